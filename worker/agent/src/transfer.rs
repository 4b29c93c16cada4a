//! Whole transfers of a job: its capture and checkpoint onto this machine, its results to the store.
//!
//! Transfers go on through outages: a try that failed in passing is followed by another one, and bytes that arrived
//! are not sent again. The caller stops a transfer by dropping its future.

use std::collections::{BTreeMap, HashSet};
use std::path::Path;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::time::Duration;

use futures::future::BoxFuture;
use futures::{FutureExt, StreamExt, TryStreamExt};
use ign_proto::{Digest, FileEntry, FilePath, Kind, Manifest, ObjectName};
use tokio::time::Instant;

use crate::backoff::Backoff;
use crate::cache::Cache;
use crate::data_plane::{DataPlane, UploadSession};
use crate::error::TransferError;
use crate::files;

/// Transfers at the same time.
const PARALLEL: usize = 4;
/// A transfer that moved no byte for so long is given up.
const PATIENCE: Duration = Duration::from_mins(15);
/// Damaged arrivals in a row before the blob itself is taken to be damaged.
const MAX_DAMAGED: u32 = 5;

/// Moves files and says what it does.
pub(crate) struct Transfer<'a> {
    pub(crate) data: &'a DataPlane,
    pub(crate) cache: &'a Cache,
    pub(crate) object: &'a ObjectName,
    /// Hears of tries that failed and are repeated.
    pub(crate) note: &'a (dyn Fn(&str) + Sync),
    /// Hears how far the transfer is: done, of all, in words.
    pub(crate) progress: &'a (dyn Fn(&str) + Sync),
}

