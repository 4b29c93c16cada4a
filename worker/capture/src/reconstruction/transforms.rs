//! `transforms.json` of nerfstudio and of instant-ngp.
//!
//! A frame's `transform_matrix` places its camera in the world with axes x right, y up, z backwards. Intrinsics stand
//! at the top and may be overridden by each frame. Pixels are measured from the top-left corner, as ours; the lens is
//! `x' = x (1 + k1 r^2 + .. + k4 r^8) + 2 p1 x y + p2 (r^2 + 2 x^2)`, y likewise, on angles for the fisheye models.
//! FISHEYE624 is Project Aria's lens, COLMAP's `RAD_TAN_THIN_PRISM_FISHEYE`: twelve `distortion_params`.
//!
//! # The world
//! `applied_transform` and `applied_scale` say how nerfstudio's importers moved the reconstruction that they read.
//! They are undone here, so that cameras and points come out in the frame of the program before, which is the frame
//! of the meshes it wrote. instant-ngp's `scale`, `offset` and `aabb` place its own box around the scene and move no
//! camera: they are not applied, nor do its meshes need them.
//!
//! Source: nerfstudio documentation, "Data conventions"; instant-ngp `docs/nerf_dataset_tips.md`.

use std::path::{Component, Path, PathBuf};

use glam::{DMat3, DVec3};
use serde::Deserialize;
use serde::de::IgnoredAny;

use super::json::{self, Number, numbers};
use super::photo_index::PhotoIndex;
use super::pose::{self, FLIP_Y_AND_Z, Similarity};
use super::{Model, ModelImage, ModelPoint};
use crate::distortion::{Brown, CameraModel, SourceCamera};
use crate::fault::Faults;
use crate::settings;

const MODEL_HINT: &str = "convert the photographs to one of PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV, FULL_OPENCV, \
                          OPENCV_FISHEYE, FISHEYE624 or EQUIRECTANGULAR";
const MATRIX_HINT: &str =
    "transform_matrix must be four rows of four numbers, or three: camera to world";

/// The keys of the file and of each frame: a frame's own value goes before the file's.
#[derive(Debug, Default, Deserialize)]
#[serde(default)]
struct Entry {
    camera_model: Option<String>,
    is_fisheye: Option<bool>,
    fl_x: Option<Number>,
    fl_y: Option<Number>,
    /// Radians over the whole width and height.
    camera_angle_x: Option<Number>,
    camera_angle_y: Option<Number>,
    /// Degrees.
    x_fov: Option<Number>,
    y_fov: Option<Number>,
    cx: Option<Number>,
    cy: Option<Number>,
    w: Option<Number>,
    h: Option<Number>,
    k1: Option<Number>,
    k2: Option<Number>,
    k3: Option<Number>,
    k4: Option<Number>,
    k5: Option<Number>,
    k6: Option<Number>,
    p1: Option<Number>,
    p2: Option<Number>,
    /// k1..k4, p1, p2 in one list, as nerfstudio takes them too; k0..k5, p0, p1, s0..s3 of FISHEYE624.
    distortion_params: Option<Vec<Number>>,
    ftheta_p0: Option<IgnoredAny>,
    latlong: Option<IgnoredAny>,
    file_path: Option<String>,
    mask_path: Option<String>,
    transform_matrix: Option<Vec<Vec<Number>>>,
    frames: Option<Vec<Entry>>,
    applied_transform: Option<Vec<Vec<Number>>>,
    applied_scale: Option<Number>,
    ply_file_path: Option<String>,
    scale: Option<IgnoredAny>,
    offset: Option<IgnoredAny>,
    aabb: Option<IgnoredAny>,
}

/// Points that the file leaves to a PLY file.
#[derive(Debug)]
pub(super) struct PointFile {
    /// Inside the capture.
    pub(super) path: PathBuf,
    original_from_saved: Similarity,
}

