//! Whether two datasets hold the same, and where they differ: both are read once, side by side, a set of each
//! in memory.
//!
//! Sets are matched by their tick, streams by their name. How something is stored (segments, packing, order of
//! the frames in a set) does not count as a difference. Facts that a recording of a replay cannot keep are *passage*:
//! numbers that channel and recorder assign anew. All others are *identity*: what the camera saw and when.
//! `PASSAGE` and [`CompareOptions::strict`] say which is which.
//!
//! More than 500 lines, because images, IMUs and signals are compared in one walk over both.

use crate::dataset::{Dataset, DatasetFrame, DatasetSet, PixelMode, SetRange, Sets};
use crate::{ErrorKind, RecordMotion, Result};
use depthrig_bus::{SignalFlags, SignalSample, StreamId};
use serde::Serialize;
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::ops::ControlFlow;
use std::path::PathBuf;

mod header;
mod pixels;

pub use pixels::PixelDifference;

/// How pixels are compared.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum PixelCheck {
    /// As a replay would publish them, bit by bit. Bytes between the rows are not pixels.
    #[default]
    Exact,
    /// As they are stored: the codec and every byte of the image.
    Stored,
    /// Not at all; no image is read.
    None,
}

/// Options of a comparison.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CompareOptions {
    /// How pixels are compared.
    pub pixels: PixelCheck,
    /// Compare passage as well: of a set its id and its place in UTC, of a frame `sequence`, `captured`, `set_id`
    /// and the flag `replayed`, of a stream its nominal rate and where its calibration comes from.
    pub strict: bool,
    /// Differences that are listed one by one; all are counted.
    pub listed: usize,
}

impl Default for CompareOptions {
    fn default() -> Self {
        Self { pixels: PixelCheck::Exact, strict: false, listed: 20 }
    }
}

/// Result of a comparison.
#[derive(Debug, Clone, Serialize)]
#[non_exhaustive]
pub struct Comparison {
    /// The first dataset.
    pub a: PathBuf,
    /// The second dataset.
    pub b: PathBuf,
    /// Whether no difference was found.
    pub equal: bool,
    /// How pixels were compared.
    pub pixels: PixelCheck,
    /// Whether passage was compared.
    pub strict: bool,
    /// Sets read of the first dataset.
    pub sets_a: u64,
    /// Sets read of the second dataset.
    pub sets_b: u64,
    /// Sets that are in both.
    pub sets: u64,
    /// Frames that are in both.
    pub frames: u64,
    /// Batches of IMUs that are in both.
    pub batches: u64,
    /// Samples of signals that both have.
    pub signal_samples: u64,
    /// How many differences there are, by stream and field.
    pub counts: Vec<FieldCount>,
    /// The first of them.
    pub differences: Vec<Difference>,
    /// Streams whose pixels differ, and by how much.
    pub pixel_differences: Vec<PixelDifference>,
}

/// How many sets or frames differ in a field.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct FieldCount {
    /// `camera/stream`; empty when it is about whole sets.
    pub stream: String,
    /// The field that differs: one of the header, `pixels`, `codec`, `frame` (it is in one dataset only), `batch` (an IMU
    /// batch that is in one only), `samples`, `set` (a set that is in one only), `unreadable`, or a field of the set or of
    /// the stream's description.
    pub field: String,
    /// Sets or frames; descriptions count once.
    pub count: u64,
}

/// One difference.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Difference {
    /// Id of the set in the first dataset, where it is about a set that is there.
    pub set_a: Option<u64>,
    /// Id of the set in the second dataset.
    pub set_b: Option<u64>,
    /// Tick of the set, nanoseconds of the monotonic clock.
    pub tick_ns: Option<i64>,
    /// `camera/stream`; empty when it is about a whole set.
    pub stream: String,
    /// The field that differs, as in [`FieldCount::field`].
    pub field: String,
    /// The value in the first dataset.
    pub a: String,
    /// The value in the second dataset.
    pub b: String,
}

/// How far a comparison has come.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CompareProgress {
    /// Log time of the set reached in the first dataset, UTC nanoseconds since 1970.
    pub utc_ns: i64,
    /// Sets compared.
    pub sets: u64,
}

/// Compares two datasets.
///
/// # Errors
/// [`ErrorKind::Io`] when the disk fails. A set that cannot be read is a difference, not an error.
pub fn compare(a: &Dataset, b: &Dataset, options: &CompareOptions) -> Result<Comparison> {
    compare_with(a, b, options, &mut |_| ControlFlow::Continue(()))
}

