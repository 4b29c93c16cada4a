//! A second, deliberately plain implementation judges the fast one: every ray against every triangle, one pixel after
//! the other, all in f64 (`ign_scenes::oracle`).
//!
//! Scenes are asymmetric on purpose (width and height differ, the principal point is off centre, rotations are
//! general, the surface is curved and hides parts of itself), or axis swaps and half-pixel errors would pass.

#![expect(clippy::float_cmp, reason = "zeros outside the mask are exact")]

use std::f64::consts::TAU;

use glam::{DVec2, DVec3};
use ign_geometry::select::{Nearest, select_nearest, select_references};
use ign_geometry::{
    Camera, CameraIntrinsics, GBuffer, Mesh, NO_TRIANGLE, WarpOptions, barycentric, coverage_map,
    cross_project, rasterize,
};
use ign_scenes::oracle::{bilinear, cast, margin, pixels, ray, surface_point};
use proptest::prelude::{ProptestConfig, prop_assert, prop_assert_eq, proptest};

/// A torus with bumps, tilted: its tube hides its far side, and itself.
fn torus(around: u32, across: u32) -> Mesh {
    let mut positions = Vec::new();
    for i in 0..around {
        for j in 0..across {
            let (u, v) = (turn(i, around), turn(j, across));
            let tube = 0.38 + 0.06 * (3.0 * u + 2.0 * v).sin();
            let ring = 0.85 + tube * v.cos();
            let flat = DVec3::new(ring * u.cos(), ring * u.sin(), tube * v.sin());
            positions.push(glam::DQuat::from_euler(glam::EulerRot::XYZ, 0.7, -0.4, 0.2) * flat);
        }
    }
    let at = |i: u32, j: u32| (i % around) * across + j % across;
    let cell = |index: u32| {
        let (i, j) = (index / across, index % across);
        [
            [at(i, j), at(i + 1, j), at(i + 1, j + 1)],
            [at(i, j), at(i + 1, j + 1), at(i, j + 1)],
        ]
    };
    Mesh::new(positions, (0..around * across).flat_map(cell).collect()).expect("valid")
}

fn turn(index: u32, count: u32) -> f64 {
    TAU * f64::from(index) / f64::from(count)
}

fn camera(azimuth: f64, height: f64, distance: f64) -> Camera {
    let intrinsics = CameraIntrinsics {
        fx: 58.0,
        fy: 61.0,
        cx: 24.7,
        cy: 16.2,
        width: 53,
        height: 38,
    };
    let eye = DVec3::new(azimuth.cos(), azimuth.sin(), height).normalize_or_zero() * distance;
    Camera::look_at(
        intrinsics,
        eye,
        DVec3::new(0.05, -0.1, 0.02),
        DVec3::new(0.3, 0.2, 0.9),
    )
    .expect("valid")
}

fn ring(count: u32) -> Vec<Camera> {
    (0..count)
        .map(|i| camera(turn(i, count), 0.7 * (f64::from(i) * 1.7).sin(), 3.0))
        .collect()
}

#[test]
fn depth_triangle_and_weights_agree_with_ray_casting() {
    let mesh = torus(32, 14);
    // From outside, from between the tube and the axis (surface on all sides, also behind), and from afar.
    for camera in [
        camera(0.4, 0.8, 3.0),
        camera(2.0, -0.2, 0.3),
        camera(4.0, 1.5, 12.0),
    ] {
        let raster = rasterize(&mesh, &camera);
        let mut covered = 0;
        for (index, column, row) in pixels(&camera) {
            let px = DVec2::new(f64::from(column) + 0.5, f64::from(row) + 0.5);
            let (origin, direction) = ray(&camera, px.x, px.y);
            let Some(hit) = cast(&mesh, origin, direction) else {
                assert_eq!(
                    raster.triangle[index], NO_TRIANGLE,
                    "pixel ({column}, {row}) is empty"
                );
                assert_eq!(raster.depth[index], 0.0);
                continue;
            };
            covered += 1;
            assert_eq!(
                raster.triangle[index] as usize, hit.triangle,
                "pixel ({column}, {row})"
            );
            // f32 rounding is 6e-8; the rest is the division by a triangle's slope.
            assert!((f64::from(raster.depth[index]) / hit.distance - 1.0).abs() < 1e-6);
            let weights = barycentric(&mesh, &camera, raster.triangle[index], px).expect("seen");
            for (fast, plain) in weights.iter().zip(hit.weights) {
                assert!((fast - plain).abs() < 1e-9);
            }
        }
        assert!(covered > 10, "the scene is in view");
    }
}

