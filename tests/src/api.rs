//! A coordinator's gRPC and HTTP, spoken as `ignctl` and the agents do, for what neither of them would do.

use std::collections::BTreeMap;
use std::time::Duration;

use anyhow::{Context as _, Result};
use ign_proto::v1::bundles_client::BundlesClient;
use ign_proto::v1::jobs_client::JobsClient;
use ign_proto::{Digest, FileEntry, Kind, Manifest, ObjectName, v1};
use tonic::transport::{Channel, Endpoint};

const LIMIT: Duration = Duration::from_secs(30);

/// Connections to one coordinator. Made and used within a runtime.
#[derive(Clone, Debug)]
pub struct Api {
    url: String,
    token: String,
    channel: Channel,
    http: reqwest::Client,
}

impl Api {
    /// Of the coordinator at `url`; connects when it is first used.
    pub fn new(url: &str, token: &str) -> Result<Self> {
        Ok(Self {
            url: url.to_owned(),
            token: token.to_owned(),
            channel: Endpoint::from_shared(url.to_owned())?
                .timeout(LIMIT)
                .connect_lazy(),
            http: reqwest::Client::builder().timeout(LIMIT).build()?,
        })
    }

    fn jobs(&self) -> JobsClient<Channel> {
        JobsClient::new(self.channel.clone())
    }

    fn with_token<T>(&self, message: T) -> Result<tonic::Request<T>> {
        let mut request = tonic::Request::new(message);
        let bearer = format!("Bearer {}", self.token).parse()?;
        request.metadata_mut().insert("authorization", bearer);
        Ok(request)
    }

    /// Sends an HTTP request; anything but success is an error.
    pub async fn send(&self, request: reqwest::RequestBuilder) -> Result<reqwest::Response> {
        let request = request.bearer_auth(&self.token);
        Ok(request.send().await?.error_for_status()?)
    }

    /// Begins a request of `method` for a path of this coordinator.
    pub fn request(&self, method: reqwest::Method, path: &str) -> reqwest::RequestBuilder {
        self.http.request(method, format!("{}{path}", self.url))
    }

    /// Begins an upload session for an object; its path.
    pub async fn begin_upload(&self, object: &str) -> Result<String> {
        let path = format!("/v2/{object}/blobs/uploads/");
        let begun = self
            .send(self.request(reqwest::Method::POST, &path))
            .await?;
        let place = begun.headers().get("location").context("no location")?;
        Ok(place.to_str()?.to_owned())
    }

    /// Uploads a file through a session, as a large one.
    pub async fn upload(&self, object: &str, bytes: &[u8]) -> Result<Digest> {
        let digest = Digest::of(bytes);
        let session = self.begin_upload(object).await?;
        let path = format!("{session}?digest={digest}");
        let request = self.request(reqwest::Method::PUT, &path);
        self.send(request.body(bytes.to_vec())).await?;
        Ok(digest)
    }

    /// Uploads a capture of one file and submits it, for an agent whose child plays `script`.
    pub async fn submit(
        &self,
        object: &str,
        request_id: &str,
        script: &serde_json::Value,
    ) -> Result<v1::Job> {
        let bytes = format!("mesh of {object}").into_bytes();
        let file = FileEntry {
            path: "mesh.ply".parse()?,
            digest: self.upload(object, &bytes).await?,
            size_bytes: bytes.len() as u64,
            media_type: "application/octet-stream".to_owned(),
        };
        let manifest = Manifest::new(Kind::Capture, vec![file], BTreeMap::new())?.encode()?;
        let digest = Digest::of(&manifest);
        let path = format!("/v2/{object}/manifests/{digest}");
        let request = self.request(reqwest::Method::PUT, &path);
        self.send(request.body(manifest)).await?;
        let (collection, name) = object.split_once('/').context("no object")?;
        let spec = v1::JobSpec {
            object: Some(v1::ObjectRef {
                collection: collection.to_owned(),
                object: name.to_owned(),
            }),
            capture_digest: digest.to_string(),
            recipe_json: serde_json::json!({ "script": script }).to_string(),
            max_attempts: 100,
            ..v1::JobSpec::default()
        };
        let request = self.with_token(v1::SubmitRequest {
            request_id: request_id.to_owned(),
            spec: Some(spec),
        })?;
        Ok(self.jobs().submit(request).await?.into_inner())
    }

    /// One job.
    pub async fn get(&self, id: &str) -> Result<v1::Job> {
        let request = self.with_token(v1::GetJobRequest {
            job_id: id.to_owned(),
        })?;
        Ok(self.jobs().get(request).await?.into_inner())
    }

    /// The job after each change, until it has ended.
    pub async fn watch(&self, id: &str) -> Result<tonic::Streaming<v1::Job>> {
        let request = self.with_token(v1::GetJobRequest {
            job_id: id.to_owned(),
        })?;
        // A stream lasts as long as the job: no limit of time here.
        let channel = Endpoint::from_shared(self.url.clone())?.connect_lazy();
        Ok(JobsClient::new(channel).watch(request).await?.into_inner())
    }

    /// Names a version of an object of the form `collection/object`.
    pub async fn set_alias(&self, object: &str, reference: &str, alias: &str) -> Result<()> {
        let request = self.with_token(v1::SetAliasRequest {
            object: Some((&object.parse::<ObjectName>()?).into()),
            reference: reference.to_owned(),
            alias: alias.to_owned(),
        })?;
        BundlesClient::new(self.channel.clone())
            .set_alias(request)
            .await?;
        Ok(())
    }

    /// Everything that is published, retired versions too.
    pub async fn versions(&self) -> Result<Vec<v1::BundleVersion>> {
        let request = self.with_token(v1::ListBundlesRequest {
            include_retired: true,
            ..v1::ListBundlesRequest::default()
        })?;
        let list = BundlesClient::new(self.channel.clone())
            .list(request)
            .await?;
        Ok(list.into_inner().bundles)
    }
}
