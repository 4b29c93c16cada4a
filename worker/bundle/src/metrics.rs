//! `metrics.json`, schema `ign.metrics/1` (`DESIGN.md` section 7), and the functions that fill it.
//!
//! All functions take 8-bit sRGB images, because that is what people see and what others can score again from the
//! files. `mse` is on [0, 255] over all three channels, as in the paper's table of photometric re-rendering errors;
//! SSIM and FLIP are compared with scikit-image and NVIDIA's flip-evaluator in `tests/scores.rs`.

use image::RgbImage;
use serde::{Deserialize, Serialize};
use serde_json::Value;

pub use crate::manifest::StageSeconds;
use crate::{BundleError, METRICS_FILE};

mod flip;
mod ssim;

pub use flip::{flip, flip_map};
pub use ssim::ssim;

/// Schema name of `metrics.json`.
pub const SCHEMA: &str = "ign.metrics/1";

/// PSNR of equal images (mean squared error 0) and the cap of all others, in dB: JSON has no infinity, and one perfect
/// view must not carry a mean away.
pub const MAX_PSNR: f64 = 99.0;

/// The whole of `metrics.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Metrics {
    /// [`SCHEMA`].
    pub schema: String,
    /// `sha256:<hex>` of the capture manifest.
    pub capture: String,
    /// Width and height of the scored images in pixels.
    pub resolution: [u32; 2],
    /// How many views of each kind.
    pub views: ViewCounts,
    /// One row per method that ran.
    pub methods: Vec<MethodMetrics>,
    /// Error after so many seconds, per method; the curve of the report.
    pub speed_error: Vec<SpeedError>,
    /// What was tried, measured, kept, dropped, and why.
    pub plan: Value,
    /// Seconds per stage, in order.
    pub stages: Vec<StageSeconds>,
    /// What it ran on, in words.
    pub device: String,
}

/// How many views of each kind.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ViewCounts {
    /// Trained on.
    pub train: u32,
    /// Never trained on, never references.
    pub held_out: u32,
    /// In the bundle.
    pub references: u32,
}

/// One method's figures over all held-out views. Means over views, unless said otherwise.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct MethodMetrics {
    /// `ours`, `n_ibr`, `ibr`, `texture`, `vertex_color`, `ours_no_effects`, `paper`, ...
    pub name: String,
    /// Full frame, on [0, 255].
    pub mse: f64,
    /// Over the object, on [0, 255].
    pub mse_object: f64,
    /// dB per image, then averaged; full frame.
    pub psnr: f64,
    /// dB per image, then averaged; over the object.
    pub psnr_object: f64,
    /// In [-1, 1], full frame.
    pub ssim: f64,
    /// LDR-FLIP in [0, 1], full frame; null when not computed.
    pub flip: Option<f64>,
    /// The view with the highest full-frame error.
    pub worst_view: WorstView,
    /// Every held-out view.
    pub per_view: Vec<ViewMetrics>,
    /// Training time; 0 for methods that do not train.
    pub train_secs: f64,
    /// Mean time of one frame.
    pub render_ms: f64,
    /// What a viewer downloads for this method.
    pub bundle_bytes: u64,
}

/// The view with the highest error.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct WorstView {
    /// The photograph's name.
    pub name: String,
    /// Full frame, on [0, 255].
    pub mse: f64,
}

/// One held-out view.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ViewMetrics {
    /// The photograph's name.
    pub name: String,
    /// Full frame, on [0, 255].
    pub mse: f64,
    /// Over the object, on [0, 255].
    pub mse_object: f64,
}

/// A point of the speed-against-error curve.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SpeedError {
    /// As in [`MethodMetrics::name`].
    pub method: String,
    /// Training seconds so far.
    pub secs: f64,
    /// Full frame, on [0, 255].
    pub mse: f64,
    /// Over the object, on [0, 255].
    pub mse_object: f64,
}

/// Scores of one image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Scores {
    /// Full frame, on [0, 255].
    pub mse: f64,
    /// Over the object, on [0, 255].
    pub mse_object: f64,
    /// dB.
    pub psnr: f64,
    /// dB.
    pub psnr_object: f64,
    /// In [-1, 1].
    pub ssim: f64,
    /// In [0, 1].
    pub flip: f64,
}

impl Scores {
    /// Scores `image` against `target`; `object` is row-major, true on the object.
    ///
    /// # Panics
    /// If the sizes differ.
    pub fn of(image: &RgbImage, target: &RgbImage, object: &[bool]) -> Self {
        let (mse, mse_object) = (mse(image, target), mse_object(image, target, object));
        Self {
            mse,
            mse_object,
            psnr: psnr(mse),
            psnr_object: psnr(mse_object),
            ssim: ssim(image, target),
            flip: flip(image, target),
        }
    }
}