/// The same, calling `progress` after each set; a break ends it with the result so far.
///
/// # Errors
/// As [`compare`].
pub fn compare_with(
    a: &Dataset,
    b: &Dataset,
    options: &CompareOptions,
    progress: &mut dyn FnMut(CompareProgress) -> ControlFlow<()>,
) -> Result<Comparison> {
    let mut walk = Walk::new(a, b, *options);
    walk.descriptions();
    walk.sets(progress)?;
    Ok(walk.finish())
}

const A: usize = 0;
const B: usize = 1;
/// In place of a value that one of the two has not.
const NOTHING: &str = "-";

struct Walk<'a> {
    datasets: [&'a Dataset; 2],
    options: CompareOptions,
    read: [u64; 2],
    sets: u64,
    frames: u64,
    batches: u64,
    samples: u64,
    counts: BTreeMap<(String, String), u64>,
    differences: Vec<Difference>,
    pixels: BTreeMap<String, PixelDifference>,
    header: header::Compare,
}

/// Which set a difference is about.
#[derive(Clone, Copy, Default)]
struct At {
    a: Option<u64>,
    b: Option<u64>,
    tick_ns: Option<i64>,
}

impl<'a> Walk<'a> {
    fn new(a: &'a Dataset, b: &'a Dataset, options: CompareOptions) -> Self {
        Self {
            datasets: [a, b],
            options,
            read: [0; 2],
            sets: 0,
            frames: 0,
            batches: 0,
            samples: 0,
            counts: BTreeMap::new(),
            differences: Vec::new(),
            pixels: BTreeMap::new(),
            header: header::Compare::new(options.strict),
        }
    }

    /// Compares the streams of both `session.toml`. The name of the session, of the rig, the scene and the like say how
    /// somebody filed a recording, not what is in it.
    fn descriptions(&mut self) {
        let [a, b] = self.datasets.map(|d| &d.session().streams);
        let ids: BTreeSet<&StreamId> = a.iter().chain(b).map(|s| &s.id).collect();
        for id in ids {
            let name = id.to_string();
            let (x, y) = match (a.iter().find(|s| s.id == *id), b.iter().find(|s| s.id == *id)) {
                (Some(x), Some(y)) => (x, y),
                (x, _) => {
                    let [in_a, in_b] =
                        if x.is_some() { ["recorded", NOTHING] } else { [NOTHING, "recorded"] };
                    self.add(At::default(), &name, "stream", in_a, in_b);
                    continue;
                }
            };
            let mut check = |field: &str, x: &dyn std::fmt::Debug, y: &dyn std::fmt::Debug| {
                let x = format!("{x:?}");
                let y = format!("{y:?}");
                if x != y {
                    self.add(At::default(), &name, &format!("description.{field}"), x, y);
                }
            };
            check("model", &x.model, &y.model);
            check("serial", &x.serial, &y.serial);
            check("format", &x.format.name(), &y.format.name());
            check("width", &x.width, &y.width);
            check("height", &x.height, &y.height);
            check("depth_unit_m", &x.depth_unit_m, &y.depth_unit_m);
            check("intrinsics", &x.intrinsics, &y.intrinsics);
            check("pose", &x.pose, &y.pose);
            if self.options.strict {
                let mut check = |field: &str, x: &str, y: &str| {
                    if x != y {
                        self.add(At::default(), &name, &format!("description.{field}"), x, y);
                    }
                };
                check("calibration", &x.calibration, &y.calibration);
                check("rate_hz", &x.rate_hz.to_string(), &y.rate_hz.to_string());
            }
        }
        self.units();
        self.signal_records();
    }

    /// Compares the signals of both `session.toml`.
    fn signal_records(&mut self) {
        let [a, b] = self.datasets.map(|d| &d.session().signals);
        for x in a {
            let name = x.id.to_string();
            match b.iter().find(|y| y.id == x.id) {
                Some(y) if x.description == y.description => {}
                Some(y) => {
                    self.add(At::default(), &name, "description", x.description.json(), y.description.json());
                }
                None => self.add_on(A, At::default(), &name, "signal", "recorded".into()),
            }
        }
        for y in b.iter().filter(|y| !a.iter().any(|x| x.id == y.id)) {
            self.add_on(B, At::default(), &y.id.to_string(), "signal", "recorded".into());
        }
    }

