//! The assembler: the tick in hand, when its set is ripe, and where the next one lies.

use super::phase::{Rhythm, best_shift};
use super::stream::{REMEMBERED, Stream};
use super::{Account, AssemblerConfig, FrameSet, Member, PhasePolicy};
use depthrig_bus::HostTime;

/// Ticks between two looks at the phase: a second at 5 Hz.
const LOOK_EVERY: u64 = 5;
/// Frames that each active stream must have shown before the phase is chosen.
const WARM_FRAMES: u64 = 8;
/// Longest period and wait.
const HOUR_NS: i64 = 3_600_000_000_000;
/// Times beyond 146 years of uptime are taken to be that: sums then cannot overflow.
const FAR_NS: i64 = i64::MAX / 2;
/// Ticks after which the phase is chosen from whichever streams there are.
const WARM_TICKS: u64 = 10;

/// Makes sets of the frames of several streams; the module says by which rules.
#[derive(Debug)]
pub struct Assembler<T> {
    config: AssemblerConfig,
    streams: Vec<Stream<T>>,
    accounts: Vec<Account>,
    /// The tick whose set is next; none until the first frame.
    tick: Option<i64>,
    ticks: u64,
    next_id: u64,
    strays: u64,
    /// Whether the phase has been chosen once.
    settled: bool,
    /// How far the ticks have still to move.
    owed: i64,
    /// The other host's clock minus this one.
    offset: i64,
    /// Streams of other hosts, for which the ticks are chosen as well.
    far: Vec<Rhythm>,
}

impl<T> Assembler<T> {
    /// An assembler of as many streams as `config.stream_period_ns` has entries, all of them active.
    pub fn new(mut config: AssemblerConfig) -> Self {
        config.period_ns = config.period_ns.clamp(1, HOUR_NS);
        config.max_wait_ns = config.max_wait_ns.clamp(0, HOUR_NS);
        config.max_pending = config.max_pending.max(1);
        let tolerance = |i: usize| config.tolerance_ns.get(i).copied();
        let periods = config.stream_period_ns.iter().enumerate();
        let streams: Vec<Stream<T>> = periods.map(|(i, p)| Stream::new(*p, tolerance(i))).collect();
        Self {
            accounts: vec![Account::default(); streams.len()],
            streams,
            tick: None,
            ticks: 0,
            next_id: 1,
            strays: 0,
            settled: config.phase != PhasePolicy::MinimiseSpread,
            owed: 0,
            offset: 0,
            far: Vec::new(),
            config,
        }
    }

    /// Has ticks lie on multiples of the period of a clock that is `offset_ns` ahead of the host's. They get there by 1 % of a period each,
    /// or, when `at_once`, with the next one.
    pub const fn align(&mut self, offset_ns: i64, at_once: bool) {
        self.offset = offset_ns;
        self.settled &= !at_once;
    }

    /// Has the phase be chosen for streams of other hosts, too; their stamps are on this host's clock.
    pub fn set_far(&mut self, far: Vec<Rhythm>) {
        self.far = far;
    }

    /// The active streams that have shown a frame, as they are expected to go on.
    pub fn rhythms(&self) -> impl Iterator<Item = Rhythm> {
        let rhythm = |s: &Stream<T>| {
            Some(Rhythm { newest_ns: s.newest?, period_ns: s.period, tolerance_ns: s.tolerance })
        };
        self.streams.iter().filter(|s| s.active).filter_map(rhythm)
    }

    /// The tick whose set is next; `None` before the first frame.
    pub fn tick(&self) -> Option<HostTime> {
        self.tick.map(HostTime::from_ns)
    }

    /// Takes a frame of a stream. Whatever cannot be in a set any more is dropped before this returns.
    pub fn push(&mut self, stream: usize, capture: HostTime, item: T) {
        let period = self.config.period_ns;
        let Some(s) = self.streams.get_mut(stream) else {
            self.strays += 1;
            return;
        };
        // The first tick is the first multiple of the period at or after the first frame, on the clock that has the grid.
        let stamp = capture.ns().clamp(-FAR_NS, FAR_NS);
        let beyond = stamp.saturating_add(self.offset).rem_euclid(period);
        let first = || stamp + (period - beyond) % period;
        let tick = *self.tick.get_or_insert_with(first);
        s.push(stamp, item);
        let next = next_at_least(&self.config, self.settled, tick);
        s.prune(tick, next, self.config.max_pending);
        self.accounts[stream] = s.account;
    }

    /// The next set that is ripe at `now`; call it until it returns `None`.
    pub fn poll(&mut self, now: HostTime) -> Option<FrameSet<T>> {
        loop {
            let tick = self.tick?;
            // Ticks up to here are ripe: either nobody could add to them, or nobody is waited for any more.
            let decided = self.streams.iter().filter(|s| s.active).map(|s| s.newest).min().flatten();
            let deadline = now.ns().clamp(-FAR_NS, FAR_NS) - self.config.max_wait_ns;
            let ripe = decided.unwrap_or(i64::MIN).max(deadline);
            if tick > ripe {
                return None;
            }
            if self.streams.iter().any(|s| s.has(tick)) {
                let set = self.assemble(tick);
                self.advance(tick, 1);
                return Some(set);
            }
            self.pass_over(tick, ripe);
        }
    }

    /// When to call [`poll`](Self::poll) even though no frame came; none while there is nothing to wait for.
    pub fn next_deadline(&self) -> Option<HostTime> {
        let waiting = self.streams.iter().any(|s| s.active || s.oldest().is_some());
        let tick = self.tick.filter(|_| waiting)?;
        Some(HostTime::from_ns(tick).plus_ns(self.config.max_wait_ns))
    }

