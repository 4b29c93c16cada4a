//! The hard cases by name: one object, and the cameras, damaged meshes and images that strain whatever draws it.

use std::f64::consts::{PI, TAU};

use glam::{DAffine3, DVec3};
use ign_geometry::{Camera, CameraIntrinsics, Mesh};

/// Of every camera here unless its case is about them: width and height differ, the principal point is off centre,
/// the focal lengths differ.
pub const INTRINSICS: CameraIntrinsics = CameraIntrinsics {
    fx: 41.0,
    fy: 38.0,
    cx: 17.3,
    cy: 11.8,
    width: 36,
    height: 26,
};

/// What ruins positions and triangles.
type Damage = dyn Fn(&mut Vec<DVec3>, &mut Vec<[u32; 3]>);
/// An image: 8-bit values by (pixel, channel).
pub type Picture = fn(usize, usize) -> u8;

/// A bumpy sphere of radius 0.68 to 0.92 around the origin, open at the top (`+z`): curved, without symmetry, and one
/// can look inside.
///
/// # Panics
/// When there are no rows, or fewer than three columns.
pub fn object(rows: u32, columns: u32) -> Mesh {
    let (positions, triangles) = parts(rows, columns);
    Mesh::new(positions, triangles).expect("a mesh")
}

fn parts(rows: u32, columns: u32) -> (Vec<DVec3>, Vec<[u32; 3]>) {
    let mut positions = Vec::new();
    for row in 0..=rows {
        for column in 0..columns {
            let theta = PI * (0.15 + 0.85 * f64::from(row) / f64::from(rows));
            let phi = TAU * f64::from(column) / f64::from(columns);
            let radius = 0.8 + 0.12 * (3.0 * phi).sin() * theta.sin();
            let direction = DVec3::new(
                theta.sin() * phi.cos(),
                theta.sin() * phi.sin(),
                theta.cos(),
            );
            positions.push(direction * radius);
        }
    }
    let at = |r: u32, c: u32| r * columns + c % columns;
    let triangles = (0..rows)
        .flat_map(|r| (0..columns).map(move |c| (r, c)))
        .flat_map(|(r, c)| {
            [
                [at(r, c), at(r + 1, c), at(r + 1, c + 1)],
                [at(r, c), at(r + 1, c + 1), at(r, c + 1)],
            ]
        })
        .collect();
    (positions, triangles)
}

/// [`object`] damaged in each of the ways that scans are; every one of them is a mesh that must be drawn.
///
/// # Panics
/// When the object has fewer than 9 rows and columns of vertices.
pub fn damaged_meshes(rows: u32, columns: u32) -> Vec<(&'static str, Mesh)> {
    let damaged = |damage: &Damage| {
        let (mut positions, mut triangles) = parts(rows, columns);
        damage(&mut positions, &mut triangles);
        Mesh::new(positions, triangles).expect("a mesh")
    };
    vec![
        (
            "holes",
            damaged(&|_, triangles| {
                let mut index = 0;
                triangles.retain(|_| {
                    index += 1;
                    index % 5 != 0
                });
            }),
        ),
        (
            "flipped triangles",
            damaged(&|_, triangles| {
                for triangle in triangles.iter_mut().step_by(3) {
                    triangle.swap(1, 2);
                }
            }),
        ),
        (
            "duplicate triangles",
            damaged(&|_, triangles| triangles.extend(triangles.clone())),
        ),
        (
            "flipped duplicates of every triangle",
            damaged(&|_, triangles| {
                let flipped = triangles.iter().map(|&[a, b, c]| [a, c, b]);
                let flipped: Vec<[u32; 3]> = flipped.collect();
                triangles.extend(flipped);
            }),
        ),
        (
            "degenerate triangles",
            damaged(&|positions, triangles| {
                // A repeated corner, three corners on a line, two in one place, and a needle.
                let first = positions.len() as u32;
                positions.extend([0.0, 0.5, 1.0].map(|t| DVec3::new(0.9, 0.1, -0.3) * t));
                positions.push(positions[7]);
                positions.push(positions[9] + DVec3::splat(1e-14));
                triangles.extend([
                    [4, 4, 5],
                    [first, first + 1, first + 2],
                    [7, first + 3, 8],
                    [9, first + 4, 40],
                ]);
            }),
        ),
        (
            "edges of three and more triangles",
            damaged(&|positions, triangles| {
                for (index, direction) in
                    [DVec3::X, DVec3::Y, DVec3::splat(-0.7)].iter().enumerate()
                {
                    positions.push(positions[20 + index] * 1.2 + direction * 0.1);
                    triangles.push([20, 21, positions.len() as u32 - 1]);
                }
            }),
        ),
        (
            "loose vertices",
            damaged(&|positions, _| positions.extend([DVec3::splat(1e9), DVec3::NEG_Y * 1e-9])),
        ),
        (
            "every vertex a triangle's own",
            damaged(&|positions, triangles| {
                let soup = triangles.iter().flatten().map(|v| positions[*v as usize]);
                let soup: Vec<DVec3> = soup.collect();
                *triangles = (0..soup.len() as u32 / 3)
                    .map(|t| [3 * t, 3 * t + 1, 3 * t + 2])
                    .collect();
                *positions = soup;
            }),
        ),
        (
            "one triangle",
            damaged(&|_, triangles| triangles.truncate(1)),
        ),
        (
            "triangles through each other",
            damaged(&|positions, triangles| {
                let corners = [(-2.0, -1.5), (2.0, -1.2), (0.1, 2.0)];
                for z in [-0.3, 0.31] {
                    let first = positions.len() as u32;
                    positions.extend(corners.map(|(x, y)| DVec3::new(x, y, z)));
                    triangles.push([first, first + 1, first + 2]);
                }
            }),
        ),
    ]
}

