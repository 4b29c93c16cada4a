//! The outbox: what is announced, and what becomes of it.

use std::time::Duration;

use ign_proto::{CollectionId, JobId};
use ign_queue::webhook::PAUSES;
use ign_queue::{Delivery, DeliveryState, Dispatch, FailureKind, Secret, StoreError, Tried};
use serde_json::Value;

use crate::bench::{Bench, bundle, kind};

const HOUR: Duration = Duration::from_hours(1);
const URL: &str = "https://archive.example/hook";

fn museum() -> CollectionId {
    "museum".parse().unwrap()
}

fn secret() -> Secret {
    Secret(vec![7; 32])
}

async fn deliveries(bench: &Bench) -> Vec<Delivery> {
    bench.store.deliveries(&museum(), 100).await.unwrap()
}

async fn events_of(bench: &Bench, job: JobId) -> Vec<String> {
    let mut all = deliveries(bench).await;
    all.retain(|delivery| delivery.job == job);
    all.into_iter().map(|delivery| delivery.event).collect()
}

/// Each way to an end is announced once, in its transaction; what does not end, or ends elsewhere, is not.
pub(crate) async fn ends_are_announced(bench: &Bench) {
    let store = &bench.store;
    let before = bench.running("museum/vase").await;
    bench.fail(&before, FailureKind::InvalidInput).await;
    store.set_webhook(&museum(), URL, secret()).await.unwrap();
    store.cancel(before.id).await.unwrap();
    assert_eq!(deliveries(bench).await, [], "what ended before is not news");

    let done = bench.running("museum/vase").await;
    store
        .heartbeat(done.id, done.attempt, None, Vec::new())
        .await
        .unwrap();
    for _ in 0..2 {
        store
            .publish_and_complete(done.id, done.attempt, bundle(3))
            .await
            .unwrap();
        store.cancel(done.id).await.unwrap();
    }
    assert_eq!(events_of(bench, done.id).await, ["job.succeeded"]);

    let failed = bench.running("museum/vase").await;
    assert!(bench.fail(&failed, FailureKind::Transient).await);
    assert_eq!(events_of(bench, failed.id).await, [""; 0]);
    bench.end_backoff(failed.id).await;
    let failed = bench.lease("w").await.unwrap();
    bench.fail(&failed, FailureKind::InvalidInput).await;
    assert_eq!(events_of(bench, failed.id).await, ["job.failed"]);
    store.retry(failed.id).await.unwrap();
    store.cancel(failed.id).await.unwrap();
    assert_eq!(
        events_of(bench, failed.id).await,
        ["job.cancelled", "job.failed"]
    );

    let lost = bench.running("museum/vase").await;
    store.cancel(lost.id).await.unwrap();
    bench.end_lease(lost.id).await;
    assert_eq!(store.reap().await.unwrap().ended, [lost.id]);
    assert_eq!(events_of(bench, lost.id).await, ["job.cancelled"]);

    let elsewhere = bench.running("library/urn").await;
    bench.fail(&elsewhere, FailureKind::InvalidInput).await;
    let library = "library".parse().unwrap();
    assert_eq!(store.deliveries(&library, 9).await.unwrap(), []);

    // What is told.
    let claimed = store.claim_deliveries(100, HOUR).await.unwrap();
    assert_eq!(claimed.len(), 4);
    let success = claimed
        .iter()
        .find(|it| it.delivery.job == done.id)
        .unwrap();
    let body: Value = serde_json::from_str(&success.body).unwrap();
    assert_eq!(body["type"], "job.succeeded");
    let data = &body["data"];
    assert_eq!(data["job"], done.id.to_string());
    assert_eq!(
        (&data["collection"], &data["object"]),
        (&"museum".into(), &"vase".into())
    );
    assert_eq!(data["bundle"]["reference"], "museum/vase:v1");
    assert_eq!(
        data["bundle"]["manifest_digest"],
        bundle(3).manifest_digest.as_str()
    );
    assert_eq!(data["labels"]["batch"], "friday");
    let failure = claimed
        .iter()
        .find(|it| it.delivery.event == "job.failed")
        .unwrap();
    let body: Value = serde_json::from_str(&failure.body).unwrap();
    assert_eq!(body["data"]["failure"]["message"], "the disk is full");
    assert_eq!(body["data"]["bundle"], Value::Null);
}

