//! The tensor warp (f32) at the hard cases of `tests/README.md`, against the f64 one and the plain one.
//!
//! f32 carries 6e-8 of each coordinate: where a point of size 1 falls in the source is known to
//! `1e-6 * (f / z + |c|)` pixels, and a colour to that times the image's slope. Bounds below are these.

use glam::{DVec2, DVec3};
use ign_geometry::{Camera, GBuffer};
use ign_nets::params::flat_values;
use ign_nets::warp::{Sources, Taps};
use ign_scenes::hard;
use ign_scenes::oracle::surface_point;
use tch::{Device, Kind, Tensor};

/// Change of colour per pixel of [`smooth`], at most.
const SLOPE: f64 = 0.06;

/// An image without symmetry, smooth, in [0.1, 0.9].
fn smooth(px: DVec2) -> [f64; 3] {
    [
        0.5 + 0.4 * (px.x * 0.11).sin(),
        0.5 + 0.4 * (px.y * 0.13).cos(),
        0.5 + 0.3 * ((px.x + px.y) * 0.07).sin(),
    ]
}

fn image(camera: &Camera) -> Tensor {
    let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
    let values: Vec<f32> = (0..width * height)
        .flat_map(|at| {
            smooth(DVec2::new(
                f64::from(at % width) + 0.5,
                f64::from(at / width) + 0.5,
            ))
        })
        .map(|value| value as f32)
        .collect();
    Tensor::from_slice(&values).view([-1, 3])
}

/// The pixels of a view that show the object, with their points and normals.
fn points(view: &GBuffer) -> Vec<(DVec3, DVec3)> {
    let covered = (0..view.mask.len()).filter(|at| view.mask[*at]);
    covered.map(|at| surface_point(view, at)).collect()
}

fn taps(source: &GBuffer, depth: &[f32], points: &[(DVec3, DVec3)]) -> Taps {
    let tensor = |pick: fn(&(DVec3, DVec3)) -> DVec3| {
        let flat: Vec<f32> = points
            .iter()
            .flat_map(|point| pick(point).to_array())
            .map(|value| value as f32)
            .collect();
        Tensor::from_slice(&flat).view([-1, 3])
    };
    let view = Tensor::zeros([points.len() as i64], (Kind::Int64, Device::Cpu));
    Sources::new(&[source.camera], depth, Device::Cpu).taps(
        &tensor(|point| point.0),
        &tensor(|point| point.1),
        &view,
    )
}

/// Everything is finite and in range.
fn assert_sound(what: &str, taps: &Taps) {
    for tensor in [&taps.weight, &taps.visibility, &taps.facing, &taps.grid] {
        assert_eq!(tensor.isfinite().all().int64_value(&[]), 1, "{what}");
    }
    for share in flat_values(&taps.visibility)
        .iter()
        .chain(&flat_values(&taps.facing))
    {
        assert!((-1e-6..=1.0 + 1e-6).contains(share), "{what}: {share}");
    }
}

/// Compares with f64 what the source shows at each point; how many points it sees whole.
fn assert_like_f64(what: &str, source: &GBuffer, target: &GBuffer) -> usize {
    let points = points(target);
    let taps = taps(source, &source.depth, &points);
    assert_sound(what, &taps);
    let k = source.camera.intrinsics;
    let visibility = flat_values(&taps.visibility);
    let colors = flat_values(
        &(taps.gather(&image(&source.camera)) / taps.visibility.clamp_min(1e-3).unsqueeze(1)),
    );
    let mut whole = 0;
    for (at, (position, _)) in points.iter().enumerate() {
        let projection = source.camera.project(*position);
        let bound = projection.map_or(f64::INFINITY, |seen| {
            1e-6 * ((k.fx + k.fy) / seen.depth + k.cx.abs() + k.cy.abs())
                * (1.0 + source.camera.center().length())
        });
        // Neighbours of a pixel within the image may have a part in it: one pixel more.
        let inside = projection.is_some_and(|seen| {
            let (low, high) = (DVec2::splat(-1.0 - bound), DVec2::splat(1.0 + bound));
            let size = DVec2::new(f64::from(k.width), f64::from(k.height));
            seen.px.cmpge(low).all() && seen.px.cmple(size + high).all()
        });
        if !inside {
            assert!(
                visibility[at] < 1e-6,
                "{what}: {position} is behind or outside, seen {}",
                visibility[at]
            );
            continue;
        }
        if visibility[at] < 0.999_99 {
            continue;
        }
        whole += 1;
        let px = projection.expect("in front").px;
        for (channel, exact) in smooth(px).into_iter().enumerate() {
            let difference = (f64::from(colors[at * 3 + channel]) - exact).abs();
            // Linear between pixels, where the image is a sine: 0.13 squared, of 0.4, an eighth.
            assert!(
                difference < 1e-3 + SLOPE * bound,
                "{what}: {position} at {px} differs by {difference}"
            );
        }
    }
    whole
}

#[test]
fn hard_cameras_agree_with_f64_both_ways() {
    let mesh = hard::object(14, 20);
    let ordinary = GBuffer::render(&mesh, &hard::ring()[0], 1);
    let mut whole = 0;
    for (what, camera) in hard::cameras() {
        let other = GBuffer::render(&mesh, &camera, 1);
        whole += assert_like_f64(what, &ordinary, &other);
        whole += assert_like_f64(what, &other, &ordinary);
    }
    assert!(whole > 1000, "only {whole} points are seen whole");
}

#[test]
fn grazing_surfaces_fade_out() {
    let mesh = hard::plane(6);
    let target = GBuffer::render(&mesh, &hard::grazing(20.0, 1.5), 1);
    for degrees in [0.1, 45.0, 80.0, 89.0, 89.9] {
        let source = GBuffer::render(&mesh, &hard::grazing(degrees, 30.0), 1);
        assert_like_f64(&format!("{degrees} degrees"), &source, &target);
        let taps = taps(&source, &source.depth, &points(&target));
        let facing = flat_values(&taps.facing);
        // From afar all of the plane is seen at about one angle; confidence is none from 87.1 degrees on.
        assert!(
            facing
                .iter()
                .all(|facing| (*facing > 0.0) == (degrees < 87.0)),
            "{degrees}"
        );
    }
}

#[test]
fn damaged_meshes_agree_with_f64() {
    for (what, mesh) in hard::damaged_meshes(8, 12) {
        let [source, target] =
            [hard::ring()[0], hard::ring()[1]].map(|camera| GBuffer::render(&mesh, &camera, 1));
        assert_like_f64(what, &source, &target);
    }
}

#[test]
fn depth_that_is_not_finite_is_no_surface() {
    let mesh = hard::object(10, 14);
    let [source, target] =
        [hard::ring()[0], hard::ring()[1]].map(|camera| GBuffer::render(&mesh, &camera, 1));
    for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, -1.0, 0.0] {
        let taps = taps(&source, &vec![bad; source.depth.len()], &points(&target));
        assert_sound("depth", &taps);
        assert!(
            flat_values(&taps.visibility)
                .iter()
                .all(|seen| *seen == 0.0),
            "depth {bad}"
        );
    }
}
