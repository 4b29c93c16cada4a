//! A mesh made ready for drawing: split once into compact clusters, so that a view costs what it shows.
//!
//! A cluster holds a few neighbouring triangles with copies of their vertices, and a box around them. A view projects
//! the boxes, leaves out clusters outside the image or hidden behind what is already drawn, and projects the vertices
//! of the rest into a small buffer. Nothing of a view's size is kept for all vertices or all triangles, and the work
//! of a view follows the triangles that it shows.
//!
//! What is drawn does not depend on how the triangles are split: see [`crate::raster`].

use std::cmp::Ordering;

use glam::{DVec3, Vec3};
use rayon::prelude::{IntoParallelRefIterator, ParallelIterator};

use crate::Mesh;
use crate::raster::NO_TRIANGLE;

/// Triangles of a cluster, at most; a power of two. Smaller ones hide each other better, larger ones share more
/// vertices: measured on a sphere of a million triangles at 512 x 512 pixels.
const TRIANGLES: usize = 128;
/// Vertices of a cluster, at most: a corner is named by one byte.
pub(crate) const VERTICES: usize = 256;
/// Splitting goes on in parallel while a part holds at least this many triangles.
const PARALLEL: usize = 1 << 14;

/// A mesh made ready to be drawn from many cameras: see [`Drawable::rasterize`], [`Drawable::g_buffer`] and
/// [`Drawable::coverage_map`].
///
/// It copies what it needs: about 90 bytes per triangle. Making it takes about as long as drawing a few views.
#[derive(Clone, Debug)]
pub struct Drawable {
    clusters: Vec<Cluster>,
    /// Where each triangle of the mesh is kept: `TRIANGLES * cluster + place`, or [`NO_TRIANGLE`] when it cannot be
    /// drawn.
    slots: Vec<u32>,
    bounds: Bounds,
}

/// Neighbouring triangles with their own copies of the vertices.
#[derive(Clone, Debug)]
pub(crate) struct Cluster {
    /// Indices of the triangles in the mesh, rising.
    pub(crate) triangles: Vec<u32>,
    /// Vertices of each triangle, in `positions` and `normals`.
    pub(crate) corners: Vec<[u8; 3]>,
    /// Positions in world axes, finite.
    pub(crate) positions: Vec<DVec3>,
    /// Normals of the vertices, as the mesh has them; zero where it has none.
    pub(crate) normals: Vec<DVec3>,
    /// A box around `positions`.
    pub(crate) bounds: Bounds,
}

/// An axis-aligned box.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Bounds {
    pub(crate) low: DVec3,
    pub(crate) high: DVec3,
}

impl Bounds {
    const EMPTY: Self = Self {
        low: DVec3::INFINITY,
        high: DVec3::NEG_INFINITY,
    };

    fn with(self, point: DVec3) -> Self {
        Self {
            low: self.low.min(point),
            high: self.high.max(point),
        }
    }

    fn around(points: impl IntoIterator<Item = DVec3>) -> Self {
        points.into_iter().fold(Self::EMPTY, Self::with)
    }
}

/// A triangle while the mesh is split: its middle and index.
type Item = (Vec3, u32);

impl Drawable {
    /// Splits `mesh` into clusters. Triangles that name a vertex which does not exist or is not finite are left out.
    pub fn new(mesh: &Mesh) -> Self {
        let count = mesh.triangles.len().min(NO_TRIANGLE as usize);
        let corners = |triangle: u32| {
            mesh.triangles[triangle as usize].map(|corner| mesh.positions.get(corner as usize))
        };
        let mut items: Vec<Item> = (0..count as u32)
            .filter_map(|triangle| {
                let [a, b, c] = corners(triangle);
                let (a, b, c) = (a?, b?, c?);
                let finite = a.is_finite() && b.is_finite() && c.is_finite();
                finite.then(|| ((a / 3.0 + b / 3.0 + c / 3.0).as_vec3(), triangle))
            })
            .collect();
        let clusters: Vec<Cluster> = split(mesh, &mut items)
            .par_iter()
            .map(|triangles| Cluster::new(mesh, triangles))
            .collect();
        let mut slots = vec![NO_TRIANGLE; count];
        for (index, cluster) in clusters.iter().enumerate() {
            for (place, triangle) in cluster.triangles.iter().enumerate() {
                slots[*triangle as usize] = (index * TRIANGLES + place) as u32;
            }
        }
        let corners = clusters.iter().map(|cluster| cluster.bounds);
        let bounds = Bounds::around(corners.flat_map(|bounds| [bounds.low, bounds.high]));
        Self {
            clusters,
            slots,
            bounds,
        }
    }

