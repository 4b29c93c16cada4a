//! glTF 2.0, as text (`.gltf`) and binary (`.glb`): every mesh of the default scene at its place.
//!
//! Read: node hierarchies with matrices or translation, rotation and scale; triangles, strips and fans; indices of 8,
//! 16 and 32 bits or none; sparse accessors; quantised attributes (`KHR_mesh_quantization`); `COLOR_0`, which is
//! linear in glTF and becomes sRGB here; buffers in the file, in data URIs and in files beside it. Not read: textures,
//! skins, morph targets. Compressed geometry (Draco, meshopt) is refused with the way out.
//!
//! The documents are deserialised here rather than by the `gltf` crate because that one keeps transforms in f32, too
//! coarse for georeferenced scans, and trusts the offsets of accessors.

use std::borrow::Cow;
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use glam::{DMat4, DQuat, DVec3};
use serde::Deserialize;

use super::{Fault, OpenBeside, Soup, stays_inside};

const CHUNK_JSON: u32 = 0x4E4F_534A;
const CHUNK_BIN: u32 = 0x004E_4942;
/// Vertices and triangles that even the smallest file may ask for by showing a mesh many times.
const LEAST_LIMIT: usize = 1 << 16;

/// Extensions that change where the geometry is: `(name, what it does, how to undo it)`.
const COMPRESSIONS: [(&str, &str); 3] = [
    ("KHR_draco_mesh_compression", "Draco"),
    ("EXT_meshopt_compression", "meshopt"),
    ("KHR_meshopt_compression", "meshopt"),
];

pub(super) fn parse_binary(bytes: &[u8], open: &OpenBeside<'_>) -> Result<Soup, Fault> {
    let fault = |at: usize, reason: &str| Fault::new(format!("byte {at}"), reason);
    let word =
        |at: usize| -> Option<u32> { Some(u32::from_le_bytes(*bytes.get(at..)?.first_chunk()?)) };
    match word(4) {
        Some(2) => {}
        Some(version) => {
            return Err(fault(
                4,
                &format!("binary glTF of version {version}, expected 2"),
            ));
        }
        None => return Err(fault(bytes.len(), "the file ends within its header")),
    }
    let chunk = |at: usize, kind: u32| -> Result<Option<&[u8]>, Fault> {
        let (Some(length), Some(found)) = (word(at), word(at + 4)) else {
            return Ok(None);
        };
        if found != kind {
            return Ok(None);
        }
        match bytes[at + 8..].get(..length as usize) {
            Some(chunk) => Ok(Some(chunk)),
            None => Err(fault(
                bytes.len(),
                &format!(
                    "the file ends here, its chunk has {length} bytes from byte {}",
                    at + 8
                ),
            )),
        }
    };
    let json = chunk(12, CHUNK_JSON)?.ok_or_else(|| fault(12, "no JSON chunk"))?;
    let blob = chunk(20 + json.len(), CHUNK_BIN)?;
    parse(json, blob, bytes.len(), open)
}

pub(super) fn parse_text(bytes: &[u8], open: &OpenBeside<'_>) -> Result<Soup, Fault> {
    parse(bytes, None, bytes.len(), open)
}

fn parse(
    json: &[u8],
    blob: Option<&[u8]>,
    file_bytes: usize,
    open: &OpenBeside<'_>,
) -> Result<Soup, Fault> {
    let json = json.strip_prefix(b"\xef\xbb\xbf").unwrap_or(json);
    let document: Document = serde_json::from_slice(json)
        .map_err(|error| Fault::new(format!("line {}", error.line()), error.to_string()))?;
    if !document.asset.version.starts_with("2.") {
        let reason = format!("glTF of version {:?}, expected 2.0", document.asset.version);
        return Err(Fault::new("asset", reason));
    }
    for (extension, name) in COMPRESSIONS {
        if document
            .extensions_required
            .iter()
            .any(|required| required == extension)
        {
            return Err(Fault::new(
                "extensionsRequired",
                format!(
                    "the geometry is compressed with {name}; export it again without compression, \
                     for example with: gltf-transform copy IN.glb OUT.glb"
                ),
            ));
        }
    }
    let mut buffers = Vec::new();
    let mut total = file_bytes;
    for (index, buffer) in document.buffers.iter().enumerate() {
        let data = buffer_data(index, buffer, blob, open)?;
        if !matches!(data, Cow::Borrowed(_)) {
            total = total.saturating_add(data.len());
        }
        buffers.push(data);
    }
    let mut reader = Reader {
        document: &document,
        buffers,
        limit: total.max(LEAST_LIMIT),
        soup: Soup::default(),
        normals: Vec::new(),
        colors: Vec::new(),
    };
    reader.scene()?;
    let Reader {
        mut soup,
        normals,
        colors,
        ..
    } = reader;
    soup.normals = normals
        .iter()
        .any(|normal| *normal != DVec3::ZERO)
        .then_some(normals);
    soup.colors = colors.into_iter().collect();
    Ok(soup)
}

