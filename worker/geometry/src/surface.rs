//! A surface through the points of a reconstruction, for captures that come without a mesh.
//!
//! How it works: normals by principal components of the neighbours, turned towards the views that saw the point; a
//! signed distance on a regular grid as the weighted mean of the neighbours' tangent planes (implicit moving least
//! squares: Kolluri 2005); its zero surface by surface nets (Gibson 1998); only the large components are kept.
//! Without masks the surface ends where the points end. With masks it is also cut by the visual hull, and closed by it
//! where there are no points: there a place is inside if every mask says so and no view looks through it at a point
//! behind.
//!
//! The result is a proxy, not a scan: about as fine as the points are dense.

use glam::{DMat3, DVec3};
use rayon::prelude::*;

use crate::neighbours::Neighbours;
use crate::simplify::compact;
use crate::{Camera, Mesh};

/// Neighbours whose plane gives a point's normal, and whose planes give the distance.
const NEIGHBOURS: usize = 12;
/// The neighbour by whose distance the density is measured.
const DENSITY_NEIGHBOUR: usize = 8;
/// Points whose neighbours are so many times farther away than is usual are left out.
const OUTLIER: f64 = 4.0;
/// A place is supported by points up to this many spacings away.
const SUPPORT_SPACINGS: f64 = 2.5;
/// Cells of the grid along the diagonal of its box, at least and at most.
const CELLS: (f64, f64) = (96.0, 192.0);
/// Size of a cell in spacings, within those limits.
const CELL_SPACINGS: f64 = 0.7;
/// Room around the points, as a share of their diagonal, that the masks may fill.
const HULL_ROOM: f64 = 0.1;
/// Components with less than this share of the largest one's area are dropped.
const LEAST_COMPONENT: f64 = 0.1;
/// Fewer points make no surface.
const LEAST_POINTS: usize = 100;
/// Half width of the ramp that a mask's edge is widened to, in pixels: there it measures distance.
const RAMP_PX: usize = 3;

/// A point of a reconstruction.
#[derive(Clone, Debug)]
pub struct SeenPoint {
    /// World frame.
    pub position: DVec3,
    /// 8-bit sRGB.
    pub color: [u8; 3],
    /// Indices of the views that saw it.
    pub views: Vec<usize>,
}

/// A view that saw points.
#[derive(Clone, Debug)]
pub struct PointView {
    /// Its camera, in the world frame.
    pub camera: Camera,
    /// Row-major share of the object in each pixel of the camera, if known.
    pub mask: Option<Vec<f32>>,
}

/// A surface made from points.
#[derive(Clone, Debug)]
pub struct PointSurface {
    /// The surface, with the colours of the nearest points.
    pub mesh: Mesh,
    /// Points that it was made from: on the object, by the masks, and not alone.
    pub points: usize,
    /// Usual distance between neighbouring points.
    pub spacing: f64,
    /// Length of the open boundary, in edges, by the square root of the number of triangles: 0 for a closed surface,
    /// about 3 for a disc, large for a surface of patches.
    pub raggedness: f64,
}

/// Why points make no surface.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum SurfaceError {
    /// Too few points, or too few of them on the object.
    #[error("{usable} of {points} points are usable, at least {LEAST_POINTS} are needed")]
    TooFewPoints {
        /// Points on the object that are not alone.
        usable: usize,
        /// All points.
        points: usize,
    },
    /// The points' distance has no zero surface.
    #[error("the points lie on no surface")]
    NoSurface,
}

