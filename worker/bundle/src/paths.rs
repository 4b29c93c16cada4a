//! Which relative paths a bundle may hold.
//!
//! Bundles travel between systems and come from strangers, so a path is a short list of portable names joined by
//! `/`: no root, no `..`, no drive, no backslash, no control character, no hidden name.

use std::path::{Path, PathBuf};

use crate::BundleError;

const MAX_LENGTH: usize = 240;

/// `path` joined to `dir`, or [`BundleError::PathEscape`].
pub(crate) fn inside(dir: &Path, path: &str) -> Result<PathBuf, BundleError> {
    let portable = |name: &str| {
        !name.is_empty()
            && !name.starts_with('.')
            && !name.ends_with(['.', ' '])
            && !name.chars().any(|c| {
                c.is_control() || matches!(c, '\\' | ':' | '*' | '?' | '"' | '<' | '>' | '|')
            })
    };
    if path.len() > MAX_LENGTH || !path.split('/').all(portable) {
        return Err(BundleError::PathEscape {
            path: path.to_owned(),
        });
    }
    Ok(path
        .split('/')
        .fold(dir.to_owned(), |joined, name| joined.join(name)))
}

/// Where the 8-bit image `kind` (`ours`, `target`) of the held-out view `view` lies in a bundle.
///
/// The view's image name loses its extension, and what a path may not hold becomes `_`:
/// `held_out_file("walk/0007.jpg", "ours")` is `held_out/walk_0007.ours.png`.
pub fn held_out_file(view: &str, kind: &str) -> String {
    let stem = view
        .rsplit_once('.')
        .map_or(view, |(stem, _)| if stem.is_empty() { view } else { stem });
    let safe: String = stem
        .chars()
        .map(|c| {
            if c.is_ascii_alphanumeric() || matches!(c, '-' | '_' | '.' | '+') {
                c
            } else {
                '_'
            }
        })
        .collect();
    format!("held_out/{}.{kind}.png", safe.trim_start_matches('.'))
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::{held_out_file, inside};

    #[test]
    fn plain_paths_are_joined() {
        assert_eq!(
            inside(Path::new("/b"), "references/0001.png").unwrap(),
            Path::new("/b/references/0001.png")
        );
    }

    #[test]
    fn escapes_are_refused() {
        for path in [
            "",
            "/etc/passwd",
            "../x",
            "a/../../x",
            "a/./b",
            "a//b",
            "a/",
            "C:/x",
            "a\\..\\b",
            "a\0b",
            ".git/config",
            "x\n",
            "dir/..",
            "nul ",
        ] {
            assert!(inside(Path::new("/b"), path).is_err(), "{path:?}");
        }
        assert!(inside(Path::new("/b"), &"a/".repeat(200)).is_err());
    }

    #[test]
    fn held_out_names_are_portable() {
        assert_eq!(held_out_file("0007.jpg", "ours"), "held_out/0007.ours.png");
        assert_eq!(
            held_out_file("walk/a b.0007.jpg", "target"),
            "held_out/walk_a_b.0007.target.png"
        );
        assert_eq!(held_out_file("../.x", "ours"), "held_out/_.ours.png");
        assert!(inside(Path::new("/b"), &held_out_file("../../e", "ours")).is_ok());
    }
}
