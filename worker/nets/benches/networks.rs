//! `--views N` training steps (`--work train`) or frames (`--work render`) of one network (`--net NAME`), after two to warm
//! up. With `--export DIR` it writes weights and inputs for the peer instead. `make bench` runs it; `RAYON_NUM_THREADS` is
//! the number of threads.

use std::path::Path;
use std::str::FromStr;
use std::time::Instant;

use glam::DVec3;
use ign_geometry::{Camera, CameraIntrinsics};
use ign_nets::composition::{
    BLEND_WIDTH, BlendComposition, BlendInput, PaperComposition, TARGET_CHANNELS,
};
use ign_nets::effects::{GEOMETRY_CHANNELS, PaperEffects, PointEffects};
use ign_nets::losses;
use ign_nets::optim::Trainee;
use ign_nets::patchgan::PatchGan;
use ign_nets::steps::{self, Descent, Gan, GanExample, Observations, SiamesePair};
use ign_nets::warp::{Sources, Taps};
use ign_nets::{Builder, Params};
use serde_json::json;
use tch::{Device, Kind, Tensor, no_grad};

const CPU: (Kind, Device) = (Kind::Float, Device::Cpu);
const K: usize = 4;
/// Side of the images that the paper's networks train on.
const IMAGE_PX: i64 = 128;
/// Side of the frames.
const FRAME_PX: i64 = 256;
/// Windows of the blending head and their side; pairs of the point effects: what a bake takes.
const WINDOWS: i64 = 8;
const WINDOW_PX: i64 = 32;
const PAIRS: i64 = 8192;
const AVERAGE_DECAY: f64 = 0.995;
/// Surface points of a Siamese pair.
const SURFACE: i64 = 6000;
/// Batches of pairs, in turn.
const BATCHES: i64 = 4;
/// Views of a sphere that the point effects learn from.
const VIEWS: usize = 24;
const RADIUS: f64 = 0.8;
const WARM_UP: usize = 2;
/// Slow enough that both sides agree after many steps on random images: at the paper's rate, 1e-3, these go apart from
/// rounding alone after about ten.
const DESCENT: Descent = Descent {
    rate: 1e-4,
    kind: Kind::Float,
};

/// Names a tensor for the peer.
struct Inputs(Vec<(String, Tensor)>);

impl Inputs {
    fn keep(&mut self, name: &str, tensor: Tensor) -> Tensor {
        self.0.push((name.to_owned(), tensor.contiguous().copy()));
        tensor
    }

    /// Uniform in [low, high).
    fn uniform(&mut self, name: &str, shape: &[i64], low: f64, high: f64) -> Tensor {
        self.keep(name, Tensor::rand(shape, CPU) * (high - low) + low)
    }

    /// A network away from its start, where heads are zero.
    fn network<N>(&mut self, register: impl FnOnce(&mut Builder) -> N) -> (N, Params) {
        let mut builder = Builder::new();
        let net = register(&mut builder);
        let params = builder.build(Device::Cpu, 7);
        no_grad(|| {
            let mut flat = params.flat().shallow_clone();
            flat += flat.randn_like() * 0.01;
        });
        for (name, shape, values) in params.export() {
            self.0
                .push((name, Tensor::from_slice(&values).view(shape.as_slice())));
        }
        (net, params)
    }
}

/// Does the work once, with the number of the turn; a figure of what came out.
type Work = Box<dyn FnMut(usize) -> f64>;

