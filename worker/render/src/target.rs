//! The geometry of one view to be rendered: visible surface points, their pixels, and coverage.

use ign_geometry::{Camera, Drawable, GBuffer};
use ign_nets::color;
use tch::{Device, Kind, Tensor};

use crate::references::selection_camera;
use crate::settings::{CoverageRule, RenderSettings};

/// Coverage samples per side of one sub-sample cell: 4 x 4 within each cell of a supersampled pixel.
const CELL_SAMPLES: u32 = 4;

/// Cells per pixel side, at least, whose coverage is taken apart.
pub const COVERAGE_CELLS: u32 = 2;

/// What the proxy looks like from one camera. All tensors are in the normalised frame, on one device.
#[derive(Debug)]
pub struct Target {
    /// The camera, normalised frame.
    pub camera: Camera,
    /// Small G-buffer on which reference views are chosen.
    pub selection: GBuffer,
    /// Triangle under each point, [P].
    pub triangles: Vec<u32>,
    /// [P, 3]: surface points, one per covered sub-sample.
    pub points: Tensor,
    /// [P, 3]: unit normals that face the camera.
    pub normals: Tensor,
    /// [P, 3]: unit directions towards the camera.
    pub to_viewer: Tensor,
    /// [P] i64: the pixel (row-major) each point belongs to.
    pub pixel: Tensor,
    /// [P]: covered fraction of the sub-sample's cell.
    pub weight: Tensor,
    /// [H*W]: sum of the weights per pixel.
    pub total: Tensor,
    /// [1, 1, H, W] in [0, 1]: factor that composites encoded colours over black.
    pub coverage: Tensor,
    /// [1, 9, H, W]: mean position, unit normal and reflection of the covered part; 0 elsewhere.
    pub geometry: Tensor,
}

impl Target {
    /// Draws the proxy (normalised frame) for `camera` (normalised frame).
    pub fn new(
        proxy: &Drawable,
        camera: &Camera,
        settings: &RenderSettings,
        device: Device,
    ) -> Self {
        let s = settings.supersample.max(1);
        let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
        let fine = Camera {
            intrinsics: camera.intrinsics.resized(width * s, height * s),
            camera_from_world: camera.camera_from_world,
        };
        let gbuffer = proxy.g_buffer(&fine, CELL_SAMPLES);

        let shading = settings.recipe.normals(&gbuffer);
        let (mut points, mut normals, mut pixel, mut weight) =
            (Vec::new(), Vec::new(), Vec::new(), Vec::new());
        let mut triangles = Vec::new();
        for y in 0..height * s {
            for x in 0..width * s {
                let at = (y * width * s + x) as usize;
                if gbuffer.mask[at] {
                    points.extend_from_slice(&gbuffer.position[at]);
                    normals.extend_from_slice(&shading[at]);
                    pixel.push(i64::from(y / s * width + x / s));
                    weight.push(gbuffer.coverage[at]);
                    triangles.push(gbuffer.triangle[at]);
                }
            }
        }
        let (h, w) = (i64::from(height), i64::from(width));
        let points = Tensor::from_slice(&points).view([-1, 3]).to_device(device);
        let normals = Tensor::from_slice(&normals).view([-1, 3]).to_device(device);
        let pixel = Tensor::from_slice(&pixel).to_device(device);
        let weight = Tensor::from_slice(&weight).to_device(device);
        let center = camera.center();
        let center = Tensor::from_slice(&[center.x as f32, center.y as f32, center.z as f32])
            .view([1, 3])
            .to_device(device);
        let to_viewer = ign_nets::warp::directions(&center, &points);
        let total = Tensor::zeros([h * w], (Kind::Float, device)).index_add(0, &pixel, &weight);

        // Coverage does not depend on how finely references are sampled: methods that differ in that share it.
        let c = s.max(COVERAGE_CELLS);
        let finer = (c > s).then(|| {
            let intrinsics = camera.intrinsics.resized(width * c, height * c);
            proxy.g_buffer(&camera.with_intrinsics(intrinsics), CELL_SAMPLES)
        });
        let c = i64::from(c);
        let cells = Tensor::from_slice(&finer.as_ref().unwrap_or(&gbuffer).coverage)
            .view([1, 1, h * c, w * c])
            .to_device(device);
        let pool = |t: &Tensor| t.avg_pool2d([c], [c], [0], false, true, None::<i64>);
        let encode = |t: &Tensor| color::srgb_from_linear(t).clamp(0.0, 1.0);
        let coverage = match settings.coverage {
            CoverageRule::Fraction => pool(&cells),
            CoverageRule::EncodedPixel => encode(&pool(&cells)),
            CoverageRule::EncodedCells => pool(&encode(&cells)),
        };

        let mut target = Self {
            camera: *camera,
            selection: proxy.g_buffer(&selection_camera(camera), 1),
            triangles,
            points,
            normals,
            to_viewer,
            pixel,
            weight,
            total,
            coverage,
            geometry: Tensor::new(),
        };
        let position = target.pool(&target.points);
        let normal = unit(&target.pool(&target.normals));
        let viewer = unit(&target.pool(&target.to_viewer));
        let reflection =
            ign_nets::warp::reflections(&viewer.view([3, -1]).tr(), &normal.view([3, -1]).tr());
        let reflection = reflection.tr().contiguous().view([1, 3, h, w]);
        target.geometry = Tensor::cat(&[position, normal, reflection], 1);
        target
    }

    /// Pixels: (height, width).
    pub fn size(&self) -> (i64, i64) {
        (
            i64::from(self.camera.intrinsics.height),
            i64::from(self.camera.intrinsics.width),
        )
    }

    /// Mean over each pixel's covered part: values [P, C] -> [1, C, H, W], 0 where nothing is covered.
    pub fn pool(&self, values: &Tensor) -> Tensor {
        let (sum, total) = self.sums(&(values * self.weight.unsqueeze(1)));
        let (h, w) = self.size();
        (sum / total.clamp_min(1e-6).unsqueeze(1))
            .tr()
            .contiguous()
            .view([1, -1, h, w])
    }

    /// Sum per pixel: values [P, C] (already weighted) -> [H*W, C], and the pixels' total weights [H*W].
    pub fn sums(&self, values: &Tensor) -> (Tensor, Tensor) {
        let (h, w) = self.size();
        let channels = values.size()[1];
        let zeros = Tensor::zeros([h * w, channels], (Kind::Float, values.device()));
        (
            zeros.index_add(0, &self.pixel, values),
            self.total.shallow_clone(),
        )
    }

    /// [1, 1, H, W]: 1 where any part of the pixel is covered.
    pub fn mask(&self) -> Tensor {
        self.coverage.gt(0.0).to_kind(Kind::Float)
    }
}

/// Unit vectors along channel 1; zero stays zero.
fn unit(x: &Tensor) -> Tensor {
    x / x
        .square()
        .sum_dim_intlist([1i64].as_slice(), true, Kind::Float)
        .sqrt()
        .clamp_min(1e-6)
}
