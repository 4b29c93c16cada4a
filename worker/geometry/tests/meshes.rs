//! Mesh files that other implementations wrote (`tests/reference/make_meshes.py`): the same shape must come out of all.

use std::path::{Path, PathBuf};

use glam::DVec3;
use ign_geometry::{Camera, CameraIntrinsics, GBuffer, Mesh, MeshError, parse_mesh, read_mesh};

/// Files keep f32; the scene of pygltflib also transforms them, 40 units from the origin.
const TOLERANCE: f64 = 1e-5;

fn folder() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/reference/meshes")
}

#[derive(serde::Deserialize)]
struct Truth {
    positions: Vec<[f64; 3]>,
    triangles: Vec<[usize; 3]>,
    colors: Vec<[u8; 3]>,
}

impl Truth {
    fn read() -> Self {
        let text = std::fs::read_to_string(folder().join("truth.json")).expect("truth");
        serde_json::from_str(&text).expect("truth")
    }

    /// The truth's vertex at a place.
    fn vertex(&self, position: DVec3) -> usize {
        let distance = |at: &usize| position.distance(DVec3::from_array(self.positions[*at]));
        let nearest = (0..self.positions.len())
            .min_by(|a, b| distance(a).total_cmp(&distance(b)))
            .expect("vertices");
        assert!(
            distance(&nearest) < TOLERANCE,
            "{position} is {} off",
            distance(&nearest)
        );
        nearest
    }

    fn check(&self, file: &str, mesh: &Mesh, has_colors: bool) {
        let vertices: Vec<usize> = mesh.positions.iter().map(|p| self.vertex(*p)).collect();
        // Winding counts, the first corner does not.
        let canonical = |[a, b, c]: [usize; 3]| [[a, b, c], [b, c, a], [c, a, b]].into_iter().min();
        let sorted = |triangles: &mut dyn Iterator<Item = [usize; 3]>| {
            let mut triangles: Vec<_> = triangles.map(canonical).collect();
            triangles.sort_unstable();
            triangles
        };
        assert_eq!(
            sorted(
                &mut mesh
                    .triangles
                    .iter()
                    .map(|t| t.map(|v| vertices[v as usize]))
            ),
            sorted(&mut self.triangles.iter().copied()),
            "{file}"
        );
        let colors = mesh.colors.as_ref();
        assert_eq!(colors.is_some(), has_colors, "{file}");
        for (vertex, color) in vertices.iter().zip(colors.into_iter().flatten()) {
            for (channel, truth) in color.iter().zip(self.colors[*vertex]) {
                // Text files keep colours to a few digits.
                assert!(channel.abs_diff(truth) <= 1, "{file}: {color:?}");
            }
        }
        for [a, b, c] in &mesh.triangles {
            let [p, q, r] = [a, b, c].map(|corner| mesh.positions[*corner as usize]);
            let face = (q - p).cross(r - p);
            assert!(
                face.dot(mesh.normals[*a as usize]) > 0.0,
                "{file}: normals point outwards"
            );
        }
    }
}

#[test]
fn files_of_other_implementations_hold_the_same_shape() {
    let truth = Truth::read();
    // Open3D and trimesh store sRGB bytes in glTF's linear COLOR_0: there only the shape is compared.
    let mut foreign_colors = vec!["open3d.glb", "trimesh.glb", "trimesh.gltf"];
    for (file, has_colors) in [
        ("trimesh_binary.ply", true),
        ("trimesh_ascii.ply", true),
        ("open3d_binary.ply", true),
        ("open3d_ascii.ply", true),
        ("meshio_binary.ply", true),
        ("meshio_ascii.ply", true),
        ("plyfile_big_endian.ply", true),
        ("trimesh.obj", true),
        ("open3d.obj", true),
        ("meshio.obj", false),
        ("trimesh_binary.stl", false),
        ("trimesh_ascii.stl", false),
        ("open3d.stl", false),
        ("meshio.stl", false),
        ("pygltflib.glb", true),
        ("pygltflib.gltf", true),
        ("open3d.glb", false),
        ("trimesh.glb", false),
        ("trimesh.gltf", false),
    ] {
        let mut mesh =
            read_mesh(&folder().join(file)).unwrap_or_else(|error| panic!("{file}: {error}"));
        if let Some(at) = foreign_colors.iter().position(|name| *name == file) {
            assert!(mesh.colors.take().is_some(), "{file}");
            foreign_colors.remove(at);
        }
        truth.check(file, &mesh, has_colors);
        if Path::new(file)
            .extension()
            .is_some_and(|ending| ending == "stl")
        {
            assert_eq!(
                mesh.positions.len(),
                truth.positions.len(),
                "{file}: corners are merged"
            );
        }
    }
    assert!(foreign_colors.is_empty());
}

