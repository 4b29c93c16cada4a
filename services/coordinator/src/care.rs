//! The registry as a whole: rebuilding it, collecting garbage, auditing.
//!
//! Whatever happens to the registry beyond its daily work becomes an event in the database.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::atomic::Ordering;
use std::time::Duration;

use ign_proto::{Cause, Digest, ObjectName};
use ign_queue::{NewVersion, Version, VersionFilter};
use ign_registry::{Audit, Collected, Keep, Outcome, RegistryError};

use crate::app::App;
use crate::http_answer::Refused;

/// An upload, submit or publish that has begun is done within this time.
const MIN_GRACE: Duration = Duration::from_hours(1);
/// Publishes that may come between looking at the database and looking at the bucket.
const TRIES: u32 = 5;
/// A scheduled audit goes in slices: one first byte of the digests after the other.
const SLICES: u64 = 256;

/// What a rebuild did.
#[derive(Debug, Default)]
pub(crate) struct Rebuilt {
    pub(crate) added: u64,
    pub(crate) known: u64,
    /// `(path, reason)`.
    pub(crate) faults: Vec<(String, String)>,
}

fn every_version() -> VersionFilter {
    VersionFilter {
        include_retired: true,
        ..VersionFilter::default()
    }
}

impl App {
    /// Rebuilds the registry if the bucket records a version that the database does not know: a number must never be
    /// given twice.
    pub(crate) async fn rebuild_if_behind(&self) -> Result<(), Refused> {
        let recorded = self.registry.recorded().await?;
        let known: BTreeSet<(ObjectName, u32)> = self
            .store
            .versions(&every_version())
            .await?
            .into_iter()
            .map(|version| (version.object, version.version))
            .collect();
        let unknown = recorded.keys().filter(|it| !known.contains(it)).count();
        if unknown > 0 {
            tracing::warn!(
                unknown,
                "the bucket records versions that the database does not know; taking them over"
            );
            self.rebuild().await?;
        }
        Ok(())
    }

    /// Takes over what the bucket records and the database does not know.
    pub(crate) async fn rebuild(&self) -> Result<Rebuilt, Refused> {
        let found = self.registry.rebuild().await?;
        let mut rebuilt = Rebuilt {
            faults: found.faults,
            ..Rebuilt::default()
        };
        let mut objects: BTreeMap<ObjectName, Vec<Version>> = BTreeMap::new();
        for published in found.versions {
            let record = published.record;
            let state = found.states.get(&record.object);
            let aliases = state.map_or_else(Vec::new, |state| {
                let here = |(_, version): &(&String, &u32)| **version == record.version;
                let aliases = state.aliases.iter().filter(here);
                aliases.map(|(alias, _)| alias.clone()).collect()
            });
            objects
                .entry(record.object.clone())
                .or_default()
                .push(Version {
                    retired: state.is_some_and(|state| state.retired.contains(&record.version)),
                    retired_at: state
                        .and_then(|state| state.retired_at.get(&record.version).copied()),
                    aliases,
                    object: record.object,
                    version: record.version,
                    bundle: NewVersion {
                        manifest_digest: record.manifest_digest,
                        size_bytes: record.size_bytes,
                        file_count: published.file_count,
                        metrics_json: record.metrics_json,
                    },
                    created_at: record.created_at,
                    job: record.job_id,
                });
        }
        for (object, versions) in objects {
            let adopted = self.store.adopt(&object, &versions).await?;
            rebuilt.added += adopted.added.len() as u64;
            rebuilt.known += u64::from(adopted.known);
            for version in adopted.differing {
                rebuilt.faults.push((
                    format!("{object}:v{version}"),
                    "the database has another version under this number".to_owned(),
                ));
            }
        }
        let message = format!(
            "{} versions taken over from the bucket, {} known, {} faults",
            rebuilt.added,
            rebuilt.known,
            rebuilt.faults.len()
        );
        tracing::info!("{message}");
        self.store.record("rebuild", "", &message).await?;
        Ok(rebuilt)
    }

    /// Collects what nothing names; see [`ign_registry::Registry::collect`].
    pub(crate) async fn collect(
        &self,
        grace: Duration,
        dry_run: bool,
    ) -> Result<Collected, Refused> {
        if grace < MIN_GRACE {
            let message = format!("must be at least {} s", MIN_GRACE.as_secs());
            return Err(Cause::bad_field("grace_secs", message).into());
        }
        let mut tries = 1;
        let collected = loop {
            let keep = self.keep(grace).await?;
            match self.registry.collect(&keep, grace, dry_run).await {
                Err(RegistryError::VersionUnknown { .. }) if tries < TRIES => tries += 1,
                collected => break collected?,
            }
        };
        if !dry_run {
            let message = format!(
                "{} objects moved to the trash, {} deleted from it ({} bytes), {} taken back",
                collected.trashed.objects,
                collected.deleted.objects,
                collected.deleted.bytes,
                collected.rescued.objects,
            );
            tracing::info!("{message}");
            self.store.record("collect", "", &message).await?;
        }
        Ok(collected)
    }

    async fn keep(&self, grace: Duration) -> Result<Keep, Refused> {
        let named = self.store.named(grace).await?;
        let versions = self.store.versions(&every_version()).await?;
        Ok(Keep {
            manifests: named.manifests,
            blobs: named.checkpoints,
            versions: versions
                .into_iter()
                .map(|version| {
                    let place = (version.object, version.version);
                    (place, version.bundle.manifest_digest)
                })
                .collect(),
        })
    }

    /// Reads every digest again, or those of one slice.
    pub(crate) async fn audit(&self, slice: Option<u8>) -> Result<Audit, Refused> {
        let published: BTreeSet<Digest> = self
            .store
            .versions(&VersionFilter::default())
            .await?
            .into_iter()
            .map(|version| version.bundle.manifest_digest)
            .collect();
        let audit = self
            .registry
            .audit(slice, &published, self.replica.as_ref())
            .await?;
        for fault in &audit.faults {
            let done = outcome_word(fault.outcome);
            tracing::error!(path = fault.path, outcome = done, "{}", fault.reason);
            let message = format!("{} ({done})", fault.reason);
            self.store.record("damage", &fault.path, &message).await?;
        }
        self.metrics
            .registry_faults
            .fetch_add(audit.faults.len() as u64, Ordering::Relaxed);
        if slice.is_none() {
            let message = format!(
                "{} objects read ({} bytes), {} faults",
                audit.read.objects,
                audit.read.bytes,
                audit.faults.len()
            );
            self.store.record("audit", "", &message).await?;
        }
        Ok(audit)
    }

    /// Audits the next slice when it is its turn.
    pub(crate) async fn audit_when_due(&self, every: Duration) -> Result<(), Refused> {
        let pause = every / SLICES as u32;
        let Some(turn) = self.store.take_turn("audit", pause).await? else {
            return Ok(());
        };
        let slice = turn % SLICES;
        let audit = self.audit(Some(slice as u8)).await?;
        tracing::debug!(slice, objects = audit.read.objects, "audited a slice");
        if slice == SLICES - 1 {
            self.store
                .record("audit", "", "every digest was read again")
                .await?;
        }
        Ok(())
    }
}

pub(crate) fn outcome_word(outcome: Outcome) -> &'static str {
    match outcome {
        Outcome::Repaired => "repaired",
        Outcome::SetAside => "set_aside",
        Outcome::Absent => "absent",
    }
}
