//! Jobs through gRPC: submitted in bulk, looked at, leased, reported about, completed.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use anyhow::{Context as _, Result, ensure};
use futures::future::try_join_all;
use futures::stream;
use ign_proto::manifest::FileEntry;
use ign_proto::v1;
use tokio::time::Instant;

use crate::Load;
use crate::figures::{Figures, Target, say};
use crate::service::{LEASE, Service, Worker};

/// Rows of one `SubmitBatch`: its answer, a job each, must fit into a message.
const ROWS_A_CALL: usize = 10_000;
/// Jobs whose pickup is timed.
const PICKUPS: usize = 100;
/// Between two of them the service is idle.
const PICKUP_PAUSE: Duration = Duration::from_millis(30);
const STATUS_CALLS: usize = 200;
const RECIPE: &str = r#"{"preset":"standard","size":256,"crop":"object","seed":0}"#;

fn request(object: &str, id: &str, capture: &str) -> v1::SubmitRequest {
    v1::SubmitRequest {
        request_id: id.to_owned(),
        spec: Some(v1::JobSpec {
            object: Some(v1::ObjectRef {
                collection: "bench".to_owned(),
                object: object.to_owned(),
            }),
            capture_digest: capture.to_owned(),
            recipe_json: RECIPE.to_owned(),
            labels: [("batch".to_owned(), "bench".to_owned())].into(),
            ..v1::JobSpec::default()
        }),
    }
}

fn lease_request(worker: &str, wait_secs: f64) -> v1::LeaseRequest {
    v1::LeaseRequest {
        worker_id: worker.to_owned(),
        hostname: "bench".to_owned(),
        version: "0".to_owned(),
        device: "cpu".to_owned(),
        wait_secs,
    }
}

fn attempt(lease: &v1::Lease, worker: &str) -> v1::JobAttempt {
    v1::JobAttempt {
        job_id: lease.job_id.clone(),
        attempt: lease.attempt,
        worker_id: worker.to_owned(),
    }
}

/// From the call that submits a job to the answer of a worker's long poll.
pub(crate) async fn pickup(figures: &mut Figures, service: &Service, store: &str) -> Result<()> {
    let capture = service.capture("bench/pickup").await?.to_string();
    let mut jobs = service.jobs()?;
    let mut times = Vec::new();
    for index in 0..PICKUPS {
        let mut worker = service.worker()?;
        let waiting = tokio::spawn(async move {
            let lease = worker.lease(lease_request("w", 30.0)).await;
            (lease, Instant::now(), worker)
        });
        tokio::time::sleep(PICKUP_PAUSE).await;
        let begun = Instant::now();
        jobs.submit(request("pickup", &format!("p{index}"), &capture))
            .await?;
        let (lease, ended, mut worker) = waiting.await?;
        let lease = lease?.into_inner().lease.context("no job was leased")?;
        times.push(ended - begun);
        let failure = v1::Failure {
            kind: v1::FailureKind::InvalidInput.into(),
            message: "measured".to_owned(),
            ..v1::Failure::default()
        };
        worker
            .fail(v1::FailRequest {
                job: Some(attempt(&lease, "w")),
                failure: Some(failure),
                logs: Vec::new(),
            })
            .await?;
    }
    figures.p95_ms(
        &format!("pickup when idle, {store}"),
        &times,
        Some(Target::AtMost(25.0)),
    );
    Ok(())
}

/// Queues `rows` jobs of a thousand objects.
pub(crate) async fn fill(service: &Service, rows: usize, prefix: &str) -> Result<Duration> {
    let capture = service.capture("bench/o0").await?.to_string();
    let mut jobs = service.jobs()?;
    let begun = Instant::now();
    for first in (0..rows).step_by(ROWS_A_CALL) {
        let requests: Vec<_> = (first..rows.min(first + ROWS_A_CALL))
            .map(|row| {
                let object = format!("o{}", row % 1000);
                request(&object, &format!("{prefix}{row}"), &capture)
            })
            .collect();
        let count = requests.len();
        let results = jobs.submit_batch(stream::iter(requests)).await?;
        let results = results.into_inner().results;
        let accepted = results
            .iter()
            .filter(|it| matches!(it.outcome, Some(v1::submit_result::Outcome::Job(_))))
            .count();
        ensure!(accepted == count, "{accepted} of {count} rows were taken");
    }
    Ok(begun.elapsed())
}

