//! Calls that come while a transaction runs share the next one.
//!
//! A commit costs a flush of the disk and as many round trips for one job as for thirty. The first of the calls that
//! wait runs for all of them; nobody waits for company, so a call that comes alone is served at once. One runs at a time:
//! with two, groups are half as large, and 64 workers got a tenth less done (`make bench BENCH=service`). Groups come in
//! powers of two: a statement's text depends on its number of rows, and so few texts stay prepared.
//!
//! A caller that leaves while it runs for others costs them a turn: they ask again. So only what may be asked twice is
//! asked here, because the transaction may have been committed before the caller left.

use std::collections::VecDeque;
use std::sync::{Mutex, MutexGuard, PoisonError};

use tokio::sync::oneshot::{self, error::TryRecvError};

/// Calls in one transaction: few enough that the first does not wait long for the last.
const MAX_CALLS: usize = 32;

/// Calls of one kind, with what they ask and hear.
#[derive(Debug)]
pub(crate) struct Group<Ask, Answer> {
    waiting: Mutex<VecDeque<(Ask, oneshot::Sender<Answer>)>>,
    turn: tokio::sync::Mutex<()>,
}

impl<Ask, Answer> Default for Group<Ask, Answer> {
    fn default() -> Self {
        Self {
            waiting: Mutex::default(),
            turn: tokio::sync::Mutex::default(),
        }
    }
}

impl<Ask, Answer> Group<Ask, Answer> {
    /// The answer to `ask`, from `run` called here or by another caller; it gives one answer for each.
    pub(crate) async fn join<Run, Ran>(&self, ask: Ask, run: Run) -> Answer
    where
        Ask: Clone,
        Run: Fn(Vec<Ask>) -> Ran,
        Ran: Future<Output = Vec<Answer>>,
    {
        loop {
            if let Some(answer) = self.join_once(ask.clone(), &run).await {
                return answer;
            }
        }
    }

    /// None when another caller ran it and left in the middle.
    async fn join_once<Run, Ran>(&self, ask: Ask, run: &Run) -> Option<Answer>
    where
        Run: Fn(Vec<Ask>) -> Ran,
        Ran: Future<Output = Vec<Answer>>,
    {
        let (sender, mut answer) = oneshot::channel();
        self.waiting().push_back((ask, sender));
        let _turn = tokio::select! {
            biased;
            answered = &mut answer => return answered.ok(),
            turn = self.turn.lock() => turn,
        };
        loop {
            match answer.try_recv() {
                Ok(answered) => return Some(answered),
                Err(TryRecvError::Closed) => return None,
                Err(TryRecvError::Empty) => {}
            }
            // Ours waits, perhaps behind a full group, or another caller has it.
            let (asks, senders): (Vec<_>, Vec<_>) = self.next().into_iter().unzip();
            if asks.is_empty() {
                return answer.await.ok();
            }
            for (sender, answered) in senders.into_iter().zip(run(asks).await) {
                // A caller that left does not want it.
                sender.send(answered).ok();
            }
        }
    }

    fn next(&self) -> Vec<(Ask, oneshot::Sender<Answer>)> {
        let mut waiting = self.waiting();
        let count = waiting.len().min(MAX_CALLS);
        let group = count.checked_ilog2().map_or(0, |power| 1 << power);
        waiting.drain(..group).collect()
    }

    fn waiting(&self) -> MutexGuard<'_, VecDeque<(Ask, oneshot::Sender<Answer>)>> {
        self.waiting.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;
    use std::sync::atomic::{AtomicUsize, Ordering};

    use super::*;

    #[tokio::test]
    async fn each_call_gets_its_own_answer_and_calls_that_wait_share_a_run() {
        let (group, runs) = (Arc::new(Group::default()), Arc::new(AtomicUsize::new(0)));
        let calls = (0..100_usize).map(|number| {
            let (group, runs) = (group.clone(), runs.clone());
            tokio::spawn(async move {
                let double = |asks: Vec<usize>| {
                    runs.fetch_add(1, Ordering::Relaxed);
                    assert!(asks.len().is_power_of_two() && asks.len() <= MAX_CALLS);
                    async {
                        tokio::task::yield_now().await;
                        asks.into_iter().map(|ask| 2 * ask).collect()
                    }
                };
                assert_eq!(group.join(number, double).await, 2 * number);
            })
        });
        for call in calls.collect::<Vec<_>>() {
            call.await.unwrap();
        }
        let runs = runs.load(Ordering::Relaxed);
        assert!((4..=40).contains(&runs), "{runs} runs for 100 calls");
    }

    #[tokio::test]
    async fn a_caller_that_leaves_in_the_middle_costs_the_others_a_turn() {
        let group = Arc::new(Group::<u8, u8>::default());
        let caller = |number: u8, runs: bool| {
            let group = group.clone();
            tokio::spawn(async move {
                let run = |asks: Vec<u8>| async move {
                    if !runs {
                        std::future::pending::<()>().await;
                    }
                    asks
                };
                group.join(number, run).await
            })
        };
        // The first has the only turn; the second will run for itself and the third, and never ends.
        let first = caller(1, false);
        tokio::task::yield_now().await;
        let (second, third, fourth) = (caller(2, false), caller(3, true), caller(4, true));
        tokio::task::yield_now().await;
        for leaves in [first, second] {
            leaves.abort();
            leaves.await.unwrap_err();
            tokio::task::yield_now().await;
        }
        assert_eq!((third.await.unwrap(), fourth.await.unwrap()), (3, 4));
    }
}
