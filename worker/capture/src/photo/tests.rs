//! Against what Pillow, `LittleCMS` and numpy get, see `tests/reference/make_photos.py`; and means against pixels.

use super::area::{Reader, Window};
use super::*;

fn path(name: &str) -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
        .join("tests/reference/photos")
        .join(name)
}

const SIZE: (u32, u32) = (40, 24);
const BUSY: (u32, u32) = (117, 83);

/// sRGB in levels of 255.
fn levels(samples: &Samples) -> Vec<f64> {
    match samples {
        Samples::Eight(data) => data.iter().map(|&value| f64::from(value)).collect(),
        Samples::Sixteen(data) => data.iter().map(|&value| f64::from(value) / 257.0).collect(),
    }
}

#[test]
fn pictures_of_other_programs_have_the_colors_they_mean() {
    // Largest difference in levels of 255, by where it comes from: none; rounding to 8 bits in both colour managers;
    // that and two JPEG decoders; the small numbers of 16-bit linear light.
    for (name, most) in [
        ("srgb_profile.png", 0.0),
        ("gamma_srgb.png", 0.0),
        ("sixteen.png", 0.0),
        ("strips_lzw.tiff", 0.0),
        ("tiles_deflate.tiff", 0.0),
        ("packbits.tiff", 0.0),
        ("grey.tiff", 0.0),
        ("palette.png", 0.0),
        ("adobe.png", 1.0),
        ("adobe.tiff", 1.0),
        ("p3.webp", 1.0),
        ("cicp_p3.png", 1.0),
        ("linear_profile.tiff", 1.5),
        ("gamma_1.png", 0.05),
        ("float.tiff", 0.05),
        ("grey.jpg", 1.0),
        ("p3.jpg", 3.0),
        ("adobe_exif.jpg", 4.0),
        ("turned.jpg", 3.0),
        ("alpha.png", 0.51),
        ("alpha.webp", 0.51),
        ("alpha.tiff", 0.6),
    ] {
        let mut photo = decode(&path(name), SIZE, None).expect(name);
        photo.over_black();
        let expected = std::fs::read(path(&format!("{name}.srgb"))).expect("what others get");
        let expected = expected
            .chunks_exact(2)
            .map(|value| f64::from(u16::from_le_bytes([value[0], value[1]])) / 257.0);
        let found = levels(&photo.rgb);
        assert_eq!(found.len(), expected.len());
        let differences = found.iter().zip(expected).map(|(a, b)| (a - b).abs());
        let worst = differences.fold(0.0, f64::max);
        assert!(worst <= most, "{name}: {worst} levels");
    }
}

#[test]
fn files_with_more_than_eight_bits_keep_them() {
    for name in [
        "sixteen.png",
        "tiles_deflate.tiff",
        "float.tiff",
        "gamma_1.png",
    ] {
        let photo = decode(&path(name), SIZE, None).expect(name);
        let Samples::Sixteen(data) = &photo.rgb else {
            panic!("{name} was reduced to 8 bits");
        };
        let fine = data.iter().filter(|&&value| value % 257 != 0).count();
        assert!(fine > data.len() / 2, "{name}: {fine}");
    }
}

#[test]
fn pictures_that_are_not_the_cameras_are_refused_before_they_are_decoded() {
    let error = decode(&path("sixteen.png"), (41, 24), None).expect_err("another size");
    assert!(
        matches!(error, PhotoError::Size { found: SIZE, .. }),
        "{error}"
    );
    // A header that promises far more than the camera has: nothing of that size is taken.
    let mut bytes = std::fs::read(path("busy_420.jpg")).expect("a picture");
    let frame = bytes
        .windows(2)
        .position(|w| w == [0xff, 0xc0])
        .expect("a frame");
    bytes[frame + 5..frame + 9].copy_from_slice(&[0xff; 4]);
    let folder = tempfile::tempdir().expect("a scratch folder");
    let bomb = folder.path().join("bomb.jpg");
    std::fs::write(&bomb, bytes).expect("a file");
    let error = decode(&bomb, BUSY, None).expect_err("a bomb");
    assert!(
        matches!(
            error,
            PhotoError::Size {
                found: (65535, 65535),
                ..
            }
        ),
        "{error}"
    );
}

/// Means over cells of fully decoded pixels, in levels of 255.
fn means_of_pixels(pixels: &[f64], cell: usize) -> Vec<f64> {
    let (width, height) = (BUSY.0 as usize, BUSY.1 as usize);
    let mut means = Vec::new();
    for y in (0..height).step_by(cell) {
        for x in (0..width).step_by(cell) {
            for channel in 0..3 {
                let (mut sum, mut count) = (0.0, 0.0);
                for y in y..(y + cell).min(height) {
                    for x in x..(x + cell).min(width) {
                        sum += pixels[(y * width + x) * 3 + channel];
                        count += 1.0;
                    }
                }
                means.push(sum / count);
            }
        }
    }
    means
}

