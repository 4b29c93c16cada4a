//! A coordinator as a process, and those who speak with it.

use std::fs;
use std::net::TcpListener;
use std::path::Path;
use std::time::Duration;

use anyhow::{Context as _, Result};
use ign_e2e::{Process, program, wait_until};
use ign_proto::manifest::{FileEntry, Kind, Manifest};
use ign_proto::v1::jobs_client::JobsClient;
use ign_proto::v1::workers_client::WorkersClient;
use ign_proto::{Digest, MAX_MESSAGE_BYTES};
use tempfile::TempDir;
use tonic::metadata::{Ascii, MetadataValue};
use tonic::service::Interceptor;
use tonic::service::interceptor::InterceptedService;
use tonic::transport::Channel;
use tonic::{Request, Status};

/// The root token.
pub(crate) const TOKEN: &str = "ign-bench-token-0123456789abcdef";
/// A third of the default: workers report three times as often, and a lease that is lost shows three times as soon.
pub(crate) const LEASE: Duration = Duration::from_secs(15);
/// Unit of times in `/proc`, on every Linux that runs this.
const TICKS_PER_SEC: f64 = 100.0;

/// Adds the token to each call.
#[derive(Clone, Debug)]
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
/// One worker's connection.
pub(crate) type Worker = WorkersClient<Authorized>;

/// A running coordinator whose store and token lie in a folder of its own.
#[derive(Debug)]
pub(crate) struct Service {
    coordinator: Process,
    url: String,
    dir: TempDir,
}

impl Service {
    /// On this database, with bundles on the local disk.
    pub(crate) async fn start(database: &str) -> Result<Self> {
        Self::start_in(&std::env::temp_dir(), database).await
    }

    /// On this database, with bundles in memory: what is left is the queue.
    pub(crate) async fn start_in_memory(database: &str) -> Result<Self> {
        Self::start_in(Path::new("/dev/shm"), database).await
    }

    async fn start_in(parent: &Path, database: &str) -> Result<Self> {
        let dir = tempfile::Builder::new()
            .prefix("ign-bench-")
            .tempdir_in(parent)?;
        let store = format!("file://{}/store", dir.path().display());
        Self::launch(dir, database, &store, []).await
    }

