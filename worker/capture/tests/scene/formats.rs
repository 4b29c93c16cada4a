//! One scene in every format: each is imported whole, and yields the cameras of the COLMAP model.

use std::fs;
use std::path::{Path, PathBuf};

use glam::DVec3;
use ign_capture::{Format, ImportOptions, Scene, check_cameras, import};

use crate::common::{errors, faults, octahedron};

const NAMES: [&str; 5] = [
    "photo_1.png",
    "photo_2.png",
    "photo_3.png",
    "photo_4.png",
    "photo_5.png",
];

fn reference(case: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("tests/reference/reconstructions")
        .join(case)
}

/// A capture with the case's files, five photographs and a mesh around the origin.
fn capture(case: &str) -> tempfile::TempDir {
    let dir = tempfile::tempdir().expect("a scratch folder");
    copy(&reference(case), dir.path());
    fs::create_dir_all(dir.path().join("images")).expect("a folder");
    for name in NAMES {
        image::RgbImage::new(96, 70)
            .save(dir.path().join("images").join(name))
            .expect("a picture");
    }
    fs::write(dir.path().join("mesh.ply"), octahedron(0.5)).expect("a mesh");
    dir
}

fn copy(from: &Path, to: &Path) {
    fs::create_dir_all(to).expect("a folder");
    for entry in fs::read_dir(from).expect("reference data") {
        let entry = entry.expect("an entry");
        let target = to.join(entry.file_name());
        if entry.path().is_dir() {
            copy(&entry.path(), &target);
        } else {
            fs::copy(entry.path(), target).expect("a copy");
        }
    }
}

fn imported(case: &str) -> Scene {
    let dir = capture(case);
    import(dir.path(), &ImportOptions::default()).unwrap_or_else(|error| panic!("{case}: {error}"))
}

/// Pixels of rays over the whole picture, by a view's own camera.
fn pixels(scene: &Scene, view: usize) -> Vec<[f64; 2]> {
    let grid =
        (-5..=5).flat_map(|x| (-4..=4).map(move |y| (f64::from(x) / 10.0, f64::from(y) / 10.0)));
    grid.map(|(x, y)| {
        let px = scene.views[view]
            .source
            .project(DVec3::new(x, y, 1.0))
            .expect("a pixel");
        [px.x, px.y]
    })
    .collect()
}

#[test]
fn every_format_yields_the_cameras_of_the_colmap_model() {
    let expected = imported("colmap");
    // The last have another lens and the same poses.
    for (case, same_lens) in [
        ("transforms_opencv", true),
        ("metashape", true),
        ("realitycapture", true),
        ("realitycapture_colmap", true),
        ("meshroom", true),
        ("opensfm", true),
        ("bundler", false),
        ("transforms_fisheye", false),
        ("transforms_metashape", false),
        ("metashape_fisheye", false),
        ("meshroom_old", false),
        ("opensfm_fisheye", false),
    ] {
        let scene = imported(case);
        assert_eq!(scene.views.len(), 5, "{case}");
        assert_eq!(
            (&scene.train, &scene.held_out),
            (&expected.train, &expected.held_out)
        );
        for (index, (view, other)) in scene.views.iter().zip(&expected.views).enumerate() {
            assert_eq!(view.name, other.name, "{case}");
            assert!(
                view.camera
                    .camera_from_world
                    .abs_diff_eq(other.camera.camera_from_world, 1e-9),
                "{case}, {}: {:?}",
                view.name,
                view.camera.camera_from_world
            );
            let (pixels, others) = (pixels(&scene, index), pixels(&expected, index));
            let apart = pixels
                .iter()
                .flatten()
                .zip(others.iter().flatten())
                .map(|(a, b)| (a - b).abs())
                .fold(0.0, f64::max);
            assert_eq!(apart < 1e-6, same_lens, "{case}, {}: {apart} px", view.name);
        }
    }
}

#[test]
fn a_list_of_distortion_parameters_is_taken_too() {
    let dir = capture("transforms_ngp");
    let path = dir.path().join("transforms.json");
    let text = fs::read_to_string(&path).expect("the file");
    let lens = " \"k1\": -0.18,\n \"k2\": 0.06,\n \"p1\": 0.004,\n \"p2\": -0.007,\n";
    assert!(text.contains(lens));
    let listed = |list: &str| text.replace(lens, &format!("\"distortion_params\": {list},"));
    fs::write(&path, listed("[-0.18, 0.06, 0, 0, 0.004, -0.007]")).expect("written");
    let scene = import(dir.path(), &ImportOptions::default()).expect("a scene");
    let expected = imported("transforms_ngp");
    for (view, other) in scene.views.iter().zip(&expected.views) {
        assert_eq!(view.source, other.source);
    }
    fs::write(&path, listed("[1]")).expect("written");
    let found = faults(dir.path(), &ImportOptions::default());
    assert!(errors(&found)[0].1.contains("has 1 distortion_params"));
}

