//! What a store accepts: limits on texts and numbers, the same for both databases.

use ign_proto::ObjectId;

use crate::state::{DEFAULT_MAX_ATTEMPTS, Failure, Progress};
use crate::store::{
    Collection, MAX_LOG_LINE_BYTES, MAX_RECIPE_BYTES, NewLogLine, NewVersion, Result, StoreError,
    Submit, WorkerInfo,
};
use crate::token::NewToken;
use crate::webhook::{MAX_URL_BYTES, SECRET_BYTES, Secret};

const MAX_REQUEST_ID_BYTES: usize = 200;
const MAX_LABELS: usize = 32;
const MAX_LABEL_BYTES: usize = 255;
const MAX_ATTEMPTS: u32 = 100;
const MAX_METRICS_BYTES: usize = 1024 * 1024;
const MAX_ALIAS_BYTES: usize = 63;
const MAX_GRANTS: usize = 100;

fn invalid<T>(field: &'static str, message: impl Into<String>) -> Result<T> {
    Err(StoreError::Invalid {
        field,
        message: message.into(),
    })
}

/// The request as it is kept, with defaults filled in.
pub(crate) fn submit(mut request: Submit) -> Result<Submit> {
    let id = &request.request_id;
    if id.is_empty() || id.len() > MAX_REQUEST_ID_BYTES || id.chars().any(char::is_control) {
        return invalid(
            "request_id",
            format!("must be 1 to {MAX_REQUEST_ID_BYTES} bytes of printable text"),
        );
    }
    let spec = &mut request.spec;
    json_object("recipe_json", &spec.recipe_json, MAX_RECIPE_BYTES)?;
    if spec.labels.len() > MAX_LABELS {
        return invalid("labels", format!("at most {MAX_LABELS}"));
    }
    for (label, value) in &spec.labels {
        let printable =
            |text: &str| text.len() <= MAX_LABEL_BYTES && !text.chars().any(char::is_control);
        if label.is_empty() || !printable(label) || !printable(value) {
            return invalid(
                "labels",
                format!("{label:?} or its value is empty, not printable or too long"),
            );
        }
    }
    if spec.max_attempts == 0 {
        spec.max_attempts = DEFAULT_MAX_ATTEMPTS;
    }
    if spec.max_attempts > MAX_ATTEMPTS {
        return invalid("max_attempts", format!("at most {MAX_ATTEMPTS}"));
    }
    Ok(request)
}

fn json_object(field: &'static str, text: &str, max_bytes: usize) -> Result<()> {
    if text.len() > max_bytes {
        return invalid(
            field,
            format!("{} bytes are more than {max_bytes}", text.len()),
        );
    }
    match serde_json::from_str::<serde_json::Map<String, serde_json::Value>>(text) {
        Ok(_) => Ok(()),
        Err(error) => invalid(field, format!("no JSON object: {error}")),
    }
}

pub(crate) fn bundle(bundle: &NewVersion) -> Result<()> {
    json_object("metrics_json", &bundle.metrics_json, MAX_METRICS_BYTES)?;
    bytes("size_bytes", bundle.size_bytes)
}

/// Databases know signed numbers only.
pub(crate) fn bytes(field: &'static str, bytes: u64) -> Result<()> {
    if i64::try_from(bytes).is_err() {
        return invalid(field, format!("{bytes} is out of range"));
    }
    Ok(())
}

pub(crate) fn collection(collection: &Collection) -> Result<()> {
    if !(0.001..=1e6).contains(&collection.weight) {
        return invalid(
            "weight",
            format!("{} is not within 0.001 and 1000000", collection.weight),
        );
    }
    Ok(())
}

/// Aliases are tags of the data plane; a version number or digest among them would hide the real one.
pub(crate) fn alias(alias: &str) -> Result<()> {
    let letter = |b: u8| b.is_ascii_lowercase() || b.is_ascii_digit();
    let named = alias.len() <= MAX_ALIAS_BYTES
        && alias.bytes().next().is_some_and(letter)
        && alias
            .bytes()
            .all(|b| letter(b) || matches!(b, b'.' | b'_' | b'-'));
    if !named {
        return invalid(
            "alias",
            format!(
                "must be 1 to {MAX_ALIAS_BYTES} of a-z 0-9 . _ -, starting with a letter or digit"
            ),
        );
    }
    if version_number(alias).is_some() {
        return invalid("alias", "looks like a version");
    }
    Ok(())
}

/// Ids are in upper case and names in lower case, so that neither is taken for the other.
pub(crate) fn token(new: &NewToken) -> Result<()> {
    let upper = |b: u8| b.is_ascii_uppercase() || b.is_ascii_digit();
    if new.id.len() != 12 || !new.id.bytes().all(upper) {
        return invalid("id", "must be 12 of A-Z 0-9");
    }
    if new.name.parse::<ObjectId>().is_err() || new.name.bytes().all(|b| b.is_ascii_digit()) {
        return invalid(
            "name",
            "must be 1 to 63 of a-z 0-9 . _ -, starting with a letter or digit, not digits alone",
        );
    }
    if new.grants.is_empty() || new.grants.len() > MAX_GRANTS {
        return invalid("grants", format!("must be 1 to {MAX_GRANTS}"));
    }
    Ok(())
}

