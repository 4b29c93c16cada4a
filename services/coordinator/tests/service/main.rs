//! The coordinator in this process, on an embedded database and a folder (or S3), spoken to by real clients.
#![expect(clippy::unwrap_used, reason = "helpers of tests")]

mod auth;
mod data_plane;
mod fixture;
mod life;
mod limits;
mod oci;
mod operations;
mod registry;
mod tls;
