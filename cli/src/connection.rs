//! Which coordinator to talk to, and the clients that do it.
//!
//! A server named on the command line or in the environment comes first; otherwise the data folder's `endpoint.json`,
//! which a coordinator of this machine writes when it listens. Every call carries the bearer token.

use std::path::{Path, PathBuf};
use std::time::Duration;

use ign_proto::MAX_MESSAGE_BYTES;
use ign_proto::v1::admin_client::AdminClient;
use ign_proto::v1::bundles_client::BundlesClient;
use ign_proto::v1::collections_client::CollectionsClient;
use ign_proto::v1::jobs_client::JobsClient;
use ign_proto::v1::tokens_client::TokensClient;
use reqwest::Url;
use serde::Deserialize;
use tonic::metadata::{Ascii, MetadataValue};
use tonic::service::interceptor::InterceptedService;
use tonic::transport::{Channel, Endpoint};

use crate::data_plane::DataPlane;
use crate::problem::{Doing as _, Problem, chain};

/// Where the coordinator is.
#[derive(Clone, Debug, Default, clap::Args)]
#[command(next_help_heading = "Connection")]
pub(crate) struct ConnectionArgs {
    #[arg(
        long,
        help = "Coordinator, such as http://bakery:7070; without it, the one of the data folder",
        env = "IGN_SERVER",
        global = true,
        value_name = "URL",
        hide_env_values = true
    )]
    pub(crate) server: Option<String>,
    /// File that holds the bearer token
    #[arg(
        long,
        env = "IGN_TOKEN_FILE",
        global = true,
        value_name = "FILE",
        hide_env_values = true
    )]
    pub(crate) token_file: Option<PathBuf>,
    /// Authorities of the coordinator's certificate, in PEM [default: those of this machine]
    #[arg(
        long,
        env = "IGN_CA_FILE",
        global = true,
        value_name = "FILE",
        hide_env_values = true
    )]
    pub(crate) ca_file: Option<PathBuf>,
    #[arg(
        long,
        help = "Data folder of the service on this machine [default: ~/.local/share/ign]",
        env = "IGN_DATA",
        global = true,
        value_name = "DIR",
        hide_env_values = true
    )]
    pub(crate) data: Option<PathBuf>,
}

impl ConnectionArgs {
    fn certificates(&self) -> ign_client::Files {
        ign_client::Files {
            ca: self.ca_file.clone(),
            identity: None,
        }
    }

    /// The data folder: named, or the user's default.
    pub(crate) fn data_dir(&self) -> Result<PathBuf, Problem> {
        if let Some(dir) = &self.data {
            return Ok(dir.clone());
        }
        let set = |name: &str| std::env::var_os(name).filter(|value| !value.is_empty());
        set("XDG_DATA_HOME")
            .map(PathBuf::from)
            .or_else(|| set("HOME").map(|home| Path::new(&home).join(".local/share")))
            .map(|base| base.join("ign"))
            .ok_or_else(|| {
                Problem::usage("no data folder: HOME is not set").hint("give --data DIR (IGN_DATA)")
            })
    }
}

/// What `endpoint.json` says.
#[derive(Clone, Debug, Deserialize)]
pub(crate) struct EndpointFile {
    /// Base address.
    pub(crate) url: String,
    /// Process that listens there.
    pub(crate) pid: u32,
    /// Token for it.
    pub(crate) token_file: PathBuf,
}

impl EndpointFile {
    /// Of the coordinator that runs on `data`; none when it never ran or has ended.
    pub(crate) fn of_live_service(data: &Path) -> Option<Self> {
        let text = std::fs::read_to_string(data.join("endpoint.json")).ok()?;
        let endpoint: Self = serde_json::from_str(&text).ok()?;
        process_lives(endpoint.pid).then_some(endpoint)
    }
}

fn process_lives(pid: u32) -> bool {
    let Some(pid) = i32::try_from(pid)
        .ok()
        .and_then(rustix::process::Pid::from_raw)
    else {
        return false;
    };
    match rustix::process::test_kill_process(pid) {
        Ok(()) => true,
        Err(error) => error == rustix::io::Errno::PERM,
    }
}