impl MethodMetrics {
    /// Whether this is somebody else's method: neither ours nor a variant of it.
    pub fn is_baseline(&self) -> bool {
        !self.name.starts_with("ours") && self.name != "paper"
    }

    /// Averages the scores of all held-out views. With no view at all every error is 0 and the worst view is "".
    pub fn from_views(
        name: &str,
        views: &[(String, Scores)],
        train_secs: f64,
        render_ms: f64,
        bundle_bytes: u64,
    ) -> Self {
        let mean = |pick: fn(&Scores) -> f64| {
            views.iter().map(|(_, scores)| pick(scores)).sum::<f64>() / views.len().max(1) as f64
        };
        let worst = views.iter().max_by(|a, b| a.1.mse.total_cmp(&b.1.mse));
        Self {
            name: name.to_owned(),
            mse: mean(|s| s.mse),
            mse_object: mean(|s| s.mse_object),
            psnr: mean(|s| s.psnr),
            psnr_object: mean(|s| s.psnr_object),
            ssim: mean(|s| s.ssim),
            flip: Some(mean(|s| s.flip)),
            worst_view: WorstView {
                name: worst.map_or_else(String::new, |(name, _)| name.clone()),
                mse: worst.map_or(0.0, |(_, scores)| scores.mse),
            },
            per_view: views
                .iter()
                .map(|(name, s)| ViewMetrics {
                    name: name.clone(),
                    mse: s.mse,
                    mse_object: s.mse_object,
                })
                .collect(),
            train_secs,
            render_ms,
            bundle_bytes,
        }
    }
}

impl Metrics {
    /// The row of method `name`.
    pub fn method(&self, name: &str) -> Option<&MethodMetrics> {
        self.methods.iter().find(|m| m.name == name)
    }

    /// The method other than ours with the lowest full-frame error: the bar to beat.
    pub fn best_baseline(&self) -> Option<&MethodMetrics> {
        self.methods
            .iter()
            .filter(|m| m.is_baseline())
            .min_by(|a, b| a.mse.total_cmp(&b.mse))
    }

    /// Pretty JSON; refuses non-finite figures, which JSON cannot hold.
    pub fn to_json(&self) -> Result<Vec<u8>, BundleError> {
        let json = serde_json::to_vec_pretty(self).map_err(BundleError::json(METRICS_FILE))?;
        // A NaN was written as null, which is no f64 on the way back.
        serde_json::from_slice::<Self>(&json).map_err(BundleError::json(METRICS_FILE))?;
        Ok(json)
    }

    /// Reads JSON of exactly this schema.
    pub fn from_json(json: &[u8]) -> Result<Self, BundleError> {
        let metrics: Self =
            serde_json::from_slice(json).map_err(BundleError::json(METRICS_FILE))?;
        if metrics.schema != SCHEMA {
            return Err(BundleError::Schema {
                file: METRICS_FILE.into(),
                found: metrics.schema,
                expected: SCHEMA,
            });
        }
        Ok(metrics)
    }
}

/// Mean squared error over the full frame and all channels, on [0, 255].
///
/// # Panics
/// If the sizes differ.
pub fn mse(image: &RgbImage, target: &RgbImage) -> f64 {
    assert_eq!(
        image.dimensions(),
        target.dimensions(),
        "images of different size cannot be compared"
    );
    let sum: u64 = image
        .iter()
        .zip(target.iter())
        .map(|(&a, &b)| u64::from(a.abs_diff(b)).pow(2))
        .sum();
    sum as f64 / image.len().max(1) as f64
}

/// Mean squared error over the pixels where `object` (row-major) is true, on [0, 255]; 0 where none is.
///
/// # Panics
/// If the sizes differ.
pub fn mse_object(image: &RgbImage, target: &RgbImage, object: &[bool]) -> f64 {
    assert_eq!(
        image.dimensions(),
        target.dimensions(),
        "images of different size cannot be compared"
    );
    assert_eq!(
        image.len(),
        object.len() * 3,
        "the mask has another size than the images"
    );
    let (mut sum, mut count) = (0_u64, 0_u64);
    for ((a, b), _) in image
        .pixels()
        .zip(target.pixels())
        .zip(object)
        .filter(|(_, object)| **object)
    {
        sum +=
            a.0.iter()
                .zip(b.0)
                .map(|(&a, b)| u64::from(a.abs_diff(b)).pow(2))
                .sum::<u64>();
        count += 3;
    }
    sum as f64 / count.max(1) as f64
}

/// Peak signal-to-noise ratio in dB of a mean squared error on [0, 255], at most [`MAX_PSNR`].
pub fn psnr(mse: f64) -> f64 {
    if mse <= 0.0 {
        MAX_PSNR
    } else {
        (10.0 * (255.0_f64 * 255.0 / mse).log10()).min(MAX_PSNR)
    }
}
