//! Who asks: a bearer token, or a worker's certificate; and whether the table of [`crate::access`] lets them.
//!
//! Closed by default: the layer lies around the whole router. Three kinds of caller:
//!
//! - the **root token** of the token file: everything, everywhere. It needs no database.
//! - a **token** of the database ([`crate::token`]), found by its public id, its secret compared by hash. Who was let in
//!   is remembered for [`TOKEN_KNOWN_FOR`]; a revocation here forgets at once.
//! - a **client certificate** that the authority for workers signed, where no token is shown: scope `publish` everywhere.
//!
//! Secrets are compared in the same time wherever they differ. An address that showed too many wrong tokens waits; whoever
//! shows a token that is known meanwhile goes on.

use std::collections::HashMap;
use std::net::{IpAddr, Ipv6Addr, SocketAddr};
use std::os::unix::fs::MetadataExt as _;
use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Instant;

use axum::extract::{MatchedPath, Request, State};
use axum::http::header::{AUTHORIZATION, WWW_AUTHENTICATE};
use axum::http::{Extensions, HeaderMap, HeaderValue, StatusCode};
use axum::middleware::Next;
use axum::response::{IntoResponse as _, Response};
use ign_proto::{Cause, CollectionId, Grant, Scope};
use ign_queue::{SecretHash, TokenKey};
use subtle::ConstantTimeEq as _;

use crate::access::{Caller, Found, Need, need};
use crate::app::App;
use crate::config::ServeError;
use crate::http_answer::{Refused, is_grpc, oci_error, unknown};
use crate::limits::{Limits, TOKEN_KNOWN_FOR};
use crate::throttle::Throttle;
use crate::token;

const MIN_TOKEN_BYTES: usize = 16;
/// Callers remembered at once; more and all are looked up again.
const MAX_KNOWN: usize = 10_000;
const FORWARDED_FOR: &str = "x-forwarded-for";

/// The other side of the connection.
#[derive(Clone, Debug)]
pub(crate) struct Peer {
    pub(crate) address: SocketAddr,
    /// Name in the client certificate that the TLS handshake verified.
    pub(crate) certificate: Option<Arc<str>>,
}

/// Who may come in.
pub(crate) struct Doorkeeper {
    root: SecretHash,
    root_caller: Arc<Caller>,
    /// By the hash of what they show.
    known: Mutex<HashMap<SecretHash, Known>>,
    failures: Throttle<IpAddr>,
    requests: Throttle<String>,
    behind_proxy: bool,
}

#[derive(Clone)]
struct Known {
    caller: Arc<Caller>,
    until: Instant,
}

impl Doorkeeper {
    /// Reads the root token's file: one line. Only its hash is kept.
    pub(crate) fn new(
        path: &Path,
        limits: &Limits,
        behind_proxy: bool,
    ) -> Result<Self, ServeError> {
        let wrong = |reason: String| ServeError::Token {
            path: path.to_owned(),
            reason,
        };
        let text = std::fs::read_to_string(path).map_err(|error| wrong(error.to_string()))?;
        let mode = std::fs::metadata(path)
            .map_err(|error| wrong(error.to_string()))?
            .mode();
        if mode & 0o077 != 0 {
            tracing::warn!(path = %path.display(), "other users of this machine may read the token file");
        }
        let root = text.trim();
        if root.len() < MIN_TOKEN_BYTES || !root.bytes().all(|b| b.is_ascii_graphic()) {
            return Err(wrong(format!(
                "expected one line of at least {MIN_TOKEN_BYTES} printable characters"
            )));
        }
        Ok(Self {
            root: token::hash(root),
            root_caller: Arc::new(Caller::new("root", vec![Grant::everywhere(Scope::Admin)])),
            known: Mutex::default(),
            failures: Throttle::new(limits.failures),
            requests: Throttle::new(limits.requests),
            behind_proxy,
        })
    }

    fn known(&self) -> MutexGuard<'_, HashMap<SecretHash, Known>> {
        self.known.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Looks everybody up again: a token was revoked or rotated.
    pub(crate) fn forget(&self) {
        self.known().clear();
    }

    fn remembered(&self, shown: &SecretHash, now: Instant) -> Option<Arc<Caller>> {
        let mut known = self.known();
        let found = known.get(shown)?;
        if now < found.until {
            return Some(found.caller.clone());
        }
        known.remove(shown);
        None
    }

    fn remember(&self, shown: SecretHash, caller: &Arc<Caller>, until: Instant) {
        let mut known = self.known();
        if known.len() >= MAX_KNOWN {
            known.clear();
        }
        let caller = caller.clone();
        known.insert(shown, Known { caller, until });
    }

