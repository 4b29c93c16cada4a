//! Blobs and manifests: bytes under the name of their content.
//!
//! Invariant: an object under `blobs/` or `manifests/` has the digest that its path says. The digest is computed while
//! the bytes pass and checked before the object appears, so a reader never sees a wrong or half-written blob.

use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;
use std::time::Duration;

use bytes::{Bytes, BytesMut};
use futures::stream::BoxStream;
use futures::{Stream, StreamExt as _, TryStreamExt as _};
use ign_proto::manifest::{MAX_BYTES, Manifest};
use ign_proto::{Digest, FileEntry};
use object_store::path::Path;
use object_store::{GetOptions, GetRange, ObjectStoreExt as _, PutPayload, WriteMultipart};
use sha2::{Digest as _, Sha256};

use crate::error::{BodyError, RegistryError, cut, store_error};
use crate::store::Registry;

/// Part of a multipart write, and the largest body that is written in one piece.
pub(crate) const PART_BYTES: usize = 8 * 1024 * 1024;
const PARTS_IN_FLIGHT: usize = 4;
const CHECKS_IN_FLIGHT: usize = 32;

/// A manifest that was written within this time had all its blobs then, and none was collected since: it is shorter than
/// any grace.
const CHECKED_LATELY: Duration = Duration::from_mins(20);

/// What lies under the name of its content.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Content {
    Blob,
    Manifest,
}

impl Content {
    pub(crate) const ALL: [Self; 2] = [Self::Blob, Self::Manifest];

    pub(crate) fn folder(self) -> &'static str {
        match self {
            Self::Blob => "blobs",
            Self::Manifest => "manifests",
        }
    }
}

/// A blob being read.
pub struct BlobRead {
    /// Length of the whole blob.
    pub size_bytes: u64,
    /// The bytes that the stream gives.
    pub range: Range<u64>,
    /// The content.
    pub stream: BoxStream<'static, Result<Bytes, RegistryError>>,
}

impl Registry {
    pub(crate) fn content_path(&self, content: Content, digest: &Digest) -> Path {
        self.path(&format!(
            "{}/sha256/{}/{}",
            content.folder(),
            &digest.hex()[..2],
            digest.hex()
        ))
    }

    pub(crate) fn blob_path(&self, digest: &Digest) -> Path {
        self.content_path(Content::Blob, digest)
    }

    fn manifest_path(&self, digest: &Digest) -> Path {
        self.content_path(Content::Manifest, digest)
    }

    /// Size of a blob; none when absent. One that was in the trash is back afterwards.
    pub async fn blob_size(&self, digest: &Digest) -> Result<Option<u64>, RegistryError> {
        if let Some(size) = self.size_of(Content::Blob, digest).await? {
            return Ok(Some(size));
        }
        if self.rescue(Content::Blob, digest).await? {
            return self.size_of(Content::Blob, digest).await;
        }
        Ok(None)
    }

    /// Size of what lies at its place, the trash aside.
    pub(crate) async fn size_of(
        &self,
        content: Content,
        digest: &Digest,
    ) -> Result<Option<u64>, RegistryError> {
        let path = self.content_path(content, digest);
        match self.store.head(&path).await {
            Ok(meta) => Ok(Some(meta.size)),
            Err(object_store::Error::NotFound { .. }) => Ok(None),
            Err(error) => Err(store_error("look up", &path)(error)),
        }
    }

    /// Reads a blob or a range of it, which must lie inside; none when absent.
    pub async fn read_blob(
        &self,
        digest: &Digest,
        range: Option<Range<u64>>,
    ) -> Result<Option<BlobRead>, RegistryError> {
        let path = self.blob_path(digest);
        let options = GetOptions {
            range: range.map(GetRange::Bounded),
            ..GetOptions::default()
        };
        let mut found = self.store.get_opts(&path, options.clone()).await;
        if matches!(found, Err(object_store::Error::NotFound { .. }))
            && self.rescue(Content::Blob, digest).await?
        {
            found = self.store.get_opts(&path, options).await;
        }
        let result = match found {
            Ok(result) => result,
            Err(object_store::Error::NotFound { .. }) => return Ok(None),
            Err(error) => return Err(store_error("read", &path)(error)),
        };
        let (size_bytes, range) = (result.meta.size, result.range.clone());
        let stream = result
            .into_stream()
            .map_err(move |error| store_error("read", &path)(error))
            .boxed();
        Ok(Some(BlobRead {
            size_bytes,
            range,
            stream,
        }))
    }

