//! Photographs and masks: whether each is there, whole and of its camera's size, and what surrounds the object in them.
//!
//! Headers, structure and colour profiles of all files are looked at here, and a handful is decoded to tell what the
//! background is; decoding all of them is [`crate::Scene::load_view`]'s work.

use std::collections::{BTreeMap, BTreeSet};
use std::io;
use std::path::Path;

use glam::DMat3;
use ign_geometry::{Camera, CameraIntrinsics};
use rayon::prelude::*;

use crate::distortion::SourceCamera;
use crate::fault::{Faults, ImportError, error_chain};
use crate::photo::{self, ColorDoubt, Header, PhotoError};
use crate::reconstruction::{Model, ModelImage};
use crate::resample;
use crate::scene::{Background, Mask, MaskFile, View};
use crate::settings::{self, MaskMeaning};
use crate::sight::SeeingView;
use crate::split;

/// Views that are decoded to tell what the background is, and their longer side when looked at, in pixels.
const SAMPLES: usize = 8;
const SAMPLE_PX: u32 = 256;

/// Photographs count as black outside their masks below this mean, of 255.
const BLACK_BELOW: f64 = 2.0;

/// Share of colours outside sRGB that is worth a warning.
const NOTABLE_CLIPPING: f64 = 0.001;

/// The model's images by name, in path order, without those whose entry is faulty by itself.
pub(crate) fn check_names<'a>(model: &'a Model, faults: &mut Faults) -> Vec<&'a ModelImage> {
    let mut images: Vec<&ModelImage> = model.images.iter().collect();
    images.sort_by(|a, b| split::natural_order(&a.name, &b.name));
    let mut kept: Vec<&ModelImage> = Vec::with_capacity(images.len());
    for image in images {
        if kept.last().is_some_and(|last| last.name == image.name) {
            faults.error(
                format!("image {} is in the model twice", image.name),
                image.at.as_str(),
                "each photograph can have one pose only: re-export the model",
            );
        } else if !settings::is_inside(Path::new(&image.name)) {
            faults.error(
                format!(
                    "image {:?} has a name that points outside images/",
                    image.name
                ),
                image.at.as_str(),
                "names are paths below images/",
            );
        } else {
            kept.push(image);
        }
    }
    kept
}

/// A view, with the id it has in the model.
pub(crate) type Candidate = (View, u32);

/// The views whose camera, photograph and masks are in order. `meaning` is what `capture.toml` says of masks.
pub(crate) fn check_photographs(
    dir: &Path,
    model: &Model,
    registered: &[&ModelImage],
    meaning: Option<MaskMeaning>,
    faults: &mut Faults,
) -> Vec<Candidate> {
    let images_exist = dir.join("images").is_dir();
    if !images_exist {
        faults.error(
            "the folder images/ is missing",
            "images/",
            "put the photographs there, named as in the model",
        );
    }
    let masks = dir.join("masks");
    let mask_folder = masks.is_dir();
    let folder_has_masks =
        mask_folder && std::fs::read_dir(&masks).is_ok_and(|mut entries| entries.next().is_some());
    // Some reconstructions name masks themselves.
    let has_masks = folder_has_masks || registered.iter().any(|image| image.mask_path.is_some());
    if mask_folder && !has_masks {
        faults.warning(
            "the folder masks/ is empty",
            "masks/",
            "remove it, or put one mask per photograph there",
        );
    }
    let check = Check {
        dir,
        model,
        images_exist,
        has_masks,
        meaning,
    };
    let checked: Vec<(Option<Checked>, Faults)> = registered
        .par_iter()
        .map(|image| {
            let mut faults = Faults::default();
            let checked = check.view(image, &mut faults);
            (checked, faults)
        })
        .collect();
    let mut views = Vec::with_capacity(checked.len());
    for (checked, found) in checked {
        views.extend(checked);
        faults.extend(found.into_list());
    }
    report_doubtful_colors(&views, faults);
    report_partial_masks(&views, has_masks, faults);
    views.into_iter().map(|checked| checked.candidate).collect()
}

