//! Published versions of objects, and the aliases that name them.

use std::collections::{BTreeMap, BTreeSet};

use chrono::{DateTime, Utc};
use ign_proto::{Attempt, Digest, JobId, LATEST, ObjectName};
use sqlx::{QueryBuilder, Row};

use super::super::{ALIAS_LIST, Connection, Db, LOCK, key, to_db};
use super::SqlStore;
use super::jobs::{lock_jobs, refused, save_jobs};
use super::rows::{object_name, small, sql, version_from};
use super::webhooks::announce;
use crate::changes::Change;
use crate::check;
use crate::store::{NewVersion, Result, StoreError, Version};

/// The condition that a row is of one of these objects.
fn push_objects<'a>(
    query: &mut QueryBuilder<Db>,
    objects: impl IntoIterator<Item = &'a ObjectName>,
) {
    query.push("(collection, object) in (");
    query.push_values(objects, |mut row, object| {
        row.push_bind(object.collection.as_str().to_owned())
            .push_bind(object.object.as_str().to_owned());
    });
    query.push(")");
}

/// Starts a select of versions; the caller adds the condition.
pub(super) fn select_versions() -> QueryBuilder<Db> {
    QueryBuilder::new(format!(
        "select v.*, (select {ALIAS_LIST} from aliases a where a.collection = v.collection and a.object = v.object \
         and a.version = v.version) as aliases from versions v where true"
    ))
}

/// The version that a reference names.
pub(super) async fn find_version(
    connection: &mut Connection,
    object: &ObjectName,
    reference: &str,
) -> Result<Version> {
    let mut query = select_versions();
    query
        .push(" and v.collection = ")
        .push_bind(object.collection.as_str());
    query
        .push(" and v.object = ")
        .push_bind(object.object.as_str());
    if let Some(version) = check::version_number(reference) {
        query
            .push(" and v.version = ")
            .push_bind(i64::from(version));
    } else if let Ok(digest) = reference.parse::<Digest>() {
        query
            .push(" and v.manifest_digest = ")
            .push_bind(digest.as_str().to_owned());
    } else {
        let alias = if reference.is_empty() {
            LATEST
        } else {
            reference
        };
        query
            .push(
                " and v.version = (select a.version from aliases a where a.collection = v.collection \
                 and a.object = v.object and a.alias = ",
            )
            .push_bind(alias.to_owned())
            .push(")");
    }
    query.push(" order by v.version desc limit 1");
    let row = query.build().fetch_optional(connection).await?;
    let absent = || {
        let reference = if reference.is_empty() {
            LATEST
        } else {
            reference
        };
        StoreError::NotFound {
            kind: "bundle",
            name: format!("{object}:{reference}"),
        }
    };
    version_from(&row.ok_or_else(absent)?)
}

pub(super) async fn point_alias(
    connection: &mut Connection,
    object: &ObjectName,
    alias: &str,
    version: u32,
) -> Result<()> {
    point_aliases(connection, alias, [(object, version)]).await
}

/// Points one alias of each of several objects.
async fn point_aliases(
    connection: &mut Connection,
    alias: &str,
    targets: impl IntoIterator<Item = (&ObjectName, u32)>,
) -> Result<()> {
    let mut insert =
        QueryBuilder::<Db>::new("insert into aliases (collection, object, alias, version) ");
    insert.push_values(targets, |mut row, (object, version)| {
        row.push_bind(object.collection.as_str())
            .push_bind(object.object.as_str())
            .push_bind(alias)
            .push_bind(i64::from(version));
    });
    insert
        .push(" on conflict (collection, object, alias) do update set version = excluded.version")
        .build()
        .execute(connection)
        .await?;
    Ok(())
}

pub(super) async fn insert_versions(
    connection: &mut Connection,
    versions: &[Version],
) -> Result<()> {
    let mut insert = QueryBuilder::<Db>::new(
        "insert into versions (collection, object, version, manifest_digest, size_bytes, file_count, metrics_json, \
         job_id, created_at, retired, retired_at) ",
    );
    insert.push_values(versions, |mut row, version| {
        row.push_bind(version.object.collection.as_str())
            .push_bind(version.object.object.as_str())
            .push_bind(i64::from(version.version))
            .push_bind(version.bundle.manifest_digest.as_str())
            .push_bind(version.bundle.size_bytes as i64)
            .push_bind(i64::from(version.bundle.file_count))
            .push_bind(version.bundle.metrics_json.as_str())
            .push_bind(key(version.job))
            .push_bind(to_db(version.created_at))
            .push_bind(version.retired)
            .push_bind(version.retired_at.map(to_db));
    });
    insert.build().execute(connection).await?;
    Ok(())
}

