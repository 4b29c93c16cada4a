//! What ignctl shows of jobs, workers and bundles: the stable fields of `-o json` and `-o yaml`, and their tables.
//!
//! The field names are an interface (listed in README.md): they are added to, never renamed. A field without a value is
//! `null`, not absent.

use chrono::{DateTime, Utc};
use ign_proto::v1;
use ign_trace::TraceParent;
use serde::Serialize;
use serde_json::Value;

use crate::output::{Table, age, bytes, duration, number};

/// State words, as in the proto.
pub(crate) const STATES: [&str; 5] = ["queued", "leased", "succeeded", "failed", "cancelled"];

#[derive(Clone, Debug, Serialize)]
pub(crate) struct JobView {
    pub(crate) id: String,
    pub(crate) collection: String,
    pub(crate) object: String,
    pub(crate) state: &'static str,
    pub(crate) attempt: u32,
    pub(crate) max_attempts: u32,
    pub(crate) priority: i32,
    pub(crate) worker: Option<String>,
    pub(crate) progress: Option<ProgressView>,
    pub(crate) failure: Option<FailureView>,
    pub(crate) bundle: Option<BundleView>,
    pub(crate) capture_digest: String,
    pub(crate) recipe: Value,
    pub(crate) checkpoint_digest: Option<String>,
    pub(crate) trace_id: Option<String>,
    pub(crate) submitted_at: Option<DateTime<Utc>>,
    pub(crate) started_at: Option<DateTime<Utc>>,
    pub(crate) finished_at: Option<DateTime<Utc>>,
    pub(crate) queue_position: Option<u64>,
    pub(crate) waiting_for: Option<String>,
}

#[derive(Clone, Debug, Serialize)]
pub(crate) struct ProgressView {
    pub(crate) stage: String,
    pub(crate) percent: f64,
    pub(crate) eta_secs: Option<f64>,
    /// Current validation error.
    pub(crate) mse: Option<f64>,
    pub(crate) message: String,
}

#[derive(Clone, Debug, Serialize)]
pub(crate) struct FailureView {
    pub(crate) kind: &'static str,
    pub(crate) message: String,
    pub(crate) at: Option<String>,
    pub(crate) hint: Option<String>,
}

#[derive(Clone, Debug, Serialize)]
pub(crate) struct BundleView {
    pub(crate) collection: String,
    pub(crate) object: String,
    pub(crate) version: u32,
    pub(crate) digest: String,
    pub(crate) aliases: Vec<String>,
    pub(crate) created_at: Option<DateTime<Utc>>,
    pub(crate) size_bytes: u64,
    pub(crate) job_id: String,
    pub(crate) metrics: Value,
    pub(crate) retired: bool,
}

#[derive(Clone, Debug, Serialize)]
pub(crate) struct WorkerView {
    pub(crate) id: String,
    pub(crate) hostname: String,
    pub(crate) version: String,
    pub(crate) device: String,
    pub(crate) last_seen_at: Option<DateTime<Utc>>,
    /// The first of `job_ids`.
    pub(crate) job_id: Option<String>,
    pub(crate) job_ids: Vec<String>,
    pub(crate) draining: bool,
}

/// A protobuf time; none when out of range.
pub(crate) fn time(at: Option<&prost_types::Timestamp>) -> Option<DateTime<Utc>> {
    at.and_then(|at| DateTime::from_timestamp(at.seconds, u32::try_from(at.nanos).ok()?))
}

fn some(text: &str) -> Option<String> {
    (!text.is_empty()).then(|| text.to_string())
}

/// JSON kept as text on the wire; text that is no JSON stays a string.
fn embedded(json: &str) -> Value {
    if json.is_empty() {
        return Value::Null;
    }
    serde_json::from_str(json).unwrap_or_else(|_| Value::String(json.to_string()))
}

pub(crate) fn state_word(state: v1::JobState) -> &'static str {
    match state {
        v1::JobState::Unspecified => "unknown",
        v1::JobState::Queued => "queued",
        v1::JobState::Leased => "leased",
        v1::JobState::Succeeded => "succeeded",
        v1::JobState::Failed => "failed",
        v1::JobState::Cancelled => "cancelled",
    }
}

/// Whether a job in this state has ended.
pub(crate) fn is_terminal(state: v1::JobState) -> bool {
    matches!(
        state,
        v1::JobState::Succeeded | v1::JobState::Failed | v1::JobState::Cancelled
    )
}

