//! Where the cameras stand: angles between neighbours, distances from the object.

use glam::DVec3;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::fault::Faults;
use crate::scene::Scene;
use crate::survey::{Survey, median};

/// Median angle to the nearest view, in degrees, above which views are far apart.
const FAR_APART: f64 = 25.0;
/// Angle from any other view, in degrees, from which a view stands alone.
const ALONE: f64 = 40.0;
/// Angle between the outermost views, in degrees, below which all look from one side.
const ONE_SIDED: f64 = 45.0;
/// Angle, in degrees, and share of the distance within which two views are the same.
const SAME: (f64, f64) = (0.05, 1e-3);
/// Ratio of the largest to the smallest distance above which sharpness differs much between views.
const UNEVEN: f64 = 4.0;

/// Angles between the views' directions at the object's centre, in degrees, and distances from there in radii of the
/// object's bounding sphere. Over training views.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Baselines {
    /// Median angle from a view to its nearest one; 0 with a single view.
    pub nearest_degrees_median: f64,
    /// Largest such angle.
    pub nearest_degrees_most: f64,
    /// Angle between the two views that are farthest apart.
    pub widest_degrees: f64,
    /// Smallest distance.
    pub distance_least: f64,
    /// Median distance.
    pub distance_median: f64,
    /// Largest distance.
    pub distance_most: f64,
    /// Views that repeat another one's place.
    pub duplicates: Vec<String>,
}

pub(super) fn baselines(scene: &Scene, survey: &Survey, faults: &mut Faults) -> Baselines {
    let centers: Vec<DVec3> = scene
        .train
        .iter()
        .map(|&view| survey.views[view].camera.center())
        .collect();
    let directions: Vec<DVec3> = centers
        .iter()
        .map(|center| center.normalize_or(DVec3::Z))
        .collect();
    let distances: Vec<f64> = centers.iter().map(|center| center.length()).collect();
    let name = |at: usize| scene.views[scene.train[at]].name.clone();
    // Of each view: its nearest one's angle, the farthest one's, and an earlier view at the same place.
    let others: Vec<(f64, f64, Option<usize>)> = (0..centers.len())
        .into_par_iter()
        .map(|at| {
            let (mut nearest, mut farthest, mut same) = (f64::INFINITY, 0.0_f64, None);
            for other in (0..centers.len()).filter(|&other| other != at) {
                let angle = directions[at].angle_between(directions[other]).to_degrees();
                nearest = nearest.min(angle);
                farthest = farthest.max(angle);
                let apart = (distances[at] - distances[other]).abs();
                if other < at && angle < SAME.0 && apart < SAME.1 * distances[at] {
                    same = same.or(Some(other));
                }
            }
            (
                if nearest.is_finite() { nearest } else { 0.0 },
                farthest,
                same,
            )
        })
        .collect();
    let lonely = (0..others.len()).max_by(|&a, &b| others[a].0.total_cmp(&others[b].0));
    let duplicates: Vec<(usize, usize)> = others
        .iter()
        .enumerate()
        .filter_map(|(at, other)| Some((at, other.2?)))
        .collect();
    let found = Baselines {
        nearest_degrees_median: median(others.iter().map(|other| other.0).collect()),
        nearest_degrees_most: others.iter().map(|other| other.0).fold(0.0, f64::max),
        widest_degrees: others.iter().map(|other| other.1).fold(0.0, f64::max),
        distance_least: distances.iter().copied().reduce(f64::min).unwrap_or(0.0),
        distance_median: median(distances.clone()),
        distance_most: distances.iter().copied().fold(0.0, f64::max),
        duplicates: duplicates.iter().map(|&(at, _)| name(at)).collect(),
    };
    if found.nearest_degrees_median > FAR_APART {
        faults.warning(
            format!(
                "neighbouring views are {:.0} degrees apart",
                found.nearest_degrees_median
            ),
            "images/",
            "take photographs every 10 to 15 degrees around the object: highlights change quickly",
        );
    } else if let Some(at) = lonely.filter(|_| found.nearest_degrees_most > ALONE) {
        faults.warning(
            format!(
                "the nearest other view is {:.0} degrees away",
                found.nearest_degrees_most
            ),
            format!("view {}", name(at)),
            "take photographs between it and the others",
        );
    }
    if centers.len() > 1 && found.widest_degrees < ONE_SIDED {
        faults.warning(
            format!("all views lie within {:.0} degrees", found.widest_degrees),
            "images/",
            "renderings are good near these views only; go further around the object",
        );
    }
    if found.distance_most > UNEVEN * found.distance_least {
        faults.warning(
            format!(
                "the farthest view is {:.0} times as far away as the nearest",
                found.distance_most / found.distance_least.max(f64::MIN_POSITIVE)
            ),
            "images/",
            "leave out photographs from far away, or bake at the size that they allow",
        );
    }
    if let Some(&(at, other)) = duplicates.first() {
        faults.warning(
            format!(
                "{} views repeat another one's place; {} and {} are the first two",
                duplicates.len(),
                name(other),
                name(at)
            ),
            format!("view {}", name(at)),
            "remove copies of photographs; a second exposure of the same place adds nothing",
        );
    }
    found
}
