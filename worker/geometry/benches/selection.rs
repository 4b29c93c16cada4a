//! Chooses 20 references among the views of a capture (`--views N`), from G-buffers of `--size PX` pixels that are
//! drawn on demand. With `--export DIR` it also writes what the choice knows of the views, for the peer.
//! `make bench` runs it; `RAYON_NUM_THREADS` is the number of threads.

mod common;

use std::fs::File;
use std::io::BufWriter;
use std::path::Path;
use std::time::Instant;

use ign_geometry::Drawable;
use ign_geometry::select::Candidates;
use serde_json::json;

fn main() {
    let mesh = common::statue(common::argument("--triangles", 1_000_000));
    let cameras = common::cameras(
        common::argument("--views", 100),
        common::argument("--size", 64),
    );
    let drawable = Drawable::new(&mesh);
    drop(mesh);
    let started = Instant::now();
    let candidates = Candidates::new(cameras.len(), |view| drawable.g_buffer(&cameras[view], 1));
    let prepare_secs = started.elapsed().as_secs_f64();
    let started = Instant::now();
    let chosen = candidates.choose(common::argument("--references", 20));
    let secs = started.elapsed().as_secs_f64();
    let folder: String = common::argument("--export", String::new());
    if !folder.is_empty() {
        let file = File::create(Path::new(&folder).join("candidates.json"));
        let file = BufWriter::new(file.expect("the folder can be written"));
        serde_json::to_writer(file, &candidates).expect("the file can be written");
    }
    let weights = &json!(candidates)["cosines"];
    common::report(json!({
        "items": cameras.len(),
        "secs": secs,
        "prepare_secs": prepare_secs,
        // By sample and target: weight, ray and cost.
        "table_bytes": weights.as_array().map_or(0, Vec::len) * 5 * size_of::<f32>(),
        "check": { "chosen": chosen },
    }));
}
