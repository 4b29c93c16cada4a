//! The rasteriser: which triangle is nearest at each sample of the image plane, and how deep it lies.
//!
//! How it works: the boxes around the mesh's clusters ([`Drawable`]) are projected and sorted into bands of pixel rows,
//! which are drawn in parallel. A band takes its clusters front to back, leaves out those that lie wholly behind what
//! it has drawn, projects the vertices of the others, clips triangles that cross the near plane, drops those that no
//! sample can meet, and tests the rest with f64 edge functions.
//!
//! Invariants:
//! - *Watertight.* The edge function of an edge is computed from the same end points in the same order whichever
//!   triangle asks, so two triangles that share an edge get exactly opposite values, and a sample exactly on it
//!   belongs to one of them (top-left rule). Copies of a vertex are projected to the same bits.
//! - *Deterministic.* The nearest surface wins, to the precision of f32; ties are decided by where the triangles lie
//!   ([`Drawable::first`]). So neither the order of triangles in the mesh, nor threads, nor the order of drawing, nor
//!   what was left out matter: a cluster is hidden only if every sample it could meet already holds a strictly nearer
//!   surface.
//! - Both sides of a triangle are drawn: proxies of real captures are open and their winding is not reliable.
//! - Whatever is not finite, also as the f32 that maps are made of, is not drawn.

use std::ops::Range;

use glam::{DVec2, DVec3};
use rayon::prelude::{
    IndexedParallelIterator, IntoParallelIterator, IntoParallelRefIterator, ParallelIterator,
    ParallelSliceMut,
};

use crate::drawable::{Bounds, Cluster, VERTICES};
use crate::{Camera, Drawable, Mesh};

/// Marks a sample that no triangle covers in [`Raster::triangle`].
pub const NO_TRIANGLE: u32 = u32::MAX;

/// Near plane as a fraction of the depth of the scene's bounding box: far enough from zero that f64 screen coordinates
/// keep their precision, near enough that nothing a camera can see is lost.
const NEAR_FRACTION: f64 = 1e-9;
/// Samples drawn by one task: its key buffer (8 bytes a sample) then stays in the second-level cache.
const BAND_SAMPLES: usize = 1 << 16;
/// At least this many bands, where there are that many rows, so that small images are drawn in parallel too.
const MIN_BANDS: usize = 8;
/// Up to this many samples a row are tested one by one; wider rows have their ends computed.
const NARROW: usize = 8;
/// Slack, in samples, when the samples inside a bounding box are found; the edge functions decide.
const BOX_SLACK: f64 = 1e-6;
/// Samples across a tile, and down: the grain at which hidden clusters are found.
const TILE: usize = 8;
/// Relative slack of projected boxes, far above what rounding moves a vertex and far below a pixel.
const BOUNDS_SLACK: f64 = 1e-12;

/// What [`Drawable::rasterize`] found at each pixel centre, row-major.
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

/// Draws the mesh at the pixel centres of the camera's image. For several views of one mesh, make a [`Drawable`] once.
pub fn rasterize(mesh: &Mesh, camera: &Camera) -> Raster {
    Drawable::new(mesh).rasterize(camera)
}

impl Drawable {
    /// Draws the mesh at the pixel centres of the camera's image.
    ///
    /// A camera or mesh put together by hand from values that are not finite draws nothing there.
    pub fn rasterize(&self, camera: &Camera) -> Raster {
        let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
        let pixels = width as usize * height as usize;
        let (mut depth, mut triangle) = (vec![0.0_f32; pixels], vec![NO_TRIANGLE; pixels]);
        let view = View::new(self, camera, 1);
        (view.bands(&mut depth), view.bands(&mut triangle))
            .into_par_iter()
            .enumerate()
            .for_each_init(DepthBuffer::default, |keys, (band, (depth, triangle))| {
                view.draw(band, 1, keys);
                let top = view.rows(band).start;
                for (index, key) in keys.keys.iter().enumerate() {
                    let (column, row) = (index % view.width, top + index / view.width);
                    let place = DVec2::new(column as f64, row as f64) + 0.5;
                    if let Some(found) = key_triangle(*key)
                        && let Some(surface) = view.surface(found, place)
                    {
                        depth[index] = surface.depth as f32;
                        triangle[index] = found;
                    }
                }
            });
        Raster {
            width,
            height,
            depth,
            triangle,
        }
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

/// Where the ray through an image point meets a triangle.
pub(crate) struct Surface<'a> {
    /// Weights of the triangle's corners.
    pub(crate) weights: [f64; 3],
    /// Camera z.
    pub(crate) depth: f64,
    /// What holds the triangle.
    pub(crate) cluster: &'a Cluster,
    /// The corners' vertices in `cluster`.
    pub(crate) corners: [usize; 3],
}

/// The nearest triangle at each sample of a band.
#[derive(Default)]
pub(crate) struct DepthBuffer {
    /// Row-major, `width` a row: how far, and which triangle; see [`key`].
    pub(crate) keys: Vec<u64>,
    width: usize,
    /// The farthest surface of each tile of `TILE` x `TILE` samples, as [`farness`]. May be out of date: too far.
    farthest: Vec<u32>,
    /// Whether a tile has been drawn to since `farthest` was found.
    drawn_to: Vec<bool>,
}

impl DepthBuffer {
    fn clear(&mut self, width: usize, height: usize) {
        let tiles = width.div_ceil(TILE) * height.div_ceil(TILE);
        self.width = width;
        self.keys.clear();
        self.keys.resize(width * height, u64::MAX);
        self.farthest.clear();
        self.farthest.resize(tiles, u32::MAX);
        self.drawn_to.clear();
        self.drawn_to.resize(tiles, false);
    }

