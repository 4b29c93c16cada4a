//! What the photographs say about each other: gains, moving light, blur, coverage; and reports that stay finite.
//!
//! The captures are traced by ign-demo, so the truth is known; what is wrong with them is put in afterwards.

use std::fs;
use std::path::{Path, PathBuf};

use ign_capture::{
    Gains, ImportOptions, Preflight, PreflightOptions, Scene, Severity, Survey, import, preflight,
};
use ign_demo::{DemoOptions, Shape, generate};
use image::{Rgb, RgbImage};

const SIZE: u32 = 96;

fn capture(dir: &Path, options: &DemoOptions) -> PathBuf {
    let out = dir.join("capture");
    generate(&out, options, &|_, _| {}).expect("a capture");
    out
}

fn options() -> DemoOptions {
    DemoOptions {
        size: SIZE,
        views: 30,
        ..DemoOptions::default()
    }
}

fn imported(dir: &Path) -> Scene {
    import(dir, &ImportOptions::default()).expect("no faults")
}

fn report(dir: &Path) -> Preflight {
    preflight(
        dir,
        &PreflightOptions {
            proxy: None,
            size: 64,
        },
    )
}

/// Rewrites a photograph.
fn retouch(dir: &Path, name: &str, change: impl FnOnce(RgbImage) -> RgbImage) {
    let path = dir.join("images").join(name);
    let image = image::open(&path).expect("a photograph").into_rgb8();
    change(image).save(&path).expect("written");
}

fn names(dir: &Path) -> Vec<String> {
    imported(dir)
        .views
        .iter()
        .map(|view| view.name.clone())
        .collect()
}

fn linear(value: u8) -> f64 {
    let encoded = f64::from(value) / 255.0;
    if encoded <= 0.040_45 {
        encoded / 12.92
    } else {
        ((encoded + 0.055) / 1.055).powf(2.4)
    }
}

fn encoded(light: f64) -> u8 {
    let light = light.clamp(0.0, 1.0);
    let value = if light <= 0.003_130_8 {
        light * 12.92
    } else {
        1.055 * light.powf(1.0 / 2.4) - 0.055
    };
    (value * 255.0).round() as u8
}

fn exposed(image: &RgbImage, factors: [f64; 3]) -> RgbImage {
    RgbImage::from_fn(image.width(), image.height(), |x, y| {
        let pixel = image.get_pixel(x, y).0;
        let channel = |c: usize| encoded(linear(pixel[c]) * factors[c]);
        Rgb([channel(0), channel(1), channel(2)])
    })
}

/// Exposures between 0.65 and 1.25, each channel's its own, the same for each run.
fn drift(view: usize) -> [f64; 3] {
    [0, 1, 2].map(|channel| {
        let hash = (view * 3 + channel + 1).wrapping_mul(0x9e37_79b9) >> 8 & 0xffff;
        0.65 + 0.6 * hash as f64 / 65_535.0
    })
}

#[test]
fn exposures_are_recovered_to_a_percent() {
    let dir = tempfile::tempdir().expect("a folder");
    // Matte and well lit in every channel: gloss, and channels near black, cost some percent.
    let out = capture(
        dir.path(),
        &DemoOptions {
            shape: Shape::Bowl,
            gloss: 0.0,
            size: 160,
            views: 36,
            ..options()
        },
    );
    for (view, name) in names(&out).iter().enumerate() {
        retouch(&out, name, |image| exposed(&image, drift(view)));
    }
    let scene = imported(&out);
    let gains = Gains::estimate(&scene, &Survey::new(&scene));
    assert!(gains.needed && gains.explained > 0.3, "{}", gains.explained);
    for channel in 0..3 {
        // Up to the one factor that nobody can know.
        let product = |view: usize| gains.per_view[view][channel] * drift(view)[channel];
        let mean = (0..scene.views.len()).map(product).sum::<f64>() / scene.views.len() as f64;
        let off: Vec<f64> = (0..scene.views.len())
            .map(|view| 100.0 * (product(view) / mean - 1.0))
            .collect();
        assert!(
            off.iter().all(|percent| percent.abs() < 1.0),
            "channel {channel}: off by percent {off:.2?}"
        );
    }
    let report = report(&out);
    assert!(report.ok);
    let findings = report.findings.expect("findings");
    assert!(findings.exposure.drifts && findings.exposure.white_balance_spread > 0.1);
    assert!(findings.exposure.spread_stops > 0.4);
}

#[test]
fn constant_exposure_and_light_are_left_alone() {
    for (shape, gloss) in [(Shape::Vase, 0.75), (Shape::Bowl, 0.0)] {
        let dir = tempfile::tempdir().expect("a folder");
        let out = capture(
            dir.path(),
            &DemoOptions {
                shape,
                gloss,
                ..options()
            },
        );
        let scene = imported(&out);
        let gains = Gains::estimate(&scene, &Survey::new(&scene));
        assert!(!gains.needed, "{shape:?}: {}", gains.explained);
        assert!(
            gains
                .per_view
                .iter()
                .flatten()
                .all(|gain| gain.to_bits() == 1.0_f64.to_bits())
        );
        let findings = report(&out).findings.expect("findings");
        assert!(!findings.light.moves_with_object, "{:?}", findings.light);
        assert!(
            findings.sharpness.blurred.is_empty(),
            "{:?}",
            findings.sharpness
        );
    }
}

