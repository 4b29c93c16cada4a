//! The life of a job as a pure state machine: no I/O, no clock. Time comes in as an argument (the stores pass the
//! database's), so that every rule can be tested exhaustively and both stores share one truth.
//!
//! ```text
//! queued -> leased -> succeeded | failed | cancelled
//!    ^---------'  a retry: queued with attempt + 1
//! ```
//!
//! Invariants (checked by [`Job::check`]):
//! - An attempt number is leased at most once, so it is a fencing token: whoever does not carry the current one of a
//!   leased job changes nothing and is told [`Refusal::LeaseLost`].
//! - A lease that ran out but was not yet given back by [`Job::expire`] still belongs to its worker: a late heartbeat
//!   revives it. Safety rests on the attempt, never on clocks.
//! - Only [`Job::complete`] leads to `succeeded`, and it carries a version.

use std::collections::BTreeMap;
use std::time::Duration;

use chrono::{DateTime, Utc};
use ign_proto::{Attempt, Digest, JobId, ObjectName, WorkerId};
use serde::{Deserialize, Serialize};

pub use ign_events::{Failure, FailureKind, Level, Progress};

/// Attempts of a job whose spec does not say.
pub const DEFAULT_MAX_ATTEMPTS: u32 = 4;

/// What to bake and how; immutable after submit.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct JobSpec {
    /// Whose bundle it becomes.
    pub object: ObjectName,
    /// Manifest of the capture.
    pub capture_digest: Digest,
    /// The recipe, JSON; its schema is the worker's.
    pub recipe_json: String,
    /// Larger goes first.
    pub priority: i32,
    /// Free words to find jobs by.
    pub labels: BTreeMap<String, String>,
    /// Tries before it counts as failed; at least 1.
    pub max_attempts: u32,
}

/// Where a job stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum JobState {
    /// Waits for a worker.
    Queued,
    /// A worker holds it.
    Leased,
    /// Its bundle is published.
    Succeeded,
    /// Ended without a result.
    Failed,
    /// Stopped on request.
    Cancelled,
}

impl JobState {
    /// All states, in the order of a job's life.
    pub const ALL: [Self; 5] = [
        Self::Queued,
        Self::Leased,
        Self::Succeeded,
        Self::Failed,
        Self::Cancelled,
    ];

    /// The word that the stores keep.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Queued => "queued",
            Self::Leased => "leased",
            Self::Succeeded => "succeeded",
            Self::Failed => "failed",
            Self::Cancelled => "cancelled",
        }
    }

    /// No transition leads on, except [`Job::retry`].
    pub fn is_terminal(self) -> bool {
        !matches!(self, Self::Queued | Self::Leased)
    }
}

impl std::str::FromStr for JobState {
    type Err = String;

    fn from_str(word: &str) -> Result<Self, String> {
        Self::ALL
            .into_iter()
            .find(|state| state.as_str() == word)
            .ok_or_else(|| format!("unknown job state {word:?}"))
    }
}

/// The newest state of training that a next attempt can resume from.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Checkpoint {
    /// Blob of the checkpoint.
    pub digest: Digest,
    /// Its size.
    pub size_bytes: u64,
}

/// One bake, from submit to its end.
#[derive(Clone, Debug, PartialEq)]
pub struct Job {
    /// Sorts by time of submission.
    pub id: JobId,
    /// Key of the submit within its collection.
    pub request_id: String,
    /// What to bake and how.
    pub spec: JobSpec,
    /// Where it stands.
    pub state: JobState,
    /// Number of the current attempt, or of the next one while queued; counts from 1.
    pub attempt: Attempt,
    /// Last attempt number before the job counts as failed; grows by a retry on request.
    pub attempt_limit: u32,
    /// Who holds it, or held it last; none while queued.
    pub worker: Option<WorkerId>,
    /// Whose token or certificate leased the current attempt: reports about it come from nobody else. None while queued,
    /// and where it is not known.
    pub holder: Option<String>,
    /// Its worker is to stop at the next heartbeat.
    pub cancel_requested: bool,
    /// How far the current attempt is.
    pub progress: Option<Progress>,
    /// Why the last attempt ended without a result.
    pub failure: Option<Failure>,
    /// Where the next attempt resumes.
    pub checkpoint: Option<Checkpoint>,
    /// Version of the object that it published.
    pub version: Option<u32>,
    /// When it was submitted.
    pub submitted_at: DateTime<Utc>,
    /// Not leased before this time (back-off).
    pub not_before: DateTime<Utc>,
    /// When the newest attempt was leased.
    pub started_at: Option<DateTime<Utc>>,
    /// When it reached a terminal state.
    pub finished_at: Option<DateTime<Utc>>,
    /// When the current lease runs out.
    pub lease_until: Option<DateTime<Utc>>,
    /// W3C trace context of the call that submitted it.
    pub traceparent: Option<String>,
}

