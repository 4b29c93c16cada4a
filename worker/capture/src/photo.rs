//! Decoding photographs and masks, and finding them by name.

use std::fs::File;
use std::io::BufReader;
use std::path::{Path, PathBuf};

use image::{DynamicImage, ImageReader, ImageResult};

/// Memory that a decoder may take beyond the decoded pixels, in bytes.
const DECODER_SLACK_BYTES: u64 = 64 << 20;

fn reader(path: &Path) -> ImageResult<ImageReader<BufReader<File>>> {
    // The content decides on the format, not the file's name.
    Ok(ImageReader::open(path)?.with_guessed_format()?)
}

/// Width and height by the file's header alone.
pub(crate) fn dimensions(path: &Path) -> ImageResult<(u32, u32)> {
    reader(path)?.into_dimensions()
}

/// Decodes a file that is expected to have `expected` pixels; the memory taken is bounded by that.
/// The orientation tag is not applied, as COLMAP does not.
pub(crate) fn decode(path: &Path, expected: (u32, u32)) -> ImageResult<DynamicImage> {
    let mut reader = reader(path)?;
    let mut limits = image::Limits::default();
    let pixels = u64::from(expected.0) * u64::from(expected.1);
    limits.max_alloc = Some(pixels * 16 + DECODER_SLACK_BYTES);
    reader.limits(limits);
    reader.decode()
}

/// The mask of a photograph in `masks/`: same stem as .png, or COLMAP's `name.ext.png`.
pub(crate) fn find_mask(masks: &Path, name: &str) -> Option<PathBuf> {
    let appended = masks.join(format!("{name}.png"));
    let same_stem = masks.join(Path::new(name).with_extension("png"));
    [appended, same_stem]
        .into_iter()
        .find(|path| path.is_file())
}
