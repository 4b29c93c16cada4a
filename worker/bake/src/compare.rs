//! The methods that are scored beside ours, on the same views, coverage and compositing.
//!
//! Methods that train get as long as ours did, beyond the recipe's time budget.

use ign_nets::composition::PaperComposition;
use ign_render::{
    ColorGrid, Model, RenderSettings, SurfaceColors, Target, Translation, TranslationInput,
    debevec_ibr, naive_ibr,
};
use tch::Tensor;

use crate::BakeError;
use crate::checkpoint::Session;
use crate::composition::{self, GeneratorInput, Plan};
use crate::evaluate::{Row, score};
use crate::recipe::{EffectsChoice, Method, Preset, Recipe};
use crate::schedule::{Rate, Schedule};
use crate::training::{Drawn, OURS_NO_EFFECTS, PAPER, Trained, Trainer};

/// A method that trained, ready to be scored.
enum Rival {
    /// Our renderer with other networks; with the views they see where these are not ours.
    Model(Box<Trained>, Option<Drawn>),
    Translation(Translation, f64),
    /// The very model that is `ours`.
    Ours,
}

/// The methods of the recipe that train.
pub(crate) struct Rivals(Vec<(Method, Rival)>);

impl Rivals {
    /// Trains what the recipe wants beside `ours`; `chosen` are the reference views.
    pub(crate) fn train(
        trainer: &Trainer<'_>,
        session: &mut Session<'_>,
        ours: &Trained,
        chosen: &[usize],
    ) -> Result<Self, BakeError> {
        let wanted: Vec<Method> = trainer
            .settings
            .methods
            .iter()
            .copied()
            .filter(|method| !Method::CHEAP.contains(method))
            .collect();
        let mut rivals = Vec::new();
        for (at, &method) in wanted.iter().enumerate() {
            let stage = format!("training {} for comparison", method.name());
            if at == 0 {
                session.reporter.stage("comparison", &stage);
            }
            let (from, to) = (at as f64, at as f64 + 1.0);
            let count = wanted.len() as f64;
            session.reporter.span(from / count, to / count);
            rivals.push((method, rival(trainer, session, ours, chosen, method)?));
        }
        Ok(Self(rivals))
    }
}

fn rival(
    trainer: &Trainer<'_>,
    session: &mut Session<'_>,
    ours: &Trained,
    chosen: &[usize],
    method: Method,
) -> Result<Rival, BakeError> {
    let paper = Recipe {
        preset: Preset::Paper,
        ..Recipe::default()
    }
    .resolve(trainer.data.train.len())?;
    let beside_paper = trainer.settings.preset == Preset::Paper;
    // The paper's networks have the paper's schedule, unless ours took less.
    let budget_secs = if beside_paper {
        trainer.budget_secs
    } else {
        Some(ours.secs)
    };
    let translation = |session: &mut Session<'_>, stage: &'static str, input| {
        let steps = if beside_paper {
            trainer.settings.composition_steps
        } else {
            paper.composition_steps
        };
        let plan = Plan {
            stage,
            method: method.name(),
            schedule: Schedule {
                steps,
                budget_secs,
                rate: Rate::Constant,
            },
            seed: trainer.seed,
            secs_before: 0.0,
        };
        translation(trainer, session, &plan, input)
    };
    Ok(match method {
        Method::OursNoEffects if ours.model.effects().is_none() => Rival::Ours,
        Method::OursNoEffects => {
            let mut settings = trainer.settings.clone();
            settings.effects = EffectsChoice::Off;
            let by_the_clock = trainer.budget_secs.is_some() || settings.preset == Preset::Auto;
            if settings.preset == Preset::Auto {
                // As long as ours, whether that pays without effects or not.
                settings.preset = Preset::Standard;
            }
            let without = Trainer {
                settings: &settings,
                budget_secs: by_the_clock.then_some(ours.secs),
                ..*trainer
            };
            Rival::Model(Box::new(without.train(session, OURS_NO_EFFECTS)?), None)
        }
        Method::Paper => {
            let settings = RenderSettings {
                supersample: paper.supersample,
                recipe: paper.drawing,
                ..trainer.drawn.settings.clone()
            };
            let drawn = Drawn::new(trainer.data, chosen, settings, 1)?;
            let published = Trainer {
                settings: &paper,
                drawn: &drawn,
                budget_secs,
                ..*trainer
            };
            let trained = published.train(session, PAPER)?;
            Rival::Model(Box::new(trained), Some(drawn))
        }
        Method::Pix2pixPosition => {
            translation(session, "pix2pix_position", TranslationInput::Position)?
        }
        Method::Pix2pixDepth => translation(session, "pix2pix_depth", TranslationInput::Depth)?,
        Method::VertexColor | Method::Texture | Method::NaiveIbr | Method::Ibr => {
            unreachable!("{} does not train", method.name())
        }
    })
}

