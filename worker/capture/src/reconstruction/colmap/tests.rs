//! Models written by pycolmap (`tests/reference/make_colmap_models.py`) and damaged copies of them.

use std::fs;
use std::path::{Path, PathBuf};

use glam::{DVec2, DVec3};

use super::*;
use crate::fault::{Fault, Severity};
use crate::reconstruction::ModelImage;

fn reference() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/reference/colmap")
}

/// Copies the files with these names into a fresh folder `sparse/0`, so that only one form is there.
fn copied(model: &str, extension: &str) -> tempfile::TempDir {
    let dir = tempfile::tempdir().expect("a scratch folder");
    let to = dir.path().join("sparse/0");
    fs::create_dir_all(&to).expect("a folder");
    for part in ["cameras", "images", "points3D"] {
        let name = format!("{part}.{extension}");
        fs::copy(reference().join(model).join(&name), to.join(&name)).expect("a copy");
    }
    dir
}

fn read_all(dir: &Path) -> (Model, Vec<Fault>) {
    let mut faults = Faults::default();
    let relative = locate(dir, Path::new(FOLDER), &mut faults).expect("a model");
    let model = read(dir, &relative, &mut faults);
    (model, faults.into_list())
}

/// The pixel of a world point by this crate's own camera.
fn project(model: &Model, image: &ModelImage, point: DVec3) -> DVec2 {
    let source = model.cameras[&image.camera_id].expect("a sound camera");
    let in_camera = image.camera_from_world.transform_point3(point);
    source.project(in_camera).expect("a pixel")
}

#[test]
fn projections_agree_with_pycolmap_for_every_camera_model() {
    let mut models = 0;
    for entry in fs::read_dir(reference()).expect("reference data") {
        let name = entry
            .expect("an entry")
            .file_name()
            .into_string()
            .expect("a name");
        for extension in ["bin", "txt"] {
            let dir = copied(&name, extension);
            let (model, faults) = read_all(dir.path());
            assert!(faults.is_empty(), "{name}.{extension}: {faults:?}");
            assert_eq!(
                (model.images.len(), model.points.len()),
                (3, 12),
                "{name}.{extension}"
            );
            let text = fs::read_to_string(reference().join(&name).join("projections.txt"))
                .expect("projections");
            let mut largest = 0.0_f64;
            for line in text.lines() {
                let mut words = line.split(' ');
                let image_name = words.next().expect("a name").replace('_', " ");
                let values: Vec<f64> = words.map(|word| word.parse().expect("a number")).collect();
                let image = model
                    .images
                    .iter()
                    .find(|image| image.name == image_name)
                    .expect("the image");
                let px = project(&model, image, DVec3::new(values[0], values[1], values[2]));
                largest = largest.max(px.distance(DVec2::new(values[3], values[4])));
            }
            // The same formulas in f64: only rounding is left.
            assert!(largest < 1e-9, "{name}.{extension}: off by {largest} px");
        }
        models += 1;
    }
    assert_eq!(models, 18);
}

#[test]
fn binary_and_text_hold_the_same_model() {
    let (binary, _) = read_all(copied("opencv", "bin").path());
    let (text, _) = read_all(copied("opencv", "txt").path());
    assert_eq!(binary.cameras, text.cameras);
    for (a, b) in binary.images.iter().zip(&text.images) {
        assert_eq!((a.id, &a.name, a.camera_id), (b.id, &b.name, b.camera_id));
        assert!(a.camera_from_world.abs_diff_eq(b.camera_from_world, 1e-12));
    }
    for (a, b) in binary.points.iter().zip(&text.points) {
        assert_eq!(
            (a.position, a.color, &a.image_ids),
            (b.position, b.color, &b.image_ids)
        );
        assert_eq!(a.image_ids.len(), 3);
    }
}

#[test]
fn every_truncation_of_a_binary_file_is_found() {
    for part in ["cameras", "images", "points3D"] {
        let whole =
            fs::read(reference().join("pinhole").join(format!("{part}.bin"))).expect("the file");
        for length in 0..whole.len() {
            // Every length is tried for the small file, a spread of them for the others.
            if whole.len() > 200 && length % 37 != 0 {
                continue;
            }
            let dir = copied("pinhole", "bin");
            fs::write(
                dir.path().join(format!("sparse/0/{part}.bin")),
                &whole[..length],
            )
            .expect("written");
            let (_, faults) = read_all(dir.path());
            assert_eq!(faults.len(), 1, "{part} cut to {length}: {faults:?}");
            assert!(
                faults[0].message.contains("truncated"),
                "{}",
                faults[0].message
            );
            assert!(
                faults[0]
                    .at
                    .starts_with(&format!("sparse/0/{part}.bin (byte ")),
                "{}",
                faults[0].at
            );
        }
    }
}

