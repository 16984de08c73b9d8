//! Where the ticks should lie so that the frames of a set lie close together.
//!
//! For streams of one rate the best tick is opposite the widest gap between their phases: then the frames around
//! the circle are all but that gap. For mixed rates there is no such formula, so the spread is simply predicted for
//! shifts all over the range. Of a stretch of equally good shifts the middle is taken: it is furthest from
//! where jitter would move a frame to the other side.

use serde::{Deserialize, Serialize};

/// A stream as it is expected to go on.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Rhythm {
    /// Capture time of its newest frame, nanoseconds.
    pub newest_ns: i64,
    /// Time between frames, nanoseconds.
    pub period_ns: f64,
    /// A frame may lie so far from the tick of its set, nanoseconds.
    pub tolerance_ns: i64,
}

impl Rhythm {
    /// Where the frame nearest to `tick` will lie, relative to it.
    fn nearest(&self, tick: f64) -> f64 {
        let since = tick - self.newest_ns as f64;
        (since / self.period_ns).round() * self.period_ns - since
    }
}

/// Shifts tried to each side.
const TRIED: i64 = 100;
/// Ticks that a shift is tried on: rates that do not divide each other take turns.
const AHEAD: i64 = 4;
/// Spreads this close are equally good, nanoseconds.
const EQUAL_NS: f64 = 200_000.0;

/// The shift of `tick`, within `range` either way, for which sets `period` apart will have the least mean spread.
pub(super) fn best_shift(tick: i64, period: i64, range: i64, streams: &[Rhythm]) -> i64 {
    if streams.len() < 2 || range < TRIED {
        return 0;
    }
    let shift_of = |i: i64| range / TRIED * i;
    let costs: Vec<f64> = (-TRIED..=TRIED)
        .map(|i| {
            let first = tick.saturating_add(shift_of(i));
            (0..AHEAD).map(|k| spread(first as f64 + (k * period) as f64, period, streams)).sum::<f64>()
                / AHEAD as f64
        })
        .collect();
    let least = costs.iter().copied().fold(f64::INFINITY, f64::min);
    // The middles of all stretches of best shifts; the nearest of them costs the least moving. A stretch that
    // runs out of the range has no middle to be seen and is the last choice.
    let mut best: Option<(bool, i64)> = None;
    let mut start = None;
    for (i, cost) in costs.iter().map(Some).chain([None]).enumerate() {
        let good = cost.is_some_and(|c| *c <= least + EQUAL_NS);
        match (good, start) {
            (true, None) => start = Some(i),
            (false, Some(from)) => {
                let middle = (from + i - 1) as i64 / 2 - TRIED;
                let cut = from == 0 || i == costs.len();
                if best.is_none_or(|b| (cut, middle.abs()) < (b.0, b.1.abs())) {
                    best = Some((cut, middle));
                }
                start = None;
            }
            _ => {}
        }
    }
    shift_of(best.map_or(0, |b| b.1))
}

/// Predicted spread of the set at `tick`; a stream that would be missing costs a whole period.
fn spread(tick: f64, period: i64, streams: &[Rhythm]) -> f64 {
    let mut low = f64::INFINITY;
    let mut high = f64::NEG_INFINITY;
    let mut missing = 0.0;
    for s in streams {
        let at = s.nearest(tick);
        if at.abs() > s.tolerance_ns as f64 {
            missing += period as f64;
        } else {
            low = low.min(at);
            high = high.max(at);
        }
    }
    missing + (high - low).max(0.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(ms: i64, rate: f64) -> Rhythm {
        Rhythm {
            newest_ns: ms * 1_000_000,
            period_ns: 1e9 / rate,
            tolerance_ns: (5e8 / rate) as i64 + 1_000_000,
        }
    }

    #[test]
    fn equal_rates_go_opposite_the_widest_gap() {
        // Phases 0, 3 and 6 of 33.3 ms: the gap is from 6 to 33.3, its middle 19.7, opposite it 3.
        let streams = [at(0, 30.0), at(3, 30.0), at(6, 30.0)];
        for tick_ms in [0, 12, 20, 31] {
            let tick = 1_000_000_000 + tick_ms * 1_000_000;
            let to = (tick + best_shift(tick, 200_000_000, 33_333_333, &streams)) as f64 / 1e6;
            let phase = to.rem_euclid(100.0 / 3.0);
            assert!((phase - 3.0).abs() < 0.6, "from {tick_ms}: {phase}");
        }
    }

    #[test]
    fn a_slow_stream_among_fast_ones_draws_the_tick() {
        let streams = [at(0, 15.0), at(8, 60.0), at(20, 30.0)];
        let tick = 1_000_000_000;
        let to = tick + best_shift(tick, 200_000_000, 66_666_667, &streams);
        let before = spread(tick as f64, 200_000_000, &streams);
        assert!(spread(to as f64, 200_000_000, &streams) <= before.min(13.5e6));
    }

    #[test]
    fn no_stream_is_left_out_for_the_sake_of_the_others() {
        // A frame of 5 Hz that is 20 ms from the tick at the most, beside one of 30 Hz: a tick elsewhere has a spread of 0, without it.
        let slow = Rhythm { tolerance_ns: 20_000_000, ..at(50, 5.0) };
        for tick_ms in (0..200).step_by(10) {
            let tick = 1_000_000_000 + tick_ms * 1_000_000;
            let to = tick + best_shift(tick, 200_000_000, 200_000_000, &[at(0, 30.0), slow]);
            let off = slow.nearest(to as f64).abs();
            assert!(off <= 20e6, "from {tick_ms}: {off} ns from the frame");
        }
    }

    #[test]
    fn one_stream_or_none_does_not_care() {
        assert_eq!(best_shift(5, 200, 100, &[]), 0);
        assert_eq!(best_shift(5, 200_000_000, 16_000_000, &[at(7, 30.0)]), 0);
    }
}
