//! Typed events from a bake to whoever watches it.
//!
//! A bake (`ign-bake`) emits [`Event`]s; `ign-worker exec` writes each as one JSON line on stdout; the agent
//! (`ign-agent`) reads them, forwards progress and logs, and uploads checkpoints and results. Both sides of that
//! pipe use this crate, so its serde form is the contract between them.

mod job;

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

pub use job::{JobFile, ObjectName};

/// One line from a bake.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "event", rename_all = "snake_case")]
pub enum Event {
    /// How far the whole bake is.
    Progress(Progress),
    /// A line for the job's log.
    Log {
        /// Severity.
        level: Level,
        /// One sentence, lowercase, no full stop.
        message: String,
    },
    /// A checkpoint file was written and closed; training can resume from it.
    Checkpoint {
        /// Absolute path of the file; it is not changed afterwards.
        path: PathBuf,
    },
    /// The bake ended well.
    Done {
        /// Folder that holds the bundle's files.
        bundle: PathBuf,
    },
    /// The bake ended without a result.
    Failed(Failure),
}

impl Event {
    /// The event as one line of JSON, without the line break.
    ///
    /// # Errors
    /// A path in the event is not Unicode.
    pub fn to_line(&self) -> serde_json::Result<String> {
        serde_json::to_string(self)
    }

    /// Reads one line of a child's stdout; `None` when it is something else that was printed there.
    pub fn from_line(line: &str) -> Option<Self> {
        serde_json::from_str(line).ok()
    }
}

/// How far a bake is.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Progress {
    /// `import`, `plan`, `effects`, `composition`, `comparison`, `evaluate` or `pack`.
    pub stage: String,
    /// Of the whole bake, 0 to 100.
    pub percent: f64,
    /// Seconds left, when known.
    pub eta_secs: Option<f64>,
    /// Current validation error (full-frame MSE on [0, 255]), where the stage has one.
    pub error: Option<f64>,
    /// What is being done, for people.
    pub message: String,
}

/// Severity of a log line.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Level {
    /// Ordinary.
    Info,
    /// Something the user should look at.
    Warn,
    /// Something that ended the attempt.
    Error,
}

/// Why a bake ended without a result.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Failure {
    /// Decides whether it is tried again.
    pub kind: FailureKind,
    /// What, lowercase, no full stop.
    pub message: String,
    /// Where: file and line, or the view's name; may be empty.
    #[serde(default)]
    pub at: String,
    /// How to fix it; may be empty.
    #[serde(default)]
    pub hint: String,
}

/// Class of a failure; decides whether the job is tried again.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum FailureKind {
    /// May go away by itself: network, store, full disk. Retried.
    Transient,
    /// The capture or recipe is wrong. Not retried.
    InvalidInput,
    /// Panic, abort or out of memory. Retried.
    Crashed,
    /// Stopped on request.
    Cancelled,
}

impl std::fmt::Display for Failure {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.message)?;
        if !self.at.is_empty() {
            write!(f, " (at {})", self.at)?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_keep_their_form() {
        let event = Event::Checkpoint {
            path: PathBuf::from("/w/c.bin"),
        };
        let line = event.to_line().unwrap();
        assert_eq!(line, r#"{"event":"checkpoint","path":"/w/c.bin"}"#);
        assert_eq!(Event::from_line(&line), Some(event));
        let failed = r#"{"event":"failed","kind":"invalid_input","message":"camera 3 has zero focal length"}"#;
        let Some(Event::Failed(failure)) = Event::from_line(failed) else {
            panic!("not read: {failed}")
        };
        assert_eq!(failure.kind, FailureKind::InvalidInput);
        assert_eq!(failure.at, "");
    }

    #[test]
    fn other_output_is_no_event() {
        for line in ["", "Epoch 3", "{}", r#"{"event":"sing"}"#, "{\"event\":"] {
            assert_eq!(Event::from_line(line), None, "{line}");
        }
    }

    #[test]
    fn nan_in_progress_survives_as_unknown() {
        let line = Event::Progress(Progress {
            stage: "plan".into(),
            percent: 1.0,
            eta_secs: None,
            error: Some(f64::NAN),
            message: String::new(),
        })
        .to_line()
        .unwrap();
        let Some(Event::Progress(progress)) = Event::from_line(&line) else {
            panic!("not read: {line}")
        };
        assert_eq!(progress.error, None);
    }
}
