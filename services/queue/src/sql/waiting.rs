//! What a queued job waits for.

use std::collections::BTreeMap;

use chrono::{DateTime, Utc};
use ign_proto::{CollectionId, JobId};
use sqlx::{QueryBuilder, Row};

use super::super::{Connection, Db, from_key, key, to_db};
use super::CHUNK;
use super::rows::{collection_from, count, parse};
use crate::state::Job;
use crate::store::{Collection, Result};

/// A collection and how many jobs wait in it.
#[derive(Debug)]
pub(super) struct QueueCounts {
    pub(super) collection: Collection,
    pub(super) running: u64,
    pub(super) by_priority: BTreeMap<i64, u64>,
}

pub(super) async fn all_queues(
    reader: &mut Connection,
) -> Result<BTreeMap<CollectionId, QueueCounts>> {
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
pub(super) fn queue_place(job: &Job) -> (CollectionId, i32, DateTime<Utc>, JobId) {
    (
        job.spec.object.collection.clone(),
        job.spec.priority,
        job.submitted_at,
        job.id,
    )
}

/// For each of some queued jobs, sorted by [`queue_place`], how many of the same collection and priority are older. Each
/// stretch of the queue between two of them is counted once.
pub(super) async fn older_equals(
    reader: &mut Connection,
    jobs: &[&Job],
) -> Result<BTreeMap<JobId, u64>> {
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
