//! The report of synthetic figures: complete, self-contained, and safe against strange names.
//!
//! To look at it: `IGN_REPORT_OUT=/tmp/report.html cargo test -p ign-bundle --test report`, then open the file.

#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

use ign_bundle::manifest::{Manifest, StageSeconds};
use ign_bundle::metrics::{MethodMetrics, Scores, SpeedError, ViewCounts};
use ign_bundle::{CaptureLine, Metrics, ReportInput, ReportView, pack, render_report};
use image::{Rgb, RgbImage};
use serde_json::json;

const SIZE: u32 = 128;

/// A shaded ball with a highlight of strength `gloss`, its texture moved by `shift` pixels.
fn ball(turn: f64, gloss: f64, shift: f64) -> RgbImage {
    RgbImage::from_fn(SIZE, SIZE, |px, py| {
        let half = f64::from(SIZE) / 2.0;
        let (x, y) = (
            (f64::from(px) + 0.5 - half) / (0.8 * half),
            (f64::from(py) + 0.5 - half) / (0.8 * half),
        );
        let r2 = x * x + y * y;
        if r2 >= 1.0 {
            return Rgb([0; 3]);
        }
        let z = (1.0 - r2).sqrt();
        let angle = x.atan2(z) + turn + shift / half;
        let stripe = if (angle * 9.0).sin() * (y * 11.0).cos() > 0.0 {
            0.75
        } else {
            0.35
        };
        let light = 0.25 + 0.75 * (0.5 * x - 0.6 * y + 0.62 * z).max(0.0);
        let lobe = gloss * (0.35 * x - 0.45 * y + 0.82 * z).max(0.0).powi(60);
        Rgb([0.95, 0.8, 0.6].map(|c| ((stripe * c * light + lobe) * 255.0).clamp(0.0, 255.0) as u8))
    })
}

fn views() -> Vec<ReportView> {
    (0..3)
        .map(|i| {
            let turn = f64::from(i) * 0.8;
            let gloss = if i == 1 { 1.2 } else { 0.7 };
            ReportView {
                name: format!("{:04}.png", 7 + 8 * i),
                target: ball(turn, gloss, 0.0),
                ours: ball(turn, gloss * if i == 1 { 0.6 } else { 0.93 }, 0.0),
                baseline: Some(("ibr".into(), ball(turn, 0.1, 1.5))),
                diffuse: Some(ball(turn, 0.0, 0.0)),
                effects: (i < 2).then(|| {
                    let (mut image, diffuse) = (ball(turn, gloss, 0.0), ball(turn, 0.0, 0.0));
                    image
                        .iter_mut()
                        .zip(diffuse.iter())
                        .for_each(|(a, b)| *a -= b);
                    image
                }),
            }
        })
        .collect()
}

fn row(
    name: &str,
    factor: f64,
    train_secs: f64,
    render_ms: f64,
    bundle_bytes: u64,
) -> MethodMetrics {
    let views: Vec<(String, Scores)> = (0..15)
        .map(|i| {
            let wave = 1.0 + 0.4 * (f64::from(i) * 1.3).sin();
            let outlier = if i == 1 && name == "ours" { 4.5 } else { 1.0 };
            let mse = factor * wave * outlier;
            let psnr = ign_bundle::metrics::psnr(mse);
            let scores = Scores {
                mse,
                mse_object: 2.4 * mse,
                psnr,
                psnr_object: psnr - 3.8,
                ssim: 1.0 - mse / 3000.0,
                flip: mse / 900.0,
            };
            (format!("{:04}.png", 7 + 8 * i), scores)
        })
        .collect();
    MethodMetrics::from_views(name, &views, train_secs, render_ms, bundle_bytes)
}

