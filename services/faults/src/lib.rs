//! Fault points: named places in the code at which a test can end or freeze the process, to prove that it may happen
//! there.
//!
//! `IGN_FAULT=publish.committed@2` kills the process, as SIGKILL would, when it reaches that point for the second time;
//! `IGN_FAULT=agent.sent@1:freeze` stops it there as SIGSTOP would, until somebody sends SIGCONT. A release build holds
//! nothing of this: [`point`] is empty there.
//!
//! Invariant: every point that the code names is in [`POINTS`]; a name that is not there panics in tests.

/// Every point, in the order in which a job passes them.
pub const POINTS: [&str; 17] = [
    // An upload, in the registry.
    "blob.written",
    "upload.finished",
    "manifest.written",
    // A submit, in the coordinator.
    "submit.checked",
    "submit.committed",
    "lease.committed",
    // A job, in the agent.
    "agent.leased",
    "agent.fetched",
    "agent.checkpoint_sent",
    "checkpoint.checked",
    "checkpoint.committed",
    "agent.checkpoint_told",
    "agent.sent",
    // A publish, in coordinator and registry.
    "publish.committed",
    "version.recorded",
    "state.recorded",
    "agent.completed",
];

/// A place where the process may be ended; see the crate's text.
#[inline]
pub fn point(name: &'static str) {
    #[cfg(debug_assertions)]
    armed::reach(name);
    #[cfg(not(debug_assertions))]
    let _in_tests_only = name;
}

#[cfg(debug_assertions)]
mod armed {
    use std::sync::OnceLock;
    use std::sync::atomic::{AtomicU32, Ordering};

    use rustix::process::{Signal, getpid, kill_process};

    use crate::POINTS;

    #[derive(Debug, PartialEq, Eq)]
    pub(crate) struct Fault {
        pub(crate) point: String,
        pub(crate) times: u32,
        pub(crate) freeze: bool,
    }

    static FAULT: OnceLock<Option<Fault>> = OnceLock::new();
    static REACHED: AtomicU32 = AtomicU32::new(0);

    pub(crate) fn reach(name: &'static str) {
        assert!(POINTS.contains(&name), "fault point {name} is not listed");
        let fault = FAULT.get_or_init(|| parse(&std::env::var("IGN_FAULT").ok()?));
        if let Some(fault) = fault
            && fault.point == name
            && REACHED.fetch_add(1, Ordering::SeqCst) + 1 == fault.times
        {
            let signal = if fault.freeze {
                Signal::STOP
            } else {
                Signal::KILL
            };
            // Nothing may follow: the signal is delivered before the call returns, or the process goes on unharmed.
            kill_process(getpid(), signal).ok();
        }
    }

    /// `point@times`, `point@times:freeze`.
    pub(crate) fn parse(text: &str) -> Option<Fault> {
        let (point, rest) = text.split_once('@')?;
        let (times, freeze) = match rest.strip_suffix(":freeze") {
            Some(times) => (times, true),
            None => (rest, false),
        };
        Some(Fault {
            point: point.to_owned(),
            times: times.parse().ok()?,
            freeze,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::armed::{Fault, parse};
    use super::*;

    #[test]
    fn faults_are_named_by_point_and_count() {
        let fault = |freeze| Fault {
            point: "agent.sent".to_owned(),
            times: 3,
            freeze,
        };
        assert_eq!(parse("agent.sent@3"), Some(fault(false)));
        assert_eq!(parse("agent.sent@3:freeze"), Some(fault(true)));
        for bad in ["", "agent.sent", "agent.sent@", "agent.sent@x", "@"] {
            assert_eq!(parse(bad), None, "{bad}");
        }
        // Not armed: passing is free.
        for name in POINTS {
            point(name);
        }
    }
}
