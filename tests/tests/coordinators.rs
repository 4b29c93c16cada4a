//! Two coordinators on one Postgres and one bucket, with workers on both: what one takes in the other shows, and when one
//! is killed in the middle the other brings all of it to its end, once.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, ensure};
use ign_e2e::{Api, Client, Coordinator, S3, Setup, path, scripted_agent, wait_until};
use ign_proto::{Digest, v1};
use ign_testkit::Postgres;
use reqwest::Method;
use serde_json::{Value, json};

const MINUTE: Duration = Duration::from_mins(1);
const TOKEN: &str = "ign-coordinators-token-0123456789abcdef";
const OBJECTS: usize = 16;
/// Short, so that what the killed one's workers had goes on soon.
const LEASE_SECS: &str = "3";

/// An upload that one coordinator begins, the other takes on, and the first one ends.
async fn upload_across(a: &Api, b: &Api) -> Result<()> {
    let bytes: Vec<u8> = (0..300_000_u32).map(|i| (i % 251) as u8).collect();
    let session = a.begin_upload("museum/across").await?;
    let patch = |api: &Api, from: usize, to: usize| {
        api.request(Method::PATCH, &session)
            .header("content-range", format!("{from}-{}", to - 1))
            .body(bytes[from..to].to_vec())
    };
    a.send(patch(a, 0, 100_000)).await?;
    let stands = b.send(b.request(Method::GET, &session)).await?;
    ensure!(stands.headers()["range"] == "0-99999", "{stands:?}");
    b.send(patch(b, 100_000, 250_000)).await?;
    let digest = Digest::of(&bytes);
    let end = a
        .request(Method::PUT, &format!("{session}?digest={digest}"))
        .header("content-range", format!("250000-{}", bytes.len() - 1))
        .body(bytes[250_000..].to_vec());
    a.send(end).await?;
    let blob = format!("/v2/museum/across/blobs/{digest}");
    let there = b.send(b.request(Method::HEAD, &blob)).await?;
    ensure!(there.headers()["content-length"] == "300000", "{there:?}");
    Ok(())
}

fn rows(value: &Value) -> Result<&Vec<Value>> {
    value.as_array().context("no list")
}

