//! OBJ (Wavefront): `v` with optional colour in [0, 1], `vn`, and `f` with any number of corners, positive or
//! negative indices. Texture coordinates, groups and materials are ignored.
//!
//! OBJ gives normals to corners of faces; a vertex here has one normal, the mean of those its corners name.

use glam::DVec3;

use super::{Fault, Soup};

pub(super) fn parse(bytes: &[u8]) -> Result<Soup, Fault> {
    let mut soup = Soup::default();
    let mut colors = Vec::new();
    let mut file_normals = Vec::new();
    let mut normals: Vec<DVec3> = Vec::new();
    let mut corners = Vec::new();
    for (index, line) in bytes.split(|&byte| byte == b'\n').enumerate() {
        let place = format_args!("line {}", index + 1).to_string();
        let fault = |reason: String| Fault::new(place.as_str(), reason);
        let line = String::from_utf8_lossy(line);
        let line = line.split('#').next().unwrap_or_default();
        let mut words = line.split_whitespace();
        let Some(keyword) = words.next() else {
            continue;
        };
        let numbers = |words: std::str::SplitWhitespace<'_>| -> Result<Vec<f64>, Fault> {
            words
                .map(|word| {
                    word.parse()
                        .map_err(|_error| fault(format!("{word:?} is no number")))
                })
                .collect()
        };
        match keyword {
            "v" => {
                let numbers = numbers(words)?;
                let &[x, y, z, ref rest @ ..] = &numbers[..] else {
                    return Err(fault("vertex has fewer than three coordinates".to_owned()));
                };
                if !(x.is_finite() && y.is_finite() && z.is_finite()) {
                    let vertex = soup.positions.len();
                    return Err(fault(format!(
                        "vertex {vertex} at ({x}, {y}, {z}) is not finite"
                    )));
                }
                soup.positions.push(DVec3::new(x, y, z));
                if let &[red, green, blue] = rest {
                    colors.push([red, green, blue].map(|channel| (channel * 255.0).round() as u8));
                }
            }
            "vn" => match numbers(words)?[..] {
                [x, y, z] => file_normals.push(DVec3::new(x, y, z)),
                _ => return Err(fault("normal has not three coordinates".to_owned())),
            },
            "f" => {
                corners.clear();
                for word in words {
                    let mut parts = word.split('/');
                    let vertex = resolve(parts.next().unwrap_or_default(), soup.positions.len())
                        .ok_or_else(|| {
                            fault(format!("corner {word:?} names no vertex before it"))
                        })?;
                    corners.push(vertex as u32);
                    if let Some(part) = parts.nth(1).filter(|part| !part.is_empty()) {
                        let normal = resolve(part, file_normals.len()).ok_or_else(|| {
                            fault(format!("corner {word:?} names no normal before it"))
                        })?;
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
    soup.colors = (!colors.is_empty() && colors.len() == soup.positions.len()).then_some(colors);
    soup.normals = (!normals.is_empty()).then_some(normals);
    Ok(soup)
}

/// Index from 0 of the item that an OBJ reference names: from 1, or from the end when negative.
fn resolve(word: &str, count: usize) -> Option<usize> {
    let reference: i64 = word.parse().ok()?;
    let index = if reference < 0 {
        (count as i64).checked_add(reference)?
    } else {
        reference - 1
    };
    usize::try_from(index).ok().filter(|index| *index < count)
}
