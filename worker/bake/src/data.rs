//! From an imported scene to what training needs: the normalised proxy, views at working resolution, references.
//!
//! Colours. A photograph's pixel at the object's rim mixes object and background. Where the capture is black outside
//! (a rendering or a cut-out with coverage), the colour is divided by the coverage in linear light, which gives the
//! object's own colour, and the coverage stays as the pixel's weight. Where a photograph shows background, rim pixels
//! cannot be repaired: they are left out by a weight that starts one pixel inside the mask or silhouette.
//!
//! What the capture says to ignore (a hand, a stand) counts as lying outside the photograph: it has no weight as a
//! colour to learn from or to show, is black in both images that are compared, and is no part of the object's score.
//!
//! Exposure. Where the photographs differ in exposure, everything that is learned from and rendered is in one canonical
//! exposure: photographs are multiplied by their view's gain, in linear light. Scores compare with the photographs as
//! they are, so a rendering is divided by the view's gain first ([`Scored::photographed`]), every method's alike.

use std::path::{Path, PathBuf};

use ign_capture::{Background, Frame, Gains, ImportError, Scene, ViewImage};
use ign_geometry::select::Candidates;
use ign_geometry::silhouette::{self, Outline};
use ign_geometry::simplify::simplify;
use ign_geometry::{Camera, Drawable, Mesh, Similarity};
use ign_nets::color;
use ign_render::{COVERAGE_CELLS, CoverageRule, ReferenceImage, RenderSettings, Target};
use rayon::prelude::*;
use tch::{Device, Kind, Tensor};

use crate::BakeError;
use crate::recipe::{Crop, Recipe, Settings};
use crate::views::ViewStore;

/// Of the training views, one in so many validates: it is neither trained on nor a reference.
const VALIDATION_EVERY: usize = 10;
/// At most so many validation views.
const VALIDATION_MOST: usize = 8;
/// Coverage below which a colour cannot be divided out of its background.
const LEAST_COVERAGE: f32 = 0.1;
/// Training views whose masks the proxy is fitted to, at most.
const FIT_VIEWS: usize = 48;
/// Long side of the G-buffers on which references are chosen.
const SELECTION_PX: u32 = 64;

/// The scene in the normalised frame with its views split.
pub(crate) struct Dataset<'a> {
    pub(crate) scene: &'a Scene,
    /// The proxy, simplified where the views do not show the difference.
    pub(crate) mesh: Mesh,
    /// `mesh`, ready to be drawn.
    pub(crate) proxy: Drawable,
    /// Where the proxy comes from and what became of it, in words for the plan.
    pub(crate) proxy_words: String,
    pub(crate) normalisation: Similarity,
    pub(crate) frame: Frame,
    pub(crate) settings: RenderSettings,
    /// Factor between the references' resolution and the target's.
    pub(crate) reference_scale: u32,
    pub(crate) train: Vec<usize>,
    pub(crate) validation: Vec<usize>,
    pub(crate) held_out: Vec<usize>,
    /// Per view of the scene and channel, linear light: from the photograph to the canonical exposure.
    pub(crate) gains: Vec<[f32; 3]>,
    pub(crate) device: Device,
    /// Memory for what training views show, and the folder for what does not fit.
    cache_bytes: u64,
    work_dir: PathBuf,
}

/// One view as it is scored.
pub(crate) struct Scored {
    pub(crate) target: Target,
    /// [1, 3, H, W]: encoded sRGB, black outside the object, in the photograph's exposure.
    pub(crate) truth: Tensor,
    /// Per channel, linear light: from the photograph's exposure to the canonical one.
    pub(crate) gain: [f32; 3],
    /// [1, 1, H, W]: 0 where both images are black before scoring, else 1.
    pub(crate) counted: Tensor,
    /// Row-major: on the object.
    pub(crate) object: Vec<bool>,
    /// [1, 1, H, W]: the same.
    pub(crate) object_mask: Tensor,
}

impl Scored {
    /// `image` ([1, 3, H, W], encoded sRGB, canonical exposure) as the photograph would show it.
    pub(crate) fn photographed(&self, image: &Tensor) -> Tensor {
        multiplied(image, self.gain.map(|gain| 1.0 / gain))
    }

    /// [1, 3, H, W]: the photograph in the canonical exposure, encoded sRGB; what networks are trained towards.
    pub(crate) fn canonical_truth(&self) -> Tensor {
        multiplied(&self.truth, self.gain)
    }
}