impl Transfer<'_> {
    /// Puts the capture's files into `dir` and, if there is one, the checkpoint beside them. A checkpoint that the
    /// store lost or damaged is reported and left out: the bake then starts from zero.
    pub(crate) async fn fetch_capture(
        &self,
        digest: &Digest,
        checkpoint: Option<&Digest>,
        dir: &Path,
    ) -> Result<(), TransferError> {
        let moved = AtomicU64::new(0);
        let bytes = self
            .persist(&moved, || self.data.manifest(self.object, digest).boxed())
            .await?;
        let unusable = |reason: String| TransferError::Manifest {
            digest: digest.to_string(),
            reason,
        };
        let manifest = Manifest::decode(&bytes).map_err(|error| unusable(error.to_string()))?;
        if manifest.kind() != Kind::Capture {
            return Err(unusable("it describes no capture".to_owned()));
        }

        let wanted: BTreeMap<Digest, u64> = manifest
            .files()
            .iter()
            .map(|file| (file.digest.clone(), file.size_bytes))
            .collect();
        let keep: HashSet<Digest> = wanted.keys().cloned().chain(checkpoint.cloned()).collect();
        let cache = self.cache.clone();
        let missing = files::blocking(move || {
            let missing: Vec<(Digest, u64)> = wanted
                .into_iter()
                .filter(|(digest, _)| !cache.holds(digest))
                .collect();
            let needed = missing.iter().map(|(_, size)| size).sum();
            cache.make_room(needed, &keep).map(|()| missing)
        })
        .await??;
        let total: u64 = missing.iter().map(|(_, size)| size).sum();
        let received = |count: u64| {
            let moved = moved.fetch_add(count, Ordering::Relaxed) + count;
            (self.progress)(&format!(
                "fetching the capture: {} of {} MB",
                moved.min(total) / 1_000_000,
                total.div_ceil(1_000_000)
            ));
        };
        let fetches = missing
            .iter()
            .map(|(digest, size)| self.fetch(digest, Some(*size), &moved, &received).boxed());
        all(fetches.collect()).await?;
        let (cache, dir) = (self.cache.clone(), dir.to_path_buf());
        let digest = digest.to_string();
        files::blocking(move || lay_out(&cache, &manifest, &digest, &dir)).await?
    }

    /// Puts the checkpoint at `path`; `false` when the store has lost it.
    pub(crate) async fn fetch_checkpoint(
        &self,
        digest: &Digest,
        path: &Path,
    ) -> Result<bool, TransferError> {
        let (cache, wanted) = (self.cache.clone(), digest.clone());
        if !files::blocking(move || cache.holds(&wanted)).await? {
            let moved = AtomicU64::new(0);
            let received = |count| {
                moved.fetch_add(count, Ordering::Relaxed);
            };
            match self.fetch(digest, None, &moved, &received).await {
                Ok(()) => {}
                Err(error @ (TransferError::Missing { .. } | TransferError::Damaged { .. })) => {
                    (self.note)(&format!(
                        "starting from zero: the checkpoint is lost: {error}"
                    ));
                    return Ok(false);
                }
                Err(error) => return Err(error),
            }
        }
        let (from, to) = (self.cache.blob(digest), path.to_path_buf());
        files::blocking(move || files::link_or_copy(&from, &to)).await??;
        Ok(true)
    }

    async fn fetch(
        &self,
        digest: &Digest,
        size_bytes: Option<u64>,
        moved: &AtomicU64,
        received: &(dyn Fn(u64) + Sync),
    ) -> Result<(), TransferError> {
        let partial = self.cache.partial(digest);
        self.persist(moved, || {
            self.data
                .fetch(self.object, digest, size_bytes, &partial, received)
                .boxed()
        })
        .await?;
        self.cache.commit(digest)
    }

    /// Sends every file of the bundle in `dir` and returns what a manifest says about them.
    pub(crate) async fn send_bundle(&self, dir: &Path) -> Result<Vec<FileEntry>, TransferError> {
        let root = dir.to_path_buf();
        let entries = files::blocking(move || bundle_files(&root)).await??;
        let sent = AtomicUsize::new(0);
        let count = entries.len();
        let sends = entries.iter().map(|entry| {
            let sent = &sent;
            async move {
                let path = dir.join(entry.path.as_str());
                self.send(&path, &entry.digest, entry.size_bytes).await?;
                let sent = sent.fetch_add(1, Ordering::Relaxed) + 1;
                (self.progress)(&format!("sending the bundle: {sent} of {count} files"));
                Ok(())
            }
            .boxed()
        });
        all(sends.collect()).await?;
        Ok(entries)
    }

    async fn send(
        &self,
        path: &Path,
        digest: &Digest,
        size_bytes: u64,
    ) -> Result<(), TransferError> {
        let session = UploadSession::default();
        let moved = AtomicU64::new(0);
        self.persist(&moved, || {
            self.data
                .push(self.object, path, digest, size_bytes, &session)
                .boxed()
        })
        .await?;
        Ok(())
    }

    /// Tries until it goes well, fails for good, or nothing `moved` for a long time.
    async fn persist<'a, T>(
        &self,
        moved: &AtomicU64,
        attempt: impl Fn() -> BoxFuture<'a, Result<T, TransferError>>,
    ) -> Result<T, TransferError> {
        let mut backoff = Backoff::default();
        let mut damaged = 0;
        let mut last_moved = moved.load(Ordering::Relaxed);
        let mut patience = Instant::now() + PATIENCE;
        loop {
            let error = match attempt().await {
                Ok(value) => return Ok(value),
                Err(error) if error.is_passing() => error,
                Err(error) => return Err(error),
            };
            damaged += u32::from(matches!(error, TransferError::Damaged { .. }));
            let now_moved = moved.load(Ordering::Relaxed);
            if now_moved != last_moved {
                last_moved = now_moved;
                patience = Instant::now() + PATIENCE;
                backoff.reset();
            }
            if damaged >= MAX_DAMAGED || Instant::now() >= patience {
                return Err(error);
            }
            (self.note)(&format!("{error}; trying again"));
            tokio::time::sleep(backoff.next_delay()).await;
        }
    }
}

