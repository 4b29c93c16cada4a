//! Surfaces of revolution as triangles.
//!
//! A profile is a smooth curve through a few control points in the half plane (distance from the axis, height). It
//! runs from the axis at the bottom over the outside to the rim and back over the inside to the axis, so the solid has
//! a wall of some thickness. Rows of the grid lie along the profile, denser where it bends; columns go around.
//!
//! The tracer sees these triangles, not the smooth curve: mesh and images agree exactly. Positions are rounded to
//! f32 first, since that is what the PLY file holds.

use glam::{DVec2, DVec3};

use crate::Shape;

/// Grid of the finest mesh: 2 * 176 * (148 - 1) triangles, less at the poles.
const COLUMNS: usize = 176;
const ROWS: usize = 148;
/// Size of the images from which on the mesh is the finest: in smaller ones its triangles would be far below a pixel.
const FINEST_PX: f64 = 96.0;
/// The coarsest mesh, as a share of the finest one's rows and columns.
const COARSEST: f64 = 0.3;

/// Where the object stands in the world: nothing may rely on it being centred.
const CENTER: DVec3 = DVec3::new(0.25, -0.4, 0.6);

/// How much a turn of the profile by one radian counts as arc length when rows are spread.
const BEND_WEIGHT: f64 = 0.22;

/// Samples per span between control points for measuring the curve.
const FINE: usize = 200;

/// A tessellated surface of revolution about the vertical axis through `center`.
pub(crate) struct Surface {
    pub(crate) center: DVec3,
    /// World positions, exactly representable in f32.
    pub(crate) positions: Vec<DVec3>,
    /// Unit normals of the smooth surface.
    pub(crate) normals: Vec<DVec3>,
    /// Row coordinate of each vertex, from 0 on.
    pub(crate) rows: Vec<f64>,
    /// Counter-clockwise seen from outside.
    pub(crate) triangles: Vec<[u32; 3]>,
    profile: Vec<ProfileRow>,
    columns: usize,
    /// Row coordinate of the rim: rows beyond are the inside. Infinite for closed shapes.
    pub(crate) rim_row: f64,
}

/// One row of the grid in the half plane.
#[derive(Clone, Copy)]
struct ProfileRow {
    point: DVec2,
    normal: DVec2,
}

impl Surface {
    /// As fine as images of `size` pixels show.
    pub(crate) fn new(shape: Shape, size: u32) -> Self {
        let detail = (f64::from(size) / FINEST_PX).clamp(COARSEST, 1.0);
        let of = |finest: usize| (finest as f64 * detail).round() as usize;
        let (rows, columns) = (of(ROWS), of(COLUMNS));
        let (controls, rim) = controls(shape);
        let (profile, rim_row) = rows_along(&controls, rim, rows);
        let mut surface = Self {
            center: CENTER,
            positions: Vec::with_capacity(rows * columns),
            normals: Vec::with_capacity(rows * columns),
            rows: Vec::with_capacity(rows * columns),
            triangles: Vec::with_capacity(2 * rows * columns),
            profile,
            columns,
            rim_row,
        };
        surface.tessellate();
        surface
    }

    pub(crate) fn row_count(&self) -> usize {
        self.profile.len()
    }

    /// Smooth point and normal at a row coordinate and an angle, in the world.
    pub(crate) fn at(&self, row: f64, angle: f64) -> (DVec3, DVec3) {
        let rows = self.row_count();
        let row = row.clamp(0.0, (rows - 1) as f64);
        let low = (row as usize).min(rows - 2);
        let (a, b) = (self.profile[low], self.profile[low + 1]);
        let share = row - low as f64;
        let normal = a.normal.lerp(b.normal, share).normalize_or(a.normal);
        (
            self.center + turned(a.point.lerp(b.point, share), angle),
            turned(normal, angle),
        )
    }

