//! Writes the bundle: references, proxy, networks, metrics, held-out images, report, previews.

use std::io::Cursor;
use std::path::PathBuf;

use chrono::{DateTime, SecondsFormat, Utc};
use ign_bundle::manifest::{
    CanonicalExposure, MetricsSummary, Networks, ObjectName, Provenance, SCHEMA, StageSeconds,
};
use ign_bundle::metrics::Metrics;
use ign_bundle::report::{CaptureLine, ReportInput, ReportView, render_report};
use ign_bundle::{
    BundleWriter, COMPOSITION_FILE, EFFECTS_FILE, HeldOutView, Manifest, Precision, Reference,
    THUMBNAIL_FILE,
};
use ign_capture::Preflight;
use ign_nets::color;
use ign_render::{Effects, Model, NetworkFiles, ReferenceImage, Target, orbit, to_image};
use image::codecs::jpeg::JpegEncoder;
use image::{ExtendedColorType, ImageEncoder, RgbImage};

use crate::BakeError;
use crate::data::{Dataset, Scored};
use crate::evaluate::Row;
use crate::progress::Reporter;
use crate::recipe::Settings;
use crate::run::BakeJob;

/// Milliseconds that a frame stays: one round in about three seconds.
const PREVIEW_FRAME_MS: i32 = 90;
/// WebP's quality, 0 to 100.
const PREVIEW_QUALITY: f32 = 85.0;
/// Pixels of a preview frame's sides.
pub(crate) const PREVIEW_PX: u32 = 192;
/// Held-out views that the report shows.
const REPORT_VIEWS: usize = 4;

/// Everything a finished bake knows.
pub(crate) struct Finished<'a> {
    pub(crate) job: &'a BakeJob,
    pub(crate) settings: &'a Settings,
    pub(crate) data: &'a Dataset<'a>,
    pub(crate) model: &'a Model,
    pub(crate) images: &'a [ReferenceImage],
    /// The scene's views that they show.
    pub(crate) chosen: &'a [usize],
    pub(crate) views: &'a [(String, &'a Scored)],
    pub(crate) rows: Vec<Row>,
    pub(crate) metrics: Metrics,
    pub(crate) preflight: &'a Preflight,
    pub(crate) started_at: DateTime<Utc>,
    pub(crate) reporter: &'a Reporter<'a>,
}

