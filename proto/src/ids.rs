//! Identifiers as newtypes: swapped arguments fail to compile, and a value that exists has been checked.
//!
//! Names become path segments of the object store and of URLs, so their alphabet is narrow: no separator, no leading
//! dot, no upper case (stores on case-insensitive file systems would merge them).

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};
use sha2::{Digest as _, Sha256};
use uuid::Uuid;

use crate::v1;

/// A text that is no valid identifier.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{kind} {text:?} is not valid: {rule}")]
pub struct IdError {
    /// Which identifier was expected.
    pub kind: &'static str,
    /// The offending text, cut to 80 characters.
    pub text: String,
    /// What it must look like.
    pub rule: &'static str,
}

impl IdError {
    pub(crate) fn new(kind: &'static str, text: &str, rule: &'static str) -> Self {
        Self {
            kind,
            text: text.chars().take(80).collect(),
            rule,
        }
    }
}

fn is_name(text: &str, max_bytes: usize, allow_upper: bool) -> bool {
    let alphanumeric = |b: u8| {
        b.is_ascii_lowercase() || b.is_ascii_digit() || (allow_upper && b.is_ascii_uppercase())
    };
    let bytes = text.as_bytes();
    bytes.len() <= max_bytes
        && bytes.first().is_some_and(|&b| alphanumeric(b))
        && bytes
            .iter()
            .all(|&b| alphanumeric(b) || matches!(b, b'.' | b'_' | b'-'))
}

macro_rules! text_id {
    ($(#[$doc:meta])* $name:ident, $kind:literal, $rule:literal, $check:expr) => {
        $(#[$doc])*
        #[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
        #[serde(try_from = "String", into = "String")]
        pub struct $name(String);

        impl $name {
            /// The checked text.
            pub fn as_str(&self) -> &str {
                &self.0
            }
        }

        impl FromStr for $name {
            type Err = IdError;

            fn from_str(text: &str) -> Result<Self, IdError> {
                let check: fn(&str) -> bool = $check;
                if check(text) { Ok(Self(text.to_owned())) } else { Err(IdError::new($kind, text, $rule)) }
            }
        }

        impl TryFrom<String> for $name {
            type Error = IdError;

            fn try_from(text: String) -> Result<Self, IdError> {
                text.parse()
            }
        }

        impl From<$name> for String {
            fn from(id: $name) -> Self {
                id.0
            }
        }

        impl AsRef<str> for $name {
            fn as_ref(&self) -> &str {
                &self.0
            }
        }

        impl fmt::Display for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.pad(&self.0)
            }
        }
    };
}

text_id!(
    /// A museum or department: the unit of access, quota and fairness.
    CollectionId,
    "collection",
    "1 to 63 of a-z 0-9 . _ -, starting with a letter or digit",
    |text| is_name(text, 63, false)
);
text_id!(
    /// A physical object within its collection.
    ObjectId,
    "object",
    "1 to 63 of a-z 0-9 . _ -, starting with a letter or digit",
    |text| is_name(text, 63, false)
);
text_id!(
    /// A worker agent, unique while it runs.
    WorkerId,
    "worker",
    "1 to 128 of A-Z a-z 0-9 . _ -, starting with a letter or digit",
    |text| is_name(text, 128, true)
);
text_id!(
    /// Content address of a blob or manifest, `sha256:` and 64 lower-case hex digits.
    Digest,
    "digest",
    "sha256: and 64 lower-case hex digits",
    |text| text.strip_prefix("sha256:").is_some_and(|hex| {
        hex.len() == 64 && hex.bytes().all(|b| b.is_ascii_digit() || (b'a'..=b'f').contains(&b))
    })
);

text_id!(
    /// Path of a file inside a capture or bundle, relative, with `/`: joined to any folder, it stays inside it.
    FilePath,
    "path",
    "relative, with / between names, no empty, . or .. name, no \\ : or control character, at most 512 bytes",
    |text| text.len() <= 512
        && !text.chars().any(|c| c.is_control() || matches!(c, '\\' | ':'))
        && text.split('/').all(|name| !matches!(name, "" | "." | ".."))
);

impl Digest {
    /// Of bytes in memory.
    pub fn of(bytes: &[u8]) -> Self {
        Self::from_sha256(Sha256::digest(bytes).into())
    }

    /// From the 32 bytes that SHA-256 gave.
    pub fn from_sha256(hash: [u8; 32]) -> Self {
        use fmt::Write as _;
        let mut text = String::with_capacity(71);
        text.push_str("sha256:");
        for byte in hash {
            // Writing to a String cannot fail.
            let _infallible = write!(text, "{byte:02x}");
        }
        Self(text)
    }

    /// The 64 hex digits without the algorithm.
    pub fn hex(&self) -> &str {
        &self.0["sha256:".len()..]
    }
}

/// One bake: a UUID of version 7, so that ids sort by time of submission.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct JobId(Uuid);

impl JobId {
    /// A new id, later than those made before on this machine.
    pub fn generate() -> Self {
        Self(Uuid::now_v7())
    }

    /// The UUID itself, for stores that have such a type.
    pub fn as_uuid(&self) -> Uuid {
        self.0
    }
}

impl From<Uuid> for JobId {
    fn from(uuid: Uuid) -> Self {
        Self(uuid)
    }
}

