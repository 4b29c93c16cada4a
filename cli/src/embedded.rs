//! The service on one machine: a coordinator in this process on `SQLite` and local files, and workers as children.
//!
//! Invariant: one service per data folder. The folder's `lock` is held from before the database is opened until after
//! the last worker ended; the system releases it should this process die.

use std::fs::{File, TryLockError};
use std::io::Write as _;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::time::Duration;

use ign_coordinator::{Care, Running};
use ign_registry::StoreConfig;
use ign_trace::Exporter;
use tokio::sync::{oneshot, watch};
use tokio::task::{JoinHandle, JoinSet};
use tracing_subscriber::layer::SubscriberExt as _;
use tracing_subscriber::util::SubscriberInitExt as _;
use tracing_subscriber::{EnvFilter, Layer as _};

use crate::connection::Target;
use crate::problem::{Doing as _, Problem, chain};
use crate::supervise::{self, WorkerCommand};

/// How to start the service.
#[derive(Clone, Debug)]
pub(crate) struct Options {
    pub(crate) data: PathBuf,
    pub(crate) workers: usize,
    /// Threads per worker; none to share the cores among the workers.
    pub(crate) threads: Option<usize>,
    pub(crate) listen: SocketAddr,
    /// Something in front speaks TLS: listening beyond this machine is fine.
    pub(crate) behind_tls_proxy: bool,
    /// What keeps the store sound.
    pub(crate) care: Care,
    /// Receivers of webhooks inside, `host:port`.
    pub(crate) webhook_internal: Vec<String>,
    /// Whether this is a bake's own service: workers that keep dying end it, and the coordinator logs to a file.
    pub(crate) own: bool,
}

/// A service that runs in this process.
pub(crate) struct Embedded {
    pub(crate) target: Target,
    pub(crate) threads: usize,
    pub(crate) logs: PathBuf,
    stop_workers: watch::Sender<bool>,
    workers: JoinSet<Result<(), Problem>>,
    stop_coordinator: Option<oneshot::Sender<()>>,
    coordinator: JoinHandle<Result<(), Problem>>,
    /// Sends the last spans when all has ended.
    _exporter: Option<Exporter>,
    _lock: File,
}

impl Embedded {
    /// Starts coordinator and workers; returns when the coordinator listens.
    pub(crate) async fn start(options: &Options) -> Result<Self, Problem> {
        let data = std::path::absolute(&options.data)
            .doing("cannot use the data folder", options.data.display())?;
        let logs = data.join("logs");
        std::fs::create_dir_all(&logs).doing("cannot create the data folder", data.display())?;
        let lock = take_lock(&data)?;
        let exporter = log(options.own.then(|| logs.join("coordinator.log")).as_deref())?;
        let program = match options.workers {
            0 => PathBuf::new(),
            _ => supervise::find_worker()?,
        };
        let token_file = data.join("token");
        ensure_token(&token_file)?;
        remove_if_there(&data.join("endpoint.json"))?;

        let (stop_coordinator, stopped) = oneshot::channel();
        let running = start_coordinator(&data, &token_file, options, stopped).await?;
        let url = running.url();
        let coordinator = tokio::spawn(async move {
            let ended = running.wait().await;
            ended.map_err(|error| Problem::failed(chain(&error)))
        });
        let target = Target::new(&url, Some(&token_file), &ign_client::Files::default())?;

        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        let threads = options
            .threads
            .unwrap_or((cores / options.workers.max(1)).max(1));
        let (stop_workers, stopped) = watch::channel(false);
        let mut workers = JoinSet::new();
        for index in 1..=options.workers {
            let name = format!("local-{index}");
            let work_dir = data.join("work").join(&name);
            std::fs::create_dir_all(&work_dir).doing("cannot create", work_dir.display())?;
            let args = [
                "agent",
                "--server",
                &url,
                "--token-file",
                &token_file.display().to_string(),
                "--work-dir",
                &work_dir.display().to_string(),
                "--name",
                &name,
                "--threads",
                &threads.to_string(),
                "--exit-when-stdin-closes",
            ]
            .map(str::to_string)
            .to_vec();
            let command = WorkerCommand {
                program: program.clone(),
                args,
                log: logs.join(format!("{name}.log")),
                name,
                give_up_after: options.own.then_some(supervise::HOPELESS_AFTER),
            };
            workers.spawn(supervise::keep_running(command, stopped.clone()));
        }
        Ok(Self {
            target,
            threads,
            logs,
            stop_workers,
            workers,
            stop_coordinator: Some(stop_coordinator),
            coordinator,
            _exporter: exporter,
            _lock: lock,
        })
    }

