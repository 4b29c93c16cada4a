//! Commands about jobs: `jobs get|list`, `logs`, `cancel`, `retry`, `rebake`, `wait`.
//!
//! A job is named by its id, by an unambiguous beginning of it, or by `collection/object` for that object's newest job.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use chrono::{DateTime, Utc};
use futures::StreamExt as _;
use futures::stream::FuturesUnordered;
use ign_proto::{Cause, CollectionId, ObjectName, v1};
use ign_trace::TraceParent;
use serde::Serialize;

use crate::Context;
use crate::connection::Connection;
use crate::output::{self, Format, Live};
use crate::problem::Problem;
use crate::recipe::{RecipeArgs, key_value};
use crate::upload;
use crate::views::{JobView, is_terminal, job_table, short_id, time};
use crate::watch;

/// `jobs get|list`.
#[derive(Debug, clap::Subcommand)]
pub(crate) enum Command {
    /// Show everything about a job
    Get {
        /// Job id, its beginning, or C/O for that object's newest job
        job: String,
    },
    /// List jobs, newest first
    List(Query),
}

/// Which jobs: those for which all of it holds.
#[derive(Clone, Debug, Default, clap::Args)]
pub(crate) struct Query {
    /// Only jobs in this state; may be given again
    #[arg(long, value_parser = state)]
    state: Vec<v1::JobState>,
    /// Only this collection
    #[arg(long, value_name = "C")]
    collection: Option<CollectionId>,
    /// Only this object
    #[arg(long, value_name = "C/O", conflicts_with = "collection")]
    object: Option<ObjectName>,
    /// Only jobs with this label; may be given again
    #[arg(long = "label", value_name = "KEY=VALUE", value_parser = key_value)]
    labels: Vec<(String, String)>,
}

impl Query {
    /// All jobs of a collection.
    pub(crate) fn of(collection: CollectionId) -> Self {
        Self {
            collection: Some(collection),
            ..Self::default()
        }
    }

    fn is_empty(&self) -> bool {
        self.state.is_empty()
            && self.collection.is_none()
            && self.object.is_none()
            && self.labels.is_empty()
    }
}

/// Arguments of `cancel` and `retry`: jobs by name, or all that a query finds.
#[derive(Debug, clap::Args)]
pub(crate) struct JobArgs {
    /// Job ids, their beginnings, or C/O for an object's newest job
    #[arg(value_name = "JOB", conflicts_with_all = ["state", "collection", "object", "labels"])]
    jobs: Vec<String>,
    #[command(flatten)]
    query: Query,
}

/// Arguments of `rebake`.
#[derive(Debug, clap::Args)]
pub(crate) struct RebakeArgs {
    #[command(flatten)]
    which: JobArgs,
    /// Jobs of higher priority go first
    #[arg(long, value_name = "N", default_value_t = 0, allow_hyphen_values = true, value_parser = clap::value_parser!(i32).range(-1000..=1000))]
    priority: i32,
    #[command(flatten)]
    recipe: RecipeArgs,
}

/// Arguments of `logs`.
#[derive(Debug, clap::Args)]
pub(crate) struct LogsArgs {
    /// Job id, its beginning, or C/O for that object's newest job
    job: String,
    /// Go on until the job ends
    #[arg(short, long)]
    follow: bool,
}

/// Arguments of `wait`.
#[derive(Debug, clap::Args)]
pub(crate) struct WaitArgs {
    /// Job ids, their beginnings, or C/O for an object's newest job
    #[arg(required = true, value_name = "JOB")]
    jobs: Vec<String>,
    /// Give up after so long, such as 90s, 10m or 2h; exit code 4
    #[arg(long, value_name = "TIME", value_parser = duration)]
    timeout: Option<Duration>,
}

