//! The structure of a JPEG file: its markers from the start of the image to its end.
//!
//! Reads what the header says and finds every scan's coded data. A file that ends before the end marker, or whose
//! segments do not fit together, is damaged: decoders would fill the rest with grey.
//! Source: ITU-T T.81, annex B; APP2 by the ICC specification, annex B.4.

use memchr::memchr;

const SOI: u8 = 0xd8;
const EOI: u8 = 0xd9;
const SOS: u8 = 0xda;
const DQT: u8 = 0xdb;
const DHT: u8 = 0xc4;
const DRI: u8 = 0xdd;
const APP14: u8 = 0xee;

/// Zigzag position to row-major position in an 8x8 block.
pub(super) const NATURAL: [u8; 64] = [
    0, 1, 8, 16, 9, 2, 3, 10, 17, 24, 32, 25, 18, 11, 4, 5, 12, 19, 26, 33, 40, 48, 41, 34, 27, 20,
    13, 6, 7, 14, 21, 28, 35, 42, 49, 56, 57, 50, 43, 36, 29, 22, 15, 23, 30, 37, 44, 51, 58, 59,
    52, 45, 38, 31, 39, 46, 53, 60, 61, 54, 47, 55, 62, 63,
];

/// One component of the frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Component {
    pub(super) id: u8,
    /// Horizontal and vertical sampling factors, 1 to 4.
    pub(super) sampling: (usize, usize),
    pub(super) quantisation: usize,
}

/// What the frame header says.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct Frame {
    /// Sequential Huffman coding at 8 bits.
    pub(super) baseline: bool,
    pub(super) size: (usize, usize),
    pub(super) components: Vec<Component>,
}

/// A Huffman table as the file has it: number of codes per length, and their values.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct HuffmanCodes {
    pub(super) counts: [u8; 16],
    pub(super) values: Vec<u8>,
}

/// The first scan: for each of its components its place in the frame and its DC and AC tables.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Scan {
    pub(super) components: Vec<(usize, usize, usize)>,
    /// Coded data, with stuffing and restart markers.
    pub(super) coded: std::ops::Range<usize>,
    /// MCUs between restart markers; 0 without them.
    pub(super) restart_interval: usize,
    /// DC tables, then AC tables.
    pub(super) huffman: [[Option<HuffmanCodes>; 4]; 2],
    pub(super) quantisation: [Option<[u16; 64]>; 4],
}

/// The file's structure.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct Structure {
    pub(super) frame: Frame,
    /// Colour transform by the Adobe segment, where there is one.
    pub(super) adobe_transform: Option<u8>,
    pub(super) scans: usize,
    pub(super) first_scan: Option<Scan>,
}

/// Walks over the whole file.
///
/// # Errors
/// What is damaged, and at which byte.
pub(super) fn structure(data: &[u8]) -> Result<Structure, String> {
    let mut found = Structure::default();
    let mut huffman: [[Option<HuffmanCodes>; 4]; 2] = Default::default();
    let mut quantisation: [Option<[u16; 64]>; 4] = [None; 4];
    let mut restart_interval = 0;
    let mut at = 2;
    if data.get(..2) != Some(&[0xff, SOI]) {
        return Err("it does not start as a JPEG file".into());
    }
    loop {
        let marker = next_marker(data, &mut at)?;
        if marker == EOI {
            if found.scans == 0 {
                return Err(format!("it ends at byte {at} without an image"));
            }
            return Ok(found);
        }
        let begin = at;
        let body = segment(data, &mut at)?;
        let wrong = || format!("the segment {marker:#04x} at byte {begin} is malformed");
        match marker {
            DQT => read_quantisation(body, &mut quantisation).ok_or_else(wrong)?,
            DHT => read_huffman(body, &mut huffman).ok_or_else(wrong)?,
            DRI => restart_interval = usize::from(word(body, 0).ok_or_else(wrong)?),
            APP14 if body.starts_with(b"Adobe") => {
                found.adobe_transform = body.get(11).copied();
            }
            0xc0..=0xcf if !matches!(marker, DHT | 0xc8 | 0xcc) => {
                found.frame = read_frame(marker, body).ok_or_else(wrong)?;
            }
            SOS => {
                let end = end_of_scan(data, at)?;
                found.scans += 1;
                if found.first_scan.is_none() {
                    let components = read_scan(body, &found.frame).ok_or_else(wrong)?;
                    found.first_scan = Some(Scan {
                        components,
                        coded: at..end,
                        restart_interval,
                        huffman: huffman.clone(),
                        quantisation,
                    });
                }
                at = end;
            }
            _ => {}
        }
    }
}

