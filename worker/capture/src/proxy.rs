//! The proxy mesh: which file it is, reading it, and building one where the capture has none.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use ign_geometry::{
    Mesh, MeshError, PointSurface, PointView, SeenPoint, coverage_map, read_mesh,
    surface_from_points,
};
use rayon::prelude::*;

use crate::fault::{Faults, ImportError, error_chain};
use crate::import::ImportOptions;
use crate::photographs::Candidate;
use crate::reconstruction::Model;
use crate::resample::load;
use crate::scene::Mask;
use crate::settings::{self, Settings};

/// Proxies that are looked for, in this order.
const PROXY_NAMES: [&str; 5] = ["mesh.ply", "mesh.obj", "mesh.glb", "mesh.gltf", "mesh.stl"];

/// Long side, in pixels, of the masks that a proxy is built with and judged by.
const MASK_PX: u32 = 256;
/// Points with a larger reprojection error, in pixels, build nothing.
const POINT_ERROR_PX: f64 = 4.0;
/// A built proxy must agree with the masks: median over the views of intersection by union.
const LEAST_IOU: f64 = 0.9;
/// Without masks: longest boundary of a built proxy, see [`PointSurface::raggedness`].
const MOST_RAGGED: f64 = 8.0;
/// Without masks: largest distance between neighbouring points, as a share of the proxy's radius.
const MOST_SPACING: f64 = 0.06;
/// Share of the points that must be usable, masks or not.
const LEAST_USABLE: f64 = 0.2;

/// How to make a mesh, from within the capture folder.
const MAKE_ONE: &str = "put mesh.ply (or .obj, .glb, .gltf, .stl) there, in the frame of the model, or name it in \
    capture.toml; COLMAP makes one with these commands in the capture folder: \
    colmap image_undistorter --image_path images --input_path sparse/0 --output_path dense && \
    colmap patch_match_stereo --workspace_path dense && \
    colmap stereo_fusion --workspace_path dense --output_path dense/fused.ply && \
    colmap poisson_mesher --input_path dense/fused.ply --output_path mesh.ply; or, without a GPU and coarser: \
    colmap delaunay_mesher --input_type sparse --input_path sparse/0 --output_path mesh.ply";

/// Where the proxy comes from.
pub(crate) enum Proxy {
    /// A file, by its path inside the capture.
    File(PathBuf),
    /// One was named that cannot be used; reported.
    Faulty,
    /// The capture has none.
    None,
}

/// Finds the proxy inside the capture: the caller's, the settings', or one of the usual names.
pub(crate) fn find_proxy(
    dir: &Path,
    options: &ImportOptions,
    settings: &Settings,
    faults: &mut Faults,
) -> Proxy {
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
            return Proxy::Faulty;
        }
        if !dir.join(&path).is_file() {
            faults.error(
                format!("the proxy {} is missing", path.display()),
                at,
                "check the name: it is a path inside the capture folder; where none is named, one is built from the \
                 model's points",
            );
            return Proxy::Faulty;
        }
        return Proxy::File(path);
    }
    PROXY_NAMES
        .iter()
        .map(PathBuf::from)
        .find(|name| dir.join(name).is_file())
        .map_or(Proxy::None, Proxy::File)
}

/// Builds a proxy from the model's points, with the words that say what was done; `None` with a fault where they do
/// not suffice.
///
/// "Suffice" is measured: with masks, the silhouettes must agree with them; without, the points must be dense and the
/// surface whole, because nothing else tells where the object ends.
pub(crate) fn build_proxy(
    model: &Model,
    candidates: &[Candidate],
    faults: &mut Faults,
) -> Option<(Mesh, String)> {
    let mut missing = |reason: &str| {
        faults.error(
            format!("the proxy mesh is missing{reason}"),
            PROXY_NAMES[0],
            MAKE_ONE,
        );
    };
    // A panorama has no pinhole camera before the object is known.
    let used: Vec<&Candidate> = candidates
        .iter()
        .filter(|(view, _)| !view.source.is_panorama())
        .collect();
    if model.points.is_empty() || used.is_empty() {
        missing("");
        return None;
    }
    let views: Result<Vec<PointView>, ImportError> = used
        .par_iter()
        .map(|(view, _)| {
            let whole = view.camera.intrinsics;
            let scale = (f64::from(MASK_PX) / f64::from(whole.width.max(whole.height))).min(1.0);
            let side = |pixels: u32| ((f64::from(pixels) * scale).round() as u32).max(1);
            let camera = view
                .camera
                .with_intrinsics(whole.resized(side(whole.width), side(whole.height)));
            let mask = match &view.mask {
                None => None,
                Some(mask) => {
                    let loaded = load(view, &camera)?;
                    // Alpha that hides nothing is no mask.
                    let shows_all = *mask == Mask::Alpha && !loaded.alpha_hides;
                    loaded.image.mask.filter(|_| !shows_all)
                }
            };
            Ok(PointView { camera, mask })
        })
        .collect();
    let views = match views {
        Ok(views) => views,
        Err(error) => {
            missing(&format!(" and none can be built: {}", error_chain(&error)));
            return None;
        }
    };
    let points = seen_points(model, &used);
    let built = match surface_from_points(&points, &views) {
        Ok(built) => built,
        Err(error) => {
            missing(&format!(
                ", and the model's points do not suffice to build one: {error}"
            ));
            return None;
        }
    };
    match verdict(&built, &views, model.points.len()) {
        Ok(agreement) => {
            let words = format!(
                "the capture has no mesh: a proxy of {} triangles was built from {} of the model's {} points; {agreement}",
                built.mesh.triangles.len(),
                built.points,
                model.points.len()
            );
            faults.warning(
                words.as_str(),
                PROXY_NAMES[0],
                "good for a draft; a mesh from dense stereo or a scan makes sharper results",
            );
            Some((built.mesh, words))
        }
        Err(reason) => {
            missing(&format!(
                ", and the model's points do not suffice to build one: {reason}"
            ));
            None
        }
    }
}

