//! The CSV list of captures that `submit --manifest` reads.
//!
//! One header line names the columns, in any order: `path`, `collection`, `object`, and optionally `preset`, `size`,
//! `priority`, `labels` (`key=value`, several with `;` between). Paths are relative to the list's own folder. Empty optional cells take the command line's value; lines that
//! are empty or begin with `#` are skipped. All rows are read before anything is sent, and every fault is reported.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use ign_proto::ObjectName;

use crate::problem::Problem;
use crate::recipe::key_value;

const REQUIRED: [&str; 3] = ["path", "collection", "object"];
const OPTIONAL: [&str; 4] = ["preset", "size", "priority", "labels"];

/// One row.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Row {
    /// Line in the list.
    pub(crate) line: u64,
    pub(crate) path: PathBuf,
    pub(crate) object: ObjectName,
    pub(crate) preset: Option<String>,
    pub(crate) size: Option<u32>,
    pub(crate) priority: Option<i32>,
    pub(crate) labels: BTreeMap<String, String>,
}

/// Reads the list, or says everything that is wrong with it.
pub(crate) fn read(file: &Path) -> Result<Vec<Row>, Vec<Problem>> {
    let unreadable = |error: &dyn std::fmt::Display| {
        vec![Problem::usage(format!("cannot read the list: {error}")).at(file.display())]
    };
    let text = std::fs::read_to_string(file).map_err(|error| unreadable(&error))?;
    // Spreadsheets like to begin a file with a byte order mark.
    let text = text.trim_start_matches('\u{feff}');
    let mut reader = csv::ReaderBuilder::new()
        .comment(Some(b'#'))
        .trim(csv::Trim::All)
        .from_reader(text.as_bytes());
    let header = reader
        .headers()
        .map_err(|error| unreadable(&error))?
        .clone();
    let mut problems = check_header(file, &header);
    if !problems.is_empty() {
        return Err(problems);
    }
    let base = file.parent().unwrap_or(Path::new(""));
    let mut rows: Vec<Row> = Vec::new();
    for record in reader.records() {
        match record {
            Ok(record) => match row(base, &header, &record, line_of(text, record.position())) {
                Ok(row) => rows.push(row),
                Err(faults) => {
                    let line = line_of(text, record.position());
                    problems.extend(
                        faults
                            .into_iter()
                            .map(|fault| fault.at(format!("{}:{line}", file.display()))),
                    );
                }
            },
            Err(error) => {
                let line = line_of(text, error.position());
                problems
                    .push(Problem::usage(unequal(&error)).at(format!("{}:{line}", file.display())));
            }
        }
    }
    if problems.is_empty() && rows.is_empty() {
        problems.push(Problem::usage("the list has no rows").at(file.display()));
    }
    if problems.is_empty() {
        Ok(rows)
    } else {
        Err(problems)
    }
}

/// The line of a record; the reader's own figure is that of the empty lines and comments before it.
fn line_of(text: &str, position: Option<&csv::Position>) -> u64 {
    position.map_or(0, |position| {
        let rest = text.get(position.byte() as usize..).unwrap_or("");
        let skipped = rest
            .lines()
            .take_while(|line| line.trim().is_empty() || line.starts_with('#'))
            .count();
        position.line() + skipped as u64
    })
}

fn unequal(error: &csv::Error) -> String {
    match error.kind() {
        csv::ErrorKind::UnequalLengths {
            expected_len, len, ..
        } => {
            format!("{len} cells, the header has {expected_len}")
        }
        _ => error.to_string(),
    }
}

fn check_header(file: &Path, header: &csv::StringRecord) -> Vec<Problem> {
    let at = format!("{}:1", file.display());
    let known = || REQUIRED.iter().chain(&OPTIONAL);
    let unknown = header
        .iter()
        .filter(|name| !known().any(|known| known == name))
        .map(|name| format!("unknown column {name:?}"));
    let missing = REQUIRED
        .iter()
        .filter(|name| !header.iter().any(|column| column == **name))
        .map(|name| format!("column {name:?} is missing"));
    unknown
        .chain(missing)
        .map(|what| {
            Problem::usage(what)
                .at(&at)
                .hint("columns are path, collection, object and optionally preset, size, priority, labels")
        })
        .collect()
}