#[test]
fn g_buffer_agrees_with_ray_casting() {
    let mesh = torus(28, 12);
    for (camera, samples) in [(camera(0.4, 0.8, 3.0), 3), (camera(2.9, -0.5, 2.6), 4)] {
        let buffer = GBuffer::render(&mesh, &camera, samples);
        let eye = ray(&camera, 0.0, 0.0).0;
        for (index, column, row) in pixels(&camera) {
            let step = 1.0 / f64::from(samples);
            let mut hits = 0;
            for sample in 0..samples * samples {
                let x = f64::from(column) + (f64::from(sample % samples) + 0.5) * step;
                let y = f64::from(row) + (f64::from(sample / samples) + 0.5) * step;
                let (origin, direction) = ray(&camera, x, y);
                hits += u32::from(cast(&mesh, origin, direction).is_some());
            }
            let coverage = f64::from(hits) * step * step;
            assert!(
                (f64::from(buffer.coverage[index]) - coverage).abs() < 1e-6,
                "pixel ({column}, {row})"
            );
            assert_eq!(buffer.mask[index], hits > 0);
            let [position, normal, normal_fd, reflection] = [
                &buffer.position,
                &buffer.normal,
                &buffer.normal_fd,
                &buffer.reflection,
            ]
            .map(|map| DVec3::from_array(map[index].map(f64::from)));
            if hits == 0 {
                assert_eq!(
                    (buffer.depth[index], position, normal),
                    (0.0, DVec3::ZERO, DVec3::ZERO)
                );
                assert_eq!(buffer.triangle[index], NO_TRIANGLE);
                assert_eq!((normal_fd, reflection), (DVec3::ZERO, DVec3::ZERO));
                continue;
            }
            // Whatever sample was taken, its attributes belong together.
            let seen = camera.project(position).expect("in front");
            assert!((seen.depth - f64::from(buffer.depth[index])).abs() < 1e-6 * seen.depth);
            let place = seen.px - DVec2::new(f64::from(column), f64::from(row));
            assert!(
                place.min_element() > 0.0 && place.max_element() < 1.0,
                "inside its pixel"
            );
            let view = (position - eye).normalize_or_zero();
            for unit in [normal, normal_fd, reflection] {
                assert!((unit.length() - 1.0).abs() < 1e-5);
            }
            assert!(
                normal.dot(view) < 1e-6 && normal_fd.dot(view) < 1e-6,
                "faces the camera"
            );
            assert!((view - normal * (2.0 * view.dot(normal)) - reflection).length() < 1e-5);
            // Where the centre is covered, it is what was taken.
            let (origin, direction) = ray(&camera, f64::from(column) + 0.5, f64::from(row) + 0.5);
            let Some(hit) = cast(&mesh, origin, direction) else {
                continue;
            };
            assert!(
                (position - (origin + direction * hit.distance)).length() < 1e-6 * hit.distance
            );
            let corners = mesh.triangles[hit.triangle].map(|corner| corner as usize);
            let mut smooth = DVec3::ZERO;
            for (corner, weight) in corners.iter().zip(hit.weights) {
                smooth += mesh.normals[*corner] * weight;
            }
            let smooth = smooth.normalize_or_zero();
            // At the silhouette the smooth normal may point away; there it was turned to be perpendicular.
            if smooth.dot(view) < -1e-3 {
                assert!((normal - smooth).length() < 1e-5, "pixel ({column}, {row})");
            }
        }
    }
}

