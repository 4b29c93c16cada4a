//! The rasteriser: which triangle is nearest at each sample of the image plane, and how deep it lies.
//!
//! How it works: vertices are projected once; triangles that cross the near plane are clipped; each triangle is put
//! into the bins of the bands of pixel rows it touches; bands are drawn in parallel with f64 edge functions.
//!
//! Invariants:
//! - *Watertight.* The edge function of an edge is computed from the same end points in the same order whichever
//!   triangle asks, so two triangles that share an edge get exactly opposite values, and a sample exactly on it
//!   belongs to one of them (top-left rule).
//! - *Deterministic.* The nearest surface wins, ties go to the lower triangle index; neither threads nor the order of
//!   drawing matter.
//! - Both sides of a triangle are drawn: proxies of real captures are open and their winding is not reliable.
//! - Whatever is not finite is not drawn.

use std::ops::Range;

use glam::{DVec2, DVec3};
use rayon::prelude::{IndexedParallelIterator, ParallelIterator, ParallelSlice, ParallelSliceMut};

use crate::{Camera, Mesh};

/// Marks a sample that no triangle covers in [`Raster::triangle`].
pub const NO_TRIANGLE: u32 = u32::MAX;

/// Near plane as a fraction of the deepest vertex's depth: far enough from zero that f64 screen coordinates keep
/// their precision, near enough that nothing a camera can see is lost.
const NEAR_FRACTION: f64 = 1e-9;
/// Samples drawn by one task: its key buffer (8 bytes a sample) then stays in the second-level cache.
const BAND_SAMPLES: usize = 1 << 16;
/// At least this many bands, where there are that many rows, so that small images are drawn in parallel too.
const MIN_BANDS: usize = 8;
/// Triangles binned by one task.
const BIN_CHUNK: usize = 1 << 15;
/// Up to this many samples a row are tested one by one; wider rows have their ends computed.
const NARROW: usize = 8;
/// Slack, in samples, when the samples inside a bounding box are found; the edge functions decide.
const BOX_SLACK: f64 = 1e-6;

/// What [`rasterize`] found at each pixel centre, row-major.
#[derive(Clone, Debug, PartialEq)]
pub struct Raster {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// Camera z of the nearest surface; 0 where `triangle` is [`NO_TRIANGLE`].
    pub depth: Vec<f32>,
    /// Index of the nearest triangle, or [`NO_TRIANGLE`].
    pub triangle: Vec<u32>,
}

/// Draws the mesh at the pixel centres of the camera's image.
///
/// A camera or mesh put together by hand from values that are not finite draws nothing there.
pub fn rasterize(mesh: &Mesh, camera: &Camera) -> Raster {
    let (width, height) = (
        camera.intrinsics.width as usize,
        camera.intrinsics.height as usize,
    );
    let scene = Projected::new(mesh, camera);
    let bins = scene.bin(width, height, &[1]);
    let mut pixels = vec![(0.0_f32, NO_TRIANGLE); width * height];
    bins.bands(&mut pixels, width)
        .for_each_init(Vec::new, |keys, (band, pixels)| {
            clear(keys, pixels.len());
            let first_row = bins.rows(band).start;
            bins.for_each_triangle(band, |triangle| {
                for piece in scene.pieces(triangle) {
                    piece.scan(1, width, bins.rows(band), |row, column, inverse_depth| {
                        keep_nearest(
                            &mut keys[(row - first_row) * width + column],
                            inverse_depth,
                            triangle,
                        );
                    });
                }
            });
            for (index, (pixel, key)) in pixels.iter_mut().zip(keys.iter()).enumerate() {
                if let Some(triangle) = key_triangle(*key) {
                    let px = DVec2::new(
                        (index % width) as f64 + 0.5,
                        (first_row + index / width) as f64 + 0.5,
                    );
                    let depth = scene
                        .surface(triangle, px)
                        .map_or(0.0, |(_, depth)| depth as f32);
                    *pixel = (depth, triangle);
                }
            }
        });
    let (depth, triangle) = pixels.into_iter().unzip();
    Raster {
        width: width as u32,
        height: height as u32,
        depth,
        triangle,
    }
}

