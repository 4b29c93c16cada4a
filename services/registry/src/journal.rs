//! Small objects in a folder, made durable many at a time.
//!
//! To keep one small file through a power cut the disk flushes the file, its name and its folder. So a small object is
//! first appended to a journal, where one flush serves all that came meanwhile; its file is then written without waiting
//! for the disk. What a power cut took from the files is written again from the journal when the folder is next opened.
//! When a journal is full the next one begins, and it goes once the whole file system was flushed.
//!
//! ```text
//! journal/<uuid>.log   of one process, which holds a lock on it
//!   boot               36 bytes: which start of the machine
//!   entry ...          CRC-32 of the rest, length of the path, length of the content (u32, little endian), path, content
//!   zeros
//! ```
//!
//! Invariant: what an entry was written for is in its file, for every process of this machine to see, before anybody
//! hears that it is stored. So the end of a process alone takes nothing, and only another start of the machine makes
//! entries count.

use std::collections::BTreeMap;
use std::fs::{self, File, OpenOptions, TryLockError};
use std::io::{self, ErrorKind};
use std::os::unix::fs::FileExt as _;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, RwLock};

use object_store::local::LocalFileSystem;
use object_store::path::Path as Name;
use uuid::Uuid;

/// Larger objects are better flushed by themselves than written twice.
pub(crate) const MAX_OBJECT_BYTES: usize = 64 * 1024;
/// A journal is at most so long.
const MAX_BYTES: u64 = 16 * 1024 * 1024;
/// Zeros are written ahead by so much: a flush that need not note a new length is the cheapest.
const AHEAD_BYTES: u64 = 1024 * 1024;
const BOOT_BYTES: usize = 36;
const HEAD_BYTES: usize = 12;

/// Where small objects of one folder are put.
#[derive(Debug)]
pub(crate) struct Journal {
    root: LocalFileSystem,
    folder: PathBuf,
    boot: String,
    /// Held for reading while an object is on its way into segment and file.
    current: RwLock<Arc<Segment>>,
}

/// One file of the journal.
#[derive(Debug)]
struct Segment {
    path: PathBuf,
    file: File,
    end: Mutex<End>,
    flushed: Mutex<Flushed>,
}

#[derive(Clone, Copy, Debug, Default)]
struct End {
    entries: u64,
    zeros: u64,
}

#[derive(Clone, Copy, Debug, Default)]
struct Flushed {
    until: u64,
    /// The disk refused once: what it keeps from then on cannot be known.
    broken: bool,
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

fn generic(error: impl Into<Box<dyn std::error::Error + Send + Sync>>) -> object_store::Error {
    object_store::Error::Generic {
        store: "journal",
        source: error.into(),
    }
}

/// Which start of the machine this is; where that cannot be told, one that never was.
fn this_boot() -> String {
    let known = fs::read_to_string("/proc/sys/kernel/random/boot_id").ok();
    known
        .map(|text| text.trim().to_owned())
        .filter(|text| text.len() == BOOT_BYTES)
        .unwrap_or_else(|| Uuid::new_v4().to_string())
}

impl Journal {
    /// Takes up what an earlier start of the machine left in the folder, and begins a journal of our own.
    pub(crate) async fn open(folder: PathBuf) -> object_store::Result<Arc<Self>> {
        let opened = tokio::task::spawn_blocking(move || Self::open_at(&folder, this_boot()));
        opened.await.map_err(generic)?.map(Arc::new)
    }

    fn open_at(root: &Path, boot: String) -> object_store::Result<Self> {
        let folder = root.join("journal");
        fs::create_dir_all(&folder).map_err(generic)?;
        let root = LocalFileSystem::new_with_prefix(root)?;
        recover(&root, &folder, &boot)?;
        let segment = Segment::create(&folder, &boot).map_err(generic)?;
        Ok(Self {
            root,
            folder,
            boot,
            current: RwLock::new(Arc::new(segment)),
        })
    }

