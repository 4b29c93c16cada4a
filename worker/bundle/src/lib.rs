//! The model bundle `ign.bundle/1`: pack, verify, read, score, report.
//!
//! A bundle is what a bake publishes and what a viewer renders from, alone: a folder of plain files (JSON, PNG, GLB,
//! safetensors, HTML) that `bundle.json` lists with their digests. Nothing in it is executable. This crate knows
//! the files; what the networks compute is `ign-nets`' business, how they are drawn `ign-render`'s.
//!
//! Invariants: `bundle.json` is written last; [`Bundle::open`] hands nothing out before every file has passed.

mod error;
pub mod manifest;
pub mod metrics;
pub mod pack;
mod paths;
pub mod proxy;
pub mod references;
pub mod report;
pub mod weights;

pub use error::BundleError;
pub use manifest::{Manifest, NetworkDescription};
pub use metrics::Metrics;
pub use pack::{Bundle, BundleWriter, folder_digest};
pub use paths::held_out_file;
pub use references::{HeldOutView, Reference};
pub use report::{CaptureLine, ReportInput, ReportView, render_report};
pub use weights::{Precision, Tensor, Tensors};

/// Name of the manifest inside a bundle.
pub const MANIFEST_FILE: &str = "bundle.json";
/// Name of the proxy mesh inside a bundle.
pub const PROXY_FILE: &str = "proxy.glb";
/// Name of the list of reference views inside a bundle.
pub const VIEWS_FILE: &str = "references/views.json";
/// Name of the held-out views' cameras inside a bundle.
pub const HELD_OUT_VIEWS_FILE: &str = "held_out/views.json";
/// Name of the metrics inside a bundle.
pub const METRICS_FILE: &str = "metrics.json";
/// Name of the report inside a bundle.
pub const REPORT_FILE: &str = "report.html";
/// Name of the small picture inside a bundle.
pub const THUMBNAIL_FILE: &str = "thumbnail.jpg";
/// Name of `EffectsNet`'s weights inside a bundle.
pub const EFFECTS_FILE: &str = "effects.safetensors";
/// Name of `CompositionNet`'s weights inside a bundle.
pub const COMPOSITION_FILE: &str = "composition.safetensors";
