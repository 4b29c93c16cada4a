//! `admin rebuild-registry|gc|audit|events`: the registry as a whole.
//!
//! A collection of garbage shows first what it would do, and does it only when somebody says yes.

use std::io::IsTerminal as _;
use std::time::Duration;

use chrono::{DateTime, Utc};
use ign_proto::v1;
use serde::Serialize;

use crate::Context;
use crate::commands::jobs::duration;
use crate::connection::Connection;
use crate::output::{self, Table, bytes};
use crate::problem::{Exit, Problem};
use crate::views::time;

/// `admin ...`.
#[derive(Debug, clap::Subcommand)]
pub(crate) enum Command {
    /// Take over versions that the bucket records and the database does not know
    RebuildRegistry,
    /// Delete files that no published version, live job or running upload names
    Gc(GcArgs),
    /// Read every digest again; repair from the replica where the coordinator has one
    Audit,
    /// What happened to the registry, newest first
    Events {
        /// At most this many
        #[arg(long, value_name = "N", default_value_t = 100)]
        limit: u32,
    },
}

/// Arguments of `admin gc`.
#[derive(Debug, clap::Args)]
pub(crate) struct GcArgs {
    /// Only show what would be done
    #[arg(long)]
    dry_run: bool,
    /// How long unnamed files stay, and then again in the trash: 7d, 12h; at least 1h
    #[arg(long, value_name = "TIME", default_value = "7d", value_parser = duration)]
    grace: Duration,
    /// Do not ask
    #[arg(long)]
    yes: bool,
}

#[derive(Debug, Serialize)]
struct FaultView {
    path: String,
    reason: String,
    outcome: Option<String>,
}

#[derive(Debug, Serialize)]
struct RebuildView {
    added: u64,
    known: u64,
    faults: Vec<FaultView>,
}

#[derive(Clone, Copy, Debug, Serialize)]
struct TallyView {
    objects: u64,
    bytes: u64,
}

#[derive(Debug, Serialize)]
struct GcView {
    dry_run: bool,
    named: TallyView,
    young: TallyView,
    trashed: TallyView,
    waiting: TallyView,
    rescued: TallyView,
    deleted: TallyView,
}

#[derive(Debug, Serialize)]
struct AuditView {
    read: TallyView,
    faults: Vec<FaultView>,
}

#[derive(Debug, Serialize)]
struct EventView {
    seq: u64,
    at: Option<DateTime<Utc>>,
    kind: String,
    subject: Option<String>,
    message: String,
}

impl From<v1::RegistryFault> for FaultView {
    fn from(fault: v1::RegistryFault) -> Self {
        Self {
            path: fault.path,
            reason: fault.reason,
            outcome: (!fault.outcome.is_empty()).then_some(fault.outcome),
        }
    }
}

impl From<Option<v1::Tally>> for TallyView {
    fn from(tally: Option<v1::Tally>) -> Self {
        let v1::Tally { objects, bytes } = tally.unwrap_or_default();
        Self { objects, bytes }
    }
}

pub(crate) async fn run(context: &Context, command: &Command) -> Result<(), Problem> {
    let connection = Connection::open(&context.connection).await?;
    match command {
        Command::RebuildRegistry => rebuild(context, &connection).await,
        Command::Gc(args) => collect(context, &connection, args).await,
        Command::Audit => audit(context, &connection).await,
        Command::Events { limit } => events(context, &connection, *limit).await,
    }
}

async fn rebuild(context: &Context, connection: &Connection) -> Result<(), Problem> {
    let request = v1::RebuildRegistryRequest {};
    let rebuilt = connection
        .admin()
        .rebuild_registry(request)
        .await?
        .into_inner();
    let view = RebuildView {
        added: rebuilt.added,
        known: rebuilt.known,
        faults: rebuilt.faults.into_iter().map(FaultView::from).collect(),
    };
    output::data(context.format, &view, || {
        format!(
            "{} versions taken over, {} known already\n{}",
            view.added,
            view.known,
            faults(&view.faults)
        )
    })?;
    sound(&view.faults)
}