impl From<&v1::Failure> for FailureView {
    fn from(failure: &v1::Failure) -> Self {
        Self {
            kind: match failure.kind() {
                v1::FailureKind::Unspecified => "unknown",
                v1::FailureKind::Transient => "transient",
                v1::FailureKind::InvalidInput => "invalid_input",
                v1::FailureKind::Crashed => "crashed",
                v1::FailureKind::Cancelled => "cancelled",
            },
            message: failure.message.clone(),
            at: some(&failure.at),
            hint: some(&failure.hint),
        }
    }
}

impl From<&v1::BundleVersion> for BundleView {
    fn from(bundle: &v1::BundleVersion) -> Self {
        let object = bundle.object.clone().unwrap_or_default();
        let mut aliases = bundle.aliases.clone();
        aliases.sort();
        Self {
            collection: object.collection,
            object: object.object,
            version: bundle.version,
            digest: bundle.manifest_digest.clone(),
            aliases,
            created_at: time(bundle.created_at.as_ref()),
            size_bytes: bundle.size_bytes,
            job_id: bundle.job_id.clone(),
            metrics: embedded(&bundle.metrics_json),
            retired: bundle.retired,
        }
    }
}

impl From<&v1::Job> for JobView {
    fn from(job: &v1::Job) -> Self {
        let spec = job.spec.clone().unwrap_or_default();
        let object = spec.object.unwrap_or_default();
        let queued = job.state() == v1::JobState::Queued;
        Self {
            id: job.id.clone(),
            collection: object.collection,
            object: object.object,
            state: state_word(job.state()),
            attempt: job.attempt,
            max_attempts: job.max_attempts,
            priority: spec.priority,
            worker: some(&job.worker),
            progress: job.progress.as_ref().map(|progress| ProgressView {
                stage: progress.stage.clone(),
                percent: progress.percent,
                eta_secs: progress.eta_secs,
                mse: progress.error,
                message: progress.message.clone(),
            }),
            failure: job
                .failure
                .as_ref()
                .filter(|failure| !failure.message.is_empty())
                .map(FailureView::from),
            bundle: job.bundle.as_ref().map(BundleView::from),
            capture_digest: spec.capture_digest,
            recipe: embedded(&spec.recipe_json),
            checkpoint_digest: some(&job.checkpoint_digest),
            trace_id: job
                .traceparent
                .parse()
                .ok()
                .map(|trace: TraceParent| trace.trace_id()),
            submitted_at: time(job.submitted_at.as_ref()),
            started_at: time(job.started_at.as_ref()),
            finished_at: time(job.finished_at.as_ref()),
            queue_position: queued.then_some(job.queue_position),
            waiting_for: some(&job.waiting_for),
        }
    }
}

impl From<&v1::Worker> for WorkerView {
    fn from(worker: &v1::Worker) -> Self {
        Self {
            id: worker.id.clone(),
            hostname: worker.hostname.clone(),
            version: worker.version.clone(),
            device: worker.device.clone(),
            last_seen_at: time(worker.last_seen_at.as_ref()),
            job_id: some(&worker.job_id),
            // A coordinator of the release before names one job alone.
            job_ids: match &worker.job_ids[..] {
                [] => some(&worker.job_id).into_iter().collect(),
                several => several.to_vec(),
            },
            draining: worker.draining,
        }
    }
}

impl WorkerView {
    /// Ids of what it runs.
    pub(crate) fn jobs(&self) -> impl Iterator<Item = &str> {
        self.job_ids.iter().map(String::as_str)
    }
}

impl JobView {
    /// `collection/object`.
    pub(crate) fn name(&self) -> String {
        format!("{}/{}", self.collection, self.object)
    }

    /// The state for people: a leased job is one that runs.
    pub(crate) fn state_for_people(&self) -> &'static str {
        if self.state == "leased" {
            "running"
        } else {
            self.state
        }
    }

    /// What one line can say about this job, by its state.
    pub(crate) fn note(&self) -> String {
        match (self.state, &self.failure, &self.bundle) {
            ("succeeded", _, Some(bundle)) => bundle.summary(),
            ("failed" | "cancelled", Some(failure), _) => failure.one_line(),
            ("queued", _, _) => self.waiting_for.clone().unwrap_or_default(),
            ("leased", _, _) => self
                .progress
                .as_ref()
                .map(ProgressView::one_line)
                .unwrap_or_default(),
            _ => String::new(),
        }
    }

    /// Time from the start of the last attempt to its end, or to `now`.
    pub(crate) fn took(&self, now: DateTime<Utc>) -> String {
        match (self.started_at, self.finished_at) {
            (Some(started), end) => age(Some(started), end.unwrap_or(now)),
            (None, _) => "-".to_string(),
        }
    }
}

