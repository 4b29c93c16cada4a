//! What the photographs say about each other: gains, moving light, blur, coverage; and reports that stay finite.
//!
//! The captures are traced by ign-demo, so the truth is known; what is wrong with them is put in afterwards.

use std::fs;
use std::path::{Path, PathBuf};

use ign_capture::{
    Gains, ImportError, ImportOptions, Preflight, PreflightOptions, Scene, Severity, Survey,
    import, preflight,
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
            budget_secs: None,
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

/// The gains undo `factor` in every view to a percent, up to the one factor that nobody can know.
fn assert_recovered(gains: &Gains, channel: usize, factor: impl Fn(usize) -> f64) {
    let views = gains.per_view.iter().enumerate();
    let products: Vec<f64> = views
        .map(|(view, gain)| gain[channel] * factor(view))
        .collect();
    let mean = products.iter().sum::<f64>() / products.len() as f64;
    let off: Vec<f64> = products
        .iter()
        .map(|product| 100.0 * (product / mean - 1.0))
        .collect();
    assert!(
        off.iter().all(|percent| percent.abs() < 1.0),
        "channel {channel}: off by percent {off:.2?}"
    );
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
        assert_recovered(&gains, channel, |view| drift(view)[channel]);
    }
    let report = report(&out);
    assert!(report.ok);
    let findings = report.findings.expect("findings");
    assert!(findings.exposure.drifts && findings.exposure.white_balance_spread > 0.1);
    assert!(findings.exposure.spread_stops > 0.4);
}

