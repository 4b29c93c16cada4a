//! Closed by default: every RPC of the schema and every route, with every kind of token that must not open it.

use std::collections::BTreeSet;
use std::time::Duration;

use ign_coordinator::{Config, Rate};
use ign_proto::{Cause, Digest, Kind, Scope, v1};
use prost::Message as _;
use reqwest::{Method, StatusCode};

use crate::fixture::{Clients, Service, TOKEN, attempt, manifest, object_ref, submit_request};

/// What each RPC is asked, in the collection `museum`, and the scope that it takes.
fn calls(job: &str) -> Vec<(&'static str, Vec<u8>, Scope)> {
    let object = || Some(object_ref("museum/vase"));
    let job = || job.to_owned();
    let get_job = || v1::GetJobRequest { job_id: job() };
    let held = || {
        Some(v1::JobAttempt {
            job_id: job(),
            attempt: 1,
            worker_id: "w".to_owned(),
        })
    };
    let get_bundle = || v1::GetBundleRequest {
        object: object(),
        reference: "latest".to_owned(),
    };
    let submit = submit_request("museum/vase", "again", &Digest::of(b"nothing"));
    let museum = || "museum".to_owned();
    vec![
        ("Jobs/Submit", submit.encode_to_vec(), Scope::Submit),
        ("Jobs/Get", get_job().encode_to_vec(), Scope::Read),
        (
            "Jobs/List",
            v1::ListJobsRequest {
                collection: museum(),
                ..v1::ListJobsRequest::default()
            }
            .encode_to_vec(),
            Scope::Read,
        ),
        ("Jobs/Watch", get_job().encode_to_vec(), Scope::Read),
        (
            "Jobs/Logs",
            v1::LogsRequest {
                job_id: job(),
                ..v1::LogsRequest::default()
            }
            .encode_to_vec(),
            Scope::Read,
        ),
        (
            "Jobs/Status",
            v1::StatusRequest {
                collection: museum(),
            }
            .encode_to_vec(),
            Scope::Read,
        ),
        ("Jobs/Cancel", get_job().encode_to_vec(), Scope::Submit),
        ("Jobs/Retry", get_job().encode_to_vec(), Scope::Submit),
        (
            "Workers/Heartbeat",
            v1::HeartbeatRequest {
                job: held(),
                ..v1::HeartbeatRequest::default()
            }
            .encode_to_vec(),
            Scope::Publish,
        ),
        (
            "Workers/Checkpoint",
            v1::CheckpointRequest {
                job: held(),
                digest: Digest::of(b"nothing").to_string(),
                size_bytes: 7,
            }
            .encode_to_vec(),
            Scope::Publish,
        ),
        (
            "Workers/Complete",
            v1::CompleteRequest {
                job: held(),
                ..v1::CompleteRequest::default()
            }
            .encode_to_vec(),
            Scope::Publish,
        ),
        (
            "Workers/Fail",
            v1::FailRequest {
                job: held(),
                ..v1::FailRequest::default()
            }
            .encode_to_vec(),
            Scope::Publish,
        ),
        (
            "Bundles/List",
            v1::ListBundlesRequest {
                collection: museum(),
                ..v1::ListBundlesRequest::default()
            }
            .encode_to_vec(),
            Scope::Read,
        ),
        ("Bundles/Get", get_bundle().encode_to_vec(), Scope::Read),
        (
            "Bundles/SetAlias",
            v1::SetAliasRequest {
                object: object(),
                reference: "latest".to_owned(),
                alias: "approved".to_owned(),
            }
            .encode_to_vec(),
            Scope::Admin,
        ),
        ("Bundles/Retire", get_bundle().encode_to_vec(), Scope::Admin),
        (
            "Bundles/Restore",
            get_bundle().encode_to_vec(),
            Scope::Admin,
        ),
        (
            "Collections/Set",
            v1::Collection {
                name: museum(),
                ..v1::Collection::default()
            }
            .encode_to_vec(),
            Scope::Admin,
        ),
        (
            "Collections/SetWebhook",
            v1::SetWebhookRequest {
                collection: museum(),
                url: "https://archive.example/hook".to_owned(),
                secret: vec![7; 32],
            }
            .encode_to_vec(),
            Scope::Admin,
        ),
        (
            "Collections/ListWebhooks",
            v1::ListWebhooksRequest {
                collection: museum(),
            }
            .encode_to_vec(),
            Scope::Admin,
        ),
        (
            "Collections/ListDeliveries",
            v1::ListDeliveriesRequest {
                collection: museum(),
                limit: 0,
            }
            .encode_to_vec(),
            Scope::Admin,
        ),
        (
            "Collections/Redeliver",
            v1::RedeliverRequest {
                collection: museum(),
                id: "msg_unknown".to_owned(),
            }
            .encode_to_vec(),
            Scope::Admin,
        ),
        (
            "Collections/RemoveWebhook",
            v1::RemoveWebhookRequest {
                collection: museum(),
            }
            .encode_to_vec(),
            Scope::Admin,
        ),
    ]
}

