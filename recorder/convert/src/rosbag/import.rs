//! A bag of librealsense as a dataset.

use super::FORMAT;
use super::bag::{Bag, Unpacked};
use super::messages::image;
use super::sets::{Set, group};
use crate::bytecamera::{camera_name, free_name};
use crate::{ImportFacts, ImportProgress, Importer, import as driver};
use depthrig_bus::{
    ClockDomain, DropCounts, DropReason, FrameFlags, FrameHeader, HostTime, Intrinsics, PixelFormat, Pose,
    StreamId, UtcPair,
};
use depthrig_recorder::fs::{Fs, ReadFile};
use depthrig_recorder::{
    Error, ErrorKind, RecordFrame, RecordSet, Result, Session, StreamAccount, StreamRecord,
};
use pose::pose_of;
use scan::{Frame, Refused, Scan};
use std::collections::BTreeMap;
use std::path::Path;

mod clocks;
mod pose;
mod scan;

/// The clock map of a bag with less than this has `CLOCK_WARMUP`, as that of a camera that just began.
const WARMUP_NS: i64 = 5_000_000_000;

/// The importer of one bag.
pub struct RosbagImport {
    bag: Bag,
    name: String,
    streams: Vec<Stream>,
    sets: Vec<Set>,
    at: usize,
    /// One unpacked chunk for each stream: their messages lie in turns.
    chunks: Vec<Unpacked>,
    facts: ImportFacts,
    options: toml::Table,
    facts_of_devices: toml::Table,
}

/// One stream of one sensor.
struct Stream {
    record: StreamRecord,
    frames: Vec<Frame>,
    sequence: u64,
    dropped: DropCounts,
    last_counter: Option<u64>,
}

impl RosbagImport {
    /// Reads the bag `path` once from front to back; images are read later.
    ///
    /// # Errors
    /// [`ErrorKind::NotFound`], [`ErrorKind::BadRecording`] when it is not a rosbag of version 2, is packed with bz2 or
    /// holds no frames of librealsense, [`ErrorKind::Io`]. Damage is counted in [`ImportFacts`].
    pub fn open(fs: &dyn Fs, path: &Path, name: String) -> Result<Self> {
        let file = fs.open(path).map_err(|e| Error::reading("open", path, e))?;
        Self::read(file, path, name)
    }

    fn read(file: Box<dyn ReadFile>, path: &Path, name: String) -> Result<Self> {
        let bag = Bag::open(file, path)?;
        let mut scan = Scan::default();
        let mut facts = ImportFacts::default();
        bag.messages(
            &mut |m| {
                scan.message(&m);
                Ok(())
            },
            &mut |damage| facts.lose(damage),
        )?;
        let mut import = Self {
            bag,
            name,
            streams: Vec::new(),
            sets: Vec::new(),
            at: 0,
            chunks: Vec::new(),
            facts,
            options: toml::Table::new(),
            facts_of_devices: toml::Table::new(),
        };
        import.streams(scan)?;
        import.facts.stated.extend(clocks::place(&mut import.streams));
        let times: Vec<Vec<i64>> =
            import.streams.iter().map(|s| s.frames.iter().map(|f| f.capture_ns).collect()).collect();
        import.sets = group(&times);
        import.chunks = import.streams.iter().map(|_| Unpacked::default()).collect();
        let spread = import.sets.iter().map(|s| import.spread(s)).max().unwrap_or(0);
        import.state(format!(
            "frames were put into sets by nearest capture time; the widest spread is {:.3} ms",
            spread as f64 / 1e6
        ));
        Ok(import)
    }

    fn state(&mut self, what: String) {
        self.facts.stated.push(what);
    }

    /// Counts images that cannot be imported, for one reason.
    fn lose(&mut self, images: u64, problem: String) {
        self.facts.lost = self.facts.lost.saturating_add(images.saturating_sub(1));
        self.facts.lose(problem);
    }

