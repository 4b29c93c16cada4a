//! One suite for both stores: every case runs on `SQLite` and on Postgres, each in a database of its own with the real
//! migrations. `model` drives both with random operations against the pure state machine; `postgres_only` has what takes
//! a server.

#![expect(clippy::unwrap_used, reason = "a panic is how a test fails")]

mod bench;
mod cases;
mod migrations;
mod model;
mod postgres_only;
mod tokens;
mod webhooks;

macro_rules! conformance {
    ($($case:ident),* $(,)?) => {
        mod sqlite {
            $(#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
            async fn $case() {
                super::cases::$case(&super::bench::Bench::sqlite().await).await;
            })*
        }
        mod postgres {
            $(#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
            async fn $case() {
                super::cases::$case(&super::bench::Bench::postgres().await).await;
            })*
        }
    };
}

conformance![
    a_holder_is_that_of_its_attempt,
    a_newer_schema_is_worked_with,
    aliases_and_retirement,
    attempts_run_out_and_retry_gives_new_ones,
    backoff_ends_by_itself,
    batches_answer_each_request,
    cancel_in_every_state,
    changes_between_query_and_wait_are_not_missed,
    concurrent_publications_of_one_object_get_distinct_versions,
    data_outlive_the_store,
    deliveries_go_on_until_they_are_taken_or_given_up,
    drained_workers_get_nothing,
    ends_are_announced,
    events_and_turns,
    failures_decide_by_kind,
    find_takes_unambiguous_prefixes,
    flood_of_one_collection_does_not_starve_another,
    heartbeats_keep_a_short_lease_alive,
    leases_run_out_by_the_databases_clock,
    life_of_a_job,
    limits_hold_under_concurrent_leases,
    lists_filter_and_page,
    logs_are_ordered_bounded_and_counted_once,
    one_lease_for_each_job_among_64_workers,
    order_is_priority_then_age,
    paused_collections_wait,
    publish_is_idempotent,
    stale_attempts_change_nothing,
    status_shows_one_screen,
    submits_are_idempotent,
    tokens_rotate_expire_and_end,
    versions_are_adopted,
    waiting_jobs_say_why,
    weights_share_the_workers,
    what_is_named_is_known,
    workers_stay_within_their_collections,
    worthless_requests_are_refused,
];

/// A hundred thousand steps on one store, ten thousand on the other, which takes a server and is slower.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn random_operations_on_sqlite_match_the_model() {
    model::rounds(50, bench::Bench::sqlite).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn random_operations_on_postgres_match_the_model() {
    model::rounds(5, bench::Bench::postgres).await;
}
