//! Random scenes: small meshes, sound and damaged, seen by ordinary and extreme cameras. A scene is fully given by a
//! seed and its number.
//!
//! `IGN_SCENES` sets how many [`each`] makes, `IGN_SEED` the seed, `IGN_FIRST` the number of the first one: what it
//! says on failure makes the same scene again.

use std::panic::{AssertUnwindSafe, catch_unwind};

use glam::{DAffine3, DQuat, DVec3, EulerRot};
use ign_geometry::{Camera, CameraIntrinsics, Mesh, Similarity};
use rand::seq::SliceRandom;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;
use rayon::prelude::{IntoParallelIterator, ParallelIterator};

use crate::hard;

/// Where the sequence of scenes starts when `IGN_SEED` does not say so.
const SEED: u64 = 20_180_711;
/// Most pixels along a side: a scene then takes well below a millisecond.
const LONGEST_SIDE: u32 = 14;

/// One random scene, in the normalised frame.
#[derive(Clone, Debug)]
pub struct Scene {
    /// Seed and number: the scene's name.
    pub name: String,
    /// At least one triangle.
    pub mesh: Mesh,
    /// Whether the mesh is as [`Mesh::new`] made it; otherwise coordinates, normals or indices were ruined after that.
    pub sound: bool,
    /// One to five views.
    pub views: Vec<View>,
    /// For what the test itself has to choose.
    pub rng: Pcg64,
}

/// One view of a scene.
#[derive(Clone, Debug)]
pub struct View {
    /// A valid camera.
    pub camera: Camera,
    /// Whether the camera is an ordinary one; otherwise it stands too near or far, or its intrinsics are extreme.
    pub ordinary: bool,
    /// `[height][width][3]` in [0, 1].
    pub rgb: Vec<f32>,
}

impl Scene {
    /// Scene `number` of the sequence `seed`; `None` where the random mesh has no triangle with an area.
    pub fn new(seed: u64, number: u64) -> Option<Self> {
        // A stream of its own for each scene.
        let mut rng = Pcg64::seed_from_u64(seed ^ number.wrapping_mul(0x9e37_79b9_7f4a_7c15));
        let mesh = placed(mesh(&mut rng)?, &mut rng)?;
        let mut views: Vec<View> = Vec::new();
        for _ in 0..rng.random_range(1..=5) {
            let (camera, ordinary) = match views.last() {
                // A copy, or nearly one.
                Some(last) if rng.random_bool(0.15) => {
                    let mut camera = last.camera;
                    camera.camera_from_world.translation.x +=
                        [0.0, 1e-6, 1e-3][rng.random_range(0..3)];
                    (camera, last.ordinary)
                }
                _ => camera(&mut rng),
            };
            let rgb = image(&camera, &mut rng);
            views.push(View {
                camera,
                ordinary,
                rgb,
            });
        }
        let (mesh, sound) = if rng.random_bool(0.05) {
            (ruined(mesh, &mut rng), false)
        } else {
            (mesh, true)
        };
        Some(Self {
            name: format!("IGN_SEED={seed} IGN_FIRST={number} IGN_SCENES=1"),
            mesh,
            sound,
            views,
            rng,
        })
    }

    /// A random order of `count` things: `order[new] = old`.
    pub fn order(&self, count: usize) -> Vec<usize> {
        let mut order: Vec<usize> = (0..count).collect();
        order.shuffle(&mut self.rng.clone());
        order
    }
}

/// Runs `check` on `count` scenes, or on `IGN_SCENES`, on all cores.
///
/// # Panics
/// When `check` fails or panics, with the name of the scene.
pub fn each(count: u64, check: impl Fn(&Scene) -> Result<(), String> + Sync) {
    let number = |name: &str, default: u64| {
        std::env::var(name).map_or(default, |text| text.parse().expect("a number"))
    };
    let (count, seed) = (number("IGN_SCENES", count), number("IGN_SEED", SEED));
    let first = number("IGN_FIRST", 0);
    let failed = (first..first + count).into_par_iter().find_map_any(|at| {
        let run = || Scene::new(seed, at).map_or(Ok(()), |scene| check(&scene));
        let result = catch_unwind(AssertUnwindSafe(run))
            .unwrap_or_else(|_| Err("it panicked, see above".to_owned()));
        result.err().map(|message| (at, message))
    });
    if let Some((at, message)) = failed {
        panic!("scene IGN_SEED={seed} IGN_FIRST={at} IGN_SCENES=1: {message}");
    }
}

/// Log-uniform between two positive numbers.
fn magnitude(rng: &mut Pcg64, low: f64, high: f64) -> f64 {
    rng.random_range(low.ln()..high.ln()).exp()
}

fn vector(rng: &mut Pcg64) -> DVec3 {
    DVec3::from_array(std::array::from_fn(|_| rng.random_range(-1.0..1.0)))
}