/// Those that name no collection: what they show or give is what differs. See the tests of listings and of leases.
const OF_ALL_COLLECTIONS: [(&str, Scope); 3] = [
    ("Jobs/SubmitBatch", Scope::Submit),
    ("Workers/Lease", Scope::Publish),
    ("Collections/List", Scope::Read),
];

/// Those for the holder of `admin` everywhere.
const OF_OPERATORS: [&str; 10] = [
    "Admin/RebuildRegistry",
    "Admin/CollectGarbage",
    "Admin/AuditRegistry",
    "Admin/ListEvents",
    "Admin/DrainWorkers",
    "Admin/Diagnose",
    "Tokens/Create",
    "Tokens/List",
    "Tokens/Rotate",
    "Tokens/Revoke",
];

/// What each route is asked in the collection `museum`, and the scopes of which it takes one.
fn routes() -> Vec<(Method, String, &'static [Scope])> {
    use Scope::{Publish, Read, Submit};
    let at = |tail: &str| format!("/v2/museum/vase/{tail}");
    let digest = Digest::of(b"nothing");
    let upload = at("blobs/uploads/00000000-0000-4000-8000-000000000000");
    vec![
        (
            Method::HEAD,
            at(&format!("blobs/{digest}")),
            &[Read, Submit, Publish],
        ),
        (
            Method::GET,
            at(&format!("blobs/{digest}")),
            &[Read, Publish],
        ),
        (Method::POST, at("blobs/uploads/"), &[Submit, Publish]),
        (Method::POST, at("blobs/uploads"), &[Submit, Publish]),
        (
            Method::POST,
            at(&format!("blobs/uploads/?digest={digest}")),
            &[Submit, Publish],
        ),
        (Method::GET, upload.clone(), &[Submit, Publish]),
        (Method::PATCH, upload.clone(), &[Submit, Publish]),
        (
            Method::PUT,
            format!("{upload}?digest={digest}"),
            &[Submit, Publish],
        ),
        (Method::DELETE, upload, &[Submit, Publish]),
        (Method::GET, at("manifests/latest"), &[Read, Publish]),
        (
            Method::HEAD,
            at(&format!("manifests/{digest}")),
            &[Read, Submit, Publish],
        ),
        (Method::PUT, at(&format!("manifests/{digest}")), &[Submit]),
        (Method::GET, at("tags/list"), &[Read]),
    ]
}

/// A call over HTTP, of which only the refusal is looked at: the gRPC status in the headers, 0 where there is none.
async fn call(service: &Service, path: &str, message: &[u8], authorization: &str) -> u32 {
    let mut frame = vec![0];
    frame.extend((message.len() as u32).to_be_bytes());
    frame.extend(message);
    let request = service
        .http
        .post(format!("{}{path}", service.url))
        .header("content-type", "application/grpc")
        .header("te", "trailers")
        .header("authorization", authorization)
        .body(frame);
    let answer = request.send().await.unwrap();
    match answer.headers().get("grpc-status") {
        Some(status) => status.to_str().unwrap().parse().unwrap(),
        None => 0,
    }
}

async fn ask(service: &Service, method: &Method, path: &str, authorization: &str) -> StatusCode {
    let request = service
        .http
        .request(method.clone(), format!("{}{path}", service.url))
        .header("authorization", authorization);
    request.send().await.unwrap().status()
}

