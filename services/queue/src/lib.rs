//! Job state machine and its two stores, Postgres and SQLite.
//!
//! - [`state`]: the rules of a job's life, pure.
//! - [`store`]: what a queue can do, as a trait with its types and errors.
//! - [`changes`]: waiting for changes.

pub mod changes;
pub mod state;
pub mod store;

pub use changes::Changes;
pub use state::{
    Backoff, Checkpoint, Failure, FailureKind, Job, JobSpec, JobState, Level, Progress,
};
pub use store::{
    Collection, JobFilter, JobPage, LogLine, NewLogLine, NewVersion, Orders, Reaped, Settings,
    Status, Store, StoreError, Submit, Version, VersionFilter, Waiting, Worker, WorkerInfo,
};
