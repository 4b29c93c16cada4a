//! A proxy whose outline is where the masks say.
//!
//! Reconstructed meshes are often a pixel or two too thin or too fat, and with image-based rendering that rim is most of
//! the error: nothing re-lights a pixel that the proxy does not cover. Vertices that form the outline in a view are moved
//! along their normals until the outline lies on the mask's, over all views at once.
//!
//! Measure. Across the outline, along the vertex's normal as the view shows it, the coverage of the mask and that of the
//! drawn proxy are each summed up over [`REACH`] pixels to both sides. Where both go from covered to empty once, the
//! difference of the sums is the distance from one edge to the other, to a fraction of a pixel. A vertex takes the mean over
//! the views whose outline it forms, evened out over its neighbours; vertices that form none follow them.
//!
//! Views that had no part in moving decide whether the outcome is kept.

use std::collections::HashMap;

use glam::{DVec2, DVec3};
use rayon::prelude::*;

use crate::{Camera, Drawable, Mesh};

/// Pixels to either side of an outline in which a mask's edge is looked for.
const REACH: f64 = 6.0;
/// Samples of it per pixel.
const DENSITY: f64 = 4.0;
/// Coverage that counts as covered at the inner end, and as empty at the outer one.
const COVERED: f64 = 0.9;
const EMPTY: f64 = 0.1;
/// A vertex forms the outline if it lies so close to the drawn one, in pixels, seen at no steeper than this cosine.
const ON_OUTLINE: f64 = 1.0;
const GRAZING: f64 = 0.5;
/// Rounds of moving.
const ROUNDS: usize = 5;
/// Weight of agreeing with a neighbour, beside one view's measurement, and passes that bring agreement.
const STIFFNESS: f64 = 1.0;
const PASSES: usize = 40;
/// One view in so many checks the others' work.
const CHECK_EVERY: usize = 4;
/// Share by which the mismatch must fall for the outcome to be kept, and what is too little to touch a mesh, in pixels.
const LEAST_GAIN: f64 = 0.2;
const LEAST_PX: f64 = 0.15;
/// Samples a pixel side of a drawn outline.
const SAMPLES: u32 = 4;

/// What a view shows of the object.
#[derive(Clone, Debug)]
pub struct Outline {
    /// In the mesh's frame.
    pub camera: Camera,
    /// Row-major, of the camera's size: how much of each pixel the object covers, in [0, 1]; NaN where that is not known.
    pub coverage: Vec<f32>,
}

/// A mesh with its outline on the masks'.
#[derive(Clone, Debug)]
pub struct Fitted {
    /// The same triangles and colours at other positions.
    pub mesh: Mesh,
    /// Area that only one of proxy and mask covers, by the length of the outline: mean over the views that checked, in
    /// pixels, of the mesh as given and of this one.
    pub before_px: f64,
    /// See `before_px`.
    pub after_px: f64,
}

/// Fits `mesh` to the outlines. `None` where that does not bring it nearer to those that had no part in it, or where it
/// lies on them already.
///
/// # Panics
/// When a coverage has another size than its camera's image.
pub fn fit(mesh: &Mesh, outlines: &[Outline]) -> Option<Fitted> {
    let (check, use_): (Vec<_>, Vec<_>) = outlines
        .iter()
        .enumerate()
        .partition(|(at, _)| at % CHECK_EVERY == CHECK_EVERY / 2);
    let check: Vec<&Outline> = check.into_iter().map(|(_, outline)| outline).collect();
    let used: Vec<&Outline> = use_.into_iter().map(|(_, outline)| outline).collect();
    if check.is_empty() || used.is_empty() {
        return None;
    }
    let before_px = mismatch(mesh, &check)?;
    if before_px < LEAST_PX {
        return None;
    }
    let places = Places::new(mesh);
    let (mut best, mut best_px) = (None, before_px);
    let mut now = mesh.clone();
    for _ in 0..ROUNDS {
        now = places.moved(&now, &used)?;
        let px = mismatch(&now, &check)?;
        if px >= 0.97 * best_px {
            break;
        }
        best_px = px;
        best = Some(now.clone());
    }
    best.filter(|_| best_px <= (1.0 - LEAST_GAIN) * before_px)
        .map(|mesh| Fitted {
            mesh,
            before_px,
            after_px: best_px,
        })
}

/// Vertices by place: seams have several at one, which must stay together.
struct Places {
    /// Per vertex.
    of: Vec<usize>,
    count: usize,
    /// Pairs of places that an edge joins.
    edges: Vec<[usize; 2]>,
}

