//! Writing and opening whole bundles.
//!
//! [`BundleWriter::finish`] writes `bundle.json` last, so an interrupted bake leaves no folder that looks complete.
//! [`Bundle::open`] trusts nothing: paths, sizes, digests, image sizes, weights and schemas are checked before
//! anything is handed out, and a folder with a file that the manifest does not list is refused.

use std::collections::BTreeSet;
use std::fs::{self, File};
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use ign_geometry::{Mesh, Similarity};
use image::{ExtendedColorType, ImageEncoder, RgbImage, codecs::png::PngEncoder};
use sha2::{Digest, Sha256};
use walkdir::WalkDir;

use crate::manifest::{FileRecord, Manifest, NetworkDescription, SCHEMA};
use crate::paths::{held_out_file, inside};
use crate::references::{self, HeldOutView, HeldOutViews, Reference};
use crate::weights::{self, Precision, Tensors};
use crate::{
    BundleError, HELD_OUT_VIEWS_FILE, MANIFEST_FILE, METRICS_FILE, Metrics, PROXY_FILE,
    REPORT_FILE, VIEWS_FILE, proxy,
};

/// Largest `bundle.json` or `views.json` that is read.
const MAX_JSON_BYTES: u64 = 64 << 20;

/// A bundle in the making.
#[derive(Debug)]
pub struct BundleWriter {
    dir: PathBuf,
}

impl BundleWriter {
    /// Makes `dir` (and its parents); it must not exist yet or be empty.
    pub fn create(dir: &Path) -> Result<Self, BundleError> {
        let io = || BundleError::io(dir.display().to_string());
        fs::create_dir_all(dir).map_err(io())?;
        if fs::read_dir(dir).map_err(io())?.next().is_some() {
            return Err(BundleError::malformed(
                dir.display().to_string(),
                "the folder is not empty",
            ));
        }
        Ok(Self {
            dir: dir.to_owned(),
        })
    }

    /// Adds a file under a new relative path.
    pub fn file(&self, path: &str, bytes: &[u8]) -> Result<(), BundleError> {
        let target = inside(&self.dir, path)?;
        if path == MANIFEST_FILE || target.exists() {
            return Err(BundleError::Duplicate {
                file: path.to_owned(),
            });
        }
        if let Some(parent) = target.parent() {
            fs::create_dir_all(parent).map_err(BundleError::io(path))?;
        }
        fs::write(&target, bytes).map_err(BundleError::io(path))
    }

    /// Adds the reference views.
    pub fn references(&self, references: &[Reference]) -> Result<(), BundleError> {
        references::encode(references)?
            .iter()
            .try_for_each(|(path, bytes)| self.file(path, bytes))
    }

    /// Adds the proxy; `mesh` is in the normalised frame.
    pub fn proxy(
        &self,
        mesh: &Mesh,
        normalised_from_world: &Similarity,
    ) -> Result<(), BundleError> {
        self.file(PROXY_FILE, &proxy::encode(mesh, normalised_from_world)?)
    }

    /// Adds a network's weights.
    pub fn weights(
        &self,
        path: &str,
        tensors: &Tensors,
        precision: Precision,
    ) -> Result<(), BundleError> {
        self.file(path, &weights::encode(path, tensors, precision)?)
    }

    /// Adds `metrics.json`.
    pub fn metrics(&self, metrics: &Metrics) -> Result<(), BundleError> {
        self.file(METRICS_FILE, &metrics.to_json()?)
    }

    /// Adds `report.html`.
    pub fn report(&self, html: &str) -> Result<(), BundleError> {
        self.file(REPORT_FILE, html.as_bytes())
    }

    /// Adds `held_out/VIEW.KIND.png`, an image as it was scored; `kind` is `ours` or `target`.
    pub fn held_out(&self, view: &str, kind: &str, image: &RgbImage) -> Result<(), BundleError> {
        let path = held_out_file(view, kind);
        self.file(&path, &encode_png(&path, image)?)
    }

    /// Adds `held_out/views.json`: camera and exposure of each scored image.
    pub fn held_out_views(&self, views: &[HeldOutView]) -> Result<(), BundleError> {
        let json = serde_json::to_vec_pretty(&HeldOutViews::new(views))
            .map_err(BundleError::json(HELD_OUT_VIEWS_FILE))?;
        self.file(HELD_OUT_VIEWS_FILE, &json)
    }

