//! One photograph, resampled once: undistortion, crop and scale together.
//!
//! # The filter
//! A pixel of the wanted camera is mapped into the photograph by the camera models (to 0.005 pixels, see
//! [`crate::pixel_map`]). Its footprint there is taken as an axis-aligned box with the same centre and, along each
//! axis, the same variance as the true footprint: the width in x is `hypot(dx/di, dx/dj)`, with the derivatives of the
//! map. The colour is the exact area mean over that box of the photograph's pixels, each a constant square, on sRGB
//! values at the photograph's own precision. So
//! - scaling by a whole factor without distortion is the exact mean of the covered pixels,
//! - every other scaling down is the exact area-weighted mean, at any crop offset,
//! - a lens distortion, whose map hardly shears within one pixel, is filtered by its local footprint in one pass,
//! - where the photograph is enlarged the box is kept one pixel wide, which is bilinear interpolation.
//!
//! A JPEG photograph that is scaled down is not decoded to pixels but to their means over cells of 2x2, 4x4 or 8x8
//! pixels, where every footprint is at least 4, 6 or 12 pixels wide; the box then takes its means over cells, each a
//! constant square. The README states what that costs in accuracy.
//!
//! Masks go through the same filter. What lies outside the photograph, or is to be ignored, has no part in a mean;
//! `inside` says how much of the pixel's own footprint (not widened) is left.

use ign_geometry::Camera;
use rayon::prelude::*;

use crate::fault::ImportError;
use crate::photo::{self, Photo, PhotoError, Samples};
use crate::pixel_map::{Footprint, Footprints, PixelMap};
use crate::scene::{Mask, MaskFile, Scene, View};

/// A view's photograph in the pixels of some camera. All buffers are row-major.
#[derive(Debug, Clone, PartialEq)]
pub struct ViewImage {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// `[height * width * 3]`, sRGB in [0, 1]; zero where `inside` is zero.
    pub rgb: Vec<f32>,
    /// `[height * width]`, 1 = object, where the view has a mask; zero where `inside` is zero.
    pub mask: Option<Vec<f32>>,
    /// `[height * width]`, fraction of the pixel that the photograph tells something about: that lies inside it and
    /// is not to be ignored.
    pub inside: Vec<f32>,
}

impl Scene {
    /// Decodes the photograph (and masks) of a view and resamples it into the pixels of `camera`, which must share the
    /// view's pose, as those of [`Scene::frame_camera`] do: only its intrinsics are looked at.
    ///
    /// Takes the memory of one decoded photograph and its masks. Rows are resampled in parallel; views may be loaded
    /// from several threads at once.
    ///
    /// # Errors
    /// When a file cannot be decoded or has changed its size, or the camera or the index is not usable.
    pub fn load_view(&self, view: usize, camera: &Camera) -> Result<ViewImage, ImportError> {
        let view = self.views.get(view).ok_or(ImportError::NoSuchView {
            index: view,
            views: self.views.len(),
        })?;
        load(view, camera).map(|loaded| loaded.image)
    }
}

/// A view as loaded.
pub(crate) struct Loaded {
    pub(crate) image: ViewImage,
    /// Share of the photograph's colours that lie outside sRGB and were clipped.
    pub(crate) clipped: f64,
    /// The photograph has an alpha channel that hides something.
    pub(crate) alpha_hides: bool,
}

pub(crate) fn load(view: &View, camera: &Camera) -> Result<Loaded, ImportError> {
    camera
        .intrinsics
        .validate()
        .map_err(|source| ImportError::Camera {
            view: view.name.clone(),
            source,
        })?;
    let map = PixelMap {
        target: camera.intrinsics,
        source: view.source,
        source_from_target: view.source_from_camera,
    };
    let footprints = map.footprints();
    let photograph = |error| image_error(view, &view.image_path, error);

    // Rolling and ignoring go by single pixels.
    let by_pixel = view.rolled_columns > 0 || view.ignored.is_some();
    let wanted = (!by_pixel).then(|| footprints.wanted());
    let mut photo =
        photo::decode(&view.image_path, footprints.source, wanted).map_err(photograph)?;
    photo.roll(view.rolled_columns);
    let is_cut_out = view.mask == Some(Mask::Alpha);
    if is_cut_out {
        photo.over_black();
    }
    let kept = match &view.ignored {
        Some(file) => Some(mask_file(view, file, true)?),
        None => None,
    };
    let kept = kept.as_ref();
    let alpha_hides = !photo.is_opaque();
    let (rgb, inside) = resample::<3>(&photo, &photo.rgb, kept, &footprints);
    let mask = match &view.mask {
        Some(Mask::Alpha) => match &photo.alpha {
            Some(alpha) => Some(resample::<1>(&photo, alpha, kept, &footprints).0),
            None => {
                return Err(photograph(PhotoError::Damaged(
                    "its alpha channel is gone".into(),
                )));
            }
        },
        Some(Mask::File(file)) => {
            let values = Samples::Eight(mask_file(view, file, false)?);
            let grid = Photo::grid_of_pixels(footprints.source);
            Some(resample::<1>(&grid, &values, kept, &footprints).0)
        }
        None => None,
    };
    Ok(Loaded {
        image: ViewImage {
            width: camera.intrinsics.width,
            height: camera.intrinsics.height,
            rgb,
            mask,
            inside,
        },
        clipped: photo.clipped,
        alpha_hides,
    })
}