fn state(text: &str) -> Result<v1::JobState, String> {
    match text {
        "queued" => Ok(v1::JobState::Queued),
        "leased" | "running" => Ok(v1::JobState::Leased),
        "succeeded" => Ok(v1::JobState::Succeeded),
        "failed" => Ok(v1::JobState::Failed),
        "cancelled" => Ok(v1::JobState::Cancelled),
        _ => Err("expected queued, running, succeeded, failed or cancelled".to_string()),
    }
}

/// `90`, `90s`, `10m`, `2h`, `7d`.
pub(crate) fn duration(text: &str) -> Result<Duration, String> {
    let (digits, unit) = match text.find(|c: char| !c.is_ascii_digit() && c != '.') {
        Some(at) => text.split_at(at),
        None => (text, "s"),
    };
    let scale = match unit {
        "s" => 1.0,
        "m" => 60.0,
        "h" => 3600.0,
        "d" => 24.0 * 3600.0,
        _ => return Err("expected a time such as 90s, 10m, 2h or 7d".to_string()),
    };
    digits
        .parse::<f64>()
        .ok()
        .and_then(|count| Duration::try_from_secs_f64(count * scale).ok())
        .ok_or_else(|| "expected a time such as 90s, 10m, 2h or 7d".to_string())
}

/// Finds the job that `name` names.
async fn find(connection: &Connection, name: &str) -> Result<v1::Job, Problem> {
    if name.contains('/') {
        let object: ObjectName = name
            .parse()
            .map_err(|error| Problem::usage(format!("{error}")))?;
        let query = Query {
            object: Some(object.clone()),
            ..Query::default()
        };
        let jobs = list_all(connection, &query).await?;
        return jobs
            .into_iter()
            .next()
            .ok_or_else(|| Problem::failed(format!("{object} has no job")));
    }
    let request = v1::GetJobRequest {
        job_id: name.to_string(),
    };
    Ok(connection.jobs().get(request).await?.into_inner())
}

/// All pages of a listing, newest job first.
pub(crate) async fn list_all(
    connection: &Connection,
    query: &Query,
) -> Result<Vec<v1::Job>, Problem> {
    let (collection, object) = match (&query.object, &query.collection) {
        (Some(name), _) => (name.collection.to_string(), name.object.to_string()),
        (None, Some(collection)) => (collection.to_string(), String::new()),
        (None, None) => (String::new(), String::new()),
    };
    let mut client = connection.jobs();
    let mut jobs = Vec::new();
    let mut page_token = String::new();
    loop {
        let request = v1::ListJobsRequest {
            collection: collection.clone(),
            object: object.clone(),
            states: query.state.iter().map(|state| i32::from(*state)).collect(),
            labels: query.labels.iter().cloned().collect(),
            page_size: 500,
            page_token,
        };
        let page = client.list(request).await?.into_inner();
        jobs.extend(page.jobs);
        page_token = page.next_page_token;
        if page_token.is_empty() {
            break;
        }
    }
    // Ids begin with the time of submission.
    jobs.sort_by(|a, b| b.id.cmp(&a.id));
    Ok(jobs)
}

pub(crate) async fn run(context: &Context, command: &Command) -> Result<(), Problem> {
    let connection = Connection::open(&context.connection).await?;
    match command {
        Command::Get { job } => {
            let view = JobView::from(&find(&connection, job).await?);
            output::data(context.format, &view, || details(&view, Utc::now()))
        }
        Command::List(query) => {
            let jobs = list_all(&connection, query).await?;
            let views: Vec<JobView> = jobs.iter().map(JobView::from).collect();
            if views.is_empty() {
                output::note("no job");
            }
            output::data(context.format, &views, || match views.len() {
                0 => String::new(),
                _ => job_table(&views, Utc::now()),
            })
        }
    }
}