/// Why a transition did not happen.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Refusal {
    /// The caller's attempt does not hold the job.
    LeaseLost,
    /// The state does not allow it.
    NotAllowed(JobState),
    /// Queued, but it backs off until later.
    NotYet,
}

/// How long a retry waits: doubling from `base` up to `cap`, then shortened by up to half.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Backoff {
    /// After the first attempt.
    pub base: Duration,
    /// Never longer.
    pub cap: Duration,
}

impl Default for Backoff {
    fn default() -> Self {
        Self {
            base: Duration::from_secs(5),
            cap: Duration::from_mins(5),
        }
    }
}

impl Backoff {
    /// The wait after `attempt` of `job`. The jitter that keeps jobs which failed together from coming back together is
    /// drawn from job and attempt, so that the state machine stays deterministic.
    pub fn delay(&self, job: JobId, attempt: Attempt) -> Duration {
        let doublings = attempt.0.saturating_sub(1).min(20);
        let full = self.base.saturating_mul(1 << doublings).min(self.cap);
        // SplitMix64's finaliser over the random bits of the id.
        let mut bits = job.as_uuid().as_u64_pair().1 ^ (u64::from(attempt.0) << 32);
        bits = (bits ^ (bits >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        bits = (bits ^ (bits >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        let unit = ((bits ^ (bits >> 31)) >> 11) as f64 / (1_u64 << 53) as f64;
        full.mul_f64(1.0 - 0.5 * unit)
    }
}

impl Job {
    /// A new job, first in state `queued`.
    pub fn submit(id: JobId, request_id: String, spec: JobSpec, now: DateTime<Utc>) -> Self {
        Self {
            id,
            request_id,
            state: JobState::Queued,
            attempt: Attempt(1),
            attempt_limit: spec.max_attempts,
            spec,
            worker: None,
            holder: None,
            cancel_requested: false,
            progress: None,
            failure: None,
            checkpoint: None,
            version: None,
            submitted_at: now,
            not_before: now,
            started_at: None,
            finished_at: None,
            lease_until: None,
            traceparent: None,
        }
    }

    /// Gives the job to a worker for `lease`; `holder` is who the worker is by its token or certificate.
    pub fn lease(
        &mut self,
        worker: WorkerId,
        holder: Option<String>,
        now: DateTime<Utc>,
        lease: Duration,
    ) -> Result<(), Refusal> {
        if self.state != JobState::Queued {
            return Err(Refusal::NotAllowed(self.state));
        }
        if self.not_before > now {
            return Err(Refusal::NotYet);
        }
        self.state = JobState::Leased;
        self.worker = Some(worker);
        self.holder = holder;
        self.progress = None;
        self.started_at = Some(now);
        self.lease_until = Some(now + lease);
        Ok(())
    }

    /// Whether `attempt` holds the job.
    pub fn holds(&self, attempt: Attempt) -> Result<(), Refusal> {
        if self.state == JobState::Leased && self.attempt == attempt {
            Ok(())
        } else {
            Err(Refusal::LeaseLost)
        }
    }

    /// Whether `attempt` is the last and was given out: from then on who holds it never changes.
    pub fn is_taken(&self, attempt: Attempt) -> bool {
        self.attempt == attempt && self.state != JobState::Queued
    }

    /// Extends the lease; answers whether the worker is to stop. A lease never becomes shorter.
    pub fn heartbeat(
        &mut self,
        attempt: Attempt,
        progress: Option<Progress>,
        now: DateTime<Utc>,
        lease: Duration,
    ) -> Result<bool, Refusal> {
        self.holds(attempt)?;
        self.lease_until = self.lease_until.max(Some(now + lease));
        if let Some(progress) = progress {
            self.progress = Some(sane(progress));
        }
        Ok(self.cancel_requested)
    }

    /// Remembers where the next attempt resumes.
    pub fn checkpointed(
        &mut self,
        attempt: Attempt,
        checkpoint: Checkpoint,
    ) -> Result<(), Refusal> {
        self.holds(attempt)?;
        self.checkpoint = Some(checkpoint);
        Ok(())
    }

    /// Ends the job with a published version. A cancel that comes with the result comes too late.
    pub fn complete(
        &mut self,
        attempt: Attempt,
        version: u32,
        now: DateTime<Utc>,
    ) -> Result<(), Refusal> {
        self.holds(attempt)?;
        self.version = Some(version);
        self.failure = None;
        self.finish(JobState::Succeeded, now);
        Ok(())
    }

    /// Ends the attempt without a result; answers whether the job is queued again.
    pub fn fail(
        &mut self,
        attempt: Attempt,
        failure: Failure,
        now: DateTime<Utc>,
        backoff: &Backoff,
    ) -> Result<bool, Refusal> {
        self.holds(attempt)?;
        let retryable = matches!(failure.kind, FailureKind::Transient | FailureKind::Crashed);
        let stopped = self.cancel_requested || failure.kind == FailureKind::Cancelled;
        self.failure = Some(failure);
        if stopped {
            self.finish(JobState::Cancelled, now);
        } else if retryable && attempt.0 < self.attempt_limit {
            self.requeue(now + backoff.delay(self.id, attempt));
            return Ok(true);
        } else {
            self.finish(JobState::Failed, now);
        }
        Ok(false)
    }

    /// Takes the job from a worker that was not heard of for a whole lease; answers whether anything changed. The next
    /// attempt waits for nothing: a lost worker says little about the job, and the limit of attempts bounds the harm.
    pub fn expire(&mut self, now: DateTime<Utc>) -> bool {
        if self.state != JobState::Leased || self.lease_until.is_none_or(|until| until > now) {
            return false;
        }
        let worker = self.worker.as_ref().map_or("its worker", WorkerId::as_str);
        self.failure = Some(Failure {
            kind: FailureKind::Crashed,
            message: format!(
                "attempt {} ended: {worker} was not heard of for a whole lease",
                self.attempt
            ),
            at: String::new(),
            hint: "look at the worker's own log: it was killed, froze or lost the network"
                .to_owned(),
        });
        if self.cancel_requested {
            self.finish(JobState::Cancelled, now);
        } else if self.attempt.0 < self.attempt_limit {
            self.requeue(now);
        } else {
            self.finish(JobState::Failed, now);
        }
        true
    }

    /// Stops the job: at once while queued, with its worker's next heartbeat while leased. Terminal jobs stay.
    pub fn cancel(&mut self, now: DateTime<Utc>) {
        match self.state {
            JobState::Queued => self.finish(JobState::Cancelled, now),
            JobState::Leased => self.cancel_requested = true,
            JobState::Succeeded | JobState::Failed | JobState::Cancelled => {}
        }
    }

    /// Queues a failed or cancelled job again, with a fresh allowance of attempts and its last checkpoint.
    pub fn retry(&mut self, now: DateTime<Utc>) -> Result<(), Refusal> {
        if !matches!(self.state, JobState::Failed | JobState::Cancelled) {
            return Err(Refusal::NotAllowed(self.state));
        }
        self.attempt_limit = self.attempt.0.saturating_add(self.spec.max_attempts);
        self.failure = None;
        self.finished_at = None;
        self.requeue(now);
        Ok(())
    }

    fn requeue(&mut self, not_before: DateTime<Utc>) {
        self.state = JobState::Queued;
        self.attempt = Attempt(self.attempt.0.saturating_add(1));
        self.worker = None;
        self.holder = None;
        self.progress = None;
        self.lease_until = None;
        self.not_before = not_before;
    }

    fn finish(&mut self, state: JobState, now: DateTime<Utc>) {
        self.state = state;
        self.cancel_requested = false;
        self.lease_until = None;
        self.finished_at = Some(now);
    }

    /// What must always hold; the message names what does not.
    pub fn check(&self) -> Result<(), &'static str> {
        let leased = self.state == JobState::Leased;
        let rules = [
            (
                leased == self.lease_until.is_some(),
                "a lease time belongs to leased jobs alone",
            ),
            (
                !leased || self.worker.is_some(),
                "a leased job has a worker",
            ),
            (
                !leased || self.started_at.is_some(),
                "a leased job has started",
            ),
            (
                self.state != JobState::Queued || (self.worker.is_none() && self.holder.is_none()),
                "a queued job has no worker and no holder",
            ),
            (
                self.state.is_terminal() == self.finished_at.is_some(),
                "only terminal jobs have an end",
            ),
            (
                (self.state == JobState::Succeeded) == self.version.is_some(),
                "only success has a version",
            ),
            (
                leased || !self.cancel_requested,
                "only a leased job waits for its cancel",
            ),
            (
                self.attempt.0 >= 1 && self.attempt.0 <= self.attempt_limit,
                "the attempt is within its limit",
            ),
        ];
        rules
            .iter()
            .find(|(holds, _)| !holds)
            .map_or(Ok(()), |(_, rule)| Err(rule))
    }
}

/// Numbers from a worker may be anything; JSON and people know only finite ones.
fn sane(mut progress: Progress) -> Progress {
    progress.percent = if progress.percent.is_finite() {
        progress.percent.clamp(0.0, 100.0)
    } else {
        0.0
    };
    progress.eta_secs = progress
        .eta_secs
        .filter(|secs| secs.is_finite() && *secs >= 0.0);
    progress.error = progress.error.filter(|error| error.is_finite());
    progress
}

#[cfg(test)]
mod tests {
    use super::*;

    const LEASE: Duration = Duration::from_secs(45);
    const BACKOFF: Backoff = Backoff {
        base: Duration::from_secs(8),
        cap: Duration::from_secs(20),
    };

    #[derive(Clone, Copy, Debug)]
    enum Op {
        Lease,
        Heartbeat,
        Complete,
        Fail(FailureKind),
        Expire,
        Cancel,
        Retry,
        StaleHeartbeat,
        StaleComplete,
        StaleFail,
    }

    const OPS: [Op; 13] = [
        Op::Lease,
        Op::Heartbeat,
        Op::Complete,
        Op::Fail(FailureKind::Transient),
        Op::Fail(FailureKind::Crashed),
        Op::Fail(FailureKind::InvalidInput),
        Op::Fail(FailureKind::Cancelled),
        Op::Expire,
        Op::Cancel,
        Op::Retry,
        Op::StaleHeartbeat,
        Op::StaleComplete,
        Op::StaleFail,
    ];

    fn job() -> Job {
        let spec = JobSpec {
            object: "museum/vase".parse().unwrap(),
            capture_digest: Digest::from_sha256([1; 32]),
            recipe_json: "{}".to_owned(),
            priority: 0,
            labels: BTreeMap::new(),
            max_attempts: 2,
        };
        Job::submit(
            JobId::generate(),
            "r".to_owned(),
            spec,
            DateTime::UNIX_EPOCH,
        )
    }

    fn failure(kind: FailureKind) -> Failure {
        Failure {
            kind,
            message: "no".to_owned(),
            at: String::new(),
            hint: String::new(),
        }
    }

    /// Applies one operation an hour after the last, when every lease and back-off has ended.
    fn apply(job: &mut Job, op: Op, now: DateTime<Utc>) -> bool {
        let current = job.attempt;
        let stale = Attempt(job.attempt.0 - 1);
        match op {
            Op::Lease => job
                .lease("w".parse().unwrap(), Some("token".to_owned()), now, LEASE)
                .is_ok(),
            Op::Heartbeat => job.heartbeat(current, None, now, LEASE).is_ok(),
            Op::Complete => job.complete(current, 1, now).is_ok(),
            Op::Fail(kind) => job.fail(current, failure(kind), now, &BACKOFF).is_ok(),
            Op::Expire => job.expire(now),
            Op::Cancel => {
                job.cancel(now);
                true
            }
            Op::Retry => job.retry(now).is_ok(),
            Op::StaleHeartbeat => job.heartbeat(stale, None, now, LEASE).is_ok(),
            Op::StaleComplete => job.complete(stale, 1, now).is_ok(),
            Op::StaleFail => job
                .fail(stale, failure(FailureKind::Crashed), now, &BACKOFF)
                .is_ok(),
        }
    }

    /// Every sequence of operations up to `depth`, from a fresh job.
    fn explore(
        job: &Job,
        depth: u32,
        now: DateTime<Utc>,
        seen: &mut std::collections::HashSet<JobState>,
    ) {
        seen.insert(job.state);
        if depth == 0 {
            return;
        }
        let now = now + Duration::from_hours(1);
        for op in OPS {
            let mut next = job.clone();
            let done = apply(&mut next, op, now);
            next.check()
                .unwrap_or_else(|rule| panic!("{rule}: {op:?} on {job:?}"));
            assert!(next.attempt >= job.attempt, "attempts never go back");
            if !done {
                assert_eq!(&next, job, "a refused {op:?} changed something");
            }
            if matches!(op, Op::StaleHeartbeat | Op::StaleComplete | Op::StaleFail) {
                assert!(!done, "a stale attempt was obeyed: {op:?} on {job:?}");
            }
            if matches!(op, Op::Lease) && done {
                assert!(job.worker.is_none(), "leased twice");
            }
            if job.is_taken(job.attempt) && next.is_taken(job.attempt) {
                assert_eq!(next.holder, job.holder, "another holder of one attempt");
            }
            if job.state == JobState::Leased && next.state == JobState::Queued {
                assert_eq!(
                    next.attempt.0,
                    job.attempt.0 + 1,
                    "the next attempt has its own number"
                );
            }
            if job.state == JobState::Succeeded {
                assert_eq!(&next, job, "success is final");
            }
            explore(&next, depth - 1, now, seen);
        }
    }

    #[test]
    fn every_sequence_of_operations_keeps_the_rules() {
        let mut seen = std::collections::HashSet::new();
        explore(&job(), 5, DateTime::UNIX_EPOCH, &mut seen);
        assert_eq!(seen.len(), JobState::ALL.len());
    }

    #[test]
    fn backoff_doubles_up_to_its_cap_with_jitter_of_at_most_half() {
        let mut distinct = std::collections::HashSet::new();
        for _ in 0..200 {
            let id = JobId::generate();
            for (attempt, full) in [(1, 8), (2, 16), (3, 20), (4, 20), (u32::MAX, 20)] {
                let delay = BACKOFF.delay(id, Attempt(attempt));
                assert_eq!(delay, BACKOFF.delay(id, Attempt(attempt)));
                assert!(
                    delay <= Duration::from_secs(full) && delay >= Duration::from_secs(full) / 2
                );
                distinct.insert(delay);
            }
        }
        assert!(
            distinct.len() > 900,
            "jobs that failed together come back together"
        );
    }

    #[test]
    fn a_lease_is_not_taken_before_its_time_and_not_shortened() {
        let mut job = job();
        let now = DateTime::UNIX_EPOCH;
        job.not_before = now + Duration::from_secs(1);
        assert_eq!(
            job.lease("w".parse().unwrap(), None, now, LEASE),
            Err(Refusal::NotYet)
        );
        job.lease(
            "w".parse().unwrap(),
            None,
            now + Duration::from_secs(1),
            LEASE,
        )
        .unwrap();
        let until = job.lease_until;
        // A clock that was set back.
        job.heartbeat(Attempt(1), None, now, LEASE).unwrap();
        assert_eq!(job.lease_until, until);
        assert!(!job.expire(now + LEASE));
        assert!(job.expire(now + LEASE + Duration::from_secs(1)));
    }
}
