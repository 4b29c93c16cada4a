//! The conditional discriminator of Pix2Pix (Isola et al. 2017), which the paper's adversarial loss uses.
//!
//! The 70x70 variant: C64-C128-C256-C512 and a last convolution to one value per patch; 2.8 M parameters.

use crate::params::{Builder, Params};
use crate::unet::{BatchNorm, Conv, leaky_relu};
use tch::Tensor;

/// `PatchGAN` discriminator.
#[derive(Debug)]
pub struct PatchGan {
    layers: Vec<(Conv, Option<BatchNorm>)>,
    head: Conv,
}

impl PatchGan {
    /// `input` counts the condition's channels plus the image's 3.
    pub fn new(builder: &mut Builder, input: i64) -> Self {
        let mut layers = Vec::new();
        let mut channels = input;
        for (index, (width, stride)) in [(64, 2), (128, 2), (256, 2), (512, 1)]
            .into_iter()
            .enumerate()
        {
            let conv = Conv::new(
                builder,
                &format!("conv{index}"),
                (channels, width),
                (4, stride, 1),
            );
            let norm = (index > 0).then(|| BatchNorm::new(builder, &format!("norm{index}"), width));
            layers.push((conv, norm));
            channels = width;
        }
        Self {
            layers,
            head: Conv::new(builder, "head", (channels, 1), (4, 1, 1)),
        }
    }

    /// condition: [B, C, H, W], image: [B, 3, H, W] in [0, 1] -> logits [B, 1, h, w]; H and W at least 32.
    pub fn forward(
        &self,
        params: &Params,
        condition: &Tensor,
        image: &Tensor,
        train: bool,
    ) -> Tensor {
        let mut x = Tensor::cat(&[condition, image], 1);
        for (conv, norm) in &self.layers {
            x = conv.forward(params, &x);
            if let Some(norm) = norm {
                x = norm.forward(params, &x, train);
            }
            x = leaky_relu(&x, 0.2);
        }
        self.head.forward(params, &x)
    }
}
