//! Starting, waiting, stopping.

use std::time::{Duration, Instant};

use ign_coordinator::ServeError;
use ign_proto::v1;
use reqwest::{Method, StatusCode};
use tokio_stream::StreamExt as _;

use crate::fixture::{Service, attempt};

#[tokio::test]
async fn a_waiting_worker_gets_a_new_job_at_once() {
    let mut service = Service::start().await;
    let waiting = tokio::spawn({
        let mut workers = service.workers.clone();
        async move {
            let request = v1::LeaseRequest {
                worker_id: "worker-1".to_owned(),
                wait_secs: 20.0,
                ..Default::default()
            };
            let lease = workers.lease(request).await.unwrap().into_inner().lease;
            (lease, Instant::now())
        }
    });
    tokio::time::sleep(Duration::from_millis(300)).await;
    service.submit("museum/vase", "request-1").await;
    let submitted = Instant::now();
    let (lease, leased) = waiting.await.unwrap();
    assert!(lease.is_some());
    assert!(leased.saturating_duration_since(submitted) < Duration::from_secs(1));
}

#[tokio::test]
async fn stopping_ends_streams_and_long_polls_soon() {
    let mut service = Service::start().await;
    let endpoint = service.folder.join("endpoint.json");
    let written: serde_json::Value =
        serde_json::from_slice(&std::fs::read(&endpoint).unwrap()).unwrap();
    assert_eq!(written["url"], service.url.as_str());
    assert_eq!(written["pid"], std::process::id());
    assert_eq!(
        written["token_file"],
        service.folder.join("token").display().to_string()
    );

    let job = service.submit("museum/vase", "request-1").await;
    service.lease("worker-0", 5.0).await.unwrap();
    let request = v1::GetJobRequest {
        job_id: job.id.clone(),
    };
    let mut watched = service.jobs.watch(request).await.unwrap().into_inner();
    watched.next().await.unwrap().unwrap();
    let waiting = tokio::spawn({
        let mut workers = service.workers.clone();
        async move {
            let request = v1::LeaseRequest {
                worker_id: "worker-1".to_owned(),
                wait_secs: 60.0,
                ..Default::default()
            };
            workers.lease(request).await
        }
    });
    tokio::time::sleep(Duration::from_millis(200)).await;
    let begun = Instant::now();
    service.stop().await;
    assert!(
        begun.elapsed() < Duration::from_secs(5),
        "{:?}",
        begun.elapsed()
    );
    assert!(!endpoint.exists());
    assert!(waiting.await.unwrap().unwrap().into_inner().lease.is_none());
    let ended = watched.next().await.unwrap().unwrap_err();
    assert!(ign_proto::Cause::from_status(&ended).retryable());

    service.restart().await;
    let kept = service.get(&job.id).await;
    assert_eq!(
        kept.state(),
        v1::JobState::Leased,
        "a restart loses nothing"
    );
}

#[tokio::test]
async fn a_message_that_is_too_large_is_refused() {
    let mut service = Service::start().await;
    let request = v1::LogsRequest {
        job_id: "x".repeat(17 * 1024 * 1024),
        ..Default::default()
    };
    assert_eq!(
        service.jobs.logs(request).await.unwrap_err().code(),
        tonic::Code::OutOfRange
    );
    let large = vec![b' '; 5 * 1024 * 1024];
    let path = format!("/v2/c/o/manifests/{}", ign_proto::Digest::of(&large));
    let answer = service
        .request(Method::PUT, &path)
        .body(large)
        .send()
        .await
        .unwrap();
    assert_eq!(answer.status(), StatusCode::PAYLOAD_TOO_LARGE);
}

#[tokio::test]
async fn a_coordinator_that_cannot_work_says_why() {
    let dir = tempfile::tempdir().unwrap();
    let token = dir.path().join("token");
    std::fs::write(&token, "0123456789abcdef").unwrap();
    let config = |change: fn(&mut ign_coordinator::Config)| {
        let mut config = ign_coordinator::Config {
            listen: "127.0.0.1:0".parse().unwrap(),
            database: format!("sqlite://{}/ign.db", dir.path().display()),
            store: ign_registry::StoreConfig::new(format!("file://{}/store", dir.path().display())),
            token_file: token.clone(),
            endpoint_file: None,
            settings: ign_queue::Settings::default(),
            tls: None,
            behind_tls_proxy: false,
            limits: ign_coordinator::Limits::default(),
            redirect_blobs: false,
            care: ign_coordinator::Care::default(),
            webhook_internal: Vec::new(),
        };
        change(&mut config);
        ign_coordinator::serve(config, std::future::pending())
    };
    let error = config(|config| config.token_file = "/absent".into())
        .await
        .unwrap_err();
    assert!(matches!(error, ServeError::Token { .. }), "{error}");
    let error = config(|config| config.database = "mysql://x".to_owned())
        .await
        .unwrap_err();
    assert!(matches!(error, ServeError::Database { .. }), "{error}");
    let error = config(|config| config.store.url = "file:///dev/null/x".to_owned())
        .await
        .unwrap_err();
    assert!(matches!(error, ServeError::Registry { .. }), "{error}");
    let error = config(|config| config.endpoint_file = Some("/dev/null/x".into()))
        .await
        .unwrap_err();
    assert!(matches!(error, ServeError::Endpoint { .. }), "{error}");
}

#[tokio::test]
async fn a_drained_worker_finishes_and_gets_work_again_when_the_drain_ends() {
    let mut service = Service::start().await;
    service.submit("museum/vase", "1").await;
    service.submit("museum/urn", "2").await;
    let lease = service.lease("w", 5.0).await.unwrap();
    let drain = |names: &[&str], draining| v1::DrainWorkersRequest {
        worker_ids: names.iter().map(ToString::to_string).collect(),
        draining,
    };
    let drained = service.admin.drain_workers(drain(&["w"], true)).await;
    let drained = drained.unwrap().into_inner().workers;
    assert_eq!(drained.len(), 1);
    assert!(drained[0].draining && drained[0].job_id == lease.job_id);
    let heartbeat = v1::HeartbeatRequest {
        job: Some(attempt(&lease, "w")),
        ..v1::HeartbeatRequest::default()
    };
    let told = service.workers.heartbeat(heartbeat).await.unwrap();
    assert!(told.into_inner().drain);
    service
        .complete(&lease, "w", &[("bundle.json", b"{}")])
        .await
        .unwrap();
    assert_eq!(service.lease("w", 0.3).await, None);
    let absent = service.admin.drain_workers(drain(&["nobody"], true)).await;
    assert_eq!(absent.unwrap_err().code(), tonic::Code::NotFound);

    // All of them, and a long poll that waits hears of it at once.
    let mut admin = service.admin.clone();
    let begun = Instant::now();
    let (lease, undrained) = tokio::join!(service.lease("w", 20.0), async {
        tokio::time::sleep(Duration::from_millis(200)).await;
        admin.drain_workers(drain(&[], false)).await.unwrap()
    });
    assert!(lease.is_some() && begun.elapsed() < Duration::from_secs(10));
    assert!(!undrained.into_inner().workers[0].draining);
}
