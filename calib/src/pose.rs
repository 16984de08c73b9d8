//! Rigid transforms: the wire type [`Pose`] in and out of the mathematics of `glam`.

use depthrig_bus::Pose;
use glam::{DAffine3, DQuat, DVec3};

/// Mathematics on the wire type [`Pose`].
pub trait PoseExt: Sized {
    /// The pose as an affine map from the child's coordinates to the parent's. A rotation that is not of unit
    /// length (as typed by a person) is normalised; a zero or non-finite one counts as no rotation.
    fn to_affine(&self) -> DAffine3;

    /// The pose of a rigid affine map; scale or shear in it is lost.
    fn from_affine(map: &DAffine3) -> Self;

    /// The pose of `child`'s frame in this pose's parent: `self ∘ child`. Where one of them is the identity, it is the
    /// other one bit by bit.
    fn compose(&self, child: &Self) -> Self;

    /// The pose of the parent in the child.
    fn inverse(&self) -> Self;

    /// `p_parent = R p_child + t`, metres.
    fn transform_point(&self, p_child: DVec3) -> DVec3;
}

impl PoseExt for Pose {
    fn to_affine(&self) -> DAffine3 {
        let q = DQuat::from_array(self.rotation_xyzw);
        let length = q.length();
        let q = if length.is_finite() && length > 1e-12 { q / length } else { DQuat::IDENTITY };
        DAffine3::from_rotation_translation(q, DVec3::from_array(self.translation_m))
    }

    fn from_affine(map: &DAffine3) -> Self {
        let q = DQuat::from_mat3(&map.matrix3).normalize();
        Self { translation_m: map.translation.to_array(), rotation_xyzw: q.to_array() }
    }

    fn compose(&self, child: &Self) -> Self {
        if *self == Self::IDENTITY {
            return *child;
        }
        if *child == Self::IDENTITY {
            return *self;
        }
        Self::from_affine(&(self.to_affine() * child.to_affine()))
    }

    fn inverse(&self) -> Self {
        Self::from_affine(&self.to_affine().inverse())
    }

    fn transform_point(&self, p_child: DVec3) -> DVec3 {
        self.to_affine().transform_point3(p_child)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use proptest::strategy::ValueTree as _;

    fn poses() -> impl Strategy<Value = Pose> {
        let t = prop::array::uniform3(-5.0f64..5.0);
        let q = prop::array::uniform4(-1.0f64..1.0)
            .prop_filter("too short to be a rotation", |q| q.iter().map(|c| c * c).sum::<f64>() > 0.01);
        (t, q).prop_map(|(translation_m, rotation_xyzw)| Pose { translation_m, rotation_xyzw })
    }

    /// `R p + t` written out with the textbook matrix of a unit quaternion.
    fn by_hand(pose: &Pose, p: [f64; 3]) -> [f64; 3] {
        let n = pose.rotation_xyzw.iter().map(|c| c * c).sum::<f64>().sqrt();
        let [x, y, z, w] = pose.rotation_xyzw.map(|c| c / n);
        let r = [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
            [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)],
            [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)],
        ];
        core::array::from_fn(|i| (0..3).map(|j| r[i][j] * p[j]).sum::<f64>() + pose.translation_m[i])
    }

    proptest! {
        #[test]
        fn agrees_with_the_textbook(a in poses(), b in poses(), p in prop::array::uniform3(-3.0f64..3.0)) {
            let v = DVec3::from_array(p);
            prop_assert!((a.transform_point(v) - DVec3::from_array(by_hand(&a, p))).length() < 1e-9);
            let chained = DVec3::from_array(by_hand(&a, by_hand(&b, p)));
            prop_assert!((a.compose(&b).transform_point(v) - chained).length() < 1e-9);
            prop_assert!((a.inverse().transform_point(a.transform_point(v)) - v).length() < 1e-9);
        }
    }

    /// A replay, whose cameras have no pose of their own, must not change the poses of a dataset.
    #[test]
    fn composed_with_the_identity_a_pose_stays_as_it_is_bit_by_bit() {
        let bits = |p: &Pose| (p.translation_m.map(f64::to_bits), p.rotation_xyzw.map(f64::to_bits));
        let mut runner = proptest::test_runner::TestRunner::deterministic();
        for _ in 0..1000 {
            let mut pose = poses().new_tree(&mut runner).unwrap().current();
            let n = pose.rotation_xyzw.iter().map(|c| c * c).sum::<f64>().sqrt();
            pose.rotation_xyzw = pose.rotation_xyzw.map(|c| c / n);
            assert_eq!(bits(&Pose::IDENTITY.compose(&pose)), bits(&pose));
            assert_eq!(bits(&pose.compose(&Pose::IDENTITY)), bits(&pose));
        }
    }

    #[test]
    fn a_rotation_that_is_none_counts_as_identity() {
        for bad in [[0.0; 4], [f64::NAN; 4]] {
            let pose = Pose { translation_m: [1.0, 2.0, 3.0], rotation_xyzw: bad };
            assert_eq!(pose.transform_point(DVec3::ZERO), DVec3::new(1.0, 2.0, 3.0));
            assert_eq!(pose.transform_point(DVec3::X), DVec3::new(2.0, 2.0, 3.0));
        }
    }
}
