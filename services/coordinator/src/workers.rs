//! `ign.v1.Workers`: leases, heartbeats, results.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use ign_proto::v1::workers_server::Workers;
use ign_proto::{Cause, Kind, Manifest, Scope, v1};
use ign_queue::Checkpoint;
use tokio::time::Instant;
use tonic::{Request, Response, Status};

use crate::app::App;
use crate::auth::caller;
use crate::convert::{
    failure, job_attempt, log_lines, parsed, progress, required, to_bundle, to_spec, worker_info,
};
use crate::http_answer::Refused;
use crate::room::Write;
use crate::trace;

/// Longest long poll.
const MAX_WAIT: Duration = Duration::from_mins(1);

type Answer<T> = Result<Response<T>, Status>;

/// Serves `ign.v1.Workers`.
pub(crate) struct WorkersApi(pub(crate) Arc<App>);

impl WorkersApi {
    fn lease_secs(&self) -> f64 {
        self.0.store.settings().lease.as_secs_f64()
    }
}

#[tonic::async_trait]
impl Workers for WorkersApi {
    async fn lease(&self, request: Request<v1::LeaseRequest>) -> Answer<v1::LeaseResponse> {
        let caller = caller(request.extensions())?;
        let reach = caller.reach(Scope::Publish);
        let request = request.into_inner();
        let worker = worker_info(&request)?;
        let wait = Duration::try_from_secs_f64(request.wait_secs)
            .unwrap_or_default()
            .min(MAX_WAIT);
        let deadline = Instant::now() + wait;
        let mut changes = self.0.store.work();
        loop {
            // A job that is begun now could not bring its result home.
            let full = self.0.room.check(Write::Work).is_err();
            // In a task of its own: a client that leaves in the middle must not cut a claim in two.
            let claim = trace::spawn({
                let (app, worker, reach) = (self.0.clone(), worker.clone(), reach.clone());
                let caller = caller.clone();
                async move {
                    if full {
                        return Ok(None);
                    }
                    let holder = Some(caller.name.as_str());
                    app.store.lease_within(&worker, holder, reach.only()).await
                }
            });
            let job = claim
                .await
                .map_err(|error| Refused(crate::error::internal(&error)))?;
            if let Some(job) = job.map_err(Refused::from)? {
                ign_faults::point("lease.committed");
                self.0.holders.remember(&job);
                tracing::info!(job.id = %job.id, job.attempt = job.attempt.0, worker.id = %worker.id, "leased");
                return Ok(Response::new(v1::LeaseResponse {
                    lease: Some(v1::Lease {
                        job_id: job.id.to_string(),
                        attempt: job.attempt.0,
                        spec: Some(to_spec(&job.spec)),
                        checkpoint_digest: job
                            .checkpoint
                            .map(|it| it.digest.to_string())
                            .unwrap_or_default(),
                        lease_secs: self.lease_secs(),
                        traceparent: job.traceparent.unwrap_or_default(),
                    }),
                }));
            }
            let left = deadline.saturating_duration_since(Instant::now());
            if left.is_zero() || self.0.stopping.is_cancelled() {
                return Ok(Response::new(v1::LeaseResponse { lease: None }));
            }
            tokio::select! {
                () = changes.wait(left) => {}
                () = self.0.stopping.cancelled() => {}
            }
        }
    }

    async fn heartbeat(
        &self,
        request: Request<v1::HeartbeatRequest>,
    ) -> Answer<v1::HeartbeatResponse> {
        let caller = caller(request.extensions())?;
        let request = request.into_inner();
        let (job, attempt) = job_attempt(request.job.as_ref())?;
        self.0.check_holder(&caller, job, attempt).await?;
        let (progress, logs) = (request.progress.map(progress), log_lines(request.logs));
        let orders = self
            .0
            .store
            .heartbeat(job, attempt, progress, logs)
            .await
            .map_err(Refused::from)?;
        Ok(Response::new(v1::HeartbeatResponse {
            cancel: orders.cancel,
            drain: orders.drain,
            lease_secs: self.lease_secs(),
        }))
    }

    async fn checkpoint(
        &self,
        request: Request<v1::CheckpointRequest>,
    ) -> Answer<v1::CheckpointResponse> {
        let caller = caller(request.extensions())?;
        let request = request.into_inner();
        let (job, attempt) = job_attempt(request.job.as_ref())?;
        self.0.check_holder(&caller, job, attempt).await?;
        let checkpoint = Checkpoint {
            digest: parsed(&request.digest, "digest")?,
            size_bytes: request.size_bytes,
        };
        let stored = self
            .0
            .registry
            .blob_size(&checkpoint.digest)
            .await
            .map_err(Refused::from)?;
        if stored != Some(checkpoint.size_bytes) {
            let message = format!("checkpoint {} was not uploaded in full", checkpoint.digest);
            return Err(Cause::NotAllowed {
                reason: "BLOB_MISSING".to_owned(),
                message,
            }
            .status());
        }
        ign_faults::point("checkpoint.checked");
        self.0
            .store
            .checkpoint(job, attempt, checkpoint)
            .await
            .map_err(Refused::from)?;
        ign_faults::point("checkpoint.committed");
        Ok(Response::new(v1::CheckpointResponse {}))
    }

    async fn complete(
        &self,
        request: Request<v1::CompleteRequest>,
    ) -> Answer<v1::CompleteResponse> {
        let caller = caller(request.extensions())?;
        let request = request.into_inner();
        let (job, attempt) = job_attempt(request.job.as_ref())?;
        self.0.check_holder(&caller, job, attempt).await?;
        let manifest = Manifest::from_wire(Kind::Bundle, &request.files)
            .map_err(|error| Refused(Cause::bad_field("files", error)))?;
        // Not cut short by a client that leaves: the next call finds the outcome.
        let published = trace::spawn({
            let app = self.0.clone();
            async move {
                app.publish(job, attempt, &manifest, request.metrics_json)
                    .await
            }
        });
        let version = published
            .await
            .map_err(|error| Refused(crate::error::internal(&error)))??;
        self.0.metrics.published.fetch_add(1, Ordering::Relaxed);
        tracing::info!(job.id = %job, job.object = %version.object, version = version.version, "published");
        Ok(Response::new(v1::CompleteResponse {
            bundle: Some(to_bundle(version)),
        }))
    }

    async fn fail(&self, request: Request<v1::FailRequest>) -> Answer<v1::FailResponse> {
        let caller = caller(request.extensions())?;
        let request = request.into_inner();
        let (job, attempt) = job_attempt(request.job.as_ref())?;
        self.0.check_holder(&caller, job, attempt).await?;
        let failure = failure(required(request.failure, "failure")?)?;
        tracing::info!(job.id = %job, job.attempt = attempt.0, failure = failure.message, "attempt failed");
        let logs = log_lines(request.logs);
        let will_retry = self
            .0
            .store
            .fail(job, attempt, failure, logs)
            .await
            .map_err(Refused::from)?;
        Ok(Response::new(v1::FailResponse { will_retry }))
    }
}
