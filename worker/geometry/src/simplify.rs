//! The coarsest mesh that looks like the original from the capture's views.
//!
//! Quadric edge collapse (meshoptimizer; Garland and Heckbert 1997) makes ever coarser candidates; a candidate counts
//! only by what both meshes look like when they are rasterised at the working resolution. The search halves the
//! number of triangles until a candidate fails in views chosen to cover all sides, then closes in between the last
//! that held and the first that failed, and at last checks the winner in many more views.
//!
//! Measure. Both meshes are drawn with 2 x 2 samples a pixel. A sample of one is compared with the range of depths
//! that the other shows within half a pixel of it, both ways round, in units of the footprint (depth / focal length:
//! the width of a pixel there). Half a pixel of play across the image is what makes the measure robust: at grazing
//! angles and at the rims of what hides something else, depth itself jumps within a pixel. A sample without any depth
//! near it in the other mesh counts as infinitely far. [`Deviation::depth_footprints`] is what 99.9 % of a view's
//! samples keep to; the mean displacement of the silhouette, where most of the error of a wrong proxy lies (DESIGN
//! section 9), has a bound of its own.
//!
//! Open boundaries are free to move: the silhouette's bound holds them, and real captures are open where nobody looks.

use glam::DVec3;
use meshopt::SimplifyOptions;
use rayon::prelude::*;

use crate::{Camera, Drawable, Mesh, NO_TRIANGLE};

/// Depth that a candidate may be off, in footprints.
const DEPTH_FOOTPRINTS: f64 = 0.5;
/// Mean displacement of the silhouette that a candidate may have, in pixels.
const SILHOUETTE_PX: f64 = 0.02;
/// Share of a view's samples that must keep to the bound on depth.
const SAMPLES_WITHIN: f64 = 0.999;
/// Samples along each side of a pixel; half a pixel is then one sample.
const SAMPLES: u32 = 2;
/// Views that the search looks at, and the final check.
const SEARCH_VIEWS: usize = 12;
const CHECK_VIEWS: usize = 48;
/// Samples of the original kept during the search; very large views make do with fewer of them.
const SEARCH_SAMPLES: usize = 1 << 26;
const LEAST_SEARCH_VIEWS: usize = 4;
/// Nothing is gained below this.
const LEAST_TRIANGLES: usize = 200;
/// Steps between the last candidate that held and the first that failed, by halving the ratio.
const CLOSING_STEPS: usize = 3;
/// A collapse that leaves more than this share of the triangles it started from gets nowhere.
const STUCK: f64 = 0.95;
/// Steps of the radius in which the collapse sees positions, a power of two: fine beside any triangle worth its bytes,
/// coarse beside the rounding of coordinates in the millions. Which edges go depends on every bit, and must not depend
/// on how far the mesh lies from its world's origin. The mesh that comes out keeps its own positions.
const STEPS: f64 = 65_536.0;
/// Vertices at one place are one if their normals are at most about 45 degrees apart; a sharp edge stays sharp.
const SAME_NORMAL: f64 = 0.7;

/// How far a mesh looks from another one, in the worst of the views it was drawn in.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Deviation {
    /// Difference in depth that 99.9 % of the samples keep to, in footprints of a pixel; infinite where more of them
    /// have nothing within half a pixel.
    pub depth_footprints: f64,
    /// Area that only one of the two covers, by the length of the silhouette, in pixels.
    pub silhouette_px: f64,
}

impl Deviation {
    const NONE: Self = Self {
        depth_footprints: 0.0,
        silhouette_px: 0.0,
    };

    fn worst(self, other: Self) -> Self {
        Self {
            depth_footprints: self.depth_footprints.max(other.depth_footprints),
            silhouette_px: self.silhouette_px.max(other.silhouette_px),
        }
    }

    fn holds(&self) -> bool {
        self.depth_footprints <= DEPTH_FOOTPRINTS && self.silhouette_px <= SILHOUETTE_PX
    }
}

/// A simplified mesh.
#[derive(Clone, Debug, PartialEq)]
pub struct Simplified {
    /// The mesh: vertices of the original with their normals and colours, unused ones dropped.
    pub mesh: Mesh,
    /// How far it looks from the original, in the worst of the views that were checked.
    pub deviation: Deviation,
    /// Number of views in which it was checked.
    pub views: usize,
}