fn image_error(view: &View, path: &std::path::Path, source: PhotoError) -> ImportError {
    ImportError::Image {
        view: view.name.clone(),
        path: path.to_owned(),
        source,
    }
}

/// A mask's values, turned as the file's meaning says and once more on request; ignored pixels are 0 or 255.
fn mask_file(view: &View, file: &MaskFile, keep: bool) -> Result<Vec<u8>, ImportError> {
    let size = (view.source.width, view.source.height);
    let mut values = photo::decode_mask(&file.path, size)
        .map_err(|error| image_error(view, &file.path, error))?;
    if file.inverted {
        for value in &mut values {
            *value = 255 - *value;
        }
    }
    if keep {
        for value in &mut values {
            *value = if *value >= 128 { 0 } else { 255 };
        }
    }
    photo::roll_rows(&mut values, size.0 as usize, view.rolled_columns);
    Ok(values)
}

/// Resamples `samples` of `C` channels, which lie as `grid` says; returns values in [0, 1] and the share inside. Of
/// `kept`, in pixels of the photograph, only what is 255 counts.
fn resample<const C: usize>(
    grid: &Photo,
    samples: &Samples,
    kept: Option<&Vec<u8>>,
    footprints: &Footprints,
) -> (Vec<f32>, Vec<f32>) {
    match samples {
        Samples::Eight(data) => resample_as::<u8, C>(grid, data, 255.0, kept, footprints),
        Samples::Sixteen(data) => resample_as::<u16, C>(grid, data, 65535.0, kept, footprints),
    }
}

fn resample_as<T: Copy + Into<u32> + Default + Sync, const C: usize>(
    grid: &Photo,
    data: &[T],
    white: f64,
    kept: Option<&Vec<u8>>,
    footprints: &Footprints,
) -> (Vec<f32>, Vec<f32>) {
    let width = footprints.width;
    let layout = Layout::new(grid, footprints.source);
    let counted: Option<Vec<T>> = kept.map(|kept| {
        let values = data.chunks_exact(C).zip(kept);
        values
            .flat_map(|(pixel, &kept)| {
                let pixel: [T; C] = std::array::from_fn(|channel| pixel[channel]);
                if kept > 0 { pixel } else { [T::default(); C] }
            })
            .collect()
    });
    let data = counted.as_deref().unwrap_or(data);
    let mut values = vec![0.0; footprints.boxes.len() * C];
    let mut inside = vec![0.0; footprints.boxes.len()];
    let rows = values
        .par_chunks_mut(width * C)
        .zip(inside.par_chunks_mut(width))
        .zip(footprints.boxes.par_chunks(width));
    rows.for_each(|((values, inside), boxes)| {
        for ((value, share), footprint) in values.chunks_exact_mut(C).zip(inside).zip(boxes) {
            let Some(footprint) = footprint else {
                continue;
            };
            *share = share_inside(footprint, footprints.source);
            if *share <= 0.0 {
                continue;
            }
            let area = layout.area(footprint);
            let mean: [f64; C] = area.mean(data, layout.stride);
            let mut scale = 1.0 / white;
            if let Some(kept) = kept {
                let [counted] = area.mean::<u8, 1>(kept, layout.stride);
                let counted = counted / 255.0;
                *share *= counted as f32;
                if counted <= 0.0 {
                    continue;
                }
                scale /= counted;
            }
            for (value, mean) in value.iter_mut().zip(mean) {
                *value = (mean * scale) as f32;
            }
        }
    });
    (values, inside)
}

