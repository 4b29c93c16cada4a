//! G-buffers: what the proxy looks like from a camera, as the maps that the networks read (paper, Sec. `EffectsNet`,
//! "Network Inputs": position, normals, reflected viewing direction).

use glam::{DVec2, DVec3};
use rayon::prelude::{
    IndexedParallelIterator, IntoParallelIterator, IntoParallelRefMutIterator, ParallelIterator,
};

use crate::raster::{DepthBuffer, NO_TRIANGLE, View, key_triangle};
use crate::{Camera, Drawable, Mesh};

/// Rows of normals by differences found by one task, at least.
const ROWS_A_TASK: usize = 32;

/// Maps of one view, row-major, `height * width` entries each. Outside `mask` everything else is zero.
///
/// Positions are f32 and meant for the normalised frame (bounding sphere of radius 1); normalise mesh and camera
/// first.
#[derive(Clone, Debug, PartialEq)]
pub struct GBuffer {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// The camera it was rendered with.
    pub camera: Camera,
    /// Share of each pixel that the mesh covers, in [0, 1].
    pub coverage: Vec<f32>,
    /// Whether the pixel is covered at all: `coverage > 0`.
    pub mask: Vec<bool>,
    /// Camera z.
    pub depth: Vec<f32>,
    /// World position.
    pub position: Vec<[f32; 3]>,
    /// Interpolated normal in world axes, unit, never pointing away from the camera.
    pub normal: Vec<[f32; 3]>,
    /// Normal by finite differences of `position`, as in the paper; unit, never pointing away from the camera.
    /// Where a pixel has no covered neighbours across or along, the interpolated one.
    pub normal_fd: Vec<[f32; 3]>,
    /// Direction, in world axes, in which the viewing ray leaves the surface when reflected about `normal`; unit.
    pub reflection: Vec<[f32; 3]>,
    /// Index of the triangle that the attributes come from; [`NO_TRIANGLE`](crate::NO_TRIANGLE) outside `mask`.
    pub triangle: Vec<u32>,
}

/// Attributes of the surface seen at one point of the image.
struct Attributes {
    depth: f64,
    position: DVec3,
    normal: DVec3,
    reflection: DVec3,
}

impl GBuffer {
    /// Draws `mesh` with `samples` x `samples` samples a pixel. For several views of one mesh, make a [`Drawable`]
    /// once; see [`Drawable::g_buffer`].
    pub fn render(mesh: &Mesh, camera: &Camera, samples: u32) -> Self {
        Drawable::new(mesh).g_buffer(camera, samples)
    }
}

impl Drawable {
    /// Draws the mesh with `samples` x `samples` samples a pixel (0 counts as 1).
    ///
    /// Coverage is the covered share of the samples. The attributes are those of the pixel's centre where the mesh
    /// covers it, so that a map is not shifted by a part of a pixel, and otherwise (in the silhouette's rim) those
    /// of the covered sample nearest to it.
    pub fn g_buffer(&self, camera: &Camera, samples: u32) -> GBuffer {
        let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
        let samples = samples.max(1) as usize;
        let view = View::new(self, camera, samples);
        let order = samples_by_distance(samples);
        let eye = camera.center();
        let pixels = width as usize * height as usize;
        let mut maps = GBuffer {
            width,
            height,
            camera: *camera,
            coverage: vec![0.0; pixels],
            mask: vec![false; pixels],
            depth: vec![0.0; pixels],
            position: vec![[0.0; 3]; pixels],
            normal: vec![[0.0; 3]; pixels],
            normal_fd: Vec::new(),
            reflection: vec![[0.0; 3]; pixels],
            triangle: vec![NO_TRIANGLE; pixels],
        };
        (
            view.bands(&mut maps.coverage),
            view.bands(&mut maps.mask),
            view.bands(&mut maps.depth),
            view.bands(&mut maps.position),
            view.bands(&mut maps.normal),
            view.bands(&mut maps.reflection),
            view.bands(&mut maps.triangle),
        )
            .into_par_iter()
            .enumerate()
            .for_each_init(
                || (DepthBuffer::default(), DepthBuffer::default()),
                |(keys, centers), (band, maps)| {
                    let (coverage, mask, depth, position, normal, reflection, triangle) = maps;
                    view.draw(band, samples, keys);
                    // With an odd number of samples one of them is the centre.
                    if samples.is_multiple_of(2) {
                        view.draw(band, 1, centers);
                    }
                    let top = view.rows(band).start;
                    for index in 0..mask.len() {
                        let (row, column) = (index / view.width, index % view.width);
                        let block = Block {
                            keys: &keys.keys,
                            samples,
                            row_samples: view.width * samples,
                            row,
                            column,
                        };
                        let count = block.count();
                        if count == 0 {
                            continue;
                        }
                        let center = centers.keys.get(index).copied().and_then(key_triangle);
                        let place = center.map(|triangle| (triangle, DVec2::splat(0.5)));
                        let corner = DVec2::new(column as f64, (top + row) as f64);
                        if let Some((found, offset)) = place.or_else(|| block.first(&order))
                            && let Some(seen) = attributes(&view, found, corner + offset, eye)
                        {
                            coverage[index] = count as f32 / (samples * samples) as f32;
                            mask[index] = true;
                            depth[index] = seen.depth as f32;
                            position[index] = seen.position.as_vec3().to_array();
                            normal[index] = seen.normal.as_vec3().to_array();
                            reflection[index] = seen.reflection.as_vec3().to_array();
                            triangle[index] = found;
                        }
                    }
                },
            );
        maps.normal_fd = normals_by_differences(&maps, eye);
        maps
    }
}

