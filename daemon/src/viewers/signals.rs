//! Signals for those who look: a page asks for those that it shows, again and again, and each answer has what came since the last one.
//!
//! A channel is open only while a page shows its signal, once for all pages. Samples are thinned to what a small plot can show, and the oldest go
//! first: a page that is slow asks less often and gets fewer of them, and nothing waits for it.

use crate::{Error, ErrorKind, Result};
use depthrig_bus::sync::lock;
use depthrig_bus::{
    FieldType, HostTime, RuntimeDir, SignalField, SignalFlags, SignalName, SignalSample, SignalSubscriber,
    Signals, Value,
};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::{Arc, Mutex};

/// Signals that a page may show.
const MAX_SHOWN: usize = 64;
/// Of so many nanoseconds a plot has one sample, the last.
const POINT_NS: i64 = 50_000_000;
/// Points of a signal that are kept: ten seconds of them.
const MAX_POINTS: usize = 200;
/// Elements of a sample that are plotted.
const MAX_LINES: usize = 32;
/// Elements of the newest sample that are sent.
const MAX_ELEMENTS: usize = 64;
/// The rate is that of so much time.
const RATE_OVER_NS: i64 = 3_000_000_000;
/// Pause before a signal that could not be opened is tried again.
const RETRY_NS: i64 = 1_000_000_000;
/// Integers up to here are numbers in every reader of JSON.
const MAX_EXACT: u64 = 1 << 53;

/// A signal that a page shows.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Shown {
    /// Its name, `DEVICE/SIGNAL`.
    pub signal: String,
    /// Number of the last point that the page has; 0: it has none.
    #[serde(default)]
    pub after: u64,
}

/// The answer.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct News {
    /// Signals that are published now, by name.
    pub published: Vec<String>,
    /// Those that the page shows, as far as something is known of them.
    pub signals: Vec<SignalNews>,
}

/// The news of a signal.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct SignalNews {
    /// Its name.
    pub signal: String,
    /// Why it cannot be read.
    pub problem: Option<String>,
    /// Its fields; none before the first sample.
    pub fields: Vec<SignalField>,
    /// The elements of each field in the newest sample, the first 64 of all; `null` for one that is not a number.
    pub values: Vec<Vec<Element>>,
    /// Age of the newest sample, seconds.
    pub age_s: Option<f64>,
    /// Samples a second, with those that were lost; `None` before it is known.
    pub rate_hz: Option<f64>,
    /// Times that another publisher took over, since a page shows it.
    pub restarts: u64,
    /// The points that the page does not have.
    pub points: Vec<Point>,
}

/// An element of a field as JSON.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(untagged)]
pub(crate) enum Element {
    F64(f64),
    F32(f32),
    I64(i64),
    Bool(bool),
    Text(String),
}

/// A point of each line of a plot.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct Point {
    /// Its number among all points of all signals, from 1.
    pub number: u64,
    /// Time of the sample, milliseconds of its clock.
    pub ms: f64,
    /// Whether samples before it were lost, or are of another publisher.
    pub gap: bool,
    /// The first 32 elements that are numbers, in the order of the fields.
    pub values: Vec<f32>,
}

/// The signals below a runtime folder, for all pages.
#[derive(Debug, Clone)]
pub(crate) struct SignalFeed {
    shared: Arc<Shared>,
}

#[derive(Debug)]
struct Shared {
    runtime: RuntimeDir,
    state: Mutex<State>,
}

#[derive(Debug, Default)]
struct State {
    /// `None` while no page shows a signal.
    signals: Option<Signals>,
    sources: BTreeMap<SignalName, Source>,
    /// The signals that each page shows.
    pages: BTreeMap<u64, BTreeSet<SignalName>>,
    next_page: u64,
    last_point: u64,
}

/// A signal that a page shows.
#[derive(Debug)]
struct Source {
    subscriber: Option<SignalSubscriber>,
    /// Earliest time of the next attempt to open it.
    retry: HostTime,
    problem: Option<String>,
    newest: Option<SignalSample>,
    heard: Option<HostTime>,
    points: VecDeque<Point>,
    /// Samples that were read or lost, at the times of the looks.
    counts: VecDeque<(HostTime, u64)>,
    samples: u64,
}

