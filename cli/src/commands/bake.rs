//! `bake`: one capture from folder to verified bundle, with the service that runs or one that lives as long as the bake.

use std::path::{Path, PathBuf};
use std::sync::OnceLock;
use std::time::{Duration, Instant};

use ign_proto::{Digest, ObjectName, v1};

use crate::Context;
use crate::connection::Connection;
use crate::embedded::{self, Embedded, Options, interrupted};
use crate::output::{self, Live};
use crate::pack;
use crate::problem::{Exit, Problem};
use crate::recipe::RecipeArgs;
use crate::results::{self, Files, ResultView, Staging};
use crate::upload::{self, Order};
use crate::views::{BundleView, is_terminal, short_id};
use crate::watch;

/// Somebody waits for a bake of this kind; what was queued earlier can wait a little longer.
const FOREGROUND_PRIORITY: i32 = 10;

/// How long to wait for a service that is starting or ending on the data folder.
const TAKEN_PATIENCE: Duration = Duration::from_secs(20);
/// A service of this machine that is silent for so long has ended.
const LOCAL_PATIENCE: Duration = Duration::from_secs(10);

/// Arguments of `bake`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Capture folder: images/, sparse/, a mesh
    capture: PathBuf,
    /// Name of the object, as in museum/vase
    #[arg(long, value_name = "C/O")]
    object: ObjectName,
    /// Proxy mesh to use instead of the capture's own
    #[arg(long, value_name = "FILE")]
    proxy: Option<PathBuf>,
    /// Folder for the results [default: bake-out/OBJECT]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Key under which repeating the command finds the same job [default: a new one each time]
    #[arg(long, value_name = "ID")]
    request_id: Option<String>,
    // Last, because its heading holds for what follows.
    #[command(flatten)]
    recipe: RecipeArgs,
}

pub(crate) async fn run(context: &Context, args: &Args) -> Result<(), Problem> {
    // All that the command line can get wrong is found before anything starts.
    pack::check_folder(&args.capture)?;
    let proxy = match &args.proxy {
        Some(proxy) => Some(pack::find_proxy(&args.capture, proxy)?),
        None => None,
    };
    let proxy_path = proxy.as_deref().map(pack::proxy_path).transpose()?;
    let recipe = args.recipe.recipe(proxy_path.map(String::from))?;
    let out = args
        .out
        .clone()
        .unwrap_or_else(|| Path::new("bake-out").join(args.object.object.as_str()));
    results::check_replaceable(&out)?;
    let mut order = Order {
        capture: args.capture.clone(),
        proxy,
        object: args.object.clone(),
        recipe,
        priority: 0,
        labels: std::collections::BTreeMap::new(),
    };

    loop {
        let (connection, service) = connect(context).await?;
        if let Some(service) = service {
            if args.request_id.is_none() {
                order.priority = FOREGROUND_PRIORITY;
            }
            return with_own(context, &connection, service, &order, args, &out).await;
        }
        match with_running(context, &connection, &order, args, &out).await {
            // The service was another bake's, which has ended: go on with the job under one of our own.
            Err(problem)
                if problem.exit == Exit::Unreachable && context.connection.server.is_none() =>
            {
                output::warn("the service has gone; looking for another");
            }
            outcome => return outcome,
        }
    }
}

/// Bakes with a service that runs; Ctrl-C leaves the job to it.
async fn with_running(
    context: &Context,
    connection: &Connection,
    order: &Order,
    args: &Args,
    out: &Path,
) -> Result<(), Problem> {
    let job_id = OnceLock::new();
    tokio::select! {
        outcome = bake(context, connection, order, args, out, &job_id) => outcome,
        signal = interrupted() => {
            signal?;
            if let Some(id) = job_id.get() {
                output::note(&format!(
                    "job {id} goes on; come back with `ignctl wait {0}`, stop it with `ignctl cancel {0}`",
                    short_id(id)
                ));
            }
            Err(Problem::said(Exit::Failed))
        }
    }
}

