//! `bundle list|show|fetch|verify|tag|retire|restore`: versions of model bundles.
//!
//! A bundle is named `collection/object`, with `:v3`, `:latest` or `@sha256:...` behind it where another than the
//! latest is meant.

use std::path::PathBuf;
use std::str::FromStr;

use chrono::Utc;
use ign_proto::{Digest, ObjectName, v1};
use serde::Serialize;

use crate::Context;
use crate::connection::Connection;
use crate::output::{self, Table, age, bytes, number};
use crate::problem::Problem;
use crate::results::{self, Files, Staging, method_rows, method_table};
use crate::views::BundleView;

/// `bundle ...`.
#[derive(Debug, clap::Subcommand)]
pub(crate) enum Command {
    /// List versions
    List {
        /// Only this collection (C) or object (C/O)
        #[arg(value_name = "C[/O]")]
        of: Option<String>,
        /// Retired versions too
        #[arg(long)]
        retired: bool,
    },
    /// Show a version with its figures
    Show {
        /// C/O, C/O:v3, C/O:approved or C/O@sha256:...
        bundle: BundleRef,
    },
    /// Download a version, checking every digest
    Fetch {
        /// C/O, C/O:v3, C/O:approved or C/O@sha256:...
        bundle: BundleRef,
        /// Folder for its files [default: OBJECT-VERSION]
        #[arg(long, value_name = "DIR")]
        out: Option<PathBuf>,
    },
    /// Check a folder, or what the server holds, against its digests
    Verify {
        /// A bundle folder, or C/O, C/O:v3 ...
        bundle: String,
    },
    /// Point an alias at a version
    Tag {
        /// C/O, C/O:v3 or C/O@sha256:...
        bundle: BundleRef,
        /// Alias, such as approved
        alias: String,
    },
    /// Take a version out of listings; its files stay for the grace of the next collections
    Retire {
        /// C/O:v3 or C/O@sha256:...
        bundle: BundleRef,
    },
    /// Put a retired version back into listings
    Restore {
        /// C/O:v3 or C/O@sha256:...
        bundle: BundleRef,
    },
}

/// An object and which of its versions.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct BundleRef {
    object: ObjectName,
    /// Empty means the latest.
    reference: String,
}

impl FromStr for BundleRef {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (object, reference) = match text.find(['@', ':']) {
            Some(at) => (&text[..at], &text[at + 1..]),
            None => (text, ""),
        };
        if object.len() < text.len() && reference.is_empty() {
            return Err("no version after the colon".to_string());
        }
        Ok(Self {
            object: object
                .parse()
                .map_err(|error: ign_proto::IdError| error.to_string())?,
            reference: reference.to_string(),
        })
    }
}

impl BundleRef {
    fn request(&self) -> v1::GetBundleRequest {
        v1::GetBundleRequest {
            object: Some((&self.object).into()),
            reference: self.reference.clone(),
        }
    }

    async fn get(&self, connection: &Connection) -> Result<v1::BundleVersion, Problem> {
        Ok(connection.bundles().get(self.request()).await?.into_inner())
    }
}

/// What a check found.
#[derive(Debug, Serialize)]
struct VerifyView {
    bundle: String,
    files: usize,
    size_bytes: u64,
    verified: bool,
}

pub(crate) async fn run(context: &Context, command: &Command) -> Result<(), Problem> {
    match command {
        Command::List { of, retired } => list(context, of.as_deref(), *retired).await,
        Command::Show { bundle } => {
            let connection = Connection::open(&context.connection).await?;
            let view = BundleView::from(&bundle.get(&connection).await?);
            output::data(context.format, &view, || details(&view))
        }
        Command::Fetch { bundle, out } => fetch(context, bundle, out.clone()).await,
        Command::Verify { bundle } => verify(context, bundle).await,
        Command::Tag { bundle, alias } => {
            let connection = Connection::open(&context.connection).await?;
            let request = v1::SetAliasRequest {
                object: Some((&bundle.object).into()),
                reference: bundle.reference.clone(),
                alias: alias.clone(),
            };
            let view =
                BundleView::from(&connection.bundles().set_alias(request).await?.into_inner());
            output::data(context.format, &view, || table(std::slice::from_ref(&view)))
        }
        Command::Retire { bundle } => {
            let connection = Connection::open(&context.connection).await?;
            let retired = connection.bundles().retire(bundle.request()).await?;
            let view = BundleView::from(&retired.into_inner());
            output::data(context.format, &view, || table(std::slice::from_ref(&view)))
        }
        Command::Restore { bundle } => {
            let connection = Connection::open(&context.connection).await?;
            let restored = connection.bundles().restore(bundle.request()).await?;
            let view = BundleView::from(&restored.into_inner());
            output::data(context.format, &view, || table(std::slice::from_ref(&view)))
        }
    }
}

async fn list(context: &Context, of: Option<&str>, include_retired: bool) -> Result<(), Problem> {
    let (collection, object) = match of {
        None => (String::new(), String::new()),
        Some(of) => {
            let usage = |error: ign_proto::IdError| Problem::usage(error.to_string());
            if of.contains('/') {
                let name: ObjectName = of.parse().map_err(usage)?;
                (name.collection.to_string(), name.object.to_string())
            } else {
                let collection: ign_proto::CollectionId = of.parse().map_err(usage)?;
                (collection.to_string(), String::new())
            }
        }
    };
    let connection = Connection::open(&context.connection).await?;
    let request = v1::ListBundlesRequest {
        collection,
        object,
        include_retired,
    };
    let bundles = connection
        .bundles()
        .list(request)
        .await?
        .into_inner()
        .bundles;
    let views: Vec<BundleView> = bundles.iter().map(BundleView::from).collect();
    if views.is_empty() {
        output::note("no bundle");
    }
    output::data(context.format, &views, || match views.len() {
        0 => String::new(),
        _ => table(&views),
    })
}

