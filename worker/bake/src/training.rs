//! What is trained for `ours`, by preset.

use ign_bundle::metrics::SpeedError;
use ign_nets::composition::{BlendComposition, PaperComposition};
use ign_nets::effects::{PaperEffects, PointEffects};
use ign_render::{Composition, Effects, Model, ReferenceImage, References, RenderSettings};
use rayon::prelude::*;
use serde_json::json;

use crate::checkpoint::{Schedule, Session};
use crate::composition::{self, GeneratorInput, Plan, Views};
use crate::data::{Dataset, Scored};
use crate::recipe::{EffectsChoice, Preset, Recipe, Settings};
use crate::{BakeError, effects};

/// Effects stay when they lower the validation error of plain blending by at least this share.
const EFFECTS_GAIN: f64 = 0.03;
/// Share of a time budget that effects get.
const EFFECTS_SHARE: f64 = 0.25;
/// Paper: 64 epochs for each network.
const PAPER_EPOCHS: u64 = 64;
/// Share of a time budget that the paper's `EffectsNet` gets: its step costs about half of a `CompositionNet` step.
const PAPER_EFFECTS_SHARE: f64 = 0.3;

const COMPOSITION: &str = "composition";
const COMPOSITION_NO_EFFECTS: &str = "composition_no_effects";
const PAPER_EFFECTS: &str = "paper_effects";
const PAPER_COMPOSITION: &str = "paper_composition";

/// Networks and what they took.
pub(crate) struct Trained {
    pub(crate) model: Model,
    /// Training seconds.
    pub(crate) secs: f64,
}

/// The capture's views as one recipe's networks see them.
pub(crate) struct Drawn {
    pub(crate) settings: RenderSettings,
    /// The reference views.
    pub(crate) images: Vec<ReferenceImage>,
    pub(crate) validation: Vec<Scored>,
    pub(crate) held_out: Vec<Scored>,
}

impl Drawn {
    /// Loads the `chosen` references, `scale` times the working resolution, and the views that are rendered.
    pub(crate) fn new(
        data: &Dataset<'_>,
        chosen: &[usize],
        settings: RenderSettings,
        scale: u32,
    ) -> Result<Self, BakeError> {
        let load = |views: &[usize]| {
            views
                .par_iter()
                .map(|&view| data.scored(view, &settings))
                .collect::<Result<Vec<Scored>, BakeError>>()
        };
        Ok(Self {
            images: data.reference_images(chosen, scale)?,
            validation: load(&data.validation)?,
            held_out: load(&data.held_out)?,
            settings,
        })
    }

    /// A model without networks.
    pub(crate) fn plain(&self, data: &Dataset<'_>) -> Model {
        let references =
            References::new(&data.proxy, &self.images, self.settings.recipe, data.device);
        Model::new(references, self.settings.clone(), None, None)
    }

    pub(crate) fn views(&self) -> Views<'_> {
        Views {
            validation: &self.validation,
            held_out: &self.held_out,
        }
    }
}

/// Everything that training needs.
pub(crate) struct Trainer<'a> {
    pub(crate) recipe: &'a Recipe,
    pub(crate) settings: &'a Settings,
    pub(crate) data: &'a Dataset<'a>,
    /// As the recipe's preset has it.
    pub(crate) drawn: &'a Drawn,
}

