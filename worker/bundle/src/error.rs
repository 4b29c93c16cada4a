//! Everything that can be wrong with a bundle; each case names the file.

use std::io;

/// Why a bundle could not be written or is not accepted.
#[derive(Debug, thiserror::Error)]
pub enum BundleError {
    /// The file system refused.
    #[error("{file}: cannot be read or written")]
    Io {
        /// Path as given, or relative to the bundle.
        file: String,
        /// Cause.
        #[source]
        source: io::Error,
    },
    /// The file is no JSON, or lacks fields of its schema.
    #[error("{file}: not the JSON that its schema asks for")]
    Json {
        /// Relative path.
        file: String,
        /// Cause, with line and column.
        #[source]
        source: serde_json::Error,
    },
    /// Another format or a newer version.
    #[error("{file}: schema is {found:?}, this program reads {expected:?}")]
    Schema {
        /// Relative path.
        file: String,
        /// What the file says.
        found: String,
        /// What this crate reads.
        expected: &'static str,
    },
    /// Absolute, climbing out, or not portable.
    #[error("{path:?} is not a path inside a bundle")]
    PathEscape {
        /// The path as it was written.
        path: String,
    },
    /// A listed or required file is not there.
    #[error("{file}: absent")]
    Missing {
        /// Relative path.
        file: String,
    },
    /// A file or link that `bundle.json` does not list.
    #[error("{file}: not listed in bundle.json")]
    Unlisted {
        /// Relative path.
        file: String,
    },
    /// The same path twice.
    #[error("{file}: already in the bundle")]
    Duplicate {
        /// Relative path.
        file: String,
    },
    /// Truncated or extended.
    #[error("{file}: {found} bytes, bundle.json says {expected}")]
    Size {
        /// Relative path.
        file: String,
        /// Bytes on disk.
        found: u64,
        /// Bytes in the manifest.
        expected: u64,
    },
    /// Changed since it was packed.
    #[error("{file}: content does not match the sha256 in bundle.json")]
    Digest {
        /// Relative path.
        file: String,
    },
    /// Would take too much memory to decode.
    #[error("{file}: an image of {width}x{height} pixels is over the limit of {limit} pixels")]
    ImageTooLarge {
        /// Relative path.
        file: String,
        /// Width in pixels.
        width: u32,
        /// Height in pixels.
        height: u32,
        /// Most pixels accepted.
        limit: u64,
    },
    /// The image is damaged or of another format.
    #[error("{file}: not an image that can be decoded")]
    Image {
        /// Relative path.
        file: String,
        /// Cause.
        #[source]
        source: image::ImageError,
    },
    /// NaN or infinity among the weights (or a value that fp16 cannot hold).
    #[error("{file}: tensor {tensor:?} holds a non-finite value")]
    NonFinite {
        /// Relative path.
        file: String,
        /// Name of the tensor.
        tensor: String,
    },
    /// Anything else that the file's format forbids.
    #[error("{file}: {reason}")]
    Malformed {
        /// Relative path.
        file: String,
        /// What is wrong, lowercase.
        reason: String,
    },
}

impl BundleError {
    pub(crate) fn io(file: impl Into<String>) -> impl FnOnce(io::Error) -> Self {
        let file = file.into();
        move |source| Self::Io { file, source }
    }

    pub(crate) fn json(file: impl Into<String>) -> impl FnOnce(serde_json::Error) -> Self {
        let file = file.into();
        move |source| Self::Json { file, source }
    }

    pub(crate) fn malformed(file: impl Into<String>, reason: impl Into<String>) -> Self {
        Self::Malformed {
            file: file.into(),
            reason: reason.into(),
        }
    }
}
