//! Leases: which job of which collection a worker gets next.

use std::cmp::Ordering;
use std::collections::{BTreeMap, BTreeSet, VecDeque};

use chrono::{DateTime, Utc};
use ign_proto::{CollectionId, JobId, WorkerId};
use sqlx::{QueryBuilder, Row};

use super::super::{Backend, Connection, Db, LOCK, LOCK_FREE_ROWS, from_key, to_db};
use super::jobs::{refused, save_jobs};
use super::rows::{
    collection_from, count, jobs_from, optional_time, parse, seconds, sql, time, worker_from,
};
use super::{JOB, SqlStore};
use crate::changes::Change;
use crate::check;
use crate::error::from_commit;
use crate::state::Job;
use crate::store::{Collection, Result, WorkerInfo};

/// A worker's row is written again after this many seconds, so that idle workers cost reads only.
const WORKER_FRESH_SECS: i64 = 5;

impl SqlStore {
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
    pub(super) async fn lease_all(&self, asks: &[LeaseAsk]) -> Result<Vec<Option<Job>>> {
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
}

/// A worker that asks for a job. Asked twice it may get a second one; the first one's lease then runs out.
#[derive(Clone, Debug)]
pub(super) struct LeaseAsk {
    pub(super) worker: WorkerInfo,
    pub(super) holder: Option<String>,
    pub(super) within: Option<BTreeSet<CollectionId>>,
}

impl LeaseAsk {
    fn takes_from(&self, queue: &Queue) -> bool {
        let name = &queue.collection.name;
        self.within
            .as_ref()
            .is_none_or(|within| within.contains(name))
    }
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
