//! `session.toml`: who recorded what with which rig, and how it was calibrated.
//!
//! More than 500 lines, because the file is one table whose parts are checked against each other.

use crate::fs::{self, Fs};
use crate::{Error, ErrorKind, RecordMotion, Result, SET_MOTION_MAX_BYTES, SetCounts};
use depthrig_bus::{Distortion, Intrinsics, Name, PixelFormat, Pose, StreamId};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::Path;

mod edit;
mod episode;
mod limits;
mod signal;

pub(crate) use edit::SessionText;
pub use edit::{SessionChanges, StreamCalibration, UnitCalibration, adopt, check_name, edit, rename};
pub use episode::{Episode, EpisodeCounts, EpisodeEnd, EpisodeOutcome};
pub use signal::SignalRecord;

/// The value of `Session::format` that this version writes and reads.
pub const FORMAT: &str = "depthrig.dataset/1";
/// The name of the session file in a dataset.
pub const SESSION_FILE: &str = "session.toml";
/// Its name while it is written.
pub(crate) const SESSION_TMP: &str = "session.tmp";
/// Longest note, bytes.
pub const NOTE_MAX_BYTES: usize = 4096;
/// Most notes of a dataset, and most bytes of all of them: `session.toml` must stay small enough to be read.
const NOTES_MAX: usize = 4096;
const NOTES_MAX_BYTES: usize = 1 << 20;
/// Streams and IMUs at most: each has three tables of a session, and three of the 65535 channels of a file.
const STREAMS_MAX: usize = 4_000;

/// The contents of `session.toml`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Session {
    /// [`FORMAT`].
    #[serde(default = "format")]
    pub format: String,
    /// Name of the session, usually the folder's.
    pub name: String,
    /// Name of the rig: the first part of each topic.
    pub rig: String,
    /// The scene in front of the cameras.
    #[serde(default)]
    pub scene: String,
    /// Who recorded it.
    #[serde(default)]
    pub operator: String,
    /// When the recording began, UTC nanoseconds since 1970.
    pub started_utc_ns: i64,
    /// The version of depthrig that recorded it.
    #[serde(default)]
    pub depthrig_version: String,
    /// The computer's name.
    #[serde(default)]
    pub host: String,
    /// The rig's configuration, TOML text.
    #[serde(default)]
    pub rig_config: String,
    /// The mount's calibration that poses and intrinsics come from, the text of `calibration.toml`; empty without one.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub calibration: String,
    /// The frames of one set should not be further apart than this, nanoseconds: twice what the rig's set window
    /// allows. Without it `verify` checks the spread only against a limit in its options.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub max_spread_ns: Option<i64>,
    /// A person's judgement.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mark: Option<Mark>,
    /// How it ended; absent while it runs and when it was cut off.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub outcome: Option<Outcome>,
    /// Notes of the operator.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub notes: Vec<Note>,
    /// Demonstrations, in the order of their times.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub episodes: Vec<Episode>,
    /// Firmware of each camera that says it.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub firmware: BTreeMap<String, String>,
    /// Changes after the recording, oldest first.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub history: Vec<Edit>,
    /// The datasets that it was cut or joined from, oldest first; empty for an original recording.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub derived: Vec<Derived>,
    /// Streams that no camera gave, with what computed them.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub computed: Vec<Computed>,
    /// The recorded streams; a frame names its stream by the index here.
    pub streams: Vec<StreamRecord>,
    /// The recorded IMUs, which are not streams of the sets; a batch names its IMU by the index here.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub motion: Vec<MotionRecord>,
    /// The recorded signals, in the order in which they appeared; samples name their signal by the index here.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub signals: Vec<SignalRecord>,
    /// Keys that this version does not know: a user's own, or a later version's. They are kept.
    #[serde(flatten)]
    pub extra: toml::Table,
}

/// A person's judgement of a recording. Nothing is deleted for it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Mark {
    /// To be used.
    Good,
    /// Not to be used.
    Bad,
}

impl Mark {
    /// The name used in files and JSON.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Good => "good",
            Self::Bad => "bad",
        }
    }
}

/// A change of `session.toml` after the recording.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Edit {
    /// When, UTC nanoseconds since 1970.
    pub utc_ns: i64,
    /// Which key.
    pub field: String,
    /// Its value until then; empty for a note.
    #[serde(default)]
    pub before: String,
    /// Its value since.
    #[serde(default)]
    pub after: String,
    /// The version of depthrig that changed it.
    #[serde(default)]
    pub depthrig_version: String,
}

