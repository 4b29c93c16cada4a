//! Cross-projection on tensors (Sec. "Proxy-based Cross-projection").
//!
//! A surface point of the target is projected into a source view and sampled there bilinearly. Each of the four
//! neighbouring source pixels is depth-tested by itself, so that a pixel of an occluder never bleeds into the result
//! and visibility falls off softly at its edge.
//!
//! The lookup is kept apart from the sampling: [`Taps`] are four pixel indices and weights per point, computed once
//! per (target, source) pair; any image of the source (colour, diffuse, effects) is then a weighted gather, which is
//! differentiable in the image.
//!
//! The test against the f64 implementation is in `tests/warp_agrees.rs`.

use glam::{DAffine3, DVec3};
use ign_geometry::Camera;
use tch::{Device, Kind, Tensor};

/// Reductions keep the kind of their input, so that gradients can be checked in f64.
const KEEP: Option<Kind> = None;

/// Cosine below which a source sees a point too obliquely to be used at all.
pub const GRAZING_COSINE: f64 = 0.05;
/// Cosine above which a source's obliqueness costs no confidence.
pub const FACING_COSINE: f64 = 0.25;

/// Several source views of one size: cameras and depth, flattened, on one device.
#[derive(Debug)]
pub struct Sources {
    width: i64,
    height: i64,
    /// [V, 3, 4] f32: `camera_from_world`.
    pose: Tensor,
    /// [V, 4] f32: fx, fy, cx, cy in pixels.
    intrinsics: Tensor,
    /// [V, 3] f32: camera centres.
    centers: Tensor,
    /// [V*H*W] f32: camera z; 0 where the source has no surface.
    depth: Tensor,
}

/// For each of P points: four pixels of the flattened stack of sources and their weights.
#[derive(Debug)]
pub struct Taps {
    /// [P, 4] i64 into [V*H*W].
    pub index: Tensor,
    /// [P, 4] f32: bilinear weight, 0 where the depth test fails.
    pub weight: Tensor,
    /// [P] f32 in [0, 1]: sum of the weights; how much of the footprint the source sees.
    pub visibility: Tensor,
    /// [P] f32 in [0, 1]: confidence from the angle between the surface and the source's ray.
    pub facing: Tensor,
    /// [P, 2] f32: the point's place in the source, `2u/W - 1`, clamped to [-2, 2].
    pub grid: Tensor,
}

impl Sources {
    /// `depth`: [V*H*W], a camera-z map per camera, 0 where there is no surface; all cameras of one size.
    pub fn new(cameras: &[Camera], depth: &[f32], device: Device) -> Self {
        let (width, height) = cameras.first().map_or((0, 0), |c| {
            (
                i64::from(c.intrinsics.width),
                i64::from(c.intrinsics.height),
            )
        });
        let pose: Vec<f32> = cameras
            .iter()
            .flat_map(|c| rows(&c.camera_from_world))
            .collect();
        let intrinsics: Vec<f32> = cameras
            .iter()
            .flat_map(|c| {
                [
                    c.intrinsics.fx,
                    c.intrinsics.fy,
                    c.intrinsics.cx,
                    c.intrinsics.cy,
                ]
                .map(|x| x as f32)
            })
            .collect();
        let centers: Vec<f32> = cameras.iter().flat_map(|c| to_f32(c.center())).collect();
        let views = cameras.len() as i64;
        Self {
            width,
            height,
            pose: Tensor::from_slice(&pose)
                .view([views, 3, 4])
                .to_device(device),
            intrinsics: Tensor::from_slice(&intrinsics)
                .view([views, 4])
                .to_device(device),
            centers: Tensor::from_slice(&centers)
                .view([views, 3])
                .to_device(device),
            depth: Tensor::from_slice(depth).to_device(device),
        }
    }

    /// Number of views.
    pub fn len(&self) -> usize {
        self.pose.size()[0] as usize
    }

    /// Whether there is no view.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// [V, 3] f32: camera centres.
    pub fn centers(&self) -> &Tensor {
        &self.centers
    }

    /// Where the tensors live.
    pub fn device(&self) -> Device {
        self.depth.device()
    }

