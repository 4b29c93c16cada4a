//! A throw-away Postgres cluster.
//!
//! The server runs under a small shell that holds the read end of a pipe from us: when the pipe closes, because the
//! [`Postgres`] was dropped or because the test process died in whatever way, the shell stops the server (its own
//! child, by process id) and removes the folder. Nothing is left behind by `kill -9`.
//!
//! Postgres refuses to run as root, so a root test runs it as the user `postgres`, which the distribution's package
//! makes.

use std::io::Write;
use std::net::TcpListener;
use std::os::unix::fs::{MetadataExt, PermissionsExt as _};
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Mutex, OnceLock};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, anyhow, bail};

const INSTALL_HINT: &str = "install Postgres: apt-get install -y postgresql (Debian, Ubuntu), \
     or set IGN_POSTGRES_BIN to the folder that holds initdb and postgres";

/// Runs the server until the pipe on stdin closes or says `stop`. Arguments: folder, server program and its arguments.
const SUPERVISOR: &str = r#"
dir=$1; shift
"$@" >>"$dir/log" 2>&1 </dev/null &
server=$!
word=gone
read -r word
case "$word" in
    fast) kill -INT $server ;;
    *) kill -QUIT $server ;;
esac
wait $server
case "$word" in
    fast|stop) ;;
    *) rm -rf "$dir" ;;
esac
"#;

/// A running cluster; stopped and removed when dropped.
#[derive(Debug)]
pub struct Postgres {
    bin: PathBuf,
    dir: PathBuf,
    port: u16,
    server: Mutex<Option<Child>>,
    databases: AtomicU32,
    tls: bool,
    durable: bool,
}

impl Postgres {
    /// Makes a new cluster and starts it. Takes about a second. What it commits outlives a crash of its processes, not one
    /// of the machine: tests do not wait for the disk.
    pub fn start() -> Result<Self> {
        Self::make(None, false)
    }

    /// The same, for connections over TLS alone: with this certificate and its key, in PEM.
    pub fn start_with_tls(certificate: &str, key: &str) -> Result<Self> {
        Self::make(Some((certificate, key)), false)
    }

    /// The same with Postgres's own settings for durability, for measuring what it reaches.
    pub fn start_durable() -> Result<Self> {
        Self::make(None, true)
    }

    fn make(tls: Option<(&str, &str)>, durable: bool) -> Result<Self> {
        let bin = find_binaries()?;
        let dir = tempfile::Builder::new().prefix("ign-pg-").tempdir()?.keep();
        let cluster = Self {
            bin,
            dir,
            port: free_port()?,
            server: Mutex::new(None),
            databases: AtomicU32::new(0),
            tls: tls.is_some(),
            durable,
        };
        if is_root()? {
            run(Command::new("chown").arg("postgres").arg(&cluster.dir))
                .context("user postgres is missing")
                .context(INSTALL_HINT)?;
        }
        run(unprivileged(&cluster.bin.join("initdb"))?
            .arg("--pgdata")
            .arg(cluster.data())
            .args([
                "--username=postgres",
                "--auth=trust",
                "--encoding=UTF8",
                "--locale=C",
                "--no-sync",
            ]))?;
        if let Some((certificate, key)) = tls {
            cluster.write("server.crt", certificate)?;
            cluster.write("server.key", key)?;
            cluster.write(
                "pg_hba.conf",
                "local all all trust\nhostssl all all 127.0.0.1/32 trust\n",
            )?;
        }
        cluster.launch()?;
        Ok(cluster)
    }

