//! A pose in the rig's file.

use super::read::Section;
use depthrig_bus::Pose;

/// Reads the table `key`, written as `kind` shows: metres, and a unit quaternion or angles in degrees; the identity where it is left out.
pub(crate) fn pose(camera: &Section<'_, '_>, key: &'static str, kind: &'static str) -> Pose {
    let s = camera.table(key, kind);
    let translation_m = s.or("translation_m", [0.0; 3], |_| Ok(()));
    let quaternion = s.get::<[f64; 4]>("rotation_xyzw");
    let angles = s.get::<[f64; 3]>("rotation_rpy_deg");
    let rotation_xyzw = match (quaternion, angles) {
        (None, None) => Pose::IDENTITY.rotation_xyzw,
        (None, Some(a)) => quaternion_of_rpy_deg(a.value),
        (Some(q), None) => {
            let norm = q.value.iter().map(|c| c * c).sum::<f64>().sqrt();
            if (norm - 1.0).abs() > 1e-3 {
                let why = format!("must be a quaternion x, y, z, w of length 1; its length is {norm:.4}");
                s.problem(q.at, format!("{} {why}", s.key_of("rotation_xyzw")));
            }
            q.value.map(|c| c / norm)
        }
        (Some(q), Some(a)) => {
            s.problem(q.at.max(a.at), "rotation_xyzw and rotation_rpy_deg say the same thing; keep one");
            Pose::IDENTITY.rotation_xyzw
        }
    };
    s.finish();
    Pose { translation_m, rotation_xyzw }
}

/// The unit quaternion of turns about the fixed axes x, then y, then z of the mount (roll, pitch, yaw as in URDF):
/// `R = Rz(yaw) Ry(pitch) Rx(roll)`.
fn quaternion_of_rpy_deg(angles: [f64; 3]) -> [f64; 4] {
    let [(sr, cr), (sp, cp), (sy, cy)] = angles.map(|a| (a.to_radians() / 2.0).sin_cos());
    [
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    ]
}
