//! Static colours on the proxy: what most reconstruction programs deliver (paper, Appendix "Comparison to Texture-based
//! Rendering"). View-dependent effects are baked in and stay where they were.
//!
//! Every texel is a cosine-weighted sum of the four reference views towards whose cameras its normal points the most and
//! that see it; a texel that no view sees has no colour.
//!
//! Deviation: no UV atlas. Texels lie on the mesh itself (Yuksel, Keyser and House 2010, "Mesh Colors"): on each triangle a
//! lattice of R + 1 texels a side, with R such that neighbours are at most half a reference pixel's footprint apart, and
//! linear interpolation between three of them. There are no seams or stretched charts; a lattice of R = 1 on every
//! triangle is one colour per vertex.

use glam::{DVec2, DVec3};
use ign_geometry::Mesh;
use rayon::prelude::*;
use tch::{Kind, Tensor, no_grad};

use crate::model::composite;
use crate::references::References;
use crate::target::Target;
use ign_nets::params::flat_values;
use ign_nets::warp::directions;

/// Views that a texel mixes (paper: four).
const VIEWS: usize = 4;
/// Visible share of the footprint from which on a view sees a texel.
const SEEN: f64 = 0.5;
/// Texels between two reference pixels.
const DENSITY: f64 = 2.0;
/// Texels at most; larger surfaces get coarser lattices.
const MOST_TEXELS: usize = 4_000_000;
/// Texels looked up at once.
const CHUNK: usize = 1 << 16;

/// How densely colours lie.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ColorGrid {
    /// One per corner of a triangle: `vertex_color`.
    Vertices,
    /// As dense as the references' pixels: `texture`.
    Texels,
}

/// Colours of a mesh's surface.
#[derive(Debug)]
pub struct SurfaceColors {
    /// Per triangle: lattice steps along an edge.
    steps: Vec<u32>,
    /// Per triangle: its first texel; then the number of all.
    first: Vec<usize>,
    /// Encoded sRGB, and 1 where some view sees the texel, else 0.
    texels: Vec<[f32; 4]>,
}

impl SurfaceColors {
    /// Colours the mesh (normalised frame) from the reference views.
    pub fn new(mesh: &Mesh, references: &References, grid: ColorGrid) -> Self {
        let edges: Vec<f64> = mesh
            .triangles
            .iter()
            .map(|&t| longest_edge(mesh, t))
            .collect();
        let mut spacing = match grid {
            ColorGrid::Vertices => f64::INFINITY,
            ColorGrid::Texels => footprint(references) / DENSITY,
        };
        let steps_for = |spacing: f64| -> Vec<u32> {
            let steps = |edge: &f64| (edge / spacing).ceil().clamp(1.0, 1e4) as u32;
            edges.iter().map(steps).collect()
        };
        let mut steps = steps_for(spacing);
        while steps.iter().any(|&n| n > 1) && total(&steps) > MOST_TEXELS {
            spacing *= 1.25;
            steps = steps_for(spacing);
        }
        let mut first = Vec::with_capacity(steps.len() + 1);
        let mut next = 0;
        for &n in &steps {
            first.push(next);
            next += count(n);
        }
        first.push(next);
        let places: Vec<(DVec3, DVec3)> = (0..steps.len())
            .into_par_iter()
            .flat_map_iter(|triangle| lattice(mesh, triangle, steps[triangle]))
            .collect();
        let outside = outside(&places, references);
        let texels = places
            .chunks(CHUNK)
            .flat_map(|chunk| colors(chunk, outside, references))
            .collect();
        Self {
            steps,
            first,
            texels,
        }
    }

    /// Number of texels.
    pub fn len(&self) -> usize {
        self.texels.len()
    }

    /// Whether there is no texel.
    pub fn is_empty(&self) -> bool {
        self.texels.is_empty()
    }

    /// [1, 3, H, W] in [0, 1]: the mesh in its colours over black, encoded sRGB. `mesh` is the one that was coloured.
    pub fn image(&self, mesh: &Mesh, target: &Target) -> Tensor {
        no_grad(|| {
            let points = flat_values(&target.points);
            let values: Vec<f32> = points
                .par_chunks_exact(3)
                .zip(&target.triangles)
                .flat_map_iter(|(point, &triangle)| {
                    let place = DVec3::new(point[0].into(), point[1].into(), point[2].into());
                    self.at(triangle as usize, barycentric(mesh, triangle, place))
                })
                .collect();
            let values = Tensor::from_slice(&values).view([-1, 4]);
            let values = values.to_device(target.points.device()) * target.weight.unsqueeze(1);
            let (sums, _) = target.sums(&values);
            let (h, w) = target.size();
            let mean = sums.narrow(1, 0, 3) / sums.narrow(1, 3, 1).clamp_min(1e-4);
            composite(&mean.tr().contiguous().view([1, 3, h, w]), target)
        })
    }

