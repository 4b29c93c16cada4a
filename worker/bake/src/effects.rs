//! Training of `EffectsNet` (Sec. "Self-supervised Training").
//!
//! Both forms minimise the difference of two views' diffuse colours at the same surface point. [`train_points`]
//! states it as a prediction: what the other view saw, minus its effects, plus this view's effects, is what this view
//! saw; compared in encoded sRGB, the values that are scored. Where the other view's colour is clipped, what it hides
//! is unknown and the pair does not count.

use ign_nets::effects::{PaperEffects, PointEffects};
use ign_nets::losses::{self, Pair};
use ign_nets::optim::Trainee;
use ign_nets::steps::{self, SPARSITY, SiamesePair};
use ign_nets::warp::{Sources, directions};
use ign_nets::{Builder, Params};
use ign_render::{RenderSettings, Target};
use rand::RngExt;
use rayon::prelude::*;
use tch::{Device, Kind, Tensor, no_grad};

use crate::BakeError;
use crate::checkpoint::{Session, Stage, Watch};
use crate::data::Dataset;
use crate::sampler::{indices, step_rng};
use crate::schedule::Schedule;

/// Peak learning rate of the point effects (paper: 1e-3 constant for its U-Net).
const POINT_RATE: f64 = 2e-3;
/// Surface observations kept at most; more views thin them out evenly.
const MOST_OBSERVATIONS: usize = 4_000_000;

/// Pairs with a validation view, which say how well effects predict what was not trained on.
const UNSEEN_BATCHES: usize = 4;
const UNSEEN_BATCH: i64 = 8192;
const UNSEEN: &str = "effects_unseen";

/// Name and length of one training.
pub(crate) struct Plan {
    /// Stage in checkpoints.
    pub(crate) stage: &'static str,
    pub(crate) schedule: Schedule,
    pub(crate) seed: u64,
    /// Observations per step of the point effects.
    pub(crate) batch: i64,
    /// Decay of the average of weights that is kept.
    pub(crate) average_decay: f64,
    /// What layers of the point effects compute in.
    pub(crate) kind: Kind,
}

/// Every surface point that a training or validation view sees, with its colour; the training views come first.
struct Observations {
    /// Number of points that training views see.
    trained_points: i64,
    /// Number of training views.
    trained_views: i64,
    /// [N, 3].
    points: Tensor,
    /// [N, 3].
    normals: Tensor,
    /// [N, 3] encoded sRGB.
    colors: Tensor,
    /// [N] i64.
    views: Tensor,
    sources: Sources,
    /// [V*H*W, 3] u8 and [V*H*W] u8.
    source_colors: Tensor,
    source_alpha: Tensor,
}

