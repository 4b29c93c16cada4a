//! Estimated diffuse images against the truth that demo captures carry for their held-out views.

use std::path::Path;

use ign_bundle::Bundle;
use ign_bundle::held_out_file;
use ign_bundle::metrics::mse;
use ign_capture::{Gains, ImportOptions, Scene};
use ign_render::{BundleRenderer, to_image};
use tch::Device;

use crate::data::Dataset;
use crate::recipe::Recipe;
use crate::{BakeError, io};

/// Where demo captures keep it.
const TRUTH: &str = "truth/diffuse";

/// Errors of one held-out view against its diffuse truth, on [0, 255], full frame.
pub(super) struct ViewErrors {
    /// Of the photograph: how much there is to remove.
    pub(super) photograph: f64,
    /// Of the estimated diffuse image.
    pub(super) estimated: f64,
}

/// A capture whose held-out photographs are replaced by their diffuse truth.
pub(super) struct Truth {
    scene: Scene,
    /// Holds the photographs that `scene` loads.
    folder: tempfile::TempDir,
}

impl Truth {
    /// # Errors
    /// A capture without the truth, or one that cannot be read.
    pub(super) fn of(capture: &Path) -> Result<Self, BakeError> {
        let truth = capture.join(TRUTH);
        if !truth.is_dir() {
            return Err(BakeError::Unusable {
                message: format!("{} has no {TRUTH}", capture.display()),
                hint: "only generated captures know it: ign-worker demo-capture makes one".into(),
            });
        }
        let folder = tempfile::tempdir().map_err(io(capture))?;
        copy(capture, folder.path())?;
        copy(&truth, &folder.path().join("images"))?;
        let scene = ign_capture::import(folder.path(), &ImportOptions::default())?;
        Ok(Self { scene, folder })
    }

    /// Compares the bundle in `dir`, baked from this capture with `recipe`.
    pub(super) fn errors(&self, recipe: &Recipe, dir: &Path) -> Result<Vec<ViewErrors>, BakeError> {
        let settings = recipe.resolve(self.scene.train.len())?;
        let gains = Gains::none(self.scene.views.len());
        let data = Dataset::new(
            &self.scene,
            &gains,
            recipe,
            &settings,
            Device::Cpu,
            self.folder.path(),
        )?;
        let renderer = BundleRenderer::open(dir, Device::Cpu)?;
        let bundle: &Bundle = renderer.bundle();
        data.held_out
            .iter()
            .map(|&view| {
                let name = &self.scene.views[view].name;
                let scored = data.scored(view, &data.settings)?;
                let truth = to_image(&scored.truth);
                let bytes = bundle.read(&held_out_file(name, "target"))?;
                let photograph =
                    image::load_from_memory(&bytes).map_err(|source| BakeError::Picture {
                        file: "held_out",
                        source,
                    })?;
                let estimated = renderer.diffuse_normalised(&scored.target.camera);
                Ok(ViewErrors {
                    photograph: mse(&photograph.into_rgb8(), &truth),
                    estimated: mse(&estimated, &truth),
                })
            })
            .collect()
    }
}

/// Copies the files below `from` over those below `to`.
fn copy(from: &Path, to: &Path) -> Result<(), BakeError> {
    std::fs::create_dir_all(to).map_err(io(to))?;
    for entry in std::fs::read_dir(from).map_err(io(from))? {
        let entry = entry.map_err(io(from))?;
        let (path, target) = (entry.path(), to.join(entry.file_name()));
        if path.is_dir() {
            copy(&path, &target)?;
        } else {
            std::fs::copy(&path, &target).map_err(io(&path))?;
        }
    }
    Ok(())
}
