//! Whole bundles: written, read back, damaged in every way.

#![expect(
    clippy::unwrap_used,
    reason = "a test fails by panicking; figures compared here are exact"
)]

use std::fs;
use std::path::Path;

use glam::{DAffine3, DQuat, DVec3};
use ign_bundle::manifest::{
    CanonicalExposure, Layer, Manifest, MetricsSummary, NetworkDescription, NetworkInput, Networks,
    ObjectName, Provenance, StageSeconds,
};
use ign_bundle::metrics::{MethodMetrics, Scores, SpeedError, ViewCounts};
use ign_bundle::references::Crop;
use ign_bundle::weights::{decode, encode};
use ign_bundle::{
    Bundle, BundleError, BundleWriter, COMPOSITION_FILE, HeldOutView, MANIFEST_FILE, METRICS_FILE,
    Metrics, PROXY_FILE, Precision, Reference, Tensor, Tensors, VIEWS_FILE, pack, proxy,
};
use ign_geometry::{Camera, CameraIntrinsics, Mesh, Similarity};
use image::{Rgb, RgbImage};
use proptest::prelude::*;
use serde_json::json;

fn reference(index: u8) -> Reference {
    let (width, height) = (5, 3);
    let intrinsics = CameraIntrinsics {
        fx: 7.1,
        fy: 6.9,
        cx: 2.2,
        cy: 1.7,
        width,
        height,
    };
    let rotation = DQuat::from_euler(glam::EulerRot::XYZ, 0.3, -0.2 * f64::from(index), 0.7);
    let camera = Camera::new(
        intrinsics,
        DAffine3::from_rotation_translation(rotation, DVec3::new(0.1, 0.2, 3.3)),
    );
    Reference {
        name: format!("walk/{index:04}.jpg"),
        camera: camera.unwrap(),
        width,
        height,
        rgba: (0..60)
            .map(|i| (i as u8).wrapping_mul(37).wrapping_add(index))
            .collect(),
        exposure_gain: [1.0, 0.1 + 1.0 / 3.0, 1.25],
        crop: Some(Crop {
            x: 10.5,
            y: 4.0,
            width: 100.0,
            height: 60.1,
        }),
    }
}

fn mesh() -> Mesh {
    let corner = |x: f64, y: f64, z: f64| DVec3::new(x, y, z).as_vec3().as_dvec3();
    let positions = vec![
        corner(0.1, 0.2, 0.3),
        corner(0.9, -0.2, 0.1),
        corner(-0.4, 0.7, 0.2),
        corner(0.0, 0.1, -0.9),
    ];
    let mut mesh = Mesh::new(positions, vec![[0, 1, 2], [0, 3, 1], [1, 3, 2], [2, 3, 0]]).unwrap();
    mesh.colors = Some(vec![[0, 128, 255], [1, 2, 3], [200, 100, 50], [9, 9, 9]]);
    mesh.normals = mesh
        .normals
        .iter()
        .map(|n| n.as_vec3().as_dvec3())
        .collect();
    mesh
}

const WORLD: Similarity = Similarity {
    scale: 0.1,
    translation: DVec3::new(1.5, -2.25, 0.300_000_000_000_000_04),
};

fn metrics() -> Metrics {
    let black = RgbImage::new(12, 12);
    let grey = RgbImage::from_pixel(12, 12, Rgb([2, 2, 2]));
    let scores = Scores::of(&grey, &black, &[true; 144]);
    Metrics {
        schema: "ign.metrics/1".into(),
        capture: format!("sha256:{}", "0".repeat(64)),
        resolution: [12, 12],
        views: ViewCounts {
            train: 20,
            held_out: 1,
            references: 2,
        },
        methods: vec![MethodMetrics::from_views(
            "ours",
            &[("walk/0007.jpg".into(), scores)],
            1.5,
            20.0,
            4096,
        )],
        speed_error: vec![SpeedError {
            method: "ours".into(),
            secs: 1.5,
            mse: 4.0,
            mse_object: 4.0,
        }],
        plan: json!({"kept": []}),
        stages: vec![StageSeconds {
            name: "import".into(),
            secs: 0.5,
        }],
        device: "cpu".into(),
    }
}

fn weights() -> Tensors {
    Tensors::from([(
        "head.weight".to_owned(),
        Tensor {
            shape: vec![2, 1, 1, 1],
            values: vec![0.5, -0.25],
        },
    )])
}

