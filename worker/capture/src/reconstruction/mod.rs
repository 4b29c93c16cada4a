//! The reconstruction: cameras, poses and points, whichever program wrote them.
//!
//! Each format has a module that reads its files into a [`Model`] in our conventions (camera axes x right, y down, z
//! forward; pixels with the centre of the top-left one at (0.5, 0.5)). The formats that are a single file have one
//! pure function from the file's bytes to the model and its faults.
//!
//! Files are recognised by what is in them. Where a capture holds several reconstructions, the first in the order of
//! [`Format`] is taken, and a warning names the others; `reconstruction` in capture.toml decides otherwise.

mod bundler;
mod colmap;
mod detect;
mod json;
mod meshroom;
mod metashape;
mod opensfm;
mod photo_index;
mod pose;
mod reality_capture;
mod transforms;
mod xml;

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::path::{Path, PathBuf};

use glam::{DAffine3, DVec2, DVec3};

use crate::distortion::SourceCamera;
use crate::fault::{Fault, Faults};
use crate::settings::{self, Settings};

use photo_index::PhotoIndex;

/// Formats of reconstructions, in the order in which they are preferred.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Format {
    /// COLMAP's sparse model: a folder.
    Colmap,
    /// `transforms.json` of nerfstudio and instant-ngp.
    Transforms,
    /// Agisoft Metashape's cameras as XML.
    Metashape,
    /// `RealityCapture`'s and `RealityScan`'s internal and external camera parameters as CSV.
    RealityCapture,
    /// Meshroom's and `AliceVision`'s `sfm.json` and `cameras.sfm`.
    Meshroom,
    /// `OpenSfM`'s and `OpenDroneMap`'s `reconstruction.json`.
    OpenSfm,
    /// Bundler's `bundle.out` with the list of its images.
    Bundler,
}

impl fmt::Display for Format {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Colmap => "COLMAP model",
            Self::Transforms => "transforms.json",
            Self::Metashape => "Metashape XML",
            Self::RealityCapture => "RealityCapture CSV",
            Self::Meshroom => "Meshroom file",
            Self::OpenSfm => "OpenSfM reconstruction",
            Self::Bundler => "Bundler file",
        })
    }
}

/// A reconstruction that was found: its format, and its file or folder inside the capture.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
struct Found {
    format: Format,
    path: PathBuf,
}

/// Reads the capture's reconstruction. Everything wrong with it goes into `faults`.
pub(crate) fn read(dir: &Path, settings: &Settings, faults: &mut Faults) -> Model {
    let Some(Found { format, path }) = choose(dir, settings, faults) else {
        return Model::default();
    };
    if format == Format::Colmap {
        return colmap::read(dir, &path, faults);
    }
    let Some(bytes) = load(dir, &path, faults) else {
        return Model::default();
    };
    let shown = path.display().to_string();
    let photographs = PhotoIndex::of_capture(dir);
    match format {
        Format::Transforms => {
            let folder = path.parent().unwrap_or(Path::new(""));
            let (mut model, points) =
                transforms::parse(&bytes, &shown, folder, &photographs, faults);
            if let Some(points) = points {
                transforms::read_points(dir, &points, &mut model, faults);
            }
            model
        }
        Format::Bundler => {
            let Some(list) = bundler::find_list(dir, &path) else {
                faults.error(
                    "the list of images is missing",
                    path.with_file_name("list.txt").display().to_string(),
                    "put list.txt beside the Bundler file: one photograph per line, in the cameras' order",
                );
                return Model::default();
            };
            let Some(list) = load(dir, &list, faults) else {
                return Model::default();
            };
            let list = String::from_utf8_lossy(&list);
            bundler::parse(&bytes, &list, &shown, &photographs, faults)
        }
        _ => parse(format, &bytes, &shown, &photographs, faults),
    }
}

/// The formats that are one file.
fn parse(
    format: Format,
    bytes: &[u8],
    shown: &str,
    photographs: &PhotoIndex,
    faults: &mut Faults,
) -> Model {
    match format {
        Format::Metashape => metashape::parse(bytes, shown, photographs, faults),
        Format::RealityCapture => reality_capture::parse(bytes, shown, photographs, faults),
        Format::Meshroom => meshroom::parse(bytes, shown, photographs, faults),
        Format::OpenSfm => opensfm::parse(bytes, shown, photographs, faults),
        Format::Transforms => transforms::parse(bytes, shown, Path::new(""), photographs, faults).0,
        Format::Bundler => bundler::parse(bytes, "", shown, photographs, faults),
        Format::Colmap => Model::default(),
    }
}

