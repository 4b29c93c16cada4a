//! Readers of mesh files: PLY, OBJ, STL, GLB and glTF, recognised by what they hold.
//!
//! Every reader takes bytes that nobody vouches for: counts and offsets in them are checked against what is really
//! there before anything is allocated, and no file that a mesh names is opened outside the mesh's own folder.

mod gltf;
mod obj;
mod ply;
mod points;
mod stl;

use std::path::{Component, Path};

use glam::DVec3;

pub use points::parse_points;

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

/// Opens a file that a mesh refers to, by its path relative to the mesh's folder.
pub type OpenBeside<'a> = dyn Fn(&Path) -> std::io::Result<Vec<u8>> + 'a;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Format {
    Ply,
    Obj,
    Stl,
    Glb,
    Gltf,
}

/// Bytes at the start of a file that are looked at to tell a text format.
const SNIFFED_BYTES: usize = 1 << 16;

impl Format {
    /// By content; by the name's ending where the content is none of ours, so that the reader can say what it misses.
    fn of(name: &Path, bytes: &[u8]) -> Option<Self> {
        Self::by_content(bytes).or_else(|| {
            let ending = name.extension()?.to_str()?.to_ascii_lowercase();
            Some(match ending.as_str() {
                "ply" => Self::Ply,
                "obj" => Self::Obj,
                "stl" => Self::Stl,
                "glb" => Self::Glb,
                "gltf" => Self::Gltf,
                _ => return None,
            })
        })
    }

    fn by_content(bytes: &[u8]) -> Option<Self> {
        if bytes.starts_with(b"ply\n") || bytes.starts_with(b"ply\r") {
            return Some(Self::Ply);
        }
        if bytes.starts_with(b"glTF") {
            return Some(Self::Glb);
        }
        // Before ASCII: the header of a binary STL may start with "solid", or with anything else.
        if stl::is_binary(bytes) {
            return Some(Self::Stl);
        }
        let text = String::from_utf8_lossy(&bytes[..bytes.len().min(SNIFFED_BYTES)]);
        let text = text.trim_start_matches('\u{feff}').trim_start();
        if text.starts_with('{') {
            return Some(Self::Gltf);
        }
        if text.starts_with("solid") && (text.contains("facet") || text.contains("endsolid")) {
            return Some(Self::Stl);
        }
        let first_word = text
            .lines()
            .filter_map(|line| line.split_whitespace().next())
            .find(|word| !word.starts_with('#'))?;
        obj::KEYWORDS.contains(&first_word).then_some(Self::Obj)
    }
}

/// Reads a mesh file: PLY, OBJ, STL, GLB or glTF.
///
/// The format is recognised by content, whatever the file is called. Faces with more than three corners become
/// triangle fans. Normals are the file's where it has usable ones, otherwise area-weighted. Files that a glTF names
/// are looked for in its own folder and below.
///
/// # Errors
/// [`MeshError`] names the file, and the line, byte, vertex, triangle or accessor.
pub fn read_mesh(path: &Path) -> Result<Mesh, MeshError> {
    let bytes = std::fs::read(path).map_err(|source| MeshError::Io {
        path: path.to_owned(),
        source,
    })?;
    let folder = path.parent().unwrap_or(Path::new(""));
    parse_mesh(path, &bytes, &|beside| std::fs::read(folder.join(beside)))
}

/// Parses the bytes of a mesh file; `name` is what errors call it. `open_beside` is asked for files that a glTF names,
/// always with a relative path that does not lead upwards.
///
/// Memory grows with the bytes that are there, not with the counts they claim.
///
/// # Errors
/// As [`read_mesh`].
pub fn parse_mesh(
    name: &Path,
    bytes: &[u8],
    open_beside: &OpenBeside<'_>,
) -> Result<Mesh, MeshError> {
    let format = Format::of(name, bytes).ok_or_else(|| MeshError::UnknownFormat {
        path: name.to_owned(),
    })?;
    let soup = match format {
        Format::Ply => ply::parse(bytes),
        Format::Obj => obj::parse(bytes),
        Format::Stl => stl::parse(bytes),
        Format::Glb => gltf::parse_binary(bytes, open_beside),
        Format::Gltf => gltf::parse_text(bytes, open_beside),
    };
    let soup = soup.map_err(|Fault { at, reason }| MeshError::Malformed {
        path: name.to_owned(),
        at,
        reason,
    })?;
    let mut mesh =
        Mesh::new(soup.positions, soup.triangles).map_err(|source| MeshError::Unusable {
            path: name.to_owned(),
            source: Box::new(source),
        })?;
    if let Some(normals) = &soup.normals {
        mesh.adopt_normals(normals);
    }
    mesh.colors = soup
        .colors
        .filter(|colors| colors.len() == mesh.positions.len());
    Ok(mesh)
}

