//! `status`: what an operator wants to see, on one screen.

use std::collections::BTreeMap;
use std::time::Duration;

use chrono::{DateTime, Utc};
use ign_proto::v1;
use serde::Serialize;

use crate::Context;
use crate::connection::Connection;
use crate::output::{self, Format, Table, age, duration, number};
use crate::problem::{Exit, Problem};
use crate::views::{JobView, STATES, ShortIds, WorkerView, time};

/// Time between two screens of `-w`.
const REFRESH: Duration = Duration::from_secs(2);

/// Arguments of `status`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Refresh in place until Ctrl-C
    #[arg(short, long)]
    watch: bool,
    /// Only this collection
    #[arg(long, value_name = "C")]
    collection: Option<ign_proto::CollectionId>,
}

#[derive(Debug, Serialize)]
struct StatusView {
    server: String,
    server_version: String,
    at: Option<DateTime<Utc>>,
    jobs_by_state: BTreeMap<String, u64>,
    workers: Vec<WorkerView>,
    running: Vec<JobView>,
    next_queued: Vec<JobView>,
    recent_failures: Vec<JobView>,
}

pub(crate) async fn run(context: &Context, args: &Args) -> Result<(), Problem> {
    let connection = Connection::open(&context.connection).await?;
    if !args.watch {
        let view = ask(&connection, args).await?;
        return output::data(context.format, &view, || screen(&view));
    }
    let in_place = context.format == Format::Table && output::stdout_is_terminal();
    let mut last = None;
    loop {
        match ask(&connection, args).await {
            Ok(view) if in_place => {
                output::screen(&screen(&view))?;
                last = Some(view);
            }
            Ok(view) => output::data(context.format, &view, || format!("{}\n", screen(&view)))?,
            // A restart of the coordinator is worth waiting for.
            Err(problem) if problem.exit == Exit::Unreachable => {
                let text = format!("no answer: {}", problem.what);
                match &last {
                    Some(view) if in_place => output::screen(&format!("{text}\n{}", screen(view)))?,
                    _ => output::warn(&text),
                }
            }
            Err(problem) => return Err(problem),
        }
        tokio::time::sleep(REFRESH).await;
    }
}

async fn ask(connection: &Connection, args: &Args) -> Result<StatusView, Problem> {
    let request = v1::StatusRequest {
        collection: args
            .collection
            .as_ref()
            .map(ToString::to_string)
            .unwrap_or_default(),
    };
    let status = connection.jobs().status(request).await?.into_inner();
    Ok(view(connection.target.url.as_str(), &status))
}

fn view(server: &str, status: &v1::StatusResponse) -> StatusView {
    let jobs = |jobs: &[v1::Job]| jobs.iter().map(JobView::from).collect();
    let mut jobs_by_state: BTreeMap<String, u64> = STATES
        .iter()
        .map(|state| ((*state).to_string(), 0))
        .collect();
    jobs_by_state.extend(status.jobs_by_state.clone());
    StatusView {
        server: server.trim_end_matches('/').to_string(),
        server_version: status.server_version.clone(),
        at: time(status.at.as_ref()),
        jobs_by_state,
        workers: status.workers.iter().map(WorkerView::from).collect(),
        running: jobs(&status.running),
        next_queued: jobs(&status.next_queued),
        recent_failures: jobs(&status.recent_failures),
    }
}

fn screen(view: &StatusView) -> String {
    let now = view.at.unwrap_or_else(Utc::now);
    let shown = [&view.running, &view.next_queued, &view.recent_failures];
    let ids = ShortIds::of(
        shown
            .iter()
            .flat_map(|jobs| jobs.iter().map(|job| job.id.as_str()))
            .chain(view.workers.iter().flat_map(WorkerView::jobs)),
    );
    let count = |state: &str| view.jobs_by_state.get(state).copied().unwrap_or(0);
    let counts: Vec<String> = STATES
        .iter()
        .map(|state| {
            let word = if *state == "leased" { "running" } else { state };
            format!("{} {word}", count(state))
        })
        .collect();
    let mut text = format!(
        "{}  ign {}  {}\n{}\n",
        view.server,
        view.server_version,
        now.format("%Y-%m-%d %H:%M:%S UTC"),
        counts.join(" · ")
    );
    section(
        &mut text,
        "RUNNING",
        running(&view.running, &ids).as_ref(),
        "nothing runs",
    );
    section(
        &mut text,
        "WORKERS",
        workers(&view.workers, &ids, now).as_ref(),
        "no worker is connected",
    );
    if !view.next_queued.is_empty() {
        section(
            &mut text,
            "NEXT",
            Some(&queued(&view.next_queued, &ids, now)),
            "",
        );
    }
    if !view.recent_failures.is_empty() {
        section(
            &mut text,
            "FAILED",
            Some(&failures(&view.recent_failures, &ids, now)),
            "",
        );
    }
    text
}

fn section(text: &mut String, name: &str, table: Option<&Table>, empty: &str) {
    text.push('\n');
    text.push_str(&output::heading(name));
    text.push('\n');
    let table = table.map_or_else(|| format!("{empty}\n"), Table::to_string);
    text.push_str(&table);
}