fn details(job: &JobView, now: DateTime<Utc>) -> String {
    let at = |at: Option<DateTime<Utc>>| {
        at.map(|at| {
            format!(
                "{} ({} ago)",
                at.format("%Y-%m-%d %H:%M:%S UTC"),
                output::age(Some(at), now)
            )
        })
        .unwrap_or_default()
    };
    let failure = job.failure.as_ref();
    output::pairs(&[
        ("job", job.id.clone()),
        ("object", job.name()),
        ("state", job.state_for_people().to_string()),
        (
            "attempt",
            format!("{} of {}", job.attempt, job.max_attempts),
        ),
        ("worker", job.worker.clone().unwrap_or_default()),
        (
            "progress",
            job.progress
                .as_ref()
                .map(crate::views::ProgressView::one_line)
                .unwrap_or_default(),
        ),
        (
            "doing",
            job.progress
                .as_ref()
                .map(|p| p.message.clone())
                .unwrap_or_default(),
        ),
        ("waiting for", job.waiting_for.clone().unwrap_or_default()),
        (
            "error",
            failure.map(|f| f.message.clone()).unwrap_or_default(),
        ),
        ("at", failure.and_then(|f| f.at.clone()).unwrap_or_default()),
        (
            "hint",
            failure.and_then(|f| f.hint.clone()).unwrap_or_default(),
        ),
        (
            "kind",
            failure.map(|f| f.kind.to_string()).unwrap_or_default(),
        ),
        (
            "bundle",
            job.bundle
                .as_ref()
                .map(crate::views::BundleView::summary)
                .unwrap_or_default(),
        ),
        ("submitted", at(job.submitted_at)),
        ("started", at(job.started_at)),
        ("finished", at(job.finished_at)),
        (
            "took",
            job.started_at.map(|_| job.took(now)).unwrap_or_default(),
        ),
        ("priority", job.priority.to_string()),
        ("capture", job.capture_digest.clone()),
        ("recipe", job.recipe.to_string()),
        (
            "checkpoint",
            job.checkpoint_digest.clone().unwrap_or_default(),
        ),
        ("trace", job.trace_id.clone().unwrap_or_default()),
    ])
}

/// A call that takes a job and returns what became of it.
#[derive(Clone, Copy)]
enum Act {
    Cancel,
    Retry,
}

pub(crate) async fn cancel(context: &Context, args: &JobArgs) -> Result<(), Problem> {
    act(context, args, Act::Cancel).await
}

pub(crate) async fn retry(context: &Context, args: &JobArgs) -> Result<(), Problem> {
    act(context, args, Act::Retry).await
}

/// The jobs that the arguments choose; what cannot be found is told at once, and the rest goes on.
async fn chosen(
    connection: &Connection,
    args: &JobArgs,
    worst: &mut Option<Problem>,
) -> Result<Vec<v1::Job>, Problem> {
    if args.jobs.is_empty() && args.query.is_empty() {
        return Err(Problem::usage("no job is named")
            .hint("name jobs, or choose them with --collection, --object, --state and --label"));
    }
    if args.jobs.is_empty() {
        let jobs = list_all(connection, &args.query).await?;
        output::note(&format!("{} jobs", jobs.len()));
        return Ok(jobs);
    }
    let mut jobs = Vec::new();
    for name in &args.jobs {
        match find(connection, name).await {
            Ok(job) => jobs.push(job),
            Err(problem) => tell(worst, problem, name),
        }
    }
    Ok(jobs)
}

fn tell(worst: &mut Option<Problem>, problem: Problem, job: &str) {
    let problem = problem.context(format!("job {job}"));
    output::problem(&problem);
    *worst = Some(problem);
}

/// Prints what became of the jobs; fails when something was told before.
fn ended(context: &Context, jobs: &[JobView], worst: Option<Problem>) -> Result<(), Problem> {
    output::data(context.format, &jobs, || match jobs.len() {
        0 => String::new(),
        _ => job_table(jobs, Utc::now()),
    })?;
    match worst {
        Some(problem) => Err(Problem::said(problem.exit)),
        None => Ok(()),
    }
}