/// The coarsest simplification of `mesh` whose depth stays within half a footprint and whose silhouette within a
/// fiftieth of a pixel on average, seen by `cameras` at their resolution. `None` when nothing coarser holds, or there
/// is no camera.
pub fn simplify(mesh: &Mesh, cameras: &[Camera]) -> Option<Simplified> {
    if cameras.is_empty() || mesh.triangles.len() < LEAST_TRIANGLES {
        return None;
    }
    let order = all_sides(mesh, cameras, CHECK_VIEWS);
    let cameras: Vec<Camera> = order.into_iter().map(|at| cameras[at]).collect();
    let samples = cameras
        .iter()
        .map(|camera| {
            (camera.intrinsics.width * camera.intrinsics.height * SAMPLES * SAMPLES) as usize
        })
        .max()
        .unwrap_or(1);
    let searched = (SEARCH_SAMPLES / samples.max(1)).clamp(LEAST_SEARCH_VIEWS, SEARCH_VIEWS);
    let searched = &cameras[..searched.min(cameras.len())];
    let original = Drawable::new(mesh);
    let drawn: Vec<Drawn> = searched
        .par_iter()
        .map(|camera| Drawn::new(&original, camera))
        .collect();
    let deviation = |candidate: &Mesh| {
        let candidate = Drawable::new(candidate);
        drawn
            .par_iter()
            .zip(searched)
            .map(|(original, camera)| original.deviation(&Drawn::new(&candidate, camera)))
            .reduce(|| Deviation::NONE, Deviation::worst)
    };

    // Candidates that held, ever coarser.
    let mut held: Vec<Mesh> = Vec::new();
    let mut finest = welded(mesh)?;
    let mut failed = loop {
        let target = finest.triangles.len() / 2;
        if target < LEAST_TRIANGLES / 2 {
            break target;
        }
        match collapsed(&finest, target) {
            Some(coarser) if deviation(&coarser).holds() => {
                held.push(coarser.clone());
                finest = coarser;
            }
            _ => break target,
        }
    };
    for _ in 0..CLOSING_STEPS {
        let count = finest.triangles.len();
        let target = ((count as f64) * (failed as f64)).sqrt() as usize;
        match collapsed(&finest, target) {
            Some(coarser) if deviation(&coarser).holds() => {
                held.push(coarser.clone());
                finest = coarser;
            }
            _ => failed = target,
        }
    }
    drop(drawn);
    while let Some(candidate) = held.pop() {
        let deviation = self::deviation(mesh, &candidate, &cameras);
        if deviation.holds() {
            return Some(Simplified {
                mesh: candidate,
                deviation,
                views: cameras.len(),
            });
        }
    }
    None
}

/// How far `other` looks from `mesh` in the worst of `cameras`.
pub fn deviation(mesh: &Mesh, other: &Mesh, cameras: &[Camera]) -> Deviation {
    let (mesh, other) = (Drawable::new(mesh), Drawable::new(other));
    cameras
        .iter()
        .map(|camera| Drawn::new(&mesh, camera).deviation(&Drawn::new(&other, camera)))
        .fold(Deviation::NONE, Deviation::worst)
}

/// Up to `count` cameras, each in the direction that is farthest from those before.
fn all_sides(mesh: &Mesh, cameras: &[Camera], count: usize) -> Vec<usize> {
    let (center, _) = mesh.bounding_sphere();
    let directions: Vec<DVec3> = cameras
        .iter()
        .map(|camera| (camera.center() - center).normalize_or_zero())
        .collect();
    let mut chosen = vec![0];
    let mut distances = vec![f64::INFINITY; cameras.len()];
    while chosen.len() < count.min(cameras.len()) {
        let last = directions[chosen[chosen.len() - 1]];
        for (distance, direction) in distances.iter_mut().zip(&directions) {
            *distance = distance.min(direction.distance_squared(last));
        }
        for &at in &chosen {
            distances[at] = -1.0;
        }
        let farthest = (0..cameras.len())
            .max_by(|&a, &b| distances[a].total_cmp(&distances[b]).then(b.cmp(&a)));
        chosen.extend(farthest);
    }
    chosen
}

/// A mesh drawn with [`SAMPLES`] x [`SAMPLES`] samples a pixel.
struct Drawn {
    width: usize,
    /// Row-major camera z; 0 where nothing is.
    depth: Vec<f32>,
    /// In pixels of the view.
    focal: f64,
}

