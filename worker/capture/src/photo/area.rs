//! Area means of a JPEG photograph, straight from its coefficients.
//!
//! A photograph that is scaled down needs no pixel by itself, only means over cells of 2x2, 4x4 or 8x8 pixels. The
//! mean of a block's pixels over a cell is linear in the block's coefficients and separable:
//!
//! ```text
//! mean(X, Y) = sum_uv  F(u, v) b(X, u) b(Y, v),   b(X, u) = mean over x in X of  c(u)/2 cos((2x + 1) u pi / 16)
//! ```
//!
//! with F the dequantised coefficients, so the result is what decoding every pixel and averaging would give, but for
//! the rounding and clamping of single pixels to 8 bits. Subsampled chroma takes the mean over its own, larger samples
//! (each a constant square). The colour transform is linear, and so commutes with the mean.
//!
//! All codes are read, also those of blocks outside the wanted window: only a scan that ends exactly with its last
//! block is sound. JPEG has no checksum: damage that makes the codes lose step for good is found that way, a changed
//! number in a block cannot be told from the photograph.
//!
//! Covers what cameras write: sequential Huffman coding, 8 bits, one scan, grey or YCbCr. [`Reader::new`] answers
//! `None` for the rest.

use crate::photo::jpeg::{HuffmanCodes, NATURAL, Structure};

/// Bits of a code that are looked up at once.
const LOOKUP_BITS: u32 = 10;
/// Zero bytes behind the coded data, so that reading ahead stays inside.
const PADDING: usize = 16;

/// A rectangle of whole pixels of the photograph, `x` and `y` as start and end.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Window {
    pub(crate) x: (usize, usize),
    pub(crate) y: (usize, usize),
}

/// Means over cells: `[height][width][3]`, RGB scaled to 16 bits, with the origin in pixels of the photograph.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Means {
    pub(super) width: usize,
    pub(super) height: usize,
    pub(super) origin: (usize, usize),
    pub(super) rgb: Vec<u16>,
}

struct Plane {
    /// Blocks of this component in an MCU.
    blocks: (usize, usize),
    dc: Huffman,
    ac: Huffman,
    /// Dequantisation by zigzag position.
    quantisation: [f32; 64],
}

/// A photograph whose means can be read.
pub(super) struct Reader<'a> {
    coded: &'a [u8],
    size: (usize, usize),
    /// Sampling factors of the frame: an MCU is 8 times that in pixels.
    mcu: (usize, usize),
    restart_interval: usize,
    planes: Vec<Plane>,
}

impl<'a> Reader<'a> {
    /// `None` when the file is none of those that the module covers.
    pub(super) fn new(data: &'a [u8], structure: &Structure) -> Option<Self> {
        let frame = &structure.frame;
        let scan = structure.first_scan.as_ref()?;
        let places = scan.components.iter().map(|&(place, _, _)| place);
        if !frame.baseline
            || structure.scans != 1
            || !places.eq(0..frame.components.len())
            || frame.size.0 == 0
            || frame.size.1 == 0
        {
            return None;
        }
        let is_rgb = || {
            let ids: Vec<u8> = frame.components.iter().map(|c| c.id).collect();
            structure.adobe_transform == Some(0)
                || (structure.adobe_transform.is_none() && ids == *b"RGB")
        };
        let grey = match frame.components.len() {
            1 => true,
            3 if !is_rgb() => false,
            _ => return None,
        };
        let most =
            |of: fn((usize, usize)) -> usize| frame.components.iter().map(|c| of(c.sampling)).max();
        // A single component is not interleaved: its MCU is one block, whatever its factors.
        let mcu = if grey {
            (1, 1)
        } else {
            (most(|s| s.0)?, most(|s| s.1)?)
        };
        let mut planes = Vec::new();
        for (component, &(_, dc, ac)) in frame.components.iter().zip(&scan.components) {
            let blocks = if grey { (1, 1) } else { component.sampling };
            // Cells of 2x2 pixels must be whole samples of every component.
            if !matches!(mcu.0 / blocks.0, 1 | 2)
                || !matches!(mcu.1 / blocks.1, 1 | 2)
                || mcu.0 % blocks.0 != 0
                || mcu.1 % blocks.1 != 0
            {
                return None;
            }
            let quantisation = scan.quantisation[component.quantisation].as_ref()?;
            planes.push(Plane {
                blocks,
                dc: Huffman::new(scan.huffman[0][dc].as_ref()?)?,
                ac: Huffman::new(scan.huffman[1][ac].as_ref()?)?,
                quantisation: quantisation.map(f32::from),
            });
        }
        Some(Self {
            coded: &data[scan.coded.clone()],
            size: frame.size,
            mcu,
            restart_interval: scan.restart_interval,
            planes,
        })
    }

