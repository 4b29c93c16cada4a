//! The painting: albedo as a function of the place on the surface, with detail finer than the mesh.
//!
//! Everything is procedural and unfiltered; the renderer's samples per pixel do the anti-aliasing. Colours are given
//! as 8-bit sRGB and used in linear light.

use std::f64::consts::{PI, TAU};

use glam::DVec3;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;

use crate::Shape;

/// A place on the surface.
#[derive(Clone, Copy)]
pub(crate) struct Place {
    /// Relative to the object's centre.
    pub(crate) position: DVec3,
    /// Angle about the axis.
    pub(crate) angle: f64,
    /// On the inside of a vessel.
    pub(crate) inside: bool,
}

/// The painting of one object.
pub(crate) struct Paint {
    shape: Shape,
    noise: Noise,
    /// Turns the pattern bands against each other.
    phase: [f64; 6],
    /// Repetitions around of the main frieze; even, because two kinds alternate.
    repeats: f64,
    palette: Palette,
}

/// Linear colours.
#[derive(Clone, Copy)]
struct Palette {
    ground: DVec3,
    dark: DVec3,
    light: DVec3,
    accent: DVec3,
    second: DVec3,
}

impl Paint {
    pub(crate) fn new(shape: Shape, seed: u64) -> Self {
        let mut rng = Pcg32::seed_from_u64(seed ^ 0x7061_696e_7400);
        let mut phase = [0.0; 6];
        for value in &mut phase {
            *value = rng.random_range(0.0..TAU);
        }
        // A few percent of brightness per colour, so that seeds differ at a glance.
        let mut color = |r: u8, g: u8, b: u8| {
            let linear = DVec3::new(linear(r), linear(g), linear(b));
            linear * rng.random_range(0.93..1.07)
        };
        let palette = match shape {
            Shape::Vase => Palette {
                ground: color(205, 112, 62),
                dark: color(40, 32, 33),
                light: color(236, 216, 178),
                accent: color(150, 36, 30),
                second: color(196, 150, 62),
            },
            Shape::Bowl => Palette {
                ground: color(226, 230, 228),
                dark: color(28, 52, 128),
                light: color(240, 240, 234),
                accent: color(62, 104, 176),
                second: color(150, 178, 214),
            },
            Shape::Sphere => Palette {
                ground: color(20, 104, 106),
                dark: color(16, 40, 66),
                light: color(232, 222, 190),
                accent: color(176, 44, 40),
                second: color(206, 160, 66),
            },
        };
        let repeats = f64::from(2 * rng.random_range(4_u32..=5));
        Self {
            shape,
            noise: Noise { seed: rng.random() },
            phase,
            repeats,
            palette,
        }
    }

    /// Diffuse albedo, linear.
    pub(crate) fn albedo(&self, place: Place) -> DVec3 {
        let painted = match self.shape {
            Shape::Vase => self.vase(place),
            Shape::Bowl => self.bowl(place),
            Shape::Sphere => self.sphere(place),
        };
        self.aged(painted, place.position)
    }

    /// Uneven firing, fine speckles and a net of hairline cracks.
    fn aged(&self, color: DVec3, p: DVec3) -> DVec3 {
        let cloud = self.noise.fractal(p * 3.1);
        let grain = self.noise.fractal(p * 34.0);
        let mut color = color * (1.0 + 0.24 * (cloud - 0.5) + 0.16 * (grain - 0.5));
        let crack = (self.noise.fractal(p * 7.3 + DVec3::splat(17.0)) - 0.5).abs();
        if crack < 0.0055 && cloud > 0.42 {
            color *= 0.72;
        }
        color.clamp(DVec3::splat(0.01), DVec3::splat(0.92))
    }

    fn vase(&self, place: Place) -> DVec3 {
        let Palette {
            ground,
            dark,
            light,
            accent,
            second,
        } = self.palette;
        if place.inside {
            return dark.lerp(ground, 0.25);
        }
        let y = (place.position.z + 0.975) / 1.96;
        let around = |count: f64, phase: usize| (place.angle + self.phase[phase]) / TAU * count;
        let band = |from: f64, to: f64| (from..to).contains(&y).then(|| (y - from) / (to - from));
        if let Some(v) = band(0.11, 0.235) {
            // Rays standing on the foot.
            let u = triangle_wave(around(26.0, 0));
            return if u < 0.92 * (1.0 - v) { dark } else { ground };
        }
        for (line, color) in [
            (0.245, dark),
            (0.262, accent),
            (0.356, dark),
            (0.612, dark),
            (0.716, accent),
            (0.73, dark),
        ] {
            if (y - line).abs() < 0.0052 {
                return color;
            }
        }
        if let Some(v) = band(0.274, 0.346) {
            return if meander(around(24.0, 1), v) {
                dark
            } else {
                light
            };
        }
        if let Some(v) = band(0.366, 0.602) {
            return self.frieze(around(self.repeats, 2), v);
        }
        if let Some(v) = band(0.622, 0.706) {
            // Running waves, with a dot in each.
            let u = around(20.0, 3);
            let crest = 0.5 + 0.33 * (u * TAU).sin();
            let dot = centered(u + 0.25).hypot((v - 0.72) * 0.62) < 0.13;
            return if dot {
                accent
            } else if v < crest {
                dark
            } else {
                light
            };
        }
        if let Some(v) = band(0.74, 0.835) {
            // Tongues on the shoulder.
            let u = around(30.0, 4);
            let half = centered(u).abs();
            let tongue = if u.rem_euclid(2.0) < 1.0 {
                dark
            } else {
                accent
            };
            let rounded = v > 0.16 || half.hypot((v - 0.16) * 1.9) < 0.36;
            return if half < 0.36 && rounded {
                tongue
            } else {
                ground
            };
        }
        if let Some(v) = band(0.872, 0.925) {
            // A chain of leaves on the dark neck.
            let u = around(16.0, 5);
            let leaf = (centered(u) / 0.34).powi(2)
                + ((v - 0.5) / (0.30 + 0.12 * (u * PI).sin())).powi(2)
                < 1.0;
            return if leaf { second } else { dark };
        }
        if y > 0.985 || (0.050..0.062).contains(&y) {
            return second;
        }
        if (0.11..=0.84).contains(&y) {
            ground
        } else {
            dark
        }
    }

