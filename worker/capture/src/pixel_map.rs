//! From the pixels of a wanted camera to boxes in the photograph.
//!
//! The camera models are evaluated on a grid of pixels and interpolated bilinearly in between. The grid is the coarsest
//! one at which the interpolation lies within [`MOST_ERROR_PX`] of the model at the centre of every cell, which is
//! where it is worst; where a corner lies outside the lens model's range, each pixel asks the model itself.

use glam::{DMat3, DVec2};
use ign_geometry::CameraIntrinsics;
use rayon::prelude::*;

use crate::distortion::SourceCamera;
use crate::photo::{Wanted, Window};

/// Largest error of the interpolation, in pixels of the photograph.
const MOST_ERROR_PX: f64 = 0.005;
/// Grids that are tried, in pixels of the wanted camera.
const STEPS: [usize; 4] = [32, 8, 4, 2];
/// Cells, and how wide every footprint must be for means over them to stand for pixels; all in pixels.
const CELLS: [(usize, f64); 3] = [(8, 12.0), (4, 6.0), (2, 4.0)];

/// A box in the photograph: centre and widths, in pixels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Footprint {
    pub(crate) center: DVec2,
    pub(crate) width: DVec2,
}

impl Footprint {
    /// Of a pixel whose image moves by these amounts from one pixel to the next.
    fn new(center: DVec2, along_x: DVec2, along_y: DVec2) -> Self {
        Self {
            center,
            width: (along_x * along_x + along_y * along_y).sqrt(),
        }
    }
}

/// The exact map.
pub(crate) struct PixelMap {
    pub(crate) target: CameraIntrinsics,
    pub(crate) source: SourceCamera,
    pub(crate) source_from_target: DMat3,
}

impl PixelMap {
    fn at(&self, px: DVec2) -> Option<DVec2> {
        self.source
            .project(self.source_from_target * self.target.ray(px))
    }

    /// Of the pixel whose centre is `px`; `None` outside the lens model's range.
    fn footprint(&self, px: DVec2) -> Option<Footprint> {
        let (x, y) = (DVec2::new(0.5, 0.0), DVec2::new(0.0, 0.5));
        let along_x = self.at(px + x)? - self.at(px - x)?;
        let along_y = self.at(px + y)? - self.at(px - y)?;
        Some(Footprint::new(self.at(px)?, along_x, along_y))
    }

    /// Footprints of all pixels, row-major.
    pub(crate) fn footprints(&self) -> Footprints {
        let grid = STEPS.iter().find_map(|&step| Grid::new(self, step));
        let (width, height) = (self.target.width as usize, self.target.height as usize);
        let mut boxes = vec![None; width * height];
        boxes
            .par_chunks_mut(width)
            .enumerate()
            .for_each(|(row, boxes)| {
                for (column, found) in boxes.iter_mut().enumerate() {
                    let interpolated = grid.as_ref().and_then(|grid| grid.footprint(column, row));
                    let exact =
                        || self.footprint(DVec2::new(column as f64 + 0.5, row as f64 + 0.5));
                    *found = interpolated.or_else(exact);
                }
            });
        Footprints {
            width,
            boxes,
            source: (self.source.width, self.source.height),
        }
    }
}

/// The map at the centres of every `step`-th pixel.
struct Grid {
    step: usize,
    columns: usize,
    nodes: Vec<Option<DVec2>>,
}

impl Grid {
    /// `None` where a grid of this step is too coarse.
    fn new(map: &PixelMap, step: usize) -> Option<Self> {
        let count = |size: u32| (size as usize).div_ceil(step) + 1;
        let (columns, rows) = (count(map.target.width), count(map.target.height));
        let at = |column: f64, row: f64| {
            map.at(DVec2::new(column, row) * step as f64 + DVec2::splat(0.5))
        };
        let nodes = (0..rows)
            .flat_map(|row| (0..columns).map(move |column| (column, row)))
            .map(|(column, row)| at(column as f64, row as f64))
            .collect();
        let grid = Self {
            step,
            columns,
            nodes,
        };
        let fits = (0..rows - 1).all(|row| {
            (0..columns - 1).all(|column| {
                let (Some(corners), Some(exact)) = (
                    grid.corners(column, row),
                    at(column as f64 + 0.5, row as f64 + 0.5),
                ) else {
                    return true;
                };
                let middle = corners.iter().sum::<DVec2>() / 4.0;
                middle.distance(exact) <= MOST_ERROR_PX
            })
        });
        fits.then_some(grid)
    }

    /// Top left, top right, bottom left, bottom right of a cell.
    fn corners(&self, column: usize, row: usize) -> Option<[DVec2; 4]> {
        let at = row * self.columns + column;
        Some([
            self.nodes[at]?,
            self.nodes[at + 1]?,
            self.nodes[at + self.columns]?,
            self.nodes[at + self.columns + 1]?,
        ])
    }

    fn footprint(&self, column: usize, row: usize) -> Option<Footprint> {
        let [a, b, c, d] = self.corners(column / self.step, row / self.step)?;
        let scale = 1.0 / self.step as f64;
        let (x, y) = (
            (column % self.step) as f64 * scale,
            (row % self.step) as f64 * scale,
        );
        let (top, bottom) = (a + (b - a) * x, c + (d - c) * x);
        let along_x = ((b - a) * (1.0 - y) + (d - c) * y) * scale;
        Some(Footprint::new(
            top + (bottom - top) * y,
            along_x,
            (bottom - top) * scale,
        ))
    }
}

/// The footprints of a whole picture.
pub(crate) struct Footprints {
    /// Pixels of a row.
    pub(crate) width: usize,
    /// Row-major.
    pub(crate) boxes: Vec<Option<Footprint>>,
    /// Size of the photograph.
    pub(crate) source: (u32, u32),
}

impl Footprints {
    /// The coarsest cells, and the part of the photograph, that are needed.
    pub(crate) fn wanted(&self) -> Wanted {
        let size = DVec2::new(f64::from(self.source.0), f64::from(self.source.1));
        let mut least = f64::INFINITY;
        let (mut min, mut max) = (size, DVec2::ZERO);
        for found in self.boxes.iter().flatten() {
            let half = found.width.max(DVec2::ONE) / 2.0;
            let (low, high) = (found.center - half, found.center + half);
            if low.cmplt(size).all() && high.cmpgt(DVec2::ZERO).all() {
                least = least.min(found.width.min_element());
                min = min.min(low);
                max = max.max(high);
            }
        }
        let (min, max) = (min.max(DVec2::ZERO), max.min(size));
        let cell = CELLS.into_iter().find(|&(_, width)| least >= width);
        Wanted {
            cell: cell.map_or(1, |(cell, _)| cell),
            window: Window {
                x: (min.x.floor() as usize, max.x.ceil() as usize),
                y: (min.y.floor() as usize, max.y.ceil() as usize),
            },
        }
    }
}