fn held_out_view() -> HeldOutView {
    HeldOutView {
        name: "walk/0007.jpg".into(),
        camera: reference(7).camera,
        exposure_gain: [0.9, 1.0, 1.0 / 3.0],
    }
}

fn manifest() -> Manifest {
    Manifest {
        schema: "ign.bundle/1".into(),
        object: ObjectName {
            collection: "c".into(),
            object: "o".into(),
        },
        networks: Networks {
            effects: None,
            composition: Some(NetworkDescription {
                kind: "test".into(),
                inputs: vec![NetworkInput {
                    name: "warped".into(),
                    channels: 1,
                }],
                layers: vec![Layer {
                    name: "head".into(),
                    op: "conv".into(),
                    from: vec![],
                    in_channels: 1,
                    out_channels: 2,
                    kernel: 1,
                    stride: 1,
                    padding: 0,
                    activation: "none".into(),
                    norm: "none".into(),
                }],
                head: "blend_weights".into(),
                weights: COMPOSITION_FILE.into(),
                dtype: Precision::Fp16,
            }),
        },
        capture: format!("sha256:{}", "0".repeat(64)),
        recipe: json!({"preset": "standard"}),
        plan: json!({}),
        provenance: Provenance {
            software: "test".into(),
            git: None,
            device: "cpu".into(),
            seeds: vec![0],
            started_at: "2026-01-01T00:00:00Z".into(),
            finished_at: "2026-01-01T00:00:01Z".into(),
            stages: vec![],
        },
        files: vec![],
        metrics: MetricsSummary::from(&metrics()),
        normalised_from_world: WORLD.into(),
        colour_space: "srgb".into(),
        canonical_exposure: Some(CanonicalExposure {
            equalised: true,
            gain_range: [0.5, 1.25],
        }),
        render: json!({"k": 4}),
    }
}

fn write_bundle(dir: &Path) -> Bundle {
    let writer = BundleWriter::create(dir).unwrap();
    writer.references(&[reference(0), reference(1)]).unwrap();
    writer.proxy(&mesh(), &WORLD).unwrap();
    writer
        .weights(COMPOSITION_FILE, &weights(), Precision::Fp16)
        .unwrap();
    writer.metrics(&metrics()).unwrap();
    writer
        .held_out("walk/0007.jpg", "ours", &RgbImage::new(12, 12))
        .unwrap();
    writer.held_out_views(&[held_out_view()]).unwrap();
    writer.report("<!doctype html>").unwrap();
    writer.finish(manifest()).unwrap()
}

#[test]
fn everything_comes_back() {
    let dir = tempfile::tempdir().unwrap();
    write_bundle(dir.path());
    let bundle = Bundle::open(dir.path()).unwrap();
    assert_eq!(bundle.references().unwrap(), [reference(0), reference(1)]);
    let (proxy, world) = bundle.proxy().unwrap();
    let original = mesh();
    assert_eq!(proxy.positions, original.positions);
    assert_eq!(proxy.normals, original.normals);
    assert_eq!(proxy.colors, original.colors);
    assert_eq!(proxy.triangles, original.triangles);
    assert_eq!(world, WORLD);
    assert_eq!(bundle.metrics().unwrap(), Some(metrics()));
    let network = bundle.manifest().networks.composition.clone().unwrap();
    assert_eq!(bundle.weights(&network).unwrap(), weights());
    assert_eq!(bundle.held_out_views().unwrap(), [held_out_view()]);
    let paths: Vec<_> = bundle
        .manifest()
        .files
        .iter()
        .map(|f| f.path.as_str())
        .collect();
    assert_eq!(
        paths,
        [
            "composition.safetensors",
            "held_out/views.json",
            "held_out/walk_0007.ours.png",
            "metrics.json",
            "proxy.glb",
            "references/0000.png",
            "references/0001.png",
            "references/views.json",
            "report.html",
        ]
    );
}

