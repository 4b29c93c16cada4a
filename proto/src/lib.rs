//! Wire types of ign.v1, identifiers, and the mapping of errors to gRPC status.
//!
//! - [`v1`]: messages, clients and servers generated from `ign/v1/ign.proto`.
//! - [`ids`]: newtypes for names and digests; a value that exists is valid.
//! - [`grant`]: what a bearer token allows.
//! - [`manifest`]: captures and bundles as OCI image manifests, written and read.
//! - [`status`]: the one place that builds or reads a [`tonic::Status`].
//!
//! Invariant: this crate does no I/O and knows nothing of stores or jobs' rules.

pub mod grant;
pub mod ids;
pub mod manifest;
pub mod status;

pub use grant::{Grant, Scope};
pub use ids::{
    Attempt, CollectionId, Digest, FilePath, IdError, JobId, LATEST, ObjectId, ObjectName, WorkerId,
};
pub use manifest::{FileEntry, Kind, Manifest};
pub use status::Cause;

/// Messages, clients and servers generated from `ign/v1/ign.proto`.
pub mod v1 {
    #![allow(
        missing_docs,
        unreachable_pub,
        clippy::pedantic,
        clippy::allow_attributes,
        clippy::large_enum_variant,
        clippy::large_futures,
        reason = "generated code"
    )]
    tonic::include_proto!("ign.v1");

    /// The compiled schema, for gRPC reflection.
    pub const FILE_DESCRIPTOR_SET: &[u8] = tonic::include_file_descriptor_set!("ign.v1");
}

/// Largest gRPC message that either side accepts. Bytes of captures and bundles travel over HTTP instead.
pub const MAX_MESSAGE_BYTES: usize = 16 * 1024 * 1024;
