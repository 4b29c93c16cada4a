//! What simplification makes of a capture's proxy, and how the proxy of another copy of the capture compares with it
//! (for example one whose mesh was removed, so that it is built from the points):
//! `cargo run --release -p ign-capture --example proxy -- CAPTURE SIZE [COPY]`

#![expect(clippy::print_stdout, reason = "it reports on the terminal")]

use std::path::Path;
use std::time::Instant;

use ign_capture::{Frame, ImportError, ImportOptions, Scene, import};
use ign_geometry::simplify::{deviation, simplify};
use ign_geometry::{Camera, Mesh, coverage_map};

fn main() -> Result<(), ImportError> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [capture, size, rest @ ..] = &arguments[..] else {
        println!("usage: proxy CAPTURE SIZE [COPY]");
        return Ok(());
    };
    let size = size.parse().unwrap_or(256);
    let scene = import(Path::new(capture), &ImportOptions::default())?;
    let cameras: Vec<Camera> = scene
        .train
        .iter()
        .map(|&view| camera(&scene, view, size))
        .collect();
    let started = Instant::now();
    let simplified = simplify(&scene.mesh, &cameras);
    let secs = started.elapsed().as_secs_f64();
    match simplified {
        Some(found) => {
            let held_out: Vec<Camera> = scene
                .held_out
                .iter()
                .map(|&view| camera(&scene, view, size))
                .collect();
            println!(
                "{capture} at {size} px: {} triangles to {} in {secs:.2} s; training views {:?}; held-out views {:?}",
                scene.mesh.triangles.len(),
                found.mesh.triangles.len(),
                found.deviation,
                deviation(&scene.mesh, &found.mesh, &held_out)
            );
        }
        None => println!(
            "{capture} at {size} px: {} triangles kept, {secs:.2} s",
            scene.mesh.triangles.len()
        ),
    }
    for copy in rest {
        let started = Instant::now();
        let other = import(Path::new(copy), &ImportOptions::default())?;
        let secs = started.elapsed().as_secs_f64();
        let built = other
            .info
            .proxy_built
            .as_deref()
            .unwrap_or("read from its file");
        let radius = scene.mesh.bounding_sphere().1;
        let [there, back] =
            [(&other.mesh, &scene.mesh), (&scene.mesh, &other.mesh)].map(|(from, to)| {
                let mut off = distances(from, to);
                off.sort_by(f64::total_cmp);
                [0.5, 0.9, 0.99]
                    .map(|share| off[((off.len() - 1) as f64 * share) as usize] / radius)
            });
        let mut agreement: Vec<f64> = cameras
            .iter()
            .map(|camera| agreement(&scene.mesh, &other.mesh, camera))
            .collect();
        agreement.sort_by(f64::total_cmp);
        println!(
            "{copy}: {built}; imported in {secs:.1} s; distance by the radius (median, 90 %, 99 %): to the given mesh \
             {there:.4?}, from it {back:.4?}; silhouettes agree to {:.3} (median), {:.3} (worst)",
            agreement[agreement.len() / 2],
            agreement[0]
        );
    }
    Ok(())
}

fn camera(scene: &Scene, view: usize, size: u32) -> Camera {
    scene.frame_camera(view, &Frame::Object { size, margin: 0.05 }, 1)
}

/// From each of up to 2,000 vertices to the nearest vertex of the other mesh.
fn distances(from: &Mesh, to: &Mesh) -> Vec<f64> {
    let step = from.positions.len().div_ceil(2000);
    from.positions
        .iter()
        .step_by(step)
        .map(|place| {
            let squared = to
                .positions
                .iter()
                .map(|other| other.distance_squared(*place));
            squared.fold(f64::INFINITY, f64::min).sqrt()
        })
        .collect()
}

/// Intersection of the silhouettes by their union.
fn agreement(a: &Mesh, b: &Mesh, camera: &Camera) -> f64 {
    let [a, b] = [a, b].map(|mesh| coverage_map(mesh, camera, 1, 2));
    let sum = |pick: fn(f32, f32) -> f32| -> f64 {
        a.iter().zip(&b).map(|(a, b)| f64::from(pick(*a, *b))).sum()
    };
    sum(f32::min) / sum(f32::max).max(f64::MIN_POSITIVE)
}
