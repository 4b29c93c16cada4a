//! `BagIt` bags (RFC 8493), as archives keep them: a folder whose payload lies in `data/` with a list of checksums.
//!
//! A bag is verified before anything of it is sent: every payload file is listed with the right checksum, and every
//! listed file is there. Bags that say where to fetch missing files (`fetch.txt`) are refused: nothing is downloaded.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Component, Path, PathBuf};

use crate::memory::Checksums;
use crate::problem::Problem;

/// What makes a folder a bag.
const DECLARATION: &str = "bagit.txt";
/// Checksums that a payload manifest may hold, strongest first; the first that the bag has is checked.
const ALGORITHMS: [&str; 4] = ["sha512", "sha256", "sha1", "md5"];

/// The folder that holds the captures of `path`: the payload of a bag, otherwise the folder itself.
///
/// # Errors
/// When `path` is a bag that is not whole; the message counts the faults and names the first.
pub(crate) fn payload(path: &Path) -> Result<PathBuf, Problem> {
    if !path.join(DECLARATION).is_file() {
        return Ok(path.to_path_buf());
    }
    let faults = verify(path)?;
    let Some(first) = faults.first() else {
        return Ok(path.join("data"));
    };
    let rest = match faults.len() {
        1 => String::new(),
        count => format!(", and {} more faults", count - 1),
    };
    Err(
        Problem::failed(format!("the bag is damaged: {first}{rest}"))
            .at(path.display())
            .hint("copy the bag again from where it is kept; nothing of it was sent"),
    )
}

/// Everything that is wrong with the payload of a bag.
fn verify(bag: &Path) -> Result<Vec<String>, Problem> {
    let fetch = bag.join("fetch.txt");
    if std::fs::metadata(&fetch).is_ok_and(|meta| meta.len() > 0) {
        return Ok(vec![
            "fetch.txt names files that are not in the bag".to_string(),
        ]);
    }
    let Some((algorithm, text)) = ALGORITHMS.iter().find_map(|algorithm| {
        let name = format!("manifest-{algorithm}.txt");
        Some((*algorithm, std::fs::read_to_string(bag.join(name)).ok()?))
    }) else {
        return Ok(vec![format!(
            "it has no payload manifest of {}",
            ALGORITHMS.join(", ")
        )]);
    };
    let mut faults = Vec::new();
    let listed = listed(&text, &mut faults);
    // What is read here is not read again for the store.
    let checksums = Checksums::default();
    for (file, expected) in &listed {
        match checksums.of(&bag.join(file), Some(algorithm), &|_| ()) {
            Ok(read) if read.sum(algorithm).eq_ignore_ascii_case(expected) => {}
            Ok(_) => faults.push(format!("{file} does not have its {algorithm} checksum")),
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => {
                faults.push(format!("{file} is missing"));
            }
            Err(error) => faults.push(format!("cannot read {file}: {error}")),
        }
    }
    for file in payload_files(bag)? {
        if !listed.contains_key(&file) {
            faults.push(format!("{file} is not in the bag's manifest"));
        }
    }
    Ok(faults)
}

/// Path and checksum of each line of a payload manifest.
fn listed(text: &str, faults: &mut Vec<String>) -> BTreeMap<String, String> {
    let mut files = BTreeMap::new();
    for (line, number) in text.trim_start_matches('\u{feff}').lines().zip(1..) {
        if line.trim().is_empty() {
            continue;
        }
        let entry = line.split_once([' ', '\t']).map(|(checksum, path)| {
            (
                checksum,
                unescaped(path.trim_start_matches([' ', '\t', '*'])),
            )
        });
        match entry {
            Some((checksum, path)) if stays_in_payload(&path) => {
                files.insert(path, checksum.to_string());
            }
            Some((_, path)) => faults.push(format!(
                "line {number} names {path}, which lies outside data/"
            )),
            None => faults.push(format!(
                "line {number} of the manifest is no checksum and path"
            )),
        }
    }
    files
}

/// Line breaks and percent signs are percent-encoded in manifests (RFC 8493, section 2.1.3).
fn unescaped(path: &str) -> String {
    path.replace("%0A", "\n")
        .replace("%0a", "\n")
        .replace("%0D", "\r")
        .replace("%0d", "\r")
        .replace("%25", "%")
}

