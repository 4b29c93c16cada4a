//! Scores of every method on the held-out views, through the renderer that ships. Renderings are in the canonical
//! exposure and are brought to the photograph's before they are compared.

use ign_bundle::metrics::{MethodMetrics, Scores, ViewMetrics, WorstView};
use ign_render::{Target, to_image};
use image::RgbImage;
use std::time::Instant;
use tch::Tensor;

use crate::data::Scored;

/// One method's images and figures.
#[derive(Clone)]
pub(crate) struct Row {
    pub(crate) metrics: MethodMetrics,
    pub(crate) images: Vec<RgbImage>,
}

/// Renders and scores all held-out views with one method.
pub(crate) fn score(
    name: &str,
    train_secs: f64,
    names: &[String],
    views: &[Scored],
    render: impl Fn(&Target) -> Tensor,
) -> Row {
    let mut per_view = Vec::new();
    let mut images = Vec::new();
    let mut scores: Vec<Scores> = Vec::new();
    let mut millis = Vec::new();
    for (view, scored) in names.iter().zip(views) {
        let start = Instant::now();
        let image = render(&scored.target);
        millis.push(start.elapsed().as_secs_f64() * 1e3);
        let image = to_image(&(scored.photographed(&image) * &scored.counted));
        let score = Scores::of(&image, &to_image(&scored.truth), &scored.object);
        per_view.push(ViewMetrics {
            name: view.clone(),
            mse: score.mse,
            mse_object: score.mse_object,
        });
        scores.push(score);
        images.push(image);
    }
    let mean = |pick: fn(&Scores) -> f64| {
        scores.iter().map(pick).sum::<f64>() / scores.len().max(1) as f64
    };
    let worst = per_view.iter().max_by(|a, b| a.mse.total_cmp(&b.mse));
    let worst_view = worst.map_or(
        WorstView {
            name: String::new(),
            mse: 0.0,
        },
        |v| WorstView {
            name: v.name.clone(),
            mse: v.mse,
        },
    );
    millis.sort_by(f64::total_cmp);
    let metrics = MethodMetrics {
        name: name.into(),
        mse: mean(|s| s.mse),
        mse_object: mean(|s| s.mse_object),
        psnr: mean(|s| s.psnr),
        psnr_object: mean(|s| s.psnr_object),
        ssim: mean(|s| s.ssim),
        flip: (!scores.is_empty()).then(|| mean(|s| s.flip)),
        worst_view,
        per_view,
        train_secs,
        render_ms: millis.get(millis.len() / 2).copied().unwrap_or(0.0),
        bundle_bytes: 0,
    };
    Row { metrics, images }
}
