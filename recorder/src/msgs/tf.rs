//! `tf2_msgs/msg/TFMessage` on `/tf_static`: where each optical frame and each IMU sits on the mount.

use crate::Session;
use crate::cdr::Writer;
use depthrig_bus::StreamId;

/// The name of the mount's frame.
pub(crate) fn mount_frame(rig: &str) -> String {
    format!("{rig}_mount")
}

/// The name of a stream's optical frame.
pub(crate) fn optical_frame(id: &StreamId) -> String {
    format!("{}_{}_optical_frame", id.camera, id.stream)
}

/// The name of an IMU's frame.
pub(crate) fn unit_frame(id: &StreamId) -> String {
    format!("{}_{}_frame", id.camera, id.stream)
}

pub(crate) fn write(buf: &mut Vec<u8>, stamp_utc_ns: i64, session: &Session) {
    let streams = session.streams.iter().map(|s| (optical_frame(&s.id), &s.pose));
    let units = session.motion.iter().map(|u| (unit_frame(&u.id), &u.pose));
    let mount = mount_frame(&session.rig);
    let mut w = Writer::new(buf);
    w.u32((session.streams.len() + session.motion.len()) as u32);
    for (child, pose) in streams.chain(units) {
        w.header(stamp_utc_ns, &mount).str(&child);
        w.f64s(&pose.translation_m).f64s(&pose.rotation_xyzw);
    }
}
