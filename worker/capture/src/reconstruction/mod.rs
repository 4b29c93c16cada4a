//! The reconstruction: cameras, poses and points, whichever program wrote them.
//!
//! Each format has a module that finds its files in a capture and reads them into a [`Model`] in our conventions
//! (camera axes x right, y down, z forward; pixels with the centre of the top-left one at (0.5, 0.5)).

mod colmap;

use std::collections::BTreeMap;
use std::path::Path;

use glam::{DAffine3, DVec3};

use crate::distortion::SourceCamera;
use crate::fault::Faults;

/// Reads the capture's reconstruction. Everything wrong with it goes into `faults`.
pub(crate) fn read(dir: &Path, faults: &mut Faults) -> Model {
    match colmap::locate(dir, faults) {
        Some(relative) => colmap::read(dir, &relative, faults),
        None => Model::default(),
    }
}

/// A sparse model as read. Entries with faults are left out and were reported.
#[derive(Debug, Default)]
pub(crate) struct Model {
    /// By camera id; `None` where the camera was there but has a fault.
    pub(crate) cameras: BTreeMap<u32, Option<SourceCamera>>,
    pub(crate) images: Vec<ModelImage>,
    /// The list of images was read to its end, without a fault in it.
    pub(crate) has_all_images: bool,
    pub(crate) points: Vec<ModelPoint>,
}

#[derive(Debug)]
pub(crate) struct ModelImage {
    pub(crate) id: u32,
    pub(crate) name: String,
    pub(crate) camera_id: u32,
    pub(crate) camera_from_world: DAffine3,
    /// Where it stands, for faults found later.
    pub(crate) at: String,
}

#[derive(Debug)]
pub(crate) struct ModelPoint {
    pub(crate) position: DVec3,
    pub(crate) color: [u8; 3],
    /// Mean reprojection error in pixels.
    pub(crate) error_px: f64,
    /// Ids of the images that saw it.
    pub(crate) image_ids: Vec<u32>,
}

/// Enters a camera, or its fault.
pub(crate) fn add_camera(
    model: &mut Model,
    faults: &mut Faults,
    id: u32,
    at: &str,
    camera: Result<SourceCamera, (String, &'static str)>,
) {
    let checked = camera.and_then(|camera| match camera.fault() {
        Some(message) => Err((
            message,
            "re-export the model with sound intrinsics, for example as PINHOLE",
        )),
        None => Ok(camera),
    });
    let entry = match checked {
        Ok(camera) => Some(camera),
        Err((message, hint)) => {
            faults.error(format!("camera {id} {message}"), at, hint);
            None
        }
    };
    if model.cameras.insert(id, entry).is_some() {
        faults.error(
            format!("camera {id} is there twice"),
            at,
            "re-export the model",
        );
    }
}
