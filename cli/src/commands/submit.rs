//! `submit`: queues captures, or checks them without sending anything.
//!
//! Request ids follow from content (object, capture, recipe, priority), so repeating a submit after a broken connection
//! finds the jobs it had queued and sends no byte twice, even if it was killed in the middle of a file. One bad capture
//! does not stop the others.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use chrono::{DateTime, Utc};
use futures::{StreamExt as _, TryStreamExt as _};
use ign_capture::{Fault, Findings, Preflight, PreflightOptions, Severity};
use ign_proto::{CollectionId, Digest, ObjectName, v1};
use serde::Serialize;
use tokio::sync::mpsc;

use crate::Context;
use crate::bag;
use crate::commands::{jobs, manifest, preflight};
use crate::connection::Connection;
use crate::output::{self, Table};
use crate::pack;
use crate::problem::{Doing as _, Exit, Problem};
use crate::recipe::{RecipeArgs, key_value};
use crate::upload::{self, Order, Uploader};
use crate::views::{JobView, ShortIds, short_id, time};

/// Captures that are hashed and sent at the same time.
const CAPTURES_AT_ONCE: usize = 4;
/// Rows that are queued by one call.
const ROWS_A_CALL: usize = 500;

/// Arguments of `submit`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Capture folders, or folders that hold captures
    #[arg(
        value_name = "PATH",
        required_unless_present = "manifest",
        conflicts_with = "manifest"
    )]
    paths: Vec<PathBuf>,
    /// CSV list with the columns path, collection, object and optionally preset, size, priority, labels
    #[arg(long, value_name = "CSV")]
    manifest: Option<PathBuf>,
    /// Name of the object, for one capture
    #[arg(long, value_name = "C/O", conflicts_with_all = ["manifest", "collection"])]
    object: Option<ObjectName>,
    /// Collection; the objects are named by capture.toml or by their folders
    #[arg(long, value_name = "C", conflicts_with = "manifest")]
    collection: Option<CollectionId>,
    /// Jobs of higher priority go first
    #[arg(long, value_name = "N", default_value_t = 0, allow_hyphen_values = true, value_parser = clap::value_parser!(i32).range(-1000..=1000))]
    priority: i32,
    /// Mark the jobs, for listing, cancelling or retrying them together; may be given again
    #[arg(long = "label", value_name = "KEY=VALUE", value_parser = key_value)]
    labels: Vec<(String, String)>,
    /// Write what is wrong, one row per fault, as CSV into this file
    #[arg(long, value_name = "CSV")]
    errors: Option<PathBuf>,
    /// Check the captures and queue nothing
    #[arg(long, conflicts_with_all = ["wait", "again"])]
    dry_run: bool,
    /// Wait until all jobs have ended
    #[arg(long)]
    wait: bool,
    /// Queue a new job even where the same one was queued before
    #[arg(long)]
    again: bool,
    // Last, because its heading holds for what follows.
    #[command(flatten)]
    recipe: RecipeArgs,
}

/// What became of one capture.
#[derive(Debug, Serialize)]
struct RowView {
    path: PathBuf,
    collection: String,
    object: String,
    /// `submitted`, `known` (queued by an earlier submit) or `error`.
    outcome: &'static str,
    job: Option<JobView>,
    error: Option<String>,
}

/// What preflight found in one capture.
#[derive(Debug, Serialize)]
struct CheckView {
    path: PathBuf,
    collection: String,
    object: String,
    ok: bool,
    train_views: Option<usize>,
    held_out_views: Option<usize>,
    triangles: Option<usize>,
    faults: Vec<Fault>,
    findings: Option<Findings>,
}

