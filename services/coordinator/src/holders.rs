//! Who took which lease, and so may report about it.
//!
//! A lease belongs to the token or certificate that took it, whichever coordinator gave it: heartbeats, checkpoints and
//! results from anybody else are refused. A rotated token and a renewed certificate of the same name keep theirs.
//!
//! Invariant: who holds an attempt never changes once it was given out, so the answer of the database is remembered, and
//! looking before the transaction that follows is as good as looking within it.

use std::collections::HashMap;
use std::sync::{Mutex, MutexGuard, PoisonError};

use ign_proto::{Attempt, Cause, CollectionId, JobId, Scope};
use ign_queue::Job;

use crate::access::Caller;
use crate::app::App;
use crate::http_answer::Refused;

/// Attempts remembered at once; more and all are looked up again.
const MAX_KNOWN: usize = 10_000;

/// Holders of the attempts that were asked about.
#[derive(Debug, Default)]
pub(crate) struct Holders {
    known: Mutex<HashMap<(JobId, Attempt), Held>>,
}

#[derive(Clone, Debug)]
struct Held {
    collection: CollectionId,
    /// None where an older coordinator gave the lease.
    holder: Option<String>,
}

impl Holders {
    fn known(&self) -> MutexGuard<'_, HashMap<(JobId, Attempt), Held>> {
        self.known.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Remembers the current attempt of a job that was leased.
    pub(crate) fn remember(&self, job: &Job) {
        let mut known = self.known();
        if known.len() >= MAX_KNOWN {
            known.clear();
        }
        let held = Held {
            collection: job.spec.object.collection.clone(),
            holder: job.holder.clone(),
        };
        known.insert((job.id, job.attempt), held);
    }
}

impl App {
    /// Refuses unless the caller holds the attempt; a job of a collection that it does not work for does not exist.
    pub(crate) async fn check_holder(
        &self,
        caller: &Caller,
        job: JobId,
        attempt: Attempt,
    ) -> Result<(), Refused> {
        let known = self.holders.known().get(&(job, attempt)).cloned();
        let held = if let Some(held) = known {
            held
        } else {
            let found = self.store.get(job).await?;
            if found.is_taken(attempt) {
                self.holders.remember(&found);
            } else if caller.may(Scope::Publish, &found.spec.object.collection) {
                return Err(Cause::LeaseLost {
                    job: job.to_string(),
                    attempt: attempt.0,
                }
                .into());
            }
            Held {
                collection: found.spec.object.collection,
                holder: found.holder,
            }
        };
        if !caller.may(Scope::Publish, &held.collection) {
            return Err(Cause::absent("job", job).into());
        }
        match held.holder {
            Some(holder) if holder != caller.name => {
                tracing::warn!(job.id = %job, job.attempt = attempt.0, holder, caller = caller.name, "a report from another than the lease's holder was refused");
                Err(Cause::Forbidden {
                    message: format!(
                        "attempt {attempt} of job {job} was leased to another token or certificate"
                    ),
                }
                .into())
            }
            _ => Ok(()),
        }
    }
}
