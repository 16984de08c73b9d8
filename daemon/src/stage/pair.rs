//! Which colour frame belongs to which depth frame: the nearest by capture time.
//!
//! A depth frame is decided when a colour frame at or after it was seen, because no later one can be nearer, or when it
//! has waited long enough. A colour frame is in one pair at most. Colour frames are kept while a depth frame still to
//! come may want them, three at most.

use std::collections::VecDeque;

/// Colour frames that are kept: two around a depth frame, and one more where depth takes longer to arrive.
const COLORS: usize = 3;
/// Depth frames that wait for colour.
const DEPTHS: usize = 2;

/// Pairs the frames of two streams. `T` is a frame; stamps are capture times, nanoseconds.
#[derive(Debug)]
pub struct Pairer<T> {
    tolerance_ns: i64,
    timeout_ns: i64,
    colors: VecDeque<(i64, T)>,
    depths: VecDeque<Waiting<T>>,
}

#[derive(Debug)]
struct Waiting<T> {
    stamp: i64,
    /// When it was pushed.
    since: i64,
    item: T,
}

/// Fate of a depth frame.
#[derive(Debug, PartialEq, Eq)]
pub enum Paired<T> {
    /// It has its colour.
    Pair {
        /// The colour frame.
        color: T,
        /// The depth frame.
        depth: T,
    },
    /// No colour frame is near enough.
    Alone,
}

impl<T> Pairer<T> {
    /// Pairs frames that are at most `tolerance_ns` apart; a depth frame waits for `timeout_ns` at most.
    pub fn new(tolerance_ns: i64, timeout_ns: i64) -> Self {
        let colors = VecDeque::with_capacity(COLORS + 1);
        let depths = VecDeque::with_capacity(DEPTHS + 1);
        Self { tolerance_ns, timeout_ns, colors, depths }
    }

    /// Takes a colour frame.
    pub fn color(&mut self, stamp: i64, item: T) {
        // Times that go back are those of a camera that was opened again, or of a replay.
        if self.colors.back().is_some_and(|(newest, _)| stamp < *newest) {
            self.colors.clear();
        }
        self.colors.push_back((stamp, item));
        if self.colors.len() > COLORS {
            self.colors.pop_front();
        }
    }

    /// Takes a depth frame at the time `now`; the oldest that waits is given up when there are too many.
    pub fn depth(&mut self, stamp: i64, now: i64, item: T) -> Option<Paired<T>> {
        let crowded = self.depths.len() >= DEPTHS;
        let out = if crowded { self.decide() } else { None };
        self.depths.push_back(Waiting { stamp, since: now, item });
        out
    }

    /// The fate of the oldest depth frame, if that is decided at `now`; call it until it returns `None`.
    pub fn poll(&mut self, now: i64) -> Option<Paired<T>> {
        let first = self.depths.front()?;
        let seen = self.colors.back().is_some_and(|(newest, _)| *newest >= first.stamp);
        let late = now.saturating_sub(first.since) >= self.timeout_ns;
        if seen || late { self.decide() } else { None }
    }

    fn decide(&mut self) -> Option<Paired<T>> {
        let Waiting { stamp, item: depth, .. } = self.depths.pop_front()?;
        let apart = |at: i64| at.saturating_sub(stamp).saturating_abs();
        let nearest = (0..self.colors.len()).min_by_key(|i| apart(self.colors[*i].0));
        let Some(at) = nearest.filter(|i| apart(self.colors[*i].0) <= self.tolerance_ns) else {
            return Some(Paired::Alone);
        };
        // Those before it are older than anything that a later depth frame could want.
        self.colors.drain(..at);
        self.colors.pop_front().map(|(_, color)| Paired::Pair { color, depth })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;

    fn pairer() -> Pairer<i64> {
        Pairer::new(17 * MS, 50 * MS)
    }

    #[test]
    fn the_nearest_colour_before_or_after_wins() {
        let mut p = pairer();
        p.color(0, 0);
        assert_eq!(p.depth(10 * MS, 12 * MS, 10), None);
        assert_eq!(p.poll(12 * MS), None, "a nearer one may come");
        p.color(33 * MS, 33);
        assert_eq!(p.poll(34 * MS), Some(Paired::Pair { color: 0, depth: 10 }));
        assert_eq!(p.depth(43 * MS, 45 * MS, 43), None);
        p.color(50 * MS, 50);
        assert_eq!(p.poll(51 * MS), Some(Paired::Pair { color: 50, depth: 43 }));
        assert_eq!(p.poll(52 * MS), None);
    }

    #[test]
    fn a_depth_frame_whose_colour_does_not_come_is_alone() {
        let mut p = pairer();
        p.color(0, 0);
        p.depth(100 * MS, 100 * MS, 100);
        assert_eq!(p.poll(149 * MS), None);
        assert_eq!(p.poll(150 * MS), Some(Paired::Alone), "100 ms apart");
        // A colour frame that is later by far decides it at once, too.
        p.depth(200 * MS, 200 * MS, 200);
        p.color(300 * MS, 300);
        assert_eq!(p.poll(200 * MS), Some(Paired::Alone));
    }

    #[test]
    fn a_colour_frame_is_in_one_pair_and_few_are_held() {
        let mut p = pairer();
        p.color(0, 0);
        p.depth(0, 0, 1);
        p.depth(5 * MS, 5 * MS, 2);
        assert_eq!(p.poll(0), Some(Paired::Pair { color: 0, depth: 1 }));
        assert_eq!(p.poll(60 * MS), Some(Paired::Alone));
        for i in 0..100 {
            p.color(i * MS, i);
            p.depth(1000 * MS + i, 0, i);
        }
        assert!(p.colors.len() <= COLORS && p.depths.len() <= DEPTHS);
    }

    #[test]
    fn time_may_start_again() {
        let mut p = pairer();
        p.color(1000 * MS, 1);
        p.color(0, 2);
        p.depth(0, 0, 3);
        assert_eq!(p.poll(0), Some(Paired::Pair { color: 2, depth: 3 }));
    }
}
