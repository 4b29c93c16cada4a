//! COLMAP sparse models: `cameras`, `images`, `points3D`, binary or text.
//!
//! COLMAP's poses are world-to-camera with the quaternion as (w, x, y, z), camera axes x right, y down, z forward, and
//! pixels with the centre of the top-left one at (0.5, 0.5): our own conventions, so that only the order of the
//! quaternion's parts changes here. Recent versions write `rigs` and `frames` beside them; the poses in `images` are
//! composed from those already, so they are not read. `RealityCapture` exports models in this layout too. Source: COLMAP documentation, "Output Format".

mod binary;
mod text;

use std::path::{Path, PathBuf};

use glam::{DAffine3, DQuat, DVec3};

use crate::fault::Faults;
use crate::reconstruction::{FORMATS_HINT, Model};

/// Where a capture has its models: in this folder, or in numbered ones below it.
pub(super) const FOLDER: &str = "sparse";

/// Files of a model; the first four make a folder one.
const FILES: [&str; 10] = [
    "cameras.bin",
    "cameras.txt",
    "images.bin",
    "images.txt",
    "points3D.bin",
    "points3D.txt",
    "rigs.bin",
    "rigs.txt",
    "frames.bin",
    "frames.txt",
];

/// Whether there is a model in `dir/folder`, or in numbered folders below it.
pub(super) fn is_there(dir: &Path, folder: &Path) -> bool {
    !models(dir, folder).is_empty()
}

/// The files of the model in `dir/relative`, from `dir`.
pub(super) fn files(dir: &Path, relative: &Path) -> Vec<PathBuf> {
    FILES
        .iter()
        .map(|name| relative.join(name))
        .filter(|path| dir.join(path).is_file())
        .collect()
}

/// The folders of models, from `dir`, the numbered ones first.
fn models(dir: &Path, folder: &Path) -> Vec<PathBuf> {
    let holds_model = |relative: &PathBuf| {
        FILES[..4]
            .iter()
            .any(|name| dir.join(relative).join(name).is_file())
    };
    let mut numbers: Vec<u64> = std::fs::read_dir(dir.join(folder))
        .into_iter()
        .flatten()
        .filter_map(Result::ok)
        .filter_map(|entry| entry.file_name().to_str()?.parse().ok())
        .collect();
    numbers.sort_unstable();
    numbers
        .into_iter()
        .map(|number| folder.join(number.to_string()))
        .chain([folder.to_owned()])
        .filter(holds_model)
        .collect()
}

/// The model with the most images in `dir/folder` or in a numbered folder below it; of equals, the first.
pub(super) fn locate(dir: &Path, folder: &Path, faults: &mut Faults) -> Option<PathBuf> {
    let mut counted: Vec<(u64, PathBuf)> = models(dir, folder)
        .into_iter()
        .map(|relative| (count_images(dir, &relative), relative))
        .collect();
    counted.sort_by_key(|(images, _)| std::cmp::Reverse(*images));
    match counted.as_slice() {
        [] if dir.join(folder).is_dir() => faults.error(
            "there is no COLMAP model in the capture",
            folder.join("0").display().to_string(),
            "put cameras, images and points3D (.bin or .txt) there",
        ),
        [] => faults.error(
            format!(
                "the capture has no reconstruction: the folder {}/ is missing, and no other format was found",
                folder.display()
            ),
            format!("{}/", folder.display()),
            FORMATS_HINT,
        ),
        [_] => {}
        [(images, taken), others @ ..] => {
            let others: Vec<String> = others
                .iter()
                .map(|(images, other)| format!("{} ({images} images)", other.display()))
                .collect();
            faults.warning(
                format!(
                    "the reconstruction fell into {} models; {} with {images} images is used, left out: {}",
                    counted.len(),
                    taken.display(),
                    others.join(", ")
                ),
                taken.display().to_string(),
                "merge the models, or check that the missing photographs are not needed",
            );
        }
    }
    counted.into_iter().next().map(|(_, relative)| relative)
}

/// How many images a model says that it has; it is read in full only when it is the one to take.
fn count_images(dir: &Path, relative: &Path) -> u64 {
    let folder = dir.join(relative);
    if is_binary(&folder) {
        binary::count_images(&folder.join("images.bin"))
    } else {
        text::count_images(&folder.join("images.txt"))
    }
}

/// COLMAP prefers binary when both are there; the two files that matter decide for all.
fn is_binary(folder: &Path) -> bool {
    let has = |name: &str| folder.join(name).is_file();
    (has("cameras.bin") && has("images.bin")) || !(has("cameras.txt") || has("images.txt"))
}

/// Reads the model in `dir/relative`. Everything wrong with it goes into `faults`.
pub(crate) fn read(dir: &Path, relative: &Path, faults: &mut Faults) -> Model {
    let mut model = Model::default();
    let extension = if is_binary(&dir.join(relative)) {
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

/// COLMAP writes -1 where it has not computed an error.
fn known_error(error_px: f64) -> Option<f64> {
    (error_px.is_finite() && error_px >= 0.0).then_some(error_px)
}

/// For entries that no export of today writes.
const REEXPORT_HINT: &str = "re-export the model with a current version of COLMAP";

#[cfg(test)]
mod tests;