pub(crate) async fn run(context: &Context, args: &Args) -> Result<(), Problem> {
    let mut errors = ErrorList::create(args.errors.as_deref())?;
    let orders = plan(args, &mut errors)?;
    if args.dry_run {
        return dry_run(context, orders, &mut errors).await;
    }
    let connection = Connection::open(&context.connection).await?;
    let began = connection
        .jobs()
        .status(v1::StatusRequest::default())
        .await?
        .into_inner();
    let began = time(began.at.as_ref()).unwrap_or_default();
    let salt = if args.again {
        Utc::now().timestamp_micros().to_string()
    } else {
        String::new()
    };
    let (mut rows, stopped) = submit_all(&connection, &orders, &salt, began, &mut errors).await?;

    let ids: Vec<String> = rows
        .iter()
        .filter_map(|row| row.job.as_ref())
        .map(|job| job.id.clone())
        .collect();
    if args.wait && stopped.is_none() && !ids.is_empty() {
        let ended = jobs::wait_for(&connection, ids, None).await?;
        let mut ended = ended.iter().map(JobView::from);
        for row in rows.iter_mut().filter(|row| row.job.is_some()) {
            row.job = ended.next();
        }
    }
    output::data(context.format, &rows, || table(&rows))?;
    if let Some(problem) = stopped {
        return Err(
            problem.hint("submit the same again later: what was queued is not queued twice")
        );
    }
    verdict(&rows, args.wait)
}

fn verdict(rows: &[RowView], waited: bool) -> Result<(), Problem> {
    let refused = rows.iter().filter(|row| row.error.is_some()).count();
    if refused > 0 {
        return Err(Problem::failed(format!(
            "{refused} of {} captures were not queued",
            rows.len()
        )));
    }
    if waited {
        let jobs: Vec<JobView> = rows.iter().filter_map(|row| row.job.clone()).collect();
        return jobs::verdict(&jobs);
    }
    Ok(())
}

/// All captures that the arguments name, each with its object; every fault of the arguments is found before anything
/// is sent.
fn plan(args: &Args, errors: &mut ErrorList) -> Result<Vec<Order>, Problem> {
    let (orders, problems) = match &args.manifest {
        Some(list) => plan_manifest(args, list)?,
        None => plan_paths(args)?,
    };
    let mut problems = problems;
    problems.extend(duplicates(&orders));
    for problem in &problems {
        errors.problem(None, problem)?;
    }
    match problems.len() {
        0 => Ok(orders),
        1 => Err(problems.remove(0)),
        count => {
            for problem in &problems {
                output::problem(problem);
            }
            Err(Problem::usage(format!("{count} faults; nothing was sent")))
        }
    }
}

type Planned = Result<(Vec<Order>, Vec<Problem>), Problem>;

fn plan_manifest(args: &Args, list: &Path) -> Planned {
    let rows = match manifest::read(list) {
        Ok(rows) => rows,
        Err(problems) => return Ok((Vec::new(), problems)),
    };
    let (mut orders, mut problems) = (Vec::new(), Vec::new());
    for row in rows {
        let capture = match pack::check_folder(&row.path).and_then(|()| bag::payload(&row.path)) {
            Ok(capture) => capture,
            Err(problem) => {
                let at = format!("{}:{}", list.display(), row.line);
                problems.push(
                    Problem::usage(format!("{} ({})", problem.what, row.path.display())).at(at),
                );
                continue;
            }
        };
        let mut recipe = args.recipe.recipe(None)?;
        recipe.preset = row.preset.unwrap_or(recipe.preset);
        recipe.size = row.size.unwrap_or(recipe.size);
        let mut labels: BTreeMap<String, String> = args.labels.iter().cloned().collect();
        labels.extend(row.labels);
        orders.push(Order {
            capture,
            proxy: None,
            object: row.object,
            recipe,
            priority: row.priority.unwrap_or(args.priority),
            labels,
        });
    }
    Ok((orders, problems))
}

