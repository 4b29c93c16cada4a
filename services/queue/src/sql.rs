//! The store's operations in SQL that both dialects speak.
//!
//! This file is compiled twice, as a child of `postgres.rs` and of `sqlite.rs`: the parent gives the names in the `use
//! super` line below (types of the driver, how rows are locked, how times and ids are kept). So an operation is written
//! once and both stores behave alike; what differs is in the parents.
//!
//! Every change of a job is: lock its row, apply the pure transition of [`crate::state`], write it back, commit, signal.
//! Lock order where one transaction takes several: collection, job, object.

use std::cmp::Ordering;
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use chrono::{DateTime, NaiveDate, Utc};
use ign_proto::{Attempt, CollectionId, Digest, Grant, JobId, ObjectName, WorkerId};
use sqlx::types::Json;
use sqlx::{AssertSqlSafe, QueryBuilder, Row, Transaction};

use super::{
    ALIAS_LIST, Backend, Connection, Db, DbTime, GROUPS_AT_ONCE, LOCK, LOCK_FREE_ROWS, from_db,
    from_key, key, push_label, to_db,
};
use crate::changes::{Change, Changes, Signal};
use crate::check;
use crate::error::{from_commit, shared};
use crate::group::Group;
use crate::state::{Checkpoint, Failure, Job, JobSpec, JobState, Level, Progress, Refusal};
use crate::store::{
    Adopted, Collection, Event, JobFilter, JobPage, LogLine, MAX_EVENTS, MAX_LOG_LINE_BYTES,
    MAX_LOG_LINES, MAX_PAGE, Named, NewLogLine, NewVersion, Orders, Reaped, Result, Settings,
    Standing, Status, Store, StoreError, Submit, Version, VersionFilter, Waiting, Worker,
    WorkerInfo,
};
use crate::token::{NewToken, SecretHash, Token, TokenKey, Tokens};
use crate::waiting::{Rival, Surroundings, describe};

#[path = "webhook_sql.rs"]
mod webhook_sql;

use webhook_sql::announce;

type DbRow = <Db as sqlx::Database>::Row;

/// Rows of one insert; a row has at most a dozen bound values, and `SQLite` takes 32,766 of them.
const CHUNK: usize = 500;
/// The alias that every publish moves.
const LATEST: &str = "latest";
/// A worker's row is written again after this many seconds, so that idle workers cost reads only.
const WORKER_FRESH_SECS: i64 = 5;
const WORKER_LISTED_SECS: i64 = 3600;
const WORKER_KEPT_SECS: i64 = 24 * 3600;
const REAP_BATCH: usize = 100;
/// Log lines taken from one call; of more, the last.
const MAX_LINES_PER_CALL: usize = 2000;

const JOB: &str = "id, collection, object, request_id, capture_digest, recipe_json, priority, labels, max_attempts, \
    state, attempt, attempt_limit, worker, cancel_requested, progress, failure, checkpoint_digest, checkpoint_bytes, \
    version, submitted_at, not_before, started_at, finished_at, lease_until, holder, holder_attempt, traceparent";

/// The queue in a database.
#[derive(Debug)]
pub struct SqlStore {
    backend: Backend,
    signal: Arc<Signal>,
    settings: Settings,
    leases: Group<LeaseAsk, Result<Option<Job>>>,
    publishes: Group<PublishAsk, Option<Result<Version>>>,
    lookups: Group<ObjectName, Result<Standing>>,
}

fn sql(text: String) -> AssertSqlSafe<String> {
    // Only constants of this file and its parents are formatted in; values are bound.
    AssertSqlSafe(text)
}

fn internal(message: impl std::fmt::Display) -> StoreError {
    StoreError::Internal {
        message: message.to_string(),
        source: None,
    }
}

fn parse<T: std::str::FromStr>(text: &str) -> Result<T>
where
    T::Err: std::fmt::Display,
{
    text.parse().map_err(internal)
}

fn seconds(secs: i64) -> chrono::TimeDelta {
    chrono::TimeDelta::seconds(secs)
}

/// A count or size that is never negative.
fn count(value: i64) -> u64 {
    value.max(0) as u64
}

fn small(value: i64) -> Result<u32> {
    u32::try_from(value).map_err(|_range| internal(format!("{value} is out of range")))
}

fn time(row: &DbRow, column: &str) -> Result<DateTime<Utc>> {
    from_db(row.try_get::<DbTime, _>(column)?)
}

fn optional_time(row: &DbRow, column: &str) -> Result<Option<DateTime<Utc>>> {
    row.try_get::<Option<DbTime>, _>(column)?
        .map(from_db)
        .transpose()
}

fn object_name(row: &DbRow) -> Result<ObjectName> {
    Ok(ObjectName {
        collection: parse(row.try_get("collection")?)?,
        object: parse(row.try_get("object")?)?,
    })
}

fn job_from(row: &DbRow) -> Result<Job> {
    let checkpoint = match row.try_get::<Option<&str>, _>("checkpoint_digest")? {
        Some(digest) => Some(Checkpoint {
            digest: parse(digest)?,
            size_bytes: count(row.try_get("checkpoint_bytes")?),
        }),
        None => None,
    };
    let attempt = Attempt(small(row.try_get("attempt")?)?);
    // An older coordinator leases without a holder and leaves that of an earlier attempt there.
    let holder = match row.try_get::<Option<i64>, _>("holder_attempt")? {
        Some(of) if of == i64::from(attempt.0) => row.try_get("holder")?,
        _ => None,
    };
    Ok(Job {
        id: from_key(row.try_get("id")?)?,
        request_id: row.try_get("request_id")?,
        spec: JobSpec {
            object: object_name(row)?,
            capture_digest: parse(row.try_get("capture_digest")?)?,
            recipe_json: row.try_get("recipe_json")?,
            priority: i32::try_from(row.try_get::<i64, _>("priority")?).map_err(internal)?,
            labels: row.try_get::<Json<_>, _>("labels")?.0,
            max_attempts: small(row.try_get("max_attempts")?)?,
        },
        state: parse(row.try_get("state")?)?,
        attempt,
        attempt_limit: small(row.try_get("attempt_limit")?)?,
        worker: row
            .try_get::<Option<&str>, _>("worker")?
            .map(parse)
            .transpose()?,
        holder,
        cancel_requested: row.try_get("cancel_requested")?,
        progress: row
            .try_get::<Option<Json<Progress>>, _>("progress")?
            .map(|json| json.0),
        failure: row
            .try_get::<Option<Json<Failure>>, _>("failure")?
            .map(|json| json.0),
        checkpoint,
        version: row
            .try_get::<Option<i64>, _>("version")?
            .map(small)
            .transpose()?,
        submitted_at: time(row, "submitted_at")?,
        not_before: time(row, "not_before")?,
        started_at: optional_time(row, "started_at")?,
        finished_at: optional_time(row, "finished_at")?,
        lease_until: optional_time(row, "lease_until")?,
        traceparent: row.try_get("traceparent")?,
    })
}

fn jobs_from(rows: &[DbRow]) -> Result<Vec<Job>> {
    rows.iter().map(job_from).collect()
}

fn version_from(row: &DbRow) -> Result<Version> {
    let mut aliases: Vec<String> = match row.try_get::<Option<&str>, _>("aliases")? {
        Some(list) => list.split(',').map(str::to_owned).collect(),
        None => Vec::new(),
    };
    aliases.sort_unstable();
    Ok(Version {
        object: object_name(row)?,
        version: small(row.try_get("version")?)?,
        bundle: NewVersion {
            manifest_digest: parse(row.try_get("manifest_digest")?)?,
            size_bytes: count(row.try_get("size_bytes")?),
            file_count: small(row.try_get("file_count")?)?,
            metrics_json: row.try_get("metrics_json")?,
        },
        aliases,
        created_at: time(row, "created_at")?,
        job: from_key(row.try_get("job_id")?)?,
        retired: row.try_get("retired")?,
        retired_at: optional_time(row, "retired_at")?,
    })
}

fn collection_from(row: &DbRow) -> Result<Collection> {
    Ok(Collection {
        name: parse(row.try_get("name")?)?,
        weight: row.try_get("weight")?,
        max_running: small(row.try_get("max_running")?)?,
        paused: row.try_get("paused")?,
    })
}

/// The job, its row locked until the transaction ends.
async fn lock_job(connection: &mut Connection, job: JobId) -> Result<Job> {
    let row = sqlx::query(sql(format!("select {JOB} from jobs where id = $1 {LOCK}")))
        .bind(key(job))
        .fetch_optional(connection)
        .await?;
    job_from(&row.ok_or_else(|| StoreError::NotFound {
        kind: "job",
        name: job.to_string(),
    })?)
}

/// Writes jobs back whose rows are locked.
async fn save_jobs(connection: &mut Connection, jobs: &[Job]) -> Result<()> {
    for chunk in jobs.chunks(CHUNK) {
        let mut update = QueryBuilder::<Db>::new(
            "update jobs set state = v.column2, attempt = v.column3, attempt_limit = v.column4, worker = v.column5, \
             cancel_requested = v.column6, progress = v.column7, failure = v.column8, checkpoint_digest = v.column9, \
             checkpoint_bytes = v.column10, version = v.column11, not_before = v.column12, started_at = v.column13, \
             finished_at = v.column14, lease_until = v.column15, holder = v.column16, holder_attempt = v.column17 from (",
        );
        update.push_values(chunk, |mut row, job| {
            let checkpoint = job.checkpoint.as_ref();
            row.push_bind(key(job.id))
                .push_bind(job.state.as_str())
                .push_bind(i64::from(job.attempt.0))
                .push_bind(i64::from(job.attempt_limit))
                .push_bind(job.worker.as_ref().map(WorkerId::as_str))
                .push_bind(job.cancel_requested)
                .push_bind(job.progress.as_ref().map(Json))
                .push_bind(job.failure.as_ref().map(Json))
                .push_bind(checkpoint.map(|it| it.digest.as_str()))
                .push_bind(checkpoint.map(|it| it.size_bytes as i64))
                .push_bind(job.version.map(i64::from))
                .push_bind(to_db(job.not_before))
                .push_bind(job.started_at.map(to_db))
                .push_bind(job.finished_at.map(to_db))
                .push_bind(job.lease_until.map(to_db))
                .push_bind(job.holder.as_deref())
                .push_bind(job.holder.as_ref().map(|_holder| i64::from(job.attempt.0)));
        });
        update
            .push(") v where jobs.id = v.column1")
            .build()
            .execute(&mut *connection)
            .await?;
    }
    Ok(())
}

