//! `OpenSfM`'s `reconstruction.json`, which `OpenDroneMap` keeps as `opensfm/reconstruction.json`.
//!
//! The file is a list of reconstructions; each has cameras, shots (rotation from the world as axis times angle, and
//! translation) and points without tracks. Camera axes are ours. Lengths within the picture count in its longer side
//! and are measured from its centre. Of several reconstructions the one with the most shots is taken.
//! Source: `OpenSfM` documentation, "Geometric Models" and "Dataset Structure".

use std::collections::BTreeMap;

use glam::{DAffine3, DQuat, DVec3};
use serde::Deserialize;

use super::json::{self, Number, numbers};
use super::photo_index::PhotoIndex;
use super::{Model, ModelImage, ModelPoint};
use crate::distortion::{Brown, SourceCamera};
use crate::fault::Faults;

#[derive(Deserialize)]
struct Reconstruction {
    #[serde(default)]
    cameras: BTreeMap<String, Camera>,
    #[serde(default)]
    shots: BTreeMap<String, Shot>,
    #[serde(default)]
    points: BTreeMap<String, Point>,
}

/// Which of these a camera has depends on its projection.
#[derive(Deserialize)]
#[serde(default)]
struct Camera {
    projection_type: String,
    width: Number,
    height: Number,
    focal: Option<Number>,
    focal_x: Option<Number>,
    focal_y: Option<Number>,
    c_x: Number,
    c_y: Number,
    k1: Number,
    k2: Number,
    k3: Number,
    k4: Number,
    k5: Number,
    k6: Number,
    p1: Number,
    p2: Number,
    s0: Number,
    s1: Number,
    s2: Number,
    s3: Number,
}

impl Default for Camera {
    fn default() -> Self {
        let zero = Number(0.0);
        Self {
            projection_type: "perspective".into(),
            width: zero,
            height: zero,
            focal: None,
            focal_x: None,
            focal_y: None,
            c_x: zero,
            c_y: zero,
            k1: zero,
            k2: zero,
            k3: zero,
            k4: zero,
            k5: zero,
            k6: zero,
            p1: zero,
            p2: zero,
            s0: zero,
            s1: zero,
            s2: zero,
            s3: zero,
        }
    }
}

#[derive(Deserialize)]
struct Shot {
    rotation: [Number; 3],
    translation: [Number; 3],
    camera: String,
}

#[derive(Deserialize)]
struct Point {
    coordinates: [Number; 3],
    #[serde(default)]
    color: Vec<Number>,
}