impl Drawn {
    fn new(mesh: &Drawable, camera: &Camera) -> Self {
        let intrinsics = &camera.intrinsics;
        let fine = intrinsics.resized(intrinsics.width * SAMPLES, intrinsics.height * SAMPLES);
        let raster = mesh.rasterize(&camera.with_intrinsics(fine));
        let mut depth = raster.depth;
        for (depth, triangle) in depth.iter_mut().zip(&raster.triangle) {
            if *triangle == NO_TRIANGLE {
                *depth = 0.0;
            }
        }
        Self {
            width: fine.width as usize,
            depth,
            focal: intrinsics.fx.max(intrinsics.fy),
        }
    }

    fn deviation(&self, other: &Self) -> Deviation {
        let mut off: Vec<f32> = Vec::with_capacity(self.depth.len());
        self.measure(other, &mut off);
        other.measure(self, &mut off);
        let last =
            ((off.len() as f64 * SAMPLES_WITHIN).ceil() as usize).clamp(1, off.len().max(1)) - 1;
        let depth_footprints = if off.is_empty() {
            0.0
        } else {
            f64::from(*off.select_nth_unstable_by(last, f32::total_cmp).1)
        };
        let differing = self
            .depth
            .iter()
            .zip(&other.depth)
            .filter(|(a, b)| (**a > 0.0) != (**b > 0.0))
            .count();
        let length = self.silhouette_samples();
        let per_pixel = f64::from(SAMPLES);
        Deviation {
            depth_footprints,
            silhouette_px: if differing == 0 {
                0.0
            } else {
                differing as f64 / length.max(1.0) / per_pixel
            },
        }
    }

    /// Appends, for each covered sample, how far the nearest depth of `other` within half a pixel is, in footprints.
    fn measure(&self, other: &Self, off: &mut Vec<f32>) {
        let height = self.depth.len() / self.width.max(1);
        for y in 0..height {
            for x in 0..self.width {
                let depth = self.depth[y * self.width + x];
                if depth <= 0.0 {
                    continue;
                }
                let (mut low, mut high) = (f32::INFINITY, f32::NEG_INFINITY);
                for row in y.saturating_sub(1)..(y + 2).min(height) {
                    let start = row * self.width;
                    for &near in
                        &other.depth[start + x.saturating_sub(1)..start + (x + 2).min(self.width)]
                    {
                        if near > 0.0 {
                            low = low.min(near);
                            high = high.max(near);
                        }
                    }
                }
                let beyond = (low - depth).max(depth - high).max(0.0);
                off.push((f64::from(beyond) * self.focal / f64::from(depth)) as f32);
            }
        }
    }

    /// Length of the silhouette in samples: borders between covered and uncovered samples, along rows and columns;
    /// a line at a random angle crosses 4/pi as many as it is long.
    fn silhouette_samples(&self) -> f64 {
        let covered = |depth: &f32| *depth > 0.0;
        let along = self
            .depth
            .chunks_exact(self.width.max(1))
            .flat_map(|row| row.windows(2))
            .filter(|pair| covered(&pair[0]) != covered(&pair[1]))
            .count();
        let across = self
            .depth
            .iter()
            .zip(self.depth.iter().skip(self.width))
            .filter(|(above, below)| covered(above) != covered(below))
            .count();
        (along + across) as f64 * std::f64::consts::FRAC_PI_4
    }
}

/// Positions around the middle in whole [`STEPS`] of the radius, wherever the mesh lies.
fn steps(mesh: &Mesh) -> Vec<DVec3> {
    let (center, radius) = mesh.bounding_sphere();
    let steps = |position: &DVec3| ((*position - center) / radius * STEPS).round();
    mesh.positions.iter().map(steps).collect()
}

/// The mesh with vertices at one place and of about one normal joined, as collapses need them.
fn welded(mesh: &Mesh) -> Option<Mesh> {
    let steps = steps(mesh);
    let key = |vertex: u32| steps[vertex as usize].to_array().map(|step| step as i64);
    let mut order: Vec<u32> = (0..mesh.positions.len() as u32).collect();
    order.par_sort_unstable_by_key(|&vertex| (key(vertex), vertex));
    let mut joined: Vec<u32> = (0..mesh.positions.len() as u32).collect();
    for same in order.chunk_by(|&a, &b| key(a) == key(b)) {
        let mut apart: Vec<u32> = Vec::new();
        for &vertex in same {
            let normal = mesh.normals[vertex as usize];
            let first = apart
                .iter()
                .find(|&&other| mesh.normals[other as usize].dot(normal) >= SAME_NORMAL);
            match first {
                Some(&first) => joined[vertex as usize] = first,
                None => apart.push(vertex),
            }
        }
    }
    let mut normals = vec![DVec3::ZERO; mesh.positions.len()];
    for (vertex, &first) in joined.iter().enumerate() {
        normals[first as usize] += mesh.normals[vertex];
    }
    let joined = Mesh {
        positions: mesh.positions.clone(),
        normals: normals
            .into_iter()
            .map(|normal| normal.try_normalize().unwrap_or(DVec3::Z))
            .collect(),
        colors: mesh.colors.clone(),
        triangles: mesh
            .triangles
            .iter()
            .map(|corners| corners.map(|corner| joined[corner as usize]))
            .collect(),
    };
    // Vertices that nothing uses would still be taken for the other side of a seam.
    compact(&joined, &joined.triangles)
}

