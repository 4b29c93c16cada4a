//! Views loaded into the pixels of a camera: where things land, and what the filter yields.

use std::fmt::Write as _;
use std::path::Path;

use crate::common::{Capture, HEIGHT, PINHOLE, VIEWS, WIDTH};
use glam::{DAffine3, DQuat, DVec2, DVec3};
use ign_capture::{Frame, ImportOptions, Scene, ViewImage, import};
use ign_geometry::Camera;

/// Centre of the light in a picture, in continuous pixels.
fn centroid(image: &ViewImage) -> DVec2 {
    let (mut sum, mut weight) = (DVec2::ZERO, 0.0);
    for y in 0..image.height {
        for x in 0..image.width {
            let value = f64::from(image.rgb[((y * image.width + x) * 3) as usize]);
            sum += value * DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
            weight += value;
        }
    }
    sum / weight
}

/// Draws a small disc, anti-aliased by its distance, black elsewhere.
fn disc(center: DVec2, radius: f64) -> impl Fn(u32, u32) -> [u8; 3] {
    move |x, y| {
        let distance = center.distance(DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5));
        [((radius - distance + 0.5).clamp(0.0, 1.0) * 255.0).round() as u8; 3]
    }
}

#[test]
fn a_point_lands_where_its_camera_projects_it_for_every_lens() {
    let lenses = [
        PINHOLE,
        "1 SIMPLE_PINHOLE 80 60 92 41.5 28.25",
        "1 SIMPLE_RADIAL 80 60 92 41.5 28.25 -0.2",
        "1 RADIAL 80 60 92 41.5 28.25 -0.25 0.1",
        "1 OPENCV 80 60 90 95 41.5 28.25 -0.2 0.05 0.006 -0.004",
        "1 FULL_OPENCV 80 60 90 95 41.5 28.25 0.1 0.02 0.004 -0.003 0.01 0.25 0.05 0.01",
        "1 OPENCV_FISHEYE 80 60 90 95 41.5 28.25 -0.05 0.02 0 0",
        "1 SIMPLE_RADIAL_FISHEYE 80 60 92 41.5 28.25 -0.07",
    ];
    let point = DVec3::new(0.21, -0.17, 0.13);
    for lens in lenses {
        let capture = Capture::with_camera(lens);
        let scene = capture.import();
        for view in [0, 3, 7] {
            let in_camera = scene.views[view]
                .camera
                .camera_from_world
                .transform_point3(point);
            let source_px = scene.views[view]
                .source
                .project(in_camera)
                .expect("a pixel");
            capture.photograph(view, disc(source_px, 2.0));
            let frames = [
                Frame::Whole { long_side: 80 },
                Frame::Whole { long_side: 31 },
                Frame::Object {
                    size: 52,
                    margin: 0.1,
                },
            ];
            for frame in frames {
                let camera = scene.frame_camera(view, &frame, 1);
                let image = scene.load_view(view, &camera).expect("a picture");
                let expected = camera.project(point).expect("in front").px;
                // The disc itself is quantised and sampled: a few hundredths of a pixel.
                let off = centroid(&image).distance(expected);
                assert!(
                    off < 0.06,
                    "{lens}, view {view}, {frame:?}: off by {off} px"
                );
            }
        }
    }
}

/// Panoramas have no pinhole: each view gets one that looks at the object, wherever the panorama's seam lies.
#[test]
fn a_point_lands_where_it_is_in_a_panorama() {
    let capture = Capture::with_camera("1 EQUIRECTANGULAR 80 60 80 60");
    let point = DVec3::new(0.21, -0.17, 0.13);
    for yaw in [0.0_f64, 1.1, 2.9, -3.1] {
        // The same places, with each panorama turned about its own vertical axis.
        let mut images = String::new();
        let turned =
            |view: usize| DAffine3::from_rotation_y(yaw) * Capture::camera(view).camera_from_world;
        for view in 0..8 {
            let (q, t) = (
                DQuat::from_mat3(&turned(view).matrix3),
                turned(view).translation,
            );
            writeln!(
                images,
                "{} {} {} {} {} {} {} {} 1 {}\n",
                view + 1,
                q.w,
                q.x,
                q.y,
                q.z,
                t.x,
                t.y,
                t.z,
                Capture::name(view)
            )
            .expect("a line");
        }
        capture.write("sparse/0/images.txt", &images);
        let scene = capture.import();
        assert_eq!(scene.views.len(), 8);
        for view in [0, 3, 7] {
            let ray = turned(view).transform_point3(point);
            // A soft cone around the point's direction.
            let cone = |looking: DVec3, center: DVec3| {
                (1.0 - looking.angle_between(center) / 0.15).max(0.0)
            };
            capture.photograph(view, |x, y| {
                let longitude = ((f64::from(x) + 0.5) / 80.0 - 0.5) * std::f64::consts::TAU;
                let latitude = ((f64::from(y) + 0.5) / 60.0 - 0.5) * std::f64::consts::PI;
                let looking = DVec3::new(
                    longitude.sin() * latitude.cos(),
                    latitude.sin(),
                    longitude.cos() * latitude.cos(),
                );
                [(cone(looking, ray) * 255.0).round() as u8; 3]
            });
            let frame = Frame::Object {
                size: 26,
                margin: 0.8,
            };
            let camera = scene.frame_camera(view, &frame, 1);
            let image = scene.load_view(view, &camera).expect("a picture");
            // The cone as the pinhole camera sees it.
            let center = camera.camera_from_world.transform_point3(point);
            let mut ideal = image.clone();
            for (at, value) in ideal.rgb.chunks_exact_mut(3).enumerate() {
                let px = DVec2::new((at % 26) as f64 + 0.5, (at / 26) as f64 + 0.5);
                value.fill(cone(camera.intrinsics.ray(px), center) as f32);
            }
            // Some levels across two pixels of the panorama each: a tenth of a pixel.
            let off = centroid(&image).distance(centroid(&ideal));
            assert!(off < 0.1, "turned by {yaw}, view {view}: off by {off} px");
            assert!(image.inside.iter().all(|&share| share > 0.999));
        }
    }
}

