//! The reference views: `references/NNNN.png` and `references/views.json`.
//!
//! A PNG holds straight (not premultiplied) sRGB colour and, as alpha, the share of the pixel that the object
//! covers; where alpha is 0 the colour is black. Cameras are in the normalised frame, f64, and come back bit for bit.
//! Depth is not stored: it is rasterised from the proxy.

use std::io::Cursor;

use glam::{DAffine3, DMat3, DVec3};
use ign_geometry::{Camera, CameraIntrinsics};
use image::{ExtendedColorType, ImageEncoder, ImageFormat, ImageReader, codecs::png::PngEncoder};
use serde::{Deserialize, Serialize};

use crate::BundleError;

/// Most pixels of an image that is decoded; a hostile header must not take the machine's memory.
pub const MAX_PIXELS: u64 = 1 << 26;

/// One reference view.
#[derive(Clone, Debug, PartialEq)]
pub struct Reference {
    /// The photograph's name.
    pub name: String,
    /// In the normalised frame; its intrinsics have the image's size.
    pub camera: Camera,
    /// Pixels.
    pub width: u32,
    /// Pixels.
    pub height: u32,
    /// `[height, width, 4]`, straight sRGB colour and coverage, 8 bit.
    pub rgba: Vec<u8>,
    /// Per channel, in linear light: what the photograph was multiplied by to come to the bundle's canonical exposure,
    /// in which the image is stored. A view in this exposure divided by it looks as photographed.
    pub exposure_gain: [f32; 3],
    /// Part of the undistorted photograph that the image shows.
    pub crop: Option<Crop>,
}

/// A rectangle of the undistorted photograph, in its pixels.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Crop {
    /// Left edge.
    pub x: f64,
    /// Top edge.
    pub y: f64,
    /// Extent to the right.
    pub width: f64,
    /// Extent downwards.
    pub height: f64,
}

/// `references/views.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Views {
    /// In the order of the reference indices.
    pub views: Vec<ViewRecord>,
}

/// One entry of [`Views`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ViewRecord {
    /// The photograph's name.
    pub name: String,
    /// Relative to the bundle.
    pub file: String,
    /// Of the stored image.
    pub intrinsics: CameraIntrinsics,
    /// 3 by 4, row-major; normalised frame, x right, y down, z forward.
    pub camera_from_world: [f64; 12],
    /// Width and height in pixels.
    pub size: [u32; 2],
    /// Part of the undistorted photograph that the image shows.
    #[serde(default)]
    pub crop: Option<Crop>,
    /// See [`Reference::exposure_gain`].
    pub exposure_gain: [f32; 3],
}

/// `held_out/views.json`: the cameras of the scored images, so that anyone can render and score them again.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct HeldOutViews {
    /// In the order of `metrics.json`.
    pub views: Vec<HeldOutRecord>,
}

/// One entry of [`HeldOutViews`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct HeldOutRecord {
    /// The photograph's name.
    pub name: String,
    /// Of the scored image.
    pub intrinsics: CameraIntrinsics,
    /// 3 by 4, row-major; normalised frame, x right, y down, z forward.
    pub camera_from_world: [f64; 12],
    /// See [`HeldOutView::exposure_gain`]. 1 in bundles that were written before there were gains.
    #[serde(default = "no_gain")]
    pub exposure_gain: [f32; 3],
}

/// A held-out view: where its photograph was taken, and in which exposure.
#[derive(Clone, Debug, PartialEq)]
pub struct HeldOutView {
    /// The photograph's name.
    pub name: String,
    /// Of the scored image, normalised frame.
    pub camera: Camera,
    /// Per channel, in linear light: takes the photograph to the bundle's canonical exposure. Renderings were divided by
    /// it before they were scored.
    pub exposure_gain: [f32; 3],
}

fn no_gain() -> [f32; 3] {
    [1.0; 3]
}

fn is_gain(gain: &[f32; 3]) -> bool {
    gain.iter().all(|g| g.is_finite() && *g > 0.0)
}

impl HeldOutViews {
    pub(crate) fn new(views: &[HeldOutView]) -> Self {
        let record = |view: &HeldOutView| HeldOutRecord {
            name: view.name.clone(),
            intrinsics: view.camera.intrinsics,
            camera_from_world: to_rows(&view.camera.camera_from_world),
            exposure_gain: view.exposure_gain,
        };
        Self {
            views: views.iter().map(record).collect(),
        }
    }

    fn checked(self) -> Result<Vec<HeldOutView>, BundleError> {
        let view = |record: HeldOutRecord| {
            let bad = |reason: String| {
                BundleError::malformed(
                    crate::HELD_OUT_VIEWS_FILE,
                    format!("view {:?}: {reason}", record.name),
                )
            };
            if !is_gain(&record.exposure_gain) {
                return Err(bad("exposure gain is not positive".to_owned()));
            }
            let camera = Camera::new(record.intrinsics, from_rows(&record.camera_from_world))
                .map_err(|source| bad(source.to_string()))?;
            Ok(HeldOutView {
                name: record.name,
                camera,
                exposure_gain: record.exposure_gain,
            })
        };
        self.views.into_iter().map(view).collect()
    }
}

/// Reads `held_out/views.json`.
///
/// # Errors
/// It is no such list, or a camera or an exposure in it is none.
pub fn decode_held_out(json: &[u8]) -> Result<Vec<HeldOutView>, BundleError> {
    serde_json::from_slice::<HeldOutViews>(json)
        .map_err(BundleError::json(crate::HELD_OUT_VIEWS_FILE))?
        .checked()
}

