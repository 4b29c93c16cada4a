//! Whole bakes of tiny captures: the bundle renders what was scored, a resumed bake ends like an unbroken one, bad
//! settings and hard captures end as they must.

mod auto;
mod experiments;
mod gains;
mod hard;

use std::cell::RefCell;
use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};

use ign_bake::{BakeJob, Event, PretrainJob, Recipe, bake, pretrain};
use ign_bundle::Bundle;
use ign_demo::DemoOptions;
use ign_events::FailureKind;
use ign_render::BundleRenderer;

fn capture(dir: &Path, gloss: f64) -> PathBuf {
    let out = dir.join("capture");
    let options = DemoOptions {
        gloss,
        size: 48,
        views: 14,
        seed: 3,
        ..DemoOptions::default()
    };
    ign_demo::generate(&out, &options, &|_, _| {}).expect("a demo capture");
    out
}

fn recipe(settings: &[(&str, &str)]) -> Recipe {
    let mut recipe = Recipe {
        size: 40,
        seed: 5,
        ..Recipe::default()
    };
    let small = [
        ("effects_steps", "12"),
        ("composition_steps", "12"),
        ("effects_batch", "512"),
        ("batch", "2"),
        ("references", "6"),
        ("preview_frames", "2"),
    ];
    for (key, value) in small.iter().chain(settings) {
        recipe.settings.insert((*key).into(), (*value).into());
    }
    recipe
}

fn job(capture: &Path, work_dir: &Path, recipe: Recipe) -> BakeJob {
    BakeJob {
        capture_dir: capture.to_owned(),
        capture_digest: format!("sha256:{}", "0".repeat(64)),
        object: ("tests".into(), "vase".into()),
        recipe,
        checkpoint: None,
        work_dir: work_dir.to_owned(),
        threads: 1,
    }
}

/// The weights files of a bundle, byte for byte.
fn weights(bundle: &Path) -> Vec<Vec<u8>> {
    [ign_bundle::EFFECTS_FILE, ign_bundle::COMPOSITION_FILE]
        .iter()
        .filter_map(|file| std::fs::read(bundle.join(file)).ok())
        .collect()
}

/// What a bake would ship at any second starts at plain image-based rendering and is never worse, by more than the noise of
/// choosing on other views than those that are scored.
#[test]
fn standard_is_never_worse_than_plain_blending() {
    const NOISE: f64 = 1.03;
    let dir = tempfile::tempdir().expect("a folder");
    for (name, gloss) in [("matte", 0.0), ("glossy", 0.9)] {
        let folder = dir.path().join(name);
        let capture = capture(&folder, gloss);
        let recipe = recipe(&[("effects_steps", "60"), ("composition_steps", "40")]);
        let bundle = bake(&job(&capture, &folder.join("work"), recipe), &|_| {}).expect("a bake");
        let bundle = Bundle::open(&bundle).expect("it verifies");
        let metrics = bundle.metrics().expect("metrics").expect("metrics.json");
        let ours = metrics.speed_error.iter().filter(|p| p.method == "ours");
        let curve: Vec<(f64, f64)> = ours.map(|p| (p.secs, p.mse)).collect();
        assert!(curve.len() > 8, "{name}: {curve:?}");
        assert!(
            curve.windows(2).all(|pair| pair[0].0 <= pair[1].0),
            "{name}: {curve:?}"
        );
        let (secs, start) = curve[0];
        assert_eq!(secs.to_bits(), 0.0_f64.to_bits(), "{name}");
        assert!(
            curve.iter().all(|(_, mse)| *mse <= NOISE * start),
            "{name}: {curve:?}"
        );
        let measured = &bundle.manifest().plan["measured"];
        let figure = |key: &str| measured[key].as_f64().expect("a figure");
        // What was learned on other objects blends better than the plain weights here, before any training.
        let (learned, plain) = (figure("composition_pretrained_mse"), figure("prior_mse"));
        assert!(learned < plain, "{name}: {measured}");
        // The start is the mean of the same views as n_ibr, weighted.
        let plain = metrics.method("n_ibr").expect("a row").mse;
        assert!(start < 1.1 * plain, "{name}: {start}, n_ibr {plain}");
        let end = metrics.method("ours").expect("a row").mse;
        assert!(
            end <= NOISE * start,
            "{name}: ends at {end}, starts at {start}"
        );
    }
}