#[test]
fn normals_by_differences_are_those_of_neighbouring_positions() {
    let mesh = torus(28, 12);
    // So near that all four borders of the image cut through the object.
    let camera = camera(1.3, 0.4, 1.7);
    let buffer = GBuffer::render(&mesh, &camera, 1);
    let (width, height) = (buffer.width as i64, buffer.height as i64);
    let at = |column: i64, row: i64| {
        let inside = (0..width).contains(&column) && (0..height).contains(&row);
        let index = (row * width + column) as usize;
        (inside && buffer.mask[index]).then(|| surface_point(&buffer, index).0)
    };
    let mut borders = 0;
    for (index, column, row) in pixels(&camera) {
        let (column, row) = (i64::from(column), i64::from(row));
        let Some(here) = at(column, row) else {
            continue;
        };
        let step = |dx: i64, dy: i64| {
            let after = at(column + dx, row + dy).unwrap_or(here);
            after - at(column - dx, row - dy).unwrap_or(here)
        };
        let normal = step(1, 0).cross(step(0, 1)).normalize_or_zero();
        let view = (here - camera.center()).normalize_or_zero();
        // Next to the silhouette the plane of the neighbours may contain the viewing ray: no side is right there.
        if normal == DVec3::ZERO || normal.dot(view).abs() < 1e-2 {
            continue;
        }
        let normal = if normal.dot(view) > 0.0 {
            -normal
        } else {
            normal
        };
        let fast = DVec3::from_array(buffer.normal_fd[index].map(f64::from));
        // Positions are f32, differences a hundredth of them.
        assert!((normal - fast).length() < 1e-4, "pixel ({column}, {row})");
        borders += u32::from(column == 0) + u32::from(column == width - 1);
    }
    assert!(borders > 10, "the object leaves the image on both sides");
}

#[test]
fn winding_does_not_matter() {
    let mesh = torus(28, 12);
    let mut mixed = mesh.clone();
    for triangle in mixed.triangles.iter_mut().step_by(3) {
        triangle.swap(1, 2);
    }
    let camera = camera(2.9, -0.5, 2.6);
    let (straight, mixed) = (
        GBuffer::render(&mesh, &camera, 2),
        GBuffer::render(&mixed, &camera, 2),
    );
    assert!(straight.coverage == mixed.coverage && straight.triangle == mixed.triangle);
    for (a, b) in straight
        .normal
        .iter()
        .flatten()
        .zip(mixed.normal.iter().flatten())
    {
        assert!((a - b).abs() < 1e-5);
    }
    // Nor does the sign of the normals that a file brought along.
    let mut inverted = mesh.clone();
    inverted
        .normals
        .iter_mut()
        .for_each(|normal| *normal = -*normal);
    let inverted = GBuffer::render(&inverted, &camera, 2);
    let away = |index: &usize| {
        let (a, b) = (
            surface_point(&straight, *index).1,
            surface_point(&inverted, *index).1,
        );
        (a - b).length() > 1e-5
    };
    let covered = straight.mask.iter().filter(|covered| **covered).count();
    // But where an interpolated normal leans over the silhouette, the face decides its side.
    assert!((0..straight.mask.len()).filter(away).count() * 100 <= covered);
}

#[test]
fn normals_by_differences_follow_the_surface() {
    let mesh = torus(96, 48);
    let camera = camera(0.4, 0.8, 3.0);
    let fine = camera.with_intrinsics(camera.intrinsics.resized(53 * 8, 38 * 8));
    let buffer = GBuffer::render(&mesh, &fine, 1);
    let mut angles: Vec<f64> = (0..buffer.mask.len())
        .filter(|index| buffer.mask[*index])
        .map(|index| {
            let [a, b] = [buffer.normal[index], buffer.normal_fd[index]]
                .map(|n| DVec3::from_array(n.map(f64::from)));
            a.dot(b).clamp(-1.0, 1.0).acos()
        })
        .collect();
    angles.sort_by(f64::total_cmp);
    // Facets of this mesh differ from its smooth normals by up to half their 7.5 degrees.
    assert!(
        angles[angles.len() / 2] < 0.05,
        "median {}",
        angles[angles.len() / 2]
    );
    assert!(
        angles[angles.len() * 9 / 10] < 0.12,
        "90 % {}",
        angles[angles.len() * 9 / 10]
    );
}

