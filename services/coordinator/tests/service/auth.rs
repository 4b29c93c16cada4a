//! Closed by default: every RPC of the schema and every route, without a token and with a wrong one.

use ign_proto::v1;
use prost::Message as _;
use reqwest::{Method, StatusCode};

use crate::fixture::{Service, TOKEN};

/// Every `/service/method` of the compiled schema, and reflection.
fn methods() -> Vec<String> {
    let schema = prost_types::FileDescriptorSet::decode(v1::FILE_DESCRIPTOR_SET).unwrap();
    let mut methods: Vec<String> = schema
        .file
        .iter()
        .filter(|file| file.package() == "ign.v1")
        .flat_map(|file| &file.service)
        .flat_map(|service| {
            service
                .method
                .iter()
                .map(|method| format!("/ign.v1.{}/{}", service.name(), method.name()))
        })
        .collect();
    assert!(methods.len() >= 20, "{methods:?}");
    methods.push("/grpc.reflection.v1.ServerReflection/ServerReflectionInfo".to_owned());
    methods.push("/no.such.Service/Method".to_owned());
    methods
}

fn routes() -> Vec<(Method, String)> {
    let digest = format!("sha256:{}", "0".repeat(64));
    let id = "00000000-0000-4000-8000-000000000000";
    [
        (Method::GET, "/v2/".to_owned()),
        (Method::HEAD, format!("/v2/c/o/blobs/{digest}")),
        (Method::GET, format!("/v2/c/o/blobs/{digest}")),
        (Method::POST, "/v2/c/o/blobs/uploads/".to_owned()),
        (Method::POST, "/v2/c/o/blobs/uploads".to_owned()),
        (
            Method::POST,
            format!("/v2/c/o/blobs/uploads/?digest={digest}"),
        ),
        (Method::GET, format!("/v2/c/o/blobs/uploads/{id}")),
        (Method::PATCH, format!("/v2/c/o/blobs/uploads/{id}")),
        (
            Method::PUT,
            format!("/v2/c/o/blobs/uploads/{id}?digest={digest}"),
        ),
        (Method::DELETE, format!("/v2/c/o/blobs/uploads/{id}")),
        (Method::GET, "/v2/c/o/manifests/latest".to_owned()),
        (Method::HEAD, format!("/v2/c/o/manifests/{digest}")),
        (Method::PUT, format!("/v2/c/o/manifests/{digest}")),
        (Method::GET, "/v2/c/o/tags/list".to_owned()),
        (Method::GET, "/".to_owned()),
        (Method::GET, "/no/such/route".to_owned()),
        (Method::DELETE, "/healthz/../v2/".to_owned()),
    ]
    .to_vec()
}

#[tokio::test]
async fn every_rpc_and_route_is_closed_without_the_token() {
    let service = Service::start().await;
    let wrong = [
        "",
        "Bearer",
        "Bearer wrong-token-0123456789",
        "Basic test-token-0123456789",
    ];
    for authorization in wrong {
        for path in methods() {
            let answer = service
                .http
                .post(format!("{}{path}", service.url))
                .header("content-type", "application/grpc")
                .header("authorization", authorization)
                .body(vec![0; 5])
                .send()
                .await
                .unwrap();
            assert_eq!(
                answer.headers()["grpc-status"],
                "16",
                "{path} with {authorization:?}"
            );
        }
        for (method, path) in routes() {
            let answer = service
                .http
                .request(method.clone(), format!("{}{path}", service.url))
                .header("authorization", authorization)
                .send()
                .await
                .unwrap();
            assert_eq!(
                answer.status(),
                StatusCode::UNAUTHORIZED,
                "{method} {path} with {authorization:?}"
            );
            assert!(answer.headers().contains_key("www-authenticate"));
        }
    }
    for (method, path) in routes() {
        let answer = service.request(method.clone(), &path).send().await.unwrap();
        assert_ne!(answer.status(), StatusCode::UNAUTHORIZED, "{method} {path}");
        assert!(
            !answer.status().is_server_error(),
            "{method} {path}: {}",
            answer.status()
        );
    }
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
