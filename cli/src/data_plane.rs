//! Blobs and manifests of one object over HTTP (`/v2/<collection>/<object>/...`), as DESIGN section 5 has them.
//!
//! Uploads ask first (`HEAD`), go up in parts, and go on where they broke; downloads go on with `Range`. Invariant:
//! bytes that leave this module have been checked against their digest.

use std::path::Path;
use std::time::Duration;

use futures::StreamExt as _;
use ign_proto::manifest::MEDIA_TYPE;
use ign_proto::{Digest, ObjectName};
use reqwest::header::{CONTENT_RANGE, CONTENT_TYPE, HeaderMap, HeaderValue, LOCATION, RANGE};
use reqwest::{Client, Method, RequestBuilder, Response, StatusCode, Url};
use sha2::{Digest as _, Sha256};
use tokio::io::{AsyncReadExt as _, AsyncSeekExt as _, AsyncWriteExt as _};

use crate::memory::OpenUpload;
use crate::pack::{PackedFile, Source};
use crate::problem::{Doing as _, Exit, Problem, chain};

/// Blobs up to this size go up in one request.
const MONOLITHIC_BYTES: u64 = 1 << 20;
/// Size of a part of a larger blob; at most this much is sent again after a broken connection.
const PART_BYTES: u64 = 8 << 20;
/// Tries of one request or part before giving up.
const TRIES: u32 = 6;

/// Client of one object's repository.
#[derive(Clone)]
pub(crate) struct DataPlane {
    object: ObjectName,
    repository: Url,
    http: Client,
    headers: HeaderMap,
}

impl DataPlane {
    pub(crate) fn new(
        base: &Url,
        bearer: &str,
        object: &ObjectName,
        http: Client,
    ) -> Result<Self, Problem> {
        let malformed = |error: String| Problem::usage(error);
        let repository = base
            .join(&format!("v2/{object}/"))
            .map_err(|error| malformed(error.to_string()))?;
        let mut value =
            HeaderValue::from_str(bearer).map_err(|error| malformed(error.to_string()))?;
        value.set_sensitive(true);
        let headers = HeaderMap::from_iter([(reqwest::header::AUTHORIZATION, value)]);
        Ok(Self {
            object: object.clone(),
            repository,
            http,
            headers,
        })
    }

    fn request(&self, method: Method, path: &str) -> Result<RequestBuilder, Problem> {
        let url = self
            .repository
            .join(path)
            .map_err(|error| Problem::failed(format!("malformed address {path:?}: {error}")))?;
        // Sent to our own server only: a signed address of the object store takes no token.
        let ours = url.origin() == self.repository.origin();
        let request = self.http.request(method, url);
        Ok(if ours {
            request.headers(self.headers.clone())
        } else {
            request
        })
    }

    /// Whether the store has this blob already.
    pub(crate) async fn has(&self, digest: &Digest) -> Result<bool, Problem> {
        let path = format!("blobs/{digest}");
        let answer =
            retrying(|| async { checked(self.request(Method::HEAD, &path)?.send().await?).await })
                .await;
        absent_is_none(answer).map(|found| found.is_some())
    }

    /// Whether the store has the manifest of a capture, and so the capture: it is written last.
    pub(crate) async fn has_manifest(&self, digest: &Digest) -> Result<bool, Problem> {
        let path = format!("manifests/{digest}");
        let answer =
            retrying(|| async { checked(self.request(Method::HEAD, &path)?.send().await?).await })
                .await;
        absent_is_none(answer).map(|found| found.is_some())
    }

    /// Sends bytes unless the store has them.
    pub(crate) async fn upload_bytes(&self, digest: &Digest, bytes: &[u8]) -> Result<(), Problem> {
        if self.has(digest).await? {
            return Ok(());
        }
        self.upload_at_once(digest, bytes).await
    }

