//! Training of `EffectsNet` (Sec. "Self-supervised Training").
//!
//! Both forms minimise the difference of two views' diffuse colours at the same surface point (`ign_nets::steps`); here is
//! what they learn from.

use ign_geometry::Camera;
use ign_nets::effects::{PaperEffects, PointEffects};
use ign_nets::optim::Trainee;
use ign_nets::steps::{self, Descent, Observations, SiamesePair};
use ign_nets::warp::Sources;
use ign_nets::{Builder, Params};
use ign_render::{Effects, RenderSettings, Target};
use rand::RngExt;
use rayon::prelude::*;
use tch::{Kind, Tensor};

use crate::BakeError;
use crate::checkpoint::{Session, Stage, Watch};
use crate::data::{Dataset, spread};
use crate::recipe::Settings;
use crate::sampler::{indices, step_rng};
use crate::schedule::{Rate, Schedule};

/// Peak learning rate of the point effects (paper: 1e-3 constant for its U-Net).
const POINT_RATE: f64 = 2e-3;
/// Surface observations kept at most; more views thin them out evenly.
const MOST_OBSERVATIONS: usize = 4_000_000;
/// Bytes of the pictures and depths that these are compared with, at most; more views are thinned out evenly.
const MOST_SOURCE_BYTES: usize = 2 << 30;
/// Bytes of a pixel of these: depth, colour, coverage.
const SOURCE_PIXEL_BYTES: usize = 8;

/// Name and length of one training.
pub(crate) struct Plan<'a> {
    /// Stage in checkpoints.
    pub(crate) stage: &'static str,
    pub(crate) schedule: Schedule,
    pub(crate) seed: u64,
    pub(crate) settings: &'a Settings,
    /// Error on the validation views with these effects; `None` when there are no such views.
    pub(crate) validation: &'a dyn Fn(Effects) -> Option<f64>,
}

/// The training views that are learned from.
fn observed_views(data: &Dataset<'_>) -> Vec<usize> {
    let sizes = data.train.iter().map(|&view| {
        let i = data.cameras(view, data.reference_scale).0.intrinsics;
        (i.width as usize, i.height as usize)
    });
    let (width, height) = sizes.fold((1, 1), |a, b| (a.0.max(b.0), a.1.max(b.1)));
    spread(&data.train, views_that_fit(width * height))
}

/// How many views of so many pixels each.
fn views_that_fit(pixels: usize) -> usize {
    (MOST_SOURCE_BYTES / SOURCE_PIXEL_BYTES / pixels.max(1)).max(2)
}

/// What a view saw of the surface: positions, normals and encoded sRGB, three values each.
#[derive(Default)]
struct Seen {
    points: Vec<f32>,
    normals: Vec<f32>,
    colors: Vec<f32>,
}

/// Every surface point that one of these views sees. Each view's picture is written where it stays, in the corner of its
/// place in the stack: there is no second copy of all of them.
fn observe_all(data: &Dataset<'_>, views: &[usize]) -> Result<Observations, BakeError> {
    let own: Vec<Camera> = views
        .iter()
        .map(|&view| data.cameras(view, data.reference_scale).0)
        .collect();
    let longest = |side: fn(&Camera) -> u32| own.iter().map(side).max().unwrap_or(1);
    let (width, height) = (
        longest(|camera| camera.intrinsics.width),
        longest(|camera| camera.intrinsics.height),
    );
    let place = width as usize * height as usize;
    let mut depth = vec![0.0f32; place * views.len()];
    let mut rgb = vec![0u8; place * views.len() * 3];
    let mut alpha = vec![0u8; place * views.len()];
    let per_view = (MOST_OBSERVATIONS / views.len().max(1)).max(1);
    let seen: Vec<Seen> = views
        .par_iter()
        .zip(depth.par_chunks_mut(place))
        .zip(rgb.par_chunks_mut(place * 3))
        .zip(alpha.par_chunks_mut(place))
        .map(|(((&view, depth), rgb), alpha)| {
            let straight = data.straight(view, data.reference_scale)?;
            let gbuffer = data.proxy.g_buffer(&straight.camera, 2);
            let own_width = straight.camera.intrinsics.width as usize;
            let mut usable = Vec::new();
            for at in 0..gbuffer.mask.len() {
                let to = at / own_width * width as usize + at % own_width;
                if gbuffer.mask[at] {
                    depth[to] = gbuffer.depth[at];
                }
                for channel in 0..3 {
                    rgb[to * 3 + channel] = byte(straight.rgb[at * 3 + channel]);
                }
                alpha[to] = byte(straight.alpha[at]);
                if gbuffer.coverage[at] >= 1.0 && straight.alpha[at] >= 0.99 {
                    usable.push(at);
                }
            }
            let stride = usable.len().div_ceil(per_view).max(1);
            let mut seen = Seen::default();
            for at in usable.into_iter().step_by(stride) {
                seen.points.extend(gbuffer.position[at]);
                seen.normals.extend(gbuffer.normal[at]);
                seen.colors.extend(&straight.rgb[at * 3..at * 3 + 3]);
            }
            Ok(seen)
        })
        .collect::<Result<_, BakeError>>()?;
    let cameras: Vec<Camera> = own
        .into_iter()
        .map(|mut camera| {
            (camera.intrinsics.width, camera.intrinsics.height) = (width, height);
            camera
        })
        .collect();
    let index: Vec<i64> = (0..)
        .zip(&seen)
        .flat_map(|(view, seen)| std::iter::repeat_n(view, seen.points.len() / 3))
        .collect();
    let joined = |pick: fn(&Seen) -> &Vec<f32>| {
        let values: Vec<&[f32]> = seen.iter().map(|it| pick(it).as_slice()).collect();
        Tensor::from_slice(&values.concat())
            .view([-1, 3])
            .to_device(data.device)
    };
    Ok(Observations {
        points: joined(|it| &it.points),
        normals: joined(|it| &it.normals),
        colors: joined(|it| &it.colors),
        views: Tensor::from_slice(&index).to_device(data.device),
        sources: Sources::new(&cameras, &depth, data.device),
        source_colors: Tensor::from_slice(&rgb)
            .view([-1, 3])
            .to_device(data.device),
        source_alpha: Tensor::from_slice(&alpha).to_device(data.device),
    })
}

