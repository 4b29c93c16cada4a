//! Captures that cannot be baked end as failed jobs within seconds, and the worker goes on.

use std::fs;
use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, ensure};
use ign_e2e::{Demo, Embedded, copy_dir, demo_capture, wait_until};

/// From being leased to having failed, also on a loaded machine.
const LIMIT: Duration = Duration::from_secs(30);

/// Name of a fault, how to make it in a good capture, and what the message must name.
type Fault = (
    &'static str,
    fn(&Path) -> Result<()>,
    &'static [&'static str],
);

const FAULTS: [Fault; 7] = [
    ("empty-folder", empty, &["missing"]),
    ("missing-mesh", missing_mesh, &["mesh"]),
    ("image-that-is-none", image_that_is_none, &["image"]),
    ("absent-image", absent_image, &["image"]),
    ("zero-focal-length", zero_focal_length, &["focal"]),
    ("nan-vertices", nan_vertices, &["vertex", "mesh.ply"]),
    (
        "truncated-images-bin",
        truncated_images_bin,
        &["images.bin"],
    ),
];

#[test]
fn bad_captures_fail_with_one_clear_message_and_the_worker_goes_on() -> Result<()> {
    let dir = tempfile::Builder::new().prefix("ign-e2e-").tempdir()?;
    let good = demo_capture(&dir.path().join("good"), Demo::default())?;
    let service = Embedded::start(&dir.path().join("data"), 1)?;
    let client = service.client()?;
    for (name, break_it, words) in FAULTS {
        let capture = dir.path().join(name);
        copy_dir(&good, &capture)?;
        break_it(&capture)?;
        let started = Instant::now();
        let job = client.submit(
            &capture,
            &format!("bad/{name}"),
            &["--size", "32", "--budget-secs", "5"],
        )?;
        let job = wait_until(&format!("the end of {name}"), LIMIT, || {
            let job = client.job(job.id())?;
            Ok(job.has_ended().then_some(job))
        })?;
        let failure = &job.0["failure"];
        ensure!(
            job.state() == "failed",
            "{name} {}: {:?}",
            job.state(),
            job.0
        );
        ensure!(failure["kind"] == "invalid_input", "{name}: {failure}");
        ensure!(
            job.attempt() == 1,
            "{name} was tried {} times",
            job.attempt()
        );
        let message = failure["message"].as_str().context("no message")?;
        let everything = failure.to_string().to_lowercase();
        ensure!(
            !message.is_empty() && message.lines().count() == 1,
            "{name}: {message:?}"
        );
        ensure!(
            words.iter().any(|word| everything.contains(word)),
            "{name}: {failure} names none of {words:?}"
        );
        ensure!(!everything.contains("panic"), "{name}: {failure}");
        ensure!(
            started.elapsed() < LIMIT,
            "{name} took {:?}",
            started.elapsed()
        );
    }
    let bake = client.command(&[
        "bake",
        good.to_str().context("the path is no UTF-8")?,
        "--object",
        "good/vase",
        "--size",
        "32",
        "--budget-secs",
        "4",
        "--out",
        dir.path()
            .join("out")
            .to_str()
            .context("the path is no UTF-8")?,
    ])?;
    let output = ign_e2e::run(&mut { bake }, Duration::from_mins(4))?;
    ensure!(
        output.status.success(),
        "the good capture failed: {}",
        String::from_utf8_lossy(&output.stderr)
    );
    for file in [
        "bundle/bundle.json",
        "metrics.json",
        "report.html",
        "held_out",
    ] {
        ensure!(
            dir.path().join("out").join(file).exists(),
            "{file} is absent"
        );
    }
    Ok(())
}

fn empty(capture: &Path) -> Result<()> {
    fs::remove_dir_all(capture)?;
    fs::create_dir(capture)?;
    Ok(())
}

fn missing_mesh(capture: &Path) -> Result<()> {
    fs::remove_file(capture.join("mesh.ply"))?;
    Ok(())
}

/// Path of one photograph.
fn photograph(capture: &Path) -> Result<std::path::PathBuf> {
    let mut files: Vec<_> = fs::read_dir(capture.join("images"))?.collect::<Result<_, _>>()?;
    files.sort_by_key(fs::DirEntry::file_name);
    Ok(files.first().context("no photograph")?.path())
}

fn image_that_is_none(capture: &Path) -> Result<()> {
    fs::write(photograph(capture)?, "this is no image\n")?;
    Ok(())
}

fn absent_image(capture: &Path) -> Result<()> {
    fs::remove_file(photograph(capture)?)?;
    Ok(())
}

fn zero_focal_length(capture: &Path) -> Result<()> {
    let file = capture.join("sparse/0/cameras.txt");
    let text = fs::read_to_string(&file)?;
    let lines =
        text.lines().map(
            |line| match line.split_whitespace().collect::<Vec<_>>().as_slice() {
                [id, "PINHOLE", width, height, _fx, fy, cx, cy] => {
                    format!("{id} PINHOLE {width} {height} 0 {fy} {cx} {cy}")
                }
                _ => line.to_owned(),
            },
        );
    let changed = lines.collect::<Vec<_>>().join("\n") + "\n";
    ensure!(changed != text, "no PINHOLE camera in {}", file.display());
    fs::write(&file, changed)?;
    Ok(())
}

/// Puts NaN into the first vertices, in a text or binary PLY of floats or doubles.
fn nan_vertices(capture: &Path) -> Result<()> {
    let mesh = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n\
                element face 1\nproperty list uchar int vertex_indices\nend_header\nnan 0 0\n1 0 0\n0 1 0\n3 0 1 2\n";
    fs::write(capture.join("mesh.ply"), mesh)?;
    Ok(())
}

/// A binary model whose image list ends in the middle.
fn truncated_images_bin(capture: &Path) -> Result<()> {
    let model = capture.join("sparse/0");
    let camera = fs::read_to_string(model.join("cameras.txt"))?;
    let fields: Vec<f64> = camera
        .lines()
        .find(|line| !line.starts_with('#') && !line.trim().is_empty())
        .context("no camera")?
        .split_whitespace()
        .filter_map(|field| field.parse().ok())
        .collect();
    ensure!(fields.len() == 7, "cameras.txt holds no PINHOLE camera");
    let mut cameras = 1_u64.to_le_bytes().to_vec();
    cameras.extend((fields[0] as i32).to_le_bytes());
    cameras.extend(1_i32.to_le_bytes());
    cameras.extend(
        fields[1..3]
            .iter()
            .flat_map(|size| (*size as u64).to_le_bytes()),
    );
    cameras.extend(
        fields[3..]
            .iter()
            .flat_map(|parameter| parameter.to_le_bytes()),
    );
    for file in ["cameras.txt", "images.txt", "points3D.txt"] {
        let _absent_is_fine = fs::remove_file(model.join(file));
    }
    fs::write(model.join("cameras.bin"), cameras)?;
    let mut images = 16_u64.to_le_bytes().to_vec();
    images.extend([0; 20]);
    fs::write(model.join("images.bin"), images)?;
    fs::write(model.join("points3D.bin"), 0_u64.to_le_bytes())?;
    Ok(())
}
