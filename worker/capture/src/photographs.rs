//! Photographs and masks: whether each is there and fits its camera, and what surrounds the object in them.
//!
//! They are only opened as far as their headers here (a handful is decoded to tell what the background is); decoding
//! all of them is [`crate::Scene::load_view`]'s work.

use std::collections::BTreeSet;
use std::io;
use std::path::Path;

use glam::DMat3;
use ign_geometry::{Camera, CameraIntrinsics};
use image::{DynamicImage, ImageError};
use rayon::prelude::*;

use crate::distortion::SourceCamera;
use crate::fault::{Fault, Faults, error_chain};
use crate::photo;
use crate::reconstruction::{Model, ModelImage};
use crate::scene::{Background, View};
use crate::settings;
use crate::sight::SeeingView;
use crate::split;

/// Views that are decoded to tell what the background is.
const BACKGROUND_SAMPLES: usize = 8;

/// Photographs count as black outside their masks below this mean, of 255.
const BLACK_BELOW: f64 = 2.0;

/// The model's images by name, in path order, without those whose entry is faulty by itself.
pub(crate) fn check_names<'a>(model: &'a Model, faults: &mut Faults) -> Vec<&'a ModelImage> {
    let mut images: Vec<&ModelImage> = model.images.iter().collect();
    images.sort_by(|a, b| split::natural_order(&a.name, &b.name));
    let mut kept: Vec<&ModelImage> = Vec::with_capacity(images.len());
    for image in images {
        if kept.last().is_some_and(|last| last.name == image.name) {
            faults.error(
                format!("image {} is in the model twice", image.name),
                image.at.as_str(),
                "each photograph can have one pose only: re-export the model",
            );
        } else if !settings::is_inside(Path::new(&image.name)) {
            faults.error(
                format!(
                    "image {:?} has a name that points outside images/",
                    image.name
                ),
                image.at.as_str(),
                "names are paths below images/",
            );
        } else {
            kept.push(image);
        }
    }
    kept
}

/// A view, with the id it has in the model.
pub(crate) type Candidate = (View, u32);

/// The views whose camera, photograph and mask are in order, and whether there are masks.
pub(crate) fn check_photographs(
    dir: &Path,
    model: &Model,
    registered: &[&ModelImage],
    faults: &mut Faults,
) -> (Vec<Candidate>, bool) {
    let images = dir.join("images");
    let images_exist = images.is_dir();
    if !images_exist {
        faults.error(
            "the folder images/ is missing",
            "images/",
            "put the photographs there, named as in the model",
        );
    }
    let masks = dir.join("masks");
    let mask_folder = masks.is_dir();
    let folder_has_masks =
        mask_folder && std::fs::read_dir(&masks).is_ok_and(|mut entries| entries.next().is_some());
    // Some reconstructions name masks themselves.
    let has_masks = folder_has_masks || registered.iter().any(|image| image.mask_path.is_some());
    if mask_folder && !has_masks {
        faults.warning(
            "the folder masks/ is empty",
            "masks/",
            "remove it, or put one mask per photograph there",
        );
    }
    let checked: Vec<(Option<Candidate>, Faults)> = registered
        .par_iter()
        .map(|image| {
            let mut faults = Faults::default();
            let candidate = check_view(dir, model, image, images_exist, has_masks, &mut faults);
            (candidate, faults)
        })
        .collect();
    let mut candidates = Vec::with_capacity(checked.len());
    for (candidate, found) in checked {
        candidates.extend(candidate);
        faults.extend(found.into_list());
    }
    (candidates, has_masks)
}

pub(crate) fn report_unregistered(images: &Path, registered: &[&ModelImage], faults: &mut Faults) {
    let known: BTreeSet<&str> = registered.iter().map(|image| image.name.as_str()).collect();
    let Ok(entries) = std::fs::read_dir(images) else {
        return;
    };
    let mut extra: Vec<String> = entries
        .filter_map(Result::ok)
        .filter(|entry| entry.file_type().is_ok_and(|kind| kind.is_file()))
        .filter_map(|entry| entry.file_name().into_string().ok())
        .filter(|name| !known.contains(name.as_str()))
        .collect();
    extra.sort();
    if let Some(first) = extra.first() {
        faults.warning(
            format!(
                "{} files in images/ are not in the model and are left out, the first is {first}",
                extra.len()
            ),
            "images/",
            "nothing to do, unless they should have been registered",
        );
    }
}

