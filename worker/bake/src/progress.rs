//! Progress of a whole bake: one percentage, one estimate of the time left.

use ign_events::{Event, Level, Progress};
use std::cell::RefCell;
use std::time::{Duration, Instant};

/// Share of a bake's expected time per stage.
pub(crate) type Shares = Vec<(&'static str, f64)>;

/// Progress events at most this often.
const INTERVAL: Duration = Duration::from_millis(500);

/// Emits events for one bake.
pub(crate) struct Reporter<'a> {
    sink: &'a dyn Fn(Event),
    state: RefCell<State>,
}

struct State {
    shares: Shares,
    /// Part of the stage that one of its several trainings is.
    span: (f64, f64),
    /// Part of that which steps report on.
    part: (f64, f64),
    started: Instant,
    /// Percent at the start: a resumed bake does not begin at 0, and its estimate must not either.
    first_percent: Option<f64>,
    last_sent: Option<Instant>,
    stage: &'static str,
    /// Part of the stage whose time is kept apart; empty for the rest of it.
    activity: &'static str,
    activity_started: Instant,
    stages: Vec<(String, f64)>,
    error: Option<f64>,
}

impl<'a> Reporter<'a> {
    pub(crate) fn new(sink: &'a dyn Fn(Event)) -> Self {
        let now = Instant::now();
        Self {
            sink,
            state: RefCell::new(State {
                shares: shares(0),
                span: (0.0, 1.0),
                part: (0.0, 1.0),
                started: now,
                first_percent: None,
                last_sent: None,
                stage: "",
                activity: "",
                activity_started: now,
                stages: Vec::new(),
                error: None,
            }),
        }
    }

    /// Expects so many methods to be trained for comparison, between `composition` and `evaluate`.
    pub(crate) fn expect(&self, methods: usize) {
        self.state.borrow_mut().shares = shares(methods);
    }

    /// Says which part of the stage the next parts are.
    pub(crate) fn span(&self, from: f64, to: f64) {
        let mut state = self.state.borrow_mut();
        state.span = (from, to);
        state.part = (0.0, 1.0);
    }

    /// Says which part of the stage, or of its present span, the next steps are.
    pub(crate) fn part(&self, from: f64, to: f64) {
        self.state.borrow_mut().part = (from, to);
    }

    /// Begins a stage; the time of the former one is kept.
    pub(crate) fn stage(&self, stage: &'static str, message: &str) {
        {
            let mut state = self.state.borrow_mut();
            close_activity(&mut state);
            state.stage = stage;
            state.activity = "";
            state.span = (0.0, 1.0);
            state.part = (0.0, 1.0);
            state.last_sent = None;
        }
        self.step(0.0, message);
    }

    /// Keeps the time from here on apart, as `STAGE: NAME`; an empty name is the rest of the stage. Returns the former name.
    pub(crate) fn activity(&self, name: &'static str) -> &'static str {
        let mut state = self.state.borrow_mut();
        close_activity(&mut state);
        std::mem::replace(&mut state.activity, name)
    }

    /// Reports progress within the stage, from 0 to 1.
    pub(crate) fn step(&self, fraction: f64, message: &str) {
        let mut state = self.state.borrow_mut();
        let now = Instant::now();
        if state.last_sent.is_some_and(|last| now - last < INTERVAL) {
            return;
        }
        state.last_sent = Some(now);
        let total: f64 = state.shares.iter().map(|(_, share)| share).sum();
        let before: f64 = state
            .shares
            .iter()
            .take_while(|(name, _)| *name != state.stage)
            .map(|(_, share)| share)
            .sum();
        let share = state
            .shares
            .iter()
            .find(|(name, _)| *name == state.stage)
            .map_or(0.0, |(_, share)| *share);
        let within = |(from, to): (f64, f64), fraction: f64| from + (to - from) * fraction;
        let fraction = within(state.span, within(state.part, fraction.clamp(0.0, 1.0)));
        let percent = 100.0 * (before + share * fraction) / total;
        let first = *state.first_percent.get_or_insert(percent);
        let done = percent - first;
        let eta_secs =
            (done > 3.0).then(|| state.started.elapsed().as_secs_f64() * (100.0 - percent) / done);
        let event = Event::Progress(Progress {
            stage: state.stage.to_owned(),
            percent,
            eta_secs,
            error: state.error,
            message: message.to_owned(),
        });
        drop(state);
        (self.sink)(event);
    }

    /// Keeps the newest validation error for the progress line.
    pub(crate) fn error(&self, mse: f64) {
        self.state.borrow_mut().error = Some(mse);
    }

    pub(crate) fn info(&self, message: impl Into<String>) {
        // Evaluated before the macro, which skips its arguments when nobody listens.
        let message = self.log(Level::Info, message.into());
        tracing::info!("{message}");
    }

    pub(crate) fn warn(&self, message: impl Into<String>) {
        let message = self.log(Level::Warn, message.into());
        tracing::warn!("{message}");
    }

    fn log(&self, level: Level, message: String) -> String {
        (self.sink)(Event::Log {
            level,
            message: message.clone(),
        });
        message
    }

    pub(crate) fn emit(&self, event: Event) {
        (self.sink)(event);
    }

    /// Seconds per stage and activity so far, in order; together all the time since the first stage began.
    pub(crate) fn stages(&self) -> Vec<(String, f64)> {
        let mut state = self.state.borrow_mut();
        close_activity(&mut state);
        state.stages.clone()
    }
}

fn shares(methods: usize) -> Shares {
    let before = [
        ("import", 4.0),
        ("plan", 6.0),
        ("effects", 25.0),
        ("composition", 35.0),
    ];
    let after = [("evaluate", 8.0), ("pack", 4.0)];
    before
        .into_iter()
        .chain((methods > 0).then_some(("comparison", 60.0 * methods as f64)))
        .chain(after)
        .collect()
}

fn close_activity(state: &mut State) {
    let secs = state.activity_started.elapsed().as_secs_f64();
    state.activity_started = Instant::now();
    let name = match (state.stage, state.activity) {
        ("", _) => return,
        (stage, "") => stage.to_owned(),
        (stage, activity) => format!("{stage}: {activity}"),
    };
    match state.stages.iter_mut().find(|(known, _)| *known == name) {
        Some((_, total)) => *total += secs,
        None => state.stages.push((name, secs)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn activities_split_the_time_of_their_stage() {
        let reporter = Reporter::new(&|_| {});
        let wait = || std::thread::sleep(Duration::from_millis(5));
        reporter.stage("plan", "");
        wait();
        reporter.stage("composition", "");
        for _ in 0..2 {
            let before = reporter.activity("steps");
            wait();
            assert_eq!(reporter.activity(before), "steps");
            wait();
        }
        let stages = reporter.stages();
        let names: Vec<&str> = stages.iter().map(|(name, _)| name.as_str()).collect();
        assert_eq!(names, ["plan", "composition", "composition: steps"]);
        assert!(
            stages[1..].iter().all(|(_, secs)| *secs >= 0.01),
            "{stages:?}"
        );
    }
}
