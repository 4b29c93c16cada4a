//! Every format against another implementation's pixels (`tests/reference/make_reconstructions.py`), and damaged
//! copies of every file.

use std::fs;
use std::path::{Path, PathBuf};

use glam::DVec3;

use super::*;
use crate::fault::Severity;

const NAMES: [&str; 5] = [
    "photo_1.png",
    "photo_2.png",
    "photo_3.png",
    "photo_4.png",
    "photo_5.png",
];

fn reference() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/reference/reconstructions")
}

fn cases() -> Vec<String> {
    let mut names: Vec<String> = fs::read_dir(reference())
        .expect("reference data")
        .map(|entry| {
            entry
                .expect("an entry")
                .file_name()
                .into_string()
                .expect("a name")
        })
        .collect();
    names.sort();
    names
}

/// A capture with the case's files and with photographs of the right size.
fn capture(case: &str) -> tempfile::TempDir {
    let dir = tempfile::tempdir().expect("a scratch folder");
    for entry in walkdir::WalkDir::new(reference().join(case)) {
        let entry = entry.expect("an entry");
        let to = dir.path().join(
            entry
                .path()
                .strip_prefix(reference().join(case))
                .expect("a path below"),
        );
        if entry.file_type().is_dir() {
            fs::create_dir_all(to).expect("a folder");
        } else if entry.file_name() != "projections.txt" {
            fs::copy(entry.path(), to).expect("a copy");
        }
    }
    let height = if case.ends_with("_spherical") { 48 } else { 70 };
    for name in NAMES {
        photograph(dir.path(), name, height);
    }
    dir
}

fn photograph(dir: &Path, name: &str, height: u32) {
    let path = dir.join("images").join(name);
    fs::create_dir_all(path.parent().expect("a folder")).expect("a folder");
    image::GrayImage::new(96, height)
        .save(path)
        .expect("a picture");
}

fn read_with(dir: &Path, settings: &Settings) -> (Model, Vec<Fault>) {
    let mut faults = Faults::default();
    let model = read(dir, settings, &mut faults);
    (model, faults.into_list())
}

fn read_all(dir: &Path) -> (Model, Vec<Fault>) {
    read_with(dir, &Settings::default())
}

/// Largest distance between the model's pixels and those of the reference, and how many were compared.
fn largest_error(model: &Model, projections: &str) -> (f64, usize) {
    let mut largest = 0.0_f64;
    let mut compared = 0;
    for line in projections.lines() {
        let mut words = line.split(' ');
        let name = words.next().expect("a name");
        let values: Vec<f64> = words.map(|word| word.parse().expect("a number")).collect();
        let image = model
            .images
            .iter()
            .find(|image| image.name == name)
            .unwrap_or_else(|| panic!("{name} is not in the model"));
        let camera = model.cameras[&image.camera_id].expect("a sound camera");
        let point = DVec3::new(values[0], values[1], values[2]);
        let px = camera
            .project(image.camera_from_world.transform_point3(point))
            .expect("a pixel");
        largest = largest.max(px.distance(DVec2::new(values[3], values[4])));
        compared += 1;
    }
    (largest, compared)
}

#[test]
fn every_format_agrees_with_another_implementation() {
    for case in cases() {
        let dir = capture(&case);
        let (model, faults) = read_all(dir.path());
        let errors: Vec<&Fault> = faults
            .iter()
            .filter(|fault| fault.severity == Severity::Error)
            .collect();
        assert!(errors.is_empty(), "{case}: {errors:?}");
        assert!(model.has_all_images, "{case}");
        let text = fs::read_to_string(reference().join(&case).join("projections.txt"))
            .expect("projections");
        let (largest, compared) = largest_error(&model, &text);
        assert!(compared >= 50, "{case}: {compared}");
        // Files with 17 digits, and rotations that went through other programs' quaternions and angles.
        assert!(largest < 1e-6, "{case}: off by {largest} px");
    }
}

#[test]
fn the_formats_are_found_by_themselves() {
    let expected = [
        ("bundler", Format::Bundler),
        ("colmap", Format::Colmap),
        ("meshroom", Format::Meshroom),
        ("metashape", Format::Metashape),
        ("opensfm", Format::OpenSfm),
        ("realitycapture", Format::RealityCapture),
        ("transforms_opencv", Format::Transforms),
    ];
    for (case, format) in expected {
        let dir = capture(case);
        let found = choose(dir.path(), &Settings::default(), &mut Faults::default());
        assert_eq!(found.map(|found| found.format), Some(format), "{case}");
    }
}

