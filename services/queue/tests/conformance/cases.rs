//! What every store must do.

use std::collections::{BTreeMap, BTreeSet};
use std::time::{Duration, Instant};

use chrono::{DateTime, Utc};
use ign_proto::{Attempt, JobId};
use ign_queue::{
    Backoff, Checkpoint, Collection, FailureKind, JobFilter, JobSpec, JobState, Level, NewLogLine,
    NewVersion, Progress, Settings, StoreError, Submit, VersionFilter,
};

pub(crate) use crate::tokens::{
    tokens_rotate_expire_and_end, workers_stay_within_their_collections,
};
pub(crate) use crate::webhooks::{
    deliveries_go_on_until_they_are_taken_or_given_up, ends_are_announced,
};

use crate::bench::{
    Bench, PATIENT, TRACE, after, bundle, digest, failure, kind, name, request, spec, worker,
};

fn line(source_seq: u64, message: &str) -> NewLogLine {
    NewLogLine {
        source_seq,
        at: DateTime::<Utc>::UNIX_EPOCH,
        level: Level::Info,
        message: message.to_owned(),
    }
}

fn progress(percent: f64) -> Progress {
    Progress {
        stage: "effects".to_owned(),
        percent,
        eta_secs: Some(12.5),
        error: Some(f64::NAN),
        message: "step 7\0".to_owned(),
    }
}

pub(crate) async fn submits_are_idempotent(bench: &Bench) {
    let first = request("museum/vase");
    let job = bench.store.submit(first.clone()).await.unwrap();
    job.check().unwrap();
    assert_eq!(
        (job.state, job.attempt, job.spec.max_attempts),
        (JobState::Queued, Attempt(1), 4)
    );
    assert_eq!(bench.store.submit(first.clone()).await.unwrap(), job);

    let mut other = first.clone();
    other.spec.priority = 5;
    assert_eq!(kind(&bench.store.submit(other).await), "conflict");

    let elsewhere = Submit {
        request_id: first.request_id.clone(),
        spec: spec("library/vase"),
        traceparent: None,
    };
    assert_ne!(bench.store.submit(elsewhere).await.unwrap().id, job.id);

    // Also when the job has moved on, and when the same request comes many times at once.
    bench.lease("w").await.unwrap();
    // The trace is that of the first call.
    let repeated = Submit {
        traceparent: None,
        ..first
    };
    let same = bench.store.submit(repeated).await.unwrap();
    assert_eq!(
        (same.id, same.traceparent.as_deref()),
        (job.id, Some(TRACE))
    );
    let racing = request("museum/urn");
    let mut tasks = tokio::task::JoinSet::new();
    for _ in 0..16 {
        let (store, racing) = (bench.store.clone(), racing.clone());
        tasks.spawn(async move { store.submit(racing).await.unwrap().id });
    }
    assert_eq!(
        tasks
            .join_all()
            .await
            .into_iter()
            .collect::<BTreeSet<_>>()
            .len(),
        1
    );
}

pub(crate) async fn worthless_requests_are_refused(bench: &Bench) {
    let good = request("museum/vase");
    let spec = |spec| Submit {
        spec,
        ..good.clone()
    };
    let with_recipe = |recipe: &str| {
        spec(JobSpec {
            recipe_json: recipe.to_owned(),
            ..good.spec.clone()
        })
    };
    let label = ("a".to_owned(), "\0".to_owned());
    for (what, bad) in [
        (
            "no key",
            Submit {
                request_id: String::new(),
                ..good.clone()
            },
        ),
        (
            "long key",
            Submit {
                request_id: "x".repeat(201),
                ..good.clone()
            },
        ),
        (
            "control character",
            Submit {
                request_id: "a\0b".to_owned(),
                ..good.clone()
            },
        ),
        ("no JSON", with_recipe("{")),
        ("no object", with_recipe("[1]")),
        (
            "NUL in a label",
            spec(JobSpec {
                labels: [label].into(),
                ..good.spec.clone()
            }),
        ),
        (
            "attempts",
            spec(JobSpec {
                max_attempts: 101,
                ..good.spec.clone()
            }),
        ),
    ] {
        assert_eq!(kind(&bench.store.submit(bad).await), "invalid", "{what}");
    }
    assert!(
        bench
            .store
            .list(&JobFilter::default(), None, 10)
            .await
            .unwrap()
            .jobs
            .is_empty()
    );
    assert_eq!(kind(&bench.store.get(JobId::generate()).await), "not found");
    assert_eq!(
        kind(&bench.store.cancel(JobId::generate()).await),
        "not found"
    );
    assert_eq!(
        kind(&bench.store.logs(JobId::generate(), 0, 10).await),
        "not found"
    );
}

pub(crate) async fn batches_answer_each_request(bench: &Bench) {
    let mut requests: Vec<Submit> = (0..1200)
        .map(|i| {
            request(if i % 2 == 0 {
                "museum/vase"
            } else {
                "library/urn"
            })
        })
        .collect();
    requests[7].spec.recipe_json.truncate(1);
    requests[900] = requests[3].clone();
    requests[901] = Submit {
        spec: with_priority(&requests[5], 9),
        ..requests[5].clone()
    };
    let results = bench.store.submit_batch(requests.clone()).await.unwrap();
    assert_eq!(results.len(), 1200);
    assert_eq!(kind(&results[7]), "invalid");
    assert_eq!(kind(&results[901]), "conflict");
    assert_eq!(
        results[900].as_ref().unwrap().id,
        results[3].as_ref().unwrap().id
    );
    let ids: BTreeSet<_> = results.iter().flatten().map(|job| job.id).collect();
    assert_eq!(ids.len(), 1200 - 3);

    // The whole batch again: nothing new. Jobs are leased in the order of the batch.
    let again = bench.store.submit_batch(requests.clone()).await.unwrap();
    assert_eq!(
        again
            .iter()
            .flatten()
            .map(|job| job.id)
            .collect::<BTreeSet<_>>(),
        ids
    );
    let status = bench.store.status(None, 1200).await.unwrap();
    assert_eq!(status.counts[&JobState::Queued], 1197);
    let museum: Vec<_> = (0..1200)
        .filter(|i| i % 2 == 0 && *i != 900)
        .map(|i| requests[i].request_id.clone())
        .collect();
    let listed: Vec<_> = status
        .next_queued
        .iter()
        .filter(|(job, _)| job.spec.object == name("museum/vase"))
        .map(|(job, _)| job.request_id.clone())
        .collect();
    assert_eq!(listed[..], museum[..listed.len()]);
    assert!(
        bench
            .store
            .submit_batch(Vec::new())
            .await
            .unwrap()
            .is_empty()
    );
}

