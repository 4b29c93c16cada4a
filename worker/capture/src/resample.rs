//! One photograph, resampled once: undistortion, crop and scale together.
//!
//! # The filter
//! A pixel of the wanted camera is mapped into the photograph by the exact camera models. Its footprint there is taken
//! as an axis-aligned box with the same centre and, along each axis, the same variance as the true footprint: the
//! width in x is `hypot(dx/di, dx/dj)`, with the derivatives of the map by central differences. The colour is the
//! exact area mean over that box of the photograph's pixels, each a constant square, on sRGB values. So
//! - scaling by a whole factor without distortion is the exact mean of the covered pixels,
//! - every other scaling down is the exact area-weighted mean, at any crop offset,
//! - a lens distortion, whose map hardly shears within one pixel, is filtered by its local footprint in one pass,
//! - where the photograph is enlarged the box is kept one pixel wide, which is bilinear interpolation.
//!
//! Masks go through the same filter. What lies outside the photograph has no part in a mean; `inside` says how much
//! of the pixel's own footprint (not widened) lies within it.

use std::path::Path;

use glam::{DMat3, DVec2};
use ign_geometry::{Camera, CameraIntrinsics};
use rayon::prelude::*;

use crate::distortion::SourceCamera;
use crate::fault::ImportError;
use crate::photo;
use crate::scene::{Scene, View};

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
    /// `[height * width]`, fraction of the pixel that lies inside the photograph.
    pub inside: Vec<f32>,
}

impl Scene {
    /// Decodes the photograph (and mask) of a view and resamples it into the pixels of `camera`, which must share the
    /// view's pose, as those of [`Scene::frame_camera`] do: only its intrinsics are looked at.
    ///
    /// Takes the memory of one decoded photograph and mask. Rows are resampled in parallel; views may be loaded from
    /// several threads at once.
    ///
    /// # Errors
    /// When a file cannot be decoded or has changed its size, or the camera or the index is not usable.
    pub fn load_view(&self, view: usize, camera: &Camera) -> Result<ViewImage, ImportError> {
        let view = self.views.get(view).ok_or(ImportError::NoSuchView {
            index: view,
            views: self.views.len(),
        })?;
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
        let mut photograph = decode(view, &view.image_path)?.into_rgb8().into_raw();
        roll::<3>(&mut photograph, view);
        let (rgb, inside) = resample::<3>(&photograph, &map);
        drop(photograph);
        let mask = match &view.mask_path {
            Some(path) => {
                let mut mask = decode(view, path)?.into_luma8().into_raw();
                if self.mask_is_background {
                    for value in &mut mask {
                        *value = 255 - *value;
                    }
                }
                roll::<1>(&mut mask, view);
                Some(resample::<1>(&mask, &map).0)
            }
            None => None,
        };
        Ok(ViewImage {
            width: camera.intrinsics.width,
            height: camera.intrinsics.height,
            rgb,
            mask,
            inside,
        })
    }
}

/// Rolls rows of `C` interleaved channels as the view says.
fn roll<const C: usize>(data: &mut [u8], view: &View) {
    if view.rolled_columns > 0 {
        for row in data.chunks_exact_mut(view.source.width as usize * C) {
            row.rotate_left(view.rolled_columns * C);
        }
    }
}

fn decode(view: &View, path: &Path) -> Result<image::DynamicImage, ImportError> {
    let (width, height) = (view.source.width, view.source.height);
    let image = photo::decode(path, (width, height)).map_err(|source| ImportError::Image {
        view: view.name.clone(),
        path: path.to_owned(),
        source,
    })?;
    if (image.width(), image.height()) == (width, height) {
        Ok(image)
    } else {
        Err(ImportError::Size {
            view: view.name.clone(),
            path: path.to_owned(),
            width,
            height,
            found_width: image.width(),
            found_height: image.height(),
        })
    }
}

/// From pixels of the wanted camera to pixels of the photograph.
struct PixelMap {
    target: CameraIntrinsics,
    source: SourceCamera,
    source_from_target: DMat3,
}

/// A box in the photograph: centre and widths, in pixels.
#[derive(Debug, Clone, Copy)]
struct Footprint {
    center: DVec2,
    width: DVec2,
}