#[test]
fn points_come_with_the_formats_that_have_them() {
    // nerfstudio writes six decimals.
    for (case, tracks, within) in [
        ("colmap", 5, 1e-12),
        ("transforms_opencv", 0, 1e-5),
        ("meshroom", 3, 1e-12),
        ("opensfm", 0, 1e-12),
        ("bundler", 3, 1e-12),
    ] {
        let (model, _) = read_all(capture(case).path());
        let (reference, _) = read_all(capture("colmap").path());
        assert_eq!(model.points.len(), 10, "{case}");
        for (index, point) in model.points.iter().enumerate() {
            // Text keys of OpenSfM come in their own order, which for these is the same.
            let expected = &reference.points[index];
            assert!(
                point.position.abs_diff_eq(expected.position, within),
                "{case}: {} for {}",
                point.position,
                expected.position
            );
            assert_eq!(point.color, expected.color, "{case}");
            assert_eq!(point.image_ids.len(), tracks, "{case}");
        }
    }
    // Observations were moved by (0.3, 0.4).
    for case in ["meshroom", "bundler"] {
        let (model, _) = read_all(capture(case).path());
        for point in &model.points {
            let error = point.error_px.expect("an error");
            assert!((error - 0.5).abs() < 1e-9, "{case}: {error}");
        }
    }
}

#[test]
fn what_is_left_out_is_said() {
    let said = |case: &str| -> Vec<String> {
        let (_, faults) = read_all(capture(case).path());
        faults.into_iter().map(|fault| fault.message).collect()
    };
    assert_eq!(
        said("metashape"),
        [
            "1 cameras are disabled and are left out",
            "1 cameras were not aligned and are left out"
        ]
    );
    assert_eq!(
        said("bundler"),
        ["1 of 6 cameras were not aligned and are left out"]
    );
    assert_eq!(
        said("meshroom"),
        ["1 of 6 views were not aligned and are left out"]
    );
    assert_eq!(
        said("opensfm"),
        [
            "the reconstruction fell into 2 parts; part 1 with 5 images is used, left out: 0 (1 images)"
        ]
    );
    assert!(said("transforms_ngp")[0].starts_with("scale, offset and aabb are not applied"));
    for silent in ["colmap", "transforms_opencv", "realitycapture"] {
        assert!(said(silent).is_empty(), "{silent}");
    }
}

#[test]
fn the_largest_of_several_colmap_models_is_taken() {
    let dir = capture("colmap");
    let whole = dir.path().join("sparse/0");
    // 2 and 10: numbers, not text. Two images in one, all in the other, none in the flat one.
    fs::rename(&whole, dir.path().join("sparse/10")).expect("renamed");
    let copy = |to: &str, images: usize| {
        let to = dir.path().join(to);
        fs::create_dir_all(&to).expect("a folder");
        for name in ["cameras.txt", "points3D.txt"] {
            fs::copy(dir.path().join("sparse/10").join(name), to.join(name)).expect("a copy");
        }
        let text = fs::read_to_string(dir.path().join("sparse/10/images.txt")).expect("images");
        let lines: Vec<&str> = text
            .lines()
            .filter(|line| !line.starts_with('#'))
            .take(2 * images)
            .collect();
        fs::write(to.join("images.txt"), lines.join("\n") + "\n").expect("written");
    };
    copy("sparse/2", 2);
    copy("sparse", 0);
    let (model, faults) = read_all(dir.path());
    assert_eq!(model.images.len(), 5);
    let messages: Vec<&str> = faults.iter().map(|fault| fault.message.as_str()).collect();
    assert_eq!(
        messages,
        [
            "the reconstruction fell into 3 models; sparse/10 with 5 images is used, left out: \
             sparse/2 (2 images), sparse (0 images)"
        ]
    );
    // The flat folder alone.
    for number in ["2", "10"] {
        fs::remove_dir_all(dir.path().join("sparse").join(number)).expect("removed");
    }
    copy_back(
        &reference().join("colmap/sparse/0"),
        &dir.path().join("sparse"),
    );
    let (model, faults) = read_all(dir.path());
    assert_eq!((model.images.len(), faults), (5, Vec::new()));
}

