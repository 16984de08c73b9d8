//! The quality report of a dataset: what was recorded and how well, in one self-contained HTML file.
//!
//! Numbers come from every set; images are sampled evenly over the dataset, and the report says how many. Memory is
//! constant in the length of the dataset except for eight bytes per set. Damage does not end it: it is in the report.

use crate::catalog::Health;
use crate::dataset::Dataset;
use crate::fs::{self, Fs};
use crate::{Edit, Error, Note, Result, StreamAccount};
use core::ops::ControlFlow;
use serde::Serialize;
use std::collections::BTreeMap;
use std::ffi::OsString;
use std::path::{Path, PathBuf};

mod account;
pub mod curves;
mod gather;
mod html;
mod markup;
pub mod page;
mod pixels;
mod series;
mod svg;
mod verdict;

pub use account::SetsAccount;
pub use series::{Quantiles, Range, TimeBins};

/// The name of the report in a dataset's folder.
pub const REPORT_FILE: &str = "report.html";

/// Options of a report.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ReportOptions {
    /// Sets whose depth images are decoded for the fill rate, evenly over the dataset.
    pub fill_sets: usize,
    /// Frames of a set should not lie further apart than this, nanoseconds; `None`: what the session says, and
    /// where that says nothing half a period of the slowest camera, within which a nearest frame always lies.
    pub max_spread_ns: Option<i64>,
}

impl Default for ReportOptions {
    fn default() -> Self {
        Self { fill_sets: 48, max_spread_ns: None }
    }
}

/// Called with the progress in thousandths; returns whether to go on.
pub type OnProgress<'a> = &'a mut dyn FnMut(u64) -> ControlFlow<()>;

/// The quality of a dataset. Series are `null` where nothing is known.
#[derive(Debug, Clone, Serialize)]
#[non_exhaustive]
pub struct Report {
    /// The dataset.
    pub path: PathBuf,
    /// The session's name.
    pub name: String,
    /// The rig's name.
    pub rig: String,
    /// The scene in front of the cameras.
    pub scene: String,
    /// Who recorded it.
    pub operator: String,
    /// The computer's name.
    pub host: String,
    /// The version of depthrig that recorded it.
    pub depthrig_version: String,
    /// When the recording began, UTC nanoseconds since 1970.
    pub started_utc_ns: i64,
    /// Notes of the operator.
    pub notes: Vec<Note>,
    /// Demonstrations within it.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub episodes: Vec<crate::Episode>,
    /// Changes after the recording.
    pub history: Vec<Edit>,
    /// Streams that no camera gave, with what computed them.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub computed: Vec<crate::Computed>,
    /// The verdict on it.
    pub verdict: Verdict,
    /// Its sets.
    pub sets: SetsReport,
    /// The time bins of the series below.
    pub bins: TimeBins,
    /// Its streams.
    pub streams: Vec<StreamReport>,
    /// Its IMUs.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub motion: Vec<MotionReport>,
    /// Its signals.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub signals: Vec<SignalReport>,
    /// The two clocks of the host.
    pub host_clock: HostClock,
    /// Bytes of its segments.
    pub bytes: u64,
    /// Its segments.
    pub segments: usize,
    /// Segments that were not finished, by file name.
    pub unfinished: Vec<String>,
    /// Parts that could not be read: the first [`PROBLEMS_MAX`].
    pub problems: Vec<String>,
    /// How much could not be read.
    pub problem_count: u64,
    /// Images checked.
    pub sampled: Sampled,
    /// First, middle and last set; not in JSON.
    #[serde(skip)]
    images: Vec<SetImages>,
}

/// Problems that a report names; the rest is counted.
pub const PROBLEMS_MAX: usize = 20;

/// Restarts and steps listed with their time, at most.
const LISTED_MAX: usize = 32;

/// The verdict on a dataset.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Verdict {
    /// Its health.
    pub health: Health,
    /// The same in a sentence.
    pub headline: String,
    /// The reasons, and what to do.
    pub why: Vec<String>,
    /// Facts worth knowing that are not defects of the dataset.
    pub remarks: Vec<String>,
}

