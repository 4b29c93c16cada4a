//! What preset `auto` decides before it trains: how many references and at which resolution, how many of them a pixel
//! blends, whether there is time for a network at all. Each from a measurement on validation views or from a limit that
//! the recipe states; held-out views decide nothing.

use std::path::Path;
use std::time::Instant;

use ign_bundle::Reference;
use ign_nets::Builder;
use ign_nets::composition::BlendComposition;
use ign_nets::effects::PointEffects;
use ign_render::{Composition, Effects, ReferenceImage, Target};

use crate::BakeError;
use crate::checkpoint::Session;
use crate::composition::prior_errors;
use crate::data::Dataset;
use crate::recipe::{Preset, Settings};
use crate::training::Drawn;

/// Numbers of references that are tried, most first.
const REFERENCES: [usize; 6] = [20, 14, 10, 7, 5, 4];
/// Error that fewer references may add, as a share.
const REFERENCE_SLACK: f64 = 0.005;
/// Bytes of a bundle besides references, proxy and weights.
const OTHER_BYTES: f64 = 1e5;
/// Bytes of a proxy's vertex and triangle in a bundle.
const VERTEX_BYTES: f64 = 28.0;
const TRIANGLE_BYTES: f64 = 12.0;
/// Channels of a `CompositionNet` that renders faster, where frames are to be fast.
const NARROW: i64 = 16;
/// Times that a frame is rendered to know how long it takes, after one that does not count.
const TIMED_FRAMES: usize = 3;
/// Observations of a training, as far as their time is set aside.
const OBSERVATIONS: usize = 14;
/// What is set aside for everything after the training, beyond what its frames take.
const SPARE: f64 = 1.3;
const SPARE_SECS: f64 = 5.0;

/// How a frame is rendered.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Manner {
    k: usize,
    supersample: u32,
    /// Of `CompositionNet`; `None` without networks.
    width: Option<i64>,
}

/// What was decided.
pub(crate) struct Fit {
    pub(crate) drawn: Drawn,
    /// The scene's views that `drawn.images` show.
    pub(crate) chosen: Vec<usize>,
    /// For the plan, with the reasons.
    pub(crate) words: Vec<String>,
}

/// Draws the views, with as few references and as much work per frame as the scene and the recipe's limits ask for.
pub(crate) fn fit(
    data: &mut Dataset<'_>,
    settings: &mut Settings,
    mut chosen: Vec<usize>,
    session: &mut Session<'_>,
) -> Result<Fit, BakeError> {
    let draw = |data: &Dataset<'_>, chosen: &[usize]| {
        Drawn::new(data, chosen, data.settings.clone(), data.reference_scale)
    };
    let mut drawn = draw(data, &chosen)?;
    let mut words = Vec::new();
    if settings.preset != Preset::Auto {
        return Ok(Fit {
            drawn,
            chosen,
            words,
        });
    }
    if let Some(fps) = settings.min_render_fps {
        words.push(fit_speed(data, settings, &drawn, session, fps));
        if data.settings != drawn.settings {
            drawn = draw(data, &chosen)?;
        }
    }
    let enough = fewest_references(data, &mut drawn, session);
    if enough < chosen.len() {
        words.push(format!(
            "{enough} of {} references suffice: more lower the error of plain blending by less than {:.1} %.",
            chosen.len(),
            100.0 * REFERENCE_SLACK
        ));
    }
    chosen.truncate(enough);
    drawn.images.truncate(enough);
    if let Some(most) = settings.max_bundle_mb {
        words.push(fit_bytes(
            data,
            settings,
            &mut drawn,
            &mut chosen,
            most * 1e6,
        )?);
    }
    for sentence in &words {
        session.reporter.info(sentence.clone());
    }
    Ok(Fit {
        drawn,
        chosen,
        words,
    })
}

