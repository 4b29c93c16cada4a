//! `ign-coordinator`: one coordinator as a process. See the library for what it serves.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Duration;

use clap::{Parser, ValueEnum};
use ign_coordinator::{Care, Config, Limits, TlsFiles, serve};
use ign_queue::Settings;
use ign_registry::StoreConfig;
use ign_trace::Exporter;
use tokio::signal::unix::{SignalKind, signal};
use tracing_subscriber::layer::SubscriberExt as _;
use tracing_subscriber::util::SubscriberInitExt as _;
use tracing_subscriber::{EnvFilter, Layer as _};

/// Many small requests at once: a fifth of the processor's time went into the system's allocator.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

/// Serves jobs, workers, captures and bundles on one port.
///
/// S3 credentials and endpoint come from the usual variables: AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY, AWS_REGION,
/// AWS_ENDPOINT, AWS_ALLOW_HTTP.
#[derive(Debug, Parser)]
#[command(version)]
#[expect(clippy::doc_markdown, reason = "these texts are the command's help")]
struct Args {
    /// Address to listen on; port 0 takes a free one.
    #[arg(long, env = "IGN_LISTEN", default_value = "127.0.0.1:0")]
    listen: SocketAddr,
    /// sqlite:///path or postgres://user@host/database.
    #[arg(long, env = "IGN_DATABASE", hide_env_values = true)]
    database: String,
    /// file:///folder or s3://bucket/prefix.
    #[arg(long, env = "IGN_STORE")]
    store: String,
    /// File with the root token, which allows everything; `ignctl token create` makes others.
    #[arg(long, env = "IGN_TOKEN_FILE")]
    token_file: PathBuf,
    /// Certificate of this server in PEM, with those between it and its authority; read again when it changes and on
    /// SIGHUP.
    #[arg(long, env = "IGN_TLS_CERT", requires = "tls_key")]
    tls_cert: Option<PathBuf>,
    /// Its key in PEM.
    #[arg(long, env = "IGN_TLS_KEY", requires = "tls_cert")]
    tls_key: Option<PathBuf>,
    /// Authority of workers' certificates in PEM: whoever shows one that it signed may work, without a token.
    #[arg(long, env = "IGN_CLIENT_CA", requires = "tls_cert")]
    client_ca: Option<PathBuf>,
    /// A proxy in front speaks TLS: listen beyond this machine without it, and take clients' addresses from the last
    /// X-Forwarded-For.
    #[arg(long, env = "IGN_BEHIND_TLS_PROXY")]
    behind_tls_proxy: bool,
    /// Where to write url, pid and token file as JSON once listening.
    #[arg(long, env = "IGN_ENDPOINT_FILE")]
    endpoint_file: Option<PathBuf>,
    /// How long a worker may be silent before its job is given to another.
    #[arg(long, env = "IGN_LEASE_SECS", default_value_t = 45.0, value_parser = lease_secs)]
    lease_secs: f64,
    /// Send readers of blobs to the object store by signed URL, where it can sign. Turn off where clients cannot reach
    /// the store under the address that the coordinator uses.
    #[arg(long, env = "IGN_REDIRECT_BLOBS", default_value_t = true, action = clap::ArgAction::Set)]
    redirect_blobs: bool,
    /// Refuse new work while the disk of a local store or database has less free space than this; 0 never refuses.
    #[arg(long, env = "IGN_RESERVE_MIB", default_value_t = 512)]
    reserve_mib: u64,
    /// Read every digest of the store again once in this many days; 0 only on request (ignctl admin audit).
    #[arg(long, env = "IGN_AUDIT_DAYS", default_value_t = 30)]
    audit_days: u32,
    /// Store with the same content from which damaged files are repaired; it is only read.
    #[arg(long, env = "IGN_REPLICA")]
    replica: Option<String>,
    /// Receiver of webhooks in your own network, HOST:PORT; those named here may have private addresses and speak plain
    /// http, all others take https and a public address. May be given more than once.
    #[arg(
        long,
        env = "IGN_WEBHOOK_INTERNAL",
        value_name = "HOST:PORT",
        value_delimiter = ','
    )]
    webhook_internal: Vec<String>,
    /// Form of the log on stderr; IGN_LOG sets the level (info, debug, ign_coordinator=debug, ...).
    #[arg(long, env = "IGN_LOG_FORMAT", value_enum, default_value = "text")]
    log_format: LogFormat,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum LogFormat {
    Text,
    Json,
}

fn lease_secs(text: &str) -> Result<f64, String> {
    let secs: f64 = text
        .parse()
        .map_err(|_error| "expected a number of seconds".to_owned())?;
    if (0.2..=3600.0).contains(&secs) {
        Ok(secs)
    } else {
        Err("expected 0.2 to 3600 seconds".to_owned())
    }
}

fn main() -> ExitCode {
    let args = Args::parse();
    let filter = EnvFilter::try_from_env("IGN_LOG").unwrap_or_else(|_unset| EnvFilter::new("info"));
    let log = tracing_subscriber::fmt::layer().with_writer(std::io::stderr);
    let log = match args.log_format {
        LogFormat::Text => log.with_ansi(false).boxed(),
        LogFormat::Json => log.json().boxed(),
    };
    let exporter = Exporter::from_env("ign-coordinator");
    tracing_subscriber::registry()
        .with(log.with_filter(filter))
        .with(
            exporter
                .as_ref()
                .ok()
                .and_then(Option::as_ref)
                .map(Exporter::layer),
        )
        .init();
    // It ends last, so that it sends the last spans.
    let outcome = exporter
        .map_err(anyhow::Error::from)
        .and_then(|_exporter| run(args));
    match outcome {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            tracing::error!("{error:#}");
            ExitCode::FAILURE
        }
    }
}

#[tokio::main]
async fn run(args: Args) -> anyhow::Result<()> {
    let (mut interrupt, mut terminate) = (
        signal(SignalKind::interrupt())?,
        signal(SignalKind::terminate())?,
    );
    let config = Config {
        listen: args.listen,
        database: args.database,
        store: StoreConfig::new(args.store),
        token_file: args.token_file,
        endpoint_file: args.endpoint_file,
        settings: Settings {
            lease: Duration::from_secs_f64(args.lease_secs),
            ..Settings::default()
        },
        redirect_blobs: args.redirect_blobs,
        tls: args.tls_cert.zip(args.tls_key).map(|(cert, key)| TlsFiles {
            cert,
            key,
            client_ca: args.client_ca,
        }),
        behind_tls_proxy: args.behind_tls_proxy,
        limits: Limits::default(),
        care: Care {
            reserve_bytes: args.reserve_mib.saturating_mul(1024 * 1024),
            audit_every: (args.audit_days > 0).then(|| Duration::from_hours(24) * args.audit_days),
            replica: args.replica.map(StoreConfig::new),
        },
        webhook_internal: args.webhook_internal,
    };
    let shutdown = async move {
        tokio::select! {
            _ = interrupt.recv() => {}
            _ = terminate.recv() => {}
        }
        tracing::info!("asked to stop");
    };
    let running = serve(config, shutdown).await?;
    let reload = running.reload_certificates();
    let mut hangup = signal(SignalKind::hangup())?;
    tokio::spawn(async move {
        while hangup.recv().await.is_some() {
            reload();
        }
    });
    running.wait().await?;
    Ok(())
}
