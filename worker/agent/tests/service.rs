//! The agent against the real coordinator, in this process, with `SQLite` and a local store.

#![expect(clippy::unwrap_used, reason = "a panic is how a test fails")]

#[path = "support/worker.rs"]
mod worker;

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::time::{Duration, Instant};

use ign_coordinator::{Config, Running};
use ign_proto::v1::jobs_client::JobsClient;
use ign_proto::{Digest, FileEntry, Kind, Manifest, v1};
use ign_queue::{Backoff, Settings};
use ign_registry::StoreConfig;
use serde_json::json;
use tokio_util::sync::CancellationToken;
use tonic::transport::Channel;
use worker::{TOKEN, Worker, alive};

const OBJECT: &str = "/v2/museum/vase";

struct Service {
    dir: tempfile::TempDir,
    address: SocketAddr,
    running: Option<(Running, CancellationToken)>,
    http: reqwest::Client,
}

impl Service {
    async fn start() -> Self {
        let dir = tempfile::tempdir().unwrap();
        std::fs::write(dir.path().join("token"), TOKEN).unwrap();
        let mut service = Self {
            dir,
            address: "127.0.0.1:0".parse().unwrap(),
            running: None,
            http: reqwest::Client::new(),
        };
        service.serve().await;
        service
    }

    async fn serve(&mut self) {
        let folder = self.dir.path().display();
        let config = Config {
            listen: self.address,
            database: format!("sqlite://{folder}/ign.db"),
            store: StoreConfig::new(format!("file://{folder}/store")),
            token_file: self.dir.path().join("token"),
            endpoint_file: None,
            settings: Settings {
                lease: Duration::from_secs(6),
                backoff: Backoff {
                    base: Duration::from_millis(50),
                    cap: Duration::from_millis(50),
                },
                poll: Duration::from_millis(100),
            },
            tls: None,
            behind_tls_proxy: false,
            limits: ign_coordinator::Limits::default(),
            redirect_blobs: true,
            care: ign_coordinator::Care::default(),
            webhook_internal: Vec::new(),
        };
        let stop = CancellationToken::new();
        let running = ign_coordinator::serve(config, stop.clone().cancelled_owned())
            .await
            .unwrap();
        self.address = running.address();
        self.running = Some((running, stop));
    }

    async fn stop(&mut self) {
        let (running, stop) = self.running.take().unwrap();
        stop.cancel();
        running.wait().await.unwrap();
    }

    fn url(&self) -> String {
        format!("http://{}", self.address)
    }

    async fn jobs(&self) -> JobsClient<Channel> {
        JobsClient::connect(self.url()).await.unwrap()
    }

    fn request<T>(message: T) -> tonic::Request<T> {
        let mut request = tonic::Request::new(message);
        let bearer = format!("Bearer {TOKEN}").parse().unwrap();
        request.metadata_mut().insert("authorization", bearer);
        request
    }

    async fn send(&self, request: reqwest::RequestBuilder) {
        let response = request.bearer_auth(TOKEN).send().await.unwrap();
        let status = response.status();
        assert!(
            status.is_success(),
            "{status}: {}",
            response.text().await.unwrap()
        );
    }

    /// Uploads a capture of these files and returns its digest.
    async fn upload(&self, files: &[(&str, &[u8])]) -> Digest {
        let url = format!("{}{OBJECT}", self.url());
        let mut entries = Vec::new();
        // The empty config is part of every manifest.
        let config: (&str, &[u8]) = ("", b"{}");
        for (path, content) in files.iter().chain([&config]) {
            let digest = Digest::of(content);
            let upload = format!("{url}/blobs/uploads/?digest={digest}");
            self.send(self.http.post(upload).body(content.to_vec()))
                .await;
            if !path.is_empty() {
                entries.push(FileEntry {
                    path: path.parse().unwrap(),
                    digest,
                    size_bytes: content.len() as u64,
                    media_type: "application/octet-stream".into(),
                });
            }
        }
        let bytes = Manifest::new(Kind::Capture, entries, BTreeMap::new())
            .unwrap()
            .encode()
            .unwrap();
        let digest = Digest::of(&bytes);
        let put = self
            .http
            .put(format!("{url}/manifests/{digest}"))
            .header("content-type", "application/vnd.oci.image.manifest.v1+json")
            .body(bytes);
        self.send(put).await;
        digest
    }

