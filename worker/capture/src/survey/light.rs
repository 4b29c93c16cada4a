//! Light that moves with the object.
//!
//! An object on a turntable under fixed lamps, or lit by a lamp on the camera, breaks the assumption that the light is
//! constant: seen from the object, the light goes round with the camera. Then the brightness of a surface point depends
//! on how its normal lies in *camera* axes. So two models of the logarithm of the light at well-seen points are
//! compared,
//!
//! ```text
//! a(point) + g(view) + h(z)     and     a(point) + g(view) + f(x, y, z),      (x, y, z) the normal in camera axes,
//! ```
//!
//! `f` a polynomial of second order (as good as exact for matte surfaces under distant light: Ramamoorthi and Hanrahan
//! 2001), `h` its terms in z alone: rough gloss and Fresnel's law make a surface's brightness depend on the viewing
//! angle under any light. Under constant light `f` says no more than `h`, because what the light does at a point is in
//! `a` already. Fitted on one half of the surface, judged on the other, both ways.
//!
//! Measured (share explained beyond `h`): a bronze axe turned in a light tent 0.27; photographs of a plaster head 0.013;
//! path-traced under constant light, nearly matte bust 0.012, glossy vase 0.018.

use super::within::{Datum, Effects};
use super::{Survey, cross_validated};

/// Terms of `f`, and how many of them, the last ones, are those of `h`.
const TERMS: usize = 8;
const ANGLE_TERMS: usize = 2;
/// Least cosine of the viewing angle.
const LEAST_COS: f32 = 0.35;
/// Linear light, summed over channels, below which rounding to 8 bits and stray light decide.
const DARK: f32 = 0.01;
/// Share of the variance between photographs that `f` must explain on points it was not fitted to.
const LEAST_EXPLAINED: f64 = 0.1;
/// Observations below which nothing is said.
const FEWEST_DATA: usize = 200;

/// Whether the light moves with the object.
#[derive(Debug)]
pub(crate) struct MovingLight {
    /// Share of the differences between photographs that the normal in camera axes explains beyond the viewing angle; 0
    /// where it explains nothing, `None` where there is too little to compare.
    pub(crate) explained: Option<f64>,
    pub(crate) detected: bool,
}

impl MovingLight {
    pub(crate) fn unknown() -> Self {
        Self {
            explained: None,
            detected: false,
        }
    }

    pub(crate) fn of(survey: &Survey) -> Self {
        let data = survey.shading();
        if data.len() < FEWEST_DATA {
            return Self::unknown();
        }
        let by_angle: Vec<Datum<ANGLE_TERMS>> = data
            .iter()
            .map(|datum| Datum {
                point: datum.point,
                view: datum.view,
                value: datum.value,
                features: [datum.features[TERMS - 2], datum.features[TERMS - 1]],
            })
            .collect();
        let count = survey.views.len();
        let constant = cross_validated(survey, &by_angle, |data| Effects::fit(data, count));
        let moving = cross_validated(survey, &data, |data| Effects::fit(data, count));
        let explained = super::explained(&constant, &moving);
        Self {
            explained: Some(explained),
            detected: explained >= LEAST_EXPLAINED,
        }
    }
}

impl Survey {
    /// Logarithm of the light at well-seen points, with the terms of `f`.
    fn shading(&self) -> Vec<Datum<TERMS>> {
        self.data(|view, sighting| {
            let look = sighting.look?;
            let light: f32 = look.linear.iter().sum();
            let usable = sighting.cos >= LEAST_COS && !look.clipped.contains(&true) && light > DARK;
            let normal =
                view.camera.camera_from_world.matrix3 * self.points[sighting.point as usize].normal;
            let (x, y, z) = (normal.x, normal.y, normal.z);
            let features = [x, y, x * y, x * z, y * z, x * x - y * y, z, z * z];
            usable.then(|| (f64::from(light).ln(), features))
        })
    }
}