    /// The main frieze: flowers of two kinds between leaning tendrils, on the bare clay.
    fn frieze(&self, u: f64, v: f64) -> DVec3 {
        let Palette {
            ground,
            dark,
            light,
            accent,
            second,
        } = self.palette;
        let cell = centered(u);
        let (x, y) = (cell * 1.02, v - 0.5);
        let (radius, direction) = (x.hypot(y), y.atan2(x));
        let is_even = u.rem_euclid(2.0) < 1.0;
        let (petals, petal_color) = if is_even { (8.0, accent) } else { (6.0, dark) };
        if radius < 0.055 {
            return second;
        }
        if radius < 0.085 {
            return light;
        }
        let reach = 0.33 * (0.52 + 0.48 * (direction * petals / 2.0).cos().abs());
        if radius < reach {
            let vein = (direction * petals / 2.0).sin().abs() > 0.985 || radius > reach - 0.028;
            return if vein { light } else { petal_color };
        }
        // Tendrils between the flowers, and dots above and below.
        let side = (cell.abs() - 0.5).abs();
        let tendril = 0.05 * (y * 13.0).sin();
        if (side - 0.045 - tendril).abs() < 0.016 && y.abs() < 0.43 {
            return dark;
        }
        for at in [-0.36, 0.36] {
            if (cell.abs() - 0.5).hypot(y - at) < 0.035 {
                return accent;
            }
            if (cell.abs() - 0.27).hypot(y - at) < 0.028 {
                return dark;
            }
        }
        ground
    }

    fn bowl(&self, place: Place) -> DVec3 {
        let Palette {
            ground,
            dark,
            light,
            accent,
            second,
        } = self.palette;
        let (r, z) = (place.position.x.hypot(place.position.y), place.position.z);
        let around = |count: f64, phase: usize| (place.angle + self.phase[phase]) / TAU * count;
        let petal = |u: f64, v: f64| {
            let half = centered(u).abs();
            let width = 0.46 * (v * PI).sin().max(0.0).sqrt();
            if half > width {
                None
            } else if half > width - 0.07 {
                Some(dark)
            } else {
                Some(accent.lerp(second, v))
            }
        };
        if place.inside {
            if r < 0.30 {
                let reach =
                    0.26 * (0.45 + 0.55 * ((place.angle + self.phase[0]) * 4.0).cos().abs());
                return if r < 0.05 {
                    light
                } else if r < reach - 0.02 {
                    dark
                } else if r < reach {
                    second
                } else {
                    ground
                };
            }
            if (0.315..0.335).contains(&r) || (0.855..0.87).contains(&r) {
                return dark;
            }
            if (0.875..0.925).contains(&r) && meander(around(34.0, 1), (r - 0.875) / 0.05) {
                return dark;
            }
            let vine = 0.06 * (around(6.0, 2) * TAU).sin() + 0.6;
            if (r - vine).abs() < 0.012 {
                return dark;
            }
            let flower = around(12.0, 2);
            let bud = (centered(flower) * 0.32).hypot(
                r - 0.6
                    - 0.11
                        * if flower.rem_euclid(2.0) < 1.0 {
                            1.0
                        } else {
                            -1.0
                        },
            );
            return if bud < 0.022 {
                light
            } else if bud < 0.055 {
                accent
            } else {
                ground
            };
        }
        for line in [-0.37, -0.30, 0.17, 0.19, 0.40] {
            if (z - line).abs() < 0.007 {
                return dark;
            }
        }
        if (-0.29..0.16).contains(&z) {
            return petal(around(18.0, 3), (z + 0.29) / 0.45).unwrap_or(ground);
        }
        if (0.20..0.385).contains(&z) {
            let v = (z - 0.20) / 0.185;
            let u = around(24.0, 4);
            let cloud = 0.5 + 0.28 * (u * TAU).sin();
            let ring = centered(u + 0.25).hypot((v - 0.78) * 0.72);
            return if (0.1..0.17).contains(&ring) || (v - cloud).abs() < 0.07 {
                dark
            } else if v < cloud {
                second
            } else {
                ground
            };
        }
        ground
    }

