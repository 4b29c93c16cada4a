//! The embedded store: `SQLite`, one process, one machine.
//!
//! Write-ahead log, so that readers never wait for the writer; one writing connection with `BEGIN IMMEDIATE`, so that a
//! transaction never fails half-way for want of the lock. `synchronous = FULL`: an acknowledged submit survives a power
//! cut, not only `kill -9` (for which NORMAL would do); it costs one flush per commit, which at an embedded service's
//! rate of commits nobody notices.
//!
//! The database's clock is this machine's, made strictly increasing within the process.

use std::str::FromStr;
use std::sync::Arc;
use std::sync::atomic::{AtomicI64, Ordering};
use std::time::Duration;

use chrono::{DateTime, Utc};
use ign_proto::JobId;
use sqlx::sqlite::{SqliteConnectOptions, SqliteJournalMode, SqlitePoolOptions, SqliteSynchronous};
use sqlx::{QueryBuilder, Sqlite, SqliteConnection, SqlitePool, Transaction};

use crate::changes::Signal;
use crate::schema;
use crate::store::{Result, Settings, StoreError};

#[path = "sql/mod.rs"]
#[expect(
    clippy::duplicate_mod,
    reason = "one text for two dialects; see its module doc"
)]
mod sql;

pub use sql::SqlStore as SqliteStore;

const READERS: u32 = 4;

// What sql needs of its dialect.
type Db = Sqlite;
type Connection = SqliteConnection;
type DbTime = i64;
const LOCK: &str = "";
const LOCK_FREE_ROWS: &str = "";
const ALIAS_LIST: &str = "group_concat(a.alias, ',')";

#[derive(Debug)]
pub(super) struct Backend {
    writer: SqlitePool,
    readers: SqlitePool,
}

impl Backend {
    fn reader(&self) -> &SqlitePool {
        &self.readers
    }

    async fn begin(&self) -> Result<Transaction<'static, Db>> {
        Ok(self.writer.begin_with("begin immediate").await?)
    }

    #[expect(clippy::unused_async, reason = "the other dialect asks its server")]
    async fn now(_connection: &mut Connection) -> Result<DateTime<Utc>> {
        static LAST: AtomicI64 = AtomicI64::new(0);
        let wall = Utc::now().timestamp_micros();
        let last = LAST
            .fetch_update(Ordering::SeqCst, Ordering::SeqCst, |last| {
                Some(wall.max(last + 1))
            })
            .unwrap_or(wall);
        from_db(wall.max(last + 1))
    }
}

fn to_db(time: DateTime<Utc>) -> DbTime {
    time.timestamp_micros()
}

fn from_db(micros: DbTime) -> Result<DateTime<Utc>> {
    DateTime::from_timestamp_micros(micros).ok_or_else(|| StoreError::Internal {
        message: format!("time {micros} is out of range"),
        source: None,
    })
}

fn key(job: JobId) -> String {
    job.to_string()
}

#[expect(
    clippy::needless_pass_by_value,
    reason = "the other dialect's keys are values"
)]
fn from_key(key: String) -> Result<JobId> {
    key.parse().map_err(|error| StoreError::Internal {
        message: format!("{error}"),
        source: None,
    })
}

fn push_label(query: &mut QueryBuilder<Db>, label: &str, value: &str) {
    query
        .push("exists (select 1 from json_each(labels) l where l.key = ")
        .push_bind(label.to_owned())
        .push(" and l.value = ")
        .push_bind(value.to_owned())
        .push(")");
}

/// Opens the file, or makes it, and brings its schema up to date.
pub(crate) async fn open(url: &str, settings: Settings) -> Result<SqliteStore> {
    let options = SqliteConnectOptions::from_str(url)
        .map_err(|source| StoreError::Internal {
            message: "the database URL is not valid".to_owned(),
            source: Some(source),
        })?
        .create_if_missing(true)
        .foreign_keys(true)
        .journal_mode(SqliteJournalMode::Wal)
        .synchronous(SqliteSynchronous::Full)
        .busy_timeout(Duration::from_secs(10));
    let pool = |connections| {
        SqlitePoolOptions::new()
            .max_connections(connections)
            .acquire_timeout(Duration::from_secs(30))
            .idle_timeout(None)
            .max_lifetime(None)
    };
    let writer = pool(1).connect_with(options.clone()).await?;
    schema::sqlite()
        .run(&writer)
        .await
        .map_err(crate::error::from_migration)?;
    let readers = pool(READERS).connect_with(options).await?;
    let signal = Arc::new(Signal::new(settings.poll));
    Ok(SqliteStore::new(
        Backend { writer, readers },
        signal,
        settings,
    ))
}