#[test]
fn a_file_can_be_judged_by_itself() {
    let bytes = fs::read(reference("metashape").join("cameras.xml")).expect("the file");
    let (format, found) = check_cameras(&bytes, &[]);
    assert_eq!(format, Some(Format::Metashape));
    assert_eq!(errors(&found), []);
    let (format, found) = check_cameras(b"<html/>", &[]);
    assert_eq!(format, None);
    assert_eq!(
        errors(&found),
        [("cameras", "the file is of no known format")]
    );
}

#[test]
fn masks_of_transforms_json_are_taken() {
    let dir = capture("transforms_opencv");
    let path = dir.path().join("transforms.json");
    let text = fs::read_to_string(&path).expect("the file");
    let named = text.replace(
        "\"file_path\":",
        "\"mask_path\": \"./other/mask.png\", \"file_path\":",
    );
    fs::write(&path, named).expect("written");
    let found = faults(dir.path(), &ImportOptions::default());
    assert!(
        errors(&found)[0].1.contains("other/mask.png is missing"),
        "{found:#?}"
    );
    fs::create_dir_all(dir.path().join("other")).expect("a folder");
    image::GrayImage::from_pixel(96, 70, image::Luma([255]))
        .save(dir.path().join("other/mask.png"))
        .expect("a mask");
    let scene = import(dir.path(), &ImportOptions::default()).expect("a scene");
    assert!(
        scene
            .views
            .iter()
            .all(|view| view.ignored.as_ref().is_some_and(
                |ignored| ignored.inverted && ignored.path == dir.path().join("other/mask.png")
            ) && view.mask.is_none())
    );
}

#[test]
fn faults_name_the_file_the_place_and_the_fix() {
    for (case, file, from, to, at, message) in [
        (
            "transforms_opencv",
            "transforms.json",
            "\"OPENCV\"",
            "\"ORTHOPHOTO\"",
            "transforms.json (frame 0, \"images/photo_1.png\")",
            "image photo_1.png has the unsupported camera model ORTHOPHOTO",
        ),
        (
            "transforms_ngp",
            "transforms.json",
            "\"w\": 96.0",
            "\"w\": 96.5",
            "transforms.json (frame 0, \"./images/photo_1\")",
            "image photo_1.png has a picture size of 96.5x70",
        ),
        (
            "metashape",
            "cameras.xml",
            "type=\"frame\" class=\"adjusted\"",
            "type=\"cylindrical\" class=\"adjusted\"",
            "cameras.xml:5",
            "sensor 0 has the unsupported type \"cylindrical\"",
        ),
        (
            "metashape",
            "cameras.xml",
            "</chunk>",
            "</chunks>",
            "cameras.xml:24",
            "the file cannot be read: ill-formed document",
        ),
        (
            "realitycapture",
            "registration.csv",
            "pitch,",
            "phi,",
            "registration.csv:1",
            "the table has no column pitch",
        ),
        (
            "realitycapture",
            "registration.csv",
            "photo_2.png,",
            "photo_2.png,x",
            "registration.csv:3",
            "x is no finite number: \"x",
        ),
        (
            "meshroom",
            "sfm.json",
            "\"brown\"",
            "\"3deanamorphic4\"",
            "sfm.json (intrinsic 77)",
            "intrinsic 77 has the unsupported type \"3deanamorphic4\"",
        ),
        (
            "opensfm",
            "opensfm/reconstruction.json",
            "\"brown\"",
            "\"dual\"",
            "opensfm/reconstruction.json (camera \"v2 unknown\")",
            "camera \"v2 unknown\" has the unsupported projection \"dual\"",
        ),
        (
            "bundler",
            "bundle/bundle.out",
            "6 10",
            "6 11",
            "bundle/bundle.out:62",
            "the file ends before a point's position",
        ),
    ] {
        let dir = capture(case);
        let path = dir.path().join(file);
        let text = fs::read_to_string(&path).expect("the file");
        assert!(text.contains(from), "{case} does not hold {from}");
        fs::write(&path, text.replace(from, to)).expect("written");
        let found = faults(dir.path(), &ImportOptions::default());
        let errors = errors(&found);
        assert!(!errors.is_empty(), "{case}");
        let (found_at, found_message) = errors[0];
        assert!(
            found_at == at && found_message.starts_with(message),
            "{case}: {found_message} (at {found_at})"
        );
        assert!(!found[0].hint.is_empty());
    }
    let dir = capture("bundler");
    fs::remove_file(dir.path().join("list.txt")).expect("removed");
    let found = faults(dir.path(), &ImportOptions::default());
    assert_eq!(
        errors(&found)[0],
        ("bundle/list.txt", "the list of images is missing")
    );
}

#[test]
fn photographs_that_are_missing_are_reported_as_such() {
    for case in ["bundler", "realitycapture", "metashape", "transforms_ngp"] {
        let dir = capture(case);
        fs::remove_file(dir.path().join("images/photo_3.png")).expect("removed");
        let found = faults(dir.path(), &ImportOptions::default());
        let errors = errors(&found);
        assert_eq!(errors.len(), 1, "{case}: {errors:?}");
        assert!(errors[0].1.contains("photo_3"), "{case}: {errors:?}");
        assert!(errors[0].1.ends_with("is missing"), "{case}: {errors:?}");
    }
}
