//! Recordings of an Azure Kinect (`.mkv`) as datasets: JPEG, depth and infrared come over as they are.
//!
//! Read once, block by block. Images of one capture become one set: colour and depth whose times, the delay between
//! them left out, lie within half a period; a capture that lacks one is a set that lacks it. Memory is that of the few
//! captures that are not complete yet.
//!
//! Samples of accelerometer and gyroscope come over in batches ([`motion`]): all of them, those before the first capture
//! with the first set and those after the last with the last.

use crate::{ImportFacts, ImportProgress, Importer};
use depthrig_bus::{
    CameraName, ClockDomain, DropCounts, DropReason, FrameHeader, HostTime, PixelFormat, StreamId, UtcPair,
};
use depthrig_driver::unpack;
use depthrig_kinect::motion as kinect_motion;
use depthrig_kinect::playback::{CalibrationSource, recorded_motion, recorded_profiles, serial};
use depthrig_kinect::recording::{Pixels, Recording, TrackKind};
use depthrig_kinect::{Calibration, ColorMode, DepthMode};
use depthrig_recorder::{
    Error, ErrorKind, MotionRecord, RecordFrame, RecordSet, Result, Session, StreamAccount, StreamRecord,
};
use std::collections::{BTreeMap, VecDeque};
use std::path::{Path, PathBuf};

mod motion;

/// The name of the layout.
pub const FORMAT: &str = "kinect";
/// The most incomplete captures that may wait.
const MOST_OPEN: usize = 8;
/// Problems that are reported in words.
const MOST_REPORTED: u64 = 50;

/// How to import a recording.
#[derive(Debug, Clone)]
pub struct KinectOptions {
    /// Name of the dataset.
    pub name: String,
    /// Name of the camera in it.
    pub camera: CameraName,
    /// The device's calibration.
    pub calibration: CalibrationSource,
}

/// The importer of one recording.
pub struct KinectImport {
    recording: Recording,
    path: PathBuf,
    options: KinectOptions,
    streams: Vec<Stream>,
    /// Captures in the order of their times, the last ones incomplete.
    open: VecDeque<Capture>,
    period_us: u64,
    /// Delays that are added to the times of colour and of depth, so that those of a capture are equal.
    delays_us: (u64, u64),
    /// UTC at the device's time 0, nanoseconds.
    origin_ns: i64,
    sets: u64,
    /// The newest set, which may be the last and then takes the rest of the IMU batches.
    held: Option<RecordSet>,
    motion: Option<motion::Unit>,
    /// Blocks of tracks that belong to no camera, which were left out.
    others: u64,
    ended: bool,
    facts: ImportFacts,
}

/// One stream and its account.
struct Stream {
    record: StreamRecord,
    track: usize,
    kind: TrackKind,
    pixels: Option<Pixels>,
    sequence: u64,
    /// Number of the newest frame by the device's times, and that time.
    newest: Option<(u64, u64)>,
    dropped: DropCounts,
}

/// One capture that may lack images yet.
struct Capture {
    at_us: u64,
    frames: Vec<Option<RecordFrame>>,
}

