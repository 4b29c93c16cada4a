//! What a bundle's files alone render is what was scored, and what was scored can be scored again.

use std::fs;
use std::path::Path;
use std::process::Command;
use std::time::Duration;

use anyhow::{Context as _, Result, ensure};
use ign_bundle::{Bundle, held_out_file, metrics};
use ign_e2e::{Client, Demo, demo_capture, program, run};
use image::RgbImage;

const LIMIT: Duration = Duration::from_mins(4);

#[test]
fn a_fetched_bundle_renders_what_was_scored() -> Result<()> {
    let dir = tempfile::Builder::new().prefix("ign-e2e-").tempdir()?;
    let capture = demo_capture(
        &dir.path().join("vase"),
        Demo {
            gloss: 0.8,
            ..Demo::default()
        },
    )?;
    let text = |path: &Path| {
        path.to_str()
            .map(str::to_owned)
            .context("the path is no UTF-8")
    };
    let out = dir.path().join("out");
    // No service runs: the bake starts one for its own time.
    let client = Client::of_data(&text(&dir.path().join("data"))?);
    let bake = [
        "bake",
        &text(&capture)?,
        "--object",
        "demo/vase",
        "--size",
        "48",
        "--budget-secs",
        "8",
        "--out",
        &text(&out)?,
    ];
    let output = run(&mut client.command(&bake)?, LIMIT)?;
    ensure!(
        output.status.success(),
        "the bake failed: {}",
        String::from_utf8_lossy(&output.stderr)
    );

    let bundle = Bundle::open(&out.join("bundle"))?;
    let scores = bundle.metrics()?.context("the bundle has no metrics")?;
    ensure!(
        fs::read(out.join("metrics.json"))? == bundle.read("metrics.json")?,
        "the two metrics.json differ"
    );
    let ours = scores.method("ours").context("ours was not scored")?;
    ensure!(
        ours.per_view.len() == 2,
        "{} held-out views instead of 2",
        ours.per_view.len()
    );
    for view in &ours.per_view {
        let picture = |kind: &str| -> Result<RgbImage> {
            Ok(
                image::load_from_memory(&bundle.read(&held_out_file(&view.name, kind))?)?
                    .into_rgb8(),
            )
        };
        let (scored, target) = (picture("ours")?, picture("target")?);
        let again = metrics::mse(&scored, &target);
        ensure!(
            (again - view.mse).abs() < 1e-6,
            "{}: scored {}, scored again {again}",
            view.name,
            view.mse
        );

        let rendered = dir.path().join("rendered");
        let output = run(
            Command::new(program("ign-worker")?)
                .arg("render")
                .arg(out.join("bundle"))
                .args(["--view", &view.name, "--threads", "1", "--out"])
                .arg(&rendered),
            LIMIT,
        )?;
        ensure!(
            output.status.success(),
            "render failed: {}",
            String::from_utf8_lossy(&output.stderr)
        );
        let printed = String::from_utf8(output.stdout)?;
        let image = image::open(printed.trim())?.into_rgb8();
        ensure!(
            image.dimensions() == scored.dimensions(),
            "{}: another size",
            view.name
        );
        let worst = image
            .iter()
            .zip(scored.iter())
            .map(|(a, b)| a.abs_diff(*b))
            .max()
            .unwrap_or(0);
        ensure!(
            worst <= 1,
            "{}: rendered from the bundle, a pixel differs by {worst} of 255",
            view.name
        );
    }
    Ok(())
}
