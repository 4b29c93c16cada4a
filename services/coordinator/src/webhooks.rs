//! Sending what is in the outbox: signed, to receivers that may be reached, at least once.
//!
//! The form is Standard Webhooks': `webhook-id` (the same at every try), `webhook-timestamp` (Unix seconds of this try),
//! `webhook-signature: v1,BASE64(HMAC-SHA256(secret, "ID.TIMESTAMP.BODY"))`.
//!
//! A success is sent only after every file of the bundle was found in the store; otherwise it is tried again later.
//!
//! **Closed by default.** A receiver takes `https` and has a public address; the name is resolved for each try and the
//! connection goes to the addresses that were looked at. Receivers inside are those alone that the coordinator's
//! operator names (`host:port`); they may be private and plain `http`. Redirects are not followed, proxies of the
//! environment are not used, and of an answer nothing but the status is read.

use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr};
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use base64::Engine as _;
use base64::prelude::BASE64_STANDARD;
use chrono::Utc;
use futures::stream::{self, StreamExt as _};
use hmac::{Hmac, KeyInit as _, Mac as _};
use ign_queue::{Dispatch, Secret, Tried};
use reqwest::dns::{Addrs, Name, Resolve, Resolving};
use reqwest::{Client, StatusCode, Url};
use sha2::Sha256;
use tokio::time::MissedTickBehavior;

use crate::app::App;
use crate::config::ServeError;
use crate::http_answer::Refused;

const TICK: Duration = Duration::from_secs(1);
/// Sent at once.
const BATCH: u32 = 16;
/// For name, connection, TLS and the answer's status.
const SEND_LIMIT: Duration = Duration::from_secs(10);
/// A claimed delivery is everybody's again after this time: looking for files and sending end before.
const HOLD: Duration = Duration::from_secs(20);

/// Who may be sent to, and how.
#[derive(Debug)]
pub(crate) struct Receivers {
    public: Client,
    internal: Client,
    /// `host:port`.
    allowed: Vec<String>,
}

impl Receivers {
    pub(crate) fn new(allowed: &[String]) -> Result<Self, ServeError> {
        let client = || {
            Client::builder()
                .redirect(reqwest::redirect::Policy::none())
                .no_proxy()
                .timeout(SEND_LIMIT)
                .pool_max_idle_per_host(0)
                .user_agent(concat!("ign/", env!("CARGO_PKG_VERSION")))
        };
        let failed = |source| ServeError::Webhooks { source };
        Ok(Self {
            public: client()
                .https_only(true)
                .dns_resolver(Arc::new(PublicOnly))
                .build()
                .map_err(failed)?,
            internal: client().build().map_err(failed)?,
            allowed: allowed.iter().map(|it| it.to_ascii_lowercase()).collect(),
        })
    }

    /// The URL and the client that may go there; otherwise why nobody may.
    pub(crate) fn check(&self, url: &str) -> Result<(Url, &Client), String> {
        let url = Url::parse(url).map_err(|error| format!("no URL: {error}"))?;
        let host = url.host_str().unwrap_or_default();
        let port = url.port_or_known_default().unwrap_or_default();
        if !url.username().is_empty() || url.password().is_some() {
            return Err("a URL with a password in it would show in listings".to_owned());
        }
        if !matches!(url.scheme(), "http" | "https") {
            return Err(format!("{} is not https", url.scheme()));
        }
        if self.allowed.contains(&format!("{host}:{port}")) {
            return Ok((url, &self.internal));
        }
        if url.scheme() != "https" {
            return Err(format!(
                "must be https, or {host}:{port} one of the coordinator's --webhook-internal"
            ));
        }
        let literal = host.trim_matches(['[', ']']).parse::<IpAddr>();
        if literal.is_ok_and(|address| !is_public(address)) {
            return Err(format!(
                "{host} is not a public address; name {host}:{port} in the coordinator's --webhook-internal"
            ));
        }
        Ok((url, &self.public))
    }
}

/// Resolves names to public addresses alone.
struct PublicOnly;

impl Resolve for PublicOnly {
    fn resolve(&self, name: Name) -> Resolving {
        Box::pin(async move {
            let found = tokio::net::lookup_host((name.as_str(), 0)).await?;
            let public: Vec<SocketAddr> = found.filter(|it| is_public(it.ip())).collect();
            if public.is_empty() {
                return Err(format!("{} has no public address", name.as_str()).into());
            }
            Ok(Box::new(public.into_iter()) as Addrs)
        })
    }
}

