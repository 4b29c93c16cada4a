//! What can go wrong, in the callers' terms: theirs ([`RegistryError::is_callers_fault`]), or the store's.

use ign_proto::Digest;
use ign_proto::manifest::ManifestError;

use crate::uploads::UploadId;

/// Why a body that somebody sends could not be read further.
pub type BodyError = Box<dyn std::error::Error + Send + Sync>;

/// Failure of a registry operation.
///
/// Every write is idempotent by its content or key; after a `Store` error the outcome of a write is unknown and the
/// same call may be made again.
#[derive(Debug, thiserror::Error)]
pub enum RegistryError {
    /// The store's URL or settings do not make sense.
    #[error("store {url:?}: {reason}")]
    Location {
        /// The URL as given.
        url: String,
        /// What is wrong.
        reason: String,
    },
    /// The store failed.
    #[error("object store could not {operation} {path}")]
    Store {
        /// Verb: read, write, list, ...
        operation: &'static str,
        /// Which object.
        path: String,
        /// What the store said.
        #[source]
        source: object_store::Error,
    },
    /// The store has no room left. What was there is unharmed.
    #[error("object store is full: could not {operation} {path}")]
    Full {
        /// Verb: write, copy, ...
        operation: &'static str,
        /// Which object.
        path: String,
        /// What the store said.
        #[source]
        source: object_store::Error,
    },
    /// The bytes are not those that the digest names. Nothing was kept.
    #[error("content has digest {actual}, not {expected}")]
    WrongDigest {
        /// As claimed.
        expected: Digest,
        /// As computed.
        actual: Digest,
    },
    /// The sender's body ended early; an upload session keeps what arrived.
    #[error("body ended early")]
    Body {
        /// What the connection said.
        #[source]
        source: BodyError,
    },
    /// A body larger than the limit that the caller set.
    #[error("content is larger than {limit_bytes} bytes")]
    TooLarge {
        /// The limit.
        limit_bytes: u64,
    },
    /// A chunk that does not begin where the upload stands.
    #[error("upload {id} stands at byte {offset}, not {given}")]
    WrongOffset {
        /// The upload.
        id: UploadId,
        /// Where it stands.
        offset: u64,
        /// Where the chunk begins.
        given: u64,
    },
    /// No such upload, or it has finished or expired.
    #[error("upload {id} does not exist")]
    UploadAbsent {
        /// The upload.
        id: UploadId,
    },
    /// A manifest that breaks a rule.
    #[error("invalid manifest")]
    Manifest {
        /// Which rule.
        #[source]
        source: ManifestError,
    },
    /// A manifest names blobs that are absent or have another size.
    #[error(
        "{missing} of the manifest's blobs are absent or of another size, the first is {first}"
    )]
    BlobsMissing {
        /// How many.
        missing: usize,
        /// One of them.
        first: Digest,
    },
    /// A version's record exists with other content: two databases share one bucket.
    #[error("{path} exists with other content")]
    VersionTaken {
        /// Path of the record.
        path: String,
    },
    /// The bucket records a version that the database does not know: nothing may be collected by such a database.
    #[error("the database does not know {path}; rebuild the registry first")]
    VersionUnknown {
        /// Path of the record.
        path: String,
    },
    /// An object of the registry's own holds what it should not.
    #[error("{path} is damaged: {reason}")]
    Damaged {
        /// Which object.
        path: String,
        /// What is wrong.
        reason: String,
    },
}

impl RegistryError {
    /// The request was wrong; the same request fails again.
    pub fn is_callers_fault(&self) -> bool {
        match self {
            Self::WrongDigest { .. }
            | Self::TooLarge { .. }
            | Self::WrongOffset { .. }
            | Self::UploadAbsent { .. }
            | Self::Manifest { .. }
            | Self::BlobsMissing { .. }
            | Self::Body { .. } => true,
            Self::Location { .. }
            | Self::Store { .. }
            | Self::Full { .. }
            | Self::VersionTaken { .. }
            | Self::VersionUnknown { .. }
            | Self::Damaged { .. } => false,
        }
    }
}

impl From<ManifestError> for RegistryError {
    fn from(source: ManifestError) -> Self {
        Self::Manifest { source }
    }
}

/// Adapter for `map_err` on calls to the store.
pub(crate) fn store_error(
    operation: &'static str,
    path: &object_store::path::Path,
) -> impl FnOnce(object_store::Error) -> RegistryError {
    let path = path.to_string();
    move |source| {
        if is_full(&source) {
            RegistryError::Full {
                operation,
                path,
                source,
            }
        } else {
            RegistryError::Store {
                operation,
                path,
                source,
            }
        }
    }
}

/// A body that ended before its length without a word of the connection.
pub(crate) fn cut(path: &object_store::path::Path) -> RegistryError {
    RegistryError::Store {
        operation: "read",
        path: path.to_string(),
        source: object_store::Error::Generic {
            store: "registry",
            source: "the body ended early".into(),
        },
    }
}

/// Whether the store says that it has no room. Folders say so by the error's kind; of a bucket's answer only the text is
/// passed on: status 507, or the error code of the server.
fn is_full(error: &object_store::Error) -> bool {
    const WORDS: [&str; 4] = [
        "507 Insufficient Storage",
        "QuotaExceeded",
        "StorageFull",
        "InsufficientStorage",
    ];
    let mut cause: Option<&(dyn std::error::Error + 'static)> = Some(error);
    while let Some(error) = cause {
        if let Some(io) = error.downcast_ref::<std::io::Error>()
            && matches!(
                io.kind(),
                std::io::ErrorKind::StorageFull | std::io::ErrorKind::QuotaExceeded
            )
        {
            return true;
        }
        let text = error.to_string();
        if WORDS.iter().any(|word| text.contains(word)) {
            return true;
        }
        cause = error.source();
    }
    false
}