fn plan_paths(args: &Args) -> Planned {
    let recipe = args.recipe.recipe(None)?;
    let order = |capture: PathBuf, object: ObjectName| Order {
        capture,
        proxy: None,
        object,
        recipe: recipe.clone(),
        priority: args.priority,
        labels: args.labels.iter().cloned().collect(),
    };
    if let Some(object) = &args.object {
        let [path] = args.paths.as_slice() else {
            return Err(Problem::usage(
                "--object names one object, but several captures are given",
            )
            .hint("use --collection, or a list with --manifest"));
        };
        pack::check_folder(path)?;
        let capture = bag::payload(path)?;
        return Ok((vec![order(capture, object.clone())], Vec::new()));
    }
    let (mut orders, mut problems) = (Vec::new(), Vec::new());
    for path in &args.paths {
        match captures_in(path) {
            Ok(captures) => {
                for capture in captures {
                    match name(&capture, args.collection.as_ref()) {
                        Ok(object) => orders.push(order(capture, object)),
                        Err(problem) => problems.push(problem),
                    }
                }
            }
            Err(problem) => problems.push(problem),
        }
    }
    Ok((orders, problems))
}

/// The folder itself when it looks like a capture, otherwise its children that do; of a bag, those of its payload.
pub(crate) fn captures_in(path: &Path) -> Result<Vec<PathBuf>, Problem> {
    pack::check_folder(path)?;
    let path = &bag::payload(path)?;
    if pack::looks_like_capture(path) {
        return Ok(vec![path.clone()]);
    }
    let mut children: Vec<PathBuf> = std::fs::read_dir(path)?
        .filter_map(Result::ok)
        .map(|entry| entry.path())
        .filter(|child| child.is_dir())
        .collect();
    children.sort();
    let mut captures = Vec::new();
    for child in children {
        let capture = bag::payload(&child)?;
        if pack::looks_like_capture(&capture) {
            captures.push(capture);
        }
    }
    if captures.is_empty() {
        return Err(Problem::usage("neither a capture nor a folder of captures")
            .at(path.display())
            .hint("a capture has images/, sparse/ and a mesh; --object submits the folder all the same"));
    }
    Ok(captures)
}

/// `capture.toml`'s object, or the folder's name in the alphabet of object names.
fn name(capture: &Path, collection: Option<&CollectionId>) -> Result<ObjectName, Problem> {
    let written = pack::capture_toml(capture)
        .and_then(|info| info.get("object")?.as_str().map(str::to_string));
    if let Some(written) = written {
        let named: ObjectName = written.parse().map_err(|error: ign_proto::IdError| {
            Problem::usage(error.to_string()).at(capture.join("capture.toml").display())
        })?;
        return Ok(ObjectName {
            collection: collection.cloned().unwrap_or(named.collection),
            object: named.object,
        });
    }
    let Some(collection) = collection else {
        return Err(
            Problem::usage("the capture does not say which object it is")
                .at(capture.display())
                .hint("give --object C/O, --collection C, or `object` in capture.toml"),
        );
    };
    let folder = std::path::absolute(capture)?;
    let folder = folder
        .file_name()
        .map(|name| name.to_string_lossy().into_owned())
        .unwrap_or_default();
    let object = slug(&folder).parse().map_err(|error: ign_proto::IdError| {
        Problem::usage(error.to_string()).at(capture.display())
    })?;
    Ok(ObjectName {
        collection: collection.clone(),
        object,
    })
}

fn slug(folder: &str) -> String {
    let mapped: String = folder
        .chars()
        .map(|c| match c.to_ascii_lowercase() {
            c if c.is_ascii_alphanumeric() || matches!(c, '.' | '_' | '-') => c,
            _ => '-',
        })
        .collect();
    mapped
        .trim_start_matches(['.', '_', '-'])
        .trim_end_matches('-')
        .chars()
        .take(63)
        .collect()
}

/// The file of `--errors`: one row per fault, written as they are found, so that a broken run leaves them too.
struct ErrorList(Option<csv::Writer<std::fs::File>>);

/// One row of it.
#[derive(Serialize)]
struct ErrorRow<'a> {
    path: String,
    object: String,
    severity: Severity,
    message: &'a str,
    at: &'a str,
    hint: &'a str,
}

