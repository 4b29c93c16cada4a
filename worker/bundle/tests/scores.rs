//! Metric functions against scikit-image and flip-evaluator (`tests/reference/make_scores.py`).

#![expect(
    clippy::unwrap_used,
    clippy::float_cmp,
    reason = "a test fails by panicking; figures compared here are exact"
)]

use std::collections::BTreeMap;
use std::path::Path;

use ign_bundle::metrics::{Scores, flip, mse, mse_object, psnr, ssim};
use image::{Rgb, RgbImage};

fn reference(name: &str) -> RgbImage {
    let path = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("tests/reference")
        .join(name);
    image::open(path).unwrap().into_rgb8()
}

#[test]
fn scores_agree_with_independent_programs() {
    let scores: BTreeMap<String, BTreeMap<String, f64>> =
        serde_json::from_str(include_str!("reference/scores.json")).unwrap();
    let target = reference("target.png");
    assert_eq!(scores.len(), 4);
    for (name, expected) in scores {
        let image = reference(&format!("{name}.png"));
        let everywhere = vec![true; (image.width() * image.height()) as usize];
        let ours = Scores::of(&image, &target, &everywhere);
        let check = |what: &str, value: f64, tolerance: f64| {
            assert!(
                (value - expected[what]).abs() < tolerance,
                "{name} {what}: {value}, expected {}",
                expected[what]
            );
        };
        check("mse", ours.mse, 1e-9);
        check("mse", ours.mse_object, 1e-9);
        check("psnr", ours.psnr, 1e-9);
        // The reference filters in f64 as we do.
        check("ssim", ours.ssim, 1e-9);
        // The reference computes in f32, with images as f32.
        check("flip", ours.flip, 2e-5);
    }
}

#[test]
fn equal_images_are_perfect() {
    let target = reference("target.png");
    assert_eq!(mse(&target, &target), 0.0);
    assert_eq!(psnr(0.0), 99.0);
    assert!((ssim(&target, &target) - 1.0).abs() < 1e-12);
    assert_eq!(flip(&target, &target), 0.0);
}

#[test]
fn object_error_ignores_the_rest() {
    let black = RgbImage::new(4, 3);
    let mut image = black.clone();
    image.put_pixel(1, 2, Rgb([3, 0, 0]));
    image.put_pixel(0, 0, Rgb([255, 255, 255]));
    let mut object = vec![false; 12];
    object[2 * 4 + 1] = true;
    object[2 * 4 + 2] = true;
    assert_eq!(mse_object(&image, &black, &object), 9.0 / 6.0);
    assert_eq!(mse_object(&image, &black, &[false; 12]), 0.0);
}

#[test]
fn tiny_images_have_scores() {
    let (a, b) = (
        RgbImage::new(3, 1),
        RgbImage::from_pixel(3, 1, Rgb([255; 3])),
    );
    assert!(ssim(&a, &b) < 0.01 && (0.5..=1.0).contains(&flip(&a, &b)));
}