    /// Colour times weight, and weight, at the barycentric coordinates of a triangle's second and third corner.
    fn at(&self, triangle: usize, place: DVec2) -> [f32; 4] {
        let n = self.steps[triangle];
        let scaled = place * f64::from(n);
        let cell = |x: f64| (x.floor().max(0.0) as u32).min(n - 1);
        let (i, j) = (cell(scaled.x), cell(scaled.y));
        // Beyond the long edge there are no texels: the last cell of a row is half a cell.
        let j = j.min(n - 1 - i);
        let (u, v) = (scaled.x - f64::from(i), scaled.y - f64::from(j));
        let corners = if u + v <= 1.0 || i + j + 2 > n {
            [((i, j), 1.0 - u - v), ((i + 1, j), u), ((i, j + 1), v)]
        } else {
            [
                ((i + 1, j + 1), u + v - 1.0),
                ((i, j + 1), 1.0 - u),
                ((i + 1, j), 1.0 - v),
            ]
        };
        let mut sum = [0.0; 4];
        for ((i, j), weight) in corners {
            let texel = self.texels[self.first[triangle] + index(n, i, j)];
            // Rounding takes points a little out of their triangle.
            let weight = weight.max(0.0) as f32 * texel[3];
            for (sum, value) in sum.iter_mut().zip([texel[0], texel[1], texel[2], 1.0]) {
                *sum += value * weight;
            }
        }
        sum
    }
}

/// Texels of a lattice of `n` steps.
fn count(n: u32) -> usize {
    let n = n as usize;
    (n + 1) * (n + 2) / 2
}

fn total(steps: &[u32]) -> usize {
    steps.iter().map(|&n| count(n)).sum()
}

/// Place of texel (i, j), i + j <= n, in a lattice of `n` steps: rows of constant i, each one texel shorter.
fn index(n: u32, i: u32, j: u32) -> usize {
    let (n, i, j) = (n as usize, i as usize, j as usize);
    i * (n + 1) - i * i.saturating_sub(1) / 2 + j
}

fn corners(mesh: &Mesh, triangle: [u32; 3]) -> [DVec3; 3] {
    triangle.map(|vertex| mesh.positions[vertex as usize])
}

fn longest_edge(mesh: &Mesh, triangle: [u32; 3]) -> f64 {
    let [a, b, c] = corners(mesh, triangle);
    a.distance(b).max(b.distance(c)).max(c.distance(a))
}

/// Position and normal of each texel of a triangle, in the order of [`index`].
fn lattice(mesh: &Mesh, triangle: usize, n: u32) -> impl Iterator<Item = (DVec3, DVec3)> {
    let triangle = mesh.triangles[triangle];
    let [a, b, c] = corners(mesh, triangle);
    let [na, nb, nc] = triangle.map(|vertex| mesh.normals[vertex as usize]);
    (0..=n).flat_map(move |i| {
        (0..=n - i).map(move |j| {
            let (u, v) = (f64::from(i) / f64::from(n), f64::from(j) / f64::from(n));
            let w = 1.0 - u - v;
            let normal = (na * w + nb * u + nc * v).normalize_or_zero();
            (a * w + b * u + c * v, normal)
        })
    })
}

/// Weights of the second and third corner at a point of the triangle's plane.
fn barycentric(mesh: &Mesh, triangle: u32, point: DVec3) -> DVec2 {
    let [a, b, c] = corners(mesh, mesh.triangles[triangle as usize]);
    let (ab, ac, ap) = (b - a, c - a, point - a);
    let (d00, d01, d11) = (ab.dot(ab), ab.dot(ac), ac.dot(ac));
    let (d20, d21) = (ap.dot(ab), ap.dot(ac));
    let determinant = d00 * d11 - d01 * d01;
    if determinant <= 0.0 {
        return DVec2::ZERO;
    }
    DVec2::new(d11 * d20 - d01 * d21, d00 * d21 - d01 * d20) / determinant
}

/// Median size, at the object's centre, of what a reference's pixel covers.
fn footprint(references: &References) -> f64 {
    let mut sizes: Vec<f64> = references
        .cameras
        .iter()
        .map(|camera| camera.center().length() / camera.intrinsics.fx)
        .collect();
    sizes.sort_by(f64::total_cmp);
    sizes.get(sizes.len() / 2).copied().unwrap_or(1.0)
}