/// Builds a surface through `points`, seen by `views`. The masks are used when every view has one.
///
/// # Errors
/// [`SurfaceError`] when there are too few points or they lie on no surface.
pub fn surface_from_points(
    points: &[SeenPoint],
    views: &[PointView],
) -> Result<PointSurface, SurfaceError> {
    let too_few = |usable| SurfaceError::TooFewPoints {
        usable,
        points: points.len(),
    };
    let ramps: Option<Vec<Ramp>> = views
        .par_iter()
        .map(|view| Some(Ramp::new(&view.camera, view.mask.as_ref()?)))
        .collect();
    let ramps = ramps.filter(|ramps| !ramps.is_empty());
    let on_object = |point: &&SeenPoint| match &ramps {
        _ if !point.position.is_finite() || point.views.is_empty() => false,
        None => true,
        Some(ramps) => {
            let inside = point.views.iter().filter(|&&view| {
                let ramp = ramps.get(view);
                ramp.and_then(|ramp| ramp.inside(point.position))
                    .is_some_and(|inside| inside > -1.5)
            });
            2 * inside.count() > point.views.len()
        }
    };
    let mut used: Vec<&SeenPoint> = points.iter().filter(on_object).collect();
    if used.len() < LEAST_POINTS {
        return Err(too_few(used.len()));
    }
    let radii = density_radii(&used);
    let usual = median(radii.clone());
    let mut radii = radii.into_iter();
    used.retain(|_| radii.next().is_some_and(|radius| radius <= OUTLIER * usual));
    if used.len() < LEAST_POINTS {
        return Err(too_few(used.len()));
    }
    let cloud = Cloud::new(&used, views);
    let depths = match &ramps {
        Some(_) => sparse_depths(&used, views, cloud.spacing),
        None => Vec::new(),
    };
    let hull = ramps.map(|ramps| Hull {
        ramps,
        depths,
        spacing: cloud.spacing,
    });
    let grid = Grid::around(&cloud, hull.is_some());
    let field = grid.field(&cloud, hull.as_ref());
    let (positions, triangles) = grid.zero_surface(&field);
    let triangles = large_components(&positions, triangles);
    let raggedness = raggedness(&triangles);
    let mut mesh = Mesh::new(positions, triangles).map_err(|_error| SurfaceError::NoSurface)?;
    mesh = compact(&mesh, &mesh.triangles).ok_or(SurfaceError::NoSurface)?;
    let mut found = Vec::new();
    mesh.colors = mesh
        .positions
        .iter()
        .map(|place| {
            cloud.tree.nearest(*place, 1, f64::INFINITY, &mut found);
            found.first().map(|&(_, index)| used[index as usize].color)
        })
        .collect();
    Ok(PointSurface {
        mesh,
        points: used.len(),
        spacing: cloud.spacing,
        raggedness,
    })
}

fn median(mut values: Vec<f64>) -> f64 {
    let middle = values.len() / 2;
    if values.is_empty() {
        return 0.0;
    }
    *values.select_nth_unstable_by(middle, f64::total_cmp).1
}

/// Distance of each point to its [`DENSITY_NEIGHBOUR`]th.
fn density_radii(points: &[&SeenPoint]) -> Vec<f64> {
    let positions: Vec<DVec3> = points.iter().map(|point| point.position).collect();
    let tree = Neighbours::new(&positions);
    positions
        .par_iter()
        .map_init(Vec::new, |found, place| {
            tree.nearest(*place, DENSITY_NEIGHBOUR + 1, f64::INFINITY, found);
            found.last().map_or(0.0, |&(squared, _)| squared.sqrt())
        })
        .collect()
}

/// Points with normals.
struct Cloud {
    positions: Vec<DVec3>,
    normals: Vec<DVec3>,
    /// Distance to the next points, per point.
    spacings: Vec<f64>,
    spacing: f64,
    tree: Neighbours,
}

