//! The schema goes up, down and up again, with data in it, and each step leaves the program before it working: a rolling
//! upgrade runs both at once.

use ign_queue::schema;
use ign_testkit::Postgres;
use sqlx::AssertSqlSafe;

/// The last step.
const NEWEST: i64 = 24;

/// Columns of the first schema, in every table.
const FIRST: [(&str, &str); 7] = [
    ("collections", "name, weight, max_running, paused"),
    (
        "jobs",
        "id, collection, object, request_id, capture_digest, recipe_json, priority, labels, max_attempts, state, \
         attempt, attempt_limit, worker, cancel_requested, progress, failure, checkpoint_digest, checkpoint_bytes, \
         version, submitted_at, not_before, started_at, finished_at, lease_until, log_seq",
    ),
    ("job_logs", "job_id, seq, at, attempt, level, message"),
    (
        "workers",
        "id, hostname, version, device, last_seen_at, draining",
    ),
    ("objects", "collection, object, last_version"),
    (
        "versions",
        "collection, object, version, manifest_digest, size_bytes, file_count, metrics_json, job_id, created_at, retired",
    ),
    ("aliases", "collection, object, alias, version"),
];

/// A database of either sort.
enum Database {
    Postgres(sqlx::PgPool),
    Sqlite(sqlx::SqlitePool),
}

impl Database {
    async fn up(&self, to: i64) {
        match self {
            Self::Postgres(pool) => schema::postgres().run_to(to, pool).await.unwrap(),
            Self::Sqlite(pool) => schema::sqlite().run_to(to, pool).await.unwrap(),
        }
    }

    async fn down(&self, to: i64) {
        match self {
            Self::Postgres(pool) => schema::postgres().undo(pool, to).await.unwrap(),
            Self::Sqlite(pool) => schema::sqlite().undo(pool, to).await.unwrap(),
        }
    }

    /// Runs SQL in which `{at}` stands for a time and `{true}` for a truth.
    async fn execute(&self, sql: &str) {
        match self {
            Self::Postgres(pool) => {
                let sql = sql
                    .replace("{at}", "timestamptz '2026-01-02 03:04:05.678901+00'")
                    .replace("{true}", "true")
                    .replace("{bytes}", "'\\x00ff'::bytea");
                sqlx::query(AssertSqlSafe(sql)).execute(pool).await.unwrap();
            }
            Self::Sqlite(pool) => {
                let sql = sql
                    .replace("{at}", "1767323045678901")
                    .replace("{true}", "1")
                    .replace("{bytes}", "x'00ff'");
                sqlx::query(AssertSqlSafe(sql)).execute(pool).await.unwrap();
            }
        }
    }

    /// Rows of a query, as text.
    async fn rows(&self, columns: &str, table: &str) -> Vec<String> {
        match self {
            Self::Postgres(pool) => {
                let sql = format!(
                    "select row_to_json(t)::text from (select {columns} from {table}) t order by 1"
                );
                sqlx::query_scalar(AssertSqlSafe(sql))
                    .fetch_all(pool)
                    .await
                    .unwrap()
            }
            Self::Sqlite(pool) => {
                let sql = format!("select json_array({columns}) from {table} order by 1");
                sqlx::query_scalar(AssertSqlSafe(sql))
                    .fetch_all(pool)
                    .await
                    .unwrap()
            }
        }
    }

    async fn first_schema(&self) -> Vec<Vec<String>> {
        let mut all = Vec::new();
        for (table, columns) in FIRST {
            all.push(self.rows(columns, table).await);
        }
        all
    }

    /// What the program of the first schema writes.
    async fn fill(&self) {
        self.execute("insert into collections (name, weight) values ('museum', 2.5)")
            .await;
        for (number, state, extra) in [
            (1, "succeeded", "1, {at}, null"),
            (2, "succeeded", "2, {at}, null"),
            (3, "leased", "null, null, {at}"),
            (4, "queued", "null, null, null"),
            (5, "failed", "null, {at}, null"),
        ] {
            self.execute(&format!(
                "insert into jobs (id, collection, object, request_id, capture_digest, recipe_json, priority, labels, \
                 max_attempts, state, attempt, attempt_limit, cancel_requested, submitted_at, not_before, version, \
                 finished_at, lease_until) values ('0192f0c1-0000-7000-8000-00000000000{number}', 'museum', 'vase', \
                 'r{number}', 'sha256:c{number}', '{{}}', 0, '{{}}', 4, '{state}', 1, 4, not {{true}}, {{at}}, {{at}}, \
                 {extra})"
            ))
            .await;
        }
        self.execute(
            "insert into job_logs values ('0192f0c1-0000-7000-8000-000000000003', 1, {at}, 1, 'info', 'hello')",
        )
        .await;
        self.execute("insert into workers (id, hostname, version, device, last_seen_at) values ('w', 'h', '0', 'cpu', {at})")
            .await;
        self.execute("insert into objects values ('museum', 'vase', 2)")
            .await;
        self.publish_as_before(1).await;
        self.publish_as_before(2).await;
        self.retire_as_before(1).await;
        for alias in ["latest", "approved"] {
            self.execute(&format!(
                "insert into aliases values ('museum', 'vase', '{alias}', 2)"
            ))
            .await;
        }
    }

