//! How the mount moves through the world.
//!
//! The world has x to the right, y away from the viewer and z up, metres; its origin is the middle of the
//! table's top. The mount has x right, y down, z forward and looks at the table.

use core::f64::consts::TAU;
use depthrig_bus::HostTime;
use glam::{DAffine3, DMat3, DVec3};

/// Which of `poses` is shown after `steps` steps: 0, 1, …, last, …, 1, 0, 1, …
pub(crate) const fn to_and_fro(steps: u64, poses: u32) -> u32 {
    if poses < 2 {
        return 0;
    }
    let last = poses as u64 - 1;
    let at = steps % (2 * last);
    (if at <= last { at } else { 2 * last - at }) as u32
}

/// How many steps the mount has made when a frame is exposed at `t`.
pub(crate) fn steps(world_start: HostTime, t: HostTime, pose_rate_hz: f64) -> u64 {
    (t.since_ns(world_start).max(0) as f64 * 1e-9 * pose_rate_hz) as u64
}

/// The mount in the world at pose `index` of `poses`: half a turn of a slow swing that rests at both ends, so
/// that going to and fro is smooth.
pub(crate) fn mount(index: u32, poses: u32) -> DAffine3 {
    let s = if poses < 2 { 0.5 } else { f64::from(index) / f64::from(poses - 1) };
    let swing = -(s * TAU / 2.0).cos(); // -1 … 1, at rest at both ends
    let position = DVec3::new(0.02 + 0.075 * swing, -0.60 + 0.015 * swing * swing, 0.47 + 0.02 * swing);
    let target = DVec3::new(-0.01 - 0.01 * swing, 0.09, 0.07);
    look_at(position, target)
}

/// The frame at `position` whose z axis points at `target` and whose x axis is level.
pub(crate) fn look_at(position: DVec3, target: DVec3) -> DAffine3 {
    let forward = (target - position).normalize();
    let right = forward.cross(DVec3::Z).normalize();
    DAffine3::from_mat3_translation(DMat3::from_cols(right, forward.cross(right), forward), position)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn poses_go_to_and_fro() {
        let shown: Vec<_> = (0..9).map(|s| to_and_fro(s, 4)).collect();
        assert_eq!(shown, [0, 1, 2, 3, 2, 1, 0, 1, 2]);
        assert!((0..9).all(|s| to_and_fro(s, 1) == 0));
        let start = HostTime::from_ns(7);
        assert_eq!(steps(start, start.plus_ns(1_000_000_001), 15.0), 15);
        assert_eq!(steps(start, start.plus_ns(-5), 15.0), 0);
    }

    #[test]
    fn the_mount_moves_smoothly_and_looks_at_the_table() {
        let all: Vec<_> = (0..12).map(|i| mount(i, 12)).collect();
        let moved: Vec<_> = all.windows(2).map(|w| (w[1].translation - w[0].translation).length()).collect();
        assert!(moved.iter().all(|m| *m > 0.0005 && *m < 0.03), "{moved:?}");
        assert!(moved[0] < moved[5] / 2.0, "slow at the end, fast in the middle: {moved:?}");
        for m in all {
            assert!((m.matrix3.determinant() - 1.0).abs() < 1e-12);
            let down = m.transform_vector3(DVec3::Y);
            assert!(down.z < -0.5, "the image's down is the world's down");
            assert!(m.inverse().transform_point3(DVec3::ZERO).z > 0.5, "the table is in front");
        }
    }
}
