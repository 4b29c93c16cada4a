//! How long a stage trains, and how fast it learns meanwhile.
//!
//! The learning rate falls with the root of a stage's steps, so that the weights are nearly settled wherever it ends, and over
//! the last quarter along a cosine to almost nothing. A stage that trains [while it pays](Rate::WhileItPays) begins that end
//! once a doubling of its length no longer lowers the error on validation views by enough.
//!
//! Against a cosine over the whole of `CompositionNet`'s 1000 steps: matte demo vase, 64 px, held-out error 7.15 with the cosine,
//! 6.92 with the root.

use serde::{Deserialize, Serialize};

/// Steps in which the learning rate rises to its peak.
const WARM_STEPS: u64 = 20;
/// What the rate falls to, as a share of its peak.
const LOWEST_RATE: f64 = 0.02;
/// Length of the falling end, as a share of what the stage took before.
const TAIL: f64 = 1.0 / 3.0;
/// Observations of a stage whose end is known, beside the one at its start.
const OBSERVATIONS: u64 = 8;
/// Step of the first observation of a stage that trains while it pays; the next ones are a factor apart.
const FIRST_OBSERVED: u64 = 64;
const OBSERVED_APART: f64 = std::f64::consts::SQRT_2;
/// An observation counts as one at half the length up to this share.
const HALF: f64 = 0.55;

/// How long a stage trains at most, and at what rate.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Schedule {
    pub(crate) steps: u64,
    pub(crate) budget_secs: Option<f64>,
    pub(crate) rate: Rate,
}

/// Course of a learning rate.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Rate {
    /// The paper's.
    Constant,
    /// See the module.
    Falling {
        /// Step from which on it falls.
        knee: f64,
    },
    /// The same, to an end that is decided on the way.
    WhileItPays {
        /// Step from which on it falls.
        knee: f64,
        worth: Worth,
    },
}

/// What more training must bring.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Worth {
    /// Share by which a doubling of the stage's length must lower the validation error.
    pub(crate) least_gain: f64,
    /// Steps before which nothing is decided: the first ones tell little about the rest.
    pub(crate) least_steps: u64,
    /// Validation error at which the stage ends at once.
    pub(crate) enough: Option<f64>,
}

/// What a stage has seen on its way; part of a checkpoint.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub(crate) struct Course {
    /// Progress at each observation, and the lowest validation error up to then.
    observed: Vec<(f64, Option<f64>)>,
    /// Progress at which the rate began to fall and at which the stage ends, once that is decided.
    tail: Option<(f64, f64)>,
}

impl Course {
    /// The lowest validation error so far.
    pub(crate) fn lowest(&self) -> Option<f64> {
        self.observed.last().and_then(|(_, error)| *error)
    }

    /// Whether more training was found not to pay.
    pub(crate) fn ended_early(&self) -> bool {
        self.tail.is_some()
    }

    /// Progress at which the stage ends, as far as is known.
    pub(crate) fn end(&self) -> f64 {
        self.tail.map_or(1.0, |(_, end)| end)
    }

    /// Whether these figures, read from a file, can be gone on from.
    pub(crate) fn holds(&self) -> bool {
        let share = |value: f64| (0.0..=1.0).contains(&value);
        self.observed
            .iter()
            .all(|(at, error)| share(*at) && error.is_none_or(|error| error >= 0.0))
            && self.tail.is_none_or(|(from, to)| share(from) && share(to))
    }
}

impl Schedule {
    /// Share of the longest possible training that is done.
    pub(crate) fn progress(&self, step: u64, elapsed_secs: f64) -> f64 {
        let by_time = self
            .budget_secs
            .map_or(0.0, |budget| elapsed_secs / budget.max(1e-3));
        (step as f64 / self.steps.max(1) as f64)
            .max(by_time)
            .min(1.0)
    }

    /// Whether the network is to be observed now.
    pub(crate) fn is_due(&self, course: &Course, step: u64, progress: f64) -> bool {
        let Some((last, _)) = course.observed.last() else {
            return true;
        };
        if progress >= course.end() {
            return true;
        }
        match self.rate {
            Rate::Constant | Rate::Falling { .. } => {
                progress * OBSERVATIONS as f64 >= course.observed.len() as f64
            }
            Rate::WhileItPays { .. } if course.observed.len() == 1 => step >= FIRST_OBSERVED,
            Rate::WhileItPays { .. } => course.tail.is_none() && progress >= last * OBSERVED_APART,
        }
    }

    /// Learning rate as a share of its peak.
    pub(crate) fn rate(&self, course: &Course, step: u64, progress: f64) -> f64 {
        let (Rate::Falling { knee } | Rate::WhileItPays { knee, .. }) = self.rate else {
            return 1.0;
        };
        let (from, to) = course.tail.unwrap_or((1.0 / (1.0 + TAIL), 1.0));
        let warm = ((step + 1) as f64 / WARM_STEPS as f64).min(1.0);
        let root = 1.0 / (1.0 + step as f64 / knee).sqrt();
        let fallen = ((progress - from) / (to - from).max(1e-9)).clamp(0.0, 1.0);
        let cosine = 0.5 * (1.0 + (std::f64::consts::PI * fallen).cos());
        warm * root * (LOWEST_RATE + (1.0 - LOWEST_RATE) * cosine)
    }

