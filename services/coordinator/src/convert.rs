//! Between the wire's messages and the queue's types. Names and digests are checked on the way in.

use chrono::{DateTime, Utc};
use ign_proto::{Attempt, Cause, Digest, JobId, ObjectName, v1};
use ign_queue::{
    Collection, Delivery, DeliveryState, Failure, FailureKind, Job, JobSpec, JobState, Level,
    LogLine, NewLogLine, Progress, Version, Webhook, Worker, WorkerInfo,
};
use prost_types::Timestamp;

use crate::http_answer::Refused;

/// A field that must be present.
pub(crate) fn required<T>(value: Option<T>, field: &str) -> Result<T, Refused> {
    value.ok_or_else(|| Refused(Cause::bad_field(field, "is missing")))
}

/// A name or digest, with the field it stands in.
pub(crate) fn parsed<T: std::str::FromStr<Err = ign_proto::IdError>>(
    text: &str,
    field: &str,
) -> Result<T, Refused> {
    text.parse()
        .map_err(|error: ign_proto::IdError| Refused(Cause::bad_field(field, error)))
}

/// As [`parsed`]; empty means none.
pub(crate) fn optional<T: std::str::FromStr<Err = ign_proto::IdError>>(
    text: &str,
    field: &str,
) -> Result<Option<T>, Refused> {
    if text.is_empty() {
        Ok(None)
    } else {
        parsed(text, field).map(Some)
    }
}

pub(crate) fn object_name(wire: Option<&v1::ObjectRef>) -> Result<ObjectName, Refused> {
    Ok(ObjectName::try_from(required(wire, "object")?)?)
}

pub(crate) fn job_spec(wire: v1::JobSpec) -> Result<JobSpec, Refused> {
    let object = object_name(wire.object.as_ref())?;
    Ok(JobSpec {
        object,
        capture_digest: parsed::<Digest>(&wire.capture_digest, "capture_digest")?,
        recipe_json: wire.recipe_json,
        priority: wire.priority,
        labels: wire.labels.into_iter().collect(),
        max_attempts: wire.max_attempts,
    })
}

pub(crate) fn job_attempt(wire: Option<&v1::JobAttempt>) -> Result<(JobId, Attempt), Refused> {
    let wire = required(wire, "job")?;
    Ok((parsed(&wire.job_id, "job.job_id")?, Attempt(wire.attempt)))
}

pub(crate) fn worker_info(wire: &v1::LeaseRequest) -> Result<WorkerInfo, Refused> {
    Ok(WorkerInfo {
        id: parsed(&wire.worker_id, "worker_id")?,
        hostname: wire.hostname.clone(),
        version: wire.version.clone(),
        device: wire.device.clone(),
    })
}

pub(crate) fn progress(wire: v1::Progress) -> Progress {
    let v1::Progress {
        stage,
        percent,
        eta_secs,
        error,
        message,
    } = wire;
    let finite = |value: Option<f64>| value.filter(|value| value.is_finite());
    let percent = if percent.is_finite() {
        percent.clamp(0.0, 100.0)
    } else {
        0.0
    };
    Progress {
        stage,
        percent,
        eta_secs: finite(eta_secs),
        error: finite(error),
        message,
    }
}

pub(crate) fn failure(wire: v1::Failure) -> Result<Failure, Refused> {
    let kind = match wire.kind() {
        v1::FailureKind::Transient => FailureKind::Transient,
        v1::FailureKind::InvalidInput => FailureKind::InvalidInput,
        v1::FailureKind::Crashed => FailureKind::Crashed,
        v1::FailureKind::Cancelled => FailureKind::Cancelled,
        v1::FailureKind::Unspecified => {
            return Err(Cause::bad_field("failure.kind", "is missing").into());
        }
    };
    Ok(Failure {
        kind,
        message: wire.message,
        at: wire.at,
        hint: wire.hint,
    })
}

pub(crate) fn log_lines(wire: Vec<v1::LogLine>) -> Vec<NewLogLine> {
    wire.into_iter()
        .map(|line| NewLogLine {
            source_seq: line.seq,
            at: line
                .at
                .and_then(|at| DateTime::from_timestamp(at.seconds, at.nanos.max(0) as u32))
                .unwrap_or_else(Utc::now),
            level: match line.level.as_str() {
                "warn" => Level::Warn,
                "error" => Level::Error,
                _ => Level::Info,
            },
            message: line.message,
        })
        .collect()
}

pub(crate) fn job_state(wire: v1::JobState) -> Option<JobState> {
    match wire {
        v1::JobState::Unspecified => None,
        v1::JobState::Queued => Some(JobState::Queued),
        v1::JobState::Leased => Some(JobState::Leased),
        v1::JobState::Succeeded => Some(JobState::Succeeded),
        v1::JobState::Failed => Some(JobState::Failed),
        v1::JobState::Cancelled => Some(JobState::Cancelled),
    }
}

pub(crate) fn collection(wire: &v1::Collection) -> Result<Collection, Refused> {
    Ok(Collection {
        name: parsed(&wire.name, "name")?,
        // Absent on the wire is 0, which no collection can have.
        weight: if wire.weight == 0.0 { 1.0 } else { wire.weight },
        max_running: wire.max_running,
        paused: wire.paused,
    })
}