impl Cloud {
    fn new(points: &[&SeenPoint], views: &[PointView]) -> Self {
        let positions: Vec<DVec3> = points.iter().map(|point| point.position).collect();
        let tree = Neighbours::new(&positions);
        let centers: Vec<DVec3> = views.iter().map(|view| view.camera.center()).collect();
        let raw: Vec<DVec3> = points
            .par_iter()
            .map_init(Vec::new, |found, point| {
                let toward: DVec3 = point
                    .views
                    .iter()
                    .filter_map(|&view| (centers.get(view)? - point.position).try_normalize())
                    .sum();
                tree.nearest(point.position, NEIGHBOURS, f64::INFINITY, found);
                normal(&positions, found, toward)
            })
            .collect();
        // The neighbours' normals smooth the noise of each.
        let normals = positions
            .par_iter()
            .map_init(Vec::new, |found, place| {
                tree.nearest(*place, NEIGHBOURS, f64::INFINITY, found);
                let sum: DVec3 = found.iter().map(|&(_, index)| raw[index as usize]).sum();
                sum.normalize_or_zero()
            })
            .collect();
        // On a surface with one point per square of this side, pi r^2 holds as many points as there are in radius r.
        let per_radius = (std::f64::consts::PI / DENSITY_NEIGHBOUR as f64).sqrt();
        let raw: Vec<f64> = density_radii(points)
            .into_iter()
            .map(|radius| radius * per_radius)
            .collect();
        let spacing = median(raw.clone()).max(f64::MIN_POSITIVE);
        let spacings = raw
            .into_iter()
            .map(|own| own.clamp(0.5 * spacing, 2.0 * spacing))
            .collect();
        Self {
            positions,
            normals,
            spacings,
            spacing,
            tree,
        }
    }

    /// Signed distance to the surface, positive outside; `None` where no point is near.
    fn distance(&self, place: DVec3, found: &mut Vec<(f64, u32)>) -> Option<f64> {
        let reach = 2.0 * SUPPORT_SPACINGS * self.spacing;
        self.tree.nearest(place, NEIGHBOURS, reach, found);
        let &(nearest, index) = found.first()?;
        let spacing = self.spacings[index as usize];
        if nearest.sqrt() > SUPPORT_SPACINGS * spacing {
            return None;
        }
        let (mut sum, mut weights) = (0.0, 0.0);
        for &(squared, index) in &*found {
            let index = index as usize;
            // Relative to the nearest, so that the weights do not vanish far from all points.
            let weight = (-(squared - nearest) / (spacing * spacing)).exp();
            sum += weight * self.normals[index].dot(place - self.positions[index]);
            weights += weight;
        }
        Some(sum / weights)
    }
}

/// Unit direction in which the neighbours `found` spread least, on the side of `toward`.
fn normal(positions: &[DVec3], found: &[(f64, u32)], toward: DVec3) -> DVec3 {
    let near = || found.iter().map(|&(_, index)| positions[index as usize]);
    let mean = near().sum::<DVec3>() / found.len().max(1) as f64;
    let mut spread = DMat3::ZERO;
    for place in near() {
        let off = place - mean;
        spread += DMat3::from_cols(off * off.x, off * off.y, off * off.z);
    }
    let trace = spread.x_axis.x + spread.y_axis.y + spread.z_axis.z;
    let toward = toward.normalize_or_zero();
    if !(trace > 0.0 && trace.is_finite()) {
        return toward;
    }
    // Inverse iteration: the smallest eigenvalue's direction grows fastest. It starts towards the views.
    let inverse = (spread * trace.recip() + DMat3::IDENTITY * 1e-6).inverse();
    let mut direction = toward + DVec3::new(1e-3, 2e-3, 3e-3);
    for _ in 0..8 {
        direction = (inverse * direction).normalize_or_zero();
    }
    if direction.dot(toward) < 0.0 {
        -direction
    } else {
        direction
    }
}

/// A mask whose edge is widened to a ramp, which measures the distance to it in pixels.
struct Ramp {
    camera: Camera,
    /// Row-major, in pixels; positive inside.
    inside: Vec<f32>,
}

