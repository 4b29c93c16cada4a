//! `doctor`: looks at everything that a bake needs, and says what to do about what is missing.

use std::path::Path;
use std::process::Stdio;
use std::time::{Duration, Instant};

use chrono::Utc;
use ign_proto::{Cause, v1};
use serde::{Deserialize, Serialize};
use tonic::Code;

use crate::Context;
use crate::connection::{Connection, EndpointFile};
use crate::output::{self, Table, bytes};
use crate::problem::{Exit, Problem};
use crate::supervise::find_worker;
use crate::views::time;

/// Less free space than this is worth a warning: one bake's work folder and bundle.
const FREE_BYTES: u64 = 2_000_000_000;
/// What a coordinator grants by default, where it does not say.
const LEASE_SECS: f64 = 45.0;
/// For the worker to start.
const WORKER_LIMIT: Duration = Duration::from_secs(30);
/// For torch to compute something; loading the GPU's library for the first time reads gigabytes.
const GPU_LIMIT: Duration = Duration::from_mins(4);
/// Clocks that differ by more confuse people who read times, though not leases.
const SKEW_SECS: f64 = 5.0;

/// Arguments of `doctor`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {}

/// One thing that was looked at.
#[derive(Debug, Deserialize, Serialize)]
struct Check {
    name: String,
    /// `ok`, `warn` or `failed`.
    state: String,
    detail: String,
    hint: Option<String>,
}

impl Check {
    fn new(name: &str, state: &str, detail: impl Into<String>) -> Self {
        Self {
            name: name.to_owned(),
            state: state.to_owned(),
            detail: detail.into(),
            hint: None,
        }
    }

    fn hint(mut self, hint: impl Into<String>) -> Self {
        self.hint = Some(hint.into());
        self
    }

    fn problem(name: &str, state: &str, problem: &Problem) -> Self {
        let at = if problem.at.is_empty() {
            String::new()
        } else {
            format!(" ({})", problem.at)
        };
        let check = Self::new(name, state, format!("{}{at}", problem.what));
        if problem.hint.is_empty() {
            check
        } else {
            check.hint(problem.hint.clone())
        }
    }
}

pub(crate) async fn run(context: &Context, _args: &Args) -> Result<(), Problem> {
    let mut checks = Vec::new();
    let mut exit = Exit::Ok;
    match Connection::open(&context.connection).await {
        Ok(connection) => {
            checks.push(Check::new(
                "server",
                "ok",
                connection.target.url.to_string(),
            ));
            checks.extend(diagnosis(&connection).await);
            checks.extend(coordinator(&connection).await);
        }
        // Without a service, `bake` starts its own: only a server that was named must answer.
        Err(problem) if problem.exit == Exit::Unreachable => {
            let expected = context.connection.server.is_some() || named_but_silent(context);
            checks.push(Check::problem(
                "server",
                if expected { "failed" } else { "warn" },
                &problem,
            ));
            if expected {
                exit = Exit::Unreachable;
            }
        }
        Err(problem) => checks.push(Check::problem("server", "failed", &problem)),
    }
    if context.connection.server.is_none() {
        let data = context.connection.data_dir()?;
        checks.push(writable(&data));
        checks.push(space(&data));
        checks.extend(worker().await);
    }
    output::data(context.format, &checks, || table(&checks))?;
    let failed = checks
        .iter()
        .filter(|check| check.state == "failed")
        .count();
    if exit == Exit::Ok && failed > 0 {
        exit = Exit::Failed;
    }
    match exit {
        Exit::Ok => Ok(()),
        exit => Err(Problem {
            exit,
            ..Problem::failed(format!("{failed} of {} checks failed", checks.len()))
        }),
    }
}

/// A process that should listen is there, but does not answer.
fn named_but_silent(context: &Context) -> bool {
    context
        .connection
        .data_dir()
        .is_ok_and(|data| EndpointFile::of_live_service(&data).is_some())
}

/// What the coordinator says of what it stands on, where the token may hear it.
async fn diagnosis(connection: &Connection) -> Vec<Check> {
    match connection.admin().diagnose(v1::DiagnoseRequest {}).await {
        Ok(answer) => answer
            .into_inner()
            .checks
            .into_iter()
            .map(|check| Check {
                name: check.name,
                state: check.state,
                detail: check.detail,
                hint: (!check.hint.is_empty()).then_some(check.hint),
            })
            .collect(),
        Err(status) => match Cause::from_status(&status) {
            // For operators alone; others hear whether it is ready.
            Cause::Forbidden { .. } => vec![store(connection).await],
            _ if status.code() == Code::Unimplemented => vec![store(connection).await],
            _ => vec![Check::problem("database", "failed", &Problem::from(status))],
        },
    }
}

