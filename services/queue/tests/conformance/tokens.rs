//! Tokens, and what they reach.

use std::collections::BTreeSet;
use std::time::Duration;

use ign_queue::NewToken;

use crate::bench::{Bench, kind, worker};

const HOUR: Duration = Duration::from_hours(1);

fn new_token(id: &str, name: &str, secret: u8) -> NewToken {
    NewToken {
        id: id.to_owned(),
        name: name.to_owned(),
        grants: vec!["submit:museum".parse().unwrap(), "read:*".parse().unwrap()],
        secret: [secret; 32],
        valid_for: None,
    }
}

pub(crate) async fn tokens_rotate_expire_and_end(bench: &Bench) {
    let store = &bench.store;
    let made = store
        .create_token(new_token("AAAAAAAAAAA1", "registrar", 1))
        .await
        .unwrap();
    assert_eq!(made.grants.len(), 2);
    assert_eq!(
        (made.expires_at, made.revoked_at, made.last_used_on),
        (None, None, None)
    );

    // One live token for a name, one token for an id.
    let again = store
        .create_token(new_token("AAAAAAAAAAA2", "registrar", 2))
        .await;
    assert_eq!(kind(&again), "not allowed");
    let again = store
        .create_token(new_token("AAAAAAAAAAA1", "other", 2))
        .await;
    assert_eq!(kind(&again), "not allowed");
    for bad in ["", "Registrar", "a b", "12", "AAAAAAAAAAA1"] {
        let made = store.create_token(new_token("AAAAAAAAAAA3", bad, 2)).await;
        assert_eq!(kind(&made), "invalid", "{bad}");
    }
    let mut nothing = new_token("AAAAAAAAAAA3", "nothing", 2);
    nothing.grants.clear();
    assert_eq!(kind(&store.create_token(nothing).await), "invalid");

    let key = store.token_key("AAAAAAAAAAA1").await.unwrap().unwrap();
    assert_eq!((&key.token, &key.secrets), (&made, &vec![[1; 32]]));
    assert!(store.token_key("AAAAAAAAAAA9").await.unwrap().is_none());

    store.token_used("AAAAAAAAAAA1").await.unwrap();
    let used = store.tokens().await.unwrap().remove(0);
    assert_eq!(used.last_used_on, Some(key.at.date_naive()));

    // Both secrets during the grace, one without.
    store
        .rotate_token("registrar", [2; 32], HOUR, Some(HOUR))
        .await
        .unwrap();
    let key = store.token_key("AAAAAAAAAAA1").await.unwrap().unwrap();
    assert_eq!(key.secrets, [[2; 32], [1; 32]]);
    let ends_at = key.token.expires_at.unwrap();
    assert!(ends_at > key.at && ends_at <= key.at + HOUR);
    let rotated = store
        .rotate_token("AAAAAAAAAAA1", [3; 32], Duration::ZERO, None)
        .await
        .unwrap();
    assert_eq!(rotated.expires_at, Some(ends_at));
    let key = store.token_key("AAAAAAAAAAA1").await.unwrap().unwrap();
    assert_eq!(key.secrets, [[3; 32]]);
    let for_ever = store
        .rotate_token("registrar", [4; 32], HOUR, Some(Duration::MAX))
        .await;
    assert_eq!(kind(&for_ever), "invalid");

    // Revoked once and for ever; its name is free again.
    let ended = store.revoke_token("registrar").await.unwrap();
    assert!(ended.revoked_at.is_some());
    assert_eq!(store.revoke_token("AAAAAAAAAAA1").await.unwrap(), ended);
    assert_eq!(kind(&store.revoke_token("registrar").await), "not found");
    let rotated = store
        .rotate_token("AAAAAAAAAAA1", [4; 32], HOUR, None)
        .await;
    assert_eq!(kind(&rotated), "not allowed");
    let next = store
        .create_token(new_token("AAAAAAAAAAA4", "registrar", 4))
        .await
        .unwrap();
    let listed: BTreeSet<String> = store
        .tokens()
        .await
        .unwrap()
        .into_iter()
        .map(|it| it.id)
        .collect();
    assert_eq!(listed, [ended.id, next.id].into());
}

pub(crate) async fn workers_stay_within_their_collections(bench: &Bench) {
    let museum = bench.submit("museum/vase").await;
    let library = bench.submit("library/globe").await;
    let within = |name: &str| BTreeSet::from([name.parse().unwrap()]);
    let lease = async |name: &str| {
        let collections = within(name);
        let leased = bench
            .store
            .lease_within(&worker("w"), Some("token"), Some(&collections))
            .await;
        leased.unwrap().map(|job| job.id)
    };
    assert_eq!(lease("library").await, Some(library.id));
    assert_eq!(lease("library").await, None);
    assert_eq!(lease("nowhere").await, None);
    assert_eq!(lease("museum").await, Some(museum.id));
}
