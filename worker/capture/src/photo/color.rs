//! What a photograph's numbers mean as colours, and their conversion to sRGB.
//!
//! In order of precedence, as the PNG specification has it: cICP, ICC profile, sRGB, gAMA with cHRM, Exif, nothing.
//! A photograph that says nothing is taken as sRGB; one of floating-point numbers as linear light with the primaries
//! of sRGB. A description that moves no 8-bit colour by more than one level is sRGB: those colours are left alone bit
//! for bit. Everything else is converted relative-colorimetrically; what lies outside sRGB is clipped.

use std::sync::Arc;

use moxcms::{
    Chromaticity, CicpColorPrimaries, CicpProfile, ColorPrimaries, ColorProfile, DataColorSpace,
    Layout, MatrixCoefficients, RenderingIntent, TransferCharacteristics, Transform8BitExecutor,
    Transform16BitExecutor, TransformExecutor, TransformOptions, XyY, curve_from_gamma,
};

use crate::photo::{PhotoError, Samples};

/// gAMA of files that mean sRGB and say so to programs that know no better.
const GAMMA_OF_SRGB: std::ops::RangeInclusive<u32> = 45_000..=46_000;

/// xy of the white point and the primaries.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Chromaticities {
    pub(super) white: [f64; 2],
    pub(super) red: [f64; 2],
    pub(super) green: [f64; 2],
    pub(super) blue: [f64; 2],
}

/// What a file says about its colours.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct ColorTag {
    /// PNG cICP: primaries, transfer, matrix, range.
    pub(super) cicp: Option<[u8; 4]>,
    pub(super) icc: Option<Vec<u8>>,
    pub(super) srgb: bool,
    /// PNG gAMA: 100,000 times the exponent that encodes light.
    pub(super) gamma: Option<u32>,
    pub(super) chromaticities: Option<Chromaticities>,
    /// What Exif says.
    pub(super) exif: ExifColor,
    /// Samples are floating-point numbers.
    pub(super) float: bool,
}

/// Colour space by Exif (DCF: Adobe RGB is "uncalibrated" with interoperability index R03).
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) enum ExifColor {
    /// sRGB, or nothing said.
    #[default]
    Srgb,
    AdobeRgb,
    Uncalibrated,
}

/// A conversion to sRGB.
#[derive(Clone)]
pub(super) struct Conversion {
    source: ColorProfile,
    eight: Arc<Transform8BitExecutor>,
}

impl std::fmt::Debug for Conversion {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Conversion")
    }
}

impl ColorTag {
    /// The conversion to sRGB; `None` where the colours are sRGB already.
    pub(super) fn conversion(&self) -> Result<Option<Conversion>, PhotoError> {
        let Some(profile) = self.profile()? else {
            return Ok(None);
        };
        let conversion = Conversion::new(profile).map_err(|error| refused(&error))?;
        Ok((!conversion.is_identity()?).then_some(conversion))
    }

    fn profile(&self) -> Result<Option<ColorProfile>, PhotoError> {
        if let Some(cicp) = self.cicp {
            return from_cicp(cicp).map(Some);
        }
        if let Some(icc) = &self.icc {
            return from_icc(icc).map(Some);
        }
        if self.float {
            return Ok(Some(with_curve(1.0)));
        }
        if self.srgb {
            return Ok(None);
        }
        if self.gamma.is_some() || self.chromaticities.is_some() {
            return self.power_law().map(Some);
        }
        Ok((self.exif == ExifColor::AdobeRgb).then(ColorProfile::new_adobe_rgb))
    }

    fn power_law(&self) -> Result<ColorProfile, PhotoError> {
        let mut profile = match self.gamma {
            None => ColorProfile::new_srgb(),
            Some(gamma) if GAMMA_OF_SRGB.contains(&gamma) => ColorProfile::new_srgb(),
            Some(gamma @ 10_000..=1_000_000) => with_curve(1e5 / gamma as f32),
            Some(gamma) => {
                return Err(PhotoError::Unsupported {
                    message: format!("its gAMA chunk says {gamma}, which is no usable gamma"),
                    hint: "save it anew as sRGB",
                });
            }
        };
        if let Some(c) = self.chromaticities {
            let xy = |[x, y]: [f64; 2]| Chromaticity {
                x: x as f32,
                y: y as f32,
            };
            let usable = |[x, y]: [f64; 2]| x >= 0.0 && y > 0.0 && x + y <= 1.0 + 1e-9;
            if ![c.white, c.red, c.green, c.blue].into_iter().all(usable) {
                return Err(PhotoError::Unsupported {
                    message: "its cHRM chunk names primaries that are no colours".into(),
                    hint: "save it anew as sRGB",
                });
            }
            let white = XyY {
                x: c.white[0],
                y: c.white[1],
                yb: 1.0,
            };
            let primaries = ColorPrimaries {
                red: xy(c.red),
                green: xy(c.green),
                blue: xy(c.blue),
            };
            profile.update_rgb_colorimetry(white, primaries);
        }
        Ok(profile)
    }
}

fn refused(error: &moxcms::CmsError) -> PhotoError {
    PhotoError::Unsupported {
        message: format!("its colour profile cannot be used: {error}"),
        hint: "convert the photograph to sRGB with the program that wrote it",
    }
}

/// Primaries of sRGB with a power law.
fn with_curve(gamma: f32) -> ColorProfile {
    let mut profile = ColorProfile::new_srgb();
    profile.cicp = None;
    let curve = curve_from_gamma(gamma);
    profile.red_trc = Some(curve.clone());
    profile.green_trc = Some(curve.clone());
    profile.blue_trc = Some(curve);
    profile
}

