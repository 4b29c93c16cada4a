//! Blobs and manifests over HTTP, in the manner of the OCI distribution specification.
//!
//! ```text
//! GET                    /v2/                                       the API is there
//! HEAD GET               /v2/{c}/{o}/blobs/{digest}                 Range, ETag, redirect to a signed URL
//! POST                   /v2/{c}/{o}/blobs/uploads/[?digest=]       begin; with a digest: the whole blob at once
//! GET PATCH PUT DELETE   /v2/{c}/{o}/blobs/uploads/{id}[?digest=]   where it stands; add; finish; forget
//! HEAD GET PUT           /v2/{c}/{o}/manifests/{digest|vN|alias}    clients may put captures only, by digest
//! GET                    /v2/{c}/{o}/tags/list                      versions and aliases
//! ```
//!
//! Limits: a blob of [`MAX_BLOB_BYTES`], a manifest of 4 MiB, slow bodies as [`crate::body`] says. Memory is bounded
//! by a few parts per upload.

use std::ops::Range;
use std::sync::Arc;
use std::sync::atomic::Ordering;

use axum::body::Body;
use axum::extract::{Path, Query, Request, State};
use axum::http::header::{
    ACCEPT_RANGES, CACHE_CONTROL, CONTENT_LENGTH, CONTENT_RANGE, CONTENT_TYPE, ETAG, IF_NONE_MATCH,
    IF_RANGE, LOCATION, RANGE,
};
use axum::http::{HeaderMap, HeaderName, HeaderValue, Method, StatusCode};
use axum::response::{IntoResponse, Response};
use axum::routing::{MethodRouter, get, post};
use axum::{Extension, Json};
use bytes::Bytes;
use futures::{Stream, TryStreamExt as _};
use ign_proto::manifest::{MAX_BYTES, MEDIA_TYPE};
use ign_proto::{Cause, Digest, IdError, Kind, Manifest, ObjectName};
use ign_queue::VersionFilter;
use ign_registry::{BodyError, RegistryError, UploadId};
use serde::Deserialize;

use crate::access::Caller;
use crate::app::App;
use crate::error::internal;
use crate::fetch::Item;
use crate::http_answer::{Refused, oci_error};
use crate::limits::{MAX_BLOB_BYTES, SIGNED_FOR};
use crate::room::Write;
use crate::trace;

const CONTENT_DIGEST: HeaderName = HeaderName::from_static("docker-content-digest");
const UPLOAD_UUID: HeaderName = HeaderName::from_static("docker-upload-uuid");

type Answer = Result<Response, Refused>;
type Shared = State<Arc<App>>;

/// The routes under `/v2/`.
pub(crate) fn routes() -> Vec<(&'static str, MethodRouter<Arc<App>>)> {
    let upload = get(upload_state)
        .patch(add_to_upload)
        .put(finish_upload)
        .delete(forget_upload);
    vec![
        ("/v2/", get(|| async { Json(serde_json::json!({})) })),
        ("/v2/{collection}/{object}/blobs/{digest}", get(read_blob)),
        (
            "/v2/{collection}/{object}/blobs/uploads",
            post(begin_upload),
        ),
        (
            "/v2/{collection}/{object}/blobs/uploads/",
            post(begin_upload),
        ),
        ("/v2/{collection}/{object}/blobs/uploads/{id}", upload),
        (
            "/v2/{collection}/{object}/manifests/{reference}",
            get(read_manifest).put(put_manifest),
        ),
        ("/v2/{collection}/{object}/tags/list", get(list_tags)),
    ]
}

/// The object in the path; its names are checked here, before anything else.
#[derive(Deserialize)]
struct ObjectPath {
    collection: String,
    object: String,
}

impl ObjectPath {
    fn name(&self) -> Result<ObjectName, IdError> {
        Ok(ObjectName {
            collection: self.collection.parse()?,
            object: self.object.parse()?,
        })
    }
}

#[derive(Deserialize)]
struct DigestQuery {
    digest: Option<String>,
    mount: Option<String>,
}

// ---------------------------------------------------------------- blobs

