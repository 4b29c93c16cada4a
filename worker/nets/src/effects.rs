//! `EffectsNet`: the view-dependent part of a view's colours, from its geometry alone (Sec. "EffectsNet").
//!
//! Two forms:
//! - [`PaperEffects`]: the paper's U-Net over position, normal and reflection maps, sigmoid output, subtracted from
//!   the encoded image.
//! - [`PointEffects`] (preset `standard`): the same inputs through a small perceptron per surface point.
//!
//! Deviation: `PointEffects` replaces the U-Net. (1) It sees one point at a time, so its output cannot depend on
//! framing or on batch statistics. (2) Reflected light adds in linear light, where a highlight does not carry the
//! texture below it, so effects are removed and re-inserted there. (3) Pairs of training observations are sampled
//! point by point over all views instead of image pair by image pair, and both predictions are evaluated at the same
//! surface point: no error from resampling predicted effects. The measured effect is in worker/nets/README.md.

use crate::params::{Builder, Init, ParamId, Params};
use crate::unet::UNet;
use tch::{Kind, Tensor};

/// Channels of the geometry input: position, normal, reflected viewing direction.
pub const GEOMETRY_CHANNELS: i64 = 9;
const PAPER_WIDTHS: [i64; 6] = [32, 32, 64, 128, 256, 512];

/// The paper's `EffectsNet`.
#[derive(Debug)]
pub struct PaperEffects {
    net: UNet,
}

impl PaperEffects {
    /// Registers the network's tensors.
    pub fn new(builder: &mut Builder) -> Self {
        Self {
            net: builder.scope("effects", |b| {
                UNet::new(b, GEOMETRY_CHANNELS, &PAPER_WIDTHS, 3, 0.0)
            }),
        }
    }

    /// geometry: [B, 9, H, W] -> effects [B, 3, H, W] in [0, 1], encoded sRGB.
    pub fn forward(&self, params: &Params, geometry: &Tensor, train: bool) -> Tensor {
        self.net.forward(params, geometry, train).sigmoid()
    }
}

/// Octaves of the position code: surface detail down to 1/4 of the object's radius.
const POSITION_OCTAVES: i64 = 3;
/// Octaves of the reflection code: lobes down to about 7 degrees before the perceptron sharpens them.
const REFLECTION_OCTAVES: i64 = 4;
/// Width of the hidden layers.
const HIDDEN: i64 = 64;

/// `EffectsNet` of preset `standard`: a perceptron per surface point, in linear light.
#[derive(Clone, Debug)]
pub struct PointEffects {
    layers: Vec<(ParamId, ParamId)>,
}

impl PointEffects {
    /// Registers the network's tensors.
    pub fn new(builder: &mut Builder) -> Self {
        let input = 3 * (1 + 2 * POSITION_OCTAVES) + 3 + 3 * (1 + 2 * REFLECTION_OCTAVES) + 1;
        let widths = [input, HIDDEN, HIDDEN, HIDDEN, HIDDEN, 3];
        let layers = builder.scope("effects", |b| {
            (0..widths.len() - 1)
                .map(|index| {
                    let (from, to) = (widths[index], widths[index + 1]);
                    let last = index + 2 == widths.len();
                    // Starts with effects near zero: softplus(-4) = 0.018.
                    let (init, bias) = if last {
                        (Init::Uniform(0.02), Init::Constant(-4.0))
                    } else {
                        (Init::kaiming(from), Init::Constant(0.0))
                    };
                    let layer = |b: &mut Builder| {
                        (
                            b.param("weight", &[to, from], init),
                            b.param("bias", &[to], bias),
                        )
                    };
                    b.scope(&format!("layer{index}"), |b| {
                        // What goes into softplus is about -4: a rounding to bfloat16 shows.
                        if last { b.exact(layer) } else { layer(b) }
                    })
                })
                .collect()
        });
        Self { layers }
    }

    /// `points`, `normals`, `to_viewer`: [P, 3] in the normalised frame, the latter two unit -> effects [P, 3], linear
    /// light, not negative. Layers compute in the kind of their weights.
    pub fn forward(
        &self,
        params: &Params,
        points: &Tensor,
        normals: &Tensor,
        to_viewer: &Tensor,
    ) -> Tensor {
        let reflection = crate::warp::reflections(to_viewer, normals);
        let cosine = (to_viewer * normals).sum_dim_intlist([1i64].as_slice(), true, None::<Kind>);
        let mut x = Tensor::cat(
            &[
                frequency_code(points, POSITION_OCTAVES),
                normals.shallow_clone(),
                frequency_code(&reflection, REFLECTION_OCTAVES),
                cosine,
            ],
            1,
        );
        for (index, (weight, bias)) in self.layers.iter().enumerate() {
            let weight = params.get(*weight);
            x = x
                .to_kind(weight.kind())
                .linear(weight, Some(params.get(*bias)));
            if index + 1 < self.layers.len() {
                x = x.relu();
            }
        }
        x.to_kind(points.kind()).softplus()
    }
}

/// x: [P, 3] -> [P, 3 (1 + 2 octaves)]: the value, then sine and cosine at pi, 2 pi, 4 pi, ...
fn frequency_code(x: &Tensor, octaves: i64) -> Tensor {
    let mut parts = vec![x.shallow_clone()];
    for octave in 0..octaves {
        let angle = x * (std::f64::consts::PI * f64::from(1 << octave));
        parts.push(angle.sin());
        parts.push(angle.cos());
    }
    Tensor::cat(&parts, 1)
}
