//! The device clock mapped to the host's clock, from nothing but frames and when they arrived.
//!
//! A frame arrives late by a latency that is never less than some constant and mostly little more. So the points
//! (device time, arrival) lie above a line, the line of a delivery without jitter, and the fastest frames touch
//! it: the lower convex hull of the last minute is that line, and a frame that arrives 200 ms late takes no part
//! in it. A mean or a least-squares fit would follow the late ones (measured: 1.3 ms to 24 ms at p99, against
//! 5 µs). The method is that of Moon, Skelly and Towsley (1999) and Zhang, Liu and Xia (2002).
//!
//! One-way stamps cannot reveal that least latency itself. Until [`ClockMap::probe`] is called or
//! [`ClockConfig::latency_ns`] is set, capture times are late by it (commonly 1 ms to 20 ms with USB, the same for
//! every frame) and [`ClockQuality::latency_known`] is false. [`Mapped::uncertainty_ns`] leaves it out then, and
//! covers the truth itself afterwards. For the same reason a latency that changes for good cannot be distinguished
//! from a clock that stepped: up to 20 ms the map follows within a window, above that it starts a new epoch.
//!
//! Invariants, whatever the device sends:
//! 1. Within an epoch capture times never run backwards, and no capture time is later than its frame's arrival.
//! 2. Between frames of a warm epoch the line moves by at most 200 µs per second of time, unless it must fall
//!    to keep 1.
//! 3. A frame whose device time is in doubt (clock step, restart, backward stamp) carries
//!    [`FrameFlags::TIME_UNCERTAIN`]; the decision takes five frames. So does one of a device that is asked for its
//!    clock ([`ClockMap::expect_probes`]) and has not answered yet.
//! 4. Memory is bounded, and a frame costs amortised constant time.

mod hull;
mod judge;
mod probe;
mod trust;
mod types;
mod unwrap;

use depthrig_bus::{FrameFlags, HostTime};
pub use hull::{Hull, Line, Point};
use judge::Verdict;
use probe::{Latency, Probes};
use trust::{Residuals, Trust};
pub use types::{CalibratedLatency, ClockConfig, ClockQuality, Mapped};
use unwrap::Counter;

/// Arrivals this far below the line cannot be luck: a clock stepped.
const STEP_NS: i64 = 20_000_000;
/// Frames that decide a restart, and frames of a new epoch until its times are called certain.
const DECIDING_FRAMES: usize = 5;
/// Largest drift of two crystals against each other while no frame comes.
const PAUSE_DRIFT: f64 = 20e-6;
/// Largest rate of a crystal; beyond it the edge of the hull is bad.
const MAX_RATE: f64 = 500e-6;
/// How fast a published line may move to where it should be.
const SLEW: f64 = 200e-6;
/// History from which on the hull's slope is used.
const WARM_NS: i64 = 5_000_000_000;
/// History from which on a probe is measured once; until then the slope may turn, and the probes with it.
const SETTLED_NS: i64 = 4 * WARM_NS;
/// Arrivals more than 20 ms above the line for this long are more than a stall.
const HIGH_SUSPECT_NS: i64 = 1_000_000_000;
/// Furthest that times are kept from an epoch's first frame (31 years), so that sums cannot overflow.
const FAR_NS: i64 = 1_000_000_000_000_000_000;

/// A frame as the map keeps it.
#[derive(Debug, Clone, Copy)]
struct Seen {
    raw: u64,
    /// Ticks since the epoch's first frame.
    ticks: i64,
    sequence: u64,
    arrival: HostTime,
}

/// State of the epoch in force; it ends with the epoch.
#[derive(Debug)]
struct Epoch {
    first: Seen,
    last: Seen,
    /// Frames taken in.
    frames: u64,
    newest_x: i64,
    line: Line,
    /// Published height of the line over `shown_x`, and that point.
    shown_d: f64,
    shown_x: i64,
    /// The arrival since which all arrivals were 20 ms above the line or more.
    high_since: Option<i64>,
    /// How far above the lowest of them was, nanoseconds.
    high_least: i64,
}