/// Multiplies encoded colours [1, 3, H, W] by a factor per channel in linear light; the result lies in [0, 1].
fn multiplied(image: &Tensor, factors: [f32; 3]) -> Tensor {
    if factors == NO_GAIN {
        return image.shallow_clone();
    }
    let factors = Tensor::from_slice(&factors)
        .view([1, 3, 1, 1])
        .to_device(image.device());
    let light = color::linear_from_srgb(&image.clamp(0.0, 1.0)) * factors;
    color::srgb_from_linear(&light.clamp(0.0, 1.0))
}

/// The gain of a view whose photograph stays as it is.
const NO_GAIN: [f32; 3] = [1.0; 3];

/// A view's straight colours and weights at one camera.
pub(crate) struct Straight {
    pub(crate) camera: Camera,
    /// Row-major RGB, encoded sRGB in [0, 1], canonical exposure.
    pub(crate) rgb: Vec<f32>,
    /// Row-major weight in [0, 1].
    pub(crate) alpha: Vec<f32>,
}

impl<'a> Dataset<'a> {
    pub(crate) fn new(
        scene: &'a Scene,
        gains: &Gains,
        recipe: &Recipe,
        settings: &Settings,
        device: Device,
        work_dir: &Path,
    ) -> Result<Self, BakeError> {
        let normalisation = scene.mesh.normalisation();
        let frame = match recipe.crop {
            Crop::Object => Frame::Object {
                size: recipe.size,
                margin: settings.margin,
            },
            Crop::None => Frame::Whole {
                long_side: recipe.size,
            },
        };
        let supersample = settings.supersample;
        let reference_scale = scene.useful_scale(&frame, supersample);
        let coverage = match scene.background {
            Background::Black if scene.useful_scale(&frame, COVERAGE_CELLS) > 1 => {
                CoverageRule::EncodedCells
            }
            Background::Black => CoverageRule::EncodedPixel,
            Background::MaskedOut | Background::Silhouette => CoverageRule::Fraction,
        };
        let corpus = spread(&scene.train, settings.train_views);
        let every = VALIDATION_EVERY.max(corpus.len().div_ceil(VALIDATION_MOST));
        let mut train = Vec::new();
        let mut validation = Vec::new();
        for (at, &view) in corpus.iter().enumerate() {
            if corpus.len() >= VALIDATION_EVERY && at % every == every / 2 {
                validation.push(view);
            } else {
                train.push(view);
            }
        }
        if train.len() < 2 {
            return Err(BakeError::Unusable {
                message: format!("only {} views are left to train on", train.len()),
                hint: "a bake needs at least 2 training views; shorten the held-out list or add photographs".into(),
            });
        }
        let render = RenderSettings {
            k: settings.k,
            supersample,
            coverage,
            recipe: settings.drawing,
        };
        let mesh = scene.mesh.transformed(&normalisation);
        Ok(Self {
            scene,
            proxy: Drawable::new(&mesh),
            mesh,
            proxy_words: String::new(),
            normalisation,
            frame,
            settings: render,
            reference_scale,
            train,
            validation,
            held_out: scene.held_out.clone(),
            gains: gains
                .per_view
                .iter()
                .map(|gain| gain.map(|channel| channel as f32))
                .collect(),
            device,
            cache_bytes: settings.cache_mb << 20,
            work_dir: work_dir.to_owned(),
        })
    }

    /// For what training views show one network.
    pub(crate) fn view_store(&self) -> ViewStore {
        ViewStore::new(&self.work_dir, self.cache_bytes, self.device)
    }

    /// Brings the proxy's outline to the masks of the training views where that helps views that had no part in it, if
    /// `wanted`; what was done, in words.
    pub(crate) fn fit_proxy(&mut self, wanted: bool) -> Result<Option<String>, BakeError> {
        let masked = |view: &&usize| self.scene.views[**view].mask.is_some();
        let views: Vec<usize> = self.train.iter().filter(masked).copied().collect();
        if !wanted || views.is_empty() {
            return Ok(None);
        }
        let outlines = spread(&views, FIT_VIEWS)
            .into_par_iter()
            .map(|view| {
                let (camera, world) = self.cameras(view, self.reference_scale);
                let image = self.scene.load_view(view, &world)?;
                let known = image.mask.unwrap_or_default().into_iter().zip(image.inside);
                let coverage = known
                    .map(|(covered, inside)| if inside < 0.5 { f32::NAN } else { covered })
                    .collect();
                Ok(Outline { camera, coverage })
            })
            .collect::<Result<Vec<Outline>, BakeError>>()?;
        let Some(fitted) = silhouette::fit(&self.mesh, &outlines) else {
            return Ok(None);
        };
        self.mesh = fitted.mesh;
        self.proxy = Drawable::new(&self.mesh);
        let scale = f64::from(self.reference_scale);
        Ok(Some(format!(
            "The proxy's outline was off the masks by {:.2} px; fitted to them it is off by {:.2} px, in views that had no \
             part in that.",
            fitted.before_px / scale,
            fitted.after_px / scale
        )))
    }

