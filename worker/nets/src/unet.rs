//! The encoder-decoder that both networks of the paper share (Sec. "EffectsNet", "CompositionNet").
//!
//! Six 4x4 convolutions of stride 2 down, six transposed 4x4 convolutions of stride 2 up "with the same number of
//! feature channels as in the respective encoder layer", skip connections by concatenation, batch normalisation after
//! each, a last 4x4 convolution of stride 1 and a sigmoid. With the widths of the paper this gives 6.35 M parameters
//! for `EffectsNet` and 5.2 M for `CompositionNet`.

use crate::params::{Builder, Init, ParamId, Params};
use tch::{Device, Tensor};

/// Batch normalisation with running statistics.
#[derive(Debug)]
pub struct BatchNorm {
    weight: ParamId,
    bias: ParamId,
    mean: ParamId,
    variance: ParamId,
}

impl BatchNorm {
    /// Registers scale, shift and statistics of `channels` channels.
    pub fn new(builder: &mut Builder, name: &str, channels: i64) -> Self {
        builder.scope(name, |b| Self {
            weight: b.param("weight", &[channels], Init::Constant(1.0)),
            bias: b.param("bias", &[channels], Init::Constant(0.0)),
            mean: b.buffer("running_mean", &[channels], 0.0),
            variance: b.buffer("running_var", &[channels], 1.0),
        })
    }

    /// x: [B, C, H, W]. In training the batch's statistics normalise and move the running ones by 0.1.
    pub fn forward(&self, params: &Params, x: &Tensor, train: bool) -> Tensor {
        // One value per channel has no variance: use the running statistics there, as evaluation does.
        let size = x.size();
        let batch_statistics = train && size[0] * size[2] * size[3] > 1;
        x.batch_norm(
            Some(params.get(self.weight)),
            Some(params.get(self.bias)),
            Some(params.get(self.mean)),
            Some(params.get(self.variance)),
            batch_statistics,
            0.1,
            1e-5,
            true,
        )
    }
}

/// The same values [B, C, H, W] laid out as convolutions of `params` are fastest: on the CPU pixel by pixel, which saves a
/// quarter of a frame; plane by plane where a gradient is wanted, whose pass is slower the other way.
pub(crate) fn laid_out(params: &Params, x: &Tensor) -> Tensor {
    if params.recorded() || params.device() != Device::Cpu {
        return x.shallow_clone();
    }
    x.permute([0, 2, 3, 1]).contiguous().permute([0, 3, 1, 2])
}

/// max(x, slope x) for a slope in [0, 1), any shape: one pass over memory in each direction.
pub(crate) fn leaky_relu(x: &Tensor, slope: f64) -> Tensor {
    // torch's own function has a fixed slope in tch. Its derivative scales one tensor where another is negative: of the same
    // values twice that is the function itself, differentiable in the first.
    x.detach().leaky_relu_backward(x, slope, false)
}

/// Weight and bias of a convolution.
#[derive(Debug)]
pub struct Conv {
    weight: ParamId,
    bias: ParamId,
    stride: i64,
    padding: i64,
}

impl Conv {
    /// A `kernel` x `kernel` convolution.
    pub fn new(
        builder: &mut Builder,
        name: &str,
        (input, output): (i64, i64),
        (kernel, stride, padding): (i64, i64, i64),
    ) -> Self {
        Self::with_init(
            builder,
            name,
            (input, output),
            (kernel, stride, padding),
            Init::kaiming(input * kernel * kernel),
        )
    }

    /// A convolution whose weights start as told.
    pub fn with_init(
        builder: &mut Builder,
        name: &str,
        (input, output): (i64, i64),
        (kernel, stride, padding): (i64, i64, i64),
        init: Init,
    ) -> Self {
        builder.scope(name, |b| Self {
            weight: b.param("weight", &[output, input, kernel, kernel], init),
            bias: b.param("bias", &[output], Init::Constant(0.0)),
            stride,
            padding,
        })
    }

