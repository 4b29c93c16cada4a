//! `webhook set|list|remove|deliveries|redeliver`: the ends of a collection's jobs, sent to a URL.

use std::path::{Path, PathBuf};

use base64::Engine as _;
use base64::prelude::BASE64_STANDARD;
use chrono::{DateTime, Utc};
use ign_proto::{CollectionId, v1};
use serde::Serialize;

use crate::Context;
use crate::connection::Connection;
use crate::output::{self, Table, age};
use crate::problem::{Doing as _, Problem};
use crate::views::{ShortIds, time};

/// What Standard Webhooks puts before a secret.
const PREFIX: &str = "whsec_";

/// `webhook ...`.
#[derive(Debug, clap::Subcommand)]
pub(crate) enum Command {
    /// Send the ends of a collection's jobs to a URL, signed; in place of another one
    Set {
        /// Collection
        collection: CollectionId,
        /// Receiver: https and a public address, unless the coordinator's --webhook-internal names it
        #[arg(long)]
        url: String,
        /// File with the secret that signs: base64 of 24 to 64 random bytes, with or without whsec_ before it (make one
        /// with: openssl rand -base64 32)
        #[arg(long, value_name = "FILE")]
        secret_file: PathBuf,
    },
    /// List receivers; secrets are not shown
    List,
    /// Send no more; what is still to be sent is given up
    Remove {
        /// Collection
        collection: CollectionId,
    },
    /// Show what was sent or is to be sent, the newest first
    Deliveries {
        /// Collection
        collection: CollectionId,
        /// At most this many
        #[arg(long, value_name = "N", default_value_t = 100)]
        limit: u32,
    },
    /// Send a delivery once more
    Redeliver {
        /// Collection
        collection: CollectionId,
        /// Id of the delivery
        id: String,
    },
}

/// A receiver, as `-o json` writes it.
#[derive(Debug, Serialize)]
struct WebhookView {
    collection: String,
    url: String,
    set_at: Option<DateTime<Utc>>,
}

/// A delivery, as `-o json` writes it.
#[derive(Debug, Serialize)]
struct DeliveryView {
    id: String,
    collection: String,
    job_id: String,
    event: String,
    state: String,
    tries: u32,
    created_at: Option<DateTime<Utc>>,
    next_at: Option<DateTime<Utc>>,
    ended_at: Option<DateTime<Utc>>,
    last_error: Option<String>,
}

impl From<v1::Webhook> for WebhookView {
    fn from(wire: v1::Webhook) -> Self {
        Self {
            set_at: time(wire.set_at.as_ref()),
            collection: wire.collection,
            url: wire.url,
        }
    }
}

impl From<v1::Delivery> for DeliveryView {
    fn from(wire: v1::Delivery) -> Self {
        Self {
            created_at: time(wire.created_at.as_ref()),
            next_at: time(wire.next_at.as_ref()),
            ended_at: time(wire.ended_at.as_ref()),
            id: wire.id,
            collection: wire.collection,
            job_id: wire.job_id,
            event: wire.event,
            state: wire.state,
            tries: wire.tries,
            last_error: (!wire.last_error.is_empty()).then_some(wire.last_error),
        }
    }
}

pub(crate) async fn run(context: &Context, command: &Command) -> Result<(), Problem> {
    // Read first: a bad secret needs no service to be refused.
    let secret = match command {
        Command::Set { secret_file, .. } => read_secret(secret_file)?,
        _ => Vec::new(),
    };
    let connection = Connection::open(&context.connection).await?;
    let mut collections = connection.collections();
    match command {
        Command::Set {
            collection, url, ..
        } => {
            let request = v1::SetWebhookRequest {
                collection: collection.to_string(),
                url: url.clone(),
                secret,
            };
            let webhook = collections.set_webhook(request).await?.into_inner();
            show_webhooks(context, vec![webhook])
        }
        Command::List => {
            let request = v1::ListWebhooksRequest::default();
            let answer = collections.list_webhooks(request).await?.into_inner();
            show_webhooks(context, answer.webhooks)
        }
        Command::Remove { collection } => {
            let request = v1::RemoveWebhookRequest {
                collection: collection.to_string(),
            };
            collections.remove_webhook(request).await?;
            output::note(&format!("nothing more is sent about {collection}"));
            Ok(())
        }
        Command::Deliveries { collection, limit } => {
            let request = v1::ListDeliveriesRequest {
                collection: collection.to_string(),
                limit: *limit,
            };
            let answer = collections.list_deliveries(request).await?.into_inner();
            show_deliveries(context, answer.deliveries)
        }
        Command::Redeliver { collection, id } => {
            let request = v1::RedeliverRequest {
                collection: collection.to_string(),
                id: id.clone(),
            };
            let delivery = collections.redeliver(request).await?.into_inner();
            show_deliveries(context, vec![delivery])
        }
    }
}