/// Bulk submit, and what the coordinator holds in memory then.
pub(crate) async fn submit(
    figures: &mut Figures,
    service: &Service,
    load: Load,
    store: &str,
) -> Result<()> {
    let took = fill(service, load.rows, "row").await?;
    figures.alone(
        &format!("bulk submit of {} rows, {store}", load.rows),
        "rows/s",
        &[load.rows as f64 / took.as_secs_f64()],
        Some(Target::AtLeast(5000.0)),
    );
    let again = fill(service, load.rows.min(ROWS_A_CALL), "row").await?;
    figures.alone(
        &format!("the same {ROWS_A_CALL} rows once more, {store}"),
        "rows/s",
        &[load.rows.min(ROWS_A_CALL) as f64 / again.as_secs_f64()],
        None,
    );
    let (now, most) = service.memory()?;
    figures.alone(
        &format!("coordinator's memory with {} queued, {store}", load.rows),
        "MB",
        &[now / 1e6],
        None,
    );
    figures.alone(
        &format!("coordinator's memory at most until then, {store}"),
        "MB",
        &[most / 1e6],
        None,
    );
    Ok(())
}

/// The status screen, one call after the other.
pub(crate) async fn status(
    figures: &mut Figures,
    service: &Service,
    load: Load,
    store: &str,
) -> Result<()> {
    let mut jobs = service.jobs()?;
    let mut times = Vec::new();
    for _ in 0..STATUS_CALLS {
        let begun = Instant::now();
        let status = jobs.status(v1::StatusRequest::default()).await?;
        times.push(begun.elapsed());
        let queued = status.into_inner().jobs_by_state["queued"];
        ensure!(queued == load.rows as u64, "status counts {queued} jobs");
    }
    figures.p95_ms(
        &format!("status over {} jobs, {store}", load.rows),
        &times,
        Some(Target::AtMost(100.0)),
    );
    Ok(())
}

/// What a worker does again and again.
#[derive(Clone, Debug)]
pub(crate) enum Cycle {
    /// Leases a job and completes it with a bundle of this file.
    Job(FileEntry),
    /// Two calls that are refused as soon as they are read: what remains of a cycle without jobs.
    Calls,
}

impl Cycle {
    pub(crate) async fn job(service: &Service) -> Result<Self> {
        let file = service
            .upload("bench/o0", b"a bundle's only file\n")
            .await?;
        Ok(Self::Job(file))
    }

    async fn run(&self, worker: &mut Worker, name: &str) -> Result<()> {
        let Self::Job(bundle) = self else {
            refused_call(worker).await?;
            return refused_call(worker).await;
        };
        let lease = worker.lease(lease_request(name, 5.0)).await?;
        let lease = lease.into_inner().lease.context("the queue is empty")?;
        // As real bundles do, each has a manifest of its own.
        let file = FileEntry {
            path: format!("{}.json", lease.job_id).parse()?,
            ..bundle.clone()
        };
        worker
            .complete(v1::CompleteRequest {
                job: Some(attempt(&lease, name)),
                files: vec![(&file).into()],
                metrics_json: r#"{"mse":4.9}"#.to_owned(),
            })
            .await?;
        Ok(())
    }
}

async fn refused_call(worker: &mut Worker) -> Result<()> {
    let answer = worker.heartbeat(v1::HeartbeatRequest::default()).await;
    ensure!(answer.is_err(), "an empty report was taken");
    Ok(())
}