fn report_doubtful_colors(views: &[Checked], faults: &mut Faults) {
    let mut doubts: BTreeMap<ColorDoubt, Vec<&str>> = BTreeMap::new();
    for checked in views {
        if let Some(doubt) = checked.doubt {
            doubts
                .entry(doubt)
                .or_default()
                .push(&checked.candidate.0.name);
        }
    }
    for (doubt, names) in doubts {
        let message = match doubt {
            ColorDoubt::AdobeByExif => {
                "photographs have no colour profile and are Adobe RGB by their Exif tags; they are converted to sRGB"
            }
            ColorDoubt::Uncalibrated => {
                "photographs have no colour profile and are not sRGB by their Exif tags; they are taken as sRGB"
            }
        };
        faults.warning(
            format!("{} {message}, the first is {}", names.len(), names[0]),
            "images/",
            "export them as sRGB, or with their profile, if the colours look wrong",
        );
    }
}

fn report_partial_masks(views: &[Checked], has_masks: bool, faults: &mut Faults) {
    let count = |is: fn(&View) -> bool| views.iter().filter(|c| is(&c.candidate.0)).count();
    let cut_out = count(|view| view.mask == Some(Mask::Alpha));
    let mut without = views.iter().filter(|c| c.candidate.0.mask.is_none());
    if cut_out > 0
        && let Some(first) = without.next()
    {
        faults.warning(
            format!(
                "{} of {} photographs have no alpha channel, the first is {}; the proxy's silhouette says where the object is in them",
                without.count() + 1,
                views.len(),
                first.candidate.0.name
            ),
            "images/",
            "cut out all photographs, or none",
        );
    }
    let ignoring = count(|view| view.ignored.is_some());
    if has_masks && ignoring > 0 && ignoring < views.len() {
        faults.warning(
            format!(
                "{ignoring} of {} photographs have a mask of what to ignore; nothing is ignored in the others",
                views.len()
            ),
            "masks/",
            "nothing to do, unless the others show something to ignore",
        );
    }
}

pub(crate) fn report_unregistered(images: &Path, registered: &[&ModelImage], faults: &mut Faults) {
    let known: BTreeSet<&str> = registered.iter().map(|image| image.name.as_str()).collect();
    let Ok(entries) = std::fs::read_dir(images) else {
        return;
    };
    let mut extra: Vec<String> = entries
        .filter_map(Result::ok)
        .filter(|entry| entry.file_type().is_ok_and(|kind| kind.is_file()))
        .filter_map(|entry| entry.file_name().into_string().ok())
        .filter(|name| !known.contains(name.as_str()))
        .collect();
    extra.sort();
    if let Some(first) = extra.first() {
        faults.warning(
            format!(
                "{} files in images/ are not in the model and are left out, the first is {first}",
                extra.len()
            ),
            "images/",
            "nothing to do, unless they should have been registered",
        );
    }
}

/// A view in order, with what is doubtful in its photograph.
struct Checked {
    candidate: Candidate,
    doubt: Option<ColorDoubt>,
}

/// What views are checked against.
struct Check<'a> {
    dir: &'a Path,
    model: &'a Model,
    images_exist: bool,
    has_masks: bool,
    meaning: Option<MaskMeaning>,
}

