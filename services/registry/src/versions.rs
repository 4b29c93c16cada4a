//! The bucket's copy of what the database decided: one record per version, and per object its aliases and retired
//! versions. With the manifests and blobs this is everything that a new database needs.
//!
//! Invariant: a version's record is written once. Its bytes depend only on what the database committed, so writing it
//! again (after a crash between commit and write) gives the same object.
//!
//! A publication writes its record alone: a new version takes over [`LATEST`], whatever that named before, and changes
//! nothing else of the object. What a user names or retires is written to the object's state.
//!
//! A local disk is not made to flush these copies, which would take as long as flushing the manifest: the database has
//! flushed what they say, and a start writes again what a power cut took.

use std::collections::{BTreeMap, BTreeSet};

use bytes::Bytes;
use chrono::{DateTime, Utc};
use futures::{StreamExt as _, TryStreamExt as _};
use ign_proto::manifest::{Kind, Manifest};
use ign_proto::{Digest, JobId, LATEST, ObjectName};
use object_store::path::Path;
use object_store::{ObjectStore as _, ObjectStoreExt as _, PutMode};
use serde::{Deserialize, Serialize};

use crate::error::{RegistryError, store_error};
use crate::store::Registry;

const READS_IN_FLIGHT: usize = 8;

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
    /// Number of the newest version then, listed or not; of a later one, [`LATEST`] here does not know.
    #[serde(default)]
    pub newest: u32,
    /// Alias to version.
    pub aliases: BTreeMap<String, u32>,
    /// Versions taken out of listings.
    pub retired: BTreeSet<u32>,
    /// Since when, where that is known.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub retired_at: BTreeMap<u32, DateTime<Utc>>,
}

impl ObjectState {
    /// Whether this is what the records of `versions` say by themselves.
    fn is_plain(&self) -> bool {
        let named = self
            .aliases
            .iter()
            .map(|(alias, version)| (alias.as_str(), *version));
        self.retired.is_empty() && named.eq([(LATEST, self.newest)])
    }

    /// Brings it up to the versions that are recorded, in any order.
    fn catch_up(&mut self, versions: &BTreeSet<u32>) {
        let Some(newest) = versions.last().copied().filter(|it| *it > self.newest) else {
            return;
        };
        self.newest = newest;
        match versions.difference(&self.retired).last() {
            Some(listed) => self.aliases.insert(LATEST.to_owned(), *listed),
            None => self.aliases.remove(LATEST),
        };
    }
}

/// A version as the bucket has it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Published {
    /// Its record.
    pub record: VersionRecord,
    /// Number of its files.
    pub file_count: u32,
}

/// What the bucket says is published.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Rebuild {
    /// Sorted by object and version.
    pub versions: Vec<Published>,
    /// Of each object.
    pub states: BTreeMap<ObjectName, ObjectState>,
    /// Records that cannot be used, and why: `(path, reason)`.
    pub faults: Vec<(String, String)>,
}

impl Registry {
    fn version_path(&self, object: &ObjectName, name: &str) -> Path {
        self.path(&format!("versions/{object}/{name}"))
    }

    /// Writes the record of a version that was made just now. On a store that refuses a second create this is one call.
    pub async fn put_version(&self, record: &VersionRecord) -> Result<(), RegistryError> {
        if self.probe().conditional_create {
            let (path, bytes) = self.encode_version(record)?;
            let created = self
                .records
                .put_opts(&path, bytes.into(), PutMode::Create.into())
                .await;
            match created {
                Ok(_) => {
                    ign_faults::point("version.recorded");
                    return Ok(());
                }
                Err(object_store::Error::AlreadyExists { .. }) => {}
                Err(error) => return Err(store_error("write", &path)(error)),
            }
        }
        self.restore_version(record).await
    }