async fn claim(bench: &Bench) -> Vec<Dispatch> {
    bench.store.claim_deliveries(10, HOUR).await.unwrap()
}

pub(crate) async fn deliveries_go_on_until_they_are_taken_or_given_up(bench: &Bench) {
    let store = &bench.store;
    for (url, bad) in [
        ("", secret()),
        (URL, Secret(vec![7; 23])),
        (URL, Secret(vec![7; 65])),
    ] {
        let refused = store.set_webhook(&museum(), url, bad).await;
        assert_eq!(kind(&refused), "invalid");
    }
    assert_eq!(kind(&store.remove_webhook(&museum()).await), "not found");
    let set = store.set_webhook(&museum(), URL, secret()).await.unwrap();
    assert_eq!(store.webhooks().await.unwrap(), [set]);
    assert!(
        !format!("{:?}", secret()).contains('7'),
        "secrets are not shown"
    );

    let end = async || {
        let job = bench.running("museum/vase").await;
        bench.fail(&job, FailureKind::InvalidInput).await;
    };
    end().await;
    // One of two coordinators gets it; when that one dies the other does, later.
    let other = bench.open(store.settings()).await;
    let (here, there) = tokio::join!(
        store.claim_deliveries(10, HOUR),
        other.claim_deliveries(10, HOUR)
    );
    let both = [here.unwrap(), there.unwrap()].concat();
    assert_eq!(both.len(), 1);
    let first = &both[0];
    assert_eq!((first.delivery.tries, first.url.as_str()), (1, URL));
    assert_eq!(first.secret, secret());
    assert_eq!(claim(bench).await, []);
    bench.end_pauses().await;
    let second = claim(bench).await.remove(0);
    assert_eq!(second.delivery.tries, 2);
    assert_eq!(
        (&second.delivery.id, &second.body),
        (&first.delivery.id, &first.body)
    );

    // The dead one comes back: that it failed says nothing any more.
    let id = &second.delivery.id;
    let tried = async |tries, how| store.delivery_tried(id, tries, how).await;
    tried(1, Tried::Refused("late".to_owned())).await.unwrap();
    assert_eq!(deliveries(bench).await[0].state, DeliveryState::Pending);

    // After each pause once more, and then no more.
    for tries in 2..=PAUSES.len() as u32 {
        let begun = deliveries(bench).await[0].clone();
        tried(tries, Tried::Failed(format!("no answer {tries}")))
            .await
            .unwrap();
        let now = deliveries(bench).await[0].clone();
        assert_eq!(now.state, DeliveryState::Pending);
        assert_eq!(now.last_error, Some(format!("no answer {tries}")));
        let pause = now.next_at - begun.created_at;
        assert!(pause >= chrono::TimeDelta::from_std(PAUSES[tries as usize - 1]).unwrap());
        assert_eq!(claim(bench).await, [], "not before its time");
        bench.end_pauses().await;
        assert_eq!(claim(bench).await[0].delivery.tries, tries + 1);
    }
    let last = PAUSES.len() as u32 + 1;
    tried(last, Tried::Failed("no answer".to_owned()))
        .await
        .unwrap();
    let given_up = deliveries(bench).await[0].clone();
    assert_eq!(given_up.state, DeliveryState::GivenUp);
    assert!(given_up.ended_at.is_some());
    bench.end_pauses().await;
    assert_eq!(claim(bench).await, []);

    // On request it begins again, and ends when it is taken.
    let library = "library".parse().unwrap();
    assert_eq!(kind(&store.redeliver(&library, id).await), "not found");
    let again = store.redeliver(&museum(), id).await.unwrap();
    assert_eq!((again.state, again.tries), (DeliveryState::Pending, 0));
    assert_eq!(claim(bench).await[0].delivery.tries, 1);
    tried(1, Tried::Delivered).await.unwrap();
    assert_eq!(deliveries(bench).await[0].state, DeliveryState::Delivered);

    // A webhook that is removed takes what waits with it.
    end().await;
    store.remove_webhook(&museum()).await.unwrap();
    let removed = deliveries(bench).await[0].clone();
    assert_eq!(removed.state, DeliveryState::GivenUp);
    end().await;
    assert_eq!(deliveries(bench).await.len(), 2);
    let unknown = store.delivery_tried("msg_x", 1, Tried::Delivered).await;
    assert!(matches!(unknown, Err(StoreError::NotFound { .. })));
}
