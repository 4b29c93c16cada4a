//! Coordinator: gRPC control plane and HTTP data plane on one port.
//!
//! ```text
//!             one port, HTTP/2 and HTTP/1.1, TLS or not
//!   trace -> cors -> auth -+-> ign.v1 (jobs, workers, bundles, admin, ...)  -> ign-queue (database)
//!                          +-> /v2/... blobs and manifests (data_plane)     -> ign-registry (bucket)
//!                          +-> /healthz /readyz /metrics, gRPC health and reflection
//!   tasks: reap lost leases · mirror what is published into the bucket · drop stale uploads · audit
//!          send webhooks
//! ```
//!
//! **Architecture invariants.** The coordinator decides nothing by itself: every rule about jobs is the queue's, under a
//! row lock of the database, so that any number of coordinators may run on one database and bucket, and any of them may
//! be killed at any point. Nothing is kept in memory that a restart needs. Only [`publish`] makes a bundle visible, and
//! only after the database accepted the attempt. What a request needs stands in the table of
//! [`access`] alone; what is not there does not exist.

mod access;
mod admin;
mod app;
mod auth;
mod body;
mod bundles;
mod care;
mod collections;
mod config;
mod connections;
mod convert;
mod data_plane;
mod diagnose;
mod error;
mod fetch;
#[doc(hidden)]
pub mod fuzz;
mod holders;
mod http_answer;
mod jobs;
mod limits;
mod maintenance;
mod metrics;
mod operations;
mod publish;
mod room;
mod server;
mod throttle;
mod tls;
mod token;
mod tokens;
mod trace;
mod webhooks;
mod workers;

pub use config::{Care, Config, ServeError};
pub use limits::{Limits, Rate};
pub use server::{Running, serve};
pub use tls::TlsFiles;