fn read_secret(file: &Path) -> Result<Vec<u8>, Problem> {
    let text = std::fs::read_to_string(file).doing("cannot read the secret", file.display())?;
    let text = text.trim();
    BASE64_STANDARD
        .decode(text.strip_prefix(PREFIX).unwrap_or(text))
        .map_err(|_error| {
            Problem::usage("the secret is not base64")
                .at(file.display())
                .hint("make one with: openssl rand -base64 32")
        })
}

fn show_webhooks(context: &Context, webhooks: Vec<v1::Webhook>) -> Result<(), Problem> {
    let views: Vec<WebhookView> = webhooks.into_iter().map(WebhookView::from).collect();
    output::data(context.format, &views, || {
        let mut table = Table::new(&["COLLECTION", "URL", ">SET"]);
        for view in &views {
            table.row([
                view.collection.clone(),
                view.url.clone(),
                age(view.set_at, Utc::now()),
            ]);
        }
        table.to_string()
    })
}

fn show_deliveries(context: &Context, deliveries: Vec<v1::Delivery>) -> Result<(), Problem> {
    let views: Vec<DeliveryView> = deliveries.into_iter().map(DeliveryView::from).collect();
    output::data(context.format, &views, || table(&views, Utc::now()))
}

fn table(views: &[DeliveryView], now: DateTime<Utc>) -> String {
    let ids = ShortIds::of(views.iter().map(|view| view.job_id.as_str()));
    let mut table = Table::new(&[
        "ID", "EVENT", "JOB", "STATE", ">TRIES", ">AGE", "NEXT", "ERROR",
    ]);
    for view in views {
        let next = view.next_at.map_or_else(String::new, |at| {
            at.format("%Y-%m-%d %H:%M:%S UTC").to_string()
        });
        table.row([
            view.id.clone(),
            view.event.clone(),
            ids.show(&view.job_id),
            view.state.replace('_', " "),
            view.tries.to_string(),
            age(view.created_at, now),
            next,
            view.last_error.clone().unwrap_or_default(),
        ]);
    }
    table.to_string()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::views::samples;

    #[test]
    fn what_became_of_each_delivery() {
        let view = |event: &str, state: &str, tries, error: Option<&str>| DeliveryView {
            id: "msg_0192f0c100007000800000000000000".into(),
            collection: "museum".into(),
            job_id: "0192f0c1-0000-7000-8000-000000000001".into(),
            event: event.into(),
            state: state.into(),
            tries,
            created_at: Some(samples::now() - chrono::TimeDelta::seconds(70)),
            next_at: (state == "pending").then(samples::now),
            ended_at: None,
            last_error: error.map(str::to_owned),
        };
        insta::assert_snapshot!(table(
            &[
                view(
                    "job.succeeded",
                    "pending",
                    2,
                    Some("503 Service Unavailable")
                ),
                view("job.failed", "given_up", 8, Some("410 Gone")),
                view("job.succeeded", "delivered", 1, None),
            ],
            samples::now()
        ));
    }

    #[test]
    fn secrets_are_base64_with_or_without_their_prefix() {
        let file = tempfile::NamedTempFile::new().unwrap();
        for text in ["c2VjcmV0\n", "whsec_c2VjcmV0"] {
            std::fs::write(file.path(), text).unwrap();
            assert_eq!(read_secret(file.path()).unwrap(), b"secret");
        }
        std::fs::write(file.path(), "not base64!").unwrap();
        let problem = read_secret(file.path()).unwrap_err();
        assert!(!problem.to_string().contains("not base64!"), "{problem}");
    }
}
