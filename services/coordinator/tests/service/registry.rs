//! The registry as a whole: rebuilt, collected, audited; and what happens when there is no room or no database.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use ign_coordinator::Care;
use ign_proto::{Cause, Digest, v1};
use ign_registry::StoreConfig;
use ign_testkit::Postgres;
use reqwest::{Method, StatusCode};

use crate::fixture::{Service, object_ref, submit_request};

const HOUR: Duration = Duration::from_hours(1);

fn reference(object: &str, reference: &str) -> v1::GetBundleRequest {
    v1::GetBundleRequest {
        object: Some(object_ref(object)),
        reference: reference.to_owned(),
    }
}

fn cause(status: &tonic::Status) -> Cause {
    Cause::from_status(status)
}

impl Service {
    /// Submits, leases and completes one bundle.
    async fn publish(
        &mut self,
        object: &str,
        request_id: &str,
        content: &[u8],
    ) -> v1::BundleVersion {
        self.submit(object, request_id).await;
        let lease = self.lease("worker-1", 5.0).await.unwrap();
        self.complete(&lease, "worker-1", &[("bundle.json", content)])
            .await
            .unwrap()
    }

    async fn gc(&mut self, dry_run: bool) -> v1::CollectGarbageResponse {
        let request = v1::CollectGarbageRequest {
            dry_run,
            grace_secs: HOUR.as_secs_f64(),
        };
        self.admin
            .collect_garbage(request)
            .await
            .unwrap()
            .into_inner()
    }

    async fn pool(&self) -> sqlx::SqlitePool {
        let url = format!("sqlite://{}/ign.db", self.folder.display());
        sqlx::SqlitePool::connect(&url).await.unwrap()
    }

    /// All rows of the registry's tables, as text.
    async fn rows(&self) -> Vec<String> {
        let pool = self.pool().await;
        let mut rows = Vec::new();
        for table in [
            "select json_array(collection, object, last_version) from objects order by 1",
            "select json_array(collection, object, version, manifest_digest, size_bytes, file_count, metrics_json, \
             job_id, created_at, retired, retired_at) from versions order by 1",
            "select json_array(collection, object, alias, version) from aliases order by 1",
        ] {
            let found: Vec<String> = sqlx::query_scalar(table).fetch_all(&pool).await.unwrap();
            assert!(!found.is_empty());
            rows.extend(found);
        }
        pool.close().await;
        rows
    }

    async fn execute(&self, sql: &'static str) {
        let pool = self.pool().await;
        sqlx::query(sql).execute(&pool).await.unwrap();
        pool.close().await;
    }

    /// Makes everything in the store two hours older.
    fn age(&self) {
        for path in walk(&self.folder.join("store")) {
            let file = std::fs::File::options().write(true).open(path).unwrap();
            let before = file.metadata().unwrap().modified().unwrap();
            file.set_modified(before - 2 * HOUR).unwrap();
        }
    }

    fn blob(&self, digest: &Digest) -> PathBuf {
        let (hex, folder) = (digest.hex(), &digest.hex()[..2]);
        self.folder
            .join(format!("store/blobs/sha256/{folder}/{hex}"))
    }

    async fn events(&mut self) -> Vec<v1::Event> {
        let request = v1::ListEventsRequest::default();
        let events = self.admin.list_events(request).await.unwrap();
        events.into_inner().events
    }
}