    async fn upload_at_once(&self, digest: &Digest, bytes: &[u8]) -> Result<(), Problem> {
        let path = format!("blobs/uploads/?digest={digest}");
        let answer = retrying(|| async {
            let request = self
                .request(Method::POST, &path)?
                .header(CONTENT_TYPE, "application/octet-stream")
                .body(bytes.to_vec());
            checked(request.send().await?).await
        })
        .await?;
        if answer.status() == StatusCode::ACCEPTED {
            // A server may decline to take it at once and open an upload instead.
            let location = location(&answer)?;
            self.finish(&location, digest, bytes.to_vec()).await?;
        }
        Ok(())
    }

    /// Sends a file unless the store has it; `sent` hears of each byte once, negative when a part goes again.
    pub(crate) async fn upload(
        &self,
        packed: &PackedFile,
        sent: &(dyn Fn(i64) + Sync),
    ) -> Result<(), Problem> {
        let (digest, size_bytes) = (&packed.digest, packed.file.size_bytes);
        if self.has(digest).await? {
            sent(size_bytes as i64);
            return Ok(());
        }
        let large = match &packed.file.source {
            Source::File(file) if size_bytes > MONOLITHIC_BYTES => Some(file),
            _ => None,
        };
        let outcome = match large {
            Some(file) => self.upload_parts(digest, size_bytes, file, sent).await,
            None => match packed.file.source.read().await {
                Ok(bytes) => self
                    .upload_at_once(digest, &bytes)
                    .await
                    .map(|()| sent(size_bytes as i64)),
                Err(problem) => Err(problem),
            },
        };
        outcome.map_err(|problem| problem.at(&packed.file.path))
    }

    async fn upload_parts(
        &self,
        digest: &Digest,
        size_bytes: u64,
        file: &Path,
        sent: &(dyn Fn(i64) + Sync),
    ) -> Result<(), Problem> {
        let mut reader = tokio::fs::File::open(file)
            .await
            .doing("cannot read", file.display())?;
        let remembered = OpenUpload::of(self.repository.as_str(), &self.object, digest);
        let (mut upload, mut offset) = self.go_on(&remembered, size_bytes).await?;
        sent(offset as i64);
        let mut tries = 0;
        while offset < size_bytes {
            let length = PART_BYTES.min(size_bytes - offset);
            let mut part = vec![0; length as usize];
            reader.seek(std::io::SeekFrom::Start(offset)).await?;
            reader
                .read_exact(&mut part)
                .await
                .doing("the file changed while it was sent", file.display())?;
            let range = format!("{offset}-{}", offset + length - 1);
            let request = self
                .request(Method::PATCH, &upload)?
                .header(CONTENT_TYPE, "application/octet-stream")
                .header(CONTENT_RANGE, range)
                .body(part);
            let answer = match request.send().await {
                Ok(answer) => checked(answer).await,
                Err(error) => Err(error.into()),
            };
            match answer {
                Ok(answer) => {
                    upload = location(&answer).unwrap_or(upload);
                    offset += length;
                    sent(length as i64);
                    tries = 0;
                }
                Err(Refusal::Final(problem)) if problem.exit != Exit::Failed => {
                    return Err(problem);
                }
                Err(refusal) => {
                    tries += 1;
                    if tries >= TRIES {
                        return Err(refusal.into());
                    }
                    tokio::time::sleep(pause(tries)).await;
                    // The part may have arrived, in full or in part; ask how far the server is.
                    let held = match self.upload_offset(&upload).await {
                        Ok(Some(held)) => held.min(size_bytes),
                        Ok(None) => {
                            upload = self.open_upload().await?;
                            remembered.remember(&upload);
                            0
                        }
                        Err(_) => continue,
                    };
                    sent(held as i64 - offset as i64);
                    offset = held;
                }
            }
        }
        // Whatever the answer, this upload is at its end: one that was refused would be refused again.
        let finished = self.finish(&upload, digest, Vec::new()).await;
        if !matches!(&finished, Err(problem) if problem.exit == Exit::Unreachable) {
            remembered.forget();
        }
        finished
    }

