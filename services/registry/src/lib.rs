//! Content-addressed blobs, manifests, versions and aliases on an object store.
//!
//! ```text
//! blobs/sha256/ab/<64 hex>              files of captures, bundles and checkpoints
//! manifests/sha256/ab/<64 hex>          OCI image manifests that list them
//! versions/<collection>/<object>/v3.json  which manifest is version 3, and where it came from; written once
//! versions/<collection>/<object>/state.json  what users named and retired, rewritten on change
//! uploads/<id>/...                      parts of uploads that have not finished
//! trash/blobs/<64 hex>/<uuid>           what nothing names any more, on its way out
//! damaged/...                           what an audit found to be wrong
//! ```
//!
//! Everything needed to serve the published models lies in the bucket: [`Registry::rebuild`] reads it back.
//!
//! **Architecture invariant:** nothing here decides. The database is the only commit authority; this crate stores bytes
//! under the name of their content and mirrors what the database decided. Hence no lock, no compare-and-swap and no
//! local state: any number of coordinators may share one bucket, and each may be killed at any point. A store that does
//! not honour conditional create (found at start, see [`Probe`]) costs nothing but a warning.

mod audit;
mod blobs;
mod collect;
mod error;
mod store;
mod trash;
mod uploads;
mod versions;

pub use audit::{Audit, Fault, Outcome};
pub use blobs::BlobRead;
pub use collect::{Collected, Keep, Tally};
pub use error::{BodyError, RegistryError};
pub use store::{Probe, Registry, StoreConfig};
pub use uploads::UploadId;
pub use versions::{ObjectState, Published, Rebuild, VersionRecord};