impl Trainer<'_> {
    /// The paper's 64 epochs.
    pub(crate) fn epochs(&self) -> u64 {
        PAPER_EPOCHS * self.data.train.len() as u64
    }

    /// Trains `ours`; the plan says what was tried, measured, kept and why.
    pub(crate) fn ours(
        &self,
        session: &mut Session<'_>,
    ) -> Result<(Trained, serde_json::Value), BakeError> {
        match self.settings.preset {
            Preset::Standard => self.standard(session),
            Preset::Paper => {
                session
                    .reporter
                    .stage("composition", "training the paper's networks");
                let steps = (self.settings.effects_steps, self.settings.composition_steps);
                let budget = self.recipe.budget_secs;
                let trained = self.paper(session, self.drawn, steps, budget, "ours")?;
                let plan = json!({
                    "preset": "paper",
                    "references": self.drawn.images.len(),
                    "k": self.settings.k,
                    "words": [
                        self.data.proxy_words,
                        "The paper's networks, losses and schedule as published; nothing was measured or left out.",
                    ],
                });
                Ok((trained, plan))
            }
        }
    }

    /// Preset `standard`: effects when they pay, then the blending head.
    fn standard(
        &self,
        session: &mut Session<'_>,
    ) -> Result<(Trained, serde_json::Value), BakeError> {
        let (data, settings, reporter) = (self.data, self.settings, session.reporter);
        let plain = self.drawn.plain(data);
        let prior_error = |model: &Model| {
            composition::prior_errors(model, &self.drawn.validation).map_or(0.0, |(full, _)| full)
        };
        let plain_mse = session.measured("plain_mse", || prior_error(&plain));
        reporter.error(plain_mse);
        reporter.info(format!(
            "plain blending of {} references: validation error {plain_mse:.2}",
            settings.k
        ));
        if session.curve().is_empty()
            && let Some((mse, mse_object)) = composition::prior_errors(&plain, &self.drawn.held_out)
        {
            session.curve_point(SpeedError {
                method: "ours".into(),
                secs: 0.0,
                mse,
                mse_object,
            });
        }

        let mut with_effects = None;
        let mut effects_mse = None;
        if settings.effects != EffectsChoice::Off {
            reporter.stage("effects", "training EffectsNet");
            if !session.finished(effects::STAGE) {
                let schedule = Schedule {
                    steps: settings.effects_steps,
                    budget_secs: self.recipe.budget_secs.map(|secs| secs * EFFECTS_SHARE),
                };
                effects::train_points(
                    data,
                    session,
                    schedule,
                    (self.recipe.seed, settings.effects_batch),
                )?;
            }
            let (net, params) = session.restore(effects::STAGE, data.device, PointEffects::new)?;
            let effects = Effects::Points(net, params);
            let model = self.drawn.plain(data).with_effects(Some(effects));
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

        reporter.stage("composition", "training CompositionNet");
        let effects_secs = session.secs(effects::STAGE);
        let budget = self.recipe.budget_secs;
        let budget = budget.map(|secs| (secs - effects_secs).max(secs * (1.0 - EFFECTS_SHARE)));
        let model = with_effects.filter(|_| keep).unwrap_or(plain);
        let model = self.blend(session, model, COMPOSITION, "ours", budget, effects_secs)?;
        let secs = effects_secs + session.secs(COMPOSITION);
        let plan = json!({
            "preset": "standard",
            "references": self.drawn.images.len(),
            "k": settings.k,
            "effects_kept": keep,
            "effects_gain": gain,
            "effects_least_gain": EFFECTS_GAIN,
            "measured": session.measurements(),
            "words": [
                data.proxy_words,
                format!("{} reference views were chosen by coverage; each target view blends {} of them.", self.drawn.images.len(), settings.k),
                words,
            ],
        });
        Ok((Trained { model, secs }, plan))
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
        if !session.finished(stage) {
            let plan = Plan {
                stage,
                method,
                schedule: Schedule {
                    steps: self.settings.composition_steps,
                    budget_secs,
                },
                seed: self.recipe.seed,
                secs_before,
            };
            let patch = self.settings.patch.min(i64::from(self.recipe.size));
            let windows = (self.settings.batch, patch);
            composition::train_blend(
                self.data,
                session,
                &model,
                &plan,
                windows,
                self.drawn.views(),
            )?;
        }
        let k = self.settings.k;
        let (net, params) =
            session.restore(stage, self.data.device, |b| BlendComposition::new(b, k))?;
        model.composition = Some(Composition::Blend(net, params));
        Ok(model)
    }

    /// `ours` as it is without `EffectsNet`, within `budget_secs`.
    pub(crate) fn without_effects(
        &self,
        session: &mut Session<'_>,
        budget_secs: Option<f64>,
    ) -> Result<Trained, BakeError> {
        let (stage, method) = (COMPOSITION_NO_EFFECTS, "ours_no_effects");
        let plain = self.drawn.plain(self.data);
        let model = match self.settings.preset {
            Preset::Standard => self.blend(session, plain, stage, method, budget_secs, 0.0)?,
            Preset::Paper => {
                let plan = Plan {
                    stage,
                    method,
                    schedule: Schedule {
                        steps: self.settings.composition_steps,
                        budget_secs,
                    },
                    seed: self.recipe.seed,
                    secs_before: 0.0,
                };
                self.paper_composition(session, self.drawn, plain, &plan)?
            }
        };
        Ok(Trained {
            model,
            secs: session.secs(stage),
        })
    }

    /// The paper's networks on views that are drawn the paper's way: (effects, composition) steps, within `budget`.
    pub(crate) fn paper(
        &self,
        session: &mut Session<'_>,
        drawn: &Drawn,
        (effects_steps, composition_steps): (u64, u64),
        budget: Option<f64>,
        method: &'static str,
    ) -> Result<Trained, BakeError> {
        let data = self.data;
        session.reporter.part(0.0, PAPER_EFFECTS_SHARE);
        if !session.finished(PAPER_EFFECTS) {
            let schedule = Schedule {
                steps: effects_steps,
                budget_secs: budget.map(|secs| secs * PAPER_EFFECTS_SHARE),
            };
            let (settings, seed) = (&drawn.settings, self.recipe.seed);
            effects::train_paper(data, session, PAPER_EFFECTS, settings, schedule, seed)?;
        }
        let (net, params) = session.restore(PAPER_EFFECTS, data.device, PaperEffects::new)?;
        let model = drawn
            .plain(data)
            .with_effects(Some(Effects::Paper(net, params)));
        session.reporter.part(PAPER_EFFECTS_SHARE, 1.0);
        let effects_secs = session.secs(PAPER_EFFECTS);
        let plan = Plan {
            stage: PAPER_COMPOSITION,
            method,
            schedule: Schedule {
                steps: composition_steps,
                budget_secs: budget.map(|secs| secs * (1.0 - PAPER_EFFECTS_SHARE)),
            },
            seed: self.recipe.seed,
            secs_before: effects_secs,
        };
        let model = self.paper_composition(session, drawn, model, &plan)?;
        Ok(Trained {
            model,
            secs: effects_secs + session.secs(PAPER_COMPOSITION),
        })
    }

    /// The paper's `CompositionNet` for the model's effects, unless a checkpoint already has it.
    fn paper_composition(
        &self,
        session: &mut Session<'_>,
        drawn: &Drawn,
        mut model: Model,
        plan: &Plan,
    ) -> Result<Model, BakeError> {
        let channels = PaperComposition::input_channels(drawn.settings.k);
        if !session.finished(plan.stage) {
            let input = GeneratorInput {
                channels,
                of: &|target| model.paper_input(target),
                settings: &drawn.settings,
            };
            composition::train_generator(self.data, session, &input, plan, drawn.views())?;
        }
        let (net, params) = session.restore(plan.stage, self.data.device, |b| {
            PaperComposition::new(b, channels)
        })?;
        model.composition = Some(Composition::Paper(net, params));
        Ok(model)
    }
}
