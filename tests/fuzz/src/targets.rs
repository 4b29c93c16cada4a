//! The parsers, each as a plain function on the bytes of one file.
//!
//! Those of a capture run through `ign_capture::import`, with the other files of a sound capture around the damaged one:
//! what a target proves, it proves for what a museum can send.

use std::path::{Component, Path};
use std::sync::Arc;

use ign_bundle::{BundleError, metrics, pack, proxy, references, weights};
use ign_events::{Event, JobFile};
use ign_geometry::{parse_mesh, parse_points};
use ign_registry::Registry;
use object_store::ObjectStoreExt as _;
use object_store::memory::InMemory;

use crate::Target;
use crate::captures::{
    self, CAMERAS_TXT, Capture, IMAGES_TXT, MESH, NAMES, POINTS_TXT, SIZE, cameras_bin, check,
    encoded, images_bin, points_bin,
};

/// Import of the capture around the damaged file: photographs, rasters, threads.
const IMPORT: usize = 4 << 20;
/// What a decoder may hold beyond its pixels (`photo::decode`), and the capture around.
const DECODER: usize = (64 << 20) + IMPORT;
/// A glTF may show one mesh many times, up to a limit of vertices and triangles however small the file is.
const MESH_LIMIT: usize = 32 << 20;
/// JSON values: a byte such as a bracket may become a value of 32 bytes in a vector that doubles.
const JSON: usize = 128;

/// The one list of targets: every parser, the bytes that it may hold at once whatever the input, and those for each byte
/// of it. The dollar sign is handed in for the macro within.
macro_rules! targets {
    ($dollar:tt: $($name:ident, $base:expr, $each:expr;)*) => {
        /// Every target.
        pub const ALL: &[Target] = &[$(Target {
            name: stringify!($name),
            run: $name,
            base_bytes: $base,
            bytes_per_byte: $each,
        }),*];

        /// Calls a macro with the names of all targets.
        #[macro_export]
        macro_rules! for_all_targets {
            ($dollar each:ident) => { $dollar each! { $($name),* } };
        }
    };
}

targets! { $:
    colmap_cameras_txt, IMPORT, 64;
    colmap_images_txt, IMPORT, 64;
    colmap_points_txt, IMPORT, 64;
    colmap_cameras_bin, IMPORT, 64;
    colmap_images_bin, IMPORT, 64;
    colmap_points_bin, IMPORT, 64;
    transforms_json, IMPORT, JSON;
    metashape_xml, IMPORT, JSON;
    reality_capture_csv, IMPORT, JSON;
    meshroom_sfm, IMPORT, JSON;
    opensfm_json, IMPORT, JSON;
    bundler_out, IMPORT, JSON;
    capture_toml, IMPORT, JSON;
    test_txt, IMPORT, 64;
    photograph, DECODER, 64;
    mask, DECODER, 64;
    mesh_ply, 1 << 20, 64;
    mesh_obj, 1 << 20, 64;
    mesh_stl, 1 << 20, 64;
    mesh_glb, MESH_LIMIT, JSON;
    mesh_gltf, MESH_LIMIT, JSON;
    points_ply, 1 << 20, 64;
    bundle_json, 1 << 16, JSON;
    bundle_metrics, 1 << 16, JSON;
    bundle_views, 1 << 20, JSON;
    bundle_held_out, 1 << 16, JSON;
    bundle_image, 1 << 20, 64;
    bundle_proxy, 1 << 20, 64;
    bundle_weights, 1 << 16, 64;
    render_cameras, 1 << 16, JSON;
    recipe, 1 << 16, JSON;
    checkpoint, 1 << 16, 64;
    oci_manifest, 1 << 16, JSON;
    registry_version, 1 << 20, JSON;
    registry_state, 1 << 20, JSON;
    http_headers, 1 << 16, 16;
    submit_list, 1 << 20, 64;
    bag, 1 << 20, 64;
    ids, 1 << 16, 16;
    events, 1 << 16, JSON;
    job, 1 << 16, JSON;
}

