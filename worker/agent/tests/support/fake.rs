//! A coordinator in memory that breaks on demand, and an agent working for it.

#![expect(clippy::unwrap_used, reason = "a panic is how a test fails")]

use std::collections::{BTreeMap, HashMap, HashSet, VecDeque};
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::{Duration, Instant};

use crate::worker::TOKEN;
use axum::body::{Body, Bytes};
use axum::extract::{DefaultBodyLimit, Path, Query, Request, State};
use axum::http::{HeaderMap, StatusCode, header};
use axum::middleware::{self, Next};
use axum::response::{IntoResponse, Response};
use axum::routing::{any, get};
use ign_proto::v1::workers_server::{Workers, WorkersServer};
use ign_proto::{Cause, Digest, FileEntry, JobId, Kind, Manifest, v1};

const LEASE_SECS: f64 = 1.0;
/// Trace context of every lease.
pub(crate) const TRACE: &str = "00-4bf92f3577b34da6a3ce929d0e0e4736-00f067aa0ba902b7-01";

/// How an attempt ended, as the coordinator heard it.
#[derive(Clone, Debug)]
pub(crate) enum End {
    Completed(v1::CompleteRequest),
    Failed(v1::Failure),
}

#[derive(Default)]
#[expect(
    clippy::struct_excessive_bools,
    reason = "faults that a test switches on, each on its own"
)]
pub(crate) struct World {
    pub(crate) queue: VecDeque<v1::Lease>,
    pub(crate) blobs: HashMap<String, Vec<u8>>,
    manifests: HashMap<String, Vec<u8>>,
    uploads: HashMap<String, Vec<u8>>,
    pub(crate) ends: Vec<(String, End)>,
    pub(crate) logs: Vec<String>,
    pub(crate) progress: Vec<v1::Progress>,
    pub(crate) checkpoints: Vec<String>,
    /// Method, path and Range or Content-Range of every data plane request.
    pub(crate) requests: Vec<String>,
    pub(crate) heartbeats: usize,
    pub(crate) cancel: HashSet<String>,
    pub(crate) lost: HashSet<String>,
    pub(crate) drain: bool,
    /// Calls for work are forbidden.
    pub(crate) refuse_leases: bool,
    /// What heartbeats say that they belong to.
    pub(crate) traces: std::collections::BTreeSet<String>,
    /// Nothing is served.
    pub(crate) down: bool,
    /// The next blob downloads break off after this many bytes.
    pub(crate) cut_downloads: VecDeque<usize>,
    /// This many of the next PATCH requests are stored and then answered with an error.
    pub(crate) lose_patch_answers: usize,
    /// Forget this many uploads at their next PATCH.
    pub(crate) forget_uploads: usize,
    /// Blobs arrive changed.
    pub(crate) damage: bool,
    pub(crate) blob_missing_answers: usize,
}

#[derive(Clone)]
pub(crate) struct Coordinator {
    world: Arc<Mutex<World>>,
    pub(crate) url: String,
}

impl Coordinator {
    pub(crate) async fn start() -> Self {
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
        let url = format!("http://{}", listener.local_addr().unwrap());
        let coordinator = Self {
            world: Arc::default(),
            url,
        };
        let grpc = tonic::service::Routes::new(WorkersServer::new(coordinator.clone()));
        let app = axum::Router::new()
            .route("/v2/{c}/{o}/manifests/{digest}", get(manifest))
            .route("/v2/{c}/{o}/blobs/{digest}", any(blob))
            .route("/v2/{c}/{o}/blobs/uploads/", any(start_upload))
            .route("/v2/{c}/{o}/blobs/uploads/{id}", any(upload))
            .layer(DefaultBodyLimit::disable())
            .with_state(coordinator.clone())
            .merge(grpc.into_axum_router())
            .layer(middleware::from_fn_with_state(coordinator.clone(), gate));
        tokio::spawn(async move { axum::serve(listener, app).await });
        coordinator
    }

