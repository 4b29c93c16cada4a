//! From a capture folder to a submitted job: hash, send what the store lacks, write the manifest, submit.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::PathBuf;

use futures::{StreamExt as _, TryStreamExt as _};
use ign_proto::manifest::EMPTY_CONFIG;
use ign_proto::{Digest, ObjectName, v1};
use tokio::sync::{Mutex, OnceCell, Semaphore};

use crate::connection::Connection;
use crate::data_plane::DataPlane;
use crate::output::Live;
use crate::pack::{self, PackedFile};
use crate::problem::Problem;
use crate::recipe::Recipe;

/// Files that are sent or fetched at the same time.
pub(crate) const TRANSFERS_AT_ONCE: usize = 4;
/// Locks of which each guards a share of all digests.
const GUARDS: usize = 64;

/// What to bake, ready to be packed.
pub(crate) struct Order {
    pub(crate) capture: PathBuf,
    pub(crate) proxy: Option<PathBuf>,
    pub(crate) object: ObjectName,
    pub(crate) recipe: Recipe,
    pub(crate) priority: i32,
    pub(crate) labels: BTreeMap<String, String>,
}

impl Order {
    /// Bytes of its capture; a folder that cannot be read is reported when it is uploaded.
    pub(crate) fn size_bytes(&self) -> u64 {
        let files = pack::list(&self.capture, self.proxy.as_deref()).unwrap_or_default();
        files.iter().map(|file| file.size_bytes).sum()
    }
}

/// Brings captures to the store, several at a time, with one progress over all of them. However many there are, so many
/// files at most are on their way, and no bytes go twice.
pub(crate) struct Uploader<'a> {
    connection: &'a Connection,
    live: Live,
    transfers: Semaphore,
    /// The same bytes in two captures: the second waits and finds them there.
    guards: Vec<Mutex<()>>,
    config_is_there: OnceCell<()>,
}

impl<'a> Uploader<'a> {
    /// For captures of so many bytes in all.
    pub(crate) fn new(connection: &'a Connection, total_bytes: u64) -> Self {
        Self {
            connection,
            live: Live::transfer("upload", total_bytes),
            transfers: Semaphore::new(TRANSFERS_AT_ONCE),
            guards: (0..GUARDS).map(|_| Mutex::default()).collect(),
            config_is_there: OnceCell::new(),
        }
    }

    /// Hashes the capture of `order` and sends what the store lacks; its digest. One whose manifest is there costs one
    /// question, unless `check` says to ask for every file.
    pub(crate) async fn upload(&self, order: &Order, check: bool) -> Result<Digest, Problem> {
        let (capture, proxy) = (order.capture.clone(), order.proxy.clone());
        let files = tokio::task::spawn_blocking(move || pack::list(&capture, proxy.as_deref()))
            .await
            .map_err(|error| Problem::failed(format!("reading the folder stopped: {error}")))??;
        let packed = pack::pack(files, |_| ()).await?;
        let store = self.connection.data_plane(&order.object)?;
        if !check && store.has_manifest(&packed.digest).await? {
            let files = packed.files.iter();
            self.live.add(files.map(|it| it.file.size_bytes).sum());
            return Ok(packed.digest);
        }
        self.config_is_there
            .get_or_try_init(async || {
                let digest = Digest::of(EMPTY_CONFIG);
                store.upload_bytes(&digest, EMPTY_CONFIG).await
            })
            .await?;
        futures::stream::iter(&packed.files)
            .map(|file| self.send(&store, file))
            .buffer_unordered(TRANSFERS_AT_ONCE)
            .try_collect::<Vec<()>>()
            .await?;
        store.put_manifest(&packed.digest, &packed.manifest).await?;
        Ok(packed.digest)
    }

    async fn send(&self, store: &DataPlane, file: &PackedFile) -> Result<(), Problem> {
        let guard = usize::from_str_radix(&file.digest.hex()[..4], 16).unwrap_or(0) % GUARDS;
        let _alone = self.guards[guard].lock().await;
        // Never closed.
        let _place = self.transfers.acquire().await.ok();
        let sent = |count: i64| {
            if count >= 0 {
                self.live.add(count as u64);
            } else {
                self.live.take_back(count.unsigned_abs());
            }
        };
        store.upload(file, &sent).await
    }

