//! Errors on the wire: the only module that builds a [`tonic::Status`], and the one that reads it back.
//!
//! Both directions go through [`Cause`], so that a client matches on the same words as the server used and never on
//! message text. The table (code, detail) is in each variant's doc. Messages are lowercase without a full stop.
//!
//! Invariant: `Cause::from_status(&cause.status()) == cause` for every cause that a server can speak.

use std::fmt;
use std::time::Duration;

use tonic::{Code, Status};
use tonic_types::{ErrorDetails, StatusExt as _};

use crate::ids::IdError;

const DOMAIN: &str = "ign.v1";
const KEY_REUSED: &str = "KEY_REUSED";
const LEASE_LOST: &str = "LEASE_LOST";
const FULL: &str = "FULL";
const FORBIDDEN: &str = "FORBIDDEN";
const NO_TOKEN: &str = "NO_TOKEN";

/// Why a call was refused or failed.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Cause {
    /// A field of the request is wrong. `INVALID_ARGUMENT`, `BadRequest`.
    BadField {
        /// Which field, as in the proto.
        field: String,
        /// What is wrong with it.
        message: String,
    },
    /// Something named does not exist. `NOT_FOUND`, `ResourceInfo`.
    Absent {
        /// What sort of thing: job, bundle, blob.
        kind: String,
        /// Its name.
        name: String,
    },
    /// An idempotency key came again with another payload. `ALREADY_EXISTS`, `ErrorInfo`.
    KeyReused {
        /// The key.
        key: String,
    },
    /// The attempt no longer holds its job; it must stop. `FAILED_PRECONDITION`, `ErrorInfo` with reason `LEASE_LOST`.
    LeaseLost {
        /// The job.
        job: String,
        /// The attempt that was refused.
        attempt: u32,
    },
    /// The state does not allow the call. `FAILED_PRECONDITION`, `ErrorInfo` with the given reason.
    NotAllowed {
        /// A constant in upper case, such as `BLOB_MISSING`.
        reason: String,
        /// What is missing.
        message: String,
    },
    /// Two writers met; the call had no effect. `ABORTED`, no detail.
    Conflict,
    /// Database or object store cannot be reached. `UNAVAILABLE`, `RetryInfo`.
    Unavailable {
        /// What is down.
        message: String,
        /// When to try again.
        retry_after: Duration,
    },
    /// Too many requests in a short time. `RESOURCE_EXHAUSTED`, `RetryInfo`.
    TooMany {
        /// When to try again.
        retry_after: Duration,
    },
    /// No room is left for new work; what runs goes on. `RESOURCE_EXHAUSTED`, `ErrorInfo` with reason `FULL`.
    Full {
        /// What is full, and what makes room.
        message: String,
    },
    /// No token, or a wrong one. `UNAUTHENTICATED`, `ErrorInfo`.
    Unauthenticated,
    /// The token does not allow this. `PERMISSION_DENIED`, `ErrorInfo`.
    Forbidden {
        /// What was not allowed.
        message: String,
    },
    /// A bug; the server's log has the story under this id. `INTERNAL`, `RequestInfo`.
    Internal {
        /// Id of the request in the server's log.
        request_id: String,
    },
    /// Client side only: the call broke on the way, or another program answered. The outcome is unknown.
    Transport {
        /// gRPC's code.
        code: Code,
        /// What the transport said.
        message: String,
    },
}

impl Cause {
    /// A field that does not parse.
    pub fn bad_field(field: &str, message: impl fmt::Display) -> Self {
        Self::BadField {
            field: field.to_owned(),
            message: message.to_string(),
        }
    }

    /// Something that does not exist.
    pub fn absent(kind: &str, name: impl fmt::Display) -> Self {
        Self::Absent {
            kind: kind.to_owned(),
            name: name.to_string(),
        }
    }