impl KinectImport {
    /// Opens the recording `path`.
    ///
    /// # Errors
    /// [`ErrorKind::NotFound`], [`ErrorKind::BadRecording`] when it is not an Azure Kinect `.mkv`, or its calibration
    /// is unreadable, [`ErrorKind::BadInput`] when it has no calibration and one is wanted, [`ErrorKind::Io`].
    pub fn open(path: &Path, options: KinectOptions) -> Result<Self> {
        let recording = Recording::open(path).map_err(of_driver)?;
        let lacks_calibration =
            options.calibration == CalibrationSource::Recorded && recording.facts().calibration.is_none();
        let calibration = options.calibration.load(&recording).map_err(|e| {
            // An option can do without it.
            if lacks_calibration {
                Error::new(ErrorKind::BadInput, e.to_string()).with_source(e)
            } else {
                of_driver(e)
            }
        })?;
        let facts = recording.facts();
        let profiles = recorded_profiles(facts, calibration.as_ref()).map_err(of_driver)?;
        let from = match &options.calibration {
            CalibrationSource::Recorded => "factory, as the recording has it".to_owned(),
            CalibrationSource::At(path) => format!("file {}", path.display()),
            CalibrationSource::None => "none".to_owned(),
        };
        let mut streams = Vec::new();
        for (track, profile) in profiles {
            let Some(t) = facts.tracks.get(track) else { continue };
            let id = StreamId::new(options.camera.as_str(), profile.stream.as_str()).map_err(|e| {
                Error::new(ErrorKind::BadInput, format!("{}: {e}", path.display())).with_source(e)
            })?;
            let record = StreamRecord {
                id,
                model: "Azure Kinect".to_owned(),
                serial: serial(facts, path),
                format: profile.format,
                width: profile.width,
                height: profile.height,
                rate_hz: profile.rate_hz,
                depth_unit_m: profile.depth_unit_m,
                calibration: from.clone(),
                intrinsics: profile.intrinsics,
                pose: profile.pose_in_device,
            };
            let kind = t.kind;
            let pixels = t.pixels;
            let dropped = DropCounts::default();
            streams.push(Stream { record, track, kind, pixels, sequence: 0, newest: None, dropped });
        }
        let motion = recorded_motion(facts, calibration.as_ref()).map_err(of_driver)?;
        let motion = motion.map(|(track, profile)| {
            let id = StreamId { camera: options.camera.clone(), stream: profile.stream.clone() };
            let record = MotionRecord {
                id,
                model: "Azure Kinect".to_owned(),
                serial: serial(facts, path),
                rate_hz: profile.samples_hz(),
                batch: profile.width,
                calibration: format!(
                    "{}; {}",
                    kinect_motion::stated(&from, calibration.as_ref()),
                    kinect_motion::CORRECTED
                ),
                pose: profile.pose_in_device,
            };
            motion::Unit::new(record, track)
        });
        let rate_hz = streams.iter().map(|s| s.record.rate_hz).fold(f64::INFINITY, f64::min);
        let delay_us = facts.depth_delay_ns / 1000;
        let delays_us = (delay_us.max(0).unsigned_abs(), delay_us.min(0).unsigned_abs());
        let start_ns = i64::try_from(facts.start_offset_ns).unwrap_or(0);
        let mut import = Self {
            open: VecDeque::new(),
            period_us: (1e6 / rate_hz).round().max(1.0) as u64,
            delays_us,
            origin_ns: facts.date_utc_ns.unwrap_or(0).saturating_sub(start_ns),
            sets: 0,
            held: None,
            motion,
            others: 0,
            ended: false,
            facts: ImportFacts::default(),
            path: path.to_path_buf(),
            options,
            streams,
            recording,
        };
        import.state_all(calibration.as_ref());
        Ok(import)
    }

    /// The assumptions, before anything was read.
    fn state_all(&mut self, calibration: Option<&Calibration>) {
        let facts = self.recording.facts();
        let mut stated = vec![if facts.date_utc_ns.is_some() {
            "UTC is what the file says of when it was begun, in whole seconds; times from frame to frame are the device's"
                .to_owned()
        } else {
            "the file does not say when it was recorded: times count from 1970".to_owned()
        }];
        stated.push("capture times are the device's clock at mid-exposure; frames have no numbers, they follow from it".to_owned());
        if calibration.is_none() {
            stated.push("there is no calibration: intrinsics are unknown".to_owned());
        }
        if facts.depth_delay_ns != 0 {
            let us = facts.depth_delay_ns / 1000;
            stated.push(format!("depth was exposed {us} us after colour; a set holds both"));
        }
        if facts.tracks.iter().any(|t| t.kind == TrackKind::Motion) {
            stated.push(
                "a sample of accelerometer and gyroscope has the gyroscope's time, and its number follows from that; it \
                 is with the first set that is not earlier, or with the last"
                    .to_owned(),
            );
            let rotation = kinect_motion::gyroscope_in_unit(calibration);
            stated.extend(rotation.map(|r| r.to_string()));
        }
        for t in facts.tracks.iter().filter(|t| t.kind == TrackKind::Other) {
            stated.push(format!("the track {} is left out: it belongs to no camera", t.name));
        }
        self.facts.stated = stated;
    }

