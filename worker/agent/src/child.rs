//! One child process: start it, read its lines, see how it ends, kill it.
//!
//! Invariants:
//! - The child's stdin stays open as long as its [`Child`] lives. The child exits at end of file there, so it cannot
//!   outlive an agent that was killed.
//! - The child leads its own process group. A Ctrl-C in the agent's terminal does not reach it, and whatever it
//!   starts dies with it.
//! - Memory is bounded whatever the child prints: lines are cut, queues are short, a child that prints faster than
//!   its lines are read waits in `write`.

use std::collections::VecDeque;
use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::process::{ExitStatus, Stdio};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use ign_events::Event;
use rustix::process::{Pid, Signal};
use tokio::io::{AsyncBufRead, AsyncBufReadExt, BufReader};
use tokio::process::ChildStdin;
use tokio::sync::mpsc;
use tokio::task::JoinSet;

/// Program and first arguments of the child; the job file's path is appended.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ChildCommand {
    /// Executable.
    pub program: PathBuf,
    /// Arguments before the job file.
    pub args: Vec<OsString>,
    /// Added to the agent's environment.
    pub envs: Vec<(OsString, OsString)>,
}

impl ChildCommand {
    /// This very program as `exec --job FILE`.
    ///
    /// # Errors
    /// The path of the running program is not known.
    pub fn current_exe() -> std::io::Result<Self> {
        Ok(Self {
            program: std::env::current_exe()?,
            args: vec!["exec".into(), "--job".into()],
            envs: Vec::new(),
        })
    }
}

/// A line longer than this is cut; an event of this size would be a mistake.
const MAX_LINE_BYTES: usize = 1 << 20;
/// Lines of stderr kept for the report of a crash.
const TAIL_LINES: usize = 20;
/// How long the pipes may stay open after the child has ended.
const PIPE_GRACE: Duration = Duration::from_secs(2);

/// What a child says.
#[derive(Debug, PartialEq)]
pub(crate) enum Output {
    Event(Event),
    /// Any other line, from stdout or stderr.
    Text(String),
}

#[derive(Debug)]
pub(crate) struct Child {
    process: tokio::process::Child,
    group: Option<Pid>,
    /// Held, never written.
    _stdin: Option<ChildStdin>,
    output: mpsc::Receiver<Output>,
    tail: Arc<Mutex<VecDeque<String>>>,
    status: Option<ExitStatus>,
    /// Reader tasks; they end with the pipes, or with this value.
    _readers: JoinSet<()>,
}

impl Child {
    /// Starts `command` on `job_file` in `dir`, with `threads` for every numeric library that reads them from the
    /// environment, and the trace that this task works under.
    pub(crate) fn spawn(
        command: &ChildCommand,
        job_file: &Path,
        dir: &Path,
        threads: usize,
    ) -> std::io::Result<Self> {
        let threads = threads.to_string();
        let mut process = tokio::process::Command::new(&command.program)
            .args(&command.args)
            .arg(job_file)
            .current_dir(dir)
            .env("OMP_NUM_THREADS", &threads)
            .env("MKL_NUM_THREADS", &threads)
            .env("RAYON_NUM_THREADS", &threads)
            .envs(command.envs.iter().map(|(name, value)| (name, value)))
            .env_remove(ign_trace::VARIABLE)
            .envs(ign_trace::current().map(|trace| (ign_trace::VARIABLE, trace.to_string())))
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .process_group(0)
            .kill_on_drop(true)
            .spawn()?;
        let group = process
            .id()
            .and_then(|id| Pid::from_raw(i32::try_from(id).ok()?));
        let stdin = process.stdin.take();
        let (sender, output) = mpsc::channel(64);
        let tail = Arc::new(Mutex::new(VecDeque::new()));
        let mut readers = JoinSet::new();
        if let Some(stdout) = process.stdout.take() {
            let sender = sender.clone();
            readers.spawn(async move {
                let mut lines = Lines::new(BufReader::new(stdout));
                while let Some(line) = lines.next().await {
                    let output = match Event::from_line(&line) {
                        Some(event) => Output::Event(event),
                        None => Output::Text(line),
                    };
                    if sender.send(output).await.is_err() {
                        return;
                    }
                }
            });
        }
        if let Some(stderr) = process.stderr.take() {
            let tail = Arc::clone(&tail);
            readers.spawn(async move {
                let mut lines = Lines::new(BufReader::new(stderr));
                while let Some(line) = lines.next().await {
                    {
                        let mut tail = tail.lock().unwrap_or_else(PoisonError::into_inner);
                        if tail.len() == TAIL_LINES {
                            tail.pop_front();
                        }
                        tail.push_back(crate::logs::cut(&line, 1000).to_owned());
                    }
                    if sender.send(Output::Text(line)).await.is_err() {
                        return;
                    }
                }
            });
        }
        Ok(Self {
            process,
            group,
            _stdin: stdin,
            output,
            tail,
            status: None,
            _readers: readers,
        })
    }

