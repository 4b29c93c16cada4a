//! Peers that cost more than they may.

use std::time::{Duration, Instant};

use ign_coordinator::Config;
use ign_proto::manifest::MAX_BYTES;
use ign_proto::{Cause, Digest, FileEntry, Kind, Manifest, v1};
use reqwest::{Method, StatusCode};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpStream;

use crate::fixture::{Service, TOKEN, attempt, submit_request};

/// Limits so tight that a test can wait for them.
fn tight(config: &mut Config) {
    config.limits.first_request = Duration::from_millis(600);
    config.limits.head = Duration::from_millis(900);
    config.limits.body_silence = Duration::from_millis(400);
    config.limits.body_bytes_per_sec = 1000;
    config.limits.connections_per_peer = 5;
}

async fn connect(service: &Service) -> TcpStream {
    let address = service.url.strip_prefix("http://").unwrap();
    TcpStream::connect(address).await.unwrap()
}

/// What comes until the other side closes, which it must do soon.
async fn until_closed(socket: &mut TcpStream) -> String {
    let mut answer = Vec::new();
    // A reset closes too.
    let read = tokio::time::timeout(Duration::from_secs(5), socket.read_to_end(&mut answer));
    read.await.expect("the connection is closed in time").ok();
    String::from_utf8_lossy(&answer).into_owned()
}

#[tokio::test]
async fn slow_heads_are_cut() {
    let service = Service::with(tight).await;
    let begun = Instant::now();
    for head in [
        &b""[..],
        b"GET /heal",
        b"GET /healthz HTTP/1.1\r\nhost: x\r\nx-a: ",
        b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n",
    ] {
        let mut socket = connect(&service).await;
        socket.write_all(head).await.unwrap();
        until_closed(&mut socket).await;
    }
    assert!(
        begun.elapsed() >= Duration::from_secs(2),
        "{:?}",
        begun.elapsed()
    );
    // A trickle of headers does not buy time.
    let mut socket = connect(&service).await;
    socket
        .write_all(b"GET /healthz HTTP/1.1\r\n")
        .await
        .unwrap();
    let trickle = async {
        loop {
            tokio::time::sleep(Duration::from_millis(100)).await;
            if socket.write_all(b"x-a: b\r\n").await.is_err() {
                return;
            }
        }
    };
    tokio::time::timeout(Duration::from_secs(5), trickle)
        .await
        .expect("it is cut");
    // After a first request another half one is cut too.
    let mut socket = connect(&service).await;
    socket
        .write_all(b"GET /healthz HTTP/1.1\r\nhost: x\r\n\r\nGET /h")
        .await
        .unwrap();
    assert!(until_closed(&mut socket).await.starts_with("HTTP/1.1 200"));
}

#[tokio::test]
async fn large_heads_are_refused() {
    let service = Service::start().await;
    let large = "x".repeat(80 * 1024);
    let answer = service
        .request(Method::GET, "/v2/")
        .header("x-a", &large)
        .send()
        .await;
    assert!(
        answer.is_err() || answer.unwrap().status() == StatusCode::REQUEST_HEADER_FIELDS_TOO_LARGE
    );
    let http2 = reqwest::Client::builder()
        .http2_prior_knowledge()
        .build()
        .unwrap();
    let answer = http2
        .get(format!("{}/v2/", service.url))
        .header("x-a", &large)
        .send()
        .await;
    assert!(
        answer.is_err() || answer.unwrap().status() == StatusCode::REQUEST_HEADER_FIELDS_TOO_LARGE
    );
    let many = "x-a: y\r\n".repeat(200);
    let mut socket = connect(&service).await;
    socket
        .write_all(format!("GET /healthz HTTP/1.1\r\n{many}\r\n").as_bytes())
        .await
        .unwrap();
    assert!(until_closed(&mut socket).await.starts_with("HTTP/1.1 431"));
}