    fn tessellate(&mut self) {
        let (last, round) = (self.row_count() - 1, self.columns);
        let mut first_of_row = Vec::with_capacity(last + 1);
        for (row, ProfileRow { point, normal }) in self.profile.clone().into_iter().enumerate() {
            first_of_row.push(self.positions.len());
            let columns = if row == 0 || row == last { 1 } else { round };
            for column in 0..columns {
                let angle = std::f64::consts::TAU * column as f64 / round as f64;
                let position = self.center + turned(point, angle);
                self.positions.push(position.as_vec3().as_dvec3());
                self.normals.push(turned(normal, angle));
                self.rows.push(row as f64);
            }
        }
        for row in 0..last {
            // At a pole one of the quad's triangles has no area: its row has a single vertex.
            let vertex = |row: usize, column: usize| {
                let around = if row == 0 || row == last {
                    0
                } else {
                    column % round
                };
                (first_of_row[row] + around) as u32
            };
            for column in 0..round {
                let (a, b) = (vertex(row, column), vertex(row, column + 1));
                let (c, d) = (vertex(row + 1, column + 1), vertex(row + 1, column));
                if row != 0 {
                    self.triangles.push([a, b, c]);
                }
                if row + 1 != last {
                    self.triangles.push([a, c, d]);
                }
            }
        }
    }
}

/// From the half plane into space.
fn turned(point: DVec2, angle: f64) -> DVec3 {
    let (sin, cos) = angle.sin_cos();
    DVec3::new(point.x * cos, point.x * sin, point.y)
}

/// Control points (distance from the axis, height) and the index of the rim.
fn controls(shape: Shape) -> (Vec<DVec2>, Option<usize>) {
    let points = |list: &[(f64, f64)]| list.iter().map(|&(r, z)| DVec2::new(r, z)).collect();
    match shape {
        Shape::Vase => {
            let list = [
                (0.0, -0.97),
                (0.27, -0.975),
                (0.345, -0.965),
                (0.35, -0.92),
                (0.275, -0.86),
                (0.29, -0.79),
                (0.45, -0.50),
                (0.615, -0.13),
                (0.655, 0.14),
                (0.585, 0.41),
                (0.385, 0.605),
                (0.255, 0.72),
                (0.232, 0.82),
                (0.285, 0.93),
                (0.352, 0.965),
                (0.345, 0.985),
                (0.30, 0.97),
                (0.212, 0.84),
                (0.225, 0.72),
                (0.345, 0.585),
                (0.545, 0.39),
                (0.61, 0.14),
                (0.57, -0.12),
                (0.40, -0.48),
                (0.22, -0.74),
                (0.0, -0.79),
            ];
            (points(&list), Some(15))
        }
        Shape::Bowl => {
            let list = [
                (0.0, -0.44),
                (0.30, -0.445),
                (0.355, -0.435),
                (0.345, -0.37),
                (0.42, -0.315),
                (0.66, -0.17),
                (0.84, 0.08),
                (0.92, 0.33),
                (0.965, 0.43),
                (0.95, 0.445),
                (0.905, 0.385),
                (0.865, 0.30),
                (0.785, 0.08),
                (0.60, -0.13),
                (0.33, -0.26),
                (0.0, -0.29),
            ];
            (points(&list), Some(9))
        }
        Shape::Sphere => {
            let arc = |step: i32| {
                let angle = std::f64::consts::PI * (f64::from(step) / 24.0 - 0.5);
                DVec2::new((0.9 * angle.cos()).max(0.0), 0.9 * angle.sin())
            };
            ((0..=24).map(arc).collect(), None)
        }
    }
}