const NOT_FOUND: u32 = 5;
const PERMISSION_DENIED: u32 = 7;
const UNIMPLEMENTED: u32 = 12;
const UNAUTHENTICATED: u32 = 16;

/// Headers that open nothing: none, no token, wrong ones, and tokens that have ended.
async fn worthless(service: &mut Service) -> Vec<String> {
    let revoked = service.token(&["admin:*"]).await;
    service.revoke(&revoked).await;
    let expired = service.token_for(&["admin:*"], 0.05).await;
    let rotated = service.token(&["admin:*"]).await;
    service.rotate(&rotated, 0.0).await;
    tokio::time::sleep(Duration::from_millis(100)).await;
    let good = service.token(&["admin:*"]).await;
    let forged = format!("{}{}", &good[..40], &revoked[40..]);
    [
        String::new(),
        "Bearer".to_owned(),
        "Bearer wrong-token-0123456789".to_owned(),
        format!("Basic {TOKEN}"),
        format!("Bearer {revoked}"),
        format!("Bearer {expired}"),
        format!("Bearer {rotated}"),
        format!("Bearer {forged}"),
    ]
    .into()
}

#[tokio::test]
async fn nothing_opens_without_a_good_token() {
    let mut service = Service::with(patient).await;
    let job = service.submit("museum/vase", "1").await.id;
    let calls = calls(&job);
    let every = calls.iter().map(|(path, ..)| *path);
    let every: Vec<&str> = every
        .chain(OF_ALL_COLLECTIONS.map(|(path, _)| path))
        .chain(OF_OPERATORS)
        .collect();
    // Whoever adds an RPC says here how it is called.
    let schema = prost_types::FileDescriptorSet::decode(v1::FILE_DESCRIPTOR_SET).unwrap();
    let mut methods: Vec<String> = Vec::new();
    for service in schema.file.iter().flat_map(|file| &file.service) {
        let name = |method: &prost_types::MethodDescriptorProto| {
            format!("{}/{}", service.name(), method.name())
        };
        methods.extend(service.method.iter().map(name));
    }
    assert_eq!(
        every.iter().copied().collect::<BTreeSet<_>>(),
        methods.iter().map(String::as_str).collect()
    );
    for authorization in worthless(&mut service).await {
        for path in &every {
            let status = call(&service, &format!("/ign.v1.{path}"), b"", &authorization).await;
            assert_eq!(status, UNAUTHENTICATED, "{path} with {authorization:?}");
        }
        for path in [
            "/grpc.reflection.v1.ServerReflection/ServerReflectionInfo",
            "/no.such.Service/Method",
            "/ign.v1.Jobs/NoSuchMethod",
        ] {
            let status = call(&service, path, b"", &authorization).await;
            assert_eq!(status, UNAUTHENTICATED, "{path} with {authorization:?}");
        }
        let more = [
            (Method::GET, "/v2/"),
            (Method::GET, "/"),
            (Method::GET, "/no/such/route"),
        ];
        let more = more.map(|(method, path)| (method, path.to_owned()));
        let routes = routes().into_iter().map(|(method, path, _)| (method, path));
        for (method, path) in routes.chain(more) {
            let status = ask(&service, &method, &path, &authorization).await;
            assert_eq!(
                status,
                StatusCode::UNAUTHORIZED,
                "{method} {path} with {authorization:?}"
            );
        }
    }
}

