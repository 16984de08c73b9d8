//! Where replayed sets come from: one or several datasets, read as the sets of one rig.

use super::session_clock::{SessionClock, Shift};
use super::signals::shifted;
use super::timeline::{Part, Timeline};
use crate::{Error, ErrorKind, Result};
use depthrig_bus::{FrameFlags, FrameHeader, HostTime, PixelFormat, RigName};
use depthrig_recorder::{
    ColorCodec, Computed, Dataset, DatasetFrame, DatasetSet, DepthCodec, MotionRecord, PixelMode,
    RecordMotion, RecordSignal, Session, SetReader, SignalRecord, StreamRecord,
};
use std::collections::BTreeSet;
use std::path::PathBuf;

/// Clocks of two datasets that agree within this are one clock of one computer: two boots, or two computers, differ
/// by hours.
const SAME_CLOCK_NS: i64 = 1_000_000_000;
/// Sets that are looked at to learn how images are stored.
const LOOK_AT: usize = 8;

/// Datasets that are replayed as one rig.
pub struct Sources {
    list: Vec<Source>,
    rig: RigName,
    streams: Vec<StreamRecord>,
    units: Vec<MotionRecord>,
    signals: Vec<SignalRecord>,
    /// Added to a monotonic time of the replay this gives UTC.
    utc_offset_ns: i64,
}

struct Source {
    dataset: Dataset,
    reader: SetReader,
    /// The rig's stream of each stream of this dataset.
    streams: Vec<usize>,
    /// Its log times, of a rig of several computers on the session's clock.
    times: Vec<i64>,
    /// Its clock, of such a rig.
    clock: Option<SessionClock>,
    /// The rig's IMU of each of this dataset; `None` where a dataset before it gives the same unit at the same
    /// times, as a recording and a dataset computed from it do.
    units: Vec<Option<usize>>,
    /// The same of its signals; also `None` where another dataset has other fields by that name.
    signals: Vec<Option<usize>>,
    /// The set that was read last.
    read: usize,
    /// Of each signal the publisher and the time of its last sample, where sets are read in order.
    after: Vec<Option<(u64, i64)>>,
}

/// One moment of a replay: a set, or several that were paired.
#[derive(Default)]
pub struct Moment {
    /// Id of the set in its dataset; of the first one, where there are several.
    pub id: u64,
    /// The moment that it stands for, on the clock of the replay.
    pub tick: HostTime,
    /// Latest minus earliest capture time, nanoseconds.
    pub spread_ns: i64,
    /// The frames; `stream` is the rig's stream.
    pub frames: Vec<DatasetFrame>,
    /// IMU batches since the moment before; `unit` is the rig's IMU.
    pub motion: Vec<RecordMotion>,
    /// Samples of signals since the moment before; `signal` is the rig's signal.
    pub signals: Vec<RecordSignal>,
    /// Sets of this moment that could not be read.
    pub problems: Vec<String>,
}

