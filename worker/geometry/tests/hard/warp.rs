//! Cross-projection and its depth test.

use glam::DVec3;
use ign_geometry::{Camera, GBuffer, WarpOptions, Warped, cross_project};
use ign_scenes::oracle::{bilinear, margin, surface_point};
use ign_scenes::{check, hard};

/// A view's image in [0, 1].
fn rgb(camera: &Camera, value: impl Fn(usize, usize) -> u8) -> Vec<f32> {
    let pixels = (camera.intrinsics.width * camera.intrinsics.height) as usize;
    (0..pixels)
        .flat_map(|at| [0, 1, 2].map(|channel| f32::from(value(at, channel)) / 255.0))
        .collect()
}

/// Warps and compares each pixel with the plain implementation. How many points the source sees.
fn assert_like_the_oracle(
    what: &str,
    source: &GBuffer,
    rgb: &[f32],
    target: &GBuffer,
) -> (Warped, usize) {
    let options = WarpOptions::default();
    let warped = cross_project(source, rgb, target, &options);
    check::warped(&warped, rgb).unwrap_or_else(|wrong| panic!("{what}: {wrong}"));
    let mut seen = 0;
    for at in 0..target.mask.len() {
        if !target.mask[at] {
            assert!(
                warped.visibility[at] < 0.5,
                "{what}: nothing is seen at {at}"
            );
            continue;
        }
        let (position, normal) = surface_point(target, at);
        let margin = margin(source, position, normal, &options);
        // Depths are f32: next to the threshold a rounding decides.
        let depth = source.camera.camera_from_world.transform_point3(position).z;
        if margin.is_some_and(|margin| margin.abs() < 1e-6 * depth) {
            continue;
        }
        let visible = margin.is_some_and(|margin| margin > 0.0);
        let cos = normal.dot((source.camera.center() - position).normalize_or_zero());
        if (cos - options.grazing_cos).abs() > 1e-6 {
            assert_eq!(warped.visibility[at] > 0.5, visible, "{what}: pixel {at}");
        }
        if visible {
            seen += 1;
            let px = source.camera.project(position).expect("in front").px;
            for channel in 0..3 {
                let plain = bilinear(
                    |i| Some(f64::from(rgb[i * 3 + channel])),
                    &source.camera,
                    px,
                );
                let fast = f64::from(warped.rgb[at * 3 + channel]);
                assert!(
                    (fast - plain.expect("all count")).abs() < 1e-5,
                    "{what}: pixel {at}"
                );
            }
        }
    }
    (warped, seen)
}

#[test]
fn hard_cameras_agree_with_the_plain_warp_both_ways() {
    let mesh = hard::object(14, 20);
    let ordinary = GBuffer::render(&mesh, &hard::ring()[0], 2);
    let mut seen = 0;
    for (what, camera) in hard::cameras() {
        let other = GBuffer::render(&mesh, &camera, 2);
        for (source, target) in [(&ordinary, &other), (&other, &ordinary)] {
            let image = rgb(&source.camera, hard::pattern);
            seen += assert_like_the_oracle(what, source, &image, target).1;
        }
    }
    assert!(seen > 1500, "only {seen} points are seen");
}

#[test]
fn a_baseline_of_1e_6_is_the_same_view() {
    let mesh = hard::object(14, 20);
    let here = hard::ordinary();
    let mut there = here;
    there.camera_from_world.translation.x += 1e-6;
    let [here, there] = [here, there].map(|camera| GBuffer::render(&mesh, &camera, 1));
    let image = rgb(&here.camera, hard::pattern);
    let (warped, seen) = assert_like_the_oracle("a baseline of 1e-6", &here, &image, &there);
    assert!(seen > 200);
    for at in (0..there.mask.len()).filter(|at| warped.visibility[*at] > 0.5) {
        // 1e-6 at depth 1.5 moves a pixel by 3e-5 of itself, a pixel of the image by the whole range.
        for channel in 0..3 {
            let difference = (warped.rgb[3 * at + channel] - image[3 * at + channel]).abs();
            assert!(difference < 2e-4, "pixel {at} differs by {difference}");
        }
    }
}

