//! Results as a table for people, the same for programs, and a plot.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use ign_bundle::report::plot::{Axis, Plot, Series, Unit, WIDTH};
use serde_json::{Map, Value, json};

use crate::{BakeError, io};

/// Axis of most plots.
pub(super) const ERROR: Axis = Axis::log("mean squared error, 0 to 255", Unit::Plain);

/// One line: what it is about, then figures.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Row {
    labels: Vec<String>,
    figures: Vec<f64>,
}

impl Row {
    pub(super) fn new(labels: &[&str], figures: &[f64]) -> Self {
        Self {
            labels: labels.iter().map(|&label| label.to_owned()).collect(),
            figures: figures.to_vec(),
        }
    }
}

/// What an experiment found.
pub(super) struct Table {
    pub(super) caption: &'static str,
    /// Headings of the rows' labels, and of their figures.
    pub(super) labels: &'static [&'static str],
    pub(super) columns: &'static [&'static str],
    pub(super) rows: Vec<Row>,
    pub(super) series: Vec<Series>,
    pub(super) x: Axis,
    pub(super) y: Axis,
}

impl Table {
    fn markdown(&self) -> String {
        let headings = [self.labels, self.columns].concat();
        let mut text = format!("{}\n\n| {} |\n|", self.caption, headings.join(" | "));
        text.push_str(&"---|".repeat(self.labels.len()));
        text.push_str(&"---:|".repeat(self.columns.len()));
        text.push('\n');
        for row in &self.rows {
            let labels = row.labels.iter().map(|label| label.replace('|', "\\|"));
            let figures = row.figures.iter().map(|&figure| short(figure));
            let cells: Vec<String> = labels.chain(figures).collect();
            writeln!(text, "| {} |", cells.join(" | ")).ok();
        }
        text
    }

    fn json(&self, experiment: &str) -> Value {
        let rows: Vec<Value> = self
            .rows
            .iter()
            .map(|row| {
                let labels = row.labels.iter().map(|label| json!(label));
                let figures = row.figures.iter().map(|figure| json!(figure));
                let names = self.labels.iter().chain(self.columns);
                let fields = names
                    .map(|name| (*name).to_owned())
                    .zip(labels.chain(figures));
                Value::Object(fields.collect::<Map<_, _>>())
            })
            .collect();
        json!({ "schema": "ign.experiment/1", "experiment": experiment, "caption": self.caption, "rows": rows })
    }

    /// Writes `NAME.md`, `NAME.json` and `NAME.svg`.
    pub(super) fn write(&self, dir: &Path, name: &str) -> Result<Vec<PathBuf>, BakeError> {
        std::fs::create_dir_all(dir).map_err(io(dir))?;
        let plot = Plot {
            size: (WIDTH, 330.0),
            series: self.series.clone(),
            x: self.x,
            y: self.y,
        };
        let json = format!("{:#}\n", self.json(name));
        [
            ("md", self.markdown()),
            ("json", json),
            ("svg", plot.document()),
        ]
        .into_iter()
        .map(|(extension, text)| {
            let path = dir.join(format!("{name}.{extension}"));
            std::fs::write(&path, text).map_err(io(&path))?;
            Ok(path)
        })
        .collect()
    }
}

/// Four significant digits, or as many as a whole number has.
fn short(figure: f64) -> String {
    let size = figure.abs();
    match size {
        _ if !figure.is_finite() => "–".to_owned(),
        _ if figure.fract().abs() < 1e-9 => format!("{figure:.0}"),
        s if s >= 1000.0 => format!("{figure:.0}"),
        s if s >= 100.0 => format!("{figure:.1}"),
        s if s >= 10.0 => format!("{figure:.2}"),
        _ => format!("{figure:.3}"),
    }
}
