//! The worker's calls to the coordinator (`ign.v1.Workers`), each with a deadline, none retried here.

use std::time::Duration;

use ign_proto::v1::workers_client::WorkersClient;
use ign_proto::{Cause, MAX_MESSAGE_BYTES, v1};
use reqwest::Url;
use tonic::metadata::{Ascii, MetadataValue};
use tonic::service::Interceptor;
use tonic::service::interceptor::InterceptedService;
use tonic::transport::{Channel, Endpoint};
use tonic::{Request, Response, Status};

use crate::error::AgentError;

const DEADLINE: Duration = Duration::from_secs(15);
/// Publishing checks every blob in the store.
const COMPLETE_DEADLINE: Duration = Duration::from_mins(2);

/// Adds the bearer token, where there is one, to every call, and the trace that it belongs to.
#[derive(Clone, Debug)]
struct Bearer(Option<MetadataValue<Ascii>>);

impl Interceptor for Bearer {
    fn call(&mut self, mut request: Request<()>) -> Result<Request<()>, Status> {
        if let Some(token) = &self.0 {
            request
                .metadata_mut()
                .insert("authorization", token.clone());
        }
        if let Some(trace) = ign_trace::current()
            && let Ok(trace) = trace.to_string().parse()
        {
            request.metadata_mut().insert(ign_trace::HEADER, trace);
        }
        Ok(request)
    }
}

/// A connection that makes itself again when it broke.
#[derive(Clone, Debug)]
pub(crate) struct Control {
    client: WorkersClient<InterceptedService<Channel, Bearer>>,
}

impl Control {
    pub(crate) fn new(
        server: &Url,
        token: &str,
        tls: &ign_client::Tls,
    ) -> Result<Self, AgentError> {
        let mut value: MetadataValue<Ascii> = format!("Bearer {token}")
            .parse()
            .map_err(|_invalid| AgentError::Token)?;
        value.set_sensitive(true);
        let bearer = Bearer((!token.is_empty()).then_some(value));
        let endpoint = Endpoint::from_shared(server.to_string())
            .map_err(|error| AgentError::Server {
                url: server.to_string(),
                reason: error.to_string(),
            })?
            .connect_timeout(Duration::from_secs(5))
            // A peer that vanished without a word is noticed within this time, also during a long poll.
            .http2_keep_alive_interval(Duration::from_secs(10))
            .keep_alive_timeout(Duration::from_secs(10))
            .keep_alive_while_idle(true);
        let client = WorkersClient::with_interceptor(tls.channel(&endpoint), bearer)
            .max_decoding_message_size(MAX_MESSAGE_BYTES);
        Ok(Self { client })
    }

    /// Long poll for work.
    pub(crate) async fn lease(
        &self,
        request: v1::LeaseRequest,
    ) -> Result<Option<v1::Lease>, Cause> {
        let deadline = DEADLINE + Duration::from_secs_f64(request.wait_secs.clamp(0.0, 3600.0));
        let mut client = self.client.clone();
        within(deadline, client.lease(request))
            .await
            .map(|response| response.lease)
    }

    pub(crate) async fn heartbeat(
        &self,
        request: v1::HeartbeatRequest,
    ) -> Result<v1::HeartbeatResponse, Cause> {
        let mut client = self.client.clone();
        within(DEADLINE, client.heartbeat(request)).await
    }

    pub(crate) async fn checkpoint(&self, request: v1::CheckpointRequest) -> Result<(), Cause> {
        let mut client = self.client.clone();
        within(DEADLINE, client.checkpoint(request)).await.map(drop)
    }

    pub(crate) async fn complete(
        &self,
        request: v1::CompleteRequest,
    ) -> Result<v1::CompleteResponse, Cause> {
        let mut client = self.client.clone();
        within(COMPLETE_DEADLINE, client.complete(request)).await
    }

    pub(crate) async fn fail(&self, request: v1::FailRequest) -> Result<v1::FailResponse, Cause> {
        let mut client = self.client.clone();
        within(DEADLINE, client.fail(request)).await
    }
}

async fn within<T>(
    deadline: Duration,
    call: impl Future<Output = Result<Response<T>, Status>>,
) -> Result<T, Cause> {
    match tokio::time::timeout(deadline, call).await {
        Ok(Ok(response)) => Ok(response.into_inner()),
        Ok(Err(status)) => Err(Cause::from_status(&status)),
        Err(_elapsed) => Err(Cause::Transport {
            code: tonic::Code::DeadlineExceeded,
            message: format!("no answer within {} s", deadline.as_secs()),
        }),
    }
}
