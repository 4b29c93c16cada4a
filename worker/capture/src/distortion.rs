//! COLMAP's camera models: from a ray of the undistorted pinhole to a pixel of the photograph.
//!
//! All supported models are one formula. With `(u, v)` the ray at z = 1 and `r = |(u, v)|`:
//!
//! ```text
//! s      = r, or atan(r) for the fisheye models
//! g(s)   = (1 + a1 s^2 + a2 s^4 + a3 s^6 + a4 s^8) / (1 + b1 s^2 + b2 s^4 + b3 s^6)
//! (u',v') = (u, v) * s g(s) / r  +  tangential(u, v)
//! x = fx u' + cx,  y = fy v' + cy
//! ```
//!
//! Source: COLMAP `src/colmap/sensor/models.h` and its documentation page "Camera Models".
//! The polynomial folds back beyond some radius, where rays far outside the photograph would land inside it again;
//! [`SourceCamera::project`] answers `None` from there on.

use glam::DVec2;
use serde::{Deserialize, Serialize};

/// Camera models of COLMAP that can be imported.
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
}

/// One row of COLMAP's model table: number in binary files, name in text files, number of parameters.
struct ModelRow {
    id: i32,
    name: &'static str,
    params: usize,
    model: Option<CameraModel>,
}

const fn row(id: i32, name: &'static str, params: usize, model: Option<CameraModel>) -> ModelRow {
    ModelRow {
        id,
        name,
        params,
        model,
    }
}

/// Models without a [`CameraModel`] are known by name and length only, so that a file that holds one can be read on.
const MODELS: [ModelRow; 18] = [
    row(0, "SIMPLE_PINHOLE", 3, Some(CameraModel::SimplePinhole)),
    row(1, "PINHOLE", 4, Some(CameraModel::Pinhole)),
    row(2, "SIMPLE_RADIAL", 4, Some(CameraModel::SimpleRadial)),
    row(3, "RADIAL", 5, Some(CameraModel::Radial)),
    row(4, "OPENCV", 8, Some(CameraModel::Opencv)),
    row(5, "OPENCV_FISHEYE", 8, Some(CameraModel::OpencvFisheye)),
    row(6, "FULL_OPENCV", 12, Some(CameraModel::FullOpencv)),
    row(7, "FOV", 5, None),
    row(
        8,
        "SIMPLE_RADIAL_FISHEYE",
        4,
        Some(CameraModel::SimpleRadialFisheye),
    ),
    row(9, "RADIAL_FISHEYE", 5, Some(CameraModel::RadialFisheye)),
    row(10, "THIN_PRISM_FISHEYE", 12, None),
    row(11, "RAD_TAN_THIN_PRISM_FISHEYE", 16, None),
    row(12, "SIMPLE_DIVISION", 4, None),
    row(13, "DIVISION", 5, None),
    row(14, "SIMPLE_FISHEYE", 3, Some(CameraModel::SimpleFisheye)),
    row(15, "FISHEYE", 4, Some(CameraModel::Fisheye)),
    row(16, "EUCM", 6, None),
    row(17, "EQUIRECTANGULAR", 2, None),
];

/// What a model's number or name stands for.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ModelKind {
    pub(crate) name: &'static str,
    pub(crate) params: usize,
    pub(crate) model: Option<CameraModel>,
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

