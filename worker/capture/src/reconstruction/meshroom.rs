//! Meshroom's and `AliceVision`'s `sfm.json` and `cameras.sfm`.
//!
//! Views name an intrinsic and a pose; a pose is the rotation from the world, column by column, and the camera's
//! centre. Camera axes are ours. Numbers are mostly written as text. Several versions of the format differ:
//!
//! | version | |
//! |---|---|
//! | below 1.2.0 | one focal length in pixels, `pxFocalLength` |
//! | below 1.2.1 | principal point from the top-left corner; from there on from the picture's centre |
//! | below 1.2.2 | two focal lengths in pixels |
//! | 1.2.2 to 1.2.4 | `focalLength` in millimetres for `sensorWidth`; `pixelRatio` is fx / fy |
//! | from 1.2.5 | `pixelRatio` is the pixels' own, fy / fx |
//!
//! Source: `AliceVision`, `sfmDataIO/CHANGES.md` and `jsonIO.cpp`.

use std::collections::BTreeMap;
use std::f64::consts::TAU;

use glam::{DAffine3, DMat3, DVec2, DVec3};
use serde::Deserialize;

use super::json::{self, Id, List, Number, numbers};
use super::photo_index::PhotoIndex;
use super::{Model, ModelImage, ModelPoint, pose};
use crate::distortion::{Brown, CameraModel, SourceCamera};
use crate::fault::Faults;

