//! The camera path: a spiral from below the object's middle to high above, always looking at it.

use std::f64::consts::TAU;

use glam::DVec3;
use ign_geometry::{Camera, CameraIntrinsics};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;

use crate::{DemoError, DemoOptions};

/// Rounds of the spiral.
const ROUNDS: f64 = 5.0;
/// Elevation at its start and end, degrees.
const ELEVATION: (f64, f64) = (-14.0, 64.0);
/// Distance from the object, scene units; each view varies it.
pub(crate) const DISTANCE: f64 = 4.0;
const DISTANCE_VARIES: f64 = 0.05;
/// Roll of the camera, radians.
const ROLL_VARIES: f64 = 0.10;
/// Focal length over image width: the object's sphere (radius 1) fills nine tenths of the width.
pub(crate) const FOCAL: f64 = 1.72;
/// The principal point, off centre on purpose, as a share of the width and height.
const PRINCIPAL_POINT: (f64, f64) = (0.4785, 0.5137);

/// Elevation of an orbit, degrees: in the middle of what the spiral covers.
const ORBIT_ELEVATION: f64 = 22.0;

/// One view to render.
pub(crate) struct DemoView {
    /// Stem of its files.
    pub(crate) stem: String,
    pub(crate) camera: Camera,
    pub(crate) held_out: bool,
}

fn intrinsics(options: &DemoOptions) -> CameraIntrinsics {
    let size = f64::from(options.size);
    CameraIntrinsics {
        fx: FOCAL * size,
        fy: FOCAL * size,
        cx: PRINCIPAL_POINT.0 * size,
        cy: PRINCIPAL_POINT.1 * size,
        width: options.size,
        height: options.size,
    }
}

/// From the object's middle; angles in radians.
fn direction(azimuth: f64, elevation: f64) -> DVec3 {
    DVec3::new(
        elevation.cos() * azimuth.cos(),
        elevation.cos() * azimuth.sin(),
        elevation.sin(),
    )
}

/// The held-out frames of one round, if there are to be any.
pub(crate) fn orbit(options: &DemoOptions, center: DVec3) -> Result<Vec<DemoView>, DemoError> {
    let frames = options.orbit.unwrap_or(0);
    (0..frames)
        .map(|index| {
            let azimuth = TAU * index as f64 / frames as f64;
            let outwards = direction(azimuth, ORBIT_ELEVATION.to_radians());
            let eye = center + outwards * DISTANCE;
            let camera = Camera::look_at(intrinsics(options), eye, center, DVec3::Z);
            Ok(DemoView {
                stem: format!("orbit_{index:04}"),
                camera: camera.map_err(|source| DemoError::Camera {
                    view: index,
                    source,
                })?,
                held_out: true,
            })
        })
        .collect()
}

/// All views of the spiral, in path order.
pub(crate) fn spiral(options: &DemoOptions, center: DVec3) -> Result<Vec<DemoView>, DemoError> {
    let mut rng = Pcg32::seed_from_u64(options.seed ^ 0x7061_7468);
    let start = rng.random_range(0.0..TAU);
    let intrinsics = intrinsics(options);
    let held_out = options.held_out_count();
    let mut views = Vec::with_capacity(options.views);
    for index in 0..options.views {
        let along = (index as f64 + 0.5) / options.views as f64;
        // Even steps in the sine of the elevation: even coverage of the sphere.
        let sine = |degrees: f64| degrees.to_radians().sin();
        let elevation =
            (sine(ELEVATION.0) + (sine(ELEVATION.1) - sine(ELEVATION.0)) * along).asin();
        let azimuth = start + TAU * ROUNDS * along;
        let distance = DISTANCE * (1.0 + rng.random_range(-DISTANCE_VARIES..DISTANCE_VARIES));
        let roll = rng.random_range(-ROLL_VARIES..ROLL_VARIES);
        let outwards = direction(azimuth, elevation);
        let side = DVec3::new(-azimuth.sin(), azimuth.cos(), 0.0);
        let up = DVec3::Z * roll.cos() + side * roll.sin();
        let camera = Camera::look_at(intrinsics, center + outwards * distance, center, up)
            .map_err(|source| DemoError::Camera {
                view: index,
                source,
            })?;
        // Held-out views stand in the middle of equal stretches of the path.
        let held_out =
            (0..held_out).any(|slot| (2 * slot + 1) * options.views / (2 * held_out) == index);
        views.push(DemoView {
            stem: format!("view_{index:04}"),
            camera,
            held_out,
        });
    }
    Ok(views)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn as_many_views_are_held_out_as_asked_for() {
        for views in 3..60 {
            for held_out in 0..=views - 2 {
                let options = DemoOptions {
                    views,
                    held_out: Some(held_out),
                    ..DemoOptions::default()
                };
                let path = spiral(&options, DVec3::ZERO).expect("a path");
                assert_eq!(
                    path.iter().filter(|view| view.held_out).count(),
                    held_out,
                    "{held_out} of {views}"
                );
            }
        }
    }
}
