//! Random operations on a store against a model in memory: the pure state machine and, beside it, the plainest possible
//! statement of what else a store promises (order of leases, versions, aliases).
//!
//! After each operation the answers are compared, and now and then the whole content. Times are compared by presence:
//! the store's are the database's, the model's are counted.
//!
//! The steps are split into rounds, each with a seed and a database of its own, so that neither the queue nor the model
//! grows without end. `IGN_MODEL_ROUNDS` and `IGN_MODEL_SEED` run it longer or elsewhere.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Debug;

use chrono::{DateTime, TimeDelta, Utc};
use ign_proto::{Attempt, CollectionId, JobId, ObjectName};
use ign_queue::{
    Checkpoint, Collection, FailureKind, Job, JobFilter, JobState, NewVersion, StoreError, Submit,
    Version, VersionFilter,
};
use rand::RngExt;
use rand_pcg::Pcg64Mcg;

use crate::bench::{Bench, PATIENT, bundle, digest, failure, kind, name, spec, worker};

const OBJECTS: [&str; 5] = [
    "museum/vase",
    "museum/urn",
    "library/vase",
    "gallery/bust",
    "gallery/vase",
];
const WORKERS: [&str; 4] = ["w1", "w2", "w3", "w4"];
const PAST: DateTime<Utc> = DateTime::UNIX_EPOCH;

fn from_env(name: &str, default: u64) -> u64 {
    std::env::var(name).map_or(default, |text| text.parse().expect("a number"))
}

/// What a refusal is called; [`kind`] gives the same words for a store's.
type Answer<T> = Result<T, &'static str>;

#[derive(Default)]
struct Model {
    ticks: i64,
    jobs: BTreeMap<JobId, Job>,
    collections: BTreeMap<CollectionId, Collection>,
    versions: BTreeMap<(ObjectName, u32), Version>,
    last_version: BTreeMap<ObjectName, u32>,
    aliases: BTreeMap<(ObjectName, String), u32>,
    draining: BTreeSet<&'static str>,
    seen: BTreeSet<&'static str>,
}

impl Model {
    fn now(&self) -> DateTime<Utc> {
        DateTime::from_timestamp(1_000_000_000, 0).expect("in range")
            + TimeDelta::microseconds(self.ticks)
    }

    /// The id is the store's to choose: `given` is what it chose if the job is new.
    fn submit(&mut self, request: &Submit, given: Option<JobId>) -> Answer<Job> {
        let mut spec = request.spec.clone();
        if spec.max_attempts == 0 {
            spec.max_attempts = 4;
        }
        let collection = spec.object.collection.clone();
        let known = self.jobs.values().find(|job| {
            job.spec.object.collection == collection && job.request_id == request.request_id
        });
        if let Some(job) = known {
            return if job.spec == spec {
                Ok(job.clone())
            } else {
                Err("conflict")
            };
        }
        let id = given.expect("a new job has a new id");
        assert!(!self.jobs.contains_key(&id), "an id was given twice");
        let job = Job::submit(id, request.request_id.clone(), spec, self.now());
        self.collections
            .entry(collection.clone())
            .or_insert_with(|| Collection::new(collection));
        self.jobs.insert(id, job.clone());
        Ok(job)
    }

    fn running(&self, collection: &CollectionId) -> u32 {
        let held =
            |job: &&Job| job.state == JobState::Leased && job.spec.object.collection == *collection;
        self.jobs.values().filter(held).count() as u32
    }

    /// Priority, then running jobs by weight, then the collection served longest ago, then age.
    fn next(&self) -> Option<JobId> {
        let ready = self.jobs.values().filter(|job| {
            let collection = &self.collections[&job.spec.object.collection];
            job.state == JobState::Queued
                && job.not_before <= self.now()
                && !collection.paused
                && (collection.max_running == 0
                    || self.running(&collection.name) < collection.max_running)
        });
        let rank = |job: &Job| {
            let collection = &self.collections[&job.spec.object.collection];
            let load = f64::from(self.running(&collection.name)) / collection.weight;
            let served = self
                .jobs
                .values()
                .filter(|other| other.spec.object.collection == collection.name)
                .filter_map(|other| other.started_at)
                .max();
            // Priority within the collection comes first, also when the collections' first jobs are compared.
            (
                -job.spec.priority,
                (load * 1e6) as u64,
                served,
                job.submitted_at,
                job.id,
            )
        };
        ready.min_by_key(|job| rank(job)).map(|job| job.id)
    }

