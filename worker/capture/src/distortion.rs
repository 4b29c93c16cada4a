//! Camera models: from a ray in camera axes to a pixel of the photograph.
//!
//! Most models are one formula. With `(u, v)` the ray at z = 1 and `r = |(u, v)|`:
//!
//! ```text
//! s      = r, or the angle to the axis for the fisheye models;  (a, b) = (u, v) s / r
//! g(s)   = (1 + a1 s^2 + ... + a6 s^12) / (1 + b1 s^2 + b2 s^4 + b3 s^6)
//! (u',v') = (a, b) g(s)  +  tangential(a, b)  +  thin prism(a, b)
//! x = fx u' + skew v' + cx,  y = fy v' + cy
//! ```
//!
//! The others (field of view, division, enhanced unified, panorama) are variants of [`Lens`]. Source: COLMAP
//! `src/colmap/sensor/models.h` and its documentation page "Camera Models".
//! The polynomial folds back beyond some radius, where rays far outside the photograph would land inside it again;
//! [`SourceCamera::project`] answers `None` from there on.

use glam::{DVec2, DVec3};
use serde::{Deserialize, Serialize};

/// Camera models that can be imported: COLMAP's, and the two that all other programs' come down to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "SCREAMING_SNAKE_CASE")]
pub enum CameraModel {
    /// f, cx, cy
    SimplePinhole,
    /// fx, fy, cx, cy
    Pinhole,
    /// f, cx, cy, k
    SimpleRadial,
    /// f, cx, cy, k1, k2
    Radial,
    /// fx, fy, cx, cy, k1, k2, p1, p2
    Opencv,
    /// fx, fy, cx, cy, k1, k2, k3, k4
    OpencvFisheye,
    /// fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6
    FullOpencv,
    /// f, cx, cy, k
    SimpleRadialFisheye,
    /// f, cx, cy, k1, k2
    RadialFisheye,
    /// f, cx, cy
    SimpleFisheye,
    /// fx, fy, cx, cy
    Fisheye,
    /// fx, fy, cx, cy, omega
    Fov,
    /// fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, sx1, sy1
    ThinPrismFisheye,
    /// fx, fy, cx, cy, k0 .. k5, p0, p1, s0 .. s3
    RadTanThinPrismFisheye,
    /// f, cx, cy, k
    SimpleDivision,
    /// fx, fy, cx, cy, k
    Division,
    /// fx, fy, cx, cy, alpha, beta
    Eucm,
    /// width, height
    Equirectangular,
    /// Pinhole with radial, tangential and prism terms and skew, as [`Brown`] has them; not a model of COLMAP.
    Brown,
    /// The same on angles to the axis; not a model of COLMAP.
    BrownFisheye,
}

/// One row of COLMAP's model table: number in binary files, name in text files, number of parameters.
struct ModelRow {
    id: i32,
    name: &'static str,
    params: usize,
    model: CameraModel,
}

const fn row(id: i32, name: &'static str, params: usize, model: CameraModel) -> ModelRow {
    ModelRow {
        id,
        name,
        params,
        model,
    }
}

const MODELS: [ModelRow; 18] = [
    row(0, "SIMPLE_PINHOLE", 3, CameraModel::SimplePinhole),
    row(1, "PINHOLE", 4, CameraModel::Pinhole),
    row(2, "SIMPLE_RADIAL", 4, CameraModel::SimpleRadial),
    row(3, "RADIAL", 5, CameraModel::Radial),
    row(4, "OPENCV", 8, CameraModel::Opencv),
    row(5, "OPENCV_FISHEYE", 8, CameraModel::OpencvFisheye),
    row(6, "FULL_OPENCV", 12, CameraModel::FullOpencv),
    row(7, "FOV", 5, CameraModel::Fov),
    row(
        8,
        "SIMPLE_RADIAL_FISHEYE",
        4,
        CameraModel::SimpleRadialFisheye,
    ),
    row(9, "RADIAL_FISHEYE", 5, CameraModel::RadialFisheye),
    row(10, "THIN_PRISM_FISHEYE", 12, CameraModel::ThinPrismFisheye),
    row(
        11,
        "RAD_TAN_THIN_PRISM_FISHEYE",
        16,
        CameraModel::RadTanThinPrismFisheye,
    ),
    row(12, "SIMPLE_DIVISION", 4, CameraModel::SimpleDivision),
    row(13, "DIVISION", 5, CameraModel::Division),
    row(14, "SIMPLE_FISHEYE", 3, CameraModel::SimpleFisheye),
    row(15, "FISHEYE", 4, CameraModel::Fisheye),
    row(16, "EUCM", 6, CameraModel::Eucm),
    row(17, "EQUIRECTANGULAR", 2, CameraModel::Equirectangular),
];