/// The samples of one pixel of a band.
struct Block<'a> {
    keys: &'a [u64],
    samples: usize,
    row_samples: usize,
    row: usize,
    column: usize,
}

impl Block<'_> {
    /// Number of covered samples.
    fn count(&self) -> usize {
        let covered = |y: usize| {
            let line = &self.keys[self.index((0, y))..][..self.samples];
            line.iter()
                .filter(|key| key_triangle(**key).is_some())
                .count()
        };
        (0..self.samples).map(covered).sum()
    }

    /// Triangle and place within the pixel of the first covered sample in `order`.
    fn first(&self, order: &[(usize, usize)]) -> Option<(u32, DVec2)> {
        order.iter().find_map(|&(x, y)| {
            let triangle = key_triangle(self.keys[self.index((x, y))])?;
            Some((
                triangle,
                DVec2::new(x as f64 + 0.5, y as f64 + 0.5) / self.samples as f64,
            ))
        })
    }

    fn index(&self, (x, y): (usize, usize)) -> usize {
        (self.row * self.samples + y) * self.row_samples + self.column * self.samples + x
    }
}

/// Samples of a pixel, the one nearest to the centre first; equally near ones in reading order.
fn samples_by_distance(samples: usize) -> Vec<(usize, usize)> {
    let mut order: Vec<(usize, usize)> = (0..samples * samples)
        .map(|index| (index % samples, index / samples))
        .collect();
    let off_center = |index: usize| (2 * index + 1).abs_diff(samples).pow(2);
    order.sort_by_key(|&(x, y)| off_center(x) + off_center(y));
    order
}

/// Surface attributes where the ray through `px` meets `triangle`.
#[inline]
fn attributes(view: &View<'_>, triangle: u32, px: DVec2, eye: DVec3) -> Option<Attributes> {
    let surface = view.surface(triangle, px)?;
    let weights = surface.weights;
    let (cluster, corners) = (surface.cluster, surface.corners);
    let [a, b, c] = corners.map(|corner| cluster.positions[corner]);
    let position = a * weights[0] + b * weights[1] + c * weights[2];
    if !position.as_vec3().is_finite() {
        return None;
    }
    let view = (position - eye).try_normalize()?;
    let face = (b - a).cross(c - a);
    let face = if face.dot(view) > 0.0 { -face } else { face };
    // The side is the face's, at each corner by itself: a vertex of triangles with mixed winding points anywhere, and an
    // interpolated normal alone would flip in the middle of a silhouette's triangle.
    let normal = corners
        .iter()
        .zip(weights)
        .map(|(corner, weight)| {
            let normal = cluster.normals[*corner];
            let side = if normal.dot(face) < 0.0 { -1.0 } else { 1.0 };
            normal * side * weight
        })
        .sum::<DVec3>();
    let normal = facing(normal, view)
        .or_else(|| facing(face, view))
        .unwrap_or(-view);
    Some(Attributes {
        depth: surface.depth,
        position,
        normal,
        reflection: view - normal * (2.0 * view.dot(normal)),
    })
}

/// Unit vector along `normal`, tilted just so far that it does not point away along the viewing direction.
fn facing(normal: DVec3, view: DVec3) -> Option<DVec3> {
    let normal = normal.try_normalize()?;
    let away = normal.dot(view);
    if away <= 0.0 {
        Some(normal)
    } else {
        (normal - view * away).try_normalize()
    }
}

/// Normals from differences of neighbouring positions: central where both neighbours are covered, else one-sided.
fn normals_by_differences(maps: &GBuffer, eye: DVec3) -> Vec<[f32; 3]> {
    let (width, mask) = (maps.width as usize, &maps.mask);
    let mut normals = vec![[0.0_f32; 3]; mask.len()];
    let position = |index: usize| glam::Vec3::from(maps.position[index]).as_dvec3();
    let covered = |index: Option<usize>| {
        index.filter(|index| mask.get(*index).is_some_and(|covered| *covered))
    };
    normals
        .par_iter_mut()
        .enumerate()
        .with_min_len(width.max(1) * ROWS_A_TASK)
        .filter(|(index, _)| mask[*index])
        .for_each(|(index, normal)| {
            let column = index % width;
            let difference = |before: Option<usize>, after: Option<usize>| {
                let (before, after) = (
                    covered(before).unwrap_or(index),
                    covered(after).unwrap_or(index),
                );
                position(after) - position(before)
            };
            let across = difference(
                index.checked_sub(1).filter(|_| column > 0),
                Some(index + 1).filter(|_| column + 1 < width),
            );
            let along = difference(index.checked_sub(width), Some(index + width));
            let view = (position(index) - eye).normalize_or_zero();
            let vector = along.cross(across);
            let vector = if vector.dot(view) > 0.0 {
                -vector
            } else {
                vector
            };
            *normal = facing(vector, view)
                .map_or(maps.normal[index], |normal| normal.as_vec3().to_array());
        });
    normals
}