async fn save_job(connection: &mut Connection, job: &Job) -> Result<()> {
    save_jobs(connection, std::slice::from_ref(job)).await
}

fn refused(job: &Job, attempt: Attempt, refusal: Refusal) -> StoreError {
    match refusal {
        Refusal::LeaseLost => StoreError::LeaseLost {
            job: job.id,
            attempt,
        },
        Refusal::NotAllowed(state) => StoreError::NotAllowed {
            message: format!("job {} is {}", job.id, state.as_str()),
        },
        Refusal::NotYet => StoreError::NotAllowed {
            message: format!("job {} backs off", job.id),
        },
    }
}

/// Adds lines to the log of a job whose row is locked, and lets the oldest go.
async fn append_logs(
    connection: &mut Connection,
    job: JobId,
    attempt: Attempt,
    mut lines: Vec<NewLogLine>,
) -> Result<()> {
    if lines.is_empty() {
        return Ok(());
    }
    let row =
        sqlx::query("select log_seq, log_source_attempt, log_source_seq from jobs where id = $1")
            .bind(key(job))
            .fetch_one(&mut *connection)
            .await?;
    let mut seq: i64 = row.try_get("log_seq")?;
    let known_attempt: i64 = row.try_get("log_source_attempt")?;
    let mut taken = if known_attempt == i64::from(attempt.0) {
        count(row.try_get("log_source_seq")?)
    } else {
        0
    };
    lines.retain(|line| line.source_seq == 0 || line.source_seq > taken);
    if lines.is_empty() {
        return Ok(());
    }
    taken = lines
        .iter()
        .map(|line| line.source_seq)
        .fold(taken, u64::max)
        .min(i64::MAX as u64);
    lines.drain(..lines.len().saturating_sub(MAX_LINES_PER_CALL));
    for chunk in lines.chunks(CHUNK) {
        let mut insert = QueryBuilder::<Db>::new(
            "insert into job_logs (job_id, seq, at, attempt, level, message) ",
        );
        insert.push_values(chunk, |mut row, line| {
            seq += 1;
            let line = check::log_line(line);
            row.push_bind(key(job))
                .push_bind(seq)
                .push_bind(to_db(line.at))
                .push_bind(i64::from(attempt.0))
                .push_bind(level_word(line.level))
                .push_bind(line.message);
        });
        insert.build().execute(&mut *connection).await?;
    }
    sqlx::query("delete from job_logs where job_id = $1 and seq <= $2")
        .bind(key(job))
        .bind(seq - MAX_LOG_LINES as i64)
        .execute(&mut *connection)
        .await?;
    sqlx::query(
        "update jobs set log_seq = $2, log_source_attempt = $3, log_source_seq = $4 where id = $1",
    )
    .bind(key(job))
    .bind(seq)
    .bind(i64::from(attempt.0))
    .bind(taken as i64)
    .execute(connection)
    .await?;
    Ok(())
}

fn level_word(level: Level) -> &'static str {
    match level {
        Level::Info => "info",
        Level::Warn => "warn",
        Level::Error => "error",
    }
}

fn level_from(word: &str) -> Result<Level> {
    match word {
        "info" => Ok(Level::Info),
        "warn" => Ok(Level::Warn),
        "error" => Ok(Level::Error),
        other => Err(internal(format!("unknown level {other:?}"))),
    }
}

/// The condition that a row is of one of these objects.
fn push_objects<'a>(
    query: &mut QueryBuilder<Db>,
    objects: impl IntoIterator<Item = &'a ObjectName>,
) {
    query.push("(collection, object) in (");
    query.push_values(objects, |mut row, object| {
        row.push_bind(object.collection.as_str().to_owned())
            .push_bind(object.object.as_str().to_owned());
    });
    query.push(")");
}

/// Starts a select of versions; the caller adds the condition.
fn select_versions() -> QueryBuilder<Db> {
    QueryBuilder::new(format!(
        "select v.*, (select {ALIAS_LIST} from aliases a where a.collection = v.collection and a.object = v.object \
         and a.version = v.version) as aliases from versions v where true"
    ))
}

/// The version that a reference names.
async fn find_version(
    connection: &mut Connection,
    object: &ObjectName,
    reference: &str,
) -> Result<Version> {
    let mut query = select_versions();
    query
        .push(" and v.collection = ")
        .push_bind(object.collection.as_str());
    query
        .push(" and v.object = ")
        .push_bind(object.object.as_str());
    if let Some(version) = check::version_number(reference) {
        query
            .push(" and v.version = ")
            .push_bind(i64::from(version));
    } else if let Ok(digest) = reference.parse::<Digest>() {
        query
            .push(" and v.manifest_digest = ")
            .push_bind(digest.as_str().to_owned());
    } else {
        let alias = if reference.is_empty() {
            "latest"
        } else {
            reference
        };
        query
            .push(
                " and v.version = (select a.version from aliases a where a.collection = v.collection \
                 and a.object = v.object and a.alias = ",
            )
            .push_bind(alias.to_owned())
            .push(")");
    }
    query.push(" order by v.version desc limit 1");
    let row = query.build().fetch_optional(connection).await?;
    let absent = || {
        let reference = if reference.is_empty() {
            "latest"
        } else {
            reference
        };
        StoreError::NotFound {
            kind: "bundle",
            name: format!("{object}:{reference}"),
        }
    };
    version_from(&row.ok_or_else(absent)?)
}

async fn point_alias(
    connection: &mut Connection,
    object: &ObjectName,
    alias: &str,
    version: u32,
) -> Result<()> {
    point_aliases(connection, alias, [(object, version)]).await
}

/// Points one alias of each of several objects.
async fn point_aliases(
    connection: &mut Connection,
    alias: &str,
    targets: impl IntoIterator<Item = (&ObjectName, u32)>,
) -> Result<()> {
    let mut insert =
        QueryBuilder::<Db>::new("insert into aliases (collection, object, alias, version) ");
    insert.push_values(targets, |mut row, (object, version)| {
        row.push_bind(object.collection.as_str())
            .push_bind(object.object.as_str())
            .push_bind(alias)
            .push_bind(i64::from(version));
    });
    insert
        .push(" on conflict (collection, object, alias) do update set version = excluded.version")
        .build()
        .execute(connection)
        .await?;
    Ok(())
}

async fn insert_versions(connection: &mut Connection, versions: &[Version]) -> Result<()> {
    let mut insert = QueryBuilder::<Db>::new(
        "insert into versions (collection, object, version, manifest_digest, size_bytes, file_count, metrics_json, \
         job_id, created_at, retired, retired_at) ",
    );
    insert.push_values(versions, |mut row, version| {
        row.push_bind(version.object.collection.as_str())
            .push_bind(version.object.object.as_str())
            .push_bind(i64::from(version.version))
            .push_bind(version.bundle.manifest_digest.as_str())
            .push_bind(version.bundle.size_bytes as i64)
            .push_bind(i64::from(version.bundle.file_count))
            .push_bind(version.bundle.metrics_json.as_str())
            .push_bind(key(version.job))
            .push_bind(to_db(version.created_at))
            .push_bind(version.retired)
            .push_bind(version.retired_at.map(to_db));
    });
    insert.build().execute(connection).await?;
    Ok(())
}

/// Takes a version out of listings, or puts it back.
async fn set_retired(
    connection: &mut Connection,
    object: &ObjectName,
    version: u32,
    at: Option<DateTime<Utc>>,
) -> Result<()> {
    sqlx::query(
        "update versions set retired = $4, retired_at = $5 where collection = $1 and object = $2 and version = $3",
    )
    .bind(object.collection.as_str())
    .bind(object.object.as_str())
    .bind(i64::from(version))
    .bind(at.is_some())
    .bind(at.map(to_db))
    .execute(connection)
    .await?;
    Ok(())
}

/// Points `latest` to the newest version that is listed.
async fn point_latest(connection: &mut Connection, object: &ObjectName) -> Result<()> {
    let newest: Option<i64> = sqlx::query_scalar(
        "select max(version) from versions where collection = $1 and object = $2 and not retired",
    )
    .bind(object.collection.as_str())
    .bind(object.object.as_str())
    .fetch_one(&mut *connection)
    .await?;
    if let Some(newest) = newest {
        return point_alias(connection, object, LATEST, small(newest)?).await;
    }
    sqlx::query("delete from aliases where collection = $1 and object = $2 and alias = $3")
        .bind(object.collection.as_str())
        .bind(object.object.as_str())
        .bind(LATEST)
        .execute(connection)
        .await?;
    Ok(())
}

/// Orders whatever changes the versions and aliases of one object.
async fn lock_object(connection: &mut Connection, object: &ObjectName) -> Result<()> {
    sqlx::query(sql(format!(
        "select last_version from objects where collection = $1 and object = $2 {LOCK}"
    )))
    .bind(object.collection.as_str())
    .bind(object.object.as_str())
    .fetch_optional(connection)
    .await?;
    Ok(())
}

impl SqlStore {
    pub(super) fn new(backend: Backend, signal: Arc<Signal>, settings: Settings) -> Self {
        Self {
            backend,
            signal,
            settings,
            leases: Group::new(GROUPS_AT_ONCE),
            publishes: Group::new(GROUPS_AT_ONCE),
            lookups: Group::new(GROUPS_AT_ONCE),
        }
    }

    async fn begin(&self) -> Result<(Transaction<'static, Db>, DateTime<Utc>)> {
        let mut transaction = self.backend.begin().await?;
        let now = Backend::now(&mut transaction).await?;
        Ok((transaction, now))
    }

    /// Commits what `outcome` says went well and tells of it; rolls back otherwise. Not left to the transaction's drop,
    /// which only schedules the rollback: until then its locks would hide rows from claims.
    async fn finish<T: Send>(
        &self,
        transaction: Transaction<'static, Db>,
        outcome: Result<T>,
        change: Change,
    ) -> Result<T> {
        if outcome.is_ok() {
            transaction.commit().await.map_err(from_commit)?;
            self.signal.raise(change);
        } else if let Err(error) = transaction.rollback().await {
            tracing::debug!(%error, "a rollback failed; the server does it when the connection closes");
        }
        outcome
    }