impl Ramp {
    fn new(camera: &Camera, mask: &[f32]) -> Self {
        let width = camera.intrinsics.width as usize;
        let mut along = vec![0.0; mask.len()];
        let mut across = vec![0.0; mask.len()];
        let height = mask.len() / width.max(1);
        let mean = |values: &[f32], at: usize, stride: usize, place: usize, count: usize| {
            let first = place.saturating_sub(RAMP_PX);
            let last = (place + RAMP_PX).min(count - 1);
            let start = at - (place - first) * stride;
            let sum: f32 = (0..=last - first)
                .map(|step| values[start + step * stride])
                .sum();
            sum / (last - first + 1) as f32
        };
        for (at, value) in along.iter_mut().enumerate() {
            *value = mean(mask, at, 1, at % width, width);
        }
        for (at, value) in across.iter_mut().enumerate() {
            *value = mean(&along, at, width, at / width, height);
        }
        let slope = (2 * RAMP_PX + 1) as f32;
        Self {
            camera: *camera,
            inside: across.iter().map(|share| (share - 0.5) * slope).collect(),
        }
    }

    /// Pixels from the mask's edge, positive inside; `None` outside the picture and behind the camera.
    fn inside(&self, place: DVec3) -> Option<f64> {
        let seen = self.camera.project(place)?;
        let intrinsics = &self.camera.intrinsics;
        if !intrinsics.contains(seen.px) {
            return None;
        }
        let (width, height) = (intrinsics.width as usize, intrinsics.height as usize);
        let at = (seen.px - 0.5).max(glam::DVec2::ZERO);
        let (x, y) = (
            (at.x as usize).min(width - 1),
            (at.y as usize).min(height - 1),
        );
        let (right, below) = ((x + 1).min(width - 1), (y + 1).min(height - 1));
        let (fx, fy) = ((at.x - x as f64).min(1.0), (at.y - y as f64).min(1.0));
        let value = |x: usize, y: usize| f64::from(self.inside[y * width + x]);
        let top = value(x, y) * (1.0 - fx) + value(right, y) * fx;
        let bottom = value(x, below) * (1.0 - fx) + value(right, below) * fx;
        Some(top * (1.0 - fy) + bottom * fy)
    }
}

/// Per view, a coarse picture of the depth of the nearest points that it saw; 0 where it saw none.
struct SparseDepth {
    camera: Camera,
    nearest: Vec<f32>,
}

fn sparse_depths(points: &[&SeenPoint], views: &[PointView], spacing: f64) -> Vec<SparseDepth> {
    views
        .par_iter()
        .enumerate()
        .map(|(index, view)| {
            let seen: Vec<_> = points
                .iter()
                .filter(|point| point.views.contains(&index))
                .filter_map(|point| view.camera.project(point.position))
                .collect();
            let depth = median(seen.iter().map(|seen| seen.depth).collect()).max(f64::MIN_POSITIVE);
            let intrinsics = view.camera.intrinsics;
            // One pixel is about as wide as the points are apart.
            let scale = (depth / (intrinsics.fx.max(intrinsics.fy) * spacing)).min(1.0);
            let side = |pixels: u32| ((f64::from(pixels) * scale).ceil() as u32).max(1);
            let small = intrinsics.resized(side(intrinsics.width), side(intrinsics.height));
            let (width, height) = (small.width as usize, small.height as usize);
            let mut nearest = vec![0.0_f32; width * height];
            for seen in seen {
                if !intrinsics.contains(seen.px) {
                    continue;
                }
                let column =
                    (seen.px.x * f64::from(small.width) / f64::from(intrinsics.width)) as usize;
                let row =
                    (seen.px.y * f64::from(small.height) / f64::from(intrinsics.height)) as usize;
                let (column, row) = (column.min(width - 1), row.min(height - 1));
                for y in row.saturating_sub(1)..(row + 2).min(height) {
                    for x in column.saturating_sub(1)..(column + 2).min(width) {
                        let place = &mut nearest[y * width + x];
                        if *place == 0.0 || f64::from(*place) > seen.depth {
                            *place = seen.depth as f32;
                        }
                    }
                }
            }
            SparseDepth {
                camera: view.camera.with_intrinsics(small),
                nearest,
            }
        })
        .collect()
}

