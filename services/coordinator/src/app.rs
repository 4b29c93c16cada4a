//! What all handlers share.

use std::sync::Arc;
use std::time::Duration;

use ign_queue::Store;
use ign_registry::Registry;
use tokio_util::sync::CancellationToken;

use crate::auth::Doorkeeper;
use crate::fetch::Contents;
use crate::holders::Holders;
use crate::limits::Limits;
use crate::metrics::Metrics;
use crate::publish::Mirror;
use crate::room::Room;
use crate::webhooks::Receivers;

/// The coordinator's parts; one for all connections.
pub(crate) struct App {
    pub(crate) store: Arc<dyn Store>,
    pub(crate) registry: Registry,
    pub(crate) doorkeeper: Doorkeeper,
    pub(crate) contents: Contents,
    pub(crate) holders: Holders,
    pub(crate) limits: Limits,
    pub(crate) metrics: Metrics,
    pub(crate) mirror: Mirror,
    pub(crate) redirect_blobs: bool,
    pub(crate) room: Room,
    /// Who may be sent webhooks.
    pub(crate) receivers: Receivers,
    /// Where damaged content is repaired from.
    pub(crate) replica: Option<Registry>,
    /// How often every digest is read again.
    pub(crate) audit_every: Option<Duration>,
    /// Cancelled when the coordinator is to end: long polls and streams end then.
    pub(crate) stopping: CancellationToken,
}
