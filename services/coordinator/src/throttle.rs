//! Token buckets: each key may do `burst` things at once and `per_sec` of them in the long run.

use std::collections::HashMap;
use std::hash::Hash;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use crate::limits::Rate;

/// Keys that are remembered; a key whose bucket is full is the same as one never seen.
const MAX_KEYS: usize = 10_000;

#[derive(Debug)]
pub(crate) struct Throttle<K> {
    rate: Rate,
    buckets: Mutex<HashMap<K, Bucket>>,
}

#[derive(Clone, Copy, Debug)]
struct Bucket {
    left: f64,
    at: Instant,
}

impl Bucket {
    fn filled(self, rate: Rate, now: Instant) -> Self {
        let secs = now.saturating_duration_since(self.at).as_secs_f64();
        Self {
            left: (self.left + secs * rate.per_sec).min(f64::from(rate.burst)),
            at: now,
        }
    }
}

impl<K: Eq + Hash> Throttle<K> {
    pub(crate) fn new(rate: Rate) -> Self {
        Self {
            rate,
            buckets: Mutex::default(),
        }
    }

    fn buckets(&self) -> MutexGuard<'_, HashMap<K, Bucket>> {
        self.buckets.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// How long the key must wait; none when it need not.
    pub(crate) fn wait(&self, key: &K, now: Instant) -> Option<Duration> {
        let bucket = self.buckets().get(key)?.filled(self.rate, now);
        (bucket.left < 1.0)
            .then(|| Duration::from_secs_f64((1.0 - bucket.left) / self.rate.per_sec))
    }

    /// Counts one thing that the key did, or says how long it must wait before it may.
    pub(crate) fn take(&self, key: K, now: Instant) -> Result<(), Duration> {
        if let Some(wait) = self.wait(&key, now) {
            return Err(wait);
        }
        let mut buckets = self.buckets();
        if buckets.len() >= MAX_KEYS {
            let full = f64::from(self.rate.burst);
            buckets.retain(|_, bucket| bucket.filled(self.rate, now).left < full);
            if buckets.len() >= MAX_KEYS {
                buckets.clear();
            }
        }
        let fresh = Bucket {
            left: f64::from(self.rate.burst),
            at: now,
        };
        let bucket = buckets.entry(key).or_insert(fresh);
        *bucket = bucket.filled(self.rate, now);
        bucket.left -= 1.0;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_burst_then_a_rate() {
        let throttle = Throttle::new(Rate {
            per_sec: 2.0,
            burst: 3,
        });
        let start = Instant::now();
        for _ in 0..3 {
            assert_eq!(throttle.take("a", start), Ok(()));
        }
        let wait = throttle.take("a", start).unwrap_err();
        assert_eq!(wait, Duration::from_millis(500));
        assert_eq!(throttle.take("b", start), Ok(()));
        let later = start + wait;
        assert_eq!(throttle.take("a", later), Ok(()));
        assert!(throttle.take("a", later).is_err());
        // Never more than the burst, however long nothing came.
        let much_later = start + Duration::from_hours(1);
        assert_eq!(
            (0..9)
                .filter(|_| throttle.take("a", much_later).is_ok())
                .count(),
            3
        );
    }

    #[test]
    fn memory_is_bounded() {
        let throttle = Throttle::new(Rate {
            per_sec: 1e-3,
            burst: 2,
        });
        let now = Instant::now();
        for key in 0..3 * MAX_KEYS {
            assert_eq!(throttle.take(key, now), Ok(()));
        }
        assert!(throttle.buckets().len() <= MAX_KEYS);
    }
}