#[test]
fn counts_beyond_the_file_allocate_nothing() {
    let dir = copied("pinhole", "bin");
    let path = dir.path().join("sparse/0/points3D.bin");
    let mut bytes = fs::read(&path).expect("the file");
    bytes[..8].copy_from_slice(&u64::MAX.to_le_bytes());
    fs::write(&path, &bytes).expect("written");
    let (_, faults) = read_all(dir.path());
    assert!(faults[0].message.contains("truncated"));
    // The track length of the first point.
    bytes[..8].copy_from_slice(&12_u64.to_le_bytes());
    bytes[51..59].copy_from_slice(&(u64::MAX / 8).to_le_bytes());
    fs::write(&path, &bytes).expect("written");
    let (_, faults) = read_all(dir.path());
    assert!(faults[0].message.contains("truncated"));
}

#[test]
fn damaged_bytes_never_panic() {
    let mut state = 1_u64;
    let mut random = move |below: usize| {
        // Knuth's linear congruential generator; the high bits are the good ones.
        state = state
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        (state >> 33) as usize % below
    };
    for extension in ["bin", "txt"] {
        let dir = copied("full_opencv", extension);
        for part in ["cameras", "images", "points3D"] {
            let path = dir.path().join(format!("sparse/0/{part}.{extension}"));
            let whole = fs::read(&path).expect("the file");
            for _ in 0..150 {
                let mut bytes = whole.clone();
                for _ in 0..=random(6) {
                    let at = random(bytes.len());
                    bytes[at] = random(256) as u8;
                }
                fs::write(&path, &bytes).expect("written");
                let (model, _) = read_all(dir.path());
                for camera in model.cameras.values().flatten() {
                    camera.project(DVec3::new(0.3, -0.2, 1.0));
                }
            }
            fs::write(&path, &whole).expect("written");
        }
    }
}

#[test]
fn faulty_cameras_are_named_with_their_line() {
    let dir = copied("pinhole", "txt");
    let text = "# comment\n7 PINHOLE 96 70 0 92.5 45.5 37.25\n8 SIMPLE_RADIAL 96 70 nan 45.5 37 0\n\
                9 FOV 96 70 88 88 45 37 inf\n10 CUBIC 96 70 1\n11 PINHOLE 96 70 88 88 45\nx\n\
                12 PINHOLE 96 70 88 88 45 37 1\n7 PINHOLE 96 70 9 92.5 45.5 37.25\n";
    fs::write(dir.path().join("sparse/0/cameras.txt"), text).expect("written");
    let (_, faults) = read_all(dir.path());
    let found: Vec<(String, String)> = faults.into_iter().map(|f| (f.at, f.message)).collect();
    let expected = [
        (2, "camera 7 has zero focal length"),
        (3, "camera 8 has a focal length that is not a finite number"),
        (
            4,
            "camera 9 has a distortion parameter that is not a finite number",
        ),
        (5, "camera 10 has the unknown model CUBIC"),
        (
            6,
            "camera 11 cannot be read: the line ends before a parameter",
        ),
        (7, "the camera's id is no number: \"x\""),
        (
            8,
            "camera 12 cannot be read: more than the 4 parameters of PINHOLE",
        ),
        (9, "camera 7 is there twice"),
    ];
    let expected: Vec<(String, String)> = expected
        .iter()
        .map(|(line, text)| (format!("sparse/0/cameras.txt:{line}"), (*text).to_owned()))
        .collect();
    assert_eq!(found, expected);
}

#[test]
fn faulty_lines_of_images_and_points_are_named() {
    let dir = copied("pinhole", "txt");
    let images = "1 1 0 0 0 0 0 4 7 a.png\n\n2 0 0 0 0 0 0 4 7 b.png\n1 2 3\n3 1 0 0 0 inf 0 4 7 c.png\n\n\
                  4 1 0 0 q 0 0 4 7 d.png\n\n5 1 0 0 0 0 0 4 7\n\n";
    fs::write(dir.path().join("sparse/0/images.txt"), images).expect("written");
    fs::write(
        dir.path().join("sparse/0/points3D.txt"),
        "1 0 0 nan 1 2 3 0.5 1 0\n2 0 0 0 1 2 300 0.5\n",
    )
    .expect("written");
    let (model, faults) = read_all(dir.path());
    assert_eq!(model.images.len(), 1);
    let places: Vec<&str> = faults.iter().map(|fault| fault.at.as_str()).collect();
    let expected = [
        "images.txt:3",
        "images.txt:5",
        "images.txt:7",
        "images.txt:9",
        "points3D.txt:1",
        "points3D.txt:2",
    ];
    assert_eq!(places, expected.map(|place| format!("sparse/0/{place}")));
}

#[test]
fn missing_parts_of_a_model_are_named() {
    let dir = copied("pinhole", "bin");
    fs::remove_file(dir.path().join("sparse/0/cameras.bin")).expect("removed");
    fs::remove_file(dir.path().join("sparse/0/points3D.bin")).expect("removed");
    let (_, faults) = read_all(dir.path());
    assert_eq!(faults[0].at, "sparse/0/cameras.bin");
    assert_eq!(
        (faults[1].at.as_str(), faults[1].severity),
        ("sparse/0/points3D.bin", Severity::Warning)
    );
}
