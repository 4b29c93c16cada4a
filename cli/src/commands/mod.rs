//! The commands, one file per group.

pub(crate) mod admin;
pub(crate) mod bake;
pub(crate) mod bundle;
pub(crate) mod collections;
pub(crate) mod completions;
pub(crate) mod doctor;
pub(crate) mod jobs;
pub(crate) mod manifest;
pub(crate) mod preflight;
pub(crate) mod report;
pub(crate) mod status;
pub(crate) mod submit;
pub(crate) mod token;
pub(crate) mod up;
pub(crate) mod webhook;
pub(crate) mod worker;