#[test]
fn the_content_decides_and_not_the_name() {
    let truth = Truth::read();
    let nothing_beside = |_: &Path| Err(std::io::ErrorKind::NotFound.into());
    for file in [
        "open3d_binary.ply",
        "open3d.obj",
        "open3d.stl",
        "trimesh_ascii.stl",
        "pygltflib.glb",
        "pygltflib.gltf",
    ] {
        let bytes = std::fs::read(folder().join(file)).expect("fixture");
        let mesh = parse_mesh(Path::new("model.bin"), &bytes, &nothing_beside).expect(file);
        truth.check(file, &mesh, mesh.colors.is_some());
    }
    // Binary STL whose free header begins like an ASCII one.
    let mut bytes = std::fs::read(folder().join("open3d.stl")).expect("fixture");
    bytes[..40].copy_from_slice(b"solid facet normal endsolid             ");
    let mesh = parse_mesh(Path::new("model.stl"), &bytes, &nothing_beside).expect("binary");
    truth.check("solid", &mesh, false);
    bytes.truncate(bytes.len() - 7);
    let error = parse_mesh(Path::new("model.stl"), &bytes, &nothing_beside).expect_err("short");
    assert!(
        error
            .to_string()
            .contains("its facet count asks for 4084 bytes"),
        "{error}"
    );
}

/// A glTF text with one triangle, for damage.
fn document(position: &str, buffer: &str, rest: &str) -> String {
    format!(
        r#"{{"asset":{{"version":"2.0"}},{rest}"scene":0,"scenes":[{{"nodes":[0]}}],"nodes":[{{"mesh":0}}],
        "meshes":[{{"primitives":[{{"attributes":{{"POSITION":0}}}}]}}],
        "accessors":[{{{position}"componentType":5126,"count":3,"type":"VEC3"}}],
        "bufferViews":[{{"buffer":0,"byteLength":36}}],"buffers":[{{"byteLength":36,{buffer}}}]}}"#
    )
}