fn main() {
    let (net, work) = (
        argument("--net", String::new()),
        argument("--work", String::new()),
    );
    let variable = std::env::var("RAYON_NUM_THREADS").ok();
    let threads = variable.and_then(|text| text.parse().ok()).unwrap_or(1);
    ign_nets::device::start_threads(threads).expect("nothing has run yet");
    tch::manual_seed(11);
    let mut inputs = Inputs(Vec::new());
    let mut once = match (net.as_str(), work.as_str()) {
        ("paper_effects", "train") => train_paper_effects(&mut inputs),
        ("paper_effects", "render") => render_paper_effects(&mut inputs),
        ("paper_composition", "train") => train_paper_composition(&mut inputs),
        ("paper_composition", "render") => render_paper_composition(&mut inputs),
        ("point_effects", "train") => train_point_effects(&mut inputs),
        ("point_effects", "render") => render_point_effects(&mut inputs),
        ("blend", "train") => train_blend(&mut inputs),
        ("blend", "render") => render_blend(&mut inputs),
        _ => panic!("no work {work:?} of a network {net:?}"),
    };
    let folder: String = argument("--export", String::new());
    if !folder.is_empty() {
        let folder = Path::new(&folder);
        Tensor::write_safetensors(&inputs.0, folder.join("tensors.safetensors")).expect("a file");
        let case = json!({"net": net, "work": work}).to_string();
        std::fs::write(folder.join("case.json"), case).expect("a file");
        return;
    }
    drop(inputs);
    let count = argument("--views", 10);
    let started = Instant::now();
    for turn in 0..WARM_UP {
        once(turn);
    }
    let prepare_secs = started.elapsed().as_secs_f64();
    let started = Instant::now();
    let mut figure = f64::NAN;
    for turn in WARM_UP..WARM_UP + count {
        figure = once(turn);
    }
    report(json!({
        "items": count,
        "secs": started.elapsed().as_secs_f64(),
        "prepare_secs": prepare_secs,
        "check": { "figure": figure },
    }));
}

fn train_paper_effects(inputs: &mut Inputs) -> Work {
    let (net, params) = inputs.network(PaperEffects::new);
    let pixels = IMAGE_PX * IMAGE_PX;
    let shape = [2, GEOMETRY_CHANNELS, IMAGE_PX, IMAGE_PX];
    let geometry = inputs.uniform("geometry", &shape, -1.0, 1.0);
    let colors = inputs.uniform("colors", &[2, pixels, 3], 0.0, 1.0);
    let random = |shape: &[i64]| Tensor::randint(pixels, shape, (Kind::Int64, Device::Cpu));
    let surface = inputs.keep("surface", random(&[SURFACE]));
    let index = inputs.keep("tap_pixels", random(&[SURFACE, 4]));
    let weight = inputs.uniform("tap_weights", &[SURFACE, 4], 0.0, 0.25);
    let visibility = weight.sum_dim_intlist([1i64].as_slice(), false, Kind::Float);
    let taps = Taps {
        index,
        weight,
        facing: visibility.ones_like(),
        grid: Tensor::zeros([SURFACE, 2], CPU),
        visibility,
    };
    let mut trainee = Trainee::new(params, 0.0);
    Box::new(move |_| {
        let pair = SiamesePair {
            geometry: &geometry,
            color_p: &colors.get(0),
            color_q: &colors.get(1),
            surface: &surface,
            taps: &taps,
        };
        steps::effects_step(&net, &mut trainee, &pair, DESCENT.rate)
    })
}

fn render_paper_effects(inputs: &mut Inputs) -> Work {
    let (net, params) = inputs.network(PaperEffects::new);
    let shape = [1, GEOMETRY_CHANNELS, FRAME_PX, FRAME_PX];
    let geometry = inputs.uniform("geometry", &shape, -1.0, 1.0);
    render(move || net.forward(&params, &geometry, false))
}

fn train_paper_composition(inputs: &mut Inputs) -> Work {
    let channels = PaperComposition::input_channels(K);
    let (generator, painter) = inputs.network(|b| PaperComposition::new(b, channels));
    let (discriminator, critic) =
        inputs.network(|b| b.scope("discriminator", |b| PatchGan::new(b, channels + 3)));
    let image = |channels| [1, channels, IMAGE_PX, IMAGE_PX];
    let input = inputs.uniform("input", &image(channels), -1.0, 1.0);
    let truth = inputs.uniform("truth", &image(3), 0.0, 1.0);
    let coverage = inputs.uniform("coverage", &image(1), 0.0, 1.0);
    let (mut painter, mut critic) = (Trainee::new(painter, 0.0), Trainee::new(critic, 0.0));
    Box::new(move |_| {
        let gan = Gan {
            generator: &generator,
            discriminator: &discriminator,
        };
        let example = GanExample {
            input: &input,
            truth: &truth,
            coverage: &coverage,
        };
        gan.step(&mut painter, &mut critic, &example, DESCENT.rate)
    })
}

