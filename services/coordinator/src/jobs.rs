//! `ign.v1.Jobs`: submitting, looking, waiting.

use std::cmp::Ordering;
use std::collections::{BTreeMap, BTreeSet};
use std::pin::Pin;
use std::sync::Arc;
use std::time::Duration;

use futures::Stream;
use futures::stream::{self, StreamExt as _, TryStreamExt as _};
use ign_proto::v1::jobs_server::Jobs;
use ign_proto::{Cause, CollectionId, Digest, JobId, Kind, Scope, v1};
use ign_queue::store::MAX_PAGE;
use ign_queue::{
    Job, JobFilter, JobPage, JobState, Status as Screen, StoreError, Submit, Waiting, Worker,
};
use ign_registry::RegistryError;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Request, Response, Status, Streaming};

use crate::access::{Caller, Reach};
use crate::app::App;
use crate::auth::caller;
use crate::convert::{
    job_spec, job_state, optional, parsed, required, to_bundle, to_job, to_log_line, to_timestamp,
    to_worker,
};
use crate::http_answer::Refused;
use crate::room::Write;
use crate::trace;

const DEFAULT_PAGE: u32 = 100;
const BATCH: usize = 500;
const LOOKUPS_IN_FLIGHT: usize = 16;
const LOG_PAGE: u32 = 500;
/// Lists in the status screen.
const STATUS_ROWS: u32 = 20;
/// Longest time between two looks at a job that is watched.
const WATCH_PAUSE: Duration = Duration::from_secs(30);

type Answer<T> = Result<Response<T>, Status>;
type AnswerStream<T> = Pin<Box<dyn Stream<Item = Result<T, Status>> + Send>>;

/// Serves `ign.v1.Jobs`.
pub(crate) struct JobsApi(pub(crate) Arc<App>);

impl App {
    /// The job as the wire has it, with its bundle or its place in the queue.
    async fn full_job(&self, job: &Job) -> Result<v1::Job, Refused> {
        let waiting = self.store.waiting(job).await?;
        self.with_bundle(job, waiting).await
    }

    async fn full_jobs(&self, jobs: &[Job]) -> Result<Vec<v1::Job>, Refused> {
        let waiting = self.store.all_waiting(jobs).await?;
        self.with_bundles(jobs.iter().zip(waiting)).await
    }

    async fn with_bundles(
        &self,
        jobs: impl Iterator<Item = (&Job, Waiting)>,
    ) -> Result<Vec<v1::Job>, Refused> {
        let lookups: Vec<_> = jobs
            .map(|(job, waiting)| self.with_bundle(job, waiting))
            .collect();
        stream::iter(lookups)
            .buffered(LOOKUPS_IN_FLIGHT)
            .try_collect()
            .await
    }

    async fn with_bundle(&self, job: &Job, waiting: Waiting) -> Result<v1::Job, Refused> {
        let mut wire = to_job(job);
        if job.state == JobState::Queued {
            wire.queue_position = waiting.position;
            wire.waiting_for = match self.room.check(Write::Work) {
                Ok(()) => waiting.reason,
                Err(Refused(full)) => full.to_string(),
            };
        }
        if let Some(version) = job.version {
            match self
                .store
                .version(&job.spec.object, &format!("v{version}"))
                .await
            {
                Ok(version) => wire.bundle = Some(to_bundle(version)),
                Err(StoreError::NotFound { .. }) => {}
                Err(error) => return Err(error.into()),
            }
        }
        Ok(wire)
    }

    /// By id, or by a prefix of it. A job of a collection where the caller lacks the scope does not exist for it.
    async fn find_job(&self, caller: &Caller, scope: Scope, id: &str) -> Result<Job, Refused> {
        let job = match id.parse::<JobId>() {
            Ok(id) => self.store.get(id).await?,
            Err(_) => self.store.find(id).await?,
        };
        if caller.may(scope, &job.spec.object.collection) {
            Ok(job)
        } else {
            Err(Cause::absent("job", id).into())
        }
    }

