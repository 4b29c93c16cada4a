//! The services that other tests build on do what those tests assume.

use std::io::{BufRead, BufReader};
use std::process::{Command, Stdio};

use ign_testkit::{Postgres, S3};
use object_store::aws::{AmazonS3, AmazonS3Builder, S3ConditionalPut};
use object_store::path::Path;
use object_store::{ObjectStore, ObjectStoreExt, PutMode, PutOptions};

fn client(endpoint: &str, bucket: &str, s3: &ign_testkit::Credentials) -> AmazonS3 {
    AmazonS3Builder::new()
        .with_endpoint(endpoint)
        .with_bucket_name(bucket)
        .with_region("us-east-1")
        .with_access_key_id(&s3.access_key)
        .with_secret_access_key(&s3.secret_key)
        .with_allow_http(true)
        .with_conditional_put(S3ConditionalPut::ETagMatch)
        .build()
        .expect("every setting is given")
}

#[test]
fn postgres_keeps_data_over_a_restart_and_leaves_nothing() {
    let postgres = Postgres::start().unwrap();
    let url = postgres.create_database().unwrap();
    assert_ne!(url, postgres.create_database().unwrap());
    let name = url.rsplit('/').next().unwrap();
    postgres
        .execute(name, "create table t(x int); insert into t values (7)")
        .unwrap();
    postgres.restart().unwrap();
    assert_eq!(postgres.execute(name, "select x from t").unwrap(), "7");
    let folder = postgres.execute("postgres", "show data_directory").unwrap();
    assert!(std::path::Path::new(&folder).parent().unwrap().exists());
    drop(postgres);
    assert!(!std::path::Path::new(&folder).parent().unwrap().exists());
}

#[tokio::test]
async fn s3_honours_conditional_create_and_refuses_a_wrong_key() {
    let s3 = S3::start().unwrap();
    let store = client(&s3.endpoint(), S3::BUCKET, s3.credentials());
    let path = Path::from("a/b");
    let create = || PutOptions {
        mode: PutMode::Create,
        ..PutOptions::default()
    };
    store.put_opts(&path, "one".into(), create()).await.unwrap();
    let again = store.put_opts(&path, "two".into(), create()).await;
    assert!(
        matches!(again, Err(object_store::Error::AlreadyExists { .. })),
        "{again:?}"
    );
    assert_eq!(
        store.get(&path).await.unwrap().bytes().await.unwrap(),
        "one"
    );
    assert_eq!(store.get_range(&path, 1..3).await.unwrap(), "ne");

    let thief = ign_testkit::Credentials {
        secret_key: "guess".to_owned(),
        ..s3.credentials().clone()
    };
    assert!(
        client(&s3.endpoint(), S3::BUCKET, &thief)
            .get(&path)
            .await
            .is_err()
    );
    let root = s3.root().to_owned();
    drop(s3);
    assert!(!root.exists());
}

#[tokio::test]
async fn s3_endpoint_runs_as_a_process() {
    let root = tempfile::tempdir().unwrap();
    let mut child = Command::new(env!("CARGO_BIN_EXE_s3-endpoint"))
        .args(["--bucket", "spare", "--exit-when-stdin-closes", "--root"])
        .arg(root.path())
        .env("AWS_ACCESS_KEY_ID", "id")
        .env("AWS_SECRET_ACCESS_KEY", "secret")
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut endpoint = String::new();
    BufReader::new(child.stdout.take().unwrap())
        .read_line(&mut endpoint)
        .unwrap();
    let keys = ign_testkit::Credentials {
        access_key: "id".to_owned(),
        secret_key: "secret".to_owned(),
    };
    let store = client(endpoint.trim(), "spare", &keys);
    store.put(&Path::from("x"), "y".into()).await.unwrap();
    assert!(root.path().join("spare/x").exists());
    drop(child.stdin.take());
    assert!(child.wait().unwrap().success());
}