fn byte(value: f32) -> u8 {
    (value.clamp(0.0, 1.0) * 255.0).round() as u8
}

/// Trains the effects per surface point.
pub(crate) fn train_points(
    data: &Dataset<'_>,
    session: &mut Session<'_>,
    plan: &Plan<'_>,
) -> Result<(), BakeError> {
    let (seed, batch) = (plan.seed, plan.settings.effects_batch);
    let before = session.reporter.activity("observations");
    let views = observed_views(data);
    let observations = observe_all(data, &views)?;
    let points = observations.points.size()[0];
    let views = views.len() as i64;
    session.reporter.activity(before);
    let mut builder = Builder::new();
    let net = PointEffects::new(&mut builder);
    let trainee = plan.settings.trainee(builder.build(data.device, seed));
    let validation = |params: &Params| {
        let effects = Effects::Points(net.clone(), params.in_kind(Kind::Float));
        (plan.validation)(effects)
    };
    // Rendering the validation views costs as much as many steps: not where the end is known.
    let ends_on_the_way = matches!(plan.schedule.rate, Rate::WhileItPays { .. });
    let stage = Stage {
        name: plan.stage,
        schedule: plan.schedule,
        watch: ends_on_the_way.then_some(Watch {
            keep_best: false,
            validation: &validation,
            curve: None,
        }),
    };
    session.train(&stage, vec![trainee], |trainees, step, rate| {
        let trainee = &mut trainees[0];
        let mut rng = step_rng(seed, plan.stage, step);
        let pick = indices(&mut rng, batch, points, data.device);
        let other = indices(&mut rng, batch, views, data.device);
        let descent = Descent {
            rate: POINT_RATE * rate,
            kind: plan.settings.kind(),
        };
        steps::point_step(&net, trainee, &observations, (&pick, &other), descent)
    })
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
    camera: Camera,
    depth: Vec<f32>,
}

/// Trains the paper's `EffectsNet` on random pairs of images.
pub(crate) fn train_paper(
    data: &Dataset<'_>,
    session: &mut Session<'_>,
    plan: &Plan<'_>,
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
    let trainee = Trainee::new(params, plan.settings.average_decay);
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
        let sources = Sources::new(&[q.camera], &q.depth, data.device);
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pictures_that_are_learned_from_fit_into_their_memory() {
        for side in [64, 512, 2048, 8192] {
            let views = views_that_fit(side * side);
            let bytes = views * side * side * SOURCE_PIXEL_BYTES;
            assert!(
                views == 2 || bytes <= MOST_SOURCE_BYTES,
                "{side} px: {views} views"
            );
            assert!(views >= 2);
        }
        assert_eq!(views_that_fit(1024 * 1024), 256);
        let all: Vec<usize> = (0..920).collect();
        let kept = spread(&all, views_that_fit(1024 * 1024));
        assert_eq!((kept.len(), kept[0]), (256, 0));
        assert!(
            kept.windows(2)
                .all(|pair| (3..=4).contains(&(pair[1] - pair[0])))
        );
    }
}