fn copy_back(from: &Path, to: &Path) {
    for entry in fs::read_dir(from).expect("a folder") {
        let entry = entry.expect("an entry");
        fs::copy(entry.path(), to.join(entry.file_name())).expect("a copy");
    }
}

#[test]
fn binary_counts_decide_as_well_and_are_not_believed_beyond_the_file() {
    let dir = capture("colmap_rig");
    let small = dir.path().join("sparse/1");
    fs::create_dir_all(&small).expect("a folder");
    copy_back(&dir.path().join("sparse/0"), &small);
    let mut bytes = fs::read(small.join("images.bin")).expect("images");
    bytes[..8].copy_from_slice(&u64::MAX.to_le_bytes());
    bytes.truncate(80);
    fs::write(small.join("images.bin"), bytes).expect("written");
    let mut faults = Faults::default();
    let taken = colmap::locate(dir.path(), Path::new("sparse"), &mut faults);
    assert_eq!(taken, Some(PathBuf::from("sparse/0")));
    assert!(
        faults.into_list()[0]
            .message
            .contains("sparse/1 (1 images)")
    );
}

#[test]
fn of_several_formats_one_is_taken_and_capture_toml_decides() {
    let dir = capture("colmap");
    for (case, from, to) in [
        ("metashape", "cameras.xml", "scan/cameras.xml"),
        ("metashape", "cameras.xml", "cameras.xml"),
        ("bundler", "bundle/bundle.out", "bundle/bundle.out"),
    ] {
        let to = dir.path().join(to);
        fs::create_dir_all(to.parent().expect("a folder")).expect("a folder");
        fs::copy(reference().join(case).join(from), to).expect("a copy");
    }
    let (_, faults) = read_all(dir.path());
    assert_eq!(
        faults[0].message,
        "the capture holds several reconstructions; the COLMAP model is used, left out: cameras.xml (Metashape XML), \
         bundle/bundle.out (Bundler file)"
    );
    assert!(faults[0].hint.contains("capture.toml"));
    let naming = |path: &str| Settings {
        reconstruction: Some((path.into(), 3)),
        ..Settings::default()
    };
    for (path, images) in [("scan/cameras.xml", 5), ("sparse", 5), ("sparse/0", 5)] {
        let (model, faults) = read_with(dir.path(), &naming(path));
        assert_eq!(model.images.len(), images, "{path}: {faults:?}");
        assert!(
            !faults.iter().any(|fault| fault.message.contains("several")),
            "{path}"
        );
    }
    for (path, message) in [
        ("none.xml", "the reconstruction none.xml is missing"),
        ("images", "the reconstruction images is of no known format"),
        (
            "images/photo_1.png",
            "the reconstruction images/photo_1.png is of no known format",
        ),
    ] {
        let (_, faults) = read_with(dir.path(), &naming(path));
        assert_eq!(faults.len(), 1, "{path}");
        assert_eq!(
            (faults[0].at.as_str(), faults[0].message.as_str()),
            ("capture.toml:3", message)
        );
    }
}

#[test]
fn the_files_of_a_reconstruction_are_listed() {
    let files = |dir: &Path| -> Vec<String> {
        camera_files(dir)
            .iter()
            .map(|path| path.display().to_string())
            .collect()
    };
    assert!(files(capture("colmap").path()).is_empty());
    assert_eq!(
        files(capture("bundler").path()),
        ["bundle/bundle.out", "list.txt"]
    );
    assert_eq!(
        files(capture("opensfm").path()),
        ["opensfm/reconstruction.json"]
    );
    let dir = capture("transforms_opencv");
    assert_eq!(files(dir.path()), ["sparse_pc.ply", "transforms.json"]);
    fs::create_dir_all(dir.path().join("m")).expect("a folder");
    fs::write(dir.path().join("m/1.png"), "").expect("a file");
    let path = dir.path().join("transforms.json");
    let text = fs::read_to_string(&path).expect("the file");
    let named = text.replacen(
        "\"file_path\"",
        "\"mask_path\": \"m/1.png\", \"file_path\"",
        1,
    );
    fs::write(&path, named).expect("written");
    fs::create_dir_all(dir.path().join("colmap")).expect("a folder");
    copy_back(
        &reference().join("colmap/sparse/0"),
        &dir.path().join("colmap"),
    );
    fs::write(
        dir.path().join("capture.toml"),
        "reconstruction = 'colmap'\n",
    )
    .expect("written");
    assert_eq!(
        files(dir.path()),
        [
            "colmap/cameras.txt",
            "colmap/frames.txt",
            "colmap/images.txt",
            "colmap/points3D.txt",
            "colmap/rigs.txt",
            "m/1.png",
            "sparse_pc.ply",
            "transforms.json"
        ]
    );
}

