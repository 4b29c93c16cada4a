//! Worker agents as child processes of an embedded service.
//!
//! Each child ends when its stdin closes, so no worker outlives ignctl, however ignctl ends. A worker that dies is
//! started again, after a wait that grows while it keeps dying at once.

use std::fs::File;
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::{Duration, Instant};

use tokio::process::{Child, Command};
use tokio::sync::watch;

use crate::output;
use crate::problem::{Doing as _, Problem};

/// A worker that lives this long is well: the wait before the next start begins small again.
const WELL_AFTER: Duration = Duration::from_secs(30);
/// Longest wait before a start.
const LONGEST_WAIT: Duration = Duration::from_secs(30);
/// How long a worker may take to end after its stdin closed.
const GRACE: Duration = Duration::from_secs(10);
/// A log file larger than this is set aside when a worker starts.
const LOG_BYTES: u64 = 16 << 20;
/// Deaths in a row, each soon after the start, after which a worker is not started any more in a foreground bake.
pub(crate) const HOPELESS_AFTER: u32 = 4;

/// How to start one worker.
#[derive(Clone, Debug)]
pub(crate) struct WorkerCommand {
    /// The executable.
    pub(crate) program: PathBuf,
    /// Its arguments.
    pub(crate) args: Vec<String>,
    /// For messages.
    pub(crate) name: String,
    /// Takes its output.
    pub(crate) log: PathBuf,
    /// Deaths in a row after which to give up; none for never.
    pub(crate) give_up_after: Option<u32>,
}

/// Finds `ign-worker`: `IGN_WORKER`, or beside this program.
pub(crate) fn find_worker() -> Result<PathBuf, Problem> {
    if let Some(named) = std::env::var_os("IGN_WORKER").filter(|name| !name.is_empty()) {
        let named = PathBuf::from(named);
        return if named.is_file() {
            Ok(named)
        } else {
            Err(Problem::usage("IGN_WORKER names no file").at(named.display()))
        };
    }
    let own = std::env::current_exe().doing("cannot find this program's folder", "ignctl")?;
    let beside = own.with_file_name("ign-worker");
    if beside.is_file() {
        Ok(beside)
    } else {
        Err(Problem::failed("the worker program is not installed")
            .at(beside.display())
            .hint("put ign-worker beside ignctl or name it by IGN_WORKER; `make setup` builds it"))
    }
}

/// Keeps one worker running until `stop` turns true; an error means that it cannot be kept running.
pub(crate) async fn keep_running(
    command: WorkerCommand,
    mut stop: watch::Receiver<bool>,
) -> Result<(), Problem> {
    let mut deaths_in_a_row = 0;
    loop {
        if *stop.borrow() {
            return Ok(());
        }
        let started = Instant::now();
        let mut child = start(&command)?;
        // Taken out of the child, because waiting for a child closes its stdin.
        let stdin = child.stdin.take();
        let died = tokio::select! {
            status = child.wait() => status.doing("cannot wait for the worker", &command.name)?,
            _ = stop.changed() => {
                drop(stdin);
                return end(child, &command.name).await;
            }
        };
        drop(stdin);
        deaths_in_a_row = if started.elapsed() > WELL_AFTER {
            1
        } else {
            deaths_in_a_row + 1
        };
        if command
            .give_up_after
            .is_some_and(|limit| deaths_in_a_row >= limit)
        {
            return Err(
                Problem::failed(format!("{} keeps ending: {died}", command.name))
                    .at(command.log.display())
                    .hint(last_line(&command.log)),
            );
        }
        let wait = LONGEST_WAIT.min(Duration::from_millis(250 << deaths_in_a_row.min(7)));
        output::warn(&format!(
            "{} ended ({died}); starting it again in {:.1} s; its log: {}",
            command.name,
            wait.as_secs_f64(),
            command.log.display()
        ));
        tokio::select! {
            () = tokio::time::sleep(wait) => {}
            _ = stop.changed() => return Ok(()),
        }
    }
}

