//! Jobs from submit to their end.

use std::time::Duration;

use ign_proto::{Cause, Digest, Manifest, v1};
use ign_registry::Registry;
use ign_registry::StoreConfig;
use reqwest::{Method, StatusCode};
use tokio_stream::StreamExt as _;

use crate::fixture::{Service, attempt, object_ref, settings, submit_request};

fn job_request(job: &v1::Job) -> v1::GetJobRequest {
    v1::GetJobRequest {
        job_id: job.id.clone(),
    }
}

fn line(seq: u64, message: &str) -> v1::LogLine {
    v1::LogLine {
        seq,
        level: "info".to_owned(),
        message: message.to_owned(),
        ..v1::LogLine::default()
    }
}

#[tokio::test]
async fn a_job_lives_from_submit_to_a_bundle_that_verifies() {
    let mut service = Service::start().await;
    let job = service.submit("museum/vase", "request-1").await;
    assert_eq!((job.state(), job.attempt), (v1::JobState::Queued, 1));
    assert!(!job.waiting_for.is_empty());
    assert_eq!(
        service.submit("museum/vase", "request-1").await.id,
        job.id,
        "submit is idempotent"
    );
    let mut watched = service
        .jobs
        .watch(job_request(&job))
        .await
        .unwrap()
        .into_inner();
    let followed = v1::LogsRequest {
        job_id: job.id.clone(),
        follow: true,
        after_seq: 0,
    };
    let mut followed = service.jobs.logs(followed).await.unwrap().into_inner();
    assert_eq!(
        watched.next().await.unwrap().unwrap().state(),
        v1::JobState::Queued
    );

    let lease = service.lease("worker-1", 5.0).await.unwrap();
    assert_eq!(
        (
            lease.job_id.as_str(),
            lease.attempt,
            lease.checkpoint_digest.as_str()
        ),
        (&*job.id, 1, "")
    );
    assert!(service.lease("worker-2", 0.0).await.is_none());
    let progress = v1::Progress {
        stage: "effects".to_owned(),
        percent: 12.5,
        eta_secs: Some(60.0),
        error: Some(4.5),
        message: "epoch 3".to_owned(),
    };
    let heartbeat = v1::HeartbeatRequest {
        job: Some(attempt(&lease, "worker-1")),
        progress: Some(progress.clone()),
        logs: vec![line(1, "first"), line(2, "second")],
    };
    let orders = service
        .workers
        .heartbeat(heartbeat.clone())
        .await
        .unwrap()
        .into_inner();
    assert_eq!((orders.cancel, orders.drain), (false, false));
    // The same lines again add nothing.
    service.workers.heartbeat(heartbeat).await.unwrap();
    assert_eq!(followed.next().await.unwrap().unwrap().message, "first");
    assert_eq!(followed.next().await.unwrap().unwrap().message, "second");

    let missing = v1::CheckpointRequest {
        job: Some(attempt(&lease, "worker-1")),
        digest: Digest::of(b"weights").to_string(),
        size_bytes: 7,
    };
    let refused = Cause::from_status(
        &service
            .workers
            .checkpoint(missing.clone())
            .await
            .unwrap_err(),
    );
    assert_eq!(refused.reason(), "BLOB_MISSING");
    service.upload("museum/vase", b"weights").await;
    service.workers.checkpoint(missing).await.unwrap();

    let files: &[(&str, &[u8])] = &[
        ("bundle.json", b"{}"),
        ("references/0001.png", b"png"),
        ("copy.png", b"png"),
    ];
    let bundle = service.complete(&lease, "worker-1", files).await.unwrap();
    assert_eq!(
        (bundle.version, bundle.aliases.as_slice()),
        (1, ["latest".to_owned()].as_slice())
    );
    assert_eq!(bundle.size_bytes, 8);
    let again = service.complete(&lease, "worker-1", files).await.unwrap();
    assert_eq!(again, bundle, "a repeated complete gives the same version");

    let states: Vec<v1::Job> = watched.map(Result::unwrap).collect().await;
    assert!(
        states
            .iter()
            .any(|job| job.progress.as_ref() == Some(&progress))
    );
    let last = states.last().unwrap();
    assert_eq!(
        (last.state(), last.bundle.as_ref()),
        (v1::JobState::Succeeded, Some(&bundle))
    );
    assert!(followed.next().await.is_none(), "logs end with the job");

    for reference in ["latest", "v1", bundle.manifest_digest.as_str()] {
        let path = format!("/v2/museum/vase/manifests/{reference}");
        let bytes = service
            .request(Method::GET, &path)
            .send()
            .await
            .unwrap()
            .bytes()
            .await
            .unwrap();
        assert_eq!(Digest::of(&bytes).as_str(), bundle.manifest_digest);
        let manifest = Manifest::decode(&bytes).unwrap();
        assert_eq!(manifest.files().len(), 3);
        for file in manifest.files() {
            let path = format!("/v2/museum/vase/blobs/{}", file.digest);
            let blob = service
                .request(Method::GET, &path)
                .send()
                .await
                .unwrap()
                .bytes()
                .await
                .unwrap();
            assert_eq!(
                (Digest::of(&blob), blob.len() as u64),
                (file.digest.clone(), file.size_bytes)
            );
        }
    }
    let request = v1::GetBundleRequest {
        object: Some(object_ref("museum/vase")),
        reference: String::new(),
    };
    assert_eq!(
        service.bundles.get(request).await.unwrap().into_inner(),
        bundle
    );
}