/// The bytes of a buffer: the binary chunk, a data URI, or a file beside this one.
fn buffer_data<'a>(
    index: usize,
    buffer: &Buffer,
    blob: Option<&'a [u8]>,
    open: &OpenBeside<'_>,
) -> Result<Cow<'a, [u8]>, Fault> {
    let fault = |reason: String| Fault::new(format!("buffer {index}"), reason);
    let data = match &buffer.uri {
        None => Cow::Borrowed(
            blob.filter(|_| index == 0)
                .ok_or_else(|| fault("has neither a URI nor a binary chunk".into()))?,
        ),
        Some(uri) if uri.starts_with("data:") => {
            let encoded = uri
                .split_once(";base64,")
                .ok_or_else(|| fault("its data URI is not base64".into()))?
                .1;
            let decoded = STANDARD
                .decode(encoded)
                .map_err(|error| fault(format!("its data URI is no base64: {error}")))?;
            Cow::Owned(decoded)
        }
        Some(uri) => {
            let name = percent_encoding::percent_decode_str(uri).decode_utf8_lossy();
            let path = Path::new(name.as_ref());
            if name.contains("://") || name.contains('\\') || !stays_inside(path) {
                return Err(fault(format!(
                    "{uri:?} is no file in the mesh's own folder; pack everything into one .glb"
                )));
            }
            let read = open(path).map_err(|error| {
                fault(format!(
                    "cannot read {uri:?}: {error}; put it beside the mesh or pack everything into one .glb"
                ))
            })?;
            Cow::Owned(read)
        }
    };
    if data.len() < buffer.byte_length {
        return Err(fault(format!(
            "has {} bytes, expected {}",
            data.len(),
            buffer.byte_length
        )));
    }
    Ok(data)
}

struct Reader<'a> {
    document: &'a Document,
    buffers: Vec<Cow<'a, [u8]>>,
    /// Most vertices, and most triangles, that may come out.
    limit: usize,
    soup: Soup,
    /// One per vertex; zero where its primitive has none.
    normals: Vec<DVec3>,
    /// One per vertex; none where its primitive has none.
    colors: Vec<Option<[u8; 3]>>,
}

