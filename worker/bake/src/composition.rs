//! Training of `CompositionNet` (Sec. "Image compositing").
//!
//! What a training view shows the network does not change while it trains: warps, effects and coverage are computed
//! once per view and kept in half precision, cut to the object's bounds ([`ViewStore`]).
//!
//! Deviation (presets `standard` and `auto`): a training view that is a reference is blended from the other references, as
//! if its own picture were not there. Otherwise two training views in five of a small capture are shown with the answer
//! among the candidates, teach nothing, and the head fits the rest by heart. The order of a pixel's views is shuffled at
//! each step for the same end. Matte demo vase, 64 px, 400 steps, error on validation and held-out views: neither 7.17 and
//! 7.78, left out 6.14 and 7.47, both 6.07 and 7.33 (plain blending 8.38 and 11.07).
//!
//! Deviation (presets `standard` and `auto`): random windows instead of whole images, so that a step sees several views and the
//! network cannot rely on framing. Many small ones teach more in the same time: held-out error after 1650 steps of eight windows
//! of 32 px and after 1000 of four of 64 px, demo vases at 64 px, 5.86 and 6.00 (matte), 10.73 and 10.92 (glossy). l1 plus a
//! squared term, since squared error is what is scored; no discriminator (it is two thirds of a step's cost, and lowers no error
//! that is scored). The preset `paper` has the paper's.

use ign_nets::composition::{BlendComposition, BlendInput, PaperComposition};
use ign_nets::losses;
use ign_nets::optim::Trainee;
use ign_nets::params::flat_values;
use ign_nets::patchgan::PatchGan;
use ign_nets::steps::{Descent, Gan, GanExample, RATE, blend_step};
use ign_nets::{Builder, Params};
use ign_render::{Model, ReferenceImage, RenderSettings, Target};
use rand::RngExt;
use rand::seq::SliceRandom;
use tch::{Kind, Tensor, no_grad};

use crate::BakeError;
use crate::checkpoint::{Curve, Session, Stage, Watch};
use crate::data::{Dataset, Scored, errors_255};
use crate::pretrain;
use crate::recipe::{Loss, Settings};
use crate::sampler::{StepRng, step_rng};
use crate::schedule::Schedule;
use crate::training::Drawn;
use crate::views::ViewStore;

/// Peak learning rate of the blending head.
const BLEND_RATE: f64 = 1.5e-3;

/// A view to measure on during training, with what the network sees of it.
pub(crate) struct Watched<'a, I> {
    scored: &'a Scored,
    input: I,
}

fn with_kind(input: &BlendInput, kind: Kind) -> BlendInput {
    BlendInput {
        candidates: input.candidates.to_kind(kind),
        prior: input.prior.to_kind(kind),
        visibility: input.visibility.to_kind(kind),
        target: input.target.to_kind(kind),
    }
}

/// Prepares views for measuring with what `input` makes of them.
fn watched<I>(views: &[Scored], input: impl Fn(&Target) -> I) -> Vec<Watched<'_, I>> {
    views
        .iter()
        .map(|scored| Watched {
            scored,
            input: input(&scored.target),
        })
        .collect()
}

/// Prepares views for measuring the blending head with `model`'s present effects.
fn watched_blend<'a>(model: &Model, views: &'a [Scored]) -> Vec<Watched<'a, BlendInput>> {
    watched(views, |target| {
        with_kind(&model.blend_input(target), Kind::Half)
    })
}

/// Mean errors (full frame, object) of plain blending with the prior's weights; `None` without views.
pub(crate) fn prior_errors(model: &Model, views: &[Scored]) -> Option<(f64, f64)> {
    mean_errors(&watched_blend(model, views), |input| {
        with_kind(input, Kind::Float).prior_blend()
    })
}

/// Mean squared error, full frame, of what a model renders; `None` without views.
pub(crate) fn rendered_error(model: &Model, views: &[Scored]) -> Option<f64> {
    let errors = views
        .iter()
        .map(|scored| errors_255(&model.image(&scored.target), scored).0);
    let sum: f64 = errors.sum();
    (!views.is_empty()).then(|| sum / views.len() as f64)
}

