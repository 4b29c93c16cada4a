//! What earlier runs found out, so that the next one need not: checksums of files, and uploads that were cut off.
//!
//! It lies in the user's cache folder (`XDG_CACHE_HOME/ign`, `~/.cache/ign`), one file per folder of photographs and one
//! per open upload. Removing it costs time and nothing else; where it cannot be written, nothing is remembered.
//!
//! Invariant: a remembered checksum is used only for the very bytes it was computed from. A file counts as unchanged
//! while its size, its inode, and its times of modification and of change are the same; the latter is the system's and
//! cannot be set. A file that changed within [`SETTLED`] of being read is not remembered, because a write in the same
//! tick of the clock would not show.

use std::collections::BTreeMap;
use std::fs::{File, Metadata};
use std::io::{Read as _, Write as _};
use std::os::unix::fs::MetadataExt as _;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use chrono::Utc;
use ign_proto::{Digest, ObjectName};
use serde::{Deserialize, Serialize};
use sha2::digest::DynDigest;

const SHA256: &str = "sha256";
/// Coarser than the clock of any file system that photographs lie on.
const SETTLED: chrono::TimeDelta = chrono::TimeDelta::seconds(2);

/// The folder; none where the user has no cache folder.
fn folder(name: &str) -> Option<PathBuf> {
    let set = |name: &str| std::env::var_os(name).filter(|value| !value.is_empty());
    let base = set("XDG_CACHE_HOME")
        .map(PathBuf::from)
        .or_else(|| set("HOME").map(|home| Path::new(&home).join(".cache")))?;
    Some(base.join("ign").join(name))
}

/// Written aside and renamed: whoever reads sees all of it or none. That it failed is no fault of the user's work.
fn write(file: &Path, bytes: &[u8]) {
    let Some(folder) = file.parent() else { return };
    let written = std::fs::create_dir_all(folder).and_then(|()| {
        let mut aside = tempfile::NamedTempFile::new_in(folder)?;
        aside.write_all(bytes)?;
        aside.persist(file).map_err(|error| error.error)
    });
    written.map(drop).ok();
}

/// A name for a file here that depends on `what`.
fn name_of(what: &str) -> String {
    Digest::of(what.as_bytes()).hex()[..40].to_string()
}

/// How a file stood when it was read.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
struct Stamp {
    size: u64,
    device: u64,
    inode: u64,
    modified: (i64, i64),
    changed: (i64, i64),
}

impl Stamp {
    fn of(meta: &Metadata) -> Self {
        Self {
            size: meta.size(),
            device: meta.dev(),
            inode: meta.ino(),
            modified: (meta.mtime(), meta.mtime_nsec()),
            changed: (meta.ctime(), meta.ctime_nsec()),
        }
    }

    fn is_settled(&self) -> bool {
        (Utc::now() - SETTLED).timestamp() > self.changed.0.max(self.modified.0)
    }
}

/// A file's checksums by algorithm, in hexadecimal.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct Entry {
    stamp: Stamp,
    sums: BTreeMap<String, String>,
}

type Table = BTreeMap<String, Entry>;

/// Checksums of the files of some folders, those of earlier runs and those of this one.
#[derive(Debug, Default)]
pub(crate) struct Checksums {
    tables: Mutex<BTreeMap<PathBuf, (Table, bool)>>,
}

/// What was read of a file.
pub(crate) struct Read {
    pub(crate) size_bytes: u64,
    sums: BTreeMap<String, String>,
}

impl Read {
    /// Its checksum under an algorithm that was asked for.
    pub(crate) fn sum(&self, algorithm: &str) -> &str {
        self.sums.get(algorithm).map_or("", String::as_str)
    }

    pub(crate) fn sha256(&self) -> Option<Digest> {
        format!("sha256:{}", self.sum(SHA256)).parse().ok()
    }
}

