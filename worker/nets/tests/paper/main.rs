//! The paper's networks, losses and training steps against an independent `PyTorch` implementation (`reference.py`).
//!
//! Inputs and weights come from a formula that both sides compute; `expected.safetensors` holds, in f64, the norm of each
//! result and some of its entries. Forward passes are compared in f32, as they run: sums of some thousand products round
//! to about 1e-6. Gradients and steps are compared in f64: Adam divides a gradient by its own size, and rounding of the
//! smallest ones in f32 would become steps of full length.

use std::collections::BTreeMap;

use ign_nets::composition::PaperComposition;
use ign_nets::effects::PaperEffects;
use ign_nets::optim::Trainee;
use ign_nets::params::{Builder, Params, flat_values};
use ign_nets::patchgan::PatchGan;
use ign_nets::steps::{self, Gan, GanExample, RATE, SiamesePair};
use ign_nets::warp::Taps;
use safetensors::SafeTensors;
use tch::{Device, Kind, Tensor, no_grad};

const BATCH: i64 = 2;
const HEIGHT: i64 = 64;
const WIDTH: i64 = 128;
const K: usize = 4;
const STEPS: usize = 3;
const POINTS: i64 = 3000;
/// Entries kept of each tensor, and of each image.
const SAMPLES: usize = 24;
const IMAGE_SAMPLES: usize = 500;

/// Of values, whose size is about 1.
const FORWARD: f64 = 1e-5;
/// Of gradients, relative to the largest of their tensor, rounded to f32 once.
const GRADIENT: f64 = 1e-6;
/// Gradients below this are rounding: a bias changes nothing where a normalisation follows.
const NO_GRADIENT: f64 = 1e-12;
/// Of weights after three steps of at most 1e-3 each, rounded to f32 once.
const TRAINED: f64 = 1e-6;

/// Uniform in [low, high): splitmix64 of FNV-1a of the name plus the entry's number, its upper 24 bits.
fn stream(name: &str, count: i64, low: f32, high: f32) -> Vec<f32> {
    let seed = name.bytes().fold(0xcbf2_9ce4_8422_2325_u64, |state, byte| {
        (state ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3)
    });
    (1..=count as u64)
        .map(|at| {
            let z = seed.wrapping_add(at.wrapping_mul(0x9e37_79b9_7f4a_7c15));
            let z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
            let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
            let unit = ((z ^ (z >> 31)) >> 40) as f32 / (1 << 24) as f32;
            low + unit * (high - low)
        })
        .collect()
}

fn tensor(name: &str, shape: &[i64], low: f32, high: f32) -> Tensor {
    Tensor::from_slice(&stream(name, shape.iter().product(), low, high)).view(shape)
}

/// Pixel numbers.
fn pixels(name: &str, shape: &[i64]) -> Tensor {
    tensor(name, shape, 0.0, (HEIGHT * WIDTH) as f32).to_kind(Kind::Int64)
}

fn double(tensor: &Tensor) -> Tensor {
    tensor.to_kind(Kind::Double)
}

/// A copy of a network in f64, untrained.
fn trainee(params: &Params) -> Trainee {
    Trainee::new(params.with_flat(&double(params.flat())), 0.0)
}

/// A network with values of the formula.
fn filled(builder: Builder) -> Params {
    let mut params = builder.build(Device::Cpu, 0);
    let values: BTreeMap<String, (Vec<i64>, Vec<f32>)> = params
        .export()
        .into_iter()
        .map(|(name, shape, values)| {
            let count = values.len() as i64;
            let (low, high) = if shape.len() > 1 {
                let bound = (6.0 / (count / shape[0]) as f64).sqrt() as f32;
                (-bound, bound)
            } else if name.contains("norm") && name.ends_with("weight")
                || name.ends_with("running_var")
            {
                (0.75, 1.25)
            } else {
                (-0.125, 0.125)
            };
            let values = stream(&name, count, low, high);
            (name, (shape, values))
        })
        .collect();
    params
        .import(|name| values.get(name).map(|(s, v)| (s.as_slice(), v.as_slice())))
        .expect("every tensor is there");
    params
}

