//! How many jobs there are, and what a queued one waits for.

use std::collections::BTreeMap;

use chrono::{DateTime, Utc};
use ign_proto::{CollectionId, JobId};
use sqlx::{QueryBuilder, Row};

use super::super::{Connection, Db, from_key, key, to_db};
use super::CHUNK;
use super::rows::{collection_from, count, internal, parse};
use crate::state::{Job, JobState};
use crate::store::{Collection, Result, StoreError, Waiting};
use crate::waiting::{Rival, Surroundings, describe};

/// A collection and how many jobs are in it.
#[derive(Debug)]
pub(super) struct QueueCounts {
    pub(super) collection: Collection,
    pub(super) running: u64,
    /// Those that wait.
    pub(super) by_priority: BTreeMap<i64, u64>,
    /// All of it, where [`Counted`] asks for it.
    pub(super) by_state: BTreeMap<JobState, u64>,
}

/// Of which collections jobs are counted that do not wait.
#[derive(Clone, Copy)]
pub(super) enum Counted<'a> {
    None,
    Of(&'a CollectionId),
    All,
}

/// All collections; one look at the table, which is what a screen over very many jobs costs.
pub(super) async fn all_queues(
    reader: &mut Connection,
    counted: Counted<'_>,
) -> Result<BTreeMap<CollectionId, QueueCounts>> {
    let mut query =
        QueryBuilder::<Db>::new("select collection, priority, state, count(*) as jobs from jobs");
    match counted {
        Counted::None => drop(query.push(" where state = 'queued'")),
        Counted::Of(collection) => {
            query
                .push(" where state = 'queued' or collection = ")
                .push_bind(collection.as_str());
        }
        Counted::All => {}
    }
    query.push(" group by collection, priority, state");
    let counts = query.build().fetch_all(&mut *reader).await?;
    // After the jobs: theirs are all there then.
    let rows = sqlx::query(
        "select c.*, (select count(*) from jobs j where j.collection = c.name and j.state = 'leased') as running \
         from collections c",
    )
    .fetch_all(reader)
    .await?;
    let mut queues = BTreeMap::new();
    for row in rows {
        let queue = QueueCounts {
            running: count(row.try_get("running")?),
            by_priority: BTreeMap::new(),
            by_state: BTreeMap::new(),
            collection: collection_from(&row)?,
        };
        queues.insert(queue.collection.name.clone(), queue);
    }
    for row in counts {
        let name: CollectionId = parse(row.try_get("collection")?)?;
        let queue = queues
            .get_mut(&name)
            .ok_or_else(|| missing_collection(&name))?;
        let jobs = count(row.try_get("jobs")?);
        let state = parse(row.try_get("state")?)?;
        if state == JobState::Queued {
            queue.by_priority.insert(row.try_get("priority")?, jobs);
        }
        *queue.by_state.entry(state).or_default() += jobs;
    }
    Ok(queues)
}

fn missing_collection(name: &CollectionId) -> StoreError {
    internal(format!("a job's collection {name} is missing"))
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

/// What each of some jobs waits for, in their order.
pub(super) async fn all_waiting(
    reader: &mut Connection,
    jobs: &[Job],
    queues: &BTreeMap<CollectionId, QueueCounts>,
    workers: u64,
    now: DateTime<Utc>,
) -> Result<Vec<Waiting>> {
    let mut queued: Vec<&Job> = jobs
        .iter()
        .filter(|job| job.state == JobState::Queued)
        .collect();
    queued.sort_by_key(|job| queue_place(job));
    let older = older_equals(reader, &queued).await?;
    jobs.iter()
        .map(|job| {
            let Some(older) = older.get(&job.id) else {
                return Ok(Waiting::default());
            };
            let name = &job.spec.object.collection;
            let own = queues.get(name).ok_or_else(|| missing_collection(name))?;
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
                workers,
                now,
            };
            Ok(describe(job, &around))
        })
        .collect()
}
