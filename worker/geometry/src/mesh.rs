//! Triangle meshes: the proxy geometry.
//!
//! Invariants of a mesh made by [`Mesh::new`] or [`crate::read_mesh`]: positions finite, indices in range, at least
//! one triangle, none degenerate, none twice, one unit normal per vertex.

use std::collections::HashSet;
use std::path::PathBuf;

use glam::DVec3;

use crate::Similarity;

/// Refinement steps of the bounding sphere; its radius is then within about 1 % of the smallest possible.
const SPHERE_STEPS: u32 = 100;

/// Coordinates beyond this would overflow where they are squared or multiplied.
const LARGEST: f64 = 1e100;

/// Cosine of the angle between two faces at a vertex beyond which they are taken to be wound against each other. No
/// corner of an object is near it, as a box's is near 0: there a rounding would decide.
const OPPOSITE_COSINE: f64 = -0.5;

/// Why a mesh cannot be used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum MeshError {
    /// The file cannot be read.
    #[error("cannot read mesh {path}")]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        #[source]
        source: std::io::Error,
    },
    /// The file breaks its format.
    #[error("mesh {path}, {at}: {reason}")]
    Malformed {
        /// The file.
        path: PathBuf,
        /// Where: `line 12`, `byte 4096` or `vertex 7`.
        at: String,
        /// What is wrong there.
        reason: String,
    },
    /// None of our formats by content and name.
    #[error("mesh {path} is no PLY, OBJ, STL, GLB or glTF")]
    UnknownFormat {
        /// The file.
        path: PathBuf,
    },
    /// The file was read, but what it holds is no usable mesh.
    #[error("mesh {path} cannot be used")]
    Unusable {
        /// The file.
        path: PathBuf,
        /// Why.
        #[source]
        source: Box<MeshError>,
    },
    /// A coordinate that is NaN or infinite.
    #[error("vertex {vertex} has a coordinate that is not finite")]
    NotFinite {
        /// Index of the first such vertex, from 0.
        vertex: usize,
    },
    /// A triangle that names a vertex beyond the last.
    #[error("triangle {triangle} names vertex {index}, but there are {vertices} vertices")]
    IndexOutOfRange {
        /// Index of the triangle, from 0.
        triangle: usize,
        /// The vertex it names, from 0.
        index: u32,
        /// Number of vertices.
        vertices: usize,
    },
    /// A coordinate so large that its square is not finite.
    #[error("vertex {vertex} has the coordinate {coordinate:e}, beyond 1e100")]
    TooFar {
        /// Index of the first such vertex, from 0.
        vertex: usize,
        /// Its largest coordinate.
        coordinate: f64,
    },
    /// No triangle with an area.
    #[error("{}", no_triangles(*triangles))]
    NoTriangles {
        /// Number of triangles before degenerate ones were dropped.
        triangles: usize,
    },
    /// More triangles or vertices than 32-bit indices can name.
    #[error("{count} elements are more than 32-bit indices can name")]
    TooLarge {
        /// Number of triangles or vertices.
        count: usize,
    },
}

fn no_triangles(triangles: usize) -> String {
    match triangles {
        0 => "it holds points but no triangles".into(),
        _ => format!("no triangle with an area is left of {triangles}"),
    }
}

/// A triangle mesh with one normal per vertex.
#[derive(Clone, Debug, PartialEq)]
pub struct Mesh {
    /// Vertex positions.
    pub positions: Vec<DVec3>,
    /// Unit normal of each vertex; `+z` where no triangle defines one.
    pub normals: Vec<DVec3>,
    /// sRGB colour of each vertex, where the file has one.
    pub colors: Option<Vec<[u8; 3]>>,
    /// Vertex indices of each triangle; counter-clockwise seen from outside, where the capture keeps to that.
    pub triangles: Vec<[u32; 3]>,
}

impl Mesh {
    /// A mesh from positions and triangles. Degenerate triangles (repeated vertex, no area) are dropped, and so are all
    /// but the first of triangles with the same corners, whichever way they turn; normals are the area-weighted mean
    /// of the adjacent faces' normals, whichever way round these are wound.
    ///
    /// # Errors
    /// [`MeshError`] for coordinates that are not finite or beyond 1e100, indices out of range, or no triangle left.
    pub fn new(positions: Vec<DVec3>, triangles: Vec<[u32; 3]>) -> Result<Self, MeshError> {
        let largest = positions.len().max(triangles.len());
        if largest >= u32::MAX as usize {
            return Err(MeshError::TooLarge { count: largest });
        }
        if let Some(vertex) = positions.iter().position(|position| !position.is_finite()) {
            return Err(MeshError::NotFinite { vertex });
        }
        let largest = |position: &DVec3| position.abs().max_element();
        if let Some(vertex) = positions.iter().position(|p| largest(p) > LARGEST) {
            return Err(MeshError::TooFar {
                vertex,
                coordinate: largest(&positions[vertex]),
            });
        }
        for (triangle, corners) in triangles.iter().enumerate() {
            if let Some(&index) = corners
                .iter()
                .find(|&&index| index as usize >= positions.len())
            {
                return Err(MeshError::IndexOutOfRange {
                    triangle,
                    index,
                    vertices: positions.len(),
                });
            }
        }
        let count = triangles.len();
        let mut kept = triangles;
        kept.retain(|&corners| face_vector(&positions, corners).abs().max_element() > 0.0);
        drop_repeated(&mut kept);
        if kept.is_empty() {
            return Err(MeshError::NoTriangles { triangles: count });
        }
        let normals = vertex_normals(&positions, &kept);
        Ok(Self {
            positions,
            normals,
            colors: None,
            triangles: kept,
        })
    }

