//! The demo: the full pipeline once, and a report to judge it by.

pub mod live;
pub mod replayed;
pub mod report;
pub mod seeded;
pub mod sheet;

use depthrig_bus::StreamId;
use std::collections::BTreeMap;

/// Checksums of depth images as they were live, by stream and capture time: which a replay must reproduce.
pub type Checksums = BTreeMap<(StreamId, i64), u32>;

/// Returns whether a stream is depth that a camera measured, neither derived from it nor the ground truth of a
/// simulation.
pub fn is_depth(stream: &str) -> bool {
    const COMPUTED: [&str; 4] = ["depth_refined", "depth_aligned", "depth_true", "depth_true_color"];
    stream == "depth" || (stream.starts_with("depth_") && !COMPUTED.contains(&stream))
}

/// Names the depth mode of a stream: the camera, and the mode if it has several.
pub fn mode_name(camera: &str, stream: &str) -> String {
    stream.strip_prefix("depth_").map_or_else(|| camera.to_owned(), |mode| format!("{camera} {mode}"))
}

/// Checksum of an image (CRC-32, as in PNG).
pub fn checksum(pixels: &[u8]) -> u32 {
    crc32fast::hash(pixels)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn depth_modes_are_told_from_what_is_made_of_them() {
        for stream in ["depth", "depth_performance", "depth_neural"] {
            assert!(is_depth(stream), "{stream}");
        }
        for stream in ["color", "depth_refined", "depth_true", "confidence_quality", "depthless", "left"] {
            assert!(!is_depth(stream), "{stream}");
        }
        assert_eq!(mode_name("d435", "depth"), "d435");
        assert_eq!(mode_name("zed2i", "depth_ultra"), "zed2i ultra");
    }
}