/// A page's place; dropping it leaves its signals.
#[derive(Debug)]
pub(crate) struct SignalPlace {
    feed: SignalFeed,
    number: u64,
}

impl SignalFeed {
    pub(crate) fn new(runtime: RuntimeDir) -> Self {
        Self { shared: Arc::new(Shared { runtime, state: Mutex::default() }) }
    }

    pub(crate) fn enter(&self) -> SignalPlace {
        let mut state = lock(&self.shared.state);
        state.next_page += 1;
        SignalPlace { feed: self.clone(), number: state.next_page }
    }
}

impl SignalPlace {
    /// Shows these signals and no others, and returns what is new of them, and which ones there are.
    ///
    /// # Errors
    /// `BadInput` for too many and for an invalid name; those of [`Signals::open`].
    pub(crate) fn show(&self, shown: &[Shown]) -> Result<News> {
        if shown.len() > MAX_SHOWN {
            let what = format!("{} signals are out of range 0..={MAX_SHOWN}", shown.len());
            return Err(Error::new(ErrorKind::BadInput, what));
        }
        let mut wanted = BTreeMap::new();
        for Shown { signal, after } in shown {
            let name: SignalName = signal.parse().map_err(|_| {
                let what = format!("invalid signal name \"{signal}\"; write DEVICE/SIGNAL");
                Error::new(ErrorKind::BadInput, what)
            })?;
            wanted.insert(name, *after);
        }
        let mut state = lock(&self.feed.shared.state);
        state.change(self.number, Some(wanted.keys().cloned().collect()));
        state.look(&self.feed.shared.runtime, &wanted)
    }

    /// Shows none any more.
    pub(crate) fn leave(&self) {
        lock(&self.feed.shared.state).change(self.number, None);
    }
}

impl Drop for SignalPlace {
    fn drop(&mut self) {
        self.leave();
    }
}

impl State {
    /// Takes over what a page shows, and closes what none shows; `None`: it does not even show which signals there are.
    fn change(&mut self, page: u64, shown: Option<BTreeSet<SignalName>>) {
        match shown {
            Some(shown) => self.pages.insert(page, shown),
            None => self.pages.remove(&page),
        };
        let pages = &self.pages;
        self.sources.retain(|name, _| pages.values().any(|shown| shown.contains(name)));
        if self.pages.is_empty() {
            self.signals = None;
        }
    }

    fn look(&mut self, runtime: &RuntimeDir, wanted: &BTreeMap<SignalName, u64>) -> Result<News> {
        let signals = match &mut self.signals {
            Some(signals) => signals,
            closed => closed.insert(Signals::open(runtime)?),
        };
        let published: Vec<SignalName> = signals.published().into_iter().map(|(name, _)| name).collect();
        let mut news = Vec::new();
        for (name, after) in wanted {
            let source = self.sources.entry(name.clone()).or_insert_with(Source::new);
            source.open(signals, name, published.contains(name));
            source.read(&mut self.last_point);
            news.push(source.news(name, *after));
        }
        Ok(News { published: published.iter().map(ToString::to_string).collect(), signals: news })
    }
}

impl Source {
    fn new() -> Self {
        Self {
            subscriber: None,
            retry: HostTime::now(),
            problem: None,
            newest: None,
            heard: None,
            points: VecDeque::new(),
            counts: VecDeque::new(),
            samples: 0,
        }
    }

    fn open(&mut self, signals: &Signals, name: &SignalName, is_published: bool) {
        if self.subscriber.is_some() || !is_published || !self.retry.from_now().is_zero() {
            return;
        }
        match signals.subscriber(name) {
            Ok(subscriber) => {
                self.subscriber = Some(subscriber);
                self.problem = None;
            }
            Err(e) => {
                self.retry = HostTime::now().plus_ns(RETRY_NS);
                // Its publisher is just opening the channel.
                self.problem = (e.kind() != depthrig_bus::ErrorKind::NotFound).then(|| e.to_string());
            }
        }
    }