    /// Replaces computed normals by given ones, vertex by vertex where the given one has a direction.
    pub(crate) fn adopt_normals(&mut self, given: &[DVec3]) {
        for (normal, given) in self.normals.iter_mut().zip(given) {
            if let Some(given) = unit(*given) {
                *normal = given;
            }
        }
    }

    /// Centre and radius of a sphere around all vertices that a triangle uses, near the smallest possible one.
    ///
    /// Bădoiu and Clarkson's iteration from the centre of the bounding box; the result always contains every vertex.
    pub fn bounding_sphere(&self) -> (DVec3, f64) {
        let mut used = vec![false; self.positions.len()];
        for &corner in self.triangles.iter().flatten() {
            if let Some(used) = used.get_mut(corner as usize) {
                *used = true;
            }
        }
        let points: Vec<DVec3> = self
            .positions
            .iter()
            .zip(&used)
            .filter(|(_, used)| **used)
            .map(|(p, _)| *p)
            .collect();
        let Some(&first) = points.first() else {
            return (DVec3::ZERO, 0.0);
        };
        let (low, high) = points
            .iter()
            .fold((first, first), |(low, high), p| (low.min(*p), high.max(*p)));
        let mut center = low.midpoint(high);
        let mut best = (center, f64::INFINITY);
        for step in 0..SPHERE_STEPS {
            let (radius_squared, farthest) =
                points.iter().fold((-1.0, first), |(worst, point), p| {
                    let distance = p.distance_squared(center);
                    if distance > worst {
                        (distance, *p)
                    } else {
                        (worst, point)
                    }
                });
            if radius_squared.sqrt() < best.1 {
                best = (center, radius_squared.sqrt());
            }
            center += (farthest - center) / f64::from(step + 8);
        }
        best
    }

    /// The similarity that puts the bounding sphere at the origin with radius 1.
    pub fn normalisation(&self) -> Similarity {
        let (center, radius) = self.bounding_sphere();
        let scale = if radius > 0.0 && radius.recip().is_finite() {
            radius.recip()
        } else {
            1.0
        };
        Similarity {
            scale,
            translation: center,
        }
    }

    /// The mesh in the new frame of `similarity`; normals, colours and triangles are unchanged.
    #[must_use]
    pub fn transformed(&self, similarity: &Similarity) -> Self {
        let positions = self
            .positions
            .iter()
            .map(|p| similarity.transform_point(*p))
            .collect();
        Self {
            positions,
            ..self.clone()
        }
    }
}

/// Area-weighted mean of the normals of the faces around each vertex; `+z` where there are none.
///
/// Scans hold triangles that are wound the wrong way round, and surfaces that are doubled back to back: summed up as
/// they are, such faces cancel, and what is left is rounding. So a face that points against the largest one at its
/// vertex counts with the opposite sign, and the majority decides which side is outside.
fn vertex_normals(positions: &[DVec3], triangles: &[[u32; 3]]) -> Vec<DVec3> {
    // Twice the area times the unit normal: a sum is area-weighted by itself.
    let faces = || {
        triangles
            .iter()
            .map(|&corners| (corners, face_vector(positions, corners)))
    };
    let mut largest = vec![(0.0, DVec3::ZERO); positions.len()];
    for (corners, vector) in faces() {
        let size = vector.abs().max_element();
        for corner in corners {
            let largest = &mut largest[corner as usize];
            if size > largest.0 {
                *largest = (size, vector / size);
            }
        }
    }
    let mut sums = vec![(DVec3::ZERO, 0.0); positions.len()];
    for (corners, vector) in faces() {
        for corner in corners {
            let (size, direction) = largest[corner as usize];
            let along = (vector / size).dot(direction);
            let limit = OPPOSITE_COSINE * (vector / size).length() * direction.length();
            let sign = if along < limit { -1.0 } else { 1.0 };
            let (sum, side) = &mut sums[corner as usize];
            *sum += vector / size * sign;
            *side += along;
        }
    }
    sums.into_iter()
        .map(|(sum, side)| unit(if side < 0.0 { -sum } else { sum }).unwrap_or(DVec3::Z))
        .collect()
}

