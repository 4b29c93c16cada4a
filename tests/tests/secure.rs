//! The service over TLS, with a token for each hand and a certificate for the worker; and where secrets do not go.

use std::collections::BTreeSet;
use std::fs;
use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context as _, Result, ensure};
use ign_e2e::{
    Client, Coordinator, Demo, Process, S3, Setup, demo_capture, descendants, path, program,
    wait_until,
};
use rcgen::{BasicConstraints, CertificateParams, IsCa, Issuer, KeyPair};

const START_LIMIT: Duration = Duration::from_mins(1);
const BAKE_LIMIT: Duration = Duration::from_mins(3);
const ROOT: &str = "canary-root-token-8f1b2c3d4e5f60718293a4b5c6d7e8f9";
const S3_ACCESS: &str = "canary-s3-access";
const S3_SECRET: &str = "canary-s3-secret-0a1b2c3d4e5f6071";

/// An authority in `dir/NAME.pem`, and what it signs.
struct Authority {
    issuer: Issuer<'static, KeyPair>,
    file: PathBuf,
}

impl Authority {
    fn new(dir: &Path, name: &str) -> Result<Self> {
        let mut params = CertificateParams::default();
        params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        let key = KeyPair::generate()?;
        let file = dir.join(format!("{name}.pem"));
        fs::write(&file, params.self_signed(&key)?.pem())?;
        Ok(Self {
            issuer: Issuer::new(params, key),
            file,
        })
    }

    /// Certificate and key of `name`, and the key's text.
    fn sign(&self, dir: &Path, name: &str) -> Result<(PathBuf, PathBuf, String)> {
        let key = KeyPair::generate()?;
        let params = CertificateParams::new([name.to_owned(), "127.0.0.1".to_owned()])?;
        let (cert, secret) = (
            dir.join(format!("{name}.cert")),
            dir.join(format!("{name}.key")),
        );
        fs::write(&cert, params.signed_by(&key, &self.issuer)?.pem())?;
        fs::write(&secret, key.serialize_pem())?;
        Ok((cert, secret, key.serialize_pem()))
    }
}

/// Files below `dir` that hold one of the secrets, with the secret's name.
fn leaks(
    dir: &Path,
    secrets: &[(&str, String)],
    found: &mut Vec<String>,
    read: &mut u64,
) -> Result<()> {
    for entry in fs::read_dir(dir)? {
        let path = entry?.path();
        if path.is_symlink() || path.is_file() {
            let Ok(bytes) = fs::read(&path) else { continue };
            *read += bytes.len() as u64;
            for (name, secret) in secrets {
                if bytes
                    .windows(secret.len())
                    .any(|it| it == secret.as_bytes())
                {
                    found.push(format!("{name} in {}", path.display()));
                }
            }
        } else if path.is_dir() {
            leaks(&path, secrets, found, read)?;
        }
    }
    Ok(())
}

