//! Training of `CompositionNet` (Sec. "Image compositing").
//!
//! What a training view shows the network does not change while it trains: warps, effects and coverage are computed
//! once per view and kept in half precision, cut to the object's bounds.
//!
//! Deviation (preset `standard`): random windows instead of whole images, so that a step sees several views and the
//! network cannot rely on framing; l1 plus a squared term, since squared error is what is scored; no discriminator
//! (it is two thirds of a step's cost, and lowers no error that is scored). The preset `paper` has the paper's.

use ign_nets::composition::{BlendComposition, BlendInput, PaperComposition};
use ign_nets::losses;
use ign_nets::optim::{Adam, cosine_rate};
use ign_nets::patchgan::PatchGan;
use ign_nets::{Builder, Params, color};
use ign_render::{Composition, Model};
use rand::RngExt;
use tch::{Kind, Tensor, no_grad};

use crate::BakeError;
use crate::checkpoint::{Schedule, Session, Trainee, load_weights};
use crate::data::{Dataset, Scored, errors_255};
use crate::sampler::step_rng;

/// Peak learning rate of the blending head.
const BLEND_RATE: f64 = 1.5e-3;
const AVERAGE_DECAY: f64 = 0.995;
/// Paper: the adversarial loss counts 0.01, the l1 loss 1.
const ADVERSARIAL: f64 = 0.01;
/// Smallest side of an image that the discriminator takes.
const LEAST_GAN_PX: i64 = 32;

/// A view to measure on during training.
pub(crate) struct Watched<'a> {
    scored: &'a Scored,
    input: Stored,
}

/// A network's input in half precision.
enum Stored {
    Blend(BlendInput),
    Paper(Tensor),
}

fn with_kind(input: &BlendInput, kind: Kind) -> BlendInput {
    BlendInput {
        candidates: input.candidates.to_kind(kind),
        prior: input.prior.to_kind(kind),
        visibility: input.visibility.to_kind(kind),
        target: input.target.to_kind(kind),
    }
}

/// One training view: input, truth and factors, cut to the object's bounds.
struct Example {
    input: BlendInput,
    /// [1, 3, h, w] f16.
    truth: Tensor,
    /// [1, 1, h, w] f16: coverage times scored.
    coverage: Tensor,
    size: (i64, i64),
}

/// Prepares views for measuring with `model`'s present effects.
pub(crate) fn watch<'a>(model: &Model, views: &'a [Scored], paper: bool) -> Vec<Watched<'a>> {
    views
        .iter()
        .map(|scored| {
            let input = if paper {
                Stored::Paper(model.paper_input(&scored.target).to_kind(Kind::Half))
            } else {
                Stored::Blend(with_kind(&model.blend_input(&scored.target), Kind::Half))
            };
            Watched { scored, input }
        })
        .collect()
}