/// An address and its token, not yet tried.
#[derive(Clone, Debug)]
pub(crate) struct Target {
    /// Base address.
    pub(crate) url: Url,
    token: MetadataValue<Ascii>,
    bearer: String,
    tls: ign_client::Tls,
}

impl Target {
    /// Checks address and token file.
    pub(crate) fn new(
        url: &str,
        token_file: Option<&Path>,
        certificates: &ign_client::Files,
    ) -> Result<Self, Problem> {
        let parsed = Url::parse(url)
            .ok()
            .filter(|parsed| parsed.host_str().is_some())
            .ok_or_else(|| {
                Problem::usage(format!("{url:?} is no address"))
                    .hint("--server takes http://host:port")
            })?;
        if !matches!(parsed.scheme(), "http" | "https") {
            return Err(
                Problem::usage(format!("scheme {} is not spoken", parsed.scheme()))
                    .at(url)
                    .hint("https:// or, within this machine or behind a tunnel, http://"),
            );
        }
        let tls =
            ign_client::Tls::load(certificates).map_err(|error| Problem::usage(chain(&error)))?;
        let token = match token_file {
            Some(file) => std::fs::read_to_string(file).map_err(|error| {
                Problem::usage(format!("cannot read the token: {error}")).at(file.display())
            })?,
            None => String::new(),
        };
        let bearer = format!("Bearer {}", token.trim());
        let mut token = MetadataValue::try_from(bearer.as_str())
            .map_err(|error| Problem::usage(format!("the token is malformed: {error}")))?;
        token.set_sensitive(true);
        Ok(Self {
            url: parsed,
            token,
            bearer,
            tls,
        })
    }

    /// What the arguments name; for the data folder, a service that runs now.
    pub(crate) fn resolve(args: &ConnectionArgs) -> Result<Self, Problem> {
        if let Some(server) = &args.server {
            return Self::new(server, args.token_file.as_deref(), &args.certificates());
        }
        let data = args.data_dir()?;
        let endpoint = EndpointFile::of_live_service(&data).ok_or_else(|| {
            Problem::unreachable("no coordinator runs on the data folder")
                .at(data.display())
                .hint("start one with `ignctl up`, or name another with --server")
        })?;
        let token_file = args.token_file.as_ref().unwrap_or(&endpoint.token_file);
        Self::new(&endpoint.url, Some(token_file), &args.certificates())
    }
}

/// Adds the token to each gRPC call, and the trace that the command began.
#[derive(Clone)]
pub(crate) struct Bearer(MetadataValue<Ascii>);

impl tonic::service::Interceptor for Bearer {
    fn call(
        &mut self,
        mut request: tonic::Request<()>,
    ) -> Result<tonic::Request<()>, tonic::Status> {
        request
            .metadata_mut()
            .insert("authorization", self.0.clone());
        if let Some(trace) = ign_trace::current()
            && let Ok(trace) = trace.to_string().parse()
        {
            request.metadata_mut().insert(ign_trace::HEADER, trace);
        }
        Ok(request)
    }
}

/// A gRPC channel with the token.
pub(crate) type Admitted = InterceptedService<Channel, Bearer>;

/// A coordinator that has answered.
#[derive(Clone)]
pub(crate) struct Connection {
    /// Address and token.
    pub(crate) target: Target,
    channel: Channel,
    http: reqwest::Client,
}

impl Connection {
    /// Resolves the arguments and makes sure that somebody answers.
    pub(crate) async fn open(args: &ConnectionArgs) -> Result<Self, Problem> {
        Self::to(Target::resolve(args)?).await
    }

