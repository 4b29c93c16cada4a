//! Coverage: which share of each photograph pixel the object fills.
//!
//! A photograph's silhouette pixels mix object and background. Knowing the mixing ratio lets a caller take the
//! background out before warping and composite with the target's own coverage after; on matte objects that rim is
//! nearly the whole error of a binary mask (DESIGN section 9, "Silhouettes first").

use rayon::prelude::ParallelIterator;

use crate::raster::{Projected, covered};
use crate::{Camera, Mesh};

/// Covered share of each cell of a grid `group` times finer than the camera's pixels.
///
/// `camera` is that of the output image; a cell is one pixel of a photograph with `group` times the resolution, so
/// that a caller can un-mix each photograph pixel before it averages `group` x `group` of them. Each cell is sampled
/// at `samples_per_group` x `samples_per_group` points. The values are shares of area in [0, 1], linear in light, and
/// lie row-major in `[height * group][width * group]`. A `group` or `samples_per_group` of 0 counts as 1.
pub fn coverage_map(mesh: &Mesh, camera: &Camera, group: u32, samples_per_group: u32) -> Vec<f32> {
    let intrinsics = &camera.intrinsics;
    let group = group.max(1);
    let fine = intrinsics.resized(
        intrinsics.width.saturating_mul(group),
        intrinsics.height.saturating_mul(group),
    );
    let camera = camera.with_intrinsics(fine);
    let (width, height) = (fine.width as usize, fine.height as usize);
    let samples = samples_per_group.max(1) as usize;
    let scene = Projected::new(mesh, &camera);
    let bins = scene.bin(width, height, &[samples]);
    let mut cells = vec![0.0_f32; width * height];
    let share = 1.0 / (samples * samples) as f32;
    bins.bands(&mut cells, width)
        .for_each_init(Vec::new, |hit, (band, cells)| {
            hit.resize(cells.len() * samples * samples, false);
            covered(&scene, &bins, band, samples, width, hit);
            for (row, line) in hit.chunks_exact(width * samples).enumerate() {
                let cells = &mut cells[row / samples * width..][..width];
                for (cell, samples) in cells.iter_mut().zip(line.chunks_exact(samples)) {
                    *cell += samples.iter().filter(|hit| **hit).count() as f32;
                }
            }
            for cell in cells {
                *cell *= share;
            }
        });
    cells
}
