//! Uploads checkpoints while training goes on. The newest wins: one that is overtaken before its upload began is
//! never sent, and one that cannot be sent is replaced by the next.

use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use ign_events::Level;
use ign_proto::{Cause, Digest, v1};
use tokio::sync::watch;
use tokio::task::JoinHandle;

use crate::backoff::Backoff;
use crate::control::Control;
use crate::data_plane::{DataPlane, UploadSession};
use crate::error::TransferError;
use crate::files;
use crate::state::{State, Stop};

/// Takes checkpoint files and sends them in the background.
#[derive(Debug)]
pub(crate) struct Checkpoints {
    newest: watch::Sender<Option<PathBuf>>,
    outbox: PathBuf,
    count: u32,
    sending: Arc<Mutex<Option<PathBuf>>>,
    task: JoinHandle<()>,
}

impl Checkpoints {
    /// `outbox` is an existing folder for the files on their way.
    pub(crate) fn start(
        control: Control,
        data: DataPlane,
        state: Arc<State>,
        outbox: PathBuf,
    ) -> Self {
        let (newest, offered) = watch::channel(None);
        let sending = Arc::default();
        let work = run(control, data, state, offered, Arc::clone(&sending));
        let task = tokio::spawn(ign_trace::carry(work));
        Self {
            newest,
            outbox,
            count: 0,
            sending,
            task,
        }
    }

    /// Takes a second name for the file, so that the child may delete its own.
    pub(crate) fn offer(&mut self, path: &Path) -> std::io::Result<()> {
        self.count += 1;
        let kept = self.outbox.join(format!("checkpoint-{}", self.count));
        std::fs::hard_link(path, &kept)?;
        let overtaken = self.newest.send_replace(Some(kept));
        // What is on its way arrives, or a slow line would never save anything. Other older ones are not worth it.
        if let Some(overtaken) = overtaken
            && Some(&overtaken) != lock(&self.sending).as_ref()
        {
            std::fs::remove_file(overtaken).ok();
        }
        Ok(())
    }

    /// Lets the newest checkpoint arrive, within `limit`.
    pub(crate) async fn finish(mut self, limit: Duration) {
        // The task sees that no more will come.
        self.newest = watch::Sender::new(None);
        if tokio::time::timeout(limit, &mut self.task).await.is_err() {
            self.task.abort();
        }
    }
}

impl Drop for Checkpoints {
    fn drop(&mut self) {
        self.task.abort();
    }
}

async fn run(
    control: Control,
    data: DataPlane,
    state: Arc<State>,
    mut offered: watch::Receiver<Option<PathBuf>>,
    sending: Arc<Mutex<Option<PathBuf>>>,
) {
    let mut backoff = Backoff::default();
    // Of the checkpoint that is being sent.
    let mut session = UploadSession::default();
    while offered.changed().await.is_ok() {
        loop {
            let Some(path) = offered.borrow_and_update().clone() else {
                break;
            };
            *lock(&sending) = Some(path.clone());
            let sent = send(&control, &data, &state, &path, &session).await;
            *lock(&sending) = None;
            if offered.has_changed().unwrap_or(false) || sent.is_ok() {
                std::fs::remove_file(&path).ok();
            }
            let problem = match sent {
                Ok(size_bytes) => {
                    let megabytes = size_bytes as f64 / 1e6;
                    state.log(
                        Level::Info,
                        &format!("checkpoint saved ({megabytes:.1} MB)"),
                    );
                    backoff.reset();
                    break;
                }
                Err(problem) => problem,
            };
            match problem {
                Problem::LeaseLost => {
                    state.stop(Stop::LeaseLost);
                    return;
                }
                Problem::Lasting(message) => {
                    if !offered.has_changed().unwrap_or(false) {
                        state.log(Level::Warn, &format!("checkpoint not saved: {message}"));
                    }
                    break;
                }
                Problem::Passing(message) => {
                    tracing::warn!(job = %state.job, "checkpoint not saved yet: {message}");
                }
            }
            tokio::time::sleep(backoff.next_delay()).await;
            if offered.has_changed().unwrap_or(false) {
                session = UploadSession::default();
            }
        }
        session = UploadSession::default();
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

enum Problem {
    LeaseLost,
    /// Another try may help.
    Passing(String),
    Lasting(String),
}

impl From<TransferError> for Problem {
    fn from(error: TransferError) -> Self {
        let message = error.failure().message;
        if error.is_passing() {
            Self::Passing(message)
        } else {
            Self::Lasting(message)
        }
    }
}

impl From<Cause> for Problem {
    fn from(cause: Cause) -> Self {
        match cause {
            Cause::LeaseLost { .. } => Self::LeaseLost,
            cause if cause.retryable() => Self::Passing(cause.to_string()),
            cause => Self::Lasting(cause.to_string()),
        }
    }
}

async fn send(
    control: &Control,
    data: &DataPlane,
    state: &State,
    path: &Path,
    session: &UploadSession,
) -> Result<u64, Problem> {
    let (digest, size_bytes): (Digest, u64) = {
        let path = path.to_path_buf();
        files::blocking(move || {
            files::digest(&path).map_err(|source| TransferError::file("read", &path, source))
        })
        .await??
    };
    data.push(&state.object, path, &digest, size_bytes, session)
        .await?;
    ign_faults::point("agent.checkpoint_sent");
    let request = v1::CheckpointRequest {
        job: Some(state.token()),
        digest: digest.to_string(),
        size_bytes,
    };
    control.checkpoint(request).await?;
    ign_faults::point("agent.checkpoint_told");
    Ok(size_bytes)
}
