//! A survey: points spread over the proxy, and what each photograph shows of them.
//!
//! Coverage, sharpness, exposure gains and the search for light that moves with the object all ask the same thing:
//! what do several photographs say about one surface point? So every photograph is decoded once, at a low resolution,
//! and looked up at all points it sees; the rest works on these few numbers. Memory holds one decoded photograph per
//! thread and about [`MOST_OBSERVATIONS`] looked-up values, however many photographs there are.
//!
//! Two pictures of the object's window are used: a fine one for detail, and its mean over whole pixels for colour,
//! where a misregistration by a pixel or two of the fine one does little harm.

mod gains;
mod light;
mod look;
mod sharpness;
mod surface;
mod within;

use std::time::Instant;

use ign_geometry::{Camera, Drawable, GBuffer, WarpOptions};
use rayon::prelude::*;

use crate::fault::{Fault, Severity, error_chain};
use crate::frame::Frame;
use crate::scene::Scene;
use look::Look;
use surface::SurfacePoint;

pub use gains::Gains;
pub(crate) use light::MovingLight;
pub(crate) use sharpness::Sharpness;
pub(crate) use within::median;
use within::{Datum, Effects};

/// Points on the surface, where the views are few.
const MOST_POINTS: usize = 4000;
/// Points on the surface at least, however many views there are.
const FEWEST_POINTS: usize = 800;
/// Observations that are aimed at: about a third of the points times the views.
const MOST_OBSERVATIONS: usize = 150_000;
/// Pixels of the coarse picture's sides.
const COARSE_PX: u32 = 128;
/// Fine pixels per coarse one at most.
const MOST_FACTOR: u32 = 4;
/// Pixels of the photograph per pixel of the fine picture, along a side, from which its detail is its own.
const NATIVE: f64 = 0.85;
/// Margin of the window around the object.
const MARGIN: f64 = 0.03;

/// What the photographs show of the proxy's surface.
#[derive(Debug)]
pub struct Survey {
    pub(crate) points: Vec<SurfacePoint>,
    /// In the order of the scene's views.
    pub(crate) views: Vec<ViewSurvey>,
    /// Whether the light moves with the object.
    pub(crate) light: MovingLight,
    /// Photographs that could not be decoded.
    pub(crate) faults: Vec<Fault>,
    /// Seconds that it took.
    pub(crate) secs: f64,
}

/// What one photograph shows.
#[derive(Debug)]
pub(crate) struct ViewSurvey {
    /// Normalised frame, with the fine picture's intrinsics.
    pub(crate) camera: Camera,
    /// The surface points that it sees, ascending.
    pub(crate) sightings: Vec<Sighting>,
    /// Whether the photograph has as many pixels as the fine picture.
    pub(crate) is_native: bool,
    /// Shares of the object's pixels that are white and black to the limit.
    pub(crate) overexposed: f64,
    pub(crate) underexposed: f64,
}

/// One point in one photograph.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Sighting {
    pub(crate) point: u32,
    /// Cosine between the normal and the direction to the camera.
    pub(crate) cos: f32,
    /// Absent where the photograph shows something else as well: at rims, outside the mask or the picture.
    pub(crate) look: Option<Look>,
}