    /// Writes a version's record where it is absent or rotten; most often it is there.
    pub async fn restore_version(&self, record: &VersionRecord) -> Result<(), RegistryError> {
        let (path, bytes) = self.encode_version(record)?;
        match self.read_small(&path).await? {
            Some(present) if present == bytes => return Ok(()),
            Some(present) if serde_json::from_slice::<VersionRecord>(&present).is_ok() => {
                return Err(RegistryError::VersionTaken {
                    path: path.to_string(),
                });
            }
            // No record at all: it rotted, and the database knows what it said.
            Some(_) => self.set_aside(&path).await?,
            None => {}
        }
        self.put_record(&path, bytes).await?;
        ign_faults::point("version.recorded");
        Ok(())
    }

    fn encode_version(&self, record: &VersionRecord) -> Result<(Path, Bytes), RegistryError> {
        let path = self.version_path(&record.object, &format!("v{}.json", record.version));
        let bytes = to_json(&path, record)?;
        Ok((path, bytes))
    }

    async fn put_record(&self, path: &Path, bytes: Bytes) -> Result<(), RegistryError> {
        let written = self.records.put(path, bytes.into()).await;
        written.map(drop).map_err(store_error("write", path))
    }

    /// The versions that the bucket records, by name alone: `(object and version, path)`.
    pub async fn recorded(&self) -> Result<BTreeMap<(ObjectName, u32), String>, RegistryError> {
        let mut found = BTreeMap::new();
        for meta in self.list(&self.path("versions")).await? {
            let names = self.names(&meta.location);
            let [_, collection, object, file] = names.as_slice() else {
                continue;
            };
            let version = file
                .strip_prefix('v')
                .and_then(|rest| rest.strip_suffix(".json"))
                .and_then(|number| number.parse().ok());
            if let (Ok(object), Some(version)) = (format!("{collection}/{object}").parse(), version)
            {
                found.insert((object, version), meta.location.to_string());
            }
        }
        Ok(found)
    }

    /// Writes an object's aliases and retired versions, unless the bucket says the same already.
    pub async fn put_state(
        &self,
        object: &ObjectName,
        state: &ObjectState,
    ) -> Result<(), RegistryError> {
        let path = self.version_path(object, "state.json");
        let bytes = to_json(&path, state)?;
        let present = self.read_small(&path).await?;
        if present.map_or_else(|| state.is_plain(), |present| present == bytes) {
            return Ok(());
        }
        self.put_record(&path, bytes).await?;
        ign_faults::point("state.recorded");
        Ok(())
    }

    /// Reads all versions back from the bucket alone, and checks that each one's manifest is there, and its blobs unless
    /// it is retired.
    pub async fn rebuild(&self) -> Result<Rebuild, RegistryError> {
        let mut rebuild = Rebuild::default();
        let (states, versions): (Vec<Path>, Vec<Path>) = self
            .list(&self.path("versions"))
            .await?
            .into_iter()
            .map(|meta| meta.location)
            .partition(|path| path.filename() == Some("state.json"));
        for path in states {
            match self.read_state(&path).await? {
                Some(Ok((object, state))) => {
                    rebuild.states.insert(object, state);
                }
                Some(Err(reason)) => rebuild.faults.push((path.to_string(), reason)),
                None => {}
            }
        }
        let states = &rebuild.states;
        let read: Vec<_> = futures::stream::iter(versions)
            .map(|path| async move {
                let read = self.read_version(&path, states).await?;
                Ok::<_, RegistryError>((path, read))
            })
            .buffer_unordered(READS_IN_FLIGHT)
            .try_collect()
            .await?;
        for (path, read) in read {
            match read {
                Some(Ok(published)) => rebuild.versions.push(published),
                Some(Err(reason)) => rebuild.faults.push((path.to_string(), reason)),
                None => {}
            }
        }
        rebuild.versions.sort_by(|a, b| {
            (&a.record.object, a.record.version).cmp(&(&b.record.object, b.record.version))
        });
        let mut numbers: BTreeMap<&ObjectName, BTreeSet<u32>> = BTreeMap::new();
        for Published { record, .. } in &rebuild.versions {
            numbers
                .entry(&record.object)
                .or_default()
                .insert(record.version);
        }
        for (object, numbers) in numbers {
            let state = rebuild.states.entry(object.clone()).or_default();
            state.catch_up(&numbers);
        }
        rebuild.faults.sort();
        Ok(rebuild)
    }