    fn lease(&mut self, me: &'static str) -> Option<Job> {
        self.seen.insert(me);
        if self.draining.contains(me) {
            return None;
        }
        let id = self.next()?;
        let now = self.now();
        let job = self.jobs.get_mut(&id)?;
        job.lease(me.parse().expect("a name"), None, now, PATIENT.lease)
            .expect("it is ready");
        Some(job.clone())
    }

    fn publish(&mut self, id: JobId, attempt: Attempt, bundle: &NewVersion) -> Answer<Version> {
        let now = self.now();
        let job = self.jobs.get(&id).ok_or("not found")?;
        let object = job.spec.object.clone();
        if let (Some(version), true) = (job.version, job.attempt == attempt) {
            let published = self.version(&object, version);
            if published.bundle.manifest_digest == bundle.manifest_digest {
                return Ok(published);
            }
        }
        let job = self.jobs.get_mut(&id).ok_or("not found")?;
        let last = self.last_version.entry(object.clone()).or_insert(0);
        job.complete(attempt, *last + 1, now)
            .map_err(|_refusal| "lease lost")?;
        *last += 1;
        let version = *last;
        self.versions.insert(
            (object.clone(), version),
            Version {
                object: object.clone(),
                version,
                bundle: bundle.clone(),
                aliases: Vec::new(),
                created_at: now,
                job: id,
                retired: false,
                retired_at: None,
            },
        );
        self.aliases
            .insert((object.clone(), "latest".to_owned()), version);
        Ok(self.version(&object, version))
    }

    fn version(&self, object: &ObjectName, version: u32) -> Version {
        let mut found = self.versions[&(object.clone(), version)].clone();
        found.aliases = self
            .aliases
            .iter()
            .filter(|((of, _), to)| of == object && **to == version)
            .map(|((_, alias), _)| alias.clone())
            .collect();
        found
    }

    fn resolve(&self, object: &ObjectName, reference: &str) -> Answer<Version> {
        let number = match reference
            .strip_prefix('v')
            .and_then(|digits| digits.parse().ok())
        {
            Some(number) => number,
            None => *self
                .aliases
                .get(&(object.clone(), reference.to_owned()))
                .ok_or("not found")?,
        };
        if !self.versions.contains_key(&(object.clone(), number)) {
            return Err("not found");
        }
        Ok(self.version(object, number))
    }

    fn set_alias(&mut self, object: &ObjectName, reference: &str, alias: &str) -> Answer<Version> {
        let version = self.resolve(object, reference)?;
        if version.retired {
            return Err("not allowed");
        }
        self.aliases
            .insert((object.clone(), alias.to_owned()), version.version);
        Ok(self.version(object, version.version))
    }

    fn retire(&mut self, object: &ObjectName, reference: &str) -> Answer<Version> {
        let version = self.resolve(object, reference)?;
        if version.aliases.iter().any(|alias| alias != "latest") {
            return Err("not allowed");
        }
        let number = version.version;
        let at = (object.clone(), number);
        let now = self.now();
        let row = self.versions.get_mut(&at).expect("resolved");
        row.retired = true;
        row.retired_at.get_or_insert(now);
        let newest = self
            .versions
            .values()
            .filter(|v| v.object == *object && !v.retired)
            .map(|v| v.version)
            .max();
        let latest = (object.clone(), "latest".to_owned());
        if self.aliases.get(&latest) == Some(&number) {
            match newest {
                Some(newest) => self.aliases.insert(latest, newest),
                None => self.aliases.remove(&latest),
            };
        }
        Ok(self.version(object, number))
    }
}