impl ErrorList {
    fn create(file: Option<&Path>) -> Result<Self, Problem> {
        let writer = file
            .map(|file| std::fs::File::create(file).doing("cannot write", file.display()))
            .transpose()?
            .map(csv::Writer::from_writer);
        Ok(Self(writer))
    }

    fn row(&mut self, row: &ErrorRow<'_>) -> Result<(), Problem> {
        let Some(writer) = &mut self.0 else {
            return Ok(());
        };
        writer.serialize(row).map_err(|error| {
            Problem::failed(format!("cannot write the list of errors: {error}"))
        })?;
        Ok(writer.flush()?)
    }

    fn problem(&mut self, order: Option<&Order>, problem: &Problem) -> Result<(), Problem> {
        self.row(&ErrorRow {
            path: order.map_or_else(String::new, |order| order.capture.display().to_string()),
            object: order.map_or_else(String::new, |order| order.object.to_string()),
            severity: Severity::Error,
            message: &problem.what,
            at: &problem.at,
            hint: &problem.hint,
        })
    }

    fn check(&mut self, check: &CheckView) -> Result<(), Problem> {
        for fault in &check.faults {
            self.row(&ErrorRow {
                path: check.path.display().to_string(),
                object: format!("{}/{}", check.collection, check.object),
                severity: fault.severity,
                message: &fault.message,
                at: &fault.at,
                hint: &fault.hint,
            })?;
        }
        Ok(())
    }
}

/// Two captures that would become the same object: one name is wrong, most likely by its case or its spaces.
fn duplicates(orders: &[Order]) -> Vec<Problem> {
    let mut seen: BTreeMap<&ObjectName, &Path> = BTreeMap::new();
    let mut problems = Vec::new();
    for order in orders {
        if let Some(first) = seen.insert(&order.object, &order.capture) {
            problems.push(
                Problem::usage(format!("two captures for {}", order.object))
                    .at(format!(
                        "{} and {}",
                        first.display(),
                        order.capture.display()
                    ))
                    .hint("give them different names, or submit them one after the other"),
            );
        }
    }
    problems
}

/// Uploads captures, several at a time, and queues their rows as they arrive; ends early only when the coordinator is
/// gone. Rows that name the same capture share its upload.
async fn submit_all(
    connection: &Connection,
    orders: &[Order],
    salt: &str,
    began: DateTime<Utc>,
    errors: &mut ErrorList,
) -> Result<(Vec<RowView>, Option<Problem>), Problem> {
    let mut captures: BTreeMap<(&Path, &CollectionId), Vec<usize>> = BTreeMap::new();
    for (index, order) in orders.iter().enumerate() {
        let at = (order.capture.as_path(), &order.object.collection);
        captures.entry(at).or_default().push(index);
    }
    // In the order of the list, so that a run that is cut off has done its beginning.
    let mut captures: Vec<Vec<usize>> = captures.into_values().collect();
    captures.sort();
    let total = captures
        .iter()
        .map(|rows| orders[rows[0]].size_bytes())
        .sum();
    let uploader = Uploader::new(connection, total);
    let (sender, uploaded) = mpsc::channel(ROWS_A_CALL);
    let uploads = async {
        // Its end, which ends the queueing, is the end of this block.
        let sender = sender;
        let captures = futures::stream::iter(captures.into_iter().map(Ok));
        let upload = async |captured: Vec<usize>| {
            let outcome = uploader.upload(&orders[captured[0]], false).await;
            for row in captured {
                sender.send((row, outcome.clone())).await?;
            }
            Ok::<(), mpsc::error::SendError<_>>(())
        };
        // Cut short when nobody queues any more.
        captures
            .try_for_each_concurrent(CAPTURES_AT_ONCE, upload)
            .await
            .ok();
    };
    let queueing = async {
        // Ends with this block, however it ends, and with it the uploads.
        let mut uploaded = uploaded;
        let mut rows: BTreeMap<usize, RowView> = BTreeMap::new();
        let mut stopped = None;
        let mut chunk = Vec::new();
        while stopped.is_none() && uploaded.recv_many(&mut chunk, ROWS_A_CALL).await > 0 {
            let chunk = std::mem::take(&mut chunk);
            for (index, outcome) in queue(&uploader, connection, orders, salt, chunk).await? {
                let order = &orders[index];
                let (outcome, job, error) = match outcome {
                    Ok(job) => {
                        // The same request returns the same job: one from before this command began is an older
                        // submit's.
                        let known = time(job.submitted_at.as_ref()).is_some_and(|at| at < began);
                        let outcome = if known { "known" } else { "submitted" };
                        uploader.say(&format!(
                            "{}/{}  {}  {outcome}, job {}",
                            rows.len() + 1,
                            orders.len(),
                            order.object,
                            short_id(&job.id)
                        ));
                        (outcome, Some(JobView::from(&job)), None)
                    }
                    Err(problem) => {
                        output::problem(&problem.clone().context(order.object.to_string()));
                        errors.problem(Some(order), &problem)?;
                        let what = problem.what.clone();
                        if problem.exit == Exit::Unreachable {
                            stopped.get_or_insert(problem);
                        }
                        ("error", None, Some(what))
                    }
                };
                let row = RowView {
                    path: order.capture.clone(),
                    collection: order.object.collection.to_string(),
                    object: order.object.object.to_string(),
                    outcome,
                    job,
                    error,
                };
                rows.insert(index, row);
            }
        }
        Ok((rows.into_values().collect(), stopped))
    };
    let ((), queued) = tokio::join!(uploads, queueing);
    queued
}

