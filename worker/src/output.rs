//! The only place that prints: data on stdout; progress, warnings and errors on stderr.

#![expect(clippy::print_stderr, reason = "this module is the program's voice")]

use std::io::{IsTerminal, Write};
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressStyle};

/// One line on stdout. A reader that went away is no error.
pub(crate) fn data(line: &str) {
    let mut stdout = std::io::stdout().lock();
    writeln!(stdout, "{line}")
        .and_then(|()| stdout.flush())
        .ok();
}

/// A line for people.
pub(crate) fn say(line: &str) {
    eprintln!("{line}");
}

/// An error with its causes.
pub(crate) fn error(error: &anyhow::Error) {
    eprintln!("error: {error:#}");
}

/// Progress over a known number of steps: a bar on a terminal, otherwise a line every few seconds.
pub(crate) struct Steps {
    what: &'static str,
    total: u64,
    done: u64,
    started: Instant,
    said: Instant,
    bar: Option<ProgressBar>,
}

/// Between two plain lines.
const PLAIN_INTERVAL: Duration = Duration::from_secs(5);

impl Steps {
    pub(crate) fn new(what: &'static str, total: u64) -> Self {
        let bar = std::io::stderr().is_terminal().then(|| {
            let bar = ProgressBar::new(total).with_prefix(what);
            let style = ProgressStyle::with_template(
                "{prefix} [{bar:30}] {pos}/{len}, {per_sec}, {eta} left",
            );
            bar.with_style(style.unwrap_or_else(|_invalid| ProgressStyle::default_bar()))
        });
        let now = Instant::now();
        Self {
            what,
            total,
            done: 0,
            started: now,
            said: now,
            bar,
        }
    }

    /// `done` steps are finished.
    pub(crate) fn set(&mut self, done: u64) {
        self.done = done;
        if let Some(bar) = &self.bar {
            bar.set_position(done);
        } else if done > 0 && done < self.total && self.said.elapsed() >= PLAIN_INTERVAL {
            self.said = Instant::now();
            let elapsed = self.started.elapsed().as_secs_f64();
            let left = elapsed / done as f64 * (self.total - done) as f64;
            say(&format!(
                "{}: {done} of {}, about {left:.0} s left",
                self.what, self.total
            ));
        }
    }

    /// Ends with a line that says how long it took.
    pub(crate) fn finish(self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
        let secs = self.started.elapsed().as_secs_f64();
        say(&format!("{}: {} in {secs:.1} s", self.what, self.total));
    }
}
