//! The fixed reference views: their pictures, depth from the proxy, and the cross-projection into a target.

use glam::{DVec3, Vec3};
use ign_geometry::{Camera, Drawable, GBuffer, select};
use ign_nets::warp::{Sources, directions};
use tch::{Device, Kind, Tensor};

use crate::settings::Recipe;
use crate::target::Target;

/// Long side, in pixels, of the G-buffers on which views are chosen (the paper samples 64 x 64 points).
const SELECTION_PX: u32 = 64;
/// Angle, in radians, below which nearer views gain no more weight.
const PRIOR_ANGLE: f64 = 0.035;

/// One reference view: straight colours and how far each pixel belongs to the object.
#[derive(Clone, Debug)]
pub struct ReferenceImage {
    /// Image name.
    pub name: String,
    /// Normalised frame.
    pub camera: Camera,
    /// Row-major RGBA, 8 bit: straight (not premultiplied) encoded sRGB, and the pixel's weight.
    pub rgba: Vec<u8>,
}

/// All reference views of an object on one device, padded to one size.
#[derive(Debug)]
pub struct References {
    /// Cameras, normalised frame.
    pub cameras: Vec<Camera>,
    /// Geometry for lookups.
    pub sources: Sources,
    /// [V*H*W, 3]: straight encoded sRGB in [0, 1].
    pub colors: Tensor,
    /// [V*H*W]: weight of each pixel in [0, 1].
    pub alpha: Tensor,
    /// [V, 9, H, W]: position, normal and reflection maps.
    pub geometry: Tensor,
    selection: Vec<GBuffer>,
    size: (i64, i64),
}

/// K reference views in the target's picture.
#[derive(Debug)]
pub struct Warped {
    /// [1, K, 3, H, W]: mean of the visible part, 0 where nothing is visible.
    pub color: Tensor,
    /// [1, K, H, W] in [0, 1]: visible part of what the target covers.
    pub visibility: Tensor,
    /// [1, K, H, W]: weights of plain image-based rendering; they sum to 1 where any view sees the pixel, else 0.
    pub prior: Tensor,
    /// [1, K, 2, H, W]: where each pixel comes from in its source, `2u/W - 1`; 0 where not visible.
    pub grid: Tensor,
}

impl References {
    /// Draws the proxy for each reference view.
    pub fn new(
        proxy: &Drawable,
        images: &[ReferenceImage],
        recipe: Recipe,
        device: Device,
    ) -> Self {
        let cameras: Vec<Camera> = images.iter().map(|image| image.camera).collect();
        let width = cameras
            .iter()
            .map(|c| c.intrinsics.width)
            .max()
            .unwrap_or(1);
        let height = cameras
            .iter()
            .map(|c| c.intrinsics.height)
            .max()
            .unwrap_or(1);
        let (h, w) = (i64::from(height), i64::from(width));
        let (mut depths, mut colors, mut alphas, mut geometry) =
            (Vec::new(), Vec::new(), Vec::new(), Vec::new());
        for image in images {
            let gbuffer = proxy.g_buffer(&image.camera, 4);
            let normals = recipe.normals(&gbuffer);
            let eye = image.camera.center();
            let (iw, ih) = (gbuffer.width as usize, gbuffer.height as usize);
            let mut depth = vec![0.0f32; (h * w) as usize];
            let mut color = vec![0.0f32; (h * w * 3) as usize];
            let mut alpha = vec![0.0f32; (h * w) as usize];
            let mut maps = vec![0.0f32; (h * w * 9) as usize];
            for y in 0..ih {
                for x in 0..iw {
                    let from = y * iw + x;
                    let to = y * w as usize + x;
                    if gbuffer.mask[from] {
                        depth[to] = gbuffer.depth[from];
                        let (position, normal) = (gbuffer.position[from], normals[from]);
                        let values = position
                            .into_iter()
                            .chain(normal)
                            .chain(reflection(eye, position, normal));
                        for (channel, value) in values.enumerate() {
                            maps[channel * (h * w) as usize + to] = value;
                        }
                    }
                    for channel in 0..3 {
                        color[to * 3 + channel] = f32::from(image.rgba[from * 4 + channel]) / 255.0;
                    }
                    alpha[to] = f32::from(image.rgba[from * 4 + 3]) / 255.0;
                }
            }
            depths.push(depth);
            colors.push(Tensor::from_slice(&color).view([-1, 3]));
            alphas.push(Tensor::from_slice(&alpha));
            geometry.push(Tensor::from_slice(&maps).view([9, h, w]));
        }
        let padded: Vec<Camera> = cameras
            .iter()
            .map(|camera| {
                let mut camera = *camera;
                (camera.intrinsics.width, camera.intrinsics.height) = (width, height);
                camera
            })
            .collect();
        Self {
            sources: Sources::new(&padded, &depths.concat(), device),
            colors: Tensor::cat(&colors, 0).to_device(device),
            alpha: Tensor::cat(&alphas, 0).to_device(device),
            geometry: Tensor::stack(&geometry, 0).to_device(device),
            selection: cameras
                .iter()
                .map(|camera| proxy.g_buffer(&selection_camera(camera), 1))
                .collect(),
            cameras,
            size: (h, w),
        }
    }

