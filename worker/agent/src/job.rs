//! One attempt of one job, from lease to report.
//!
//! ```text
//! fetch capture and checkpoint -> child bakes (events in, checkpoints out) -> send bundle -> Complete | Fail
//!            \________________ heartbeats all the while; they may say stop ________________/
//! ```
//!
//! Invariants: whatever happens, the child is dead and the job's folder is gone when [`run`] returns; after a lost
//! lease nothing more is sent about the job.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use ign_events::{Event, Failure, FailureKind, JobFile, Level, Progress};
use ign_proto::{Attempt, Cause, Digest, IdError, JobId, ObjectName, v1};
use ign_trace::TraceParent;
use tokio::task::JoinSet;
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;

use crate::backoff::Backoff;
use crate::checkpoints::Checkpoints;
use crate::child::{Child, Output};
use crate::error::TransferError;
use crate::heartbeat;
use crate::state::{State, Stop, wire_failure, wire_lines};
use crate::transfer::Transfer;
use crate::{Agent, logs};

/// How long a child may take to end after it said that it is done.
const EXIT_GRACE: Duration = Duration::from_secs(30);
/// How long the last checkpoint of a crashed child may take to arrive before the crash is reported.
const CHECKPOINT_GRACE: Duration = Duration::from_mins(1);
/// Times that a bundle is sent again because the store lost a blob of it, or published again because the coordinator
/// failed inside: the bake took too long to give its result up at once.
const MAX_RESENDS: u32 = 3;
const MAX_SUMMARY_BYTES: usize = 256 * 1024;

/// Why an attempt gave no result.
enum Ended {
    Stopped(Stop),
    Failed(Failure),
}

impl From<TransferError> for Ended {
    fn from(error: TransferError) -> Self {
        Self::Failed(error.failure())
    }
}

/// Works on a lease until its job has ended, one way or another, within the trace that the lease names.
pub(crate) async fn run(agent: &Agent, lease: v1::Lease, shutdown: &CancellationToken) {
    let trace: Option<TraceParent> = lease.traceparent.parse().ok();
    let span = tracing::info_span!(
        "job",
        job.id = lease.job_id,
        job.attempt = lease.attempt,
        trace.id = trace.map(|trace| trace.trace_id()),
    );
    ign_trace::within(span, trace, work_on(agent, lease, shutdown)).await;
}

async fn work_on(agent: &Agent, lease: v1::Lease, shutdown: &CancellationToken) {
    let (state, spec) = match read_lease(agent, &lease) {
        Ok(read) => read,
        Err(error) => {
            // The lease runs out and another worker, perhaps a newer one, gets the job.
            tracing::error!(job = lease.job_id, "cannot understand the lease: {error}");
            return;
        }
    };
    ign_faults::point("agent.leased");
    let state = Arc::new(state);
    let started = Instant::now();
    tracing::info!(job = %state.job, attempt = %state.attempt, object = %state.object, "job started");
    let mut background = JoinSet::new();
    background.spawn(ign_trace::carry(heartbeat::run(
        agent.control.clone(),
        Arc::clone(&state),
        lease.lease_secs,
    )));
    background.spawn({
        let (state, shutdown) = (Arc::clone(&state), shutdown.clone());
        async move {
            shutdown.cancelled().await;
            state.stop(Stop::Shutdown);
        }
    });

    let dir = agent
        .jobs_dir
        .join(format!("{}.{}", state.job, state.attempt));
    let job = Job {
        agent,
        state: &state,
        dir: &dir,
        shutdown,
    };
    let ended = Box::pin(job.work(&spec)).await;
    let secs = started.elapsed().as_secs();
    match ended {
        Ok(version) => {
            tracing::info!(job = %state.job, "job done in {secs} s: {} v{version}", state.object);
        }
        Err(ended) => {
            let failure = match ended {
                Ended::Failed(failure) => failure,
                Ended::Stopped(Stop::LeaseLost) => {
                    failure(FailureKind::Transient, "lease lost", "")
                }
                Ended::Stopped(Stop::Cancelled) => failure(FailureKind::Cancelled, "cancelled", ""),
                Ended::Stopped(Stop::Shutdown) => {
                    failure(FailureKind::Transient, "worker shut down", "")
                }
            };
            tracing::warn!(job = %state.job, kind = ?failure.kind, "job ended after {secs} s: {failure}");
            job.report(&failure).await;
        }
    }
    background.shutdown().await;
    remove_dir(dir).await;
}

