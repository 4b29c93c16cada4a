//! `bundle.json`, schema `ign.bundle/1` (`DESIGN.md` section 6).
//!
//! Networks are described as data, so that a viewer needs no source code of ours to evaluate them; recipe, plan and
//! render settings are JSON that their owners (`ign-bake`, `ign-render`) define and this crate passes through.
//! Readers ignore fields they do not know: a new optional field is no new schema version.

use ign_geometry::Similarity;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::metrics::Metrics;
use crate::weights::Precision;

/// Schema name of `bundle.json`.
pub const SCHEMA: &str = "ign.bundle/1";

/// The whole of `bundle.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Manifest {
    /// [`SCHEMA`].
    pub schema: String,
    /// Whose bundle it is.
    pub object: ObjectName,
    /// The networks, as data.
    pub networks: Networks,
    /// `sha256:<hex>` of the capture manifest that was baked.
    pub capture: String,
    /// The recipe, as submitted.
    pub recipe: Value,
    /// What was tried, measured, kept, dropped, and why.
    pub plan: Value,
    /// Who made it, with what, when.
    pub provenance: Provenance,
    /// Every file but `bundle.json` itself, sorted by path. [`crate::BundleWriter::finish`] fills it.
    #[serde(default)]
    pub files: Vec<FileRecord>,
    /// The figures of `metrics.json` that listings show.
    pub metrics: MetricsSummary,
    /// From the capture's world to the normalised frame of proxy and cameras.
    pub normalised_from_world: WorldTransform,
    /// Of every image: `srgb`.
    pub colour_space: String,
    /// The exposure of references and renderings; absent in bundles from before there were gains: the photographs' own.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub canonical_exposure: Option<CanonicalExposure>,
    /// What the renderer needs beside the networks (K, coverage samples, ...); `ign-render` owns its content.
    pub render: Value,
}

/// The one exposure and white balance that references are stored in and views are rendered in. The photographs' own,
/// per view, are `exposure_gain` in `references/views.json` and `held_out/views.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct CanonicalExposure {
    /// Whether photographs were brought to it by gains; otherwise all gains are 1 and it is the photographs' own.
    pub equalised: bool,
    /// Smallest and largest gain of any view and channel, linear light.
    pub gain_range: [f32; 2],
}

/// Name of an object.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ObjectName {
    /// Museum or department.
    pub collection: String,
    /// Object within the collection.
    pub object: String,
}

/// The networks a viewer evaluates; both absent: plain image-based rendering was enough.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Networks {
    /// `EffectsNet`; absent when no view-dependent effects were found.
    pub effects: Option<NetworkDescription>,
    /// `CompositionNet`; absent when plain image-based rendering was enough.
    pub composition: Option<NetworkDescription>,
}

/// One network: a list of layers, each naming its inputs.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct NetworkDescription {
    /// Architecture's name, for people (`effects-paper`, `unet-blend`, ...).
    pub kind: String,
    /// Input channels in order.
    pub inputs: Vec<NetworkInput>,
    /// Layers in order of evaluation.
    pub layers: Vec<Layer>,
    /// What the last layer's output means (`rgb`, `signed_rgb`, `blend_weights`, ...).
    pub head: String,
    /// File of the weights, relative to the bundle.
    pub weights: String,
    /// How the weights are stored.
    pub dtype: Precision,
}

/// A group of input channels.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct NetworkInput {
    /// What the channels hold (`normal`, `reflection`, `warped_diffuse`, ...).
    pub name: String,
    /// How many channels.
    pub channels: u32,
}

/// One layer. Its tensors are `NAME.weight`, `NAME.bias` and so on in the weights file.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Layer {
    /// Prefix of the layer's tensors.
    pub name: String,
    /// `conv`, `conv_transpose`, `upsample_nearest`, `upsample_bilinear`, `concat`, ...
    pub op: String,
    /// Layers whose outputs are concatenated along channels as input; empty: the previous layer.
    /// `input` is the network's own input.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub from: Vec<String>,
    /// Input channels.
    #[serde(rename = "in")]
    pub in_channels: u32,
    /// Output channels.
    #[serde(rename = "out")]
    pub out_channels: u32,
    /// Kernel edge in pixels; 0 where the op has none.
    pub kernel: u32,
    /// Stride in pixels (the factor of an upsampling op).
    pub stride: u32,
    /// Padding in pixels on each side.
    #[serde(default)]
    pub padding: u32,
    /// `none`, `relu`, `leaky_relu:0.2`, `sigmoid`, `tanh`, ...
    pub activation: String,
    /// `none` (also when folded into the weights), `batch`, `channel`, ...
    pub norm: String,
}

/// Where a bundle comes from.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Provenance {
    /// Name and version of the program.
    pub software: String,
    /// Commit, when known.
    pub git: Option<String>,
    /// What it ran on, in words.
    pub device: String,
    /// Seeds of every random choice.
    pub seeds: Vec<u64>,
    /// RFC 3339, UTC.
    pub started_at: String,
    /// RFC 3339, UTC.
    pub finished_at: String,
    /// Seconds per stage, in order.
    pub stages: Vec<StageSeconds>,
}

/// How long a stage took.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct StageSeconds {
    /// `import`, `plan`, `effects`, `composition`, `evaluate`, `pack`, ...
    pub name: String,
    /// Wall-clock seconds.
    pub secs: f64,
}

/// A file of the bundle.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct FileRecord {
    /// Relative path with `/`.
    pub path: String,
    /// Lowercase hex.
    pub sha256: String,
    /// Bytes.
    pub size_bytes: u64,
}

/// The figures of `metrics.json` that listings show.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct MetricsSummary {
    /// One per method that ran.
    pub methods: Vec<MethodSummary>,
    /// View with the highest error of ours.
    pub worst_view: Option<String>,
}

/// One method's figures over all held-out views.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct MethodSummary {
    /// As in `metrics.json`.
    pub name: String,
    /// On [0, 255], full frame.
    pub mse: f64,
    /// On [0, 255], over the object.
    pub mse_object: f64,
    /// dB, full frame.
    pub psnr: f64,
}

impl From<&Metrics> for MetricsSummary {
    fn from(metrics: &Metrics) -> Self {
        Self {
            methods: metrics
                .methods
                .iter()
                .map(|m| MethodSummary {
                    name: m.name.clone(),
                    mse: m.mse,
                    mse_object: m.mse_object,
                    psnr: m.psnr,
                })
                .collect(),
            worst_view: metrics.method("ours").map(|m| m.worst_view.name.clone()),
        }
    }
}

/// `p_normalised = (p_world - translation) * scale`, f64.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct WorldTransform {
    /// Normalised units per world unit.
    pub scale: f64,
    /// Centre of the object's bounding sphere, world units.
    pub translation: [f64; 3],
}

impl From<Similarity> for WorldTransform {
    fn from(similarity: Similarity) -> Self {
        Self {
            scale: similarity.scale,
            translation: similarity.translation.to_array(),
        }
    }
}

impl From<WorldTransform> for Similarity {
    fn from(transform: WorldTransform) -> Self {
        Self {
            scale: transform.scale,
            translation: transform.translation.into(),
        }
    }
}