fn with_priority(request: &Submit, priority: i32) -> JobSpec {
    JobSpec {
        priority,
        ..request.spec.clone()
    }
}

pub(crate) async fn life_of_a_job(bench: &Bench) {
    let submitted = bench.submit("museum/vase").await;
    let job = bench.lease("w1").await.unwrap();
    assert_eq!(
        (job.id, job.state, job.attempt),
        (submitted.id, JobState::Leased, Attempt(1))
    );
    assert_eq!(job.worker.as_ref().unwrap().as_str(), "w1");
    assert_eq!(job.spec, submitted.spec);
    let until = job.lease_until.unwrap() - job.started_at.unwrap();
    assert_eq!(until.to_std().unwrap(), PATIENT.lease);
    assert_eq!(bench.lease("w2").await, None);

    let orders = bench
        .store
        .heartbeat(job.id, job.attempt, Some(progress(250.0)), Vec::new())
        .await
        .unwrap();
    assert!(!orders.cancel && !orders.drain);
    let seen = bench.store.get(job.id).await.unwrap().progress.unwrap();
    assert_eq!(
        (seen.percent, seen.eta_secs, seen.error),
        (100.0, Some(12.5), None)
    );
    assert_eq!(seen.message, "step 7\u{FFFD}");

    let checkpoint = Checkpoint {
        digest: digest(2),
        size_bytes: u64::from(u32::MAX) * 3,
    };
    bench
        .store
        .checkpoint(job.id, job.attempt, checkpoint.clone())
        .await
        .unwrap();
    assert_eq!(
        bench.store.get(job.id).await.unwrap().checkpoint,
        Some(checkpoint)
    );

    let version = bench
        .store
        .publish_and_complete(job.id, job.attempt, bundle(3))
        .await
        .unwrap();
    assert_eq!(
        (version.version, version.job, &version.bundle),
        (1, job.id, &bundle(3))
    );
    assert_eq!(version.aliases, ["latest"]);
    let done = bench.store.get(job.id).await.unwrap();
    done.check().unwrap();
    assert_eq!((done.state, done.version), (JobState::Succeeded, Some(1)));
    for reference in ["", "latest", "v1", digest(3).as_str()] {
        assert_eq!(
            bench
                .store
                .version(&name("museum/vase"), reference)
                .await
                .unwrap(),
            version,
            "{reference}"
        );
    }
    for reference in [
        "v2",
        "approved",
        "v99999999999",
        digest(4).as_str(),
        "no such thing",
    ] {
        assert_eq!(
            kind(&bench.store.version(&name("museum/vase"), reference).await),
            "not found",
            "{reference}"
        );
    }
}

pub(crate) async fn publish_is_idempotent(bench: &Bench) {
    let job = bench.running("museum/vase").await;
    let publish = |number| {
        bench
            .store
            .publish_and_complete(job.id, job.attempt, bundle(number))
    };
    let mut tasks = tokio::task::JoinSet::new();
    for _ in 0..12 {
        let store = bench.store.clone();
        tasks.spawn(async move {
            store
                .publish_and_complete(job.id, job.attempt, bundle(3))
                .await
                .unwrap()
        });
    }
    let versions = tasks.join_all().await;
    assert!(
        versions
            .iter()
            .all(|version| *version == versions[0] && version.version == 1)
    );
    assert_eq!(publish(3).await.unwrap(), versions[0]);
    assert_eq!(kind(&publish(4).await), "lease lost");
    let bad = NewVersion {
        metrics_json: "no".to_owned(),
        ..bundle(3)
    };
    assert_eq!(
        kind(
            &bench
                .store
                .publish_and_complete(job.id, job.attempt, bad)
                .await
        ),
        "invalid"
    );
    assert_eq!(
        bench
            .store
            .versions(&VersionFilter::default())
            .await
            .unwrap()
            .len(),
        1
    );

    // The same content from another job is a version of its own: it has its own provenance.
    let next = bench.running("museum/vase").await;
    let second = bench
        .store
        .publish_and_complete(next.id, next.attempt, bundle(3))
        .await
        .unwrap();
    assert_eq!(
        (second.version, second.aliases.as_slice()),
        (2, &["latest".to_owned()][..])
    );
    assert!(
        bench
            .store
            .version(&name("museum/vase"), "v1")
            .await
            .unwrap()
            .aliases
            .is_empty()
    );
    assert_eq!(publish(3).await.unwrap().version, 1);
}

pub(crate) async fn concurrent_publications_of_one_object_get_distinct_versions(bench: &Bench) {
    let mut tasks = tokio::task::JoinSet::new();
    for number in 0..8 {
        bench.submit("museum/vase").await;
        let job = bench.lease(&format!("w{number}")).await.unwrap();
        let store = bench.store.clone();
        tasks.spawn(async move {
            store
                .publish_and_complete(job.id, job.attempt, bundle(number))
                .await
                .unwrap()
                .version
        });
    }
    let versions: BTreeSet<_> = tasks.join_all().await.into_iter().collect();
    assert_eq!(versions, (1..=8).collect());
    assert_eq!(
        bench
            .store
            .version(&name("museum/vase"), "latest")
            .await
            .unwrap()
            .version,
        8
    );
}

pub(crate) async fn a_holder_is_that_of_its_attempt(bench: &Bench) {
    let store = &bench.store;
    let submitted = bench.submit("museum/vase").await;
    let lease = async |holder| {
        let leased = store.lease_within(&worker("w"), holder, None).await;
        leased.unwrap().unwrap()
    };
    let first = lease(Some("token-a")).await;
    assert_eq!(first.holder.as_deref(), Some("token-a"));
    assert_eq!(store.get(first.id).await.unwrap(), first);
    assert!(first.is_taken(first.attempt) && !first.is_taken(after(first.attempt)));
    bench.end_lease(first.id).await;
    store.reap().await.unwrap();
    let queued = store.get(first.id).await.unwrap();
    assert_eq!(queued.holder, None);
    assert!(!queued.is_taken(queued.attempt));
    let second = lease(Some("token-b")).await;
    assert_eq!(second.holder.as_deref(), Some("token-b"));

    // An older coordinator takes it back and leases it, and does not know of holders.
    bench
        .execute(format!(
            "update jobs set attempt = attempt + 1 where id = '{}'",
            submitted.id
        ))
        .await;
    let third = store.get(first.id).await.unwrap();
    assert_eq!((third.attempt, third.holder), (after(second.attempt), None));
}

/// A coordinator that was not upgraded yet starts beside one that was.
pub(crate) async fn a_newer_schema_is_worked_with(bench: &Bench) {
    bench
        .execute(
            "insert into _sqlx_migrations (version, description, success, checksum, execution_time) \
             values (999999, 'of a later release', true, '', 0)"
                .to_owned(),
        )
        .await;
    let older = bench.open(PATIENT).await;
    older.submit(request("museum/vase")).await.unwrap();
    assert!(bench.lease("w").await.is_some());
}