impl Edit {
    /// The change in words. A calibration is named by the date at which it was made.
    pub fn text(&self) -> String {
        match self.field.as_str() {
            "notes" => format!("note added: {:?}", self.after),
            "calibration" => format!(
                "calibration: {} is now {}",
                calibration_date(&self.before).unwrap_or("none"),
                calibration_date(&self.after).unwrap_or("none")
            ),
            "mark" if self.after.is_empty() => format!("mark {} removed", self.before),
            "mark" => format!("marked {}", self.after),
            "pruned" => format!("pruned: {}", self.before),
            field => format!("{field}: {:?} is now {:?}", self.before, self.after),
        }
    }
}

/// The date in the text of a `calibration.toml`.
pub(crate) fn calibration_date(text: &str) -> Option<&str> {
    let line = text.lines().find_map(|l| l.trim_start().strip_prefix("created"))?;
    Some(line.trim_start().strip_prefix('=')?.trim().trim_matches('"'))
}

/// The producer of a computed stream, such as depth from two images: in `session.toml` under `[[computed]]`, and in the
/// metadata of the stream's channels.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Computed {
    /// The stream, `camera/stream`.
    pub stream: StreamId,
    /// Name of the computation, such as `mimic_quality`.
    pub name: String,
    /// The program or network with its version.
    pub producer: String,
    /// Every setting that the pixels depend on.
    #[serde(default)]
    pub parameters: String,
    /// The streams that it was computed from.
    #[serde(default)]
    pub from: Vec<StreamId>,
}

impl core::fmt::Display for Computed {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        let from: Vec<_> = self.from.iter().map(ToString::to_string).collect();
        let from = from.join(" and ");
        write!(f, "{} is {} by {}", self.stream, self.name, self.producer)?;
        if !from.is_empty() {
            write!(f, " from {from}")?;
        }
        if self.parameters.is_empty() { Ok(()) } else { write!(f, ": {}", self.parameters) }
    }
}

/// A step that derived a dataset from others, in `session.toml` under `[[derived]]`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Derived {
    /// `trim`, `merge` or `prune`.
    pub by: String,
    /// When, UTC nanoseconds since 1970.
    pub utc_ns: i64,
    /// The version of depthrig that did it.
    pub depthrig_version: String,
    /// File names of its sources.
    pub from: Vec<String>,
    /// Log time of the first set, UTC nanoseconds since 1970.
    pub first_utc_ns: i64,
    /// Log time of the last set.
    pub last_utc_ns: i64,
    /// Sets that were offered to the recorder before its own begin: `FrameSet.sets_offered` counts these as well.
    #[serde(default)]
    pub offered_before: u64,
    /// Runs of sets that `prune` removed between others.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub removed: Vec<RemovedSets>,
}

/// Consecutive sets that were removed from a dataset.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct RemovedSets {
    /// Log time of the first one, UTC nanoseconds since 1970.
    pub first_utc_ns: i64,
    /// Log time of the last one.
    pub last_utc_ns: i64,
}

/// A note of the operator.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Note {
    /// When, UTC nanoseconds since 1970.
    pub utc_ns: i64,
    /// The note.
    pub text: String,
}

/// How a recording ended.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Outcome {
    /// When the last set was taken, UTC nanoseconds since 1970.
    pub ended_utc_ns: i64,
    /// Whether every set handed over is in the dataset.
    pub complete: bool,
    /// Sets handed to the recorder.
    pub sets_offered: u64,
    /// Sets in the dataset.
    pub sets_recorded: u64,
    /// Sets lost, by reason.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub sets_dropped: BTreeMap<String, u64>,
    /// Losses and errors in words.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub lost: Vec<String>,
}

impl Outcome {
    pub(crate) fn new(ended_utc_ns: i64, sets: &SetCounts, lost: Vec<String>) -> Self {
        Self {
            ended_utc_ns,
            complete: lost.is_empty(),
            sets_offered: sets.offered,
            sets_recorded: sets.recorded,
            sets_dropped: sets.dropped_by_reason().map(|(r, n)| (r.name().to_owned(), n)).collect(),
            lost,
        }
    }
}

/// One recorded stream.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StreamRecord {
    /// Its name, `camera/stream`.
    pub id: StreamId,
    /// Camera model.
    #[serde(default)]
    pub model: String,
    /// Camera serial number.
    #[serde(default)]
    pub serial: String,
    /// Pixel format as the camera's channel carries it.
    pub format: PixelFormat,
    /// Pixels per row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Nominal frame rate of the live stream, Hz.
    #[serde(default)]
    pub rate_hz: f64,
    /// Metres per unit of depth; 0 for a stream without depth.
    #[serde(default)]
    pub depth_unit_m: f64,
    /// Where the calibration comes from: factory, file and date, none.
    #[serde(default)]
    pub calibration: String,
    /// Intrinsics at this size.
    #[serde(with = "intrinsics")]
    pub intrinsics: Intrinsics,
    /// Pose of the optical frame on the mount.
    pub pose: Pose,
}