/// Where reference number `index` lies in a bundle.
pub fn image_file(index: usize) -> String {
    format!("references/{index:04}.png")
}

/// The files of `references`: `views.json` first, then the images, as (path, bytes).
pub fn encode(references: &[Reference]) -> Result<Vec<(String, Vec<u8>)>, BundleError> {
    let mut records = Vec::with_capacity(references.len());
    let mut images = Vec::with_capacity(references.len());
    for (index, reference) in references.iter().enumerate() {
        let file = image_file(index);
        let k = &reference.camera.intrinsics;
        if (k.width, k.height) != (reference.width, reference.height)
            || reference.rgba.len() as u64
                != 4 * u64::from(reference.width) * u64::from(reference.height)
        {
            return Err(BundleError::malformed(
                file,
                format!(
                    "view {:?}: camera, size and pixels do not agree",
                    reference.name
                ),
            ));
        }
        let mut png = Vec::new();
        PngEncoder::new(&mut png)
            .write_image(
                &reference.rgba,
                reference.width,
                reference.height,
                ExtendedColorType::Rgba8,
            )
            .map_err(|source| BundleError::Image {
                file: file.clone(),
                source,
            })?;
        records.push(ViewRecord {
            name: reference.name.clone(),
            file: file.clone(),
            intrinsics: *k,
            camera_from_world: to_rows(&reference.camera.camera_from_world),
            size: [reference.width, reference.height],
            crop: reference.crop,
            exposure_gain: reference.exposure_gain,
        });
        images.push((file, png));
    }
    let json = serde_json::to_vec_pretty(&Views { views: records })
        .map_err(BundleError::json(crate::VIEWS_FILE))?;
    Ok(std::iter::once((crate::VIEWS_FILE.to_owned(), json))
        .chain(images)
        .collect())
}

/// Reads `views.json`'s bytes, then each image through `read` (path to bytes).
pub fn decode(
    json: &[u8],
    mut read: impl FnMut(&str) -> Result<Vec<u8>, BundleError>,
) -> Result<Vec<Reference>, BundleError> {
    let views: Views =
        serde_json::from_slice(json).map_err(BundleError::json(crate::VIEWS_FILE))?;
    views
        .views
        .into_iter()
        .map(|record| {
            let view = record.name.clone();
            let bad = move |reason: String| {
                BundleError::malformed(crate::VIEWS_FILE, format!("view {view:?}: {reason}"))
            };
            if record.size != [record.intrinsics.width, record.intrinsics.height] {
                return Err(bad("size and intrinsics do not agree".to_owned()));
            }
            if !is_gain(&record.exposure_gain) {
                return Err(bad("exposure gain is not positive".to_owned()));
            }
            let camera = Camera::new(record.intrinsics, from_rows(&record.camera_from_world))
                .map_err(|source| bad(source.to_string()))?;
            let bytes = read(&record.file)?;
            // By its header: an image of another size is refused before memory is taken for it.
            let (width, height) = check_size(&record.file, &bytes)?;
            if [width, height] != record.size {
                let [said_width, said_height] = record.size;
                return Err(BundleError::malformed(
                    record.file,
                    format!("{width}x{height} pixels, views.json says {said_width}x{said_height}"),
                ));
            }
            let image = image::load_from_memory_with_format(&bytes, ImageFormat::Png)
                .map_err(|source| BundleError::Image {
                    file: record.file.clone(),
                    source,
                })?
                .into_rgba8();
            Ok(Reference {
                name: record.name,
                camera,
                width: image.width(),
                height: image.height(),
                rgba: image.into_raw(),
                exposure_gain: record.exposure_gain,
                crop: record.crop,
            })
        })
        .collect()
}

/// Refuses images of more than [`MAX_PIXELS`] pixels by their header alone. Any format that this crate decodes.
pub fn check_size(file: &str, bytes: &[u8]) -> Result<(u32, u32), BundleError> {
    let image = |source| BundleError::Image {
        file: file.to_owned(),
        source,
    };
    let reader = ImageReader::new(Cursor::new(bytes))
        .with_guessed_format()
        .map_err(BundleError::io(file))?;
    let (width, height) = reader.into_dimensions().map_err(image)?;
    if u64::from(width) * u64::from(height) > MAX_PIXELS {
        return Err(BundleError::ImageTooLarge {
            file: file.to_owned(),
            width,
            height,
            limit: MAX_PIXELS,
        });
    }
    Ok((width, height))
}

fn to_rows(a: &DAffine3) -> [f64; 12] {
    let (m, t) = (a.matrix3, a.translation);
    [
        m.x_axis.x, m.y_axis.x, m.z_axis.x, t.x, m.x_axis.y, m.y_axis.y, m.z_axis.y, t.y,
        m.x_axis.z, m.y_axis.z, m.z_axis.z, t.z,
    ]
}

fn from_rows(r: &[f64; 12]) -> DAffine3 {
    DAffine3 {
        matrix3: DMat3::from_cols(
            DVec3::new(r[0], r[4], r[8]),
            DVec3::new(r[1], r[5], r[9]),
            DVec3::new(r[2], r[6], r[10]),
        ),
        translation: DVec3::new(r[3], r[7], r[11]),
    }
}
