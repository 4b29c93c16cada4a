//! COLMAP sparse models: `cameras`, `images`, `points3D`, binary or text.
//!
//! COLMAP's poses are world-to-camera with the quaternion as (w, x, y, z), camera axes x right, y down, z forward, and
//! pixels with the centre of the top-left one at (0.5, 0.5): our own conventions, so that only the order of the
//! quaternion's parts changes here. `rigs` and `frames` files of recent versions repeat what `images` says; they
//! are not read. Source: COLMAP documentation, "Output Format".

mod binary;
mod text;

use std::path::{Path, PathBuf};

use glam::{DAffine3, DQuat, DVec3};

use crate::fault::Faults;
use crate::reconstruction::Model;

/// The folder of the model inside the capture: `sparse/0` or `sparse`.
pub(crate) fn locate(dir: &Path, faults: &mut Faults) -> Option<PathBuf> {
    let holds_model = |folder: &Path| {
        ["cameras.bin", "cameras.txt", "images.bin", "images.txt"]
            .iter()
            .any(|name| folder.join(name).is_file())
    };
    for relative in ["sparse/0", "sparse"] {
        if holds_model(&dir.join(relative)) {
            if relative == "sparse/0" && holds_model(&dir.join("sparse/1")) {
                faults.warning(
                    "the reconstruction fell into several models; only the first is used",
                    "sparse/1",
                    "merge the models, or check that the missing photographs are not needed",
                );
            }
            return Some(PathBuf::from(relative));
        }
    }
    if dir.join("sparse").is_dir() {
        faults.error(
            "there is no COLMAP model in the capture",
            "sparse/0",
            "put cameras, images and points3D (.bin or .txt) there",
        );
    } else {
        faults.error(
            "the folder sparse/ is missing",
            "sparse/",
            "put COLMAP's sparse model into sparse/0: cameras, images and points3D (.bin or .txt)",
        );
    }
    None
}

/// Reads the model in `dir/relative`. Everything wrong with it goes into `faults`.
pub(crate) fn read(dir: &Path, relative: &Path, faults: &mut Faults) -> Model {
    let mut model = Model::default();
    // COLMAP prefers binary when both are there; the two files that matter decide for all.
    let has = |name: &str| dir.join(relative).join(name).is_file();
    let is_binary = has("cameras.bin") && has("images.bin");
    let extension = if is_binary || !(has("cameras.txt") || has("images.txt")) {
        "bin"
    } else {
        "txt"
    };
    for part in ["cameras", "images", "points3D"] {
        let name = format!("{part}.{extension}");
        let source = Source {
            path: dir.join(relative).join(&name),
            shown: relative.join(&name).display().to_string(),
        };
        if !source.path.is_file() {
            if part == "points3D" {
                faults.warning(
                    "the model has no points",
                    source.shown.as_str(),
                    "they are used for checks only; export them if you have them",
                );
            } else {
                faults.error(
                    format!("the model's {name} is missing"),
                    source.shown.as_str(),
                    "export the model again: cameras, images and points3D belong together",
                );
            }
            continue;
        }
        let errors_before = faults.error_count();
        match (part, extension) {
            ("cameras", "bin") => binary::cameras(&source, &mut model, faults),
            ("cameras", _) => text::cameras(&source, &mut model, faults),
            ("images", "bin") => binary::images(&source, &mut model, faults),
            ("images", _) => text::images(&source, &mut model, faults),
            (_, "bin") => binary::points(&source, &mut model, faults),
            _ => text::points(&source, &mut model, faults),
        }
        if part == "images" {
            model.has_all_images = faults.error_count() == errors_before;
        }
    }
    model
}

/// One file of a model: where it lies, and how faults call it.
struct Source {
    path: PathBuf,
    shown: String,
}

/// Pose from COLMAP's numbers: `[qw, qx, qy, qz, tx, ty, tz]`; the fault as a message when they are none.
fn pose(values: &[f64; 7]) -> Result<DAffine3, &'static str> {
    let [w, x, y, z, tx, ty, tz] = *values;
    if !values.iter().all(|v| v.is_finite()) {
        return Err("has a pose that is not finite");
    }
    let rotation = DQuat::from_xyzw(x, y, z, w);
    if rotation.length_squared() < 1e-12 {
        return Err("has a rotation of length zero");
    }
    Ok(DAffine3::from_rotation_translation(
        rotation.normalize(),
        DVec3::new(tx, ty, tz),
    ))
}

/// For entries that no export of today writes.
const REEXPORT_HINT: &str = "re-export the model with a current version of COLMAP";

#[cfg(test)]
mod tests;
