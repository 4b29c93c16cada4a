//! Rasteriser, G-buffer and coverage map.

use glam::DVec3;
use ign_geometry::{
    Camera, CameraError, CameraIntrinsics, GBuffer, Mesh, MeshError, NO_TRIANGLE, Similarity,
    coverage_map, rasterize,
};
use ign_scenes::oracle::{hits, pixels, ray};
use ign_scenes::{check, hard};

/// Depths are f32: 6e-8 of rounding.
const DEPTH: f64 = 1e-6;

/// Compares depth and coverage of pixel centres with ray casting, wherever the hit does not hang on a rounding: not
/// within `1e-7` of a triangle's edge, nor of another surface. How many pixels were compared and hit.
fn assert_like_the_oracle(what: &str, mesh: &Mesh, camera: &Camera) -> usize {
    let raster = rasterize(mesh, camera);
    check::raster(&raster).unwrap_or_else(|wrong| panic!("{what}: {wrong}"));
    let mut compared = 0;
    for (index, column, row) in pixels(camera) {
        let (origin, direction) = ray(camera, f64::from(column) + 0.5, f64::from(row) + 0.5);
        let all: Vec<_> = hits(mesh, origin, direction).collect();
        let near_an_edge = |weights: [f64; 3]| weights.iter().any(|weight| weight.abs() < 1e-7);
        if all.iter().any(|hit| near_an_edge(hit.weights)) {
            continue;
        }
        let nearest = all
            .iter()
            .map(|hit| hit.distance)
            .fold(f64::INFINITY, f64::min);
        let depth = f64::from(raster.depth[index]);
        if nearest == f64::INFINITY {
            // The oracle's own edges are sharp, the sample may lie within a rounding of one.
            let margin = || ambiguous(mesh, origin, direction);
            assert!(
                raster.triangle[index] == NO_TRIANGLE || margin(),
                "{what}: pixel ({column}, {row}) is empty, drawn at depth {depth}"
            );
        } else {
            assert!(
                (depth / nearest - 1.0).abs() < DEPTH,
                "{what}: pixel ({column}, {row}) at {depth}, by ray casting {nearest}"
            );
            compared += 1;
        }
    }
    compared
}

/// Whether the ray passes within a rounding of some triangle's edge.
fn ambiguous(mesh: &Mesh, origin: DVec3, direction: DVec3) -> bool {
    mesh.triangles.iter().any(|corners| {
        let [a, b, c] = corners.map(|corner| mesh.positions[corner as usize]);
        let normal = (b - a).cross(c - a);
        let distance = (a - origin).dot(normal) / direction.dot(normal);
        let point = origin + direction * distance;
        let area =
            |p: DVec3, q: DVec3| (p - point).cross(q - point).dot(normal) / normal.length_squared();
        let weights = [area(b, c), area(c, a), area(a, b)];
        weights.iter().all(|weight| *weight > -1e-7) && weights.iter().any(|weight| *weight < 1e-7)
    })
}

/// G-buffers with 1 to 4 samples and coverage maps are sound, and agree on what is covered.
fn assert_sound(what: &str, mesh: &Mesh, camera: &Camera) {
    for samples in 1..=4 {
        let buffer = GBuffer::render(mesh, camera, samples);
        check::g_buffer(&buffer).unwrap_or_else(|wrong| panic!("{what}: {wrong}"));
        // Where a pixel has attributes at all; a needle may have none.
        let coverage = coverage_map(mesh, camera, 1, samples);
        for (share, found) in coverage.iter().zip(&buffer.coverage) {
            assert!(share == found || *found == 0.0, "{what}: {share}, {found}");
        }
    }
    check::shares(&coverage_map(mesh, camera, 3, 2))
        .unwrap_or_else(|wrong| panic!("{what}: {wrong}"));
}

#[test]
fn hard_cameras_see_what_rays_meet() {
    let mesh = hard::object(14, 20);
    let mut compared = 0;
    for (what, camera) in hard::cameras() {
        compared += assert_like_the_oracle(what, &mesh, &camera);
        assert_sound(what, &mesh, &camera);
    }
    assert!(compared > 2500, "only {compared} pixels hit the object");
}

#[test]
fn damaged_meshes_are_drawn_as_rays_meet_them() {
    for (what, mesh) in hard::damaged_meshes(8, 12) {
        let mut compared = 0;
        for camera in hard::ring() {
            compared += assert_like_the_oracle(what, &mesh, &camera);
            assert_sound(what, &mesh, &camera);
        }
        assert!(compared > 0, "{what}: nothing in view");
    }
}

