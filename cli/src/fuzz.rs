//! Entries for the fuzz targets (`tests/fuzz`): what reads files that somebody else wrote.

use std::path::Path;

use crate::{bag, commands};

/// The CSV list of captures of `submit --manifest`; whether every row is sound.
pub fn list(file: &Path) -> bool {
    commands::manifest::read(file).is_ok()
}

/// A folder that may be a `BagIt` bag; whether it is whole.
pub fn bag(folder: &Path) -> bool {
    bag::payload(folder).is_ok()
}