    /// Reads what came since the last look; no more than may wait, so that a fast publisher cannot hold this thread.
    fn read(&mut self, last_point: &mut u64) {
        let Some(subscriber) = &mut self.subscriber else { return };
        let now = HostTime::now();
        for _ in 0..depthrig_bus::signal::BUFFER {
            let missed_before = subscriber.missed();
            let restarts_before = subscriber.restarts();
            match subscriber.try_next() {
                Ok(Some(sample)) => {
                    let is_first = self.newest.is_none();
                    let missed = subscriber.missed() - missed_before;
                    let is_gap = !is_first && (missed > 0 || subscriber.restarts() > restarts_before);
                    self.samples += 1 + if is_first { 0 } else { missed };
                    self.heard = Some(now);
                    self.problem = None;
                    *last_point += 1;
                    add_point(&mut self.points, &sample, *last_point, is_gap);
                    self.newest = Some(sample);
                }
                Ok(None) => break,
                Err(e) => self.problem = Some(e.to_string()),
            }
        }
        self.counts.push_back((now, self.samples));
        while self.counts.len() > 2 && now.since_ns(self.counts[1].0) > RATE_OVER_NS {
            self.counts.pop_front();
        }
    }

    /// Samples a second over the last looks.
    fn rate_hz(&self) -> Option<f64> {
        let (from, first) = self.counts.front()?;
        let (to, last) = self.counts.back()?;
        let seconds = to.since_ns(*from) as f64 / 1e9;
        (seconds > 0.5).then(|| (last - first) as f64 / seconds)
    }

    /// Age of the newest sample. The times of a replay are those of its recording: there it is how long ago the sample came.
    fn age_s(&self) -> Option<f64> {
        let sample = self.newest.as_ref()?;
        let since = if sample.has(SignalFlags::REPLAYED) { self.heard? } else { sample.time() };
        Some(HostTime::now().since_ns(since).max(0) as f64 / 1e9)
    }

    fn news(&self, name: &SignalName, after: u64) -> SignalNews {
        let description = self.newest.as_ref().map(SignalSample::description);
        SignalNews {
            signal: name.to_string(),
            problem: self.problem.clone(),
            fields: description.map(|d| d.all_fields().to_vec()).unwrap_or_default(),
            values: self.newest.as_ref().map(values).unwrap_or_default(),
            age_s: self.age_s(),
            rate_hz: self.rate_hz(),
            restarts: self.subscriber.as_ref().map_or(0, SignalSubscriber::restarts),
            points: self.points.iter().filter(|p| p.number > after).cloned().collect(),
        }
    }
}

/// Adds a point, or replaces the last one if it is of the same moment.
fn add_point(points: &mut VecDeque<Point>, sample: &SignalSample, number: u64, is_gap: bool) {
    let time = sample.time().ns();
    let lines = sample.description().all_fields().iter().filter(|f| is_plotted(f.kind));
    let values: Vec<f32> = lines
        .flat_map(|f| sample.field(&f.name))
        .filter_map(Value::number)
        .map(|x| x as f32)
        .take(MAX_LINES)
        .collect();
    let mut point = Point { number, ms: time as f64 / 1e6, gap: is_gap, values };
    if let Some(last) = points.back()
        && ((last.ms * 1e6) as i64).div_euclid(POINT_NS) == time.div_euclid(POINT_NS)
        && !is_gap
    {
        point.gap = last.gap;
        points.pop_back();
    }
    points.push_back(point);
    if points.len() > MAX_POINTS {
        points.pop_front();
    }
}

/// Whether elements of this type are lines of a plot; others are shown as text.
const fn is_plotted(kind: FieldType) -> bool {
    matches!(kind, FieldType::F64 | FieldType::F32 | FieldType::I64)
}

/// The elements of each field, the first [`MAX_ELEMENTS`] of all.
fn values(sample: &SignalSample) -> Vec<Vec<Element>> {
    let mut left = MAX_ELEMENTS;
    let fields = sample.description().all_fields().iter();
    fields
        .map(|field| {
            let elements: Vec<_> = sample.field(&field.name).take(left).map(Element::from).collect();
            left -= elements.len();
            elements
        })
        .collect()
}

impl From<Value<'_>> for Element {
    fn from(value: Value<'_>) -> Self {
        match value {
            Value::F64(x) => Self::F64(x),
            Value::F32(x) => Self::F32(x),
            Value::I64(x) if x.unsigned_abs() > MAX_EXACT => Self::Text(x.to_string()),
            Value::I64(x) => Self::I64(x),
            Value::Bool(x) => Self::Bool(x),
            Value::Text(x) => Self::Text(x.to_owned()),
        }
    }
}

#[cfg(test)]
mod tests;