fn effects_net() -> (PaperEffects, Params) {
    let mut builder = Builder::new();
    let net = PaperEffects::new(&mut builder);
    (net, filled(builder))
}

fn composition_net() -> (PaperComposition, Params) {
    let mut builder = Builder::new();
    let net = PaperComposition::new(&mut builder, PaperComposition::input_channels(K));
    (net, filled(builder))
}

fn discriminator() -> (PatchGan, Params) {
    let mut builder = Builder::new();
    let channels = PaperComposition::input_channels(K) + 3;
    let net = builder.scope("discriminator", |b| PatchGan::new(b, channels));
    (net, filled(builder))
}

/// What the reference computed.
struct Expected {
    file: Vec<u8>,
}

impl Expected {
    fn read() -> Self {
        let path = concat!(
            env!("CARGO_MANIFEST_DIR"),
            "/tests/paper/expected.safetensors"
        );
        Self {
            file: std::fs::read(path).expect("the reference's results"),
        }
    }

    fn tensors(&self) -> SafeTensors<'_> {
        SafeTensors::deserialize(&self.file).expect("safetensors")
    }

    /// Names of a case's tensors.
    fn names(&self, case: &str) -> Vec<String> {
        let names: Vec<String> = self
            .tensors()
            .names()
            .into_iter()
            .filter_map(|name| name.strip_prefix(case)?.strip_prefix('/'))
            .map(str::to_owned)
            .collect();
        assert!(!names.is_empty(), "{case} is not in the reference");
        names
    }

    /// Compares the norm and the kept entries, at even steps from the first.
    fn check(&self, name: &str, found: &[f32], bound: f64) {
        let tensors = self.tensors();
        let view = tensors.tensor(name).expect("a tensor of the reference");
        let values: Vec<f64> = view
            .data()
            .chunks_exact(8)
            .map(|b| f64::from_le_bytes(b.try_into().expect("8 bytes")))
            .collect();
        let (norm, entries) = values.split_first().expect("a norm");
        let samples = if name.starts_with("forward") {
            IMAGE_SAMPLES
        } else {
            SAMPLES
        };
        let stride = (found.len() / samples).max(1);
        let kept: Vec<f32> = found.iter().step_by(stride).copied().collect();
        assert_eq!(kept.len(), entries.len(), "{name} has another size");
        for (at, (found, expected)) in kept.iter().zip(entries).enumerate() {
            let difference = (f64::from(*found) - expected).abs();
            assert!(
                difference <= bound,
                "{name}, entry {}: {found}, expected {expected}",
                at * stride
            );
        }
        let found_norm = found
            .iter()
            .map(|&x| f64::from(x).powi(2))
            .sum::<f64>()
            .sqrt();
        // As many errors of at most `bound`.
        let bound = bound * (found.len() as f64).sqrt();
        assert!(
            (found_norm - norm).abs() <= bound,
            "{name}: norm {found_norm}, expected {norm}"
        );
    }

    /// Compares how a loss changes with a network's tensors.
    fn check_gradients(&self, case: &str, params: &Params, loss: &Tensor) {
        let gradients = params.with_flat(&params.gradient(loss)).export();
        for name in self.names(case) {
            let (_, _, values) = find(&gradients, &name);
            let largest = values.iter().fold(0.0_f32, |most, g| most.max(g.abs()));
            let bound = (GRADIENT * f64::from(largest)).max(NO_GRADIENT);
            self.check(&format!("{case}/{name}"), values, bound);
        }
    }

    /// Compares weights and running statistics.
    fn check_state(&self, case: &str, params: &Params) {
        let state = params.export();
        for name in self.names(case) {
            let (_, _, values) = find(&state, &name);
            self.check(&format!("{case}/{name}"), values, TRAINED);
        }
    }
}

fn find<'a>(
    tensors: &'a [(String, Vec<i64>, Vec<f32>)],
    name: &str,
) -> &'a (String, Vec<i64>, Vec<f32>) {
    let found = tensors.iter().find(|(known, _, _)| known == name);
    found.unwrap_or_else(|| panic!("the network has no tensor {name}"))
}

fn geometry() -> Tensor {
    tensor("geometry", &[BATCH, 9, HEIGHT, WIDTH], -1.0, 1.0)
}