#[test]
fn a_bundle_renders_what_was_scored() {
    let dir = tempfile::tempdir().expect("a folder");
    let capture = capture(dir.path(), 0.8);
    for (name, preset, scale) in [
        ("standard", "standard", "fp32"),
        ("half", "standard", "fp16"),
        ("wide", "standard", "fp32"),
        ("paper", "paper", "fp32"),
    ] {
        let mut recipe = recipe(&[("effects", "on")]);
        recipe.preset = serde_json::from_value(preset.into()).expect("a preset");
        recipe
            .settings
            .insert("half_weights".into(), (scale == "fp16").to_string());
        if name == "wide" {
            // The width is known from the weights alone.
            recipe.settings.insert("width".into(), "24".into());
        }
        let folder = bake(&job(&capture, &dir.path().join(name), recipe), &|_| {}).expect("a bake");
        let bundle = Bundle::open(&folder).expect("it verifies");
        let metrics = bundle.metrics().expect("metrics").expect("metrics.json");
        for method in ["vertex_color", "texture", "n_ibr", "ibr", "ours"] {
            assert!(
                metrics
                    .method(method)
                    .is_some_and(|row| row.mse.is_finite()),
                "{name}: {method}"
            );
        }
        assert!(metrics.speed_error.len() >= 4);
        let renderer = BundleRenderer::open(&folder, tch::Device::Cpu).expect("it opens");
        let views = bundle.held_out_views().expect("views");
        assert!(!views.is_empty());
        for view in views {
            assert_eq!(view.exposure_gain.map(f32::to_bits), [1.0_f32.to_bits(); 3]);
            let (view, camera) = (view.name, view.camera);
            let file = folder.join(ign_bundle::held_out_file(&view, "ours"));
            let scored = image::open(file).expect("an image").into_rgb8();
            let rendered = renderer.render_normalised(&camera);
            let worst = scored
                .iter()
                .zip(rendered.iter())
                .map(|(a, b)| a.abs_diff(*b))
                .max();
            assert!(
                worst <= Some(1),
                "{name}, {view}: differs by {worst:?} of 255"
            );
        }
    }
}

#[test]
fn pretraining_writes_weights_of_the_network_that_was_asked_for() {
    let dir = tempfile::tempdir().expect("a folder");
    let captures: Vec<PathBuf> = [("matte", 0.0), ("glossy", 0.9)]
        .map(|(name, gloss)| capture(&dir.path().join(name), gloss))
        .into();
    let job = |captures: &[PathBuf], out: &str| PretrainJob {
        captures: captures.to_owned(),
        recipe: recipe(&[("width", "8")]),
        out: dir.path().join(out),
        threads: 1,
    };
    let made = |out: &str| {
        pretrain(&job(&captures, out), &|_| {}).expect("weights");
        std::fs::read(dir.path().join(out)).expect("a file")
    };
    let bytes = made("first");
    assert_eq!(bytes, made("second"), "the same seed, other weights");
    let tensors = ign_bundle::weights::decode("first", &bytes).expect("weights");
    let shape = |name: &str| tensors.get(name).map(|tensor| tensor.shape.clone());
    assert_eq!(shape("composition.stem.weight"), Some(vec![8, 33, 3, 3]));
    // Others may read it, as any file that is made here.
    std::fs::write(dir.path().join("any"), []).expect("a file");
    let mode = |name: &str| {
        let data = std::fs::metadata(dir.path().join(name)).expect("a file");
        data.permissions().mode()
    };
    assert_eq!(mode("first"), mode("any"));
    // It learned: the head starts at zero.
    let head = &tensors["composition.head.weight"].values;
    assert!(head.iter().any(|value| *value != 0.0));

    let error = pretrain(&job(&[], "first"), &|_| {}).expect_err("no capture");
    assert!(error.failure().hint.contains("demo-capture"), "{error}");
    let error = pretrain(&job(&captures, "absent/file"), &|_| {}).expect_err("no folder");
    assert!(error.failure().message.contains("absent/file"), "{error}");
    assert_eq!(
        std::fs::read(dir.path().join("first")).expect("a file"),
        bytes
    );
}

