//! What a bearer token allows: scopes, each in one collection or in all.

use std::fmt;
use std::str::FromStr;

use crate::ids::{CollectionId, IdError};

/// What may be done in a collection.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Scope {
    /// Upload captures, queue bakes, cancel and retry them.
    Submit,
    /// Look at jobs, logs and bundles, fetch bundles.
    Read,
    /// Work: lease jobs, read their captures, write blobs, publish bundles.
    Publish,
    /// All of these; move aliases, retire versions, set shares and limits. Everywhere: tokens too.
    Admin,
}

impl Scope {
    /// Every scope.
    pub const ALL: [Self; 4] = [Self::Submit, Self::Read, Self::Publish, Self::Admin];

    /// Its word.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Submit => "submit",
            Self::Read => "read",
            Self::Publish => "publish",
            Self::Admin => "admin",
        }
    }
}

impl fmt::Display for Scope {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.as_str())
    }
}

/// A scope in a collection, written `read:museum`, or in all of them, `read:*`.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Grant {
    /// What may be done.
    pub scope: Scope,
    /// Where; none means everywhere.
    pub collection: Option<CollectionId>,
}

impl Grant {
    /// A scope in every collection.
    pub const fn everywhere(scope: Scope) -> Self {
        Self {
            scope,
            collection: None,
        }
    }
}

impl fmt::Display for Grant {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let collection = self.collection.as_ref().map_or("*", CollectionId::as_str);
        write!(f, "{}:{collection}", self.scope)
    }
}

impl FromStr for Grant {
    type Err = IdError;

    fn from_str(text: &str) -> Result<Self, IdError> {
        let wrong = || {
            IdError::new(
                "grant",
                text,
                "submit, read, publish or admin, a colon, and a collection or *",
            )
        };
        let (word, collection) = text.split_once(':').ok_or_else(wrong)?;
        let scope = Scope::ALL.into_iter().find(|scope| scope.as_str() == word);
        Ok(Self {
            scope: scope.ok_or_else(wrong)?,
            collection: match collection {
                "*" => None,
                name => Some(name.parse().map_err(|_invalid: IdError| wrong())?),
            },
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn grants_are_read_as_they_are_written() {
        for text in ["submit:museum", "read:*", "publish:a.b", "admin:*"] {
            assert_eq!(text.parse::<Grant>().unwrap().to_string(), text);
        }
        for bad in [
            "", "read", "read:", "Read:*", "write:*", "read:**", "read:A", "read:a:b", ":*",
            "read: a",
        ] {
            assert!(bad.parse::<Grant>().is_err(), "{bad}");
        }
    }
}
