//! Certificates for connections to a coordinator, gRPC and HTTP alike.
//!
//! An `https://` address is spoken to over TLS (rustls, HTTP/2 for gRPC), an `http://` one is not. The server's
//! certificate is checked against the given authority, or against the machine's own where none is given. HTTP also
//! trusts the machine's authorities, because blob reads may be redirected to an object store that has another
//! certificate; gRPC is never redirected.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use hyper_util::client::legacy::connect::HttpConnector;
use rustls::{ClientConfig, RootCertStore};
use rustls_pki_types::pem::PemObject as _;
use rustls_pki_types::{CertificateDer, PrivateKeyDer};
use rustls_platform_verifier::BuilderVerifierExt as _;
use tonic::transport::{Channel, Endpoint};

/// Files with certificates, all in PEM.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Files {
    /// Authorities that may sign the server's certificate; none for those of the machine.
    pub ca: Option<PathBuf>,
    /// Certificate and key by which this client identifies itself.
    pub identity: Option<(PathBuf, PathBuf)>,
}

/// Why certificates are of no use.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A file is absent, or holds no PEM of the right kind.
    #[error("cannot read {} as PEM", path.display())]
    Pem {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        #[source]
        source: rustls_pki_types::pem::Error,
    },
    /// A file holds nothing that is looked for.
    #[error("{} holds no certificate", path.display())]
    Empty {
        /// The file.
        path: PathBuf,
    },
    /// Certificates that rustls does not take.
    #[error("the certificates cannot be used")]
    Tls {
        /// What is wrong.
        #[from]
        source: rustls::Error,
    },
    /// Certificates that the HTTP client does not take.
    #[error("the certificates cannot be used for HTTP")]
    Http {
        /// What is wrong.
        #[from]
        source: reqwest::Error,
    },
    /// The file of the key or of the certificate.
    #[error("cannot read {}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system said.
        #[source]
        source: std::io::Error,
    },
}

/// Certificates that were read and checked.
#[derive(Clone, Debug)]
pub struct Tls {
    grpc: ClientConfig,
    authorities: Vec<reqwest::Certificate>,
    identity: Option<reqwest::Identity>,
}

impl Tls {
    /// Reads the files.
    ///
    /// # Errors
    /// A file is absent, is no PEM, holds no certificate, or key and certificate do not fit.
    pub fn load(files: &Files) -> Result<Self, Error> {
        let provider = Arc::new(rustls::crypto::aws_lc_rs::default_provider());
        let builder =
            ClientConfig::builder_with_provider(provider).with_safe_default_protocol_versions()?;
        let mut authorities = Vec::new();
        let builder = match &files.ca {
            None => builder.with_platform_verifier()?,
            Some(path) => {
                let mut roots = RootCertStore::empty();
                for der in certificates(path)? {
                    authorities.push(reqwest::Certificate::from_der(&der)?);
                    roots.add(der)?;
                }
                builder.with_root_certificates(roots)
            }
        };
        let (grpc, identity) = match &files.identity {
            None => (builder.with_no_client_auth(), None),
            Some((cert, key)) => {
                let config =
                    builder.with_client_auth_cert(certificates(cert)?, private_key(key)?)?;
                let mut pem = read(cert)?;
                pem.push(b'\n');
                pem.extend(read(key)?);
                (config, Some(reqwest::Identity::from_pem(&pem)?))
            }
        };
        Ok(Self {
            grpc,
            authorities,
            identity,
        })
    }

    /// A gRPC channel that connects when it is first used. Of the endpoint's settings, those of TCP have no effect.
    pub fn channel(&self, endpoint: &Endpoint) -> Channel {
        let mut tcp = HttpConnector::new();
        tcp.enforce_http(false);
        tcp.set_nodelay(true);
        let connector = hyper_rustls::HttpsConnectorBuilder::new()
            .with_tls_config(self.grpc.clone())
            .https_or_http()
            .enable_http2()
            .wrap_connector(tcp);
        endpoint.connect_with_connector_lazy(connector)
    }

    /// Gives an HTTP client the same certificates.
    pub fn http(&self, builder: reqwest::ClientBuilder) -> reqwest::ClientBuilder {
        let builder = builder.tls_certs_merge(self.authorities.clone());
        match &self.identity {
            Some(identity) => builder.identity(identity.clone()),
            None => builder,
        }
    }
}

/// All certificates of a PEM file; at least one.
///
/// # Errors
/// The file is absent, is no PEM, or holds none.
pub fn certificates(path: &Path) -> Result<Vec<CertificateDer<'static>>, Error> {
    let wrong = |source| Error::Pem {
        path: path.to_owned(),
        source,
    };
    let found: Vec<_> = CertificateDer::pem_file_iter(path)
        .map_err(wrong)?
        .collect::<Result<_, _>>()
        .map_err(wrong)?;
    if found.is_empty() {
        return Err(Error::Empty {
            path: path.to_owned(),
        });
    }
    Ok(found)
}

/// The private key of a PEM file.
///
/// # Errors
/// The file is absent, is no PEM, or holds none.
pub fn private_key(path: &Path) -> Result<PrivateKeyDer<'static>, Error> {
    PrivateKeyDer::from_pem_file(path).map_err(|source| Error::Pem {
        path: path.to_owned(),
        source,
    })
}

fn read(path: &Path) -> Result<Vec<u8>, Error> {
    std::fs::read(path).map_err(|source| Error::Read {
        path: path.to_owned(),
        source,
    })
}
