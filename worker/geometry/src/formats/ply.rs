//! PLY: the Stanford polygon format (Turk 1994), ascii and binary of either byte order.
//!
//! Read: element `vertex` with `x y z`, optionally `nx ny nz` and `red green blue` (also as `diffuse_red` or `r`, of any
//! scalar type); element `face` with the list `vertex_indices` or `vertex_index`. Everything else is skipped. Counts in
//! the header are not trusted: memory grows with the data that is really there.

use glam::DVec3;

use super::{Fault, Soup, bytes_from_real_colors};

/// Scalar types, under both their old and new names.
#[derive(Clone, Copy)]
enum Scalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Scalar {
    fn parse(name: &str) -> Option<Self> {
        Some(match name {
            "char" | "int8" => Self::I8,
            "uchar" | "uint8" => Self::U8,
            "short" | "int16" => Self::I16,
            "ushort" | "uint16" => Self::U16,
            "int" | "int32" => Self::I32,
            "uint" | "uint32" => Self::U32,
            "float" | "float32" => Self::F32,
            "double" | "float64" => Self::F64,
            _ => return None,
        })
    }

    /// Factor that takes a stored colour to [0, 1].
    fn color_scale(self) -> f64 {
        match self {
            Self::U16 => 1.0 / 65535.0,
            Self::F32 | Self::F64 => 1.0,
            Self::I8 | Self::U8 | Self::I16 | Self::I32 | Self::U32 => 1.0 / 255.0,
        }
    }
}

struct Property {
    name: String,
    /// Type of the count, for a list.
    count: Option<Scalar>,
    value: Scalar,
}

struct Element {
    name: String,
    count: usize,
    properties: Vec<Property>,
}

#[derive(Clone, Copy)]
enum Encoding {
    Ascii,
    LittleEndian,
    BigEndian,
}

pub(super) fn parse(bytes: &[u8]) -> Result<Soup, Fault> {
    let (encoding, elements, start, lines) = header(bytes)?;
    let mut soup = Soup::default();
    match encoding {
        Encoding::Ascii => {
            let text = std::str::from_utf8(&bytes[start..]).map_err(|error| {
                Fault::new(
                    format!("byte {}", start + error.valid_up_to()),
                    "not text, but the header says ascii",
                )
            })?;
            body(
                &mut Words {
                    lines: text.lines(),
                    entry: "".split_whitespace(),
                    line: lines,
                },
                &elements,
                &mut soup,
            )?;
        }
        Encoding::LittleEndian => body(
            &mut Binary::<false> { bytes, at: start },
            &elements,
            &mut soup,
        )?,
        Encoding::BigEndian => body(
            &mut Binary::<true> { bytes, at: start },
            &elements,
            &mut soup,
        )?,
    }
    Ok(soup)
}

/// Encoding, elements, where the data starts, and how many lines the header has.
fn header(bytes: &[u8]) -> Result<(Encoding, Vec<Element>, usize, usize), Fault> {
    if !bytes.starts_with(b"ply") {
        return Err(Fault::new("line 1", "expected \"ply\""));
    }
    let mut encoding = None;
    let mut elements: Vec<Element> = Vec::new();
    let mut at = 0;
    for line in 1.. {
        let fault = |reason: &str| Fault::new(format!("line {line}"), reason);
        let Some(length) = bytes[at..].iter().position(|&byte| byte == b'\n') else {
            return Err(fault("header does not end with \"end_header\""));
        };
        let text = String::from_utf8_lossy(&bytes[at..at + length]);
        at += length + 1;
        let words: Vec<&str> = text.split_whitespace().collect();
        match words[..] {
            ["ply"] if line == 1 => {}
            _ if line == 1 => return Err(fault("expected \"ply\"")),
            ["format", name, _] => {
                encoding = Some(match name {
                    "ascii" => Encoding::Ascii,
                    "binary_little_endian" => Encoding::LittleEndian,
                    "binary_big_endian" => Encoding::BigEndian,
                    _ => return Err(fault(&format!("unknown format {name:?}"))),
                });
            }
            ["element", name, count] => {
                let count = count
                    .parse()
                    .map_err(|_error| fault(&format!("count {count:?} is no number")))?;
                elements.push(Element {
                    name: name.to_owned(),
                    count,
                    properties: Vec::new(),
                });
            }
            ["property", ref rest @ ..] => {
                let element = elements
                    .last_mut()
                    .ok_or_else(|| fault("property before any element"))?;
                let scalar = |name: &str| {
                    Scalar::parse(name).ok_or_else(|| fault(&format!("unknown type {name:?}")))
                };
                element.properties.push(match rest {
                    ["list", count, value, name] => Property {
                        name: (*name).to_owned(),
                        count: Some(scalar(count)?),
                        value: scalar(value)?,
                    },
                    [value, name] => Property {
                        name: (*name).to_owned(),
                        count: None,
                        value: scalar(value)?,
                    },
                    _ => return Err(fault("property is not \"property TYPE NAME\"")),
                });
            }
            ["end_header"] => {
                let encoding = encoding.ok_or_else(|| fault("no format line"))?;
                return Ok((encoding, elements, at, line));
            }
            [] | ["comment" | "obj_info", ..] => {}
            _ => return Err(fault(&format!("unknown header line {:?}", text.trim()))),
        }
    }
    Err(Fault::new("line 1", "empty"))
}

