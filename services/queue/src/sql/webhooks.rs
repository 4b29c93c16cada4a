//! Webhooks and their outbox in SQL; like the module that it is in, compiled once for each database.

use std::time::Duration;

use async_trait::async_trait;
use chrono::{DateTime, Utc};
use ign_proto::{Attempt, CollectionId};
use sqlx::{QueryBuilder, Row};

use super::super::{Connection, Db, LOCK, LOCK_FREE_ROWS, from_key, key, to_db};
use super::rows::{optional_time, parse, small, sql, time};
use super::{DbRow, SqlStore};
use crate::changes::Change;
use crate::check;
use crate::state::Job;
use crate::store::{MAX_LOG_LINE_BYTES, MAX_PAGE, NewVersion, Result, StoreError};
use crate::webhook::{
    Delivery, DeliveryState, Dispatch, KEPT, PAUSES, Secret, Tried, Webhook, Webhooks, event,
};

const DELIVERY: &str = "id, collection, job_id, attempt, event, state, tries, created_at, next_at, ended_at, last_error";

fn delivery_from(row: &DbRow) -> Result<Delivery> {
    Ok(Delivery {
        id: row.try_get("id")?,
        collection: parse(row.try_get("collection")?)?,
        job: from_key(row.try_get("job_id")?)?,
        attempt: Attempt(small(row.try_get("attempt")?)?),
        event: row.try_get("event")?,
        state: parse(row.try_get("state")?)?,
        tries: small(row.try_get("tries")?)?,
        created_at: time(row, "created_at")?,
        next_at: time(row, "next_at")?,
        ended_at: optional_time(row, "ended_at")?,
        last_error: row.try_get("last_error")?,
    })
}

fn absent(id: &str) -> StoreError {
    StoreError::NotFound {
        kind: "delivery",
        name: id.to_owned(),
    }
}

/// Writes into the outbox which of `jobs` have ended, with their bundles, where their collections want to hear of it.
pub(super) async fn announce<'a>(
    connection: &mut Connection,
    jobs: impl IntoIterator<Item = (&'a Job, Option<&'a NewVersion>)>,
    now: DateTime<Utc>,
) -> Result<()> {
    let ended: Vec<_> = jobs
        .into_iter()
        .filter(|(job, _)| job.state.is_terminal())
        .collect();
    if ended.is_empty() {
        return Ok(());
    }
    let listening: Vec<String> = sqlx::query_scalar("select collection from webhooks")
        .fetch_all(&mut *connection)
        .await?;
    let told = |(job, bundle): (&'a Job, _)| {
        let collection = job.spec.object.collection.as_str();
        let listens = listening.iter().any(|it| it == collection);
        Some((job, listens.then(|| event(job, bundle))??))
    };
    let events: Vec<(&Job, (&str, String))> = ended.into_iter().filter_map(told).collect();
    if events.is_empty() {
        return Ok(());
    }
    let mut insert = QueryBuilder::<Db>::new(
        "insert into deliveries (id, collection, job_id, attempt, event, body, state, created_at, next_at) \
         select v.column1, v.column2, v.column3, v.column4, v.column5, v.column6, 'pending', v.column7, v.column7 from (",
    );
    insert.push_values(events, |mut row, (job, (event, body))| {
        row.push_bind(format!("msg_{}", uuid::Uuid::now_v7().simple()))
            .push_bind(job.spec.object.collection.as_str())
            .push_bind(key(job.id))
            .push_bind(i64::from(job.attempt.0))
            .push_bind(event)
            .push_bind(body)
            .push_bind(to_db(now));
    });
    insert
        .push(") v, webhooks w where w.collection = v.column2 on conflict do nothing")
        .build()
        .execute(connection)
        .await?;
    Ok(())
}

/// Ends what is pending of a collection without a webhook.
async fn give_up(
    connection: &mut Connection,
    collection: &CollectionId,
    now: DateTime<Utc>,
) -> Result<()> {
    sqlx::query(
        "update deliveries set state = 'given_up', ended_at = $2, last_error = 'the webhook was removed' \
         where collection = $1 and state = 'pending'",
    )
    .bind(collection.as_str())
    .bind(to_db(now))
    .execute(connection)
    .await?;
    Ok(())
}