    /// Turns the results of the first pass into streams of cameras.
    fn streams(&mut self, scan: Scan) -> Result<()> {
        let mut cameras: BTreeMap<u32, (String, String, String)> = BTreeMap::new();
        for ((device, sensor, kind, index), found) in scan.streams {
            let facts = scan.devices.get(&device);
            let fact = |key: &str| facts.and_then(|f| f.get(key)).cloned().unwrap_or_default();
            if !cameras.contains_key(&device) {
                let model = fact("Name");
                let plain = camera_name(&model, &format!("device_{device}"));
                let taken = |name: &str| cameras.values().any(|(taken, ..)| taken == name);
                let camera = free_name(&plain, device, taken).to_string();
                cameras.insert(device, (camera, model, fact("Serial Number")));
            }
            let Some((camera, model, serial)) = cameras.get(&device).cloned() else { continue };
            let plain = kind.to_lowercase();
            let stream = if index == 0 { plain } else { format!("{plain}_{index}") };
            let stream = camera_name("", &stream);
            let topic = format!("/device_{device}/sensor_{sensor}/{kind}_{index}");
            if let Some(Refused { images, first }) = found.refused {
                let what = format!("{topic}: {images} images cannot be imported; the first: {first}");
                self.lose(images, what);
            }
            let (Some(format), Some((width, height))) = (found.format, found.size) else { continue };
            let id = StreamId::new(&camera, stream.as_str())
                .map_err(|e| Error::new(ErrorKind::BadRecording, format!("{topic}: {e}")).with_source(e))?;
            if self.streams.iter().any(|s| s.record.id == id) {
                let images = found.frames.len() as u64;
                self.lose(images, format!("{topic}: there is a stream {id} already, this one is left out"));
                continue;
            }
            let options = scan.options.get(&(device, sensor));
            let unit = options.and_then(|o| o.get("Depth Units")).copied();
            let depth_unit_m = match format {
                // The shortest number that is this float: 0.001, not 0.0010000000474974513.
                PixelFormat::Z16 => unit.and_then(|u| u.to_string().parse().ok()).unwrap_or(0.001),
                PixelFormat::DepthF32 => 1.0,
                _ => 0.0,
            };
            if format == PixelFormat::Z16 {
                let why = if unit.is_some() { "as the bag says" } else { "assumed, the bag does not say it" };
                self.state(format!("{id}: depth unit {depth_unit_m} m {why}"));
            }
            let known = found.info.filter(|(w, h, i)| (*w, *h) == (width, height) && i.is_known());
            let calibration =
                if known.is_some() { "factory, as librealsense wrote it into the bag" } else { "none" };
            let pose = found.to_color.and_then(pose_of);
            if pose.is_none() {
                self.state(format!("{id}: the bag has no pose, it is put where depth is"));
            }
            let record = StreamRecord {
                id,
                model,
                serial,
                format,
                width,
                height,
                rate_hz: found.rate_hz,
                depth_unit_m,
                calibration: calibration.to_owned(),
                intrinsics: known.map_or_else(Intrinsics::default, |(.., i)| i),
                pose: pose.unwrap_or(Pose::IDENTITY),
            };
            let dropped = DropCounts::default();
            self.streams.push(Stream {
                record,
                frames: found.frames,
                sequence: 0,
                dropped,
                last_counter: None,
            });
        }
        for (topic, n) in scan.others {
            self.state(format!(
                "{topic}: {n} messages are left out: motion and poses of a bag are not imported"
            ));
        }
        for ((device, sensor), options) in scan.options {
            let table = options.into_iter().map(|(k, v)| (k, f64::from(v).into())).collect::<toml::Table>();
            self.options.insert(format!("device_{device}/sensor_{sensor}"), table.into());
        }
        for (device, facts) in scan.devices {
            let table = facts.into_iter().map(|(k, v)| (k, v.into())).collect::<toml::Table>();
            self.facts_of_devices.insert(format!("device_{device}"), table.into());
        }
        if self.streams.is_empty() {
            return Err(Error::new(
                ErrorKind::BadRecording,
                format!(
                    "{} holds no images of librealsense (topics /device_0/sensor_0/Depth_0/image/data){}",
                    self.bag.path.display(),
                    self.facts.problems.first().map_or_else(String::new, |p| format!("; {p}"))
                ),
            ));
        }
        Ok(())
    }

    fn spread(&self, set: &Set) -> i64 {
        let times =
            set.frames.iter().enumerate().filter_map(|(s, f)| Some(self.streams[s].frames[(*f)?].capture_ns));
        let (low, high) = times.fold((i64::MAX, i64::MIN), |(low, high), t| (low.min(t), high.max(t)));
        high.saturating_sub(low).max(0)
    }

    /// The frame's header and pixels.
    fn frame(&mut self, stream: usize, index: usize, warmup: bool) -> Result<RecordFrame> {
        let s = &mut self.streams[stream];
        let f = &s.frames[index];
        let name = format!("{}: frame {} of {}", self.bag.path.display(), index, s.record.id);
        let damaged = |why: &str| Error::new(ErrorKind::Corrupt, format!("{name} {why}"));
        let place = f.place.ok_or_else(|| damaged("has no image"))?;
        let data = self.bag.message(place, &mut self.chunks[stream])?;
        let image = image(data).ok_or_else(|| damaged("ends too early"))?;
        let r = &s.record;
        let format = r.format;
        let step = image.step as usize;
        let row = format.row_bytes(r.width) as usize;
        let whole = step.checked_mul(r.height as usize).is_some_and(|n| n <= image.data.len());
        if (image.width, image.height) != (r.width, r.height)
            || image.format(format.is_depth()) != Some(format)
            || step < row
            || !whole
        {
            return Err(damaged(&format!(
                "is {}x{} {} with {step} bytes a row, its stream is {}x{} {}",
                image.width,
                image.height,
                image.encoding,
                r.width,
                r.height,
                format.name()
            )));
        }
        let mut pixels = Vec::with_capacity(row * r.height as usize);
        image
            .data
            .chunks(step.max(1))
            .take(r.height as usize)
            .for_each(|line| pixels.extend_from_slice(&line[..row]));
        if let (Some(last), Some(counter)) = (s.last_counter, f.counter) {
            s.dropped.add(DropReason::DeviceGap, counter.saturating_sub(last).saturating_sub(1).min(1 << 32));
        }
        s.last_counter = f.counter.or(s.last_counter);
        s.sequence += 1;
        let by_host = f.host_clock == Some(true) || f.arrival_ns.is_none();
        let domain = if by_host { ClockDomain::Arrival } else { ClockDomain::Device };
        let mut flags = 0;
        if domain == ClockDomain::Arrival {
            flags |= FrameFlags::TIME_UNCERTAIN.0;
        } else if warmup {
            flags |= FrameFlags::CLOCK_WARMUP.0;
        }
        let arrival = f.arrival_ns.unwrap_or(f.capture_ns);
        let mut header = FrameHeader {
            sequence: s.sequence,
            device_sequence: f.counter.unwrap_or(s.sequence),
            device_time: f.device_us,
            device_tick_ns: 1000.0,
            capture_time_ns: f.capture_ns,
            capture_uncertainty_ns: f.uncertainty_ns,
            arrival_time_ns: arrival,
            publish_time_ns: arrival,
            exposure_ns: f.exposure_us.unwrap_or(0).saturating_mul(1000),
            captured: s.sequence.saturating_add(s.dropped.total()),
            dropped: s.dropped.0,
            depth_unit_m: r.depth_unit_m,
            intrinsics: r.intrinsics,
            pose: r.pose,
            clock_domain: domain as u32,
            flags,
            gain: f.gain.unwrap_or(0.0),
            ..FrameHeader::default()
        };
        header.set_names("rig", &r.id);
        header.set_device(&r.model, &r.serial);
        header.set_image(format, r.width, r.height);
        Ok(RecordFrame { stream, header, pixels: Box::new(pixels) })
    }
}

