//! What a queue can do, whatever database keeps it: the [`Store`] trait, its types and errors.
//!
//! Every write is idempotent by a key of the caller (request id, attempt, manifest), so that a call whose outcome is
//! unknown is safely repeated. Time is the database's clock: machines whose clocks differ agree on leases.
//!
//! Invariant: no transaction is open between calls, let alone while a job runs.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use async_trait::async_trait;
use chrono::{DateTime, Utc};
use ign_proto::{Attempt, CollectionId, Digest, JobId, ObjectId, ObjectName, WorkerId};

use crate::changes::Changes;
use crate::state::{Backoff, Checkpoint, Failure, Job, JobSpec, JobState, Level, Progress};
use crate::token::Tokens;
use crate::webhook::Webhooks;

/// Lines kept of a job's log; older ones go.
pub const MAX_LOG_LINES: u64 = 10_000;
/// Bytes kept of a log line.
pub const MAX_LOG_LINE_BYTES: usize = 4096;
/// Jobs in one page of a list.
pub const MAX_PAGE: u32 = 1000;
/// Events kept; older ones go.
pub const MAX_EVENTS: u64 = 100_000;
/// Bytes of a recipe.
pub const MAX_RECIPE_BYTES: usize = 64 * 1024;

/// Why a store refused or failed.
#[derive(Debug, thiserror::Error)]
pub enum StoreError {
    /// It does not exist.
    #[error("{kind} {name} does not exist")]
    NotFound {
        /// job, bundle, worker.
        kind: &'static str,
        /// What was asked for.
        name: String,
    },
    /// The request id came before with another payload.
    #[error("request id {key} was used before with another payload")]
    Conflict {
        /// The request id.
        key: String,
    },
    /// The attempt does not hold the job; nothing was changed.
    #[error("attempt {attempt} no longer holds job {job}")]
    LeaseLost {
        /// The job.
        job: JobId,
        /// The attempt that was refused.
        attempt: Attempt,
    },
    /// The argument is not acceptable.
    #[error("{field}: {message}")]
    Invalid {
        /// Which argument.
        field: &'static str,
        /// What is wrong with it.
        message: String,
    },
    /// The state of the thing does not allow it.
    #[error("{message}")]
    NotAllowed {
        /// What stands in the way.
        message: String,
    },
    /// The database cannot be reached, is full or too busy. Worth trying again.
    #[error("the database is unavailable")]
    Unavailable {
        /// True: nothing was changed. False: it may have been.
        determinate: bool,
        /// What the driver said.
        #[source]
        source: sqlx::Error,
    },
    /// The database holds something that this program cannot read, or refused a statement: a bug or a foreign hand.
    #[error("unexpected answer of the database: {message}")]
    Internal {
        /// Where.
        message: String,
        /// What the driver said, when it was the driver.
        #[source]
        source: Option<sqlx::Error>,
    },
}

/// A result of a store.
pub type Result<T> = std::result::Result<T, StoreError>;

/// Times of a store.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Settings {
    /// How long a worker may be silent. Heartbeats come three times as often.
    pub lease: Duration,
    /// How long a failed attempt waits for the next.
    pub backoff: Backoff,
    /// Longest sleep of [`Changes::wait`]: back-offs end without a signal, and signals can be lost.
    pub poll: Duration,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            lease: Duration::from_secs(45),
            backoff: Backoff::default(),
            poll: Duration::from_secs(1),
        }
    }
}

/// A bake to queue.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Submit {
    /// Key within the collection: the same key and spec give the same job.
    pub request_id: String,
    /// What to bake; `max_attempts` 0 means the default.
    pub spec: JobSpec,
    /// W3C trace context of the call; no part of what makes two submits the same.
    pub traceparent: Option<String>,
}

/// Which jobs to list; empty fields do not filter.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct JobFilter {
    /// Of this collection.
    pub collection: Option<CollectionId>,
    /// Of objects with this name.
    pub object: Option<ObjectId>,
    /// In one of these states.
    pub states: Vec<JobState>,
    /// With all of these labels.
    pub labels: BTreeMap<String, String>,
}

/// A page of jobs, newest first.
#[derive(Clone, Debug, PartialEq)]
pub struct JobPage {
    /// The jobs.
    pub jobs: Vec<Job>,
    /// Pass it as `after` for the next page; none at the end.
    pub next: Option<JobId>,
}