    /// Compares the IMUs of both `session.toml`.
    fn units(&mut self) {
        let [a, b] = self.datasets.map(|d| &d.session().motion);
        let ids: BTreeSet<&StreamId> = a.iter().chain(b).map(|u| &u.id).collect();
        for id in ids {
            let name = id.to_string();
            let (x, y) = match (a.iter().find(|u| u.id == *id), b.iter().find(|u| u.id == *id)) {
                (Some(x), Some(y)) => (x, y),
                (x, _) => {
                    self.add_on(
                        if x.is_some() { A } else { B },
                        At::default(),
                        &name,
                        "unit",
                        "recorded".into(),
                    );
                    continue;
                }
            };
            let mut check = |field: &str, x: String, y: String| {
                if x != y {
                    self.add(At::default(), &name, &format!("description.{field}"), x, y);
                }
            };
            check("model", x.model.clone(), y.model.clone());
            check("serial", x.serial.clone(), y.serial.clone());
            check("pose", format!("{:?}", x.pose), format!("{:?}", y.pose));
            if self.options.strict {
                let mut check = |field: &str, x: String, y: String| {
                    if x != y {
                        self.add(At::default(), &name, &format!("description.{field}"), x, y);
                    }
                };
                check("batch", x.batch.to_string(), y.batch.to_string());
                check("calibration", x.calibration.clone(), y.calibration.clone());
                check("rate_hz", x.rate_hz.to_string(), y.rate_hz.to_string());
            }
        }
    }

    /// Both datasets set by set, in the order of their ticks.
    fn sets(&mut self, progress: &mut dyn FnMut(CompareProgress) -> ControlFlow<()>) -> Result<()> {
        let mode = if self.options.pixels == PixelCheck::None { PixelMode::None } else { PixelMode::Stored };
        let mut readers = self.datasets.map(|d| d.sets_with(SetRange::ALL, mode));
        let mut next = [self.next(A, &mut readers[A])?, self.next(B, &mut readers[B])?];
        loop {
            let ticks = [&next[A], &next[B]].map(|s| s.as_ref().map(|s| s.tick));
            let [a, b] = match ticks {
                [None, None] => return Ok(()),
                [Some(a), Some(b)] => [a <= b, b <= a],
                [a, b] => [a.is_some(), b.is_some()],
            };
            if let Some(set) = &next[A] {
                let at = CompareProgress { utc_ns: set.utc_ns, sets: self.sets };
                if progress(at).is_break() {
                    return Ok(());
                }
            }
            match (next[A].take_if(|_| a), next[B].take_if(|_| b)) {
                (Some(a), Some(b)) => self.set(&a, &b),
                (Some(a), None) => self.lone_set(A, &a),
                (None, Some(b)) => self.lone_set(B, &b),
                (None, None) => return Ok(()),
            }
            if a {
                next[A] = self.next(A, &mut readers[A])?;
            }
            if b {
                next[B] = self.next(B, &mut readers[B])?;
            }
        }
    }

    /// The next set that can be read; those that cannot are differences.
    fn next(&mut self, side: usize, sets: &mut Sets) -> Result<Option<DatasetSet>> {
        for set in sets {
            match set {
                Ok(set) => {
                    self.read[side] += 1;
                    return Ok(Some(set));
                }
                Err(e) if e.kind() == ErrorKind::Io => return Err(e),
                Err(e) => self.add_on(side, At::default(), "", "unreadable", e.to_string()),
            }
        }
        Ok(None)
    }

    fn lone_set(&mut self, side: usize, set: &DatasetSet) {
        let mut at = At { tick_ns: Some(set.tick.ns()), ..At::default() };
        *(if side == A { &mut at.a } else { &mut at.b }) = Some(set.id);
        self.add_on(side, at, "", "set", format!("{} frames", set.frames.len()));
    }

