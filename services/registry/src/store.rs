//! Where the registry lies: `file:///folder` or `s3://bucket/prefix`, and what that store can do.

use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use futures::TryStreamExt as _;
use ign_proto::manifest::EMPTY_CONFIG;
use object_store::aws::AmazonS3Builder;
use object_store::local::LocalFileSystem;
use object_store::path::Path;
use object_store::signer::Signer;
use object_store::{ObjectStore, ObjectStoreExt as _, PutMode, RetryConfig};
use uuid::Uuid;

use crate::error::{RegistryError, store_error};

/// Address of an object store.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct StoreConfig {
    /// `file:///folder` (made when absent) or `s3://bucket/prefix`.
    pub url: String,
    /// S3 settings that go before the `AWS_*` environment variables, under the same names in lower case
    /// (`aws_endpoint`, `aws_access_key_id`, ...).
    pub options: Vec<(String, String)>,
}

impl StoreConfig {
    /// With settings from the environment alone.
    pub fn new(url: impl Into<String>) -> Self {
        Self {
            url: url.into(),
            options: Vec::new(),
        }
    }
}

/// What the store was found to do at start.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Probe {
    /// A second create of the same object is refused. Informative: correctness does not rest on it.
    pub conditional_create: bool,
    /// Reads can be handed to clients as signed URLs.
    pub signs_urls: bool,
}

/// Blobs, manifests and versions in one store. Cheap to clone; holds no state of its own.
#[derive(Clone, Debug)]
pub struct Registry {
    pub(crate) store: Arc<dyn ObjectStore>,
    /// The same place, for what [`crate::versions`] writes: a local disk is not made to flush it.
    pub(crate) records: Arc<dyn ObjectStore>,
    signer: Option<Arc<dyn Signer>>,
    prefix: Path,
    probe: Probe,
}

impl Registry {
    /// Opens the store, checks that it can be written and read, and finds out what it can do.
    pub async fn open(config: &StoreConfig) -> Result<Self, RegistryError> {
        let registry = Self::connect(config)?.prepared().await?;
        if !registry.probe.conditional_create {
            tracing::warn!(
                store.url = config.url,
                "store ignores conditional create; the database alone guards versions"
            );
        }
        Ok(registry)
    }

    /// On a store that is open already; its URLs are not signed.
    pub async fn on(store: Arc<dyn ObjectStore>) -> Result<Self, RegistryError> {
        Self::new(store.clone(), store, None, Path::default())
            .prepared()
            .await
    }

    /// For reading alone: nothing is written, not even to try the store out.
    pub fn connect(config: &StoreConfig) -> Result<Self, RegistryError> {
        let wrong = |reason: String| RegistryError::Location {
            url: config.url.clone(),
            reason,
        };
        match config.url.split_once("://") {
            Some(("file", folder)) if folder.starts_with('/') => {
                std::fs::create_dir_all(folder).map_err(|error| wrong(error.to_string()))?;
                let open = |flushed| {
                    LocalFileSystem::new_with_prefix(folder)
                        .map(|local| Arc::new(local.with_fsync(flushed)))
                        .map_err(|error| wrong(error.to_string()))
                };
                Ok(Self::new(open(true)?, open(false)?, None, Path::default()))
            }
            Some(("s3", rest)) => {
                let (bucket, prefix) = rest.split_once('/').unwrap_or((rest, ""));
                if bucket.is_empty() {
                    return Err(wrong("it names no bucket".to_owned()));
                }
                let prefix = Path::parse(prefix).map_err(|error| wrong(error.to_string()))?;
                let mut builder = AmazonS3Builder::from_env()
                    .with_bucket_name(bucket)
                    .with_retry(RetryConfig {
                        max_retries: 3,
                        retry_timeout: Duration::from_secs(15),
                        ..RetryConfig::default()
                    });
                for (key, value) in &config.options {
                    let key = key
                        .parse()
                        .map_err(|error: object_store::Error| wrong(error.to_string()))?;
                    builder = builder.with_config(key, value);
                }
                let s3 = Arc::new(builder.build().map_err(|error| wrong(error.to_string()))?);
                Ok(Self::new(s3.clone(), s3.clone(), Some(s3), prefix))
            }
            _ => Err(wrong(
                "expected file:///folder or s3://bucket/prefix".to_owned(),
            )),
        }
    }

    fn new(
        store: Arc<dyn ObjectStore>,
        records: Arc<dyn ObjectStore>,
        signer: Option<Arc<dyn Signer>>,
        prefix: Path,
    ) -> Self {
        Self {
            store,
            records,
            probe: Probe {
                conditional_create: false,
                signs_urls: signer.is_some(),
            },
            signer,
            prefix,
        }
    }

    async fn prepared(mut self) -> Result<Self, RegistryError> {
        self.probe.conditional_create = self.try_out().await?;
        self.put_bytes(Bytes::from_static(EMPTY_CONFIG)).await?;
        Ok(self)
    }

    /// What the store was found to do.
    pub fn probe(&self) -> Probe {
        self.probe
    }

    /// Whether the store answers, for readiness checks.
    pub async fn ping(&self) -> Result<(), RegistryError> {
        let path = self.blob_path(&ign_proto::Digest::of(EMPTY_CONFIG));
        self.store
            .head(&path)
            .await
            .map(drop)
            .map_err(store_error("read", &path))
    }

    /// Writes, reads, writes again and deletes one object; says whether the second create was refused.
    ///
    /// # Errors
    /// The store does not do one of these.
    pub async fn try_out(&self) -> Result<bool, RegistryError> {
        let path = self.path(&format!("probe/{}", Uuid::now_v7()));
        self.store
            .put(&path, "first".into())
            .await
            .map_err(store_error("write", &path))?;
        let second = self
            .store
            .put_opts(&path, "second".into(), PutMode::Create.into())
            .await;
        let read = self
            .store
            .get(&path)
            .await
            .map_err(store_error("read", &path))?;
        let kept: Vec<Bytes> = read
            .into_stream()
            .try_collect()
            .await
            .map_err(store_error("read", &path))?;
        self.store
            .delete(&path)
            .await
            .map_err(store_error("delete", &path))?;
        Ok(second.is_err() && kept.concat() == b"first")
    }

    pub(crate) fn path(&self, relative: &str) -> Path {
        relative.split('/').fold(self.prefix.clone(), Path::join)
    }

    /// The part of a store's path after our prefix, as names.
    pub(crate) fn names(&self, path: &Path) -> Vec<String> {
        path.prefix_match(&self.prefix)
            .map(|parts| parts.map(|part| part.as_ref().to_owned()).collect())
            .unwrap_or_default()
    }

    /// A URL from which anyone can read the object until it expires; none when the store cannot sign.
    pub(crate) async fn sign(
        &self,
        path: &Path,
        valid_for: Duration,
    ) -> Result<Option<String>, RegistryError> {
        let Some(signer) = &self.signer else {
            return Ok(None);
        };
        let url = signer
            .signed_url(http::Method::GET, path, valid_for)
            .await
            .map_err(store_error("sign", path))?;
        Ok(Some(url.to_string()))
    }
}