#[tokio::test]
async fn every_rpc_takes_its_scope_in_its_collection() {
    let mut service = Service::with(patient).await;
    let job = service.submit("museum/vase", "1").await.id;
    for (path, message, scope) in calls(&job) {
        let others = |collection: &str| {
            let others = Scope::ALL
                .into_iter()
                .filter(|it| *it != scope && *it != Scope::Admin);
            others
                .map(|it| format!("{it}:{collection}"))
                .collect::<Vec<_>>()
        };
        let path = &format!("/ign.v1.{path}");
        let elsewhere = vec![format!("{scope}:library"), "read:library".to_owned()];
        let mut foreign = others("museum");
        foreign.extend(elsewhere.clone());
        for (grants, may) in [
            (vec![format!("{scope}:museum")], true),
            (vec![format!("{scope}:*")], true),
            (vec!["admin:museum".to_owned()], true),
            (others("*"), false),
            (elsewhere, false),
            (foreign, false),
            (vec!["admin:library".to_owned()], false),
        ] {
            let grants: Vec<&str> = grants.iter().map(String::as_str).collect();
            let token = service.token(&grants).await;
            let status = call(&service, path, &message, &format!("Bearer {token}")).await;
            if may {
                assert!(
                    ![PERMISSION_DENIED, UNAUTHENTICATED, UNIMPLEMENTED].contains(&status),
                    "{path} {grants:?}: {status}"
                );
                // The bundle, the delivery and a webhook that was removed before are not there, but the job is.
                let absent = ["Bundles", "Redeliver", "RemoveWebhook"];
                assert!(
                    status != NOT_FOUND || absent.iter().any(|it| path.contains(it)),
                    "{path} {grants:?}"
                );
            } else {
                // A job of somebody else is no job at all.
                assert!(
                    [PERMISSION_DENIED, NOT_FOUND].contains(&status),
                    "{path} {grants:?}: {status}"
                );
            }
        }
    }
    for (path, scope) in OF_ALL_COLLECTIONS {
        let others = Scope::ALL
            .into_iter()
            .filter(|it| *it != scope && *it != Scope::Admin);
        let others: Vec<String> = others.map(|it| format!("{it}:*")).collect();
        let others: Vec<&str> = others.iter().map(String::as_str).collect();
        let token = service.token(&others).await;
        let status = call(
            &service,
            &format!("/ign.v1.{path}"),
            b"",
            &format!("Bearer {token}"),
        )
        .await;
        assert_eq!(status, PERMISSION_DENIED, "{path}");
    }
    let token = service
        .token(&["admin:museum", "submit:*", "read:*", "publish:*"])
        .await;
    for path in OF_OPERATORS {
        let status = call(
            &service,
            &format!("/ign.v1.{path}"),
            b"",
            &format!("Bearer {token}"),
        )
        .await;
        assert_eq!(status, PERMISSION_DENIED, "{path}");
    }
}

#[tokio::test]
async fn every_route_takes_its_scope_in_its_collection() {
    let mut service = Service::with(patient).await;
    service.submit("museum/vase", "1").await;
    let mut tokens = Vec::new();
    for scope in Scope::ALL {
        for collection in ["museum", "library"] {
            let token = service.token(&[&format!("{scope}:{collection}")]).await;
            tokens.push((scope, collection, format!("Bearer {token}")));
        }
    }
    for (method, path, scopes) in routes() {
        for (scope, collection, authorization) in &tokens {
            let may = *collection == "museum" && (*scope == Scope::Admin || scopes.contains(scope));
            let status = ask(&service, &method, &path, authorization).await;
            assert_eq!(
                status != StatusCode::FORBIDDEN,
                may,
                "{method} {path} with {scope}:{collection}: {status}"
            );
            assert!(
                !status.is_server_error() && status != StatusCode::UNAUTHORIZED,
                "{method} {path}: {status}"
            );
        }
    }
    for (.., authorization) in &tokens {
        assert_eq!(
            ask(&service, &Method::GET, "/v2/", authorization).await,
            StatusCode::OK
        );
    }
    // A path that only looks like the token's own collection.
    let museum = &tokens[2].2;
    for path in [
        "/v2/library/../museum/vase/tags/list",
        "/v2/museum/../library/globe/tags/list",
        "/v2/museum%2F..%2Flibrary/globe/tags/list",
        "/v2/%6Dibrary/globe/tags/list",
        "/v2//library/globe/tags/list",
    ] {
        let raw = raw_get(&service, path, museum).await;
        assert!(raw.starts_with("HTTP/1.1 4"), "{path}: {raw}");
    }
}

/// Sent as it is: a client library would tidy the path up.
async fn raw_get(service: &Service, path: &str, authorization: &str) -> String {
    use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
    let address = service.url.strip_prefix("http://").unwrap();
    let mut socket = tokio::net::TcpStream::connect(address).await.unwrap();
    let head = format!(
        "GET {path} HTTP/1.1\r\nhost: x\r\nauthorization: {authorization}\r\nconnection: close\r\n\r\n"
    );
    socket.write_all(head.as_bytes()).await.unwrap();
    let mut answer = String::new();
    socket.read_to_string(&mut answer).await.unwrap();
    answer
}

