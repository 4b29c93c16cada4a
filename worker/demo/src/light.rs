//! Light: a warm key light and a cool fill light, both discs of some size, and a soft dome.
//!
//! The lights do not move, so what each place on the surface gets of them is traced once, into maps over (row,
//! angle), and interpolated when views are rendered: soft cast shadows cost nothing per view. The dome is symmetric
//! about the axis like the object, its map has one entry per row. Only the highlights depend on the view: a GGX lobe
//! for each light, and the dome's mirror image by Fresnel's law (Schlick).

use std::f64::consts::{PI, TAU};

use glam::DVec3;
use rayon::prelude::*;

use crate::shape::Surface;
use crate::trace::{Ray, Tracer};

/// Columns of the visibility map.
const COLUMNS: usize = 384;
/// Rows of the map per row of the mesh.
const ROWS_PER_ROW: usize = 2;
/// Points on each light.
const LIGHT_SAMPLES: u32 = 20;
/// Rays per row into the dome.
const DOME_SAMPLES: u32 = 400;
/// Start of shadow rays above the surface, in scene units.
const OFFSET: f64 = 2e-3;
/// What hidden directions of the dome still give: light that bounced off the object.
const BOUNCE: f64 = 0.10;

/// A disc that faces the object.
struct Light {
    /// Relative to the object's centre.
    position: DVec3,
    radius: f64,
    /// Radiance that a white matte surface facing it reflects.
    color: DVec3,
}

const LIGHTS: [Light; 2] = [
    Light {
        position: DVec3::new(3.4, -2.6, 4.1),
        radius: 0.75,
        color: DVec3::new(0.80, 0.74, 0.66),
    },
    Light {
        position: DVec3::new(-4.2, -2.0, 1.6),
        radius: 1.1,
        color: DVec3::new(0.15, 0.18, 0.23),
    },
];

/// Radiance of the dome in a direction: bright above, dim below.
fn dome(direction: DVec3) -> DVec3 {
    let up = direction.z;
    let sky = DVec3::new(0.30, 0.31, 0.33) * (0.5 + 0.5 * up).powf(1.5);
    let floor = DVec3::new(0.075, 0.068, 0.062) * (0.5 - 0.5 * up);
    sky + floor
}

/// What reaches each place of the surface.
pub(crate) struct Lighting {
    /// Visible share of each light, `[map row][column]`.
    visibility: Vec<[f32; 2]>,
    /// Light of the dome on each row of the mesh, and the visible share of it.
    dome: Vec<(DVec3, f64)>,
}

/// Everything about a hit that shading needs, in the world.
pub(crate) struct ShadePoint {
    /// Relative to the object's centre.
    pub(crate) position: DVec3,
    pub(crate) normal: DVec3,
    pub(crate) row: f64,
    pub(crate) angle: f64,
    pub(crate) albedo: DVec3,
}

impl ShadePoint {
    /// The same place of the object after it has turned about its axis by so many radians.
    pub(crate) fn turned(self, radians: f64) -> Self {
        Self {
            position: self.position.rotate_z(radians),
            normal: self.normal.rotate_z(radians),
            angle: self.angle + radians,
            ..self
        }
    }
}

/// The highlight's strength and width.
#[derive(Clone, Copy)]
pub(crate) struct Gloss {
    /// Reflectance at normal incidence; 0: no highlights at all.
    reflectance: f64,
    /// Roughness of GGX.
    alpha: f64,
}

impl Gloss {
    /// From 0 (matte) to 1 (fresh glaze).
    pub(crate) fn new(gloss: f64) -> Self {
        Self {
            reflectance: 0.055 * (gloss * 2.0).min(1.0),
            alpha: 0.05 + 0.40 * (1.0 - gloss).powf(1.4),
        }
    }
}

impl Lighting {
    pub(crate) fn bake(surface: &Surface, tracer: &Tracer) -> Self {
        let map_rows = (surface.row_count() - 1) * ROWS_PER_ROW + 1;
        let visibility = (0..map_rows * COLUMNS)
            .into_par_iter()
            .map(|texel| {
                let row = (texel / COLUMNS) as f64 / ROWS_PER_ROW as f64;
                let angle = TAU * (texel % COLUMNS) as f64 / COLUMNS as f64;
                let (position, normal) = surface.at(row, angle);
                let place = position - surface.center;
                [0, 1].map(|light| visible_share(&LIGHTS[light], surface, tracer, place, normal))
            })
            .collect();
        let dome = (0..surface.row_count())
            .into_par_iter()
            .map(|row| {
                let (position, normal) = surface.at(row as f64, 0.0);
                dome_light(tracer, position, normal)
            })
            .collect();
        Self { visibility, dome }
    }

    /// Visible share of each light at a place, bilinear.
    fn visibility(&self, row: f64, angle: f64) -> [f64; 2] {
        let y = row * ROWS_PER_ROW as f64;
        let x = angle.rem_euclid(TAU) / TAU * COLUMNS as f64;
        let last = self.visibility.len() / COLUMNS - 1;
        let (y0, x0) = ((y as usize).min(last), x as usize);
        let (fy, fx) = (y - y0 as f64, x - x0 as f64);
        let at = |dy: usize, dx: usize| {
            self.visibility[(y0 + dy).min(last) * COLUMNS + (x0 + dx) % COLUMNS]
        };
        let (a, b, c, d) = (at(0, 0), at(0, 1), at(1, 0), at(1, 1));
        [0, 1].map(|i| {
            let top = f64::from(a[i]) * (1.0 - fx) + f64::from(b[i]) * fx;
            let bottom = f64::from(c[i]) * (1.0 - fx) + f64::from(d[i]) * fx;
            top * (1.0 - fy) + bottom * fy
        })
    }

