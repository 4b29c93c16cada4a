//! The steps of the schema, built into the program: `migrations/DIALECT/NAME.up.sql` and `.down.sql`, see the README there.

use sqlx::SqlSafeStr as _;
use sqlx::migrate::{Migration, MigrationType, Migrator};

/// A step's name, `0001_name`, with what goes up and what goes down again.
type Step = (&'static str, [&'static str; 2]);

macro_rules! steps {
    ($dialect:literal: $($name:literal),+) => {
        [$(($name, [
            include_str!(concat!("../../../migrations/", $dialect, "/", $name, ".up.sql")),
            include_str!(concat!("../../../migrations/", $dialect, "/", $name, ".down.sql")),
        ])),+]
    };
}

/// All steps; both dialects have the same.
macro_rules! schema {
    ($dialect:literal) => {
        steps!(
            $dialect: "0001_queue",
            "0002_registry",
            "0010_tokens",
            "0021_lease_holders",
            "0022_webhooks",
            "0023_traces",
            "0024_fewer_indexes"
        )
    };
}

/// Postgres's schema.
pub fn postgres() -> Migrator {
    migrator(&schema!("postgres"))
}

/// `SQLite`'s schema.
pub fn sqlite() -> Migrator {
    migrator(&schema!("sqlite"))
}

/// A schema that is ahead, because a newer coordinator was here, is worked with: each step leaves the program before it
/// working.
fn migrator(steps: &[Step]) -> Migrator {
    let migrations = steps.iter().flat_map(|(name, texts)| {
        let (number, title) = name.split_once('_').unwrap_or((name, ""));
        let number = number
            .parse()
            .expect("a step's name starts with its number");
        let types = [MigrationType::ReversibleUp, MigrationType::ReversibleDown];
        types.into_iter().zip(texts).map(move |(up_or_down, text)| {
            let title = title.replace('_', " ");
            Migration::new(number, title.into(), up_or_down, text.into_sql_str(), false)
        })
    });
    let mut migrator = Migrator::with_migrations(migrations.collect());
    migrator.set_ignore_missing(true);
    migrator
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    #[test]
    fn every_file_of_a_dialect_is_built_in_under_a_number_of_its_own() {
        for (dialect, steps) in [
            ("postgres", schema!("postgres")),
            ("sqlite", schema!("sqlite")),
        ] {
            let folder = format!("{}/../../migrations/{dialect}", env!("CARGO_MANIFEST_DIR"));
            let files: BTreeSet<String> = std::fs::read_dir(folder)
                .unwrap()
                .map(|entry| entry.unwrap().file_name().into_string().unwrap())
                .collect();
            let built_in = steps
                .iter()
                .flat_map(|(name, _)| ["up", "down"].map(|way| format!("{name}.{way}.sql")))
                .collect();
            assert_eq!(files, built_in, "{dialect}");
            let number = |step: &Step| step.0.split_once('_').unwrap().0;
            assert!(steps.is_sorted_by(|a, b| number(a) < number(b)));
        }
    }
}
