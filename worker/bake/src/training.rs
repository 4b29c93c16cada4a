//! Training of both networks as the settings say; presets are nothing but settings.
//!
//! Two forms of each network: `EffectsNet` per surface point or as the paper's U-Net, `CompositionNet` with the blending
//! head or as the paper's painter. `EffectsNet` is kept where it lowers the error of plain blending on validation views;
//! with preset `auto`, `CompositionNet` too, and both train for as long as they lower that error by enough.

use std::cell::RefCell;

use ign_bundle::metrics::SpeedError;
use ign_nets::composition::{BlendComposition, PaperComposition};
use ign_nets::effects::{PaperEffects, PointEffects};
use ign_render::{Composition, Effects, Model, ReferenceImage, References, RenderSettings};
use rayon::prelude::*;
use serde_json::json;

use crate::checkpoint::Session;
use crate::composition::{self, GeneratorInput, Plan, Views};
use crate::data::{Dataset, Scored};
use crate::pretrain;
use crate::recipe::{EffectsChoice, EffectsNet, Head, Preset, Settings};
use crate::schedule::Schedule;
use crate::{BakeError, effects};

/// Effects stay when they lower the validation error of plain blending by at least this share.
const EFFECTS_GAIN: f64 = 0.03;
/// With preset `auto`, `CompositionNet` stays when it lowers the validation error by at least this share.
const COMPOSITION_GAIN: f64 = 0.03;
/// Share of a time budget that effects get: per surface point, and of the paper's network, whose step costs about half of
/// its `CompositionNet`'s.
const EFFECTS_SHARE: f64 = 0.25;
const PAPER_EFFECTS_SHARE: f64 = 0.3;

/// Steps from which on learning rates fall.
const EFFECTS_KNEE: f64 = 500.0;
pub(crate) const COMPOSITION_KNEE: f64 = 50.0;
/// Least steps of a training that lasts while it pays. What `CompositionNet` has learned on other objects is improved on
/// slowly at first.
const EFFECTS_LEAST: u64 = 250;
const COMPOSITION_LEAST: u64 = 500;

/// What one training is called: its row of metrics.json, and its stages in checkpoints.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Names {
    pub(crate) method: &'static str,
    pub(crate) effects: &'static str,
    pub(crate) composition: &'static str,
}

pub(crate) const OURS: Names = Names {
    method: "ours",
    effects: "effects",
    composition: "composition",
};
pub(crate) const OURS_NO_EFFECTS: Names = Names {
    method: "ours_no_effects",
    effects: "effects_no_effects",
    composition: "composition_no_effects",
};
pub(crate) const PAPER: Names = Names {
    method: "paper",
    effects: "paper_effects",
    composition: "paper_composition",
};

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
    pub(crate) settings: &'a Settings,
    pub(crate) data: &'a Dataset<'a>,
    /// As the settings have it.
    pub(crate) drawn: &'a Drawn,
    pub(crate) seed: u64,
    /// Seconds of training at most, both networks together.
    pub(crate) budget_secs: Option<f64>,
}

/// One network: whether it is in the bundle, and why.
struct Decision {
    kept: bool,
    gain: Option<f64>,
    words: String,
}

