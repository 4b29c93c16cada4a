//! What can go wrong, and how each cause is reported as the failure of a job.

use std::path::PathBuf;

use ign_events::{Failure, FailureKind};

/// Ends the agent. Everything that concerns one job alone is a [`Failure`] of that job instead.
#[derive(Debug, thiserror::Error)]
pub enum AgentError {
    /// The coordinator's address is not usable.
    #[error("server address {url} is not usable: {reason}")]
    Server {
        /// As given.
        url: String,
        /// Why.
        reason: String,
    },
    /// The token cannot be a header value.
    #[error("the token holds characters that a header cannot carry")]
    Token,
    /// The certificates are absent or unusable.
    #[error("cannot use the certificates")]
    Certificates {
        /// What is wrong.
        #[source]
        source: ign_client::Error,
    },
    /// The given name of this worker breaks the rules for names.
    #[error("the worker's name is not usable")]
    Name {
        /// Which rule.
        #[source]
        source: ign_proto::IdError,
    },
    /// The coordinator does not accept our token.
    #[error("the coordinator refuses this worker: {message}")]
    Refused {
        /// What it said.
        message: String,
    },
    /// The work folder cannot be prepared.
    #[error("cannot use the work folder {path}")]
    WorkDir {
        /// The folder.
        path: PathBuf,
        /// Why.
        #[source]
        source: std::io::Error,
    },
    /// Two agents would delete each other's files.
    #[error("the work folder {path} is in use by another agent")]
    WorkDirInUse {
        /// The folder.
        path: PathBuf,
    },
}

/// A file or a manifest could not be moved between the data plane and this machine.
#[derive(Debug, thiserror::Error)]
pub(crate) enum TransferError {
    #[error("no space left in {dir}")]
    DiskFull { dir: PathBuf },
    #[error("{what} is not in the registry")]
    Missing { what: String },
    #[error("{what} arrived damaged: {reason}")]
    Damaged { what: String, reason: String },
    #[error("the capture manifest {digest} is not usable: {reason}")]
    Manifest { digest: String, reason: String },
    #[error("the data plane refused {what} with status {status}: {body}")]
    Refused {
        what: String,
        status: u16,
        body: String,
    },
    #[error("the data plane did not serve {what}: {reason}")]
    Unavailable { what: String, reason: String },
    #[error("cannot {action} {path}")]
    File {
        action: &'static str,
        path: PathBuf,
        #[source]
        source: std::io::Error,
    },
}

impl TransferError {
    /// A file operation failed; a full disk is told apart from the rest.
    pub(crate) fn file(
        action: &'static str,
        path: &std::path::Path,
        source: std::io::Error,
    ) -> Self {
        use std::io::ErrorKind;
        if matches!(
            source.kind(),
            ErrorKind::StorageFull | ErrorKind::QuotaExceeded
        ) {
            let dir = path.parent().unwrap_or(path).to_path_buf();
            return Self::DiskFull { dir };
        }
        Self::File {
            action,
            path: path.to_path_buf(),
            source,
        }
    }

    /// Another try may go well without anybody doing anything.
    pub(crate) fn is_passing(&self) -> bool {
        matches!(self, Self::Unavailable { .. } | Self::Damaged { .. })
    }

    /// How the job's owner is told.
    pub(crate) fn failure(&self) -> Failure {
        let (kind, hint) = match self {
            Self::DiskFull { .. } => (
                FailureKind::Transient,
                "free space in the worker's work folder, or give it a larger disk",
            ),
            Self::Missing { .. } => (FailureKind::InvalidInput, "submit the capture again"),
            Self::Manifest { .. } => (
                FailureKind::InvalidInput,
                "submit the capture again with this version of ignctl",
            ),
            Self::Refused {
                status: 401 | 403, ..
            } => (FailureKind::Transient, "check the worker's token"),
            Self::Damaged { .. }
            | Self::Refused { .. }
            | Self::Unavailable { .. }
            | Self::File { .. } => (FailureKind::Transient, ""),
        };
        let mut message = self.to_string();
        if let Self::File { source, .. } = self {
            message = format!("{message}: {source}");
        }
        Failure {
            kind,
            message,
            at: String::new(),
            hint: hint.to_owned(),
        }
    }
}