pub(crate) fn webhook(url: &str, secret: &Secret) -> Result<()> {
    if url.is_empty() || url.len() > MAX_URL_BYTES || url.chars().any(char::is_control) {
        return invalid("url", format!("must be 1 to {MAX_URL_BYTES} bytes"));
    }
    if !SECRET_BYTES.contains(&secret.0.len()) {
        let (least, most) = (SECRET_BYTES.start(), SECRET_BYTES.end());
        return invalid("secret", format!("must be {least} to {most} bytes"));
    }
    Ok(())
}

/// `v3` as 3.
pub(crate) fn version_number(reference: &str) -> Option<u32> {
    let digits = reference.strip_prefix('v')?;
    if digits.is_empty() || !digits.bytes().all(|b| b.is_ascii_digit()) {
        return None;
    }
    // A number too large for any version names none.
    Some(digits.parse().unwrap_or(u32::MAX))
}

/// Text from a worker: any bytes may have got into it, but databases refuse NUL, and lengths must have an end.
pub(crate) fn clean(text: &str, max_bytes: usize) -> String {
    let mut end = text.len().min(max_bytes);
    while !text.is_char_boundary(end) {
        end -= 1;
    }
    text[..end].replace('\0', "\u{FFFD}")
}

pub(crate) fn log_line(line: &NewLogLine) -> NewLogLine {
    NewLogLine {
        message: clean(&line.message, MAX_LOG_LINE_BYTES),
        ..*line
    }
}

pub(crate) fn failure(failure: &Failure) -> Failure {
    Failure {
        kind: failure.kind,
        message: clean(&failure.message, MAX_LOG_LINE_BYTES),
        at: clean(&failure.at, MAX_LOG_LINE_BYTES),
        hint: clean(&failure.hint, MAX_LOG_LINE_BYTES),
    }
}

pub(crate) fn progress(progress: &Progress) -> Progress {
    Progress {
        stage: clean(&progress.stage, 64),
        message: clean(&progress.message, MAX_LOG_LINE_BYTES),
        ..*progress
    }
}

pub(crate) fn worker(worker: &WorkerInfo) -> WorkerInfo {
    WorkerInfo {
        id: worker.id.clone(),
        hostname: clean(&worker.hostname, 255),
        version: clean(&worker.version, 64),
        device: clean(&worker.device, 255),
    }
}

/// The first and last job id that start with `prefix`.
pub(crate) fn id_range(prefix: &str) -> Result<(uuid::Uuid, uuid::Uuid)> {
    const HYPHENS: [usize; 4] = [8, 13, 18, 23];
    let fits = prefix.len() >= 4
        && prefix.len() <= 36
        && prefix.bytes().enumerate().all(|(i, b)| {
            if HYPHENS.contains(&i) {
                b == b'-'
            } else {
                b.is_ascii_hexdigit()
            }
        });
    if !fits {
        return invalid(
            "job_id",
            format!("{prefix:?} is no id and no prefix of one (at least 4 characters)"),
        );
    }
    let digits: String = prefix.chars().filter(|&c| c != '-').collect();
    let bound = |fill: char| {
        let text: String = digits
            .chars()
            .chain(std::iter::repeat(fill))
            .take(32)
            .collect();
        u128::from_str_radix(&text, 16).map(uuid::Uuid::from_u128)
    };
    match (bound('0'), bound('f')) {
        (Ok(first), Ok(last)) => Ok((first, last)),
        _ => invalid("job_id", format!("{prefix:?} is not hexadecimal")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn aliases_never_look_like_versions() {
        for good in ["latest", "approved", "v1.0", "v", "2026-01", "vase"] {
            assert!(alias(good).is_ok(), "{good}");
        }
        for bad in [
            "",
            "v1",
            "v99999999999999",
            "Approved",
            "a/b",
            "sha256:x",
            "-x",
            &"a".repeat(64),
        ] {
            assert!(alias(bad).is_err(), "{bad}");
        }
        assert_eq!(version_number("v12"), Some(12));
        assert_eq!(version_number("v99999999999999"), Some(u32::MAX));
        assert_eq!(version_number("v1a"), None);
    }

    #[test]
    fn text_is_cut_at_a_character_and_has_no_nul() {
        assert_eq!(clean("aä\0b", 2), "a");
        assert_eq!(clean("aä\0b", 4), "aä\u{FFFD}");
        assert_eq!(clean("abc", 99), "abc");
    }

    #[test]
    fn prefix_bounds_hold_every_id_with_it() {
        let id = uuid::Uuid::parse_str("0192f0c1-2345-7abc-8def-0123456789ab").unwrap();
        let text = id.to_string();
        for length in 4..=36 {
            let (first, last) = id_range(&text[..length]).unwrap();
            assert!(first <= id && id <= last);
            assert_eq!(first == last, length == 36);
        }
        for bad in [
            "019",
            "0192f0c12",
            "0192-",
            "zzzz",
            "0192f0c1-2345-7abc-8def-0123456789abc",
            "+192",
        ] {
            assert!(id_range(bad).is_err(), "{bad}");
        }
    }
}
