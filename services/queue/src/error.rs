//! What a driver's error means to a caller.
//!
//! Statements inside a transaction that was not committed are determinate: nothing happened. Only a commit whose answer
//! was lost is not; [`from_commit`] says so.

use sqlx::error::DatabaseError;

use crate::store::StoreError;

impl From<sqlx::Error> for StoreError {
    fn from(source: sqlx::Error) -> Self {
        if is_unavailable(&source) {
            Self::Unavailable {
                determinate: true,
                source,
            }
        } else {
            Self::Internal {
                message: "a statement was refused".to_owned(),
                source: Some(source),
            }
        }
    }
}

/// An error of a commit: unless the server itself refused it, it may have happened.
pub(crate) fn from_commit(source: sqlx::Error) -> StoreError {
    match source {
        sqlx::Error::Database(_) => source.into(),
        source => StoreError::Unavailable {
            determinate: false,
            source,
        },
    }
}

/// The error of a transaction, for one more of the calls that shared it.
pub(crate) fn shared(error: &StoreError) -> StoreError {
    match error {
        StoreError::Unavailable {
            determinate,
            source,
        } => StoreError::Unavailable {
            determinate: *determinate,
            source: sqlx::Error::Io(std::io::Error::other(source.to_string())),
        },
        other => StoreError::Internal {
            message: other.to_string(),
            source: None,
        },
    }
}

/// An error while the schema was brought up to date.
pub(crate) fn from_migration(error: sqlx::migrate::MigrateError) -> StoreError {
    match error {
        sqlx::migrate::MigrateError::Execute(source) => source.into(),
        other => StoreError::Internal {
            message: format!("the schema does not fit this program: {other}"),
            source: None,
        },
    }
}

fn is_unavailable(error: &sqlx::Error) -> bool {
    match error {
        sqlx::Error::Io(_)
        | sqlx::Error::Tls(_)
        | sqlx::Error::PoolTimedOut
        | sqlx::Error::PoolClosed
        | sqlx::Error::WorkerCrashed => true,
        sqlx::Error::Database(error) => is_passing(error.as_ref()),
        _ => false,
    }
}

/// Server-side conditions that pass: connection and resource troubles, shutdown, deadlock, a file that is locked or full.
fn is_passing(error: &dyn DatabaseError) -> bool {
    let Some(code) = error.code() else {
        return false;
    };
    // SQLSTATE has five characters; SQLite's extended codes are numbers whose low byte is the primary code.
    if code.len() == 5 {
        ["08", "40", "53", "55", "57", "58"].contains(&&code[..2]) || code == "25006"
    } else {
        const BUSY_LOCKED_NOMEM_READONLY_IOERR_FULL_CANTOPEN: [u32; 7] = [5, 6, 7, 8, 10, 13, 14];
        code.parse::<u32>().is_ok_and(|code| {
            BUSY_LOCKED_NOMEM_READONLY_IOERR_FULL_CANTOPEN.contains(&(code & 0xff))
        })
    }
}