const AGAIN: &str = "export the cameras again with ConvertSfMFormat, or copy the file again";
const LENS_HINT: &str =
    "use one of Meshroom's pinhole, radial1, radial3, brown, fisheye1 or fisheye4 cameras";

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct SfmData {
    #[serde(default)]
    version: List<Number>,
    #[serde(default)]
    views: List<View>,
    #[serde(default)]
    intrinsics: List<Intrinsic>,
    #[serde(default)]
    poses: List<Pose>,
    #[serde(default)]
    rigs: List<Rig>,
    #[serde(default)]
    structure: List<Landmark>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct View {
    #[serde(rename = "viewId")]
    id: Id,
    pose_id: Option<Id>,
    intrinsic_id: Option<Id>,
    rig_id: Option<Id>,
    sub_pose_id: Option<Number>,
    /// The spelling is the format's.
    #[serde(alias = "isPoseIndependant")]
    is_pose_independent: Option<TrueOrFalse>,
    path: String,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Intrinsic {
    #[serde(rename = "intrinsicId")]
    id: Id,
    width: Number,
    height: Number,
    #[serde(rename = "type")]
    kind: String,
    px_focal_length: Option<OneOrTwo>,
    focal_length: Option<Number>,
    sensor_width: Option<Number>,
    pixel_ratio: Option<Number>,
    #[serde(default)]
    principal_point: List<Number>,
    distortion_type: Option<String>,
    undistortion_type: Option<String>,
    #[serde(default)]
    distortion_params: List<Number>,
}

#[derive(Deserialize)]
#[serde(untagged)]
enum OneOrTwo {
    One(Number),
    Two([Number; 2]),
}

#[derive(Deserialize)]
#[serde(untagged)]
enum TrueOrFalse {
    Value(bool),
    Text(String),
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Pose {
    pose_id: Id,
    pose: Placed,
}

#[derive(Deserialize)]
struct Placed {
    transform: Transform,
}

#[derive(Deserialize)]
struct Transform {
    rotation: List<Number>,
    center: List<Number>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Rig {
    rig_id: Id,
    #[serde(default)]
    sub_poses: List<SubPose>,
}

#[derive(Deserialize)]
struct SubPose {
    pose: Transform,
}

#[derive(Deserialize)]
struct Landmark {
    #[serde(rename = "X")]
    position: List<Number>,
    #[serde(default)]
    color: List<Number>,
    #[serde(default)]
    observations: List<Observation>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Observation {
    /// The view's id.
    observation_id: Id,
    /// Pixel, where features were saved.
    #[serde(default)]
    x: List<Number>,
}

impl View {
    /// The pose is the rig's, not the view's own.
    fn is_of_rig(&self) -> bool {
        let independent = match &self.is_pose_independent {
            None => true,
            Some(TrueOrFalse::Value(value)) => *value,
            Some(TrueOrFalse::Text(text)) => text != "false" && text != "0",
        };
        self.rig_id.is_some() && !independent
    }
}

impl Transform {
    /// Camera from world.
    fn rigid(&self) -> Result<DAffine3, &'static str> {
        let rotation =
            numbers::<9>(&self.rotation.0).ok_or("has a rotation that is no 3x3 matrix")?;
        let center = numbers::<3>(&self.center.0).ok_or("has a centre that is no 3-vector")?;
        let camera_from_world = DMat3::from_cols_array(&rotation);
        pose::camera_from_world(camera_from_world.transpose(), DVec3::from_array(center))
    }
}

pub(super) fn parse(
    bytes: &[u8],
    shown: &str,
    photographs: &PhotoIndex,
    faults: &mut Faults,
) -> Model {
    let mut model = Model::default();
    let Some(data) = json::read::<SfmData>(bytes, shown, faults) else {
        return model;
    };
    let errors_before = faults.error_count();
    let version = numbers::<3>(&data.version.0).unwrap_or([1.0, 0.0, 0.0]);
    let mut camera_ids = BTreeMap::new();
    for intrinsic in &data.intrinsics.0 {
        let id = &intrinsic.id;
        let camera = source_camera(intrinsic, version).and_then(super::sound);
        let camera = match camera {
            Ok(camera) => Some(camera),
            Err(message) => {
                faults.error(
                    format!("intrinsic {} {message}", id.0),
                    format!("{shown} (intrinsic {})", id.0),
                    LENS_HINT,
                );
                None
            }
        };
        camera_ids.insert(id, model.push_camera(camera));
    }
    let poses: BTreeMap<&Id, &Transform> = data
        .poses
        .0
        .iter()
        .map(|pose| (&pose.pose_id, &pose.pose.transform))
        .collect();
    let rigs: BTreeMap<&Id, &[SubPose]> = data
        .rigs
        .0
        .iter()
        .map(|rig| (&rig.rig_id, rig.sub_poses.0.as_slice()))
        .collect();
    let mut image_ids = BTreeMap::new();
    let mut unaligned = 0;
    for view in &data.views.0 {
        // Views without a pose, or without intrinsics, were not aligned.
        let pose = view.pose_id.as_ref().and_then(|id| poses.get(id));
        let (Some(pose), Some(intrinsic)) = (pose, &view.intrinsic_id) else {
            unaligned += 1;
            continue;
        };
        let at = format!("{shown} (view {})", view.id.0);
        let name = match photographs.name_of(&view.path) {
            Ok(name) => name,
            Err(message) => {
                faults.error(
                    message,
                    at,
                    "the view's path must lead to one photograph in images/",
                );
                continue;
            }
        };
        let Some(&camera_id) = camera_ids.get(intrinsic) else {
            faults.error(
                format!(
                    "image {name} names intrinsic {}, which the file does not have",
                    intrinsic.0
                ),
                at,
                AGAIN,
            );
            continue;
        };
        let camera_from_world = pose.rigid().and_then(|pose| {
            if !view.is_of_rig() {
                return Ok(pose);
            }
            let index = view.sub_pose_id.map_or(0.0, |number| number.0);
            let sub_pose = view
                .rig_id
                .as_ref()
                .and_then(|id| rigs.get(id)?.get(index as usize))
                .ok_or("belongs to a rig that the file does not have")?;
            Ok(sub_pose.pose.rigid()? * pose)
        });
        match camera_from_world {
            Ok(camera_from_world) => {
                let mut image = ModelImage::new(name, camera_from_world, at);
                image.camera_id = camera_id;
                image_ids.insert(&view.id, model.push_image(image));
            }
            Err(message) => faults.error(format!("image {name} {message}"), at, AGAIN),
        }
    }
    if unaligned > 0 {
        faults.warning(
            format!(
                "{unaligned} of {} views were not aligned and are left out",
                data.views.0.len()
            ),
            shown,
            "nothing to do, unless they are needed",
        );
    }
    for (index, landmark) in data.structure.0.iter().enumerate() {
        let Some(position) = numbers::<3>(&landmark.position.0) else {
            faults.error(
                "a landmark has a position that is no 3-vector",
                format!("{shown} (landmark {index})"),
                AGAIN,
            );
            continue;
        };
        let position = DVec3::from_array(position);
        let (mut ids, mut errors) = (Vec::new(), Vec::new());
        for observation in &landmark.observations.0 {
            let Some(&id) = image_ids.get(&observation.observation_id) else {
                continue;
            };
            ids.push(id);
            if let Some([x, y]) = numbers::<2>(&observation.x.0) {
                errors.extend(model.reprojection_error(id, position, DVec2::new(x, y)));
            }
        }
        model.points.push(ModelPoint {
            position,
            color: numbers::<3>(&landmark.color.0)
                .unwrap_or_default()
                .map(|value| value as u8),
            error_px: super::mean(&errors),
            image_ids: ids,
        });
    }
    model.has_all_images = faults.error_count() == errors_before;
    model
}

fn source_camera(intrinsic: &Intrinsic, version: [f64; 3]) -> Result<SourceCamera, String> {
    let (width, height) = super::picture_size(intrinsic.width.0, intrinsic.height.0)?;
    let half = [f64::from(width) / 2.0, f64::from(height) / 2.0];
    let (fx, fy) = focal_lengths(intrinsic, version, f64::from(width))?;
    let [mut cx, mut cy] = numbers::<2>(&intrinsic.principal_point.0)
        .ok_or("has a principal point that is no pair of numbers")?;
    if version >= [1.0, 2.0, 1.0] {
        cx += half[0];
        cy += half[1];
    }
    if intrinsic.kind == "equirectangular" {
        let panorama = SourceCamera::panorama(width, height);
        let off = [
            fx - panorama.fx,
            fy - panorama.fy,
            cx - half[0],
            cy - half[1],
        ];
        // Half a pixel at the picture's edge.
        if off.iter().any(|pixels| pixels.abs() * TAU > 1.0) {
            return Err(
                "has a picture of less than the whole sphere, which is not supported".into(),
            );
        }
        return Ok(panorama);
    }
    let undistorts = intrinsic
        .undistortion_type
        .as_deref()
        .is_some_and(|kind| kind != "none");
    if undistorts {
        return Err("has an undistortion in place of a distortion, which is not supported".into());
    }
    let params: Vec<f64> = intrinsic.distortion_params.0.iter().map(|p| p.0).collect();
    let mut lens = Brown {
        width,
        height,
        fx,
        fy,
        cx,
        cy,
        ..Brown::default()
    };
    // The lens once was part of the type, and now stands beside it.
    let kind = match (
        intrinsic.kind.as_str(),
        intrinsic.distortion_type.as_deref(),
    ) {
        ("pinhole", Some(distortion)) => distortion,
        (kind, _) => kind,
    };
    match (kind, params.as_slice()) {
        ("none" | "pinhole", []) => {}
        ("radial1" | "radialk1", &[k1]) => lens.radial[0] = k1,
        ("radial3" | "radialk3", &[k1, k2, k3]) => {
            lens.radial[..3].copy_from_slice(&[k1, k2, k3]);
        }
        ("brown", &[k1, k2, k3, t1, t2]) => {
            lens.radial[..3].copy_from_slice(&[k1, k2, k3]);
            lens.tangential = [t1, t2];
        }
        ("fisheye" | "fisheye4", &[k1, k2, k3, k4]) => {
            lens.fisheye = true;
            lens.radial[..4].copy_from_slice(&[k1, k2, k3, k4]);
        }
        ("fisheye1", &[omega]) => {
            return SourceCamera::from_params(
                CameraModel::Fov,
                width,
                height,
                &[fx, fy, cx, cy, omega],
            )
            .ok_or_else(|| "has a field of view that is no number".into());
        }
        (
            "none" | "pinhole" | "radial1" | "radialk1" | "radial3" | "radialk3" | "brown"
            | "fisheye" | "fisheye4" | "fisheye1",
            params,
        ) => {
            return Err(format!(
                "has {} distortion parameters for {kind}",
                params.len()
            ));
        }
        (other, _) => return Err(format!("has the unsupported type {other:?}")),
    }
    Ok(lens.into())
}

/// fx and fy in pixels.
fn focal_lengths(
    intrinsic: &Intrinsic,
    version: [f64; 3],
    width: f64,
) -> Result<(f64, f64), String> {
    if version < [1.0, 2.0, 2.0] {
        return match intrinsic.px_focal_length {
            Some(OneOrTwo::One(Number(f))) => Ok((f, f)),
            Some(OneOrTwo::Two([Number(fx), Number(fy)])) => Ok((fx, fy)),
            None => Err("has no pxFocalLength".into()),
        };
    }
    let focal = intrinsic.focal_length.ok_or("has no focalLength")?.0;
    let sensor = intrinsic.sensor_width.ok_or("has no sensorWidth")?.0;
    let ratio = intrinsic.pixel_ratio.map_or(1.0, |number| number.0);
    let fx = focal / sensor * width;
    let fy = if version < [1.0, 2.0, 5.0] {
        fx / ratio
    } else {
        fx * ratio
    };
    Ok((fx, fy))
}
