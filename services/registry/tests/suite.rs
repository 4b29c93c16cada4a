//! One suite for both stores: a folder and an S3 endpoint with signature checks.
#![expect(clippy::unwrap_used, reason = "helpers of tests")]

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use bytes::Bytes;
use futures::{StreamExt as _, TryStreamExt as _};
use ign_proto::{Digest, FileEntry, JobId, Kind, Manifest, ObjectName};
use ign_registry::{
    BodyError, Keep, ObjectState, Outcome, Published, Registry, RegistryError, StoreConfig,
    VersionRecord,
};
use ign_testkit::S3;

const NO_LIMIT: u64 = u64::MAX;
const MIB: usize = 1024 * 1024;

/// A registry of its own, and the folder in which its objects can be damaged.
struct Fixture {
    registry: Registry,
    config: StoreConfig,
    folder: std::path::PathBuf,
    _keep: tempfile::TempDir,
}

async fn file() -> Fixture {
    let keep = tempfile::tempdir().unwrap();
    let folder = keep.path().join("store");
    let config = StoreConfig::new(format!("file://{}", folder.display()));
    Fixture {
        registry: Registry::open(&config).await.unwrap(),
        config,
        folder,
        _keep: keep,
    }
}

async fn s3() -> Fixture {
    let keep = tempfile::tempdir().unwrap();
    let prefix = keep
        .path()
        .file_name()
        .unwrap()
        .to_string_lossy()
        .replace('.', "t");
    let server = S3::shared().unwrap();
    let config = StoreConfig {
        url: server.url(&prefix),
        options: server
            .env()
            .into_iter()
            .map(|(key, value)| (key.to_lowercase(), value))
            .collect(),
    };
    let folder = server.root().join(S3::BUCKET).join(&prefix);
    Fixture {
        registry: Registry::open(&config).await.unwrap(),
        config,
        folder,
        _keep: keep,
    }
}

