//! From a bundle and a camera to an image, and the image-based baselines beside it.
//!
//! Path of one image: [`Target`] rasterises the proxy for the camera; [`References::warp`] cross-projects the K
//! chosen reference views; [`Model::image`] removes and re-inserts effects, blends, and composites with the target's
//! coverage. Training, evaluation and the shipped renderer all go through these functions, so what is scored is what
//! a viewer sees.

mod baselines;
mod bundle;
mod camera_file;
mod model;
mod references;
mod settings;
mod surface_colors;
mod target;
mod translation;

pub use baselines::{debevec_ibr, naive_ibr};
pub use bundle::{BundleRenderer, NetworkFiles, RenderError, import, orbit};
pub use camera_file::{CameraFileError, parse_cameras, read_cameras};
pub use model::{Composition, Effects, Model};
pub use references::{ReferenceImage, References, Warped};
pub use settings::{CoverageRule, Recipe, RenderSettings};
pub use surface_colors::{ColorGrid, SurfaceColors};
pub use target::{COVERAGE_CELLS, Target};
pub use translation::{Translation, TranslationInput};

use image::RgbImage;
use tch::Tensor;

/// [1, 3, H, W] encoded sRGB in [0, 1] to an 8-bit image.
pub fn to_image(image: &Tensor) -> RgbImage {
    let (_, _, height, width) = image.size4().unwrap_or((1, 3, 0, 0));
    let rows = (image
        .squeeze_dim(0)
        .permute([1, 2, 0])
        .contiguous()
        .clamp(0.0, 1.0)
        * 255.0)
        .round();
    let bytes = ign_nets::params::flat_values(&rows)
        .into_iter()
        .map(|value| value as u8)
        .collect();
    RgbImage::from_raw(width as u32, height as u32, bytes).unwrap_or_default()
}
