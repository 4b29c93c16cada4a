//! What a photograph shows at a surface point: its colour, and how much detail there is around it.

use ign_geometry::GBuffer;

use super::ViewSurvey;
use super::surface::SurfacePoint;
use crate::resample::ViewImage;

/// Encoded values from here on count as clipped, to here as lost in the dark.
const WHITE: f32 = 250.0 / 255.0;
const BLACK: f32 = 3.0 / 255.0;
/// Least mask and share inside the photograph of a pixel that shows the object alone.
const WHOLE: f32 = 0.99;
/// Pixels of the fine picture around a point, to each side, over which detail is measured.
const DETAIL_REACH: usize = 5;
/// Directions in which detail is measured: across, down, and the diagonals.
pub(crate) const DIRECTIONS: [(isize, isize); 4] = [(1, 0), (0, 1), (1, 1), (1, -1)];
/// Added to the mean square of the second difference relative to the mean: below it there is nothing but the rounding
/// to 8 bits.
const DETAIL_FLOOR: f64 = 1e-7;

/// A photograph at one surface point.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Look {
    /// Linear light, in [0, 1].
    pub(crate) linear: [f32; 3],
    /// Whether the value of some pixel around is at the sensor's upper or lower limit, per channel.
    pub(crate) clipped: [bool; 3],
    /// Logarithm of the relative mean square of second differences, per direction; none next to a rim.
    pub(crate) detail: Option<[f32; 4]>,
}

/// The pixels of a picture that show the object alone.
struct Interior {
    width: usize,
    inside: Vec<bool>,
}

impl Interior {
    /// True where all pixels up to `reach` away are.
    fn holds(&self, x: usize, y: usize, reach: usize) -> bool {
        let height = self.inside.len() / self.width;
        x >= reach
            && y >= reach
            && x + reach < self.width
            && y + reach < height
            && (y - reach..=y + reach).all(|row| {
                self.inside[row * self.width + x - reach..=row * self.width + x + reach]
                    .iter()
                    .all(|&inside| inside)
            })
    }
}

/// Looks up all points that the view sees. `image` has `factor` pixels along each side of one of `coarse`.
pub(crate) fn look_up(
    view: &mut ViewSurvey,
    image: &ViewImage,
    coarse: &GBuffer,
    points: &[SurfacePoint],
    factor: u32,
) {
    let (width, factor) = (image.width as usize, factor as usize);
    let object = |x: usize, y: usize| {
        let at = y * width + x;
        coarse.mask[y / factor * coarse.width as usize + x / factor]
            && image.inside[at] >= WHOLE
            && image.mask.as_ref().is_none_or(|mask| mask[at] >= WHOLE)
    };
    let fine = Interior {
        width,
        inside: (0..image.inside.len())
            .map(|at| object(at % width, at / width))
            .collect(),
    };
    let (small, small_width) = (Small::of(image, &fine, factor), width / factor);
    (view.overexposed, view.underexposed) = clipped_shares(image, &fine);
    let luminance: Vec<f32> = image
        .rgb
        .chunks_exact(3)
        .map(|rgb| 0.3 * rgb[0] + 0.6 * rgb[1] + 0.1 * rgb[2])
        .collect();
    for sighting in &mut view.sightings {
        let point = &points[sighting.point as usize];
        let Some(projected) = view.camera.project(point.position) else {
            continue;
        };
        let place = projected.px / factor as f64 - 0.5;
        let (x, y) = (place.x.round() as usize, place.y.round() as usize);
        if small.interior.holds(x, y, 1) {
            let detail = detail_at(
                &luminance,
                &fine,
                projected.px.x as usize,
                projected.px.y as usize,
            );
            sighting.look = Some(small.at(place.x, place.y, small_width, detail));
        }
    }
}

/// The picture's means over `factor` x `factor` pixels, in linear light.
struct Small {
    linear: Vec<[f32; 3]>,
    clipped: Vec<[bool; 3]>,
    interior: Interior,
}