#[test]
fn damaged_bytes_never_panic() {
    let sizes: Vec<(String, (u32, u32))> = NAMES
        .iter()
        .map(|name| ((*name).to_owned(), (96, 70)))
        .collect();
    let mut state = 1_u64;
    let mut random = move |below: usize| {
        // Knuth's linear congruential generator; the high bits are the good ones.
        state = state
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        (state >> 33) as usize % below
    };
    for (case, file) in [
        ("bundler", "bundle/bundle.out"),
        ("meshroom", "sfm.json"),
        ("metashape_frame", "cameras.xml"),
        ("opensfm", "opensfm/reconstruction.json"),
        ("realitycapture_all_terms", "cameras.csv"),
        ("transforms_opencv", "transforms.json"),
    ] {
        let whole = fs::read(reference().join(case).join(file)).expect("the file");
        let (format, faults) = check_cameras(&whole, &sizes);
        assert!(format.is_some(), "{case}");
        let errors = faults
            .iter()
            .filter(|fault| fault.severity == Severity::Error);
        assert_eq!(errors.count(), 0, "{case}: {faults:?}");
        let mut found = 0;
        for _ in 0..120 {
            let mut bytes = whole.clone();
            for _ in 0..=random(4) {
                let at = random(bytes.len());
                bytes[at] = b"0-9.e\"{}[]<>,#\n\xff"[random(16)];
            }
            if random(4) == 0 {
                bytes.truncate(random(bytes.len()));
            }
            let (_, faults) = check_cameras(&bytes, &sizes);
            found += usize::from(!faults.is_empty());
        }
        assert!(found > 20, "{case}: {found}");
    }
}

/// Faults and model of an edited fixture.
fn edited(case: &str, file: &str, edit: impl Fn(String) -> String) -> (Model, Vec<Fault>) {
    let dir = capture(case);
    let path = dir.path().join(file);
    let text = fs::read_to_string(&path).expect("the file");
    let changed = edit(text.clone());
    assert_ne!(text, changed, "{case}: nothing was edited");
    fs::write(&path, changed).expect("written");
    read_all(dir.path())
}

#[test]
fn components_that_are_not_placed_to_each_other_are_not_mixed() {
    let split = |component: &str, text: &str| {
        let second =
            format!("<component id=\"1\" label=\"2\">{component}</component></components>");
        let text = text.replace("</components>", &second);
        // Photographs 4 and 5, and with them the group.
        let (head, group) = text.split_once("<group").expect("a group");
        let group = group.replacen("component_id=\"0\"", "component_id=\"1\"", 2);
        format!("{head}<group{group}")
    };
    let (model, faults) = edited("metashape", "cameras.xml", |text| split("", &text));
    assert_eq!(model.images.len(), 3);
    assert_eq!(
        faults[0].message,
        "the cameras fell into 2 components that are not placed to each other; the largest, 0, is used, left out: \
         component 1 (2 images)"
    );
    let moved = "<transform><translation>1 2 3</translation><scale>2</scale></transform>";
    let (model, faults) = edited("metashape", "cameras.xml", |text| split(moved, &text));
    assert_eq!(model.images.len(), 5);
    assert!(
        faults[0]
            .message
            .ends_with("all are used: component 0 (3 images), component 1 (2 images)")
    );
    // Two of them in the second component's frame: scaled and moved from its own, which is the file's.
    let (plain, _) = edited("metashape", "cameras.xml", |text| {
        split("<transform><scale>1</scale></transform>", &text)
    });
    for index in [3, 4] {
        let center = |model: &Model| {
            let pose = model.images[index].camera_from_world;
            pose.inverse().translation
        };
        let expected = 2.0 * center(&plain) + DVec3::new(1.0, 2.0, 3.0);
        assert!(center(&model).abs_diff_eq(expected, 1e-9));
    }
}

