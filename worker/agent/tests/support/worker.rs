//! An agent under test, with the scripted child.

#![expect(clippy::unwrap_used, reason = "a panic is how a test fails")]

use std::num::NonZero;
use std::time::Duration;

use ign_agent::{AgentConfig, AgentError, ChildCommand};
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;

pub(crate) const TOKEN: &str = "a-token-for-tests-only-0123456789";

pub(crate) struct Worker {
    pub(crate) dir: tempfile::TempDir,
    pub(crate) shutdown: CancellationToken,
    pub(crate) task: JoinHandle<Result<(), AgentError>>,
}

pub(crate) fn config(url: &str, dir: &std::path::Path) -> AgentConfig {
    AgentConfig {
        name: Some("tester".into()),
        threads: 3,
        child: ChildCommand {
            program: env!("CARGO_BIN_EXE_ign-agent-test-child").into(),
            args: vec!["exec".into(), "--job".into()],
            envs: Vec::new(),
        },
        shutdown_grace: Duration::from_secs(5),
        lease_wait: Duration::from_secs(1),
        ..AgentConfig::new(url, TOKEN, dir).unwrap()
    }
}

impl Worker {
    pub(crate) fn start(url: &str) -> Self {
        Self::with_slots(url, 1)
    }

    pub(crate) fn with_slots(url: &str, slots: usize) -> Self {
        let dir = tempfile::tempdir().unwrap();
        let shutdown = CancellationToken::new();
        let config = AgentConfig {
            slots: NonZero::new(slots).unwrap(),
            ..config(url, dir.path())
        };
        let task = tokio::spawn(ign_agent::run(config, shutdown.clone()));
        Self {
            dir,
            shutdown,
            task,
        }
    }

    /// Stops the agent and checks that it left no job behind.
    pub(crate) async fn stop(self) {
        self.shutdown.cancel();
        self.task.await.unwrap().unwrap();
        let jobs = std::fs::read_dir(self.dir.path().join("jobs")).unwrap();
        assert_eq!(jobs.count(), 0);
    }
}

/// Whether a process exists and is no zombie.
pub(crate) fn alive(pid: &str) -> bool {
    let state = std::fs::read_to_string(format!("/proc/{pid}/stat")).unwrap_or_default();
    !state.is_empty() && !state.contains(") Z ")
}