#[tokio::test]
async fn listings_show_what_the_token_may_read() {
    let mut service = Service::start().await;
    let museum = service.submit("museum/vase", "1").await.id;
    let library = service.submit("library/globe", "1").await.id;
    let archive = service.submit("archive/map", "1").await.id;
    let leased = service.lease("w", 0.0).await.unwrap();
    let hidden = leased
        .spec
        .as_ref()
        .unwrap()
        .object
        .as_ref()
        .unwrap()
        .collection
        .clone();

    for (grants, jobs) in [
        (&["read:museum"][..], vec![&museum]),
        (
            &["read:museum", "admin:archive", "submit:library"],
            vec![&archive, &museum],
        ),
        (&["read:*"], vec![&archive, &library, &museum]),
        (&["read:nowhere"], vec![]),
    ] {
        let token = service.token(grants).await;
        let mut reader = Clients::new(&service.url, &token);
        // Page by page, newest first.
        let (mut listed, mut page_token) = (Vec::new(), String::new());
        loop {
            let request = v1::ListJobsRequest {
                page_size: 1,
                page_token,
                ..v1::ListJobsRequest::default()
            };
            let page = reader.jobs.list(request).await.unwrap().into_inner();
            listed.extend(page.jobs.into_iter().map(|job| job.id));
            page_token = page.next_page_token;
            if page_token.is_empty() {
                break;
            }
        }
        assert_eq!(listed.iter().collect::<Vec<_>>(), jobs, "{grants:?}");

        let collections = reader
            .collections
            .list(v1::ListCollectionsRequest {})
            .await
            .unwrap();
        assert_eq!(
            collections.into_inner().collections.len(),
            jobs.len(),
            "{grants:?}"
        );
        let status = reader
            .jobs
            .status(v1::StatusRequest::default())
            .await
            .unwrap()
            .into_inner();
        let count: u64 = status.jobs_by_state.values().sum();
        assert_eq!(count as usize, jobs.len(), "{grants:?}");
        let shown = status.running.iter().chain(&status.next_queued);
        assert_eq!(shown.count(), jobs.len(), "{grants:?}");
        let shows_the_leased = grants.contains(&"read:*")
            || grants.iter().any(|grant| {
                grant.ends_with(&format!(":{hidden}")) && !grant.starts_with("submit")
            });
        assert_eq!(
            status.workers[0].job_id == leased.job_id,
            shows_the_leased,
            "{grants:?}"
        );
    }
}

