//! What must happen without anybody asking: taking jobs back from silent workers, repairing the bucket's record of
//! versions, dropping uploads that nobody goes on with, reading every digest again, sending webhooks.

use std::sync::atomic::Ordering;
use std::time::Duration;

use tokio::time::{Instant, MissedTickBehavior};

use crate::app::App;
use crate::http_answer::Refused;
use crate::webhooks;

const UPLOAD_SWEEP: Duration = Duration::from_hours(1);
const AUDIT_TICK: Duration = Duration::from_mins(1);
const UPLOAD_IDLE: Duration = Duration::from_hours(7 * 24);

/// Runs until the coordinator stops.
pub(crate) async fn run(app: &App) {
    tokio::select! {
        () = app.stopping.cancelled() => {}
        ((), (), (), ()) = async {
            tokio::join!(reap(app), repair(app), audit(app), webhooks::run(app))
        } => {}
    }
}

/// Begins one lease after the start, so that workers which outlived the last coordinator can report first.
async fn reap(app: &App) {
    let lease = app.store.settings().lease;
    let pause = (lease / 9).clamp(Duration::from_millis(100), Duration::from_secs(5));
    tokio::time::sleep(lease).await;
    let mut tick = tokio::time::interval(pause);
    tick.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        tick.tick().await;
        match app.store.reap().await {
            Ok(reaped) => {
                for job in &reaped.requeued {
                    tracing::warn!(job.id = %job, "worker fell silent; queued again");
                }
                for job in &reaped.ended {
                    tracing::warn!(job.id = %job, "worker fell silent; ended");
                }
                let count = reaped.requeued.len() + reaped.ended.len();
                app.metrics
                    .reaped
                    .fetch_add(count as u64, Ordering::Relaxed);
            }
            // Logged by the conversion; the next tick tries again.
            Err(error) => drop(Refused::from(error)),
        }
    }
}

async fn repair(app: &App) {
    app.mirror_all().await;
    let mut tick = tokio::time::interval(Duration::from_secs(5));
    tick.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut sweep_at = Instant::now();
    loop {
        tick.tick().await;
        app.mirror_behind().await;
        if Instant::now() >= sweep_at {
            sweep_at = Instant::now() + UPLOAD_SWEEP;
            match app.registry.drop_stale_uploads(UPLOAD_IDLE).await {
                Ok(0) => {}
                Ok(dropped) => tracing::info!(dropped, "dropped uploads that nobody went on with"),
                Err(error) => drop(Refused::from(error)),
            }
        }
    }
}

async fn audit(app: &App) {
    let Some(every) = app.audit_every else {
        return;
    };
    let mut tick = tokio::time::interval(AUDIT_TICK.min(every / 256));
    tick.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        tick.tick().await;
        if let Err(Refused(cause)) = app.audit_when_due(every).await {
            tracing::warn!(error = %cause, "an audit broke off; the next slice goes on");
        }
    }
}
