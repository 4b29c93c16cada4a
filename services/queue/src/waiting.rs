//! Where a queued job stands and what it waits for, from plain numbers.

use chrono::{DateTime, Utc};

use crate::state::{Job, JobState};
use crate::store::{Collection, Waiting};

/// What the queue looks like around one job.
#[derive(Clone, Debug)]
pub(crate) struct Surroundings {
    /// The job's collection.
    pub(crate) collection: Collection,
    /// Jobs of the collection that are leased.
    pub(crate) running: u64,
    /// Queued jobs of the collection that come first by priority and age.
    pub(crate) ahead: u64,
    /// The other collections that are not paused.
    pub(crate) others: Vec<Rival>,
    /// Workers heard of within a lease that do not drain.
    pub(crate) workers: u64,
    pub(crate) now: DateTime<Utc>,
}

/// The queue of another collection, compared with the job's priority.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Rival {
    pub(crate) weight: f64,
    pub(crate) higher: u64,
    pub(crate) equal: u64,
}

pub(crate) fn describe(job: &Job, around: &Surroundings) -> Waiting {
    if job.state != JobState::Queued {
        return Waiting::default();
    }
    Waiting {
        position: position(around),
        reason: reason(job, around),
    }
}

/// Each rival gets its share by weight while the jobs ahead of this one in its own collection are served.
fn position(around: &Surroundings) -> u64 {
    let served = (around.ahead + 1) as f64;
    around
        .others
        .iter()
        .map(|rival| {
            let share = (served * rival.weight / around.collection.weight).ceil() as u64;
            rival.higher + rival.equal.min(share)
        })
        .fold(around.ahead, u64::saturating_add)
}

fn reason(job: &Job, around: &Surroundings) -> String {
    let collection = &around.collection;
    if collection.paused {
        return format!("collection {} is paused", collection.name);
    }
    if job.not_before > around.now {
        let until = job.not_before.format("%Y-%m-%d %H:%M:%S UTC");
        return match &job.failure {
            Some(failure) => {
                format!(
                    "backing off until {until} after attempt {}: {}",
                    job.attempt.0 - 1,
                    failure.message
                )
            }
            None => format!("backing off until {until}"),
        };
    }
    if collection.max_running > 0 && around.running >= u64::from(collection.max_running) {
        return format!(
            "collection {} runs its limit of {} jobs",
            collection.name, collection.max_running
        );
    }
    match around.workers {
        // As long as no worker is free, this is all there is to say.
        1.. if position(around) == 0 => {
            "it is next: the first worker that is free takes it".to_owned()
        }
        0 => "no worker is connected".to_owned(),
        1 => "the worker has other jobs first".to_owned(),
        workers => format!("all {workers} workers have other jobs first"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn around() -> Surroundings {
        Surroundings {
            collection: Collection::new("museum".parse().unwrap()),
            running: 0,
            ahead: 2,
            others: vec![
                Rival {
                    weight: 2.0,
                    higher: 1,
                    equal: 100,
                },
                Rival {
                    weight: 1.0,
                    higher: 0,
                    equal: 1,
                },
            ],
            workers: 3,
            now: DateTime::UNIX_EPOCH,
        }
    }

    #[test]
    fn position_counts_own_queue_and_the_share_of_rivals() {
        // 2 ahead, 1 of higher priority, twice as many as our 3 for the heavy rival, the light one's only job.
        assert_eq!(position(&around()), 2 + 1 + 6 + 1);
        assert_eq!(
            position(&Surroundings {
                others: Vec::new(),
                ahead: 0,
                ..around()
            }),
            0
        );
    }
}