    fn set(&mut self, a: &DatasetSet, b: &DatasetSet) {
        self.sets += 1;
        let at = At { a: Some(a.id), b: Some(b.id), tick_ns: Some(a.tick.ns()) };
        if a.spread_ns != b.spread_ns {
            self.add(at, "", "spread_ns", a.spread_ns.to_string(), b.spread_ns.to_string());
        }
        if self.options.strict {
            let mut check = |field: &str, x: i64, y: i64| {
                if x != y {
                    self.add(at, "", field, x.to_string(), y.to_string());
                }
            };
            check("id", a.id as i64, b.id as i64);
            check("utc_ns", a.utc_ns, b.utc_ns);
            check("utc_offset_ns", a.utc_offset_ns, b.utc_offset_ns);
        }
        self.motion(at, a, b);
        self.signals(at, a, b);
        let [a, b] = [(A, a), (B, b)].map(|(side, set)| self.by_name(side, set));
        for (name, x) in &a {
            match b.get(name) {
                Some(y) => self.frame(at, name, x, y),
                None => self.add_on(A, at, name, "frame", format!("number {}", x.header.sequence)),
            }
        }
        for (name, y) in b.iter().filter(|(name, _)| !a.contains_key(*name)) {
            self.add_on(B, at, name, "frame", format!("number {}", y.header.sequence));
        }
    }

    /// The batches of a set, those of each unit in their order.
    fn motion(&mut self, at: At, a: &DatasetSet, b: &DatasetSet) {
        let [mut x, mut y] = [(A, a), (B, b)].map(|(side, set)| {
            let units = &self.datasets[side].session().motion;
            let mut of: BTreeMap<String, VecDeque<&RecordMotion>> = BTreeMap::new();
            for batch in &set.motion {
                if let Some(unit) = units.get(batch.unit) {
                    of.entry(unit.id.to_string()).or_default().push_back(batch);
                }
            }
            of
        });
        let names: BTreeSet<String> = x.keys().chain(y.keys()).cloned().collect();
        for name in names {
            let x = x.remove(&name).unwrap_or_default();
            let y = y.remove(&name).unwrap_or_default();
            for (a, b) in x.iter().zip(&y) {
                self.batch(at, &name, a, b);
            }
            for (side, lone) in [(A, x.iter().skip(y.len())), (B, y.iter().skip(x.len()))] {
                for batch in lone {
                    self.add_on(side, at, &name, "batch", format!("number {}", batch.header.sequence));
                }
            }
        }
    }

    /// Two batches of one unit: the headers as those of frames, the samples bit by bit.
    fn batch(&mut self, at: At, name: &str, a: &RecordMotion, b: &RecordMotion) {
        self.batches += 1;
        for (field, x, y) in self.header.differing(&a.header, &b.header) {
            self.add(at, name, field, x, y);
        }
        let mut pairs = a.samples.iter().zip(&b.samples);
        let differs = pairs.position(|(x, y)| x.to_bytes() != y.to_bytes());
        let at_sample =
            differs.or((a.samples.len() != b.samples.len()).then_some(a.samples.len().min(b.samples.len())));
        if let Some(n) = at_sample {
            let [x, y] = [a, b].map(|m| m.samples.get(n).map_or(NOTHING.to_owned(), |s| format!("{s:?}")));
            self.add(at, name, "samples", x, y);
        }
    }

    /// The samples of signals of a set, those of each signal in their order.
    fn signals(&mut self, at: At, a: &DatasetSet, b: &DatasetSet) {
        let [mut x, mut y] = [(A, a), (B, b)].map(|(side, set)| {
            let signals = &self.datasets[side].session().signals;
            let mut of: BTreeMap<String, Vec<&SignalSample>> = BTreeMap::new();
            for part in &set.signals {
                if let Some(signal) = signals.get(part.signal) {
                    of.entry(signal.id.to_string()).or_default().extend(&part.samples);
                }
            }
            of
        });
        let names: BTreeSet<String> = x.keys().chain(y.keys()).cloned().collect();
        for name in names {
            let x = x.remove(&name).unwrap_or_default();
            let y = y.remove(&name).unwrap_or_default();
            for (a, b) in x.iter().zip(&y) {
                self.signal_sample(at, &name, a, b);
            }
            for (side, lone) in [(A, x.iter().skip(y.len())), (B, y.iter().skip(x.len()))] {
                for sample in lone {
                    self.add_on(side, at, &name, "sample", format!("number {}", sample.header().sequence));
                }
            }
        }
    }