/// What a model's number or name stands for.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ModelKind {
    pub(crate) name: &'static str,
    pub(crate) params: usize,
    pub(crate) model: CameraModel,
}

impl ModelKind {
    pub(crate) fn by_id(id: i32) -> Option<Self> {
        MODELS.iter().find(|m| m.id == id).map(Self::from_row)
    }

    pub(crate) fn by_name(name: &str) -> Option<Self> {
        MODELS.iter().find(|m| m.name == name).map(Self::from_row)
    }

    fn from_row(row: &ModelRow) -> Self {
        Self {
            name: row.name,
            params: row.params,
            model: row.model,
        }
    }
}

/// How a lens bends rays, before focal lengths and principal point.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Lens {
    /// The module's formula.
    Polynomial(Polynomial),
    /// Devernay and Faugeras 2001: the distorted radius is `atan(2 r tan(omega / 2)) / omega`.
    Fov { omega: f64 },
    /// Fitzgibbon 2001: a pixel at radius d looks along radius `d / (1 + k d^2)`.
    Division { k: f64 },
    /// Enhanced unified camera model, Khomutenko et al. 2016.
    Eucm { alpha: f64, beta: f64 },
    /// Longitude and latitude over the whole sphere.
    Equirectangular,
}

/// Coefficients of the module's formula.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub(crate) struct Polynomial {
    fisheye: bool,
    /// a1..a6.
    radial: [f64; 6],
    /// b1..b3.
    denominator: [f64; 3],
    /// p1, p2.
    tangential: [f64; 2],
    /// Thin prism: x by q^2 and q^4, y by q^2 and q^4.
    prism: [f64; 4],
    /// Tangential and prism terms act on what the radial factor has moved.
    radial_first: bool,
    /// Largest s up to which the radial part grows.
    s_limit: f64,
}

/// A photograph's own camera: intrinsics and lens, in pixels of the photograph.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct SourceCamera {
    /// The model it was given as.
    pub model: CameraModel,
    /// Width of the photograph in pixels.
    pub width: u32,
    /// Height of the photograph in pixels.
    pub height: u32,
    /// Focal length in x, pixels.
    pub fx: f64,
    /// Focal length in y, pixels.
    pub fy: f64,
    /// Principal point x, pixels.
    pub cx: f64,
    /// Principal point y, pixels.
    pub cy: f64,
    /// How far x moves, in pixels, per unit of the bent ray's y.
    pub skew: f64,
    /// The lens.
    pub(crate) lens: Lens,
}

/// A camera of the polynomial family with any of its terms, in pixels: what other programs than COLMAP write.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Brown {
    pub(crate) width: u32,
    pub(crate) height: u32,
    pub(crate) fx: f64,
    pub(crate) fy: f64,
    pub(crate) cx: f64,
    pub(crate) cy: f64,
    pub(crate) skew: f64,
    /// Radii are angles to the axis.
    pub(crate) fisheye: bool,
    /// k1..k6, of the even powers of the radius.
    pub(crate) radial: [f64; 6],
    /// p1, p2 in `OpenCV`'s order: p1 bends y more, p2 bends x more.
    pub(crate) tangential: [f64; 2],
    /// Thin prism: x by the radius squared and to the fourth, y by the same.
    pub(crate) prism: [f64; 4],
}

impl From<Brown> for SourceCamera {
    fn from(brown: Brown) -> Self {
        let bend = Polynomial {
            fisheye: brown.fisheye,
            radial: brown.radial,
            tangential: brown.tangential,
            prism: brown.prism,
            ..Polynomial::NONE
        };
        Self {
            model: if brown.fisheye {
                CameraModel::BrownFisheye
            } else {
                CameraModel::Brown
            },
            width: brown.width,
            height: brown.height,
            fx: brown.fx,
            fy: brown.fy,
            cx: brown.cx,
            cy: brown.cy,
            skew: brown.skew,
            lens: Lens::Polynomial(bend.limited()),
        }
    }
}

/// Largest ray radius (tangent of the angle to the axis) that the scan for folding looks at.
const RADIUS_SCANNED: f64 = 20.0;

/// Largest photograph that is accepted: 512 megapixels.
const MOST_PIXELS: u64 = 1 << 29;

