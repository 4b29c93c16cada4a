//! Listening, serving, ending.
//!
//! Ending is a future that the caller passes in. Then: long polls and streams end, readiness turns false, no new
//! connection is taken, what runs may finish within a grace; see [`crate::connections`].

use std::io::Write as _;
use std::net::SocketAddr;
use std::path::Path;
use std::sync::Arc;

use axum::Router;
use axum::http::header::{
    AUTHORIZATION, CONTENT_LENGTH, CONTENT_RANGE, CONTENT_TYPE, ETAG, IF_NONE_MATCH, LOCATION,
    RANGE,
};
use axum::http::{HeaderMap, HeaderName, Method};
use futures::future::BoxFuture;
use ign_proto::v1::admin_server::AdminServer;
use ign_proto::v1::bundles_server::BundlesServer;
use ign_proto::v1::collections_server::CollectionsServer;
use ign_proto::v1::jobs_server::JobsServer;
use ign_proto::v1::tokens_server::TokensServer;
use ign_proto::v1::workers_server::WorkersServer;
use ign_proto::{MAX_MESSAGE_BYTES, v1};
use ign_registry::Registry;
use tokio::net::TcpListener;
use tokio::sync::Notify;
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;
use tonic_health::server::HealthReporter;
use tower_http::cors::{Any, CorsLayer};

use crate::admin::AdminApi;
use crate::app::App;
use crate::auth::{self, Doorkeeper};
use crate::body;
use crate::bundles::BundlesApi;
use crate::collections::CollectionsApi;
use crate::config::{Config, ServeError};
use crate::connections::Door;
use crate::data_plane;
use crate::fetch::Contents;
use crate::holders::Holders;
use crate::http_answer::{Refused, unknown};
use crate::jobs::JobsApi;
use crate::maintenance;
use crate::metrics::Metrics;
use crate::operations;
use crate::publish::Mirror;
use crate::room::Room;
use crate::tls::Tls;
use crate::tokens::TokensApi;
use crate::trace;
use crate::webhooks::Receivers;
use crate::workers::WorkersApi;

/// A coordinator that listens.
#[derive(Debug)]
pub struct Running {
    address: SocketAddr,
    scheme: &'static str,
    reload: Arc<Notify>,
    task: JoinHandle<Result<(), ServeError>>,
}

impl Running {
    /// Where it listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Its address as a URL.
    pub fn url(&self) -> String {
        format!("{}://{}", self.scheme, self.address)
    }

    /// What makes it read its certificates again at once; it also does so when they change.
    pub fn reload_certificates(&self) -> impl Fn() + Send + Sync + use<> {
        let reload = self.reload.clone();
        move || reload.notify_one()
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
pub fn serve(
    config: Config,
    shutdown: impl Future<Output = ()> + Send + 'static,
) -> BoxFuture<'static, Result<Running, ServeError>> {
    starting(config, Box::pin(shutdown))
}

/// Not generic, and boxed here: the server is compiled once, and not in every crate that starts one.
#[inline(never)]
fn starting(
    config: Config,
    shutdown: BoxFuture<'static, ()>,
) -> BoxFuture<'static, Result<Running, ServeError>> {
    Box::pin(start(config, shutdown))
}

async fn start(config: Config, shutdown: BoxFuture<'static, ()>) -> Result<Running, ServeError> {
    let doorkeeper = Doorkeeper::new(&config.token_file, &config.limits, config.behind_tls_proxy)?;
    let tls = config.tls.clone().map(Tls::load).transpose();
    let tls = tls
        .map_err(|source| ServeError::Tls { source })?
        .map(Arc::new);
    let scheme = if tls.is_some() { "https" } else { "http" };
    if tls.is_none() && !config.behind_tls_proxy && !config.listen.ip().is_loopback() {
        return Err(ServeError::PlainHttp {
            address: config.listen,
        });
    }
    let receivers = Receivers::new(&config.webhook_internal)?;
    let registry = Registry::open(&config.store)
        .await
        .map_err(|source| ServeError::Registry { source })?;
    let replica = match &config.care.replica {
        None => None,
        Some(replica) => {
            Some(Registry::connect(replica).map_err(|source| ServeError::Registry { source })?)
        }
    };
    let store = ign_queue::open(&config.database, config.settings)
        .await
        .map_err(|source| ServeError::Database { source })?;
    let listen = |source| ServeError::Listen {
        address: config.listen,
        source,
    };
    let listener = TcpListener::bind(config.listen).await.map_err(listen)?;
    let address = listener.local_addr().map_err(listen)?;
    tracing::info!(
        %address,
        scheme,
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
        holders: Holders::default(),
        limits: config.limits,
        metrics: Metrics::default(),
        mirror: Mirror::default(),
        redirect_blobs: config.redirect_blobs,
        room: Room::new(&config),
        receivers,
        replica,
        audit_every: config.care.audit_every,
        stopping: CancellationToken::new(),
    });
    app.rebuild_if_behind()
        .await
        .map_err(|Refused(cause)| ServeError::Rebuild {
            reason: cause.to_string(),
        })?;
    let (health, router) = router(&app).await;
    if let Some(path) = &config.endpoint_file {
        write_endpoint(path, scheme, address, &config.token_file).map_err(|source| {
            ServeError::Endpoint {
                path: path.clone(),
                source,
            }
        })?;
    }
    let reload = Arc::new(Notify::new());
    let asked = reload.clone();
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
        let certificates = tokio::spawn({
            let (app, tls, reload) = (app.clone(), tls.clone(), reload.clone());
            async move {
                if let Some(tls) = tls {
                    tls.follow(&reload, &app.stopping).await;
                }
            }
        });
        let closing = async {
            health.set_not_serving::<JobsServer<JobsApi>>().await;
            health.set_not_serving::<WorkersServer<WorkersApi>>().await;
        };
        Door::new(router, tls, &app.limits, config.behind_tls_proxy)
            .run(listener, &app.stopping, closing)
            .await;
        for task in [maintenance, certificates] {
            task.await.map_err(|source| ServeError::Task { source })?;
        }
        if let Some(path) = &config.endpoint_file
            && let Err(error) = std::fs::remove_file(path)
        {
            tracing::warn!(%error, path = %path.display(), "could not remove the endpoint file");
        }
        tracing::info!("coordinator ended");
        Ok(())
    });
    Ok(Running {
        address,
        scheme,
        reload: asked,
        task,
    })
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
        )
        .add_service(
            AdminServer::new(AdminApi(app.clone())).max_decoding_message_size(MAX_MESSAGE_BYTES),
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
            body::layer,
        ))
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

/// Says where we listen. Readers see the whole file or none: it is written aside and renamed.
fn write_endpoint(
    path: &Path,
    scheme: &str,
    address: SocketAddr,
    token_file: &Path,
) -> std::io::Result<()> {
    let token_file = std::path::absolute(token_file)?;
    let endpoint = serde_json::json!({
        "url": format!("{scheme}://{address}"),
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
