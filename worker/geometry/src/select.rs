//! Choice of views by surface coverage (paper, Sec. "Coverage-based View Selection").
//!
//! Both choices are greedy over surface samples: [`select_references`] picks the fixed n reference views of a
//! capture, [`select_nearest`] the K views of them that a target view is made from.
//!
//! Deviation: the paper does not say what happens once everything is covered, which on a convex object is after a
//! handful of views. References then go on by closeness to all views, nearest views start a second layer of coverage.

use glam::{DVec3, Vec3};
use rayon::prelude::{
    IndexedParallelIterator, IntoParallelIterator, IntoParallelRefIterator, ParallelIterator,
};
use serde::{Deserialize, Serialize};
use std::borrow::Borrow;
use std::cmp::Ordering;
use std::collections::BTreeMap;
use std::ops::Range;

use crate::{GBuffer, WarpOptions};

/// Samples across a target view, and down (the paper's 64 x 64).
const TARGET_GRID: usize = 64;
/// Samples across a view, and down, when the surface is sampled from all views.
const VIEW_GRID: usize = 64;
/// Voxels across the surface: one sample is kept in each, so that what many views see does not count more.
const VOXELS: f64 = 48.0;
/// From this many to twice as many samples are kept of a capture's surface.
const SURFACE_SAMPLES: usize = 512;
/// At most this many views, evenly spread over all, stand for all targets and give the surface samples.
const TARGETS: usize = 128;
/// Gains evaluated at a time by the lazy choice, in parallel.
const BATCH: usize = 16;
/// Once no view adds more than this share of all samples, the object counts as covered: what is left are cracks, and
/// views chosen for them alone are bad neighbours of every target.
const COVERED_SHARE: f64 = 0.05;
/// Cost of a sample that no chosen reference sees: that of the opposite viewing direction.
const UNSEEN_COST: f32 = 2.0;
/// Two cameras nearer to each other than this share of their distance to the object are near-duplicates.
const DUPLICATE_SHARE: f64 = 0.01;
/// What a sample keeps of its weight when a view with the very same viewing ray has been chosen.
const RESIDUAL_FLOOR: f64 = 0.3;

/// How [`select_nearest`] counts a sample.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Nearest {
    /// The paper: 1 when the reference sees it and no chosen one does, else 0.
    #[default]
    Coverage,
    /// The cosine of the angle between the two viewing rays at the sample, times what earlier choices left of it.
    ///
    /// Deviation: counting alone prefers a frontal far view to a near one, whose highlights lie where the target has
    /// them. Measured as for [`select_references`], with its 20 references: 204 and 41, against 211 and 43 by counting.
    CoverageAngle,
}

/// A point on the surface.
#[derive(Clone, Copy)]
struct Sample {
    position: DVec3,
    normal: DVec3,
}

/// Surface points on a uniform grid of `grid` x `grid` over a view.
fn samples(view: &GBuffer, grid: usize) -> Vec<Sample> {
    let (width, height) = (view.width as usize, view.height as usize);
    let mut found = Vec::new();
    for row in 0..grid {
        for column in 0..grid {
            // Centre of the grid's cell, in whole pixels.
            let (x, y) = (
                (2 * column + 1) * width / (2 * grid),
                (2 * row + 1) * height / (2 * grid),
            );
            let index = y * width + x;
            if view.mask.get(index).is_some_and(|covered| *covered) {
                let position = Vec3::from(view.position[index]).as_dvec3();
                let normal = Vec3::from(view.normal[index]).as_dvec3();
                if position.is_finite() && normal.is_finite() {
                    found.push(Sample { position, normal });
                }
            }
        }
    }
    found
}