fn cut_short(data: &[u8]) -> String {
    format!(
        "it is cut short: {} bytes, and no end of the image among them",
        data.len()
    )
}

fn word(bytes: &[u8], at: usize) -> Option<u16> {
    Some(u16::from_be_bytes([*bytes.get(at)?, *bytes.get(at + 1)?]))
}

/// The marker at `at`, which is moved behind it. Fill bytes are skipped.
fn next_marker(data: &[u8], at: &mut usize) -> Result<u8, String> {
    let start = *at;
    if data.get(start).is_some_and(|&byte| byte != 0xff) {
        return Err(format!("byte {start} should begin a segment and does not"));
    }
    while data.get(*at) == Some(&0xff) {
        *at += 1;
    }
    let marker = *data.get(*at).ok_or_else(|| cut_short(data))?;
    *at += 1;
    Ok(marker)
}

/// The segment's content; `at` is moved behind it.
fn segment<'a>(data: &'a [u8], at: &mut usize) -> Result<&'a [u8], String> {
    let length = usize::from(word(data, *at).ok_or_else(|| cut_short(data))?);
    if length < 2 {
        return Err(format!("the segment at byte {at} has no length"));
    }
    let body = data
        .get(*at + 2..*at + length)
        .ok_or_else(|| cut_short(data))?;
    *at += length;
    Ok(body)
}

/// Where the coded data from `at` on ends: at the next marker other than a restart.
fn end_of_scan(data: &[u8], mut at: usize) -> Result<usize, String> {
    loop {
        let rest = data.get(at..).unwrap_or_default();
        at += memchr(0xff, rest).ok_or_else(|| cut_short(data))?;
        match data.get(at + 1) {
            None => return Err(cut_short(data)),
            Some(0 | 0xd0..=0xd7) => at += 2,
            Some(0xff) => at += 1,
            Some(_) => return Ok(at),
        }
    }
}

fn read_frame(marker: u8, body: &[u8]) -> Option<Frame> {
    let count = usize::from(*body.get(5)?);
    let mut components = Vec::with_capacity(count);
    for at in 0..count {
        let entry = body.get(6 + 3 * at..9 + 3 * at)?;
        let sampling = (usize::from(entry[1] >> 4), usize::from(entry[1] & 15));
        if !(1..=4).contains(&sampling.0) || !(1..=4).contains(&sampling.1) || entry[2] > 3 {
            return None;
        }
        components.push(Component {
            id: entry[0],
            sampling,
            quantisation: usize::from(entry[2]),
        });
    }
    (count > 0).then_some(Frame {
        baseline: matches!(marker, 0xc0 | 0xc1) && body[0] == 8,
        size: (usize::from(word(body, 3)?), usize::from(word(body, 1)?)),
        components,
    })
}

fn read_scan(body: &[u8], frame: &Frame) -> Option<Vec<(usize, usize, usize)>> {
    let count = usize::from(*body.first()?);
    let mut components = Vec::with_capacity(count);
    for at in 0..count {
        let entry = body.get(1 + 2 * at..3 + 2 * at)?;
        let place = frame.components.iter().position(|c| c.id == entry[0])?;
        let (dc, ac) = (usize::from(entry[1] >> 4), usize::from(entry[1] & 15));
        if dc > 3 || ac > 3 {
            return None;
        }
        components.push((place, dc, ac));
    }
    (count > 0).then_some(components)
}

fn read_quantisation(mut body: &[u8], tables: &mut [Option<[u16; 64]>; 4]) -> Option<()> {
    while let Some((&first, rest)) = body.split_first() {
        let wide = first >> 4 != 0;
        let bytes = if wide { 128 } else { 64 };
        let entries = rest.get(..bytes)?;
        let mut table = [0; 64];
        for (at, value) in table.iter_mut().enumerate() {
            *value = if wide {
                word(entries, 2 * at)?
            } else {
                u16::from(entries[at])
            };
        }
        *tables.get_mut(usize::from(first & 15))? = Some(table);
        body = &rest[bytes..];
    }
    Some(())
}

fn read_huffman(mut body: &[u8], tables: &mut [[Option<HuffmanCodes>; 4]; 2]) -> Option<()> {
    while let Some((&first, rest)) = body.split_first() {
        let counts: [u8; 16] = rest.get(..16)?.try_into().ok()?;
        let total: usize = counts.iter().map(|&count| usize::from(count)).sum();
        let values = rest.get(16..16 + total)?.to_vec();
        let class = tables.get_mut(usize::from(first >> 4))?;
        *class.get_mut(usize::from(first & 15))? = Some(HuffmanCodes { counts, values });
        body = &rest[16 + total..];
    }
    Some(())
}