#[test]
fn clipped_highlights_do_not_pull_at_the_gains() {
    let dir = tempfile::tempdir().expect("a folder");
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
    // Every third photograph is so bright that most of the white glaze reaches the sensor's limit.
    let factor = |view: usize| if view.is_multiple_of(3) { 2.2 } else { 0.9 };
    for (view, name) in names(&out).iter().enumerate() {
        retouch(&out, name, |image| exposed(&image, [factor(view); 3]));
    }
    let scene = imported(&out);
    let exposure = report(&out).findings.expect("findings").exposure;
    assert!(exposure.overexposed.len() >= 6, "{exposure:?}");
    let gains = Gains::estimate(&scene, &Survey::new(&scene));
    assert!(gains.needed);
    for channel in 0..3 {
        assert_recovered(&gains, channel, factor);
    }
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

/// The capture without some of its model's views.
fn without_views(dir: &Path, keep: impl Fn(usize) -> bool) {
    let path = dir.join("sparse/0/images.txt");
    let model = fs::read_to_string(&path).expect("the model");
    let (comments, lines): (Vec<&str>, Vec<&str>) =
        model.lines().partition(|line| line.starts_with('#'));
    let kept = lines.chunks(2).enumerate().filter(|(view, _)| keep(*view));
    let kept: Vec<&str> = kept.flat_map(|(_, lines)| lines.iter().copied()).collect();
    fs::write(path, [comments, kept].concat().join("\n") + "\n").expect("written");
    // Held-out views that are no more.
    fs::remove_file(dir.join("test.txt")).expect("removed");
}

fn warns(report: &Preflight, start: &str) -> bool {
    report.faults.iter().any(|fault| {
        fault.severity == Severity::Warning
            && fault.message.contains(start)
            && !fault.hint.is_empty()
    })
}

/// The demo's views go round the object in a spiral: neighbours in it are neighbours around the object.
#[test]
fn baselines_that_are_wide_one_sided_or_nothing_are_told() {
    let small = DemoOptions {
        size: 40,
        views: 60,
        ..options()
    };
    let wide = "neighbouring views are";
    let one_sided = "all views lie within";
    let repeated = "views repeat another one's place";
    let dir = tempfile::tempdir().expect("a folder");
    let out = capture(dir.path(), &small);
    let sound_model = fs::read_to_string(out.join("sparse/0/images.txt")).expect("the model");
    let held_out = fs::read_to_string(out.join("test.txt")).expect("a list");
    let scene = imported(&out);
    let found = |change: &dyn Fn()| {
        fs::write(out.join("sparse/0/images.txt"), &sound_model).expect("written");
        fs::write(out.join("test.txt"), &held_out).expect("written");
        change();
        let report = report(&out);
        let baselines = report
            .findings
            .as_ref()
            .expect("findings")
            .baselines
            .clone();
        let told = [wide, one_sided, repeated].map(|words| warns(&report, words));
        (baselines, told)
    };

    let (sound, told) = found(&|| ());
    assert_eq!(told, [false; 3], "{sound:?}");
    assert!(sound.nearest_degrees_median < 25.0 && sound.widest_degrees > 120.0);

    let (few, told) = found(&|| without_views(&out, |view| view % 7 == 0));
    assert_eq!(told, [true, false, false], "{few:?}");
    assert!(few.nearest_degrees_median > 25.0);

    let middle = scene.views[30].camera.center();
    let (near, told) = found(&|| {
        without_views(&out, |view| {
            let center = scene.views[view].camera.center();
            middle.angle_between(center).to_degrees() < 22.0
        });
    });
    assert!(told[1] && !told[2], "{near:?}");
    assert!(near.widest_degrees < 45.0);

    let (twice, told) = found(&|| {
        let name = &scene.views[scene.train[4]].name;
        let line = sound_model.lines().find(|line| line.ends_with(name));
        let (rest, _) = line.and_then(|line| line.rsplit_once(' ')).expect("a view");
        let (_, pose) = rest.split_once(' ').expect("an id");
        for folder in ["images", "masks"] {
            let folder = out.join(folder);
            fs::copy(folder.join(name), folder.join("copy.png")).expect("a copy");
        }
        let model = format!("{sound_model}999 {pose} copy.png\n\n");
        fs::write(out.join("sparse/0/images.txt"), model).expect("written");
    });
    assert_eq!(told, [false, false, true], "{twice:?}");
    assert_eq!(twice.duplicates.len(), 1);
}

#[test]
fn a_loose_reconstruction_is_told() {
    for (error_px, told) in [(0.4, false), (1.9, true)] {
        let dir = tempfile::tempdir().expect("a folder");
        let out = capture(
            dir.path(),
            &DemoOptions {
                size: 40,
                views: 12,
                ..options()
            },
        );
        let path = out.join("sparse/0/points3D.txt");
        let points: Vec<String> = (1..=50)
            .map(|id| format!("{id} 0 0 0.{id:02} 9 9 9 {error_px} 1 0 2 0"))
            .collect();
        fs::write(&path, points.join("\n")).expect("points");
        let report = report(&out);
        let found = report
            .findings
            .as_ref()
            .and_then(|findings| findings.reprojection.clone())
            .expect("points with errors");
        assert!(
            (found.median_px - error_px).abs() < 1e-9 && (found.mean_px - error_px).abs() < 1e-9
        );
        assert_eq!(warns(&report, "the reconstruction fits loosely"), told);
    }
}

#[test]
fn sizes_and_places_are_told() {
    let dir = tempfile::tempdir().expect("a folder");
    let out = capture(
        dir.path(),
        &DemoOptions {
            size: 40,
            views: 12,
            ..options()
        },
    );
    let settings = |metres: &str| {
        fs::write(out.join("capture.toml"), metres).expect("settings");
        let report = report(&out);
        let told = warns(&report, "metres large");
        (report.findings.expect("findings").scale, told)
    };
    let (unknown, told) = settings("");
    assert!(!told && unknown.extent_metres.is_none() && !unknown.georeferenced);
    assert!(unknown.words.starts_with("size unknown"));
    let unit = 0.3 / unknown.extent;
    let (usual, told) = settings(&format!("metres_per_scene_unit = {unit}\n"));
    assert!(!told && (usual.extent_metres.expect("metres") - 0.3).abs() < 1e-9);
    assert_eq!(usual.words, "can be held in two hands");
    // Millimetres taken for metres.
    let (huge, told) = settings(&format!("metres_per_scene_unit = {}\n", 1000.0 * unit));
    assert!(told && huge.words == "larger than a person", "{huge:?}");
}

#[test]
fn the_forecast_follows_the_recipe() {
    let dir = tempfile::tempdir().expect("a folder");
    let out = capture(
        dir.path(),
        &DemoOptions {
            size: 40,
            views: 12,
            ..options()
        },
    );
    let forecast = |size: u32, budget_secs: Option<f64>| {
        let options = PreflightOptions {
            proxy: None,
            size,
            budget_secs,
        };
        let report = preflight(&out, &options);
        let words = report.lines().last().expect("a line").text.clone();
        (report.findings.expect("findings").forecast, words)
    };
    let (free, words) = forecast(64, None);
    assert!(
        !free.ends_by_budget && words.contains("roughly, on two CPU cores"),
        "{words}"
    );
    let (short, words) = forecast(64, Some(90.0));
    assert!(short.ends_by_budget && (short.training_secs - 90.0).abs() < 1e-9);
    assert!(
        words.contains("2 min of training, the recipe's budget"),
        "{words}"
    );
    // A budget beyond what the steps take ends nothing.
    let (long, _) = forecast(64, Some(1e6));
    assert!(!long.ends_by_budget && (long.training_secs - free.training_secs).abs() < 1e-9);
    let (large, _) = forecast(128, None);
    assert!(large.training_bytes > free.training_bytes && large.bundle_bytes > free.bundle_bytes);
}

#[test]
fn without_a_mesh_the_demos_points_make_one() {
    let dir = tempfile::tempdir().expect("a folder");
    let out = capture(dir.path(), &options());
    let (center, radius) = imported(&out).mesh.bounding_sphere();
    fs::remove_file(out.join("mesh.ply")).expect("removed");
    let named = match import(&out, &ImportOptions::default()) {
        Err(ImportError::Faults(faults)) => faults,
        other => panic!("{other:?}"),
    };
    assert!(named[0].at.starts_with("capture.toml") && named[0].hint.contains("model's points"));
    fs::remove_file(out.join("capture.toml")).expect("removed");
    let scene = imported(&out);
    let words = scene.info.proxy_built.as_ref().expect("built");
    let (built_center, built_radius) = scene.mesh.bounding_sphere();
    assert!(built_center.distance(center) < 0.1 * radius, "{words}");
    assert!((built_radius / radius - 1.0).abs() < 0.1, "{words}");
}