    /// Whether every sample in `columns` and `rows` holds something strictly nearer than `nearest`, a [`farness`].
    fn hide(&mut self, columns: &Range<usize>, rows: &Range<usize>, nearest: u32) -> bool {
        for row in tiles(rows) {
            for column in tiles(columns) {
                let tile = row * self.width.div_ceil(TILE) + column;
                if nearest > self.farthest[tile] {
                    continue;
                }
                if !self.drawn_to[tile] {
                    return false;
                }
                self.drawn_to[tile] = false;
                let columns = column * TILE..((column + 1) * TILE).min(self.width);
                let lines = self.keys[row * TILE * self.width..].chunks(self.width);
                let far = lines
                    .take(TILE)
                    .flat_map(|line| &line[columns.clone()])
                    .max();
                self.farthest[tile] = far.map_or(u32::MAX, |key| (key >> 32) as u32);
                if nearest <= self.farthest[tile] {
                    return false;
                }
            }
        }
        true
    }

    fn mark(&mut self, columns: &Range<usize>, rows: &Range<usize>) {
        for row in tiles(rows) {
            let first = row * self.width.div_ceil(TILE);
            let columns = tiles(columns);
            self.drawn_to[first + columns.start..first + columns.end].fill(true);
        }
    }
}

/// The tiles that hold a range of samples.
fn tiles(samples: &Range<usize>) -> Range<usize> {
    samples.start / TILE..samples.end.div_ceil(TILE)
}

/// Orders positive inverse depths from near to far: bits of a positive float order like the float.
#[inline]
fn farness(inverse_depth: f64) -> u32 {
    !(inverse_depth as f32).to_bits()
}

/// What a sample keeps the nearest of: [`farness`] above, the triangle's index below.
#[inline]
fn key(inverse_depth: f64, triangle: u32) -> u64 {
    (u64::from(farness(inverse_depth)) << 32) | u64::from(triangle)
}

/// The triangle of a key, if any was drawn.
#[inline]
pub(crate) fn key_triangle(key: u64) -> Option<u32> {
    (key != u64::MAX).then_some(key as u32)
}

/// A vertex on the screen, in samples.
#[derive(Clone, Copy, Default)]
struct ScreenPoint {
    x: f64,
    y: f64,
    /// 1/depth; 0 when behind the near plane, NaN when the vertex is not finite.
    inverse_depth: f64,
}

/// The samples that a box may hold: columns and rows from the first to before the last, both within the band.
#[derive(Clone, Copy, Default)]
struct SampleBox {
    columns: (u32, u32),
    rows: (u32, u32),
}

/// The samples of a band, on a grid of `samples` x `samples` samples a pixel.
struct Grid {
    samples: f64,
    columns: u32,
    rows: Range<u32>,
}

impl Grid {
    /// The samples that a point's box holds: none, or one where rounding could decide.
    ///
    /// Sample i lies at i + 0.5: it is at or above `low` from ceil(low - 0.5) on, at or below `high` up to
    /// floor(high - 0.5). A cast cuts off like floor, and sends what is too small (or NaN) to 0; both are many times
    /// cheaper than the library's rounding.
    #[inline]
    fn around(&self, point: &ScreenPoint) -> SampleBox {
        let range = |at: f64, low: u32, high: u32| {
            (
                upper(at + (0.5 - BOX_SLACK), f64::from(low)) as u32,
                lower(at + (0.5 + BOX_SLACK), f64::from(high)) as u32,
            )
        };
        SampleBox {
            columns: range(point.x, 0, self.columns),
            rows: range(point.y, self.rows.start, self.rows.end),
        }
    }
}

impl SampleBox {
    /// The samples that a triangle's bounding box may hold. May hold a few that the triangle does not cover: the edge
    /// functions decide.
    #[inline]
    fn join([a, b, c]: [Self; 3]) -> Self {
        let both = |a: (u32, u32), b: (u32, u32)| (a.0.min(b.0), a.1.max(b.1));
        Self {
            columns: both(both(a.columns, b.columns), c.columns),
            rows: both(both(a.rows, b.rows), c.rows),
        }
    }

