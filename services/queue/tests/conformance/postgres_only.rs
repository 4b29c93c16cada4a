//! What takes a server: several coordinators on one database, and a server that goes away.

use std::collections::BTreeSet;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use ign_proto::CollectionId;
use ign_queue::{Collection, FailureKind, Settings, StoreError};
use ign_testkit::Postgres;
use rcgen::{BasicConstraints, CertificateParams, IsCa, Issuer, KeyPair};

use crate::bench::{Bench, PATIENT, failure, request, worker};

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
async fn two_stores_that_lease_from_limited_collections_never_wait_for_each_other_in_a_ring() {
    const JOBS: usize = 150;
    let bench = Bench::postgres().await;
    let stores = [bench.store.clone(), bench.open(PATIENT).await];
    let names = ["library", "museum"].map(|name| name.parse::<CollectionId>().unwrap());
    for name in &names {
        let mut collection = Collection::new(name.clone());
        collection.max_running = 6;
        bench.store.set_collection(collection).await.unwrap();
        let requests = (0..JOBS).map(|_| request(&format!("{name}/vase")));
        for submitted in bench.store.submit_batch(requests.collect()).await.unwrap() {
            submitted.unwrap();
        }
    }
    let left = std::sync::Arc::new(AtomicUsize::new(2 * JOBS));
    let mut tasks = tokio::task::JoinSet::new();
    for index in 0..32 {
        // Each store asks now for the one, now for the other, in the same transaction too.
        let store = stores[index % 2].clone();
        let within = BTreeSet::from([names[index / 2 % 2].clone()]);
        let left = left.clone();
        tasks.spawn(async move {
            let me = worker(&format!("w{index}"));
            while left.load(Ordering::Relaxed) > 0 {
                let leased = store.lease_within(&me, None, Some(&within)).await;
                let Some(job) = leased.expect("no claim is a victim") else {
                    tokio::time::sleep(Duration::from_millis(1)).await;
                    continue;
                };
                let failure = failure(FailureKind::InvalidInput);
                let ended = store.fail(job.id, job.attempt, failure, Vec::new()).await;
                assert!(!ended.unwrap());
                left.fetch_sub(1, Ordering::Relaxed);
            }
        });
    }
    tasks.join_all().await;
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

/// Repeats a call while the database is away.
async fn insist<T, F: Future<Output = ign_queue::store::Result<T>>>(call: impl Fn() -> F) -> T {
    let deadline = Instant::now() + Duration::from_mins(1);
    loop {
        match call().await {
            Ok(value) => return value,
            Err(StoreError::Unavailable { .. }) if Instant::now() < deadline => {
                tokio::time::sleep(Duration::from_millis(5)).await;
            }
            Err(error) => panic!("{error:?}"),
        }
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn three_hundred_clients_share_a_small_pool() {
    let bench = Bench::postgres().await;
    let begun = Instant::now();
    let mut tasks = tokio::task::JoinSet::new();
    for index in 0..300 {
        let store = bench.store.clone();
        tasks.spawn(async move {
            let request = request("museum/vase");
            let job = insist(|| store.submit(request.clone())).await;
            let me = worker(&format!("w{index}"));
            let leased = loop {
                // None while the last rows are in others' hands.
                if let Some(leased) = insist(|| store.lease(&me)).await {
                    break leased;
                }
            };
            insist(|| store.heartbeat(leased.id, leased.attempt, None, Vec::new())).await;
            insist(|| store.status(None, 5)).await;
            (job.id, leased.id)
        });
    }
    let (submitted, leased): (BTreeSet<_>, BTreeSet<_>) =
        tasks.join_all().await.into_iter().unzip();
    assert_eq!(submitted.len(), 300);
    assert_eq!(leased, submitted, "each job went to one client");
    assert!(
        begun.elapsed() < Duration::from_mins(1),
        "{:?}",
        begun.elapsed()
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn killed_connections_lose_and_double_nothing() {
    let bench = Bench::postgres().await;
    let admin = sqlx::PgPool::connect(&bench.url).await.unwrap();
    let done = std::sync::Arc::new(std::sync::atomic::AtomicBool::new(false));
    let killer = tokio::spawn({
        let done = done.clone();
        async move {
            let mut killed = 0_usize;
            while !done.load(std::sync::atomic::Ordering::Relaxed) {
                let ended: Vec<bool> = sqlx::query_scalar(
                    "select pg_terminate_backend(pid) from pg_stat_activity \
                     where datname = current_database() and application_name = 'ign'",
                )
                .fetch_all(&admin)
                .await
                .unwrap();
                killed += ended.len();
                tokio::time::sleep(Duration::from_millis(50)).await;
            }
            killed
        }
    });
    let mut tasks = tokio::task::JoinSet::new();
    for index in 0..8 {
        let store = bench.store.clone();
        tasks.spawn(async move {
            let me = worker(&format!("w{index}"));
            let mut acknowledged = Vec::new();
            for number in 0..12_u8 {
                let object = format!("museum/object-{index}-{number}");
                let request = request(&object);
                acknowledged.push(insist(|| store.submit(request.clone())).await.id);
                // A lease whose answer was lost runs out; here nobody waits for that, others are leased.
                if let Some(job) = insist(|| store.lease(&me)).await {
                    let bundle = crate::bench::bundle(number);
                    insist(|| store.publish_and_complete(job.id, job.attempt, bundle.clone()))
                        .await;
                }
            }
            acknowledged
        });
    }
    let acknowledged: BTreeSet<_> = tasks.join_all().await.into_iter().flatten().collect();
    done.store(true, std::sync::atomic::Ordering::Relaxed);
    assert!(
        killer.await.unwrap() > 20,
        "hardly any connection was killed"
    );
    assert_eq!(acknowledged.len(), 96);
    let every = ign_queue::VersionFilter::default();
    let all = insist(|| bench.store.versions(&every)).await;
    let jobs: BTreeSet<_> = all.iter().map(|version| version.job).collect();
    assert_eq!(jobs.len(), all.len(), "a job published twice");
    assert!(jobs.is_subset(&acknowledged) && !jobs.is_empty());
    for id in acknowledged {
        let job = insist(|| bench.store.get(id)).await;
        job.check().unwrap();
        assert_eq!(job.version.is_some(), jobs.contains(&id));
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_transaction_held_open_holds_up_its_rows_alone_and_not_for_ever() {
    let bench = Bench::postgres().await;
    let held = bench.submit("museum/vase").await;
    let other = bench.submit("museum/urn").await;
    let pool = sqlx::PgPool::connect(&bench.url).await.unwrap();
    let mut transaction = pool.begin().await.unwrap();
    sqlx::query("select * from jobs where id = $1 for update")
        .bind(held.id.as_uuid())
        .execute(&mut *transaction)
        .await
        .unwrap();
    // Claims pass it by.
    assert_eq!(bench.lease("w").await.map(|job| job.id), Some(other.id));
    assert_eq!(bench.lease("w").await, None);
    bench.store.reap().await.unwrap();
    bench.store.status(None, 5).await.unwrap();
    let begun = Instant::now();
    match bench.store.cancel(held.id).await {
        Err(StoreError::Unavailable { determinate, .. }) => assert!(determinate),
        other => panic!("a row that is held gave {other:?}"),
    }
    assert!(
        begun.elapsed() < Duration::from_secs(20),
        "{:?}",
        begun.elapsed()
    );
    transaction.rollback().await.unwrap();
    bench.store.cancel(held.id).await.unwrap();
}

/// `sslmode=verify-full`: the certificate must be the authority's and name the host; nothing is said in plain text.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_connection_is_encrypted_and_the_server_is_who_it_says() {
    let dir = tempfile::tempdir().unwrap();
    let mut params = CertificateParams::default();
    params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
    let key = KeyPair::generate().unwrap();
    let ca = dir.path().join("ca.pem");
    std::fs::write(&ca, params.self_signed(&key).unwrap().pem()).unwrap();
    let issuer = Issuer::new(params, key);
    let other = dir.path().join("other.pem");
    let stranger = rcgen::generate_simple_self_signed(["127.0.0.1".to_owned()]).unwrap();
    std::fs::write(&other, stranger.cert.pem()).unwrap();
    let server = |name: &str| {
        let key = KeyPair::generate().unwrap();
        let params = CertificateParams::new([name.to_owned()]).unwrap();
        let certificate = params.signed_by(&key, &issuer).unwrap().pem();
        Postgres::start_with_tls(&certificate, &key.serialize_pem()).unwrap()
    };
    let verified = |url: &str, ca: &std::path::Path| {
        format!("{url}?sslmode=verify-full&sslrootcert={}", ca.display())
    };

    let here = server("127.0.0.1");
    let url = here.create_database().unwrap();
    let store = ign_queue::open(&verified(&url, &ca), PATIENT)
        .await
        .unwrap();
    let job = store.submit(request("museum/vase")).await.unwrap();
    assert_eq!(store.get(job.id).await.unwrap(), job);
    let encrypted = here.execute(
        "postgres",
        "select bool_and(ssl) from pg_stat_ssl join pg_stat_activity using (pid) where application_name = 'ign'",
    );
    assert_eq!(encrypted.unwrap(), "t");
    // The password of a URL is not sent to whoever listens there.
    for wrong in [verified(&url, &other), format!("{url}?sslmode=disable")] {
        let refused = ign_queue::open(&wrong, PATIENT).await;
        assert!(refused.is_err(), "{wrong}");
    }
    let elsewhere = server("db.example");
    let url = elsewhere.create_database().unwrap();
    let refused = ign_queue::open(&verified(&url, &ca), PATIENT).await;
    assert!(refused.is_err(), "a certificate of another host");
}
