//! The structure of PNG, TIFF and WebP files: whether all of the picture is in the file, and what the image decoders do
//! not tell of its colours.
//!
//! Sources: PNG specification (third edition), TIFF 6.0, RFC 9649 (WebP).

use std::io::{self, BufRead, BufReader, Read, Seek, SeekFrom};

use tiff::decoder::Decoder;
use tiff::tags::Tag;

use crate::photo::PhotoError;
use crate::photo::color::{Chromaticities, ColorTag};

fn damaged(message: impl Into<String>) -> PhotoError {
    PhotoError::Damaged(message.into())
}

/// An end of the file where more is needed is damage of the file, not of the disk.
fn ended(error: io::Error, what: &str) -> PhotoError {
    if error.kind() == io::ErrorKind::UnexpectedEof {
        damaged(format!("it is cut short in {what}"))
    } else {
        PhotoError::Io(error)
    }
}

/// Walks over all chunks with their checksums to the end chunk; fills in what they say about colours.
pub(super) fn png(file: impl Read, color: &mut ColorTag) -> Result<(), PhotoError> {
    let mut file = BufReader::with_capacity(1 << 16, file);
    io::copy(&mut file.by_ref().take(8), &mut io::sink())?;
    let mut offset = 8_u64;
    loop {
        let mut header = [0; 8];
        file.read_exact(&mut header)
            .map_err(|error| ended(error, "its chunks, before the end chunk"))?;
        let [l0, l1, l2, l3, kind @ ..] = header;
        let length = u32::from_be_bytes([l0, l1, l2, l3]);
        let name = String::from_utf8_lossy(&kind).into_owned();
        let mut checksum = crc32fast::Hasher::new();
        checksum.update(&kind);
        // The chunks that are looked at are small.
        let mut kept = Vec::new();
        let mut left = u64::from(length);
        while left > 0 {
            let read = file.fill_buf()?;
            let taken = (read.len() as u64).min(left) as usize;
            if taken == 0 {
                return Err(damaged(format!("it is cut short in its chunk {name}")));
            }
            checksum.update(&read[..taken]);
            if kept.len() < 32 {
                kept.extend_from_slice(&read[..taken.min(32 - kept.len())]);
            }
            file.consume(taken);
            left -= taken as u64;
        }
        let mut stored = [0; 4];
        file.read_exact(&mut stored)
            .map_err(|error| ended(error, &format!("its chunk {name}")))?;
        if checksum.finalize() != u32::from_be_bytes(stored) {
            return Err(damaged(format!(
                "the checksum of its chunk {name} at byte {offset} is wrong"
            )));
        }
        offset += 12 + u64::from(length);
        match &kind {
            b"IEND" => return Ok(()),
            b"sRGB" => color.srgb = true,
            b"gAMA" => color.gamma = be_u32(&kept, 0),
            b"cICP" => color.cicp = kept.as_slice().try_into().ok(),
            b"cHRM" => color.chromaticities = chromaticities(&kept),
            _ => {}
        }
    }
}

fn be_u32(bytes: &[u8], at: usize) -> Option<u32> {
    Some(u32::from_be_bytes(*bytes.get(at..)?.first_chunk()?))
}

fn chromaticities(bytes: &[u8]) -> Option<Chromaticities> {
    let pair = |at: usize| {
        let unit = |at: usize| Some(f64::from(be_u32(bytes, at)?) / 1e5);
        Some([unit(at)?, unit(at + 4)?])
    };
    Some(Chromaticities {
        white: pair(0)?,
        red: pair(8)?,
        green: pair(16)?,
        blue: pair(24)?,
    })
}

/// Whether all chunks lie within the file.
pub(super) fn webp(mut file: impl Read + Seek, length: u64) -> Result<(), PhotoError> {
    let mut header = [0; 12];
    file.read_exact(&mut header)
        .map_err(|error| ended(error, "its header"))?;
    let end = 8 + u64::from(le_u32(header, 4));
    if end > length {
        return Err(damaged(format!("it is cut short: {length} bytes of {end}")));
    }
    let mut at = 12;
    while at + 8 <= end {
        file.seek(SeekFrom::Start(at))?;
        let mut chunk = [0; 8];
        file.read_exact(&mut chunk)
            .map_err(|error| ended(error, "its chunks"))?;
        let size = u64::from(le_u32(chunk, 4));
        if at + 8 + size > end {
            return Err(damaged(format!(
                "its chunk {} reaches beyond its end",
                String::from_utf8_lossy(&chunk[..4])
            )));
        }
        if &chunk[..4] == b"ANIM" {
            return Err(PhotoError::Unsupported {
                message: "it is an animation".into(),
                hint: "save each photograph as a picture of its own",
            });
        }
        at += 8 + size + size % 2;
    }
    Ok(())
}

fn le_u32<const N: usize>(bytes: [u8; N], at: usize) -> u32 {
    u32::from_le_bytes([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]])
}

/// What a TIFF file says that the image decoder does not.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct TiffNotes {
    /// Colours are multiplied by alpha as they are stored (`ExtraSamples` = 1).
    pub(super) premultiplied: bool,
}

/// Whether all strips or tiles lie within the file, and whether its kind of picture can be read rightly; fills in the
/// colour profile, which the image decoder leaves out where it is larger than the picture.
pub(super) fn tiff(
    file: impl Read + Seek,
    length: u64,
    color: &mut ColorTag,
) -> Result<TiffNotes, PhotoError> {
    let broken = |error: tiff::TiffError| match error {
        tiff::TiffError::IoError(error) => ended(error, "its directory"),
        tiff::TiffError::UnsupportedError(kind) => PhotoError::Unsupported {
            message: format!("it is of an unusual kind: {kind}"),
            hint: "save it as RGB with 8 or 16 bits per channel",
        },
        other => damaged(other.to_string()),
    };
    let mut file = Decoder::new(file).map_err(broken)?;
    let profile = file.find_tag(Tag::IccProfile).map_err(broken)?;
    color.icc = profile
        .map(tiff::decoder::ifd::Value::into_u8_vec)
        .transpose()
        .map_err(broken)?;
    let mut numbers = |tag| {
        file.find_tag_unsigned_vec::<u64>(tag)
            .map_err(broken)
            .map(Option::unwrap_or_default)
    };
    for (offsets, counts, what) in [
        (Tag::StripOffsets, Tag::StripByteCounts, "strip"),
        (Tag::TileOffsets, Tag::TileByteCounts, "tile"),
    ] {
        let (offsets, counts) = (numbers(offsets)?, numbers(counts)?);
        for (index, (&offset, &count)) in offsets.iter().zip(&counts).enumerate() {
            if offset.checked_add(count).is_none_or(|end| end > length) {
                return Err(damaged(format!(
                    "it is cut short: its {what} {index} of {} lies beyond its {length} bytes",
                    offsets.len()
                )));
            }
        }
    }
    let first = |values: Vec<u64>| values.first().copied();
    match first(numbers(Tag::PhotometricInterpretation)?) {
        Some(0..=2 | 4) | None => {}
        other => {
            let kind = match other {
                Some(3) => "a palette",
                Some(5) => "CMYK",
                Some(6) => "YCbCr",
                Some(8..=10) => "Lab",
                Some(32803) => "raw sensor data",
                _ => "an unknown colour space",
            };
            return Err(PhotoError::Unsupported {
                message: format!("its colours are {kind}"),
                hint: "convert it to RGB, with its profile, in an image editor",
            });
        }
    }
    Ok(TiffNotes {
        premultiplied: numbers(Tag::ExtraSamples)?.contains(&1),
    })
}