/// Weights of a triangle's corners at the surface point seen through `px`: perspective-correct, non-negative, of
/// sum 1. `None` when the triangle does not exist, or has no area seen from the camera.
///
/// For a `px` that the triangle does not cover, the weights are those of a nearby point of the triangle.
pub fn barycentric(mesh: &Mesh, camera: &Camera, triangle: u32, px: DVec2) -> Option<[f64; 3]> {
    let corners = mesh.triangles.get(triangle as usize)?;
    let mut points = [DVec3::ZERO; 3];
    for (point, corner) in points.iter_mut().zip(corners) {
        *point = camera
            .camera_from_world
            .transform_point3(*mesh.positions.get(*corner as usize)?);
    }
    weights(points, camera.intrinsics.ray(px))
}

/// Corner weights where `ray`, from the origin, meets the triangle. Needs no projection, so it also holds for
/// triangles that reach behind the camera.
fn weights([a, b, c]: [DVec3; 3], ray: DVec3) -> Option<[f64; 3]> {
    // Möller and Trumbore 1997, with the eye at the origin: edges are taken relative to one corner, so that the cross
    // products of small distant triangles do not cancel.
    let (ab, ac) = (b - a, c - a);
    let p = ray.cross(ac);
    let determinant = ab.dot(p);
    let q = (-a).cross(ab);
    let second = -a.dot(p) / determinant;
    let third = ray.dot(q) / determinant;
    let raw = [1.0 - second - third, second, third];
    let clamped = raw.map(|weight| weight.max(0.0));
    let sum: f64 = clamped.iter().sum();
    (raw.iter().all(|weight| weight.is_finite()) && sum > 0.0)
        .then(|| clamped.map(|weight| weight / sum))
}

/// Empties a key buffer for `samples` samples.
pub(crate) fn clear(keys: &mut Vec<u64>, samples: usize) {
    keys.clear();
    keys.resize(samples, u64::MAX);
}

/// Depth test. A key orders by nearness (bits of a positive float order like the float), then by triangle index.
#[inline]
pub(crate) fn keep_nearest(key: &mut u64, inverse_depth: f64, triangle: u32) {
    let candidate = (u64::from(!(inverse_depth as f32).to_bits()) << 32) | u64::from(triangle);
    *key = candidate.min(*key);
}

/// The triangle of a key, if any was drawn.
#[inline]
pub(crate) fn key_triangle(key: u64) -> Option<u32> {
    (key != u64::MAX).then_some(key as u32)
}

/// A vertex on the screen, in pixels.
#[derive(Clone, Copy)]
struct ScreenPoint {
    x: f64,
    y: f64,
    /// 1/depth; 0 when behind the near plane, NaN when the vertex is not finite.
    inverse_depth: f64,
}

/// A mesh seen by a camera.
pub(crate) struct Projected<'a> {
    mesh: &'a Mesh,
    camera: &'a Camera,
    /// Vertices in camera axes.
    points: Vec<DVec3>,
    screen: Vec<ScreenPoint>,
    near: f64,
}

impl<'a> Projected<'a> {
    pub(crate) fn new(mesh: &'a Mesh, camera: &'a Camera) -> Self {
        let points: Vec<DVec3> = mesh
            .positions
            .iter()
            .map(|position| camera.camera_from_world.transform_point3(*position))
            .collect();
        let deepest = points
            .iter()
            .map(|point| point.z)
            .filter(|z| z.is_finite())
            .fold(0.0, f64::max);
        let near = (deepest * NEAR_FRACTION).max(f64::MIN_POSITIVE);
        let mut scene = Self {
            mesh,
            camera,
            points,
            screen: Vec::new(),
            near,
        };
        scene.screen = scene
            .points
            .iter()
            .map(|point| scene.screen_point(*point))
            .collect();
        scene
    }

    fn screen_point(&self, point: DVec3) -> ScreenPoint {
        let intrinsics = &self.camera.intrinsics;
        if point.is_finite() && point.z < self.near {
            return ScreenPoint {
                x: 0.0,
                y: 0.0,
                inverse_depth: 0.0,
            };
        }
        let inverse_depth = point.z.recip();
        let x = intrinsics.fx * point.x * inverse_depth + intrinsics.cx;
        let y = intrinsics.fy * point.y * inverse_depth + intrinsics.cy;
        let finite = x.is_finite() && y.is_finite() && inverse_depth.is_finite();
        ScreenPoint {
            x,
            y,
            inverse_depth: if finite { inverse_depth } else { f64::NAN },
        }
    }