impl Places {
    fn new(mesh: &Mesh) -> Self {
        let mut known: HashMap<[u64; 3], usize> = HashMap::new();
        let of: Vec<usize> = mesh
            .positions
            .iter()
            .map(|p| {
                let next = known.len();
                *known.entry(p.to_array().map(f64::to_bits)).or_insert(next)
            })
            .collect();
        let mut edges: Vec<[usize; 2]> = mesh
            .triangles
            .iter()
            .flat_map(|triangle| {
                let [a, b, c] = triangle.map(|vertex| of[vertex as usize]);
                [[a, b], [b, c], [c, a]]
            })
            .filter(|[a, b]| a != b)
            .map(|[a, b]| [a.min(b), a.max(b)])
            .collect();
        edges.sort_unstable();
        edges.dedup();
        Self {
            of,
            count: known.len(),
            edges,
        }
    }

    /// The mesh with every place moved along its normal as the outlines ask; `None` when none asks for anything.
    fn moved(&self, mesh: &Mesh, outlines: &[&Outline]) -> Option<Mesh> {
        let mut normals = vec![DVec3::ZERO; self.count];
        let mut positions = vec![DVec3::ZERO; self.count];
        for (vertex, &place) in self.of.iter().enumerate() {
            normals[place] += mesh.normals[vertex];
            positions[place] = mesh.positions[vertex];
        }
        for normal in &mut normals {
            *normal = normal.normalize_or_zero();
        }
        let drawable = Drawable::new(mesh);
        let asked = outlines
            .par_iter()
            .map(|outline| asked_by(outline, &drawable, &positions, &normals))
            .reduce(
                || vec![(0.0, 0.0); self.count],
                |mut sums, more| {
                    for (sum, (distance, weight)) in sums.iter_mut().zip(more) {
                        sum.0 += distance;
                        sum.1 += weight;
                    }
                    sums
                },
            );
        if asked.iter().all(|(_, weight)| *weight <= 0.0) {
            return None;
        }
        let distances = self.evened(&asked);
        let moved = self
            .of
            .iter()
            .enumerate()
            .map(|(vertex, &place)| mesh.positions[vertex] + normals[place] * distances[place]);
        Some(Mesh {
            positions: moved.collect(),
            ..mesh.clone()
        })
    }

    /// Distances that keep to what was asked and to each other: (sum, weight) per place.
    fn evened(&self, asked: &[(f64, f64)]) -> Vec<f64> {
        let mut distances: Vec<f64> = asked
            .iter()
            .map(|(sum, weight)| if *weight > 0.0 { sum / weight } else { 0.0 })
            .collect();
        for _ in 0..PASSES {
            let mut sums: Vec<(f64, f64)> = asked.to_vec();
            for &[a, b] in &self.edges {
                sums[a].0 += STIFFNESS * distances[b];
                sums[b].0 += STIFFNESS * distances[a];
                sums[a].1 += STIFFNESS;
                sums[b].1 += STIFFNESS;
            }
            for (distance, (sum, weight)) in distances.iter_mut().zip(sums) {
                if weight > 0.0 {
                    *distance = sum / weight;
                }
            }
        }
        distances
    }
}

/// Per place: how far the view wants it moved along its normal, and with which weight.
fn asked_by(
    outline: &Outline,
    drawable: &Drawable,
    positions: &[DVec3],
    normals: &[DVec3],
) -> Vec<(f64, f64)> {
    let camera = &outline.camera;
    let drawn = drawable.g_buffer(camera, SAMPLES).coverage;
    let k = camera.intrinsics;
    let size = (k.width as usize, k.height as usize);
    let eye = camera.center();
    let mut asked = vec![(0.0, 0.0); positions.len()];
    for ((position, normal), asked) in positions.iter().zip(normals).zip(&mut asked) {
        let Some(seen) = camera.project(*position) else {
            continue;
        };
        let towards = (eye - *position).normalize_or_zero();
        if !camera.intrinsics.contains(seen.px) || normal.dot(towards).abs() > GRAZING {
            continue;
        }
        // Pixels by which the image moves for a small step along the normal.
        let step = seen.depth / k.fx.max(k.fy);
        let Some(beside) = camera.project(*position + *normal * step) else {
            continue;
        };
        let shift = (beside.px - seen.px) / step;
        let rate = shift.length();
        if rate * step < 0.5 {
            continue;
        }
        // Normals may point inwards.
        for outwards in [1.0, -1.0] {
            let across = outwards * shift / rate;
            let edge = |coverage: &[f32]| edge_position(coverage, size, seen.px, across);
            if let (Some(drawn), Some(wanted)) = (edge(&drawn), edge(&outline.coverage))
                && drawn.abs() <= ON_OUTLINE
            {
                *asked = (outwards * (wanted - drawn) / rate, 1.0);
            }
        }
    }
    asked
}

