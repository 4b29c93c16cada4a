//! Bytes through the data plane, beside curl to the S3 server itself: the same file, the same disk, in turn.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

use anyhow::{Result, ensure};
use ign_e2e::{Process, program, run};
use ign_proto::Digest;
use tempfile::TempDir;

use crate::Load;
use crate::figures::Figures;
use crate::service::{Service, TOKEN, await_line, text};

const ACCESS_KEY: &str = "ign-bench-access";
const SECRET_KEY: &str = "ign-bench-secret-0123456789";
const REGION: &str = "us-east-1";
const LIMIT: Duration = Duration::from_mins(5);

/// An S3 endpoint on a folder.
struct S3 {
    _process: Process,
    url: String,
    dir: TempDir,
}

impl S3 {
    fn start() -> Result<Self> {
        let dir = tempfile::Builder::new().prefix("ign-bench-s3-").tempdir()?;
        let process = Process::start(
            "S3 endpoint",
            &program("s3-endpoint")?,
            [
                "--root",
                text(&dir.path().join("s3"))?,
                "--bucket",
                "bundles",
                "--access-key",
                ACCESS_KEY,
                "--secret-key",
                SECRET_KEY,
                "--exit-when-stdin-closes",
            ],
            [],
            &dir.path().join("s3.log"),
        )?;
        let url = await_line(&process, "http://")?;
        Ok(Self {
            _process: process,
            url,
            dir,
        })
    }

    fn env(&self) -> Vec<(String, String)> {
        [
            ("AWS_ENDPOINT", self.url.as_str()),
            ("AWS_ACCESS_KEY_ID", ACCESS_KEY),
            ("AWS_SECRET_ACCESS_KEY", SECRET_KEY),
            ("AWS_REGION", REGION),
            ("AWS_ALLOW_HTTP", "true"),
        ]
        .map(|(name, value)| (name.to_owned(), value.to_owned()))
        .into()
    }
}

/// Seconds that curl takes with these arguments.
fn curl(args: &[&str]) -> Result<f64> {
    let begun = Instant::now();
    let mut command = Command::new("curl");
    command.args([
        "--silent",
        "--show-error",
        "--fail",
        "--location",
        "-o",
        "/dev/null",
    ]);
    let output = run(command.args(args), LIMIT)?;
    ensure!(
        output.status.success(),
        "curl failed: {}",
        String::from_utf8_lossy(&output.stderr)
    );
    Ok(begun.elapsed().as_secs_f64())
}

/// Seconds that `ignctl submit` of a capture with the file takes: hashing, sending, queueing.
fn submit(service: &Service, capture: &Path, round: usize) -> Result<f64> {
    let token = service.folder().join("token");
    let object = format!("bench/sent-{round}");
    let begun = Instant::now();
    let mut command = Command::new(program("ignctl")?);
    command
        .env("XDG_CACHE_HOME", service.folder().join("cache"))
        .args(["--server", service.url(), "--token-file", text(&token)?])
        .args(["submit", text(capture)?, "--object", &object]);
    let output = run(&mut command, LIMIT)?;
    ensure!(
        output.status.success(),
        "ignctl failed: {}",
        String::from_utf8_lossy(&output.stderr)
    );
    Ok(begun.elapsed().as_secs_f64())
}

/// A file that no store has yet; its digest.
fn write(file: &PathBuf, mib: usize, round: usize) -> Result<Digest> {
    let mut bytes: Vec<u8> = (0..mib << 20)
        .map(|at| (at * 31 + at / 7919) as u8)
        .collect();
    bytes[..8].copy_from_slice(&(round as u64).to_le_bytes());
    fs::write(file, &bytes)?;
    Ok(Digest::of(&bytes))
}

pub(crate) async fn measure(figures: &mut Figures, load: Load) -> Result<()> {
    let s3 = S3::start()?;
    let database = |dir: &TempDir| format!("sqlite://{}/ign.db", dir.path().display());
    let dir = tempfile::tempdir()?;
    let url = database(&dir);
    let on_s3 = Service::launch(dir, &url, "s3://bundles/bench", s3.env()).await?;
    let dir = tempfile::tempdir()?;
    let on_disk = Service::start(&database(&dir)).await?;
    let capture = s3.dir.path().join("capture");
    fs::create_dir_all(capture.join("images"))?;
    let file = capture.join("mesh.ply");
    let authorization = format!("Authorization: Bearer {TOKEN}");
    let (signed, keys) = (
        format!("aws:amz:{REGION}:s3"),
        format!("{ACCESS_KEY}:{SECRET_KEY}"),
    );
    let s3_options = [
        "--aws-sigv4",
        &signed,
        "--user",
        &keys,
        "-H",
        "x-amz-content-sha256: UNSIGNED-PAYLOAD",
    ];
    let direct = format!("{}/bundles/direct", s3.url);
    let mib = load.file_mib as f64 * 1.048_576;
    let (mut sent_s3, mut got_s3) = (Vec::new(), Vec::new());
    let (mut sent_disk, mut got_disk) = (Vec::new(), Vec::new());
    let (mut sent_direct, mut got_direct, mut submitted) = (Vec::new(), Vec::new(), Vec::new());
    for round in 0..load.rounds {
        let digest = write(&file, load.file_mib, round)?;
        let path = text(&file)?;
        sent_direct.push(mib / curl(&[&s3_options[..], &["-T", path, &direct]].concat())?);
        got_direct.push(mib / curl(&[&s3_options[..], &[&direct]].concat())?);
        for (service, sent, got) in [
            (&on_s3, &mut sent_s3, &mut got_s3),
            (&on_disk, &mut sent_disk, &mut got_disk),
        ] {
            let blobs = format!("{}/v2/bench/curl/blobs", service.url());
            let post = format!("{blobs}/uploads?digest={digest}");
            let get = format!("{blobs}/{digest}");
            sent.push(mib / curl(&["-H", &authorization, "-X", "POST", "-T", path, &post])?);
            got.push(mib / curl(&["-H", &authorization, &get])?);
        }
        write(&file, load.file_mib, load.rounds + round)?;
        submitted.push(mib / submit(&on_s3, &capture, round)?);
    }
    let peer = "curl to the S3 server";
    let size = load.file_mib;
    for (name, ours, theirs) in [
        (
            format!("upload of {size} MiB by curl, store on S3"),
            &sent_s3,
            &sent_direct,
        ),
        (
            format!("upload of {size} MiB by curl, store on disk"),
            &sent_disk,
            &sent_direct,
        ),
        (
            format!("ignctl submit of {size} MiB, store on S3"),
            &submitted,
            &sent_direct,
        ),
        (
            format!("fetch of {size} MiB by curl, store on S3"),
            &got_s3,
            &got_direct,
        ),
        (
            format!("fetch of {size} MiB by curl, store on disk"),
            &got_disk,
            &got_direct,
        ),
    ] {
        figures.beside(&name, "MB/s", ours, (peer, theirs), None);
    }
    Ok(())
}
