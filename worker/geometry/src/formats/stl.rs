//! STL (3D Systems 1989): binary and ASCII. Corners at the same place become one vertex; facet normals and the
//! attribute bytes, which every program fills differently, are not used.

use std::collections::HashMap;

use glam::DVec3;

use super::{Fault, Soup};

const HEADER_BYTES: usize = 80;
const FACET_BYTES: usize = 50;
/// Bytes at the start of a text file that no NUL is expected in.
const TEXT_BYTES: usize = 1024;

/// Whether the file is as long as its facet count says. The first word tells nothing: many programs begin the header
/// of a binary file with "solid".
pub(super) fn is_binary(bytes: &[u8]) -> bool {
    expected_bytes(bytes) == Some(bytes.len())
}

fn expected_bytes(bytes: &[u8]) -> Option<usize> {
    let count = u32::from_le_bytes(*bytes.get(HEADER_BYTES..)?.first_chunk()?) as usize;
    count
        .checked_mul(FACET_BYTES)?
        .checked_add(HEADER_BYTES + 4)
}

pub(super) fn parse(bytes: &[u8]) -> Result<Soup, Fault> {
    let is_text = bytes.trim_ascii_start().starts_with(b"solid")
        && !bytes[..bytes.len().min(TEXT_BYTES)].contains(&0);
    let corners = if is_text && !is_binary(bytes) {
        text(bytes)?
    } else {
        binary(bytes)?
    };
    if let Some(corner) = corners.iter().position(|position| !position.is_finite()) {
        let DVec3 { x, y, z } = corners[corner];
        return Err(Fault::new(
            format!("triangle {}", corner / 3),
            format!("corner ({x}, {y}, {z}) is not finite"),
        ));
    }
    Ok(merged(corners))
}

fn binary(bytes: &[u8]) -> Result<Vec<DVec3>, Fault> {
    let expected = expected_bytes(bytes).ok_or_else(|| {
        Fault::new(
            "byte 0",
            "too short for a binary STL, and no ASCII STL either",
        )
    })?;
    if bytes.len() < expected {
        return Err(Fault::new(
            format!("byte {}", bytes.len()),
            format!("the file ends here, its facet count asks for {expected} bytes"),
        ));
    }
    let (facets, _) = bytes[HEADER_BYTES + 4..expected].as_chunks::<FACET_BYTES>();
    let mut corners = Vec::with_capacity(facets.len() * 3);
    for facet in facets {
        let (numbers, _) = facet[12..48].as_chunks::<4>();
        let (points, _) = numbers.as_chunks::<3>();
        corners.extend(
            points
                .iter()
                .map(|point| glam::Vec3::from_array(point.map(f32::from_le_bytes)).as_dvec3()),
        );
    }
    Ok(corners)
}

fn text(bytes: &[u8]) -> Result<Vec<DVec3>, Fault> {
    let mut corners = Vec::new();
    let mut in_facet = 0;
    let mut last = 0;
    for (index, line) in bytes.split(|&byte| byte == b'\n').enumerate() {
        last = index + 1;
        let fault = |reason: String| Fault::new(format!("line {last}"), reason);
        let line = String::from_utf8_lossy(line);
        let mut words = line.split_whitespace();
        match words.next().unwrap_or_default() {
            "vertex" => {
                let mut number = || -> Result<f64, Fault> {
                    let word = words.next().unwrap_or_default();
                    word.parse()
                        .map_err(|_error| fault(format!("{word:?} is no number")))
                };
                corners.push(DVec3::new(number()?, number()?, number()?));
                in_facet += 1;
            }
            "endfacet" => {
                if in_facet != 3 {
                    return Err(fault(format!("the facet has {in_facet} vertices, not 3")));
                }
                in_facet = 0;
            }
            _ => {}
        }
    }
    if in_facet != 0 {
        return Err(Fault::new(
            format!("line {last}"),
            "the file ends within a facet",
        ));
    }
    Ok(corners)
}

/// Makes one vertex of all corners at one place; vertices stand in the order in which they first appear.
fn merged(corners: Vec<DVec3>) -> Soup {
    let mut positions = Vec::new();
    let mut vertex_at: HashMap<[u64; 3], u32> = HashMap::new();
    let vertices: Vec<u32> = corners
        .into_iter()
        .map(|corner| {
            // Adding zero makes -0 a 0, which is the same place.
            let place = (corner + 0.0).to_array().map(f64::to_bits);
            *vertex_at.entry(place).or_insert_with(|| {
                positions.push(corner);
                (positions.len() - 1) as u32
            })
        })
        .collect();
    let (triangles, _) = vertices.as_chunks::<3>();
    Soup {
        positions,
        triangles: triangles.to_vec(),
        ..Soup::default()
    }
}