/// A photograph with no structure to it, the same for each run.
fn speckle(x: u32, y: u32) -> [u8; 3] {
    let hash = |c: u32| {
        let mut h = (x * 7919 + y * 104_729 + c * 1_299_709).wrapping_mul(0x9e37_79b1);
        h ^= h >> 15;
        (h.wrapping_mul(0x85eb_ca6b) >> 24) as u8
    };
    [hash(0), hash(1), hash(2)]
}

#[test]
fn whole_factors_are_the_exact_mean_of_the_pixels() {
    let capture = Capture::sound();
    capture.photograph(2, speckle);
    let scene = capture.import();
    for factor in [1, 2, 4, 5] {
        let camera = scene.frame_camera(
            2,
            &Frame::Whole {
                long_side: WIDTH / factor,
            },
            1,
        );
        assert_eq!(
            (camera.intrinsics.width, camera.intrinsics.height),
            (WIDTH / factor, HEIGHT / factor)
        );
        let image = scene.load_view(2, &camera).expect("a picture");
        for y in 0..HEIGHT / factor {
            for x in 0..WIDTH / factor {
                for c in 0..3 {
                    let mut sum = 0.0;
                    for (dy, dx) in (0..factor).flat_map(|dy| (0..factor).map(move |dx| (dy, dx))) {
                        sum += f64::from(speckle(x * factor + dx, y * factor + dy)[c]) / 255.0;
                    }
                    let found = image.rgb[((y * image.width + x) as usize) * 3 + c];
                    let expected = sum / f64::from(factor * factor);
                    assert!(
                        (f64::from(found) - expected).abs() < 1e-6,
                        "{factor} ({x}, {y}): {found} {expected}"
                    );
                }
            }
        }
        assert!(
            image
                .inside
                .iter()
                .all(|&inside| (inside - 1.0).abs() < 1e-6)
        );
        assert!(image.mask.is_none());
    }
}

#[test]
fn enlarging_is_bilinear() {
    let capture = Capture::sound();
    capture.photograph(2, speckle);
    let scene = capture.import();
    let camera = scene.frame_camera(
        2,
        &Frame::Whole {
            long_side: WIDTH * 3,
        },
        1,
    );
    let image = scene.load_view(2, &camera).expect("a picture");
    for (x, y) in [(100, 40), (37, 111), (200, 90)] {
        let (u, v) = (
            (f64::from(x) + 0.5) / 3.0 - 0.5,
            (f64::from(y) + 0.5) / 3.0 - 0.5,
        );
        let (x0, y0) = (u.floor() as u32, v.floor() as u32);
        let (fx, fy) = (u - u.floor(), v - v.floor());
        let at = |dx: u32, dy: u32| f64::from(speckle(x0 + dx, y0 + dy)[0]) / 255.0;
        let top = at(0, 0) * (1.0 - fx) + at(1, 0) * fx;
        let bottom = at(0, 1) * (1.0 - fx) + at(1, 1) * fx;
        let found = f64::from(image.rgb[((y * image.width + x) * 3) as usize]);
        assert!((found - (top * (1.0 - fy) + bottom * fy)).abs() < 1e-6);
    }
}

#[test]
fn a_lens_with_hardly_any_distortion_is_filtered_like_one_without() {
    let load = |camera: &str| {
        let capture = Capture::with_camera(camera);
        capture.photograph(2, speckle);
        let scene = capture.import();
        let camera = scene.frame_camera(2, &Frame::Whole { long_side: 37 }, 1);
        scene.load_view(2, &camera).expect("a picture")
    };
    let (plain, bent) = (
        load("1 SIMPLE_PINHOLE 80 60 90 41.5 28.25"),
        load("1 SIMPLE_RADIAL 80 60 90 41.5 28.25 1e-7"),
    );
    let largest = plain
        .rgb
        .iter()
        .zip(&bent.rgb)
        .map(|(a, b)| (a - b).abs())
        .fold(0.0, f32::max);
    assert!(largest < 1e-4, "{largest}");
}