    /// A page of the jobs of all collections in reach.
    async fn page(
        &self,
        reach: &Reach,
        filter: &JobFilter,
        after: Option<JobId>,
        limit: u32,
    ) -> Result<JobPage, Refused> {
        let mut jobs = Vec::new();
        let mut more = false;
        for collection in reach.each() {
            let filter = JobFilter {
                collection,
                ..filter.clone()
            };
            let page = self.store.list(&filter, after, limit).await?;
            more |= page.next.is_some();
            jobs.extend(page.jobs);
        }
        // What a later page of any collection holds is older than what its own page held.
        let limit = limit.clamp(1, MAX_PAGE) as usize;
        jobs.sort_by_key(|job| std::cmp::Reverse(job.id));
        more |= jobs.len() > limit;
        jobs.truncate(limit);
        let next = jobs.last().filter(|_| more).map(|job| job.id);
        Ok(JobPage { jobs, next })
    }

    /// The status screen of all collections in reach.
    async fn screen(&self, caller: &Caller, reach: &Reach) -> Result<Screen, Refused> {
        let mut whole: Option<Screen> = None;
        for collection in reach.each() {
            let part = self.store.status(collection.as_ref(), STATUS_ROWS).await?;
            match &mut whole {
                None => whole = Some(part),
                Some(whole) => add(whole, part),
            }
        }
        let nowhere = "the token may read no collection".to_owned();
        let mut whole = whole.ok_or(Cause::Forbidden { message: nowhere })?;
        if let Some(readable) = caller.reach(Scope::Read).only() {
            self.hide_jobs(&mut whole.workers, readable).await?;
        }
        Ok(whole)
    }

    /// Takes away from workers what they do for other collections.
    async fn hide_jobs(
        &self,
        workers: &mut [Worker],
        readable: &BTreeSet<CollectionId>,
    ) -> Result<(), Refused> {
        for worker in workers {
            let mut shown = Vec::new();
            for &job in &worker.jobs {
                if readable.contains(&self.store.get(job).await?.spec.object.collection) {
                    shown.push(job);
                }
            }
            worker.jobs = shown;
        }
        Ok(())
    }

    /// Fails unless the digest names the manifest of a capture that is here.
    async fn check_capture(&self, digest: &Digest) -> Result<(), Refused> {
        let missing = |message: String| {
            Refused(Cause::NotAllowed {
                reason: "CAPTURE_MISSING".to_owned(),
                message,
            })
        };
        let manifest = match self.registry.manifest_to_name(digest).await {
            Ok(Some(manifest)) => manifest,
            Ok(None) => {
                return Err(missing(format!("capture {digest} was not uploaded")));
            }
            Err(error @ RegistryError::BlobsMissing { .. }) => {
                return Err(missing(format!("of capture {digest}: {error}")));
            }
            Err(error) => return Err(error.into()),
        };
        match manifest.kind() {
            Kind::Capture => Ok(()),
            Kind::Bundle => Err(missing(format!("{digest} is a bundle, not a capture"))),
        }
    }

