//! The registry on a store that fails: by a seeded plan, for want of room, or by lying.
#![expect(clippy::unwrap_used, reason = "helpers of tests")]

mod faulty;

use std::collections::{BTreeMap, BTreeSet};
use std::sync::atomic::Ordering;
use std::time::Duration;

use bytes::Bytes;
use faulty::{Conditional, Faulty};
use futures::TryStreamExt as _;
use ign_proto::{Digest, FileEntry, JobId, Kind, Manifest, ObjectName};
use ign_registry::{
    BodyError, Keep, ObjectState, Registry, RegistryError, StoreConfig, VersionRecord,
};

const NO_LIMIT: u64 = u64::MAX;
const HOUR: Duration = Duration::from_hours(1);

fn object() -> ObjectName {
    "museum/vase".parse().unwrap()
}

/// Repeats a call as clients, workers and coordinators do, until it succeeds.
async fn insist<T, F: Future<Output = Result<T, RegistryError>>>(mut call: impl FnMut() -> F) -> T {
    for _ in 0..200 {
        match call().await {
            Ok(value) => return value,
            // A cut body shows as a store's error or as another digest: never as success, never as damage.
            Err(
                RegistryError::Store { .. }
                | RegistryError::Body { .. }
                | RegistryError::WrongDigest { .. },
            ) => {}
            Err(error) => panic!("{error:?}"),
        }
    }
    panic!("200 tries in vain");
}

fn body(bytes: Bytes) -> impl futures::Stream<Item = Result<Bytes, BodyError>> + Send {
    futures::stream::iter([Ok(bytes)])
}

fn content(seed: u64, bytes: usize) -> Bytes {
    (0..bytes as u64)
        .map(|i| (i * 31 + seed * 7 + i / 251) as u8)
        .collect::<Vec<u8>>()
        .into()
}

fn manifest(kind: Kind, contents: &[Bytes]) -> Manifest {
    let files = contents.iter().enumerate().map(|(index, bytes)| FileEntry {
        path: format!("{index}.bin").parse().unwrap(),
        digest: Digest::of(bytes),
        size_bytes: bytes.len() as u64,
        media_type: "application/octet-stream".to_owned(),
    });
    Manifest::new(kind, files.collect(), BTreeMap::new()).unwrap()
}

async fn read(registry: &Registry, digest: &Digest) -> Bytes {
    let read = registry.read_blob(digest, None).await.unwrap().unwrap();
    let chunks: Vec<Bytes> = read.stream.try_collect().await.unwrap();
    chunks.concat().into()
}

/// No object lies under a digest that its content does not have.
fn check_names(folder: &std::path::Path) {
    for content in ["blobs", "manifests"] {
        for entry in walk(&folder.join(content)) {
            let name = entry.file_name().unwrap().to_string_lossy().into_owned();
            if let Ok(digest) = format!("sha256:{name}").parse::<Digest>() {
                assert_eq!(Digest::of(&std::fs::read(&entry).unwrap()), digest);
            }
        }
    }
}

fn walk(folder: &std::path::Path) -> Vec<std::path::PathBuf> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir(folder).into_iter().flatten().flatten() {
        if entry.file_type().unwrap().is_dir() {
            found.extend(walk(&entry.path()));
        } else {
            found.push(entry.path());
        }
    }
    found
}