#[test]
fn winding_and_copies_change_no_pixel() {
    let meshes = hard::damaged_meshes(8, 12);
    let sound = hard::object(8, 12);
    let find = |name: &str| {
        &meshes
            .iter()
            .find(|(what, _)| *what == name)
            .expect("there")
            .1
    };
    for camera in hard::ring() {
        let expected = GBuffer::render(&sound, &camera, 2);
        for name in [
            "flipped triangles",
            "duplicate triangles",
            "flipped duplicates of every triangle",
        ] {
            let found = GBuffer::render(find(name), &camera, 2);
            assert_eq!(found.coverage, expected.coverage, "{name}");
            assert_eq!(found.depth, expected.depth, "{name}");
            assert_eq!(found.position, expected.position, "{name}");
        }
        // Doubling every triangle doubles each face's share of a vertex's normal.
        let doubled = GBuffer::render(find("duplicate triangles"), &camera, 2);
        for (a, b) in doubled
            .normal
            .iter()
            .flatten()
            .zip(expected.normal.iter().flatten())
        {
            assert!((a - b).abs() < 1e-6);
        }
    }
}

#[test]
fn normals_follow_the_surface_however_its_faces_are_wound() {
    // Of mixed or doubled faces the sum at a vertex is too short, or nothing but rounding in whatever direction.
    // Faces around a vertex here are less than 60 degrees apart: more, and one cannot tell a fold from a turned face.
    let meshes = hard::damaged_meshes(28, 40);
    let turned = ["flipped triangles", "flipped duplicates of every triangle"];
    for (what, mesh) in meshes.iter().filter(|(what, _)| turned.contains(what)) {
        for camera in hard::ring() {
            let buffer = GBuffer::render(mesh, &camera, 1);
            let sound = GBuffer::render(&hard::object(28, 40), &camera, 1);
            for at in (0..buffer.mask.len()).filter(|at| buffer.mask[*at]) {
                let [found, expected] = [&buffer, &sound]
                    .map(|buffer| DVec3::from_array(buffer.normal[at].map(f64::from)));
                assert!(
                    (found - expected).length() < 1e-5,
                    "{what}, pixel {at}: {found}, not {expected}"
                );
            }
        }
    }
}

#[test]
fn grazing_angles_up_to_89_9_degrees_are_exact() {
    let mesh = hard::plane(6);
    for degrees in [0.0, 45.0, 80.0, 89.0, 89.9] {
        for distance in [0.3, 1.5, 40.0] {
            let camera = hard::grazing(degrees, distance);
            let what = format!("{degrees} degrees from {distance}");
            let hit = assert_like_the_oracle(&what, &mesh, &camera);
            assert_sound(&what, &mesh, &camera);
            assert!(hit > 0 || distance > 2.0, "{what}: nothing in view");
            let buffer = GBuffer::render(&mesh, &camera, 1);
            for at in (0..buffer.mask.len()).filter(|at| buffer.mask[*at]) {
                let [x, y, z] = buffer.position[at];
                assert!(
                    z.abs() < 1e-7 && x.abs().max(y.abs()) < 1.0 + 1e-6,
                    "{what}: {x} {y} {z}"
                );
                assert!(
                    buffer.normal[at][2] > 1.0 - 1e-6,
                    "{what}: the plane's normal"
                );
            }
        }
    }
}

#[test]
fn depth_towards_zero_is_exact_and_what_is_behind_is_not_drawn() {
    let mesh = hard::plane(4);
    for distance in [1e-1, 1e-3, 1e-6, 1e-9, 1e-12] {
        let camera = hard::grazing(0.0, distance);
        let raster = rasterize(&mesh, &camera);
        assert!(
            raster
                .triangle
                .iter()
                .all(|triangle| *triangle != NO_TRIANGLE)
        );
        for depth in raster.depth {
            assert!(
                (f64::from(depth) / distance - 1.0).abs() < DEPTH,
                "{depth} at {distance}"
            );
        }
        assert_sound("near", &mesh, &camera);
    }
    // In the plane itself, and beyond it with the back turned.
    let mut camera = hard::grazing(0.0, 1.0);
    for z in [0.0, -1e-300, -1e-9, -1.0] {
        camera.camera_from_world.translation.z = z;
        let raster = rasterize(&mesh, &camera);
        assert!(
            raster
                .triangle
                .iter()
                .all(|triangle| *triangle == NO_TRIANGLE),
            "{z}"
        );
        assert_sound("behind", &mesh, &camera);
    }
}