    /// points: [P, 3] in the sources' world; normals: [P, 3], unit; view: [P] i64, which source each point looks up.
    ///
    /// Points behind the source, outside its picture or occluded get weight 0; every output is finite for finite
    /// input.
    pub fn taps(&self, points: &Tensor, normals: &Tensor, view: &Tensor) -> Taps {
        let pose = self.pose.index_select(0, view);
        let k = self.intrinsics.index_select(0, view);
        let rotated = (pose.narrow(2, 0, 3) * points.unsqueeze(1)).sum_dim_intlist(
            [2i64].as_slice(),
            false,
            Kind::Float,
        );
        let in_camera = rotated + pose.select(2, 3);
        let z = in_camera.select(1, 2);
        let in_front = z.gt(1e-4);
        let z_safe = z.clamp_min(1e-4);
        // Far outside is as good as outside: the clamp keeps later integer conversions defined.
        let limit = 4.0 * self.width.max(self.height) as f64;
        let u = (in_camera.select(1, 0) / &z_safe * k.select(1, 0) + k.select(1, 2))
            .clamp(-limit, limit);
        let v = (in_camera.select(1, 1) / &z_safe * k.select(1, 1) + k.select(1, 3))
            .clamp(-limit, limit);

        let to_source = self.centers.index_select(0, view) - points;
        let distance = to_source
            .square()
            .sum_dim_intlist([1i64].as_slice(), false, Kind::Float)
            .sqrt()
            .clamp_min(1e-9);
        let cosine =
            (to_source * normals).sum_dim_intlist([1i64].as_slice(), false, Kind::Float) / distance;
        let facing =
            ((&cosine - GRAZING_COSINE) / (FACING_COSINE - GRAZING_COSINE)).clamp(0.0, 1.0);
        let cosine = cosine.clamp(0.1, 1.0);
        let sine: Tensor = (1.0f64 - cosine.square()).clamp_min(0.0).sqrt();
        let tangent = sine / cosine;
        // A neighbouring pixel lies up to one footprint aside; on a slanted surface its depth differs by that much
        // times the slope. One more footprint covers the proxy's own quantisation.
        let footprint = &z_safe / k.select(1, 0);
        let bias = footprint * (tangent + 1.0) * 1.5;

        let x = &u - 0.5;
        let y = &v - 0.5;
        let x0 = x.floor();
        let y0 = y.floor();
        let fx = &x - &x0;
        let fy = &y - &y0;
        let (x0, y0) = (x0.to_kind(Kind::Int64), y0.to_kind(Kind::Int64));
        let base = view * (self.width * self.height);
        let mut indices = Vec::with_capacity(4);
        let mut weights = Vec::with_capacity(4);
        for (dx, dy) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
            let xi = &x0 + dx;
            let yi = &y0 + dy;
            let inside = xi
                .ge(0)
                .logical_and(&xi.lt(self.width))
                .logical_and(&yi.ge(0))
                .logical_and(&yi.lt(self.height));
            let index =
                &base + yi.clamp(0, self.height - 1) * self.width + xi.clamp(0, self.width - 1);
            let d = self.depth.index_select(0, &index);
            let passes = d
                .gt(0.0)
                .logical_and(&z.le_tensor(&(&d + &bias)))
                .logical_and(&z.ge_tensor(&(&d - &bias * 4.0)));
            let wx = if dx == 1 {
                fx.shallow_clone()
            } else {
                1.0f64 - &fx
            };
            let wy = if dy == 1 {
                fy.shallow_clone()
            } else {
                1.0f64 - &fy
            };
            let usable = inside
                .logical_and(&passes)
                .logical_and(&in_front)
                .to_kind(Kind::Float);
            weights.push(wx * wy * usable);
            indices.push(index);
        }
        let weight = Tensor::stack(&weights, 1) * facing.gt(0.0).to_kind(Kind::Float).unsqueeze(1);
        let visibility = weight.sum_dim_intlist([1i64].as_slice(), false, Kind::Float);
        let grid = Tensor::stack(
            &[
                &u * (2.0 / self.width as f64) - 1.0,
                &v * (2.0 / self.height as f64) - 1.0,
            ],
            1,
        )
        .clamp(-2.0, 2.0);
        Taps {
            index: Tensor::stack(&indices, 1),
            weight,
            visibility,
            facing,
            grid,
        }
    }
}

impl Taps {
    /// Weighted sum of the four pixels: image [V*H*W, C] -> [P, C]; not divided by the weights.
    pub fn gather(&self, image: &Tensor) -> Tensor {
        let channels = image.size()[1];
        let points = self.index.size()[0];
        let picked = image
            .index_select(0, &self.index.view([-1]))
            .view([points, 4, channels]);
        let weight = self.weight.to_kind(image.kind()).unsqueeze(2);
        (picked * weight).sum_dim_intlist([1i64].as_slice(), false, KEEP)
    }

    /// These taps with each weight multiplied by the source's own weight: alpha [V*H*W].
    #[must_use]
    pub fn weighted(&self, alpha: &Tensor) -> Self {
        let points = self.index.size()[0];
        let weight = self.weight.to_kind(alpha.kind())
            * alpha
                .index_select(0, &self.index.view([-1]))
                .view([points, 4]);
        let visibility = weight.sum_dim_intlist([1i64].as_slice(), false, KEEP);
        Self {
            index: self.index.shallow_clone(),
            weight,
            visibility,
            facing: self.facing.shallow_clone(),
            grid: self.grid.shallow_clone(),
        }
    }
}

fn rows(transform: &DAffine3) -> [f32; 12] {
    let m = transform.matrix3;
    let t = transform.translation;
    [
        m.x_axis.x, m.y_axis.x, m.z_axis.x, t.x, m.x_axis.y, m.y_axis.y, m.z_axis.y, t.y,
        m.x_axis.z, m.y_axis.z, m.z_axis.z, t.z,
    ]
    .map(|x| x as f32)
}

fn to_f32(v: DVec3) -> [f32; 3] {
    [v.x as f32, v.y as f32, v.z as f32]
}

/// Unit vectors from points [P, 3] towards centres [P, 3] or [1, 3].
pub fn directions(centers: &Tensor, points: &Tensor) -> Tensor {
    let d = centers - points;
    let norm = d
        .square()
        .sum_dim_intlist([1i64].as_slice(), true, KEEP)
        .sqrt()
        .clamp_min(1e-9);
    d / norm
}

/// Mirrors unit directions towards the viewer [P, 3] about unit normals [P, 3].
pub fn reflections(to_viewer: &Tensor, normals: &Tensor) -> Tensor {
    let cosine = (to_viewer * normals).sum_dim_intlist([1i64].as_slice(), true, KEEP);
    cosine * 2.0 * normals - to_viewer
}
