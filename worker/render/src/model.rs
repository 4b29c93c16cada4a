//! The two networks with their weights, and the path from a target's geometry to its image.

use ign_geometry::select::Nearest;
use ign_nets::composition::{BlendComposition, BlendInput, PaperComposition};
use ign_nets::effects::{PaperEffects, PointEffects};
use ign_nets::{Params, color};
use tch::{Kind, Tensor, no_grad};

use crate::references::{References, Warped};
use crate::settings::{Recipe, RenderSettings};
use crate::target::Target;

/// Reference pixels evaluated at once when effects are removed from the references.
const EFFECTS_CHUNK: i64 = 1 << 16;
/// Encoded value above which a channel counts as clipped: what lies above is unknown there.
const CLIPPED: f64 = 0.96;

/// An `EffectsNet` with its weights.
#[derive(Debug)]
pub enum Effects {
    /// The paper's U-Net; effects are encoded sRGB.
    Paper(PaperEffects, Params),
    /// Per surface point; effects are linear light.
    Points(PointEffects, Params),
}

/// A `CompositionNet` with its weights.
#[derive(Debug)]
pub enum Composition {
    /// The paper's U-Net.
    Paper(PaperComposition, Params),
    /// The blending head.
    Blend(BlendComposition, Params),
}

/// Reference pictures without effects, ready to be warped; constant while a model is.
#[derive(Debug)]
struct Diffuse {
    /// [V*H*W, 3]: linear light (standard) or encoded (paper); the pictures themselves without `EffectsNet`.
    image: Tensor,
    /// [V*H*W].
    alpha: Tensor,
}

/// What renders an object: references, networks and settings.
#[derive(Debug)]
pub struct Model {
    /// The fixed reference views.
    pub references: References,
    /// How to render.
    pub settings: RenderSettings,
    effects: Option<Effects>,
    /// `None`: plain image-based rendering with the prior's weights.
    pub composition: Option<Composition>,
    diffuse: Diffuse,
}

impl Model {
    /// Removes the effects from every reference once.
    pub fn new(
        references: References,
        settings: RenderSettings,
        effects: Option<Effects>,
        composition: Option<Composition>,
    ) -> Self {
        let diffuse = no_grad(|| diffuse(&references, effects.as_ref()));
        Self {
            references,
            settings,
            effects,
            composition,
            diffuse,
        }
    }

    /// The same references with other effects.
    #[must_use]
    pub fn with_effects(self, effects: Option<Effects>) -> Self {
        Self::new(self.references, self.settings, effects, None)
    }

    /// Takes the effects network out; the references are as they were photographed again.
    #[must_use]
    pub fn split_effects(mut self) -> (Self, Option<Effects>) {
        let effects = self.effects.take();
        (self.with_effects(None), effects)
    }

    /// The effects network, when the scene needs one.
    pub fn effects(&self) -> Option<&Effects> {
        self.effects.as_ref()
    }

    /// [1, 3, H, W]: effects in the target's picture (linear light or encoded, as the network has them), or zeros.
    pub fn target_effects(&self, target: &Target) -> Tensor {
        let (h, w) = target.size();
        no_grad(|| match &self.effects {
            None => Tensor::zeros([1, 3, h, w], (Kind::Float, target.points.device())),
            Some(Effects::Paper(net, params)) => {
                net.forward(params, &target.geometry, false) * target.mask()
            }
            Some(Effects::Points(net, params)) => {
                let effects = in_chunks(target.points.size()[0], |from, len| {
                    let cut = |t: &Tensor| t.narrow(0, from, len);
                    net.forward(
                        params,
                        &cut(&target.points),
                        &cut(&target.normals),
                        &cut(&target.to_viewer),
                    )
                });
                target.pool(&effects)
            }
        })
    }

    /// Indices of the reference views that a target uses.
    pub fn chosen(&self, target: &Target) -> Vec<usize> {
        self.chosen_without(target, None)
    }

    fn chosen_without(&self, target: &Target, hidden: Option<usize>) -> Vec<usize> {
        let mode = match self.settings.recipe {
            Recipe::Paper => Nearest::Coverage,
            Recipe::Standard => Nearest::CoverageAngle,
        };
        self.references
            .nearest(target, self.settings.k, mode, hidden)
    }

    /// Warps the chosen references and re-inserts the target's effects.
    pub fn candidates(&self, target: &Target, chosen: &[usize]) -> (Warped, Tensor) {
        no_grad(|| {
            let mut warped =
                self.references
                    .warp(target, chosen, &self.diffuse.image, &self.diffuse.alpha);
            let effects = self.target_effects(target);
            let seen = warped.visibility.gt(0.0).to_kind(Kind::Float).unsqueeze(2);
            warped.color = match &self.effects {
                None => warped.color,
                Some(Effects::Paper(..)) => (warped.color + effects.unsqueeze(1)) * seen,
                Some(Effects::Points(..)) => {
                    color::srgb_from_linear(&(warped.color + effects.unsqueeze(1))).clamp(0.0, 1.0)
                        * seen
                }
            };
            (warped, effects)
        })
    }

    /// What the blending head sees of a target. Missing candidates (fewer references than K) are empty.
    pub fn blend_input(&self, target: &Target) -> BlendInput {
        self.blend_input_without(target, None)
    }

