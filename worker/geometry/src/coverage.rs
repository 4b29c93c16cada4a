//! Coverage: which share of each photograph pixel the object fills.
//!
//! A photograph's silhouette pixels mix object and background. Knowing the mixing ratio lets a caller take the
//! background out before warping and composite with the target's own coverage after; on matte objects that rim is
//! nearly the whole error of a binary mask (DESIGN section 9, "Silhouettes first").

use rayon::prelude::{IndexedParallelIterator, ParallelIterator};

use crate::raster::{DepthBuffer, View, key_triangle};
use crate::{Camera, Drawable, Mesh};

/// [`Drawable::coverage_map`] of a mesh that is drawn once.
pub fn coverage_map(mesh: &Mesh, camera: &Camera, group: u32, samples_per_group: u32) -> Vec<f32> {
    Drawable::new(mesh).coverage_map(camera, group, samples_per_group)
}

impl Drawable {
    /// Covered share of each cell of a grid `group` times finer than the camera's pixels.
    ///
    /// `camera` is that of the output image; a cell is one pixel of a photograph with `group` times the resolution, so
    /// that a caller can un-mix each photograph pixel before it averages `group` x `group` of them. Each cell is
    /// sampled at `samples_per_group` x `samples_per_group` points. The values are shares of area in [0, 1], linear in
    /// light, and lie row-major in `[height * group][width * group]`. A `group` or `samples_per_group` of 0 counts as
    /// 1.
    pub fn coverage_map(&self, camera: &Camera, group: u32, samples_per_group: u32) -> Vec<f32> {
        let intrinsics = &camera.intrinsics;
        let group = group.max(1);
        let fine = intrinsics.resized(
            intrinsics.width.saturating_mul(group),
            intrinsics.height.saturating_mul(group),
        );
        let camera = camera.with_intrinsics(fine);
        let (width, height) = (fine.width as usize, fine.height as usize);
        let samples = samples_per_group.max(1) as usize;
        let view = View::new(self, &camera, samples);
        let mut cells = vec![0.0_f32; width * height];
        let share = 1.0 / (samples * samples) as f32;
        view.bands(&mut cells).enumerate().for_each_init(
            DepthBuffer::default,
            |keys, (band, cells)| {
                view.draw(band, samples, keys);
                for (row, line) in keys.keys.chunks_exact(width * samples).enumerate() {
                    let cells = &mut cells[row / samples * width..][..width];
                    for (cell, keys) in cells.iter_mut().zip(line.chunks_exact(samples)) {
                        let hits = keys.iter().filter(|key| key_triangle(**key).is_some());
                        *cell += hits.count() as f32;
                    }
                }
                for cell in cells {
                    *cell *= share;
                }
            },
        );
        cells
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{CameraIntrinsics, GBuffer};
    use glam::{DAffine3, DVec2};

    fn scene() -> (Mesh, Camera) {
        let intrinsics = CameraIntrinsics {
            fx: 20.0,
            fy: 22.0,
            cx: 9.3,
            cy: 3.1,
            width: 13,
            height: 7,
        };
        let camera = Camera::new(intrinsics, DAffine3::IDENTITY).expect("valid");
        let at = |x: f64, y: f64| camera.unproject(DVec2::new(x, y), 2.0);
        // A rectangle from (2.25, 1.5) to (9.125, 5.0).
        let positions = vec![at(2.25, 1.5), at(9.125, 1.5), at(9.125, 5.0), at(2.25, 5.0)];
        (
            Mesh::new(positions, vec![[0, 1, 2], [0, 2, 3]]).expect("valid"),
            camera,
        )
    }

    #[test]
    fn cells_hold_the_covered_share_of_their_area() {
        let (mesh, camera) = scene();
        for (group, samples) in [(1, 8), (2, 4), (3, 5)] {
            let cells = coverage_map(&mesh, &camera, group, samples);
            assert_eq!(cells.len(), (13 * group * 7 * group) as usize);
            let side = 1.0 / f64::from(group);
            for (index, cell) in cells.iter().enumerate() {
                let (column, row) = (index as u32 % (13 * group), index as u32 / (13 * group));
                let overlap = |low: f64, high: f64, place: u32| {
                    let start = f64::from(place) * side;
                    ((start + side).min(high) - start.max(low)).max(0.0) / side
                };
                let area = overlap(2.25, 9.125, column) * overlap(1.5, 5.0, row);
                // A straight edge is off by less than half a sample along each axis.
                assert!(
                    (f64::from(*cell) - area).abs() <= 1.0 / f64::from(samples),
                    "{group} {column} {row}"
                );
            }
        }
        // Where the edges fall between samples, the shares are exact.
        assert!((coverage_map(&mesh, &camera, 1, 8)[13 + 2] - 0.75 * 0.5).abs() < 1e-6);
    }

    #[test]
    fn groups_of_one_agree_with_the_g_buffer_and_zero_counts_as_one() {
        let (mesh, camera) = scene();
        assert_eq!(
            coverage_map(&mesh, &camera, 1, 4),
            GBuffer::render(&mesh, &camera, 4).coverage
        );
        assert_eq!(
            coverage_map(&mesh, &camera, 0, 0),
            coverage_map(&mesh, &camera, 1, 1)
        );
    }
}
