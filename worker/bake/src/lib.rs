//! One bake: a capture folder and a recipe in, a verified bundle folder out.
//!
//! Stages, in order: import the capture; plan (split off validation views, choose references, measure whether the
//! scene has view-dependent effects worth modelling); train `EffectsNet`; train `CompositionNet`; evaluate on the
//! held-out views through `ign-render`, the code that ships; pack. Each stage emits [`Event`]s; checkpoints make a
//! bake resume where it was.

mod checkpoint;
mod compare;
mod composition;
mod data;
mod divergence;
mod effects;
mod error;
mod evaluate;
pub mod experiment;
#[doc(hidden)]
pub mod fuzz;
mod pack;
mod plan;
mod pretrain;
mod progress;
mod recipe;
mod run;
mod sampler;
mod schedule;
mod training;
mod views;

pub use error::BakeError;
pub(crate) use error::io;
pub use pretrain::{PretrainJob, pretrain};
pub use recipe::{Crop, Method, Preset, Recipe};
pub use run::{BakeJob, bake};

pub use ign_events::Event;