    #[inline]
    fn is_empty(&self) -> bool {
        self.columns.0 >= self.columns.1 || self.rows.0 >= self.rows.1
    }
}

/// A cluster's vertices on the screen.
struct Projected {
    points: [ScreenPoint; VERTICES],
    boxes: [SampleBox; VERTICES],
}

/// A cluster as a band sees it, in pixels.
struct Visible {
    /// [`farness`] of the nearest corner of its box; 0 where that is not known.
    nearest: u32,
    cluster: u32,
    columns: Range<u32>,
    rows: Range<u32>,
}

/// A mesh seen by a camera.
pub(crate) struct View<'a> {
    drawable: &'a Drawable,
    camera: &'a Camera,
    near: f64,
    /// Width in pixels.
    pub(crate) width: usize,
    height: usize,
    band_rows: usize,
    /// The clusters of each band, front to back.
    bands: Vec<Vec<(u32, u32)>>,
    visible: Vec<Visible>,
}

impl<'a> View<'a> {
    /// Finds what of `drawable` the camera sees. `finest` is the largest number of samples a pixel side that will be
    /// drawn.
    pub(crate) fn new(drawable: &'a Drawable, camera: &'a Camera, finest: usize) -> Self {
        let intrinsics = &camera.intrinsics;
        let (width, height) = (intrinsics.width as usize, intrinsics.height as usize);
        let by_memory = BAND_SAMPLES / (width * finest * finest).max(1);
        let band_rows = by_memory.min(height.div_ceil(MIN_BANDS)).max(1);
        let (middle, half) = in_camera(drawable.bounds(), camera);
        let deepest = Some(middle.z + half.z).filter(|z| z.is_finite());
        let near = (deepest.unwrap_or(0.0) * NEAR_FRACTION).max(f64::MIN_POSITIVE);
        let visible: Vec<Visible> = drawable
            .clusters()
            .par_iter()
            .enumerate()
            .with_min_len(1024)
            .filter_map(|(index, cluster)| visible(index, cluster, camera, near))
            .collect();
        let mut bands = vec![Vec::new(); height.div_ceil(band_rows)];
        for (index, cluster) in visible.iter().enumerate() {
            let first = cluster.rows.start as usize / band_rows;
            let end = (cluster.rows.end as usize).div_ceil(band_rows);
            for band in &mut bands[first..end] {
                band.push((cluster.nearest, index as u32));
            }
        }
        Self {
            drawable,
            camera,
            near,
            width,
            height,
            band_rows,
            bands,
            visible,
        }
    }

    /// Pixel rows of a band.
    pub(crate) fn rows(&self, band: usize) -> Range<usize> {
        band * self.band_rows..((band + 1) * self.band_rows).min(self.height)
    }

