//! An independent OCI client pulls a bundle.

use oci_client::client::{ClientConfig, ClientProtocol};
use oci_client::secrets::RegistryAuth;
use oci_client::{Client, Reference};

use crate::fixture::{Service, TOKEN};

#[tokio::test]
async fn an_ordinary_oci_client_pulls_a_bundle() {
    let mut service = Service::start().await;
    service.submit("museum/vase", "request-1").await;
    let lease = service.lease("worker-1", 5.0).await.unwrap();
    let files: &[(&str, &[u8])] = &[("bundle.json", b"{}"), ("references/0001.png", b"png")];
    let bundle = service.complete(&lease, "worker-1", files).await.unwrap();

    let client = Client::new(ClientConfig {
        protocol: ClientProtocol::Http,
        ..ClientConfig::default()
    });
    let auth = RegistryAuth::Bearer(TOKEN.to_owned());
    let host = service.url.trim_start_matches("http://");
    let image: Reference = format!("{host}/museum/vase:latest").parse().unwrap();
    client
        .store_auth_if_needed(image.resolve_registry(), &auth)
        .await;
    let tags = client.list_tags(&image, &auth, None, None).await.unwrap();
    assert_eq!(tags.tags, ["latest", "v1"]);
    assert_eq!(
        client.fetch_manifest_digest(&image, &auth).await.unwrap(),
        bundle.manifest_digest
    );
    let (manifest, digest) = client.pull_image_manifest(&image, &auth).await.unwrap();
    assert_eq!(digest, bundle.manifest_digest);
    assert_eq!(
        manifest.artifact_type.as_deref(),
        Some("application/vnd.ign.bundle.v1")
    );
    let mut pulled = Vec::new();
    for layer in &manifest.layers {
        let mut bytes = Vec::new();
        client.pull_blob(&image, layer, &mut bytes).await.unwrap();
        let title = &layer.annotations.as_ref().unwrap()["org.opencontainers.image.title"];
        pulled.push((title.clone(), bytes));
    }
    let expected: Vec<(String, Vec<u8>)> = files
        .iter()
        .map(|(path, bytes)| ((*path).to_owned(), bytes.to_vec()))
        .collect();
    assert_eq!(pulled, expected);
    let mut config = Vec::new();
    client
        .pull_blob(&image, &manifest.config, &mut config)
        .await
        .unwrap();
    assert_eq!(config, b"{}");
}
