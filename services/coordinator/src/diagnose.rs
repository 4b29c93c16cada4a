//! Trying out what the coordinator stands on, for `ignctl doctor`.

use std::time::{Duration, Instant};

use chrono::Utc;
use ign_proto::v1;
use ign_registry::Registry;

use crate::app::App;
use crate::error::chain;

/// Longest that a part may take to answer.
const PATIENCE: Duration = Duration::from_secs(15);
/// Leases go by the database's clock; people read the coordinator's in logs.
const SKEW_SECS: f64 = 5.0;

fn check(name: &str, state: &str, detail: impl Into<String>, hint: impl Into<String>) -> v1::Check {
    v1::Check {
        name: name.to_owned(),
        state: state.to_owned(),
        detail: detail.into(),
        hint: hint.into(),
    }
}

/// What `work` gives and how long it took; why not, otherwise.
async fn timed<T, E: std::error::Error>(
    work: impl Future<Output = Result<T, E>>,
) -> Result<(T, Duration), String> {
    let begun = Instant::now();
    match tokio::time::timeout(PATIENCE, work).await {
        Ok(Ok(value)) => Ok((value, begun.elapsed())),
        Ok(Err(error)) => Err(chain(&error)),
        Err(_elapsed) => Err(format!("no answer within {} s", PATIENCE.as_secs())),
    }
}

impl App {
    /// Every part, one after the other.
    pub(crate) async fn diagnose(&self) -> Vec<v1::Check> {
        let mut checks = self.database().await;
        checks.push(store("store", &self.registry).await);
        if let Some(replica) = &self.replica {
            checks.push(match timed(replica.ping()).await {
                Ok(_) => check("replica", "ok", "answers", ""),
                Err(why) => check(
                    "replica",
                    "failed",
                    why,
                    "without it damage is found and not repaired",
                ),
            });
        }
        checks.extend(self.disks());
        checks
    }

    async fn database(&self) -> Vec<v1::Check> {
        let hint = "look at the database's own log, and at --database";
        match timed(self.store.status(None, 0)).await {
            Ok((status, took)) => {
                let skew = (status.at - Utc::now()).as_seconds_f64() + took.as_secs_f64() / 2.0;
                let detail = format!("answers in {:.0} ms", took.as_secs_f64() * 1000.0);
                let clock = format!(
                    "the database's and the coordinator's are {:.1} s apart",
                    skew.abs()
                );
                vec![
                    check("database", "ok", detail, ""),
                    if skew.abs() <= SKEW_SECS {
                        check("database clock", "ok", clock, "")
                    } else {
                        check("database clock", "warn", clock, "set both by NTP")
                    },
                ]
            }
            Err(why) => vec![check("database", "failed", why, hint)],
        }
    }

    fn disks(&self) -> Vec<v1::Check> {
        self.room
            .free()
            .map(|(folder, free)| {
                let detail = format!("{} MB free at {}", free / 1_000_000, folder.display());
                match self.room.check(crate::room::Write::Work) {
                    Ok(()) => check("server disk", "ok", detail, ""),
                    Err(_full) => check(
                        "server disk",
                        "failed",
                        format!("{detail}: below the reserve, no new work is taken"),
                        "make room, or collect garbage (ignctl admin gc)",
                    ),
                }
            })
            .collect()
    }
}

async fn store(name: &str, registry: &Registry) -> v1::Check {
    match timed(registry.try_out()).await {
        Ok((true, took)) => check(
            name,
            "ok",
            format!(
                "writes, reads, deletes and honours conditional put ({:.0} ms)",
                took.as_secs_f64() * 1000.0
            ),
            "",
        ),
        Ok((false, _)) => check(
            name,
            "warn",
            "writes, reads and deletes, but ignores conditional put",
            "the database alone guards versions; keep other programs out of the bucket",
        ),
        Err(why) => check(name, "failed", why, "look at --store and its credentials"),
    }
}