    /// Takes one block.
    fn block(&mut self) -> Result<bool> {
        let Some(block) = self.recording.next_block().map_err(of_driver)? else { return Ok(false) };
        let device_us = block.device_us;
        let track = block.track;
        let Some(at) = self.streams.iter().position(|s| s.track == track) else {
            match &mut self.motion {
                Some(unit) if unit.track() == track => {
                    block.frames().for_each(|f| unit.take(f, device_us, self.origin_ns));
                }
                _ => self.others += 1,
            }
            return Ok(true);
        };
        let pixels: Vec<_> = block.frames().map(<[u8]>::to_vec).collect();
        for data in pixels {
            self.image(at, device_us, &data);
        }
        Ok(true)
    }

    /// Puts an image into its capture.
    fn image(&mut self, at: usize, device_us: u64, data: &[u8]) {
        let Some(s) = self.streams.get_mut(at) else { return };
        let frame = s.frame(at, device_us, self.origin_ns, self.period_us, data);
        let frame = match frame {
            Ok(frame) => frame,
            Err(reason) => {
                s.dropped.add(reason, 1);
                let what =
                    format!("{}: the image at {device_us} us is damaged ({})", s.record.id, reason.name());
                self.lose(what);
                return;
            }
        };
        let (color, depth) = self.delays_us;
        let at_us = device_us.saturating_add(if s.kind == TrackKind::Color { color } else { depth });
        let half = self.period_us / 2;
        let is_free =
            |c: &Capture| c.at_us.abs_diff(at_us) < half && c.frames.get(at).is_some_and(Option::is_none);
        let place = self.open.iter().position(is_free).unwrap_or_else(|| {
            let place = self.open.partition_point(|c| c.at_us < at_us);
            let frames = self.streams.iter().map(|_| None).collect();
            self.open.insert(place, Capture { at_us, frames });
            place
        });
        if let Some(slot) = self.open.get_mut(place).and_then(|c| c.frames.get_mut(at)) {
            *slot = Some(frame);
        }
    }

    fn lose(&mut self, what: String) {
        if self.facts.lost < MOST_REPORTED {
            self.facts.lose(what);
        } else {
            self.facts.lost += 1;
        }
    }

    /// The oldest capture, when nothing can be added to it any more.
    fn ready(&mut self) -> Option<Capture> {
        let first = self.open.front()?;
        let newest = self.open.back().map_or(0, |c| c.at_us);
        let is_whole = first.frames.iter().all(Option::is_some);
        let is_past = newest.saturating_sub(first.at_us) > 2 * self.period_us || self.open.len() > MOST_OPEN;
        if is_whole || is_past || self.ended { self.open.pop_front() } else { None }
    }

    fn set(&mut self, capture: Capture) -> RecordSet {
        self.sets += 1;
        let missing = (0..).zip(&capture.frames).filter(|(_, f)| f.is_none()).map(|(i, _)| i).collect();
        let mut frames: Vec<RecordFrame> = capture.frames.into_iter().flatten().collect();
        for f in &mut frames {
            let Some(s) = self.streams.get_mut(f.stream) else { continue };
            s.sequence += 1;
            f.header.sequence = s.sequence;
            f.header.captured = s.sequence.saturating_add(s.dropped.total());
            f.header.dropped = s.dropped.0;
        }
        let times = || frames.iter().map(|f| f.header.capture_time_ns);
        let first = times().min().unwrap_or(0);
        RecordSet {
            id: self.sets,
            tick: HostTime::from_ns(first),
            // Times of an import count from 1970: its own zero of the monotonic clock.
            utc: UtcPair::default(),
            missing,
            motion: Vec::new(),
            signals: Vec::new(),
            spread_ns: times().max().unwrap_or(0).saturating_sub(first),
            frames,
        }
    }

