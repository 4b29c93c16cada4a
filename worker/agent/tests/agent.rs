//! The whole agent against a coordinator that breaks on demand, with a child that plays scripts.

#[path = "support/fake.rs"]
mod fake;
#[path = "support/worker.rs"]
mod worker;

use std::time::Duration;

use fake::{Coordinator, End, TRACE};
use ign_agent::AgentError;
use ign_proto::v1::FailureKind;
use serde_json::json;
use tokio_util::sync::CancellationToken;
use worker::{Worker, alive, config};

const SMALL: &[(&str, &[u8])] = &[("mesh.ply", b"ply"), ("images/1.png", b"one")];

fn failed(end: End) -> ign_proto::v1::Failure {
    match end {
        End::Failed(failure) => failure,
        End::Completed(_) => panic!("the job succeeded"),
    }
}

fn completed(end: End) -> ign_proto::v1::CompleteRequest {
    match end {
        End::Completed(request) => request,
        End::Failed(failure) => panic!("the job failed: {failure:?}"),
    }
}

#[tokio::test]
async fn a_capture_becomes_a_bundle() {
    let coordinator = Coordinator::start().await;
    let capture = coordinator.add_capture(&[
        ("mesh.ply", b"ply"),
        ("images/1.png", b"one"),
        ("images/copy of 1.png", b"one"),
        ("empty", b""),
    ]);
    let script = json!([
        {"read": "images/copy of 1.png"}, {"print": "{\"not\": \"an event\"}"}, {"eprint": "libtorch says hello"},
        {"progress": 40.0}, {"sleep_ms": 800}, {"done": 10}
    ]);
    let job = coordinator.queue(&capture, &script);
    let worker = Worker::start(&coordinator.url);
    let request = completed(coordinator.end_of(&job).await);
    let paths: Vec<&str> = request.files.iter().map(|file| &*file.path).collect();
    assert_eq!(
        paths,
        ["bundle.json", "metrics.json", "references/0007.png"]
    );
    assert_eq!(request.files[2].size_bytes, 10);
    assert_eq!(request.files[2].media_type, "image/png");
    assert_eq!(
        request.metrics_json,
        r#"{"methods":[{"mse":4.5,"name":"ours"}],"schema":"ign.metrics/1"}"#
    );
    {
        let world = coordinator.world();
        for line in [
            "images/copy of 1.png: one",
            "{\"not\": \"an event\"}",
            "libtorch says hello",
            "threads 3",
        ] {
            assert!(world.logs.iter().any(|known| known == line), "{line}");
        }
        assert!(world.progress.iter().any(|progress| {
            progress.stage == "effects"
                && (progress.percent - 40.0).abs() < 1e-9
                && progress.error == Some(20.5)
        }));
        assert!(
            world
                .progress
                .iter()
                .any(|progress| progress.stage == "upload")
        );
    }

    // The same capture again moves no bytes of it, and the same bundle none either.
    coordinator.world().requests.clear();
    let job = coordinator.queue(&capture, &json!([{"done": 10}]));
    completed(coordinator.end_of(&job).await);
    let requests = coordinator.world().requests.clone();
    assert!(
        requests
            .iter()
            .all(|line| line.starts_with("HEAD ") || line.contains("/manifests/")),
        "{requests:#?}"
    );
    worker.stop().await;
}

#[tokio::test]
async fn broken_downloads_go_on_where_they_stopped() {
    let coordinator = Coordinator::start().await;
    let large: Vec<u8> = (0..1_000_000_u32).map(|i| b'a' + (i % 7) as u8).collect();
    let capture = coordinator.add_capture(&[("large.txt", &large)]);
    coordinator.world().cut_downloads.extend([300_000, 200_000]);
    let job = coordinator.queue(&capture, &json!([{"done": 1}]));
    let worker = Worker::start(&coordinator.url);
    completed(coordinator.end_of(&job).await);
    let ranges: Vec<String> = coordinator
        .world()
        .requests
        .iter()
        .filter(|line| line.starts_with("GET ") && line.contains("/blobs/"))
        .map(|line| line.split_whitespace().nth(2).unwrap_or("whole").to_owned())
        .collect();
    assert_eq!(ranges, ["whole", "bytes=300000-", "bytes=500000-"]);
    worker.stop().await;
}