thread_local! {
    static COLMAP_TEXT: Capture = Capture::new(&[
        ("sparse/0/cameras.txt", CAMERAS_TXT.as_bytes()),
        ("sparse/0/images.txt", IMAGES_TXT.as_bytes()),
        ("sparse/0/points3D.txt", POINTS_TXT.as_bytes()),
    ]);
    static COLMAP_BINARY: Capture = Capture::new(&[
        ("sparse/0/cameras.bin", &cameras_bin()),
        ("sparse/0/images.bin", &images_bin()),
        ("sparse/0/points3D.bin", &points_bin()),
    ]);
    static CAMERAS: Capture = Capture::new(&[("list.txt", NAMES.join("\n").as_bytes())]);
}

/// `sparse/0/cameras.txt`.
fn colmap_cameras_txt(bytes: &[u8]) {
    text_model("sparse/0/cameras.txt", bytes, CAMERAS_TXT);
}

/// `sparse/0/images.txt`.
fn colmap_images_txt(bytes: &[u8]) {
    text_model("sparse/0/images.txt", bytes, IMAGES_TXT);
}

/// `sparse/0/points3D.txt`.
fn colmap_points_txt(bytes: &[u8]) {
    text_model("sparse/0/points3D.txt", bytes, POINTS_TXT);
}

/// Imports with one damaged file, and mends it again for the next target.
fn text_model(path: &str, bytes: &[u8], sound: &str) {
    COLMAP_TEXT.with(|capture| {
        capture.import_with(path, bytes);
        capture.write(path, sound.as_bytes());
    });
}

/// `sparse/0/cameras.bin`.
fn colmap_cameras_bin(bytes: &[u8]) {
    binary_model("sparse/0/cameras.bin", bytes, &cameras_bin());
}

/// `sparse/0/images.bin`.
fn colmap_images_bin(bytes: &[u8]) {
    binary_model("sparse/0/images.bin", bytes, &images_bin());
}

/// `sparse/0/points3D.bin`.
fn colmap_points_bin(bytes: &[u8]) {
    binary_model("sparse/0/points3D.bin", bytes, &points_bin());
}

fn binary_model(path: &str, bytes: &[u8], sound: &[u8]) {
    COLMAP_BINARY.with(|capture| {
        capture.import_with(path, bytes);
        capture.write(path, sound);
    });
}

/// `transforms.json` of nerfstudio and instant-ngp.
fn transforms_json(bytes: &[u8]) {
    cameras("transforms.json", bytes);
}

/// Metashape's cameras.
fn metashape_xml(bytes: &[u8]) {
    cameras("cameras.xml", bytes);
}

/// `RealityCapture`'s registration.
fn reality_capture_csv(bytes: &[u8]) {
    cameras("cameras.csv", bytes);
}

/// Meshroom's `sfm.json`, `cameras.sfm`.
fn meshroom_sfm(bytes: &[u8]) {
    cameras("cameras.sfm", bytes);
}

/// `OpenSfM`'s `reconstruction.json`.
fn opensfm_json(bytes: &[u8]) {
    cameras("reconstruction.json", bytes);
}

/// `bundle.out`, beside a sound `list.txt`.
fn bundler_out(bytes: &[u8]) {
    cameras("bundle.out", bytes);
}

/// A file of cameras by itself, and as the only reconstruction of a capture.
fn cameras(path: &str, bytes: &[u8]) {
    let photographs = NAMES.map(|name| (name.to_owned(), SIZE));
    let (format, faults) = ign_capture::check_cameras(bytes, &photographs);
    assert!(format.is_some() || !faults.is_empty());
    CAMERAS.with(|capture| {
        capture.import_with(path, bytes);
        std::fs::remove_file(capture.dir().join(path)).expect("there");
    });
}

/// `capture.toml`.
fn capture_toml(bytes: &[u8]) {
    text_model("capture.toml", bytes, "");
}

/// `test.txt`.
fn test_txt(bytes: &[u8]) {
    text_model("test.txt", bytes, "");
}

/// A photograph: its header at import, its pixels when the view is loaded. It may change in between.
fn photograph(bytes: &[u8]) {
    replaced("images/a.png", bytes);
    COLMAP_TEXT.with(|capture| capture.write("images/a.png", &captures::photograph(0)));
}