    /// The upload that an earlier run began, with the bytes that the server has of it; otherwise a new one.
    async fn go_on(
        &self,
        remembered: &OpenUpload,
        size_bytes: u64,
    ) -> Result<(String, u64), Problem> {
        if let Some(upload) = remembered.location()
            && let Ok(Some(held)) = self.upload_offset(&upload).await
            && held <= size_bytes
        {
            return Ok((upload, held));
        }
        let upload = self.open_upload().await?;
        remembered.remember(&upload);
        Ok((upload, 0))
    }

    async fn open_upload(&self) -> Result<String, Problem> {
        let answer = retrying(|| async {
            checked(self.request(Method::POST, "blobs/uploads/")?.send().await?).await
        })
        .await?;
        location(&answer)
    }

    /// Bytes that the server holds of an upload; none when it does not know it any more.
    async fn upload_offset(&self, upload: &str) -> Result<Option<u64>, Problem> {
        let answer = self.request(Method::GET, upload)?.send().await?;
        if answer.status() == StatusCode::NOT_FOUND {
            return Ok(None);
        }
        let answer = checked(answer).await.map_err(Problem::from)?;
        let held = answer
            .headers()
            .get(RANGE)
            .and_then(|range| range.to_str().ok())
            .and_then(|range| range.trim_start_matches("bytes=").split_once('-'))
            .and_then(|(_, last)| last.parse::<u64>().ok());
        // An empty upload has no last byte: the header is absent or "0-0".
        Ok(Some(
            held.map_or(0, |last| if last == 0 { 0 } else { last + 1 }),
        ))
    }

    async fn finish(&self, upload: &str, digest: &Digest, rest: Vec<u8>) -> Result<(), Problem> {
        let joint = if upload.contains('?') { '&' } else { '?' };
        let path = format!("{upload}{joint}digest={digest}");
        let outcome = retrying(|| async {
            let request = self
                .request(Method::PUT, &path)?
                .header(CONTENT_TYPE, "application/octet-stream")
                .body(rest.clone());
            checked(request.send().await?).await
        })
        .await;
        match outcome {
            Ok(_) => Ok(()),
            // The answer to a first try may have been lost: what counts is whether the blob is there.
            Err(problem)
                if problem.exit == Exit::Failed && self.has(digest).await.unwrap_or(false) =>
            {
                Ok(())
            }
            Err(problem) => Err(problem.context("the upload was not accepted")),
        }
    }

    /// Writes a manifest under its digest.
    pub(crate) async fn put_manifest(&self, digest: &Digest, bytes: &[u8]) -> Result<(), Problem> {
        let path = format!("manifests/{digest}");
        retrying(|| async {
            let request = self
                .request(Method::PUT, &path)?
                .header(CONTENT_TYPE, MEDIA_TYPE)
                .body(bytes.to_vec());
            checked(request.send().await?).await
        })
        .await
        .map(drop)
        .map_err(|problem| problem.context("the capture's manifest was not accepted"))
    }

    /// Reads a manifest by digest and checks it.
    pub(crate) async fn manifest(&self, digest: &Digest) -> Result<Vec<u8>, Problem> {
        let path = format!("manifests/{digest}");
        let bytes = retrying(|| async {
            let request = self
                .request(Method::GET, &path)?
                .header(reqwest::header::ACCEPT, MEDIA_TYPE);
            Ok(checked(request.send().await?).await?.bytes().await?)
        })
        .await?;
        if Digest::of(&bytes) != *digest {
            return Err(
                Problem::failed("the manifest does not have the digest it is named by").at(digest),
            );
        }
        Ok(bytes.to_vec())
    }

