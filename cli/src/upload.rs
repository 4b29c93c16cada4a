//! From a capture folder to a submitted job: hash, send what the store lacks, write the manifest, submit.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::PathBuf;
use std::sync::Arc;

use futures::{StreamExt as _, TryStreamExt as _};
use ign_proto::manifest::EMPTY_CONFIG;
use ign_proto::{Digest, ObjectName, v1};

use crate::connection::Connection;
use crate::output::Live;
use crate::pack::{self, Packed};
use crate::problem::Problem;
use crate::recipe::Recipe;

/// Files that are sent or fetched at the same time.
pub(crate) const TRANSFERS_AT_ONCE: usize = 4;

/// What to bake, ready to be packed.
pub(crate) struct Order {
    pub(crate) capture: PathBuf,
    pub(crate) proxy: Option<PathBuf>,
    pub(crate) object: ObjectName,
    pub(crate) recipe: Recipe,
    pub(crate) priority: i32,
    pub(crate) labels: BTreeMap<String, String>,
}

/// Hashes and uploads the capture of `order`; returns its digest.
pub(crate) async fn upload(connection: &Connection, order: &Order) -> Result<Digest, Problem> {
    let files = pack::list(&order.capture, order.proxy.as_deref())?;
    let total = files.iter().map(|file| file.size_bytes).sum();
    let hashing = Arc::new(Live::transfer("hash", total));
    let packed = {
        let hashing = Arc::clone(&hashing);
        pack::pack(files, move |count| hashing.add(count)).await?
    };
    hashing.clear();
    send(connection, &order.object, &packed).await?;
    Ok(packed.digest)
}

async fn send(
    connection: &Connection,
    object: &ObjectName,
    packed: &Packed,
) -> Result<(), Problem> {
    let store = connection.data_plane(object)?;
    let total = packed
        .files
        .iter()
        .map(|packed| packed.file.size_bytes)
        .sum();
    let live = Live::transfer("upload", total);
    let sent = |count: i64| {
        if count >= 0 {
            live.add(count as u64);
        } else {
            live.take_back(count.unsigned_abs());
        }
    };
    store
        .upload_bytes(&Digest::of(EMPTY_CONFIG), EMPTY_CONFIG)
        .await?;
    futures::stream::iter(&packed.files)
        .map(|packed| store.upload(packed, &sent))
        .buffer_unordered(TRANSFERS_AT_ONCE)
        .try_collect::<Vec<()>>()
        .await?;
    store.put_manifest(&packed.digest, &packed.manifest).await?;
    live.clear();
    Ok(())
}

/// The job specification of `order` for a capture that was uploaded.
pub(crate) fn spec(order: &Order, capture: &Digest) -> Result<v1::JobSpec, Problem> {
    Ok(v1::JobSpec {
        object: Some((&order.object).into()),
        capture_digest: capture.to_string(),
        recipe_json: order.recipe.json()?,
        priority: order.priority,
        labels: order.labels.clone().into_iter().collect(),
        max_attempts: 0,
    })
}

/// A request id that repeats for the same specification and `salt`.
pub(crate) fn request_id(spec: &v1::JobSpec, salt: &str) -> String {
    let object = spec.object.clone().unwrap_or_default();
    let mut text = [
        object.collection.as_str(),
        &object.object,
        &spec.capture_digest,
        &spec.recipe_json,
        &spec.priority.to_string(),
        salt,
    ]
    .join("\n");
    let labels: BTreeMap<&String, &String> = spec.labels.iter().collect();
    for (key, value) in labels {
        // Writing to a String cannot fail.
        let _infallible = write!(text, "\n{key:?}={value:?}");
    }
    Digest::of(text.as_bytes()).hex()[..32].to_string()
}

/// Submits; the same request id returns the same job.
pub(crate) async fn submit(
    connection: &Connection,
    spec: v1::JobSpec,
    request_id: String,
) -> Result<v1::Job, Problem> {
    let request = v1::SubmitRequest {
        request_id,
        spec: Some(spec),
    };
    Ok(connection.jobs().submit(request).await?.into_inner())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn spec_with(priority: i32, digest: &str) -> v1::JobSpec {
        v1::JobSpec {
            object: Some(v1::ObjectRef {
                collection: "museum".into(),
                object: "vase".into(),
            }),
            capture_digest: digest.into(),
            recipe_json: "{}".into(),
            priority,
            ..Default::default()
        }
    }

    #[test]
    fn request_ids_repeat_for_the_same_content_only() {
        let id = request_id(&spec_with(0, "a"), "");
        assert_eq!(id, request_id(&spec_with(0, "a"), ""));
        assert_ne!(id, request_id(&spec_with(0, "b"), ""));
        assert_ne!(id, request_id(&spec_with(1, "a"), ""));
        assert_ne!(id, request_id(&spec_with(0, "a"), "again"));
        let mut labelled = spec_with(0, "a");
        labelled.labels.insert("room".into(), "3".into());
        assert_ne!(id, request_id(&labelled, ""));
        assert_eq!(id.len(), 32);
    }
}
