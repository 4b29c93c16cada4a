//! Child processes that end with the test, and waiting with a limit.

use std::ffi::OsStr;
use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::thread::sleep;
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, bail, ensure};
use rustix::process::{Pid, Signal, kill_process};

/// Lines of a log that a failing test prints.
const LOG_TAIL: usize = 60;

/// A program of the workspace: in `IGN_BIN_DIR`, or where cargo puts it beside the tests.
pub fn program(name: &str) -> Result<PathBuf> {
    let dir = if let Some(dir) = std::env::var_os("IGN_BIN_DIR") {
        PathBuf::from(dir)
    } else {
        let test = std::env::current_exe()?;
        test.ancestors()
            .nth(2)
            .context("the test lies in no target folder")?
            .to_owned()
    };
    let path = dir.join(name);
    ensure!(
        path.is_file(),
        "{} is not built: run `cargo build --workspace --all-targets` first",
        path.display()
    );
    Ok(path)
}

/// A running program whose output goes to a file.
#[derive(Debug)]
pub struct Process {
    name: String,
    child: Child,
    log: PathBuf,
}

impl Process {
    /// Starts `program`; stdin is a pipe that closes when the [`Process`] is dropped. `log` is appended to.
    pub fn start<A: AsRef<OsStr>>(
        name: &str,
        program: &Path,
        args: impl IntoIterator<Item = A>,
        env: impl IntoIterator<Item = (String, String)>,
        log: &Path,
    ) -> Result<Self> {
        let out = File::options().create(true).append(true).open(log)?;
        // `setpriv` becomes the program (same process id), which then dies with the thread that runs the test.
        let mut command = Command::new("setpriv");
        let child = command
            .args(["--pdeathsig", "KILL"])
            .arg(program)
            .args(args)
            .envs(env)
            .stdin(Stdio::piped())
            .stdout(out.try_clone()?)
            .stderr(out)
            .spawn()
            .with_context(|| {
                format!(
                    "cannot start {} (through setpriv of util-linux)",
                    program.display()
                )
            })?;
        Ok(Self {
            name: name.to_owned(),
            child,
            log: log.to_owned(),
        })
    }

    /// Process id.
    pub fn pid(&self) -> u32 {
        self.child.id()
    }

    /// Its name in this test.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Whether it still runs.
    pub fn is_running(&mut self) -> bool {
        matches!(self.child.try_wait(), Ok(None))
    }

    /// Everything it has printed.
    pub fn output(&self) -> String {
        fs::read_to_string(&self.log).unwrap_or_default()
    }

    /// SIGKILL, then waits until the process is gone.
    pub fn kill(&mut self) -> Result<()> {
        self.child.kill()?;
        self.child.wait()?;
        Ok(())
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        // Already gone is as good.
        let _already_gone = self.child.kill();
        let _reaped = self.child.wait();
        let text = self.output();
        let lines: Vec<&str> = text.lines().collect();
        let tail = lines[lines.len().saturating_sub(LOG_TAIL)..].join("\n");
        report(&format!(
            "--- last lines of {} ({})\n{tail}\n---",
            self.name,
            self.log.display()
        ));
    }
}

#[expect(
    clippy::print_stderr,
    reason = "shown with a failed test, swallowed with a good one"
)]
fn report(text: &str) {
    eprintln!("{text}");
}

/// Runs a program to its end within `limit`; its output, whatever the status.
pub fn run(command: &mut Command, limit: Duration) -> Result<Output> {
    let what = format!("{command:?}");
    let dir = tempfile::tempdir()?;
    let (out, err) = (dir.path().join("out"), dir.path().join("err"));
    let mut child = command
        .stdin(Stdio::null())
        .stdout(File::create(&out)?)
        .stderr(File::create(&err)?)
        .spawn()
        .with_context(|| format!("cannot start {what}"))?;
    let deadline = Instant::now() + limit;
    let status = loop {
        if let Some(status) = child.try_wait()? {
            break status;
        }
        if Instant::now() > deadline {
            child.kill()?;
            child.wait()?;
            bail!(
                "{what} took longer than {limit:?}: {}",
                fs::read_to_string(&err).unwrap_or_default()
            );
        }
        sleep(Duration::from_millis(20));
    };
    Ok(Output {
        status,
        stdout: fs::read(out)?,
        stderr: fs::read(err)?,
    })
}

/// Calls `probe` until it gives something; `what` names what was waited for when `limit` has passed.
pub fn wait_until<T>(
    what: &str,
    limit: Duration,
    mut probe: impl FnMut() -> Result<Option<T>>,
) -> Result<T> {
    let deadline = Instant::now() + limit;
    loop {
        if let Some(value) = probe()? {
            return Ok(value);
        }
        ensure!(
            Instant::now() < deadline,
            "waited {limit:?} in vain for {what}"
        );
        sleep(Duration::from_millis(100));
    }
}

/// Process ids of all children of `pid` and of theirs.
pub fn descendants(pid: u32) -> Result<Vec<u32>> {
    let mut parents = Vec::new();
    for entry in fs::read_dir("/proc")? {
        let entry = entry?;
        let Some(child) = entry
            .file_name()
            .to_str()
            .and_then(|name| name.parse::<u32>().ok())
        else {
            continue;
        };
        // Gone meanwhile: not a child any more.
        let Ok(stat) = fs::read_to_string(entry.path().join("stat")) else {
            continue;
        };
        // The name in parentheses may hold anything; state and parent follow it.
        let parent = stat
            .rsplit_once(')')
            .and_then(|(_, rest)| rest.split_whitespace().nth(1)?.parse::<u32>().ok());
        parents.extend(parent.map(|parent| (child, parent)));
    }
    let mut found = vec![pid];
    let mut at = 0;
    while at < found.len() {
        let of = found[at];
        found.extend(
            parents
                .iter()
                .filter(|(_, parent)| *parent == of)
                .map(|(child, _)| *child),
        );
        at += 1;
    }
    found.remove(0);
    Ok(found)
}

/// SIGKILL to a process that this test's processes started; gone already is as good.
pub fn kill_now(pid: u32) -> Result<()> {
    let pid = Pid::from_raw(i32::try_from(pid)?).context("no process has id 0")?;
    match kill_process(pid, Signal::KILL) {
        Ok(()) | Err(rustix::io::Errno::SRCH) => Ok(()),
        Err(error) => Err(error.into()),
    }
}

/// A path as an argument.
pub fn path(path: &Path) -> Result<&str> {
    path.to_str().context("the path is no UTF-8")
}