async fn read_blob(
    State(app): Shared,
    Extension(caller): Extension<Arc<Caller>>,
    Path(object): Path<ObjectPath>,
    Path(BlobPath { digest }): Path<BlobPath>,
    method: Method,
    headers: HeaderMap,
) -> Answer {
    let object = object.name()?;
    let digest: Digest = digest.parse()?;
    // Whether a blob is there is told to all who may upload: it is how they know what to send.
    if method != Method::HEAD {
        app.may_fetch(&caller, &object, Item::Blob(&digest)).await?;
    }
    let size = app
        .registry
        .blob_size(&digest)
        .await?
        .ok_or_else(|| Cause::absent("blob", &digest))?;
    let etag = etag(&digest);
    let common = [
        (
            CONTENT_TYPE,
            HeaderValue::from_static("application/octet-stream"),
        ),
        (ACCEPT_RANGES, HeaderValue::from_static("bytes")),
        (ETAG, etag.clone()),
        // What a digest names never changes.
        (
            CACHE_CONTROL,
            HeaderValue::from_static("private, max-age=31536000, immutable"),
        ),
        (CONTENT_DIGEST, text(digest.as_str())),
    ];
    if method == Method::HEAD {
        return Ok((common, [(CONTENT_LENGTH, HeaderValue::from(size))]).into_response());
    }
    if headers
        .get(IF_NONE_MATCH)
        .is_some_and(|given| names_etag(given, &etag))
    {
        return Ok((StatusCode::NOT_MODIFIED, common).into_response());
    }
    if app.redirect_blobs
        && let Some(url) = app.registry.sign_blob(&digest, SIGNED_FOR).await?
    {
        let location = HeaderValue::from_str(&url).map_err(|error| internal(&error))?;
        let headers = [
            (LOCATION, location),
            (CACHE_CONTROL, HeaderValue::from_static("no-store")),
        ];
        return Ok((StatusCode::TEMPORARY_REDIRECT, headers).into_response());
    }
    let fresh = headers.get(IF_RANGE).is_none_or(|given| *given == etag);
    let wanted = headers
        .get(RANGE)
        .filter(|_| fresh)
        .and_then(|value| value.to_str().ok());
    let (status, range) = match wanted.map_or(Wanted::All, |header| wanted_range(header, size)) {
        Wanted::All => (StatusCode::OK, None),
        Wanted::Part(range) => (StatusCode::PARTIAL_CONTENT, Some(range)),
        Wanted::Nothing => {
            let mut response = oci_error(
                StatusCode::RANGE_NOT_SATISFIABLE,
                "RANGE_INVALID",
                "the range lies outside the blob",
            );
            response
                .headers_mut()
                .insert(CONTENT_RANGE, text(&format!("bytes */{size}")));
            return Ok(response);
        }
    };
    let read = app
        .registry
        .read_blob(&digest, range.clone())
        .await?
        .ok_or_else(|| Cause::absent("blob", &digest))?;
    let length = read.range.end - read.range.start;
    app.metrics.bytes_sent.fetch_add(length, Ordering::Relaxed);
    let mut response = (status, common, Body::from_stream(read.stream)).into_response();
    response
        .headers_mut()
        .insert(CONTENT_LENGTH, HeaderValue::from(length));
    if let Some(Range { start, end }) = range {
        response.headers_mut().insert(
            CONTENT_RANGE,
            text(&format!("bytes {start}-{}/{size}", end - 1)),
        );
    }
    Ok(response)
}

#[derive(Deserialize)]
struct BlobPath {
    digest: String,
}

#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Wanted {
    All,
    Part(Range<u64>),
    Nothing,
}

/// What a `Range` header asks of a blob. Forms that are not served (several ranges, other units) ask for all of it, as
/// HTTP allows.
pub(crate) fn wanted_range(header: &str, size: u64) -> Wanted {
    let parse = |header: &str| -> Option<Wanted> {
        let (first, last) = header.strip_prefix("bytes=")?.split_once('-')?;
        let range = match (first.trim(), last.trim()) {
            ("", suffix) => size.saturating_sub(suffix.parse().ok()?)..size,
            (first, "") => first.parse().ok()?..size,
            (first, last) => {
                let (first, last): (u64, u64) = (first.parse().ok()?, last.parse().ok()?);
                if first > last {
                    return None;
                }
                first..size.min(last.saturating_add(1))
            }
        };
        Some(if range.start < range.end {
            Wanted::Part(range)
        } else {
            Wanted::Nothing
        })
    };
    parse(header).unwrap_or(Wanted::All)
}

fn etag(digest: &Digest) -> HeaderValue {
    text(&format!("\"{digest}\""))
}

fn names_etag(given: &HeaderValue, etag: &HeaderValue) -> bool {
    let (given, etag) = (
        given.to_str().unwrap_or_default(),
        etag.to_str().unwrap_or_default(),
    );
    given
        .split(',')
        .any(|one| matches!(one.trim().trim_start_matches("W/"), it if it == "*" || it == etag))
}