impl SourceCamera {
    /// From COLMAP's parameter list; `None` when the list has the wrong length.
    /// Values are taken as they are: see [`SourceCamera::fault`].
    pub fn from_params(
        model: CameraModel,
        width: u32,
        height: u32,
        params: &[f64],
    ) -> Option<Self> {
        use CameraModel as M;
        let one_focal_length = matches!(
            model,
            M::SimplePinhole
                | M::SimpleRadial
                | M::Radial
                | M::SimpleRadialFisheye
                | M::RadialFisheye
                | M::SimpleFisheye
                | M::SimpleDivision
        );
        let (fx, fy, cx, cy, rest) = match *params {
            // A panorama's two numbers repeat its size: its pixels are angles.
            [w, h] if model == M::Equirectangular => {
                let (x, y) = (w / std::f64::consts::TAU, h / std::f64::consts::PI);
                (x, y, w / 2.0, h / 2.0, &params[2..])
            }
            [f, cx, cy, ref rest @ ..] if one_focal_length => (f, f, cx, cy, rest),
            [fx, fy, cx, cy, ref rest @ ..] if !one_focal_length => (fx, fy, cx, cy, rest),
            _ => return None,
        };
        let mut bend = Polynomial::NONE;
        bend.fisheye = matches!(
            model,
            M::OpencvFisheye
                | M::SimpleRadialFisheye
                | M::RadialFisheye
                | M::SimpleFisheye
                | M::Fisheye
                | M::ThinPrismFisheye
                | M::RadTanThinPrismFisheye
        );
        let mut lens = None;
        match (model, rest) {
            (M::SimplePinhole | M::Pinhole | M::SimpleFisheye | M::Fisheye, &[]) => {}
            (M::SimpleRadial | M::SimpleRadialFisheye, &[k]) => bend.radial[0] = k,
            (M::Radial | M::RadialFisheye, &[k1, k2]) => {
                bend.radial[..2].copy_from_slice(&[k1, k2]);
            }
            (M::Opencv, &[k1, k2, p1, p2]) => {
                bend.radial[..2].copy_from_slice(&[k1, k2]);
                bend.tangential = [p1, p2];
            }
            (M::OpencvFisheye, &[k1, k2, k3, k4]) => {
                bend.radial[..4].copy_from_slice(&[k1, k2, k3, k4]);
            }
            (M::FullOpencv, &[k1, k2, p1, p2, k3, k4, k5, k6]) => {
                bend.radial[..3].copy_from_slice(&[k1, k2, k3]);
                bend.denominator = [k4, k5, k6];
                bend.tangential = [p1, p2];
            }
            (M::ThinPrismFisheye, &[k1, k2, p1, p2, k3, k4, sx, sy]) => {
                bend.radial[..4].copy_from_slice(&[k1, k2, k3, k4]);
                bend.tangential = [p1, p2];
                bend.prism = [sx, 0.0, sy, 0.0];
            }
            (M::RadTanThinPrismFisheye, &[a1, a2, a3, a4, a5, a6, p0, p1, s0, s1, s2, s3]) => {
                bend.radial = [a1, a2, a3, a4, a5, a6];
                // This model counts its tangential pair the other way round.
                bend.tangential = [p1, p0];
                bend.prism = [s0, s1, s2, s3];
                bend.radial_first = true;
            }
            (M::Fov, &[omega]) => lens = Some(Lens::Fov { omega }),
            (M::SimpleDivision | M::Division, &[k]) => lens = Some(Lens::Division { k }),
            (M::Eucm, &[alpha, beta]) => lens = Some(Lens::Eucm { alpha, beta }),
            (M::Equirectangular, &[]) => lens = Some(Lens::Equirectangular),
            _ => return None,
        }
        Some(Self {
            model,
            width,
            height,
            fx,
            fy,
            cx,
            cy,
            skew: 0.0,
            lens: lens.unwrap_or_else(|| Lens::Polynomial(bend.limited())),
        })
    }

    /// What makes this camera unusable, if anything: sizes of zero or beyond reason, focal lengths that are not positive and finite,
    /// other parameters that are not finite.
    pub fn fault(&self) -> Option<String> {
        if self.width == 0 || self.height == 0 {
            Some(format!(
                "has a picture size of {}x{}",
                self.width, self.height
            ))
        } else if u64::from(self.width) * u64::from(self.height) > MOST_PIXELS {
            Some(format!(
                "has a picture size of {}x{}, more than can be worked with",
                self.width, self.height
            ))
        } else if self.fx == 0.0 || self.fy == 0.0 {
            Some("has zero focal length".into())
        } else if !(self.fx.is_finite() && self.fy.is_finite()) {
            Some("has a focal length that is not a finite number".into())
        } else if self.fx < 0.0 || self.fy < 0.0 {
            Some("has a negative focal length".into())
        } else if !(self.cx.is_finite() && self.cy.is_finite()) {
            Some("has a principal point that is not a finite number".into())
        } else if !(self.skew.is_finite() && self.lens.is_finite()) {
            Some("has a distortion parameter that is not a finite number".into())
        } else {
            None
        }
    }

