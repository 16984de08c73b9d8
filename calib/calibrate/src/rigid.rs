//! Rigid transforms as the optimiser needs them: composed, inverted, moved by small steps.

use depthrig_bus::Pose;
use glam::{DAffine3, DMat3, DQuat, DVec3};
use nalgebra::Vector6;

/// A rotation, then a translation in metres: `p' = R p + t`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rigid {
    /// `R`, of unit length.
    pub rotation: DQuat,
    /// `t`.
    pub translation: DVec3,
}

impl Rigid {
    /// No motion.
    pub const IDENTITY: Self = Self { rotation: DQuat::IDENTITY, translation: DVec3::ZERO };

    /// From a rotation matrix, which is made orthonormal.
    pub fn from_matrix(rotation: DMat3, translation: DVec3) -> Self {
        Self { rotation: DQuat::from_mat3(&rotation).normalize(), translation }
    }

    /// `R p + t`.
    pub fn transform(&self, p: DVec3) -> DVec3 {
        self.rotation * p + self.translation
    }

    /// The same as a matrix, with which many points are transformed faster.
    pub fn affine(&self) -> DAffine3 {
        DAffine3::from_rotation_translation(self.rotation, self.translation)
    }

    /// First `first`, then this.
    pub fn after(&self, first: &Self) -> Self {
        Self {
            rotation: (self.rotation * first.rotation).normalize(),
            translation: self.transform(first.translation),
        }
    }

    /// The inverse.
    pub fn inverse(&self) -> Self {
        let rotation = self.rotation.conjugate();
        Self { rotation, translation: -(rotation * self.translation) }
    }

    /// Moved by a small rotation (a vector along its axis, radians) about the origin of the target frame, then by a
    /// translation: to first order `p' + rotation × p' + translation`.
    pub fn moved(&self, rotation: DVec3, translation: DVec3) -> Self {
        let by = DQuat::from_scaled_axis(rotation);
        Self { rotation: (by * self.rotation).normalize(), translation: by * self.translation + translation }
    }

    /// How far it is from `other`.
    pub fn distance(&self, other: &Self) -> Distance {
        let between = self.after(&other.inverse());
        // Both signs of a quaternion are one rotation.
        let angle = between.rotation.xyz().length().atan2(between.rotation.w.abs()) * 2.0;
        Distance { metres: (self.translation - other.translation).length(), radians: angle }
    }

    /// The rotation as a vector along its axis, radians, shorter than π.
    pub fn rotation_vector(&self) -> DVec3 {
        let q = if self.rotation.w < 0.0 { -self.rotation } else { self.rotation };
        q.to_scaled_axis()
    }
}

/// Change of a value whose gradient at the point `p` is `gradient`, as `p` moves like [`Rigid::moved`]: by the rotation, by the
/// translation.
pub(crate) fn by_motion(p: DVec3, gradient: DVec3) -> Vector6<f64> {
    let by_rotation = p.cross(gradient);
    Vector6::new(by_rotation.x, by_rotation.y, by_rotation.z, gradient.x, gradient.y, gradient.z)
}

/// A distance between two poses.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Distance {
    /// Between the translations.
    pub metres: f64,
    /// Angle of the rotation between them.
    pub radians: f64,
}

impl From<&Pose> for Rigid {
    fn from(pose: &Pose) -> Self {
        let q = DQuat::from_array(pose.rotation_xyzw);
        let length = q.length();
        let rotation = if length.is_finite() && length > 1e-12 { q / length } else { DQuat::IDENTITY };
        Self { rotation, translation: DVec3::from_array(pose.translation_m) }
    }
}

impl From<&Rigid> for Pose {
    fn from(rigid: &Rigid) -> Self {
        Self { translation_m: rigid.translation.to_array(), rotation_xyzw: rigid.rotation.to_array() }
    }
}
