//! Captures at the hard cases of `tests/README.md`: imported right, or refused by a fault that names the place.

use std::fmt::Write as _;

use glam::{DAffine3, DMat3, DQuat, DVec3};
use ign_capture::{Frame, ImportOptions, Scene, ViewImage, import};
use ign_geometry::{Camera, GBuffer};

use crate::common::{Capture, HEIGHT, VIEWS, WIDTH, errors, octahedron};

const FRAME: Frame = Frame::Object {
    size: 24,
    margin: 0.1,
};

/// `images.txt` of these poses, in this order.
fn images(poses: &[(String, DAffine3)]) -> String {
    let mut text = String::new();
    for (index, (name, pose)) in poses.iter().enumerate() {
        let (q, t) = (DQuat::from_mat3(&pose.matrix3), pose.translation);
        let id = index + 1;
        writeln!(
            text,
            "{id} {:?} {:?} {:?} {:?} {:?} {:?} {:?} 1 {name}\n",
            q.w, q.x, q.y, q.z, t.x, t.y, t.z
        )
        .expect("a line");
    }
    text
}

fn poses() -> Vec<(String, DAffine3)> {
    (0..VIEWS)
        .map(|view| (Capture::name(view), Capture::camera(view).camera_from_world))
        .collect()
}

/// All views in the pixels that are worked with, and their normalised cameras' depth maps.
fn loaded(scene: &Scene) -> Vec<(ViewImage, GBuffer)> {
    let normal = scene.mesh.normalisation();
    let mesh = scene.mesh.transformed(&normal);
    (0..scene.views.len())
        .map(|view| {
            let camera = scene.frame_camera(view, &FRAME, 1);
            let image = scene.load_view(view, &camera).expect("a picture");
            (
                image,
                GBuffer::render(&mesh, &camera.transformed(normal), 1),
            )
        })
        .collect()
}

#[test]
fn worlds_of_millions_and_odd_scales_load_the_same_pixels() {
    let capture = Capture::sound();
    for view in 0..VIEWS {
        capture.photograph(view, |x, y| {
            [(3 * x) as u8, (4 * y) as u8, (17 * view) as u8]
        });
    }
    let expected = loaded(&capture.import());
    for (scale, offset) in [
        (1.0, DVec3::new(4.5e5, 5.2e6, 1.1e6)),
        (1.0, DVec3::new(-1.7e7, 1.0e7, 3.0e6)),
        (1e-4, DVec3::new(3e-4, 0.0, -1e-4)),
        (1e4, DVec3::new(0.0, 2e4, 5e3)),
    ] {
        let moved: Vec<(String, DAffine3)> = poses()
            .into_iter()
            .map(|(name, pose)| {
                // As the file's reader sees it: the rotation of its quaternion, not the one it was made from.
                let rotation = DMat3::from_quat(DQuat::from_mat3(&pose.matrix3).normalize());
                let translation = pose.translation * scale - rotation * offset;
                (
                    name,
                    DAffine3 {
                        matrix3: rotation,
                        translation,
                    },
                )
            })
            .collect();
        capture.write("sparse/0/images.txt", &images(&moved));
        let text = octahedron(0.5).replace("property float", "property double");
        let (header, body) = text.split_once("end_header\n").expect("a header");
        let mut mesh = format!("{header}end_header\n");
        for line in body.lines() {
            let numbers: Vec<f64> = line
                .split(' ')
                .map(|word| word.parse().expect("a number"))
                .collect();
            match numbers[..] {
                [x, y, z] => {
                    let p = DVec3::new(x, y, z) * scale + offset;
                    writeln!(mesh, "{:?} {:?} {:?}", p.x, p.y, p.z).expect("a line");
                }
                _ => writeln!(mesh, "{line}").expect("a line"),
            }
        }
        capture.write("mesh.ply", &mesh);
        let found = loaded(&capture.import());
        assert_eq!(found.len(), expected.len());
        for ((image, buffer), (other, expected)) in found.iter().zip(&expected) {
            let worst = image
                .rgb
                .iter()
                .zip(&other.rgb)
                .map(|(a, b)| (a - b).abs())
                .fold(0.0, f32::max);
            assert!(
                worst < 1.0 / 255.0,
                "scale {scale}, offset {offset}: pixels differ by {worst}"
            );
            // f64 has 4e-9 left of a coordinate of 1.7e7, a window's edge moves by as much of a pixel's thousandth.
            let differing =
                (0..buffer.mask.len()).filter(|at| buffer.mask[*at] != expected.mask[*at]);
            assert!(differing.count() <= 2, "scale {scale}, offset {offset}");
        }
    }
}