fn running(jobs: &[JobView], ids: &ShortIds) -> Option<Table> {
    let mut table = Table::new(&[
        "JOB", "OBJECT", "STAGE", ">DONE", ">ETA", ">MSE", ">TRY", "WORKER", "DOING",
    ]);
    for job in jobs {
        let progress = job.progress.as_ref();
        let figure = |value: Option<f64>, show: fn(f64) -> String| {
            value.map_or_else(|| "-".to_string(), show)
        };
        table.row([
            ids.show(&job.id),
            job.name(),
            progress.map_or_else(|| "starting".to_string(), |p| p.stage.clone()),
            progress.map_or_else(|| "-".to_string(), |p| format!("{:.0}%", p.percent)),
            figure(progress.and_then(|p| p.eta_secs), duration),
            figure(progress.and_then(|p| p.mse), number),
            job.attempt.to_string(),
            job.worker.clone().unwrap_or_default(),
            progress.map(|p| p.message.clone()).unwrap_or_default(),
        ]);
    }
    (!jobs.is_empty()).then_some(table)
}

/// One row for each worker; none for none.
pub(crate) fn workers(workers: &[WorkerView], ids: &ShortIds, now: DateTime<Utc>) -> Option<Table> {
    let mut table = Table::new(&["WORKER", "HOST", ">SEEN", "JOB", "VERSION", "DEVICE"]);
    for worker in workers {
        let jobs: Vec<String> = worker.jobs().map(|job| ids.show(job)).collect();
        let doing = match (jobs.join(", "), worker.draining) {
            (jobs, true) if jobs.is_empty() => "draining".to_string(),
            (jobs, false) if jobs.is_empty() => "idle".to_string(),
            (jobs, true) => format!("{jobs} (draining)"),
            (jobs, false) => jobs,
        };
        table.row([
            worker.id.clone(),
            worker.hostname.clone(),
            age(worker.last_seen_at, now),
            doing,
            worker.version.clone(),
            worker.device.clone(),
        ]);
    }
    (!workers.is_empty()).then_some(table)
}

fn queued(jobs: &[JobView], ids: &ShortIds, now: DateTime<Utc>) -> Table {
    let mut table = Table::new(&["JOB", "OBJECT", ">PRIORITY", ">WAITED", "WAITING FOR"]);
    for job in jobs {
        table.row([
            ids.show(&job.id),
            job.name(),
            job.priority.to_string(),
            age(job.submitted_at, now),
            job.waiting_for.clone().unwrap_or_default(),
        ]);
    }
    table
}

fn failures(jobs: &[JobView], ids: &ShortIds, now: DateTime<Utc>) -> Table {
    let mut table = Table::new(&["JOB", "OBJECT", ">AGO", ">TRY", "KIND", "WHY"]);
    for job in jobs {
        table.row([
            ids.show(&job.id),
            job.name(),
            age(job.finished_at, now),
            job.attempt.to_string(),
            job.failure
                .as_ref()
                .map_or("", |failure| failure.kind)
                .to_string(),
            job.note(),
        ]);
    }
    table
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::views::samples;

    fn sample() -> v1::StatusResponse {
        v1::StatusResponse {
            jobs_by_state: [
                ("queued".to_string(), 1),
                ("leased".to_string(), 1),
                ("failed".to_string(), 1),
            ]
            .into(),
            workers: vec![v1::Worker {
                id: "local-1".into(),
                hostname: "bakery".into(),
                version: "0.1.0".into(),
                device: "cpu, 2 threads".into(),
                last_seen_at: Some(prost_types::Timestamp {
                    seconds: samples::now().timestamp() - 4,
                    nanos: 0,
                }),
                job_id: samples::running().id,
                draining: false,
                job_ids: vec![samples::running().id],
            }],
            running: vec![samples::running()],
            recent_failures: vec![samples::failed()],
            server_version: "0.1.0".into(),
            at: Some(prost_types::Timestamp {
                seconds: samples::now().timestamp(),
                nanos: 0,
            }),
            next_queued: vec![samples::queued()],
            lease_secs: 45.0,
        }
    }

    #[test]
    fn one_screen() {
        insta::assert_snapshot!(screen(&view("http://127.0.0.1:7070/", &sample())));
    }

    #[test]
    fn an_idle_service() {
        let status = v1::StatusResponse {
            server_version: "0.1.0".into(),
            at: sample().at,
            ..Default::default()
        };
        insta::assert_snapshot!(screen(&view("http://127.0.0.1:7070/", &status)));
    }

    #[test]
    fn every_job_of_a_worker_is_shown() {
        let mut status = sample();
        let worker = &mut status.workers[0];
        worker.draining = true;
        worker.job_ids.push(samples::failed().id);
        let text = screen(&view("http://127.0.0.1:7070/", &status));
        let shown = "01985a4e-0001, 01985a4e-0002 (draining)";
        assert!(text.contains(shown), "{text}");
    }

    #[test]
    fn machine_fields() {
        let value = serde_json::to_value(view("http://127.0.0.1:7070/", &sample())).unwrap();
        let fields: Vec<&String> = value.as_object().unwrap().keys().collect();
        insta::assert_debug_snapshot!(fields);
        assert_eq!(value["jobs_by_state"]["succeeded"], 0);
    }
}
