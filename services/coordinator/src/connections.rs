//! Connections: taking them, with or without TLS, and ending those that cost more than they may.
//!
//! A connection has a place of its own among all and among those of its address, until it ends. It must bring its first
//! request soon, the TLS handshake included: whoever connects and says nothing, or half a word, is cut. Later silence is
//! HTTP's: a head must be read within [`Limits::head`], and HTTP/2 peers answer pings.

use std::collections::HashMap;
use std::net::IpAddr;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use axum::Router;
use axum::extract::Request;
use hyper_util::rt::{TokioExecutor, TokioIo, TokioTimer};
use hyper_util::server::conn::auto;
use hyper_util::server::graceful::{GracefulShutdown, Watcher};
use hyper_util::service::TowerToHyperService;
use tokio::net::{TcpListener, TcpStream};
use tokio::task::JoinSet;
use tokio::time::Instant;
use tokio_util::either::Either;
use tokio_util::sync::CancellationToken;
use tower::ServiceExt as _;

use crate::auth::Peer;
use crate::limits::Limits;
use crate::tls::{Tls, client_name};

const MAX_STREAMS: u32 = 1024;
/// A peer that vanished is noticed after the sum of both.
const KEEP_ALIVE_INTERVAL: Duration = Duration::from_secs(15);
const KEEP_ALIVE_TIMEOUT: Duration = Duration::from_secs(15);
const STREAM_WINDOW: u32 = 1024 * 1024;
const CONNECTION_WINDOW: u32 = 8 * 1024 * 1024;
/// How long running requests may take to end.
const GRACE: Duration = Duration::from_secs(8);

/// Takes connections.
pub(crate) struct Door {
    server: auto::Builder<TokioExecutor>,
    router: Router,
    tls: Option<Arc<Tls>>,
    places: Arc<Places>,
    first_request: Duration,
}

impl Door {
    pub(crate) fn new(
        router: Router,
        tls: Option<Arc<Tls>>,
        limits: &Limits,
        behind_proxy: bool,
    ) -> Self {
        let mut server = auto::Builder::new(TokioExecutor::new());
        server
            .http1()
            .timer(TokioTimer::new())
            .header_read_timeout(limits.head)
            .max_buf_size(limits.head_bytes as usize);
        server
            .http2()
            .timer(TokioTimer::new())
            .keep_alive_interval(KEEP_ALIVE_INTERVAL)
            .keep_alive_timeout(KEEP_ALIVE_TIMEOUT)
            .max_concurrent_streams(MAX_STREAMS)
            .max_header_list_size(limits.head_bytes)
            .initial_stream_window_size(STREAM_WINDOW)
            .initial_connection_window_size(CONNECTION_WINDOW);
        Self {
            server,
            router,
            tls,
            places: Arc::new(Places {
                taken: Mutex::default(),
                all: limits.connections,
                // A proxy's address is everybody's.
                of_a_peer: if behind_proxy {
                    limits.connections
                } else {
                    limits.connections_per_peer
                },
            }),
            first_request: limits.first_request,
        }
    }

    /// Takes connections until the coordinator is to stop; then `closing` runs, and those that are open may finish.
    pub(crate) async fn run(
        self,
        listener: TcpListener,
        stopping: &CancellationToken,
        closing: impl Future<Output = ()>,
    ) {
        let door = Arc::new(self);
        let graceful = GracefulShutdown::new();
        let mut connections = JoinSet::new();
        loop {
            let accepted = tokio::select! {
                biased;
                () = stopping.cancelled() => break,
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
            let Some(place) = door.places.take(peer.ip()) else {
                tracing::warn!(%peer, "refused a connection: too many are open");
                continue;
            };
            let (door, watcher) = (door.clone(), graceful.watcher());
            connections.spawn(async move {
                let ended = door.serve(socket, peer, watcher).await;
                if let Err(error) = ended {
                    tracing::debug!(error, %peer, "connection broke");
                }
                drop(place);
            });
        }
        drop(listener);
        closing.await;
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

    async fn serve(
        &self,
        socket: TcpStream,
        address: std::net::SocketAddr,
        watcher: Watcher,
    ) -> Result<(), Box<dyn std::error::Error + Send + Sync>> {
        let deadline = Instant::now() + self.first_request;
        socket.set_nodelay(true)?;
        let (io, certificate) = match &self.tls {
            None => (Either::Left(socket), None),
            Some(tls) => {
                let shaken = tokio::time::timeout_at(deadline, tls.acceptor().accept(socket));
                let stream = shaken.await??;
                let certificate = client_name(stream.get_ref().1);
                (Either::Right(stream), certificate)
            }
        };
        let asked = Arc::new(AtomicBool::new(false));
        let service = self.router.clone().map_request({
            let asked = asked.clone();
            let peer = Peer {
                address,
                certificate,
            };
            move |mut request: Request<_>| {
                asked.store(true, Ordering::Relaxed);
                request.extensions_mut().insert(peer.clone());
                request
            }
        });
        let connection = self
            .server
            .serve_connection(TokioIo::new(io), TowerToHyperService::new(service))
            .into_owned();
        let silent = async {
            tokio::time::sleep_until(deadline).await;
            if asked.load(Ordering::Relaxed) {
                std::future::pending::<()>().await;
            }
        };
        tokio::select! {
            ended = watcher.watch(connection) => ended,
            () = silent => Err("no request came in time".into()),
        }
    }
}

/// Open connections, of all and of each address.
#[derive(Debug)]
struct Places {
    taken: Mutex<HashMap<IpAddr, usize>>,
    all: usize,
    of_a_peer: usize,
}

impl Places {
    fn take(self: &Arc<Self>, peer: IpAddr) -> Option<Place> {
        let mut taken = self.taken.lock().unwrap_or_else(PoisonError::into_inner);
        let all: usize = taken.values().sum();
        let of_peer = taken.get(&peer).copied().unwrap_or(0);
        if all >= self.all || of_peer >= self.of_a_peer {
            return None;
        }
        taken.insert(peer, of_peer + 1);
        Some(Place {
            places: self.clone(),
            peer,
        })
    }
}

struct Place {
    places: Arc<Places>,
    peer: IpAddr,
}

impl Drop for Place {
    fn drop(&mut self) {
        let mut taken = self
            .places
            .taken
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        if let Some(count) = taken.get_mut(&self.peer) {
            *count -= 1;
            if *count == 0 {
                taken.remove(&self.peer);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn places_are_counted_by_address_and_given_back() {
        let places = Arc::new(Places {
            taken: Mutex::default(),
            all: 3,
            of_a_peer: 2,
        });
        let [a, b] = ["10.0.0.1", "10.0.0.2"].map(|text| text.parse::<IpAddr>().unwrap());
        let first = places.take(a).unwrap();
        let _second = places.take(a).unwrap();
        assert!(places.take(a).is_none());
        let _third = places.take(b).unwrap();
        assert!(places.take(b).is_none());
        drop(first);
        assert!(places.take(b).is_some() && places.take(a).is_some());
    }
}