/// The sets of a dataset.
#[derive(Debug, Clone, Serialize)]
#[non_exhaustive]
pub struct SetsReport {
    /// Sets that are there.
    pub count: u64,
    /// Of those, sets that lack a frame of some stream.
    pub incomplete: u64,
    /// From the first to the last, nanoseconds.
    pub duration_ns: i64,
    /// Time from set to set, nanoseconds.
    pub interval_ns: Quantiles,
    /// Sets handed over, recorded and dropped by reason: by the last account in the file, or by the session's
    /// outcome where that counts more.
    pub counts: Option<SetsAccount>,
    /// Sets per second over time.
    pub per_second: Vec<Option<f64>>,
    /// Latest minus earliest capture time of a set, nanoseconds.
    pub spread_ns: Quantiles,
    /// Histogram of the spreads.
    pub spread_histogram: LinearHistogram,
    /// Limit of the spread, nanoseconds.
    pub spread_limit_ns: Option<i64>,
    /// Sets beyond that.
    pub beyond_limit: u64,
}

/// Counts in bins of equal width from 0.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize)]
pub struct LinearHistogram {
    /// Width of a bin, nanoseconds.
    pub width_ns: i64,
    /// Values in each.
    pub counts: Vec<u64>,
    /// Values beyond the last.
    pub beyond: u64,
}

/// One stream of a dataset.
#[derive(Debug, Clone, Serialize)]
#[non_exhaustive]
pub struct StreamReport {
    /// Its entry in the session.
    #[serde(flatten)]
    pub record: crate::StreamRecord,
    /// How pixels are stored; empty without frames.
    pub codec: &'static str,
    /// Frames in the dataset.
    pub frames: u64,
    /// Sets without a frame of it.
    pub missing: u64,
    /// Bytes of its images before the chunks are packed.
    pub bytes: u64,
    /// Bytes of the chunks that hold its images, as they lie in the file.
    pub packed_bytes: u64,
    /// Whether chunks of it are packed by zstd.
    pub is_packed: bool,
    /// Bytes that its pixels have on the channel.
    pub raw_bytes: u64,
    /// Frames per second on its channel between its first and its last recorded frame.
    pub live_hz: f64,
    /// The same over time.
    pub live_hz_series: Vec<Option<f64>>,
    /// Sets without a frame of it, over time.
    pub missing_series: Vec<u64>,
    /// Frames lost before its channel, over time.
    pub dropped_series: Vec<u64>,
    /// `captured = delivered + Σ dropped` over the recording, from the last account in the file.
    pub account: Option<StreamAccount>,
    /// Time of its first frame since the first set, nanoseconds.
    pub first_ns: Option<i64>,
    /// Time of its last frame since the first set, nanoseconds.
    pub last_ns: Option<i64>,
    /// When it was missing first and last, since the first set, nanoseconds.
    pub missing_ns: Option<(i64, i64)>,
    /// Its capture clock.
    pub clock: ClockReport,
    /// How much of its images has depth; `None` for a stream without depth, or if no image was checked.
    pub fill: Option<Fill>,
}

/// One IMU of a dataset.
#[derive(Debug, Clone, Serialize)]
#[non_exhaustive]
pub struct MotionReport {
    /// Its entry in the session.
    #[serde(flatten)]
    pub record: crate::MotionRecord,
    /// Batches in the dataset.
    pub batches: u64,
    /// Batches between the first and the last that are not in it.
    pub lost_batches: u64,
    /// Samples in the dataset.
    pub samples: u64,
    /// Samples between those that the device never gave.
    pub never_given: u64,
    /// Samples per second between the first and the last.
    pub samples_hz: f64,
    /// Magnitude of the angular velocity over time, rad/s.
    pub rotation_series: Vec<Option<Range>>,
    /// Magnitude of the acceleration over time, m/s².
    pub acceleration_series: Vec<Option<Range>>,
    /// `captured = delivered + Σ dropped` of its batches over the recording, from the last account in the file.
    pub account: Option<StreamAccount>,
}

/// One signal of a dataset.
#[derive(Debug, Clone, Serialize)]
#[non_exhaustive]
pub struct SignalReport {
    /// `device/signal`.
    pub id: depthrig_bus::StreamId,
    /// `fields`, `joints` or `pose`.
    pub kind: &'static str,
    /// Unit of the first field.
    pub unit: String,
    /// Samples in the dataset.
    pub samples: u64,
    /// Samples between the first and the last that are not in it.
    pub lost: u64,
    /// Number of times that another publisher took over.
    pub restarts: u64,
    /// Samples per second between the first and the last.
    pub samples_hz: f64,
    /// Losses and pauses in words.
    pub remarks: Vec<String>,
    /// The values of the first elements over time; none of a text.
    pub fields: Vec<FieldSeries>,
    /// `captured = delivered + Σ dropped` of its samples over the recording, from the last account in the file.
    pub account: Option<StreamAccount>,
}