async fn act(context: &Context, args: &JobArgs, act: Act) -> Result<(), Problem> {
    let connection = Connection::open(&context.connection).await?;
    let (mut done, mut worst) = (Vec::new(), None);
    for job in chosen(&connection, args, &mut worst).await? {
        // Of many, those that the call is not for are left as they are; a job that was named gets an answer.
        if args.jobs.is_empty() && !act.is_for(job.state()) {
            continue;
        }
        match act_on(&connection, job.id.clone(), act).await {
            Ok(job) => done.push(JobView::from(&job)),
            Err(problem) => tell(&mut worst, problem, &short_id(&job.id)),
        }
    }
    ended(context, &done, worst)
}

impl Act {
    /// Whether the call changes a job in this state.
    fn is_for(self, state: v1::JobState) -> bool {
        match self {
            Self::Cancel => !is_terminal(state),
            Self::Retry => matches!(state, v1::JobState::Failed | v1::JobState::Cancelled),
        }
    }
}

async fn act_on(connection: &Connection, job_id: String, act: Act) -> Result<v1::Job, Problem> {
    let request = v1::GetJobRequest { job_id };
    let mut client = connection.jobs();
    let answer = match act {
        Act::Cancel => client.cancel(request).await?,
        Act::Retry => client.retry(request).await?,
    };
    let job = answer.into_inner();
    if matches!(act, Act::Cancel) && !is_terminal(job.state()) {
        output::note(&format!(
            "job {} ends when its worker next reports; `ignctl wait {0}` sees it end",
            short_id(&job.id)
        ));
    }
    Ok(job)
}

/// Queues the captures of the chosen jobs again under the recipe given now; nothing is sent, the store has them.
pub(crate) async fn rebake(context: &Context, args: &RebakeArgs) -> Result<(), Problem> {
    let connection = Connection::open(&context.connection).await?;
    let salt = Utc::now().timestamp_micros().to_string();
    let (mut done, mut worst) = (Vec::new(), None);
    let mut seen = BTreeSet::new();
    for job in chosen(&connection, &args.which, &mut worst).await? {
        let Some(spec) = job.spec else { continue };
        // Newest first: an object that was baked several times is baked once more, from its newest capture.
        if !seen.insert(
            spec.object
                .as_ref()
                .map(|o| (o.collection.clone(), o.object.clone())),
        ) {
            continue;
        }
        let before: Option<crate::recipe::Recipe> = serde_json::from_str(&spec.recipe_json).ok();
        let recipe = args.recipe.recipe(before.and_then(|recipe| recipe.proxy))?;
        let spec = v1::JobSpec {
            recipe_json: recipe.json()?,
            priority: args.priority,
            ..spec
        };
        let request_id = upload::request_id(&spec, &salt);
        match upload::submit(&connection, spec, request_id).await {
            Ok(job) => done.push(JobView::from(&job)),
            Err(problem) => tell(&mut worst, problem, &short_id(&job.id)),
        }
    }
    ended(context, &done, worst)
}

/// One line of a log, as `-o json` writes it, one object per line.
#[derive(Debug, Serialize)]
struct LogView {
    seq: u64,
    at: Option<DateTime<Utc>>,
    attempt: u32,
    level: String,
    message: String,
}

pub(crate) async fn logs(context: &Context, args: &LogsArgs) -> Result<(), Problem> {
    let connection = Connection::open(&context.connection).await?;
    let job = find(&connection, &args.job).await?;
    if let Ok(trace) = job.traceparent.parse::<TraceParent>() {
        output::note(&format!("trace {}", trace.trace_id()));
    }
    let mut after_seq = 0;
    let mut breaks = 0;
    loop {
        match log_lines(context, &connection, &job.id, args.follow, &mut after_seq).await {
            // A stream that just ends while the job goes on was cut by a restart.
            Ok(()) if !args.follow => return Ok(()),
            Ok(()) => {
                let now = find(&connection, &job.id).await;
                if now.as_ref().is_ok_and(|now| is_terminal(now.state())) {
                    return Ok(());
                }
                breaks += 1;
            }
            Err(LogEnd::Problem(problem)) => return Err(problem),
            Err(LogEnd::Status(status))
                if args.follow && Cause::from_status(&status).retryable() && breaks < 60 =>
            {
                breaks += 1;
            }
            Err(LogEnd::Status(status)) => return Err(status.into()),
        }
        tokio::time::sleep(Duration::from_secs(1)).await;
    }
}

