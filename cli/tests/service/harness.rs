//! A service without workers, and `ignctl` run against it.

use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

use serde_json::Value;
use tempfile::TempDir;

/// Longest that anything here may take.
const LIMIT: Duration = Duration::from_secs(30);

/// `ignctl up --workers 0` on a folder of its own; ends with the test.
pub(crate) struct Service {
    up: Child,
    data: PathBuf,
    _own: Option<TempDir>,
}

fn command(args: &[&str], env: &[(&str, &str)]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_ignctl"));
    for name in [
        "IGN_SERVER",
        "IGN_TOKEN_FILE",
        "IGN_DATA",
        "IGN_WORKER",
        "NO_COLOR",
    ] {
        command.env_remove(name);
    }
    command
        .args(args)
        // Not the user's own memory of checksums and uploads.
        .env(
            "XDG_CACHE_HOME",
            concat!(env!("CARGO_TARGET_TMPDIR"), "/cache"),
        )
        .envs(env.iter().copied())
        .stdin(Stdio::null());
    command
}

/// Runs ignctl to its end.
pub(crate) fn run(args: &[&str], env: &[(&str, &str)]) -> Output {
    let streams = [
        tempfile::NamedTempFile::new().unwrap(),
        tempfile::NamedTempFile::new().unwrap(),
    ];
    let mut child = command(args, env)
        .stdout(streams[0].reopen().unwrap())
        .stderr(streams[1].reopen().unwrap())
        .spawn()
        .unwrap();
    let start = Instant::now();
    let status = loop {
        if let Some(status) = child.try_wait().unwrap() {
            break status;
        }
        if start.elapsed() > LIMIT {
            child.kill().unwrap();
        }
        std::thread::sleep(Duration::from_millis(5));
    };
    let [stdout, stderr] = streams.map(|stream| std::fs::read(stream.path()).unwrap());
    Output {
        status,
        stdout,
        stderr,
    }
}

pub(crate) fn stdout(output: &Output) -> String {
    String::from_utf8_lossy(&output.stdout).into_owned()
}

pub(crate) fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

/// A small folder that looks like a capture.
pub(crate) fn capture(parent: &Path, name: &str) -> PathBuf {
    let dir = parent.join(name);
    std::fs::create_dir_all(dir.join("images")).unwrap();
    std::fs::write(dir.join("images/a.jpg"), format!("no picture of {name}")).unwrap();
    // Larger than one part of an upload.
    std::fs::write(dir.join("mesh.ply"), vec![7; 9 << 20]).unwrap();
    dir
}

/// An executable shell script.
pub(crate) fn script(dir: &Path, name: &str, text: &str) -> PathBuf {
    use std::os::unix::fs::PermissionsExt as _;
    let path = dir.join(name);
    std::fs::write(&path, format!("#!/bin/sh\n{text}\n")).unwrap();
    std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o755)).unwrap();
    path
}

pub(crate) fn wait_until<T>(what: &str, mut ready: impl FnMut() -> Option<T>) -> T {
    let start = Instant::now();
    loop {
        if let Some(value) = ready() {
            return value;
        }
        assert!(start.elapsed() < LIMIT, "waited in vain for {what}");
        std::thread::sleep(Duration::from_millis(10));
    }
}

impl Service {
    /// On a new folder.
    pub(crate) fn start() -> Self {
        let own = tempfile::tempdir().unwrap();
        Self {
            up: up(own.path(), "127.0.0.1:0"),
            data: own.path().to_path_buf(),
            _own: Some(own),
        }
    }

    /// On `data`, which outlives it.
    pub(crate) fn on(data: &Path) -> Self {
        Self {
            up: up(data, "127.0.0.1:0"),
            data: data.to_path_buf(),
            _own: None,
        }
    }

    /// What `endpoint.json` says.
    pub(crate) fn url(&self) -> String {
        endpoint(&self.data).unwrap()
    }

    pub(crate) fn token_file(&self) -> PathBuf {
        self.data.join("token")
    }

    /// Runs ignctl against this service.
    pub(crate) fn run(&self, args: &[&str]) -> Output {
        run(
            &[&["--data", self.data.to_str().unwrap()], args].concat(),
            &[],
        )
    }

    /// Starts ignctl against this service; both streams go to `log`.
    pub(crate) fn spawn(&self, args: &[&str], log: &Path) -> Running {
        spawn(
            &[&["--data", self.data.to_str().unwrap()], args].concat(),
            &[],
            log,
        )
    }

    /// The same by address, as from another machine.
    pub(crate) fn spawn_on_server(&self, args: &[&str], log: &Path) -> Running {
        let (url, token) = (self.url(), self.token_file());
        let server = ["--server", &url, "--token-file", token.to_str().unwrap()];
        spawn(&[&server, args].concat(), &[], log)
    }