#[tokio::test]
async fn a_stale_attempt_is_told_so_and_nothing_of_it_shows() {
    let mut service =
        Service::with(|config| config.settings = settings(Duration::from_millis(600))).await;
    let job = service.submit("museum/vase", "request-1").await;
    let stale = service.lease("frozen", 5.0).await.unwrap();
    service.upload("museum/vase", b"weights").await;
    let checkpoint = |lease, worker| v1::CheckpointRequest {
        job: Some(attempt(lease, worker)),
        digest: Digest::of(b"weights").to_string(),
        size_bytes: 7,
    };
    service
        .workers
        .checkpoint(checkpoint(&stale, "frozen"))
        .await
        .unwrap();
    // The worker falls silent; another one gets the job, with the checkpoint.
    let fresh = service.lease("fresh", 20.0).await.unwrap();
    assert_eq!((fresh.job_id.as_str(), fresh.attempt), (&*job.id, 2));
    assert_eq!(fresh.checkpoint_digest, Digest::of(b"weights").as_str());

    let lost = Cause::LeaseLost {
        job: job.id.clone(),
        attempt: 1,
    };
    let refused = service
        .complete(&stale, "frozen", &[("bundle.json", b"stale")])
        .await
        .unwrap_err();
    assert_eq!(refused, lost);
    let heartbeat = v1::HeartbeatRequest {
        job: Some(attempt(&stale, "frozen")),
        ..v1::HeartbeatRequest::default()
    };
    assert_eq!(
        Cause::from_status(&service.workers.heartbeat(heartbeat).await.unwrap_err()),
        lost
    );
    let status = service
        .workers
        .checkpoint(checkpoint(&stale, "frozen"))
        .await
        .unwrap_err();
    assert_eq!(Cause::from_status(&status), lost);
    let fail = v1::FailRequest {
        job: Some(attempt(&stale, "frozen")),
        failure: Some(v1::Failure {
            kind: v1::FailureKind::Crashed.into(),
            ..v1::Failure::default()
        }),
        logs: vec![],
    };
    assert_eq!(
        Cause::from_status(&service.workers.fail(fail).await.unwrap_err()),
        lost
    );
    let tags = service
        .request(Method::GET, "/v2/museum/vase/tags/list")
        .send()
        .await
        .unwrap();
    assert_eq!(tags.status(), StatusCode::NOT_FOUND);

    let bundle = service
        .complete(&fresh, "fresh", &[("bundle.json", b"fresh")])
        .await
        .unwrap();
    assert_eq!(bundle.version, 1);
    let late = service
        .complete(&stale, "frozen", &[("bundle.json", b"stale")])
        .await
        .unwrap_err();
    assert_eq!(late, lost);
    let list = service
        .bundles
        .list(v1::ListBundlesRequest::default())
        .await
        .unwrap()
        .into_inner();
    assert_eq!(list.bundles, std::slice::from_ref(&bundle));
    let store = StoreConfig::new(format!("file://{}/store", service.folder.display()));
    let published = Registry::open(&store)
        .await
        .unwrap()
        .rebuild()
        .await
        .unwrap();
    assert_eq!(published.versions.len(), 1);
    assert_eq!(
        published.versions[0].record.manifest_digest.as_str(),
        bundle.manifest_digest
    );
    assert_eq!(published.faults, []);
}