/// A header from text of our own making, which is always ASCII.
fn text(value: &str) -> HeaderValue {
    HeaderValue::from_str(value).unwrap_or(HeaderValue::from_static(""))
}

// ---------------------------------------------------------------- uploads

#[derive(Deserialize)]
struct UploadPath {
    id: String,
}

impl UploadPath {
    fn id(&self) -> Result<UploadId, Refused> {
        self.id
            .parse()
            .map_err(|_not_ours| Refused(Cause::absent("upload", &self.id)))
    }
}

async fn begin_upload(
    State(app): Shared,
    Path(object): Path<ObjectPath>,
    Query(query): Query<DigestQuery>,
    request: Request,
) -> Answer {
    let object = object.name()?;
    check_room(&app, &request)?;
    if let Some(digest) = query.digest {
        let digest: Digest = digest.parse()?;
        let body = pieces(&app, request);
        let stored = trace::spawn({
            let (app, digest) = (app.clone(), digest.clone());
            async move { app.registry.put_stream(&digest, MAX_BLOB_BYTES, body).await }
        });
        return match stored.await.map_err(|error| internal(&error))? {
            Ok(_) => Ok(created("blobs", &object, &digest)),
            Err(error) => upload_refused(&object, error),
        };
    }
    // All blobs lie in one store: what another repository has, this one has.
    if let Some(digest) = query.mount.and_then(|mount| mount.parse::<Digest>().ok())
        && app.registry.blob_size(&digest).await?.is_some()
    {
        return Ok(created("blobs", &object, &digest));
    }
    let id = app.registry.create_upload(&object).await?;
    Ok(upload_answer(StatusCode::ACCEPTED, &object, id, 0))
}

async fn upload_state(
    State(app): Shared,
    Path(object): Path<ObjectPath>,
    Path(upload): Path<UploadPath>,
) -> Answer {
    let (object, id) = (object.name()?, upload.id()?);
    let offset = app.registry.upload_offset(&object, id).await?;
    Ok(upload_answer(StatusCode::NO_CONTENT, &object, id, offset))
}

async fn add_to_upload(
    State(app): Shared,
    Path(object): Path<ObjectPath>,
    Path(upload): Path<UploadPath>,
    request: Request,
) -> Answer {
    let (object, id) = (object.name()?, upload.id()?);
    check_room(&app, &request)?;
    let first = content_range_start(request.headers())?;
    match append(&app, &object, id, first, request).await? {
        Ok(end) => Ok(upload_answer(StatusCode::ACCEPTED, &object, id, end)),
        Err(error) => upload_refused(&object, error),
    }
}

async fn finish_upload(
    State(app): Shared,
    Path(object): Path<ObjectPath>,
    Path(upload): Path<UploadPath>,
    Query(query): Query<DigestQuery>,
    request: Request,
) -> Answer {
    let (object, id) = (object.name()?, upload.id()?);
    check_room(&app, &request)?;
    let digest: Digest = query
        .digest
        .ok_or_else(|| Cause::bad_field("digest", "the query must name it"))?
        .parse()?;
    let length = request.headers().get(CONTENT_LENGTH);
    let has_body = match length {
        Some(length) => length != "0",
        None => !axum::body::HttpBody::is_end_stream(request.body()),
    };
    if has_body {
        let first = content_range_start(request.headers())?;
        if let Err(error) = append(&app, &object, id, first, request).await? {
            return upload_refused(&object, error);
        }
    }
    let finished = trace::spawn({
        let (app, object, digest) = (app.clone(), object.clone(), digest.clone());
        async move {
            app.registry
                .finish_upload(&object, id, &digest, MAX_BLOB_BYTES)
                .await
        }
    });
    match finished.await.map_err(|error| internal(&error))? {
        Ok(_) => Ok(created("blobs", &object, &digest)),
        Err(error) => upload_refused(&object, error),
    }
}

async fn forget_upload(
    State(app): Shared,
    Path(object): Path<ObjectPath>,
    Path(upload): Path<UploadPath>,
) -> Answer {
    let (object, id) = (object.name()?, upload.id()?);
    app.registry.upload_offset(&object, id).await?;
    app.registry.drop_upload(id).await?;
    Ok(StatusCode::NO_CONTENT.into_response())
}