    fn dome_at(&self, row: f64) -> (DVec3, f64) {
        let low = (row as usize).min(self.dome.len() - 2);
        let share = row - low as f64;
        let (a, b) = (self.dome[low], self.dome[low + 1]);
        (a.0.lerp(b.0, share), a.1 + (b.1 - a.1) * share)
    }

    /// The part that is the same from everywhere, linear.
    pub(crate) fn diffuse(&self, point: &ShadePoint) -> DVec3 {
        let visibility = self.visibility(point.row, point.angle);
        let mut light = self.dome_at(point.row).0;
        for (lamp, visible) in LIGHTS.iter().zip(visibility) {
            let towards = (lamp.position - point.position).normalize_or_zero();
            light += lamp.color * (point.normal.dot(towards).max(0.0) * visible);
        }
        point.albedo * light
    }

    /// The highlights seen from `to_eye` (unit), linear. Never negative; zero where `gloss` has no reflectance.
    pub(crate) fn specular(&self, point: &ShadePoint, to_eye: DVec3, gloss: Gloss) -> DVec3 {
        let n_eye = point.normal.dot(to_eye);
        if gloss.reflectance <= 0.0 || n_eye <= 0.0 {
            return DVec3::ZERO;
        }
        let visibility = self.visibility(point.row, point.angle);
        let mut sum = DVec3::ZERO;
        for (lamp, visible) in LIGHTS.iter().zip(visibility) {
            let offset = lamp.position - point.position;
            let distance = offset.length();
            let towards = offset / distance;
            let n_light = point.normal.dot(towards);
            if n_light <= 0.0 || visible <= 0.0 {
                continue;
            }
            let half = (towards + to_eye).normalize_or_zero();
            // A light of some size widens the lobe and keeps its energy.
            let alpha2 = gloss.alpha.powi(2) + (0.5 * lamp.radius / distance).powi(2);
            let n_half = point.normal.dot(half);
            let spread = alpha2 / (PI * (n_half * n_half * (alpha2 - 1.0) + 1.0).powi(2));
            let shadowing = smith(n_eye, alpha2) * smith(n_light, alpha2);
            let lobe = spread * shadowing * schlick(gloss.reflectance, to_eye.dot(half)) / 4.0;
            sum += lamp.color * (PI * lobe * visible * n_light);
        }
        let (_, open) = self.dome_at(point.row);
        let mirrored = 2.0 * n_eye * point.normal - to_eye;
        // Rough surfaces mirror less at grazing angles.
        let fresnel = schlick(gloss.reflectance, n_eye) * (1.0 - 0.7 * gloss.alpha);
        sum + dome(mirrored) * (fresnel * open)
    }
}

fn schlick(reflectance: f64, cosine: f64) -> f64 {
    reflectance + (1.0 - reflectance) * (1.0 - cosine.clamp(0.0, 1.0)).powi(5)
}

/// Smith's masking G1 of one direction over its cosine, which cancels against the lobe's denominator.
fn smith(cosine: f64, alpha2: f64) -> f64 {
    2.0 / (cosine + (alpha2 + (1.0 - alpha2) * cosine * cosine).sqrt())
}

/// Share of a light's disc that a place sees.
fn visible_share(
    light: &Light,
    surface: &Surface,
    tracer: &Tracer,
    place: DVec3,
    normal: DVec3,
) -> f32 {
    let axis = light.position.normalize_or_zero();
    let (side, up) = axis.any_orthonormal_pair();
    let mut visible = 0;
    for sample in 0..LIGHT_SAMPLES {
        let (radius, turn) = sunflower(sample, LIGHT_SAMPLES);
        let target =
            light.position + (side * turn.cos() + up * turn.sin()) * (radius * light.radius);
        let offset = target - place;
        if offset.dot(normal) <= 0.0 {
            continue;
        }
        let direction = offset.normalize_or_zero();
        let origin = surface.center + place + normal * OFFSET;
        let blocked = tracer.is_blocked(Ray {
            origin,
            direction,
            t_min: 0.0,
            t_max: offset.length(),
        });
        visible += u32::from(!blocked);
    }
    visible as f32 / LIGHT_SAMPLES as f32
}

/// Light of the dome on a place, and the visible share of it.
fn dome_light(tracer: &Tracer, position: DVec3, normal: DVec3) -> (DVec3, f64) {
    let (side, up) = normal.any_orthonormal_pair();
    let mut light = DVec3::ZERO;
    let mut open = 0.0;
    for sample in 0..DOME_SAMPLES {
        // Uniform on the disc, lifted to the hemisphere: weighted by the cosine.
        let (radius, turn) = sunflower(sample, DOME_SAMPLES);
        let height = (1.0 - radius * radius).sqrt();
        let direction = (side * turn.cos() + up * turn.sin()) * radius + normal * height;
        let origin = position + normal * OFFSET;
        if tracer.is_blocked(Ray {
            origin,
            direction,
            t_min: 0.0,
            t_max: 1e3,
        }) {
            light += dome(direction) * BOUNCE;
        } else {
            light += dome(direction);
            open += 1.0;
        }
    }
    (
        light / f64::from(DOME_SAMPLES),
        open / f64::from(DOME_SAMPLES),
    )
}

/// Evenly spread points on the unit disc: radius and angle.
fn sunflower(index: u32, count: u32) -> (f64, f64) {
    const GOLDEN_ANGLE: f64 = 2.399_963_229_728_653;
    (
        ((f64::from(index) + 0.5) / f64::from(count)).sqrt(),
        f64::from(index) * GOLDEN_ANGLE,
    )
}