#[test]
fn one_flipped_byte_in_any_file_is_found() {
    let dir = tempfile::tempdir().unwrap();
    let bundle = write_bundle(dir.path());
    for record in &bundle.manifest().files {
        let path = dir.path().join(&record.path);
        let content = fs::read(&path).unwrap();
        for at in [0, content.len() / 2, content.len() - 1] {
            let mut damaged = content.clone();
            damaged[at] ^= 1;
            fs::write(&path, damaged).unwrap();
            let error = Bundle::open(dir.path()).unwrap_err();
            assert!(
                matches!(&error, BundleError::Digest { file } if *file == record.path),
                "{error}"
            );
        }
        fs::write(&path, &content[1..]).unwrap();
        assert!(matches!(
            Bundle::open(dir.path()),
            Err(BundleError::Size { .. })
        ));
        fs::remove_file(&path).unwrap();
        assert!(
            matches!(Bundle::open(dir.path()), Err(BundleError::Missing { file }) if file == record.path)
        );
        fs::write(&path, &content).unwrap();
    }
    Bundle::open(dir.path()).unwrap();
}

#[test]
fn strange_files_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    write_bundle(dir.path());
    fs::write(dir.path().join("extra.bin"), "x").unwrap();
    assert!(
        matches!(Bundle::open(dir.path()), Err(BundleError::Unlisted { file }) if file == "extra.bin")
    );
    fs::remove_file(dir.path().join("extra.bin")).unwrap();
    #[cfg(unix)]
    {
        let report = dir.path().join("report.html");
        fs::rename(&report, dir.path().with_extension("elsewhere")).unwrap();
        std::os::unix::fs::symlink(dir.path().with_extension("elsewhere"), &report).unwrap();
        assert!(
            matches!(Bundle::open(dir.path()), Err(BundleError::Malformed { file, .. }) if file == "report.html")
        );
        fs::remove_file(dir.path().with_extension("elsewhere")).unwrap();
    }
}

/// Rewrites `bundle.json` through `edit` and opens the result.
fn edited(dir: &Path, edit: impl FnOnce(&mut serde_json::Value)) -> BundleError {
    let path = dir.join(MANIFEST_FILE);
    let original = fs::read(&path).unwrap();
    let mut value = serde_json::from_slice(&original).unwrap();
    edit(&mut value);
    fs::write(&path, serde_json::to_vec(&value).unwrap()).unwrap();
    let error = Bundle::open(dir).unwrap_err();
    fs::write(&path, original).unwrap();
    error
}

#[test]
fn hostile_manifests_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    write_bundle(dir.path());
    for path in ["../outside", "/etc/passwd", "a\\b", "bundle.json/../x"] {
        let error = edited(dir.path(), |m| m["files"][0]["path"] = json!(path));
        assert!(
            matches!(&error, BundleError::PathEscape { path: found } if found == path),
            "{error}"
        );
    }
    let error = edited(dir.path(), |m| m["schema"] = json!("ign.bundle/2"));
    assert!(matches!(error, BundleError::Schema { .. }));
    let error = edited(dir.path(), |m| m["files"][1] = m["files"][0].clone());
    assert!(matches!(error, BundleError::Duplicate { .. }));
    let error = edited(dir.path(), |m| {
        m["networks"]["composition"]["weights"] = json!("other.safetensors");
    });
    assert!(matches!(error, BundleError::Missing { file } if file == "other.safetensors"));
    let error = edited(dir.path(), |m| {
        m["normalised_from_world"]["scale"] = json!(2.0);
    });
    assert!(matches!(error, BundleError::Malformed { file, .. } if file == PROXY_FILE));
    let error = edited(dir.path(), |m| *m = json!([]));
    assert!(matches!(error, BundleError::Json { .. }));
}

/// Replaces a file and its digest, as a hostile packer could.
fn repacked(dir: &Path, file: &str, bytes: &[u8]) -> BundleError {
    let path = dir.join(file);
    let original = fs::read(&path).unwrap();
    fs::write(&path, bytes).unwrap();
    let error = edited(dir, |m| {
        for record in m["files"].as_array_mut().unwrap() {
            if record["path"] == file {
                record["size_bytes"] = json!(bytes.len());
                record["sha256"] =
                    json!(hex::encode(<sha2::Sha256 as sha2::Digest>::digest(bytes)));
            }
        }
    });
    fs::write(&path, original).unwrap();
    error
}