/// What the masks, and the views through empty space, say about a place.
struct Hull {
    ramps: Vec<Ramp>,
    depths: Vec<SparseDepth>,
    spacing: f64,
}

impl Hull {
    /// Signed distance to the visual hull, positive outside; right near its surface, a bound elsewhere.
    fn distance(&self, place: DVec3) -> f64 {
        let mut outside = f64::NEG_INFINITY;
        for ramp in &self.ramps {
            let Some(inside) = ramp.inside(place) else {
                continue;
            };
            let depth = ramp.camera.camera_from_world.transform_point3(place).z;
            let footprint = depth / ramp.camera.intrinsics.fx;
            outside = outside.max(-inside * footprint);
            if inside < -(RAMP_PX as f64) {
                break;
            }
        }
        if outside == f64::NEG_INFINITY {
            self.spacing
        } else {
            outside
        }
    }

    /// How far in front of what a view saw behind it the place lies; positive: it is empty.
    fn seen_through(&self, place: DVec3) -> f64 {
        let margin = SUPPORT_SPACINGS * self.spacing;
        self.depths
            .iter()
            .filter_map(|view| {
                let seen = view.camera.project(place)?;
                let intrinsics = &view.camera.intrinsics;
                if !intrinsics.contains(seen.px) {
                    return None;
                }
                let column = (seen.px.x as usize).min(intrinsics.width as usize - 1);
                let row = (seen.px.y as usize).min(intrinsics.height as usize - 1);
                let nearest = view.nearest[row * intrinsics.width as usize + column];
                (nearest > 0.0).then(|| f64::from(nearest) - margin - seen.depth)
            })
            .fold(f64::NEG_INFINITY, f64::max)
    }
}

/// A regular grid of places.
struct Grid {
    origin: DVec3,
    cell: f64,
    size: [usize; 3],
}

impl Grid {
    fn around(cloud: &Cloud, with_hull: bool) -> Self {
        let (mut low, mut high) = cloud.positions.iter().fold(
            (DVec3::INFINITY, DVec3::NEG_INFINITY),
            |(low, high), place| (low.min(*place), high.max(*place)),
        );
        let room = if with_hull {
            HULL_ROOM * low.distance(high)
        } else {
            0.0
        };
        let room = DVec3::splat(room + 3.0 * cloud.spacing);
        low -= room;
        high += room;
        let diagonal = low.distance(high);
        let cell = (CELL_SPACINGS * cloud.spacing).clamp(diagonal / CELLS.1, diagonal / CELLS.0);
        let size = ((high - low) / cell)
            .to_array()
            .map(|cells| cells.ceil() as usize + 2);
        Self {
            origin: low,
            cell,
            size,
        }
    }

    fn place(&self, [x, y, z]: [usize; 3]) -> DVec3 {
        self.origin + DVec3::new(x as f64, y as f64, z as f64) * self.cell
    }

    fn index(&self, [x, y, z]: [usize; 3]) -> usize {
        (z * self.size[1] + y) * self.size[0] + x
    }

    /// Signed distance at each node, positive outside; NaN where nothing is known.
    fn field(&self, cloud: &Cloud, hull: Option<&Hull>) -> Vec<f32> {
        let [width, height, depth] = self.size;
        let mut field = vec![f32::NAN; width * height * depth];
        field
            .par_chunks_mut(width)
            .enumerate()
            .for_each_init(Vec::new, |found, (row, values)| {
                for (x, value) in values.iter_mut().enumerate() {
                    let place = self.place([x, row % height, row / height]);
                    let hull_distance = hull.map_or(f64::NEG_INFINITY, |hull| hull.distance(place));
                    // Far outside the hull nothing else matters.
                    let distance = if hull_distance > 2.0 * self.cell {
                        hull_distance
                    } else if let Some(distance) = cloud.distance(place, found) {
                        distance.max(hull_distance)
                    } else if let Some(hull) = hull {
                        hull_distance.max(hull.seen_through(place))
                    } else {
                        continue;
                    };
                    *value = distance as f32;
                }
            });
        field
    }