    /// One result per request, in order.
    async fn submit_all(
        &self,
        caller: &Caller,
        requests: Vec<v1::SubmitRequest>,
    ) -> Result<Vec<Result<Job, Refused>>, Refused> {
        self.room.check(Write::Work)?;
        let parsed: Vec<Result<Submit, Refused>> = requests
            .into_iter()
            .map(|request| {
                let spec = job_spec(required(request.spec, "spec")?)?;
                caller.require(&[Scope::Submit], &spec.object.collection)?;
                Ok(Submit {
                    request_id: request.request_id,
                    spec,
                    traceparent: ign_trace::current().map(|trace| trace.to_string()),
                })
            })
            .collect();
        let captures: BTreeMap<Digest, Option<Cause>> = parsed
            .iter()
            .flatten()
            .map(|submit| (submit.spec.capture_digest.clone(), None))
            .collect();
        let captures: BTreeMap<Digest, Option<Cause>> = stream::iter(captures.into_keys())
            .map(|digest| async move {
                let refused = self
                    .check_capture(&digest)
                    .await
                    .err()
                    .map(|Refused(cause)| cause);
                (digest, refused)
            })
            .buffered(LOOKUPS_IN_FLIGHT)
            .collect()
            .await;
        let checked: Vec<Result<Submit, Refused>> = parsed
            .into_iter()
            .map(|submit| {
                let submit = submit?;
                match captures.get(&submit.spec.capture_digest) {
                    Some(Some(cause)) => Err(Refused(cause.clone())),
                    _ => Ok(submit),
                }
            })
            .collect();
        let good: Vec<Submit> = checked.iter().flatten().cloned().collect();
        ign_faults::point("submit.checked");
        let mut jobs = self.store.submit_batch(good).await?.into_iter();
        ign_faults::point("submit.committed");
        Ok(checked
            .into_iter()
            .map(|submit| {
                submit?;
                let job = jobs.next().ok_or(Cause::Conflict)?;
                Ok(job?)
            })
            .collect())
    }
}

#[tonic::async_trait]
impl Jobs for JobsApi {
    type WatchStream = AnswerStream<v1::Job>;
    type LogsStream = AnswerStream<v1::LogLine>;

    async fn submit(&self, request: Request<v1::SubmitRequest>) -> Answer<v1::Job> {
        let caller = caller(request.extensions())?;
        let requests = vec![request.into_inner()];
        let mut results = self.0.submit_all(&caller, requests).await?;
        let job = results.pop().ok_or(Refused(Cause::Conflict))??;
        tracing::info!(job.id = %job.id, job.object = %job.spec.object, "submitted");
        Ok(Response::new(self.0.full_job(&job).await?))
    }

    async fn submit_batch(
        &self,
        request: Request<Streaming<v1::SubmitRequest>>,
    ) -> Answer<v1::SubmitBatchResponse> {
        let caller = caller(request.extensions())?;
        let mut chunks = request.into_inner().try_chunks(BATCH);
        let mut results = Vec::new();
        while let Some(chunk) = chunks.next().await {
            let chunk = chunk.map_err(|error| error.1)?;
            let ids: Vec<String> = chunk
                .iter()
                .map(|request| request.request_id.clone())
                .collect();
            let outcomes = self.0.submit_all(&caller, chunk).await?;
            results.extend(ids.into_iter().zip(outcomes).map(|(request_id, outcome)| {
                let outcome = match outcome {
                    Ok(job) => v1::submit_result::Outcome::Job(to_job(&job)),
                    Err(Refused(cause)) => v1::submit_result::Outcome::Error(v1::Error {
                        code: cause.reason().to_owned(),
                        message: cause.to_string(),
                    }),
                };
                v1::SubmitResult {
                    request_id,
                    outcome: Some(outcome),
                }
            }));
        }
        tracing::info!(jobs = results.len(), "submitted a batch");
        Ok(Response::new(v1::SubmitBatchResponse { results }))
    }

    async fn get(&self, request: Request<v1::GetJobRequest>) -> Answer<v1::Job> {
        let caller = caller(request.extensions())?;
        let id = &request.get_ref().job_id;
        let job = self.0.find_job(&caller, Scope::Read, id).await?;
        Ok(Response::new(self.0.full_job(&job).await?))
    }

    async fn list(&self, request: Request<v1::ListJobsRequest>) -> Answer<v1::ListJobsResponse> {
        let reach = caller(request.extensions())?.reach(Scope::Read);
        let request = request.into_inner();
        let reach = reach.narrow(optional(&request.collection, "collection")?)?;
        let filter = JobFilter {
            collection: None,
            object: optional(&request.object, "object")?,
            states: request.states().filter_map(job_state).collect(),
            labels: request.labels.into_iter().collect(),
        };
        let after = if request.page_token.is_empty() {
            None
        } else {
            Some(parsed(&request.page_token, "page_token")?)
        };
        let limit = if request.page_size == 0 {
            DEFAULT_PAGE
        } else {
            request.page_size
        };
        let page = self.0.page(&reach, &filter, after, limit).await?;
        Ok(Response::new(v1::ListJobsResponse {
            jobs: self.0.full_jobs(&page.jobs).await?,
            next_page_token: page.next.map(|id| id.to_string()).unwrap_or_default(),
        }))
    }

