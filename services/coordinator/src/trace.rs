//! One span and one id per request, and the trace that the request belongs to.
//!
//! The id comes from the client's `x-request-id` when that is harmless, is sent back in the answer, and stands in every
//! log line of the request; so does the id of the trace of its `traceparent`. Paths hold names and digests only;
//! headers, where tokens are, are never logged.

use std::sync::Arc;
use std::time::Instant;

use axum::extract::{Request, State};
use axum::http::{HeaderMap, HeaderName, HeaderValue};
use axum::middleware::Next;
use axum::response::Response;
use ign_trace::TraceParent;
use tracing::field::Empty;

use crate::app::App;
use crate::http_answer::is_grpc;

const HEADER: HeaderName = HeaderName::from_static("x-request-id");

tokio::task_local! {
    static REQUEST_ID: String;
}

/// Id of the request that this task serves; a new one outside of any.
pub(crate) fn request_id() -> String {
    REQUEST_ID
        .try_with(Clone::clone)
        .unwrap_or_else(|_outside| new_id())
}

/// Gives a task that goes on by itself the id, span and trace of the request that started it.
pub(crate) fn spawn<F>(future: F) -> tokio::task::JoinHandle<F::Output>
where
    F: Future<Output: Send> + Send + 'static,
{
    tokio::spawn(REQUEST_ID.scope(request_id(), ign_trace::carry(future)))
}

fn new_id() -> String {
    uuid::Uuid::now_v7().simple().to_string()
}

fn given_id(headers: &HeaderMap) -> Option<&str> {
    let id = headers.get(HEADER)?.to_str().ok()?;
    let harmless =
        (1..=64).contains(&id.len()) && id.bytes().all(|b| b.is_ascii_alphanumeric() || b == b'-');
    harmless.then_some(id)
}

fn parent(headers: &HeaderMap) -> Option<TraceParent> {
    headers.get(ign_trace::HEADER)?.to_str().ok()?.parse().ok()
}

/// Spans, counts and times every request.
pub(crate) async fn layer(State(app): State<Arc<App>>, request: Request, next: Next) -> Response {
    let id = given_id(request.headers()).map_or_else(new_id, str::to_owned);
    let parent = parent(request.headers());
    let grpc = is_grpc(request.headers());
    let span = tracing::info_span!(
        "request",
        otel.kind = "server",
        request.id = id,
        trace.id = Empty,
        http.method = %request.method(),
        http.path = request.uri().path(),
    );
    if let Some(parent) = parent {
        span.record("trace.id", parent.trace_id());
    }
    let begun = Instant::now();
    let work = REQUEST_ID.scope(id.clone(), next.run(request));
    let mut response = ign_trace::within(span.clone(), parent, work).await;
    let status = response.status().as_u16();
    let elapsed = begun.elapsed();
    app.metrics.request(grpc, status, elapsed);
    tracing::debug!(parent: &span, http.status = status, elapsed_secs = elapsed.as_secs_f64(), "answered");
    if let Ok(value) = HeaderValue::from_str(&id) {
        response.headers_mut().insert(HEADER, value);
    }
    response
}
