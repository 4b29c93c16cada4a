//! Waiting for changes without polling hard, and without missing one.
//!
//! A [`Changes`] is made before the query; a change that falls between the query and [`Changes::wait`] ends the wait at
//! once. Signals are hints: they carry no data, may come for nothing, and may be lost (another process died before it
//! sent one), so every wait ends after the poll interval at the latest and the caller asks the store again.

use std::time::Duration;

use tokio::sync::watch;

/// Interest in changes since it was made or last waited.
#[derive(Clone, Debug)]
pub struct Changes {
    generation: watch::Receiver<u64>,
    poll: Duration,
}

impl Changes {
    /// Returns after a change, after `at_most`, or after the store's poll interval: whichever comes first. Then ask the
    /// store again.
    pub async fn wait(&mut self, at_most: Duration) {
        // An error (the store is gone) reads like a change: the next query tells.
        tokio::time::timeout(at_most.min(self.poll), self.generation.changed())
            .await
            .ok();
    }
}

/// The sending side, inside a store.
#[derive(Debug)]
pub(crate) struct Signal {
    generation: watch::Sender<u64>,
    /// Changes that this process made, to be told to others.
    own: watch::Sender<u64>,
    poll: Duration,
}

impl Signal {
    pub(crate) fn new(poll: Duration) -> Self {
        Self {
            generation: watch::Sender::new(0),
            own: watch::Sender::new(0),
            poll,
        }
    }

    /// After this process changed something.
    pub(crate) fn raise(&self) {
        bump(&self.own);
        bump(&self.generation);
    }

    /// After another process did.
    pub(crate) fn raise_foreign(&self) {
        bump(&self.generation);
    }

    pub(crate) fn subscribe(&self) -> Changes {
        Changes {
            generation: self.generation.subscribe(),
            poll: self.poll,
        }
    }

    pub(crate) fn subscribe_own(&self) -> watch::Receiver<u64> {
        self.own.subscribe()
    }
}

fn bump(counter: &watch::Sender<u64>) {
    counter.send_modify(|count| *count = count.wrapping_add(1));
}
