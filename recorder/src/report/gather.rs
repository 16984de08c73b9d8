//! One pass over the numbers of a dataset, and a look at some of its images.

use super::series::{Counts, Histogram, TimeBins, Values};
use super::{
    ClockReport, Fill, LISTED_MAX, LinearHistogram, OnProgress, PROBLEMS_MAX, Report, ReportOptions,
    SetsAccount, SetsReport, StreamReport, verdict,
};
use crate::catalog::look_at;
use crate::dataset::{Dataset, DatasetSet, PixelMode, Removed, SetRange};
use crate::{ErrorKind, Result, StreamAccount};
use depthrig_bus::{FrameFlags, FrameHeader};
use images::SampledImages;
use messages::{MessageSummary, read_messages};
use std::collections::BTreeMap;

mod images;
mod messages;
mod motion;
mod signal;

/// Bars of the histogram of spreads.
const BARS: i64 = 48;

/// Sums over the frames of a stream.
struct Stream {
    codec: &'static str,
    frames: u64,
    missing: u64,
    bytes: u64,
    packed_bytes: u64,
    is_packed: bool,
    raw_bytes: u64,
    live: Counts,
    missing_at: Counts,
    dropped_at: Counts,
    lag: Histogram,
    lag_at: Values,
    uncertainty: Histogram,
    uncertain: u64,
    restarts_ns: Vec<i64>,
    restarts: u64,
    /// Time since the first set and header of the first and the last frame.
    first: Option<(i64, FrameHeader)>,
    last: Option<(i64, FrameHeader)>,
    /// When it was missing first and last.
    missing_ns: Option<(i64, i64)>,
    /// Frames on the channel and the time between recorded frames that they lie in, without restarts of the count.
    delivered: u64,
    over_ns: i64,
}

impl Stream {
    fn new(bins: TimeBins) -> Self {
        Self {
            codec: "",
            frames: 0,
            missing: 0,
            bytes: 0,
            packed_bytes: 0,
            is_packed: false,
            raw_bytes: 0,
            live: Counts::new(bins),
            missing_at: Counts::new(bins),
            dropped_at: Counts::new(bins),
            lag: Histogram::default(),
            lag_at: Values::new(bins),
            uncertainty: Histogram::default(),
            uncertain: 0,
            restarts_ns: Vec::new(),
            restarts: 0,
            first: None,
            last: None,
            missing_ns: None,
            delivered: 0,
            over_ns: 0,
        }
    }

    /// A frame captured `t_ns` after the first set.
    fn frame(&mut self, bins: TimeBins, t_ns: i64, h: &FrameHeader) {
        self.frames += 1;
        self.raw_bytes += u64::from(h.payload_len);
        let lag = h.arrival_time_ns.saturating_sub(h.capture_time_ns);
        self.lag.add(lag);
        self.lag_at.add(bins, t_ns, lag as f64);
        self.uncertainty.add(i64::try_from(h.capture_uncertainty_ns).unwrap_or(i64::MAX));
        self.uncertain += u64::from(h.has(FrameFlags::TIME_UNCERTAIN));
        if let Some((before_ns, before)) = self.last {
            // A daemon that was started again counts from the beginning.
            if let (Some(n), true) = (h.sequence.checked_sub(before.sequence), t_ns > before_ns) {
                self.live.spread(bins, before_ns, t_ns, n as f64);
                self.delivered += n;
                self.over_ns += t_ns - before_ns;
            }
            let lost = h.drops().total().saturating_sub(before.drops().total());
            self.dropped_at.add(bins, t_ns, lost as f64);
            if h.clock_epoch != before.clock_epoch {
                self.restarts += 1;
                if self.restarts_ns.len() < LISTED_MAX {
                    self.restarts_ns.push(t_ns);
                }
            }
        }
        self.first.get_or_insert((t_ns, *h));
        self.last = Some((t_ns, *h));
    }

    /// A stream present at an end of the dataset is measured up to its own frame there; an absent one has no frames
    /// until the end.
    fn live_series(&self, bins: TimeBins) -> Vec<Option<f64>> {
        let (Some((first, _)), Some((last, _))) = (self.first, self.last) else {
            return self.live.per_second(bins, 0, bins.span_ns);
        };
        let near = bins.width_ns;
        let from = if first < near { first } else { 0 };
        let to = if last > bins.span_ns - near { last } else { bins.span_ns };
        self.live.per_second(bins, from, to)
    }