    /// Stores an object of at most [`MAX_OBJECT_BYTES`]; it is durable afterwards.
    pub(crate) async fn put(
        self: &Arc<Self>,
        name: &Name,
        content: impl AsRef<[u8]> + Send + 'static,
    ) -> object_store::Result<()> {
        let (journal, name) = (self.clone(), name.clone());
        let put = tokio::task::spawn_blocking(move || journal.put_now(&name, content.as_ref()));
        put.await.map_err(generic)?
    }

    fn put_now(&self, name: &Name, content: &[u8]) -> object_store::Result<()> {
        let path = self.root.path_to_filesystem(name)?;
        let entry = entry(name.as_ref(), content);
        loop {
            let current = self.current.read().unwrap_or_else(PoisonError::into_inner);
            if let Some(end) = current.append(&entry).map_err(generic)? {
                current.flush(end).map_err(generic)?;
                return write(&path, content).map_err(generic);
            }
            let full = current.clone();
            drop(current);
            self.replace(&full).map_err(generic)?;
        }
    }

    /// Begins the next segment, and lets the full one go.
    fn replace(&self, full: &Arc<Segment>) -> io::Result<()> {
        {
            let mut current = self.current.write().unwrap_or_else(PoisonError::into_inner);
            if !Arc::ptr_eq(&current, full) {
                return Ok(());
            }
            *current = Arc::new(Segment::create(&self.folder, &self.boot)?);
        }
        // Nobody is on the way into it any more: its objects are in their files.
        rustix::fs::syncfs(&full.file)?;
        fs::remove_file(&full.path)
    }
}

impl Segment {
    fn create(folder: &Path, boot: &str) -> io::Result<Self> {
        let path = folder.join(format!("{}.log", Uuid::now_v7()));
        let file = OpenOptions::new()
            .read(true)
            .write(true)
            .create_new(true)
            .open(&path)?;
        file.lock()?;
        file.write_all_at(boot.as_bytes(), 0)?;
        file.sync_all()?;
        File::open(folder)?.sync_all()?;
        let start = BOOT_BYTES as u64;
        Ok(Self {
            path,
            file,
            end: Mutex::new(End {
                entries: start,
                zeros: start,
            }),
            flushed: Mutex::new(Flushed {
                until: start,
                broken: false,
            }),
        })
    }

    /// Where the entry ends; none when it does not fit, or nothing fits any more.
    fn append(&self, entry: &[u8]) -> io::Result<Option<u64>> {
        let mut end = lock(&self.end);
        let next = end.entries + entry.len() as u64;
        if next > MAX_BYTES {
            return Ok(None);
        }
        if next > end.zeros {
            let zeros = (next + AHEAD_BYTES).min(MAX_BYTES);
            self.file
                .write_all_at(&vec![0; (zeros - end.zeros) as usize], end.zeros)?;
            end.zeros = zeros;
        }
        self.file.write_all_at(entry, end.entries)?;
        end.entries = next;
        Ok(Some(next))
    }