#[tokio::test]
async fn a_worker_reads_what_its_jobs_need_and_no_more() {
    let mut service = Service::start().await;
    let job = service.submit("museum/vase", "1").await;
    service.submit("library/globe", "1").await;
    let capture = job.spec.unwrap().capture_digest;
    let secret = service
        .upload("museum/vase", b"a file of another capture")
        .await;
    let other = service
        .upload_capture("museum/vase", &[("images/2.png", b"two")])
        .await;
    let reader = format!("Bearer {}", service.token(&["read:museum"]).await);
    let worker = service.token(&["publish:museum"]).await;
    let authorization = format!("Bearer {worker}");
    let photo = Digest::of(b"one");
    let blob = |digest: &Digest| format!("/v2/museum/vase/blobs/{digest}");
    let manifest = |digest: &str| format!("/v2/museum/vase/manifests/{digest}");

    // Before its lease nothing is there for it.
    let get = async |path: &str| ask(&service, &Method::GET, path, &authorization).await;
    assert_eq!(get(&blob(&photo)).await, StatusCode::NOT_FOUND);
    assert_eq!(get(&manifest(&capture)).await, StatusCode::NOT_FOUND);

    // It gets the job of its collection, and not the other's.
    let mut agent = Clients::new(&service.url, &worker);
    let lease = |name: &str| v1::LeaseRequest {
        worker_id: name.to_owned(),
        ..v1::LeaseRequest::default()
    };
    let leased = agent
        .workers
        .lease(lease("w"))
        .await
        .unwrap()
        .into_inner()
        .lease
        .unwrap();
    assert_eq!(leased.job_id, job.id);
    assert_eq!(
        agent
            .workers
            .lease(lease("w2"))
            .await
            .unwrap()
            .into_inner()
            .lease,
        None
    );
    assert_eq!(get(&blob(&photo)).await, StatusCode::OK);
    assert_eq!(get(&manifest(&capture)).await, StatusCode::OK);
    assert_eq!(get(&blob(&secret)).await, StatusCode::NOT_FOUND);
    assert_eq!(get(&manifest(other.as_str())).await, StatusCode::NOT_FOUND);
    assert_eq!(
        get("/v2/museum/bowl/manifests/latest").await,
        StatusCode::NOT_FOUND
    );

    // A reader sees what the object's jobs and bundles are made of, and no stray blob.
    let read = async |path: &str| ask(&service, &Method::GET, path, &reader).await;
    assert_eq!(read(&blob(&photo)).await, StatusCode::OK);
    assert_eq!(read(&blob(&secret)).await, StatusCode::NOT_FOUND);
    assert_eq!(
        read(&format!("/v2/museum/bowl/blobs/{photo}")).await,
        StatusCode::NOT_FOUND
    );

    // Checkpoint, result, and then it is over.
    let send = service.http.post(format!(
        "{}/v2/museum/vase/blobs/uploads/?digest={}",
        service.url,
        Digest::of(b"state")
    ));
    let sent = send
        .bearer_auth(&worker)
        .body("state")
        .send()
        .await
        .unwrap();
    assert_eq!(sent.status(), StatusCode::CREATED);
    let checkpoint = v1::CheckpointRequest {
        job: Some(attempt(&leased, "w")),
        digest: Digest::of(b"state").to_string(),
        size_bytes: 5,
    };
    agent.workers.checkpoint(checkpoint).await.unwrap();
    assert_eq!(get(&blob(&Digest::of(b"state"))).await, StatusCode::OK);
    service.workers = agent.workers;
    service
        .complete(&leased, "w", &[("bundle.json", b"{}")])
        .await
        .unwrap();
    assert_eq!(
        ask(&service, &Method::GET, &blob(&photo), &authorization).await,
        StatusCode::NOT_FOUND
    );
    assert_eq!(
        ask(
            &service,
            &Method::GET,
            "/v2/museum/vase/manifests/v1",
            &reader
        )
        .await,
        StatusCode::OK
    );
    assert_eq!(
        ask(&service, &Method::GET, &blob(&Digest::of(b"{}")), &reader).await,
        StatusCode::OK
    );
}

#[tokio::test]
async fn tokens_are_made_used_rotated_and_revoked() {
    let mut service = Service::start().await;
    let first = service.token(&["read:museum"]).await;
    let authorization = format!("Bearer {first}");
    let is_open = async |service: &Service, authorization: &str| {
        ask(service, &Method::GET, "/v2/", authorization).await == StatusCode::OK
    };
    assert!(is_open(&service, &authorization).await);

    let tokens = service
        .tokens
        .list(v1::ListTokensRequest {})
        .await
        .unwrap()
        .into_inner()
        .tokens;
    assert_eq!(
        (tokens.len(), &tokens[0].grants[..]),
        (1, &["read:museum".to_owned()][..])
    );
    let today = service
        .jobs
        .status(v1::StatusRequest::default())
        .await
        .unwrap()
        .into_inner()
        .at
        .unwrap();
    let days = |day: &str| {
        let day: chrono::NaiveDate = day.parse().unwrap();
        day.signed_duration_since(chrono::NaiveDate::default())
            .num_days()
    };
    assert!(today.seconds / 86_400 - days(&tokens[0].last_used_on) <= 1);
    assert!(!format!("{tokens:?}").contains(&first));

    // Both secrets during the grace; after another rotation without one, the last alone.
    let second = service.rotate(&first, 60.0).await;
    assert!(is_open(&service, &authorization).await);
    assert!(is_open(&service, &format!("Bearer {second}")).await);
    let third = service.rotate(&first, 0.0).await;
    assert!(!is_open(&service, &authorization).await);
    assert!(!is_open(&service, &format!("Bearer {second}")).await);
    assert!(is_open(&service, &format!("Bearer {third}")).await);

    service.restart().await;
    assert!(is_open(&service, &format!("Bearer {third}")).await);
    service.revoke(&third).await;
    assert!(!is_open(&service, &format!("Bearer {third}")).await);

    for grants in [&["read"][..], &["write:museum"], &["read:MUSEUM"], &[]] {
        let request = v1::CreateTokenRequest {
            name: "bad".to_owned(),
            grants: grants.iter().map(ToString::to_string).collect(),
            valid_secs: 0.0,
        };
        let refused = service.tokens.create(request).await.unwrap_err();
        assert_eq!(refused.code(), tonic::Code::InvalidArgument, "{grants:?}");
    }
    // Neither database nor log of this process ever held a secret.
    for file in std::fs::read_dir(&service.folder).unwrap() {
        let file = file.unwrap().path();
        if file.is_file() && !file.ends_with("token") {
            let bytes = std::fs::read(&file).unwrap();
            for secret in [&first, &second, &third] {
                assert!(
                    !bytes.windows(40).any(|it| it == &secret.as_bytes()[17..57]),
                    "{}",
                    file.display()
                );
            }
        }
    }
}

