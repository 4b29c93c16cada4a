//! A store in a fresh database, and hands that reach around it.

use std::sync::Arc;
use std::time::Duration;

use ign_proto::{Attempt, Digest, JobId, ObjectName};
use ign_queue::{
    Backoff, Failure, FailureKind, Job, JobSpec, NewVersion, Settings, Store, StoreError, Submit,
    WorkerInfo,
};
use ign_testkit::Postgres;

/// Times so long that nothing runs out by itself; cases that want it move the database's times.
pub(crate) const PATIENT: Settings = Settings {
    lease: Duration::from_hours(1),
    backoff: Backoff {
        base: Duration::from_hours(1),
        cap: Duration::from_hours(2),
    },
    poll: Duration::from_millis(500),
};

pub(crate) const TRACE: &str = "00-4bf92f3577b34da6a3ce929d0e0e4736-00f067aa0ba902b7-01";

/// A way into the database around the store.
enum Beside {
    Sqlite(sqlx::SqlitePool),
    Postgres(sqlx::PgPool),
}

/// One database and a store on it.
pub(crate) struct Bench {
    pub(crate) store: Arc<dyn Store>,
    pub(crate) url: String,
    beside: Beside,
    _dir: Option<tempfile::TempDir>,
}

impl Bench {
    pub(crate) async fn sqlite() -> Self {
        // In memory where the system has a place for that: the model takes many steps, each flushed to disk.
        let memory = std::path::Path::new("/dev/shm");
        let dir = if memory.is_dir() {
            tempfile::tempdir_in(memory)
        } else {
            tempfile::tempdir()
        };
        let dir = dir.unwrap();
        let url = format!("sqlite://{}/ign.db", dir.path().display());
        let store = ign_queue::open(&url, PATIENT).await.unwrap();
        Self {
            store,
            beside: Beside::Sqlite(sqlx::SqlitePool::connect_lazy(&url).unwrap()),
            url,
            _dir: Some(dir),
        }
    }

    pub(crate) async fn postgres() -> Self {
        let url = tokio::task::spawn_blocking(|| Postgres::shared()?.create_database())
            .await
            .unwrap()
            .unwrap();
        let store = ign_queue::open(&url, PATIENT).await.unwrap();
        Self {
            store,
            beside: Beside::Postgres(
                sqlx::postgres::PgPoolOptions::new()
                    .max_connections(1)
                    .connect_lazy(&url)
                    .unwrap(),
            ),
            url,
            _dir: None,
        }
    }

    /// Another store on the same database.
    pub(crate) async fn open(&self, settings: Settings) -> Arc<dyn Store> {
        ign_queue::open(&self.url, settings).await.unwrap()
    }

    /// Runs SQL beside the store.
    pub(crate) async fn execute(&self, sql: String) {
        let sql = sqlx::AssertSqlSafe(sql);
        match &self.beside {
            Beside::Sqlite(pool) => sqlx::query(sql).execute(pool).await.map(drop).unwrap(),
            Beside::Postgres(pool) => sqlx::query(sql).execute(pool).await.map(drop).unwrap(),
        }
    }

    fn past(&self) -> &'static str {
        if self.url.starts_with("sqlite") {
            "1"
        } else {
            "timestamptz '2000-01-01'"
        }
    }

    /// Makes the job's lease run out now.
    pub(crate) async fn end_lease(&self, job: JobId) {
        self.execute(format!(
            "update jobs set lease_until = {} where id = '{job}'",
            self.past()
        ))
        .await;
    }

    /// Makes the job's back-off end now.
    pub(crate) async fn end_backoff(&self, job: JobId) {
        self.execute(format!(
            "update jobs set not_before = {} where id = '{job}'",
            self.past()
        ))
        .await;
    }

    /// Makes every delivery that waits due now.
    pub(crate) async fn end_pauses(&self) {
        self.execute(format!("update deliveries set next_at = {}", self.past()))
            .await;
    }

    /// Makes it long ago that the job ended.
    pub(crate) async fn end_long_ago(&self, job: JobId) {
        self.execute(format!(
            "update jobs set finished_at = {} where id = '{job}'",
            self.past()
        ))
        .await;
    }

    /// Makes it long ago that versions were retired.
    pub(crate) async fn retire_long_ago(&self) {
        self.execute(format!(
            "update versions set retired_at = {} where retired_at is not null",
            self.past()
        ))
        .await;
    }

    /// Queues a job of `collection/object`.
    pub(crate) async fn submit(&self, object: &str) -> Job {
        self.store.submit(request(object)).await.unwrap()
    }

    /// Queues and leases a job; no other may be queued.
    pub(crate) async fn running(&self, object: &str) -> Job {
        let submitted = self.submit(object).await;
        let job = self.lease("w").await.expect("a job is queued");
        assert_eq!(job.id, submitted.id);
        job
    }

    pub(crate) async fn lease(&self, id: &str) -> Option<Job> {
        self.store.lease(&worker(id)).await.unwrap()
    }

    pub(crate) async fn fail(&self, job: &Job, kind: FailureKind) -> bool {
        self.store
            .fail(job.id, job.attempt, failure(kind), Vec::new())
            .await
            .unwrap()
    }
}

/// A request with a key of its own.
pub(crate) fn request(object: &str) -> Submit {
    Submit {
        request_id: JobId::generate().to_string(),
        spec: spec(object),
        traceparent: Some(TRACE.to_owned()),
    }
}

pub(crate) fn spec(object: &str) -> JobSpec {
    JobSpec {
        object: name(object),
        capture_digest: digest(1),
        recipe_json: r#"{"preset":"standard"}"#.to_owned(),
        priority: 0,
        labels: [("batch".to_owned(), "friday".to_owned())].into(),
        max_attempts: 0,
    }
}

pub(crate) fn name(object: &str) -> ObjectName {
    object.parse().unwrap()
}

pub(crate) fn digest(number: u8) -> Digest {
    Digest::from_sha256([number; 32])
}

pub(crate) fn bundle(number: u8) -> NewVersion {
    NewVersion {
        manifest_digest: digest(number),
        size_bytes: 1_000_000 + u64::from(number),
        file_count: 9,
        metrics_json: r#"{"mse":4.9}"#.to_owned(),
    }
}

pub(crate) fn worker(id: &str) -> WorkerInfo {
    WorkerInfo {
        id: id.parse().unwrap(),
        hostname: "host".to_owned(),
        version: "0.1.0".to_owned(),
        device: "cpu".to_owned(),
    }
}

pub(crate) fn failure(kind: FailureKind) -> Failure {
    Failure {
        kind,
        message: "the disk is full".to_owned(),
        at: "sparse/cameras.txt:7".to_owned(),
        hint: "make room".to_owned(),
    }
}

/// Which error it is, without its details.
pub(crate) fn kind<T: std::fmt::Debug>(result: &Result<T, StoreError>) -> &'static str {
    match result {
        Ok(_) => "ok",
        Err(StoreError::NotFound { .. }) => "not found",
        Err(StoreError::Conflict { .. }) => "conflict",
        Err(StoreError::LeaseLost { .. }) => "lease lost",
        Err(StoreError::Invalid { .. }) => "invalid",
        Err(StoreError::NotAllowed { .. }) => "not allowed",
        Err(StoreError::Unavailable { .. }) => "unavailable",
        Err(StoreError::Internal { .. }) => "internal",
    }
}

pub(crate) fn after(attempt: Attempt) -> Attempt {
    Attempt(attempt.0 + 1)
}