fn render_paper_composition(inputs: &mut Inputs) -> Work {
    let channels = PaperComposition::input_channels(K);
    let (net, params) = inputs.network(|b| PaperComposition::new(b, channels));
    let input = inputs.uniform("input", &[1, channels, FRAME_PX, FRAME_PX], -1.0, 1.0);
    render(move || net.forward(&params, &input, false))
}

fn train_point_effects(inputs: &mut Inputs) -> Work {
    let (net, params) = inputs.network(PointEffects::new);
    let all = observations(inputs);
    let (count, int) = (all.points.size()[0], (Kind::Int64, Device::Cpu));
    let pick = inputs.keep("pick", Tensor::randint(count, [BATCHES, PAIRS], int));
    let other = inputs.keep(
        "other",
        Tensor::randint(VIEWS as i64, [BATCHES, PAIRS], int),
    );
    let mut trainee = Trainee::with_muon(params, AVERAGE_DECAY);
    Box::new(move |turn| {
        let batch = turn as i64 % BATCHES;
        let pairs = (&pick.get(batch), &other.get(batch));
        steps::point_step(&net, &mut trainee, &all, pairs, DESCENT)
    })
}

fn render_point_effects(inputs: &mut Inputs) -> Work {
    let (net, params) = inputs.network(PointEffects::new);
    let unit = |t: Tensor| {
        &t / t
            .square()
            .sum_dim_intlist([1i64].as_slice(), true, Kind::Float)
            .sqrt()
    };
    let shape = [FRAME_PX * FRAME_PX, 3];
    let points = inputs.uniform("points", &shape, -1.0, 1.0);
    let normals = inputs.keep("normals", unit(Tensor::randn(shape, CPU)));
    let to_viewer = inputs.keep("to_viewer", unit(Tensor::randn(shape, CPU)));
    render(move || net.forward(&params, &points, &normals, &to_viewer))
}

fn train_blend(inputs: &mut Inputs) -> Work {
    let (net, params) = inputs.network(|b| BlendComposition::new(b, K, BLEND_WIDTH));
    let input = blend_input(inputs, WINDOWS, WINDOW_PX);
    let image = |channels| [WINDOWS, channels, WINDOW_PX, WINDOW_PX];
    let truth = inputs.uniform("truth", &image(3), 0.0, 1.0);
    let coverage = inputs.uniform("coverage", &image(1), 0.0, 1.0);
    let mut trainee = Trainee::with_muon(params, AVERAGE_DECAY);
    Box::new(move |_| {
        steps::blend_step(
            &net,
            &mut trainee,
            &input,
            (&truth, &coverage),
            losses::blend,
            DESCENT,
        )
    })
}

fn render_blend(inputs: &mut Inputs) -> Work {
    let (net, params) = inputs.network(|b| BlendComposition::new(b, K, BLEND_WIDTH));
    let input = blend_input(inputs, 1, FRAME_PX);
    render(move || net.forward(&params, &input))
}

fn blend_input(inputs: &mut Inputs, batch: i64, px: i64) -> BlendInput {
    let shape = |channels| [batch, channels, px, px];
    let k = K as i64;
    let prior = Tensor::rand(shape(k), CPU).softmax(1, Kind::Float);
    let visibility = Tensor::rand(shape(k), CPU).gt(0.2).to_kind(Kind::Float);
    BlendInput {
        candidates: inputs.uniform("candidates", &[batch, k, 3, px, px], 0.0, 1.0),
        prior: inputs.keep("prior", prior),
        visibility: inputs.keep("visibility", visibility),
        target: inputs.uniform("target", &shape(TARGET_CHANNELS), -1.0, 1.0),
    }
}

