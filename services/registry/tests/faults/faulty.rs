//! An object store that fails as real ones do, by a seeded plan.

use std::fmt;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};

use async_trait::async_trait;
use bytes::Bytes;
use futures::StreamExt as _;
use futures::stream::{self, BoxStream};
use object_store::local::LocalFileSystem;
use object_store::path::Path;
use object_store::{
    CopyOptions, Error, Extensions, GetOptions, GetResult, GetResultPayload, ListResult,
    MultipartUpload, ObjectMeta, ObjectStore, PutMode, PutMultipartOptions, PutOptions, PutPayload,
    PutResult, RenameOptions, Result,
};
use rand::{RngExt, SeedableRng as _};
use rand_pcg::Pcg64Mcg;

/// What a conditional put really does.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Conditional {
    /// What it says.
    Honest,
    /// Ignores the condition and overwrites.
    Overwrites,
    /// Says that it wrote, and kept what was there.
    ClaimsSuccess,
    /// Says that it refused, and overwrote.
    OverwritesAndRefuses,
}

/// One call in `one_in` fails, in one of the ways of a network or a server.
pub(crate) struct Faulty {
    inner: LocalFileSystem,
    plan: Mutex<Pcg64Mcg>,
    one_in: u32,
    conditional: Conditional,
    full: AtomicBool,
    /// Faults that were played.
    pub(crate) played: AtomicU64,
}

/// How a call fails.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Fault {
    /// Nothing happened.
    Before,
    /// It happened, and the answer was lost.
    After,
}

impl Faulty {
    /// Over a folder; faults are off until [`Faulty::start`].
    pub(crate) fn new(folder: &std::path::Path, seed: u64, one_in: u32) -> Arc<Self> {
        Self::with(folder, seed, one_in, Conditional::Honest)
    }

    pub(crate) fn with(
        folder: &std::path::Path,
        seed: u64,
        one_in: u32,
        conditional: Conditional,
    ) -> Arc<Self> {
        Arc::new(Self {
            inner: LocalFileSystem::new_with_prefix(folder).unwrap(),
            plan: Mutex::new(Pcg64Mcg::seed_from_u64(seed)),
            one_in,
            conditional,
            full: AtomicBool::new(false),
            played: AtomicU64::new(0),
        })
    }

    /// From now on every write is refused for want of room, or no longer.
    pub(crate) fn set_full(&self, full: bool) {
        self.full.store(full, Ordering::SeqCst);
    }

    fn fault(&self) -> Option<Fault> {
        let mut plan = self.plan.lock().unwrap();
        if self.one_in == 0 || !plan.random_ratio(1, self.one_in) {
            return None;
        }
        self.played.fetch_add(1, Ordering::Relaxed);
        Some(if plan.random_bool(0.5) {
            Fault::Before
        } else {
            Fault::After
        })
    }

    /// Plays one call of the plan around `work`.
    async fn play<T>(&self, work: impl Future<Output = Result<T>>) -> Result<T> {
        match self.fault() {
            None => work.await,
            Some(Fault::Before) => Err(broken("connection refused")),
            Some(Fault::After) => {
                work.await?;
                Err(broken("the answer timed out"))
            }
        }
    }

    fn check_room(&self) -> Result<()> {
        if self.full.load(Ordering::SeqCst) {
            return Err(Error::Generic {
                store: "faulty",
                source: Box::new(std::io::Error::from(std::io::ErrorKind::StorageFull)),
            });
        }
        Ok(())
    }
}

fn broken(what: &'static str) -> Error {
    Error::Generic {
        store: "faulty",
        source: what.into(),
    }
}

impl fmt::Debug for Faulty {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Faulty")
    }
}

impl fmt::Display for Faulty {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("faulty")
    }
}

#[async_trait]
impl ObjectStore for Faulty {
    async fn put_opts(
        &self,
        location: &Path,
        payload: PutPayload,
        mut opts: PutOptions,
    ) -> Result<PutResult> {
        self.check_room()?;
        if opts.mode == PutMode::Create {
            match self.conditional {
                Conditional::Honest => {}
                Conditional::Overwrites => opts.mode = PutMode::Overwrite,
                Conditional::ClaimsSuccess => {
                    if self
                        .inner
                        .get_opts(location, GetOptions::default())
                        .await
                        .is_ok()
                    {
                        return Ok(PutResult {
                            e_tag: None,
                            version: None,
                            extensions: Extensions::default(),
                        });
                    }
                }
                Conditional::OverwritesAndRefuses => {
                    opts.mode = PutMode::Overwrite;
                    self.inner.put_opts(location, payload, opts).await?;
                    return Err(Error::AlreadyExists {
                        path: location.to_string(),
                        source: "it is there".into(),
                    });
                }
            }
        }
        self.play(self.inner.put_opts(location, payload, opts))
            .await
    }

    async fn put_multipart_opts(
        &self,
        location: &Path,
        opts: PutMultipartOptions,
    ) -> Result<Box<dyn MultipartUpload>> {
        self.check_room()?;
        self.play(self.inner.put_multipart_opts(location, opts))
            .await
    }

    /// Half of the faults cut the body: with an error, or without a word.
    async fn get_opts(&self, location: &Path, options: GetOptions) -> Result<GetResult> {
        let head = options.head;
        let result = match self.fault() {
            Some(Fault::Before) => return Err(broken("connection refused")),
            None => return self.inner.get_opts(location, options).await,
            Some(Fault::After) => self.inner.get_opts(location, options).await?,
        };
        if head {
            return Err(broken("the answer timed out"));
        }
        let silent = self.plan.lock().unwrap().random_bool(0.5);
        let (meta, range, attributes) = (
            result.meta.clone(),
            result.range.clone(),
            result.attributes.clone(),
        );
        let extensions = result.extensions.clone();
        let bytes = result.bytes().await?;
        let mut pieces: Vec<Result<Bytes>> = vec![Ok(bytes.slice(..bytes.len() / 2))];
        if !silent {
            pieces.push(Err(broken("connection reset")));
        }
        Ok(GetResult {
            payload: GetResultPayload::Stream(stream::iter(pieces).boxed()),
            meta,
            range,
            attributes,
            extensions,
        })
    }

    fn delete_stream(
        &self,
        locations: BoxStream<'static, Result<Path>>,
    ) -> BoxStream<'static, Result<Path>> {
        match self.fault() {
            None => self.inner.delete_stream(locations),
            Some(Fault::Before) => {
                stream::once(async { Err(broken("connection refused")) }).boxed()
            }
            Some(Fault::After) => self
                .inner
                .delete_stream(locations)
                .map(|_done| Err(broken("the answer timed out")))
                .boxed(),
        }
    }

    fn list(&self, prefix: Option<&Path>) -> BoxStream<'static, Result<ObjectMeta>> {
        match self.fault() {
            None => self.inner.list(prefix),
            Some(_) => self
                .inner
                .list(prefix)
                .take(1)
                .chain(stream::once(async { Err(broken("connection reset")) }))
                .boxed(),
        }
    }

    async fn list_with_delimiter(&self, prefix: Option<&Path>) -> Result<ListResult> {
        self.play(self.inner.list_with_delimiter(prefix)).await
    }

    async fn copy_opts(&self, from: &Path, to: &Path, options: CopyOptions) -> Result<()> {
        self.check_room()?;
        self.play(self.inner.copy_opts(from, to, options)).await
    }

    async fn rename_opts(&self, from: &Path, to: &Path, options: RenameOptions) -> Result<()> {
        self.play(self.inner.rename_opts(from, to, options)).await
    }
}
