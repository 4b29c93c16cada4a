//! Points spread evenly over the proxy's surface.

use glam::{DVec3, dvec3};
use ign_geometry::{Camera, CameraIntrinsics, Drawable, GBuffer, Mesh, WarpOptions};
use rayon::prelude::*;

/// Directions from which the object is looked at to tell outside from inside.
const OUTSIDE_VIEWS: usize = 40;
/// Pixels of each such picture's sides.
const OUTSIDE_PX: u32 = 128;
/// Distance of those cameras from the centre of the unit sphere around the object.
const OUTSIDE_DISTANCE: f64 = 4.0;
/// Side of the cells that decide on a point's fold, in the normalised frame.
const CELL: f64 = 0.3;

/// A point of the surface, in the normalised frame. All points stand for the same area.
#[derive(Debug, Clone, Copy)]
pub(crate) struct SurfacePoint {
    pub(crate) position: DVec3,
    /// Unit; points outwards where the object closes.
    pub(crate) normal: DVec3,
}

impl SurfacePoint {
    /// Which half of the surface it belongs to, in cells like those of a chess board: what is fitted on one half is
    /// judged on the other, and neighbours, which err alike, are mostly in the same half.
    pub(crate) fn fold(&self) -> usize {
        let cell = (self.position / CELL).floor();
        (cell.x + cell.y + cell.z).rem_euclid(2.0) as usize
    }
}

/// About `count` points of the part of `mesh` (normalised frame, also as `drawable`) that can be seen from outside at all.
///
/// Winding is not trusted: all normals are turned when most of what is seen from outside faces inwards.
pub(crate) fn sample(mesh: &Mesh, drawable: &Drawable, count: usize) -> Vec<SurfacePoint> {
    let points = spread(mesh, count);
    let outside: Vec<GBuffer> = (0..OUTSIDE_VIEWS)
        .into_par_iter()
        .filter_map(|index| Some(drawable.g_buffer(&outside_camera(index)?, 1)))
        .collect();
    let options = WarpOptions::default();
    // From how many directions each side of the surface is seen.
    let sides: Vec<[usize; 2]> = points
        .par_iter()
        .map(|point| {
            [point.normal, -point.normal].map(|normal| {
                let sees = |view: &&GBuffer| view.sees(point.position, normal, &options).is_some();
                outside.iter().filter(sees).count()
            })
        })
        .collect();
    let total = |side: usize| sides.iter().map(|seen| seen[side]).sum::<usize>();
    let outer = usize::from(total(1) > total(0));
    points
        .into_iter()
        .zip(sides)
        .filter(|(_, seen)| seen[outer] > 0)
        .map(|(point, _)| SurfacePoint {
            normal: if outer == 0 {
                point.normal
            } else {
                -point.normal
            },
            ..point
        })
        .collect()
}

/// Systematic sampling by area: the triangles are walked once, a point is taken after every equal share of the area.
fn spread(mesh: &Mesh, count: usize) -> Vec<SurfacePoint> {
    let corners = |triangle: &[u32; 3]| triangle.map(|corner| mesh.positions[corner as usize]);
    let area = |triangle: &[u32; 3]| {
        let [a, b, c] = corners(triangle);
        (b - a).cross(c - a).length() / 2.0
    };
    let total: f64 = mesh.triangles.iter().map(area).sum();
    let step = total / count.max(1) as f64;
    let mut points = Vec::with_capacity(count);
    if !(step.is_finite() && step > 0.0) {
        return points;
    }
    let mut passed = 0.0;
    for triangle in &mesh.triangles {
        passed += area(triangle);
        while points.len() < count && passed > (points.len() as f64 + 0.5) * step {
            let [a, b, c] = corners(triangle);
            // Roberts' R2 sequence, folded into the triangle.
            let n = points.len() as f64 + 1.0;
            let (mut u, mut v) = (
                (n * 0.754_877_666_246_692_8).fract(),
                (n * 0.569_840_290_998_053_3).fract(),
            );
            if u + v > 1.0 {
                (u, v) = (1.0 - u, 1.0 - v);
            }
            let weights = [1.0 - u - v, u, v];
            let face = (b - a).cross(c - a);
            let smooth: DVec3 = triangle
                .iter()
                .zip(weights)
                .map(|(&corner, weight)| mesh.normals[corner as usize] * weight)
                .sum();
            let normal = if smooth.dot(face) < 0.0 {
                -smooth
            } else {
                smooth
            };
            points.push(SurfacePoint {
                position: a * weights[0] + b * weights[1] + c * weights[2],
                normal: normal
                    .try_normalize()
                    .or_else(|| face.try_normalize())
                    .unwrap_or(DVec3::Z),
            });
        }
    }
    points
}

/// Number `index` of cameras spread evenly around the unit sphere, which fills their pictures.
fn outside_camera(index: usize) -> Option<Camera> {
    // Fibonacci's spiral on the sphere.
    let z = 1.0 - (2.0 * index as f64 + 1.0) / OUTSIDE_VIEWS as f64;
    let turn = index as f64 * 2.399_963_229_728_653;
    let radius = (1.0 - z * z).sqrt();
    let direction = dvec3(radius * turn.cos(), radius * turn.sin(), z);
    let half = f64::from(OUTSIDE_PX) / 2.0;
    let focal = half * (OUTSIDE_DISTANCE * OUTSIDE_DISTANCE - 1.0).sqrt();
    let intrinsics = CameraIntrinsics {
        fx: focal,
        fy: focal,
        cx: half,
        cy: half,
        width: OUTSIDE_PX,
        height: OUTSIDE_PX,
    };
    let up = direction.any_orthonormal_vector();
    Camera::look_at(intrinsics, direction * OUTSIDE_DISTANCE, DVec3::ZERO, up).ok()
}