    /// Connects to `target` and makes sure that it answers.
    pub(crate) async fn to(target: Target) -> Result<Self, Problem> {
        let http = target
            .tls
            .http(reqwest::Client::builder())
            .connect_timeout(Duration::from_secs(5))
            .read_timeout(Duration::from_mins(1))
            .build()
            .doing("cannot set up HTTP", &target.url)?;
        let health = target
            .url
            .join("healthz")
            .map_err(|error| Problem::usage(error.to_string()))?;
        let answer = http
            .get(health)
            .timeout(Duration::from_secs(5))
            .send()
            .await;
        match answer {
            Ok(answer) if answer.status().is_success() => {}
            Ok(answer) => {
                return Err(Problem::unreachable(format!(
                    "no coordinator answers there: {}",
                    answer.status()
                ))
                .at(&target.url)
                .hint("ignctl doctor"));
            }
            Err(error) => {
                return Err(Problem::unreachable(format!(
                    "cannot reach the coordinator: {}",
                    chain(&error.without_url())
                ))
                .at(&target.url)
                .hint("start one with `ignctl up`, or name another with --server"));
            }
        }
        // Keepalive is off by default; without it a `logs -f` over a dead link would wait for ever.
        let endpoint = Endpoint::from_shared(target.url.to_string())
            .map_err(|error| Problem::usage(chain(&error)).at(&target.url))?
            .connect_timeout(Duration::from_secs(5))
            .http2_keep_alive_interval(Duration::from_secs(20))
            .keep_alive_timeout(Duration::from_secs(10));
        let channel = target.tls.channel(&endpoint);
        Ok(Self {
            target,
            channel,
            http,
        })
    }

    fn admitted(&self) -> Admitted {
        InterceptedService::new(self.channel.clone(), Bearer(self.target.token.clone()))
    }

    /// Client of the job calls.
    pub(crate) fn jobs(&self) -> JobsClient<Admitted> {
        JobsClient::new(self.admitted()).max_decoding_message_size(MAX_MESSAGE_BYTES)
    }

    /// Client of the calls about collections.
    pub(crate) fn collections(&self) -> CollectionsClient<Admitted> {
        CollectionsClient::new(self.admitted()).max_decoding_message_size(MAX_MESSAGE_BYTES)
    }

    /// Client of the bundle calls.
    pub(crate) fn bundles(&self) -> BundlesClient<Admitted> {
        BundlesClient::new(self.admitted()).max_decoding_message_size(MAX_MESSAGE_BYTES)
    }

    /// Client of the token calls.
    pub(crate) fn tokens(&self) -> TokensClient<Admitted> {
        TokensClient::new(self.admitted())
    }

    /// Client of the calls about the registry as a whole.
    pub(crate) fn admin(&self) -> AdminClient<Admitted> {
        AdminClient::new(self.admitted()).max_decoding_message_size(MAX_MESSAGE_BYTES)
    }

    /// Client of the blobs of one object.
    pub(crate) fn data_plane(&self, object: &ign_proto::ObjectName) -> Result<DataPlane, Problem> {
        DataPlane::new(
            &self.target.url,
            &self.target.bearer,
            object,
            self.http.clone(),
        )
    }

    /// Plain GET of a path without the token, such as `readyz`.
    pub(crate) async fn get_open(&self, path: &str) -> Result<reqwest::Response, Problem> {
        let url = self
            .target
            .url
            .join(path)
            .map_err(|error| Problem::failed(error.to_string()))?;
        Ok(self
            .http
            .get(url)
            .timeout(Duration::from_secs(10))
            .send()
            .await?)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_service_that_ended_is_not_used() {
        let data = tempfile::tempdir().unwrap();
        let write = |pid: u32| {
            let text =
                format!(r#"{{"url":"http://127.0.0.1:1","pid":{pid},"token_file":"/none"}}"#);
            std::fs::write(data.path().join("endpoint.json"), text).unwrap();
        };
        assert!(EndpointFile::of_live_service(data.path()).is_none());
        write(std::process::id());
        assert!(EndpointFile::of_live_service(data.path()).is_some());
        let mut child = std::process::Command::new("true").spawn().unwrap();
        let pid = child.id();
        child.wait().unwrap();
        write(pid);
        assert!(EndpointFile::of_live_service(data.path()).is_none());
        write(0);
        assert!(EndpointFile::of_live_service(data.path()).is_none());
    }

    #[test]
    fn addresses_are_checked_before_use() {
        for bad in ["", "bakery:7070", "ftp://bakery", "file:///x", "http://"] {
            let problem = Target::new(bad, None, &ign_client::Files::default()).unwrap_err();
            assert_eq!(problem.exit, crate::problem::Exit::Usage, "{bad}");
        }
        assert!(Target::new("https://bakery:7070", None, &ign_client::Files::default()).is_ok());
    }
}
