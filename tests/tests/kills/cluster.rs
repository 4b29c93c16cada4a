//! A coordinator, agents with a scripted child, Postgres and a folder as bucket: everything that can be killed, and
//! nothing that bakes.

use std::collections::BTreeMap;
use std::net::TcpListener;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, bail, ensure};
use ign_e2e::{Process, program};
use ign_proto::v1::bundles_client::BundlesClient;
use ign_proto::v1::jobs_client::JobsClient;
use ign_proto::{Cause, Digest, FileEntry, Kind, Manifest, v1};
use ign_registry::{Registry, StoreConfig};
use ign_testkit::Postgres;
use tokio::runtime::Runtime;
use tonic::transport::{Channel, Endpoint};

pub(crate) const TOKEN: &str = "ign-kills-token-0123456789abcdef";
/// Longest that anything may take on a busy machine.
const LIMIT: Duration = Duration::from_mins(2);

pub(crate) struct Cluster {
    // Dropped in this order: clients before what they use.
    pub(crate) agents: BTreeMap<String, Process>,
    coordinator: Process,
    pub(crate) postgres: Postgres,
    database: String,
    listen: String,
    lease_secs: f64,
    runtime: Runtime,
    channel: Channel,
    http: reqwest::Client,
    dir: tempfile::TempDir,
}

impl Cluster {
    pub(crate) fn start(lease_secs: f64) -> Result<Self> {
        // In memory where there is a place for that: nothing here outlives a power cut.
        let memory = std::path::Path::new("/dev/shm");
        let dir = if memory.is_dir() {
            tempfile::tempdir_in(memory)?
        } else {
            tempfile::tempdir()?
        };
        let postgres = Postgres::start()?;
        let database = postgres.create_database()?;
        std::fs::write(dir.path().join("token"), TOKEN)?;
        // The same port again after a restart, as behind a service name.
        let listen = TcpListener::bind("127.0.0.1:0")?.local_addr()?.to_string();
        // One thread, that of the test: the processes die with the thread that started them.
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build()?;
        let channel = {
            let _entered = runtime.enter();
            Endpoint::from_shared(format!("http://{listen}"))?
                .timeout(Duration::from_secs(30))
                .connect_lazy()
        };
        let mut cluster = Self {
            agents: BTreeMap::new(),
            coordinator: coordinator(&dir, &listen, &database, lease_secs, None)?,
            postgres,
            database,
            listen,
            lease_secs,
            runtime,
            channel,
            http: reqwest::Client::builder()
                .timeout(Duration::from_secs(30))
                .build()?,
            dir,
        };
        cluster.await_coordinator()?;
        Ok(cluster)
    }