#[test]
fn hard_intrinsics_are_imported_or_named() {
    for (camera, fault) in [
        ("1 PINHOLE 80 60 nan 95 41.5 28.25", Some("camera 1")),
        ("1 PINHOLE 80 60 inf 95 41.5 28.25", Some("camera 1")),
        ("1 PINHOLE 80 60 -90 95 41.5 28.25", Some("camera 1")),
        ("1 PINHOLE 80 60 90 95 nan 28.25", Some("camera 1")),
        (
            "1 OPENCV 80 60 90 95 41.5 28.25 inf 0 0 0",
            Some("camera 1"),
        ),
        ("1 PINHOLE 80 60 1e-9 1e-9 41.5 28.25", None),
        (
            "1 PINHOLE 80 60 90 95 -300 28.25",
            Some("none of the 12 views sees the proxy"),
        ),
        ("1 PINHOLE 80 60 1e12 1e12 41.5 28.25", None),
        ("1 OPENCV 80 60 90 95 41.5 28.25 1e9 -1e9 1e6 1e6", None),
    ] {
        let capture = Capture::with_camera(camera);
        match (import(capture.dir(), &ImportOptions::default()), fault) {
            (Err(error), Some(fault)) => {
                assert!(error.to_string().contains(fault), "{camera}: {error}");
            }
            // What has no view of the proxy left says so; what has one loads.
            (Err(error), None) => assert!(error.to_string().contains("view"), "{camera}: {error}"),
            (Ok(scene), None) => {
                for (image, buffer) in loaded(&scene) {
                    assert!(
                        image.rgb.iter().all(|value| (0.0..=1.0).contains(value)),
                        "{camera}"
                    );
                    assert!(
                        buffer.depth.iter().all(|depth| depth.is_finite()),
                        "{camera}"
                    );
                }
            }
            (Ok(_), Some(fault)) => panic!("{camera} was imported, expected {fault}"),
        }
    }
}

#[test]
fn a_principal_point_outside_the_image_is_no_fault() {
    // The object is in the picture all the same: the camera looks past it.
    let capture = Capture::with_camera("1 PINHOLE 80 60 90 95 -60 28.25");
    let aside: Vec<(String, DAffine3)> = poses()
        .into_iter()
        .map(|(name, pose)| {
            (
                name,
                DAffine3::from_rotation_y((101.5_f64 / 90.0).atan()) * pose,
            )
        })
        .collect();
    capture.write("sparse/0/images.txt", &images(&aside));
    let scene = capture.import();
    assert_eq!(scene.views.len(), VIEWS);
    assert!(
        loaded(&scene)
            .iter()
            .all(|(_, buffer)| buffer.mask.iter().any(|covered| *covered))
    );
}

#[test]
fn poses_that_are_not_finite_name_the_image() {
    for bad in ["nan", "inf", "-inf"] {
        let capture = Capture::sound();
        let lines = images(&poses());
        let third = lines.lines().nth(4).expect("the third image").to_owned();
        let mut words: Vec<&str> = third.split(' ').collect();
        words[5] = bad;
        capture.write(
            "sparse/0/images.txt",
            &lines.replace(&third, &words.join(" ")),
        );
        let found = capture.faults();
        let (at, message) = errors(&found)[0];
        assert_eq!(at, "sparse/0/images.txt:5", "{message}");
        assert!(message.contains("img 2.png"), "{message}");
    }
}

#[test]
fn flat_photographs_load_as_they_are() {
    for value in [0, 255, 127] {
        let capture = Capture::sound();
        for view in 0..VIEWS {
            capture.photograph(view, |_, _| [value; 3]);
        }
        for (image, _) in loaded(&capture.import()) {
            let exact = f32::from(value) / 255.0;
            let inside = image
                .inside
                .iter()
                .zip(image.rgb.chunks(3))
                .filter(|(inside, _)| **inside > 0.0);
            assert!(
                inside
                    .flat_map(|(_, rgb)| rgb)
                    .all(|v| (v - exact).abs() < 1e-6),
                "{value}"
            );
        }
    }
}

