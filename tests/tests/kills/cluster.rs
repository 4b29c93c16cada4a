//! A coordinator, agents with a scripted child, Postgres and a folder as bucket: everything that can be killed, and
//! nothing that bakes.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use anyhow::Result;
use ign_e2e::{Api, Coordinator, Process, Setup, scripted_agent};
use ign_proto::Cause;
use ign_registry::{Registry, StoreConfig};
use ign_testkit::Postgres;
use tokio::runtime::Runtime;

const TOKEN: &str = "ign-kills-token-0123456789abcdef";
/// Longest that anything may take on a busy machine.
const LIMIT: Duration = Duration::from_mins(2);

pub(crate) struct Cluster {
    // Dropped in this order: clients before what they use.
    pub(crate) agents: BTreeMap<String, Process>,
    coordinator: Coordinator,
    pub(crate) postgres: Postgres,
    runtime: Runtime,
    api: Api,
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
        std::fs::write(dir.path().join("token"), TOKEN)?;
        let mut coordinator = Coordinator::start(Setup {
            name: "coordinator".to_owned(),
            dir: dir.path().to_owned(),
            database: postgres.create_database()?,
            store: format!("file://{}/store", dir.path().display()),
            token_file: dir.path().join("token"),
            args: vec!["--lease-secs".to_owned(), lease_secs.to_string()],
            env: BTreeMap::new(),
        })?;
        // One thread, that of the test: the processes die with the thread that started them.
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build()?;
        let api = {
            let _entered = runtime.enter();
            Api::new(&coordinator.url(), TOKEN)?
        };
        coordinator.await_ready()?;
        Ok(Self {
            agents: BTreeMap::new(),
            coordinator,
            postgres,
            runtime,
            api,
            dir,
        })
    }

    /// Kills the coordinator and starts another, armed with `fault`. It may die before it is ready.
    pub(crate) fn replace_coordinator(&mut self, fault: Option<&str>) -> Result<()> {
        self.coordinator.replace(fault)
    }

    /// Kills the agent of this name, if there is one, and starts another, armed with `fault`.
    pub(crate) fn replace_agent(&mut self, name: &str, fault: Option<&str>) -> Result<()> {
        if let Some(mut agent) = self.agents.remove(name) {
            agent.kill()?;
        }
        let url = self.coordinator.url();
        let agent = scripted_agent(self.dir.path(), &url, TOKEN, name, fault)?;
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
        mut call: impl AsyncFnMut(&Api) -> Result<T>,
    ) -> Result<T> {
        let begun = Instant::now();
        loop {
            let outcome = self.runtime.block_on(call(&self.api));
            match outcome {
                Ok(value) => return Ok(value),
                Err(error) if begun.elapsed() < LIMIT && passes(&error) => meanwhile(self)?,
                Err(error) => return Err(error.context(what.to_owned())),
            }
            std::thread::sleep(Duration::from_millis(20));
        }
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
