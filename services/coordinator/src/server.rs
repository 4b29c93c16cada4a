//! Listening, serving, ending.
//!
//! Ending is a future that the caller passes in. Then: long polls and streams end, readiness turns false, no new
//! connection is taken, what runs may finish within [`GRACE`].

use std::io::Write as _;
use std::net::SocketAddr;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use axum::Router;
use axum::extract::Request;
use axum::http::header::{
    AUTHORIZATION, CONTENT_LENGTH, CONTENT_RANGE, CONTENT_TYPE, ETAG, IF_NONE_MATCH, LOCATION,
    RANGE,
};
use axum::http::{HeaderMap, HeaderName, Method};
use hyper_util::rt::{TokioExecutor, TokioIo, TokioTimer};
use hyper_util::server::conn::auto;
use hyper_util::server::graceful::GracefulShutdown;
use hyper_util::service::TowerToHyperService;
use ign_proto::v1::bundles_server::BundlesServer;
use ign_proto::v1::collections_server::CollectionsServer;
use ign_proto::v1::jobs_server::JobsServer;
use ign_proto::v1::tokens_server::TokensServer;
use ign_proto::v1::workers_server::WorkersServer;
use ign_proto::{MAX_MESSAGE_BYTES, v1};
use ign_registry::Registry;
use tokio::net::TcpListener;
use tokio::sync::Semaphore;
use tokio::task::{JoinHandle, JoinSet};
use tokio_util::sync::CancellationToken;
use tonic_health::server::HealthReporter;
use tower::ServiceExt as _;
use tower_http::cors::{Any, CorsLayer};

use crate::app::App;
use crate::auth::{self, Doorkeeper, Peer};
use crate::bundles::BundlesApi;
use crate::collections::CollectionsApi;
use crate::config::{Config, ServeError};
use crate::data_plane;
use crate::fetch::Contents;
use crate::http_answer::unknown;
use crate::jobs::JobsApi;
use crate::maintenance;
use crate::metrics::Metrics;
use crate::operations;
use crate::publish::Mirror;
use crate::tokens::TokensApi;
use crate::trace;
use crate::workers::WorkersApi;

const MAX_CONNECTIONS: usize = 4096;
const MAX_STREAMS: u32 = 1024;
/// A peer that vanished is noticed after the sum of both.
const KEEP_ALIVE_INTERVAL: Duration = Duration::from_secs(15);
const KEEP_ALIVE_TIMEOUT: Duration = Duration::from_secs(15);
/// Longer than clients keep idle connections (reqwest: 90 s), or they would send into one that is closing.
const HEADER_TIMEOUT: Duration = Duration::from_mins(2);
const STREAM_WINDOW: u32 = 1024 * 1024;
const CONNECTION_WINDOW: u32 = 8 * 1024 * 1024;
/// How long running requests may take to end.
const GRACE: Duration = Duration::from_secs(8);

/// A coordinator that listens.
#[derive(Debug)]
pub struct Running {
    address: SocketAddr,
    task: JoinHandle<Result<(), ServeError>>,
}

impl Running {
    /// Where it listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Its address as a URL.
    pub fn url(&self) -> String {
        format!("http://{}", self.address)
    }

    /// Waits until it has ended.
    pub async fn wait(self) -> Result<(), ServeError> {
        self.task
            .await
            .map_err(|source| ServeError::Task { source })?
    }
}