/// Leases run by the database's clock: a worker that is five minutes early or late holds its job as long as any other.
#[tokio::test]
async fn a_workers_clock_decides_nothing() {
    let mut service =
        Service::with(|config| config.settings = settings(Duration::from_millis(900))).await;
    let job = service.submit("museum/vase", "request-1").await;
    let lease = service.lease("skewed", 5.0).await.unwrap();
    let now = chrono::Utc::now().timestamp();
    for (seq, skew) in [(1, -300), (2, 300), (3, -300), (4, 300), (5, 0)] {
        let line = v1::LogLine {
            at: Some(prost_types::Timestamp {
                seconds: now + skew,
                nanos: 0,
            }),
            ..line(seq, "still here")
        };
        let heartbeat = v1::HeartbeatRequest {
            job: Some(attempt(&lease, "skewed")),
            logs: vec![line],
            ..v1::HeartbeatRequest::default()
        };
        service.workers.heartbeat(heartbeat).await.unwrap();
        assert!(service.lease("rival", 0.3).await.is_none(), "skew {skew} s");
    }
    // Silent, it loses the job as any other.
    let rescued = service.lease("rival", 20.0).await.unwrap();
    assert_eq!((rescued.job_id, rescued.attempt), (job.id, 2));
}

#[tokio::test]
async fn cancel_reaches_the_worker_and_retry_begins_again() {
    let mut service = Service::start().await;
    let queued = service.submit("museum/bust", "request-0").await;
    let cancelled = service
        .jobs
        .cancel(job_request(&queued))
        .await
        .unwrap()
        .into_inner();
    assert_eq!(cancelled.state(), v1::JobState::Cancelled);

    let job = service.submit("museum/vase", "request-1").await;
    let lease = service.lease("worker-1", 5.0).await.unwrap();
    let running = service
        .jobs
        .cancel(job_request(&job))
        .await
        .unwrap()
        .into_inner();
    assert_eq!(running.state(), v1::JobState::Leased);
    let heartbeat = v1::HeartbeatRequest {
        job: Some(attempt(&lease, "worker-1")),
        ..v1::HeartbeatRequest::default()
    };
    assert!(
        service
            .workers
            .heartbeat(heartbeat)
            .await
            .unwrap()
            .into_inner()
            .cancel
    );
    let failure = |kind: v1::FailureKind| v1::Failure {
        kind: kind.into(),
        message: "stopped".to_owned(),
        at: "effects".to_owned(),
        hint: String::new(),
    };
    let fail = |lease, kind, logs| v1::FailRequest {
        job: Some(attempt(lease, "worker-1")),
        failure: Some(failure(kind)),
        logs,
    };
    let request = fail(
        &lease,
        v1::FailureKind::Cancelled,
        vec![line(1, "stopped by request")],
    );
    assert!(
        !service
            .workers
            .fail(request)
            .await
            .unwrap()
            .into_inner()
            .will_retry
    );
    assert_eq!(service.get(&job.id).await.state(), v1::JobState::Cancelled);

    let again = service
        .jobs
        .retry(job_request(&job))
        .await
        .unwrap()
        .into_inner();
    assert_eq!((again.state(), again.attempt), (v1::JobState::Queued, 2));
    let lease = service.lease("worker-1", 5.0).await.unwrap();
    let request = fail(&lease, v1::FailureKind::Transient, vec![]);
    assert!(
        service
            .workers
            .fail(request)
            .await
            .unwrap()
            .into_inner()
            .will_retry
    );
    let lease = service.lease("worker-1", 5.0).await.unwrap();
    assert_eq!(lease.attempt, 3);
    let request = fail(
        &lease,
        v1::FailureKind::InvalidInput,
        vec![line(1, "camera 3 has zero focal length")],
    );
    assert!(
        !service
            .workers
            .fail(request)
            .await
            .unwrap()
            .into_inner()
            .will_retry
    );
    let failed = service.get(&job.id[..13]).await;
    assert_eq!(
        (failed.state(), failed.failure),
        (
            v1::JobState::Failed,
            Some(failure(v1::FailureKind::InvalidInput))
        )
    );

    let logs = v1::LogsRequest {
        job_id: job.id.clone(),
        follow: true,
        after_seq: 0,
    };
    let lines: Vec<v1::LogLine> = service
        .jobs
        .logs(logs)
        .await
        .unwrap()
        .into_inner()
        .map(Result::unwrap)
        .collect()
        .await;
    let words: Vec<(u32, &str)> = lines
        .iter()
        .map(|line| (line.attempt, line.message.as_str()))
        .collect();
    assert_eq!(
        words,
        [
            (1, "stopped by request"),
            (3, "camera 3 has zero focal length")
        ]
    );
    let status = service
        .jobs
        .status(v1::StatusRequest::default())
        .await
        .unwrap()
        .into_inner();
    assert_eq!(
        (
            status.jobs_by_state["failed"],
            status.jobs_by_state["cancelled"]
        ),
        (1, 1)
    );
    assert_eq!(status.recent_failures[0].id, job.id);
    assert_eq!(status.workers[0].id, "worker-1");
}

