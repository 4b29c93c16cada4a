//! Publishing a bundle, and the bucket's copy of what is published.
//!
//! Order of a publish, each step idempotent, so that a call cut anywhere is repeated by the worker:
//!
//! 1. Every blob is there with its size.
//! 2. The manifest is written; nobody names it yet.
//! 3. The database, under the job's row lock and after checking the attempt, makes it version N and ends the job. This
//!    alone is the commit.
//! 4. The bucket gets the version's record. That it is the latest now, the record says by itself.
//!
//! What users name and retire gets to the bucket as the object's state, as the database has it at that time; it is read
//! again afterwards until both agree, so that two writers end at the newer state. A crash between a commit and its copy is
//! repaired by [`App::mirror_all`] at start; a store that failed is tried again by the maintenance task.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Mutex;

use futures::stream::{self, StreamExt as _};
use ign_proto::{Attempt, JobId, Manifest, ObjectName};
use ign_queue::{NewVersion, Standing, Version, VersionFilter};
use ign_registry::{ObjectState, VersionRecord};

use crate::app::App;
use crate::http_answer::Refused;

const OBJECTS_IN_FLIGHT: usize = 8;

/// Objects whose copy in the bucket is behind.
#[derive(Debug, Default)]
pub(crate) struct Mirror {
    behind: Mutex<BTreeSet<ObjectName>>,
}

impl Mirror {
    fn behind(&self) -> std::sync::MutexGuard<'_, BTreeSet<ObjectName>> {
        self.behind
            .lock()
            .unwrap_or_else(std::sync::PoisonError::into_inner)
    }
}

impl App {
    /// Makes the bundle the object's next version and ends the job; the same call again gives the same version.
    pub(crate) async fn publish(
        &self,
        job: JobId,
        attempt: Attempt,
        manifest: &Manifest,
        metrics_json: String,
    ) -> Result<Version, Refused> {
        let manifest_digest = self.registry.put_manifest(manifest).await?;
        let bundle = NewVersion {
            manifest_digest,
            size_bytes: manifest.size_bytes(),
            file_count: manifest.files().len() as u32,
            metrics_json,
        };
        let version = self
            .store
            .publish_and_complete(job, attempt, bundle)
            .await?;
        ign_faults::point("publish.committed");
        let recorded = self.registry.put_version(&record(&version)).await;
        self.retry_later(&version.object, recorded.map_err(Refused::from));
        Ok(version)
    }

    /// Brings the bucket's copy of what users may change of an object up to date.
    pub(crate) async fn mirror(&self, object: &ObjectName) {
        let mirrored = self.mirror_state(object).await;
        self.retry_later(object, mirrored);
    }

    /// A failure is logged and mended later: what the database committed stands.
    fn retry_later(&self, object: &ObjectName, outcome: Result<(), Refused>) {
        if let Err(Refused(cause)) = outcome {
            tracing::warn!(object = %object, error = %cause, "the bucket's record of versions is behind; trying again later");
            self.mirror.behind().insert(object.clone());
        }
    }

    async fn restore(&self, versions: &[Version]) -> Result<(), Refused> {
        for version in versions {
            self.registry.restore_version(&record(version)).await?;
        }
        Ok(())
    }

    async fn mirror_state(&self, object: &ObjectName) -> Result<(), Refused> {
        let mut standing = self.store.standing(object).await?;
        loop {
            self.registry.put_state(object, &state(&standing)).await?;
            let now = self.store.standing(object).await?;
            if now == standing {
                return Ok(());
            }
            standing = now;
        }
    }

    /// Repairs the bucket's copy of every object.
    pub(crate) async fn mirror_all(&self) {
        if let Err(Refused(cause)) = self.mirror_those(VersionFilter::default()).await {
            tracing::warn!(error = %cause, "could not list versions to check the bucket's record of them");
        }
    }

    /// Tries again what failed.
    pub(crate) async fn mirror_behind(&self) {
        let behind = std::mem::take(&mut *self.mirror.behind());
        for object in behind {
            let of_object = VersionFilter {
                collection: Some(object.collection.clone()),
                object: Some(object.object.clone()),
                ..VersionFilter::default()
            };
            if let Err(Refused(cause)) = self.mirror_those(of_object).await {
                tracing::warn!(object = %object, error = %cause, "could not list an object's versions");
                self.mirror.behind().insert(object);
            }
        }
    }

    async fn mirror_those(&self, those: VersionFilter) -> Result<(), Refused> {
        let all = VersionFilter {
            include_retired: true,
            ..those
        };
        let mut objects: BTreeMap<ObjectName, Vec<Version>> = BTreeMap::new();
        for version in self.store.versions(&all).await? {
            objects
                .entry(version.object.clone())
                .or_default()
                .push(version);
        }
        stream::iter(objects)
            .for_each_concurrent(OBJECTS_IN_FLIGHT, |(object, versions)| async move {
                let restored = self.restore(&versions).await;
                self.retry_later(&object, restored);
                self.mirror(&object).await;
            })
            .await;
        Ok(())
    }
}

fn record(version: &Version) -> VersionRecord {
    VersionRecord {
        object: version.object.clone(),
        version: version.version,
        manifest_digest: version.bundle.manifest_digest.clone(),
        size_bytes: version.bundle.size_bytes,
        job_id: version.job,
        created_at: version.created_at,
        metrics_json: version.bundle.metrics_json.clone(),
    }
}

fn state(standing: &Standing) -> ObjectState {
    let retired_at = standing
        .retired
        .iter()
        .filter_map(|(version, at)| Some((*version, (*at)?)))
        .collect();
    ObjectState {
        newest: standing.newest,
        aliases: standing.aliases.clone(),
        retired: standing.retired.keys().copied().collect(),
        retired_at,
    }
}