/// The values of one element of a signal.
#[derive(Debug, Clone, Serialize)]
pub struct FieldSeries {
    /// Its field, with the place in it if the field has several.
    pub name: String,
    /// Over time, in the field's unit.
    pub series: Vec<Option<Range>>,
}

/// The capture clock of a stream.
#[derive(Debug, Clone, Serialize)]
pub struct ClockReport {
    /// Where capture times come from: `device`, `kernel` or `arrival`; empty without frames.
    pub domain: &'static str,
    /// Arrival minus capture time, nanoseconds: exposure, read-out and transport, and what the clock map missed.
    pub lag_ns: Quantiles,
    /// The same over time, nanoseconds.
    pub lag_series: Vec<Option<Range>>,
    /// Stated uncertainty of the capture times, nanoseconds.
    pub uncertainty_ns: Quantiles,
    /// Frames flagged `time_uncertain`.
    pub uncertain_frames: u64,
    /// Times at which the clock map was restarted, since the first set, nanoseconds: the first 32.
    pub restarts_ns: Vec<i64>,
    /// How often it was restarted.
    pub restarts: u64,
}

/// How much of the depth images has depth.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Fill {
    /// Time since the first set in nanoseconds, and share of the pixels that have a depth, 0 to 1.
    pub samples: Vec<(i64, f64)>,
    /// Least.
    pub min: f64,
    /// Mean.
    pub mean: f64,
    /// Greatest.
    pub max: f64,
}

/// The host's wall clock against its monotonic one.
#[derive(Debug, Clone, Default, Serialize)]
pub struct HostClock {
    /// Readings of both clocks.
    pub pairs: u64,
    /// The two were read within this at worst, nanoseconds.
    pub width_ns: i64,
    /// Change of the difference from the first reading to the last, nanoseconds; steps included.
    pub change_ns: i64,
    /// The same without steps, parts per million of the time.
    pub drift_ppm: f64,
    /// The change over time, nanoseconds.
    pub series: Vec<Option<Range>>,
    /// Changes that no slewing explains: time since the first set and size, nanoseconds; the first 32.
    pub steps: Vec<(i64, i64)>,
}

/// The number of images checked.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
pub struct Sampled {
    /// Sets whose depth images were decoded.
    pub sets: usize,
    /// Images that were decoded, those shown included.
    pub images: usize,
}

/// The images of a set, by stream.
#[derive(Debug, Clone)]
struct SetImages {
    /// `first`, `middle` or `last`.
    title: &'static str,
    number: usize,
    /// Since the first set, nanoseconds.
    at_ns: i64,
    images: BTreeMap<usize, Shown>,
}

/// A small image as the report embeds it.
#[derive(Debug, Clone)]
struct Shown {
    data_uri: String,
    width: u32,
    height: u32,
    /// Range of the colours of depth, metres.
    range_m: Option<(f32, f32)>,
}

impl Report {
    /// Looks at `dataset`; `None` when `progress` asked to stop.
    ///
    /// # Errors
    /// When the disk cannot be read. Damage is in the report, not an error.
    pub fn of(dataset: &Dataset, options: &ReportOptions, progress: OnProgress<'_>) -> Result<Option<Self>> {
        gather::gather(dataset, options, progress)
    }

    /// The report as HTML that needs no script, no network and no other file. It is well-formed XML as well.
    pub fn to_html(&self) -> String {
        html::page(self)
    }

    /// Writes the HTML to `path`, replacing an existing file in one step.
    ///
    /// # Errors
    /// The error of the file system.
    pub fn write(&self, fs: &dyn Fs, path: &Path) -> Result<()> {
        let tmp = temporary(path);
        fs::replace_by(fs, &tmp, path, self.to_html().as_bytes()).map_err(|e| {
            // Nobody would find a hidden file. If removing it fails, the next report does it.
            let _ = fs.remove_file(&tmp);
            Error::io("write", path, e)
        })
    }
}

/// The name of `path` while it is written. It may lie among files of others; a hidden name that contains all of the
/// final one does not collide with theirs.
fn temporary(path: &Path) -> PathBuf {
    let mut name = OsString::from(".");
    name.push(path.file_name().unwrap_or_default());
    name.push(".tmp");
    path.with_file_name(name)
}