/// What the bake needs, checked.
struct Spec {
    capture: Digest,
    recipe: serde_json::Value,
    checkpoint: Option<Digest>,
}

fn read_lease(agent: &Agent, lease: &v1::Lease) -> Result<(State, Spec), IdError> {
    let wire = lease.spec.clone().unwrap_or_default();
    let object = ObjectName::try_from(&wire.object.unwrap_or_default())?;
    let job: JobId = lease.job_id.parse()?;
    let checkpoint = match lease.checkpoint_digest.as_str() {
        "" => None,
        text => Some(text.parse()?),
    };
    let spec = Spec {
        capture: wire.capture_digest.parse()?,
        // The child reports a recipe that it cannot read; it owns the schema.
        recipe: serde_json::from_str(&wire.recipe_json)
            .unwrap_or(serde_json::Value::String(wire.recipe_json)),
        checkpoint,
    };
    let state = State::new(job, Attempt(lease.attempt), agent.worker.clone(), object);
    Ok((state, spec))
}

struct Job<'a> {
    agent: &'a Agent,
    state: &'a Arc<State>,
    dir: &'a Path,
    shutdown: &'a CancellationToken,
}

impl Job<'_> {
    /// The number of the published version.
    async fn work(&self, spec: &Spec) -> Result<u32, Ended> {
        let job_file = self
            .unless_stopped(Duration::ZERO, self.prepare(spec))
            .await?;
        ign_faults::point("agent.fetched");
        let bundle = self.bake(&job_file).await?;
        self.deliver(&bundle).await
    }

    /// Drops `work` when the attempt must stop; a shutdown leaves it `grace` to finish.
    async fn unless_stopped<T>(
        &self,
        grace: Duration,
        work: impl Future<Output = Result<T, Ended>>,
    ) -> Result<T, Ended> {
        tokio::select! {
            biased;
            stop = self.state.stopped(grace) => Err(Ended::Stopped(stop)),
            result = work => result,
        }
    }

    /// Makes the job's folder: capture, checkpoint, job file.
    async fn prepare(&self, spec: &Spec) -> Result<PathBuf, Ended> {
        remove_dir(self.dir.to_path_buf()).await;
        let capture_dir = self.dir.join("capture");
        let work_dir = self.dir.join("work");
        for dir in [&capture_dir, &work_dir, &self.dir.join("outbox")] {
            std::fs::create_dir_all(dir)
                .map_err(|source| TransferError::file("create", dir, source))?;
        }
        let note = |message: &str| self.note(message);
        let progress = |message: &str| self.progress("import", 0.0, message);
        progress("waiting for another job's files");
        let fetching = self.agent.fetching.lock().await;
        progress("fetching the capture");
        let transfer = self.transfer(&note, &progress);
        transfer
            .fetch_capture(&spec.capture, spec.checkpoint.as_ref(), &capture_dir)
            .await?;
        let mut checkpoint = None;
        if let Some(digest) = &spec.checkpoint {
            let path = self.dir.join("checkpoint");
            if transfer.fetch_checkpoint(digest, &path).await? {
                checkpoint = Some(path);
            }
        }
        drop(fetching);
        let object = ign_events::ObjectName {
            collection: self.state.object.collection.to_string(),
            object: self.state.object.object.to_string(),
        };
        let job = JobFile {
            job_id: self.state.job.to_string(),
            attempt: self.state.attempt.0,
            object,
            capture_dir,
            capture_digest: spec.capture.to_string(),
            recipe: spec.recipe.clone(),
            checkpoint,
            work_dir,
            threads: self.agent.config.threads,
        };
        let path = self.dir.join("job.json");
        job.write(&path)
            .map_err(|source| TransferError::file("write", &path, source))?;
        Ok(path)
    }

    /// Runs the child to its end; the folder of the finished bundle.
    async fn bake(&self, job_file: &Path) -> Result<PathBuf, Ended> {
        let config = &self.agent.config;
        let mut checkpoints = Checkpoints::start(
            self.agent.control.clone(),
            self.agent.data.clone(),
            Arc::clone(self.state),
            self.dir.join("outbox"),
        );
        let mut child =
            Child::spawn(&config.child, job_file, self.dir, config.threads).map_err(|error| {
                let program = config.child.program.display();
                Ended::Failed(failure(
                    FailureKind::Transient,
                    &format!("cannot start {program}: {error}"),
                    "",
                ))
            })?;
        let mut stage = "start".to_owned();
        let mut result: Option<Result<PathBuf, Failure>> = None;
        let mut exit_by: Option<Instant> = None;
        loop {
            let overdue = async {
                match exit_by {
                    Some(deadline) => tokio::time::sleep_until(deadline).await,
                    None => std::future::pending().await,
                }
            };
            let output = tokio::select! {
                biased;
                stop = self.state.stopped(Duration::ZERO) => {
                    child.kill().await;
                    if stop == Stop::Shutdown {
                        self.finish(checkpoints, config.shutdown_grace).await;
                    }
                    // Something weightier may have come meanwhile.
                    return Err(Ended::Stopped(self.state.stop_reason().unwrap_or(stop)));
                }
                () = overdue => {
                    exit_by = None;
                    child.kill().await;
                    continue;
                }
                output = child.next() => output,
            };
            let event = match output {
                None => break,
                Some(Output::Text(line)) => {
                    self.state.log_text(&line);
                    continue;
                }
                Some(Output::Event(event)) => event,
            };
            match event {
                Event::Progress(progress) => {
                    stage.clone_from(&progress.stage);
                    self.state.set_progress(&progress);
                }
                Event::Log { level, message } => self.state.log(level, &message),
                Event::Checkpoint { path } => {
                    if let Err(error) = checkpoints.offer(&path) {
                        let path = path.display();
                        self.note(&format!("checkpoint {path} cannot be read: {error}"));
                    }
                }
                Event::Done { bundle } => {
                    result.get_or_insert(Ok(bundle));
                    exit_by.get_or_insert(Instant::now() + EXIT_GRACE);
                }
                Event::Failed(failure) => {
                    result.get_or_insert(Err(self.without_paths(&failure)));
                    exit_by.get_or_insert(Instant::now() + EXIT_GRACE);
                }
            }
        }
        let failure = match result {
            Some(Ok(bundle)) if bundle.join("bundle.json").is_file() => return Ok(bundle),
            Some(Ok(bundle)) => {
                let message = format!("the bake left no bundle.json in {}", bundle.display());
                failure(FailureKind::Crashed, &message, "")
            }
            Some(Err(failure)) => failure,
            None => crash(&child, &stage),
        };
        // The next attempt goes on from the last checkpoint, if that arrives.
        if matches!(failure.kind, FailureKind::Transient | FailureKind::Crashed) {
            self.finish(checkpoints, CHECKPOINT_GRACE).await;
        }
        Err(Ended::Failed(failure))
    }

    /// Names the capture's files as their owner does, not as they lie on this machine.
    fn without_paths(&self, failure: &Failure) -> Failure {
        let capture = self.dir.join("capture").display().to_string();
        let folder = format!("{capture}/");
        let relative = |text: &str| text.replace(&folder, "").replace(&capture, "capture");
        Failure {
            kind: failure.kind,
            message: relative(&failure.message),
            at: relative(&failure.at),
            hint: relative(&failure.hint),
        }
    }

    /// Lets the last checkpoint arrive, unless the job is no longer ours.
    async fn finish(&self, checkpoints: Checkpoints, limit: Duration) {
        tokio::select! {
            () = self.state.lease_lost() => {}
            () = self.shutdown_overdue() => {}
            () = checkpoints.finish(limit) => {}
        }
    }

    /// Sends the bundle and publishes it; the number of its version.
    async fn deliver(&self, bundle: &Path) -> Result<u32, Ended> {
        let note = |message: &str| self.note(message);
        let progress = |message: &str| self.progress("upload", 99.0, message);
        progress("sending the bundle");
        let transfer = self.transfer(&note, &progress);
        let mut resends = 0;
        let mut backoff = Backoff::default();
        // The last lines arrive before the job ends; best effort.
        heartbeat::beat(&self.agent.control, self.state).await.ok();
        loop {
            let grace = self.agent.config.shutdown_grace;
            let files = self
                .unless_stopped(grace, async { Ok(transfer.send_bundle(bundle).await?) })
                .await?;
            ign_faults::point("agent.sent");
            let request = v1::CompleteRequest {
                job: Some(self.state.token()),
                files: files
                    .into_iter()
                    .map(|file| v1::FileEntry {
                        path: file.path.to_string(),
                        digest: file.digest.to_string(),
                        size_bytes: file.size_bytes,
                        media_type: file.media_type,
                    })
                    .collect(),
                metrics_json: summary(&bundle.join("metrics.json")),
            };
            match self.complete(request, &mut backoff).await? {
                Completed::Version(version) => {
                    ign_faults::point("agent.completed");
                    return Ok(version);
                }
                Completed::BlobMissing(message) if resends == MAX_RESENDS => {
                    return Err(Ended::Failed(failure(FailureKind::Transient, &message, "")));
                }
                Completed::BlobMissing(message) => {
                    resends += 1;
                    self.note(&format!("{message}; sending the bundle again"));
                }
            }
        }
    }

    async fn complete(
        &self,
        request: v1::CompleteRequest,
        backoff: &mut Backoff,
    ) -> Result<Completed, Ended> {
        let mut internal_errors = 0;
        loop {
            // Never dropped before its answer: a heartbeat that comes after the commit hears that the lease is over,
            // and would make a success look like a lost lease.
            let cause = match self.agent.control.complete(request.clone()).await {
                Ok(response) => {
                    let version = response.bundle.map_or(0, |bundle| bundle.version);
                    return Ok(Completed::Version(version));
                }
                Err(cause) => cause,
            };
            match cause {
                Cause::LeaseLost { .. } => return Err(Ended::Stopped(Stop::LeaseLost)),
                Cause::NotAllowed { reason, message } if reason == "BLOB_MISSING" => {
                    return Ok(Completed::BlobMissing(message));
                }
                cause
                    if cause.retryable()
                        || (matches!(cause, Cause::Internal { .. })
                            && internal_errors < MAX_RESENDS) =>
                {
                    internal_errors += u32::from(matches!(cause, Cause::Internal { .. }));
                    self.note(&format!("cannot publish yet: {cause}"));
                    let wait = cause.retry_after().unwrap_or_default();
                    let pause = tokio::time::sleep(backoff.next_delay().max(wait));
                    self.unless_stopped(self.agent.config.shutdown_grace, async {
                        pause.await;
                        Ok(())
                    })
                    .await?;
                }
                cause => {
                    let message = format!("the coordinator refused the bundle: {cause}");
                    return Err(Ended::Failed(failure(FailureKind::Crashed, &message, "")));
                }
            }
        }
    }

    /// Tells the coordinator how the attempt ended, until it knows or the job is no longer ours.
    async fn report(&self, failure: &Failure) {
        tokio::select! {
            biased;
            () = self.state.lease_lost() => {}
            () = self.send_report(failure) => {}
            () = self.shutdown_overdue() => {
                tracing::warn!(job = %self.state.job, "end not reported in time; the lease will run out");
            }
        }
    }

    /// Ends when a shutdown was asked for and its grace has passed.
    async fn shutdown_overdue(&self) {
        self.shutdown.cancelled().await;
        tokio::time::sleep(self.agent.config.shutdown_grace).await;
    }

    async fn send_report(&self, failure: &Failure) {
        let lines = self.state.logs().take();
        let request = v1::FailRequest {
            job: Some(self.state.token()),
            failure: Some(wire_failure(failure)),
            logs: wire_lines(&lines, self.state.attempt),
        };
        let mut backoff = Backoff::default();
        loop {
            match self.agent.control.fail(request.clone()).await {
                Ok(response) => {
                    if response.will_retry {
                        tracing::info!(job = %self.state.job, "the job is queued again");
                    }
                    return;
                }
                Err(Cause::LeaseLost { .. }) => return,
                Err(cause) if cause.retryable() => {
                    let wait = cause.retry_after().unwrap_or_default();
                    tokio::time::sleep(backoff.next_delay().max(wait)).await;
                }
                Err(cause) => {
                    tracing::error!(job = %self.state.job, "the coordinator refused the report: {cause}");
                    return;
                }
            }
        }
    }

    fn transfer<'a>(
        &'a self,
        note: &'a (dyn Fn(&str) + Sync),
        progress: &'a (dyn Fn(&str) + Sync),
    ) -> Transfer<'a> {
        Transfer {
            data: &self.agent.data,
            cache: &self.agent.cache,
            object: &self.state.object,
            note,
            progress,
        }
    }

    fn note(&self, message: &str) {
        tracing::warn!(job = %self.state.job, "{message}");
        self.state.log(Level::Warn, message);
    }

    fn progress(&self, stage: &str, percent: f64, message: &str) {
        self.state.set_progress(&Progress {
            stage: stage.to_owned(),
            percent,
            eta_secs: None,
            error: self.state.progress().and_then(|last| last.error),
            message: message.to_owned(),
        });
    }
}

