//! What a ray hits: a bounding volume hierarchy over triangles.
//!
//! Boxes are f32 and rounded outwards, triangles are tested in f64 (Moeller and Trumbore 1997), so no hit is lost to
//! the boxes. Splits are by the surface area heuristic over bins.

use glam::{DVec3, Vec3A};

use crate::shape::Surface;

const BINS: usize = 16;
const LEAF: usize = 4;
/// A hair of slack, in barycentric weights, closes the seams between triangles.
const SLACK: f64 = 1e-10;

/// Deep enough for any tree that halves at least one triangle off per level at this size, by far.
const STACK: usize = 96;

/// A hierarchy over the triangles of a surface.
pub(crate) struct Tracer {
    nodes: Vec<Node>,
    triangles: Vec<Triangle>,
}

/// Inner node: `count` is 0 and the children are `first` and `first + 1`. Leaf: triangles `first..first + count`.
#[derive(Clone, Copy)]
struct Node {
    min: Vec3A,
    max: Vec3A,
    first: u32,
    count: u32,
}

struct Triangle {
    corner: DVec3,
    edge1: DVec3,
    edge2: DVec3,
    index: u32,
}

/// A ray `origin + t * direction`, for `t` between the two limits.
#[derive(Clone, Copy)]
pub(crate) struct Ray {
    pub(crate) origin: DVec3,
    pub(crate) direction: DVec3,
    pub(crate) t_min: f64,
    pub(crate) t_max: f64,
}

/// The nearest hit.
#[derive(Clone, Copy)]
pub(crate) struct Hit {
    pub(crate) t: f64,
    pub(crate) triangle: u32,
    /// Weights of the triangle's second and third corner.
    pub(crate) weights: (f64, f64),
}

/// A triangle while the tree is built.
struct Item {
    min: Vec3A,
    max: Vec3A,
    center: Vec3A,
    index: u32,
}

impl Tracer {
    pub(crate) fn new(surface: &Surface) -> Self {
        let mut items: Vec<Item> = Vec::with_capacity(surface.triangles.len());
        for (index, corners) in surface.triangles.iter().enumerate() {
            // Positions are f32 values: these boxes are exact.
            let [a, b, c] = corners.map(|corner| surface.positions[corner as usize].as_vec3a());
            let (min, max) = (a.min(b).min(c), a.max(b).max(c));
            items.push(Item {
                min,
                max,
                center: (min + max) / 2.0,
                index: index as u32,
            });
        }
        let mut nodes = vec![Node {
            min: Vec3A::ZERO,
            max: Vec3A::ZERO,
            first: 0,
            count: 0,
        }];
        build(&mut nodes, 0, &mut items, 0);
        let triangles = items
            .iter()
            .map(|item| {
                let [a, b, c] =
                    surface.triangles[item.index as usize].map(|v| surface.positions[v as usize]);
                Triangle {
                    corner: a,
                    edge1: b - a,
                    edge2: c - a,
                    index: item.index,
                }
            })
            .collect();
        Self { nodes, triangles }
    }

    /// The nearest hit, if any.
    pub(crate) fn nearest(&self, ray: Ray) -> Option<Hit> {
        let mut best: Option<Hit> = None;
        self.walk(ray, |triangle, t_max| {
            if let Some(hit) = triangle.hit(&ray, t_max) {
                best = Some(hit);
                return Some(hit.t);
            }
            None
        });
        best
    }

    /// Whether anything is hit.
    pub(crate) fn is_blocked(&self, ray: Ray) -> bool {
        let mut blocked = false;
        self.walk(ray, |triangle, t_max| {
            triangle.hit(&ray, t_max)?;
            blocked = true;
            // Nothing can be nearer: the walk ends.
            Some(f64::NEG_INFINITY)
        });
        blocked
    }

    /// Visits triangles whose boxes the ray meets, near ones first; `visit` returns a new far limit after a hit.
    fn walk(&self, ray: Ray, mut visit: impl FnMut(&Triangle, f64) -> Option<f64>) {
        let origin = ray.origin.as_vec3a();
        let inverse = ray.direction.as_vec3a().recip();
        let mut t_max = ray.t_max;
        let mut stack = [(0_u32, 0.0_f32); STACK];
        let mut depth = 1;
        if self.nodes[0].enter(origin, inverse, t_max as f32).is_none() {
            return;
        }
        while depth > 0 {
            depth -= 1;
            let (index, entry) = stack[depth];
            if f64::from(entry) > t_max {
                continue;
            }
            let node = &self.nodes[index as usize];
            if node.count > 0 {
                for triangle in
                    &self.triangles[node.first as usize..(node.first + node.count) as usize]
                {
                    if let Some(t) = visit(triangle, t_max) {
                        t_max = t;
                    }
                }
                if t_max == f64::NEG_INFINITY {
                    return;
                }
                continue;
            }
            let limit = t_max as f32;
            let left = self.nodes[node.first as usize]
                .enter(origin, inverse, limit)
                .map(|t| (node.first, t));
            let right = self.nodes[node.first as usize + 1]
                .enter(origin, inverse, limit)
                .map(|t| (node.first + 1, t));
            let (near, far) = match (left, right) {
                (Some(l), Some(r)) if r.1 < l.1 => (Some(r), Some(l)),
                other => other,
            };
            for child in [far, near].into_iter().flatten() {
                stack[depth] = child;
                depth += 1;
            }
        }
    }
}

