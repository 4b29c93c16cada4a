//! Sharpness of the photographs, relative to each other.
//!
//! A measure of one picture alone confuses a blurred photograph with a smooth object. Here the same surface points are
//! compared: the detail around a point is what the surface has there times what the photograph keeps of it. Detail is
//! measured in four directions, and the worst one counts: motion blurs along its path only. Photographs from so far away
//! that they have fewer pixels on the object than most are not judged.

use super::Survey;
use super::look::DIRECTIONS;
use super::within::{Datum, Effects, MAD_TO_SIGMA, median};

/// Least cosine of the viewing angle: oblique surfaces show their detail foreshortened.
const LEAST_COS: f32 = 0.5;
/// A view with fewer points that are looked at is not judged.
const FEWEST_DATA: usize = 12;
/// A view is blurred when it keeps less than this share of the detail's amplitude, ...
const BLURRED: f64 = 0.6;
/// ... and lies this many robust standard deviations of all views below their median.
const OUTLIER: f64 = 3.5;

/// How sharp each view is.
#[derive(Debug)]
pub(crate) struct Sharpness {
    /// Share of the usual detail's amplitude that the view keeps in its worst direction; the median view has 1.
    /// `None` where too little of the surface is seen, or at a lower resolution than by most.
    pub(crate) per_view: Vec<Option<f64>>,
    /// Views that are blurred, ascending.
    pub(crate) blurred: Vec<usize>,
}

impl Sharpness {
    pub(crate) fn of(survey: &Survey) -> Self {
        let count = survey.views.len();
        let mut data_of_view = vec![0_usize; count];
        let mut worst = vec![f64::INFINITY; count];
        for direction in 0..DIRECTIONS.len() {
            let data: Vec<Datum<0>> = survey.data(|view, sighting| {
                if !view.is_native {
                    return None;
                }
                let detail = sighting.look.and_then(|look| look.detail)?;
                (sighting.cos >= LEAST_COS).then(|| (f64::from(detail[direction]), []))
            });
            let effects = Effects::fit(&data, count);
            for (worst, effect) in worst.iter_mut().zip(&effects.views) {
                *worst = worst.min(*effect);
            }
            if direction == 0 {
                for datum in &data {
                    data_of_view[datum.view as usize] += 1;
                }
            }
        }
        let judged: Vec<Option<f64>> = worst
            .into_iter()
            .zip(data_of_view)
            .map(|(effect, data)| (data >= FEWEST_DATA).then_some(effect))
            .collect();
        let known: Vec<f64> = judged.iter().copied().flatten().collect();
        let usual = median(known.clone());
        let spread =
            MAD_TO_SIGMA * median(known.iter().map(|effect| (effect - usual).abs()).collect());
        let blurred =
            |effect: f64| amplitude(effect - usual) < BLURRED && effect < usual - OUTLIER * spread;
        Self {
            blurred: (0..count)
                .filter(|&view| judged[view].is_some_and(blurred))
                .collect(),
            per_view: judged
                .into_iter()
                .map(|effect| effect.map(|effect| amplitude(effect - usual)))
                .collect(),
        }
    }
}

/// From the logarithm of a mean square to the factor of an amplitude.
fn amplitude(log_square: f64) -> f64 {
    (log_square / 2.0).exp()
}