fn observe_all(data: &Dataset<'_>) -> Result<Observations, BakeError> {
    struct One {
        camera: ign_geometry::Camera,
        points: Vec<f32>,
        normals: Vec<f32>,
        colors: Vec<f32>,
        depth: Vec<f32>,
        rgb: Vec<u8>,
        alpha: Vec<u8>,
    }
    let per_view = MOST_OBSERVATIONS / data.train.len().max(1);
    let all: Vec<usize> = data.train.iter().chain(&data.validation).copied().collect();
    let views: Vec<One> = all
        .par_iter()
        .map(|&view| {
            let straight = data.straight(view, data.reference_scale)?;
            let gbuffer = data.proxy.g_buffer(&straight.camera, 2);
            let usable: Vec<usize> = (0..gbuffer.mask.len())
                .filter(|&at| gbuffer.coverage[at] >= 1.0 && straight.alpha[at] >= 0.99)
                .collect();
            let stride = usable.len().div_ceil(per_view.max(1)).max(1);
            let kept: Vec<usize> = usable.into_iter().step_by(stride).collect();
            let byte = |value: f32| (value.clamp(0.0, 1.0) * 255.0).round() as u8;
            Ok(One {
                camera: straight.camera,
                points: kept.iter().flat_map(|&at| gbuffer.position[at]).collect(),
                normals: kept.iter().flat_map(|&at| gbuffer.normal[at]).collect(),
                colors: kept
                    .iter()
                    .flat_map(|&at| {
                        [
                            straight.rgb[at * 3],
                            straight.rgb[at * 3 + 1],
                            straight.rgb[at * 3 + 2],
                        ]
                    })
                    .collect(),
                depth: gbuffer
                    .depth
                    .iter()
                    .zip(&gbuffer.mask)
                    .map(|(&d, &covered)| if covered { d } else { 0.0 })
                    .collect(),
                rgb: straight.rgb.iter().map(|&v| byte(v)).collect(),
                alpha: straight.alpha.iter().map(|&v| byte(v)).collect(),
            })
        })
        .collect::<Result<_, BakeError>>()?;
    let width = views
        .iter()
        .map(|v| v.camera.intrinsics.width)
        .max()
        .unwrap_or(1);
    let height = views
        .iter()
        .map(|v| v.camera.intrinsics.height)
        .max()
        .unwrap_or(1);
    let cameras: Vec<_> = views
        .iter()
        .map(|v| {
            let mut camera = v.camera;
            (camera.intrinsics.width, camera.intrinsics.height) = (width, height);
            camera
        })
        .collect();
    let depth: Vec<Vec<f32>> = views
        .iter()
        .map(|v| padded(&v.depth, v.camera.intrinsics.width, 1, (width, height)))
        .collect();
    let depth: Vec<&[f32]> = depth.iter().map(Vec::as_slice).collect();
    let stack = |pick: fn(&One) -> &Vec<f32>| {
        Tensor::cat(
            &views
                .iter()
                .map(|v| Tensor::from_slice(pick(v)).view([-1, 3]))
                .collect::<Vec<_>>(),
            0,
        )
        .to_device(data.device)
    };
    let index: Vec<Tensor> = views
        .iter()
        .enumerate()
        .map(|(at, v)| {
            Tensor::full(
                [v.points.len() as i64 / 3],
                at as i64,
                (Kind::Int64, Device::Cpu),
            )
        })
        .collect();
    let rgb: Vec<Tensor> = views
        .iter()
        .map(|v| {
            Tensor::from_slice(&padded(
                &v.rgb,
                v.camera.intrinsics.width,
                3,
                (width, height),
            ))
            .view([-1, 3])
        })
        .collect();
    let alpha: Vec<Tensor> = views
        .iter()
        .map(|v| {
            Tensor::from_slice(&padded(
                &v.alpha,
                v.camera.intrinsics.width,
                1,
                (width, height),
            ))
        })
        .collect();
    let trained = &views[..data.train.len()];
    Ok(Observations {
        trained_points: trained.iter().map(|v| v.points.len() as i64 / 3).sum(),
        trained_views: data.train.len() as i64,
        points: stack(|v| &v.points),
        normals: stack(|v| &v.normals),
        colors: stack(|v| &v.colors),
        views: Tensor::cat(&index, 0).to_device(data.device),
        sources: Sources::new(&cameras, &depth, data.device),
        source_colors: Tensor::cat(&rgb, 0).to_device(data.device),
        source_alpha: Tensor::cat(&alpha, 0).to_device(data.device),
    })
}

/// Copies a row-major image of `channels` into the top-left corner of one of size `to`.
fn padded<T: Copy + Default>(from: &[T], width: u32, channels: usize, to: (u32, u32)) -> Vec<T> {
    let (from_row, to_row) = (width as usize * channels, to.0 as usize * channels);
    let mut out = vec![T::default(); to_row * to.1 as usize];
    for (source, target) in from
        .chunks_exact(from_row.max(1))
        .zip(out.chunks_exact_mut(to_row.max(1)))
    {
        target[..from_row].copy_from_slice(source);
    }
    out
}