#[async_trait]
impl Webhooks for SqlStore {
    async fn set_webhook(
        &self,
        collection: &CollectionId,
        url: &str,
        secret: Secret,
    ) -> Result<Webhook> {
        check::webhook(url, &secret)?;
        let (mut transaction, now) = self.begin().await?;
        let outcome = async {
            sqlx::query("insert into collections (name) values ($1) on conflict do nothing")
                .bind(collection.as_str())
                .execute(&mut *transaction)
                .await?;
            sqlx::query(
                "insert into webhooks (collection, url, secret, set_at) values ($1, $2, $3, $4) \
                 on conflict (collection) do update set url = excluded.url, secret = excluded.secret, \
                 set_at = excluded.set_at",
            )
            .bind(collection.as_str())
            .bind(url)
            .bind(secret.0)
            .bind(to_db(now))
            .execute(&mut *transaction)
            .await?;
            Ok(Webhook {
                collection: collection.clone(),
                url: url.to_owned(),
                set_at: now,
            })
        }
        .await;
        self.finish(transaction, outcome, Change::Nothing).await
    }

    async fn remove_webhook(&self, collection: &CollectionId) -> Result<()> {
        let (mut transaction, now) = self.begin().await?;
        let outcome = async {
            let removed = sqlx::query("delete from webhooks where collection = $1")
                .bind(collection.as_str())
                .execute(&mut *transaction)
                .await?;
            if removed.rows_affected() == 0 {
                return Err(StoreError::NotFound {
                    kind: "webhook",
                    name: collection.to_string(),
                });
            }
            give_up(&mut transaction, collection, now).await
        }
        .await;
        self.finish(transaction, outcome, Change::Nothing).await
    }

    async fn webhooks(&self) -> Result<Vec<Webhook>> {
        let rows = sqlx::query("select collection, url, set_at from webhooks")
            .fetch_all(self.backend.reader())
            .await?;
        let mut webhooks = rows
            .iter()
            .map(|row| {
                Ok(Webhook {
                    collection: parse(row.try_get("collection")?)?,
                    url: row.try_get("url")?,
                    set_at: time(row, "set_at")?,
                })
            })
            .collect::<Result<Vec<_>>>()?;
        webhooks.sort_by(|a, b| a.collection.cmp(&b.collection));
        Ok(webhooks)
    }

    async fn deliveries(&self, collection: &CollectionId, limit: u32) -> Result<Vec<Delivery>> {
        let rows = sqlx::query(sql(format!(
            "select {DELIVERY} from deliveries where collection = $1 order by created_at desc, id desc limit $2"
        )))
        .bind(collection.as_str())
        .bind(i64::from(limit.clamp(1, MAX_PAGE)))
        .fetch_all(self.backend.reader())
        .await?;
        rows.iter().map(delivery_from).collect()
    }

    async fn redeliver(&self, collection: &CollectionId, id: &str) -> Result<Delivery> {
        let (mut transaction, now) = self.begin().await?;
        let outcome = async {
            let row = sqlx::query(sql(format!(
                "update deliveries set state = 'pending', tries = 0, next_at = $3, ended_at = null \
                 where id = $1 and collection = $2 returning {DELIVERY}"
            )))
            .bind(id)
            .bind(collection.as_str())
            .bind(to_db(now))
            .fetch_optional(&mut *transaction)
            .await?;
            delivery_from(&row.ok_or_else(|| absent(id))?)
        }
        .await;
        self.finish(transaction, outcome, Change::Nothing).await
    }

