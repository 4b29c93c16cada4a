//! `ign-worker demo-capture`: generates a capture to try things with.

use std::path::PathBuf;

use anyhow::Result;
use ign_demo::{DemoOptions, Shape};

use crate::output::{self, Steps};

#[derive(Debug, clap::Args)]
pub(crate) struct Options {
    /// Folder to make; must be absent or empty.
    out: PathBuf,
    /// vase, bowl or sphere.
    #[arg(long, default_value = "vase")]
    shape: Shape,
    /// 0: matte; 1: a fresh glaze.
    #[arg(long, default_value_t = DemoOptions::default().gloss)]
    gloss: f64,
    /// Width and height of the images in pixels.
    #[arg(long, default_value_t = DemoOptions::default().size)]
    size: u32,
    /// Number of views, held-out ones included.
    #[arg(long, default_value_t = DemoOptions::default().views)]
    views: usize,
    /// Views held out [default: an eighth].
    #[arg(long)]
    held_out: Option<usize>,
    /// Hold out so many frames of one round about the object instead.
    #[arg(long, value_name = "FRAMES", conflicts_with_all = ["held_out", "turntable"])]
    orbit: Option<usize>,
    /// Varies painting and camera path.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Turn the object under fixed lamps instead of moving the camera: light that is not constant.
    #[arg(long)]
    turntable: bool,
    /// Pixels by which the proxy is off, and twice those by which the poses are, as after a reconstruction.
    #[arg(long, value_name = "PX", default_value_t = 0.0)]
    misregistration: f64,
}

pub(crate) fn run(options: &Options) -> Result<()> {
    let demo = DemoOptions {
        shape: options.shape,
        gloss: options.gloss,
        size: options.size,
        views: options.views,
        held_out: options.held_out,
        orbit: options.orbit,
        seed: options.seed,
        turntable: options.turntable,
        misregistration: options.misregistration,
    };
    let steps = std::cell::RefCell::new(Steps::new(
        "views traced",
        (options.views + options.orbit.unwrap_or(0)) as u64,
    ));
    let summary = ign_demo::generate(&options.out, &demo, &|done, _total| {
        steps.borrow_mut().set(done as u64);
    })?;
    steps.into_inner().finish();
    output::say(&format!(
        "{} views to train on, {} held out, mesh of {} triangles",
        summary.train, summary.held_out, summary.triangles
    ));
    output::data(&summary.dir.display().to_string());
    Ok(())
}
