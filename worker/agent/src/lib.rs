//! Worker agent: lease, heartbeat, transfer, and supervision of one child process per job.
//!
//! Each slot of the agent asks the coordinator for one job at a time, puts the capture's files into a folder, lets a
//! child process bake them ([`ChildCommand`], job file and events of `ign-events`), and sends checkpoints and the bundle
//! to the store. Slots share nothing but the connection, the cache of files and the worker's name. It holds no torch state and streams every file, so its memory stays small; whatever happens to the child is
//! a failure that the agent reports.
//!
//! - `control`: gRPC calls, `data_plane`: HTTP calls, one try each. `transfer`: whole transfers that go on through
//!   outages. `cache`: what was fetched before.
//! - `child`: the process. `checkpoints`, `heartbeat`: what runs beside it. `job`: one attempt from lease to report.
//!
//! Invariant: every call about a job carries its attempt; when the coordinator says that the attempt is over, nothing
//! more is sent about it.

mod backoff;
mod cache;
mod checkpoints;
mod child;
mod control;
mod data_plane;
mod error;
mod files;
mod heartbeat;
mod job;
mod logs;
mod state;
mod transfer;

use std::fs::{File, TryLockError};
use std::num::NonZero;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use futures::future::BoxFuture;
use ign_proto::{Cause, WorkerId, v1};
use reqwest::Url;
use tokio_util::sync::CancellationToken;

pub use crate::child::ChildCommand;
pub use crate::error::AgentError;

use crate::backoff::Backoff;
use crate::cache::Cache;
use crate::control::Control;
use crate::data_plane::DataPlane;

/// How one agent works.
#[derive(Clone, Debug)]
pub struct AgentConfig {
    /// `https://host:port` of the coordinator, or `http://` within one machine.
    pub server: String,
    /// Bearer token; empty where a certificate says who this is.
    pub token: String,
    /// Certificates for TLS.
    pub certificates: ign_client::Files,
    /// Folder for cached captures and running jobs; belongs to this agent alone.
    pub work_dir: PathBuf,
    /// Name of this worker; made from host name and process id when absent.
    pub name: Option<String>,
    /// Jobs at once, each in a child of its own.
    pub slots: NonZero<usize>,
    /// CPU threads for each child.
    pub threads: usize,
    /// What the bakes run on, for people: `cpu`, `NVIDIA H200`.
    pub device: String,
    /// Version of this program.
    pub version: String,
    /// Bound of the cache of captures and checkpoints.
    pub cache_bytes: u64,
    /// What bakes one job.
    pub child: ChildCommand,
    /// After a shutdown request: time for a last checkpoint or a finished bundle to arrive.
    pub shutdown_grace: Duration,
    /// How long the coordinator may hold a call for work open.
    pub lease_wait: Duration,
}

impl AgentConfig {
    /// Usual settings: one job at a time on every core, 20 GB of cache, this program as child.
    ///
    /// # Errors
    /// The path of the running program is not known.
    pub fn new(server: &str, token: &str, work_dir: &Path) -> std::io::Result<Self> {
        Ok(Self {
            server: server.to_owned(),
            token: token.to_owned(),
            certificates: ign_client::Files::default(),
            work_dir: work_dir.to_path_buf(),
            name: None,
            slots: NonZero::<usize>::MIN,
            threads: threads_per_slot(NonZero::<usize>::MIN),
            device: "cpu".to_owned(),
            version: env!("CARGO_PKG_VERSION").to_owned(),
            cache_bytes: 20_000_000_000,
            child: ChildCommand::current_exe()?,
            shutdown_grace: Duration::from_secs(30),
            lease_wait: Duration::from_secs(20),
        })
    }
}

/// The cores of this machine, divided between `slots` jobs; at least one each.
pub fn threads_per_slot(slots: NonZero<usize>) -> usize {
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    (cores / slots).max(1)
}

/// What the slots of a running agent share.
#[derive(Debug)]
struct Agent {
    config: AgentConfig,
    worker: WorkerId,
    hostname: String,
    control: Control,
    data: DataPlane,
    cache: Cache,
    /// Held while a slot fetches into the cache: no other may then evict what has come, or write to the same file.
    fetching: tokio::sync::Mutex<()>,
    jobs_dir: PathBuf,
    /// Whether the coordinator answered the last call for work.
    reachable: AtomicBool,
    /// Held while the agent runs.
    _lock: File,
}

/// Works on jobs until `shutdown` is cancelled. A worker that is drained goes on asking, and gets nothing until the drain
/// is taken back: only the coordinator knows.
///
/// An unreachable coordinator is waited for, however long; only what a person must repair ends the agent.
///
/// # Errors
/// The configuration is not usable, or the coordinator refuses the token.
#[inline(never)]
pub fn run(
    config: AgentConfig,
    shutdown: CancellationToken,
) -> BoxFuture<'static, Result<(), AgentError>> {
    // Boxed, so that the agent is compiled here alone and not in every crate that runs one.
    Box::pin(work(config, shutdown))
}

