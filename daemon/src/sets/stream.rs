//! One stream's frames on their way into sets: which to hold, which to let go.

use super::Account;
use std::collections::VecDeque;

/// Sets sent without the stream having been heard that are remembered, to call their frames late.
pub(super) const REMEMBERED: usize = 8;

#[derive(Debug)]
pub(super) struct Pending<T> {
    pub stamp: i64,
    pub item: T,
    late: bool,
}

/// A set that was sent before the stream showed a frame at or after its tick.
#[derive(Debug, Clone, Copy)]
struct Undecided {
    tick: i64,
    /// Distance of the frame that was used, or just over the tolerance if none was.
    distance: i64,
}

#[derive(Debug)]
pub(super) struct Stream<T> {
    pub active: bool,
    pub tolerance: i64,
    /// Time between frames as it comes, nanoseconds.
    pub period: f64,
    /// Stamp of the newest frame.
    pub newest: Option<i64>,
    pub account: Account,
    /// Stamps rise; all are later than any frame used.
    pending: VecDeque<Pending<T>>,
    undecided: VecDeque<Undecided>,
}

impl<T> Stream<T> {
    pub(super) fn new(period: i64, tolerance: Option<i64>) -> Self {
        let period = period.max(1);
        Self {
            active: true,
            tolerance: tolerance.unwrap_or(period / 2 + 1_000_000).max(0),
            period: period as f64,
            newest: None,
            account: Account::default(),
            pending: VecDeque::new(),
            undecided: VecDeque::new(),
        }
    }

    /// Takes a frame in, if it is newer than all before.
    pub(super) fn push(&mut self, stamp: i64, item: T) {
        self.account.pushed += 1;
        if let Some(newest) = self.newest {
            if stamp <= newest {
                self.account.out_of_order += 1;
                return;
            }
            // Follows the real rate; frames that were lost between the two do not count.
            let gap = stamp.saturating_sub(newest) as f64;
            let frames = (gap / self.period).round();
            if (1.0..16.0).contains(&frames) {
                self.period += (gap / frames - self.period) / 16.0;
            }
        }
        self.newest = Some(stamp);
        while self.undecided.front().is_some_and(|u| u.tick.saturating_add(self.tolerance) < stamp) {
            self.undecided.pop_front();
        }
        let late = self.undecided.iter().any(|u| u.tick.saturating_sub(stamp).saturating_abs() < u.distance);
        self.pending.push_back(Pending { stamp, item, late });
        self.account.pending += 1;
    }

    /// Whether no frame still to come could be nearer to `tick`.
    pub(super) fn decided(&self, tick: i64) -> bool {
        self.newest.is_some_and(|n| n >= tick)
    }

    /// Stamp of the oldest frame held.
    pub(super) fn oldest(&self) -> Option<i64> {
        self.pending.front().map(|p| p.stamp)
    }

    /// Lets go of every frame that is not the best for `tick` and cannot be in a set at `next` or later.
    pub(super) fn prune(&mut self, tick: i64, next: i64, max_pending: usize) {
        while let Some(first) = self.pending.front() {
            let beaten = self.pending.get(1).is_some_and(|second| {
                second.stamp.saturating_sub(tick).saturating_abs() < tick.saturating_sub(first.stamp)
            });
            if !beaten && first.stamp >= tick.saturating_sub(self.tolerance) {
                break;
            }
            self.drop_at(0);
        }
        // The first is the best for the tick, if it is near enough. The others, and it if not, wait for the next.
        let mut at = usize::from(self.oldest().is_some_and(|s| s <= tick.saturating_add(self.tolerance)));
        while let Some(p) = self.pending.get(at) {
            if p.stamp >= next.saturating_sub(self.tolerance) {
                break;
            }
            // A frame before the tick is only there while nothing beats it; one after it has decided.
            self.drop_at(at);
        }
        at = self.pending.len();
        while at > max_pending.max(1) {
            self.pending.pop_front();
            self.account.pending -= 1;
            self.account.overflow += 1;
            at -= 1;
        }
    }

    fn drop_at(&mut self, index: usize) {
        if let Some(p) = self.pending.remove(index) {
            self.account.pending -= 1;
            if p.late {
                self.account.late += 1;
            } else {
                self.account.decimated += 1;
            }
        }
    }

    /// Whether there is a frame for `tick`. The stream must be pruned for it.
    pub(super) fn has(&self, tick: i64) -> bool {
        self.oldest().is_some_and(|s| s.saturating_sub(tick).saturating_abs() <= self.tolerance)
    }

    /// The frame for `tick`, if there is one. The stream must be pruned for it.
    pub(super) fn take(&mut self, tick: i64) -> Option<Pending<T>> {
        let taken = if self.has(tick) { self.pending.pop_front() } else { None };
        if taken.is_some() {
            self.account.pending -= 1;
            self.account.used += 1;
        }
        taken
    }

    /// The set of `tick` is out, with this stream's frame at `used`, or without.
    pub(super) fn sent(&mut self, tick: i64, used: Option<i64>) {
        if self.decided(tick) {
            return;
        }
        let distance = match used {
            Some(stamp) => stamp.saturating_sub(tick).saturating_abs(),
            None => self.tolerance.saturating_add(1),
        };
        if self.undecided.len() == REMEMBERED {
            self.undecided.pop_front();
        }
        self.undecided.push_back(Undecided { tick, distance });
    }
}
