//! Manifests: the list of files of a capture or bundle, as an OCI image manifest.
//!
//! Layers are the files; the annotation `org.opencontainers.image.title` is the path inside the folder. The config is
//! OCI's empty one, so that an ordinary OCI client can pull. Encoding is canonical (files sorted by path, keys in fixed
//! order, no white space): the same files give the same digest on every machine, which is what makes a capture that was
//! submitted twice cost nothing.
//!
//! Invariant: a [`Manifest`] that exists has at least one file, safe and distinct paths, and sorted order.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::ids::{Digest, FilePath};
use crate::v1;

/// `mediaType` of every manifest.
pub const MEDIA_TYPE: &str = "application/vnd.oci.image.manifest.v1+json";
/// Largest manifest that is read or written; enough for some 10,000 files.
pub const MAX_BYTES: usize = 4 * 1024 * 1024;
/// OCI's empty config, as a blob that the registry must hold.
pub const EMPTY_CONFIG: &[u8] = b"{}";

const EMPTY_CONFIG_TYPE: &str = "application/vnd.oci.empty.v1+json";
const TITLE: &str = "org.opencontainers.image.title";

/// What a manifest describes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Kind {
    /// Files as a user submitted them.
    Capture,
    /// Files of a baked model.
    Bundle,
}

impl Kind {
    /// The manifest's `artifactType`.
    pub fn artifact_type(self) -> &'static str {
        match self {
            Self::Capture => "application/vnd.ign.capture.v1",
            Self::Bundle => "application/vnd.ign.bundle.v1",
        }
    }
}

/// One file: a layer of its manifest.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FileEntry {
    /// Where it lies in the folder.
    pub path: FilePath,
    /// Its content.
    pub digest: Digest,
    /// Its length.
    pub size_bytes: u64,
    /// Media type; `application/octet-stream` when unknown.
    pub media_type: String,
}

/// The files of a capture or bundle.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Manifest {
    kind: Kind,
    files: Vec<FileEntry>,
    annotations: BTreeMap<String, String>,
}

/// A manifest that breaks a rule.
#[derive(Debug, thiserror::Error)]
pub enum ManifestError {
    /// No JSON, or not of this shape.
    #[error("manifest is not a valid OCI image manifest")]
    Json {
        /// What the parser said.
        #[source]
        source: serde_json::Error,
    },
    /// Larger than [`MAX_BYTES`].
    #[error("manifest has {size_bytes} bytes, more than {MAX_BYTES}")]
    TooLarge {
        /// Its length.
        size_bytes: usize,
    },
    /// A field has a value that is not supported.
    #[error("manifest field {field} is {value:?}, expected {expected}")]
    Field {
        /// Name of the field.
        field: &'static str,
        /// What it holds.
        value: String,
        /// What it should hold.
        expected: String,
    },
    /// A layer's title, or a file's path, is no safe relative path.
    #[error("file {index}: {reason}")]
    Path {
        /// Which file, from 0.
        index: usize,
        /// What is wrong.
        reason: String,
    },
    /// Two files with one path.
    #[error("path {path} is given twice")]
    Duplicate {
        /// The path.
        path: FilePath,
    },
    /// No files at all.
    #[error("manifest names no files")]
    Empty,
}

impl Manifest {
    /// From files in any order; `annotations` are kept as they are.
    pub fn new(
        kind: Kind,
        mut files: Vec<FileEntry>,
        annotations: BTreeMap<String, String>,
    ) -> Result<Self, ManifestError> {
        if files.is_empty() {
            return Err(ManifestError::Empty);
        }
        files.sort_by(|a, b| a.path.cmp(&b.path));
        if let Some(pair) = files.windows(2).find(|pair| pair[0].path == pair[1].path) {
            return Err(ManifestError::Duplicate {
                path: pair[0].path.clone(),
            });
        }
        Ok(Self {
            kind,
            files,
            annotations,
        })
    }

    /// What it describes.
    pub fn kind(&self) -> Kind {
        self.kind
    }

    /// The files, sorted by path.
    pub fn files(&self) -> &[FileEntry] {
        &self.files
    }

    /// Annotations of the whole.
    pub fn annotations(&self) -> &BTreeMap<String, String> {
        &self.annotations
    }

    /// Sum of the files' sizes.
    pub fn size_bytes(&self) -> u64 {
        self.files
            .iter()
            .fold(0, |sum, file| sum.saturating_add(file.size_bytes))
    }

