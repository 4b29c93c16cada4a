//! OBJ (Wavefront): `v` with optional colour, `vn`, and `f` with any number of corners, positive or negative indices.
//! Texture coordinates, groups and materials are ignored, so no material file is needed: a material's one colour says
//! nothing about single vertices.
//!
//! OBJ gives normals to corners of faces; a vertex here has one normal, the mean of those its corners name.

use glam::DVec3;

use super::{Fault, Soup, bytes_from_real_colors};

/// What a line of an OBJ file may begin with, by which the format is recognised.
pub(super) const KEYWORDS: [&str; 14] = [
    "v", "vn", "vt", "vp", "f", "l", "p", "o", "g", "s", "mg", "mtllib", "usemtl", "usemap",
];

pub(super) fn parse(bytes: &[u8]) -> Result<Soup, Fault> {
    let mut soup = Soup::default();
    let mut colors: Vec<[f32; 3]> = Vec::new();
    let mut file_normals = Vec::new();
    let mut normals: Vec<DVec3> = Vec::new();
    let mut corners = Vec::new();
    let mut joined = Vec::new();
    for (index, line) in bytes.split(|&byte| byte == b'\n').enumerate() {
        let fault = |reason: String| Fault::new(format!("line {}", index + 1), reason);
        // A backslash at the end continues the line.
        if let Some(begun) = line.trim_ascii_end().strip_suffix(b"\\") {
            joined.extend_from_slice(begun);
            joined.push(b' ');
            continue;
        }
        let whole;
        let line = if joined.is_empty() {
            line
        } else {
            joined.extend_from_slice(line);
            whole = std::mem::take(&mut joined);
            &whole[..]
        };
        let line = line.split(|&byte| byte == b'#').next().unwrap_or_default();
        let mut words = line
            .split(u8::is_ascii_whitespace)
            .filter(|word| !word.is_empty());
        let Some(keyword) = words.next() else {
            continue;
        };
        match keyword {
            b"v" => {
                let mut numbers = [0.0; 8];
                let mut count = 0;
                for word in words {
                    let number = number(word).map_err(fault)?;
                    if let Some(slot) = numbers.get_mut(count) {
                        *slot = number;
                    }
                    count += 1;
                }
                let [x, y, z, red, green, blue, _, _] = numbers;
                if count < 3 {
                    return Err(fault("vertex has fewer than three coordinates".to_owned()));
                }
                if !(x.is_finite() && y.is_finite() && z.is_finite()) {
                    let vertex = soup.positions.len();
                    return Err(fault(format!(
                        "vertex {vertex} at ({x}, {y}, {z}) is not finite"
                    )));
                }
                soup.positions.push(DVec3::new(x, y, z));
                // Six numbers are a place and a colour; four are a place and a weight.
                if count == 6 || count == 7 {
                    colors.push([red, green, blue].map(|channel| channel as f32));
                }
            }
            b"vn" => {
                let mut normal = [0.0; 3];
                for slot in &mut normal {
                    let word = words.next().ok_or_else(|| {
                        fault("normal has fewer than three coordinates".to_owned())
                    })?;
                    *slot = number(word).map_err(fault)?;
                }
                file_normals.push(DVec3::from_array(normal));
            }
            b"f" => {
                corners.clear();
                for word in words {
                    let names = |what: &str| {
                        fault(format!(
                            "corner {:?} names no {what} before it",
                            String::from_utf8_lossy(word)
                        ))
                    };
                    let mut parts = word.split(|&byte| byte == b'/');
                    let vertex = resolve(parts.next().unwrap_or_default(), soup.positions.len())
                        .ok_or_else(|| names("vertex"))?;
                    corners.push(vertex as u32);
                    if let Some(part) = parts.nth(1).filter(|part| !part.is_empty()) {
                        let normal =
                            resolve(part, file_normals.len()).ok_or_else(|| names("normal"))?;
                        if normals.len() <= vertex {
                            normals.resize(soup.positions.len(), DVec3::ZERO);
                        }
                        normals[vertex] += file_normals[normal].normalize_or_zero();
                    }
                }
                if corners.len() < 3 {
                    return Err(fault(format!("face has {} corners", corners.len())));
                }
                for pair in corners[1..].windows(2) {
                    soup.triangles.push([corners[0], pair[0], pair[1]]);
                }
            }
            _ => {}
        }
    }
    soup.colors = (!colors.is_empty() && colors.len() == soup.positions.len())
        .then(|| bytes_from_real_colors(&colors));
    soup.normals = (!normals.is_empty()).then_some(normals);
    Ok(soup)
}

fn number(word: &[u8]) -> Result<f64, String> {
    std::str::from_utf8(word)
        .ok()
        .and_then(|text| text.parse().ok())
        .ok_or_else(|| format!("{:?} is no number", String::from_utf8_lossy(word)))
}

/// Index from 0 of the item that an OBJ reference names: from 1, or from the end when negative.
fn resolve(word: &[u8], count: usize) -> Option<usize> {
    let reference: i64 = std::str::from_utf8(word).ok()?.parse().ok()?;
    let index = if reference < 0 {
        (count as i64).checked_add(reference)?
    } else {
        reference - 1
    };
    usize::try_from(index).ok().filter(|index| *index < count)
}
