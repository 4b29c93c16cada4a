//! Job state machine and its two stores, Postgres and `SQLite`.
//!
//! - [`state`]: the rules of a job's life, pure.
//! - [`store`]: what a queue can do, as a trait with its types and errors.
//! - [`changes`]: waiting for changes.
//! - [`token`]: bearer tokens.
//! - [`webhook`]: where events are sent, and the outbox.
//! - [`postgres`] and [`sqlite`]: the two databases; `sql` is the text they share, [`schema`] their tables.
//!
//! Invariant: nothing outside the state machine decides what becomes of a job; the stores only find, lock and keep.

use std::pin::Pin;
use std::sync::Arc;

pub mod changes;
mod check;
mod error;
mod group;
pub mod postgres;
pub mod schema;
pub mod sqlite;
pub mod state;
pub mod store;
pub mod token;
mod waiting;
pub mod webhook;

pub use changes::Changes;
pub use state::{
    Backoff, Checkpoint, Failure, FailureKind, Job, JobSpec, JobState, Level, Progress,
};
pub use store::{
    Adopted, Collection, Event, JobFilter, JobPage, LogLine, Named, NewLogLine, NewVersion, Orders,
    Reaped, Settings, Standing, Status, Store, StoreError, Submit, Version, VersionFilter, Waiting,
    Worker, WorkerInfo,
};
pub use token::{NewToken, SecretHash, Token, TokenKey, Tokens};
pub use webhook::{Delivery, DeliveryState, Dispatch, Secret, Tried, Webhook, Webhooks};

/// A store that is being opened: boxed, so that it is compiled here alone and not in every crate that waits for it.
pub type Opening<'a> = Pin<Box<dyn Future<Output = store::Result<Arc<dyn Store>>> + Send + 'a>>;

/// Opens the store that the URL names (`sqlite:///path/to/file` or `postgres://...`) and brings its schema up to date.
#[inline(never)]
pub fn open(url: &str, settings: Settings) -> Opening<'_> {
    Box::pin(async move {
        if url.starts_with("sqlite:") {
            Ok(Arc::new(sqlite::open(url, settings).await?) as Arc<dyn Store>)
        } else if url.starts_with("postgres:") || url.starts_with("postgresql:") {
            Ok(Arc::new(postgres::open(url, settings).await?) as Arc<dyn Store>)
        } else {
            Err(StoreError::Invalid {
                field: "database",
                message: "the URL must start with sqlite: or postgres:".to_owned(),
            })
        }
    })
}