#[tokio::test]
async fn broken_uploads_go_on_where_they_stopped() {
    let coordinator = Coordinator::start().await;
    let capture = coordinator.add_capture(SMALL);
    {
        let mut world = coordinator.world();
        world.lose_patch_answers = 1;
    }
    let job = coordinator.queue(&capture, &json!([{"done": 10_000_000}]));
    let worker = Worker::start(&coordinator.url);
    let request = completed(coordinator.end_of(&job).await);
    assert_eq!(
        coordinator.world().blobs[&request.files[2].digest].len(),
        10_000_000
    );
    let patches: Vec<String> = coordinator
        .world()
        .requests
        .iter()
        .filter(|line| line.starts_with("PATCH "))
        .map(|line| line.split_whitespace().nth(2).unwrap().to_owned())
        .collect();
    // The answer to the first was lost, its bytes were not.
    assert_eq!(patches, ["0-4194303", "4194304-8388607", "8388608-9999999"]);

    // An upload that the server forgot begins again.
    coordinator.world().forget_uploads = 1;
    let job = coordinator.queue(&capture, &json!([{"done": 5_000_000}]));
    completed(coordinator.end_of(&job).await);
    worker.stop().await;
}

#[tokio::test]
async fn blobs_that_the_store_lost_are_sent_again() {
    let coordinator = Coordinator::start().await;
    let capture = coordinator.add_capture(SMALL);
    coordinator.world().blob_missing_answers = 1;
    let job = coordinator.queue(&capture, &json!([{"done": 5}]));
    let worker = Worker::start(&coordinator.url);
    completed(coordinator.end_of(&job).await);
    worker.stop().await;
}

#[tokio::test]
async fn a_crash_is_reported_and_the_next_attempt_resumes() {
    let coordinator = Coordinator::start().await;
    let capture = coordinator.add_capture(SMALL);
    let script = json!([
        {"checkpoint": "epoch 1"}, {"sleep_ms": 500}, {"progress": 10.0},
        {"checkpoint": "epoch 2"}, {"eprint": "terminate called"}, {"abort": true}
    ]);
    let job = coordinator.queue(&capture, &script);
    let worker = Worker::start(&coordinator.url);
    let failure = failed(coordinator.end_of(&job).await);
    assert_eq!(failure.kind(), FailureKind::Crashed);
    assert_eq!(
        failure.message,
        "the bake process was killed by signal 6 (SIGABRT) in stage effects without a result; last output: terminate called"
    );
    let checkpoint = coordinator.world().checkpoints.last().unwrap().clone();
    assert_eq!(coordinator.world().blobs[&checkpoint], b"epoch 2");

    coordinator.queue_attempt(&job, 2, &capture, &json!([{"done": 5}]), &checkpoint);
    coordinator
        .until("second end", |world| world.ends.len() == 2)
        .await;
    completed(coordinator.end_of(&job).await);
    assert_eq!(
        coordinator.world().log_after("resumed from ").unwrap(),
        "epoch 2"
    );

    // A checkpoint that the store lost costs time, not the job.
    let lost = format!("sha256:{}", "0".repeat(64));
    let other = ign_proto::JobId::generate().to_string();
    coordinator.queue_attempt(&other, 2, &capture, &json!([{"done": 5}]), &lost);
    completed(coordinator.end_of(&other).await);
    assert!(
        coordinator
            .world()
            .log_after("starting from zero")
            .is_some()
    );
    worker.stop().await;
}

