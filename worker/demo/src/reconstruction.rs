//! What a reconstruction from photographs would have made of it: a proxy and poses that are a little off.

use glam::{DAffine3, DQuat, DVec3};
use ign_geometry::{Camera, Mesh};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;

use crate::paint::Noise;
use crate::path::{DISTANCE, DemoView, FOCAL};
use crate::shape::Surface;
use crate::{DemoError, DemoOptions};

/// Dents and bulges per scene unit.
const FREQUENCY: f64 = 4.0;
/// Standard deviation of the noise that makes them.
const NOISE_DEVIATION: f64 = 0.15;
/// Poses come out better than surfaces: their share of the error.
const POSE_SHARE: f64 = 0.5;

/// The surface, with dents and bulges along its normals whose standard deviation is as long as so many pixels are wide.
pub(crate) fn proxy(mut surface: Surface, options: &DemoOptions) -> Result<Surface, DemoError> {
    if options.misregistration == 0.0 {
        return Ok(surface);
    }
    let mut rng = Pcg32::seed_from_u64(options.seed ^ 0x7072_6f78_7900);
    let noise = Noise { seed: rng.random() };
    let pixel = DISTANCE / (FOCAL * f64::from(options.size));
    let displaced = |(position, normal): (&DVec3, &DVec3)| {
        let wave = (noise.fractal(*position * FREQUENCY) - 0.5) / NOISE_DEVIATION;
        *position + *normal * (wave * options.misregistration * pixel)
    };
    let places = surface.positions.iter().zip(&surface.normals);
    let mesh = Mesh::new(places.map(displaced).collect(), surface.triangles.clone())
        .map_err(|source| DemoError::Proxy { source })?;
    surface.positions = mesh.positions;
    surface.normals = mesh.normals;
    Ok(surface)
}

/// The views' cameras, turned about themselves.
pub(crate) fn cameras(views: &[DemoView], options: &DemoOptions) -> Vec<Camera> {
    let mut rng = Pcg32::seed_from_u64(options.seed ^ 0x706f_7365_7300);
    // Of an even distribution with the wanted standard deviation, in radians.
    let widest =
        3f64.sqrt() * POSE_SHARE * options.misregistration / (FOCAL * f64::from(options.size));
    views
        .iter()
        .map(|view| {
            let mut turn = || (2.0 * rng.random::<f64>() - 1.0) * widest;
            let turned = DQuat::from_scaled_axis(DVec3::new(turn(), turn(), turn()));
            Camera {
                camera_from_world: DAffine3::from_quat(turned) * view.camera.camera_from_world,
                ..view.camera
            }
        })
        .collect()
}