    /// Corner weights and depth where the ray through `px` meets a triangle.
    pub(crate) fn surface(&self, triangle: u32, px: DVec2) -> Option<([f64; 3], f64)> {
        let points =
            self.mesh.triangles[triangle as usize].map(|corner| self.points[corner as usize]);
        let weights = weights(points, self.camera.intrinsics.ray(px))?;
        let depth = weights
            .iter()
            .zip(&points)
            .map(|(weight, point)| weight * point.z)
            .sum();
        Some((weights, depth))
    }

    /// What of a triangle lies in front of the near plane, as triangles on the screen.
    pub(crate) fn pieces(&self, triangle: u32) -> impl Iterator<Item = Piece> {
        self.screen_triangles(triangle)
            .into_iter()
            .flatten()
            .filter_map(Piece::new)
    }

    fn screen_triangles(&self, triangle: u32) -> [Option<[ScreenPoint; 3]>; 2] {
        let corners = self.mesh.triangles[triangle as usize];
        let Some(corners) = self.existing(corners) else {
            return [None, None];
        };
        let screen = corners.map(|corner| self.screen[corner]);
        if screen.iter().all(|point| point.inverse_depth > 0.0) {
            return [Some(screen), None];
        }
        if screen.iter().any(|point| point.inverse_depth.is_nan()) {
            return [None, None];
        }
        self.clipped(corners)
    }

    fn existing(&self, corners: [u32; 3]) -> Option<[usize; 3]> {
        let corners = corners.map(|corner| corner as usize);
        corners
            .iter()
            .all(|corner| *corner < self.screen.len())
            .then_some(corners)
    }

    /// Sutherland-Hodgman against the near plane: up to four corners, as a fan.
    fn clipped(&self, corners: [usize; 3]) -> [Option<[ScreenPoint; 3]>; 2] {
        let mut polygon = Vec::with_capacity(4);
        for (index, &corner) in corners.iter().enumerate() {
            let next = corners[(index + 1) % 3];
            let (here, there) = (self.screen[corner], self.screen[next]);
            if here.inverse_depth > 0.0 {
                polygon.push(here);
            }
            if (here.inverse_depth > 0.0) != (there.inverse_depth > 0.0) {
                // Both triangles of an edge must compute the same crossing: always start from the lower index.
                let (from, to) = (self.points[corner.min(next)], self.points[corner.max(next)]);
                let crossing = from.lerp(to, (self.near - from.z) / (to.z - from.z));
                polygon.push(self.screen_point(crossing.with_z(self.near)));
            }
        }
        if polygon.iter().any(|point| point.inverse_depth.is_nan()) {
            return [None, None];
        }
        match polygon[..] {
            [a, b, c] => [Some([a, b, c]), None],
            [a, b, c, d] => [Some([a, b, c]), Some([a, c, d])],
            _ => [None, None],
        }
    }

    /// Sorts the triangles into bands of pixel rows. `grids` are the sample grids that will be drawn (samples per
    /// pixel side); a triangle that meets no sample of any of them is left out.
    pub(crate) fn bin(&self, width: usize, height: usize, grids: &[usize]) -> Bins {
        let finest = grids.iter().copied().max().unwrap_or(1);
        let by_memory = BAND_SAMPLES / (width * finest * finest).max(1);
        let band_rows = by_memory.min(height.div_ceil(MIN_BANDS)).max(1);
        let bands = height.div_ceil(band_rows);
        let count = self.mesh.triangles.len().min(NO_TRIANGLE as usize);
        let chunks = self.mesh.triangles[..count]
            .par_chunks(BIN_CHUNK)
            .enumerate()
            .map(|(chunk, triangles)| {
                let mut bins = vec![Vec::new(); bands];
                for index in 0..triangles.len() {
                    let triangle = (chunk * BIN_CHUNK + index) as u32;
                    let mut touched = 0..0;
                    for screen in self.screen_triangles(triangle).into_iter().flatten() {
                        for &samples in grids {
                            let (columns, rows) =
                                sample_box(&screen, samples, width, 0..height * samples);
                            if columns.is_empty() || rows.is_empty() {
                                continue;
                            }
                            let first = rows.start / (samples * band_rows);
                            let last = (rows.end - 1) / (samples * band_rows) + 1;
                            touched = if touched.is_empty() {
                                first..last
                            } else {
                                first.min(touched.start)..last.max(touched.end)
                            };
                        }
                    }
                    for bin in &mut bins[touched] {
                        bin.push(triangle);
                    }
                }
                bins
            })
            .collect();
        Bins {
            band_rows,
            height,
            chunks,
        }
    }
}