    /// Reads all codes and forgets what they say.
    ///
    /// # Errors
    /// Where the coded data is damaged.
    pub(super) fn verify(&self) -> Result<(), String> {
        let nothing = Window {
            x: (0, 0),
            y: (0, 0),
        };
        self.means(8, nothing).map(|_| ())
    }

    /// Means over cells of `cell` x `cell` pixels (2, 4 or 8) of at least what lies in `window`.
    ///
    /// # Errors
    /// Where the coded data is damaged.
    pub(super) fn means(&self, cell: usize, window: Window) -> Result<Means, String> {
        let pixels = (8 * self.mcu.0, 8 * self.mcu.1);
        let count = (
            self.size.0.div_ceil(pixels.0),
            self.size.1.div_ceil(pixels.1),
        );
        let covered = |range: (usize, usize), pixels: usize, size: usize| {
            let end = range.1.min(size);
            (range.0.min(end) / pixels, end.div_ceil(pixels))
        };
        let columns = covered(window.x, pixels.0, self.size.0);
        let rows = covered(window.y, pixels.1, self.size.1);
        let inside = |range: (usize, usize), pixels: usize, size: usize| {
            (range.1 * pixels).min(size.next_multiple_of(cell)) - range.0 * pixels
        };
        let mut means = Means {
            width: inside(columns, pixels.0, self.size.0) / cell,
            height: inside(rows, pixels.1, self.size.1) / cell,
            origin: (columns.0 * pixels.0, rows.0 * pixels.1),
            rgb: Vec::new(),
        };
        means.rgb.reserve_exact(means.width * means.height * 3);

        let bases: Vec<Basis> = self
            .planes
            .iter()
            .map(|plane| Basis::new(self.mcu, plane.blocks, cell))
            .collect();
        // One row of MCUs, a plane per component, all at the cells' resolution.
        let stride = (columns.1 - columns.0) * pixels.0 / cell;
        let mut band = vec![vec![0.0_f32; stride * pixels.1 / cell]; self.planes.len()];

        let (coded, segments) = unstuffed(self.coded);
        let mut bits = Bits::new(&coded, 0);
        let mut segments = segments.into_iter();
        let mut segment_end = segments.next().unwrap_or(0);
        let (mut coefficients, mut flat) = (Coefficients::default(), Coefficients::default());
        let mut predictions = vec![0_i32; self.planes.len()];
        let mut until_restart = self.restart_interval;
        let damaged = |row: usize, column: usize| {
            format!(
                "its coded data is damaged near pixel ({}, {})",
                column * pixels.0,
                row * pixels.1
            )
        };
        for row in 0..count.1 {
            let wanted_row = (rows.0..rows.1).contains(&row);
            for column in 0..count.0 {
                if self.restart_interval > 0 {
                    if until_restart == 0 {
                        let start = segment_end;
                        if !bits.ends_at(segment_end) {
                            return Err(damaged(row, column));
                        }
                        segment_end = segments.next().ok_or_else(|| damaged(row, column))?;
                        bits = Bits::new(&coded, start);
                        predictions.fill(0);
                        until_restart = self.restart_interval;
                    }
                    until_restart -= 1;
                }
                let wanted = wanted_row && (columns.0..columns.1).contains(&column);
                for (index, plane) in self.planes.iter().enumerate() {
                    let basis = &bases[index];
                    for block in 0..plane.blocks.0 * plane.blocks.1 {
                        let prediction = &mut predictions[index];
                        if wanted && !basis.only_dc() {
                            bits.block::<true>(plane, prediction, &mut coefficients)
                        } else {
                            bits.block::<false>(plane, prediction, &mut flat)
                        }
                        .ok_or_else(|| damaged(row, column))?;
                        if wanted {
                            let read = if basis.only_dc() {
                                &flat
                            } else {
                                &coefficients
                            };
                            let at = (
                                (column - columns.0) * pixels.0 / cell
                                    + block % plane.blocks.0 * basis.cells.0,
                                block / plane.blocks.0 * basis.cells.1,
                            );
                            basis.write(read, &mut band[index][at.1 * stride + at.0..], stride);
                        }
                    }
                }
            }
            if wanted_row {
                let lines = (pixels.1 / cell).min(means.height - (row - rows.0) * pixels.1 / cell);
                for line in 0..lines {
                    let line = line * stride..line * stride + means.width;
                    append_rgb(&band, line, &mut means.rgb);
                }
            }
        }
        if bits.ends_at(segment_end) && segments.next().is_none() {
            Ok(means)
        } else {
            Err(damaged(count.1 - 1, count.0 - 1))
        }
    }
}

