//! The service in its two forms: as many processes on Postgres and S3, and embedded in one `ignctl up`.

use std::fs;
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context as _, Result, ensure};
use ign_testkit::Postgres;
use tempfile::TempDir;

use crate::client::{Client, Job};
use crate::coordinator::{Coordinator, Setup};
use crate::process::{Process, descendants, kill_now, path, program, wait_until};
use crate::s3::S3;

/// Time for a process to start listening, also on a loaded machine.
const START_LIMIT: Duration = Duration::from_mins(1);
/// Short, so that a killed worker's job goes on soon; heartbeats come three times as often.
const LEASE_SECS: u32 = 9;
const ACCESS_KEY: &str = "ign-e2e-access";
const SECRET_KEY: &str = "ign-e2e-secret-0123456789";
const TOKEN: &str = "ign-e2e-token-0123456789abcdef0123456789abcdef";

/// Coordinator, workers, Postgres and S3 as processes.
#[derive(Debug)]
pub struct Stack {
    // Dropped in this order: clients before what they use.
    workers: Vec<Process>,
    coordinator: Coordinator,
    _s3: S3,
    postgres: Postgres,
    /// Everything on disk.
    pub dir: TempDir,
}

impl Stack {
    /// Starts all of it with `workers` workers of one thread each, named `worker-1`, `worker-2`, ...
    pub fn start(workers: usize) -> Result<Self> {
        let dir = tempfile::Builder::new().prefix("ign-e2e-").tempdir()?;
        let postgres = Postgres::start()?;
        let database = postgres.create_database()?;
        let s3 = S3::start(dir.path(), ACCESS_KEY, SECRET_KEY)?;
        fs::write(dir.path().join("token"), TOKEN)?;
        let mut coordinator = Coordinator::start(Setup {
            name: "coordinator".to_owned(),
            dir: dir.path().to_owned(),
            database,
            store: s3.url(),
            token_file: dir.path().join("token"),
            args: vec!["--lease-secs".to_owned(), LEASE_SECS.to_string()],
            env: s3.env().clone(),
        })?;
        coordinator.await_ready()?;
        let mut stack = Self {
            workers: Vec::new(),
            coordinator,
            _s3: s3,
            postgres,
            dir,
        };
        for number in 1..=workers {
            let name = format!("worker-{number}");
            let worker = stack.start_worker(&name)?;
            stack.workers.push(worker);
        }
        Ok(stack)
    }

    /// `ignctl` for this service.
    pub fn client(&self) -> Result<Client> {
        Ok(Client::of_server(
            &self.url(),
            path(&self.dir.path().join("token"))?,
        ))
    }

    /// `http://127.0.0.1:PORT`.
    pub fn url(&self) -> String {
        self.coordinator.url()
    }

    /// The Postgres cluster.
    pub fn postgres(&self) -> &Postgres {
        &self.postgres
    }

    /// Kills the worker that has `job`, and what it runs, with SIGKILL; its name.
    pub fn kill_worker_of(&mut self, job: &Job) -> Result<String> {
        let worker = self
            .workers
            .iter_mut()
            .find(|worker| job.worker() == worker.name())
            .with_context(|| format!("no worker is called {:?}", job.worker()))?;
        worker.kill()?;
        Ok(worker.name().to_owned())
    }

    /// Kills the coordinator with SIGKILL.
    pub fn kill_coordinator(&mut self) -> Result<()> {
        self.coordinator.kill()
    }

    /// Starts the coordinator again, on the same address.
    pub fn restart_coordinator(&mut self) -> Result<()> {
        self.coordinator.replace(None)?;
        self.coordinator.await_ready()
    }

    /// Names of the workers that run.
    pub fn running_workers(&mut self) -> Vec<String> {
        self.workers
            .iter_mut()
            .filter_map(|w| w.is_running().then(|| w.name().to_owned()))
            .collect()
    }

    fn start_worker(&self, name: &str) -> Result<Process> {
        Process::start(
            name,
            &program("ign-worker")?,
            [
                "agent",
                "--server",
                &self.url(),
                "--token-file",
                path(&self.dir.path().join("token"))?,
                "--work-dir",
                path(&self.dir.path().join(name))?,
                "--name",
                name,
                "--threads",
                "1",
                "--exit-when-stdin-closes",
            ],
            [],
            &self.dir.path().join(format!("{name}.log")),
        )
    }
}

/// `ignctl up` on a data folder that survives it.
#[derive(Debug)]
pub struct Embedded {
    service: Process,
    data: PathBuf,
    workers: usize,
}

impl Embedded {
    /// Starts the service on `data` with `workers` workers of one thread each.
    pub fn start(data: &Path, workers: usize) -> Result<Self> {
        let service = start_embedded(data, workers)?;
        let mut embedded = Self {
            service,
            data: data.to_owned(),
            workers,
        };
        embedded.await_service()?;
        Ok(embedded)
    }

    /// `ignctl` for this service.
    pub fn client(&self) -> Result<Client> {
        Ok(Client::of_data(path(&self.data)?))
    }

    /// SIGKILL to the service and to every process that it started, all at once.
    pub fn kill_everything(&mut self) -> Result<usize> {
        let children = descendants(self.service.pid())?;
        self.service.kill()?;
        for &pid in &children {
            kill_now(pid)?;
        }
        Ok(children.len())
    }

    /// Starts it again on what is left.
    pub fn restart(&mut self) -> Result<()> {
        self.service = start_embedded(&self.data, self.workers)?;
        self.await_service()
    }

    fn await_service(&mut self) -> Result<()> {
        let client = self.client()?;
        wait_until("the embedded service", START_LIMIT, || {
            ensure!(
                self.service.is_running(),
                "ignctl up ended:\n{}",
                self.service.output()
            );
            Ok(client.run(&["status"])?.status.success().then_some(()))
        })
    }
}

fn start_embedded(data: &Path, workers: usize) -> Result<Process> {
    Process::start(
        "ignctl up",
        &program("ignctl")?,
        [
            "--data",
            path(data)?,
            "up",
            "--workers",
            &workers.to_string(),
            "--threads",
            "1",
        ],
        [(
            "IGN_WORKER".to_owned(),
            path(&program("ign-worker")?)?.to_owned(),
        )],
        &data.with_extension("log"),
    )
}
