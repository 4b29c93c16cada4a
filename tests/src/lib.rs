//! Harness of the end-to-end tests: real processes, a real Postgres, a real S3 endpoint, all on loopback.
//!
//! Tests speak to the service as its users do, through `ignctl`, and hurt it as the world does, with SIGKILL. A program
//! or service that is missing fails the test; nothing is skipped. Every process is ended by its id when the test ends,
//! however it ends; what they wrote is printed when a test fails.

mod api;
mod captures;
mod client;
mod coordinator;
mod process;
mod receiver;
mod s3;
mod stack;

pub use api::Api;
pub use captures::{Demo, copy_dir, demo_capture};
pub use client::{Client, Job};
pub use coordinator::{Coordinator, Setup, scripted_agent};
pub use process::{Process, descendants, kill_now, path, program, run, wait_until};
pub use receiver::{Received, receiver};
pub use s3::S3;
pub use stack::{Embedded, Stack};
