//! Between unnamed and gone: the trash.
//!
//! ```text
//! trash/blobs/<64 hex>/<uuid>      moved there by a collection; the uuid (version 7) says when
//! damaged/blobs/<64 hex>-<uuid>    set aside by an audit: bytes that are not what their name says
//! ```
//!
//! Whoever asks for content that lies in the trash finds it: [`Registry::rescue`] moves it back. So a collection that
//! raced with an upload, a submit or a publish costs nothing: what was moved under their feet is there again as soon as
//! somebody looks, and is only deleted after nobody asked for it, and nothing named it, for another whole grace.

use chrono::{DateTime, Utc};
use ign_proto::Digest;
use object_store::ObjectStoreExt as _;
use object_store::path::Path;
use uuid::{NoContext, Timestamp, Uuid};

use crate::blobs::Content;
use crate::error::{RegistryError, store_error};
use crate::store::Registry;

/// One object in the trash.
pub(crate) struct Trashed {
    pub(crate) path: Path,
    pub(crate) content: Content,
    pub(crate) digest: Digest,
    pub(crate) since: DateTime<Utc>,
    pub(crate) size_bytes: u64,
}

impl Registry {
    /// Moves content into the trash; absent content is fine.
    pub(crate) async fn discard(
        &self,
        content: Content,
        digest: &Digest,
        now: DateTime<Utc>,
    ) -> Result<(), RegistryError> {
        let at = Timestamp::from_unix(
            NoContext,
            now.timestamp().max(0) as u64,
            now.timestamp_subsec_nanos(),
        );
        let (from, to) = (
            self.content_path(content, digest),
            self.path(&format!(
                "trash/{}/{}/{}",
                content.folder(),
                digest.hex(),
                Uuid::new_v7(at)
            )),
        );
        self.move_object(&from, &to).await.map(drop)
    }

    /// Moves content back from the trash; answers whether it was there.
    pub(crate) async fn rescue(
        &self,
        content: Content,
        digest: &Digest,
    ) -> Result<bool, RegistryError> {
        let folder = self.path(&format!("trash/{}/{}", content.folder(), digest.hex()));
        let to = self.content_path(content, digest);
        for meta in self.list(&folder).await? {
            if self.move_object(&meta.location, &to).await? {
                tracing::info!(path = %to, "taken back from the trash");
                return Ok(true);
            }
        }
        Ok(false)
    }

    /// Sets damaged content aside, so that the right bytes can be sent again.
    pub(crate) async fn set_aside(&self, path: &Path) -> Result<(), RegistryError> {
        let name = self.names(path).join("/");
        let to = self.path(&format!("damaged/{name}-{}", Uuid::now_v7()));
        self.move_object(path, &to).await.map(drop)
    }

    /// Everything in the trash.
    pub(crate) async fn trash(&self) -> Result<Vec<Trashed>, RegistryError> {
        let mut found = Vec::new();
        for content in Content::ALL {
            let folder = self.path(&format!("trash/{}", content.folder()));
            for meta in self.list(&folder).await? {
                let names = self.names(&meta.location);
                let [_, _, hex, id] = names.as_slice() else {
                    continue;
                };
                let since = id
                    .parse::<Uuid>()
                    .ok()
                    .and_then(|id| id.get_timestamp())
                    .and_then(|at| {
                        let (secs, nanos) = at.to_unix();
                        DateTime::from_timestamp(i64::try_from(secs).ok()?, nanos)
                    });
                if let (Ok(digest), Some(since)) = (format!("sha256:{hex}").parse(), since) {
                    found.push(Trashed {
                        path: meta.location,
                        content,
                        digest,
                        since,
                        size_bytes: meta.size,
                    });
                }
            }
        }
        Ok(found)
    }

    /// Whether there was something to move.
    async fn move_object(&self, from: &Path, to: &Path) -> Result<bool, RegistryError> {
        match self.store.rename(from, to).await {
            Ok(()) => Ok(true),
            Err(object_store::Error::NotFound { .. }) => Ok(false),
            Err(error) => Err(store_error("move", from)(error)),
        }
    }
}