impl Small {
    fn of(image: &ViewImage, fine: &Interior, factor: usize) -> Self {
        let (width, height) = (
            image.width as usize / factor,
            image.height as usize / factor,
        );
        let mut small = Self {
            linear: vec![[0.0; 3]; width * height],
            clipped: vec![[false; 3]; width * height],
            interior: Interior {
                width,
                inside: vec![true; width * height],
            },
        };
        let share = 1.0 / (factor * factor) as f32;
        for y in 0..height * factor {
            for x in 0..width * factor {
                let (from, to) = (y * fine.width + x, y / factor * width + x / factor);
                small.interior.inside[to] &= fine.inside[from];
                for channel in 0..3 {
                    let value = image.rgb[from * 3 + channel];
                    small.linear[to][channel] += share * linear(value);
                    small.clipped[to][channel] |= value >= WHITE || value <= BLACK;
                }
            }
        }
        small
    }

    /// Bilinear; the pixels around are all interior.
    fn at(&self, x: f64, y: f64, width: usize, detail: Option<[f32; 4]>) -> Look {
        let (left, top) = (x.floor(), y.floor());
        let (right_share, lower_share) = ((x - left) as f32, (y - top) as f32);
        let corner = top as usize * width + left as usize;
        let mut look = Look {
            linear: [0.0; 3],
            clipped: [false; 3],
            detail,
        };
        for (at, weight) in [
            (corner, (1.0 - right_share) * (1.0 - lower_share)),
            (corner + 1, right_share * (1.0 - lower_share)),
            (corner + width, (1.0 - right_share) * lower_share),
            (corner + width + 1, right_share * lower_share),
        ] {
            for channel in 0..3 {
                look.linear[channel] += weight * self.linear[at][channel];
                look.clipped[channel] |= self.clipped[at][channel];
            }
        }
        look
    }
}

/// Shares of the object's pixels with a channel at the upper limit, and with all of them at the lower one.
fn clipped_shares(image: &ViewImage, fine: &Interior) -> (f64, f64) {
    let (mut white, mut black, mut all) = (0_usize, 0_usize, 0_usize);
    for (rgb, _) in image
        .rgb
        .chunks_exact(3)
        .zip(&fine.inside)
        .filter(|(_, inside)| **inside)
    {
        all += 1;
        white += usize::from(rgb.iter().any(|&value| value >= WHITE));
        black += usize::from(rgb.iter().all(|&value| value <= BLACK));
    }
    let share = |count: usize| count as f64 / all.max(1) as f64;
    (share(white), share(black))
}

fn detail_at(luminance: &[f32], fine: &Interior, x: usize, y: usize) -> Option<[f32; 4]> {
    if !fine.holds(x, y, DETAIL_REACH + 1) {
        return None;
    }
    let (mut sum, mut squares) = (0.0_f64, [0.0_f64; 4]);
    for row in y - DETAIL_REACH..=y + DETAIL_REACH {
        for column in x - DETAIL_REACH..=x + DETAIL_REACH {
            let at = row * fine.width + column;
            sum += f64::from(luminance[at]);
            for (square, (dx, dy)) in squares.iter_mut().zip(DIRECTIONS) {
                let offset = dy * fine.width as isize + dx;
                let (before, after) = (
                    at.wrapping_add_signed(-offset),
                    at.wrapping_add_signed(offset),
                );
                let bend = luminance[before] + luminance[after] - 2.0 * luminance[at];
                *square += f64::from(bend).powi(2);
            }
        }
    }
    let count = ((2 * DETAIL_REACH + 1) * (2 * DETAIL_REACH + 1)) as f64;
    let mean = sum / count;
    (mean > 0.0)
        .then(|| squares.map(|square| (square / count / (mean * mean) + DETAIL_FLOOR).ln() as f32))
}

/// sRGB to linear light.
fn linear(encoded: f32) -> f32 {
    if encoded <= 0.040_45 {
        encoded / 12.92
    } else {
        ((encoded + 0.055) / 1.055).powf(2.4)
    }
}