    /// A panorama of the whole sphere.
    pub(crate) fn panorama(width: u32, height: u32) -> Self {
        let (w, h) = (f64::from(width), f64::from(height));
        Self {
            model: CameraModel::Equirectangular,
            width,
            height,
            fx: w / std::f64::consts::TAU,
            fy: h / std::f64::consts::PI,
            cx: w / 2.0,
            cy: h / 2.0,
            skew: 0.0,
            lens: Lens::Equirectangular,
        }
    }

    /// True when pixels are an affine function of rays: no distortion at all.
    pub fn is_pinhole(&self) -> bool {
        self.lens == Lens::Polynomial(Polynomial::NONE)
    }

    /// True when the picture holds all directions: no pinhole camera shows the same.
    pub fn is_panorama(&self) -> bool {
        self.lens == Lens::Equirectangular
    }

    /// Pixel of the photograph that light from the direction `ray` (camera axes, any length) falls on; it may lie
    /// outside the picture. `None` where the model folds back on itself, behind cameras that cannot see there, and
    /// for rays that are not finite.
    pub fn project(&self, ray: DVec3) -> Option<DVec2> {
        let bent = self.lens.bend(ray)?;
        let pixel = DVec2::new(
            self.fx * bent.x + self.skew * bent.y + self.cx,
            self.fy * bent.y + self.cy,
        );
        pixel.is_finite().then_some(pixel)
    }
}

impl Lens {
    fn is_finite(&self) -> bool {
        match *self {
            Self::Polynomial(bend) => bend
                .radial
                .iter()
                .chain(&bend.denominator)
                .chain(&bend.tangential)
                .chain(&bend.prism)
                .all(|value| value.is_finite()),
            Self::Fov { omega } => omega.is_finite(),
            Self::Division { k } => k.is_finite(),
            Self::Eucm { alpha, beta } => alpha.is_finite() && beta.is_finite(),
            Self::Equirectangular => true,
        }
    }

    /// Where a ray meets the picture at focal length 1.
    fn bend(&self, ray: DVec3) -> Option<DVec2> {
        if !ray.is_finite() {
            return None;
        }
        let axial = ray.truncate();
        match *self {
            Self::Polynomial(bend) if bend.fisheye => bend.apply_fisheye(ray),
            Self::Eucm { alpha, beta } => {
                let distance = (beta * axial.length_squared() + ray.z * ray.z).sqrt();
                let depth = alpha * distance + (1.0 - alpha) * ray.z;
                // Beyond this cone two directions share a pixel.
                let edge = if alpha > 0.5 {
                    (alpha - 1.0) / alpha
                } else {
                    alpha / (alpha - 1.0)
                };
                (depth > 0.0 && ray.z > edge * distance).then(|| axial / depth)
            }
            Self::Equirectangular => {
                let longitude = ray.x.atan2(ray.z);
                let latitude = ray.y.atan2(ray.x.hypot(ray.z));
                (ray.length_squared() > 0.0).then(|| DVec2::new(longitude, latitude))
            }
            _ if ray.z <= 0.0 => None,
            Self::Polynomial(bend) => bend.apply(axial / ray.z),
            Self::Fov { omega } => {
                let at = axial / ray.z;
                let radius = at.length();
                let scale = 2.0 * (omega / 2.0).tan();
                // Both angles tend to their tangents at 0, and so does the quotient.
                let bent = if omega.abs() < 1e-9 {
                    radius
                } else {
                    (radius * scale).atan() / omega
                };
                Some(if radius > 1e-12 {
                    at * (bent / radius)
                } else {
                    at
                })
            }
            Self::Division { k } => {
                let at = axial / ray.z;
                let root = 1.0 - 4.0 * k * at.length_squared();
                (root >= 0.0).then(|| at * (2.0 / (1.0 + root.sqrt())))
            }
        }
    }
}

impl Polynomial {
    const NONE: Self = Self {
        fisheye: false,
        radial: [0.0; 6],
        denominator: [0.0; 3],
        tangential: [0.0; 2],
        prism: [0.0; 4],
        radial_first: false,
        s_limit: f64::INFINITY,
    };

