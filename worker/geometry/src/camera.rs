//! Pinhole cameras and the similarity between the capture's world and the normalised frame, in f64.
//!
//! Axes: x right, y down, z forward. A pose is `camera_from_world`; names compose (`a_from_b * b_from_c`). Pixel
//! coordinates are continuous: `(0, 0)` is the top-left corner of the image and pixel `(i, j)` has its centre at
//! `(i + 0.5, j + 0.5)`, so resizing and cropping are exact scalings and shifts of the intrinsics.

use glam::{DAffine3, DMat3, DQuat, DVec2, DVec3};
use serde::{Deserialize, Serialize};

/// How far `RᵀR` may be from the identity before a pose is refused; poses printed with four digits still pass.
const ROTATION_TOLERANCE: f64 = 1e-3;
/// Below this deviation a rotation is kept bit for bit; above it (and below the tolerance) it is orthonormalised.
const ROTATION_EXACT: f64 = 1e-12;

/// Why a camera cannot be used.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum CameraError {
    /// A focal length that is zero, negative or not finite.
    #[error("focal length is ({fx}, {fy}), expected two positive finite numbers")]
    FocalLength {
        /// Horizontal focal length in pixels.
        fx: f64,
        /// Vertical focal length in pixels.
        fy: f64,
    },
    /// A principal point that is not finite.
    #[error("principal point is ({cx}, {cy}), expected finite numbers")]
    PrincipalPoint {
        /// Horizontal coordinate in pixels.
        cx: f64,
        /// Vertical coordinate in pixels.
        cy: f64,
    },
    /// An image without pixels.
    #[error("image size is {width}x{height}, expected at least one pixel")]
    ImageSize {
        /// Width in pixels.
        width: u32,
        /// Height in pixels.
        height: u32,
    },
    /// A pose that holds a NaN or an infinity.
    #[error("pose is not finite")]
    PoseNotFinite,
    /// A pose whose linear part is not a rotation.
    #[error(
        "pose is not a rotation: it differs by {deviation} from an orthonormal right-handed matrix"
    )]
    PoseNotRigid {
        /// Largest entry of `|RᵀR - 1|`, or 2 for a reflection.
        deviation: f64,
    },
    /// A viewing direction that is undefined, because eye and target coincide or `up` is parallel to the view.
    #[error(
        "look-at directions are degenerate: eye and target coincide or up is parallel to the view"
    )]
    LookAt,
}

/// Pinhole intrinsics in pixels, for an image of `width` x `height` pixels.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct CameraIntrinsics {
    /// Horizontal focal length in pixels.
    pub fx: f64,
    /// Vertical focal length in pixels.
    pub fy: f64,
    /// Principal point, horizontal, from the image's left edge.
    pub cx: f64,
    /// Principal point, vertical, from the image's top edge.
    pub cy: f64,
    /// Image width in pixels.
    pub width: u32,
    /// Image height in pixels.
    pub height: u32,
}

impl CameraIntrinsics {
    /// Checks that focal lengths are positive, all numbers finite and the image not empty.
    pub fn validate(&self) -> Result<(), CameraError> {
        let &Self {
            fx,
            fy,
            cx,
            cy,
            width,
            height,
        } = self;
        if !(fx.is_finite() && fy.is_finite() && fx > 0.0 && fy > 0.0) {
            return Err(CameraError::FocalLength { fx, fy });
        }
        if !(cx.is_finite() && cy.is_finite()) {
            return Err(CameraError::PrincipalPoint { cx, cy });
        }
        if width == 0 || height == 0 {
            return Err(CameraError::ImageSize { width, height });
        }
        Ok(())
    }

    /// The same view resampled to `width` x `height` pixels.
    #[must_use]
    pub fn resized(&self, width: u32, height: u32) -> Self {
        let sx = f64::from(width) / f64::from(self.width);
        let sy = f64::from(height) / f64::from(self.height);
        Self {
            fx: self.fx * sx,
            fy: self.fy * sy,
            cx: self.cx * sx,
            cy: self.cy * sy,
            width,
            height,
        }
    }

    /// The window of `width` x `height` pixels whose top-left corner lies at `(x0, y0)` of this image. The window
    /// may reach outside the image.
    #[must_use]
    pub fn cropped(&self, x0: f64, y0: f64, width: u32, height: u32) -> Self {
        Self {
            cx: self.cx - x0,
            cy: self.cy - y0,
            width,
            height,
            ..*self
        }
    }

