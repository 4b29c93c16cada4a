//! Fixity: every digest is read again, because storage rots silently.
//!
//! An audit goes over the whole store, or over one of 256 slices (by the first byte of the digest), so that a scheduled
//! one is spread over its interval. Content that is wrong twice in a row is replaced from the replica where there is
//! one; otherwise it is set aside, so that nobody is served wrong bytes and the right ones can be sent again. Files that
//! kept manifests name and that are absent are fetched from the replica too.

use std::collections::BTreeSet;

use futures::{StreamExt as _, TryStreamExt as _};
use ign_proto::manifest::EMPTY_CONFIG;
use ign_proto::{Digest, Manifest};
use object_store::path::Path;
use object_store::{ObjectMeta, ObjectStoreExt as _};
use sha2::{Digest as _, Sha256};

use crate::blobs::Content;
use crate::collect::Tally;
use crate::error::{BodyError, RegistryError, cut, store_error};
use crate::store::Registry;

const READS_IN_FLIGHT: usize = 4;

/// What became of a fault.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// Right again, from the replica.
    Repaired,
    /// Moved to `damaged/`; sending the content again repairs it.
    SetAside,
    /// Absent, and the replica has none.
    Absent,
}

/// Content that is not what it should be.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Fault {
    /// Which object.
    pub path: String,
    /// What is wrong.
    pub reason: String,
    /// What was done about it.
    pub outcome: Outcome,
}

/// What an audit found.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Audit {
    /// What was read.
    pub read: Tally,
    /// What was wrong.
    pub faults: Vec<Fault>,
}

impl Registry {
    /// Reads everything, or the slice of digests that begin with this byte, and repairs what it can. `named` are the
    /// manifests that must be there with all their files.
    pub async fn audit(
        &self,
        slice: Option<u8>,
        named: &BTreeSet<Digest>,
        replica: Option<&Registry>,
    ) -> Result<Audit, RegistryError> {
        let mut audit = Audit::default();
        for content in Content::ALL {
            let folder = match slice {
                None => self.path(content.folder()),
                Some(byte) => self.path(&format!("{}/sha256/{byte:02x}", content.folder())),
            };
            let mut checks = futures::stream::iter(self.list(&folder).await?)
                .map(|meta| async move { self.check(content, meta, replica).await })
                .buffer_unordered(READS_IN_FLIGHT);
            while let Some((size_bytes, fault)) = checks.try_next().await? {
                audit.read.add(size_bytes);
                audit.faults.extend(fault);
            }
        }
        let in_slice = |digest: &Digest| {
            slice.is_none_or(|byte| digest.hex().starts_with(&format!("{byte:02x}")))
        };
        let mut wanted = BTreeSet::from([Digest::of(EMPTY_CONFIG)]);
        for digest in named {
            let bytes = match self.manifest(digest).await {
                Ok(bytes) => bytes,
                // Found above, when its own slice was read.
                Err(RegistryError::Damaged { .. }) => continue,
                Err(error) => return Err(error),
            };
            if let Some(bytes) = bytes {
                let manifest = Manifest::decode(&bytes)?;
                wanted.extend(manifest.files().iter().map(|file| file.digest.clone()));
            } else if in_slice(digest) {
                audit.faults.extend(
                    self.fetch_absent(Content::Manifest, digest, replica)
                        .await?,
                );
            }
        }
        for digest in wanted.iter().filter(|digest| in_slice(digest)) {
            if self.blob_size(digest).await?.is_none() {
                audit
                    .faults
                    .extend(self.fetch_absent(Content::Blob, digest, replica).await?);
            }
        }
        audit.faults.sort_by(|a, b| a.path.cmp(&b.path));
        audit.faults.dedup();
        Ok(audit)
    }

    /// Reads one object; its size, and what is wrong with it.
    async fn check(
        &self,
        content: Content,
        meta: ObjectMeta,
        replica: Option<&Registry>,
    ) -> Result<(u64, Option<Fault>), RegistryError> {
        let path = meta.location;
        let hex = path.filename().unwrap_or_default();
        let Ok(expected) = format!("sha256:{hex}").parse::<Digest>() else {
            // Another program's file, or what a crash left of a write: it has no name, so nobody can ask for it.
            return Ok((meta.size, None));
        };
        // Twice: a read that broke is no damage.
        for _ in 0..2 {
            match self.digest_of(&path).await? {
                Some(actual) if actual != expected => {}
                _ => return Ok((meta.size, None)),
            }
        }
        let outcome = if self.copy_from(replica, content, &expected).await? {
            Outcome::Repaired
        } else {
            self.set_aside(&path).await?;
            Outcome::SetAside
        };
        let fault = Fault {
            path: path.to_string(),
            reason: "its content does not have the digest of its name".to_owned(),
            outcome,
        };
        Ok((meta.size, Some(fault)))
    }

    async fn fetch_absent(
        &self,
        content: Content,
        digest: &Digest,
        replica: Option<&Registry>,
    ) -> Result<Option<Fault>, RegistryError> {
        let outcome = if self.copy_from(replica, content, digest).await? {
            Outcome::Repaired
        } else {
            Outcome::Absent
        };
        Ok(Some(Fault {
            path: self.content_path(content, digest).to_string(),
            reason: "it is named, but absent".to_owned(),
            outcome,
        }))
    }

    /// Takes content from the replica if that has it whole; nothing that is wrong there gets here, and a replica that
    /// fails is as good as none.
    async fn copy_from(
        &self,
        replica: Option<&Registry>,
        content: Content,
        digest: &Digest,
    ) -> Result<bool, RegistryError> {
        let Some(replica) = replica else {
            return Ok(false);
        };
        match self.try_copy_from(replica, content, digest).await {
            Err(error @ RegistryError::Full { .. }) => Err(error),
            Err(error) => {
                tracing::warn!(%error, %digest, "cannot be repaired from the replica");
                Ok(false)
            }
            copied => copied,
        }
    }

    async fn try_copy_from(
        &self,
        replica: &Registry,
        content: Content,
        digest: &Digest,
    ) -> Result<bool, RegistryError> {
        match content {
            Content::Blob => {
                let Some(read) = replica.read_blob(digest, None).await? else {
                    return Ok(false);
                };
                let body = read
                    .stream
                    .map_err(|error| Box::new(error) as BodyError)
                    .boxed();
                self.put_stream(digest, u64::MAX, body).await?;
            }
            Content::Manifest => {
                let Some(bytes) = replica.manifest(digest).await? else {
                    return Ok(false);
                };
                let path = self.content_path(content, digest);
                self.put(&path, bytes.into()).await?;
            }
        }
        Ok(true)
    }

    /// Digest of what lies at a path; none when it is gone.
    async fn digest_of(&self, path: &Path) -> Result<Option<Digest>, RegistryError> {
        let (size_bytes, mut body) = match self.store.get(path).await {
            Ok(result) => (result.meta.size, result.into_stream()),
            Err(object_store::Error::NotFound { .. }) => return Ok(None),
            Err(error) => return Err(store_error("read", path)(error)),
        };
        let mut hasher = Sha256::new();
        let mut read_bytes = 0;
        while let Some(chunk) = body.try_next().await.map_err(store_error("read", path))? {
            hasher.update(&chunk);
            read_bytes += chunk.len() as u64;
        }
        if read_bytes != size_bytes {
            return Err(cut(path));
        }
        Ok(Some(Digest::from_sha256(hasher.finalize().into())))
    }
}