#[tokio::test]
async fn slow_bodies_are_cut() {
    let service = Service::with(tight).await;
    let digest = Digest::of(b"x");
    let head = format!(
        "POST /v2/c/o/blobs/uploads/?digest={digest} HTTP/1.1\r\nhost: x\r\nauthorization: Bearer {TOKEN}\r\n\
         content-length: 1000000\r\n\r\n"
    );
    // Silence.
    let mut socket = connect(&service).await;
    socket.write_all(head.as_bytes()).await.unwrap();
    let answer = until_closed(&mut socket).await;
    assert!(
        answer.starts_with("HTTP/1.1 400") && answer.contains("nothing came for 0.4 s"),
        "{answer}"
    );
    // A byte now and then.
    let (mut answers, mut socket) = connect(&service).await.into_split();
    socket.write_all(head.as_bytes()).await.unwrap();
    let trickle = async {
        while socket.write_all(b"x").await.is_ok() {
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
    };
    let answer = async {
        let mut bytes = vec![0; 4096];
        let count = answers.read(&mut bytes).await.unwrap();
        String::from_utf8_lossy(&bytes[..count]).into_owned()
    };
    let answer = async {
        tokio::select! {
            answer = answer => answer,
            () = trickle => panic!("cut without an answer"),
        }
    };
    let answer = tokio::time::timeout(Duration::from_secs(5), answer)
        .await
        .unwrap();
    assert!(answer.contains("less than 1000 bytes/s"), "{answer}");
    // Slow but steady enough.
    let slow = futures::stream::unfold(0, |sent| async move {
        tokio::time::sleep(Duration::from_millis(100)).await;
        (sent < 8).then(|| (Ok::<_, std::io::Error>(vec![7; 1000]), sent + 1))
    });
    let path = format!("/v2/c/o/blobs/uploads/?digest={}", Digest::of(&[7; 8000]));
    let sent = service
        .request(Method::POST, &path)
        .body(reqwest::Body::wrap_stream(slow));
    assert_eq!(sent.send().await.unwrap().status(), StatusCode::CREATED);
    // A stream of gRPC that says nothing.
    let mut jobs = service.jobs.clone();
    let silent = futures::stream::pending::<v1::SubmitRequest>();
    let refused = tokio::time::timeout(Duration::from_secs(5), jobs.submit_batch(silent))
        .await
        .expect("it is cut");
    assert!(refused.is_err());
}

#[tokio::test]
async fn one_address_does_not_take_all_connections() {
    let service = Service::with(|config| {
        config.limits.connections_per_peer = 3;
    })
    .await;
    let mut open = Vec::new();
    for _ in 0..3 {
        let mut socket = connect(&service).await;
        socket
            .write_all(b"GET /healthz HTTP/1.1\r\nhost: x\r\n\r\n")
            .await
            .unwrap();
        let mut answer = [0; 12];
        socket.read_exact(&mut answer).await.unwrap();
        assert_eq!(&answer, b"HTTP/1.1 200");
        open.push(socket);
    }
    assert_eq!(until_closed(&mut connect(&service).await).await, "");
    drop(open.pop());
    for _ in 0..50 {
        if service
            .http
            .get(format!("{}/healthz", service.url))
            .send()
            .await
            .is_ok()
        {
            return;
        }
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
    panic!("a place that was given back is not to be had");
}

#[tokio::test]
async fn compressed_bodies_are_not_unpacked() {
    let service = Service::start().await;
    for encoding in ["gzip", "deflate", "br", "zstd", "identity, gzip"] {
        let request = service
            .request(
                Method::PUT,
                &format!("/v2/c/o/manifests/{}", Digest::of(b"x")),
            )
            .header("content-encoding", encoding)
            .body(vec![0x1f, 0x8b, 8, 0]);
        let answer = request.send().await.unwrap();
        assert_eq!(
            answer.status(),
            StatusCode::UNSUPPORTED_MEDIA_TYPE,
            "{encoding}"
        );
    }
    let request = service
        .request(Method::POST, "/ign.v1.Jobs/Get")
        .header("content-type", "application/grpc")
        .header("grpc-encoding", "gzip")
        .body(vec![1, 0, 0, 0, 4, 0x1f, 0x8b, 8, 0]);
    let answer = request.send().await.unwrap();
    assert_eq!(answer.headers()["grpc-status"], "12");
}

fn put(service: &Service, body: Vec<u8>) -> reqwest::RequestBuilder {
    let path = format!("/v2/museum/vase/manifests/{}", Digest::of(&body));
    service.request(Method::PUT, &path).body(body)
}

#[tokio::test]
async fn lying_manifests_are_refused() {
    let service = Service::start().await;
    service.upload("museum/vase", b"one").await;
    let entry = FileEntry {
        path: "images/PLACE".parse().unwrap(),
        digest: Digest::of(b"one"),
        size_bytes: 3,
        media_type: "application/octet-stream".to_owned(),
    };
    let good = Manifest::new(
        Kind::Capture,
        vec![entry],
        std::collections::BTreeMap::new(),
    )
    .unwrap();
    let good = String::from_utf8(good.encode().unwrap()).unwrap();
    assert_eq!(
        put(&service, good.clone().into())
            .send()
            .await
            .unwrap()
            .status(),
        StatusCode::CREATED
    );
    let size = "\"size\":3";
    assert!(good.contains("images/PLACE") && good.contains(size));
    let mut lies = Vec::new();
    for path in [
        "../../etc/passwd",
        "/etc/passwd",
        "images/../../x",
        "images//x",
        "C:\\\\x",
        "a\\u0000b",
        "..",
        "",
    ] {
        lies.push(good.replace("images/PLACE", path));
    }
    // Another size than the blob's, absurd ones, and a blob that nobody sent.
    for lie in [
        "\"size\":4",
        "\"size\":2",
        "\"size\":18446744073709551615",
        "\"size\":-3",
    ] {
        lies.push(good.replace(size, lie));
    }
    lies.push(good.replace(Digest::of(b"one").as_str(), Digest::of(b"two").as_str()));
    // Deep and broken JSON.
    lies.push(format!("{}{}", "[".repeat(100_000), "]".repeat(100_000)));
    lies.push(good[..good.len() / 2].to_owned());
    for lie in lies {
        let answer = put(&service, lie.clone().into_bytes())
            .send()
            .await
            .unwrap();
        assert_eq!(
            answer.status(),
            StatusCode::BAD_REQUEST,
            "{}",
            &lie[..lie.len().min(300)]
        );
    }
    // Another digest than the body's.
    let path = format!("/v2/museum/vase/manifests/{}", Digest::of(b"other"));
    let answer = service
        .request(Method::PUT, &path)
        .body(good)
        .send()
        .await
        .unwrap();
    assert_eq!(answer.status(), StatusCode::BAD_REQUEST);
    // Larger than a manifest may be.
    let answer = put(&service, vec![b' '; MAX_BYTES + 1])
        .send()
        .await
        .unwrap();
    assert_eq!(answer.status(), StatusCode::PAYLOAD_TOO_LARGE);
}

#[tokio::test]
async fn lying_results_are_refused() {
    let mut service = Service::start().await;
    service.submit("museum/vase", "1").await;
    let lease = service.lease("w", 0.0).await.unwrap();
    let entry = |path: &str| v1::FileEntry {
        path: path.to_owned(),
        digest: Digest::of(b"one").to_string(),
        size_bytes: 3,
        media_type: "application/octet-stream".to_owned(),
    };
    let many = (0..60_000).map(|i| entry(&format!("f{i}"))).collect();
    let lies: Vec<(Vec<v1::FileEntry>, &str)> = vec![
        (vec![entry("../bundle.json")], "{}"),
        (vec![entry("a"), entry("a")], "{}"),
        (
            vec![v1::FileEntry {
                size_bytes: 4,
                ..entry("a")
            }],
            "{}",
        ),
        (
            vec![v1::FileEntry {
                digest: "sha256:00".to_owned(),
                ..entry("a")
            }],
            "{}",
        ),
        (vec![entry("a")], "[1, 2]"),
        (many, "{}"),
        (vec![], "{}"),
    ];
    for (files, metrics) in lies {
        let what = files.first().map(|it| it.path.clone());
        let request = v1::CompleteRequest {
            job: Some(attempt(&lease, "w")),
            files,
            metrics_json: metrics.to_owned(),
        };
        let refused = service.workers.complete(request).await.unwrap_err();
        let cause = Cause::from_status(&refused);
        assert!(
            matches!(cause, Cause::BadField { .. } | Cause::NotAllowed { .. }),
            "{what:?}: {cause:?}"
        );
    }
    let deep = format!("{}1{}", "{\"a\":".repeat(5000), "}".repeat(5000));
    let wide = format!("{{\"a\":\"{}\"}}", "x".repeat(70_000));
    for recipe in [deep, wide] {
        let capture = lease.spec.as_ref().unwrap().capture_digest.parse().unwrap();
        let mut request = submit_request("museum/vase", "2", &capture);
        request.spec.as_mut().unwrap().recipe_json = recipe;
        let refused = service.jobs.submit(request).await.unwrap_err();
        let cause = Cause::from_status(&refused);
        assert!(
            matches!(&cause, Cause::BadField { field, .. } if field == "recipe_json"),
            "{cause:?}"
        );
    }
    // Nothing of it shows, and the attempt still holds its job.
    service
        .complete(&lease, "w", &[("bundle.json", b"{}")])
        .await
        .unwrap();
}