    /// The status that carries this cause.
    pub fn status(&self) -> Status {
        let mut details = ErrorDetails::new();
        let info = |details: &mut ErrorDetails, reason: &str, pairs: &[(&str, String)]| {
            let metadata: std::collections::HashMap<String, String> = pairs
                .iter()
                .map(|(key, value)| ((*key).to_owned(), value.clone()))
                .collect();
            details.set_error_info(reason, DOMAIN, metadata);
        };
        let code = match self {
            Self::BadField { field, message } => {
                details.add_bad_request_violation(field, message);
                Code::InvalidArgument
            }
            Self::Absent { kind, name } => {
                details.set_resource_info(kind, name, "", "does not exist");
                Code::NotFound
            }
            Self::KeyReused { key } => {
                info(&mut details, KEY_REUSED, &[("key", key.clone())]);
                Code::AlreadyExists
            }
            Self::LeaseLost { job, attempt } => {
                info(
                    &mut details,
                    LEASE_LOST,
                    &[("job", job.clone()), ("attempt", attempt.to_string())],
                );
                Code::FailedPrecondition
            }
            Self::NotAllowed { reason, message } => {
                info(&mut details, reason, &[("message", message.clone())]);
                Code::FailedPrecondition
            }
            Self::Conflict => Code::Aborted,
            Self::Unavailable { retry_after, .. } => {
                details.set_retry_info(Some(*retry_after));
                Code::Unavailable
            }
            Self::TooMany { retry_after } => {
                details.set_retry_info(Some(*retry_after));
                Code::ResourceExhausted
            }
            Self::Full { message } => {
                info(&mut details, FULL, &[("message", message.clone())]);
                Code::ResourceExhausted
            }
            Self::Unauthenticated => {
                info(&mut details, NO_TOKEN, &[]);
                Code::Unauthenticated
            }
            Self::Forbidden { message } => {
                info(&mut details, FORBIDDEN, &[("message", message.clone())]);
                Code::PermissionDenied
            }
            Self::Internal { request_id } => {
                details.set_request_info(request_id, "");
                Code::Internal
            }
            Self::Transport { code, message } => return Status::new(*code, message),
        };
        if *self == Self::Conflict {
            return Status::new(code, self.to_string());
        }
        let message = match self {
            Self::Unavailable { message, .. } => message.clone(),
            other => other.to_string(),
        };
        Status::with_error_details(code, message, details)
    }

    /// What a status says; the inverse of [`Cause::status`].
    pub fn from_status(status: &Status) -> Self {
        let details = status.get_error_details();
        let info = details.error_info().filter(|info| info.domain == DOMAIN);
        let field = |key: &str| {
            info.and_then(|info| info.metadata.get(key))
                .cloned()
                .unwrap_or_default()
        };
        let cause = match (status.code(), info.map(|info| info.reason.as_str())) {
            (Code::InvalidArgument, _) => details
                .bad_request()
                .and_then(|bad| bad.field_violations.first())
                .map(|violation| Self::BadField {
                    field: violation.field.clone(),
                    message: violation.description.clone(),
                }),
            (Code::NotFound, _) => details.resource_info().map(|info| Self::Absent {
                kind: info.resource_type.clone(),
                name: info.resource_name.clone(),
            }),
            (Code::AlreadyExists, Some(KEY_REUSED)) => Some(Self::KeyReused { key: field("key") }),
            (Code::FailedPrecondition, Some(LEASE_LOST)) => Some(Self::LeaseLost {
                job: field("job"),
                attempt: field("attempt").parse().unwrap_or(0),
            }),
            (Code::FailedPrecondition, Some(reason)) => Some(Self::NotAllowed {
                reason: reason.to_owned(),
                message: field("message"),
            }),
            (Code::Aborted, _) => Some(Self::Conflict),
            (Code::Unavailable, _) => details.retry_info().map(|info| Self::Unavailable {
                message: status.message().to_owned(),
                retry_after: info.retry_delay.unwrap_or_default(),
            }),
            (Code::ResourceExhausted, Some(FULL)) => Some(Self::Full {
                message: field("message"),
            }),
            // Without it: a message that is too large.
            (Code::ResourceExhausted, _) => details.retry_info().map(|info| Self::TooMany {
                retry_after: info.retry_delay.unwrap_or_default(),
            }),
            (Code::Unauthenticated, _) => Some(Self::Unauthenticated),
            (Code::PermissionDenied, Some(FORBIDDEN)) => Some(Self::Forbidden {
                message: field("message"),
            }),
            (Code::Internal, _) => details.request_info().map(|info| Self::Internal {
                request_id: info.request_id.clone(),
            }),
            _ => None,
        };
        cause.unwrap_or_else(|| Self::Transport {
            code: status.code(),
            message: status.message().to_owned(),
        })
    }

    /// Whether the same call may succeed later. Every write is idempotent by its key, so an unknown outcome is
    /// retried too.
    pub fn retryable(&self) -> bool {
        match self {
            Self::Conflict
            | Self::Unavailable { .. }
            | Self::TooMany { .. }
            | Self::Full { .. } => true,
            // A connection that broke shows as any of these; a server that has no such method, or refuses a message's
            // size, does not.
            Self::Transport { code, .. } => matches!(
                code,
                Code::Unavailable
                    | Code::Unknown
                    | Code::Internal
                    | Code::Cancelled
                    | Code::DeadlineExceeded
            ),
            _ => false,
        }
    }

    /// How long to wait before trying again, when the server said so.
    pub fn retry_after(&self) -> Option<Duration> {
        match self {
            Self::Unavailable { retry_after, .. } | Self::TooMany { retry_after } => {
                Some(*retry_after)
            }
            _ => None,
        }
    }

