//! A plain implementation that judges the fast one: every ray against every triangle, one pixel after the other, all
//! in f64, written from the definitions.

use glam::{DVec2, DVec3};
use ign_geometry::{Camera, GBuffer, Mesh, WarpOptions};

/// Where a ray meets the mesh first.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Hit {
    /// In units of the ray's direction.
    pub distance: f64,
    /// Index of the triangle.
    pub triangle: usize,
    /// Weights of its corners, of sum 1; all at least 0.
    pub weights: [f64; 3],
}

/// All hits of a ray from `origin`, in the order of the triangles.
pub fn hits(mesh: &Mesh, origin: DVec3, direction: DVec3) -> impl Iterator<Item = Hit> {
    mesh.triangles
        .iter()
        .enumerate()
        .filter_map(move |(triangle, corners)| {
            let [a, b, c] = corners.map(|corner| mesh.positions[corner as usize]);
            // Where the ray meets the plane, then the three sub-areas.
            let normal = (b - a).cross(c - a);
            let distance = (a - origin).dot(normal) / direction.dot(normal);
            let point = origin + direction * distance;
            let area = |p: DVec3, q: DVec3| {
                (p - point).cross(q - point).dot(normal) / normal.length_squared()
            };
            let weights = [area(b, c), area(c, a), area(a, b)];
            (distance > 0.0 && weights.iter().all(|weight| *weight >= 0.0)).then_some(Hit {
                distance,
                triangle,
                weights,
            })
        })
}

/// The nearest hit of a ray from `origin`, the first of equals.
pub fn cast(mesh: &Mesh, origin: DVec3, direction: DVec3) -> Option<Hit> {
    hits(mesh, origin, direction).reduce(|nearest, hit| {
        if hit.distance < nearest.distance {
            hit
        } else {
            nearest
        }
    })
}

/// Origin and direction of the ray through an image point, scaled so that distances along it are depths.
pub fn ray(camera: &Camera, x: f64, y: f64) -> (DVec3, DVec3) {
    let k = &camera.intrinsics;
    let rotation = camera.camera_from_world.matrix3.inverse();
    let origin = rotation * -camera.camera_from_world.translation;
    (
        origin,
        rotation * DVec3::new((x - k.cx) / k.fx, (y - k.cy) / k.fy, 1.0),
    )
}

/// Index, column and row of every pixel of a camera's image.
pub fn pixels(camera: &Camera) -> impl Iterator<Item = (usize, u32, u32)> + use<> {
    let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
    (0..height).flat_map(move |row| {
        (0..width).map(move |column| ((row * width + column) as usize, column, row))
    })
}

/// Bilinear sample of one channel of a map, with repeated border, over the pixels that have a value.
pub fn bilinear(value: impl Fn(usize) -> Option<f64>, camera: &Camera, px: DVec2) -> Option<f64> {
    let (width, height) = (
        i64::from(camera.intrinsics.width),
        i64::from(camera.intrinsics.height),
    );
    let (mut sum, mut total) = (0.0, 0.0);
    for dy in 0..2 {
        for dx in 0..2 {
            let (column, row) = (
                (px.x - 0.5).floor() as i64 + dx,
                (px.y - 0.5).floor() as i64 + dy,
            );
            // A pixel's weight falls linearly from 1 at its centre to 0 at its neighbour's.
            let weight_x = 1.0 - (px.x - (column as f64 + 0.5)).abs();
            let weight_y = 1.0 - (px.y - (row as f64 + 0.5)).abs();
            let index = row.clamp(0, height - 1) * width + column.clamp(0, width - 1);
            if let Some(value) = value(index as usize) {
                sum += weight_x * weight_y * value;
                total += weight_x * weight_y;
            }
        }
    }
    (total > 0.0).then_some(sum / total)
}

/// How far a point is from being rejected by the depth test (positive: seen), or `None` when it is for other reasons:
/// behind the camera, outside the image, turned away, or nothing of the object there.
pub fn margin(
    source: &GBuffer,
    position: DVec3,
    normal: DVec3,
    options: &WarpOptions,
) -> Option<f64> {
    let k = &source.camera.intrinsics;
    let point = source.camera.camera_from_world.transform_point3(position);
    let px = DVec2::new(
        k.fx * point.x / point.z + k.cx,
        k.fy * point.y / point.z + k.cy,
    );
    if point.z <= 0.0
        || px.x < 0.0
        || px.y < 0.0
        || px.x > f64::from(k.width)
        || px.y > f64::from(k.height)
    {
        return None;
    }
    let eye = ray(&source.camera, 0.0, 0.0).0;
    let cos = normal.dot(eye - position) / (eye - position).length();
    if cos < options.grazing_cos {
        return None;
    }
    let depth = |index: usize| source.mask[index].then(|| f64::from(source.depth[index]));
    let surface = bilinear(depth, &source.camera, px)?;
    let footprint = point.z / (0.5 * (k.fx + k.fy));
    let bias = options.relative_bias * point.z
        + options.slope_footprints * footprint / cos.max(options.min_cos);
    Some(surface + bias - point.z)
}

/// Position and normal of a pixel of a G-buffer.
pub fn surface_point(buffer: &GBuffer, index: usize) -> (DVec3, DVec3) {
    let vector = |map: &[[f32; 3]]| DVec3::from_array(map[index].map(f64::from));
    (vector(&buffer.position), vector(&buffer.normal))
}