    /// The statement with which the program of the first schema publishes.
    async fn publish_as_before(&self, version: u32) {
        self.execute(&format!(
            "insert into versions (collection, object, version, manifest_digest, size_bytes, file_count, metrics_json, \
             job_id, created_at) values ('museum', 'vase', {version}, 'sha256:m{version}', 5, 1, '{{}}', \
             '0192f0c1-0000-7000-8000-00000000000{version}', {{at}})"
        ))
        .await;
    }

    async fn retire_as_before(&self, version: u32) {
        self.execute(&format!(
            "update versions set retired = {{true}} where version = {version}"
        ))
        .await;
    }

    /// Up, down and up again, from one schema to the next and at once.
    async fn check(&self) {
        self.up(1).await;
        self.fill().await;
        let before = self.first_schema().await;
        self.up(2).await;
        assert_eq!(self.first_schema().await, before, "going up loses nothing");
        let times = self.rows("retired_at", "versions where retired").await;
        assert!(
            times.len() == 1 && !times[0].contains("null"),
            "the grace of what was retired begins: {times:?}"
        );

        // The program before goes on, beside the new one: it publishes, retires, moves aliases.
        self.execute("update jobs set state = 'succeeded', version = 3, lease_until = null, finished_at = {at} where request_id = 'r3'")
            .await;
        self.publish_as_before(3).await;
        self.execute("update objects set last_version = 3").await;
        self.execute("update aliases set version = 3 where alias = 'latest'")
            .await;
        self.retire_as_before(3).await;
        let both = self.first_schema().await;

        // A version whose job is gone, as a rebuilt registry has it.
        self.execute("insert into objects values ('library', 'urn', 1)")
            .await;
        self.execute(
            "insert into versions (collection, object, version, manifest_digest, size_bytes, file_count, metrics_json, \
             job_id, created_at) values ('library', 'urn', 1, 'sha256:u1', 5, 1, '{}', \
             '0192f0c1-0000-7000-8000-0000000000aa', {at})",
        )
        .await;
        let rebuilt = self.first_schema().await;

        self.down(1).await;
        let down = self.first_schema().await;
        for (index, (table, _)) in FIRST.into_iter().enumerate() {
            match table {
                // The program before wants a job behind each version, and a collection behind each job.
                "jobs" | "collections" => {
                    assert_eq!(down[index].len(), both[index].len() + 1, "{table}");
                    assert!(both[index].iter().all(|row| down[index].contains(row)));
                }
                _ => assert_eq!(down[index], rebuilt[index], "{table}"),
            }
        }
        self.up(2).await;
        assert_eq!(self.first_schema().await, down);

        // The later steps only add: the program before goes on beside them, and nothing is lost on the way back.
        self.up(NEWEST).await;
        assert_eq!(self.first_schema().await, down);
        self.execute("update jobs set state = 'leased', worker = 'w', lease_until = {at} where request_id = 'r4'")
            .await;
        self.execute(
            "insert into webhooks values ('museum', 'https://archive.example', {bytes}, {at})",
        )
        .await;
        let both = self.first_schema().await;
        self.down(2).await;
        assert_eq!(self.first_schema().await, both);
        self.up(NEWEST).await;
        assert_eq!(self.first_schema().await, both);
        self.down(0).await;
        self.up(NEWEST).await;
    }
}

#[tokio::test]
async fn postgres_up_down_up_with_data() {
    let url = Postgres::shared().unwrap().create_database().unwrap();
    let database = Database::Postgres(sqlx::PgPool::connect(&url).await.unwrap());
    database.check().await;
    database.down(0).await;
    let left = database
        .rows(
            "tablename",
            "pg_tables where schemaname = 'public' and tablename not like '_sqlx%'",
        )
        .await;
    assert!(left.is_empty(), "{left:?}");
}

#[tokio::test]
async fn sqlite_up_down_up_with_data() {
    let dir = tempfile::tempdir().unwrap();
    let url = format!("sqlite://{}/t.db?mode=rwc", dir.path().display());
    let database = Database::Sqlite(sqlx::SqlitePool::connect(&url).await.unwrap());
    database.check().await;
    database.down(0).await;
    let left = database
        .rows(
            "name",
            "sqlite_schema where type = 'table' and name not like '_sqlx%' and name not like 'sqlite%'",
        )
        .await;
    assert!(left.is_empty(), "{left:?}");
}