fn mean_errors<I>(views: &[Watched<'_, I>], image: impl Fn(&I) -> Tensor) -> Option<(f64, f64)> {
    let mut sums = (0.0, 0.0);
    for view in views {
        let (full, object) = no_grad(|| {
            let image = image(&view.input).nan_to_num(0.0, 1.0, 0.0).clamp(0.0, 1.0)
                * &view.scored.target.coverage;
            errors_255(&image, view.scored)
        });
        sums = (sums.0 + full, sums.1 + object);
    }
    let count = views.len() as f64;
    (!views.is_empty()).then_some((sums.0 / count, sums.1 / count))
}

/// Every training view that shows the object, cut to its bounds: input, truth, coverage times scored.
pub(crate) fn examples(
    data: &Dataset<'_>,
    session: &Session<'_>,
    model: &Model,
    settings: &Settings,
    references: &[ReferenceImage],
) -> Result<ViewStore, BakeError> {
    let patch = settings.patch;
    let mut examples = data.view_store();
    each_training_view(data, session, &model.settings, |view, scored| {
        let name = &data.scene.views[view].name;
        let own = references.iter().position(|image| &image.name == name);
        let hidden = own.filter(|_| settings.leave_out && references.len() > 1);
        let input = model.blend_input_without(&scored.target, hidden);
        let coverage = &scored.target.coverage * &scored.counted;
        let Some((y, x, h, w)) = bounds(&coverage, patch) else {
            return Ok(());
        };
        let cut = |t: &Tensor| t.narrow(2, y, h).narrow(3, x, w);
        examples.push(&[
            input.crop(y, x, h, w).planes(),
            cut(&scored.canonical_truth()),
            cut(&coverage),
        ])
    })?;
    say_where(session, &examples);
    if examples.len() == 0 {
        return Err(BakeError::Unusable {
            message: "no training view shows the object".into(),
            hint: "check that proxy and cameras are in the same frame".into(),
        });
    }
    Ok(examples)
}

/// Loads the training views one after the other.
fn each_training_view(
    data: &Dataset<'_>,
    session: &Session<'_>,
    settings: &RenderSettings,
    mut work: impl FnMut(usize, &Scored) -> Result<(), BakeError>,
) -> Result<(), BakeError> {
    let before = session.reporter.activity("warps");
    for (at, &view) in data.train.iter().enumerate() {
        session.reporter.step(
            0.0,
            &format!("warping training view {} of {}", at + 1, data.train.len()),
        );
        work(view, &data.scored(view, settings)?)?;
    }
    session.reporter.activity(before);
    Ok(())
}

fn say_where(session: &Session<'_>, examples: &ViewStore) {
    if examples.on_disk_bytes() > 0 {
        session.reporter.info(format!(
            "{} MB of training views do not fit into cache_mb and lie on disk",
            examples.on_disk_bytes() >> 20
        ));
    }
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

/// Names and lengths of one composition training.
pub(crate) struct Plan {
    /// Stage in checkpoints.
    pub(crate) stage: &'static str,
    /// Row of metrics.json whose curve this is.
    pub(crate) method: &'static str,
    pub(crate) schedule: Schedule,
    pub(crate) seed: u64,
    /// Training seconds spent before this stage on what the method needs.
    pub(crate) secs_before: f64,
}

/// Views that training is measured on.
#[derive(Clone, Copy)]
pub(crate) struct Views<'a> {
    pub(crate) validation: &'a [Scored],
    pub(crate) held_out: &'a [Scored],
}

/// Trains the blending head on windows of several views a step; keeps the weights of the lowest validation error.
pub(crate) fn train_blend(
    data: &Dataset<'_>,
    session: &mut Session<'_>,
    model: &Model,
    plan: &Plan,
    settings: &Settings,
    drawn: &Drawn,
) -> Result<(), BakeError> {
    let examples = examples(data, session, model, settings, &drawn.images)?;
    let mut builder = Builder::new();
    let net = BlendComposition::new(&mut builder, drawn.settings.k, settings.width);
    let mut params = builder.build(data.device, plan.seed);
    let validation = watched_blend(model, &drawn.validation);
    let held_out = watched_blend(model, &drawn.held_out);
    let errors = |params: &Params, views| {
        mean_errors(views, |input| {
            net.forward(params, &with_kind(input, Kind::Float))
        })
    };
    let error = |params: &Params| errors(params, &validation).map(|(full, _)| full);
    // Without validation views nobody knows whether the pretrained weights do here.
    if settings.pretrained
        && let Some(plain_error) = error(&params)
    {
        let plain = flat_values(params.flat());
        if pretrain::fill(&mut params)?
            && let Some(learned_error) = error(&params)
        {
            session.measured(&pretrain::measure(plan.stage), || learned_error);
            if learned_error > plain_error {
                params.restore(&plain)?;
            }
        }
    }
    let stage = Stage {
        name: plan.stage,
        schedule: plan.schedule,
        watch: Some(Watch {
            keep_best: true,
            validation: &error,
            curve: Some(Curve {
                method: plan.method,
                secs_before: plan.secs_before,
                held_out: &|params| errors(params, &held_out).unwrap_or_default(),
            }),
        }),
    };
    let trainee = settings.trainee(params);
    session.train(&stage, vec![trainee], |trainees, step, rate| {
        let mut rng = step_rng(plan.seed, plan.stage, step);
        train_on_windows(&net, &mut trainees[0], &examples, settings, &mut rng, rate)
    })
}

/// A step on windows of several views, drawn at random; returns the loss before it.
pub(crate) fn train_on_windows(
    net: &BlendComposition,
    trainee: &mut Trainee,
    examples: &ViewStore,
    settings: &Settings,
    rng: &mut StepRng,
    rate: f64,
) -> f64 {
    let picked: Vec<usize> = (0..settings.batch)
        .map(|_| rng.random_range(0..examples.len()))
        .collect();
    // Windows of a batch have one size: the smallest that all its views can give.
    let patch = settings.patch;
    let (h, w) = picked.iter().fold((patch, patch), |(h, w), &view| {
        let size = examples.size(view);
        (h.min(size.0), w.min(size.1))
    });
    let from: Vec<(usize, i64, i64)> = picked
        .into_iter()
        .map(|view| {
            let size = examples.size(view);
            let y = rng.random_range(0..=size.0 - h);
            (view, y, rng.random_range(0..=size.1 - w))
        })
        .collect();
    let windows = examples.windows(&from, (h, w));
    let channels = windows.size()[1];
    let k = settings.k;
    let mut input = BlendInput::of_planes(&windows.narrow(1, 0, channels - 4), k);
    if settings.shuffle {
        let mut order: Vec<i64> = (0..k as i64).collect();
        order.shuffle(rng);
        input = input.reordered(&order);
    }
    let truth = windows.narrow(1, channels - 4, 3);
    let coverage = windows.narrow(1, channels - 1, 1);
    let loss = match settings.loss {
        Loss::Mixed => losses::blend,
        Loss::L1 => |image: &Tensor, truth: &Tensor, _: &Tensor| losses::l1(image, truth),
    };
    let descent = Descent {
        rate: BLEND_RATE * rate,
        kind: settings.kind(),
    };
    blend_step(net, trainee, &input, (&truth, &coverage), loss, descent)
}

/// What a generator sees of a target.
pub(crate) struct GeneratorInput<'a> {
    /// Of `of`'s result.
    pub(crate) channels: i64,
    /// [1, C, H, W].
    pub(crate) of: &'a dyn Fn(&Target) -> Tensor,
    /// How its targets are drawn.
    pub(crate) settings: &'a RenderSettings,
    /// Whether a discriminator judges what it paints.
    pub(crate) adversarial: bool,
}

