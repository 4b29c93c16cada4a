//! Import and preflight: one walk over the capture folder that finds everything that is wrong with it.
//!
//! Photographs are only opened as far as their headers here (a handful is decoded to tell what the background is);
//! decoding all of them is [`crate::Scene::load_view`]'s work.

use std::collections::{BTreeMap, BTreeSet};
use std::io;
use std::path::{Path, PathBuf};

use glam::{DVec2, DVec3};
use ign_geometry::{Camera, CameraIntrinsics, Mesh, MeshError, NO_TRIANGLE, rasterize, read_mesh};
use image::{DynamicImage, ImageError};
use rayon::prelude::*;

use crate::colmap::{self, Model, ModelImage};
use crate::distortion::SourceCamera;
use crate::fault::{Fault, Faults, ImportError};
use crate::frame::Bounds;
use crate::photo;
use crate::scene::{Background, CaptureInfo, Point, Scene, View};
use crate::settings::{self, Settings};
use crate::split;

/// What the caller decides about an import.
#[derive(Debug, Clone, Default)]
pub struct ImportOptions {
    /// The proxy's path inside the capture, instead of the one the capture names.
    pub proxy: Option<PathBuf>,
}

/// File with the names of the held-out views.
const HELD_OUT_FILE: &str = "test.txt";

/// Proxies that are looked for, in this order.
const PROXY_NAMES: [&str; 3] = ["mesh.ply", "mesh.obj", "mesh.glb"];

/// Fewest views that something can be learned from.
const FEWEST_TRAINING_VIEWS: usize = 2;

/// Views that are decoded to tell what the background is.
const BACKGROUND_SAMPLES: usize = 8;

/// Photographs count as black outside their masks below this mean, of 255.
const BLACK_BELOW: f64 = 2.0;

/// A vertex this far outside the picture, as a share of its size, still counts for the object's bounds.
const BOUNDS_SLACK: f64 = 0.02;

/// Long side of the picture in which a view without a vertex inside is looked at again.
const SIGHT_RASTER_PX: u32 = 64;

/// Imports the capture in `dir`.
///
/// # Errors
/// [`ImportError::Faults`] with every fault found, when at least one of them is an error.
pub fn import(dir: &Path, options: &ImportOptions) -> Result<Scene, ImportError> {
    let mut faults = Faults::default();
    if !check_folder(dir, &mut faults) {
        return Err(ImportError::Faults(faults.into_list()));
    }
    let settings = settings::read(dir, &mut faults);
    let proxy = find_proxy(dir, options, &settings, &mut faults);
    let mesh = proxy
        .as_ref()
        .and_then(|proxy| load_proxy(dir, proxy, &mut faults));
    let model = match colmap::locate(dir, &mut faults) {
        Some(relative) => colmap::read(dir, &relative, &mut faults),
        None => Model::default(),
    };
    let registered = check_names(&model, &mut faults);
    // Of a model that was read in part, what seems to be missing in it tells nothing.
    let model_is_whole = model.has_all_images && registered.len() == model.images.len();
    let (candidates, has_masks) = check_photographs(dir, &model, &registered, &mut faults);
    if model_is_whole {
        report_unregistered(&dir.join("images"), &registered, &mut faults);
    }
    let held_out_names = held_out_names(dir, &settings, &registered, model_is_whole, &mut faults);
    // Counting views makes sense only when none of them is missing for another reason.
    let views_are_complete = !faults.has_errors();

    let Some(mesh) = mesh else {
        return Err(ImportError::Faults(faults.into_list()));
    };
    let views = keep_those_that_see(candidates, &mesh, proxy.as_deref(), &mut faults);
    let names: Vec<&str> = views
        .iter()
        .map(|(view, _, _)| view.name.as_str())
        .collect();
    let (train, held_out) = split(&names, held_out_names.as_ref());
    if views_are_complete && !faults.has_errors() {
        check_split(&train, &held_out, &mut faults);
    }
    let background = if has_masks {
        background(&views, settings.mask_is_background, &mut faults)
    } else {
        Background::Silhouette
    };
    if faults.has_errors() {
        return Err(ImportError::Faults(faults.into_list()));
    }

    let points = points(&model, &views);
    let (views, bounds) = views
        .into_iter()
        .map(|(view, _, bounds)| (view, bounds))
        .unzip();
    let folder = || {
        dir.canonicalize()
            .ok()?
            .file_name()?
            .to_str()
            .map(str::to_owned)
    };
    Ok(Scene {
        name: settings
            .object
            .clone()
            .or_else(folder)
            .unwrap_or_else(|| "capture".into()),
        info: CaptureInfo {
            object: settings.object,
            title: settings.title,
            licence: settings.licence,
            rights: settings.rights,
            metres_per_scene_unit: settings.metres_per_scene_unit,
            proxy: proxy.unwrap_or_default(),
        },
        mesh,
        views,
        train,
        held_out,
        points,
        warnings: faults.into_list(),
        background,
        mask_is_background: settings.mask_is_background,
        bounds,
    })
}

