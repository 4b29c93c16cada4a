//! Which part of the surface the training photographs show, and in which direction the rest lies.

use glam::DVec3;
use ign_geometry::Camera;
use serde::{Deserialize, Serialize};

use crate::fault::Faults;
use crate::scene::Scene;
use crate::survey::Survey;

/// Least cosine of a good viewing angle: 60 degrees from the normal.
const GOOD_COS: f32 = 0.5;
/// Part of the surface that a region must have to be worth words.
const LEAST_AREA: f64 = 0.02;
/// Part of a region that must be seen too little for it to be weak.
const WEAK_SHARE: f64 = 0.5;
/// Cosine between normal and vertical from which a place belongs to the top or the underside: 45 degrees.
const STEEP: f64 = 0.7;
/// Sides into which the rest is divided.
const SIDES: usize = 6;
/// Length of the cameras' mean up direction from which it is trusted to be the object's.
const UPRIGHT: f64 = 0.5;

/// Coverage of the part of the surface that can be seen from outside at all, by training views at good angles
/// (within 60 degrees of the normal). Shares of the area.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Coverage {
    /// Seen by at least one view.
    pub by_one: f64,
    /// Seen by at least two.
    pub by_two: f64,
    /// Seen by at least four.
    pub by_four: f64,
    /// Regions of which less than half is seen by two views, the largest first.
    pub weak: Vec<Region>,
}

/// A part of the surface that faces one way.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Region {
    /// Where it is: `the underside`, `the side towards IMG_7.jpg`.
    pub name: String,
    /// Its share of the surface.
    pub area: f64,
    /// Share of it that no view sees.
    pub unseen: f64,
    /// Share of it that fewer than two views see.
    pub seen_once_at_most: f64,
}

/// Which way a place faces.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Facing {
    Top,
    Underside,
    Side(usize),
}

pub(super) fn coverage(scene: &Scene, survey: &Survey, faults: &mut Faults) -> Coverage {
    let mut seen = vec![0_usize; survey.points.len()];
    for &view in &scene.train {
        for sighting in &survey.views[view].sightings {
            if sighting.cos >= GOOD_COS {
                seen[sighting.point as usize] += 1;
            }
        }
    }
    let total = seen.len().max(1) as f64;
    let at_least =
        |count: usize| seen.iter().filter(|&&views| views >= count).count() as f64 / total;
    let cameras: Vec<Camera> = survey.views.iter().map(|view| view.camera).collect();
    let compass = Compass::of(&cameras);

    let mut places: Vec<(Facing, usize)> = survey
        .points
        .iter()
        .zip(&seen)
        .map(|(point, &views)| (compass.facing(point.normal), views))
        .collect();
    places.sort_by_key(|&(facing, _)| facing);
    let mut weak: Vec<Region> = places
        .chunk_by(|a, b| a.0 == b.0)
        .map(|places| {
            let share = |most: usize| {
                places.iter().filter(|(_, views)| *views <= most).count() as f64
                    / places.len() as f64
            };
            Region {
                name: compass.name(places[0].0, scene, &cameras),
                area: places.len() as f64 / total,
                unseen: share(0),
                seen_once_at_most: share(1),
            }
        })
        .filter(|region| region.area >= LEAST_AREA && region.seen_once_at_most >= WEAK_SHARE)
        .collect();
    weak.sort_by(|a, b| b.area.total_cmp(&a.area));
    for region in &weak {
        let how = if region.unseen >= WEAK_SHARE {
            "is mostly seen by no view"
        } else {
            "is mostly seen by one view only"
        };
        faults.warning(
            format!(
                "{} ({:.0} % of the surface) {how}",
                region.name,
                100.0 * region.area
            ),
            "images/",
            "take photographs of it, or accept that what is shown there is a guess",
        );
    }
    Coverage {
        by_one: at_least(1),
        by_two: at_least(2),
        by_four: at_least(4),
        weak,
    }
}

/// Directions around the object.
struct Compass {
    up: DVec3,
    ahead: DVec3,
    left: DVec3,
}

impl Compass {
    /// Up is the mean of the cameras' own; where they were held every way, the axis that they circle, on the side on
    /// which they stand.
    fn of(cameras: &[Camera]) -> Self {
        let count = cameras.len().max(1) as f64;
        let mean_up = cameras
            .iter()
            .map(|camera| camera.camera_from_world.matrix3.transpose() * DVec3::NEG_Y)
            .sum::<DVec3>()
            / count;
        let up = if mean_up.length() >= UPRIGHT {
            mean_up.normalize_or(DVec3::Z)
        } else {
            circled_axis(cameras)
        };
        let ahead = up.any_orthonormal_vector();
        Self {
            up,
            ahead,
            left: up.cross(ahead),
        }
    }

    /// Angle around the vertical, in turns from 0 to 1.
    fn turn(&self, direction: DVec3) -> f64 {
        let turn =
            direction.dot(self.left).atan2(direction.dot(self.ahead)) / std::f64::consts::TAU;
        turn.rem_euclid(1.0)
    }

    fn facing(&self, normal: DVec3) -> Facing {
        match normal.dot(self.up) {
            up if up > STEEP => Facing::Top,
            up if up < -STEEP => Facing::Underside,
            _ => Facing::Side(((self.turn(normal) * SIDES as f64) as usize).min(SIDES - 1)),
        }
    }

    fn name(&self, facing: Facing, scene: &Scene, cameras: &[Camera]) -> String {
        match facing {
            Facing::Top => "the top".into(),
            Facing::Underside => "the underside".into(),
            Facing::Side(side) => {
                let middle = (side as f64 + 0.5) / SIDES as f64;
                let off = |camera: &Camera| {
                    let difference = (self.turn(camera.center()) - middle).rem_euclid(1.0);
                    difference.min(1.0 - difference)
                };
                let nearest = cameras
                    .iter()
                    .map(off)
                    .zip(&scene.views)
                    .min_by(|a, b| a.0.total_cmp(&b.0));
                match nearest {
                    Some((off, view)) if off <= 0.125 => format!("the side towards {}", view.name),
                    Some((off, view)) if off >= 0.375 => {
                        format!("the side away from {}", view.name)
                    }
                    Some((_, view)) => format!("the side beside what {} shows", view.name),
                    None => "a side".into(),
                }
            }
        }
    }
}

/// Direction in which the cameras' places, seen from the object's centre, differ least from each other.
fn circled_axis(cameras: &[Camera]) -> DVec3 {
    let places: Vec<DVec3> = cameras
        .iter()
        .filter_map(|camera| camera.center().try_normalize())
        .collect();
    let mean = places.iter().sum::<DVec3>() / places.len().max(1) as f64;
    let spread = |axis: DVec3| {
        places
            .iter()
            .map(|place| (place - mean).dot(axis).powi(2))
            .sum::<f64>()
    };
    // A search over directions is plenty: words need no more than some degrees.
    let steps = 400;
    let axis = (0..steps)
        .map(|index| {
            let z = (f64::from(index) + 0.5) / f64::from(steps);
            let turn = f64::from(index) * 2.399_963_229_728_653;
            let radius = (1.0 - z * z).sqrt();
            DVec3::new(radius * turn.cos(), radius * turn.sin(), z)
        })
        .min_by(|a, b| spread(*a).total_cmp(&spread(*b)))
        .unwrap_or(DVec3::Z);
    if mean.dot(axis) < 0.0 { -axis } else { axis }
}