    /// The next line; `None` once the child has ended and everything it said was read. Cancel-safe.
    pub(crate) async fn next(&mut self) -> Option<Output> {
        if self.status.is_none() {
            tokio::select! {
                biased;
                output = self.output.recv() => match output {
                    Some(output) => return Some(output),
                    // Both pipes are closed; the child may still run.
                    None => self.wait().await,
                },
                status = self.process.wait() => self.ended(status),
            }
        }
        // A grandchild may hold the pipes; it is dead by now, or not ours to wait for.
        tokio::time::timeout(PIPE_GRACE, self.output.recv())
            .await
            .unwrap_or(None)
    }

    /// Waits until the child has ended.
    pub(crate) async fn wait(&mut self) {
        if self.status.is_none() {
            let status = self.process.wait().await;
            self.ended(status);
        }
    }

    /// Kills the child and everything it started, and waits until it is gone.
    pub(crate) async fn kill(&mut self) {
        self.kill_group();
        self.wait().await;
    }

    /// How the child ended, in words.
    pub(crate) fn ending(&self) -> Ending {
        let tail = self.tail.lock().unwrap_or_else(PoisonError::into_inner);
        Ending {
            status: self.status,
            last_lines: tail.iter().cloned().collect(),
        }
    }

    fn ended(&mut self, status: std::io::Result<ExitStatus>) {
        self.kill_group();
        self.group = None;
        self.status = Some(status.unwrap_or_default());
    }

    fn kill_group(&self) {
        if let Some(group) = self.group {
            // The group may be gone already.
            rustix::process::kill_process_group(group, Signal::KILL).ok();
        }
    }
}

impl Drop for Child {
    fn drop(&mut self) {
        self.kill_group();
    }
}

/// How a child ended without saying so itself.
#[derive(Clone, Debug)]
pub(crate) struct Ending {
    pub(crate) status: Option<ExitStatus>,
    pub(crate) last_lines: Vec<String>,
}

impl Ending {
    /// `was killed by signal 9 (SIGKILL)` or `exited with code 3`.
    pub(crate) fn describe(&self) -> String {
        use std::os::unix::process::ExitStatusExt;
        let Some(status) = self.status else {
            return "ended".to_owned();
        };
        match (status.signal(), status.code()) {
            (Some(signal), _) => match signal_name(signal) {
                Some(name) => format!("was killed by signal {signal} ({name})"),
                None => format!("was killed by signal {signal}"),
            },
            (None, Some(code)) => format!("exited with code {code}"),
            (None, None) => "ended".to_owned(),
        }
    }

    /// The kernel's out-of-memory killer looks like this.
    pub(crate) fn was_killed(&self) -> bool {
        use std::os::unix::process::ExitStatusExt;
        self.status.and_then(|status| status.signal()) == Some(Signal::KILL.as_raw())
    }
}

fn signal_name(signal: i32) -> Option<&'static str> {
    [
        (Signal::ABORT, "SIGABRT"),
        (Signal::BUS, "SIGBUS"),
        (Signal::FPE, "SIGFPE"),
        (Signal::HUP, "SIGHUP"),
        (Signal::ILL, "SIGILL"),
        (Signal::INT, "SIGINT"),
        (Signal::KILL, "SIGKILL"),
        (Signal::PIPE, "SIGPIPE"),
        (Signal::SEGV, "SIGSEGV"),
        (Signal::TERM, "SIGTERM"),
        (Signal::XCPU, "SIGXCPU"),
    ]
    .into_iter()
    .find_map(|(known, name)| (known.as_raw() == signal).then_some(name))
}

/// Lines of bounded length from a pipe; the rest of a longer line is skipped.
struct Lines<R> {
    reader: R,
}

impl<R: AsyncBufRead + Unpin> Lines<R> {
    fn new(reader: R) -> Self {
        Self { reader }
    }

    /// The next line without its end, or `None` at end of file. A read error ends the lines as well.
    async fn next(&mut self) -> Option<String> {
        let mut line = Vec::new();
        loop {
            let Ok(available) = self.reader.fill_buf().await else {
                return None;
            };
            if available.is_empty() {
                return (!line.is_empty()).then(|| text(&line));
            }
            let end = available.iter().position(|&byte| byte == b'\n');
            let piece = &available[..end.unwrap_or(available.len())];
            let room = MAX_LINE_BYTES - line.len();
            line.extend_from_slice(&piece[..piece.len().min(room)]);
            let used = piece.len() + usize::from(end.is_some());
            self.reader.consume(used);
            if end.is_some() {
                return Some(text(&line));
            }
        }
    }
}

/// What a terminal would show of this line in the end: progress bars overwrite themselves after a carriage return.
fn text(line: &[u8]) -> String {
    let text = String::from_utf8_lossy(line);
    let text = text.trim_end();
    text.rsplit('\r').next().unwrap_or(text).to_owned()
}

#[cfg(test)]
mod tests {
    use ign_events::{Failure, FailureKind};

    use super::*;

    fn shell(script: &str) -> Child {
        let command = ChildCommand {
            program: "/bin/sh".into(),
            args: vec!["-c".into(), script.into()],
            envs: vec![("IGN_TEST".into(), "set".into())],
        };
        Child::spawn(&command, Path::new("job.json"), Path::new("/"), 3).unwrap()
    }