/// The mesh with about `target` triangles; `None` when that cannot be reached.
fn collapsed(mesh: &Mesh, target: usize) -> Option<Mesh> {
    let positions: Vec<[f32; 3]> = steps(mesh)
        .into_iter()
        .map(|steps| (steps / STEPS).as_vec3().to_array())
        .collect();
    // The result's error is judged by looking, so the collapse itself may go as far as it likes.
    let unlimited = 1.0;
    let indices = meshopt::simplify_decoder(
        mesh.triangles.as_flattened(),
        &positions,
        target * 3,
        unlimited,
        SimplifyOptions::None,
        None,
    );
    let (triangles, _) = indices.as_chunks::<3>();
    if triangles.len() as f64 > STUCK * mesh.triangles.len() as f64 {
        return None;
    }
    compact(mesh, triangles)
}

/// The mesh of `triangles` over the vertices of `mesh`, without those that no triangle uses.
pub(crate) fn compact(mesh: &Mesh, triangles: &[[u32; 3]]) -> Option<Mesh> {
    let mut place = vec![u32::MAX; mesh.positions.len()];
    let mut kept: Vec<u32> = Vec::new();
    let triangles = triangles
        .iter()
        .map(|corners| {
            corners.map(|corner| {
                let place = &mut place[corner as usize];
                if *place == u32::MAX {
                    *place = kept.len() as u32;
                    kept.push(corner);
                }
                *place
            })
        })
        .collect();
    let of = |values: &[DVec3]| {
        kept.iter()
            .map(|&vertex| values[vertex as usize])
            .collect::<Vec<_>>()
    };
    let mut compact = Mesh::new(of(&mesh.positions), triangles).ok()?;
    compact.adopt_normals(&of(&mesh.normals));
    compact.colors = mesh
        .colors
        .as_ref()
        .map(|colors| kept.iter().map(|&vertex| colors[vertex as usize]).collect());
    Some(compact)
}

#[cfg(test)]
mod tests {
    use glam::DAffine3;

    use super::*;
    use crate::CameraIntrinsics;

    /// A ball with bumps, fine enough to have much to spare; `unwelded` gives each triangle its own vertices.
    fn ball(rings: usize, unwelded: bool) -> Mesh {
        let place = |ring: usize, step: usize| {
            let polar = std::f64::consts::PI * ring as f64 / rings as f64;
            let turn = std::f64::consts::TAU * (step % (2 * rings)) as f64 / (2 * rings) as f64;
            let radius = 1.0 + 0.1 * (3.0 * polar).sin() * (2.0 * turn).cos();
            DVec3::new(
                polar.sin() * turn.cos(),
                polar.sin() * turn.sin(),
                1.2 * polar.cos(),
            ) * radius
        };
        let mut positions = Vec::new();
        let mut triangles = Vec::new();
        for ring in 0..rings {
            for step in 0..2 * rings {
                let [a, b, c, d] =
                    [(0, 0), (1, 0), (1, 1), (0, 1)].map(|(r, s)| place(ring + r, step + s));
                for corners in [[a, b, c], [a, c, d]] {
                    triangles.push([0, 1, 2].map(|corner| (positions.len() + corner) as u32));
                    positions.extend(corners);
                }
            }
        }
        let soup = Mesh::new(positions, triangles).expect("valid");
        if unwelded {
            return soup;
        }
        welded(&soup).expect("valid")
    }

    fn cameras(px: u32) -> Vec<Camera> {
        let intrinsics = CameraIntrinsics {
            fx: 1.4 * f64::from(px),
            fy: 1.3 * f64::from(px),
            cx: 0.48 * f64::from(px),
            cy: 0.53 * f64::from(px),
            width: px,
            height: px + 10,
        };
        (0..14)
            .map(|at| {
                let turn = f64::from(at) * 2.4;
                let eye = DVec3::new(turn.cos(), turn.sin(), f64::from(at) / 7.0 - 1.0)
                    .normalize_or_zero()
                    * 4.0;
                Camera::look_at(intrinsics, eye, DVec3::ZERO, DVec3::Z).expect("camera")
            })
            .collect()
    }

