//! Inputs: the raw left and right images of a recorded dataset, or the pairs of another recording.

use super::images::Raw;
use depthrig_bus::{
    ClockDomain, FrameFlags, FrameHeader, HostTime, Intrinsics, PixelFormat, Pose, StreamId, UtcPair,
};
use depthrig_calib::PoseExt;
use depthrig_recorder::{
    Dataset, DatasetFrame, Derived, Error, ErrorKind, PixelMode, RecordMotion, RecordSignal, Result, Session,
    SetReader, StreamAccount, StreamRecord,
};
use depthrig_zed::conf::StereoCalibration;
use depthrig_zed::replay::{self, Pair, Source};
use serde_json::{Value, json};
use std::path::Path;

/// The moment on the monotonic clock that the first pair of a recording without such a clock gets, nanoseconds.
const FIRST_NS: i64 = 1_000_000_000;
/// Times before this are not UTC but count from some start: the year 2000, nanoseconds since 1970.
const EARLIEST_UTC_NS: i64 = 946_684_800_000_000_000;

/// Facts common to the frames of a pair.
pub(super) struct Head {
    pub(super) set: u64,
    pub(super) tick: HostTime,
    pub(super) utc: UtcPair,
    /// Header of the left image's frame; `None` in a set without a pair.
    pub(super) left: Option<Box<FrameHeader>>,
    /// IMU batches of the camera since the set before.
    pub(super) motion: Vec<RecordMotion>,
    /// Samples of signals since the set before.
    pub(super) signals: Vec<RecordSignal>,
}

/// The next item of an input.
pub(super) enum Next {
    /// A pair, or a set that has none.
    Pair(Head, Option<Raw>),
    /// A pair that cannot be decoded, and why.
    Damaged(Head, String),
    End,
}

/// Facts known before the first pair.
#[derive(Clone)]
pub(super) struct Facts {
    /// Name of the camera.
    pub(super) camera: String,
    pub(super) model: String,
    pub(super) serial: String,
    pub(super) size: (u32, u32),
    pub(super) rate_hz: f64,
    pub(super) calibration: StereoCalibration,
    pub(super) calibration_origin: String,
    /// Pose of the left camera on the mount.
    pub(super) pose: Pose,
    /// The session that the output's begins as: without streams.
    pub(super) session: Session,
    /// Accounts of the batches of its IMUs, as the recording has them.
    pub(super) accounts: Vec<StreamAccount>,
    /// Streams that depth is computed from.
    pub(super) from: Vec<StreamId>,
    /// Identifies this input among others, and shows that it changed.
    pub(super) identity: Value,
    pub(super) total: u64,
}

enum Kind {
    Dataset {
        reader: Box<SetReader>,
        left: usize,
        right: usize,
        /// The output's IMU for each IMU of the dataset, if it has one.
        units: Vec<Option<usize>>,
        number: usize,
        lost: Vec<String>,
    },
    Recording {
        source: Box<dyn Source>,
        pair: Pair,
        first_ns: i64,
        timed_utc: Option<i64>,
    },
}

pub(super) struct Input {
    facts: Facts,
    kind: Kind,
}

fn bad(message: impl Into<String>) -> Error {
    Error::new(ErrorKind::BadInput, message)
}

fn driver(e: depthrig_driver::Error) -> Error {
    let kind = match e.kind() {
        depthrig_driver::ErrorKind::NotFound => ErrorKind::NotFound,
        depthrig_driver::ErrorKind::PermissionDenied => ErrorKind::PermissionDenied,
        depthrig_driver::ErrorKind::BadInput | depthrig_driver::ErrorKind::Unsupported => {
            ErrorKind::BadRecording
        }
        _ => ErrorKind::Io,
    };
    Error::new(kind, e.to_string()).with_source(e)
}

fn name_of(path: &Path) -> String {
    path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned()
}

impl Input {
    /// Opens a dataset with raw left and right images, a folder of side-by-side images, or an SVO2 file.
    pub(super) fn open(path: &Path, camera: Option<&str>, options: &replay::OpenOptions) -> Result<Self> {
        let recording = || Self::recording(replay::open(path, options).map_err(driver)?, camera);
        // An SVO2 file is an MCAP file, as a segment of a dataset is; its name identifies it even when it is damaged.
        if path.extension().is_some_and(|e| e.eq_ignore_ascii_case("svo2") || e.eq_ignore_ascii_case("svo")) {
            return recording();
        }
        match Dataset::open(path) {
            Ok(dataset) => Self::dataset(&dataset, camera),
            Err(e) if matches!(e.kind(), ErrorKind::NotADataset | ErrorKind::Foreign) => recording(),
            Err(e) => Err(e),
        }
    }

