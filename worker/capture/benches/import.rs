//! Imports the photographs of a capture (`--views N`, JPEG of 24 megapixels with lens distortion) at `--size PX` around
//! the object: decode, undistort, crop, resample. Three distinct photographs stand in turn for all views. With
//! `--export DIR` it also writes what the peer reads. `make bench` runs it; `RAYON_NUM_THREADS` is the number of threads.

use std::fmt::Write as _;
use std::fs;
use std::path::Path;
use std::process::Command;
use std::str::FromStr;
use std::time::Instant;

use glam::{DQuat, DVec3};
use ign_capture::{Frame, ImportOptions, import};
use ign_geometry::{Camera, CameraIntrinsics};
use jpeg_encoder::{ColorType, Encoder, SamplingFactor};
use rayon::prelude::*;
use serde_json::json;

const WIDTH: u32 = 6000;
const HEIGHT: u32 = 4000;
const DISTINCT: usize = 3;
const LENS: [f64; 8] = [
    5200.0, 5200.0, 3010.5, 1985.25, -0.08, 0.05, 0.0004, -0.0003,
];

fn main() {
    let write: String = argument("--write", String::new());
    if !write.is_empty() {
        write_photographs(Path::new(&write));
        return;
    }
    let views = argument("--views", 20);
    let size = argument("--size", 512);
    let folder = tempfile::tempdir().expect("a scratch folder");
    // In a process of its own, so that its memory does not count.
    let program = std::env::current_exe().expect("this program");
    let written = Command::new(program)
        .arg("--write")
        .arg(folder.path())
        .status();
    assert!(written.expect("a process").success(), "no photographs");
    write_capture(folder.path(), views);

    let started = Instant::now();
    let scene = import(folder.path(), &ImportOptions::default()).expect("a sound capture");
    let prepare_secs = started.elapsed().as_secs_f64();
    let frame = Frame::Object { size, margin: 0.05 };
    let export: String = argument("--export", String::new());
    if !export.is_empty() {
        let to = Path::new(&export);
        for photograph in 0..DISTINCT {
            let name = format!("{photograph}.jpg");
            fs::copy(folder.path().join(&name), to.join(&name)).expect("a copy");
        }
        let cameras: Vec<CameraIntrinsics> = (0..scene.views.len())
            .map(|view| scene.frame_camera(view, &frame, 1).intrinsics)
            .collect();
        let text = json!({"lens": LENS, "photographs": DISTINCT, "cameras": cameras}).to_string();
        fs::write(to.join("import.json"), text).expect("a file");
    }

    let started = Instant::now();
    let means: Vec<f64> = (0..scene.views.len())
        .into_par_iter()
        .map(|view| {
            let camera = scene.frame_camera(view, &frame, 1);
            let image = scene.load_view(view, &camera).expect("a photograph");
            image.rgb.iter().map(|&v| f64::from(v)).sum::<f64>() / image.rgb.len() as f64
        })
        .collect();
    let secs = started.elapsed().as_secs_f64();
    let bytes = (0..DISTINCT)
        .map(|photograph| folder.path().join(format!("{photograph}.jpg")))
        .map(|path| fs::metadata(path).expect("a photograph").len());
    report(json!({
        "items": means.len(),
        "secs": secs,
        "prepare_secs": prepare_secs,
        "photograph_bytes": bytes.sum::<u64>() as f64 / DISTINCT as f64,
        "output_bytes": f64::from(size) * f64::from(size) * 12.0,
        "check": { "mean": means.iter().sum::<f64>() / means.len() as f64 },
    }));
}

/// Views on a ring around an octahedron, which fills most of the photographs' height.
fn write_capture(dir: &Path, views: usize) {
    for folder in ["images", "sparse/0"] {
        fs::create_dir_all(dir.join(folder)).expect("a folder");
    }
    let intrinsics = CameraIntrinsics {
        fx: LENS[0],
        fy: LENS[1],
        cx: LENS[2],
        cy: LENS[3],
        width: WIDTH,
        height: HEIGHT,
    };
    let mut images = String::new();
    for view in 0..views {
        let name = format!("{view:04}.jpg");
        let photograph = dir.join(format!("{}.jpg", view % DISTINCT));
        std::os::unix::fs::symlink(photograph, dir.join("images").join(&name)).expect("a link");
        let angle = std::f64::consts::TAU * view as f64 / views as f64;
        let eye = DVec3::new(3.3 * angle.cos(), 3.3 * angle.sin(), 0.4);
        let camera = Camera::look_at(intrinsics, eye, DVec3::ZERO, DVec3::Z).expect("a camera");
        let pose = camera.camera_from_world;
        let (q, t) = (DQuat::from_mat3(&pose.matrix3), pose.translation);
        writeln!(
            images,
            "{} {} {} {} {} {} {} {} 1 {name}\n",
            view + 1,
            q.w,
            q.x,
            q.y,
            q.z,
            t.x,
            t.y,
            t.z
        )
        .expect("a line");
    }
    let lens: Vec<String> = LENS.iter().map(f64::to_string).collect();
    let lens = lens.join(" ");
    for (name, text) in [
        (
            "sparse/0/cameras.txt",
            format!("1 OPENCV {WIDTH} {HEIGHT} {lens}\n"),
        ),
        ("sparse/0/images.txt", images),
        ("sparse/0/points3D.txt", String::new()),
        ("mesh.ply", octahedron()),
    ] {
        fs::write(dir.join(name), text).expect("a file");
    }
}