    /// Waits for what should not happen: the coordinator ends, or no worker can be kept running.
    pub(crate) async fn broken(&mut self) -> Problem {
        loop {
            tokio::select! {
                ended = &mut self.coordinator => return ended_early(ended),
                Some(ended) = self.workers.join_next() => {
                    match ended {
                        Ok(Ok(())) => {}
                        Ok(Err(problem)) => return problem,
                        Err(error) => return Problem::failed(format!("a worker's supervisor stopped: {error}")),
                    }
                }
            }
        }
    }

    /// Ends workers first, so that they can still say goodbye, then the coordinator.
    pub(crate) async fn stop(mut self) -> Result<(), Problem> {
        self.stop_workers.send_replace(true);
        let mut outcome = Ok(());
        while let Some(ended) = self.workers.join_next().await {
            if let Ok(Err(problem)) = ended {
                outcome = Err(problem);
            }
        }
        if let Some(stop) = self.stop_coordinator.take() {
            // An error here means that it has ended already.
            let _ended = stop.send(());
        }
        if !self.coordinator.is_finished() {
            match tokio::time::timeout(Duration::from_secs(10), &mut self.coordinator).await {
                Ok(Ok(ended)) => outcome = outcome.and(ended),
                Ok(Err(error)) => {
                    let stopped = Problem::failed(format!("the coordinator stopped: {error}"));
                    outcome = outcome.and(Err(stopped));
                }
                // Streams that clients keep open must not keep the service.
                Err(_) => self.coordinator.abort(),
            }
        }
        outcome
    }
}

fn ended_early(ended: Result<Result<(), Problem>, tokio::task::JoinError>) -> Problem {
    match ended {
        Ok(Ok(())) => Problem::failed("the coordinator ended by itself"),
        Ok(Err(problem)) => problem,
        Err(error) => Problem::failed(format!("the coordinator stopped: {error}")),
    }
}

/// Starts the coordinator on the data folder; returns when it listens.
async fn start_coordinator(
    data: &Path,
    token_file: &Path,
    options: &Options,
    stopped: oneshot::Receiver<()>,
) -> Result<Running, Problem> {
    let text = |path: &Path| {
        path.to_str()
            .map(str::to_string)
            .ok_or_else(|| Problem::usage("the data folder's path is not UTF-8").at(data.display()))
    };
    // The part of a database URL that is a path is percent-encoded; the store's is not.
    let database = text(&data.join("ign.db"))?
        .replace('%', "%25")
        .replace('?', "%3F");
    let config = ign_coordinator::Config {
        listen: options.listen,
        database: format!("sqlite://{database}"),
        store: StoreConfig::new(format!("file://{}", text(&data.join("store"))?)),
        token_file: token_file.to_path_buf(),
        endpoint_file: Some(data.join("endpoint.json")),
        settings: ign_queue::Settings::default(),
        redirect_blobs: false,
        tls: None,
        behind_tls_proxy: options.behind_tls_proxy,
        limits: ign_coordinator::Limits::default(),
        care: options.care.clone(),
        webhook_internal: options.webhook_internal.clone(),
    };
    let shutdown = async {
        // Asked to stop, or the service was dropped: both mean stop.
        let _either = stopped.await;
    };
    ign_coordinator::serve(config, shutdown)
        .await
        .map_err(|error| Problem::failed(chain(&error)).at(data.display()))
}

/// Sends the coordinator's log to a file, or to stderr; `IGN_LOG` sets the level. Its spans go where
/// `OTEL_EXPORTER_OTLP_ENDPOINT` says, until what is returned is dropped.
fn log(file: Option<&Path>) -> Result<Option<Exporter>, Problem> {
    let level = if file.is_some() { "info" } else { "warn" };
    let filter = EnvFilter::try_from_env("IGN_LOG").unwrap_or_else(|_unset| EnvFilter::new(level));
    let log = tracing_subscriber::fmt::layer().with_ansi(false);
    let log = match file {
        Some(path) => log
            .with_writer(Mutex::new(supervise::open_log(path)?))
            .boxed(),
        None => log.with_writer(std::io::stderr).boxed(),
    };
    let exporter =
        Exporter::from_env("ign-coordinator").map_err(|error| Problem::usage(chain(&error)))?;
    tracing_subscriber::registry()
        .with(log.with_filter(filter))
        .with(exporter.as_ref().map(Exporter::layer))
        .try_init()
        .map_err(|error| Problem::failed(format!("cannot begin the log: {error}")))?;
    Ok(exporter)
}