#[test]
fn coverage_of_groups_agrees_with_ray_casting() {
    let mesh = torus(28, 12);
    let camera = camera(1.1, 0.3, 3.0);
    let (group, samples) = (2, 2);
    let cells = coverage_map(&mesh, &camera, group, samples);
    let (width, height) = (53 * group, 38 * group);
    assert_eq!(cells.len(), (width * height) as usize);
    let step = 1.0 / f64::from(group * samples);
    for (index, cell) in cells.iter().enumerate() {
        let (column, row) = (index as u32 % width, index as u32 / width);
        let mut hits = 0.0;
        for sample in 0..samples * samples {
            let x = (f64::from(column * samples + sample % samples) + 0.5) * step;
            let y = (f64::from(row * samples + sample / samples) + 0.5) * step;
            let (origin, direction) = ray(&camera, x, y);
            hits += f64::from(cast(&mesh, origin, direction).is_some());
        }
        assert!(
            (f64::from(*cell) - hits / f64::from(samples * samples)).abs() < 1e-6,
            "cell ({column}, {row})"
        );
    }
}

/// An image without symmetry.
fn picture(camera: &Camera) -> Vec<f32> {
    let wave = |column: u32, row: u32, channel: u32| {
        let (x, y) = (f64::from(column), f64::from(row));
        (0.5 + 0.5 * (0.21 * x + 0.13 * y * f64::from(channel + 1) + f64::from(channel)).sin())
            as f32
    };
    pixels(camera)
        .flat_map(|(_, column, row)| [0, 1, 2].map(|channel| wave(column, row, channel)))
        .collect()
}

#[test]
fn cross_projection_agrees_with_the_plain_one() {
    let mesh = torus(32, 14);
    let options = WarpOptions::default();
    let (mut visible, mut wrongly_rejected, mut hidden, mut wrongly_accepted) = (0, 0, 0, 0);
    for (from, to) in [(0.0, 0.5), (0.9, 0.2), (3.0, 4.2)] {
        let [source, target] = [camera(from, 0.4, 3.0), camera(to, -0.1, 2.7)]
            .map(|camera| GBuffer::render(&mesh, &camera, 4));
        let rgb = picture(&source.camera);
        let warped = cross_project(&source, &rgb, &target, &options);
        for (index, column, row) in pixels(&target.camera) {
            let name = format!("pixel ({column}, {row})");
            let fast: [f32; 3] = [0, 1, 2].map(|channel| warped.rgb[index * 3 + channel]);
            if !target.mask[index] {
                assert_eq!(
                    (fast, warped.visibility[index], warped.source_px[index]),
                    ([0.0; 3], 0.0, [0.0; 2])
                );
                continue;
            }
            let (position, normal) = surface_point(&target, index);
            let seen = source
                .camera
                .project(position)
                .expect("the source looks at the whole scene");
            let px = DVec2::from_array(warped.source_px[index].map(f64::from));
            assert!((px - seen.px).length() < 1e-4, "{name}");
            if source.camera.intrinsics.contains(seen.px) {
                for channel in 0..3 {
                    let plain = bilinear(
                        |i| Some(f64::from(rgb[i * 3 + channel])),
                        &source.camera,
                        seen.px,
                    );
                    assert!(
                        (f64::from(fast[channel]) - plain.expect("all pixels count")).abs() < 1e-5,
                        "{name}"
                    );
                }
            }
            let margin = margin(&source, position, normal, &options);
            // The band allows for rounding of depths next to the threshold.
            if margin.is_none_or(|margin| margin.abs() > 1e-6) {
                let plain = margin.is_some_and(|margin| margin > 0.0);
                assert_eq!(warped.visibility[index] > 0.5, plain, "{name}");
            }
            // And against the truth: is anything between the point and the source?
            let eye = source.camera.center();
            let towards = position - eye;
            if normal.dot(-towards) / towards.length() < 0.1 || margin.is_none() {
                continue;
            }
            let blocked = cast(&mesh, eye, towards).is_some_and(|hit| hit.distance < 1.0 - 1e-3);
            let accepted = warped.visibility[index] > 0.5;
            visible += u32::from(!blocked);
            wrongly_rejected += u32::from(!blocked && !accepted);
            hidden += u32::from(blocked);
            wrongly_accepted += u32::from(blocked && accepted);
        }
    }
    assert!(
        visible > 500 && hidden > 30,
        "the scene hides itself: {visible} visible, {hidden} hidden"
    );
    // At this resolution a rim pixel is a fourth of the tube's width.
    assert!(
        wrongly_rejected * 20 < visible,
        "{wrongly_rejected} of {visible} visible points rejected"
    );
    assert!(
        wrongly_accepted * 5 < hidden,
        "{wrongly_accepted} of {hidden} hidden points accepted"
    );
}