impl Sources {
    /// Opens `paths` as the rig `rig`, or as the one that they were recorded from. Several that have no clock of one session go by UTC if that
    /// is permitted.
    ///
    /// # Errors
    /// [`ErrorKind::NotFound`], [`ErrorKind::PermissionDenied`], [`ErrorKind::BadInput`] when they are not of one rig or must not go by UTC,
    /// [`ErrorKind::Other`] when one of them is not a dataset or has no set, or the disk fails.
    pub fn open(paths: &[PathBuf], rig: Option<RigName>, by_utc: bool) -> Result<Self> {
        let mut sources = Vec::new();
        let mut streams: Vec<StreamRecord> = Vec::new();
        let mut units: Vec<MotionRecord> = Vec::new();
        let mut signals: Vec<SignalRecord> = Vec::new();
        for path in paths {
            let dataset = Dataset::open(path).map_err(Error::from)?;
            let mut reader = dataset.set_reader().map_err(Error::from)?;
            if reader.times().is_empty() {
                let shown = path.display();
                let why = reader.problems().first().map_or(String::new(), |p| format!(": {p}"));
                let message = format!("{shown} holds no frame set, there is nothing to replay{why}");
                return Err(Error::new(ErrorKind::Other, message));
            }
            // One dataset is replayed on its own clock.
            let clock = if paths.len() > 1 { SessionClock::of(dataset.session(), &mut reader) } else { None };
            let first = sources.first().and_then(|s: &Source| s.clock.as_ref());
            if let (Some(own), Some(first)) = (&clock, first)
                && own.clock != first.clock
            {
                return Err(bad(format!(
                    "{} is of another session than {}: the clock that its computer followed is another one",
                    dataset.path().display(),
                    sources[0].dataset.path().display()
                )));
            }
            let times = match &clock {
                Some(clock) => clock.times(first.unwrap_or(clock).utc_offset_ns),
                None => reader.times().to_vec(),
            };
            let mut indices = Vec::new();
            for record in &dataset.session().streams {
                indices.push(join(&mut streams, record, &dataset)?);
            }
            let overlaps = |s: &Source| overlap(&s.times, &times);
            let given: BTreeSet<usize> = sources
                .iter()
                .filter(|s| overlaps(s))
                .flat_map(|s| s.units.iter().flatten().copied())
                .collect();
            let mut unit = |record| Some(join_unit(&mut units, record)).filter(|i| !given.contains(i));
            let of_rig = dataset.session().motion.iter().map(&mut unit).collect();
            let given: BTreeSet<usize> = sources
                .iter()
                .filter(|s| overlaps(s))
                .flat_map(|s| s.signals.iter().flatten().copied())
                .collect();
            let mut signal = |record| join_signal(&mut signals, record).filter(|i| !given.contains(i));
            let signals: Vec<_> = dataset.session().signals.iter().map(&mut signal).collect();
            let after = vec![None; signals.len()];
            sources.push(Source {
                dataset,
                reader,
                streams: indices,
                times,
                clock,
                units: of_rig,
                signals,
                read: 0,
                after,
            });
        }
        if sources.is_empty() {
            return Err(bad("name a dataset to replay"));
        }
        // Beside a dataset without the session's clock all go by UTC.
        if let Some(without) = sources.iter().position(|s| s.clock.is_none()) {
            if !by_utc && sources.len() > 1 {
                return Err(bad(format!(
                    "{} has no clock of the session, or several: its computer had no answer from the recorder's (UDP, which a firewall may hold \
                     back), or one of both was started meanwhile. Its sets can be matched by UTC alone, as exactly as the clocks of both \
                     computers were set: depthrig replay PART... --record DIR",
                    sources[without].dataset.path().display()
                )));
            }
            if sources.iter().any(|s| s.clock.is_some()) {
                let path = sources[without].dataset.path().display();
                tracing::warn!(
                    "{path} has no clock of a session of several computers, so all datasets are joined by UTC"
                );
            }
            for source in &mut sources {
                source.clock = None;
                source.times = source.reader.times().to_vec();
            }
        }
        let utc_offset_ns = match &sources[0].clock {
            Some(clock) => clock.utc_offset_ns,
            None => utc_offset_ns(&mut sources)?,
        };
        let rig = match rig {
            Some(rig) => rig,
            None => rig_of(&sources)?,
        };
        Ok(Self { list: sources, rig, streams, units, signals, utc_offset_ns })
    }

