//! Bundles on this machine: fetched with every digest checked, verified, laid out as the result of a bake.
//!
//! Invariants: a folder appears under its final name only when it is complete;
//! a folder that a bake did not write is never replaced.

use std::path::{Path, PathBuf};

use futures::{StreamExt as _, TryStreamExt as _};
use ign_bundle::{Bundle, METRICS_FILE, REPORT_FILE};
use ign_proto::{Digest, Kind, Manifest, ObjectName};
use serde::Serialize;
use serde_json::Value;

use crate::connection::Connection;
use crate::output::{Live, Table};
use crate::problem::{Doing as _, Problem, chain};
use crate::upload::TRANSFERS_AT_ONCE;

/// Folder of scored held-out images, in a bundle and beside it.
const HELD_OUT: &str = "held_out";
/// Turntable of a bundle.
const PREVIEW_FILE: &str = "preview.webp";
/// Methods that come first in the table, in this order.
const FIRST_METHODS: [&str; 3] = ["ours", "n_ibr", "ibr"];

/// The files of a bundle, as its manifest names them.
pub(crate) struct Files(Manifest);

impl Files {
    /// Reads and checks a bundle's manifest.
    pub(crate) async fn of(
        connection: &Connection,
        object: &ObjectName,
        digest: &Digest,
    ) -> Result<Self, Problem> {
        let bytes = connection.data_plane(object)?.manifest(digest).await?;
        let manifest =
            Manifest::decode(&bytes).map_err(|error| Problem::failed(chain(&error)).at(digest))?;
        match manifest.kind() {
            Kind::Bundle => Ok(Self(manifest)),
            Kind::Capture => Err(Problem::failed("this is a capture, not a bundle").at(digest)),
        }
    }

    /// How many.
    pub(crate) fn count(&self) -> usize {
        self.0.files().len()
    }

    /// Of all files.
    pub(crate) fn size_bytes(&self) -> u64 {
        self.0.size_bytes()
    }

    /// Reads one file, checked against its digest, by way of a file on disk; none when the bundle has no such file.
    pub(crate) async fn read(
        &self,
        connection: &Connection,
        object: &ObjectName,
        name: &str,
        by_way_of: &Path,
    ) -> Result<Option<Vec<u8>>, Problem> {
        let Some(file) = self.0.files().iter().find(|f| f.path.as_str() == name) else {
            return Ok(None);
        };
        let store = connection.data_plane(object)?;
        store
            .download(&file.digest, file.size_bytes, Some(by_way_of), &|_| ())
            .await
            .map_err(|problem| problem.context(name))?;
        Ok(Some(
            std::fs::read(by_way_of).doing("cannot read", by_way_of.display())?,
        ))
    }

    /// Writes the files into `dir`, which is empty; without a folder, reads and checks them only.
    pub(crate) async fn fetch(
        &self,
        connection: &Connection,
        object: &ObjectName,
        dir: Option<&Path>,
    ) -> Result<(), Problem> {
        let store = connection.data_plane(object)?;
        let live = Live::transfer(
            if dir.is_some() { "fetch" } else { "check" },
            self.size_bytes(),
        );
        for file in self.0.files() {
            if let Some(parent) =
                dir.and_then(|dir| dir.join(file.path.as_str()).parent().map(Path::to_path_buf))
            {
                std::fs::create_dir_all(&parent).doing("cannot create", parent.display())?;
            }
        }
        let received = |count: i64| live.add(count.unsigned_abs());
        futures::stream::iter(self.0.files())
            .map(|file| {
                let (store, received) = (&store, &received);
                async move {
                    let to = dir.map(|dir| dir.join(file.path.as_str()));
                    store
                        .download(&file.digest, file.size_bytes, to.as_deref(), received)
                        .await
                        .map_err(|problem| problem.context(&file.path))
                }
            })
            .buffer_unordered(TRANSFERS_AT_ONCE)
            .try_collect::<Vec<()>>()
            .await?;
        live.clear();
        Ok(())
    }
}

/// Verifies a bundle folder: every digest, image, weight.
pub(crate) fn verify_folder(dir: &Path) -> Result<Bundle, Problem> {
    Bundle::open(dir).map_err(|error| Problem::failed(chain(&error)).at(dir.display()))
}