fn walk(folder: &Path) -> Vec<PathBuf> {
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

fn files(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    walk(folder)
        .into_iter()
        .map(|path| {
            let bytes = std::fs::read(&path).unwrap();
            (path, bytes)
        })
        .collect()
}

#[tokio::test]
async fn the_registry_is_rebuilt_from_the_bucket_alone_byte_for_byte() {
    let mut service = Service::start().await;
    for (index, content) in [b"one", b"two", b"six"].into_iter().enumerate() {
        service
            .publish("museum/vase", &format!("request-{index}"), content)
            .await;
    }
    service.publish("library/urn", "request-9", b"urn").await;
    let approve = v1::SetAliasRequest {
        object: Some(object_ref("museum/vase")),
        reference: "v1".to_owned(),
        alias: "approved".to_owned(),
    };
    service.bundles.set_alias(approve).await.unwrap();
    service
        .bundles
        .retire(reference("museum/vase", "v3"))
        .await
        .unwrap();
    let rows = service.rows().await;
    let records = files(&service.folder.join("store/versions"));

    // The command, on a database whose registry is gone.
    for table in [
        "delete from aliases",
        "delete from versions",
        "delete from objects",
    ] {
        service.execute(table).await;
    }
    let request = v1::RebuildRegistryRequest {};
    let rebuilt = service.admin.rebuild_registry(request).await.unwrap();
    let rebuilt = rebuilt.into_inner();
    assert_eq!((rebuilt.added, rebuilt.known), (4, 0));
    assert_eq!(rebuilt.faults, []);
    assert_eq!(service.rows().await, rows);
    let again = service.admin.rebuild_registry(request).await.unwrap();
    assert_eq!((again.get_ref().added, again.get_ref().known), (0, 4));

    // A coordinator that starts on an empty database does it by itself: a number must never be given twice.
    service.stop().await;
    for name in ["ign.db", "ign.db-wal", "ign.db-shm"] {
        std::fs::remove_file(service.folder.join(name)).ok();
    }
    service.restart().await;
    assert_eq!(service.rows().await, rows);
    let next = service.publish("museum/vase", "request-10", b"ten").await;
    assert_eq!(next.version, 4);
    let now = files(&service.folder.join("store/versions"));
    for (path, bytes) in records {
        if !path.ends_with("museum/vase/state.json") {
            assert_eq!(now[&path], bytes, "{}", path.display());
        }
    }
}

#[tokio::test]
async fn garbage_goes_and_what_is_named_stays() {
    let mut service = Service::start().await;
    let first = service.publish("museum/vase", "request-1", b"first").await;
    service.publish("museum/vase", "request-2", b"two").await;
    let orphan = service.upload("museum/vase", b"orphan").await;
    let live = service.submit("museum/bust", "request-3").await;
    service
        .bundles
        .retire(reference("museum/vase", "v1"))
        .await
        .unwrap();
    service.age();
    let dry = service.gc(true).await;
    let moved = dry.trashed.unwrap();
    assert_eq!(moved.objects, 1, "the orphan alone: {dry:?}");
    assert!(service.blob(&orphan).exists(), "a dry run changes nothing");
    assert_eq!(service.gc(false).await, dry);
    assert!(!service.blob(&orphan).exists());
    let short = v1::CollectGarbageRequest {
        dry_run: true,
        grace_secs: 60.0,
    };
    let refused = cause(&service.admin.collect_garbage(short).await.unwrap_err());
    assert_eq!(refused.reason(), "BAD_FIELD");

    // Retired and ended long ago: the files of v1 go, its number and record stay.
    service
        .execute("update versions set retired_at = 1 where retired")
        .await;
    service
        .execute("update jobs set finished_at = 1 where finished_at is not null")
        .await;
    service.age();
    let moved = service.gc(false).await.trashed.unwrap();
    assert_eq!(
        moved.objects, 1,
        "the file of v1 alone: the capture is that of a live job"
    );
    let one = Digest::of(b"first");
    assert!(!service.blob(&one).exists());
    // Restored within the grace, it is whole again.
    let restored = service
        .bundles
        .restore(reference("museum/vase", "v1"))
        .await
        .unwrap()
        .into_inner();
    assert!(!restored.retired);
    assert_eq!(restored.manifest_digest, first.manifest_digest);
    assert!(service.blob(&one).exists());

    // Retired again, collected, and its grace in the trash over: it cannot come back, and says why.
    service
        .bundles
        .retire(reference("museum/vase", "v1"))
        .await
        .unwrap();
    service
        .execute("update versions set retired_at = 1 where retired")
        .await;
    service.age();
    service.gc(false).await;
    std::fs::remove_dir_all(service.folder.join("store/trash")).unwrap();
    let gone = service
        .bundles
        .restore(reference("museum/vase", "v1"))
        .await;
    assert_eq!(cause(&gone.unwrap_err()).reason(), "FILES_COLLECTED");

    // A job whose capture was collected cannot be tried again.
    let cancel = v1::GetJobRequest {
        job_id: live.id.clone(),
    };
    service.jobs.cancel(cancel.clone()).await.unwrap();
    service
        .execute("update jobs set finished_at = 1 where finished_at is not null")
        .await;
    service.age();
    let moved = service.gc(false).await.trashed.unwrap();
    assert_eq!(moved.objects, 3, "the capture's manifest and two files");
    // Within the grace it still can: it is taken back from the trash.
    let retried = service.jobs.retry(cancel.clone()).await.unwrap();
    assert_eq!(retried.get_ref().state(), v1::JobState::Queued);
    service.jobs.cancel(cancel.clone()).await.unwrap();
    std::fs::remove_dir_all(service.folder.join("store/manifests")).unwrap();
    let refused = cause(&service.jobs.retry(cancel).await.unwrap_err());
    assert_eq!(refused.reason(), "CAPTURE_MISSING");

    let kinds: Vec<String> = service
        .events()
        .await
        .into_iter()
        .map(|event| event.kind)
        .collect();
    assert_eq!(kinds.iter().filter(|kind| *kind == "collect").count(), 4);
    assert_eq!(kinds.iter().filter(|kind| *kind == "retire").count(), 2);
    assert_eq!(kinds.iter().filter(|kind| *kind == "restore").count(), 1);
}

#[tokio::test]
async fn rot_is_found_and_repaired_without_anybody_asking() {
    let replica = tempfile::tempdir().unwrap();
    let url = format!("file://{}", replica.path().display());
    let mut service = Service::with(|config| {
        config.care = Care {
            // A slice every 4 ms.
            audit_every: Some(Duration::from_millis(1024)),
            replica: Some(StoreConfig::new(url)),
            ..Care::default()
        };
    })
    .await;
    service.publish("museum/vase", "request-1", b"one").await;
    for (path, bytes) in files(&service.folder.join("store/blobs")) {
        let store = service.folder.join("store");
        let copy = replica.path().join(path.strip_prefix(store).unwrap());
        std::fs::create_dir_all(copy.parent().unwrap()).unwrap();
        std::fs::write(copy, bytes).unwrap();
    }
    let path = service.blob(&Digest::of(b"one"));
    std::fs::write(&path, b"onE").unwrap();
    let begun = Instant::now();
    while std::fs::read(&path).is_ok_and(|bytes| bytes != b"one") {
        assert!(begun.elapsed() < Duration::from_mins(1), "not repaired");
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    let damage = loop {
        let events = service.events().await;
        if let Some(damage) = events.into_iter().find(|event| event.kind == "damage") {
            break damage;
        }
        assert!(begun.elapsed() < Duration::from_mins(1), "not recorded");
        tokio::time::sleep(Duration::from_millis(20)).await;
    };
    assert!(damage.subject.ends_with(Digest::of(b"one").hex()));
    assert!(damage.message.contains("repaired"), "{damage:?}");
    // On request everything is read at once.
    let request = v1::AuditRegistryRequest {};
    let audit = service.admin.audit_registry(request).await.unwrap();
    let audit = audit.into_inner();
    assert_eq!(audit.faults, []);
    assert_eq!(
        audit.read.unwrap().objects,
        walk(&service.folder.join("store/blobs")).len() as u64 + 2
    );
}

#[tokio::test]
async fn a_full_disk_refuses_new_work_and_lets_the_rest_go_on() {
    let mut service = Service::start().await;
    service.publish("museum/vase", "request-1", b"one").await;
    let waiting = service.submit("museum/bust", "request-2").await;
    let capture = service
        .upload_capture("museum/vase", &[("mesh.ply", b"ply")])
        .await;
    // Half of the reserve is free: room for results, not for new work.
    let free = free_bytes(&service.folder);
    service.care(|care| care.reserve_bytes = free + free / 2);
    service.restart().await;
    let refused = service
        .jobs
        .submit(submit_request("museum/vase", "request-3", &capture))
        .await;
    let refused = cause(&refused.unwrap_err());
    assert_eq!(refused.reason(), "FULL");
    assert!(refused.to_string().contains("nearly full"), "{refused}");
    assert!(service.lease("worker-1", 0.2).await.is_none());
    let shown = service.get(&waiting.id).await;
    assert!(shown.waiting_for.contains("nearly full"), "{shown:?}");
    service.upload("museum/vase", b"a result").await;

    // Less than half: no blob is taken either, and none of this stops.
    service.care(|care| care.reserve_bytes = u64::MAX);
    service.restart().await;
    let digest = Digest::of(b"more");
    let path = format!("/v2/museum/vase/blobs/uploads/?digest={digest}");
    let answer = service.request(Method::POST, &path).body("more");
    let answer = answer.send().await.unwrap();
    assert_eq!(answer.status(), StatusCode::INSUFFICIENT_STORAGE);
    let said: serde_json::Value = answer.json().await.unwrap();
    assert_eq!(said["errors"][0]["code"], "FULL");
    let request = v1::GetJobRequest {
        job_id: waiting.id.clone(),
    };
    let cancelled = service.jobs.cancel(request).await.unwrap().into_inner();
    assert_eq!(cancelled.state(), v1::JobState::Cancelled);
    service
        .bundles
        .retire(reference("museum/vase", "v1"))
        .await
        .unwrap();
    service.age();
    service.gc(false).await;
    service
        .jobs
        .status(v1::StatusRequest::default())
        .await
        .unwrap();

    service.care(|care| care.reserve_bytes = 0);
    service.restart().await;
    service.submit("museum/vase", "request-3").await;
}

fn free_bytes(folder: &Path) -> u64 {
    let stat = rustix::fs::statvfs(folder).unwrap();
    stat.f_bavail * stat.f_frsize
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_dead_database_refuses_clearly_and_costs_nothing_that_was_acknowledged() {
    let postgres = tokio::task::spawn_blocking(|| Postgres::start().unwrap())
        .await
        .unwrap();
    let url = postgres.create_database().unwrap();
    let mut service = Service::with(|config| config.database = url).await;
    let job = service.submit("museum/vase", "request-1").await;
    let lease = service.lease("worker-1", 5.0).await.unwrap();
    postgres.stop().unwrap();
    let begun = Instant::now();
    let capture = service
        .upload_capture("museum/vase", &[("mesh.ply", b"ply")])
        .await;
    let refused = service
        .jobs
        .submit(submit_request("museum/vase", "request-2", &capture))
        .await;
    let refused = cause(&refused.unwrap_err());
    assert_eq!(refused.reason(), "UNAVAILABLE");
    assert!(refused.to_string().contains("database"), "{refused}");
    let late = service.complete(&lease, "worker-1", &[("bundle.json", b"one")]);
    assert!(late.await.unwrap_err().retryable());
    assert!(
        begun.elapsed() < Duration::from_secs(30),
        "{:?}",
        begun.elapsed()
    );
    let ready = service
        .request(Method::GET, "/readyz")
        .send()
        .await
        .unwrap();
    assert_eq!(ready.status(), StatusCode::SERVICE_UNAVAILABLE);

    postgres.resume().unwrap();
    let published = loop {
        match service
            .complete(&lease, "worker-1", &[("bundle.json", b"one")])
            .await
        {
            Ok(published) => break published,
            Err(cause) => assert!(
                cause.retryable() && begun.elapsed() < Duration::from_mins(1),
                "{cause}"
            ),
        }
    };
    assert_eq!((published.version, published.job_id), (1, job.id));
    service
        .jobs
        .submit(submit_request("museum/vase", "request-2", &capture))
        .await
        .unwrap();
}
