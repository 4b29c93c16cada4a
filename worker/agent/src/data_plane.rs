//! Client of the coordinator's HTTP data plane: manifests and blobs, both ways, resumable.
//!
//! Every method is one try, except that a transfer that broke off keeps what it got: calling again goes on from
//! there. The caller decides how long to go on. Files are streamed; memory per transfer is one chunk.

use std::io::SeekFrom;
use std::path::Path;
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use futures::StreamExt;
use ign_proto::{Digest, ObjectName, manifest};
use reqwest::header::{
    ACCEPT, AUTHORIZATION, CONTENT_LENGTH, CONTENT_RANGE, CONTENT_TYPE, HeaderMap, HeaderValue,
    LOCATION, RANGE,
};
use reqwest::{Method, RequestBuilder, Response, StatusCode, Url};
use sha2::{Digest as _, Sha256};
use tokio::io::{AsyncReadExt, AsyncSeekExt, AsyncWriteExt};

use crate::error::{AgentError, TransferError};
use crate::files;

/// Body of one upload request.
const CHUNK_BYTES: u64 = 4 << 20;

/// Blobs and manifests of one coordinator.
#[derive(Clone, Debug)]
pub(crate) struct DataPlane {
    http: reqwest::Client,
    base: Url,
}

/// What `push_blob` had to do.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Pushed {
    /// The store had the blob already.
    Known,
    /// Its bytes were sent.
    Sent,
}

/// The upload of one blob: where to go on with it after it broke off.
#[derive(Debug, Default)]
pub(crate) struct UploadSession(Mutex<Option<Url>>);

impl UploadSession {
    fn set(&self, location: Option<Url>) -> Option<Url> {
        let mut known = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        std::mem::replace(&mut known, location)
    }

    /// Sorts an error in the middle of an upload. What the server refuses here is about this upload, not about the
    /// blob: a new one may go well.
    fn broke_off(&self, error: TransferError) -> TransferError {
        match error {
            TransferError::Missing { what } => {
                self.set(None);
                let reason = "the server no longer knows the upload".to_owned();
                TransferError::Unavailable { what, reason }
            }
            TransferError::Refused {
                what,
                status: status @ (400 | 409 | 416),
                body,
            } => {
                // After 416 the server still has the upload and tells how far it is.
                if status != 416 {
                    self.set(None);
                }
                let reason = format!("status {status}: {body}");
                TransferError::Damaged { what, reason }
            }
            other => other,
        }
    }
}

impl DataPlane {
    pub(crate) fn new(
        server: &Url,
        token: &str,
        tls: &ign_client::Tls,
    ) -> Result<Self, AgentError> {
        let mut value = HeaderValue::from_str(&format!("Bearer {token}"))
            .map_err(|_invalid| AgentError::Token)?;
        value.set_sensitive(true);
        let bearer = (!token.is_empty()).then_some((AUTHORIZATION, value));
        let http = tls
            .http(reqwest::Client::builder())
            .default_headers(HeaderMap::from_iter(bearer))
            .connect_timeout(Duration::from_secs(5))
            .read_timeout(Duration::from_secs(30))
            .tcp_keepalive(Duration::from_secs(20))
            .build()
            .map_err(|error| AgentError::Server {
                url: server.to_string(),
                reason: error.to_string(),
            })?;
        Ok(Self {
            http,
            base: server.clone(),
        })
    }

    fn url(&self, object: &ObjectName, tail: &str) -> Url {
        let mut url = self.base.clone();
        // Names and digests hold nothing that needs escaping.
        url.set_path(&format!(
            "/v2/{}/{}/{tail}",
            object.collection, object.object
        ));
        url
    }

    /// The bytes of a manifest, checked against its digest.
    pub(crate) async fn manifest(
        &self,
        object: &ObjectName,
        digest: &Digest,
    ) -> Result<Vec<u8>, TransferError> {
        let what = format!("the capture manifest {digest}");
        let url = self.url(object, &format!("manifests/{digest}"));
        let request = self.http.get(url).header(ACCEPT, manifest::MEDIA_TYPE);
        let mut response = send(request, &what).await?;
        let mut bytes = Vec::new();
        while let Some(chunk) = response.chunk().await.map_err(broken(&what))? {
            bytes.extend_from_slice(&chunk);
            if bytes.len() > manifest::MAX_BYTES {
                return Err(TransferError::Manifest {
                    digest: digest.to_string(),
                    reason: format!("it is larger than {} bytes", manifest::MAX_BYTES),
                });
            }
        }
        if Digest::of(&bytes) != *digest {
            return Err(TransferError::Damaged {
                what,
                reason: "its digest differs".to_owned(),
            });
        }
        Ok(bytes)
    }