/// A mask, likewise.
fn mask(bytes: &[u8]) {
    COLMAP_TEXT.with(|capture| {
        let white = image::GrayImage::from_pixel(SIZE.0, SIZE.1, image::Luma([255]));
        for name in NAMES {
            let path = format!("masks/{name}");
            capture.write(
                &path,
                &encoded(&white.clone().into(), image::ImageFormat::Png),
            );
        }
    });
    replaced("masks/a.png", bytes);
    COLMAP_TEXT
        .with(|capture| std::fs::remove_dir_all(capture.dir().join("masks")).expect("there"));
}

/// The file is damaged after the import, then before it.
fn replaced(path: &str, bytes: &[u8]) {
    COLMAP_TEXT.with(|capture| {
        let options = ign_capture::ImportOptions::default();
        let scene = ign_capture::import(capture.dir(), &options).expect("a sound capture");
        capture.write(path, bytes);
        check(&scene);
        capture.import_with(path, bytes);
    });
}

/// `mesh.ply`.
fn mesh_ply(bytes: &[u8]) {
    mesh("mesh.ply", bytes);
}

/// `mesh.obj`.
fn mesh_obj(bytes: &[u8]) {
    mesh("mesh.obj", bytes);
}

/// `mesh.stl`.
fn mesh_stl(bytes: &[u8]) {
    mesh("mesh.stl", bytes);
}

/// `mesh.glb`.
fn mesh_glb(bytes: &[u8]) {
    mesh("mesh.glb", bytes);
}

/// `mesh.gltf`, with the same 172 bytes in whatever file it names.
fn mesh_gltf(bytes: &[u8]) {
    mesh("mesh.gltf", bytes);
}

fn mesh(name: &str, bytes: &[u8]) {
    let beside = |path: &Path| {
        let plain = |part| matches!(part, Component::Normal(_) | Component::CurDir);
        assert!(path.components().all(plain), "{}", path.display());
        Ok(vec![0x3f; 172])
    };
    if let Ok(mesh) = parse_mesh(Path::new(name), bytes, &beside) {
        check_mesh(&mesh);
        let (center, radius) = mesh.bounding_sphere();
        assert!(
            center.is_finite() && radius.is_finite(),
            "{center} {radius}"
        );
    }
}

/// A file of points: `ply_file_path` of `transforms.json`.
fn points_ply(bytes: &[u8]) {
    for (position, _) in parse_points(bytes).into_iter().flatten() {
        assert!(position.is_finite(), "{position}");
    }
}

fn check_mesh(mesh: &ign_geometry::Mesh) {
    let count = mesh.positions.len();
    assert!(mesh.positions.iter().all(|position| position.is_finite()));
    assert!(mesh.normals.len() == count && !mesh.triangles.is_empty());
    assert!(
        mesh.normals
            .iter()
            .all(|normal| (normal.length() - 1.0).abs() < 1e-3)
    );
    assert!(
        mesh.triangles
            .iter()
            .flatten()
            .all(|corner| (*corner as usize) < count)
    );
}

/// `bundle.json`.
fn bundle_json(bytes: &[u8]) {
    drop(pack::parse_manifest(bytes));
}

/// `metrics.json`.
fn bundle_metrics(bytes: &[u8]) {
    drop(metrics::Metrics::from_json(bytes));
}

/// `references/views.json`, with a sound image for whatever file it names.
fn bundle_views(bytes: &[u8]) {
    let image = image::RgbaImage::from_pixel(SIZE.0, SIZE.1, image::Rgba([9, 8, 7, 255]));
    let image = encoded(&image.into(), image::ImageFormat::Png);
    views(bytes, &|_| Ok(image.clone()));
}

/// `held_out/views.json`.
fn bundle_held_out(bytes: &[u8]) {
    for view in references::decode_held_out(bytes).into_iter().flatten() {
        view.camera.intrinsics.validate().expect("a valid camera");
    }
}

/// An image of a bundle, by a sound `references/views.json`.
fn bundle_image(bytes: &[u8]) {
    views(VIEWS_JSON.as_bytes(), &|_| Ok(bytes.to_vec()));
}

