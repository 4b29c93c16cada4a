//! A coordinator with its clients.

use std::collections::BTreeMap;
use std::os::unix::fs::PermissionsExt as _;
use std::path::PathBuf;
use std::time::Duration;

use ign_coordinator::{Care, Config, Limits, Running, serve};
use ign_proto::v1::admin_client::AdminClient;
use ign_proto::v1::bundles_client::BundlesClient;
use ign_proto::v1::collections_client::CollectionsClient;
use ign_proto::v1::jobs_client::JobsClient;
use ign_proto::v1::tokens_client::TokensClient;
use ign_proto::v1::workers_client::WorkersClient;
use ign_proto::{Cause, Digest, FileEntry, Kind, Manifest, v1};
use ign_queue::{Backoff, Settings};
use ign_registry::StoreConfig;
use reqwest::{Method, RequestBuilder, StatusCode};
use tokio::sync::oneshot;
use tonic::metadata::{Ascii, MetadataValue};
use tonic::service::Interceptor;
use tonic::service::interceptor::InterceptedService;
use tonic::transport::Channel;
use tonic::{Request, Status};

pub(crate) const TOKEN: &str = "test-token-0123456789";

/// Adds the token to each call.
#[derive(Clone)]
pub(crate) struct Bearer(MetadataValue<Ascii>);

impl Interceptor for Bearer {
    fn call(&mut self, mut request: Request<()>) -> Result<Request<()>, Status> {
        request
            .metadata_mut()
            .insert("authorization", self.0.clone());
        Ok(request)
    }
}

type Authorized = InterceptedService<Channel, Bearer>;

/// A coordinator and everything to speak with it; started again on the same data by [`Service::restart`].
pub(crate) struct Service {
    pub(crate) url: String,
    pub(crate) jobs: JobsClient<Authorized>,
    pub(crate) workers: WorkersClient<Authorized>,
    pub(crate) bundles: BundlesClient<Authorized>,
    pub(crate) collections: CollectionsClient<Authorized>,
    pub(crate) tokens: TokensClient<Authorized>,
    pub(crate) admin: AdminClient<Authorized>,
    pub(crate) http: reqwest::Client,
    pub(crate) folder: PathBuf,
    config: Config,
    running: Option<(Running, oneshot::Sender<()>)>,
    _keep: tempfile::TempDir,
}

pub(crate) fn settings(lease: Duration) -> Settings {
    Settings {
        lease,
        backoff: Backoff {
            base: Duration::from_millis(20),
            cap: Duration::from_millis(50),
        },
        poll: Duration::from_millis(100),
    }
}

impl Service {
    pub(crate) async fn start() -> Self {
        Self::with(|_| {}).await
    }

    /// With other settings than the usual.
    pub(crate) async fn with(change: impl FnOnce(&mut Config)) -> Self {
        let keep = tempfile::tempdir().unwrap();
        let folder = keep.path().to_owned();
        let token_file = folder.join("token");
        std::fs::write(&token_file, format!("{TOKEN}\n")).unwrap();
        std::fs::set_permissions(&token_file, std::fs::Permissions::from_mode(0o600)).unwrap();
        let mut config = Config {
            listen: "127.0.0.1:0".parse().unwrap(),
            database: format!("sqlite://{}/ign.db", folder.display()),
            store: StoreConfig::new(format!("file://{}/store", folder.display())),
            token_file,
            endpoint_file: Some(folder.join("endpoint.json")),
            settings: settings(Duration::from_secs(45)),
            redirect_blobs: true,
            tls: None,
            behind_tls_proxy: false,
            limits: Limits::default(),
            care: Care::default(),
            webhook_internal: Vec::new(),
        };
        change(&mut config);
        let http = reqwest::Client::new();
        let (running, stop) = launch(&config).await;
        let url = running.url();
        let Clients {
            jobs,
            workers,
            bundles,
            collections,
            tokens,
            admin,
        } = Clients::new(&url, TOKEN);
        Self {
            url,
            jobs,
            workers,
            bundles,
            collections,
            tokens,
            admin,
            http,
            folder,
            config,
            running: Some((running, stop)),
            _keep: keep,
        }
    }

    /// Its settings, changed.
    pub(crate) fn config(&self, change: impl FnOnce(&mut Config)) -> Config {
        let mut config = self.config.clone();
        change(&mut config);
        config
    }

