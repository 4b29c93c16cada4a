//! Proxies: the formats that are found, and one built from the points where there is none.

use std::f64::consts::TAU;
use std::fmt::Write as _;

use glam::{DVec2, DVec3};
use ign_capture::{Background, Severity};

use crate::common::{Capture, HEIGHT, VIEWS, WIDTH};

/// `points3D.txt` with points all over a ball of radius 0.5, each seen by the views that face it.
fn ball_points(count: usize) -> String {
    let golden = TAU * (1.0 - 1.0 / 1.618_033_988_75);
    let mut text = String::new();
    for at in 0..count {
        let z = 1.0 - 2.0 * (at as f64 + 0.5) / count as f64;
        let (ring, turn) = ((1.0 - z * z).sqrt(), golden * at as f64);
        let normal = DVec3::new(ring * turn.cos(), ring * turn.sin(), z);
        let place = normal * 0.5;
        write!(
            text,
            "{} {} {} {} 200 100 50 0.3",
            at + 1,
            place.x,
            place.y,
            place.z
        )
        .expect("a line");
        for view in 0..VIEWS {
            if (Capture::camera(view).center() - place)
                .normalize_or_zero()
                .dot(normal)
                > 0.2
            {
                write!(text, " {} 0", view + 1).expect("a line");
            }
        }
        text.push('\n');
    }
    text
}

#[test]
fn every_usual_name_is_found() {
    let capture = Capture::sound();
    let triangle =
        "outer loop\nvertex 0.5 0 0\nvertex 0 0.5 0\nvertex 0 0 0.5\nendloop\nendfacet\n";
    let gltf = r#"{"asset":{"version":"2.0"},"scenes":[{"nodes":[0]}],"nodes":[{"mesh":0,"scale":[0.5,0.5,0.5]}],
        "meshes":[{"primitives":[{"attributes":{"POSITION":0}}]}],
        "accessors":[{"bufferView":0,"componentType":5126,"count":3,"type":"VEC3"}],
        "bufferViews":[{"buffer":0,"byteLength":36}],
        "buffers":[{"byteLength":36,"uri":"data:;base64,AACAPwAAAAAAAAAAAAAAAAAAgD8AAAAAAAAAAAAAAAAAAIA/"}]}"#;
    capture.remove("mesh.ply");
    for (name, text) in [
        (
            "mesh.stl",
            format!("solid one\nfacet normal 0 0 1\n{triangle}endsolid one\n"),
        ),
        ("mesh.gltf", gltf.to_owned()),
        (
            "mesh.obj",
            "mtllib none.mtl\nv .5 0 0\nv 0 .5 0\nv 0 0 .5\nusemtl a\nf 1 2 3\n".to_owned(),
        ),
    ] {
        capture.write(name, &text);
        let scene = capture.import();
        assert_eq!(scene.info.proxy, Some(name.into()), "later names go first");
        assert_eq!(scene.mesh.positions[1], DVec3::new(0.0, 0.5, 0.0), "{name}");
    }
}

#[test]
fn without_a_mesh_one_is_built_and_said_so() {
    let capture = Capture::sound();
    capture.remove("mesh.ply");
    capture.write("sparse/0/points3D.txt", &ball_points(5000));
    let scene = capture.import();
    assert_eq!(scene.info.proxy, None);
    let words = scene.info.proxy_built.expect("built");
    assert!(words.contains("of the model's 5000 points"), "{words}");
    let warning = scene.warnings.iter().find(|fault| fault.message == words);
    assert_eq!(warning.map(|fault| fault.severity), Some(Severity::Warning));
    for place in &scene.mesh.positions {
        // No view sees the bottom: at the rim of the hole there the surface goes on for two spacings of 0.025, straight.
        let bound = if place.z > -0.4 { 0.01 } else { 0.025 };
        assert!((place.length() - 0.5).abs() < bound, "{place}");
    }
}

#[test]
fn masks_close_what_the_points_leave_open() {
    let capture = Capture::sound();
    capture.remove("mesh.ply");
    capture.write("sparse/0/points3D.txt", &ball_points(5000));
    // The lower part lost its points.
    let upper: String = ball_points(5000)
        .lines()
        .filter(|line| {
            line.split(' ')
                .nth(3)
                .is_some_and(|z| !z.starts_with("-0.4"))
        })
        .flat_map(|line| [line, "\n"])
        .collect();
    capture.write("sparse/0/points3D.txt", &upper);
    for view in 0..VIEWS {
        let camera = Capture::camera(view);
        let eye = camera.center();
        let value = |x: u32, y: u32| {
            let px = DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
            let along = (camera.unproject(px, 1.0) - eye).normalize_or_zero();
            let on_ball = eye.cross(along).length() < 0.5;
            if on_ball { 255 } else { 0 }
        };
        capture.mask(&format!("img {view}.png"), (WIDTH, HEIGHT), value);
    }
    let scene = capture.import();
    assert_eq!(scene.background, Background::MaskedOut);
    let words = scene.info.proxy_built.expect("built");
    assert!(words.contains("agree with the masks to 9"), "{words}");
    let lowest = scene
        .mesh
        .positions
        .iter()
        .map(|place| place.z)
        .fold(0.0, f64::min);
    assert!(lowest < -0.45, "{lowest}");
}

#[test]
fn points_that_do_not_suffice_are_refused_with_the_way_out() {
    let capture = Capture::sound();
    capture.remove("mesh.ply");
    for (points, reason) in [
        (String::new(), "the proxy mesh is missing"),
        (
            ball_points(60),
            "of 60 points are usable, at least 100 are needed",
        ),
        (ball_points(150), "of the object's radius apart"),
    ] {
        capture.write("sparse/0/points3D.txt", &points);
        let found = capture.faults();
        assert_eq!(found.len(), 1, "{found:#?}");
        assert!(found[0].message.contains(reason), "{}", found[0].message);
        assert!(
            found[0]
                .hint
                .contains("colmap poisson_mesher --input_path dense/fused.ply")
        );
    }
    // Masks that show something else than the points.
    capture.write("sparse/0/points3D.txt", &ball_points(5000));
    for view in 0..VIEWS {
        capture.mask(&format!("img {view}.png"), (WIDTH, HEIGHT), |x, _| {
            if x < 50 { 255 } else { 0 }
        });
    }
    let found = capture.faults();
    assert!(
        found[0].message.contains("do not suffice to build one"),
        "{}",
        found[0].message
    );
}
