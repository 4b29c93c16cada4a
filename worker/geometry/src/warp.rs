//! Cross-projection of one view's image into another through the proxy (paper, Sec. "Proxy-based Cross-projection").
//!
//! For each covered pixel of the target view, its surface point is projected into the source view, the source image
//! is sampled bilinearly there, and a depth test against the source's G-buffer tells whether the source sees the
//! point at all. This is the CPU reference of the operation; the device version in `ign-nets` is tested against it.

use glam::{DVec2, DVec3, Vec3};
use rayon::prelude::{IndexedParallelIterator, IntoParallelIterator, ParallelIterator};
use serde::{Deserialize, Serialize};

use crate::GBuffer;

/// How the depth test decides.
///
/// A point at depth `z` of the source camera is seen when `z <= surface + bias`, where `surface` is the source's
/// depth interpolated there and
/// `bias = relative_bias * z + slope_footprints * (z / f) / max(cos, min_cos)`:
/// `z / f` is the footprint of a source pixel, `cos` that of the angle between the source's viewing ray and the
/// normal. A surface seen at an angle changes its depth within one pixel by footprint * tan, which is below
/// footprint / cos; a constant bias is either too small there (surfaces shadow themselves) or too large everywhere
/// else (colour leaks through thin parts).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct WarpOptions {
    /// Share of the depth: covers rounding and the curvature of the surface between samples.
    pub relative_bias: f64,
    /// Share of a pixel's footprint. Measured on two scanned statues at 128 pixels (views 30 to 60 degrees apart,
    /// against depth 16 times finer): 0.25 wrongly rejects 1.2 to 1.5 % of what is visible and accepts 2.4 % of what is
    /// hidden; 0.5: 0.5 to 0.8 % and 5 %; 1: 0.4 % and 12 %; 2: 0.2 % and 24 %. Most of what 0.5 still accepts lies
    /// just behind the rim; less than 0.7 % of the hidden points are accepted far behind another surface.
    pub slope_footprints: f64,
    /// Lower bound of `cos` in the bias, so that a surface seen edge-on is not compared with an unbounded bias.
    pub min_cos: f64,
    /// Points whose `cos` is below this are rejected: a pixel there smears over many target pixels.
    pub grazing_cos: f64,
}

impl Default for WarpOptions {
    fn default() -> Self {
        Self {
            relative_bias: 1e-3,
            slope_footprints: 0.5,
            min_cos: 0.2,
            grazing_cos: 0.05,
        }
    }
}

/// A view's image moved into another view, row-major.
#[derive(Clone, Debug, PartialEq)]
pub struct Warped {
    /// `[height][width][3]` of the target, in the source image's colour space; 0 where the point projects outside
    /// the source image. Filled also where `visibility` is 0 but the projection lies inside.
    pub rgb: Vec<f32>,
    /// `[height][width]`: 1 where the source sees the target's surface point, else 0.
    pub visibility: Vec<f32>,
    /// `[height][width]`: where the point falls in the source image, in pixels; 0 where it has no projection.
    pub source_px: Vec<[f32; 2]>,
}

/// How a source view sees a surface point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Seen {
    /// Where it falls in the source image.
    pub px: DVec2,
    /// Cosine of the angle between the normal and the direction to the source camera.
    pub cos: f64,
}

impl GBuffer {
    /// Whether, and how, this view sees the surface point `position` with unit normal `normal`; `None` when the point
    /// is outside the image, behind another surface, or turned away.
    pub fn sees(&self, position: DVec3, normal: DVec3, options: &WarpOptions) -> Option<Seen> {
        let seen = self.camera.project(position)?;
        if !self.camera.intrinsics.contains(seen.px) {
            return None;
        }
        let cos = normal.dot((self.camera.center() - position).try_normalize()?);
        if cos.is_nan() || cos < options.grazing_cos {
            return None;
        }
        let (mut depth, mut weight) = (0.0, 0.0);
        for (index, share) in neighbours(seen.px, self.width as usize, self.height as usize)? {
            if self.mask[index] {
                depth += share * f64::from(self.depth[index]);
                weight += share;
            }
        }
        let focal = 0.5 * (self.camera.intrinsics.fx + self.camera.intrinsics.fy);
        let footprint = seen.depth / focal / cos.max(options.min_cos);
        let bias = options.relative_bias * seen.depth + options.slope_footprints * footprint;
        let surface = depth / weight;
        (surface.is_finite() && seen.depth <= surface + bias).then_some(Seen { px: seen.px, cos })
    }
}

/// The four pixels around an image point and their bilinear weights; pixels beyond the border repeat it.
/// `None` for an image without pixels.
fn neighbours(px: DVec2, width: usize, height: usize) -> Option<[(usize, f64); 4]> {
    if width == 0 || height == 0 {
        return None;
    }
    let place = px - 0.5;
    let low = place.floor();
    let part = place - low;
    let column = |offset: f64| (low.x + offset).clamp(0.0, (width - 1) as f64) as usize;
    let row = |offset: f64| (low.y + offset).clamp(0.0, (height - 1) as f64) as usize;
    Some([
        (
            row(0.0) * width + column(0.0),
            (1.0 - part.x) * (1.0 - part.y),
        ),
        (row(0.0) * width + column(1.0), part.x * (1.0 - part.y)),
        (row(1.0) * width + column(0.0), (1.0 - part.x) * part.y),
        (row(1.0) * width + column(1.0), part.x * part.y),
    ])
}

/// Warps `source_rgb` (`[height][width][3]` of the source view) into the target view.
///
/// # Panics
/// When `source_rgb` has another length than the source view's pixels need: like slicing out of bounds, that is a
/// mistake in the calling code, not in its data.
pub fn cross_project(
    source: &GBuffer,
    source_rgb: &[f32],
    target: &GBuffer,
    options: &WarpOptions,
) -> Warped {
    let (width, height) = (source.width as usize, source.height as usize);
    assert_eq!(
        source_rgb.len(),
        width * height * 3,
        "source image is not {width}x{height}x3"
    );
    let pixels: Vec<([f32; 3], f32, [f32; 2])> = (0..target.mask.len())
        .into_par_iter()
        .with_min_len(1024)
        .map(|index| {
            let nothing = ([0.0; 3], 0.0, [0.0; 2]);
            if !target.mask[index] {
                return nothing;
            }
            let position = Vec3::from(target.position[index]).as_dvec3();
            let normal = Vec3::from(target.normal[index]).as_dvec3();
            let Some(projection) = source.camera.project(position) else {
                return nothing;
            };
            let px = projection.px;
            if !source.camera.intrinsics.contains(px) {
                return ([0.0; 3], 0.0, px.as_vec2().to_array());
            }
            let Some(neighbours) = neighbours(px, width, height) else {
                return nothing;
            };
            let mut rgb = [0.0_f64; 3];
            for (index, share) in neighbours {
                for (channel, sum) in rgb.iter_mut().enumerate() {
                    *sum += share * f64::from(source_rgb[index * 3 + channel]);
                }
            }
            let visible = source.sees(position, normal, options).is_some();
            (
                rgb.map(|channel| channel as f32),
                f32::from(visible),
                px.as_vec2().to_array(),
            )
        })
        .collect();
    Warped {
        rgb: pixels.iter().flat_map(|(rgb, _, _)| *rgb).collect(),
        visibility: pixels.iter().map(|(_, visible, _)| *visible).collect(),
        source_px: pixels.iter().map(|(_, _, px)| *px).collect(),
    }
}