    /// A camera was lost, or is back. Sets do not wait for a stream that is not active; frames of it that are
    /// there all the same are used.
    pub fn set_stream_active(&mut self, stream: usize, active: bool) {
        if let Some(s) = self.streams.get_mut(stream) {
            s.active = active;
        }
    }

    /// Accounts of the frames, per stream.
    pub fn accounts(&self) -> &[Account] {
        &self.accounts
    }

    /// Frames pushed for a stream that does not exist.
    pub const fn strays(&self) -> u64 {
        self.strays
    }

    fn assemble(&mut self, tick: i64) -> FrameSet<T> {
        let mut members = Vec::with_capacity(self.streams.len());
        let mut missing = 0u64;
        let mut low = i64::MAX;
        let mut high = i64::MIN;
        for (i, s) in self.streams.iter_mut().enumerate() {
            let taken = s.take(tick);
            s.sent(tick, taken.as_ref().map(|p| p.stamp));
            if let Some(p) = &taken {
                (low, high) = (low.min(p.stamp), high.max(p.stamp));
            } else {
                missing |= u32::try_from(i).ok().and_then(|i| 1u64.checked_shl(i)).unwrap_or(0);
            }
            members.push(taken.map(|p| Member {
                item: p.item,
                capture: HostTime::from_ns(p.stamp),
                skew_ns: p.stamp.saturating_sub(tick),
            }));
        }
        let id = self.next_id;
        self.next_id += 1;
        let spread_ns = high.saturating_sub(low).max(0);
        FrameSet { id, tick: HostTime::from_ns(tick), members, missing, spread_ns }
    }

    /// Goes past ticks that are ripe and have no frame, however many those are.
    fn pass_over(&mut self, tick: i64, ripe: i64) {
        // Not further than the first tick that a frame held now may be near enough to.
        let reach = |s: &Stream<T>| s.oldest().map(|o| o.saturating_sub(s.tolerance));
        let stop = self.streams.iter().filter_map(reach).min().unwrap_or(i64::MAX).min(ripe);
        let passed = (stop.saturating_sub(tick) / self.config.period_ns).max(1);
        for k in (passed - passed.min(REMEMBERED as i64))..passed {
            for s in &mut self.streams {
                s.sent(tick.saturating_add(k * self.config.period_ns), None);
            }
        }
        self.advance(tick, passed);
    }

    /// Moves on by `ticks` periods and by the phase correction that is due.
    fn advance(&mut self, tick: i64, ticks: i64) {
        self.ticks += 1;
        let next = tick.saturating_add(self.config.period_ns.saturating_mul(ticks));
        let shift = match self.config.phase {
            PhasePolicy::Fixed => 0,
            PhasePolicy::MinimiseSpread => self.shift(next),
            PhasePolicy::Aligned => self.grid_shift(next),
        };
        let tick = next.saturating_add(shift);
        self.tick = Some(tick);
        let after = next_at_least(&self.config, self.settled, tick);
        for (s, account) in self.streams.iter_mut().zip(&mut self.accounts) {
            s.prune(tick, after, self.config.max_pending);
            *account = s.account;
        }
    }

    /// The move of `next` now, towards the grid of the other clock.
    fn grid_shift(&mut self, next: i64) -> i64 {
        let period = self.config.period_ns;
        let beyond = next.saturating_add(self.offset).rem_euclid(period);
        let owed = if beyond > period / 2 { period - beyond } else { -beyond };
        let limit = shift_limit(&self.config, self.settled);
        self.settled = true;
        owed.clamp(-limit, limit)
    }

    /// How far `next` is to be moved now.
    fn shift(&mut self, next: i64) -> i64 {
        let mut active = self.streams.iter().filter(|s| s.active);
        let warm = active.all(|s| s.account.pushed >= WARM_FRAMES) || self.ticks >= WARM_TICKS;
        let limit = shift_limit(&self.config, self.settled);
        if warm && (!self.settled || self.ticks.is_multiple_of(LOOK_EVERY)) {
            let rhythms: Vec<Rhythm> = self.rhythms().chain(self.far.iter().copied()).collect();
            // All phases of the slowest stream, so that the best stretch of them is seen in full.
            let far = self.far.iter().map(|far| far.period_ns as i64).max().unwrap_or(0);
            let range = slowest(&self.config).max(far).min(self.config.period_ns);
            self.owed = best_shift(next, self.config.period_ns, range, &rhythms);
            self.settled = true;
        }
        let shift = self.owed.clamp(-limit, limit);
        self.owed -= shift;
        shift
    }
}

/// How far one tick may be moved: at first to the other side of the slowest stream's frame, later 1 % of a period.
fn shift_limit(config: &AssemblerConfig, settled: bool) -> i64 {
    if config.phase == PhasePolicy::Fixed {
        0
    } else if settled {
        config.period_ns / 100
    } else if config.phase == PhasePolicy::Aligned {
        config.period_ns / 2
    } else {
        (slowest(config) / 2 + 1).min(config.period_ns / 2)
    }
}

/// Period of the slowest stream.
fn slowest(config: &AssemblerConfig) -> i64 {
    config.stream_period_ns.iter().copied().max().unwrap_or(0).max(0)
}

/// The earliest that the tick after `tick` can lie.
fn next_at_least(config: &AssemblerConfig, settled: bool, tick: i64) -> i64 {
    tick.saturating_add(config.period_ns).saturating_sub(shift_limit(config, settled))
}
