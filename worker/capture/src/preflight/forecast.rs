//! What a bake will cost: disk, memory, time.
//!
//! Orders of magnitude for preset `standard` on two CPU cores, scaled by what they grow with. Measured against them: peak
//! memory 0.86 GB for 67 views at 128 pixels (0.94 said), 1.60 GB for 144 views at 256 (1.21 said); bundles of 5.3 MB
//! (6.1 said) and 14.3 MB (12 said). Training ends with the recipe's budget. Without one it takes the steps of the preset:
//! two trainings of `CompositionNet` at the 3 to 4 steps a second seen on a busy machine of two cores. Which machine is
//! going to train, only the coordinator finds out: what this one could tell is not asked.

use serde::{Deserialize, Serialize};

use super::PreflightOptions;
use crate::frame::Frame;
use crate::scene::{Mask, Scene};
use crate::survey::Survey;

/// Memory of a bake before any view is loaded: libtorch, networks, their optimiser, one step.
const BASE_BYTES: f64 = 0.9e9;
/// Memory per training view and pixel of its image.
const BYTES_PER_VIEW_PIXEL: f64 = 40.0;
/// Reference views in a bundle at most.
const MOST_REFERENCES: usize = 20;
/// Factor between the references' resolution and the images', where the photographs allow it.
const REFERENCE_SCALE: u32 = 2;
/// Bytes of a reference view's pixel, as PNG.
const BYTES_PER_REFERENCE_PIXEL: f64 = 1.6;
/// Bytes of a proxy's vertex and triangle in a bundle.
const BYTES_PER_VERTEX: f64 = 28.0;
const BYTES_PER_TRIANGLE: f64 = 12.0;
/// Weights, metrics, report, previews.
const OTHER_BUNDLE_BYTES: f64 = 3e6;
/// Seconds of training with the preset's own number of steps, on two cores.
const TRAINING_SECS: f64 = 600.0;

/// What a bake will cost: preset `standard`, two CPU cores, to a factor of two.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Forecast {
    /// Side of the baked images in pixels.
    pub size: u32,
    /// Bytes of photographs, masks and proxy: nearly all of what is uploaded.
    pub capture_bytes: u64,
    /// Seconds that reading the capture took just now; 0 where it had been read before.
    pub import_secs: f64,
    /// Seconds that decoding and surveying all photographs took just now.
    pub survey_secs: f64,
    /// Bytes of memory that training takes.
    pub training_bytes: u64,
    /// Seconds of training, at most the recipe's budget.
    pub training_secs: f64,
    /// Whether the recipe's budget ends the training; otherwise the preset's number of steps does.
    #[serde(default)]
    pub ends_by_budget: bool,
    /// Bytes of the bundle.
    pub bundle_bytes: u64,
}

pub(super) fn forecast(
    dir: &std::path::Path,
    scene: &Scene,
    survey: &Survey,
    options: &PreflightOptions,
) -> Forecast {
    let size = options.size;
    let bytes = |path: &std::path::Path| std::fs::metadata(path).map_or(0, |file| file.len());
    let pictures = scene.views.iter().map(|view| {
        let mask = match &view.mask {
            Some(Mask::File(file)) => bytes(&file.path),
            Some(Mask::Alpha) | None => 0,
        };
        let ignored = view.ignored.as_ref().map_or(0, |file| bytes(&file.path));
        bytes(&view.image_path) + mask + ignored
    });
    let proxy_file = scene.info.proxy.as_ref();
    let proxy_bytes = proxy_file.map_or(0, |proxy| bytes(&dir.join(proxy)));
    let pixels = f64::from(size).powi(2);
    let frame = Frame::Object { size, margin: 0.05 };
    let scale = f64::from(scene.useful_scale(&frame, REFERENCE_SCALE));
    let references = scene.train.len().min(MOST_REFERENCES) as f64;
    let proxy = scene.mesh.positions.len() as f64 * BYTES_PER_VERTEX
        + scene.mesh.triangles.len() as f64 * BYTES_PER_TRIANGLE;
    let bundle = references * pixels * scale * scale * BYTES_PER_REFERENCE_PIXEL
        + proxy
        + OTHER_BUNDLE_BYTES;
    let training = BASE_BYTES + scene.train.len() as f64 * pixels * BYTES_PER_VIEW_PIXEL;
    let budget_secs = options.budget_secs.filter(|secs| *secs < TRAINING_SECS);
    Forecast {
        size,
        capture_bytes: pictures.sum::<u64>() + proxy_bytes,
        import_secs: 0.0,
        survey_secs: survey.secs,
        training_bytes: training as u64,
        training_secs: budget_secs.unwrap_or(TRAINING_SECS),
        ends_by_budget: budget_secs.is_some(),
        bundle_bytes: bundle as u64,
    }
}
