//! `collections`: shares of the workers, limits, pause.

use ign_proto::{CollectionId, v1};
use serde::Serialize;

use crate::Context;
use crate::connection::Connection;
use crate::output::{self, Table};
use crate::problem::Problem;

/// `collections list|set|pause|resume`.
#[derive(Debug, clap::Subcommand)]
pub(crate) enum Command {
    /// List the collections with their shares and limits
    List,
    /// Set a collection's share or limit
    Set {
        /// Collection
        name: CollectionId,
        /// Share of the workers relative to other collections
        #[arg(long, value_name = "X")]
        weight: Option<f64>,
        /// Jobs that run at the same time at most; 0 for no limit
        #[arg(long, value_name = "N")]
        max_running: Option<u32>,
    },
    /// Start no more jobs of a collection; what runs goes on
    Pause {
        /// Collection
        name: CollectionId,
    },
    /// Start jobs of a collection again
    Resume {
        /// Collection
        name: CollectionId,
    },
}

/// A collection, as `-o json` writes it.
#[derive(Debug, Serialize)]
struct CollectionView {
    name: String,
    weight: f64,
    /// None for no limit.
    max_running: Option<u32>,
    paused: bool,
}

impl From<&v1::Collection> for CollectionView {
    fn from(wire: &v1::Collection) -> Self {
        Self {
            name: wire.name.clone(),
            weight: wire.weight,
            max_running: (wire.max_running > 0).then_some(wire.max_running),
            paused: wire.paused,
        }
    }
}

pub(crate) async fn run(context: &Context, command: &Command) -> Result<(), Problem> {
    let connection = Connection::open(&context.connection).await?;
    let views = match command {
        Command::List => list(&connection).await?,
        Command::Set {
            name,
            weight,
            max_running,
        } => {
            if weight.is_none() && max_running.is_none() {
                return Err(Problem::usage("nothing to set").hint("give --weight or --max-running"));
            }
            let change = |collection: &mut v1::Collection| {
                collection.weight = weight.unwrap_or(collection.weight);
                collection.max_running = max_running.unwrap_or(collection.max_running);
            };
            vec![set(&connection, name, change).await?]
        }
        Command::Pause { name } => vec![set(&connection, name, |c| c.paused = true).await?],
        Command::Resume { name } => vec![set(&connection, name, |c| c.paused = false).await?],
    };
    let views: Vec<CollectionView> = views.iter().map(CollectionView::from).collect();
    output::data(context.format, &views, || table(&views))
}

async fn list(connection: &Connection) -> Result<Vec<v1::Collection>, Problem> {
    let request = v1::ListCollectionsRequest {};
    let answer = connection.collections().list(request).await?;
    Ok(answer.into_inner().collections)
}

/// Changes one collection and keeps the rest of it; one that has no job yet may be set up before its first.
async fn set(
    connection: &Connection,
    name: &CollectionId,
    change: impl FnOnce(&mut v1::Collection),
) -> Result<v1::Collection, Problem> {
    let mut collection = list(connection)
        .await?
        .into_iter()
        .find(|collection| collection.name == name.as_str())
        .unwrap_or_else(|| v1::Collection {
            name: name.to_string(),
            weight: 1.0,
            max_running: 0,
            paused: false,
        });
    change(&mut collection);
    Ok(connection.collections().set(collection).await?.into_inner())
}

fn table(collections: &[CollectionView]) -> String {
    let mut table = Table::new(&["COLLECTION", ">WEIGHT", ">MAX RUNNING", "STATE"]);
    for collection in collections {
        table.row([
            collection.name.clone(),
            output::number(collection.weight),
            collection
                .max_running
                .map_or_else(|| "-".to_string(), |count| count.to_string()),
            if collection.paused { "paused" } else { "ok" }.to_string(),
        ]);
    }
    table.to_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shares_limits_and_pauses_in_columns() {
        let view = |name: &str, max_running, paused| CollectionView {
            name: name.into(),
            weight: 1.0,
            max_running,
            paused,
        };
        insta::assert_snapshot!(table(&[
            view("museum", None, false),
            view("loans", Some(2), true)
        ]), @r"
        COLLECTION  WEIGHT  MAX RUNNING  STATE
        museum        1.00            -  ok
        loans         1.00            2  paused
        ");
    }
}