    fn sphere(&self, place: Place) -> DVec3 {
        let Palette {
            ground,
            dark,
            light,
            accent,
            second,
        } = self.palette;
        let latitude = (place.position.z / 0.9).clamp(-1.0, 1.0).asin() / PI;
        let longitude = (place.angle + self.phase[0]) / TAU;
        for line in [-0.34, -0.31, 0.31, 0.34] {
            if (latitude - line).abs() < 0.005 {
                return second;
            }
        }
        if latitude.abs() > 0.345 {
            let pole = 0.5 - latitude.abs();
            let reach = 0.14 * (0.35 + 0.65 * (longitude * TAU * 5.0).cos().abs());
            return if pole < 0.02 {
                second
            } else if pole < reach {
                light
            } else {
                dark
            };
        }
        if latitude.abs() > 0.265 {
            let v = (latitude.abs() - 0.265) / 0.04;
            return if (0.0..1.0).contains(&v) && meander(longitude * 30.0, v) {
                light
            } else {
                dark
            };
        }
        // A lattice of two families of spirals with flowers in its cells.
        let (a, b) = (
            longitude * 12.0 + latitude * 10.0,
            longitude * 12.0 - latitude * 10.0,
        );
        let (x, y) = (centered(a), centered(b));
        if x.abs().max(y.abs()) > 0.455 {
            return second;
        }
        let (radius, direction) = (x.hypot(y), y.atan2(x));
        let reach = 0.36 * (0.5 + 0.5 * (direction * 3.0).cos().abs());
        if radius < 0.07 {
            second
        } else if radius < reach {
            if (a.floor() as i64 + b.floor() as i64).rem_euclid(2) == 0 {
                accent
            } else {
                light
            }
        } else {
            ground
        }
    }
}

/// One cell of a Greek key, as rows from the top.
const KEY: [&[u8; 8]; 8] = [
    b"########",
    b"#.......",
    b"#.#####.",
    b"#.#...#.",
    b"#.#.#.#.",
    b"#.#.###.",
    b"#.#.....",
    b"###.####",
];

/// Whether the meander is dark at `u` (cells around) and `v` (0 at the bottom to 1).
fn meander(u: f64, v: f64) -> bool {
    let column = (u.rem_euclid(1.0) * 8.0) as usize;
    let row = ((1.0 - v).clamp(0.0, 1.0) * 8.0) as usize;
    KEY[row.min(7)][column.min(7)] == b'#'
}

/// Place within the unit cell, from its middle: -0.5 to 0.5.
fn centered(x: f64) -> f64 {
    x.rem_euclid(1.0) - 0.5
}

/// 0 at whole numbers, 1 half way between.
fn triangle_wave(x: f64) -> f64 {
    1.0 - (2.0 * x.rem_euclid(1.0) - 1.0).abs()
}

/// Linear light of an 8-bit sRGB value.
fn linear(value: u8) -> f64 {
    let s = f64::from(value) / 255.0;
    if s <= 0.04045 {
        s / 12.92
    } else {
        ((s + 0.055) / 1.055).powf(2.4)
    }
}

/// Value noise on the integer lattice.
/// Smooth noise in space.
pub(crate) struct Noise {
    pub(crate) seed: u32,
}

impl Noise {
    /// Two octaves, in [0, 1] with mean 0.5.
    pub(crate) fn fractal(&self, p: DVec3) -> f64 {
        (2.0 * self.value(p) + self.value(p * 2.17 + DVec3::splat(5.3))) / 3.0
    }

    fn value(&self, p: DVec3) -> f64 {
        let floor = p.floor();
        let f = p - floor;
        let fade = f * f * (DVec3::splat(3.0) - 2.0 * f);
        let (x, y, z) = (floor.x as i32, floor.y as i32, floor.z as i32);
        let mix = |a: f64, b: f64, t: f64| a + (b - a) * t;
        let edge = |dy: i32, dz: i32| {
            mix(
                self.lattice(x, y + dy, z + dz),
                self.lattice(x + 1, y + dy, z + dz),
                fade.x,
            )
        };
        mix(
            mix(edge(0, 0), edge(1, 0), fade.y),
            mix(edge(0, 1), edge(1, 1), fade.y),
            fade.z,
        )
    }

    /// A hash of a lattice point, in [0, 1).
    fn lattice(&self, x: i32, y: i32, z: i32) -> f64 {
        let mut h = self.seed;
        for value in [x, y, z] {
            h = (h ^ value as u32).wrapping_mul(0x9e37_79b1);
            h ^= h >> 15;
        }
        h = h.wrapping_mul(0x85eb_ca6b);
        h ^= h >> 13;
        f64::from(h) / 4_294_967_296.0
    }
}