/// A photograph's own camera: pinhole intrinsics and lens distortion, in pixels of the photograph.
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
    /// a1..a4 of the module's formula.
    pub radial: [f64; 4],
    /// b1..b3 of the module's formula.
    pub denominator: [f64; 3],
    /// p1, p2.
    pub tangential: [f64; 2],
    /// Largest s of the module's formula up to which the radial part grows.
    s_limit: f64,
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
        let mut camera = Self {
            model,
            width,
            height,
            fx: 0.0,
            fy: 0.0,
            cx: 0.0,
            cy: 0.0,
            radial: [0.0; 4],
            denominator: [0.0; 3],
            tangential: [0.0; 2],
            s_limit: f64::INFINITY,
        };
        let rest = match (model, params) {
            (
                CameraModel::SimplePinhole
                | CameraModel::SimpleRadial
                | CameraModel::Radial
                | CameraModel::SimpleRadialFisheye
                | CameraModel::RadialFisheye
                | CameraModel::SimpleFisheye,
                &[f, cx, cy, ref rest @ ..],
            ) => {
                (camera.fx, camera.fy, camera.cx, camera.cy) = (f, f, cx, cy);
                rest
            }
            (_, &[fx, fy, cx, cy, ref rest @ ..]) => {
                (camera.fx, camera.fy, camera.cx, camera.cy) = (fx, fy, cx, cy);
                rest
            }
            _ => return None,
        };
        match (model, rest) {
            (
                CameraModel::SimplePinhole
                | CameraModel::Pinhole
                | CameraModel::SimpleFisheye
                | CameraModel::Fisheye,
                [],
            ) => {}
            (CameraModel::SimpleRadial | CameraModel::SimpleRadialFisheye, &[k]) => {
                camera.radial[0] = k;
            }
            (CameraModel::Radial | CameraModel::RadialFisheye, &[k1, k2]) => {
                camera.radial = [k1, k2, 0.0, 0.0];
            }
            (CameraModel::Opencv, &[k1, k2, p1, p2]) => {
                camera.radial = [k1, k2, 0.0, 0.0];
                camera.tangential = [p1, p2];
            }
            (CameraModel::OpencvFisheye, &[k1, k2, k3, k4]) => camera.radial = [k1, k2, k3, k4],
            (CameraModel::FullOpencv, &[k1, k2, p1, p2, k3, k4, k5, k6]) => {
                camera.radial = [k1, k2, k3, 0.0];
                camera.denominator = [k4, k5, k6];
                camera.tangential = [p1, p2];
            }
            _ => return None,
        }
        camera.s_limit = camera.folding_limit();
        Some(camera)
    }

    /// What makes this camera unusable, if anything: sizes of zero or beyond reason, focal lengths that are not positive and finite,
    /// other parameters that are not finite.
    pub fn fault(&self) -> Option<String> {
        let coefficients = self
            .radial
            .iter()
            .chain(&self.denominator)
            .chain(&self.tangential);
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
        } else if !coefficients.copied().all(f64::is_finite) {
            Some("has a distortion parameter that is not a finite number".into())
        } else {
            None
        }
    }

    /// True when pixels are an affine function of rays: no distortion at all.
    pub fn is_pinhole(&self) -> bool {
        !self.is_fisheye()
            && all_zero(&self.radial)
            && all_zero(&self.denominator)
            && all_zero(&self.tangential)
    }

    fn is_fisheye(&self) -> bool {
        matches!(
            self.model,
            CameraModel::OpencvFisheye
                | CameraModel::SimpleRadialFisheye
                | CameraModel::RadialFisheye
                | CameraModel::SimpleFisheye
                | CameraModel::Fisheye
        )
    }

    /// Pixel of the photograph that the ray `(u, v, 1)` falls on; it may lie outside the picture.
    /// `None` where the model folds back on itself or the ray is not finite.
    pub fn project(&self, ray: DVec2) -> Option<DVec2> {
        let r2 = ray.length_squared();
        if !r2.is_finite() {
            return None;
        }
        let factor = if self.is_fisheye() {
            let r = r2.sqrt();
            let theta = r.atan();
            if theta > self.s_limit {
                return None;
            }
            // theta / r tends to 1 at the axis.
            let scale = if r > 1e-9 { theta / r } else { 1.0 };
            scale * self.radial_factor(theta * theta)
        } else {
            if r2 > self.s_limit * self.s_limit {
                return None;
            }
            self.radial_factor(r2)
        };
        let [p1, p2] = self.tangential;
        let (u, v) = (ray.x, ray.y);
        let distorted = DVec2::new(
            u * factor + 2.0 * p1 * u * v + p2 * (r2 + 2.0 * u * u),
            v * factor + 2.0 * p2 * u * v + p1 * (r2 + 2.0 * v * v),
        );
        let pixel = DVec2::new(
            self.fx * distorted.x + self.cx,
            self.fy * distorted.y + self.cy,
        );
        pixel.is_finite().then_some(pixel)
    }

    /// g(s) for `s2 = s^2`.
    fn radial_factor(&self, s2: f64) -> f64 {
        let [a1, a2, a3, a4] = self.radial;
        let [b1, b2, b3] = self.denominator;
        let numerator = 1.0 + s2 * (a1 + s2 * (a2 + s2 * (a3 + s2 * a4)));
        let denominator = 1.0 + s2 * (b1 + s2 * (b2 + s2 * b3));
        numerator / denominator
    }

    /// The s at which `s g(s)` stops growing, by scanning in small steps.
    fn folding_limit(&self) -> f64 {
        const STEPS: u32 = 8192;
        if all_zero(&self.radial) && all_zero(&self.denominator) {
            return f64::INFINITY;
        }
        let end = if self.is_fisheye() {
            RADIUS_SCANNED.atan()
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
        assert!(camera.project(DVec2::new(1.2, 0.0)).is_some());
        assert!(camera.project(DVec2::new(1.4, 0.0)).is_none());
        assert!(camera.project(DVec2::new(f64::NAN, 0.0)).is_none());
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