    /// The canonical bytes.
    pub fn encode(&self) -> Result<Vec<u8>, ManifestError> {
        let wire = Wire {
            schema_version: 2,
            media_type: MEDIA_TYPE.to_owned(),
            artifact_type: self.kind.artifact_type().to_owned(),
            config: Descriptor {
                media_type: EMPTY_CONFIG_TYPE.to_owned(),
                digest: Digest::of(EMPTY_CONFIG),
                size: EMPTY_CONFIG.len() as u64,
                annotations: BTreeMap::new(),
            },
            layers: self
                .files
                .iter()
                .map(|file| Descriptor {
                    media_type: file.media_type.clone(),
                    digest: file.digest.clone(),
                    size: file.size_bytes,
                    annotations: BTreeMap::from([(TITLE.to_owned(), file.path.to_string())]),
                })
                .collect(),
            annotations: self.annotations.clone(),
        };
        let bytes = serde_json::to_vec(&wire).map_err(|source| ManifestError::Json { source })?;
        if bytes.len() > MAX_BYTES {
            return Err(ManifestError::TooLarge {
                size_bytes: bytes.len(),
            });
        }
        Ok(bytes)
    }

    /// Reads any encoding of a manifest and checks every rule.
    pub fn decode(bytes: &[u8]) -> Result<Self, ManifestError> {
        if bytes.len() > MAX_BYTES {
            return Err(ManifestError::TooLarge {
                size_bytes: bytes.len(),
            });
        }
        let wire: Wire =
            serde_json::from_slice(bytes).map_err(|source| ManifestError::Json { source })?;
        let field = |field, value: &str, expected: &str| ManifestError::Field {
            field,
            value: value.to_owned(),
            expected: expected.to_owned(),
        };
        if wire.schema_version != 2 {
            return Err(field(
                "schemaVersion",
                &wire.schema_version.to_string(),
                "2",
            ));
        }
        if wire.media_type != MEDIA_TYPE {
            return Err(field("mediaType", &wire.media_type, MEDIA_TYPE));
        }
        let kind = [Kind::Capture, Kind::Bundle]
            .into_iter()
            .find(|kind| kind.artifact_type() == wire.artifact_type)
            .ok_or_else(|| {
                field(
                    "artifactType",
                    &wire.artifact_type,
                    "a capture's or bundle's type",
                )
            })?;
        let empty = Digest::of(EMPTY_CONFIG);
        if wire.config.digest != empty {
            return Err(field(
                "config.digest",
                wire.config.digest.as_str(),
                empty.as_str(),
            ));
        }
        let files = wire
            .layers
            .into_iter()
            .enumerate()
            .map(|(index, layer)| {
                let title = layer.annotations.get(TITLE).map_or("", String::as_str);
                file_entry(index, title, layer.digest, layer.size, layer.media_type)
            })
            .collect::<Result<_, _>>()?;
        Self::new(kind, files, wire.annotations)
    }

    /// From the files of a worker's `Complete` call.
    pub fn from_wire(kind: Kind, files: &[v1::FileEntry]) -> Result<Self, ManifestError> {
        let files = files
            .iter()
            .enumerate()
            .map(|(index, file)| {
                let digest =
                    file.digest
                        .parse()
                        .map_err(|error: crate::IdError| ManifestError::Path {
                            index,
                            reason: error.to_string(),
                        })?;
                file_entry(
                    index,
                    &file.path,
                    digest,
                    file.size_bytes,
                    file.media_type.clone(),
                )
            })
            .collect::<Result<_, _>>()?;
        Self::new(kind, files, BTreeMap::new())
    }
}

fn file_entry(
    index: usize,
    path: &str,
    digest: Digest,
    size_bytes: u64,
    media_type: String,
) -> Result<FileEntry, ManifestError> {
    let path = path
        .parse()
        .map_err(|error: crate::IdError| ManifestError::Path {
            index,
            reason: error.to_string(),
        })?;
    let media_type = if media_type.is_empty() {
        "application/octet-stream".to_owned()
    } else {
        media_type
    };
    Ok(FileEntry {
        path,
        digest,
        size_bytes,
        media_type,
    })
}

impl From<&FileEntry> for v1::FileEntry {
    fn from(file: &FileEntry) -> Self {
        Self {
            path: file.path.to_string(),
            digest: file.digest.to_string(),
            size_bytes: file.size_bytes,
            media_type: file.media_type.clone(),
        }
    }
}