fn views(json: &[u8], read: &dyn Fn(&str) -> Result<Vec<u8>, BundleError>) {
    for reference in references::decode(json, read).into_iter().flatten() {
        let pixels = reference.width as usize * reference.height as usize;
        assert_eq!(reference.rgba.len(), 4 * pixels);
        reference
            .camera
            .intrinsics
            .validate()
            .expect("a valid camera");
    }
}

/// One view of 8 by 6 pixels.
const VIEWS_JSON: &str = r#"{"views":[{"name":"a.png","file":"references/0000.png",
"intrinsics":{"fx":9.0,"fy":9.5,"cx":4.0,"cy":3.0,"width":8,"height":6},
"camera_from_world":[1,0,0,0, 0,1,0,0, 0,0,1,2],"size":[8,6],"crop":null,"exposure_gain":[1,1,1]}]}"#;

/// `proxy.glb`.
fn bundle_proxy(bytes: &[u8]) {
    if let Ok((mesh, _)) = proxy::decode(bytes) {
        let count = mesh.positions.len();
        assert!(
            mesh.positions
                .iter()
                .chain(&mesh.normals)
                .all(|vector| vector.is_finite())
        );
        assert!(
            mesh.triangles
                .iter()
                .flatten()
                .all(|corner| (*corner as usize) < count)
        );
    }
}

/// `effects.safetensors` and `composition.safetensors`.
fn bundle_weights(bytes: &[u8]) {
    for (name, tensor) in weights::decode("weights", bytes).into_iter().flatten() {
        let count: usize = tensor.shape.iter().product();
        assert_eq!(tensor.values.len(), count, "{name}");
        assert!(
            tensor.values.iter().all(|value| value.is_finite()),
            "{name}"
        );
    }
}

/// The file of `ign-worker render --cameras`.
fn render_cameras(bytes: &[u8]) {
    for (name, camera) in ign_render::parse_cameras(bytes).into_iter().flatten() {
        camera.intrinsics.validate().expect("valid intrinsics");
        assert!(camera.camera_from_world.is_finite(), "{name}");
    }
}

/// A recipe, as jobs carry it.
fn recipe(bytes: &[u8]) {
    ign_bake::fuzz::recipe(bytes);
}

/// A checkpoint of training.
fn checkpoint(bytes: &[u8]) {
    ign_bake::fuzz::checkpoint(bytes);
}

/// Manifests of captures and bundles.
fn oci_manifest(bytes: &[u8]) {
    if let Ok(manifest) = ign_proto::Manifest::decode(bytes) {
        let again = manifest.encode().expect("it was one");
        assert_eq!(
            ign_proto::Manifest::decode(&again).expect("encoded"),
            manifest
        );
    }
}

/// The bucket's record of a version.
fn registry_version(bytes: &[u8]) {
    rebuild("versions/museum/vase/v1.json", bytes);
}

/// The bucket's record of an object's aliases and retired versions.
fn registry_state(bytes: &[u8]) {
    rebuild("versions/museum/vase/state.json", bytes);
}

/// Reads a bucket back that holds one record.
fn rebuild(path: &str, bytes: &[u8]) {
    let store = Arc::new(InMemory::new());
    let rebuilt = futures::executor::block_on(async {
        store.put(&path.into(), bytes.to_vec().into()).await?;
        let registry = Registry::on(store).await.expect("a working store");
        Ok::<_, object_store::Error>(registry.rebuild().await)
    });
    let rebuilt = rebuilt.expect("stored").expect("read");
    // No manifest is there: a version is a fault whatever it says.
    assert!(rebuilt.versions.is_empty());
    assert_eq!(rebuilt.faults.len() + rebuilt.states.len(), 1);
}

/// Headers of requests: tokens and ranges.
fn http_headers(bytes: &[u8]) {
    ign_coordinator::fuzz::header(&String::from_utf8_lossy(bytes), 1000);
}

thread_local! {
    static FOLDER: tempfile::TempDir = tempfile::TempDir::with_prefix("ign-fuzz-").expect("a folder");
}