/// The paper's selection, as it is written there: 64 x 64 samples, the largest overlap with what is uncovered, again.
fn plain_nearest(target: &GBuffer, references: &[GBuffer], k: usize) -> Vec<usize> {
    let (width, height) = (target.width as usize, target.height as usize);
    let mut uncovered = Vec::new();
    for row in 0..64 {
        for column in 0..64 {
            let x = ((column as f64 + 0.5) / 64.0 * width as f64).floor() as usize;
            let y = ((row as f64 + 0.5) / 64.0 * height as f64).floor() as usize;
            if target.mask[y * width + x] {
                uncovered.push(surface_point(target, y * width + x));
            }
        }
    }
    let options = WarpOptions::default();
    let sees = |view: &GBuffer, (position, normal): (DVec3, DVec3)| {
        margin(view, position, normal, &options).is_some_and(|margin| margin >= 0.0)
    };
    let mut chosen = Vec::new();
    while chosen.len() < k {
        let count = |view: usize| {
            uncovered
                .iter()
                .filter(|sample| sees(&references[view], **sample))
                .count()
        };
        let counts: Vec<usize> = (0..references.len()).map(count).collect();
        let most = counts.iter().copied().max().unwrap_or(0);
        // The paper leaves ties and complete coverage open, and so does this.
        if most == 0 || counts.iter().filter(|count| **count == most).count() > 1 {
            break;
        }
        let pick = counts
            .iter()
            .position(|count| *count == most)
            .expect("the maximum is there");
        uncovered.retain(|sample| !sees(&references[pick], *sample));
        chosen.push(pick);
    }
    chosen
}

#[test]
fn nearest_views_agree_with_plain_greedy_coverage() {
    let mesh = torus(32, 14);
    let references: Vec<GBuffer> = ring(9)
        .iter()
        .map(|camera| GBuffer::render(&mesh, camera, 2))
        .collect();
    let mut compared = 0;
    for azimuth in [0.3, 1.9, 2.8, 4.4, 5.9] {
        let target = GBuffer::render(&mesh, &camera(azimuth, 0.35, 3.2), 2);
        let plain = plain_nearest(&target, &references, 4);
        let fast = select_nearest(&target, &references, 4, Nearest::Coverage);
        assert_eq!(fast[..plain.len()], plain[..], "azimuth {azimuth}");
        compared += plain.len();
    }
    assert!(compared >= 10, "only {compared} choices were free of ties");
}

/// Share of the mesh's vertices that at least one of the chosen views truly sees, by ray casting.
fn seen_vertices(mesh: &Mesh, cameras: &[Camera]) -> Vec<Vec<bool>> {
    let sees = |camera: &Camera, vertex: usize| {
        let (position, normal) = (mesh.positions[vertex], mesh.normals[vertex]);
        let Some(seen) = camera.project(position) else {
            return false;
        };
        let eye = camera.center();
        camera.intrinsics.contains(seen.px)
            && normal.dot(eye - position) > 0.1 * (eye - position).length()
            && cast(mesh, eye, position - eye).is_none_or(|hit| hit.distance > 1.0 - 1e-3)
    };
    cameras
        .iter()
        .map(|camera| {
            (0..mesh.positions.len())
                .map(|vertex| sees(camera, vertex))
                .collect()
        })
        .collect()
}

fn covered(seen: &[Vec<bool>], chosen: &[usize]) -> usize {
    (0..seen[0].len())
        .filter(|vertex| chosen.iter().any(|view| seen[*view][*vertex]))
        .count()
}

#[test]
fn references_cover_as_much_as_plain_greedy_on_the_vertices() {
    let mesh = torus(28, 12);
    let cameras = ring(16);
    let views: Vec<GBuffer> = cameras
        .iter()
        .map(|camera| GBuffer::render(&mesh, camera, 2))
        .collect();
    let seen = seen_vertices(&mesh, &cameras);
    for n in [2, 4, 6] {
        let mut plain: Vec<usize> = Vec::new();
        while plain.len() < n {
            let gain = |view: &usize| covered(&seen, &[&plain[..], &[*view]].concat());
            plain.push((0..cameras.len()).max_by_key(gain).expect("views"));
        }
        let chosen = select_references(&views, n);
        assert_eq!(chosen.len(), n);
        // Samples are pixels of the views there and vertices here.
        let (fast, plain) = (covered(&seen, &chosen), covered(&seen, &plain));
        assert!(
            fast * 100 >= plain * 95,
            "{n} views: {fast} vertices, plain greedy {plain}"
        );
    }
}

