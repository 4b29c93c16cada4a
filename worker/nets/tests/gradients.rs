//! The gradients of the warp, of each loss and of the networks behind them against central differences, in f64.
//!
//! A step of 1e-6 on values of size 1 leaves a rounding error of about 1e-10 and a curvature error below 1e-9: bounds
//! of 1e-6, relative to the largest entry, are far above both and far below any wrong term.

use glam::DVec3;
use ign_geometry::{Camera, CameraIntrinsics, GBuffer, Mesh};
use ign_nets::composition::{BlendComposition, BlendInput, PaperComposition, TARGET_CHANNELS};
use ign_nets::effects::{PaperEffects, PointEffects};
use ign_nets::losses::{self, Pair};
use ign_nets::params::{Builder, Params};
use ign_nets::patchgan::PatchGan;
use ign_nets::warp::{Sources, Taps, directions};
use ign_nets::{color, warp};
use tch::{Device, Kind, Tensor, no_grad};

const F64: (Kind, Device) = (Kind::Double, Device::Cpu);
const STEP: f64 = 1e-6;
const BOUND: f64 = 1e-6;

/// Compares the gradient of `f` at `x` with central differences, at `samples` entries spread over `x`.
fn check(name: &str, x: &Tensor, samples: usize, f: &dyn Fn(&Tensor) -> Tensor) {
    let leaf = x.detach().copy().set_requires_grad(true);
    let value = f(&leaf);
    assert_eq!(value.kind(), Kind::Double, "{name} leaves f64");
    value.backward();
    let exact: Vec<f64> = Vec::try_from(leaf.grad().reshape([-1])).expect("f64 values");
    let scale = exact.iter().fold(1e-3_f64, |most, g| most.max(g.abs()));
    let moved = |at: usize, by: f64| {
        let y = x.detach().copy();
        drop(y.view([-1]).get(at as i64).g_add_scalar_(by));
        no_grad(|| f(&y)).double_value(&[])
    };
    let mut moving = 0;
    let stride = (exact.len() / samples.max(1)).max(1);
    for at in (0..exact.len()).step_by(stride) {
        let numeric = (moved(at, STEP) - moved(at, -STEP)) / (2.0 * STEP);
        let difference = (numeric - exact[at]).abs();
        assert!(
            difference < BOUND * scale,
            "{name}, entry {at}: {numeric} by differences, {} by autograd",
            exact[at]
        );
        moving += usize::from(exact[at].abs() > BOUND * scale);
    }
    assert!(moving > 0, "{name}: no entry has a gradient");
}

/// The same for a network's parameters: `f` maps them to a scalar.
fn check_params(name: &str, params: &Params, samples: usize, f: &dyn Fn(&Params) -> Tensor) {
    let flat = params.flat().to_kind(Kind::Double);
    let leaf = params.with_flat(&flat);
    let exact: Vec<f64> = Vec::try_from(leaf.gradient(&f(&leaf))).expect("f64 values");
    let scale = exact.iter().fold(1e-3_f64, |most, g| most.max(g.abs()));
    let moved = |at: usize, by: f64| {
        let y = flat.copy();
        drop(y.get(at as i64).g_add_scalar_(by));
        no_grad(|| f(&params.with_flat(&y))).double_value(&[])
    };
    let stride = (exact.len() / samples).max(1);
    let mut moving = 0;
    for at in (stride / 2..exact.len()).step_by(stride) {
        let numeric = (moved(at, STEP) - moved(at, -STEP)) / (2.0 * STEP);
        assert!(
            (numeric - exact[at]).abs() < BOUND * scale,
            "{name}, parameter {at}: {numeric} by differences, {} by autograd",
            exact[at]
        );
        moving += usize::from(exact[at].abs() > BOUND * scale);
    }
    assert!(moving > 0, "{name}: no parameter has a gradient");
}

fn random(shape: &[i64]) -> Tensor {
    // Away from 0 and 1, where clamps and absolute values have their kinks.
    Tensor::rand(shape, F64) * 0.7 + 0.1
}