/// Refuses a folder that exists and does not come from a bake or fetch.
pub(crate) fn check_replaceable(out: &Path) -> Result<(), Problem> {
    let empty = std::fs::read_dir(out).is_ok_and(|mut entries| entries.next().is_none());
    let ours = ["metrics.json", "bundle", "bundle.json"]
        .iter()
        .any(|name| out.join(name).exists());
    if out.symlink_metadata().is_err() || (out.is_dir() && (empty || ours)) {
        return Ok(());
    }
    Err(
        Problem::usage("the output folder exists and is not the result of a bake")
            .at(out.display())
            .hint("give another --out, or move it away"),
    )
}

/// A folder in the making beside its final place; removed again unless it is put in place.
pub(crate) struct Staging {
    dir: PathBuf,
    out: PathBuf,
    placed: bool,
}

impl Staging {
    /// Makes the folder.
    pub(crate) fn new(out: &Path) -> Result<Self, Problem> {
        check_replaceable(out)?;
        let out = std::path::absolute(out).doing("cannot use the output folder", out.display())?;
        let name = out
            .file_name()
            .ok_or_else(|| Problem::usage("the output folder has no name").at(out.display()))?
            .to_string_lossy()
            .into_owned();
        let dir = out.with_file_name(format!(".{name}.partial-{}", std::process::id()));
        if dir.exists() {
            std::fs::remove_dir_all(&dir).doing("cannot remove", dir.display())?;
        }
        std::fs::create_dir_all(&dir).doing("cannot create", dir.display())?;
        Ok(Self {
            dir,
            out,
            placed: false,
        })
    }

    /// Where to write.
    pub(crate) fn dir(&self) -> &Path {
        &self.dir
    }

    /// Gives the folder its final name; a former result goes away.
    pub(crate) fn place(mut self) -> Result<(), Problem> {
        // Checked again: hours may have passed.
        check_replaceable(&self.out)?;
        let former = self.dir.with_extension("former");
        let replaces = self.out.symlink_metadata().is_ok();
        if replaces {
            std::fs::rename(&self.out, &former)
                .doing("cannot move the former result away", self.out.display())?;
        }
        std::fs::rename(&self.dir, &self.out)
            .doing("cannot put the result in place", self.out.display())?;
        self.placed = true;
        if replaces {
            std::fs::remove_dir_all(&former)
                .doing("cannot remove the former result", former.display())?;
        }
        Ok(())
    }
}

impl Drop for Staging {
    fn drop(&mut self) {
        if !self.placed {
            // Nothing more can be done about a folder that cannot be removed.
            let _left = std::fs::remove_dir_all(&self.dir);
        }
    }
}

/// Copies what people look at out of `dir/bundle` to `dir`.
pub(crate) fn lay_out(dir: &Path) -> Result<(), Problem> {
    let bundle = dir.join("bundle");
    for file in [METRICS_FILE, REPORT_FILE] {
        if bundle.join(file).is_file() {
            link_or_copy(&bundle.join(file), &dir.join(file))?;
        }
    }
    let held_out = bundle.join(HELD_OUT);
    if held_out.is_dir() {
        std::fs::create_dir_all(dir.join(HELD_OUT))
            .doing("cannot create", dir.join(HELD_OUT).display())?;
        for entry in std::fs::read_dir(&held_out).doing("cannot read", held_out.display())? {
            let entry = entry.doing("cannot read", held_out.display())?;
            link_or_copy(&entry.path(), &dir.join(HELD_OUT).join(entry.file_name()))?;
        }
    }
    Ok(())
}

fn link_or_copy(from: &Path, to: &Path) -> Result<(), Problem> {
    if std::fs::hard_link(from, to).is_err() {
        std::fs::copy(from, to).doing("cannot write", to.display())?;
    }
    Ok(())
}

/// The result of a bake on disk.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct ResultView {
    pub(crate) job_id: String,
    pub(crate) bundle: crate::views::BundleView,
    pub(crate) out_dir: PathBuf,
    pub(crate) bundle_dir: PathBuf,
    pub(crate) report: Option<PathBuf>,
    pub(crate) preview: Option<PathBuf>,
    pub(crate) methods: Vec<MethodView>,
}