#[test]
fn a_world_of_millions_and_odd_scales_draw_the_same() {
    let mesh = hard::object(10, 14);
    let expected = GBuffer::render(&mesh, &hard::ordinary(), 2);
    for (scale, offset) in [
        (1.0, DVec3::new(4.5e5, 5.2e6, 1.1e6)),
        (1.0, DVec3::new(-1.7e7, 1.0e7, 3.0e6)),
        (1e-4, DVec3::new(3e-4, 0.0, -1e-4)),
        (1e4, DVec3::new(0.0, 2e4, 5e3)),
        (1e-4, DVec3::new(120.0, -40.0, 7.0)),
    ] {
        let world_from_here = Similarity {
            scale,
            translation: -offset / scale,
        };
        let world = mesh.transformed(&world_from_here);
        let camera = hard::ordinary().transformed(world_from_here);
        // As an import does it: normalised from the world's coordinates.
        let normal_from_world = world.normalisation();
        let back = GBuffer::render(
            &world.transformed(&normal_from_world),
            &camera.transformed(normal_from_world),
            2,
        );
        let here = mesh.normalisation();
        let straight = GBuffer::render(
            &mesh.transformed(&here),
            &hard::ordinary().transformed(here),
            2,
        );
        // f64 has 2e-9 left of a coordinate of 1.7e7, and the object is 1 across.
        let bound = 1e-6 + 4.0 * offset.abs().max_element() * f64::EPSILON / scale;
        let differing = (0..back.mask.len()).filter(|at| back.mask[*at] != straight.mask[*at]);
        assert_eq!(differing.count(), 0, "scale {scale}, offset {offset}");
        for (a, b) in back.depth.iter().zip(&straight.depth) {
            assert!(
                f64::from((a - b).abs()) < bound,
                "scale {scale}, offset {offset}: {a} {b}"
            );
        }
        assert_eq!(straight.coverage, expected.coverage);
        assert_sound("a world of millions", &world, &camera);
    }
}

#[test]
fn width_and_height_are_not_confused() {
    let mesh = hard::object(10, 14);
    for (width, height) in [(50, 7), (7, 50), (1, 33), (33, 1)] {
        let intrinsics = CameraIntrinsics {
            width,
            height,
            cx: f64::from(width) * 0.45,
            cy: f64::from(height) * 0.55,
            ..hard::INTRINSICS
        };
        let camera = hard::ordinary().with_intrinsics(intrinsics);
        let what = format!("{width}x{height}");
        assert!(assert_like_the_oracle(&what, &mesh, &camera) > 10, "{what}");
        assert_sound(&what, &mesh, &camera);
    }
}

#[test]
fn cameras_that_are_not_finite_are_refused_by_name() {
    let good = hard::ordinary();
    for bad in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
        let with = |change: &dyn Fn(&mut CameraIntrinsics)| {
            let mut intrinsics = hard::INTRINSICS;
            change(&mut intrinsics);
            Camera::new(intrinsics, good.camera_from_world)
        };
        assert!(matches!(
            with(&|i| i.fx = bad),
            Err(CameraError::FocalLength { .. })
        ));
        assert!(matches!(
            with(&|i| i.cy = bad),
            Err(CameraError::PrincipalPoint { .. })
        ));
        let mut pose = good.camera_from_world;
        pose.translation.y = bad;
        assert!(matches!(
            Camera::new(hard::INTRINSICS, pose),
            Err(CameraError::PoseNotFinite)
        ));
        // And put together by hand all the same, it draws nothing and breaks nothing.
        let camera = Camera {
            camera_from_world: pose,
            ..good
        };
        assert_sound("a pose that is not finite", &hard::object(4, 6), &camera);
    }
    for zero in [0.0, -1.0] {
        let intrinsics = CameraIntrinsics {
            fy: zero,
            ..hard::INTRINSICS
        };
        assert!(Camera::new(intrinsics, good.camera_from_world).is_err());
    }
}

#[test]
fn meshes_that_are_none_are_refused_by_name() {
    let good = hard::object(4, 6);
    for bad in [f64::NAN, f64::INFINITY] {
        let mut positions = good.positions.clone();
        positions[5].z = bad;
        assert!(matches!(
            Mesh::new(positions, good.triangles.clone()),
            Err(MeshError::NotFinite { vertex: 5 })
        ));
    }
    for triangles in [vec![], vec![[1, 1, 2]], vec![[0, 0, 0]; 9]] {
        assert!(matches!(
            Mesh::new(good.positions.clone(), triangles),
            Err(MeshError::NoTriangles { .. })
        ));
    }
    assert!(matches!(
        Mesh::new(good.positions, vec![[0, 1, 9999]]),
        Err(MeshError::IndexOutOfRange { index: 9999, .. })
    ));
}

#[test]
fn coordinates_that_f32_cannot_hold_are_not_drawn() {
    // Finite in f64, infinite or zero as the f32 that maps are made of.
    for scale in [1e60, 1e39, 1e-60] {
        let world_from_here = Similarity {
            scale,
            translation: DVec3::ZERO,
        };
        let mesh = hard::object(4, 6).transformed(&world_from_here);
        let camera = hard::ordinary().transformed(world_from_here);
        assert_sound("too large for f32", &mesh, &camera);
        check::raster(&rasterize(&mesh, &camera)).expect("sound");
    }
}