#[test]
fn a_bake_over_tls_leaves_no_secret_anywhere() -> Result<()> {
    let dir = tempfile::Builder::new().prefix("ign-e2e-").tempdir()?;
    let (kept, seen) = (dir.path().join("kept"), dir.path().join("seen"));
    fs::create_dir_all(&kept)?;
    fs::create_dir_all(&seen)?;
    let servers = Authority::new(&kept, "servers")?;
    let workers = Authority::new(&kept, "workers")?;
    let (cert, key, server_key) = servers.sign(&kept, "localhost")?;
    let (worker_cert, worker_key, worker_secret) = workers.sign(&kept, "worker-1")?;
    fs::write(kept.join("root"), ROOT)?;
    fs::set_permissions(kept.join("root"), fs::Permissions::from_mode(0o600))?;

    let s3 = S3::start(&seen, S3_ACCESS, S3_SECRET)?;
    let mut env = s3.env().clone();
    env.insert("IGN_LOG".to_owned(), "debug".to_owned());
    let args = [
        "--tls-cert",
        path(&cert)?,
        "--tls-key",
        path(&key)?,
        "--client-ca",
        path(&workers.file)?,
    ];
    let mut coordinator = Coordinator::start(Setup {
        name: "coordinator".to_owned(),
        dir: seen.clone(),
        database: format!("sqlite://{}", path(&seen.join("ign.db"))?),
        store: s3.url(),
        token_file: kept.join("root"),
        args: args.map(str::to_owned).into(),
        env,
    })?;
    let url = format!("https://{}", coordinator.address());
    let client = |token: &str| -> Result<Client> {
        Ok(Client::of_server(&url, path(&kept.join(token))?)
            .with(&["--ca-file", path(&servers.file)?]))
    };
    let root = client("root")?;
    wait_until("the coordinator", START_LIMIT, || {
        ensure!(
            coordinator.is_running(),
            "the coordinator ended:\n{}",
            coordinator.output()
        );
        Ok(root.run(&["status"])?.status.success().then_some(()))
    })?;
    // Whoever does not know the authority is not talked to.
    let stranger = Client::of_server(&url, path(&kept.join("root"))?).run(&["status"])?;
    ensure!(stranger.status.code() == Some(3), "{stranger:?}");

    let token_file = kept.join("registrar");
    root.text(&[
        "token",
        "create",
        "registrar",
        "--allow",
        "submit:museum",
        "--allow",
        "read:museum",
        "--out",
        path(&token_file)?,
    ])?;
    ensure!(fs::metadata(&token_file)?.permissions().mode() & 0o777 == 0o600);
    let token = fs::read_to_string(&token_file)?.trim().to_owned();
    let registrar = client("registrar")?;

    let worker = Process::start(
        "worker",
        &program("ign-worker")?,
        [
            "agent",
            "--server",
            &url,
            "--ca-file",
            path(&servers.file)?,
            "--client-cert",
            path(&worker_cert)?,
            "--client-key",
            path(&worker_key)?,
            "--work-dir",
            path(&seen.join("work"))?,
            "--name",
            "worker-1",
            "--threads",
            "1",
            "--exit-when-stdin-closes",
        ],
        [("RUST_LOG".to_owned(), "debug".to_owned())],
        &seen.join("worker.log"),
    )?;
    let capture = demo_capture(&dir.path().join("capture"), Demo::default())?;
    let job = registrar.submit(
        &capture,
        "museum/vase",
        &["--size", "32", "--budget-secs", "5"],
    )?;
    let elsewhere = registrar.run(&["submit", path(&capture)?, "--object", "library/vase"])?;
    ensure!(elsewhere.status.code() == Some(1), "{elsewhere:?}");

    let secrets = [
        ("root token", ROOT.to_owned()),
        ("registrar's token", token),
        ("S3 secret", S3_SECRET.to_owned()),
        (
            "server's key",
            server_key
                .lines()
                .nth(1)
                .context("a key has lines")?
                .to_owned(),
        ),
        (
            "worker's key",
            worker_secret
                .lines()
                .nth(1)
                .context("a key has lines")?
                .to_owned(),
        ),
    ];
    // Command lines of all that runs, until the job has ended.
    let mut command_lines = BTreeSet::new();
    let job = wait_until("the end of the bake", BAKE_LIMIT, || {
        for root in [coordinator.pid(), worker.pid()] {
            for pid in descendants(root)?.into_iter().chain([root]) {
                // It may have ended meanwhile.
                command_lines.insert(fs::read(format!("/proc/{pid}/cmdline")).unwrap_or_default());
            }
        }
        let job = registrar.job(job.id())?;
        Ok(job.has_ended().then_some(job))
    })?;
    ensure!(
        job.state() == "succeeded",
        "{:?}\n{}",
        job.0,
        worker.output()
    );
    ensure!(
        command_lines.len() >= 3,
        "the job's own process was not seen"
    );
    registrar.fetch_verified("museum/vase", seen.join("bundle"))?;

    let lines = seen.join("command-lines");
    fs::write(
        &lines,
        command_lines.into_iter().collect::<Vec<_>>().join(&b'\n'),
    )?;
    let (mut found, mut read) = (Vec::new(), 0);
    leaks(&seen, &secrets, &mut found, &mut read)?;
    ensure!(found.is_empty(), "{found:#?}");
    ensure!(read > 100_000, "only {read} bytes were looked at");
    // The search finds what is there.
    fs::write(&lines, format!("x{ROOT}x"))?;
    leaks(&seen, &secrets, &mut found, &mut read)?;
    ensure!(found.len() == 1, "{found:#?}");
    Ok(())
}
