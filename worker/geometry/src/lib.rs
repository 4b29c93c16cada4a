//! Cameras, meshes, rasteriser, G-buffers, cross-projection and coverage, in f64.