/// A method's row of `metrics.json`.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(crate) struct MethodView {
    pub(crate) method: String,
    pub(crate) mse: Option<f64>,
    pub(crate) mse_object: Option<f64>,
    pub(crate) psnr: Option<f64>,
}

/// Where a bundle's people-facing files lie, if it has them.
pub(crate) fn people_files(bundle: &Path) -> (Option<PathBuf>, Option<PathBuf>) {
    let existing = |name: &str| Some(bundle.join(name)).filter(|path| path.is_file());
    (existing(REPORT_FILE), existing(PREVIEW_FILE))
}

/// The rows of `metrics.json`: ours, then plain image-based rendering, then the others as they come.
pub(crate) fn methods(metrics: &Path) -> Result<Vec<MethodView>, Problem> {
    let text = match std::fs::read(metrics) {
        Ok(text) => text,
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(Vec::new()),
        Err(error) => return Err(error).doing("cannot read", metrics.display()),
    };
    let parsed: Value = serde_json::from_slice(&text)
        .map_err(|error| Problem::failed(format!("not JSON: {error}")).at(metrics.display()))?;
    Ok(method_rows(&parsed))
}

/// The rows of a parsed `metrics.json`, or of the summary kept with a version.
pub(crate) fn method_rows(metrics: &Value) -> Vec<MethodView> {
    let rows = metrics["methods"]
        .as_array()
        .map(Vec::as_slice)
        .unwrap_or_default();
    let mut rows: Vec<MethodView> = rows
        .iter()
        .filter_map(|row| {
            Some(MethodView {
                method: row["name"].as_str()?.to_string(),
                mse: row["mse"].as_f64(),
                mse_object: row["mse_object"].as_f64(),
                psnr: row["psnr"].as_f64(),
            })
        })
        .collect();
    let rank = |name: &str| {
        FIRST_METHODS
            .iter()
            .position(|first| *first == name)
            .unwrap_or(FIRST_METHODS.len())
    };
    rows.sort_by_key(|row| rank(&row.method));
    rows
}

/// The methods as a table.
pub(crate) fn method_table(methods: &[MethodView]) -> String {
    let mut table = Table::new(&["METHOD", ">MSE", ">MSE_OBJECT", ">PSNR"]);
    let cell =
        |value: Option<f64>| value.map_or_else(|| "-".to_string(), |value| format!("{value:.2}"));
    for row in methods {
        table.row([
            row.method.clone(),
            cell(row.mse),
            cell(row.mse_object),
            cell(row.psnr),
        ]);
    }
    table.to_string()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::problem::Exit;
    use serde_json::json;

    #[test]
    fn ours_stands_beside_plain_rendering() {
        let metrics = json!({"methods": [
            {"name": "ibr", "mse": 139.0, "mse_object": 400.25, "psnr": 26.7},
            {"name": "texture", "mse": 300.0, "mse_object": 900.0, "psnr": 23.0},
            {"name": "n_ibr", "mse": 148.0, "mse_object": 410.0, "psnr": 26.4},
            {"name": "ours", "mse": 42.5, "mse_object": 120.1, "psnr": null},
        ]});
        insta::assert_snapshot!(method_table(&method_rows(&metrics)));
    }

    #[test]
    fn only_former_results_are_replaced() {
        let dir = tempfile::tempdir().unwrap();
        let out = dir.path().join("vase");
        let write = |name: &str| {
            let staging = Staging::new(&out)?;
            std::fs::write(staging.dir().join("metrics.json"), name)?;
            staging.place()
        };
        write("first").unwrap();
        write("second").unwrap();
        assert_eq!(
            std::fs::read_to_string(out.join("metrics.json")).unwrap(),
            "second"
        );
        assert_eq!(
            std::fs::read_dir(dir.path()).unwrap().count(),
            1,
            "nothing is left beside it"
        );
        std::fs::remove_file(out.join("metrics.json")).unwrap();
        std::fs::write(out.join("thesis.tex"), "").unwrap();
        assert_eq!(write("third").unwrap_err().exit, Exit::Usage);
        assert!(out.join("thesis.tex").exists());
    }

    #[test]
    fn an_unfinished_folder_goes_away() {
        let dir = tempfile::tempdir().unwrap();
        drop(Staging::new(&dir.path().join("out")).unwrap());
        assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 0);
    }
}
