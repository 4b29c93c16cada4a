//! What training minimises. Each loss is a scalar of the kind of its inputs; its gradient is checked against finite
//! differences in f64 (`tests/gradients.rs`).

use tch::{Kind, Tensor};

use crate::color;

/// Reductions keep the kind of their input.
const KEEP: Option<Kind> = None;

/// An encoded colour at or above this may be clipped: what was there is not known.
const CLIPPED: f64 = 0.98;
/// Where the pair loss turns from squares to absolute values, as a squared difference of encoded colours.
const PAIR_TURN: f64 = 1e-4;
/// The same of the blending loss.
const BLEND_TURN: f64 = 1e-6;
/// Weight of the squared term of the blending loss, which is what the metric counts.
const SQUARED: f64 = 4.0;
/// Keeps the root of the paper's loss differentiable at 0.
const ROOT_FLOOR: f64 = 1e-8;

/// Two observations of the same P surface points and the effects predicted for each.
#[derive(Debug)]
pub struct Pair<'a> {
    /// [P, 3], encoded sRGB in [0, 1], seen from here.
    pub color_here: &'a Tensor,
    /// [P, 3], the same from there.
    pub color_there: &'a Tensor,
    /// [P, 3], effects in linear light.
    pub effects_here: &'a Tensor,
    /// [P, 3], effects in linear light.
    pub effects_there: &'a Tensor,
    /// [P, 1], 1 where both observations are sound.
    pub sound: &'a Tensor,
}

/// How badly each observation, with its effects exchanged for the other's, predicts the other: mean over points and
/// channels of a robust (Charbonnier) difference of encoded colours. Light adds up in linear light; a clipped
/// observation predicts nothing.
pub fn pair(pair: &Pair<'_>) -> Tensor {
    let here = color::linear_from_srgb(pair.color_here) - pair.effects_here;
    let there = color::linear_from_srgb(pair.color_there) - pair.effects_there;
    let predicted_here = color::srgb_from_linear(&(there + pair.effects_here));
    let predicted_there = color::srgb_from_linear(&(here + pair.effects_there));
    let unclipped = |c: &Tensor| c.lt(CLIPPED).to_kind(c.kind());
    let size = |d: Tensor| (d.square() + PAIR_TURN).sqrt();
    let error = size(predicted_here - pair.color_here) * unclipped(pair.color_there)
        + size(predicted_there - pair.color_there) * unclipped(pair.color_here);
    (error * pair.sound).sum(KEEP) / (pair.sound.sum(KEEP) * 6.0).clamp_min(1.0)
}

/// Loss of the blending head: robust absolute plus squared differences per covered channel.
/// image, truth: [B, 3, H, W], encoded, black outside; coverage: [B, 1, H, W].
pub fn blend(image: &Tensor, truth: &Tensor, coverage: &Tensor) -> Tensor {
    let difference = image - truth;
    let covered = coverage.sum(KEEP).clamp_min(1.0) * 3.0;
    ((difference.square() + BLEND_TURN).sqrt().sum(KEEP) + difference.square().sum(KEEP) * SQUARED)
        / covered
}

/// The paper's l1 distance of two images of one shape (Sec. "CompositionNet").
pub fn l1(image: &Tensor, truth: &Tensor) -> Tensor {
    (image - truth).abs().mean(KEEP)
}

/// The paper's distance of two diffuse images where both are visible (Sec. "EffectsNet"): the root of the mean square.
/// a, b: [P, 3]; visible: [P, 1].
pub fn diffuse_distance(a: &Tensor, b: &Tensor, visible: &Tensor) -> Tensor {
    let difference = (a - b) * visible;
    let count = (visible.sum(KEEP) * 3.0).clamp_min(1.0);
    (difference.square().sum(KEEP) / count + ROOT_FLOOR).sqrt()
}

/// Mean size of the predicted effects: what nothing speaks for shall be zero.
pub fn sparsity(effects: &Tensor) -> Tensor {
    effects.abs().mean(KEEP)
}

/// Binary cross-entropy of patch logits against "all real" or "all generated".
pub fn adversarial(logits: &Tensor, real: bool) -> Tensor {
    let signed = if real {
        -logits
    } else {
        logits.shallow_clone()
    };
    signed.softplus().mean(KEEP)
}
