//! Claim, rescue and publish: one job, two workers, any number of coordinators.
//!
//! The job is the real state machine; the bucket and the steps of a publish are those of the coordinator's `publish`
//! module. Workers crash or freeze (whoever is not chosen for long enough is frozen), answers get lost, coordinators die
//! between two steps, leases run out whenever it hurts most.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use chrono::{DateTime, TimeDelta, Utc};
use ign_proto::{Attempt, Digest, JobId};
use ign_queue::{Backoff, Failure, FailureKind, Job, JobSpec, JobState};

use crate::explore::World;

const LEASE: Duration = Duration::from_secs(45);
const WORKERS: usize = 2;
const MAX_ATTEMPTS: u32 = 3;

/// How the coordinator publishes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Variant {
    /// As it does: the attempt is checked in the transaction that makes the version; the bucket follows.
    Real,
    /// Broken: the attempt is checked first, the version is made in another transaction.
    ChecksTooEarly,
    /// Broken: whoever completes a leased job is believed.
    BelievesAnybody,
    /// Broken: the bucket's record is written before the database decided.
    RecordsTooEarly,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Step {
    CheckBlobs,
    PutManifest,
    CheckAttempt,
    Commit,
    PutRecord(u32),
    Answer(Option<u32>),
}

/// A call of Complete that a coordinator works on.
#[derive(Clone, Debug)]
struct Call {
    worker: usize,
    attempt: Attempt,
    step: Step,
}

#[derive(Clone, Debug, PartialEq, Eq)]
enum Worker {
    Idle,
    Bakes { attempt: Attempt, uploaded: bool },
    Heard { attempt: Attempt, version: u32 },
}

/// What an attempt bakes is named by its number: no two bakes give the same bytes.
#[derive(Clone, Debug)]
pub(crate) struct Publishing {
    variant: Variant,
    job: Job,
    /// The database's: version to the attempt whose bundle it is.
    versions: BTreeMap<u32, Attempt>,
    blobs: BTreeSet<Attempt>,
    manifests: BTreeSet<Attempt>,
    /// The bucket's.
    records: BTreeMap<u32, Attempt>,
    workers: [Worker; WORKERS],
    calls: Vec<Call>,
    crashes_left: u32,
    may_cancel: bool,
}

fn now() -> DateTime<Utc> {
    DateTime::UNIX_EPOCH
}

impl Publishing {
    pub(crate) fn new(variant: Variant) -> Self {
        let spec = JobSpec {
            object: "museum/vase".parse().unwrap(),
            capture_digest: Digest::of(b"capture"),
            recipe_json: "{}".to_owned(),
            priority: 0,
            labels: BTreeMap::new(),
            max_attempts: MAX_ATTEMPTS,
        };
        let id: JobId = "0192f0c1-0000-7000-8000-000000000001".parse().unwrap();
        Self {
            variant,
            job: Job::submit(id, "r".to_owned(), spec, now()),
            versions: BTreeMap::new(),
            blobs: BTreeSet::new(),
            manifests: BTreeSet::new(),
            records: BTreeMap::new(),
            workers: [Worker::Idle, Worker::Idle],
            calls: Vec::new(),
            crashes_left: 2,
            may_cancel: true,
        }
    }

    fn with(&self, change: impl FnOnce(&mut Self)) -> Self {
        let mut next = self.clone();
        change(&mut next);
        next
    }

    /// The commit: what the transaction of `publish_and_complete` does.
    fn commit(&mut self, attempt: Attempt) -> Option<u32> {
        if let (Some(version), true) = (self.job.version, self.job.attempt == attempt) {
            return Some(version);
        }
        let version = self.versions.len() as u32 + 1;
        let holder = match self.variant {
            Variant::Real | Variant::RecordsTooEarly => attempt,
            // Whatever the job became since it was looked at.
            Variant::ChecksTooEarly | Variant::BelievesAnybody => self.job.attempt,
        };
        if self.job.complete(holder, version, now()).is_err()
            && self.variant != Variant::ChecksTooEarly
        {
            return None;
        }
        self.versions.insert(version, attempt);
        Some(version)
    }

    /// The next step of a call.
    fn advance(&mut self, index: usize) {
        let call = self.calls[index].clone();
        let next = match call.step {
            Step::CheckBlobs if self.blobs.contains(&call.attempt) => Step::PutManifest,
            Step::CheckBlobs => Step::Answer(None),
            Step::PutManifest => {
                self.manifests.insert(call.attempt);
                match self.variant {
                    Variant::ChecksTooEarly => Step::CheckAttempt,
                    Variant::RecordsTooEarly => Step::PutRecord(self.versions.len() as u32 + 1),
                    _ => Step::Commit,
                }
            }
            Step::CheckAttempt => match self.job.holds(call.attempt) {
                Ok(()) => Step::Commit,
                Err(_lost) => Step::Answer(None),
            },
            Step::Commit => match self.commit(call.attempt) {
                Some(version) if self.variant == Variant::RecordsTooEarly => {
                    Step::Answer(Some(version))
                }
                Some(version) => Step::PutRecord(version),
                None => Step::Answer(None),
            },
            Step::PutRecord(version) => {
                self.records.entry(version).or_insert(call.attempt);
                if self.variant == Variant::RecordsTooEarly {
                    Step::Commit
                } else {
                    Step::Answer(Some(version))
                }
            }
            Step::Answer(outcome) => {
                self.calls.remove(index);
                let attempt = call.attempt;
                if matches!(&self.workers[call.worker], Worker::Bakes { attempt: own, .. } if *own == attempt)
                {
                    self.workers[call.worker] = match outcome {
                        Some(version) => Worker::Heard { attempt, version },
                        None => Worker::Idle,
                    };
                }
                return;
            }
        };
        self.calls[index].step = next;
    }
}

