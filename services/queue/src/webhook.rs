//! Webhooks: where a collection's events are sent, and an outbox of what is to be sent.
//!
//! A row of the outbox is written in the transaction that ends a job, so there is one for each end that was committed
//! while the collection had a webhook, and none for any other. Whoever claims a row has it for a while; what it does not
//! end in that time is claimed again, so that each is sent at least once, whichever coordinator dies. What fails is tried
//! again after each of [`PAUSES`], and then given up.
//!
//! A secret must be kept as it is, because it signs. It leaves the store in a [`Dispatch`] alone, and no `Debug` shows it.

use std::fmt;
use std::time::Duration;

use async_trait::async_trait;
use chrono::{DateTime, Utc};
use ign_proto::{Attempt, CollectionId, JobId};
use serde_json::json;

use crate::state::{Job, JobState};
use crate::store::{NewVersion, Result};

/// Waits between the tries of a delivery; after the last it is given up: about 28 hours after the first.
pub const PAUSES: [Duration; 7] = [
    Duration::from_secs(5),
    Duration::from_mins(5),
    Duration::from_mins(30),
    Duration::from_hours(2),
    Duration::from_hours(5),
    Duration::from_hours(10),
    Duration::from_hours(10),
];
/// Deliveries that ended are forgotten after this time.
pub const KEPT: Duration = Duration::from_hours(30 * 24);
/// Bytes of a secret, at least and at most, as Standard Webhooks has it.
pub const SECRET_BYTES: std::ops::RangeInclusive<usize> = 24..=64;
/// Bytes of a URL.
pub const MAX_URL_BYTES: usize = 2048;

/// What signs deliveries.
#[derive(Clone, PartialEq, Eq)]
pub struct Secret(pub Vec<u8>);

impl fmt::Debug for Secret {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Secret(..)")
    }
}

/// Where a collection's events are sent.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Webhook {
    /// Whose events.
    pub collection: CollectionId,
    /// Whither; checked by who sends.
    pub url: String,
    /// Since when.
    pub set_at: DateTime<Utc>,
}

/// What became of a delivery.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DeliveryState {
    /// To be sent, or to be sent again.
    Pending,
    /// The receiver took it.
    Delivered,
    /// It is not tried again by itself.
    GivenUp,
}

impl DeliveryState {
    /// The word that the stores keep.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Pending => "pending",
            Self::Delivered => "delivered",
            Self::GivenUp => "given_up",
        }
    }
}

impl std::str::FromStr for DeliveryState {
    type Err = String;

    fn from_str(word: &str) -> std::result::Result<Self, String> {
        [Self::Pending, Self::Delivered, Self::GivenUp]
            .into_iter()
            .find(|state| state.as_str() == word)
            .ok_or_else(|| format!("unknown state of a delivery {word:?}"))
    }
}

/// One event on its way to one receiver.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Delivery {
    /// The same for every try: receivers know repetitions by it.
    pub id: String,
    /// Whose event.
    pub collection: CollectionId,
    /// Which job ended.
    pub job: JobId,
    /// In which attempt.
    pub attempt: Attempt,
    /// `job.succeeded`, `job.failed` or `job.cancelled`.
    pub event: String,
    /// What became of it.
    pub state: DeliveryState,
    /// Tries so far.
    pub tries: u32,
    /// When the job ended.
    pub created_at: DateTime<Utc>,
    /// When it is tried next, while pending.
    pub next_at: DateTime<Utc>,
    /// When it was delivered or given up.
    pub ended_at: Option<DateTime<Utc>>,
    /// Why the last try failed.
    pub last_error: Option<String>,
}

/// A delivery that its holder is to send now.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Dispatch {
    /// Which; its `tries` counts this one.
    pub delivery: Delivery,
    /// Whither.
    pub url: String,
    /// What signs it.
    pub secret: Secret,
    /// What is sent, the same at every try.
    pub body: String,
}

/// How a try went.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Tried {
    /// The receiver took it.
    Delivered,
    /// It did not; try again later.
    Failed(String),
    /// It never will.
    Refused(String),
}

/// The webhooks of a queue.
#[async_trait]
pub trait Webhooks {
    /// Sends a collection's events from now on to `url`; in place of another one. Makes the collection where it is new.
    async fn set_webhook(
        &self,
        collection: &CollectionId,
        url: &str,
        secret: Secret,
    ) -> Result<Webhook>;

    /// Sends nothing more; what is pending is given up.
    async fn remove_webhook(&self, collection: &CollectionId) -> Result<()>;

    /// All of them by collection.
    async fn webhooks(&self) -> Result<Vec<Webhook>>;

    /// Deliveries of a collection, the newest first.
    async fn deliveries(&self, collection: &CollectionId, limit: u32) -> Result<Vec<Delivery>>;

    /// Sends a delivery once more, from its first try on.
    async fn redeliver(&self, collection: &CollectionId, id: &str) -> Result<Delivery>;

    /// Takes deliveries that are due, at most so many; nobody else gets them for `hold`.
    async fn claim_deliveries(&self, limit: u32, hold: Duration) -> Result<Vec<Dispatch>>;

    /// Says how the try of a claimed delivery went. Who says it after another has claimed it changes nothing, unless it
    /// was delivered.
    async fn delivery_tried(&self, id: &str, tries: u32, tried: Tried) -> Result<()>;
}

/// The event of a job that has ended and its body; none for a job that goes on.
pub(crate) fn event(job: &Job, bundle: Option<&NewVersion>) -> Option<(&'static str, String)> {
    let event = match job.state {
        JobState::Succeeded => "job.succeeded",
        JobState::Failed => "job.failed",
        JobState::Cancelled => "job.cancelled",
        JobState::Queued | JobState::Leased => return None,
    };
    let object = &job.spec.object;
    let bundle = job.version.zip(bundle).map(|(version, bundle)| {
        json!({
            "version": version,
            "reference": format!("{object}:v{version}"),
            "manifest_digest": bundle.manifest_digest,
            "size_bytes": bundle.size_bytes,
        })
    });
    let body = json!({
        "type": event,
        "timestamp": job.finished_at,
        "data": {
            "job": job.id.to_string(),
            "collection": object.collection,
            "object": object.object,
            "attempt": job.attempt.0,
            "labels": job.spec.labels,
            "bundle": bundle,
            "failure": job.failure,
        },
    });
    Some((event, body.to_string()))
}