#[tokio::test]
async fn bad_captures_fail_at_once_and_the_worker_goes_on() {
    let coordinator = Coordinator::start().await;
    let capture = coordinator.add_capture(SMALL);
    let refused = coordinator.queue(
        &capture,
        &json!([{"fail": "camera 3 has zero focal length"}, {"exit": 1}]),
    );
    let silent = coordinator.queue(&capture, &json!([{"exit": 3}]));
    let absent = coordinator.queue(&format!("sha256:{}", "1".repeat(64)), &json!([]));
    let garbage = coordinator.queue(&coordinator.add_manifest(b"[1, 2]"), &json!([]));
    let incomplete = coordinator.add_capture(&[("mesh.ply", b"will be lost")]);
    coordinator
        .world()
        .blobs
        .retain(|_, content| content != b"will be lost");
    let incomplete = coordinator.queue(&incomplete, &json!([]));
    let clash = coordinator.add_capture(&[("a", b"file"), ("a/b", b"below it")]);
    let clash = coordinator.queue(&clash, &json!([]));
    let good = coordinator.queue(&capture, &json!([{"done": 5}]));
    let worker = Worker::start(&coordinator.url);
    completed(coordinator.end_of(&good).await);

    let failure = failed(coordinator.end_of(&refused).await);
    assert_eq!(failure.kind(), FailureKind::InvalidInput);
    assert_eq!(failure.message, "camera 3 has zero focal length");
    assert_eq!(failure.at, "sparse/cameras.txt:7");
    assert_eq!(failure.hint, "re-export with PINHOLE");
    let failure = failed(coordinator.end_of(&silent).await);
    assert_eq!(failure.kind(), FailureKind::Crashed);
    assert!(
        failure.message.contains("exited with code 3"),
        "{failure:?}"
    );
    for (job, message) in [
        (absent, "is not in the registry"),
        (garbage, "is not usable: manifest"),
        (incomplete, "is not in the registry"),
        (clash, "a/b lies below another file"),
    ] {
        let failure = failed(coordinator.end_of(&job).await);
        assert_eq!(failure.kind(), FailureKind::InvalidInput, "{failure:?}");
        assert!(failure.message.contains(message), "{failure:?}");
    }
    worker.stop().await;
}

#[tokio::test]
async fn damaged_blobs_never_reach_a_bake() {
    let coordinator = Coordinator::start().await;
    let capture = coordinator.add_capture(SMALL);
    coordinator.world().damage = true;
    let job = coordinator.queue(&capture, &json!([{"done": 5}]));
    let worker = Worker::start(&coordinator.url);
    let failure = failed(coordinator.end_of(&job).await);
    assert_eq!(failure.kind(), FailureKind::Transient);
    assert!(failure.message.contains("arrived damaged"), "{failure:?}");
    worker.stop().await;
}

#[tokio::test]
async fn cancel_kills_the_child() {
    let coordinator = Coordinator::start().await;
    let capture = coordinator.add_capture(SMALL);
    let job = coordinator.queue(&capture, &json!([{"sleep_ms": 600_000}]));
    let worker = Worker::start(&coordinator.url);
    coordinator
        .until("start", |world| world.log_after("pid ").is_some())
        .await;
    let pid = coordinator.world().log_after("pid ").unwrap();
    assert!(alive(&pid));
    coordinator.world().cancel.insert(job.clone());
    let failure = failed(coordinator.end_of(&job).await);
    assert_eq!(failure.kind(), FailureKind::Cancelled);
    assert!(!alive(&pid));
    worker.stop().await;
}

#[tokio::test]
async fn a_lost_lease_ends_everything_about_the_job() {
    let coordinator = Coordinator::start().await;
    let capture = coordinator.add_capture(SMALL);
    let lost = coordinator.queue(&capture, &json!([{"sleep_ms": 600_000}]));
    let worker = Worker::start(&coordinator.url);
    coordinator
        .until("start", |world| world.log_after("pid ").is_some())
        .await;
    let pid = coordinator.world().log_after("pid ").unwrap();
    coordinator.world().lost.insert(lost.clone());
    let next = coordinator.queue(&capture, &json!([{"done": 5}]));
    completed(coordinator.end_of(&next).await);
    assert!(!alive(&pid));
    assert_eq!(coordinator.world().ends.len(), 1);
    worker.stop().await;
}

#[tokio::test]
async fn a_bake_outlives_an_absent_coordinator() {
    let coordinator = Coordinator::start().await;
    let capture = coordinator.add_capture(SMALL);
    let script = json!([{"sleep_ms": 1000}, {"checkpoint": "c"}, {"print": "still here"}, {"done": 6_000_000}]);
    let job = coordinator.queue(&capture, &script);
    let worker = Worker::start(&coordinator.url);
    coordinator
        .until("start", |world| world.log_after("pid ").is_some())
        .await;
    coordinator.world().down = true;
    tokio::time::sleep(Duration::from_secs(4)).await;
    assert!(coordinator.world().ends.is_empty());
    coordinator.world().down = false;
    completed(coordinator.end_of(&job).await);
    assert!(coordinator.world().log_after("still here").is_some());
    worker.stop().await;
}

