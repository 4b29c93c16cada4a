//! TLS with certificates made for the test: who is let in, who is not, and what a renewed certificate takes.

use std::path::{Path, PathBuf};
use std::time::Duration;

use ign_client::{Files, Tls};
use ign_coordinator::{Config, ServeError, TlsFiles, serve};
use ign_proto::v1;
use ign_proto::v1::jobs_client::JobsClient;
use ign_proto::v1::workers_client::WorkersClient;
use rcgen::{BasicConstraints, CertificateParams, IsCa, Issuer, KeyPair};
use reqwest::{Method, StatusCode};
use tonic::Code;
use tonic::transport::{Channel, Endpoint};

use crate::fixture::{Service, TOKEN};

/// An authority, and the file with its certificate.
struct Authority {
    issuer: Issuer<'static, KeyPair>,
    file: PathBuf,
}

impl Authority {
    fn new(folder: &Path, name: &str) -> Self {
        let mut params = CertificateParams::default();
        params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        params
            .distinguished_name
            .push(rcgen::DnType::CommonName, name);
        let key = KeyPair::generate().unwrap();
        let file = folder.join(format!("{name}.pem"));
        std::fs::write(&file, params.self_signed(&key).unwrap().pem()).unwrap();
        Self {
            issuer: Issuer::new(params, key),
            file,
        }
    }

    /// A certificate for `name` and its key, in files beside each other.
    fn sign(&self, folder: &Path, file: &str, name: &str) -> (PathBuf, PathBuf) {
        let key = KeyPair::generate().unwrap();
        let params = CertificateParams::new([name.to_owned(), "127.0.0.1".to_owned()]).unwrap();
        let cert = params.signed_by(&key, &self.issuer).unwrap();
        let at = |kind: &str| folder.join(format!("{file}.{kind}"));
        std::fs::write(at("cert"), cert.pem()).unwrap();
        std::fs::write(at("key"), key.serialize_pem()).unwrap();
        (at("cert"), at("key"))
    }
}

/// A coordinator with TLS, and what its clients hold.
struct Secure {
    service: Service,
    servers: Authority,
    workers: Authority,
    folder: tempfile::TempDir,
}

impl Secure {
    async fn start() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let servers = Authority::new(folder.path(), "servers");
        let workers = Authority::new(folder.path(), "workers");
        let (cert, key) = servers.sign(folder.path(), "server", "localhost");
        let files = TlsFiles {
            cert,
            key,
            client_ca: Some(workers.file.clone()),
        };
        let service = Service::with(|config| config.tls = Some(files)).await;
        Self {
            service,
            servers,
            workers,
            folder,
        }
    }

    fn client(&self, identity: Option<(PathBuf, PathBuf)>) -> Tls {
        Tls::load(&Files {
            ca: Some(self.servers.file.clone()),
            identity,
        })
        .unwrap()
    }

    fn channel(&self, tls: &Tls) -> Channel {
        tls.channel(&Endpoint::from_shared(self.service.url.clone()).unwrap())
    }

    async fn healthz(&self, tls: &Tls) -> Result<StatusCode, reqwest::Error> {
        let http = tls.http(reqwest::Client::builder()).build().unwrap();
        let answer = http
            .get(format!("{}/healthz", self.service.url))
            .send()
            .await;
        answer.map(|answer| answer.status())
    }
}

fn lease() -> v1::LeaseRequest {
    v1::LeaseRequest {
        worker_id: "w".to_owned(),
        ..v1::LeaseRequest::default()
    }
}

fn with_token<T>(message: T, token: &str) -> tonic::Request<T> {
    let mut request = tonic::Request::new(message);
    let value = format!("Bearer {token}").parse().unwrap();
    request.metadata_mut().insert("authorization", value);
    request
}

#[tokio::test]
async fn clients_that_trust_the_authority_are_served_and_others_turn_away() {
    let secure = Secure::start().await;
    assert!(secure.service.url.starts_with("https://"));
    let tls = secure.client(None);
    assert_eq!(secure.healthz(&tls).await.unwrap(), StatusCode::OK);
    let mut jobs = JobsClient::new(secure.channel(&tls));
    jobs.status(with_token(v1::StatusRequest::default(), TOKEN))
        .await
        .unwrap();

    // The machine's own authorities did not sign it; plain HTTP is not spoken.
    assert!(
        secure
            .healthz(&Tls::load(&Files::default()).unwrap())
            .await
            .is_err()
    );
    let stranger = JobsClient::new(secure.channel(&Tls::load(&Files::default()).unwrap()))
        .status(with_token(v1::StatusRequest::default(), TOKEN))
        .await
        .unwrap_err();
    assert_eq!(stranger.code(), Code::Unavailable);
    let plain = secure.service.url.replace("https", "http");
    let answer = secure
        .service
        .http
        .get(format!("{plain}/healthz"))
        .send()
        .await;
    assert!(answer.is_err());
}

