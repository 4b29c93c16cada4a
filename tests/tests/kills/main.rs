//! Coordinator, agent and Postgres are killed at every fault point; a worker freezes and comes back. Nothing is lost and
//! nothing is published twice.
//!
//! `IGN_KILL_CYCLES=1000 IGN_KILL_SEED=7 cargo test -p ign-e2e --test kills every_fault_point` runs it longer: after each
//! point once, at random.

mod cluster;

use std::collections::{BTreeMap, BTreeSet};
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, ensure};
use cluster::Cluster;
use ign_faults::POINTS;
use ign_proto::v1;
use rand::{RngExt as _, SeedableRng as _};
use rand_pcg::Pcg64Mcg;
use rustix::process::{Pid, Signal, kill_process};
use serde_json::json;

const MINUTE: Duration = Duration::from_mins(1);
const AGENT: &str = "agent-1";
const APPROVED: &str = "approved";
/// Short, so that a killed worker's job goes on soon.
const LEASE_SECS: f64 = 1.0;

fn from_env(name: &str, default: u64) -> u64 {
    std::env::var(name).map_or(default, |text| text.parse().expect("a number"))
}

/// Brings back whatever has died, without a fault.
fn revive(cluster: &mut Cluster) -> Result<()> {
    if !cluster.coordinator_runs() {
        cluster.replace_coordinator(None)?;
    }
    if !cluster.agent_runs(AGENT) {
        cluster.replace_agent(AGENT, None)?;
    }
    Ok(())
}

/// One job, during which one process is killed at one point; whether the point was reached.
fn cycle(cluster: &mut Cluster, number: u64, fault: &str, restart_postgres: bool) -> Result<bool> {
    let agents = fault.starts_with("agent.");
    if agents {
        cluster.replace_agent(AGENT, Some(fault))?;
    } else {
        cluster.replace_coordinator(Some(fault))?;
    }
    let mut reached = false;
    let mut look = |cluster: &mut Cluster| {
        reached |= if agents {
            !cluster.agent_runs(AGENT)
        } else {
            !cluster.coordinator_runs()
        };
        revive(cluster)
    };
    let object = format!("kills/object-{number}");
    // Where a checkpoint matters, the bake lasts until it has arrived.
    let bake_ms = if fault.contains("checkpoint") {
        3000
    } else {
        0
    };
    let script = json!([{"checkpoint": "half"}, {"sleep_ms": bake_ms}, {"done": 100}]);
    let request_id = format!("request-{number}");
    let job = cluster.insist("submit", &mut look, async |api| {
        api.submit(&object, &request_id, &script).await
    })?;
    if restart_postgres {
        cluster.postgres.restart()?;
    }
    let begun = Instant::now();
    let ended = loop {
        look(cluster)?;
        let now = cluster.insist("get", &mut look, async |api| api.get(&job.id).await)?;
        if matches!(
            now.state(),
            v1::JobState::Succeeded | v1::JobState::Failed | v1::JobState::Cancelled
        ) {
            break now;
        }
        ensure!(
            begun.elapsed() < 2 * MINUTE,
            "{fault}: the job does not end: {now:?}"
        );
        std::thread::sleep(Duration::from_millis(30));
    };
    ensure!(
        ended.state() == v1::JobState::Succeeded,
        "{fault}: {ended:?}"
    );
    let again = cluster.insist("submit again", &mut look, async |api| {
        api.submit(&object, &request_id, &script).await
    })?;
    ensure!(
        again.id == job.id,
        "{fault}: a second job came of one submit"
    );
    cluster.insist("name", &mut look, async |api| {
        api.set_alias(&object, "v1", APPROVED).await
    })?;
    // The last points come after the job has ended.
    let late = ["version.", "state.", "agent.completed"];
    if late.iter().any(|point| fault.starts_with(point)) {
        let until = Instant::now() + Duration::from_secs(2);
        while !reached && Instant::now() < until {
            reached = !cluster.agent_runs(AGENT) || !cluster.coordinator_runs();
            std::thread::sleep(Duration::from_millis(20));
        }
    }
    Ok(reached)
}