/// Maps one device's counter to the host's clock. One for each stream, since two streams of a clock may arrive crossed.
#[derive(Debug)]
pub struct ClockMap {
    config: ClockConfig,
    counter: Counter,
    /// None until the first frame, and again after [`restart`](Self::restart).
    epoch: Option<Epoch>,
    epochs: u32,
    hull: Hull,
    /// Host rate over device rate, minus one: the last that was believed.
    rate: f64,
    rate_known: bool,
    /// Device time from frame to frame as it comes, nanoseconds.
    period_ns: f64,
    residuals: Residuals,
    trust: Trust,
    claim_ns: f64,
    probes: Probes,
    latency: Option<Latency>,
    /// The latency is that of probes in an epoch that is over.
    is_carried: bool,
    /// Somebody asks the device for its clock, so that not to know the latency is a state that passes.
    is_asked: bool,
    shown_latency: f64,
    /// Frames that may be the first of a restarted device.
    pending: Vec<Seen>,
    last_capture: HostTime,
    late: u64,
    uncertain: u64,
}

impl ClockMap {
    /// A map that has seen nothing.
    pub fn new(config: ClockConfig) -> Self {
        let config = config.in_range();
        let known = config.latency_ns > 0;
        Self {
            counter: Counter::new(config.counter_bits, config.tick_ns),
            epoch: None,
            epochs: 0,
            hull: Hull::new(config.window_ns, WARM_NS),
            rate: 0.0,
            rate_known: false,
            period_ns: config.period_ns as f64,
            residuals: Residuals::new(),
            trust: Trust::new(),
            claim_ns: 0.0,
            probes: Probes::default(),
            latency: known.then_some(Latency { ns: config.latency_ns, bound_ns: config.latency_bound_ns }),
            is_carried: false,
            is_asked: false,
            shown_latency: config.latency_ns as f64,
            pending: Vec::with_capacity(DECIDING_FRAMES),
            last_capture: HostTime::from_ns(i64::MIN),
            late: 0,
            uncertain: 0,
            config,
        }
    }

    /// The configuration in force.
    pub fn config(&self) -> &ClockConfig {
        &self.config
    }

    /// The device was reopened: its counter may have started anew. The next frame begins an epoch.
    pub fn restart(&mut self) {
        self.epoch = None;
        self.pending.clear();
    }

    /// Takes one frame: the counter as the device gave it, the device's frame number (a constant if it has none),
    /// and the host's time when its bytes were complete. Frames come in the order of their arrival.
    pub fn observe(&mut self, raw_ticks: u64, device_sequence: u64, arrival: HostTime) -> Mapped {
        let fresh = Seen { raw: raw_ticks, ticks: 0, sequence: device_sequence, arrival };
        let epochs_before = self.epochs;
        let mapped = match self.epoch.take() {
            None => self.begin_epoch(&[], fresh),
            Some(mut epoch) => match self.judge(&epoch, fresh) {
                Verdict::NewEpoch => self.begin_epoch(&[], fresh),
                Verdict::Follows(seen) => {
                    self.pending.clear();
                    self.take(&mut epoch, seen);
                    self.publish(epoch, seen)
                }
                Verdict::Doubtful(seen) => self.doubt(epoch, seen),
            },
        };
        let changed = epochs_before > 0 && self.epochs != epochs_before;
        let flags = mapped.flags.with(epoch_changed(changed)).with(self.latency_flags());
        let mapped = Mapped { flags, ..mapped };
        self.last_capture = mapped.capture_time;
        self.late += u64::from(mapped.flags.0 & FrameFlags::LATE.0 != 0);
        self.uncertain += u64::from(mapped.flags.0 & FrameFlags::TIME_UNCERTAIN.0 != 0);
        mapped
    }

    /// Takes the latency that a calibration found, as if it had been configured. Probes replace it, so that a latency is never
    /// subtracted twice. Called before the first frame; afterwards the published times approach it slowly.
    pub fn calibrate(&mut self, latency: CalibratedLatency) {
        let config =
            ClockConfig { latency_ns: latency.ns, latency_bound_ns: latency.bound_ns, ..self.config };
        self.config = config.in_range();
        if !self.is_measured() {
            let Self { config, .. } = self;
            self.latency = Some(Latency { ns: config.latency_ns, bound_ns: config.latency_bound_ns });
        }
        if self.epochs == 0 {
            self.shown_latency = self.latency.map_or(0.0, |l| l.ns as f64);
        }
    }

