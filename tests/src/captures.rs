//! Small generated captures.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use anyhow::{Result, ensure};

use crate::process::{program, run};

/// What to generate.
#[derive(Clone, Copy, Debug)]
pub struct Demo {
    /// `vase`, `bowl` or `sphere`.
    pub shape: &'static str,
    /// 0 (matte) to 1.
    pub gloss: f64,
    /// Edge of the photographs in pixels.
    pub size: u32,
    /// Photographs.
    pub views: usize,
    /// Varies painting and path.
    pub seed: u64,
}

impl Default for Demo {
    fn default() -> Self {
        Self {
            shape: "vase",
            gloss: 0.6,
            size: 48,
            views: 16,
            seed: 0,
        }
    }
}

/// Runs `ign-worker demo-capture` into `dir`.
pub fn demo_capture(dir: &Path, demo: Demo) -> Result<PathBuf> {
    let output = run(
        Command::new(program("ign-worker")?)
            .arg("demo-capture")
            .arg(dir)
            .args([
                "--shape",
                demo.shape,
                "--gloss",
                &demo.gloss.to_string(),
                "--size",
                &demo.size.to_string(),
                "--views",
                &demo.views.to_string(),
                "--seed",
                &demo.seed.to_string(),
            ]),
        Duration::from_mins(2),
    )?;
    ensure!(
        output.status.success(),
        "demo-capture failed: {}",
        String::from_utf8_lossy(&output.stderr)
    );
    Ok(dir.to_owned())
}

/// Copies a folder with everything in it.
pub fn copy_dir(from: &Path, to: &Path) -> Result<()> {
    fs::create_dir_all(to)?;
    for entry in fs::read_dir(from)? {
        let entry = entry?;
        let target = to.join(entry.file_name());
        if entry.file_type()?.is_dir() {
            copy_dir(&entry.path(), &target)?;
        } else {
            fs::copy(entry.path(), target)?;
        }
    }
    Ok(())
}