fn from_cicp([primaries, transfer, matrix, range]: [u8; 4]) -> Result<ColorProfile, PhotoError> {
    let unsupported = || PhotoError::Unsupported {
        message: format!(
            "its cICP chunk names the colour space {primaries}/{transfer}/{matrix}/{range}, which cannot be converted"
        ),
        hint: "convert the photograph to sRGB with the program that wrote it",
    };
    refuse_high_dynamic_range(transfer)?;
    if matrix != 0 || range != 1 {
        return Err(unsupported());
    }
    let (Ok(color_primaries), Ok(transfer_characteristics)) = (
        CicpColorPrimaries::try_from(primaries),
        TransferCharacteristics::try_from(transfer),
    ) else {
        return Err(unsupported());
    };
    let cicp = CicpProfile {
        color_primaries,
        transfer_characteristics,
        matrix_coefficients: MatrixCoefficients::Identity,
        full_range: true,
    };
    let mut profile = ColorProfile::new_srgb();
    profile.red_trc = None;
    // What it answers is no sign of success; the curves are.
    profile.update_rgb_colorimetry_from_cicp(cicp);
    if profile.red_trc.is_some() {
        Ok(profile)
    } else {
        Err(unsupported())
    }
}

/// PQ and HLG say how bright a display should be, not what share of white was seen.
fn refuse_high_dynamic_range(transfer: u8) -> Result<(), PhotoError> {
    if matches!(transfer, 16 | 18) {
        return Err(PhotoError::Unsupported {
            message: "it is in high dynamic range (PQ or HLG)".into(),
            hint: "export the photographs as standard-range sRGB",
        });
    }
    Ok(())
}

fn from_icc(icc: &[u8]) -> Result<ColorProfile, PhotoError> {
    let mut profile = ColorProfile::new_from_slice(icc).map_err(|error| refused(&error))?;
    if let Some(cicp) = &profile.cicp {
        refuse_high_dynamic_range(cicp.transfer_characteristics as u8)?;
    }
    match profile.color_space {
        DataColorSpace::Rgb => Ok(profile),
        // Grey photographs are read with three equal channels: a grey curve acts the same on each.
        DataColorSpace::Gray if profile.gray_trc.is_some() => {
            let curve = profile.gray_trc.take();
            let mut rgb = ColorProfile::new_srgb();
            rgb.cicp = None;
            rgb.red_trc.clone_from(&curve);
            rgb.green_trc.clone_from(&curve);
            rgb.blue_trc = curve;
            Ok(rgb)
        }
        _ => Err(PhotoError::Unsupported {
            message: "its colour profile is not for RGB or grey photographs".into(),
            hint: "convert the photograph to sRGB with the program that wrote it",
        }),
    }
}

fn options() -> TransformOptions {
    TransformOptions {
        rendering_intent: RenderingIntent::RelativeColorimetric,
        ..TransformOptions::default()
    }
}

impl Conversion {
    fn new(source: ColorProfile) -> Result<Self, moxcms::CmsError> {
        let srgb = ColorProfile::new_srgb();
        let eight = source.create_transform_8bit(Layout::Rgb, &srgb, Layout::Rgb, options())?;
        Ok(Self { source, eight })
    }

    /// Made where it is needed: its tables take longer than those of 8 bits, and most profiles are sRGB's.
    fn sixteen(&self) -> Result<Arc<Transform16BitExecutor>, moxcms::CmsError> {
        let srgb = ColorProfile::new_srgb();
        self.source
            .create_transform_16bit(Layout::Rgb, &srgb, Layout::Rgb, options())
    }

    /// Moves no 8-bit colour of a grid, and no grey, by more than one level.
    fn is_identity(&self) -> Result<bool, PhotoError> {
        let mut colors: Vec<u8> = (0..=255).flat_map(|grey| [grey; 3]).collect();
        let steps = || (0..=255_u8).step_by(17);
        colors.extend(
            steps().flat_map(|r| steps().flat_map(move |g| steps().flat_map(move |b| [r, g, b]))),
        );
        let mut converted = vec![0; colors.len()];
        self.eight
            .transform(&colors, &mut converted)
            .map_err(|error| refused(&error))?;
        let mut pairs = colors.iter().zip(&converted);
        Ok(pairs.all(|(before, after)| before.abs_diff(*after) <= 1))
    }

    /// Converts interleaved RGB; returns the share of colours that lie outside sRGB.
    pub(super) fn apply(&self, samples: &mut Samples) -> Result<f64, PhotoError> {
        match samples {
            Samples::Eight(data) => convert(&*self.eight, data, u8::MAX),
            Samples::Sixteen(data) => {
                let sixteen = self.sixteen().map_err(|error| refused(&error))?;
                convert(&*sixteen, data, u16::MAX)
            }
        }
    }
}

/// A colour counts as clipped where a channel became 0 or `white` that was neither before.
fn convert<T: Copy + Default + PartialEq>(
    transform: &dyn TransformExecutor<T>,
    data: &mut Vec<T>,
    white: T,
) -> Result<f64, PhotoError> {
    let mut converted = vec![T::default(); data.len()];
    transform
        .transform(data, &mut converted)
        .map_err(|error| refused(&error))?;
    let at_end = |value: T| value == T::default() || value == white;
    let pixels = data.chunks_exact(3).zip(converted.chunks_exact(3));
    let clipped = pixels
        .filter(|(before, after)| {
            let mut channels = before.iter().zip(*after);
            channels.any(|(&before, &after)| at_end(after) && !at_end(before))
        })
        .count();
    let share = clipped as f64 / (data.len() / 3).max(1) as f64;
    *data = converted;
    Ok(share)
}
