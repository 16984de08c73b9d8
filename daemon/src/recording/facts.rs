//! Facts about the streams of a recording, and how `session.toml` lists them.

use crate::stream::Stream;
use depthrig_calib::PoseExt;
use depthrig_recorder::StreamRecord;
use std::sync::Arc;

/// Facts about a camera's stream that a recording needs.
pub struct StreamFacts {
    /// The stream.
    pub stream: Arc<Stream>,
    /// Model and serial number of its camera.
    pub model: String,
    /// Serial number of its camera.
    pub serial: String,
    /// Firmware of its camera; empty if unknown.
    pub firmware: String,
    /// Where its calibration comes from.
    pub calibration: String,
    /// Pose of its camera on the mount.
    pub camera_pose: depthrig_bus::Pose,
    /// The algorithm that computed it; `None` for a camera's own stream.
    pub computed: Option<depthrig_recorder::Computed>,
}

/// How `session.toml` lists a stream of images.
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
