//! Breadth-first search over everything that can happen.

use std::collections::{BTreeMap, VecDeque};
use std::fmt::Debug;

/// Something that moves in steps which are atomic, in any order.
pub(crate) trait World: Clone + Debug {
    /// Every step that can happen next, with its name.
    fn steps(&self) -> Vec<(String, Self)>;

    /// What must always hold; the message names what does not.
    fn check(&self) -> Result<(), String>;

    /// Whether everything has come to its good end.
    fn is_done(&self) -> bool;
}

/// How large the search was.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Explored {
    pub(crate) states: usize,
    pub(crate) steps: usize,
}

/// Visits every state that can be reached. Fails with the shortest way to a state that breaks a rule, or from which no
/// good end can be reached any more.
pub(crate) fn explore<W: World>(start: W) -> Result<Explored, String> {
    let mut known: BTreeMap<String, usize> = BTreeMap::from([(format!("{start:?}"), 0)]);
    let mut states = vec![start];
    let mut came_from: Vec<Option<(usize, String)>> = vec![None];
    let mut before: Vec<Vec<usize>> = vec![Vec::new()];
    let mut open = VecDeque::from([0]);
    let mut steps = 0;
    while let Some(at) = open.pop_front() {
        let state = states[at].clone();
        state
            .check()
            .map_err(|rule| format!("{rule}\n{}", way(&came_from, at)))?;
        for (name, next) in state.steps() {
            steps += 1;
            let key = format!("{next:?}");
            let index = *known.entry(key).or_insert_with(|| {
                states.push(next);
                came_from.push(Some((at, name)));
                before.push(Vec::new());
                open.push_back(states.len() - 1);
                states.len() - 1
            });
            before[index].push(at);
        }
    }
    let mut ends_well = vec![false; states.len()];
    let mut open: Vec<usize> = (0..states.len())
        .filter(|at| states[*at].is_done())
        .collect();
    while let Some(at) = open.pop() {
        if !std::mem::replace(&mut ends_well[at], true) {
            open.extend(&before[at]);
        }
    }
    match ends_well.iter().position(|well| !well) {
        Some(at) => Err(format!(
            "no good end can be reached\n{}",
            way(&came_from, at)
        )),
        None => Ok(Explored {
            states: states.len(),
            steps,
        }),
    }
}

fn way(came_from: &[Option<(usize, String)>], mut at: usize) -> String {
    let mut steps = Vec::new();
    while let Some((from, name)) = &came_from[at] {
        steps.push(name.as_str());
        at = *from;
    }
    steps.reverse();
    steps.join("\n")
}
