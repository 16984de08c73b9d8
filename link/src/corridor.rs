//! The offset between two hosts' clocks, with a bound that holds, from exchanges of four stamps.
//!
//! A packet cannot arrive before it was sent. So `t2 − t1` of each exchange (remote receipt minus local sending) is at least the
//! offset at `t1`, and `t3 − t4` at most the offset at `t4`: the offset over local time passes below all points of the first kind and above all
//! of the second. Over ten seconds two crystals differ by a straight line. Of the lines in this corridor the one with the most
//! room is the estimate, in the middle of it, and the range of all of them is its uncertainty. A queue in the network only
//! adds points that bound nothing; an asymmetry of the route stays unseen, as for every two-way exchange, but it is within
//! the uncertainty as long as neither way is negative. While a clock is being slewed, and until the corridor has bent, in a few
//! exchanges, the error is bounded by the round trip alone.
//!
//! The two edges of the corridor are convex hulls, those of [`depthrig_driver::clock`].

use core::time::Duration;
use depthrig_bus::HostTime;
use depthrig_driver::clock::{Hull, Line, Point};
use serde::{Deserialize, Serialize};
use std::collections::VecDeque;

/// History that the corridor is made of.
const WINDOW: Duration = Duration::from_secs(10);
/// Largest rate of one clock against the other, minus one: two bad crystals, one of them slewed by NTP.
const MAX_RATE: f64 = 1e-3;
/// Rate at which two crystals may leave the line after the last exchange.
const WANDER: f64 = 2e-6;
/// Points that are closer together do not speak for a rate other than that of a good crystal, nanoseconds.
const LEVER: f64 = 2e8;
/// Exchanges kept to begin the corridor anew, and heard after a bend that may be a step: three seconds at 20 Hz.
const RECENT: usize = 64;
/// Halvings of the range of rates: to 1e-15.
const STEPS: usize = 40;
/// An exchange that took longer says nothing that the corridor needs.
const LONGEST: Duration = Duration::from_secs(2);
/// Times beyond this many nanoseconds (36 years) are nonsense, and sums of them could overflow.
const FAR_NS: i64 = i64::MAX / 8;

/// Four stamps of one question and its answer, each on the `CLOCK_MONOTONIC` of the host that took it, nanoseconds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Exchange {
    /// The question was sent; local.
    pub t1: i64,
    /// The question had arrived; remote.
    pub t2: i64,
    /// The answer was sent; remote.
    pub t3: i64,
    /// The answer had arrived; local.
    pub t4: i64,
}

impl Exchange {
    /// Time on the way, both ways together, nanoseconds.
    pub const fn round_trip_ns(&self) -> i64 {
        (self.t4 - self.t1) - (self.t3 - self.t2)
    }

    /// Whether the stamps can be true at all.
    const fn is_possible(&self) -> bool {
        let in_range = self.t1.saturating_abs() < FAR_NS
            && self.t2.saturating_abs() < FAR_NS
            && self.t3.saturating_abs() < FAR_NS
            && self.t4.saturating_abs() < FAR_NS;
        in_range
            && self.t4 >= self.t1
            && self.t3 >= self.t2
            && self.t4 - self.t1 < LONGEST.as_nanos() as i64
            && self.t3 - self.t2 <= self.t4 - self.t1
    }
}

/// Effect of an exchange on the corridor.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Taken {
    /// It fits.
    Fits,
    /// A clock changed its rate: older exchanges were forgotten, the offset went on where it was.
    Bent,
    /// A clock stepped, or the remote host started anew: a new epoch began.
    Stepped,
    /// Its stamps contradict each other.
    Refused,
}

/// The remote clock at a local time.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Reading {
    /// Remote minus local, nanoseconds.
    pub offset_ns: i64,
    /// The offset is wrong by no more than this, nanoseconds.
    pub uncertainty_ns: u64,
    /// Rate of the remote clock over the local one, minus one.
    pub rate: f64,
    /// Counts steps of the clocks; times of different epochs cannot be compared.
    pub epoch: u32,
}

impl Reading {
    /// The reading `ns` later (earlier, if negative) on the local clock, without another exchange: its uncertainty has grown.
    pub fn moved(self, ns: i64) -> Self {
        let moved_ns = (ns as f64 * self.rate).round() as i64;
        let grown_ns = (ns.unsigned_abs() as f64 * WANDER).ceil() as u64;
        Self {
            offset_ns: self.offset_ns.saturating_add(moved_ns),
            uncertainty_ns: self.uncertainty_ns.saturating_add(grown_ns),
            ..self
        }
    }
}

/// All that the exchanges so far say of the remote clock.
#[derive(Debug, Clone, Copy)]
pub struct Estimate {
    lines: Lines,
    /// Local time and offset that the lines are relative to.
    origin: (i64, i64),
    newest: i64,
    epoch: u32,
}

