//! Writes the sound inputs of every target into `tests/fuzz/corpus`; run it after a format has changed.

use std::path::Path;

fn main() -> std::io::Result<()> {
    let corpus = Path::new(env!("CARGO_MANIFEST_DIR")).join("corpus");
    for (target, file, bytes) in ign_fuzz::targets::seeds() {
        std::fs::create_dir_all(corpus.join(target))?;
        std::fs::write(corpus.join(target).join(file), bytes)?;
    }
    Ok(())
}
