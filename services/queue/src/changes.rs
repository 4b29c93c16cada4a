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

/// What sort of change it was.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Change {
    /// Nobody need look.
    Nothing,
    /// Something can be seen.
    Job,
    /// Something can be seen, and a lease may succeed that did not before.
    Work,
}

/// Numbers of changes that this process made.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Own {
    pub(crate) all: u64,
    pub(crate) work: u64,
}

/// The sending side, inside a store.
#[derive(Debug)]
pub(crate) struct Signal {
    all: watch::Sender<u64>,
    work: watch::Sender<u64>,
    own: watch::Sender<Own>,
    poll: Duration,
}

impl Signal {
    pub(crate) fn new(poll: Duration) -> Self {
        Self {
            all: watch::Sender::new(0),
            work: watch::Sender::new(0),
            own: watch::Sender::new(Own::default()),
            poll,
        }
    }

    /// After this process changed something.
    pub(crate) fn raise(&self, change: Change) {
        if change == Change::Nothing {
            return;
        }
        self.own.send_modify(|own| {
            own.all = own.all.wrapping_add(1);
            if change == Change::Work {
                own.work = own.work.wrapping_add(1);
            }
        });
        self.raise_foreign(change);
    }

    /// After another process did; it is not told further.
    pub(crate) fn raise_foreign(&self, change: Change) {
        if change == Change::Work {
            bump(&self.work);
        }
        if change != Change::Nothing {
            bump(&self.all);
        }
    }

    pub(crate) fn subscribe(&self) -> Changes {
        Changes {
            generation: self.all.subscribe(),
            poll: self.poll,
        }
    }

    pub(crate) fn subscribe_work(&self) -> Changes {
        Changes {
            generation: self.work.subscribe(),
            poll: self.poll,
        }
    }

    pub(crate) fn subscribe_own(&self) -> watch::Receiver<Own> {
        self.own.subscribe()
    }
}

fn bump(counter: &watch::Sender<u64>) {
    counter.send_modify(|count| *count = count.wrapping_add(1));
}