fn load(dir: &Path, path: &Path, faults: &mut Faults) -> Option<Vec<u8>> {
    std::fs::read(dir.join(path))
        .map_err(|error| {
            faults.error(
                format!("cannot read the file: {error}"),
                path.display().to_string(),
                "check its permissions",
            );
        })
        .ok()
}

/// The reconstruction to take: the one that capture.toml names, or the first that is there.
fn choose(dir: &Path, settings: &Settings, faults: &mut Faults) -> Option<Found> {
    if let Some((path, line)) = &settings.reconstruction {
        return named(
            dir,
            path,
            &format!("{}:{line}", settings::FILE_NAME),
            faults,
        );
    }
    let files = detect::files(dir);
    let has_colmap = colmap::is_there(dir, Path::new(colmap::FOLDER));
    // Without any, COLMAP's reader says what is missing.
    let model = (has_colmap || files.is_empty())
        .then(|| colmap::locate(dir, Path::new(colmap::FOLDER), faults))
        .flatten()
        .map(|path| Found {
            format: Format::Colmap,
            path,
        });
    let mut all = model.into_iter().chain(files);
    let taken = all.next()?;
    let others: Vec<String> = all
        .map(|other| format!("{} ({})", other.path.display(), other.format))
        .collect();
    if !others.is_empty() {
        faults.warning(
            format!(
                "the capture holds several reconstructions; the {} is used, left out: {}",
                taken.format,
                others.join(", ")
            ),
            taken.path.display().to_string(),
            "remove the others, or name the one to use in capture.toml: reconstruction = \"...\"",
        );
    }
    Some(taken)
}

/// The reconstruction at a path that capture.toml names.
fn named(dir: &Path, path: &Path, at: &str, faults: &mut Faults) -> Option<Found> {
    let full = dir.join(path);
    let found = if full.is_dir() {
        colmap::is_there(dir, path)
            .then(|| colmap::locate(dir, path, faults))
            .flatten()
            .map(|path| (Format::Colmap, path))
    } else {
        detect::format_of(dir, path).map(|format| (format, path.to_owned()))
    };
    if let Some((format, path)) = found {
        return Some(Found { format, path });
    }
    let message = if full.exists() {
        format!(
            "the reconstruction {} is of no known format",
            path.display()
        )
    } else {
        format!("the reconstruction {} is missing", path.display())
    };
    faults.error(message, at, FORMATS_HINT);
    None
}

/// What a capture may hold.
pub(crate) const FORMATS_HINT: &str = "export one of: a COLMAP model (sparse/0), transforms.json of nerfstudio or \
     instant-ngp, Metashape's cameras as XML, RealityCapture's internal/external camera parameters as CSV, Meshroom's \
     cameras.sfm or sfm.json, OpenSfM's reconstruction.json, Bundler's bundle.out with list.txt";

/// The files, by their paths inside the capture `dir`, that make up its reconstruction beside `sparse/`: those that
/// hold cameras, and the lists, points and masks that they name. Sorted; empty where there are none.
pub fn camera_files(dir: &Path) -> Vec<PathBuf> {
    let mut unheard = Faults::default();
    let settings = settings::read(dir, &mut unheard);
    let mut found = detect::files(dir);
    if settings.reconstruction.is_some() {
        found.extend(choose(dir, &settings, &mut unheard));
    }
    let mut files = BTreeSet::new();
    for Found { format, path } in found {
        match format {
            Format::Colmap => files.extend(colmap::files(dir, &path)),
            Format::Bundler => files.extend(bundler::find_list(dir, &path)),
            Format::Transforms => {
                if let Some(bytes) = load(dir, &path, &mut unheard) {
                    let folder = path.parent().unwrap_or(Path::new(""));
                    let nothing = PhotoIndex::default();
                    let (model, points) =
                        transforms::parse(&bytes, "", folder, &nothing, &mut unheard);
                    files.extend(points.map(|points| points.path));
                    files.extend(model.images.into_iter().filter_map(|image| image.mask_path));
                }
            }
            Format::Metashape | Format::RealityCapture | Format::Meshroom | Format::OpenSfm => {}
        }
        if format != Format::Colmap {
            files.insert(path);
        }
    }
    files
        .into_iter()
        .filter(|path| dir.join(path).is_file())
        .collect()
}

