//! ByteCameraDepth folders as a dataset, with or without the times and calibration that an export of ours has.

use super::calibration::{Calibration, SessionFacts};
use super::pictures::{MAX_FILE, Picture, Want, read};
use super::rows::{Row, head};
use super::{CALIBRATION_FILE, FORMAT, FRAMES_FILE, names};
use crate::exchange::{ImportFacts, ImportProgress, Importer};
use crate::fs::{Fs, ReadFile};
use crate::{Error, ErrorKind, RecordFrame, RecordSet, Result, Session, StreamAccount, StreamRecord};
use depthrig_bus::{
    ClockDomain, DropCounts, DropReason, FrameFlags, FrameHeader, HostTime, Intrinsics, PixelFormat, Pose,
    StreamId, UtcPair,
};
use std::collections::{BTreeMap, BTreeSet};
use std::io::{self, BufRead, BufReader, Read};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use time::{Date, Month, PrimitiveDateTime, Time};

/// Rate at which the published dataset was recorded, Hz.
const USUAL_RATE_HZ: f64 = 5.0;
/// Longest line of `frames.csv`, bytes; ours have a few hundred.
const LINE_MAX: u64 = 64 << 10;

/// What the folders do not say.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ByteCameraOptions {
    /// Metres per unit of 16-bit depth, of all cameras.
    pub depth_unit_m: Option<f64>,
    /// The same of single cameras, by the name of the camera or of its folder.
    pub camera_depth_unit_m: BTreeMap<String, f64>,
    /// Sets in a second, where there is no `frames.csv`.
    pub rate_hz: Option<f64>,
    /// Name of the dataset.
    pub name: String,
}

/// The importer of one session's folder.
pub struct ByteCameraImport {
    fs: Arc<dyn Fs>,
    dir: PathBuf,
    options: ByteCameraOptions,
    session: SessionFacts,
    streams: Vec<Stream>,
    list: List,
    facts: ImportFacts,
    alpha_dropped: u64,
    done: u64,
    total: u64,
}

/// One kind of file in one folder.
struct Stream {
    folder: String,
    prefix: String,
    ending: String,
    want: Want,
    /// The name of each number's file where it is not the plain one (`depth_007.png`), and which numbers there are.
    files: BTreeMap<u32, Option<String>>,
    record: StreamRecord,
    /// The unit of depth is another one than the files say.
    unit_given: bool,
    sequence: u64,
    dropped: DropCounts,
    /// The number of the last frame, to see what is missing between it and the next.
    last: Option<u32>,
    /// The header of the last frame, where the files say it.
    told: Option<FrameHeader>,
}

/// Where the sets come from.
enum List {
    /// `frames.csv`, at this line; the row is the first one of the next set.
    Rows { lines: Box<dyn BufRead + Send>, line: u64, next: Option<Box<Row>> },
    /// The numbers of the files.
    Numbers { numbers: Vec<u32>, at: usize, start_utc_ns: i64, period_ns: i64 },
}

/// A file as a stream of bytes.
struct Bytes {
    file: Box<dyn ReadFile>,
    at: u64,
    size: u64,
}

impl Read for Bytes {
    fn read(&mut self, buf: &mut [u8]) -> io::Result<usize> {
        let n = buf.len().min(usize::try_from(self.size - self.at).unwrap_or(usize::MAX));
        self.file.read_exact_at(&mut buf[..n], self.at)?;
        self.at += n as u64;
        Ok(n)
    }
}

fn bad(path: &Path, why: impl core::fmt::Display) -> Error {
    Error::new(ErrorKind::BadInput, format!("{}: {why}", path.display()))
}