/// Trains a generator of the paper's form, as a rule with its discriminator: whole images one by one, Adam 1e-3 for both.
pub(crate) fn train_generator(
    data: &Dataset<'_>,
    session: &mut Session<'_>,
    input: &GeneratorInput<'_>,
    plan: &Plan,
    views: Views<'_>,
) -> Result<(), BakeError> {
    let half = |target: &Target| (input.of)(target).to_kind(Kind::Half);
    let mut examples = data.view_store();
    each_training_view(data, session, input.settings, |_, scored| {
        examples.push(&[
            (input.of)(&scored.target),
            scored.canonical_truth(),
            &scored.target.coverage * &scored.counted,
        ])
    })?;
    say_where(session, &examples);
    let mut builder = Builder::new();
    let generator = PaperComposition::new(&mut builder, input.channels);
    let painter = Trainee::new(builder.build(data.device, plan.seed), 0.0);
    let mut builder = Builder::new();
    let discriminator = builder.scope("discriminator", |b| PatchGan::new(b, input.channels + 3));
    let critic = Trainee::new(builder.build(data.device, plan.seed ^ 1), 0.0);
    let gan = Gan {
        generator: &generator,
        discriminator: &discriminator,
    };
    let validation = watched(views.validation, half);
    let held_out = watched(views.held_out, half);
    let errors = |params: &Params, views| {
        mean_errors(views, |input: &Tensor| {
            generator.forward(params, &input.to_kind(Kind::Float), false)
        })
    };
    let stage = Stage {
        name: plan.stage,
        schedule: plan.schedule,
        watch: Some(Watch {
            keep_best: false,
            validation: &|params| errors(params, &validation).map(|(full, _)| full),
            curve: Some(Curve {
                method: plan.method,
                secs_before: plan.secs_before,
                held_out: &|params| errors(params, &held_out).unwrap_or_default(),
            }),
        }),
    };
    let mut trainees = vec![painter];
    trainees.extend(input.adversarial.then_some(critic));
    session.train(&stage, trainees, |trainees, step, rate| {
        let mut rng = step_rng(plan.seed, plan.stage, step);
        let view = rng.random_range(0..examples.len());
        let image = examples.windows(&[(view, 0, 0)], examples.size(view));
        let example = GanExample {
            input: &image.narrow(1, 0, input.channels),
            truth: &image.narrow(1, input.channels, 3),
            coverage: &image.narrow(1, input.channels + 3, 1),
        };
        match trainees {
            [painter, critic] => gan.step(painter, critic, &example, RATE * rate),
            [painter] => gan.step_alone(painter, &example, RATE * rate),
            _ => unreachable!("a generator has one discriminator or none"),
        }
    })
}
