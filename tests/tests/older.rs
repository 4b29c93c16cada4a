//! A worker and a client of the last release against the coordinator as it is: they speak the released contract, whose
//! messages and calls are compiled from `proto/tests/frozen`.

use std::fs;

use anyhow::{Context as _, Result, ensure};
use ign_e2e::{Api, Client, Coordinator, Setup, path};
use ign_proto::Digest;
use released::jobs_client::JobsClient;
use released::workers_client::WorkersClient;
use serde_json::json;
use tonic::transport::{Channel, Endpoint};

mod released {
    #![allow(
        missing_docs,
        unreachable_pub,
        clippy::pedantic,
        clippy::allow_attributes,
        clippy::large_enum_variant,
        clippy::large_futures,
        reason = "generated code"
    )]
    tonic::include_proto!("ign.v1");
}

const TOKEN: &str = "ign-older-token-0123456789abcdef";

fn with_token<T>(message: T) -> Result<tonic::Request<T>> {
    let mut request = tonic::Request::new(message);
    let bearer = format!("Bearer {TOKEN}").parse()?;
    request.metadata_mut().insert("authorization", bearer);
    Ok(request)
}

async fn work(api: &Api, channel: Channel, object: &str) -> Result<released::BundleVersion> {
    let mut workers = WorkersClient::new(channel.clone());
    let lease = workers
        .lease(with_token(released::LeaseRequest {
            worker_id: "older-1".to_owned(),
            hostname: "host".to_owned(),
            version: "0.1.0".to_owned(),
            device: "cpu".to_owned(),
            wait_secs: 5.0,
        })?)
        .await?
        .into_inner()
        .lease
        .context("no lease")?;
    let held = released::JobAttempt {
        job_id: lease.job_id.clone(),
        attempt: lease.attempt,
        worker_id: "older-1".to_owned(),
    };
    let orders = workers
        .heartbeat(with_token(released::HeartbeatRequest {
            job: Some(held.clone()),
            progress: Some(released::Progress {
                stage: "effects".to_owned(),
                percent: 40.0,
                ..released::Progress::default()
            }),
            logs: vec![released::LogLine {
                seq: 1,
                level: "info".to_owned(),
                message: "said by an older worker".to_owned(),
                ..released::LogLine::default()
            }],
        })?)
        .await?
        .into_inner();
    ensure!(!orders.cancel && orders.lease_secs > 0.0, "{orders:?}");
    let state = api.upload(object, b"state").await?;
    workers
        .checkpoint(with_token(released::CheckpointRequest {
            job: Some(held.clone()),
            digest: state.to_string(),
            size_bytes: 5,
        })?)
        .await?;
    let bundle = b"{\"attempt\":1}";
    api.upload(object, bundle).await?;
    let done = workers
        .complete(with_token(released::CompleteRequest {
            job: Some(held),
            files: vec![released::FileEntry {
                path: "bundle.json".to_owned(),
                digest: Digest::of(bundle).to_string(),
                size_bytes: bundle.len() as u64,
                media_type: "application/json".to_owned(),
            }],
            metrics_json: "{\"mse\":1.5}".to_owned(),
        })?)
        .await?
        .into_inner();
    // What its own client sees of it.
    let job = JobsClient::new(channel)
        .get(with_token(released::GetJobRequest {
            job_id: lease.job_id,
        })?)
        .await?
        .into_inner();
    ensure!(
        job.state() == released::JobState::Succeeded && job.checkpoint_digest == state.as_str(),
        "{job:?}"
    );
    done.bundle.context("no bundle")
}

#[test]
fn a_worker_of_the_released_contract_takes_a_job_from_lease_to_version() -> Result<()> {
    let dir = tempfile::Builder::new().prefix("ign-e2e-").tempdir()?;
    let token = dir.path().join("token");
    fs::write(&token, TOKEN)?;
    let mut coordinator = Coordinator::start(Setup {
        name: "coordinator".to_owned(),
        dir: dir.path().to_owned(),
        database: format!("sqlite://{}/ign.db", path(dir.path())?),
        store: format!("file://{}/store", path(dir.path())?),
        token_file: token.clone(),
        args: Vec::new(),
        env: std::collections::BTreeMap::new(),
    })?;
    coordinator.await_ready()?;
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()?;
    let version = runtime.block_on(async {
        let api = Api::new(&coordinator.url(), TOKEN)?;
        let channel = Endpoint::from_shared(coordinator.url())?.connect_lazy();
        api.submit("museum/vase", "1", &json!([])).await?;
        work(&api, channel, "museum/vase").await
    })?;
    ensure!(version.version == 1, "{version:?}");
    let ctl = Client::of_server(&coordinator.url(), path(&token)?);
    let log = ctl.logs("museum/vase")?;
    ensure!(log.contains("said by an older worker"), "{log}");
    ensure!(ctl.versions("museum")? == [("vase".to_owned(), 1)]);
    Ok(())
}