impl ByteCameraImport {
    /// Looks at the folder `dir` of a session, which holds `camera_…` folders. One picture of each kind is read.
    ///
    /// # Errors
    /// [`ErrorKind::NotFound`] or [`ErrorKind::BadInput`] when it holds no such folders or they contradict
    /// `calibration.json` or `frames.csv`, [`ErrorKind::Io`].
    pub fn open(fs: Arc<dyn Fs>, dir: &Path, options: ByteCameraOptions) -> Result<Self> {
        for unit in options.depth_unit_m.iter().chain(options.camera_depth_unit_m.values()) {
            if !(1e-6..=1.0).contains(unit) {
                return Err(bad(dir, format_args!("a depth unit of {unit} m makes no sense; 1 mm is 0.001")));
            }
        }
        if options.rate_hz.is_some_and(|r| !(1e-3..=1e4).contains(&r)) {
            return Err(bad(dir, "a rate is a number of sets in a second, such as 5"));
        }
        let found = list(&*fs, dir)?;
        let calibration = match read_file(&*fs, &dir.join(CALIBRATION_FILE))? {
            Some(text) => Some(Calibration::parse(&text, &dir.join(CALIBRATION_FILE))?),
            None => None,
        };
        let mut import = Self {
            fs,
            dir: dir.to_owned(),
            options,
            session: SessionFacts::default(),
            streams: Vec::new(),
            list: List::Numbers { numbers: Vec::new(), at: 0, start_utc_ns: 0, period_ns: 1 },
            facts: ImportFacts::default(),
            alpha_dropped: 0,
            done: 0,
            total: 0,
        };
        match calibration {
            Some(c) => import.described(c, found)?,
            None => import.inferred(found)?,
        }
        import.total = import.streams.iter().map(|s| s.files.len() as u64).sum();
        import.find_times()?;
        Ok(import)
    }

    fn state(&mut self, what: String) {
        self.facts.stated.push(what);
    }

    /// Streams as `calibration.json` describes them.
    fn described(&mut self, calibration: Calibration, mut found: Found) -> Result<()> {
        for s in calibration.streams {
            let files = found.remove(&(s.folder.clone(), s.prefix.clone(), s.ending.clone()));
            let mut record = s.stream;
            let given = self.given_unit(record.id.camera.as_str(), &s.folder);
            let given = given.filter(|u| record.format == PixelFormat::Z16 && *u != record.depth_unit_m);
            if let Some(unit) = given {
                let said = std::mem::replace(&mut record.depth_unit_m, unit);
                let id = &record.id;
                self.state(format!("{id}: depth unit {unit} m as given, {CALIBRATION_FILE} says {said}"));
            }
            let want = Want::Exactly(record.format, record.width, record.height);
            let files = files.unwrap_or_default();
            let mut stream = Stream::new(s.folder, s.prefix, s.ending, want, files, record);
            stream.unit_given = given.is_some();
            self.streams.push(stream);
        }
        self.session = calibration.session;
        if self.streams.is_empty() {
            return Err(bad(&self.dir.join(CALIBRATION_FILE), "it names no streams"));
        }
        self.state(format!("intrinsics, poses and depth units are those of {CALIBRATION_FILE}"));
        for ((folder, prefix, ending), files) in found {
            self.state(format!(
                "{folder}/{prefix}_N.{ending}: {} files that {CALIBRATION_FILE} does not name are left out",
                files.len()
            ));
        }
        Ok(())
    }

