//! Every fault of a capture folder is found, named with its place, and all of them in one pass.

use std::fs;

use crate::common::{Capture, HEIGHT, VIEWS, WIDTH, errors, faults, octahedron};
use ign_capture::{Background, ImportOptions, Severity, import};

#[test]
fn a_sound_capture_is_imported() {
    let scene = Capture::sound().import();
    assert_eq!(
        (
            scene.views.len(),
            scene.points.len(),
            scene.mesh.triangles.len()
        ),
        (VIEWS, 1, 8)
    );
    assert!(scene.warnings.is_empty(), "{:?}", scene.warnings);
    assert_eq!(scene.background, Background::Silhouette);
    // Path order compares numbers: img 2 before img 10. Image ids 1 and 3 are views 0 and 2.
    let names: Vec<&str> = scene.views.iter().map(|view| view.name.as_str()).collect();
    assert_eq!(names[..3], ["img 0.png", "img 1.png", "img 2.png"]);
    assert_eq!(scene.points[0].views, [0, 2]);
    assert_eq!(scene.held_out, [4]);
    assert_eq!(scene.train.len(), 11);
    for (index, view) in scene.views.iter().enumerate() {
        let expected = Capture::camera(index);
        assert!(
            view.camera
                .camera_from_world
                .abs_diff_eq(expected.camera_from_world, 1e-12)
        );
        assert_eq!(view.camera.intrinsics, expected.intrinsics);
    }
}

#[test]
fn everything_wrong_is_found_in_one_pass() {
    let capture = Capture::sound();
    capture.write("capture.toml", "title = \"T\"\ntitel = \"T\"\n");
    capture.replace("mesh.ply", "0.5 0 0", "nan 0 0");
    capture.remove("images/img 2.png");
    capture.write("images/img 5.png", "not a picture");
    image::RgbImage::new(HEIGHT, WIDTH)
        .save(capture.path("images/img 7.png"))
        .expect("a picture");
    capture.write("test.txt", "img 1.png\n\nimg 99.png\nimg 3.jpg\n");
    capture.write("sparse/0/points3D.txt", "1 0 0\n");
    let found = capture.faults();
    let errors = errors(&found);
    let expected = [
        ("capture.toml:2", "unknown key \"titel\""),
        ("mesh.ply", "the proxy mesh cannot be used"),
        (
            "sparse/0/points3D.txt:1",
            "the line ends before the position",
        ),
        (
            "sparse/0/images.txt:6",
            "the photograph images/img 2.png is missing",
        ),
        (
            "images/img 5.png",
            "images/img 5.png is no image that can be read",
        ),
        (
            "images/img 7.png",
            "is 60x80 pixels, its camera 1 says 80x60 (turned by 90 degrees?)",
        ),
        ("test.txt:3", "held-out view img 99.png is unknown"),
        ("test.txt:4", "held-out view img 3.jpg is unknown"),
    ];
    assert_eq!(errors.len(), expected.len(), "{errors:#?}");
    for ((at, message), (expected_at, expected_message)) in errors.iter().zip(expected) {
        assert!(at.starts_with(expected_at), "{at}: {message}");
        assert!(message.contains(expected_message), "{at}: {message}");
    }
    assert!(found.iter().all(|fault| !fault.hint.is_empty()));
    let hint = found
        .iter()
        .find(|fault| fault.at == "test.txt:4")
        .map(|fault| fault.hint.as_str());
    assert_eq!(hint, Some("is img 3.png meant?"));
}

#[test]
fn missing_parts_are_one_fault_each() {
    let empty = tempfile::tempdir().expect("a scratch folder");
    let found = faults(empty.path(), &ImportOptions::default());
    assert_eq!(errors(&found).len(), 1);
    assert_eq!(found[0].message, "the capture folder is empty");

    let found = faults(&empty.path().join("nowhere"), &ImportOptions::default());
    assert!(
        found[0]
            .message
            .starts_with("cannot read the capture folder")
    );

    fs::write(empty.path().join("readme.txt"), "x").expect("a file");
    let found = faults(empty.path(), &ImportOptions::default());
    let places: Vec<&str> = errors(&found).iter().map(|error| error.0).collect();
    assert_eq!(places, ["sparse/", "images/", "mesh.ply"]);

    for (part, at) in [
        ("images", "images/"),
        ("sparse", "sparse/"),
        ("sparse/0/images.txt", "sparse/0/images.txt"),
        ("mesh.ply", "mesh.ply"),
    ] {
        let capture = Capture::sound();
        capture.write("test.txt", "img 4.png\n");
        capture.remove(part);
        let found = capture.faults();
        assert_eq!(found.len(), 1, "{part}: {found:#?}");
        assert_eq!(found[0].at, at);
    }
}