    async fn claim_deliveries(&self, limit: u32, hold: Duration) -> Result<Vec<Dispatch>> {
        // Looked at without a lock first: mostly there is nothing.
        let mut reader = self.backend.reader().acquire().await?;
        let now = super::Backend::now(&mut reader).await?;
        let due = "state = 'pending' and next_at <= $1";
        let any = sqlx::query(sql(format!(
            "select 1 as found from deliveries where {due} limit 1"
        )))
        .bind(to_db(now))
        .fetch_optional(&mut *reader)
        .await?;
        drop(reader);
        if any.is_none() {
            return Ok(Vec::new());
        }
        let (mut transaction, now) = self.begin().await?;
        let outcome = async {
            let rows = sqlx::query(sql(format!(
                "select id from deliveries where {due} order by next_at limit $2 {LOCK_FREE_ROWS}"
            )))
            .bind(to_db(now))
            .bind(i64::from(limit))
            .fetch_all(&mut *transaction)
            .await?;
            let until = now + chrono::TimeDelta::from_std(hold).map_err(super::internal)?;
            let mut claimed = Vec::new();
            for row in rows {
                let id: String = row.try_get("id")?;
                let row = sqlx::query(sql(format!(
                    "update deliveries set tries = tries + 1, next_at = $2 where id = $1 returning {DELIVERY}, body"
                )))
                .bind(&id)
                .bind(to_db(until))
                .fetch_one(&mut *transaction)
                .await?;
                let delivery = delivery_from(&row)?;
                let body = row.try_get("body")?;
                let webhook = sqlx::query("select url, secret from webhooks where collection = $1")
                    .bind(delivery.collection.as_str())
                    .fetch_optional(&mut *transaction)
                    .await?;
                // Removed while the job ended.
                let Some(webhook) = webhook else {
                    give_up(&mut transaction, &delivery.collection, now).await?;
                    continue;
                };
                claimed.push(Dispatch {
                    delivery,
                    url: webhook.try_get("url")?,
                    secret: Secret(webhook.try_get("secret")?),
                    body,
                });
            }
            Ok(claimed)
        }
        .await;
        self.finish(transaction, outcome, Change::Nothing).await
    }

    async fn delivery_tried(&self, id: &str, tries: u32, tried: Tried) -> Result<()> {
        let (mut transaction, now) = self.begin().await?;
        let outcome = async {
            let row = sqlx::query(sql(format!(
                "select {DELIVERY} from deliveries where id = $1 {LOCK}"
            )))
            .bind(id)
            .fetch_optional(&mut *transaction)
            .await?;
            let delivery = delivery_from(&row.ok_or_else(|| absent(id))?)?;
            let mine = delivery.state == DeliveryState::Pending && delivery.tries == tries;
            if !mine && tried != Tried::Delivered {
                return Ok(());
            }
            let pause = PAUSES.get(tries.saturating_sub(1) as usize);
            let (state, next_at, error) = match (tried, pause) {
                (Tried::Delivered, _) => (DeliveryState::Delivered, now, None),
                (Tried::Failed(error), Some(pause)) => {
                    let pause = chrono::TimeDelta::from_std(*pause).map_err(super::internal)?;
                    (DeliveryState::Pending, now + pause, Some(error))
                }
                (Tried::Failed(error) | Tried::Refused(error), _) => {
                    (DeliveryState::GivenUp, now, Some(error))
                }
            };
            let ended_at = (state != DeliveryState::Pending).then(|| to_db(now));
            sqlx::query(
                "update deliveries set state = $2, next_at = $3, ended_at = $4, last_error = $5 where id = $1",
            )
            .bind(id)
            .bind(state.as_str())
            .bind(to_db(next_at))
            .bind(ended_at)
            .bind(error.map(|error| check::clean(&error, MAX_LOG_LINE_BYTES)))
            .execute(&mut *transaction)
            .await?;
            let kept = chrono::TimeDelta::from_std(KEPT).map_err(super::internal)?;
            sqlx::query("delete from deliveries where state <> 'pending' and ended_at < $1")
                .bind(to_db(now - kept))
                .execute(&mut *transaction)
                .await?;
            Ok(())
        }
        .await;
        self.finish(transaction, outcome, Change::Nothing).await
    }
}