fn check_view(
    dir: &Path,
    model: &Model,
    image: &ModelImage,
    images_exist: bool,
    has_masks: bool,
    faults: &mut Faults,
) -> Option<Candidate> {
    let source = model
        .cameras
        .get(&image.camera_id)
        .copied()
        .unwrap_or_else(|| {
            faults.error(
                format!(
                    "image {} names camera {}, which the model does not have",
                    image.name, image.camera_id
                ),
                image.at.as_str(),
                "cameras and images must come from the same export",
            );
            None
        });
    let size = source.map(|source| (source.width, source.height));
    let image_path = dir.join("images").join(&image.name);
    let photograph_is_sound = images_exist
        && check_picture(
            &image_path,
            &format!("images/{}", image.name),
            "photograph",
            size,
            image,
            faults,
        );
    let mut mask_path = None;
    if has_masks {
        mask_path = match &image.mask_path {
            Some(named) => Some(dir.join(named)),
            None => photo::find_mask(&dir.join("masks"), &image.name),
        };
        match &mask_path {
            Some(path) => {
                let shown = path.strip_prefix(dir).unwrap_or(path).display().to_string();
                check_picture(path, &shown, "mask", size, image, faults);
            }
            None => faults.error(
                format!("image {} has no mask", image.name),
                format!(
                    "masks/{}",
                    Path::new(&image.name).with_extension("png").display()
                ),
                "add it (white = object), or remove masks/ to go by the proxy's silhouette",
            ),
        }
    }
    let source = source?;
    let camera = Camera::new(pinhole(&source), image.camera_from_world).map_err(|error| {
        faults.error(
            format!(
                "image {} has an unusable camera: {}",
                image.name,
                error_chain(&error)
            ),
            image.at.as_str(),
            "re-export the model",
        );
    });
    let camera = camera.ok()?;
    photograph_is_sound.then(|| {
        (
            View {
                name: image.name.clone(),
                camera,
                source,
                source_from_camera: DMat3::IDENTITY,
                rolled_columns: 0,
                image_path,
                mask_path,
            },
            image.id,
        )
    })
}

/// The undistorted camera of a photograph: same size, focal lengths and principal point.
fn pinhole(source: &SourceCamera) -> CameraIntrinsics {
    CameraIntrinsics {
        fx: source.fx,
        fy: source.fy,
        cx: source.cx,
        cy: source.cy,
        width: source.width,
        height: source.height,
    }
}

/// Checks a photograph or mask by its header.
fn check_picture(
    path: &Path,
    shown: &str,
    what: &str,
    size: Option<(u32, u32)>,
    image: &ModelImage,
    faults: &mut Faults,
) -> bool {
    match (photo::dimensions(path), size) {
        (Ok(found), Some(size)) if found != size => {
            let turned = if (found.1, found.0) == size {
                " (turned by 90 degrees?)"
            } else {
                ""
            };
            faults.error(
                format!(
                    "the {what} {shown} is {}x{} pixels, its camera {} says {}x{}{turned}",
                    found.0, found.1, image.camera_id, size.0, size.1
                ),
                shown,
                "use the pictures that the reconstruction was made from, at their full size",
            );
            false
        }
        (Ok(_), _) => true,
        (Err(ImageError::IoError(error)), _) if error.kind() == io::ErrorKind::NotFound => {
            faults.error(
                format!("the {what} {shown} is missing"),
                image.at.as_str(),
                "add it, or remove the image from the model",
            );
            false
        }
        (Err(error), _) => {
            let message = error_chain(&error);
            faults.error(
                format!("{shown} is no image that can be read: {message}"),
                shown,
                "replace it by a JPEG, PNG or WebP file",
            );
            false
        }
    }
}

/// What surrounds the object, by decoding a few views with their masks.
pub(crate) fn background(
    views: &[SeeingView],
    mask_is_background: bool,
    faults: &mut Faults,
) -> Background {
    let count = views.len().min(BACKGROUND_SAMPLES);
    let sampled: Vec<Result<Option<f64>, Fault>> = (0..count)
        .into_par_iter()
        .map(|sample| mean_outside_mask(&views[sample * views.len() / count].0, mask_is_background))
        .collect();
    let mut means = Vec::new();
    for sample in sampled {
        match sample {
            Ok(mean) => means.extend(mean),
            Err(fault) => faults.extend([fault]),
        }
    }
    if !means.is_empty() && means.iter().all(|&mean| mean < BLACK_BELOW) {
        Background::Black
    } else {
        Background::MaskedOut
    }
}

/// Mean of the photograph, of 255, where the mask is zero; `None` where it nowhere is.
fn mean_outside_mask(view: &View, mask_is_background: bool) -> Result<Option<f64>, Fault> {
    let decode = |path: &Path| -> Result<DynamicImage, Fault> {
        photo::decode(path, (view.source.width, view.source.height)).map_err(|error| Fault {
            severity: crate::Severity::Error,
            message: format!("cannot decode {}: {}", path.display(), error_chain(&error)),
            at: format!("view {}", view.name),
            hint: "copy the file again: it seems to be damaged".into(),
        })
    };
    let Some(mask_path) = &view.mask_path else {
        return Ok(None);
    };
    let photograph = decode(&view.image_path)?.into_rgb8();
    let mask = decode(mask_path)?.into_luma8();
    let outside = if mask_is_background { 255 } else { 0 };
    let (mut sum, mut count) = (0_u64, 0_u64);
    for (pixel, mask) in photograph.pixels().zip(mask.pixels()) {
        if mask.0[0] == outside {
            sum += pixel.0.iter().map(|&value| u64::from(value)).sum::<u64>();
            count += 3;
        }
    }
    Ok((count > 0).then(|| sum as f64 / count as f64))
}
