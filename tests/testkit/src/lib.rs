//! Real services for tests: a throw-away Postgres cluster and an S3 endpoint with signature checks.
//!
//! Tests that need a service start it here and fail, with a hint how to install it, where it is absent: a skipped
//! test proves nothing. Everything listens on loopback at a free port, lives in its own temporary folder and ends with
//! the test process, also when that is killed.

mod postgres;
mod s3;

pub use postgres::Postgres;
pub use s3::{Credentials, S3, serve};