/// Mean and largest difference of `channels` interleaved values, times the cell, where a cell lies inside the picture.
fn differences(found: &[f64], expected: &[f64], channels: usize, cell: usize) -> (f64, f64) {
    assert_eq!(found.len(), expected.len());
    let columns = (BUSY.0 as usize).div_ceil(cell);
    let is_whole = |at: usize| {
        let (x, y) = (at / channels % columns, at / channels / columns);
        (x + 1) * cell <= BUSY.0 as usize && (y + 1) * cell <= BUSY.1 as usize
    };
    let pairs = found.iter().zip(expected).enumerate();
    let differences: Vec<f64> = pairs
        .filter(|&(at, _)| is_whole(at))
        .map(|(_, (a, b))| (a - b).abs() * cell as f64)
        .collect();
    let mean = differences.iter().sum::<f64>() / differences.len() as f64;
    (mean, differences.into_iter().fold(0.0, f64::max))
}

#[test]
fn means_over_cells_are_the_means_of_the_pixels() {
    // Mean and largest difference in levels of 255, times the cell. Single pixels are rounded and clamped by the decoder,
    // and so is each of their colour components. Where chroma is subsampled the decoder smooths it between its samples
    // and means do not, which shows in this picture, whose colours change from pixel to pixel: brightness is compared.
    for (name, mean_most, most) in [
        ("busy_grey.jpg", 0.26, 1.0),
        ("busy_444.jpg", 0.5, 2.6),
        ("busy_422.jpg", 0.35, 1.5),
        ("busy_420.jpg", 0.35, 1.5),
        ("busy_restart.jpg", 0.35, 1.5),
    ] {
        let subsampled = !matches!(name, "busy_grey.jpg" | "busy_444.jpg");
        let brightness = |rgb: &[f64]| -> Vec<f64> {
            let (pixels, _) = rgb.as_chunks::<3>();
            pixels
                .iter()
                .map(|[r, g, b]| 0.299 * r + 0.587 * g + 0.114 * b)
                .collect()
        };
        let pixels = levels(&decode(&path(name), BUSY, None).expect(name).rgb);
        for cell in [2, 4, 8] {
            let window = Window {
                x: (0, 117),
                y: (0, 83),
            };
            let wanted = Some(Wanted { cell, window });
            let photo = decode(&path(name), BUSY, wanted).expect(name);
            assert_eq!(photo.cell, cell, "{name}");
            let found = levels(&photo.rgb);
            let expected = means_of_pixels(&pixels, cell);
            let (mean, worst) = if subsampled {
                differences(&brightness(&found), &brightness(&expected), 1, cell)
            } else {
                differences(&found, &expected, 3, cell)
            };
            println!("{name} 1/{cell}: mean {mean:.3}, worst {worst:.3}");
            assert!(
                mean <= mean_most && worst <= most,
                "{name} 1/{cell}: {mean} {worst}"
            );
            let (mean, _) = differences(&found, &expected, 3, cell);
            assert!(mean < 3.0 * cell as f64, "{name} 1/{cell}: colours {mean}");
        }
    }
}

#[test]
fn a_window_holds_the_same_means() {
    let data = std::fs::read(path("busy_420.jpg")).expect("a picture");
    let structure = jpeg::structure(&data).expect("sound");
    let reader = Reader::new(&data, &structure).expect("baseline");
    let all = reader
        .means(
            4,
            Window {
                x: (0, 117),
                y: (0, 83),
            },
        )
        .expect("sound");
    let part = reader
        .means(
            4,
            Window {
                x: (40, 90),
                y: (33, 50),
            },
        )
        .expect("sound");
    assert_eq!((part.origin, part.width, part.height), ((32, 32), 16, 8));
    for y in 0..part.height {
        let row = ((y + 8) * all.width + 8) * 3;
        assert_eq!(
            part.rgb[y * part.width * 3..(y + 1) * part.width * 3],
            all.rgb[row..row + part.width * 3]
        );
    }
}

#[test]
fn damaged_jpeg_files_are_found_out() {
    for name in [
        "busy_444.jpg",
        "busy_420.jpg",
        "busy_restart.jpg",
        "busy_grey.jpg",
    ] {
        let data = std::fs::read(path(name)).expect("a picture");
        for end in 0..data.len() {
            assert!(
                jpeg::structure(&data[..end]).is_err(),
                "{name} cut at {end}"
            );
        }
        let sound = jpeg::structure(&data).expect("sound");
        let coded = sound.first_scan.as_ref().expect("a scan").coded.clone();
        let (mut found, mut tried) = (0, 0);
        for at in coded.step_by(7) {
            for bit in 0..8 {
                let mut damaged = data.clone();
                damaged[at] ^= 1 << bit;
                tried += 1;
                let verified = jpeg::structure(&damaged).and_then(|structure| {
                    let reader = Reader::new(&damaged, &structure);
                    reader.map_or(Ok(()), |reader| reader.verify())
                });
                found += usize::from(verified.is_err());
            }
        }
        println!("{name}: {found} of {tried} flipped bits found");
        assert!(found * 10 > tried * 3, "{name}: {found} of {tried}");
    }
}