impl Survey {
    /// Surveys all views, held-out ones included. Photographs that cannot be decoded become faults.
    pub fn new(scene: &Scene) -> Self {
        let began = Instant::now();
        let normalised_from_world = scene.mesh.normalisation();
        let mesh = scene.mesh.transformed(&normalised_from_world);
        let count =
            (3 * MOST_OBSERVATIONS / scene.views.len().max(1)).clamp(FEWEST_POINTS, MOST_POINTS);
        let drawable = Drawable::new(&mesh);
        let points = surface::sample(&mesh, &drawable, count);
        let factor = scene.useful_scale(
            &Frame::Object {
                size: COARSE_PX,
                margin: MARGIN,
            },
            MOST_FACTOR,
        );
        let fine = Frame::Object {
            size: COARSE_PX * factor,
            margin: MARGIN,
        };
        let (views, faults): (Vec<ViewSurvey>, Vec<Option<Fault>>) = (0..scene.views.len())
            .into_par_iter()
            .map(|index| {
                let world = scene.frame_camera(index, &fine, 1);
                let camera = world.transformed(normalised_from_world);
                let coarse = Camera {
                    intrinsics: camera.intrinsics.resized(COARSE_PX, COARSE_PX),
                    ..camera
                };
                let gbuffer = drawable.g_buffer(&coarse, 1);
                let mut view = ViewSurvey {
                    camera,
                    sightings: sightings(&gbuffer, &points),
                    is_native: scene.window(index, MARGIN).1
                        >= NATIVE * f64::from(COARSE_PX * factor),
                    overexposed: 0.0,
                    underexposed: 0.0,
                };
                let fault = match scene.load_view(index, &world) {
                    Ok(image) => {
                        look::look_up(&mut view, &image, &gbuffer, &points, factor);
                        None
                    }
                    Err(error) => Some(Fault {
                        severity: Severity::Error,
                        message: error_chain(&error),
                        at: format!("view {}", scene.views[index].name),
                        hint: "copy the file again: it seems to be damaged".into(),
                    }),
                };
                (view, fault)
            })
            .unzip();
        let mut survey = Self {
            points,
            views,
            light: MovingLight::unknown(),
            faults: faults.into_iter().flatten().collect(),
            secs: 0.0,
        };
        survey.light = MovingLight::of(&survey);
        survey.secs = began.elapsed().as_secs_f64();
        survey
    }
}

fn sightings(view: &GBuffer, points: &[SurfacePoint]) -> Vec<Sighting> {
    let options = WarpOptions::default();
    (0..)
        .zip(points)
        .filter_map(|(index, point)| {
            let seen = view.sees(point.position, point.normal, &options)?;
            Some(Sighting {
                point: index,
                cos: seen.cos as f32,
                look: None,
            })
        })
        .collect()
}

impl Survey {
    /// The values and features that `value` finds in the sightings, by point; points that one view alone tells about say nothing.
    fn data<const K: usize>(
        &self,
        value: impl Fn(&ViewSurvey, &Sighting) -> Option<(f64, [f64; K])>,
    ) -> Vec<Datum<K>> {
        let mut data: Vec<Datum<K>> = (0..)
            .zip(&self.views)
            .flat_map(|(view, seen)| {
                seen.sightings.iter().filter_map({
                    let value = &value;
                    move |sighting| {
                        let (value, features) = value(seen, sighting)?;
                        Some(Datum {
                            point: sighting.point,
                            view,
                            value,
                            features,
                        })
                    }
                })
            })
            .collect();
        data.sort_by_key(|datum| datum.point);
        data.chunk_by(|a, b| a.point == b.point)
            .filter(|group| group.len() >= 2)
            .flatten()
            .copied()
            .collect()
    }
}

/// Errors of a fit at points that it did not see: fitted on each half of the surface, judged on the other.
fn cross_validated<const K: usize>(
    survey: &Survey,
    data: &[Datum<K>],
    fit: impl Fn(&[Datum<K>]) -> Effects<K>,
) -> Vec<f64> {
    let (even, odd): (Vec<_>, Vec<_>) = data
        .iter()
        .partition(|datum| survey.points[datum.point as usize].fold() == 0);
    [(&even, &odd), (&odd, &even)]
        .into_iter()
        .flat_map(|(seen, judged)| fit(seen).residuals(judged))
        .collect()
}

/// Residuals count at most so many robust standard deviations: highlights and misregistration must not decide.
const CAP: f64 = 3.0;

/// Share of the first errors' mean square that the second ones are without; 0 where they are larger.
fn explained(before: &[f64], after: &[f64]) -> f64 {
    let cap = CAP * within::robust_scale(before);
    let power = |errors: &[f64]| errors.iter().map(|e| e.abs().min(cap).powi(2)).sum::<f64>();
    let before = power(before);
    if before > 0.0 {
        (1.0 - power(after) / before).max(0.0)
    } else {
        0.0
    }
}