#[tokio::test]
async fn a_shutdown_hands_the_job_back_with_its_checkpoint() {
    let coordinator = Coordinator::start().await;
    let capture = coordinator.add_capture(SMALL);
    let script =
        json!([{"checkpoint": "epoch 7"}, {"print": "checkpointed"}, {"sleep_ms": 600_000}]);
    let job = coordinator.queue(&capture, &script);
    let worker = Worker::start(&coordinator.url);
    coordinator
        .until("checkpoint", |world| {
            world.log_after("checkpointed").is_some()
        })
        .await;
    let pid = coordinator.world().log_after("pid ").unwrap();
    worker.stop().await;
    assert!(!alive(&pid));
    let failure = failed(coordinator.end_of(&job).await);
    assert_eq!(failure.kind(), FailureKind::Transient);
    assert_eq!(failure.message, "worker shut down");
    let world = coordinator.world();
    let checkpoint = world.checkpoints.last().unwrap();
    assert_eq!(world.blobs[checkpoint], b"epoch 7");
}

#[tokio::test]
async fn a_shutdown_ends_even_when_nobody_answers() {
    let coordinator = Coordinator::start().await;
    let capture = coordinator.add_capture(SMALL);
    coordinator.queue(&capture, &json!([{"sleep_ms": 600_000}]));
    let worker = Worker::start(&coordinator.url);
    coordinator
        .until("start", |world| world.log_after("pid ").is_some())
        .await;
    coordinator.world().down = true;
    tokio::time::timeout(Duration::from_secs(20), worker.stop())
        .await
        .unwrap();
}

#[tokio::test]
async fn a_drained_worker_finishes_its_job_and_waits_for_the_end_of_the_drain() {
    let coordinator = Coordinator::start().await;
    let capture = coordinator.add_capture(SMALL);
    let job = coordinator.queue(&capture, &json!([{"sleep_ms": 800}, {"done": 5}]));
    let waiting = coordinator.queue(&capture, &json!([{"done": 5}]));
    let worker = Worker::start(&coordinator.url);
    coordinator
        .until("the lease", |world| world.queue.len() == 1)
        .await;
    coordinator.world().drain = true;
    completed(coordinator.end_of(&job).await);
    tokio::time::sleep(Duration::from_millis(500)).await;
    assert_eq!(coordinator.world().queue[0].job_id, waiting);
    assert!(!worker.task.is_finished(), "it waits");
    coordinator.world().drain = false;
    completed(coordinator.end_of(&waiting).await);
    worker.stop().await;
}

#[tokio::test]
async fn slots_run_side_by_side_and_each_job_ends_by_itself() {
    let coordinator = Coordinator::start().await;
    let capture = coordinator.add_capture(SMALL);
    let endless = json!([{"checkpoint": "c"}, {"print": "at work"}, {"sleep_ms": 600_000}]);
    let cancelled = coordinator.queue(&capture, &endless);
    let stopped = coordinator.queue(&capture, &endless);
    let next = coordinator.queue(&capture, &json!([{"read": "images/1.png"}, {"done": 5}]));
    let worker = Worker::with_slots(&coordinator.url, 2);
    coordinator
        .until("two at work", |world| {
            let at_work = world.logs.iter().filter(|line| *line == "at work");
            at_work.count() == 2 && world.checkpoints.len() == 2
        })
        .await;
    let pids = coordinator.world().logs_after("pid ");
    assert!(
        pids.len() == 2 && pids.iter().all(|pid| alive(pid)),
        "{pids:?}"
    );
    let folders = std::fs::read_dir(worker.dir.path().join("jobs")).unwrap();
    assert_eq!(folders.count(), 2);
    assert_eq!(coordinator.world().queue.len(), 1);

    // One slot becomes free; the job of the other goes on.
    coordinator.world().cancel.insert(cancelled.clone());
    let failure = failed(coordinator.end_of(&cancelled).await);
    assert_eq!(failure.kind(), FailureKind::Cancelled);
    completed(coordinator.end_of(&next).await);
    assert_eq!(pids.iter().filter(|pid| alive(pid)).count(), 1);
    let fetched = coordinator
        .world()
        .requests
        .iter()
        .filter(|line| line.starts_with("GET ") && line.contains("/blobs/"))
        .count();
    assert_eq!(
        fetched,
        SMALL.len(),
        "what one slot fetched serves the others"
    );

    worker.stop().await;
    assert!(!pids.iter().any(|pid| alive(pid)));
    let failure = failed(coordinator.end_of(&stopped).await);
    assert_eq!(failure.message, "worker shut down");
}

