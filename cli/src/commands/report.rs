//! `report COLLECTION`: one page on a whole collection: which objects are good, which stand out, what to photograph again.
//!
//! It reads the figures and the thumbnail of each object's latest bundle, checked against their digests, and nothing
//! else of it. The page is written whole or not at all.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};

use chrono::Utc;
use futures::{StreamExt as _, TryStreamExt as _};
use ign_bundle::report::{
    CollectionInput, CollectionObject, Need, Ranked, WithoutBundle, rank, render_collection,
};
use ign_bundle::{METRICS_FILE, Metrics, THUMBNAIL_FILE};
use ign_proto::{CollectionId, ObjectName, v1};
use serde::Serialize;

use crate::Context;
use crate::commands::jobs::{Query, list_all};
use crate::connection::Connection;
use crate::output::{self, Live, Table, number};
use crate::problem::{Doing as _, Problem};
use crate::results::Files;
use crate::upload::TRANSFERS_AT_ONCE;
use crate::views::{BundleView, JobView};

/// `report ...`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// The collection
    collection: CollectionId,
    /// Where to write the page [default: COLLECTION-report.html]
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
}

/// What programs get.
#[derive(Debug, Serialize)]
struct ReportView {
    collection: String,
    report: PathBuf,
    objects: Vec<Ranked>,
    without_bundle: Vec<WithoutBundle>,
}

pub(crate) async fn run(context: &Context, args: &Args) -> Result<(), Problem> {
    let collection = args.collection.to_string();
    let out = args
        .out
        .clone()
        .unwrap_or_else(|| PathBuf::from(format!("{collection}-report.html")));
    let connection = Connection::open(&context.connection).await?;
    let request = v1::ListBundlesRequest {
        collection: collection.clone(),
        ..Default::default()
    };
    let listed = connection.bundles().list(request).await?.into_inner();
    let latest = latest(&listed.bundles);
    let without_bundle = without_bundle(&connection, &args.collection, &latest).await?;
    if latest.is_empty() && without_bundle.is_empty() {
        return Err(Problem::failed("the collection has no bundle and no job")
            .at(&collection)
            .hint("ignctl collections list names the collections there are"));
    }
    let objects = fetch_all(&connection, &latest).await?;
    let objects_ranked = rank(&objects);
    let made_at = Utc::now().format("Made %Y-%m-%d %H:%M UTC.").to_string();
    let page = render_collection(
        &CollectionInput {
            collection: &collection,
            objects: &objects,
            without: &without_bundle,
            made_at: &made_at,
        },
        &objects_ranked,
    );
    write(&out, &page)?;
    let view = ReportView {
        collection,
        report: out,
        objects: objects_ranked,
        without_bundle,
    };
    output::data(context.format, &view, || table(&view))
}

/// The latest version of each object.
fn latest(bundles: &[v1::BundleVersion]) -> Vec<BundleView> {
    let mut views: Vec<BundleView> = bundles.iter().map(BundleView::from).collect();
    views.sort_by(|a, b| a.object.cmp(&b.object).then(b.version.cmp(&a.version)));
    views.dedup_by(|later, kept| later.object == kept.object);
    views
}

/// Objects that were submitted and have no bundle, with what became of their last job.
async fn without_bundle(
    connection: &Connection,
    collection: &CollectionId,
    bundles: &[BundleView],
) -> Result<Vec<WithoutBundle>, Problem> {
    let query = Query::of(collection.clone());
    let mut known: BTreeSet<String> = bundles.iter().map(|b| b.object.clone()).collect();
    let mut without = Vec::new();
    // Newest first: the first job of an object is its last one.
    for job in list_all(connection, &query)
        .await?
        .iter()
        .map(JobView::from)
    {
        if known.insert(job.object.clone()) {
            let reason = job
                .failure
                .map_or_else(String::new, |failure| match failure.hint {
                    Some(hint) => format!("{}: {hint}", failure.message),
                    None => failure.message,
                });
            without.push(WithoutBundle {
                object: job.object,
                state: job.state.to_string(),
                reason,
            });
        }
    }
    without.sort_by(|a, b| a.object.cmp(&b.object));
    Ok(without)
}