fn seen_points(model: &Model, views: &[&Candidate]) -> Vec<SeenPoint> {
    let view_of_image: BTreeMap<u32, usize> = views
        .iter()
        .enumerate()
        .map(|(index, (_, id))| (*id, index))
        .collect();
    model
        .points
        .iter()
        .filter(|point| point.error_px.is_none_or(|error| error <= POINT_ERROR_PX))
        .map(|point| {
            let mut views: Vec<usize> = point
                .image_ids
                .iter()
                .filter_map(|id| view_of_image.get(id).copied())
                .collect();
            views.sort_unstable();
            views.dedup();
            SeenPoint {
                position: point.position,
                color: point.color,
                views,
            }
        })
        .collect()
}

/// How well a built proxy fits, in words, or why it does not do.
fn verdict(built: &PointSurface, views: &[PointView], points: usize) -> Result<String, String> {
    let usable = built.points as f64 / points.max(1) as f64;
    if usable < LEAST_USABLE {
        return Err(format!(
            "only {} of {points} lie on one object",
            built.points
        ));
    }
    let mut agreements: Vec<f64> = views
        .par_iter()
        .filter_map(|view| {
            let mask = view.mask.as_ref()?;
            let drawn = coverage_map(&built.mesh, &view.camera, 1, 2);
            let sum = |pick: fn(f32, f32) -> f32| -> f64 {
                let pairs = drawn.iter().zip(mask);
                pairs.map(|(a, b)| f64::from(pick(*a, *b))).sum()
            };
            Some(sum(f32::min) / sum(f32::max).max(f64::MIN_POSITIVE))
        })
        .collect();
    agreements.sort_by(f64::total_cmp);
    if let Some(&median) = agreements.get(agreements.len() / 2) {
        return if median >= LEAST_IOU {
            Ok(format!(
                "its silhouettes agree with the masks to {:.1} % in the median view",
                median * 100.0
            ))
        } else {
            Err(format!(
                "the surface through them agrees with the masks to only {:.0} % in the median view, {:.0} % are needed",
                median * 100.0,
                LEAST_IOU * 100.0
            ))
        };
    }
    let (_, radius) = built.mesh.bounding_sphere();
    let spacing = built.spacing / radius;
    if spacing > MOST_SPACING {
        return Err(format!(
            "they lie {:.1} % of the object's radius apart, {:.0} % is the most that will do",
            spacing * 100.0,
            MOST_SPACING * 100.0
        ));
    }
    if built.raggedness > MOST_RAGGED {
        return Err(
            "the surface through them has more holes than substance, and there are no masks to close it by".into(),
        );
    }
    Ok(format!(
        "they lie {:.1} % of its radius apart, and without masks it ends where they end",
        spacing * 100.0
    ))
}

pub(crate) fn load_proxy(dir: &Path, proxy: &Path, faults: &mut Faults) -> Option<Mesh> {
    let error = match read_mesh(&dir.join(proxy)) {
        Ok(mesh) => return Some(mesh),
        Err(error) => error,
    };
    let proxy = proxy.display().to_string();
    // The error's own path is the one on this machine: say the one in the capture.
    let (message, at) = match error {
        MeshError::Malformed { at, reason, .. } => (reason, format!("{proxy} ({at})")),
        MeshError::Unusable { source, .. } => (error_chain(source.as_ref()), proxy),
        MeshError::UnknownFormat { .. } => ("it is no PLY, OBJ, STL, GLB or glTF".into(), proxy),
        other => (error_chain(&other), proxy),
    };
    faults.error(
        format!("the proxy mesh cannot be used: {message}"),
        at,
        "clean the mesh and export it again, for example as PLY or GLB",
    );
    None
}