#[tokio::test]
async fn a_drain_lets_every_slot_finish() {
    let coordinator = Coordinator::start().await;
    let capture = coordinator.add_capture(SMALL);
    let script = json!([{"sleep_ms": 800}, {"done": 5}]);
    let running = [
        coordinator.queue(&capture, &script),
        coordinator.queue(&capture, &script),
    ];
    let waiting = coordinator.queue(&capture, &json!([{"done": 5}]));
    let worker = Worker::with_slots(&coordinator.url, 2);
    coordinator
        .until("the leases", |world| world.queue.len() == 1)
        .await;
    coordinator.world().drain = true;
    for job in &running {
        completed(coordinator.end_of(job).await);
    }
    tokio::time::sleep(Duration::from_millis(500)).await;
    assert_eq!(coordinator.world().queue.len(), 1);
    coordinator.world().drain = false;
    completed(coordinator.end_of(&waiting).await);
    worker.stop().await;
}

#[tokio::test]
async fn a_refused_slot_ends_the_agent_and_hands_the_other_job_back() {
    let coordinator = Coordinator::start().await;
    let capture = coordinator.add_capture(SMALL);
    let job = coordinator.queue(&capture, &json!([{"sleep_ms": 600_000}]));
    let worker = Worker::with_slots(&coordinator.url, 2);
    coordinator
        .until("start", |world| world.log_after("pid ").is_some())
        .await;
    let pid = coordinator.world().log_after("pid ").unwrap();
    coordinator.world().refuse_leases = true;
    let ended = worker.task.await.unwrap();
    assert!(
        matches!(ended, Err(AgentError::Refused { .. })),
        "{ended:?}"
    );
    let failure = failed(coordinator.end_of(&job).await);
    assert_eq!(failure.message, "worker shut down");
    assert!(!alive(&pid));
}

/// Also where nothing is exported.
#[tokio::test]
async fn the_trace_of_the_lease_reaches_the_child_and_comes_back_with_calls() {
    let coordinator = Coordinator::start().await;
    let capture = coordinator.add_capture(SMALL);
    let job = coordinator.queue(&capture, &json!([{"env": "TRACEPARENT"}, {"done": 5}]));
    let worker = Worker::start(&coordinator.url);
    completed(coordinator.end_of(&job).await);
    worker.stop().await;
    let world = coordinator.world();
    let told = world.log_after("TRACEPARENT=");
    assert_eq!(told.as_deref(), Some(TRACE));
    assert_eq!(world.traces, [TRACE.to_owned()].into());
}

#[tokio::test]
async fn what_a_person_must_repair_ends_the_agent() {
    let coordinator = Coordinator::start().await;
    let dir = tempfile::tempdir().unwrap();
    let run = |config| ign_agent::run(config, CancellationToken::new());

    let mut wrong = config(&coordinator.url, dir.path());
    wrong.token = "wrong".into();
    let error = run(wrong).await.unwrap_err();
    assert!(matches!(error, AgentError::Refused { .. }), "{error}");

    let mut wrong = config(&coordinator.url, dir.path());
    wrong.server = "coordinator:7400".into();
    let error = run(wrong).await.unwrap_err();
    assert!(matches!(error, AgentError::Server { .. }), "{error}");

    let mut wrong = config(&coordinator.url, dir.path());
    wrong.name = Some("../x".into());
    let error = run(wrong).await.unwrap_err();
    assert!(matches!(error, AgentError::Name { .. }), "{error}");

    let worker = Worker::start(&coordinator.url);
    tokio::time::sleep(Duration::from_millis(300)).await;
    let error = run(config(&coordinator.url, worker.dir.path()))
        .await
        .unwrap_err();
    assert!(matches!(error, AgentError::WorkDirInUse { .. }), "{error}");
    worker.stop().await;
}

#[tokio::test]
async fn leftovers_of_a_killed_agent_are_removed() {
    let coordinator = Coordinator::start().await;
    let dir = tempfile::tempdir().unwrap();
    std::fs::create_dir_all(dir.path().join("jobs/old.1/capture")).unwrap();
    std::fs::write(dir.path().join("jobs/old.1/capture/mesh.ply"), "x").unwrap();
    let shutdown = CancellationToken::new();
    let task = tokio::spawn(ign_agent::run(
        config(&coordinator.url, dir.path()),
        shutdown.clone(),
    ));
    tokio::time::sleep(Duration::from_millis(300)).await;
    shutdown.cancel();
    task.await.unwrap().unwrap();
    assert_eq!(
        std::fs::read_dir(dir.path().join("jobs")).unwrap().count(),
        0
    );
}
