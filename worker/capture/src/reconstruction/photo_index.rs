//! The photographs of a capture by all the ways in which other programs name them.
//!
//! Those programs write paths as they were on the machine that ran them, labels without an ending, or paths relative
//! to a file of their own; a capture has `images/`, and a view's name is the path below it.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use crate::photo;

/// Folders below `images/` that are looked into.
const DEEPEST: usize = 8;

/// Steps of a written path, from its end, that are compared.
const MOST_STEPS: usize = 16;

/// What lies below `images/`.
#[derive(Debug, Default)]
pub(crate) struct PhotoIndex {
    images: PathBuf,
    /// Widths and heights that are known without a look into the files.
    sizes: BTreeMap<String, (u32, u32)>,
    /// Names by themselves, and without their ending.
    names: BTreeMap<String, Vec<String>>,
    /// Names by their last step, and by that without its ending.
    last_steps: BTreeMap<String, Vec<String>>,
}

impl PhotoIndex {
    /// Looks through `dir/images`; hidden files are no photographs.
    pub(crate) fn of_capture(dir: &Path) -> Self {
        let mut index = Self {
            images: dir.join("images"),
            ..Self::default()
        };
        let walk = walkdir::WalkDir::new(&index.images)
            .follow_links(true)
            .max_depth(DEEPEST)
            .sort_by_file_name()
            .into_iter()
            .filter_entry(|entry| {
                entry.depth() == 0 || !entry.file_name().as_encoded_bytes().starts_with(b".")
            });
        let files: Vec<PathBuf> = walk
            .filter_map(Result::ok)
            .filter(|entry| entry.file_type().is_file())
            .map(walkdir::DirEntry::into_path)
            .collect();
        for file in files {
            let steps: Option<Vec<&str>> = file
                .strip_prefix(&index.images)
                .ok()
                .and_then(|relative| relative.iter().map(|step| step.to_str()).collect());
            if let Some(steps) = steps {
                index.add(&steps.join("/"));
            }
        }
        index
    }

    /// Photographs of which only names, widths and heights are known.
    pub(crate) fn listed(photographs: &[(String, (u32, u32))]) -> Self {
        let mut index = Self {
            sizes: photographs.iter().cloned().collect(),
            ..Self::default()
        };
        for name in index.sizes.keys().cloned().collect::<Vec<_>>() {
            index.add(&name);
        }
        index
    }

    fn add(&mut self, name: &str) {
        let last = name.rsplit('/').next().unwrap_or(name);
        for (map, key) in [(&mut self.names, name), (&mut self.last_steps, last)] {
            for key in [key, without_ending(key)] {
                let entry = map.entry(key.to_owned()).or_default();
                if entry.last().is_none_or(|known| known != name) {
                    entry.push(name.to_owned());
                }
            }
        }
    }

    /// The name below `images/` of a photograph that a file calls `written`: the longest end of that path that is
    /// there, with or without the ending. A photograph that is not there keeps its last step for a name, so that it
    /// is reported as missing.
    ///
    /// # Errors
    /// What is wrong, when it fits several photographs or none can be meant.
    pub(crate) fn name_of(&self, written: &str) -> Result<String, String> {
        let path = written.replace('\\', "/");
        let below_upwards = path.rsplit("../").next().unwrap_or(&path);
        let mut steps: Vec<&str> = below_upwards
            .rsplit('/')
            .filter(|step| !step.is_empty() && *step != ".")
            .take(MOST_STEPS)
            .collect();
        steps.reverse();
        let Some(&last) = steps.last() else {
            return Err(format!("{written:?} names no photograph"));
        };
        let by_end = (0..steps.len()).find_map(|start| {
            let end = steps[start..].join("/");
            self.names.get(&end).map(|names| (end, names))
        });
        let by_last_step = || Some((last.to_owned(), self.last_steps.get(last)?));
        match by_end.or_else(by_last_step) {
            None => Ok(last.to_owned()),
            Some((end, names)) => match names.as_slice() {
                [name] => Ok(name.clone()),
                several if several.contains(&end) => Ok(end),
                several => Err(format!(
                    "{written:?} fits several photographs: {}",
                    several.join(", ")
                )),
            },
        }
    }

    /// Width and height of a photograph by its header. A photograph that cannot be read has none, and is reported
    /// where photographs are checked.
    pub(crate) fn size_of(&self, name: &str) -> Option<(u32, u32)> {
        let known = self.names.get(name)?.iter().any(|known| known == name);
        self.sizes
            .get(name)
            .copied()
            .or_else(|| photo::dimensions(&self.images.join(name)).ok())
            .filter(|_| known)
    }
}

/// Up to the last dot, unless that begins the name.
fn without_ending(name: &str) -> &str {
    match name.rsplit_once('.') {
        Some((stem, ending))
            if !stem.is_empty() && !stem.ends_with('/') && !ending.contains('/') =>
        {
            stem
        }
        _ => name,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn index(names: &[&str]) -> PhotoIndex {
        let mut index = PhotoIndex::default();
        for name in names {
            index.add(name);
        }
        index
    }

    #[test]
    fn photographs_are_found_however_they_are_called() {
        let index = index(&[
            "IMG_1.JPG",
            "a/IMG_2.JPG",
            "b/IMG_2.JPG",
            "b/c/x.y.png",
            "10.png",
        ]);
        for (written, name) in [
            ("IMG_1.JPG", "IMG_1.JPG"),
            ("IMG_1", "IMG_1.JPG"),
            ("./images/IMG_1.JPG", "IMG_1.JPG"),
            ("C:\\photos\\vase\\IMG_1.JPG", "IMG_1.JPG"),
            ("/home/x/b/IMG_2.JPG", "b/IMG_2.JPG"),
            ("../../images/a/IMG_2", "a/IMG_2.JPG"),
            ("x.y", "b/c/x.y.png"),
            ("x.y.png", "b/c/x.y.png"),
            ("nowhere/IMG_9.JPG", "IMG_9.JPG"),
        ] {
            assert_eq!(index.name_of(written).as_deref(), Ok(name), "{written}");
        }
        assert!(
            index
                .name_of("IMG_2")
                .is_err_and(|message| message.contains("a/IMG_2.JPG, b/IMG_2.JPG"))
        );
        assert!(index.name_of("///").is_err());
        assert!(index.name_of("..").is_ok_and(|name| name == ".."));
    }

    #[test]
    fn an_exact_name_goes_before_one_with_another_ending() {
        let index = index(&["1.jpg", "1.jpg.png"]);
        assert_eq!(index.name_of("1.jpg").as_deref(), Ok("1.jpg"));
        assert!(index.name_of("1").is_ok_and(|name| name == "1.jpg"));
    }
}