/// The list of `ignctl submit --manifest`.
fn submit_list(bytes: &[u8]) {
    FOLDER.with(|folder| {
        let path = folder.path().join("list.csv");
        std::fs::write(&path, bytes).expect("a file");
        ignctl::fuzz::list(&path);
    });
}

/// The payload manifest of a `BagIt` bag of one file.
fn bag(bytes: &[u8]) {
    FOLDER.with(|folder| {
        let bag = folder.path().join("bag");
        let write = |path: &str, bytes: &[u8]| {
            let path = bag.join(path);
            std::fs::create_dir_all(path.parent().expect("a folder")).expect("a folder");
            std::fs::write(path, bytes).expect("a file");
        };
        write(
            "bagit.txt",
            b"BagIt-Version: 1.0\nTag-File-Character-Encoding: UTF-8\n",
        );
        write("data/images/a 100%.png", b"abc");
        write("manifest-sha256.txt", bytes);
        ignctl::fuzz::bag(&bag);
    });
}

/// Identifiers, digests, grants and paths.
fn ids(bytes: &[u8]) {
    let Ok(text) = std::str::from_utf8(bytes) else {
        return;
    };
    if let Ok(path) = text.parse::<ign_proto::FilePath>() {
        let joined = Path::new("/folder").join(path.as_str());
        let plain = |part| matches!(part, Component::RootDir | Component::Normal(_));
        assert!(
            joined.starts_with("/folder") && joined.components().all(plain),
            "{}",
            joined.display()
        );
    }
    for parsed in [
        text.parse::<ign_proto::CollectionId>()
            .map(|id| id.to_string()),
        text.parse::<ign_proto::ObjectId>().map(|id| id.to_string()),
        text.parse::<ign_proto::WorkerId>().map(|id| id.to_string()),
        text.parse::<ign_proto::Digest>().map(|id| id.to_string()),
        text.parse::<ign_proto::ObjectName>()
            .map(|id| id.to_string()),
        text.parse::<ign_proto::Grant>()
            .map(|grant| grant.to_string()),
    ] {
        assert!(parsed.is_err() || parsed.is_ok_and(|parsed| parsed == text));
    }
    drop(text.parse::<ign_proto::JobId>());
}

/// Lines of a bake's events.
fn events(bytes: &[u8]) {
    for event in String::from_utf8_lossy(bytes)
        .lines()
        .filter_map(Event::from_line)
    {
        let line = event.to_line().expect("it was a line");
        assert!(Event::from_line(&line).is_some());
    }
}

/// `job.json`.
fn job(bytes: &[u8]) {
    drop(serde_json::from_slice::<JobFile>(bytes));
}