fn row(
    base: &Path,
    header: &csv::StringRecord,
    record: &csv::StringRecord,
    line: u64,
) -> Result<Row, Vec<Problem>> {
    let cell = |name: &str| {
        let column = header.iter().position(|column| column == name)?;
        record.get(column).filter(|cell| !cell.is_empty())
    };
    let mut faults = Vec::new();
    if cell("path").is_none() {
        faults.push(Problem::usage("path is empty"));
    }
    let name = format!(
        "{}/{}",
        cell("collection").unwrap_or(""),
        cell("object").unwrap_or("")
    );
    let object = name
        .parse::<ObjectName>()
        .map_err(|error| faults.push(Problem::usage(error.to_string())))
        .ok();
    if let Some(preset) = cell("preset")
        && !matches!(preset, "auto" | "standard" | "paper")
    {
        faults.push(Problem::usage(format!(
            "preset {preset:?} is none of auto, standard and paper"
        )));
    }
    let mut labels = BTreeMap::new();
    for text in cell("labels").unwrap_or("").split(';') {
        match key_value(text) {
            Ok((key, value)) => drop(labels.insert(key, value)),
            Err(_) if text.trim().is_empty() => {}
            Err(expected) => faults.push(Problem::usage(format!("label {text:?}: {expected}"))),
        }
    }
    let mut number = |name: &str, range: std::ops::RangeInclusive<i64>| {
        let text = cell(name)?;
        let value = text
            .parse::<i64>()
            .ok()
            .filter(|value| range.contains(value));
        if value.is_none() {
            faults.push(Problem::usage(format!(
                "{name} {text:?} is no whole number from {} to {}",
                range.start(),
                range.end()
            )));
        }
        value
    };
    let size = number("size", 16..=8192).map(|size| size as u32);
    let priority = number("priority", -1000..=1000).map(|priority| priority as i32);
    match object {
        Some(object) if faults.is_empty() => Ok(Row {
            line,
            path: base.join(cell("path").unwrap_or("")),
            object,
            preset: cell("preset").map(str::to_string),
            size,
            priority,
            labels,
        }),
        _ => Err(faults),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(text: &str) -> Result<Vec<Row>, String> {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("list.csv");
        std::fs::write(&file, text).unwrap();
        let prefix = format!("{}/", dir.path().display());
        match read(&file) {
            Ok(mut rows) => {
                for row in &mut rows {
                    row.path = row.path.strip_prefix(dir.path()).unwrap().to_path_buf();
                }
                Ok(rows)
            }
            Err(problems) => {
                let texts: Vec<String> = problems.iter().map(ToString::to_string).collect();
                Err(texts.join("\n").replace(&prefix, ""))
            }
        }
    }

    #[test]
    fn columns_in_any_order_and_empty_cells() {
        let rows = parse(
            "\u{feff}object, collection ,path,size,priority,labels\n# from the north wing\n\nvase,museum,a/vase,128,-5,room=3; photographer = A. B.;\nbust,museum,b,,,\n",
        )
        .unwrap();
        assert_eq!(rows.len(), 2);
        assert_eq!(rows[0].object.to_string(), "museum/vase");
        assert_eq!(
            (rows[0].size, rows[0].priority, rows[0].line),
            (Some(128), Some(-5), 4)
        );
        assert_eq!((rows[1].size, rows[1].priority), (None, None));
        let labels: Vec<(&str, &str)> = rows[0]
            .labels
            .iter()
            .map(|(key, value)| (key.as_str(), value.as_str()))
            .collect();
        assert_eq!(labels, [("photographer", "A. B."), ("room", "3")]);
        assert!(rows[1].labels.is_empty());
        assert_eq!(rows[1].path, Path::new("b"));
    }

    #[test]
    fn every_fault_is_reported_with_its_line() {
        let faults = parse(
            "path,collection,object,preset,size,labels\na,museum,Vase,standard,1,=x\n,museum,bust,best,128,\nc,museum\n",
        )
        .unwrap_err();
        insta::assert_snapshot!(faults);
    }

    #[test]
    fn the_header_is_checked_first() {
        insta::assert_snapshot!(parse("path,collection,name\na,b,c\n").unwrap_err());
        assert!(
            parse("path,collection,object\n")
                .unwrap_err()
                .contains("no rows")
        );
    }
}
