//! The service in its two forms: as many processes on Postgres and S3, and embedded in one `ignctl up`.

use std::collections::BTreeMap;
use std::fs;
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context as _, Result, ensure};
use ign_testkit::Postgres;
use tempfile::TempDir;

use crate::client::{Client, Job};
use crate::process::{Process, descendants, kill_now, program, wait_until};

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
    coordinator: Process,
    _s3: Process,
    postgres: Postgres,
    database: String,
    env: BTreeMap<String, String>,
    listen: String,
    /// Everything on disk.
    pub dir: TempDir,
}

impl Stack {
    /// Starts all of it with `workers` workers of one thread each, named `worker-1`, `worker-2`, ...
    pub fn start(workers: usize) -> Result<Self> {
        let dir = tempfile::Builder::new().prefix("ign-e2e-").tempdir()?;
        let postgres = Postgres::start()?;
        let database = postgres.create_database()?;
        let bucket = "bundles";
        let s3 = Process::start(
            "S3 endpoint",
            &program("s3-endpoint")?,
            [
                "--root",
                path(&dir.path().join("s3"))?,
                "--bucket",
                bucket,
                "--access-key",
                ACCESS_KEY,
                "--secret-key",
                SECRET_KEY,
                "--exit-when-stdin-closes",
            ],
            [],
            &dir.path().join("s3.log"),
        )?;
        let endpoint = wait_until("the S3 endpoint's address", START_LIMIT, || {
            Ok(s3
                .output()
                .lines()
                .find(|line| line.starts_with("http://"))
                .map(str::to_owned))
        })?;
        let env = BTreeMap::from(
            [
                ("AWS_ENDPOINT", endpoint.as_str()),
                ("AWS_ACCESS_KEY_ID", ACCESS_KEY),
                ("AWS_SECRET_ACCESS_KEY", SECRET_KEY),
                ("AWS_REGION", "us-east-1"),
                ("AWS_ALLOW_HTTP", "true"),
                ("AWS_VIRTUAL_HOSTED_STYLE_REQUEST", "false"),
            ]
            .map(|(name, value)| (name.to_owned(), value.to_owned())),
        );
        fs::write(dir.path().join("token"), TOKEN)?;
        // The same port again after a restart, as behind a service name.
        let listen = TcpListener::bind("127.0.0.1:0")?.local_addr()?.to_string();
        let coordinator = start_coordinator(&dir, &listen, &database, &env)?;
        let mut stack = Self {
            workers: Vec::new(),
            coordinator,
            _s3: s3,
            postgres,
            database,
            env,
            listen,
            dir,
        };
        stack.await_service()?;
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
        format!("http://{}", self.listen)
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
        self.coordinator = start_coordinator(&self.dir, &self.listen, &self.database, &self.env)?;
        self.await_service()
    }

    /// Names of the workers that run.
    pub fn running_workers(&mut self) -> Vec<String> {
        self.workers
            .iter_mut()
            .filter_map(|w| w.is_running().then(|| w.name().to_owned()))
            .collect()
    }

    fn await_service(&mut self) -> Result<()> {
        let client = self.client()?;
        wait_until("the coordinator", START_LIMIT, || {
            ensure!(
                self.coordinator.is_running(),
                "the coordinator ended:\n{}",
                self.coordinator.output()
            );
            Ok(client.run(&["status"])?.status.success().then_some(()))
        })
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

fn start_coordinator(
    dir: &TempDir,
    listen: &str,
    database: &str,
    env: &BTreeMap<String, String>,
) -> Result<Process> {
    Process::start(
        "coordinator",
        &program("ign-coordinator")?,
        [
            "--listen",
            listen,
            "--database",
            database,
            "--store",
            "s3://bundles/e2e",
            "--token-file",
            path(&dir.path().join("token"))?,
            "--lease-secs",
            &LEASE_SECS.to_string(),
        ],
        env.clone(),
        &dir.path().join("coordinator.log"),
    )
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

fn path(path: &Path) -> Result<&str> {
    path.to_str().context("the path is no UTF-8")
}