    /// Records the facts that are known only at the end.
    fn finish(&mut self) {
        self.ended = true;
        let losses = self.recording.losses();
        if losses.places > 0 {
            let places = losses.places;
            let bytes = losses.bytes;
            let cut = if self.recording.facts().is_cut { "; the file was cut off" } else { "" };
            let places = if places == 1 { "one place".to_owned() } else { format!("{places} places") };
            self.facts.lose(format!(
                "{}: {bytes} bytes at {places} are damaged or cut off and left out{cut}",
                self.path.display()
            ));
        }
    }

    /// Counts of data that was read and that a dataset does not hold.
    fn left_out(&self) -> BTreeMap<String, u64> {
        let motion = self.motion.as_ref().map_or(0, motion::Unit::left_out);
        let counts = [("motion_samples", motion), ("blocks_of_other_tracks", self.others)];
        counts.into_iter().filter(|(_, n)| *n > 0).map(|(what, n)| (what.to_owned(), n)).collect()
    }
}

impl Stream {
    /// A frame of this stream; `DeviceGap`s before it are counted.
    fn frame(
        &mut self,
        index: usize,
        device_us: u64,
        origin_ns: i64,
        period_us: u64,
        data: &[u8],
    ) -> core::result::Result<RecordFrame, DropReason> {
        let r = &self.record;
        let number = match self.newest {
            None => 0,
            Some((_, then)) if device_us <= then => return Err(DropReason::OutOfOrder),
            Some((number, then)) => {
                let periods = ((device_us - then).saturating_add(period_us / 2) / period_us).max(1);
                self.dropped.add(DropReason::DeviceGap, periods - 1);
                number + periods
            }
        };
        self.newest = Some((number, device_us));
        let mut pixels = vec![0; r.format.frame_bytes(r.width, r.height)];
        match self.pixels {
            Some(Pixels::Mjpg) => {
                pixels = unpack::jpeg_span(data)?.to_vec();
                if pixels.len() > r.format.frame_bytes(r.width, r.height) {
                    return Err(DropReason::WrongSize);
                }
            }
            Some(Pixels::Gray16Be) => unpack::copy_swapped(data, &mut pixels)?,
            Some(Pixels::Bgra) => {
                unpack::drop_alpha(data, r.width as usize * 4, r.width as usize, &mut pixels)?;
            }
            _ if data.len() > pixels.len() => return Err(DropReason::WrongSize),
            _ => unpack::copy_rows(data, pixels.len(), pixels.len(), &mut pixels)?,
        }
        let device_ns = i64::try_from(device_us).unwrap_or(i64::MAX / 1000).saturating_mul(1000);
        let capture_time_ns = origin_ns.saturating_add(device_ns);
        let mut header = FrameHeader {
            device_sequence: number,
            device_time: device_us,
            device_tick_ns: 1000.0,
            capture_time_ns,
            // The device's clock counts microseconds.
            capture_uncertainty_ns: 1000,
            arrival_time_ns: capture_time_ns,
            publish_time_ns: capture_time_ns,
            depth_unit_m: r.depth_unit_m,
            intrinsics: r.intrinsics,
            pose: r.pose,
            clock_domain: ClockDomain::Device as u32,
            ..FrameHeader::default()
        };
        header.set_names("rig", &r.id);
        header.set_device(&r.model, &r.serial);
        header.set_image(r.format, r.width, r.height);
        if r.format == PixelFormat::Mjpeg {
            header.payload_len = pixels.len() as u32;
        }
        Ok(RecordFrame { stream: index, header, pixels: Box::new(pixels) })
    }
}