/// Writes and verifies the bundle; returns its folder.
pub(crate) fn pack(finished: Finished<'_>) -> Result<PathBuf, BakeError> {
    let Finished {
        job,
        settings,
        data,
        model,
        images,
        chosen,
        views,
        rows,
        mut metrics,
        preflight,
        started_at,
        reporter,
    } = finished;
    reporter.stage("pack", "writing the bundle");
    let dir = job.work_dir.join("bundle");
    if dir.exists() {
        // What an earlier attempt left here is incomplete: a complete one would have been published.
        std::fs::remove_dir_all(&dir).map_err(|source| BakeError::Io {
            path: dir.clone(),
            source,
        })?;
    }
    let writer = BundleWriter::create(&dir)?;
    let references: Vec<Reference> = images
        .iter()
        .zip(chosen)
        .map(|(image, &view)| Reference {
            name: image.name.clone(),
            camera: image.camera,
            width: image.camera.intrinsics.width,
            height: image.camera.intrinsics.height,
            rgba: image.rgba.clone(),
            exposure_gain: data.gains[view],
            crop: None,
        })
        .collect();
    writer.references(&references)?;
    writer.proxy(&data.mesh, &data.normalisation)?;

    let dtype = if settings.half_weights {
        Precision::Fp16
    } else {
        Precision::Fp32
    };
    let effects = model
        .effects()
        .map(|effects| NetworkFiles::of_effects(effects, dtype));
    if let Some(files) = &effects {
        writer.weights(EFFECTS_FILE, &files.tensors, dtype)?;
    }
    let composition = model
        .composition
        .as_ref()
        .map(|net| NetworkFiles::of_composition(net, data.settings.k, dtype));
    if let Some(files) = &composition {
        writer.weights(COMPOSITION_FILE, &files.tensors, dtype)?;
    }

    let ours = rows.iter().find(|row| row.metrics.name == "ours");
    if let Some(ours) = ours {
        for ((name, scored), image) in views.iter().zip(&ours.images) {
            writer.held_out(name, "ours", image)?;
            writer.held_out(name, "target", &to_image(&scored.truth))?;
        }
    }
    let held_out_views: Vec<HeldOutView> = views
        .iter()
        .map(|(name, scored)| HeldOutView {
            name: name.clone(),
            camera: scored.target.camera,
            exposure_gain: scored.gain,
        })
        .collect();
    writer.held_out_views(&held_out_views)?;
    let before = reporter.activity("preview");
    let frames = turntable(data, model, settings.preview_frames, reporter);
    writer.file("preview.webp", &animation(&frames)?)?;
    reporter.activity(before);
    if let Some(first) = frames.first() {
        writer.file(THUMBNAIL_FILE, &jpeg(first)?)?;
    }

    let report_views = report_views(views, &rows, model);
    metrics.methods = rows.into_iter().map(|row| row.metrics).collect();
    metrics.stages = reporter
        .stages()
        .into_iter()
        .map(|(name, secs)| StageSeconds { name, secs })
        .collect();
    let bytes: u64 = written_bytes(&dir, &["held_out", "preview.webp", THUMBNAIL_FILE])?;
    for method in &mut metrics.methods {
        method.bundle_bytes = bytes;
    }
    writer.metrics(&metrics)?;

    let manifest = Manifest {
        schema: SCHEMA.into(),
        object: ObjectName {
            collection: job.object.0.clone(),
            object: job.object.1.clone(),
        },
        networks: Networks {
            effects: effects.map(|files| files.description),
            composition: composition.map(|files| files.description),
        },
        capture: job.capture_digest.clone(),
        recipe: serde_json::to_value(&job.recipe).unwrap_or_default(),
        plan: metrics.plan.clone(),
        provenance: Provenance {
            software: concat!("ign ", env!("CARGO_PKG_VERSION")).into(),
            git: option_env!("IGN_GIT_COMMIT").map(str::to_owned),
            device: metrics.device.clone(),
            seeds: vec![job.recipe.seed],
            started_at: started_at.to_rfc3339_opts(SecondsFormat::Secs, true),
            finished_at: Utc::now().to_rfc3339_opts(SecondsFormat::Secs, true),
            stages: metrics.stages.clone(),
        },
        files: Vec::new(),
        metrics: MetricsSummary::from(&metrics),
        normalised_from_world: data.normalisation.into(),
        colour_space: "srgb".into(),
        canonical_exposure: Some(canonical_exposure(&data.gains)),
        render: serde_json::to_value(&data.settings).unwrap_or_default(),
    };
    let words: Vec<String> = manifest.plan["words"]
        .as_array()
        .map(|words| {
            words
                .iter()
                .filter_map(|word| word.as_str().map(str::to_owned))
                .collect()
        })
        .unwrap_or_default();
    let lines: Vec<CaptureLine> = preflight
        .lines()
        .into_iter()
        .map(|line| CaptureLine {
            subject: line.subject,
            text: line.text,
            doubtful: line.doubtful,
        })
        .collect();
    let advice: Vec<String> = preflight
        .faults
        .iter()
        .map(|fault| format!("{} ({}): {}", fault.message, fault.at, fault.hint))
        .collect();
    let title = data
        .scene
        .info
        .title
        .clone()
        .unwrap_or_else(|| format!("{}/{}", job.object.0, job.object.1));
    writer.report(&render_report(&ReportInput {
        title: &title,
        manifest: &manifest,
        metrics: &metrics,
        views: &report_views,
        plan: &words,
        capture: &lines,
        advice: &advice,
    }))?;
    writer.finish(manifest)?;
    Ok(dir)
}

fn canonical_exposure(gains: &[[f32; 3]]) -> CanonicalExposure {
    let all = || gains.iter().flatten().copied();
    CanonicalExposure {
        equalised: all().any(|gain| (gain - 1.0).abs() > f32::EPSILON),
        gain_range: [
            all().reduce(f32::min).unwrap_or(1.0),
            all().reduce(f32::max).unwrap_or(1.0),
        ],
    }
}

