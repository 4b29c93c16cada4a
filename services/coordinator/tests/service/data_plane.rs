//! Blobs, uploads and manifests over HTTP.

use std::time::Duration;

use ign_proto::{Digest, Kind};
use ign_testkit::S3;
use reqwest::{Method, StatusCode};
use tokio::io::AsyncWriteExt as _;

use crate::fixture::{Service, TOKEN, manifest, pattern};

const MIB: usize = 1024 * 1024;

#[tokio::test]
async fn a_blob_that_is_there_is_not_sent_again_and_reads_with_ranges() {
    let service = Service::start().await;
    let bytes = pattern(1000);
    let path = format!("/v2/museum/vase/blobs/{}", Digest::of(&bytes));
    let head = service.request(Method::HEAD, &path).send().await.unwrap();
    assert_eq!(head.status(), StatusCode::NOT_FOUND);
    service.upload("museum/vase", &bytes).await;
    let head = service.request(Method::HEAD, &path).send().await.unwrap();
    assert_eq!(
        (
            head.status(),
            head.headers()["content-length"].to_str().unwrap()
        ),
        (StatusCode::OK, "1000")
    );
    // One store: another object has it too, and an OCI client may mount it.
    let other = path.replace("vase", "bust");
    assert_eq!(
        service
            .request(Method::HEAD, &other)
            .send()
            .await
            .unwrap()
            .status(),
        StatusCode::OK
    );
    let mount = format!(
        "/v2/museum/bust/blobs/uploads/?mount={}&from=museum/vase",
        Digest::of(&bytes)
    );
    assert_eq!(
        service
            .request(Method::POST, &mount)
            .send()
            .await
            .unwrap()
            .status(),
        StatusCode::CREATED
    );

    let whole = service.request(Method::GET, &path).send().await.unwrap();
    let etag = whole.headers()["etag"].clone();
    assert_eq!(
        whole.headers()["docker-content-digest"],
        Digest::of(&bytes).as_str()
    );
    assert_eq!(whole.bytes().await.unwrap(), bytes);
    for (range, expected, content_range) in [
        ("bytes=10-19", &bytes[10..20], "bytes 10-19/1000"),
        ("bytes=990-", &bytes[990..], "bytes 990-999/1000"),
        ("bytes=-5", &bytes[995..], "bytes 995-999/1000"),
    ] {
        let part = service
            .request(Method::GET, &path)
            .header("range", range)
            .send()
            .await
            .unwrap();
        assert_eq!(part.status(), StatusCode::PARTIAL_CONTENT);
        assert_eq!(part.headers()["content-range"], content_range);
        assert_eq!(part.bytes().await.unwrap(), expected);
    }
    let outside = service
        .request(Method::GET, &path)
        .header("range", "bytes=1000-")
        .send()
        .await
        .unwrap();
    assert_eq!(outside.status(), StatusCode::RANGE_NOT_SATISFIABLE);
    assert_eq!(outside.headers()["content-range"], "bytes */1000");
    let known = service
        .request(Method::GET, &path)
        .header("if-none-match", etag)
        .send()
        .await
        .unwrap();
    assert_eq!(known.status(), StatusCode::NOT_MODIFIED);
    let changed = service
        .request(Method::GET, &path)
        .header("range", "bytes=0-1")
        .header("if-range", "\"x\"");
    assert_eq!(changed.send().await.unwrap().status(), StatusCode::OK);
}

