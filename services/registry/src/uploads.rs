//! Upload sessions: a blob that arrives in pieces, over as many connections, coordinators and restarts as it takes.
//!
//! What arrives is kept in the store as `uploads/<id>/<offset>` in parts of at most 8 MiB, also the last piece before a
//! connection breaks. Where an upload stands is what lies there without a gap; nothing is remembered elsewhere. When
//! the client finishes, the parts are read once through the digest check into the blob, and removed.
//!
//! Two connections that write the same session can only overwrite each other's parts; the digest check then refuses
//! the sum, and the client resumes from where the session stands.

use std::fmt;
use std::str::FromStr;
use std::sync::Arc;
use std::time::Duration;

use bytes::{Bytes, BytesMut};
use futures::stream::BoxStream;
use futures::{Stream, StreamExt as _, TryStreamExt as _};
use ign_proto::{Digest, ObjectName};
use object_store::path::Path;
use object_store::{ObjectMeta, ObjectStore, ObjectStoreExt as _};
use uuid::Uuid;

use crate::blobs::PART_BYTES;
use crate::error::{BodyError, RegistryError, store_error};
use crate::store::Registry;

const SESSION: &str = "session";

/// Names an upload session; unguessable.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct UploadId(Uuid);

impl FromStr for UploadId {
    type Err = uuid::Error;

    fn from_str(text: &str) -> Result<Self, uuid::Error> {
        Uuid::try_parse(text).map(Self)
    }
}

impl fmt::Display for UploadId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.hyphenated().fmt(f)
    }
}

struct Part {
    path: Path,
    size_bytes: u64,
}

impl Registry {
    fn upload_path(&self, id: UploadId, name: &str) -> Path {
        self.path(&format!("uploads/{id}/{name}"))
    }

    /// Begins an upload for an object; only requests for the same object can go on with it.
    pub async fn create_upload(&self, object: &ObjectName) -> Result<UploadId, RegistryError> {
        let id = UploadId(Uuid::new_v4());
        self.put(
            &self.upload_path(id, SESSION),
            object.to_string().into_bytes().into(),
        )
        .await?;
        Ok(id)
    }

    /// How many bytes have arrived.
    pub async fn upload_offset(
        &self,
        object: &ObjectName,
        id: UploadId,
    ) -> Result<u64, RegistryError> {
        self.check_session(object, id).await?;
        Ok(self
            .upload_parts(id)
            .await?
            .iter()
            .map(|part| part.size_bytes)
            .sum())
    }

    /// Adds bytes from `offset`, where the upload must stand; returns where it stands afterwards. When the body breaks,
    /// what arrived is kept and the error says that it broke.
    pub async fn append_upload<S>(
        &self,
        object: &ObjectName,
        id: UploadId,
        offset: u64,
        limit_bytes: u64,
        body: S,
    ) -> Result<u64, RegistryError>
    where
        S: Stream<Item = Result<Bytes, BodyError>> + Send,
    {
        let stands_at = self.upload_offset(object, id).await?;
        if offset != stands_at {
            return Err(RegistryError::WrongOffset {
                id,
                offset: stands_at,
                given: offset,
            });
        }
        let mut body = std::pin::pin!(body);
        let mut written = offset;
        let mut buffer = BytesMut::new();
        let mut broke = None;
        while let Some(chunk) = body.next().await {
            match chunk {
                Ok(chunk) => buffer.extend_from_slice(&chunk),
                Err(source) => {
                    broke = Some(RegistryError::Body { source });
                    break;
                }
            }
            if written + buffer.len() as u64 > limit_bytes {
                return Err(RegistryError::TooLarge { limit_bytes });
            }
            while buffer.len() >= PART_BYTES {
                let part = buffer.split_to(PART_BYTES).freeze();
                written = self.put_part(id, written, part).await?;
            }
        }
        // OCI clients read "0-0" as nothing: a lone first byte is not worth keeping.
        let ambiguous = broke.is_some() && written + buffer.len() as u64 == 1;
        if !buffer.is_empty() && !ambiguous {
            written = self.put_part(id, written, buffer.freeze()).await?;
        }
        broke.map_or(Ok(written), Err)
    }