    async fn submit(&self, capture: &Digest, script: serde_json::Value) -> String {
        let spec = v1::JobSpec {
            object: Some(v1::ObjectRef {
                collection: "museum".into(),
                object: "vase".into(),
            }),
            capture_digest: capture.to_string(),
            recipe_json: json!({ "script": script }).to_string(),
            ..v1::JobSpec::default()
        };
        let request = v1::SubmitRequest {
            request_id: script.to_string(),
            spec: Some(spec),
        };
        let mut jobs = self.jobs().await;
        let job = jobs.submit(Self::request(request)).await.unwrap();
        job.into_inner().id
    }

    async fn get(&self, job: &str) -> v1::Job {
        let request = v1::GetJobRequest { job_id: job.into() };
        let mut jobs = self.jobs().await;
        jobs.get(Self::request(request)).await.unwrap().into_inner()
    }

    async fn until(&self, job: &str, what: &str, condition: impl Fn(&v1::Job) -> bool) -> v1::Job {
        let started = Instant::now();
        loop {
            let state = self.get(job).await;
            if condition(&state) {
                return state;
            }
            assert!(
                started.elapsed() < Duration::from_mins(1),
                "no {what}: {state:?}"
            );
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
    }

    async fn ended(&self, job: &str) -> v1::Job {
        self.until(job, "end", |job| {
            matches!(
                job.state(),
                v1::JobState::Succeeded | v1::JobState::Failed | v1::JobState::Cancelled
            )
        })
        .await
    }

    async fn log_after(&self, job: &str, start: &str) -> Option<String> {
        let request = v1::LogsRequest {
            job_id: job.into(),
            ..v1::LogsRequest::default()
        };
        let mut jobs = self.jobs().await;
        let mut lines = jobs
            .logs(Self::request(request))
            .await
            .unwrap()
            .into_inner();
        while let Some(line) = lines.message().await.unwrap() {
            if let Some(rest) = line.message.strip_prefix(start) {
                return Some(rest.to_owned());
            }
        }
        None
    }
}

const FILES: &[(&str, &[u8])] = &[("mesh.ply", b"ply"), ("images/1.png", b"one")];

#[tokio::test(flavor = "multi_thread")]
async fn a_job_runs_crashes_resumes_and_is_published() {
    let service = Service::start().await;
    let capture = service.upload(FILES).await;
    let script = json!([
        {"read": "images/1.png"}, {"progress": 30.0}, {"checkpoint": "epoch 5"}, {"sleep_ms": 500},
        {"abort_unless_resumed": true}, {"done": 9_000_000}
    ]);
    let job = service.submit(&capture, script).await;
    let worker = Worker::start(&service.url());
    let end = service.ended(&job).await;
    assert_eq!(end.state(), v1::JobState::Succeeded, "{end:?}");
    assert_eq!(end.attempt, 2);
    let bundle = end.bundle.unwrap();
    assert_eq!(bundle.version, 1);
    assert!(bundle.size_bytes > 9_000_000);
    assert!(bundle.metrics_json.contains("\"mse\":4.5"), "{bundle:?}");
    assert_eq!(
        service.log_after(&job, "resumed from ").await.as_deref(),
        Some("epoch 5")
    );
    assert_eq!(
        service.log_after(&job, "images/1.png: ").await.as_deref(),
        Some("one")
    );
    worker.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn bad_input_and_cancel_end_as_such() {
    let service = Service::start().await;
    let capture = service.upload(FILES).await;
    let bad = service
        .submit(
            &capture,
            json!([{"fail": "camera 3 has zero focal length"}]),
        )
        .await;
    let slow = service
        .submit(&capture, json!([{"sleep_ms": 600_000}]))
        .await;
    let worker = Worker::start(&service.url());
    let end = service.ended(&bad).await;
    assert_eq!(end.state(), v1::JobState::Failed);
    assert_eq!(end.attempt, 1);
    let failure = end.failure.unwrap();
    assert_eq!(failure.kind(), v1::FailureKind::InvalidInput);
    assert_eq!(failure.at, "sparse/cameras.txt:7");

    service
        .until(&slow, "start", |job| job.state() == v1::JobState::Leased)
        .await;
    let mut jobs = service.jobs().await;
    let request = v1::GetJobRequest {
        job_id: slow.clone(),
    };
    jobs.cancel(Service::request(request)).await.unwrap();
    let end = service.ended(&slow).await;
    assert_eq!(end.state(), v1::JobState::Cancelled);
    worker.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_bake_outlives_a_restart_of_the_coordinator() {
    let mut service = Service::start().await;
    let capture = service.upload(FILES).await;
    let script = json!([{"progress": 30.0}, {"sleep_ms": 3000}, {"done": 100}]);
    let job = service.submit(&capture, script).await;
    let worker = Worker::start(&service.url());
    service
        .until(&job, "progress", |job| {
            job.progress
                .as_ref()
                .is_some_and(|progress| progress.percent > 1.0)
        })
        .await;
    service.stop().await;
    tokio::time::sleep(Duration::from_secs(1)).await;
    service.serve().await;
    let end = service.ended(&job).await;
    assert_eq!(end.state(), v1::JobState::Succeeded, "{end:?}");
    assert_eq!(end.attempt, 1);
    worker.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn another_worker_goes_on_where_one_was_shut_down() {
    let service = Service::start().await;
    let capture = service.upload(FILES).await;
    let script = json!([
        {"checkpoint": "epoch 9"}, {"print": "checkpointed"}, {"sleep_ms": 3000}, {"done": 100}
    ]);
    let job = service.submit(&capture, script).await;
    let first = Worker::start(&service.url());
    service
        .until(&job, "checkpoint", |job| !job.checkpoint_digest.is_empty())
        .await;
    first.stop().await;
    let pid = service.log_after(&job, "pid ").await.unwrap();
    assert!(!alive(&pid));
    let second = Worker::start(&service.url());
    let end = service.ended(&job).await;
    assert_eq!(end.state(), v1::JobState::Succeeded, "{end:?}");
    assert_eq!(end.attempt, 2);
    assert_eq!(
        service.log_after(&job, "resumed from ").await.as_deref(),
        Some("epoch 9")
    );
    second.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn two_slots_bake_two_jobs_at_once_and_status_shows_both() {
    let service = Service::start().await;
    let capture = service.upload(FILES).await;
    let mut running = Vec::new();
    for name in ["one", "two"] {
        let script = json!([{"print": name}, {"sleep_ms": 3000}, {"done": 100}]);
        running.push(service.submit(&capture, script).await);
    }
    let queued = service.submit(&capture, json!([{"done": 100}])).await;
    let worker = Worker::with_slots(&service.url(), 2);
    for job in &running {
        service
            .until(job, "start", |job| job.state() == v1::JobState::Leased)
            .await;
    }
    let request = Service::request(v1::StatusRequest::default());
    let status = service.jobs().await.status(request).await.unwrap();
    let status = status.into_inner();
    assert_eq!(status.workers.len(), 1);
    let shown = &status.workers[0];
    assert_eq!(shown.id, "tester");
    assert_eq!(shown.job_id, shown.job_ids[0]);
    let mut ids = shown.job_ids.clone();
    ids.sort_unstable();
    running.sort_unstable();
    assert_eq!(ids, running);
    assert_eq!(status.running.len(), 2);

    let mut versions = Vec::new();
    for job in running.iter().chain([&queued]) {
        let end = service.ended(job).await;
        assert_eq!(end.state(), v1::JobState::Succeeded, "{end:?}");
        assert_eq!(end.attempt, 1);
        versions.push(end.bundle.unwrap().version);
    }
    versions.sort_unstable();
    assert_eq!(versions, [1, 2, 3]);
    worker.stop().await;
}