/// Triangles of each band, in rising order.
pub(crate) struct Bins {
    band_rows: usize,
    height: usize,
    /// `chunks[chunk][band]`.
    chunks: Vec<Vec<Vec<u32>>>,
}

impl Bins {
    /// Pixel rows of a band.
    pub(crate) fn rows(&self, band: usize) -> Range<usize> {
        band * self.band_rows..((band + 1) * self.band_rows).min(self.height)
    }

    pub(crate) fn for_each_triangle(&self, band: usize, mut each: impl FnMut(u32)) {
        for chunk in &self.chunks {
            chunk[band].iter().for_each(|triangle| each(*triangle));
        }
    }

    /// Splits an image with `row_items` items a pixel row into its bands.
    pub(crate) fn bands<'a, T: Send>(
        &self,
        image: &'a mut [T],
        row_items: usize,
    ) -> impl IndexedParallelIterator<Item = (usize, &'a mut [T])> {
        image
            .par_chunks_mut((row_items * self.band_rows).max(1))
            .enumerate()
    }
}

/// Columns and rows of the samples that a triangle's bounding box may hold, within the image and `rows`.
fn sample_box(
    screen: &[ScreenPoint; 3],
    samples: usize,
    width: usize,
    rows: Range<usize>,
) -> (Range<usize>, Range<usize>) {
    let [a, b, c] = screen;
    let range = |low: f64, high: f64, limits: Range<usize>| {
        let first = (low * samples as f64 - 0.5 - BOX_SLACK)
            .ceil()
            .max(limits.start as f64);
        let end = ((high * samples as f64 - 0.5 + BOX_SLACK).floor() + 1.0).min(limits.end as f64);
        if first < end {
            first as usize..end as usize
        } else {
            0..0
        }
    };
    (
        range(
            a.x.min(b.x).min(c.x),
            a.x.max(b.x).max(c.x),
            0..width * samples,
        ),
        range(a.y.min(b.y).min(c.y), a.y.max(b.y).max(c.y), rows),
    )
}

/// One edge; positive on the inner side.
#[derive(Clone, Copy)]
struct Edge {
    x: f64,
    y: f64,
    dx: f64,
    dy: f64,
    /// Whether a sample exactly on the edge is inside.
    inclusive: bool,
}

impl Edge {
    /// The edge from `a` to `b`, anchored at the lexicographically smaller end so that the reverse edge has exactly
    /// the opposite value everywhere (multiplying by -1 is exact).
    fn new(a: ScreenPoint, b: ScreenPoint) -> Self {
        let swap = (b.x, b.y) < (a.x, a.y);
        let (from, to, sign) = if swap { (b, a, -1.0) } else { (a, b, 1.0) };
        let (dx, dy) = (sign * (to.x - from.x), sign * (to.y - from.y));
        Self {
            x: from.x,
            y: from.y,
            dx,
            dy,
            inclusive: dy < 0.0 || (dy == 0.0 && dx > 0.0),
        }
    }

    fn value(&self, x: f64, y: f64) -> f64 {
        self.dx * (y - self.y) - self.dy * (x - self.x)
    }

    fn holds(&self, x: f64, y: f64) -> bool {
        let value = self.value(x, y);
        value > 0.0 || (value == 0.0 && self.inclusive)
    }
}

/// A triangle on the screen, ready to be drawn.
pub(crate) struct Piece {
    screen: [ScreenPoint; 3],
    edges: [Edge; 3],
    /// 1/depth is affine on the screen: its value at the first corner, and its slopes.
    slope_x: f64,
    slope_y: f64,
    /// 1/depth of the farthest and nearest corner: keeps slivers, whose slopes are all rounding, within bounds.
    bounds: (f64, f64),
}