#[tokio::test]
async fn guessing_is_slowed_and_a_flood_of_one_token_too() {
    let mut service = Service::with(|config| {
        config.limits.failures = Rate {
            per_sec: 0.5,
            burst: 3,
        };
        config.limits.requests = Rate {
            per_sec: 0.5,
            burst: 5,
        };
    })
    .await;
    let known = format!("Bearer {}", service.token(&["read:*"]).await);
    assert_eq!(
        ask(&service, &Method::GET, "/v2/", &known).await,
        StatusCode::OK
    );
    for _ in 0..3 {
        assert_eq!(
            ask(&service, &Method::GET, "/v2/", "Bearer guess-0123456789").await,
            StatusCode::UNAUTHORIZED
        );
    }
    let url = format!("{}/v2/", service.url);
    let refused = service
        .http
        .get(&url)
        .bearer_auth("guess-0123456789")
        .send()
        .await
        .unwrap();
    assert_eq!(refused.status(), StatusCode::TOO_MANY_REQUESTS);
    let wait: u64 = refused.headers()["retry-after"]
        .to_str()
        .unwrap()
        .parse()
        .unwrap();
    assert!((1..=2).contains(&wait), "{wait}");
    let mut guesser = Clients::new(&service.url, "guess-0123456789");
    let refused = guesser
        .jobs
        .status(v1::StatusRequest::default())
        .await
        .unwrap_err();
    assert_eq!(refused.code(), tonic::Code::ResourceExhausted);
    assert!(matches!(
        Cause::from_status(&refused),
        Cause::TooMany { .. }
    ));
    // Who is known goes on, as far as its own rate lets it; so does the root token.
    for _ in 0..4 {
        assert_eq!(
            ask(&service, &Method::GET, "/v2/", &known).await,
            StatusCode::OK
        );
    }
    assert_eq!(
        ask(&service, &Method::GET, "/v2/", &known).await,
        StatusCode::TOO_MANY_REQUESTS
    );
    for _ in 0..20 {
        let root = service.request(Method::GET, "/v2/").send().await.unwrap();
        assert_eq!(root.status(), StatusCode::OK);
    }
}

/// Wrong tokens without end: these tests ask all from one address.
fn patient(config: &mut Config) {
    config.limits.failures = Rate {
        per_sec: 1e6,
        burst: 1_000_000,
    };
}

#[tokio::test]
async fn health_checks_are_open_and_tell_no_more() {
    let service = Service::start().await;
    for path in ["/healthz", "/readyz"] {
        let answer = service
            .http
            .get(format!("{}{path}", service.url))
            .send()
            .await
            .unwrap();
        assert_eq!(answer.status(), StatusCode::OK);
        assert!(answer.text().await.unwrap().len() < 10);
    }
    // Loopback may read metrics; they hold counts alone.
    let metrics = service
        .http
        .get(format!("{}/metrics", service.url))
        .send()
        .await
        .unwrap()
        .text()
        .await
        .unwrap();
    assert!(
        metrics.contains("ign_jobs{state=\"queued\"} 0\n"),
        "{metrics}"
    );
    assert!(!metrics.contains(TOKEN));
    let channel = tonic::transport::Channel::from_shared(service.url.clone())
        .unwrap()
        .connect()
        .await
        .unwrap();
    let mut health = tonic_health::pb::health_client::HealthClient::new(channel);
    let request = tonic_health::pb::HealthCheckRequest {
        service: "ign.v1.Jobs".to_owned(),
    };
    let answer = health.check(request).await.unwrap().into_inner();
    assert_eq!(answer.status(), tonic_health::ServingStatus::Serving.into());
}