#[tokio::test]
async fn an_upload_goes_on_after_a_broken_connection_and_a_restart() {
    let mut service = Service::start().await;
    let bytes = pattern(11 * MIB + 3);
    let digest = Digest::of(&bytes);
    let begun = service
        .request(Method::POST, "/v2/museum/vase/blobs/uploads/")
        .send()
        .await
        .unwrap();
    assert_eq!(begun.status(), StatusCode::ACCEPTED);
    let location = begun.headers()["location"].to_str().unwrap().to_owned();

    // Send a part of what the header promises, then vanish.
    let mut socket = tokio::net::TcpStream::connect(service.url.trim_start_matches("http://"))
        .await
        .unwrap();
    let head = format!(
        "PATCH {location} HTTP/1.1\r\nhost: x\r\nauthorization: Bearer {TOKEN}\r\ncontent-range: 0-{}\r\ncontent-length: {}\r\n\r\n",
        bytes.len() - 1,
        bytes.len()
    );
    socket.write_all(head.as_bytes()).await.unwrap();
    socket.write_all(&bytes[..9 * MIB]).await.unwrap();
    drop(socket);
    let offset = wait_for_offset(&service, &location, 9 * MIB).await;

    service.restart().await;
    assert_eq!(wait_for_offset(&service, &location, offset).await, offset);
    let wrong = service
        .request(Method::PATCH, &location)
        .header("content-range", "0-9")
        .body(vec![0; 10]);
    let wrong = wrong.send().await.unwrap();
    assert_eq!(wrong.status(), StatusCode::RANGE_NOT_SATISFIABLE);
    assert_eq!(
        wrong.headers()["range"],
        format!("0-{}", offset - 1).as_str()
    );

    let range = format!("{offset}-{}", bytes.len() - 1);
    let rest = service
        .request(Method::PATCH, &location)
        .header("content-range", range)
        .body(bytes[offset..].to_vec());
    assert_eq!(rest.send().await.unwrap().status(), StatusCode::ACCEPTED);
    let finish = format!("{location}?digest={digest}");
    let done = service.request(Method::PUT, &finish).send().await.unwrap();
    assert_eq!(done.status(), StatusCode::CREATED);
    let blob = done.headers()["location"].to_str().unwrap().to_owned();
    assert_eq!(
        service
            .request(Method::GET, &blob)
            .send()
            .await
            .unwrap()
            .bytes()
            .await
            .unwrap(),
        bytes
    );
    // Answers get lost: finishing again is fine, and the session is gone.
    assert_eq!(
        service
            .request(Method::PUT, &finish)
            .send()
            .await
            .unwrap()
            .status(),
        StatusCode::CREATED
    );
    assert_eq!(
        service
            .request(Method::GET, &location)
            .send()
            .await
            .unwrap()
            .status(),
        StatusCode::NOT_FOUND
    );
}