    /// One transition of one job on request of a user.
    async fn change(
        &self,
        job: JobId,
        transition: impl FnOnce(&mut Job, DateTime<Utc>) -> std::result::Result<(), Refusal> + Send,
    ) -> Result<Job> {
        let (mut transaction, now) = self.begin().await?;
        let outcome = async {
            let mut job = lock_job(&mut transaction, job).await?;
            let (attempt, had_ended) = (job.attempt, job.state.is_terminal());
            transition(&mut job, now).map_err(|refusal| refused(&job, attempt, refusal))?;
            save_job(&mut transaction, &job).await?;
            if !had_ended {
                announce(&mut transaction, [(&job, None)], now).await?;
            }
            Ok(job)
        }
        .await;
        self.finish(transaction, outcome, Change::Work).await
    }

    /// Queues requests that were checked, sorted by their key so that concurrent batches lock in one order.
    async fn insert_jobs(
        &self,
        requests: &[(usize, JobId, Submit)],
    ) -> Result<Vec<(usize, Result<Job>)>> {
        let (mut transaction, now) = self.begin().await?;
        let outcome = async {
        let mut names: Vec<&str> = requests
            .iter()
            .map(|(_, _, request)| request.spec.object.collection.as_str())
            .collect();
        names.dedup();
        let mut insert = QueryBuilder::<Db>::new("insert into collections (name) ");
        insert.push_values(names, |mut row, name| {
            row.push_bind(name);
        });
        insert
            .push(" on conflict do nothing")
            .build()
            .execute(&mut *transaction)
            .await?;

        let mut insert = QueryBuilder::<Db>::new(
            "insert into jobs (id, collection, object, request_id, capture_digest, recipe_json, priority, labels, \
             max_attempts, state, attempt, attempt_limit, cancel_requested, submitted_at, not_before, traceparent) ",
        );
        insert.push_values(requests, |mut row, (_, id, request)| {
            let job = Job::submit(*id, request.request_id.clone(), request.spec.clone(), now);
            row.push_bind(key(job.id))
                .push_bind(job.spec.object.collection.as_str())
                .push_bind(job.spec.object.object.as_str())
                .push_bind(job.request_id.as_str())
                .push_bind(job.spec.capture_digest.as_str())
                .push_bind(job.spec.recipe_json.as_str())
                .push_bind(i64::from(job.spec.priority))
                .push_bind(Json(&job.spec.labels))
                .push_bind(i64::from(job.spec.max_attempts))
                .push_bind(job.state.as_str())
                .push_bind(i64::from(job.attempt.0))
                .push_bind(i64::from(job.attempt_limit))
                .push_bind(job.cancel_requested)
                .push_bind(to_db(job.submitted_at))
                .push_bind(to_db(job.not_before))
                .push_bind(request.traceparent.as_deref());
        });
        insert
            .push(" on conflict (collection, request_id) do nothing")
            .build()
            .execute(&mut *transaction)
            .await?;

        let mut select = QueryBuilder::<Db>::new(format!(
            "select {JOB} from jobs where (collection, request_id) in ("
        ));
        select.push_values(requests, |mut row, (_, _, request)| {
            row.push_bind(request.spec.object.collection.as_str())
                .push_bind(request.request_id.as_str());
        });
        let rows = select
            .push(")")
            .build()
            .fetch_all(&mut *transaction)
            .await?;
        jobs_from(&rows)
        }
        .await;
        let stored = self.finish(transaction, outcome, Change::Work).await?;

        let mut jobs = BTreeMap::new();
        for job in stored {
            jobs.insert(
                (job.spec.object.collection.clone(), job.request_id.clone()),
                job,
            );
        }
        let outcome = |request: &Submit| {
            let at = (
                request.spec.object.collection.clone(),
                request.request_id.clone(),
            );
            match jobs.get(&at) {
                Some(job) if job.spec == request.spec => Ok(job.clone()),
                Some(_) => Err(StoreError::Conflict {
                    key: request.request_id.clone(),
                }),
                None => Err(internal("a job vanished while it was submitted")),
            }
        };
        Ok(requests
            .iter()
            .map(|(index, _, request)| (*index, outcome(request)))
            .collect())
    }

    /// Notes that workers are there; answers which of them drain. Those that were seen a moment ago cost a read alone.
    async fn touch_workers(
        &self,
        reader: &mut Connection,
        workers: BTreeMap<WorkerId, WorkerInfo>,
        now: DateTime<Utc>,
    ) -> Result<BTreeSet<WorkerId>> {
        let mut select = QueryBuilder::<Db>::new("select * from workers where id in (");
        let mut ids = select.separated(", ");
        for id in workers.keys() {
            ids.push_bind(id.as_str());
        }
        let rows = select.push(")").build().fetch_all(reader).await?;
        let mut draining = BTreeSet::new();
        let mut stale = workers;
        for row in rows {
            let known = worker_from(&row)?;
            let fresh = time(&row, "last_seen_at")? + seconds(WORKER_FRESH_SECS) > now;
            if row.try_get("draining")? {
                draining.insert(known.id.clone());
            }
            if fresh && stale.get(&known.id) == Some(&known) {
                stale.remove(&known.id);
            }
        }
        if stale.is_empty() {
            return Ok(draining);
        }
        let mut insert = QueryBuilder::<Db>::new(
            "insert into workers (id, hostname, version, device, last_seen_at) ",
        );
        insert.push_values(stale.values(), |mut row, worker| {
            row.push_bind(worker.id.as_str())
                .push_bind(worker.hostname.as_str())
                .push_bind(worker.version.as_str())
                .push_bind(worker.device.as_str())
                .push_bind(to_db(now));
        });
        insert.push(
            " on conflict (id) do update set hostname = excluded.hostname, version = excluded.version, \
             device = excluded.device, last_seen_at = excluded.last_seen_at",
        );
        let mut transaction = self.backend.begin().await?;
        insert.build().execute(&mut *transaction).await?;
        transaction.commit().await.map_err(from_commit)?;
        Ok(draining)
    }

    /// The next jobs for some workers, each as if it had asked alone, in their order.
    async fn lease_all(&self, asks: &[LeaseAsk]) -> Result<Vec<Option<Job>>> {
        let mut reader = self.backend.reader().acquire().await?;
        let now = Backend::now(&mut reader).await?;
        let workers = asks
            .iter()
            .map(|ask| (ask.worker.id.clone(), check::worker(&ask.worker)))
            .collect();
        let draining = self.touch_workers(&mut reader, workers, now).await?;
        let mut queues = waiting_queues(&mut reader, now).await?;
        drop(reader);
        let served = |ask: &LeaseAsk, queues: &[Queue]| {
            !draining.contains(&ask.worker.id) && queues.iter().any(|queue| ask.takes_from(queue))
        };
        if !asks.iter().any(|ask| served(ask, &queues)) {
            return Ok(asks.iter().map(|_| None).collect());
        }
        let (mut transaction, now) = self.begin().await?;
        let outcome = async {
            lock_limited(&mut transaction, &mut queues).await?;
            queues.retain(|queue| queue.room > 0);
            let (mut leased, mut answers) = (Vec::new(), Vec::new());
            for (index, ask) in asks.iter().enumerate() {
                if !served(ask, &queues) {
                    answers.push(None);
                    continue;
                }
                let left = asks.len() - index;
                let next = next_job(&mut transaction, &mut queues, ask, left, now).await?;
                answers.push(next.as_ref().map(|_| leased.len()));
                if let Some(mut job) = next {
                    let attempt = job.attempt;
                    job.lease(
                        ask.worker.id.clone(),
                        ask.holder.clone(),
                        now,
                        self.settings.lease,
                    )
                    .map_err(|refusal| refused(&job, attempt, refusal))?;
                    leased.push(job);
                }
            }
            save_jobs(&mut transaction, &leased).await?;
            note_served(&mut transaction, &leased, now).await?;
            Ok((leased, answers))
        }
        .await;
        let change = match &outcome {
            // Others may have passed over jobs that were locked here.
            Ok(_) if queues.iter().any(Queue::holds_jobs) => Change::Work,
            Ok((leased, _)) if !leased.is_empty() => Change::Job,
            _ => Change::Nothing,
        };
        let (leased, answers) = self.finish(transaction, outcome, change).await?;
        Ok(answers
            .into_iter()
            .map(|at| at.map(|at: usize| leased[at].clone()))
            .collect())
    }

    /// Publishes bundles of several jobs and ends the jobs. With a `lock` that skips rows which somebody holds, those are
    /// answered with none, as is what cannot share a transaction with the others.
    async fn publish_all(
        &self,
        asks: &[PublishAsk],
        lock: &str,
    ) -> Result<Vec<Option<Result<Version>>>> {
        let (mut transaction, now) = self.begin().await?;
        let outcome = async {
            let mut jobs =
                lock_jobs(&mut transaction, asks.iter().map(|ask| ask.job), lock).await?;
            let mut answers: Vec<Option<Result<Version>>> = Vec::new();
            let mut holding = Vec::new();
            for ask in asks {
                let Some(job) = jobs.remove(&ask.job) else {
                    answers.push(None);
                    continue;
                };
                let again = match job.version {
                    Some(version) if job.attempt == ask.attempt => {
                        let reference = format!("v{version}");
                        let published =
                            find_version(&mut transaction, &job.spec.object, &reference).await?;
                        Some(published)
                            .filter(|it| it.bundle.manifest_digest == ask.bundle.manifest_digest)
                    }
                    _ => None,
                };
                answers.push(match (again, job.holds(ask.attempt)) {
                    (Some(published), _) => Some(Ok(published)),
                    (None, Err(refusal)) => Some(Err(refused(&job, ask.attempt, refusal))),
                    (None, Ok(())) => {
                        holding.push((answers.len(), job));
                        None
                    }
                });
            }
            let objects = holding.iter().map(|(_, job)| &job.spec.object).collect();
            let mut last = lock_objects(&mut transaction, objects, lock).await?;
            let (mut versions, mut ended) = (Vec::new(), Vec::new());
            for (index, mut job) in holding {
                let Some(last) = last.get_mut(&job.spec.object) else {
                    continue;
                };
                *last += 1;
                let ask = &asks[index];
                job.complete(ask.attempt, *last, now)
                    .map_err(|refusal| refused(&job, ask.attempt, refusal))?;
                versions.push((
                    index,
                    Version {
                        object: job.spec.object.clone(),
                        version: *last,
                        bundle: ask.bundle.clone(),
                        aliases: Vec::new(),
                        created_at: now,
                        job: job.id,
                        retired: false,
                        retired_at: None,
                    },
                ));
                ended.push(job);
            }
            let (indices, mut versions): (Vec<usize>, Vec<Version>) = versions.into_iter().unzip();
            if !versions.is_empty() {
                let newest: BTreeMap<&ObjectName, u32> =
                    versions.iter().map(|it| (&it.object, it.version)).collect();
                advance_objects(&mut transaction, &newest).await?;
                insert_versions(&mut transaction, &versions).await?;
                let latest = newest.iter().map(|(object, version)| (*object, *version));
                point_aliases(&mut transaction, LATEST, latest).await?;
                save_jobs(&mut transaction, &ended).await?;
                let bundles = versions.iter().map(|version| Some(&version.bundle));
                announce(&mut transaction, ended.iter().zip(bundles), now).await?;
                for version in &mut versions {
                    if last.get(&version.object) == Some(&version.version) {
                        version.aliases.push(LATEST.to_owned());
                    }
                }
            }
            for (index, version) in indices.into_iter().zip(versions) {
                answers[index] = Some(Ok(version));
            }
            Ok(answers)
        }
        .await;
        self.finish(transaction, outcome, Change::Work).await
    }

