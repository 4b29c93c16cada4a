//! `CompositionNet`: from K warped views to one image (Sec. "CompositionNet").
//!
//! - [`PaperComposition`]: the paper's U-Net that paints RGB through a sigmoid.
//! - [`BlendComposition`] (preset `standard`): predicts per-pixel softmax weights over the K warped views and one
//!   generated layer.
//!
//! Deviation: the blending head. Its last layer starts at zero, so training starts at the image-based rendering
//! whose weights it is given, and the network learns only what those get wrong; no normalisation layer, so a crop
//! and the full frame agree. The measured effect is in worker/nets/README.md.

use crate::params::{Builder, Init, Params};
use crate::unet::{Conv, UNet, laid_out, leaky_relu};
use tch::{Kind, Tensor};

/// Reductions keep the kind of their input, so that gradients can be checked in f64.
const KEEP: Option<Kind> = None;
const PAPER_WIDTHS: [i64; 6] = [64, 64, 128, 128, 256, 256];

/// The paper's `CompositionNet`: input 3K warped colours, 2K warp fields, 3 target positions. With other inputs it is the
/// generator of the image-to-image baselines (Pix2Pix).
#[derive(Debug)]
pub struct PaperComposition {
    net: UNet,
}

impl PaperComposition {
    /// Channels of the input for `k` warped views; 23 for K = 4.
    pub fn input_channels(k: usize) -> i64 {
        5 * k as i64 + 3
    }

    /// Registers the network's tensors for an input of so many channels.
    pub fn new(builder: &mut Builder, input: i64) -> Self {
        Self {
            net: builder.scope("composition", |b| {
                UNet::new(b, input, &PAPER_WIDTHS, 3, 0.2)
            }),
        }
    }

    /// input: [B, C, H, W] -> [B, 3, H, W], encoded sRGB in [0, 1].
    pub fn forward(&self, params: &Params, input: &Tensor, train: bool) -> Tensor {
        self.net.forward(params, input, train).sigmoid()
    }
}

/// What the blending head works on; all [B, ., H, W], the candidates in encoded sRGB.
#[derive(Debug)]
pub struct BlendInput {
    /// [B, K, 3, H, W]: warped views with the target's effects, 0 where not visible.
    pub candidates: Tensor,
    /// [B, K, H, W]: weights of plain image-based rendering; they sum to 1 where any view sees the point, else 0.
    pub prior: Tensor,
    /// [B, K, H, W] in [0, 1]: how much of the pixel each view sees.
    pub visibility: Tensor,
    /// [B, C, H, W]: what is known of the target: position, normal, effects, coverage.
    pub target: Tensor,
}

impl BlendInput {
    /// A window of every tensor.
    #[must_use]
    pub fn crop(&self, y: i64, x: i64, height: i64, width: i64) -> Self {
        let cut = |t: &Tensor| {
            let n = t.dim() as i64;
            t.narrow(n - 2, y, height).narrow(n - 1, x, width)
        };
        Self {
            candidates: cut(&self.candidates),
            prior: cut(&self.prior),
            visibility: cut(&self.visibility),
            target: cut(&self.target),
        }
    }

    /// The candidates in another order: `order` holds each of 0 to K - 1 once.
    #[must_use]
    pub fn reordered(&self, order: &[i64]) -> Self {
        let order = Tensor::from_slice(order).to_device(self.prior.device());
        let by_order = |t: &Tensor| t.index_select(1, &order);
        Self {
            candidates: by_order(&self.candidates),
            prior: by_order(&self.prior),
            visibility: by_order(&self.visibility),
            target: self.target.shallow_clone(),
        }
    }

    /// [B, 5K + C, H, W]: all of it, plane by plane.
    pub fn planes(&self) -> Tensor {
        let candidates = self.candidates.flatten(1, 2);
        Tensor::cat(
            &[&candidates, &self.prior, &self.visibility, &self.target],
            1,
        )
    }

    /// From [`BlendInput::planes`] of `k` candidates.
    pub fn of_planes(planes: &Tensor, k: usize) -> Self {
        let size = planes.size();
        let k = k as i64;
        Self {
            candidates: planes
                .narrow(1, 0, 3 * k)
                .view([size[0], k, 3, size[2], size[3]]),
            prior: planes.narrow(1, 3 * k, k),
            visibility: planes.narrow(1, 4 * k, k),
            target: planes.narrow(1, 5 * k, size[1] - 5 * k),
        }
    }

    /// [B, 3, H, W]: plain image-based rendering with the prior's weights.
    pub fn prior_blend(&self) -> Tensor {
        (&self.candidates * self.prior.unsqueeze(2)).sum_dim_intlist([1i64].as_slice(), false, KEEP)
    }
}

/// Channels of [`BlendInput::target`]: position 3, normal 3, effects 3, coverage 1.
pub const TARGET_CHANNELS: i64 = 10;
/// Logit with which the generated layer starts: 2 % where some view sees the pixel, all where none does.
const GENERATED_LOGIT: f64 = -4.0;