pub(crate) async fn stale_attempts_change_nothing(bench: &Bench) {
    let old = bench.running("museum/vase").await;
    bench.end_lease(old.id).await;
    assert_eq!(bench.store.reap().await.unwrap().requeued, [old.id]);
    let refuse_all = async |attempt: Attempt| {
        let before = bench.store.get(old.id).await.unwrap();
        let store = &bench.store;
        let failed = failure(FailureKind::InvalidInput);
        assert_eq!(
            kind(
                &store
                    .heartbeat(old.id, attempt, Some(progress(1.0)), vec![line(0, "x")])
                    .await
            ),
            "lease lost"
        );
        let checkpoint = Checkpoint {
            digest: digest(9),
            size_bytes: 1,
        };
        assert_eq!(
            kind(&store.checkpoint(old.id, attempt, checkpoint).await),
            "lease lost"
        );
        assert_eq!(
            kind(&store.publish_and_complete(old.id, attempt, bundle(9)).await),
            "lease lost"
        );
        assert_eq!(
            kind(
                &store
                    .fail(old.id, attempt, failed, vec![line(0, "x")])
                    .await
            ),
            "lease lost"
        );
        assert_eq!(store.get(old.id).await.unwrap(), before);
        assert!(store.logs(old.id, 0, 10).await.unwrap().is_empty());
    };
    // Queued again, leased by another, ended; the past and the future attempt.
    refuse_all(old.attempt).await;
    refuse_all(after(old.attempt)).await;
    let new = bench.lease("w2").await.unwrap();
    assert_eq!((new.id, new.attempt), (old.id, after(old.attempt)));
    refuse_all(old.attempt).await;
    refuse_all(after(new.attempt)).await;
    assert!(
        bench
            .store
            .versions(&VersionFilter::default())
            .await
            .unwrap()
            .is_empty()
    );
    bench
        .store
        .publish_and_complete(new.id, new.attempt, bundle(1))
        .await
        .unwrap();
    refuse_all(old.attempt).await;
    refuse_all(new.attempt).await;
    assert_eq!(
        bench
            .store
            .versions(&VersionFilter::default())
            .await
            .unwrap()
            .len(),
        1
    );
}

pub(crate) async fn leases_run_out_by_the_databases_clock(bench: &Bench) {
    let lease = Duration::from_millis(400);
    let store = bench.open(Settings { lease, ..PATIENT }).await;
    let request = Submit {
        spec: JobSpec {
            max_attempts: 2,
            ..spec("museum/vase")
        },
        ..request("museum/vase")
    };
    store.submit(request).await.unwrap();
    let first = store.lease(&worker("w1")).await.unwrap().unwrap();
    assert_eq!(store.reap().await.unwrap().requeued, []);
    tokio::time::sleep(lease + Duration::from_millis(50)).await;

    // Late, but nobody took it: the heartbeat revives the lease.
    store
        .heartbeat(first.id, first.attempt, None, Vec::new())
        .await
        .unwrap();
    assert_eq!(store.reap().await.unwrap().requeued, []);
    tokio::time::sleep(lease + Duration::from_millis(50)).await;
    assert_eq!(store.reap().await.unwrap().requeued, [first.id]);
    let waiting = store.get(first.id).await.unwrap();
    waiting.check().unwrap();
    assert_eq!(
        (waiting.state, waiting.attempt),
        (JobState::Queued, Attempt(2))
    );
    assert_eq!(waiting.failure.unwrap().kind, FailureKind::Crashed);

    // The last attempt.
    let second = store.lease(&worker("w2")).await.unwrap().unwrap();
    tokio::time::sleep(lease + Duration::from_millis(50)).await;
    let reaped = store.reap().await.unwrap();
    assert_eq!((reaped.requeued, reaped.ended), (vec![], vec![second.id]));
    assert_eq!(store.get(first.id).await.unwrap().state, JobState::Failed);
}

pub(crate) async fn heartbeats_keep_a_short_lease_alive(bench: &Bench) {
    let lease = Duration::from_millis(600);
    let store = bench.open(Settings { lease, ..PATIENT }).await;
    store.submit(request("museum/vase")).await.unwrap();
    let job = store.lease(&worker("w")).await.unwrap().unwrap();
    let start = Instant::now();
    while start.elapsed() < lease * 3 {
        store
            .heartbeat(job.id, job.attempt, None, Vec::new())
            .await
            .unwrap();
        assert_eq!(store.reap().await.unwrap().requeued, []);
        tokio::time::sleep(lease / 6).await;
    }
}

pub(crate) async fn backoff_ends_by_itself(bench: &Bench) {
    let backoff = Backoff {
        base: Duration::from_millis(600),
        cap: Duration::from_secs(1),
    };
    let store = bench.open(Settings { backoff, ..PATIENT }).await;
    store.submit(request("museum/vase")).await.unwrap();
    let job = store.lease(&worker("w")).await.unwrap().unwrap();
    assert!(
        store
            .fail(
                job.id,
                job.attempt,
                failure(FailureKind::Transient),
                Vec::new()
            )
            .await
            .unwrap()
    );
    assert_eq!(store.lease(&worker("w")).await.unwrap(), None);
    let reason = store
        .waiting(&store.get(job.id).await.unwrap())
        .await
        .unwrap()
        .reason;
    assert!(
        reason.starts_with("backing off until ")
            && reason.ends_with("after attempt 1: the disk is full"),
        "{reason}"
    );
    let start = Instant::now();
    let mut changes = store.changes();
    let again = loop {
        if let Some(job) = store.lease(&worker("w")).await.unwrap() {
            break job;
        }
        assert!(start.elapsed() < Duration::from_secs(5));
        changes.wait(Duration::from_millis(100)).await;
    };
    assert_eq!((again.id, again.attempt), (job.id, Attempt(2)));
    let waited = (again.started_at.unwrap() - again.not_before).to_std();
    assert!(waited.is_ok(), "leased before its time");
}

pub(crate) async fn failures_decide_by_kind(bench: &Bench) {
    for (failure, retried, state) in [
        (FailureKind::Transient, true, JobState::Queued),
        (FailureKind::Crashed, true, JobState::Queued),
        (FailureKind::InvalidInput, false, JobState::Failed),
        (FailureKind::Cancelled, false, JobState::Cancelled),
    ] {
        let job = bench.running("museum/vase").await;
        assert_eq!(bench.fail(&job, failure).await, retried, "{failure:?}");
        let ended = bench.store.get(job.id).await.unwrap();
        ended.check().unwrap();
        assert_eq!(ended.state, state, "{failure:?}");
        assert_eq!(ended.failure, Some(crate::bench::failure(failure)));
        // Keeps the next round's lease to its own job.
        bench.store.cancel(job.id).await.unwrap();
    }
}