/// Why a queued job is not leased yet; of one that is not queued, the default.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Waiting {
    /// Estimate of the jobs that are leased before it: those of its own collection, and the share of the others.
    pub position: u64,
    /// In words; empty unless queued.
    pub reason: String,
}

/// A worker agent as it introduces itself.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct WorkerInfo {
    /// Unique while it runs.
    pub id: WorkerId,
    /// Machine it runs on.
    pub hostname: String,
    /// Its version.
    pub version: String,
    /// What it computes with.
    pub device: String,
}

/// A worker agent as the queue knows it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Worker {
    /// As it introduced itself.
    pub info: WorkerInfo,
    /// Its last lease call or heartbeat.
    pub last_seen_at: DateTime<Utc>,
    /// What it runs, the latest first: one job per busy slot.
    pub jobs: Vec<JobId>,
    /// It gets no more jobs.
    pub draining: bool,
}

/// What a worker is told with a heartbeat.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Orders {
    /// Stop this job and report it cancelled.
    pub cancel: bool,
    /// Finish this job, then ask for no more.
    pub drain: bool,
}

/// A line that a worker adds to its job's log.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NewLogLine {
    /// The worker's own count within the attempt, from 1: a repeated call adds nothing. 0 when it does not count.
    pub source_seq: u64,
    /// When it happened, by the worker's clock.
    pub at: DateTime<Utc>,
    /// Severity.
    pub level: Level,
    /// What happened.
    pub message: String,
}

/// A line of a job's log.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LogLine {
    /// Grows over the job's whole life.
    pub seq: u64,
    /// When it happened, by the worker's clock.
    pub at: DateTime<Utc>,
    /// Which attempt said it.
    pub attempt: Attempt,
    /// Severity.
    pub level: Level,
    /// What happened.
    pub message: String,
}

/// A bundle whose blobs and manifest are in the object store.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NewVersion {
    /// Its manifest.
    pub manifest_digest: Digest,
    /// All its files together.
    pub size_bytes: u64,
    /// Number of its files.
    pub file_count: u32,
    /// Summary of metrics.json for listings.
    pub metrics_json: String,
}

/// A published bundle.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Version {
    /// Of which object.
    pub object: ObjectName,
    /// 1, 2, ...; shown as v1, v2.
    pub version: u32,
    /// Its content.
    pub bundle: NewVersion,
    /// Names that point to it, sorted.
    pub aliases: Vec<String>,
    /// When it was published.
    pub created_at: DateTime<Utc>,
    /// Which job made it.
    pub job: JobId,
    /// Taken out of listings.
    pub retired: bool,
    /// Since when; its files stay for a grace period after that.
    pub retired_at: Option<DateTime<Utc>>,
}

/// What of an object's versions may change; all else of a version stays as it was published.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Standing {
    /// Number of the newest version, listed or not.
    pub newest: u32,
    /// Alias to version.
    pub aliases: BTreeMap<String, u32>,
    /// Versions taken out of listings, and since when, where that is known.
    pub retired: BTreeMap<u32, Option<DateTime<Utc>>>,
}

/// What [`Store::adopt`] did.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Adopted {
    /// Versions that the database did not know.
    pub added: Vec<u32>,
    /// Versions that it knew, and the same.
    pub known: u32,
    /// Versions that it knows with other content; nothing was changed about them.
    pub differing: Vec<u32>,
}

/// What the database names in the object store: nothing of it may go.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Named {
    /// Manifests of versions that are published or were retired lately, and of captures of jobs that live or ended
    /// lately.
    pub manifests: BTreeSet<Digest>,
    /// Checkpoints of those jobs.
    pub checkpoints: BTreeSet<Digest>,
}

/// Something that happened to the registry.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Event {
    /// Grows with each event.
    pub seq: u64,
    /// When, by the database's clock.
    pub at: DateTime<Utc>,
    /// A constant word, such as `damage`.
    pub kind: String,
    /// What it is about: a path, an object's version; may be empty.
    pub subject: String,
    /// In words.
    pub message: String,
}

/// Which bundles to list; empty fields do not filter.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct VersionFilter {
    /// Of this collection.
    pub collection: Option<CollectionId>,
    /// Of objects with this name.
    pub object: Option<ObjectId>,
    /// Retired ones too.
    pub include_retired: bool,
}