/// Spreads samples evenly over the surface that they lie on.
fn thinned(all: Vec<Sample>) -> Vec<Sample> {
    let Some(first) = all.first() else { return all };
    let (low, high) = all
        .iter()
        .fold((first.position, first.position), |(low, high), s| {
            (low.min(s.position), high.max(s.position))
        });
    let size = (high - low).max_element() / VOXELS;
    if size <= 0.0 {
        return vec![*first];
    }
    let mut voxels = BTreeMap::new();
    for sample in all {
        let voxel = ((sample.position - low) / size)
            .floor()
            .as_i64vec3()
            .to_array();
        // Both sides of a thin part are surfaces of their own.
        let side = sample.normal.to_array().map(|component| component > 0.0);
        voxels.entry((voxel, side)).or_insert(sample);
    }
    let stride = (voxels.len() / SURFACE_SAMPLES).max(1);
    voxels.into_values().step_by(stride).collect()
}

/// What the choice of references needs to know of the views: which surface samples each of them sees.
///
/// A view takes about 200 bytes, whatever its size: its G-buffer is reduced at once and dropped.
#[derive(Clone, Debug, Serialize)]
pub struct Candidates {
    /// Camera centre of each view.
    centers: Vec<DVec3>,
    /// Positions of the surface samples.
    samples: Vec<DVec3>,
    /// The samples that each view sees, one bit each: bit `sample % 64` of word `sample / 64`.
    seen: Vec<Vec<u64>>,
    /// Sum of the cosines to the normal over what each view sees.
    quality: Vec<f64>,
    /// The views that stand for all targets.
    targets: Vec<usize>,
    /// `[sample][target]`: cosine to the normal, 0 where the target does not see the sample.
    cosines: Vec<f32>,
}

impl Candidates {
    /// Reduces `count` views to what they see of the surface. `view` gives the G-buffer of a view by its index; it is
    /// asked twice for at most [`TARGETS`] of them, from several threads.
    pub fn new<V: Borrow<GBuffer>>(count: usize, view: impl Fn(usize) -> V + Sync) -> Self {
        let stride = count.div_ceil(TARGETS).max(1);
        let targets: Vec<usize> = (0..count).step_by(stride).collect();
        let surface = targets
            .par_iter()
            .flat_map_iter(|target| samples(view(*target).borrow(), VIEW_GRID));
        let samples = thinned(surface.collect());
        let options = WarpOptions::default();
        let signatures: Vec<Signature> = (0..count)
            .into_par_iter()
            .map(|index| {
                let buffer = view(index);
                let buffer = buffer.borrow();
                let cosines = samples.iter().map(|sample| {
                    let seen = buffer.sees(sample.position, sample.normal, &options);
                    seen.map_or(0.0, |seen| seen.cos as f32)
                });
                Signature::new(buffer, cosines.collect(), index % stride == 0)
            })
            .collect();
        let columns: Vec<&Vec<f32>> = signatures
            .iter()
            .filter_map(|s| s.cosines.as_ref())
            .collect();
        Self {
            centers: signatures.iter().map(|s| s.center).collect(),
            quality: signatures.iter().map(|s| s.quality).collect(),
            cosines: (0..samples.len())
                .flat_map(|sample| columns.iter().map(move |column| column[sample]))
                .collect(),
            seen: signatures.into_iter().map(|s| s.seen).collect(),
            samples: samples.iter().map(|sample| sample.position).collect(),
            targets,
        }
    }