    fn dataset(dataset: &Dataset, camera: Option<&str>) -> Result<Self> {
        let session = dataset.session();
        let (left, right) = left_and_right(session, camera)?;
        let l = &session.streams[left];
        let r = &session.streams[right];
        same_image(l, r)?;
        let reader = dataset.set_reader()?;
        let size = |p: &std::path::PathBuf| p.metadata().map_or(0, |m| m.len());
        let identity = json!({
            "kind": "dataset",
            "name": name_of(dataset.path()),
            "camera": l.id.camera.as_str(),
            "started_utc_ns": session.started_utc_ns,
            "sets": reader.times().len(),
            "first_utc_ns": reader.times().first(),
            "segment_bytes": dataset.segments().iter().map(size).collect::<Vec<_>>(),
        });
        let mut output = session.clone();
        output.outcome = None;
        output.streams.clear();
        // Motion of other cameras would have no frames to belong to.
        output.motion.retain(|u| u.id.camera == l.id.camera);
        let units = session.motion.iter().map(|u| output.motion.iter().position(|m| m.id == u.id)).collect();
        let mut accounts = if output.motion.is_empty() { Vec::new() } else { dataset.info()?.accounts };
        accounts.retain(|a| output.motion.iter().any(|u| u.id == a.stream));
        output.computed.clear();
        output.derived.push(derived(
            dataset.path(),
            reader.times().first().copied().unwrap_or_default(),
            reader.times().last().copied().unwrap_or_default(),
        ));
        let facts = Facts {
            camera: l.id.camera.to_string(),
            model: l.model.clone(),
            serial: l.serial.clone(),
            size: (l.width, l.height),
            rate_hz: l.rate_hz,
            calibration: StereoCalibration {
                left: l.intrinsics,
                right: r.intrinsics,
                right_in_left: l.pose.inverse().compose(&r.pose),
            },
            calibration_origin: l.calibration.clone(),
            pose: l.pose,
            session: output,
            accounts,
            from: vec![l.id.clone(), r.id.clone()],
            identity,
            total: reader.times().len() as u64,
        };
        known(&facts.calibration.left, &facts.calibration.right, dataset.path())?;
        let lost = reader.problems().to_vec();
        let kind = Kind::Dataset { reader: Box::new(reader), left, right, units, number: 0, lost };
        Ok(Self { facts, kind })
    }

    fn recording(mut source: Box<dyn Source>, camera: Option<&str>) -> Result<Self> {
        let mut pair = Pair::default();
        source.next(&mut pair).map_err(driver)?;
        let first_ns = pair.capture_time_ns;
        source.seek(0).map_err(driver)?;
        let info = source.info().clone();
        let Some(calibration) = info.calibration else {
            return Err(bad(format!(
                "{} has no calibration, which depth needs: put the camera's SN<serial>.conf beside it or \
                 name the file with --calibration",
                info.path.display()
            )));
        };
        let camera = camera.unwrap_or("zed2i");
        let timed_utc = (info.timed && first_ns >= EARLIEST_UTC_NS).then_some(first_ns);
        let changed = info.path.metadata().and_then(|m| m.modified()).ok();
        let changed = changed.and_then(|t| t.duration_since(std::time::UNIX_EPOCH).ok());
        let started = timed_utc.or_else(|| i64::try_from(changed?.as_nanos()).ok()).unwrap_or_default();
        let total = source.len_hint().unwrap_or_default();
        let mut session = Session::new(name_of(&info.path), "zed");
        session.started_utc_ns = started;
        session.derived.push(derived(&info.path, started, started));
        let id = |side: &str| StreamId::new(camera, side).map_err(|e| bad(format!("--camera {camera}: {e}")));
        let facts = Facts {
            camera: camera.to_owned(),
            model: if info.model.is_empty() { "ZED".to_owned() } else { info.model.clone() },
            serial: info.serial.clone(),
            size: (info.width, info.height),
            rate_hz: info.rate_hz,
            calibration,
            calibration_origin: info.calibration_origin.clone(),
            pose: Pose::IDENTITY,
            session,
            accounts: Vec::new(),
            from: vec![id("left")?, id("right")?],
            identity: json!({
                "kind": info.kind,
                "name": name_of(&info.path),
                "camera": camera,
                "pairs": total,
                "first_ns": first_ns,
                "started_utc_ns": started,
                "bytes": info.path.metadata().map_or(0, |m| m.len()),
            }),
            total,
        };
        let kind = Kind::Recording { source, pair, first_ns, timed_utc };
        Ok(Self { facts, kind })
    }

    pub(super) const fn facts(&self) -> &Facts {
        &self.facts
    }