impl ProgressView {
    /// `composition 41%, eta 1m 20s, mse 7.40`.
    pub(crate) fn one_line(&self) -> String {
        let done = format!("{} {:.0}%", self.stage, self.percent);
        let eta = self
            .eta_secs
            .map(|eta_secs| format!("eta {}", duration(eta_secs)));
        let mse = self.mse.map(|mse| format!("mse {}", number(mse)));
        [Some(done), eta, mse]
            .into_iter()
            .flatten()
            .collect::<Vec<_>>()
            .join(", ")
    }
}

impl FailureView {
    /// `message (at)`.
    pub(crate) fn one_line(&self) -> String {
        match &self.at {
            Some(at) => format!("{} ({at})", self.message),
            None => self.message.clone(),
        }
    }
}

impl BundleView {
    /// `collection/object`.
    pub(crate) fn name(&self) -> String {
        format!("{}/{}", self.collection, self.object)
    }

    /// `v3 (latest)  12.3 MB  mse 4.90`.
    pub(crate) fn summary(&self) -> String {
        let version = match self.aliases.join(", ") {
            aliases if aliases.is_empty() => format!("v{}", self.version),
            aliases => format!("v{} ({aliases})", self.version),
        };
        let mse = self.mse().map(|mse| format!("mse {}", number(mse)));
        [Some(version), Some(bytes(self.size_bytes)), mse]
            .into_iter()
            .flatten()
            .collect::<Vec<_>>()
            .join(", ")
    }

    /// Held-out MSE of our method, from the summary kept with the version: either the method's row of a
    /// `ign.metrics/1` document or a flat summary.
    pub(crate) fn mse(&self) -> Option<f64> {
        let rows = self.metrics.get("methods").and_then(Value::as_array);
        let ours = rows.and_then(|rows| rows.iter().find(|row| row["name"] == "ours"));
        ours.or_else(|| self.metrics.get("ours"))
            .unwrap_or(&self.metrics)["mse"]
            .as_f64()
    }
}

/// How many characters of the ids of a listing to show. Ids begin with their time: 13 characters are a millisecond.
pub(crate) struct ShortIds(usize);

impl ShortIds {
    /// For a listing of these ids: as short as keeps them apart, and never shorter than a millisecond.
    pub(crate) fn of<'a>(ids: impl Iterator<Item = &'a str>) -> Self {
        let mut ids: Vec<&str> = ids.collect();
        ids.sort_unstable();
        ids.dedup();
        let shared = ids
            .windows(2)
            .map(|pair| {
                pair[0]
                    .bytes()
                    .zip(pair[1].bytes())
                    .take_while(|(a, b)| a == b)
                    .count()
            })
            .max();
        let needed = shared.map_or(0, |shared| shared + 1);
        // Cut where a UUID has its hyphens, so that the ids stay easy to read and to select.
        Self(
            [13, 18, 23]
                .into_iter()
                .find(|cut| needed <= *cut)
                .unwrap_or(36),
        )
    }

    /// The id cut to that length.
    pub(crate) fn show(&self, id: &str) -> String {
        id.chars().take(self.0).collect()
    }
}

/// One job's id for a message to a person.
pub(crate) fn short_id(id: &str) -> String {
    ShortIds(13).show(id)
}

/// Table of jobs with what their state has to say.
pub(crate) fn job_table(jobs: &[JobView], now: DateTime<Utc>) -> String {
    let ids = ShortIds::of(jobs.iter().map(|job| job.id.as_str()));
    let mut table = Table::new(&[
        "JOB", "OBJECT", "STATE", ">ATTEMPT", ">AGE", ">TOOK", "NOTE",
    ]);
    for job in jobs {
        table.row([
            ids.show(&job.id),
            job.name(),
            job.state_for_people().to_string(),
            job.attempt.to_string(),
            age(job.submitted_at, now),
            job.took(now),
            job.note(),
        ]);
    }
    table.to_string()
}

#[cfg(test)]
pub(crate) mod samples {
    use super::*;

    fn stamp(seconds: i64) -> prost_types::Timestamp {
        prost_types::Timestamp {
            seconds: 1_800_000_000 + seconds,
            nanos: 0,
        }
    }

    pub(crate) fn now() -> DateTime<Utc> {
        DateTime::from_timestamp(1_800_000_600, 0).unwrap()
    }