    /// A URL from which the blob can be read without credentials; none when the store cannot sign.
    pub async fn sign_blob(
        &self,
        digest: &Digest,
        valid_for: Duration,
    ) -> Result<Option<String>, RegistryError> {
        self.sign(&self.blob_path(digest), valid_for).await
    }

    /// Stores bytes that are in memory.
    pub async fn put_bytes(&self, bytes: Bytes) -> Result<Digest, RegistryError> {
        let digest = Digest::of(&bytes);
        if self.blob_size(&digest).await? != Some(bytes.len() as u64) {
            self.put(&self.blob_path(&digest), bytes.into()).await?;
        }
        Ok(digest)
    }

    /// Stores a stream whose digest is claimed; returns its size. Nothing is kept unless the claim holds. Memory is
    /// bounded whatever the size.
    pub async fn put_stream<S>(
        &self,
        expected: &Digest,
        limit_bytes: u64,
        body: S,
    ) -> Result<u64, RegistryError>
    where
        S: Stream<Item = Result<Bytes, BodyError>> + Send,
    {
        let mut body = std::pin::pin!(body);
        let mut hasher = Sha256::new();
        let mut size_bytes = 0_u64;
        let mut buffer = BytesMut::new();
        let path = self.blob_path(expected);
        let mut large: Option<WriteMultipart> = None;
        let received: Result<(), RegistryError> = async {
            while let Some(chunk) = body.next().await {
                let chunk = chunk.map_err(|source| RegistryError::Body { source })?;
                hasher.update(&chunk);
                size_bytes += chunk.len() as u64;
                if size_bytes > limit_bytes {
                    return Err(RegistryError::TooLarge { limit_bytes });
                }
                if let Some(writer) = &mut large {
                    writer
                        .wait_for_capacity(PARTS_IN_FLIGHT)
                        .await
                        .map_err(store_error("write", &path))?;
                    writer.put(chunk);
                } else {
                    buffer.extend_from_slice(&chunk);
                    if buffer.len() > PART_BYTES {
                        let upload = self
                            .store
                            .put_multipart(&path)
                            .await
                            .map_err(store_error("write", &path))?;
                        let mut writer = WriteMultipart::new_with_chunk_size(upload, PART_BYTES);
                        writer.put(std::mem::take(&mut buffer).freeze());
                        large = Some(writer);
                    }
                }
            }
            Ok(())
        }
        .await;
        let checked = received.and_then(|()| {
            let actual = Digest::from_sha256(hasher.finalize().into());
            if actual == *expected {
                Ok(())
            } else {
                Err(RegistryError::WrongDigest {
                    expected: expected.clone(),
                    actual,
                })
            }
        });
        match (large, checked) {
            (Some(writer), Ok(())) => writer
                .finish()
                .await
                .map(drop)
                .map_err(store_error("write", &path))?,
            (Some(writer), Err(error)) => {
                if let Err(abort) = writer.abort().await {
                    tracing::warn!(error = %abort, path = %path, "parts of a refused blob are left in the store");
                }
                return Err(error);
            }
            (None, Ok(())) => self.put(&path, buffer.freeze().into()).await?,
            (None, Err(error)) => return Err(error),
        }
        ign_faults::point("blob.written");
        Ok(size_bytes)
    }

    /// Stores a manifest in its canonical bytes, after checking that every blob is there with the size it says.
    pub async fn put_manifest(&self, manifest: &Manifest) -> Result<Digest, RegistryError> {
        let bytes = manifest.encode()?;
        self.put_manifest_bytes(bytes.into(), manifest).await
    }

