//! The stages of a bake, in order.

use std::path::PathBuf;
use std::time::Instant;

use ign_bundle::metrics::{Metrics, SCHEMA, ViewCounts};
use ign_capture::{Gains, ImportError, ImportOptions, Preflight, PreflightOptions, Survey};
use ign_events::Event;
use serde_json::json;

use crate::BakeError;
use crate::checkpoint::Session;
use crate::compare::{self, Rivals};
use crate::data::{Dataset, Scored};
use crate::divergence::Fallback;
use crate::pack::{Finished, pack};
use crate::plan;
use crate::progress::Reporter;
use crate::recipe::{GainsChoice, Recipe};
use crate::training::Trainer;

/// What to bake, and where.
#[derive(Clone, Debug)]
pub struct BakeJob {
    /// Folder of the capture's files.
    pub capture_dir: PathBuf,
    /// `sha256:<hex>` of the capture's manifest, for provenance.
    pub capture_digest: String,
    /// Collection and object, for provenance.
    pub object: (String, String),
    /// What to train.
    pub recipe: Recipe,
    /// Resume from here.
    pub checkpoint: Option<PathBuf>,
    /// Checkpoints go to `checkpoints/`, the result to `bundle/` below it.
    pub work_dir: PathBuf,
    /// Cores this job may use.
    pub threads: usize,
}