    pub(crate) fn job(id: &str, object: &str, state: v1::JobState) -> v1::Job {
        v1::Job {
            id: id.into(),
            spec: Some(v1::JobSpec {
                object: Some(v1::ObjectRef {
                    collection: "museum".into(),
                    object: object.into(),
                }),
                capture_digest: format!("sha256:{}", "ab".repeat(32)),
                recipe_json: r#"{"preset":"standard","size":256}"#.into(),
                priority: 0,
                labels: std::collections::HashMap::new(),
                max_attempts: 3,
            }),
            state: state.into(),
            attempt: 1,
            max_attempts: 3,
            submitted_at: Some(stamp(0)),
            ..Default::default()
        }
    }

    pub(crate) fn running() -> v1::Job {
        v1::Job {
            worker: "bakery-1".into(),
            progress: Some(v1::Progress {
                stage: "composition".into(),
                percent: 41.3,
                eta_secs: Some(80.0),
                error: Some(7.4),
                message: "epoch 5 of 12".into(),
            }),
            started_at: Some(stamp(30)),
            ..job(
                "01985a4e-0001-7000-8000-000000000001",
                "vase",
                v1::JobState::Leased,
            )
        }
    }

    pub(crate) fn failed() -> v1::Job {
        v1::Job {
            failure: Some(v1::Failure {
                kind: v1::FailureKind::InvalidInput.into(),
                message: "camera 3 has zero focal length".into(),
                at: "sparse/0/cameras.txt:7".into(),
                hint: "re-export with PINHOLE".into(),
            }),
            started_at: Some(stamp(30)),
            finished_at: Some(stamp(33)),
            ..job(
                "01985a4e-0002-7000-8000-000000000002",
                "bust",
                v1::JobState::Failed,
            )
        }
    }

    pub(crate) fn succeeded() -> v1::Job {
        v1::Job {
            bundle: Some(bundle()),
            started_at: Some(stamp(30)),
            finished_at: Some(stamp(500)),
            ..job(
                "01985a4e-0003-7000-8000-000000000003",
                "axe",
                v1::JobState::Succeeded,
            )
        }
    }

    pub(crate) fn bundle() -> v1::BundleVersion {
        v1::BundleVersion {
            object: Some(v1::ObjectRef {
                collection: "museum".into(),
                object: "axe".into(),
            }),
            version: 2,
            manifest_digest: format!("sha256:{}", "cd".repeat(32)),
            aliases: vec!["latest".into()],
            created_at: Some(stamp(500)),
            size_bytes: 12_300_000,
            job_id: "01985a4e-0003-7000-8000-000000000003".into(),
            metrics_json: r#"{"methods":[{"name":"ours","mse":4.9}]}"#.into(),
            retired: false,
        }
    }

    pub(crate) fn queued() -> v1::Job {
        v1::Job {
            queue_position: 3,
            waiting_for: "no worker connected".into(),
            attempt: 0,
            ..job(
                "01985a4e-0004-7000-8000-000000000004",
                "buddha",
                v1::JobState::Queued,
            )
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_state_says_what_matters() {
        let jobs: Vec<JobView> = [
            samples::running(),
            samples::failed(),
            samples::succeeded(),
            samples::queued(),
        ]
        .iter()
        .map(JobView::from)
        .collect();
        insta::assert_snapshot!(job_table(&jobs, samples::now()));
    }

    #[test]
    fn field_names_are_stable() {
        let views = [samples::running(), samples::failed(), samples::succeeded()];
        let views: Vec<JobView> = views.iter().map(JobView::from).collect();
        insta::assert_snapshot!(serde_json::to_string_pretty(&views).unwrap());
    }

    #[test]
    fn short_ids_stay_apart() {
        let close = [
            "01985a4e-0001-7000-8000-000000000001",
            "01985a4e-0001-7000-8000-000000000002",
        ];
        assert_eq!(ShortIds::of(close.into_iter()).show(close[0]), close[0]);
        let far = [
            "01985a4e-0001-7000-8000-000000000001",
            "01985a4e-0002-7000-8000-000000000001",
        ];
        assert_eq!(ShortIds::of(far.into_iter()).show(far[0]), "01985a4e-0001");
        let one = [
            "01985a4e-0001-7001-8000-000000000001",
            "01985a4e-0001-7002-8000-000000000001",
        ];
        assert_eq!(
            ShortIds::of(one.into_iter()).show(one[0]),
            "01985a4e-0001-7001"
        );
    }
}
