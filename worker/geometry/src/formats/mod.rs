//! Readers of mesh files.

mod obj;
mod ply;

use std::path::Path;

use glam::DVec3;

use crate::{Mesh, MeshError};

/// What a reader found, before it is checked as a mesh.
#[derive(Default)]
struct Soup {
    positions: Vec<DVec3>,
    normals: Option<Vec<DVec3>>,
    colors: Option<Vec<[u8; 3]>>,
    triangles: Vec<[u32; 3]>,
}

/// What is wrong with a file, and where.
struct Fault {
    at: String,
    reason: String,
}

impl Fault {
    fn new(at: impl Into<String>, reason: impl Into<String>) -> Self {
        Self {
            at: at.into(),
            reason: reason.into(),
        }
    }
}

/// Reads a mesh: PLY (ascii or binary of either byte order) or OBJ.
///
/// The format is recognised by content (`ply` in the first line) and otherwise by the ending `.obj`. Faces with more
/// than three corners become triangle fans. Normals are the file's where it has usable ones, otherwise area-weighted.
///
/// # Errors
/// [`MeshError`] names the file, and the line, byte or vertex.
pub fn read_mesh(path: &Path) -> Result<Mesh, MeshError> {
    let bytes = std::fs::read(path).map_err(|source| MeshError::Io {
        path: path.to_owned(),
        source,
    })?;
    let soup = if bytes.starts_with(b"ply") {
        ply::parse(&bytes)
    } else if path
        .extension()
        .is_some_and(|ending| ending.eq_ignore_ascii_case("obj"))
    {
        obj::parse(&bytes)
    } else if path
        .extension()
        .is_some_and(|ending| ending.eq_ignore_ascii_case("ply"))
    {
        Err(Fault::new("line 1", "expected \"ply\""))
    } else {
        return Err(MeshError::UnknownFormat {
            path: path.to_owned(),
        });
    };
    let soup = soup.map_err(|Fault { at, reason }| MeshError::Malformed {
        path: path.to_owned(),
        at,
        reason,
    })?;
    let unusable = |source| MeshError::Unusable {
        path: path.to_owned(),
        source: Box::new(source),
    };
    let mut mesh = Mesh::new(soup.positions, soup.triangles).map_err(unusable)?;
    if let Some(normals) = &soup.normals {
        mesh.adopt_normals(normals);
    }
    mesh.colors = soup.colors;
    Ok(mesh)
}