/// Every method has its row, and those that train their curve.
#[test]
fn all_methods_are_scored_beside_ours() {
    let dir = tempfile::tempdir().expect("a folder");
    let capture = capture(dir.path(), 0.8);
    let trained = [
        "pix2pix_position",
        "pix2pix_depth",
        "ours_no_effects",
        "paper",
    ];
    let cheap = ["vertex_color", "texture", "n_ibr", "ibr"];
    for (preset, trained) in [("standard", &trained[..]), ("paper", &trained[..3])] {
        let methods = [&cheap[..], trained].concat();
        let mut recipe = recipe(&[("effects", "on"), ("methods", &methods.join(","))]);
        recipe.preset = serde_json::from_value(preset.into()).expect("a preset");
        let percent = RefCell::new(Vec::new());
        let folder = bake(&job(&capture, &dir.path().join(preset), recipe), &|event| {
            if let Event::Progress(progress) = event {
                percent.borrow_mut().push(progress.percent);
            }
        })
        .expect("a bake");
        let percent = percent.into_inner();
        let rises = percent.windows(2).all(|pair| pair[0] <= pair[1] + 1e-9);
        assert!(rises, "{preset}: {percent:?}");
        let bundle = Bundle::open(&folder).expect("it verifies");
        let metrics = bundle.metrics().expect("metrics").expect("metrics.json");
        let rows: Vec<&str> = metrics
            .methods
            .iter()
            .map(|row| row.name.as_str())
            .collect();
        assert_eq!(rows, [&cheap[..], &["ours"], trained].concat(), "{preset}");
        let mut errors: Vec<u64> = metrics.methods.iter().map(|r| r.mse.to_bits()).collect();
        errors.sort_unstable();
        errors.dedup();
        assert_eq!(
            errors.len(),
            rows.len(),
            "{preset}: two methods have one error"
        );
        for name in trained.iter().chain(&["ours"]) {
            let row = metrics.method(name).expect("a row");
            assert!(row.train_secs > 0.0, "{preset}: {name}");
            let curve = metrics.speed_error.iter().filter(|p| p.method == **name);
            assert!(curve.count() >= 2, "{preset}: {name}");
        }
    }
}

#[test]
fn resuming_gives_what_an_unbroken_bake_gives() {
    let dir = tempfile::tempdir().expect("a folder");
    let capture = capture(dir.path(), 0.8);
    let recipe = recipe(&[("effects", "on"), ("checkpoint_secs", "0")]);
    let kept = RefCell::new(Vec::new());
    let whole = bake(
        &job(&capture, &dir.path().join("whole"), recipe.clone()),
        &|event| {
            if let Event::Checkpoint { path } = event {
                let copy = dir
                    .path()
                    .join(format!("kept-{}.safetensors", kept.borrow().len()));
                std::fs::copy(path, &copy).expect("a copy");
                kept.borrow_mut().push(copy);
            }
        },
    )
    .expect("a bake");
    let kept = kept.into_inner();
    assert!(kept.len() > 20, "{} checkpoints", kept.len());
    // In the middle of the effects, and of the composition.
    for at in [5, 20] {
        let mut job = job(
            &capture,
            &dir.path().join(format!("resumed-{at}")),
            recipe.clone(),
        );
        job.checkpoint = Some(kept[at].clone());
        let resumed = bake(&job, &|_| {}).expect("a resumed bake");
        assert!(
            weights(&resumed) == weights(&whole),
            "resumed from checkpoint {at}: other weights"
        );
    }
}