    pub(crate) fn world(&self) -> MutexGuard<'_, World> {
        self.world.lock().unwrap()
    }

    /// Stores a capture and returns the digest of its manifest.
    pub(crate) fn add_capture(&self, files: &[(&str, &[u8])]) -> String {
        let mut world = self.world();
        let entries = files
            .iter()
            .map(|(path, content)| {
                let digest = Digest::of(content);
                world.blobs.insert(digest.to_string(), content.to_vec());
                FileEntry {
                    path: path.parse().unwrap(),
                    digest,
                    size_bytes: content.len() as u64,
                    media_type: "application/octet-stream".into(),
                }
            })
            .collect();
        let bytes = Manifest::new(Kind::Capture, entries, BTreeMap::new())
            .unwrap()
            .encode()
            .unwrap();
        let digest = Digest::of(&bytes).to_string();
        world.manifests.insert(digest.clone(), bytes);
        digest
    }

    pub(crate) fn add_manifest(&self, bytes: &[u8]) -> String {
        let digest = Digest::of(bytes).to_string();
        self.world()
            .manifests
            .insert(digest.clone(), bytes.to_vec());
        digest
    }

    pub(crate) fn queue(&self, capture: &str, script: &serde_json::Value) -> String {
        let job_id = JobId::generate().to_string();
        self.queue_attempt(&job_id, 1, capture, script, "");
        job_id
    }

    pub(crate) fn queue_attempt(
        &self,
        job_id: &str,
        attempt: u32,
        capture: &str,
        script: &serde_json::Value,
        checkpoint: &str,
    ) {
        let spec = v1::JobSpec {
            object: Some(v1::ObjectRef {
                collection: "museum".into(),
                object: "vase".into(),
            }),
            capture_digest: capture.into(),
            recipe_json: serde_json::json!({ "script": script }).to_string(),
            ..v1::JobSpec::default()
        };
        self.world().queue.push_back(v1::Lease {
            traceparent: TRACE.to_owned(),
            job_id: job_id.into(),
            attempt,
            spec: Some(spec),
            checkpoint_digest: checkpoint.into(),
            lease_secs: LEASE_SECS,
        });
    }

    /// Waits until `condition` holds.
    pub(crate) async fn until(&self, what: &str, condition: impl Fn(&World) -> bool) {
        let started = Instant::now();
        while !condition(&self.world()) {
            if started.elapsed() > Duration::from_secs(40) {
                let world = self.world();
                panic!(
                    "no {what}: ends {:?}, logs {:#?}, requests {:#?}",
                    world.ends, world.logs, world.requests
                );
            }
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    }

    pub(crate) async fn end_of(&self, job: &str) -> End {
        self.until("end of the job", |world| {
            world.ends.iter().any(|(id, _)| id == job)
        })
        .await;
        let world = self.world();
        let ends: Vec<&End> = world
            .ends
            .iter()
            .filter_map(|(id, end)| (id == job).then_some(end))
            .collect();
        ends[ends.len() - 1].clone()
    }

    fn check(&self, job: Option<&v1::JobAttempt>) -> Result<String, Cause> {
        let job = job.unwrap();
        assert_eq!(job.worker_id, "tester");
        if self.world().lost.contains(&job.job_id) {
            return Err(Cause::LeaseLost {
                job: job.job_id.clone(),
                attempt: job.attempt,
            });
        }
        Ok(job.job_id.clone())
    }
}

/// Lets nothing through without the token, or while the coordinator is "down".
async fn gate(State(coordinator): State<Coordinator>, request: Request, next: Next) -> Response {
    if coordinator.world().down {
        return StatusCode::SERVICE_UNAVAILABLE.into_response();
    }
    let expected = format!("Bearer {TOKEN}");
    let given = request.headers().get(header::AUTHORIZATION);
    if given.is_none_or(|given| given != expected.as_str()) {
        return Cause::Unauthenticated.status().into_http::<Body>();
    }
    if request.uri().path().starts_with("/v2/") {
        let range = request
            .headers()
            .get(header::RANGE)
            .or_else(|| request.headers().get(header::CONTENT_RANGE))
            .map_or("", |value| value.to_str().unwrap());
        let line = format!("{} {} {range}", request.method(), request.uri().path());
        coordinator
            .world()
            .requests
            .push(line.trim_end().to_owned());
    }
    next.run(request).await
}

type Names = Path<(String, String, String)>;