    /// Returns when everything before `end` is on the disk. The first of those who wait flushes for all of them.
    fn flush(&self, end: u64) -> io::Result<()> {
        let mut flushed = lock(&self.flushed);
        if flushed.broken {
            return Err(io::Error::other("the journal could not be flushed"));
        }
        if flushed.until >= end {
            return Ok(());
        }
        let until = lock(&self.end).entries;
        if let Err(error) = self.file.sync_data() {
            flushed.broken = true;
            lock(&self.end).entries = MAX_BYTES;
            return Err(error);
        }
        flushed.until = until;
        Ok(())
    }
}

fn entry(name: &str, content: &[u8]) -> Vec<u8> {
    let mut entry = vec![0; 4];
    for length in [name.len(), content.len()] {
        entry.extend_from_slice(&(length as u32).to_le_bytes());
    }
    entry.extend_from_slice(name.as_bytes());
    entry.extend_from_slice(content);
    let sum = crc32fast::hash(&entry[4..]);
    entry[..4].copy_from_slice(&sum.to_le_bytes());
    entry
}

/// Name and content of the first entry, and what comes after it; none where nothing whole begins.
fn first_entry(bytes: &[u8]) -> Option<(Name, &[u8], &[u8])> {
    let number = |at: usize| {
        let four = bytes.get(at..at + 4)?.try_into().ok()?;
        Some(u32::from_le_bytes(four))
    };
    let (sum, name_bytes, content_bytes) = (number(0)?, number(4)? as usize, number(8)? as usize);
    let name_end = HEAD_BYTES + name_bytes;
    let end = name_end + content_bytes;
    if name_bytes == 0 || sum != crc32fast::hash(bytes.get(4..end)?) {
        return None;
    }
    let name = std::str::from_utf8(&bytes[HEAD_BYTES..name_end]).ok()?;
    let name = Name::parse(name).ok()?;
    Some((name, &bytes[name_end..end], &bytes[end..]))
}

/// Writes what journals of another start of the machine hold, where the files do not, and lets go of the journals that
/// no process writes any more.
fn recover(root: &LocalFileSystem, folder: &Path, boot: &str) -> object_store::Result<()> {
    let mut paths = fs::read_dir(folder)
        .map_err(generic)?
        .map(|file| file.map(|it| it.path()))
        .collect::<io::Result<Vec<_>>>()
        .map_err(generic)?;
    // By their ids, which is by their age.
    paths.sort_unstable();
    let mut left = Vec::new();
    let mut objects = BTreeMap::new();
    for path in paths {
        let file = match File::open(&path) {
            Ok(file) => file,
            // Another process was faster.
            Err(error) if error.kind() == ErrorKind::NotFound => continue,
            Err(error) => return Err(generic(error)),
        };
        match file.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => continue,
            Err(TryLockError::Error(error)) => return Err(generic(error)),
        }
        let bytes = fs::read(&path).map_err(generic)?;
        if let Some((written_in, mut rest)) = bytes.split_at_checked(BOOT_BYTES)
            && written_in != boot.as_bytes()
        {
            while let Some((name, content, after)) = first_entry(rest) {
                objects.insert(name, content.to_vec());
                rest = after;
            }
        }
        left.push((path, file));
    }
    let mut written = 0_u32;
    for (name, content) in objects {
        let path = root.path_to_filesystem(&name)?;
        if fs::read(&path).ok().as_deref() != Some(&content) {
            write(&path, &content).map_err(generic)?;
            written += 1;
        }
    }
    if written > 0 {
        tracing::warn!(written, "wrote again what a power cut took from the store");
    }
    for (path, file) in left {
        rustix::fs::syncfs(&file)
            .map_err(io::Error::from)
            .map_err(generic)?;
        fs::remove_file(path).map_err(generic)?;
    }
    Ok(())
}

/// Writes a whole file or none, without waiting for the disk; its folder is made where it is missing. While it is
/// written it has a name that listings of the store pass over.
fn write(path: &Path, content: &[u8]) -> io::Result<()> {
    let mut staged = path.as_os_str().to_owned();
    staged.push(format!("#{}", Uuid::new_v4().as_u128()));
    let staged = PathBuf::from(staged);
    let placed = match fs::write(&staged, content) {
        Err(error) if error.kind() == ErrorKind::NotFound => {
            if let Some(folder) = path.parent() {
                fs::create_dir_all(folder)?;
            }
            fs::write(&staged, content)
        }
        done => done,
    }
    .and_then(|()| fs::rename(&staged, path));
    if placed.is_err() {
        // It is passed over in any case.
        fs::remove_file(&staged).ok();
    }
    placed
}

#[cfg(test)]
mod tests {
    use super::*;

    const BEFORE: &str = "00000000-0000-4000-8000-000000000001";
    const AFTER: &str = "00000000-0000-4000-8000-000000000002";

    fn open(root: &Path, boot: &str) -> Journal {
        Journal::open_at(root, boot.to_owned()).unwrap()
    }

