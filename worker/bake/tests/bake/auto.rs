//! Preset `auto`: what does not pay is left out, limits hold or are refused; and bfloat16 beside single precision.

use std::cell::RefCell;
use std::path::Path;

use ign_bake::{Event, Preset, Recipe, bake};
use ign_bundle::{Bundle, Metrics};
use serde_json::Value;

use crate::{capture, job, recipe, weights};

/// Bakes with preset `auto`; the figures and the plan.
fn auto(dir: &Path, name: &str, capture: &Path, settings: &[(&str, &str)]) -> (Metrics, Value) {
    let recipe = Recipe {
        preset: Preset::Auto,
        ..recipe(settings)
    };
    let bundle = bake(&job(capture, &dir.join(name), recipe), &|_| {})
        .unwrap_or_else(|error| panic!("{name}: {error}"));
    let bundle = Bundle::open(&bundle).expect("it verifies");
    let plan = bundle.manifest().plan.clone();
    (
        bundle.metrics().expect("metrics").expect("metrics.json"),
        plan,
    )
}

fn steps(plan: &Value, stage: &str) -> u64 {
    plan[format!("{stage}_steps")].as_u64().expect("a number")
}

fn says(plan: &Value, words: &str) -> bool {
    let sentences = plan["words"].as_array().expect("words");
    sentences
        .iter()
        .any(|sentence| sentence.as_str().is_some_and(|s| s.contains(words)))
}

#[test]
fn a_matte_object_gets_no_effects_and_trains_briefly() {
    let dir = tempfile::tempdir().expect("a folder");
    let dir = dir.path();
    let long = [("effects_steps", "2000"), ("composition_steps", "60")];
    let (metrics, plan) = auto(dir, "matte", &capture(dir, 0.0), &long);
    assert_eq!(plan["effects_kept"], false, "{plan:#}");
    // Twice the preset's steps at most; an eighth of that was enough to see that they do not pay.
    assert!(steps(&plan, "effects") < 500, "{plan:#}");
    let (ours, naive) = (metrics.method("ours"), metrics.method("n_ibr"));
    assert!(ours.expect("a row").mse < 1.05 * naive.expect("a row").mse);
    assert!(says(&plan, "no EffectsNet"), "{plan:#}");
}

#[test]
fn a_training_broken_off_in_its_falling_end_ends_where_it_would_have() {
    let dir = tempfile::tempdir().expect("a folder");
    let capture = capture(dir.path(), 0.0);
    let settings = [
        ("effects", "on"),
        ("effects_steps", "400"),
        ("checkpoint_secs", "0"),
    ];
    let recipe = Recipe {
        preset: Preset::Auto,
        ..recipe(&settings)
    };
    let bake = |name: &str, checkpoint, seen: &dyn Fn(Event)| {
        let mut job = job(&capture, &dir.path().join(name), recipe.clone());
        job.checkpoint = checkpoint;
        bake(&job, seen).expect("a bake")
    };
    let effects_steps = |bundle: &Path| {
        let bundle = Bundle::open(bundle).expect("it verifies");
        steps(&bundle.manifest().plan, "effects")
    };
    let kept = RefCell::new(Vec::new());
    let whole = bake("whole", None, &|event| {
        if let Event::Checkpoint { path } = event {
            let copy = path.with_extension(format!("kept{}", kept.borrow().len()));
            std::fs::copy(path, &copy).expect("a copy");
            kept.borrow_mut().push(copy);
        }
    });
    // Effects do not pay; the last quarter of what they trained is the falling end.
    let trained = effects_steps(&whole);
    assert!(trained < 800, "{trained} steps");
    let checkpoint = kept.borrow()[trained as usize * 9 / 10].clone();
    let resumed = bake("resumed", Some(checkpoint), &|_| {});
    assert_eq!(effects_steps(&resumed), trained);
    assert!(weights(&resumed) == weights(&whole), "other weights");
}

#[test]
fn limits_hold_and_the_plan_says_how() {
    let dir = tempfile::tempdir().expect("a folder");
    let dir = dir.path();
    let capture = capture(dir, 0.8);

    let (_, plan) = auto(dir, "target", &capture, &[("target_psnr", "8")]);
    assert_eq!(steps(&plan, "composition"), 0, "{plan:#}");

    let (metrics, plan) = auto(dir, "fast", &capture, &[("min_render_fps", "9999")]);
    assert_eq!(plan["composition_kept"], false);
    assert!(says(&plan, "frames a second"), "{plan:#}");
    assert_eq!(plan["k"], 2);
    assert!(metrics.method("ours").is_some());

    let (metrics, plan) = auto(dir, "small", &capture, &[("max_bundle_mb", "1.6")]);
    let bytes = metrics.method("ours").expect("a row").bundle_bytes;
    assert!(bytes <= 1_600_000, "{bytes}: {plan:#}");
    assert!(says(&plan, "The bundle may have 1.6 MB"), "{plan:#}");

    let (_, plan) = auto(
        dir,
        "brief",
        &capture,
        &[("max_secs", "2"), ("composition_steps", "100000")],
    );
    assert!(steps(&plan, "composition") < 100_000, "{plan:#}");
}

#[test]
fn a_bundle_that_cannot_be_so_small_is_refused_before_training() {
    let dir = tempfile::tempdir().expect("a folder");
    let capture = capture(dir.path(), 0.8);
    let recipe = Recipe {
        preset: Preset::Auto,
        ..recipe(&[("max_bundle_mb", "0.02")])
    };
    let error = bake(&job(&capture, dir.path(), recipe), &|_| {}).expect_err("too small");
    let failure = error.failure();
    assert!(failure.message.contains("max_bundle_mb=0.0"), "{failure:?}");
    assert!(failure.hint.contains("allow more"), "{failure:?}");
    for (key, value) in [("quality", "draft"), ("max_secs", "9")] {
        let error = bake(
            &job(&capture, dir.path(), crate::recipe(&[(key, value)])),
            &|_| {},
        )
        .expect_err("of preset auto alone");
        assert!(
            error.failure().message.contains("needs preset auto"),
            "{error}"
        );
    }
}

/// In the median of several seeds: two trainings that round differently go different ways, in either precision, and end a tenth
/// of a decibel apart, sometimes four.
#[test]
fn training_in_bfloat16_costs_no_twentieth_of_a_decibel() {
    const SEEDS: u64 = 9;
    let dir = tempfile::tempdir().expect("a folder");
    let dir = dir.path();
    let capture = capture(dir, 0.8);
    let psnr = |precision: &str, seed: u64| {
        let recipe = Recipe {
            seed,
            ..recipe(&[
                ("precision", precision),
                ("effects", "on"),
                ("effects_steps", "300"),
                ("composition_steps", "60"),
            ])
        };
        let work = dir.join(format!("{precision}-{seed}"));
        let bundle = bake(&job(&capture, &work, recipe), &|_| {}).expect("a bake");
        let metrics = Bundle::open(&bundle).expect("it verifies").metrics();
        let metrics = metrics.expect("metrics").expect("metrics.json");
        metrics.method("ours").expect("a row").psnr
    };
    let mut gains: Vec<f64> = (0..SEEDS)
        .map(|seed| psnr("bf16", seed) - psnr("fp32", seed))
        .collect();
    gains.sort_by(f64::total_cmp);
    assert!(gains[gains.len() / 2] > -0.05, "{gains:?} dB");
    // Not the same numbers: the setting does something.
    assert!(gains.iter().all(|gain| *gain != 0.0));
}
