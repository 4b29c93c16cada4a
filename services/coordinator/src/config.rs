//! What a coordinator needs to know, and why it may not start.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::Duration;

use ign_queue::{Settings, StoreError};
use ign_registry::{RegistryError, StoreConfig};

use crate::limits::Limits;
use crate::tls::TlsFiles;

/// Settings of one coordinator.
#[derive(Clone, Debug)]
pub struct Config {
    /// Where to listen; port 0 takes a free one.
    pub listen: SocketAddr,
    /// `sqlite:///path` or `postgres://...`.
    pub database: String,
    /// Where blobs, manifests and versions lie.
    pub store: StoreConfig,
    /// File that holds the root token: all scopes, everywhere.
    pub token_file: PathBuf,
    /// Where to write `{"url","pid","token_file"}` once listening; removed at the end.
    pub endpoint_file: Option<PathBuf>,
    /// Lease, back-off and polling times.
    pub settings: Settings,
    /// Answer blob reads with a redirect to a signed URL where the store can sign. Clients must be able to reach the
    /// store under the same address.
    pub redirect_blobs: bool,
    /// Certificates; none for plain HTTP, which is for this machine alone unless [`Config::behind_tls_proxy`].
    pub tls: Option<TlsFiles>,
    /// A proxy in front speaks TLS with clients and says in `X-Forwarded-For` who they are.
    pub behind_tls_proxy: bool,
    /// What a peer may cost.
    pub limits: Limits,
    /// What keeps the store sound.
    pub care: Care,
    /// Receivers of webhooks, `host:port`, that may be private and plain HTTP; all others take HTTPS and a public address.
    pub webhook_internal: Vec<String>,
}

/// What keeps the store sound over the years.
#[derive(Clone, Debug)]
pub struct Care {
    /// New work is refused while the disk of a local store or database has fewer free bytes than this; results of what
    /// runs may use half of it.
    pub reserve_bytes: u64,
    /// Every digest is read again once in this time; none: only on request.
    pub audit_every: Option<Duration>,
    /// Another registry with the same content, from which damage is repaired. It is only read.
    pub replica: Option<StoreConfig>,
}

impl Default for Care {
    fn default() -> Self {
        Self {
            reserve_bytes: 512 * 1024 * 1024,
            audit_every: Some(Duration::from_hours(30 * 24)),
            replica: None,
        }
    }
}

/// Why a coordinator did not start or had to end.
#[derive(Debug, thiserror::Error)]
pub enum ServeError {
    /// The token file is absent or unusable.
    #[error("token file {}: {reason}", path.display())]
    Token {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// Tokens would cross a network for all to read.
    #[error(
        "{address} is beyond this machine and would be served without TLS; give --tls-cert and --tls-key, or say \
         --behind-tls-proxy if a proxy speaks TLS in front"
    )]
    PlainHttp {
        /// As configured.
        address: SocketAddr,
    },
    /// The certificates are absent or unusable.
    #[error("cannot use the certificates")]
    Tls {
        /// What is wrong.
        #[source]
        source: ign_client::Error,
    },
    /// The address cannot be listened on.
    #[error("cannot listen on {address}")]
    Listen {
        /// As configured.
        address: SocketAddr,
        /// What the system said.
        #[source]
        source: std::io::Error,
    },
    /// The database cannot be opened.
    #[error("cannot open the database")]
    Database {
        /// What it said.
        #[source]
        source: StoreError,
    },
    /// The object store cannot be opened, written and read.
    #[error("cannot open the object store")]
    Registry {
        /// What it said.
        #[source]
        source: RegistryError,
    },
    /// The bucket records versions that the database does not know, and they cannot be taken over.
    #[error("cannot rebuild the registry: {reason}")]
    Rebuild {
        /// What went wrong; the log has the story.
        reason: String,
    },
    /// No HTTP client for webhooks.
    #[error("cannot prepare to send webhooks")]
    Webhooks {
        /// What is wrong.
        #[source]
        source: reqwest::Error,
    },
    /// The endpoint file cannot be written.
    #[error("cannot write {}", path.display())]
    Endpoint {
        /// The file.
        path: PathBuf,
        /// What the system said.
        #[source]
        source: std::io::Error,
    },
    /// A task of the coordinator panicked.
    #[error("a task of the coordinator stopped")]
    Task {
        /// Which way.
        #[source]
        source: tokio::task::JoinError,
    },
}