    /// Fetches a blob into `partial`, going on from what is there, and verifies it. `received` hears of every piece.
    pub(crate) async fn fetch(
        &self,
        object: &ObjectName,
        digest: &Digest,
        size_bytes: Option<u64>,
        partial: &Path,
        received: &(dyn Fn(u64) + Sync),
    ) -> Result<(), TransferError> {
        let what = format!("blob {digest}");
        let path = partial.to_path_buf();
        let (mut hasher, mut length) = match files::blocking(move || files::hash(&path)).await? {
            Ok(found) => found,
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => (Sha256::new(), 0),
            Err(source) => return Err(TransferError::file("read", partial, source)),
        };
        if size_bytes.is_some_and(|size| length > size) {
            (hasher, length) = (Sha256::new(), 0);
        }
        if length == 0 || size_bytes != Some(length) {
            let mut request = self.http.get(self.url(object, &format!("blobs/{digest}")));
            if length > 0 {
                request = request.header(RANGE, format!("bytes={length}-"));
            }
            let mut response = match send(request, &what).await {
                // What we hold is not a start of the blob, or all of it; the digest tells.
                Err(TransferError::Refused { status: 416, .. }) if length > 0 => None,
                other => Some(other?),
            };
            if let Some(response) = &mut response {
                if response.status() != StatusCode::PARTIAL_CONTENT
                    || range_start(response) != Some(length)
                {
                    (hasher, length) = (Sha256::new(), 0);
                    if response.status() == StatusCode::PARTIAL_CONTENT {
                        remove(partial).await?;
                        return Err(TransferError::Damaged {
                            what,
                            reason: "the server sent another range than was asked for".to_owned(),
                        });
                    }
                }
                let failed = |source| TransferError::file("write", partial, source);
                let file = tokio::fs::OpenOptions::new()
                    .create(true)
                    .write(true)
                    .truncate(false)
                    .open(partial)
                    .await
                    .map_err(failed)?;
                file.set_len(length).await.map_err(failed)?;
                let mut file = tokio::io::BufWriter::with_capacity(1 << 18, file);
                file.seek(SeekFrom::Start(length)).await.map_err(failed)?;
                received(length);
                let end = loop {
                    match response.chunk().await {
                        Ok(Some(chunk)) => {
                            file.write_all(&chunk).await.map_err(failed)?;
                            hasher.update(&chunk);
                            length += chunk.len() as u64;
                            received(chunk.len() as u64);
                        }
                        Ok(None) => break Ok(()),
                        Err(error) => break Err(broken(&what)(error)),
                    }
                };
                // Kept also when the transfer broke off: the next try goes on here.
                file.flush().await.map_err(failed)?;
                end?;
                file.get_ref().sync_data().await.map_err(failed)?;
            }
        }
        let found = Digest::from_sha256(hasher.finalize().into());
        if found == *digest {
            return Ok(());
        }
        remove(partial).await?;
        Err(TransferError::Damaged {
            what,
            reason: format!("{length} bytes with digest {found}"),
        })
    }

    /// Sends a file that has this digest, unless the store has it.
    pub(crate) async fn push(
        &self,
        object: &ObjectName,
        file: &Path,
        digest: &Digest,
        size_bytes: u64,
        session: &UploadSession,
    ) -> Result<Pushed, TransferError> {
        let what = format!("blob {digest}");
        let blob = self.url(object, &format!("blobs/{digest}"));
        match send(self.http.head(blob), &what).await {
            Ok(_) => return Ok(Pushed::Known),
            Err(TransferError::Missing { .. }) => {}
            Err(error) => return Err(error),
        }
        let uploads = self.url(object, "blobs/uploads/");
        if size_bytes <= CHUNK_BYTES {
            let bytes = read_piece(file, 0, size_bytes).await?;
            let mut url = uploads;
            url.query_pairs_mut().append_pair("digest", digest.as_str());
            let request = self.upload(Method::POST, url, bytes);
            send(request, &what).await?;
            return Ok(Pushed::Sent);
        }
        let (mut location, mut offset) = self.upload_state(&uploads, session, &what).await?;
        while offset < size_bytes {
            let length = CHUNK_BYTES.min(size_bytes - offset);
            let bytes = read_piece(file, offset, length).await?;
            let request = self
                .upload(Method::PATCH, location.clone(), bytes)
                .header(CONTENT_RANGE, format!("{offset}-{}", offset + length - 1));
            let response = match send(request, &what).await {
                Ok(response) => response,
                Err(error) => return Err(session.broke_off(error)),
            };
            offset = received_bytes(&response).unwrap_or(offset + length);
            if let Some(next) = self.location(&response) {
                location = next;
            }
            session.set(Some(location.clone()));
        }
        let mut finish = location;
        finish
            .query_pairs_mut()
            .append_pair("digest", digest.as_str());
        match send(self.upload(Method::PUT, finish, Vec::new()), &what).await {
            Ok(_) => Ok(Pushed::Sent),
            Err(error) => Err(session.broke_off(error)),
        }
    }

