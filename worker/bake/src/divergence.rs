//! Notices within a few steps that a training diverges, and keeps the record of what was done about it.

use serde::{Deserialize, Serialize};

/// A loss this many times the usual one is no bad luck with the samples.
const EXPLODED: f64 = 10.0;
/// Suspicious steps in a row that make a divergence: one may be a hard sample.
const PATIENCE: u32 = 3;
/// What the usual loss keeps of itself per step.
const MEMORY: f64 = 0.9;
/// Losses below this are all the same: zero.
const LEAST: f64 = 1e-6;

/// Watches the losses of one training. Part of its checkpoints, so that a resumed training notices the same.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Watchdog {
    /// Moving average of the losses that were not suspicious.
    usual: Option<f64>,
    suspicious: u32,
}

impl Watchdog {
    /// Takes the loss of a step and whether its gradient could be applied; says why if the training has diverged.
    pub(crate) fn diverged(&mut self, loss: f64, applied: bool) -> Option<&'static str> {
        if !loss.is_finite() {
            return Some("the loss is not finite");
        }
        let exploded = self
            .usual
            .is_some_and(|usual| loss > EXPLODED * usual.max(LEAST));
        if applied && !exploded {
            self.suspicious = 0;
            let usual = self.usual.unwrap_or(loss);
            self.usual = Some(MEMORY * usual + (1.0 - MEMORY) * loss);
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