/// Bakes with a service of its own, which ends with it; Ctrl-C cancels the job.
async fn with_own(
    context: &Context,
    connection: &Connection,
    mut service: Embedded,
    order: &Order,
    args: &Args,
    out: &Path,
) -> Result<(), Problem> {
    let job_id = OnceLock::new();
    let outcome = tokio::select! {
        outcome = bake(context, connection, order, args, out, &job_id) => outcome,
        problem = service.broken() => Err(problem),
        signal = interrupted() => {
            signal?;
            if let Some(id) = job_id.get() {
                output::note("cancelling");
                cancel(connection, id).await;
            }
            Err(Problem::said(Exit::Failed))
        }
    };
    let left = left_over(connection).await;
    let stopped = service.stop().await;
    if left > 0 {
        let jobs = if left == 1 { "job waits" } else { "jobs wait" };
        output::note(&format!(
            "{left} {jobs} in the data folder; `ignctl up` runs what is queued"
        ));
    }
    outcome.and(stopped)
}

/// The service that runs, or else a new one for the time of this bake.
async fn connect(context: &Context) -> Result<(Connection, Option<Embedded>), Problem> {
    let data = context.connection.data_dir();
    let began = Instant::now();
    loop {
        match Connection::open(&context.connection).await {
            Ok(connection) => return Ok((connection, None)),
            Err(problem)
                if problem.exit == Exit::Unreachable && context.connection.server.is_none() => {}
            Err(problem) => return Err(problem),
        }
        let data = data.clone()?;
        let options = Options {
            data: data.clone(),
            workers: 1,
            threads: None,
            listen: std::net::SocketAddr::from(([127, 0, 0, 1], 0)),
            behind_tls_proxy: false,
            care: ign_coordinator::Care::default(),
            webhook_internal: Vec::new(),
            own: true,
        };
        match Embedded::start(&options).await {
            Ok(service) => {
                output::note(&format!(
                    "service started for this bake; data in {}",
                    data.display()
                ));
                let connection = Connection::to(service.target.clone()).await?;
                return Ok((connection, Some(service)));
            }
            // Another service is just starting or ending there.
            Err(_) if embedded::is_taken(&data) && began.elapsed() < TAKEN_PATIENCE => {
                tokio::time::sleep(Duration::from_millis(200)).await;
            }
            Err(problem) => return Err(problem),
        }
    }
}

async fn bake(
    context: &Context,
    connection: &Connection,
    order: &Order,
    args: &Args,
    out: &Path,
    job_id: &OnceLock<String>,
) -> Result<(), Problem> {
    let capture = upload::upload(connection, order).await?;
    let job = submit(connection, order, &capture, args.request_id.as_deref()).await?;
    output::note(&format!("job {} bakes {}", job.id, order.object));
    // Set once: this function runs once.
    let _first = job_id.set(job.id.clone());

    let live = Live::percent();
    let patience = match context.connection.server {
        Some(_) => watch::PATIENCE,
        None => LOCAL_PATIENCE,
    };
    let show = |job: &v1::Job| watch::show(&live, job);
    let job = watch::until_end(connection, &job.id, patience, show).await?;
    live.clear();
    if job.state() != v1::JobState::Succeeded {
        return Err(watch::failure(&job));
    }
    let bundle = job.bundle.as_ref().ok_or_else(|| {
        Problem::failed("the job succeeded but names no bundle").at(format!("job {}", job.id))
    })?;
    let result = fetch(connection, order, &job.id, bundle, out).await?;
    output::data(context.format, &result, || table(&result))
}

/// Submits, or joins a job of the same capture and recipe that has not ended: after a crash, the same command goes on
/// with the job that it had begun.
async fn submit(
    connection: &Connection,
    order: &Order,
    capture: &Digest,
    request_id: Option<&str>,
) -> Result<v1::Job, Problem> {
    let spec = upload::spec(order, capture)?;
    if let Some(id) = request_id {
        return upload::submit(connection, spec, id.to_string()).await;
    }
    let request = v1::ListJobsRequest {
        collection: order.object.collection.to_string(),
        object: order.object.object.to_string(),
        states: vec![v1::JobState::Queued.into(), v1::JobState::Leased.into()],
        ..Default::default()
    };
    let open = connection.jobs().list(request).await?.into_inner().jobs;
    let same = open.into_iter().find(|job| {
        job.spec.as_ref().is_some_and(|other| {
            other.capture_digest == spec.capture_digest && other.recipe_json == spec.recipe_json
        })
    });
    if let Some(job) = same {
        output::note("a job for this capture and recipe is under way already; joining it");
        return Ok(job);
    }
    let now = chrono::Utc::now().timestamp_micros().to_string();
    let id = upload::request_id(&spec, &now);
    upload::submit(connection, spec, id).await
}

