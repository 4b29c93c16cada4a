//! The stages of a bake, in order.

use std::path::PathBuf;

use ign_bundle::metrics::{Metrics, SCHEMA, ViewCounts};
use ign_capture::{Gains, ImportError, ImportOptions, Preflight, Survey};
use ign_events::Event;
use ign_render::{Model, ReferenceImage, References, RenderSettings, debevec_ibr, naive_ibr};
use rayon::prelude::*;
use serde_json::json;

use crate::checkpoint::{Schedule, Session};
use crate::composition::{self, Plan};
use crate::data::{Dataset, Scored};
use crate::evaluate::{Row, score};
use crate::pack::{Finished, pack};
use crate::progress::Reporter;
use crate::recipe::{EffectsChoice, GainsChoice, Preset, Recipe, Settings};
use crate::{BakeError, effects};

/// Effects stay when they lower the validation error of plain blending by at least this share.
const EFFECTS_GAIN: f64 = 0.03;
/// Shares of the time budget: effects, composition, composition without effects.
const BUDGET_SHARES: [f64; 3] = [0.25, 0.45, 0.30];

/// Paper: 64 epochs for each network.
const PAPER_EPOCHS: u64 = 64;
/// Share of a time budget that the paper's EffectsNet gets: its step costs about half of a CompositionNet step.
const PAPER_EFFECTS_SHARE: f64 = 0.3;

const COMPOSITION: &str = "composition";
const COMPOSITION_NO_EFFECTS: &str = "composition_no_effects";
const PAPER_EFFECTS: &str = "paper_effects";
const PAPER_COMPOSITION: &str = "paper_composition";

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
    let started_at = chrono::Utc::now();
    let reporter = Reporter::new(events);
    ign_nets::device::limit_threads(job.threads);
    let device = ign_nets::select_device();

    reporter.stage("import", "reading the capture");
    let options = ImportOptions {
        proxy: job.recipe.proxy.as_ref().map(PathBuf::from),
    };
    let scene = ign_capture::import(&job.capture_dir, &options)?;
    let settings = job.recipe.resolve(scene.train.len())?;
    reporter.step(0.2, "comparing the photographs at common surface points");
    let survey = Survey::new(&scene);
    let estimated = Gains::estimate(&scene, &survey);
    let preflight = Preflight::of(
        &job.capture_dir,
        &scene,
        &survey,
        &estimated,
        job.recipe.size,
    );
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
    let mut data = Dataset::new(&scene, &gains, &job.recipe, &settings, device)?;
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

    reporter.stage("plan", "choosing reference views");
    // On the proxy as given: what a view covers must not hang on how coarse a proxy suffices.
    let chosen = data.choose_references(settings.references);
    reporter.step(0.2, "fitting the proxy to the views");
    data.settle_proxy(settings.simplify);
    reporter.info(data.proxy_words.clone());
    let data = data;
    let images = data.reference_images(&chosen)?;
    reporter.step(0.4, "loading validation and held-out views");
    let load = |views: &[usize]| {
        views
            .par_iter()
            .map(|&view| data.scored(view))
            .collect::<Result<Vec<Scored>, BakeError>>()
    };
    let validation = load(&data.validation)?;
    let held_out = load(&data.held_out)?;

    let references = References::new(&data.proxy, &images, data.settings.recipe, device);
    let model = Model::new(references, data.settings.clone(), None, None);
    let bake = Bake {
        job,
        settings: &settings,
        data: &data,
        images: &images,
        validation: &validation,
        held_out: &held_out,
    };
    let mut trained = match settings.preset {
        Preset::Standard => bake.standard(&mut session, model)?,
        Preset::Paper => bake.paper(&mut session, model)?,
    };

    note_capture(&mut trained.plan, &preflight, &gains);

    reporter.stage("evaluate", "scoring held-out views");
    let names = data
        .held_out
        .iter()
        .map(|&view| scene.views[view].name.clone());
    let views: Vec<(String, &Scored)> = names.zip(&held_out).collect();
    let mut rows: Vec<Row> = Vec::new();
    let refs = &trained.model.references;
    rows.push(score("n_ibr", 0.0, &views, |target| {
        naive_ibr(refs, target, &trained.model.chosen(target))
    }));
    reporter.step(0.2, "scored n_ibr");
    rows.push(score("ibr", 0.0, &views, |target| {
        debevec_ibr(refs, &data.mesh, target)
    }));
    reporter.step(0.5, "scored ibr");
    rows.push(score("ours", trained.secs, &views, |target| {
        trained.model.image(target)
    }));
    for other in &trained.others {
        rows.push(score(other.method, other.secs, &views, |target| {
            other.model.image(target)
        }));
    }
    let bundle = pack(Finished {
        job,
        settings: &settings,
        data: &data,
        model: &trained.model,
        images: &images,
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
                references: images.len() as u32,
            },
            methods: Vec::new(),
            speed_error: session.curve().to_vec(),
            plan: trained.plan,
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
    if let Some(list) = plan["words"].as_array_mut() {
        list.push(words.into());
    }
    plan["gains"] = json!({ "applied": gains.needed, "explained": gains.explained });
    plan["preflight"] = json!(preflight);
}