impl World for Publishing {
    fn steps(&self) -> Vec<(String, Self)> {
        let mut steps = Vec::new();
        for (index, worker) in self.workers.iter().enumerate() {
            let name = format!("worker {index}");
            match worker {
                Worker::Idle | Worker::Heard { .. } => {
                    let mut next = self.clone();
                    let id = format!("w{index}").parse().unwrap();
                    if next.job.lease(id, None, now(), LEASE).is_ok() {
                        next.workers[index] = Worker::Bakes {
                            attempt: next.job.attempt,
                            uploaded: false,
                        };
                        steps.push((format!("{name} leases"), next));
                    }
                }
                Worker::Bakes { attempt, uploaded } => {
                    let attempt = *attempt;
                    let calling = self
                        .calls
                        .iter()
                        .any(|call| call.worker == index && call.attempt == attempt);
                    if !uploaded {
                        let next = self.with(|next| {
                            next.blobs.insert(attempt);
                            next.workers[index] = Worker::Bakes {
                                attempt,
                                uploaded: true,
                            };
                        });
                        steps.push((format!("{name} uploads {attempt}"), next));
                        let next = self.with(|next| {
                            let crash = Failure {
                                kind: FailureKind::Crashed,
                                message: String::new(),
                                at: String::new(),
                                hint: String::new(),
                            };
                            // Refused when the lease is lost.
                            next.job
                                .fail(
                                    attempt,
                                    crash,
                                    now(),
                                    &Backoff {
                                        base: Duration::ZERO,
                                        cap: Duration::ZERO,
                                    },
                                )
                                .ok();
                            next.workers[index] = Worker::Idle;
                        });
                        steps.push((format!("{name} reports a failure of {attempt}"), next));
                    } else if !calling {
                        let next = self.with(|next| {
                            next.calls.push(Call {
                                worker: index,
                                attempt,
                                step: Step::CheckBlobs,
                            });
                        });
                        steps.push((format!("{name} completes {attempt}"), next));
                    }
                    if self.crashes_left > 0 {
                        let next = self.with(|next| {
                            next.workers[index] = Worker::Idle;
                            next.crashes_left -= 1;
                        });
                        steps.push((format!("{name} is killed"), next));
                    }
                }
            }
        }
        for (index, call) in self.calls.iter().enumerate() {
            let name = format!("the call of attempt {} in {:?}", call.attempt, call.step);
            steps.push((
                format!("{name} goes on"),
                self.with(|next| next.advance(index)),
            ));
            if self.crashes_left > 0 {
                let next = self.with(|next| {
                    next.calls.remove(index);
                    next.crashes_left -= 1;
                });
                steps.push((
                    format!("{name} dies with its coordinator, or its answer is lost"),
                    next,
                ));
            }
        }
        if self.job.state == JobState::Leased {
            let late = now() + LEASE + TimeDelta::seconds(1);
            let next = self.with(|next| {
                next.job.expire(late);
                next.job.not_before = now();
                if next.job.finished_at.is_some() {
                    next.job.finished_at = Some(now());
                }
            });
            steps.push(("the lease runs out".to_owned(), next));
        }
        if self.may_cancel && !self.job.state.is_terminal() {
            let next = self.with(|next| {
                next.job.cancel(now());
                next.may_cancel = false;
            });
            steps.push(("somebody cancels".to_owned(), next));
        }
        if let Some((version, attempt)) = self
            .versions
            .iter()
            .find(|(version, _)| !self.records.contains_key(version))
        {
            let next = self.with(|next| {
                next.records.insert(*version, *attempt);
            });
            steps.push((format!("a coordinator mirrors v{version}"), next));
        }
        steps
    }

    fn check(&self) -> Result<(), String> {
        self.job.check()?;
        if self.versions.len() > 1 {
            return Err(format!("one job published twice: {:?}", self.versions));
        }
        if self.job.version.is_some() != (self.versions.len() == 1) {
            return Err("the job and its version disagree".to_owned());
        }
        for (version, attempt) in &self.versions {
            if !self.manifests.contains(attempt) || !self.blobs.contains(attempt) {
                return Err(format!("v{version} is published without its files"));
            }
            if self.job.attempt != *attempt {
                return Err(format!("v{version} is of the stale attempt {attempt}"));
            }
        }
        for (version, attempt) in &self.records {
            if self.versions.get(version) != Some(attempt) {
                return Err(format!(
                    "the bucket shows v{version} of attempt {attempt}, which the database never accepted"
                ));
            }
        }
        for worker in &self.workers {
            if let Worker::Heard { attempt, version } = worker
                && self.versions.get(version) != Some(attempt)
            {
                return Err(format!(
                    "attempt {attempt} was told v{version}, which is lost"
                ));
            }
        }
        Ok(())
    }

    fn is_done(&self) -> bool {
        self.job.state.is_terminal() && self.calls.is_empty() && self.records == self.versions
    }
}
