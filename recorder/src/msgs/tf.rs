//! `tf2_msgs/msg/TFMessage` on `/tf_static`: where each optical frame sits on the mount.

use crate::cdr::Writer;
use depthrig_bus::{Pose, StreamId};

/// The name of the mount's frame.
pub(crate) fn mount_frame(rig: &str) -> String {
    format!("{rig}_mount")
}

/// The name of a stream's optical frame.
pub(crate) fn optical_frame(id: &StreamId) -> String {
    format!("{}_{}_optical_frame", id.camera, id.stream)
}

pub(crate) fn write<'a>(
    buf: &mut Vec<u8>,
    stamp_utc_ns: i64,
    rig: &str,
    poses: impl ExactSizeIterator<Item = (&'a StreamId, &'a Pose)>,
) {
    let mut w = Writer::new(buf);
    w.u32(poses.len() as u32);
    for (id, pose) in poses {
        w.header(stamp_utc_ns, &mount_frame(rig)).str(&optical_frame(id));
        w.f64s(&pose.translation_m).f64s(&pose.rotation_xyzw);
    }
}
