//! Following a job until it ends, over broken connections.

use std::time::{Duration, Instant};

use ign_proto::{Cause, v1};

use crate::connection::Connection;
use crate::output::{self, Live, duration, number};
use crate::problem::Problem;
use crate::views::{JobView, is_terminal, short_id};

/// How long a coordinator may be away before following is given up; the job itself does not mind.
pub(crate) const PATIENCE: Duration = Duration::from_mins(2);

/// Follows a job until it ends; `changed` sees each state of it. Gives up when nothing answers for `patience`.
pub(crate) async fn until_end(
    connection: &Connection,
    job_id: &str,
    patience: Duration,
    mut changed: impl FnMut(&v1::Job),
) -> Result<v1::Job, Problem> {
    let mut away_since: Option<Instant> = None;
    loop {
        let broken = match watch_once(connection, job_id, &mut changed, &mut away_since).await {
            Ok(Some(job)) => return Ok(job),
            Ok(None) => None,
            Err(status) if Cause::from_status(&status).retryable() => Some(status),
            Err(status) => return Err(status.into()),
        };
        let since = *away_since.get_or_insert_with(Instant::now);
        if since.elapsed() > patience {
            let problem = broken.map_or_else(
                || Problem::unreachable("the coordinator ends every watch at once"),
                Problem::from,
            );
            return Err(problem.at(format!("job {job_id}")).hint(format!(
                "the job goes on; come back with `ignctl wait {}`",
                short_id(job_id)
            )));
        }
        tokio::time::sleep(Duration::from_millis(500)).await;
    }
}

async fn watch_once(
    connection: &Connection,
    job_id: &str,
    changed: &mut impl FnMut(&v1::Job),
    away_since: &mut Option<Instant>,
) -> Result<Option<v1::Job>, tonic::Status> {
    let request = v1::GetJobRequest {
        job_id: job_id.to_string(),
    };
    let mut stream = connection.jobs().watch(request).await?.into_inner();
    while let Some(job) = stream.message().await? {
        *away_since = None;
        changed(&job);
        if is_terminal(job.state()) {
            return Ok(Some(job));
        }
    }
    Ok(None)
}

/// Shows a job on a live line.
pub(crate) fn show(live: &Live, job: &v1::Job) {
    let view = JobView::from(job);
    match view.state {
        "queued" => {
            let ahead = view.queue_position.unwrap_or(0);
            let mut text = view.waiting_for.unwrap_or_default();
            if ahead > 0 {
                text = format!("{ahead} ahead  {text}");
            }
            if view.attempt > 1 || view.checkpoint_digest.is_some() {
                text = format!("attempt {}  {text}", view.attempt);
            }
            live.set("queued", 0.0, text.trim_end());
        }
        "leased" => {
            let Some(progress) = view.progress else {
                live.set("starting", 0.0, "");
                return;
            };
            let mut parts = Vec::new();
            if let Some(eta_secs) = progress.eta_secs {
                parts.push(format!("eta {}", duration(eta_secs)));
            }
            if let Some(mse) = progress.mse {
                parts.push(format!("mse {}", number(mse)));
            }
            if view.attempt > 1 {
                parts.push(format!("attempt {}", view.attempt));
            }
            parts.push(progress.message);
            live.set(
                &progress.stage,
                progress.percent,
                parts.join("  ").trim_end(),
            );
        }
        // How it ended is for the caller to say.
        _ => {}
    }
}

/// How a job that did not succeed is reported.
pub(crate) fn failure(job: &v1::Job) -> Problem {
    let view = JobView::from(job);
    match view.failure {
        Some(failure) => Problem {
            at: failure.at.unwrap_or_default(),
            hint: failure
                .hint
                .unwrap_or_else(|| format!("ignctl logs {}", short_id(&job.id))),
            ..Problem::failed(output::printable(&failure.message))
        },
        None => Problem::failed(format!("the job was {}", view.state)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::views::samples;

    #[test]
    fn a_failed_job_is_reported_in_three_lines() {
        insta::assert_snapshot!(failure(&samples::failed()));
    }

    #[test]
    fn a_cancelled_job_says_so() {
        let job = samples::job("01985a4e-0001", "vase", v1::JobState::Cancelled);
        insta::assert_snapshot!(failure(&job));
    }
}