/// Whether an address is somebody's on the public internet (IANA's special-purpose registries).
fn is_public(address: IpAddr) -> bool {
    let within4 = |address: Ipv4Addr, network: [u8; 4], bits: u32| {
        let mask = u32::MAX << (32 - bits);
        address.to_bits() & mask == Ipv4Addr::from(network).to_bits() & mask
    };
    let within6 = |address: Ipv6Addr, network: u128, bits: u32| {
        (address.to_bits() ^ network) >> (128 - bits) == 0
    };
    match address.to_canonical() {
        IpAddr::V4(v4) => ![
            ([0, 0, 0, 0], 8),
            ([10, 0, 0, 0], 8),
            ([100, 64, 0, 0], 10),
            ([127, 0, 0, 0], 8),
            ([169, 254, 0, 0], 16),
            ([172, 16, 0, 0], 12),
            ([192, 0, 0, 0], 24),
            ([192, 0, 2, 0], 24),
            ([192, 88, 99, 0], 24),
            ([192, 168, 0, 0], 16),
            ([198, 18, 0, 0], 15),
            ([198, 51, 100, 0], 24),
            ([203, 0, 113, 0], 24),
            // Multicast, reserved, broadcast.
            ([224, 0, 0, 0], 3),
        ]
        .into_iter()
        .any(|(network, bits)| within4(v4, network, bits)),
        IpAddr::V6(v6) => {
            // Global unicast, less protocol assignments (Teredo), documentation and 6to4.
            within6(v6, 0x2000 << 112, 3)
                && !within6(v6, 0x2001 << 112, 23)
                && !within6(v6, 0x2001_0db8 << 96, 32)
                && !within6(v6, 0x2002 << 112, 16)
                && !within6(v6, 0x3fff << 112, 20)
        }
    }
}

/// `v1,BASE64`: what proves that the body comes from whoever has the secret.
fn signature(secret: &Secret, id: &str, timestamp: i64, body: &str) -> Option<String> {
    let mut mac = Hmac::<Sha256>::new_from_slice(&secret.0).ok()?;
    mac.update(format!("{id}.{timestamp}.{body}").as_bytes());
    let signed = BASE64_STANDARD.encode(mac.finalize().into_bytes());
    Some(format!("v1,{signed}"))
}

/// Sends what is due, until the coordinator stops.
pub(crate) async fn run(app: &App) {
    let mut tick = tokio::time::interval(TICK);
    tick.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        tick.tick().await;
        match app.store.claim_deliveries(BATCH, HOLD).await {
            Ok(claimed) => {
                stream::iter(claimed)
                    .for_each_concurrent(None, |dispatch| app.deliver(dispatch))
                    .await;
            }
            // Logged by the conversion; the next tick tries again.
            Err(error) => drop(Refused::from(error)),
        }
    }
}

impl App {
    async fn deliver(&self, dispatch: Dispatch) {
        let delivery = &dispatch.delivery;
        let tried = match tokio::time::timeout(HOLD / 2, self.fetchable(&dispatch)).await {
            Ok(Ok(())) => self.send(&dispatch).await,
            Ok(Err(Refused(cause))) => {
                Tried::Failed(format!("the bundle cannot be fetched yet: {cause}"))
            }
            Err(_elapsed) => Tried::Failed("the store did not answer in time".to_owned()),
        };
        match &tried {
            Tried::Delivered => {
                self.metrics
                    .webhooks_delivered
                    .fetch_add(1, Ordering::Relaxed);
                tracing::info!(delivery.id, delivery.event, collection = %delivery.collection, job.id = %delivery.job, "webhook delivered");
            }
            Tried::Failed(why) | Tried::Refused(why) => {
                self.metrics.webhooks_failed.fetch_add(1, Ordering::Relaxed);
                tracing::warn!(delivery.id, delivery.event, collection = %delivery.collection, tries = delivery.tries, error = why, "webhook not delivered");
            }
        }
        let recorded = self
            .store
            .delivery_tried(&delivery.id, delivery.tries, tried)
            .await;
        if let Err(error) = recorded {
            // Logged by the conversion; it is sent again, which receivers know by its id.
            drop(Refused::from(error));
        }
    }