    /// Whether a point of the image plane lies inside the image (edges included).
    pub fn contains(&self, px: DVec2) -> bool {
        px.x >= 0.0
            && px.y >= 0.0
            && px.x <= f64::from(self.width)
            && px.y <= f64::from(self.height)
    }

    /// Direction, in camera axes and with z = 1, of the ray through `px`.
    pub fn ray(&self, px: DVec2) -> DVec3 {
        DVec3::new((px.x - self.cx) / self.fx, (px.y - self.cy) / self.fy, 1.0)
    }
}

/// Where a point falls in an image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Projection {
    /// Continuous pixel coordinates; may lie outside the image.
    pub px: DVec2,
    /// Camera z, positive.
    pub depth: f64,
}

/// A pinhole camera: intrinsics and pose.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Camera {
    /// Intrinsics.
    pub intrinsics: CameraIntrinsics,
    /// Rigid transform from world to camera axes.
    pub camera_from_world: DAffine3,
}

impl Camera {
    /// A camera from checked parts. A rotation that is only nearly orthonormal (few printed digits) is
    /// orthonormalised.
    ///
    /// # Errors
    /// [`CameraError`] for bad intrinsics, a pose that is not finite, or one that is no rotation.
    pub fn new(
        intrinsics: CameraIntrinsics,
        camera_from_world: DAffine3,
    ) -> Result<Self, CameraError> {
        intrinsics.validate()?;
        if !camera_from_world.is_finite() {
            return Err(CameraError::PoseNotFinite);
        }
        let rotation = camera_from_world.matrix3;
        let gram = rotation.transpose() * rotation - DMat3::IDENTITY;
        let mut deviation = gram
            .to_cols_array()
            .iter()
            .fold(0.0_f64, |worst, entry| worst.max(entry.abs()));
        if rotation.determinant() <= 0.0 {
            deviation = deviation.max(2.0);
        }
        if deviation.is_nan() || deviation > ROTATION_TOLERANCE {
            return Err(CameraError::PoseNotRigid { deviation });
        }
        let matrix3 = if deviation <= ROTATION_EXACT {
            rotation
        } else {
            DMat3::from_quat(DQuat::from_mat3(&rotation).normalize())
        };
        Ok(Self {
            intrinsics,
            camera_from_world: DAffine3 {
                matrix3,
                ..camera_from_world
            },
        })
    }

    /// A camera at `eye` that looks at `target`, with `up` pointing up in the image.
    ///
    /// # Errors
    /// [`CameraError::LookAt`] when the directions are degenerate, or what [`Camera::new`] finds.
    pub fn look_at(
        intrinsics: CameraIntrinsics,
        eye: DVec3,
        target: DVec3,
        up: DVec3,
    ) -> Result<Self, CameraError> {
        let forward = (target - eye).try_normalize().ok_or(CameraError::LookAt)?;
        let up = up.try_normalize().ok_or(CameraError::LookAt)?;
        let side = forward.cross(up);
        if side.length() < 1e-9 {
            return Err(CameraError::LookAt);
        }
        let right = side.try_normalize().ok_or(CameraError::LookAt)?;
        let down = forward.cross(right);
        let rotation = DMat3::from_cols(right, down, forward).transpose();
        Self::new(
            intrinsics,
            DAffine3 {
                matrix3: rotation,
                translation: -(rotation * eye),
            },
        )
    }

    /// Inverse of the pose.
    pub fn world_from_camera(&self) -> DAffine3 {
        let rotation = self.camera_from_world.matrix3.transpose();
        DAffine3 {
            matrix3: rotation,
            translation: -(rotation * self.camera_from_world.translation),
        }
    }

    /// Centre of projection in world coordinates.
    pub fn center(&self) -> DVec3 {
        self.world_from_camera().translation
    }

    /// Projects a world point; `None` when it does not lie in front of the camera or is not finite.
    pub fn project(&self, point_in_world: DVec3) -> Option<Projection> {
        let point = self.camera_from_world.transform_point3(point_in_world);
        if !(point.z > 0.0 && point.is_finite()) {
            return None;
        }
        let intrinsics = &self.intrinsics;
        let px = DVec2::new(
            intrinsics.fx * point.x / point.z + intrinsics.cx,
            intrinsics.fy * point.y / point.z + intrinsics.cy,
        );
        px.is_finite().then_some(Projection { px, depth: point.z })
    }

