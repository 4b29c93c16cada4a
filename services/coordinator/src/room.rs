//! Room on the disks of a local store and database: new work is refused before they are full.
//!
//! Below the reserve no capture, submit or lease is taken, so that what runs has room for its result. Below half of it
//! no blob is taken either, so that the database can always write: cancelling, retiring and collecting garbage work on.
//! A bucket does not say how much room it has; its refusals come as [`ign_registry::RegistryError::Full`].

use std::path::{Path, PathBuf};

use ign_proto::Cause;

use crate::config::Config;
use crate::http_answer::Refused;

/// What is to be written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Write {
    /// The beginning of something: a capture, a job.
    Work,
    /// Bytes, of something new or of what runs.
    Blob {
        /// How many, where that is known.
        bytes: u64,
    },
}

/// The folders whose disks are watched.
#[derive(Debug)]
pub(crate) struct Room {
    folders: Vec<PathBuf>,
    reserve_bytes: u64,
}

impl Room {
    pub(crate) fn new(config: &Config) -> Self {
        let store = config.store.url.strip_prefix("file://").map(PathBuf::from);
        let database = config
            .database
            .strip_prefix("sqlite://")
            .and_then(|path| PathBuf::from(path).parent().map(PathBuf::from));
        Self {
            folders: store.into_iter().chain(database).collect(),
            reserve_bytes: config.care.reserve_bytes,
        }
    }

    /// The folders that are watched, with the free bytes of their disks where these say.
    pub(crate) fn free(&self) -> impl Iterator<Item = (&Path, u64)> {
        self.folders.iter().filter_map(|folder| {
            // A disk that does not say is not held against the work.
            let stat = rustix::fs::statvfs(folder).ok()?;
            Some((
                folder.as_path(),
                stat.f_bavail.saturating_mul(stat.f_frsize),
            ))
        })
    }

    /// Fails while there is too little room for a write.
    pub(crate) fn check(&self, write: Write) -> Result<(), Refused> {
        let (need, reserve) = match write {
            Write::Work => (0, self.reserve_bytes),
            Write::Blob { bytes } => (bytes, self.reserve_bytes / 2),
        };
        for (folder, free) in self.free() {
            if free.saturating_sub(need) < reserve {
                return Err(Cause::Full {
                    message: format!(
                        "the disk of {} is nearly full: {} MB are free, {} MB are kept in reserve; make room, or collect \
                         garbage (ignctl admin gc)",
                        folder.display(),
                        free / 1_000_000,
                        reserve / 1_000_000,
                    ),
                }
                .into());
            }
        }
        Ok(())
    }
}
