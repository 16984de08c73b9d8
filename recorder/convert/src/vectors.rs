//! Samples of signals at the moments of sets, as vectors of floats: what people train from as state and action.
//!
//! The value at a moment lies on a line between the samples around it ([`Series::at`]); nothing is extrapolated.

use crate::Source;
use core::time::Duration;
use depthrig_bus::signal::LINK_CLOCK;
use depthrig_bus::{FieldType, HostTime, Series, SignalHeader, SignalSample, StreamId, Value};
use depthrig_recorder::{Error, ErrorKind, PixelMode, Result, SignalRecord};
use serde::Serialize;
use std::ops::Range;

/// Treatment of moments at which a signal has no value.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Gaps {
    /// The export is refused, and says which.
    #[default]
    Refuse,
    /// The last value before is held, and the row is marked as missing.
    Mask,
}

/// The signals of an export.
#[derive(Debug, Clone, Serialize)]
pub struct VectorOptions {
    /// Signals of the state, in this order. None means all that are no actions, by name.
    pub state: Vec<StreamId>,
    /// Signals of the action. None means all whose device or signal is named `action` or begins with `action_`.
    pub action: Vec<StreamId>,
    /// Neighbours that are further apart are a gap, nanoseconds.
    pub max_gap_ns: u64,
    /// Treatment of gaps.
    pub gaps: Gaps,
}

impl Default for VectorOptions {
    fn default() -> Self {
        Self { state: Vec::new(), action: Vec::new(), max_gap_ns: 200_000_000, gaps: Gaps::Refuse }
    }
}

/// Samples come with the set after them, which was put together this much later at most, nanoseconds.
const LATENCY_NS: i64 = 2_000_000_000;
/// So much without a signal at either end of an episode or a dataset is left out, and stated, nanoseconds: its last set may lack the sample
/// after it, which came with a set that was cut away or pruned.
const EDGE_NS: i64 = 1_000_000_000;
/// Moments that a message names.
const NAMED: usize = 5;

/// One vector: all numbers of some signals.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Vector {
    /// Its name in the layout.
    pub(crate) key: &'static str,
    signals: Vec<SignalRecord>,
}

impl Vector {
    /// State and action as `options` choose them among the signals of `sources`; a vector without signals is left out.
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] when a signal is not in every dataset with the same fields.
    pub(crate) fn choose(
        sources: &[Source],
        options: &VectorOptions,
        keys: [&'static str; 2],
    ) -> Result<Vec<Self>> {
        let Some(first) = sources.first() else { return Ok(Vec::new()) };
        let all = &first.session().signals;
        let is_action = |id: &StreamId| {
            if !options.action.is_empty() {
                return options.action.contains(id);
            }
            let names = [id.camera.to_string(), id.stream.to_string()];
            names.iter().any(|name| name == "action" || name.starts_with("action_"))
        };
        let named =
            |ids: &[StreamId]| ids.iter().map(|id| find(first, id).cloned()).collect::<Result<Vec<_>>>();
        let of = |ids: &[StreamId], action: bool| match ids {
            [] => {
                // By name: the session has them in the order in which they appeared.
                let is_robots = |s: &&SignalRecord| s.id.stream.as_str() != LINK_CLOCK;
                let of_kind = |s: &&SignalRecord| is_action(&s.id) == action;
                let mut found: Vec<_> = all.iter().filter(is_robots).filter(of_kind).cloned().collect();
                found.sort_by(|a, b| a.id.cmp(&b.id));
                Ok(found)
            }
            ids => named(ids),
        };
        let chosen = [of(&options.state, false)?, of(&options.action, true)?];
        let mut vectors = Vec::new();
        for (key, signals) in keys.into_iter().zip(chosen) {
            for other in sources.iter().skip(1) {
                for signal in &signals {
                    if find(other, &signal.id)? != signal {
                        let there = other.dataset().path().display();
                        let id = &signal.id;
                        return Err(bad(format!(
                            "signal {id} has other fields in {there} than in {}: export them separately",
                            first.dataset().path().display()
                        )));
                    }
                }
            }
            let vector = Self { key, signals };
            if !vector.names().is_empty() {
                vectors.push(vector);
            }
        }
        Ok(vectors)
    }

    /// A name for each of its numbers: `DEVICE/SIGNAL.FIELD`, with a number behind it for more than one element.
    pub(crate) fn names(&self) -> Vec<String> {
        let mut names = Vec::new();
        for SignalRecord { id, description } in &self.signals {
            for field in description.all_fields().iter().filter(|f| f.kind != FieldType::Text) {
                let name = format!("{id}.{}", field.name);
                let one = |i| if field.count > 1 { format!("{name}.{i}") } else { name.clone() };
                names.extend((0..field.count).map(one));
            }
        }
        names
    }

    /// Its signals.
    pub(crate) fn signals(&self) -> impl Iterator<Item = &SignalRecord> {
        self.signals.iter()
    }
}