async fn collect(context: &Context, connection: &Connection, args: &GcArgs) -> Result<(), Problem> {
    let ask = async |dry_run| -> Result<GcView, Problem> {
        let request = v1::CollectGarbageRequest {
            dry_run,
            grace_secs: args.grace.as_secs_f64(),
        };
        let collected = connection
            .admin()
            .collect_garbage(request)
            .await?
            .into_inner();
        Ok(GcView {
            dry_run,
            named: collected.named.into(),
            young: collected.young.into(),
            trashed: collected.trashed.into(),
            waiting: collected.waiting.into(),
            rescued: collected.rescued.into(),
            deleted: collected.deleted.into(),
        })
    };
    let mut view = ask(true).await?;
    if !args.dry_run {
        if !args.yes && !confirmed(&view)? {
            return Err(Problem::failed("nothing was collected").hint("--yes does not ask"));
        }
        view = ask(false).await?;
    }
    output::data(context.format, &view, || gc_text(&view))
}

/// Shows what would be done and asks; no without a terminal.
fn confirmed(view: &GcView) -> Result<bool, Problem> {
    output::note(gc_text(view).trim_end());
    if !std::io::stdin().is_terminal() {
        return Ok(false);
    }
    output::note("type yes to do this:");
    let mut answer = String::new();
    std::io::stdin().read_line(&mut answer)?;
    Ok(answer.trim() == "yes")
}

fn gc_text(view: &GcView) -> String {
    let mut table = Table::new(&["", ">FILES", ">SIZE"]);
    let would = |done: &str, will: &str| if view.dry_run { will } else { done }.to_string();
    let rows = [
        ("named: stays".to_string(), view.named),
        ("not named, but young: stays".to_string(), view.young),
        (
            would("moved to the trash", "would move to the trash"),
            view.trashed,
        ),
        ("in the trash: stays for now".to_string(), view.waiting),
        (
            would(
                "taken back from the trash",
                "would be taken back from the trash",
            ),
            view.rescued,
        ),
        (
            would("deleted from the trash", "would be deleted from the trash"),
            view.deleted,
        ),
    ];
    for (what, tally) in rows {
        table.row([what, tally.objects.to_string(), bytes(tally.bytes)]);
    }
    table.to_string()
}

async fn audit(context: &Context, connection: &Connection) -> Result<(), Problem> {
    let request = v1::AuditRegistryRequest {};
    let audit = connection
        .admin()
        .audit_registry(request)
        .await?
        .into_inner();
    let view = AuditView {
        read: audit.read.into(),
        faults: audit.faults.into_iter().map(FaultView::from).collect(),
    };
    output::data(context.format, &view, || {
        format!(
            "{} files read, {}, {} faults\n{}",
            view.read.objects,
            bytes(view.read.bytes),
            view.faults.len(),
            faults(&view.faults)
        )
    })?;
    sound(&view.faults)
}

async fn events(context: &Context, connection: &Connection, limit: u32) -> Result<(), Problem> {
    let request = v1::ListEventsRequest {
        before_seq: 0,
        limit,
    };
    let events = connection.admin().list_events(request).await?.into_inner();
    let views: Vec<EventView> = events
        .events
        .into_iter()
        .map(|event| EventView {
            seq: event.seq,
            at: time(event.at.as_ref()),
            kind: event.kind,
            subject: (!event.subject.is_empty()).then_some(event.subject),
            message: event.message,
        })
        .collect();
    output::data(context.format, &views, || {
        let mut table = Table::new(&["AT", "KIND", "ABOUT", "WHAT"]);
        for event in &views {
            let at = event
                .at
                .map(|at| at.format("%Y-%m-%d %H:%M:%S").to_string());
            table.row([
                at.unwrap_or_default(),
                event.kind.clone(),
                event.subject.clone().unwrap_or_default(),
                event.message.clone(),
            ]);
        }
        table.to_string()
    })
}

fn faults(faults: &[FaultView]) -> String {
    if faults.is_empty() {
        return String::new();
    }
    let mut table = Table::new(&["PATH", "FAULT", "NOW"]);
    for fault in faults {
        table.row([
            fault.path.clone(),
            fault.reason.clone(),
            fault.outcome.clone().unwrap_or_default(),
        ]);
    }
    table.to_string()
}

/// Fails unless every fault was repaired.
fn sound(faults: &[FaultView]) -> Result<(), Problem> {
    let left = |fault: &&FaultView| fault.outcome.as_deref() != Some("repaired");
    match faults.iter().filter(left).count() {
        0 => Ok(()),
        _ => Err(Problem::said(Exit::Failed)),
    }
}