fn metrics() -> Metrics {
    let curve = |method: &str, start: f64, end: f64, secs: f64| -> Vec<SpeedError> {
        (0..8)
            .map(|i| {
                let share = f64::from(i) / 7.0;
                let mse = start * (end / start).powf(share.sqrt());
                SpeedError {
                    method: method.into(),
                    secs: if i == 0 { 0.0 } else { secs * share * share },
                    mse,
                    mse_object: 2.4 * mse,
                }
            })
            .collect()
    };
    Metrics {
        schema: "ign.metrics/1".into(),
        capture: format!("sha256:{}", "5d41402abc4b2a76b9719d911017c592".repeat(2)),
        resolution: [SIZE, SIZE],
        views: ViewCounts {
            train: 105,
            held_out: 15,
            references: 20,
        },
        methods: vec![
            row("texture", 88.0, 0.0, 6.0, 620_000),
            row("n_ibr", 40.7, 0.0, 14.0, 1_900_000),
            row("ibr", 38.3, 0.0, 31.0, 1_900_000),
            row("ours_no_effects", 17.4, 340.0, 95.0, 12_300_000),
            row("ours", 5.9, 612.0, 140.0, 25_400_000),
            row("paper", 26.0, 612.0, 150.0, 25_400_000),
        ],
        speed_error: [
            curve("ours", 38.3, 7.2, 612.0),
            curve("ours_no_effects", 38.3, 17.4, 340.0),
            curve("paper", 98.0, 26.0, 612.0),
        ]
        .concat(),
        plan: json!({}),
        stages: [
            ("import", 3.2),
            ("plan", 8.9),
            ("effects", 272.0),
            ("composition", 340.0),
            ("evaluate", 41.0),
            ("pack", 2.3),
        ]
        .map(|(name, secs)| StageSeconds {
            name: name.into(),
            secs,
        })
        .into(),
        device: "cpu, 2 threads".into(),
    }
}

fn manifest() -> Manifest {
    pack::parse_manifest(include_bytes!("fixtures/bundle-1.json")).unwrap()
}

fn page(title: &str, metrics: &Metrics, views: &[ReportView]) -> String {
    let plan = [
        "20 reference views cover 98.7 % of what the training views see; the 21st would add 0.1 %.",
        "Observed colour varies by 14.2 levels over views, 5 times the noise: EffectsNet is trained.",
        "The blending head cut the validation error from 38.3 to 9.1 in 42 s and was kept.",
        "The GAN loss cost 2.1 times the time per step and gained nothing: dropped.",
    ]
    .map(str::to_owned);
    render_report(&ReportInput {
        title,
        manifest: &manifest(),
        metrics,
        views,
        plan: &plan,
        capture: &[
            CaptureLine {
                subject: "coverage".into(),
                text: "94 % of the surface seen by two views; weak: the underside (9 %)".into(),
                doubtful: true,
            },
            CaptureLine {
                subject: "light".into(),
                text: "constant".into(),
                doubtful: false,
            },
        ],
        advice: &["the underside <is> seen by no view: take photographs of it".to_owned()],
    })
}

#[test]
fn the_page_is_complete_and_self_contained() {
    let html = page("Vase with lid, Apulian", &metrics(), &views());
    if let Some(out) = std::env::var_os("IGN_REPORT_OUT") {
        std::fs::write(out, &html).unwrap();
    }
    for expected in [
        "Good, but look at one view",
        "0015.png",
        "worst view",
        "Speed against error",
        "nearest-view IBR",
        "<svg",
        "antiquities / vase-12",
        "GAN loss",
        "<dt class=\"doubtful\">coverage</dt>",
        "the underside &lt;is&gt; seen",
    ] {
        assert!(html.contains(expected), "{expected}");
    }
    for foreign in [
        "http:", "https:", "<script", "<link", "@import", "url(", "NaN", "inf",
    ] {
        assert!(
            !html.replace("information", "").contains(foreign),
            "{foreign}"
        );
    }
    // 3 views of 5 pictures, 3 diffuse, 2 effects.
    assert_eq!(html.matches("data:image/png;base64,").count(), 20);
}

#[test]
fn strange_input_gives_a_page() {
    let mut metrics = metrics();
    let html = page("<b>&\"", &metrics, &[]);
    assert!(html.contains("&lt;b&gt;&amp;&quot;") && !html.contains("<b>&"));
    metrics.methods.retain(|m| m.name == "ibr");
    metrics.speed_error.clear();
    assert!(page("x", &metrics, &[]).contains("Not scored"));
    metrics.methods.clear();
    metrics.stages.clear();
    assert!(page("x", &metrics, &[]).contains("Not scored"));
}

#[test]
fn no_gain_is_said_plainly() {
    let mut metrics = metrics();
    metrics.methods = vec![
        row("ibr", 10.0, 0.0, 1.0, 1),
        row("ours", 30.0, 1.0, 1.0, 1),
    ];
    assert!(page("x", &metrics, &[]).contains("No better than plain image-based rendering"));
    metrics.methods = vec![
        row("ibr", 100.0, 0.0, 1.0, 1),
        row("ours", 3.0, 1.0, 1.0, 1),
    ];
    metrics.methods[1].per_view[1].mse = 3.0;
    assert!(page("x", &metrics, &[]).contains("Every held-out view is rendered better"));
}