impl Importer for KinectImport {
    fn format(&self) -> &'static str {
        FORMAT
    }

    fn session(&mut self) -> Result<Session> {
        let facts = self.recording.facts();
        let mut session = Session::new(self.options.name.clone(), "rig");
        session.host = String::new();
        let start_ns = i64::try_from(facts.start_offset_ns).unwrap_or(0);
        session.started_utc_ns = self.origin_ns.saturating_add(start_ns);
        session.streams = self.streams.iter().map(|s| s.record.clone()).collect();
        session.motion = self.motion.iter().map(|unit| unit.record().clone()).collect();
        let mut table = toml::Table::new();
        let mut put = |key: &str, value: toml::Value| drop(table.insert(key.to_owned(), value));
        put("format", FORMAT.into());
        put("from", self.path.file_name().unwrap_or_default().to_string_lossy().into_owned().into());
        put("depthrig_version", env!("CARGO_PKG_VERSION").into());
        put("stated", toml::Value::Array(self.facts.stated.iter().cloned().map(Into::into).collect()));
        put("written_by", facts.written_by.clone().into());
        put("color_firmware", facts.color_firmware.clone().into());
        put("depth_firmware", facts.depth_firmware.clone().into());
        put("color_mode", facts.color_mode.map(ColorMode::tag).unwrap_or_default().into());
        put("depth_mode", facts.depth_mode.map(DepthMode::name).unwrap_or_default().into());
        put("wired_sync", facts.wired_sync.name().into());
        put("depth_delay_ns", facts.depth_delay_ns.into());
        put("subordinate_delay_ns", i64::try_from(facts.subordinate_delay_ns).unwrap_or(i64::MAX).into());
        put("start_offset_ns", start_ns.into());
        // All of it: metric radius, motion sensors and fields of later versions.
        if let Some(text) = facts.calibration.as_deref().and_then(|t| core::str::from_utf8(t).ok()) {
            put("calibration_json", text.trim_end_matches('\0').into());
        }
        session.extra.insert("import".to_owned(), table.into());
        Ok(session)
    }

    fn next(&mut self) -> Result<Option<RecordSet>> {
        loop {
            if let Some(capture) = self.ready() {
                let newest = self.set(capture);
                let Some(mut set) = self.held.replace(newest) else { continue };
                if let Some(unit) = &mut self.motion {
                    unit.hand_over(&mut set);
                }
                return Ok(Some(set));
            }
            if self.ended {
                let mut last = self.held.take();
                if let Some(unit) = &mut self.motion {
                    unit.end(last.as_mut());
                }
                return Ok(last);
            }
            if !self.block()? {
                self.finish();
            }
        }
    }

    fn progress(&self) -> ImportProgress {
        let (done, total) = self.recording.progress();
        ImportProgress { done, total }
    }

    fn facts(&self) -> ImportFacts {
        let mut facts = self.facts.clone();
        if let Some(unit) = &self.motion {
            facts.stated.push(format!(
                "{} samples of accelerometer and gyroscope came over, {} were left out",
                unit.samples(),
                unit.left_out()
            ));
        }
        facts.left_out = self.left_out();
        let account = |(i, s): (usize, &Stream)| {
            // A set that was not handed on when the import was ended is not in the dataset.
            let held = self.held.iter().flat_map(|set| &set.frames).filter(|f| f.stream == i).count() as u64;
            let delivered = s.sequence - held;
            StreamAccount {
                stream: s.record.id.clone(),
                captured: delivered.saturating_add(s.dropped.total()),
                delivered,
                dropped: s.dropped,
            }
        };
        facts.accounts = self.streams.iter().enumerate().map(account).collect();
        facts.accounts.extend(self.motion.as_ref().map(motion::Unit::account));
        facts
    }
}

fn of_driver(e: depthrig_driver::Error) -> Error {
    let kind = match e.kind() {
        depthrig_driver::ErrorKind::NotFound => ErrorKind::NotFound,
        depthrig_driver::ErrorKind::PermissionDenied => ErrorKind::PermissionDenied,
        depthrig_driver::ErrorKind::Io => ErrorKind::Io,
        _ => ErrorKind::BadRecording,
    };
    Error::new(kind, e.to_string()).with_source(e)
}