#[test]
fn a_zero_focal_length_is_named_once_with_its_line() {
    let capture = Capture::with_camera("1 PINHOLE 80 60 0 95 41.5 28.25");
    let found = capture.faults();
    assert_eq!(
        errors(&found),
        [("sparse/0/cameras.txt:2", "camera 1 has zero focal length")]
    );
}

#[test]
fn images_of_unknown_cameras_outside_names_and_doubles_are_faults() {
    let capture = Capture::sound();
    capture.replace("sparse/0/images.txt", "1 img 3.png", "9 img 3.png");
    capture.replace("sparse/0/images.txt", "1 img 5.png", "1 ../img 5.png");
    capture.replace("sparse/0/images.txt", "1 img 7.png", "1 img 8.png");
    let found = capture.faults();
    let messages: Vec<&str> = errors(&found).iter().map(|error| error.1).collect();
    assert_eq!(
        messages,
        [
            "image \"../img 5.png\" has a name that points outside images/",
            "image img 8.png is in the model twice",
            "image img 3.png names camera 9, which the model does not have",
        ]
    );
}

#[test]
fn proxies_are_found_by_option_settings_and_name() {
    let capture = Capture::sound();
    capture.write("scan/fine.ply", &octahedron(0.25));
    let imported = |proxy: Option<&str>| {
        let options = ImportOptions {
            proxy: proxy.map(Into::into),
        };
        let scene = import(capture.dir(), &options).expect("a sound capture");
        (
            scene.info.proxy.expect("a file").display().to_string(),
            scene.mesh.bounding_sphere().1 < 0.3,
        )
    };
    assert_eq!(imported(None), ("mesh.ply".into(), false));
    capture.write("capture.toml", "proxy = \"scan/fine.ply\"\n");
    assert_eq!(imported(None), ("scan/fine.ply".into(), true));
    assert_eq!(imported(Some("mesh.ply")), ("mesh.ply".into(), false));
    for (proxy, message) in [
        ("../mesh.ply", "lies outside the capture"),
        ("none.ply", "is missing"),
    ] {
        let found = faults(
            capture.dir(),
            &ImportOptions {
                proxy: Some(proxy.into()),
            },
        );
        assert!(found[0].message.contains(message), "{}", found[0].message);
    }
    capture.write("capture.toml", "\nproxy = \"gone.ply\"\n");
    assert_eq!(
        errors(&capture.faults()),
        [("capture.toml:2", "the proxy gone.ply is missing")]
    );
}

#[test]
fn held_out_lists_are_checked() {
    let capture = Capture::sound();
    capture.write("test.txt", "# two of them\nimg 1.png\nimg 10.png\n");
    let scene = capture.import();
    assert_eq!(scene.held_out, [1, 10]);
    capture.write(
        "capture.toml",
        "held_out = [\"img 10.png\", \"img 1.png\"]\n",
    );
    assert_eq!(capture.import().held_out, [1, 10]);
    capture.write("capture.toml", "held_out = [\"img 10.png\"]\n");
    assert!(capture.faults()[0].message.contains("differ"));
    capture.remove("test.txt");
    assert_eq!(capture.import().held_out, [10]);

    // A photograph that COLMAP did not register is no fault.
    fs::copy(
        capture.path("images/img 1.png"),
        capture.path("images/extra.png"),
    )
    .expect("a copy");
    capture.write(
        "capture.toml",
        "held_out = [\"img 10.png\", \"extra.png\"]\n",
    );
    let scene = capture.import();
    assert_eq!(scene.warnings.len(), 2, "{:?}", scene.warnings);

    let all: Vec<String> = (0..VIEWS).map(Capture::name).collect();
    capture.remove("capture.toml");
    capture.write("test.txt", &all.join("\n"));
    assert_eq!(
        errors(&capture.faults()),
        [("test.txt", "all 12 views are held out")]
    );
    capture.write("test.txt", &all[1..].join("\n"));
    assert!(
        capture.faults()[0]
            .message
            .contains("1 training views are too few")
    );
}

