//! The schema goes up, down and up again.

use ign_testkit::Postgres;
use sqlx::migrate::Migrator;

static FOR_POSTGRES: Migrator = sqlx::migrate!("../../migrations/postgres");
static FOR_SQLITE: Migrator = sqlx::migrate!("../../migrations/sqlite");

#[tokio::test]
async fn postgres_up_down_up() {
    let url = Postgres::shared().unwrap().create_database().unwrap();
    let pool = sqlx::PgPool::connect(&url).await.unwrap();
    FOR_POSTGRES.run(&pool).await.unwrap();
    FOR_POSTGRES.undo(&pool, 0).await.unwrap();
    let left: i64 =
        sqlx::query_scalar("select count(*) from pg_tables where schemaname = 'public' and tablename not like '_sqlx%'")
            .fetch_one(&pool)
            .await
            .unwrap();
    assert_eq!(left, 0);
    FOR_POSTGRES.run(&pool).await.unwrap();
}

#[tokio::test]
async fn sqlite_up_down_up() {
    let dir = tempfile::tempdir().unwrap();
    let pool =
        sqlx::SqlitePool::connect(&format!("sqlite://{}/t.db?mode=rwc", dir.path().display()))
            .await
            .unwrap();
    FOR_SQLITE.run(&pool).await.unwrap();
    FOR_SQLITE.undo(&pool, 0).await.unwrap();
    let left: i64 = sqlx::query_scalar(
        "select count(*) from sqlite_schema where type = 'table' and name not like '_sqlx%' and name not like 'sqlite%'",
    )
    .fetch_one(&pool)
    .await
    .unwrap();
    assert_eq!(left, 0);
    FOR_SQLITE.run(&pool).await.unwrap();
}
