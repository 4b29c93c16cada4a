//! End-to-end tests with real processes, a real Postgres and a real S3 endpoint.
