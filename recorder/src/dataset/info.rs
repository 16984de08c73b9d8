//! Content of a dataset, without reading an image.

use super::removed::{Crossing, Removed};
use super::{Dataset, PixelMode, SetRange, SignalCount};
use crate::container::scan::{ChunkEntry, SegmentReader};
use crate::msgs::accounts;
use crate::msgs::schemas::Schema;
use crate::session::calibration_date;
use crate::{
    Computed, Edit, ErrorKind, MotionRecord, RecordMotion, Result, SetCounts, SignalRecord, StreamAccount,
    StreamRecord,
};
use depthrig_bus::FrameFlags;
use serde::Serialize;
use std::path::PathBuf;

/// Content of a dataset.
#[derive(Debug, Clone, Serialize)]
#[non_exhaustive]
pub struct DatasetInfo {
    /// Where it is.
    pub path: PathBuf,
    /// The session's name.
    pub name: String,
    /// The rig's name.
    pub rig: String,
    /// The scene in front of the cameras.
    pub scene: String,
    /// Who recorded it.
    pub operator: String,
    /// Demonstrations within it.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub episodes: Vec<crate::Episode>,
    /// When it began, UTC nanoseconds since 1970.
    pub started_utc_ns: i64,
    /// Time from the first set to the last, nanoseconds.
    pub duration_ns: i64,
    /// Sets in it.
    pub sets: u64,
    /// Sets that lack a frame of some stream.
    pub incomplete_sets: u64,
    /// Bytes of its segments.
    pub bytes: u64,
    /// Its segments.
    pub segments: u32,
    /// Segments that were not finished, by file name.
    pub unfinished: Vec<String>,
    /// Parts that could not be read.
    pub problems: Vec<String>,
    /// Latest minus earliest capture time over the sets.
    pub spread: SpreadStats,
    /// Per stream.
    pub streams: Vec<StreamInfo>,
    /// Per IMU.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub motion: Vec<MotionInfo>,
    /// Per signal.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub signals: Vec<SignalInfo>,
    /// Streams that no camera gave, with what computed them.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub computed: Vec<Computed>,
    /// The calibration of the mount that its poses come from; `None` without one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub calibration: Option<AttachedCalibration>,
    /// Changes after the recording, oldest first.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub history: Vec<Edit>,
    /// The last account of the sets in the file.
    pub set_counts: Option<SetCounts>,
    /// The last account of each stream in the file.
    pub accounts: Vec<StreamAccount>,
}

/// A calibration of the mount, as a dataset carries it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[non_exhaustive]
pub struct AttachedCalibration {
    /// When it was made, as its file says.
    pub created: String,
    /// When it was attached to the dataset, UTC nanoseconds since 1970; `None` if the rig had it when it recorded.
    pub attached_utc_ns: Option<i64>,
    /// The date of the one before; `None` if it is the first.
    pub before: Option<String>,
}

impl AttachedCalibration {
    fn of(session: &crate::Session) -> Option<Self> {
        let created = calibration_date(&session.calibration)?.to_owned();
        let edit = session.history.iter().rev().find(|e| e.field == "calibration");
        Some(Self {
            created,
            attached_utc_ns: edit.map(|e| e.utc_ns),
            before: edit.and_then(|e| calibration_date(&e.before)).map(str::to_owned),
        })
    }
}

/// How far apart the frames of a set are, nanoseconds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
pub struct SpreadStats {
    /// Half of the sets are within.
    pub p50_ns: i64,
    /// 95 % of the sets are within.
    pub p95_ns: i64,
    /// All sets are within.
    pub max_ns: i64,
}

impl SpreadStats {
    fn of(mut spreads: Vec<i64>) -> Self {
        spreads.sort_unstable();
        // Nearest rank: the smallest value that at least this share does not exceed.
        let rank = |percent: usize| spreads.len().saturating_mul(percent).div_ceil(100).saturating_sub(1);
        let at = |percent| spreads.get(rank(percent)).copied().unwrap_or(0);
        Self { p50_ns: at(50), p95_ns: at(95), max_ns: at(100) }
    }
}