/// Reads the file. `folder` is its place inside the capture: masks and points are named from there.
pub(super) fn parse(
    bytes: &[u8],
    shown: &str,
    folder: &Path,
    photographs: &PhotoIndex,
    faults: &mut Faults,
) -> (Model, Option<PointFile>) {
    let mut model = Model::default();
    let Some(mut file) = json::read::<Entry>(bytes, shown, faults) else {
        return (model, None);
    };
    let errors_before = faults.error_count();
    if file.scale.is_some() || file.offset.is_some() || file.aabb.is_some() {
        faults.warning(
            "scale, offset and aabb are not applied: they place instant-ngp's own box and move no camera",
            shown,
            "nothing to do: the proxy must be in the frame of the cameras in the file",
        );
    }
    let original_from_saved = undo_applied(&file, shown, faults);
    let frames = file.frames.take().unwrap_or_default();
    if frames.is_empty() {
        faults.error(
            "the file has no frames",
            shown,
            "export the cameras of the aligned photographs",
        );
    }
    let mut last_complaint = String::new();
    for (index, frame) in frames.iter().enumerate() {
        let written = frame.file_path.as_deref().unwrap_or_default();
        let at = format!("{shown} (frame {index}, {written:?})");
        let name = match photographs.name_of(written) {
            Ok(name) => name,
            Err(message) => {
                faults.error(
                    message,
                    at,
                    "file_path must lead to one photograph in images/",
                );
                continue;
            }
        };
        let camera_from_world = match placed(frame, original_from_saved) {
            Ok(pose) => pose,
            Err(message) => {
                faults.error(format!("image {name} {message}"), at, MATRIX_HINT);
                continue;
            }
        };
        let camera = camera(&file, frame, || photographs.size_of(&name)).and_then(|camera| {
            camera.map(super::sound).transpose().map_err(|message| {
                (
                    message,
                    "correct the intrinsics, or convert the photographs again",
                )
            })
        });
        let camera = match camera {
            Ok(camera) => camera,
            Err((message, hint)) => {
                // One fault for a mistake that all frames share.
                if message != last_complaint {
                    faults.error(format!("image {name} {message}"), at.as_str(), hint);
                    last_complaint = message;
                }
                None
            }
        };
        let mask_path = frame.mask_path.as_deref().and_then(|written| {
            let mask = inside(folder, written);
            if mask.is_none() {
                faults.error(
                    format!(
                        "image {name} has the mask {written:?}, which lies outside the capture"
                    ),
                    at.as_str(),
                    "copy it into masks/ and name it from there",
                );
            }
            mask
        });
        let camera_id = model.push_camera(camera);
        model.push_image(ModelImage {
            camera_id,
            mask_path,
            ..ModelImage::new(name, camera_from_world, at)
        });
    }
    model.has_all_images = faults.error_count() == errors_before;
    let points = file.ply_file_path.as_deref().and_then(|written| {
        let path = inside(folder, written);
        if path.is_none() {
            faults.warning(
                format!("the points {written:?} lie outside the capture and are left out"),
                shown,
                "they are used for checks only; copy the file into the capture",
            );
        }
        Some(PointFile {
            path: path?,
            original_from_saved: original_from_saved.unwrap_or(Similarity::IDENTITY),
        })
    });
    (model, points)
}

/// A path as the file writes it, from the capture; `None` where it leads out of it.
fn inside(folder: &Path, written: &str) -> Option<PathBuf> {
    let written = written.replace('\\', "/");
    let path: PathBuf = folder
        .join(written)
        .components()
        .filter(|step| *step != Component::CurDir)
        .collect();
    settings::is_inside(&path).then_some(path)
}

/// From the file's world to the one before nerfstudio's importer; `None` where a fault keeps it unknown.
fn undo_applied(file: &Entry, shown: &str, faults: &mut Faults) -> Option<Similarity> {
    let scale = file.applied_scale.map_or(1.0, |number| number.0);
    let (rows, moved) = match &file.applied_transform {
        None => (DMat3::IDENTITY, DVec3::ZERO),
        // No matrix of the right size cannot be undone either.
        Some(matrix) => affine(matrix).unwrap_or((DMat3::ZERO, DVec3::ZERO)),
    };
    let rotation = pose::rotation(rows).map(DMat3::from_quat);
    let original_from_saved = match rotation {
        Ok(rotation) if scale.is_finite() && scale > 0.0 && moved.is_finite() => {
            let inverse = rotation.transpose();
            // saved = scale * (length * rotation * original + moved)
            let length = rows.col(0).length();
            Some(Similarity {
                scale: (scale * length).recip(),
                rotation: inverse,
                translation: -(inverse * moved) / length,
            })
        }
        _ => None,
    };
    original_from_saved.or_else(|| {
        faults.error(
            "applied_transform and applied_scale cannot be undone",
            shown,
            "applied_transform must be a rotation with a translation, applied_scale a number above zero",
        );
        None
    })
}

/// Rows of a 3x4 or 4x4 matrix as its linear part and translation.
fn affine(rows: &[Vec<Number>]) -> Option<(DMat3, DVec3)> {
    if !matches!(rows.len(), 3 | 4) {
        return None;
    }
    let rows: Vec<[f64; 4]> = rows
        .iter()
        .map(|row| numbers::<4>(row))
        .collect::<Option<_>>()?;
    let column = |index: usize| DVec3::new(rows[0][index], rows[1][index], rows[2][index]);
    Some((DMat3::from_cols(column(0), column(1), column(2)), column(3)))
}

fn placed(
    frame: &Entry,
    original_from_saved: Option<Similarity>,
) -> Result<glam::DAffine3, &'static str> {
    let matrix = frame
        .transform_matrix
        .as_deref()
        .ok_or("has no transform_matrix")?;
    let (axes, center) = affine(matrix).ok_or("has a transform_matrix of another size")?;
    let world = original_from_saved.unwrap_or(Similarity::IDENTITY);
    pose::camera_from_world(world.rotation * axes * FLIP_Y_AND_Z, world.apply(center))
}

