//! Choice of views by surface coverage (paper, Sec. "Coverage-based View Selection").
//!
//! Both choices are greedy over surface samples: [`select_references`] picks the fixed n reference views of a
//! capture, [`select_nearest`] the K views of them that a target view is made from.
//!
//! Deviation: the paper does not say what happens once everything is covered, which on a convex object is after a
//! handful of views. References then go on by diversity and quality, nearest views start a second layer of coverage.

use glam::{DVec3, Vec3};
use rayon::prelude::{
    IndexedParallelIterator, IntoParallelIterator, IntoParallelRefIterator, ParallelIterator,
};
use serde::{Deserialize, Serialize};
use std::cmp::Ordering;
use std::collections::BTreeMap;

use crate::{GBuffer, WarpOptions};

/// Samples across a target view, and down (the paper's 64 x 64).
const TARGET_GRID: usize = 64;
/// Samples across a view, and down, when the surface is sampled from all views.
const VIEW_GRID: usize = 64;
/// Voxels across the surface: one sample is kept in each, so that what many views see does not count more.
const VOXELS: f64 = 48.0;
/// Gains below this share of all samples are noise of the sampling: the object then counts as covered.
const COVERED_SHARE: f64 = 0.002;
/// Two cameras nearer to each other than this share of their distance to the object are near-duplicates.
const DUPLICATE_SHARE: f64 = 0.01;
/// What a sample keeps of its weight when a view with the very same viewing ray has been chosen.
const RESIDUAL_FLOOR: f64 = 0.1;

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
    /// them.
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

/// Samples of the surface that any of the views sees, spread evenly over it.
fn surface_samples(views: &[GBuffer]) -> Vec<Sample> {
    let all: Vec<Sample> = views
        .par_iter()
        .flat_map_iter(|view| samples(view, VIEW_GRID))
        .collect();
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
    voxels.into_values().collect()
}

/// Chooses the reference views: `min(n, views.len())` indices, in the order of choice, without repeats.
///
/// First the views that cover most samples that no chosen view covers, until what is left is noise. Then, one by one,
/// the view that sees the surface best from the newest direction: the sum over its samples of the cosine to the
/// normal times (1 - cosine of the angle to the nearest chosen view's ray). Near-duplicates of chosen views come last.
pub fn select_references(views: &[GBuffer], n: usize) -> Vec<usize> {
    let samples = surface_samples(views);
    let options = WarpOptions::default();
    // cosines[view][sample]: cosine to the normal, 0 where the view does not see the sample.
    let cosines: Vec<Vec<f32>> = views
        .par_iter()
        .map(|view| {
            let cosine = |s: &Sample| {
                view.sees(s.position, s.normal, &options)
                    .map_or(0.0, |seen| seen.cos as f32)
            };
            samples.iter().map(cosine).collect()
        })
        .collect();
    let centers: Vec<DVec3> = views.iter().map(|view| view.camera.center()).collect();
    let middle =
        samples.iter().map(|sample| sample.position).sum::<DVec3>() / samples.len().max(1) as f64;
    let near_duplicate = |a: usize, b: usize| {
        let distance = centers[a].distance(middle).min(centers[b].distance(middle));
        centers[a].distance(centers[b]) <= DUPLICATE_SHARE * distance
    };

    let noise = COVERED_SHARE * samples.len() as f64;
    let mut uncovered = vec![true; samples.len()];
    // Largest cosine between a view's ray and those of the chosen views that see the sample.
    let mut nearest_ray = vec![vec![0.0_f32; samples.len()]; views.len()];
    let mut covering = true;
    let mut left: Vec<usize> = (0..views.len()).collect();
    let mut chosen: Vec<usize> = Vec::new();
    while chosen.len() < n && !left.is_empty() {
        let mut fresh: Vec<usize> = left
            .iter()
            .copied()
            .filter(|view| !chosen.iter().any(|other| near_duplicate(*view, *other)))
            .collect();
        if fresh.is_empty() {
            fresh.clone_from(&left);
        }
        let quality =
            |view: usize| -> f64 { cosines[view].iter().map(|cos| f64::from(*cos)).sum() };
        let mut pick = None;
        if covering {
            let gain = |view: usize| {
                let count = cosines[view]
                    .iter()
                    .zip(&uncovered)
                    .filter(|(cos, left)| **cos > 0.0 && **left)
                    .count();
                (count as f64, quality(view))
            };
            pick = best(&fresh, gain)
                .filter(|(_, (count, _))| *count > noise)
                .map(|(view, _)| view);
            covering = pick.is_some();
        }
        let pick = pick.or_else(|| {
            let gain = |view: usize| {
                let new = |(cos, near): (&f32, &f32)| f64::from(cos * (1.0 - near));
                (
                    cosines[view].iter().zip(&nearest_ray[view]).map(new).sum(),
                    quality(view),
                )
            };
            best(&fresh, gain).map(|(view, _)| view)
        });
        let Some(pick) = pick else { break };
        chosen.push(pick);
        left.retain(|view| *view != pick);
        for (uncovered, cos) in uncovered.iter_mut().zip(&cosines[pick]) {
            *uncovered &= *cos <= 0.0;
        }
        nearest_ray = (0..views.len())
            .into_par_iter()
            .map(|view| {
                let old = &nearest_ray[view];
                let update = |index: usize| {
                    if cosines[view][index] <= 0.0 || cosines[pick][index] <= 0.0 {
                        return old[index];
                    }
                    old[index].max(
                        ray_cosine(samples[index].position, centers[view], centers[pick]) as f32,
                    )
                };
                (0..samples.len()).map(update).collect()
            })
            .collect();
    }
    chosen
}

/// Chooses the `min(k, references.len())` references that a target view is best made from, in the order of choice,
/// without repeats. A reference with the pose of a chosen one is taken only when no other is left.
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
    let same_pose = |a: usize, b: usize| {
        references[a].camera.camera_from_world == references[b].camera.camera_from_world
    };

    let mut residual = vec![1.0_f64; samples.len()];
    let mut left: Vec<usize> = (0..references.len()).collect();
    let mut chosen: Vec<usize> = Vec::new();
    while chosen.len() < k && !left.is_empty() {
        let mut fresh: Vec<usize> = left
            .iter()
            .copied()
            .filter(|view| !chosen.iter().any(|other| same_pose(*view, *other)))
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
fn best(candidates: &[usize], gain: impl Fn(usize) -> (f64, f64)) -> Option<(usize, (f64, f64))> {
    let scored = candidates.iter().map(|view| (*view, gain(*view)));
    scored.reduce(|best, next| {
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
