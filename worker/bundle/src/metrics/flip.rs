//! LDR-FLIP (Andersson, Nilsson, Akenine-Moeller, Oskarsson, Astroem, Fairchild 2020): the difference a person sees
//! when two images alternate.
//!
//! Written from the paper: contrast sensitivity filters in an opponent space, `HyAB` distance between Hunt-adjusted
//! L*a*b* colours, edge and point features, and their combination. Viewing distance is the paper's default, 67.02
//! pixels per degree. Every filter is a sum of separable Gaussians (or their derivatives), so all are run as rows
//! and columns; borders repeat the edge pixel.

use image::RgbImage;

const PIXELS_PER_DEGREE: f64 = 67.020_643_276_582_25;
const WHITE: [f64; 3] = [0.950_428_545_377_181, 1.0, 1.088_900_370_798_128];
const RGB_TO_XYZ: [[f64; 3]; 3] = [
    [
        10_135_552.0 / 24_577_794.0,
        8_788_810.0 / 24_577_794.0,
        4_435_075.0 / 24_577_794.0,
    ],
    [
        2_613_072.0 / 12_288_897.0,
        8_788_810.0 / 12_288_897.0,
        887_015.0 / 12_288_897.0,
    ],
    [
        1_425_312.0 / 73_733_382.0,
        8_788_810.0 / 73_733_382.0,
        70_074_185.0 / 73_733_382.0,
    ],
];
/// Exponent that spreads colour differences (`q_c`).
const COLOR_EXPONENT: f64 = 0.7;
/// Differences below this share of the largest (`p_c`) are spread over [0, `p_t`].
const COLOR_KNEE: f64 = 0.4;
const COLOR_KNEE_VALUE: f64 = 0.95;
/// Width of the feature detectors in degrees (`w`).
const FEATURE_WIDTH: f64 = 0.082;
/// Exponent of feature differences (`q_f`).
const FEATURE_EXPONENT: f64 = 0.5;

type Planes = [Vec<f64>; 3];

/// Mean LDR-FLIP error, in [0, 1]: 0 for equal images.
///
/// # Panics
/// If the sizes differ.
pub fn flip(image: &RgbImage, target: &RgbImage) -> f64 {
    let map = flip_map(image, target);
    map.iter().sum::<f64>() / map.len().max(1) as f64
}

/// LDR-FLIP error per pixel, row-major, in [0, 1].
///
/// # Panics
/// If the sizes differ.
pub fn flip_map(image: &RgbImage, target: &RgbImage) -> Vec<f64> {
    assert_eq!(
        image.dimensions(),
        target.dimensions(),
        "images of different size cannot be compared"
    );
    let size = (image.width() as usize, image.height() as usize);
    if image.is_empty() {
        return Vec::new();
    }
    let (a, b) = (opponent(image), opponent(target));
    let color = color_difference(&perceived(&a, size), &perceived(&b, size));
    let feature = feature_difference(&a[0], &b[0], size);
    color
        .iter()
        .zip(feature)
        .map(|(c, f)| c.powf(1.0 - f))
        .collect()
}

/// `YCxCz` planes of an 8-bit sRGB image.
fn opponent(image: &RgbImage) -> Planes {
    let mut planes = [const { Vec::new() }; 3];
    for pixel in image.pixels() {
        let linear = pixel.0.map(|v| {
            let v = f64::from(v) / 255.0;
            if v <= 0.04045 {
                v / 12.92
            } else {
                ((v + 0.055) / 1.055).powf(2.4)
            }
        });
        let [x, y, z] = relative_xyz(linear);
        for (plane, value) in
            planes
                .iter_mut()
                .zip([116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)])
        {
            plane.push(value);
        }
    }
    planes
}

/// XYZ of linear RGB relative to the white point.
fn relative_xyz(rgb: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|row| {
        RGB_TO_XYZ[row]
            .iter()
            .zip(rgb)
            .map(|(m, v)| m * v)
            .sum::<f64>()
            / WHITE[row]
    })
}

/// Linear RGB of XYZ relative to the white point.
fn rgb_from_relative_xyz(relative: [f64; 3]) -> [f64; 3] {
    let m = glam::DMat3::from_cols_array_2d(&RGB_TO_XYZ).transpose();
    let xyz = glam::DVec3::from_array(relative) * glam::DVec3::from_array(WHITE);
    (m.inverse() * xyz).to_array()
}

/// What the eye resolves of an image: filtered, as Hunt-adjusted L*a*b*.
fn perceived(opponent: &Planes, size: (usize, usize)) -> Planes {
    // (amplitude, width) of the Gaussians of each channel's contrast sensitivity.
    const SENSITIVITY: [&[(f64, f64)]; 3] = [
        &[(1.0, 0.0047)],
        &[(1.0, 0.0053)],
        &[(34.1, 0.04), (13.5, 0.025)],
    ];
    const WIDEST: f64 = 0.04;
    let pi = std::f64::consts::PI;
    let radius = (3.0 * (WIDEST / (2.0 * pi * pi)).sqrt() * PIXELS_PER_DEGREE).ceil() as isize;
    let filtered: Planes = std::array::from_fn(|channel| {
        let mut sum = vec![0.0; opponent[channel].len()];
        let mut total = 0.0;
        for &(amplitude, width) in SENSITIVITY[channel] {
            let taps: Vec<f64> = (-radius..=radius)
                .map(|i| (-(pi * i as f64 / PIXELS_PER_DEGREE).powi(2) / width).exp())
                .collect();
            let scale = amplitude * (pi / width).sqrt();
            total += scale * taps.iter().sum::<f64>().powi(2);
            for (sum, v) in sum
                .iter_mut()
                .zip(separable(&opponent[channel], size, &taps, &taps))
            {
                *sum += scale * v;
            }
        }
        sum.iter().map(|v| v / total).collect()
    });
    let mut lab = [const { Vec::new() }; 3];
    for ((y, cx), cz) in filtered[0].iter().zip(&filtered[1]).zip(&filtered[2]) {
        let y = (y + 16.0) / 116.0;
        let rgb = rgb_from_relative_xyz([y + cx / 500.0, y, y - cz / 200.0]);
        for (plane, value) in lab.iter_mut().zip(hunt_lab(rgb.map(|v| v.clamp(0.0, 1.0)))) {
            plane.push(value);
        }
    }
    lab
}