fn stays_in_payload(path: &str) -> bool {
    path.starts_with("data/")
        && Path::new(path)
            .components()
            .all(|part| matches!(part, Component::Normal(_)))
}

fn payload_files(bag: &Path) -> Result<BTreeSet<String>, Problem> {
    let mut files = BTreeSet::new();
    for entry in walkdir::WalkDir::new(bag.join("data")) {
        let entry =
            entry.map_err(|error| Problem::failed(format!("cannot read the bag: {error}")))?;
        if !entry.file_type().is_dir() {
            let inside = entry.path().strip_prefix(bag).unwrap_or(entry.path());
            files.insert(inside.to_string_lossy().into_owned());
        }
    }
    Ok(files)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A bag with one file for each algorithm's manifest; checksums are those of `sha512sum`, `sha256sum`, ... of "abc".
    const ABC: [(&str, &str); 4] = [
        (
            "sha512",
            "ddaf35a193617abacc417349ae20413112e6fa4e89a97ea20a9eeee64b55d39a2192992a274fc1a836ba3c23a3feebbd454d4423643ce80e2a9ac94fa54ca49f",
        ),
        (
            "sha256",
            "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad",
        ),
        ("sha1", "a9993e364706816aba3e25717850c26c9cd0d89d"),
        ("md5", "900150983cd24fb0d6963f7d28e17f72"),
    ];

    fn bag(algorithm: &str, manifest: &str) -> tempfile::TempDir {
        let dir = tempfile::tempdir().unwrap();
        std::fs::write(
            dir.path().join(DECLARATION),
            "BagIt-Version: 1.0\nTag-File-Character-Encoding: UTF-8\n",
        )
        .unwrap();
        std::fs::create_dir_all(dir.path().join("data/images")).unwrap();
        std::fs::write(dir.path().join("data/images/a 100%.png"), "abc").unwrap();
        std::fs::write(
            dir.path().join(format!("manifest-{algorithm}.txt")),
            manifest,
        )
        .unwrap();
        dir
    }

    #[test]
    fn a_whole_bag_is_its_payload_and_a_plain_folder_is_itself() {
        for (algorithm, checksum) in ABC {
            for separator in ["  ", " *", "\t"] {
                let bag = bag(
                    algorithm,
                    &format!("{checksum}{separator}data/images/a 100%25.png\n"),
                );
                assert_eq!(payload(bag.path()).unwrap(), bag.path().join("data"));
            }
        }
        let plain = tempfile::tempdir().unwrap();
        assert_eq!(payload(plain.path()).unwrap(), plain.path());
    }

    #[test]
    fn a_damaged_bag_names_its_faults() {
        let (algorithm, checksum) = ABC[1];
        let good = format!("{checksum}  data/images/a 100%25.png\n");
        let what = |manifest: &str, file: Option<(&str, &str)>| {
            let bag = bag(algorithm, manifest);
            if let Some((name, text)) = file {
                std::fs::write(bag.path().join(name), text).unwrap();
            }
            payload(bag.path()).unwrap_err().what
        };
        for (outcome, expected) in [
            (
                what(&good, Some(("data/images/a 100%.png", "abd"))),
                "does not have its sha256 checksum",
            ),
            (
                what(&good, Some(("data/extra", "x"))),
                "data/extra is not in the bag's manifest",
            ),
            (
                what(&format!("{good}{checksum}  data/b.png\n"), None),
                "data/b.png is missing",
            ),
            (
                what(&format!("{good}{checksum}  data/../bagit.txt\n"), None),
                "which lies outside data/",
            ),
            (
                what(
                    &good,
                    Some(("fetch.txt", "https://elsewhere/ 3 data/b.png\n")),
                ),
                "fetch.txt",
            ),
            (what("nonsense\n", None), "no checksum and path, and 1 more"),
        ] {
            assert!(outcome.contains(expected), "{outcome}");
        }
        let empty = bag("sha3", "");
        assert!(
            payload(empty.path())
                .unwrap_err()
                .what
                .contains("no payload manifest")
        );
    }
}
