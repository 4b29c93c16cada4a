//! Heartbeats of one attempt: progress and log lines up, cancel and drain down.
//!
//! One goes out at least every third of the lease, and sooner when there is news. While the coordinator cannot be
//! reached the bake goes on; lines wait in their bounded buffer.

use std::sync::Arc;
use std::time::Duration;

use ign_proto::{Cause, v1};
use tokio::time::Instant;

use crate::backoff::Backoff;
use crate::control::Control;
use crate::state::{State, Stop, wire_lines};

/// News does not go out more often than this.
const MIN_INTERVAL: Duration = Duration::from_secs(2);

/// Runs until the lease is lost, or forever; the caller drops it when the attempt ends.
pub(crate) async fn run(control: Control, state: Arc<State>, lease_secs: f64) {
    let mut interval = interval(lease_secs);
    let mut backoff = Backoff::new(Duration::from_millis(500), Duration::from_secs(10));
    let mut failing_since: Option<Instant> = None;
    let mut draining = false;
    loop {
        let wait = match beat(&control, &state).await {
            Ok(response) => {
                if let Some(since) = failing_since.take() {
                    let secs = since.elapsed().as_secs();
                    tracing::info!(job = %state.job, "the coordinator is back after {secs} s");
                }
                backoff.reset();
                if response.lease_secs > 0.0 {
                    interval = self::interval(response.lease_secs);
                }
                if response.cancel {
                    state.stop(Stop::Cancelled);
                }
                if response.drain && !std::mem::replace(&mut draining, true) {
                    tracing::info!(job = %state.job, "draining: no other job after this one");
                }
                if state.logs().is_empty() {
                    let news = async {
                        tokio::time::sleep(MIN_INTERVAL.min(interval)).await;
                        state.news().await;
                    };
                    // Either is a reason for the next heartbeat.
                    tokio::time::timeout(interval, news).await.ok();
                    continue;
                }
                MIN_INTERVAL.min(interval)
            }
            Err(Cause::LeaseLost { .. }) => {
                state.stop(Stop::LeaseLost);
                return;
            }
            Err(cause) => {
                if failing_since.is_none() {
                    failing_since = Some(Instant::now());
                    tracing::warn!(job = %state.job, "heartbeat failed: {cause}; the bake goes on");
                }
                backoff.next_delay().min(interval)
            }
        };
        tokio::time::sleep(wait).await;
    }
}

/// One heartbeat; lines that did not arrive stay in the buffer.
pub(crate) async fn beat(control: &Control, state: &State) -> Result<v1::HeartbeatResponse, Cause> {
    let lines = LinesInFlight::take(state);
    let request = v1::HeartbeatRequest {
        job: Some(state.token()),
        progress: state.progress(),
        logs: wire_lines(&lines.lines, state.attempt),
    };
    let response = control.heartbeat(request).await?;
    lines.arrived();
    Ok(response)
}

/// Lines of a request; they go back into the buffer unless the request is known to have arrived.
struct LinesInFlight<'a> {
    state: &'a State,
    lines: Vec<crate::logs::Line>,
}

impl<'a> LinesInFlight<'a> {
    fn take(state: &'a State) -> Self {
        let lines = state.logs().take();
        Self { state, lines }
    }

    fn arrived(mut self) {
        self.lines.clear();
    }
}

impl Drop for LinesInFlight<'_> {
    fn drop(&mut self) {
        if !self.lines.is_empty() {
            let lines = std::mem::take(&mut self.lines);
            self.state.logs().put_back(lines);
        }
    }
}

fn interval(lease_secs: f64) -> Duration {
    Duration::from_secs_f64((lease_secs / 3.0).clamp(0.05, 300.0))
}