    /// Segments of a dataset that cannot be read, in words.
    pub(super) fn take_lost(&mut self) -> Vec<String> {
        match &mut self.kind {
            Kind::Dataset { lost, .. } => std::mem::take(lost),
            Kind::Recording { .. } => Vec::new(),
        }
    }

    /// Goes back to the first pair.
    pub(super) fn rewind(&mut self) -> Result<()> {
        match &mut self.kind {
            Kind::Recording { source, .. } => source.seek(0).map_err(driver),
            Kind::Dataset { number, lost, reader, .. } => {
                *number = 0;
                *lost = reader.problems().to_vec();
                Ok(())
            }
        }
    }

    /// Goes to the pair after set `last` of the output; returns how many sets lie before.
    pub(super) fn go_behind(&mut self, last: u64) -> Result<u64> {
        match &mut self.kind {
            Kind::Recording { source, .. } => {
                source.seek(last).map_err(driver)?;
                Ok(last)
            }
            Kind::Dataset { reader, number, .. } => {
                while *number < reader.times().len() {
                    match reader.read(*number, PixelMode::None) {
                        Ok(set) if set.id > last => break,
                        Err(e) if e.kind() == ErrorKind::Io => return Err(e),
                        _ => *number += 1,
                    }
                }
                Ok(*number as u64)
            }
        }
    }

    /// The next pair.
    pub(super) fn next(&mut self) -> Result<Next> {
        match &mut self.kind {
            Kind::Dataset { reader, left, right, units, number, lost } => loop {
                if *number >= reader.times().len() {
                    return Ok(Next::End);
                }
                let read = reader.read(*number, PixelMode::Stored);
                *number += 1;
                let mut set = match read {
                    Ok(set) => set,
                    Err(e) if e.kind() == ErrorKind::Io => return Err(e),
                    Err(e) => {
                        lost.push(e.to_string());
                        continue;
                    }
                };
                let motion = std::mem::take(&mut set.motion);
                let motion = motion.into_iter().filter_map(|m| {
                    let unit = units.get(m.unit).copied().flatten()?;
                    Some(RecordMotion { unit, ..m })
                });
                let motion: Vec<_> = motion.collect();
                let signals = std::mem::take(&mut set.signals);
                let of = |stream| set.frames.iter().find(|f| f.stream == stream);
                let head = |left: Option<Box<FrameHeader>>| Head {
                    set: set.id,
                    tick: set.tick,
                    utc: UtcPair {
                        mono: set.tick,
                        utc_ns: set.tick.ns().saturating_add(set.utc_offset_ns),
                        width_ns: 0,
                    },
                    left,
                    motion,
                    signals,
                };
                let (Some(l), Some(r)) = (of(*left), of(*right)) else {
                    return Ok(Next::Pair(head(None), None));
                };
                return Ok(match (packed(l), packed(r)) {
                    (Ok((format, left)), Ok((_, right))) => {
                        Next::Pair(head(Some(Box::new(l.header))), Some(Raw { format, left, right }))
                    }
                    (Err(e), _) | (_, Err(e)) => Next::Damaged(head(None), format!("set {}: {e}", set.id)),
                });
            },
            Kind::Recording { source, pair, first_ns, timed_utc } => {
                let next = source.next(pair).map_err(driver)?;
                if next == replay::Next::End {
                    return Ok(Next::End);
                }
                let info = source.info();
                let ns = pair.capture_time_ns.saturating_sub(*first_ns).saturating_add(FIRST_NS);
                let start = timed_utc.unwrap_or(self.facts.session.started_utc_ns);
                let tick = HostTime::from_ns(ns);
                let mut head = Head {
                    set: pair.index + 1,
                    tick,
                    utc: UtcPair { mono: HostTime::from_ns(FIRST_NS), utc_ns: start, width_ns: 0 },
                    left: None,
                    motion: Vec::new(),
                    signals: Vec::new(),
                };
                if let replay::Next::Damaged(why) = next {
                    let what = format!("pair {} of {}: {why}", pair.index, info.path.display());
                    return Ok(Next::Damaged(head, what));
                }
                let mut h = FrameHeader {
                    sequence: pair.index + 1,
                    device_sequence: pair.index,
                    device_time: u64::try_from(pair.capture_time_ns).unwrap_or_default(),
                    capture_time_ns: ns,
                    arrival_time_ns: ns,
                    publish_time_ns: ns,
                    captured: pair.index + 1,
                    clock_domain: if info.timed { ClockDomain::Device } else { ClockDomain::Arrival } as u32,
                    flags: FrameFlags::REPLAYED.0,
                    ..FrameHeader::default()
                };
                h.set_device(&self.facts.model, &self.facts.serial);
                h.set_image(info.format, info.width, info.height);
                head.left = Some(Box::new(h));
                let left = std::mem::take(&mut pair.left);
                let right = std::mem::take(&mut pair.right);
                Ok(Next::Pair(head, Some(Raw { format: info.format, left, right })))
            }
        }
    }
}