async fn manifest(State(coordinator): State<Coordinator>, Path(names): Names) -> Response {
    match coordinator.world().manifests.get(&names.2) {
        Some(bytes) => bytes.clone().into_response(),
        None => StatusCode::NOT_FOUND.into_response(),
    }
}

async fn blob(
    State(coordinator): State<Coordinator>,
    Path(names): Names,
    request: Request,
) -> Response {
    let mut world = coordinator.world();
    let Some(mut bytes) = world.blobs.get(&names.2).cloned() else {
        return StatusCode::NOT_FOUND.into_response();
    };
    if request.method() == "HEAD" {
        return StatusCode::OK.into_response();
    }
    if world.damage {
        bytes[0] ^= 1;
    }
    let start: usize = request.headers().get(header::RANGE).map_or(0, |range| {
        let range = range.to_str().unwrap().strip_prefix("bytes=").unwrap();
        range.strip_suffix('-').unwrap().parse().unwrap()
    });
    if start > 0 && start >= bytes.len() {
        return StatusCode::RANGE_NOT_SATISFIABLE.into_response();
    }
    let mut response = Response::builder().header(header::CONTENT_LENGTH, bytes.len() - start);
    if start > 0 {
        response = response.status(StatusCode::PARTIAL_CONTENT).header(
            header::CONTENT_RANGE,
            format!("bytes {start}-{}/{}", bytes.len() - 1, bytes.len()),
        );
    }
    let mut body = bytes.split_off(start);
    let Some(cut) = world.cut_downloads.pop_front() else {
        return response.body(Body::from(body)).unwrap();
    };
    body.truncate(cut);
    let start = futures::stream::once(async { Ok(Bytes::from(body)) });
    // The start arrives before the connection breaks.
    let end = futures::stream::once(async {
        tokio::time::sleep(Duration::from_millis(200)).await;
        Err(std::io::Error::other("cut"))
    });
    let body = Body::from_stream(futures::StreamExt::chain(start, end));
    response.body(body).unwrap()
}

async fn start_upload(
    State(coordinator): State<Coordinator>,
    Query(query): Query<HashMap<String, String>>,
    body: Bytes,
) -> Response {
    let mut world = coordinator.world();
    if let Some(digest) = query.get("digest") {
        assert_eq!(&Digest::of(&body).to_string(), digest);
        world.blobs.insert(digest.clone(), body.to_vec());
        return StatusCode::CREATED.into_response();
    }
    let id = format!("u{}", world.uploads.len() + world.requests.len());
    world.uploads.insert(id.clone(), Vec::new());
    let location = format!("/v2/museum/vase/blobs/uploads/{id}");
    (StatusCode::ACCEPTED, [(header::LOCATION, location)]).into_response()
}

async fn upload(
    State(coordinator): State<Coordinator>,
    Path((_, _, id)): Names,
    Query(query): Query<HashMap<String, String>>,
    method: axum::http::Method,
    headers: HeaderMap,
    body: Bytes,
) -> Response {
    let mut world = coordinator.world();
    if method == "PATCH" && world.forget_uploads > 0 {
        world.forget_uploads -= 1;
        world.uploads.remove(&id);
    }
    let Some(upload) = world.uploads.get_mut(&id) else {
        return StatusCode::NOT_FOUND.into_response();
    };
    if method == "PATCH" {
        let range = headers[header::CONTENT_RANGE].to_str().unwrap();
        let start: usize = range.split('-').next().unwrap().parse().unwrap();
        if start != upload.len() {
            return StatusCode::RANGE_NOT_SATISFIABLE.into_response();
        }
        upload.extend_from_slice(&body);
    }
    let length = upload.len();
    if method == "PUT" {
        let content = world.uploads.remove(&id).unwrap();
        let digest = Digest::of(&content).to_string();
        if digest != query["digest"] {
            return StatusCode::BAD_REQUEST.into_response();
        }
        world.blobs.insert(digest, content);
        return StatusCode::CREATED.into_response();
    }
    if method == "PATCH" && world.lose_patch_answers > 0 {
        world.lose_patch_answers -= 1;
        return StatusCode::BAD_GATEWAY.into_response();
    }
    let location = format!("/v2/museum/vase/blobs/uploads/{id}");
    let range = format!("0-{}", length.saturating_sub(1));
    let status = if method == "GET" {
        StatusCode::NO_CONTENT
    } else {
        StatusCode::ACCEPTED
    };
    (
        status,
        [(header::LOCATION, location), (header::RANGE, range)],
    )
        .into_response()
}

