//! The paper's training steps (Sec. "Self-supervised Training", "CompositionNet", "Training"): what a bake repeats, and
//! what `tests/paper` compares with an independent implementation.
//!
//! The paper gives norms without saying how they scale with the number of pixels; here all of them are means, so that
//! their weights against each other do not depend on the resolution.

use tch::Tensor;

use crate::composition::PaperComposition;
use crate::effects::PaperEffects;
use crate::losses;
use crate::optim::Trainee;
use crate::params::Params;
use crate::patchgan::PatchGan;
use crate::warp::Taps;

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
    loss.backward();
    trainee.step(rate, f64::INFINITY);
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
            self.criticism(&discriminator.params, example, &image)
                .backward();
            discriminator.step(rate, f64::INFINITY);
        }
        let loss = self.loss(&discriminator.params, example, &image);
        loss.backward();
        // The generator's pass left gradients in the discriminator: they are not its own.
        drop(discriminator.params.take_grad());
        generator.step(rate, f64::INFINITY);
        loss.double_value(&[])
    }

    /// Trains the generator by the l1 distance alone; returns its loss before the step.
    pub fn step_alone(&self, generator: &mut Trainee, example: &GanExample<'_>, rate: f64) -> f64 {
        let image = self.image(&generator.params, example);
        let loss = losses::l1(&image, example.truth);
        loss.backward();
        generator.step(rate, f64::INFINITY);
        loss.double_value(&[])
    }
}

fn judged(example: &GanExample<'_>) -> bool {
    let size = example.truth.size();
    size[2].min(size[3]) >= LEAST_GAN_PX
}