/// One stream of a dataset.
#[derive(Debug, Clone, Serialize)]
#[non_exhaustive]
pub struct StreamInfo {
    /// `camera/stream`.
    pub stream: String,
    /// Camera model.
    pub model: String,
    /// Where its calibration comes from.
    pub calibration: String,
    /// Pixel format on the channel.
    pub format: &'static str,
    /// Pixels per row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// How pixels are stored; empty without a frame.
    pub codec: &'static str,
    /// Metres per unit of depth; 0 without depth.
    pub depth_unit_m: f64,
    /// Frames in the dataset.
    pub frames: u64,
    /// Sets without a frame of this stream.
    pub missing: u64,
    /// Bytes of its images before the chunks are packed.
    pub bytes: u64,
    /// Bytes of the chunks that hold its images, as they lie in the file.
    pub packed_bytes: u64,
    /// Whether chunks of it are packed by zstd.
    pub is_packed: bool,
    /// Bytes that its pixels have on the channel.
    pub raw_bytes: u64,
    /// Frames per second between its first and its last frame, by capture time.
    pub rate_hz: f64,
}

/// One IMU of a dataset.
#[derive(Debug, Clone, Serialize)]
#[non_exhaustive]
pub struct MotionInfo {
    /// `camera/stream`.
    pub unit: String,
    /// Camera model.
    pub model: String,
    /// Batches in the dataset.
    pub batches: u64,
    /// Batches between the first and the last that are not in it.
    pub lost_batches: u64,
    /// Samples in the dataset.
    pub samples: u64,
    /// Samples per second between the first and the last, by their times.
    pub rate_hz: f64,
}

/// One signal of a dataset.
#[derive(Debug, Clone, Serialize)]
#[non_exhaustive]
pub struct SignalInfo {
    /// `device/signal`.
    pub signal: String,
    /// `fields`, `joints` or `pose`.
    pub kind: &'static str,
    /// Names of its fields.
    pub fields: Vec<String>,
    /// Samples in the dataset.
    pub samples: u64,
    /// Samples between the first and the last that are not in it.
    pub lost: u64,
    /// Number of times that another publisher took over.
    pub restarts: u64,
    /// Samples per second between the first and the last, by their times.
    pub rate_hz: f64,
}

/// Counts of an IMU while its batches are read.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct MotionCount {
    /// Batches that passed.
    pub(crate) batches: u64,
    /// Batches that are missing between those, without those of removed sets.
    pub(crate) lost_batches: u64,
    /// Samples that passed.
    pub(crate) samples: u64,
    /// Samples that are missing between those and were not lost with a batch: the device never gave them.
    pub(crate) never_given: u64,
    last_batch: Option<(u64, [u64; 8])>,
    last_sample: Option<u64>,
    times: Option<(i64, i64)>,
    crossing: Crossing,
}

impl MotionCount {
    /// Takes a batch of a set by the set's log time.
    pub(crate) fn take(&mut self, batch: &RecordMotion, set_utc_ns: i64, removed: &Removed) {
        let crosses = self.crossing.take(set_utc_ns, removed);
        let sequence = batch.header.sequence;
        let skipped = self.last_batch.map_or(0, |(last, _)| sequence.saturating_sub(last.saturating_add(1)));
        if !crosses {
            self.lost_batches = self.lost_batches.saturating_add(skipped);
        }
        // A recorded replay may begin again at any batch.
        let replayed = batch.header.flags & FrameFlags::REPLAYED.0 != 0;
        let mut kept = skipped == 0
            && !crosses
            && !replayed
            && self.last_batch.is_none_or(|(_, dropped)| dropped == batch.header.dropped);
        self.last_batch = Some((sequence, batch.header.dropped));
        for sample in &batch.samples {
            let before = self.last_sample.replace(sample.sequence);
            let gap = before.map_or(0, |before| sample.sequence.saturating_sub(before.saturating_add(1)));
            self.never_given = self.never_given.saturating_add(if kept { gap } else { 0 });
            // Within a batch nothing else is lost.
            kept = true;
        }
        self.batches += 1;
        self.samples += batch.samples.len() as u64;
        if let (Some(first), Some(last)) = (batch.samples.first(), batch.samples.last()) {
            let (began, before) = self.times.unwrap_or((first.time_ns, 0));
            if crosses {
                self.crossing.pass(before, first.time_ns);
            }
            self.times = Some((began, last.time_ns));
        }
    }

