//! How a dataset is written.

use serde::{Deserialize, Serialize};

/// How colour images are stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ColorCodec {
    /// JPEG 4:4:4 of `RecorderOptions::jpeg_quality`.
    #[default]
    Jpeg,
    /// Every bit, as `rgb8` in `Zstandard` chunks: quick to read, twice as small as not packed.
    Raw,
    /// Every bit, as PNG: smaller than raw, and every viewer knows it.
    Png,
}

/// How depth images of 16 bit are stored; either way every bit.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DepthCodec {
    /// As `16UC1`, packed as `RecorderOptions::compression` says: opens in every viewer.
    #[default]
    Zstd,
    /// With [`crate::codec`]: takes about half of the space, and needs our decoder, in Rust or in Python.
    Rank,
}

/// How images that are not JPEG are packed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Compression {
    /// Zstandard at level 1: lossless, about a quarter of the size for depth.
    #[default]
    Zstd1,
    /// Not at all.
    None,
}

/// `RecorderOptions::late_after_ns` of a live recording: a fifth of the promised second is left for writing the set or
/// the count.
pub const LIVE_LATE_NS: i64 = 800_000_000;

/// The same for sets this many nanoseconds apart: those rarer than two a second may wait longer for what is computed of
/// them, and a kill then takes at most two of them without a trace.
pub fn live_late_ns(period_ns: i64) -> i64 {
    LIVE_LATE_NS.max(period_ns.saturating_mul(8) / 5)
}

/// How a dataset is written.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct RecorderOptions {
    /// JPEG quality, 1 to 100.
    pub jpeg_quality: u8,
    /// How RGB and BGR images are stored; all others are stored losslessly.
    pub color: ColorCodec,
    /// How depth images of 16 bit are stored.
    pub depth: DepthCodec,
    /// How losslessly stored images are packed.
    pub compression: Compression,
    /// A segment is closed before the set that would begin beyond this size, bytes.
    pub segment_max_bytes: u64,
    /// A segment is closed before the set that begins this long after its first one, nanoseconds.
    pub segment_max_ns: i64,
    /// Threads that encode.
    pub workers: usize,
    /// Sets that may wait to be encoded; their samples in shared memory stay in use meanwhile.
    pub queue_sets: usize,
    /// Encoded bytes that may wait to be written: 256 MiB carry seven cameras over a disk that stalls for 5 s.
    pub backlog_max_bytes: u64,
    /// How often the file is made durable, nanoseconds: the most that a power cut can lose.
    pub sync_interval_ns: i64,
    /// A set that is not in the file this long after its tick, nanoseconds, is given up and counted, and the count is
    /// written at once: a kill can lose only younger sets without a trace. For live recordings, whose ticks are times
    /// of the host's clock ([`LIVE_LATE_NS`]); without it a set waits for as long as encoders and disk take.
    pub late_after_ns: Option<i64>,
    /// The recording ends cleanly when the disk has less than this left, bytes.
    pub min_free_bytes: u64,
    /// Size of a file that is deleted to make room for the index when the disk is full nevertheless, bytes.
    pub reserve_bytes: u64,
}

impl Default for RecorderOptions {
    fn default() -> Self {
        Self {
            jpeg_quality: 95,
            color: ColorCodec::Jpeg,
            depth: DepthCodec::Zstd,
            compression: Compression::Zstd1,
            segment_max_bytes: 1 << 30,
            segment_max_ns: 60_000_000_000,
            workers: std::thread::available_parallelism().map_or(2, |n| n.get().clamp(1, 4)),
            queue_sets: 4,
            backlog_max_bytes: 256 << 20,
            sync_interval_ns: 1_000_000_000,
            late_after_ns: None,
            min_free_bytes: 256 << 20,
            reserve_bytes: 2 << 20,
        }
    }
}
