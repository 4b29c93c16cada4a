//! Postgres's own benchmark on the same server: what its `-N` transaction (update a row, read it, add to a history)
//! reaches with as many clients.

use std::process::Command;
use std::time::Duration;

use anyhow::{Context as _, Result, ensure};
use ign_e2e::run;
use ign_testkit::Postgres;

/// A million accounts, so that clients hardly ever meet.
const SCALE: &str = "10";

/// Makes and fills a database for it; its URL.
pub(crate) fn prepare(postgres: &Postgres) -> Result<String> {
    let url = postgres.create_database()?;
    pgbench(postgres, &["-i", "-q", "-s", SCALE, &url], 120.0)?;
    Ok(url)
}

/// Transactions per second.
pub(crate) fn rate(postgres: &Postgres, url: &str, clients: usize, secs: f64) -> Result<f64> {
    let (clients, whole_secs) = (clients.to_string(), secs.ceil().to_string());
    let text = pgbench(
        postgres,
        &[
            "-n",
            "-N",
            "-j",
            "2",
            "-c",
            &clients,
            "-T",
            &whole_secs,
            url,
        ],
        secs + 60.0,
    )?;
    text.lines()
        .find_map(|line| line.strip_prefix("tps = ")?.split(' ').next()?.parse().ok())
        .with_context(|| format!("pgbench printed no rate: {text}"))
}

fn pgbench(postgres: &Postgres, args: &[&str], limit_secs: f64) -> Result<String> {
    let mut command = Command::new(postgres.bin().join("pgbench"));
    command.args(args);
    let output = run(&mut command, Duration::from_secs_f64(limit_secs))?;
    ensure!(
        output.status.success(),
        "pgbench {args:?} failed: {}",
        String::from_utf8_lossy(&output.stderr)
    );
    Ok(String::from_utf8(output.stdout)?)
}