/// Drops triangles whose three corners an earlier one has: drawn they would change nothing, but they would count
/// twice for the normals, or cancel them where they turn the other way.
fn drop_repeated(triangles: &mut Vec<[u32; 3]>) {
    let mut seen = HashSet::with_capacity(triangles.len());
    triangles.retain(|corners| {
        let mut corners = *corners;
        corners.sort_unstable();
        seen.insert(corners)
    });
}

/// Normal of a triangle, as long as twice its area.
fn face_vector(positions: &[DVec3], corners: [u32; 3]) -> DVec3 {
    let [a, b, c] = corners.map(|corner| positions[corner as usize]);
    (b - a).cross(c - a)
}

/// Unit vector along `vector`, unless it has no direction. Also right for very short vectors, of tiny triangles.
fn unit(vector: DVec3) -> Option<DVec3> {
    let largest = vector.abs().max_element();
    if !(largest > 0.0 && largest.is_finite()) {
        return None;
    }
    (vector / largest).try_normalize()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tetrahedron() -> (Vec<DVec3>, Vec<[u32; 3]>) {
        let positions = vec![DVec3::ZERO, DVec3::X, DVec3::Y * 2.0, DVec3::Z * 3.0];
        (positions, vec![[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    }

    #[test]
    fn normals_are_unit_and_point_outwards() {
        let (positions, triangles) = tetrahedron();
        let mesh = Mesh::new(positions, triangles).expect("valid");
        let middle = DVec3::new(0.25, 0.5, 0.75);
        for (position, normal) in mesh.positions.iter().zip(&mesh.normals) {
            assert!((normal.length() - 1.0).abs() < 1e-12);
            assert!(normal.dot(*position - middle) > 0.0);
        }
    }

    #[test]
    fn degenerate_triangles_are_dropped_and_bad_ones_named() {
        let (positions, mut triangles) = tetrahedron();
        triangles.push([1, 1, 2]);
        let mesh = Mesh::new(positions.clone(), triangles.clone()).expect("valid");
        assert_eq!(mesh.triangles.len(), 4);
        triangles.push([0, 9, 1]);
        let error = Mesh::new(positions.clone(), triangles).expect_err("index");
        assert!(matches!(
            error,
            MeshError::IndexOutOfRange {
                triangle: 5,
                index: 9,
                vertices: 4
            }
        ));
        let mut broken = positions.clone();
        broken[2].y = f64::NAN;
        assert!(matches!(
            Mesh::new(broken, vec![[0, 1, 3]]),
            Err(MeshError::NotFinite { vertex: 2 })
        ));
        assert!(matches!(
            Mesh::new(positions, vec![[0, 0, 1]]),
            Err(MeshError::NoTriangles { triangles: 1 })
        ));
        assert!(matches!(
            Mesh::new(Vec::new(), Vec::new()),
            Err(MeshError::NoTriangles { triangles: 0 })
        ));
    }

    #[test]
    fn repeated_triangles_change_nothing_and_far_vertices_are_named() {
        let (positions, triangles) = tetrahedron();
        let once = Mesh::new(positions.clone(), triangles.clone()).expect("valid");
        let mut doubled = triangles.clone();
        doubled.extend(triangles.iter().map(|&[a, b, c]| [c, b, a]));
        doubled.extend(triangles.iter().map(|&[a, b, c]| [b, c, a]));
        assert_eq!(Mesh::new(positions.clone(), doubled).expect("valid"), once);
        let mut far = positions;
        far[3].z = -1e101;
        assert!(matches!(
            Mesh::new(far, triangles),
            Err(MeshError::TooFar { vertex: 3, .. })
        ));
    }

    #[test]
    fn tiny_triangles_have_normals() {
        let positions = tetrahedron().0.iter().map(|p| *p * 1e-70).collect();
        let mesh = Mesh::new(positions, tetrahedron().1).expect("valid");
        assert!(
            mesh.normals
                .iter()
                .all(|n| (n.length() - 1.0).abs() < 1e-12)
        );
    }

    #[test]
    fn normalisation_makes_a_unit_sphere_around_used_vertices() {
        let (mut positions, triangles) = tetrahedron();
        positions.push(DVec3::splat(1e9));
        let mesh = Mesh::new(positions, triangles).expect("valid");
        let similarity = mesh.normalisation();
        let moved = mesh.transformed(&similarity);
        let farthest = moved.positions[..4]
            .iter()
            .map(|p| p.length())
            .fold(0.0, f64::max);
        assert!((farthest - 1.0).abs() < 1e-12);
        // The smallest sphere of this tetrahedron has the edge from (0,2,0) to (0,0,3) as its diameter.
        assert!(similarity.scale.recip() < 1.02 * 13.0_f64.sqrt() / 2.0);
    }
}
