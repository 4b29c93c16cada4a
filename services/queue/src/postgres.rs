//! The store for many machines: Postgres.
//!
//! Claims take the next row that nobody else holds (`for no key update skip locked`), so any number of coordinators
//! lease from one database. A change is told to the other coordinators by `NOTIFY`, sent outside the transaction that
//! made it and at most every [`NOTIFY_PAUSE`]: inside, it would serialise every commit on one lock of the server. A
//! lost notification costs one poll interval.

use std::str::FromStr;
use std::sync::Arc;
use std::time::Duration;

use chrono::{DateTime, Utc};
use ign_proto::JobId;
use sqlx::postgres::{PgConnectOptions, PgListener, PgPoolOptions};
use sqlx::{PgConnection, PgPool, Postgres, QueryBuilder, Transaction};
use tokio::task::JoinSet;
use uuid::Uuid;

use crate::changes::{Change, Signal};
use crate::schema;
use crate::store::{Result, Settings, StoreError};

#[path = "sql/mod.rs"]
mod sql;

pub use sql::SqlStore as PostgresStore;

const CHANNEL: &str = "ign_queue";
/// Changes within this time are told once.
const NOTIFY_PAUSE: Duration = Duration::from_millis(10);
const JOB_WORD: &str = "job";
const WORK_WORD: &str = "work";
const MAX_CONNECTIONS: u32 = 24;
/// A row that somebody else holds for longer is an outage, not a reason to wait for ever.
const LOCK_TIMEOUT: &str = "10s";
/// A coordinator that froze in the middle of a transaction lets go of its rows after this time.
const IDLE_TRANSACTION_TIMEOUT: &str = "20s";

// What sql needs of its dialect.
type Db = Postgres;
type Connection = PgConnection;
type DbTime = DateTime<Utc>;
const LOCK: &str = "for no key update";
const LOCK_FREE_ROWS: &str = "for no key update skip locked";
const ALIAS_LIST: &str = "string_agg(a.alias, ',')";

/// The pool, and the tasks that pass changes on; they end with the last store.
#[derive(Debug)]
pub(super) struct Backend {
    pool: PgPool,
    _tasks: JoinSet<()>,
}

impl Backend {
    fn reader(&self) -> &PgPool {
        &self.pool
    }

    async fn begin(&self) -> Result<Transaction<'static, Db>> {
        Ok(self.pool.begin().await?)
    }

    /// The database's clock.
    async fn now(connection: &mut Connection) -> Result<DateTime<Utc>> {
        Ok(sqlx::query_scalar("select clock_timestamp()")
            .fetch_one(connection)
            .await?)
    }
}

fn to_db(time: DateTime<Utc>) -> DbTime {
    time
}

#[expect(
    clippy::unnecessary_wraps,
    reason = "the other dialect's times can be out of range"
)]
fn from_db(time: DbTime) -> Result<DateTime<Utc>> {
    Ok(time)
}

fn key(job: JobId) -> Uuid {
    job.as_uuid()
}

#[expect(clippy::unnecessary_wraps, reason = "the other dialect keeps text")]
fn from_key(key: Uuid) -> Result<JobId> {
    Ok(key.into())
}

fn push_label(query: &mut QueryBuilder<Db>, label: &str, value: &str) {
    query
        .push("labels @> ")
        .push_bind(serde_json::json!({ label: value }));
}

/// Opens the database, brings its schema up to date.
pub(crate) async fn open(url: &str, settings: Settings) -> Result<PostgresStore> {
    let options = PgConnectOptions::from_str(url)
        .map_err(|source| StoreError::Internal {
            message: "the database URL is not valid".to_owned(),
            source: Some(source),
        })?
        .application_name("ign")
        .options([
            ("lock_timeout", LOCK_TIMEOUT),
            (
                "idle_in_transaction_session_timeout",
                IDLE_TRANSACTION_TIMEOUT,
            ),
        ]);
    let pool = PgPoolOptions::new()
        .max_connections(MAX_CONNECTIONS)
        .acquire_timeout(Duration::from_secs(10))
        .connect_with(options)
        .await?;
    schema::postgres()
        .run(&pool)
        .await
        .map_err(crate::error::from_migration)?;

    let signal = Arc::new(Signal::new(settings.poll));
    let instance = Uuid::new_v4().to_string();
    let mut tasks = JoinSet::new();
    tasks.spawn(tell_others(pool.clone(), signal.clone(), instance.clone()));
    tasks.spawn(hear_others(pool.clone(), signal.clone(), instance));
    Ok(PostgresStore::new(
        Backend {
            pool,
            _tasks: tasks,
        },
        signal,
        settings,
    ))
}

async fn tell_others(pool: PgPool, signal: Arc<Signal>, instance: String) {
    let mut own = signal.subscribe_own();
    let mut told_work = own.borrow_and_update().work;
    while own.changed().await.is_ok() {
        let work = own.borrow_and_update().work;
        let word = if work == told_work {
            JOB_WORD
        } else {
            WORK_WORD
        };
        told_work = work;
        let told = sqlx::query("select pg_notify($1, $2)")
            .bind(CHANNEL)
            .bind(format!("{word} {instance}"))
            .execute(&pool)
            .await;
        if let Err(error) = told {
            tracing::warn!(%error, "cannot tell other coordinators of a change; they will poll");
        }
        tokio::time::sleep(NOTIFY_PAUSE).await;
    }
}

async fn hear_others(pool: PgPool, signal: Arc<Signal>, instance: String) {
    loop {
        match listen(&pool, &signal, &instance).await {
            Ok(never) => match never {},
            Err(error) => {
                tracing::warn!(%error, "cannot hear of other coordinators' changes; polling until I can");
            }
        }
        tokio::time::sleep(Duration::from_secs(1)).await;
    }
}

async fn listen(
    pool: &PgPool,
    signal: &Signal,
    instance: &str,
) -> std::result::Result<std::convert::Infallible, sqlx::Error> {
    let mut listener = PgListener::connect_with(pool).await?;
    listener.listen(CHANNEL).await?;
    // Between two connections something may have been missed.
    signal.raise_foreign(Change::Work);
    loop {
        let Some(notification) = listener.try_recv().await? else {
            signal.raise_foreign(Change::Work);
            continue;
        };
        match notification.payload().split_once(' ') {
            Some((_, sender)) if sender == instance => {}
            Some((JOB_WORD, _)) => signal.raise_foreign(Change::Job),
            // Also what a newer version may say.
            _ => signal.raise_foreign(Change::Work),
        }
    }
}