#[test]
fn views_without_overlap_see_nothing_of_each_other() {
    let mesh = hard::object(14, 20);
    // A closed object from two sides.
    let [front, back] = [DVec3::new(2.5, 0.0, -0.2), DVec3::new(-2.5, 0.0, -0.2)]
        .map(|eye| GBuffer::render(&mesh, &hard::looking(eye), 1));
    let image = rgb(&front.camera, hard::pattern);
    let (_, seen) = assert_like_the_oracle("from behind", &front, &image, &back);
    let covered = back.mask.iter().filter(|covered| **covered).count();
    // What both see is the rim, which the open top shows.
    assert!(seen * 20 < covered, "{seen} of {covered}");
    let blind = GBuffer::render(&mesh, &hard::blind(), 1);
    for (source, target) in [(&blind, &front), (&front, &blind)] {
        let image = rgb(&source.camera, hard::pattern);
        let (warped, seen) = assert_like_the_oracle("a blind view", source, &image, target);
        assert_eq!(seen, 0);
        assert!(warped.visibility.iter().all(|visible| *visible < 0.5));
    }
}

#[test]
fn grazing_surfaces_are_rejected_as_the_threshold_says() {
    let mesh = hard::plane(6);
    let target = GBuffer::render(&mesh, &hard::grazing(20.0, 1.5), 1);
    for degrees in [45.0, 80.0, 89.0, 89.9] {
        let source = GBuffer::render(&mesh, &hard::grazing(degrees, 30.0), 1);
        let image = rgb(&source.camera, hard::pattern);
        let what = format!("{degrees} degrees");
        let (_, seen) = assert_like_the_oracle(&what, &source, &image, &target);
        // cos 87.1 degrees is 0.05; from afar all of the plane is seen at about one angle.
        assert_eq!(seen > 0, degrees < 87.0, "{what}: {seen} points");
    }
}

#[test]
fn flat_images_stay_flat() {
    let mesh = hard::object(14, 20);
    let views: Vec<GBuffer> = hard::ring()
        .iter()
        .map(|camera| GBuffer::render(&mesh, camera, 2))
        .collect();
    for (what, value) in hard::images() {
        let image = rgb(&views[0].camera, value);
        let (warped, seen) = assert_like_the_oracle(what, &views[0], &image, &views[1]);
        assert!(seen > 50);
        if matches!(what, "black" | "white" | "one colour") {
            for at in (0..views[1].mask.len()).filter(|at| warped.visibility[*at] > 0.5) {
                for channel in 0..3 {
                    let exact = f32::from(value(0, channel)) / 255.0;
                    assert!(
                        (warped.rgb[3 * at + channel] - exact).abs() < 1e-6,
                        "{what}"
                    );
                }
            }
        }
    }
}

#[test]
fn depth_and_positions_that_are_not_finite_are_seen_by_nobody() {
    let mesh = hard::object(10, 14);
    let [source, target] =
        [hard::ring()[0], hard::ring()[1]].map(|camera| GBuffer::render(&mesh, &camera, 1));
    let image = rgb(&source.camera, hard::pattern);
    let options = WarpOptions::default();
    for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        let mut broken = target.clone();
        for at in (0..broken.mask.len()).step_by(3) {
            broken.position[at][at % 3] = bad;
            broken.normal[at] = [bad; 3];
        }
        let warped = cross_project(&source, &image, &broken, &options);
        check::warped(&warped, &image).expect("sound");
        assert!(
            warped
                .visibility
                .iter()
                .step_by(3)
                .all(|visible| *visible < 0.5)
        );
        let mut broken = source.clone();
        broken.depth.fill(bad);
        let warped = cross_project(&broken, &image, &target, &options);
        check::warped(&warped, &image).expect("sound");
        assert!(
            warped.visibility.iter().all(|visible| *visible < 0.5),
            "depth {bad}"
        );
    }
}