    /// Samples per second, 0 without two.
    pub(crate) fn rate_hz(&self) -> f64 {
        let span = self.times.map_or(0, |(first, last)| last.saturating_sub(first));
        self.crossing.rate_hz(self.samples, span)
    }
}

impl StreamInfo {
    /// Of a stream of which nothing was read yet.
    fn new(s: &StreamRecord) -> Self {
        Self {
            stream: s.id.to_string(),
            model: s.model.clone(),
            calibration: s.calibration.clone(),
            format: s.format.name(),
            width: s.width,
            height: s.height,
            codec: "",
            depth_unit_m: s.depth_unit_m,
            frames: 0,
            missing: 0,
            bytes: 0,
            packed_bytes: 0,
            is_packed: false,
            raw_bytes: 0,
            rate_hz: 0.0,
        }
    }
}

impl MotionInfo {
    fn new(unit: &MotionRecord, count: &MotionCount) -> Self {
        Self {
            unit: unit.id.to_string(),
            model: unit.model.clone(),
            batches: count.batches,
            lost_batches: count.lost_batches,
            samples: count.samples,
            rate_hz: count.rate_hz(),
        }
    }
}

impl SignalInfo {
    fn new(signal: &SignalRecord, count: &SignalCount) -> Self {
        let description = &signal.description;
        Self {
            signal: signal.id.to_string(),
            kind: description.kind().name(),
            fields: description.all_fields().iter().map(|f| f.name.clone()).collect(),
            samples: count.samples,
            lost: count.lost,
            restarts: count.restarts,
            rate_hz: count.rate_hz(),
        }
    }
}

/// The session's part, before anything is counted.
fn uncounted(dataset: &Dataset) -> DatasetInfo {
    let session = dataset.session();
    DatasetInfo {
        path: dataset.path().to_owned(),
        name: session.name.clone(),
        rig: session.rig.clone(),
        scene: session.scene.clone(),
        operator: session.operator.clone(),
        episodes: session.episodes.clone(),
        started_utc_ns: session.started_utc_ns,
        duration_ns: 0,
        sets: 0,
        incomplete_sets: 0,
        bytes: 0,
        segments: dataset.segments().len() as u32,
        unfinished: Vec::new(),
        problems: Vec::new(),
        spread: SpreadStats::default(),
        streams: session.streams.iter().map(StreamInfo::new).collect(),
        motion: Vec::new(),
        signals: Vec::new(),
        computed: session.computed.clone(),
        calibration: AttachedCalibration::of(session),
        history: session.history.clone(),
        set_counts: None,
        accounts: Vec::new(),
    }
}