#[tokio::test]
async fn bad_submits_are_refused_one_by_one() {
    let mut service = Service::start().await;
    let capture = service
        .upload_capture("museum/vase", &[("mesh.ply", b"ply")])
        .await;
    let good = submit_request("museum/vase", "good", &capture);
    let absent = submit_request("museum/vase", "absent", &Digest::of(b"absent"));
    let mut name = submit_request("museum/vase", "name", &capture);
    name.spec.as_mut().unwrap().object = Some(v1::ObjectRef {
        collection: "Museum".to_owned(),
        object: "vase".to_owned(),
    });
    let mut recipe = submit_request("museum/vase", "recipe", &capture);
    recipe.spec.as_mut().unwrap().recipe_json = "no json".to_owned();
    let empty = v1::SubmitRequest::default();
    let mut other = good.clone();
    other.spec.as_mut().unwrap().priority = 7;

    let requests = vec![
        good.clone(),
        absent.clone(),
        name,
        recipe,
        empty,
        other.clone(),
        good.clone(),
    ];
    let results = service
        .jobs
        .submit_batch(tokio_stream::iter(requests))
        .await
        .unwrap()
        .into_inner()
        .results;
    let outcomes: Vec<&str> = results
        .iter()
        .map(|result| match result.outcome.as_ref().unwrap() {
            v1::submit_result::Outcome::Job(_) => "job",
            v1::submit_result::Outcome::Error(error) => error.code.as_str(),
        })
        .collect();
    assert_eq!(
        outcomes,
        [
            "job",
            "CAPTURE_MISSING",
            "BAD_FIELD",
            "BAD_FIELD",
            "BAD_FIELD",
            "KEY_REUSED",
            "job"
        ]
    );
    let cause = |status: tonic::Status| Cause::from_status(&status);
    assert_eq!(
        cause(service.jobs.submit(other).await.unwrap_err()).reason(),
        "KEY_REUSED"
    );
    assert_eq!(
        cause(service.jobs.submit(absent).await.unwrap_err()).reason(),
        "CAPTURE_MISSING"
    );
    let nobody = v1::GetJobRequest {
        job_id: "00000000-0000-7000-8000-000000000000".to_owned(),
    };
    assert!(matches!(
        cause(service.jobs.get(nobody).await.unwrap_err()),
        Cause::Absent { .. }
    ));
    let listed = service
        .jobs
        .list(v1::ListJobsRequest::default())
        .await
        .unwrap()
        .into_inner();
    assert_eq!(listed.jobs.len(), 1);
}