/// Trains the effects per surface point.
pub(crate) fn train_points(
    data: &Dataset<'_>,
    session: &mut Session<'_>,
    plan: &Plan,
) -> Result<(), BakeError> {
    let (seed, batch) = (plan.seed, plan.batch);
    let observations = observe_all(data)?;
    let mut builder = Builder::new();
    let net = PointEffects::new(&mut builder);
    let trainee = Trainee::new(builder.build(data.device, seed), plan.average_decay);
    let unseen = unseen_pairs(&observations, seed);
    let stage = Stage {
        name: plan.stage,
        schedule: plan.schedule,
        watch: Some(Watch {
            keep_best: false,
            validation: &|params| unseen_error(&unseen, &net, params),
            curve: None,
        }),
    };
    session.train(&stage, vec![trainee], |trainees, step, rate| {
        let trainee = &mut trainees[0];
        let mut rng = step_rng(seed, plan.stage, step);
        let device = data.device;
        let pick = indices(&mut rng, batch, observations.trained_points, device);
        let other = indices(&mut rng, batch, observations.trained_views, device);
        let Some(pairs) = Pairs::new(&observations, &pick, &other) else {
            return 0.0;
        };
        let (here, there) = pairs.effects(&net, &trainee.params.in_kind(plan.kind));
        let size = losses::sparsity(&here) + losses::sparsity(&there);
        let loss = losses::pair(&pairs.with(&here, &there)) + size * (0.5 * SPARSITY);
        let value = loss.double_value(&[]);
        loss.backward();
        trainee.step(POINT_RATE * rate, 1.0);
        value
    })
}

/// Observations of validation views beside those of training views at the same points.
fn unseen_pairs(all: &Observations, seed: u64) -> Vec<Pairs> {
    let unseen = all.points.size()[0] - all.trained_points;
    if unseen == 0 {
        return Vec::new();
    }
    let mut rng = step_rng(seed, UNSEEN, 0);
    (0..UNSEEN_BATCHES)
        .filter_map(|_| {
            let device = all.points.device();
            let pick = indices(&mut rng, UNSEEN_BATCH, unseen, device) + all.trained_points;
            let other = indices(&mut rng, UNSEEN_BATCH, all.trained_views, device);
            Pairs::new(all, &pick, &other)
        })
        .collect()
}

/// Mean squared error, on [0, 255], of predicting validation views from training views and effects.
fn unseen_error(unseen: &[Pairs], net: &PointEffects, params: &Params) -> Option<f64> {
    let errors = unseen.iter().map(|pairs| {
        no_grad(|| {
            let (here, there) = pairs.effects(net, params);
            losses::pair_error(&pairs.with(&here, &there)).double_value(&[])
        })
    });
    let sum: f64 = errors.sum();
    (!unseen.is_empty()).then(|| sum / unseen.len() as f64 * 255.0 * 255.0)
}

/// Surface points that two views each see, with what they saw.
struct Pairs {
    /// [P, 3] each.
    points: Tensor,
    normals: Tensor,
    to_here: Tensor,
    to_there: Tensor,
    color_here: Tensor,
    color_there: Tensor,
    /// [P, 1].
    sound: Tensor,
}

impl Pairs {
    /// What `other` ([N], views) sees at the points of observations `pick` ([N]); `None` when it sees none.
    fn new(all: &Observations, pick: &Tensor, other: &Tensor) -> Option<Self> {
        let points = all.points.index_select(0, pick);
        let normals = all.normals.index_select(0, pick);
        let taps = all.sources.taps(&points, &normals, other);
        let same = all.views.index_select(0, pick).eq_tensor(other);
        let valid = taps
            .visibility
            .gt(0.9)
            .logical_and(&taps.facing.gt(0.3))
            .logical_and(&same.logical_not());
        let rows = valid.nonzero().view([-1]);
        let n = rows.size()[0];
        if n == 0 {
            return None;
        }
        let cut = |t: &Tensor| t.index_select(0, &rows);
        let (points, normals, pick) = (cut(&points), cut(&normals), cut(pick));
        let flat = cut(&taps.index).view([-1]);
        let alpha = all.source_alpha.index_select(0, &flat).view([n, 4]);
        let weight = cut(&taps.weight) * alpha.to_kind(Kind::Float) / 255.0;
        let total = weight.sum_dim_intlist([1i64].as_slice(), true, Kind::Float);
        let picked = all
            .source_colors
            .index_select(0, &flat)
            .view([n, 4, 3])
            .to_kind(Kind::Float)
            / 255.0;
        let color_there =
            (picked * weight.unsqueeze(2)).sum_dim_intlist([1i64].as_slice(), false, Kind::Float)
                / total.clamp_min(1e-3);
        let centers = all.sources.centers();
        let towards = |views: &Tensor| directions(&centers.index_select(0, views), &points);
        Some(Self {
            to_here: towards(&all.views.index_select(0, &pick)),
            to_there: towards(&cut(other)),
            color_here: all.colors.index_select(0, &pick),
            color_there,
            sound: total.gt(0.9).to_kind(Kind::Float),
            points,
            normals,
        })
    }

