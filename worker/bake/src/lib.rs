//! One bake: a capture folder and a recipe in, a verified bundle folder out.
//!
//! Stages, in order: import the capture; plan (split off validation views, choose references, measure whether the
//! scene has view-dependent effects worth modelling); train `EffectsNet`; train `CompositionNet`; evaluate on the
//! held-out views through `ign-render`, the code that ships; pack. Each stage emits [`Event`]s; checkpoints make a
//! bake resume where it was.

mod checkpoint;
mod composition;
mod data;
mod effects;
mod error;
mod evaluate;
mod pack;
mod progress;
mod recipe;
mod run;
mod sampler;

pub use error::BakeError;
pub use recipe::{Preset, Recipe};
pub use run::{BakeJob, bake};

pub use ign_events::Event;