    /// Surface nets: one vertex in each cell that the surface passes, at the mean of its crossings with the cell's
    /// edges; one quad for each edge that it crosses. Cells with an unknown corner are left out.
    fn zero_surface(&self, field: &[f32]) -> (Vec<DVec3>, Vec<[u32; 3]>) {
        const CORNERS: [[usize; 3]; 8] = [
            [0, 0, 0],
            [1, 0, 0],
            [0, 1, 0],
            [1, 1, 0],
            [0, 0, 1],
            [1, 0, 1],
            [0, 1, 1],
            [1, 1, 1],
        ];
        let [width, height, depth] = self.size;
        let mut vertex = vec![u32::MAX; field.len()];
        let mut positions = Vec::new();
        for z in 0..depth - 1 {
            for y in 0..height - 1 {
                for x in 0..width - 1 {
                    let values = CORNERS.map(|[i, j, k]| field[self.index([x + i, y + j, z + k])]);
                    let inside = values.iter().filter(|value| **value < 0.0).count();
                    if inside == 0 || inside == 8 || values.iter().any(|value| value.is_nan()) {
                        continue;
                    }
                    let (mut sum, mut count) = (DVec3::ZERO, 0.0);
                    for (first, a) in CORNERS.iter().enumerate() {
                        for axis in 0..3 {
                            let second = first | 1 << axis;
                            if a[axis] == 1 || (values[first] < 0.0) == (values[second] < 0.0) {
                                continue;
                            }
                            let along = values[first] / (values[first] - values[second]);
                            let mut crossing = DVec3::from_array(a.map(|corner| corner as f64));
                            crossing[axis] += f64::from(along);
                            sum += crossing;
                            count += 1.0;
                        }
                    }
                    vertex[self.index([x, y, z])] = positions.len() as u32;
                    positions.push(self.place([x, y, z]) + sum / count * self.cell);
                }
            }
        }
        let mut triangles = Vec::new();
        let strides = [1, width, width * height];
        for z in 1..depth - 1 {
            for y in 1..height - 1 {
                for x in 1..width - 1 {
                    let at = self.index([x, y, z]);
                    for axis in 0..3 {
                        let (here, there) = (field[at], field[at + strides[axis]]);
                        if here.is_nan() || there.is_nan() || (here < 0.0) == (there < 0.0) {
                            continue;
                        }
                        let (u, v) = (strides[(axis + 1) % 3], strides[(axis + 2) % 3]);
                        let around = [at - u - v, at - v, at, at - u].map(|cell| vertex[cell]);
                        if around.contains(&u32::MAX) {
                            continue;
                        }
                        // Counter-clockwise seen from outside, which is where the distance grows.
                        let [a, b, c, d] = if here < 0.0 {
                            around
                        } else {
                            [around[3], around[2], around[1], around[0]]
                        };
                        let length = |from: u32, to: u32| {
                            positions[from as usize].distance_squared(positions[to as usize])
                        };
                        if length(a, c) <= length(b, d) {
                            triangles.extend([[a, b, c], [a, c, d]]);
                        } else {
                            triangles.extend([[a, b, d], [b, c, d]]);
                        }
                    }
                }
            }
        }
        (positions, triangles)
    }
}

/// The vertex that stands for all that `vertex` is connected to.
fn root(parent: &mut [u32], mut vertex: u32) -> u32 {
    while parent[vertex as usize] != vertex {
        parent[vertex as usize] = parent[parent[vertex as usize] as usize];
        vertex = parent[vertex as usize];
    }
    vertex
}