    /// What may change of each of several objects.
    async fn standings(&self, objects: &[ObjectName]) -> Result<Vec<Standing>> {
        let mut query = QueryBuilder::<Db>::new(
            "select collection, object, alias, version, null as retired_at from aliases where ",
        );
        push_objects(&mut query, objects);
        query.push(
            " union all select collection, object, null, version, retired_at from versions where retired and ",
        );
        push_objects(&mut query, objects);
        let mut found: BTreeMap<ObjectName, Standing> = BTreeMap::new();
        for row in query.build().fetch_all(self.backend.reader()).await? {
            let standing = found.entry(object_name(&row)?).or_default();
            let version = small(row.try_get("version")?)?;
            if let Some(alias) = row.try_get::<Option<String>, _>("alias")? {
                standing.aliases.insert(alias, version);
            } else {
                let retired_at = optional_time(&row, "retired_at")?;
                standing.retired.insert(version, retired_at);
            }
        }
        let of = |object| found.get(object).cloned().unwrap_or_default();
        Ok(objects.iter().map(of).collect())
    }

    /// Takes back leases that ran out, at most [`REAP_BATCH`], and forgets workers that are long gone.
    async fn reap_batch(&self) -> Result<Vec<Job>> {
        let (mut transaction, now) = self.begin().await?;
        let outcome = async {
            let rows = sqlx::query(sql(format!(
                "select {JOB} from jobs where state = 'leased' and lease_until <= $1 order by lease_until \
                 limit {REAP_BATCH} {LOCK_FREE_ROWS}"
            )))
            .bind(to_db(now))
            .fetch_all(&mut *transaction)
            .await?;
            let mut jobs = jobs_from(&rows)?;
            for job in &mut jobs {
                job.expire(now);
            }
            save_jobs(&mut transaction, &jobs).await?;
            announce(&mut transaction, jobs.iter().map(|job| (job, None)), now).await?;
            sqlx::query("delete from workers where last_seen_at < $1")
                .bind(to_db(now - seconds(WORKER_KEPT_SECS)))
                .execute(&mut *transaction)
                .await?;
            Ok(jobs)
        }
        .await;
        let change = match &outcome {
            Ok(jobs) if !jobs.is_empty() => Change::Work,
            _ => Change::Nothing,
        };
        self.finish(transaction, outcome, change).await
    }
}

/// A worker that asks for a job. Asked twice it may get a second one; the first one's lease then runs out.
#[derive(Clone, Debug)]
struct LeaseAsk {
    worker: WorkerInfo,
    holder: Option<String>,
    within: Option<BTreeSet<CollectionId>>,
}

impl LeaseAsk {
    fn takes_from(&self, queue: &Queue) -> bool {
        let name = &queue.collection.name;
        self.within
            .as_ref()
            .is_none_or(|within| within.contains(name))
    }
}

/// A worker that ends a job with a bundle.
#[derive(Clone, Debug)]
struct PublishAsk {
    job: JobId,
    attempt: Attempt,
    bundle: NewVersion,
}

/// A collection with something to lease.
#[derive(Debug)]
struct Queue {
    collection: Collection,
    running: u64,
    served_at: Option<DateTime<Utc>>,
    /// How many more jobs it may run.
    room: u64,
    /// Priority, age and id of its next job.
    head: (i64, DateTime<Utc>, JobId),
    /// Its next jobs, once their rows are locked.
    locked: Option<VecDeque<Job>>,
}

impl Queue {
    /// Which of two is served first: priority, then the fewest running jobs for the weight, then the one served longest
    /// ago, then age.
    fn before(&self, other: &Self) -> Ordering {
        let share = |queue: &Self| queue.running as f64 / queue.collection.weight;
        let age = |queue: &Self| (queue.head.1, queue.head.2);
        other
            .head
            .0
            .cmp(&self.head.0)
            .then_with(|| share(self).total_cmp(&share(other)))
            .then_with(|| self.served_at.cmp(&other.served_at))
            .then_with(|| age(self).cmp(&age(other)))
    }

    fn take_head(&mut self) {
        if let Some(job) = self.locked.as_ref().and_then(VecDeque::front) {
            self.head = (i64::from(job.spec.priority), job.submitted_at, job.id);
        }
    }

    fn holds_jobs(&self) -> bool {
        self.locked.as_ref().is_some_and(|jobs| !jobs.is_empty())
    }
}

/// Collections that may run one more of their queued jobs.
async fn waiting_queues(reader: &mut Connection, now: DateTime<Utc>) -> Result<Vec<Queue>> {
    // Three looks at the top of one index: a join would be planned as a read of the whole table.
    let head = |column: &str| {
        format!(
            "(select q.{column} from jobs q where q.collection = c.name and q.state = 'queued' and q.not_before <= $1 \
             order by q.priority desc, q.submitted_at, q.id limit 1) as {column}"
        )
    };
    let rows = sqlx::query(sql(format!(
        "select c.*, {}, {}, {}, \
         (select count(*) from jobs r where r.collection = c.name and r.state = 'leased') as running \
         from collections c where not c.paused",
        head("priority"),
        head("submitted_at"),
        head("id"),
    )))
    .bind(to_db(now))
    .fetch_all(reader)
    .await?;
    let mut queues = Vec::new();
    for row in rows {
        let Some(priority) = row.try_get::<Option<i64>, _>("priority")? else {
            continue;
        };
        let (collection, running) = (collection_from(&row)?, count(row.try_get("running")?));
        let queue = Queue {
            room: room(&collection, running),
            collection,
            running,
            served_at: optional_time(&row, "served_at")?,
            head: (
                priority,
                time(&row, "submitted_at")?,
                from_key(row.try_get("id")?)?,
            ),
            locked: None,
        };
        if queue.room > 0 {
            queues.push(queue);
        }
    }
    Ok(queues)
}

/// How many more jobs a collection may run.
fn room(settings: &Collection, running: u64) -> u64 {
    match (settings.paused, settings.max_running) {
        (true, _) => 0,
        (false, 0) => u64::MAX,
        (false, limit) => u64::from(limit).saturating_sub(running),
    }
}

/// Locks the rows of collections that have a limit, all of them before any job and in the order of their names, and looks
/// again how much room there is: two claims must not both take the last place. The others are not held up.
async fn lock_limited(connection: &mut Connection, queues: &mut [Queue]) -> Result<()> {
    let mut limited: BTreeMap<CollectionId, &mut Queue> = queues
        .iter_mut()
        .filter(|queue| queue.collection.max_running > 0)
        .map(|queue| (queue.collection.name.clone(), queue))
        .collect();
    if limited.is_empty() {
        return Ok(());
    }
    let mut select = QueryBuilder::<Db>::new("select * from collections where name in (");
    let mut names = select.separated(", ");
    for name in limited.keys() {
        names.push_bind(name.as_str());
    }
    select.push(") order by name ").push(LOCK);
    let rows = select.build().fetch_all(&mut *connection).await?;
    let mut select = QueryBuilder::<Db>::new(
        "select collection, count(*) as running from jobs where state = 'leased' and collection in (",
    );
    let mut names = select.separated(", ");
    for name in limited.keys() {
        names.push_bind(name.as_str());
    }
    select.push(") group by collection");
    let mut running: BTreeMap<CollectionId, u64> = BTreeMap::new();
    for row in select.build().fetch_all(connection).await? {
        let name = parse(row.try_get("collection")?)?;
        running.insert(name, count(row.try_get("running")?));
    }
    for row in rows {
        let settings = collection_from(&row)?;
        if let Some(queue) = limited.get_mut(&settings.name) {
            queue.running = running.get(&settings.name).copied().unwrap_or(0);
            queue.room = room(&settings, queue.running);
        }
    }
    Ok(())
}

/// The next job for a worker, its row locked; `at_most` jobs are wanted in this transaction from now on. A queue from
/// which nothing more can be taken is dropped.
async fn next_job(
    connection: &mut Connection,
    queues: &mut Vec<Queue>,
    ask: &LeaseAsk,
    at_most: usize,
    now: DateTime<Utc>,
) -> Result<Option<Job>> {
    loop {
        let first = (0..queues.len())
            .filter(|&at| ask.takes_from(&queues[at]))
            .min_by(|&a, &b| queues[a].before(&queues[b]));
        let Some(at) = first else { return Ok(None) };
        let queue = &mut queues[at];
        let Some(jobs) = &mut queue.locked else {
            let (name, room) = (&queue.collection.name, queue.room.min(at_most as u64));
            queue.locked = Some(lock_queued(connection, name, room, now).await?);
            queue.take_head();
            continue;
        };
        let Some(job) = jobs.pop_front() else {
            queues.remove(at);
            continue;
        };
        queue.running += 1;
        queue.served_at = Some(now);
        queue.take_head();
        return Ok(Some(job));
    }
}