#[test]
fn every_fault_point_is_killed_at_and_nothing_is_lost_or_doubled() -> Result<()> {
    let cycles = from_env("IGN_KILL_CYCLES", POINTS.len() as u64 + 3);
    let mut rng = Pcg64Mcg::seed_from_u64(from_env("IGN_KILL_SEED", 1));
    let mut cluster = Cluster::start(LEASE_SECS)?;
    cluster.replace_agent(AGENT, None)?;
    let mut reached: BTreeMap<&str, u64> = BTreeMap::new();
    let mut postgres_restarts = 0;
    for number in 0..cycles {
        let first_round = number < POINTS.len() as u64;
        let point = if first_round {
            POINTS[number as usize]
        } else {
            POINTS[rng.random_range(0..POINTS.len())]
        };
        let times = if first_round {
            1
        } else {
            rng.random_range(1..=2)
        };
        let restart_postgres = !first_round && rng.random_ratio(1, 3);
        postgres_restarts += u64::from(restart_postgres);
        let fault = format!("{point}@{times}");
        let hit = cycle(&mut cluster, number, &fault, restart_postgres)
            .with_context(|| format!("cycle {number}, {fault}"))?;
        *reached.entry(point).or_insert(0) += u64::from(hit);
        if (number + 1) % 50 == 0 {
            report(&format!("{} cycles", number + 1));
        }
    }
    revive(&mut cluster)?;
    let never: Vec<&str> = POINTS
        .into_iter()
        .filter(|point| reached.get(point).copied().unwrap_or(0) == 0)
        .collect();
    ensure!(never.is_empty(), "never reached: {never:?}");

    let versions = cluster.insist("list", revive, async |api| api.versions().await)?;
    let objects: BTreeSet<String> = versions
        .iter()
        .map(|version| version.object.clone().unwrap_or_default().object)
        .collect();
    ensure!(
        versions.len() as u64 == cycles && objects.len() as u64 == cycles,
        "{} versions of {} objects after {cycles} jobs",
        versions.len(),
        objects.len()
    );
    let approved = [APPROVED, "latest"];
    ensure!(
        versions
            .iter()
            .all(|it| it.version == 1 && it.aliases == approved)
    );
    // The bucket follows by itself, and says the same, with every file there.
    let begun = Instant::now();
    let bucket = loop {
        let bucket = cluster.bucket()?;
        let mut states = bucket.states.values();
        if bucket.versions.len() as u64 == cycles
            && states.all(|state| state.aliases.keys().eq(&approved))
        {
            break bucket;
        }
        ensure!(begun.elapsed() < MINUTE, "the bucket stays behind");
        std::thread::sleep(Duration::from_millis(200));
    };
    ensure!(bucket.faults.is_empty(), "{:?}", bucket.faults);
    let hits: u64 = reached.values().sum();
    report(&format!(
        "{cycles} cycles, {hits} kills at fault points, {postgres_restarts} restarts of Postgres: 0 lost, 0 doubled"
    ));
    Ok(())
}

#[expect(clippy::print_stderr, reason = "shown with --nocapture")]
fn report(text: &str) {
    eprintln!("{text}");
}

