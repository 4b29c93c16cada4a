//! The report on a capture before anything is queued or spent.
//!
//! [`preflight`] imports and surveys a capture and says in figures and in words what a bake can expect of it: how much
//! there is, which parts of the surface no photograph shows, whether photographs are blurred, drift in exposure or show
//! a light that moves with the object, how large the object is, and what a bake will cost. What is wrong or doubtful is
//! a [`Fault`] with what to do about it; all of them are found in one pass.
//!
//! Every figure is finite, whatever the photographs show: constant colour, black, white, a single view, no points.

mod coverage;
mod forecast;
mod path;
mod photographs;
mod scale;
mod words;

use std::path::{Path, PathBuf};
use std::time::Instant;

use serde::{Deserialize, Serialize};

use crate::fault::{Fault, Faults, ImportError, Severity, error_chain};
use crate::import::{ImportOptions, import};
use crate::scene::Scene;
use crate::survey::{Gains, Survey};

pub use coverage::{Coverage, Region};
pub use forecast::Forecast;
pub use path::Baselines;
pub use photographs::{BlurredView, Exposure, Light, Sharpness};
pub use scale::Scale;
pub use words::Line;

/// What the caller decides about a preflight.
#[derive(Debug, Clone)]
pub struct PreflightOptions {
    /// The proxy's path inside the capture, instead of the one the capture names.
    pub proxy: Option<PathBuf>,
    /// Side of the images that are going to be baked, in pixels; the forecast depends on it.
    pub size: u32,
    /// Seconds of training at most, as the recipe says; the forecast depends on it.
    pub budget_secs: Option<f64>,
}

/// What is known about a capture before it is baked. The JSON form is stable; it may gain fields.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Preflight {
    /// Name of the object or of the folder.
    pub capture: String,
    /// Whether a bake can begin: no fault is an error.
    pub ok: bool,
    /// What is wrong or doubtful, errors first.
    pub faults: Vec<Fault>,
    /// The figures; absent where the capture cannot be read.
    pub findings: Option<Findings>,
}

/// Figures of a capture.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Findings {
    /// How much there is.
    pub counts: Counts,
    /// Which part of the surface the photographs show.
    pub coverage: Coverage,
    /// Where the cameras stand.
    pub baselines: Baselines,
    /// How well the reconstruction fits; absent where it has no points.
    pub reprojection: Option<Reprojection>,
    /// Motion blur.
    pub sharpness: Sharpness,
    /// Exposure and white balance.
    pub exposure: Exposure,
    /// Whether the light moves with the object.
    pub light: Light,
    /// Size of the object.
    pub scale: Scale,
    /// What a bake will cost.
    pub forecast: Forecast,
}

/// How much there is of everything.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Counts {
    /// Photographs with a pose that see the proxy.
    pub views: usize,
    /// Of these, views to train on.
    pub train: usize,
    /// Of these, views only ever compared with.
    pub held_out: usize,
    /// Files in `images/` that are no view: without a pose, or not seeing the proxy.
    pub left_out: usize,
    /// Points of the reconstruction.
    pub points: usize,
    /// Triangles of the proxy.
    pub triangles: usize,
    /// Pixels of all views, in millions.
    pub megapixels: f64,
    /// Median side, in pixels of the photographs, of the window around the object.
    pub object_px: f64,
}

/// Reprojection error of the reconstruction's points, in pixels of the photographs.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Reprojection {
    /// Mean over the points.
    pub mean_px: f64,
    /// Median over the points.
    pub median_px: f64,
    /// Share of the points whose error is above [`Reprojection::HIGH_PX`].
    pub high_share: f64,
}

impl Reprojection {
    /// What counts as a high error, in pixels.
    pub const HIGH_PX: f64 = 2.0;

    fn is_doubtful(&self) -> bool {
        self.median_px > DOUBTFUL_MEDIAN_PX || self.high_share > DOUBTFUL_HIGH_SHARE
    }
}

/// Median reprojection error that is doubtful, in pixels.
const DOUBTFUL_MEDIAN_PX: f64 = 1.5;
/// Share of high reprojection errors that is doubtful.
const DOUBTFUL_HIGH_SHARE: f64 = 0.1;
/// Upsampling that is pointless: the object's window has fewer pixels than this share of the size asked for.
const LEAST_RESOLUTION: f64 = 0.7;