/// Full-range BT.601 (JFIF) or grey to RGB at 16 bits; the band's values are centred on zero.
fn append_rgb(band: &[Vec<f32>], line: std::ops::Range<usize>, rgb: &mut Vec<u16>) {
    let scaled = |value: f32| (value * 257.0 + 0.5).clamp(0.0, 65535.0) as u16;
    match band {
        [y, cb, cr] => {
            let planes = y[line.clone()].iter().zip(&cb[line.clone()]).zip(&cr[line]);
            rgb.extend(planes.flat_map(|((&y, &cb), &cr)| {
                let y = y + 128.0;
                [
                    scaled(y + 1.402 * cr),
                    scaled(y - 0.344_136_3 * cb - 0.714_136_3 * cr),
                    scaled(y + 1.772 * cb),
                ]
            }));
        }
        _ => rgb.extend(band[0][line].iter().flat_map(|&y| [scaled(y + 128.0); 3])),
    }
}

/// The coded data without stuffing, and where each part between restart markers ends in it.
fn unstuffed(coded: &[u8]) -> (Vec<u8>, Vec<usize>) {
    let mut bytes = Vec::with_capacity(coded.len() + PADDING);
    let mut ends = Vec::new();
    let mut rest = coded;
    while let Some(at) = memchr::memchr(0xff, rest) {
        bytes.extend_from_slice(&rest[..at]);
        match rest.get(at + 1) {
            Some(0) => bytes.push(0xff),
            Some(0xd0..=0xd7) => ends.push(bytes.len()),
            // Fill bytes: the second one may begin the marker.
            _ => {
                rest = &rest[at + 1..];
                continue;
            }
        }
        rest = &rest[at + 2..];
    }
    bytes.extend_from_slice(rest);
    ends.push(bytes.len());
    bytes.resize(bytes.len() + PADDING, 0);
    (bytes, ends)
}

/// A block's dequantised coefficients, row-major, and which of its rows hold any beyond the first coefficient.
struct Coefficients {
    values: [f32; 64],
    rows: u8,
}

impl Default for Coefficients {
    fn default() -> Self {
        Self {
            values: [0.0; 64],
            rows: 0,
        }
    }
}

/// How one component's blocks become means.
struct Basis {
    /// Cells of one block.
    cells: (usize, usize),
    /// `[u][X]`.
    x: [[f32; 8]; 8],
    y: [[f32; 8]; 8],
}

impl Basis {
    fn new(mcu: (usize, usize), blocks: (usize, usize), cell: usize) -> Self {
        let cells = (mcu.0 / blocks.0 * 8 / cell, mcu.1 / blocks.1 * 8 / cell);
        Self {
            cells,
            x: means_of_cosines(cells.0),
            y: means_of_cosines(cells.1),
        }
    }

    fn only_dc(&self) -> bool {
        self.cells == (1, 1)
    }

    fn write(&self, block: &Coefficients, out: &mut [f32], stride: usize) {
        match self.cells {
            (1, 1) => self.write_cells::<1, 1>(block, out, stride),
            (1, 2) => self.write_cells::<1, 2>(block, out, stride),
            (2, 1) => self.write_cells::<2, 1>(block, out, stride),
            (2, 2) => self.write_cells::<2, 2>(block, out, stride),
            (2, 4) => self.write_cells::<2, 4>(block, out, stride),
            (4, 2) => self.write_cells::<4, 2>(block, out, stride),
            (4, 4) => self.write_cells::<4, 4>(block, out, stride),
            (4, 8) => self.write_cells::<4, 8>(block, out, stride),
            (8, 4) => self.write_cells::<8, 4>(block, out, stride),
            _ => self.write_cells::<8, 8>(block, out, stride),
        }
    }