#[test]
fn views_that_do_not_see_the_proxy_are_left_out() {
    let capture = Capture::sound();
    let place = |x: f64, y: f64, z: f64| format!("1 0 0 0 {x} {y} {z} 1 img");
    let lines = fs::read_to_string(capture.path("sparse/0/images.txt")).expect("the model");
    let mut lines: Vec<String> = lines.lines().map(str::to_owned).collect();
    lines[1] = format!("1 {} 0.png", place(0.0, 0.0, -3.0));
    lines[3] = format!("2 {} 1.png", place(5.0, 0.0, 3.0));
    lines[5] = format!("3 {} 2.png", place(0.0, 0.0, 0.1));
    capture.write("sparse/0/images.txt", &(lines.join("\n") + "\n"));
    let scene = capture.import();
    assert_eq!(scene.views.len(), VIEWS - 3);
    let warnings: Vec<(&str, &str)> = scene
        .warnings
        .iter()
        .map(|fault| {
            (
                fault.at.as_str(),
                fault.message.split(';').next().unwrap_or(""),
            )
        })
        .collect();
    assert_eq!(
        warnings,
        [
            ("view img 0.png", "the proxy lies behind the camera"),
            ("view img 1.png", "the proxy lies outside the picture"),
            ("view img 2.png", "the camera stands inside the proxy"),
        ]
    );
    assert!(
        scene
            .warnings
            .iter()
            .all(|fault| fault.severity == Severity::Warning)
    );

    capture.write("mesh.ply", &shifted_octahedron());
    let found = capture.faults();
    assert!(
        errors(&found)[0]
            .1
            .contains("none of the 12 views sees the proxy"),
        "{found:#?}"
    );
}

/// Far away from every camera's picture.
fn shifted_octahedron() -> String {
    let text = octahedron(0.5);
    let (header, body) = text.split_once("end_header\n").expect("a header");
    let mut shifted = format!("{header}end_header\n");
    for line in body.lines() {
        let numbers: Vec<f64> = line
            .split(' ')
            .map(|word| word.parse().expect("a number"))
            .collect();
        if line.starts_with("3 ") {
            shifted += line;
        } else {
            let [x, y, z] = numbers[..] else {
                panic!("three numbers: {line}")
            };
            shifted.extend([x, y, z - 500.0].map(|value| format!("{value} ")));
        }
        shifted.push('\n');
    }
    shifted
}

#[test]
fn masks_are_found_by_both_names_and_checked() {
    let capture = Capture::sound();
    let is_object = |x: u32, y: u32| (20..60).contains(&x) && (15..45).contains(&y);
    for view in 0..VIEWS {
        let file = if view % 2 == 0 {
            format!("img {view}.png")
        } else {
            format!("img {view}.png.png")
        };
        capture.mask(&file, (WIDTH, HEIGHT), |x, y| {
            if is_object(x, y) { 255 } else { 0 }
        });
    }
    assert_eq!(capture.import().background, Background::MaskedOut);
    for view in 0..VIEWS {
        capture.photograph(view, |x, y| {
            if is_object(x, y) {
                [200, 150, 90]
            } else {
                [1, 0, 2]
            }
        });
    }
    assert_eq!(capture.import().background, Background::Black);
    // With the meaning turned round, the object is what is not black.
    capture.write("capture.toml", "masks = \"white_is_background\"\n");
    assert_eq!(capture.import().background, Background::MaskedOut);
    capture.remove("capture.toml");

    capture.mask("img 3.png.png", (WIDTH, HEIGHT - 1), |_, _| 255);
    capture.remove("masks/img 6.png");
    capture.write("masks/img 8.png", "no picture");
    let found = capture.faults();
    let places: Vec<&str> = errors(&found).iter().map(|error| error.0).collect();
    assert_eq!(
        places,
        ["masks/img 3.png.png", "masks/img 6.png", "masks/img 8.png"]
    );
}

#[test]
fn damaged_pixels_are_a_typed_error_when_loaded() {
    let capture = Capture::sound();
    let scene = capture.import();
    let path = capture.path("images/img 3.png");
    let bytes = fs::read(&path).expect("the picture");
    fs::write(&path, &bytes[..bytes.len() - 40]).expect("cut short");
    let camera = scene.views[3].camera;
    let error = scene.load_view(3, &camera).expect_err("a damaged picture");
    assert!(
        matches!(&error, ign_capture::ImportError::Image { view, .. } if view == "img 3.png"),
        "{error}"
    );
    assert!(matches!(
        scene.load_view(99, &camera),
        Err(ign_capture::ImportError::NoSuchView { index: 99, .. })
    ));
}