/// Notes that jobs of these collections were leased now, except where somebody else is about to do the same.
async fn note_served(connection: &mut Connection, jobs: &[Job], now: DateTime<Utc>) -> Result<()> {
    let collections: BTreeSet<&str> = jobs
        .iter()
        .map(|job| job.spec.object.collection.as_str())
        .collect();
    if collections.is_empty() {
        return Ok(());
    }
    let mut update = QueryBuilder::<Db>::new("update collections set served_at = ");
    update.push_bind(to_db(now));
    update.push(" where name in (select name from collections where name in (");
    let mut names = update.separated(", ");
    for name in collections {
        names.push_bind(name);
    }
    update.push(") order by name ").push(LOCK_FREE_ROWS);
    update.push(")").build().execute(connection).await?;
    Ok(())
}

/// The first jobs of a collection that nobody else is about to take.
async fn lock_queued(
    connection: &mut Connection,
    collection: &CollectionId,
    at_most: u64,
    now: DateTime<Utc>,
) -> Result<VecDeque<Job>> {
    let rows = sqlx::query(sql(format!(
        "select {JOB} from jobs where collection = $1 and state = 'queued' and not_before <= $2 \
         order by priority desc, submitted_at, id limit $3 {LOCK_FREE_ROWS}"
    )))
    .bind(collection.as_str())
    .bind(to_db(now))
    .bind(at_most as i64)
    .fetch_all(connection)
    .await?;
    Ok(jobs_from(&rows)?.into())
}

/// Jobs by id, their rows locked until the transaction ends.
async fn lock_jobs(
    connection: &mut Connection,
    jobs: impl IntoIterator<Item = JobId>,
    lock: &str,
) -> Result<BTreeMap<JobId, Job>> {
    let mut select = QueryBuilder::<Db>::new(format!("select {JOB} from jobs where id in ("));
    let mut ids = select.separated(", ");
    for job in jobs {
        ids.push_bind(key(job));
    }
    select.push(") order by id ").push(lock);
    let rows = select.build().fetch_all(connection).await?;
    let jobs = jobs_from(&rows)?;
    Ok(jobs.into_iter().map(|job| (job.id, job)).collect())
}

/// The newest version numbers of objects, their rows locked until the transaction ends and made where they are missing.
async fn lock_objects(
    connection: &mut Connection,
    mut objects: BTreeSet<&ObjectName>,
    lock: &str,
) -> Result<BTreeMap<ObjectName, u32>> {
    let mut last = lock_known_objects(connection, &objects, lock).await?;
    objects.retain(|object| !last.contains_key(*object));
    if objects.is_empty() {
        return Ok(last);
    }
    let mut insert =
        QueryBuilder::<Db>::new("insert into objects (collection, object, last_version) ");
    insert.push_values(&objects, |mut row, object| {
        row.push_bind(object.collection.as_str())
            .push_bind(object.object.as_str())
            .push("0");
    });
    insert.push(" on conflict (collection, object) do nothing returning collection, object");
    for row in insert.build().fetch_all(&mut *connection).await? {
        last.insert(object_name(&row)?, 0);
    }
    objects.retain(|object| !last.contains_key(*object));
    // Others made them meanwhile, or hold them.
    last.extend(lock_known_objects(connection, &objects, lock).await?);
    Ok(last)
}

async fn lock_known_objects(
    connection: &mut Connection,
    objects: &BTreeSet<&ObjectName>,
    lock: &str,
) -> Result<BTreeMap<ObjectName, u32>> {
    if objects.is_empty() {
        return Ok(BTreeMap::new());
    }
    let mut select = QueryBuilder::<Db>::new("select * from objects where ");
    push_objects(&mut select, objects.iter().copied());
    select.push(" order by collection, object ").push(lock);
    let rows = select.build().fetch_all(connection).await?;
    rows.iter()
        .map(|row| Ok((object_name(row)?, small(row.try_get("last_version")?)?)))
        .collect()
}

/// Writes the newest version numbers of objects whose rows are locked.
async fn advance_objects(
    connection: &mut Connection,
    newest: &BTreeMap<&ObjectName, u32>,
) -> Result<()> {
    let mut update = QueryBuilder::<Db>::new("update objects set last_version = v.column3 from (");
    update.push_values(newest, |mut row, (object, version)| {
        row.push_bind(object.collection.as_str())
            .push_bind(object.object.as_str())
            .push_bind(i64::from(*version));
    });
    update
        .push(") v where objects.collection = v.column1 and objects.object = v.column2")
        .build()
        .execute(connection)
        .await?;
    Ok(())
}

/// A collection and how many jobs wait in it.
#[derive(Debug)]
struct QueueCounts {
    collection: Collection,
    running: u64,
    by_priority: BTreeMap<i64, u64>,
}

async fn all_queues(reader: &mut Connection) -> Result<BTreeMap<CollectionId, QueueCounts>> {
    let rows = sqlx::query(
        "select c.*, (select count(*) from jobs j where j.collection = c.name and j.state = 'leased') as running \
         from collections c",
    )
    .fetch_all(&mut *reader)
    .await?;
    let mut queues = BTreeMap::new();
    for row in rows {
        let collection = collection_from(&row)?;
        let counts = QueueCounts {
            running: count(row.try_get("running")?),
            by_priority: BTreeMap::new(),
            collection,
        };
        queues.insert(counts.collection.name.clone(), counts);
    }
    let rows = sqlx::query(
        "select collection, priority, count(*) as jobs from jobs where state = 'queued' group by collection, priority",
    )
    .fetch_all(reader)
    .await?;
    for row in rows {
        let name: CollectionId = parse(row.try_get("collection")?)?;
        if let Some(queue) = queues.get_mut(&name) {
            let jobs = count(row.try_get("jobs")?);
            queue.by_priority.insert(row.try_get("priority")?, jobs);
        }
    }
    Ok(queues)
}

/// Where a job stands among the queued ones.
fn queue_place(job: &Job) -> (CollectionId, i32, DateTime<Utc>, JobId) {
    (
        job.spec.object.collection.clone(),
        job.spec.priority,
        job.submitted_at,
        job.id,
    )
}

/// For each of some queued jobs, sorted by [`queue_place`], how many of the same collection and priority are older. Each
/// stretch of the queue between two of them is counted once.
async fn older_equals(reader: &mut Connection, jobs: &[&Job]) -> Result<BTreeMap<JobId, u64>> {
    let mut between = BTreeMap::new();
    let before = std::iter::once(None).chain(jobs.iter().copied().map(Some));
    let stretches: Vec<_> = before.zip(jobs.iter().copied()).collect();
    let same_queue = |before: Option<&Job>, job: &Job| {
        let queue = |job: &Job| (job.spec.object.collection.clone(), job.spec.priority);
        before.is_some_and(|before| queue(before) == queue(job))
    };
    for chunk in stretches.chunks(CHUNK) {
        let mut select = QueryBuilder::<Db>::new(
            "select v.column1 as id, (select count(*) from jobs j where j.state = 'queued' and j.collection = v.column2 \
             and j.priority = v.column3 and (j.submitted_at, j.id) >= (v.column4, v.column5) \
             and (j.submitted_at, j.id) < (v.column6, v.column1)) as jobs from (",
        );
        select.push_values(chunk, |mut row, (before, job)| {
            let from = before.filter(|_| same_queue(*before, job));
            row.push_bind(key(job.id))
                .push_bind(job.spec.object.collection.as_str())
                .push_bind(i64::from(job.spec.priority))
                .push_bind(to_db(
                    from.map_or(DateTime::UNIX_EPOCH, |job| job.submitted_at),
                ))
                .push_bind(key(from.map_or(uuid::Uuid::nil().into(), |job| job.id)))
                .push_bind(to_db(job.submitted_at));
        });
        for row in select.push(") v").build().fetch_all(&mut *reader).await? {
            between.insert(from_key(row.try_get("id")?)?, count(row.try_get("jobs")?));
        }
    }
    let mut older = BTreeMap::new();
    for (before, job) in stretches {
        let so_far = before
            .filter(|_| same_queue(before, job))
            .and_then(|before: &Job| older.get(&before.id))
            .copied()
            .unwrap_or(0);
        older.insert(job.id, so_far + between.get(&job.id).copied().unwrap_or(0));
    }
    Ok(older)
}

fn select_jobs(collection: Option<&CollectionId>, state: JobState) -> QueryBuilder<Db> {
    let mut query = QueryBuilder::new(format!(
        "select {JOB} from jobs where state = '{}'",
        state.as_str()
    ));
    if let Some(collection) = collection {
        query
            .push(" and collection = ")
            .push_bind(collection.as_str().to_owned());
    }
    query
}

fn worker_from(row: &DbRow) -> Result<WorkerInfo> {
    Ok(WorkerInfo {
        id: parse(row.try_get("id")?)?,
        hostname: row.try_get("hostname")?,
        version: row.try_get("version")?,
        device: row.try_get("device")?,
    })
}

async fn list_workers(connection: &mut Connection, now: DateTime<Utc>) -> Result<Vec<Worker>> {
    let rows = sqlx::query(
        "select worker, id from jobs where state = 'leased' order by started_at desc, id desc",
    )
    .fetch_all(&mut *connection)
    .await?;
    let mut running: BTreeMap<Option<String>, Vec<_>> = BTreeMap::new();
    for row in rows {
        let jobs = running.entry(row.try_get("worker")?).or_default();
        jobs.push(from_key(row.try_get("id")?)?);
    }
    let rows = sqlx::query("select * from workers where last_seen_at > $1 order by id")
        .bind(to_db(now - seconds(WORKER_LISTED_SECS)))
        .fetch_all(connection)
        .await?;
    rows.iter()
        .map(|row| {
            let info = worker_from(row)?;
            Ok(Worker {
                last_seen_at: time(row, "last_seen_at")?,
                jobs: running
                    .remove(&Some(info.id.to_string()))
                    .unwrap_or_default(),
                draining: row.try_get("draining")?,
                info,
            })
        })
        .collect()
}

#[async_trait]
impl Store for SqlStore {
    fn settings(&self) -> Settings {
        self.settings
    }

    fn changes(&self) -> Changes {
        self.signal.subscribe()
    }

    fn work(&self) -> Changes {
        self.signal.subscribe_work()
    }