/// Figures and thumbnails of all bundles, several at once.
async fn fetch_all(
    connection: &Connection,
    bundles: &[BundleView],
) -> Result<Vec<CollectionObject>, Problem> {
    let folder = tempfile::tempdir().doing("cannot make", "a folder for downloads")?;
    let live = Live::percent();
    let read = AtomicUsize::new(0);
    let (live, read, dir) = (&live, &read, folder.path());
    futures::stream::iter(bundles.iter().enumerate())
        .map(|(at, bundle)| async move {
            let object = fetch(connection, bundle, &dir.join(at.to_string()))
                .await
                .map_err(|problem| problem.context(bundle.name()))?;
            let (done, all) = (read.fetch_add(1, Ordering::Relaxed) + 1, bundles.len());
            let percent = 100.0 * done as f64 / all as f64;
            live.set("reading", percent, &format!("{done} of {all} bundles"));
            Ok(object)
        })
        .buffered(TRANSFERS_AT_ONCE)
        .try_collect()
        .await
}

async fn fetch(
    connection: &Connection,
    bundle: &BundleView,
    file: &Path,
) -> Result<CollectionObject, Problem> {
    let object: ObjectName = bundle
        .name()
        .parse()
        .map_err(|error| Problem::failed(format!("the object's name is malformed: {error}")))?;
    let digest = bundle
        .digest
        .parse()
        .map_err(|error| Problem::failed(format!("the bundle's digest is malformed: {error}")))?;
    let files = Files::of(connection, &object, &digest).await?;
    let metrics = files
        .read(connection, &object, METRICS_FILE, file)
        .await?
        .ok_or_else(|| Problem::failed(format!("the bundle has no {METRICS_FILE}")))?;
    let metrics: Metrics = serde_json::from_slice(&metrics)
        .map_err(|error| Problem::failed(format!("not this schema: {error}")).at(METRICS_FILE))?;
    Ok(CollectionObject {
        object: bundle.object.clone(),
        version: bundle.version,
        size_bytes: bundle.size_bytes,
        metrics,
        thumbnail: files
            .read(connection, &object, THUMBNAIL_FILE, file)
            .await?,
    })
}

/// Writes the page beside its place, then moves it there.
fn write(out: &Path, page: &str) -> Result<(), Problem> {
    let folder = match out.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    };
    let beside = tempfile::Builder::new()
        .permissions(std::os::unix::fs::PermissionsExt::from_mode(0o644))
        .tempfile_in(folder)
        .doing("cannot write in", folder.display())?;
    std::fs::write(beside.path(), page).doing("cannot write", beside.path().display())?;
    beside
        .persist(out)
        .map_err(|error| error.error)
        .doing("cannot write", out.display())?;
    Ok(())
}

fn table(view: &ReportView) -> String {
    let mut table = Table::new(&[
        "OBJECT",
        "VERSION",
        "STATE",
        ">MSE",
        ">OF BEST OTHER",
        "WHY",
    ]);
    for object in &view.objects {
        let state = match object.need {
            Need::Retake => "retake",
            Need::Look => "look",
            Need::Nothing => "good",
        };
        let dash = || "-".to_string();
        table.row([
            object.object.clone(),
            format!("v{}", object.version),
            state.to_string(),
            object.mse.map_or_else(dash, number),
            object
                .of_baseline
                .map_or_else(dash, |share| format!("{:.0}%", 100.0 * share)),
            object.reasons.join(" "),
        ]);
    }
    for object in &view.without_bundle {
        table.row([
            object.object.clone(),
            "-".to_string(),
            object.state.clone(),
            "-".to_string(),
            "-".to_string(),
            object.reason.clone(),
        ]);
    }
    format!("{table}\nreport: {}\n", view.report.display())
}
