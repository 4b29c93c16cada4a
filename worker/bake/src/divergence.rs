//! Notices within a few steps that a training diverges, and keeps the record of what was done about it.

use serde::{Deserialize, Serialize};

/// A loss this many times the usual one is no bad luck with the samples.
const EXPLODED: f64 = 10.0;
/// Suspicious steps in a row that make a divergence: one may be a hard sample.
const PATIENCE: u32 = 3;
/// What the usual loss keeps of itself per step.
const MEMORY: f64 = 0.9;
/// Losses whose mean says what is usual. Before, since a stage may begin with samples that show next to nothing, only a loss
/// that also goes on growing is suspicious.
const ENOUGH: u32 = 10;
/// Times the loss before it.
const GROWING: f64 = 2.0;
/// Losses below this are all the same: zero.
const LEAST: f64 = 1e-6;

/// Watches the losses of one training. Part of its checkpoints, so that a resumed training notices the same.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub(crate) struct Watchdog {
    /// Mean of the losses that were not suspicious, of late.
    mean: f64,
    /// How many they were.
    seen: u32,
    /// The loss before.
    last: f64,
    suspicious: u32,
}

impl Watchdog {
    /// Takes the loss of a step and whether its gradient could be applied; says why if the training has diverged.
    pub(crate) fn diverged(&mut self, loss: f64, applied: bool) -> Option<&'static str> {
        if !loss.is_finite() {
            return Some("the loss is not finite");
        }
        let settled = self.seen >= ENOUGH;
        let exploded = self.seen > 0
            && loss > EXPLODED * self.mean.max(LEAST)
            && (settled || loss > GROWING * self.last);
        self.last = loss;
        if applied && !exploded {
            self.suspicious = 0;
            self.seen = self.seen.saturating_add(1);
            let share = (1.0 - MEMORY).max(1.0 / f64::from(self.seen));
            self.mean += share * (loss - self.mean);
            return None;
        }
        self.suspicious += 1;
        (self.suspicious >= PATIENCE).then_some(if exploded {
            "the loss has grown tenfold"
        } else {
            "gradients are not finite"
        })
    }
}

/// A training that diverged and went back.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Fallback {
    pub(crate) stage: String,
    /// The step at which it was noticed.
    pub(crate) step: u64,
    /// The step that training went on from.
    pub(crate) back_to: u64,
    /// Factor of the learning rate from then on; 0: training ended.
    pub(crate) rate_scale: f64,
    pub(crate) reason: String,
}

impl Fallback {
    /// For the log, the plan and the report.
    pub(crate) fn words(&self) -> String {
        let then = if self.rate_scale > 0.0 {
            format!("with the learning rate times {}", self.rate_scale)
        } else {
            "for good: its best weights so far are kept".to_owned()
        };
        format!(
            "Training of {} diverged at step {} ({}) and went back to step {} {then}.",
            self.stage, self.step, self.reason, self.back_to
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hard_samples_are_no_divergence_but_a_jump_is() {
        let mut dog = Watchdog::default();
        for step in 0..200 {
            // Every other sample is eight times harder, one in fifty thirty times.
            let loss = match step {
                s if s % 50 == 49 => 30.0,
                s if s % 2 == 1 => 8.0,
                _ => 1.0,
            };
            assert_eq!(dog.diverged(loss, true), None, "step {step}");
        }
        let noticed = (0..5).position(|_| dog.diverged(100.0, true).is_some());
        assert_eq!(noticed, Some(2));
        assert!(Watchdog::default().diverged(f64::NAN, true).is_some());
        assert!(Watchdog::default().diverged(f64::INFINITY, true).is_some());
    }

    /// The paper's pairs of views may begin with one that hardly overlaps.
    #[test]
    fn samples_that_show_next_to_nothing_at_the_start_make_no_divergence() {
        let mut dog = Watchdog::default();
        for loss in [1e-4, 0.05, 0.04, 0.07, 0.06, 2e-4, 0.05] {
            assert_eq!(dog.diverged(loss, true), None, "{loss}");
        }
        for _ in 0..20 {
            assert_eq!(dog.diverged(0.05, true), None);
        }
        let noticed = (0..5).position(|_| dog.diverged(5.0, true).is_some());
        assert_eq!(noticed, Some(2));
    }

    #[test]
    fn gradients_that_cannot_be_applied_are_noticed() {
        let mut dog = Watchdog::default();
        assert_eq!(dog.diverged(1.0, false), None);
        assert_eq!(dog.diverged(1.0, true), None);
        assert_eq!(dog.diverged(1.0, false), None);
        assert_eq!(dog.diverged(1.0, false), None);
        assert!(dog.diverged(1.0, false).is_some());
    }
}
