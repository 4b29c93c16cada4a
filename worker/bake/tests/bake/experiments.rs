//! The paper's experiments on tiny captures: every one writes its table and its plot.

use std::path::{Path, PathBuf};

use ign_bake::experiment::{self, Experiment, ExperimentJob};
use ign_bake::{Crop, Event, Recipe};
use ign_demo::DemoOptions;
use serde_json::Value;

use crate::recipe;

fn demo(dir: &Path, name: &str, orbit: Option<usize>) -> PathBuf {
    let out = dir.join(name);
    let options = DemoOptions {
        gloss: 0.8,
        size: 40,
        views: 18,
        held_out: orbit.is_none().then_some(2),
        orbit,
        seed: 3,
        ..DemoOptions::default()
    };
    ign_demo::generate(&out, &options, &|_, _| {}).expect("a demo capture");
    out
}

fn tiny() -> Recipe {
    Recipe {
        size: 40,
        crop: Crop::None,
        ..recipe(&[
            ("effects_steps", "4"),
            ("composition_steps", "4"),
            ("preview_frames", "1"),
        ])
    }
}

/// Runs an experiment; returns its rows and how many bakes it took.
fn rows(dir: &Path, experiment: Experiment, captures: &[PathBuf]) -> (Vec<Value>, usize) {
    let bakes = std::cell::Cell::new(0);
    let job = ExperimentJob {
        experiment,
        captures: captures.to_vec(),
        recipe: tiny(),
        out: dir.join("out"),
        seeds: 1,
        only: vec!["head".into(), "gains".into()],
        threads: 1,
    };
    let files = experiment::run(&job, &|event| {
        if let Event::Progress(progress) = event
            && progress.message == "reading the capture"
        {
            bakes.set(bakes.get() + 1);
        }
    })
    .expect("an experiment");
    let name = experiment.name();
    let text = |extension: &str| {
        let path = job.out.join(format!("{name}.{extension}"));
        assert!(files.contains(&path), "{}", path.display());
        std::fs::read_to_string(path).expect("a file")
    };
    let svg = text("svg");
    assert!(
        svg.starts_with("<svg xmlns=") && svg.contains("</style>"),
        "{name}: {svg}"
    );
    assert!(
        svg.contains("class=\"dot") || svg.contains("class=\"level"),
        "{name}: nothing drawn"
    );
    let json: Value = serde_json::from_str(&text("json")).expect("json");
    assert_eq!(json["experiment"], name);
    let rows = json["rows"].as_array().expect("rows").clone();
    let lines = text("md")
        .lines()
        .filter(|line| line.starts_with("| "))
        .count();
    assert_eq!(lines, rows.len() + 1, "{name}");
    for row in &rows {
        let figures = row.as_object().expect("an object").iter();
        for (column, figure) in figures.filter(|(_, value)| !value.is_string()) {
            assert!(
                figure.as_f64().is_some_and(f64::is_finite),
                "{name}: {column} is {figure}"
            );
        }
    }
    (rows, bakes.get())
}

fn figure(row: &Value, column: &str) -> f64 {
    row[column]
        .as_f64()
        .unwrap_or_else(|| panic!("{row} has no {column}"))
}

#[test]
fn every_experiment_makes_its_table_and_its_plot() {
    let dir = tempfile::tempdir().expect("a folder");
    let dir = dir.path();
    let vase = [demo(dir, "vase", None)];

    let (methods, bakes) = rows(dir, Experiment::Methods, &vase);
    let names: Vec<&str> = methods
        .iter()
        .filter_map(|row| row["method"].as_str())
        .collect();
    assert_eq!(names.len(), 9, "{names:?}");
    assert_eq!(bakes, 1);
    // What has been baked is not baked again.
    assert_eq!(rows(dir, Experiment::Methods, &vase), (methods, 0));

    let (effects, _) = rows(dir, Experiment::Effects, &vase);
    let [row] = &effects[..] else {
        panic!("{effects:?}")
    };
    let ratio = figure(row, "with_effects") / figure(row, "without_effects");
    assert!((ratio - figure(row, "ratio")).abs() < 1e-9);

    let (diffuse, _) = rows(dir, Experiment::Diffuse, &vase);
    let [row] = &diffuse[..] else {
        panic!("{diffuse:?}")
    };
    assert!(
        figure(row, "photograph") > 1.0 && figure(row, "estimated") > 0.0,
        "{row}"
    );

    let (corpus, _) = rows(dir, Experiment::Corpus, &vase);
    let views: Vec<f64> = corpus
        .iter()
        .map(|row| figure(row, "train_views"))
        .collect();
    assert_eq!(views, [16.0, 8.0]);

    let orbit = [demo(dir, "orbit", Some(6))];
    let (temporal, _) = rows(dir, Experiment::Temporal, &orbit);
    let [row] = &temporal[..] else {
        panic!("{temporal:?}")
    };
    assert!((figure(row, "frames") - 6.0).abs() < 1e-9);
    // Highlights move over the surface in the photographs themselves.
    assert!(figure(row, "photographs") > 0.1, "{row}");
}

#[test]
fn numbers_of_references_are_compared() {
    let dir = tempfile::tempdir().expect("a folder");
    let dir = dir.path();
    let (rows, bakes) = rows(dir, Experiment::References, &[demo(dir, "vase", None)]);
    // Ten and more references of 16 views; K = 4 of 20 is in both series.
    assert_eq!(bakes, 7);
    let choices: Vec<(f64, f64)> = rows
        .iter()
        .map(|row| (figure(row, "references"), figure(row, "k")))
        .collect();
    assert!(
        choices.contains(&(5.0, 4.0)) && choices.iter().any(|&(_, k)| k > 7.0),
        "{choices:?}"
    );
}

#[test]
fn every_change_is_taken_out_and_put_in_alone() {
    let dir = tempfile::tempdir().expect("a folder");
    let dir = dir.path();
    let (rows, bakes) = rows(dir, Experiment::Ablation, &[demo(dir, "vase", None)]);
    // Two changes on either side of two presets; one row per capture and one over all.
    assert_eq!((bakes, rows.len()), (6, 4));
    for row in &rows {
        assert!(
            figure(row, "removed_low") <= figure(row, "removed"),
            "{row}"
        );
        assert!(figure(row, "alone") <= figure(row, "alone_high"), "{row}");
    }
    let of = |change: &str| {
        let mut rows = rows.iter();
        let row = rows.find(|row| row["change"] == change && row["capture"] == "vase");
        figure(row.unwrap_or_else(|| panic!("no {change}")), "removed")
    };
    // After four steps the painter is nowhere near plain blending, which is where the other head starts.
    assert!(of("blending head") > 2.0, "{rows:?}");
    // Its photographs are steady.
    assert!((of("exposure gains") - 1.0).abs() < 1e-3, "{rows:?}");
}

#[test]
fn what_an_experiment_lacks_is_named() {
    let dir = tempfile::tempdir().expect("a folder");
    let capture = demo(dir.path(), "vase", None);
    std::fs::remove_dir_all(capture.join("truth")).expect("a folder");
    for (experiment, captures, what) in [
        (Experiment::Diffuse, vec![capture], "truth/diffuse"),
        (Experiment::Effects, Vec::new(), "no capture"),
    ] {
        let job = ExperimentJob {
            experiment,
            captures,
            recipe: tiny(),
            out: dir.path().join("out"),
            seeds: 1,
            only: Vec::new(),
            threads: 1,
        };
        let error = experiment::run(&job, &|_| {}).expect_err("it lacks something");
        assert!(error.failure().message.contains(what), "{error}");
        assert!(!error.failure().hint.is_empty());
    }
}