macro_rules! suite {
    ($($test:ident),* $(,)?) => {
        mod on_file { $(#[tokio::test] async fn $test() { super::$test(super::file().await).await; })* }
        mod on_s3 { $(#[tokio::test] async fn $test() { super::$test(super::s3().await).await; })* }
    };
}

suite!(
    probe_finds_conditional_create,
    blobs_round_trip_with_ranges,
    a_wrong_digest_keeps_nothing,
    a_large_blob_streams_in_parts,
    an_upload_survives_broken_connections_and_restarts,
    uploads_belong_to_their_object_and_expire,
    manifests_need_their_blobs,
    versions_are_written_once_and_rebuilt,
    what_nothing_names_goes_slowly,
    a_collection_at_any_point_of_a_submit_loses_nothing,
    a_database_that_knows_less_than_the_bucket_collects_nothing,
    an_audit_finds_and_repairs_what_rotted,
);

fn body(
    parts: Vec<Result<Bytes, &'static str>>,
) -> impl futures::Stream<Item = Result<Bytes, BodyError>> + Send {
    futures::stream::iter(parts).map(|part| part.map_err(BodyError::from))
}

fn pattern(bytes: usize) -> Bytes {
    (0..bytes)
        .map(|i| (i * 31 + i / 7919) as u8)
        .collect::<Vec<_>>()
        .into()
}

async fn content(
    registry: &Registry,
    digest: &Digest,
    range: Option<std::ops::Range<u64>>,
) -> Option<Vec<u8>> {
    let read = registry.read_blob(digest, range).await.unwrap()?;
    let chunks: Vec<Bytes> = read.stream.try_collect().await.unwrap();
    Some(chunks.concat())
}

fn object() -> ObjectName {
    "museum/vase".parse().unwrap()
}

async fn bundle(registry: &Registry, content: &'static [u8]) -> Manifest {
    let digest = registry
        .put_bytes(Bytes::from_static(content))
        .await
        .unwrap();
    let file = FileEntry {
        path: "bundle.json".parse().unwrap(),
        digest,
        size_bytes: content.len() as u64,
        media_type: "application/json".to_owned(),
    };
    Manifest::new(Kind::Bundle, vec![file], BTreeMap::new()).unwrap()
}

async fn probe_finds_conditional_create(fixture: Fixture) {
    let probe = fixture.registry.probe();
    assert!(probe.conditional_create);
    assert_eq!(probe.signs_urls, fixture.config.url.starts_with("s3://"));
    fixture.registry.ping().await.unwrap();
    // OCI clients ask for the empty config of every manifest.
    let empty = Digest::of(b"{}");
    assert_eq!(
        content(&fixture.registry, &empty, None).await.unwrap(),
        b"{}"
    );
}

async fn blobs_round_trip_with_ranges(fixture: Fixture) {
    let registry = fixture.registry;
    let bytes = pattern(1000);
    let digest = registry.put_bytes(bytes.clone()).await.unwrap();
    assert_eq!(registry.put_bytes(bytes.clone()).await.unwrap(), digest);
    assert_eq!(registry.blob_size(&digest).await.unwrap(), Some(1000));
    assert_eq!(content(&registry, &digest, None).await.unwrap(), bytes);
    let read = registry
        .read_blob(&digest, Some(10..20))
        .await
        .unwrap()
        .unwrap();
    assert_eq!((read.size_bytes, read.range.clone()), (1000, 10..20));
    assert_eq!(
        content(&registry, &digest, Some(10..20)).await.unwrap(),
        bytes[10..20]
    );
    let absent = Digest::of(b"absent");
    assert_eq!(registry.blob_size(&absent).await.unwrap(), None);
    assert!(content(&registry, &absent, None).await.is_none());
    if registry.probe().signs_urls {
        let url = registry
            .sign_blob(&digest, Duration::from_mins(1))
            .await
            .unwrap()
            .unwrap();
        assert_eq!(
            reqwest::get(url).await.unwrap().bytes().await.unwrap(),
            bytes
        );
    }
}

async fn a_wrong_digest_keeps_nothing(fixture: Fixture) {
    let registry = fixture.registry;
    for size in [10, 9 * MIB] {
        let (bytes, claimed) = (pattern(size), Digest::of(b"other"));
        let error = registry
            .put_stream(&claimed, NO_LIMIT, body(vec![Ok(bytes.clone())]))
            .await
            .unwrap_err();
        assert!(
            matches!(&error, RegistryError::WrongDigest { expected, actual }
            if *expected == claimed && *actual == Digest::of(&bytes))
        );
        assert!(error.is_callers_fault());
        assert_eq!(registry.blob_size(&claimed).await.unwrap(), None);
    }
    let digest = Digest::of(b"abc");
    let broken = vec![Ok(Bytes::from_static(b"abc")), Err("connection reset")];
    assert!(matches!(
        registry.put_stream(&digest, NO_LIMIT, body(broken)).await,
        Err(RegistryError::Body { .. })
    ));
    let large = vec![Ok(Bytes::from_static(b"abc"))];
    assert!(matches!(
        registry.put_stream(&digest, 2, body(large)).await,
        Err(RegistryError::TooLarge { .. })
    ));
    assert_eq!(registry.blob_size(&digest).await.unwrap(), None);
}

async fn a_large_blob_streams_in_parts(fixture: Fixture) {
    let bytes = pattern(20 * MIB + 17);
    let digest = Digest::of(&bytes);
    let chunks = bytes
        .chunks(100_000)
        .map(|chunk| Ok(Bytes::copy_from_slice(chunk)))
        .collect();
    let size = fixture
        .registry
        .put_stream(&digest, NO_LIMIT, body(chunks))
        .await
        .unwrap();
    assert_eq!(size, bytes.len() as u64);
    assert_eq!(
        content(&fixture.registry, &digest, None).await.unwrap(),
        bytes
    );
}

async fn an_upload_survives_broken_connections_and_restarts(fixture: Fixture) {
    let bytes = pattern(18 * MIB + 5);
    let digest = Digest::of(&bytes);
    let registry = fixture.registry;
    let id = registry.create_upload(&object()).await.unwrap();
    let first = vec![
        Ok(bytes.slice(..9 * MIB)),
        Ok(bytes.slice(9 * MIB..10 * MIB)),
        Err("connection reset"),
    ];
    let error = registry
        .append_upload(&object(), id, 0, NO_LIMIT, body(first))
        .await
        .unwrap_err();
    assert!(matches!(error, RegistryError::Body { .. }));

    let registry = Registry::open(&fixture.config).await.unwrap();
    let offset = registry.upload_offset(&object(), id).await.unwrap();
    assert_eq!(offset, 10 * MIB as u64, "all that arrived is kept");
    let again = registry
        .append_upload(&object(), id, 0, NO_LIMIT, body(vec![Ok(bytes.clone())]))
        .await;
    assert!(
        matches!(again, Err(RegistryError::WrongOffset { offset: at, given: 0, .. }) if at == offset)
    );
    let early = registry
        .finish_upload(&object(), id, &digest, NO_LIMIT)
        .await;
    assert!(matches!(early, Err(RegistryError::WrongDigest { .. })));
    let rest = vec![Ok(bytes.slice(offset as usize..))];
    let end = registry
        .append_upload(&object(), id, offset, NO_LIMIT, body(rest))
        .await
        .unwrap();
    assert_eq!(end, bytes.len() as u64);
    assert_eq!(
        registry
            .finish_upload(&object(), id, &digest, NO_LIMIT)
            .await
            .unwrap(),
        end
    );
    assert_eq!(content(&registry, &digest, None).await.unwrap(), bytes);
    // The answer was lost and the client asks again.
    assert_eq!(
        registry
            .finish_upload(&object(), id, &digest, NO_LIMIT)
            .await
            .unwrap(),
        end
    );
    assert!(matches!(
        registry.upload_offset(&object(), id).await,
        Err(RegistryError::UploadAbsent { .. })
    ));
}

async fn uploads_belong_to_their_object_and_expire(fixture: Fixture) {
    let registry = fixture.registry;
    let id = registry.create_upload(&object()).await.unwrap();
    let other: ObjectName = "museum/bust".parse().unwrap();
    assert!(matches!(
        registry.upload_offset(&other, id).await,
        Err(RegistryError::UploadAbsent { .. })
    ));
    assert_eq!(
        registry
            .drop_stale_uploads(Duration::from_hours(1))
            .await
            .unwrap(),
        0
    );
    assert_eq!(registry.upload_offset(&object(), id).await.unwrap(), 0);
    assert_eq!(
        registry.drop_stale_uploads(Duration::ZERO).await.unwrap(),
        1
    );
    assert!(matches!(
        registry.upload_offset(&object(), id).await,
        Err(RegistryError::UploadAbsent { .. })
    ));
}

async fn manifests_need_their_blobs(fixture: Fixture) {
    let registry = fixture.registry;
    let good = bundle(&registry, b"content").await;
    let digest = registry.put_manifest(&good).await.unwrap();
    let bytes = registry.manifest(&digest).await.unwrap().unwrap();
    assert_eq!(Manifest::decode(&bytes).unwrap(), good);
    assert!(
        registry
            .manifest(&Digest::of(b"absent"))
            .await
            .unwrap()
            .is_none()
    );

    let mut absent = good.files()[0].clone();
    absent.digest = Digest::of(b"absent");
    let mut wrong_size = good.files()[0].clone();
    wrong_size.size_bytes += 1;
    for file in [absent, wrong_size] {
        let digest = file.digest.clone();
        let manifest = Manifest::new(Kind::Bundle, vec![file], BTreeMap::new()).unwrap();
        let error = registry.put_manifest(&manifest).await.unwrap_err();
        assert!(
            matches!(error, RegistryError::BlobsMissing { missing: 1, first } if first == digest)
        );
    }

    let path = fixture.folder.join(format!(
        "manifests/sha256/{}/{}",
        &digest.hex()[..2],
        digest.hex()
    ));
    std::fs::write(path, b"{}").unwrap();
    assert!(matches!(
        registry.manifest(&digest).await,
        Err(RegistryError::Damaged { .. })
    ));
}

async fn versions_are_written_once_and_rebuilt(fixture: Fixture) {
    let registry = fixture.registry;
    let manifest = bundle(&registry, b"one").await;
    let manifest_digest = registry.put_manifest(&manifest).await.unwrap();
    let record = |version| VersionRecord {
        object: object(),
        version,
        manifest_digest: manifest_digest.clone(),
        size_bytes: manifest.size_bytes(),
        job_id: JobId::generate(),
        created_at: chrono::DateTime::from_timestamp(1_700_000_000, 123_456_000).unwrap(),
        metrics_json: "{}".to_owned(),
    };
    let (v1, v10) = (record(1), record(10));
    for record in [&v10, &v1, &v1] {
        registry.put_version(record).await.unwrap();
        registry.restore_version(record).await.unwrap();
    }
    let other = VersionRecord {
        job_id: JobId::generate(),
        ..v1.clone()
    };
    for refused in [
        registry.put_version(&other).await,
        registry.restore_version(&other).await,
    ] {
        assert!(matches!(refused, Err(RegistryError::VersionTaken { .. })));
    }
    let plain = ObjectState {
        newest: 10,
        aliases: [("latest".to_owned(), 10)].into(),
        ..ObjectState::default()
    };
    let rebuilt = registry.rebuild().await.unwrap();
    assert_eq!(rebuilt.states, BTreeMap::from([(object(), plain.clone())]));
    registry.put_state(&object(), &plain).await.unwrap();
    let written = fixture.folder.join("versions/museum/vase/state.json");
    assert!(!written.exists(), "the records say all that it says");
    let state = ObjectState {
        aliases: [("latest".to_owned(), 10), ("approved".to_owned(), 1)].into(),
        retired: [1].into(),
        retired_at: [(1, v1.created_at)].into(),
        ..plain
    };
    registry.put_state(&object(), &state).await.unwrap();
    assert!(written.exists());

    let rebuilt = Registry::open(&fixture.config)
        .await
        .unwrap()
        .rebuild()
        .await
        .unwrap();
    let published = |record: &VersionRecord| Published {
        record: record.clone(),
        file_count: 1,
    };
    assert_eq!(rebuilt.versions, [published(&v1), published(&v10)]);
    assert_eq!(rebuilt.states, BTreeMap::from([(object(), state.clone())]));
    assert_eq!(rebuilt.faults, []);

    // `latest` was moved back, then came a version, then that was retired.
    let moved = ObjectState {
        aliases: [("latest".to_owned(), 1)].into(),
        retired: BTreeSet::new(),
        retired_at: BTreeMap::new(),
        ..state
    };
    registry.put_state(&object(), &moved).await.unwrap();
    let latest = async || {
        let rebuilt = registry.rebuild().await.unwrap();
        rebuilt.states[&object()].aliases["latest"]
    };
    assert_eq!(latest().await, 1);
    registry.put_version(&record(13)).await.unwrap();
    assert_eq!(latest().await, 13);
    let retired = ObjectState {
        newest: 12,
        retired: [13].into(),
        ..moved
    };
    registry.put_state(&object(), &retired).await.unwrap();
    assert_eq!(latest().await, 10);

    let lost = VersionRecord {
        version: 11,
        manifest_digest: Digest::of(b"absent"),
        ..v1
    };
    registry.put_version(&lost).await.unwrap();
    std::fs::write(fixture.folder.join("versions/museum/vase/v12.json"), b"{").unwrap();
    let faults = registry.rebuild().await.unwrap().faults;
    assert_eq!(faults.len(), 2);
    assert!(
        faults[0].0.ends_with("v11.json") && faults[0].1.contains("absent"),
        "{faults:?}"
    );
}

const HOUR: Duration = Duration::from_hours(1);

impl Fixture {
    /// Makes everything in the store two hours older.
    fn age(&self) {
        for path in walk(&self.folder) {
            let file = std::fs::File::options().write(true).open(path).unwrap();
            let before = file.metadata().unwrap().modified().unwrap();
            file.set_modified(before - 2 * HOUR).unwrap();
        }
    }

    fn blob(&self, digest: &Digest) -> std::path::PathBuf {
        self.folder.join(format!(
            "blobs/sha256/{}/{}",
            &digest.hex()[..2],
            digest.hex()
        ))
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

fn keeping(manifests: &[&Digest]) -> Keep {
    Keep {
        manifests: manifests.iter().copied().cloned().collect(),
        ..Keep::default()
    }
}

async fn what_nothing_names_goes_slowly(fixture: Fixture) {
    let registry = &fixture.registry;
    let kept = bundle(registry, b"kept").await;
    let kept_digest = registry.put_manifest(&kept).await.unwrap();
    let gone = bundle(registry, b"gone").await;
    let gone_digest = registry.put_manifest(&gone).await.unwrap();
    let checkpoint = registry.put_bytes(pattern(100)).await.unwrap();
    let retired = bundle(registry, b"retired").await;
    let retired_digest = registry.put_manifest(&retired).await.unwrap();
    let keep = Keep {
        manifests: [kept_digest.clone()].into(),
        blobs: [checkpoint.clone()].into(),
        versions: [
            ((object(), 1), kept_digest.clone()),
            ((object(), 2), retired_digest.clone()),
        ]
        .into(),
    };
    // Young: everything stays.
    let collected = registry.collect(&keep, HOUR, false).await.unwrap();
    assert_eq!(
        (collected.trashed.objects, collected.deleted.objects),
        (0, 0)
    );
    assert!(collected.young.objects >= 2, "{collected:?}");

    fixture.age();
    let upload = registry.create_upload(&object()).await.unwrap();
    let fresh = registry
        .put_bytes(Bytes::from_static(b"fresh"))
        .await
        .unwrap();
    let dry = registry.collect(&keep, HOUR, true).await.unwrap();
    // The manifest and blob of `gone`; of `retired` the blob alone.
    assert_eq!(dry.trashed.objects, 3);
    assert_eq!(dry.young.objects, 1);
    assert_eq!(
        registry.collect(&keep, HOUR, true).await.unwrap(),
        dry,
        "a dry run changes nothing"
    );
    assert_eq!(registry.collect(&keep, HOUR, false).await.unwrap(), dry);
    let after = registry.collect(&keep, HOUR, false).await.unwrap();
    assert_eq!(after.trashed.objects, 0);
    assert_eq!((after.waiting, after.deleted.objects), (dry.trashed, 0));

    // Who asks for it gets it back, and nothing else was touched.
    let gone_blob = gone.files()[0].digest.clone();
    assert!(!fixture.blob(&gone_blob).exists());
    assert_eq!(content(registry, &gone_blob, None).await.unwrap(), b"gone");
    assert!(fixture.blob(&gone_blob).exists());
    assert!(registry.manifest(&retired_digest).await.unwrap().is_some());
    for blob in [&checkpoint, &fresh, &kept.files()[0].digest] {
        assert!(fixture.blob(blob).exists());
    }
    assert_eq!(registry.upload_offset(&object(), upload).await.unwrap(), 0);

    // After another grace it is deleted; what is named again meanwhile comes back first.
    let keep = Keep {
        manifests: [kept_digest, gone_digest.clone()].into(),
        ..keep
    };
    let last = registry
        .collect(&keep, Duration::ZERO, false)
        .await
        .unwrap();
    assert_eq!(last.rescued.objects, 1, "the manifest of `gone`: {last:?}");
    assert_eq!(last.deleted.objects, 1, "the blob of `retired`: {last:?}");
    let retired_blob = &retired.files()[0].digest;
    assert_eq!(registry.blob_size(retired_blob).await.unwrap(), None);
    registry.check_blobs(&gone).await.unwrap();
    assert!(registry.manifest(&gone_digest).await.unwrap().is_some());
}

/// A client finds that the store has its files from long ago, so it sends none; then it puts the manifest, and submits.
/// Two collections come between any of these steps.
async fn a_collection_at_any_point_of_a_submit_loses_nothing(fixture: Fixture) {
    const STEPS: usize = 4;
    let registry = &fixture.registry;
    for first in 0..=STEPS {
        for second in first..=STEPS {
            let bytes = Bytes::from(format!("{first} {second}"));
            let digest = registry.put_bytes(bytes.clone()).await.unwrap();
            let file = FileEntry {
                path: "mesh.ply".parse().unwrap(),
                digest: digest.clone(),
                size_bytes: bytes.len() as u64,
                media_type: "application/octet-stream".to_owned(),
            };
            let capture = Manifest::new(Kind::Capture, vec![file], BTreeMap::new()).unwrap();
            fixture.age();
            let mut named: Option<Digest> = None;
            for step in 0..=STEPS {
                for point in [first, second] {
                    if point == step {
                        let keep = keeping(&named.iter().collect::<Vec<_>>());
                        registry.collect(&keep, HOUR, false).await.unwrap();
                    }
                }
                match step {
                    0 => assert_eq!(
                        registry.blob_size(&digest).await.unwrap(),
                        Some(bytes.len() as u64)
                    ),
                    1 => {
                        registry.put_manifest(&capture).await.unwrap();
                    }
                    2 => {
                        let there = Digest::of(&capture.encode().unwrap());
                        let found = registry.manifest_to_name(&there).await.unwrap();
                        assert_eq!(found.as_ref(), Some(&capture));
                    }
                    3 => named = Some(Digest::of(&capture.encode().unwrap())),
                    _ => {}
                }
            }
            fixture.age();
            let keep = keeping(&[named.as_ref().unwrap()]);
            for _ in 0..2 {
                registry.collect(&keep, HOUR, false).await.unwrap();
            }
            registry.check_blobs(&capture).await.unwrap();
            assert_eq!(content(registry, &digest, None).await.unwrap(), bytes);
        }
    }
}

async fn a_database_that_knows_less_than_the_bucket_collects_nothing(fixture: Fixture) {
    let registry = &fixture.registry;
    let manifest = bundle(registry, b"one").await;
    let manifest_digest = registry.put_manifest(&manifest).await.unwrap();
    let record = VersionRecord {
        object: object(),
        version: 1,
        manifest_digest: manifest_digest.clone(),
        size_bytes: manifest.size_bytes(),
        job_id: JobId::generate(),
        created_at: chrono::DateTime::from_timestamp(1_700_000_000, 0).unwrap(),
        metrics_json: "{}".to_owned(),
    };
    registry.put_version(&record).await.unwrap();
    fixture.age();
    let refused = registry.collect(&Keep::default(), HOUR, false).await;
    assert!(
        matches!(&refused, Err(RegistryError::VersionUnknown { path }) if path.ends_with("v1.json")),
        "{refused:?}"
    );
    registry.check_blobs(&manifest).await.unwrap();

    // Nor one whose manifest cannot be read: nobody knows what it names.
    let keep = Keep {
        manifests: [manifest_digest.clone()].into(),
        versions: [((object(), 1), manifest_digest.clone())].into(),
        ..Keep::default()
    };
    let path = fixture.folder.join(format!(
        "manifests/sha256/{}/{}",
        &manifest_digest.hex()[..2],
        manifest_digest.hex()
    ));
    std::fs::remove_file(path).unwrap();
    let refused = registry.collect(&keep, HOUR, false).await;
    assert!(
        matches!(&refused, Err(RegistryError::Damaged { .. })),
        "{refused:?}"
    );
    registry.check_blobs(&manifest).await.unwrap();
}

async fn an_audit_finds_and_repairs_what_rotted(fixture: Fixture) {
    let registry = &fixture.registry;
    let manifest = bundle(registry, b"one").await;
    let named = [registry.put_manifest(&manifest).await.unwrap()].into();
    let other = registry.put_bytes(pattern(1000)).await.unwrap();
    let clean = registry.audit(None, &named, None).await.unwrap();
    // Two blobs, the empty config, the manifest.
    assert_eq!((clean.read.objects, clean.faults.len()), (4, 0));

    let replica_keep = tempfile::tempdir().unwrap();
    let config = StoreConfig::new(format!("file://{}", replica_keep.path().display()));
    let copy = Registry::open(&config).await.unwrap();
    copy.put_bytes(Bytes::from_static(b"one")).await.unwrap();
    let replica = Registry::connect(&config).unwrap();

    let one = manifest.files()[0].digest.clone();
    for damage in ["rotten", "absent"] {
        std::fs::write(fixture.blob(&other), b"rotten").unwrap();
        if damage == "rotten" {
            std::fs::write(fixture.blob(&one), b"onE").unwrap();
        } else {
            std::fs::remove_file(fixture.blob(&one)).unwrap();
        }
        let audit = registry.audit(None, &named, Some(&replica)).await.unwrap();
        let outcome = |digest: &Digest| {
            let of = |fault: &&ign_registry::Fault| fault.path.ends_with(digest.hex());
            audit.faults.iter().find(of).map(|fault| fault.outcome)
        };
        assert_eq!(audit.faults.len(), 2, "{damage}: {audit:?}");
        assert_eq!(outcome(&one), Some(Outcome::Repaired));
        assert_eq!(outcome(&other), Some(Outcome::SetAside));
        assert_eq!(content(registry, &one, None).await.unwrap(), b"one");
        // Nobody is served wrong bytes, and sending the right ones repairs it.
        assert_eq!(registry.blob_size(&other).await.unwrap(), None);
        registry.put_bytes(pattern(1000)).await.unwrap();
    }
    // A replica that rotted too repairs nothing.
    let in_replica =
        replica_keep
            .path()
            .join(format!("blobs/sha256/{}/{}", &one.hex()[..2], one.hex()));
    std::fs::write(in_replica, b"onE").unwrap();
    std::fs::remove_file(fixture.blob(&one)).unwrap();
    let audit = registry.audit(None, &named, Some(&replica)).await.unwrap();
    assert_eq!(audit.faults.len(), 1);
    assert_eq!(audit.faults[0].outcome, Outcome::Absent);
    // By slices each object is read once.
    registry
        .put_bytes(Bytes::from_static(b"one"))
        .await
        .unwrap();
    let mut objects = 0;
    for byte in 0..=255 {
        let audit = registry.audit(Some(byte), &named, None).await.unwrap();
        assert_eq!(audit.faults, []);
        objects += audit.read.objects;
    }
    assert_eq!(objects, 4);
}

#[tokio::test]
async fn a_wrong_address_is_refused_with_the_reason() {
    for url in [
        "",
        "store",
        "file://relative",
        "ftp://host",
        "s3://",
        "file:///dev/null/x",
    ] {
        let error = Registry::open(&StoreConfig::new(url)).await.unwrap_err();
        assert!(
            matches!(error, RegistryError::Location { .. }),
            "{url}: {error}"
        );
    }
}
