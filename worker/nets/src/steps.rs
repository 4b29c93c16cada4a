//! The training steps: what a bake repeats.
//!
//! - The paper's (Sec. "Self-supervised Training", "CompositionNet", "Training"): [`effects_step`], [`Gan::step`], which
//!   `tests/paper` compares with an independent implementation. The paper gives norms without saying how they scale with
//!   the number of pixels; here all of them are means, so that their weights against each other do not depend on the
//!   resolution.
//! - Those of preset `standard`: [`point_step`], [`blend_step`].

use tch::{Kind, Tensor};

use crate::composition::{BlendComposition, BlendInput, PaperComposition};
use crate::effects::{PaperEffects, PointEffects};
use crate::losses;
use crate::optim::Trainee;
use crate::params::Params;
use crate::patchgan::PatchGan;
use crate::warp::{Sources, Taps, directions};

/// Adam's learning rate, constant over the whole training.
pub const RATE: f64 = 1e-3;
/// Weight of the l1 norm of the effects.
pub const SPARSITY: f64 = 0.01;
/// Weight of the adversarial loss beside the l1 loss.
pub const ADVERSARIAL: f64 = 0.01;
/// Visible share of a pixel's footprint in the other view from which on the pair counts there.
const VISIBLE: f64 = 0.5;
/// Smallest side of an image that the discriminator takes.
const LEAST_GAN_PX: i64 = 32;
/// Bound of the gradient's norm in the steps of preset `standard`.
const MOST_GRADIENT: f64 = 1.0;

/// Two training views p and q of one size, and where p's surface points lie in q.
#[derive(Debug)]
pub struct SiamesePair<'a> {
    /// [2, 9, H, W]: the network's input for p and for q.
    pub geometry: &'a Tensor,
    /// [H*W, 3]: p's photograph, encoded sRGB.
    pub color_p: &'a Tensor,
    /// [H*W, 3]: q's photograph, encoded sRGB.
    pub color_q: &'a Tensor,
    /// [P] i64: p's pixels that show the object.
    pub surface: &'a Tensor,
    /// For each of these, where q shows it.
    pub taps: &'a Taps,
}

/// The root of the mean squared difference of p's diffuse image and q's, warped to p, where both see the surface, plus
/// [`SPARSITY`] times the mean of the effects.
pub fn effects_loss(net: &PaperEffects, params: &Params, pair: &SiamesePair<'_>) -> Tensor {
    let effects = net.forward(params, pair.geometry, true);
    let flat = |at: i64| effects.select(0, at).view([3, -1]).tr();
    let diffuse_p = (pair.color_p - flat(0)).index_select(0, pair.surface);
    let diffuse_q = pair.color_q - flat(1);
    let visibility = pair.taps.visibility.unsqueeze(1);
    let visible = visibility.gt(VISIBLE).to_kind(diffuse_p.kind());
    let warped = pair.taps.gather(&diffuse_q) / visibility.clamp_min(1e-3);
    losses::diffuse_distance(&diffuse_p, &warped, &visible) + losses::sparsity(&effects) * SPARSITY
}

/// Trains `EffectsNet` on one pair; returns the loss before the step.
pub fn effects_step(
    net: &PaperEffects,
    trainee: &mut Trainee,
    pair: &SiamesePair<'_>,
    rate: f64,
) -> f64 {
    let loss = effects_loss(net, &trainee.params, pair);
    trainee.descend(&loss, rate, f64::INFINITY);
    loss.double_value(&[])
}

/// One image to learn: B views of one size.
#[derive(Debug)]
pub struct GanExample<'a> {
    /// [B, C, H, W]: what the generator sees, and the discriminator's condition.
    pub input: &'a Tensor,
    /// [B, 3, H, W]: the photograph, encoded sRGB, black outside the object.
    pub truth: &'a Tensor,
    /// [B, 1, H, W]: factor that composites the generator's colours over black.
    pub coverage: &'a Tensor,
}

/// A generator and the conditional discriminator that it is trained against.
#[derive(Debug)]
pub struct Gan<'a> {
    /// Paints the image.
    pub generator: &'a PaperComposition,
    /// Judges patches of it.
    pub discriminator: &'a PatchGan,
}