/// Trains an image-to-image translator, unless a checkpoint already has it.
fn translation(
    trainer: &Trainer<'_>,
    session: &mut Session<'_>,
    plan: &Plan,
    input: TranslationInput,
) -> Result<Rival, BakeError> {
    let (data, channels) = (trainer.data, input.channels());
    if !session.finished(plan.stage) {
        let seen = GeneratorInput {
            channels,
            of: &|target| input.of(target),
            settings: &trainer.drawn.settings,
            adversarial: true,
        };
        composition::train_generator(data, session, &seen, plan, trainer.drawn.views())?;
    }
    let (net, params) = session.restore(plan.stage, data.device, |b| {
        PaperComposition::new(b, channels)
    })?;
    let translation = Translation { input, net, params };
    Ok(Rival::Translation(translation, session.secs(plan.stage)))
}

/// Scores ours and everything beside it on the held-out views, whose names are given.
pub(crate) fn rows(
    trainer: &Trainer<'_>,
    session: &Session<'_>,
    ours: &Trained,
    rivals: &Rivals,
    names: &[String],
) -> Vec<Row> {
    let model = &ours.model;
    let (references, mesh) = (&model.references, &trainer.data.mesh);
    let held_out = &trainer.drawn.held_out;
    let plain =
        |name: &str, render: &dyn Fn(&Target) -> Tensor| score(name, 0.0, names, held_out, render);
    let methods = &trainer.settings.methods;
    let mut rows = Vec::new();
    for (at, &method) in methods.iter().enumerate() {
        let name = method.name();
        let static_colors = |grid| {
            let colors = SurfaceColors::new(mesh, references, grid);
            plain(name, &|target| colors.image(mesh, target))
        };
        let row = match method {
            Method::VertexColor => static_colors(ColorGrid::Vertices),
            Method::Texture => static_colors(ColorGrid::Texels),
            Method::NaiveIbr => plain(name, &|target| {
                naive_ibr(references, target, &model.chosen(target))
            }),
            Method::Ibr => plain(name, &|target| debevec_ibr(references, mesh, target)),
            _ => continue,
        };
        rows.push(row);
        let done = (at + 1) as f64 / (methods.len() + 1) as f64;
        session.reporter.step(done, &format!("scored {name}"));
    }
    let with = |name: &str, model: &Model, secs, views| {
        score(name, secs, names, views, |target| model.image(target))
    };
    let scored = with("ours", model, ours.secs, held_out);
    rows.push(scored.clone());
    for (method, rival) in &rivals.0 {
        let name = method.name();
        rows.push(match rival {
            Rival::Ours => {
                let mut same = scored.clone();
                name.clone_into(&mut same.metrics.name);
                same
            }
            Rival::Model(trained, drawn) => {
                let views = drawn.as_ref().map_or(held_out, |drawn| &drawn.held_out);
                with(name, &trained.model, trained.secs, views)
            }
            Rival::Translation(translation, secs) => {
                score(name, *secs, names, held_out, |target| {
                    translation.image(target)
                })
            }
        });
    }
    rows
}
