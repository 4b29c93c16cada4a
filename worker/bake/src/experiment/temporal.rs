//! How much neighbouring frames of a path differ beyond what moved.

use ign_bundle::{Bundle, held_out_file};
use ign_geometry::Drawable;
use ign_nets::warp::Sources;
use ign_render::{RenderSettings, Target};
use tch::{Device, Kind, Tensor, no_grad};

use crate::BakeError;

/// Visible share of a pixel's footprint in the frame before from which on the pixel counts.
const VISIBLE: f64 = 0.99;

/// From one frame to the next: mean squared difference of the frame from the one before, warped into it, on [0, 255].
pub(super) struct Step {
    pub(super) ours: f64,
    pub(super) truth: f64,
}

/// Residuals along the held-out views of a bundle, in their order.
///
/// # Errors
/// A bundle that cannot be read, or fewer than two frames.
pub(super) fn residuals(bundle: &Bundle) -> Result<Vec<Step>, BakeError> {
    let (mesh, _) = bundle.proxy()?;
    let proxy = Drawable::new(&mesh);
    let settings = RenderSettings {
        supersample: 1,
        ..RenderSettings::default()
    };
    let views = bundle.held_out_views()?;
    if views.len() < 2 {
        return Err(BakeError::Unusable {
            message: "the capture holds out fewer than two views: there is no path".into(),
            hint: "hold out the frames of a path; ign-worker demo-capture --orbit makes one".into(),
        });
    }
    let picture = |name: &str, method: &str| -> Result<Tensor, BakeError> {
        let bytes = bundle.read(&held_out_file(name, method))?;
        let image = image::load_from_memory(&bytes)
            .map_err(|source| BakeError::Picture {
                file: "held_out",
                source,
            })?
            .into_rgb8();
        Ok(Tensor::from_slice(&image.into_raw())
            .view([-1, 3])
            .to_kind(Kind::Float))
    };
    let mut steps = Vec::new();
    for pair in views.windows(2) {
        let [before, now] = pair else { continue };
        let depth = proxy.g_buffer(&before.camera, 1);
        let depth: Vec<f32> = depth
            .depth
            .iter()
            .zip(&depth.mask)
            .map(|(&z, &covered)| if covered { z } else { 0.0 })
            .collect();
        let target = Target::new(&proxy, &now.camera, &settings, Device::Cpu);
        let sources = Sources::new(&[before.camera], &depth, Device::Cpu);
        let points = target.points.size()[0];
        let first = Tensor::zeros([points], (Kind::Int64, Device::Cpu));
        let taps = sources.taps(&target.points, &target.normals, &first);
        // Rims mix object and background.
        let whole = target
            .coverage
            .view([-1])
            .index_select(0, &target.pixel)
            .ge(1.0);
        let counted = taps
            .visibility
            .gt(VISIBLE)
            .logical_and(&whole)
            .to_kind(Kind::Float);
        let residual = |method: &str| -> Result<f64, BakeError> {
            let (before, now) = (picture(&before.name, method)?, picture(&now.name, method)?);
            Ok(no_grad(|| {
                let warped = taps.gather(&before) / taps.visibility.clamp_min(1e-3).unsqueeze(1);
                let squared = (warped - now.index_select(0, &target.pixel)).square();
                let sum = (squared * counted.unsqueeze(1)).sum(Kind::Double);
                (sum / (counted.sum(Kind::Double).clamp_min(1.0) * 3.0)).double_value(&[])
            }))
        };
        steps.push(Step {
            ours: residual("ours")?,
            truth: residual("target")?,
        });
    }
    Ok(steps)
}