/// The triangles of components that have a good share of the largest one's area.
fn large_components(positions: &[DVec3], triangles: Vec<[u32; 3]>) -> Vec<[u32; 3]> {
    let mut parent: Vec<u32> = (0..positions.len() as u32).collect();
    for [a, b, c] in &triangles {
        for (from, to) in [(*a, *b), (*b, *c)] {
            let (from, to) = (root(&mut parent, from), root(&mut parent, to));
            parent[from.max(to) as usize] = from.min(to);
        }
    }
    let mut areas = vec![0.0; positions.len()];
    for corners in &triangles {
        let [a, b, c] = corners.map(|corner| positions[corner as usize]);
        areas[root(&mut parent, corners[0]) as usize] += (b - a).cross(c - a).length();
    }
    let largest = areas.iter().copied().fold(0.0, f64::max);
    triangles
        .into_iter()
        .filter(|corners| {
            areas[root(&mut parent, corners[0]) as usize] >= LEAST_COMPONENT * largest
        })
        .collect()
}

fn raggedness(triangles: &[[u32; 3]]) -> f64 {
    let mut edges: Vec<(u32, u32)> = triangles
        .iter()
        .flat_map(|&[a, b, c]| [(a, b), (b, c), (c, a)])
        .map(|(a, b)| (a.min(b), a.max(b)))
        .collect();
    edges.par_sort_unstable();
    let open = edges
        .chunk_by(|a, b| a == b)
        .filter(|same| same.len() == 1)
        .count();
    open as f64 / (triangles.len() as f64).sqrt().max(1.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{CameraIntrinsics, coverage_map};
    use std::f64::consts::TAU;

    /// Radius of the true surface along a direction.
    fn radius(direction: DVec3) -> f64 {
        1.0 + 0.15 * (3.0 * direction.x).sin() * (2.0 * direction.z).cos()
    }

    fn cameras() -> Vec<Camera> {
        let intrinsics = CameraIntrinsics {
            fx: 230.0,
            fy: 220.0,
            cx: 84.0,
            cy: 77.0,
            width: 170,
            height: 150,
        };
        (0..16)
            .map(|at| {
                let turn = f64::from(at) * 2.4;
                let eye = DVec3::new(turn.cos(), turn.sin(), f64::from(at) / 8.0 - 0.9)
                    .normalize_or_zero()
                    * 5.0;
                Camera::look_at(intrinsics, eye, DVec3::ZERO, DVec3::Z).expect("camera")
            })
            .collect()
    }

    /// `count` points spread over the surface, with noise, and the views that see them; none where `gap` says so.
    fn points(
        count: usize,
        noise: f64,
        gap: impl Fn(DVec3) -> bool,
        cameras: &[Camera],
    ) -> Vec<SeenPoint> {
        let golden = TAU * (1.0 - 1.0 / 1.618_033_988_75);
        (0..count)
            .filter_map(|at| {
                let z = 1.0 - 2.0 * (at as f64 + 0.5) / count as f64;
                let turn = golden * at as f64;
                let ring = (1.0 - z * z).sqrt();
                let direction = DVec3::new(ring * turn.cos(), ring * turn.sin(), z);
                let wobble = noise * (12.9898 * at as f64).sin();
                let position = direction * (radius(direction) + wobble);
                let views = (0..cameras.len())
                    .filter(|&view| {
                        (cameras[view].center() - position)
                            .normalize_or_zero()
                            .dot(direction)
                            > 0.4
                    })
                    .collect();
                (!gap(direction)).then_some(SeenPoint {
                    position,
                    color: [at as u8, 1, 2],
                    views,
                })
            })
            .collect()
    }

    /// Largest and mean distance of the mesh's vertices from the true surface, and of the true surface's points from
    /// the mesh's vertices.
    fn distances(mesh: &Mesh) -> (f64, f64, f64) {
        let off: Vec<f64> = mesh
            .positions
            .iter()
            .map(|place| (place.length() - radius(place.normalize_or_zero())).abs())
            .collect();
        let tree = Neighbours::new(&mesh.positions);
        let mut found = Vec::new();
        let back = points(2000, 0.0, |_| false, &[])
            .iter()
            .map(|point| {
                tree.nearest(point.position, 1, f64::INFINITY, &mut found);
                found[0].0.sqrt()
            })
            .fold(0.0, f64::max);
        let largest = off.iter().copied().fold(0.0, f64::max);
        (largest, off.iter().sum::<f64>() / off.len() as f64, back)
    }

    fn views(cameras: &[Camera], truth: Option<&Mesh>) -> Vec<PointView> {
        cameras
            .iter()
            .map(|camera| PointView {
                camera: *camera,
                mask: truth.map(|mesh| coverage_map(mesh, camera, 1, 4)),
            })
            .collect()
    }

    #[test]
    fn dense_points_give_their_surface_closed() {
        let cameras = cameras();
        let points = points(4000, 0.004, |_| false, &cameras);
        let built = surface_from_points(&points, &views(&cameras, None)).expect("dense");
        let (largest, mean, back) = distances(&built.mesh);
        // The spacing is about 0.06, the noise 0.004, a cell's diagonal 0.07.
        assert!(
            largest < 0.02 && mean < 0.004 && back < 0.07,
            "{largest} {mean} {back}"
        );
        assert!(
            built.raggedness == 0.0 && (built.spacing - 0.06).abs() < 0.02,
            "{}",
            built.spacing
        );
        for corners in &built.mesh.triangles {
            let [a, b, c] = corners.map(|corner| built.mesh.positions[corner as usize]);
            assert!((b - a).cross(c - a).dot(a) > 0.0, "faces look outwards");
        }
        assert_eq!(
            built.mesh.colors.as_ref().map(Vec::len),
            Some(built.mesh.positions.len())
        );
    }

    #[test]
    fn a_gap_stays_open_without_masks_and_is_closed_by_them() {
        let cameras = cameras();
        let truth = surface_from_points(
            &points(6000, 0.0, |_| false, &cameras),
            &views(&cameras, None),
        )
        .expect("dense")
        .mesh;
        let mut gapped = points(3000, 0.002, |direction| direction.x > 0.75, &cameras);
        // A few points that the reconstruction got wrong, alone and off the object.
        for at in 0..20 {
            gapped.push(SeenPoint {
                position: DVec3::new(1.5 + 0.1 * f64::from(at), 1.0, f64::from(at % 3)),
                color: [0; 3],
                views: vec![0, 1],
            });
        }
        let open =
            surface_from_points(&gapped, &views(&cameras, None)).expect("dense but for the gap");
        assert!(open.raggedness > 0.5);
        assert!(open.mesh.positions.iter().all(|place| place.x < 1.0));
        let closed =
            surface_from_points(&gapped, &views(&cameras, Some(&truth))).expect("with masks");
        assert!(closed.raggedness == 0.0, "{}", closed.raggedness);
        let (largest, mean, back) = distances(&closed.mesh);
        assert!(
            largest < 0.12 && mean < 0.015 && back < 0.12,
            "{largest} {mean} {back}"
        );
        for camera in &cameras {
            let silhouette = |mesh: &Mesh| coverage_map(mesh, camera, 1, 2);
            let (a, b) = (silhouette(&truth), silhouette(&closed.mesh));
            let both: f32 = a.iter().zip(&b).map(|(a, b)| a.min(*b)).sum();
            let either: f32 = a.iter().zip(&b).map(|(a, b)| a.max(*b)).sum();
            assert!(both / either > 0.97, "{}", both / either);
        }
    }

    #[test]
    fn too_few_points_are_refused() {
        let cameras = cameras();
        let few = points(60, 0.0, |_| false, &cameras);
        assert_eq!(
            surface_from_points(&few, &views(&cameras, None)).expect_err("few"),
            SurfaceError::TooFewPoints {
                usable: 60,
                points: 60
            }
        );
        let mut unseen = points(500, 0.0, |_| false, &cameras);
        for point in &mut unseen {
            point.views.clear();
        }
        assert!(surface_from_points(&unseen, &views(&cameras, None)).is_err());
    }
}