    /// Whether the latency comes from probes.
    fn is_measured(&self) -> bool {
        self.is_carried || !self.probes.is_empty()
    }

    /// How the latency is known, for the frames' flags.
    fn latency_flags(&self) -> FrameFlags {
        match self.latency {
            _ if self.is_measured() => FrameFlags::LATENCY_MEASURED,
            Some(_) => FrameFlags::LATENCY_CALIBRATED,
            None => FrameFlags(0),
        }
    }

    /// Announces that probes of this device will come. Until the first one, its frames carry
    /// [`FrameFlags::TIME_UNCERTAIN`]: they may be late by a latency that only a probe can measure, such as the queue
    /// of a computer that is busy when the camera starts.
    pub const fn expect_probes(&mut self) {
        self.is_asked = true;
    }

    /// Takes a two-way probe: the device read its counter somewhere between two readings of the host's clock.
    ///
    /// From then on capture times are free of the constant latency, up to half the width of the tightest probes,
    /// which is part of the claimed uncertainty. In the first 20 s they are measured against the map's line anew with
    /// every frame, because that line still moves. Ignored while a restart is in doubt.
    pub fn probe(&mut self, before: HostTime, raw_ticks: u64, after: HostTime) {
        let Some(epoch) = &self.epoch else { return };
        let width_ns = after.since_ns(before);
        if !(0..FAR_NS).contains(&width_ns) || !self.pending.is_empty() {
            return;
        }
        let middle = before.plus_ns(width_ns / 2);
        let delta = self.counter.delta(epoch.last.raw, raw_ticks, middle.since_ns(epoch.last.arrival));
        let x = self.counter.ns(epoch.last.ticks.saturating_add(delta));
        let offset_ns = middle.since_ns(epoch.first.arrival).saturating_sub(x);
        let latency_ns = (epoch.line.at(x) as i64).saturating_sub(offset_ns);
        // A probe of another timeline (the device is just restarting) says nothing.
        if latency_ns.saturating_abs() < 10_000_000_000 {
            self.latency = Some(self.probes.add(x, offset_ns, width_ns, epoch.line));
            self.is_carried = false;
        }
    }

    /// Host rate over device rate, minus one, as it is believed now; 0 until it is known.
    pub const fn rate(&self) -> f64 {
        self.rate
    }

    /// How the map is doing.
    pub fn quality(&self) -> ClockQuality {
        ClockQuality {
            rate_ppm: self.rate * 1e6,
            hull_points: self.hull.len(),
            span_ns: self.hull.span_ns(),
            residual_p50_ns: self.residuals.quantile_ns(0.5),
            residual_p99_ns: self.residuals.quantile_ns(0.99),
            uncertainty_ns: self.claim_ns as u64,
            epochs: self.epochs,
            late: self.late,
            uncertain: self.uncertain,
            latency_known: self.latency.is_some(),
            latency_ns: self.shown_latency as i64,
        }
    }

    /// Starts an epoch with the frames `earlier`, whose times are out already, and `last`, which is published.
    fn begin_epoch(&mut self, earlier: &[Seen], last: Seen) -> Mapped {
        let first = Seen { ticks: 0, ..*earlier.first().unwrap_or(&last) };
        let origin = earlier.first().unwrap_or(&last).ticks;
        self.epochs = self.epochs.saturating_add(1);
        self.hull.clear();
        self.trust.restart();
        self.forget_probes();
        self.pending.clear();
        let mut epoch = Epoch {
            first,
            last: first,
            frames: 0,
            newest_x: 0,
            line: Line { x0: 0, d0: 0, slope: self.rate },
            shown_d: 0.0,
            shown_x: 0,
            high_since: None,
            high_least: i64::MAX,
        };
        let own = |f: &Seen| Seen { ticks: f.ticks.saturating_sub(origin), ..*f };
        for frame in earlier {
            self.take(&mut epoch, own(frame));
        }
        let last = own(&last);
        self.take(&mut epoch, last);
        self.publish(epoch, last)
    }

    /// The line that the probes were measured against is gone; the latency that they found is all there is for now.
    fn forget_probes(&mut self) {
        self.is_carried |= !self.probes.is_empty();
        self.probes = Probes::default();
    }