#[test]
fn copies_of_a_view_come_last() {
    let mesh = torus(28, 12);
    let originals = ring(5);
    // Every view three times, the copies first moved by nothing, then by a hair.
    let cameras: Vec<Camera> = (0..15)
        .map(|index| {
            let mut camera = originals[index % 5];
            camera.camera_from_world.translation.x += if index >= 10 { 1e-4 } else { 0.0 };
            camera
        })
        .collect();
    let views: Vec<GBuffer> = cameras
        .iter()
        .map(|camera| GBuffer::render(&mesh, camera, 1))
        .collect();
    let chosen = select_references(&views, 15);
    let mut first: Vec<usize> = chosen[..5].iter().map(|view| view % 5).collect();
    first.sort_unstable();
    assert_eq!(first, [0, 1, 2, 3, 4]);
    let target = GBuffer::render(&mesh, &camera(0.3, 0.2, 3.0), 1);
    for mode in [Nearest::Coverage, Nearest::CoverageAngle] {
        let nearest = select_nearest(&target, &views[..10], 8, mode);
        let mut first: Vec<usize> = nearest[..5].iter().map(|view| view % 5).collect();
        first.sort_unstable();
        assert_eq!(first, [0, 1, 2, 3, 4], "{mode:?}");
    }
    // The view that is itself among the references is the best one for it by angle.
    assert_eq!(
        select_nearest(&views[3], &views[..5], 1, Nearest::CoverageAngle),
        [3]
    );
}

#[test]
fn empty_views_and_short_lists_are_no_trouble() {
    let mesh = torus(12, 8);
    let away = Camera::look_at(
        camera(0.0, 0.0, 3.0).intrinsics,
        DVec3::X * 3.0,
        DVec3::X * 9.0,
        DVec3::Z,
    )
    .expect("valid");
    let empty = GBuffer::render(&mesh, &away, 2);
    assert!(empty.mask.iter().all(|covered| !covered));
    let views: Vec<GBuffer> = ring(3)
        .iter()
        .map(|camera| GBuffer::render(&mesh, camera, 2))
        .collect();
    let nearest = select_nearest(&empty, &views, 2, Nearest::Coverage);
    let distance = |view: &usize| views[*view].camera.center().distance(away.center());
    assert_eq!(nearest.len(), 2);
    assert!(
        nearest
            .windows(2)
            .all(|pair| distance(&pair[0]) <= distance(&pair[1])),
        "nearest cameras first"
    );
    assert_eq!(
        select_nearest(&views[0], &[], 4, Nearest::Coverage),
        Vec::<usize>::new()
    );
    assert_eq!(select_references(&[], 4), Vec::<usize>::new());
    assert_eq!(
        select_references(&[empty.clone(), empty.clone()], 5).len(),
        2
    );
    assert_eq!(select_references(&views, 0), Vec::<usize>::new());
    let warped = cross_project(
        &empty,
        &picture(&empty.camera),
        &views[0],
        &WarpOptions::default(),
    );
    assert!(warped.visibility.iter().all(|visible| *visible == 0.0));
    assert!(
        warped
            .rgb
            .iter()
            .chain(warped.source_px.iter().flatten())
            .all(|number| number.is_finite())
    );
    let warped = cross_project(
        &views[0],
        &picture(&empty.camera),
        &empty,
        &WarpOptions::default(),
    );
    assert!(warped.rgb.iter().all(|number| *number == 0.0));
}