    /// `NX` x `NY` cells.
    fn write_cells<const NX: usize, const NY: usize>(
        &self,
        block: &Coefficients,
        out: &mut [f32],
        stride: usize,
    ) {
        let flat = block.values[0] / 8.0;
        let (first, _) = block.values.as_chunks::<8>();
        if block.rows == 0 || (NX, NY) == (1, 1) {
            for line in out.chunks_mut(stride).take(NY) {
                line[..NX].fill(flat);
            }
            return;
        }
        let mut columns = [[0.0_f32; 8]; NY];
        for (v, row) in first.iter().enumerate() {
            if v > 0 && block.rows & (1 << v) == 0 {
                continue;
            }
            for (sum, &weight) in columns.iter_mut().zip(&self.y[v]) {
                for (sum, &value) in sum.iter_mut().zip(row) {
                    *sum += weight * value;
                }
            }
        }
        for (line, column) in out.chunks_mut(stride).zip(&columns) {
            let mut cells = [0.0_f32; NX];
            for (&value, weights) in column.iter().zip(&self.x) {
                for (cell, &weight) in cells.iter_mut().zip(weights) {
                    *cell += value * weight;
                }
            }
            line[..NX].copy_from_slice(&cells);
        }
    }
}

/// `[u][X]`: means of the transform's basis functions over each of `cells` equal parts of a block.
fn means_of_cosines(cells: usize) -> [[f32; 8]; 8] {
    let mut basis = [[0.0; 8]; 8];
    let part = 8 / cells;
    for (u, row) in basis.iter_mut().enumerate() {
        let scale = if u == 0 { 0.125_f64.sqrt() } else { 0.5 };
        for (x, value) in row.iter_mut().take(cells).enumerate() {
            let samples = (x * part..(x + 1) * part).map(|x| {
                ((2 * x + 1) as f64 * u as f64 * std::f64::consts::PI / 16.0).cos() * scale
            });
            *value = (samples.sum::<f64>() / part as f64) as f32;
        }
    }
    basis
}

/// A Huffman table for decoding.
struct Huffman {
    /// By the next [`LOOKUP_BITS`] bits; see [`Entry`].
    lookup: Box<[Entry; 1 << LOOKUP_BITS]>,
    /// By length: the first code that is too large, left-aligned to 16 bits, and what leads from code to value.
    beyond: [u32; 17],
    offset: [i32; 17],
    values: Vec<u8>,
}

/// A code found by lookup, packed: bits to move on by (8), run and size (8), the number (16). The bits are those of the
/// code and of the number; [`Entry::CODE_ALONE`] is added to them where the number was out of reach, and they are 0
/// where the code was.
#[derive(Debug, Clone, Copy, Default)]
struct Entry(u32);

impl Entry {
    const CODE_ALONE: u32 = 64;

    fn new(length: u32, value: u8, number: i32) -> Self {
        Self(length | u32::from(value) << 8 | (number as u32) << 16)
    }

    fn length(self) -> u32 {
        self.0 & 255
    }

    fn value(self) -> u8 {
        (self.0 >> 8) as u8
    }

    fn number(self) -> i32 {
        self.0 as i32 >> 16
    }
}

impl Huffman {
    /// `None` where the lengths make no prefix code.
    fn new(codes: &HuffmanCodes) -> Option<Self> {
        let mut table = Self {
            lookup: Box::new([Entry::default(); 1 << LOOKUP_BITS]),
            beyond: [0; 17],
            offset: [0; 17],
            values: codes.values.clone(),
        };
        let (mut code, mut index) = (0_u32, 0_usize);
        for (length, &count) in (1_u32..).zip(&codes.counts) {
            table.offset[length as usize] = index as i32 - code as i32;
            for _ in 0..count {
                if code >= 1 << length {
                    return None;
                }
                table.enter(code, length, codes.values[index]);
                code += 1;
                index += 1;
            }
            table.beyond[length as usize] = code << (16 - length);
            code <<= 1;
        }
        Some(table)
    }

    fn enter(&mut self, code: u32, length: u32, value: u8) {
        let Some(free) = LOOKUP_BITS.checked_sub(length) else {
            return;
        };
        let size = u32::from(value & 15);
        for tail in 0..1_u32 << free {
            self.lookup[((code << free) | tail) as usize] = match free.checked_sub(size) {
                Some(left) => Entry::new(length + size, value, extend(tail >> left, size)),
                None => Entry::new(length + Entry::CODE_ALONE, value, 0),
            };
        }
    }
}