#[test]
fn light_that_moves_with_the_object_is_detected() {
    for gloss in [0.0, 0.75] {
        let dir = tempfile::tempdir().expect("a folder");
        let out = capture(
            dir.path(),
            &DemoOptions {
                gloss,
                turntable: true,
                ..options()
            },
        );
        let report = report(&out);
        let findings = report.findings.expect("findings");
        assert!(findings.light.moves_with_object, "{:?}", findings.light);
        assert!(report.faults.iter().any(|fault| {
            fault.severity == Severity::Warning && fault.message.starts_with("the light moves")
        }));
    }
}

#[test]
fn motion_blur_is_found_and_named() {
    let dir = tempfile::tempdir().expect("a folder");
    let out = capture(
        dir.path(),
        &DemoOptions {
            size: 160,
            gloss: 0.3,
            ..options()
        },
    );
    let shaken = [names(&out)[7].clone(), names(&out)[19].clone()];
    for (name, (dx, dy)) in shaken.iter().zip([(1_i64, 0_i64), (1, 1)]) {
        // The mean along a path of seven pixels.
        retouch(&out, name, |image| {
            RgbImage::from_fn(image.width(), image.height(), |x, y| {
                let mut sum = [0_u32; 3];
                for step in -3..=3 {
                    let column = (i64::from(x) + step * dx).clamp(0, i64::from(image.width()) - 1);
                    let row = (i64::from(y) + step * dy).clamp(0, i64::from(image.height()) - 1);
                    for (sum, value) in sum
                        .iter_mut()
                        .zip(image.get_pixel(column as u32, row as u32).0)
                    {
                        *sum += u32::from(value);
                    }
                }
                Rgb(sum.map(|sum| (sum / 7) as u8))
            })
        });
    }
    let report = report(&out);
    let mut found: Vec<String> = report
        .findings
        .expect("findings")
        .sharpness
        .blurred
        .into_iter()
        .map(|view| view.view)
        .collect();
    found.sort();
    assert_eq!(found, shaken);
}

#[test]
fn the_side_that_no_view_shows_is_named() {
    let dir = tempfile::tempdir().expect("a folder");
    let out = capture(dir.path(), &options());
    let report = report(&out);
    let coverage = report.findings.as_ref().expect("findings").coverage.clone();
    let weak: Vec<&str> = coverage
        .weak
        .iter()
        .map(|region| region.name.as_str())
        .collect();
    assert_eq!(weak, ["the underside"]);
    assert!(coverage.by_one > 0.7 && coverage.by_one < 1.0);
    assert!(coverage.by_four <= coverage.by_two && coverage.by_two <= coverage.by_one);
    assert!(
        report
            .faults
            .iter()
            .any(|fault| fault.message.starts_with("the underside"))
    );
    assert_eq!(report.lines().len(), 10);
}

/// JSON has no NaN: it would come out as null and not come back.
fn comes_back(report: &Preflight) {
    let text = serde_json::to_string(report).expect("JSON");
    let back: Preflight = serde_json::from_str(&text).expect("every figure is finite");
    assert_eq!(back.faults, report.faults);
}

#[test]
fn reports_stay_finite_whatever_the_photographs_show() {
    let dir = tempfile::tempdir().expect("a folder");
    let out = capture(
        dir.path(),
        &DemoOptions {
            size: 40,
            views: 8,
            ..options()
        },
    );
    fs::write(out.join("sparse/0/points3D.txt"), "").expect("no points");
    for color in [[0, 0, 0], [255, 255, 255], [128, 128, 128], [255, 0, 255]] {
        for name in names(&out) {
            retouch(&out, &name, |image| {
                RgbImage::from_pixel(image.width(), image.height(), Rgb(color))
            });
        }
        let report = report(&out);
        comes_back(&report);
        let findings = report.findings.expect("findings");
        assert!(!findings.exposure.drifts && !findings.light.moves_with_object);
        assert!(findings.sharpness.blurred.is_empty() && findings.reprojection.is_none());
    }
}

#[test]
fn one_view_and_a_damaged_photograph_are_reported() {
    let dir = tempfile::tempdir().expect("a folder");
    let out = capture(
        dir.path(),
        &DemoOptions {
            size: 40,
            views: 12,
            ..options()
        },
    );
    let broken = names(&out)[5].clone();
    let path = out.join("images").join(&broken);
    let bytes = fs::read(&path).expect("a photograph");
    fs::write(&path, &bytes[..bytes.len() / 2]).expect("half of it");
    let damaged = report(&out);
    comes_back(&damaged);
    assert!(!damaged.ok);
    assert!(
        damaged.faults[0].severity == Severity::Error && damaged.faults[0].at.contains(&broken)
    );

    let model = fs::read_to_string(out.join("sparse/0/images.txt")).expect("the model");
    let first: Vec<&str> = model.lines().take(4).collect();
    fs::write(out.join("sparse/0/images.txt"), first.join("\n") + "\n").expect("one view");
    fs::write(out.join("test.txt"), "# none\n").expect("no held-out view");
    let single = report(&out);
    comes_back(&single);
    assert!(!single.ok && single.findings.is_none());
}
