//! `proxy.glb`: the proxy mesh in the normalised frame, readable by any glTF viewer.
//!
//! One primitive with f32 `POSITION` and `NORMAL`, optional `COLOR_0` (16-bit, linear as glTF asks, so that 8-bit sRGB
//! colours come back exactly) and u32 indices. `asset.extras.normalised_from_world` holds the f64 transform from the
//! capture's world. Format: glTF 2.0 section 4.4 (GLB). The reader accepts what this writer writes, checks every
//! offset, and keeps the stored normals: write then read is exact for f32.

use glam::DVec3;
use ign_geometry::{Mesh, Similarity};
use serde::Deserialize;
use serde_json::json;

use crate::manifest::WorldTransform;
use crate::{BundleError, PROXY_FILE};

const MAGIC: u32 = 0x4654_6C67;
const CHUNK_JSON: u32 = 0x4E4F_534A;
const CHUNK_BIN: u32 = 0x004E_4942;
const UNSIGNED_SHORT: u32 = 5123;
const UNSIGNED_INT: u32 = 5125;
const FLOAT: u32 = 5126;
const ARRAY_BUFFER: u32 = 34962;
const ELEMENT_ARRAY_BUFFER: u32 = 34963;

/// Encodes `mesh`, which is in the normalised frame.
pub fn encode(mesh: &Mesh, normalised_from_world: &Similarity) -> Result<Vec<u8>, BundleError> {
    let count = mesh.positions.len();
    if mesh.normals.len() != count || mesh.colors.as_ref().is_some_and(|c| c.len() != count) {
        return Err(BundleError::malformed(
            PROXY_FILE,
            "normals or colours do not match the vertices",
        ));
    }
    if count == 0 || mesh.triangles.is_empty() {
        return Err(BundleError::malformed(PROXY_FILE, "mesh without triangles"));
    }
    let positions: Vec<[f32; 3]> = mesh
        .positions
        .iter()
        .map(|p| p.as_vec3().to_array())
        .collect();
    let normals: Vec<[f32; 3]> = mesh
        .normals
        .iter()
        .map(|n| n.as_vec3().to_array())
        .collect();
    if !positions
        .iter()
        .chain(&normals)
        .flatten()
        .all(|v| v.is_finite())
    {
        return Err(BundleError::malformed(PROXY_FILE, "non-finite vertex"));
    }
    let bound = |pick: fn(f32, f32) -> f32| {
        positions
            .iter()
            .copied()
            .reduce(|a, b| [pick(a[0], b[0]), pick(a[1], b[1]), pick(a[2], b[2])])
    };

    let mut blob = Blob::default();
    let mut attributes = serde_json::Map::new();
    let vec3 = |v: &[[f32; 3]]| {
        v.iter()
            .flatten()
            .flat_map(|x| x.to_le_bytes())
            .collect::<Vec<u8>>()
    };
    let position = blob.add(&vec3(&positions), ARRAY_BUFFER, json!({
        "componentType": FLOAT, "count": count, "type": "VEC3", "min": bound(f32::min), "max": bound(f32::max),
    }));
    let normal = blob.add(
        &vec3(&normals),
        ARRAY_BUFFER,
        json!({
            "componentType": FLOAT, "count": count, "type": "VEC3",
        }),
    );
    attributes.insert("POSITION".into(), position.into());
    attributes.insert("NORMAL".into(), normal.into());
    if let Some(colors) = &mesh.colors {
        let bytes: Vec<u8> = colors
            .iter()
            .flat_map(|c| {
                [
                    linear_from_srgb(c[0]),
                    linear_from_srgb(c[1]),
                    linear_from_srgb(c[2]),
                    u16::MAX,
                ]
            })
            .flat_map(u16::to_le_bytes)
            .collect();
        let color = blob.add(
            &bytes,
            ARRAY_BUFFER,
            json!({
                "componentType": UNSIGNED_SHORT, "normalized": true, "count": count, "type": "VEC4",
            }),
        );
        attributes.insert("COLOR_0".into(), color.into());
    }
    let indices: Vec<u8> = mesh
        .triangles
        .iter()
        .flatten()
        .flat_map(|i| i.to_le_bytes())
        .collect();
    let indices = blob.add(
        &indices,
        ELEMENT_ARRAY_BUFFER,
        json!({
            "componentType": UNSIGNED_INT, "count": mesh.triangles.len() * 3, "type": "SCALAR",
        }),
    );

    let document = json!({
        "asset": {
            "version": "2.0",
            "generator": concat!("ign-bundle ", env!("CARGO_PKG_VERSION")),
            "extras": { "normalised_from_world": WorldTransform::from(*normalised_from_world) },
        },
        "scene": 0,
        "scenes": [{ "nodes": [0] }],
        "nodes": [{ "mesh": 0, "name": "proxy" }],
        "meshes": [{ "primitives": [{ "attributes": attributes, "indices": indices }] }],
        "accessors": blob.accessors,
        "bufferViews": blob.views,
        "buffers": [{ "byteLength": blob.bytes.len() }],
    });
    let mut json = serde_json::to_vec(&document).map_err(BundleError::json(PROXY_FILE))?;
    json.resize(json.len().next_multiple_of(4), b' ');

    let length = 12 + 8 + json.len() + 8 + blob.bytes.len();
    let too_large = |_: std::num::TryFromIntError| {
        BundleError::malformed(PROXY_FILE, "mesh of more than 4 GiB")
    };
    let mut out = Vec::with_capacity(length);
    for word in [MAGIC, 2, u32::try_from(length).map_err(too_large)?] {
        out.extend(word.to_le_bytes());
    }
    for (kind, chunk) in [(CHUNK_JSON, &json), (CHUNK_BIN, &blob.bytes)] {
        out.extend(u32::try_from(chunk.len()).map_err(too_large)?.to_le_bytes());
        out.extend(kind.to_le_bytes());
        out.extend(chunk);
    }
    Ok(out)
}