/// The number that `size` bits stand for (T.81, F.2.2.1).
fn extend(bits: u32, size: u32) -> i32 {
    if size == 0 {
        0
    } else if bits >> (size - 1) == 0 {
        bits as i32 - (1 << size) + 1
    } else {
        bits as i32
    }
}

/// Reads unstuffed data bit by bit. `window` holds the next bits from its top, at least `count` of them.
struct Bits<'a> {
    data: &'a [u8],
    at: usize,
    window: u64,
    count: u32,
}

impl<'a> Bits<'a> {
    fn new(data: &'a [u8], at: usize) -> Self {
        Self {
            data,
            at,
            window: 0,
            count: 0,
        }
    }

    /// At least 56 bits are there afterwards; `None` beyond the padding.
    #[inline]
    fn refill(&mut self) -> Option<()> {
        let next = self.data.get(self.at..)?.first_chunk::<8>()?;
        self.window |= u64::from_be_bytes(*next) >> self.count;
        let bytes = (63 - self.count) >> 3;
        self.at += bytes as usize;
        self.count += bytes * 8;
        Some(())
    }

    #[inline]
    fn skip(&mut self, bits: u32) {
        self.window <<= bits;
        self.count -= bits;
    }

    /// The next code's value and number.
    #[expect(
        clippy::inline_always,
        reason = "keeps the window in registers: a quarter less time"
    )]
    #[inline(always)]
    fn symbol(&mut self, table: &Huffman) -> Option<(u8, i32)> {
        // A code has at most 16 bits, its number at most 15.
        if self.count < 32 {
            self.refill()?;
        }
        let entry = table.lookup[(self.window >> (64 - LOOKUP_BITS)) as usize];
        if matches!(entry.length(), 1..Entry::CODE_ALONE) {
            self.skip(entry.length());
            return Some((entry.value(), entry.number()));
        }
        self.long_symbol(table, entry)
    }

    #[cold]
    fn long_symbol(&mut self, table: &Huffman, entry: Entry) -> Option<(u8, i32)> {
        let value = if entry.length() > 0 {
            self.skip(entry.length() - Entry::CODE_ALONE);
            entry.value()
        } else {
            self.long_code(table)?
        };
        let size = u32::from(value & 15);
        let number = extend((self.window >> 32 >> (32 - size)) as u32, size);
        self.skip(size);
        Some((value, number))
    }

    fn long_code(&mut self, table: &Huffman) -> Option<u8> {
        let ahead = (self.window >> 48) as u32;
        let length = (LOOKUP_BITS as usize + 1..17).find(|&n| ahead < table.beyond[n])?;
        let code = (ahead >> (16 - length)) as i32;
        let value = table.values.get((code + table.offset[length]) as usize)?;
        self.skip(length as u32);
        Some(*value)
    }

    /// Reads a block; with `KEEP` into `block`, which is zero beyond its first coefficient where its `rows` are.
    fn block<const KEEP: bool>(
        &mut self,
        plane: &Plane,
        prediction: &mut i32,
        block: &mut Coefficients,
    ) -> Option<()> {
        if KEEP && block.rows != 0 {
            block.values = [0.0; 64];
            block.rows = 0;
        }
        let (size, difference) = self.symbol(&plane.dc)?;
        if size > 15 {
            return None;
        }
        *prediction = prediction.wrapping_add(difference);
        block.values[0] = *prediction as f32 * plane.quantisation[0];
        let mut k = 1;
        while k < 64 {
            let (value, number) = self.symbol(&plane.ac)?;
            k += usize::from(value >> 4);
            let size = value & 15;
            if size == 0 {
                if value != 0xf0 {
                    break;
                }
            } else if KEEP && k < 64 {
                let at = NATURAL[k];
                block.values[usize::from(at & 63)] = number as f32 * plane.quantisation[k];
                block.rows |= 1 << (at >> 3);
            }
            k += 1;
        }
        // Runs may not lead beyond the block.
        (k <= 64).then_some(())
    }

    /// Whether what was read ends with the part that ends at `end`: only padding may be left.
    fn ends_at(&self, end: usize) -> bool {
        let read = self.at * 8 - self.count as usize;
        let next = read.div_ceil(8);
        let rest = self.data.get(next..end);
        read <= end * 8 && rest.is_some_and(|rest| rest.iter().all(|byte| matches!(byte, 0 | 255)))
    }
}