/// Source of the numbers after the header.
trait Numbers {
    fn number(&mut self, scalar: Scalar) -> Result<f64, Fault>;
    /// Where the number just read stands.
    fn place(&self) -> String;
    /// Called before each entry of an element; an ascii entry starts on its own line.
    fn next_entry(&mut self);
}

struct Words<'a> {
    lines: std::str::Lines<'a>,
    entry: std::str::SplitWhitespace<'a>,
    line: usize,
}

impl Numbers for Words<'_> {
    fn number(&mut self, _scalar: Scalar) -> Result<f64, Fault> {
        loop {
            if let Some(word) = self.entry.next() {
                return word
                    .parse()
                    .map_err(|_error| Fault::new(self.place(), format!("{word:?} is no number")));
            }
            let Some(line) = self.lines.next() else {
                return Err(Fault::new(
                    self.place(),
                    "file ends before the last element",
                ));
            };
            self.line += 1;
            self.entry = line.split_whitespace();
        }
    }

    fn place(&self) -> String {
        format!("line {}", self.line)
    }

    fn next_entry(&mut self) {
        self.entry = "".split_whitespace();
    }
}

struct Binary<'a, const BIG: bool> {
    bytes: &'a [u8],
    at: usize,
}

impl<const BIG: bool> Binary<'_, BIG> {
    fn take<const N: usize>(&mut self) -> Result<[u8; N], Fault> {
        let Some(bytes) = self
            .bytes
            .get(self.at..)
            .and_then(|rest| rest.first_chunk::<N>())
        else {
            return Err(Fault::new(
                self.place(),
                "file ends before the last element",
            ));
        };
        self.at += N;
        let mut bytes = *bytes;
        if BIG {
            bytes.reverse();
        }
        Ok(bytes)
    }
}

impl<const BIG: bool> Numbers for Binary<'_, BIG> {
    fn number(&mut self, scalar: Scalar) -> Result<f64, Fault> {
        Ok(match scalar {
            Scalar::I8 => f64::from(i8::from_le_bytes(self.take()?)),
            Scalar::U8 => f64::from(u8::from_le_bytes(self.take()?)),
            Scalar::I16 => f64::from(i16::from_le_bytes(self.take()?)),
            Scalar::U16 => f64::from(u16::from_le_bytes(self.take()?)),
            Scalar::I32 => f64::from(i32::from_le_bytes(self.take()?)),
            Scalar::U32 => f64::from(u32::from_le_bytes(self.take()?)),
            Scalar::F32 => f64::from(f32::from_le_bytes(self.take()?)),
            Scalar::F64 => f64::from_le_bytes(self.take()?),
        })
    }

    fn place(&self) -> String {
        format!("byte {}", self.at)
    }

    fn next_entry(&mut self) {}
}

/// What a property of a vertex means to us: which of the nine numbers it is, under any of its names.
const VERTEX_NAMES: [&[&str]; 9] = [
    &["x"],
    &["y"],
    &["z"],
    &["nx"],
    &["ny"],
    &["nz"],
    &["red", "diffuse_red", "r"],
    &["green", "diffuse_green", "g"],
    &["blue", "diffuse_blue", "b"],
];