#[test]
fn gltf_faults_name_the_part_and_files_outside_are_not_opened() {
    let triangle: Vec<u8> = [0.0_f32, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0]
        .iter()
        .flat_map(|number| number.to_le_bytes())
        .collect();
    let parse = |text: &str| {
        let open = |path: &Path| {
            assert!(
                path == Path::new("data/my mesh.bin"),
                "opened {}",
                path.display()
            );
            Ok(triangle.clone())
        };
        parse_mesh(Path::new("m.gltf"), text.as_bytes(), &open)
    };
    let view = r#""bufferView":0,"#;
    let uri = |name: &str| format!(r#""uri":"{name}""#);
    let good = document(view, &uri("data/my%20mesh.bin"), "");
    assert_eq!(parse(&good).expect("valid").triangles, [[0, 1, 2]]);
    for (text, words) in [
        (
            document(view, &uri("../mesh.bin"), ""),
            "no file in the mesh's own folder",
        ),
        (
            document(view, &uri("%2e%2e/mesh.bin"), ""),
            "no file in the mesh's own folder",
        ),
        (
            document(view, &uri("/etc/passwd"), ""),
            "no file in the mesh's own folder",
        ),
        (
            document(view, &uri("https://host/mesh.bin"), ""),
            "no file in the mesh's own folder",
        ),
        (
            document(view, &uri("file:///mesh.bin"), ""),
            "no file in the mesh's own folder",
        ),
        (
            document(view, &uri("data:application/octet-stream;base64,AA=="), ""),
            "has 1 bytes, expected 36",
        ),
        (
            good.replace(r#""count":3"#, r#""count":4000000000"#),
            "accessor 0: reaches beyond its buffer",
        ),
        (
            good.replace(view, "")
                .replace(r#""count":3"#, r#""count":4000000000"#),
            "has no data for 4000000000 elements",
        ),
        (
            good.replace(view, r#""bufferView":7,"#),
            "buffer view 7, which does not exist",
        ),
        (
            good.replace(r#""mesh":0"#, r#""mesh":0,"children":[0]"#),
            "node 0: has two parents",
        ),
        (
            good.replace("VEC3", "VEC2"),
            "accessor 0: has 2 components, expected 3",
        ),
        (
            good.replace("\"2.0\"", "\"1.0\""),
            "version \"1.0\", expected 2.0",
        ),
        (good.replace("[{\"nodes\"", "[{\"nodes"), "line 1"),
        (
            document(
                view,
                &uri("data/my%20mesh.bin"),
                r#""extensionsRequired":["KHR_draco_mesh_compression"],"#,
            ),
            "compressed with Draco; export it again without compression",
        ),
        (
            document(
                view,
                &uri("data/my%20mesh.bin"),
                r#""extensionsRequired":["EXT_meshopt_compression"],"#,
            ),
            "compressed with meshopt; export it again without compression",
        ),
    ] {
        let error = parse(&text).expect_err(words);
        assert!(
            matches!(error, MeshError::Malformed { .. }) && error.to_string().contains(words),
            "{error}"
        );
    }
}

#[test]
fn one_mesh_shown_very_often_is_refused_and_far_places_keep_their_digits() {
    let uri = r#""uri":"data:;base64,AAAAAAAAAAAAAAAAAACAPwAAAAAAAAAAAAAAAAAAgD8AAAAA""#;
    let good = document(r#""bufferView":0,"#, uri, "");
    let nothing = |_: &Path| Err(std::io::ErrorKind::NotFound.into());
    let parse = |text: &str| parse_mesh(Path::new("m.gltf"), text.as_bytes(), &nothing);
    let nodes = vec![r#"{"mesh":0}"#; 30_000].join(",");
    let names = (0..30_000)
        .map(|n| n.to_string())
        .collect::<Vec<_>>()
        .join(",");
    let many = good
        .replace(r#""nodes":[{"mesh":0}]"#, &format!(r#""nodes":[{nodes}]"#))
        .replace(r#""nodes":[0]"#, &format!(r#""nodes":[{names}]"#));
    assert_eq!(
        parse(&many).expect("a file that large may").triangles.len(),
        30_000
    );
    let big = format!(
        r#""primitives":[{}]"#,
        vec![r#"{"attributes":{"POSITION":0}}"#; 40].join(",")
    );
    let more = many.replace(r#""primitives":[{"attributes":{"POSITION":0}}]"#, &big);
    assert!(
        parse(&more)
            .expect_err("too many")
            .to_string()
            .contains("shows its meshes so often")
    );
    let far = good.replace(
        r#"{"mesh":0}"#,
        r#"{"mesh":0,"translation":[10000000.125,0,-10000000.25]}"#,
    );
    assert_eq!(
        parse(&far).expect("valid").positions[0],
        DVec3::new(10_000_000.125, 0.0, -10_000_000.25)
    );
}

/// What a mesh looks like from a general place, in its own normalised frame.
fn picture(mesh: &Mesh) -> GBuffer {
    let intrinsics = CameraIntrinsics {
        fx: 70.0,
        fy: 66.0,
        cx: 30.3,
        cy: 22.6,
        width: 64,
        height: 48,
    };
    let eye = DVec3::new(2.1, -1.3, 1.7);
    let camera = Camera::look_at(intrinsics, eye, DVec3::ZERO, DVec3::Z).expect("camera");
    GBuffer::render(&mesh.transformed(&mesh.normalisation()), &camera, 2)
}

#[test]
fn faults_that_change_nothing_do_not_change_the_picture() {
    let mesh = read_mesh(&folder().join("plyfile_big_endian.ply")).expect("fixture");
    let picture = |positions: &[DVec3], triangles: &[[u32; 3]]| {
        let mesh = Mesh::new(positions.to_vec(), triangles.to_vec()).expect("usable");
        self::picture(&mesh)
    };
    let sound = picture(&mesh.positions, &mesh.triangles);
    assert!(sound.mask.iter().filter(|covered| **covered).count() > 500);

    let mut repeated = mesh.triangles.clone();
    repeated.extend(mesh.triangles.iter().step_by(3).map(|&[a, b, c]| [b, a, c]));
    repeated.extend(mesh.triangles.iter().step_by(2).map(|&[a, b, c]| [c, a, b]));
    repeated.extend([[0, 0, 1], [5, 5, 5], [1, 2, 2]]);
    assert_eq!(
        picture(&mesh.positions, &repeated),
        sound,
        "duplicates and degenerate triangles"
    );

    let mut unused = mesh.positions.clone();
    unused.extend([DVec3::splat(1e7), DVec3::splat(-3.0)]);
    assert_eq!(picture(&unused, &mesh.triangles), sound, "unused vertices");

    // The same shape far away, tiny and huge: the same picture up to what f64 keeps of the coordinates.
    for (scale, offset) in [
        (1.0, 1e7),
        (1e-4, 0.0),
        (1e4, 0.0),
        (1e-30, 0.0),
        (1e30, 0.0),
    ] {
        let moved: Vec<DVec3> = mesh.positions.iter().map(|p| *p * scale + offset).collect();
        let seen = picture(&moved, &mesh.triangles);
        let differing = seen
            .mask
            .iter()
            .zip(&sound.mask)
            .filter(|(a, b)| a != b)
            .count();
        assert!(differing <= 2, "{scale} {offset}: {differing} pixels");
        for pixel in (0..sound.mask.len()).filter(|&pixel| seen.mask[pixel] && sound.mask[pixel]) {
            // A sample next to an edge may fall on its other side.
            if seen.triangle[pixel] == sound.triangle[pixel] {
                assert!((seen.depth[pixel] - sound.depth[pixel]).abs() < 1e-5);
            }
        }
    }
}

#[test]
fn holes_flipped_triangles_and_fins_stay_finite() {
    let mesh = read_mesh(&folder().join("plyfile_big_endian.ply")).expect("fixture");
    let mut broken = mesh.triangles.clone();
    broken.drain(10..20);
    for corners in broken.iter_mut().step_by(2) {
        corners.swap(0, 2);
    }
    // An edge of four triangles.
    let [a, b, _] = broken[0];
    broken.extend([[a, b, 30], [b, a, 35]]);
    let seen = picture(&Mesh::new(mesh.positions.clone(), broken).expect("usable"));
    let finite = |vectors: &[[f32; 3]]| vectors.iter().flatten().all(|number| number.is_finite());
    assert!(
        seen.depth
            .iter()
            .all(|depth| depth.is_finite() && *depth >= 0.0)
    );
    assert!(
        finite(&seen.position)
            && finite(&seen.normal)
            && finite(&seen.normal_fd)
            && finite(&seen.reflection)
    );
    let whole = picture(&mesh);
    let covered = |view: &GBuffer| view.mask.iter().filter(|covered| **covered).count();
    assert!(
        covered(&seen) * 10 > covered(&whole) * 8,
        "both sides are drawn"
    );
}