#[test]
fn the_order_of_views_in_the_model_changes_nothing() {
    let capture = Capture::sound();
    let before = capture.import();
    let mut turned = poses();
    turned.rotate_left(5);
    turned.swap(0, 3);
    capture.write("sparse/0/images.txt", &images(&turned));
    let after = capture.import();
    let names = |scene: &Scene| {
        scene
            .views
            .iter()
            .map(|view| view.name.clone())
            .collect::<Vec<_>>()
    };
    let cameras = |scene: &Scene| {
        scene
            .views
            .iter()
            .map(|view| view.camera)
            .collect::<Vec<Camera>>()
    };
    assert_eq!(names(&before), names(&after));
    assert_eq!(
        (&before.train, &before.held_out),
        (&after.train, &after.held_out)
    );
    for (a, b) in cameras(&before).iter().zip(cameras(&after)) {
        assert!(a.camera_from_world.abs_diff_eq(b.camera_from_world, 1e-12));
    }
}

#[test]
fn views_of_one_place_are_all_kept() {
    let capture = Capture::sound();
    let one = poses()[0].1;
    let copies: Vec<(String, DAffine3)> =
        (0..VIEWS).map(|view| (Capture::name(view), one)).collect();
    capture.write("sparse/0/images.txt", &images(&copies));
    assert_eq!(capture.import().views.len(), VIEWS);
}

#[test]
fn one_view_is_too_few_and_two_are_enough() {
    for (count, fault) in [(1, true), (2, false), (3, false)] {
        let capture = Capture::sound();
        capture.write("sparse/0/images.txt", &images(&poses()[..count]));
        capture.write("sparse/0/points3D.txt", "");
        let result = import(capture.dir(), &ImportOptions::default());
        if fault {
            let found = capture.faults();
            assert!(
                errors(&found)[0].1.contains("1 training views are too few"),
                "{found:?}"
            );
        } else {
            assert_eq!(result.expect("enough").views.len(), count);
        }
    }
}

#[test]
fn damaged_proxies_are_mended_or_named() {
    let sound = octahedron(0.5);
    let faces = |extra: &str, count: usize| {
        sound.replace("element face 8", &format!("element face {count}")) + extra
    };
    for (what, text, fault) in [
        (
            "no faces",
            sound
                .split("3 0 2 4")
                .next()
                .expect("a header")
                .replace("element face 8", "element face 0"),
            true,
        ),
        (
            "a vertex that is not finite",
            sound.replacen("0.5 0 0", "nan 0 0", 1),
            true,
        ),
        (
            "an infinite vertex",
            sound.replacen("0.5 0 0", "0.5 inf 0", 1),
            true,
        ),
        ("a face beyond the vertices", faces("3 0 1 9\n", 9), true),
        (
            "only degenerate faces",
            sound
                .split("3 0 2 4")
                .next()
                .expect("a header")
                .replace("element face 8", "element face 2")
                + "3 0 0 1\n3 2 2 2\n",
            true,
        ),
        ("degenerate faces", faces("3 0 0 1\n3 2 2 2\n", 10), false),
        (
            "copies and flipped copies",
            faces("3 0 2 4\n3 2 0 4\n", 10),
            false,
        ),
        (
            "an edge of four faces",
            faces("3 0 2 1\n3 0 2 3\n", 10),
            false,
        ),
        (
            "a hole",
            sound
                .replacen("3 0 2 4\n", "", 1)
                .replace("element face 8", "element face 7"),
            false,
        ),
    ] {
        let capture = Capture::sound();
        capture.write("mesh.ply", &text);
        if fault {
            let found = capture.faults();
            assert!(
                errors(&found)[0].0.starts_with("mesh.ply"),
                "{what}: {found:?}"
            );
        } else {
            assert_eq!(capture.import().views.len(), VIEWS, "{what}");
        }
    }
}

#[test]
fn a_photograph_on_its_side_is_named() {
    let capture = Capture::sound();
    image::RgbImage::new(HEIGHT, WIDTH)
        .save(capture.path("images/img 4.png"))
        .expect("a picture");
    let found = capture.faults();
    assert!(errors(&found)[0].1.contains("img 4.png"), "{found:?}");
}