    /// The moments of a replay of them.
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] when two of them hold the same stream at the same time.
    pub fn timeline(&self) -> Result<Timeline> {
        let parts: Vec<_> = self
            .list
            .iter()
            .map(|s| Part {
                name: s.dataset.path().display().to_string(),
                streams: s.streams.iter().map(|i| &self.streams[*i].id).collect(),
                times: &s.times,
            })
            .collect();
        Timeline::new(&parts)
    }

    /// The rig's name.
    pub const fn rig(&self) -> &RigName {
        &self.rig
    }

    /// The streams of all of them.
    pub fn streams(&self) -> &[StreamRecord] {
        &self.streams
    }

    /// The IMUs of all of them.
    pub fn units(&self) -> &[MotionRecord] {
        &self.units
    }

    /// The signals of all of them.
    pub fn signals(&self) -> &[SignalRecord] {
        &self.signals
    }

    /// The algorithms behind the streams that no camera gave.
    pub fn computed(&self) -> Vec<Computed> {
        self.list.iter().flat_map(|s| &s.dataset.session().computed).cloned().collect()
    }

    /// The session of the first one.
    pub fn session(&self) -> &Session {
        self.list[0].dataset.session()
    }

    /// Unreadable parts, one line per segment.
    pub fn problems(&self) -> impl Iterator<Item = &String> {
        self.list.iter().flat_map(|s| s.reader.problems())
    }

    /// How colour and depth must be stored for nothing to be lost: as in the datasets where they agree.
    pub fn codecs(&mut self) -> (ColorCodec, DepthCodec) {
        let mut color = BTreeSet::new();
        let mut depth = BTreeSet::new();
        for source in &mut self.list {
            for n in 0..source.reader.times().len().min(LOOK_AT) {
                let Ok(set) = source.reader.read(n, PixelMode::None) else { continue };
                for frame in &set.frames {
                    match frame.header.pixel_format() {
                        Some(PixelFormat::Rgb8 | PixelFormat::Bgr8) => color.insert(frame.codec),
                        Some(PixelFormat::Z16) => depth.insert(frame.codec),
                        _ => false,
                    };
                }
            }
        }
        let only = |codecs: BTreeSet<&'static str>| codecs.first().copied().filter(|_| codecs.len() == 1);
        (
            // A recorder that was short of time stored PNG in place of JPEG; on the same topic, both are stored again as they are.
            if color.iter().any(|codec| !matches!(*codec, "jpeg" | "png")) || color.is_empty() {
                ColorCodec::Raw
            } else if color.contains("jpeg") {
                ColorCodec::Jpeg
            } else {
                ColorCodec::Png
            },
            if only(depth) == Some("rank") { DepthCodec::Rank } else { DepthCodec::default() },
        )
    }

    /// Reads a moment of `timeline`.
    pub fn read(&mut self, timeline: &Timeline, moment: usize, mode: PixelMode) -> Moment {
        let mut read = Moment::default();
        let mut sets = 0;
        for member in timeline.members(moment) {
            let Some(source) = self.list.get_mut(member.dataset as usize) else { continue };
            match source.reader.read(member.set as usize, mode) {
                Ok(set) => {
                    if member.set as usize != source.read + 1 {
                        source.after.fill(None);
                    }
                    source.read = member.set as usize;
                    let place = source.clock.as_ref().and_then(|c| c.places.get(member.set as usize));
                    let by_utc = || Shift::of_utc(set.utc_offset_ns, self.utc_offset_ns);
                    let shift = place.map_or_else(by_utc, |place| place.shift);
                    take(&mut read, set, source, shift, sets == 0);
                    sets += 1;
                }
                Err(e) => read.problems.push(e.to_string()),
            }
        }
        if sets > 1 {
            let times = read.frames.iter().map(|f| f.header.capture_time_ns);
            read.spread_ns = times.clone().max().unwrap_or(0) - times.min().unwrap_or(0);
        }
        // In the order in which they were published, as a subscriber of several streams saw them.
        read.frames.sort_by_key(|f| f.header.publish_time_ns);
        read
    }

    /// A time of the replay's clock as UTC.
    pub const fn utc_ns(&self, t: HostTime) -> i64 {
        t.ns().saturating_add(self.utc_offset_ns)
    }

    /// The number of the set with this id, in the only dataset.
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] when there are several datasets, [`ErrorKind::NotFound`] when no set has this id.
    pub fn number_of(&mut self, id: u64) -> Result<usize> {
        let [source] = self.list.as_mut_slice() else {
            return Err(bad("ids name sets of one dataset, and this replay has several; seek by time"));
        };
        // Ids increase, so the index need not have them: a dozen sets are looked at, their images not read.
        let mut low = 0;
        let mut high = source.reader.times().len();
        while low < high {
            let middle = low + (high - low) / 2;
            let readable = (middle..high)
                .find_map(|n| source.reader.read(n, PixelMode::None).ok().map(|set| (n, set.id)));
            match readable {
                Some((n, found)) if found == id => return Ok(n),
                Some((n, found)) if found < id => low = n + 1,
                _ => high = middle,
            }
        }
        let shown = source.dataset.path().display();
        Err(Error::new(ErrorKind::NotFound, format!("{shown} has no set with the id {id}")))
    }
}

/// The rig's stream for `record`; a new one unless a dataset before it has it.
fn join(streams: &mut Vec<StreamRecord>, record: &StreamRecord, dataset: &Dataset) -> Result<usize> {
    let Some(i) = streams.iter().position(|s| s.id == record.id) else {
        streams.push(record.clone());
        return Ok(streams.len() - 1);
    };
    let mode = |r: &StreamRecord| format!("{}x{} {}", r.width, r.height, r.format.name());
    let before = mode(&streams[i]);
    let now = mode(record);
    if before == now {
        return Ok(i);
    }
    Err(bad(format!(
        "{}: stream {} is {now} there and {before} in a dataset before it; a rig's stream has one mode: replay them one \
         at a time",
        dataset.path().display(),
        record.id
    )))
}

