//! Rows of jobs and their logs: locked, written, queued.

use std::collections::BTreeMap;

use ign_proto::{Attempt, CollectionId, JobId, WorkerId};
use sqlx::types::Json;
use sqlx::{QueryBuilder, Row};

use super::super::{Connection, Db, LOCK, key, to_db};
use super::rows::{count, internal, job_from, jobs_from, level_word, sql};
use super::{CHUNK, JOB, SqlStore};
use crate::changes::Change;
use crate::check;
use crate::state::{Job, JobState, Refusal};
use crate::store::{MAX_LOG_LINES, NewLogLine, Result, StoreError, Submit};

/// Log lines taken from one call; of more, the last.
const MAX_LINES_PER_CALL: usize = 2000;

/// The job, its row locked until the transaction ends.
pub(super) async fn lock_job(connection: &mut Connection, job: JobId) -> Result<Job> {
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
pub(super) async fn save_jobs(connection: &mut Connection, jobs: &[Job]) -> Result<()> {
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

pub(super) async fn save_job(connection: &mut Connection, job: &Job) -> Result<()> {
    save_jobs(connection, std::slice::from_ref(job)).await
}

pub(super) fn refused(job: &Job, attempt: Attempt, refusal: Refusal) -> StoreError {
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
pub(super) async fn append_logs(
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

impl SqlStore {
    /// Queues requests that were checked, sorted by their key so that concurrent batches lock in one order.
    pub(super) async fn insert_jobs(
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
}

/// Jobs by id, their rows locked until the transaction ends.
pub(super) async fn lock_jobs(
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

pub(super) fn select_jobs(collection: Option<&CollectionId>, state: JobState) -> QueryBuilder<Db> {
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