    /// Waits until there are so many jobs.
    pub(crate) fn wait_for_jobs(&self, count: usize) {
        wait_until("jobs", || {
            let list = self.run(&["jobs", "list", "-o", "json"]);
            let list: Value = serde_json::from_slice(&list.stdout).ok()?;
            (list.as_array()?.len() == count).then_some(())
        });
    }

    /// SIGKILL, then a new process on the same folder and port.
    pub(crate) fn kill_and_restart(&mut self) {
        let listen = self
            .url()
            .trim_start_matches("http://")
            .trim_end_matches('/')
            .to_string();
        self.up.kill().unwrap();
        self.up.wait().unwrap();
        self.up = up(&self.data, &listen);
    }

    /// Changes a byte of every stored blob that holds `text`.
    pub(crate) fn damage_blob(&self, text: &str) {
        let mut damaged = 0;
        for entry in walkdir::WalkDir::new(self.data.join("store")) {
            let path = entry.unwrap().into_path();
            let Ok(mut bytes) = std::fs::read(&path) else {
                continue;
            };
            if let Some(at) = bytes
                .windows(text.len())
                .position(|window| window == text.as_bytes())
            {
                bytes[at] ^= 1;
                std::fs::write(&path, bytes).unwrap();
                damaged += 1;
            }
        }
        assert!(damaged > 0, "no blob holds {text:?}");
    }
}

impl Drop for Service {
    fn drop(&mut self) {
        signal(&self.up, rustix::process::Signal::TERM);
        let start = Instant::now();
        while self.up.try_wait().unwrap().is_none() {
            if start.elapsed() > LIMIT {
                self.up.kill().unwrap();
            }
            std::thread::sleep(Duration::from_millis(10));
        }
    }
}

fn endpoint(data: &Path) -> Option<String> {
    let text = std::fs::read_to_string(data.join("endpoint.json")).ok()?;
    let endpoint: Value = serde_json::from_str(&text).ok()?;
    Some(endpoint["url"].as_str()?.to_string())
}

fn up(data: &Path, listen: &str) -> Child {
    let args = [
        "--data",
        data.to_str().unwrap(),
        "up",
        "--workers",
        "0",
        "--listen",
        listen,
    ];
    std::fs::create_dir_all(data).unwrap();
    let log = std::fs::File::options()
        .create(true)
        .append(true)
        .open(data.join("up.log"))
        .unwrap();
    let mut up = command(&args, &[])
        .stdout(Stdio::null())
        .stderr(log)
        .spawn()
        .unwrap();
    wait_until("the service", || {
        let ended = up.try_wait().unwrap();
        assert!(
            ended.is_none(),
            "{}",
            std::fs::read_to_string(data.join("up.log")).unwrap()
        );
        let text = std::fs::read_to_string(data.join("endpoint.json")).ok()?;
        let endpoint: Value = serde_json::from_str(&text).ok()?;
        (endpoint["pid"] == up.id()).then_some(())
    });
    up
}

fn signal(child: &Child, signal: rustix::process::Signal) {
    let pid = rustix::process::Pid::from_raw(child.id() as i32).unwrap();
    // It may have ended already.
    let _sent = rustix::process::kill_process(pid, signal);
}

/// ignctl in the background.
pub(crate) struct Running {
    child: Child,
    log: PathBuf,
}

/// Starts ignctl; both streams go to `log`.
pub(crate) fn spawn(args: &[&str], env: &[(&str, &str)], log: &Path) -> Running {
    let out = std::fs::File::create(log).unwrap();
    let child = command(args, env)
        .stdout(out.try_clone().unwrap())
        .stderr(out)
        .spawn()
        .unwrap();
    Running {
        child,
        log: log.to_path_buf(),
    }
}

impl Running {
    fn said(&self) -> String {
        std::fs::read_to_string(&self.log).unwrap()
    }

    /// Ctrl-C once it has said `ready`; what it said in all.
    pub(crate) fn interrupt(mut self, ready: &str) -> String {
        wait_until(ready, || {
            let ended = self.child.try_wait().unwrap();
            assert!(ended.is_none(), "{}", self.said());
            self.said().contains(ready).then_some(())
        });
        signal(&self.child, rustix::process::Signal::INT);
        let (code, said) = self.ended();
        assert_eq!(code, Some(1), "{said}");
        said
    }

    /// Waits for its end; exit code and what it said.
    pub(crate) fn ended(mut self) -> (Option<i32>, String) {
        let status = wait_until("the end", || self.child.try_wait().unwrap());
        (status.code(), self.said())
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        if self.child.try_wait().unwrap().is_none() {
            self.child.kill().unwrap();
            self.child.wait().unwrap();
        }
    }
}