    /// Lets a frame that follows the line move the line.
    fn take(&mut self, epoch: &mut Epoch, seen: Seen) {
        let x = self.counter.ns(seen.ticks);
        let y = arrival_y(epoch, seen);
        let frames = seen.sequence.saturating_sub(epoch.last.sequence).max(1) as f64;
        let dx = self.counter.ns(seen.ticks.saturating_sub(epoch.last.ticks)) as f64;
        // The device may run at another rate than the nominal one (exposure, USB 2); within reason, believe it.
        let nominal = self.config.period_ns as f64;
        if epoch.frames > 0 && dx > 0.2 * nominal && dx < 5.0 * nominal * frames {
            self.period_ns += (dx / frames - self.period_ns) / 32.0;
        }
        epoch.last = seen;
        epoch.frames += 1;
        epoch.newest_x = epoch.newest_x.max(x);
        self.hull.push(Point { x, d: y - x }, self.rate);
        self.choose_line(epoch);
        self.residuals.add(y - x - epoch.line.at(x) as i64);
    }

    /// The edge of the hull over the middle of the window; before that makes sense, the support line of the last
    /// believed rate.
    fn choose_line(&mut self, epoch: &mut Epoch) {
        if epoch.newest_x >= WARM_NS {
            let middle = epoch.newest_x - self.hull.span_ns().min(self.config.window_ns) / 2;
            if let Some(edge) = self.hull.edge(middle)
                && edge.slope.abs() < MAX_RATE
            {
                epoch.line = edge;
                self.rate = edge.slope;
                self.rate_known = true;
                let checked = self.trust.settle(middle, |x| edge.at(x));
                if checked || self.claim_ns == 0.0 {
                    self.claim_ns = self.line_claim_ns(epoch);
                }
                self.measure_again(epoch);
                return;
            }
        }
        if let Some(line) = self.hull.support(self.rate) {
            epoch.line = line;
        }
        self.measure_again(epoch);
        self.claim_ns = self.line_claim_ns(epoch);
    }

    /// Measures the probes against a line that still turns. Once it rests on a long history each probe keeps what it
    /// measured: then the line is off at its end by the crystal's curvature, and so is what is measured there, alike.
    fn measure_again(&mut self, epoch: &Epoch) {
        if epoch.newest_x < SETTLED_NS
            && let Some(latency) = self.probes.measure_again(epoch.line)
        {
            self.latency = Some(latency);
        }
    }

    /// Largest error of the line itself, nanoseconds.
    fn line_claim_ns(&self, epoch: &Epoch) -> f64 {
        let tick_ns = self.config.tick_ns;
        // A median of exponential jitter is ln 2 of its mean; real jitter has a median, whatever its mean.
        let jitter_ns = self.residuals.quantile_ns(0.5) as f64 / core::f64::consts::LN_2;
        let frames = epoch.frames as f64;
        if epoch.newest_x < WARM_NS {
            // The lowest of n frames is some n-th of the mean jitter high; a quarter period stands for what is
            // not known yet. An unknown rate turns the line by up to its largest value.
            let period_ns = self.config.period_ns as f64 * f64::from(self.config.bunch);
            let lowest_ns = 5.0 * (period_ns / 4.0 / frames + jitter_ns) / frames;
            let rate = if self.rate_known { PAUSE_DRIFT } else { MAX_RATE };
            return lowest_ns + rate * epoch.newest_x as f64 + tick_ns;
        }
        self.trust.line_ns(jitter_ns, self.hull.count(), self.hull.span_ns()) + tick_ns
    }