/// The part of `center +- width / 2` that lies in `[low, high]`, as its two ends.
fn clip(center: f64, width: f64, low: f64, high: f64) -> (f64, f64) {
    (
        (center - width / 2.0).max(low),
        (center + width / 2.0).min(high),
    )
}

/// Share of the footprint that lies inside a photograph of this size.
fn share_inside(footprint: &Footprint, size: (u32, u32)) -> f32 {
    let (center, width) = (footprint.center, footprint.width);
    let (x0, x1) = clip(center.x, width.x, 0.0, f64::from(size.0));
    let (y0, y1) = clip(center.y, width.y, 0.0, f64::from(size.1));
    let area = width.x * width.y;
    if x1 <= x0 || y1 <= y0 || area <= 0.0 {
        0.0
    } else {
        ((x1 - x0) * (y1 - y0) / area).min(1.0) as f32
    }
}

/// Where the samples lie: pixels of the photograph to cells.
struct Layout {
    scale: f64,
    origin: (f64, f64),
    /// Ends of the samples that lie inside the photograph, in cells.
    end: (f64, f64),
    stride: usize,
}

impl Layout {
    fn new(grid: &Photo, source: (u32, u32)) -> Self {
        let cell = grid.cell as f64;
        let origin = (grid.origin.0 as f64, grid.origin.1 as f64);
        let end = |samples: usize, source: u32, origin: f64| {
            (samples as f64).min((f64::from(source) - origin) / cell)
        };
        Self {
            scale: 1.0 / cell,
            origin,
            end: (
                end(grid.size.0, source.0, origin.0),
                end(grid.size.1, source.1, origin.1),
            ),
            stride: grid.size.0,
        }
    }

    /// The footprint, at least one cell wide, in cells, without what lies outside the photograph.
    fn area(&self, footprint: &Footprint) -> Area {
        let width = footprint.width * self.scale;
        Area {
            x: clip(
                (footprint.center.x - self.origin.0) * self.scale,
                width.x.max(1.0),
                0.0,
                self.end.0,
            ),
            y: clip(
                (footprint.center.y - self.origin.1) * self.scale,
                width.y.max(1.0),
                0.0,
                self.end.1,
            ),
        }
    }
}

/// A box in cells, as the ends of its sides.
struct Area {
    x: (f64, f64),
    y: (f64, f64),
}

impl Area {
    /// The mean of `data`, rows of `stride` times `C` values, over this area.
    fn mean<T: Copy + Into<u32>, const C: usize>(&self, data: &[T], stride: usize) -> [f64; C] {
        let columns = Span::new(self.x);
        let rows = Span::new(self.y);
        let mut sum = [0.0_f64; C];
        for row in rows.first..rows.end {
            let at = row * stride;
            let cells = &data[(at + columns.first) * C..(at + columns.end) * C];
            let weight = rows.weight(row);
            // Whole cells are summed as integers.
            let (first_and_whole, last) = cells.split_at(cells.len() - C);
            let mut whole = [0_u32; C];
            for cell in first_and_whole.chunks_exact(C).skip(1) {
                for (sum, &value) in whole.iter_mut().zip(cell) {
                    *sum += value.into();
                }
            }
            for channel in 0..C {
                let mut line = f64::from(whole[channel]);
                line += columns.weight(columns.end - 1) * f64::from(last[channel].into());
                if let Some(&first) = first_and_whole.get(channel) {
                    line += columns.weight(columns.first) * f64::from(first.into());
                }
                sum[channel] += weight * line;
            }
        }
        let area = (self.x.1 - self.x.0) * (self.y.1 - self.y.0);
        sum.map(|sum| sum / area)
    }
}

/// The cells that an interval touches.
struct Span {
    first: usize,
    end: usize,
    interval: (f64, f64),
}

impl Span {
    fn new(interval: (f64, f64)) -> Self {
        let first = interval.0.floor() as usize;
        Self {
            first,
            end: (interval.1.ceil() as usize).max(first + 1),
            interval,
        }
    }

    /// How much of a cell lies in the interval.
    fn weight(&self, cell: usize) -> f64 {
        let cell = cell as f64;
        (cell + 1.0).min(self.interval.1) - cell.max(self.interval.0)
    }
}