/// Sound inputs to start from, by target, for what is written in code; the corpus folder holds them as files.
///
/// # Panics
/// When an encoder fails.
pub fn seeds() -> Vec<(&'static str, &'static str, Vec<u8>)> {
    let picture = image::DynamicImage::from(image::RgbImage::from_fn(SIZE.0, SIZE.1, |x, y| {
        image::Rgb([30 * x as u8, 40 * y as u8, 7])
    }));
    let gray = image::DynamicImage::from(picture.to_luma8());
    let deep = image::DynamicImage::from(picture.to_rgb16());
    let png = |picture: &image::DynamicImage| encoded(picture, image::ImageFormat::Png);
    let nothing_beside = |_: &Path| Err(std::io::ErrorKind::NotFound.into());
    let mesh = parse_mesh(Path::new("mesh.ply"), MESH.as_bytes(), &nothing_beside).expect("a mesh");
    let weights = ign_bundle::Tensors::from([(
        "stem.weight".to_owned(),
        ign_bundle::Tensor {
            shape: vec![2, 3],
            values: vec![0.5, -1.0, 2.0, 0.0, 1e-3, 7.0],
        },
    )]);
    let precise =
        |precision| ign_bundle::weights::encode("weights", &weights, precision).expect("encoded");
    vec![
        ("colmap_cameras_txt", "four.txt", CAMERAS_TXT.into()),
        ("colmap_images_txt", "four.txt", IMAGES_TXT.into()),
        ("colmap_points_txt", "two.txt", POINTS_TXT.into()),
        ("colmap_cameras_bin", "two.bin", cameras_bin()),
        ("colmap_images_bin", "four.bin", images_bin()),
        ("colmap_points_bin", "two.bin", points_bin()),
        ("capture_toml", "all.toml", CAPTURE_TOML.into()),
        (
            "test_txt",
            "two.txt",
            b"# held out\na.png\n\nc.png\n".to_vec(),
        ),
        ("photograph", "rgb.png", png(&picture)),
        ("photograph", "deep.png", png(&deep)),
        (
            "photograph",
            "rgb.jpg",
            encoded(&picture, image::ImageFormat::Jpeg),
        ),
        (
            "photograph",
            "rgb.webp",
            encoded(&picture, image::ImageFormat::WebP),
        ),
        ("photograph", "bomb.png", bomb()),
        ("mask", "gray.png", png(&gray)),
        ("mask", "bomb.png", bomb()),
        ("mesh_ply", "ascii.ply", MESH.into()),
        ("mesh_ply", "binary.ply", binary_ply()),
        ("mesh_obj", "four.obj", MESH_OBJ.into()),
        ("bundle_views", "one.json", VIEWS_JSON.into()),
        ("bundle_image", "rgba.png", png(&picture.to_rgba8().into())),
        ("bundle_image", "bomb.png", bomb()),
        (
            "bundle_proxy",
            "four.glb",
            ign_bundle::proxy::encode(&mesh, &mesh.normalisation()).expect("encoded"),
        ),
        (
            "bundle_weights",
            "fp32.safetensors",
            precise(ign_bundle::Precision::Fp32),
        ),
        (
            "bundle_weights",
            "fp16.safetensors",
            precise(ign_bundle::Precision::Fp16),
        ),
        ("bundle_json", "bundle.json", BUNDLE_JSON.into()),
        ("bundle_metrics", "metrics.json", METRICS_JSON.into()),
        ("oci_manifest", "capture.json", oci()),
        ("ids", "collection", b"museum".to_vec()),
        ("ids", "object-name", b"museum/vase-12".to_vec()),
        ("ids", "path", b"images/0001 (copy).JPG".to_vec()),
        (
            "ids",
            "digest",
            ign_proto::Digest::of(b"x").to_string().into(),
        ),
        (
            "ids",
            "job",
            b"01a20254-c193-7000-8000-0123456789ab".to_vec(),
        ),
        ("events", "all.jsonl", EVENTS.into()),
        ("job", "job.json", JOB.into()),
    ]
}

/// A PNG whose header says 60,000 by 60,000 pixels.
fn bomb() -> Vec<u8> {
    let mut bytes = encoded(
        &image::GrayImage::new(600, 600).into(),
        image::ImageFormat::Png,
    );
    // Width, height and checksum of the header chunk.
    bytes[16..20].copy_from_slice(&60_000_u32.to_be_bytes());
    bytes[20..24].copy_from_slice(&60_000_u32.to_be_bytes());
    let checksum = !bytes[12..29].iter().fold(u32::MAX, |sum, byte| {
        (0..8).fold(sum ^ u32::from(*byte), |sum, _| {
            (sum >> 1) ^ (0xedb8_8320 * (sum & 1))
        })
    });
    bytes[29..33].copy_from_slice(&checksum.to_be_bytes());
    bytes
}

fn binary_ply() -> Vec<u8> {
    let mut bytes = b"ply\nformat binary_little_endian 1.0\nelement vertex 4\nproperty double x\nproperty float y\n\
        property float z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\nelement face 2\n\
        property list uchar uint vertex_indices\nend_header\n"
        .to_vec();
    for (x, y, z) in [
        (0.0_f64, 0.0_f32, 0.0_f32),
        (1.0, 0.0, 0.1),
        (1.0, 1.0, 0.2),
        (0.0, 1.0, 0.3),
    ] {
        bytes.extend(x.to_le_bytes());
        bytes.extend(y.to_le_bytes().into_iter().chain(z.to_le_bytes()));
        bytes.extend([10, 20, 30]);
    }
    for corners in [&[0_u32, 1, 2, 3][..], &[0, 2, 3]] {
        bytes.push(corners.len() as u8);
        bytes.extend(corners.iter().flat_map(|corner| corner.to_le_bytes()));
    }
    bytes
}