    /// Simplifies the proxy as far as the training views allow at the references' resolution, if `wanted`, and says so.
    pub(crate) fn settle_proxy(&mut self, wanted: bool) {
        let given = count(self.mesh.triangles.len());
        let cameras: Vec<Camera> = self
            .scene
            .train
            .iter()
            .map(|&view| self.cameras(view, self.reference_scale).0)
            .collect();
        let simplified = wanted.then(|| simplify(&self.mesh, &cameras)).flatten();
        let words = match simplified {
            Some(simplified) => {
                let deviation = simplified.deviation;
                self.mesh = simplified.mesh;
                self.proxy = Drawable::new(&self.mesh);
                format!(
                    "Proxy of {given} triangles simplified to {}: depth within {:.2} px footprints and silhouette \
                     within {:.3} px on average in {} views.",
                    count(self.mesh.triangles.len()),
                    deviation.depth_footprints,
                    deviation.silhouette_px,
                    simplified.views,
                )
            }
            None if wanted => {
                format!("Proxy of {given} triangles kept: a coarser one would show.")
            }
            None => format!("Proxy of {given} triangles, as given."),
        };
        self.proxy_words = match &self.scene.info.proxy_built {
            Some(built) => format!("{words} It was built: {built}."),
            None => words,
        };
    }

    /// A view's camera in the normalised frame, and the world camera it comes from.
    pub(crate) fn cameras(&self, view: usize, scale: u32) -> (Camera, Camera) {
        let world = self.scene.frame_camera(view, &self.frame, scale);
        (world.transformed(self.normalisation), world)
    }

    /// Loads a view as it is scored, drawn as `settings` say.
    pub(crate) fn scored(
        &self,
        view: usize,
        settings: &RenderSettings,
    ) -> Result<Scored, BakeError> {
        let (camera, world) = self.cameras(view, 1);
        let image = self.scene.load_view(view, &world)?;
        let target = Target::new(&self.proxy, &camera, settings, self.device);
        let (h, w) = target.size();
        let pixels = (h * w) as usize;
        let silhouette = ign_nets::params::flat_values(&target.coverage);
        let mut truth = image.rgb.clone();
        let mut scored = vec![1.0f32; pixels];
        let mut object = vec![false; pixels];
        for pixel in 0..pixels {
            let mask = image
                .mask
                .as_ref()
                .map_or(silhouette[pixel], |mask| mask[pixel]);
            if mask <= 0.0 || image.inside[pixel] < 0.5 {
                scored[pixel] = 0.0;
            }
            let factor = match self.scene.background {
                Background::Black if image.mask.is_some() => 1.0,
                _ => mask,
            };
            for channel in 0..3 {
                truth[pixel * 3 + channel] *= factor * scored[pixel];
            }
            object[pixel] = mask >= 0.5 && scored[pixel] > 0.0;
        }
        let truth = Tensor::from_slice(&truth)
            .view([h, w, 3])
            .permute([2, 0, 1])
            .contiguous()
            .unsqueeze(0);
        Ok(Scored {
            target,
            gain: self.gains[view],
            truth: truth.to_device(self.device),
            counted: Tensor::from_slice(&scored)
                .view([1, 1, h, w])
                .to_device(self.device),
            object_mask: Tensor::from_slice(&object)
                .view([1, 1, h, w])
                .to_kind(Kind::Float)
                .to_device(self.device),
            object,
        })
    }