async fn store(connection: &Connection) -> Check {
    match connection.get_open("readyz").await {
        Ok(answer) if answer.status().is_success() => {
            Check::new("store", "ok", "database and object store answer")
        }
        Ok(answer) => {
            let status = answer.status();
            let said = answer.text().await.unwrap_or_default();
            let said: String = said.trim().chars().take(300).collect();
            let detail = if said.is_empty() {
                status.to_string()
            } else {
                said
            };
            Check::new("store", "failed", detail).hint("look at the coordinator's log")
        }
        Err(problem) => Check::problem("store", "failed", &problem),
    }
}

async fn coordinator(connection: &Connection) -> Vec<Check> {
    let asked = Instant::now();
    let status = match connection.jobs().status(v1::StatusRequest::default()).await {
        Ok(status) => status.into_inner(),
        Err(status) => return vec![Check::problem("token", "failed", &Problem::from(status))],
    };
    let half_way = asked.elapsed() / 2;
    let mut checks = vec![Check::new("token", "ok", "accepted")];
    let own = env!("CARGO_PKG_VERSION");
    checks.push(if status.server_version == own {
        Check::new("version", "ok", format!("{own} on both sides"))
    } else {
        Check::new(
            "version",
            "warn",
            format!("ignctl {own}, coordinator {}", status.server_version),
        )
        .hint("install the same version on both sides")
    });
    checks.push(workers(&status));
    if let Some(at) = time(status.at.as_ref()) {
        let here = Utc::now() - chrono::Duration::from_std(half_way).unwrap_or_default();
        let skew = (at - here).num_milliseconds() as f64 / 1000.0;
        checks.push(if skew.abs() <= SKEW_SECS {
            Check::new("clock", "ok", format!("{:.1} s apart", skew.abs()))
        } else {
            Check::new(
                "clock",
                "warn",
                format!(
                    "the coordinator's is {:.0} s {}",
                    skew.abs(),
                    if skew > 0.0 { "ahead" } else { "behind" }
                ),
            )
            .hint("set both by NTP; leases go by the database's clock and are not affected")
        });
    }
    checks
}

/// The workers that were seen within a lease.
fn workers(status: &v1::StatusResponse) -> Check {
    let lease_secs = if status.lease_secs > 0.0 {
        status.lease_secs
    } else {
        LEASE_SECS
    };
    let at = time(status.at.as_ref());
    let is_here = |worker: &&v1::Worker| {
        let silent = at.zip(time(worker.last_seen_at.as_ref()));
        silent.is_none_or(|(at, seen)| (at - seen).as_seconds_f64() <= lease_secs)
    };
    let here: Vec<&v1::Worker> = status.workers.iter().filter(is_here).collect();
    let away = match status.workers.len() - here.len() {
        0 => String::new(),
        away => format!("; {away} not seen for {lease_secs:.0} s"),
    };
    let others: Vec<String> = here
        .iter()
        .filter(|worker| worker.version != status.server_version)
        .map(|worker| format!("{} {}", worker.id, worker.version))
        .collect();
    match (here.len(), others.as_slice()) {
        (0, _) => Check::new("workers", "warn", format!("none is connected{away}"))
            .hint("ignctl up --workers N, or ign-worker agent on other machines"),
        (count, []) => Check::new("workers", "ok", format!("{count} connected{away}")),
        (_, others) => Check::new(
            "workers",
            "warn",
            format!("of another version: {}{away}", others.join(", ")),
        ),
    }
}

fn writable(data: &Path) -> Check {
    // The folder may not exist yet: `up` creates it.
    let probe = data.join(format!(".doctor-{}", std::process::id()));
    let written = std::fs::create_dir_all(data)
        .and_then(|()| std::fs::write(&probe, b"probe"))
        .and_then(|()| std::fs::remove_file(&probe));
    match written {
        Ok(()) => Check::new("data folder", "ok", data.display().to_string()),
        Err(error) => Check::new(
            "data folder",
            "failed",
            format!("{}: {error}", data.display()),
        )
        .hint("give another folder by --data (IGN_DATA)"),
    }
}

fn space(data: &Path) -> Check {
    match rustix::fs::statvfs(data) {
        Ok(stat) => {
            let free = stat.f_bavail.saturating_mul(stat.f_frsize);
            let state = if free < FREE_BYTES { "warn" } else { "ok" };
            let check = Check::new("disk space", state, format!("{} free", bytes(free)));
            if free < FREE_BYTES {
                check.hint("make room before the next bake")
            } else {
                check
            }
        }
        Err(error) => Check::new("disk space", "warn", format!("cannot tell: {error}")),
    }
}