    /// The world point at depth `depth` (camera z) behind the image point `px`.
    pub fn unproject(&self, px: DVec2, depth: f64) -> DVec3 {
        self.world_from_camera()
            .transform_point3(self.intrinsics.ray(px) * depth)
    }

    /// The camera that sees the transformed scene exactly as this one sees the original; depths scale along.
    #[must_use]
    pub fn transformed(&self, new_from_old: Similarity) -> Self {
        let DAffine3 {
            matrix3,
            translation,
        } = self.camera_from_world;
        let translation = (matrix3 * new_from_old.translation + translation) * new_from_old.scale;
        Self {
            intrinsics: self.intrinsics,
            camera_from_world: DAffine3 {
                matrix3,
                translation,
            },
        }
    }

    /// The same pose with other intrinsics (a resized or cropped image).
    #[must_use]
    pub fn with_intrinsics(&self, intrinsics: CameraIntrinsics) -> Self {
        Self {
            intrinsics,
            ..*self
        }
    }
}

/// Translation and uniform scale between two frames: `p_new = (p_old - translation) * scale`.
///
/// Takes the capture's world to the normalised frame, in which the object's bounding sphere has radius 1 at the
/// origin. Rotations are unchanged.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Similarity {
    /// Length of one old unit in the new frame; positive.
    pub scale: f64,
    /// The old point that becomes the new origin.
    pub translation: DVec3,
}

impl Similarity {
    /// Leaves everything where it is.
    pub const IDENTITY: Self = Self {
        scale: 1.0,
        translation: DVec3::ZERO,
    };

    /// A point of the old frame in the new one.
    pub fn transform_point(&self, point: DVec3) -> DVec3 {
        (point - self.translation) * self.scale
    }