    /// Chooses the reference views: `min(n, views)` indices, in the order of choice, without repeats.
    ///
    /// First the views that cover most samples that no chosen view covers, until what is left is little. Then, one by
    /// one, the view that most lowers the sum, over all views taken as targets and the samples they see, of the angle
    /// to the nearest reference's ray. Views whose camera stands where a chosen one's does come last.
    ///
    /// Deviation: the paper goes on by coverage alone. Measured with plain averaging of 4 views
    /// ([`Nearest::CoverageAngle`]) at 128 pixels, mean squared error inside the object, on two path-traced statues
    /// (glossy and matte, 120 training views): 20 references chosen so 204 and 41; coverage to the last sample and then
    /// whatever differs most from the chosen views 264 and 41; every sixth view along the camera path 217 and 42. With
    /// 8 references 328 and 66; 347 and 89; 354 and 76.
    pub fn choose(&self, n: usize) -> Vec<usize> {
        let samples = self.samples.len();
        let middle = self.samples.iter().sum::<DVec3>() / samples.max(1) as f64;
        let centers = &self.centers;
        let near_duplicate = |a: usize, b: usize| {
            let distance = centers[a].distance(middle).min(centers[b].distance(middle));
            centers[a].distance(centers[b]) <= DUPLICATE_SHARE * distance
        };
        let mut service = Service::new(self);
        let mut covered = vec![0_u64; samples.div_ceil(64)];
        let mut covering = true;
        let mut left: Vec<usize> = (0..centers.len()).collect();
        let mut chosen: Vec<usize> = Vec::new();
        // Gains of an earlier choice: they only fall, so they bound today's.
        let mut bounds = vec![f64::INFINITY; centers.len()];
        while chosen.len() < n && !left.is_empty() {
            let is_fresh = |view: &usize| !chosen.iter().any(|other| near_duplicate(*view, *other));
            let mut fresh: Vec<usize> = left.iter().copied().filter(is_fresh).collect();
            if fresh.is_empty() {
                fresh.clone_from(&left);
            }
            let mut pick = None;
            if covering {
                let count = |view: usize| {
                    let words = self.seen[view].iter().zip(&covered);
                    let count: u32 = words
                        .map(|(seen, covered)| (seen & !covered).count_ones())
                        .sum();
                    (f64::from(count), self.quality[view])
                };
                pick = best(&fresh, count)
                    .filter(|(_, (count, _))| *count > COVERED_SHARE * samples as f64);
                covering = pick.is_some();
            }
            let pick = pick.map(|(view, _)| view);
            let Some(pick) = pick.or_else(|| service.best(&mut fresh, &mut bounds)) else {
                break;
            };
            chosen.push(pick);
            left.retain(|view| *view != pick);
            for (covered, seen) in covered.iter_mut().zip(&self.seen[pick]) {
                *covered |= seen;
            }
            service.choose(pick);
        }
        chosen
    }
}

/// What is kept of one view's G-buffer.
struct Signature {
    center: DVec3,
    seen: Vec<u64>,
    quality: f64,
    /// Of targets alone.
    cosines: Option<Vec<f32>>,
}

impl Signature {
    fn new(view: &GBuffer, cosines: Vec<f32>, is_target: bool) -> Self {
        let mut seen = vec![0_u64; cosines.len().div_ceil(64)];
        for (sample, _) in cosines.iter().enumerate().filter(|(_, cos)| **cos > 0.0) {
            seen[sample / 64] |= 1 << (sample % 64);
        }
        Self {
            center: view.camera.center(),
            seen,
            quality: cosines.iter().map(|cos| f64::from(*cos)).sum(),
            cosines: is_target.then_some(cosines),
        }
    }
}

/// How well the chosen references serve every view that stands for the targets.
struct Service<'a> {
    views: &'a Candidates,
    /// `[sample][target]`: unit vector from the sample to the target's camera, by component.
    rays: [Vec<f32>; 3],
    /// `[sample][target]`: cost of the sample in that target, from the references chosen so far.
    costs: Vec<f32>,
}

impl<'a> Service<'a> {
    fn new(views: &'a Candidates) -> Self {
        let rays: Vec<Vec3> = (0..views.samples.len())
            .flat_map(|sample| {
                views
                    .targets
                    .iter()
                    .map(move |target| ray(views, *target, sample))
            })
            .collect();
        Self {
            views,
            costs: vec![UNSEEN_COST; rays.len()],
            rays: [0, 1, 2].map(|axis| rays.iter().map(|ray| ray[axis]).collect()),
        }
    }

    /// Calls `each(entries, chords)` for each sample that `view` sees, with the sample's entries in tables of
    /// `[sample][target]`, and the chords between the rays of `view` and of the targets: the cost of taking the sample
    /// from `view`.
    fn for_each_seen(&self, view: usize, mut each: impl FnMut(Range<usize>, &[f32])) {
        let targets = self.views.targets.len();
        let mut chords = vec![0.0_f32; targets];
        for (word, bits) in self.views.seen[view].iter().enumerate() {
            let mut bits = *bits;
            while bits != 0 {
                let sample = word * 64 + bits.trailing_zeros() as usize;
                bits &= bits - 1;
                let ray = ray(self.views, view, sample);
                let entries = sample * targets..(sample + 1) * targets;
                let [x, y, z] = self.rays.each_ref().map(|axis| &axis[entries.clone()]);
                for (chord, ((x, y), z)) in chords.iter_mut().zip(x.iter().zip(y).zip(z)) {
                    let (x, y, z) = (ray.x - x, ray.y - y, ray.z - z);
                    *chord = (x * x + y * y + z * z).sqrt();
                }
                each(entries, &chords);
            }
        }
    }