fn octahedron() -> String {
    let mut text = String::from(
        "ply\nformat ascii 1.0\nelement vertex 6\nproperty float x\nproperty float y\nproperty float z\n\
         element face 8\nproperty list uchar int vertex_indices\nend_header\n\
         1 0 0\n-1 0 0\n0 1 0\n0 -1 0\n0 0 1\n0 0 -1\n",
    );
    for (a, b) in [(0, 2), (2, 1), (1, 3), (3, 0)] {
        writeln!(text, "3 {a} {b} 4\n3 {b} {a} 5").expect("lines");
    }
    text
}

fn write_photographs(dir: &Path) {
    (0..DISTINCT).into_par_iter().for_each(|photograph| {
        write_photograph(&dir.join(format!("{photograph}.jpg")), photograph);
    });
}

/// A photograph's statistics: structure at all scales, sensor noise, and a smooth surround as of a studio.
fn write_photograph(path: &Path, seed: usize) {
    const OCTAVES: usize = 6;
    let (width, height) = (WIDTH as usize, HEIGHT as usize);
    let mut state = 0x9e37_79b9_7f4a_7c15_u64 ^ ((seed as u64 + 1) << 32);
    let mut noise = || {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        (state >> 40) as f32 / (1 << 24) as f32 - 0.5
    };
    let waves = |count: usize, shift: f32| -> Vec<[f32; OCTAVES]> {
        let wave = |at: usize, octave: usize| {
            let scale = 9.0 * 2.3_f32.powi(octave as i32);
            (at as f32 / 6000.0 * scale + shift * (seed + octave) as f32).sin()
        };
        (0..count)
            .map(|at| std::array::from_fn(|octave| wave(at, octave)))
            .collect()
    };
    let (across, down) = (waves(width, 1.0), waves(height, 2.0));
    let mut pixels = Vec::with_capacity(width * height * 3);
    for (y, down) in down.iter().enumerate() {
        for (x, across) in across.iter().enumerate() {
            let (u, v) = (x as f32 / 6000.0 - 0.5, y as f32 / 6000.0 - 0.33);
            let texture = if u * u + v * v < 0.09 { 1.0 } else { 0.1 };
            let products = across.iter().zip(down).zip(1_u8..);
            let value: f32 = products
                .map(|((a, b), n)| 26.0 * a * b / f32::from(n))
                .sum();
            let grain = 16.0 * (noise() + noise());
            for tint in [1.0, 0.86, 0.72] {
                let level = (118.0 + texture * value) * tint + grain;
                pixels.push(level.clamp(0.0, 255.0) as u8);
            }
        }
    }
    let mut encoder = Encoder::new_file(path, 92).expect("a file");
    encoder.set_sampling_factor(SamplingFactor::F_2_2);
    encoder
        .encode(&pixels, WIDTH as u16, HEIGHT as u16, ColorType::Rgb)
        .expect("a photograph");
}

/// The value of `--name` on the command line, or `default`.
fn argument<T: FromStr>(name: &str, default: T) -> T {
    let mut arguments = std::env::args().skip_while(|argument| argument != name);
    let value = arguments.nth(1).and_then(|value| value.parse().ok());
    value.unwrap_or(default)
}

/// Prints the result with this process's peak memory.
#[expect(clippy::print_stdout, reason = "the benchmark's result")]
fn report(mut result: serde_json::Value) {
    let status = fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"));
    let kilobytes = line.and_then(|line| line.trim().split(' ').next()?.parse::<u64>().ok());
    result["peak_bytes"] = (kilobytes.unwrap_or(0) * 1024).into();
    println!("{result}");
}