/// A sphere of random colours, seen by cameras that are evenly spread around it.
fn observations(inputs: &mut Inputs) -> Observations {
    let px = IMAGE_PX as u32;
    let focal = 1.7 * f64::from(px);
    let half = 0.5 * f64::from(px);
    let intrinsics = CameraIntrinsics {
        fx: focal,
        fy: focal,
        cx: half,
        cy: half,
        width: px,
        height: px,
    };
    let (mut cameras, mut depth, mut points, mut views) = (vec![], vec![], vec![], vec![]);
    for view in 0..VIEWS {
        let z = 0.9 - 1.8 * (view as f64 + 0.5) / VIEWS as f64;
        let turn = 2.4 * view as f64;
        let around = (1.0 - z * z).sqrt();
        let eye = DVec3::new(around * turn.cos(), around * turn.sin(), z) * 3.2;
        let camera = Camera::look_at(intrinsics, eye, DVec3::ZERO, DVec3::Z).expect("a camera");
        let world_from_camera = camera.camera_from_world.inverse();
        for pixel in 0..px * px {
            let (u, v) = (f64::from(pixel % px) + 0.5, f64::from(pixel / px) + 0.5);
            let ray = DVec3::new((u - half) / focal, (v - half) / focal, 1.0);
            let direction = world_from_camera.transform_vector3(ray);
            // Where eye + t direction first has the sphere's radius.
            let (a, b) = (direction.length_squared(), eye.dot(direction));
            let root = b * b - a * (eye.length_squared() - RADIUS * RADIUS);
            let t = if root > 0.0 {
                (-b - root.sqrt()) / a
            } else {
                0.0
            };
            depth.push(t as f32);
            if t > 0.0 {
                points.extend((eye + direction * t).to_array().map(|x| x as f32));
                views.push(view as i64);
            }
        }
        cameras.push(camera);
    }
    let pose: Vec<f32> = cameras
        .iter()
        .flat_map(|c| c.camera_from_world.to_cols_array().map(|x| x as f32))
        .collect();
    let lens = [focal, focal, half, half].map(|x| x as f32);
    // Columns of the rotation and the translation, as [V, 4, 3]; the peer wants rows.
    let pose = Tensor::from_slice(&pose).view([-1, 4, 3]).transpose(1, 2);
    drop(inputs.keep("pose", pose));
    let lens = Tensor::from_slice(&lens).repeat([VIEWS as i64, 1]);
    drop(inputs.keep("intrinsics", lens));
    drop(inputs.keep("depth", Tensor::from_slice(&depth)));
    let points = Tensor::from_slice(&points).view([-1, 3]);
    let (count, pixels) = (points.size()[0], depth.len() as i64);
    let bytes = |shape: &[i64]| Tensor::randint(256, shape, (Kind::Uint8, Device::Cpu));
    Observations {
        normals: inputs.keep("normals", &points / RADIUS),
        points: inputs.keep("points", points),
        colors: inputs.uniform("colors", &[count, 3], 0.0, 1.0),
        views: inputs.keep("views", Tensor::from_slice(&views)),
        sources: Sources::new(&cameras, &depth, Device::Cpu),
        source_colors: inputs.keep("source_colors", bytes(&[pixels, 3])),
        source_alpha: inputs.keep(
            "source_alpha",
            Tensor::full([pixels], 255, (Kind::Uint8, Device::Cpu)),
        ),
    }
}

/// Frames; their mean.
fn render(frame: impl Fn() -> Tensor + 'static) -> Work {
    Box::new(move |_| no_grad(|| frame().mean(Kind::Float).double_value(&[])))
}

/// The value after `name` on the command line.
fn argument<T: FromStr>(name: &str, default: T) -> T {
    let mut arguments = std::env::args()
        .skip_while(|argument| argument != name)
        .skip(1);
    match arguments.next() {
        Some(value) => value.parse().ok().expect("a value that fits its option"),
        None => default,
    }
}

/// Prints the result with the largest resident set of this process so far.
#[expect(clippy::print_stdout, reason = "the result is what the program is for")]
fn report(mut result: serde_json::Value) {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let peak = status.lines().find_map(|line| line.strip_prefix("VmHWM:"));
    let kilobytes = peak.and_then(|text| text.split_whitespace().next()?.parse::<u64>().ok());
    result["peak_bytes"] = json!(kilobytes.unwrap_or(0) * 1024);
    println!("{result}");
}