/// Opens database and object store, listens, and serves in the background until `shutdown` is ready. Returns when
/// requests are answered and the endpoint file is written.
pub async fn serve(
    config: Config,
    shutdown: impl Future<Output = ()> + Send + 'static,
) -> Result<Running, ServeError> {
    let doorkeeper = Doorkeeper::new(&config.token_file, &config.limits, false)?;
    let registry = Registry::open(&config.store)
        .await
        .map_err(|source| ServeError::Registry { source })?;
    let store = ign_queue::open(&config.database, config.settings)
        .await
        .map_err(|source| ServeError::Database { source })?;
    let listen = |source| ServeError::Listen {
        address: config.listen,
        source,
    };
    let listener = TcpListener::bind(config.listen).await.map_err(listen)?;
    let address = listener.local_addr().map_err(listen)?;
    if !address.ip().is_loopback() {
        tracing::warn!(%address, "listening beyond this machine without TLS: put a proxy that speaks TLS in front");
    }
    tracing::info!(
        %address,
        store.url = config.store.url,
        store.conditional_create = registry.probe().conditional_create,
        store.signs_urls = registry.probe().signs_urls,
        "coordinator listens"
    );
    let app = Arc::new(App {
        store,
        registry,
        doorkeeper,
        contents: Contents::default(),
        metrics: Metrics::default(),
        mirror: Mirror::default(),
        redirect_blobs: config.redirect_blobs,
        stopping: CancellationToken::new(),
    });
    let (health, router) = router(&app).await;
    if let Some(path) = &config.endpoint_file {
        write_endpoint(path, address, &config.token_file).map_err(|source| {
            ServeError::Endpoint {
                path: path.clone(),
                source,
            }
        })?;
    }
    let task = tokio::spawn(async move {
        tokio::spawn({
            let stopping = app.stopping.clone();
            async move {
                shutdown.await;
                stopping.cancel();
            }
        });
        let maintenance = tokio::spawn({
            let app = app.clone();
            async move { maintenance::run(&app).await }
        });
        accept(&app, listener, router, &health).await;
        maintenance
            .await
            .map_err(|source| ServeError::Task { source })?;
        if let Some(path) = &config.endpoint_file
            && let Err(error) = std::fs::remove_file(path)
        {
            tracing::warn!(%error, path = %path.display(), "could not remove the endpoint file");
        }
        tracing::info!("coordinator ended");
        Ok(())
    });
    Ok(Running { address, task })
}

async fn router(app: &Arc<App>) -> (HealthReporter, Router) {
    let (health, health_service) = tonic_health::server::health_reporter();
    health.set_serving::<JobsServer<JobsApi>>().await;
    health.set_serving::<WorkersServer<WorkersApi>>().await;
    let mut services = tonic::service::Routes::new(health_service)
        .add_service(
            JobsServer::new(JobsApi(app.clone())).max_decoding_message_size(MAX_MESSAGE_BYTES),
        )
        .add_service(
            WorkersServer::new(WorkersApi(app.clone()))
                .max_decoding_message_size(MAX_MESSAGE_BYTES),
        )
        .add_service(
            BundlesServer::new(BundlesApi(app.clone()))
                .max_decoding_message_size(MAX_MESSAGE_BYTES),
        )
        .add_service(
            CollectionsServer::new(CollectionsApi(app.clone()))
                .max_decoding_message_size(MAX_MESSAGE_BYTES),
        )
        .add_service(
            TokensServer::new(TokensApi(app.clone())).max_decoding_message_size(MAX_MESSAGE_BYTES),
        );
    match tonic_reflection::server::Builder::configure()
        .register_encoded_file_descriptor_set(v1::FILE_DESCRIPTOR_SET)
        .register_encoded_file_descriptor_set(tonic_health::pb::FILE_DESCRIPTOR_SET)
        .build_v1()
    {
        Ok(reflection) => services = services.add_service(reflection),
        Err(error) => tracing::error!(%error, "no reflection: the compiled schema is damaged"),
    }
    let http = data_plane::routes()
        .into_iter()
        .chain(operations::routes())
        .fold(Router::new(), |router, (path, route)| {
            router.route(path, route)
        })
        .with_state(app.clone());
    let cors = CorsLayer::new()
        .allow_origin(Any)
        .allow_methods([Method::GET, Method::HEAD])
        .allow_headers([AUTHORIZATION, RANGE, IF_NONE_MATCH])
        .expose_headers([
            CONTENT_LENGTH,
            CONTENT_RANGE,
            CONTENT_TYPE,
            ETAG,
            LOCATION,
            HeaderName::from_static("docker-content-digest"),
            HeaderName::from_static("x-request-id"),
        ]);
    let router = http
        .merge(services.into_axum_router())
        .fallback(|headers: HeaderMap| async move { unknown(&headers) })
        .layer(axum::middleware::from_fn_with_state(
            app.clone(),
            auth::layer,
        ))
        .layer(cors)
        .layer(axum::middleware::from_fn_with_state(
            app.clone(),
            trace::layer,
        ));
    (health, router)
}