/// A camera at `eye` that looks at the object.
///
/// # Panics
/// When `eye` lies on the vertical axis through the target.
pub fn looking(eye: DVec3) -> Camera {
    let up = DVec3::new(0.05, 0.1, 1.0);
    Camera::look_at(INTRINSICS, eye, DVec3::new(0.02, -0.01, 0.03), up).expect("a camera")
}

/// An ordinary view of the object.
pub fn ordinary() -> Camera {
    looking(DVec3::new(2.2, 0.8, 0.6))
}

/// Five cameras around the object.
pub fn ring() -> Vec<Camera> {
    [
        (2.3, 0.2, 0.4),
        (1.6, 1.6, 0.1),
        (1.9, -1.2, 0.9),
        (1.2, 0.3, 2.0),
        (2.4, 0.9, -0.8),
    ]
    .map(|(x, y, z)| looking(DVec3::new(x, y, z)))
    .to_vec()
}

/// A camera that looks away from the object.
pub fn blind() -> Camera {
    let camera = looking(DVec3::new(2.0, 0.0, 0.0));
    Camera {
        camera_from_world: DAffine3 {
            translation: DVec3::new(0.0, 0.0, -50.0),
            ..camera.camera_from_world
        },
        ..camera
    }
}

/// Cameras of the object at the edge of what can be drawn; all are valid cameras.
///
/// # Panics
/// Never: the cameras are fixed.
pub fn cameras() -> Vec<(&'static str, Camera)> {
    let near = ordinary();
    let with = |change: &dyn Fn(&mut CameraIntrinsics)| {
        let mut intrinsics = INTRINSICS;
        change(&mut intrinsics);
        near.with_intrinsics(intrinsics)
    };
    let turned = DAffine3 {
        translation: near.camera_from_world.translation * DVec3::new(1.0, 1.0, -1.0),
        ..near.camera_from_world
    };
    vec![
        ("an ordinary view", near),
        (
            "from where no reference looks",
            looking(DVec3::new(-2.0, -1.0, -0.6)),
        ),
        ("into the opening", looking(DVec3::new(0.1, 0.1, 2.5))),
        ("from inside", looking(DVec3::new(0.1, -0.2, 0.15))),
        (
            "from within 1e-6 of the surface",
            looking(DVec3::new(0.0, 0.0, -0.800_001)),
        ),
        (
            "from within 1e-12 of the surface",
            looking(DVec3::new(0.0, 0.0, -0.800_000_000_001)),
        ),
        ("from 1e6 away", looking(DVec3::new(1e6, 3e5, 2e5))),
        (
            "with the object behind",
            Camera::new(INTRINSICS, turned).expect("a camera"),
        ),
        (
            "a reference's own pose but for 1e-6",
            looking(DVec3::new(2.3, 0.2 + 1e-6, 0.4)),
        ),
        (
            "a focal length of 1e-3 px",
            with(&|i| (i.fx, i.fy) = (1e-3, 1e-3)),
        ),
        (
            "a focal length of 1e-12 px",
            with(&|i| (i.fx, i.fy) = (1e-12, 1e-12)),
        ),
        (
            "a focal length of 1e7 px",
            with(&|i| (i.fx, i.fy) = (1e7, 1e7)),
        ),
        (
            "a focal length of 1e12 px",
            with(&|i| (i.fx, i.fy) = (1e12, 1e12)),
        ),
        (
            "a principal point far outside",
            with(&|i| (i.cx, i.cy) = (-4e3, 9e3)),
        ),
        ("a principal point just outside", with(&|i| i.cx = -9.0)),
        (
            "a principal point outside, the object inside",
            // The object seen from aside, by a window far off the axis.
            shifted(near, -500.0, 320.0),
        ),
        ("one pixel", with(&|i| (i.width, i.height) = (1, 1))),
        ("one column", with(&|i| i.width = 1)),
        ("one row", with(&|i| i.height = 1)),
    ]
}

