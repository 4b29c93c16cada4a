//! The service under load: real processes (`ign-coordinator`, Postgres, an S3 endpoint) on loopback, each figure beside
//! what it is to reach and beside a peer where there is one. `make bench BENCH=service` runs it.
//!
//! Postgres keeps its defaults for durability (`fsync`, `synchronous_commit`, full pages). Load comes from this process,
//! on the same cores, through gRPC with one connection per worker. Progress goes to stderr; the last line on stdout is
//! one JSON object with all figures.

mod bytes;
mod figures;
mod jobs;
mod pgbench;
mod service;

use anyhow::{Context as _, Result};
use ign_testkit::Postgres;

use crate::figures::Figures;
use crate::jobs::Cycle;
use crate::service::Service;

/// What to measure, and for how long.
#[derive(Clone, Copy, Debug)]
struct Load {
    /// Rows submitted and left in the queue.
    rows: usize,
    /// Workers that lease and complete, and clients of pgbench.
    workers: usize,
    /// Workers that hold a job and report.
    connected: usize,
    /// Runs of each side where two alternate.
    rounds: usize,
    /// Length of one run.
    secs: f64,
    /// Size of the file whose transfer is timed.
    file_mib: usize,
}

fn main() -> Result<()> {
    let load = Load {
        rows: argument("--rows", 100_000)?,
        workers: argument("--workers", 64)?,
        connected: argument("--connected", 500)?,
        rounds: argument("--rounds", 3)?,
        secs: argument("--secs", 8.0)?,
        file_mib: argument("--file-mib", 256)?,
    };
    let only: String = argument("--only", String::new())?;
    let wanted = |part: &str| only.is_empty() || only.split(',').any(|it| it == part);
    let runtime = tokio::runtime::Runtime::new()?;
    let mut figures = Figures::default();
    runtime.block_on(async {
        if wanted("postgres") {
            postgres(&mut figures, load).await?;
        }
        if wanted("sqlite") {
            sqlite(&mut figures, load).await?;
        }
        if wanted("bytes") {
            bytes::measure(&mut figures, load).await?;
        }
        anyhow::Ok(())
    })?;
    figures.print();
    Ok(())
}

/// Everything about jobs on Postgres, with bundles on the local disk.
async fn postgres(figures: &mut Figures, load: Load) -> Result<()> {
    let postgres = Postgres::start_durable()?;
    if load.connected > 0 {
        let service = Service::start(&postgres.create_database()?).await?;
        jobs::pickup(figures, &service, "Postgres").await?;
        jobs::connected(figures, &service, load).await?;
    }
    let service = Service::start(&postgres.create_database()?).await?;
    jobs::submit(figures, &service, load, "Postgres").await?;
    jobs::status(figures, &service, load, "Postgres").await?;
    let in_memory = Service::start_in_memory(&postgres.create_database()?).await?;
    jobs::fill(&in_memory, load.rows, "row").await?;
    let peer = pgbench::prepare(&postgres)?;
    let (disk_jobs, memory_jobs) = (Cycle::job(&service).await?, Cycle::job(&in_memory).await?);
    let (mut transactions, mut on_disk) = (Vec::new(), Vec::new());
    let (mut without_disk, mut calls_alone) = (Vec::new(), Vec::new());
    for _ in 0..load.rounds {
        transactions.push(pgbench::rate(&postgres, &peer, load.workers, load.secs)?);
        on_disk.push(jobs::cycles(&service, load, &disk_jobs).await?);
        without_disk.push(jobs::cycles(&in_memory, load, &memory_jobs).await?);
        calls_alone.push(jobs::cycles(&in_memory, load, &Cycle::Calls).await?);
    }
    let name = format!("lease and complete, {} workers, Postgres", load.workers);
    let peer = ("pgbench -N", &transactions[..]);
    figures.beside(&name, "cycles/s", &on_disk, peer, Some(0.5));
    let name = format!("{name}, bundles in memory");
    figures.beside(&name, "cycles/s", &without_disk, peer, None);
    let name = format!("two calls that do nothing, {} workers", load.workers);
    figures.beside(&name, "cycles/s", &calls_alone, peer, None);
    jobs::reports(figures, &service, "Postgres")
}

/// The same on the embedded store.
async fn sqlite(figures: &mut Figures, load: Load) -> Result<()> {
    let folder = tempfile::tempdir()?;
    let url = format!("sqlite://{}/ign.db", folder.path().display());
    let service = Service::start(&url).await?;
    jobs::pickup(figures, &service, "SQLite").await?;
    jobs::submit(figures, &service, load, "SQLite").await?;
    jobs::status(figures, &service, load, "SQLite").await?;
    let (jobs, mut cycles) = (Cycle::job(&service).await?, Vec::new());
    for _ in 0..load.rounds {
        cycles.push(jobs::cycles(&service, load, &jobs).await?);
    }
    figures.alone(
        &format!("lease and complete, {} workers, SQLite", load.workers),
        "cycles/s",
        &cycles,
        None,
    );
    jobs::reports(figures, &service, "SQLite")
}

/// The value of `--name VALUE`, or the default.
fn argument<T: std::str::FromStr>(name: &str, default: T) -> Result<T>
where
    T::Err: std::error::Error + Send + Sync + 'static,
{
    let mut arguments = std::env::args().skip_while(|argument| argument != name);
    match arguments.nth(1) {
        Some(value) => value
            .parse()
            .with_context(|| format!("{name} {value} is not understood")),
        None => Ok(default),
    }
}
