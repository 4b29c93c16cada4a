//! Entries for the fuzz targets (`tests/fuzz`): what reads files that another machine wrote.

use crate::{Recipe, checkpoint};

/// A recipe as JSON; whether each of its settings is known and in range.
pub fn recipe(json: &[u8]) -> bool {
    serde_json::from_slice::<Recipe>(json).is_ok_and(|recipe| recipe.resolve(12).is_ok())
}

/// A checkpoint; whether training could go on from it.
pub fn checkpoint(bytes: &[u8]) -> bool {
    checkpoint::parse(bytes).is_ok()
}