/// Runs transfers side by side until all are done or one fails.
async fn all(
    transfers: Vec<BoxFuture<'_, Result<(), TransferError>>>,
) -> Result<(), TransferError> {
    futures::stream::iter(transfers)
        .buffer_unordered(PARALLEL)
        .try_collect()
        .await
}

/// Links the cached files under their names.
fn lay_out(
    cache: &Cache,
    manifest: &Manifest,
    digest: &str,
    dir: &Path,
) -> Result<(), TransferError> {
    use std::io::ErrorKind;
    for file in manifest.files() {
        let path = dir.join(file.path.as_str());
        let parent = path.parent().unwrap_or(dir);
        std::fs::create_dir_all(parent).map_err(|source| {
            if matches!(
                source.kind(),
                ErrorKind::AlreadyExists | ErrorKind::NotADirectory
            ) {
                return TransferError::Manifest {
                    digest: digest.to_owned(),
                    reason: format!("{} lies below another file", file.path),
                };
            }
            TransferError::file("create", parent, source)
        })?;
        files::link_or_copy(&cache.blob(&file.digest), &path)?;
    }
    Ok(())
}

/// Digest and size of every file below `root`. Links and other special files are refused.
fn bundle_files(root: &Path) -> Result<Vec<FileEntry>, TransferError> {
    let mut entries = Vec::new();
    let mut folders = vec![root.to_path_buf()];
    while let Some(folder) = folders.pop() {
        let failed = |source| TransferError::file("list", &folder, source);
        for entry in std::fs::read_dir(&folder).map_err(failed)? {
            let entry = entry.map_err(failed)?;
            let path = entry.path();
            let kind = entry.file_type().map_err(failed)?;
            if kind.is_dir() {
                folders.push(path);
                continue;
            }
            let unusable = |reason: &str| {
                let source = std::io::Error::other(reason.to_owned());
                TransferError::file("send", &path, source)
            };
            if !kind.is_file() {
                return Err(unusable("it is no ordinary file"));
            }
            let name: FilePath = path
                .strip_prefix(root)
                .ok()
                .and_then(Path::to_str)
                .ok_or_else(|| unusable("its name is not Unicode"))?
                .parse()
                .map_err(|error: ign_proto::IdError| unusable(&error.to_string()))?;
            let (digest, size_bytes) = files::digest(&path)
                .map_err(|source| TransferError::file("read", &path, source))?;
            entries.push(FileEntry {
                media_type: media_type(name.as_str()).to_owned(),
                path: name,
                digest,
                size_bytes,
            });
        }
    }
    entries.sort_by(|a, b| a.path.cmp(&b.path));
    Ok(entries)
}

fn media_type(name: &str) -> &'static str {
    match name.rsplit_once('.').map_or("", |(_, extension)| extension) {
        "json" => "application/json",
        "glb" => "model/gltf-binary",
        "html" => "text/html",
        "png" => "image/png",
        "jpg" | "jpeg" => "image/jpeg",
        "webp" => "image/webp",
        _ => "application/octet-stream",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_bundle_lists_its_files_and_refuses_links() {
        let dir = tempfile::tempdir().unwrap();
        std::fs::create_dir(dir.path().join("references")).unwrap();
        std::fs::write(dir.path().join("bundle.json"), "{}").unwrap();
        std::fs::write(dir.path().join("references/0007.png"), "abc").unwrap();
        let entries = bundle_files(dir.path()).unwrap();
        let listed: Vec<(&str, u64, &str)> = entries
            .iter()
            .map(|entry| (entry.path.as_str(), entry.size_bytes, &*entry.media_type))
            .collect();
        assert_eq!(
            listed,
            [
                ("bundle.json", 2, "application/json"),
                ("references/0007.png", 3, "image/png"),
            ]
        );
        assert_eq!(entries[0].digest, Digest::of(b"{}"));

        std::os::unix::fs::symlink("/etc/passwd", dir.path().join("link")).unwrap();
        let error = bundle_files(dir.path()).unwrap_err();
        assert!(error.failure().message.ends_with("it is no ordinary file"));
    }
}