    async fn all(child: &mut Child) -> Vec<Output> {
        let mut outputs = Vec::new();
        while let Some(output) = child.next().await {
            outputs.push(output);
        }
        outputs
    }

    fn alive(pid: &str) -> bool {
        let state = std::fs::read_to_string(format!("/proc/{pid}/stat")).unwrap_or_default();
        !state.is_empty() && !state.contains(") Z ")
    }

    #[tokio::test]
    async fn events_and_garbage_are_told_apart() {
        let mut child = shell(
            r#"echo loading; echo '{"event":"done","bundle":"/b"}'; printf '\377\376 half {"event"'; echo "$OMP_NUM_THREADS $0 $IGN_TEST" >&2"#,
        );
        let outputs = all(&mut child).await;
        assert!(
            outputs.contains(&Output::Text("loading".into())),
            "{outputs:?}"
        );
        assert!(outputs.contains(&Output::Event(Event::Done {
            bundle: "/b".into()
        })));
        assert!(
            outputs.contains(&Output::Text("3 job.json set".into())),
            "{outputs:?}"
        );
        assert_eq!(outputs.len(), 4, "{outputs:?}");
        assert_eq!(child.ending().describe(), "exited with code 0");
        assert_eq!(child.ending().last_lines, ["3 job.json set"]);
    }

    #[tokio::test]
    async fn a_failure_event_is_read_before_the_exit() {
        let mut child = shell(
            r#"echo '{"event":"failed","kind":"invalid_input","message":"no mesh","hint":"add mesh.ply"}'; exit 1"#,
        );
        assert_eq!(
            all(&mut child).await,
            [Output::Event(Event::Failed(Failure {
                kind: FailureKind::InvalidInput,
                message: "no mesh".into(),
                at: String::new(),
                hint: "add mesh.ply".into(),
            }))]
        );
        assert_eq!(child.ending().describe(), "exited with code 1");
    }

    #[tokio::test]
    async fn a_crash_names_its_signal_and_last_words() {
        let mut child = shell(
            "for i in 1 2 3 4 5 6 7 8 9 10 11 12 13 14 15 16 17 18 19 20 21 22; do echo $i >&2; done; kill -SEGV $$",
        );
        all(&mut child).await;
        let ending = child.ending();
        assert_eq!(ending.describe(), "was killed by signal 11 (SIGSEGV)");
        assert_eq!(ending.last_lines.len(), TAIL_LINES);
        assert_eq!(ending.last_lines.last().unwrap(), "22");
        assert!(!ending.was_killed());
    }

    #[tokio::test]
    async fn killing_takes_the_whole_family() {
        let mut child = shell("sleep 1000 & echo $!; wait");
        let Some(Output::Text(grandchild)) = child.next().await else {
            panic!("no line")
        };
        assert!(alive(&grandchild));
        child.kill().await;
        assert!(child.ending().was_killed());
        assert_eq!(child.next().await, None);
        for _ in 0..100 {
            if !alive(&grandchild) {
                return;
            }
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
        panic!("process {grandchild} is still alive");
    }

    #[tokio::test]
    async fn a_grandchild_that_keeps_the_pipes_does_not_hold_us() {
        let started = std::time::Instant::now();
        let mut child = shell("sleep 1000 & exit 4");
        assert_eq!(all(&mut child).await, []);
        assert_eq!(child.ending().describe(), "exited with code 4");
        assert!(started.elapsed() < Duration::from_secs(30));
    }

    #[tokio::test]
    async fn stdin_stays_open_until_the_child_is_dropped() {
        let mut child = shell("echo $$; cat >/dev/null; sleep 1000");
        let Some(Output::Text(pid)) = child.next().await else {
            panic!("no line")
        };
        let quiet = tokio::time::timeout(Duration::from_millis(200), child.next()).await;
        assert!(quiet.is_err(), "the child ended: {quiet:?}");
        drop(child);
        for _ in 0..100 {
            if !alive(&pid) {
                return;
            }
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
        panic!("process {pid} outlived its handle");
    }

    #[tokio::test]
    async fn endless_lines_and_floods_stay_bounded() {
        let mut child =
            shell("head -c 5000000 /dev/zero | tr '\\0' x; echo; yes | head -n 100000; echo end");
        let outputs = all(&mut child).await;
        let Output::Text(first) = &outputs[0] else {
            panic!("{:?}", outputs.len())
        };
        assert_eq!(first.len(), MAX_LINE_BYTES);
        assert_eq!(outputs.len(), 100_002);
        assert_eq!(outputs.last(), Some(&Output::Text("end".into())));
    }

    #[tokio::test]
    async fn a_missing_program_is_an_error() {
        let command = ChildCommand {
            program: "/no/such/program".into(),
            args: Vec::new(),
            envs: Vec::new(),
        };
        assert!(Child::spawn(&command, Path::new("job.json"), Path::new("/"), 1).is_err());
    }

    #[test]
    fn only_the_last_state_of_a_progress_bar_counts() {
        assert_eq!(text(b"10%\r 20%\r 30%\n"), " 30%");
        assert_eq!(text(b"plain\r\n"), "plain");
    }
}
