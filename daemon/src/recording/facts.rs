//! What a recording needs to know of the streams that it is made of, and how `session.toml` lists them.

use crate::stream::Stream;
use depthrig_calib::PoseExt;
use depthrig_recorder::StreamRecord;
use std::sync::Arc;

/// What a recording needs to know of a camera's stream.
pub struct StreamFacts {
    /// The stream.
    pub stream: Arc<Stream>,
    /// Model and serial number of its camera.
    pub model: String,
    /// Serial number of its camera.
    pub serial: String,
    /// Where its calibration comes from.
    pub calibration: String,
    /// Pose of its camera on the mount.
    pub camera_pose: depthrig_bus::Pose,
    /// What computed it, if it is no camera's.
    pub computed: Option<depthrig_recorder::Computed>,
}

/// How `session.toml` lists a stream of pictures.
pub(super) fn record_of(s: &StreamFacts) -> StreamRecord {
    let p = &s.stream.profile;
    StreamRecord {
        id: s.stream.id.clone(),
        model: s.model.clone(),
        serial: s.serial.clone(),
        format: p.format,
        width: p.width,
        height: p.height,
        rate_hz: p.rate_hz,
        depth_unit_m: p.depth_unit_m,
        calibration: s.calibration.clone(),
        intrinsics: p.intrinsics,
        pose: s.camera_pose.compose(&p.pose_in_device),
    }
}
