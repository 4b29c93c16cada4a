//! Import and preflight: one walk over the capture folder that finds everything that is wrong with it.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use crate::fault::{Faults, ImportError};
use crate::photographs::{check_names, check_photographs, look_at_some, report_unregistered};
use crate::proxy::{Proxy, build_proxy, find_proxy, load_proxy};
use crate::reconstruction::{self, Model};
use crate::scene::{CaptureInfo, Point, Scene};
use crate::settings;
use crate::sight::{SeeingView, keep_those_that_see};
use crate::split::{check_split, held_out_names, split};

/// What the caller decides about an import.
#[derive(Debug, Clone, Default)]
pub struct ImportOptions {
    /// The proxy's path inside the capture, instead of the one the capture names.
    pub proxy: Option<PathBuf>,
}

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
    let mut mesh = match &proxy {
        Proxy::File(path) => load_proxy(dir, path, &mut faults),
        Proxy::Faulty | Proxy::None => None,
    };
    let model = reconstruction::read(dir, &settings, &mut faults);
    let registered = check_names(&model, &mut faults);
    // Of a model that was read in part, what seems to be missing in it tells nothing.
    let model_is_whole = model.has_all_images && registered.len() == model.images.len();
    let candidates = check_photographs(dir, &model, &registered, settings.masks, &mut faults);
    if model_is_whole {
        report_unregistered(&dir.join("images"), &registered, &mut faults);
    }
    let mut proxy_built = None;
    if let Proxy::None = proxy
        && let Some((built, words)) = build_proxy(&model, &candidates, &mut faults)
    {
        mesh = Some(built);
        proxy_built = Some(words);
    }
    let proxy = match proxy {
        Proxy::File(path) => Some(path),
        Proxy::Faulty | Proxy::None => None,
    };
    let held_out_names = held_out_names(dir, &settings, &registered, model_is_whole, &mut faults);
    // Counting views makes sense only when none of them is missing for another reason.
    let views_are_complete = !faults.has_errors();

    let Some(mesh) = mesh else {
        return Err(ImportError::Faults(faults.into_list()));
    };
    let mut views = keep_those_that_see(candidates, &mesh, proxy.as_deref(), &mut faults);
    let names: Vec<&str> = views
        .iter()
        .map(|(view, _, _)| view.name.as_str())
        .collect();
    let (train, held_out) = split(&names, held_out_names.as_ref());
    if views_are_complete && !faults.has_errors() {
        check_split(&train, &held_out, &mut faults);
    }
    let background = look_at_some(&mut views, &mut faults);
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
            proxy,
            proxy_built,
        },
        mesh,
        views,
        train,
        held_out,
        points,
        warnings: faults.into_list(),
        background,
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
                "name a folder with images/, a reconstruction and a mesh",
            );
            false
        }
        Ok(mut entries) => {
            let empty = entries.next().is_none();
            if empty {
                faults.error(
                    "the capture folder is empty",
                    at,
                    "it must hold images/, a reconstruction (a COLMAP model in sparse/0/ or another format's file) and the proxy mesh.ply",
                );
            }
            !empty
        }
    }
}

/// The model's points with tracks in terms of the views that were kept.
fn points(model: &Model, views: &[SeeingView]) -> Vec<Point> {
    let view_of_image: BTreeMap<u32, usize> = views
        .iter()
        .enumerate()
        .map(|(index, &(_, id, _))| (id, index))
        .collect();
    let point = |point: &reconstruction::ModelPoint| {
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