    /// Streams as the names of folders and files and the first picture of each tell them.
    fn inferred(&mut self, found: Found) -> Result<()> {
        let mut cameras: BTreeMap<String, (String, String)> = BTreeMap::new();
        for ((folder, prefix, ending), files) in found {
            let want = match (prefix.as_str(), ending.as_str()) {
                ("raw_depth", "npy") => Want::Metres,
                (p, "png") if p == "depth" || p.starts_with("depth_") => Want::Depth,
                (p, "png") if p.ends_with("color") => Want::Color,
                (p, "png") if p.starts_with("ir") => Want::Grey,
                _ => {
                    self.state(format!(
                        "{folder}/{prefix}_N.{ending}: {} files are left out, a dataset has no such stream",
                        files.len()
                    ));
                    continue;
                }
            };
            let part = folder.strip_prefix("camera_").unwrap_or(&folder);
            let (mut name, model) = names::camera_of(part);
            if let Some((known, _)) = cameras.get(&folder) {
                name = names::name(known);
            } else {
                let plain = name.clone();
                let mut n = 2;
                while cameras.values().any(|(taken, _)| taken == name.as_str()) {
                    name = names::name(&format!("{plain}_{n}"));
                    n += 1;
                }
                cameras.insert(folder.clone(), (name.to_string(), model.clone()));
            }
            let stream = match prefix.as_str() {
                "R_color" => "color_right".to_owned(),
                other => names::name(other).to_string(),
            };
            let id = StreamId::new(name.as_str(), &stream).map_err(|e| bad(&self.dir.join(&folder), e))?;
            if self.streams.iter().any(|s| s.record.id == id) {
                return Err(bad(&self.dir.join(&folder), format_args!("stream {id} is there twice")));
            }
            let record = StreamRecord {
                id: id.clone(),
                model: model.clone(),
                serial: String::new(),
                format: PixelFormat::Z16,
                width: 0,
                height: 0,
                rate_hz: 0.0,
                depth_unit_m: 0.0,
                calibration: "none: the folders hold no calibration".to_owned(),
                intrinsics: Intrinsics::default(),
                pose: Pose::IDENTITY,
            };
            let mut stream = Stream::new(folder.clone(), prefix, ending, want, files, record);
            let Some(first) = self.first_picture(&mut stream)? else { continue };
            let r = &mut stream.record;
            (r.format, r.width, r.height) = (first.format, first.width, first.height);
            if r.format == PixelFormat::Z16 {
                r.depth_unit_m = self.unit(&id, &folder, &model, &first.pixels);
            } else if r.format == PixelFormat::DepthF32 {
                r.depth_unit_m = 1.0;
            }
            self.streams.push(stream);
        }
        if self.streams.is_empty() {
            return Err(bad(
                &self.dir,
                "it holds no folder camera_<model> with depth_N.png, color_N.png, ir_N.png or raw_depth_N.npy",
            ));
        }
        "rig".clone_into(&mut self.session.rig);
        self.state("there is no calibration.json: no intrinsics, no poses".to_owned());
        Ok(())
    }

    /// The first picture of a stream that can be read; it says format and size.
    fn first_picture(&mut self, stream: &mut Stream) -> Result<Option<Picture>> {
        let numbers: Vec<u32> = stream.files.keys().copied().collect();
        for n in numbers {
            if let Ok(picture) = self.picture(stream, n)? {
                return Ok(Some(picture));
            }
        }
        for n in stream.files.keys() {
            let path = stream.path(*n);
            self.facts.lose(format!("{path}: no file of its kind can be read, the stream is left out"));
        }
        Ok(None)
    }

    fn given_unit(&self, camera: &str, folder: &str) -> Option<f64> {
        let part = folder.strip_prefix("camera_").unwrap_or(folder);
        let one = [camera, folder, part].into_iter().find_map(|n| self.options.camera_depth_unit_m.get(n));
        one.copied().or(self.options.depth_unit_m)
    }

    /// The depth unit as given, else as inferred; it is stated.
    fn unit(&mut self, id: &StreamId, folder: &str, model: &str, pixels: &[u8]) -> f64 {
        let mut values: Vec<u16> = pixels.as_chunks().0.iter().map(|v| u16::from_le_bytes(*v)).collect();
        values.retain(|v| *v != 0 && *v != u16::MAX);
        let middle = values.len() / 2;
        let median = if values.is_empty() { 0 } else { *values.select_nth_unstable(middle).1 };
        let (unit, why) = if let Some(unit) = self.given_unit(id.camera.as_str(), folder) {
            (unit, "as given".to_owned())
        } else if let Some(unit) = names::usual_depth_unit_m(model) {
            (unit, format!("inferred from the model {model}, which comes so"))
        } else {
            // Indoors the middle of a picture is nearer than 8 m; in units of 0.1 mm it is then below 65535.
            let unit = if median > 8000 { 0.0001 } else { 0.001 };
            (unit, "inferred from the numbers of the first picture".to_owned())
        };
        let metres = f64::from(median) * unit;
        self.state(format!(
            "{id}: depth unit {unit} m {why}; the first picture's median is then {metres:.3} m"
        ));
        unit
    }