    async fn ping(&self) -> Result<()> {
        sqlx::query("select 1")
            .execute(self.backend.reader())
            .await?;
        Ok(())
    }

    async fn submit_batch(&self, requests: Vec<Submit>) -> Result<Vec<Result<Job>>> {
        let mut results: Vec<Option<Result<Job>>> = Vec::new();
        let mut accepted = Vec::new();
        for (index, request) in requests.into_iter().enumerate() {
            match check::submit(request) {
                Ok(request) => {
                    accepted.push((index, JobId::generate(), request));
                    results.push(None);
                }
                Err(error) => results.push(Some(Err(error))),
            }
        }
        accepted.sort_by(|(_, _, a), (_, _, b)| {
            (&a.spec.object.collection, &a.request_id)
                .cmp(&(&b.spec.object.collection, &b.request_id))
        });
        for (done, chunk) in accepted.chunks(CHUNK).enumerate() {
            match self.insert_jobs(chunk).await {
                Ok(inserted) => {
                    for (index, result) in inserted {
                        results[index] = Some(result);
                    }
                }
                Err(StoreError::Unavailable {
                    source,
                    determinate,
                }) => {
                    return Err(StoreError::Unavailable {
                        source,
                        determinate: determinate && done == 0,
                    });
                }
                Err(error) => return Err(error),
            }
        }
        let unanswered = || Err(internal("a submit was not answered"));
        Ok(results
            .into_iter()
            .map(|result| result.unwrap_or_else(unanswered))
            .collect())
    }

    async fn get(&self, job: JobId) -> Result<Job> {
        let row = sqlx::query(sql(format!("select {JOB} from jobs where id = $1")))
            .bind(key(job))
            .fetch_optional(self.backend.reader())
            .await?;
        job_from(&row.ok_or_else(|| StoreError::NotFound {
            kind: "job",
            name: job.to_string(),
        })?)
    }

    async fn find(&self, prefix: &str) -> Result<Job> {
        let (first, last) = check::id_range(prefix)?;
        let rows = sqlx::query(sql(format!(
            "select {JOB} from jobs where id >= $1 and id <= $2 limit 2"
        )))
        .bind(key(first.into()))
        .bind(key(last.into()))
        .fetch_all(self.backend.reader())
        .await?;
        match &rows[..] {
            [] => Err(StoreError::NotFound {
                kind: "job",
                name: prefix.to_owned(),
            }),
            [row] => job_from(row),
            _ => Err(StoreError::Invalid {
                field: "job_id",
                message: format!("several jobs start with {prefix}; give more of the id"),
            }),
        }
    }

    async fn list(&self, filter: &JobFilter, after: Option<JobId>, limit: u32) -> Result<JobPage> {
        let limit = limit.clamp(1, MAX_PAGE) as usize;
        let mut query = QueryBuilder::<Db>::new(format!("select {JOB} from jobs where true"));
        if let Some(collection) = &filter.collection {
            query
                .push(" and collection = ")
                .push_bind(collection.as_str());
        }
        if let Some(object) = &filter.object {
            query.push(" and object = ").push_bind(object.as_str());
        }
        if !filter.states.is_empty() {
            let words: Vec<String> = filter
                .states
                .iter()
                .map(|state| format!("'{}'", state.as_str()))
                .collect();
            query.push(format!(" and state in ({})", words.join(", ")));
        }
        for (label, value) in &filter.labels {
            query.push(" and ");
            push_label(&mut query, label, value);
        }
        if let Some(after) = after {
            query.push(" and id < ").push_bind(key(after));
        }
        query
            .push(" order by id desc limit ")
            .push_bind(limit as i64 + 1);
        let mut jobs = jobs_from(&query.build().fetch_all(self.backend.reader()).await?)?;
        let more = jobs.len() > limit;
        jobs.truncate(limit);
        let next = if more {
            jobs.last().map(|job| job.id)
        } else {
            None
        };
        Ok(JobPage { jobs, next })
    }

    async fn all_waiting(&self, jobs: &[Job]) -> Result<Vec<Waiting>> {
        let mut queued: Vec<&Job> = jobs
            .iter()
            .filter(|job| job.state == JobState::Queued)
            .collect();
        let nothing = || Waiting {
            position: 0,
            reason: String::new(),
        };
        if queued.is_empty() {
            return Ok(jobs.iter().map(|_| nothing()).collect());
        }
        let mut reader = self.backend.reader().acquire().await?;
        let now = Backend::now(&mut reader).await?;
        let workers: i64 = sqlx::query_scalar(
            "select count(*) from workers where not draining and last_seen_at > $1",
        )
        .bind(to_db(now - self.settings.lease))
        .fetch_one(&mut *reader)
        .await?;
        let queues = all_queues(&mut reader).await?;
        queued.sort_by_key(|job| queue_place(job));
        let older = older_equals(&mut reader, &queued).await?;
        jobs.iter()
            .map(|job| {
                let Some(older) = older.get(&job.id) else {
                    return Ok(nothing());
                };
                let name = &job.spec.object.collection;
                let own = queues
                    .get(name)
                    .ok_or_else(|| internal(format!("a job's collection {name} is missing")))?;
                let higher = |queue: &QueueCounts| -> u64 {
                    let from = i64::from(job.spec.priority) + 1;
                    queue.by_priority.range(from..).map(|(_, jobs)| jobs).sum()
                };
                let others = queues
                    .values()
                    .filter(|other| other.collection.name != *name && !other.collection.paused)
                    .map(|other| Rival {
                        weight: other.collection.weight,
                        higher: higher(other),
                        equal: other
                            .by_priority
                            .get(&i64::from(job.spec.priority))
                            .copied()
                            .unwrap_or(0),
                    })
                    .collect();
                let around = Surroundings {
                    collection: own.collection.clone(),
                    running: own.running,
                    ahead: higher(own) + older,
                    others,
                    workers: count(workers),
                    now,
                };
                Ok(describe(job, &around))
            })
            .collect()
    }

    async fn cancel(&self, job: JobId) -> Result<Job> {
        let cancel = |job: &mut Job, now| {
            job.cancel(now);
            Ok(())
        };
        self.change(job, cancel).await
    }

    async fn retry(&self, job: JobId) -> Result<Job> {
        self.change(job, Job::retry).await
    }

    async fn logs(&self, job: JobId, after_seq: u64, limit: u32) -> Result<Vec<LogLine>> {
        let rows = sqlx::query(
            "select seq, at, attempt, level, message from job_logs where job_id = $1 and seq > $2 order by seq limit $3",
        )
        .bind(key(job))
        .bind(i64::try_from(after_seq).unwrap_or(i64::MAX))
        .bind(i64::from(limit.clamp(1, MAX_PAGE)))
        .fetch_all(self.backend.reader())
        .await?;
        if rows.is_empty() {
            // Tells an unknown job from a silent one.
            self.get(job).await?;
        }
        rows.iter()
            .map(|row| {
                Ok(LogLine {
                    seq: count(row.try_get("seq")?),
                    at: time(row, "at")?,
                    attempt: Attempt(small(row.try_get("attempt")?)?),
                    level: level_from(row.try_get("level")?)?,
                    message: row.try_get("message")?,
                })
            })
            .collect()
    }

    async fn status(&self, collection: Option<&CollectionId>, limit: u32) -> Result<Status> {
        let limit = i64::from(limit.min(MAX_PAGE));
        let mut reader = self.backend.reader().acquire().await?;
        let now = Backend::now(&mut reader).await?;
        let mut counts: BTreeMap<JobState, u64> =
            JobState::ALL.into_iter().map(|state| (state, 0)).collect();
        let mut query = QueryBuilder::<Db>::new("select state, count(*) as jobs from jobs");
        if let Some(collection) = collection {
            query
                .push(" where collection = ")
                .push_bind(collection.as_str());
        }
        for row in query
            .push(" group by state")
            .build()
            .fetch_all(&mut *reader)
            .await?
        {
            counts.insert(parse(row.try_get("state")?)?, count(row.try_get("jobs")?));
        }
        let mut some = async |state, order| {
            let mut query = select_jobs(collection, state);
            query
                .push(" order by ")
                .push(order)
                .push(" limit ")
                .push_bind(limit);
            jobs_from(&query.build().fetch_all(&mut *reader).await?)
        };
        let running = some(JobState::Leased, "started_at, id").await?;
        let recent_failures = some(JobState::Failed, "finished_at desc, id").await?;
        let next_queued = some(JobState::Queued, "priority desc, submitted_at, id").await?;
        let workers = list_workers(&mut reader, now).await?;
        Ok(Status {
            counts,
            workers,
            running,
            recent_failures,
            next_queued,
            at: now,
        })
    }

    async fn lease_within(
        &self,
        worker: &WorkerInfo,
        holder: Option<&str>,
        within: Option<&BTreeSet<CollectionId>>,
    ) -> Result<Option<Job>> {
        let ask = LeaseAsk {
            worker: worker.clone(),
            holder: holder.map(str::to_owned),
            within: within.cloned(),
        };
        let run = |asks: Vec<LeaseAsk>| async move {
            match self.lease_all(&asks).await {
                Ok(jobs) => jobs.into_iter().map(Ok).collect(),
                Err(error) => asks.iter().map(|_| Err(shared(&error))).collect(),
            }
        };
        self.leases.join(ask, run).await
    }

    async fn heartbeat(
        &self,
        job: JobId,
        attempt: Attempt,
        progress: Option<Progress>,
        logs: Vec<NewLogLine>,
    ) -> Result<Orders> {
        let (mut transaction, now) = self.begin().await?;
        let outcome = async {
            let mut job = lock_job(&mut transaction, job).await?;
            let cancel = job
                .heartbeat(
                    attempt,
                    progress.as_ref().map(check::progress),
                    now,
                    self.settings.lease,
                )
                .map_err(|refusal| refused(&job, attempt, refusal))?;
            save_job(&mut transaction, &job).await?;
            append_logs(&mut transaction, job.id, attempt, logs).await?;
            let drain: Option<bool> = sqlx::query_scalar(
                "update workers set last_seen_at = $2 where id = $1 returning draining",
            )
            .bind(job.worker.as_ref().map(WorkerId::as_str))
            .bind(to_db(now))
            .fetch_optional(&mut *transaction)
            .await?;
            Ok(Orders {
                cancel,
                drain: drain.unwrap_or(false),
            })
        }
        .await;
        self.finish(transaction, outcome, Change::Job).await
    }