/// Adds the request's body to the upload; without `first` where the upload stands. In a task of its own: when the
/// connection breaks, what has arrived is still kept.
async fn append(
    app: &Arc<App>,
    object: &ObjectName,
    id: UploadId,
    first: Option<u64>,
    request: Request,
) -> Result<Result<u64, RegistryError>, Refused> {
    let offset = match first {
        Some(first) => first,
        None => app.registry.upload_offset(object, id).await?,
    };
    let body = pieces(app, request);
    let appended = trace::spawn({
        let (app, object) = (app.clone(), object.clone());
        async move {
            app.registry
                .append_upload(&object, id, offset, MAX_BLOB_BYTES, body)
                .await
        }
    });
    Ok(appended.await.map_err(|error| internal(&error))?)
}

/// Fails before any byte is read when the body would not fit.
fn check_room(app: &App, request: &Request) -> Result<(), Refused> {
    let length = request.headers().get(CONTENT_LENGTH);
    let bytes = length
        .and_then(|length| length.to_str().ok()?.parse().ok())
        .unwrap_or(0);
    app.room.check(Write::Blob { bytes })
}

/// The body in pieces, counted.
fn pieces(
    app: &Arc<App>,
    request: Request,
) -> impl Stream<Item = Result<Bytes, BodyError>> + Send + use<> {
    let app = app.clone();
    let body = request.into_body().into_data_stream();
    body.map_err(BodyError::from)
        .inspect_ok(move |piece: &Bytes| {
            app.metrics
                .bytes_received
                .fetch_add(piece.len() as u64, Ordering::Relaxed);
        })
}

/// First byte of `Content-Range: 5-9`, also with HTTP's own `bytes ` before it and `/10` behind.
pub(crate) fn content_range_start(headers: &HeaderMap) -> Result<Option<u64>, Refused> {
    let Some(value) = headers.get(CONTENT_RANGE) else {
        return Ok(None);
    };
    let start = value.to_str().ok().and_then(|value| {
        let value = value
            .strip_prefix("bytes")
            .unwrap_or(value)
            .trim_start_matches(['=', ' ']);
        value.split_once('-')?.0.trim().parse().ok()
    });
    start.map(Some).ok_or_else(|| {
        Refused(Cause::bad_field(
            "body",
            "Content-Range is not of the form 0-99",
        ))
    })
}

fn upload_refused(object: &ObjectName, error: RegistryError) -> Answer {
    match error {
        RegistryError::WrongOffset { id, offset, .. } => {
            let mut response = upload_answer(StatusCode::RANGE_NOT_SATISFIABLE, object, id, offset);
            response.headers_mut().remove(CONTENT_LENGTH);
            Ok(response)
        }
        RegistryError::TooLarge { .. } => Ok(oci_error(
            StatusCode::PAYLOAD_TOO_LARGE,
            "SIZE_INVALID",
            &error.to_string(),
        )),
        other => Err(other.into()),
    }
}

fn upload_answer(status: StatusCode, object: &ObjectName, id: UploadId, offset: u64) -> Response {
    // OCI has no way to say "nothing yet": its registries answer 0-0 then.
    let last = offset.saturating_sub(1);
    let headers = [
        (LOCATION, text(&format!("/v2/{object}/blobs/uploads/{id}"))),
        (RANGE, text(&format!("0-{last}"))),
        (UPLOAD_UUID, text(&id.to_string())),
    ];
    (status, headers).into_response()
}

fn created(kind: &str, object: &ObjectName, digest: &Digest) -> Response {
    let headers = [
        (LOCATION, text(&format!("/v2/{object}/{kind}/{digest}"))),
        (CONTENT_DIGEST, text(digest.as_str())),
    ];
    (StatusCode::CREATED, headers).into_response()
}

// ---------------------------------------------------------------- manifests

#[derive(Deserialize)]
struct ManifestPath {
    reference: String,
}

async fn read_manifest(
    State(app): Shared,
    Extension(caller): Extension<Arc<Caller>>,
    Path(object): Path<ObjectPath>,
    Path(ManifestPath { reference }): Path<ManifestPath>,
    method: Method,
    headers: HeaderMap,
) -> Answer {
    let object = object.name()?;
    let digest = match reference.parse::<Digest>() {
        Ok(digest) => digest,
        Err(_tag) => {
            app.store
                .version(&object, &reference)
                .await?
                .bundle
                .manifest_digest
        }
    };
    if method != Method::HEAD {
        app.may_fetch(&caller, &object, Item::Manifest(&digest))
            .await?;
    }
    let bytes = app
        .registry
        .manifest(&digest)
        .await?
        .ok_or_else(|| Cause::absent("manifest", &digest))?;
    let etag = etag(&digest);
    let common = [
        (CONTENT_TYPE, HeaderValue::from_static(MEDIA_TYPE)),
        (CONTENT_DIGEST, text(digest.as_str())),
        (ETAG, etag.clone()),
    ];
    if headers
        .get(IF_NONE_MATCH)
        .is_some_and(|given| names_etag(given, &etag))
    {
        return Ok((StatusCode::NOT_MODIFIED, common).into_response());
    }
    // For HEAD the server drops the body and keeps its length.
    Ok((common, bytes).into_response())
}

