//! Photographs and masks in files: JPEG, PNG, TIFF and WebP, checked and decoded to sRGB.
//!
//! [`inspect`] looks at the header, at the file's structure and at its colour profile, without decoding pixels: a file
//! that is cut short, or whose colours cannot be converted, is named. [`decode`] yields sRGB samples, with 16 bits per
//! channel where the file has more than 8, and reads means over cells of pixels instead of pixels where that is all
//! that is wanted and a JPEG file allows it.
//!
//! - The Exif orientation is never applied: cameras are of the pixels as they are stored. [`Header::orientation`] only
//!   helps to explain sizes that do not match.
//! - Files are refused before memory is taken when their size is not the camera's or needs more than
//!   [`BYTES_PER_PIXEL`] and [`DECODER_SLACK_BYTES`].
//! - CMYK and palette-less oddities (Lab, sensor data) are refused; grey and palettes are expanded to RGB.

mod area;
mod color;
mod container;
mod jpeg;
#[cfg(test)]
mod tests;

use std::fs::File;
use std::io::{self, BufReader, Read, Seek};
use std::path::{Path, PathBuf};

use image::{ColorType, DynamicImage, ImageDecoder, ImageFormat, ImageReader};
use zune_core::bytestream::ZCursor;
use zune_core::colorspace::ColorSpace;
use zune_core::options::DecoderOptions;
use zune_jpeg::JpegDecoder;

pub(crate) use area::Window;
use color::{ColorTag, ExifColor};
use container::TiffNotes;

/// Memory that a decoder may take beyond the pixels, in bytes.
const DECODER_SLACK_BYTES: u64 = 64 << 20;
/// Memory that a decoder, or a JPEG file, may take per pixel of the camera, in bytes.
const BYTES_PER_PIXEL: u64 = 16;

/// Why a photograph or mask cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum PhotoError {
    /// The file cannot be read.
    #[error("cannot read the file")]
    Io(#[from] io::Error),
    /// The content is no picture that is known.
    #[error("it is neither a JPEG, PNG, TIFF nor WebP file")]
    Unknown,
    /// The file is cut short or altered.
    #[error("the file is damaged: {0}")]
    Damaged(String),
    /// A kind of picture that would be misread.
    #[error("{message}")]
    Unsupported {
        /// What is in the way.
        message: String,
        /// What to do about it.
        hint: &'static str,
    },
    /// The picture has not the size of its camera.
    #[error("it is {}x{} pixels, its camera says {}x{}", found.0, found.1, expected.0, expected.1)]
    Size {
        /// Width and height of the picture in pixels.
        found: (u32, u32),
        /// Width and height by the camera in pixels.
        expected: (u32, u32),
    },
    /// The decoder failed.
    #[error("it cannot be decoded")]
    Decoder(#[from] image::ImageError),
}

impl PhotoError {
    /// What to do about it.
    pub fn hint(&self) -> &'static str {
        match self {
            Self::Unsupported { hint, .. } => hint,
            Self::Unknown => "replace it by a JPEG, PNG, TIFF or WebP file",
            Self::Size { .. } => {
                "use the pictures that the cameras were computed from, at their full size"
            }
            Self::Io(_) | Self::Damaged(_) | Self::Decoder(_) => {
                "copy it again from the camera or the archive"
            }
        }
    }
}

/// Samples of a picture, row-major.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Samples {
    Eight(Vec<u8>),
    Sixteen(Vec<u16>),
}

/// What a file's header says.
#[derive(Debug)]
pub(crate) struct Header {
    pub(crate) size: (u32, u32),
    pub(crate) has_alpha: bool,
    /// Exif orientation, where it is one that turns or flips.
    pub(crate) orientation: Option<u8>,
    pub(crate) doubt: Option<ColorDoubt>,
}

/// Colours that are understood only by a guess.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum ColorDoubt {
    /// Only Exif says Adobe RGB; there is no profile.
    AdobeByExif,
    /// Exif says that the colours are not sRGB, and nothing says what they are.
    Uncalibrated,
}

/// A decoded photograph, or the part of it that was wanted.
#[derive(Debug)]
pub(crate) struct Photo {
    /// Pixels of the photograph per sample, along each axis.
    pub(crate) cell: usize,
    /// Pixel of the photograph at which the first sample begins.
    pub(crate) origin: (usize, usize),
    /// Width and height in samples.
    pub(crate) size: (usize, usize),
    /// `[height][width][3]`, sRGB.
    pub(crate) rgb: Samples,
    /// `[height][width]`, straight, where the file has it.
    pub(crate) alpha: Option<Samples>,
    /// Share of the samples that lie outside sRGB and were clipped.
    pub(crate) clipped: f64,
}