fn check_folder(dir: &Path, faults: &mut Faults) -> bool {
    let at = dir.display().to_string();
    match std::fs::read_dir(dir) {
        Err(error) => {
            faults.error(
                format!("cannot read the capture folder: {error}"),
                at,
                "name a folder with images/, sparse/ and a mesh",
            );
            false
        }
        Ok(mut entries) => {
            let empty = entries.next().is_none();
            if empty {
                faults.error(
                    "the capture folder is empty",
                    at,
                    "it must hold images/, a COLMAP model in sparse/0/ and the proxy mesh.ply",
                );
            }
            !empty
        }
    }
}

/// The proxy's path inside the capture: the caller's, the settings', or one of the usual names.
fn find_proxy(
    dir: &Path,
    options: &ImportOptions,
    settings: &Settings,
    faults: &mut Faults,
) -> Option<PathBuf> {
    let named = match (&options.proxy, &settings.proxy) {
        (Some(path), _) => Some((path.clone(), "the chosen proxy".to_owned())),
        (None, Some((path, line))) => {
            Some((path.clone(), format!("{}:{line}", settings::FILE_NAME)))
        }
        (None, None) => None,
    };
    if let Some((path, at)) = named {
        if !settings::is_inside(&path) {
            faults.error(
                format!("the proxy {} lies outside the capture", path.display()),
                at,
                "copy it into the capture folder and name it by its path in there",
            );
            return None;
        }
        if !dir.join(&path).is_file() {
            faults.error(
                format!("the proxy {} is missing", path.display()),
                at,
                "check the name: it is a path inside the capture folder",
            );
            return None;
        }
        return Some(path);
    }
    let found = PROXY_NAMES
        .iter()
        .map(PathBuf::from)
        .find(|name| dir.join(name).is_file());
    if found.is_none() {
        faults.error(
            "the proxy mesh is missing",
            PROXY_NAMES[0],
            "put the proxy there as mesh.ply or mesh.obj, in the frame of the COLMAP model, or name it in capture.toml",
        );
    }
    found
}

fn load_proxy(dir: &Path, proxy: &Path, faults: &mut Faults) -> Option<Mesh> {
    let error = match read_mesh(&dir.join(proxy)) {
        Ok(mesh) => return Some(mesh),
        Err(error) => error,
    };
    let proxy = proxy.display().to_string();
    // The error's own path is the one on this machine: say the one in the capture.
    let (message, at) = match error {
        MeshError::Malformed { at, reason, .. } => (reason, format!("{proxy} ({at})")),
        MeshError::Unusable { source, .. } => (error_chain(source.as_ref()), proxy),
        MeshError::UnknownFormat { .. } => ("it is neither PLY nor OBJ".into(), proxy),
        other => (error_chain(&other), proxy),
    };
    faults.error(
        format!("the proxy mesh cannot be used: {message}"),
        at,
        "clean the mesh and export it again as PLY or OBJ",
    );
    None
}