    /// Lists every file with its digest in `manifest`, writes `bundle.json`, and verifies the whole.
    pub fn finish(self, mut manifest: Manifest) -> Result<Bundle, BundleError> {
        manifest.files = list_files(&self.dir)?
            .into_iter()
            .map(|path| {
                let (sha256, size_bytes) = digest(&self.dir, &path)?;
                Ok(FileRecord {
                    path,
                    sha256,
                    size_bytes,
                })
            })
            .collect::<Result<_, BundleError>>()?;
        let json =
            serde_json::to_vec_pretty(&manifest).map_err(BundleError::json(MANIFEST_FILE))?;
        let (partial, target) = (
            self.dir.join(".bundle.json.partial"),
            self.dir.join(MANIFEST_FILE),
        );
        let write = || -> io::Result<()> {
            let mut file = File::create(&partial)?;
            file.write_all(&json)?;
            file.sync_all()?;
            fs::rename(&partial, &target)
        };
        write().map_err(BundleError::io(MANIFEST_FILE))?;
        Bundle::open(&self.dir)
    }
}

/// A verified bundle.
#[derive(Clone, Debug)]
pub struct Bundle {
    dir: PathBuf,
    manifest: Manifest,
}

impl Bundle {
    /// Verifies the folder `dir` completely.
    pub fn open(dir: &Path) -> Result<Self, BundleError> {
        let manifest = read_manifest(dir)?;
        let mut listed = BTreeSet::new();
        for record in &manifest.files {
            let path = inside(dir, &record.path)?;
            if record.path == MANIFEST_FILE || !listed.insert(record.path.clone()) {
                return Err(BundleError::Duplicate {
                    file: record.path.clone(),
                });
            }
            let metadata = match fs::symlink_metadata(&path) {
                Err(e) if e.kind() == io::ErrorKind::NotFound => {
                    return Err(BundleError::Missing {
                        file: record.path.clone(),
                    });
                }
                other => other.map_err(BundleError::io(&record.path))?,
            };
            if !metadata.is_file() {
                return Err(BundleError::malformed(&record.path, "not a regular file"));
            }
            if metadata.len() != record.size_bytes {
                return Err(BundleError::Size {
                    file: record.path.clone(),
                    found: metadata.len(),
                    expected: record.size_bytes,
                });
            }
        }
        if let Some(file) = list_files(dir)?
            .into_iter()
            .find(|path| !listed.contains(path))
        {
            return Err(BundleError::Unlisted { file });
        }
        let networks = [&manifest.networks.effects, &manifest.networks.composition];
        let required = [PROXY_FILE, VIEWS_FILE]
            .into_iter()
            .chain(networks.into_iter().flatten().map(|n| n.weights.as_str()));
        for file in required {
            if !listed.contains(file) {
                return Err(BundleError::Missing {
                    file: file.to_owned(),
                });
            }
        }
        for record in &manifest.files {
            if digest(dir, &record.path)?.0 != record.sha256 {
                return Err(BundleError::Digest {
                    file: record.path.clone(),
                });
            }
        }
        let bundle = Self {
            dir: dir.to_owned(),
            manifest,
        };
        bundle.check_content()?;
        Ok(bundle)
    }

    /// The folder.
    pub fn dir(&self) -> &Path {
        &self.dir
    }

    /// `bundle.json`.
    pub fn manifest(&self) -> &Manifest {
        &self.manifest
    }

    /// Bytes of all files but `bundle.json`.
    pub fn size_bytes(&self) -> u64 {
        self.manifest.files.iter().map(|f| f.size_bytes).sum()
    }

    /// The reference views, decoded.
    pub fn references(&self) -> Result<Vec<Reference>, BundleError> {
        references::decode(&self.read(VIEWS_FILE)?, |path| self.read(path))
    }

    /// The proxy in the normalised frame, and the transform from the capture's world into it.
    pub fn proxy(&self) -> Result<(Mesh, Similarity), BundleError> {
        proxy::decode(&self.read(PROXY_FILE)?)
    }

    /// The weights of `network`.
    pub fn weights(&self, network: &NetworkDescription) -> Result<Tensors, BundleError> {
        weights::decode(&network.weights, &self.read(&network.weights)?)
    }

    /// `metrics.json`, where the bundle has one.
    pub fn metrics(&self) -> Result<Option<Metrics>, BundleError> {
        if self.lists(METRICS_FILE) {
            Metrics::from_json(&self.read(METRICS_FILE)?).map(Some)
        } else {
            Ok(None)
        }
    }

    /// Camera and exposure of the scored images; none in a bundle without them.
    pub fn held_out_views(&self) -> Result<Vec<HeldOutView>, BundleError> {
        if !self.lists(HELD_OUT_VIEWS_FILE) {
            return Ok(Vec::new());
        }
        references::decode_held_out(&self.read(HELD_OUT_VIEWS_FILE)?)
    }

    fn lists(&self, path: &str) -> bool {
        self.manifest.files.iter().any(|f| f.path == path)
    }

    /// The content of a listed file.
    pub fn read(&self, path: &str) -> Result<Vec<u8>, BundleError> {
        if !self.lists(path) {
            return Err(BundleError::Missing {
                file: path.to_owned(),
            });
        }
        fs::read(inside(&self.dir, path)?).map_err(BundleError::io(path))
    }

