//! Poses of librealsense, which say the way from depth to a stream, as poses of cameras on the mount.

use crate::rosbag::messages::Transform;
use depthrig_bus::Pose;

/// Norms at which a quaternion counts as a rotation.
const UNIT: core::ops::Range<f64> = 0.99..1.01;

/// Where the camera is on the mount, whose origin is that of depth: the bag has the way from depth to this stream,
/// `p_stream = R p_depth + t`, and a pose is the way back.
pub(super) fn pose_of(transform: Transform) -> Option<Pose> {
    let Transform { translation: t, rotation: q } = transform;
    let norm = q.iter().map(|v| v * v).sum::<f64>().sqrt();
    if !UNIT.contains(&norm) || !t.iter().all(|v| v.is_finite()) {
        return None;
    }
    let [x, y, z, w] = q.map(|v| v / norm);
    // The inverse of a rotation is its conjugate; the identity stays as it is, without a minus zero.
    let q = [0.0 - x, 0.0 - y, 0.0 - z, w];
    let [a, b, c] = rotate(q, t);
    Some(Pose { translation_m: [0.0 - a, 0.0 - b, 0.0 - c], rotation_xyzw: q })
}

/// `v` turned by the unit quaternion `q`: v + 2w(u × v) + 2(u × (u × v)).
fn rotate([x, y, z, w]: [f64; 4], v: [f64; 3]) -> [f64; 3] {
    let cross = |a: [f64; 3], b: [f64; 3]| {
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    };
    let once = cross([x, y, z], v);
    let twice = cross([x, y, z], once);
    [0, 1, 2].map(|i| v[i] + 2.0 * w * once[i] + 2.0 * twice[i])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pose_is_the_way_back() {
        let half = core::f64::consts::FRAC_1_SQRT_2;
        // A quarter turn about z, then 1 m along x: the point (0, -1, 0) of depth is the stream's (2, 0, 0).
        let t = [1.0, 0.0, 0.0];
        let q = [0.0, 0.0, half, half];
        let p = [0.0, -1.0, 0.0];
        let there = rotate(q, p);
        let there = [there[0] + t[0], there[1] + t[1], there[2] + t[2]];
        let pose = pose_of(Transform { translation: t, rotation: q }).unwrap();
        let back = rotate(pose.rotation_xyzw, there);
        for (i, v) in p.iter().enumerate() {
            assert!((there[i] - [2.0, 0.0, 0.0][i]).abs() < 1e-12);
            assert!((back[i] + pose.translation_m[i] - v).abs() < 1e-12);
        }
        let identity = Transform { translation: [0.0; 3], rotation: [0.0, 0.0, 0.0, 1.0] };
        assert_eq!(pose_of(identity), Some(Pose::IDENTITY));
        assert_eq!(pose_of(Transform { rotation: [0.0; 4], ..identity }), None);
    }
}