/// Workers that do this as fast as they can; cycles per second.
pub(crate) async fn cycles(service: &Service, load: Load, cycle: &Cycle) -> Result<f64> {
    let done = Arc::new(AtomicUsize::new(0));
    let mut workers = Vec::new();
    for number in 0..load.workers {
        let mut worker = service.worker()?;
        // The connection is made before the clock starts.
        refused_call(&mut worker).await?;
        workers.push((format!("w{number}"), worker));
    }
    let begun = Instant::now();
    let until = begun + Duration::from_secs_f64(load.secs);
    let tasks = workers.into_iter().map(|(name, mut worker)| {
        let (done, cycle) = (done.clone(), cycle.clone());
        tokio::spawn(async move {
            while Instant::now() < until {
                cycle.run(&mut worker, &name).await?;
                done.fetch_add(1, Ordering::Relaxed);
            }
            anyhow::Ok(())
        })
    });
    let cpu = service.cpu()?;
    for ended in try_join_all(tasks).await? {
        ended?;
    }
    let secs = begun.elapsed().as_secs_f64();
    let rate = done.load(Ordering::Relaxed) as f64 / secs;
    let busy = service.cpu()?.saturating_sub(cpu).as_secs_f64() / secs;
    say(&format!(
        "{rate:.0} cycles/s; the coordinator keeps {busy:.2} cores busy"
    ));
    Ok(rate)
}

/// What the cycles left behind: nothing was taken back, and memory did not grow with the jobs.
pub(crate) fn reports(figures: &mut Figures, service: &Service, store: &str) -> Result<()> {
    let (_, most) = service.memory()?;
    figures.alone(
        &format!("coordinator's memory at most, all cycles included, {store}"),
        "MB",
        &[most / 1e6],
        None,
    );
    Ok(())
}

/// Workers that each hold a job and report about it, for two leases.
pub(crate) async fn connected(figures: &mut Figures, service: &Service, load: Load) -> Result<()> {
    fill(service, load.connected, "held").await?;
    let mut workers = Vec::new();
    for number in 0..load.connected {
        let name = format!("c{number}");
        let mut worker = service.worker()?;
        let lease = worker.lease(lease_request(&name, 10.0)).await?.into_inner();
        let lease = lease.lease.context("the queue is empty")?;
        workers.push((name, worker, lease));
    }
    let (every, until) = (LEASE / 3, Instant::now() + 2 * LEASE);
    let (cpu, begun) = (service.cpu()?, Instant::now());
    let tasks = workers
        .into_iter()
        .enumerate()
        .map(|(index, (name, mut worker, lease))| {
            let first = every * index as u32 / load.connected as u32;
            tokio::spawn(async move {
                let mut times = Vec::new();
                tokio::time::sleep(first).await;
                let mut tick = tokio::time::interval(every);
                while Instant::now() < until {
                    tick.tick().await;
                    let seq = times.len() as u64 + 1;
                    let line = v1::LogLine {
                        seq,
                        level: "info".to_owned(),
                        message: format!("step {seq} loss 0.0280"),
                        ..v1::LogLine::default()
                    };
                    let progress = v1::Progress {
                        stage: "effects".to_owned(),
                        percent: seq as f64,
                        ..v1::Progress::default()
                    };
                    let sent = Instant::now();
                    worker
                        .heartbeat(v1::HeartbeatRequest {
                            job: Some(attempt(&lease, &name)),
                            progress: Some(progress),
                            logs: vec![line],
                        })
                        .await?;
                    times.push(sent.elapsed());
                }
                anyhow::Ok(times)
            })
        });
    let mut times = Vec::new();
    for reported in try_join_all(tasks).await? {
        times.extend(reported.context("a worker lost its job")?);
    }
    let secs = begun.elapsed().as_secs_f64();
    let busy = service.cpu()?.saturating_sub(cpu).as_secs_f64() / secs;
    let name = format!(
        "{} workers that report every {} s",
        load.connected,
        every.as_secs()
    );
    figures.p95_ms(&format!("{name}: answer"), &times, None);
    figures.alone(
        &format!("{name}: coordinator's share of a core"),
        "%",
        &[busy * 100.0],
        None,
    );
    let lost = service.metric("ign_leases_reaped_total").await?;
    figures.alone(
        &format!("{name}: leases lost"),
        "jobs",
        &[lost],
        Some(Target::AtMost(0.0)),
    );
    let (now, _) = service.memory()?;
    figures.alone(
        &format!("{name}: coordinator's memory"),
        "MB",
        &[now / 1e6],
        None,
    );
    Ok(())
}