fn take_lock(data: &Path) -> Result<File, Problem> {
    let path = data.join("lock");
    let mut lock = File::options()
        .create(true)
        .truncate(false)
        .read(true)
        .write(true)
        .open(&path)
        .doing("cannot write to the data folder", path.display())?;
    match lock.try_lock() {
        Ok(()) => {}
        Err(TryLockError::WouldBlock) => {
            let holder = std::fs::read_to_string(&path).unwrap_or_default();
            return Err(Problem::failed(format!(
                "a service runs on this data folder already (process {})",
                holder.trim()
            ))
            .at(data.display())
            .hint("use it (`ignctl status`), end it, or give another --data"));
        }
        Err(TryLockError::Error(error)) => return Err(Problem::from(error).at(path.display())),
    }
    lock.set_len(0).doing("cannot write", path.display())?;
    writeln!(lock, "{}", std::process::id()).doing("cannot write", path.display())?;
    Ok(lock)
}

/// Whether another process runs a service on this data folder.
pub(crate) fn is_taken(data: &Path) -> bool {
    File::open(data.join("lock"))
        .is_ok_and(|lock| matches!(lock.try_lock_shared(), Err(TryLockError::WouldBlock)))
}

/// Creates a random token that only this user can read, unless there is one.
fn ensure_token(path: &Path) -> Result<(), Problem> {
    use std::os::unix::fs::OpenOptionsExt as _;
    if std::fs::read_to_string(path).is_ok_and(|token| !token.trim().is_empty()) {
        return Ok(());
    }
    let token = format!(
        "{}{}",
        uuid::Uuid::new_v4().simple(),
        uuid::Uuid::new_v4().simple()
    );
    // Written beside and renamed: a crash leaves no half a token.
    let partial = path.with_extension("partial");
    remove_if_there(&partial)?;
    let mut file = File::options()
        .create_new(true)
        .write(true)
        .mode(0o600)
        .open(&partial)
        .doing("cannot write the token", partial.display())?;
    writeln!(file, "{token}").doing("cannot write the token", partial.display())?;
    file.sync_all()
        .doing("cannot write the token", partial.display())?;
    std::fs::rename(&partial, path).doing("cannot write the token", path.display())
}

fn remove_if_there(path: &Path) -> Result<(), Problem> {
    match std::fs::remove_file(path) {
        Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
            Err(error).doing("cannot remove", path.display())
        }
        _ => Ok(()),
    }
}

/// Waits for Ctrl-C or a request to end.
pub(crate) async fn interrupted() -> Result<(), Problem> {
    use tokio::signal::unix::{SignalKind, signal};
    let listen = |kind| signal(kind).doing("cannot listen for signals", "this process");
    let (mut int, mut term) = (
        listen(SignalKind::interrupt())?,
        listen(SignalKind::terminate())?,
    );
    tokio::select! {
        _ = int.recv() => {}
        _ = term.recv() => {}
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::PermissionsExt as _;

    #[test]
    fn the_lock_is_taken_once() {
        let data = tempfile::tempdir().unwrap();
        let lock = take_lock(data.path()).unwrap();
        let refused = take_lock(data.path()).unwrap_err();
        assert!(is_taken(data.path()));
        assert!(
            refused.what.contains(&std::process::id().to_string()),
            "{refused}"
        );
        drop(lock);
        assert!(!is_taken(data.path()));
        take_lock(data.path()).unwrap();
    }

    #[test]
    fn the_token_is_private_and_stays() {
        let data = tempfile::tempdir().unwrap();
        let path = data.path().join("token");
        ensure_token(&path).unwrap();
        let token = std::fs::read_to_string(&path).unwrap();
        assert_eq!(token.trim().len(), 64);
        assert_eq!(
            std::fs::metadata(&path).unwrap().permissions().mode() & 0o777,
            0o600
        );
        ensure_token(&path).unwrap();
        assert_eq!(std::fs::read_to_string(&path).unwrap(), token);
    }
}
