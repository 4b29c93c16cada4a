//! A worker played by the test: leases, reports, publishes a small but valid bundle.

use std::path::Path;

use glam::{DAffine3, DVec3};
use ign_bundle::{BundleWriter, Metrics, Reference};
use ign_geometry::{Camera, CameraIntrinsics, Mesh, Similarity};
use ign_proto::Digest;
use ign_proto::v1;
use ign_proto::v1::workers_client::WorkersClient;
use serde_json::json;
use tonic::Request;
use tonic::metadata::MetadataValue;
use tonic::transport::Channel;

use crate::harness::Service;

pub(crate) const NAME: &str = "fake-1";

/// Address and token of the service it works for.
#[derive(Clone)]
pub(crate) struct FakeWorker {
    url: String,
    token: String,
}

impl FakeWorker {
    pub(crate) fn new(service: &Service) -> Self {
        let token = std::fs::read_to_string(service.token_file()).unwrap();
        Self {
            url: service.url().trim_end_matches('/').to_string(),
            token: token.trim().to_string(),
        }
    }

    /// Leases one job and does `work` with it.
    pub(crate) fn run_one<F: Future<Output = ()>>(self, work: impl FnOnce(Self, v1::Lease) -> F) {
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build()
            .unwrap();
        runtime.block_on(async {
            let lease = self.lease().await;
            work(self, lease).await;
        });
    }

    async fn client(&self) -> WorkersClient<Channel> {
        WorkersClient::connect(self.url.clone()).await.unwrap()
    }

    fn request<T>(&self, message: T) -> Request<T> {
        let mut request = Request::new(message);
        let token = MetadataValue::try_from(format!("Bearer {}", self.token)).unwrap();
        request.metadata_mut().insert("authorization", token);
        request
    }

    async fn lease(&self) -> v1::Lease {
        let mut client = self.client().await;
        for _ in 0..20 {
            let request = v1::LeaseRequest {
                worker_id: NAME.into(),
                hostname: "test".into(),
                version: "0.1.0".into(),
                device: "none".into(),
                wait_secs: 2.0,
            };
            let answer = client.lease(self.request(request)).await.unwrap();
            if let Some(lease) = answer.into_inner().lease {
                return lease;
            }
        }
        panic!("no job to lease");
    }

    fn attempt(lease: &v1::Lease) -> v1::JobAttempt {
        v1::JobAttempt {
            job_id: lease.job_id.clone(),
            attempt: lease.attempt,
            worker_id: NAME.into(),
        }
    }

    async fn heartbeat(
        &self,
        lease: &v1::Lease,
        progress: Option<v1::Progress>,
        logs: Vec<v1::LogLine>,
    ) {
        let request = v1::HeartbeatRequest {
            job: Some(Self::attempt(lease)),
            progress,
            logs,
        };
        self.client()
            .await
            .heartbeat(self.request(request))
            .await
            .unwrap();
    }

    /// Reports progress; waits until watchers have had time to see it.
    pub(crate) async fn progress(&self, lease: &v1::Lease, stage: &str, percent: f64) {
        let progress = v1::Progress {
            stage: stage.into(),
            percent,
            eta_secs: Some(80.0),
            error: Some(7.4),
            message: "epoch 5 of 12".into(),
        };
        self.heartbeat(lease, Some(progress), Vec::new()).await;
        tokio::time::sleep(std::time::Duration::from_millis(500)).await;
    }

    pub(crate) async fn log(&self, lease: &v1::Lease, level: &str, message: &str) {
        let line = v1::LogLine {
            seq: 1,
            at: Some(prost_types::Timestamp {
                seconds: 1_800_000_000,
                nanos: 0,
            }),
            attempt: lease.attempt,
            level: level.into(),
            message: message.into(),
        };
        self.heartbeat(lease, None, vec![line]).await;
    }

    pub(crate) async fn fail(&self, lease: &v1::Lease, failure: v1::Failure) {
        let request = v1::FailRequest {
            job: Some(Self::attempt(lease)),
            failure: Some(failure),
            logs: Vec::new(),
        };
        self.client()
            .await
            .fail(self.request(request))
            .await
            .unwrap();
    }

