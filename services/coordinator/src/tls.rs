//! TLS from files: the server's certificate, and the authority of the workers' certificates.
//!
//! The files are looked at every [`LOOK`] and on request, and read again when one has changed, so that a renewed
//! certificate needs no restart. Files that cannot be used are reported, and what was there goes on.
//!
//! A client may show a certificate or not. One that the authority did not sign ends the handshake; one that it signed
//! names a worker, by its first DNS name.

use std::path::{Path, PathBuf};
use std::sync::{Arc, PoisonError, RwLock};
use std::time::{Duration, SystemTime};

use ign_client::{Error, certificates, private_key};
use rustls::server::WebPkiClientVerifier;
use rustls::{RootCertStore, ServerConfig, ServerConnection};
use tokio::sync::Notify;
use tokio_rustls::TlsAcceptor;
use tokio_util::sync::CancellationToken;

/// Time between two looks at the files.
const LOOK: Duration = Duration::from_secs(10);

/// Where certificates lie, all in PEM.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TlsFiles {
    /// The server's certificate, and those between it and its authority.
    pub cert: PathBuf,
    /// Its key.
    pub key: PathBuf,
    /// The authority that signs workers' certificates and nothing else.
    pub client_ca: Option<PathBuf>,
}

impl TlsFiles {
    fn paths(&self) -> impl Iterator<Item = &Path> {
        let ca = self.client_ca.as_deref();
        [&self.cert, &self.key]
            .into_iter()
            .map(PathBuf::as_path)
            .chain(ca)
    }

    fn changed_at(&self) -> Vec<Option<SystemTime>> {
        self.paths()
            .map(|path| std::fs::metadata(path).and_then(|it| it.modified()).ok())
            .collect()
    }

    fn load(&self) -> Result<Arc<ServerConfig>, Error> {
        let provider = Arc::new(rustls::crypto::aws_lc_rs::default_provider());
        let builder = ServerConfig::builder_with_provider(provider.clone())
            .with_safe_default_protocol_versions()?;
        let builder = match &self.client_ca {
            None => builder.with_no_client_auth(),
            Some(path) => {
                let mut roots = RootCertStore::empty();
                for der in certificates(path)? {
                    roots.add(der)?;
                }
                let verifier =
                    WebPkiClientVerifier::builder_with_provider(Arc::new(roots), provider)
                        .allow_unauthenticated()
                        .build()
                        .map_err(|error| rustls::Error::General(error.to_string()))?;
                builder.with_client_cert_verifier(verifier)
            }
        };
        let mut config =
            builder.with_single_cert(certificates(&self.cert)?, private_key(&self.key)?)?;
        config.alpn_protocols = vec![b"h2".to_vec(), b"http/1.1".to_vec()];
        Ok(Arc::new(config))
    }
}

/// The certificates as they are now.
#[derive(Debug)]
pub(crate) struct Tls {
    files: TlsFiles,
    current: RwLock<Arc<ServerConfig>>,
}

impl Tls {
    pub(crate) fn load(files: TlsFiles) -> Result<Self, Error> {
        let current = RwLock::new(files.load()?);
        Ok(Self { files, current })
    }

    pub(crate) fn acceptor(&self) -> TlsAcceptor {
        let current = self.current.read().unwrap_or_else(PoisonError::into_inner);
        TlsAcceptor::from(current.clone())
    }

    /// Reads the files again when they change or `asked` says so.
    pub(crate) async fn follow(&self, asked: &Notify, stopping: &CancellationToken) {
        let mut seen = self.files.changed_at();
        loop {
            let mut must = false;
            tokio::select! {
                () = stopping.cancelled() => return,
                () = asked.notified() => must = true,
                () = tokio::time::sleep(LOOK) => {}
            }
            let now = self.files.changed_at();
            if !must && now == seen {
                continue;
            }
            seen = now;
            match self.files.load() {
                Ok(config) => {
                    *self.current.write().unwrap_or_else(PoisonError::into_inner) = config;
                    tracing::info!(cert = %self.files.cert.display(), "certificates were read again");
                }
                Err(error) => {
                    let error = crate::error::chain(&error);
                    tracing::error!(error, "new certificates cannot be used; the old ones stay");
                }
            }
        }
    }
}

/// The name in the client's certificate, where it showed one; the handshake has verified it.
pub(crate) fn client_name(connection: &ServerConnection) -> Option<Arc<str>> {
    let certificate = connection.peer_certificates()?.first()?;
    let parsed = webpki::EndEntityCert::try_from(certificate).ok()?;
    parsed.valid_dns_names().next().map(Arc::from)
}
