//! How a token is written: `ign_ID_SECRETCHECK`.
//!
//! `ID` (12 of 0-9 A-Z without I L O U) is public and finds the row; `SECRET` (43 of 0-9 A-Z a-z) holds 256 random bits;
//! `CHECK` is the CRC-32 of all before it (6 of the same). The prefix and the checksum let a scanner for leaked secrets
//! find tokens, and nothing else, by `ign_[0-9A-Z]{12}_[0-9A-Za-z]{49}`.

use ign_queue::SecretHash;
use rand::TryRng as _;
use rand::rngs::SysRng;
use sha2::{Digest as _, Sha256};

const PREFIX: &str = "ign_";
const ID_CHARS: usize = 12;
const SECRET_CHARS: usize = 43;
const CHECK_CHARS: usize = 6;
const CROCKFORD: &[u8; 32] = b"0123456789ABCDEFGHJKMNPQRSTVWXYZ";
const BASE62: &[u8; 62] = b"0123456789ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz";

/// A token that somebody shows.
pub(crate) struct Shown<'a> {
    pub(crate) id: &'a str,
    pub(crate) secret: SecretHash,
}

/// Reads a token; none when it is not one, which costs no look at the database.
pub(crate) fn parse(text: &str) -> Option<Shown<'_>> {
    if !text.is_ascii() {
        return None;
    }
    let (body, check) = text.split_at_checked(text.len().checked_sub(CHECK_CHARS)?)?;
    let (id, secret) = body.strip_prefix(PREFIX)?.split_once('_')?;
    let good = id.len() == ID_CHARS
        && id.bytes().all(|b| CROCKFORD.contains(&b))
        && secret.len() == SECRET_CHARS
        && check == checksum(body);
    good.then(|| Shown {
        id,
        secret: hash(secret),
    })
}

/// A fresh token: its text and its parts.
pub(crate) struct Minted {
    pub(crate) id: String,
    pub(crate) text: String,
    pub(crate) secret: SecretHash,
}

/// A new token, or a new secret for the token with this id.
pub(crate) fn mint(id: Option<&str>) -> Result<Minted, rand::rngs::SysError> {
    let id = match id {
        Some(id) => id.to_owned(),
        None => random(CROCKFORD, ID_CHARS)?,
    };
    let secret = random(BASE62, SECRET_CHARS)?;
    let body = format!("{PREFIX}{id}_{secret}");
    Ok(Minted {
        text: format!("{body}{}", checksum(&body)),
        secret: hash(&secret),
        id,
    })
}

/// SHA-256 of a text.
pub(crate) fn hash(text: &str) -> SecretHash {
    Sha256::digest(text).into()
}

/// Characters of the alphabet, each as likely as any other: bytes beyond its last whole multiple are thrown away.
fn random(alphabet: &[u8], chars: usize) -> Result<String, rand::rngs::SysError> {
    let whole = 256 / alphabet.len() * alphabet.len();
    let mut text = String::with_capacity(chars);
    let mut bytes = [0; 64];
    while text.len() < chars {
        SysRng.try_fill_bytes(&mut bytes)?;
        let good = bytes.iter().map(|&b| usize::from(b)).filter(|b| *b < whole);
        text.extend(
            good.map(|b| char::from(alphabet[b % alphabet.len()]))
                .take(chars - text.len()),
        );
    }
    Ok(text)
}

fn checksum(body: &str) -> String {
    let mut left = crc32fast::hash(body.as_bytes()) as usize;
    let mut chars = [b'0'; CHECK_CHARS];
    for char in chars.iter_mut().rev() {
        *char = BASE62[left % BASE62.len()];
        left /= BASE62.len();
    }
    chars.map(char::from).iter().collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_minted_is_read() {
        let minted = mint(None).unwrap();
        let shown = parse(&minted.text).unwrap();
        assert_eq!((shown.id, shown.secret), (&minted.id[..], minted.secret));
        assert_eq!(minted.text.len(), 66);
        let again = mint(Some(&minted.id)).unwrap();
        assert_eq!(again.id, minted.id);
        assert_ne!(again.secret, minted.secret);
    }

    #[test]
    fn any_other_character_is_noticed() {
        let text = mint(None).unwrap().text;
        for at in 0..text.len() {
            for other in ["x", "0", "_", "ä"] {
                let mut wrong = text.clone();
                wrong.replace_range(at..=at, other);
                assert!(wrong == text || parse(&wrong).is_none(), "{wrong}");
            }
            assert!(parse(&text[..at]).is_none() && parse(&text[at + 1..]).is_none());
        }
    }
}