    /// Two samples of one signal, their values bit by bit. Publisher and number are passage, and so is `replayed`.
    fn signal_sample(&mut self, at: At, name: &str, a: &SignalSample, b: &SignalSample) {
        self.samples += 1;
        let passage = if self.options.strict { 0 } else { SignalFlags::REPLAYED.0 };
        let identity = |s: &SignalSample| {
            let h = *s.header();
            [
                ("time_ns", h.time_ns.to_string()),
                ("publish_time_ns", h.publish_time_ns.to_string()),
                ("uncertainty_ns", h.uncertainty_ns.to_string()),
                ("flags", (h.flags & !passage).to_string()),
            ]
        };
        for ((field, x), (_, y)) in identity(a).into_iter().zip(identity(b)) {
            if x != y {
                self.add(at, name, field, x, y);
            }
        }
        if a.bytes() != b.bytes() {
            let [x, y] = [a, b].map(|s| format!("{:?}", s.values().collect::<Vec<_>>()));
            self.add(at, name, "values", x, y);
        }
        if self.options.strict {
            let [x, y] = [a, b].map(|s| (s.header().session, s.header().sequence));
            if x != y {
                self.add(at, name, "sequence", format!("{x:?}"), format!("{y:?}"));
            }
        }
    }

    /// The frames of a set by the names of their streams.
    fn by_name<'s>(&self, side: usize, set: &'s DatasetSet) -> BTreeMap<String, &'s DatasetFrame> {
        let streams = &self.datasets[side].session().streams;
        let named = set.frames.iter().filter_map(|f| Some((streams.get(f.stream)?.id.to_string(), f)));
        named.collect()
    }

    fn frame(&mut self, at: At, name: &str, a: &DatasetFrame, b: &DatasetFrame) {
        self.frames += 1;
        let fields = self.header.differing(&a.header, &b.header);
        for (field, x, y) in fields {
            self.add(at, name, field, x, y);
        }
        let same = a.codec == b.codec && a.pixels == b.pixels;
        match self.options.pixels {
            PixelCheck::Stored if a.codec != b.codec => self.add(at, name, "codec", a.codec, b.codec),
            PixelCheck::Stored if !same => {
                let [x, y] = [a, b].map(|f| {
                    format!("{} bytes with CRC-32 {:08x}", f.pixels.len(), crc32fast::hash(&f.pixels))
                });
                self.add(at, name, "pixels", x, y);
            }
            // The same stored bytes under the same header decode to the same pixels.
            PixelCheck::Exact if !same => self.pixels(at, name, a, b),
            PixelCheck::None | PixelCheck::Exact | PixelCheck::Stored => {}
        }
    }

    fn pixels(&mut self, at: At, name: &str, a: &DatasetFrame, b: &DatasetFrame) {
        let [x, y] = match [a.decoded(), b.decoded()] {
            [Ok(x), Ok(y)] => [x, y],
            results => {
                let [x, y] = results.map(|r| r.map_or_else(|e| e.to_string(), |_| "decodes".to_owned()));
                return self.add(at, name, "unreadable", x, y);
            }
        };
        let entry = self.pixels.entry(name.to_owned());
        let total = entry.or_insert_with(|| PixelDifference::new(name));
        if let Some((x, y)) = total.frame(&a.header, &x, &b.header, &y) {
            self.add(at, name, "pixels", x, y);
        }
    }

    /// Something that one of the two has alone.
    fn add_on(&mut self, side: usize, at: At, stream: &str, field: &str, what: String) {
        let nothing = NOTHING.to_owned();
        let (a, b) = if side == A { (what, nothing) } else { (nothing, what) };
        self.add(at, stream, field, a, b);
    }

    fn add(&mut self, at: At, stream: &str, field: &str, a: impl Into<String>, b: impl Into<String>) {
        *self.counts.entry((stream.to_owned(), field.to_owned())).or_default() += 1;
        if self.differences.len() < self.options.listed {
            self.differences.push(Difference {
                set_a: at.a,
                set_b: at.b,
                tick_ns: at.tick_ns,
                stream: stream.to_owned(),
                field: field.to_owned(),
                a: a.into(),
                b: b.into(),
            });
        }
    }

    fn finish(self) -> Comparison {
        let count = |((stream, field), count)| FieldCount { stream, field, count };
        Comparison {
            a: self.datasets[A].path().to_owned(),
            b: self.datasets[B].path().to_owned(),
            equal: self.counts.is_empty(),
            pixels: self.options.pixels,
            strict: self.options.strict,
            sets_a: self.read[A],
            sets_b: self.read[B],
            sets: self.sets,
            frames: self.frames,
            batches: self.batches,
            signal_samples: self.samples,
            counts: self.counts.into_iter().map(count).collect(),
            differences: self.differences,
            pixel_differences: self.pixels.into_values().filter(|p| p.frames_differing > 0).collect(),
        }
    }
}