    /// The same as if one of the references, the target's own picture, were not there.
    pub fn blend_input_without(&self, target: &Target, hidden: Option<usize>) -> BlendInput {
        let chosen = self.chosen_without(target, hidden);
        let (warped, effects) = self.candidates(target, &chosen);
        let position_normal = target.geometry.narrow(1, 0, 6);
        let missing = self.settings.k.saturating_sub(chosen.len()) as i64;
        let fill = |t: Tensor, axes: i64| {
            let zeros = vec![0i64; 2 * axes as usize];
            t.constant_pad_nd([zeros.as_slice(), &[0, missing]].concat())
        };
        BlendInput {
            candidates: fill(warped.color, 3),
            prior: fill(warped.prior, 2),
            visibility: fill(warped.visibility, 2),
            target: Tensor::cat(
                &[position_normal, effects, target.coverage.shallow_clone()],
                1,
            ),
        }
    }

    /// What the paper's `CompositionNet` sees: K warped views, K warp fields, the target's positions.
    pub fn paper_input(&self, target: &Target) -> Tensor {
        let chosen = self.chosen(target);
        let (warped, _) = self.candidates(target, &chosen);
        let (h, w) = target.size();
        let k = self.settings.k as i64;
        let missing = k - chosen.len() as i64;
        let flat = |t: Tensor, channels: i64| {
            t.view([1, -1, h, w])
                .constant_pad_nd([0, 0, 0, 0, 0, missing * channels])
        };
        Tensor::cat(
            &[
                flat(warped.color, 3),
                flat(warped.grid, 2),
                target.geometry.narrow(1, 0, 3),
            ],
            1,
        )
    }

    /// [1, 3, H, W] in [0, 1]: the finished image over black, encoded sRGB.
    pub fn image(&self, target: &Target) -> Tensor {
        no_grad(|| {
            let color = match &self.composition {
                None => self.blend_input(target).prior_blend(),
                Some(Composition::Blend(net, params)) => {
                    net.forward(params, &self.blend_input(target))
                }
                Some(Composition::Paper(net, params)) => {
                    net.forward(params, &self.paper_input(target), false)
                }
            };
            composite(&color, target)
        })
    }

    /// [1, 3, H, W] in [0, 1]: the estimated diffuse image of a target, encoded sRGB over black.
    pub fn diffuse_image(&self, target: &Target) -> Tensor {
        no_grad(|| {
            let chosen = self.chosen(target);
            let warped =
                self.references
                    .warp(target, &chosen, &self.diffuse.image, &self.diffuse.alpha);
            let mean = (&warped.color * warped.prior.unsqueeze(2)).sum_dim_intlist(
                [1i64].as_slice(),
                false,
                Kind::Float,
            );
            let color = match &self.effects {
                Some(Effects::Points(..)) => color::srgb_from_linear(&mean),
                _ => mean,
            };
            composite(&color, target)
        })
    }
}

/// Over black, with the target's coverage; clamps to [0, 1] and replaces what is not finite by black.
pub(crate) fn composite(color: &Tensor, target: &Target) -> Tensor {
    (color.nan_to_num(0.0, 1.0, 0.0).clamp(0.0, 1.0) * &target.coverage).clamp(0.0, 1.0)
}

fn diffuse(references: &References, effects: Option<&Effects>) -> Diffuse {
    let colors = &references.colors;
    let pixels = colors.size()[0];
    match effects {
        None => Diffuse {
            image: colors.shallow_clone(),
            alpha: references.alpha.shallow_clone(),
        },
        Some(Effects::Paper(net, params)) => {
            let parts: Vec<Tensor> = (0..references.len() as i64)
                .map(|view| {
                    let effects =
                        net.forward(params, &references.geometry.narrow(0, view, 1), false);
                    effects.view([3, -1]).tr().contiguous()
                })
                .collect();
            Diffuse {
                image: colors - Tensor::cat(&parts, 0),
                alpha: references.alpha.shallow_clone(),
            }
        }
        Some(Effects::Points(net, params)) => {
            let (h, w) = references.size();
            let maps = references
                .geometry
                .permute([0, 2, 3, 1])
                .contiguous()
                .view([-1, 9]);
            let views = Tensor::arange(references.len() as i64, (Kind::Int64, colors.device()))
                .view([-1, 1])
                .expand([-1, h * w], false)
                .contiguous()
                .view([-1]);
            let effects = in_chunks(pixels, |from, len| {
                let maps = maps.narrow(0, from, len);
                let points = maps.narrow(1, 0, 3).contiguous();
                let normals = maps.narrow(1, 3, 3).contiguous();
                let centers = references
                    .sources
                    .centers()
                    .index_select(0, &views.narrow(0, from, len));
                net.forward(
                    params,
                    &points,
                    &normals,
                    &ign_nets::warp::directions(&centers, &points),
                )
            });
            let (brightest, _) = colors.max_dim(1, false);
            let clipped = ((brightest - CLIPPED) / (1.0 - CLIPPED)).clamp(0.0, 1.0);
            Diffuse {
                image: color::linear_from_srgb(colors) - effects,
                alpha: &references.alpha * (1.0f64 - clipped * 0.9),
            }
        }
    }
}

fn in_chunks(total: i64, part: impl Fn(i64, i64) -> Tensor) -> Tensor {
    let parts: Vec<Tensor> = (0..total)
        .step_by(EFFECTS_CHUNK as usize)
        .map(|from| part(from, EFFECTS_CHUNK.min(total - from)))
        .collect();
    if parts.is_empty() {
        part(0, 0)
    } else {
        Tensor::cat(&parts, 0)
    }
}
