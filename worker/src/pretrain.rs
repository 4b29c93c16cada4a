//! `ign-worker pretrain`: the weights that a `CompositionNet` starts from.

use std::num::NonZero;
use std::path::PathBuf;

use anyhow::Result;
use ign_bake::{Crop, PretrainJob, Recipe, pretrain};

use crate::experiment::{explained, key_value, said};
use crate::{gpu, output};

#[derive(Debug, clap::Args)]
pub(crate) struct Options {
    /// Capture folders.
    #[arg(value_name = "CAPTURE", required = true)]
    captures: Vec<PathBuf>,
    /// File of the weights, as safetensors.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// Longer side of the images, in pixels.
    #[arg(long, value_name = "PX", default_value_t = 128)]
    size: u32,
    /// Seed of everything random.
    #[arg(long, value_name = "N", default_value_t = 0)]
    seed: u64,
    /// A setting of the recipe; may be given again.
    #[arg(long, value_name = "KEY=VALUE", value_parser = key_value)]
    set: Vec<(String, String)>,
    /// CPU threads [default: all cores].
    #[arg(long, env = "IGN_THREADS", value_name = "N")]
    threads: Option<NonZero<usize>>,
}

pub(crate) fn run(options: &Options) -> Result<()> {
    let threads = gpu::prepare(options.threads)?;
    let job = PretrainJob {
        captures: options.captures.clone(),
        recipe: Recipe {
            size: options.size,
            crop: Crop::None,
            seed: options.seed,
            settings: options.set.iter().cloned().collect(),
            ..Recipe::default()
        },
        out: options.out.clone(),
        threads,
    };
    pretrain(&job, &said()).map_err(|error| explained(&error))?;
    output::data(&options.out.display().to_string());
    Ok(())
}
