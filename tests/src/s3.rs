//! An S3 endpoint as a process.

use std::collections::BTreeMap;
use std::path::Path;
use std::time::Duration;

use anyhow::Result;

use crate::process::{Process, path, program, wait_until};

/// The bucket that it has.
const BUCKET: &str = "bundles";
const START_LIMIT: Duration = Duration::from_mins(1);

/// A bucket behind signed requests, on loopback.
#[derive(Debug)]
pub struct S3 {
    _process: Process,
    env: BTreeMap<String, String>,
}

impl S3 {
    /// Starts it on `dir`, where its log lies beside the data, for whoever has the key.
    pub fn start(dir: &Path, access_key: &str, secret_key: &str) -> Result<Self> {
        let process = Process::start(
            "S3 endpoint",
            &program("s3-endpoint")?,
            [
                "--root",
                path(&dir.join("s3"))?,
                "--bucket",
                BUCKET,
                "--access-key",
                access_key,
                "--secret-key",
                secret_key,
                "--exit-when-stdin-closes",
            ],
            [],
            &dir.join("s3.log"),
        )?;
        let endpoint = wait_until("the S3 endpoint's address", START_LIMIT, || {
            Ok(process
                .output()
                .lines()
                .find(|line| line.starts_with("http://"))
                .map(str::to_owned))
        })?;
        let env = BTreeMap::from(
            [
                ("AWS_ENDPOINT", endpoint.as_str()),
                ("AWS_ACCESS_KEY_ID", access_key),
                ("AWS_SECRET_ACCESS_KEY", secret_key),
                ("AWS_REGION", "us-east-1"),
                ("AWS_ALLOW_HTTP", "true"),
                ("AWS_VIRTUAL_HOSTED_STYLE_REQUEST", "false"),
            ]
            .map(|(name, value)| (name.to_owned(), value.to_owned())),
        );
        Ok(Self {
            _process: process,
            env,
        })
    }

    /// What a coordinator's environment says about it.
    pub fn env(&self) -> &BTreeMap<String, String> {
        &self.env
    }

    /// The store as `--store` names it.
    pub fn url(&self) -> String {
        format!("s3://{BUCKET}/e2e")
    }
}