enum LogEnd {
    Status(tonic::Status),
    Problem(Problem),
}

impl From<tonic::Status> for LogEnd {
    fn from(status: tonic::Status) -> Self {
        Self::Status(status)
    }
}

async fn log_lines(
    context: &Context,
    connection: &Connection,
    job_id: &str,
    follow: bool,
    after_seq: &mut u64,
) -> Result<(), LogEnd> {
    let request = v1::LogsRequest {
        job_id: job_id.to_string(),
        follow,
        after_seq: *after_seq,
    };
    let mut stream = connection.jobs().logs(request).await?.into_inner();
    while let Some(line) = stream.message().await? {
        *after_seq = line.seq;
        print_log_line(context.format, line).map_err(LogEnd::Problem)?;
    }
    Ok(())
}

fn print_log_line(format: Format, line: v1::LogLine) -> Result<(), Problem> {
    let view = LogView {
        seq: line.seq,
        at: time(line.at.as_ref()),
        attempt: line.attempt,
        level: line.level,
        message: line.message,
    };
    match format {
        Format::Table => output::line(&log_text(&view)),
        Format::Json => {
            let text = serde_json::to_string(&view)
                .map_err(|error| Problem::failed(format!("cannot write JSON: {error}")))?;
            output::line(&text)
        }
        Format::Yaml => output::data(Format::Yaml, &[view], String::new),
    }
}

fn log_text(line: &LogView) -> String {
    let at = line
        .at
        .map(|at| at.format("%Y-%m-%dT%H:%M:%SZ").to_string())
        .unwrap_or_default();
    format!(
        "{at} #{} {:<5} {}",
        line.attempt,
        output::printable(&line.level),
        output::printable(&line.message)
    )
}

pub(crate) async fn wait(context: &Context, args: &WaitArgs) -> Result<(), Problem> {
    let connection = Connection::open(&context.connection).await?;
    let mut ids = Vec::new();
    for name in &args.jobs {
        ids.push(
            find(&connection, name)
                .await
                .map_err(|problem| problem.context(format!("job {name}")))?
                .id,
        );
    }
    let jobs = wait_for(&connection, ids, args.timeout).await?;
    let views: Vec<JobView> = jobs.iter().map(JobView::from).collect();
    output::data(context.format, &views, || job_table(&views, Utc::now()))?;
    verdict(&views)
}

/// Exit code of jobs that were waited for.
pub(crate) fn verdict(jobs: &[JobView]) -> Result<(), Problem> {
    let failed = jobs
        .iter()
        .filter(|job| !matches!(job.state, "succeeded" | "queued" | "leased"))
        .count();
    let open = jobs
        .iter()
        .any(|job| matches!(job.state, "queued" | "leased"));
    match (failed, open) {
        (0, false) => Ok(()),
        (_, true) => Err(Problem::timeout("the time passed; the jobs go on")),
        (failed, false) => Err(Problem::failed(format!(
            "{failed} of {} jobs did not succeed",
            jobs.len()
        ))
        .hint("`ignctl jobs get JOB` shows why, `ignctl retry JOB` tries again")),
    }
}