    /// Reads a blob into `to`, or only checks it when `to` is none; goes on where a connection broke.
    pub(crate) async fn download(
        &self,
        digest: &Digest,
        size_bytes: u64,
        to: Option<&Path>,
        received: &(dyn Fn(i64) + Sync),
    ) -> Result<(), Problem> {
        let mut file = match to {
            Some(path) => Some(
                tokio::fs::File::create(path)
                    .await
                    .doing("cannot write", path.display())?,
            ),
            None => None,
        };
        let mut hash = Sha256::new();
        let mut offset = 0;
        let mut tries = 0;
        while offset < size_bytes || (size_bytes == 0 && tries == 0) {
            let before = offset;
            let outcome = self
                .download_from(
                    digest,
                    &mut offset,
                    size_bytes,
                    &mut file,
                    &mut hash,
                    received,
                )
                .await;
            tries = if offset > before { 1 } else { tries + 1 };
            match outcome {
                Ok(()) if offset >= size_bytes => break,
                Ok(()) if tries >= TRIES => {
                    return Err(Problem::failed(format!(
                        "the blob ends after {offset} of {size_bytes} bytes"
                    ))
                    .at(digest));
                }
                Err(Refusal::Passing(problem)) if tries >= TRIES => return Err(problem),
                Err(Refusal::Final(problem)) => return Err(problem),
                Ok(()) | Err(Refusal::Passing(_)) => tokio::time::sleep(pause(tries)).await,
            }
        }
        if let Some(mut file) = file {
            file.flush().await?;
            file.sync_all().await?;
        }
        let found = Digest::from_sha256(hash.finalize().into());
        if found != *digest {
            return Err(
                Problem::failed(format!("damaged: the bytes have digest {found}"))
                    .at(digest)
                    .hint("the store holds a damaged blob; bake the object again"),
            );
        }
        Ok(())
    }

    async fn download_from(
        &self,
        digest: &Digest,
        offset: &mut u64,
        size_bytes: u64,
        file: &mut Option<tokio::fs::File>,
        hash: &mut Sha256,
        received: &(dyn Fn(i64) + Sync),
    ) -> Result<(), Refusal> {
        let mut request = self.request(Method::GET, &format!("blobs/{digest}"))?;
        if *offset > 0 {
            request = request.header(RANGE, format!("bytes={offset}-"));
        }
        let answer = checked(request.send().await?).await?;
        // A server that ignores Range sends all of it: skip what we have.
        let mut skip = if answer.status() == StatusCode::PARTIAL_CONTENT {
            0
        } else {
            *offset
        };
        let mut stream = answer.bytes_stream();
        while let Some(chunk) = stream.next().await {
            let chunk = chunk?;
            let fresh = &chunk[(skip.min(chunk.len() as u64) as usize)..];
            skip = skip.saturating_sub(chunk.len() as u64);
            if *offset + fresh.len() as u64 > size_bytes {
                let problem =
                    Problem::failed(format!("the blob is longer than {size_bytes} bytes"))
                        .at(digest);
                return Err(Refusal::Final(problem));
            }
            if let Some(file) = file {
                file.write_all(fresh)
                    .await
                    .map_err(|error| Refusal::Final(error.into()))?;
            }
            hash.update(fresh);
            *offset += fresh.len() as u64;
            received(fresh.len() as i64);
        }
        Ok(())
    }
}

/// Why a request did not do what it should.
enum Refusal {
    /// May go away by itself: connection, time, overload.
    Passing(Problem),
    /// Trying again changes nothing.
    Final(Problem),
}

impl From<Problem> for Refusal {
    fn from(problem: Problem) -> Self {
        Self::Final(problem)
    }
}

impl From<reqwest::Error> for Refusal {
    fn from(error: reqwest::Error) -> Self {
        let what = format!("the connection broke: {}", chain(&error.without_url()));
        Self::Passing(Problem::unreachable(what).hint("the same command goes on where it stopped"))
    }
}