    async fn checkpoint(&self, job: JobId, attempt: Attempt, checkpoint: Checkpoint) -> Result<()> {
        check::bytes("size_bytes", checkpoint.size_bytes)?;
        let (mut transaction, _now) = self.begin().await?;
        let outcome = async {
            let mut job = lock_job(&mut transaction, job).await?;
            job.checkpointed(attempt, checkpoint)
                .map_err(|refusal| refused(&job, attempt, refusal))?;
            save_job(&mut transaction, &job).await?;
            Ok(())
        }
        .await;
        self.finish(transaction, outcome, Change::Job).await
    }

    async fn publish_and_complete(
        &self,
        job: JobId,
        attempt: Attempt,
        bundle: NewVersion,
    ) -> Result<Version> {
        check::bundle(&bundle)?;
        let ask = PublishAsk {
            job,
            attempt,
            bundle,
        };
        let run = |asks: Vec<PublishAsk>| async move {
            match self.publish_all(&asks, LOCK_FREE_ROWS).await {
                Ok(answers) => answers,
                Err(error @ StoreError::Unavailable { .. }) => {
                    asks.iter().map(|_| Some(Err(shared(&error)))).collect()
                }
                // Something of one of them was refused: each is to hear its own.
                Err(_) => asks.iter().map(|_| None).collect(),
            }
        };
        if let Some(published) = self.publishes.join(ask.clone(), run).await {
            return published;
        }
        // Not with the others: it waits for what they passed over.
        let mut alone = self.publish_all(&[ask], LOCK).await?;
        alone.pop().flatten().unwrap_or_else(|| {
            Err(StoreError::NotFound {
                kind: "job",
                name: job.to_string(),
            })
        })
    }

    async fn fail(
        &self,
        job: JobId,
        attempt: Attempt,
        failure: Failure,
        logs: Vec<NewLogLine>,
    ) -> Result<bool> {
        let (mut transaction, now) = self.begin().await?;
        let outcome = async {
            let mut job = lock_job(&mut transaction, job).await?;
            let will_retry = job
                .fail(
                    attempt,
                    check::failure(&failure),
                    now,
                    &self.settings.backoff,
                )
                .map_err(|refusal| refused(&job, attempt, refusal))?;
            save_job(&mut transaction, &job).await?;
            announce(&mut transaction, [(&job, None)], now).await?;
            append_logs(&mut transaction, job.id, attempt, logs).await?;
            Ok(will_retry)
        }
        .await;
        self.finish(transaction, outcome, Change::Work).await
    }

    async fn reap(&self) -> Result<Reaped> {
        let mut reaped = Reaped::default();
        loop {
            let batch = self.reap_batch().await?;
            let full = batch.len() == REAP_BATCH;
            for job in batch {
                if job.state == JobState::Queued {
                    reaped.requeued.push(job.id);
                } else {
                    reaped.ended.push(job.id);
                }
            }
            if !full {
                return Ok(reaped);
            }
        }
    }

    async fn workers(&self) -> Result<Vec<Worker>> {
        let mut reader = self.backend.reader().acquire().await?;
        let now = Backend::now(&mut reader).await?;
        list_workers(&mut reader, now).await
    }

    async fn drain_worker(&self, worker: &WorkerId, draining: bool) -> Result<()> {
        let (mut transaction, _now) = self.begin().await?;
        let outcome = async {
            let done = sqlx::query("update workers set draining = $2 where id = $1")
                .bind(worker.as_str())
                .bind(draining)
                .execute(&mut *transaction)
                .await?;
            if done.rows_affected() == 0 {
                return Err(StoreError::NotFound {
                    kind: "worker",
                    name: worker.to_string(),
                });
            }
            Ok(())
        }
        .await;
        self.finish(transaction, outcome, Change::Work).await
    }

    async fn versions(&self, filter: &VersionFilter) -> Result<Vec<Version>> {
        let mut query = select_versions();
        if let Some(collection) = &filter.collection {
            query
                .push(" and v.collection = ")
                .push_bind(collection.as_str());
        }
        if let Some(object) = &filter.object {
            query.push(" and v.object = ").push_bind(object.as_str());
        }
        if !filter.include_retired {
            query.push(" and not v.retired");
        }
        let rows = query.build().fetch_all(self.backend.reader()).await?;
        let mut versions = rows.iter().map(version_from).collect::<Result<Vec<_>>>()?;
        // Here and not in SQL: the order of text there depends on the database's locale.
        versions.sort_by(|a, b| (&a.object, a.version).cmp(&(&b.object, b.version)));
        Ok(versions)
    }

    async fn standing(&self, object: &ObjectName) -> Result<Standing> {
        let run = |objects: Vec<ObjectName>| async move {
            match self.standings(&objects).await {
                Ok(standings) => standings.into_iter().map(Ok).collect(),
                Err(error) => objects.iter().map(|_| Err(shared(&error))).collect(),
            }
        };
        self.lookups.join(object.clone(), run).await
    }

    async fn version(&self, object: &ObjectName, reference: &str) -> Result<Version> {
        let mut reader = self.backend.reader().acquire().await?;
        find_version(&mut reader, object, reference).await
    }

    async fn set_alias(
        &self,
        object: &ObjectName,
        reference: &str,
        alias: &str,
    ) -> Result<Version> {
        check::alias(alias)?;
        let (mut transaction, _now) = self.begin().await?;
        let outcome = async {
            lock_object(&mut transaction, object).await?;
            let version = find_version(&mut transaction, object, reference).await?;
            if version.retired {
                return Err(StoreError::NotAllowed {
                    message: format!("{object}:v{} is retired", version.version),
                });
            }
            point_alias(&mut transaction, object, alias, version.version).await?;
            let version = find_version(&mut transaction, object, alias).await?;
            Ok(version)
        }
        .await;
        self.finish(transaction, outcome, Change::Job).await
    }

    async fn retire(&self, object: &ObjectName, reference: &str) -> Result<Version> {
        let (mut transaction, now) = self.begin().await?;
        let outcome = async {
            lock_object(&mut transaction, object).await?;
            let version = find_version(&mut transaction, object, reference).await?;
            if let Some(alias) = version.aliases.iter().find(|alias| *alias != LATEST) {
                return Err(StoreError::NotAllowed {
                    message: format!(
                        "alias {alias} points to {object}:v{}; move it first",
                        version.version
                    ),
                });
            }
            if version.retired {
                return Ok(version);
            }
            set_retired(&mut transaction, object, version.version, Some(now)).await?;
            if !version.aliases.is_empty() {
                point_latest(&mut transaction, object).await?;
            }
            find_version(&mut transaction, object, &format!("v{}", version.version)).await
        }
        .await;
        self.finish(transaction, outcome, Change::Job).await
    }

    async fn restore(&self, object: &ObjectName, reference: &str) -> Result<Version> {
        let (mut transaction, _now) = self.begin().await?;
        let outcome = async {
            lock_object(&mut transaction, object).await?;
            let version = find_version(&mut transaction, object, reference).await?;
            if version.retired {
                set_retired(&mut transaction, object, version.version, None).await?;
                point_latest(&mut transaction, object).await?;
            }
            find_version(&mut transaction, object, &format!("v{}", version.version)).await
        }
        .await;
        self.finish(transaction, outcome, Change::Job).await
    }

    async fn adopt(&self, object: &ObjectName, versions: &[Version]) -> Result<Adopted> {
        for version in versions {
            check::bundle(&version.bundle)?;
            for alias in &version.aliases {
                check::alias(alias)?;
            }
        }
        let (mut transaction, _now) = self.begin().await?;
        let outcome = async {
            let last = versions.iter().map(|it| it.version).max().unwrap_or(0);
            sqlx::query(
                "insert into objects (collection, object, last_version) values ($1, $2, $3) \
                 on conflict (collection, object) do update set last_version = case \
                 when excluded.last_version > objects.last_version then excluded.last_version \
                 else objects.last_version end",
            )
            .bind(object.collection.as_str())
            .bind(object.object.as_str())
            .bind(i64::from(last))
            .execute(&mut *transaction)
            .await?;
            let mut adopted = Adopted::default();
            for version in versions {
                let reference = format!("v{}", version.version);
                let added = match find_version(&mut transaction, object, &reference).await {
                    Ok(known) if known.bundle == version.bundle && known.job == version.job => {
                        adopted.known += 1;
                        false
                    }
                    Ok(_) => {
                        adopted.differing.push(version.version);
                        continue;
                    }
                    Err(StoreError::NotFound { .. }) => {
                        insert_versions(&mut transaction, std::slice::from_ref(version)).await?;
                        adopted.added.push(version.version);
                        true
                    }
                    Err(error) => return Err(error),
                };
                for alias in &version.aliases {
                    let unknown = matches!(
                        find_version(&mut transaction, object, alias).await,
                        Err(StoreError::NotFound { .. })
                    );
                    if added || unknown {
                        point_alias(&mut transaction, object, alias, version.version).await?;
                    }
                }
            }
            Ok(adopted)
        }
        .await;
        self.finish(transaction, outcome, Change::Job).await
    }

    async fn named(&self, grace: Duration) -> Result<Named> {
        let (mut transaction, now) = self.begin().await?;
        let outcome = async {
            // A coordinator of the version before this column retires without a time: the grace begins now.
            sqlx::query("update versions set retired_at = $1 where retired and retired_at is null")
                .bind(to_db(now))
                .execute(&mut *transaction)
                .await?;
            let since = to_db(now - chrono::TimeDelta::from_std(grace).map_err(internal)?);
            let mut named = Named::default();
            let rows = sqlx::query(
                "select distinct manifest_digest from versions where not retired or retired_at > $1",
            )
            .bind(since)
            .fetch_all(&mut *transaction)
            .await?;
            for row in rows {
                named.manifests.insert(parse(row.try_get("manifest_digest")?)?);
            }
            let rows = sqlx::query(
                "select distinct capture_digest, checkpoint_digest from jobs \
                 where finished_at is null or finished_at > $1",
            )
            .bind(since)
            .fetch_all(&mut *transaction)
            .await?;
            for row in rows {
                named.manifests.insert(parse(row.try_get("capture_digest")?)?);
                if let Some(digest) = row.try_get::<Option<&str>, _>("checkpoint_digest")? {
                    named.checkpoints.insert(parse(digest)?);
                }
            }
            Ok(named)
        }
        .await;
        self.finish(transaction, outcome, Change::Nothing).await
    }