    #[test]
    fn coarser_where_nobody_sees_the_difference() {
        let mesh = ball(60, false);
        let small = simplify(&mesh, &cameras(32)).expect("much to spare");
        let large = simplify(&mesh, &cameras(96)).expect("something to spare");
        assert!(small.mesh.triangles.len() < large.mesh.triangles.len());
        assert!(large.mesh.triangles.len() < mesh.triangles.len());
        for (found, px) in [(&small, 32), (&large, 96)] {
            let again = deviation(&mesh, &found.mesh, &cameras(px));
            assert_eq!(again, found.deviation);
            assert!(again.depth_footprints <= 0.5 && again.silhouette_px <= SILHOUETTE_PX);
            assert_eq!(found.views, 14);
        }
        assert_eq!(simplify(&mesh, &cameras(32)), Some(small), "deterministic");
        assert_eq!(simplify(&mesh, &[]), None);
    }

    #[test]
    fn far_from_the_worlds_origin_the_same_triangles_stay() {
        let (mesh, views) = (ball(60, false), cameras(32));
        let here = simplify(&mesh, &views).expect("much to spare");
        let offset = DVec3::new(4.5e5, 5.2e6, 1.1e6);
        let mut far = mesh.clone();
        for position in &mut far.positions {
            *position += offset;
        }
        let moved = DAffine3::from_translation(-offset);
        let views: Vec<Camera> = views
            .iter()
            .map(|view| {
                Camera::new(view.intrinsics, view.camera_from_world * moved).expect("a camera")
            })
            .collect();
        let there = simplify(&far, &views).expect("much to spare");
        assert_ne!(far.positions[7] - offset, mesh.positions[7], "rounded");
        assert_eq!(here.mesh.triangles, there.mesh.triangles);
        assert_eq!(here.mesh.normals, there.mesh.normals);
    }

    #[test]
    fn triangles_without_common_vertices_collapse_too() {
        let whole = simplify(&ball(40, false), &cameras(32)).expect("something to spare");
        let soup = simplify(&ball(40, true), &cameras(32)).expect("welded first");
        assert!(soup.mesh.triangles.len() < whole.mesh.triangles.len() * 3 / 2);
    }

    #[test]
    fn what_differs_is_measured() {
        let mesh = ball(30, false);
        let views = cameras(64);
        assert_eq!(deviation(&mesh, &mesh, &views), Deviation::NONE);
        // Footprint at depth d is d / focal: grown by g at radius about 1, seen from 4, the silhouette moves by about
        // g focal / 4 pixels.
        let grown = |factor: f64| {
            let mut grown = mesh.clone();
            for position in &mut grown.positions {
                *position *= factor;
            }
            deviation(&mesh, &grown, &views)
        };
        let (some, more) = (grown(1.01), grown(1.02));
        let expected = 0.01 * 1.4 * 64.0 / 4.0;
        assert!(
            some.silhouette_px > 0.5 * expected && some.silhouette_px < 2.0 * expected,
            "{some:?}"
        );
        assert!(
            more.silhouette_px > 1.5 * some.silhouette_px
                && more.depth_footprints > some.depth_footprints
        );
        // Nothing near: a triangle far off, and a hole.
        let mut hole = mesh.clone();
        hole.triangles.drain(1000..1200);
        assert!(
            deviation(&mesh, &hole, &views)
                .depth_footprints
                .is_infinite()
        );
        assert!(
            deviation(&hole, &mesh, &views)
                .depth_footprints
                .is_infinite()
        );
    }

    #[test]
    fn what_cannot_be_simplified_stays() {
        // A box whose every triangle is needed, and an open sheet with a step.
        let corners: Vec<DVec3> = (0..8)
            .map(|at| {
                DVec3::new(
                    f64::from(at & 1),
                    f64::from(at >> 1 & 1),
                    f64::from(at >> 2),
                )
            })
            .collect();
        let faces = vec![
            [0, 2, 1],
            [1, 2, 3],
            [4, 5, 6],
            [5, 7, 6],
            [0, 1, 4],
            [1, 5, 4],
        ];
        let mesh = Mesh::new(corners, faces).expect("valid");
        assert_eq!(simplify(&mesh, &cameras(32)), None);
    }
}