fn bad(message: String) -> Error {
    Error::new(ErrorKind::BadInput, message)
}

fn find<'s>(source: &'s Source, id: &StreamId) -> Result<&'s SignalRecord> {
    let signals = &source.session().signals;
    signals.iter().find(|s| s.id == *id).ok_or_else(|| {
        let there: Vec<_> = signals.iter().map(|s| s.id.to_string()).collect();
        bad(format!(
            "{} has no signal {id}; it has: {}",
            source.dataset().path().display(),
            if there.is_empty() { "none".to_owned() } else { there.join(", ") }
        ))
    })
}

/// The vectors of the sets of a source.
#[derive(Debug, Clone, Default)]
pub(crate) struct Moments {
    /// Number of the set of each row.
    numbers: Vec<usize>,
    /// By vector, by row.
    rows: Vec<Vec<Row>>,
    /// Numbers of sets at the ends without a value, in order.
    pub(crate) left_out: Vec<usize>,
}

/// A vector at one moment.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Row {
    pub(crate) values: Vec<f32>,
    /// No value was there: the last one is held, 0 before the first.
    pub(crate) is_missing: bool,
}

impl Moments {
    /// Reads the samples of `vectors` in the sets of `source`; no image is read.
    ///
    /// # Errors
    /// [`ErrorKind::Io`] when the disk fails; [`ErrorKind::BadInput`] when a signal has a gap and the options refuse it.
    pub(crate) fn read(source: &Source, vectors: &[Vector], options: &VectorOptions) -> Result<Self> {
        if vectors.is_empty() {
            return Ok(Self::default());
        }
        let numbers: Vec<_> = source.numbers().collect();
        let times: Vec<_> = numbers.iter().map(|n| source.times()[*n]).collect();
        let mut tracks: Vec<Vec<Track>> = vectors
            .iter()
            .map(|v| v.signals.iter().map(|s| Track::new(s, options, times.len())).collect())
            .collect();
        let mut reader = source.reader();
        for number in around(source, &times, options) {
            let set = match reader.read(number, PixelMode::None) {
                Ok(set) => set,
                Err(e) if e.kind() == ErrorKind::Io => return Err(e),
                // The export says so when it comes to it; here its samples are a gap.
                Err(_) => continue,
            };
            for part in &set.signals {
                let Some(record) = source.session().signals.get(part.signal) else { continue };
                for track in tracks.iter_mut().flatten().filter(|t| t.id == record.id) {
                    for sample in &part.samples {
                        track.take(sample, set.utc_offset_ns, &times)?;
                    }
                }
            }
        }
        let mut moments = Self { numbers, ..Self::default() };
        tracks.iter_mut().flatten().for_each(|t| t.end(times.len()));
        moments.left_out = edges(&tracks, &times).map(|row| moments.numbers[row]).collect();
        if options.gaps == Gaps::Refuse {
            for track in tracks.iter().flatten() {
                track.refuse(source, &moments, options)?;
            }
        }
        moments.rows = tracks.iter().map(|tracks| join(tracks, times.len())).collect();
        Ok(moments)
    }

    /// Vector number `vector` at the set of this number.
    pub(crate) fn row(&self, vector: usize, number: usize) -> Option<&Row> {
        self.rows.get(vector)?.get(self.numbers.binary_search(&number).ok()?)
    }
}

/// Numbers of the sets that may hold samples around these times.
fn around(source: &Source, times: &[i64], options: &VectorOptions) -> Range<usize> {
    let margin = i64::try_from(options.max_gap_ns).unwrap_or(i64::MAX).saturating_add(LATENCY_NS);
    let [Some(first), Some(last)] = [times.first(), times.last()] else { return 0..0 };
    let all = source.times();
    let begin = all.partition_point(|t| *t < first.saturating_sub(margin));
    begin..all.partition_point(|t| *t <= last.saturating_add(margin))
}

/// The rows at the beginning and at the end at which some signal has no value, as far as they are within [`EDGE_NS`].
fn edges(tracks: &[Vec<Track>], times: &[i64]) -> impl Iterator<Item = usize> + use<> {
    let all = || tracks.iter().flatten();
    let begin = all().map(|t| without(t.rows.iter())).max().unwrap_or(0);
    let end = all().map(|t| without(t.rows.iter().rev())).max().unwrap_or(0);
    let n = times.len();
    let is_short = |rows: Range<usize>| {
        let span = times.get(rows.clone()).and_then(|t| Some(t.last()? - t.first()?)).unwrap_or(0);
        span <= EDGE_NS && rows.len() < n
    };
    let begin = if is_short(0..begin) { begin } else { 0 };
    let end = if is_short(n - end..n) { end } else { 0 };
    (0..begin).chain((n - end).max(begin)..n)
}

