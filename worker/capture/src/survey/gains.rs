//! Exposure and white balance of the photographs, from well-seen surface points.
//!
//! Photographs of one point under constant light differ by their exposure; in linear light that is a factor per channel.
//! `log light = a(point) + g(view) + h(viewing angle)`, robustly, without clipped, dark and grazing samples, gives each
//! view's factor; `h`, a parabola in the cosine, takes what gloss adds towards grazing angles, of which a view from above
//! sees less than one from the side.
//! Whether equalising helps is decided on points that had no part in the fit: highlights and misregistration also make
//! photographs differ, but not by one factor all over. Where the light moves with the object, exposure and light cannot
//! be told apart along a path of views that overlap with their neighbours only: nothing is equalised then.
//!
//! Measured (share of the variance taken away on the other half of the surface): photographs of a plaster head 0.69;
//! path-traced at one exposure, nearly matte bust 0.09, glossy vase 0.05.

use super::within::{Datum, Effects, median};
use super::{Survey, cross_validated, explained};
use crate::scene::Scene;

/// Terms of `h`.
const ANGLE_TERMS: usize = 2;
/// Least cosine of the viewing angle.
const LEAST_COS: f32 = 0.45;
/// Median of a point's linear light below which rounding to 8 bits and stray light decide.
const DARK: f64 = 0.006;
/// Share of the variance between photographs that the gains must take away on points they were not fitted to.
const LEAST_EXPLAINED: f64 = 0.15;
/// Spread of the gains, in natural logarithms, below which there is nothing to equalise.
const LEAST_SPREAD: f64 = 0.01;
/// Largest gain, and the inverse of the smallest, relative to the canonical exposure.
const LARGEST: f64 = 4.0;
/// Observations of a view below which its gain is left at the usual one.
const FEWEST_DATA: usize = 12;
/// Share of what is seen that stays below white in the canonical exposure.
const BELOW_WHITE: f64 = 0.995;

/// A factor per view and channel that takes a photograph, in linear light, to the capture's canonical exposure: that of
/// the geometric mean of its training views, lowered so far that hardly anything is pushed beyond white.
#[derive(Debug, Clone, PartialEq)]
pub struct Gains {
    /// Per view of the scene, per channel; all 1 where equalising does not help.
    pub per_view: Vec<[f64; 3]>,
    /// Whether equalising helps.
    pub needed: bool,
    /// Share of the variance between photographs, at points that had no part in the fit, that the gains take away;
    /// 0 where they take nothing away.
    pub explained: f64,
    /// As estimated, relative to their geometric mean, whether they are needed or not.
    pub(crate) estimated: Vec<[f64; 3]>,
}

impl Gains {
    /// Gains of 1: every photograph as it is.
    pub fn none(views: usize) -> Self {
        Self {
            per_view: vec![[1.0; 3]; views],
            needed: false,
            explained: 0.0,
            estimated: vec![[1.0; 3]; views],
        }
    }

    /// Estimates the gains of all views. Training views alone decide; those of held-out views follow from their own
    /// photographs and the surface's colours as the training views saw them.
    pub fn estimate(scene: &Scene, survey: &Survey) -> Self {
        let count = survey.views.len();
        let mut gains = Self::none(count);
        if survey.light.detected {
            return gains;
        }
        let mut trains = vec![false; count];
        for &view in &scene.train {
            trains[view] = true;
        }
        let (mut shares, mut found) = (Vec::new(), vec![[None; 3]; count]);
        for channel in 0..3 {
            let all = survey.channel(channel);
            let train: Vec<Datum<ANGLE_TERMS>> = all
                .iter()
                .filter(|datum| trains[datum.view as usize])
                .copied()
                .collect();
            if train.len() < FEWEST_DATA {
                return gains;
            }
            let plain = cross_validated(survey, &train, |data| Effects::fit_features(data, count));
            let equal = cross_validated(survey, &train, |data| Effects::fit(data, count));
            shares.push(explained(&plain, &equal));
            let effects = with_held_out(&Effects::fit(&train, count), &all, &trains);
            let usual = mean(scene.train.iter().filter_map(|&view| effects[view]));
            for (found, effect) in found.iter_mut().zip(effects) {
                found[channel] = effect.map(|effect| usual - effect);
            }
        }
        let logs: Vec<[f64; 3]> = found.iter().map(whole).collect();
        let bound = LARGEST.ln();
        gains.estimated = logs
            .iter()
            .map(|log| log.map(|log| log.clamp(-bound, bound).exp()))
            .collect();
        gains.explained = mean(shares.into_iter());
        let spread = median(
            scene
                .train
                .iter()
                .map(|&view| {
                    logs[view]
                        .iter()
                        .fold(0.0, |most: f64, log| most.max(log.abs()))
                })
                .collect(),
        );
        gains.needed = gains.explained >= LEAST_EXPLAINED && spread >= LEAST_SPREAD;
        if gains.needed {
            let headroom = survey.headroom(&gains.estimated);
            gains.per_view = gains
                .estimated
                .iter()
                .map(|gain| gain.map(|gain| gain * headroom))
                .collect();
        }
        gains
    }
}