    /// Whether every file of the bundle that a delivery tells of can be had.
    async fn fetchable(&self, dispatch: &Dispatch) -> Result<(), Refused> {
        let job = self.store.get(dispatch.delivery.job).await?;
        // A job that was retried since has no version; neither has the event.
        let Some(version) = job.version else {
            return Ok(());
        };
        let reference = format!("v{version}");
        let version = self.store.version(&job.spec.object, &reference).await?;
        self.check_files(&version).await
    }

    async fn send(&self, dispatch: &Dispatch) -> Tried {
        let (url, client) = match self.receivers.check(&dispatch.url) {
            Ok(found) => found,
            Err(why) => return Tried::Refused(why),
        };
        let (id, body) = (&dispatch.delivery.id, &dispatch.body);
        let timestamp = Utc::now().timestamp();
        let Some(signature) = signature(&dispatch.secret, id, timestamp, body) else {
            return Tried::Refused("the secret cannot sign".to_owned());
        };
        let answer = client
            .post(url)
            .header("content-type", "application/json")
            .header("webhook-id", id)
            .header("webhook-timestamp", timestamp.to_string())
            .header("webhook-signature", signature)
            .body(body.clone())
            .send()
            .await;
        match answer {
            Ok(answer) if answer.status().is_success() => Tried::Delivered,
            Ok(answer) if answer.status() == StatusCode::GONE => {
                Tried::Refused("410 Gone: the receiver wants no more".to_owned())
            }
            Ok(answer) if answer.status().is_redirection() => {
                Tried::Failed(format!("{}: redirects are not followed", answer.status()))
            }
            Ok(answer) => Tried::Failed(answer.status().to_string()),
            // Without the URL, which may hold what is nobody else's business.
            Err(error) => Tried::Failed(crate::error::chain(&error.without_url())),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_signature_is_that_of_the_standard() {
        // The example of the Standard Webhooks specification.
        let secret = BASE64_STANDARD
            .decode("MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw")
            .unwrap();
        let signed = signature(
            &Secret(secret),
            "msg_p5jXN8AQM9LWM0D4loKWxJek",
            1_614_265_330,
            r#"{"test": 2432232314}"#,
        );
        assert_eq!(
            signed.unwrap(),
            "v1,g0hM9SsE+OTPJTGt/tmIKtSyZlE3uFJELVlNIOLJ1OE="
        );
    }

    #[test]
    fn only_public_addresses_are_public() {
        for public in ["8.8.8.8", "172.32.0.1", "2606:4700::1111", "::ffff:8.8.8.8"] {
            assert!(is_public(public.parse().unwrap()), "{public}");
        }
        for inside in [
            "0.0.0.0",
            "10.1.2.3",
            "100.64.0.1",
            "127.0.0.1",
            "169.254.169.254",
            "172.31.255.255",
            "192.168.1.1",
            "198.19.0.1",
            "203.0.113.5",
            "224.0.0.1",
            "255.255.255.255",
            "::",
            "::1",
            "::ffff:10.0.0.1",
            "64:ff9b::a00:1",
            "2001::1",
            "2001:db8::1",
            "2002:a00:1::",
            "fc00::1",
            "fe80::1",
            "ff02::1",
        ] {
            assert!(!is_public(inside.parse().unwrap()), "{inside}");
        }
    }

    #[tokio::test]
    async fn receivers_inside_are_closed_unless_they_are_named() {
        let receivers = Receivers::new(&["archive.museum:8080".to_owned()]).unwrap();
        for open in [
            "https://archive.example/hook",
            "https://8.8.8.8/hook",
            "http://archive.museum:8080/hook",
            "https://Archive.Museum:8080/hook",
        ] {
            assert!(receivers.check(open).is_ok(), "{open}");
        }
        for closed in [
            "archive.example",
            "ftp://archive.example",
            "http://archive.example/hook",
            "http://archive.museum/hook",
            "https://user:secret@archive.example/",
            "https://127.0.0.1/",
            "https://2130706433/",
            "https://0x7f.1/",
            "https://[::1]/",
            "https://[::ffff:10.0.0.1]/",
            "https://169.254.169.254/latest/meta-data",
        ] {
            assert!(receivers.check(closed).is_err(), "{closed}");
        }
        // A name is looked at when it is resolved, each time.
        let (url, client) = receivers.check("https://localhost/").unwrap();
        let error = client.get(url).send().await.unwrap_err();
        let error = crate::error::chain(&error);
        assert!(error.contains("no public address"), "{error}");
    }
}