impl Importer for RosbagImport {
    fn format(&self) -> &'static str {
        FORMAT
    }

    fn session(&mut self) -> Result<Session> {
        let mut session = Session::new(self.name.clone(), "rig");
        session.host = String::new();
        session.started_utc_ns = self.sets.first().map_or(0, |s| s.tick_ns);
        session.streams = self.streams.iter().map(|s| s.record.clone()).collect();
        let mut table = driver::table(FORMAT, &self.bag.path, &self.facts);
        if let toml::Value::Table(table) = &mut table {
            table.insert("devices".to_owned(), self.facts_of_devices.clone().into());
            table.insert("options".to_owned(), self.options.clone().into());
        }
        session.extra.insert("import".to_owned(), table);
        Ok(session)
    }

    fn next(&mut self) -> Result<Option<RecordSet>> {
        let length =
            self.sets.last().zip(self.sets.first()).map_or(0, |(b, a)| b.tick_ns.saturating_sub(a.tick_ns));
        let Some(set) = self.sets.get(self.at).cloned() else { return Ok(None) };
        self.at += 1;
        let mut out = RecordSet {
            id: self.at as u64,
            tick: HostTime::from_ns(set.tick_ns),
            // Times of an import count from 1970: its own zero of the monotonic clock.
            utc: UtcPair::default(),
            frames: Vec::new(),
            missing: Vec::new(),
            motion: Vec::new(),
            signals: Vec::new(),
            spread_ns: 0,
        };
        for (stream, frame) in set.frames.iter().enumerate() {
            let read = frame.map(|f| self.frame(stream, f, length < WARMUP_NS));
            match read {
                Some(Ok(frame)) => out.frames.push(frame),
                Some(Err(e)) if e.kind() == ErrorKind::Io => return Err(e),
                Some(Err(e)) => {
                    let s = &mut self.streams[stream];
                    s.dropped.add(DropReason::Incomplete, 1);
                    s.last_counter = frame.and_then(|f| s.frames[f].counter).or(s.last_counter);
                    self.facts.lose(e.to_string());
                    out.missing.push(stream);
                }
                None => out.missing.push(stream),
            }
        }
        let times = out.frames.iter().map(|f| f.header.capture_time_ns);
        out.spread_ns = times.clone().max().zip(times.min()).map_or(0, |(b, a)| b.saturating_sub(a));
        Ok(Some(out))
    }

    fn progress(&self) -> ImportProgress {
        ImportProgress { done: self.at as u64, total: self.sets.len() as u64 }
    }

    fn facts(&self) -> ImportFacts {
        let mut facts = self.facts.clone();
        facts.accounts = self
            .streams
            .iter()
            .map(|s| StreamAccount {
                stream: s.record.id.clone(),
                captured: s.sequence.saturating_add(s.dropped.total()),
                delivered: s.sequence,
                dropped: s.dropped,
            })
            .collect();
        facts
    }
}

/// A bag from any bytes: opened, and every set read; how many frames came out.
#[cfg(any(test, feature = "testing"))]
pub(crate) fn fuzz(file: Box<dyn ReadFile>) -> u64 {
    let Ok(mut import) = RosbagImport::read(file, Path::new("fuzz.bag"), "fuzz".to_owned()) else { return 0 };
    drop(import.session());
    let mut frames = 0;
    while let Ok(Some(set)) = import.next() {
        frames += set.frames.len() as u64;
    }
    assert!(import.facts().accounts.iter().all(StreamAccount::balances), "captured = delivered + dropped");
    frames
}