impl Check<'_> {
    fn view(&self, image: &ModelImage, faults: &mut Faults) -> Option<Checked> {
        let source = self
            .model
            .cameras
            .get(&image.camera_id)
            .copied()
            .unwrap_or_else(|| {
                faults.error(
                    format!(
                        "image {} names camera {}, which the model does not have",
                        image.name, image.camera_id
                    ),
                    image.at.as_str(),
                    "cameras and images must come from the same export",
                );
                None
            });
        let size = source.map(|source| (source.width, source.height));
        let image_path = self.dir.join("images").join(&image.name);
        let header = self.images_exist.then(|| {
            let shown = format!("images/{}", image.name);
            check_picture(&image_path, &shown, "photograph", size, image, faults)
        });
        let header = header.flatten();
        let (mut mask, ignored) = self.mask_files(image, size, faults);
        if mask.is_none() && !self.has_masks && header.as_ref().is_some_and(|h| h.has_alpha) {
            mask = Some(Mask::Alpha);
        }
        let source = source?;
        let camera = Camera::new(pinhole(&source), image.camera_from_world).map_err(|error| {
            faults.error(
                format!(
                    "image {} has an unusable camera: {}",
                    image.name,
                    error_chain(&error)
                ),
                image.at.as_str(),
                "re-export the model",
            );
        });
        let view = View {
            name: image.name.clone(),
            camera: camera.ok()?,
            source,
            source_from_camera: DMat3::IDENTITY,
            rolled_columns: 0,
            image_path,
            mask,
            ignored,
        };
        Some(Checked {
            candidate: (view, image.id),
            doubt: header?.doubt,
        })
    }

    /// The object's mask and that of what to ignore, by files.
    fn mask_files(
        &self,
        image: &ModelImage,
        size: Option<(u32, u32)>,
        faults: &mut Faults,
    ) -> (Option<Mask>, Option<MaskFile>) {
        let in_folder = self
            .has_masks
            .then(|| photo::find_mask(&self.dir.join("masks"), &image.name))
            .flatten();
        let by_model = image.mask_path.as_ref().map(|path| self.dir.join(path));
        let unsaid = match (&in_folder, &by_model) {
            (None, Some(_)) => MaskMeaning::BlackIsIgnored,
            _ => MaskMeaning::WhiteIsObject,
        };
        let meaning = self.meaning.unwrap_or(unsaid);
        let inverted = matches!(
            meaning,
            MaskMeaning::WhiteIsBackground | MaskMeaning::BlackIsIgnored
        );
        let is_object = matches!(
            meaning,
            MaskMeaning::WhiteIsObject | MaskMeaning::WhiteIsBackground
        );
        let Some(path) = in_folder.or(by_model) else {
            if self.has_masks && is_object {
                faults.error(
                    format!("image {} has no mask", image.name),
                    format!(
                        "masks/{}",
                        Path::new(&image.name).with_extension("png").display()
                    ),
                    "add it (white = object), or remove masks/ to go by the proxy's silhouette",
                );
            }
            return (None, None);
        };
        let shown = path.strip_prefix(self.dir).unwrap_or(&path);
        let shown = shown.display().to_string();
        if check_picture(&path, &shown, "mask", size, image, faults).is_none() {
            return (None, None);
        }
        let file = MaskFile { path, inverted };
        if is_object {
            (Some(Mask::File(file)), None)
        } else {
            (None, Some(file))
        }
    }
}

/// The undistorted camera of a photograph: same size, focal lengths and principal point.
fn pinhole(source: &SourceCamera) -> CameraIntrinsics {
    CameraIntrinsics {
        fx: source.fx,
        fy: source.fy,
        cx: source.cx,
        cy: source.cy,
        width: source.width,
        height: source.height,
    }
}

/// Checks a photograph or mask without decoding it.
fn check_picture(
    path: &Path,
    shown: &str,
    what: &str,
    size: Option<(u32, u32)>,
    image: &ModelImage,
    faults: &mut Faults,
) -> Option<Header> {
    match photo::inspect(path) {
        Ok(header) => match size {
            Some(size) if header.size != size => {
                let (explanation, hint) = explain_size(&header, size);
                faults.error(
                    format!(
                        "the {what} {shown} is {}x{} pixels, its camera {} says {}x{}{explanation}",
                        header.size.0, header.size.1, image.camera_id, size.0, size.1
                    ),
                    shown,
                    hint,
                );
                None
            }
            _ => Some(header),
        },
        Err(PhotoError::Io(error)) if error.kind() == io::ErrorKind::NotFound => {
            faults.error(
                format!("the {what} {shown} is missing"),
                image.at.as_str(),
                "add it, or remove the image from the model",
            );
            None
        }
        Err(error) => {
            faults.error(
                format!(
                    "{shown} is no image that can be read: {}",
                    error_chain(&error)
                ),
                shown,
                error.hint(),
            );
            None
        }
    }
}

