//! Every interleaving of what may happen at once, by exhaustive search, in the manner of a model checker: claim, rescue
//! and publish of one job, and a collection of garbage beside a submit. Each model has broken variants that the search
//! must catch, or it would prove nothing.

#![expect(clippy::unwrap_used, reason = "a panic is how a test fails")]

mod collect;
mod explore;
mod publish;

use collect::Collecting;
use explore::explore;
use publish::Publishing;

#[test]
fn every_interleaving_of_claim_rescue_and_publish_keeps_the_promises() {
    let explored = explore(Publishing::new(publish::Variant::Real)).unwrap();
    assert!(
        explored.states > 1000 && explored.steps > explored.states,
        "{explored:?}"
    );
}

#[test]
fn broken_publishes_are_caught() {
    for (variant, rule) in [
        (publish::Variant::ChecksTooEarly, "disagree"),
        (publish::Variant::BelievesAnybody, "stale attempt"),
        (publish::Variant::RecordsTooEarly, "never accepted"),
    ] {
        let way = explore(Publishing::new(variant)).unwrap_err();
        assert!(way.contains(rule), "{variant:?}: {way}");
    }
}

#[test]
fn every_interleaving_of_a_collection_and_a_submit_keeps_the_files() {
    let explored = explore(Collecting::new(collect::Variant::Real)).unwrap();
    assert!(explored.states > 100, "{explored:?}");
}

#[test]
fn broken_collections_are_caught() {
    for variant in [collect::Variant::NoTrash, collect::Variant::NoRescue] {
        let way = explore(Collecting::new(variant)).unwrap_err();
        assert!(
            way.contains("names a file that is gone"),
            "{variant:?}: {way}"
        );
    }
}
