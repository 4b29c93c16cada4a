//! What the database keeps of a value, and back.

use chrono::{DateTime, Utc};
use ign_proto::{Attempt, ObjectName};
use sqlx::types::Json;
use sqlx::{AssertSqlSafe, Row};

use super::super::{from_db, from_key};
use super::{DbRow, DbTime};
use crate::state::{Checkpoint, Failure, Job, JobSpec, Level, Progress};
use crate::store::{Collection, NewVersion, Result, StoreError, Version, WorkerInfo};

pub(super) fn sql(text: String) -> AssertSqlSafe<String> {
    // Only constants of this file and its parents are formatted in; values are bound.
    AssertSqlSafe(text)
}

pub(super) fn internal(message: impl std::fmt::Display) -> StoreError {
    StoreError::Internal {
        message: message.to_string(),
        source: None,
    }
}

pub(super) fn parse<T: std::str::FromStr>(text: &str) -> Result<T>
where
    T::Err: std::fmt::Display,
{
    text.parse().map_err(internal)
}

pub(super) fn seconds(secs: i64) -> chrono::TimeDelta {
    chrono::TimeDelta::seconds(secs)
}

/// A count or size that is never negative.
pub(super) fn count(value: i64) -> u64 {
    value.max(0) as u64
}

pub(super) fn small(value: i64) -> Result<u32> {
    u32::try_from(value).map_err(|_range| internal(format!("{value} is out of range")))
}

pub(super) fn time(row: &DbRow, column: &str) -> Result<DateTime<Utc>> {
    from_db(row.try_get::<DbTime, _>(column)?)
}

pub(super) fn optional_time(row: &DbRow, column: &str) -> Result<Option<DateTime<Utc>>> {
    row.try_get::<Option<DbTime>, _>(column)?
        .map(from_db)
        .transpose()
}

pub(super) fn object_name(row: &DbRow) -> Result<ObjectName> {
    Ok(ObjectName {
        collection: parse(row.try_get("collection")?)?,
        object: parse(row.try_get("object")?)?,
    })
}

pub(super) fn job_from(row: &DbRow) -> Result<Job> {
    let checkpoint = match row.try_get::<Option<&str>, _>("checkpoint_digest")? {
        Some(digest) => Some(Checkpoint {
            digest: parse(digest)?,
            size_bytes: count(row.try_get("checkpoint_bytes")?),
        }),
        None => None,
    };
    let attempt = Attempt(small(row.try_get("attempt")?)?);
    // An older coordinator leases without a holder and leaves that of an earlier attempt there.
    let holder = match row.try_get::<Option<i64>, _>("holder_attempt")? {
        Some(of) if of == i64::from(attempt.0) => row.try_get("holder")?,
        _ => None,
    };
    Ok(Job {
        id: from_key(row.try_get("id")?)?,
        request_id: row.try_get("request_id")?,
        spec: JobSpec {
            object: object_name(row)?,
            capture_digest: parse(row.try_get("capture_digest")?)?,
            recipe_json: row.try_get("recipe_json")?,
            priority: i32::try_from(row.try_get::<i64, _>("priority")?).map_err(internal)?,
            labels: row.try_get::<Json<_>, _>("labels")?.0,
            max_attempts: small(row.try_get("max_attempts")?)?,
        },
        state: parse(row.try_get("state")?)?,
        attempt,
        attempt_limit: small(row.try_get("attempt_limit")?)?,
        worker: row
            .try_get::<Option<&str>, _>("worker")?
            .map(parse)
            .transpose()?,
        holder,
        cancel_requested: row.try_get("cancel_requested")?,
        progress: row
            .try_get::<Option<Json<Progress>>, _>("progress")?
            .map(|json| json.0),
        failure: row
            .try_get::<Option<Json<Failure>>, _>("failure")?
            .map(|json| json.0),
        checkpoint,
        version: row
            .try_get::<Option<i64>, _>("version")?
            .map(small)
            .transpose()?,
        submitted_at: time(row, "submitted_at")?,
        not_before: time(row, "not_before")?,
        started_at: optional_time(row, "started_at")?,
        finished_at: optional_time(row, "finished_at")?,
        lease_until: optional_time(row, "lease_until")?,
        traceparent: row.try_get("traceparent")?,
    })
}

pub(super) fn jobs_from(rows: &[DbRow]) -> Result<Vec<Job>> {
    rows.iter().map(job_from).collect()
}

pub(super) fn version_from(row: &DbRow) -> Result<Version> {
    let mut aliases: Vec<String> = match row.try_get::<Option<&str>, _>("aliases")? {
        Some(list) => list.split(',').map(str::to_owned).collect(),
        None => Vec::new(),
    };
    aliases.sort_unstable();
    Ok(Version {
        object: object_name(row)?,
        version: small(row.try_get("version")?)?,
        bundle: NewVersion {
            manifest_digest: parse(row.try_get("manifest_digest")?)?,
            size_bytes: count(row.try_get("size_bytes")?),
            file_count: small(row.try_get("file_count")?)?,
            metrics_json: row.try_get("metrics_json")?,
        },
        aliases,
        created_at: time(row, "created_at")?,
        job: from_key(row.try_get("job_id")?)?,
        retired: row.try_get("retired")?,
        retired_at: optional_time(row, "retired_at")?,
    })
}

pub(super) fn collection_from(row: &DbRow) -> Result<Collection> {
    Ok(Collection {
        name: parse(row.try_get("name")?)?,
        weight: row.try_get("weight")?,
        max_running: small(row.try_get("max_running")?)?,
        paused: row.try_get("paused")?,
    })
}

pub(super) fn level_word(level: Level) -> &'static str {
    match level {
        Level::Info => "info",
        Level::Warn => "warn",
        Level::Error => "error",
    }
}

pub(super) fn level_from(word: &str) -> Result<Level> {
    match word {
        "info" => Ok(Level::Info),
        "warn" => Ok(Level::Warn),
        "error" => Ok(Level::Error),
        other => Err(internal(format!("unknown level {other:?}"))),
    }
}

pub(super) fn worker_from(row: &DbRow) -> Result<WorkerInfo> {
    Ok(WorkerInfo {
        id: parse(row.try_get("id")?)?,
        hostname: row.try_get("hostname")?,
        version: row.try_get("version")?,
        device: row.try_get("device")?,
    })
}
