//! One coordinator as a process, which can be killed and started again.

use std::collections::BTreeMap;
use std::io::{Read as _, Write as _};
use std::net::{TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Result, ensure};

use crate::process::{Process, path, program};

const START_LIMIT: Duration = Duration::from_mins(1);

/// How a coordinator is started; the same each time.
#[derive(Clone, Debug)]
pub struct Setup {
    /// Name in logs; `NAME.log` lies in `dir`.
    pub name: String,
    /// Where its log lies.
    pub dir: PathBuf,
    /// `--database`.
    pub database: String,
    /// `--store`.
    pub store: String,
    /// `--token-file`.
    pub token_file: PathBuf,
    /// More arguments.
    pub args: Vec<String>,
    /// Environment, beside that of the test.
    pub env: BTreeMap<String, String>,
}

/// A coordinator that listens on one address for its whole life, as behind a service name.
#[derive(Debug)]
pub struct Coordinator {
    process: Process,
    setup: Setup,
    listen: String,
}

impl Coordinator {
    /// Starts it; it may not be ready yet, see [`Coordinator::await_ready`].
    pub fn start(setup: Setup) -> Result<Self> {
        let listen = TcpListener::bind("127.0.0.1:0")?.local_addr()?.to_string();
        let process = launch(&setup, &listen, None)?;
        Ok(Self {
            process,
            setup,
            listen,
        })
    }

    /// `127.0.0.1:PORT`.
    pub fn address(&self) -> &str {
        &self.listen
    }

    /// `http://127.0.0.1:PORT`.
    pub fn url(&self) -> String {
        format!("http://{}", self.listen)
    }

    /// Process id.
    pub fn pid(&self) -> u32 {
        self.process.pid()
    }

    /// Everything it has printed.
    pub fn output(&self) -> String {
        self.process.output()
    }

    /// Whether it still runs.
    pub fn is_running(&mut self) -> bool {
        self.process.is_running()
    }

    /// Kills it with SIGKILL.
    pub fn kill(&mut self) -> Result<()> {
        self.process.kill()
    }

    /// Kills it and starts another on the same address, armed with `fault`. It may die before it is ready.
    pub fn replace(&mut self, fault: Option<&str>) -> Result<()> {
        self.process.kill()?;
        self.process = launch(&self.setup, &self.listen, fault)?;
        Ok(())
    }

    /// Waits until database and store answer it.
    pub fn await_ready(&mut self) -> Result<()> {
        let begun = Instant::now();
        while !self.is_ready() {
            ensure!(
                self.process.is_running(),
                "the coordinator ended:\n{}",
                self.process.output()
            );
            ensure!(
                begun.elapsed() < START_LIMIT,
                "the coordinator is not ready"
            );
            std::thread::sleep(Duration::from_millis(20));
        }
        Ok(())
    }

    fn is_ready(&self) -> bool {
        let ask = || -> std::io::Result<Vec<u8>> {
            let mut socket = TcpStream::connect(&self.listen)?;
            socket.set_read_timeout(Some(START_LIMIT))?;
            socket.write_all(b"GET /readyz HTTP/1.0\r\nHost: ign\r\n\r\n")?;
            let mut answer = vec![0; 12];
            socket.read_exact(&mut answer)?;
            Ok(answer)
        };
        ask().is_ok_and(|answer| answer.ends_with(b" 200"))
    }
}

fn launch(setup: &Setup, listen: &str, fault: Option<&str>) -> Result<Process> {
    let token_file = path(&setup.token_file)?;
    let args = [
        "--listen",
        listen,
        "--database",
        &setup.database,
        "--store",
        &setup.store,
        "--token-file",
        token_file,
    ];
    let mut env = setup.env.clone();
    env.extend(fault.map(|fault| ("IGN_FAULT".to_owned(), fault.to_owned())));
    Process::start(
        &setup.name,
        &program("ign-coordinator")?,
        args.into_iter()
            .chain(setup.args.iter().map(String::as_str)),
        env,
        &setup.dir.join(format!("{}.log", setup.name)),
    )
}

/// An agent whose child plays the script in its job's recipe, in `DIR/NAME`; armed with `fault`.
pub fn scripted_agent(
    dir: &Path,
    url: &str,
    token: &str,
    name: &str,
    fault: Option<&str>,
) -> Result<Process> {
    let work = dir.join(name);
    let mut env = vec![("IGN_TEST_TOKEN".to_owned(), token.to_owned())];
    env.extend(fault.map(|fault| ("IGN_FAULT".to_owned(), fault.to_owned())));
    std::fs::create_dir_all(&work)?;
    Process::start(
        name,
        &program("ign-agent-test-child")?,
        ["agent", url, path(&work)?, name],
        env,
        &dir.join(format!("{name}.log")),
    )
}