/// What a caller can do with less than all pixels.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Wanted {
    /// Means over cells of so many pixels suffice: 1, 2, 4 or 8.
    pub(crate) cell: usize,
    /// Only this part is looked at.
    pub(crate) window: Window,
}

enum Content {
    Jpeg {
        data: Vec<u8>,
        structure: Box<jpeg::Structure>,
    },
    Other {
        file: File,
        format: ImageFormat,
        tiff: TiffNotes,
    },
}

/// A file whose header and structure have been looked at.
struct Opened {
    content: Content,
    size: (u32, u32),
    has_alpha: bool,
    orientation: Option<u8>,
    color: ColorTag,
}

/// Width and height by the file's header alone.
pub(crate) fn dimensions(path: &Path) -> image::ImageResult<(u32, u32)> {
    // The content decides on the format, not the file's name.
    let reader = ImageReader::open(path)?.with_guessed_format()?;
    reader.into_dimensions()
}

/// Looks at a photograph without decoding its pixels.
pub(crate) fn inspect(path: &Path) -> Result<Header, PhotoError> {
    let opened = open(path, None)?;
    opened.color.conversion()?;
    let says_nothing_else = opened.color
        == ColorTag {
            exif: opened.color.exif,
            ..ColorTag::default()
        };
    let doubt = match opened.color.exif {
        ExifColor::AdobeRgb if says_nothing_else => Some(ColorDoubt::AdobeByExif),
        ExifColor::Uncalibrated if says_nothing_else => Some(ColorDoubt::Uncalibrated),
        _ => None,
    };
    Ok(Header {
        size: opened.size,
        has_alpha: opened.has_alpha,
        orientation: opened.orientation,
        doubt,
    })
}

/// Decodes the photograph of a camera of `expected` pixels.
pub(crate) fn decode(
    path: &Path,
    expected: (u32, u32),
    wanted: Option<Wanted>,
) -> Result<Photo, PhotoError> {
    let opened = open(path, Some(expected))?;
    let conversion = opened.color.conversion()?;
    let mut photo = match opened.content {
        Content::Jpeg { data, structure } => decode_jpeg(&data, &structure, expected, wanted)?,
        Content::Other { file, format, tiff } => {
            let mut photo = split_alpha(decode_other(file, format, expected)?, expected);
            if tiff.premultiplied {
                photo.unmultiply();
            }
            photo
        }
    };
    if let Some(conversion) = conversion {
        photo.clipped = conversion.apply(&mut photo.rgb)?;
    }
    Ok(photo)
}

/// Decodes a mask of `expected` pixels to `[height][width]` grey values.
pub(crate) fn decode_mask(path: &Path, expected: (u32, u32)) -> Result<Vec<u8>, PhotoError> {
    let image = match open(path, Some(expected))?.content {
        Content::Jpeg { data, structure } => {
            let photo = decode_jpeg(&data, &structure, expected, None)?;
            let Samples::Eight(rgb) = photo.rgb else {
                return Err(PhotoError::Damaged("it has changed".into()));
            };
            image::RgbImage::from_raw(expected.0, expected.1, rgb)
                .map(DynamicImage::from)
                .ok_or_else(|| PhotoError::Damaged("pixels are missing".into()))?
        }
        Content::Other { file, format, .. } => decode_other(file, format, expected)?,
    };
    Ok(image.into_luma8().into_raw())
}

/// The mask of a photograph in `masks/`: same stem as .png, or COLMAP's `name.ext.png`.
pub(crate) fn find_mask(masks: &Path, name: &str) -> Option<PathBuf> {
    let appended = masks.join(format!("{name}.png"));
    let same_stem = masks.join(Path::new(name).with_extension("png"));
    [appended, same_stem]
        .into_iter()
        .find(|path| path.is_file())
}

fn most_bytes(pixels: (u32, u32)) -> u64 {
    u64::from(pixels.0) * u64::from(pixels.1) * BYTES_PER_PIXEL + DECODER_SLACK_BYTES
}