/// What the reference views see of surface points, on their device: cosines [n, V], signed, 0 where a view does not see the
/// point; and colours [n, V, 3].
fn observed(places: &[(DVec3, DVec3)], references: &References) -> (Tensor, Tensor) {
    let device = references.colors.device();
    let flat = |pick: fn(&(DVec3, DVec3)) -> DVec3| {
        let values: Vec<f32> = places
            .iter()
            .flat_map(|place| pick(place).as_vec3().to_array())
            .collect();
        Tensor::from_slice(&values).view([-1, 3]).to_device(device)
    };
    let (points, normals) = (flat(|p| p.0), flat(|p| p.1));
    let n = points.size()[0];
    let (mut cosines, mut colors) = (Vec::new(), Vec::new());
    for view in 0..references.len() as i64 {
        let index = Tensor::full([n], view, (Kind::Int64, device));
        let center = references.sources.centers().narrow(0, view, 1);
        let cosine = (directions(&center, &points) * &normals).sum_dim_intlist(
            [1i64].as_slice(),
            true,
            Kind::Float,
        );
        let facing = &normals * cosine.sign();
        let taps = references
            .sources
            .taps(&points, &facing, &index)
            .weighted(&references.alpha);
        let seen = taps.visibility.gt(SEEN).to_kind(Kind::Float);
        cosines.push(cosine.view([-1]) * seen);
        colors.push(taps.gather(&references.colors) / taps.visibility.clamp_min(1e-4).unsqueeze(1));
    }
    (Tensor::stack(&cosines, 1), Tensor::stack(&colors, 1))
}

/// 1 where a mesh's normals point outwards, -1 where it is wound the other way: the outside is what is seen more. Decided once
/// for the mesh: through a thin wall, views of its other side may seem to see a point of this one.
fn outside(places: &[(DVec3, DVec3)], references: &References) -> f64 {
    let stride = places.len().div_ceil(CHUNK).max(1);
    let sample: Vec<(DVec3, DVec3)> = places.iter().step_by(stride).copied().collect();
    let (cosines, _) = no_grad(|| observed(&sample, references));
    if cosines.sum(Kind::Double).double_value(&[]) < 0.0 {
        -1.0
    } else {
        1.0
    }
}

/// The texel rule.
fn colors(places: &[(DVec3, DVec3)], outside: f64, references: &References) -> Vec<[f32; 4]> {
    no_grad(|| {
        let (cosines, colors) = observed(places, references);
        let (n, best) = (places.len() as i64, VIEWS.min(references.len()) as i64);
        // [n, best]
        let (weights, views) = (cosines * outside).clamp_min(0.0).topk(best, 1, true, true);
        let views = views.unsqueeze(2).expand([n, best, 3], false);
        let colors = colors.gather(1, &views, false);
        let total = weights.sum_dim_intlist([1i64].as_slice(), true, Kind::Float);
        let mean =
            (colors * weights.unsqueeze(2)).sum_dim_intlist([1i64].as_slice(), false, Kind::Float)
                / total.clamp_min(1e-6);
        let texels = Tensor::cat(&[mean, total.gt(0.0).to_kind(Kind::Float)], 1);
        let flat = flat_values(&texels);
        flat.as_chunks::<4>().0.to_vec()
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lattices_are_numbered_without_gaps() {
        for n in 1..6 {
            let mut next = 0;
            for i in 0..=n {
                for j in 0..=n - i {
                    assert_eq!(index(n, i, j), next);
                    next += 1;
                }
            }
            assert_eq!(next, count(n));
        }
    }

    /// Colours that are linear in the place are interpolated without error, whatever the lattice.
    #[test]
    fn interpolation_is_linear() {
        for n in 1..5 {
            let mut texels = Vec::new();
            for i in 0..=n {
                for j in 0..=n - i {
                    texels.push([i as f32 / n as f32, j as f32 / n as f32, 0.25, 1.0]);
                }
            }
            let colors = SurfaceColors {
                steps: vec![n],
                first: vec![0, texels.len()],
                texels,
            };
            for (u, v) in [
                (0.0, 0.0),
                (1.0, 0.0),
                (0.0, 1.0),
                (0.31, 0.22),
                (0.6, 0.39),
                (0.05, 0.94),
            ] {
                let found = colors.at(0, DVec2::new(u, v));
                for (found, expected) in found.iter().zip([u, v, 0.25, 1.0]) {
                    assert!((f64::from(*found) - expected).abs() < 1e-6, "{n}: {u}, {v}");
                }
            }
        }
    }
}