/// What training leaves for evaluation.
struct Trained {
    model: Model,
    /// Training seconds that `ours` needed.
    secs: f64,
    others: Vec<Other>,
    plan: serde_json::Value,
}

/// A method trained beside ours for comparison.
struct Other {
    method: &'static str,
    secs: f64,
    model: Model,
}

struct Bake<'a> {
    job: &'a BakeJob,
    settings: &'a Settings,
    data: &'a Dataset<'a>,
    images: &'a [ReferenceImage],
    validation: &'a [Scored],
    held_out: &'a [Scored],
}

impl Bake<'_> {
    fn budget(&self, stage: usize) -> Option<f64> {
        self.job
            .recipe
            .budget_secs
            .map(|secs| secs * BUDGET_SHARES[stage])
    }

    /// A model without networks.
    fn plain(&self, recipe: ign_render::Recipe) -> Model {
        let references = References::new(&self.data.proxy, self.images, recipe, self.data.device);
        Model::new(
            references,
            RenderSettings {
                recipe,
                ..self.data.settings.clone()
            },
            None,
            None,
        )
    }

    /// Preset `standard`: effects when they pay, then the blending head.
    fn standard(&self, session: &mut Session<'_>, plain: Model) -> Result<Trained, BakeError> {
        let (data, settings, reporter) = (self.data, self.settings, session.reporter);
        let prior_error = |model: &Model| {
            composition::prior_errors(&composition::watch(model, self.validation, false)).0
        };
        let plain_mse = session.measured("plain_mse", || prior_error(&plain));
        reporter.error(plain_mse);
        reporter.info(format!(
            "plain blending of {} references: validation error {plain_mse:.2}",
            settings.k
        ));

        let mut with_effects = None;
        let mut effects_mse = None;
        if settings.effects != EffectsChoice::Off {
            reporter.stage("effects", "training EffectsNet");
            if session.finished(effects::STAGE).is_none() {
                let schedule = Schedule {
                    steps: settings.effects_steps,
                    budget_secs: self.budget(0),
                };
                effects::train_points(
                    data,
                    session,
                    schedule,
                    (self.job.recipe.seed, settings.effects_batch),
                )?;
            }
            let model = self
                .plain(data.settings.recipe)
                .with_effects(effects::restore(data, session, effects::STAGE, false)?);
            let mse = session.measured("effects_mse", || prior_error(&model));
            reporter.info(format!(
                "plain blending with effects removed and re-inserted: validation error {mse:.2}"
            ));
            effects_mse = Some(mse);
            with_effects = Some(model);
        }
        let gain = effects_mse.map(|mse| 1.0 - mse / plain_mse.max(1e-9));
        let keep = match settings.effects {
            EffectsChoice::On => true,
            EffectsChoice::Off => false,
            EffectsChoice::Auto => gain.is_some_and(|gain| gain >= EFFECTS_GAIN),
        };
        let words = match effects_mse {
            Some(mse) if keep => format!(
                "Colours change with the viewpoint: removing and re-inserting learned effects takes the error of plain \
                 blending from {plain_mse:.1} to {mse:.1} on validation views, so EffectsNet is part of the bundle."
            ),
            Some(mse) => format!(
                "Colours hardly change with the viewpoint: plain blending has an error of {plain_mse:.1} on validation \
                 views, with learned effects {mse:.1}; the bundle has no EffectsNet."
            ),
            None => "EffectsNet was switched off by the recipe.".to_owned(),
        };
        reporter.info(words.clone());

        let both = keep && settings.ablate_effects;
        let mut extra = Vec::new();
        extra.extend(both.then_some(("ablation", 30.0)));
        extra.extend(settings.compare_paper.then_some(("comparison", 60.0)));
        reporter.expect(&extra);
        reporter.stage("composition", "training CompositionNet");
        let whole = self
            .budget(1)
            .zip(self.budget(2))
            .map(|(ours, other)| ours + other);
        let mut others = Vec::new();
        let (model, secs) = match with_effects.filter(|_| keep) {
            Some(model) => {
                let effects_secs = session.secs(effects::STAGE);
                let budget = if both { self.budget(1) } else { whole };
                let model =
                    self.blend(session, model, COMPOSITION, "ours", budget, effects_secs)?;
                let secs = effects_secs + session.secs(COMPOSITION);
                if both {
                    reporter.stage("ablation", "training CompositionNet without effects");
                    let plain = self.blend(
                        session,
                        plain,
                        COMPOSITION_NO_EFFECTS,
                        "ours_no_effects",
                        self.budget(2),
                        0.0,
                    )?;
                    others.push(Other {
                        method: "ours_no_effects",
                        secs: session.secs(COMPOSITION_NO_EFFECTS),
                        model: plain,
                    });
                }
                (model, secs)
            }
            None => (
                self.blend(session, plain, COMPOSITION, "ours", whole, 0.0)?,
                session.secs(COMPOSITION),
            ),
        };
        if settings.compare_paper {
            reporter.stage("comparison", "training the paper's networks for as long");
            let model = self.train_paper(session, Some(secs), "paper")?;
            others.push(Other {
                method: "paper",
                secs: paper_secs(session),
                model,
            });
        }
        let plan = json!({
            "preset": "standard",
            "references": self.images.len(),
            "k": settings.k,
            "effects_kept": keep,
            "effects_gain": gain,
            "effects_least_gain": EFFECTS_GAIN,
            "measured": session.measurements(),
            "words": [
                data.proxy_words,
                format!("{} reference views were chosen by coverage; each target view blends {} of them.", self.images.len(), settings.k),
                words,
            ],
        });
        Ok(Trained {
            model,
            secs,
            others,
            plan,
        })
    }

    /// Trains a blending head for the model's effects, unless a checkpoint already has it.
    fn blend(
        &self,
        session: &mut Session<'_>,
        mut model: Model,
        stage: &'static str,
        method: &'static str,
        budget_secs: Option<f64>,
        secs_before: f64,
    ) -> Result<Model, BakeError> {
        if session.finished(stage).is_none() {
            let plan = Plan {
                stage,
                method,
                schedule: Schedule {
                    steps: self.settings.composition_steps,
                    budget_secs,
                },
                seed: self.job.recipe.seed,
                batch: self.settings.batch,
                patch: self.settings.patch.min(i64::from(self.job.recipe.size)),
                secs_before,
            };
            let validation = composition::watch(&model, self.validation, false);
            let held_out = composition::watch(&model, self.held_out, false);
            composition::train_blend(self.data, session, &model, &plan, &validation, &held_out)?;
        }
        model.composition = composition::restore(self.data, session, stage, false)?;
        Ok(model)
    }

    /// Preset `paper`.
    fn paper(&self, session: &mut Session<'_>, plain: Model) -> Result<Trained, BakeError> {
        drop(plain);
        session
            .reporter
            .stage("composition", "training the paper's networks");
        let model = self.train_paper(session, self.job.recipe.budget_secs, "ours")?;
        let plan = json!({
            "preset": "paper",
            "references": self.images.len(),
            "k": self.settings.k,
            "words": [
                self.data.proxy_words,
                "The paper's networks, losses and schedule as published; nothing was measured or left out.",
            ],
        });
        Ok(Trained {
            model,
            secs: paper_secs(session),
            others: Vec::new(),
            plan,
        })
    }

    fn train_paper(
        &self,
        session: &mut Session<'_>,
        budget: Option<f64>,
        method: &'static str,
    ) -> Result<Model, BakeError> {
        let data = self.data;
        let epochs = PAPER_EPOCHS * data.train.len() as u64;
        let (effects_steps, composition_steps) = match self.settings.preset {
            Preset::Paper => (self.settings.effects_steps, self.settings.composition_steps),
            Preset::Standard => (epochs, epochs),
        };
        session.reporter.part(0.0, PAPER_EFFECTS_SHARE);
        if session.finished(PAPER_EFFECTS).is_none() {
            let schedule = Schedule {
                steps: effects_steps,
                budget_secs: budget.map(|secs| secs * PAPER_EFFECTS_SHARE),
            };
            effects::train_paper(data, session, PAPER_EFFECTS, schedule, self.job.recipe.seed)?;
        }
        let plain = self.plain(ign_render::Recipe::Paper);
        let mut model = plain.with_effects(effects::restore(data, session, PAPER_EFFECTS, true)?);
        session.reporter.part(PAPER_EFFECTS_SHARE, 1.0);
        if session.finished(PAPER_COMPOSITION).is_none() {
            let plan = Plan {
                stage: PAPER_COMPOSITION,
                method,
                schedule: Schedule {
                    steps: composition_steps,
                    budget_secs: budget.map(|secs| secs * (1.0 - PAPER_EFFECTS_SHARE)),
                },
                seed: self.job.recipe.seed,
                batch: 1,
                patch: i64::from(self.job.recipe.size),
                secs_before: session.secs(PAPER_EFFECTS),
            };
            let validation = composition::watch(&model, self.validation, true);
            let held_out = composition::watch(&model, self.held_out, true);
            composition::train_paper(data, session, &model, &plan, &validation, &held_out)?;
        }
        model.composition = composition::restore(data, session, PAPER_COMPOSITION, true)?;
        Ok(model)
    }
}

fn paper_secs(session: &Session<'_>) -> f64 {
    session.secs(PAPER_EFFECTS) + session.secs(PAPER_COMPOSITION)
}