/// Runs one bake to its end; returns the bundle's folder.
///
/// # Errors
/// See [`BakeError`]; its [`BakeError::failure`] says whether trying again can help.
pub fn bake(job: &BakeJob, events: &dyn Fn(Event)) -> Result<PathBuf, BakeError> {
    let (started_at, started) = (chrono::Utc::now(), Instant::now());
    let reporter = Reporter::new(events);
    ign_nets::device::limit_threads(job.threads);
    let device = ign_nets::select_device();

    reporter.stage("import", "reading the capture");
    let asked = PreflightOptions {
        proxy: job.recipe.proxy.as_ref().map(PathBuf::from),
        size: job.recipe.size,
        budget_secs: job.recipe.budget_secs,
    };
    let options = ImportOptions {
        proxy: asked.proxy.clone(),
    };
    let scene = ign_capture::import(&job.capture_dir, &options)?;
    let mut settings = job.recipe.resolve(scene.train.len())?;
    reporter.expect(settings.trained_methods());
    reporter.activity("preflight");
    reporter.step(0.2, "comparing the photographs at common surface points");
    let survey = Survey::new(&scene);
    let estimated = Gains::estimate(&scene, &survey);
    let preflight = Preflight::of(&job.capture_dir, &scene, &survey, &estimated, &asked);
    drop(survey);
    for fault in &preflight.faults {
        reporter.warn(format!("{} ({})", fault.message, fault.at));
    }
    if !preflight.ok {
        return Err(ImportError::Faults(preflight.faults).into());
    }
    let gains = match settings.gains {
        GainsChoice::Auto => estimated,
        GainsChoice::Off => Gains::none(scene.views.len()),
    };
    let mut data = Dataset::new(
        &scene,
        &gains,
        &job.recipe,
        &settings,
        device,
        &job.work_dir,
    )?;
    reporter.info(format!(
        "{} views to train on, {} to validate, {} held out; device {}",
        data.train.len(),
        data.validation.len(),
        data.held_out.len(),
        ign_nets::device::name(device),
    ));
    let checkpoints = job.work_dir.join("checkpoints");
    let mut session = Session::open(
        &reporter,
        &checkpoints,
        settings.checkpoint_secs,
        &job.recipe,
        &job.capture_digest,
        job.checkpoint.as_deref(),
    )?;

    reporter.stage("plan", "fitting the proxy to the masks");
    let fitted = data.fit_proxy(settings.fit)?;
    reporter.step(0.1, "choosing reference views");
    // On the proxy as given: what a view covers must not hang on how coarse a proxy suffices.
    let chosen = data.choose_references(settings.references);
    reporter.activity("proxy");
    reporter.step(0.2, "simplifying the proxy where no view shows it");
    data.settle_proxy(settings.simplify);
    reporter.info(data.proxy_words.clone());
    if let Some(words) = &fitted {
        reporter.info(words.clone());
    }
    reporter.activity("views");
    reporter.step(0.4, "loading validation and held-out views");
    let fit = plan::fit(&mut data, &mut settings, chosen, &mut session)?;
    let (data, settings, drawn, chosen) = (data, settings, fit.drawn, fit.chosen);
    let left = settings
        .max_secs
        .map(|most| plan::training_secs(&data, &settings, &drawn, started, most));
    let trainer = Trainer {
        settings: &settings,
        data: &data,
        drawn: &drawn,
        seed: job.recipe.seed,
        budget_secs: left
            .into_iter()
            .chain(job.recipe.budget_secs)
            .reduce(f64::min),
    };
    let (ours, mut plan) = trainer.ours(&mut session)?;
    let rivals = Rivals::train(&trainer, &mut session, &ours, &chosen)?;
    for sentence in fitted.into_iter().chain(fit.words) {
        say(&mut plan, sentence);
    }
    note_capture(&mut plan, &preflight, &gains);
    note_fallbacks(&mut plan, session.fallbacks());

    reporter.stage("evaluate", "scoring held-out views");
    let names: Vec<String> = data
        .held_out
        .iter()
        .map(|&view| scene.views[view].name.clone())
        .collect();
    let rows = compare::rows(&trainer, &session, &ours, &rivals, &names);
    let views: Vec<(String, &Scored)> = names.into_iter().zip(&drawn.held_out).collect();
    let bundle = pack(Finished {
        job,
        settings: &settings,
        data: &data,
        model: &ours.model,
        images: &drawn.images,
        chosen: &chosen,
        views: &views,
        rows,
        metrics: Metrics {
            schema: SCHEMA.into(),
            capture: job.capture_digest.clone(),
            resolution: views.first().map_or([job.recipe.size; 2], |(_, v)| {
                let i = v.target.camera.intrinsics;
                [i.width, i.height]
            }),
            views: ViewCounts {
                train: (data.train.len() + data.validation.len()) as u32,
                held_out: data.held_out.len() as u32,
                references: drawn.images.len() as u32,
            },
            methods: Vec::new(),
            speed_error: session.curve().to_vec(),
            plan,
            stages: Vec::new(),
            device: ign_nets::device::name(device),
        },
        preflight: &preflight,
        started_at,
        reporter: &reporter,
    })?;
    reporter.step(1.0, "done");
    Ok(bundle)
}

/// Puts what was found out about the capture into the plan.
fn note_capture(plan: &mut serde_json::Value, preflight: &Preflight, gains: &Gains) {
    let words = if gains.needed {
        format!(
            "The photographs differ in exposure: gains per view take away {:.0} % of the differences at surface points that \
             had no part in estimating them. Everything is learned and rendered in one exposure; scores compare in the \
             photograph's own.",
            100.0 * gains.explained
        )
    } else {
        "The photographs are used in their own exposure.".to_owned()
    };
    say(plan, words);
    plan["gains"] = json!({ "applied": gains.needed, "explained": gains.explained });
    plan["preflight"] = json!(preflight);
}

/// Puts what went wrong in training, and what was done about it, into the plan.
fn note_fallbacks(plan: &mut serde_json::Value, fallbacks: &[Fallback]) {
    for fallback in fallbacks {
        say(plan, fallback.words());
    }
    plan["fallbacks"] = json!(fallbacks);
}

/// Adds a sentence to the plan.
fn say(plan: &mut serde_json::Value, words: String) {
    if let Some(list) = plan["words"].as_array_mut() {
        list.push(words.into());
    }
}