pub(super) fn parse(
    bytes: &[u8],
    shown: &str,
    photographs: &PhotoIndex,
    faults: &mut Faults,
) -> Model {
    let mut model = Model::default();
    let Some(all) = json::read::<Vec<Reconstruction>>(bytes, shown, faults) else {
        return model;
    };
    let errors_before = faults.error_count();
    // The first of the largest.
    let largest = all
        .iter()
        .enumerate()
        .rev()
        .max_by_key(|(_, reconstruction)| reconstruction.shots.len());
    let Some((taken, reconstruction)) = largest else {
        faults.error(
            "the file has no reconstruction",
            shown,
            "run the reconstruction to its end and copy the file again",
        );
        return model;
    };
    if all.len() > 1 {
        let others: Vec<String> = all
            .iter()
            .enumerate()
            .filter(|(index, _)| *index != taken)
            .map(|(index, other)| format!("{index} ({} images)", other.shots.len()))
            .collect();
        faults.warning(
            format!(
                "the reconstruction fell into {} parts; part {taken} with {} images is used, left out: {}",
                all.len(),
                reconstruction.shots.len(),
                others.join(", ")
            ),
            shown,
            "check that the missing photographs are not needed",
        );
    }
    let mut ids: BTreeMap<&str, u32> = BTreeMap::new();
    for (name, camera) in &reconstruction.cameras {
        let at = format!("{shown} (camera {name:?})");
        let camera = source_camera(camera).and_then(super::sound);
        let camera = match camera {
            Ok(camera) => Some(camera),
            Err(message) => {
                let hint = "use one of perspective, simple_radial, radial, brown, fisheye, fisheye_opencv, fisheye62, \
                            fisheye624 or spherical with sound numbers";
                faults.error(format!("camera {name:?} {message}"), at, hint);
                None
            }
        };
        ids.insert(name, model.push_camera(camera));
    }
    for (written, shot) in &reconstruction.shots {
        let at = format!("{shown} (shot {written:?})");
        let name = match photographs.name_of(written) {
            Ok(name) => name,
            Err(message) => {
                faults.error(
                    message,
                    at,
                    "shots are called as the photographs in images/",
                );
                continue;
            }
        };
        let Some(&camera_id) = ids.get(shot.camera.as_str()) else {
            faults.error(
                format!(
                    "image {name} names camera {:?}, which the file does not have",
                    shot.camera
                ),
                at,
                "copy the file again, or run the reconstruction again",
            );
            continue;
        };
        let vector = |values: [Number; 3]| DVec3::from_array(values.map(|number| number.0));
        let axis_angle = vector(shot.rotation);
        let rotation = DQuat::from_scaled_axis(axis_angle);
        if !rotation.is_finite() {
            faults.error(
                format!("image {name} has a rotation that is not finite"),
                at,
                "run the reconstruction again",
            );
            continue;
        }
        let pose = DAffine3::from_rotation_translation(rotation, vector(shot.translation));
        let mut image = ModelImage::new(name, pose, at);
        image.camera_id = camera_id;
        model.push_image(image);
    }
    for point in reconstruction.points.values() {
        model.points.push(ModelPoint {
            position: DVec3::from_array(point.coordinates.map(|number| number.0)),
            color: numbers::<3>(&point.color)
                .unwrap_or_default()
                .map(|value| value as u8),
            error_px: None,
            image_ids: Vec::new(),
        });
    }
    model.has_all_images = faults.error_count() == errors_before;
    model
}

fn source_camera(camera: &Camera) -> Result<SourceCamera, String> {
    let (width, height) = super::picture_size(camera.width.0, camera.height.0)?;
    let (w, h) = (f64::from(width), f64::from(height));
    let side = w.max(h);
    let [k1, k2, k3, k4, k5, k6] = [
        camera.k1, camera.k2, camera.k3, camera.k4, camera.k5, camera.k6,
    ]
    .map(|number| number.0);
    let mut lens = Brown {
        width,
        height,
        cx: camera.c_x.0 * side + w / 2.0,
        cy: camera.c_y.0 * side + h / 2.0,
        ..Brown::default()
    };
    let both = camera.focal_x.zip(camera.focal_y);
    let one = camera.focal.map(|focal| (focal, focal));
    let focal = match camera.projection_type.as_str() {
        "perspective" | "fisheye" => one,
        _ => both,
    };
    match camera.projection_type.as_str() {
        "spherical" | "equirectangular" => return Ok(SourceCamera::panorama(width, height)),
        "simple_radial" => lens.radial[0] = k1,
        "perspective" | "radial" | "fisheye" => lens.radial[..2].copy_from_slice(&[k1, k2]),
        "brown" => {
            lens.radial[..3].copy_from_slice(&[k1, k2, k3]);
            lens.tangential = [camera.p1.0, camera.p2.0];
        }
        "fisheye_opencv" => lens.radial[..4].copy_from_slice(&[k1, k2, k3, k4]),
        "fisheye62" | "fisheye624" => {
            lens.radial = [k1, k2, k3, k4, k5, k6];
            lens.tangential = [camera.p1.0, camera.p2.0];
            if camera.projection_type == "fisheye624" {
                lens.prism = [camera.s0, camera.s1, camera.s2, camera.s3].map(|number| number.0);
            }
        }
        other => return Err(format!("has the unsupported projection {other:?}")),
    }
    lens.fisheye = camera.projection_type.starts_with("fisheye");
    let Some((fx, fy)) = focal else {
        return Err("has no focal length".into());
    };
    lens.fx = fx.0 * side;
    lens.fy = fy.0 * side;
    Ok(lens.into())
}