    /// x: [B, input, H, W] -> [B, output, H', W'], in the kind of the layer's weights.
    pub fn forward(&self, params: &Params, x: &Tensor) -> Tensor {
        let weight = params.get(self.weight);
        x.to_kind(weight.kind()).conv2d(
            weight,
            Some(params.get(self.bias)),
            [self.stride, self.stride],
            [self.padding, self.padding],
            [1, 1],
            1,
        )
    }
}

#[derive(Debug)]
struct UpConv {
    weight: ParamId,
    bias: ParamId,
}

impl UpConv {
    fn new(builder: &mut Builder, name: &str, input: i64, output: i64) -> Self {
        builder.scope(name, |b| Self {
            // Each output value of a stride-2, 4x4 transposed convolution sums input * 4 products.
            weight: b.param("weight", &[input, output, 4, 4], Init::kaiming(input * 4)),
            bias: b.param("bias", &[output], Init::Constant(0.0)),
        })
    }

    fn forward(&self, params: &Params, x: &Tensor) -> Tensor {
        x.conv_transpose2d(
            params.get(self.weight),
            Some(params.get(self.bias)),
            [2, 2],
            [1, 1],
            [0, 0],
            1,
            [1, 1],
        )
    }
}

/// The paper's U-Net.
#[derive(Debug)]
pub struct UNet {
    down: Vec<(Conv, BatchNorm)>,
    up: Vec<(UpConv, BatchNorm)>,
    head: Conv,
    /// Slope of the encoder's activation below zero: 0 is a ReLU.
    encoder_slope: f64,
    levels: u32,
}

impl UNet {
    /// `widths` are the encoder's output channels, first to last.
    pub fn new(
        builder: &mut Builder,
        input: i64,
        widths: &[i64],
        output: i64,
        encoder_slope: f64,
    ) -> Self {
        let mut down = Vec::new();
        let mut channels = input;
        for (level, &width) in widths.iter().enumerate() {
            let conv = Conv::new(
                builder,
                &format!("down{level}"),
                (channels, width),
                (4, 2, 1),
            );
            down.push((
                conv,
                BatchNorm::new(builder, &format!("down{level}_norm"), width),
            ));
            channels = width;
        }
        let mut up = Vec::new();
        for level in (0..widths.len()).rev() {
            let width = widths[level.saturating_sub(1)];
            let conv = UpConv::new(builder, &format!("up{level}"), channels, width);
            up.push((
                conv,
                BatchNorm::new(builder, &format!("up{level}_norm"), width),
            ));
            channels = if level == 0 { width } else { width * 2 };
        }
        let head = Conv::new(builder, "head", (channels, output), (4, 1, 0));
        Self {
            down,
            up,
            head,
            encoder_slope,
            levels: widths.len() as u32,
        }
    }

    /// x: [B, input, H, W], any H and W -> [B, output, H, W] before the last activation.
    ///
    /// Sizes that the strides do not divide are padded with zeros at the right and bottom and cut again.
    ///
    /// # Panics
    /// When `x` has not four dimensions.
    pub fn forward(&self, params: &Params, x: &Tensor, train: bool) -> Tensor {
        let (_, _, height, width) = x.size4().expect("a U-Net takes [B, C, H, W]");
        let step = 1i64 << self.levels;
        let pad = |n: i64| (step - n % step) % step;
        let mut x = laid_out(params, &x.constant_pad_nd([0, pad(width), 0, pad(height)]));
        let mut skips = Vec::new();
        for (conv, norm) in &self.down {
            x = norm.forward(params, &conv.forward(params, &x), train);
            x = leaky_relu(&x, self.encoder_slope);
            skips.push(x.shallow_clone());
        }
        skips.pop();
        for (conv, norm) in &self.up {
            x = norm
                .forward(params, &conv.forward(params, &x), train)
                .relu();
            if let Some(skip) = skips.pop() {
                x = Tensor::cat(&[x, skip], 1);
            }
        }
        // A 4x4 kernel has no centre: one row and column more after than before keeps the size.
        let x = self.head.forward(params, &x.constant_pad_nd([1, 2, 1, 2]));
        x.narrow(2, 0, height).narrow(3, 0, width).contiguous()
    }
}
