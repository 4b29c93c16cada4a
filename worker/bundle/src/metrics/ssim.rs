//! Structural similarity (Wang, Bovik, Sheikh, Simoncelli 2004).
//!
//! Gaussian window of 11 by 11 pixels with sigma 1.5, K1 = 0.01, K2 = 0.03, population covariance, range 255; per
//! channel, averaged over the pixels whose window lies inside the image, then over channels: the authors' setting and
//! scikit-image's with `gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=255`.

use image::RgbImage;

const RADIUS: usize = 5;
const SIGMA: f64 = 1.5;
const C1: f64 = (0.01 * 255.0) * (0.01 * 255.0);
const C2: f64 = (0.03 * 255.0) * (0.03 * 255.0);

/// Mean structural similarity, in [-1, 1]. Images smaller than the window are extended by mirroring.
///
/// # Panics
/// If the sizes differ.
pub fn ssim(image: &RgbImage, target: &RgbImage) -> f64 {
    assert_eq!(
        image.dimensions(),
        target.dimensions(),
        "images of different size cannot be compared"
    );
    let (width, height) = (image.width() as usize, image.height() as usize);
    if width == 0 || height == 0 {
        return 1.0;
    }
    (0..3)
        .map(|channel| {
            channel_ssim(
                &plane(image, channel),
                &plane(target, channel),
                width,
                height,
            )
        })
        .sum::<f64>()
        / 3.0
}

fn plane(image: &RgbImage, channel: usize) -> Vec<f64> {
    image.pixels().map(|p| f64::from(p.0[channel])).collect()
}

fn channel_ssim(a: &[f64], b: &[f64], width: usize, height: usize) -> f64 {
    let product = |x: &[f64], y: &[f64]| x.iter().zip(y).map(|(x, y)| x * y).collect::<Vec<f64>>();
    let blur = |v: &[f64]| blur(v, width, height);
    let (mean_a, mean_b) = (blur(a), blur(b));
    let (aa, bb, ab) = (
        blur(&product(a, a)),
        blur(&product(b, b)),
        blur(&product(a, b)),
    );
    let border = |size: usize| {
        if size > 2 * RADIUS {
            RADIUS..size - RADIUS
        } else {
            0..size
        }
    };
    let (mut sum, mut count) = (0.0, 0_usize);
    for y in border(height) {
        for i in border(width).map(|x| y * width + x) {
            let (ma, mb) = (mean_a[i], mean_b[i]);
            let (var_a, var_b, cov) = (aa[i] - ma * ma, bb[i] - mb * mb, ab[i] - ma * mb);
            sum += ((2.0 * ma * mb + C1) * (2.0 * cov + C2))
                / ((ma * ma + mb * mb + C1) * (var_a + var_b + C2));
            count += 1;
        }
    }
    sum / count as f64
}

/// Separable Gaussian, mirrored at the borders (edge pixel repeated).
fn blur(values: &[f64], width: usize, height: usize) -> Vec<f64> {
    let offsets = -(RADIUS as isize)..=RADIUS as isize;
    let raw: Vec<f64> = offsets
        .map(|x| (-0.5 * (x as f64 / SIGMA).powi(2)).exp())
        .collect();
    let total: f64 = raw.iter().sum();
    let kernel: Vec<f64> = raw.iter().map(|w| w / total).collect();
    let mirror = |i: isize, size: usize| {
        let period = 2 * size as isize;
        let i = i.rem_euclid(period);
        (if i < size as isize { i } else { period - 1 - i }) as usize
    };
    let tap =
        |at: usize, size: usize, k: usize| mirror(at as isize + k as isize - RADIUS as isize, size);
    let mut rows = vec![0.0; values.len()];
    for y in 0..height {
        for x in 0..width {
            rows[y * width + x] = kernel
                .iter()
                .enumerate()
                .map(|(k, w)| w * values[y * width + tap(x, width, k)])
                .sum();
        }
    }
    let mut out = vec![0.0; values.len()];
    for y in 0..height {
        for x in 0..width {
            out[y * width + x] = kernel
                .iter()
                .enumerate()
                .map(|(k, w)| w * rows[tap(y, height, k) * width + x])
                .sum();
        }
    }
    out
}