#[derive(Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
struct Wire {
    schema_version: u32,
    media_type: String,
    #[serde(default)]
    artifact_type: String,
    config: Descriptor,
    layers: Vec<Descriptor>,
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    annotations: BTreeMap<String, String>,
}

#[derive(Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
struct Descriptor {
    media_type: String,
    digest: Digest,
    size: u64,
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    annotations: BTreeMap<String, String>,
}

#[cfg(test)]
mod tests {
    use super::*;

    fn file(path: &str, content: &[u8]) -> FileEntry {
        FileEntry {
            path: path.parse().unwrap(),
            digest: Digest::of(content),
            size_bytes: content.len() as u64,
            media_type: "image/png".to_owned(),
        }
    }

    #[test]
    fn order_of_files_does_not_change_the_bytes_and_they_round_trip() {
        let (a, b) = (file("images/a.png", b"a"), file("mesh.ply", b"bb"));
        let one =
            Manifest::new(Kind::Capture, vec![a.clone(), b.clone()], BTreeMap::new()).unwrap();
        let two = Manifest::new(Kind::Capture, vec![b, a], BTreeMap::new()).unwrap();
        let bytes = one.encode().unwrap();
        assert_eq!(bytes, two.encode().unwrap());
        assert_eq!(Manifest::decode(&bytes).unwrap(), one);
        assert_eq!(one.size_bytes(), 3);
    }

    /// A digest that changes makes every capture already submitted look new.
    #[test]
    fn encoding_is_frozen() {
        let manifest = Manifest::new(
            Kind::Bundle,
            vec![file("bundle.json", b"x")],
            BTreeMap::new(),
        )
        .unwrap();
        assert_eq!(
            String::from_utf8(manifest.encode().unwrap()).unwrap(),
            concat!(
                r#"{"schemaVersion":2,"mediaType":"application/vnd.oci.image.manifest.v1+json","#,
                r#""artifactType":"application/vnd.ign.bundle.v1","config":{"#,
                r#""mediaType":"application/vnd.oci.empty.v1+json","digest":"sha256:"#,
                r#"44136fa355b3678a1146ad16f7e8649e94fb4fc21fe77e8310c060f61caaff8a","size":2},"#,
                r#""layers":[{"mediaType":"image/png","digest":"sha256:"#,
                r#"2d711642b726b04401627ca9fbac32f5c8530fb1903cc4db02258717921a4881","size":1,"#,
                r#""annotations":{"org.opencontainers.image.title":"bundle.json"}}]}"#
            )
        );
    }

    #[test]
    fn bad_manifests_are_refused_with_the_reason() {
        let good = Manifest::new(Kind::Capture, vec![file("a", b"a")], BTreeMap::new()).unwrap();
        let text = String::from_utf8(good.encode().unwrap()).unwrap();
        let title = r#""org.opencontainers.image.title":"a""#;
        for (from, to, expected) in [
            (
                title,
                r#""org.opencontainers.image.title":"../a""#,
                "file 0: path \"../a\"",
            ),
            (title, r#""other":"a""#, "file 0: path \"\""),
            (
                "\"schemaVersion\":2",
                "\"schemaVersion\":1",
                "schemaVersion",
            ),
            ("vnd.ign.capture.v1", "vnd.other", "artifactType"),
            ("image.manifest.v1", "image.index.v1", "mediaType"),
            ("44136f", "54136f", "config.digest"),
            (
                "\"size\":1",
                "\"size\":-1",
                "not a valid OCI image manifest",
            ),
        ] {
            let error = Manifest::decode(text.replace(from, to).as_bytes()).unwrap_err();
            assert!(error.to_string().contains(expected), "{error}");
        }
        assert!(matches!(
            Manifest::new(Kind::Capture, vec![], BTreeMap::new()),
            Err(ManifestError::Empty)
        ));
        let twice = vec![file("a", b"a"), file("a", b"b")];
        assert!(matches!(
            Manifest::new(Kind::Capture, twice, BTreeMap::new()),
            Err(ManifestError::Duplicate { .. })
        ));
        assert!(matches!(
            Manifest::decode(&vec![b' '; MAX_BYTES + 1]),
            Err(ManifestError::TooLarge { .. })
        ));
    }
}