/// One recorded IMU.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct MotionRecord {
    /// Its stream's name, such as `zed2i/imu`.
    pub id: StreamId,
    /// Camera model.
    #[serde(default)]
    pub model: String,
    /// Camera serial number.
    #[serde(default)]
    pub serial: String,
    /// Nominal number of samples a second.
    #[serde(default)]
    pub rate_hz: f64,
    /// Most samples of one batch.
    pub batch: u32,
    /// Where its pose comes from: factory, file and date, none.
    #[serde(default)]
    pub calibration: String,
    /// Pose of the IMU on the mount.
    pub pose: Pose,
}

fn format() -> String {
    FORMAT.to_owned()
}

/// Intrinsics in TOML: the model by name, and only the coefficients.
mod intrinsics {
    use super::{Deserialize, Distortion, Intrinsics, Serialize};
    use serde::{Deserializer, Serializer};

    #[derive(Serialize, Deserialize)]
    struct Repr {
        fx: f64,
        fy: f64,
        cx: f64,
        cy: f64,
        #[serde(default)]
        model: Distortion,
        #[serde(default)]
        coeffs: [f64; 8],
    }

    pub(super) fn serialize<S: Serializer>(i: &Intrinsics, s: S) -> Result<S::Ok, S::Error> {
        Repr { fx: i.fx, fy: i.fy, cx: i.cx, cy: i.cy, model: i.distortion(), coeffs: i.coeffs }.serialize(s)
    }

    pub(super) fn deserialize<'de, D: Deserializer<'de>>(d: D) -> Result<Intrinsics, D::Error> {
        let r = Repr::deserialize(d)?;
        let model = r.model as u32;
        Ok(Intrinsics { fx: r.fx, fy: r.fy, cx: r.cx, cy: r.cy, coeffs: r.coeffs, model, reserved: 0 })
    }
}

impl Session {
    /// A session that begins now, without streams.
    pub fn new(name: impl Into<String>, rig: impl Into<String>) -> Self {
        Self {
            format: format(),
            name: name.into(),
            rig: rig.into(),
            scene: String::new(),
            operator: String::new(),
            started_utc_ns: depthrig_bus::UtcPair::sample().utc_ns,
            depthrig_version: env!("CARGO_PKG_VERSION").to_owned(),
            host: rustix::system::uname().nodename().to_string_lossy().into_owned(),
            rig_config: String::new(),
            calibration: String::new(),
            max_spread_ns: None,
            mark: None,
            outcome: None,
            notes: Vec::new(),
            episodes: Vec::new(),
            firmware: BTreeMap::new(),
            history: Vec::new(),
            derived: Vec::new(),
            computed: Vec::new(),
            motion: Vec::new(),
            signals: Vec::new(),
            streams: Vec::new(),
            extra: toml::Table::new(),
        }
    }

    /// Checks that `text` can be one more note.
    pub(crate) fn check_note(&self, text: &str) -> Result<()> {
        let total: usize = self.notes.iter().map(|n| n.text.len()).sum();
        let why = if text.len() > NOTE_MAX_BYTES {
            format!(
                "the note has {} bytes, {NOTE_MAX_BYTES} is the limit; write it to a file and note its name",
                text.len()
            )
        } else if self.notes.len() >= NOTES_MAX {
            format!("the dataset has {NOTES_MAX} notes already, which is the limit")
        } else if total + text.len() > NOTES_MAX_BYTES {
            format!("the dataset's notes have {total} bytes already, {NOTES_MAX_BYTES} is the limit")
        } else {
            return Ok(());
        };
        Err(Error::new(ErrorKind::BadInput, why))
    }