pub(crate) async fn attempts_run_out_and_retry_gives_new_ones(bench: &Bench) {
    let spec = JobSpec {
        max_attempts: 2,
        ..spec("museum/vase")
    };
    let id = bench
        .store
        .submit(Submit {
            spec,
            ..request("museum/vase")
        })
        .await
        .unwrap()
        .id;
    assert_eq!(kind(&bench.store.retry(id).await), "not allowed");
    for round in 0..2 {
        for turn in [1, 2] {
            let job = bench.lease("w").await.unwrap();
            assert_eq!(job.attempt, Attempt(round * 2 + turn));
            assert_eq!(kind(&bench.store.retry(id).await), "not allowed");
            let checkpoint = Checkpoint {
                digest: digest(7),
                size_bytes: 7,
            };
            bench
                .store
                .checkpoint(id, job.attempt, checkpoint)
                .await
                .unwrap();
            assert_eq!(bench.fail(&job, FailureKind::Crashed).await, turn == 1);
            bench.end_backoff(id).await;
        }
        let failed = bench.store.get(id).await.unwrap();
        assert_eq!(failed.state, JobState::Failed);
        let retried = bench.store.retry(id).await.unwrap();
        retried.check().unwrap();
        assert_eq!(
            (retried.state, retried.attempt),
            (JobState::Queued, after(failed.attempt))
        );
        assert_eq!(
            (retried.failure, retried.checkpoint),
            (None, failed.checkpoint)
        );
    }
    let job = bench.lease("w").await.unwrap();
    bench
        .store
        .publish_and_complete(id, job.attempt, bundle(1))
        .await
        .unwrap();
    assert_eq!(kind(&bench.store.retry(id).await), "not allowed");
}

pub(crate) async fn cancel_in_every_state(bench: &Bench) {
    let queued = bench.submit("museum/vase").await;
    assert_eq!(
        bench.store.cancel(queued.id).await.unwrap().state,
        JobState::Cancelled
    );
    assert_eq!(bench.lease("w").await, None);

    let job = bench.running("museum/vase").await;
    let asked = bench.store.cancel(job.id).await.unwrap();
    assert_eq!(
        (asked.state, asked.cancel_requested),
        (JobState::Leased, true)
    );
    assert!(
        bench
            .store
            .heartbeat(job.id, job.attempt, None, Vec::new())
            .await
            .unwrap()
            .cancel
    );
    assert!(!bench.fail(&job, FailureKind::Cancelled).await);
    let ended = bench.store.cancel(job.id).await.unwrap();
    assert_eq!(
        (ended.state, ended.cancel_requested),
        (JobState::Cancelled, false)
    );

    // A worker that fails or vanishes instead of reporting the cancel.
    let job = bench.running("museum/vase").await;
    bench.store.cancel(job.id).await.unwrap();
    assert!(!bench.fail(&job, FailureKind::Transient).await);
    assert_eq!(
        bench.store.get(job.id).await.unwrap().state,
        JobState::Cancelled
    );
    let job = bench.running("museum/vase").await;
    bench.store.cancel(job.id).await.unwrap();
    bench.end_lease(job.id).await;
    assert_eq!(bench.store.reap().await.unwrap().ended, [job.id]);
    assert_eq!(
        bench.store.get(job.id).await.unwrap().state,
        JobState::Cancelled
    );

    // Too late.
    let job = bench.running("museum/vase").await;
    bench.store.cancel(job.id).await.unwrap();
    bench
        .store
        .publish_and_complete(job.id, job.attempt, bundle(1))
        .await
        .unwrap();
    assert_eq!(
        bench.store.cancel(job.id).await.unwrap().state,
        JobState::Succeeded
    );
}

pub(crate) async fn order_is_priority_then_age(bench: &Bench) {
    let mut ids = Vec::new();
    for priority in [0, 5, 0, -1, 5] {
        let spec = JobSpec {
            priority,
            ..spec("museum/vase")
        };
        ids.push(
            bench
                .store
                .submit(Submit {
                    spec,
                    ..request("museum/vase")
                })
                .await
                .unwrap()
                .id,
        );
    }
    for expected in [1, 4, 0, 2, 3] {
        assert_eq!(bench.lease("w").await.unwrap().id, ids[expected]);
    }
    assert_eq!(bench.lease("w").await, None);
}

pub(crate) async fn flood_of_one_collection_does_not_starve_another(bench: &Bench) {
    for _ in 0..20 {
        bench.submit("flood/vase").await;
    }
    let first = bench.lease("w").await.unwrap();
    let single = bench.submit("museum/vase").await;
    // Beside running jobs of the flood, and also with a single worker that has just finished one.
    bench.fail(&first, FailureKind::InvalidInput).await;
    assert_eq!(bench.lease("w").await.unwrap().id, single.id);
    let late = bench.submit("museum/vase").await;
    assert_eq!(
        bench.lease("w2").await.unwrap().spec.object,
        name("flood/vase")
    );
    assert_eq!(bench.lease("w3").await.unwrap().id, late.id);
}

pub(crate) async fn weights_share_the_workers(bench: &Bench) {
    let heavy = Collection {
        weight: 2.0,
        ..Collection::new("heavy".parse().unwrap())
    };
    bench.store.set_collection(heavy).await.unwrap();
    for _ in 0..9 {
        bench.submit("light/vase").await;
        bench.submit("heavy/vase").await;
    }
    let mut running = BTreeMap::new();
    for index in 0..9 {
        let job = bench.lease(&format!("w{index}")).await.unwrap();
        *running
            .entry(job.spec.object.collection.to_string())
            .or_insert(0) += 1;
    }
    assert_eq!(
        running,
        [("heavy".to_owned(), 6), ("light".to_owned(), 3)].into()
    );
    let bad = Collection {
        weight: 0.0,
        ..Collection::new("heavy".parse().unwrap())
    };
    assert_eq!(kind(&bench.store.set_collection(bad).await), "invalid");
}

