//! Which views are held out: `test.txt`, else `capture.toml`, else every eighth view along the camera path.
//!
//! The camera path is the order of names, with runs of digits compared as numbers.

use std::cmp::Ordering;
use std::collections::BTreeSet;
use std::io;
use std::path::Path;

use crate::fault::Faults;
use crate::reconstruction::ModelImage;
use crate::settings::{self, Settings};

/// One view of this many is held out where the capture names none.
const EVERY: usize = 8;

/// The views, out of `count` in path order, that are held out by default. The first one is from the middle of the
/// first run, so that the ends of the path stay with the training views. With 3 to 7 views one is held out, with
/// fewer none.
fn every_eighth(count: usize) -> Vec<usize> {
    match count {
        0..3 => Vec::new(),
        3..EVERY => vec![count / 2],
        _ => (EVERY / 2..count).step_by(EVERY).collect(),
    }
}

/// Order of names along the camera path: runs of digits by value, the rest by bytes.
pub(crate) fn natural_order(a: &str, b: &str) -> Ordering {
    let (mut a_rest, mut b_rest) = (a.as_bytes(), b.as_bytes());
    while let (Some(&a_byte), Some(&b_byte)) = (a_rest.first(), b_rest.first()) {
        let order = if a_byte.is_ascii_digit() && b_byte.is_ascii_digit() {
            let a_digits = take_digits(&mut a_rest);
            let b_digits = take_digits(&mut b_rest);
            a_digits
                .len()
                .cmp(&b_digits.len())
                .then_with(|| a_digits.cmp(b_digits))
        } else {
            (a_rest, b_rest) = (&a_rest[1..], &b_rest[1..]);
            a_byte.cmp(&b_byte)
        };
        if order != Ordering::Equal {
            return order;
        }
    }
    // Equal but for leading zeros: the bytes decide, so that the order is total.
    a_rest.len().cmp(&b_rest.len()).then_with(|| a.cmp(b))
}

/// Takes the digits at the front, without leading zeros.
fn take_digits<'a>(rest: &mut &'a [u8]) -> &'a [u8] {
    let length = rest.iter().take_while(|b| b.is_ascii_digit()).count();
    let (digits, behind) = rest.split_at(length);
    *rest = behind;
    let zeros = digits.iter().take_while(|&&b| b == b'0').count();
    &digits[zeros..]
}

/// File with the names of the held-out views.
const HELD_OUT_FILE: &str = "test.txt";

/// Fewest views that something can be learned from.
const FEWEST_TRAINING_VIEWS: usize = 2;

/// Names of held-out views that the model has; `None` where the capture names none.
pub(crate) fn held_out_names(
    dir: &Path,
    settings: &Settings,
    registered: &[&ModelImage],
    model_is_whole: bool,
    faults: &mut Faults,
) -> Option<BTreeSet<String>> {
    let from_file = read_held_out(dir, faults);
    let listed = match (from_file, &settings.held_out) {
        (Some(file), Some(list)) => {
            let names = |list: &[(String, usize)]| {
                list.iter()
                    .map(|(name, _)| name.clone())
                    .collect::<BTreeSet<_>>()
            };
            if names(&file) != names(list) {
                faults.error(
                    format!(
                        "held-out views are named by {HELD_OUT_FILE} and {} and differ",
                        settings::FILE_NAME
                    ),
                    HELD_OUT_FILE,
                    "keep one of the two lists",
                );
            }
            (file, HELD_OUT_FILE)
        }
        (Some(file), None) => (file, HELD_OUT_FILE),
        (None, Some(list)) => (list.clone(), settings::FILE_NAME),
        (None, None) => return None,
    };
    let (names, file) = listed;
    if names.is_empty() {
        faults.warning(
            "the list of held-out views is empty; every eighth view is held out",
            file,
            "name some views, or remove the list",
        );
        return None;
    }
    let known: BTreeSet<&str> = registered.iter().map(|image| image.name.as_str()).collect();
    let mut kept = BTreeSet::new();
    for (name, line) in names {
        let at = format!("{file}:{line}");
        if known.contains(name.as_str()) {
            kept.insert(name);
        } else if !model_is_whole {
            // It may well be in the part that could not be read.
        } else if settings::is_inside(Path::new(&name)) && dir.join("images").join(&name).is_file()
        {
            faults.warning(
                format!("held-out view {name} is not in the model and is left out"),
                at,
                "the reconstruction did not register this photograph",
            );
        } else {
            let alike = known
                .iter()
                .find(|other| Path::new(other).file_stem() == Path::new(&name).file_stem());
            let hint = match alike {
                Some(alike) => format!("is {alike} meant?"),
                None => "names are those of the model's images, one per line".into(),
            };
            faults.error(format!("held-out view {name} is unknown"), at, hint);
        }
    }
    Some(kept)
}

/// The lines of `test.txt` with their numbers.
fn read_held_out(dir: &Path, faults: &mut Faults) -> Option<Vec<(String, usize)>> {
    match std::fs::read_to_string(dir.join(HELD_OUT_FILE)) {
        Ok(text) => {
            let lines = text
                .lines()
                .zip(1..)
                .map(|(line, number)| (line.trim().to_owned(), number));
            Some(
                lines
                    .filter(|(line, _)| !line.is_empty() && !line.starts_with('#'))
                    .collect(),
            )
        }
        Err(error) if error.kind() == io::ErrorKind::NotFound => None,
        Err(error) => {
            faults.error(
                format!("cannot read the file: {error}"),
                HELD_OUT_FILE,
                "one image name per line, UTF-8",
            );
            None
        }
    }
}

/// Indices of training and held-out views.
pub(crate) fn split(
    names: &[&str],
    held_out: Option<&BTreeSet<String>>,
) -> (Vec<usize>, Vec<usize>) {
    let chosen: BTreeSet<usize> = match held_out {
        Some(listed) => (0..names.len())
            .filter(|&view| listed.contains(names[view]))
            .collect(),
        None => every_eighth(names.len()).into_iter().collect(),
    };
    (0..names.len()).partition(|view| !chosen.contains(view))
}

pub(crate) fn check_split(train: &[usize], held_out: &[usize], faults: &mut Faults) {
    let count = train.len();
    if count == 0 && !held_out.is_empty() {
        faults.error(
            format!("all {} views are held out", held_out.len()),
            HELD_OUT_FILE,
            "leave most views for training: every eighth is a good share",
        );
    } else if count < FEWEST_TRAINING_VIEWS {
        faults.error(
            format!(
                "{count} training views are too few, at least {FEWEST_TRAINING_VIEWS} are needed"
            ),
            "images/",
            "take more photographs around the object, or hold out fewer",
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn digits_compare_as_numbers() {
        let mut names = vec!["b1", "a10.png", "a9.png", "a09.png", "a", "a10x", "a2b3"];
        names.sort_by(|a, b| natural_order(a, b));
        assert_eq!(
            names,
            ["a", "a2b3", "a09.png", "a9.png", "a10.png", "a10x", "b1"]
        );
    }

    #[test]
    fn default_split_leaves_the_ends_to_training() {
        assert!(every_eighth(2).is_empty());
        assert_eq!(every_eighth(5), [2]);
        assert_eq!(every_eighth(8), [4]);
        assert_eq!(every_eighth(26), [4, 12, 20]);
        for count in 3..100 {
            let held_out = every_eighth(count);
            assert!(!held_out.is_empty() && held_out.iter().all(|&i| i < count));
            assert!(count - held_out.len() >= 2, "{count}");
        }
    }
}