/// The worst views first, then an even spread over the rest.
fn report_views(views: &[(String, &Scored)], rows: &[Row], model: &Model) -> Vec<ReportView> {
    let Some(ours) = rows.iter().find(|row| row.metrics.name == "ours") else {
        return Vec::new();
    };
    let best = rows.iter().filter(|row| row.metrics.is_baseline());
    let best = best.min_by(|a, b| a.metrics.mse.total_cmp(&b.metrics.mse));
    let mut order: Vec<usize> = (0..views.len()).collect();
    order.sort_by(|&a, &b| {
        ours.metrics.per_view[b]
            .mse
            .total_cmp(&ours.metrics.per_view[a].mse)
    });
    let step = (order.len() / REPORT_VIEWS).max(1);
    order
        .into_iter()
        .step_by(step)
        .take(REPORT_VIEWS)
        .map(|at| {
            let (name, scored) = &views[at];
            let (diffuse, effects) = match model.effects() {
                None => (None, None),
                Some(effects) => {
                    let raw = model.target_effects(&scored.target);
                    let shown = match effects {
                        Effects::Points(..) => color::srgb_from_linear(&raw),
                        Effects::Paper(..) => raw,
                    };
                    (
                        Some(to_image(&model.diffuse_image(&scored.target))),
                        Some(to_image(&(shown * &scored.target.coverage))),
                    )
                }
            };
            ReportView {
                name: name.clone(),
                target: to_image(&scored.truth),
                ours: ours.images[at].clone(),
                baseline: best.map(|row| (row.metrics.name.clone(), row.images[at].clone())),
                diffuse,
                effects,
            }
        })
        .collect()
}

/// One round around the object.
fn turntable(
    data: &Dataset<'_>,
    model: &Model,
    frames: usize,
    reporter: &Reporter<'_>,
) -> Vec<RgbImage> {
    let cameras = orbit(&model.references.cameras, frames, PREVIEW_PX);
    cameras
        .iter()
        .enumerate()
        .map(|(at, camera)| {
            reporter.step(at as f64 / frames as f64, "rendering the turntable");
            let target = Target::new(&data.proxy, camera, &data.settings, data.device);
            to_image(&model.image(&target))
        })
        .collect()
}

/// The frames as an animated WebP that runs for ever.
fn animation(frames: &[RgbImage]) -> Result<Vec<u8>, BakeError> {
    let failed = |reason: String| BakeError::Animation { reason };
    let mut config =
        webp::WebPConfig::new().map_err(|()| failed("no encoder configuration".into()))?;
    config.quality = PREVIEW_QUALITY;
    let mut encoder = webp::AnimEncoder::new(PREVIEW_PX, PREVIEW_PX, &config);
    for (at, frame) in frames.iter().enumerate() {
        let at_ms = at as i32 * PREVIEW_FRAME_MS;
        encoder.add_frame(webp::AnimFrame::from_rgb(
            frame,
            frame.width(),
            frame.height(),
            at_ms,
        ));
    }
    let encoded = encoder
        .try_encode()
        .map_err(|error| failed(format!("{error:?}")))?;
    Ok(encoded.to_vec())
}

fn jpeg(image: &RgbImage) -> Result<Vec<u8>, BakeError> {
    let mut bytes = Vec::new();
    JpegEncoder::new_with_quality(Cursor::new(&mut bytes), 88)
        .write_image(
            image,
            image.width(),
            image.height(),
            ExtendedColorType::Rgb8,
        )
        .map_err(|source| BakeError::Picture {
            file: THUMBNAIL_FILE,
            source,
        })?;
    Ok(bytes)
}

/// Bytes of the files that a viewer needs: all but those under the given names.
fn written_bytes(dir: &std::path::Path, without: &[&str]) -> Result<u64, BakeError> {
    let io = |source| BakeError::Io {
        path: dir.to_owned(),
        source,
    };
    let mut total = 0;
    for entry in std::fs::read_dir(dir).map_err(io)? {
        let entry = entry.map_err(io)?;
        if without.iter().any(|name| entry.file_name() == *name) {
            continue;
        }
        let metadata = entry.metadata().map_err(io)?;
        total += if metadata.is_dir() {
            written_bytes(&entry.path(), &[])?
        } else {
            metadata.len()
        };
    }
    Ok(total)
}