impl Reader<'_> {
    /// All nodes below the default scene's, or all roots where the file has no scene.
    fn scene(&mut self) -> Result<(), Fault> {
        let document = self.document;
        let roots: Vec<usize> =
            if let Some(scene) = document.scenes.get(document.scene.unwrap_or(0)) {
                scene.nodes.clone()
            } else {
                let children: BTreeSet<usize> = document
                    .nodes
                    .iter()
                    .flat_map(|node| node.children.iter().copied())
                    .collect();
                (0..document.nodes.len())
                    .filter(|node| !children.contains(node))
                    .collect()
            };
        // A node has one parent, so a second visit means a loop or a broken tree.
        let mut visited = vec![false; document.nodes.len()];
        let mut open: Vec<(usize, DMat4)> = roots
            .into_iter()
            .rev()
            .map(|node| (node, DMat4::IDENTITY))
            .collect();
        while let Some((index, world_from_parent)) = open.pop() {
            let fault = |reason: &str| Fault::new(format!("node {index}"), reason);
            let node = document
                .nodes
                .get(index)
                .ok_or_else(|| fault("does not exist"))?;
            if std::mem::replace(&mut visited[index], true) {
                return Err(fault("has two parents, or is its own descendant"));
            }
            let world_from_node = world_from_parent * node.matrix();
            if let Some(mesh) = node.mesh {
                let mesh = document
                    .meshes
                    .get(mesh)
                    .ok_or_else(|| fault("names a mesh that does not exist"))?;
                for primitive in &mesh.primitives {
                    self.primitive(primitive, world_from_node)?;
                }
            }
            open.extend(
                node.children
                    .iter()
                    .rev()
                    .map(|&child| (child, world_from_node)),
            );
        }
        Ok(())
    }

    fn primitive(&mut self, primitive: &Primitive, world_from_node: DMat4) -> Result<(), Fault> {
        // Points and lines have no surface.
        if !(4..=6).contains(&primitive.mode) {
            return Ok(());
        }
        for (extension, name) in COMPRESSIONS {
            if primitive.extensions.contains_key(extension)
                && !primitive.attributes.contains_key("POSITION")
            {
                return Err(Fault::new(
                    "primitive",
                    format!(
                        "the geometry is compressed with {name}; export it again without compression"
                    ),
                ));
            }
        }
        let Some(&position) = primitive.attributes.get("POSITION") else {
            return Ok(());
        };
        let first = self.soup.positions.len();
        let positions = self.numbers::<3>(position)?;
        self.check_limit(first + positions.len())?;
        for position in &positions {
            self.soup
                .positions
                .push(world_from_node.transform_point3(DVec3::from_array(*position)));
        }
        let last = self.soup.positions.len();

        if let Some(&normal) = primitive.attributes.get("NORMAL") {
            let normals = self.numbers::<3>(normal)?;
            // Normals go with the inverse transpose; a mirroring node turns the winding, not the outside.
            let turn = glam::DMat3::from_mat4(world_from_node)
                .inverse()
                .transpose();
            self.normals
                .extend(normals.iter().take(last - first).map(|normal| {
                    let turned = turn * DVec3::from_array(*normal);
                    if turned.is_finite() {
                        turned
                    } else {
                        DVec3::ZERO
                    }
                }));
        }
        self.normals.resize(last, DVec3::ZERO);
        if let Some(&color) = primitive.attributes.get("COLOR_0") {
            let colors = self.numbers::<3>(color)?;
            self.colors.extend(
                colors
                    .iter()
                    .take(last - first)
                    .map(|color| Some(color.map(srgb_byte))),
            );
        }
        self.colors.resize(last, None);

        let indices: Vec<u32> = match primitive.indices {
            Some(accessor) => self
                .numbers::<1>(accessor)?
                .iter()
                .map(|[index]| *index as u32)
                .collect(),
            None => (0..positions.len() as u32).collect(),
        };
        if let Some(index) = indices
            .iter()
            .find(|index| **index as usize >= positions.len())
        {
            return Err(Fault::new(
                format!("accessor {}", primitive.indices.unwrap_or(position)),
                format!(
                    "names vertex {index}, but there are {} vertices",
                    positions.len()
                ),
            ));
        }
        let mirrored = world_from_node.determinant() < 0.0;
        let corner = |at: usize| first as u32 + indices[at];
        let count = match primitive.mode {
            4 => indices.len() / 3,
            _ => indices.len().saturating_sub(2),
        };
        self.check_limit(self.soup.triangles.len() + count)?;
        for at in 0..count {
            let mut triangle = match primitive.mode {
                4 => [corner(3 * at), corner(3 * at + 1), corner(3 * at + 2)],
                // Every other triangle of a strip turns the other way round.
                5 => [corner(at), corner(at + 1 + at % 2), corner(at + 2 - at % 2)],
                _ => [corner(0), corner(at + 1), corner(at + 2)],
            };
            if mirrored {
                triangle.swap(1, 2);
            }
            self.soup.triangles.push(triangle);
        }
        Ok(())
    }

    fn check_limit(&self, count: usize) -> Result<(), Fault> {
        if count <= self.limit {
            return Ok(());
        }
        Err(Fault::new(
            "scene",
            format!(
                "shows its meshes so often that more than {} vertices or triangles come out; \
                 apply the instances or export only the object",
                self.limit
            ),
        ))
    }

    /// The first `N` components of each element of an accessor, normalised where the accessor says so.
    fn numbers<const N: usize>(&self, index: usize) -> Result<Vec<[f64; N]>, Fault> {
        let fault = |reason: String| Fault::new(format!("accessor {index}"), reason);
        let accessor = self
            .document
            .accessors
            .get(index)
            .ok_or_else(|| fault("does not exist".into()))?;
        let components = match accessor.kind.as_str() {
            "SCALAR" => 1,
            "VEC2" => 2,
            "VEC3" => 3,
            "VEC4" => 4,
            other => return Err(fault(format!("has type {other:?}, expected a vector"))),
        };
        if components < N {
            return Err(fault(format!("has {components} components, expected {N}")));
        }
        let component = Component::of(accessor.component_type).ok_or_else(|| {
            fault(format!(
                "has unknown component type {}",
                accessor.component_type
            ))
        })?;
        let element = |bytes: &[u8]| {
            let mut numbers = [0.0; N];
            for (at, number) in numbers.iter_mut().enumerate() {
                *number = component.read(&bytes[at * component.bytes()..], accessor.normalized);
            }
            numbers
        };
        let size = components * component.bytes();
        let mut values = match accessor.buffer_view {
            Some(view) => {
                let (bytes, stride) = self
                    .elements(view, accessor.byte_offset, accessor.count, size)
                    .map_err(fault)?;
                (0..accessor.count)
                    .map(|at| element(&bytes[at * stride..]))
                    .collect()
            }
            None if accessor.count <= self.limit => vec![[0.0; N]; accessor.count],
            None => {
                return Err(fault(format!(
                    "has no data for {} elements",
                    accessor.count
                )));
            }
        };
        if let Some(sparse) = &accessor.sparse {
            let index_component = Component::of(sparse.indices.component_type)
                .ok_or_else(|| fault("its sparse indices have an unknown type".into()))?;
            let places = self
                .elements(
                    sparse.indices.buffer_view,
                    sparse.indices.byte_offset,
                    sparse.count,
                    index_component.bytes(),
                )
                .map_err(fault)?;
            let replacements = self
                .elements(
                    sparse.values.buffer_view,
                    sparse.values.byte_offset,
                    sparse.count,
                    size,
                )
                .map_err(fault)?;
            for at in 0..sparse.count {
                let place = index_component.read(&places.0[at * places.1..], false) as usize;
                *values.get_mut(place).ok_or_else(|| {
                    fault(format!("replaces element {place}, which does not exist"))
                })? = element(&replacements.0[at * replacements.1..]);
            }
        }
        Ok(values)
    }

    /// The bytes from the first of `count` elements of `size` bytes on, and the distance between elements.
    fn elements(
        &self,
        view: usize,
        offset: usize,
        count: usize,
        size: usize,
    ) -> Result<(&[u8], usize), String> {
        let view = self
            .document
            .buffer_views
            .get(view)
            .ok_or_else(|| format!("names buffer view {view}, which does not exist"))?;
        if view.extensions.keys().any(|name| name.contains("meshopt")) {
            return Err(
                "the geometry is compressed with meshopt; export it again without compression"
                    .into(),
            );
        }
        let stride = view.byte_stride.unwrap_or(size).max(size);
        let slice = || {
            let data = self.buffers.get(view.buffer)?;
            let data = data.get(view.byte_offset..)?.get(..view.byte_length)?;
            let data = data.get(offset..)?;
            let needed = match count {
                0 => 0,
                _ => (count - 1).checked_mul(stride)?.checked_add(size)?,
            };
            (needed <= data.len()).then_some(data)
        };
        slice()
            .map(|data| (data, stride))
            .ok_or_else(|| "reaches beyond its buffer".into())
    }
}

