//! `up`: the whole service on this machine, in the foreground.

use std::net::SocketAddr;
use std::time::Duration;

use ign_coordinator::Care;
use ign_registry::StoreConfig;

use crate::Context;
use crate::embedded::{Embedded, Options, interrupted};
use crate::output;
use crate::problem::Problem;

/// Arguments of `up`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Worker processes; each bakes one job at a time
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = workers)]
    workers: usize,
    /// Threads per worker [default: the cores, shared among the workers]
    #[arg(long, value_name = "N", value_parser = threads)]
    threads: Option<usize>,
    /// Address to listen on; port 0 takes a free one
    #[arg(long, value_name = "ADDR", default_value = "127.0.0.1:0")]
    listen: SocketAddr,
    /// Listen beyond this machine without TLS, because a proxy in front speaks it
    #[arg(long)]
    behind_tls_proxy: bool,
    /// Refuse new work while the data folder's disk has less free space than this; 0 never refuses
    #[arg(long, value_name = "MIB", default_value_t = 512)]
    reserve_mib: u64,
    /// Read every digest of the store again once in this many days; 0 only on request (ignctl admin audit)
    #[arg(long, value_name = "DAYS", default_value_t = 30)]
    audit_days: u32,
    /// Folder or bucket with the same content, from which damaged files are repaired; it is only read
    #[arg(long, value_name = "URL")]
    replica: Option<String>,
    /// Receiver of webhooks in your own network, which may have a private address and speak plain http; may be repeated
    #[arg(long, value_name = "HOST:PORT")]
    webhook_internal: Vec<String>,
}

fn workers(text: &str) -> Result<usize, String> {
    text.parse()
        .ok()
        .filter(|n| *n <= 256)
        .ok_or_else(|| "expected 0 to 256".to_string())
}

fn threads(text: &str) -> Result<usize, String> {
    text.parse()
        .ok()
        .filter(|n| (1..=1024).contains(n))
        .ok_or_else(|| "expected 1 to 1024".to_string())
}

pub(crate) async fn run(context: &Context, args: &Args) -> Result<(), Problem> {
    let options = Options {
        data: context.connection.data_dir()?,
        workers: args.workers,
        threads: args.threads,
        listen: args.listen,
        behind_tls_proxy: args.behind_tls_proxy,
        care: Care {
            reserve_bytes: args.reserve_mib.saturating_mul(1024 * 1024),
            audit_every: (args.audit_days > 0).then(|| Duration::from_hours(24) * args.audit_days),
            replica: args.replica.clone().map(StoreConfig::new),
        },
        webhook_internal: args.webhook_internal.clone(),
        own: false,
    };
    let mut service = Embedded::start(&options).await?;
    let plural =
        |count: usize, noun: &str| format!("{count} {noun}{}", if count == 1 { "" } else { "s" });
    let facts = output::pairs(&[
        ("listening", service.target.url.to_string()),
        ("data", options.data.display().to_string()),
        ("token", options.data.join("token").display().to_string()),
        (
            "workers",
            format!(
                "{}, {} each",
                plural(options.workers, "worker"),
                plural(service.threads, "thread")
            ),
        ),
        ("logs", service.logs.display().to_string()),
    ]);
    output::note(facts.trim_end());
    output::note(
        "Ctrl-C ends the service; running jobs go on from their last checkpoint when it starts again",
    );
    let ended = tokio::select! {
        signal = interrupted() => signal,
        problem = service.broken() => Err(problem),
    };
    output::note("ending");
    let stopped = service.stop().await;
    ended.and(stopped)
}