    /// Where to go on with an upload, and from which byte: the one that broke off if the server still knows it,
    /// otherwise a new one.
    async fn upload_state(
        &self,
        uploads: &Url,
        session: &UploadSession,
        what: &str,
    ) -> Result<(Url, u64), TransferError> {
        if let Some(known) = session.set(None) {
            match send(self.http.get(known.clone()), what).await {
                Ok(response) => {
                    let offset = received_bytes(&response).unwrap_or(0);
                    let location = self.location(&response).unwrap_or(known);
                    session.set(Some(location.clone()));
                    return Ok((location, offset));
                }
                Err(error) if error.is_passing() => {
                    session.set(Some(known));
                    return Err(error);
                }
                // Forgotten: begin again.
                Err(_) => {}
            }
        }
        let response = send(self.upload(Method::POST, uploads.clone(), Vec::new()), what).await?;
        let location = self
            .location(&response)
            .ok_or_else(|| TransferError::Unavailable {
                what: what.to_owned(),
                reason: "the server gave no usable upload location".to_owned(),
            })?;
        session.set(Some(location.clone()));
        Ok((location, 0))
    }

    fn upload(&self, method: Method, url: Url, body: Vec<u8>) -> RequestBuilder {
        self.http
            .request(method, url)
            .header(CONTENT_TYPE, "application/octet-stream")
            .header(CONTENT_LENGTH, body.len())
            .body(body)
    }

    /// The upload's address, if it lies on our server: our token goes nowhere else.
    fn location(&self, response: &Response) -> Option<Url> {
        let value = response.headers().get(LOCATION)?.to_str().ok()?;
        let url = response.url().join(value).ok()?;
        (url.origin() == self.base.origin()).then_some(url)
    }
}

async fn read_piece(file: &Path, offset: u64, length: u64) -> Result<Vec<u8>, TransferError> {
    let failed = |source| TransferError::file("read", file, source);
    let mut handle = tokio::fs::File::open(file).await.map_err(failed)?;
    handle.seek(SeekFrom::Start(offset)).await.map_err(failed)?;
    let mut bytes = vec![0; length as usize];
    handle.read_exact(&mut bytes).await.map_err(failed)?;
    Ok(bytes)
}

async fn remove(path: &Path) -> Result<(), TransferError> {
    match tokio::fs::remove_file(path).await {
        Err(source) if source.kind() != std::io::ErrorKind::NotFound => {
            Err(TransferError::file("remove", path, source))
        }
        _ => Ok(()),
    }
}

/// Sends a request, under the trace of its job, and sorts the answer.
async fn send(mut request: RequestBuilder, what: &str) -> Result<Response, TransferError> {
    if let Some(trace) = ign_trace::current() {
        request = request.header(ign_trace::HEADER, trace.to_string());
    }
    let response = request.send().await.map_err(broken(what))?;
    let status = response.status();
    if status.is_success() {
        return Ok(response);
    }
    let what = what.to_owned();
    match status {
        StatusCode::NOT_FOUND => Err(TransferError::Missing { what }),
        status
            if status.is_server_error()
                || matches!(
                    status,
                    StatusCode::REQUEST_TIMEOUT | StatusCode::TOO_MANY_REQUESTS
                ) =>
        {
            let reason = format!("status {status}: {}", short_body(response).await);
            Err(TransferError::Unavailable { what, reason })
        }
        status => Err(TransferError::Refused {
            what,
            status: status.as_u16(),
            body: short_body(response).await,
        }),
    }
}

/// The start of an error's body, for the log.
async fn short_body(response: Response) -> String {
    let mut bytes = Vec::new();
    let mut stream = response.bytes_stream();
    while let Some(Ok(chunk)) = stream.next().await {
        bytes.extend_from_slice(&chunk);
        if bytes.len() >= 500 {
            break;
        }
    }
    let text = String::from_utf8_lossy(&bytes);
    crate::logs::cut(text.trim(), 500).to_owned()
}

fn broken(what: &str) -> impl FnOnce(reqwest::Error) -> TransferError {
    let what = what.to_owned();
    move |error| TransferError::Unavailable {
        what,
        reason: chain(&error.without_url()),
    }
}

/// An error with its causes, in one line.
fn chain(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut cause = error.source();
    while let Some(error) = cause {
        text = format!("{text}: {error}");
        cause = error.source();
    }
    text
}

/// First byte of a `Content-Range: bytes 5-9/10` answer.
fn range_start(response: &Response) -> Option<u64> {
    let value = response.headers().get(CONTENT_RANGE)?.to_str().ok()?;
    value
        .strip_prefix("bytes ")?
        .split('-')
        .next()?
        .parse()
        .ok()
}

/// How much of an upload the server has, from `Range: 0-<last byte>`. An empty upload has no such header, or `0-0`
/// at servers that cannot say it otherwise; sending one byte twice does no harm where offsets are checked.
fn received_bytes(response: &Response) -> Option<u64> {
    let value = response.headers().get(RANGE)?.to_str().ok()?;
    let last: u64 = value
        .trim_start_matches("bytes=")
        .split('-')
        .nth(1)?
        .parse()
        .ok()?;
    Some(if last == 0 { 0 } else { last + 1 })
}
