//! Draws the views of a capture: `--maps depth` (depth and triangle) or `--maps all` (G-buffers), `--views N`,
//! `--triangles N`, `--size PX`. With `--export DIR` it draws nothing and writes mesh and cameras for the peers.
//! `make bench` runs it; `RAYON_NUM_THREADS` is the number of threads.

mod common;

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::Path;
use std::time::Instant;

use ign_geometry::{Camera, Drawable, Mesh};
use rayon::prelude::{IntoParallelRefIterator, ParallelIterator};
use serde_json::json;

fn main() {
    let mesh = common::statue(common::argument("--triangles", 1_000_000));
    let cameras = common::cameras(
        common::argument("--views", 20),
        common::argument("--size", 512),
    );
    let folder: String = common::argument("--export", String::new());
    if !folder.is_empty() {
        export(Path::new(&folder), &mesh, &cameras).expect("the folder can be written");
        return;
    }
    let started = Instant::now();
    let drawable = Drawable::new(&mesh);
    let prepare_secs = started.elapsed().as_secs_f64();
    let all = common::argument("--maps", "all".to_owned()) == "all";
    let started = Instant::now();
    // Covered pixels and the sum of their depths, so that the sides can be compared.
    let found: Vec<(usize, f64)> = cameras
        .par_iter()
        .map(|camera| {
            let depth = if all {
                drawable.g_buffer(camera, 1).depth
            } else {
                drawable.rasterize(camera).depth
            };
            let covered = depth.iter().filter(|depth| **depth > 0.0);
            (
                covered.count(),
                depth.iter().map(|depth| f64::from(*depth)).sum(),
            )
        })
        .collect();
    let secs = started.elapsed().as_secs_f64();
    let covered: usize = found.iter().map(|(covered, _)| covered).sum();
    let depth: f64 = found.iter().map(|(_, depth)| depth).sum();
    common::report(json!({
        "items": cameras.len(),
        "secs": secs,
        "prepare_secs": prepare_secs,
        "triangles": mesh.triangles.len(),
        "vertices": mesh.positions.len(),
        "pixels": cameras.iter().map(|c| u64::from(c.intrinsics.width) * u64::from(c.intrinsics.height)).sum::<u64>(),
        "check": { "covered": covered as f64 / cameras.len() as f64, "mean_depth": depth / covered as f64 },
    }));
}

/// `positions.f32` and `triangles.u32`, little-endian, three numbers a row; `cameras.json`.
fn export(folder: &Path, mesh: &Mesh, cameras: &[Camera]) -> std::io::Result<()> {
    let mut positions = BufWriter::new(File::create(folder.join("positions.f32"))?);
    for position in &mesh.positions {
        for value in position.as_vec3().to_array() {
            positions.write_all(&value.to_le_bytes())?;
        }
    }
    let mut triangles = BufWriter::new(File::create(folder.join("triangles.u32"))?);
    for corner in mesh.triangles.iter().flatten() {
        triangles.write_all(&corner.to_le_bytes())?;
    }
    positions.flush()?;
    triangles.flush()?;
    let cameras: Vec<_> = cameras
        .iter()
        .map(|camera| {
            let pose = &camera.camera_from_world;
            json!({
                "intrinsics": camera.intrinsics,
                "rotation": pose.matrix3.transpose().to_cols_array_2d(),
                "translation": pose.translation.to_array(),
            })
        })
        .collect();
    serde_json::to_writer(File::create(folder.join("cameras.json"))?, &cameras)?;
    Ok(())
}