#[tokio::test]
async fn aliases_versions_and_collections_are_managed() {
    let mut service = Service::start().await;
    for (version, content) in [(1, b"one"), (2, b"two")] {
        service
            .submit("museum/vase", &format!("request-{version}"))
            .await;
        let lease = service.lease("worker-1", 5.0).await.unwrap();
        assert_eq!(
            service
                .complete(&lease, "worker-1", &[("bundle.json", content)])
                .await
                .unwrap()
                .version,
            version
        );
    }
    let object = || Some(object_ref("museum/vase"));
    let approve = v1::SetAliasRequest {
        object: object(),
        reference: "v1".to_owned(),
        alias: "approved".to_owned(),
    };
    let approved = service
        .bundles
        .set_alias(approve)
        .await
        .unwrap()
        .into_inner();
    assert_eq!(
        (approved.version, approved.aliases.as_slice()),
        (1, ["approved".to_owned()].as_slice())
    );
    let retire = v1::GetBundleRequest {
        object: object(),
        reference: "v2".to_owned(),
    };
    assert!(
        service
            .bundles
            .retire(retire)
            .await
            .unwrap()
            .into_inner()
            .retired
    );
    let tags = service
        .request(Method::GET, "/v2/museum/vase/tags/list")
        .send()
        .await
        .unwrap();
    let tags: serde_json::Value = tags.json().await.unwrap();
    assert_eq!(
        tags,
        serde_json::json!({"name": "museum/vase", "tags": ["approved", "latest", "v1"]})
    );

    let collection = v1::Collection {
        name: "museum".to_owned(),
        weight: 2.0,
        max_running: 1,
        paused: true,
    };
    service.collections.set(collection.clone()).await.unwrap();
    let listed = service
        .collections
        .list(v1::ListCollectionsRequest {})
        .await
        .unwrap()
        .into_inner();
    assert_eq!(listed.collections, [collection]);
    let job = service.submit("museum/vase", "request-3").await;
    assert!(job.waiting_for.contains("paused"), "{}", job.waiting_for);
    assert!(service.lease("worker-1", 0.3).await.is_none());
}

#[tokio::test]
async fn the_bucket_is_repaired_after_a_crash_between_commit_and_record() {
    let mut service = Service::start().await;
    service.submit("museum/vase", "request-1").await;
    let lease = service.lease("worker-1", 5.0).await.unwrap();
    service
        .complete(&lease, "worker-1", &[("bundle.json", b"one")])
        .await
        .unwrap();
    service
        .bundles
        .set_alias(v1::SetAliasRequest {
            object: Some(object_ref("museum/vase")),
            reference: "v1".to_owned(),
            alias: "approved".to_owned(),
        })
        .await
        .unwrap();
    let folder = service.folder.join("store/versions/museum/vase");
    let before: Vec<Vec<u8>> = ["v1.json", "state.json"]
        .map(|name| std::fs::read(folder.join(name)).unwrap())
        .into();
    service.stop().await;
    std::fs::remove_dir_all(&folder).unwrap();
    service.restart().await;
    for _ in 0..100 {
        if folder.join("state.json").exists() {
            break;
        }
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    let after: Vec<Vec<u8>> = ["v1.json", "state.json"]
        .map(|name| std::fs::read(folder.join(name)).unwrap())
        .into();
    assert_eq!(after, before);
}