/// Opens a log to be added to; a large one is set aside first.
pub(crate) fn open_log(path: &Path) -> Result<File, Problem> {
    if std::fs::metadata(path).is_ok_and(|meta| meta.len() > LOG_BYTES) {
        std::fs::rename(path, path.with_extension("log.old"))
            .doing("cannot rotate", path.display())?;
    }
    File::options()
        .create(true)
        .append(true)
        .open(path)
        .doing("cannot write", path.display())
}

fn start(command: &WorkerCommand) -> Result<Child, Problem> {
    let log = open_log(&command.log)?;
    let out = log
        .try_clone()
        .doing("cannot write", command.log.display())?;
    Command::new(&command.program)
        .args(&command.args)
        .stdin(Stdio::piped())
        .stdout(out)
        .stderr(log)
        // Its own process group: Ctrl-C reaches ignctl alone, which then ends the workers in order.
        .process_group(0)
        .kill_on_drop(true)
        .spawn()
        .doing("cannot start the worker", command.program.display())
}

async fn end(mut child: Child, name: &str) -> Result<(), Problem> {
    if tokio::time::timeout(GRACE, child.wait()).await.is_err() {
        output::warn(&format!("{name} does not end; killing it"));
        child.kill().await.doing("cannot kill the worker", name)?;
    }
    Ok(())
}

/// The last line that a worker left in its log.
fn last_line(log: &Path) -> String {
    let bytes = std::fs::read(log).unwrap_or_default();
    let text = String::from_utf8_lossy(&bytes[bytes.len().saturating_sub(4096)..]).into_owned();
    text.lines()
        .rev()
        .find(|line| !line.trim().is_empty())
        .map_or_else(|| "its log is empty".to_string(), output::printable)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn command(dir: &Path, script: &str, give_up_after: Option<u32>) -> WorkerCommand {
        WorkerCommand {
            program: "/bin/sh".into(),
            args: vec!["-c".into(), script.into()],
            name: "local-1".into(),
            log: dir.join("worker.log"),
            give_up_after,
        }
    }

    #[tokio::test]
    async fn a_worker_that_cannot_start_is_given_up_with_its_last_words() {
        let dir = tempfile::tempdir().unwrap();
        let (_stop, stopped) = watch::channel(false);
        let command = command(
            dir.path(),
            "echo cannot open libtorch_cpu.so >&2; exit 127",
            Some(2),
        );
        let problem = keep_running(command, stopped).await.unwrap_err();
        assert_eq!(problem.hint, "cannot open libtorch_cpu.so");
    }

    #[tokio::test]
    async fn stopping_closes_stdin_and_the_worker_ends_by_itself() {
        let dir = tempfile::tempdir().unwrap();
        let (stop, stopped) = watch::channel(false);
        let command = command(
            dir.path(),
            "echo up; cat > /dev/null; echo stdin closed",
            None,
        );
        let log = command.log.clone();
        let running = tokio::spawn(keep_running(command, stopped));
        while !std::fs::read_to_string(&log)
            .unwrap_or_default()
            .contains("up")
        {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
        stop.send(true).unwrap();
        running.await.unwrap().unwrap();
        assert!(
            std::fs::read_to_string(&log)
                .unwrap()
                .contains("stdin closed")
        );
    }

    #[tokio::test]
    async fn a_worker_that_dies_is_started_again() {
        let dir = tempfile::tempdir().unwrap();
        let mark = dir.path().join("mark");
        let script = format!(
            "if [ -e {0} ]; then echo second; cat >/dev/null; else touch {0}; fi",
            mark.display()
        );
        let (stop, stopped) = watch::channel(false);
        let command = command(dir.path(), &script, None);
        let log = command.log.clone();
        let running = tokio::spawn(keep_running(command, stopped));
        while !std::fs::read_to_string(&log)
            .unwrap_or_default()
            .contains("second")
        {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
        stop.send(true).unwrap();
        running.await.unwrap().unwrap();
    }
}
