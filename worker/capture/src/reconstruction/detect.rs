//! Which files of a capture are reconstructions: recognised by what is in them, at the capture's top and where the
//! programs themselves put them.

use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

use super::{Format, Found, json};

/// Folders, below the capture, in which programs write their files: `OpenDroneMap` and Bundler.
const FOLDERS: [&str; 3] = ["", "opensfm", "bundle"];

/// Meshroom's folder; each of its folders is one run.
const MESHROOM_RUNS: &str = "MeshroomCache/StructureFromMotion";

/// Endings of the files that are looked at.
const ENDINGS: [&str; 6] = ["json", "sfm", "xml", "csv", "txt", "out"];

/// How much of a file that is no JSON decides on its format.
const HEAD_BYTES: u64 = 1 << 16;

/// All files of a capture that hold a reconstruction, the preferred first.
pub(super) fn files(dir: &Path) -> Vec<Found> {
    let mut folders: Vec<PathBuf> = FOLDERS.iter().map(PathBuf::from).collect();
    let runs = std::fs::read_dir(dir.join(MESHROOM_RUNS));
    folders.extend(
        runs.into_iter()
            .flatten()
            .filter_map(Result::ok)
            .map(|run| Path::new(MESHROOM_RUNS).join(run.file_name())),
    );
    let mut found: Vec<Found> = Vec::new();
    for folder in folders {
        let Ok(entries) = std::fs::read_dir(dir.join(&folder)) else {
            continue;
        };
        for entry in entries.filter_map(Result::ok) {
            let path = folder.join(entry.file_name());
            if has_ending(&path)
                && let Some(format) = format_of(dir, &path)
            {
                found.push(Found { format, path });
            }
        }
    }
    found.sort();
    found
}

fn has_ending(path: &Path) -> bool {
    path.extension().is_some_and(|ending| {
        ENDINGS
            .iter()
            .any(|known| ending.eq_ignore_ascii_case(known))
    })
}

/// The format of a file by its content.
pub(super) fn format_of(dir: &Path, path: &Path) -> Option<Format> {
    let full = dir.join(path);
    if !full.is_file() {
        return None;
    }
    let mut head = Vec::new();
    let read = File::open(&full).and_then(|file| file.take(HEAD_BYTES).read_to_end(&mut head));
    read.ok()?;
    if starts_json(&head) {
        head = std::fs::read(&full).ok()?;
    }
    format_of_bytes(&head)
}

/// The format of a whole file, or of the head of one that is no JSON.
pub(super) fn format_of_bytes(bytes: &[u8]) -> Option<Format> {
    if starts_json(bytes) {
        let keys = json::keys(bytes)?;
        return match keys.in_list {
            true if keys.has("cameras") && keys.has("shots") => Some(Format::OpenSfm),
            false if keys.has("frames") => Some(Format::Transforms),
            false if keys.has("views") && keys.has("poses") => Some(Format::Meshroom),
            _ => None,
        };
    }
    let head = String::from_utf8_lossy(&bytes[..bytes.len().min(HEAD_BYTES as usize)]);
    let head = head.trim_start_matches('\u{feff}');
    if head.starts_with("# Bundle file") {
        Some(Format::Bundler)
    } else if head.trim_start().starts_with('<') {
        (head.contains("<document") && head.contains("<chunk")).then_some(Format::Metashape)
    } else {
        // The names of the columns come first, or behind comments.
        let names = head
            .lines()
            .find(|line| line.to_ascii_lowercase().starts_with("#name"));
        let comments_only = head
            .lines()
            .take_while(|line| !line.to_ascii_lowercase().starts_with("#name"))
            .all(|line| line.starts_with('#') || line.trim().is_empty());
        names
            .filter(|names| comments_only && names.contains(','))
            .map(|_| Format::RealityCapture)
    }
}

fn starts_json(bytes: &[u8]) -> bool {
    let text = json::without_mark(bytes);
    matches!(
        text.iter().find(|byte| !byte.is_ascii_whitespace()),
        Some(b'{' | b'[')
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn content_decides() {
        for (text, format) in [
            ("{\"w\": 3, \"frames\": []}", Some(Format::Transforms)),
            ("[{\"cameras\": {}, \"shots\": {}}]", Some(Format::OpenSfm)),
            (
                "{\"version\": [], \"views\": [], \"intrinsics\": [], \"poses\": \"\"}",
                Some(Format::Meshroom),
            ),
            ("{\"views\": [], \"intrinsics\": []}", None),
            ("{\"type\": \"FeatureCollection\"}", None),
            ("[1, 2]", None),
            ("{", None),
            ("# Bundle file v0.3\n1 2\n", Some(Format::Bundler)),
            (
                "<?xml version=\"1.0\"?>\n<document version=\"2.0.0\">\n<chunk>",
                Some(Format::Metashape),
            ),
            ("<svg/>", None),
            (
                "\u{feff}#cameras 3\n#name,x,y,alt,heading\n",
                Some(Format::RealityCapture),
            ),
            ("object,title\na,b\n", None),
            ("img.png\n#name,x\n", None),
            ("", None),
        ] {
            assert_eq!(format_of_bytes(text.as_bytes()), format, "{text}");
        }
    }
}
