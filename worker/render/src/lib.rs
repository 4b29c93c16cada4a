//! From a bundle and a camera to an image; the image-based baselines.