/// Judges a file of cameras by itself, as [`crate::import`] does within a capture: its format by its content, and
/// what is wrong with it. `photographs` are names below `images/` with width and height in pixels; Bundler's cameras
/// are taken to be theirs, one after the other.
pub fn check_cameras(
    bytes: &[u8],
    photographs: &[(String, (u32, u32))],
) -> (Option<Format>, Vec<Fault>) {
    let mut faults = Faults::default();
    let format = detect::format_of_bytes(bytes);
    let index = PhotoIndex::listed(photographs);
    let shown = "cameras";
    match format {
        None => faults.error("the file is of no known format", shown, FORMATS_HINT),
        Some(Format::Bundler) => {
            let names: Vec<&str> = photographs.iter().map(|(name, _)| name.as_str()).collect();
            let list = names.join("\n");
            bundler::parse(bytes, &list, shown, &index, &mut faults);
        }
        Some(format) => {
            parse(format, bytes, shown, &index, &mut faults);
        }
    }
    (format, faults.into_list())
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
    /// Its mask inside the capture, where the reconstruction names one.
    pub(crate) mask_path: Option<PathBuf>,
    /// Where it stands, for faults found later.
    pub(crate) at: String,
}

#[derive(Debug)]
pub(crate) struct ModelPoint {
    pub(crate) position: DVec3,
    pub(crate) color: [u8; 3],
    /// Mean reprojection error in pixels, where it is known.
    pub(crate) error_px: Option<f64>,
    /// Ids of the images that saw it; empty where tracks are not kept.
    pub(crate) image_ids: Vec<u32>,
}

impl ModelImage {
    /// Without ids: the model gives them.
    fn new(name: String, camera_from_world: DAffine3, at: String) -> Self {
        Self {
            id: 0,
            name,
            camera_id: 0,
            camera_from_world,
            mask_path: None,
            at,
        }
    }
}

impl Model {
    /// Enters a camera, or that it has a fault, and returns its id. A camera that equals the one before is the same.
    fn push_camera(&mut self, camera: Option<SourceCamera>) -> u32 {
        match self.cameras.last_key_value() {
            Some((&id, last)) if *last == camera && camera.is_some() => id,
            last => {
                let id = last.map_or(0, |(&id, _)| id) + 1;
                self.cameras.insert(id, camera);
                id
            }
        }
    }

    /// Enters an image whose camera is there, and returns its id: its place in the list, from 1.
    fn push_image(&mut self, image: ModelImage) -> u32 {
        let id = self.images.len() as u32 + 1;
        self.images.push(ModelImage { id, ..image });
        id
    }

    /// Distance in pixels between a point's image and where image `id` saw it. `None` where the camera is not known or
    /// cannot see there.
    fn reprojection_error(&self, id: u32, point: DVec3, seen: DVec2) -> Option<f64> {
        let image = self.images.get(id as usize - 1)?;
        let camera = self.cameras.get(&image.camera_id).copied().flatten()?;
        let px = camera.project(image.camera_from_world.transform_point3(point))?;
        Some(px.distance(seen))
    }
}

/// Mean of what is known, where anything is.
fn mean(errors: &[f64]) -> Option<f64> {
    (!errors.is_empty())
        .then(|| errors.iter().sum::<f64>() / errors.len() as f64)
        .filter(|mean| mean.is_finite())
}

/// Width and height in pixels, which some programs write with a decimal point; otherwise what is wrong, to follow the
/// camera's name.
fn picture_size(width: f64, height: f64) -> Result<(u32, u32), String> {
    let pixels = |side: f64| {
        (side.fract() == 0.0 && (1.0..=f64::from(u32::MAX)).contains(&side)).then_some(side as u32)
    };
    pixels(width)
        .zip(pixels(height))
        .ok_or_else(|| format!("has a picture size of {width}x{height}"))
}

/// A camera without a fault; otherwise what is wrong, to follow its name.
fn sound(camera: SourceCamera) -> Result<SourceCamera, String> {
    match camera.fault() {
        Some(message) => Err(message),
        None => Ok(camera),
    }
}

/// Enters a camera of a file that gives ids itself, or its fault.
fn add_camera(
    model: &mut Model,
    faults: &mut Faults,
    id: u32,
    at: &str,
    camera: Result<SourceCamera, (String, &'static str)>,
) {
    let checked = camera.and_then(|camera| {
        sound(camera).map_err(|message| {
            let hint = "re-export the model with sound intrinsics, for example as PINHOLE";
            (message, hint)
        })
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

#[cfg(test)]
mod tests;
