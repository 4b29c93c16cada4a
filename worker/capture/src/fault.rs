//! Faults of a capture, and the errors of this crate.
//!
//! Preflight does not stop at the first fault: a registrar who submits a folder wants the whole list at once.

use std::fmt;
use std::path::PathBuf;

use serde::{Deserialize, Serialize};

/// How bad a fault is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Severity {
    /// The capture cannot be used.
    Error,
    /// The capture can be used; something in it was left out or is doubtful.
    Warning,
}

/// One thing that is wrong with a capture.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Fault {
    /// Whether it stops the import.
    pub severity: Severity,
    /// What is wrong: lowercase, no full stop.
    pub message: String,
    /// Where: a path inside the capture with the line (`sparse/0/cameras.txt:4`) or byte
    /// (`sparse/0/images.bin (byte 120)`), or a view's name.
    pub at: String,
    /// What to do about it.
    pub hint: String,
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} (at {}; hint: {})", self.message, self.at, self.hint)
    }
}

/// Errors of import and of loading views.
#[derive(Debug, thiserror::Error)]
pub enum ImportError {
    /// Preflight found faults; the list holds the warnings as well, errors first.
    #[error("{}", summary(.0))]
    Faults(Vec<Fault>),
    /// A view's photograph or mask could not be read or decoded.
    #[error("view {view}: cannot decode {}", path.display())]
    Image {
        /// Name of the view.
        view: String,
        /// The file.
        path: PathBuf,
        /// What the decoder says.
        #[source]
        source: crate::PhotoError,
    },
    /// A view index that the scene does not have.
    #[error("the scene has {views} views, there is no view {index}")]
    NoSuchView {
        /// The index asked for.
        index: usize,
        /// Number of views.
        views: usize,
    },
    /// A camera whose intrinsics no photograph can be resampled into.
    #[error("view {view}: cannot resample into this camera")]
    Camera {
        /// Name of the view.
        view: String,
        /// What is wrong with the camera.
        #[source]
        source: ign_geometry::CameraError,
    },
}

fn summary(faults: &[Fault]) -> String {
    let errors: Vec<&Fault> = faults
        .iter()
        .filter(|f| f.severity == Severity::Error)
        .collect();
    match errors.as_slice() {
        [] => "the capture has faults".into(),
        [only] => only.to_string(),
        [first, rest @ ..] => format!("{first}, and {} more faults", rest.len()),
    }
}

/// Collects faults while preflight goes on.
#[derive(Debug, Default)]
pub(crate) struct Faults {
    list: Vec<Fault>,
}

impl Faults {
    pub(crate) fn error(
        &mut self,
        message: impl Into<String>,
        at: impl Into<String>,
        hint: impl Into<String>,
    ) {
        self.push(Severity::Error, message.into(), at.into(), hint.into());
    }

    pub(crate) fn warning(
        &mut self,
        message: impl Into<String>,
        at: impl Into<String>,
        hint: impl Into<String>,
    ) {
        self.push(Severity::Warning, message.into(), at.into(), hint.into());
    }

    fn push(&mut self, severity: Severity, message: String, at: String, hint: String) {
        self.list.push(Fault {
            severity,
            message,
            at,
            hint,
        });
    }

    pub(crate) fn extend(&mut self, faults: impl IntoIterator<Item = Fault>) {
        self.list.extend(faults);
    }

    pub(crate) fn error_count(&self) -> usize {
        self.list
            .iter()
            .filter(|f| f.severity == Severity::Error)
            .count()
    }

    pub(crate) fn has_errors(&self) -> bool {
        self.list.iter().any(|f| f.severity == Severity::Error)
    }

    /// All faults, errors first; the order among equals stays.
    pub(crate) fn into_list(mut self) -> Vec<Fault> {
        self.list.sort_by_key(|f| f.severity == Severity::Warning);
        self.list
    }
}

/// An error with what caused it, in one line and without a full stop.
pub(crate) fn error_chain(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut source = error.source();
    while let Some(inner) = source {
        let inner_text = inner.to_string();
        if !text.contains(&inner_text) {
            text = format!("{text}: {inner_text}");
        }
        source = inner.source();
    }
    // Decoders end their messages with a full stop; ours go on behind them.
    text.trim_end_matches('.').to_owned()
}