#[derive(Clone, Copy)]
enum Component {
    I8,
    U8,
    I16,
    U16,
    U32,
    F32,
}

impl Component {
    fn of(code: u32) -> Option<Self> {
        Some(match code {
            5120 => Self::I8,
            5121 => Self::U8,
            5122 => Self::I16,
            5123 => Self::U16,
            5125 => Self::U32,
            5126 => Self::F32,
            _ => return None,
        })
    }

    fn bytes(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::U32 | Self::F32 => 4,
        }
    }

    /// The number at the start of `bytes`, which are enough; glTF 2.0, section 3.11 for normalised ones.
    fn read(self, bytes: &[u8], normalized: bool) -> f64 {
        let (number, largest) = match self {
            Self::I8 => (f64::from(bytes[0] as i8), 127.0),
            Self::U8 => (f64::from(bytes[0]), 255.0),
            Self::I16 => (f64::from(i16::from_le_bytes([bytes[0], bytes[1]])), 32767.0),
            Self::U16 => (f64::from(u16::from_le_bytes([bytes[0], bytes[1]])), 65535.0),
            Self::U32 => {
                let word = [bytes[0], bytes[1], bytes[2], bytes[3]];
                (f64::from(u32::from_le_bytes(word)), f64::from(u32::MAX))
            }
            Self::F32 => {
                let word = [bytes[0], bytes[1], bytes[2], bytes[3]];
                return f64::from(f32::from_le_bytes(word));
            }
        };
        if normalized {
            (number / largest).max(-1.0)
        } else {
            number
        }
    }
}