/// The worker beside this program, and what it says of torch and GPU.
async fn worker() -> Vec<Check> {
    let program = match find_worker() {
        Ok(program) => program,
        Err(problem) => return vec![Check::problem("worker", "failed", &problem)],
    };
    let at = program.display().to_string();
    let failed = |why: String| {
        vec![
            Check::new("worker", "failed", format!("{at}: {why}"))
                .hint("run `make setup`; it fetches libtorch, which the worker needs"),
        ]
    };
    let version = match ask_worker(&program, "--version", WORKER_LIMIT).await {
        Ok(version) => version,
        Err(why) => return failed(why),
    };
    let state = if version.ends_with(env!("CARGO_PKG_VERSION")) {
        "ok"
    } else {
        "warn"
    };
    let mut checks = vec![Check::new("worker", state, format!("{version} ({at})"))];
    match ask_worker(&program, "doctor", GPU_LIMIT).await {
        Ok(said) => match serde_json::from_str::<Vec<Check>>(&said) {
            Ok(more) => checks.extend(more),
            Err(error) => checks.push(Check::new("torch", "warn", format!("{at}: {error}"))),
        },
        Err(why) => checks.push(Check::new("torch", "failed", format!("{at}: {why}"))),
    }
    checks
}

/// What the worker prints; why it does not, otherwise.
async fn ask_worker(program: &Path, argument: &str, limit: Duration) -> Result<String, String> {
    let run = tokio::process::Command::new(program)
        .arg(argument)
        .stdin(Stdio::null())
        .kill_on_drop(true)
        .output();
    match tokio::time::timeout(limit, run).await {
        Ok(Ok(out)) if out.status.success() => {
            Ok(String::from_utf8_lossy(&out.stdout).trim().to_owned())
        }
        Ok(Ok(out)) => {
            let said = String::from_utf8_lossy(&out.stderr);
            let said = said.lines().last().unwrap_or("it says nothing").to_owned();
            Err(format!("{}: {said}", out.status))
        }
        Ok(Err(error)) => Err(error.to_string()),
        Err(_) => Err(format!("no answer within {} s", limit.as_secs())),
    }
}

fn table(checks: &[Check]) -> String {
    let mut table = Table::new(&["CHECK", "STATE", "DETAIL"]);
    for check in checks {
        table.row([
            check.name.clone(),
            check.state.clone(),
            check.detail.clone(),
        ]);
    }
    let hints = checks.iter().filter_map(|check| {
        let hint = check.hint.as_deref()?;
        Some(format!(
            "hint ({}): {}\n",
            check.name,
            output::printable(hint)
        ))
    });
    std::iter::once(table.to_string()).chain(hints).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn checks_come_with_what_to_do() {
        let checks = [
            Check::new("server", "ok", "http://127.0.0.1:7070/"),
            Check::new(
                "worker",
                "failed",
                "ign-worker: exit status: 127: cannot open libtorch_cpu.so",
            )
            .hint("run `make setup`"),
        ];
        insta::assert_snapshot!(table(&checks));
    }

    #[test]
    fn a_worker_that_was_not_seen_for_a_lease_is_away() {
        let seen = |secs: i64| v1::Worker {
            id: format!("seen-at-{secs}"),
            version: "1".to_owned(),
            last_seen_at: Some(prost_types::Timestamp {
                seconds: secs,
                nanos: 0,
            }),
            ..v1::Worker::default()
        };
        let at = |seconds: i64, lease_secs: f64| {
            let status = v1::StatusResponse {
                workers: vec![seen(100), seen(1000)],
                server_version: "1".to_owned(),
                at: Some(prost_types::Timestamp { seconds, nanos: 0 }),
                lease_secs,
                ..v1::StatusResponse::default()
            };
            let check = workers(&status);
            (check.state, check.detail)
        };
        let said = |state: &str, detail: &str| (state.to_owned(), detail.to_owned());
        assert_eq!(at(100, 1000.0), said("ok", "2 connected"));
        assert_eq!(
            at(1020, 30.0),
            said("ok", "1 connected; 1 not seen for 30 s")
        );
        assert_eq!(
            at(1044, 0.0),
            said("ok", "1 connected; 1 not seen for 45 s")
        );
        assert_eq!(
            at(1046, 0.0),
            said("warn", "none is connected; 2 not seen for 45 s")
        );
    }
}