/// Where coverage ends along `across` from `px`, in pixels; `None` where it does not go from covered to empty.
fn edge_position(coverage: &[f32], size: (usize, usize), px: DVec2, across: DVec2) -> Option<f64> {
    let count = (2.0 * REACH * DENSITY) as usize;
    let at = |index: usize| px + across * ((index as f64 + 0.5) / DENSITY - REACH);
    let values = (0..count).map(|index| bilinear(coverage, size, at(index)));
    let values: Vec<f64> = values.collect::<Option<_>>()?;
    let ends = DENSITY as usize;
    let inner = values[..ends].iter().all(|value| *value >= COVERED);
    let outer = values[count - ends..].iter().all(|value| *value <= EMPTY);
    // Up again by more than noise: another part of the object lies behind the edge.
    let mut lowest = 1.0f64;
    let once = values.iter().all(|value| {
        lowest = lowest.min(*value);
        *value <= lowest + 0.2
    });
    (inner && outer && once).then(|| values.iter().sum::<f64>() / DENSITY - REACH)
}

/// The value between pixel centres; `None` outside the image or where it is not finite.
fn bilinear(image: &[f32], (width, height): (usize, usize), px: DVec2) -> Option<f64> {
    let (x, y) = (px.x - 0.5, px.y - 0.5);
    if !(x >= 0.0 && y >= 0.0 && x < width as f64 - 1.0 && y < height as f64 - 1.0) {
        return None;
    }
    let (column, row) = (x as usize, y as usize);
    let (fx, fy) = (x - column as f64, y - row as f64);
    let at = |dx: usize, dy: usize| f64::from(image[(row + dy) * width + column + dx]);
    let top = at(0, 0) * (1.0 - fx) + at(1, 0) * fx;
    let bottom = at(0, 1) * (1.0 - fx) + at(1, 1) * fx;
    let value = top * (1.0 - fy) + bottom * fy;
    value.is_finite().then_some(value)
}

/// Mean over the views of the area that only one of proxy and mask covers, by the length of the mask's outline, in
/// pixels; `None` when no view has an outline.
fn mismatch(mesh: &Mesh, outlines: &[&Outline]) -> Option<f64> {
    let drawable = Drawable::new(mesh);
    let views: Vec<f64> = outlines
        .par_iter()
        .filter_map(|outline| {
            let drawn = drawable.g_buffer(&outline.camera, SAMPLES).coverage;
            assert_eq!(
                drawn.len(),
                outline.coverage.len(),
                "coverage of the camera's size"
            );
            let area: f64 = drawn
                .iter()
                .zip(&outline.coverage)
                .map(|(a, b)| f64::from((a - b).abs()))
                .filter(|difference| difference.is_finite())
                .sum();
            let length = outline_length(&outline.coverage, outline.camera.intrinsics.width);
            (length > 0.0).then(|| area / length)
        })
        .collect();
    (!views.is_empty()).then(|| views.iter().sum::<f64>() / views.len() as f64)
}

