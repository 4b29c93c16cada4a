//! The proxy mesh: which file it is, and reading it.

use std::path::{Path, PathBuf};

use ign_geometry::{Mesh, MeshError, read_mesh};

use crate::fault::{Faults, error_chain};
use crate::import::ImportOptions;
use crate::settings::{self, Settings};

/// Proxies that are looked for, in this order.
const PROXY_NAMES: [&str; 3] = ["mesh.ply", "mesh.obj", "mesh.glb"];

/// The proxy's path inside the capture: the caller's, the settings', or one of the usual names.
pub(crate) fn find_proxy(
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
            "put the proxy there as mesh.ply or mesh.obj, in the frame of the reconstruction, or name it in capture.toml",
        );
    }
    found
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
