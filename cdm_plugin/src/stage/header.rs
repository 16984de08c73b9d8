//! The header of a refined frame.

use depthrig_bus::{FrameFlags, FrameHeader, PixelFormat, StageStep};

/// Flags of the source frames that hold for the refined frame, too.
const INHERITED: u32 = FrameFlags::REPLAYED
    .with(FrameFlags::SYNTHETIC)
    .with(FrameFlags::TIME_UNCERTAIN)
    .with(FrameFlags::CLOCK_WARMUP)
    .0;

/// The header of the refined frame of `color` and `depth`, without its numbers and times on the channel. `epoch` is the
/// clock map of the frame before.
pub fn derived_header(
    color: &FrameHeader,
    depth: &FrameHeader,
    format: PixelFormat,
    unit_m: f64,
    stage_ns: [u64; StageStep::ALL.len()],
    epoch: Option<u32>,
) -> FrameHeader {
    let changed = epoch.is_some_and(|e| e != depth.clock_epoch);
    let inherited = depth.flags & !(FrameFlags::EPOCH_CHANGED.0) | color.flags & INHERITED;
    let mut header = FrameHeader {
        // Everything about the time is depth's, everything about the view is colour's.
        intrinsics: color.intrinsics,
        pose: color.pose,
        depth_unit_m: unit_m,
        flags: inherited | FrameFlags::DERIVED.0 | if changed { FrameFlags::EPOCH_CHANGED.0 } else { 0 },
        set_id: 0,
        source_sequence: depth.sequence,
        source_color_sequence: color.sequence,
        source_color_capture_time_ns: color.capture_time_ns,
        capture_uncertainty_ns: depth.capture_uncertainty_ns,
        stage_ns,
        ..*depth
    };
    header.set_image(format, color.width, color.height);
    header
}