    /// The way back.
    #[must_use]
    pub fn inverse(&self) -> Self {
        Self {
            scale: self.scale.recip(),
            translation: -self.translation * self.scale,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::{Strategy, prop_assert, proptest};

    fn intrinsics() -> CameraIntrinsics {
        CameraIntrinsics {
            fx: 311.0,
            fy: 297.0,
            cx: 70.3,
            cy: 51.9,
            width: 160,
            height: 96,
        }
    }

    fn pose() -> impl Strategy<Value = DAffine3> {
        (
            -3.0..3.0,
            -3.0..3.0,
            -3.0..3.0,
            -5.0..5.0,
            -5.0..5.0,
            -5.0..5.0,
        )
            .prop_map(|(a, b, c, x, y, z)| {
                DAffine3::from_rotation_translation(
                    DQuat::from_euler(glam::EulerRot::XYZ, a, b, c),
                    DVec3::new(x, y, z),
                )
            })
    }

    proptest! {
        #[test]
        fn project_inverts_unproject(pose in pose(), x in -50.0..250.0, y in -50.0..150.0, depth in 1e-3..1e3) {
            let camera = Camera::new(intrinsics(), pose).expect("rigid");
            let seen = camera.project(camera.unproject(DVec2::new(x, y), depth)).expect("in front");
            // The world point is rounded at the size of the translation, seen from as near as 1e-3.
            prop_assert!((seen.px - DVec2::new(x, y)).length() < 1e-8 * (1.0 + 1.0 / depth));
            prop_assert!((seen.depth - depth).abs() < 1e-12 * (10.0 + depth));
        }

        #[test]
        fn poses_compose(a in pose(), b in pose(), x in -1.0..1.0, y in -1.0..1.0) {
            let point = DVec3::new(x, y, 0.3);
            let whole = (a * b).transform_point3(point);
            prop_assert!((a.transform_point3(b.transform_point3(point)) - whole).length() < 1e-12);
            let camera = Camera::new(intrinsics(), a).expect("rigid");
            let back = camera.world_from_camera() * camera.camera_from_world;
            prop_assert!(back.abs_diff_eq(DAffine3::IDENTITY, 1e-12));
        }

        #[test]
        fn similarity_keeps_pixels_and_scales_depth(pose in pose(), scale in 0.01..50.0, x in 5.0..150.0) {
            let camera = Camera::new(intrinsics(), pose).expect("rigid");
            let similarity = Similarity { scale, translation: DVec3::new(0.4, -3.0, 2.0) };
            let point = camera.unproject(DVec2::new(x, 20.0), 2.5);
            let seen = camera.transformed(similarity).project(similarity.transform_point(point)).expect("in front");
            prop_assert!((seen.px - DVec2::new(x, 20.0)).length() < 1e-8);
            prop_assert!((seen.depth - 2.5 * scale).abs() < 1e-10 * scale);
            let back = similarity.inverse().transform_point(similarity.transform_point(point));
            prop_assert!((back - point).length() < 1e-11);
        }

        #[test]
        fn resize_and_crop_move_pixels_alike(pose in pose(), x in 0.0..160.0, y in 0.0..96.0) {
            let camera = Camera::new(intrinsics(), pose).expect("rigid");
            let point = camera.unproject(DVec2::new(x, y), 3.0);
            let small = camera.with_intrinsics(camera.intrinsics.resized(40, 48)).project(point).expect("in front");
            prop_assert!((small.px - DVec2::new(x / 4.0, y / 2.0)).length() < 1e-9);
            let window = camera.with_intrinsics(camera.intrinsics.cropped(11.5, -7.0, 32, 32));
            let window = window.project(point).expect("in front");
            prop_assert!((window.px - DVec2::new(x - 11.5, y + 7.0)).length() < 1e-9);
        }
    }

    #[test]
    fn axes_are_right_down_forward() {
        let camera = Camera::look_at(
            intrinsics(),
            DVec3::new(0.0, 0.0, 5.0),
            DVec3::ZERO,
            DVec3::Y,
        )
        .expect("look at");
        let middle = camera.project(DVec3::ZERO).expect("in front");
        assert!(
            (middle.px - DVec2::new(70.3, 51.9)).length() < 1e-9
                && (middle.depth - 5.0).abs() < 1e-12
        );
        assert!(camera.project(DVec3::X).expect("in front").px.x > middle.px.x);
        assert!(camera.project(DVec3::Y).expect("in front").px.y < middle.px.y);
        assert!((camera.center() - DVec3::new(0.0, 0.0, 5.0)).length() < 1e-12);
        assert_eq!(camera.project(DVec3::new(0.0, 0.0, 6.0)), None);
        assert_eq!(camera.project(DVec3::new(f64::NAN, 0.0, 0.0)), None);
    }

    #[test]
    fn bad_cameras_are_refused() {
        let identity = DAffine3::IDENTITY;
        let refuse = |intrinsics| Camera::new(intrinsics, identity).expect_err("bad intrinsics");
        let good = intrinsics();
        assert!(matches!(
            refuse(CameraIntrinsics { fx: 0.0, ..good }),
            CameraError::FocalLength { .. }
        ));
        assert!(matches!(
            refuse(CameraIntrinsics {
                fy: f64::NAN,
                ..good
            }),
            CameraError::FocalLength { .. }
        ));
        assert!(matches!(
            refuse(CameraIntrinsics {
                cx: f64::INFINITY,
                ..good
            }),
            CameraError::PrincipalPoint { .. }
        ));
        assert!(matches!(
            refuse(CameraIntrinsics { width: 0, ..good }),
            CameraError::ImageSize { .. }
        ));
        let pose = |matrix| Camera::new(good, DAffine3::from_mat3(matrix)).expect_err("bad pose");
        assert!(matches!(
            pose(DMat3::IDENTITY * 2.0),
            CameraError::PoseNotRigid { .. }
        ));
        assert!(matches!(
            pose(DMat3::from_diagonal(DVec3::new(1.0, 1.0, -1.0))),
            CameraError::PoseNotRigid { .. }
        ));
        assert!(matches!(
            pose(DMat3::IDENTITY * f64::NAN),
            CameraError::PoseNotFinite
        ));
        let eye = DVec3::new(0.0, 3.0, 0.0);
        assert_eq!(
            Camera::look_at(good, eye, DVec3::ZERO, DVec3::Y),
            Err(CameraError::LookAt)
        );
        assert_eq!(
            Camera::look_at(good, eye, eye, DVec3::Y),
            Err(CameraError::LookAt)
        );
    }

    #[test]
    fn rounded_rotations_are_orthonormalised() {
        let exact = DMat3::from_euler(glam::EulerRot::XYZ, 0.3, 1.2, -0.7);
        let rounded = DMat3::from_cols_array(
            &exact
                .to_cols_array()
                .map(|entry| (entry * 1e5).round() / 1e5),
        );
        let camera = Camera::new(intrinsics(), DAffine3::from_mat3(rounded)).expect("nearly rigid");
        let rotation = camera.camera_from_world.matrix3;
        assert!((rotation.transpose() * rotation).abs_diff_eq(DMat3::IDENTITY, 1e-14));
        assert!(rotation.abs_diff_eq(exact, 2e-5));
    }
}