#[test]
fn hostile_content_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    write_bundle(dir.path());

    let mut nan = encode("w", &weights(), Precision::Fp32).unwrap();
    let at = nan.len() - 4;
    nan[at..].copy_from_slice(&f32::NAN.to_le_bytes());
    let error = repacked(dir.path(), COMPOSITION_FILE, &nan);
    assert!(
        matches!(&error, BundleError::NonFinite { tensor, .. } if tensor == "head.weight"),
        "{error}"
    );

    // A PNG header that claims 60,000 by 60,000 pixels (its CRC is that of the claim).
    let mut huge = fs::read(dir.path().join("references/0000.png")).unwrap();
    huge[16..20].copy_from_slice(&60_000_u32.to_be_bytes());
    huge[20..24].copy_from_slice(&60_000_u32.to_be_bytes());
    let crc = crc32(&huge[12..29]);
    huge[29..33].copy_from_slice(&crc.to_be_bytes());
    let error = repacked(dir.path(), "references/0000.png", &huge);
    assert!(
        matches!(error, BundleError::ImageTooLarge { width: 60_000, .. }),
        "{error}"
    );

    let error = repacked(dir.path(), "references/0001.png", b"GIF89a");
    assert!(
        matches!(&error, BundleError::Image { file, .. } if file == "references/0001.png"),
        "{error}"
    );

    let mut views: serde_json::Value =
        serde_json::from_slice(&fs::read(dir.path().join(VIEWS_FILE)).unwrap()).unwrap();
    views["views"][0]["file"] = json!("../secret.png");
    let error = repacked(dir.path(), VIEWS_FILE, &serde_json::to_vec(&views).unwrap());
    assert!(matches!(error, BundleError::Missing { .. }), "{error}");
    views["views"][0]["file"] = json!("references/0000.png");
    views["views"][0]["intrinsics"]["fx"] = json!(0.0);
    let error = repacked(dir.path(), VIEWS_FILE, &serde_json::to_vec(&views).unwrap());
    assert!(matches!(error, BundleError::Malformed { .. }), "{error}");

    let error = repacked(dir.path(), METRICS_FILE, br#"{"schema":"ign.metrics/1"}"#);
    assert!(matches!(error, BundleError::Json { .. }), "{error}");
}

fn crc32(bytes: &[u8]) -> u32 {
    !bytes.iter().fold(u32::MAX, |crc, &byte| {
        (0..8).fold(crc ^ u32::from(byte), |crc, _| {
            if crc & 1 == 1 {
                crc >> 1 ^ 0xEDB8_8320
            } else {
                crc >> 1
            }
        })
    })
}

#[test]
fn damaged_proxies_are_errors_not_panics() {
    let bytes = proxy::encode(&mesh(), &WORLD).unwrap();
    for length in 0..bytes.len() {
        assert!(proxy::decode(&bytes[..length]).is_err());
    }
    for at in 0..bytes.len() {
        for bit in [0, 3, 7] {
            let mut damaged = bytes.clone();
            damaged[at] ^= 1 << bit;
            let _outcome = proxy::decode(&damaged);
        }
    }
    let mut far = mesh();
    far.triangles[0][0] = 4;
    assert!(proxy::decode(&proxy::encode(&far, &WORLD).unwrap()).is_err());
    let mut nan = mesh();
    nan.positions[0].x = f64::NAN;
    assert!(proxy::encode(&nan, &WORLD).is_err());
}

#[test]
fn an_unfinished_bundle_is_no_bundle() {
    let dir = tempfile::tempdir().unwrap();
    let writer = BundleWriter::create(dir.path()).unwrap();
    writer.proxy(&mesh(), &WORLD).unwrap();
    assert!(matches!(
        Bundle::open(dir.path()),
        Err(BundleError::Missing { .. })
    ));
    assert!(matches!(
        writer.file(PROXY_FILE, b""),
        Err(BundleError::Duplicate { .. })
    ));
    assert!(matches!(
        writer.file("../x", b""),
        Err(BundleError::PathEscape { .. })
    ));
    assert!(BundleWriter::create(dir.path()).is_err());
}

/// Frozen: a change of this file is a new schema version.
#[test]
fn version_1_manifests_stay_readable() {
    let text = include_str!("fixtures/bundle-1.json");
    let manifest = pack::parse_manifest(text.as_bytes()).unwrap();
    assert_eq!(manifest.object.object, "vase-12");
    assert_eq!(
        manifest.normalised_from_world.translation[2].to_bits(),
        0.300_000_000_000_000_04_f64.to_bits()
    );
    let composition = manifest.networks.composition.as_ref().unwrap();
    assert_eq!(composition.layers[1].from, ["enc0", "input"]);
    assert_eq!(composition.dtype, Precision::Fp16);
    let written = serde_json::to_value(&manifest).unwrap();
    assert_eq!(
        written,
        serde_json::from_str::<serde_json::Value>(text).unwrap()
    );
}