impl Model {
    fn restore(&mut self, object: &ObjectName, reference: &str) -> Answer<Version> {
        let version = self.resolve(object, reference)?;
        if version.retired {
            let at = (object.clone(), version.version);
            let row = self.versions.get_mut(&at).expect("resolved");
            row.retired = false;
            row.retired_at = None;
            let listed = |(of, _): &&(ObjectName, u32)| of == object;
            let newest = self
                .versions
                .keys()
                .filter(listed)
                .filter(|at| !self.versions[at].retired)
                .map(|(_, number)| *number)
                .max()
                .expect("one was just restored");
            self.aliases
                .insert((object.clone(), "latest".to_owned()), newest);
        }
        Ok(self.version(object, version.version))
    }
}

fn timeless(mut job: Job) -> Job {
    job.check().unwrap_or_else(|rule| panic!("{rule}: {job:?}"));
    job.submitted_at = PAST;
    job.not_before = PAST;
    for time in [
        &mut job.started_at,
        &mut job.finished_at,
        &mut job.lease_until,
    ] {
        *time = time.map(|_| PAST);
    }
    job
}

fn version_timeless(version: Version) -> Version {
    Version {
        created_at: PAST,
        retired_at: version.retired_at.map(|_| PAST),
        ..version
    }
}

fn same<T: PartialEq + Debug>(
    step: u64,
    what: &str,
    store: Result<T, StoreError>,
    model: Answer<T>,
) {
    match (store, model) {
        (Ok(store), Ok(model)) => assert_eq!(store, model, "step {step}: {what}"),
        (Err(error), Err(word)) => {
            assert_eq!(kind(&Err::<T, _>(error)), word, "step {step}: {what}");
        }
        (store, model) => {
            panic!("step {step}: {what}: the store says {store:?}, the model {model:?}")
        }
    }
}

async fn compare_all(bench: &Bench, model: &Model, step: u64) {
    let mut jobs = Vec::new();
    let mut after = None;
    loop {
        let page = bench
            .store
            .list(&JobFilter::default(), after, 1000)
            .await
            .unwrap();
        jobs.extend(page.jobs.into_iter().map(timeless));
        after = page.next;
        if after.is_none() {
            break;
        }
    }
    let expected: Vec<Job> = model.jobs.values().rev().cloned().map(timeless).collect();
    assert_eq!(jobs, expected, "step {step}");
    let versions = bench
        .store
        .versions(&VersionFilter {
            include_retired: true,
            ..VersionFilter::default()
        })
        .await;
    let versions: Vec<_> = versions
        .unwrap()
        .into_iter()
        .map(version_timeless)
        .collect();
    let expected: Vec<_> = model
        .versions
        .keys()
        .map(|(object, number)| version_timeless(model.version(object, *number)))
        .collect();
    assert_eq!(versions, expected, "step {step}");
    assert_eq!(
        bench.store.collections().await.unwrap(),
        model.collections.values().cloned().collect::<Vec<_>>(),
        "step {step}"
    );
    let counts = bench.store.status(None, 1).await.unwrap().counts;
    for state in JobState::ALL {
        let expected = model.jobs.values().filter(|job| job.state == state).count() as u64;
        assert_eq!(counts[&state], expected, "step {step}: {state:?}");
    }
}

/// Steps of one round.
const STEPS: u64 = 2000;

/// Rounds of random operations, each on what `fresh` gives.
pub(crate) async fn rounds(default: u64, fresh: impl AsyncFn() -> Bench) {
    let first = from_env("IGN_MODEL_SEED", 11);
    for round in 0..from_env("IGN_MODEL_ROUNDS", default) {
        Box::pin(run(&fresh().await, first + round, STEPS)).await;
    }
}