impl Gan<'_> {
    /// The generator's image, composited: [B, 3, H, W].
    pub fn image(&self, generator: &Params, example: &GanExample<'_>) -> Tensor {
        self.generator.forward(generator, example.input, true) * example.coverage
    }

    /// The discriminator's loss: the mean of its cross-entropies on the photograph and on `image`, as in Pix2Pix.
    pub fn criticism(
        &self,
        discriminator: &Params,
        example: &GanExample<'_>,
        image: &Tensor,
    ) -> Tensor {
        let judge = |image| {
            self.discriminator
                .forward(discriminator, example.input, image, true)
        };
        let (fake, real) = (judge(&image.detach()), judge(example.truth));
        (losses::adversarial(&fake, false) + losses::adversarial(&real, true)) * 0.5
    }

    /// The generator's loss: l1 distance plus [`ADVERSARIAL`] times the cross-entropy of passing for a photograph.
    pub fn loss(&self, discriminator: &Params, example: &GanExample<'_>, image: &Tensor) -> Tensor {
        let distance = losses::l1(image, example.truth);
        if !judged(example) {
            return distance;
        }
        let verdict = self
            .discriminator
            .forward(discriminator, example.input, image, true);
        distance + losses::adversarial(&verdict, true) * ADVERSARIAL
    }

    /// Trains the discriminator, then the generator against it; returns the generator's loss before its step.
    ///
    /// Images of less than 32 pixels, which the discriminator cannot take, train the generator by l1 alone.
    pub fn step(
        &self,
        generator: &mut Trainee,
        discriminator: &mut Trainee,
        example: &GanExample<'_>,
        rate: f64,
    ) -> f64 {
        let image = self.image(&generator.params, example);
        if judged(example) {
            let loss = self.criticism(&discriminator.params, example, &image);
            discriminator.descend(&loss, rate, f64::INFINITY);
        }
        let loss = self.loss(&discriminator.params, example, &image);
        generator.descend(&loss, rate, f64::INFINITY);
        loss.double_value(&[])
    }

    /// Trains the generator by the l1 distance alone; returns its loss before the step.
    pub fn step_alone(&self, generator: &mut Trainee, example: &GanExample<'_>, rate: f64) -> f64 {
        let image = self.image(&generator.params, example);
        let loss = losses::l1(&image, example.truth);
        generator.descend(&loss, rate, f64::INFINITY);
        loss.double_value(&[])
    }
}

fn judged(example: &GanExample<'_>) -> bool {
    let size = example.truth.size();
    size[2].min(size[3]) >= LEAST_GAN_PX
}

/// Every surface point that a training view sees, with its colour: N points, V views of H*W pixels.
#[derive(Debug)]
pub struct Observations {
    /// [N, 3].
    pub points: Tensor,
    /// [N, 3], unit.
    pub normals: Tensor,
    /// [N, 3] encoded sRGB in [0, 1].
    pub colors: Tensor,
    /// [N] i64: the view that sees the point.
    pub views: Tensor,
    /// The V views.
    pub sources: Sources,
    /// [V*H*W, 3] u8, encoded sRGB.
    pub source_colors: Tensor,
    /// [V*H*W] u8.
    pub source_alpha: Tensor,
}

/// Surface points that two views each see, with what they saw: P points.
struct PointPairs {
    /// [P, 3] each.
    points: Tensor,
    normals: Tensor,
    to_here: Tensor,
    to_there: Tensor,
    color_here: Tensor,
    color_there: Tensor,
    /// [P, 1].
    sound: Tensor,
}