/// Mean errors (full frame, object) of plain blending with the prior's weights.
pub(crate) fn prior_errors(views: &[Watched<'_>]) -> (f64, f64) {
    mean_errors(views, |input| match input {
        Stored::Blend(input) => with_kind(input, Kind::Float).prior_blend(),
        Stored::Paper(input) => input.narrow(1, 0, 3).to_kind(Kind::Float),
    })
}

fn mean_errors(views: &[Watched<'_>], image: impl Fn(&Stored) -> Tensor) -> (f64, f64) {
    let mut sums = (0.0, 0.0);
    for view in views {
        let (full, object) = no_grad(|| {
            let image = image(&view.input).nan_to_num(0.0, 1.0, 0.0).clamp(0.0, 1.0)
                * &view.scored.target.coverage;
            errors_255(&image, view.scored)
        });
        sums = (sums.0 + full, sums.1 + object);
    }
    let count = views.len().max(1) as f64;
    (sums.0 / count, sums.1 / count)
}

fn examples(
    data: &Dataset<'_>,
    session: &Session<'_>,
    model: &Model,
    patch: i64,
) -> Result<Vec<Example>, BakeError> {
    let mut examples = Vec::with_capacity(data.train.len());
    for (at, &view) in data.train.iter().enumerate() {
        session.reporter.step(
            0.0,
            &format!("warping training view {} of {}", at + 1, data.train.len()),
        );
        let scored = data.scored(view)?;
        let input = model.blend_input(&scored.target);
        let coverage = &scored.target.coverage * &scored.counted;
        let Some((y, x, h, w)) = bounds(&coverage, patch) else {
            continue;
        };
        let cut = |t: &Tensor| t.narrow(2, y, h).narrow(3, x, w).to_kind(Kind::Half);
        examples.push(Example {
            input: with_kind(&input.crop(y, x, h, w), Kind::Half),
            truth: cut(&scored.canonical_truth()),
            coverage: cut(&coverage),
            size: (h, w),
        });
    }
    if examples.is_empty() {
        return Err(BakeError::Unusable {
            message: "no training view shows the object".into(),
            hint: "check that proxy and cameras are in the same frame".into(),
        });
    }
    Ok(examples)
}

/// Rows and columns that hold the object, grown to at least `patch` where the image allows: (y, x, height, width).
fn bounds(coverage: &Tensor, patch: i64) -> Option<(i64, i64, i64, i64)> {
    let (_, _, height, width) = coverage.size4().ok()?;
    let range = |axis: i64, limit: i64| -> Option<(i64, i64)> {
        let any = coverage
            .amax([0i64, 1, axis].as_slice(), false)
            .gt(0.0)
            .nonzero()
            .view([-1]);
        if any.numel() == 0 {
            return None;
        }
        let (low, high) = (any.min().int64_value(&[]), any.max().int64_value(&[]) + 1);
        let size = (high - low + 8).max(patch).min(limit);
        let start = ((low + high - size) / 2).clamp(0, limit - size);
        Some((start, size))
    };
    let (y, h) = range(3, height)?;
    let (x, w) = range(2, width)?;
    Some((y, x, h, w))
}

/// A `CompositionNet` from finished weights.
pub(crate) fn restore(
    data: &Dataset<'_>,
    session: &Session<'_>,
    stage: &str,
    paper: bool,
) -> Result<Option<Composition>, BakeError> {
    let Some(weights) = session.finished(stage) else {
        return Ok(None);
    };
    let mut builder = Builder::new();
    Ok(Some(if paper {
        let net = PaperComposition::new(&mut builder, data.settings.k);
        let mut params = builder.build(data.device, 0);
        load_weights(&mut params, weights)?;
        Composition::Paper(net, params)
    } else {
        let net = BlendComposition::new(&mut builder, data.settings.k);
        let mut params = builder.build(data.device, 0);
        load_weights(&mut params, weights)?;
        Composition::Blend(net, params)
    }))
}

/// Names and lengths of one composition training.
pub(crate) struct Plan {
    /// Stage in checkpoints.
    pub(crate) stage: &'static str,
    /// Row of metrics.json whose curve this is.
    pub(crate) method: &'static str,
    pub(crate) schedule: Schedule,
    pub(crate) seed: u64,
    pub(crate) batch: usize,
    pub(crate) patch: i64,
    /// Training seconds spent before this stage on what the method needs.
    pub(crate) secs_before: f64,
}

/// Trains the blending head; keeps the weights of the observation with the lowest validation error.
pub(crate) fn train_blend(
    data: &Dataset<'_>,
    session: &mut Session<'_>,
    model: &Model,
    plan: &Plan,
    validation: &[Watched<'_>],
    held_out: &[Watched<'_>],
) -> Result<(), BakeError> {
    let examples = examples(data, session, model, plan.patch)?;
    let mut builder = Builder::new();
    let net = BlendComposition::new(&mut builder, data.settings.k);
    let params = builder.build(data.device, plan.seed);
    let adam = Adam::new(&params, AVERAGE_DECAY);
    let forward = |params: &Params, input: &Stored| match input {
        Stored::Blend(input) => net.forward(params, &with_kind(input, Kind::Float)),
        Stored::Paper(_) => unreachable!("blend models watch blend inputs"),
    };
    let outcome = session.train(
        plan.stage,
        vec![Trainee { params, adam }],
        plan.schedule,
        |trainees, step, fraction, scale| {
            let trainee = &mut trainees[0];
            let mut rng = step_rng(plan.seed, plan.stage, step);
            let mut inputs = Vec::with_capacity(plan.batch);
            let (mut truths, mut coverages) = (Vec::new(), Vec::new());
            // Windows of a batch have one size: the smallest that all its views can give.
            let picked: Vec<&Example> = (0..plan.batch)
                .map(|_| &examples[rng.random_range(0..examples.len())])
                .collect();
            let h = picked
                .iter()
                .map(|e| e.size.0)
                .min()
                .unwrap_or(1)
                .min(plan.patch);
            let w = picked
                .iter()
                .map(|e| e.size.1)
                .min()
                .unwrap_or(1)
                .min(plan.patch);
            for example in picked {
                let y = rng.random_range(0..=example.size.0 - h);
                let x = rng.random_range(0..=example.size.1 - w);
                inputs.push(with_kind(&example.input.crop(y, x, h, w), Kind::Float));
                truths.push(example.truth.narrow(2, y, h).narrow(3, x, w));
                coverages.push(example.coverage.narrow(2, y, h).narrow(3, x, w));
            }
            let truth = Tensor::cat(&truths, 0).to_kind(Kind::Float);
            let coverage = Tensor::cat(&coverages, 0).to_kind(Kind::Float);
            let image = net.forward(&trainee.params, &BlendInput::batch(&inputs)) * &coverage;
            let loss = losses::blend(&image, &truth, &coverage);
            let value = loss.double_value(&[]);
            loss.backward();
            trainee.adam.step(
                &mut trainee.params,
                cosine_rate(BLEND_RATE, fraction) * scale,
                1.0,
            );
            value
        },
        |session, trainees, secs| {
            let averaged = trainees[0].adam.averaged(&trainees[0].params);
            let error = observe(session, plan, validation, held_out, secs, |input| {
                forward(&averaged, input)
            });
            Ok(Some(error))
        },
    )?;
    session.finish(plan.stage, &outcome.best()?)
}

/// Records a point of the curve; the validation error, or the held-out one where there are no validation views.
fn observe(
    session: &mut Session<'_>,
    plan: &Plan,
    validation: &[Watched<'_>],
    held_out: &[Watched<'_>],
    secs: f64,
    image: impl Fn(&Stored) -> Tensor,
) -> f64 {
    let (mse, mse_object) = mean_errors(held_out, &image);
    session.curve_point(ign_bundle::metrics::SpeedError {
        method: plan.method.into(),
        secs: plan.secs_before + secs,
        mse,
        mse_object,
    });
    mean_errors(validation, &image).0
}

/// Trains the paper's `CompositionNet` with its discriminator: whole images one by one, Adam 1e-3 for both.
pub(crate) fn train_paper(
    data: &Dataset<'_>,
    session: &mut Session<'_>,
    model: &Model,
    plan: &Plan,
    validation: &[Watched<'_>],
    held_out: &[Watched<'_>],
) -> Result<(), BakeError> {
    let mut examples = Vec::with_capacity(data.train.len());
    for (at, &view) in data.train.iter().enumerate() {
        session.reporter.step(
            0.0,
            &format!("warping training view {} of {}", at + 1, data.train.len()),
        );
        let scored = data.scored(view)?;
        examples.push((
            model.paper_input(&scored.target).to_kind(Kind::Half),
            scored.canonical_truth().to_kind(Kind::Half),
            (&scored.target.coverage * &scored.counted).to_kind(Kind::Half),
        ));
    }
    let mut builder = Builder::new();
    let net = PaperComposition::new(&mut builder, data.settings.k);
    let params = builder.build(data.device, plan.seed);
    let generator = Trainee {
        adam: Adam::new(&params, 0.0),
        params,
    };
    let mut builder = Builder::new();
    let critic = builder.scope("discriminator", |b| {
        PatchGan::new(b, PaperComposition::input_channels(data.settings.k) + 3)
    });
    let params = builder.build(data.device, plan.seed ^ 1);
    let discriminator = Trainee {
        adam: Adam::new(&params, 0.0),
        params,
    };
    let outcome = session.train(
        plan.stage,
        vec![generator, discriminator],
        plan.schedule,
        |trainees, step, _, scale| {
            let mut rng = step_rng(plan.seed, plan.stage, step);
            let (input, truth, coverage) = &examples[rng.random_range(0..examples.len())];
            let (input, truth, coverage) = (
                input.to_kind(Kind::Float),
                truth.to_kind(Kind::Float),
                coverage.to_kind(Kind::Float),
            );
            let [generator, discriminator] = trainees else {
                return f64::NAN;
            };
            let image = net.forward(&generator.params, &input, true) * &coverage;
            let mut loss = losses::l1(&image, &truth);
            let size = truth.size();
            let adversarial = size[2].min(size[3]) >= LEAST_GAN_PX;
            if adversarial {
                let fake = critic.forward(&discriminator.params, &input, &image.detach(), true);
                let real = critic.forward(&discriminator.params, &input, &truth, true);
                let criticism =
                    (losses::adversarial(&fake, false) + losses::adversarial(&real, true)) * 0.5;
                criticism.backward();
                discriminator
                    .adam
                    .step(&mut discriminator.params, 1e-3 * scale, f64::INFINITY);
                let verdict = critic.forward(&discriminator.params, &input, &image, true);
                loss += losses::adversarial(&verdict, true) * ADVERSARIAL;
            }
            let value = loss.double_value(&[]);
            loss.backward();
            // The generator's pass left gradients in the discriminator: they are not its own.
            drop(discriminator.params.take_grad());
            generator
                .adam
                .step(&mut generator.params, 1e-3 * scale, f64::INFINITY);
            value
        },
        |session, trainees, secs| {
            let params = &trainees[0].params;
            let error = observe(
                session,
                plan,
                validation,
                held_out,
                secs,
                |input| match input {
                    Stored::Paper(input) => net.forward(params, &input.to_kind(Kind::Float), false),
                    Stored::Blend(input) => {
                        color::quantised(&with_kind(input, Kind::Float).prior_blend())
                    }
                },
            );
            Ok(Some(error))
        },
    )?;
    session.finish(plan.stage, &outcome.trainees[0].params)
}
