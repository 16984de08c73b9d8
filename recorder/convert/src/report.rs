//! `export.json`: what was exported, and what was lost on the way.

use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::collections::BTreeMap;

/// The report in the folder of an export; it is there once the export is complete.
pub const REPORT_FILE: &str = "export.json";
/// Problems that are listed one by one; all are counted.
pub(super) const MAX_PROBLEMS: usize = 100;

/// Report of an export. It holds no time and no path, so that the same export gives the same report.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[non_exhaustive]
pub struct ExportReport {
    /// The layout, by its name.
    pub format: String,
    /// The version of depthrig that wrote it.
    pub depthrig_version: String,
    /// The options that decide what is written.
    pub options: Value,
    /// The exported datasets.
    pub datasets: Vec<DatasetIdentity>,
    /// Frames exported and missing, by stream.
    pub streams: Vec<StreamCount>,
    /// Sets in the export.
    pub sets: u64,
    /// Frames in the export.
    pub frames: u64,
    /// Files beside this one.
    pub files: u64,
    /// Their bytes.
    pub bytes: u64,
    /// Changes and omissions by the layout or the options, known before anything was written.
    pub losses: Vec<String>,
    /// How often something was counted, such as pixels that were rounded.
    pub counters: BTreeMap<String, u64>,
    /// Sets and frames of the datasets that could not be exported.
    pub lost: u64,
    /// The first of them, in words.
    pub problems: Vec<String>,
    /// Whether it was ended from outside before all was done; such a report is in no file.
    #[serde(skip)]
    pub ended: bool,
    /// Parts that an earlier run had done.
    #[serde(skip)]
    pub parts_resumed: u64,
    /// Parts of the whole work.
    #[serde(skip)]
    pub parts: u64,
}

/// Identity of a dataset.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[non_exhaustive]
pub struct DatasetIdentity {
    /// Name of the session.
    pub name: String,
    /// Name of the rig.
    pub rig: String,
    /// The scene in front of the cameras.
    pub scene: String,
    /// When the recording began, UTC nanoseconds since 1970.
    pub started_utc_ns: i64,
    /// Log time of the first set.
    pub first_set_utc_ns: Option<i64>,
    /// Log time of the last set.
    pub last_set_utc_ns: Option<i64>,
    /// Sets that its indexes name.
    pub sets: u64,
    /// CRC-32 of the session as text.
    pub session_crc32: u32,
    /// Its segments.
    pub segments: Vec<SegmentIdentity>,
}

/// A segment by name and size.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct SegmentIdentity {
    /// Name of the file.
    pub name: String,
    /// Bytes.
    pub bytes: u64,
}

/// Frames of a stream, exported and missing.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct StreamCount {
    /// Name of the session.
    pub dataset: String,
    /// `camera/stream`.
    pub stream: String,
    /// Frames in the export.
    pub frames: u64,
    /// Sets in which the dataset has no frame of it.
    pub missing: u64,
}

/// Result of a part; kept beside the files until the export is complete.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[non_exhaustive]
pub struct PartRecord {
    /// Sets exported.
    pub sets: u64,
    /// Frames exported, by the index of the stream.
    pub frames: Vec<u64>,
    /// Sets without a frame, by the index of the stream.
    pub missing: Vec<u64>,
    /// Files written.
    pub files: u64,
    /// Their bytes.
    pub bytes: u64,
    /// As [`ExportReport::counters`].
    pub counters: BTreeMap<String, u64>,
    /// As [`ExportReport::lost`].
    pub lost: u64,
    /// As [`ExportReport::problems`].
    pub problems: Vec<String>,
    /// The exporter's value for [`super::Exporter::finish`].
    pub extra: Value,
}

impl PartRecord {
    pub(super) fn lose(&mut self, problem: String) {
        self.lost += 1;
        if self.problems.len() < MAX_PROBLEMS {
            self.problems.push(problem);
        }
    }
}

impl ExportReport {
    pub(super) fn add(&mut self, part: &PartRecord) {
        self.sets += part.sets;
        self.files += part.files;
        self.bytes += part.bytes;
        self.frames += part.frames.iter().sum::<u64>();
        for (name, n) in &part.counters {
            *self.counters.entry(name.clone()).or_default() += n;
        }
        self.lost += part.lost;
        let room = MAX_PROBLEMS.saturating_sub(self.problems.len());
        self.problems.extend(part.problems.iter().take(room).cloned());
    }
}
