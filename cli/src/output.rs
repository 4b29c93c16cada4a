//! Everything that ignctl writes to the terminal: data on stdout, progress and notes on stderr.
//!
//! Invariants: this is the only file that prints; stdout carries data only, in one of three formats; without a
//! terminal there is no escape sequence and no line that rewrites itself; table cells never hold control
//! characters, because names and messages come from other people's files.

#![expect(clippy::print_stderr, reason = "the one place that prints")]

use std::io::{IsTerminal as _, Write as _};
use std::time::Duration;

use chrono::{DateTime, Utc};
use console::{Style, Term, measure_text_width, truncate_str};
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use serde::Serialize;

use crate::problem::Problem;

/// How data is written to stdout.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub(crate) enum Format {
    // No doc comments: clap would print each on a line of its own in every help text.
    #[default]
    Table,
    Json,
    Yaml,
}

/// Writes text that is already complete, newline included.
pub(crate) fn raw(text: &str) -> Result<(), Problem> {
    let mut out = std::io::stdout().lock();
    out.write_all(text.as_bytes())?;
    Ok(out.flush()?)
}

/// Writes one line of data.
pub(crate) fn line(text: &str) -> Result<(), Problem> {
    raw(&format!("{text}\n"))
}

/// Writes `value` in `format`; `table` is asked only for [`Format::Table`].
pub(crate) fn data<T: Serialize>(
    format: Format,
    value: &T,
    table: impl FnOnce() -> String,
) -> Result<(), Problem> {
    match format {
        Format::Table => raw(&table()),
        Format::Json => {
            let text = serde_json::to_string_pretty(value)
                .map_err(|error| Problem::failed(format!("cannot write JSON: {error}")))?;
            line(&text)
        }
        Format::Yaml => {
            let text = serde_yaml_ng::to_string(value)
                .map_err(|error| Problem::failed(format!("cannot write YAML: {error}")))?;
            raw(&text)
        }
    }
}

/// Writes a note for people to stderr.
pub(crate) fn note(text: &str) {
    eprintln!("{text}");
}

/// Writes a warning to stderr.
pub(crate) fn warn(text: &str) {
    let label = Style::new().for_stderr().yellow().apply_to("warning:");
    eprintln!("{label} {text}");
}

/// Writes a problem to stderr; silent ones say nothing.
pub(crate) fn problem(problem: &Problem) {
    if problem.silent {
        return;
    }
    let text = problem.to_string();
    let rest = text.strip_prefix("error:").unwrap_or(&text);
    let label = Style::new().for_stderr().red().bold().apply_to("error:");
    eprintln!("{label}{rest}");
}

/// Writes clap's own text: help and versions are data, usage errors are not.
pub(crate) fn clap(error: &clap::Error) {
    if error.print().is_err() {
        eprintln!("{error}");
    }
}

/// Whether stdout is a terminal.
pub(crate) fn stdout_is_terminal() -> bool {
    std::io::stdout().is_terminal()
}

/// Columns of running text where stdout is no terminal.
const WRAP_COLUMNS: usize = 100;

/// Columns to fit tables into; none when stdout is no terminal.
fn width() -> Option<usize> {
    stdout_is_terminal().then(|| usize::from(Term::stdout().size().1).max(40))
}

/// Replaces the screen by `text`, cut to the terminal's height, without flicker.
pub(crate) fn screen(text: &str) -> Result<(), Problem> {
    let rows = usize::from(Term::stdout().size().0).max(3);
    let mut out = String::from("\x1b[H");
    let lines: Vec<&str> = text.lines().collect();
    for (index, line) in lines.iter().take(rows - 1).enumerate() {
        if index == rows - 2 && lines.len() > rows - 1 {
            let more = format!("({} more lines)\x1b[K\n", lines.len() - index);
            out.push_str(&more);
        } else {
            out.push_str(line);
            out.push_str("\x1b[K\n");
        }
    }
    out.push_str("\x1b[J");
    raw(&out)
}