type Outcome = Result<v1::Job, Problem>;

/// Queues rows whose captures were uploaded. Where the registry names a capture whose files have gone, they are sent again.
async fn queue(
    uploader: &Uploader<'_>,
    connection: &Connection,
    orders: &[Order],
    salt: &str,
    uploaded: Vec<(usize, Result<Digest, Problem>)>,
) -> Result<Vec<(usize, Outcome)>, Problem> {
    let request = |index: usize, capture: &Digest| -> Result<v1::SubmitRequest, Problem> {
        let spec = upload::spec(&orders[index], capture)?;
        Ok(v1::SubmitRequest {
            request_id: upload::request_id(&spec, salt),
            spec: Some(spec),
        })
    };
    let (mut outcomes, mut waiting, mut requests) = (Vec::new(), Vec::new(), Vec::new());
    for (index, capture) in uploaded {
        match capture {
            Ok(capture) => {
                requests.push(request(index, &capture)?);
                waiting.push(index);
            }
            Err(problem) => outcomes.push((index, Err(problem))),
        }
    }
    if requests.is_empty() {
        return Ok(outcomes);
    }
    let answers = match upload::submit_all(connection, requests).await {
        Ok(answers) => answers,
        Err(problem) => {
            outcomes.extend(
                waiting
                    .into_iter()
                    .map(|index| (index, Err(problem.clone()))),
            );
            return Ok(outcomes);
        }
    };
    for (index, answer) in waiting.into_iter().zip(answers) {
        let outcome = match answer {
            Ok(job) => Ok(job),
            Err(refused) if refused.capture_is_missing => {
                let again = async {
                    let capture = uploader.upload(&orders[index], true).await?;
                    let v1::SubmitRequest { request_id, spec } = request(index, &capture)?;
                    upload::submit(connection, spec.unwrap_or_default(), request_id).await
                };
                again.await
            }
            Err(refused) => Err(refused.problem),
        };
        outcomes.push((index, outcome));
    }
    Ok(outcomes)
}