/// Colours stored as real numbers, as bytes: in [0, 1] by the formats' documents, in [0, 255] in some files.
fn bytes_from_real_colors(colors: &[[f32; 3]]) -> Vec<[u8; 3]> {
    let scale = if colors.iter().flatten().any(|channel| *channel > 1.0) {
        1.0
    } else {
        255.0
    };
    colors
        .iter()
        .map(|color| color.map(|channel| (channel * scale).round() as u8))
        .collect()
}

/// A path that stays in the folder it is relative to.
fn stays_inside(path: &Path) -> bool {
    path.components().next().is_some()
        && path
            .components()
            .all(|part| matches!(part, Component::Normal(_) | Component::CurDir))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::{any, prop_assert, proptest};

    fn read(name: &str, bytes: &[u8]) -> Result<Mesh, MeshError> {
        let folder = tempfile::tempdir().expect("temporary folder");
        let path = folder.path().join(name);
        std::fs::write(&path, bytes).expect("write");
        read_mesh(&path)
    }

    fn message(error: &MeshError) -> String {
        let mut text = error.to_string();
        let mut source = std::error::Error::source(error);
        while let Some(inner) = source {
            text.push_str(": ");
            text.push_str(&inner.to_string());
            source = inner.source();
        }
        text
    }

    const ASCII: &str = "ply\nformat ascii 1.0\ncomment by hand\nelement vertex 5\nproperty double x\nproperty float y\n\
        property float z\nproperty float nx\nproperty float ny\nproperty float nz\nproperty uchar red\nproperty uchar green\n\
        property uchar blue\nelement edge 1\nproperty int a\nproperty int b\nelement face 2\nproperty uchar flags\n\
        property list uchar int vertex_indices\nend_header\n\
        0 0 0 0 0 2 255 0 0\n1 0 0 0 0 1 0 255 0\n1 1 0 0 0 1 0 0 255\n0 1 0 0 0 0 9 8 7\n0.5 0.5 2 1 0 0 1 2 3\n\
        0 1\n7 4 0 1 2 3\n7 3 0 1 4\n";

    #[test]
    fn ascii_ply_with_quads_normals_colors_and_other_elements() {
        let mesh = read("a.ply", ASCII.as_bytes()).expect("valid");
        assert_eq!(mesh.triangles, [[0, 1, 2], [0, 2, 3], [0, 1, 4]]);
        assert_eq!(mesh.positions[4], DVec3::new(0.5, 0.5, 2.0));
        assert_eq!(mesh.normals[0], DVec3::Z);
        assert_eq!(
            mesh.normals[3],
            DVec3::Z,
            "a zero normal is replaced by the faces'"
        );
        assert_eq!(mesh.normals[4], DVec3::X);
        assert_eq!(mesh.colors.as_ref().expect("colours")[3], [9, 8, 7]);
        assert_eq!(
            read("a.ply", ASCII.replace('\n', "\r\n").as_bytes()).expect("valid"),
            mesh
        );
    }

    fn binary(big: bool) -> Vec<u8> {
        let name = if big { "big" } else { "little" };
        let mut bytes = format!(
            "ply\nformat binary_{name}_endian 1.0\nelement vertex 4\nproperty double x\nproperty float y\n\
             property short z\nproperty list uchar uint extra\nelement face 1\nproperty list ushort uint vertex_index\n\
             end_header\n"
        )
        .into_bytes();
        macro_rules! put {
            ($number:expr) => {
                bytes.extend(if big {
                    $number.to_be_bytes()
                } else {
                    $number.to_le_bytes()
                })
            };
        }
        for (x, y, z) in [
            (0.1_f64, 0.0_f32, 0_i16),
            (1.0, 0.0, 0),
            (1.0, 1.0, -3),
            (0.0, 1.0, 0),
        ] {
            put!(x);
            put!(y);
            put!(z);
            bytes.push(1);
            put!(70_000_u32);
        }
        put!(4_u16);
        for corner in 0_u32..4 {
            put!(corner);
        }
        bytes
    }

    #[test]
    fn binary_ply_of_both_byte_orders() {
        for big in [false, true] {
            let mesh = read("b.ply", &binary(big)).expect("valid");
            assert_eq!(mesh.triangles, [[0, 1, 2], [0, 2, 3]]);
            assert_eq!(
                mesh.positions[0],
                DVec3::new(0.1, 0.0, 0.0),
                "doubles are read as doubles"
            );
            assert_eq!(mesh.positions[2], DVec3::new(1.0, 1.0, -3.0));
            assert_eq!(mesh.colors, None);
        }
    }

    #[test]
    fn obj_with_negative_indices_normals_and_colors() {
        let text = "# scan\nv 0 0 0 1 0 0\nv 1 0 0 0 1 0\nv 1 1 0 0 0 1\nv 0 1 0 1 1 1 # corner\nvn 0 0 -1\nvt 0 0\n\
            o thing\nusemtl m\nf 1//1 2//1 3/1/1 -1//-1\n";
        let mesh = read("c.obj", text.as_bytes()).expect("valid");
        assert_eq!(mesh.triangles, [[0, 1, 2], [0, 2, 3]]);
        assert!(mesh.normals.iter().all(|normal| *normal == -DVec3::Z));
        assert_eq!(mesh.colors.expect("colours")[2], [0, 0, 255]);
    }

    #[test]
    fn faults_name_file_and_place() {
        let fails = |name: &str, bytes: &[u8]| message(&read(name, bytes).expect_err("fault"));
        let truncated = binary(false);
        let text = fails("mesh.ply", &truncated[..truncated.len() - 3]);
        assert!(
            text.contains("mesh.ply, byte 2") && text.contains("ends before"),
            "{text}"
        );
        let text = fails(
            "mesh.ply",
            ASCII.replace("0.5 0.5 2", "nan 0.5 2").as_bytes(),
        );
        assert!(
            text.contains("vertex 4: position (NaN, 0.5, 2) is not finite"),
            "{text}"
        );
        let text = fails(
            "mesh.ply",
            ASCII.replace("1 1 0 0 0 1", "1 what 0 0 0 1").as_bytes(),
        );
        assert!(text.contains("line 23: \"what\" is no number"), "{text}");
        let text = fails(
            "mesh.ply",
            ASCII.replace("7 3 0 1 4", "7 3 0 1 -4").as_bytes(),
        );
        assert!(text.contains("line 28: face 1 names vertex -4"), "{text}");
        let text = fails(
            "mesh.ply",
            ASCII.replace("7 3 0 1 4", "7 3 0 1 5").as_bytes(),
        );
        assert!(
            text.contains("triangle 2 names vertex 5, but there are 5 vertices"),
            "{text}"
        );
        let text = fails(
            "mesh.ply",
            ASCII.replace("property double x\n", "").as_bytes(),
        );
        assert!(text.contains("no x, y, z"), "{text}");
        let text = fails(
            "mesh.ply",
            ASCII
                .replace("element vertex 5", "element vertex 99999999999999")
                .as_bytes(),
        );
        assert!(text.contains("line"), "{text}");
        let text = fails("mesh.ply", b"not a mesh");
        assert!(text.contains("line 1: expected \"ply\""), "{text}");
        let text = fails("mesh.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n");
        assert!(
            text.contains("mesh.obj, line 4: corner \"9\" names no vertex before it"),
            "{text}"
        );
        let text = fails("mesh.obj", b"v 0 0 0\nv 1 inf 0\n");
        assert!(
            text.contains("line 2: vertex 1 at (1, inf, 0) is not finite"),
            "{text}"
        );
        let text = fails("mesh.obj", b"");
        assert!(text.contains("points but no triangles"), "{text}");
        assert!(fails("mesh.fbx", b"Kaydara").contains("no PLY, OBJ, STL, GLB or glTF"));
        assert!(fails("mesh.stl", b"nothing").contains("too short for a binary STL"));
        assert!(matches!(
            read_mesh(Path::new("/nowhere/mesh.ply")),
            Err(MeshError::Io { .. })
        ));
    }

    proptest! {
        #[test]
        fn damaged_files_never_panic(place in 0_usize..8000, byte in any::<u8>(), kind in 0..7, cut in 0_usize..500) {
            let (name, mut bytes) = match kind {
                0 => ("a.ply", ASCII.as_bytes().to_vec()),
                1 => ("b.ply", binary(false)),
                2 => ("c.obj", b"v 0 0 0\nv 1 0 0\nvn 0 0 1\nv 0 1 0\nf 1//1 2//1 3//1\n".to_vec()),
                3 => ("d.stl", include_bytes!("../../tests/reference/meshes/trimesh_ascii.stl").to_vec()),
                4 => ("e.stl", include_bytes!("../../tests/reference/meshes/open3d.stl").to_vec()),
                5 => ("f.glb", include_bytes!("../../tests/reference/meshes/pygltflib.glb").to_vec()),
                _ => ("g.gltf", include_bytes!("../../tests/reference/meshes/pygltflib.gltf").to_vec()),
            };
            let length = bytes.len();
            bytes[place % length] = byte;
            bytes.truncate(length.saturating_sub(cut.saturating_sub(200)));
            if let Ok(mesh) = read(name, &bytes) {
                prop_assert!(mesh.positions.iter().chain(&mesh.normals).all(|vector| vector.is_finite()));
                let count = mesh.positions.len();
                prop_assert!(mesh.triangles.iter().flatten().all(|corner| (*corner as usize) < count));
            }
        }
    }
}
