//! What the networks promise: the paper's sizes, a start at plain blending, no dependence on framing, finite output.

use ign_nets::Builder;
use ign_nets::composition::{
    BLEND_WIDTH, BlendComposition, BlendInput, PaperComposition, TARGET_CHANNELS,
};
use ign_nets::effects::{PaperEffects, PointEffects};
use ign_nets::patchgan::PatchGan;
use tch::{Device, Kind, Tensor, no_grad};

const CPU: (Kind, Device) = (Kind::Float, Device::Cpu);

#[test]
fn parameter_counts_are_the_papers() {
    let count = |register: &dyn Fn(&mut Builder)| {
        let mut builder = Builder::new();
        register(&mut builder);
        builder.build(Device::Cpu, 0).count() as f64
    };
    let close = |count: f64, expected: f64| (count / expected - 1.0).abs() < 0.01;
    assert!(close(count(&|b| drop(PaperEffects::new(b))), 6.35e6));
    assert!(close(
        count(&|b| drop(PaperComposition::new(
            b,
            PaperComposition::input_channels(4)
        ))),
        5.2e6
    ));
    assert!(close(count(&|b| drop(PatchGan::new(b, 26))), 2.79e6));
}

#[test]
fn paper_networks_take_any_size() {
    tch::manual_seed(1);
    let mut builder = Builder::new();
    let net = PaperComposition::new(&mut builder, PaperComposition::input_channels(4));
    let params = builder.build(Device::Cpu, 3);
    for (h, w) in [(64, 64), (70, 101), (17, 33)] {
        let out = no_grad(|| net.forward(&params, &Tensor::rand([1, 23, h, w], CPU), false));
        assert_eq!(out.size(), [1, 3, h, w]);
        assert!(out.min().double_value(&[]) >= 0.0 && out.max().double_value(&[]) <= 1.0);
    }
}

fn blend_input(size: i64, k: i64) -> BlendInput {
    tch::manual_seed(5);
    let visibility = Tensor::rand([1, k, size, size], CPU)
        .gt(0.3)
        .to_kind(Kind::Float);
    let raw = Tensor::rand([1, k, size, size], CPU) * &visibility;
    let prior = &raw
        / raw
            .sum_dim_intlist([1i64].as_slice(), true, Kind::Float)
            .clamp_min(1e-6);
    BlendInput {
        candidates: Tensor::rand([1, k, 3, size, size], CPU) * visibility.unsqueeze(2),
        prior,
        visibility,
        target: Tensor::rand([1, TARGET_CHANNELS, size, size], CPU),
    }
}

#[test]
fn blending_starts_at_plain_blending() {
    let input = blend_input(64, 4);
    let mut builder = Builder::new();
    let net = BlendComposition::new(&mut builder, 4, BLEND_WIDTH);
    let params = builder.build(Device::Cpu, 11);
    let out = no_grad(|| net.forward(&params, &input));
    let difference = (out - input.prior_blend()).abs().max().double_value(&[]);
    // The floor under the prior's logarithm lets unused views in by 1e-4 each.
    assert!(difference < 1e-3, "{difference}");
}

/// Gives the head weights, or nothing behind it would show.
fn shake(params: &ign_nets::Params) {
    tch::manual_seed(9);
    no_grad(|| {
        let flat = params.flat();
        let noise = Tensor::randn_like(flat) * 0.02;
        drop(flat.shallow_clone().g_add_(&noise));
    });
}

#[test]
fn a_crop_and_the_full_frame_agree() {
    let input = blend_input(320, 4);
    let mut builder = Builder::new();
    let net = BlendComposition::new(&mut builder, 4, BLEND_WIDTH);
    let params = builder.build(Device::Cpu, 11);
    shake(&params);
    // Offsets that the strides divide; the network sees about 60 pixels far.
    let (full, part) = no_grad(|| {
        (
            net.forward(&params, &input),
            net.forward(&params, &input.crop(48, 64, 208, 224)),
        )
    });
    let inner = |t: &Tensor, y: i64, x: i64| t.narrow(2, y, 48).narrow(3, x, 48);
    let difference = (inner(&full, 48 + 80, 64 + 80) - inner(&part, 80, 80))
        .abs()
        .max()
        .double_value(&[]);
    assert!(difference < 1e-5, "{difference}");
}

#[test]
fn nothing_visible_gives_a_finite_image() {
    let mut input = blend_input(32, 4);
    input.visibility = input.visibility.zeros_like();
    input.prior = input.prior.zeros_like();
    input.candidates = input.candidates.zeros_like();
    let mut builder = Builder::new();
    let net = BlendComposition::new(&mut builder, 4, BLEND_WIDTH);
    let params = builder.build(Device::Cpu, 2);
    shake(&params);
    let out = net.forward(&params, &input);
    assert_eq!(out.isfinite().all().int64_value(&[]), 1);
    let gradient = params.gradient(&out.sum(Kind::Float));
    assert_eq!(gradient.isfinite().all().int64_value(&[]), 1);
}

#[test]
fn point_effects_are_finite_and_not_negative() {
    let mut builder = Builder::new();
    let net = PointEffects::new(&mut builder);
    let params = builder.build(Device::Cpu, 2);
    let points = Tensor::randn([64, 3], CPU);
    let unit = |t: Tensor| {
        &t / t
            .square()
            .sum_dim_intlist([1i64].as_slice(), true, Kind::Float)
            .sqrt()
    };
    let effects = net.forward(
        &params,
        &points,
        &unit(Tensor::randn([64, 3], CPU)),
        &unit(Tensor::randn([64, 3], CPU)),
    );
    assert_eq!(effects.size(), [64, 3]);
    assert!(effects.min().double_value(&[]) >= 0.0);
    assert_eq!(effects.isfinite().all().int64_value(&[]), 1);
}
