//! The tensor warp against the CPU implementation in f64 (`ign_geometry::cross_project`), on an asymmetric scene.

use glam::{DVec2, DVec3};
use ign_geometry::{Camera, CameraIntrinsics, GBuffer, Mesh, WarpOptions, cross_project};
use ign_nets::params::flat_values;
use ign_nets::warp::Sources;
use tch::{Device, Kind, Tensor};

/// A bumpy sphere: curved, with self-occlusion at its limb.
fn mesh() -> Mesh {
    let (rows, columns) = (48u32, 64u32);
    let mut positions = Vec::new();
    for row in 0..=rows {
        for column in 0..columns {
            let theta = std::f64::consts::PI * f64::from(row) / f64::from(rows);
            let phi = std::f64::consts::TAU * f64::from(column) / f64::from(columns);
            let radius = 0.8 + 0.08 * (3.0 * phi).sin() * theta.sin();
            positions.push(
                DVec3::new(
                    theta.sin() * phi.cos(),
                    theta.sin() * phi.sin(),
                    theta.cos(),
                ) * radius,
            );
        }
    }
    let mut triangles = Vec::new();
    for row in 0..rows {
        for column in 0..columns {
            let next = (column + 1) % columns;
            let at = |r: u32, c: u32| r * columns + c;
            triangles.push([at(row, column), at(row + 1, column), at(row + 1, next)]);
            triangles.push([at(row, column), at(row + 1, next), at(row, next)]);
        }
    }
    Mesh::new(positions, triangles).expect("a sphere is a mesh")
}

fn camera(eye: DVec3, up: DVec3) -> Camera {
    let intrinsics = CameraIntrinsics {
        fx: 150.0,
        fy: 141.0,
        cx: 49.3,
        cy: 33.8,
        width: 96,
        height: 72,
    };
    Camera::look_at(intrinsics, eye, DVec3::new(0.02, -0.03, 0.01), up).expect("a camera")
}

fn smooth(px: DVec2) -> [f32; 3] {
    [
        0.5 + 0.4 * (px.x * 0.11).sin(),
        0.5 + 0.4 * (px.y * 0.13).cos(),
        0.5 + 0.3 * ((px.x + px.y) * 0.07).sin(),
    ]
    .map(|x| x as f32)
}

#[test]
fn colours_and_visibility_agree_with_the_reference_implementation() {
    let mesh = mesh();
    let source = GBuffer::render(
        &mesh,
        &camera(DVec3::new(2.1, 0.9, 0.7), DVec3::new(0.1, 0.0, 1.0)),
        1,
    );
    let target = GBuffer::render(
        &mesh,
        &camera(DVec3::new(1.7, 1.5, 0.3), DVec3::new(-0.2, 0.1, 1.0)),
        1,
    );
    let rgb: Vec<f32> = (0..source.mask.len())
        .flat_map(|at| smooth(DVec2::new((at % 96) as f64 + 0.5, (at / 96) as f64 + 0.5)))
        .collect();
    let expected = cross_project(&source, &rgb, &target, &WarpOptions::default());

    let kept: Vec<usize> = (0..target.mask.len())
        .filter(|&at| target.mask[at])
        .collect();
    let pick = |values: &[[f32; 3]]| {
        Tensor::from_slice(&kept.iter().flat_map(|&at| values[at]).collect::<Vec<f32>>())
            .view([-1, 3])
    };
    let sources = Sources::new(&[source.camera], &source.depth, Device::Cpu);
    let view = Tensor::zeros([kept.len() as i64], (Kind::Int64, Device::Cpu));
    let taps = sources.taps(&pick(&target.position), &pick(&target.normal), &view);
    let image = Tensor::from_slice(&rgb).view([-1, 3]);
    let colors = flat_values(&(taps.gather(&image) / taps.visibility.clamp_min(1e-3).unsqueeze(1)));
    let visibility = flat_values(&taps.visibility);
    let grid = flat_values(&taps.grid);

    let (mut compared, mut disagreeing) = (0, 0);
    for (row, &at) in kept.iter().enumerate() {
        // Half-visible taps lie on an occlusion edge: the two implementations may decide there differently.
        let sees = visibility[row] > 0.99;
        if sees != (expected.visibility[at] > 0.5) {
            disagreeing += 1;
            continue;
        }
        // With a tap short, the others share its weight: another colour, on purpose.
        if visibility[row] > 0.999_99 {
            compared += 1;
            for channel in 0..3 {
                let difference = (colors[row * 3 + channel] - expected.rgb[at * 3 + channel]).abs();
                // f32 projection at 100 px: 1e-5 px, times the image's slope of 0.05 per px.
                assert!(
                    difference < 1e-4,
                    "pixel {at} channel {channel} differs by {difference}"
                );
            }
            let u = (grid[row * 2] + 1.0) * 48.0;
            assert!((u - expected.source_px[at][0]).abs() < 1e-3);
        }
    }
    assert!(compared > 800, "only {compared} pixels are visible in both");
    assert!(
        disagreeing * 20 < kept.len(),
        "{disagreeing} of {} pixels disagree on visibility",
        kept.len()
    );
}

#[test]
fn hard_points_stay_finite() {
    let mesh = mesh();
    let source = GBuffer::render(&mesh, &camera(DVec3::new(2.1, 0.9, 0.7), DVec3::Z), 1);
    let sources = Sources::new(&[source.camera], &source.depth, Device::Cpu);
    let eye = source.camera.center();
    let behind = eye * 2.0;
    let points: Vec<f32> = [
        eye,
        behind,
        DVec3::splat(1e6),
        DVec3::splat(-1e6),
        DVec3::ZERO,
    ]
    .iter()
    .flat_map(DVec3::to_array)
    .map(|x| x as f32)
    .collect();
    let points = Tensor::from_slice(&points).view([-1, 3]);
    let normals = Tensor::from_slice(&[0.0f32, 0.0, 1.0])
        .view([1, 3])
        .repeat([5, 1]);
    let taps = sources.taps(
        &points,
        &normals,
        &Tensor::zeros([5], (Kind::Int64, Device::Cpu)),
    );
    for tensor in [&taps.weight, &taps.visibility, &taps.facing, &taps.grid] {
        assert_eq!(tensor.isfinite().all().int64_value(&[]), 1);
    }
    assert!(taps.visibility.max().double_value(&[]) <= 1.0 + 1e-6);
    // Nothing behind the camera or out of the picture is seen.
    assert!(
        taps.visibility
            .narrow(0, 0, 4)
            .abs()
            .max()
            .double_value(&[])
            < 1e-9
    );
}