/// Number of rows without a value before the first that has one.
fn without<'c>(rows: impl Iterator<Item = &'c Cell>) -> usize {
    rows.take_while(|c| c.is_missing).count()
}

/// One row for each moment from the signals of a vector.
fn join(tracks: &[Track], n: usize) -> Vec<Row> {
    let row = |i: usize| Row {
        values: tracks.iter().flat_map(|t| t.rows[i].values.iter().copied()).collect(),
        is_missing: tracks.iter().any(|t| t.rows[i].is_missing),
    };
    (0..n).map(row).collect()
}

/// One signal on its way through the moments.
struct Track {
    id: StreamId,
    max_gap: Duration,
    series: Series,
    /// The last value, 0 before the first.
    held: Vec<f32>,
    rows: Vec<Cell>,
}

/// The values of a signal at one moment.
struct Cell {
    values: Vec<f32>,
    /// It is outside of the samples, or its neighbours are too far apart or of two publishers.
    is_missing: bool,
}

impl Track {
    fn new(record: &SignalRecord, options: &VectorOptions, rows: usize) -> Self {
        let fields = record.description.all_fields().iter().filter(|f| f.kind != FieldType::Text);
        let n: u32 = fields.map(|f| f.count).sum();
        let max_gap = Duration::from_nanos(options.max_gap_ns);
        Self {
            id: record.id.clone(),
            max_gap,
            series: Series::new(max_gap),
            held: vec![0.0; n as usize],
            rows: Vec::with_capacity(rows),
        }
    }

    /// Takes in a sample, and fills the moments up to it.
    fn take(&mut self, sample: &SignalSample, utc_offset_ns: i64, times: &[i64]) -> Result<()> {
        // On the axis of the sets, on which datasets that were joined are in order.
        let time_ns = sample.header().time_ns.saturating_add(utc_offset_ns);
        let header = SignalHeader { time_ns, ..*sample.header() };
        let fail = |e: depthrig_bus::Error| bad(e.to_string()).with_source(e);
        let sample =
            SignalSample::new(header, sample.description(), sample.bytes().to_vec()).map_err(fail)?;
        let newest = numbers(&sample);
        self.series.push(sample).map_err(fail)?;
        while let Some(time) = times.get(self.rows.len()).filter(|t| **t <= time_ns) {
            let at = self.series.at(HostTime::from_ns(*time), self.max_gap).ok();
            if let Some(at) = &at {
                self.held = numbers(at);
            }
            let cell = Cell { values: self.held.clone(), is_missing: at.is_none() };
            self.rows.push(cell);
        }
        self.held = newest;
        Ok(())
    }

    /// Fills the moments after the last sample.
    fn end(&mut self, n: usize) {
        while self.rows.len() < n {
            self.rows.push(Cell { values: self.held.clone(), is_missing: true });
        }
    }

    /// The error if it has no value at a moment that is exported.
    fn refuse(&self, source: &Source, moments: &Moments, options: &VectorOptions) -> Result<()> {
        let missing: Vec<_> = self
            .rows
            .iter()
            .zip(&moments.numbers)
            .filter(|(cell, number)| cell.is_missing && moments.left_out.binary_search(number).is_err())
            .map(|(_, number)| *number)
            .collect();
        let (Some(first), Some(last)) = (missing.first(), missing.last()) else { return Ok(()) };
        let begin = source.times().first().copied().unwrap_or_default();
        let seconds = |number: &usize| (source.times()[*number] - begin) as f64 / 1e9;
        let named: Vec<_> = missing.iter().take(NAMED).map(|n| format!("{:.3} s", seconds(n))).collect();
        let more = if missing.len() > NAMED { ", …" } else { "" };
        let path = source.dataset().path().display();
        let of = source.episode().map(|e| format!(", episode {}", e.number)).unwrap_or_default();
        let max_gap_s = options.max_gap_ns as f64 / 1e9;
        Err(bad(format!(
            "{path}{of}: signal {} has no samples at most {max_gap_s} s apart around {} of {} sets, from {:.3} s to {:.3} s of \
             the dataset ({}{more}); hold the last value and mark these rows (--gaps mask), allow a longer gap (--max-gap), \
             or choose other signals (--state, --action)",
            self.id,
            missing.len(),
            self.rows.len(),
            seconds(first),
            seconds(last),
            named.join(", "),
        )))
    }
}

/// The numbers of a sample.
fn numbers(sample: &SignalSample) -> Vec<f32> {
    sample.values().filter_map(Value::number).map(|x| x as f32).collect()
}