/// Imports, surveys and judges the capture in `dir`. Never fails: what is wrong is in the report.
pub fn preflight(dir: &Path, options: &PreflightOptions) -> Preflight {
    let began = Instant::now();
    let import_options = ImportOptions {
        proxy: options.proxy.clone(),
    };
    match import(dir, &import_options) {
        Ok(scene) => {
            let import_secs = began.elapsed().as_secs_f64();
            let survey = Survey::new(&scene);
            let gains = Gains::estimate(&scene, &survey);
            let mut report = Preflight::of(dir, &scene, &survey, &gains, options);
            if let Some(findings) = &mut report.findings {
                findings.forecast.import_secs = import_secs;
            }
            report
        }
        Err(error) => {
            let faults = match error {
                ImportError::Faults(faults) => faults,
                other => vec![Fault {
                    severity: Severity::Error,
                    message: error_chain(&other),
                    at: dir.display().to_string(),
                    hint: "check that the folder can be read".into(),
                }],
            };
            let name = dir.file_name().unwrap_or(dir.as_os_str());
            Preflight {
                capture: name.to_string_lossy().into_owned(),
                ok: false,
                faults,
                findings: None,
            }
        }
    }
}

impl Preflight {
    /// The report on a scene, imported from `dir`, that was surveyed.
    pub fn of(
        dir: &Path,
        scene: &Scene,
        survey: &Survey,
        gains: &Gains,
        options: &PreflightOptions,
    ) -> Self {
        let mut faults = Faults::default();
        faults.extend(scene.warnings.iter().cloned());
        faults.extend(survey.faults.iter().cloned());
        let counts = counts(dir, scene);
        check_resolution(&counts, options.size, &mut faults);
        let findings = Findings {
            coverage: coverage::coverage(scene, survey, &mut faults),
            baselines: path::baselines(scene, survey, &mut faults),
            reprojection: reprojection(scene, &mut faults),
            sharpness: photographs::sharpness(scene, survey, &mut faults),
            exposure: photographs::exposure(scene, survey, gains, &mut faults),
            light: photographs::light(survey, &mut faults),
            scale: scale::scale(scene, &mut faults),
            forecast: forecast::forecast(dir, scene, survey, options),
            counts,
        };
        Self {
            capture: scene.name.clone(),
            ok: !faults.has_errors(),
            faults: faults.into_list(),
            findings: Some(findings),
        }
    }
}

fn counts(dir: &Path, scene: &Scene) -> Counts {
    let pixels = scene
        .views
        .iter()
        .map(|view| f64::from(view.source.width) * f64::from(view.source.height));
    let windows = (0..scene.views.len()).map(|view| scene.window(view, 0.0).1);
    Counts {
        views: scene.views.len(),
        train: scene.train.len(),
        held_out: scene.held_out.len(),
        left_out: files_below(&dir.join("images")).saturating_sub(scene.views.len()),
        points: scene.points.len(),
        triangles: scene.mesh.triangles.len(),
        megapixels: pixels.sum::<f64>() / 1e6,
        object_px: crate::survey::median(windows.collect()),
    }
}

/// Files in a folder and its folders; hidden ones do not count.
fn files_below(dir: &Path) -> usize {
    let Ok(entries) = std::fs::read_dir(dir) else {
        return 0;
    };
    entries
        .filter_map(Result::ok)
        .filter(|entry| !entry.file_name().as_encoded_bytes().starts_with(b"."))
        .map(|entry| match entry.file_type() {
            Ok(kind) if kind.is_dir() => files_below(&entry.path()),
            Ok(_) => 1,
            Err(_) => 0,
        })
        .sum()
}

fn check_resolution(counts: &Counts, size: u32, faults: &mut Faults) {
    if counts.object_px < LEAST_RESOLUTION * f64::from(size) {
        faults.warning(
            format!(
                "the photographs show the object at about {:.0} pixels, less than the {size} that are to be baked",
                counts.object_px
            ),
            "images/",
            "bake at a smaller size, or take photographs from nearer",
        );
    }
}

fn reprojection(scene: &Scene, faults: &mut Faults) -> Option<Reprojection> {
    let errors: Vec<f64> = scene
        .points
        .iter()
        .filter_map(|point| point.error_px)
        .filter(|error| error.is_finite() && *error >= 0.0)
        .collect();
    if errors.is_empty() {
        return None;
    }
    let count = errors.len() as f64;
    let high = errors
        .iter()
        .filter(|error| **error > Reprojection::HIGH_PX)
        .count();
    let found = Reprojection {
        mean_px: errors.iter().map(|error| error / count).sum(),
        high_share: high as f64 / count,
        median_px: crate::survey::median(errors),
    };
    if found.is_doubtful() {
        faults.warning(
            format!(
                "the reconstruction fits loosely: the median reprojection error is {:.1} pixels, {:.0} % of the points are \
                 above {:.0}",
                found.median_px,
                100.0 * found.high_share,
                Reprojection::HIGH_PX
            ),
            "sparse/",
            "refine the cameras (bundle adjustment with the lens's parameters), and leave out photographs that moved",
        );
    }
    Some(found)
}
