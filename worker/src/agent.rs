//! `ign-worker agent`: runs `ign_agent` with this program's `exec` as the child.

use std::io::Read;
use std::num::NonZero;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, ensure};
use bytesize::ByteSize;
use ign_agent::{AgentConfig, ChildCommand};
use ign_trace::Exporter;
use tokio::signal::unix::{SignalKind, signal};
use tokio_util::sync::CancellationToken;
use tracing_subscriber::layer::SubscriberExt as _;
use tracing_subscriber::util::SubscriberInitExt as _;
use tracing_subscriber::{EnvFilter, Layer as _};

use crate::{gpu, output};

#[derive(Debug, clap::Args)]
pub(crate) struct Options {
    /// The coordinator, https://HOST:PORT; http:// within one machine.
    #[arg(long, env = "IGN_SERVER", value_name = "URL")]
    server: String,
    /// File that holds the bearer token.
    #[arg(
        long,
        env = "IGN_TOKEN_FILE",
        value_name = "FILE",
        required_unless_present = "client_cert"
    )]
    token_file: Option<PathBuf>,
    /// Authorities of the coordinator's certificate, in PEM [default: those of this machine].
    #[arg(long, env = "IGN_CA_FILE", value_name = "FILE")]
    ca_file: Option<PathBuf>,
    /// Certificate of this worker in PEM, in place of a token.
    #[arg(
        long,
        env = "IGN_CLIENT_CERT",
        value_name = "FILE",
        requires = "client_key"
    )]
    client_cert: Option<PathBuf>,
    /// Its key in PEM.
    #[arg(
        long,
        env = "IGN_CLIENT_KEY",
        value_name = "FILE",
        requires = "client_cert"
    )]
    client_key: Option<PathBuf>,
    /// Folder for cached captures and running jobs; belongs to this agent alone.
    #[arg(long, env = "IGN_WORK_DIR", value_name = "DIR")]
    work_dir: PathBuf,
    /// Name of this worker [default: host name and process id].
    #[arg(long, env = "IGN_WORKER_NAME")]
    name: Option<String>,
    /// Jobs at once, each in a process of its own: where one does not fill the machine or its GPU.
    #[arg(long, env = "IGN_SLOTS", value_name = "N", default_value = "1")]
    slots: NonZero<usize>,
    /// CPU threads of each job [default: the cores, divided between the slots].
    #[arg(long, env = "IGN_THREADS", value_name = "N")]
    threads: Option<NonZero<usize>>,
    /// Bound of the cache of captures and checkpoints.
    #[arg(
        long,
        env = "IGN_CACHE_SIZE",
        value_name = "SIZE",
        default_value = "20GB"
    )]
    cache_size: ByteSize,
    /// Stop when stdin ends: the agent then never outlives the program that started it.
    #[arg(long)]
    exit_when_stdin_closes: bool,
}

pub(crate) fn run(options: Options) -> Result<()> {
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_unset| EnvFilter::new("info"));
    let log = tracing_subscriber::fmt::layer()
        .with_writer(std::io::stderr)
        .with_ansi(std::io::IsTerminal::is_terminal(&std::io::stderr()))
        .with_target(false);
    // It ends last, so that it sends the last spans.
    let exporter = Exporter::from_env("ign-worker")?;
    tracing_subscriber::registry()
        .with(log.with_filter(filter))
        .with(exporter.as_ref().map(Exporter::layer))
        .init();
    let token = match &options.token_file {
        Some(file) => read_token(file)?,
        None => String::new(),
    };

    let shutdown = CancellationToken::new();
    if options.exit_when_stdin_closes {
        let shutdown = shutdown.clone();
        std::thread::Builder::new()
            .name("stdin".to_owned())
            .spawn(move || {
                until_end(&mut std::io::stdin().lock());
                shutdown.cancel();
            })?;
    }
    let gpu = gpu::probe();
    let mut config = AgentConfig::new(&options.server, &token, &options.work_dir)?;
    config.certificates = ign_client::Files {
        ca: options.ca_file,
        identity: options.client_cert.zip(options.client_key),
    };
    config.name = options.name;
    config.device = gpu.name;
    env!("CARGO_PKG_VERSION").clone_into(&mut config.version);
    config.cache_bytes = options.cache_size.as_u64();
    config.child = ChildCommand {
        envs: gpu.envs,
        ..ChildCommand::current_exe()?
    };
    config.slots = options.slots;
    config.threads = options
        .threads
        .map_or_else(|| ign_agent::threads_per_slot(options.slots), NonZero::get);
    // One thread is enough for everything but hashing, and keeps the agent small.
    tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .max_blocking_threads(4)
        .build()?
        .block_on(async {
            tokio::spawn(stop_on_signal(
                shutdown.clone(),
                signal(SignalKind::terminate())?,
                signal(SignalKind::interrupt())?,
            ));
            Ok(ign_agent::run(config, shutdown).await?)
        })
}

fn read_token(file: &Path) -> Result<String> {
    let shown = file.display();
    let text = std::fs::read_to_string(file)
        .with_context(|| format!("cannot read the token file {shown}"))?;
    let token = text.trim();
    ensure!(!token.is_empty(), "the token file {shown} is empty");
    Ok(token.to_owned())
}

/// The first signal asks for an orderly end, a second one does not wait for it.
async fn stop_on_signal(
    shutdown: CancellationToken,
    mut terminate: tokio::signal::unix::Signal,
    mut interrupt: tokio::signal::unix::Signal,
) {
    loop {
        tokio::select! {
            _ = terminate.recv() => {}
            _ = interrupt.recv() => {}
        }
        if shutdown.is_cancelled() {
            output::say("stopped before every job was handed back; their leases will run out");
            die();
        }
        tracing::info!("stopping: running jobs go back to the queue");
        shutdown.cancel();
    }
}

/// Reads until end of file or an error, which means the same here.
pub(crate) fn until_end(input: &mut impl Read) {
    let mut buffer = [0; 256];
    loop {
        match input.read(&mut buffer) {
            Ok(0) => return,
            Err(error) if error.kind() != std::io::ErrorKind::Interrupted => return,
            _ => {}
        }
    }
}

/// Ends this process at once. Ordinary exit would run the destructors of libraries whose threads still work.
pub(crate) fn die() {
    rustix::process::kill_process(rustix::process::getpid(), rustix::process::Signal::KILL).ok();
}