    /// How much one more reference would lower the costs, weighted by how large a sample appears in the target.
    fn gain(&self, view: usize) -> f64 {
        let mut sums = vec![0.0_f64; self.views.targets.len()];
        self.for_each_seen(view, |entries, chords| {
            let tables = self.costs[entries.clone()]
                .iter()
                .zip(&self.views.cosines[entries]);
            for ((sum, chord), (cost, cos)) in sums.iter_mut().zip(chords).zip(tables) {
                *sum += f64::from(cos * (cost - chord).max(0.0));
            }
        });
        sums.iter().sum()
    }

    /// The view of `fresh` with the largest gain, as [`best`] would find it.
    ///
    /// Lazy greedy (Minoux 1978): costs only fall, and so does every term of a gain and every rounded sum of terms;
    /// the gain that a view had is a bound of what it has. Views are evaluated by falling bounds until none that is
    /// left could win.
    fn best(&self, fresh: &mut [usize], bounds: &mut [f64]) -> Option<usize> {
        let quality = &self.views.quality;
        let rank = |a: (f64, usize), b: (f64, usize)| {
            let quality = |view: usize| quality[view];
            b.0.total_cmp(&a.0)
                .then(quality(b.1).total_cmp(&quality(a.1)))
                .then(a.1.cmp(&b.1))
        };
        fresh.sort_unstable_by(|a, b| rank((bounds[*a], *a), (bounds[*b], *b)));
        let mut best: Option<(f64, usize)> = None;
        for batch in fresh.chunks(BATCH) {
            let next = (bounds[batch[0]], batch[0]);
            if best.is_some_and(|best| rank(best, next) == Ordering::Less) {
                break;
            }
            let gains: Vec<f64> = batch.par_iter().map(|view| self.gain(*view)).collect();
            for (&view, &gain) in batch.iter().zip(&gains) {
                bounds[view] = gain;
                if best.is_none_or(|best| rank((gain, view), best) == Ordering::Less) {
                    best = Some((gain, view));
                }
            }
        }
        best.map(|(_, view)| view)
    }

    fn choose(&mut self, view: usize) {
        let mut costs = std::mem::take(&mut self.costs);
        self.for_each_seen(view, |entries, chords| {
            for (cost, chord) in costs[entries].iter_mut().zip(chords) {
                *cost = cost.min(*chord);
            }
        });
        self.costs = costs;
    }
}

/// Unit vector from a sample to a view's camera.
fn ray(views: &Candidates, view: usize, sample: usize) -> Vec3 {
    let ray = views.centers[view] - views.samples[sample];
    ray.normalize_or_zero().as_vec3()
}

/// [`Candidates::choose`] among views whose G-buffers are at hand.
pub fn select_references(views: &[GBuffer], n: usize) -> Vec<usize> {
    Candidates::new(views.len(), |view| &views[view]).choose(n)
}