impl Node {
    /// Where the ray enters the box, if it does before `limit`. The box is widened by the rounding of f32.
    #[inline]
    fn enter(&self, origin: Vec3A, inverse: Vec3A, limit: f32) -> Option<f32> {
        let a = (self.min - origin) * inverse;
        let b = (self.max - origin) * inverse;
        let near = a.min(b).max_element().max(0.0);
        let far = a.max(b).min_element();
        // Rays are a few units long; the slack covers the rounding of origin and products at that scale.
        (near * (1.0 - 1e-5) <= far * (1.0 + 1e-5) + 1e-5 && near * (1.0 - 1e-5) <= limit)
            .then_some(near * (1.0 - 1e-5))
    }

    fn area(min: Vec3A, max: Vec3A) -> f32 {
        let e = (max - min).max(Vec3A::ZERO);
        e.x * e.y + e.y * e.z + e.z * e.x
    }
}

impl Triangle {
    #[inline]
    fn hit(&self, ray: &Ray, t_max: f64) -> Option<Hit> {
        let p = ray.direction.cross(self.edge2);
        let determinant = self.edge1.dot(p);
        if determinant == 0.0 {
            return None;
        }
        let inverse = determinant.recip();
        let s = ray.origin - self.corner;
        let u = s.dot(p) * inverse;
        if !(-SLACK..=1.0 + SLACK).contains(&u) {
            return None;
        }
        let q = s.cross(self.edge1);
        let v = ray.direction.dot(q) * inverse;
        if v < -SLACK || u + v > 1.0 + SLACK {
            return None;
        }
        let t = self.edge2.dot(q) * inverse;
        (t > ray.t_min && t < t_max).then_some(Hit {
            t,
            triangle: self.index,
            weights: (u, v),
        })
    }
}

/// Fills `nodes[at]` for `items`, which become the leaves' triangles from `first` on, and reorders them.
fn build(nodes: &mut Vec<Node>, at: usize, items: &mut [Item], first: u32) {
    let mut bounds = (Vec3A::INFINITY, Vec3A::NEG_INFINITY);
    let mut centers = bounds;
    for item in items.iter() {
        bounds = (bounds.0.min(item.min), bounds.1.max(item.max));
        centers = (centers.0.min(item.center), centers.1.max(item.center));
    }
    nodes[at] = Node {
        min: bounds.0,
        max: bounds.1,
        first,
        count: items.len() as u32,
    };
    if items.len() <= LEAF {
        return;
    }
    let Some((axis, limit)) = best_split(items, centers) else {
        return;
    };
    let middle = partition(items, |item| item.center[axis] < limit);
    if middle == 0 || middle == items.len() {
        return;
    }
    let children = nodes.len();
    nodes[at].first = children as u32;
    nodes[at].count = 0;
    let empty = nodes[at];
    nodes.extend([empty, empty]);
    let (left, right) = items.split_at_mut(middle);
    build(nodes, children, left, first);
    build(nodes, children + 1, right, first + middle as u32);
}

/// Axis and place of the cheapest of the binned splits; `None` when all centres coincide.
fn best_split(items: &[Item], centers: (Vec3A, Vec3A)) -> Option<(usize, f32)> {
    let mut best: Option<(f32, usize, f32)> = None;
    for axis in 0..3 {
        let (low, extent) = (centers.0[axis], centers.1[axis] - centers.0[axis]);
        if extent <= 0.0 {
            continue;
        }
        let mut bins = [(0_u32, Vec3A::INFINITY, Vec3A::NEG_INFINITY); BINS];
        for item in items {
            let bin = (((item.center[axis] - low) / extent * BINS as f32) as usize).min(BINS - 1);
            let (count, min, max) = &mut bins[bin];
            *count += 1;
            *min = min.min(item.min);
            *max = max.max(item.max);
        }
        let sweep = |order: &mut dyn Iterator<Item = usize>| {
            let (mut count, mut min, mut max) = (0, Vec3A::INFINITY, Vec3A::NEG_INFINITY);
            let mut costs = Vec::with_capacity(BINS);
            for bin in order {
                count += bins[bin].0;
                min = min.min(bins[bin].1);
                max = max.max(bins[bin].2);
                costs.push(if count == 0 {
                    0.0
                } else {
                    count as f32 * Node::area(min, max)
                });
            }
            costs
        };
        let left = sweep(&mut (0..BINS));
        let right = sweep(&mut (0..BINS).rev());
        for cut in 1..BINS {
            let cost = left[cut - 1] + right[BINS - 1 - cut];
            if best.is_none_or(|(least, ..)| cost < least) {
                best = Some((cost, axis, low + extent * cut as f32 / BINS as f32));
            }
        }
    }
    best.map(|(_, axis, limit)| (axis, limit))
}

/// Moves the items for which `goes_left` holds to the front; returns how many.
fn partition(items: &mut [Item], goes_left: impl Fn(&Item) -> bool) -> usize {
    let mut middle = 0;
    for index in 0..items.len() {
        if goes_left(&items[index]) {
            items.swap(index, middle);
            middle += 1;
        }
    }
    middle
}