    /// Writes a file of the cluster, as its server wants it.
    fn write(&self, name: &str, text: &str) -> Result<()> {
        let path = self.data().join(name);
        std::fs::write(&path, text)?;
        std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o600))?;
        if is_root()? {
            run(Command::new("chown").arg("postgres").arg(&path))?;
        }
        Ok(())
    }

    /// The cluster that all tests of this process share, started by the first caller.
    pub fn shared() -> Result<&'static Self> {
        static SHARED: OnceLock<Result<Postgres, String>> = OnceLock::new();
        SHARED
            .get_or_init(|| Self::start().map_err(|error| format!("{error:#}")))
            .as_ref()
            .map_err(|message| anyhow!("{message}"))
    }

    /// Makes an empty database with a name of its own; returns its URL.
    pub fn create_database(&self) -> Result<String> {
        let name = format!(
            "test_{}_{}",
            std::process::id(),
            self.databases.fetch_add(1, Ordering::Relaxed)
        );
        self.execute("postgres", &format!("create database {name}"))?;
        Ok(self.url(&name))
    }

    /// URL of a database in this cluster.
    pub fn url(&self, database: &str) -> String {
        format!("postgres://postgres@127.0.0.1:{}/{database}", self.port)
    }

    /// Folder of the server programs (`pgbench`, `pg_dump`, ...).
    pub fn bin(&self) -> &Path {
        &self.bin
    }

    /// Runs SQL through psql; returns its unaligned output.
    pub fn execute(&self, database: &str, sql: &str) -> Result<String> {
        run(Command::new(self.bin.join("psql"))
            .args([
                "--no-psqlrc",
                "--quiet",
                "--tuples-only",
                "--no-align",
                "--set=ON_ERROR_STOP=1",
            ])
            .arg("--dbname")
            .arg(self.url(database))
            .args(["--command", sql]))
    }

    /// Stops the server as a crash would (no checkpoint, sessions cut); data stay.
    pub fn stop(&self) -> Result<()> {
        self.halt("stop")
    }

    /// Starts a stopped server again on the same port.
    pub fn resume(&self) -> Result<()> {
        self.launch()
    }

    /// Cuts every session and starts again, as after a crash; same port, same data.
    pub fn restart(&self) -> Result<()> {
        self.stop()?;
        self.resume()
    }

    fn data(&self) -> PathBuf {
        self.dir.join("data")
    }

    fn launch(&self) -> Result<()> {
        let mut server = self
            .server
            .lock()
            .map_err(|_poisoned| anyhow!("an earlier start panicked"))?;
        if server.is_some() {
            bail!("postgres is running already");
        }
        let child = unprivileged(Path::new("sh"))?
            .args(["-c", SUPERVISOR, "postgres-supervisor"])
            .arg(&self.dir)
            .arg(self.bin.join("postgres"))
            .arg("-D")
            .arg(self.data())
            .arg("-k")
            .arg(&self.dir)
            .args(["-h", "127.0.0.1", "-p", &self.port.to_string()])
            .args(["-c", "max_connections=300"])
            .args(["-c", if self.tls { "ssl=on" } else { "ssl=off" }])
            .args(if self.durable {
                &[][..]
            } else {
                &["-c", "fsync=off", "-c", "full_page_writes=off"]
            })
            .stdin(Stdio::piped())
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .process_group(0)
            .spawn()
            .context("cannot start postgres")?;
        *server = Some(child);
        drop(server);
        let deadline = Instant::now() + Duration::from_secs(30);
        while self.execute("postgres", "select 1").is_err() {
            if Instant::now() > deadline {
                let log = std::fs::read_to_string(self.dir.join("log")).unwrap_or_default();
                bail!("postgres did not start within 30 s; its log:\n{log}");
            }
            std::thread::sleep(Duration::from_millis(30));
        }
        Ok(())
    }

    fn halt(&self, word: &str) -> Result<()> {
        let child = self
            .server
            .lock()
            .map_err(|_poisoned| anyhow!("an earlier start panicked"))?
            .take();
        let Some(mut child) = child else {
            return Ok(());
        };
        if let Some(mut stdin) = child.stdin.take()
            && !word.is_empty()
        {
            writeln!(stdin, "{word}")?;
        }
        child.wait()?;
        Ok(())
    }
}

impl Drop for Postgres {
    fn drop(&mut self) {
        let was_running = self.server.get_mut().is_ok_and(|server| server.is_some());
        // A failure here leaves the supervisor to do it when this process ends.
        self.halt("").ok();
        if !was_running {
            std::fs::remove_dir_all(&self.dir).ok();
        }
    }
}

/// A command that does not run as root: `program` itself, or the same as user `postgres`.
fn unprivileged(program: &Path) -> Result<Command> {
    let mut command = if is_root()? {
        let mut command = Command::new("setpriv");
        command
            .args([
                "--reuid=postgres",
                "--regid=postgres",
                "--clear-groups",
                "--",
            ])
            .arg(program);
        command
    } else {
        Command::new(program)
    };
    command.current_dir("/");
    Ok(command)
}

fn is_root() -> Result<bool> {
    Ok(std::fs::metadata("/proc/self")
        .context("no /proc to learn the user from")?
        .uid()
        == 0)
}

fn find_binaries() -> Result<PathBuf> {
    if let Some(bin) = std::env::var_os("IGN_POSTGRES_BIN") {
        return Ok(bin.into());
    }
    let mut found: Vec<(u32, PathBuf)> = std::fs::read_dir("/usr/lib/postgresql")
        .into_iter()
        .flatten()
        .flatten()
        .filter_map(|entry| {
            Some((
                entry.file_name().to_str()?.parse().ok()?,
                entry.path().join("bin"),
            ))
        })
        .filter(|(_, bin): &(u32, PathBuf)| bin.join("initdb").exists())
        .collect();
    found.sort();
    found
        .pop()
        .map(|(_, bin)| bin)
        .context("no Postgres found in /usr/lib/postgresql")
        .context(INSTALL_HINT)
}

fn free_port() -> Result<u16> {
    Ok(TcpListener::bind("127.0.0.1:0")?.local_addr()?.port())
}

fn run(command: &mut Command) -> Result<String> {
    let output = command
        .stdin(Stdio::null())
        .output()
        .with_context(|| format!("cannot run {command:?}"))?;
    if !output.status.success() {
        bail!(
            "{command:?} failed: {}",
            String::from_utf8_lossy(&output.stderr).trim()
        );
    }
    Ok(String::from_utf8_lossy(&output.stdout).trim().to_owned())
}