    /// As SIGHUP does.
    pub(crate) fn reload_certificates(&self) {
        self.running.as_ref().unwrap().0.reload_certificates()();
    }

    /// Changes what the next start cares for.
    pub(crate) fn care(&mut self, change: impl FnOnce(&mut Care)) {
        change(&mut self.config.care);
    }

    /// Stops the coordinator and waits for its end.
    pub(crate) async fn stop(&mut self) {
        let (running, stop) = self.running.take().unwrap();
        stop.send(()).unwrap();
        running.wait().await.unwrap();
    }

    /// Starts it again on the same data, at another port.
    pub(crate) async fn restart(&mut self) {
        if self.running.is_some() {
            self.stop().await;
        }
        let (running, stop) = launch(&self.config).await;
        self.url = running.url();
        Clients {
            jobs: self.jobs,
            workers: self.workers,
            bundles: self.bundles,
            collections: self.collections,
            tokens: self.tokens,
            admin: self.admin,
        } = Clients::new(&self.url, TOKEN);
        self.running = Some((running, stop));
    }

    /// A request with the token.
    pub(crate) fn request(&self, method: Method, path: &str) -> RequestBuilder {
        self.http
            .request(method, format!("{}{path}", self.url))
            .bearer_auth(TOKEN)
    }

    /// A token that allows `grants`.
    pub(crate) async fn token(&mut self, grants: &[&str]) -> String {
        self.token_for(grants, 0.0).await
    }

    /// The same, for so long.
    pub(crate) async fn token_for(&mut self, grants: &[&str], valid_secs: f64) -> String {
        let request = v1::CreateTokenRequest {
            name: format!("t{}", uuid::Uuid::new_v4().simple()),
            grants: grants.iter().map(ToString::to_string).collect(),
            valid_secs,
        };
        self.tokens
            .create(request)
            .await
            .unwrap()
            .into_inner()
            .secret
    }

    /// Its next secret; the one until now is good for `grace_secs`.
    pub(crate) async fn rotate(&mut self, secret: &str, grace_secs: f64) -> String {
        let request = v1::RotateTokenRequest {
            token: token_id(secret).to_owned(),
            grace_secs,
            valid_secs: 0.0,
        };
        self.tokens
            .rotate(request)
            .await
            .unwrap()
            .into_inner()
            .secret
    }

    pub(crate) async fn revoke(&mut self, secret: &str) {
        let token = token_id(secret).to_owned();
        self.tokens
            .revoke(v1::RevokeTokenRequest { token })
            .await
            .unwrap();
    }

    pub(crate) async fn upload(&self, object: &str, bytes: &[u8]) -> Digest {
        let digest = Digest::of(bytes);
        let path = format!("/v2/{object}/blobs/uploads/?digest={digest}");
        let answer = self
            .request(Method::POST, &path)
            .body(bytes.to_vec())
            .send()
            .await
            .unwrap();
        assert_eq!(answer.status(), StatusCode::CREATED);
        digest
    }

    /// Uploads files and their manifest; returns its digest.
    pub(crate) async fn upload_capture(&self, object: &str, files: &[(&str, &[u8])]) -> Digest {
        for (_, bytes) in files {
            self.upload(object, bytes).await;
        }
        let bytes = manifest(Kind::Capture, files).encode().unwrap();
        let digest = Digest::of(&bytes);
        let path = format!("/v2/{object}/manifests/{digest}");
        let answer = self
            .request(Method::PUT, &path)
            .body(bytes)
            .send()
            .await
            .unwrap();
        assert_eq!(
            answer.status(),
            StatusCode::CREATED,
            "{}",
            answer.text().await.unwrap()
        );
        digest
    }

    /// A submitted job for an object.
    pub(crate) async fn submit(&mut self, object: &str, request_id: &str) -> v1::Job {
        let capture = self
            .upload_capture(object, &[("images/1.png", b"one"), ("mesh.ply", b"ply")])
            .await;
        self.jobs
            .submit(submit_request(object, request_id, &capture))
            .await
            .unwrap()
            .into_inner()
    }

    /// A lease, waiting at most `wait_secs`.
    pub(crate) async fn lease(&mut self, worker: &str, wait_secs: f64) -> Option<v1::Lease> {
        let request = v1::LeaseRequest {
            worker_id: worker.to_owned(),
            hostname: "host".to_owned(),
            version: "0".to_owned(),
            device: "cpu".to_owned(),
            wait_secs,
        };
        self.workers
            .lease(request)
            .await
            .unwrap()
            .into_inner()
            .lease
    }