/// Seconds of training that leave time for the rest of a bake that began at `started` and may take `most` seconds.
pub(crate) fn training_secs(
    data: &Dataset<'_>,
    settings: &Settings,
    drawn: &Drawn,
    started: Instant,
    most: f64,
) -> f64 {
    let manner = Manner {
        k: settings.k,
        supersample: data.settings.supersample,
        width: settings.compose.then_some(settings.width),
    };
    let frame = frame_secs(data, drawn, manner);
    let pixels = |size: usize| (size * size) as f64;
    let preview = pixels(crate::pack::PREVIEW_PX as usize)
        / drawn
            .held_out
            .first()
            .map_or(1.0, |view| (view.object.len() as f64).max(1.0));
    let watched = drawn.validation.len() + drawn.held_out.len();
    let frames = (data.train.len()
        + drawn.held_out.len() * (1 + settings.methods.len())
        + watched * OBSERVATIONS) as f64
        + settings.preview_frames as f64 * preview;
    let left = most - started.elapsed().as_secs_f64() - SPARE * frame * frames - SPARE_SECS;
    left.max(1.0) / (1 + settings.trained_methods()) as f64
}

/// The smallest number of references with which plain blending is about as good as with all of them.
fn fewest_references(data: &Dataset<'_>, drawn: &mut Drawn, session: &Session<'_>) -> usize {
    let all = drawn.images.len();
    let counts: Vec<usize> = std::iter::once(all)
        .chain(REFERENCES.into_iter().filter(|&count| count < all))
        .collect();
    let mut errors = Vec::new();
    let images = drawn.images.clone();
    for (at, &count) in counts.iter().enumerate() {
        drawn.images.truncate(count);
        let Some((error, _)) = prior_errors(&drawn.plain(data), &drawn.validation) else {
            break;
        };
        errors.push(error);
        session.reporter.step(
            0.5 + 0.5 * at as f64 / counts.len() as f64,
            &format!("{count} references: validation error {error:.2}"),
        );
    }
    drawn.images = images;
    let lowest = errors.iter().copied().fold(f64::INFINITY, f64::min);
    let good = |error: &f64| *error <= lowest * (1.0 + REFERENCE_SLACK);
    let fewest = errors.iter().rposition(good);
    fewest.map_or(all, |at| counts[at])
}

/// Takes the first manner of rendering that is fast enough, else the one that does the least.
fn fit_speed(
    data: &mut Dataset<'_>,
    settings: &mut Settings,
    drawn: &Drawn,
    session: &mut Session<'_>,
    fps: f64,
) -> String {
    let (k, supersample) = (settings.k, data.settings.supersample);
    let (fewer, width) = (k.min(2), settings.width);
    let manner = |k, supersample, width| Manner {
        k,
        supersample,
        width,
    };
    let mut manners = vec![
        manner(k, supersample, Some(width)),
        manner(k, 1, Some(width)),
        manner(k, 1, Some(width.min(NARROW))),
        manner(fewer, 1, Some(width.min(NARROW))),
        manner(k, 1, None),
        manner(fewer, 1, None),
    ];
    manners.dedup();
    let timed: Vec<(Manner, f64)> = manners
        .into_iter()
        .map(|manner| {
            let Manner {
                k,
                supersample,
                width,
            } = manner;
            let name = format!("fps_k{k}_samples{supersample}_width{}", width.unwrap_or(0));
            let rate = || 1.0 / frame_secs(data, drawn, manner).max(1e-6);
            (manner, session.measured(&name, rate))
        })
        .collect();
    let fast_enough = timed.iter().find(|(_, rate)| *rate >= fps);
    let Some(&(manner, reached)) = fast_enough.or(timed.last()) else {
        return String::new();
    };
    settings.k = manner.k;
    settings.compose = manner.width.is_some();
    settings.width = manner.width.unwrap_or(settings.width);
    data.settings.k = manner.k;
    data.settings.supersample = manner.supersample;
    format!(
        "At least {fps} frames a second are asked for: {} {} views a pixel, {} samples a pixel side, {} networks; \
         {reached:.1} frames a second on this device.",
        if reached >= fps {
            "reached with"
        } else {
            "not reached; the least that can be done is"
        },
        manner.k,
        manner.supersample,
        manner
            .width
            .map_or("no".into(), |width| format!("{width} channels wide")),
    )
}

