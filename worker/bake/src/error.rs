//! Why a bake ended without a bundle, and what that means for the job.

use ign_bundle::BundleError;
use ign_capture::{ImportError, Severity};
use ign_events::{Failure, FailureKind};
use ign_nets::NetError;
use std::path::PathBuf;

/// Why a bake ended without a bundle.
#[derive(Debug, thiserror::Error)]
pub enum BakeError {
    /// The capture cannot be used.
    #[error("the capture cannot be used")]
    Import(#[from] ImportError),
    /// The recipe asks for something unknown or impossible.
    #[error("{message}")]
    Recipe {
        /// What is wrong with it.
        message: String,
        /// How to fix it.
        hint: String,
    },
    /// The capture is sound but too small or empty to train on.
    #[error("{message}")]
    Unusable {
        /// What is wrong with it.
        message: String,
        /// How to fix it.
        hint: String,
    },
    /// A weights tensor does not fit its network.
    #[error("the network's weights do not fit")]
    Net(#[from] NetError),
    /// A checkpoint cannot be written or read.
    #[error("checkpoint {path} cannot be used: {reason}")]
    Checkpoint {
        /// Where it lies.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// The bundle could not be written or did not verify.
    #[error("the bundle could not be packed")]
    Bundle(#[from] BundleError),
    /// The bundle cannot be rendered.
    #[error("the bundle cannot be rendered")]
    Render(#[from] ign_render::RenderError),
    /// A picture of the bundle could not be encoded or read.
    #[error("{file} cannot be encoded or read")]
    Picture {
        /// The bundle's file.
        file: &'static str,
        /// The codec's reason.
        #[source]
        source: image::ImageError,
    },
    /// The turntable preview could not be encoded.
    #[error("preview.webp cannot be encoded: {reason}")]
    Animation {
        /// The encoder's reason.
        reason: String,
    },
    /// A file could not be read or written.
    #[error("{path} cannot be written or read")]
    Io {
        /// Where it lies.
        path: PathBuf,
        /// The system's reason.
        #[source]
        source: std::io::Error,
    },
    /// Training produced values that are not finite and lowering the rate did not help.
    #[error("training of {stage} diverged at step {step}")]
    Diverged {
        /// Which network.
        stage: &'static str,
        /// After how many steps.
        step: u64,
    },
}

/// Names the file or folder of an input or output error.
pub(crate) fn io(path: &std::path::Path) -> impl FnOnce(std::io::Error) -> BakeError + use<> {
    let path = path.to_owned();
    move |source| BakeError::Io { path, source }
}

impl BakeError {
    /// What the job's owner is told, and whether it is tried again.
    pub fn failure(&self) -> Failure {
        let text = |kind, at: String, hint: String| Failure {
            kind,
            message: chain(self),
            at,
            hint,
        };
        match self {
            Self::Import(ImportError::Faults(faults)) => {
                let mut errors = faults
                    .iter()
                    .filter(|fault| fault.severity == Severity::Error);
                let Some(first) = errors.next() else {
                    return text(FailureKind::InvalidInput, String::new(), String::new());
                };
                let more = errors.count();
                let message = if more == 0 {
                    first.message.clone()
                } else {
                    format!("{} (and {more} more faults)", first.message)
                };
                Failure {
                    kind: FailureKind::InvalidInput,
                    message,
                    at: first.at.clone(),
                    hint: first.hint.clone(),
                }
            }
            Self::Import(_) => text(FailureKind::InvalidInput, String::new(), String::new()),
            Self::Recipe { message, hint } | Self::Unusable { message, hint } => Failure {
                kind: FailureKind::InvalidInput,
                message: message.clone(),
                at: String::new(),
                hint: hint.clone(),
            },
            Self::Io { path, .. } => text(
                FailureKind::Transient,
                path.display().to_string(),
                "check the worker's disk space and permissions".into(),
            ),
            Self::Net(_)
            | Self::Checkpoint { .. }
            | Self::Bundle(_)
            | Self::Render(_)
            | Self::Picture { .. }
            | Self::Animation { .. }
            | Self::Diverged { .. } => text(FailureKind::Crashed, String::new(), String::new()),
        }
    }
}

fn chain(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut source = error.source();
    while let Some(inner) = source {
        text = format!("{text}: {inner}");
        source = inner.source();
    }
    text
}
