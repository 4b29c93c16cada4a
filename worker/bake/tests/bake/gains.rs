//! Photographs that differ in exposure: gains undo it, and scores stay those of the photographs.

use std::path::Path;

use ign_bake::bake;
use ign_bundle::{Bundle, held_out_file};
use ign_demo::DemoOptions;
use image::{Rgb, RgbImage};

use crate::{job, recipe};

/// Multiplies a photograph in linear light.
fn expose(path: &Path, factor: f64) {
    let image = image::open(path).expect("a photograph").into_rgb8();
    let value = |encoded: u8| {
        let encoded = f64::from(encoded) / 255.0;
        let light = if encoded <= 0.040_45 {
            encoded / 12.92
        } else {
            ((encoded + 0.055) / 1.055).powf(2.4)
        };
        let light = (light * factor).min(1.0);
        let back = if light <= 0.003_130_8 {
            light * 12.92
        } else {
            1.055 * light.powf(1.0 / 2.4) - 0.055
        };
        (back * 255.0).round() as u8
    };
    let exposed = RgbImage::from_fn(image.width(), image.height(), |x, y| {
        Rgb(image.get_pixel(x, y).0.map(value))
    });
    exposed.save(path).expect("written");
}

#[test]
fn drift_in_exposure_costs_hardly_anything() {
    let dir = tempfile::tempdir().expect("a folder");
    let capture = dir.path().join("capture");
    let options = DemoOptions {
        gloss: 0.2,
        size: 96,
        views: 24,
        ..DemoOptions::default()
    };
    ign_demo::generate(&capture, &options, &|_, _| {}).expect("a demo capture");
    let baked = |name: &str, gains: &str| {
        let recipe = recipe(&[("gains", gains), ("effects", "off")]);
        let folder = bake(&job(&capture, &dir.path().join(name), recipe), &|_| {}).expect("a bake");
        Bundle::open(&folder).expect("it verifies")
    };
    let equalised_by = |bundle: &Bundle| {
        let exposure = bundle.manifest().canonical_exposure.as_ref();
        exposure.expect("an exposure").equalised
    };
    let errors = |bundle: &Bundle| {
        let metrics = bundle.metrics().expect("metrics").expect("metrics.json");
        ["n_ibr", "ibr", "ours"].map(|name| metrics.method(name).expect("a row").mse)
    };

    let steady = baked("steady", "auto");
    assert!(!equalised_by(&steady));
    for view in 0..24 {
        let factor = [0.6, 1.0, 0.75, 0.9, 0.5][view % 5];
        expose(&capture.join(format!("images/view_{view:04}.png")), factor);
    }
    let drifting = baked("off", "off");
    let equalised = baked("auto", "auto");

    assert!(!equalised_by(&drifting));
    assert!(equalised_by(&equalised));
    for ((steady, off), auto) in errors(&steady)
        .into_iter()
        .zip(errors(&drifting))
        .zip(errors(&equalised))
    {
        // Darker photographs have smaller errors, rounding has a larger part in them.
        assert!(auto < 1.1 * steady, "{auto} instead of {steady}");
        assert!(off > 1.5 * auto, "without gains {off}, with {auto}");
    }
    // What is scored is the photograph as it is, in both.
    for view in equalised.held_out_views().expect("views") {
        let file = held_out_file(&view.name, "target");
        let same = |bundle: &Bundle| bundle.read(&file).expect("an image");
        assert_eq!(same(&equalised), same(&drifting), "{}", view.name);
    }
    let gains = |bundle: &Bundle| -> Vec<[f32; 3]> {
        let references = bundle.references().expect("references");
        references.iter().map(|view| view.exposure_gain).collect()
    };
    assert!(
        gains(&drifting)
            .iter()
            .flatten()
            .all(|gain| gain.to_bits() == 1.0_f32.to_bits())
    );
    assert!(
        gains(&equalised)
            .iter()
            .flatten()
            .any(|&gain| (gain - 1.0).abs() > 0.1)
    );
}