/// `CompositionNet` of preset `standard`.
#[derive(Debug)]
pub struct BlendComposition {
    k: i64,
    stem: Conv,
    down: Vec<(Conv, Conv)>,
    up: Vec<(Conv, Conv)>,
    head: Conv,
}

/// Channels of [`BlendComposition`] at full resolution; the levels below have 1.5, 2 and 3 times as many.
pub const BLEND_WIDTH: i64 = 32;
/// What [`BLEND_WIDTH`] may be: even, or the levels below have no whole number.
pub const BLEND_WIDTHS: std::ops::RangeInclusive<i64> = 4..=128;

impl BlendComposition {
    /// The weight from whose shape, [`width`, ., 3, 3], the width is known.
    pub const STEM: &str = "composition.stem.weight";

    /// Registers the network's tensors for `k` candidates; `width` is even.
    pub fn new(builder: &mut Builder, k: usize, width: i64) -> Self {
        let k = k as i64;
        let w = [width, width * 3 / 2, width * 2, width * 3];
        builder.scope("composition", |b| {
            let stem = Conv::new(b, "stem", (5 * k + 3 + TARGET_CHANNELS, w[0]), (3, 1, 1));
            let down = (1..w.len())
                .map(|i| {
                    let first = Conv::new(b, &format!("down{i}a"), (w[i - 1], w[i]), (4, 2, 1));
                    (
                        first,
                        Conv::new(b, &format!("down{i}b"), (w[i], w[i]), (3, 1, 1)),
                    )
                })
                .collect();
            let up = (1..w.len())
                .rev()
                .map(|i| {
                    let first = Conv::new(b, &format!("up{i}a"), (w[i], w[i - 1]), (3, 1, 1));
                    (
                        first,
                        Conv::new(b, &format!("up{i}b"), (2 * w[i - 1], w[i - 1]), (3, 1, 1)),
                    )
                })
                .collect();
            // Its logits decide between views: a rounding to bfloat16 shows.
            let head = b.exact(|b| {
                Conv::with_init(b, "head", (w[0], k + 4), (3, 1, 1), Init::Constant(0.0))
            });
            Self {
                k,
                stem,
                down,
                up,
                head,
            }
        })
    }

    /// -> [B, 3, H, W], encoded sRGB, in [0, 1] up to the generated layer's small overshoot. Layers compute in the kind of
    /// `params`, colours are blended in that of `input`.
    ///
    /// # Panics
    /// When the input's tensors do not have the shapes that [`BlendInput`] names.
    pub fn forward(&self, params: &Params, input: &BlendInput) -> Tensor {
        let base = input.prior_blend();
        let size = input.candidates.size();
        let (batch, height, width) = (size[0], size[3], size[4]);
        // Candidates are shown as differences from the plain blend: that is what the weights act on.
        let differences = (&input.candidates - base.unsqueeze(1))
            * input
                .visibility
                .gt(0.0)
                .to_kind(input.candidates.kind())
                .unsqueeze(2);
        let x = Tensor::cat(
            &[
                differences.reshape([batch, self.k * 3, height, width]) * 4.0,
                base.shallow_clone(),
                input.prior.shallow_clone(),
                input.visibility.shallow_clone(),
                input.target.shallow_clone(),
            ],
            1,
        );
        let step = 1i64 << self.down.len();
        let pad = |n: i64| (step - n % step) % step;
        let x = x.constant_pad_nd([0, pad(width), 0, pad(height)]);
        let x = laid_out(params, &x.to_kind(params.kind()));
        let mut x = activate(&self.stem.forward(params, &x));
        let mut skips = Vec::new();
        for (first, second) in &self.down {
            skips.push(x.shallow_clone());
            x = activate(&first.forward(params, &x));
            x = &x + activate(&second.forward(params, &x));
        }
        for (first, second) in &self.up {
            let skip = skips.pop().expect("one skip per level");
            let (_, _, h, w) = skip.size4().expect("[B, C, H, W]");
            let grown = first
                .forward(params, &x)
                .upsample_nearest2d([h, w], None, None);
            x = activate(&second.forward(params, &Tensor::cat(&[activate(&grown), skip], 1)));
        }
        let out = self
            .head
            .forward(params, &x)
            .narrow(2, 0, height)
            .narrow(3, 0, width)
            .to_kind(input.candidates.kind())
            .contiguous();
        let seen = input.visibility.gt(0.0).to_kind(input.candidates.kind());
        let logits = (&input.prior + 1e-4).log() + out.narrow(1, 0, self.k) + (seen - 1.0) * 1e4;
        let generated_logit = out.narrow(1, self.k, 1) + GENERATED_LOGIT;
        let weights = Tensor::cat(&[logits, generated_logit], 1).softmax(1, KEEP);
        let generated = &base + out.narrow(1, self.k + 1, 3);
        let blended = (&input.candidates * weights.narrow(1, 0, self.k).unsqueeze(2))
            .sum_dim_intlist([1i64].as_slice(), false, KEEP);
        blended + generated * weights.narrow(1, self.k, 1)
    }
}

fn activate(x: &Tensor) -> Tensor {
    leaky_relu(x, 0.1)
}
