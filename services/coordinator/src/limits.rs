//! Every limit on what a peer may cost, in one place.
//!
//! Limits of one message or name are where both sides agree on them: `ign_proto::MAX_MESSAGE_BYTES` (16 MiB),
//! `ign_proto::manifest::MAX_BYTES` (4 MiB) and its number of files; limits of texts in the database are
//! `ign_queue`'s `check`.

use std::time::Duration;

/// Largest blob.
pub(crate) const MAX_BLOB_BYTES: u64 = 64 * 1024 * 1024 * 1024;
/// A signed URL lives this long; a read that has begun goes on.
pub(crate) const SIGNED_FOR: Duration = Duration::from_mins(10);
/// A token that was let in is not looked up again for this long: so late does a revocation reach other coordinators.
pub(crate) const TOKEN_KNOWN_FOR: Duration = Duration::from_secs(5);

/// What a peer or a token may do.
#[derive(Clone, Copy, Debug)]
pub struct Limits {
    /// Open connections.
    pub connections: usize,
    /// Open connections of one address; not behind a proxy, whose address is everybody's.
    pub connections_per_peer: usize,
    /// From a connection's begin, TLS handshake and all, until its first request is read.
    pub first_request: Duration,
    /// Between two requests of HTTP/1.1, and for reading a request's head. Longer than clients keep idle connections
    /// (reqwest: 90 s), or they would send into one that is closing.
    pub head: Duration,
    /// All headers of a request together.
    pub head_bytes: u32,
    /// Longest silence in the middle of a request's body.
    pub body_silence: Duration,
    /// A body that is slower than this, after [`Limits::body_silence`], ends.
    pub body_bytes_per_sec: u64,
    /// Wrong tokens from one address.
    pub failures: Rate,
    /// Requests of one token, other than the coordinator's own.
    pub requests: Rate,
}

/// A burst, and a rate in the long run.
#[derive(Clone, Copy, Debug)]
pub struct Rate {
    /// In the long run.
    pub per_sec: f64,
    /// At once.
    pub burst: u32,
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            connections: 4096,
            connections_per_peer: 1024,
            first_request: Duration::from_secs(15),
            head: Duration::from_mins(2),
            head_bytes: 64 * 1024,
            body_silence: Duration::from_mins(1),
            body_bytes_per_sec: 1024,
            failures: Rate {
                per_sec: 0.2,
                burst: 10,
            },
            requests: Rate {
                per_sec: 1000.0,
                burst: 2000,
            },
        }
    }
}
