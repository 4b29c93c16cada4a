//! Log lines of one attempt on their way to the coordinator.
//!
//! A child may print without end. The buffer is bounded in lines and bytes and limits the rate of free text; what is
//! left out is counted and said. Lines that the bake logs on purpose are not rate-limited, only bounded.

use std::collections::VecDeque;
use std::time::{Instant, SystemTime};

use ign_events::Level;

/// Free text lines per second in the long run.
const RATE: f64 = 20.0;
/// Free text lines in one burst.
const BURST: f64 = 200.0;
const MAX_LINES: usize = 1000;
const MAX_LINE_BYTES: usize = 4000;
/// Lines in one request.
pub(crate) const BATCH: usize = 200;

#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Line {
    pub(crate) at: SystemTime,
    pub(crate) level: Level,
    pub(crate) message: String,
}

#[derive(Debug)]
pub(crate) struct LogBuffer {
    lines: VecDeque<Line>,
    left_out: u64,
    allowance: f64,
    refilled_at: Instant,
}

impl LogBuffer {
    pub(crate) fn new() -> Self {
        Self {
            lines: VecDeque::new(),
            left_out: 0,
            allowance: BURST,
            refilled_at: Instant::now(),
        }
    }

    /// A line that the bake or the agent means to log.
    pub(crate) fn push(&mut self, level: Level, message: &str) {
        if self.lines.len() >= MAX_LINES {
            self.lines.pop_front();
            self.left_out += 1;
        }
        self.lines.push_back(Line {
            at: SystemTime::now(),
            level,
            message: cut(message, MAX_LINE_BYTES).to_owned(),
        });
    }

    /// A line of free text that the child printed.
    pub(crate) fn push_text(&mut self, text: &str, now: Instant) {
        let waited = now.saturating_duration_since(self.refilled_at);
        self.refilled_at = now;
        self.allowance = (self.allowance + waited.as_secs_f64() * RATE).min(BURST);
        if self.allowance < 1.0 || self.lines.len() >= MAX_LINES {
            self.left_out += 1;
            return;
        }
        self.allowance -= 1.0;
        self.push(Level::Info, text);
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.lines.is_empty() && self.left_out == 0
    }

    /// The oldest lines, for one request.
    pub(crate) fn take(&mut self) -> Vec<Line> {
        let count = self.lines.len().min(BATCH);
        let mut taken: Vec<Line> = self.lines.drain(..count).collect();
        if self.lines.is_empty() && self.left_out > 0 {
            taken.push(Line {
                at: SystemTime::now(),
                level: Level::Warn,
                message: format!("{} lines of output left out", self.left_out),
            });
            self.left_out = 0;
        }
        taken
    }

    /// Gives back lines whose request failed.
    pub(crate) fn put_back(&mut self, lines: Vec<Line>) {
        for line in lines.into_iter().rev() {
            if self.lines.len() >= MAX_LINES {
                self.left_out += 1;
            } else {
                self.lines.push_front(line);
            }
        }
    }
}

/// The longest start of `text` within `max_bytes` that ends between characters.
pub(crate) fn cut(text: &str, max_bytes: usize) -> &str {
    &text[..text.floor_char_boundary(max_bytes)]
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn a_flood_is_cut_and_counted() {
        let mut buffer = LogBuffer::new();
        let start = buffer.refilled_at;
        for number in 0..10_000 {
            buffer.push_text(&format!("line {number}"), start);
        }
        buffer.push(Level::Error, "the end");
        let taken = buffer.take();
        assert_eq!(taken.len(), BATCH);
        assert_eq!(taken[0].message, "line 0");
        let rest = buffer.take();
        assert_eq!(rest[0].message, "the end");
        assert_eq!(rest[1].message, "9800 lines of output left out");
        assert!(buffer.is_empty());

        buffer.push_text("later", start + Duration::from_secs(1));
        assert_eq!(buffer.take().len(), 1);
    }

    #[test]
    fn failed_requests_lose_nothing_and_keep_order() {
        let mut buffer = LogBuffer::new();
        for number in 0..3 {
            buffer.push(Level::Info, &number.to_string());
        }
        let taken = buffer.take();
        buffer.push(Level::Info, "3");
        buffer.put_back(taken);
        let order: Vec<String> = buffer.take().into_iter().map(|line| line.message).collect();
        assert_eq!(order, ["0", "1", "2", "3"]);
    }

    #[test]
    fn stays_bounded_while_the_coordinator_is_away() {
        let mut buffer = LogBuffer::new();
        for number in 0..50_000 {
            buffer.push(Level::Info, &"x".repeat(number % 9000));
        }
        assert_eq!(buffer.lines.len(), MAX_LINES);
        assert!(
            buffer
                .lines
                .iter()
                .all(|line| line.message.len() <= MAX_LINE_BYTES)
        );
    }

    #[test]
    fn cuts_between_characters() {
        assert_eq!(cut("aäb", 2), "a");
        assert_eq!(cut("aäb", 3), "aä");
        assert_eq!(cut("short", 100), "short");
    }
}