    /// Where the sets come from.
    fn find_times(&mut self) -> Result<()> {
        let path = self.dir.join(FRAMES_FILE);
        match self.fs.open(&path) {
            Ok(file) => {
                let size = file.size().map_err(|e| Error::io("read", &path, e))?;
                let lines = Box::new(BufReader::with_capacity(64 << 10, Bytes { file, at: 0, size }));
                self.list = List::Rows { lines, line: 0, next: None };
                let first = self.line()?;
                if first.as_deref() != Some(head().trim_end()) {
                    return Err(bad(
                        &path,
                        "its first line does not name the columns that depthrig writes; remove the file to import without times",
                    ));
                }
                let row = self.row()?;
                let Some(row) = row else { return Err(bad(&path, "it names no frames")) };
                if self.session.started_utc_ns == 0 {
                    self.session.started_utc_ns = row.set_utc_ns;
                }
                self.put_back(row);
                self.state(format!("times, counters and set numbers are those of {FRAMES_FILE}"));
                return Ok(());
            }
            Err(e) if e.kind() == io::ErrorKind::NotFound => {}
            Err(e) => return Err(Error::io("open", &path, e)),
        }
        let numbers: BTreeSet<u32> = self.streams.iter().flat_map(|s| s.files.keys().copied()).collect();
        let rate = self.options.rate_hz.unwrap_or(USUAL_RATE_HZ);
        let how = if self.options.rate_hz.is_some() { "as given" } else { "assumed" };
        self.state(format!("there is no {FRAMES_FILE}: times follow from the numbers of the files at {rate} Hz, {how}; the same number is the same set"));
        let folder = self.dir.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let start = start_of(&folder);
        self.state(match start {
            Some(_) => format!("the start is the folder's name {folder}, taken as UTC"),
            None => format!("the folder's name {folder} is no date YYYYMMDD_HHMM: the start is 1970-01-01"),
        });
        let numbers: Vec<u32> = numbers.into_iter().collect();
        let holes = numbers.windows(2).map(|w| u64::from(w[1] - w[0] - 1)).sum::<u64>();
        if holes > 0 {
            self.facts.lost += holes;
            self.facts
                .problems
                .push(format!("{holes} numbers between the first and the last are in no folder"));
        }
        for s in &mut self.streams {
            s.record.rate_hz = rate;
        }
        self.tell_holes(&numbers);
        if self.session.started_utc_ns == 0 {
            self.session.started_utc_ns = start.unwrap_or(0);
        }
        let period_ns = (1e9 / rate).round() as i64;
        self.list = List::Numbers { numbers, at: 0, start_utc_ns: start.unwrap_or(0), period_ns };
        Ok(())
    }

    /// States of each stream how many of the numbers it has not.
    fn tell_holes(&mut self, numbers: &[u32]) {
        for i in 0..self.streams.len() {
            let s = &self.streams[i];
            let missing = numbers.len() - s.files.len();
            if missing > 0 {
                let first = numbers.iter().find(|n| !s.files.contains_key(n));
                let what = format!(
                    "{}: {missing} of {} sets have no file {}/{}_N.{}, the first is number {}",
                    s.record.id,
                    numbers.len(),
                    s.folder,
                    s.prefix,
                    s.ending,
                    first.unwrap_or(&0)
                );
                self.state(what);
            }
        }
    }

    /// The file `n` of a stream; the inner error is of that file alone.
    fn picture(&self, stream: &Stream, n: u32) -> Result<Result<Picture, String>> {
        let path = self.dir.join(stream.path(n));
        match read_file(&*self.fs, &path) {
            Ok(Some(bytes)) => Ok(read(&bytes, &stream.ending, stream.want)),
            Ok(None) => Ok(Err("it is not there".to_owned())),
            Err(e) if e.kind() == ErrorKind::Io => Err(e),
            Err(e) => Ok(Err(e.to_string())),
        }
    }