pub(crate) async fn limits_hold_under_concurrent_leases(bench: &Bench) {
    let limited = Collection {
        max_running: 3,
        ..Collection::new("museum".parse().unwrap())
    };
    bench.store.set_collection(limited).await.unwrap();
    for _ in 0..20 {
        bench.submit("museum/vase").await;
    }
    let mut tasks = tokio::task::JoinSet::new();
    for index in 0..24 {
        let store = bench.store.clone();
        tasks.spawn(async move { store.lease(&worker(&format!("w{index}"))).await.unwrap() });
    }
    let leased: Vec<_> = tasks.join_all().await.into_iter().flatten().collect();
    assert_eq!(leased.len(), 3);
    let (next, _) = bench
        .store
        .status(None, 1)
        .await
        .unwrap()
        .next_queued
        .remove(0);
    assert_eq!(
        bench.store.waiting(&next).await.unwrap().reason,
        "collection museum runs its limit of 3 jobs"
    );
    bench.fail(&leased[0], FailureKind::InvalidInput).await;
    assert!(bench.lease("w").await.is_some());
    assert_eq!(bench.lease("w").await, None);
}

pub(crate) async fn paused_collections_wait(bench: &Bench) {
    let job = bench.submit("museum/vase").await;
    let pause = |paused| Collection {
        paused,
        ..Collection::new("museum".parse().unwrap())
    };
    bench.store.set_collection(pause(true)).await.unwrap();
    assert_eq!(bench.lease("w").await, None);
    assert_eq!(
        bench.store.waiting(&job).await.unwrap().reason,
        "collection museum is paused"
    );
    let other = bench.submit("library/vase").await;
    assert_eq!(bench.lease("w").await.unwrap().id, other.id);
    bench.store.set_collection(pause(false)).await.unwrap();
    assert_eq!(bench.lease("w").await.unwrap().id, job.id);
    let names: Vec<_> = bench
        .store
        .collections()
        .await
        .unwrap()
        .into_iter()
        .map(|c| c.name.to_string())
        .collect();
    assert_eq!(names, ["library", "museum"]);
}

pub(crate) async fn drained_workers_get_nothing(bench: &Bench) {
    let job = bench.running("museum/vase").await;
    bench.submit("museum/vase").await;
    let id = "w".parse().unwrap();
    bench.store.drain_worker(&id, true).await.unwrap();
    assert!(
        bench
            .store
            .heartbeat(job.id, job.attempt, None, Vec::new())
            .await
            .unwrap()
            .drain
    );
    assert_eq!(bench.lease("w").await, None);
    let listed = bench.store.workers().await.unwrap();
    assert_eq!(listed.len(), 1);
    assert_eq!(
        (&listed[0].info, &listed[0].jobs[..], listed[0].draining),
        (&worker("w"), &[job.id][..], true)
    );
    bench.store.drain_worker(&id, false).await.unwrap();
    let second = bench.lease("w").await.unwrap();
    let listed = bench.store.workers().await.unwrap();
    assert_eq!(listed.len(), 1);
    assert_eq!(listed[0].jobs, [second.id, job.id], "the latest first");
    assert_eq!(
        kind(
            &bench
                .store
                .drain_worker(&"nobody".parse().unwrap(), true)
                .await
        ),
        "not found"
    );
}

pub(crate) async fn one_lease_for_each_job_among_64_workers(bench: &Bench) {
    let objects = ["museum/vase", "library/urn", "gallery/bust"];
    let requests = (0..200).map(|i| request(objects[i % 3])).collect();
    for result in bench.store.submit_batch(requests).await.unwrap() {
        result.unwrap();
    }
    let mut tasks = tokio::task::JoinSet::new();
    for index in 0..64 {
        let store = bench.store.clone();
        tasks.spawn(async move {
            let me = worker(&format!("w{index}"));
            let mut leased = Vec::new();
            // None may also mean that others held the rest just then.
            let mut empty = 0;
            while empty < 3 {
                match store.lease(&me).await.unwrap() {
                    Some(job) => leased.push(job.id),
                    None => empty += 1,
                }
            }
            leased
        });
    }
    let all: Vec<_> = tasks.join_all().await.into_iter().flatten().collect();
    assert_eq!(all.len(), 200);
    assert_eq!(all.into_iter().collect::<BTreeSet<_>>().len(), 200);
    assert_eq!(
        bench.store.status(None, 1).await.unwrap().counts[&JobState::Leased],
        200
    );
}

pub(crate) async fn lists_filter_and_page(bench: &Bench) {
    let mut ids = Vec::new();
    for i in 0..25 {
        let mut request = request(if i % 5 == 0 {
            "library/vase"
        } else {
            "museum/vase"
        });
        request.spec.labels.insert(
            "it's \"odd\"".to_owned(),
            if i % 2 == 1 { "yes" } else { "no" }.to_owned(),
        );
        ids.push(bench.store.submit(request).await.unwrap().id);
    }
    bench.store.cancel(ids[3]).await.unwrap();
    let list = async |filter: &JobFilter| {
        let (mut found, mut after, mut pages) = (Vec::new(), None, 0);
        loop {
            let page = bench.store.list(filter, after, 4).await.unwrap();
            assert!(page.jobs.len() <= 4);
            found.extend(page.jobs.iter().map(|job| job.id));
            pages += 1;
            after = page.next;
            if after.is_none() {
                return (found, pages);
            }
        }
    };
    let newest_first = |keep: &dyn Fn(usize) -> bool| -> Vec<JobId> {
        (0..25).rev().filter(|i| keep(*i)).map(|i| ids[i]).collect()
    };
    let all = JobFilter::default();
    assert_eq!(list(&all).await, (newest_first(&|_| true), 7));
    let library = JobFilter {
        collection: Some("library".parse().unwrap()),
        ..all.clone()
    };
    assert_eq!(list(&library).await.0, newest_first(&|i| i % 5 == 0));
    let object = JobFilter {
        object: Some("vase".parse().unwrap()),
        ..library.clone()
    };
    assert_eq!(list(&object).await.0, newest_first(&|i| i % 5 == 0));
    let none = JobFilter {
        object: Some("urn".parse().unwrap()),
        ..all.clone()
    };
    assert_eq!(list(&none).await, (Vec::new(), 1));
    let states = JobFilter {
        states: vec![JobState::Cancelled, JobState::Failed],
        ..all.clone()
    };
    assert_eq!(list(&states).await.0, [ids[3]]);
    let odd = ("it's \"odd\"".to_owned(), "yes".to_owned());
    let labels = JobFilter {
        labels: [odd, ("batch".to_owned(), "friday".to_owned())].into(),
        ..library
    };
    assert_eq!(
        list(&labels).await.0,
        newest_first(&|i| i % 5 == 0 && i % 2 == 1)
    );
}

pub(crate) async fn find_takes_unambiguous_prefixes(bench: &Bench) {
    let job = bench.submit("museum/vase").await;
    let id = job.id.to_string();
    for length in [4, 8, 9, 20, 36] {
        assert_eq!(bench.store.find(&id[..length]).await.unwrap(), job);
    }
    bench.submit("museum/vase").await;
    assert_eq!(kind(&bench.store.find(&id[..4]).await), "invalid");
    assert_eq!(bench.store.find(&id).await.unwrap(), job);
    assert_eq!(kind(&bench.store.find("ffff").await), "not found");
    assert_eq!(kind(&bench.store.find("xyz").await), "invalid");
}