/// Waits until the coordinator has noticed the broken connection; returns where the upload stands.
async fn wait_for_offset(service: &Service, location: &str, at_least: usize) -> usize {
    for _ in 0..100 {
        let state = service.request(Method::GET, location).send().await.unwrap();
        assert_eq!(state.status(), StatusCode::NO_CONTENT);
        let range = state.headers()["range"].to_str().unwrap().to_owned();
        let end = range.strip_prefix("0-").unwrap().parse::<usize>().unwrap() + 1;
        if end >= at_least {
            return end;
        }
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    panic!("what arrived was not kept");
}

#[tokio::test]
async fn wrong_bodies_names_and_digests_are_refused_with_the_reason() {
    let service = Service::start().await;
    let digest = Digest::of(b"right");
    let put = |body: &'static [u8], path: String| service.request(Method::POST, &path).body(body);
    let wrong = put(b"wrong", format!("/v2/c/o/blobs/uploads/?digest={digest}"))
        .send()
        .await
        .unwrap();
    assert_eq!(wrong.status(), StatusCode::BAD_REQUEST);
    assert!(wrong.text().await.unwrap().contains("DIGEST_INVALID"));
    let head = service
        .request(Method::HEAD, &format!("/v2/c/o/blobs/{digest}"))
        .send()
        .await
        .unwrap();
    assert_eq!(head.status(), StatusCode::NOT_FOUND);
    for path in [
        "/v2/C/o/blobs/uploads/",
        "/v2/c/..%2f..%2fetc/blobs/uploads/",
        "/v2/c/%2e%2e/blobs/uploads/",
        "/v2/c/o/blobs/uploads/?digest=md5:00",
        "/v2/c/o/blobs/uploads/?digest=sha256:../../x",
    ] {
        let answer = put(b"", path.to_owned()).send().await.unwrap();
        assert!(
            answer.status().is_client_error(),
            "{path}: {}",
            answer.status()
        );
    }
    let absent = "/v2/c/o/blobs/uploads/00000000-0000-4000-8000-000000000000";
    for path in [absent, "/v2/c/o/blobs/uploads/..%2f..%2fversions"] {
        let answer = service
            .request(Method::PATCH, path)
            .body("x")
            .send()
            .await
            .unwrap();
        assert_eq!(answer.status(), StatusCode::NOT_FOUND, "{path}");
    }
    // An upload of one object cannot be gone on with under another.
    let begun = service
        .request(Method::POST, "/v2/c/o/blobs/uploads/")
        .send()
        .await
        .unwrap();
    let location = begun.headers()["location"]
        .to_str()
        .unwrap()
        .replace("/o/", "/other/");
    let answer = service
        .request(Method::PATCH, &location)
        .body("x")
        .send()
        .await
        .unwrap();
    assert_eq!(answer.status(), StatusCode::NOT_FOUND);
}

#[tokio::test]
async fn clients_put_capture_manifests_alone_and_only_with_all_blobs() {
    let service = Service::start().await;
    let files: &[(&str, &[u8])] = &[("images/1.png", b"one"), ("mesh.ply", b"ply")];
    service.upload("c/o", b"one").await;
    let put = |kind, reference: Option<&str>| {
        let bytes = manifest(kind, files).encode().unwrap();
        let reference = reference.map_or_else(|| Digest::of(&bytes).to_string(), str::to_owned);
        service
            .request(Method::PUT, &format!("/v2/c/o/manifests/{reference}"))
            .body(bytes)
            .send()
    };
    let missing = put(Kind::Capture, None).await.unwrap();
    assert_eq!(missing.status(), StatusCode::BAD_REQUEST);
    assert!(
        missing
            .text()
            .await
            .unwrap()
            .contains("MANIFEST_BLOB_UNKNOWN")
    );
    service.upload("c/o", b"ply").await;
    assert_eq!(
        put(Kind::Capture, None).await.unwrap().status(),
        StatusCode::CREATED
    );
    assert_eq!(
        put(Kind::Capture, None).await.unwrap().status(),
        StatusCode::CREATED
    );
    assert_eq!(
        put(Kind::Capture, Some("v1")).await.unwrap().status(),
        StatusCode::FORBIDDEN
    );
    assert_eq!(
        put(Kind::Bundle, None).await.unwrap().status(),
        StatusCode::FORBIDDEN
    );
    let other = Digest::of(b"other").to_string();
    assert_eq!(
        put(Kind::Capture, Some(&other)).await.unwrap().status(),
        StatusCode::BAD_REQUEST
    );

    let bytes = manifest(Kind::Capture, files).encode().unwrap();
    let path = format!("/v2/c/o/manifests/{}", Digest::of(&bytes));
    let head = service.request(Method::HEAD, &path).send().await.unwrap();
    assert_eq!(
        head.headers()["content-length"],
        bytes.len().to_string().as_str()
    );
    let read = service.request(Method::GET, &path).send().await.unwrap();
    assert_eq!(
        read.headers()["content-type"],
        "application/vnd.oci.image.manifest.v1+json"
    );
    assert_eq!(read.bytes().await.unwrap(), bytes);

    let text = String::from_utf8(bytes)
        .unwrap()
        .replace("images/1.png", "../../1.png");
    let path = format!("/v2/c/o/manifests/{}", Digest::of(text.as_bytes()));
    let escape = service
        .request(Method::PUT, &path)
        .body(text)
        .send()
        .await
        .unwrap();
    assert_eq!(escape.status(), StatusCode::BAD_REQUEST);
    assert!(escape.text().await.unwrap().contains("../../1.png"));
}

#[tokio::test]
async fn a_store_that_signs_serves_blobs_itself() {
    let server = S3::start().unwrap();
    let service = Service::with(|config| {
        config.store.url = server.url("signed");
        config.store.options = server
            .env()
            .into_iter()
            .map(|(key, value)| (key.to_lowercase(), value))
            .collect();
    })
    .await;
    let bytes = pattern(3 * MIB);
    let digest = service.upload("museum/vase", &bytes).await;
    let path = format!("/v2/museum/vase/blobs/{digest}");
    let stay = reqwest::Client::builder()
        .redirect(reqwest::redirect::Policy::none())
        .build()
        .unwrap();
    let answer = stay
        .get(format!("{}{path}", service.url))
        .bearer_auth(TOKEN)
        .send()
        .await
        .unwrap();
    assert_eq!(answer.status(), StatusCode::TEMPORARY_REDIRECT);
    assert!(
        answer.headers()["location"]
            .to_str()
            .unwrap()
            .starts_with(&server.endpoint())
    );
    let followed = service
        .request(Method::GET, &path)
        .header("range", "bytes=5-9")
        .send()
        .await
        .unwrap();
    assert_eq!(followed.status(), StatusCode::PARTIAL_CONTENT);
    assert_eq!(followed.bytes().await.unwrap(), bytes[5..10]);
}