    /// Effects as seen from here and from there: [P, 3] each, linear light.
    fn effects(&self, net: &PointEffects, params: &Params) -> (Tensor, Tensor) {
        let seen_from = |to_viewer| net.forward(params, &self.points, &self.normals, to_viewer);
        (seen_from(&self.to_here), seen_from(&self.to_there))
    }

    fn with<'a>(&'a self, here: &'a Tensor, there: &'a Tensor) -> Pair<'a> {
        Pair {
            color_here: &self.color_here,
            color_there: &self.color_there,
            effects_here: here,
            effects_there: there,
            sound: &self.sound,
        }
    }
}

/// Everything the paper's `EffectsNet` needs of one training view.
struct PaperView {
    /// [1, 9, H, W].
    geometry: Tensor,
    /// [H*W, 3] encoded sRGB.
    colors: Tensor,
    /// [H*W]: 1 on the object.
    mask: Tensor,
    /// [P] i64: pixels of `mask` that are 1.
    pixels: Tensor,
    camera: ign_geometry::Camera,
    depth: Vec<f32>,
}

/// Trains the paper's `EffectsNet` on random pairs of images.
pub(crate) fn train_paper(
    data: &Dataset<'_>,
    session: &mut Session<'_>,
    plan: &Plan,
    settings: &RenderSettings,
) -> Result<(), BakeError> {
    let views: Vec<PaperView> = data
        .train
        .iter()
        .map(|&view| {
            let straight = data.straight(view, 1)?;
            let target = Target::new(&data.proxy, &straight.camera, settings, data.device);
            let gbuffer = data.proxy.g_buffer(&straight.camera, 1);
            let covered = Tensor::from_slice(&gbuffer.mask).to_kind(Kind::Float);
            let mask = (covered
                * Tensor::from_slice(&straight.alpha)
                    .gt(0.5)
                    .to_kind(Kind::Float))
            .to_device(data.device);
            Ok(PaperView {
                geometry: target.geometry,
                colors: Tensor::from_slice(&straight.rgb)
                    .view([-1, 3])
                    .to_device(data.device),
                pixels: mask.nonzero().view([-1]),
                mask,
                camera: straight.camera,
                depth: gbuffer
                    .depth
                    .iter()
                    .zip(&gbuffer.mask)
                    .map(|(&d, &c)| if c { d } else { 0.0 })
                    .collect(),
            })
        })
        .collect::<Result<_, BakeError>>()?;
    let mut builder = Builder::new();
    let net = PaperEffects::new(&mut builder);
    let params = builder.build(data.device, plan.seed);
    let trainee = Trainee::new(params, plan.average_decay);
    let stage = Stage {
        name: plan.stage,
        schedule: plan.schedule,
        watch: None,
    };
    session.train(&stage, vec![trainee], |trainees, step, rate| {
        let mut rng = step_rng(plan.seed, plan.stage, step);
        let p = &views[rng.random_range(0..views.len())];
        let q = &views[rng.random_range(0..views.len())];
        let map = p.geometry.view([9, -1]).tr().index_select(0, &p.pixels);
        let sources = Sources::new(&[q.camera], &[q.depth.as_slice()], data.device);
        let points = map.narrow(1, 0, 3).contiguous();
        let normals = map.narrow(1, 3, 3).contiguous();
        let zeros = Tensor::zeros([points.size()[0]], (Kind::Int64, data.device));
        let pair = SiamesePair {
            geometry: &Tensor::cat(&[&p.geometry, &q.geometry], 0),
            color_p: &p.colors,
            color_q: &q.colors,
            surface: &p.pixels,
            taps: &sources.taps(&points, &normals, &zeros).weighted(&q.mask),
        };
        steps::effects_step(&net, &mut trainees[0], &pair, steps::RATE * rate)
    })
}