    /// Turns the upload into the blob that `expected` names; returns its size. A wrong digest keeps the upload, so that
    /// the client can see where it stands; a repeated finish succeeds when the blob is there.
    pub async fn finish_upload(
        &self,
        object: &ObjectName,
        id: UploadId,
        expected: &Digest,
        limit_bytes: u64,
    ) -> Result<u64, RegistryError> {
        if let Some(size_bytes) = self.blob_size(expected).await? {
            self.drop_upload(id).await?;
            return Ok(size_bytes);
        }
        self.check_session(object, id).await?;
        let parts = self.upload_parts(id).await?;
        let store = self.store.clone();
        let body = futures::stream::iter(parts)
            .then(move |part| open(store.clone(), part.path))
            .try_flatten()
            .map_err(|error| Box::new(error) as BodyError)
            .boxed();
        let size_bytes = self.put_stream(expected, limit_bytes, body).await?;
        ign_faults::point("upload.finished");
        self.drop_upload(id).await?;
        Ok(size_bytes)
    }

    /// Forgets an upload and its parts; absent ones are fine.
    pub async fn drop_upload(&self, id: UploadId) -> Result<(), RegistryError> {
        let folder = self.path(&format!("uploads/{id}"));
        for meta in self.list(&folder).await? {
            self.delete(&meta.location).await?;
        }
        Ok(())
    }

    /// Forgets uploads to which nothing was added for the given time; returns how many.
    pub async fn drop_stale_uploads(&self, idle_for: Duration) -> Result<usize, RegistryError> {
        let root = self.path("uploads");
        let now = chrono::Utc::now();
        let mut last_change: std::collections::BTreeMap<String, chrono::DateTime<chrono::Utc>> =
            std::collections::BTreeMap::new();
        for meta in self.list(&root).await? {
            if let Some(id) = self.names(&meta.location).get(1) {
                let changed = last_change.entry(id.clone()).or_insert(meta.last_modified);
                *changed = meta.last_modified.max(*changed);
            }
        }
        let mut dropped = 0;
        for (id, changed) in last_change {
            let idle = (now - changed).to_std().unwrap_or_default();
            if let (true, Ok(id)) = (idle >= idle_for, id.parse()) {
                self.drop_upload(id).await?;
                dropped += 1;
            }
        }
        Ok(dropped)
    }

    async fn check_session(&self, object: &ObjectName, id: UploadId) -> Result<(), RegistryError> {
        let session = self.read_small(&self.upload_path(id, SESSION)).await?;
        match session {
            Some(owner) if owner == object.to_string() => Ok(()),
            _ => Err(RegistryError::UploadAbsent { id }),
        }
    }

    async fn put_part(
        &self,
        id: UploadId,
        offset: u64,
        bytes: Bytes,
    ) -> Result<u64, RegistryError> {
        let end = offset + bytes.len() as u64;
        self.put(
            &self.upload_path(id, &format!("{offset:020}")),
            bytes.into(),
        )
        .await?;
        Ok(end)
    }

    /// The parts that lie there without a gap, in order.
    async fn upload_parts(&self, id: UploadId) -> Result<Vec<Part>, RegistryError> {
        let folder = self.path(&format!("uploads/{id}"));
        let mut found: Vec<(u64, Part)> = self
            .list(&folder)
            .await?
            .into_iter()
            .filter_map(|ObjectMeta { location, size, .. }| {
                let offset = location.filename()?.parse().ok()?;
                Some((
                    offset,
                    Part {
                        path: location,
                        size_bytes: size,
                    },
                ))
            })
            .collect();
        found.sort_by_key(|(offset, _)| *offset);
        let mut parts = Vec::new();
        let mut end = 0;
        for (offset, part) in found {
            if offset == end {
                end += part.size_bytes;
                parts.push(part);
            }
        }
        Ok(parts)
    }

    pub(crate) async fn list(&self, folder: &Path) -> Result<Vec<ObjectMeta>, RegistryError> {
        self.store
            .list(Some(folder))
            .try_collect()
            .await
            .map_err(store_error("list", folder))
    }

    pub(crate) async fn delete(&self, path: &Path) -> Result<(), RegistryError> {
        match self.store.delete(path).await {
            Ok(()) | Err(object_store::Error::NotFound { .. }) => Ok(()),
            Err(error) => Err(store_error("delete", path)(error)),
        }
    }
}

/// The content of one object.
async fn open(
    store: Arc<dyn ObjectStore>,
    path: Path,
) -> object_store::Result<BoxStream<'static, object_store::Result<Bytes>>> {
    Ok(store.get(&path).await?.into_stream())
}
