//! Errors of queue and registry in the words of the wire.
//!
//! Each error is handled once: what the server is to blame for is logged here, with its causes and the request's id,
//! and the client gets the id.

use std::error::Error;
use std::time::Duration;

use ign_proto::Cause;
use ign_proto::manifest::ManifestError;
use ign_queue::StoreError;
use ign_registry::RegistryError;

use crate::http_answer::Refused;
use crate::trace::request_id;

const RETRY_AFTER: Duration = Duration::from_secs(2);

impl From<Cause> for Refused {
    fn from(cause: Cause) -> Self {
        Self(cause)
    }
}

impl From<ign_proto::IdError> for Refused {
    fn from(error: ign_proto::IdError) -> Self {
        Self(error.into())
    }
}

impl From<ManifestError> for Refused {
    fn from(error: ManifestError) -> Self {
        Self(Cause::bad_field("manifest", chain(&error)))
    }
}

impl From<StoreError> for Refused {
    fn from(error: StoreError) -> Self {
        Self(match error {
            StoreError::NotFound { kind, name } => Cause::absent(kind, name),
            StoreError::Conflict { key } => Cause::KeyReused { key },
            StoreError::LeaseLost { job, attempt } => Cause::LeaseLost {
                job: job.to_string(),
                attempt: attempt.0,
            },
            StoreError::Invalid { field, message } => Cause::bad_field(field, message),
            StoreError::NotAllowed { message } => Cause::NotAllowed {
                reason: "NOT_ALLOWED".to_owned(),
                message,
            },
            error @ StoreError::Unavailable { .. } => {
                unavailable("the database cannot be reached", &error)
            }
            error @ StoreError::Internal { .. } => internal(&error),
        })
    }
}

impl From<RegistryError> for Refused {
    fn from(error: RegistryError) -> Self {
        Self(match error {
            RegistryError::WrongDigest { .. } => Cause::bad_field("digest", error),
            RegistryError::UploadAbsent { id } => Cause::absent("upload", id),
            RegistryError::Manifest { source } => Cause::bad_field("manifest", chain(&source)),
            RegistryError::BlobsMissing { .. } => Cause::NotAllowed {
                reason: "BLOB_MISSING".to_owned(),
                message: error.to_string(),
            },
            RegistryError::Body { .. }
            | RegistryError::TooLarge { .. }
            | RegistryError::WrongOffset { .. } => Cause::bad_field("body", chain(&error)),
            RegistryError::Store { .. } => {
                unavailable("the object store cannot be reached", &error)
            }
            RegistryError::Full { .. } => {
                tracing::warn!(
                    request.id = request_id(),
                    error = chain(&error),
                    "the object store is full"
                );
                Cause::Full {
                    message: "the object store is full: make room, or collect garbage".to_owned(),
                }
            }
            RegistryError::VersionUnknown { .. } => Cause::NotAllowed {
                reason: "VERSION_UNKNOWN".to_owned(),
                message: error.to_string(),
            },
            RegistryError::Location { .. }
            | RegistryError::VersionTaken { .. }
            | RegistryError::Damaged { .. } => internal(&error),
        })
    }
}

impl From<Refused> for tonic::Status {
    fn from(Refused(cause): Refused) -> Self {
        cause.status()
    }
}

fn unavailable(message: &str, error: &dyn Error) -> Cause {
    tracing::warn!(request.id = request_id(), error = chain(error), "{message}");
    Cause::Unavailable {
        message: message.to_owned(),
        retry_after: RETRY_AFTER,
    }
}

/// A bug or a damaged store: logged here, the client gets the request's id.
pub(crate) fn internal(error: &dyn Error) -> Cause {
    let request_id = request_id();
    tracing::error!(
        request.id = request_id,
        error = chain(error),
        "internal error"
    );
    Cause::Internal { request_id }
}

/// An error with its causes, in one line.
pub(crate) fn chain(error: &dyn Error) -> String {
    let mut text = error.to_string();
    let mut cause = error.source();
    while let Some(error) = cause {
        let more = error.to_string();
        // Some libraries print their source themselves.
        if !text.ends_with(&more) {
            text = format!("{text}: {more}");
        }
        cause = error.source();
    }
    text
}