async fn work(config: AgentConfig, shutdown: CancellationToken) -> Result<(), AgentError> {
    let agent = Agent::prepare(config)?;
    tracing::info!(
        worker = %agent.worker,
        server = %agent.config.server,
        slots = agent.config.slots,
        threads = agent.config.threads,
        device = agent.config.device,
        "worker ready"
    );
    // A slot that is refused ends the others.
    let shutdown = shutdown.child_token();
    let slots = (0..agent.config.slots.get()).map(|_| async {
        let ended = agent.work(&shutdown).await;
        shutdown.cancel();
        ended
    });
    let ended = futures::future::join_all(slots).await;
    tracing::info!("worker ends");
    ended.into_iter().collect()
}

impl Agent {
    /// One slot: works on one job after the other until `shutdown` is cancelled.
    async fn work(&self, shutdown: &CancellationToken) -> Result<(), AgentError> {
        let mut backoff = Backoff::default();
        loop {
            let answer = tokio::select! {
                biased;
                () = shutdown.cancelled() => return Ok(()),
                answer = self.control.lease(self.lease_request()) => answer,
            };
            let wait = match answer {
                Ok(lease) => {
                    if !self.reachable.swap(true, Ordering::Relaxed) {
                        tracing::info!("the coordinator is back");
                    }
                    backoff.reset();
                    let Some(lease) = lease else { continue };
                    Box::pin(job::run(self, lease, shutdown)).await;
                    continue;
                }
                Err(cause @ (Cause::Unauthenticated | Cause::Forbidden { .. })) => {
                    return Err(AgentError::Refused {
                        message: cause.to_string(),
                    });
                }
                Err(cause) => {
                    if self.reachable.swap(false, Ordering::Relaxed) {
                        tracing::warn!("no work from the coordinator: {cause}; trying again");
                    }
                    let asked = cause.retry_after().unwrap_or_default();
                    backoff.next_delay().max(asked)
                }
            };
            tokio::select! {
                () = shutdown.cancelled() => return Ok(()),
                () = tokio::time::sleep(wait) => {}
            }
        }
    }

    fn prepare(config: AgentConfig) -> Result<Self, AgentError> {
        let unusable = |reason: &str| AgentError::Server {
            url: config.server.clone(),
            reason: reason.to_owned(),
        };
        let server = Url::parse(&config.server).map_err(|error| unusable(&error.to_string()))?;
        if !matches!(server.scheme(), "http" | "https") {
            return Err(unusable("it must begin with https:// or http://"));
        }
        let tls = ign_client::Tls::load(&config.certificates)
            .map_err(|source| AgentError::Certificates { source })?;
        let hostname = rustix::system::uname()
            .nodename()
            .to_string_lossy()
            .into_owned();
        let name = config
            .name
            .clone()
            .unwrap_or_else(|| default_name(&hostname));
        let worker = name.parse().map_err(|source| AgentError::Name { source })?;

        let in_work_dir = |source| AgentError::WorkDir {
            path: config.work_dir.clone(),
            source,
        };
        // The child gets absolute paths whatever its own folder is.
        std::fs::create_dir_all(&config.work_dir).map_err(in_work_dir)?;
        let work_dir = config.work_dir.canonicalize().map_err(in_work_dir)?;
        let lock = File::create(work_dir.join("lock")).map_err(in_work_dir)?;
        match lock.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => {
                return Err(AgentError::WorkDirInUse { path: work_dir });
            }
            Err(TryLockError::Error(source)) => return Err(in_work_dir(source)),
        }
        let jobs_dir = work_dir.join("jobs");
        // What an agent that was killed left behind.
        match std::fs::remove_dir_all(&jobs_dir) {
            Err(source) if source.kind() != std::io::ErrorKind::NotFound => {
                return Err(in_work_dir(source));
            }
            _ => {}
        }
        std::fs::create_dir_all(&jobs_dir).map_err(in_work_dir)?;
        let cache =
            Cache::open(&work_dir.join("cache"), config.cache_bytes).map_err(in_work_dir)?;
        Ok(Self {
            control: Control::new(&server, &config.token, &tls)?,
            data: DataPlane::new(&server, &config.token, &tls)?,
            cache,
            fetching: tokio::sync::Mutex::default(),
            jobs_dir,
            reachable: AtomicBool::new(true),
            worker,
            hostname,
            _lock: lock,
            config,
        })
    }

    fn lease_request(&self) -> v1::LeaseRequest {
        v1::LeaseRequest {
            worker_id: self.worker.to_string(),
            hostname: self.hostname.clone(),
            version: self.config.version.clone(),
            device: self.config.device.clone(),
            wait_secs: self.config.lease_wait.as_secs_f64(),
        }
    }
}

/// Host name and process id: unique on this machine while it runs.
fn default_name(hostname: &str) -> String {
    let host: String = hostname
        .chars()
        .map(|c| if c.is_ascii_alphanumeric() { c } else { '-' })
        .take(100)
        .collect();
    let host = host.trim_start_matches('-');
    let host = if host.is_empty() { "worker" } else { host };
    format!("{host}-{}", std::process::id())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_agent_runs_on_any_executor() {
        fn needs_send(_future: impl Send) {}
        let config = AgentConfig::new("http://127.0.0.1:1", "token", Path::new("/x")).unwrap();
        needs_send(run(config, CancellationToken::new()));
    }

    #[test]
    fn default_names_are_names() {
        for host in ["", "--", "Museum_3.lan", "h\u{f6}st"] {
            let name = default_name(host);
            assert!(name.parse::<WorkerId>().is_ok(), "{name}");
        }
    }
}