    /// Loads a view's straight colours at `scale` times the working resolution.
    pub(crate) fn straight(&self, view: usize, scale: u32) -> Result<Straight, ImportError> {
        let (camera, world) = self.cameras(view, scale);
        let image = self.scene.load_view(view, &world)?;
        let (mut rgb, alpha) = match (self.scene.background, &image.mask) {
            (Background::Black, Some(mask)) => unmultiplied(&image, mask),
            (_, Some(mask)) => inside_only(&image, mask),
            (_, None) => {
                let silhouette = self.proxy.g_buffer(&camera, 2).coverage;
                inside_only(&image, &silhouette)
            }
        };
        let gain = self.gains[view];
        if gain != NO_GAIN {
            for (value, gain) in rgb.iter_mut().zip(gain.iter().cycle()) {
                *value = encoded((linear(*value) * gain).clamp(0.0, 1.0));
            }
        }
        Ok(Straight { camera, rgb, alpha })
    }

    /// Chooses the fixed reference views by coverage (paper, Sec. "Coverage-based View Selection").
    pub(crate) fn choose_references(&self, count: usize) -> Vec<usize> {
        let candidates = Candidates::new(self.train.len(), |at| {
            let (camera, _) = self.cameras(self.train[at], 1);
            let i = camera.intrinsics;
            let scale = f64::from(SELECTION_PX) / f64::from(i.width.max(i.height));
            let scaled = |n: u32| ((f64::from(n) * scale).round() as u32).max(1);
            let small = camera.with_intrinsics(i.resized(scaled(i.width), scaled(i.height)));
            self.proxy.g_buffer(&small, 1)
        });
        let chosen = candidates.choose(count);
        chosen.into_iter().map(|at| self.train[at]).collect()
    }

    /// Loads reference views as a bundle stores them: 8 bit, straight colour and weight, `scale` times the working
    /// resolution.
    pub(crate) fn reference_images(
        &self,
        chosen: &[usize],
        scale: u32,
    ) -> Result<Vec<ReferenceImage>, BakeError> {
        chosen
            .par_iter()
            .map(|&view| {
                let straight = self.straight(view, scale)?;
                let rgba = straight
                    .alpha
                    .iter()
                    .zip(straight.rgb.chunks_exact(3))
                    .flat_map(|(&alpha, rgb)| {
                        let alpha = byte(alpha);
                        let color = if alpha == 0 {
                            [0, 0, 0]
                        } else {
                            [byte(rgb[0]), byte(rgb[1]), byte(rgb[2])]
                        };
                        [color[0], color[1], color[2], alpha]
                    })
                    .collect();
                Ok(ReferenceImage {
                    name: self.scene.views[view].name.clone(),
                    camera: straight.camera,
                    rgba,
                })
            })
            .collect()
    }
}

/// At most `most` of all, evenly spread.
pub(crate) fn spread(all: &[usize], most: usize) -> Vec<usize> {
    let kept = all.len().min(most);
    (0..kept).map(|at| all[at * all.len() / kept]).collect()
}

/// A number with its thousands set apart.
fn count(number: usize) -> String {
    let digits = number.to_string();
    let mut text = String::new();
    for (at, digit) in digits.chars().enumerate() {
        if at > 0 && (digits.len() - at).is_multiple_of(3) {
            text.push(',');
        }
        text.push(digit);
    }
    text
}

fn byte(value: f32) -> u8 {
    (value.clamp(0.0, 1.0) * 255.0).round() as u8
}

fn linear(encoded: f32) -> f32 {
    if encoded <= 0.040_45 {
        encoded / 12.92
    } else {
        ((encoded + 0.055) / 1.055).powf(2.4)
    }
}

fn encoded(linear: f32) -> f32 {
    if linear <= 0.003_130_8 {
        linear * 12.92
    } else {
        1.055 * linear.powf(1.0 / 2.4) - 0.055
    }
}

/// Divides the coverage out of colours that were mixed with black in linear light.
fn unmultiplied(image: &ViewImage, mask: &[f32]) -> (Vec<f32>, Vec<f32>) {
    let mut rgb = image.rgb.clone();
    let mut alpha = vec![0.0; mask.len()];
    for (at, &coverage) in mask.iter().enumerate() {
        let weight = coverage.min(image.inside[at]);
        if weight >= LEAST_COVERAGE {
            alpha[at] = weight;
            for value in &mut rgb[at * 3..at * 3 + 3] {
                *value = encoded((linear(*value) / coverage).clamp(0.0, 1.0));
            }
        }
    }
    (rgb, alpha)
}