pub(crate) fn to_timestamp(time: DateTime<Utc>) -> Timestamp {
    Timestamp {
        seconds: time.timestamp(),
        nanos: time.timestamp_subsec_nanos() as i32,
    }
}

pub(crate) fn to_spec(spec: &JobSpec) -> v1::JobSpec {
    v1::JobSpec {
        object: Some((&spec.object).into()),
        capture_digest: spec.capture_digest.to_string(),
        recipe_json: spec.recipe_json.clone(),
        priority: spec.priority,
        labels: spec.labels.clone().into_iter().collect(),
        max_attempts: spec.max_attempts,
    }
}

/// The job alone; what else the wire has (bundle, place in the queue) is asked for by the caller.
pub(crate) fn to_job(job: &Job) -> v1::Job {
    let state = match job.state {
        JobState::Queued => v1::JobState::Queued,
        JobState::Leased => v1::JobState::Leased,
        JobState::Succeeded => v1::JobState::Succeeded,
        JobState::Failed => v1::JobState::Failed,
        JobState::Cancelled => v1::JobState::Cancelled,
    };
    v1::Job {
        id: job.id.to_string(),
        spec: Some(to_spec(&job.spec)),
        state: state.into(),
        attempt: job.attempt.0,
        worker: job
            .worker
            .as_ref()
            .map(ToString::to_string)
            .unwrap_or_default(),
        progress: job.progress.as_ref().map(to_progress),
        failure: job.failure.as_ref().map(to_failure),
        checkpoint_digest: job
            .checkpoint
            .as_ref()
            .map(|it| it.digest.to_string())
            .unwrap_or_default(),
        bundle: None,
        submitted_at: Some(to_timestamp(job.submitted_at)),
        started_at: job.started_at.map(to_timestamp),
        finished_at: job.finished_at.map(to_timestamp),
        queue_position: 0,
        waiting_for: String::new(),
        max_attempts: job.attempt_limit,
        traceparent: job.traceparent.clone().unwrap_or_default(),
    }
}

fn to_progress(progress: &Progress) -> v1::Progress {
    let Progress {
        stage,
        percent,
        eta_secs,
        error,
        message,
    } = progress.clone();
    v1::Progress {
        stage,
        percent,
        eta_secs,
        error,
        message,
    }
}

fn to_failure(failure: &Failure) -> v1::Failure {
    let kind = match failure.kind {
        FailureKind::Transient => v1::FailureKind::Transient,
        FailureKind::InvalidInput => v1::FailureKind::InvalidInput,
        FailureKind::Crashed => v1::FailureKind::Crashed,
        FailureKind::Cancelled => v1::FailureKind::Cancelled,
    };
    v1::Failure {
        kind: kind.into(),
        message: failure.message.clone(),
        at: failure.at.clone(),
        hint: failure.hint.clone(),
    }
}

pub(crate) fn to_log_line(line: LogLine) -> v1::LogLine {
    let level = match line.level {
        Level::Info => "info",
        Level::Warn => "warn",
        Level::Error => "error",
    };
    v1::LogLine {
        seq: line.seq,
        at: Some(to_timestamp(line.at)),
        attempt: line.attempt.0,
        level: level.to_owned(),
        message: line.message,
    }
}

pub(crate) fn to_worker(worker: &Worker) -> v1::Worker {
    let job_ids: Vec<String> = worker.jobs.iter().map(ToString::to_string).collect();
    v1::Worker {
        id: worker.info.id.to_string(),
        hostname: worker.info.hostname.clone(),
        version: worker.info.version.clone(),
        device: worker.info.device.clone(),
        last_seen_at: Some(to_timestamp(worker.last_seen_at)),
        job_id: job_ids.first().cloned().unwrap_or_default(),
        draining: worker.draining,
        job_ids,
    }
}

pub(crate) fn to_bundle(version: Version) -> v1::BundleVersion {
    v1::BundleVersion {
        object: Some((&version.object).into()),
        version: version.version,
        manifest_digest: version.bundle.manifest_digest.to_string(),
        aliases: version.aliases,
        created_at: Some(to_timestamp(version.created_at)),
        size_bytes: version.bundle.size_bytes,
        job_id: version.job.to_string(),
        metrics_json: version.bundle.metrics_json,
        retired: version.retired,
    }
}

pub(crate) fn to_collection(collection: &Collection) -> v1::Collection {
    v1::Collection {
        name: collection.name.to_string(),
        weight: collection.weight,
        max_running: collection.max_running,
        paused: collection.paused,
    }
}

pub(crate) fn to_webhook(webhook: &Webhook) -> v1::Webhook {
    v1::Webhook {
        collection: webhook.collection.to_string(),
        url: webhook.url.clone(),
        set_at: Some(to_timestamp(webhook.set_at)),
    }
}

pub(crate) fn to_delivery(delivery: &Delivery) -> v1::Delivery {
    let pending = delivery.state == DeliveryState::Pending;
    v1::Delivery {
        id: delivery.id.clone(),
        collection: delivery.collection.to_string(),
        job_id: delivery.job.to_string(),
        event: delivery.event.clone(),
        state: delivery.state.as_str().to_owned(),
        tries: delivery.tries,
        created_at: Some(to_timestamp(delivery.created_at)),
        next_at: pending.then(|| to_timestamp(delivery.next_at)),
        ended_at: delivery.ended_at.map(to_timestamp),
        last_error: delivery.last_error.clone().unwrap_or_default(),
    }
}