impl Checksums {
    /// The SHA-256 of a file and its checksum under `also`, read in one pass or remembered; `heard` hears of the bytes.
    pub(crate) fn of(
        &self,
        file: &Path,
        also: Option<&str>,
        heard: &impl Fn(u64),
    ) -> std::io::Result<Read> {
        let wanted: Vec<&str> = std::iter::once(SHA256).chain(also).collect();
        let mut reader = File::open(file)?;
        let stamp = Stamp::of(&reader.metadata()?);
        let place = std::path::absolute(file)?;
        let (parent, name) = (
            place.parent().unwrap_or(Path::new("/")).to_path_buf(),
            place
                .file_name()
                .unwrap_or_default()
                .to_str()
                .map(str::to_string),
        );
        if let Some(entry) = name
            .as_ref()
            .and_then(|name| self.remembered(&parent, name))
            && entry.stamp == stamp
            && wanted
                .iter()
                .all(|algorithm| entry.sums.contains_key(*algorithm))
        {
            heard(stamp.size);
            return Ok(Read {
                size_bytes: stamp.size,
                sums: entry.sums,
            });
        }
        let mut hashes: BTreeMap<&str, Box<dyn DynDigest>> = wanted
            .into_iter()
            .map(|algorithm| (algorithm, hash(algorithm)))
            .collect();
        let mut buffer = vec![0; 1 << 18];
        let mut size_bytes = 0;
        loop {
            let count = reader.read(&mut buffer)?;
            if count == 0 {
                break;
            }
            for hash in hashes.values_mut() {
                hash.update(&buffer[..count]);
            }
            size_bytes += count as u64;
            heard(count as u64);
        }
        let sums: BTreeMap<String, String> = hashes
            .into_iter()
            .map(|(algorithm, hash)| (algorithm.to_string(), hex::encode(hash.finalize())))
            .collect();
        let untouched = Stamp::of(&reader.metadata()?) == stamp && size_bytes == stamp.size;
        if let Some(name) = name.filter(|_| untouched && stamp.is_settled()) {
            let sums = sums.clone();
            self.remember(&parent, name, Entry { stamp, sums });
        }
        Ok(Read { size_bytes, sums })
    }

    fn tables(&self) -> std::sync::MutexGuard<'_, BTreeMap<PathBuf, (Table, bool)>> {
        self.tables.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn remembered(&self, parent: &Path, name: &str) -> Option<Entry> {
        let mut tables = self.tables();
        if !tables.contains_key(parent) {
            tables.insert(parent.to_path_buf(), (load(parent), false));
        }
        tables.get(parent)?.0.get(name).cloned()
    }

    fn remember(&self, parent: &Path, name: String, entry: Entry) {
        let mut tables = self.tables();
        let (table, changed) = tables.entry(parent.to_path_buf()).or_default();
        table.insert(name, entry);
        *changed = true;
    }
}

impl Drop for Checksums {
    /// Keeps what is new for the next run.
    fn drop(&mut self) {
        for (parent, (table, changed)) in self.tables().iter() {
            if let (true, Some(file)) = (*changed, table_file(parent))
                && let Ok(bytes) = serde_json::to_vec(table)
            {
                write(&file, &bytes);
            }
        }
    }
}

fn table_file(parent: &Path) -> Option<PathBuf> {
    let name = name_of(&parent.to_string_lossy());
    Some(folder("checksums")?.join(format!("{name}.json")))
}

/// What is known of a folder's files; nothing where the table is absent or damaged.
fn load(parent: &Path) -> Table {
    table_file(parent)
        .and_then(|file| std::fs::read(file).ok())
        .and_then(|bytes| serde_json::from_slice(&bytes).ok())
        .unwrap_or_default()
}

fn hash(algorithm: &str) -> Box<dyn DynDigest> {
    match algorithm {
        "sha512" => Box::new(sha2::Sha512::default()),
        "sha1" => Box::new(sha1::Sha1::default()),
        "md5" => Box::new(md5::Md5::default()),
        _ => Box::new(sha2::Sha256::default()),
    }
}

/// An upload session that a later run can go on with.
#[derive(Clone, Debug)]
pub(crate) struct OpenUpload(Option<PathBuf>);

impl OpenUpload {
    /// That of a blob of an object on a server.
    pub(crate) fn of(server: &str, object: &ObjectName, digest: &Digest) -> Self {
        let name = name_of(&format!("{server}\n{object}\n{digest}"));
        Self(folder("uploads").map(|folder| folder.join(name)))
    }

    /// Where the server keeps it, as it said.
    pub(crate) fn location(&self) -> Option<String> {
        std::fs::read_to_string(self.0.as_ref()?).ok()
    }

    pub(crate) fn remember(&self, location: &str) {
        if let Some(file) = &self.0 {
            write(file, location.as_bytes());
        }
    }

    pub(crate) fn forget(&self) {
        if let Some(file) = &self.0 {
            std::fs::remove_file(file).ok();
        }
    }
}