fn derived(path: &Path, first_utc_ns: i64, last_utc_ns: i64) -> Derived {
    Derived {
        by: "zed replay".to_owned(),
        utc_ns: UtcPair::sample().utc_ns,
        depthrig_version: env!("CARGO_PKG_VERSION").to_owned(),
        from: vec![name_of(path)],
        first_utc_ns,
        last_utc_ns,
        offered_before: 0,
        removed: Vec::new(),
    }
}

/// Indices of the raw left and right streams of the selected stereo camera.
fn left_and_right(session: &Session, camera: Option<&str>) -> Result<(usize, usize)> {
    let find = |camera: &str, side: &str| {
        let is = |s: &StreamRecord| s.id.camera.as_str() == camera && s.id.stream.as_str() == side;
        session.streams.iter().position(is)
    };
    let all = session.streams.iter().map(|s| s.id.camera.as_str());
    let mut found: Vec<(&str, (usize, usize))> =
        all.filter_map(|c| Some((c, (find(c, "left")?, find(c, "right")?)))).collect();
    found.dedup_by_key(|(c, _)| *c);
    let names = || found.iter().map(|(c, _)| *c).collect::<std::collections::BTreeSet<_>>();
    let list = |names: std::collections::BTreeSet<&str>| names.into_iter().collect::<Vec<_>>().join(", ");
    if let Some(camera) = camera {
        let one = found.iter().find(|(c, _)| *c == camera).map(|(_, pair)| *pair);
        return one.ok_or_else(|| {
            let rest = if found.is_empty() { "none".to_owned() } else { list(names()) };
            bad(format!(
                "camera {camera} has no streams left and right in the dataset; of its cameras have: {rest}"
            ))
        });
    }
    if names().len() > 1 {
        return Err(bad(format!(
            "several cameras have streams left and right: {}; choose with --camera",
            list(names())
        )));
    }
    found.first().map(|(_, pair)| *pair).ok_or_else(|| {
        let ids: Vec<_> = session.streams.iter().map(|s| s.id.to_string()).collect();
        bad(format!("no camera of the dataset has both left and right; it has {}", ids.join(", ")))
    })
}

/// Refuses left and right images that differ in size or format, and unsupported formats.
fn same_image(l: &StreamRecord, r: &StreamRecord) -> Result<()> {
    if (l.format, l.width, l.height) != (r.format, r.width, r.height) {
        return Err(bad(format!(
            "{} is {}x{} {} and {} is {}x{} {}; left and right must have the same size and format",
            l.id,
            l.width,
            l.height,
            l.format.name(),
            r.id,
            r.width,
            r.height,
            r.format.name()
        )));
    }
    if !matches!(l.format, PixelFormat::Yuyv | PixelFormat::Rgb8 | PixelFormat::Bgr8 | PixelFormat::Mono8) {
        let id = &l.id;
        let format = l.format.name();
        return Err(bad(format!("{id} is {format}; depth is computed from yuyv, rgb8, bgr8 and mono8")));
    }
    Ok(())
}

fn known(left: &Intrinsics, right: &Intrinsics, path: &Path) -> Result<()> {
    if left.is_known() && right.is_known() {
        return Ok(());
    }
    let what = "left and right have no calibration, which depth needs: record again with the camera's \
                SN<serial>.conf in place";
    Err(bad(format!("{}: {what}", path.display())))
}

/// The pixels of a stored frame without padding; BGR as RGB.
fn packed(frame: &DatasetFrame) -> Result<(PixelFormat, Vec<u8>)> {
    let h = &frame.header;
    let mut pixels = frame.decoded()?;
    let format = h.pixel_format().unwrap_or(PixelFormat::Mjpeg);
    let row = format.row_bytes(h.width) as usize;
    let stride = h.stride as usize;
    if stride != row && row > 0 && stride > row {
        pixels = pixels.chunks(stride).flat_map(|r| r.iter().take(row).copied()).collect();
    }
    if pixels.len() != format.frame_bytes(h.width, h.height) {
        let what = format!("frame {} of {}/{} has too few pixels", h.sequence, h.camera(), h.stream());
        return Err(Error::new(ErrorKind::Corrupt, what));
    }
    if format == PixelFormat::Bgr8 {
        pixels.as_chunks_mut::<3>().0.iter_mut().for_each(|p| p.swap(0, 2));
        return Ok((PixelFormat::Rgb8, pixels));
    }
    Ok((format, pixels))
}
