//! How large the object is, and where its coordinates lie.

use glam::DVec3;
use serde::{Deserialize, Serialize};

use crate::fault::Faults;
use crate::scene::Scene;
use crate::settings;

/// Distance of the object from the origin, in its radii, from which coordinates are those of a map.
const FAR_FROM_ORIGIN: f64 = 1000.0;
/// Sizes in metres that an object of a collection has.
const PLAUSIBLE_METRES: std::ops::Range<f64> = 1e-3..100.0;
/// Largest extents in metres, and what is about as large.
const SIZES: [(f64, &str); 7] = [
    (0.01, "smaller than a fingernail"),
    (0.04, "about the size of a coin"),
    (0.12, "fits into a palm"),
    (0.4, "can be held in two hands"),
    (1.2, "about the size of a chair"),
    (3.0, "about the size of a person"),
    (f64::INFINITY, "larger than a person"),
];

/// Size and place of the object.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Scale {
    /// Largest side of the object's bounding box, in units of the reconstruction.
    pub extent: f64,
    /// The same in metres, where `capture.toml` says how long a unit is.
    pub extent_metres: Option<f64>,
    /// Distance of the object from the origin, in its radii.
    pub origin_distance: f64,
    /// Whether the coordinates are those of a map: far from the origin.
    pub georeferenced: bool,
    /// The size in words.
    pub words: String,
}

pub(super) fn scale(scene: &Scene, faults: &mut Faults) -> Scale {
    let corner = |pick: fn(DVec3, DVec3) -> DVec3| {
        scene
            .mesh
            .positions
            .iter()
            .copied()
            .reduce(pick)
            .unwrap_or_default()
    };
    let extent = (corner(DVec3::max) - corner(DVec3::min)).max_element();
    let (center, radius) = scene.mesh.bounding_sphere();
    let origin_distance = center.length() / radius.max(f64::MIN_POSITIVE);
    let georeferenced = origin_distance > FAR_FROM_ORIGIN;
    let extent_metres = scene
        .info
        .metres_per_scene_unit
        .map(|metres| extent * metres);
    let words = match extent_metres {
        Some(metres) => SIZES
            .iter()
            .find(|(most, _)| metres <= *most)
            .map_or("", |(_, words)| words)
            .to_owned(),
        None => "size unknown: the capture does not say how long a unit is".to_owned(),
    };
    if let Some(metres) = extent_metres.filter(|metres| !PLAUSIBLE_METRES.contains(metres)) {
        faults.warning(
            format!("the object would be {metres:.4} metres large"),
            settings::FILE_NAME,
            "check metres_per_scene_unit",
        );
    }
    Scale {
        extent,
        extent_metres,
        origin_distance,
        georeferenced,
        words,
    }
}