    /// With its limit found.
    pub(crate) fn limited(mut self) -> Self {
        self.s_limit = self.folding_limit();
        self
    }

    fn apply(&self, at: DVec2) -> Option<DVec2> {
        let s2 = at.length_squared();
        (s2 <= self.s_limit * self.s_limit).then(|| self.terms(at, self.radial_factor(s2)))
    }

    fn apply_fisheye(&self, ray: DVec3) -> Option<DVec2> {
        let axial = ray.truncate();
        let radius = axial.length();
        let theta = radius.atan2(ray.z);
        if theta > self.s_limit || (radius == 0.0 && ray.z <= 0.0) {
            return None;
        }
        // theta / radius tends to 1 / z at the axis.
        let scale = if radius > 1e-9 * ray.z.abs() {
            theta / radius
        } else {
            ray.z.recip()
        };
        Some(self.terms(axial * scale, self.radial_factor(theta * theta)))
    }

    /// Radial factor, tangential and prism terms at `(u, v)`.
    fn terms(&self, at: DVec2, factor: f64) -> DVec2 {
        let moved = at * factor;
        let q = if self.radial_first { moved } else { at };
        let q2 = q.length_squared();
        let ([p1, p2], [x2, x4, y2, y4]) = (self.tangential, self.prism);
        moved
            + DVec2::new(
                2.0 * p1 * q.x * q.y + p2 * (q2 + 2.0 * q.x * q.x) + q2 * (x2 + x4 * q2),
                2.0 * p2 * q.x * q.y + p1 * (q2 + 2.0 * q.y * q.y) + q2 * (y2 + y4 * q2),
            )
    }

    /// g(s) for `s2 = s^2`.
    fn radial_factor(&self, s2: f64) -> f64 {
        let [b1, b2, b3] = self.denominator;
        let numerator = self.radial.iter().rev().fold(0.0, |sum, a| s2 * (a + sum));
        (1.0 + numerator) / (1.0 + s2 * (b1 + s2 * (b2 + s2 * b3)))
    }

    /// The s at which `s g(s)` stops growing, by scanning in small steps.
    fn folding_limit(&self) -> f64 {
        const STEPS: u32 = 8192;
        if all_zero(&self.radial) && all_zero(&self.denominator) {
            return f64::INFINITY;
        }
        let end = if self.fisheye {
            std::f64::consts::PI
        } else {
            RADIUS_SCANNED
        };
        let mut last = 0.0;
        for step in 1..=STEPS {
            let s = end * f64::from(step) / f64::from(STEPS);
            let value = s * self.radial_factor(s * s);
            // Written so that NaN stops the scan as well.
            let grows = value > last;
            if !grows {
                return end * f64::from(step - 1) / f64::from(STEPS);
            }
            last = value;
        }
        f64::INFINITY
    }
}

fn all_zero(values: &[f64]) -> bool {
    values.iter().all(|&value| value == 0.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parameter_lists_of_the_wrong_length_are_refused() {
        assert!(
            SourceCamera::from_params(CameraModel::Radial, 10, 10, &[1.0, 2.0, 3.0, 4.0]).is_none()
        );
        assert!(
            SourceCamera::from_params(CameraModel::Pinhole, 10, 10, &[1.0, 2.0, 3.0]).is_none()
        );
        assert!(SourceCamera::from_params(CameraModel::Opencv, 10, 10, &[1.0; 8]).is_some());
    }

    #[test]
    fn rays_beyond_the_fold_do_not_come_back() {
        // s (1 - 0.2 s^2) grows until s = sqrt(1 / 0.6) = 1.29.
        let camera = SourceCamera::from_params(
            CameraModel::SimpleRadial,
            100,
            80,
            &[50.0, 50.0, 40.0, -0.2],
        )
        .expect("four parameters");
        assert!(camera.project(DVec3::new(1.2, 0.0, 1.0)).is_some());
        assert!(camera.project(DVec3::new(1.4, 0.0, 1.0)).is_none());
        assert!(camera.project(DVec3::new(f64::NAN, 0.0, 1.0)).is_none());
    }

    #[test]
    fn faults_are_named() {
        let camera =
            |f: f64| SourceCamera::from_params(CameraModel::SimplePinhole, 8, 8, &[f, 4.0, 4.0]);
        let fault = |f: f64| camera(f).expect("three parameters").fault();
        assert_eq!(fault(0.0).as_deref(), Some("has zero focal length"));
        assert_eq!(fault(-1.0).as_deref(), Some("has a negative focal length"));
        assert!(fault(f64::NAN).is_some());
        assert_eq!(fault(5.0), None);
    }
}