/// Length of a coverage's outline in pixels: the sum of its gradient.
fn outline_length(coverage: &[f32], width: u32) -> f64 {
    let width = width as usize;
    let mut length = 0.0;
    for (at, value) in coverage.iter().enumerate() {
        let right = if (at + 1) % width == 0 {
            *value
        } else {
            coverage[at + 1]
        };
        let below = coverage.get(at + width).unwrap_or(value);
        let slope = f64::from(right - value).hypot(f64::from(below - value));
        length += if slope.is_finite() { slope } else { 0.0 };
    }
    length
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::CameraIntrinsics;

    /// A ball of so many segments about `center`, stretched along y.
    fn ball(center: DVec3, radius: f64) -> Mesh {
        let (rings, segments) = (24u32, 48u32);
        let mut positions = vec![DVec3::Y, -DVec3::Y];
        for ring in 1..rings {
            let polar = std::f64::consts::PI * f64::from(ring) / f64::from(rings);
            for segment in 0..segments {
                let turn = std::f64::consts::TAU * f64::from(segment) / f64::from(segments);
                positions.push(DVec3::new(
                    polar.sin() * turn.cos(),
                    polar.cos(),
                    polar.sin() * turn.sin(),
                ));
            }
        }
        let at = |ring: u32, segment: u32| 2 + (ring - 1) * segments + segment % segments;
        let mut triangles = Vec::new();
        for segment in 0..segments {
            triangles.push([0, at(1, segment + 1), at(1, segment)]);
            triangles.push([1, at(rings - 1, segment), at(rings - 1, segment + 1)]);
            for ring in 1..rings - 1 {
                let [a, b] = [at(ring, segment), at(ring, segment + 1)];
                let [c, d] = [at(ring + 1, segment), at(ring + 1, segment + 1)];
                triangles.extend([[a, b, c], [b, d, c]]);
            }
        }
        let place = |p: DVec3| center + p * DVec3::new(radius, 1.3 * radius, radius);
        let positions = positions.into_iter().map(place).collect();
        Mesh::new(positions, triangles).expect("a mesh")
    }

    fn outlines(truth: &Mesh, center: DVec3) -> Vec<Outline> {
        let intrinsics = CameraIntrinsics {
            fx: 110.0,
            fy: 110.0,
            cx: 48.0,
            cy: 48.0,
            width: 96,
            height: 96,
        };
        let drawable = Drawable::new(truth);
        (0..16)
            .map(|at| {
                let turn = std::f64::consts::TAU * f64::from(at) / 16.0;
                let height = if at % 2 == 0 { 1.2 } else { -0.7 };
                let eye = center + DVec3::new(4.0 * turn.cos(), height, 4.0 * turn.sin());
                let camera = Camera::look_at(intrinsics, eye, center, DVec3::Y).expect("a camera");
                Outline {
                    camera,
                    coverage: drawable.g_buffer(&camera, SAMPLES).coverage,
                }
            })
            .collect()
    }

    #[test]
    fn a_proxy_that_is_too_thin_or_too_fat_comes_to_the_masks() {
        for center in [DVec3::ZERO, DVec3::splat(1e6)] {
            let outlines = outlines(&ball(center, 1.0), center);
            for radius in [0.93, 1.06] {
                let fitted = fit(&ball(center, radius), &outlines).expect("it can be fitted");
                assert!(fitted.before_px > 1.0, "{}", fitted.before_px);
                assert!(fitted.after_px < 0.15, "{radius}: {}", fitted.after_px);
                let widest = fitted
                    .mesh
                    .positions
                    .iter()
                    .map(|p| (*p - center).with_y(0.0).length());
                let widest = widest.fold(0.0, f64::max);
                assert!((widest - 1.0).abs() < 0.01, "{radius}: {widest}");
            }
        }
    }

    #[test]
    fn what_fits_or_cannot_be_fitted_stays() {
        let truth = ball(DVec3::ZERO, 1.0);
        let good = outlines(&truth, DVec3::ZERO);
        assert!(fit(&truth, &good).is_none());
        let thin = ball(DVec3::ZERO, 0.9);
        assert!(fit(&thin, &good[..1]).is_none());
        for value in [0.0, 1.0, f32::NAN] {
            let mut blank = good.clone();
            for outline in &mut blank {
                outline.coverage.fill(value);
            }
            assert!(fit(&thin, &blank).is_none(), "{value}");
        }
        // Masks of something else altogether are no reason to move far: nothing lies within reach.
        let other = outlines(&ball(DVec3::ZERO, 0.3), DVec3::ZERO);
        assert!(fit(&truth, &other).is_none());
    }

    #[test]
    fn seams_stay_closed() {
        let whole = ball(DVec3::ZERO, 0.93);
        // Every triangle with vertices of its own.
        let positions: Vec<DVec3> = whole
            .triangles
            .iter()
            .flat_map(|t| t.map(|v| whole.positions[v as usize]))
            .collect();
        let triangles = (0..positions.len() as u32 / 3)
            .map(|t| [3 * t, 3 * t + 1, 3 * t + 2])
            .collect();
        let torn = Mesh::new(positions, triangles).expect("a mesh");
        let good = outlines(&ball(DVec3::ZERO, 1.0), DVec3::ZERO);
        let fitted = fit(&torn, &good).expect("it can be fitted").mesh;
        let (places, after) = (Places::new(&torn), Places::new(&fitted));
        assert_eq!(places.count, after.count);
    }
}