/// Takes a version out of listings, or puts it back.
pub(super) async fn set_retired(
    connection: &mut Connection,
    object: &ObjectName,
    version: u32,
    at: Option<DateTime<Utc>>,
) -> Result<()> {
    sqlx::query(
        "update versions set retired = $4, retired_at = $5 where collection = $1 and object = $2 and version = $3",
    )
    .bind(object.collection.as_str())
    .bind(object.object.as_str())
    .bind(i64::from(version))
    .bind(at.is_some())
    .bind(at.map(to_db))
    .execute(connection)
    .await?;
    Ok(())
}

/// Points `latest` to the newest version that is listed.
pub(super) async fn point_latest(connection: &mut Connection, object: &ObjectName) -> Result<()> {
    let newest: Option<i64> = sqlx::query_scalar(
        "select max(version) from versions where collection = $1 and object = $2 and not retired",
    )
    .bind(object.collection.as_str())
    .bind(object.object.as_str())
    .fetch_one(&mut *connection)
    .await?;
    if let Some(newest) = newest {
        return point_alias(connection, object, LATEST, small(newest)?).await;
    }
    sqlx::query("delete from aliases where collection = $1 and object = $2 and alias = $3")
        .bind(object.collection.as_str())
        .bind(object.object.as_str())
        .bind(LATEST)
        .execute(connection)
        .await?;
    Ok(())
}

/// Orders whatever changes the versions and aliases of one object.
pub(super) async fn lock_object(connection: &mut Connection, object: &ObjectName) -> Result<()> {
    sqlx::query(sql(format!(
        "select last_version from objects where collection = $1 and object = $2 {LOCK}"
    )))
    .bind(object.collection.as_str())
    .bind(object.object.as_str())
    .fetch_optional(connection)
    .await?;
    Ok(())
}

impl SqlStore {
    /// Publishes bundles of several jobs and ends the jobs. With a `lock` that skips rows which somebody holds, those are
    /// answered with none, as is what cannot share a transaction with the others.
    pub(super) async fn publish_all(
        &self,
        asks: &[PublishAsk],
        lock: &str,
    ) -> Result<Vec<Option<Result<Version>>>> {
        let (mut transaction, now) = self.begin().await?;
        let outcome = async {
            let mut jobs =
                lock_jobs(&mut transaction, asks.iter().map(|ask| ask.job), lock).await?;
            let mut answers: Vec<Option<Result<Version>>> = Vec::new();
            let mut holding = Vec::new();
            for ask in asks {
                let Some(job) = jobs.remove(&ask.job) else {
                    answers.push(None);
                    continue;
                };
                let again = match job.version {
                    Some(version) if job.attempt == ask.attempt => {
                        let reference = format!("v{version}");
                        let published =
                            find_version(&mut transaction, &job.spec.object, &reference).await?;
                        Some(published)
                            .filter(|it| it.bundle.manifest_digest == ask.bundle.manifest_digest)
                    }
                    _ => None,
                };
                answers.push(match (again, job.holds(ask.attempt)) {
                    (Some(published), _) => Some(Ok(published)),
                    (None, Err(refusal)) => Some(Err(refused(&job, ask.attempt, refusal))),
                    (None, Ok(())) => {
                        holding.push((answers.len(), job));
                        None
                    }
                });
            }
            let objects = holding.iter().map(|(_, job)| &job.spec.object).collect();
            let mut last = lock_objects(&mut transaction, objects, lock).await?;
            let (mut versions, mut ended) = (Vec::new(), Vec::new());
            for (index, mut job) in holding {
                let Some(last) = last.get_mut(&job.spec.object) else {
                    continue;
                };
                *last += 1;
                let ask = &asks[index];
                job.complete(ask.attempt, *last, now)
                    .map_err(|refusal| refused(&job, ask.attempt, refusal))?;
                versions.push((
                    index,
                    Version {
                        object: job.spec.object.clone(),
                        version: *last,
                        bundle: ask.bundle.clone(),
                        aliases: Vec::new(),
                        created_at: now,
                        job: job.id,
                        retired: false,
                        retired_at: None,
                    },
                ));
                ended.push(job);
            }
            let (indices, mut versions): (Vec<usize>, Vec<Version>) = versions.into_iter().unzip();
            if !versions.is_empty() {
                let newest: BTreeMap<&ObjectName, u32> =
                    versions.iter().map(|it| (&it.object, it.version)).collect();
                advance_objects(&mut transaction, &newest).await?;
                insert_versions(&mut transaction, &versions).await?;
                let latest = newest.iter().map(|(object, version)| (*object, *version));
                point_aliases(&mut transaction, LATEST, latest).await?;
                save_jobs(&mut transaction, &ended).await?;
                let bundles = versions.iter().map(|version| Some(&version.bundle));
                announce(&mut transaction, ended.iter().zip(bundles), now).await?;
                for version in &mut versions {
                    if last.get(&version.object) == Some(&version.version) {
                        version.aliases.push(LATEST.to_owned());
                    }
                }
            }
            for (index, version) in indices.into_iter().zip(versions) {
                answers[index] = Some(Ok(version));
            }
            Ok(answers)
        }
        .await;
        self.finish(transaction, outcome, Change::Work).await
    }
}

