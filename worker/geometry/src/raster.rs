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
//! - Whatever is not finite, also as the f32 that maps are made of, is not drawn.

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
            let rows = bins.rows(band);
            nearest(&scene, &bins, band, 1, width, keys);
            for (index, (pixel, key)) in pixels.iter_mut().zip(keys.iter()).enumerate() {
                let place = DVec2::new((index % width) as f64, (rows.start + index / width) as f64);
                if let Some(triangle) = key_triangle(*key)
                    && let Some((_, depth)) = scene.surface(triangle, place + 0.5)
                {
                    *pixel = (depth as f32, triangle);
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

/// Fills `keys` with the nearest triangle at each sample of a band; samples lie row-major, `width * samples` a row.
pub(crate) fn nearest(
    scene: &Projected<'_>,
    bins: &Bins,
    band: usize,
    samples: usize,
    width: usize,
    keys: &mut Vec<u64>,
) {
    let rows = bins.rows(band);
    let row_samples = width * samples;
    keys.clear();
    keys.resize(rows.len() * samples * row_samples, u64::MAX);
    bins.for_each_triangle(band, |triangle| {
        scene.scan(
            triangle,
            samples,
            width,
            &rows,
            |row, column, inverse_depth| {
                let key = &mut keys[(row - rows.start * samples) * row_samples + column];
                keep_nearest(key, inverse_depth, triangle);
            },
        );
    });
}

/// Depth test. A key orders by nearness (bits of a positive float order like the float), then by triangle index.
#[inline]
fn keep_nearest(key: &mut u64, inverse_depth: f64, triangle: u32) {
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

    /// Corner weights and depth where the ray through `px` meets a triangle; `None` when it is seen edge-on, up to
    /// rounding, or so far or near that f32 cannot hold its depth.
    pub(crate) fn surface(&self, triangle: u32, px: DVec2) -> Option<([f64; 3], f64)> {
        let points =
            self.mesh.triangles[triangle as usize].map(|corner| self.points[corner as usize]);
        let weights = weights(points, self.camera.intrinsics.ray(px))?;
        let depth: f64 = weights
            .iter()
            .zip(&points)
            .map(|(weight, point)| weight * point.z)
            .sum();
        (depth as f32 > 0.0 && (depth as f32).is_finite()).then_some((weights, depth))
    }

    /// Calls `put(row, column, 1/depth)` for each sample that a triangle covers, within the pixel rows `rows` of an
    /// image `width` pixels wide, on a grid of `samples` x `samples` samples a pixel; rows and columns are those of
    /// samples.
    #[inline]
    pub(crate) fn scan(
        &self,
        triangle: u32,
        samples: usize,
        width: usize,
        rows: &Range<usize>,
        mut put: impl FnMut(usize, usize, f64),
    ) {
        self.for_each_screen_triangle(triangle, |screen| {
            scan(screen, samples, width, rows, &mut put);
        });
    }

    /// Calls `each` with what of a triangle lies in front of the near plane, as triangles on the screen.
    #[inline]
    fn for_each_screen_triangle(&self, triangle: u32, mut each: impl FnMut(&[ScreenPoint; 3])) {
        let Some(corners) = self.existing(self.mesh.triangles[triangle as usize]) else {
            return;
        };
        let screen = corners.map(|corner| self.screen[corner]);
        if screen.iter().all(|point| point.inverse_depth > 0.0) {
            each(&screen);
        } else if !screen.iter().any(|point| point.inverse_depth.is_nan()) {
            self.clipped(corners).iter().flatten().for_each(each);
        }
    }

    fn existing(&self, corners: [u32; 3]) -> Option<[usize; 3]> {
        let corners = corners.map(|corner| corner as usize);
        corners
            .iter()
            .all(|corner| *corner < self.screen.len())
            .then_some(corners)
    }

    /// Sutherland-Hodgman against the near plane: up to four corners, as a fan.
    #[cold]
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
                    self.for_each_screen_triangle(triangle, |screen| {
                        for &samples in grids {
                            let (columns, rows) = sample_box(screen, samples, width, &(0..height));
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
                    });
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

/// Columns and rows of the samples that a triangle's bounding box may hold, within the image and the pixel rows
/// `rows`. May hold a few that the triangle does not cover: the edge functions decide.
fn sample_box(
    [a, b, c]: &[ScreenPoint; 3],
    samples: usize,
    width: usize,
    rows: &Range<usize>,
) -> (Range<usize>, Range<usize>) {
    let scale = samples as f64;
    // Sample i lies at i + 0.5: it is at or above `low` from ceil(low - 0.5) on, at or below `high` up to
    // floor(high - 0.5). A cast cuts off like floor, and sends what is too small (or NaN) to 0; both are many times
    // cheaper than the library's rounding.
    let range = |low: f64, high: f64, limits: Range<usize>| {
        let first = upper(low * scale + (0.5 - BOX_SLACK), limits.start as f64) as usize;
        let end = lower(high * scale + (0.5 + BOX_SLACK), limits.end as f64) as usize;
        first..end
    };
    (
        range(
            lower(lower(a.x, b.x), c.x),
            upper(upper(a.x, b.x), c.x),
            0..width * samples,
        ),
        range(
            lower(lower(a.y, b.y), c.y),
            upper(upper(a.y, b.y), c.y),
            rows.start * samples..rows.end * samples,
        ),
    )
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

/// Draws one triangle that lies wholly in front of the near plane; see [`Projected::scan`].
#[inline]
fn scan(
    screen: &[ScreenPoint; 3],
    samples: usize,
    width: usize,
    rows: &Range<usize>,
    put: &mut impl FnMut(usize, usize, f64),
) {
    let (columns, rows) = sample_box(screen, samples, width, rows);
    if columns.is_empty() || rows.is_empty() {
        return;
    }
    // From here on in units of samples: sample i lies exactly at i + 0.5. Scaling moves a vertex by a rounding, but
    // for all its triangles alike.
    let scale = samples as f64;
    let [a, mut b, mut c] = screen.map(|point| ScreenPoint {
        x: point.x * scale,
        y: point.y * scale,
        ..point
    });
    let area = Edge::new(a, b).value(c.x, c.y);
    if area == 0.0 || area.is_nan() {
        return;
    }
    if area < 0.0 {
        std::mem::swap(&mut b, &mut c);
    }
    let edges = [Edge::new(a, b), Edge::new(b, c), Edge::new(c, a)];
    // 1/depth is affine on the screen. The bounds keep slivers, whose slopes are all rounding, on the triangle.
    let (ux, uy, u) = (b.x - a.x, b.y - a.y, b.inverse_depth - a.inverse_depth);
    let (vx, vy, v) = (c.x - a.x, c.y - a.y, c.inverse_depth - a.inverse_depth);
    let per_area = (ux * vy - uy * vx).recip();
    let finite = |slope: f64| if slope.is_finite() { slope } else { 0.0 };
    let slope_x = finite((u * vy - v * uy) * per_area);
    let slope_y = finite((v * ux - u * vx) * per_area);
    let farthest = lower(lower(a.inverse_depth, b.inverse_depth), c.inverse_depth);
    let nearest = upper(upper(a.inverse_depth, b.inverse_depth), c.inverse_depth);
    for row in rows {
        let y = row as f64 + 0.5;
        let row_depth = a.inverse_depth + slope_y * (y - a.y);
        let mut emit = |column: usize, x: f64| {
            put(
                row,
                column,
                lower(upper(row_depth + slope_x * (x - a.x), farthest), nearest),
            );
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

    fn hits(mesh: &Mesh, samples: usize) -> Vec<u32> {
        let camera = camera();
        let scene = Projected::new(mesh, &camera);
        let mut hits = vec![0; 37 * 29 * samples * samples];
        for triangle in 0..mesh.triangles.len() as u32 {
            scene.scan(triangle, samples, 37, &(0..29), |row, column, _| {
                hits[row * 37 * samples + column] += 1;
            });
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
            scan(&screen, 1, 37, &(0..29), &mut |row, column, _| drawn[row * 37 + column] += 1);
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
    fn ties_go_to_the_lower_index() {
        let camera = camera();
        let at = |x: f64, y: f64| camera.unproject(DVec2::new(x, y), 2.0);
        let positions = vec![at(0.0, 0.0), at(80.0, 0.0), at(0.0, 80.0)];
        let mesh = Mesh::new(positions, vec![[0, 1, 2], [0, 2, 1], [1, 2, 0]]).expect("valid");
        assert!(
            rasterize(&mesh, &camera)
                .triangle
                .iter()
                .all(|triangle| *triangle == 0)
        );
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