fn unit(shape: &[i64]) -> Tensor {
    let v = Tensor::randn(shape, F64);
    &v / v
        .square()
        .sum_dim_intlist([1i64].as_slice(), true, None::<Kind>)
        .sqrt()
}

fn mse(a: &Tensor, b: &Tensor) -> Tensor {
    (a - b).square().mean(None::<Kind>)
}

/// Taps of one asymmetric view into another: some points seen whole, some in part, some not at all.
fn taps() -> (Taps, i64) {
    let (rows, columns) = (24u32, 32u32);
    let mut positions = Vec::new();
    for row in 0..=rows {
        for column in 0..columns {
            let theta = std::f64::consts::PI * f64::from(row) / f64::from(rows);
            let phi = std::f64::consts::TAU * f64::from(column) / f64::from(columns);
            let radius = 0.8 + 0.15 * (3.0 * phi).sin() * theta.sin();
            let direction = DVec3::new(
                theta.sin() * phi.cos(),
                theta.sin() * phi.sin(),
                theta.cos(),
            );
            positions.push(direction * radius);
        }
    }
    let at = |r: u32, c: u32| r * columns + c % columns;
    let triangles = (0..rows)
        .flat_map(|r| (0..columns).map(move |c| (r, c)))
        .flat_map(|(r, c)| {
            [
                [at(r, c), at(r + 1, c), at(r + 1, c + 1)],
                [at(r, c), at(r + 1, c + 1), at(r, c + 1)],
            ]
        })
        .collect();
    let mesh = Mesh::new(positions, triangles).expect("a mesh");
    let view = |eye: DVec3| {
        let intrinsics = CameraIntrinsics {
            fx: 31.0,
            fy: 28.0,
            cx: 9.3,
            cy: 6.8,
            width: 20,
            height: 15,
        };
        let camera = Camera::look_at(intrinsics, eye, DVec3::ZERO, DVec3::new(0.1, 0.2, 1.0));
        GBuffer::render(&mesh, &camera.expect("a camera"), 1)
    };
    let (source, target) = (
        view(DVec3::new(2.1, 0.9, 0.7)),
        view(DVec3::new(1.2, 1.9, 0.2)),
    );
    let pick = |values: &[[f32; 3]]| {
        let flat: Vec<f32> = values
            .iter()
            .zip(&target.mask)
            .filter(|(_, seen)| **seen)
            .flat_map(|(v, _)| *v)
            .collect();
        Tensor::from_slice(&flat).view([-1, 3])
    };
    let (points, normals) = (pick(&target.position), pick(&target.normal));
    let view = Tensor::zeros([points.size()[0]], (Kind::Int64, Device::Cpu));
    let taps =
        Sources::new(&[source.camera], &source.depth, Device::Cpu).taps(&points, &normals, &view);
    let seen = taps.visibility.sum(Kind::Double).double_value(&[]);
    assert!(seen > 20.0 && seen < 0.95 * points.size()[0] as f64);
    (taps, 20 * 15)
}

#[test]
fn of_the_warp() {
    tch::manual_seed(31);
    let (taps, pixels) = taps();
    let image = random(&[pixels, 3]);
    let alpha = random(&[pixels]);
    let wanted = random(&[taps.index.size()[0], 3]);
    check("warp by its image", &image, 300, &|image| {
        mse(&taps.gather(image), &wanted)
    });
    let warped = |image: &Tensor, alpha: &Tensor| {
        let taps = taps.weighted(alpha);
        let visibility = taps.visibility.clamp_min(1e-3).unsqueeze(1);
        taps.gather(image) / visibility
    };
    check("weighted warp by its image", &image, 300, &|image| {
        mse(&warped(image, &alpha), &wanted)
    });
    check("weighted warp by its weights", &alpha, 300, &|alpha| {
        mse(&warped(&image, alpha), &wanted)
    });
    // The way the paper's EffectsNet is trained: what is removed from the source goes through the warp.
    let visible = taps.visibility.gt(0.5).to_kind(Kind::Double).unsqueeze(1);
    check("warp into the paper's loss", &image, 300, &|effects| {
        let diffuse = &image - effects * 0.5;
        losses::diffuse_distance(&taps.gather(&diffuse), &wanted, &visible)
    });
}