#[tonic::async_trait]
impl Workers for Coordinator {
    async fn lease(
        &self,
        request: tonic::Request<v1::LeaseRequest>,
    ) -> Result<tonic::Response<v1::LeaseResponse>, tonic::Status> {
        let wait = Duration::from_secs_f64(request.into_inner().wait_secs);
        let started = Instant::now();
        loop {
            let lease = {
                let mut world = self.world();
                if world.refuse_leases {
                    let message = "no more".to_owned();
                    return Err(Cause::Forbidden { message }.status());
                }
                if world.drain {
                    None
                } else {
                    world.queue.pop_front()
                }
            };
            if lease.is_some() || started.elapsed() > wait {
                return Ok(tonic::Response::new(v1::LeaseResponse { lease }));
            }
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
    }

    async fn heartbeat(
        &self,
        request: tonic::Request<v1::HeartbeatRequest>,
    ) -> Result<tonic::Response<v1::HeartbeatResponse>, tonic::Status> {
        let trace = request.metadata().get("traceparent").cloned();
        let request = request.into_inner();
        let job = self.check(request.job.as_ref())?;
        let mut world = self.world();
        world
            .traces
            .extend(trace.map(|trace| trace.to_str().unwrap().to_owned()));
        world.heartbeats += 1;
        world.progress.extend(request.progress);
        world
            .logs
            .extend(request.logs.into_iter().map(|line| line.message));
        Ok(tonic::Response::new(v1::HeartbeatResponse {
            cancel: world.cancel.contains(&job),
            drain: world.drain,
            lease_secs: LEASE_SECS,
        }))
    }

    async fn checkpoint(
        &self,
        request: tonic::Request<v1::CheckpointRequest>,
    ) -> Result<tonic::Response<v1::CheckpointResponse>, tonic::Status> {
        let request = request.into_inner();
        self.check(request.job.as_ref())?;
        let mut world = self.world();
        assert_eq!(
            world.blobs[&request.digest].len() as u64,
            request.size_bytes
        );
        world.checkpoints.push(request.digest);
        Ok(tonic::Response::new(v1::CheckpointResponse {}))
    }

    async fn complete(
        &self,
        request: tonic::Request<v1::CompleteRequest>,
    ) -> Result<tonic::Response<v1::CompleteResponse>, tonic::Status> {
        let request = request.into_inner();
        let job = self.check(request.job.as_ref())?;
        let mut world = self.world();
        if world.blob_missing_answers > 0 {
            world.blob_missing_answers -= 1;
            world.blobs.clear();
            return Err(Cause::NotAllowed {
                reason: "BLOB_MISSING".into(),
                message: "a blob is gone".into(),
            }
            .status());
        }
        for file in &request.files {
            assert!(world.blobs.contains_key(&file.digest), "{}", file.path);
        }
        world.lost.insert(job.clone());
        world.ends.push((job, End::Completed(request)));
        let bundle = Some(v1::BundleVersion {
            version: 1,
            ..v1::BundleVersion::default()
        });
        Ok(tonic::Response::new(v1::CompleteResponse { bundle }))
    }

    async fn fail(
        &self,
        request: tonic::Request<v1::FailRequest>,
    ) -> Result<tonic::Response<v1::FailResponse>, tonic::Status> {
        let request = request.into_inner();
        let job = self.check(request.job.as_ref())?;
        let mut world = self.world();
        world
            .logs
            .extend(request.logs.into_iter().map(|line| line.message));
        world
            .ends
            .push((job, End::Failed(request.failure.unwrap())));
        Ok(tonic::Response::new(v1::FailResponse { will_retry: false }))
    }
}

impl World {
    /// The rest of the first log line that begins so.
    pub(crate) fn log_after(&self, start: &str) -> Option<String> {
        self.logs_after(start).into_iter().next()
    }

    /// The rest of every log line that begins so.
    pub(crate) fn logs_after(&self, start: &str) -> Vec<String> {
        self.logs
            .iter()
            .filter_map(|line| line.strip_prefix(start))
            .map(str::to_owned)
            .collect()
    }
}
