//! Entry for the fuzz targets (`tests/fuzz`): what reads headers of requests, some before anybody is let in.

use axum::http::HeaderMap;
use axum::http::header::CONTENT_RANGE;

use crate::{data_plane, token};

/// A header's text as a token, as the `Range` of a blob of `size_bytes` and as a `Content-Range`.
///
/// # Panics
/// When a token's name is not the text's, or a range lies outside the blob.
pub fn header(text: &str, size_bytes: u64) {
    if let Some(shown) = token::parse(text) {
        assert!(text.contains(shown.id), "{}", shown.id);
    }
    if let data_plane::Wanted::Part(range) = data_plane::wanted_range(text, size_bytes) {
        assert!(
            range.start < range.end && range.end <= size_bytes,
            "{range:?}"
        );
    }
    if let Ok(value) = text.parse() {
        drop(data_plane::content_range_start(&HeaderMap::from_iter([(
            CONTENT_RANGE,
            value,
        )])));
    }
}