/// Colours of a word that names a state, on a terminal only.
fn state(word: &str) -> String {
    let style = match word {
        "succeeded" | "ok" => Style::new().green(),
        "failed" | "error" => Style::new().red(),
        "running" | "warn" => Style::new().yellow(),
        _ => return word.to_string(),
    };
    style.apply_to(word).to_string()
}

/// A heading within a screen.
pub(crate) fn heading(text: &str) -> String {
    Style::new().bold().apply_to(text).to_string()
}

/// Cells in columns, cut to the terminal's width; words of the column `STATE` are coloured.
pub(crate) struct Table {
    header: Vec<String>,
    rows: Vec<Vec<String>>,
    numeric: Vec<bool>,
}

impl Table {
    /// A header that starts with `>` names a column of numbers, set flush right.
    pub(crate) fn new(header: &[&str]) -> Self {
        Self {
            numeric: header.iter().map(|name| name.starts_with('>')).collect(),
            header: header
                .iter()
                .map(|name| name.trim_start_matches('>').to_string())
                .collect(),
            rows: Vec::new(),
        }
    }

    /// Adds a row; it has as many cells as the header.
    pub(crate) fn row<const N: usize>(&mut self, cells: [String; N]) {
        self.rows.push(cells.map(|cell| printable(&cell)).to_vec());
    }

    /// The table as text, each line ended; for a terminal of `columns` if given.
    fn render(&self, columns: Option<usize>) -> String {
        let count = self.header.len();
        let mut widths: Vec<usize> = self.header.iter().map(|h| measure_text_width(h)).collect();
        for row in &self.rows {
            for (width, cell) in widths.iter_mut().zip(row) {
                *width = (*width).max(measure_text_width(cell));
            }
        }
        let dim = Style::new().dim();
        let header: Vec<String> = self
            .header
            .iter()
            .map(|h| dim.apply_to(h).to_string())
            .collect();
        let mut text = String::new();
        for row in std::iter::once(&header).chain(&self.rows) {
            let mut line = String::new();
            for (index, cell) in row.iter().enumerate() {
                let pad = " ".repeat(widths[index].saturating_sub(measure_text_width(cell)));
                let cell = if self.header[index] == "STATE" {
                    &state(cell)
                } else {
                    cell
                };
                if self.numeric[index] {
                    line.push_str(&pad);
                    line.push_str(cell);
                } else {
                    line.push_str(cell);
                    if index + 1 < count {
                        line.push_str(&pad);
                    }
                }
                if index + 1 < count {
                    line.push_str("  ");
                }
            }
            let line = line.trim_end();
            match columns {
                Some(columns) => text.push_str(&truncate_str(line, columns, "…")),
                None => text.push_str(line),
            }
            text.push('\n');
        }
        text
    }
}

impl std::fmt::Display for Table {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.render(width()))
    }
}

/// `text` on one line and without control characters.
pub(crate) fn printable(text: &str) -> String {
    text.chars()
        .map(|c| match c {
            '\n' | '\r' | '\t' => ' ',
            c if c.is_control() => '?',
            c => c,
        })
        .collect()
}

/// `text` behind `label`, broken between words to the terminal's width and aligned behind the label.
pub(crate) fn wrapped(label: &str, text: &str) -> String {
    wrap(label, &printable(text), width().unwrap_or(WRAP_COLUMNS))
}

fn wrap(label: &str, text: &str, columns: usize) -> String {
    let indent = measure_text_width(label);
    let mut lines = vec![label.to_string()];
    for word in text.split(' ') {
        let line = lines.last().map_or("", String::as_str);
        let used = measure_text_width(line);
        if used > indent && used + 1 + measure_text_width(word) > columns {
            lines.push(" ".repeat(indent));
        }
        if let Some(line) = lines.last_mut() {
            if measure_text_width(line) > indent {
                line.push(' ');
            }
            line.push_str(word);
        }
    }
    lines.join("\n") + "\n"
}