fn table(rows: &[RowView]) -> String {
    let jobs = || rows.iter().filter_map(|row| row.job.as_ref());
    let ids = ShortIds::of(jobs().map(|job| job.id.as_str()));
    let mut table = Table::new(&["CAPTURE", "OBJECT", "OUTCOME", "JOB", "STATE", "NOTE"]);
    for row in rows {
        let job = row.job.as_ref();
        table.row([
            row.path.display().to_string(),
            format!("{}/{}", row.collection, row.object),
            row.outcome.to_string(),
            job.map_or_else(|| "-".to_string(), |job| ids.show(&job.id)),
            job.map_or("-", |job| job.state_for_people()).to_string(),
            row.error
                .clone()
                .or_else(|| job.map(JobView::note))
                .unwrap_or_default(),
        ]);
    }
    table.to_string()
}

async fn dry_run(
    context: &Context,
    orders: Vec<Order>,
    errors: &mut ErrorList,
) -> Result<(), Problem> {
    let total = orders.len();
    let at_once = std::thread::available_parallelism().map_or(2, usize::from);
    // Rows that name one capture share its check.
    let mut captures: BTreeMap<_, Vec<usize>> = BTreeMap::new();
    for (index, order) in orders.iter().enumerate() {
        let recipe = &order.recipe;
        let at = (order.capture.clone(), recipe.size, recipe.budget_secs);
        captures.entry(at).or_default().push(index);
    }
    let mut captures: Vec<_> = captures.into_iter().collect();
    captures.sort_by_key(|(_, rows)| rows[0]);
    let mut checking = futures::stream::iter(captures)
        .map(|((capture, size, budget_secs), rows)| async move {
            let options = PreflightOptions {
                proxy: None,
                size,
                budget_secs: budget_secs.map(|secs| secs as f64),
            };
            Ok::<_, Problem>((rows, preflight::examine(capture, options).await?))
        })
        .buffered(at_once);
    let mut checks: BTreeMap<usize, CheckView> = BTreeMap::new();
    while let Some(checked) = checking.next().await {
        let (rows, report) = checked?;
        for row in rows {
            let check = check_view(&orders[row], report.clone());
            errors.check(&check)?;
            checks.insert(row, check);
            if total <= 100 || row % 100 == 0 {
                let path = orders[row].capture.display();
                output::note(&format!("{}/{total}  checked {path}", checks.len()));
            }
        }
    }
    let checks: Vec<CheckView> = checks.into_values().collect();
    output::data(context.format, &checks, || check_table(&checks))?;
    let bad = checks.iter().filter(|check| !check.ok).count();
    if bad > 0 {
        return Err(Problem::failed(format!(
            "{bad} of {total} captures would fail"
        )));
    }
    Ok(())
}

fn check_view(order: &Order, report: Preflight) -> CheckView {
    let counts = report.findings.as_ref().map(|findings| &findings.counts);
    CheckView {
        path: order.capture.clone(),
        collection: order.object.collection.to_string(),
        object: order.object.object.to_string(),
        ok: report.ok,
        train_views: counts.map(|counts| counts.train),
        held_out_views: counts.map(|counts| counts.held_out),
        triangles: counts.map(|counts| counts.triangles),
        faults: report.faults,
        findings: report.findings,
    }
}

fn check_table(checks: &[CheckView]) -> String {
    let mut table = Table::new(&[
        "CAPTURE",
        "OBJECT",
        "STATE",
        ">TRAIN",
        ">HELD OUT",
        ">ERRORS",
        ">WARNINGS",
    ]);
    let count = |check: &CheckView, severity| {
        check
            .faults
            .iter()
            .filter(|fault| fault.severity == severity)
            .count()
    };
    let figure =
        |value: Option<usize>| value.map_or_else(|| "-".to_string(), |value| value.to_string());
    for check in checks {
        table.row([
            check.path.display().to_string(),
            format!("{}/{}", check.collection, check.object),
            if check.ok { "ok" } else { "failed" }.to_string(),
            figure(check.train_views),
            figure(check.held_out_views),
            count(check, Severity::Error).to_string(),
            count(check, Severity::Warning).to_string(),
        ]);
    }
    let faults = checks
        .iter()
        .filter(|check| !check.faults.is_empty())
        .map(fault_list);
    std::iter::once(table.to_string()).chain(faults).collect()
}