    /// A constant in upper case that names the cause; stable, for scripts.
    pub fn reason(&self) -> &str {
        match self {
            Self::BadField { .. } => "BAD_FIELD",
            Self::Absent { .. } => "ABSENT",
            Self::KeyReused { .. } => KEY_REUSED,
            Self::LeaseLost { .. } => LEASE_LOST,
            Self::NotAllowed { reason, .. } => reason,
            Self::Conflict => "CONFLICT",
            Self::Unavailable { .. } => "UNAVAILABLE",
            Self::TooMany { .. } => "TOO_MANY",
            Self::Full { .. } => FULL,
            Self::Unauthenticated => NO_TOKEN,
            Self::Forbidden { .. } => FORBIDDEN,
            Self::Internal { .. } => "INTERNAL",
            Self::Transport { .. } => "TRANSPORT",
        }
    }
}

impl fmt::Display for Cause {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::BadField { field, message } => write!(f, "{field}: {message}"),
            Self::Absent { kind, name } => write!(f, "{kind} {name} does not exist"),
            Self::KeyReused { key } => write!(f, "{key} was used before with another payload"),
            Self::LeaseLost { job, attempt } => {
                write!(f, "attempt {attempt} no longer holds job {job}")
            }
            Self::NotAllowed { message, .. }
            | Self::Full { message }
            | Self::Forbidden { message } => f.write_str(message),
            Self::Conflict => f.write_str("another write came first; try again"),
            Self::Unavailable { message, .. } => write!(f, "{message}"),
            Self::TooMany { retry_after } => write!(
                f,
                "too many requests; try again in {} s",
                retry_after.as_secs().max(1)
            ),
            Self::Unauthenticated => f.write_str("a valid bearer token is required"),
            Self::Internal { request_id } => write!(
                f,
                "internal error; the server's log has it as request {request_id}"
            ),
            Self::Transport { code, message } => write!(f, "{message} ({code:?})"),
        }
    }
}

impl std::error::Error for Cause {}

impl From<Cause> for Status {
    fn from(cause: Cause) -> Self {
        cause.status()
    }
}

impl From<&Status> for Cause {
    fn from(status: &Status) -> Self {
        Self::from_status(status)
    }
}

impl From<IdError> for Cause {
    fn from(error: IdError) -> Self {
        Self::bad_field(error.kind, error)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn server_causes() -> Vec<(Cause, Code, bool)> {
        vec![
            (
                Cause::bad_field("spec.object", "must not be empty"),
                Code::InvalidArgument,
                false,
            ),
            (Cause::absent("job", "0192"), Code::NotFound, false),
            (
                Cause::KeyReused {
                    key: "request-1".into(),
                },
                Code::AlreadyExists,
                false,
            ),
            (
                Cause::LeaseLost {
                    job: "0192".into(),
                    attempt: 3,
                },
                Code::FailedPrecondition,
                false,
            ),
            (
                Cause::NotAllowed {
                    reason: "BLOB_MISSING".into(),
                    message: "blob is absent".into(),
                },
                Code::FailedPrecondition,
                false,
            ),
            (Cause::Conflict, Code::Aborted, true),
            (
                Cause::Unavailable {
                    message: "the database is down".into(),
                    retry_after: Duration::from_secs(2),
                },
                Code::Unavailable,
                true,
            ),
            (
                Cause::TooMany {
                    retry_after: Duration::from_secs(3),
                },
                Code::ResourceExhausted,
                true,
            ),
            (
                Cause::Full {
                    message: "the disk is full".into(),
                },
                Code::ResourceExhausted,
                true,
            ),
            (Cause::Unauthenticated, Code::Unauthenticated, false),
            (
                Cause::Forbidden {
                    message: "workers only".into(),
                },
                Code::PermissionDenied,
                false,
            ),
            (
                Cause::Internal {
                    request_id: "r1".into(),
                },
                Code::Internal,
                false,
            ),
        ]
    }

    #[test]
    fn every_server_cause_survives_the_wire() {
        for (cause, code, retryable) in server_causes() {
            let status = cause.status();
            assert_eq!(status.code(), code, "{cause:?}");
            // Only code, message and detail bytes travel.
            let wire = Status::with_details(
                status.code(),
                status.message(),
                status.details().to_vec().into(),
            );
            assert_eq!(Cause::from_status(&wire), cause);
            assert_eq!(cause.retryable(), retryable, "{cause:?}");
            assert!(!cause.to_string().ends_with('.') && !status.message().is_empty());
        }
    }

    #[test]
    fn a_broken_connection_is_retryable_and_a_missing_method_is_not() {
        for (code, retryable) in [
            (Code::Unavailable, true),
            (Code::Internal, true),
            (Code::Unknown, true),
            (Code::Unimplemented, false),
        ] {
            let cause = Cause::from_status(&Status::new(code, "transport error"));
            assert_eq!(
                cause,
                Cause::Transport {
                    code,
                    message: "transport error".into()
                }
            );
            assert_eq!(cause.retryable(), retryable);
        }
    }
}
