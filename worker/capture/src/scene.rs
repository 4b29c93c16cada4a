//! What an import yields.

use std::path::PathBuf;

use glam::{DMat3, DVec3};
use ign_geometry::{Camera, Mesh};
use serde::{Deserialize, Serialize};

use crate::distortion::SourceCamera;
use crate::fault::Fault;
use crate::frame::Bounds;

/// A capture that can be worked with: every file it names was there and of the right size.
#[derive(Debug, Clone)]
pub struct Scene {
    /// Name of the object or, where `capture.toml` has none, of the folder.
    pub name: String,
    /// What the capture says about itself.
    pub info: CaptureInfo,
    /// The proxy, in the frame of the reconstruction ("world").
    pub mesh: Mesh,
    /// All views that see the proxy, in path order.
    pub views: Vec<View>,
    /// Indices of the views to train on, ascending.
    pub train: Vec<usize>,
    /// Indices of the views that are only ever compared with, ascending; disjoint from `train`.
    pub held_out: Vec<usize>,
    /// The model's points.
    pub points: Vec<Point>,
    /// What is doubtful, and what was left out.
    pub warnings: Vec<Fault>,
    /// What surrounds the object in the photographs.
    pub background: Background,
    /// Per view, the proxy's bounds inside the undistorted photograph.
    pub(crate) bounds: Vec<Bounds>,
}

/// What `capture.toml` and the folder say about the capture.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct CaptureInfo {
    /// `collection/object`.
    pub object: Option<String>,
    /// Title for people.
    pub title: Option<String>,
    /// Licence of the photographs.
    pub licence: Option<String>,
    /// Holder of the rights.
    pub rights: Option<String>,
    /// Metres per unit of the world frame, where known.
    pub metres_per_scene_unit: Option<f64>,
    /// The proxy's path inside the capture; none where it was built from the points.
    pub proxy: Option<PathBuf>,
    /// How the proxy was built, where the capture has none: words for people.
    pub proxy_built: Option<String>,
}

/// One photograph and its camera.
#[derive(Debug, Clone)]
pub struct View {
    /// The image name in the model, which is the path below `images/`.
    pub name: String,
    /// The undistorted pinhole camera: the photograph's size, focal lengths and principal point without its
    /// distortion, in the world frame. For a panorama, a pinhole camera at its centre that looks at the proxy.
    pub camera: Camera,
    /// The camera as the model has it, with distortion.
    pub source: SourceCamera,
    /// Rotation from the axes of `camera` to those of `source`; the identity for all but panoramas.
    pub source_from_camera: DMat3,
    /// How many columns the photograph is rolled to the left before it is looked at, so that a panorama's seam lies
    /// opposite the object; `source_from_camera` leads to the rolled picture. 0 for all but panoramas.
    pub(crate) rolled_columns: usize,
    /// The photograph.
    pub image_path: PathBuf,
    /// What says which part of it is the object, where something does.
    pub mask: Option<Mask>,
    /// What says which part of it counts neither as object nor as background: a hand, a stand. White is ignored.
    pub ignored: Option<MaskFile>,
}

/// The mask of an object.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Mask {
    /// A file in which white is the object.
    File(MaskFile),
    /// The photograph's own alpha channel, which is straight: colours are not multiplied by it in the file. They are
    /// when the view is loaded, in linear light.
    Alpha,
}

/// A mask in a file of its own.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct MaskFile {
    /// The file.
    pub path: PathBuf,
    /// Black stands for white and white for black.
    pub inverted: bool,
}

/// A point of the sparse reconstruction.
#[derive(Debug, Clone, PartialEq)]
pub struct Point {
    /// World frame.
    pub position: DVec3,
    /// 8-bit sRGB.
    pub color: [u8; 3],
    /// Mean reprojection error in pixels of the photographs, where the reconstruction tells.
    pub error_px: Option<f64>,
    /// Indices of the views that saw it, ascending; empty where the reconstruction keeps no tracks.
    pub views: Vec<usize>,
}

/// What surrounds the object in the photographs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Background {
    /// Masks are given, and the images are already black outside: the mask is the coverage that was multiplied into
    /// the colours in linear light.
    Black,
    /// Masks are given, and the photographs show some background.
    MaskedOut,
    /// No masks: only the proxy's silhouette says where the object is.
    Silhouette,
}