/// Positions and triangles before any check: soups, sheets, bumpy spheres, and lattices where everything coincides.
fn mesh(rng: &mut Pcg64) -> Option<(Vec<DVec3>, Vec<[u32; 3]>)> {
    let (mut positions, mut triangles) = match rng.random_range(0..4) {
        0 => {
            let count = rng.random_range(1..30);
            let size = magnitude(rng, 0.05, 2.0);
            let mut positions = Vec::new();
            for _ in 0..count {
                let middle = vector(rng);
                positions.extend((0..3).map(|_| middle + vector(rng) * size));
            }
            let triangles = (0..count).map(|t| [3 * t, 3 * t + 1, 3 * t + 2]).collect();
            (positions, triangles)
        }
        1 => {
            let plane = hard::plane(rng.random_range(1..4));
            let height = magnitude(rng, 1e-3, 1.0);
            let bumpy = |p: &DVec3| p.with_z(height * (3.0 * p.x).sin() * (2.0 * p.y).cos());
            let positions = plane.positions.iter().map(bumpy).collect();
            (positions, plane.triangles)
        }
        2 => {
            let object = hard::object(rng.random_range(2..5), rng.random_range(3..7));
            (object.positions, object.triangles)
        }
        _ => {
            // On a coarse lattice triangles share corners, edges and planes, and many have no area.
            let snapped = |v: DVec3| (v * 2.0).round() / 2.0;
            let positions: Vec<DVec3> = (0..rng.random_range(3..12))
                .map(|_| snapped(vector(rng)))
                .collect();
            let corner = |rng: &mut Pcg64| rng.random_range(0..positions.len() as u32);
            let triangles = (0..rng.random_range(1..30))
                .map(|_| std::array::from_fn(|_| corner(rng)))
                .collect();
            (positions, triangles)
        }
    };
    let turn = DQuat::from_euler(
        EulerRot::XYZ,
        rng.random_range(-3.0..3.0),
        rng.random_range(-3.0..3.0),
        rng.random_range(-3.0..3.0),
    );
    // Unturned ones have edges along the axes and corners in pixel centres.
    if rng.random_bool(0.7) {
        for position in &mut positions {
            *position = turn * *position;
        }
    }
    for _ in 0..rng.random_range(0..4) {
        let any = rng.random_range(0..triangles.len());
        match rng.random_range(0..6) {
            0 => triangles[any].swap(0, 1),
            1 => triangles.push(triangles[any]),
            2 => {
                let [a, b, c] = triangles[any];
                triangles.push([b, a, c]);
            }
            3 if triangles.len() > 1 => drop(triangles.remove(any)),
            4 => {
                let [a, b, _] = triangles[any];
                positions[b as usize] = positions[a as usize].lerp(positions[b as usize], 1e-9);
            }
            _ => {
                let [a, b, _] = triangles[any];
                positions.push(vector(rng) * magnitude(rng, 0.1, 1e3));
                triangles.push([a, b, positions.len() as u32 - 1]);
            }
        }
    }
    (!triangles.is_empty()).then_some((positions, triangles))
}

/// The mesh as a capture has it, somewhere in the world and at some scale, and then normalised.
fn placed((positions, triangles): (Vec<DVec3>, Vec<[u32; 3]>), rng: &mut Pcg64) -> Option<Mesh> {
    let world_from_here = Similarity {
        scale: magnitude(rng, 1e-4, 1e4),
        translation: vector(rng) * magnitude(rng, 1e-3, 1e3),
    };
    let positions = positions
        .into_iter()
        .map(|p| world_from_here.transform_point(p))
        .collect();
    let mesh = Mesh::new(positions, triangles).ok()?;
    Some(mesh.transformed(&mesh.normalisation()))
}

/// A mesh as no reader makes it.
fn ruined(mut mesh: Mesh, rng: &mut Pcg64) -> Mesh {
    let bad = [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, 1e300, 1e39][rng.random_range(0..5)];
    match rng.random_range(0..4) {
        0 => {
            let vertex = rng.random_range(0..mesh.positions.len());
            mesh.positions[vertex].y = bad;
        }
        1 => {
            let vertex = rng.random_range(0..mesh.normals.len());
            mesh.normals[vertex] = DVec3::splat(bad);
        }
        2 => mesh.normals.truncate(1),
        _ => mesh.triangles.push([0, u32::MAX, 1]),
    }
    mesh
}

fn camera(rng: &mut Pcg64) -> (Camera, bool) {
    let side = |rng: &mut Pcg64| rng.random_range(1..=LONGEST_SIDE);
    let (width, height) = (side(rng), side(rng));
    let long = f64::from(width.max(height));
    let mut intrinsics = CameraIntrinsics {
        fx: long * rng.random_range(0.6..2.0),
        fy: long * rng.random_range(0.6..2.0),
        cx: f64::from(width) * rng.random_range(0.2..0.8),
        cy: f64::from(height) * rng.random_range(0.2..0.8),
        width,
        height,
    };
    let direction = vector(rng).try_normalize().unwrap_or(DVec3::X);
    let mut distance = rng.random_range(1.5..4.0);
    let kind = rng.random_range(0..10);
    match kind {
        0 => distance = magnitude(rng, 1e-12, 1.5),
        1 => distance = magnitude(rng, 4.0, 1e7),
        2 => {
            intrinsics.fx = magnitude(rng, 1e-12, 1e12);
            intrinsics.fy = intrinsics.fx * rng.random_range(0.5..2.0);
        }
        3 => intrinsics.fx = magnitude(rng, 1e-6, 1e6),
        4 => {
            intrinsics.cx = long * rng.random_range(-2.0..3.0);
            intrinsics.cy = long * magnitude(rng, 1.0, 1e6);
        }
        _ => {}
    }
    let eye = direction * distance;
    let target = vector(rng) * if kind == 5 { 10.0 } else { 0.2 };
    let pose = [vector(rng), DVec3::X, DVec3::Y]
        .into_iter()
        .find_map(|up| Camera::look_at(intrinsics, eye, target, up).ok())
        .map_or(DAffine3::from_translation(-eye), |c| c.camera_from_world);
    let camera = Camera::new(intrinsics, pose).expect("intrinsics and pose are in order");
    (camera, kind > 4)
}

fn image(camera: &Camera, rng: &mut Pcg64) -> Vec<f32> {
    let (_, value) = hard::images()[rng.random_range(0..hard::images().len())];
    let pixels = (camera.intrinsics.width * camera.intrinsics.height) as usize;
    (0..pixels)
        .flat_map(|at| [0, 1, 2].map(|channel| f32::from(value(at, channel)) / 255.0))
        .collect()
}
