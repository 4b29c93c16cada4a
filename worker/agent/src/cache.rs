//! Captures and checkpoints that this worker has fetched, by content.
//!
//! `blobs/<hex>` holds whole, verified files; `partial/<hex>` the start of files whose transfer broke off, so that
//! it goes on where it stopped. Jobs get hard links, never the cached file itself. The cache is bounded: before a
//! fetch the least recently used blobs go (use is kept as the file's modification time). What the fetching job needs
//! is never evicted, even when it alone is larger than the bound. One job fetches at a time; the links of the others
//! keep what they need.

use std::collections::HashSet;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use ign_proto::Digest;

use crate::error::TransferError;
use crate::files;

/// Room left for the job's own output.
const MARGIN_BYTES: u64 = 64 << 20;

#[derive(Clone, Debug)]
pub(crate) struct Cache {
    blobs: PathBuf,
    partial: PathBuf,
    max_bytes: u64,
}

impl Cache {
    pub(crate) fn open(root: &Path, max_bytes: u64) -> std::io::Result<Self> {
        let cache = Self {
            blobs: root.join("blobs"),
            partial: root.join("partial"),
            max_bytes,
        };
        std::fs::create_dir_all(&cache.blobs)?;
        std::fs::create_dir_all(&cache.partial)?;
        Ok(cache)
    }

    pub(crate) fn blob(&self, digest: &Digest) -> PathBuf {
        self.blobs.join(digest.hex())
    }

    pub(crate) fn partial(&self, digest: &Digest) -> PathBuf {
        self.partial.join(digest.hex())
    }

    /// Whether the blob is there and still has its content; marks it as used. A damaged one is removed.
    pub(crate) fn holds(&self, digest: &Digest) -> bool {
        let path = self.blob(digest);
        let Ok(file) = std::fs::File::open(&path) else {
            return false;
        };
        if files::digest(&path).is_ok_and(|(found, _)| found == *digest) {
            // Only the order of eviction suffers when this fails.
            file.set_modified(SystemTime::now()).ok();
            return true;
        }
        std::fs::remove_file(&path).ok();
        false
    }

    /// Takes over a partial file that is now whole and verified.
    pub(crate) fn commit(&self, digest: &Digest) -> Result<(), TransferError> {
        let (from, to) = (self.partial(digest), self.blob(digest));
        // Jobs share the file through links: nobody writes to it any more.
        std::fs::metadata(&from)
            .and_then(|metadata| {
                let mut permissions = metadata.permissions();
                permissions.set_readonly(true);
                std::fs::set_permissions(&from, permissions)?;
                std::fs::rename(&from, &to)
            })
            .map_err(|source| TransferError::file("store", &to, source))
    }

    /// Makes room for `needed` more bytes, both under the bound and on the disk, without touching what is in `keep`.
    pub(crate) fn make_room(
        &self,
        needed: u64,
        keep: &HashSet<Digest>,
    ) -> Result<(), TransferError> {
        let kept: HashSet<&str> = keep.iter().map(Digest::hex).collect();
        let mut held = 0;
        let mut evictable = Vec::new();
        for dir in [&self.blobs, &self.partial] {
            for (path, length, used_at) in list(dir)? {
                held += length;
                let name = path.file_name().and_then(|name| name.to_str());
                if !name.is_some_and(|name| kept.contains(name)) {
                    evictable.push((used_at, path, length));
                }
            }
        }
        evictable.sort();
        let mut evictable = evictable.into_iter();
        loop {
            let over = held.saturating_add(needed) > self.max_bytes;
            let free = files::free_bytes(&self.blobs);
            let full = free.is_some_and(|free| free < needed.saturating_add(MARGIN_BYTES));
            if !over && !full {
                return Ok(());
            }
            let Some((_, path, length)) = evictable.next() else {
                return if full {
                    Err(TransferError::DiskFull {
                        dir: self.blobs.clone(),
                    })
                } else {
                    Ok(())
                };
            };
            std::fs::remove_file(&path)
                .map_err(|source| TransferError::file("remove", &path, source))?;
            held -= length;
        }
    }
}

/// Files of a folder with length and time of last use.
fn list(dir: &Path) -> Result<Vec<(PathBuf, u64, SystemTime)>, TransferError> {
    let failed = |source| TransferError::file("list", dir, source);
    let mut files = Vec::new();
    for entry in std::fs::read_dir(dir).map_err(failed)? {
        let entry = entry.map_err(failed)?;
        let metadata = entry.metadata().map_err(failed)?;
        let used_at = metadata.modified().unwrap_or(SystemTime::UNIX_EPOCH);
        files.push((entry.path(), metadata.len(), used_at));
    }
    Ok(files)
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    fn store(cache: &Cache, content: &[u8], age_secs: u64) -> Digest {
        let digest = Digest::of(content);
        std::fs::write(cache.partial(&digest), content).unwrap();
        cache.commit(&digest).unwrap();
        let file = std::fs::File::open(cache.blob(&digest)).unwrap();
        file.set_modified(SystemTime::now() - Duration::from_secs(age_secs))
            .unwrap();
        digest
    }

    #[test]
    fn evicts_the_least_recently_used_first_and_never_what_is_needed() {
        let dir = tempfile::tempdir().unwrap();
        let cache = Cache::open(dir.path(), 30).unwrap();
        let old = store(&cache, b"0123456789", 300);
        let older_but_used = store(&cache, b"abcdefghij", 400);
        let kept = store(&cache, b"ABCDEFGHIJ", 500);
        assert!(cache.holds(&older_but_used));
        cache.make_room(10, &HashSet::from([kept.clone()])).unwrap();
        assert!(!cache.holds(&old));
        assert!(cache.holds(&older_but_used));
        assert!(cache.holds(&kept));

        // A job larger than the bound still gets its place.
        cache
            .make_room(1000, &HashSet::from([kept.clone()]))
            .unwrap();
        assert!(!cache.holds(&older_but_used));
        assert!(cache.holds(&kept));
    }

    #[test]
    fn a_disk_that_is_too_small_is_said_before_the_transfer() {
        let dir = tempfile::tempdir().unwrap();
        let cache = Cache::open(dir.path(), u64::MAX).unwrap();
        let error = cache.make_room(u64::MAX / 2, &HashSet::new()).unwrap_err();
        assert!(
            error.to_string().starts_with("no space left in "),
            "{error}"
        );
        assert_eq!(error.failure().kind, ign_events::FailureKind::Transient);
    }

    #[test]
    fn damage_on_disk_is_noticed() {
        let dir = tempfile::tempdir().unwrap();
        let cache = Cache::open(dir.path(), 100).unwrap();
        let digest = store(&cache, b"content", 0);
        std::fs::remove_file(cache.blob(&digest)).unwrap();
        std::fs::write(cache.blob(&digest), b"c0ntent").unwrap();
        assert!(!cache.holds(&digest));
        assert!(!cache.blob(&digest).exists());
    }
}