fn error_chain(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut source = error.source();
    while let Some(inner) = source {
        let inner_text = inner.to_string();
        if !text.contains(&inner_text) {
            text = format!("{text}: {inner_text}");
        }
        source = inner.source();
    }
    // Decoders end their messages with a full stop; ours go on behind them.
    text.trim_end_matches('.').to_owned()
}

/// The model's images by name, in path order, without those whose entry is faulty by itself.
fn check_names<'a>(model: &'a Model, faults: &mut Faults) -> Vec<&'a ModelImage> {
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
type Candidate = (View, u32);

/// The views whose camera, photograph and mask are in order, and whether there are masks.
fn check_photographs(
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
    let has_masks =
        mask_folder && std::fs::read_dir(&masks).is_ok_and(|mut entries| entries.next().is_some());
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

fn report_unregistered(images: &Path, registered: &[&ModelImage], faults: &mut Faults) {
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
            "nothing to do, unless COLMAP should have registered them",
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
        mask_path = photo::find_mask(&dir.join("masks"), &image.name);
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
                "use the pictures that COLMAP was run on, at their full size",
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

/// Names of held-out views that the model has; `None` where the capture names none.
fn held_out_names(
    dir: &Path,
    settings: &Settings,
    registered: &[&ModelImage],
    model_is_whole: bool,
    faults: &mut Faults,
) -> Option<BTreeSet<String>> {
    let from_file = read_held_out(dir, faults);
    let listed = match (from_file, &settings.held_out) {
        (Some(file), Some(list)) => {
            let names = |list: &[(String, usize)]| {
                list.iter()
                    .map(|(name, _)| name.clone())
                    .collect::<BTreeSet<_>>()
            };
            if names(&file) != names(list) {
                faults.error(
                    format!(
                        "held-out views are named by {HELD_OUT_FILE} and {} and differ",
                        settings::FILE_NAME
                    ),
                    HELD_OUT_FILE,
                    "keep one of the two lists",
                );
            }
            (file, HELD_OUT_FILE)
        }
        (Some(file), None) => (file, HELD_OUT_FILE),
        (None, Some(list)) => (list.clone(), settings::FILE_NAME),
        (None, None) => return None,
    };
    let (names, file) = listed;
    if names.is_empty() {
        faults.warning(
            "the list of held-out views is empty; every eighth view is held out",
            file,
            "name some views, or remove the list",
        );
        return None;
    }
    let known: BTreeSet<&str> = registered.iter().map(|image| image.name.as_str()).collect();
    let mut kept = BTreeSet::new();
    for (name, line) in names {
        let at = format!("{file}:{line}");
        if known.contains(name.as_str()) {
            kept.insert(name);
        } else if !model_is_whole {
            // It may well be in the part that could not be read.
        } else if settings::is_inside(Path::new(&name)) && dir.join("images").join(&name).is_file()
        {
            faults.warning(
                format!("held-out view {name} is not in the model and is left out"),
                at,
                "COLMAP did not register this photograph",
            );
        } else {
            let alike = known
                .iter()
                .find(|other| Path::new(other).file_stem() == Path::new(&name).file_stem());
            let hint = match alike {
                Some(alike) => format!("is {alike} meant?"),
                None => "names are those of the model's images, one per line".into(),
            };
            faults.error(format!("held-out view {name} is unknown"), at, hint);
        }
    }
    Some(kept)
}

/// The lines of `test.txt` with their numbers.
fn read_held_out(dir: &Path, faults: &mut Faults) -> Option<Vec<(String, usize)>> {
    match std::fs::read_to_string(dir.join(HELD_OUT_FILE)) {
        Ok(text) => {
            let lines = text
                .lines()
                .zip(1..)
                .map(|(line, number)| (line.trim().to_owned(), number));
            Some(
                lines
                    .filter(|(line, _)| !line.is_empty() && !line.starts_with('#'))
                    .collect(),
            )
        }
        Err(error) if error.kind() == io::ErrorKind::NotFound => None,
        Err(error) => {
            faults.error(
                format!("cannot read the file: {error}"),
                HELD_OUT_FILE,
                "one image name per line, UTF-8",
            );
            None
        }
    }
}

/// What a view sees of the proxy.
enum Sight {
    Seen(Bounds),
    Behind,
    OutsidePicture,
    FromInside,
}

/// A view with its id in the model and the proxy's bounds in its picture.
type SeeingView = (View, u32, Bounds);

fn keep_those_that_see(
    candidates: Vec<Candidate>,
    mesh: &Mesh,
    proxy: Option<&Path>,
    faults: &mut Faults,
) -> Vec<SeeingView> {
    let total = candidates.len();
    let used: BTreeSet<u32> = mesh.triangles.iter().flatten().copied().collect();
    let vertices: Vec<DVec3> = used
        .iter()
        .map(|&index| mesh.positions[index as usize])
        .collect();
    let sights: Vec<Sight> = candidates
        .par_iter()
        .map(|(view, _)| sight(view, mesh, &vertices))
        .collect();
    let mut kept = Vec::with_capacity(total);
    let mut blind = Faults::default();
    for ((view, id), sight) in candidates.into_iter().zip(sights) {
        let (message, hint) = match sight {
            Sight::Seen(bounds) => {
                kept.push((view, id, bounds));
                continue;
            }
            Sight::Behind => ("the proxy lies behind the camera", "check the view's pose"),
            Sight::OutsidePicture => (
                "the proxy lies outside the picture",
                "check the view's pose",
            ),
            Sight::FromInside => (
                "the camera stands inside the proxy",
                "check the view's pose, or trim the mesh",
            ),
        };
        blind.warning(
            format!("{message}; the view is left out"),
            format!("view {}", view.name),
            hint,
        );
    }
    if kept.is_empty() && total > 0 {
        faults.error(
            format!("none of the {total} views sees the proxy"),
            proxy
                .map(|path| path.display().to_string())
                .unwrap_or_default(),
            "the mesh must be in the frame of the COLMAP model: same origin, axes and scale",
        );
    } else {
        faults.extend(blind.into_list());
    }
    kept
}

/// `vertices` are those of the mesh that some triangle uses.
fn sight(view: &View, mesh: &Mesh, vertices: &[DVec3]) -> Sight {
    if encloses(mesh, vertices, view.camera.center()) {
        return Sight::FromInside;
    }
    let size = DVec2::new(f64::from(view.source.width), f64::from(view.source.height));
    let picture = Bounds {
        min: DVec2::ZERO,
        max: size,
    };
    let slack = size * BOUNDS_SLACK;
    let mut bounds = Bounds {
        min: DVec2::INFINITY,
        max: DVec2::NEG_INFINITY,
    };
    let (mut some_in_front, mut some_behind, mut some_inside) = (false, false, false);
    for &position in vertices {
        let in_camera = view.camera.camera_from_world.transform_point3(position);
        if in_camera.z <= 0.0 {
            some_behind = true;
            continue;
        }
        some_in_front = true;
        let ray = DVec2::new(in_camera.x, in_camera.y) / in_camera.z;
        let Some(px) = view.source.project(ray) else {
            continue;
        };
        if px.cmpge(-slack).all() && px.cmple(size + slack).all() {
            some_inside = true;
            let i = &view.camera.intrinsics;
            let undistorted = DVec2::new(i.fx * ray.x + i.cx, i.fy * ray.y + i.cy);
            bounds.min = bounds.min.min(undistorted);
            bounds.max = bounds.max.max(undistorted);
        }
    }
    match (some_in_front, some_inside) {
        (false, _) => Sight::Behind,
        // Triangles that reach behind the camera may cover more than their other vertices show.
        (true, true) => Sight::Seen(if some_behind { picture } else { bounds }),
        (true, false) => {
            // Large triangles may cross the picture with all vertices outside.
            let i = &view.camera.intrinsics;
            let shrink = f64::from(SIGHT_RASTER_PX) / size.max_element();
            let small = |side: f64| ((side * shrink).ceil() as u32).max(1);
            let camera = Camera {
                intrinsics: i.resized(small(size.x), small(size.y)),
                camera_from_world: view.camera.camera_from_world,
            };
            let raster = rasterize(mesh, &camera);
            if raster
                .triangle
                .iter()
                .any(|&triangle| triangle != NO_TRIANGLE)
            {
                Sight::Seen(picture)
            } else {
                Sight::OutsidePicture
            }
        }
    }
}

/// Whether the surface closes around `point`: its solid angle seen from there, more than half of the full sphere.
fn encloses(mesh: &Mesh, vertices: &[DVec3], point: DVec3) -> bool {
    let corner = |pick: fn(DVec3, DVec3) -> DVec3| vertices.iter().copied().reduce(pick);
    let (Some(min), Some(max)) = (corner(DVec3::min), corner(DVec3::max)) else {
        return false;
    };
    if !(point.cmpge(min).all() && point.cmple(max).all()) {
        return false;
    }
    let vertex = |index: u32| mesh.positions[index as usize] - point;
    let solid_angle: f64 = mesh
        .triangles
        .iter()
        .map(|&[a, b, c]| {
            // Van Oosterom and Strackee, 1983.
            let (a, b, c) = (vertex(a), vertex(b), vertex(c));
            let (la, lb, lc) = (a.length(), b.length(), c.length());
            let volume = a.dot(b.cross(c));
            2.0 * volume.atan2(la * lb * lc + a.dot(b) * lc + b.dot(c) * la + c.dot(a) * lb)
        })
        .sum();
    solid_angle.abs() > 2.0 * std::f64::consts::PI
}

/// Indices of training and held-out views.
fn split(names: &[&str], held_out: Option<&BTreeSet<String>>) -> (Vec<usize>, Vec<usize>) {
    let chosen: BTreeSet<usize> = match held_out {
        Some(listed) => (0..names.len())
            .filter(|&view| listed.contains(names[view]))
            .collect(),
        None => split::every_eighth(names.len()).into_iter().collect(),
    };
    (0..names.len()).partition(|view| !chosen.contains(view))
}

fn check_split(train: &[usize], held_out: &[usize], faults: &mut Faults) {
    let count = train.len();
    if count == 0 && !held_out.is_empty() {
        faults.error(
            format!("all {} views are held out", held_out.len()),
            HELD_OUT_FILE,
            "leave most views for training: every eighth is a good share",
        );
    } else if count < FEWEST_TRAINING_VIEWS {
        faults.error(
            format!(
                "{count} training views are too few, at least {FEWEST_TRAINING_VIEWS} are needed"
            ),
            "images/",
            "take more photographs around the object, or hold out fewer",
        );
    }
}

/// What surrounds the object, by decoding a few views with their masks.
fn background(views: &[SeeingView], mask_is_background: bool, faults: &mut Faults) -> Background {
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

/// The model's points with tracks in terms of the views that were kept.
fn points(model: &Model, views: &[SeeingView]) -> Vec<Point> {
    let view_of_image: BTreeMap<u32, usize> = views
        .iter()
        .enumerate()
        .map(|(index, &(_, id, _))| (id, index))
        .collect();
    let point = |point: &colmap::ModelPoint| {
        let seen_by: BTreeSet<usize> = point
            .image_ids
            .iter()
            .filter_map(|id| view_of_image.get(id).copied())
            .collect();
        Point {
            position: point.position,
            color: point.color,
            error_px: point.error_px,
            views: seen_by.into_iter().collect(),
        }
    };
    model.points.iter().map(point).collect()
}