fn fault_list(check: &CheckView) -> String {
    let capture = output::printable(&check.path.display().to_string());
    format!("\n{capture}\n{}", preflight::faults(&check.faults))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn capture(parent: &Path, name: &str) -> PathBuf {
        let dir = parent.join(name);
        std::fs::create_dir_all(dir.join("images")).unwrap();
        dir
    }

    #[test]
    fn folders_become_object_names() {
        let collection: CollectionId = "museum".parse().unwrap();
        let dir = tempfile::tempdir().unwrap();
        let named = |folder: &str| {
            name(&capture(dir.path(), folder), Some(&collection)).map(|name| name.to_string())
        };
        assert_eq!(named("Vase 12").unwrap(), "museum/vase-12");
        assert_eq!(named("_Büste").unwrap(), "museum/b-ste");
        assert_eq!(named("---").unwrap_err().exit, Exit::Usage);
        let written = capture(dir.path(), "x");
        std::fs::write(written.join("capture.toml"), "object = \"greek/krater\"\n").unwrap();
        assert_eq!(name(&written, None).unwrap().to_string(), "greek/krater");
        assert_eq!(
            name(&written, Some(&collection)).unwrap().to_string(),
            "museum/krater"
        );
        assert_eq!(
            name(&capture(dir.path(), "y"), None).unwrap_err().exit,
            Exit::Usage
        );
    }

    #[test]
    fn a_folder_of_captures_gives_its_children() {
        let dir = tempfile::tempdir().unwrap();
        let empty = captures_in(dir.path()).unwrap_err();
        assert_eq!(empty.exit, Exit::Usage);
        let (b, a) = (capture(dir.path(), "b"), capture(dir.path(), "a"));
        std::fs::create_dir(dir.path().join("notes")).unwrap();
        assert_eq!(captures_in(dir.path()).unwrap(), [a.clone(), b]);
        assert_eq!(captures_in(&a).unwrap(), [a]);
    }

    #[test]
    fn names_that_differ_only_by_case_are_caught() {
        let dir = tempfile::tempdir().unwrap();
        let collection: CollectionId = "museum".parse().unwrap();
        let recipe = serde_json::from_str(
            r#"{"preset":"standard","size":256,"crop":"object","seed":0,"budget_secs":null,"proxy":null,"settings":{}}"#,
        );
        let recipe: crate::recipe::Recipe = recipe.unwrap();
        let orders: Vec<Order> = ["Vase", "vase"]
            .map(|folder| {
                let capture = capture(dir.path(), folder);
                Order {
                    object: name(&capture, Some(&collection)).unwrap(),
                    capture,
                    proxy: None,
                    recipe: recipe.clone(),
                    priority: 0,
                    labels: BTreeMap::new(),
                }
            })
            .into();
        assert_eq!(duplicates(&orders).len(), 1);
    }

    #[test]
    fn a_dry_run_lists_every_fault() {
        let fault = |severity, message: &str| Fault {
            severity,
            message: message.into(),
            at: "sparse/0/cameras.txt:7".into(),
            hint: "re-export with PINHOLE".into(),
        };
        let check = |ok: bool, faults| CheckView {
            path: "captures/vase".into(),
            collection: "museum".into(),
            object: "vase".into(),
            ok,
            train_views: ok.then_some(120),
            held_out_views: ok.then_some(24),
            triangles: ok.then_some(5000),
            faults,
            findings: None,
        };
        insta::assert_snapshot!(check_table(&[
            check(true, vec![]),
            check(
                false,
                vec![
                    fault(Severity::Error, "camera 3 has zero focal length"),
                    fault(Severity::Warning, "view a.jpg has no mask"),
                ]
            ),
        ]));
    }
}