/// The lines through the corridor; `x` is local time, `d` the offset, both relative to the epoch's first exchange.
#[derive(Debug, Clone, Copy)]
struct Lines {
    /// In the middle of the most room.
    rate: f64,
    low: Line,
    high: Line,
    /// The steepest and the flattest line that fit, where they touch the edge.
    steepest: Line,
    flattest: Line,
}

/// Offset of one remote clock.
#[derive(Debug)]
pub struct Corridor {
    /// Points that the offset lies below, and (negated) those that it lies above.
    above: Hull,
    below: Hull,
    recent: VecDeque<Exchange>,
    /// Local time and offset that points are relative to.
    origin: (i64, i64),
    /// When the newest question was sent, and the newest answer had arrived; local.
    asked: i64,
    newest: i64,
    lines: Option<Lines>,
    epoch: u32,
    bend: Option<Bend>,
}

/// A bend that may be a step: the exchange beside the old lines took so long that those that fit it say little.
#[derive(Debug)]
struct Bend {
    before: Estimate,
    /// Local time of the bend.
    at: i64,
    /// By how much a slewed clock may have left the old lines by then, nanoseconds.
    slewed: u64,
    /// Exchanges that may still show a step.
    left: usize,
}

impl Default for Corridor {
    fn default() -> Self {
        let window_ns = WINDOW.as_nanos() as i64;
        Self {
            above: Hull::new(window_ns, window_ns / 2),
            below: Hull::new(window_ns, window_ns / 2),
            recent: VecDeque::with_capacity(RECENT),
            origin: (0, 0),
            asked: i64::MIN,
            newest: i64::MIN,
            lines: None,
            epoch: 0,
            bend: None,
        }
    }
}

impl Estimate {
    /// The remote clock at a local time. Its uncertainty grows with the time since the last exchange.
    pub fn at(&self, local: HostTime) -> Reading {
        let lines = &self.lines;
        let x = local.ns().saturating_sub(self.origin.0);
        let middle = f64::midpoint(lines.low.at(x), lines.high.at(x));
        // Between exchanges the extremes are at most this much further apart than the steepest and the flattest line say.
        let before = (self.newest.saturating_sub(local.ns())).max(0) as f64;
        let after = (local.ns().saturating_sub(self.newest)).max(0) as f64;
        let top = lines.steepest.at(x).max(lines.high.at(x));
        let bottom = lines.flattest.at(x).min(lines.low.at(x));
        let range = (top - middle).max(middle - bottom);
        let turn = before * (lines.steepest.slope - lines.flattest.slope);
        Reading {
            offset_ns: self.origin.1.saturating_add(middle.round() as i64),
            uncertainty_ns: (range + turn + after * WANDER).ceil() as u64 + 1,
            rate: lines.rate,
            epoch: self.epoch,
        }
    }
}

impl Corridor {
    /// Takes an exchange that was sent after the one before.
    pub fn take(&mut self, e: Exchange) -> Taken {
        if !e.is_possible() || e.t1 <= self.asked {
            return Taken::Refused;
        }
        let before = self.estimate();
        if self.recent.len() == RECENT {
            self.recent.pop_front();
        }
        self.recent.push_back(e);
        if self.lines.is_some() {
            self.push(e);
            if self.find() {
                return self.settle();
            }
        }
        // No line fits: the newest exchanges that one does fit are the new corridor.
        let mut from = self.recent.len() - 1;
        let all = core::mem::take(&mut self.recent);
        self.begin(&all, from);
        while from > 0 && self.begin(&all, from - 1) {
            from -= 1;
        }
        self.begin(&all, from);
        // An older exchange would have shown a clock that was off by more than its round trip.
        let older = all.range(..all.len() - 1);
        let slewed = older.map(|old| old.round_trip_ns().cast_unsigned() + slew_ns(old.t4, e.t4)).min();
        self.recent = all;
        self.recent.drain(..from);
        let first =
            before.zip(slewed).map(|(before, slewed)| Bend { before, at: e.t4, slewed, left: RECENT });
        let earlier = self.bend.take();
        if first.as_ref().is_some_and(|b| self.went_on(b)) && earlier.as_ref().is_none_or(|b| self.went_on(b))
        {
            self.bend = earlier.or(first).map(|bend| Bend { left: RECENT, ..bend });
            return Taken::Bent;
        }
        self.epoch = self.epoch.saturating_add(1);
        Taken::Stepped
    }

    /// Takes back the last bend if an exchange that fits shows that it was a step.
    fn settle(&mut self) -> Taken {
        let Some(bend) = self.bend.take() else { return Taken::Fits };
        if self.went_on(&bend) {
            self.bend = bend.left.checked_sub(1).map(|left| Bend { left, ..bend });
            return Taken::Fits;
        }
        // Those before it may have been on their way when the clock stepped.
        self.recent.drain(..self.recent.len() - 1);
        let newest = core::mem::take(&mut self.recent);
        self.begin(&newest, 0);
        self.recent = newest;
        self.epoch = self.epoch.saturating_add(1);
        Taken::Stepped
    }