    /// Writes a line above the progress.
    pub(crate) fn say(&self, text: &str) {
        self.live.above(text);
    }
}

/// Hashes and uploads the capture of `order` alone; returns its digest.
pub(crate) async fn upload(connection: &Connection, order: &Order) -> Result<Digest, Problem> {
    let uploader = Uploader::new(connection, order.size_bytes());
    uploader.upload(order, true).await
}

/// The job specification of `order` for a capture that was uploaded.
pub(crate) fn spec(order: &Order, capture: &Digest) -> Result<v1::JobSpec, Problem> {
    Ok(v1::JobSpec {
        object: Some((&order.object).into()),
        capture_digest: capture.to_string(),
        recipe_json: order.recipe.json()?,
        priority: order.priority,
        labels: order.labels.clone().into_iter().collect(),
        max_attempts: 0,
    })
}

/// A request id that repeats for the same specification and `salt`.
pub(crate) fn request_id(spec: &v1::JobSpec, salt: &str) -> String {
    let object = spec.object.clone().unwrap_or_default();
    let mut text = [
        object.collection.as_str(),
        &object.object,
        &spec.capture_digest,
        &spec.recipe_json,
        &spec.priority.to_string(),
        salt,
    ]
    .join("\n");
    let labels: BTreeMap<&String, &String> = spec.labels.iter().collect();
    for (key, value) in labels {
        // Writing to a String cannot fail.
        let _infallible = write!(text, "\n{key:?}={value:?}");
    }
    Digest::of(text.as_bytes()).hex()[..32].to_string()
}

/// Submits; the same request id returns the same job.
pub(crate) async fn submit(
    connection: &Connection,
    spec: v1::JobSpec,
    request_id: String,
) -> Result<v1::Job, Problem> {
    let request = v1::SubmitRequest {
        request_id,
        spec: Some(spec),
    };
    Ok(connection.jobs().submit(request).await?.into_inner())
}

/// Submits several with one call; an answer for each, in their order.
pub(crate) async fn submit_all(
    connection: &Connection,
    requests: Vec<v1::SubmitRequest>,
) -> Result<Vec<Result<v1::Job, Refused>>, Problem> {
    let count = requests.len();
    let stream = futures::stream::iter(requests);
    let answer = connection.jobs().submit_batch(stream).await?.into_inner();
    if answer.results.len() != count {
        return Err(Problem::failed(format!(
            "the coordinator answered {} of {count} requests",
            answer.results.len()
        )));
    }
    let outcome = |result: v1::SubmitResult| match result.outcome {
        Some(v1::submit_result::Outcome::Job(job)) => Ok(job),
        Some(v1::submit_result::Outcome::Error(error)) => Err(Refused {
            capture_is_missing: error.code == "CAPTURE_MISSING",
            problem: Problem::failed(error.message),
        }),
        None => Err(Refused {
            capture_is_missing: false,
            problem: Problem::failed("the coordinator gave no answer to a request"),
        }),
    };
    Ok(answer.results.into_iter().map(outcome).collect())
}

/// Why one of several requests was not taken.
pub(crate) struct Refused {
    /// Files of its capture are not there (any more).
    pub(crate) capture_is_missing: bool,
    pub(crate) problem: Problem,
}

#[cfg(test)]
mod tests {
    use super::*;

    fn spec_with(priority: i32, digest: &str) -> v1::JobSpec {
        v1::JobSpec {
            object: Some(v1::ObjectRef {
                collection: "museum".into(),
                object: "vase".into(),
            }),
            capture_digest: digest.into(),
            recipe_json: "{}".into(),
            priority,
            ..Default::default()
        }
    }

    #[test]
    fn request_ids_repeat_for_the_same_content_only() {
        let id = request_id(&spec_with(0, "a"), "");
        assert_eq!(id, request_id(&spec_with(0, "a"), ""));
        assert_ne!(id, request_id(&spec_with(0, "b"), ""));
        assert_ne!(id, request_id(&spec_with(1, "a"), ""));
        assert_ne!(id, request_id(&spec_with(0, "a"), "again"));
        let mut labelled = spec_with(0, "a");
        labelled.labels.insert("room".into(), "3".into());
        assert_ne!(id, request_id(&labelled, ""));
        assert_eq!(id.len(), 32);
    }
}