pub(super) fn gather(dataset: &Dataset) -> Result<DatasetInfo> {
    let session = dataset.session();
    let mut info = uncounted(dataset);
    let mut spreads = Vec::new();
    let mut ticks = None;
    let mut units = vec![MotionCount::default(); session.motion.len()];
    let mut signals = vec![SignalCount::default(); session.signals.len()];
    let removed = Removed::of(session);
    let mut captures = vec![None; info.streams.len()];
    for set in dataset.sets_with(SetRange::ALL, PixelMode::None) {
        let set = match set {
            Ok(set) => set,
            Err(e) if e.kind() == ErrorKind::Io => return Err(e),
            Err(e) => {
                info.problems.push(e.to_string());
                continue;
            }
        };
        info.sets += 1;
        info.incomplete_sets += u64::from(!set.missing.is_empty());
        spreads.push(set.spread_ns);
        let (first, _) = ticks.unwrap_or((set.tick, set.tick));
        ticks = Some((first, set.tick));
        for batch in &set.motion {
            units[batch.unit].take(batch, set.utc_ns, &removed);
        }
        for part in &set.signals {
            signals[part.signal].take(&part.samples, set.utc_ns, &removed);
        }
        for s in set.missing {
            info.streams[s].missing += 1;
        }
        for f in set.frames {
            let s = &mut info.streams[f.stream];
            s.frames += 1;
            s.bytes = s.bytes.saturating_add(f.stored_bytes);
            s.raw_bytes += u64::from(f.header.payload_len);
            s.codec = f.codec;
            let t = f.header.capture_time_ns;
            let (first, _) = captures[f.stream].unwrap_or((t, t));
            captures[f.stream] = Some((first, t));
        }
    }
    for (s, times) in info.streams.iter_mut().zip(captures) {
        let span = times.map_or(0, |(first, last)| last.saturating_sub(first));
        if span > 0 {
            s.rate_hz = (s.frames - 1) as f64 * 1e9 / span as f64;
        }
    }
    info.motion = session.motion.iter().zip(&units).map(|(u, count)| MotionInfo::new(u, count)).collect();
    info.signals = session.signals.iter().zip(&signals).map(|(s, count)| SignalInfo::new(s, count)).collect();
    info.spread = SpreadStats::of(spreads);
    info.duration_ns = ticks.map_or(0, |(first, last)| last.since_ns(first));
    for i in 0..dataset.segments().len() {
        // A segment that cannot be opened is among the problems already.
        let Some(Ok(reader)) = dataset.open_segment(i) else { continue };
        info.bytes += reader.size;
        if !reader.finished {
            let name = reader.path.file_name().map(|n| n.to_string_lossy().into_owned());
            info.unfinished.extend(name);
        }
        add_packed(&mut info, &reader);
        let channel = reader.channels.iter().find(|(_, c)| c.schema == Schema::Accounts.name());
        let Some((channel, _)) = channel else { continue };
        let last = reader.chunks.iter().rev().find(|c| c.channels.contains(channel));
        let Some(entry) = last else { continue };
        let read = reader.messages(entry, |m| {
            if m.channel == *channel {
                let (sets, streams) = accounts::read(m.data)?;
                (info.set_counts, info.accounts) = (Some(sets), streams);
            }
            Ok(())
        });
        if let Err(e) = read {
            info.problems.push(e.to_string());
        }
    }
    info.problems.extend(crate::recalibrate::not_recalibrated(dataset));
    Ok(info)
}

/// Adds what the chunks of a segment take that hold images alone.
fn add_packed(info: &mut DatasetInfo, reader: &SegmentReader) {
    for (stream, chunk) in image_chunks(reader) {
        let Some(stream) = info.streams.iter_mut().find(|s| s.stream == stream) else { continue };
        stream.packed_bytes = stream.packed_bytes.saturating_add(chunk.length);
        stream.is_packed |= chunk.is_packed;
    }
}

/// The chunks of a segment that hold images of one stream alone, each with that stream.
pub(crate) fn image_chunks(reader: &SegmentReader) -> impl Iterator<Item = (&str, &ChunkEntry)> {
    reader.chunks.iter().filter_map(|chunk| {
        let [channel] = chunk.channels[..] else { return None };
        let channel = reader.channels.get(&channel)?;
        let is_image = Schema::IMAGES.iter().any(|s| channel.schema == s.name());
        let stream = channel.metadata.get("stream").filter(|_| is_image)?;
        Some((stream.as_str(), chunk))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn percentiles_are_nearest_rank() {
        let s = SpreadStats::of((1..=100).rev().collect());
        assert_eq!((s.p50_ns, s.p95_ns, s.max_ns), (50, 95, 100));
        let s = SpreadStats::of(vec![7]);
        assert_eq!((s.p50_ns, s.p95_ns, s.max_ns), (7, 7, 7));
        assert_eq!(SpreadStats::of(Vec::new()), SpreadStats::default());
    }
}