/// `expected` is checked before anything of the picture's size is taken into memory.
fn open(path: &Path, expected: Option<(u32, u32)>) -> Result<Opened, PhotoError> {
    let mut file = File::open(path)?;
    let length = file.metadata()?.len();
    let mut magic = Vec::with_capacity(12);
    file.by_ref().take(12).read_to_end(&mut magic)?;
    file.rewind()?;
    let opened = match magic.as_slice() {
        [0xff, 0xd8, ..] => open_jpeg(file, length, expected)?,
        [0x89, b'P', b'N', b'G', ..] => open_other(file, length, ImageFormat::Png)?,
        [b'I', b'I', 42 | 43, 0, ..] | [b'M', b'M', 0, 42 | 43, ..] => {
            open_other(file, length, ImageFormat::Tiff)?
        }
        [b'R', b'I', b'F', b'F', _, _, _, _, b'W', b'E', b'B', b'P'] => {
            open_other(file, length, ImageFormat::WebP)?
        }
        _ => return Err(PhotoError::Unknown),
    };
    match expected {
        Some(expected) if opened.size != expected => Err(PhotoError::Size {
            found: opened.size,
            expected,
        }),
        _ => Ok(opened),
    }
}

fn open_jpeg(
    mut file: File,
    length: u64,
    expected: Option<(u32, u32)>,
) -> Result<Opened, PhotoError> {
    // Without a camera at hand, what the largest JPEG picture may take.
    let most = most_bytes(expected.unwrap_or((u32::from(u16::MAX), u32::from(u16::MAX) / 8)));
    if length > most {
        return Err(PhotoError::Damaged(format!(
            "{length} bytes are more than a picture of that size can take"
        )));
    }
    let mut data = Vec::with_capacity(length as usize);
    file.read_to_end(&mut data)?;
    let structure = jpeg::structure(&data).map_err(PhotoError::Damaged)?;
    if !matches!(structure.frame.components.len(), 1 | 3) {
        return Err(PhotoError::Unsupported {
            message: "it is a JPEG file in CMYK, for printing".into(),
            hint: "convert it to RGB with its profile in an image editor, or take the original",
        });
    }
    let mut decoder = jpeg_decoder(&data, ColorSpace::RGB);
    decoder
        .decode_headers()
        .map_err(|error| jpeg_error(&error))?;
    let (orientation, exif) = read_exif(decoder.exif().cloned());
    Ok(Opened {
        size: (structure.frame.size.0 as u32, structure.frame.size.1 as u32),
        has_alpha: false,
        orientation,
        color: ColorTag {
            icc: decoder.icc_profile(),
            exif,
            ..ColorTag::default()
        },
        content: Content::Jpeg {
            data,
            structure: Box::new(structure),
        },
    })
}

fn open_other(mut file: File, length: u64, format: ImageFormat) -> Result<Opened, PhotoError> {
    let mut color = ColorTag::default();
    let mut tiff = TiffNotes::default();
    match format {
        ImageFormat::Png => container::png(&mut file, &mut color)?,
        ImageFormat::Tiff => tiff = container::tiff(&mut file, length, &mut color)?,
        _ => container::webp(&mut file, length)?,
    }
    file.rewind()?;
    let mut decoder = reader(file.try_clone()?, format).into_decoder()?;
    if format != ImageFormat::Tiff {
        color.icc = decoder.icc_profile()?;
    }
    let kind = decoder.color_type();
    color.float = matches!(kind, ColorType::Rgb32F | ColorType::Rgba32F);
    let (mut orientation, exif) = read_exif(decoder.exif_metadata()?);
    color.exif = exif;
    if format == ImageFormat::Tiff {
        orientation = Some(decoder.orientation()?.to_exif()).filter(|&turn| turn > 1);
    }
    let size = decoder.dimensions();
    drop(decoder);
    file.rewind()?;
    Ok(Opened {
        content: Content::Other { file, format, tiff },
        size,
        has_alpha: kind.has_alpha(),
        orientation,
        color,
    })
}

fn reader(file: File, format: ImageFormat) -> ImageReader<BufReader<File>> {
    ImageReader::with_format(BufReader::with_capacity(1 << 16, file), format)
}

