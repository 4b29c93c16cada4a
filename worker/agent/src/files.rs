//! Small file helpers: hashing in pieces, links that fall back to copies, free space.

use std::io::Read;
use std::path::Path;

use ign_proto::Digest;
use sha2::{Digest as _, Sha256};

use crate::error::TransferError;

/// Hash state and length of a file, read in pieces.
pub(crate) fn hash(path: &Path) -> std::io::Result<(Sha256, u64)> {
    let mut file = std::fs::File::open(path)?;
    let mut hasher = Sha256::new();
    let mut buffer = vec![0; 1 << 18];
    let mut length = 0;
    loop {
        let count = file.read(&mut buffer)?;
        if count == 0 {
            return Ok((hasher, length));
        }
        hasher.update(&buffer[..count]);
        length += count as u64;
    }
}

/// Digest and length of a file.
pub(crate) fn digest(path: &Path) -> std::io::Result<(Digest, u64)> {
    let (hasher, length) = hash(path)?;
    Ok((Digest::from_sha256(hasher.finalize().into()), length))
}

/// The same file under a second name; a copy where the file system has no links.
pub(crate) fn link_or_copy(from: &Path, to: &Path) -> Result<(), TransferError> {
    if std::fs::hard_link(from, to).is_ok() {
        return Ok(());
    }
    std::fs::copy(from, to)
        .map(drop)
        .map_err(|source| TransferError::file("write", to, source))
}

/// Bytes that this process may still write in `dir`; `None` when the file system does not say.
pub(crate) fn free_bytes(dir: &Path) -> Option<u64> {
    let stat = rustix::fs::statvfs(dir).ok()?;
    stat.f_bavail.checked_mul(stat.f_frsize)
}

/// Runs file work off the async threads.
pub(crate) async fn blocking<T: Send + 'static>(
    work: impl FnOnce() -> T + Send + 'static,
) -> Result<T, TransferError> {
    tokio::task::spawn_blocking(work)
        .await
        .map_err(|error| TransferError::Unavailable {
            what: "file work".to_owned(),
            reason: error.to_string(),
        })
}
