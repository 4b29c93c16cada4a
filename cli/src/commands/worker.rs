//! `worker list|drain|undrain`: who works, and who takes no more jobs.

use chrono::Utc;
use ign_proto::{WorkerId, v1};

use crate::Context;
use crate::commands::status;
use crate::connection::Connection;
use crate::output;
use crate::problem::Problem;
use crate::views::{ShortIds, WorkerView};

/// `worker ...`.
#[derive(Debug, clap::Subcommand)]
pub(crate) enum Command {
    /// List the workers that were seen within the last hour
    List,
    /// Let workers finish what they run and give them no more
    Drain(Which),
    /// Give drained workers jobs again
    Undrain(Which),
}

/// Which workers.
#[derive(Debug, clap::Args)]
#[group(required = true, multiple = false)]
pub(crate) struct Which {
    /// Names of workers
    #[arg(value_name = "NAME")]
    names: Vec<WorkerId>,
    /// All that were seen within the last hour
    #[arg(long)]
    all: bool,
}

pub(crate) async fn run(context: &Context, command: &Command) -> Result<(), Problem> {
    let connection = Connection::open(&context.connection).await?;
    let workers = match command {
        Command::List => {
            let request = v1::StatusRequest::default();
            connection
                .jobs()
                .status(request)
                .await?
                .into_inner()
                .workers
        }
        Command::Drain(which) => drain(&connection, which, true).await?,
        Command::Undrain(which) => drain(&connection, which, false).await?,
    };
    let views: Vec<WorkerView> = workers.iter().map(WorkerView::from).collect();
    output::data(context.format, &views, || table(&views))
}

async fn drain(
    connection: &Connection,
    which: &Which,
    draining: bool,
) -> Result<Vec<v1::Worker>, Problem> {
    let request = v1::DrainWorkersRequest {
        worker_ids: which.names.iter().map(ToString::to_string).collect(),
        draining,
    };
    let answer = connection.admin().drain_workers(request).await?;
    Ok(answer.into_inner().workers)
}

fn table(views: &[WorkerView]) -> String {
    let ids = ShortIds::of(views.iter().flat_map(WorkerView::jobs));
    status::workers(views, &ids, Utc::now()).map_or_else(
        || "no worker is connected\n".to_owned(),
        |table| table.to_string(),
    )
}