    /// The object whose folder a record lies in.
    fn object_of(&self, path: &Path) -> Result<(ObjectName, String), String> {
        let names = self.names(path);
        let [_, collection, object, file] = names.as_slice() else {
            return Err("it lies at an unknown place".to_owned());
        };
        let object = format!("{collection}/{object}")
            .parse()
            .map_err(|error| format!("its folder is no object's name: {error}"))?;
        Ok((object, file.clone()))
    }

    /// The inner error says why the record cannot be used; none when it is gone.
    async fn read_state(
        &self,
        path: &Path,
    ) -> Result<Option<Read<(ObjectName, ObjectState)>>, RegistryError> {
        let Some(bytes) = self.read_small(path).await? else {
            return Ok(None);
        };
        let read = self.object_of(path).and_then(|(object, _)| {
            let state = serde_json::from_slice(&bytes).map_err(|error| error.to_string())?;
            Ok((object, state))
        });
        Ok(Some(read))
    }

    /// The inner error says why the record cannot be used; none when it is gone.
    async fn read_version(
        &self,
        path: &Path,
        states: &BTreeMap<ObjectName, ObjectState>,
    ) -> Result<Option<Read<Published>>, RegistryError> {
        let Some(bytes) = self.read_small(path).await? else {
            return Ok(None);
        };
        let parsed = self.object_of(path).and_then(|(object, file)| {
            let record: VersionRecord =
                serde_json::from_slice(&bytes).map_err(|error| error.to_string())?;
            if record.object == object && file == format!("v{}.json", record.version) {
                Ok(record)
            } else {
                Err("its content names another object or version".to_owned())
            }
        });
        let record = match parsed {
            Ok(record) => record,
            Err(reason) => return Ok(Some(Err(reason))),
        };
        let manifest = match self.manifest(&record.manifest_digest).await {
            Ok(Some(bytes)) => Manifest::decode(&bytes).map_err(|error| error.to_string()),
            Ok(None) => Err(format!("manifest {} is absent", record.manifest_digest)),
            Err(error @ RegistryError::Damaged { .. }) => Err(error.to_string()),
            Err(error) => return Err(error),
        };
        let manifest = match manifest {
            Ok(manifest) if manifest.kind() == Kind::Bundle => manifest,
            Ok(_) => {
                let reason = format!("manifest {} is no bundle's", record.manifest_digest);
                return Ok(Some(Err(reason)));
            }
            Err(reason) => return Ok(Some(Err(reason))),
        };
        let retired = states
            .get(&record.object)
            .is_some_and(|state| state.retired.contains(&record.version));
        if !retired {
            match self.check_blobs(&manifest).await {
                Ok(()) => {}
                Err(error @ RegistryError::BlobsMissing { .. }) => {
                    return Ok(Some(Err(error.to_string())));
                }
                Err(error) => return Err(error),
            }
        }
        Ok(Some(Ok(Published {
            file_count: manifest.files().len() as u32,
            record,
        })))
    }
}

/// A record, or why it cannot be used.
type Read<T> = Result<T, String>;

fn to_json<T: Serialize>(path: &Path, value: &T) -> Result<Bytes, RegistryError> {
    let mut bytes = serde_json::to_vec_pretty(value).map_err(|error| RegistryError::Damaged {
        path: path.to_string(),
        reason: error.to_string(),
    })?;
    bytes.push(b'\n');
    Ok(bytes.into())
}
