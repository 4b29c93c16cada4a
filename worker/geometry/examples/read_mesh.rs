//! Times reading mesh files: `cargo run --release -p ign-geometry --example read_mesh -- FILE...`

#![expect(clippy::print_stdout, reason = "it reports on the terminal")]

use std::path::Path;
use std::time::Instant;

use ign_geometry::{MeshError, read_mesh};

fn main() -> Result<(), MeshError> {
    for file in std::env::args().skip(1) {
        let started = Instant::now();
        let mesh = read_mesh(Path::new(&file))?;
        let secs = started.elapsed().as_secs_f64();
        let megabytes = std::fs::metadata(&file).map_or(0.0, |meta| meta.len() as f64 / 1e6);
        println!(
            "{file}: {} triangles, {megabytes:.0} MB in {secs:.2} s, {:.0} MB/s, peak {} MB",
            mesh.triangles.len(),
            megabytes / secs,
            peak_megabytes()
        );
    }
    Ok(())
}

/// Largest resident size of this process so far, where the system tells.
fn peak_megabytes() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let peak = status.lines().find_map(|line| line.strip_prefix("VmHWM:"));
    let kilobytes = peak.and_then(|peak| peak.split_whitespace().next()?.parse::<u64>().ok());
    kilobytes.unwrap_or(0) / 1024
}
