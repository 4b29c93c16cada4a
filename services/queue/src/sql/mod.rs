//! The store's operations in SQL that both dialects speak.
//!
//! This module is compiled twice, as a child of `postgres.rs` and of `sqlite.rs`: the parent gives what they differ in
//! (types of the driver, how rows are locked, how times and ids are kept). So an operation is written once and both stores
//! behave alike.
//!
//! Every change of a job is: lock its row, apply the pure transition of [`crate::state`], write it back, commit, signal.
//! Lock order where one transaction takes several: collection, job, object.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use chrono::{DateTime, Utc};
use ign_proto::{Attempt, CollectionId, JobId, LATEST, ObjectName, WorkerId};
use sqlx::{QueryBuilder, Row, Transaction};

use super::{
    Backend, Connection, Db, DbTime, LOCK, LOCK_FREE_ROWS, from_key, key, push_label, to_db,
};
use crate::changes::{Change, Changes, Signal};
use crate::check;
use crate::error::{from_commit, shared};
use crate::group::Group;
use crate::state::{Checkpoint, Failure, Job, JobState, Progress, Refusal};
use crate::store::{
    Adopted, Collection, Event, JobFilter, JobPage, LogLine, MAX_EVENTS, MAX_LOG_LINE_BYTES,
    MAX_PAGE, Named, NewLogLine, NewVersion, Orders, Reaped, Result, Settings, Standing, Status,
    Store, StoreError, Submit, Version, VersionFilter, Waiting, Worker, WorkerInfo,
};

mod jobs;
mod leases;
mod rows;
mod tokens;
mod versions;
mod waiting;
mod webhooks;

use jobs::{append_logs, lock_job, refused, save_job, save_jobs, select_jobs};
use leases::LeaseAsk;
use rows::{
    collection_from, count, internal, job_from, jobs_from, level_from, optional_time, parse,
    seconds, small, sql, time, version_from, worker_from,
};
use versions::{
    PublishAsk, find_version, insert_versions, lock_object, point_alias, point_latest,
    select_versions, set_retired,
};
use waiting::{Counted, all_queues, all_waiting};
use webhooks::announce;

type DbRow = <Db as sqlx::Database>::Row;

/// Rows of one insert; a row has at most a dozen bound values, and `SQLite` takes 32,766 of them.
const CHUNK: usize = 500;
const WORKER_LISTED_SECS: i64 = 3600;
const WORKER_KEPT_SECS: i64 = 24 * 3600;
const REAP_BATCH: usize = 100;

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
}

impl SqlStore {
    pub(super) fn new(backend: Backend, signal: Arc<Signal>, settings: Settings) -> Self {
        Self {
            backend,
            signal,
            settings,
            leases: Group::default(),
            publishes: Group::default(),
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

/// How many workers could take a job.
async fn ready_workers(
    reader: &mut Connection,
    lease: Duration,
    now: DateTime<Utc>,
) -> Result<u64> {
    let workers: i64 =
        sqlx::query_scalar("select count(*) from workers where not draining and last_seen_at > $1")
            .bind(to_db(now - lease))
            .fetch_one(reader)
            .await?;
    Ok(count(workers))
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
        if jobs.iter().all(|job| job.state != JobState::Queued) {
            return Ok(jobs.iter().map(|_| Waiting::default()).collect());
        }
        let mut reader = self.backend.reader().acquire().await?;
        let now = Backend::now(&mut reader).await?;
        let workers = ready_workers(&mut reader, self.settings.lease, now).await?;
        let queues = all_queues(&mut reader, Counted::None).await?;
        all_waiting(&mut reader, jobs, &queues, workers, now).await
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
        let queued = some(JobState::Queued, "priority desc, submitted_at, id").await?;
        // After the list: every job in it has its queue then.
        let counted = collection.map_or(Counted::All, Counted::Of);
        let queues = all_queues(&mut reader, counted).await?;
        let mut counts: BTreeMap<JobState, u64> =
            JobState::ALL.into_iter().map(|state| (state, 0)).collect();
        let shown = |name: &CollectionId| collection.is_none_or(|only| only == name);
        for (_, queue) in queues.iter().filter(|(name, _)| shown(name)) {
            for (state, jobs) in &queue.by_state {
                *counts.entry(*state).or_default() += jobs;
            }
        }
        let ready = ready_workers(&mut reader, self.settings.lease, now).await?;
        let waiting = all_waiting(&mut reader, &queued, &queues, ready, now).await?;
        let workers = list_workers(&mut reader, now).await?;
        Ok(Status {
            counts,
            workers,
            running,
            recent_failures,
            next_queued: queued.into_iter().zip(waiting).collect(),
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
        let rows = sqlx::query(
            "select 'alias' as what, alias, version, null as retired_at from aliases \
             where collection = $1 and object = $2 \
             union all select 'retired', null, version, retired_at from versions \
             where collection = $1 and object = $2 and retired \
             union all select 'newest', null, last_version, null from objects where collection = $1 and object = $2",
        )
        .bind(object.collection.as_str())
        .bind(object.object.as_str())
        .fetch_all(self.backend.reader())
        .await?;
        let mut standing = Standing::default();
        for row in rows {
            let version = small(row.try_get("version")?)?;
            match row.try_get("what")? {
                "alias" => {
                    standing.aliases.insert(row.try_get("alias")?, version);
                }
                "retired" => {
                    let retired_at = optional_time(&row, "retired_at")?;
                    standing.retired.insert(version, retired_at);
                }
                _ => standing.newest = version,
            }
        }
        Ok(standing)
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