pub(crate) async fn logs_are_ordered_bounded_and_counted_once(bench: &Bench) {
    let job = bench.running("museum/vase").await;
    let beat = |lines| bench.store.heartbeat(job.id, job.attempt, None, lines);
    beat(vec![line(1, "one"), line(2, "two")]).await.unwrap();
    beat(vec![line(2, "two"), line(3, "thr\0ee")])
        .await
        .unwrap();
    beat(vec![line(0, "uncounted")]).await.unwrap();
    let logs = bench.store.logs(job.id, 0, 100).await.unwrap();
    let shown: Vec<_> = logs
        .iter()
        .map(|line| (line.seq, line.message.as_str()))
        .collect();
    assert_eq!(
        shown,
        [
            (1, "one"),
            (2, "two"),
            (3, "thr\u{FFFD}ee"),
            (4, "uncounted")
        ]
    );
    assert_eq!(bench.store.logs(job.id, 2, 1).await.unwrap()[0].seq, 3);
    assert_eq!(
        (logs[0].attempt, logs[0].level, logs[0].at),
        (Attempt(1), Level::Info, DateTime::UNIX_EPOCH)
    );

    // The next attempt counts from 1 again; the log goes on.
    bench
        .store
        .fail(
            job.id,
            job.attempt,
            failure(FailureKind::Crashed),
            vec![line(4, "boom")],
        )
        .await
        .unwrap();
    bench.end_backoff(job.id).await;
    let job = bench.lease("w2").await.unwrap();
    let beat = |lines| bench.store.heartbeat(job.id, job.attempt, None, lines);
    beat(vec![line(1, "again")]).await.unwrap();
    let logs = bench.store.logs(job.id, 4, 100).await.unwrap();
    let shown: Vec<_> = logs
        .iter()
        .map(|line| (line.seq, line.attempt.0, line.message.as_str()))
        .collect();
    assert_eq!(shown, [(5, 1, "boom"), (6, 2, "again")]);

    // Long lines are cut, old ones go, the newest stay.
    beat(vec![line(0, &"ä".repeat(5000))]).await.unwrap();
    assert_eq!(
        bench.store.logs(job.id, 6, 1).await.unwrap()[0]
            .message
            .len(),
        4096
    );
    for _ in 0..6 {
        beat((0..1999).map(|_| line(0, "chatter")).collect())
            .await
            .unwrap();
    }
    beat(vec![line(0, "last")]).await.unwrap();
    let newest = 7 + 6 * 1999 + 1;
    let first = bench.store.logs(job.id, 0, 1).await.unwrap()[0].seq;
    assert_eq!(first, newest - ign_queue::store::MAX_LOG_LINES + 1);
    assert_eq!(
        bench.store.logs(job.id, newest - 1, 10).await.unwrap()[0].message,
        "last"
    );
}

pub(crate) async fn aliases_and_retirement(bench: &Bench) {
    let vase = name("museum/vase");
    for number in 1..=3 {
        let job = bench.running("museum/vase").await;
        bench
            .store
            .publish_and_complete(job.id, job.attempt, bundle(number))
            .await
            .unwrap();
    }
    let job = bench.running("library/urn").await;
    bench
        .store
        .publish_and_complete(job.id, job.attempt, bundle(9))
        .await
        .unwrap();

    let approved = bench
        .store
        .set_alias(&vase, "v2", "approved")
        .await
        .unwrap();
    assert_eq!(
        (approved.version, approved.aliases.as_slice()),
        (2, &["approved".to_owned()][..])
    );
    assert_eq!(
        bench
            .store
            .version(&vase, "approved")
            .await
            .unwrap()
            .version,
        2
    );
    assert_eq!(
        kind(&bench.store.set_alias(&vase, "v9", "approved").await),
        "not found"
    );
    assert_eq!(
        kind(&bench.store.set_alias(&vase, "v1", "v7").await),
        "invalid"
    );
    assert_eq!(
        kind(
            &bench
                .store
                .set_alias(&name("museum/none"), "", "approved")
                .await
        ),
        "not found"
    );
    assert_eq!(kind(&bench.store.retire(&vase, "v2").await), "not allowed");

    assert!(bench.store.retire(&vase, "v3").await.unwrap().retired);
    assert_eq!(bench.store.version(&vase, "").await.unwrap().version, 2);
    assert_eq!(
        kind(&bench.store.set_alias(&vase, "v3", "approved").await),
        "not allowed"
    );
    let retired = bench.store.version(&vase, "v3").await.unwrap();
    assert!(retired.retired && retired.retired_at.is_some());
    let standing = bench.store.standing(&vase).await.unwrap();
    assert_eq!(standing.newest, 3);
    let aliases: Vec<_> = standing
        .aliases
        .iter()
        .map(|(a, v)| (a.as_str(), *v))
        .collect();
    assert_eq!(aliases, [("approved", 2), ("latest", 2)]);
    assert_eq!(standing.retired, [(3, retired.retired_at)].into());
    // A repeated call does not prolong the grace.
    let again = bench.store.retire(&vase, "v3").await.unwrap();
    assert_eq!(again, retired);
    let restored = bench.store.restore(&vase, "v3").await.unwrap();
    assert_eq!((restored.retired, restored.retired_at), (false, None));
    assert_eq!(restored.aliases, ["latest"]);
    let standing = bench.store.standing(&vase).await.unwrap();
    assert_eq!((standing.newest, standing.retired), (3, [].into()));
    assert_eq!(standing.aliases["latest"], 3);
    let nothing = bench.store.standing(&name("museum/none")).await.unwrap();
    assert_eq!(nothing, ign_queue::Standing::default());
    assert_eq!(
        bench.store.restore(&vase, "v3").await.unwrap(),
        restored,
        "a repeated call changes nothing"
    );
    assert_eq!(kind(&bench.store.restore(&vase, "v9").await), "not found");
    bench.store.retire(&vase, "v3").await.unwrap();

    let list = async |filter: VersionFilter| -> Vec<String> {
        let versions = bench.store.versions(&filter).await.unwrap();
        versions
            .iter()
            .map(|v| format!("{}:v{} {}", v.object, v.version, v.aliases.join("+")))
            .collect()
    };
    let all = VersionFilter::default();
    assert_eq!(
        list(all.clone()).await,
        [
            "library/urn:v1 latest",
            "museum/vase:v1 ",
            "museum/vase:v2 approved+latest"
        ]
    );
    let museum = VersionFilter {
        collection: Some("museum".parse().unwrap()),
        include_retired: true,
        ..all.clone()
    };
    assert_eq!(list(museum).await.len(), 3);
    let urns = VersionFilter {
        object: Some("urn".parse().unwrap()),
        ..all
    };
    assert_eq!(list(urns).await.len(), 1);

    // Numbers are not used twice, and with the last version `latest` goes.
    let urn = name("library/urn");
    bench.store.retire(&urn, "latest").await.unwrap();
    assert_eq!(
        kind(&bench.store.version(&urn, "latest").await),
        "not found"
    );
    let job = bench.running("library/urn").await;
    assert_eq!(
        bench
            .store
            .publish_and_complete(job.id, job.attempt, bundle(9))
            .await
            .unwrap()
            .version,
        2
    );
}