enum Completed {
    Version(u32),
    /// The store lost a blob between its upload and now.
    BlobMissing(String),
}

/// The report of a child that ended without one.
fn crash(child: &Child, stage: &str) -> Failure {
    let ending = child.ending();
    let mut message = format!(
        "the bake process {} in stage {stage} without a result",
        ending.describe()
    );
    let last = &ending.last_lines[ending.last_lines.len().saturating_sub(5)..];
    if !last.is_empty() {
        message = format!("{message}; last output: {}", last.join(" / "));
    }
    let hint = if ending.was_killed() {
        "the machine may have run out of memory: bake a smaller size, or fewer jobs at once"
    } else {
        ""
    };
    failure(FailureKind::Crashed, &message, hint)
}

fn failure(kind: FailureKind, message: &str, hint: &str) -> Failure {
    Failure {
        kind,
        message: logs::cut(message, 8000).to_owned(),
        at: String::new(),
        hint: hint.to_owned(),
    }
}

/// The part of metrics.json that listings show: methods without their single views. Empty when there is none.
fn summary(path: &Path) -> String {
    let Some(mut metrics) = std::fs::read(path)
        .ok()
        .and_then(|bytes| serde_json::from_slice::<serde_json::Value>(&bytes).ok())
    else {
        return String::new();
    };
    if let Some(methods) = metrics["methods"].as_array_mut() {
        for method in methods
            .iter_mut()
            .filter_map(serde_json::Value::as_object_mut)
        {
            method.remove("per_view");
        }
    }
    let kept: serde_json::Map<String, serde_json::Value> =
        ["schema", "resolution", "views", "methods", "device"]
            .into_iter()
            .filter_map(|key| Some((key.to_owned(), metrics.get(key)?.clone())))
            .collect();
    let text = serde_json::Value::Object(kept).to_string();
    if text.len() <= MAX_SUMMARY_BYTES {
        text
    } else {
        String::new()
    }
}

async fn remove_dir(dir: PathBuf) {
    let removed = tokio::task::spawn_blocking(move || match std::fs::remove_dir_all(&dir) {
        Err(error) if error.kind() != std::io::ErrorKind::NotFound => Err((dir, error)),
        _ => Ok(()),
    })
    .await;
    if let Ok(Err((dir, error))) = removed {
        tracing::warn!("cannot remove {}: {error}", dir.display());
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_summary_leaves_single_views_out() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("metrics.json");
        assert_eq!(summary(&path), "");
        std::fs::write(&path, "not json").unwrap();
        assert_eq!(summary(&path), "");
        std::fs::write(
            &path,
            r#"{"schema":"ign.metrics/1","plan":{"long":1},"methods":[{"name":"ours","mse":4.5,"per_view":[{"name":"a"}]}]}"#,
        )
        .unwrap();
        let summary: serde_json::Value = serde_json::from_str(&summary(&path)).unwrap();
        assert_eq!(
            summary,
            serde_json::json!({"schema": "ign.metrics/1", "methods": [{"name": "ours", "mse": 4.5}]})
        );
    }
}
