//! Waiting between tries: exponential, capped, with jitter so that many workers do not come back at the same moment.

use std::time::Duration;

/// Delays of a row of failed tries.
#[derive(Clone, Debug)]
pub(crate) struct Backoff {
    base: Duration,
    cap: Duration,
    failures: u32,
}

impl Backoff {
    pub(crate) fn new(base: Duration, cap: Duration) -> Self {
        Self {
            base,
            cap,
            failures: 0,
        }
    }

    /// Starts again at the shortest delay: the last try went well, or at least further.
    pub(crate) fn reset(&mut self) {
        self.failures = 0;
    }

    /// How long to wait before the next try: between half of the doubled delay and all of it.
    pub(crate) fn next_delay(&mut self) -> Duration {
        let full = self
            .base
            .saturating_mul(1 << self.failures.min(16))
            .min(self.cap);
        self.failures = self.failures.saturating_add(1);
        full.mul_f64(0.5 + 0.5 * rand::random::<f64>())
    }
}

impl Default for Backoff {
    fn default() -> Self {
        Self::new(Duration::from_millis(250), Duration::from_secs(15))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn grows_to_its_cap_and_starts_again() {
        let mut backoff = Backoff::new(Duration::from_millis(100), Duration::from_secs(1));
        let mut full = 100;
        for _ in 0..40 {
            let delay = backoff.next_delay();
            assert!(
                delay >= Duration::from_millis(full / 2),
                "{delay:?} of {full}"
            );
            assert!(delay <= Duration::from_millis(full), "{delay:?} of {full}");
            full = (full * 2).min(1000);
        }
        backoff.reset();
        assert!(backoff.next_delay() <= Duration::from_millis(100));
    }
}