    /// The next line of `frames.csv`.
    fn line(&mut self) -> Result<Option<String>> {
        let path = self.dir.join(FRAMES_FILE);
        let List::Rows { lines, line, .. } = &mut self.list else { return Ok(None) };
        *line += 1;
        let mut bytes = Vec::new();
        lines
            .by_ref()
            .take(LINE_MAX)
            .read_until(b'\n', &mut bytes)
            .map_err(|e| Error::io("read", &path, e))?;
        if bytes.is_empty() {
            return Ok(None);
        }
        if bytes.pop_if(|b| *b == b'\n').is_none() {
            return Err(bad(&path, format_args!("line {line} has no end: the file was cut")));
        }
        bytes.pop_if(|b| *b == b'\r');
        String::from_utf8(bytes).map(Some).map_err(|_| bad(&path, format_args!("line {line} is no text")))
    }

    fn row(&mut self) -> Result<Option<Box<Row>>> {
        if let List::Rows { next, .. } = &mut self.list
            && let Some(row) = next.take()
        {
            return Ok(Some(row));
        }
        let Some(text) = self.line()? else { return Ok(None) };
        let List::Rows { line, .. } = &self.list else { return Ok(None) };
        let path = self.dir.join(FRAMES_FILE);
        Row::parse(&text).map(|r| Some(Box::new(r))).map_err(|e| bad(&path, format_args!("line {line}: {e}")))
    }

    fn put_back(&mut self, row: Box<Row>) {
        if let List::Rows { next, .. } = &mut self.list {
            *next = Some(row);
        }
    }

    /// A set as `frames.csv` tells it.
    fn set_of_rows(&mut self) -> Result<Option<RecordSet>> {
        let Some(first) = self.row()? else {
            let unnamed = self.total.saturating_sub(self.done);
            if unnamed > 0 {
                self.facts.lost += unnamed;
                self.facts.problems.push(format!("{unnamed} files are not named in {FRAMES_FILE}"));
                self.done = self.total;
            }
            return Ok(None);
        };
        let mut set = RecordSet {
            id: first.set,
            tick: HostTime::from_ns(first.tick_ns),
            utc: UtcPair { utc_ns: first.utc_offset_ns, ..UtcPair::default() },
            frames: Vec::new(),
            missing: Vec::new(),
            spread_ns: first.spread_ns,
        };
        let id = first.set;
        let mut row = Some(first);
        while let Some(r) = row {
            if r.set != id {
                self.put_back(r);
                break;
            }
            if !r.file.is_empty() {
                self.frame_of_row(&r, &mut set)?;
            }
            row = self.row()?;
        }
        self.close(&mut set);
        Ok(Some(set))
    }

    fn frame_of_row(&mut self, row: &Row, set: &mut RecordSet) -> Result<()> {
        let Some(i) = self.streams.iter().position(|s| s.path(row.n) == row.file) else {
            self.facts.lose(format!("set {}: {} is of no stream that is imported", row.set, row.file));
            return Ok(());
        };
        if set.frames.iter().any(|f| f.stream == i) {
            return Err(bad(
                &self.dir.join(FRAMES_FILE),
                format_args!("set {} names {} twice", row.set, row.file),
            ));
        }
        self.done += 1;
        match self.picture(&self.streams[i], row.n)? {
            Ok(picture) => {
                let s = &mut self.streams[i];
                let mut header = row.header;
                s.fill(&mut header, &self.session.rig, &picture);
                s.told = Some(header);
                self.alpha_dropped += u64::from(picture.alpha_dropped);
                set.frames.push(RecordFrame { stream: i, header, pixels: Box::new(picture.pixels) });
            }
            Err(why) => self.facts.lose(format!("{}: {why}", row.file)),
        }
        Ok(())
    }