/// Where training views lie is no part of what is trained, broken off or not.
#[test]
fn a_cache_too_small_for_one_view_gives_the_same_bundle() {
    let dir = tempfile::tempdir().expect("a folder");
    let capture = capture(dir.path(), 0.8);
    let methods = ("methods", "n_ibr,pix2pix_depth");
    let mut bundles = Vec::new();
    for cache_mb in ["1000", "0"] {
        let recipe = recipe(&[("checkpoint_secs", "0"), ("cache_mb", cache_mb), methods]);
        let (kept, on_disk) = (RefCell::new(Vec::new()), RefCell::new(0));
        let whole = job(&capture, &dir.path().join(cache_mb), recipe.clone());
        let bundle = bake(&whole, &|event| match event {
            Event::Checkpoint { path } => kept
                .borrow_mut()
                .push(std::fs::read(path).expect("a checkpoint")),
            Event::Log { message, .. } => {
                *on_disk.borrow_mut() += u32::from(message.contains("lie on disk"));
            }
            Event::Progress(_) | Event::Done { .. } | Event::Failed(_) => {}
        })
        .expect("a bake");
        // Ours and the one compared with it.
        assert_eq!(on_disk.into_inner(), if cache_mb == "0" { 2 } else { 0 });
        bundles.push(bundle);
        let work = std::fs::read_dir(&whole.work_dir).expect("a folder");
        let mut left: Vec<_> = work
            .map(|entry| entry.expect("an entry").file_name())
            .collect();
        left.sort_unstable();
        assert_eq!(left, ["bundle", "checkpoints"]);
        if cache_mb == "0" {
            let checkpoint = dir.path().join("kept.safetensors");
            let kept = kept.into_inner();
            std::fs::write(&checkpoint, &kept[kept.len() / 2]).expect("written");
            let resumed = BakeJob {
                checkpoint: Some(checkpoint),
                ..job(&capture, &dir.path().join("resumed"), recipe)
            };
            bundles.push(bake(&resumed, &|_| {}).expect("a resumed bake"));
        }
    }
    let errors = |bundle: &Path| -> Vec<u64> {
        let bundle = Bundle::open(bundle).expect("it verifies");
        let metrics = bundle.metrics().expect("metrics").expect("metrics.json");
        // What is compared trains as long as ours did, by the clock.
        let rows = metrics.methods.iter();
        let by_steps = rows.filter(|row| row.name != "pix2pix_depth");
        by_steps.map(|row| row.mse.to_bits()).collect()
    };
    for bundle in &bundles[1..] {
        assert!(
            weights(bundle) == weights(&bundles[0]),
            "{}",
            bundle.display()
        );
        assert_eq!(errors(bundle), errors(&bundles[0]), "{}", bundle.display());
    }
}

#[test]
fn a_checkpoint_that_cannot_be_used_starts_from_the_beginning() {
    let dir = tempfile::tempdir().expect("a folder");
    let capture = capture(dir.path(), 0.0);
    let last = RefCell::new(None);
    let short = [("effects", "off")];
    let other = recipe(&[short[0], ("k", "3")]);
    bake(&job(&capture, &dir.path().join("one"), other), &|event| {
        if let Event::Checkpoint { path } = event {
            *last.borrow_mut() = Some(path);
        }
    })
    .expect("a bake");
    let of_another_recipe = last.into_inner().expect("a checkpoint");
    let whole = std::fs::read(&of_another_recipe).expect("a file");
    let cut = dir.path().join("cut.safetensors");
    std::fs::write(&cut, &whole[..whole.len() / 2]).expect("written");

    // Same seed, same device, same result: all three trainings from the beginning end alike.
    let afresh = job(&capture, &dir.path().join("afresh"), recipe(&short));
    let expected = bake(&afresh, &|_| {}).expect("a bake");
    let errors = |bundle: &Path| -> Vec<u64> {
        let bundle = Bundle::open(bundle).expect("it verifies");
        let metrics = bundle.metrics().expect("metrics").expect("metrics.json");
        let rows = metrics.methods.iter().map(|row| row.mse);
        let curve = metrics.speed_error.iter().map(|point| point.mse);
        rows.chain(curve).map(f64::to_bits).collect()
    };
    for (name, checkpoint) in [("other", of_another_recipe), ("cut", cut)] {
        let mut job = job(&capture, &dir.path().join(name), recipe(&short));
        job.checkpoint = Some(checkpoint);
        let warned = RefCell::new(false);
        let bundle = bake(&job, &|event| {
            if let Event::Log { message, .. } = event {
                *warned.borrow_mut() |= message.contains("starts from the beginning");
            }
        });
        let bundle = bundle.expect("a bake");
        assert!(weights(&bundle) == weights(&expected), "{name}");
        assert_eq!(errors(&bundle), errors(&expected), "{name}");
        assert!(warned.into_inner(), "{name}");
    }
}

#[test]
fn bad_settings_and_captures_are_the_submitters_fault() {
    let dir = tempfile::tempdir().expect("a folder");
    let capture = capture(dir.path(), 0.0);
    let unknown = job(
        &capture,
        &dir.path().join("a"),
        recipe(&[("colour", "blue")]),
    );
    let empty = dir.path().join("empty");
    std::fs::create_dir(&empty).expect("a folder");
    for job in [unknown, job(&empty, &dir.path().join("b"), recipe(&[]))] {
        let failure = bake(&job, &|_| {}).expect_err("cannot be baked").failure();
        assert_eq!(failure.kind, FailureKind::InvalidInput);
        assert!(
            !failure.message.is_empty() && !failure.hint.is_empty(),
            "{failure:?}"
        );
    }
}
