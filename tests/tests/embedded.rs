//! The embedded service survives SIGKILL of everything at once.

use std::time::Duration;

use anyhow::{Context as _, Result, ensure};
use ign_e2e::{Demo, Embedded, Job, demo_capture, wait_until};

const MINUTE: Duration = Duration::from_mins(1);

#[test]
fn kill_of_everything_loses_nothing() -> Result<()> {
    let dir = tempfile::Builder::new().prefix("ign-e2e-").tempdir()?;
    let mut service = Embedded::start(&dir.path().join("data"), 2)?;
    let client = service.client()?;
    for (number, shape) in ["vase", "bowl", "sphere"].into_iter().enumerate() {
        demo_capture(
            &dir.path().join(shape),
            Demo {
                shape,
                seed: number as u64,
                ..Demo::default()
            },
        )?;
    }
    let long = client.submit(
        &dir.path().join("vase"),
        "local/vase",
        &[
            "--size",
            "32",
            "--budget-secs",
            "20",
            "--priority",
            "10",
            "--set",
            "checkpoint_secs=1",
        ],
    )?;
    for shape in ["bowl", "sphere"] {
        client.submit(
            &dir.path().join(shape),
            &format!("local/{shape}"),
            &["--size", "32", "--budget-secs", "6"],
        )?;
    }
    wait_until("a checkpoint of the long job", 3 * MINUTE, || {
        let job = client.job(long.id())?;
        ensure!(
            !job.has_ended(),
            "the long job ended too early: {:?}",
            job.0
        );
        Ok((job.state() == "leased" && job.has_checkpoint()).then_some(()))
    })?;
    let killed = service.kill_everything()?;
    ensure!(
        killed >= 3,
        "two agents and a bake should have run, {killed} processes did"
    );
    service.restart()?;

    let jobs = wait_until("the end of all jobs", 8 * MINUTE, || {
        let jobs = client.jobs()?;
        Ok(jobs.iter().all(Job::has_ended).then_some(jobs))
    })?;
    for job in &jobs {
        ensure!(
            job.state() == "succeeded",
            "{} {}: {:?}",
            job.object(),
            job.state(),
            job.0
        );
    }
    let log = client.logs(long.id())?;
    let resumed = log
        .lines()
        .rfind(|line| line.contains("resumed at step"))
        .with_context(|| format!("no attempt resumed:\n{log}"))?;
    ensure!(
        !resumed.contains("resumed at step 0 "),
        "the killed job began again: {resumed}"
    );

    let expected: Vec<_> = ["bowl", "sphere", "vase"]
        .map(|object| (object.to_owned(), 1))
        .into();
    ensure!(
        client.versions("local")? == expected,
        "versions: {:?}",
        client.versions("local")?
    );
    for (object, _) in expected {
        client.fetch_verified(
            &format!("local/{object}"),
            dir.path().join(format!("{object}-bundle")),
        )?;
    }
    Ok(())
}