#[test]
fn a_worker_frozen_before_its_publish_changes_nothing_when_it_wakes() -> Result<()> {
    let mut cluster = Cluster::start(LEASE_SECS)?;
    cluster.replace_agent("frozen", Some("agent.sent@1:freeze"))?;
    let script = json!([{"checkpoint": "half"}, {"done": 100}]);
    let job = cluster.insist(
        "submit",
        |_| Ok(()),
        async |api| api.submit("museum/vase", "request-1", &script).await,
    )?;
    // Its bundle is sent; it stops before it says so.
    let frozen = cluster.agents["frozen"].pid();
    let begun = Instant::now();
    while !std::fs::read_to_string(format!("/proc/{frozen}/stat"))?.contains(") T ") {
        ensure!(begun.elapsed() < MINUTE, "it does not freeze");
        std::thread::sleep(Duration::from_millis(20));
    }
    cluster.replace_agent("fresh", None)?;
    let begun = Instant::now();
    let ended = loop {
        let now = cluster.insist("get", |_| Ok(()), async |api| api.get(&job.id).await)?;
        if now.state() == v1::JobState::Succeeded {
            break now;
        }
        ensure!(begun.elapsed() < 2 * MINUTE, "{now:?}");
        std::thread::sleep(Duration::from_millis(50));
    };
    ensure!(
        ended.worker == "fresh" && ended.attempt >= 2,
        "the other worker did not end it: {ended:?}"
    );
    let before = (cluster.bucket()?, files(&cluster.store().join("versions"))?);

    let pid = Pid::from_raw(i32::try_from(frozen)?).context("a process id")?;
    kill_process(pid, Signal::CONT)?;
    let begun = Instant::now();
    while !cluster.log_of("frozen").contains("lease lost") {
        ensure!(
            begun.elapsed() < MINUTE,
            "it was not told: {}",
            cluster.log_of("frozen")
        );
        std::thread::sleep(Duration::from_millis(50));
    }
    let now = cluster.insist("get", |_| Ok(()), async |api| api.get(&job.id).await)?;
    ensure!(now == ended, "the job changed: {now:?}");
    let versions = cluster.insist("list", |_| Ok(()), async |api| api.versions().await)?;
    ensure!(versions.len() == 1, "{versions:?}");
    let after = (cluster.bucket()?, files(&cluster.store().join("versions"))?);
    ensure!(
        after == before,
        "the bucket shows something of the stale attempt"
    );
    Ok(())
}

fn files(folder: &std::path::Path) -> Result<BTreeMap<std::path::PathBuf, Vec<u8>>> {
    let mut found = BTreeMap::new();
    for entry in std::fs::read_dir(folder)? {
        let entry = entry?;
        if entry.file_type()?.is_dir() {
            found.extend(files(&entry.path())?);
        } else {
            found.insert(entry.path(), std::fs::read(entry.path())?);
        }
    }
    Ok(found)
}

/// With the times that a coordinator has by default.
#[test]
fn a_killed_workers_job_runs_elsewhere_within_60_seconds() -> Result<()> {
    let mut cluster = Cluster::start(45.0)?;
    cluster.replace_agent("killed", None)?;
    let script = json!([{"checkpoint": "half"}, {"sleep_ms": 600_000}]);
    let job = cluster.insist(
        "submit",
        |_| Ok(()),
        async |api| api.submit("museum/vase", "request-1", &script).await,
    )?;
    let state = |cluster: &mut Cluster| {
        cluster.insist("get", |_| Ok(()), async |api| api.get(&job.id).await)
    };
    let begun = Instant::now();
    while state(&mut cluster)?.checkpoint_digest.is_empty() {
        ensure!(begun.elapsed() < MINUTE, "no checkpoint");
        std::thread::sleep(Duration::from_millis(50));
    }
    cluster.replace_agent("other", None)?;
    if let Some(mut killed) = cluster.agents.remove("killed") {
        killed.kill()?;
    }
    let begun = Instant::now();
    loop {
        let now = state(&mut cluster)?;
        if now.attempt == 2 && now.state() == v1::JobState::Leased {
            ensure!(now.worker == "other", "{now:?}");
            break;
        }
        ensure!(begun.elapsed() < MINUTE, "not rescued: {now:?}");
        std::thread::sleep(Duration::from_millis(100));
    }
    report(&format!(
        "rescued after {:.1} s",
        begun.elapsed().as_secs_f64()
    ));
    Ok(())
}