#[test]
fn of_each_loss() {
    tch::manual_seed(32);
    let (a, b) = (random(&[2, 3, 4, 5]), random(&[2, 3, 4, 5]));
    let coverage = random(&[2, 1, 4, 5]);
    check("blend", &a, 120, &|a| losses::blend(a, &b, &coverage));
    check("blend by coverage", &coverage, 40, &|coverage| {
        losses::blend(&(&a * coverage), &b, coverage)
    });
    check("l1", &a, 120, &|a| losses::l1(a, &b));
    check("sparsity", &a, 120, &losses::sparsity);
    check("adversarial, generated", &a, 120, &|a| {
        losses::adversarial(&(a * 6.0 - 3.0), false)
    });
    check("adversarial, real", &a, 120, &|a| {
        losses::adversarial(&(a * 6.0 - 3.0), true)
    });
    check("linear from sRGB", &a, 120, &|a| {
        mse(&color::linear_from_srgb(a), &b)
    });
    check("sRGB from linear", &a, 120, &|a| {
        mse(&color::srgb_from_linear(a), &b)
    });
    let (p, q) = (random(&[40, 3]), random(&[40, 3]));
    let visible = Tensor::rand([40, 1], F64).gt(0.4).to_kind(Kind::Double);
    check("diffuse distance", &p, 120, &|p| {
        losses::diffuse_distance(p, &q, &visible)
    });
    check("diffuse distance by the other", &q, 120, &|q| {
        losses::diffuse_distance(&p, q, &visible)
    });
    // Some observations are clipped: they must not pull at what they predict.
    let bright = &p + Tensor::rand([40, 3], F64).gt(0.8).to_kind(Kind::Double);
    let (here, there) = (random(&[40, 3]) * 0.1, random(&[40, 3]) * 0.1);
    let pair = |here: &Tensor, there: &Tensor| {
        losses::pair(&Pair {
            color_here: &bright,
            color_there: &q,
            effects_here: here,
            effects_there: there,
            sound: &visible,
        })
    };
    check("pair by effects here", &here, 120, &|x| pair(x, &there));
    check("pair by effects there", &there, 120, &|x| pair(&here, x));
}

#[test]
fn of_losses_at_black_white_and_equal_images_are_finite() {
    let coverage = Tensor::ones([1, 1, 3, 4], F64);
    for (a, b) in [(0.0, 0.0), (1.0, 1.0), (0.0, 1.0), (1.0, 0.0), (0.5, 0.5)] {
        let truth = Tensor::full([1, 3, 3, 4], b, F64);
        let rows = |t: &Tensor| t.view([3, 12]).tr();
        for coverage in [&coverage, &coverage.zeros_like()] {
            let leaf = Tensor::full([1, 3, 3, 4], a, F64).set_requires_grad(true);
            let (image, weight) = (rows(&leaf), coverage.view([12, 1]));
            let loss = losses::blend(&leaf, &truth, coverage)
                + losses::l1(&leaf, &truth)
                + losses::diffuse_distance(&image, &rows(&truth), &weight)
                + losses::adversarial(&leaf, true)
                + losses::pair(&Pair {
                    color_here: &rows(&truth),
                    color_there: &rows(&truth),
                    effects_here: &image,
                    effects_there: &(&image * 2.0),
                    sound: &weight,
                });
            loss.backward();
            assert!(loss.double_value(&[]).is_finite(), "{a} against {b}");
            let finite = leaf.grad().isfinite().all().int64_value(&[]);
            assert_eq!(finite, 1, "gradient of {a} against {b}");
        }
    }
}

