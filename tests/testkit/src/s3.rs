//! An S3 endpoint over a folder, with signature checks.
//!
//! Known limit of the server behind it: a conditional put is check-then-rename, not atomic. Nothing in ign relies on an
//! atomic one (the database is the only commit authority).

use std::collections::BTreeMap;
use std::future::Future;
use std::net::{SocketAddr, TcpListener};
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::OnceLock;
use std::thread::JoinHandle;

use anyhow::{Result, anyhow};
use hyper_util::rt::{TokioExecutor, TokioIo};
use hyper_util::server::conn::auto;
use s3s::auth::SimpleAuth;
use s3s::service::S3ServiceBuilder;
use tokio::sync::oneshot;

/// The one key pair that an endpoint accepts.
#[derive(Clone, Debug)]
pub struct Credentials {
    /// Access key id.
    pub access_key: String,
    /// Secret key.
    pub secret_key: String,
}

impl Default for Credentials {
    fn default() -> Self {
        Self {
            access_key: "ign-test-access".to_owned(),
            secret_key: "ign-test-secret-0123456789".to_owned(),
        }
    }
}

/// Serves the folder `root` (one sub-folder per bucket) until `stop` is ready.
pub async fn serve(
    root: &Path,
    listener: tokio::net::TcpListener,
    credentials: &Credentials,
    stop: impl Future<Output = ()>,
) -> Result<()> {
    let files = s3s_fs::FileSystem::new(root)
        .map_err(|error| anyhow!("cannot serve {}: {error:?}", root.display()))?;
    let mut builder = S3ServiceBuilder::new(files);
    builder.set_auth(SimpleAuth::from_single(
        credentials.access_key.clone(),
        credentials.secret_key.clone(),
    ));
    let service = builder.build();
    let server = auto::Builder::new(TokioExecutor::new());
    tokio::pin!(stop);
    loop {
        let (socket, _peer) = tokio::select! {
            accepted = listener.accept() => match accepted {
                Ok(connection) => connection,
                // Out of file handles, or the peer left: the next one may do.
                Err(_) => continue,
            },
            () = &mut stop => return Ok(()),
        };
        socket.set_nodelay(true)?;
        let connection = server
            .serve_connection(TokioIo::new(socket), service.clone())
            .into_owned();
        tokio::spawn(async move {
            // A broken connection is the client's to report.
            connection.await.ok();
        });
    }
}

/// Removes the folder when the test process ends, in whatever way: then the pipe on stdin closes.
const JANITOR: &str = r#"read -r _; rm -rf "$1""#;

/// An endpoint inside the test process, on a thread of its own; stopped and removed when dropped.
#[derive(Debug)]
pub struct S3 {
    address: SocketAddr,
    credentials: Credentials,
    root: PathBuf,
    janitor: Child,
    stop: Option<oneshot::Sender<()>>,
    thread: Option<JoinHandle<()>>,
}

impl S3 {
    /// Name of the bucket that every endpoint has from the start.
    pub const BUCKET: &str = "ign-test";

    /// Starts an endpoint on a free loopback port, with an empty bucket.
    pub fn start() -> Result<Self> {
        let root = tempfile::Builder::new().prefix("ign-s3-").tempdir()?.keep();
        let janitor = Command::new("sh")
            .args(["-c", JANITOR, "s3-janitor"])
            .arg(&root)
            .current_dir("/")
            .stdin(Stdio::piped())
            .process_group(0)
            .spawn()?;
        std::fs::create_dir(root.join(Self::BUCKET))?;
        let listener = TcpListener::bind("127.0.0.1:0")?;
        listener.set_nonblocking(true)?;
        let address = listener.local_addr()?;
        let credentials = Credentials::default();
        let (stop, stopped) = oneshot::channel::<()>();
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build()?;
        let listener = {
            let _entered = runtime.enter();
            tokio::net::TcpListener::from_std(listener)?
        };
        let thread = std::thread::Builder::new()
            .name("s3-endpoint".to_owned())
            .spawn({
                let root = root.clone();
                let credentials = credentials.clone();
                move || {
                    let stop = async {
                        stopped.await.ok();
                    };
                    // A failure shows at once as a refused connection in the test.
                    runtime
                        .block_on(serve(&root, listener, &credentials, stop))
                        .ok();
                }
            })?;
        Ok(Self {
            address,
            credentials,
            root,
            janitor,
            stop: Some(stop),
            thread: Some(thread),
        })
    }

    /// The endpoint that all tests of this process share, started by the first caller. Use a prefix of your own.
    pub fn shared() -> Result<&'static Self> {
        static SHARED: OnceLock<Result<S3, String>> = OnceLock::new();
        SHARED
            .get_or_init(|| Self::start().map_err(|error| format!("{error:#}")))
            .as_ref()
            .map_err(|message| anyhow!("{message}"))
    }

    /// `http://127.0.0.1:port`.
    pub fn endpoint(&self) -> String {
        format!("http://{}", self.address)
    }

    /// The key pair it accepts.
    pub fn credentials(&self) -> &Credentials {
        &self.credentials
    }

    /// `s3://bucket/prefix` of the bucket that is there from the start.
    pub fn url(&self, prefix: &str) -> String {
        format!("s3://{}/{prefix}", Self::BUCKET)
    }

    /// Folder that holds the buckets, to look at or to damage.
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// The variables that point an AWS client (and `ign-coordinator`) here.
    pub fn env(&self) -> BTreeMap<String, String> {
        aws_env(&self.endpoint(), &self.credentials)
    }
}

impl Drop for S3 {
    fn drop(&mut self) {
        if let Some(stop) = self.stop.take() {
            stop.send(()).ok();
        }
        if let Some(thread) = self.thread.take() {
            thread.join().ok();
        }
        drop(self.janitor.stdin.take());
        self.janitor.wait().ok();
    }
}

fn aws_env(endpoint: &str, credentials: &Credentials) -> BTreeMap<String, String> {
    [
        ("AWS_ACCESS_KEY_ID", credentials.access_key.as_str()),
        ("AWS_SECRET_ACCESS_KEY", credentials.secret_key.as_str()),
        ("AWS_ENDPOINT", endpoint),
        ("AWS_REGION", "us-east-1"),
        ("AWS_ALLOW_HTTP", "true"),
    ]
    .into_iter()
    .map(|(name, value)| (name.to_owned(), value.to_owned()))
    .collect()
}
