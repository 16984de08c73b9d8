//! Datasets: writing, reading and verifying them. `docs/dataset-format.md` is the format; this crate opens no
//! camera and knows no bus channel, it is handed frames.
//!
//! A dataset is a folder: `session.toml` and MCAP segments of profile `ros2`. Start at [`Recorder`] (write),
//! [`Dataset`] (read) and [`verify`] (prove).
//!
//! ```text
//! push ──▶ encode workers (JPEG, zstd) ──▶ one writer thread ──▶ seg_0000.mcap.part ──▶ seg_0000.mcap
//!  │ never blocks; a refused set is counted       │ owns the file; sets in order; sync each second
//! ```
//!
//! A set is written as one chunk per image and then one chunk with all that describes them, which ends in
//! the set's commit mark (`FrameSet`). A set without its mark does not count, so no crash leaves half a set.
#![cfg_attr(test, allow(clippy::unwrap_used, clippy::expect_used))]

pub mod bench;
mod cat;
mod catalog;
mod cdr;
mod clock;
pub mod codec;
mod compare;
mod container;
mod dataset;
mod encode;
mod error;
mod frame;
pub mod fs;
#[cfg(any(test, feature = "testing"))]
pub mod fuzzing;
mod live;
mod msgs;
pub mod npy;
mod options;
mod outside;
pub mod preview;
mod prune;
mod recalibrate;
mod recorder;
mod recover;
mod recovered;
pub mod report;
mod select;
mod session;
mod slice;
pub mod still;
#[cfg(any(test, feature = "testing"))]
pub mod testing;
pub mod transit;
pub mod trigger;
mod verify;

pub use cat::{
    FRAMES_FILE, FrameChoice, FrameRow, FramesDone, MotionRow, SampleForm, SampleRow, SetChoice, SignalRow,
    export_frames, export_samples, list_frames, list_samples, sampled,
};
pub use catalog::{CatalogEntry, Health, catalog, look_at};
pub use clock::utc_text;
pub use compare::{
    CompareOptions, CompareProgress, Comparison, Difference, FieldCount, PixelCheck, PixelDifference,
    compare, compare_with,
};
pub use dataset::{
    AttachedCalibration, Dataset, DatasetFrame, DatasetInfo, DatasetSet, MotionInfo, PixelFilter, PixelMode,
    SetRange, SetReader, Sets, SignalInfo, SpreadStats, StreamInfo, jpeg_pixels, segment_number,
};
pub use error::{Error, ErrorKind, Result};
pub use frame::{
    IMAGE_MAX_BYTES, Pixels, PushError, ReadPixels, RecordFrame, RecordMotion, RecordSet, RecordSignal,
    SET_MOTION_MAX_BYTES, SET_SIGNALS_MAX_BYTES, SetDrop, StoredImage,
};
pub use live::{LiveChannel, LiveEncoder, LiveFrame, LiveSource, LiveTopics};
pub use msgs::{Diagnostic, Level, SetCounts, StreamAccount};
pub use options::{ColorCodec, Compression, DepthCodec, LIVE_LATE_NS, RecorderOptions, live_late_ns};
pub use outside::check_outside;
pub use prune::{Prunable, PruneProgress, Pruned, prunable, prune};
pub use recalibrate::{Recalibrated, Recalibration, recalibrate};
pub use recorder::{DiskStatus, Progress, Recorder, Resumed, Summary, UtcSource};
pub use recover::{
    LostBytes, RecoverAction, RecoverOptions, RecoverProgress, RecoverReport, RecoveredSegment, recover,
    recover_with, unfinished_in,
};
pub use select::{Edge, Moment, SetSpan};
pub use session::{
    Computed, Derived, Edit, Episode, EpisodeCounts, EpisodeEnd, EpisodeOutcome, FORMAT, Mark, MotionRecord,
    NOTE_MAX_BYTES, Note, Outcome, RemovedSets, SESSION_FILE, Session, SessionChanges, SignalRecord,
    StreamCalibration, StreamRecord, UnitCalibration, adopt, check_name, edit, rename,
};
pub use slice::{SliceOptions, SliceProgress, SliceReport, merge, trim};
pub use still::{StillFormat, still};
pub use verify::{
    Finding, Severity, VerifyOptions, VerifyProgress, VerifyReport, verify, verify_watched, verify_with,
};