/// The frame's camera; `None` where its size is nowhere, because the photograph is not there.
fn camera(
    file: &Entry,
    frame: &Entry,
    size_of_photograph: impl FnOnce() -> Option<(u32, u32)>,
) -> Result<Option<SourceCamera>, (String, &'static str)> {
    let get = |key: fn(&Entry) -> Option<Number>| key(frame).or(key(file)).map(|number| number.0);
    let or_zero = |key: fn(&Entry) -> Option<Number>| get(key).unwrap_or(0.0);
    let written = (get(|e| e.w), get(|e| e.h));
    let (width, height) = match written {
        (Some(w), Some(h)) => super::picture_size(w, h)
            .map_err(|message| (message, "w and h are the photograph's size in pixels"))?,
        _ => match size_of_photograph() {
            Some(size) => size,
            None => return Ok(None),
        },
    };
    let is_fisheye = frame.is_fisheye.or(file.is_fisheye).unwrap_or(false);
    let name = frame
        .camera_model
        .as_deref()
        .or(file.camera_model.as_deref());
    if frame.ftheta_p0.is_some() || file.ftheta_p0.is_some() {
        return Err((
            "has an f-theta lens, which is not supported".into(),
            MODEL_HINT,
        ));
    }
    if frame.latlong.is_some() || file.latlong.is_some() || name == Some("EQUIRECTANGULAR") {
        return Ok(Some(SourceCamera::panorama(width, height)));
    }
    let fisheye = match name {
        None => is_fisheye,
        Some("OPENCV_FISHEYE" | "FISHEYE624") => true,
        Some(
            "PINHOLE" | "SIMPLE_PINHOLE" | "SIMPLE_RADIAL" | "RADIAL" | "OPENCV" | "FULL_OPENCV",
        ) => false,
        Some(other) => {
            return Err((
                format!("has the unsupported camera model {other}"),
                MODEL_HINT,
            ));
        }
    };
    let from_angle = |angle: Option<f64>, degrees: Option<f64>, side: u32| {
        let angle = angle.or(degrees.map(f64::to_radians))?;
        Some(0.5 * f64::from(side) / (0.5 * angle).tan())
    };
    let x =
        get(|e| e.fl_x).or_else(|| from_angle(get(|e| e.camera_angle_x), get(|e| e.x_fov), width));
    let y =
        get(|e| e.fl_y).or_else(|| from_angle(get(|e| e.camera_angle_y), get(|e| e.y_fov), height));
    let Some((fx, fy)) = x.or(y).zip(y.or(x)) else {
        return Err((
            "has no focal length".into(),
            "give fl_x in pixels, or camera_angle_x in radians",
        ));
    };
    let cx = get(|e| e.cx).unwrap_or(f64::from(width) / 2.0);
    let cy = get(|e| e.cy).unwrap_or(f64::from(height) / 2.0);
    let (k5, k6) = (or_zero(|e| e.k5), or_zero(|e| e.k6));
    let list = frame
        .distortion_params
        .as_ref()
        .or(file.distortion_params.as_ref());
    if name == Some("FISHEYE624") {
        let bend = numbers::<12>(list.map_or(&[], Vec::as_slice)).ok_or((
            format!("has {} distortion_params", list.map_or(0, Vec::len)),
            "distortion_params of FISHEYE624 must be k0..k5, p0, p1, s0..s3",
        ))?;
        let params: Vec<f64> = [fx, fy, cx, cy].into_iter().chain(bend).collect();
        let model = CameraModel::RadTanThinPrismFisheye;
        return Ok(SourceCamera::from_params(model, width, height, &params));
    }
    let [k1, k2, k3, k4, p1, p2] = match list {
        Some(list) => numbers::<6>(list).ok_or((
            format!("has {} distortion_params", list.len()),
            "distortion_params must be k1, k2, k3, k4, p1, p2",
        ))?,
        None => [
            or_zero(|e| e.k1),
            or_zero(|e| e.k2),
            or_zero(|e| e.k3),
            or_zero(|e| e.k4),
            or_zero(|e| e.p1),
            or_zero(|e| e.p2),
        ],
    };
    if name == Some("FULL_OPENCV") {
        let params = [fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6];
        return Ok(SourceCamera::from_params(
            CameraModel::FullOpencv,
            width,
            height,
            &params,
        ));
    }
    Ok(Some(
        Brown {
            width,
            height,
            fx,
            fy,
            cx,
            cy,
            fisheye,
            radial: [k1, k2, k3, k4, 0.0, 0.0],
            tangential: [p1, p2],
            ..Brown::default()
        }
        .into(),
    ))
}

/// Reads the points into the model. They are used for checks only: what is wrong with them is a warning.
pub(super) fn read_points(dir: &Path, file: &PointFile, model: &mut Model, faults: &mut Faults) {
    let points = std::fs::read(dir.join(&file.path))
        .map_err(|error| error.to_string())
        .and_then(|bytes| ign_geometry::parse_points(&bytes));
    match points {
        Ok(points) => {
            model
                .points
                .extend(points.into_iter().map(|(position, color)| ModelPoint {
                    position: file.original_from_saved.apply(position),
                    color,
                    error_px: None,
                    image_ids: Vec::new(),
                }));
        }
        Err(message) => faults.warning(
            format!("the points cannot be read: {message}"),
            file.path.display().to_string(),
            "they are used for checks only; export them as PLY if you have them",
        ),
    }
}