#[tokio::test]
async fn viewers_of_other_origins_may_ask() {
    let service = Service::start().await;
    let answer = service
        .http
        .request(
            Method::OPTIONS,
            format!("{}/v2/c/o/manifests/latest", service.url),
        )
        .header("origin", "https://viewer.example")
        .header("access-control-request-method", "GET")
        .header("access-control-request-headers", "authorization,range")
        .send()
        .await
        .unwrap();
    assert_eq!(answer.status(), StatusCode::OK);
    assert_eq!(answer.headers()["access-control-allow-origin"], "*");
    let allowed = answer.headers()["access-control-allow-headers"]
        .to_str()
        .unwrap();
    assert!(allowed.contains("authorization") && allowed.contains("range"));
}

#[tokio::test]
async fn a_lease_belongs_to_the_token_that_took_it() {
    let mut service = Service::start().await;
    service.submit("museum/vase", "1").await;
    let holder = service.token(&["publish:museum"]).await;
    let (same, other) = (
        service.token(&["publish:museum"]).await,
        service.token(&["publish:*"]).await,
    );
    service.workers = Clients::new(&service.url, &holder).workers;
    let lease = service.lease("w", 5.0).await.unwrap();
    let state = service.upload("museum/vase", b"state").await;
    service.upload("museum/vase", b"{}").await;

    // Everything that another one says is refused: one of the same rights, one of more, the operator's.
    let held = || Some(attempt(&lease, "w"));
    let report = async |url: String, token: &str| {
        let mut workers = Clients::new(&url, token).workers;
        let heartbeat = v1::HeartbeatRequest {
            job: held(),
            ..v1::HeartbeatRequest::default()
        };
        let checkpoint = v1::CheckpointRequest {
            job: held(),
            digest: state.to_string(),
            size_bytes: 5,
        };
        let complete = v1::CompleteRequest {
            job: held(),
            files: manifest(Kind::Bundle, &[("bundle.json", b"{}")])
                .files()
                .iter()
                .map(Into::into)
                .collect(),
            metrics_json: "{}".to_owned(),
        };
        let fail = v1::FailRequest {
            job: held(),
            failure: Some(v1::Failure {
                kind: v1::FailureKind::InvalidInput.into(),
                ..v1::Failure::default()
            }),
            ..v1::FailRequest::default()
        };
        let refused = |status: tonic::Status| Cause::from_status(&status);
        [
            workers.heartbeat(heartbeat).await.map_err(refused).err(),
            workers.checkpoint(checkpoint).await.map_err(refused).err(),
            workers.complete(complete).await.map_err(refused).err(),
            workers.fail(fail).await.map_err(refused).err(),
        ]
    };
    for token in [&same, &other, TOKEN] {
        for refused in report(service.url.clone(), token).await {
            assert!(
                matches!(refused, Some(Cause::Forbidden { .. })),
                "{refused:?}"
            );
        }
    }
    let untouched = service.get(&lease.job_id).await;
    assert_eq!(untouched.state(), v1::JobState::Leased);
    assert_eq!(untouched.checkpoint_digest, "");

    // A restart forgets nothing of this, and a rotated token is the same token.
    service.restart().await;
    for refused in report(service.url.clone(), &same).await {
        assert!(
            matches!(refused, Some(Cause::Forbidden { .. })),
            "{refused:?}"
        );
    }
    let rotated = service.rotate(&holder, 0.0).await;
    service.workers = Clients::new(&service.url, &rotated).workers;
    let heartbeat = v1::HeartbeatRequest {
        job: held(),
        ..v1::HeartbeatRequest::default()
    };
    service.workers.heartbeat(heartbeat).await.unwrap();
    let done = service
        .complete(&lease, "w", &[("bundle.json", b"{}")])
        .await;
    assert_eq!(done.unwrap().version, 1);
}
