//! Twelve objects, three workers, Postgres and S3: a worker and the coordinator are killed, and nothing is lost.

use std::fmt::Write as _;
use std::fs;
use std::time::Duration;

use anyhow::{Context as _, Result, ensure};
use ign_e2e::{Demo, Job, Stack, demo_capture, wait_until};

const OBJECTS: usize = 12;
const MINUTE: Duration = Duration::from_mins(1);
/// The job that is killed trains long enough to be killed in the middle; its checkpoints come every second.
const LONG: [&str; 8] = [
    "--size",
    "32",
    "--budget-secs",
    "30",
    "--priority",
    "10",
    "--set",
    "checkpoint_secs=1",
];
const SHORT: [&str; 4] = ["--size", "32", "--budget-secs", "4"];

#[test]
fn twelve_objects_survive_a_killed_worker_and_a_killed_coordinator() -> Result<()> {
    let mut stack = Stack::start(3)?;
    let client = stack.client()?;
    let captures = stack.dir.path().join("captures");
    let mut list = "path,collection,object\n".to_owned();
    for number in 0..OBJECTS {
        let shape = ["vase", "bowl", "sphere"][number % 3];
        let dir = captures.join(format!("object-{number:02}"));
        fs::create_dir_all(&captures)?;
        demo_capture(
            &dir,
            Demo {
                shape,
                seed: number as u64,
                ..Demo::default()
            },
        )?;
        if number > 0 {
            writeln!(list, "{},museum,object-{number:02}", dir.display())?;
        }
    }
    let csv = stack.dir.path().join("captures.csv");
    fs::write(&csv, list)?;
    let csv = csv.to_str().context("the path is no UTF-8")?;
    let rows = client.json(&[&["submit", "--manifest", csv], SHORT.as_slice()].concat())?;
    ensure!(
        rows.as_array()
            .is_some_and(|rows| rows.len() == OBJECTS - 1),
        "not all were queued: {rows}"
    );

    // Last, so that it is in the middle of training when it is looked at, however long the others took to submit.
    let long = client.submit(&captures.join("object-00"), "museum/object-00", &LONG)?;

    // In the middle of training: a checkpoint is stored, the job runs on.
    let victim = wait_until("a checkpoint of the long job", 3 * MINUTE, || {
        let job = client.job(long.id())?;
        ensure!(
            !job.has_ended(),
            "the long job ended too early: {:?}",
            job.0
        );
        Ok((job.state() == "leased" && job.has_checkpoint()).then_some(job))
    })?;
    ensure!(
        victim.attempt() == 1,
        "the long job was tried before: {:?}",
        victim.0
    );
    let killed = stack.kill_worker_of(&victim)?;
    stack.kill_coordinator()?;
    ensure!(
        !client.run(&["status"])?.status.success(),
        "somebody answers for the killed coordinator"
    );
    stack.restart_coordinator()?;
    ensure!(
        !stack.running_workers().contains(&killed),
        "the killed worker runs"
    );

    let jobs = wait_until("the end of all jobs", 12 * MINUTE, || {
        let jobs = client.jobs()?;
        Ok(jobs.iter().all(Job::has_ended).then_some(jobs))
    })?;
    ensure!(
        jobs.len() == OBJECTS,
        "{} jobs instead of {OBJECTS}",
        jobs.len()
    );
    for job in &jobs {
        ensure!(
            job.state() == "succeeded",
            "{} {}: {:?}",
            job.object(),
            job.state(),
            job.0
        );
    }
    // The killed job went on from its checkpoint.
    let long = client.job(long.id())?;
    ensure!(
        long.attempt() == 2,
        "the killed job took {} attempts",
        long.attempt()
    );
    ensure!(long.worker() != killed, "the dead worker ended it");
    let step = resumed_step(&client.logs(long.id())?)?;
    ensure!(step > 0, "the killed job began again");

    // Exactly one version each, and every one is whole.
    let versions = client.versions("museum")?;
    let expected: Vec<_> = (0..OBJECTS)
        .map(|number| (format!("object-{number:02}"), 1))
        .collect();
    ensure!(versions == expected, "versions: {versions:?}");
    for (object, _) in versions {
        let out = stack.dir.path().join("fetched").join(&object);
        fs::create_dir_all(stack.dir.path().join("fetched"))?;
        client.fetch_verified(&format!("museum/{object}"), out)?;
    }

    // The same captures again cost no job.
    let rows = client.json(&[&["submit", "--manifest", csv], SHORT.as_slice()].concat())?;
    for row in rows.as_array().context("no rows")? {
        ensure!(row["outcome"] == "known", "queued twice: {row}");
    }
    Ok(())
}

/// The step that the last resumed attempt says it began at.
fn resumed_step(log: &str) -> Result<u64> {
    let line = log.lines().rfind(|line| line.contains("resumed at step"));
    let line = line.with_context(|| format!("no attempt resumed:\n{log}"))?;
    let (_, rest) = line.split_once("resumed at step ").context("no step")?;
    rest.split_whitespace()
        .next()
        .and_then(|step| step.parse().ok())
        .with_context(|| format!("no step in {line}"))
}