    /// Uploads a bundle's files and completes the lease with them.
    pub(crate) async fn complete(
        &mut self,
        lease: &v1::Lease,
        worker: &str,
        files: &[(&str, &[u8])],
    ) -> Result<v1::BundleVersion, Cause> {
        let object = lease.spec.as_ref().unwrap().object.as_ref().unwrap();
        let object = format!("{}/{}", object.collection, object.object);
        for (_, bytes) in files {
            self.upload(&object, bytes).await;
        }
        let request = v1::CompleteRequest {
            job: Some(attempt(lease, worker)),
            files: manifest(Kind::Bundle, files)
                .files()
                .iter()
                .map(Into::into)
                .collect(),
            metrics_json: "{\"mse\":1.5}".to_owned(),
        };
        match self.workers.complete(request).await {
            Ok(response) => Ok(response.into_inner().bundle.unwrap()),
            Err(status) => Err(Cause::from_status(&status)),
        }
    }

    pub(crate) async fn get(&mut self, id: &str) -> v1::Job {
        self.jobs
            .get(v1::GetJobRequest {
                job_id: id.to_owned(),
            })
            .await
            .unwrap()
            .into_inner()
    }
}

fn token_id(secret: &str) -> &str {
    secret.split('_').nth(1).unwrap()
}

async fn launch(config: &Config) -> (Running, oneshot::Sender<()>) {
    let (stop, stopped) = oneshot::channel();
    let shutdown = async move {
        // A fixture that is dropped stops it too.
        stopped.await.ok();
    };
    (serve(config.clone(), shutdown).await.unwrap(), stop)
}

/// Clients of every service, with one token.
pub(crate) struct Clients {
    pub(crate) jobs: JobsClient<Authorized>,
    pub(crate) workers: WorkersClient<Authorized>,
    pub(crate) bundles: BundlesClient<Authorized>,
    pub(crate) collections: CollectionsClient<Authorized>,
    pub(crate) tokens: TokensClient<Authorized>,
    pub(crate) admin: AdminClient<Authorized>,
}

impl Clients {
    pub(crate) fn new(url: &str, token: &str) -> Self {
        let channel = Channel::from_shared(url.to_owned()).unwrap().connect_lazy();
        let bearer = Bearer(format!("Bearer {token}").parse().unwrap());
        let authorized = InterceptedService::new(channel, bearer);
        Self {
            jobs: JobsClient::new(authorized.clone()),
            workers: WorkersClient::new(authorized.clone()),
            bundles: BundlesClient::new(authorized.clone()),
            collections: CollectionsClient::new(authorized.clone()),
            tokens: TokensClient::new(authorized.clone()),
            admin: AdminClient::new(authorized),
        }
    }
}

pub(crate) fn manifest(kind: Kind, files: &[(&str, &[u8])]) -> Manifest {
    let files = files
        .iter()
        .map(|(path, bytes)| FileEntry {
            path: path.parse().unwrap(),
            digest: Digest::of(bytes),
            size_bytes: bytes.len() as u64,
            media_type: "application/octet-stream".to_owned(),
        })
        .collect();
    Manifest::new(kind, files, BTreeMap::new()).unwrap()
}

pub(crate) fn object_ref(object: &str) -> v1::ObjectRef {
    let (collection, object) = object.split_once('/').unwrap();
    v1::ObjectRef {
        collection: collection.to_owned(),
        object: object.to_owned(),
    }
}

pub(crate) fn submit_request(
    object: &str,
    request_id: &str,
    capture: &Digest,
) -> v1::SubmitRequest {
    v1::SubmitRequest {
        request_id: request_id.to_owned(),
        spec: Some(v1::JobSpec {
            object: Some(object_ref(object)),
            capture_digest: capture.to_string(),
            recipe_json: "{\"preset\":\"standard\"}".to_owned(),
            ..v1::JobSpec::default()
        }),
    }
}

pub(crate) fn attempt(lease: &v1::Lease, worker: &str) -> v1::JobAttempt {
    v1::JobAttempt {
        job_id: lease.job_id.clone(),
        attempt: lease.attempt,
        worker_id: worker.to_owned(),
    }
}

pub(crate) fn pattern(bytes: usize) -> Vec<u8> {
    (0..bytes).map(|i| (i * 31 + i / 7919) as u8).collect()
}