#[test]
fn a_georeferenced_chunk_and_followers_of_a_system_are_said() {
    let (_, faults) = edited("metashape", "cameras.xml", |text| {
        text.replace("LOCAL_CS[", "GEOGCS[")
            .replace("<camera id=\"8\"", "<camera id=\"8\" master_id=\"0\"")
    });
    let messages: Vec<&str> = faults.iter().map(|fault| fault.message.as_str()).collect();
    assert_eq!(
        messages,
        [
            "the chunk has a coordinate reference system: its cameras are in geocentric coordinates",
            "1 cameras are disabled and are left out",
            "1 cameras follow another one in a multi-camera system, which is not supported, and are left out",
        ]
    );
}

#[test]
fn views_of_a_meshroom_rig_are_composed() {
    // Photographs 1 and 2 become sub-poses of one rig pose, that of the first.
    let sub_pose = "{\"status\": \"estimated\", \"pose\": {\"rotation\": [\"0\", \"1\", \"0\", \"-1\", \"0\", \"0\", \"0\", \"0\", \"1\"], \"center\": [\"0.5\", \"0\", \"0\"]}}";
    let unmoved = sub_pose.replace(
        "\"0\", \"1\", \"0\", \"-1\", \"0\", \"0\", \"0\", \"0\", \"1\"], \"center\": [\"0.5\"",
        "\"1\", \"0\", \"0\", \"0\", \"1\", \"0\", \"0\", \"0\", \"1\"], \"center\": [\"0\"",
    );
    let (model, faults) = edited("meshroom", "sfm.json", |text| {
        let rig = |sub: usize| {
            format!(
                "\"rigId\": \"9\", \"subPoseId\": \"{sub}\", \"isPoseIndependant\": \"false\", \"poseId\": \"100\","
            )
        };
        text.replacen("\"poseId\": \"100\",", &rig(0), 1)
            .replacen("\"poseId\": \"101\",", &rig(1), 1)
            .replacen(
                "\"poses\":",
                &format!("\"rigs\": [{{\"rigId\": \"9\", \"subPoses\": [{unmoved}, {sub_pose}]}}], \"poses\":"),
                1,
            )
    });
    assert!(model.has_all_images, "{faults:?}");
    let (first, second) = (&model.images[0], &model.images[1]);
    let (plain, _) = read_all(capture("meshroom").path());
    assert!(
        first
            .camera_from_world
            .abs_diff_eq(plain.images[0].camera_from_world, 1e-12)
    );
    // The second stands half a unit to the right of the first and is turned by a quarter around its axis.
    let seen = first
        .camera_from_world
        .transform_point3(second.camera_from_world.inverse().translation);
    assert!(seen.abs_diff_eq(DVec3::new(0.5, 0.0, 0.0), 1e-12), "{seen}");
    let axis = second.camera_from_world * first.camera_from_world.inverse();
    assert!(
        axis.matrix3
            .x_axis
            .abs_diff_eq(DVec3::new(0.0, 1.0, 0.0), 1e-12)
    );
}

#[test]
fn nesting_and_entities_do_no_harm() {
    let deep = |open: &str, close: &str| open.repeat(200_000) + &close.repeat(200_000);
    let bomb = "<!DOCTYPE d [<!ENTITY a \"aaaa\"><!ENTITY b \"&a;&a;&a;&a;\">]>";
    for text in [
        format!(
            "<document><chunk>{}</chunk></document>",
            deep("<a>", "</a>")
        ),
        format!("{bomb}<document><chunk label=\"&b;\"></chunk></document>"),
        format!("{{\"frames\": {}}}", deep("[", "]")),
        format!("{{\"frames\": [], \"x\": {}}}", deep("{\"frames\":", "}")),
        format!("[{{\"cameras\": {{}}, \"shots\": {}}}]", deep("[", "]")),
        "# Bundle file v0.3\n99999999999999 99999999999999\n".to_owned(),
        format!(
            "#name,x,y,alt,heading,pitch,roll,f\n\"{}",
            "a\n".repeat(100_000)
        ),
    ] {
        let (_, faults) = check_cameras(text.as_bytes(), &[]);
        assert!(
            faults.iter().any(|fault| fault.severity == Severity::Error),
            "{}",
            &text[..60]
        );
    }
}
