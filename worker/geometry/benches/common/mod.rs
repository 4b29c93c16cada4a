//! What the benchmarks share: a mesh and views made from nothing but numbers, arguments, and the one line of JSON
//! that each prints for `tests/bench/run.py`.

use std::str::FromStr;

use glam::DVec3;
use ign_geometry::{Camera, CameraIntrinsics, Mesh};
use serde_json::Value;

/// The value of `--name` on the command line, or `default`.
pub(crate) fn argument<T: FromStr>(name: &str, default: T) -> T {
    let mut arguments = std::env::args().skip_while(|argument| argument != name);
    let value = arguments.nth(1).and_then(|value| value.parse().ok());
    value.unwrap_or(default)
}

/// A lumpy closed surface of about `triangles` triangles, with hollows that hide each other: a cube's faces pushed
/// out to a sphere and displaced. Radius at most 1.
pub(crate) fn statue(triangles: usize) -> Mesh {
    let side = (triangles as f64 / 12.0).sqrt().round() as u32;
    let (mut positions, mut corners) = (Vec::new(), Vec::new());
    for face in 0..6 {
        let first = positions.len() as u32;
        for row in 0..=side {
            for column in 0..=side {
                // Equal angles rather than equal steps: the triangles then differ little in size.
                let at = |step: u32| {
                    ((f64::from(step) / f64::from(side) - 0.5) * std::f64::consts::FRAC_PI_2).tan()
                };
                let (u, v) = (at(column), at(row));
                let sign = if face % 2 == 0 { 1.0 } else { -1.0 };
                let out = match face / 2 {
                    0 => DVec3::new(sign, u, v * sign),
                    1 => DVec3::new(v * sign, sign, u),
                    _ => DVec3::new(u, v * sign, sign),
                };
                let out = out.normalize_or_zero();
                let waves = (7.0 * out.x + 1.0).sin() * (6.0 * out.y).sin()
                    + 0.5 * (11.0 * out.z + 2.0 * out.x).sin();
                positions.push(out * (0.8 + 0.13 * waves));
            }
        }
        for row in 0..side {
            for column in 0..side {
                let corner = first + row * (side + 1) + column;
                let below = corner + side + 1;
                corners.push([corner, corner + 1, below]);
                corners.push([corner + 1, below + 1, below]);
            }
        }
    }
    Mesh::new(positions, corners).expect("a closed surface")
}

/// `count` cameras of `size` x `size` pixels, evenly spread on a sphere around the statue, which fills their images.
pub(crate) fn cameras(count: usize, size: u32) -> Vec<Camera> {
    let scale = f64::from(size) / 512.0;
    let intrinsics = CameraIntrinsics {
        fx: 640.0 * scale,
        fy: 645.0 * scale,
        cx: 250.3 * scale,
        cy: 259.1 * scale,
        width: size,
        height: size,
    };
    let golden = std::f64::consts::PI * (3.0 - 5.0_f64.sqrt());
    let camera = |index: usize| {
        let height = 1.0 - (2.0 * index as f64 + 1.0) / count as f64;
        let (ring, azimuth) = ((1.0 - height * height).sqrt(), golden * index as f64);
        let eye = DVec3::new(ring * azimuth.cos(), ring * azimuth.sin(), height) * 2.8;
        Camera::look_at(intrinsics, eye, DVec3::ZERO, DVec3::Z).expect("not above a pole")
    };
    (0..count).map(camera).collect()
}

/// Largest resident set of this process so far, in bytes.
fn peak_bytes() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"));
    let kilobytes = line.and_then(|line| line.trim().split(' ').next()?.parse::<u64>().ok());
    kilobytes.unwrap_or(0) * 1024
}

/// Prints the result: what was measured, with this process's peak memory.
#[expect(clippy::print_stdout, reason = "the benchmark's result")]
pub(crate) fn report(mut result: Value) {
    result["peak_bytes"] = peak_bytes().into();
    println!("{result}");
}