    /// The address to hold responsible; none when the proxy does not say.
    fn address(&self, peer: Option<&Peer>, headers: &HeaderMap) -> Option<IpAddr> {
        if !self.behind_proxy {
            return peer.map(|peer| peer.address.ip());
        }
        // The last one is what the proxy itself saw; those before it are the client's own words.
        let forwarded = headers.get_all(FORWARDED_FOR).iter().next_back()?;
        let last = forwarded.to_str().ok()?.rsplit(',').next()?;
        last.trim().parse().ok()
    }
}

fn same(a: &SecretHash, b: &SecretHash) -> bool {
    a.ct_eq(b).into()
}

fn bearer(headers: &HeaderMap) -> Option<&str> {
    let (scheme, token) = headers.get(AUTHORIZATION)?.to_str().ok()?.split_once(' ')?;
    let token = token.trim();
    (scheme.eq_ignore_ascii_case("bearer") && !token.is_empty()).then_some(token)
}

/// Hosts share a network of IPv6; its addresses are nobody's in particular.
fn network(address: IpAddr) -> IpAddr {
    match address.to_canonical() {
        IpAddr::V6(v6) => IpAddr::V6(Ipv6Addr::from_bits(v6.to_bits() & !(u128::MAX >> 64))),
        v4 @ IpAddr::V4(_) => v4,
    }
}

impl App {
    async fn authenticate(
        &self,
        peer: Option<&Peer>,
        address: Option<IpAddr>,
        headers: &HeaderMap,
    ) -> Result<Arc<Caller>, Refused> {
        let door = &self.doorkeeper;
        let Some(text) = bearer(headers) else {
            return match peer.and_then(|peer| peer.certificate.as_deref()) {
                Some(name) if !headers.contains_key(AUTHORIZATION) => Ok(Arc::new(Caller::new(
                    // No token's id looks like this.
                    format!("certificate {name}"),
                    vec![Grant::everywhere(Scope::Publish)],
                ))),
                _ => Err(Cause::Unauthenticated.into()),
            };
        };
        let (shown, now) = (token::hash(text), Instant::now());
        if same(&shown, &door.root) {
            return Ok(door.root_caller.clone());
        }
        let caller = if let Some(caller) = door.remembered(&shown, now) {
            caller
        } else {
            let address = address.map(network);
            if let Some(wait) = address.and_then(|address| door.failures.wait(&address, now)) {
                return Err(Cause::TooMany { retry_after: wait }.into());
            }
            let Some(caller) = self.look_up(text, shown, now).await? else {
                if let Some(address) = address {
                    // It may have been emptied meanwhile, which the next request will hear.
                    door.failures.take(address, now).ok();
                }
                let id = token::parse(text).map(|shown| shown.id);
                tracing::warn!(token.id = id, peer = ?address, "a token was refused");
                return Err(Cause::Unauthenticated.into());
            };
            caller
        };
        door.requests
            .take(caller.name.clone(), now)
            .map_err(|retry_after| Refused(Cause::TooMany { retry_after }))?;
        Ok(caller)
    }

    /// The holder of a token of the database; none when it opens nothing.
    async fn look_up(
        &self,
        text: &str,
        whole: SecretHash,
        now: Instant,
    ) -> Result<Option<Arc<Caller>>, Refused> {
        let Some(shown) = token::parse(text) else {
            return Ok(None);
        };
        let Some(TokenKey { token, secrets, at }) = self.store.token_key(shown.id).await? else {
            return Ok(None);
        };
        let right = secrets
            .iter()
            .fold(false, |right, it| right | same(it, &shown.secret));
        let ended = token.revoked_at.is_some() || token.expires_at.is_some_and(|end| end <= at);
        if !right || ended {
            return Ok(None);
        }
        let left = token.expires_at.and_then(|end| (end - at).to_std().ok());
        let caller = Arc::new(Caller::new(token.id, token.grants));
        let known_for = left.unwrap_or(TOKEN_KNOWN_FOR).min(TOKEN_KNOWN_FOR);
        self.doorkeeper.remember(whole, &caller, now + known_for);
        if token.last_used_on != Some(at.date_naive())
            && let Err(error) = self.store.token_used(&caller.name).await
        {
            tracing::warn!(token.id = caller.name, %error, "could not note a token's use");
        }
        Ok(Some(caller))
    }

    async fn admit(&self, request: &mut Request) -> Result<(), Denied> {
        let peer = request.extensions().get::<Peer>().cloned();
        let route = request.extensions().get::<MatchedPath>().cloned();
        let path = request.uri().path();
        let found = need(
            request.method(),
            path,
            route.as_ref().map(MatchedPath::as_str),
        );
        let headers = request.headers();
        let address = self.doorkeeper.address(peer.as_ref(), headers);
        match found {
            Found::Need(Need::Open) => return Ok(()),
            Found::Need(Need::LocalOr(_)) if address.is_some_and(|it| it.is_loopback()) => {
                return Ok(());
            }
            _ => {}
        }
        let caller = self.authenticate(peer.as_ref(), address, headers).await?;
        match found {
            Found::Need(need) => {
                let collection = route
                    .filter(|route| route.as_str().starts_with("/v2/{collection}/"))
                    .and_then(|_| path.split('/').nth(2))
                    .map(str::parse::<CollectionId>)
                    .transpose()
                    .map_err(Refused::from)?;
                caller.satisfy(need, collection.as_ref())?;
                request.extensions_mut().insert(caller);
                Ok(())
            }
            Found::OtherMethod => Err(Denied::OtherMethod),
            Found::Nothing => Err(Denied::Unknown),
        }
    }
}