/// The rig's unit for `record`; a new one unless a dataset before it has it. Batches of both fit into its channel.
fn join_unit(units: &mut Vec<MotionRecord>, record: &MotionRecord) -> usize {
    if let Some(i) = units.iter().position(|u| u.id == record.id) {
        units[i].batch = units[i].batch.max(record.batch);
        return i;
    }
    units.push(record.clone());
    units.len() - 1
}

/// The rig's signal for `record`; a new one unless a dataset before it has it. `None` if that one has other fields.
fn join_signal(signals: &mut Vec<SignalRecord>, record: &SignalRecord) -> Option<usize> {
    if let Some(i) = signals.iter().position(|s| s.id == record.id) {
        return (signals[i] == *record).then_some(i);
    }
    signals.push(record.clone());
    Some(signals.len() - 1)
}

/// From the clock of the replay, which is that of the first set that can be read, to UTC; 0 where none can.
fn utc_offset_ns(sources: &mut [Source]) -> Result<i64> {
    for source in sources {
        for n in 0..source.reader.times().len() {
            match source.reader.read(n, PixelMode::None) {
                Ok(set) => return Ok(set.utc_offset_ns),
                Err(e) if e.kind() == depthrig_recorder::ErrorKind::Io => return Err(e.into()),
                Err(_) => {}
            }
        }
    }
    Ok(0)
}

fn rig_of(sources: &[Source]) -> Result<RigName> {
    let mut names: Vec<&str> = sources.iter().map(|s| s.dataset.session().rig.as_str()).collect();
    names.dedup();
    match names.as_slice() {
        [name] => Ok(RigName::new(*name)?),
        names => {
            let names = names.join(", ");
            Err(bad(format!(
                "the datasets are of several rigs ({names}); name the one to replay as with --rig"
            )))
        }
    }
}

impl Shift {
    /// From a clock with `offset_ns` to UTC onto the clock with `base_ns`.
    fn of_utc(offset_ns: i64, base_ns: i64) -> Self {
        let ns = offset_ns.saturating_sub(base_ns);
        let ns = if ns.saturating_abs() < SAME_CLOCK_NS { 0 } else { ns };
        Self { ns, epoch_ns: ns, ..Self::default() }
    }

    fn move_header(self, h: &mut FrameHeader) {
        for t in [&mut h.capture_time_ns, &mut h.arrival_time_ns, &mut h.publish_time_ns] {
            *t = t.saturating_add(self.ns);
        }
        h.capture_uncertainty_ns = h.capture_uncertainty_ns.saturating_add(self.uncertainty_ns);
        if self.is_doubtful {
            h.flags |= FrameFlags::TIME_UNCERTAIN.0;
        }
    }
}

/// Whether there is a time between the first and the last of both.
fn overlap(a: &[i64], b: &[i64]) -> bool {
    let ends = |t: &[i64]| t.first().copied().zip(t.last().copied());
    ends(a).zip(ends(b)).is_some_and(|((a0, a1), (b0, b1))| a0 <= b1 && b0 <= a1)
}

/// Adds a set to a moment.
fn take(moment: &mut Moment, set: DatasetSet, source: &mut Source, shift: Shift, first: bool) {
    let tick = set.tick.plus_ns(shift.ns);
    if first {
        (moment.id, moment.tick, moment.spread_ns) = (set.id, tick, set.spread_ns);
    }
    moment.tick = moment.tick.min(tick);
    for mut frame in set.frames {
        let Some(stream) = source.streams.get(frame.stream) else { continue };
        frame.stream = *stream;
        shift.move_header(&mut frame.header);
        moment.frames.push(frame);
    }
    for mut batch in set.motion {
        let Some(unit) = source.units.get(batch.unit).copied().flatten() else { continue };
        batch.unit = unit;
        shift.move_header(&mut batch.header);
        batch.samples.iter_mut().for_each(|s| s.time_ns = s.time_ns.saturating_add(shift.ns));
        moment.motion.push(batch);
    }
    for part in set.signals {
        let Some(signal) = source.signals.get(part.signal).copied().flatten() else { continue };
        let after = &mut source.after[part.signal];
        let samples =
            part.samples.iter().filter_map(|s| shifted(s, shift.ns, shift.epoch_ns, after)).collect();
        moment.signals.push(RecordSignal { signal, samples });
    }
}

fn bad(what: impl Into<String>) -> Error {
    Error::new(ErrorKind::BadInput, what)
}