/// L*a*b* of linear RGB, chroma scaled by lightness (Hunt effect).
fn hunt_lab(rgb: [f64; 3]) -> [f64; 3] {
    const DELTA: f64 = 6.0 / 29.0;
    let [x, y, z] = relative_xyz(rgb).map(|t| {
        if t > DELTA.powi(3) {
            t.cbrt()
        } else {
            t / (3.0 * DELTA * DELTA) + 4.0 / 29.0
        }
    });
    let lightness = 116.0 * y - 16.0;
    [
        lightness,
        0.01 * lightness * 500.0 * (x - y),
        0.01 * lightness * 200.0 * (y - z),
    ]
}

fn hyab(a: [f64; 3], b: [f64; 3]) -> f64 {
    (a[0] - b[0]).abs() + (a[1] - b[1]).hypot(a[2] - b[2])
}

fn color_difference(a: &Planes, b: &Planes) -> Vec<f64> {
    let largest = hyab(hunt_lab([0.0, 1.0, 0.0]), hunt_lab([0.0, 0.0, 1.0])).powf(COLOR_EXPONENT);
    let knee = COLOR_KNEE * largest;
    (0..a[0].len())
        .map(|i| {
            let at = |planes: &Planes| [planes[0][i], planes[1][i], planes[2][i]];
            let d = hyab(at(a), at(b)).powf(COLOR_EXPONENT);
            if d < knee {
                d * COLOR_KNEE_VALUE / knee
            } else {
                COLOR_KNEE_VALUE + (d - knee) / (largest - knee) * (1.0 - COLOR_KNEE_VALUE)
            }
        })
        .collect()
}

fn feature_difference(a: &[f64], b: &[f64], size: (usize, usize)) -> Vec<f64> {
    let sigma = 0.5 * FEATURE_WIDTH * PIXELS_PER_DEGREE;
    let radius = (3.0 * sigma).ceil() as isize;
    let positions = || (-radius..=radius).map(|i| i as f64);
    let gaussian = |x: f64| (-x * x / (2.0 * sigma * sigma)).exp();
    let smooth = one_sided(positions().map(gaussian).collect());
    let edge = one_sided(positions().map(|x| -x * gaussian(x)).collect());
    let point = one_sided(
        positions()
            .map(|x| (x * x / (sigma * sigma) - 1.0) * gaussian(x))
            .collect(),
    );
    let strength = |luma: &[f64], taps: &[f64]| -> Vec<f64> {
        let across = separable(luma, size, taps, &smooth);
        let down = separable(luma, size, &smooth, taps);
        across.iter().zip(down).map(|(x, y)| x.hypot(y)).collect()
    };
    let normalised = |y: &[f64]| y.iter().map(|y| (y + 16.0) / 116.0).collect::<Vec<f64>>();
    let (a, b) = (normalised(a), normalised(b));
    let difference = |taps: &[f64]| -> Vec<f64> {
        strength(&a, taps)
            .iter()
            .zip(strength(&b, taps))
            .map(|(a, b)| (a - b).abs())
            .collect()
    };
    difference(&edge)
        .iter()
        .zip(difference(&point))
        .map(|(e, p)| (std::f64::consts::FRAC_1_SQRT_2 * e.max(p)).powf(FEATURE_EXPONENT))
        .collect()
}

/// Scales positive taps to sum to 1 and negative ones to sum to -1.
fn one_sided(taps: Vec<f64>) -> Vec<f64> {
    let positive: f64 = taps.iter().filter(|t| **t > 0.0).sum();
    let negative: f64 = -taps.iter().filter(|t| **t < 0.0).sum::<f64>();
    taps.into_iter()
        .map(|t| {
            if t > 0.0 {
                t / positive
            } else if t < 0.0 {
                t / negative
            } else {
                0.0
            }
        })
        .collect()
}

/// Correlation with `horizontal` along rows and `vertical` along columns, edge pixels repeated.
fn separable(
    values: &[f64],
    (width, height): (usize, usize),
    horizontal: &[f64],
    vertical: &[f64],
) -> Vec<f64> {
    let tap = |at: usize, k: usize, radius: usize, size: usize| {
        (at + k).saturating_sub(radius).min(size - 1)
    };
    let mut rows = vec![0.0; values.len()];
    let radius = horizontal.len() / 2;
    for y in 0..height {
        let row = &values[y * width..(y + 1) * width];
        for x in 0..width {
            rows[y * width + x] = horizontal
                .iter()
                .enumerate()
                .map(|(k, w)| w * row[tap(x, k, radius, width)])
                .sum();
        }
    }
    let mut out = vec![0.0; values.len()];
    let radius = vertical.len() / 2;
    for y in 0..height {
        let line = y * width..(y + 1) * width;
        for (k, w) in vertical.iter().enumerate() {
            let from = tap(y, k, radius, height) * width;
            for (out, v) in out[line.clone()].iter_mut().zip(&rows[from..from + width]) {
                *out += w * v;
            }
        }
    }
    out
}