/// A linear colour channel in [0, 1] as an sRGB byte (IEC 61966-2-1).
fn srgb_byte(linear: f64) -> u8 {
    let encoded = if linear <= 0.003_130_8 {
        linear * 12.92
    } else {
        1.055 * linear.powf(1.0 / 2.4) - 0.055
    };
    (encoded * 255.0).round() as u8
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Document {
    asset: Asset,
    #[serde(default)]
    extensions_required: Vec<String>,
    scene: Option<usize>,
    #[serde(default)]
    scenes: Vec<Scene>,
    #[serde(default)]
    nodes: Vec<Node>,
    #[serde(default)]
    meshes: Vec<MeshRecord>,
    #[serde(default)]
    accessors: Vec<Accessor>,
    #[serde(default)]
    buffer_views: Vec<BufferView>,
    #[serde(default)]
    buffers: Vec<Buffer>,
}

#[derive(Deserialize)]
struct Asset {
    version: String,
}

#[derive(Deserialize)]
struct Scene {
    #[serde(default)]
    nodes: Vec<usize>,
}

#[derive(Deserialize)]
struct Node {
    mesh: Option<usize>,
    #[serde(default)]
    children: Vec<usize>,
    matrix: Option<[f64; 16]>,
    translation: Option<[f64; 3]>,
    rotation: Option<[f64; 4]>,
    scale: Option<[f64; 3]>,
}

impl Node {
    fn matrix(&self) -> DMat4 {
        if let Some(matrix) = &self.matrix {
            return DMat4::from_cols_array(matrix);
        }
        let rotation = self.rotation.map_or(DQuat::IDENTITY, DQuat::from_array);
        DMat4::from_scale_rotation_translation(
            self.scale.map_or(DVec3::ONE, DVec3::from_array),
            if rotation.length_squared() > 0.0 {
                rotation.normalize()
            } else {
                DQuat::IDENTITY
            },
            self.translation.map_or(DVec3::ZERO, DVec3::from_array),
        )
    }
}

#[derive(Deserialize)]
struct MeshRecord {
    primitives: Vec<Primitive>,
}

#[derive(Deserialize)]
struct Primitive {
    attributes: BTreeMap<String, usize>,
    indices: Option<usize>,
    #[serde(default = "triangles")]
    mode: u32,
    #[serde(default)]
    extensions: serde_json::Map<String, serde_json::Value>,
}

/// The mode of a primitive that names none.
fn triangles() -> u32 {
    4
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Accessor {
    buffer_view: Option<usize>,
    #[serde(default)]
    byte_offset: usize,
    component_type: u32,
    #[serde(default)]
    normalized: bool,
    count: usize,
    #[serde(rename = "type")]
    kind: String,
    sparse: Option<Sparse>,
}

#[derive(Deserialize)]
struct Sparse {
    count: usize,
    indices: SparseIndices,
    values: SparseValues,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct SparseIndices {
    buffer_view: usize,
    #[serde(default)]
    byte_offset: usize,
    component_type: u32,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct SparseValues {
    buffer_view: usize,
    #[serde(default)]
    byte_offset: usize,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct BufferView {
    buffer: usize,
    #[serde(default)]
    byte_offset: usize,
    byte_length: usize,
    byte_stride: Option<usize>,
    #[serde(default)]
    extensions: serde_json::Map<String, serde_json::Value>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Buffer {
    byte_length: usize,
    uri: Option<String>,
}