impl PixelMap {
    fn at(&self, px: DVec2) -> Option<DVec2> {
        self.source
            .project(self.source_from_target * self.target.ray(px))
    }

    /// The box of the module's text for the pixel whose centre is `px`; `None` outside the lens model's range.
    fn footprint(&self, px: DVec2) -> Option<Footprint> {
        const HALF: DVec2 = DVec2::splat(0.5);
        let along_x =
            self.at(px + DVec2::new(HALF.x, 0.0))? - self.at(px - DVec2::new(HALF.x, 0.0))?;
        let along_y =
            self.at(px + DVec2::new(0.0, HALF.y))? - self.at(px - DVec2::new(0.0, HALF.y))?;
        Some(Footprint {
            center: self.at(px)?,
            width: DVec2::new(along_x.x.hypot(along_y.x), along_x.y.hypot(along_y.y)),
        })
    }
}

/// Resamples `data`, rows of `C` interleaved 8-bit channels; returns values in [0, 1] and the share inside.
fn resample<const C: usize>(data: &[u8], map: &PixelMap) -> (Vec<f32>, Vec<f32>) {
    let (width, height) = (map.target.width as usize, map.target.height as usize);
    let mut values = vec![0.0; width * height * C];
    let mut inside = vec![0.0; width * height];
    let rows = values
        .par_chunks_mut(width * C)
        .zip(inside.par_chunks_mut(width));
    rows.enumerate().for_each(|(row, (values, inside))| {
        for (column, (value, share)) in values.chunks_exact_mut(C).zip(inside).enumerate() {
            let px = DVec2::new(column as f64 + 0.5, row as f64 + 0.5);
            let Some(footprint) = map.footprint(px) else {
                continue;
            };
            *share = share_inside(&footprint, &map.source);
            if *share > 0.0 {
                let mean = box_mean::<C>(data, &map.source, &footprint);
                value.copy_from_slice(&mean);
            }
        }
    });
    (values, inside)
}

/// The part of `center +- width / 2` that lies in `[0, size]`, as its two ends.
fn clip(center: f64, width: f64, size: u32) -> (f64, f64) {
    (
        (center - width / 2.0).max(0.0),
        (center + width / 2.0).min(f64::from(size)),
    )
}

/// Share of the footprint that lies inside the photograph.
fn share_inside(footprint: &Footprint, source: &SourceCamera) -> f32 {
    let (x0, x1) = clip(footprint.center.x, footprint.width.x, source.width);
    let (y0, y1) = clip(footprint.center.y, footprint.width.y, source.height);
    let area = footprint.width.x * footprint.width.y;
    if x1 <= x0 || y1 <= y0 || area <= 0.0 {
        0.0
    } else {
        ((x1 - x0) * (y1 - y0) / area).min(1.0) as f32
    }
}

/// Area mean over the footprint, at least one pixel wide, of what lies inside the photograph; in [0, 1].
fn box_mean<const C: usize>(data: &[u8], source: &SourceCamera, footprint: &Footprint) -> [f32; C] {
    let (x0, x1) = clip(footprint.center.x, footprint.width.x.max(1.0), source.width);
    let (y0, y1) = clip(
        footprint.center.y,
        footprint.width.y.max(1.0),
        source.height,
    );
    let stride = source.width as usize;
    let mut sum = [0.0_f64; C];
    for y in y0.floor() as usize..y1.ceil() as usize {
        let weight_y = overlap(y, y0, y1);
        for x in x0.floor() as usize..x1.ceil() as usize {
            let weight = weight_y * overlap(x, x0, x1);
            let pixel = &data[(y * stride + x) * C..][..C];
            for (sum, &value) in sum.iter_mut().zip(pixel) {
                *sum += weight * f64::from(value);
            }
        }
    }
    let area = (x1 - x0) * (y1 - y0);
    sum.map(|sum| (sum / (area * 255.0)) as f32)
}

/// How much of the interval `[index, index + 1]` lies in `[start, end]`.
fn overlap(index: usize, start: f64, end: f64) -> f64 {
    let index = index as f64;
    (index + 1.0).min(end) - index.max(start)
}