    fn report(
        self,
        bins: TimeBins,
        record: crate::StreamRecord,
        account: Option<StreamAccount>,
    ) -> StreamReport {
        let whole = |c: &Counts| c.0.iter().map(|n| n.round() as u64).collect();
        StreamReport {
            record,
            codec: self.codec,
            frames: self.frames,
            missing: self.missing,
            bytes: self.bytes,
            packed_bytes: self.packed_bytes,
            is_packed: self.is_packed,
            raw_bytes: self.raw_bytes,
            live_hz: if self.over_ns > 0 { self.delivered as f64 * 1e9 / self.over_ns as f64 } else { 0.0 },
            live_hz_series: self.live_series(bins),
            missing_series: whole(&self.missing_at),
            dropped_series: whole(&self.dropped_at),
            account,
            first_ns: self.first.map(|(t, _)| t),
            last_ns: self.last.map(|(t, _)| t),
            missing_ns: self.missing_ns,
            clock: ClockReport {
                domain: self.last.map_or("", |(_, h)| domain(h.clock_domain)),
                lag_ns: self.lag.quantiles(),
                lag_series: self.lag_at.ranges(),
                uncertainty_ns: self.uncertainty.quantiles(),
                uncertain_frames: self.uncertain,
                restarts_ns: self.restarts_ns,
                restarts: self.restarts,
            },
            fill: None,
        }
    }
}

const fn domain(code: u32) -> &'static str {
    match code {
        0 => "arrival",
        1 => "device",
        2 => "kernel",
        _ => "unknown",
    }
}

/// Sums over the sets.
struct Pass {
    bins: TimeBins,
    /// Log time of the first set.
    t0_ns: i64,
    streams: Vec<Stream>,
    removed: Removed,
    units: Vec<motion::Unit>,
    signals: Vec<signal::Signal>,
    sets: u64,
    incomplete: u64,
    at: Counts,
    spread: Histogram,
    interval: Histogram,
    last_tick: Option<i64>,
    beyond_limit: u64,
    limit_ns: Option<i64>,
    problems: Vec<String>,
    problem_count: u64,
}

impl Pass {
    fn problem(&mut self, what: String) {
        self.problem_count += 1;
        if self.problems.len() < PROBLEMS_MAX && !self.problems.contains(&what) {
            self.problems.push(what);
        }
    }

    fn set(&mut self, set: DatasetSet) {
        let bins = self.bins;
        let t_ns = set.utc_ns - self.t0_ns;
        self.sets += 1;
        self.incomplete += u64::from(!set.missing.is_empty());
        if set.frames.len() > 1 {
            self.spread.add(set.spread_ns);
            self.beyond_limit += u64::from(self.limit_ns.is_some_and(|limit| set.spread_ns > limit));
        }
        if let Some(before) = self.last_tick.replace(set.tick.ns()) {
            let interval = set.tick.ns() - before;
            self.interval.add(interval);
            self.at.spread(bins, t_ns - interval, t_ns, 1.0);
        }
        let offset_ns = set.utc_offset_ns.saturating_sub(self.t0_ns);
        for batch in &set.motion {
            let unit = &mut self.units[batch.unit];
            unit.count.take(batch, set.utc_ns, &self.removed);
            unit.batch(bins, offset_ns, batch);
        }
        for part in &set.signals {
            let signal = &mut self.signals[part.signal];
            signal.count.take(&part.samples, set.utc_ns, &self.removed);
            signal.samples(bins, offset_ns, &part.samples);
        }
        for s in set.missing {
            let s = &mut self.streams[s];
            s.missing += 1;
            s.missing_at.add(bins, t_ns, 1.0);
            s.missing_ns = Some((s.missing_ns.map_or(t_ns, |(first, _)| first), t_ns));
        }
        for f in set.frames {
            let s = &mut self.streams[f.stream];
            s.codec = f.codec;
            s.bytes += f.stored_bytes;
            let at = f.header.capture_time_ns.saturating_add(set.utc_offset_ns).saturating_sub(self.t0_ns);
            s.frame(bins, at, &f.header);
        }
    }
}

pub(super) fn gather(
    dataset: &Dataset,
    options: &ReportOptions,
    progress: OnProgress<'_>,
) -> Result<Option<Report>> {
    let mut reader = dataset.set_reader()?;
    let t0_ns = reader.times().first().copied().unwrap_or(0);
    let end_ns = reader.times().last().copied().unwrap_or(0);
    let span_ns = end_ns.saturating_sub(t0_ns);
    let intervals = i64::try_from(reader.times().len()).unwrap_or(i64::MAX) - 1;
    let bins = TimeBins::new(span_ns, span_ns / intervals.max(1));
    let session = dataset.session();
    let slowest = session.streams.iter().map(|s| s.rate_hz).filter(|r| *r > 0.0).reduce(f64::min);
    let mut pass = Pass {
        bins,
        t0_ns,
        streams: session.streams.iter().map(|_| Stream::new(bins)).collect(),
        removed: Removed::of(session),
        units: session.motion.iter().map(|_| motion::Unit::new(bins)).collect(),
        signals: session.signals.iter().map(|s| signal::Signal::new(bins, s)).collect(),
        sets: 0,
        incomplete: 0,
        at: Counts::new(bins),
        spread: Histogram::default(),
        interval: Histogram::default(),
        last_tick: None,
        beyond_limit: 0,
        limit_ns: options.max_spread_ns.or(session.max_spread_ns).or(slowest.map(|hz| (0.5e9 / hz) as i64)),
        problems: Vec::new(),
        problem_count: 0,
    };
    for set in dataset.sets_with(SetRange::ALL, PixelMode::None) {
        match set {
            Ok(set) => {
                // The numbers are half of the work, the images the other half.
                let done = set.utc_ns.saturating_sub(t0_ns).saturating_mul(500) / bins.span_ns.max(1);
                pass.set(set);
                if progress(done.clamp(0, 500) as u64).is_break() {
                    return Ok(None);
                }
            }
            Err(e) if e.kind() == ErrorKind::Io => return Err(e),
            Err(e) => pass.problem(e.to_string()),
        }
    }
    let messages = read_messages(dataset, &mut pass)?;
    let mut sampled = SampledImages::new(&reader, session.streams.len(), options);
    if sampled.look(&mut reader, &mut pass, progress)?.is_break() {
        return Ok(None);
    }
    Ok(Some(put_together(dataset, pass, messages, sampled)))
}

