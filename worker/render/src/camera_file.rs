//! Camera files for `ign-worker render --cameras FILE`.
//!
//! A JSON list; every entry is one image:
//!
//! ```json
//! [{"name": "front", "width": 640, "height": 480,
//!   "fx": 600.0, "fy": 600.0, "cx": 320.0, "cy": 240.0,
//!   "camera_from_world": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 2]]}]
//! ```
//!
//! `camera_from_world` holds the rows of a 3x4 or 4x4 matrix (rotation and translation; the fourth row is 0 0 0 1)
//! from the capture's world into the camera: x right, y down, z forward. Pixels are continuous with the origin at the
//! top-left corner, so that the centre of the first pixel lies at (0.5, 0.5), as in COLMAP. `name` becomes the file
//! name of the image.

use std::path::{Path, PathBuf};

use glam::{DAffine3, DMat3, DVec3};
use ign_geometry::{Camera, CameraError, CameraIntrinsics};
use serde::Deserialize;

/// Longest side of an image, in pixels.
const MAX_SIDE: u32 = 16384;

/// Why a camera file cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum CameraFileError {
    /// The file cannot be read.
    #[error("cannot read the camera file {path}")]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        #[source]
        source: std::io::Error,
    },
    /// It is no list of cameras.
    #[error("the camera file is not of the documented form")]
    Json(#[from] serde_json::Error),
    /// The list is empty.
    #[error("the camera file lists no cameras")]
    Empty,
    /// A camera that is none.
    #[error("camera {name:?} cannot be used")]
    Camera {
        /// Its name in the file.
        name: String,
        /// What is wrong with it.
        #[source]
        source: CameraError,
    },
    /// A matrix of another form, or an image too large.
    #[error("camera {name:?}: {reason}")]
    Entry {
        /// Its name in the file.
        name: String,
        /// What is wrong with it.
        reason: String,
    },
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Entry {
    name: String,
    width: u32,
    height: u32,
    fx: f64,
    fy: f64,
    cx: f64,
    cy: f64,
    camera_from_world: Vec<[f64; 4]>,
}

/// Names and cameras (world frame) of a camera file.
///
/// # Errors
/// The file cannot be read, or as [`parse_cameras`].
pub fn read_cameras(path: &Path) -> Result<Vec<(String, Camera)>, CameraFileError> {
    let json = std::fs::read(path).map_err(|source| CameraFileError::Io {
        path: path.to_owned(),
        source,
    })?;
    parse_cameras(&json)
}

/// Names and cameras (world frame) of a camera file's content.
///
/// # Errors
/// The content is not of the form above, or names the camera that cannot be used and says why.
pub fn parse_cameras(json: &[u8]) -> Result<Vec<(String, Camera)>, CameraFileError> {
    let entries: Vec<Entry> = serde_json::from_slice(json)?;
    if entries.is_empty() {
        return Err(CameraFileError::Empty);
    }
    entries
        .into_iter()
        .map(|entry| Ok((entry.name.clone(), camera(entry)?)))
        .collect()
}

fn camera(entry: Entry) -> Result<Camera, CameraFileError> {
    let refused = |reason: String| CameraFileError::Entry {
        name: entry.name.clone(),
        reason,
    };
    if entry.width.max(entry.height) > MAX_SIDE {
        return Err(refused(format!(
            "its image has {}x{} pixels, at most {MAX_SIDE} on a side can be rendered",
            entry.width, entry.height
        )));
    }
    let [x, y, z] = match entry.camera_from_world.as_slice() {
        [x, y, z] | [x, y, z, [0.0, 0.0, 0.0, 1.0]] => [x, y, z],
        [_, _, _, _] => {
            return Err(refused(
                "the fourth row of camera_from_world is not 0 0 0 1".into(),
            ));
        }
        rows => {
            return Err(refused(format!(
                "camera_from_world has {} rows, expected 3 or 4",
                rows.len()
            )));
        }
    };
    let row = |row: &[f64; 4]| DVec3::new(row[0], row[1], row[2]);
    let camera_from_world = DAffine3 {
        matrix3: DMat3::from_cols(row(x), row(y), row(z)).transpose(),
        translation: DVec3::new(x[3], y[3], z[3]),
    };
    let intrinsics = CameraIntrinsics {
        fx: entry.fx,
        fy: entry.fy,
        cx: entry.cx,
        cy: entry.cy,
        width: entry.width,
        height: entry.height,
    };
    Camera::new(intrinsics, camera_from_world).map_err(|source| CameraFileError::Camera {
        name: entry.name,
        source,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn entry(matrix: &str) -> String {
        format!(
            r#"[{{"name":"a","width":6,"height":4,"fx":5.0,"fy":7.0,"cx":2.5,"cy":2.0,"camera_from_world":{matrix}}}]"#
        )
    }

    #[test]
    fn rows_are_rows() {
        // A quarter turn about z: world x is camera y.
        for matrix in [
            "[[0,-1,0,1],[1,0,0,2],[0,0,1,3]]",
            "[[0,-1,0,1],[1,0,0,2],[0,0,1,3],[0,0,0,1]]",
        ] {
            let cameras = parse_cameras(entry(matrix).as_bytes()).unwrap();
            let camera = cameras[0].1;
            let in_camera = camera.camera_from_world.transform_point3(DVec3::X);
            assert!(in_camera.distance(DVec3::new(1.0, 3.0, 3.0)) < 1e-12);
            let seen = camera.project(DVec3::X).unwrap();
            // u = fx x / z + cx, v = fy y / z + cy
            assert!((seen.px.x - (5.0 / 3.0 + 2.5)).abs() < 1e-12);
            assert!((seen.px.y - 9.0).abs() < 1e-12);
        }
    }

    #[test]
    fn faults_name_the_camera_and_the_field() {
        for (text, message) in [
            ("[]".to_owned(), "no cameras"),
            ("{}".to_owned(), "expected a sequence"),
            (entry("[[1,0,0,0]]"), "has 1 rows"),
            (
                entry("[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,2]]"),
                "fourth row",
            ),
            (entry("[[2,0,0,0],[0,1,0,0],[0,0,1,0]]"), "camera \"a\""),
            (
                entry("[[1,0,0,0],[0,1,0,0],[0,0,1,0]]").replace('6', "4294967295"),
                "4294967295x4 pixels",
            ),
        ] {
            let error = parse_cameras(text.as_bytes()).unwrap_err();
            let source = std::error::Error::source(&error).map(ToString::to_string);
            let said = format!("{error}: {}", source.unwrap_or_default());
            assert!(said.contains(message), "{said}");
        }
    }
}