impl PointPairs {
    /// What views `other` ([B] i64) see at the points of observations `pick` ([B] i64), where they do; `None` when none does.
    fn new(all: &Observations, pick: &Tensor, other: &Tensor) -> Option<Self> {
        let points = all.points.index_select(0, pick);
        let normals = all.normals.index_select(0, pick);
        let taps = all.sources.taps(&points, &normals, other);
        let same = all.views.index_select(0, pick).eq_tensor(other);
        let valid = taps
            .visibility
            .gt(0.9)
            .logical_and(&taps.facing.gt(0.3))
            .logical_and(&same.logical_not());
        let rows = valid.nonzero().view([-1]);
        let n = rows.size()[0];
        if n == 0 {
            return None;
        }
        let cut = |t: &Tensor| t.index_select(0, &rows);
        let (points, normals, pick) = (cut(&points), cut(&normals), cut(pick));
        let flat = cut(&taps.index).view([-1]);
        let alpha = all.source_alpha.index_select(0, &flat).view([n, 4]);
        let weight = cut(&taps.weight) * alpha.to_kind(Kind::Float) / 255.0;
        let total = weight.sum_dim_intlist([1i64].as_slice(), true, Kind::Float);
        let picked = all
            .source_colors
            .index_select(0, &flat)
            .view([n, 4, 3])
            .to_kind(Kind::Float)
            / 255.0;
        let color_there =
            (picked * weight.unsqueeze(2)).sum_dim_intlist([1i64].as_slice(), false, Kind::Float)
                / total.clamp_min(1e-3);
        let centers = all.sources.centers();
        let towards = |views: &Tensor| directions(&centers.index_select(0, views), &points);
        Some(Self {
            to_here: towards(&all.views.index_select(0, &pick)),
            to_there: towards(&cut(other)),
            color_here: all.colors.index_select(0, &pick),
            color_there,
            sound: total.gt(0.9).to_kind(Kind::Float),
            points,
            normals,
        })
    }

    /// Effects as seen from here and from there: [P, 3] each, linear light.
    fn effects(&self, net: &PointEffects, params: &Params) -> (Tensor, Tensor) {
        let seen_from = |to_viewer| net.forward(params, &self.points, &self.normals, to_viewer);
        (seen_from(&self.to_here), seen_from(&self.to_there))
    }
}

/// How a step of the standard networks goes down its loss.
#[derive(Clone, Copy, Debug)]
pub struct Descent {
    /// Learning rate.
    pub rate: f64,
    /// What the layers compute in.
    pub kind: Kind,
}

/// Trains the point effects on one batch of pairs: how well what another view saw of a surface point, minus its effects, plus
/// this view's effects, predicts what this view saw, compared in encoded sRGB, the values that are scored, plus the sparsity
/// term. Where the other view's colour is clipped, what it hides is unknown and the pair does not count.
///
/// pairs: [B] i64 into the observations, and [B] i64, the other view. Returns the loss before the step, 0 when no view sees
/// its point.
pub fn point_step(
    net: &PointEffects,
    trainee: &mut Trainee,
    all: &Observations,
    (pick, other): (&Tensor, &Tensor),
    descent: Descent,
) -> f64 {
    let Some(pairs) = PointPairs::new(all, pick, other) else {
        return 0.0;
    };
    let (here, there) = pairs.effects(net, &trainee.params.in_kind(descent.kind));
    let size = losses::sparsity(&here) + losses::sparsity(&there);
    let pair = losses::Pair {
        color_here: &pairs.color_here,
        color_there: &pairs.color_there,
        effects_here: &here,
        effects_there: &there,
        sound: &pairs.sound,
    };
    let loss = losses::pair(&pair) + size * (0.5 * SPARSITY);
    trainee.descend(&loss, descent.rate, MOST_GRADIENT);
    loss.double_value(&[])
}

/// Trains the blending head on windows of B views; returns the loss before the step.
///
/// truth: [B, 3, H, W], encoded sRGB, black outside the object; coverage: [B, 1, H, W], which composites the image over
/// black; loss: of image, truth and coverage.
pub fn blend_step(
    net: &BlendComposition,
    trainee: &mut Trainee,
    input: &BlendInput,
    (truth, coverage): (&Tensor, &Tensor),
    loss: fn(&Tensor, &Tensor, &Tensor) -> Tensor,
    descent: Descent,
) -> f64 {
    let params = trainee.params.in_kind(descent.kind);
    let image = net.forward(&params, input) * coverage;
    let loss = loss(&image, truth, coverage);
    trainee.descend(&loss, descent.rate, MOST_GRADIENT);
    loss.double_value(&[])
}