#[tokio::test]
async fn a_certificate_makes_a_worker_and_nothing_more() {
    let secure = Secure::start().await;
    let identity = secure
        .workers
        .sign(secure.folder.path(), "worker", "worker-1.museum.example");
    let worker = secure.client(Some(identity));
    let channel = secure.channel(&worker);
    let leased = WorkersClient::new(channel.clone())
        .lease(lease())
        .await
        .unwrap();
    assert_eq!(leased.into_inner().lease, None);
    let refused = JobsClient::new(channel.clone())
        .status(v1::StatusRequest::default())
        .await
        .unwrap_err();
    assert_eq!(refused.code(), Code::PermissionDenied);
    // A token that is shown counts, good or bad.
    let mut jobs = JobsClient::new(channel);
    jobs.status(with_token(v1::StatusRequest::default(), TOKEN))
        .await
        .unwrap();
    let refused = jobs
        .status(with_token(v1::StatusRequest::default(), "wrong"))
        .await
        .unwrap_err();
    assert_eq!(refused.code(), Code::Unauthenticated);

    // Without a certificate nobody; with one of another authority no connection at all.
    let nobody = secure.channel(&secure.client(None));
    let refused = WorkersClient::new(nobody).lease(lease()).await.unwrap_err();
    assert_eq!(refused.code(), Code::Unauthenticated);
    let foreign = secure
        .servers
        .sign(secure.folder.path(), "foreign", "worker-1.museum.example");
    let foreign = secure.client(Some(foreign));
    assert!(secure.healthz(&foreign).await.is_err());
    let refused = WorkersClient::new(secure.channel(&foreign))
        .lease(lease())
        .await
        .unwrap_err();
    // The refusal comes after the client's own handshake has ended: as a broken connection.
    assert!(
        matches!(refused.code(), Code::Unavailable | Code::Unknown),
        "{refused}"
    );
}

#[tokio::test]
async fn renewed_certificates_are_taken_up_and_broken_ones_are_not() {
    let secure = Secure::start().await;
    let (cert, _) = secure
        .servers
        .sign(secure.folder.path(), "other", "localhost");
    // A certificate that does not fit its key: the old pair stays.
    std::fs::copy(&cert, secure.folder.path().join("server.cert")).unwrap();
    secure.service.reload_certificates();
    tokio::time::sleep(Duration::from_millis(300)).await;
    assert_eq!(
        secure.healthz(&secure.client(None)).await.unwrap(),
        StatusCode::OK
    );

    let next = Authority::new(secure.folder.path(), "next");
    next.sign(secure.folder.path(), "server", "localhost");
    secure.service.reload_certificates();
    let trusting = Tls::load(&Files {
        ca: Some(next.file.clone()),
        identity: None,
    })
    .unwrap();
    for _ in 0..100 {
        if secure.healthz(&trusting).await.is_ok() {
            break;
        }
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
    assert_eq!(secure.healthz(&trusting).await.unwrap(), StatusCode::OK);
    assert!(secure.healthz(&secure.client(None)).await.is_err());
}

#[tokio::test]
async fn nothing_is_served_in_plain_text_beyond_this_machine() {
    let mut service = Service::start().await;
    service.stop().await;
    let beyond = |config: &mut Config| config.listen = "0.0.0.0:0".parse().unwrap();
    let config = service.config(beyond);
    let refused = serve(config.clone(), std::future::pending())
        .await
        .unwrap_err();
    assert!(matches!(refused, ServeError::PlainHttp { .. }), "{refused}");
    assert!(
        refused.to_string().contains("--behind-tls-proxy"),
        "{refused}"
    );

    // Behind a proxy it is; who asks for metrics is then who the proxy says.
    let behind = Service::with(|config| {
        config.listen = "0.0.0.0:0".parse().unwrap();
        config.behind_tls_proxy = true;
    })
    .await;
    let url = behind.url.replace("0.0.0.0", "127.0.0.1");
    for (forwarded, status) in [
        ("203.0.113.9", StatusCode::UNAUTHORIZED),
        ("127.0.0.1, 203.0.113.9", StatusCode::UNAUTHORIZED),
    ] {
        let request = behind
            .http
            .request(Method::GET, format!("{url}/metrics"))
            .header("x-forwarded-for", forwarded);
        assert_eq!(
            request.send().await.unwrap().status(),
            status,
            "{forwarded}"
        );
    }
    let direct = behind
        .http
        .get(format!("{url}/metrics"))
        .send()
        .await
        .unwrap();
    assert_eq!(direct.status(), StatusCode::UNAUTHORIZED);
}

#[test]
fn unusable_certificates_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let authority = Authority::new(folder.path(), "servers");
    let (cert, key) = authority.sign(folder.path(), "a", "a");
    let (_, other) = authority.sign(folder.path(), "b", "b");
    let with = |ca: Option<&Path>, identity| {
        Tls::load(&Files {
            ca: ca.map(Path::to_owned),
            identity,
        })
    };
    assert!(with(Some(&authority.file), Some((cert.clone(), key.clone()))).is_ok());
    assert!(with(Some(&key), None).is_err());
    assert!(with(Some(&folder.path().join("absent")), None).is_err());
    assert!(with(None, Some((cert, other))).is_err());
}