#[test]
fn what_two_coordinators_share_survives_one_of_them() -> Result<()> {
    let dir = tempfile::Builder::new().prefix("ign-e2e-").tempdir()?;
    let postgres = Postgres::start()?;
    let database = postgres.create_database()?;
    let s3 = S3::start(dir.path(), "access", "secret-0123456789")?;
    let token = dir.path().join("token");
    fs::write(&token, TOKEN)?;
    let start = |name: &str| {
        Coordinator::start(Setup {
            name: name.to_owned(),
            dir: dir.path().to_owned(),
            database: database.clone(),
            store: s3.url(),
            token_file: token.clone(),
            args: vec!["--lease-secs".to_owned(), LEASE_SECS.to_owned()],
            env: s3.env().clone(),
        })
    };
    // Both at once on an empty database: one migrates, the other waits.
    let (mut a, mut b) = (start("a")?, start("b")?);
    a.await_ready()?;
    b.await_ready()?;
    // One thread, that of the test: the processes die with the thread that started them.
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()?;
    let (to_a, to_b) = {
        let _entered = runtime.enter();
        (Api::new(&a.url(), TOKEN)?, Api::new(&b.url(), TOKEN)?)
    };
    let ctl =
        |of: &Coordinator| -> Result<Client> { Ok(Client::of_server(&of.url(), path(&token)?)) };
    let (ctl_a, ctl_b) = (ctl(&a)?, ctl(&b)?);
    runtime.block_on(upload_across(&to_a, &to_b))?;

    // Submitted at either, repeated at the other: one job each.
    let mut jobs: BTreeMap<String, String> = BTreeMap::new();
    for number in 0..OBJECTS {
        let object = format!("museum/object-{number:02}");
        let script = json!([{"print": format!("bakes {object}")}, {"checkpoint": "half"},
            {"sleep_ms": 1200}, {"progress": 50.0}, {"done": 100}]);
        let (first, second) = if number % 2 == 0 {
            (&to_a, &to_b)
        } else {
            (&to_b, &to_a)
        };
        let request = format!("request-{number}");
        let job = runtime.block_on(first.submit(&object, &request, &script))?;
        let again = runtime.block_on(second.submit(&object, &request, &script))?;
        ensure!(job.id == again.id, "two jobs of one submit");
        jobs.insert(job.id, object);
    }
    let ids: Vec<&str> = jobs.keys().map(String::as_str).collect();
    let mut agents = Vec::new();
    for (coordinator, name) in [(&a, "a-1"), (&b, "b-1"), (&a, "a-2"), (&b, "b-2")] {
        agents.push(scripted_agent(
            dir.path(),
            &coordinator.url(),
            TOKEN,
            name,
            None,
        )?);
    }

    // A job that a worker of A runs, watched at B: it is told by the database, not by polling through the job's end.
    let of_a = wait_until("a job of A's worker", MINUTE, || {
        let running = ctl_b.json(&["jobs", "list", "--state", "leased"])?;
        Ok(rows(&running)?
            .iter()
            .find(|job| {
                job["worker"]
                    .as_str()
                    .is_some_and(|name| name.starts_with("a-"))
            })
            .map(|job| job["id"].as_str().unwrap_or_default().to_owned()))
    })?;
    let states: Vec<v1::JobState> = runtime.block_on(async {
        let mut stream = to_b.watch(&of_a).await?;
        let mut states = Vec::new();
        while let Some(job) = tokio::time::timeout(MINUTE, stream.message()).await?? {
            states.push(job.state());
        }
        anyhow::Ok(states)
    })?;
    ensure!(
        states.last() == Some(&v1::JobState::Succeeded),
        "{states:?}"
    );
    let log = ctl_b.logs(&of_a)?;
    ensure!(log.contains("bakes museum/object-"), "{log}");
    ensure!(log == ctl_a.logs(&of_a)?, "the logs differ");

    // Two operators at once: neither hinders the other or a job.
    let care = [["admin", "audit"], ["admin", "gc"]].map(|command| {
        [(&ctl_a, command), (&ctl_b, command)].map(|(ctl, command)| {
            let grace = ["--yes", "--grace", "1h"];
            let args = [
                command.as_slice(),
                if command[1] == "gc" { &grace } else { &[] },
            ]
            .concat();
            (
                args.join(" "),
                ctl.command(&args).and_then(|mut it| Ok(it.spawn()?)),
            )
        })
    });

    // One is killed while its workers hold jobs.
    wait_until("jobs of A's workers", MINUTE, || {
        let running = ctl_b.json(&["jobs", "list", "--state", "leased"])?;
        let held = rows(&running)?.iter().any(|job| {
            job["worker"]
                .as_str()
                .is_some_and(|name| name.starts_with("a-"))
        });
        Ok(held.then_some(()))
    })?;
    for (what, child) in care.into_iter().flatten() {
        let status = child?.wait()?;
        ensure!(status.success(), "{what}: {status}");
    }
    a.kill()?;
    let killed = Instant::now();
    ctl_b.text(&[&["wait", "--timeout", "2m"], ids.as_slice()].concat())?;
    let took = killed.elapsed();
    ensure!(took < MINUTE, "the rest took {took:?} without A");

    // Each object has one version, and the bucket says the same by itself.
    let versions = runtime.block_on(to_b.versions())?;
    let objects: BTreeSet<String> = versions
        .iter()
        .map(|version| version.object.clone().unwrap_or_default().object)
        .collect();
    ensure!(versions.len() == OBJECTS && objects.len() == OBJECTS);
    ensure!(versions.iter().all(|version| version.version == 1));
    let rebuilt = ctl_b.json(&["admin", "rebuild-registry"])?;
    ensure!(
        rebuilt["known"] == OBJECTS && rebuilt["added"] == 0,
        "{rebuilt}"
    );

    // A comes back to the same service: its workers go on, and it tells the same.
    a.replace(None)?;
    a.await_ready()?;
    let script = json!([{"print": "after"}, {"done": 10}]);
    let job = runtime.block_on(to_a.submit("museum/after", "after", &script))?;
    for worker in ["b-1", "b-2"] {
        ctl_b.text(&["worker", "drain", worker])?;
    }
    ctl_a.text(&["wait", "--timeout", "1m", &job.id])?;
    for id in ids {
        let (here, there) = (ctl_a.job(id)?, ctl_b.job(id)?);
        ensure!(here.0 == there.0, "{:?} {:?}", here.0, there.0);
        ensure!(here.state() == "succeeded", "{:?}", here.0);
    }
    let damage = ctl_a.json(&["admin", "events"])?;
    ensure!(
        rows(&damage)?.iter().all(|event| event["kind"] != "damage"),
        "{damage}"
    );
    Ok(())
}