    /// Uploads a bundle and completes the job.
    pub(crate) async fn publish(&self, lease: &v1::Lease) {
        let spec = lease.spec.clone().unwrap();
        let object = spec.object.unwrap();
        let dir = tempfile::tempdir().unwrap();
        let metrics = write_bundle(&dir.path().join("bundle"), &object, &spec.capture_digest);
        let mut files = Vec::new();
        let http = reqwest::Client::new();
        for entry in walkdir::WalkDir::new(dir.path().join("bundle")).sort_by_file_name() {
            let entry = entry.unwrap();
            if !entry.file_type().is_file() {
                continue;
            }
            let bytes = std::fs::read(entry.path()).unwrap();
            let path = entry
                .path()
                .strip_prefix(dir.path().join("bundle"))
                .unwrap()
                .to_str()
                .unwrap()
                .to_string();
            let digest = Digest::of(&bytes).to_string();
            let repository = format!("{}/v2/{}/{}", self.url, object.collection, object.object);
            let answer = http
                .post(format!("{repository}/blobs/uploads/?digest={digest}"))
                .bearer_auth(&self.token)
                .body(bytes.clone())
                .send()
                .await
                .unwrap();
            assert!(
                answer.status().is_success(),
                "{}",
                answer.text().await.unwrap()
            );
            files.push(v1::FileEntry {
                path,
                digest,
                size_bytes: bytes.len() as u64,
                media_type: "application/octet-stream".into(),
            });
        }
        let request = v1::CompleteRequest {
            job: Some(Self::attempt(lease)),
            files,
            metrics_json: metrics,
        };
        self.client()
            .await
            .complete(self.request(request))
            .await
            .unwrap();
    }
}

/// Writes the smallest bundle that verifies; returns the summary of its metrics.
fn write_bundle(dir: &Path, object: &v1::ObjectRef, capture: &str) -> String {
    let writer = BundleWriter::create(dir).unwrap();
    let positions = vec![
        DVec3::new(0.0, 0.0, 0.0),
        DVec3::new(1.0, 0.0, 0.0),
        DVec3::new(0.0, 1.0, 0.0),
    ];
    let world = Similarity {
        scale: 1.0,
        translation: DVec3::ZERO,
    };
    writer
        .proxy(&Mesh::new(positions, vec![[0, 1, 2]]).unwrap(), &world)
        .unwrap();
    let intrinsics = CameraIntrinsics {
        fx: 5.0,
        fy: 5.0,
        cx: 1.0,
        cy: 1.0,
        width: 2,
        height: 2,
    };
    let pose = DAffine3::from_translation(DVec3::new(0.0, 0.0, 3.0));
    let reference = Reference {
        name: "a.jpg".into(),
        camera: Camera::new(intrinsics, pose).unwrap(),
        width: 2,
        height: 2,
        rgba: vec![255; 16],
        exposure_gain: [1.0; 3],
        crop: None,
    };
    writer.references(&[reference]).unwrap();
    let method = |name: &str, mse: f64| {
        json!({
            "name": name, "mse": mse, "mse_object": 3.0 * mse, "psnr": 30.0, "psnr_object": 28.0, "ssim": 0.9,
            "flip": null, "worst_view": {"name": "a.jpg", "mse": mse}, "per_view": [],
            "train_secs": 1.0, "render_ms": 5.0, "bundle_bytes": 100
        })
    };
    let metrics = json!({
        "schema": "ign.metrics/1", "capture": capture, "resolution": [2, 2],
        "views": {"train": 7, "held_out": 1, "references": 1},
        "methods": [method("n_ibr", 10.0), method("ibr", 7.5), method("ours", 4.9)],
        "speed_error": [], "plan": {}, "stages": [], "device": "none"
    });
    let metrics: Metrics = serde_json::from_value(metrics).unwrap();
    writer.metrics(&metrics).unwrap();
    writer.report("<p>ours</p>").unwrap();
    let image = image::RgbImage::new(2, 2);
    writer.held_out("a.jpg", "ours", &image).unwrap();
    let summary =
        serde_json::to_value(ign_bundle::manifest::MetricsSummary::from(&metrics)).unwrap();
    let manifest = json!({
        "schema": "ign.bundle/1",
        "object": {"collection": object.collection, "object": object.object},
        "networks": {"effects": null, "composition": null},
        "capture": capture, "recipe": {}, "plan": {},
        "provenance": {
            "software": "test", "git": null, "device": "none", "seeds": [0],
            "started_at": "2026-01-01T00:00:00Z", "finished_at": "2026-01-01T00:00:01Z", "stages": []
        },
        "metrics": summary,
        "normalised_from_world": {"scale": 1.0, "translation": [0.0, 0.0, 0.0]},
        "colour_space": "srgb", "render": {}
    });
    writer
        .finish(serde_json::from_value(manifest).unwrap())
        .unwrap();
    summary.to_string()
}
