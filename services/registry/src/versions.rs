//! The bucket's copy of what the database decided: one record per version, and per object its aliases and retired
//! versions. With the manifests and blobs this is everything that a new database needs.
//!
//! Invariant: a version's record is written once. Its bytes depend only on what the database committed, so writing it
//! again (after a crash between commit and write) gives the same object.

use std::collections::{BTreeMap, BTreeSet};

use bytes::Bytes;
use chrono::{DateTime, Utc};
use ign_proto::manifest::{Kind, Manifest};
use ign_proto::{Digest, JobId, ObjectName};
use object_store::path::Path;
use serde::{Deserialize, Serialize};

use crate::error::RegistryError;
use crate::store::Registry;

/// `versions/<collection>/<object>/vN.json`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct VersionRecord {
    /// The object.
    pub object: ObjectName,
    /// 1, 2, ...
    pub version: u32,
    /// The bundle's manifest.
    pub manifest_digest: Digest,
    /// Sum of the files' sizes.
    pub size_bytes: u64,
    /// The job that made it.
    pub job_id: JobId,
    /// When the database committed it.
    pub created_at: DateTime<Utc>,
    /// Summary of the metrics as JSON text, as the worker sent it.
    pub metrics_json: String,
}

/// `versions/<collection>/<object>/state.json`.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ObjectState {
    /// Alias to version.
    pub aliases: BTreeMap<String, u32>,
    /// Versions taken out of listings.
    pub retired: BTreeSet<u32>,
}

/// What the bucket says is published.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Rebuild {
    /// Sorted by object and version.
    pub versions: Vec<VersionRecord>,
    /// Objects that have aliases or retired versions.
    pub states: BTreeMap<ObjectName, ObjectState>,
    /// Records that cannot be used, and why: `(path, reason)`.
    pub faults: Vec<(String, String)>,
}

impl Registry {
    fn version_path(&self, object: &ObjectName, name: &str) -> Path {
        self.path(&format!("versions/{object}/{name}"))
    }

    /// Writes a version's record, unless it is there already.
    pub async fn put_version(&self, record: &VersionRecord) -> Result<(), RegistryError> {
        let path = self.version_path(&record.object, &format!("v{}.json", record.version));
        let bytes = to_json(&path, record)?;
        match self.read_small(&path).await? {
            Some(present) if present == bytes => Ok(()),
            Some(_) => Err(RegistryError::VersionTaken {
                path: path.to_string(),
            }),
            None => self.put(&path, bytes.into()).await,
        }
    }

    /// Writes an object's aliases and retired versions, unless they are there already.
    pub async fn put_state(
        &self,
        object: &ObjectName,
        state: &ObjectState,
    ) -> Result<(), RegistryError> {
        let path = self.version_path(object, "state.json");
        let bytes = to_json(&path, state)?;
        if self
            .read_small(&path)
            .await?
            .is_some_and(|present| present == bytes)
        {
            return Ok(());
        }
        self.put(&path, bytes.into()).await
    }

    /// Reads all versions back from the bucket alone, and checks that each one's manifest and blobs are there.
    pub async fn rebuild(&self) -> Result<Rebuild, RegistryError> {
        let mut rebuild = Rebuild::default();
        for meta in self.list(&self.path("versions")).await? {
            let path = meta.location;
            let Some(bytes) = self.read_small(&path).await? else {
                continue;
            };
            match self.read_record(&path, &bytes).await? {
                Ok(Record::Version(record)) => rebuild.versions.push(record),
                Ok(Record::State(object, state)) => {
                    rebuild.states.insert(object, state);
                }
                Err(reason) => rebuild.faults.push((path.to_string(), reason)),
            }
        }
        rebuild
            .versions
            .sort_by(|a, b| (&a.object, a.version).cmp(&(&b.object, b.version)));
        rebuild.faults.sort();
        Ok(rebuild)
    }

    /// The outer error is the store's; the inner one says why the record cannot be used.
    async fn read_record(
        &self,
        path: &Path,
        bytes: &[u8],
    ) -> Result<Result<Record, String>, RegistryError> {
        let names = self.names(path);
        let [_, collection, object, file] = names.as_slice() else {
            return Ok(Err("it lies at an unknown place".to_owned()));
        };
        let Ok(object) = format!("{collection}/{object}").parse::<ObjectName>() else {
            return Ok(Err("its folder is no object's name".to_owned()));
        };
        if file == "state.json" {
            return Ok(serde_json::from_slice(bytes)
                .map(|state| Record::State(object, state))
                .map_err(|error| error.to_string()));
        }
        let record: VersionRecord = match serde_json::from_slice(bytes) {
            Ok(record) => record,
            Err(error) => return Ok(Err(error.to_string())),
        };
        if record.object != object || *file != format!("v{}.json", record.version) {
            return Ok(Err("its content names another object or version".to_owned()));
        }
        let manifest = match self.manifest(&record.manifest_digest).await {
            Ok(Some(bytes)) => Manifest::decode(&bytes),
            Ok(None) => {
                return Ok(Err(format!(
                    "manifest {} is absent",
                    record.manifest_digest
                )));
            }
            Err(error @ RegistryError::Damaged { .. }) => return Ok(Err(error.to_string())),
            Err(error) => return Err(error),
        };
        match manifest {
            Ok(manifest) if manifest.kind() == Kind::Bundle => {
                match self.check_blobs(&manifest).await {
                    Ok(()) => Ok(Ok(Record::Version(record))),
                    Err(error @ RegistryError::BlobsMissing { .. }) => Ok(Err(error.to_string())),
                    Err(error) => Err(error),
                }
            }
            Ok(_) => Ok(Err(format!(
                "manifest {} is no bundle's",
                record.manifest_digest
            ))),
            Err(error) => Ok(Err(error.to_string())),
        }
    }
}

enum Record {
    Version(VersionRecord),
    State(ObjectName, ObjectState),
}

fn to_json<T: Serialize>(path: &Path, value: &T) -> Result<Bytes, RegistryError> {
    let mut bytes = serde_json::to_vec_pretty(value).map_err(|error| RegistryError::Damaged {
        path: path.to_string(),
        reason: error.to_string(),
    })?;
    bytes.push(b'\n');
    Ok(bytes.into())
}
