//! Refusals over HTTP, in OCI's shape: `{"errors":[{"code","message"}]}`.

use axum::Json;
use axum::http::header::{CONTENT_TYPE, RETRY_AFTER};
use axum::http::{HeaderMap, HeaderValue, StatusCode};
use axum::response::{IntoResponse, Response};
use ign_proto::Cause;

/// Why a request was refused; the error type of all handlers.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct Refused(pub(crate) Cause);

/// Whether the request speaks gRPC and wants its answer so.
pub(crate) fn is_grpc(headers: &HeaderMap) -> bool {
    headers
        .get(CONTENT_TYPE)
        .is_some_and(|value| value.as_bytes().starts_with(b"application/grpc"))
}

impl IntoResponse for Refused {
    fn into_response(self) -> Response {
        let (status, code) = match &self.0 {
            Cause::BadField { field, .. } => (
                StatusCode::BAD_REQUEST,
                match field.as_str() {
                    "digest" => "DIGEST_INVALID",
                    "manifest" => "MANIFEST_INVALID",
                    "collection" | "object" => "NAME_INVALID",
                    "body" => "BLOB_UPLOAD_INVALID",
                    _ => "BAD_FIELD",
                },
            ),
            Cause::Absent { kind, .. } => (
                StatusCode::NOT_FOUND,
                match kind.as_str() {
                    "blob" => "BLOB_UNKNOWN",
                    "upload" => "BLOB_UPLOAD_UNKNOWN",
                    "manifest" | "bundle" => "MANIFEST_UNKNOWN",
                    _ => "NAME_UNKNOWN",
                },
            ),
            Cause::NotAllowed { reason, .. } if reason == "BLOB_MISSING" => {
                (StatusCode::BAD_REQUEST, "MANIFEST_BLOB_UNKNOWN")
            }
            Cause::KeyReused { .. }
            | Cause::LeaseLost { .. }
            | Cause::NotAllowed { .. }
            | Cause::Conflict => (StatusCode::CONFLICT, "CONFLICT"),
            Cause::Unavailable { .. } => (StatusCode::SERVICE_UNAVAILABLE, "UNAVAILABLE"),
            Cause::TooMany { .. } => (StatusCode::TOO_MANY_REQUESTS, "TOOMANYREQUESTS"),
            Cause::Full { .. } => (StatusCode::INSUFFICIENT_STORAGE, "FULL"),
            Cause::Unauthenticated => (StatusCode::UNAUTHORIZED, "UNAUTHORIZED"),
            Cause::Forbidden { .. } => (StatusCode::FORBIDDEN, "DENIED"),
            Cause::Internal { .. } | Cause::Transport { .. } => {
                (StatusCode::INTERNAL_SERVER_ERROR, "INTERNAL")
            }
        };
        let mut response = oci_error(status, code, &self.0.to_string());
        if let Some(delay) = self.0.retry_after() {
            response.headers_mut().insert(
                RETRY_AFTER,
                HeaderValue::from(delay.as_secs_f64().ceil().max(1.0) as u64),
            );
        }
        response
    }
}

/// An error answer in OCI's shape.
pub(crate) fn oci_error(status: StatusCode, code: &str, message: &str) -> Response {
    (
        status,
        Json(serde_json::json!({"errors": [{"code": code, "message": message}]})),
    )
        .into_response()
}

/// What a route that does not exist answers.
pub(crate) fn unknown(headers: &HeaderMap) -> Response {
    let message = "no such route";
    if is_grpc(headers) {
        let cause = Cause::Transport {
            code: tonic::Code::Unimplemented,
            message: message.to_owned(),
        };
        return cause.status().into_http();
    }
    oci_error(StatusCode::NOT_FOUND, "UNSUPPORTED", message)
}