    /// True if a slewed clock may have led from the lines before a bend to the present offset.
    fn went_on(&self, bend: &Bend) -> bool {
        let here = HostTime::from_ns(self.newest);
        self.at(here).is_some_and(|now| {
            let old = bend.before.at(here);
            let bound = [now.uncertainty_ns, bend.slewed, slew_ns(bend.at, self.newest)];
            let bound = bound.iter().fold(old.uncertainty_ns, |sum, more| sum.saturating_add(*more));
            old.offset_ns.abs_diff(now.offset_ns) <= bound
        })
    }

    /// Forgets every exchange: the next one begins an epoch.
    pub fn restart(&mut self) {
        self.lines = None;
        self.bend = None;
        self.recent.clear();
    }

    /// The estimate; none before the first exchange.
    pub fn estimate(&self) -> Option<Estimate> {
        let Self { origin, newest, epoch, .. } = *self;
        self.lines.map(|lines| Estimate { lines, origin, newest, epoch })
    }

    /// As [`Estimate::at`]; none before the first exchange.
    pub fn at(&self, local: HostTime) -> Option<Reading> {
        self.estimate().map(|estimate| estimate.at(local))
    }

    /// Begins the corridor with these exchanges from `from` on; `false` when no line fits them.
    fn begin(&mut self, all: &VecDeque<Exchange>, from: usize) -> bool {
        self.above.clear();
        self.below.clear();
        self.lines = None;
        if let Some(first) = all.get(from) {
            self.origin = (first.t1, first.t2 - first.t1);
        }
        all.range(from..).for_each(|e| self.push(*e));
        self.find()
    }

    /// Narrows the corridor.
    fn push(&mut self, e: Exchange) {
        let rate = self.lines.map_or(0.0, |l| l.rate);
        let (x0, d0) = self.origin;
        self.above.push(Point { x: e.t1 - x0, d: e.t2 - e.t1 - d0 }, rate);
        self.below.push(Point { x: e.t4 - x0, d: d0 - (e.t3 - e.t4) }, -rate);
        self.asked = e.t1;
        self.newest = self.newest.max(e.t4);
    }

    /// Finds the lines that fit; `false` when none does.
    fn find(&mut self) -> bool {
        self.lines = self.fit(self.newest - self.origin.0);
        self.lines.is_some()
    }

    /// The lines that fit, seen from `x`.
    fn fit(&self, x: i64) -> Option<Lines> {
        // Room for lines of a slope; it is concave in the slope.
        let room = |slope: f64| {
            let (low, high) = self.edges(slope)?;
            Some(high.at(x) - low.at(x))
        };
        let widest = |lever: f64| {
            let (mut from, mut to) = (-MAX_RATE, MAX_RATE);
            for _ in 0..2 * STEPS {
                let third = (to - from) / 3.0;
                let flatter = from + third;
                let steeper = to - third;
                if room(flatter)? - lever * flatter.abs() < room(steeper)? - lever * steeper.abs() {
                    from = flatter;
                } else {
                    to = steeper;
                }
            }
            Some(f64::midpoint(from, to))
        };
        let mut rate = widest(LEVER)?;
        if room(rate)? < 0.0 {
            rate = widest(0.0)?;
        }
        if room(rate)? < 0.0 {
            return None;
        }
        let limit = |end: f64| {
            let (mut inside, mut outside) = (rate, end);
            if room(end)? >= 0.0 {
                return Some(end);
            }
            for _ in 0..STEPS {
                let middle = f64::midpoint(inside, outside);
                if room(middle)? >= 0.0 {
                    inside = middle;
                } else {
                    outside = middle;
                }
            }
            Some(outside)
        };
        let (low, high) = self.edges(rate)?;
        let (_, steepest) = self.edges(limit(MAX_RATE)?)?;
        let (flattest, _) = self.edges(limit(-MAX_RATE)?)?;
        Some(Lines { rate, low, high, steepest, flattest })
    }

    /// The lowest and the highest line of a slope that the points allow, if there is room between them.
    fn edges(&self, slope: f64) -> Option<(Line, Line)> {
        let high = self.above.support(slope)?;
        let low = self.below.support(-slope)?;
        Some((Line { x0: low.x0, d0: -low.d0, slope }, high))
    }
}

/// By how much a clock may leave its line in this local time: rates of [`MAX_RATE`] to both sides, for [`WINDOW`] at most, as
/// what was away for longer may as well have stepped.
fn slew_ns(from: i64, to: i64) -> u64 {
    let slewed = to.saturating_sub(from).clamp(0, WINDOW.as_nanos() as i64);
    (slewed as f64 * 2.0 * MAX_RATE).ceil() as u64
}

#[cfg(test)]
mod tests;
