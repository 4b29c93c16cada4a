//! `ign-worker experiment`: the paper's experiments on captures of one's own.

use std::cell::Cell;
use std::num::NonZero;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use anyhow::{Result, anyhow};
use clap::builder::{PossibleValuesParser, TypedValueParser};
use ign_bake::experiment::{self, Experiment, ExperimentJob};
use ign_bake::{BakeError, Crop, Event, Preset, Recipe};

use crate::{gpu, output};

#[derive(Debug, clap::Args)]
pub(crate) struct Options {
    /// What to compare.
    #[arg(value_name = "NAME", value_parser = by_name())]
    experiment: Experiment,
    /// Capture folders; `diffuse` needs generated ones, `temporal` held-out views along a path (see demo-capture --orbit).
    #[arg(value_name = "CAPTURE", required = true)]
    captures: Vec<PathBuf>,
    /// Folder for NAME.md, NAME.json, NAME.svg and the bakes; bakes that are there already are used again.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// What to train: auto, standard or paper.
    #[arg(long, value_parser = preset, default_value = "standard")]
    preset: Preset,
    /// Longer side of the rendered images, in pixels.
    #[arg(long, value_name = "PX", default_value_t = 128)]
    size: u32,
    /// Bake only the object's window, not the whole frame.
    #[arg(long)]
    window: bool,
    /// Seconds of training per bake [default: as many steps as the preset has].
    #[arg(long, value_name = "N")]
    budget_secs: Option<f64>,
    /// Seed of everything random.
    #[arg(long, value_name = "N", default_value_t = 0)]
    seed: u64,
    /// Seeds that `ablation` goes through, from --seed on.
    #[arg(long, value_name = "N", default_value_t = 3, value_parser = clap::value_parser!(u64).range(1..))]
    seeds: u64,
    /// Settings that `ablation` changes, `head,loss` say [default: all that differ between the presets].
    #[arg(long, value_name = "KEYS", value_delimiter = ',')]
    only: Vec<String>,
    /// A setting of the recipe; may be given again.
    #[arg(long, value_name = "KEY=VALUE", value_parser = key_value)]
    set: Vec<(String, String)>,
    /// CPU threads [default: all cores].
    #[arg(long, env = "IGN_THREADS", value_name = "N")]
    threads: Option<NonZero<usize>>,
}

/// An experiment by its name.
fn by_name() -> impl TypedValueParser<Value = Experiment> {
    PossibleValuesParser::new(Experiment::ALL.map(Experiment::name)).map(|name| {
        let found = Experiment::ALL.into_iter().find(|e| e.name() == name);
        found.unwrap_or(Experiment::Methods)
    })
}

/// A preset by its name.
fn preset(name: &str) -> Result<Preset, String> {
    serde_json::from_value(name.into())
        .map_err(|error| format!("expected auto, standard or paper: {error}"))
}

pub(crate) fn key_value(text: &str) -> Result<(String, String), String> {
    match text.split_once('=') {
        Some((key, value)) if !key.is_empty() => Ok((key.to_owned(), value.to_owned())),
        _ => Err("expected KEY=VALUE".to_owned()),
    }
}

/// Between two lines of progress.
const INTERVAL: Duration = Duration::from_secs(10);

pub(crate) fn run(options: &Options) -> Result<()> {
    let threads = gpu::prepare(options.threads)?;
    let job = ExperimentJob {
        experiment: options.experiment,
        captures: options.captures.clone(),
        recipe: Recipe {
            preset: options.preset,
            size: options.size,
            crop: if options.window {
                Crop::Object
            } else {
                Crop::None
            },
            seed: options.seed,
            budget_secs: options.budget_secs,
            proxy: None,
            settings: options.set.iter().cloned().collect(),
        },
        seeds: options.seeds,
        only: options.only.clone(),
        out: options.out.clone(),
        threads,
    };
    for file in experiment::run(&job, &said()).map_err(|error| explained(&error))? {
        output::data(&file.display().to_string());
    }
    Ok(())
}

/// Says what a training reports, its progress now and then.
pub(crate) fn said() -> impl Fn(Event) {
    let last = Cell::new(Instant::now());
    move |event| match event {
        Event::Log { message, .. } => output::say(&message),
        Event::Progress(progress) if last.get().elapsed() >= INTERVAL => {
            last.set(Instant::now());
            output::say(&format!(
                "{:3.0} % {}: {}",
                progress.percent, progress.stage, progress.message
            ));
        }
        _ => {}
    }
}

/// A failure with what to do about it.
pub(crate) fn explained(error: &BakeError) -> anyhow::Error {
    let failure = error.failure();
    let hint = match failure.hint.as_str() {
        "" => String::new(),
        hint => format!("\nhint: {hint}"),
    };
    anyhow!("{}{hint}", failure.message)
}