    /// Decodes what programs would decode later, so that they cannot trip over it.
    fn check_content(&self) -> Result<(), BundleError> {
        for FileRecord { path, .. } in &self.manifest.files {
            match path.rsplit_once('.').map(|(_, extension)| extension) {
                Some("png" | "webp" | "jpg" | "jpeg") => {
                    references::check_size(path, &self.read(path)?)?;
                }
                Some("safetensors") => {
                    weights::decode(path, &self.read(path)?)?;
                }
                _ => {}
            }
        }
        let (_, transform) = self.proxy()?;
        if transform != Similarity::from(self.manifest.normalised_from_world) {
            return Err(BundleError::malformed(
                PROXY_FILE,
                "its world transform is not the one of bundle.json",
            ));
        }
        if self.references()?.is_empty() {
            return Err(BundleError::malformed(VIEWS_FILE, "no reference views"));
        }
        self.held_out_views()?;
        self.metrics().map(drop)
    }
}

/// Reads `bundle.json` without verifying the files that it lists.
pub fn read_manifest(dir: &Path) -> Result<Manifest, BundleError> {
    let path = dir.join(MANIFEST_FILE);
    let size = match fs::metadata(&path) {
        Err(e) if e.kind() == io::ErrorKind::NotFound => {
            return Err(BundleError::Missing {
                file: path.display().to_string(),
            });
        }
        other => other.map_err(BundleError::io(MANIFEST_FILE))?.len(),
    };
    if size > MAX_JSON_BYTES {
        return Err(BundleError::malformed(
            MANIFEST_FILE,
            format!("{size} bytes is over the limit"),
        ));
    }
    parse_manifest(&fs::read(&path).map_err(BundleError::io(MANIFEST_FILE))?)
}

/// Parses `bundle.json` and checks its schema.
pub fn parse_manifest(json: &[u8]) -> Result<Manifest, BundleError> {
    // The schema first: a newer version may lack any other field.
    #[derive(serde::Deserialize)]
    struct Schema {
        schema: String,
    }
    let Schema { schema } =
        serde_json::from_slice(json).map_err(BundleError::json(MANIFEST_FILE))?;
    if schema != SCHEMA {
        return Err(BundleError::Schema {
            file: MANIFEST_FILE.to_owned(),
            found: schema,
            expected: SCHEMA,
        });
    }
    serde_json::from_slice(json).map_err(BundleError::json(MANIFEST_FILE))
}

/// 8-bit RGB PNG; `file` is only named in errors.
pub(crate) fn encode_png(file: &str, image: &RgbImage) -> Result<Vec<u8>, BundleError> {
    let mut png = Vec::new();
    PngEncoder::new(&mut png)
        .write_image(
            image,
            image.width(),
            image.height(),
            ExtendedColorType::Rgb8,
        )
        .map_err(|source| BundleError::Image {
            file: file.to_owned(),
            source,
        })?;
    Ok(png)
}

/// Relative paths of everything under `dir` but folders and `bundle.json`, sorted.
fn list_files(dir: &Path) -> Result<Vec<String>, BundleError> {
    let mut files = Vec::new();
    for entry in WalkDir::new(dir).min_depth(1).sort_by_file_name() {
        let entry = entry.map_err(|e| {
            let path = e.path().unwrap_or(dir).display().to_string();
            BundleError::io(path)(e.into())
        })?;
        if entry.file_type().is_dir() {
            continue;
        }
        let names: Vec<_> = entry
            .path()
            .strip_prefix(dir)
            .unwrap_or(entry.path())
            .iter()
            .map(|n| n.to_string_lossy())
            .collect();
        let path = names.join("/");
        if path != MANIFEST_FILE {
            files.push(path);
        }
    }
    files.sort();
    Ok(files)
}

/// Lowercase hex sha256 and size of a file.
fn digest(dir: &Path, path: &str) -> Result<(String, u64), BundleError> {
    let mut hasher = HashWriter(Sha256::new());
    let mut file = File::open(inside(dir, path)?).map_err(BundleError::io(path))?;
    let size = io::copy(&mut file, &mut hasher).map_err(BundleError::io(path))?;
    Ok((hex::encode(hasher.0.finalize()), size))
}

/// `sha256:<hex>` of the names and contents of all files below `dir`, in the order of their names.
///
/// # Errors
/// A file that cannot be read.
pub fn folder_digest(dir: &Path) -> Result<String, BundleError> {
    let mut all = Sha256::new();
    for path in list_files(dir)? {
        let (sha256, _) = digest(dir, &path)?;
        all.update(format!("{sha256}  {path}\n"));
    }
    Ok(format!("sha256:{}", hex::encode(all.finalize())))
}

struct HashWriter(Sha256);

impl Write for HashWriter {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0.update(bytes);
        Ok(bytes.len())
    }
    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}
