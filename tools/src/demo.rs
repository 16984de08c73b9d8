//! The demo: the whole way of a frame once, and a report that a person can judge.

pub mod live;
pub mod replayed;
pub mod report;
pub mod seeded;
pub mod sheet;

use depthrig_bus::StreamId;
use std::collections::BTreeMap;

/// Checksums of depth pictures as they were live, by stream and capture time: what a replay must give back.
pub type Checksums = BTreeMap<(StreamId, i64), u32>;

/// Checksum of a picture (CRC-32, as in PNG).
pub fn checksum(pixels: &[u8]) -> u32 {
    crc32fast::hash(pixels)
}