enum Denied {
    Refused(Refused),
    OtherMethod,
    Unknown,
}

impl From<Refused> for Denied {
    fn from(refused: Refused) -> Self {
        Self::Refused(refused)
    }
}

/// Who sent the request that a handler serves; the layer has put it there.
pub(crate) fn caller(extensions: &Extensions) -> Result<Arc<Caller>, Refused> {
    extensions
        .get::<Arc<Caller>>()
        .cloned()
        .ok_or(Refused(Cause::Unauthenticated))
}

/// Lets in who may; all others hear why not.
pub(crate) async fn layer(
    State(app): State<Arc<App>>,
    mut request: Request,
    next: Next,
) -> Response {
    let denied = match app.admit(&mut request).await {
        Ok(()) => return next.run(request).await,
        Err(denied) => denied,
    };
    let refused = match denied {
        Denied::Refused(refused) => refused,
        Denied::OtherMethod if !is_grpc(request.headers()) => {
            return oci_error(
                StatusCode::METHOD_NOT_ALLOWED,
                "UNSUPPORTED",
                "no such method here",
            );
        }
        Denied::OtherMethod | Denied::Unknown => return unknown(request.headers()),
    };
    if is_grpc(request.headers()) {
        return refused.0.status().into_http();
    }
    let challenge = refused.0 == Cause::Unauthenticated;
    let mut response = refused.into_response();
    if challenge {
        response.headers_mut().insert(
            WWW_AUTHENTICATE,
            HeaderValue::from_static("Bearer realm=\"ign\""),
        );
    }
    response
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt as _;

    use super::*;

    fn headers(value: &str) -> HeaderMap {
        HeaderMap::from_iter([(AUTHORIZATION, HeaderValue::from_str(value).unwrap())])
    }

    fn doorkeeper(text: &str, behind_proxy: bool) -> Result<Doorkeeper, ServeError> {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), text).unwrap();
        std::fs::set_permissions(file.path(), std::fs::Permissions::from_mode(0o600)).unwrap();
        Doorkeeper::new(file.path(), &Limits::default(), behind_proxy)
    }

    #[test]
    fn a_token_file_holds_one_long_word() {
        let root = doorkeeper("0123456789abcdef\n", false).unwrap().root;
        assert!(same(&root, &token::hash("0123456789abcdef")));
        assert!(!same(&root, &token::hash("0123456789abcdeF")));
        for bad in ["", "short", "0123456789abcdef 0123456789abcdef"] {
            assert!(doorkeeper(bad, false).is_err(), "{bad}");
        }
        assert!(Doorkeeper::new(Path::new("/absent/token"), &Limits::default(), false).is_err());
    }

    #[test]
    fn bearer_tokens_alone_are_read() {
        for good in ["Bearer 0123", "bearer 0123", "BEARER  0123 "] {
            assert_eq!(bearer(&headers(good)), Some("0123"), "{good}");
        }
        for bad in ["", "Bearer", "Bearer ", "0123", "Basic 0123"] {
            assert_eq!(bearer(&headers(bad)), None, "{bad}");
        }
    }

    #[test]
    fn behind_a_proxy_its_word_counts_and_not_the_clients() {
        let peer = Peer {
            address: "127.0.0.1:1".parse().unwrap(),
            certificate: None,
        };
        let forwarded = HeaderMap::from_iter([(
            FORWARDED_FOR.parse().unwrap(),
            HeaderValue::from_static("127.0.0.1, 203.0.113.9"),
        )]);
        let direct = doorkeeper("0123456789abcdef", false).unwrap();
        let behind = doorkeeper("0123456789abcdef", true).unwrap();
        let address = |text: &str| Some(text.parse::<IpAddr>().unwrap());
        assert_eq!(
            direct.address(Some(&peer), &forwarded),
            address("127.0.0.1")
        );
        assert_eq!(
            behind.address(Some(&peer), &forwarded),
            address("203.0.113.9")
        );
        assert_eq!(behind.address(Some(&peer), &HeaderMap::new()), None);
        let network = |text: &str| super::network(text.parse().unwrap());
        assert_eq!(network("2001:db8::1:2:3:4"), network("2001:db8::"));
        assert_ne!(network("2001:db8::"), network("2001:db9::"));
        assert_eq!(network("::ffff:10.0.0.1"), network("10.0.0.1"));
    }
}
