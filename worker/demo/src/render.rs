//! One view: 4 x 4 rays per pixel for colour and coverage, one through the centre for depth.

use glam::{DVec2, DVec3};
use ign_geometry::Camera;
use rayon::prelude::*;

use crate::light::{Gloss, Lighting, ShadePoint};
use crate::paint::{Paint, Place};
use crate::shape::Surface;
use crate::trace::{Hit, Ray, Tracer};

/// Rays per pixel along each axis.
const SAMPLES: u32 = 4;

/// Nearest distance that counts as a hit, scene units.
const NEAR: f64 = 1e-3;

/// Everything that all views share.
pub(crate) struct Renderer<'a> {
    pub(crate) surface: &'a Surface,
    pub(crate) paint: &'a Paint,
    pub(crate) tracer: &'a Tracer,
    pub(crate) lighting: &'a Lighting,
    pub(crate) gloss: Gloss,
    /// The lamps go round the object's axis with the camera.
    pub(crate) turntable: bool,
}

/// A rendered view, row-major.
pub(crate) struct Picture {
    pub(crate) width: u32,
    pub(crate) height: u32,
    /// `[height * width * 3]` 8-bit sRGB on black, coverage multiplied in before encoding.
    pub(crate) image: Vec<u8>,
    /// The same without highlights.
    pub(crate) diffuse: Vec<u8>,
    /// `[height * width]` coverage of 255.
    pub(crate) mask: Vec<u8>,
    /// `[height * width]` camera z through the pixel's centre, 0 where nothing is hit.
    pub(crate) depth: Vec<f32>,
}

struct Pixel {
    image: [u8; 3],
    diffuse: [u8; 3],
    mask: u8,
    depth: f32,
}

impl Renderer<'_> {
    pub(crate) fn render(&self, camera: &Camera) -> Picture {
        let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
        let pixels: Vec<Pixel> = (0..height * width)
            .into_par_iter()
            .map(|i| self.pixel(camera, i % width, i / width))
            .collect();
        Picture {
            width,
            height,
            image: pixels.iter().flat_map(|pixel| pixel.image).collect(),
            diffuse: pixels.iter().flat_map(|pixel| pixel.diffuse).collect(),
            mask: pixels.iter().map(|pixel| pixel.mask).collect(),
            depth: pixels.iter().map(|pixel| pixel.depth).collect(),
        }
    }

    fn pixel(&self, camera: &Camera, x: u32, y: u32) -> Pixel {
        let eye = camera.center() - self.surface.center;
        // From the object's frame to the lamps': the object and its shadows are symmetric about the axis.
        let turn = if self.turntable {
            -eye.y.atan2(eye.x)
        } else {
            0.0
        };
        let corner = DVec2::new(f64::from(x), f64::from(y));
        let (mut diffuse, mut specular) = (DVec3::ZERO, DVec3::ZERO);
        let mut covered = 0;
        for sample in 0..SAMPLES * SAMPLES {
            let offset = DVec2::new(
                f64::from(sample % SAMPLES) + 0.5,
                f64::from(sample / SAMPLES) + 0.5,
            );
            let ray = pixel_ray(camera, corner + offset / f64::from(SAMPLES));
            if let Some(hit) = self.tracer.nearest(ray) {
                let point = shade_point(
                    self.surface,
                    self.paint,
                    ray.origin + ray.direction * hit.t,
                    &hit,
                )
                .turned(turn);
                let to_eye = DVec3::rotate_z(-ray.direction.normalize_or_zero(), turn);
                diffuse += self.lighting.diffuse(&point);
                specular += self.lighting.specular(&point, to_eye, self.gloss);
                covered += 1;
            }
        }
        let samples = f64::from(SAMPLES * SAMPLES);
        let center = self
            .tracer
            .nearest(pixel_ray(camera, corner + DVec2::splat(0.5)));
        Pixel {
            image: encode((diffuse + specular) / samples),
            diffuse: encode(diffuse / samples),
            mask: (f64::from(covered) / samples * 255.0).round() as u8,
            depth: center.map_or(0.0, |hit| hit.t as f32),
        }
    }
}

/// The ray through a pixel; its parameter is the camera's z.
pub(crate) fn pixel_ray(camera: &Camera, px: DVec2) -> Ray {
    let origin = camera.center();
    Ray {
        origin,
        direction: camera.unproject(px, 1.0) - origin,
        t_min: NEAR,
        t_max: f64::INFINITY,
    }
}

/// What shading needs to know about a hit.
pub(crate) fn shade_point(surface: &Surface, paint: &Paint, world: DVec3, hit: &Hit) -> ShadePoint {
    let corners = surface.triangles[hit.triangle as usize].map(|corner| corner as usize);
    let weights = [
        1.0 - hit.weights.0 - hit.weights.1,
        hit.weights.0,
        hit.weights.1,
    ];
    let mut normal = DVec3::ZERO;
    let mut row = 0.0;
    for (corner, weight) in corners.into_iter().zip(weights) {
        normal += surface.normals[corner] * weight;
        row += surface.rows[corner] * weight;
    }
    let position = world - surface.center;
    let angle = position.y.atan2(position.x);
    let place = Place {
        position,
        angle,
        inside: row > surface.rim_row,
    };
    ShadePoint {
        position,
        normal: normal.normalize_or(DVec3::Z),
        row,
        angle,
        albedo: paint.albedo(place),
    }
}

/// 8-bit sRGB of linear light, clipped like a sensor.
pub(crate) fn encode(linear: DVec3) -> [u8; 3] {
    linear.to_array().map(|value| {
        let value = value.clamp(0.0, 1.0);
        let s = if value <= 0.003_130_8 {
            value * 12.92
        } else {
            1.055 * value.powf(1.0 / 2.4) - 0.055
        };
        (s * 255.0).round() as u8
    })
}