fn body(numbers: &mut impl Numbers, elements: &[Element], soup: &mut Soup) -> Result<(), Fault> {
    let has = |name: &str| elements.iter().any(|element| element.name == name);
    if has("tristrips") && !has("face") {
        return Err(Fault::new(
            "header",
            "the file holds triangle strips; export it again with faces",
        ));
    }
    for element in elements {
        match element.name.as_str() {
            "vertex" => vertices(numbers, element, soup)?,
            "face" => faces(numbers, element, soup)?,
            _ => {
                if element.properties.is_empty() {
                    continue;
                }
                for _ in 0..element.count {
                    numbers.next_entry();
                    for property in &element.properties {
                        for _ in 0..length(numbers, property)? {
                            numbers.number(property.value)?;
                        }
                    }
                }
            }
        }
    }
    Ok(())
}

/// How many numbers a property holds in this entry: 1, or the list's count.
fn length(numbers: &mut impl Numbers, property: &Property) -> Result<usize, Fault> {
    let Some(scalar) = property.count else {
        return Ok(1);
    };
    let count = numbers.number(scalar)?;
    if count < 0.0 || count.fract() != 0.0 || count > f64::from(u32::MAX) {
        return Err(Fault::new(
            numbers.place(),
            format!("list length {count} is no count"),
        ));
    }
    Ok(count as usize)
}

fn vertices(numbers: &mut impl Numbers, element: &Element, soup: &mut Soup) -> Result<(), Fault> {
    let slots: Vec<Option<usize>> = element
        .properties
        .iter()
        .map(|property| {
            VERTEX_NAMES
                .iter()
                .position(|names| names.contains(&&property.name[..]) && property.count.is_none())
        })
        .collect();
    let has =
        |wanted: std::ops::Range<usize>| wanted.into_iter().all(|slot| slots.contains(&Some(slot)));
    if !has(0..3) {
        return Err(Fault::new("header", "element vertex has no x, y, z"));
    }
    let mut normals = has(3..6).then(Vec::new);
    let mut colors: Option<Vec<[f32; 3]>> = has(6..9).then(Vec::new);
    for vertex in 0..element.count {
        numbers.next_entry();
        let mut values = [0.0; VERTEX_NAMES.len()];
        for (property, slot) in element.properties.iter().zip(&slots) {
            for _ in 0..length(numbers, property)? {
                let number = numbers.number(property.value)?;
                if let Some(slot) = *slot {
                    values[slot] = if slot < 6 {
                        number
                    } else {
                        number * property.value.color_scale()
                    };
                }
            }
        }
        let [x, y, z, nx, ny, nz, red, green, blue] = values;
        if !(x.is_finite() && y.is_finite() && z.is_finite()) {
            return Err(Fault::new(
                format!("vertex {vertex}"),
                format!("position ({x}, {y}, {z}) is not finite"),
            ));
        }
        soup.positions.push(DVec3::new(x, y, z));
        if let Some(normals) = &mut normals {
            normals.push(DVec3::new(nx, ny, nz));
        }
        if let Some(colors) = &mut colors {
            colors.push([red, green, blue].map(|channel| channel as f32));
        }
    }
    soup.normals = normals;
    soup.colors = colors.map(|colors| bytes_from_real_colors(&colors));
    Ok(())
}

fn faces(numbers: &mut impl Numbers, element: &Element, soup: &mut Soup) -> Result<(), Fault> {
    let is_corners = |property: &Property| {
        property.count.is_some()
            && matches!(property.name.as_str(), "vertex_indices" | "vertex_index")
    };
    if element.count > 0 && !element.properties.iter().any(is_corners) {
        return Err(Fault::new(
            "header",
            "element face has no list vertex_indices",
        ));
    }
    let mut corners = Vec::new();
    for face in 0..element.count {
        numbers.next_entry();
        for property in &element.properties {
            let count = length(numbers, property)?;
            if !is_corners(property) {
                for _ in 0..count {
                    numbers.number(property.value)?;
                }
                continue;
            }
            corners.clear();
            for _ in 0..count {
                let index = numbers.number(property.value)?;
                if !(index >= 0.0 && index.fract() == 0.0 && index < f64::from(u32::MAX)) {
                    let reason = format!("face {face} names vertex {index}");
                    return Err(Fault::new(numbers.place(), reason));
                }
                corners.push(index as u32);
            }
            for pair in corners.get(1..).unwrap_or_default().windows(2) {
                soup.triangles.push([corners[0], pair[0], pair[1]]);
            }
        }
    }
    Ok(())
}