    /// A set as the numbers of the files tell it.
    fn set_of_number(&mut self) -> Result<Option<RecordSet>> {
        let List::Numbers { numbers, at, start_utc_ns, period_ns } = &mut self.list else { return Ok(None) };
        let (Some(n), Some(first)) = (numbers.get(*at).copied(), numbers.first()) else { return Ok(None) };
        *at += 1;
        let tick = i64::from(n - first) * *period_ns;
        let (period, start) = (*period_ns, *start_utc_ns);
        let mut set = RecordSet {
            id: u64::from(n) + 1,
            tick: HostTime::from_ns(tick),
            utc: UtcPair { utc_ns: start, ..UtcPair::default() },
            frames: Vec::new(),
            missing: Vec::new(),
            spread_ns: 0,
        };
        for i in 0..self.streams.len() {
            if !self.streams[i].files.contains_key(&n) {
                continue;
            }
            self.done += 1;
            let read = self.picture(&self.streams[i], n)?.and_then(|p| self.streams[i].check(p));
            let s = &mut self.streams[i];
            s.dropped.add(DropReason::DeviceGap, s.last.map_or(0, |last| u64::from(n - last - 1)));
            s.last = Some(n);
            match read {
                Ok(picture) => {
                    s.sequence += 1;
                    let mut header = FrameHeader {
                        sequence: s.sequence,
                        device_sequence: u64::from(n),
                        device_time: u64::from(n),
                        device_tick_ns: period as f64,
                        capture_time_ns: tick,
                        capture_uncertainty_ns: period.unsigned_abs(),
                        arrival_time_ns: tick,
                        publish_time_ns: tick,
                        captured: s.sequence + s.dropped.total(),
                        dropped: s.dropped.0,
                        depth_unit_m: s.record.depth_unit_m,
                        clock_domain: ClockDomain::Arrival as u32,
                        flags: FrameFlags::TIME_UNCERTAIN.0,
                        ..FrameHeader::default()
                    };
                    s.fill(&mut header, &self.session.rig, &picture);
                    s.told = Some(header);
                    self.alpha_dropped += u64::from(picture.alpha_dropped);
                    set.frames.push(RecordFrame { stream: i, header, pixels: Box::new(picture.pixels) });
                }
                Err(why) => {
                    s.dropped.add(DropReason::Incomplete, 1);
                    let path = s.path(n);
                    self.facts.lose(format!("{path}: {why}"));
                }
            }
        }
        self.close(&mut set);
        Ok(Some(set))
    }

    fn close(&self, set: &mut RecordSet) {
        set.missing =
            (0..self.streams.len()).filter(|i| !set.frames.iter().any(|f| f.stream == *i)).collect();
    }
}

impl Stream {
    fn new(
        folder: String,
        prefix: String,
        ending: String,
        want: Want,
        files: BTreeMap<u32, Option<String>>,
        record: StreamRecord,
    ) -> Self {
        let dropped = DropCounts::default();
        Self {
            folder,
            prefix,
            ending,
            want,
            files,
            record,
            unit_given: false,
            sequence: 0,
            dropped,
            last: None,
            told: None,
        }
    }

    /// The file of a number, below the folder of the session.
    fn path(&self, n: u32) -> String {
        match self.files.get(&n) {
            Some(Some(name)) => format!("{}/{name}", self.folder),
            _ => format!("{}/{}_{n}.{}", self.folder, self.prefix, self.ending),
        }
    }

    /// Refuses a picture that is not like the first one.
    fn check(&self, picture: Picture) -> Result<Picture, String> {
        let r = &self.record;
        if (picture.format, picture.width, picture.height) == (r.format, r.width, r.height) {
            return Ok(picture);
        }
        let said = format!("{}x{} {}", r.width, r.height, r.format.name());
        Err(format!(
            "it is {}x{} {}, its stream is {said}",
            picture.width,
            picture.height,
            picture.format.name()
        ))
    }

    /// What the stream says of each of its frames.
    fn fill(&self, header: &mut FrameHeader, rig: &str, picture: &Picture) {
        header.set_names(rig, &self.record.id);
        header.set_device(&self.record.model, &self.record.serial);
        header.set_picture(picture.format, picture.width, picture.height);
        (header.intrinsics, header.pose) = (self.record.intrinsics, self.record.pose);
        if self.unit_given {
            header.depth_unit_m = self.record.depth_unit_m;
        }
    }

    fn account(&self) -> StreamAccount {
        let (captured, delivered, dropped) = match &self.told {
            Some(h) if self.sequence == 0 => {
                (h.captured, h.captured.saturating_sub(h.drops().total()), h.drops())
            }
            _ => (self.sequence + self.dropped.total(), self.sequence, self.dropped),
        };
        StreamAccount { stream: self.record.id.clone(), captured, delivered, dropped }
    }
}