/// A channel of which too little is seen, because it is clipped, gets the mean of the others: left at the usual exposure it
/// would tint the photograph.
fn whole(found: &[Option<f64>; 3]) -> [f64; 3] {
    let others = mean(found.iter().flatten().copied());
    found.map(|log| log.unwrap_or(others))
}

fn mean(values: impl Iterator<Item = f64>) -> f64 {
    let (sum, count) = values.fold((0.0, 0_usize), |(sum, count), value| {
        (sum + value, count + 1)
    });
    sum / count.max(1) as f64
}

/// Effects of all views that see enough: the fitted ones, and for the others the median difference from the surface
/// as the fitted ones saw it.
fn with_held_out(
    fitted: &Effects<ANGLE_TERMS>,
    all: &[Datum<ANGLE_TERMS>],
    trains: &[bool],
) -> Vec<Option<f64>> {
    let mut differences: Vec<Vec<f64>> = vec![Vec::new(); trains.len()];
    for group in all.chunk_by(|a, b| a.point == b.point) {
        let seen: Vec<f64> = group
            .iter()
            .filter(|datum| trains[datum.view as usize])
            .map(|datum| datum.value - fitted.of(datum))
            .collect();
        if seen.is_empty() {
            continue;
        }
        let usual = median(seen);
        for datum in group {
            // A held-out view's own effect is 0 in the fit.
            differences[datum.view as usize].push(datum.value - fitted.of(datum) - usual);
        }
    }
    differences
        .into_iter()
        .enumerate()
        .map(|(view, differences)| {
            (differences.len() >= FEWEST_DATA).then(|| {
                if trains[view] {
                    fitted.views[view]
                } else {
                    median(differences)
                }
            })
        })
        .collect()
}

impl Survey {
    /// Logarithm of a channel's linear light at well-seen points.
    fn channel(&self, channel: usize) -> Vec<Datum<ANGLE_TERMS>> {
        let data = self.data(|_, sighting| {
            let look = sighting.look?;
            let (light, cos) = (f64::from(look.linear[channel]), f64::from(sighting.cos));
            let usable = sighting.cos >= LEAST_COS && !look.clipped[channel] && light > 0.0;
            usable.then(|| (light.ln(), [cos, cos * cos]))
        });
        // Points are dark, not samples: to drop a point's darker half would make its darker views look bright.
        data.chunk_by(|a, b| a.point == b.point)
            .filter(|group| median(group.iter().map(|datum| datum.value).collect()) > DARK.ln())
            .flatten()
            .copied()
            .collect()
    }

    /// Factor, at most 1, under which nearly all of what is seen stays below white after the gains.
    fn headroom(&self, gains: &[[f64; 3]]) -> f64 {
        let mut seen: Vec<f64> = self
            .views
            .iter()
            .zip(gains)
            .flat_map(|(view, gain)| {
                view.sightings
                    .iter()
                    .filter_map(|sighting| sighting.look)
                    .map(|look| {
                        let light =
                            |channel: usize| f64::from(look.linear[channel]) * gain[channel];
                        light(0).max(light(1)).max(light(2))
                    })
            })
            .collect();
        if seen.is_empty() {
            return 1.0;
        }
        let place = ((seen.len() - 1) as f64 * BELOW_WHITE) as usize;
        let (_, top, _) = seen.select_nth_unstable_by(place, f64::total_cmp);
        (1.0 / top.max(f64::MIN_POSITIVE)).min(1.0)
    }
}
