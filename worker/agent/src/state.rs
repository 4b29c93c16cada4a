//! What the parts of one attempt share: newest progress, log lines on their way, and the reasons to stop.

use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use ign_events::{Failure, FailureKind, Level, Progress};
use ign_proto::{Attempt, JobId, ObjectName, WorkerId, v1};
use tokio::sync::{Notify, watch};

use crate::logs::{self, LogBuffer};

/// Why an attempt must stop, the weightier later.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Stop {
    /// This agent is asked to end; the job goes back to the queue.
    Shutdown,
    /// A user cancelled the job.
    Cancelled,
    /// The job is no longer ours: nothing that we would still send counts.
    LeaseLost,
}

#[derive(Debug)]
pub(crate) struct State {
    pub(crate) job: JobId,
    pub(crate) attempt: Attempt,
    pub(crate) worker: WorkerId,
    pub(crate) object: ObjectName,
    progress: Mutex<Option<v1::Progress>>,
    logs: Mutex<LogBuffer>,
    /// Something new for the next heartbeat.
    news: Notify,
    stop: watch::Sender<Option<Stop>>,
}

impl State {
    pub(crate) fn new(job: JobId, attempt: Attempt, worker: WorkerId, object: ObjectName) -> Self {
        Self {
            job,
            attempt,
            worker,
            object,
            progress: Mutex::new(None),
            logs: Mutex::new(LogBuffer::new()),
            news: Notify::new(),
            stop: watch::Sender::new(None),
        }
    }

    /// The fencing token of every call about this job.
    pub(crate) fn token(&self) -> v1::JobAttempt {
        v1::JobAttempt {
            job_id: self.job.to_string(),
            attempt: self.attempt.0,
            worker_id: self.worker.to_string(),
        }
    }

    pub(crate) fn set_progress(&self, progress: &Progress) {
        let known = |value: Option<f64>| value.filter(|value| value.is_finite());
        let progress = v1::Progress {
            stage: logs::cut(&progress.stage, 100).to_owned(),
            percent: known(Some(progress.percent))
                .unwrap_or(0.0)
                .clamp(0.0, 100.0),
            eta_secs: known(progress.eta_secs).map(|secs| secs.max(0.0)),
            error: known(progress.error),
            message: logs::cut(&progress.message, 1000).to_owned(),
        };
        *lock(&self.progress) = Some(progress);
        self.news.notify_one();
    }

    /// Newest progress, which every heartbeat carries.
    pub(crate) fn progress(&self) -> Option<v1::Progress> {
        lock(&self.progress).clone()
    }

    pub(crate) fn log(&self, level: Level, message: &str) {
        self.logs().push(level, message);
        self.news.notify_one();
    }

    pub(crate) fn log_text(&self, text: &str) {
        if !text.is_empty() {
            self.logs().push_text(text, std::time::Instant::now());
            self.news.notify_one();
        }
    }

    pub(crate) fn logs(&self) -> MutexGuard<'_, LogBuffer> {
        lock(&self.logs)
    }

    /// Ends when there is something new to tell.
    pub(crate) async fn news(&self) {
        self.news.notified().await;
    }

    /// Tells every part to stop; a weightier reason replaces a lighter one.
    pub(crate) fn stop(&self, reason: Stop) {
        self.stop.send_if_modified(|current| {
            let heavier = *current < Some(reason);
            if heavier {
                *current = Some(reason);
            }
            heavier
        });
    }

    /// Ends when the attempt must stop. After a shutdown request it may go on for `grace`.
    pub(crate) async fn stopped(&self, grace: Duration) -> Stop {
        let mut stop = self.stop.subscribe();
        let reason = wait_for(&mut stop, Stop::Shutdown).await;
        if reason > Stop::Shutdown {
            return reason;
        }
        tokio::time::timeout(grace, wait_for(&mut stop, Stop::Cancelled))
            .await
            .unwrap_or(Stop::Shutdown)
    }

    /// Ends when the job is no longer ours.
    pub(crate) async fn lease_lost(&self) {
        wait_for(&mut self.stop.subscribe(), Stop::LeaseLost).await;
    }

    /// The reason to stop at this moment.
    pub(crate) fn stop_reason(&self) -> Option<Stop> {
        *self.stop.borrow()
    }
}

async fn wait_for(stop: &mut watch::Receiver<Option<Stop>>, at_least: Stop) -> Stop {
    let reached = stop
        .wait_for(|reason| *reason >= Some(at_least))
        .await
        .ok()
        .and_then(|reason| *reason);
    match reached {
        Some(reason) => reason,
        // The state is gone, and with it whoever could ask for a stop.
        None => std::future::pending().await,
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Lines as they go over the wire; the coordinator numbers them.
pub(crate) fn wire_lines(lines: &[logs::Line], attempt: Attempt) -> Vec<v1::LogLine> {
    lines
        .iter()
        .map(|line| v1::LogLine {
            seq: 0,
            at: Some(line.at.into()),
            attempt: attempt.0,
            level: match line.level {
                Level::Info => "info",
                Level::Warn => "warn",
                Level::Error => "error",
            }
            .to_owned(),
            message: line.message.clone(),
        })
        .collect()
}

/// A failure as it goes over the wire.
pub(crate) fn wire_failure(failure: &Failure) -> v1::Failure {
    let kind = match failure.kind {
        FailureKind::Transient => v1::FailureKind::Transient,
        FailureKind::InvalidInput => v1::FailureKind::InvalidInput,
        FailureKind::Crashed => v1::FailureKind::Crashed,
        FailureKind::Cancelled => v1::FailureKind::Cancelled,
    };
    v1::Failure {
        kind: kind.into(),
        message: logs::cut(&failure.message, 16_000).to_owned(),
        at: logs::cut(&failure.at, 4000).to_owned(),
        hint: logs::cut(&failure.hint, 4000).to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use std::time::Instant;

    use super::*;

    fn state() -> State {
        State::new(
            JobId::generate(),
            Attempt(2),
            "w".parse().unwrap(),
            "c/o".parse().unwrap(),
        )
    }

    #[tokio::test]
    async fn the_weightiest_reason_wins_and_stays() {
        let state = state();
        state.stop(Stop::Cancelled);
        state.stop(Stop::Shutdown);
        assert_eq!(state.stopped(Duration::from_mins(1)).await, Stop::Cancelled);
        state.stop(Stop::LeaseLost);
        state.stop(Stop::Cancelled);
        assert_eq!(state.stopped(Duration::ZERO).await, Stop::LeaseLost);
    }

    #[tokio::test]
    async fn a_shutdown_leaves_time_to_finish() {
        let state = state();
        state.stop(Stop::Shutdown);
        let (start, grace) = (Instant::now(), Duration::from_millis(100));
        assert_eq!(state.stopped(grace).await, Stop::Shutdown);
        assert!(start.elapsed() >= grace);
        let waiting = state.stopped(Duration::from_mins(1));
        assert!(tokio::time::timeout(grace, waiting).await.is_err());
    }

    #[test]
    fn progress_is_made_presentable() {
        let state = state();
        state.set_progress(&Progress {
            stage: "effects".into(),
            percent: 140.0,
            eta_secs: Some(f64::INFINITY),
            error: Some(f64::NAN),
            message: String::new(),
        });
        let progress = state.progress().unwrap();
        assert_eq!(
            (progress.percent, progress.eta_secs, progress.error),
            (100.0, None, None)
        );
    }
}