/// A worker that ends a job with a bundle.
#[derive(Clone, Debug)]
pub(super) struct PublishAsk {
    pub(super) job: JobId,
    pub(super) attempt: Attempt,
    pub(super) bundle: NewVersion,
}

/// The newest version numbers of objects, their rows locked until the transaction ends and made where they are missing.
async fn lock_objects(
    connection: &mut Connection,
    mut objects: BTreeSet<&ObjectName>,
    lock: &str,
) -> Result<BTreeMap<ObjectName, u32>> {
    let mut last = lock_known_objects(connection, &objects, lock).await?;
    objects.retain(|object| !last.contains_key(*object));
    if objects.is_empty() {
        return Ok(last);
    }
    let mut insert =
        QueryBuilder::<Db>::new("insert into objects (collection, object, last_version) ");
    insert.push_values(&objects, |mut row, object| {
        row.push_bind(object.collection.as_str())
            .push_bind(object.object.as_str())
            .push("0");
    });
    insert.push(" on conflict (collection, object) do nothing returning collection, object");
    for row in insert.build().fetch_all(&mut *connection).await? {
        last.insert(object_name(&row)?, 0);
    }
    objects.retain(|object| !last.contains_key(*object));
    // Others made them meanwhile, or hold them.
    last.extend(lock_known_objects(connection, &objects, lock).await?);
    Ok(last)
}

async fn lock_known_objects(
    connection: &mut Connection,
    objects: &BTreeSet<&ObjectName>,
    lock: &str,
) -> Result<BTreeMap<ObjectName, u32>> {
    if objects.is_empty() {
        return Ok(BTreeMap::new());
    }
    let mut select = QueryBuilder::<Db>::new("select * from objects where ");
    push_objects(&mut select, objects.iter().copied());
    select.push(" order by collection, object ").push(lock);
    let rows = select.build().fetch_all(connection).await?;
    rows.iter()
        .map(|row| Ok((object_name(row)?, small(row.try_get("last_version")?)?)))
        .collect()
}

/// Writes the newest version numbers of objects whose rows are locked.
async fn advance_objects(
    connection: &mut Connection,
    newest: &BTreeMap<&ObjectName, u32>,
) -> Result<()> {
    let mut update = QueryBuilder::<Db>::new("update objects set last_version = v.column3 from (");
    update.push_values(newest, |mut row, (object, version)| {
        row.push_bind(object.collection.as_str())
            .push_bind(object.object.as_str())
            .push_bind(i64::from(*version));
    });
    update
        .push(") v where objects.collection = v.column1 and objects.object = v.column2")
        .build()
        .execute(connection)
        .await?;
    Ok(())
}
