//! What takes a server: several coordinators on one database, and a server that goes away.

use std::collections::BTreeSet;
use std::time::{Duration, Instant};

use ign_queue::{Settings, StoreError};
use ign_testkit::Postgres;

use crate::bench::{Bench, PATIENT, request, worker};

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn two_stores_lease_each_job_once() {
    let bench = Bench::postgres().await;
    let other = bench.open(PATIENT).await;
    for result in bench
        .store
        .submit_batch((0..60).map(|_| request("museum/vase")).collect())
        .await
        .unwrap()
    {
        result.unwrap();
    }
    let mut tasks = tokio::task::JoinSet::new();
    for index in 0..16 {
        let store = if index % 2 == 0 {
            bench.store.clone()
        } else {
            other.clone()
        };
        tasks.spawn(async move {
            let mut leased = Vec::new();
            while let Some(job) = store.lease(&worker(&format!("w{index}"))).await.unwrap() {
                leased.push(job.id);
            }
            leased
        });
    }
    let all: Vec<_> = tasks.join_all().await.into_iter().flatten().collect();
    assert_eq!(all.len(), 60);
    assert_eq!(all.into_iter().collect::<BTreeSet<_>>().len(), 60);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_change_wakes_the_other_coordinator_before_it_polls() {
    let bench = Bench::postgres().await;
    let lazy = Settings {
        poll: Duration::from_mins(1),
        ..PATIENT
    };
    let other = bench.open(lazy).await;
    // Until the listener is connected, a change may be missed: ask for several.
    let mut heard = Duration::MAX;
    for _ in 0..50 {
        let mut changes = other.changes();
        bench.submit("museum/vase").await;
        let start = Instant::now();
        changes.wait(Duration::from_millis(200)).await;
        heard = heard.min(start.elapsed());
        if heard < Duration::from_millis(100) {
            return;
        }
    }
    panic!("no change was heard within {heard:?}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_restarted_server_is_an_outage_and_not_a_loss() {
    let postgres = Postgres::start().unwrap();
    let url = postgres.create_database().unwrap();
    let store = ign_queue::open(&url, PATIENT).await.unwrap();
    let job = store.submit(request("museum/vase")).await.unwrap();
    postgres.stop().unwrap();
    match store.submit(request("museum/vase")).await {
        Err(StoreError::Unavailable { .. }) => {}
        other => panic!("a dead server gave {other:?}"),
    }
    postgres.resume().unwrap();
    let deadline = Instant::now() + Duration::from_secs(10);
    let back = loop {
        match store.get(job.id).await {
            Ok(back) => break back,
            Err(StoreError::Unavailable { .. }) if Instant::now() < deadline => {}
            Err(error) => panic!("{error:?}"),
        }
    };
    assert_eq!(back, job);
    assert_eq!(
        store.lease(&worker("w")).await.unwrap().map(|job| job.id),
        Some(job.id)
    );
}
