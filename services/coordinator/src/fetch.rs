//! What a caller may read of the data plane.
//!
//! All blobs lie in one store, so a path's object says nothing about whose bytes a digest names. A caller with `read`
//! gets what the object's bundles and the captures of its jobs name; a worker gets what the jobs of the object that are
//! leased now need: their capture and their checkpoint. The root token gets everything.

use std::collections::{BTreeSet, VecDeque};
use std::sync::{Arc, Mutex, PoisonError};

use ign_proto::manifest::EMPTY_CONFIG;
use ign_proto::{Cause, Digest, Manifest, ObjectName, Scope};
use ign_queue::store::MAX_PAGE;
use ign_queue::{Job, JobFilter, JobState, VersionFilter};

use crate::access::Caller;
use crate::app::App;
use crate::http_answer::Refused;

/// Manifests whose digests are remembered: what they name never changes.
const MAX_MANIFESTS: usize = 64;

/// The files of the manifests that were asked for last.
#[derive(Debug, Default)]
pub(crate) struct Contents(Mutex<VecDeque<(Digest, Arc<BTreeSet<Digest>>)>>);

impl Contents {
    fn get(&self, manifest: &Digest) -> Option<Arc<BTreeSet<Digest>>> {
        let known = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let found = known.iter().find(|(digest, _)| digest == manifest)?;
        Some(found.1.clone())
    }

    fn put(&self, manifest: Digest, files: Arc<BTreeSet<Digest>>) {
        let mut known = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if known.len() >= MAX_MANIFESTS {
            known.pop_front();
        }
        known.push_back((manifest, files));
    }
}

/// What is to be read.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Item<'a> {
    Manifest(&'a Digest),
    Blob(&'a Digest),
}

impl App {
    /// Refuses unless the caller may read this of the object. What it may not read does not exist for it.
    pub(crate) async fn may_fetch(
        &self,
        caller: &Caller,
        object: &ObjectName,
        item: Item<'_>,
    ) -> Result<(), Refused> {
        if caller.may_everywhere(Scope::Admin) {
            return Ok(());
        }
        let mut manifests = BTreeSet::new();
        let mut blobs = BTreeSet::from([Digest::of(EMPTY_CONFIG)]);
        if caller.may(Scope::Read, &object.collection) {
            let filter = VersionFilter {
                collection: Some(object.collection.clone()),
                object: Some(object.object.clone()),
                include_retired: true,
            };
            let versions = self.store.versions(&filter).await?;
            manifests.extend(versions.into_iter().map(|it| it.bundle.manifest_digest));
            let jobs = self.jobs_of(object, Vec::new()).await?;
            manifests.extend(jobs.into_iter().map(|job| job.spec.capture_digest));
        } else {
            for job in self.jobs_of(object, vec![JobState::Leased]).await? {
                blobs.extend(job.checkpoint.map(|checkpoint| checkpoint.digest));
                manifests.insert(job.spec.capture_digest);
            }
        }
        let (kind, digest) = match item {
            Item::Manifest(digest) => {
                if manifests.contains(digest) {
                    return Ok(());
                }
                ("manifest", digest)
            }
            Item::Blob(digest) => {
                if blobs.contains(digest) || self.any_names(&manifests, digest).await? {
                    return Ok(());
                }
                ("blob", digest)
            }
        };
        Err(Cause::absent(kind, digest).into())
    }

    async fn jobs_of(
        &self,
        object: &ObjectName,
        states: Vec<JobState>,
    ) -> Result<Vec<Job>, Refused> {
        let filter = JobFilter {
            collection: Some(object.collection.clone()),
            object: Some(object.object.clone()),
            states,
            ..JobFilter::default()
        };
        Ok(self.store.list(&filter, None, MAX_PAGE).await?.jobs)
    }

    async fn any_names(
        &self,
        manifests: &BTreeSet<Digest>,
        blob: &Digest,
    ) -> Result<bool, Refused> {
        for manifest in manifests {
            let files = if let Some(files) = self.contents.get(manifest) {
                files
            } else {
                let Some(bytes) = self.registry.manifest(manifest).await? else {
                    continue;
                };
                let decoded = Manifest::decode(&bytes)?;
                let files = decoded.files().iter();
                let files = Arc::new(files.map(|file| file.digest.clone()).collect());
                self.contents.put(manifest.clone(), Arc::clone(&files));
                files
            };
            if files.contains(blob) {
                return Ok(true);
            }
        }
        Ok(false)
    }
}