    /// Checks the values that topics and file are built from.
    pub(crate) fn check(&self) -> Result<()> {
        let bad = |why: String| Error::new(ErrorKind::BadInput, format!("session \"{}\": {why}", self.name));
        Name::new(self.rig.as_str()).map_err(|e| bad(format!("the rig's name: {e}")))?;
        if self.streams.is_empty() {
            return Err(bad("it has no streams to record".to_owned()));
        }
        for (i, s) in self.streams.iter().enumerate() {
            if self.streams[..i].iter().any(|other| other.id == s.id) {
                return Err(bad(format!("stream {} is there twice", s.id)));
            }
            if s.format.is_motion() {
                return Err(bad(format!("{} is an IMU; it belongs into [[motion]]", s.id)));
            }
        }
        for (i, u) in self.motion.iter().enumerate() {
            let mut others = self.motion[..i].iter().map(|u| &u.id).chain(self.streams.iter().map(|s| &s.id));
            if others.any(|other| *other == u.id) {
                return Err(bad(format!("IMU {} is there twice", u.id)));
            }
            if u.batch == 0 {
                return Err(bad(format!("IMU {} has batches of no samples", u.id)));
            }
        }
        for (i, s) in self.signals.iter().enumerate() {
            self.may_add(&self.signals[..i], s)?;
        }
        self.too_much().map_or(Ok(()), |why| Err(bad(why)))
    }

    /// Checks that `signal` can be recorded beside the streams, the IMUs and the signals `others`, whose topics must differ.
    fn may_add(&self, others: &[SignalRecord], signal: &SignalRecord) -> Result<()> {
        let id = &signal.id;
        let of_cameras = self.streams.iter().map(|s| &s.id).chain(self.motion.iter().map(|u| &u.id));
        let why = if others.iter().any(|other| other.id == *id) {
            "it is recorded already"
        } else if of_cameras.into_iter().any(|other| other == id) {
            "a stream of a camera has the same name; rename one of them"
        } else {
            return Ok(());
        };
        Err(Error::new(ErrorKind::BadInput, format!("signal {id} is not recorded: {why}")))
    }

    /// Adds a signal and returns its index.
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] when a stream or signal has its name, or the session is full.
    pub(crate) fn add_signal(&mut self, signal: SignalRecord) -> Result<usize> {
        self.may_add(&self.signals, &signal)?;
        if self.listed() >= STREAMS_MAX {
            let what = format!("signal {} is not recorded: the dataset has {STREAMS_MAX} streams", signal.id);
            return Err(Error::new(ErrorKind::BadInput, what));
        }
        self.signals.push(signal);
        Ok(self.signals.len() - 1)
    }

    fn listed(&self) -> usize {
        self.streams.len() + self.motion.len() + self.signals.len()
    }

    /// Whether sets of `other` can be sets of this session: the same rig, streams and IMUs, whatever their
    /// calibration.
    pub(crate) fn has_streams_of(&self, other: &Self) -> bool {
        let stream = |s: &StreamRecord| (s.id.clone(), s.format, s.width, s.height);
        let unit = |u: &MotionRecord| (u.id.clone(), u.batch);
        self.rig == other.rig
            && self.streams.iter().map(stream).eq(other.streams.iter().map(stream))
            && self.motion.iter().map(unit).eq(other.motion.iter().map(unit))
            && self.has_signals_as(other)
    }

    /// Whether the signals that both have are the same ones: one of them may have been recorded for longer.
    pub(crate) fn has_signals_as(&self, other: &Self) -> bool {
        self.signals.iter().zip(&other.signals).all(|(a, b)| a == b)
    }

    /// Whether streams and IMUs have the intrinsics and poses that those of `other` have.
    pub(crate) fn is_calibrated_as(&self, other: &Self) -> bool {
        let stream = |s: &StreamRecord| (s.intrinsics, s.pose);
        self.streams.iter().map(stream).eq(other.streams.iter().map(stream))
            && self.motion.iter().map(|u| u.pose).eq(other.motion.iter().map(|u| u.pose))
    }

    /// Losses of an import in words, from the table `import`; empty for a recording.
    pub fn import_losses(&self) -> Vec<String> {
        let Some(table) = self.extra.get("import").and_then(toml::Value::as_table) else { return Vec::new() };
        let lost = table.get("lost").and_then(toml::Value::as_integer).filter(|n| *n > 0);
        let mut words = Vec::new();
        words.extend(lost.map(|n| format!("{n} parts of what was imported could not be read, see [import]")));
        if table.get("ended_early").and_then(toml::Value::as_bool) == Some(true) {
            words.push("the import was ended before all was read".to_owned());
        }
        words
    }

    /// The first limit of a dataset that it exceeds, in words.
    fn too_much(&self) -> Option<String> {
        let listed = self.listed();
        if listed > STREAMS_MAX {
            return Some(format!("it lists {listed} streams, IMUs and signals, {STREAMS_MAX} is the limit"));
        }
        let fits = |u: &&MotionRecord| RecordMotion::stored_bytes_of(u.batch.into()) <= SET_MOTION_MAX_BYTES;
        let long = self.motion.iter().find(|u| !fits(u))?;
        Some(format!("IMU {} has batches of {} samples, no set can hold one", long.id, long.batch))
    }

    /// The text of `session.toml`.
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] when a value cannot be written as TOML.
    pub fn to_toml(&self) -> Result<String> {
        toml::to_string_pretty(self).map_err(|e| {
            Error::new(
                ErrorKind::BadInput,
                format!("session \"{}\" cannot be written as TOML: {e}", self.name),
            )
            .with_source(e)
        })
    }

    /// Reads the text of a `session.toml`; `path` is for the message.
    pub(crate) fn from_toml(text: &str, path: &Path) -> Result<Self> {
        if let Some(why) = limits::exceeded(text) {
            let message = format!("{} cannot be read as a session: {why}", path.display());
            return Err(Error::new(ErrorKind::Corrupt, message));
        }
        let session: Self = toml::from_str(text).map_err(|e| {
            let message = format!("{} cannot be read as a session: {e}", path.display());
            Error::new(ErrorKind::Corrupt, message).with_source(e)
        })?;
        if session.format != FORMAT {
            return Err(Error::new(
                ErrorKind::Version,
                format!(
                    "{} has format \"{}\"; this depthrig reads \"{FORMAT}\": use a later version",
                    path.display(),
                    session.format
                ),
            ));
        }
        if let Some(why) = session.too_much() {
            let message = format!("{} cannot be read as a session: {why}", path.display());
            return Err(Error::new(ErrorKind::Corrupt, message));
        }
        Ok(session)
    }

    /// Writes `session.toml` into `dir`, replacing it in one step.
    pub(crate) fn save(&self, fs: &dyn Fs, dir: &Path) -> Result<()> {
        let path = dir.join(SESSION_FILE);
        let text = self.to_toml()?;
        check_size(&text, &path)?;
        fs::replace(fs, &path, text.as_bytes()).map_err(|e| Error::io("write", &path, e))
    }

    /// Reads `session.toml` in `dir`.
    pub(crate) fn load(fs: &dyn Fs, dir: &Path) -> Result<Self> {
        let path = dir.join(SESSION_FILE);
        Self::from_toml(&text_of(fs, &path)?, &path)
    }
}

