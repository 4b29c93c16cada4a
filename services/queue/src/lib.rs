//! Job state machine and its two stores, Postgres and SQLite.