/// Shares and limits of a museum or department.
#[derive(Clone, Debug, PartialEq)]
pub struct Collection {
    /// Its name.
    pub name: CollectionId,
    /// Share of the workers relative to other collections.
    pub weight: f64,
    /// Running jobs at once; 0 means no limit.
    pub max_running: u32,
    /// Nothing is leased from it.
    pub paused: bool,
}

impl Collection {
    /// A collection as it is before anybody sets it.
    pub fn new(name: CollectionId) -> Self {
        Self {
            name,
            weight: 1.0,
            max_running: 0,
            paused: false,
        }
    }
}

/// One screen for an operator.
#[derive(Clone, Debug, PartialEq)]
pub struct Status {
    /// Jobs by state; every state is there.
    pub counts: BTreeMap<JobState, u64>,
    /// Workers seen within the last hour.
    pub workers: Vec<Worker>,
    /// Leased jobs, the longest running first.
    pub running: Vec<Job>,
    /// Failed jobs, the latest first.
    pub recent_failures: Vec<Job>,
    /// Queued jobs by priority and age, with what they wait for.
    pub next_queued: Vec<(Job, Waiting)>,
    /// The database's time.
    pub at: DateTime<Utc>,
}

/// What [`Store::reap`] did.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Reaped {
    /// Queued again.
    pub requeued: Vec<JobId>,
    /// Ended: out of attempts, or cancelled while their worker was gone.
    pub ended: Vec<JobId>,
}