/// Keeps pixels whose neighbourhood lies inside the object and the photograph.
fn inside_only(image: &ViewImage, mask: &[f32]) -> (Vec<f32>, Vec<f32>) {
    let (w, h) = (image.width as usize, image.height as usize);
    let mut alpha = vec![0.0f32; w * h];
    for y in 0..h {
        for x in 0..w {
            let mut least = 1.0f32;
            for ny in y.saturating_sub(1)..(y + 2).min(h) {
                for nx in x.saturating_sub(1)..(x + 2).min(w) {
                    least = least.min(mask[ny * w + nx]).min(image.inside[ny * w + nx]);
                }
            }
            alpha[y * w + x] = if least >= 0.99 { 1.0 } else { 0.0 };
        }
    }
    (image.rgb.clone(), alpha)
}

/// Mean squared errors on [0, 255] of `image` ([1, 3, H, W], canonical exposure) against a view's photograph, both as
/// 8-bit files would hold them: over the full frame and over the object.
pub(crate) fn errors_255(image: &Tensor, view: &Scored) -> (f64, f64) {
    let image = view.photographed(image) * &view.counted;
    let difference = color::quantised(&image) - color::quantised(&view.truth);
    let squared = (difference * 255.0).square();
    let object = view.object_mask.sum(Kind::Float).clamp_min(1.0) * 3.0;
    let on_object = (&squared * &view.object_mask).sum(Kind::Float) / object;
    (
        squared.mean(Kind::Float).double_value(&[]),
        on_object.double_value(&[]),
    )
}

#[cfg(test)]
mod tests {
    use ign_capture::{ImportOptions, import};

    use super::*;

    /// What masks of ignored pixels leave out.
    fn is_ignored(x: u32) -> bool {
        x < 24
    }

    #[test]
    fn ignored_pixels_are_neither_learnt_nor_shown_nor_scored() {
        let folder = tempfile::tempdir().expect("a scratch folder");
        let dir = folder.path().join("capture");
        let options = ign_demo::DemoOptions {
            size: 48,
            views: 12,
            seed: 3,
            ..ign_demo::DemoOptions::default()
        };
        ign_demo::generate(&dir, &options, &|_, _| {}).expect("a demo capture");
        let load = || import(&dir, &ImportOptions::default()).expect("a sound capture");
        let recipe = Recipe {
            size: 48,
            crop: Crop::None,
            ..Recipe::default()
        };
        let settings = recipe.resolve(10).expect("settings");
        let parts = |scene: &Scene| {
            let data = Dataset::new(
                scene,
                &ign_capture::Gains::none(scene.views.len()),
                &recipe,
                &settings,
                Device::Cpu,
                folder.path(),
            )
            .expect("a dataset");
            let view = data.train[0];
            let straight = data.straight(view, 1).expect("a view");
            (data.scored(view, &data.settings).expect("a view"), straight)
        };
        let masks = dir.join("masks");
        std::fs::remove_dir_all(&masks).expect("masks of the demo");
        let (whole, whole_straight) = parts(&load());

        std::fs::create_dir(&masks).expect("a folder");
        for view in load().views {
            let mask = image::GrayImage::from_fn(48, 48, |x, _| {
                image::Luma([if is_ignored(x) { 255 } else { 0 }])
            });
            let name = std::path::Path::new(&view.name).with_extension("png");
            mask.save(masks.join(name)).expect("a mask");
        }
        std::fs::write(dir.join("capture.toml"), "masks = \"white_is_ignored\"\n").expect("a file");
        let (part, part_straight) = parts(&load());

        let flat = |tensor: &Tensor| ign_nets::params::flat_values(tensor);
        let (truth, counted) = (flat(&part.truth), flat(&part.counted));
        let whole_truth = flat(&whole.truth);
        let mut on_object = 0;
        for at in 0..48 * 48 {
            let x = (at % 48) as u32;
            if is_ignored(x) {
                on_object += usize::from(whole.object[at]);
                let zero = 0.0_f32.to_bits();
                assert_eq!((counted[at].to_bits(), part.object[at]), (zero, false));
                assert_eq!(part_straight.alpha[at].to_bits(), zero);
                for channel in 0..3 {
                    assert_eq!(truth[channel * 48 * 48 + at].to_bits(), zero);
                }
            } else if x > 24 {
                assert_eq!(part.object[at], whole.object[at]);
                assert_eq!(
                    part_straight.alpha[at].to_bits(),
                    whole_straight.alpha[at].to_bits()
                );
                for channel in 0..3 {
                    let at = channel * 48 * 48 + at;
                    assert!((truth[at] - whole_truth[at]).abs() < 1e-6);
                }
            }
        }
        assert!(
            on_object > 50,
            "the object hardly reaches there: {on_object}"
        );
    }
}