/// Orientation where it is not plain, and colour space.
fn read_exif(raw: Option<Vec<u8>>) -> (Option<u8>, ExifColor) {
    let Some(exif) = raw.and_then(|raw| exif::Reader::new().read_raw(raw).ok()) else {
        return (None, ExifColor::Srgb);
    };
    let number = |tag| {
        let field = exif.get_field(tag, exif::In::PRIMARY)?;
        field.value.get_uint(0)
    };
    let orientation = number(exif::Tag::Orientation)
        .filter(|turn| (2..=8).contains(turn))
        .map(|turn| turn as u8);
    let interoperability = exif
        .get_field(exif::Tag::InteroperabilityIndex, exif::In::PRIMARY)
        .is_some_and(|field| match &field.value {
            exif::Value::Ascii(texts) => texts.iter().any(|text| text.starts_with(b"R03")),
            _ => false,
        });
    let color = match number(exif::Tag::ColorSpace) {
        Some(2) => ExifColor::AdobeRgb,
        Some(0xffff) if interoperability => ExifColor::AdobeRgb,
        Some(0xffff) => ExifColor::Uncalibrated,
        _ => ExifColor::Srgb,
    };
    (orientation, color)
}

fn jpeg_decoder(data: &[u8], space: ColorSpace) -> JpegDecoder<ZCursor<&[u8]>> {
    let options = DecoderOptions::default()
        .set_strict_mode(true)
        .set_max_width(usize::from(u16::MAX))
        .set_max_height(usize::from(u16::MAX))
        .jpeg_set_out_colorspace(space);
    JpegDecoder::new_with_options(ZCursor::new(data), options)
}

fn jpeg_error(error: &zune_jpeg::errors::DecodeErrors) -> PhotoError {
    PhotoError::Damaged(error.to_string())
}

fn decode_jpeg(
    data: &[u8],
    structure: &jpeg::Structure,
    expected: (u32, u32),
    wanted: Option<Wanted>,
) -> Result<Photo, PhotoError> {
    let reader = area::Reader::new(data, structure);
    if let (Some(reader), Some(wanted)) = (&reader, wanted)
        && wanted.cell > 1
    {
        let means = reader
            .means(wanted.cell, wanted.window)
            .map_err(PhotoError::Damaged)?;
        return Ok(Photo {
            cell: wanted.cell,
            origin: means.origin,
            size: (means.width, means.height),
            rgb: Samples::Sixteen(means.rgb),
            alpha: None,
            clipped: 0.0,
        });
    }
    // The decoder below fills up what it cannot read.
    if let Some(reader) = &reader {
        reader.verify().map_err(PhotoError::Damaged)?;
    }
    let grey = structure.frame.components.len() == 1;
    let space = if grey {
        ColorSpace::Luma
    } else {
        ColorSpace::RGB
    };
    let decoded = jpeg_decoder(data, space).decode();
    let mut rgb = decoded.map_err(|error| jpeg_error(&error))?;
    if grey {
        rgb = rgb.into_iter().flat_map(|grey| [grey; 3]).collect();
    }
    let size = (expected.0 as usize, expected.1 as usize);
    if rgb.len() != size.0 * size.1 * 3 {
        return Err(PhotoError::Damaged("pixels are missing".into()));
    }
    Ok(Photo {
        cell: 1,
        origin: (0, 0),
        size,
        rgb: Samples::Eight(rgb),
        alpha: None,
        clipped: 0.0,
    })
}

fn decode_other(
    file: File,
    format: ImageFormat,
    expected: (u32, u32),
) -> Result<DynamicImage, PhotoError> {
    let mut reader = reader(file, format);
    let mut limits = image::Limits::default();
    limits.max_alloc = Some(most_bytes(expected));
    reader.limits(limits);
    Ok(reader.decode()?)
}

/// Interleaved RGB and alpha of what the decoder yields, at its own precision.
fn split_alpha(image: DynamicImage, expected: (u32, u32)) -> Photo {
    let has_alpha = image.color().has_alpha();
    let (rgb, alpha) = match image {
        DynamicImage::ImageLuma16(_)
        | DynamicImage::ImageLumaA16(_)
        | DynamicImage::ImageRgb16(_)
        | DynamicImage::ImageRgba16(_)
        | DynamicImage::ImageRgb32F(_)
        | DynamicImage::ImageRgba32F(_) => {
            if has_alpha {
                let (rgb, alpha) = split(&image.into_rgba16());
                (Samples::Sixteen(rgb), Some(Samples::Sixteen(alpha)))
            } else {
                (Samples::Sixteen(image.into_rgb16().into_raw()), None)
            }
        }
        other if has_alpha => {
            let (rgb, alpha) = split(&other.into_rgba8());
            (Samples::Eight(rgb), Some(Samples::Eight(alpha)))
        }
        other => (Samples::Eight(other.into_rgb8().into_raw()), None),
    };
    Photo {
        cell: 1,
        origin: (0, 0),
        size: (expected.0 as usize, expected.1 as usize),
        rgb,
        alpha,
        clipped: 0.0,
    }
}