fn put_together(dataset: &Dataset, pass: Pass, messages: MessageSummary, images: SampledImages) -> Report {
    let session = dataset.session();
    let bins = pass.bins;
    let mut accounts: BTreeMap<String, StreamAccount> =
        messages.accounts.into_iter().map(|a| (a.stream.to_string(), a)).collect();
    let records = session.streams.iter().cloned();
    let mut streams: Vec<_> = (pass.streams.into_iter().zip(records))
        .map(|(s, record)| {
            let account = accounts.remove(&record.id.to_string());
            s.report(bins, record, account)
        })
        .collect();
    let motion = (pass.units.into_iter().zip(&session.motion))
        .map(|(u, record)| {
            let account = accounts.remove(&record.id.to_string());
            u.report(record.clone(), account)
        })
        .collect();
    let signals = (pass.signals.into_iter().zip(&session.signals))
        .map(|(s, record)| {
            let account = accounts.remove(&record.id.to_string());
            s.report(record, pass.last_tick, account)
        })
        .collect();
    for (s, samples) in streams.iter_mut().zip(images.fill) {
        s.fill = fill_of(samples);
    }
    // The outcome does not apply to a single segment.
    let outcome = session.outcome.as_ref().filter(|_| dataset.is_folder());
    let sets = SetsReport {
        count: pass.sets,
        incomplete: pass.incomplete,
        duration_ns: bins.span_ns,
        interval_ns: pass.interval.quantiles(),
        counts: SetsAccount::known(messages.counts.as_ref(), outcome),
        per_second: pass.at.per_second(bins, 0, bins.span_ns),
        spread_ns: pass.spread.quantiles(),
        spread_histogram: linear(&pass.spread, pass.limit_ns),
        spread_limit_ns: pass.limit_ns,
        beyond_limit: pass.beyond_limit,
    };
    let mut report = Report {
        path: dataset.path().to_owned(),
        name: session.name.clone(),
        rig: session.rig.clone(),
        scene: session.scene.clone(),
        operator: session.operator.clone(),
        host: session.host.clone(),
        depthrig_version: session.depthrig_version.clone(),
        started_utc_ns: session.started_utc_ns,
        notes: session.notes.clone(),
        episodes: session.episodes.clone(),
        history: session.history.clone(),
        computed: session.computed.clone(),
        verdict: verdict::unknown(),
        sets,
        bins,
        streams,
        motion,
        signals,
        host_clock: messages.clock.report(),
        bytes: messages.bytes,
        segments: dataset.segments().len(),
        unfinished: messages.unfinished,
        problems: pass.problems,
        problem_count: pass.problem_count,
        sampled: images.sampled,
        images: images.images,
    };
    let catalog = dataset.is_folder().then(|| look_at(dataset.fs(), dataset.path()));
    report.verdict = verdict::of(&report, catalog.as_ref());
    report
}

fn fill_of(samples: Vec<(i64, f64)>) -> Option<Fill> {
    let values = samples.iter().map(|(_, share)| *share);
    let min = values.clone().reduce(f64::min)?;
    let max = values.clone().reduce(f64::max)?;
    let mean = values.sum::<f64>() / samples.len() as f64;
    Some(Fill { samples, min, mean, max })
}

/// Bars that show nearly all spreads and the limit.
fn linear(spread: &Histogram, limit_ns: Option<i64>) -> LinearHistogram {
    if spread.total() == 0 {
        return LinearHistogram::default();
    }
    let most = spread.quantile(999, 1000).max(limit_ns.unwrap_or(0)).max(1000);
    let width_ns = super::svg::nice_step(most as f64 * 1.05 / BARS as f64) as i64;
    let (counts, beyond) = spread.linear(width_ns.max(1), (most / width_ns.max(1) + 1) as usize);
    LinearHistogram { width_ns, counts, beyond }
}