    fn put(journal: &Journal, name: &str, content: &[u8]) {
        journal.put_now(&Name::from(name), content).unwrap();
    }

    fn journals(root: &Path) -> usize {
        fs::read_dir(root.join("journal")).unwrap().count()
    }

    #[test]
    fn what_a_power_cut_took_is_written_again() {
        let dir = tempfile::tempdir().unwrap();
        let root = dir.path();
        let journal = open(root, BEFORE);
        put(&journal, "versions/a/b/state.json", b"old");
        put(&journal, "versions/a/b/state.json", b"new");
        put(&journal, "versions/a/b/v1.json", b"one");
        put(&journal, "versions/a/b/v2.json", b"two");
        drop(journal);
        // Names without content, names that never came to be.
        fs::write(root.join("versions/a/b/state.json"), "").unwrap();
        fs::remove_file(root.join("versions/a/b/v1.json")).unwrap();
        let _after = open(root, AFTER);
        let read = |name: &str| fs::read_to_string(root.join("versions/a/b").join(name)).unwrap();
        assert_eq!(read("state.json"), "new");
        assert_eq!(
            (read("v1.json"), read("v2.json")),
            ("one".into(), "two".into())
        );
        assert_eq!(journals(root), 1);
    }

    #[test]
    fn the_end_of_a_process_alone_takes_nothing_and_changes_nothing() {
        let dir = tempfile::tempdir().unwrap();
        let journal = open(dir.path(), BEFORE);
        put(&journal, "a", b"old");
        drop(journal);
        fs::write(dir.path().join("a"), "newer, from another process").unwrap();
        let _next = open(dir.path(), BEFORE);
        let kept = fs::read_to_string(dir.path().join("a")).unwrap();
        assert_eq!(kept, "newer, from another process");
        assert_eq!(journals(dir.path()), 1);
    }

    #[test]
    fn a_journal_that_is_being_written_is_left_alone() {
        let dir = tempfile::tempdir().unwrap();
        let first = open(dir.path(), BEFORE);
        let second = open(dir.path(), BEFORE);
        put(&first, "a", b"1");
        put(&second, "b", b"2");
        assert_eq!(journals(dir.path()), 2);
    }

    #[test]
    fn a_torn_entry_ends_the_journal() {
        let dir = tempfile::tempdir().unwrap();
        let journal = open(dir.path(), BEFORE);
        for name in ["a", "b", "c"] {
            put(&journal, name, b"content");
        }
        let segment = journal.current.read().unwrap().clone();
        let of_one = entry("a", b"content").len() as u64;
        segment
            .file
            .write_all_at(b"x", BOOT_BYTES as u64 + 2 * of_one - 1)
            .unwrap();
        drop((segment, journal));
        for name in ["a", "b", "c"] {
            fs::remove_file(dir.path().join(name)).unwrap();
        }
        let _after = open(dir.path(), AFTER);
        let there = ["a", "b", "c"].map(|name| dir.path().join(name).exists());
        assert_eq!(there, [true, false, false]);
    }

    #[test]
    fn threads_share_journals_that_come_and_go() {
        let dir = tempfile::tempdir().unwrap();
        let journal = open(dir.path(), BEFORE);
        let content = vec![7; MAX_OBJECT_BYTES];
        std::thread::scope(|scope| {
            for thread in 0..8 {
                let (journal, content) = (&journal, &content);
                scope.spawn(move || {
                    for number in 0..50 {
                        put(journal, &format!("{thread}/{number}"), content);
                    }
                });
            }
        });
        // 25 MiB went through it.
        assert_eq!(journals(dir.path()), 1);
        let last = journal.current.read().unwrap().clone();
        assert!(lock(&last.end).entries < MAX_BYTES);
        for thread in 0..8 {
            let files = fs::read_dir(dir.path().join(thread.to_string())).unwrap();
            assert!(files.count() == 50);
        }
    }
}