/// Refuses a text that is too large to be read back.
pub(crate) fn check_size(text: &str, path: &Path) -> Result<()> {
    let Some(why) = limits::exceeded(text) else { return Ok(()) };
    let message = format!("{} cannot be written: {why}; it is left as it is", path.display());
    Err(Error::new(ErrorKind::BadInput, message))
}

/// The text of a `session.toml`.
fn text_of(fs: &dyn Fs, path: &Path) -> Result<String> {
    let read = || {
        let file = fs.open(path)?;
        let size = file.size()?;
        // A session with every note of a long day is some kilobytes. Longer files are refused, and not read to the end.
        let mut bytes = vec![0; usize::try_from(size.min(limits::TEXT_MAX_BYTES + 1)).unwrap_or(0)];
        file.read_exact_at(&mut bytes, 0)?;
        Ok((bytes, size))
    };
    let (bytes, size) = read().map_err(|e: std::io::Error| Error::reading("read", path, e))?;
    if size > limits::TEXT_MAX_BYTES {
        let most = limits::TEXT_MAX_BYTES;
        let what = format!("{} has {size} bytes, {most} is the limit", path.display());
        return Err(Error::new(ErrorKind::Corrupt, what));
    }
    String::from_utf8(bytes)
        .map_err(|e| Error::new(ErrorKind::Corrupt, format!("{} is not text", path.display())).with_source(e))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::stream;
    use proptest::prelude::*;

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(1000))]
        #[test]
        fn a_pose_is_written_and_read_bit_by_bit(
            t in prop::array::uniform3(-5.0f64..5.0), q in prop::array::uniform4(-1.0f64..1.0),
        ) {
            let n = q.iter().map(|c| c * c).sum::<f64>().sqrt().max(1e-3);
            let mut session = Session::new("s", "rig");
            let mut stream = stream("a/color".parse().unwrap(), String::new(), PixelFormat::Rgb8);
            stream.pose = Pose { translation_m: t, rotation_xyzw: q.map(|c| c / n) };
            session.streams.push(stream);
            let again = Session::from_toml(&session.to_toml().unwrap(), Path::new("s")).unwrap();
            let bits = |s: &Session| {
                let p = s.streams[0].pose;
                (p.translation_m.map(f64::to_bits), p.rotation_xyzw.map(f64::to_bits))
            };
            prop_assert_eq!(bits(&again), bits(&session));
        }
    }
}
