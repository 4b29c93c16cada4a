//! Bodies of requests that come too slowly, or in a form that is not taken.
//!
//! Only time spent waiting for the peer counts: a peer is not blamed for a slow disk of ours.

use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, ready};
use std::time::Duration;

use axum::body::{Body, HttpBody};
use axum::extract::{Request, State};
use axum::http::StatusCode;
use axum::http::header::CONTENT_ENCODING;
use axum::middleware::Next;
use axum::response::Response;
use bytes::Bytes;
use http_body::{Frame, SizeHint};
use tokio::time::{Instant, Sleep};

use crate::app::App;
use crate::http_answer::oci_error;
use crate::limits::Limits;

/// Watches over the body of every request. Compressed bodies are not taken: nothing here unpacks what a peer sends.
pub(crate) async fn layer(State(app): State<Arc<App>>, request: Request, next: Next) -> Response {
    let encoding = request.headers().get(CONTENT_ENCODING);
    if encoding.is_some_and(|it| it != "identity") {
        let message = "send the body as it is, without Content-Encoding";
        return oci_error(StatusCode::UNSUPPORTED_MEDIA_TYPE, "UNSUPPORTED", message);
    }
    next.run(request.map(|body| Body::new(Paced::new(body, &app.limits))))
        .await
}

/// A body that ends with an error when nothing comes for too long, or too little.
struct Paced {
    body: Body,
    silence: Duration,
    bytes_per_sec: u64,
    received: u64,
    waited: Duration,
    /// While nothing is there: since when, and the alarm.
    waiting: Option<(Instant, Pin<Box<Sleep>>)>,
}

impl Paced {
    fn new(body: Body, limits: &Limits) -> Self {
        Self {
            body,
            silence: limits.body_silence,
            bytes_per_sec: limits.body_bytes_per_sec,
            received: 0,
            waited: Duration::ZERO,
            waiting: None,
        }
    }

    fn is_too_slow(&self) -> bool {
        self.waited > self.silence
            && (self.received as f64) < self.waited.as_secs_f64() * self.bytes_per_sec as f64
    }
}

impl HttpBody for Paced {
    type Data = Bytes;
    type Error = axum::Error;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, axum::Error>>> {
        let this = &mut *self;
        let polled = Pin::new(&mut this.body).poll_frame(cx);
        if let Poll::Ready(frame) = polled {
            if let Some((since, _alarm)) = this.waiting.take() {
                this.waited += since.elapsed();
            }
            if let Some(bytes) = frame.as_ref().and_then(|it| it.as_ref().ok()?.data_ref()) {
                this.received += bytes.len() as u64;
                if this.is_too_slow() {
                    let message =
                        format!("the body came at less than {} bytes/s", this.bytes_per_sec);
                    return Poll::Ready(Some(Err(axum::Error::new(message))));
                }
            }
            return Poll::Ready(frame);
        }
        let (_, alarm) = this
            .waiting
            .get_or_insert_with(|| (Instant::now(), Box::pin(tokio::time::sleep(this.silence))));
        ready!(alarm.as_mut().poll(cx));
        let message = format!("nothing came for {} s", this.silence.as_secs_f64());
        Poll::Ready(Some(Err(axum::Error::new(message))))
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}