fn split<T: Copy>(rgba: &[T]) -> (Vec<T>, Vec<T>) {
    let (pixels, _) = rgba.as_chunks::<4>();
    (
        pixels.iter().flat_map(|&[r, g, b, _]| [r, g, b]).collect(),
        pixels.iter().map(|pixel| pixel[3]).collect(),
    )
}

impl Photo {
    /// Where the pixels of a whole photograph lie, without the pixels.
    pub(crate) fn grid_of_pixels(size: (u32, u32)) -> Self {
        Self {
            cell: 1,
            origin: (0, 0),
            size: (size.0 as usize, size.1 as usize),
            rgb: Samples::Eight(Vec::new()),
            alpha: None,
            clipped: 0.0,
        }
    }

    /// Divides alpha out of colours that were multiplied by it as they are stored.
    fn unmultiply(&mut self) {
        match (&mut self.rgb, &self.alpha) {
            (Samples::Eight(rgb), Some(Samples::Eight(alpha))) => {
                each_color(rgb, alpha, |value, alpha| {
                    (u32::from(value) * 255 / u32::from(alpha.max(1))).min(255) as u8
                });
            }
            (Samples::Sixteen(rgb), Some(Samples::Sixteen(alpha))) => {
                each_color(rgb, alpha, |value, alpha| {
                    (u64::from(value) * 65535 / u64::from(alpha.max(1))).min(65535) as u16
                });
            }
            _ => {}
        }
    }

    /// Lays the photograph over black by its alpha channel, in linear light, so that the alpha channel is the coverage
    /// that is multiplied into the colours.
    pub(crate) fn over_black(&mut self) {
        match (&mut self.rgb, &self.alpha) {
            (Samples::Eight(rgb), Some(Samples::Eight(alpha))) => {
                each_color(rgb, alpha, |value, alpha| match alpha {
                    0 => 0,
                    255 => value,
                    _ => (dimmed(f32::from(value) / 255.0, f32::from(alpha) / 255.0) * 255.0)
                        .round() as u8,
                });
            }
            (Samples::Sixteen(rgb), Some(Samples::Sixteen(alpha))) => {
                each_color(rgb, alpha, |value, alpha| match alpha {
                    0 => 0,
                    65535 => value,
                    _ => (dimmed(f32::from(value) / 65535.0, f32::from(alpha) / 65535.0) * 65535.0)
                        .round() as u16,
                });
            }
            _ => {}
        }
    }

    /// Whether the alpha channel, where there is one, hides nothing.
    pub(crate) fn is_opaque(&self) -> bool {
        match &self.alpha {
            None => true,
            Some(Samples::Eight(alpha)) => alpha.iter().all(|&alpha| alpha == u8::MAX),
            Some(Samples::Sixteen(alpha)) => alpha.iter().all(|&alpha| alpha == u16::MAX),
        }
    }

    /// Rolls all rows to the left by so many columns. For whole photographs.
    pub(crate) fn roll(&mut self, columns: usize) {
        let width = self.size.0;
        roll_samples(&mut self.rgb, width * 3, columns * 3);
        if let Some(alpha) = &mut self.alpha {
            roll_samples(alpha, width, columns);
        }
    }
}

fn each_color<T: Copy>(rgb: &mut [T], alpha: &[T], change: impl Fn(T, T) -> T) {
    for (color, &alpha) in rgb.chunks_exact_mut(3).zip(alpha) {
        for value in color {
            *value = change(*value, alpha);
        }
    }
}

/// A value of sRGB with its light multiplied by `alpha`.
fn dimmed(value: f32, alpha: f32) -> f32 {
    let light = if value <= 0.040_45 {
        value / 12.92
    } else {
        ((value + 0.055) / 1.055).powf(2.4)
    } * alpha;
    if light <= 0.003_130_8 {
        light * 12.92
    } else {
        1.055 * light.powf(1.0 / 2.4) - 0.055
    }
}

fn roll_samples(samples: &mut Samples, stride: usize, by: usize) {
    match samples {
        Samples::Eight(data) => roll_rows(data, stride, by),
        Samples::Sixteen(data) => roll_rows(data, stride, by),
    }
}

/// Rolls rows of `stride` values to the left.
pub(crate) fn roll_rows<T>(data: &mut [T], stride: usize, by: usize) {
    if by > 0 {
        for row in data.chunks_exact_mut(stride) {
            row.rotate_left(by);
        }
    }
}