/// Name and value, one pair a line, values aligned; empty values are left out.
pub(crate) fn pairs(pairs: &[(&str, String)]) -> String {
    let width = pairs
        .iter()
        .filter(|(_, value)| !value.is_empty())
        .map(|(name, _)| name.len())
        .max()
        .unwrap_or(0);
    let lines: Vec<String> = pairs
        .iter()
        .filter(|(_, value)| !value.is_empty())
        .map(|(name, value)| format!("{name:width$}  {}\n", printable(value)))
        .collect();
    lines.concat()
}

/// `1h 04m`, `3m 20s`, `12s`: two units at most.
pub(crate) fn duration(secs: f64) -> String {
    if !secs.is_finite() || secs < 0.0 {
        return "-".to_string();
    }
    let total = secs.round() as u64;
    let (days, hours, minutes, seconds) = (
        total / 86_400,
        total / 3_600 % 24,
        total / 60 % 60,
        total % 60,
    );
    if days > 0 {
        format!("{days}d {hours:02}h")
    } else if hours > 0 {
        format!("{hours}h {minutes:02}m")
    } else if minutes > 0 {
        format!("{minutes}m {seconds:02}s")
    } else {
        format!("{seconds}s")
    }
}

/// How long ago `then` was; `-` when unknown.
pub(crate) fn age(then: Option<DateTime<Utc>>, now: DateTime<Utc>) -> String {
    then.map_or_else(
        || "-".to_string(),
        |then| duration(((now - then).num_milliseconds() as f64 / 1000.0).max(0.0)),
    )
}

/// `12.3 MB`, in powers of ten as disks are sold.
pub(crate) fn bytes(count: u64) -> String {
    bytesize::ByteSize::b(count).display().si().to_string()
}

/// A number with about four significant digits.
pub(crate) fn number(value: f64) -> String {
    match value.abs() {
        v if !v.is_finite() => "-".to_string(),
        v if v >= 1000.0 => format!("{value:.0}"),
        v if v >= 100.0 => format!("{value:.1}"),
        _ => format!("{value:.2}"),
    }
}

/// A live line on stderr: a bar on a terminal, a plain line now and then elsewhere.
pub(crate) struct Live {
    bar: ProgressBar,
    plain: bool,
    said: std::sync::Mutex<(String, Option<std::time::Instant>)>,
}

/// Least time between two plain lines that say the same thing with other figures.
const PLAIN_EVERY: Duration = Duration::from_secs(15);

impl Live {
    fn new(bar: ProgressBar, style: ProgressStyle) -> Self {
        let plain = !std::io::stderr().is_terminal();
        bar.set_draw_target(if plain {
            ProgressDrawTarget::hidden()
        } else {
            ProgressDrawTarget::stderr()
        });
        bar.set_style(style);
        if !plain {
            bar.enable_steady_tick(Duration::from_millis(120));
        }
        Self {
            bar,
            plain,
            said: std::sync::Mutex::new((String::new(), None)),
        }
    }

    /// A bar of bytes with rate and time left.
    pub(crate) fn transfer(what: &str, total_bytes: u64) -> Self {
        let style =
            style("{prefix:>10} {bar:28} {bytes}/{total_bytes}  {bytes_per_sec}  eta {eta}");
        let mut live = Self::new(ProgressBar::new(total_bytes), style);
        live.bar.set_prefix(what.to_string());
        // Without a terminal, only a transfer that takes its time is worth a line.
        live.said = std::sync::Mutex::new((what.to_string(), Some(std::time::Instant::now())));
        live
    }

    /// A bar of percent with a message behind it.
    pub(crate) fn percent() -> Self {
        Self::new(
            ProgressBar::new(1000),
            style("{prefix:>12} {bar:28} {wide_msg}"),
        )
    }

    /// Adds bytes to a transfer.
    pub(crate) fn add(&self, bytes: u64) {
        self.bar.inc(bytes);
        if self.plain {
            let total = self.bar.length().unwrap_or(0);
            let text = format!(
                "{} of {}, eta {}",
                self::bytes(self.bar.position().min(total)),
                self::bytes(total),
                duration(self.bar.eta().as_secs_f64())
            );
            let prefix = self.bar.prefix();
            self.say(&prefix, &format!("{prefix} {text}"));
        }
    }