impl Importer for ByteCameraImport {
    fn format(&self) -> &'static str {
        FORMAT
    }

    fn session(&mut self) -> Result<Session> {
        let rig = if self.session.rig.is_empty() { "rig" } else { &self.session.rig };
        let mut session = Session::new(self.options.name.clone(), rig);
        session.scene.clone_from(&self.session.scene);
        session.operator.clone_from(&self.session.operator);
        session.host.clone_from(&self.session.host);
        session.rig_config.clone_from(&self.session.rig_config);
        session.started_utc_ns = self.session.started_utc_ns;
        session.streams = self.streams.iter().map(|s| s.record.clone()).collect();
        session
            .extra
            .insert("import".to_owned(), crate::exchange::import::table(FORMAT, &self.dir, &self.facts));
        Ok(session)
    }

    fn next(&mut self) -> Result<Option<RecordSet>> {
        if matches!(self.list, List::Rows { .. }) { self.set_of_rows() } else { self.set_of_number() }
    }

    fn progress(&self) -> ImportProgress {
        ImportProgress { done: self.done.min(self.total), total: self.total }
    }

    fn facts(&self) -> ImportFacts {
        let mut facts = self.facts.clone();
        facts.accounts = self.streams.iter().map(Stream::account).collect();
        if self.alpha_dropped > 0 {
            facts
                .stated
                .push(format!("{} colour pictures had an opacity, which is left out", self.alpha_dropped));
        }
        facts
    }
}

/// The files of each folder, prefix and ending by their numbers, with the name where it is not the plain one.
type Found = BTreeMap<(String, String, String), BTreeMap<u32, Option<String>>>;

fn list(fs: &dyn Fs, dir: &Path) -> Result<Found> {
    let mut found = Found::new();
    for folder in fs.read_dir(dir).map_err(|e| Error::io("list", dir, e))? {
        if !folder.is_dir || !folder.name.starts_with("camera_") {
            continue;
        }
        let path = dir.join(&folder.name);
        for file in fs.read_dir(&path).map_err(|e| Error::io("list", &path, e))? {
            let Some((prefix, n, ending)) = names::file_parts(&file.name).filter(|_| !file.is_dir) else {
                continue;
            };
            let plain = format!("{prefix}_{n}.{ending}");
            let key = (folder.name.clone(), prefix.to_owned(), ending.to_owned());
            let name = (file.name != plain).then(|| file.name.clone());
            if found.entry(key).or_default().insert(n, name).is_some() {
                return Err(bad(
                    &path,
                    format_args!(
                        "number {n} of {prefix}_N.{ending} is there twice, as {plain} and with leading zeros"
                    ),
                ));
            }
        }
    }
    Ok(found)
}

/// A whole file; `None` when it is not there.
fn read_file(fs: &dyn Fs, path: &Path) -> Result<Option<Vec<u8>>> {
    let file = match fs.open(path) {
        Ok(file) => file,
        Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(None),
        Err(e) => return Err(Error::io("open", path, e)),
    };
    let size = file.size().map_err(|e| Error::io("read", path, e))?;
    if size > MAX_FILE {
        return Err(bad(path, format_args!("it has {size} bytes, more than any picture")));
    }
    let mut bytes = vec![0; size as usize];
    file.read_exact_at(&mut bytes, 0).map_err(|e| Error::io("read", path, e))?;
    Ok(Some(bytes))
}

/// UTC of `YYYYMMDD_HHMM`, nanoseconds since 1970.
fn start_of(folder: &str) -> Option<i64> {
    let text = folder.get(..13)?;
    let number = |at: std::ops::Range<usize>| text.get(at)?.parse::<u16>().ok();
    let month = Month::try_from(u8::try_from(number(4..6)?).ok()?).ok()?;
    let date =
        Date::from_calendar_date(i32::from(number(0..4)?), month, u8::try_from(number(6..8)?).ok()?).ok()?;
    let time =
        Time::from_hms(u8::try_from(number(9..11)?).ok()?, u8::try_from(number(11..13)?).ok()?, 0).ok()?;
    i64::try_from(PrimitiveDateTime::new(date, time).assume_utc().unix_timestamp_nanos()).ok()
}