#[test]
fn hand_made_nonsense_stays_finite() {
    let mut mesh = torus(12, 8);
    mesh.positions[5] = DVec3::splat(f64::NAN);
    mesh.normals[7] = DVec3::ZERO;
    mesh.normals.truncate(40);
    mesh.triangles.push([0, 0, 1]);
    mesh.triangles.push([0, 1, 4000]);
    let mut broken = camera(0.0, 0.3, 3.0);
    broken.camera_from_world.translation.z = f64::NAN;
    for camera in [camera(0.0, 0.3, 3.0), camera(0.0, 0.3, 0.9), broken] {
        let buffer = GBuffer::render(&mesh, &camera, 2);
        let vectors = [
            &buffer.position,
            &buffer.normal,
            &buffer.normal_fd,
            &buffer.reflection,
        ];
        assert!(
            vectors
                .iter()
                .all(|map| map.iter().flatten().all(|number| number.is_finite()))
        );
        assert!(
            buffer
                .depth
                .iter()
                .chain(&buffer.coverage)
                .all(|number| number.is_finite())
        );
        let warped = cross_project(&buffer, &picture(&camera), &buffer, &WarpOptions::default());
        assert!(warped.rgb.iter().all(|number| number.is_finite()));
        assert!(
            coverage_map(&mesh, &camera, 2, 2)
                .iter()
                .all(|share| (0.0..=1.0).contains(share))
        );
        assert_eq!(select_references(&[buffer.clone(), buffer], 2).len(), 2);
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn a_view_warped_to_itself_is_itself(azimuth in 0.0..TAU, height in -1.0..1.0, distance in 2.0..5.0, samples in 1_u32..4) {
        let mesh = torus(24, 10);
        let camera = camera(azimuth, height, distance);
        let buffer = GBuffer::render(&mesh, &camera, samples);
        let raster = rasterize(&mesh, &camera);
        let rgb = picture(&camera);
        let warped = cross_project(&buffer, &rgb, &buffer, &WarpOptions::default());
        for (index, column, row) in pixels(&camera) {
            if raster.triangle[index] == NO_TRIANGLE || !buffer.mask[index] {
                continue;
            }
            let [x, y] = warped.source_px[index];
            // Positions are f32: 1e-7 of the scene's size, times the focal length.
            prop_assert!((x - column as f32 - 0.5).abs() < 1e-4 && (y - row as f32 - 0.5).abs() < 1e-4);
            for channel in 0..3 {
                prop_assert!((warped.rgb[index * 3 + channel] - rgb[index * 3 + channel]).abs() < 1e-4);
            }
            let (position, normal) = surface_point(&buffer, index);
            let cos = normal.dot((camera.center() - position).normalize_or_zero());
            if (cos - 0.05).abs() > 1e-5 {
                prop_assert_eq!(warped.visibility[index] > 0.5, cos > 0.05);
            }
        }
    }

    #[test]
    fn selections_hold_no_view_twice(
        placements in proptest::collection::vec((0.0..TAU, -1.0..1.0, 1.8..4.0), 1..8), n in 0_usize..10, twice in 0_usize..8,
    ) {
        let mesh = torus(16, 8);
        let mut views: Vec<GBuffer> = placements
            .iter()
            .map(|(azimuth, height, distance)| GBuffer::render(&mesh, &camera(*azimuth, *height, *distance), 1))
            .collect();
        views.push(views[twice % views.len()].clone());
        let target = GBuffer::render(&mesh, &camera(1.0, 0.2, 3.0), 1);
        for chosen in [
            select_references(&views, n),
            select_nearest(&target, &views, n, Nearest::Coverage),
            select_nearest(&target, &views, n, Nearest::CoverageAngle),
        ] {
            prop_assert_eq!(chosen.len(), n.min(views.len()));
            let mut sorted = chosen.clone();
            sorted.sort_unstable();
            sorted.dedup();
            prop_assert_eq!(sorted.len(), chosen.len());
            prop_assert!(chosen.iter().all(|view| *view < views.len()));
        }
    }

    #[test]
    fn g_buffers_do_not_depend_on_the_order_of_triangles_or_threads(turn in 1_usize..400, azimuth in 0.0..TAU) {
        let mesh = torus(24, 10);
        let mut turned = mesh.clone();
        turned.triangles.rotate_left(turn);
        let camera = camera(azimuth, 0.4, 2.5);
        let one = rayon::ThreadPoolBuilder::new().num_threads(1).build().expect("pool");
        let buffer = GBuffer::render(&mesh, &camera, 2);
        prop_assert!(buffer == one.install(|| GBuffer::render(&mesh, &camera, 2)), "threads");
        let mut other = GBuffer::render(&turned, &camera, 2);
        for triangle in other.triangle.iter_mut().filter(|triangle| **triangle != NO_TRIANGLE) {
            *triangle = (*triangle + turn as u32) % mesh.triangles.len() as u32;
        }
        prop_assert!(buffer == other, "order");
    }
}