/// The camera turned so far that the object lies `(x, y)` pixels off its axis, and a window that follows it there.
fn shifted(camera: Camera, x: f64, y: f64) -> Camera {
    let k = camera.intrinsics;
    let turn = DAffine3::from_rotation_y((x / k.fx).atan())
        * DAffine3::from_rotation_x(-(y / k.fy).atan());
    let pose = turn * camera.camera_from_world;
    let seen = pose.transform_point3(DVec3::ZERO);
    let intrinsics = CameraIntrinsics {
        cx: 0.5 * f64::from(k.width) - k.fx * seen.x / seen.z,
        cy: 0.5 * f64::from(k.height) - k.fy * seen.y / seen.z,
        ..k
    };
    Camera::new(intrinsics, pose).expect("a camera")
}

/// Values of an image's pixels and channels by name: 8 bit, from (pixel, channel).
pub fn images() -> Vec<(&'static str, Picture)> {
    vec![
        ("a picture", pattern),
        ("black", |_, _| 0),
        ("white", |_, _| 255),
        ("saturated in one channel", |at, channel| {
            if channel == 1 {
                255
            } else {
                pattern(at, channel)
            }
        }),
        ("one colour", |_, channel| [90, 140, 200][channel % 3]),
    ]
}

/// An image without structure, the same at every run.
pub fn pattern(at: usize, channel: usize) -> u8 {
    (at * 37 + channel * 91) as u8
}

/// The plane `z = 0`, 2 by 2, in `n` by `n` squares: seen at a known angle from everywhere.
///
/// # Panics
/// When `n` is 0.
pub fn plane(n: u32) -> Mesh {
    let side = n + 1;
    let at = |index: u32| 2.0 * f64::from(index) / f64::from(n) - 1.0;
    let positions = (0..side * side)
        .map(|v| DVec3::new(at(v % side), at(v / side), 0.0))
        .collect();
    let triangles = (0..n * n)
        .flat_map(|cell| {
            let corner = cell / n * side + cell % n;
            [
                [corner, corner + 1, corner + side],
                [corner + 1, corner + side + 1, corner + side],
            ]
        })
        .collect();
    Mesh::new(positions, triangles).expect("a mesh")
}

/// A camera at distance `distance` from the origin that sees the plane `z = 0` there at `degrees` from its normal.
///
/// # Panics
/// When an argument is not finite.
pub fn grazing(degrees: f64, distance: f64) -> Camera {
    let angle = degrees.to_radians();
    let eye = DVec3::new(angle.sin() * 0.8, angle.sin() * 0.6, angle.cos()) * distance;
    Camera::look_at(INTRINSICS, eye, DVec3::ZERO, DVec3::new(-0.6, 0.8, 0.1)).expect("a camera")
}