    fn await_coordinator(&mut self) -> Result<()> {
        let url = format!("http://{}/readyz", self.listen);
        let begun = Instant::now();
        loop {
            // Within the runtime: the client's time limit begins with the call.
            let ready = self
                .runtime
                .block_on(async { self.http.get(&url).send().await });
            if ready.is_ok_and(|ready| ready.status().is_success()) {
                return Ok(());
            }
            ensure!(self.coordinator.is_running(), "the coordinator ended");
            ensure!(begun.elapsed() < LIMIT, "the coordinator is not ready");
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    /// Kills the coordinator and starts another, armed with `fault`. It may die before it is ready.
    pub(crate) fn replace_coordinator(&mut self, fault: Option<&str>) -> Result<()> {
        self.coordinator.kill()?;
        self.coordinator = coordinator(
            &self.dir,
            &self.listen,
            &self.database,
            self.lease_secs,
            fault,
        )?;
        Ok(())
    }

    /// Kills the agent of this name, if there is one, and starts another, armed with `fault`.
    pub(crate) fn replace_agent(&mut self, name: &str, fault: Option<&str>) -> Result<()> {
        if let Some(mut agent) = self.agents.remove(name) {
            agent.kill()?;
        }
        let work = self.dir.path().join(name);
        let url = format!("http://{}", self.listen);
        let mut env = vec![("IGN_TEST_TOKEN".to_owned(), TOKEN.to_owned())];
        env.extend(fault.map(|fault| ("IGN_FAULT".to_owned(), fault.to_owned())));
        std::fs::create_dir_all(&work)?;
        let agent = Process::start(
            name,
            &program("ign-agent-test-child")?,
            ["agent", &url, path(&work)?, name],
            env,
            &self.dir.path().join(format!("{name}.log")),
        )?;
        self.agents.insert(name.to_owned(), agent);
        Ok(())
    }

    pub(crate) fn coordinator_runs(&mut self) -> bool {
        self.coordinator.is_running()
    }

    pub(crate) fn agent_runs(&mut self, name: &str) -> bool {
        self.agents.get_mut(name).is_some_and(Process::is_running)
    }

    /// Repeats a call until it succeeds, as every client does; `meanwhile` brings back what died.
    pub(crate) fn insist<T>(
        &mut self,
        what: &str,
        mut meanwhile: impl FnMut(&mut Self) -> Result<()>,
        mut call: impl AsyncFnMut(&Self) -> Result<T>,
    ) -> Result<T> {
        let begun = Instant::now();
        loop {
            let outcome = self.runtime.block_on(call(self));
            match outcome {
                Ok(value) => return Ok(value),
                Err(error) if begun.elapsed() < LIMIT && passes(&error) => meanwhile(self)?,
                Err(error) => return Err(error.context(what.to_owned())),
            }
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    pub(crate) fn jobs(&self) -> JobsClient<Channel> {
        JobsClient::new(self.channel.clone())
    }

    pub(crate) fn bundles(&self) -> BundlesClient<Channel> {
        BundlesClient::new(self.channel.clone())
    }

    /// Uploads a file through a session, as a large one.
    pub(crate) async fn upload(&self, object: &str, bytes: &[u8]) -> Result<Digest> {
        let digest = Digest::of(bytes);
        let url = format!("http://{}/v2/{object}/blobs/uploads/", self.listen);
        let begun = self
            .http
            .post(url)
            .bearer_auth(TOKEN)
            .send()
            .await?
            .error_for_status()?;
        let place = begun.headers().get("location").context("no location")?;
        let url = format!("http://{}{}?digest={digest}", self.listen, place.to_str()?);
        self.http
            .put(url)
            .bearer_auth(TOKEN)
            .body(bytes.to_vec())
            .send()
            .await?
            .error_for_status()?;
        Ok(digest)
    }

    /// Uploads a capture of one file and submits it.
    pub(crate) async fn submit(
        &self,
        object: &str,
        request_id: &str,
        script: &serde_json::Value,
    ) -> Result<v1::Job> {
        let bytes = format!("mesh of {object}").into_bytes();
        let file = FileEntry {
            path: "mesh.ply".parse()?,
            digest: self.upload(object, &bytes).await?,
            size_bytes: bytes.len() as u64,
            media_type: "application/octet-stream".to_owned(),
        };
        let manifest = Manifest::new(Kind::Capture, vec![file], BTreeMap::new())?.encode()?;
        let digest = Digest::of(&manifest);
        let url = format!("http://{}/v2/{object}/manifests/{digest}", self.listen);
        self.http
            .put(url)
            .bearer_auth(TOKEN)
            .body(manifest)
            .send()
            .await?
            .error_for_status()?;
        let (collection, name) = object.split_once('/').context("no object")?;
        let spec = v1::JobSpec {
            object: Some(v1::ObjectRef {
                collection: collection.to_owned(),
                object: name.to_owned(),
            }),
            capture_digest: digest.to_string(),
            recipe_json: serde_json::json!({ "script": script }).to_string(),
            max_attempts: 100,
            ..v1::JobSpec::default()
        };
        let request = v1::SubmitRequest {
            request_id: request_id.to_owned(),
            spec: Some(spec),
        };
        Ok(self.jobs().submit(with_token(request)?).await?.into_inner())
    }

    pub(crate) async fn get(&self, id: &str) -> Result<v1::Job> {
        let request = v1::GetJobRequest {
            job_id: id.to_owned(),
        };
        Ok(self.jobs().get(with_token(request)?).await?.into_inner())
    }

    pub(crate) async fn versions(&self) -> Result<Vec<v1::BundleVersion>> {
        let request = v1::ListBundlesRequest {
            include_retired: true,
            ..v1::ListBundlesRequest::default()
        };
        let list = self.bundles().list(with_token(request)?).await?;
        Ok(list.into_inner().bundles)
    }

    /// What the bucket alone says is published.
    pub(crate) fn bucket(&self) -> Result<ign_registry::Rebuild> {
        let store = StoreConfig::new(format!("file://{}", self.store().display()));
        Ok(self
            .runtime
            .block_on(async { Registry::connect(&store)?.rebuild().await })?)
    }

    pub(crate) fn store(&self) -> PathBuf {
        self.dir.path().join("store")
    }

    pub(crate) fn log_of(&self, agent: &str) -> String {
        self.agents[agent].output()
    }
}

pub(crate) fn with_token<T>(message: T) -> Result<tonic::Request<T>> {
    let mut request = tonic::Request::new(message);
    let bearer = format!("Bearer {TOKEN}").parse()?;
    request.metadata_mut().insert("authorization", bearer);
    Ok(request)
}

/// Whether the same call may succeed later: the connection broke, or something behind the coordinator is away.
fn passes(error: &anyhow::Error) -> bool {
    if let Some(status) = error.downcast_ref::<tonic::Status>() {
        return Cause::from_status(status).retryable();
    }
    match error.downcast_ref::<reqwest::Error>() {
        // An upload whose blob arrived although the answer did not begins again.
        Some(error) => error.status().is_none_or(|status| {
            status.is_server_error() || status == reqwest::StatusCode::NOT_FOUND
        }),
        None => false,
    }
}

fn coordinator(
    dir: &tempfile::TempDir,
    listen: &str,
    database: &str,
    lease_secs: f64,
    fault: Option<&str>,
) -> Result<Process> {
    let store = format!("file://{}/store", dir.path().display());
    Process::start(
        "coordinator",
        &program("ign-coordinator")?,
        [
            "--listen",
            listen,
            "--database",
            database,
            "--store",
            &store,
            "--token-file",
            path(&dir.path().join("token"))?,
            "--lease-secs",
            &lease_secs.to_string(),
        ],
        fault.map(|fault| ("IGN_FAULT".to_owned(), fault.to_owned())),
        &dir.path().join("coordinator.log"),
    )
}

fn path(path: &std::path::Path) -> Result<&str> {
    match path.to_str() {
        Some(text) => Ok(text),
        None => bail!("{} is no UTF-8", path.display()),
    }
}