/// Spreads the rows along the curve; also the rim's row coordinate.
fn rows_along(controls: &[DVec2], rim: Option<usize>, rows: usize) -> (Vec<ProfileRow>, f64) {
    // Mirrored across the axis, so that the curve meets it at a right angle.
    let mirrored = |p: DVec2| DVec2::new(-p.x, p.y);
    let mut extended = vec![mirrored(controls[1])];
    extended.extend_from_slice(controls);
    extended.push(mirrored(controls[controls.len() - 2]));

    let mut fine: Vec<DVec2> = Vec::new();
    for span in extended.windows(4) {
        for step in 0..FINE {
            fine.push(centripetal(
                [span[0], span[1], span[2], span[3]],
                step as f64 / FINE as f64,
            ));
        }
    }
    fine.extend(controls.last());
    let directions: Vec<DVec2> = fine
        .windows(2)
        .map(|pair| (pair[1] - pair[0]).normalize_or_zero())
        .collect();
    let mut measure = vec![0.0];
    for (index, pair) in fine.windows(2).enumerate() {
        let turn = if index == 0 {
            0.0
        } else {
            directions[index - 1].angle_to(directions[index]).abs()
        };
        measure.push(measure[index] + pair[0].distance(pair[1]) + BEND_WEIGHT * turn);
    }
    let total = measure[measure.len() - 1];

    let mut profile = Vec::with_capacity(rows);
    let mut index = 0;
    for row in 0..rows {
        let wanted = total * row as f64 / (rows - 1) as f64;
        while index + 2 < measure.len() && measure[index + 1] < wanted {
            index += 1;
        }
        let share = ((wanted - measure[index]) / (measure[index + 1] - measure[index]).max(1e-12))
            .clamp(0.0, 1.0);
        let mut point = fine[index].lerp(fine[index + 1], share);
        let direction = directions[index];
        let mut normal = DVec2::new(direction.y, -direction.x);
        if row == 0 || row == rows - 1 {
            point.x = 0.0;
            normal = DVec2::new(0.0, normal.y.signum());
        }
        profile.push(ProfileRow {
            point: DVec2::new(point.x.max(0.0), point.y),
            normal,
        });
    }
    let rim_row = rim.map_or(f64::INFINITY, |rim| {
        (rows - 1) as f64 * measure[rim * FINE] / total
    });
    (profile, rim_row)
}

/// Centripetal Catmull-Rom (Barry and Goldman's form) between the two middle points, at `share` of the way.
fn centripetal(p: [DVec2; 4], share: f64) -> DVec2 {
    let mut knots = [0.0; 4];
    for i in 1..4 {
        knots[i] = knots[i - 1] + p[i].distance(p[i - 1]).sqrt().max(1e-6);
    }
    let t = knots[1] + (knots[2] - knots[1]) * share;
    let blend = |a: DVec2, b: DVec2, from: f64, to: f64| a.lerp(b, (t - from) / (to - from));
    let a: Vec<DVec2> = (0..3)
        .map(|i| blend(p[i], p[i + 1], knots[i], knots[i + 1]))
        .collect();
    let b: Vec<DVec2> = (0..2)
        .map(|i| blend(a[i], a[i + 1], knots[i], knots[i + 2]))
        .collect();
    blend(b[0], b[1], knots[1], knots[2])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn surfaces_are_closed_and_face_outwards() {
        let sizes = [(1, 4_000..6_000), (4096, 40_000..60_000)];
        for (shape, (size, triangles)) in Shape::ALL
            .into_iter()
            .flat_map(|shape| sizes.clone().map(|size| (shape, size)))
        {
            let surface = Surface::new(shape, size);
            let mut volume = 0.0;
            let mut edges = std::collections::BTreeMap::new();
            for &[a, b, c] in &surface.triangles {
                let corner = |i: u32| surface.positions[i as usize] - surface.center;
                volume += corner(a).dot(corner(b).cross(corner(c))) / 6.0;
                let face = (corner(b) - corner(a)).cross(corner(c) - corner(a));
                let normal = surface.normals[a as usize]
                    + surface.normals[b as usize]
                    + surface.normals[c as usize];
                assert!(
                    face.dot(normal) > 0.0,
                    "{shape:?}: triangle {a} {b} {c} faces inwards"
                );
                for (from, to) in [(a, b), (b, c), (c, a)] {
                    *edges.entry((from.min(to), from.max(to))).or_insert(0) +=
                        if from < to { 1 } else { -1 };
                }
            }
            assert!(volume > 0.05, "{shape:?}: volume {volume}");
            assert!(
                edges.values().all(|&sum| sum == 0),
                "{shape:?} has a boundary"
            );
            assert!(
                triangles.contains(&surface.triangles.len()),
                "{}",
                surface.triangles.len()
            );
        }
    }
}