    /// Number of views.
    pub fn len(&self) -> usize {
        self.cameras.len()
    }

    /// Whether there is no view.
    pub fn is_empty(&self) -> bool {
        self.cameras.is_empty()
    }

    /// Padded size: (height, width).
    pub fn size(&self) -> (i64, i64) {
        self.size
    }

    /// The K nearest views of a target, without the `hidden` one; fewer when there are fewer.
    pub fn nearest(
        &self,
        target: &Target,
        k: usize,
        mode: select::Nearest,
        hidden: Option<usize>,
    ) -> Vec<usize> {
        let Some(hidden) = hidden else {
            return select::select_nearest(&target.selection, &self.selection, k, mode);
        };
        let mut others = self.selection.clone();
        others.remove(hidden);
        select::select_nearest(&target.selection, &others, k, mode)
            .into_iter()
            .map(|at| if at < hidden { at } else { at + 1 })
            .collect()
    }

    /// Cross-projects `image` ([V*H*W, 3], one value per reference pixel) of the `chosen` views, weighting each
    /// reference pixel by `alpha` [V*H*W].
    pub fn warp(
        &self,
        target: &Target,
        chosen: &[usize],
        image: &Tensor,
        alpha: &Tensor,
    ) -> Warped {
        let (h, w) = target.size();
        let device = image.device();
        let points = target.points.size()[0];
        let (mut color, mut visibility, mut prior, mut grid) =
            (Vec::new(), Vec::new(), Vec::new(), Vec::new());
        for &view in chosen {
            let index = Tensor::full([points], view as i64, (Kind::Int64, device));
            let taps = self
                .sources
                .taps(&target.points, &target.normals, &index)
                .weighted(alpha);
            let center = self.sources.centers().narrow(0, view as i64, 1);
            let to_source = directions(&center, &target.points);
            let cosine = (&to_source * &target.to_viewer)
                .sum_dim_intlist([1i64].as_slice(), true, Kind::Float)
                .clamp(-1.0, 1.0);
            // 2 (1 - cos) is the squared chord between the two rays.
            let angle = (1.0f64 - cosine) * 2.0;
            let quality = taps.facing.unsqueeze(1) / (angle + PRIOR_ANGLE * PRIOR_ANGLE);
            let seen = taps.visibility.unsqueeze(1);
            let values = Tensor::cat(
                &[
                    taps.gather(image),
                    &taps.grid * &seen,
                    &seen * quality,
                    seen,
                ],
                1,
            );
            let (sums, total) = target.sums(&(values * target.weight.unsqueeze(1)));
            let seen = sums.narrow(1, 6, 1);
            let mean = sums.narrow(1, 0, 5) / seen.clamp_min(1e-4);
            let total = total.clamp_min(1e-6).unsqueeze(1);
            color.push(mean.narrow(1, 0, 3).tr().contiguous().view([3, h, w]));
            grid.push(mean.narrow(1, 3, 2).tr().contiguous().view([2, h, w]));
            prior.push((sums.narrow(1, 5, 1) / &total).view([h, w]));
            visibility.push((seen / total).clamp(0.0, 1.0).view([h, w]));
        }
        let visibility = Tensor::stack(&visibility, 0).unsqueeze(0);
        // A sliver of a pixel is no evidence.
        let usable = visibility.gt(0.02).to_kind(Kind::Float);
        let prior = Tensor::stack(&prior, 0).unsqueeze(0) * &usable;
        let sum = prior.sum_dim_intlist([1i64].as_slice(), true, Kind::Float);
        let prior = prior / sum.clamp_min(1e-6);
        let seen = usable.unsqueeze(2);
        Warped {
            color: Tensor::stack(&color, 0).unsqueeze(0) * &seen,
            grid: Tensor::stack(&grid, 0).unsqueeze(0) * &seen,
            visibility: visibility * usable,
            prior,
        }
    }
}

/// The direction towards `eye`, mirrored about the normal.
fn reflection(eye: DVec3, position: [f32; 3], normal: [f32; 3]) -> [f32; 3] {
    let (position, normal) = (Vec3::from(position), Vec3::from(normal));
    let to_viewer = (eye - position.as_dvec3()).normalize_or_zero().as_vec3();
    (2.0 * to_viewer.dot(normal) * normal - to_viewer).to_array()
}

/// The same view at the size on which views are chosen.
pub(crate) fn selection_camera(camera: &Camera) -> Camera {
    let i = camera.intrinsics;
    let scale = f64::from(SELECTION_PX) / f64::from(i.width.max(i.height));
    let scaled = |n: u32| ((f64::from(n) * scale).round() as u32).max(1);
    Camera {
        intrinsics: i.resized(scaled(i.width), scaled(i.height)),
        camera_from_world: camera.camera_from_world,
    }
}