/// A durable queue of jobs with its registry of versions.
#[async_trait]
pub trait Store: Tokens + Webhooks + Send + Sync + std::fmt::Debug + 'static {
    /// The times it works with.
    fn settings(&self) -> Settings;

    /// Registers interest in changes from now on: call it before the query whose answer is to be watched.
    fn changes(&self) -> Changes;

    /// The same for those changes alone after which [`Store::lease`] may give more than before: heartbeats and progress
    /// do not wake workers that wait for jobs.
    fn work(&self) -> Changes;

    /// Whether the database answers.
    async fn ping(&self) -> Result<()>;

    /// Queues one bake. Same request id and spec: the job that is there. Other spec: [`StoreError::Conflict`].
    async fn submit(&self, request: Submit) -> Result<Job> {
        let mut results = self.submit_batch(vec![request]).await?;
        results.pop().unwrap_or_else(|| {
            Err(StoreError::Internal {
                message: "no result for a submit".to_owned(),
                source: None,
            })
        })
    }

    /// Queues many bakes; one result per request, in order. One bad request does not hinder the others.
    async fn submit_batch(&self, requests: Vec<Submit>) -> Result<Vec<Result<Job>>>;

    /// The job.
    async fn get(&self, job: JobId) -> Result<Job>;

    /// The job whose id starts with these characters (at least 4): none or several are errors.
    async fn find(&self, prefix: &str) -> Result<Job>;

    /// Jobs, newest first, after the one that ended the last page; at most [`MAX_PAGE`] at once.
    async fn list(&self, filter: &JobFilter, after: Option<JobId>, limit: u32) -> Result<JobPage>;

    /// How long a queued job will wait and for what.
    async fn waiting(&self, job: &Job) -> Result<Waiting> {
        let mut results = self.all_waiting(std::slice::from_ref(job)).await?;
        results.pop().ok_or_else(|| StoreError::Internal {
            message: "no result for a job".to_owned(),
            source: None,
        })
    }

    /// The same of several jobs, in their order; each part of the queue is counted once.
    async fn all_waiting(&self, jobs: &[Job]) -> Result<Vec<Waiting>>;

    /// Stops a job: at once while queued, with its worker's next heartbeat while leased.
    async fn cancel(&self, job: JobId) -> Result<Job>;

    /// Queues a failed or cancelled job again.
    async fn retry(&self, job: JobId) -> Result<Job>;

    /// Log lines with a larger sequence number, oldest first.
    async fn logs(&self, job: JobId, after_seq: u64, limit: u32) -> Result<Vec<LogLine>>;

    /// Counts, workers and the jobs that matter now; `limit` bounds each list of jobs.
    async fn status(&self, collection: Option<&CollectionId>, limit: u32) -> Result<Status>;

    /// The next job for a worker: priority, then the collection with the fewest running jobs for its weight, then the
    /// one served longest ago, then age. None when there is nothing to do or the worker drains.
    async fn lease(&self, worker: &WorkerInfo) -> Result<Option<Job>> {
        self.lease_within(worker, None, None).await
    }

    /// As [`Store::lease`], for whom the caller's token or certificate says, from these collections alone; none for all.
    async fn lease_within(
        &self,
        worker: &WorkerInfo,
        holder: Option<&str>,
        collections: Option<&BTreeSet<CollectionId>>,
    ) -> Result<Option<Job>>;

    /// Extends the lease, keeps progress and log lines.
    async fn heartbeat(
        &self,
        job: JobId,
        attempt: Attempt,
        progress: Option<Progress>,
        logs: Vec<NewLogLine>,
    ) -> Result<Orders>;

    /// Remembers where the next attempt resumes; the blob is in the object store.
    async fn checkpoint(&self, job: JobId, attempt: Attempt, checkpoint: Checkpoint) -> Result<()>;

    /// Publishes the bundle as the object's next version, moves `latest`, ends the job: all or nothing, under the
    /// job's row lock. Repeated with the same manifest it answers the same version.
    async fn publish_and_complete(
        &self,
        job: JobId,
        attempt: Attempt,
        bundle: NewVersion,
    ) -> Result<Version>;

    /// Ends the attempt without a result; answers whether the job is queued again.
    async fn fail(
        &self,
        job: JobId,
        attempt: Attempt,
        failure: Failure,
        logs: Vec<NewLogLine>,
    ) -> Result<bool>;

    /// Takes jobs back from workers that were silent for a whole lease. Let a coordinator that was away wait one lease
    /// before its first call, so that workers which outlived it can report.
    async fn reap(&self) -> Result<Reaped>;

    /// Workers seen within the last hour.
    async fn workers(&self) -> Result<Vec<Worker>>;

    /// Lets a worker finish what it runs and gives it no more, or takes that back.
    async fn drain_worker(&self, worker: &WorkerId, draining: bool) -> Result<()>;

    /// Published bundles by collection, object and version.
    async fn versions(&self, filter: &VersionFilter) -> Result<Vec<Version>>;

    /// What of an object's versions may change.
    async fn standing(&self, object: &ObjectName) -> Result<Standing>;

    /// One bundle by version (`v3`), alias (`latest`) or manifest digest; empty means `latest`.
    async fn version(&self, object: &ObjectName, reference: &str) -> Result<Version>;

    /// Points an alias to a version.
    async fn set_alias(&self, object: &ObjectName, reference: &str, alias: &str)
    -> Result<Version>;

    /// Takes a version out of listings. `latest` falls back to the newest that is left; another alias that points to it
    /// must be moved first.
    async fn retire(&self, object: &ObjectName, reference: &str) -> Result<Version>;

    /// Puts a retired version back into listings; `latest` points to the newest again. Whether its files are still there
    /// is the caller's to check.
    async fn restore(&self, object: &ObjectName, reference: &str) -> Result<Version>;

    /// Takes over versions of one object that the object store records. Those that are known stay as they are; an alias
    /// follows the given one where it points to a version that was added, or was not there.
    async fn adopt(&self, object: &ObjectName, versions: &[Version]) -> Result<Adopted>;

    /// What the database names, with what it stopped naming within `grace`.
    async fn named(&self, grace: Duration) -> Result<Named>;

    /// Remembers that something happened; the last [`MAX_EVENTS`] are kept.
    async fn record(&self, kind: &str, subject: &str, message: &str) -> Result<()>;

    /// Events with a smaller sequence number (0: all), newest first.
    async fn events(&self, before_seq: u64, limit: u32) -> Result<Vec<Event>>;

    /// Whether it is the caller's turn to do work that is done once in `every`, whoever does it: the number of the turn,
    /// from 0.
    async fn take_turn(&self, work: &str, every: Duration) -> Result<Option<u64>>;

    /// All collections by name. Submitting makes a collection.
    async fn collections(&self) -> Result<Vec<Collection>>;

    /// Sets shares and limits; makes the collection where it is new.
    async fn set_collection(&self, collection: Collection) -> Result<Collection>;
}