    /// Takes in an observation and decides whether the stage goes on.
    pub(crate) fn observed(
        &self,
        course: &mut Course,
        step: u64,
        progress: f64,
        error: Option<f64>,
    ) {
        let lowest = match (course.lowest(), error) {
            (Some(before), Some(now)) => Some(before.min(now)),
            (before, now) => before.or(now),
        };
        course.observed.push((progress, lowest));
        let (Rate::WhileItPays { worth, .. }, Some(lowest), None) =
            (self.rate, lowest, course.tail)
        else {
            return;
        };
        if worth.enough.is_some_and(|enough| lowest <= enough) {
            course.tail = Some((progress, progress));
            return;
        }
        let mut earlier = course.observed.iter().rev();
        let half = earlier.find(|(at, _)| *at <= HALF * progress);
        if step >= worth.least_steps
            && let Some((_, Some(before))) = half
            && 1.0 - lowest / before.max(1e-9) < worth.least_gain
        {
            course.tail = Some((progress, (progress * (1.0 + TAIL)).min(1.0)));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Trains without a network: `error` of the step's number. The steps observed, and the last one.
    fn run(schedule: &Schedule, error: impl Fn(u64) -> f64) -> (Vec<u64>, u64, Course) {
        let (mut course, mut step, mut seen) = (Course::default(), 0, Vec::new());
        loop {
            let progress = schedule.progress(step, 0.0);
            if schedule.is_due(&course, step, progress) {
                seen.push(step);
                schedule.observed(&mut course, step, progress, Some(error(step)));
            }
            if progress >= course.end() {
                return (seen, step, course);
            }
            let rate = schedule.rate(&course, step, progress);
            assert!(rate > 0.0 && rate <= 1.0, "{rate}");
            step += 1;
        }
    }

    fn pays(enough: Option<f64>) -> Schedule {
        Schedule {
            steps: 4000,
            budget_secs: None,
            rate: Rate::WhileItPays {
                knee: 50.0,
                worth: Worth {
                    least_gain: 0.05,
                    least_steps: 250,
                    enough,
                },
            },
        }
    }

    #[test]
    fn a_known_end_is_reached_with_the_lowest_rate() {
        let schedule = Schedule {
            steps: 100,
            budget_secs: Some(50.0),
            rate: Rate::Falling { knee: 50.0 },
        };
        let (seen, last, course) = run(&schedule, |_| 1.0);
        assert_eq!((seen.len(), last), (9, 100));
        assert!(schedule.rate(&course, 99, 0.99) < 0.021);
        assert!(schedule.rate(&course, 0, 0.0) < 0.06);
        assert!(schedule.rate(&course, 20, 0.2) > 0.8);
        // Four times the steps, half the rate.
        let ratio = schedule.rate(&course, 750, 0.7) / schedule.rate(&course, 150, 0.7);
        assert!((ratio - 0.5).abs() < 1e-9, "{ratio}");
        assert!((schedule.progress(10, 40.0) - 0.8).abs() < 1e-12);
        let constant = Schedule {
            rate: Rate::Constant,
            ..schedule
        };
        assert!((constant.rate(&course, 0, 0.0) - 1.0).abs() < 1e-12);
    }

    #[test]
    fn what_does_not_pay_ends_and_what_pays_goes_on() {
        let (_, flat, course) = run(&pays(None), |_| 4.0);
        assert!((250..400).contains(&flat), "{flat}");
        assert!(course.ended_early());
        // A tenth less with each doubling pays; from step 1000 on nothing more comes.
        let falling = |step: u64| (step.max(1) as f64).powf(-0.15);
        let (seen, last, course) = run(&pays(None), falling);
        assert_eq!(last, 4000);
        assert!(!course.ended_early() && seen.len() < 16, "{seen:?}");
        let (_, last, _) = run(&pays(None), |step| falling(step.min(1000)));
        assert!((1400..3000).contains(&last), "{last}");
    }

    #[test]
    fn a_stage_ends_at_once_when_its_error_is_low_enough() {
        let (seen, last, course) = run(&pays(Some(0.5)), |step| 1.0 - step as f64 / 1000.0);
        assert!((500..720).contains(&last), "{last}");
        assert_eq!(seen.last(), Some(&last));
        assert!(course.lowest().is_some_and(|error| error <= 0.5));
    }

    #[test]
    fn figures_out_of_range_are_not_gone_on_from() {
        for (observed, tail) in [
            (vec![(f64::NAN, None)], None),
            (vec![(0.5, Some(-1.0))], None),
            (Vec::new(), Some((0.5, 2.0))),
        ] {
            assert!(!Course { observed, tail }.holds());
        }
        assert!(Course::default().holds());
    }
}