impl From<Refusal> for Problem {
    fn from(refusal: Refusal) -> Self {
        match refusal {
            Refusal::Passing(problem) | Refusal::Final(problem) => problem,
        }
    }
}

/// Marks "not found" among final problems; never printed.
const NOT_FOUND: &str = "not found";

fn absent_is_none<T>(answer: Result<T, Problem>) -> Result<Option<T>, Problem> {
    match answer {
        Ok(value) => Ok(Some(value)),
        Err(problem) if problem.what == NOT_FOUND => Ok(None),
        Err(problem) => Err(problem),
    }
}

/// The answer if it is a success; otherwise its message, from the OCI error body where there is one.
async fn checked(answer: Response) -> Result<Response, Refusal> {
    let status = answer.status();
    if status.is_success() {
        return Ok(answer);
    }
    if status == StatusCode::NOT_FOUND {
        return Err(Refusal::Final(Problem::failed(NOT_FOUND).at(answer.url())));
    }
    // A full store does not become empty within seconds: that is said at once.
    let passing = (status.is_server_error() && status != StatusCode::INSUFFICIENT_STORAGE)
        || matches!(
            status,
            StatusCode::REQUEST_TIMEOUT | StatusCode::TOO_MANY_REQUESTS
        );
    let body = answer.text().await.unwrap_or_default();
    let said = error_message(&body);
    let what = if said.is_empty() {
        status.to_string()
    } else {
        said
    };
    if status == StatusCode::UNAUTHORIZED {
        return Err(Refusal::Final(
            Problem::failed(what).hint("check --token-file (IGN_TOKEN_FILE)"),
        ));
    }
    Err(if passing {
        Refusal::Passing(Problem::unreachable(what).hint("ignctl doctor"))
    } else {
        Refusal::Final(Problem::failed(what))
    })
}

/// Message of an OCI error body (`{"errors":[{"code","message"}]}`), or a short plain one.
fn error_message(body: &str) -> String {
    let parsed: Option<serde_json::Value> = serde_json::from_str(body).ok();
    let message = parsed
        .as_ref()
        .and_then(|value| value.pointer("/errors/0/message"))
        .and_then(|message| message.as_str());
    match message {
        Some(message) => message.to_string(),
        None if body.len() <= 200 => body.trim().to_string(),
        None => String::new(),
    }
}

fn location(answer: &Response) -> Result<String, Problem> {
    answer
        .headers()
        .get(LOCATION)
        .and_then(|value| value.to_str().ok())
        .map(str::to_string)
        .ok_or_else(|| {
            Problem::failed("the server did not say where to send the upload").at(answer.url())
        })
}

/// Wait before try `tries` + 1: 0.2 s, doubled each time, at most 5 s.
fn pause(tries: u32) -> Duration {
    Duration::from_millis(100 << tries.min(6)).min(Duration::from_secs(5))
}

/// Tries an idempotent request again while the refusal may pass.
async fn retrying<T, F>(mut request: impl FnMut() -> F) -> Result<T, Problem>
where
    F: Future<Output = Result<T, Refusal>>,
{
    let mut tries = 0;
    loop {
        match request().await {
            Err(Refusal::Passing(_)) if tries + 1 < TRIES => {
                tries += 1;
                tokio::time::sleep(pause(tries)).await;
            }
            outcome => return outcome.map_err(Problem::from),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reads_oci_and_plain_error_bodies() {
        let oci = r#"{"errors":[{"code":"DIGEST_INVALID","message":"digest differs"}]}"#;
        assert_eq!(error_message(oci), "digest differs");
        assert_eq!(error_message("plain text\n"), "plain text");
        assert_eq!(error_message(&"<html>".repeat(100)), "");
    }

    #[test]
    fn waits_longer_each_time_within_bounds() {
        let waits: Vec<u128> = (1..9).map(|tries| pause(tries).as_millis()).collect();
        assert!(waits.is_sorted());
        assert_eq!((waits[0], waits[7]), (200, 5000));
    }
}