    pub(crate) fn clusters(&self) -> &[Cluster] {
        &self.clusters
    }

    /// A box around everything that can be drawn.
    pub(crate) fn bounds(&self) -> Bounds {
        self.bounds
    }

    /// Which of two triangles that can be drawn comes first by the coordinates of its corners, in the triangle's order,
    /// then their normals; of exact copies, the one of the lower index. Nothing but their place in the mesh differs in
    /// copies, so that what is drawn of them does not.
    pub(crate) fn first(&self, triangle: u32, other: u32) -> u32 {
        let corners = |triangle: u32| {
            let (cluster, corners) = self.corners(triangle);
            let vertices = [&cluster.positions, &cluster.normals];
            vertices
                .into_iter()
                .flat_map(move |values| corners.map(|corner| values[corner]))
                .flat_map(|value| value.to_array())
        };
        let order = corners(triangle).zip(corners(other));
        let order = order.map(|(here, there)| here.total_cmp(&there));
        match order.fold(Ordering::Equal, Ordering::then) {
            Ordering::Less => triangle,
            Ordering::Greater => other,
            Ordering::Equal => triangle.min(other),
        }
    }

    /// Where a triangle that was drawn is kept: its cluster, and the vertices of its corners there.
    #[inline]
    pub(crate) fn corners(&self, triangle: u32) -> (&Cluster, [usize; 3]) {
        let slot = self.slots[triangle as usize] as usize;
        let cluster = &self.clusters[slot / TRIANGLES];
        (cluster, cluster.corners[slot % TRIANGLES].map(usize::from))
    }
}

impl Cluster {
    fn new(mesh: &Mesh, items: &[Item]) -> Self {
        let mut triangles: Vec<u32> = items.iter().map(|(_, triangle)| *triangle).collect();
        triangles.sort_unstable();
        let vertices = vertices(mesh, items);
        let corner = |vertex: u32| vertices.partition_point(|other| *other < vertex) as u8;
        let positions: Vec<DVec3> = vertices
            .iter()
            .map(|vertex| mesh.positions[*vertex as usize])
            .collect();
        Self {
            corners: triangles
                .iter()
                .map(|triangle| mesh.triangles[*triangle as usize].map(corner))
                .collect(),
            normals: vertices
                .iter()
                .map(|vertex| {
                    mesh.normals
                        .get(*vertex as usize)
                        .copied()
                        .unwrap_or_default()
                })
                .collect(),
            bounds: Bounds::around(positions.iter().copied()),
            positions,
            triangles,
        }
    }
}

/// The vertices that triangles use, rising.
fn vertices(mesh: &Mesh, items: &[Item]) -> Vec<u32> {
    let corners = items
        .iter()
        .flat_map(|(_, triangle)| mesh.triangles[*triangle as usize]);
    let mut vertices: Vec<u32> = corners.collect();
    vertices.sort_unstable();
    vertices.dedup();
    vertices
}

/// Halves the triangles along the longest side of the box around their middles until every part fits a cluster.
fn split<'a>(mesh: &Mesh, items: &'a mut [Item]) -> Vec<&'a mut [Item]> {
    if items.is_empty() {
        return Vec::new();
    }
    if items.len() <= TRIANGLES && vertices(mesh, items).len() <= VERTICES {
        return vec![items];
    }
    let (low, high) = items.iter().fold(
        (Vec3::INFINITY, Vec3::NEG_INFINITY),
        |(low, high), (middle, _)| (low.min(*middle), high.max(*middle)),
    );
    let axis = (high - low).max_position();
    // Halves of whole clusters, so that all but the last are full.
    let half = if items.len() <= TRIANGLES {
        items.len() / 2
    } else {
        items.len().div_ceil(TRIANGLES) / 2 * TRIANGLES
    };
    items.select_nth_unstable_by(half, |a, b| a.0[axis].total_cmp(&b.0[axis]));
    let parallel = items.len() >= PARALLEL;
    let (left, right) = items.split_at_mut(half);
    let (mut left, right) = if parallel {
        rayon::join(|| split(mesh, left), || split(mesh, right))
    } else {
        (split(mesh, left), split(mesh, right))
    };
    left.extend(right);
    left
}