    async fn watch(&self, request: Request<v1::GetJobRequest>) -> Answer<Self::WatchStream> {
        let app = self.0.clone();
        let caller = caller(request.extensions())?;
        let id = &request.get_ref().job_id;
        let id = app.find_job(&caller, Scope::Read, id).await?.id;
        let (sender, receiver) = mpsc::channel(4);
        trace::spawn(async move {
            let ended = watch(&app, id, &sender).await;
            end(ended, &sender).await;
        });
        Ok(Response::new(Box::pin(ReceiverStream::new(receiver))))
    }

    async fn cancel(&self, request: Request<v1::GetJobRequest>) -> Answer<v1::Job> {
        let caller = caller(request.extensions())?;
        let id = &request.get_ref().job_id;
        let id = self.0.find_job(&caller, Scope::Submit, id).await?.id;
        let job = self.0.store.cancel(id).await.map_err(Refused::from)?;
        tracing::info!(job.id = %id, "cancel requested");
        Ok(Response::new(self.0.full_job(&job).await?))
    }

    async fn retry(&self, request: Request<v1::GetJobRequest>) -> Answer<v1::Job> {
        let caller = caller(request.extensions())?;
        let id = &request.get_ref().job_id;
        let job = self.0.find_job(&caller, Scope::Submit, id).await?;
        // It may have ended so long ago that its capture was collected.
        self.0.check_capture(&job.spec.capture_digest).await?;
        let id = job.id;
        let job = self.0.store.retry(id).await.map_err(Refused::from)?;
        tracing::info!(job.id = %id, "retry requested");
        Ok(Response::new(self.0.full_job(&job).await?))
    }

    async fn logs(&self, request: Request<v1::LogsRequest>) -> Answer<Self::LogsStream> {
        let app = self.0.clone();
        let caller = caller(request.extensions())?;
        let request = request.into_inner();
        let job = app.find_job(&caller, Scope::Read, &request.job_id).await?;
        let id = job.id;
        let (sender, receiver) = mpsc::channel(LOG_PAGE as usize);
        trace::spawn(async move {
            let ended = follow(&app, id, request.after_seq, request.follow, &sender).await;
            end(ended, &sender).await;
        });
        Ok(Response::new(Box::pin(ReceiverStream::new(receiver))))
    }

    async fn status(&self, request: Request<v1::StatusRequest>) -> Answer<v1::StatusResponse> {
        let caller = caller(request.extensions())?;
        let collection = optional(&request.get_ref().collection, "collection")?;
        let reach = caller.reach(Scope::Read).narrow(collection)?;
        let status = self.0.screen(&caller, &reach).await?;
        let queued = status
            .next_queued
            .iter()
            .map(|(job, waiting)| (job, waiting.clone()));
        Ok(Response::new(v1::StatusResponse {
            jobs_by_state: status
                .counts
                .iter()
                .map(|(state, count)| (state.as_str().to_owned(), *count))
                .collect(),
            workers: status.workers.iter().map(to_worker).collect(),
            running: status.running.iter().map(to_job).collect(),
            recent_failures: status.recent_failures.iter().map(to_job).collect(),
            server_version: env!("CARGO_PKG_VERSION").to_owned(),
            at: Some(to_timestamp(status.at)),
            next_queued: self.0.with_bundles(queued).await?,
            lease_secs: self.0.store.settings().lease.as_secs_f64(),
        }))
    }
}