#[test]
fn metrics_json_has_exactly_the_fixed_fields() {
    let value: serde_json::Value = serde_json::from_slice(&metrics().to_json().unwrap()).unwrap();
    let keys = |v: &serde_json::Value| {
        v.as_object()
            .unwrap()
            .keys()
            .cloned()
            .collect::<Vec<_>>()
            .join(" ")
    };
    assert_eq!(
        keys(&value),
        "capture device methods plan resolution schema speed_error stages views"
    );
    assert_eq!(
        keys(&value["methods"][0]),
        "bundle_bytes flip mse mse_object name per_view psnr psnr_object render_ms ssim train_secs worst_view"
    );
    assert_eq!(
        keys(&value["methods"][0]["per_view"][0]),
        "mse mse_object name"
    );
    assert_eq!(keys(&value["speed_error"][0]), "method mse mse_object secs");
    assert_eq!(keys(&value["views"]), "held_out references train");
    let mut broken = metrics();
    broken.methods[0].mse = f64::NAN;
    assert!(broken.to_json().is_err());
}

proptest! {
    #[test]
    fn weights_round_trip(values in prop::collection::vec(-1e4_f32..1e4, 0..40), rows in 1_usize..4) {
        let values = &values[..values.len() / rows * rows];
        let tensor = Tensor { shape: vec![rows, values.len() / rows], values: values.to_vec() };
        let tensors = Tensors::from([("a".to_owned(), tensor), ("b.c".to_owned(), Tensor { shape: vec![], values: vec![1.0] })]);
        let exact = decode("w", &encode("w", &tensors, Precision::Fp32).unwrap()).unwrap();
        prop_assert_eq!(&exact, &tensors);
        let half = decode("w", &encode("w", &tensors, Precision::Fp16).unwrap()).unwrap();
        for (a, b) in half["a"].values.iter().zip(values) {
            // Half a unit in the last of fp16's 11 bits; below 6e-5 the step is 6e-8.
            prop_assert!((a - b).abs() <= b.abs() / 2048.0 + 6e-8);
        }
    }

    #[test]
    fn references_round_trip(
        angle in -3.0_f64..3.0, shift in prop::array::uniform3(-5.0_f64..5.0), fx in 1.0_f64..1e4, gain in 0.1_f32..4.0,
        rgba in prop::collection::vec(any::<u8>(), 4 * 6),
    ) {
        let intrinsics = CameraIntrinsics { fx, fy: fx * 1.01, cx: 1.3, cy: 0.9, width: 3, height: 2 };
        let pose = DAffine3::from_rotation_translation(
            DQuat::from_axis_angle(DVec3::new(0.48, 0.6, 0.64), angle), shift.into());
        let one = Reference {
            name: "a \"quoted\" näme.jpg".into(), camera: Camera::new(intrinsics, pose).unwrap(), width: 3, height: 2,
            rgba, exposure_gain: [gain, 1.0, gain * 0.7], crop: None,
        };
        let files = ign_bundle::references::encode(std::slice::from_ref(&one)).unwrap();
        let back = ign_bundle::references::decode(&files[0].1, |path| {
            assert_eq!(path, files[1].0);
            Ok(files[1].1.clone())
        }).unwrap();
        prop_assert_eq!(back, [one]);
    }

    #[test]
    fn proxies_round_trip(points in prop::collection::vec(prop::array::uniform3(-1.0_f32..1.0), 3..30), scale in 1e-3_f64..1e3) {
        let count = points.len() as u32;
        let original = Mesh {
            positions: points.iter().map(|p| glam::Vec3::from_array(*p).as_dvec3()).collect(),
            normals: vec![DVec3::Z; points.len()],
            colors: None,
            triangles: (2..count).map(|i| [0, i - 1, i]).collect(),
        };
        let world = Similarity { scale, translation: DVec3::new(scale * 3.1, 0.2, -7.7) };
        let (mesh, back) = proxy::decode(&proxy::encode(&original, &world).unwrap()).unwrap();
        prop_assert_eq!(mesh.positions, original.positions);
        prop_assert_eq!(mesh.triangles, original.triangles);
        prop_assert_eq!(back, world);
    }
}