/// Decodes what [`encode`] wrote: the mesh in the normalised frame and the transform into it.
pub fn decode(bytes: &[u8]) -> Result<(Mesh, Similarity), BundleError> {
    let bad = |reason: &str| BundleError::malformed(PROXY_FILE, reason);
    let word =
        |at: usize| -> Option<u32> { Some(u32::from_le_bytes(*bytes.get(at..)?.first_chunk()?)) };
    if word(0) != Some(MAGIC)
        || word(4) != Some(2)
        || word(8).map(|n| n as usize) != Some(bytes.len())
    {
        return Err(bad("not a complete binary glTF 2.0 file"));
    }
    let chunk = |at: usize, kind: u32| -> Option<&[u8]> {
        (word(at + 4)? == kind).then_some(())?;
        bytes.get(at + 8..)?.get(..word(at)? as usize)
    };
    let json = chunk(12, CHUNK_JSON).ok_or_else(|| bad("no JSON chunk"))?;
    let blob = chunk(20 + json.len(), CHUNK_BIN).ok_or_else(|| bad("no binary chunk"))?;
    let document: Document = serde_json::from_slice(json).map_err(BundleError::json(PROXY_FILE))?;
    let primitive = match document.meshes.as_slice() {
        [mesh] if mesh.primitives.len() == 1 => &mesh.primitives[0],
        _ => return Err(bad("not exactly one mesh with one primitive")),
    };

    let data =
        |index: usize, component: u32, kind: &str, size: usize| -> Result<&[u8], BundleError> {
            let slice = || {
                let accessor = document.accessors.get(index)?;
                (accessor.component_type == component && accessor.kind == kind).then_some(())?;
                let view = document.buffer_views.get(accessor.buffer_view)?;
                let length = accessor.count.checked_mul(size)?;
                (length <= view.byte_length).then_some(())?;
                blob.get(view.byte_offset..)?.get(..length)
            };
            slice().ok_or_else(|| {
                bad(&format!(
                    "accessor {index} is not a packed {kind} inside the file"
                ))
            })
        };
    let vec3 = |index: usize| -> Result<Vec<DVec3>, BundleError> {
        let (floats, _) = data(index, FLOAT, "VEC3", 12)?.as_chunks::<4>();
        let values: Vec<DVec3> = floats
            .as_chunks::<3>()
            .0
            .iter()
            .map(|v| glam::Vec3::from_array(v.map(f32::from_le_bytes)).as_dvec3())
            .collect();
        if values.iter().all(|v| v.is_finite()) {
            Ok(values)
        } else {
            Err(bad("non-finite vertex"))
        }
    };
    let positions = vec3(primitive.attributes.position)?;
    let normals = vec3(primitive.attributes.normal)?;
    let colors = match primitive.attributes.color {
        None => None,
        Some(index) => {
            let (halves, _) = data(index, UNSIGNED_SHORT, "VEC4", 8)?.as_chunks::<2>();
            let decode = |b: [u8; 2]| srgb_from_linear(u16::from_le_bytes(b));
            Some(
                halves
                    .as_chunks::<4>()
                    .0
                    .iter()
                    .map(|c| [decode(c[0]), decode(c[1]), decode(c[2])])
                    .collect::<Vec<_>>(),
            )
        }
    };
    let (indices, _) = data(primitive.indices, UNSIGNED_INT, "SCALAR", 4)?.as_chunks::<4>();
    if !indices.len().is_multiple_of(3) {
        return Err(bad("indices are no whole triangles"));
    }
    let triangles: Vec<[u32; 3]> = indices
        .as_chunks::<3>()
        .0
        .iter()
        .map(|t| t.map(u32::from_le_bytes))
        .collect();
    if normals.len() != positions.len()
        || colors.as_ref().is_some_and(|c| c.len() != positions.len())
    {
        return Err(bad("normals or colours do not match the vertices"));
    }
    if triangles
        .iter()
        .flatten()
        .any(|&i| i as usize >= positions.len())
    {
        return Err(bad("a triangle names a vertex that does not exist"));
    }
    if triangles.is_empty() {
        return Err(bad("mesh without triangles"));
    }
    let transform = document.asset.extras.normalised_from_world;
    if !(transform.scale.is_finite()
        && transform.scale > 0.0
        && transform.translation.iter().all(|t| t.is_finite()))
    {
        return Err(bad("the world transform is not a similarity"));
    }
    Ok((
        Mesh {
            positions,
            normals,
            colors,
            triangles,
        },
        transform.into(),
    ))
}