pub(crate) async fn status_shows_one_screen(bench: &Bench) {
    let lost = bench.running("museum/vase").await;
    bench.fail(&lost, FailureKind::InvalidInput).await;
    let running = bench.running("museum/vase").await;
    bench.lease("idle").await;
    let low = bench.submit("library/vase").await;
    let high = Submit {
        spec: JobSpec {
            priority: 1,
            ..spec("museum/urn")
        },
        ..request("museum/urn")
    };
    let high = bench.store.submit(high).await.unwrap();

    let status = bench.store.status(None, 10).await.unwrap();
    let counts: Vec<_> = status
        .counts
        .iter()
        .map(|(state, count)| (state.as_str(), *count))
        .collect();
    assert_eq!(
        counts,
        [
            ("queued", 2),
            ("leased", 1),
            ("succeeded", 0),
            ("failed", 1),
            ("cancelled", 0)
        ]
    );
    let ids = |jobs: &[ign_queue::Job]| jobs.iter().map(|job| job.id).collect::<Vec<_>>();
    assert_eq!(ids(&status.running), [running.id]);
    assert_eq!(ids(&status.recent_failures), [lost.id]);
    let next: Vec<_> = status.next_queued.iter().map(|(job, _)| job.id).collect();
    assert_eq!(next, [high.id, low.id]);
    for (job, waiting) in &status.next_queued {
        assert_eq!(*waiting, bench.store.waiting(job).await.unwrap());
        assert_ne!(waiting.reason, "");
    }
    let workers: Vec<_> = status
        .workers
        .iter()
        .map(|w| (w.info.id.as_str(), &w.jobs[..]))
        .collect();
    assert_eq!(workers, [("idle", &[][..]), ("w", &[running.id][..])]);
    assert!((status.at - running.started_at.unwrap()).num_seconds() < 60);

    let library = bench
        .store
        .status(Some(&"library".parse().unwrap()), 10)
        .await
        .unwrap();
    assert_eq!(library.counts[&JobState::Queued], 1);
    assert_eq!(library.counts.values().sum::<u64>(), 1);
    assert_eq!((library.running.len(), library.next_queued.len()), (0, 1));
    bench.store.ping().await.unwrap();
}

pub(crate) async fn waiting_jobs_say_why(bench: &Bench) {
    let first = bench.submit("museum/vase").await;
    let second = bench.submit("museum/vase").await;
    let waiting = bench.store.waiting(&second).await.unwrap();
    assert_eq!(
        (waiting.position, waiting.reason.as_str()),
        (1, "no worker is connected")
    );
    bench.submit("library/vase").await;
    assert_eq!(bench.store.waiting(&second).await.unwrap().position, 2);
    let urgent = Submit {
        spec: JobSpec {
            priority: 1,
            ..spec("museum/urn")
        },
        ..request("museum/urn")
    };
    let urgent = bench.store.submit(urgent).await.unwrap();
    assert_eq!(bench.store.waiting(&second).await.unwrap().position, 3);
    assert_eq!(bench.store.waiting(&urgent).await.unwrap().position, 0);
    assert_eq!(bench.lease("w").await.unwrap().id, urgent.id);
    let waiting = bench.store.waiting(&first).await.unwrap();
    assert_eq!(
        (waiting.position, waiting.reason.as_str()),
        (1, "the worker has other jobs first")
    );
    let next = Submit {
        spec: JobSpec {
            priority: 1,
            ..spec("museum/jar")
        },
        ..request("museum/jar")
    };
    let next = bench.store.submit(next).await.unwrap();
    let waiting = bench.store.waiting(&next).await.unwrap();
    assert_eq!(
        (waiting.position, waiting.reason.as_str()),
        (0, "it is next: the first worker that is free takes it")
    );
    let running = bench.store.get(urgent.id).await.unwrap();
    assert_eq!(bench.store.waiting(&running).await.unwrap().reason, "");
}

pub(crate) async fn changes_between_query_and_wait_are_not_missed(bench: &Bench) {
    let store = bench
        .open(Settings {
            poll: Duration::from_secs(30),
            ..PATIENT
        })
        .await;
    let mut changes = store.changes();
    assert_eq!(store.lease(&worker("w")).await.unwrap(), None);
    store.submit(request("museum/vase")).await.unwrap();
    let start = Instant::now();
    changes.wait(Duration::from_secs(20)).await;
    assert!(start.elapsed() < Duration::from_secs(5));

    let waiter = tokio::spawn(async move {
        let start = Instant::now();
        changes.wait(Duration::from_secs(20)).await;
        start.elapsed()
    });
    tokio::time::sleep(Duration::from_millis(500)).await;
    let mut work = store.work();
    let job = store.lease(&worker("w")).await.unwrap().unwrap();
    assert!(waiter.await.unwrap() < Duration::from_secs(5));

    // A heartbeat wakes those who watch jobs, not those who wait for work; a finished job does.
    let mut changes = store.changes();
    store
        .heartbeat(job.id, job.attempt, Some(progress(1.0)), Vec::new())
        .await
        .unwrap();
    assert_eq!(wakes(&mut changes, &mut work).await, (true, false));
    store
        .publish_and_complete(job.id, job.attempt, bundle(1))
        .await
        .unwrap();
    assert_eq!(wakes(&mut changes, &mut work).await, (true, true));
    // Nothing to lease is no change: waiting workers would wake each other for ever.
    assert_eq!(store.lease(&worker("w")).await.unwrap(), None);
    store.reap().await.unwrap();
    assert_eq!(wakes(&mut changes, &mut work).await, (false, false));
}

async fn wakes(changes: &mut ign_queue::Changes, work: &mut ign_queue::Changes) -> (bool, bool) {
    let limit = Duration::from_millis(150);
    let mut woke = [false; 2];
    for (changes, woke) in [changes, work].into_iter().zip(&mut woke) {
        let start = Instant::now();
        changes.wait(limit).await;
        *woke = start.elapsed() < limit;
    }
    woke.into()
}