impl Piece {
    fn new(mut screen: [ScreenPoint; 3]) -> Option<Self> {
        let area = Edge::new(screen[0], screen[1]).value(screen[2].x, screen[2].y);
        if area < 0.0 {
            screen.swap(1, 2);
        } else if area == 0.0 || area.is_nan() {
            return None;
        }
        let [a, b, c] = screen;
        let (ux, uy, u) = (b.x - a.x, b.y - a.y, b.inverse_depth - a.inverse_depth);
        let (vx, vy, v) = (c.x - a.x, c.y - a.y, c.inverse_depth - a.inverse_depth);
        let determinant = ux * vy - uy * vx;
        let slope = |numerator: f64| {
            let slope = numerator / determinant;
            if slope.is_finite() { slope } else { 0.0 }
        };
        let depths = [a, b, c].map(|point| point.inverse_depth);
        Some(Self {
            screen,
            edges: [Edge::new(a, b), Edge::new(b, c), Edge::new(c, a)],
            slope_x: slope(u * vy - v * uy),
            slope_y: slope(v * ux - u * vx),
            bounds: (
                depths.iter().copied().fold(f64::INFINITY, f64::min),
                depths.iter().copied().fold(0.0, f64::max),
            ),
        })
    }

    /// Calls `put(row, column, 1/depth)` for each covered sample of a grid with `samples` x `samples` samples a
    /// pixel, within the pixel rows `rows`.
    #[inline]
    pub(crate) fn scan(
        &self,
        samples: usize,
        width: usize,
        rows: Range<usize>,
        mut put: impl FnMut(usize, usize, f64),
    ) {
        let (columns, rows) = sample_box(
            &self.screen,
            samples,
            width,
            rows.start * samples..rows.end * samples,
        );
        let scale = samples as f64;
        let center = |index: usize| (index as f64 + 0.5) / scale;
        let [anchor, ..] = self.screen;
        for row in rows {
            let y = center(row);
            let inside = |column: usize| {
                let x = center(column);
                self.edges.iter().all(|edge| edge.holds(x, y))
            };
            let row_base = anchor.inverse_depth + self.slope_y * (y - anchor.y);
            let mut emit = |column: usize| {
                let inverse_depth = row_base + self.slope_x * (center(column) - anchor.x);
                put(
                    row,
                    column,
                    inverse_depth.clamp(self.bounds.0, self.bounds.1),
                );
            };
            if columns.len() <= NARROW {
                columns
                    .clone()
                    .filter(|column| inside(*column))
                    .for_each(&mut emit);
            } else {
                self.span(columns.clone(), y, scale).for_each(&mut emit);
            }
        }
    }

    /// The columns of a row that the triangle covers. Along a row each edge function is monotone, in floating point
    /// too, so what is inside an edge is a half line: its end is estimated, then settled by exact tests.
    fn span(&self, columns: Range<usize>, y: f64, scale: f64) -> Range<usize> {
        let (mut first, mut end) = (columns.start, columns.end);
        let center = |index: usize| (index as f64 + 0.5) / scale;
        for edge in &self.edges {
            let crossing = (edge.x + edge.dx * (y - edge.y) / edge.dy) * scale - 0.5;
            let estimate = (crossing.max(columns.start as f64) as usize).min(columns.end);
            let holds = |column: usize| edge.holds(center(column), y);
            if edge.dy < 0.0 {
                let mut low = estimate;
                while low > columns.start && holds(low - 1) {
                    low -= 1;
                }
                while low < columns.end && !holds(low) {
                    low += 1;
                }
                first = first.max(low);
            } else if edge.dy > 0.0 {
                let mut high = estimate;
                while high < columns.end && holds(high) {
                    high += 1;
                }
                while high > columns.start && !holds(high - 1) {
                    high -= 1;
                }
                end = end.min(high);
            } else if !holds(columns.start) {
                return 0..0;
            }
        }
        first..end.max(first)
    }
}

/// Whether any sample of a band is covered is all that coverage needs; see [`crate::coverage_map`].
pub(crate) fn covered(
    scene: &Projected<'_>,
    bins: &Bins,
    band: usize,
    samples: usize,
    width: usize,
    hit: &mut [bool],
) {
    let rows = bins.rows(band);
    let row_samples = width * samples;
    hit.fill(false);
    bins.for_each_triangle(band, |triangle| {
        for piece in scene.pieces(triangle) {
            piece.scan(samples, width, rows.clone(), |row, column, _| {
                hit[(row - rows.start * samples) * row_samples + column] = true;
            });
        }
    });
}
