//! What the JSON formats share: numbers that may be written as text, lists that may be written as empty text, and
//! syntax errors as faults with their line.

use std::fmt;
use std::marker::PhantomData;

use serde::de::{DeserializeOwned, Error, IgnoredAny, MapAccess, SeqAccess, Visitor};
use serde::{Deserialize, Deserializer};

use crate::fault::Faults;

/// Reads the whole file as a `T`; a syntax error, or a value of another kind than the format has there, is a fault
/// with its line.
pub(super) fn read<T: DeserializeOwned>(
    bytes: &[u8],
    shown: &str,
    faults: &mut Faults,
) -> Option<T> {
    serde_json::from_slice(without_mark(bytes))
        .map_err(|error| {
            let text = error.to_string();
            // The place goes into the fault's own field.
            let message = text.split(" at line ").next().unwrap_or(&text);
            faults.error(
                format!("the file cannot be read: {message}"),
                format!("{shown}:{}", error.line()),
                "copy the file again, or export it again",
            );
        })
        .ok()
}

/// Without the mark that some programs put before UTF-8 text.
pub(super) fn without_mark(bytes: &[u8]) -> &[u8] {
    bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes)
}

/// A finite number, written as one or as text.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Number(pub(super) f64);

impl<'de> Deserialize<'de> for Number {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Numeric;
        impl Visitor<'_> for Numeric {
            type Value = Number;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("a finite number")
            }

            fn visit_f64<E: Error>(self, value: f64) -> Result<Number, E> {
                Ok(Number(value))
            }

            fn visit_i64<E: Error>(self, value: i64) -> Result<Number, E> {
                Ok(Number(value as f64))
            }

            fn visit_u64<E: Error>(self, value: u64) -> Result<Number, E> {
                Ok(Number(value as f64))
            }

            fn visit_bool<E: Error>(self, value: bool) -> Result<Number, E> {
                Ok(Number(f64::from(u8::from(value))))
            }

            fn visit_str<E: Error>(self, text: &str) -> Result<Number, E> {
                match text.trim().parse::<f64>() {
                    Ok(value) if value.is_finite() => Ok(Number(value)),
                    _ => Err(E::custom(format_args!("{text:?} is no finite number"))),
                }
            }
        }
        deserializer.deserialize_any(Numeric)
    }
}

/// An id, written as a number or as text.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Id(pub(super) String);

impl<'de> Deserialize<'de> for Id {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Any;
        impl Visitor<'_> for Any {
            type Value = Id;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("an id")
            }

            fn visit_i64<E: Error>(self, value: i64) -> Result<Id, E> {
                Ok(Id(value.to_string()))
            }

            fn visit_u64<E: Error>(self, value: u64) -> Result<Id, E> {
                Ok(Id(value.to_string()))
            }

            fn visit_str<E: Error>(self, text: &str) -> Result<Id, E> {
                Ok(Id(text.to_owned()))
            }
        }
        deserializer.deserialize_any(Any)
    }
}

/// A list; empty text and objects without entries stand for empty lists, as Boost's property trees write them.
#[derive(Debug, Clone)]
pub(super) struct List<T>(pub(super) Vec<T>);

impl<T> Default for List<T> {
    fn default() -> Self {
        Self(Vec::new())
    }
}

impl<'de, T: Deserialize<'de>> Deserialize<'de> for List<T> {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Items<T>(PhantomData<T>);
        impl<'de, T: Deserialize<'de>> Visitor<'de> for Items<T> {
            type Value = List<T>;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("a list")
            }

            fn visit_seq<A: SeqAccess<'de>>(self, mut items: A) -> Result<List<T>, A::Error> {
                let mut list = Vec::new();
                while let Some(item) = items.next_element()? {
                    list.push(item);
                }
                Ok(List(list))
            }

            fn visit_map<A: MapAccess<'de>>(self, mut entries: A) -> Result<List<T>, A::Error> {
                match entries.next_entry::<IgnoredAny, IgnoredAny>()? {
                    None => Ok(List::default()),
                    Some(_) => Err(A::Error::custom("expected a list, found an object")),
                }
            }

            fn visit_str<E: Error>(self, text: &str) -> Result<List<T>, E> {
                if text.is_empty() {
                    Ok(List::default())
                } else {
                    Err(E::custom("expected a list, found text"))
                }
            }
        }
        deserializer.deserialize_any(Items(PhantomData))
    }
}

/// Exactly `N` numbers of a list; `None` for any other count.
pub(super) fn numbers<const N: usize>(list: &[Number]) -> Option<[f64; N]> {
    let array: [Number; N] = list.try_into().ok()?;
    Some(array.map(|number| number.0))
}

/// The keys of an object, or of the first object in a list, as far as the text is sound; `None` for anything else.
pub(super) fn keys(bytes: &[u8]) -> Option<Keys> {
    let mut keys = Keys::default();
    let mut deserializer = serde_json::Deserializer::from_slice(without_mark(bytes));
    // What was seen before an error counts: a damaged file is still to be recognised, and reported.
    let result = deserializer.deserialize_any(&mut keys);
    (result.is_ok() || !keys.names.is_empty()).then_some(keys)
}

/// What [`keys`] found.
#[derive(Debug, Default)]
pub(super) struct Keys {
    /// The object stood in a list.
    pub(super) in_list: bool,
    names: Vec<String>,
}

/// More keys than any of the formats has.
const MOST_KEYS: usize = 256;

impl Keys {
    pub(super) fn has(&self, name: &str) -> bool {
        self.names.iter().any(|known| known == name)
    }
}

impl<'de> Visitor<'de> for &mut Keys {
    type Value = ();

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("an object")
    }

    fn visit_map<A: MapAccess<'de>>(self, mut entries: A) -> Result<(), A::Error> {
        while let Some(key) = entries.next_key::<String>()? {
            if self.names.len() < MOST_KEYS {
                self.names.push(key);
            }
            entries.next_value::<IgnoredAny>()?;
        }
        Ok(())
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut items: A) -> Result<(), A::Error> {
        if self.in_list {
            return Err(A::Error::custom("a list in a list"));
        }
        self.in_list = true;
        items.next_element_seed(self)?;
        while items.next_element::<IgnoredAny>()?.is_some() {}
        Ok(())
    }
}

impl<'de> serde::de::DeserializeSeed<'de> for &mut Keys {
    type Value = ();

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<(), D::Error> {
        deserializer.deserialize_any(self)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_and_lists_come_in_several_spellings() {
        let list: List<Number> = serde_json::from_str("[1, 2.5, \"-3e2\", true]").expect("numbers");
        assert_eq!(numbers::<4>(&list.0), Some([1.0, 2.5, -300.0, 1.0]));
        assert_eq!(numbers::<3>(&list.0), None);
        for empty in ["\"\"", "{}", "[]"] {
            let list: List<Number> = serde_json::from_str(empty).expect("an empty list");
            assert!(list.0.is_empty());
        }
        for wrong in ["\"nan\"", "\"1e999\"", "\"\"", "[1]"] {
            assert!(serde_json::from_str::<Number>(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn keys_are_seen_up_to_the_damage() {
        let keys = keys(b"\xef\xbb\xbf[{\"cameras\": {\"x\": 1}, \"shots\": {\"a\"").expect("keys");
        assert!(keys.in_list && keys.has("cameras") && keys.has("shots") && !keys.has("x"));
        assert!(super::keys(b"12").is_none() && super::keys(b"[[1]]").is_none());
    }
}
