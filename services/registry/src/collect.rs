//! Garbage collection: what nothing names goes, slowly.
//!
//! Two steps, each after a whole grace: content that nothing names and that was written longer ago than the grace moves
//! into the trash ([`crate::trash`]); what has been there for longer than the grace, and is still not named, is deleted.
//!
//! What is named: the files of every manifest that the caller keeps or that was written lately (a capture whose submit
//! has not come yet, a bundle whose publish has not), and single blobs that the caller keeps. Parts of running uploads
//! are no blobs yet and are not touched. A manifest that is kept but cannot be read stops the collection before anything
//! moves, and so does a version that the bucket records and the caller does not know.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use chrono::{DateTime, Utc};
use futures::{StreamExt as _, TryStreamExt as _};
use ign_proto::manifest::EMPTY_CONFIG;
use ign_proto::{Digest, Manifest, ObjectName};
use object_store::{ObjectMeta, ObjectStoreExt as _};

use crate::blobs::Content;
use crate::error::RegistryError;
use crate::store::Registry;

const IN_FLIGHT: usize = 16;

/// What a collection spares.
#[derive(Clone, Debug, Default)]
pub struct Keep {
    /// Manifests that stay with all their files.
    pub manifests: BTreeSet<Digest>,
    /// Single blobs that stay.
    pub blobs: BTreeSet<Digest>,
    /// Every version ever published with its manifest. The manifest stays; its files only if they are named above.
    pub versions: BTreeMap<(ObjectName, u32), Digest>,
}

/// A number of objects and their bytes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Tally {
    /// How many.
    pub objects: u64,
    /// Their sizes' sum.
    pub bytes: u64,
}

impl Tally {
    pub(crate) fn add(&mut self, bytes: u64) {
        self.objects += 1;
        self.bytes += bytes;
    }
}

/// What a collection did, or would do. Every object counts once, as it was found.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Collected {
    /// Named: stays.
    pub named: Tally,
    /// Not named, but younger than the grace: stays for now.
    pub young: Tally,
    /// Moved into the trash.
    pub trashed: Tally,
    /// Was in the trash, and stays there for now.
    pub waiting: Tally,
    /// Was in the trash and is named: moved back.
    pub rescued: Tally,
    /// Deleted from the trash.
    pub deleted: Tally,
}

impl Registry {
    /// Collects what `keep` does not spare; a dry run only counts. See the module's text for what that means.
    pub async fn collect(
        &self,
        keep: &Keep,
        grace: Duration,
        dry_run: bool,
    ) -> Result<Collected, RegistryError> {
        let now = self.now().await;
        let old = |at: DateTime<Utc>| (now - at).to_std().is_ok_and(|age| age >= grace);
        self.check_versions(keep).await?;
        let versions: BTreeSet<&Digest> = keep.versions.values().collect();
        let mut collected = Collected::default();
        let mut live = keep.blobs.clone();
        live.insert(Digest::of(EMPTY_CONFIG));
        let mut unnamed: Vec<(Content, Digest, u64)> = Vec::new();

        // Looked at first: whoever reads a manifest takes it back from there.
        let in_trash = self.trash().await?;
        let mut manifests = keep.manifests.clone();
        for (digest, meta) in self.contents(Content::Manifest).await? {
            if keep.manifests.contains(&digest) || versions.contains(&digest) {
                collected.named.add(meta.size);
            } else if old(meta.last_modified) {
                unnamed.push((Content::Manifest, digest, meta.size));
            } else {
                collected.young.add(meta.size);
                manifests.insert(digest);
            }
        }
        let files: Vec<Vec<Digest>> = futures::stream::iter(manifests.clone())
            .map(|digest| async move { self.files_of(&digest).await })
            .buffer_unordered(IN_FLIGHT)
            .try_collect()
            .await?;
        live.extend(files.into_iter().flatten());
        for (digest, meta) in self.contents(Content::Blob).await? {
            if live.contains(&digest) {
                collected.named.add(meta.size);
            } else if old(meta.last_modified) {
                unnamed.push((Content::Blob, digest, meta.size));
            } else {
                collected.young.add(meta.size);
            }
        }

        // First what makes room: in a full store there is none to move things.
        for trashed in in_trash {
            let named = match trashed.content {
                Content::Blob => live.contains(&trashed.digest),
                Content::Manifest => manifests.contains(&trashed.digest),
            };
            if named {
                collected.rescued.add(trashed.size_bytes);
                if !dry_run
                    && self
                        .size_of(trashed.content, &trashed.digest)
                        .await?
                        .is_none()
                {
                    self.rescue(trashed.content, &trashed.digest).await?;
                } else if !dry_run {
                    self.delete(&trashed.path).await?;
                }
            } else if old(trashed.since) {
                collected.deleted.add(trashed.size_bytes);
                if !dry_run {
                    self.delete(&trashed.path).await?;
                }
            } else {
                collected.waiting.add(trashed.size_bytes);
            }
        }
        for (content, digest, size_bytes) in unnamed {
            collected.trashed.add(size_bytes);
            if !dry_run {
                self.discard(content, &digest, now).await?;
            }
        }
        Ok(collected)
    }

    /// Fails if the bucket records a version that is not known.
    async fn check_versions(&self, keep: &Keep) -> Result<(), RegistryError> {
        for (place, path) in self.recorded().await? {
            if !keep.versions.contains_key(&place) {
                return Err(RegistryError::VersionUnknown { path });
            }
        }
        Ok(())
    }

    /// Files of a manifest that is kept.
    async fn files_of(&self, digest: &Digest) -> Result<Vec<Digest>, RegistryError> {
        let damaged = |reason: String| RegistryError::Damaged {
            path: self.content_path(Content::Manifest, digest).to_string(),
            reason,
        };
        let bytes = self
            .manifest(digest)
            .await?
            .ok_or_else(|| damaged("it is named, but absent: audit the registry".to_owned()))?;
        let manifest = Manifest::decode(&bytes).map_err(|error| damaged(error.to_string()))?;
        Ok(manifest
            .files()
            .iter()
            .map(|file| file.digest.clone())
            .collect())
    }

    /// Everything of one sort, by digest.
    pub(crate) async fn contents(
        &self,
        content: Content,
    ) -> Result<Vec<(Digest, ObjectMeta)>, RegistryError> {
        let metas = self.list(&self.path(content.folder())).await?;
        Ok(metas
            .into_iter()
            .filter_map(|meta| {
                let hex = meta.location.filename()?;
                Some((format!("sha256:{hex}").parse().ok()?, meta))
            })
            .collect())
    }

    /// The store's clock, by which ages are judged; this machine's when the store cannot be written.
    async fn now(&self) -> DateTime<Utc> {
        let path = self.path("probe/clock");
        let read = async {
            self.store.put(&path, "now".into()).await?;
            self.store.head(&path).await
        };
        match read.await {
            Ok(meta) => meta.last_modified,
            Err(error) => {
                tracing::debug!(%error, "the store's clock cannot be read; taking this machine's");
                Utc::now()
            }
        }
    }
}