fn oci() -> Vec<u8> {
    let file = |path: &str, content: &[u8]| ign_proto::FileEntry {
        path: path.parse().expect("a path"),
        digest: ign_proto::Digest::of(content),
        size_bytes: content.len() as u64,
        media_type: "image/png".to_owned(),
    };
    let files = vec![file("images/a.png", b"a"), file("mesh.ply", b"bb")];
    ign_proto::Manifest::new(
        ign_proto::Kind::Capture,
        files,
        std::collections::BTreeMap::new(),
    )
    .and_then(|manifest| manifest.encode())
    .expect("encoded")
}

const CAPTURE_TOML: &str = "object = \"museum/vase\"\ntitle = 'Vase'\nlicence = 'CC0'\nrights = 'Museum'\n\
    proxy = 'mesh.ply'\nmasks = 'white_is_object'\nmetres_per_scene_unit = 0.5\nheld_out = ['b.png']\n";
const MESH_OBJ: &str = "# scan\no thing\nv 0 0 0 1 0 0\nv 1 0 0 0 1 0\nv 1 1 0 0 0 1\nv 0 1 0.5 1 1 1\nvn 0 0 1\n\
    vt 0 0\nusemtl m\nf 1//1 2//1 3/1/1 -1//-1\nf 1 2 3\n";
const EVENTS: &str = r#"{"event":"progress","stage":"plan","percent":1.5,"eta_secs":null,"error":20.5,"message":"m"}
{"event":"log","level":"warn","message":"m"}
{"event":"checkpoint","path":"/w/c.bin"}
{"event":"done","bundle":"/w/bundle"}
{"event":"failed","kind":"invalid_input","message":"m","at":"x:1","hint":"h"}
"#;
const JOB: &str = r#"{"job_id":"01a20254-c193-7000-8000-0123456789ab","attempt":1,
"object":{"collection":"museum","object":"vase"},"capture_dir":"/c","capture_digest":"sha256:00",
"recipe":{"preset":"standard","size":128},"checkpoint":null,"work_dir":"/w","threads":2}"#;
const METRICS_JSON: &str = r#"{"schema":"ign.metrics/1","capture":"sha256:00","resolution":[8,6],
"views":{"train":3,"held_out":1,"references":2},
"methods":[{"name":"ours","mse":1.0,"mse_object":2.0,"psnr":40.0,"psnr_object":39.0,"ssim":0.9,"flip":0.1,
"worst_view":{"name":"b.png","mse":1.0},"per_view":[{"name":"b.png","mse":1.0,"mse_object":2.0}],
"train_secs":1.0,"render_ms":2.0,"bundle_bytes":3}],
"speed_error":[{"method":"ours","secs":1.0,"mse":2.0,"mse_object":3.0}],
"plan":{},"stages":[{"name":"import","secs":0.1}],"device":"cpu"}"#;
const BUNDLE_JSON: &str = r#"{"schema":"ign.bundle/1","object":{"collection":"museum","object":"vase"},
"networks":{"effects":null,"composition":{"kind":"unet-blend","inputs":[{"name":"normal","channels":3}],
"layers":[{"name":"stem","op":"conv","from":["input"],"in":3,"out":8,"kernel":3,"stride":1,"padding":1,
"activation":"relu","norm":"none"}],"head":"blend_weights","weights":"composition.safetensors","dtype":"fp16"}},
"capture":"sha256:00","recipe":{"size":128},"plan":[1,null,"x"],"provenance":{"software":"ign","git":null,"device":"cpu",
"seeds":[1],"started_at":"2026-01-01T00:00:00Z","finished_at":"2026-01-01T00:01:00Z","stages":[{"name":"plan","secs":1.5}]},
"files":[{"path":"proxy.glb","sha256":"00","size_bytes":12}],
"metrics":{"methods":[{"name":"ours","mse":1.0,"mse_object":2.0,"psnr":40.0}],"worst_view":"b.png"},
"normalised_from_world":{"scale":2.0,"translation":[1,2,3]},"colour_space":"srgb","render":{"k":4}}"#;