pub(crate) async fn data_outlive_the_store(bench: &Bench) {
    let job = bench.running("museum/vase").await;
    bench
        .store
        .heartbeat(
            job.id,
            job.attempt,
            Some(progress(5.0)),
            vec![line(1, "hello")],
        )
        .await
        .unwrap();
    let before = bench.store.get(job.id).await.unwrap();
    let again = bench.open(PATIENT).await;
    assert_eq!(again.get(job.id).await.unwrap(), before);
    assert_eq!(again.logs(job.id, 0, 10).await.unwrap().len(), 1);
    again
        .publish_and_complete(job.id, job.attempt, bundle(1))
        .await
        .unwrap();
    assert_eq!(bench.store.get(job.id).await.unwrap().version, Some(1));
    let unknown = ign_queue::open("mysql://host/db", PATIENT).await;
    assert!(matches!(unknown, Err(StoreError::Invalid { .. })));
}

/// A wiped database takes everything over that the bucket records, and nothing twice.
pub(crate) async fn versions_are_adopted(bench: &Bench) {
    let vase = name("museum/vase");
    let known = |number: u32| ign_queue::Version {
        object: vase.clone(),
        version: number,
        bundle: bundle(number as u8),
        aliases: Vec::new(),
        created_at: chrono::DateTime::from_timestamp(1_700_000_000, 123_456_000).unwrap(),
        job: JobId::generate(),
        retired: false,
        retired_at: None,
    };
    let mut versions = vec![known(1), known(2), known(4)];
    versions[0].aliases = vec!["approved".to_owned()];
    versions[2].aliases = vec!["latest".to_owned()];
    versions[1].retired = true;
    versions[1].retired_at = Some(versions[1].created_at);
    let adopted = bench.store.adopt(&vase, &versions).await.unwrap();
    assert_eq!(
        (adopted.added.as_slice(), adopted.known),
        (&[1, 2, 4][..], 0)
    );
    let all = VersionFilter {
        include_retired: true,
        ..VersionFilter::default()
    };
    assert_eq!(bench.store.versions(&all).await.unwrap(), versions);
    let again = bench.store.adopt(&vase, &versions).await.unwrap();
    assert_eq!((again.added.len(), again.known), (0, 3));

    // Numbers go on after the last one, and what the database decided since then stands.
    let job = bench.running("museum/vase").await;
    let next = bench
        .store
        .publish_and_complete(job.id, job.attempt, bundle(5))
        .await
        .unwrap();
    assert_eq!(next.version, 5);
    let mut foreign = known(5);
    foreign.aliases = vec!["latest".to_owned(), "approved".to_owned()];
    let refused = bench.store.adopt(&vase, &[foreign]).await.unwrap();
    assert_eq!(refused.differing, [5]);
    bench.store.adopt(&vase, &versions).await.unwrap();
    let latest = bench.store.version(&vase, "latest").await.unwrap();
    assert_eq!((latest.version, latest.job), (5, job.id));
    let approved = bench.store.version(&vase, "approved").await.unwrap();
    assert_eq!(approved.version, 1);
}

/// Garbage collection spares what the database names, and for the grace what it named lately.
pub(crate) async fn what_is_named_is_known(bench: &Bench) {
    let hour = std::time::Duration::from_hours(1);
    let vase = name("museum/vase");
    let with_capture = |number: u8| Submit {
        spec: JobSpec {
            capture_digest: digest(number),
            ..spec("museum/vase")
        },
        ..request("museum/vase")
    };
    let first = bench.store.submit(with_capture(1)).await.unwrap();
    let job = bench.lease("w").await.unwrap();
    let checkpoint = Checkpoint {
        digest: digest(2),
        size_bytes: 9,
    };
    bench
        .store
        .checkpoint(job.id, job.attempt, checkpoint)
        .await
        .unwrap();
    let named = bench.store.named(hour).await.unwrap();
    assert_eq!(named.manifests, [digest(1)].into());
    assert_eq!(named.checkpoints, [digest(2)].into());

    bench
        .store
        .publish_and_complete(job.id, job.attempt, bundle(3))
        .await
        .unwrap();
    bench.store.submit(with_capture(4)).await.unwrap();
    let named = bench.store.named(hour).await.unwrap();
    assert_eq!(named.manifests, [digest(1), digest(3), digest(4)].into());
    assert_eq!(named.checkpoints, [digest(2)].into());
    // The job ended longer ago than the grace: its capture and checkpoint may go, its version stays.
    bench.end_long_ago(first.id).await;
    let named = bench.store.named(hour).await.unwrap();
    assert_eq!(named.manifests, [digest(3), digest(4)].into());
    assert_eq!(named.checkpoints, [].into());

    bench.store.retire(&vase, "v1").await.unwrap();
    let named = bench.store.named(hour).await.unwrap();
    assert!(named.manifests.contains(&digest(3)));
    // A coordinator of the version before retires without a time: the grace begins when it is seen.
    bench
        .execute("update versions set retired_at = null".to_owned())
        .await;
    let named = bench.store.named(hour).await.unwrap();
    assert!(named.manifests.contains(&digest(3)));
    bench.retire_long_ago().await;
    let named = bench.store.named(hour).await.unwrap();
    assert_eq!(named.manifests, [digest(4)].into());
}

pub(crate) async fn events_and_turns(bench: &Bench) {
    for number in 0..3 {
        bench
            .store
            .record("audit", &format!("s{number}"), "all well\0")
            .await
            .unwrap();
    }
    let events = bench.store.events(0, 2).await.unwrap();
    let subjects: Vec<&str> = events.iter().map(|event| event.subject.as_str()).collect();
    assert_eq!(subjects, ["s2", "s1"]);
    assert_eq!(events[0].message, "all well\u{FFFD}");
    let rest = bench.store.events(events[1].seq, 9).await.unwrap();
    assert_eq!((rest.len(), rest[0].subject.as_str()), (1, "s0"));

    let hour = std::time::Duration::from_hours(1);
    let mut tasks = tokio::task::JoinSet::new();
    for _ in 0..8 {
        let store = bench.store.clone();
        tasks.spawn(async move { store.take_turn("audit", hour).await.unwrap() });
    }
    let turns: Vec<u64> = tasks.join_all().await.into_iter().flatten().collect();
    assert_eq!(turns, [0], "one of eight has the turn");
    let zero = std::time::Duration::ZERO;
    assert_eq!(bench.store.take_turn("audit", zero).await.unwrap(), Some(1));
    assert_eq!(bench.store.take_turn("other", hour).await.unwrap(), Some(0));
}