impl Trainer<'_> {
    /// Trains `ours`; the plan says what was tried, measured, kept and why.
    pub(crate) fn ours(
        &self,
        session: &mut Session<'_>,
    ) -> Result<(Trained, serde_json::Value), BakeError> {
        let (trained, effects, composition) = self.both(session, OURS)?;
        let (settings, references) = (self.settings, self.drawn.images.len());
        let plan = json!({
            "preset": settings.preset,
            "references": references,
            "k": self.drawn.settings.k,
            "effects_kept": effects.kept,
            "effects_gain": effects.gain,
            "effects_least_gain": EFFECTS_GAIN,
            "effects_steps": session.steps(OURS.effects),
            "composition_kept": composition.kept,
            "composition_gain": composition.gain,
            "composition_steps": session.steps(OURS.composition),
            "measured": session.measurements(),
            "words": [
                self.data.proxy_words,
                format!(
                    "{references} reference views were chosen by coverage; each target view blends {} of them.",
                    self.drawn.settings.k
                ),
                effects.words,
                composition.words,
            ],
        });
        Ok((trained, plan))
    }

    /// Trains both networks, each unless a checkpoint already has it.
    pub(crate) fn train(
        &self,
        session: &mut Session<'_>,
        names: Names,
    ) -> Result<Trained, BakeError> {
        let (trained, ..) = self.both(session, names)?;
        Ok(trained)
    }

    fn both(
        &self,
        session: &mut Session<'_>,
        names: Names,
    ) -> Result<(Trained, Decision, Decision), BakeError> {
        let share = match self.settings.effects_net {
            EffectsNet::Points => EFFECTS_SHARE,
            EffectsNet::UNet => PAPER_EFFECTS_SHARE,
        };
        let plain = self.drawn.plain(self.data);
        if self.settings.effects != EffectsChoice::Off {
            begin(session, names, "effects", (0.0, share));
        }
        let (model, effects) = self.with_effects(session, plain, names, share)?;
        begin(session, names, "composition", (share, 1.0));
        let (model, composition) = self.with_composition(session, model, names, share)?;
        let secs = session.secs(names.effects) + session.secs(names.composition);
        Ok((Trained { model, secs }, effects, composition))
    }

    /// A model with effects where they pay, and no more.
    pub(crate) fn effects_model(
        &self,
        session: &mut Session<'_>,
        names: Names,
    ) -> Result<Model, BakeError> {
        let plain = self.drawn.plain(self.data);
        let (model, _) = self.with_effects(session, plain, names, 1.0)?;
        Ok(model)
    }

    /// Error of plain blending with the model's effects on the validation views; measured once.
    fn blending_error(&self, session: &mut Session<'_>, name: &str, model: &Model) -> f64 {
        session.measured(name, || {
            composition::prior_errors(model, &self.drawn.validation).map_or(0.0, |(full, _)| full)
        })
    }

    /// Adds effects where they pay.
    fn with_effects(
        &self,
        session: &mut Session<'_>,
        plain: Model,
        names: Names,
        share: f64,
    ) -> Result<(Model, Decision), BakeError> {
        let (data, settings) = (self.data, self.settings);
        let plain_mse = self.blending_error(session, &measure(names, "plain_mse"), &plain);
        session.reporter.error(plain_mse);
        if settings.head == Head::Blend && !session.has_curve(names.method) {
            let (mse, mse_object) =
                composition::prior_errors(&plain, &self.drawn.held_out).unwrap_or_default();
            session.curve_point(SpeedError {
                method: names.method.into(),
                secs: 0.0,
                mse,
                mse_object,
            });
        }
        if settings.effects == EffectsChoice::Off {
            let decision = Decision {
                kept: false,
                gain: None,
                words: "EffectsNet was switched off by the recipe.".into(),
            };
            return Ok((plain, decision));
        }
        if !session.finished(names.effects) {
            let schedule = Schedule {
                steps: settings.effects_steps,
                budget_secs: self.budget_secs.map(|secs| secs * share),
                rate: settings.rate(EFFECTS_KNEE, EFFECTS_LEAST, None),
            };
            // Made once, where it is asked for at all.
            let watched = RefCell::new(None);
            let plan = effects::Plan {
                stage: names.effects,
                schedule,
                seed: self.seed,
                settings,
                validation: &|effects| {
                    let model = watched.take().unwrap_or_else(|| self.drawn.plain(data));
                    let model = model.with_effects(Some(effects));
                    let errors = composition::prior_errors(&model, &self.drawn.validation);
                    watched.replace(Some(model));
                    errors.map(|(full, _)| full)
                },
            };
            match settings.effects_net {
                EffectsNet::Points => effects::train_points(data, session, &plan)?,
                EffectsNet::UNet => {
                    effects::train_paper(data, session, &plan, &self.drawn.settings)?;
                }
            }
        }
        let effects = match settings.effects_net {
            EffectsNet::Points => {
                let (net, params) =
                    session.restore(names.effects, data.device, PointEffects::new)?;
                Effects::Points(net, params)
            }
            EffectsNet::UNet => {
                let (net, params) =
                    session.restore(names.effects, data.device, PaperEffects::new)?;
                Effects::Paper(net, params)
            }
        };
        let model = self.drawn.plain(data).with_effects(Some(effects));
        let mse = self.blending_error(session, &measure(names, "effects_mse"), &model);
        let gain = 1.0 - mse / plain_mse.max(1e-9);
        let kept = settings.effects == EffectsChoice::On || gain >= EFFECTS_GAIN;
        let words = match settings.effects {
            EffectsChoice::On => format!(
                "EffectsNet is in the bundle because the recipe says so; it takes the error of plain blending on validation \
                 views from {plain_mse:.1} to {mse:.1}."
            ),
            _ if kept => format!(
                "Colours change with the viewpoint: removing and re-inserting learned effects takes the error of plain \
                 blending from {plain_mse:.1} to {mse:.1} on validation views, so EffectsNet is part of the bundle."
            ),
            _ => format!(
                "Colours hardly change with the viewpoint: plain blending has an error of {plain_mse:.1} on validation \
                 views, with learned effects {mse:.1}; the bundle has no EffectsNet."
            ),
        };
        session.reporter.info(words.clone());
        let decision = Decision {
            kept,
            gain: Some(gain),
            words,
        };
        Ok((if kept { model } else { plain }, decision))
    }

    /// Adds the `CompositionNet` for the model's effects; with preset `auto`, where it pays.
    fn with_composition(
        &self,
        session: &mut Session<'_>,
        mut model: Model,
        names: Names,
        share: f64,
    ) -> Result<(Model, Decision), BakeError> {
        let settings = self.settings;
        let prior_mse = self.blending_error(session, &measure(names, "prior_mse"), &model);
        if !settings.compose {
            let decision = Decision {
                kept: false,
                gain: None,
                words: "There is no CompositionNet, for rendering to be as fast as asked.".into(),
            };
            return Ok((model, decision));
        }
        let effects_secs = session.secs(names.effects);
        // Time that the effects did not need, and all of it where there are none; more than its share if they took too much.
        let budget_secs = self
            .budget_secs
            .map(|secs| (secs - effects_secs).max(secs * (1.0 - share)));
        let plan = Plan {
            stage: names.composition,
            method: names.method,
            schedule: Schedule {
                steps: settings.composition_steps,
                budget_secs,
                rate: settings.rate(COMPOSITION_KNEE, COMPOSITION_LEAST, settings.enough_mse()),
            },
            seed: self.seed,
            secs_before: effects_secs,
        };
        model.composition = Some(match settings.head {
            Head::Blend => self.blend(session, &model, &plan)?,
            Head::Paint => self.paint(session, &model, &plan)?,
        });
        let mse = session.measured(&measure(names, "composed_mse"), || {
            composition::rendered_error(&model, &self.drawn.validation).unwrap_or(0.0)
        });
        let gain = 1.0 - mse / prior_mse.max(1e-9);
        let kept = settings.preset != Preset::Auto || gain >= COMPOSITION_GAIN;
        let start = session
            .measurements()
            .get(&pretrain::measure(names.composition))
            .filter(|start| **start < prior_mse)
            .map_or(String::new(), |start| {
                format!(" ({start:.2} with what it had learned on other objects)")
            });
        let taken = format!(
            "CompositionNet takes the error of blending on validation views from {prior_mse:.2}{start} to {mse:.2}"
        );
        let words = if kept {
            format!("{taken}.")
        } else {
            model.composition = None;
            format!("{taken} only: the bundle has none.")
        };
        session.reporter.info(words.clone());
        let decision = Decision {
            kept,
            gain: Some(gain),
            words,
        };
        Ok((model, decision))
    }

    fn blend(
        &self,
        session: &mut Session<'_>,
        model: &Model,
        plan: &Plan,
    ) -> Result<Composition, BakeError> {
        if !session.finished(plan.stage) {
            composition::train_blend(self.data, session, model, plan, self.settings, self.drawn)?;
        }
        let (k, width) = (self.drawn.settings.k, self.settings.width);
        let (net, params) = session.restore(plan.stage, self.data.device, |b| {
            BlendComposition::new(b, k, width)
        })?;
        Ok(Composition::Blend(net, params))
    }

    fn paint(
        &self,
        session: &mut Session<'_>,
        model: &Model,
        plan: &Plan,
    ) -> Result<Composition, BakeError> {
        let channels = PaperComposition::input_channels(self.drawn.settings.k);
        if !session.finished(plan.stage) {
            let input = GeneratorInput {
                channels,
                of: &|target| model.paper_input(target),
                settings: &self.drawn.settings,
                adversarial: self.settings.adversarial,
            };
            composition::train_generator(self.data, session, &input, plan, self.drawn.views())?;
        }
        let (net, params) = session.restore(plan.stage, self.data.device, |b| {
            PaperComposition::new(b, channels)
        })?;
        Ok(Composition::Paper(net, params))
    }
}

/// Begins a stage of the bake for `ours`, a part of the present one for what is compared with it.
fn begin(session: &Session<'_>, names: Names, stage: &'static str, (from, to): (f64, f64)) {
    if names.method == OURS.method {
        let message = format!("training {}Net", capitalised(stage));
        session.reporter.stage(stage, &message);
    } else {
        session.reporter.part(from, to);
    }
}

/// A figure's name: those of `ours` are known by it alone.
fn measure(names: Names, figure: &str) -> String {
    if names.method == OURS.method {
        figure.to_owned()
    } else {
        format!("{}_{figure}", names.method)
    }
}

fn capitalised(word: &str) -> String {
    let mut letters = word.chars();
    letters.next().map_or_else(String::new, |first| {
        first.to_uppercase().chain(letters).collect()
    })
}