/// Everything the registry does, each call repeated until it succeeds.
async fn publish_through_faults(seed: u64) -> u64 {
    let keep = tempfile::tempdir().unwrap();
    let store = Faulty::new(keep.path(), seed, 4);
    let registry = {
        let mut opened = None;
        while opened.is_none() {
            opened = Registry::on(store.clone()).await.ok();
        }
        opened.unwrap()
    };
    let vase = object();
    let (whole, pieces) = (content(seed, 5000), content(seed + 1000, 3001));
    let digest = Digest::of(&whole);
    insist(|| registry.put_stream(&digest, NO_LIMIT, body(whole.clone()))).await;

    // In pieces, each from where the upload stands.
    let id = insist(|| registry.create_upload(&vase)).await;
    let end = pieces.len() as u64;
    loop {
        let offset = insist(|| registry.upload_offset(&vase, id)).await;
        if offset == end {
            break;
        }
        let piece = pieces.slice(offset as usize..pieces.len().min(offset as usize + 1000));
        // Its outcome may be unknown; the next look tells.
        registry
            .append_upload(&object(), id, offset, NO_LIMIT, body(piece))
            .await
            .ok();
    }
    let second = Digest::of(&pieces);
    insist(|| registry.finish_upload(&vase, id, &second, NO_LIMIT)).await;
    check_names(keep.path());

    let bundle = manifest(Kind::Bundle, &[whole.clone(), pieces.clone()]);
    let manifest_digest = insist(|| registry.put_manifest(&bundle)).await;
    let record = VersionRecord {
        object: object(),
        version: 1,
        manifest_digest: manifest_digest.clone(),
        size_bytes: bundle.size_bytes(),
        job_id: JobId::generate(),
        created_at: chrono::DateTime::from_timestamp(1_700_000_000, 0).unwrap(),
        metrics_json: "{}".to_owned(),
    };
    insist(|| registry.put_version(&record)).await;
    let state = ObjectState {
        newest: 1,
        aliases: [("latest".to_owned(), 1), ("approved".to_owned(), 1)].into(),
        ..ObjectState::default()
    };
    insist(|| registry.put_state(&vase, &state)).await;

    // A collection and an audit among the faults harm nothing.
    let spared = Keep {
        manifests: [manifest_digest.clone()].into(),
        versions: [((object(), 1), manifest_digest.clone())].into(),
        blobs: BTreeSet::new(),
    };
    insist(|| registry.collect(&spared, HOUR, false)).await;
    let named = BTreeSet::from([manifest_digest.clone()]);
    insist(|| registry.audit(None, &named, None)).await;

    // What lies there, read without faults, is whole and right.
    check_names(keep.path());
    let url = format!("file://{}", keep.path().display());
    let sound = Registry::open(&StoreConfig::new(url)).await.unwrap();
    for bytes in [&whole, &pieces] {
        assert_eq!(read(&sound, &Digest::of(bytes)).await, *bytes);
    }
    let rebuilt = sound.rebuild().await.unwrap();
    assert_eq!(rebuilt.faults, []);
    assert_eq!(rebuilt.versions.len(), 1);
    assert_eq!(rebuilt.versions[0].record, record);
    assert_eq!(rebuilt.states[&object()], state);
    store.played.load(Ordering::Relaxed)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_store_that_fails_one_call_in_four_loses_and_falsifies_nothing() {
    let seeds = std::env::var("IGN_FAULT_SEEDS").map_or(100, |text| text.parse().unwrap());
    let mut played = 0;
    for seed in 0..seeds {
        played += publish_through_faults(seed).await;
    }
    assert!(played > 10 * seeds, "only {played} faults were played");
}

#[tokio::test]
async fn a_conditional_put_that_lies_is_found_out_at_start() {
    for (conditional, honest) in [
        (Conditional::Honest, true),
        (Conditional::Overwrites, false),
        (Conditional::ClaimsSuccess, false),
        (Conditional::OverwritesAndRefuses, false),
    ] {
        let keep = tempfile::tempdir().unwrap();
        let store = Faulty::with(keep.path(), 1, 0, conditional);
        let registry = Registry::on(store).await.unwrap();
        assert_eq!(
            registry.probe().conditional_create,
            honest,
            "{conditional:?}"
        );
    }
}

fn is_full<T: std::fmt::Debug>(result: &Result<T, RegistryError>) -> bool {
    matches!(result, Err(RegistryError::Full { .. }))
}

#[tokio::test]
async fn a_full_store_says_so_and_what_makes_room_still_works() {
    let keep = tempfile::tempdir().unwrap();
    let store = Faulty::new(keep.path(), 1, 0);
    let registry = Registry::on(store.clone()).await.unwrap();
    let (kept, garbage) = (content(1, 100), content(2, 100));
    registry.put_bytes(kept.clone()).await.unwrap();
    registry.put_bytes(garbage.clone()).await.unwrap();
    let capture = manifest(Kind::Capture, std::slice::from_ref(&kept));
    let named = registry.put_manifest(&capture).await.unwrap();
    let id = registry.create_upload(&object()).await.unwrap();
    store.set_full(true);

    let more = content(3, 100);
    let large = content(4, 9 * 1024 * 1024);
    assert!(is_full(&registry.put_bytes(more.clone()).await));
    assert!(is_full(
        &registry
            .put_stream(&Digest::of(&large), NO_LIMIT, body(large.clone()))
            .await
    ));
    assert!(is_full(&registry.create_upload(&object()).await));
    assert!(is_full(
        &registry
            .append_upload(&object(), id, 0, NO_LIMIT, body(more.clone()))
            .await
    ));
    assert!(is_full(&registry.put_manifest(&capture).await));
    assert_eq!(read(&registry, &Digest::of(&kept)).await, kept);

    registry.drop_upload(id).await.unwrap();
    age(keep.path());
    let spared = Keep {
        manifests: [named].into(),
        ..Keep::default()
    };
    let collected = registry.collect(&spared, HOUR, false).await.unwrap();
    assert_eq!(collected.trashed.objects, 1);
    let collected = registry
        .collect(&spared, Duration::ZERO, false)
        .await
        .unwrap();
    assert_eq!(collected.deleted.objects, 1);
    store.set_full(false);
    registry.put_bytes(more).await.unwrap();
    assert_eq!(read(&registry, &Digest::of(&kept)).await, kept);
}

/// Makes everything two hours older.
fn age(folder: &std::path::Path) {
    for path in walk(folder) {
        let file = std::fs::File::options().write(true).open(path).unwrap();
        let before = file.metadata().unwrap().modified().unwrap();
        file.set_modified(before - 2 * HOUR).unwrap();
    }
}