#[test]
fn of_the_networks() {
    tch::manual_seed(33);
    let (points, normals) = (Tensor::randn([30, 3], F64) * 0.4, unit(&[30, 3]));
    let to_viewer = directions(&Tensor::randn([1, 3], F64), &points);
    check("reflections", &normals, 90, &|n| {
        mse(&warp::reflections(&to_viewer, n), &points)
    });
    let mut builder = Builder::new();
    let effects = PointEffects::new(&mut builder);
    let params = builder.build(Device::Cpu, 3);
    let wanted = random(&[30, 3]);
    check_params("point effects", &params, 150, &|params| {
        mse(
            &effects.forward(params, &points, &normals, &to_viewer),
            &wanted,
        )
    });

    let mut builder = Builder::new();
    let blend = BlendComposition::new(&mut builder, 3, 8);
    let params = builder.build(Device::Cpu, 4);
    // The head starts at zero, behind which nothing would have a gradient.
    no_grad(|| {
        let noise = params.flat().randn_like() * 0.03;
        drop(params.flat().shallow_clone().g_add_(&noise));
    });
    let visibility = Tensor::rand([1, 3, 8, 16], F64)
        .gt(0.3)
        .to_kind(Kind::Double);
    let prior = Tensor::rand([1, 3, 8, 16], F64) * &visibility;
    let sum = prior.sum_dim_intlist([1i64].as_slice(), true, None::<Kind>);
    let input = BlendInput {
        candidates: random(&[1, 3, 3, 8, 16]) * visibility.unsqueeze(2),
        prior: prior / sum.clamp_min(1e-6),
        visibility,
        target: random(&[1, TARGET_CHANNELS, 8, 16]),
    };
    let truth = random(&[1, 3, 8, 16]);
    let coverage = random(&[1, 1, 8, 16]);
    check_params("blending head", &params, 150, &|params| {
        losses::blend(
            &(blend.forward(params, &input) * &coverage),
            &truth,
            &coverage,
        )
    });
    // Through candidates that learned effects have gone into.
    let exact = params.with_flat(&params.flat().to_kind(Kind::Double));
    check(
        "blending head by its candidates",
        &input.candidates,
        150,
        &|candidates| {
            let input = BlendInput {
                candidates: candidates.shallow_clone(),
                prior: input.prior.shallow_clone(),
                visibility: input.visibility.shallow_clone(),
                target: input.target.shallow_clone(),
            };
            losses::blend(
                &(blend.forward(&exact, &input) * &coverage),
                &truth,
                &coverage,
            )
        },
    );

    let geometry = random(&[1, 9, 64, 64]);
    let wanted = random(&[1, 3, 64, 64]);
    let mut builder = Builder::new();
    let net = PaperEffects::new(&mut builder);
    let params = builder.build(Device::Cpu, 5);
    check_params("the paper's EffectsNet", &params, 12, &|params| {
        mse(&net.forward(params, &geometry, true), &wanted)
    });
    let stack = random(&[1, PaperComposition::input_channels(2), 64, 64]);
    let mut builder = Builder::new();
    let net = PaperComposition::new(&mut builder, PaperComposition::input_channels(2));
    let params = builder.build(Device::Cpu, 6);
    check_params("the paper's CompositionNet", &params, 12, &|params| {
        mse(&net.forward(params, &stack, true), &wanted)
    });
    let mut builder = Builder::new();
    let net = PatchGan::new(&mut builder, 12);
    let params = builder.build(Device::Cpu, 7);
    check_params("PatchGAN", &params, 12, &|params| {
        losses::adversarial(&net.forward(params, &geometry, &wanted, true), true)
    });
    // What the generator learns from: l1 to the photograph, and a discriminator that takes its image for one.
    let params = params.with_flat(&params.flat().to_kind(Kind::Double));
    check(
        "l1 and GAN loss by the generated image",
        &wanted,
        60,
        &|image| {
            losses::l1(image, &(&wanted * 0.9 + 0.02))
                + losses::adversarial(&net.forward(&params, &geometry, image, false), true) * 0.01
        },
    );
}