/// Takes connections until the coordinator is to stop, then lets them finish.
async fn accept(app: &App, listener: TcpListener, router: Router, health: &HealthReporter) {
    let mut server = auto::Builder::new(TokioExecutor::new());
    server
        .http1()
        .timer(TokioTimer::new())
        .header_read_timeout(HEADER_TIMEOUT);
    server
        .http2()
        .timer(TokioTimer::new())
        .keep_alive_interval(KEEP_ALIVE_INTERVAL)
        .keep_alive_timeout(KEEP_ALIVE_TIMEOUT)
        .max_concurrent_streams(MAX_STREAMS)
        .initial_stream_window_size(STREAM_WINDOW)
        .initial_connection_window_size(CONNECTION_WINDOW);
    let graceful = GracefulShutdown::new();
    let places = Arc::new(Semaphore::new(MAX_CONNECTIONS));
    let mut connections = JoinSet::new();
    loop {
        let accepted = tokio::select! {
            biased;
            () = app.stopping.cancelled() => break,
            // Connections that have ended are collected as others come.
            Some(_ended) = connections.join_next() => continue,
            accepted = listener.accept() => accepted,
        };
        let (socket, peer) = match accepted {
            Ok(accepted) => accepted,
            Err(error) => {
                // Out of file handles, or the peer left: the next one may do.
                tracing::warn!(%error, "could not take a connection");
                tokio::time::sleep(Duration::from_millis(50)).await;
                continue;
            }
        };
        let Ok(place) = places.clone().try_acquire_owned() else {
            tracing::warn!(%peer, "refused a connection: {MAX_CONNECTIONS} are open");
            continue;
        };
        if let Err(error) = socket.set_nodelay(true) {
            tracing::debug!(%error, %peer, "peer left at once");
            continue;
        }
        let service = router.clone().map_request(move |mut request: Request<_>| {
            request.extensions_mut().insert(Peer {
                address: peer,
                certificate: None,
            });
            request
        });
        let connection = server
            .serve_connection(TokioIo::new(socket), TowerToHyperService::new(service))
            .into_owned();
        let connection = graceful.watch(connection);
        connections.spawn(async move {
            if let Err(error) = connection.await {
                tracing::debug!(error, %peer, "connection broke");
            }
            drop(place);
        });
    }
    drop(listener);
    health.set_not_serving::<JobsServer<JobsApi>>().await;
    health.set_not_serving::<WorkersServer<WorkersApi>>().await;
    if tokio::time::timeout(GRACE, graceful.shutdown())
        .await
        .is_err()
    {
        tracing::warn!(
            "cutting connections that did not end within {} s",
            GRACE.as_secs()
        );
    }
    connections.shutdown().await;
}

/// Says where we listen. Readers see the whole file or none: it is written aside and renamed.
fn write_endpoint(path: &Path, address: SocketAddr, token_file: &Path) -> std::io::Result<()> {
    let token_file = std::path::absolute(token_file)?;
    let endpoint = serde_json::json!({
        "url": format!("http://{address}"),
        "pid": std::process::id(),
        "token_file": token_file.display().to_string(),
    });
    let folder = path
        .parent()
        .filter(|parent| !parent.as_os_str().is_empty())
        .unwrap_or(Path::new("."));
    let mut file = tempfile::NamedTempFile::new_in(folder)?;
    writeln!(file, "{endpoint}")?;
    file.as_file().sync_all()?;
    file.persist(path).map_err(|error| error.error)?;
    Ok(())
}