fn warped() -> Tensor {
    tensor(
        "warped",
        &[BATCH, PaperComposition::input_channels(K), HEIGHT, WIDTH],
        -1.0,
        1.0,
    )
}

/// An image times its coverage lies between the two kinds of truth: the l1 norm has no kink nearby.
fn truth() -> Tensor {
    let shape = [BATCH, 3, HEIGHT, WIDTH];
    let bright = tensor("bright", &shape, -1.0, 1.0).gt(0.0);
    tensor("truth", &shape, 0.5, 1.0) * bright.to_kind(Kind::Float)
}

#[test]
fn forward_passes_agree() {
    let expected = Expected::read();
    let check = |name: &str, out: &Tensor| {
        expected.check(&format!("forward/{name}"), &flat_values(out), FORWARD);
    };
    no_grad(|| {
        let (net, params) = effects_net();
        check("effects", &net.forward(&params, &geometry(), false));
        let (net, params) = composition_net();
        check("composition", &net.forward(&params, &warped(), false));
        let (net, params) = discriminator();
        check(
            "discriminator",
            &net.forward(&params, &warped(), &truth(), false),
        );
    });
}

#[test]
fn training_of_effects_net_agrees() {
    let expected = Expected::read();
    let colors = double(&tensor("colors", &[2, HEIGHT * WIDTH, 3], 0.0, 1.0));
    let weight = double(&tensor("tap_weights", &[POINTS, 4], 0.0, 0.25));
    let visibility = weight.sum_dim_intlist([1i64].as_slice(), false, Kind::Double);
    let taps = Taps {
        index: pixels("tap_pixels", &[POINTS, 4]),
        facing: visibility.ones_like(),
        grid: visibility.zeros_like(),
        weight,
        visibility,
    };
    let pair = SiamesePair {
        geometry: &double(&geometry()),
        color_p: &colors.get(0),
        color_q: &colors.get(1),
        surface: &pixels("surface", &[POINTS]),
        taps: &taps,
    };
    let (net, params) = effects_net();
    let trainee = trainee(&params);
    let loss = steps::effects_loss(&net, &trainee.params, &pair);
    expected.check_gradients("effects_gradient", &trainee.params, &loss);

    let mut trainee = self::trainee(&params);
    let losses: Vec<f32> = (0..STEPS)
        .map(|_| steps::effects_step(&net, &mut trainee, &pair, RATE) as f32)
        .collect();
    expected.check("losses/effects", &losses, TRAINED);
    expected.check_state("effects_trained", &trainee.params);
}

#[test]
fn training_of_composition_net_agrees() {
    let expected = Expected::read();
    let (net, net_params) = composition_net();
    let (critic, critic_params) = discriminator();
    let gan = Gan {
        generator: &net,
        discriminator: &critic,
    };
    let example = GanExample {
        input: &double(&warped()),
        truth: &double(&truth()),
        coverage: &double(&tensor("coverage", &[BATCH, 1, HEIGHT, WIDTH], 0.0, 0.5)),
    };
    let (generator, mut discriminator) = (trainee(&net_params), trainee(&critic_params));
    let image = gan.image(&generator.params, &example);
    let criticism =
        |discriminator: &Trainee| gan.criticism(&discriminator.params, &example, &image);
    let loss = criticism(&discriminator);
    expected.check_gradients("discriminator_gradient", &discriminator.params, &loss);
    // The generator meets a discriminator that has made its step; the comparison has used the loss up.
    let loss = criticism(&discriminator);
    discriminator.descend(&loss, RATE, f64::INFINITY);
    let loss = gan.loss(&discriminator.params, &example, &image);
    expected.check_gradients("composition_gradient", &generator.params, &loss);

    let (mut generator, mut discriminator) = (trainee(&net_params), trainee(&critic_params));
    let losses: Vec<f32> = (0..STEPS)
        .map(|_| gan.step(&mut generator, &mut discriminator, &example, RATE) as f32)
        .collect();
    expected.check("losses/composition", &losses, TRAINED);
    expected.check_state("composition_trained", &generator.params);
    expected.check_state("discriminator_trained", &discriminator.params);
}
