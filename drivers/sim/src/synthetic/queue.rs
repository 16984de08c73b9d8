//! The frames of one stream between exposure and the driver: under way, or waiting in the device's ring.
//!
//! Invariants: arrivals rise strictly; at most the ring's size of arrived frames wait, the oldest are lost
//! first; `lost_before` of every frame says how many frames of the same boot were lost since the one before.

use super::config::FaultKind;
use super::timeline::{Boot, Timeline};
use depthrig_bus::HostTime;
use std::collections::VecDeque;

/// Frames under way at the most, besides those in the ring; further ones are lost.
const UNDER_WAY: usize = 64;

/// A frame on its way to the driver.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Waiting {
    /// Number of the frame since the device's boot.
    pub(crate) k: u64,
    pub(crate) boot: Boot,
    pub(crate) capture: HostTime,
    pub(crate) ticks: u64,
    pub(crate) arrival: HostTime,
    pub(crate) exposure_ns: u64,
    pub(crate) fault: Option<FaultKind>,
    pub(crate) lost_before: u64,
}

/// The frames of one stream.
#[derive(Debug)]
pub(crate) struct Queue {
    stream: usize,
    rate_hz: f64,
    exposure_ns: u64,
    ring: usize,
    boot: Boot,
    next_k: u64,
    lost: u64,
    last_arrival: HostTime,
    halted_until: HostTime,
    stalls: Vec<(HostTime, HostTime)>,
    /// Faults of the next frames: what, and of how many.
    spoils: VecDeque<(FaultKind, u32)>,
    waiting: VecDeque<Waiting>,
    /// Number of the boot of the last frame that was handed over.
    handed: Option<u32>,
}

impl Queue {
    /// The queue of stream number `stream`, whose first frame is the first exposed after `began`.
    pub(crate) fn new(
        stream: usize,
        rate_hz: f64,
        exposure_ns: u64,
        ring: usize,
        timeline: &Timeline,
        boot: Boot,
        began: HostTime,
    ) -> Self {
        Self {
            stream,
            rate_hz,
            exposure_ns,
            ring,
            boot,
            next_k: timeline.first_at_or_after(boot, rate_hz, began),
            lost: 0,
            last_arrival: began,
            halted_until: began,
            stalls: Vec::new(),
            spoils: VecDeque::new(),
            waiting: VecDeque::new(),
            handed: None,
        }
    }

    /// Nothing arrives between the two moments.
    pub(crate) fn stall(&mut self, from: HostTime, until: HostTime) {
        self.stalls.retain(|(_, end)| *end > from);
        self.stalls.push((from, until));
    }

    /// The next `count` frames suffer `kind`.
    pub(crate) fn spoil(&mut self, kind: FaultKind, count: u32) {
        self.spoils.push_back((kind, count));
    }

    /// Exposes every frame due before `until`.
    pub(crate) fn expose_until(&mut self, until: HostTime, timeline: &Timeline, boot: Boot) {
        if boot.number != self.boot.number {
            self.next_k = 0;
            self.lost = 0;
        }
        self.boot = boot;
        loop {
            let k = self.next_k;
            let capture = timeline.capture(boot, self.rate_hz, k);
            if capture >= until {
                break;
            }
            self.next_k += 1;
            self.expose(k, capture, timeline);
        }
        self.overflow(until);
    }

    fn expose(&mut self, k: u64, capture: HostTime, timeline: &Timeline) {
        let (arrival, halt_ns) = timeline.arrival(self.boot, self.stream, k, capture, self.exposure_ns);
        if halt_ns > 0 {
            self.halted_until = self.halted_until.max(arrival.plus_ns(halt_ns));
        }
        let arrival = arrival.max(self.halted_until).max(self.last_arrival.plus_ns(1000));
        let spoil = self.next_spoil();
        let is_stalled = self.stalls.iter().any(|(from, until)| (*from..*until).contains(&arrival));
        if spoil == Some(FaultKind::Skip) || is_stalled || self.waiting.len() >= self.ring + UNDER_WAY {
            self.lost += 1;
            return;
        }
        let ticks = timeline.ticks(self.boot, self.stream, k, capture);
        let twice = spoil == Some(FaultKind::Repeated);
        let frame = Waiting {
            k,
            boot: self.boot,
            capture,
            ticks,
            arrival,
            exposure_ns: self.exposure_ns,
            fault: spoil.filter(|_| !twice),
            lost_before: core::mem::take(&mut self.lost),
        };
        self.last_arrival = arrival;
        self.waiting.push_back(frame);
        if twice {
            self.last_arrival = arrival.plus_ns(1000);
            let fault = Some(FaultKind::Repeated);
            self.waiting.push_back(Waiting { arrival: self.last_arrival, fault, lost_before: 0, ..frame });
        }
    }

    fn next_spoil(&mut self) -> Option<FaultKind> {
        let (kind, left) = self.spoils.front_mut()?;
        let kind = *kind;
        *left -= 1;
        if *left == 0 {
            self.spoils.pop_front();
        }
        Some(kind)
    }

    /// Loses the oldest frames that arrived when there are more than the ring holds.
    fn overflow(&mut self, now: HostTime) {
        let arrived = self.waiting.partition_point(|w| w.arrival <= now);
        for _ in self.ring..arrived {
            let Some(oldest) = self.waiting.pop_front() else { return };
            let gone = oldest.lost_before + u64::from(oldest.fault != Some(FaultKind::Repeated));
            match self.waiting.front_mut() {
                Some(next) if next.boot.number != oldest.boot.number => {}
                // The other copy of a repeated frame is the frame now.
                Some(next) if next.fault == Some(FaultKind::Repeated) && next.k == oldest.k => {
                    next.fault = None;
                    next.lost_before = oldest.lost_before;
                }
                Some(next) => next.lost_before += gone,
                None => self.lost += gone,
            }
        }
    }