async fn put_manifest(
    State(app): Shared,
    Path(object): Path<ObjectPath>,
    Path(ManifestPath { reference }): Path<ManifestPath>,
    request: Request,
) -> Answer {
    let object = object.name()?;
    app.room.check(Write::Work)?;
    let Ok(claimed) = reference.parse::<Digest>() else {
        let message =
            "only the coordinator gives names to manifests; put captures by digest".to_owned();
        return Err(Cause::Forbidden { message }.into());
    };
    let Ok(bytes) = axum::body::to_bytes(request.into_body(), MAX_BYTES).await else {
        return Ok(oci_error(
            StatusCode::PAYLOAD_TOO_LARGE,
            "SIZE_INVALID",
            "the manifest is too large or broke off",
        ));
    };
    let actual = Digest::of(&bytes);
    if actual != claimed {
        return Err(RegistryError::WrongDigest {
            expected: claimed,
            actual,
        }
        .into());
    }
    let manifest = Manifest::decode(&bytes)?;
    if manifest.kind() != Kind::Capture {
        let message = "bundles are published by the coordinator when a job completes".to_owned();
        return Err(Cause::Forbidden { message }.into());
    }
    let digest = app.registry.put_manifest_bytes(bytes, &manifest).await?;
    Ok(created("manifests", &object, &digest))
}

async fn list_tags(State(app): Shared, Path(object): Path<ObjectPath>) -> Answer {
    let object = object.name()?;
    let filter = VersionFilter {
        collection: Some(object.collection.clone()),
        object: Some(object.object.clone()),
        include_retired: false,
    };
    let versions = app.store.versions(&filter).await?;
    if versions.is_empty() {
        return Err(Cause::absent("object", &object).into());
    }
    let tags: std::collections::BTreeSet<String> = versions
        .iter()
        .flat_map(|version| {
            version
                .aliases
                .iter()
                .cloned()
                .chain([format!("v{}", version.version)])
        })
        .collect();
    Ok(Json(serde_json::json!({"name": object.to_string(), "tags": tags})).into_response())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ranges_follow_http() {
        for (header, expected) in [
            ("bytes=0-0", Wanted::Part(0..1)),
            ("bytes=2-", Wanted::Part(2..10)),
            ("bytes=2-99", Wanted::Part(2..10)),
            ("bytes=-3", Wanted::Part(7..10)),
            ("bytes=-99", Wanted::Part(0..10)),
            ("bytes=9-9", Wanted::Part(9..10)),
            ("bytes=10-", Wanted::Nothing),
            ("bytes=10-12", Wanted::Nothing),
            ("bytes=-0", Wanted::Nothing),
            ("bytes=5-4", Wanted::All),
            ("bytes=0-1,3-4", Wanted::All),
            ("bytes=a-b", Wanted::All),
            ("bytes=--1", Wanted::All),
            ("lines=0-1", Wanted::All),
            ("", Wanted::All),
            ("bytes=0-18446744073709551615", Wanted::Part(0..10)),
        ] {
            assert_eq!(wanted_range(header, 10), expected, "{header}");
        }
        assert_eq!(wanted_range("bytes=0-", 0), Wanted::Nothing);
    }

    #[test]
    fn content_range_of_oci_and_of_http_are_read() {
        let start = |value: &str| {
            let headers =
                HeaderMap::from_iter([(CONTENT_RANGE, HeaderValue::from_str(value).unwrap())]);
            content_range_start(&headers).ok().flatten()
        };
        assert_eq!(start("5-9"), Some(5));
        assert_eq!(start("bytes 5-9/10"), Some(5));
        assert_eq!(start("bytes=5-9"), Some(5));
        assert_eq!(start("x-9"), None);
        assert_eq!(content_range_start(&HeaderMap::new()), Ok(None));
    }

    #[test]
    fn etags_match_in_lists_and_weak() {
        let etag = HeaderValue::from_static("\"sha256:a\"");
        for good in ["\"sha256:a\"", "\"x\", \"sha256:a\"", "W/\"sha256:a\"", "*"] {
            assert!(names_etag(&HeaderValue::from_static(good), &etag), "{good}");
        }
        assert!(!names_etag(
            &HeaderValue::from_static("\"sha256:b\""),
            &etag
        ));
    }
}