/// What may be behind a size that is not the camera's, and what to do.
fn explain_size(header: &Header, camera: (u32, u32)) -> (String, &'static str) {
    let is_turned = (header.size.1, header.size.0) == camera;
    match header.orientation.filter(|&turn| turn >= 5) {
        Some(turn) if is_turned => (
            format!(
                " (turned by 90 degrees: its orientation tag is {turn}, which the program that made the cameras has applied)"
            ),
            "turn the files as their tags say, without loss (jpegtran or exiftran -a), so that pixels and cameras agree",
        ),
        _ if is_turned => (
            " (turned by 90 degrees?)".into(),
            "use the pictures that the cameras were computed from, not turned since",
        ),
        _ => (
            String::new(),
            "use the pictures that the cameras were computed from, at their full size",
        ),
    }
}

/// Decodes a few views: says what surrounds the object, drops alpha channels that hide nothing, and reports files that
/// cannot be decoded and colours that sRGB does not have.
pub(crate) fn look_at_some(views: &mut [SeeingView], faults: &mut Faults) -> Background {
    let count = views.len().min(SAMPLES);
    let looked: Vec<Result<Look, ImportError>> = (0..count)
        .into_par_iter()
        .map(|sample| look_at(&views[sample * views.len() / count].0))
        .collect();
    let mut looks = Vec::with_capacity(count);
    for look in looked {
        match look {
            Ok(look) => looks.push(look),
            Err(error) => {
                let (at, hint) = match &error {
                    ImportError::Image { view, source, .. } => {
                        (format!("view {view}"), source.hint())
                    }
                    _ => ("images/".into(), "re-export the model"),
                };
                faults.error(error_chain(&error), at, hint);
            }
        }
    }
    let clipped: f64 = looks.iter().map(|look| look.clipped).sum::<f64>() / looks.len() as f64;
    if clipped > NOTABLE_CLIPPING {
        faults.warning(
            format!(
                "{:.1} % of the photographs' colours lie outside sRGB and are clipped",
                clipped * 100.0
            ),
            "images/",
            "nothing to do: models hold sRGB colours; very saturated ones lose some of their differences",
        );
    }
    let is_cut_out = |view: &View| view.mask == Some(Mask::Alpha);
    if !looks.is_empty()
        && !looks.iter().any(|look| look.alpha_hides)
        && views.iter().any(|(view, _, _)| is_cut_out(view))
    {
        faults.warning(
            "the alpha channels of the photographs hide nothing; the proxy's silhouette says where the object is",
            "images/",
            "nothing to do, unless the photographs should be cut out",
        );
        for (view, _, _) in &mut *views {
            view.mask.take_if(|mask| *mask == Mask::Alpha);
        }
    }
    if !views.iter().any(|(view, _, _)| view.mask.is_some()) {
        return Background::Silhouette;
    }
    let mut means = looks.iter().filter_map(|look| look.mean_outside).peekable();
    if means.peek().is_some() && means.all(|mean| mean < BLACK_BELOW) {
        Background::Black
    } else {
        Background::MaskedOut
    }
}

/// What a decoded view tells.
struct Look {
    /// Mean of the photograph, of 255, where the mask is zero; `None` where it nowhere is.
    mean_outside: Option<f64>,
    clipped: f64,
    alpha_hides: bool,
}

fn look_at(view: &View) -> Result<Look, ImportError> {
    let whole = view.camera.intrinsics;
    let scale = (f64::from(SAMPLE_PX) / f64::from(whole.width.max(whole.height))).min(1.0);
    let scaled = |side: u32| ((f64::from(side) * scale).round() as u32).max(1);
    let camera = Camera {
        intrinsics: whole.resized(scaled(whole.width), scaled(whole.height)),
        camera_from_world: view.camera.camera_from_world,
    };
    let loaded = resample::load(view, &camera)?;
    let image = &loaded.image;
    let (mut sum, mut count) = (0.0_f64, 0_usize);
    if let Some(mask) = &image.mask {
        let pixels = mask
            .iter()
            .zip(&image.inside)
            .zip(image.rgb.chunks_exact(3));
        for (_, color) in pixels.filter(|((mask, inside), _)| **mask <= 0.0 && **inside > 0.0) {
            sum += color.iter().map(|&value| f64::from(value)).sum::<f64>();
            count += 3;
        }
    }
    Ok(Look {
        mean_outside: (count > 0).then(|| 255.0 * sum / count as f64),
        clipped: loaded.clipped,
        alpha_hides: loaded.alpha_hides,
    })
}
