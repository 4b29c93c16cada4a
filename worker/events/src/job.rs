//! The job file: what the agent hands to `ign-worker exec --job FILE`.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

/// One attempt of one job, as the child process gets it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct JobFile {
    /// Job id.
    pub job_id: String,
    /// Which try of the job this is, from 1.
    pub attempt: u32,
    /// Whose capture this is.
    pub object: ObjectName,
    /// Folder with the capture's files, as the capture manifest names them.
    pub capture_dir: PathBuf,
    /// `sha256:<hex>` of the capture manifest.
    pub capture_digest: String,
    /// What to bake and how; `ign-bake` owns its schema.
    pub recipe: serde_json::Value,
    /// Checkpoint file to resume from.
    pub checkpoint: Option<PathBuf>,
    /// Folder the child may write to; the bundle ends up in `bundle/` inside it.
    pub work_dir: PathBuf,
    /// CPU threads the child may use.
    pub threads: usize,
}

/// Collection and object.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ObjectName {
    /// A museum or department.
    pub collection: String,
    /// The object's name inside its collection.
    pub object: String,
}

impl JobFile {
    /// Reads a job file.
    ///
    /// # Errors
    /// The file is absent or unreadable, or is not a job file.
    pub fn read(path: &Path) -> std::io::Result<Self> {
        let bytes = std::fs::read(path)?;
        serde_json::from_slice(&bytes).map_err(std::io::Error::from)
    }

    /// Writes the job file.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn write(&self, path: &Path) -> std::io::Result<()> {
        let bytes = serde_json::to_vec_pretty(self).map_err(std::io::Error::from)?;
        std::fs::write(path, bytes)
    }
}