fn table(bundles: &[BundleView]) -> String {
    let now = Utc::now();
    let mut table = Table::new(&[
        "OBJECT", "VERSION", "ALIASES", ">SIZE", ">MSE", ">AGE", "DIGEST",
    ]);
    for bundle in bundles {
        let version = format!(
            "v{}{}",
            bundle.version,
            if bundle.retired { " (retired)" } else { "" }
        );
        table.row([
            bundle.name(),
            version,
            bundle.aliases.join(","),
            bytes(bundle.size_bytes),
            bundle.mse().map_or_else(|| "-".to_string(), number),
            age(bundle.created_at, now),
            bundle.digest.chars().take("sha256:".len() + 12).collect(),
        ]);
    }
    table.to_string()
}

fn details(bundle: &BundleView) -> String {
    let mut text = output::pairs(&[
        ("object", bundle.name()),
        ("version", format!("v{}", bundle.version)),
        ("aliases", bundle.aliases.join(", ")),
        (
            "retired",
            if bundle.retired {
                "yes".into()
            } else {
                String::new()
            },
        ),
        ("size", bytes(bundle.size_bytes)),
        (
            "created",
            bundle
                .created_at
                .map(|at| at.format("%Y-%m-%d %H:%M:%S UTC").to_string())
                .unwrap_or_default(),
        ),
        ("job", bundle.job_id.clone()),
        ("digest", bundle.digest.clone()),
    ]);
    let methods = method_rows(&bundle.metrics);
    if !methods.is_empty() {
        text.push('\n');
        text.push_str(&method_table(&methods));
    }
    text
}

async fn fetch(context: &Context, bundle: &BundleRef, out: Option<PathBuf>) -> Result<(), Problem> {
    let connection = Connection::open(&context.connection).await?;
    let version = bundle.get(&connection).await?;
    let out = out
        .unwrap_or_else(|| PathBuf::from(format!("{}-v{}", bundle.object.object, version.version)));
    let files = Files::of(&connection, &bundle.object, &digest(&version)?).await?;
    let staging = Staging::new(&out)?;
    files
        .fetch(&connection, &bundle.object, Some(staging.dir()))
        .await?;
    results::verify_folder(staging.dir())?;
    staging.place()?;
    let view = FetchView {
        bundle: BundleView::from(&version),
        dir: out,
    };
    output::data(context.format, &view, || {
        let (report, preview) = results::people_files(&view.dir);
        let path = |path: Option<PathBuf>| {
            path.map(|path| path.display().to_string())
                .unwrap_or_default()
        };
        output::pairs(&[
            (
                "object",
                format!("{} {}", view.bundle.name(), view.bundle.summary()),
            ),
            ("bundle", view.dir.display().to_string()),
            ("report", path(report)),
            ("preview", path(preview)),
        ])
    })
}

/// A bundle that was fetched.
#[derive(Debug, Serialize)]
struct FetchView {
    bundle: BundleView,
    dir: PathBuf,
}

fn digest(version: &v1::BundleVersion) -> Result<Digest, Problem> {
    version
        .manifest_digest
        .parse()
        .map_err(|error| Problem::failed(format!("the bundle's digest is malformed: {error}")))
}

async fn verify(context: &Context, bundle: &str) -> Result<(), Problem> {
    let dir = PathBuf::from(bundle);
    let view = if dir.is_dir() {
        let nested = dir.join("bundle");
        let dir = if dir.join("bundle.json").exists() || !nested.is_dir() {
            dir
        } else {
            nested
        };
        let opened = results::verify_folder(&dir)?;
        VerifyView {
            bundle: dir.display().to_string(),
            files: opened.manifest().files.len() + 1,
            size_bytes: opened.size_bytes(),
            verified: true,
        }
    } else {
        let reference: BundleRef = bundle.parse().map_err(|error: String| {
            Problem::usage(format!("neither a folder nor a bundle: {error}")).at(bundle)
        })?;
        let connection = Connection::open(&context.connection).await?;
        let version = reference.get(&connection).await?;
        let files = Files::of(&connection, &reference.object, &digest(&version)?).await?;
        files.fetch(&connection, &reference.object, None).await?;
        VerifyView {
            bundle: format!("{}:v{}", reference.object, version.version),
            files: files.count(),
            size_bytes: files.size_bytes(),
            verified: true,
        }
    };
    output::data(context.format, &view, || {
        format!(
            "{}: {} files, {}, all digests match\n",
            view.bundle,
            view.files,
            bytes(view.size_bytes)
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::views::samples;

    #[test]
    fn names_of_versions() {
        let parse = |text: &str| {
            text.parse::<BundleRef>()
                .map(|r| (r.object.to_string(), r.reference))
        };
        let object = "museum/vase".to_string();
        assert_eq!(parse("museum/vase"), Ok((object.clone(), String::new())));
        assert_eq!(parse("museum/vase:v3"), Ok((object.clone(), "v3".into())));
        assert_eq!(parse("museum/vase@v3"), Ok((object.clone(), "v3".into())));
        assert_eq!(
            parse("museum/vase@sha256:ab"),
            Ok((object, "sha256:ab".into()))
        );
        for bad in ["vase", "museum/vase:", "museum/Vase"] {
            assert!(parse(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn a_version_with_its_figures() {
        insta::assert_snapshot!(details(&BundleView::from(&samples::bundle())));
    }
}