async fn fetch(
    connection: &Connection,
    order: &Order,
    job_id: &str,
    bundle: &v1::BundleVersion,
    out: &Path,
) -> Result<ResultView, Problem> {
    let digest: Digest = bundle
        .manifest_digest
        .parse()
        .map_err(|error| Problem::failed(format!("the bundle's digest is malformed: {error}")))?;
    let staging = Staging::new(out)?;
    let folder = staging.dir().join("bundle");
    std::fs::create_dir_all(&folder)?;
    Files::of(connection, &order.object, &digest)
        .await?
        .fetch(connection, &order.object, Some(&folder))
        .await?;
    results::verify_folder(&folder)?;
    results::lay_out(staging.dir())?;
    staging.place()?;
    let bundle_dir = out.join("bundle");
    let (_, preview) = results::people_files(&bundle_dir);
    Ok(ResultView {
        job_id: job_id.to_string(),
        bundle: BundleView::from(bundle),
        out_dir: out.to_path_buf(),
        report: results::people_files(out).0,
        preview,
        methods: results::methods(&out.join("metrics.json"))?,
        bundle_dir,
    })
}

fn table(result: &ResultView) -> String {
    let path = |path: &Option<PathBuf>| {
        path.as_ref()
            .map(|path| path.display().to_string())
            .unwrap_or_default()
    };
    let mut text = output::pairs(&[
        (
            "object",
            format!("{} {}", result.bundle.name(), result.bundle.summary()),
        ),
        ("bundle", result.bundle_dir.display().to_string()),
        ("report", path(&result.report)),
        ("preview", path(&result.preview)),
    ]);
    if !result.methods.is_empty() {
        text.push('\n');
        text.push_str(&results::method_table(&result.methods));
    }
    text
}

/// Cancels and waits a while for the worker to let go; what goes wrong here changes nothing for the user.
async fn cancel(connection: &Connection, job_id: &str) {
    let request = v1::GetJobRequest {
        job_id: job_id.to_string(),
    };
    let cancelled = connection
        .jobs()
        .cancel(request)
        .await
        .map(tonic::Response::into_inner);
    if cancelled.is_ok_and(|job| !is_terminal(job.state())) {
        let end = watch::until_end(connection, job_id, LOCAL_PATIENCE, |_| ());
        if tokio::time::timeout(Duration::from_secs(20), end)
            .await
            .is_err()
        {
            output::warn("the worker has not let go of the job yet");
        }
    }
}

/// Jobs that wait while no service runs.
async fn left_over(connection: &Connection) -> u64 {
    let status = connection.jobs().status(v1::StatusRequest::default()).await;
    status.map_or(0, |status| {
        status
            .into_inner()
            .jobs_by_state
            .get("queued")
            .copied()
            .unwrap_or(0)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::results::MethodView;
    use crate::views::samples;

    #[test]
    fn the_end_of_a_bake_says_where_everything_lies() {
        let row = |method: &str, mse: f64| MethodView {
            method: method.into(),
            mse: Some(mse),
            mse_object: Some(3.0 * mse),
            psnr: Some(30.0),
        };
        let result = ResultView {
            job_id: "01985a4e-0003".into(),
            bundle: BundleView::from(&samples::bundle()),
            out_dir: "bake-out/axe".into(),
            bundle_dir: "bake-out/axe/bundle".into(),
            report: Some("bake-out/axe/report.html".into()),
            preview: Some("bake-out/axe/bundle/preview.webp".into()),
            methods: vec![row("ours", 4.9), row("n_ibr", 10.0), row("ibr", 7.5)],
        };
        insta::assert_snapshot!(table(&result));
    }
}