#[test]
fn whole_frames_keep_the_aspect_up_to_rounding() {
    let scene = Capture::sound().import();
    let camera = scene.frame_camera(0, &Frame::Whole { long_side: 33 }, 1);
    let i = &camera.intrinsics;
    // 60 * 33 / 80 = 24.75
    assert_eq!((i.width, i.height), (33, 25));
    assert!((i.fx - 90.0 * 33.0 / 80.0).abs() < 1e-12 && (i.fy - 95.0 * 25.0 / 60.0).abs() < 1e-12);
    assert!(
        (i.cx - 41.5 * 33.0 / 80.0).abs() < 1e-12 && (i.cy - 28.25 * 25.0 / 60.0).abs() < 1e-12
    );
}

#[test]
fn scales_stop_at_the_photographs_resolution() {
    let scene = Capture::sound().import();
    let side = |frame, scale| scene.frame_camera(0, &frame, scale).intrinsics.width;
    assert_eq!(side(Frame::Whole { long_side: 40 }, 2), 80);
    assert_eq!(side(Frame::Whole { long_side: 40 }, 3), 80);
    assert_eq!(side(Frame::Whole { long_side: 41 }, 2), 41);
    assert_eq!(side(Frame::Whole { long_side: 160 }, 1), 160);
    // Object windows differ from view to view, the factor does not.
    let frame = Frame::Object {
        size: 20,
        margin: 0.05,
    };
    let sizes: Vec<u32> = (0..VIEWS)
        .map(|view| scene.frame_camera(view, &frame, 2).intrinsics.width)
        .collect();
    assert!(sizes.iter().all(|&size| size == 40), "{sizes:?}");
}

#[test]
fn object_windows_hold_the_object_with_its_margin() {
    let scene = Capture::sound().import();
    for view in 0..VIEWS {
        let camera = scene.frame_camera(
            view,
            &Frame::Object {
                size: 64,
                margin: 0.1,
            },
            1,
        );
        assert_eq!(
            (camera.intrinsics.width, camera.intrinsics.height),
            (64, 64)
        );
        let projected = scene
            .mesh
            .positions
            .iter()
            .map(|&p| camera.project(p).expect("in front").px);
        let (min, max) = projected
            .fold((DVec2::INFINITY, DVec2::NEG_INFINITY), |(min, max), px| {
                (min.min(px), max.max(px))
            });
        // The larger extent takes 1 / 1.2 of the window, and stands in its middle.
        assert!(((max - min).max_element() - 64.0 / 1.2).abs() < 1e-9);
        assert!(((min + max) / 2.0).distance(DVec2::splat(32.0)) < 1e-9);
    }
}

#[test]
fn what_lies_outside_the_photograph_is_marked() {
    let capture = Capture::sound();
    capture.photograph(1, |_, _| [255, 255, 255]);
    let scene = capture.import();
    let view = scene.views[1].camera;
    // A window of the same resolution, 10.25 pixels further to the left and 7 further down.
    let camera = Camera {
        intrinsics: view.intrinsics.cropped(-10.25, 7.0, WIDTH, HEIGHT),
        ..view
    };
    let image = scene.load_view(1, &camera).expect("a picture");
    let at = |x: u32, y: u32| (y * WIDTH + x) as usize;
    for y in 0..HEIGHT {
        for x in 0..WIDTH {
            let across = match x {
                0..10 => 0.0,
                10 => 0.75,
                _ => 1.0,
            };
            let down = if y < HEIGHT - 7 { 1.0 } else { 0.0 };
            let inside = image.inside[at(x, y)];
            assert!(
                (inside - across * down).abs() < 1e-6,
                "({x}, {y}): {inside}"
            );
            // White right up to the edge: what is outside has no part in the mean.
            let expected = if inside > 0.0 { 1.0 } else { 0.0 };
            assert!((image.rgb[at(x, y) * 3] - expected).abs() < 1e-6);
        }
    }
}

#[test]
fn masks_are_resampled_with_their_meaning() {
    let capture = Capture::sound();
    for view in 0..VIEWS {
        capture.mask(&format!("img {view}.png"), (WIDTH, HEIGHT), |x, _| {
            if x < 30 { 255 } else { 0 }
        });
    }
    let load = |scene: &Scene| {
        let camera = scene.frame_camera(0, &Frame::Whole { long_side: 20 }, 1);
        scene
            .load_view(0, &camera)
            .expect("a picture")
            .mask
            .expect("a mask")[..20]
            .to_vec()
    };
    let mut expected = [0.0; 20];
    expected[..7].fill(1.0);
    expected[7] = 0.5;
    let close = |a: &[f32], b: &[f32]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-6);
    assert!(close(&load(&capture.import()), &expected));
    capture.write("capture.toml", "masks = \"white_is_background\"\n");
    let inverse = expected.map(|value| 1.0 - value);
    assert!(close(
        &load(&import(capture.dir(), &ImportOptions::default()).expect("sound")),
        &inverse
    ));
}

#[test]
fn scenes_can_be_shared_between_threads() {
    fn shared<T: Send + Sync>() {}
    shared::<Scene>();
    let reference =
        Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/reference/make_colmap_models.py");
    assert!(
        reference.is_file(),
        "the script that wrote the reference data lies beside it"
    );
}