    async fn record(&self, kind: &str, subject: &str, message: &str) -> Result<()> {
        let (mut transaction, now) = self.begin().await?;
        let outcome = async {
            let seq: i64 = sqlx::query_scalar(
                "insert into events (at, kind, subject, message) values ($1, $2, $3, $4) returning seq",
            )
            .bind(to_db(now))
            .bind(kind)
            .bind(check::clean(subject, MAX_LOG_LINE_BYTES))
            .bind(check::clean(message, MAX_LOG_LINE_BYTES))
            .fetch_one(&mut *transaction)
            .await?;
            sqlx::query("delete from events where seq <= $1")
                .bind(seq - MAX_EVENTS as i64)
                .execute(&mut *transaction)
                .await?;
            Ok(())
        }
        .await;
        self.finish(transaction, outcome, Change::Nothing).await
    }

    async fn events(&self, before_seq: u64, limit: u32) -> Result<Vec<Event>> {
        let before = match before_seq {
            0 => i64::MAX,
            seq => i64::try_from(seq).unwrap_or(i64::MAX),
        };
        let rows = sqlx::query("select * from events where seq < $1 order by seq desc limit $2")
            .bind(before)
            .bind(i64::from(limit.clamp(1, MAX_PAGE)))
            .fetch_all(self.backend.reader())
            .await?;
        rows.iter()
            .map(|row| {
                Ok(Event {
                    seq: count(row.try_get("seq")?),
                    at: time(row, "at")?,
                    kind: row.try_get("kind")?,
                    subject: row.try_get("subject")?,
                    message: row.try_get("message")?,
                })
            })
            .collect()
    }

    async fn take_turn(&self, work: &str, every: Duration) -> Result<Option<u64>> {
        let (mut transaction, now) = self.begin().await?;
        let outcome = async {
            sqlx::query(
                "insert into turns (name, last_at, count) values ($1, $2, 0) on conflict do nothing",
            )
            .bind(work)
            .bind(to_db(DateTime::UNIX_EPOCH))
            .execute(&mut *transaction)
            .await?;
            let row = sqlx::query(sql(format!("select * from turns where name = $1 {LOCK}")))
                .bind(work)
                .fetch_one(&mut *transaction)
                .await?;
            let since = (now - time(&row, "last_at")?).to_std().unwrap_or_default();
            if since < every {
                return Ok(None);
            }
            let turn: i64 = row.try_get("count")?;
            sqlx::query("update turns set last_at = $2, count = count + 1 where name = $1")
                .bind(work)
                .bind(to_db(now))
                .execute(&mut *transaction)
                .await?;
            Ok(Some(count(turn)))
        }
        .await;
        self.finish(transaction, outcome, Change::Nothing).await
    }

    async fn collections(&self) -> Result<Vec<Collection>> {
        let rows = sqlx::query("select * from collections")
            .fetch_all(self.backend.reader())
            .await?;
        let mut collections = rows
            .iter()
            .map(collection_from)
            .collect::<Result<Vec<_>>>()?;
        collections.sort_by(|a, b| a.name.cmp(&b.name));
        Ok(collections)
    }

    async fn set_collection(&self, collection: Collection) -> Result<Collection> {
        check::collection(&collection)?;
        let (mut transaction, _now) = self.begin().await?;
        let outcome = async {
        sqlx::query(
            "insert into collections (name, weight, max_running, paused) values ($1, $2, $3, $4) \
             on conflict (name) do update set weight = excluded.weight, max_running = excluded.max_running, \
             paused = excluded.paused",
        )
        .bind(collection.name.as_str())
        .bind(collection.weight)
        .bind(i64::from(collection.max_running))
        .bind(collection.paused)
        .execute(&mut *transaction)
        .await?;
        Ok(collection)
        }
        .await;
        self.finish(transaction, outcome, Change::Work).await
    }
}

const TOKEN: &str = "id, name, grants, created_at, expires_at, revoked_at, last_used_on, secret_sha256, previous_sha256, previous_until";

fn token_from(row: &DbRow) -> Result<Token> {
    let Json(grants) = row.try_get::<Json<Vec<String>>, _>("grants")?;
    Ok(Token {
        id: row.try_get("id")?,
        name: row.try_get("name")?,
        grants: grants
            .iter()
            .map(|grant| parse(grant))
            .collect::<Result<_>>()?,
        created_at: time(row, "created_at")?,
        expires_at: optional_time(row, "expires_at")?,
        revoked_at: optional_time(row, "revoked_at")?,
        last_used_on: row.try_get::<Option<NaiveDate>, _>("last_used_on")?,
    })
}

fn secret_hash(bytes: &[u8]) -> Result<SecretHash> {
    bytes.try_into().map_err(internal)
}

/// When a token made at `now` ends.
fn end(now: DateTime<Utc>, valid_for: Option<Duration>) -> Result<Option<DateTime<Utc>>> {
    let Some(valid_for) = valid_for else {
        return Ok(None);
    };
    let end = chrono::TimeDelta::from_std(valid_for)
        .ok()
        .and_then(|valid_for| now.checked_add_signed(valid_for));
    end.map(Some).ok_or_else(|| StoreError::Invalid {
        field: "valid_secs",
        message: "is out of range".to_owned(),
    })
}

/// The live token with this name, or the one with this id; its row locked until the transaction ends.
async fn lock_token(connection: &mut Connection, token: &str) -> Result<Token> {
    let row = sqlx::query(sql(format!(
        "select {TOKEN} from tokens where (name = $1 and revoked_at is null) or id = $1 {LOCK}"
    )))
    .bind(token)
    .fetch_optional(connection)
    .await?;
    token_from(&row.ok_or_else(|| StoreError::NotFound {
        kind: "token",
        name: token.to_owned(),
    })?)
}

#[async_trait]
impl Tokens for SqlStore {
    async fn create_token(&self, new: NewToken) -> Result<Token> {
        check::token(&new)?;
        let (mut transaction, now) = self.begin().await?;
        let outcome = async {
            let grants: Vec<String> = new.grants.iter().map(Grant::to_string).collect();
            let row = sqlx::query(sql(format!(
                "insert into tokens (id, name, grants, secret_sha256, created_at, expires_at) \
                 values ($1, $2, $3, $4, $5, $6) on conflict do nothing returning {TOKEN}"
            )))
            .bind(&new.id)
            .bind(&new.name)
            .bind(Json(grants))
            .bind(&new.secret[..])
            .bind(to_db(now))
            .bind(end(now, new.valid_for)?.map(to_db))
            .fetch_optional(&mut *transaction)
            .await?;
            token_from(&row.ok_or_else(|| StoreError::NotAllowed {
                message: format!("there is a token {} already; rotate or revoke it", new.name),
            })?)
        }
        .await;
        self.finish(transaction, outcome, Change::Nothing).await
    }

    async fn tokens(&self) -> Result<Vec<Token>> {
        let rows = sqlx::query(sql(format!(
            "select {TOKEN} from tokens order by created_at desc, id"
        )))
        .fetch_all(self.backend.reader())
        .await?;
        rows.iter().map(token_from).collect()
    }

    async fn token_key(&self, id: &str) -> Result<Option<TokenKey>> {
        let mut reader = self.backend.reader().acquire().await?;
        let row = sqlx::query(sql(format!("select {TOKEN} from tokens where id = $1")))
            .bind(id)
            .fetch_optional(&mut *reader)
            .await?;
        let Some(row) = row else { return Ok(None) };
        let at = Backend::now(&mut reader).await?;
        let mut secrets = vec![secret_hash(row.try_get("secret_sha256")?)?];
        if let Some(previous) = row.try_get::<Option<&[u8]>, _>("previous_sha256")?
            && optional_time(&row, "previous_until")?.is_some_and(|until| at < until)
        {
            secrets.push(secret_hash(previous)?);
        }
        Ok(Some(TokenKey {
            token: token_from(&row)?,
            secrets,
            at,
        }))
    }

    async fn token_used(&self, id: &str) -> Result<()> {
        let (mut transaction, now) = self.begin().await?;
        let outcome = sqlx::query("update tokens set last_used_on = $2 where id = $1")
            .bind(id)
            .bind(now.date_naive())
            .execute(&mut *transaction)
            .await
            .map(drop)
            .map_err(StoreError::from);
        self.finish(transaction, outcome, Change::Nothing).await
    }

    async fn rotate_token(
        &self,
        token: &str,
        secret: SecretHash,
        grace: Duration,
        valid_for: Option<Duration>,
    ) -> Result<Token> {
        let (mut transaction, now) = self.begin().await?;
        let outcome = async {
            let token = lock_token(&mut transaction, token).await?;
            if token.revoked_at.is_some() {
                return Err(StoreError::NotAllowed {
                    message: format!("token {} is revoked", token.id),
                });
            }
            let expires_at = match valid_for {
                Some(_) => end(now, valid_for)?,
                None => token.expires_at,
            };
            let row = sqlx::query(sql(format!(
                "update tokens set previous_sha256 = secret_sha256, previous_until = $2, secret_sha256 = $3, \
                 expires_at = $4 where id = $1 returning {TOKEN}"
            )))
            .bind(&token.id)
            .bind(end(now, Some(grace))?.map(to_db))
            .bind(&secret[..])
            .bind(expires_at.map(to_db))
            .fetch_one(&mut *transaction)
            .await?;
            token_from(&row)
        }
        .await;
        self.finish(transaction, outcome, Change::Nothing).await
    }

    async fn revoke_token(&self, token: &str) -> Result<Token> {
        let (mut transaction, now) = self.begin().await?;
        let outcome = async {
            let token = lock_token(&mut transaction, token).await?;
            let row = sqlx::query(sql(format!(
                "update tokens set revoked_at = coalesce(revoked_at, $2), previous_sha256 = null where id = $1 \
                 returning {TOKEN}"
            )))
            .bind(&token.id)
            .bind(to_db(now))
            .fetch_one(&mut *transaction)
            .await?;
            token_from(&row)
        }
        .await;
        self.finish(transaction, outcome, Change::Nothing).await
    }
}
