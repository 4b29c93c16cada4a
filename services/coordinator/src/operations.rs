//! `/healthz`, `/readyz`, `/metrics`.

use std::sync::Arc;
use std::time::Duration;

use axum::extract::State;
use axum::http::StatusCode;
use axum::http::header::CONTENT_TYPE;
use axum::response::IntoResponse;
use axum::routing::{MethodRouter, get};

use crate::app::App;
use crate::http_answer::Refused;

const PATIENCE: Duration = Duration::from_secs(3);

/// The routes of this module.
pub(crate) fn routes() -> Vec<(&'static str, MethodRouter<Arc<App>>)> {
    vec![
        ("/healthz", get(healthz)),
        ("/readyz", get(readyz)),
        ("/metrics", get(metrics)),
    ]
}

/// The process answers.
async fn healthz() -> &'static str {
    "ok\n"
}

/// Database and object store answer, and the coordinator is not ending.
async fn readyz(State(app): State<Arc<App>>) -> (StatusCode, &'static str) {
    let unready = |what| (StatusCode::SERVICE_UNAVAILABLE, what);
    if app.stopping.is_cancelled() {
        return unready("stopping\n");
    }
    let database = async { app.store.ping().await.map_err(Refused::from) };
    let registry = async { app.registry.ping().await.map_err(Refused::from) };
    let (database, registry) = tokio::join!(
        tokio::time::timeout(PATIENCE, database),
        tokio::time::timeout(PATIENCE, registry)
    );
    match (database, registry) {
        (Ok(Ok(())), Ok(Ok(()))) => (StatusCode::OK, "ready\n"),
        (Ok(Ok(())), _) => unready("the object store does not answer\n"),
        _ => unready("the database does not answer\n"),
    }
}

/// Prometheus' text.
async fn metrics(State(app): State<Arc<App>>) -> impl IntoResponse {
    let status = tokio::time::timeout(PATIENCE, app.store.status(None, 0)).await;
    let text = app
        .metrics
        .render(status.ok().and_then(Result::ok).as_ref());
    ([(CONTENT_TYPE, "text/plain; version=0.0.4")], text)
}