#[derive(Default)]
struct Blob {
    bytes: Vec<u8>,
    views: Vec<serde_json::Value>,
    accessors: Vec<serde_json::Value>,
}

impl Blob {
    /// Appends `data`; `accessor` lacks its view. The accessor's index. Every element is a multiple of 4 bytes.
    fn add(&mut self, data: &[u8], target: u32, mut accessor: serde_json::Value) -> usize {
        self.views.push(json!({
            "buffer": 0, "byteOffset": self.bytes.len(), "byteLength": data.len(), "target": target,
        }));
        self.bytes.extend_from_slice(data);
        accessor["bufferView"] = (self.views.len() - 1).into();
        self.accessors.push(accessor);
        self.accessors.len() - 1
    }
}

/// sRGB transfer function, IEC 61966-2-1.
fn linear_from_srgb(value: u8) -> u16 {
    let v = f64::from(value) / 255.0;
    let linear = if v <= 0.04045 {
        v / 12.92
    } else {
        ((v + 0.055) / 1.055).powf(2.4)
    };
    (linear * 65535.0).round() as u16
}

fn srgb_from_linear(value: u16) -> u8 {
    let v = f64::from(value) / 65535.0;
    let srgb = if v <= 0.003_130_8 {
        v * 12.92
    } else {
        1.055 * v.powf(1.0 / 2.4) - 0.055
    };
    (srgb * 255.0).round() as u8
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Document {
    asset: Asset,
    meshes: Vec<MeshRecord>,
    accessors: Vec<Accessor>,
    buffer_views: Vec<BufferView>,
}

#[derive(Deserialize)]
struct Asset {
    extras: Extras,
}

#[derive(Deserialize)]
struct Extras {
    normalised_from_world: WorldTransform,
}

#[derive(Deserialize)]
struct MeshRecord {
    primitives: Vec<Primitive>,
}

#[derive(Deserialize)]
struct Primitive {
    attributes: Attributes,
    indices: usize,
}

#[derive(Deserialize)]
struct Attributes {
    #[serde(rename = "POSITION")]
    position: usize,
    #[serde(rename = "NORMAL")]
    normal: usize,
    #[serde(rename = "COLOR_0")]
    color: Option<usize>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Accessor {
    buffer_view: usize,
    component_type: u32,
    count: usize,
    #[serde(rename = "type")]
    kind: String,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct BufferView {
    #[serde(default)]
    byte_offset: usize,
    byte_length: usize,
}

#[cfg(test)]
mod tests {
    use super::{linear_from_srgb, srgb_from_linear};

    #[test]
    fn every_colour_survives_linear_storage() {
        for value in 0..=255 {
            assert_eq!(srgb_from_linear(linear_from_srgb(value)), value);
        }
    }
}
