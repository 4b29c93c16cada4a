//! What was measured, with its target.

use std::io::Write as _;
use std::time::Duration;

use serde_json::{Value, json};

/// All figures of a run, in the order in which they were measured.
#[derive(Debug, Default)]
pub(crate) struct Figures(Vec<Value>);

/// A bound that a figure is to keep.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Target {
    AtLeast(f64),
    AtMost(f64),
}

impl Target {
    fn holds(self, value: f64) -> bool {
        match self {
            Self::AtLeast(bound) => value >= bound,
            Self::AtMost(bound) => value <= bound,
        }
    }

    fn text(self, unit: &str) -> String {
        match self {
            Self::AtLeast(bound) => format!(">= {bound} {unit}"),
            Self::AtMost(bound) => format!("<= {bound} {unit}"),
        }
    }
}

impl Figures {
    /// The median of some runs of ours.
    pub(crate) fn alone(&mut self, name: &str, unit: &str, runs: &[f64], target: Option<Target>) {
        let value = median(runs);
        self.push(
            name,
            unit,
            value,
            target.map(|it| (it.text(unit), it.holds(value))),
            &json!({ "runs": runs }),
        );
    }

    /// The medians of both sides of alternating runs; the target is their ratio.
    pub(crate) fn beside(
        &mut self,
        name: &str,
        unit: &str,
        ours: &[f64],
        (peer_name, peer): (&str, &[f64]),
        at_least: Option<f64>,
    ) {
        let (value, other) = (median(ours), median(peer));
        let ratio = value / other;
        let target = at_least.map(|share| (format!(">= {share} x {peer_name}"), ratio >= share));
        let more = json!({
            "runs": ours, "peer_name": peer_name, "peer": other, "peer_runs": peer, "share_of_peer": ratio,
        });
        self.push(name, unit, value, target, &more);
    }

    /// The 95th percentile of times, in milliseconds.
    pub(crate) fn p95_ms(&mut self, name: &str, times: &[Duration], target: Option<Target>) {
        let mut ms: Vec<f64> = times.iter().map(|time| time.as_secs_f64() * 1e3).collect();
        ms.sort_by(f64::total_cmp);
        let at =
            |share: f64| ms[((ms.len() as f64 * share).ceil() as usize).clamp(1, ms.len()) - 1];
        let more = json!({ "runs": ms.len(), "median_ms": at(0.5), "worst_ms": at(1.0) });
        let value = at(0.95);
        let target = target.map(|it| (it.text("ms"), it.holds(value)));
        self.push(&format!("{name}, p95"), "ms", value, target, &more);
    }

    fn push(
        &mut self,
        name: &str,
        unit: &str,
        value: f64,
        target: Option<(String, bool)>,
        more: &Value,
    ) {
        let (target, holds) = target.unzip();
        let mut figure = json!({
            "name": name, "unit": unit, "value": value, "target": target, "holds": holds,
        });
        if let (Some(figure), Some(more)) = (figure.as_object_mut(), more.as_object()) {
            figure.extend(more.clone());
        }
        say(&figure.to_string());
        self.0.push(figure);
    }

    /// All of them as one line on stdout.
    pub(crate) fn print(&self) {
        let line = json!({ "figures": self.0 });
        // Whoever closed the pipe does not want it.
        let _closed = writeln!(std::io::stdout(), "{line}");
    }
}

/// Tells whoever waits.
#[expect(clippy::print_stderr, reason = "a benchmark's progress")]
pub(crate) fn say(text: &str) {
    eprintln!("service: {text}");
}

fn median(runs: &[f64]) -> f64 {
    let mut sorted = runs.to_vec();
    sorted.sort_by(f64::total_cmp);
    let middle = sorted.len() / 2;
    if sorted.len() % 2 == 1 {
        sorted[middle]
    } else {
        f64::midpoint(sorted[middle - 1], sorted[middle])
    }
}