async fn run(bench: &Bench, seed: u64, steps: u64) {
    let mut rng = Pcg64Mcg::new(u128::from(seed));
    let mut model = Model::default();
    let store = &bench.store;
    for step in 0..steps {
        model.ticks += 1;
        let now = model.now();
        let object = name(OBJECTS[rng.random_range(0..OBJECTS.len())]);
        // A job that exists, preferring those that live, and an attempt that is mostly the current one.
        let lively: Vec<JobId> = model
            .jobs
            .values()
            .filter(|job| !job.state.is_terminal())
            .map(|job| job.id)
            .collect();
        let all: Vec<JobId> = model.jobs.keys().copied().collect();
        let pool = if lively.is_empty() || rng.random_bool(0.15) {
            &all
        } else {
            &lively
        };
        let target = if pool.is_empty() {
            JobId::generate()
        } else {
            pool[rng.random_range(0..pool.len())]
        };
        let attempt = model.jobs.get(&target).map_or(1, |job| job.attempt.0);
        let attempt = Attempt(match rng.random_range(0..8) {
            0 => attempt + 1,
            1 => attempt.saturating_sub(1),
            _ => attempt,
        });
        match rng.random_range(0..100) {
            0..16 => {
                let mut spec = spec(&object.to_string());
                spec.priority = rng.random_range(-1..=1);
                spec.max_attempts = rng.random_range(0..4);
                // One key in four comes again, mostly with another payload.
                let number = if rng.random_bool(0.25) {
                    rng.random_range(0..=step)
                } else {
                    step
                };
                let request = Submit {
                    request_id: format!("r{number}"),
                    spec,
                    traceparent: None,
                };
                let result = store.submit(request.clone()).await;
                let expected = model.submit(&request, result.as_ref().ok().map(|job| job.id));
                same(step, "submit", result.map(timeless), expected.map(timeless));
            }
            16..20 => {
                let request = model.jobs.get(&target).map(|job| Submit {
                    request_id: job.request_id.clone(),
                    spec: job.spec.clone(),
                    traceparent: None,
                });
                if let Some(request) = request {
                    let expected = model.submit(&request, None);
                    same(
                        step,
                        "submit again",
                        store.submit(request).await.map(timeless),
                        expected.map(timeless),
                    );
                }
            }
            20..44 => {
                let me = WORKERS[rng.random_range(0..WORKERS.len())];
                let expected = Ok(model.lease(me).map(timeless));
                same(
                    step,
                    "lease",
                    store.lease(&worker(me)).await.map(|job| job.map(timeless)),
                    expected,
                );
            }
            44..52 => {
                let held_by = model.jobs.get(&target).and_then(|job| job.worker.clone());
                let expected = match model.jobs.get_mut(&target) {
                    Some(job) => job
                        .heartbeat(attempt, None, now, PATIENT.lease)
                        .map_err(|_refusal| "lease lost"),
                    None => Err("not found"),
                };
                let drain = held_by.is_some_and(|id| model.draining.contains(id.as_str()));
                let result = store.heartbeat(target, attempt, None, Vec::new()).await;
                same(
                    step,
                    "heartbeat",
                    result.map(|o| (o.cancel, o.drain)),
                    expected.map(|cancel| (cancel, drain)),
                );
            }
            52..57 => {
                let checkpoint = Checkpoint {
                    digest: digest(rng.random_range(0..9)),
                    size_bytes: step,
                };
                let expected = match model.jobs.get_mut(&target) {
                    Some(job) => job
                        .checkpointed(attempt, checkpoint.clone())
                        .map_err(|_refusal| "lease lost"),
                    None => Err("not found"),
                };
                same(
                    step,
                    "checkpoint",
                    store.checkpoint(target, attempt, checkpoint).await,
                    expected,
                );
            }
            57..66 => {
                let bundle = bundle(rng.random_range(0..3));
                let expected = model.publish(target, attempt, &bundle);
                let result = store.publish_and_complete(target, attempt, bundle).await;
                same(
                    step,
                    "publish",
                    result.map(version_timeless),
                    expected.map(version_timeless),
                );
            }
            66..74 => {
                let kinds = [
                    FailureKind::Transient,
                    FailureKind::Crashed,
                    FailureKind::Crashed,
                    FailureKind::InvalidInput,
                    FailureKind::Cancelled,
                ];
                let failure = failure(kinds[rng.random_range(0..kinds.len())]);
                let expected = match model.jobs.get_mut(&target) {
                    Some(job) => job
                        .fail(attempt, failure.clone(), now, &PATIENT.backoff)
                        .map_err(|_refusal| "lease lost"),
                    None => Err("not found"),
                };
                same(
                    step,
                    "fail",
                    store.fail(target, attempt, failure, Vec::new()).await,
                    expected,
                );
            }
            74..80 => {
                let expected = match model.jobs.get_mut(&target) {
                    Some(job) => {
                        job.cancel(now);
                        Ok(timeless(job.clone()))
                    }
                    None => Err("not found"),
                };
                same(
                    step,
                    "cancel",
                    store.cancel(target).await.map(timeless),
                    expected,
                );
            }
            80..85 => {
                let expected = match model.jobs.get_mut(&target) {
                    Some(job) => job
                        .retry(now)
                        .map_err(|_refusal| "not allowed")
                        .map(|()| timeless(job.clone())),
                    None => Err("not found"),
                };
                same(
                    step,
                    "retry",
                    store.retry(target).await.map(timeless),
                    expected,
                );
            }
            85..88 => {
                for job in model
                    .jobs
                    .values_mut()
                    .filter(|job| job.id == target && job.state == JobState::Leased)
                {
                    job.lease_until = Some(PAST);
                    bench.end_lease(target).await;
                }
            }
            88..91 => {
                let mut expected = BTreeSet::new();
                for job in model.jobs.values_mut() {
                    if job.expire(now) {
                        expected.insert(job.id);
                    }
                }
                let reaped = store.reap().await.unwrap();
                let all: BTreeSet<_> = reaped
                    .requeued
                    .iter()
                    .chain(&reaped.ended)
                    .copied()
                    .collect();
                assert_eq!(all, expected, "step {step}: reap");
            }
            91..94 => {
                for job in model
                    .jobs
                    .values_mut()
                    .filter(|job| job.id == target && job.state == JobState::Queued)
                {
                    job.not_before = PAST;
                    bench.end_backoff(target).await;
                }
            }
            94..96 => {
                let collection = Collection {
                    name: object.collection.clone(),
                    weight: [0.5, 1.0, 3.0][rng.random_range(0..3)],
                    max_running: [0, 0, 1, 3][rng.random_range(0..4)],
                    paused: rng.random_bool(0.2),
                };
                model
                    .collections
                    .insert(collection.name.clone(), collection.clone());
                same(
                    step,
                    "set collection",
                    store.set_collection(collection.clone()).await,
                    Ok(collection),
                );
            }
            96 => {
                let me = WORKERS[rng.random_range(0..WORKERS.len())];
                let drain = rng.random_bool(0.4);
                let expected = if model.seen.contains(me) {
                    Ok(())
                } else {
                    Err("not found")
                };
                if expected.is_ok() && drain {
                    model.draining.insert(me);
                } else {
                    model.draining.remove(me);
                }
                same(
                    step,
                    "drain",
                    store.drain_worker(&me.parse().unwrap(), drain).await,
                    expected,
                );
            }
            _ => {
                let number = model.last_version.get(&object).copied().unwrap_or(0);
                let reference = match rng.random_range(0..3) {
                    0 => "latest".to_owned(),
                    1 => "approved".to_owned(),
                    _ => format!("v{}", rng.random_range(0..=number + 1)),
                };
                if rng.random_bool(0.3) {
                    let expected = model.restore(&object, &reference).map(version_timeless);
                    let result = store.restore(&object, &reference).await;
                    same(step, "restore", result.map(version_timeless), expected);
                } else if rng.random_bool(0.5) {
                    let expected = model
                        .set_alias(&object, &reference, "approved")
                        .map(version_timeless);
                    let result = store.set_alias(&object, &reference, "approved").await;
                    same(step, "alias", result.map(version_timeless), expected);
                } else {
                    let expected = model.retire(&object, &reference).map(version_timeless);
                    same(
                        step,
                        "retire",
                        store
                            .retire(&object, &reference)
                            .await
                            .map(version_timeless),
                        expected,
                    );
                }
            }
        }
        if step % 200 == 0 || step + 1 == steps {
            compare_all(bench, &model, step).await;
        }
    }
    for state in JobState::ALL {
        let reached = model.jobs.values().filter(|job| job.state == state).count();
        assert!(reached > 0, "the operations no longer reach {state:?}");
    }
    assert!(!model.versions.is_empty() && model.versions.values().any(|version| version.retired));
}