    /// Stores a manifest in the bytes that a client sent, which it has already decoded to `manifest`.
    pub async fn put_manifest_bytes(
        &self,
        bytes: Bytes,
        manifest: &Manifest,
    ) -> Result<Digest, RegistryError> {
        self.check_blobs(manifest).await?;
        let digest = Digest::of(&bytes);
        self.put(&self.manifest_path(&digest), bytes.into()).await?;
        ign_faults::point("manifest.written");
        Ok(digest)
    }

    /// The bytes of a manifest, checked against the digest; none when absent.
    pub async fn manifest(&self, digest: &Digest) -> Result<Option<Bytes>, RegistryError> {
        let path = self.manifest_path(digest);
        let mut found = self.read_small(&path).await?;
        if found.is_none() && self.rescue(Content::Manifest, digest).await? {
            found = self.read_small(&path).await?;
        }
        let Some(bytes) = found else {
            return Ok(None);
        };
        let actual = Digest::of(&bytes);
        if actual != *digest {
            return Err(RegistryError::Damaged {
                path: path.to_string(),
                reason: format!("its digest is {actual}"),
            });
        }
        Ok(Some(bytes))
    }

    /// The manifest of a capture or bundle that somebody is about to name, with all its blobs there; none when it is
    /// absent. One that was checked long ago is checked and written again, so that nothing of it is collected before
    /// its new name is known.
    pub async fn manifest_to_name(
        &self,
        digest: &Digest,
    ) -> Result<Option<Manifest>, RegistryError> {
        let Some(bytes) = self.manifest(digest).await? else {
            return Ok(None);
        };
        let manifest = Manifest::decode(&bytes)?;
        let path = self.manifest_path(digest);
        let meta = self
            .store
            .head(&path)
            .await
            .map_err(store_error("look up", &path))?;
        let age = chrono::Utc::now() - meta.last_modified;
        if age.to_std().is_ok_and(|age| age > CHECKED_LATELY) {
            self.put_manifest_bytes(bytes, &manifest).await?;
        }
        Ok(Some(manifest))
    }

    /// Fails unless every blob of the manifest is there with the size it says.
    pub async fn check_blobs(&self, manifest: &Manifest) -> Result<(), RegistryError> {
        let sizes: BTreeMap<Digest, BTreeSet<u64>> = manifest.files().iter().fold(
            BTreeMap::new(),
            |mut sizes,
             FileEntry {
                 digest, size_bytes, ..
             }| {
                sizes.entry(digest.clone()).or_default().insert(*size_bytes);
                sizes
            },
        );
        let missing: Vec<Digest> = futures::stream::iter(sizes)
            .map(|(digest, claimed)| async move {
                let size = self.blob_size(&digest).await?;
                let right = claimed.iter().all(|claim| Some(*claim) == size);
                Ok::<_, RegistryError>((!right).then_some(digest))
            })
            .buffered(CHECKS_IN_FLIGHT)
            .try_filter_map(|missing| async move { Ok(missing) })
            .try_collect()
            .await?;
        match missing.first() {
            Some(first) => Err(RegistryError::BlobsMissing {
                missing: missing.len(),
                first: first.clone(),
            }),
            None => Ok(()),
        }
    }

    pub(crate) async fn put(&self, path: &Path, payload: PutPayload) -> Result<(), RegistryError> {
        self.store
            .put(path, payload)
            .await
            .map(drop)
            .map_err(store_error("write", path))
    }

    /// An object of at most [`MAX_BYTES`]; none when absent.
    pub(crate) async fn read_small(&self, path: &Path) -> Result<Option<Bytes>, RegistryError> {
        let result = match self.store.get(path).await {
            Ok(result) => result,
            Err(object_store::Error::NotFound { .. }) => return Ok(None),
            Err(error) => return Err(store_error("read", path)(error)),
        };
        if result.meta.size > MAX_BYTES as u64 {
            let reason = format!("it has {} bytes", result.meta.size);
            return Err(RegistryError::Damaged {
                path: path.to_string(),
                reason,
            });
        }
        let size_bytes = result.meta.size;
        let bytes = result.bytes().await.map_err(store_error("read", path))?;
        if bytes.len() as u64 != size_bytes {
            return Err(cut(path));
        }
        Ok(Some(bytes))
    }
}