/// Adds another collection's part to a status screen.
fn add(whole: &mut Screen, part: Screen) {
    for (state, count) in part.counts {
        *whole.counts.entry(state).or_default() += count;
    }
    merge(&mut whole.running, part.running, |a, b| {
        (a.started_at, a.id).cmp(&(b.started_at, b.id))
    });
    merge(&mut whole.recent_failures, part.recent_failures, |a, b| {
        (b.finished_at, a.id).cmp(&(a.finished_at, b.id))
    });
    merge(
        &mut whole.next_queued,
        part.next_queued,
        |(a, _), (b, _)| {
            let order = |job: &Job| {
                (
                    std::cmp::Reverse(job.spec.priority),
                    job.submitted_at,
                    job.id,
                )
            };
            order(a).cmp(&order(b))
        },
    );
}

/// Merges two parts of a list of the status screen.
fn merge<T>(into: &mut Vec<T>, from: Vec<T>, order: fn(&T, &T) -> Ordering) {
    into.extend(from);
    into.sort_by(order);
    into.truncate(STATUS_ROWS as usize);
}

/// Why a stream ended before its time; none when the client went away.
type Early = Option<Refused>;

async fn end<T>(ended: Result<(), Early>, sender: &mpsc::Sender<Result<T, Status>>) {
    if let Err(Some(refused)) = ended {
        // The client may have gone, which ends the stream too.
        sender.send(Err(refused.into())).await.ok();
    }
}

async fn deliver<T>(sender: &mpsc::Sender<Result<T, Status>>, item: T) -> Result<(), Early> {
    sender.send(Ok(item)).await.map_err(|_gone| None)
}

/// Waits for a change; an error when the client left or the coordinator ends.
async fn pause<T>(
    app: &App,
    changes: &mut ign_queue::Changes,
    sender: &mpsc::Sender<Result<T, Status>>,
) -> Result<(), Early> {
    tokio::select! {
        () = changes.wait(WATCH_PAUSE) => Ok(()),
        () = sender.closed() => Err(None),
        () = app.stopping.cancelled() => Err(Some(stopping())),
    }
}

/// What streams and long polls answer when the coordinator ends.
pub(crate) fn stopping() -> Refused {
    Refused(Cause::Unavailable {
        message: "the coordinator is stopping".to_owned(),
        retry_after: Duration::from_secs(1),
    })
}

/// Sends the job at once and after every change, until it ends.
async fn watch(
    app: &App,
    id: JobId,
    sender: &mpsc::Sender<Result<v1::Job, Status>>,
) -> Result<(), Early> {
    let mut changes = app.store.changes();
    let mut last = None;
    loop {
        let job = app
            .store
            .get(id)
            .await
            .map_err(|error| Some(error.into()))?;
        let wire = app.full_job(&job).await.map_err(Some)?;
        if last.as_ref() != Some(&wire) {
            deliver(sender, wire.clone()).await?;
            last = Some(wire);
        }
        if job.state.is_terminal() {
            return Ok(());
        }
        pause(app, &mut changes, sender).await?;
    }
}

/// Sends log lines; when following, until the job has ended and its last line was sent.
async fn follow(
    app: &App,
    id: JobId,
    mut after: u64,
    follow: bool,
    sender: &mpsc::Sender<Result<v1::LogLine, Status>>,
) -> Result<(), Early> {
    let mut changes = app.store.changes();
    loop {
        // Asked before the lines: what a job says, it says before it ends.
        let job = app
            .store
            .get(id)
            .await
            .map_err(|error| Some(error.into()))?;
        let lines = app
            .store
            .logs(id, after, LOG_PAGE)
            .await
            .map_err(|error| Some(error.into()))?;
        let full = lines.len() >= LOG_PAGE as usize;
        for line in lines {
            after = line.seq;
            deliver(sender, to_log_line(line)).await?;
        }
        if full {
            continue;
        }
        if !follow || job.state.is_terminal() {
            return Ok(());
        }
        pause(app, &mut changes, sender).await?;
    }
}