/// Chooses the `min(k, references.len())` references that a target view is best made from, in the order of choice,
/// without repeats. A reference that stands where a chosen one does is taken only when no other is left. Which ones are
/// chosen does not depend on the order of the references.
pub fn select_nearest(
    target: &GBuffer,
    references: &[GBuffer],
    k: usize,
    mode: Nearest,
) -> Vec<usize> {
    let samples = samples(target, TARGET_GRID);
    let options = WarpOptions::default();
    let eye = target.camera.center();
    let centers: Vec<DVec3> = references.iter().map(|view| view.camera.center()).collect();
    // weights[reference][sample]: cosine between the two viewing rays, 0 where the reference does not see it.
    let weights: Vec<Vec<f32>> = references
        .par_iter()
        .zip(&centers)
        .map(|(view, center)| {
            let weight = |sample: &Sample| {
                let seen = view.sees(sample.position, sample.normal, &options);
                seen.map_or(0.0, |_| {
                    ray_cosine(sample.position, *center, eye).max(1e-6) as f32
                })
            };
            samples.iter().map(weight).collect()
        })
        .collect();
    let middle =
        samples.iter().map(|sample| sample.position).sum::<DVec3>() / samples.len().max(1) as f64;
    let near_duplicate = |a: usize, b: usize| {
        let distance = centers[a].distance(middle).min(centers[b].distance(middle));
        centers[a].distance(centers[b]) <= DUPLICATE_SHARE * distance
    };

    let mut residual = vec![1.0_f64; samples.len()];
    // Of equals the first is chosen: the first by place, not by the caller's order.
    let mut left: Vec<usize> = (0..references.len()).collect();
    left.sort_by(|a, b| {
        let (a, b) = (centers[*a], centers[*b]);
        (a.x.total_cmp(&b.x))
            .then(a.y.total_cmp(&b.y))
            .then(a.z.total_cmp(&b.z))
    });
    let mut chosen: Vec<usize> = Vec::new();
    while chosen.len() < k && !left.is_empty() {
        let mut fresh: Vec<usize> = left
            .iter()
            .copied()
            .filter(|view| !chosen.iter().any(|other| near_duplicate(*view, *other)))
            .collect();
        if fresh.is_empty() {
            fresh.clone_from(&left);
        }
        // Equal gains (above all: no gain) go to the camera nearest to the target's.
        let gain = |view: usize, residual: &[f64]| {
            let pairs = weights[view]
                .iter()
                .zip(residual)
                .filter(|(weight, _)| **weight > 0.0);
            let gain = match mode {
                Nearest::Coverage => pairs.map(|(_, residual)| *residual).sum::<f64>(),
                Nearest::CoverageAngle => pairs
                    .map(|(weight, residual)| f64::from(*weight) * residual)
                    .sum(),
            };
            (gain, -centers[view].distance(eye))
        };
        let mut pick = best(&fresh, |view| gain(view, &residual));
        if pick.is_some_and(|(_, (gain, _))| gain <= 0.0) {
            residual.fill(1.0);
            pick = best(&fresh, |view| gain(view, &residual));
        }
        let Some((pick, _)) = pick else { break };
        chosen.push(pick);
        left.retain(|view| *view != pick);
        for (residual, weight) in residual
            .iter_mut()
            .zip(&weights[pick])
            .filter(|(_, weight)| **weight > 0.0)
        {
            match mode {
                Nearest::Coverage => *residual = 0.0,
                Nearest::CoverageAngle => {
                    *residual *= (1.0 - f64::from(*weight)).max(RESIDUAL_FLOOR);
                }
            }
        }
    }
    chosen
}

/// Cosine of the angle under which two cameras are seen from a point; 0 when one of them lies in it.
fn ray_cosine(point: DVec3, a: DVec3, b: DVec3) -> f64 {
    (a - point)
        .normalize_or_zero()
        .dot((b - point).normalize_or_zero())
        .clamp(-1.0, 1.0)
}