    /// Takes back bytes of a part that is sent again.
    pub(crate) fn take_back(&self, bytes: u64) {
        self.bar
            .set_position(self.bar.position().saturating_sub(bytes));
    }

    /// Sets stage, percent and message; without a terminal, says them when the stage changes or time has passed.
    pub(crate) fn set(&self, stage: &str, percent: f64, message: &str) {
        let percent = if percent.is_finite() {
            percent.clamp(0.0, 100.0)
        } else {
            0.0
        };
        self.bar.set_prefix(printable(stage));
        self.bar.set_position((percent * 10.0) as u64);
        self.bar
            .set_message(format!("{percent:3.0}%  {}", printable(message)));
        if self.plain {
            let done = if percent > 0.0 {
                format!(" {percent:.0}%")
            } else {
                String::new()
            };
            self.say(stage, format!("{stage}{done}  {message}").trim_end());
        }
    }

    fn say(&self, key: &str, text: &str) {
        let mut said = self
            .said
            .lock()
            .unwrap_or_else(std::sync::PoisonError::into_inner);
        let due = said.0 != key || said.1.is_none_or(|at| at.elapsed() >= PLAIN_EVERY);
        if due {
            *said = (key.to_string(), Some(std::time::Instant::now()));
            note(&printable(text));
        }
    }

    /// Writes a line above the bar.
    pub(crate) fn above(&self, text: &str) {
        if self.plain {
            note(text);
        } else {
            self.bar.println(text);
        }
    }

    /// Removes the bar.
    pub(crate) fn clear(&self) {
        self.bar.finish_and_clear();
    }
}

impl Drop for Live {
    fn drop(&mut self) {
        self.bar.finish_and_clear();
    }
}

fn style(template: &str) -> ProgressStyle {
    ProgressStyle::with_template(template)
        .unwrap_or_else(|_| ProgressStyle::default_bar())
        .progress_chars("━╸─")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn table() -> Table {
        let mut table = Table::new(&["JOB", ">MSE", "WHY"]);
        table.row(["0a1b".into(), "4.9".into(), "a\nb\x1b[31mred".into()]);
        table.row(["0a1b2c3d".into(), "121".into(), "mesh missing".into()]);
        table
    }

    #[test]
    fn aligns_and_takes_control_characters_out() {
        insta::assert_snapshot!(table().render(None), @r"
        JOB       MSE  WHY
        0a1b      4.9  a b?[31mred
        0a1b2c3d  121  mesh missing
        ");
    }

    #[test]
    fn text_is_broken_between_words() {
        assert_eq!(
            wrap("at: ", "one two three fourteen", 11),
            "at: one two\n    three\n    fourteen\n"
        );
    }

    #[test]
    fn cuts_to_the_terminal() {
        for line in table().render(Some(20)).lines() {
            assert!(measure_text_width(line) <= 20, "{line}");
        }
    }

    #[test]
    fn durations_have_two_units() {
        let texts: Vec<String> = [0.4, 59.6, 200.0, 3_840.0, 200_000.0, f64::NAN]
            .map(duration)
            .to_vec();
        assert_eq!(texts, ["0s", "1m 00s", "3m 20s", "1h 04m", "2d 07h", "-"]);
    }

    #[test]
    fn json_and_yaml_have_the_same_fields() {
        #[derive(Serialize)]
        struct Row {
            job_id: String,
            eta_secs: Option<f64>,
        }
        let row = Row {
            job_id: "a".into(),
            eta_secs: None,
        };
        let json: serde_json::Value =
            serde_json::from_str(&serde_json::to_string(&row).unwrap()).unwrap();
        let yaml: serde_json::Value =
            serde_yaml_ng::from_str(&serde_yaml_ng::to_string(&row).unwrap()).unwrap();
        assert_eq!(json, yaml);
    }
}