    /// When the first waiting frame arrived, if it has.
    pub(crate) fn front_arrival(&self, now: HostTime) -> Option<HostTime> {
        self.waiting.front().map(|w| w.arrival).filter(|at| *at <= now)
    }

    /// When the next frame arrives, as far as is known now.
    pub(crate) fn next_arrival(&self, timeline: &Timeline) -> HostTime {
        self.waiting.front().map_or_else(
            || {
                let capture = timeline.capture(self.boot, self.rate_hz, self.next_k);
                timeline.arrival(self.boot, self.stream, self.next_k, capture, self.exposure_ns).0
            },
            |w| w.arrival,
        )
    }

    /// Takes the first waiting frame.
    pub(crate) fn pop(&mut self) -> Option<Waiting> {
        let mut frame = self.waiting.pop_front()?;
        if self.handed.replace(frame.boot.number) != Some(frame.boot.number) {
            // The host cannot know of frames lost before the first frame of a session, or before a counter restarts.
            frame.lost_before = 0;
        }
        Some(frame)
    }
}

#[cfg(test)]
mod tests {
    use super::super::config::{ClockSim, SyntheticConfig};
    use super::*;

    const START: HostTime = HostTime::from_ns(1_000_000_000);
    const BOOT: Boot = Boot { number: 0, at: START, set_back_us: 0 };

    fn queue(clock: ClockSim) -> (Queue, Timeline) {
        let timeline = Timeline::new(&SyntheticConfig { clock, ..SyntheticConfig::default() });
        (Queue::new(0, 100.0, 1_000_000, 4, &timeline, BOOT, START), timeline)
    }

    fn ms(n: i64) -> HostTime {
        START.plus_ns(n * 1_000_000)
    }

    fn drain(queue: &mut Queue, now: HostTime) -> Vec<Waiting> {
        core::iter::from_fn(|| queue.front_arrival(now).and_then(|_| queue.pop())).collect()
    }

    #[test]
    fn a_slow_reader_loses_the_oldest_and_the_next_frame_says_how_many() {
        let (mut q, t) = queue(ClockSim::default());
        q.expose_until(ms(21), &t, BOOT);
        assert_eq!(drain(&mut q, ms(21)).iter().map(|w| w.k).collect::<Vec<_>>(), [0, 1]);
        q.expose_until(ms(208), &t, BOOT);
        let got = drain(&mut q, ms(208));
        assert_eq!(got.len(), 4);
        assert_eq!(got[0].lost_before, got[0].k - 2);
        assert!(got[1..].iter().all(|w| w.lost_before == 0));
    }

    #[test]
    fn faults_hit_the_frames_they_should() {
        let (mut q, t) = queue(ClockSim::default());
        q.expose_until(ms(5), &t, BOOT);
        q.spoil(FaultKind::Damaged, 1);
        q.spoil(FaultKind::Skip, 2);
        q.spoil(FaultKind::Repeated, 1);
        let mut got = Vec::new();
        for now in (0..80).step_by(5) {
            q.expose_until(ms(now), &t, BOOT);
            got.extend(drain(&mut q, ms(now)));
        }
        let seen: Vec<_> = got.iter().map(|w| (w.k, w.fault, w.lost_before)).collect();
        let damaged = Some(FaultKind::Damaged);
        let again = Some(FaultKind::Repeated);
        assert_eq!(seen[..5], [(0, None, 0), (1, damaged, 0), (4, None, 2), (4, again, 0), (5, None, 0)]);
        assert!(got.windows(2).all(|w| w[0].arrival < w[1].arrival));
    }

    #[test]
    fn a_halt_of_the_transport_delivers_in_one_batch() {
        let clock = ClockSim { stall_probability: 1.0, stall_ms: (30.0, 30.0), ..ClockSim::default() };
        let (mut q, t) = queue(clock);
        q.expose_until(ms(5), &t, BOOT);
        q.expose_until(ms(30), &t, BOOT);
        assert_eq!(q.front_arrival(ms(30)), None, "the first frame is held for 30 ms");
        q.stall(ms(0), ms(0));
        q.expose_until(ms(50), &t, BOOT);
        assert!(q.front_arrival(ms(50)).is_some());
    }

    #[test]
    fn after_a_reset_counting_starts_anew_without_a_loss() {
        let (mut q, t) = queue(ClockSim::default());
        q.expose_until(ms(15), &t, BOOT);
        q.spoil(FaultKind::Skip, 1);
        q.expose_until(ms(25), &t, BOOT);
        q.expose_until(ms(46), &t, Boot { number: 1, at: ms(30), set_back_us: 0 });
        let got = drain(&mut q, ms(46));
        assert_eq!(
            got.iter().map(|w| (w.k, w.boot.number, w.lost_before)).take(3).collect::<Vec<_>>(),
            [(0, 0, 0), (1, 0, 0), (0, 1, 0)]
        );
    }

    #[test]
    fn frames_lost_between_a_reset_and_the_first_one_after_it_are_no_gap() {
        let (mut q, t) = queue(ClockSim::default());
        q.expose_until(ms(21), &t, BOOT);
        assert_eq!(drain(&mut q, ms(21)).len(), 2);
        q.expose_until(ms(208), &t, Boot { number: 1, at: ms(30), set_back_us: 0 });
        let got = drain(&mut q, ms(208));
        assert!(got[0].k > 0 && got.iter().all(|w| w.lost_before == 0), "{got:?}");
    }
}