/// The candidate with the largest gain (first number, then second), the earliest of equals.
fn best(
    candidates: &[usize],
    gain: impl Fn(usize) -> (f64, f64) + Sync,
) -> Option<(usize, (f64, f64))> {
    let scored: Vec<_> = candidates
        .par_iter()
        .map(|view| (*view, gain(*view)))
        .collect();
    scored.into_iter().reduce(|best, next| {
        let order = next
            .1
            .0
            .total_cmp(&best.1.0)
            .then(next.1.1.total_cmp(&best.1.1));
        if order == Ordering::Greater {
            next
        } else {
            best
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::{Strategy, any, prop_assert_eq, proptest};

    const SAMPLES: usize = 70;

    /// Views on a coarse lattice, so that many coincide, and any visibility.
    fn candidates() -> impl Strategy<Value = Candidates> {
        let view = (proptest::array::uniform3(-2_i8..3), any::<[u64; 2]>());
        proptest::collection::vec(view, 1..40).prop_map(|views| {
            let targets: Vec<usize> = (0..views.len()).step_by(3).collect();
            let seen: Vec<Vec<u64>> = views
                .iter()
                .map(|(_, bits)| vec![bits[0], bits[1] & ((1 << (SAMPLES - 64)) - 1)])
                .collect();
            let sees = |view: usize, sample: usize| seen[view][sample / 64] >> (sample % 64) & 1;
            let cosine = |view: usize, sample: usize| {
                sees(view, sample) as f32 * (1.0 + (sample % 7) as f32) / 8.0
            };
            Candidates {
                centers: views
                    .iter()
                    .map(|(at, _)| DVec3::from_array(at.map(f64::from)) * 2.0 + 0.3)
                    .collect(),
                samples: (0..SAMPLES)
                    .map(|at| {
                        DVec3::new((at % 4) as f64, (at / 4 % 4) as f64, (at / 16) as f64) * 0.2
                    })
                    .collect(),
                quality: (0..views.len()).map(|view| (view % 4) as f64).collect(),
                cosines: (0..SAMPLES)
                    .flat_map(|sample| targets.iter().map(move |target| cosine(*target, sample)))
                    .collect(),
                targets,
                seen,
            }
        })
    }

    /// Every gain of every view, anew for every choice.
    fn plain(views: &Candidates, n: usize) -> Vec<usize> {
        let sees =
            |view: usize, sample: usize| views.seen[view][sample / 64] >> (sample % 64) & 1 == 1;
        let chord = |a: usize, b: usize, sample: usize| {
            ray(views, a, sample).distance(ray(views, b, sample))
        };
        let middle = views.samples.iter().sum::<DVec3>() / SAMPLES as f64;
        let mut chosen: Vec<usize> = Vec::new();
        let mut covering = true;
        while chosen.len() < n.min(views.centers.len()) {
            let same = |a: usize, b: usize| {
                let [a, b] = [views.centers[a], views.centers[b]];
                a.distance(b) <= DUPLICATE_SHARE * a.distance(middle).min(b.distance(middle))
            };
            let left: Vec<usize> = (0..views.centers.len())
                .filter(|v| !chosen.contains(v))
                .collect();
            let mut fresh = left.clone();
            fresh.retain(|view| !chosen.iter().any(|other| same(*view, *other)));
            if fresh.is_empty() {
                fresh = left;
            }
            let covers = |view: usize| {
                let open = |sample: &usize| {
                    sees(view, *sample) && !chosen.iter().any(|other| sees(*other, *sample))
                };
                (0..SAMPLES).filter(open).count() as f64
            };
            let gain = |view: usize| {
                let on_target = |(at, target): (usize, &usize)| {
                    let saved = |sample: usize| {
                        let cost = chosen
                            .iter()
                            .filter(|other| sees(**other, sample))
                            .map(|other| chord(*other, *target, sample))
                            .fold(UNSEEN_COST, f32::min);
                        let cos = views.cosines[sample * views.targets.len() + at];
                        f64::from(cos * (cost - chord(view, *target, sample)).max(0.0))
                    };
                    (0..SAMPLES)
                        .filter(|sample| sees(view, *sample))
                        .map(saved)
                        .sum::<f64>()
                };
                views.targets.iter().enumerate().map(on_target).sum::<f64>()
            };
            let first = |score: &dyn Fn(usize) -> f64| {
                let scores = fresh
                    .iter()
                    .map(|view| (score(*view), views.quality[*view], *view));
                scores
                    .reduce(|a, b| if (b.0, b.1) > (a.0, a.1) { b } else { a })
                    .expect("a view")
            };
            let by_cover = first(&covers);
            covering &= by_cover.0 > COVERED_SHARE * SAMPLES as f64;
            chosen.push(if covering { by_cover.2 } else { first(&gain).2 });
        }
        chosen
    }

    proptest! {
        #[test]
        fn lazy_choices_are_the_plain_ones(views in candidates(), n in 0_usize..40) {
            prop_assert_eq!(views.choose(n), plain(&views, n));
        }
    }
}