    /// On this database and store; `env` is how to reach the store.
    pub(crate) async fn launch(
        dir: TempDir,
        database: &str,
        store: &str,
        env: impl IntoIterator<Item = (String, String)>,
    ) -> Result<Self> {
        fs::write(dir.path().join("token"), TOKEN)?;
        let listen = TcpListener::bind("127.0.0.1:0")?.local_addr()?.to_string();
        let token = text(&dir.path().join("token"))?.to_owned();
        let coordinator = Process::start(
            "coordinator",
            &program("ign-coordinator")?,
            [
                "--listen",
                &listen,
                "--database",
                database,
                "--store",
                store,
                "--token-file",
                &token,
                "--lease-secs",
                &LEASE.as_secs().to_string(),
            ],
            env,
            &dir.path().join("coordinator.log"),
        )?;
        let service = Self {
            coordinator,
            url: format!("http://{listen}"),
            dir,
        };
        let http = reqwest::Client::new();
        let ready = format!("{}/readyz", service.url);
        for _ in 0..600 {
            if http
                .get(&ready)
                .send()
                .await
                .is_ok_and(|it| it.status().is_success())
            {
                return Ok(service);
            }
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
        anyhow::bail!(
            "the coordinator did not start: {}",
            service.coordinator.output()
        )
    }

    pub(crate) fn url(&self) -> &str {
        &self.url
    }

    pub(crate) fn folder(&self) -> &Path {
        self.dir.path()
    }

    fn authorized(&self) -> Result<Authorized> {
        let channel = Channel::from_shared(self.url.clone())?.connect_lazy();
        let bearer = Bearer(format!("Bearer {TOKEN}").parse()?);
        Ok(InterceptedService::new(channel, bearer))
    }

    /// A connection of its own for what users ask.
    pub(crate) fn jobs(&self) -> Result<JobsClient<Authorized>> {
        Ok(JobsClient::new(self.authorized()?).max_decoding_message_size(MAX_MESSAGE_BYTES))
    }

    /// A connection of its own for one worker.
    pub(crate) fn worker(&self) -> Result<Worker> {
        Ok(WorkersClient::new(self.authorized()?))
    }

    /// Uploads one small file; a file of a bundle or capture.
    pub(crate) async fn upload(&self, object: &str, bytes: &'static [u8]) -> Result<FileEntry> {
        let digest = Digest::of(bytes);
        reqwest::Client::new()
            .post(format!(
                "{}/v2/{object}/blobs/uploads/?digest={digest}",
                self.url
            ))
            .bearer_auth(TOKEN)
            .body(bytes)
            .send()
            .await?
            .error_for_status()?;
        Ok(FileEntry {
            path: "capture.toml".parse()?,
            digest,
            size_bytes: bytes.len() as u64,
            media_type: "application/toml".to_owned(),
        })
    }

    /// Uploads a capture of one file; the digest of its manifest.
    pub(crate) async fn capture(&self, object: &str) -> Result<Digest> {
        let file = self.upload(object, b"title = \"a vase\"\n").await?;
        let manifest = Manifest::new(Kind::Capture, vec![file], [].into())?.encode()?;
        let digest = Digest::of(&manifest);
        reqwest::Client::new()
            .put(format!("{}/v2/{object}/manifests/{digest}", self.url))
            .bearer_auth(TOKEN)
            .header("content-type", ign_proto::manifest::MEDIA_TYPE)
            .body(manifest)
            .send()
            .await?
            .error_for_status()?;
        Ok(digest)
    }

    /// A metric of the coordinator.
    pub(crate) async fn metric(&self, name: &str) -> Result<f64> {
        let text = reqwest::Client::new()
            .get(format!("{}/metrics", self.url))
            .bearer_auth(TOKEN)
            .send()
            .await?
            .error_for_status()?
            .text()
            .await?;
        text.lines()
            .find_map(|line| line.strip_prefix(name)?.trim().parse().ok())
            .with_context(|| format!("there is no metric {name}"))
    }

    /// Resident memory in bytes: now, and at most so far.
    pub(crate) fn memory(&self) -> Result<(f64, f64)> {
        let status = fs::read_to_string(format!("/proc/{}/status", self.coordinator.pid()))?;
        let bytes = |name: &str| {
            status
                .lines()
                .find_map(|line| line.strip_prefix(name)?.trim().strip_suffix(" kB"))
                .and_then(|kib| kib.trim().parse::<f64>().ok())
                .map(|kib| kib * 1024.0)
                .with_context(|| format!("no {name} in {status}"))
        };
        Ok((bytes("VmRSS:")?, bytes("VmHWM:")?))
    }

    /// Processor time that the coordinator has used.
    pub(crate) fn cpu(&self) -> Result<Duration> {
        let stat = fs::read_to_string(format!("/proc/{}/stat", self.coordinator.pid()))?;
        // The name in parentheses may hold anything; the times are the 14th and 15th field.
        let ticks: u64 = stat
            .rsplit_once(')')
            .context("malformed /proc/PID/stat")?
            .1
            .split_whitespace()
            .skip(11)
            .take(2)
            .map(|field| field.parse::<u64>().unwrap_or(0))
            .sum();
        Ok(Duration::from_secs_f64(ticks as f64 / TICKS_PER_SEC))
    }
}

pub(crate) fn text(path: &Path) -> Result<&str> {
    path.to_str().context("the path is no UTF-8")
}

/// Waits for a line that begins so in a process's output.
pub(crate) fn await_line(process: &Process, start: &str) -> Result<String> {
    wait_until(start, Duration::from_mins(1), || {
        Ok(process
            .output()
            .lines()
            .find(|line| line.starts_with(start))
            .map(str::to_owned))
    })
}
