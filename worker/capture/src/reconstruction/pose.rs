//! Poses as other programs write them, as rigid transforms into camera axes.

use glam::{DAffine3, DMat3, DQuat, DVec3};

/// How far the columns of a written rotation may be from orthonormal: files with few digits, no shear.
const ORTHONORMAL_WITHIN: f64 = 1e-3;

/// From axes x right, y up, z backwards (OpenGL, Bundler) to ours, and back.
pub(super) const FLIP_Y_AND_Z: DMat3 = DMat3::from_cols(
    DVec3::new(1.0, 0.0, 0.0),
    DVec3::new(0.0, -1.0, 0.0),
    DVec3::new(0.0, 0.0, -1.0),
);

/// The camera that stands at `center` and whose axes, in the world, are the columns of `world_from_axes` up to a
/// common scale.
///
/// # Errors
/// What is wrong with the numbers, to follow a camera's or image's name.
pub(super) fn camera_from_world(
    world_from_axes: DMat3,
    center: DVec3,
) -> Result<DAffine3, &'static str> {
    let rotation = rotation(world_from_axes)?;
    if !center.is_finite() {
        return Err("has a position that is not finite");
    }
    let camera_from_world = rotation.inverse();
    let translation = -(camera_from_world * center);
    if !translation.is_finite() {
        return Err("has a position that is not finite");
    }
    Ok(DAffine3::from_rotation_translation(
        camera_from_world,
        translation,
    ))
}

/// The rotation of a matrix that is one up to a scale and to rounding.
///
/// # Errors
/// What is wrong with the numbers.
pub(super) fn rotation(matrix: DMat3) -> Result<DQuat, &'static str> {
    if !matrix.is_finite() {
        return Err("has a rotation that is not finite");
    }
    let scale = matrix.col(0).length();
    let unit = matrix * scale.recip();
    if !(scale > 0.0 && unit.is_finite()) {
        return Err("has a rotation of length zero");
    }
    if !(unit.transpose() * unit).abs_diff_eq(DMat3::IDENTITY, ORTHONORMAL_WITHIN) {
        return Err("has axes that are not at right angles or not of one length");
    }
    if unit.determinant() < 0.0 {
        return Err("has mirrored axes");
    }
    Ok(DQuat::from_mat3(&unit).normalize())
}

/// A similarity of the world: `x -> scale * rotation * x + translation`.
#[derive(Debug, Clone, Copy)]
pub(super) struct Similarity {
    pub(super) scale: f64,
    pub(super) rotation: DMat3,
    pub(super) translation: DVec3,
}

impl Similarity {
    pub(super) const IDENTITY: Self = Self {
        scale: 1.0,
        rotation: DMat3::IDENTITY,
        translation: DVec3::ZERO,
    };

    pub(super) fn apply(&self, point: DVec3) -> DVec3 {
        self.scale * (self.rotation * point) + self.translation
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_rotations_are_taken() {
        let turned = DMat3::from_quat(DQuat::from_xyzw(0.1, -0.4, 0.2, 0.7).normalize());
        let pose = camera_from_world(turned * 3.0, DVec3::new(1.0, 2.0, 3.0)).expect("a pose");
        assert!(pose.transform_point3(DVec3::new(1.0, 2.0, 3.0)).length() < 1e-12);
        assert!(pose.matrix3.abs_diff_eq(turned.transpose(), 1e-12));
        for (matrix, part) in [
            (DMat3::ZERO, "length zero"),
            (turned * f64::NAN, "not finite"),
            (turned * -1.0, "mirrored"),
            (
                turned * DMat3::from_diagonal(DVec3::new(1.0, 1.1, 1.0)),
                "right angles",
            ),
        ] {
            let message = camera_from_world(matrix, DVec3::ZERO).expect_err("no rotation");
            assert!(message.contains(part), "{message}");
        }
        assert!(camera_from_world(turned, DVec3::INFINITY).is_err());
        assert!(camera_from_world(turned, DVec3::MAX).is_err());
    }
}