/// Waits until every job has ended or the time passed; returns them as they then are, in the order given.
pub(crate) async fn wait_for(
    connection: &Connection,
    ids: Vec<String>,
    timeout: Option<Duration>,
) -> Result<Vec<v1::Job>, Problem> {
    let total = ids.len();
    let live = Live::percent();
    let latest: std::sync::Mutex<BTreeMap<String, v1::Job>> = std::sync::Mutex::default();
    let ended = std::sync::atomic::AtomicUsize::new(0);
    let show = |job: &v1::Job| {
        if total == 1 {
            watch::show(&live, job);
        } else {
            let ended = ended.load(std::sync::atomic::Ordering::Relaxed);
            let view = JobView::from(job);
            let percent = 100.0 * ended as f64 / total as f64;
            live.set(
                "wait",
                percent,
                &format!("{ended} of {total} ended  {} {}", view.name(), view.note()),
            );
        }
    };
    let all = async {
        // Each watch is a stream of its own; a few hundred at once are no burden, thousands would be.
        let mut waiting = ids.iter();
        let mut running = FuturesUnordered::new();
        let follow = |id: &String| {
            let id = id.clone();
            let (latest, ended, show) = (&latest, &ended, &show);
            async move {
                let keep = |job: &v1::Job| {
                    let mut latest = latest
                        .lock()
                        .unwrap_or_else(std::sync::PoisonError::into_inner);
                    latest.insert(job.id.clone(), job.clone());
                };
                let job = watch::until_end(connection, &id, watch::PATIENCE, |job| {
                    keep(job);
                    show(job);
                })
                .await?;
                ended.fetch_add(1, std::sync::atomic::Ordering::Relaxed);
                show(&job);
                Ok::<(), Problem>(())
            }
        };
        running.extend(waiting.by_ref().take(200).map(&follow));
        while let Some(outcome) = running.next().await {
            outcome?;
            running.extend(waiting.next().map(&follow));
        }
        Ok::<(), Problem>(())
    };
    match timeout {
        Some(limit) => match tokio::time::timeout(limit, all).await {
            Ok(outcome) => outcome?,
            Err(_) => live.above("timeout"),
        },
        None => all.await?,
    }
    live.clear();
    let latest = latest
        .into_inner()
        .unwrap_or_else(std::sync::PoisonError::into_inner);
    let mut jobs = Vec::new();
    for id in &ids {
        match latest.get(id) {
            Some(job) => jobs.push(job.clone()),
            None => jobs.push(find(connection, id).await?),
        }
    }
    Ok(jobs)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::problem::Exit;
    use crate::views::samples;

    #[test]
    fn times_have_units() {
        let secs = |text: &str| duration(text).map(|time| time.as_secs());
        assert_eq!(
            [
                secs("90"),
                secs("90s"),
                secs("1.5m"),
                secs("2h"),
                secs("7d")
            ],
            [Ok(90), Ok(90), Ok(90), Ok(7200), Ok(604_800)]
        );
        for bad in ["", "m", "-1s", "1w", "1..2s", "1e999h"] {
            assert!(duration(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn the_verdict_is_the_exit_code() {
        let view = |job: v1::Job| JobView::from(&job);
        let exit = |jobs: &[JobView]| verdict(jobs).map_err(|problem| problem.exit);
        assert_eq!(exit(&[view(samples::succeeded())]), Ok(()));
        assert_eq!(
            exit(&[view(samples::succeeded()), view(samples::failed())]),
            Err(Exit::Failed)
        );
        assert_eq!(
            exit(&[view(samples::running()), view(samples::failed())]),
            Err(Exit::Timeout)
        );
    }

    #[test]
    fn everything_about_a_failed_job() {
        insta::assert_snapshot!(details(&JobView::from(&samples::failed()), samples::now()));
    }

    #[test]
    fn everything_about_a_running_job() {
        insta::assert_snapshot!(details(&JobView::from(&samples::running()), samples::now()));
    }

    #[test]
    fn log_lines_cannot_move_the_cursor() {
        let line = LogView {
            seq: 1,
            at: Some(samples::now()),
            attempt: 2,
            level: "warn".into(),
            message: "view \x1b[2Ja.jpg\nfake".into(),
        };
        insta::assert_snapshot!(log_text(&line), @"2027-01-15T08:10:00Z #2 warn  view ?[2Ja.jpg fake");
    }
}