/// Seconds for one frame, drawing of the proxy included; networks are untrained ones of the same size.
fn frame_secs(data: &Dataset<'_>, drawn: &Drawn, manner: Manner) -> f64 {
    let Some(view) = drawn.validation.first().or(drawn.held_out.first()) else {
        return 0.0;
    };
    let mut render = data.settings.clone();
    (render.k, render.supersample) = (manner.k, manner.supersample);
    let mut model = drawn.plain(data);
    model.settings = render.clone();
    if let Some(width) = manner.width {
        let mut builder = Builder::new();
        let net = PointEffects::new(&mut builder);
        model = model.with_effects(Some(Effects::Points(net, builder.build(data.device, 0))));
        let mut builder = Builder::new();
        let net = BlendComposition::new(&mut builder, manner.k, width);
        model.composition = Some(Composition::Blend(net, builder.build(data.device, 0)));
    }
    let mut times: Vec<f64> = (0..=TIMED_FRAMES)
        .map(|_| {
            let start = Instant::now();
            let target = Target::new(&data.proxy, &view.target.camera, &render, data.device);
            // Copied to the CPU: the device is done.
            drop(ign_nets::params::flat_values(&model.image(&target)));
            start.elapsed().as_secs_f64()
        })
        .skip(1)
        .collect();
    times.sort_by(f64::total_cmp);
    times[times.len() / 2]
}

/// Takes references away, then their resolution, until the bundle is small enough.
fn fit_bytes(
    data: &mut Dataset<'_>,
    settings: &mut Settings,
    drawn: &mut Drawn,
    chosen: &mut Vec<usize>,
    most: f64,
) -> Result<String, BakeError> {
    settings.half_weights = true;
    let proxy = data.mesh.positions.len() as f64 * VERTEX_BYTES
        + data.mesh.triangles.len() as f64 * TRIANGLE_BYTES;
    let rest = proxy + 2.0 * network_values(settings.k, settings.width) as f64 + OTHER_BYTES;
    let mut least = f64::INFINITY;
    for scale in [data.reference_scale, 1] {
        if scale != data.reference_scale {
            data.reference_scale = scale;
            drawn.images = data.reference_images(chosen, scale)?;
        }
        let sizes = png_bytes(&drawn.images)?;
        let counts = REFERENCES.into_iter().filter(|&count| count < sizes.len());
        for count in std::iter::once(sizes.len()).chain(counts) {
            let bytes = rest + sizes[..count].iter().sum::<f64>();
            least = least.min(bytes);
            if bytes <= most {
                chosen.truncate(count);
                drawn.images.truncate(count);
                return Ok(format!(
                    "The bundle may have {:.1} MB: {count} references at {scale} times the image's resolution and weights in \
                     half precision make {:.1} MB.",
                    most / 1e6,
                    bytes / 1e6
                ));
            }
        }
    }
    Err(BakeError::Recipe {
        message: format!(
            "max_bundle_mb={:.1} is too small: the proxy, the networks and {} references take {:.1} MB",
            most / 1e6,
            REFERENCES[REFERENCES.len() - 1].min(chosen.len()),
            least / 1e6
        ),
        hint: "allow more, or make the images smaller with size".into(),
    })
}

/// Numbers in the weights of both networks.
fn network_values(k: usize, width: i64) -> i64 {
    let mut builder = Builder::new();
    PointEffects::new(&mut builder);
    BlendComposition::new(&mut builder, k, width);
    builder.values()
}

/// Size of each reference as a bundle stores it.
fn png_bytes(images: &[ReferenceImage]) -> Result<Vec<f64>, BakeError> {
    let references: Vec<Reference> = images
        .iter()
        .map(|image| Reference {
            name: image.name.clone(),
            camera: image.camera,
            width: image.camera.intrinsics.width,
            height: image.camera.intrinsics.height,
            rgba: image.rgba.clone(),
            exposure_gain: [1.0; 3],
            crop: None,
        })
        .collect();
    let files = ign_bundle::references::encode(&references)?;
    let is_picture = |name: &str| {
        Path::new(name)
            .extension()
            .is_some_and(|kind| kind == "png")
    };
    let pictures = files.iter().filter(|(name, _)| is_picture(name));
    Ok(pictures.map(|(_, bytes)| bytes.len() as f64).collect())
}