impl FromStr for JobId {
    type Err = IdError;

    fn from_str(text: &str) -> Result<Self, IdError> {
        let uuid = Uuid::try_parse(text).ok().filter(|_| text.len() == 36);
        uuid.map(Self)
            .ok_or_else(|| IdError::new("job", text, "a UUID with hyphens"))
    }
}

impl TryFrom<String> for JobId {
    type Error = IdError;

    fn try_from(text: String) -> Result<Self, IdError> {
        text.parse()
    }
}

impl From<JobId> for String {
    fn from(id: JobId) -> Self {
        id.to_string()
    }
}

impl fmt::Display for JobId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.0.hyphenated().encode_lower(&mut Uuid::encode_buffer()))
    }
}

/// One try of a job, counted from 1: the fencing token that every worker call carries.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Attempt(pub u32);

impl fmt::Display for Attempt {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

/// The alias that every new version of an object takes over.
pub const LATEST: &str = "latest";

/// An object with its collection, written `collection/object`.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct ObjectName {
    /// The collection.
    pub collection: CollectionId,
    /// The object within it.
    pub object: ObjectId,
}

impl FromStr for ObjectName {
    type Err = IdError;

    fn from_str(text: &str) -> Result<Self, IdError> {
        let (collection, object) = text.split_once('/').ok_or_else(|| {
            IdError::new(
                "object name",
                text,
                "a collection and an object, as in museum/vase",
            )
        })?;
        Ok(Self {
            collection: collection.parse()?,
            object: object.parse()?,
        })
    }
}

impl fmt::Display for ObjectName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}", self.collection, self.object)
    }
}

impl TryFrom<&v1::ObjectRef> for ObjectName {
    type Error = IdError;

    fn try_from(wire: &v1::ObjectRef) -> Result<Self, IdError> {
        Ok(Self {
            collection: wire.collection.parse()?,
            object: wire.object.parse()?,
        })
    }
}

impl From<&ObjectName> for v1::ObjectRef {
    fn from(name: &ObjectName) -> Self {
        Self {
            collection: name.collection.to_string(),
            object: name.object.to_string(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_safe_as_path_segments() {
        for good in ["a", "vase", "0-9", "a.b_c-d", &"x".repeat(63)] {
            assert_eq!(good.parse::<CollectionId>().unwrap().as_str(), good);
        }
        for bad in [
            "",
            ".",
            "..",
            ".a",
            "-a",
            "_a",
            "A",
            "a/b",
            "a b",
            "a\0",
            "ä",
            "a\n",
            &"x".repeat(64),
        ] {
            assert!(bad.parse::<ObjectId>().is_err(), "{bad:?}");
        }
        assert!("Host-1.local".parse::<WorkerId>().is_ok());
    }

    #[test]
    fn file_paths_cannot_leave_their_folder() {
        for good in [
            "a",
            "images/0001 (copy).JPG",
            "sparse/0/cameras.bin",
            "ä/ö",
            "..a/b..",
            ".hidden",
        ] {
            assert!(good.parse::<FilePath>().is_ok(), "{good}");
        }
        for bad in [
            "",
            "/",
            "/a",
            "a/",
            "a//b",
            ".",
            "..",
            "a/../b",
            "./a",
            "a\\b",
            "C:a",
            "a\0",
            "a\n",
            &"x".repeat(513),
        ] {
            assert!(bad.parse::<FilePath>().is_err(), "{bad:?}");
        }
    }

    #[test]
    fn digest_round_trips_and_refuses_other_spellings() {
        let digest = Digest::from_sha256([0xAB; 32]);
        assert_eq!(digest.as_str(), format!("sha256:{}", "ab".repeat(32)));
        assert_eq!(digest.to_string().parse::<Digest>().unwrap(), digest);
        assert_eq!(digest.hex().len(), 64);
        let empty = "sha256:e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855";
        assert_eq!(Digest::of(b"").as_str(), empty);
        for bad in [
            "ab".repeat(32),
            format!("sha256:{}", "AB".repeat(32)),
            format!("sha256:{}", "a".repeat(63)),
            format!("sha512:{}", "ab".repeat(32)),
            format!("sha256:{}/", "ab".repeat(31)),
        ] {
            assert!(bad.parse::<Digest>().is_err(), "{bad}");
        }
    }

    #[test]
    fn job_ids_sort_by_time_and_parse_only_hyphenated() {
        let (first, second) = (JobId::generate(), JobId::generate());
        assert!(first < second && first.to_string() < second.to_string());
        assert_eq!(first.to_string().parse::<JobId>().unwrap(), first);
        assert!(
            first
                .as_uuid()
                .simple()
                .to_string()
                .parse::<JobId>()
                .is_err()
        );
        assert!("".parse::<JobId>().is_err());
    }

    #[test]
    fn object_name_names_the_bad_half() {
        assert_eq!(
            "museum/vase".parse::<ObjectName>().unwrap().to_string(),
            "museum/vase"
        );
        assert_eq!(
            "museum/Vase".parse::<ObjectName>().unwrap_err().kind,
            "object"
        );
        assert_eq!(
            "Museum/vase".parse::<ObjectName>().unwrap_err().kind,
            "collection"
        );
        assert!("museum".parse::<ObjectName>().is_err());
    }
}