    /// Splits an image with one item a pixel into the bands.
    pub(crate) fn bands<'b, T: Send>(&self, image: &'b mut [T]) -> rayon::slice::ChunksMut<'b, T> {
        image.par_chunks_mut((self.width * self.band_rows).max(1))
    }

    /// Fills `keys` with the nearest triangle at each sample of a band, `samples` x `samples` a pixel; samples lie
    /// row-major, `width * samples` a row.
    pub(crate) fn draw(&self, band: usize, samples: usize, keys: &mut DepthBuffer) {
        let rows = self.rows(band);
        let (top, across) = (rows.start * samples, self.width * samples);
        keys.clear(across, rows.len() * samples);
        let grid = Grid {
            samples: samples as f64,
            columns: across as u32,
            rows: top as u32..(rows.end * samples) as u32,
        };
        let mut order = self.bands[band].clone();
        order.sort_unstable();
        let mut projected = Projected {
            points: [ScreenPoint::default(); VERTICES],
            boxes: [SampleBox::default(); VERTICES],
        };
        for (nearest, index) in order {
            let visible = &self.visible[index as usize];
            let columns = &visible.columns;
            let columns = columns.start as usize * samples..columns.end as usize * samples;
            let first = (visible.rows.start as usize).max(rows.start) - rows.start;
            let end = (visible.rows.end as usize).min(rows.end) - rows.start;
            let lines = first * samples..end * samples;
            if keys.hide(&columns, &lines, nearest) {
                continue;
            }
            let cluster = &self.drawable.clusters()[visible.cluster as usize];
            self.scan(
                cluster,
                &grid,
                &mut projected,
                |row, column, inverse_depth, triangle| {
                    let kept = &mut keys.keys[(row - top) * across + column];
                    let new = key(inverse_depth, triangle);
                    *kept = if (new ^ *kept) >> 32 == 0 {
                        self.tied(new, *kept)
                    } else {
                        new.min(*kept)
                    };
                },
            );
            keys.mark(&columns, &lines);
        }
    }

    /// Which of two keys of one depth a sample keeps.
    #[cold]
    fn tied(&self, new: u64, kept: u64) -> u64 {
        match (key_triangle(new), key_triangle(kept)) {
            (Some(triangle), Some(other)) if self.drawable.first(triangle, other) == other => kept,
            _ => new,
        }
    }

    /// Where the ray through `px` meets a triangle that was drawn; `None` when that is seen edge-on, up to rounding, or
    /// so far or near that f32 cannot hold its depth.
    #[inline]
    pub(crate) fn surface(&self, triangle: u32, px: DVec2) -> Option<Surface<'a>> {
        let (cluster, corners) = self.drawable.corners(triangle);
        let points = corners.map(|corner| self.point(cluster.positions[corner]));
        let weights = weights(points, self.camera.intrinsics.ray(px))?;
        let depths = weights.iter().zip(&points);
        let depth: f64 = depths.map(|(weight, point)| weight * point.z).sum();
        (depth as f32 > 0.0 && (depth as f32).is_finite()).then_some(Surface {
            weights,
            depth,
            cluster,
            corners,
        })
    }

    /// Calls `put(row, column, 1/depth, triangle)` for each sample of the grid that a triangle of a cluster covers.
    #[inline]
    fn scan(
        &self,
        cluster: &Cluster,
        grid: &Grid,
        projected: &mut Projected,
        mut put: impl FnMut(usize, usize, f64, u32),
    ) {
        let mut all_in_front = true;
        let places = projected.points.iter_mut().zip(&mut projected.boxes);
        for (position, (point, samples)) in cluster.positions.iter().zip(places) {
            *point = self.screen_point(self.point(*position), grid.samples);
            *samples = grid.around(point);
            all_in_front &= point.inverse_depth > 0.0;
        }
        for (triangle, corners) in cluster.triangles.iter().zip(&cluster.corners) {
            let corners = corners.map(usize::from);
            let screen = || corners.map(|corner| projected.points[corner]);
            let mut put = |row, column, inverse_depth| put(row, column, inverse_depth, *triangle);
            if all_in_front || screen().iter().all(|point| point.inverse_depth > 0.0) {
                let samples = SampleBox::join(corners.map(|corner| projected.boxes[corner]));
                if !samples.is_empty() {
                    scan(&screen(), &samples, &mut put);
                }
            } else if !screen().iter().any(|point| point.inverse_depth.is_nan()) {
                let points = corners.map(|corner| self.point(cluster.positions[corner]));
                for screen in self.clipped(points, &screen(), grid).iter().flatten() {
                    let samples = SampleBox::join(screen.each_ref().map(|p| grid.around(p)));
                    if !samples.is_empty() {
                        scan(screen, &samples, &mut put);
                    }
                }
            }
        }
    }

    #[inline]
    fn point(&self, position: DVec3) -> DVec3 {
        self.camera.camera_from_world.transform_point3(position)
    }

    #[inline]
    fn screen_point(&self, point: DVec3, samples: f64) -> ScreenPoint {
        if point.is_finite() && point.z < self.near {
            return ScreenPoint::default();
        }
        let intrinsics = &self.camera.intrinsics;
        let inverse_depth = point.z.recip();
        let x = (intrinsics.fx * point.x * inverse_depth + intrinsics.cx) * samples;
        let y = (intrinsics.fy * point.y * inverse_depth + intrinsics.cy) * samples;
        let finite = x.is_finite() && y.is_finite() && inverse_depth.is_finite();
        ScreenPoint {
            x,
            y,
            inverse_depth: if finite { inverse_depth } else { f64::NAN },
        }
    }

    /// Sutherland-Hodgman against the near plane: up to four corners, as a fan.
    #[cold]
    fn clipped(
        &self,
        points: [DVec3; 3],
        screen: &[ScreenPoint; 3],
        grid: &Grid,
    ) -> [Option<[ScreenPoint; 3]>; 2] {
        let mut polygon = Vec::with_capacity(4);
        for index in 0..3 {
            let next = (index + 1) % 3;
            let (here, there) = (screen[index], screen[next]);
            if here.inverse_depth > 0.0 {
                polygon.push(here);
            }
            if (here.inverse_depth > 0.0) != (there.inverse_depth > 0.0) {
                // Both triangles of an edge must compute the same crossing: always start from the end in front.
                let front = here.inverse_depth > 0.0;
                let (from, to) = if front { (index, next) } else { (next, index) };
                let (from, to) = (points[from], points[to]);
                let crossing = from.lerp(to, (self.near - from.z) / (to.z - from.z));
                polygon.push(self.screen_point(crossing.with_z(self.near), grid.samples));
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
}

/// Middle and half the size, along the camera's axes, of a box around a box; wide enough for every rounding.
fn in_camera(bounds: Bounds, camera: &Camera) -> (DVec3, DVec3) {
    let pose = &camera.camera_from_world;
    let size = pose.matrix3.abs();
    let (middle, half) = (
        bounds.low * 0.5 + bounds.high * 0.5,
        bounds.high * 0.5 - bounds.low * 0.5,
    );
    let magnitude = size * (middle.abs() + half) + pose.translation.abs();
    (
        pose.transform_point3(middle),
        size * half + magnitude * BOUNDS_SLACK,
    )
}

/// Where a cluster falls in the camera's image; `None` where that is certainly outside, or behind the camera.
fn visible(index: usize, cluster: &Cluster, camera: &Camera, near: f64) -> Option<Visible> {
    let i = &camera.intrinsics;
    let (middle, half) = in_camera(cluster.bounds, camera);
    let (low, high) = (middle - half, middle + half);
    if high.z < near {
        return None;
    }
    let mut visible = Visible {
        nearest: 0,
        cluster: index as u32,
        columns: 0..i.width,
        rows: 0..i.height,
    };
    // Whatever is not finite fails a comparison and leaves the whole image.
    if low.z >= near {
        let pixels = |low_at: f64, high_at: f64, focal: f64, principal: f64, size: u32| {
            let ends = [
                low_at / low.z,
                low_at / high.z,
                high_at / low.z,
                high_at / high.z,
            ];
            let [a, b, c, d] = ends.map(|end| focal * end);
            let (first, last) = (
                lower(lower(a, b), lower(c, d)),
                upper(upper(a, b), upper(c, d)),
            );
            let slack = (first.abs() + last.abs() + principal.abs()) * BOUNDS_SLACK + BOX_SLACK;
            let (first, last) = (first + principal - slack, last + principal + slack);
            let whole = first.is_nan() || last.is_nan();
            if whole {
                0..size
            } else {
                (first as u32).min(size)..(last as u32).saturating_add(1).min(size)
            }
        };
        visible.nearest = farness(low.z.recip());
        visible.columns = pixels(low.x, high.x, i.fx, i.cx, i.width);
        visible.rows = pixels(low.y, high.y, i.fy, i.cy, i.height);
    }
    (!visible.columns.is_empty() && !visible.rows.is_empty()).then_some(visible)
}

/// `f64::min` without its care for NaN, which is a third of the cost of a small triangle.
#[inline]
fn lower(a: f64, b: f64) -> f64 {
    if a < b { a } else { b }
}

/// `f64::max`, likewise.
#[inline]
fn upper(a: f64, b: f64) -> f64 {
    if a > b { a } else { b }
}

/// One edge; positive on the inner side.
#[derive(Clone, Copy)]
struct Edge {
    x: f64,
    y: f64,
    dx: f64,
    dy: f64,
    /// A sample is inside when its value is above this: 0, or the largest number below 0 for an edge that also owns
    /// the samples exactly on it.
    threshold: f64,
}

impl Edge {
    /// The edge from `a` to `b`, anchored at the lexicographically smaller end so that the reverse edge has exactly
    /// the opposite value everywhere (multiplying by -1 is exact).
    fn new(a: ScreenPoint, b: ScreenPoint) -> Self {
        let swap = (b.x, b.y) < (a.x, a.y);
        let (from, to, sign) = if swap { (b, a, -1.0) } else { (a, b, 1.0) };
        let (dx, dy) = (sign * (to.x - from.x), sign * (to.y - from.y));
        let owns = dy < 0.0 || (dy == 0.0 && dx > 0.0);
        Self {
            x: from.x,
            y: from.y,
            dx,
            dy,
            threshold: if owns { -f64::from_bits(1) } else { 0.0 },
        }
    }

    #[inline]
    fn value(&self, x: f64, y: f64) -> f64 {
        self.dx * (y - self.y) - self.dy * (x - self.x)
    }

    #[inline]
    fn holds(&self, x: f64, y: f64) -> bool {
        self.value(x, y) > self.threshold
    }
}

/// Calls `put(row, column, 1/depth)` for each of `samples` that one triangle covers, which lies wholly in front of the
/// near plane.
#[inline]
fn scan(screen: &[ScreenPoint; 3], samples: &SampleBox, put: &mut impl FnMut(usize, usize, f64)) {
    let columns = samples.columns.0 as usize..samples.columns.1 as usize;
    let [a, mut b, mut c] = *screen;
    let area = Edge::new(a, b).value(c.x, c.y);
    if area == 0.0 || area.is_nan() {
        return;
    }
    if area < 0.0 {
        std::mem::swap(&mut b, &mut c);
    }
    let edges = [Edge::new(a, b), Edge::new(b, c), Edge::new(c, a)];
    // Most small triangles cover no sample: their plane is found when it is needed.
    let mut plane = None;
    for row in samples.rows.0 as usize..samples.rows.1 as usize {
        let y = row as f64 + 0.5;
        let mut emit = |column: usize, x: f64| {
            let plane = plane.get_or_insert_with(|| Plane::new(a, b, c));
            put(row, column, plane.inverse_depth(x, y));
        };
        if columns.len() <= NARROW {
            for column in columns.clone() {
                let x = column as f64 + 0.5;
                // Not short-circuiting: three comparisons cost less than one branch predicted wrongly.
                if edges[0].holds(x, y) & edges[1].holds(x, y) & edges[2].holds(x, y) {
                    emit(column, x);
                }
            }
        } else {
            span(&edges, &columns, y).for_each(|column| emit(column, column as f64 + 0.5));
        }
    }
}

/// 1/depth over a triangle: affine on the screen.
struct Plane {
    corner: ScreenPoint,
    slope_x: f64,
    slope_y: f64,
    /// Bounds keep slivers, whose slopes are all rounding, on the triangle.
    farthest: f64,
    nearest: f64,
}

impl Plane {
    #[inline]
    fn new(a: ScreenPoint, b: ScreenPoint, c: ScreenPoint) -> Self {
        // From the farthest corner: one that was clipped at the near plane lies so far outside the image that
        // differences from it round away what is inside.
        let at = |point: ScreenPoint| point.inverse_depth;
        let (a, b, c) = if at(b) < at(a) && at(b) <= at(c) {
            (b, c, a)
        } else if at(c) < at(a) {
            (c, a, b)
        } else {
            (a, b, c)
        };
        let (ux, uy, u) = (b.x - a.x, b.y - a.y, b.inverse_depth - a.inverse_depth);
        let (vx, vy, v) = (c.x - a.x, c.y - a.y, c.inverse_depth - a.inverse_depth);
        let per_area = (ux * vy - uy * vx).recip();
        let finite = |slope: f64| if slope.is_finite() { slope } else { 0.0 };
        Self {
            corner: a,
            slope_x: finite((u * vy - v * uy) * per_area),
            slope_y: finite((v * ux - u * vx) * per_area),
            farthest: at(a),
            nearest: upper(at(b), at(c)),
        }
    }

    #[inline]
    fn inverse_depth(&self, x: f64, y: f64) -> f64 {
        let row = self.corner.inverse_depth + self.slope_y * (y - self.corner.y);
        let value = row + self.slope_x * (x - self.corner.x);
        lower(upper(value, self.farthest), self.nearest)
    }
}

/// The columns of a row that a triangle covers. Along a row each edge function is monotone, in floating point too, so
/// what is inside an edge is a half line: its end is estimated, then settled by exact tests.
fn span(edges: &[Edge; 3], columns: &Range<usize>, y: f64) -> Range<usize> {
    let (mut first, mut end) = (columns.start, columns.end);
    for edge in edges {
        let holds = |column: usize| edge.holds(column as f64 + 0.5, y);
        let crossing = edge.x + edge.dx * (y - edge.y) / edge.dy;
        let estimate = (crossing.max(columns.start as f64) as usize).min(columns.end);
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
    first..end
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::CameraIntrinsics;
    use glam::DAffine3;
    use proptest::prelude::{Strategy, any, prop_assert, prop_assert_eq, proptest};

    fn camera() -> Camera {
        let intrinsics = CameraIntrinsics {
            fx: 30.0,
            fy: 33.0,
            cx: 14.2,
            cy: 21.7,
            width: 37,
            height: 29,
        };
        Camera::new(intrinsics, DAffine3::IDENTITY).expect("valid")
    }

    /// A quilt over the whole image: a grid of vertices at random depths, two triangles a cell; the jitter is too small
    /// to fold it over.
    fn quilt() -> impl Strategy<Value = Mesh> {
        const N: usize = 7;
        proptest::collection::vec((-0.2..0.2, -0.2..0.2, 1.0..3.0), N * N).prop_map(|jitter| {
            let camera = camera();
            let positions = jitter.iter().enumerate().map(|(index, (x, y, depth))| {
                let (column, row) = ((index % N) as f64, (index / N) as f64);
                let px = DVec2::new((column + x) * 9.0 - 8.0, (row + y) * 7.0 - 6.0);
                camera.unproject(px, *depth)
            });
            let cell = |index: usize| {
                let corner = (index / (N - 1) * N + index % (N - 1)) as u32;
                let n = N as u32;
                [
                    [corner, corner + 1, corner + n],
                    [corner + 1, corner + n + 1, corner + n],
                ]
            };
            Mesh::new(
                positions.collect(),
                (0..(N - 1) * (N - 1)).flat_map(cell).collect(),
            )
            .expect("valid")
        })
    }

    fn grid(samples: usize) -> Grid {
        Grid {
            samples: samples as f64,
            columns: 37 * samples as u32,
            rows: 0..29 * samples as u32,
        }
    }

    fn hits(mesh: &Mesh, samples: usize) -> Vec<u32> {
        let (camera, drawable) = (camera(), Drawable::new(mesh));
        let view = View::new(&drawable, &camera, samples);
        let mut projected = Projected {
            points: [ScreenPoint::default(); VERTICES],
            boxes: [SampleBox::default(); VERTICES],
        };
        let mut hits = vec![0; 37 * 29 * samples * samples];
        for cluster in drawable.clusters() {
            view.scan(
                cluster,
                &grid(samples),
                &mut projected,
                |row, column, _, _| {
                    hits[row * 37 * samples + column] += 1;
                },
            );
        }
        hits
    }

    proptest! {
        #[test]
        fn shared_edges_leave_no_gap_and_no_overlap(mesh in quilt(), samples in 1_usize..5) {
            prop_assert!(hits(&mesh, samples).iter().all(|count| *count == 1));
        }

        #[test]
        fn order_of_triangles_does_not_matter(mesh in quilt(), turn in 1_usize..70, depth in 1.0..3.0) {
            let mut soup = mesh;
            let corners = [(-5.0, 3.0), (30.0, -8.0), (25.0, 40.0)];
            let first = soup.positions.len() as u32;
            soup.positions.extend(corners.map(|(x, y)| camera().unproject(DVec2::new(x, y), depth)));
            soup.triangles.push([first, first + 1, first + 2]);
            let before = rasterize(&soup, &camera());
            let mut turned = soup.clone();
            turned.triangles.rotate_left(turn);
            let after = rasterize(&turned, &camera());
            prop_assert_eq!(&before.depth, &after.depth);
            for (old, new) in before.triangle.iter().zip(&after.triangle) {
                prop_assert_eq!(soup.triangles[*old as usize], turned.triangles[*new as usize]);
            }
        }

        #[test]
        fn wide_and_narrow_rows_agree_with_the_edge_functions(
            corners in proptest::array::uniform6(-20.0..60.0_f64), flip in any::<bool>(),
        ) {
            let [ax, ay, bx, by, cx, cy] = corners.map(|value| if flip { (value * 2.0).round() / 2.0 } else { value });
            let point = |x, y| ScreenPoint { x, y, inverse_depth: 1.0 };
            let mut screen = [point(ax, ay), point(bx, by), point(cx, cy)];
            let mut drawn = vec![0; 37 * 29];
            let samples = SampleBox::join(screen.each_ref().map(|point| grid(1).around(point)));
            scan(&screen, &samples, &mut |row, column, _| drawn[row * 37 + column] += 1);
            let area = Edge::new(screen[0], screen[1]).value(cx, cy);
            if area < 0.0 {
                screen.swap(1, 2);
            }
            for (index, drawn) in drawn.iter().enumerate() {
                let (x, y) = ((index % 37) as f64 + 0.5, (index / 37) as f64 + 0.5);
                let inside = (0..3).all(|i| Edge::new(screen[i], screen[(i + 1) % 3]).holds(x, y));
                prop_assert_eq!(*drawn, i32::from(inside && area != 0.0));
            }
        }
    }

    #[test]
    fn corners_exactly_on_samples_belong_to_one_triangle() {
        // A fan around a vertex that projects exactly onto a pixel centre.
        let intrinsics = CameraIntrinsics {
            fx: 8.0,
            fy: 8.0,
            cx: 4.5,
            cy: 4.5,
            width: 37,
            height: 29,
        };
        let camera = Camera::new(intrinsics, DAffine3::IDENTITY).expect("valid");
        let at = |x: f64, y: f64| camera.unproject(DVec2::new(x, y), 2.0);
        let ring = [at(1.5, 1.5), at(8.5, 1.5), at(8.5, 8.5), at(1.5, 8.5)];
        let positions = std::iter::once(at(4.5, 4.5)).chain(ring).collect();
        let mesh =
            Mesh::new(positions, vec![[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 1]]).expect("valid");
        let raster = rasterize(&mesh, &camera);
        let covered: Vec<usize> = (0..raster.triangle.len())
            .filter(|i| raster.triangle[*i] != NO_TRIANGLE)
            .collect();
        // Left and top borders are inside, right and bottom ones are not.
        assert_eq!(covered.len(), 7 * 7);
        assert_eq!(covered[0], 37 + 1);
        assert!(
            covered
                .iter()
                .all(|index| (raster.depth[*index] - 2.0).abs() < 1e-6)
        );
    }

    #[test]
    fn ties_go_to_the_triangle_whose_corners_come_first() {
        let camera = camera();
        let at = |x: f64, y: f64| camera.unproject(DVec2::new(x, y), 2.0);
        // Vertex 2 lies between the others by its coordinates.
        let positions = vec![at(0.0, 0.0), at(80.0, 0.0), at(0.0, 80.0)];
        let ways = [[0, 1, 2], [0, 2, 1], [1, 2, 0], [0, 2, 1]];
        for turn in 0..ways.len() {
            let mut triangles = ways.to_vec();
            triangles.rotate_left(turn);
            let first = triangles.iter().position(|way| *way == [0, 2, 1]);
            // Put together by hand: a valid mesh holds no copies.
            let mut mesh = Mesh::new(positions.clone(), vec![[0, 1, 2]]).expect("valid");
            mesh.triangles = triangles;
            let drawn = rasterize(&mesh, &camera).triangle;
            assert!(
                drawn
                    .iter()
                    .all(|triangle| Some(*triangle as usize) == first)
            );
        }
    }

    #[test]
    fn a_floor_that_passes_under_the_camera_is_clipped() {
        let camera = camera();
        // The plane y = 1, from far behind the camera to far in front.
        let corner = |x: f64, z: f64| DVec3::new(x, 1.0, z);
        let positions = vec![
            corner(-900.0, -50.0),
            corner(900.0, -50.0),
            corner(0.0, 4000.0),
        ];
        let mesh = Mesh::new(positions, vec![[0, 1, 2]]).expect("valid");
        let raster = rasterize(&mesh, &camera);
        for row in 0..29 {
            for column in 0..37 {
                let index = row * 37 + column;
                let ray = camera
                    .intrinsics
                    .ray(DVec2::new(column as f64 + 0.5, row as f64 + 0.5));
                let depth = ray.y.recip();
                if ray.y > 0.0 && depth < 1000.0 {
                    assert!(
                        (f64::from(raster.depth[index]) / depth - 1.0).abs() < 1e-6,
                        "{column} {row}"
                    );
                } else if ray.y <= 0.0 {
                    assert_eq!(raster.triangle[index], NO_TRIANGLE);
                }
            }
        }
    }

    #[test]
    fn what_is_not_finite_is_not_drawn() {
        let camera = camera();
        let at = |x: f64, y: f64| camera.unproject(DVec2::new(x, y), 2.0);
        let mut mesh = Mesh::new(
            vec![at(0.0, 0.0), at(80.0, 0.0), at(0.0, 80.0)],
            vec![[0, 1, 2]],
        )
        .expect("valid");
        mesh.triangles.push([0, 1, 77]);
        assert!(
            rasterize(&mesh, &camera)
                .triangle
                .iter()
                .all(|triangle| *triangle == 0)
        );
        for bad in [f64::NAN, f64::INFINITY, 1e308] {
            let mut broken = mesh.clone();
            broken.positions[1].x = bad;
            let raster = rasterize(&broken, &camera);
            assert!(raster.depth.iter().all(|depth| depth.is_finite()));
            let mut camera = camera;
            camera.intrinsics.fx = bad;
            assert!(
                rasterize(&mesh, &camera)
                    .depth
                    .iter()
                    .all(|depth| depth.is_finite())
            );
            camera.camera_from_world.translation.z = bad;
            assert!(
                rasterize(&mesh, &camera)
                    .depth
                    .iter()
                    .all(|depth| depth.is_finite())
            );
        }
        let empty = camera.with_intrinsics(CameraIntrinsics {
            width: 0,
            ..camera.intrinsics
        });
        assert!(rasterize(&mesh, &empty).depth.is_empty());
        assert_eq!(barycentric(&mesh, &camera, 9, DVec2::ZERO), None);
    }
}