    /// The frame just taken, as it goes out: the line approached at a limited speed, and the invariants.
    fn publish(&mut self, mut epoch: Epoch, seen: Seen) -> Mapped {
        let x = self.counter.ns(seen.ticks);
        let y = arrival_y(&epoch, seen);
        let period = self.period_ns * f64::from(self.config.bunch);
        let dx = (x - epoch.shown_x) as f64;
        let target_d = epoch.line.at(x);
        let target_latency = self.latency.map_or(0.0, |l| l.ns as f64);
        let warming = epoch.newest_x < WARM_NS;
        let mut flags = FrameFlags::default();
        if warming {
            flags = flags.with(FrameFlags::CLOCK_WARMUP);
            epoch.shown_d = target_d;
            self.shown_latency = target_latency;
        } else {
            let budget = SLEW * dx.clamp(0.0, 2.0 * period);
            let before = epoch.shown_d;
            let carried = before + self.rate * dx;
            let moved = (target_d - carried).clamp(-budget, budget);
            epoch.shown_d = carried + moved;
            let left = budget - moved.abs();
            self.shown_latency += (target_latency - self.shown_latency).clamp(-left, left);
        }
        epoch.shown_x = x;
        // Arrivals that stay high: a backlog, or a clock that moved and a hull that still has to forget.
        let high_ns = (y - x) as f64 - epoch.shown_d;
        let mut suspect_ns = 0.0;
        if high_ns <= STEP_NS as f64 {
            epoch.high_since = None;
        } else {
            let since = *epoch.high_since.get_or_insert(y);
            epoch.high_least = if since == y { high_ns as i64 } else { epoch.high_least.min(high_ns as i64) };
            if y - since > HIGH_SUSPECT_NS {
                flags = flags.with(FrameFlags::TIME_UNCERTAIN);
                suspect_ns = epoch.high_least as f64;
            }
            if y - since > WARM_NS && !warming && target_d - epoch.shown_d > STEP_NS as f64 {
                // The hull has forgotten: the whole window lies on the new line, so the map is warm at once.
                self.epochs = self.epochs.saturating_add(1);
                self.trust.restart();
                self.forget_probes();
                epoch.shown_d = target_d;
                epoch.high_since = None;
                suspect_ns = 0.0;
                flags = FrameFlags::default();
            }
        }
        let owed = (target_d - epoch.shown_d).abs() + (target_latency - self.shown_latency).abs();
        let base = epoch.first.arrival;
        let wish = base.plus_ns(x).plus_ns((epoch.shown_d - self.shown_latency).round() as i64);
        let step_ns = if epoch.frames > 1 { (0.5 * dx.clamp(0.0, period)) as i64 } else { 0 };
        let floor = self.last_capture.plus_ns(step_ns);
        let capture = wish.max(floor).min(seen.arrival);
        if wish > seen.arrival {
            epoch.shown_d = (y - x) as f64 + self.shown_latency;
        }
        let forced_ns = capture.since_ns(wish).saturating_abs() as f64;
        let mut bound = self.latency.map_or(0.0, |l| l.bound_ns as f64);
        if self.is_carried {
            // Its first frames may all be late alike, by what nearly every delivery has been late by at most.
            bound += self.residuals.quantile_ns(0.99) as f64;
        }
        if !warming {
            self.trust.published(x, epoch.shown_d);
        }
        // While frames pause, the two crystals drift.
        let paused = (dx - 4.0 * period).max(0.0) * PAUSE_DRIFT / 10.0;
        let mut uncertainty = self.claim_ns + owed + forced_ns + suspect_ns + bound + paused;
        // A stamp not later than the one before is invalid; the truth may be anywhere up to the arrival.
        let backward = dx <= 0.0 && epoch.frames > 1;
        if backward {
            uncertainty += seen.arrival.since_ns(capture) as f64;
        }
        let unanswered = self.is_asked && !self.is_measured();
        if unanswered
            || backward
            || epoch.frames <= DECIDING_FRAMES as u64
            || forced_ns > self.claim_ns + owed
        {
            flags = flags.with(FrameFlags::TIME_UNCERTAIN);
        }
        if seen.arrival.since_ns(capture) as f64 > 2.0 * period {
            flags = flags.with(FrameFlags::LATE);
        }
        let device_time = i128::from(epoch.first.raw) + i128::from(seen.ticks);
        self.epoch = Some(epoch);
        Mapped {
            device_time: device_time.clamp(0, i128::from(u64::MAX)) as u64,
            capture_time: capture,
            uncertainty_ns: uncertainty as u64,
            epoch: self.epochs - 1,
            flags,
            latency_ns: self.shown_latency.max(0.0).round() as u64,
        }
    }
}

/// Arrival in nanoseconds since the arrival of the epoch's first frame.
fn arrival_y(epoch: &Epoch, seen: Seen) -> i64 {
    seen.arrival.since_ns(epoch.first.arrival).clamp(-FAR_NS, FAR_NS)
}

const fn epoch_changed(yes: bool) -> FrameFlags {
    if yes { FrameFlags::EPOCH_CHANGED } else { FrameFlags(0) }
}

#[cfg(test)]
mod tests;
