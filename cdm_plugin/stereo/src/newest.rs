//! A box for one item between two threads: the newest wins, unless the one that lies there is for a frame set.

use depthrig_bus::sync::{lock, wait};
use depthrig_driver::moments::Due;
use std::sync::{Arc, Condvar, Mutex, MutexGuard};

/// An item that a box can hold.
pub(super) trait ForSet {
    /// The set that it is for, if it is for one.
    fn due(&self) -> Option<&Due>;
}

impl<T: ForSet> ForSet for Arc<T> {
    fn due(&self) -> Option<&Due> {
        (**self).due()
    }
}

/// A box for one item.
pub(super) struct Newest<T> {
    slot: Mutex<Slot<T>>,
    changed: Condvar,
    /// Wait until there is room, and replace nothing.
    keeps_all: bool,
}

struct Slot<T> {
    item: Option<T>,
    closed: bool,
}

impl<T: ForSet> Newest<T> {
    pub(super) fn new(keeps_all: bool) -> Arc<Self> {
        let slot = Mutex::new(Slot { item: None, closed: false });
        Arc::new(Self { slot, changed: Condvar::new(), keeps_all })
    }

    fn slot(&self) -> MutexGuard<'_, Slot<T>> {
        lock(&self.slot)
    }

    /// Puts `item` in and returns the one that is superseded: the item that lies there, or `item` itself if the other
    /// is for a set and `item` is for none or is further from it.
    pub(super) fn put(&self, item: T) -> Option<T> {
        let mut slot = self.slot();
        while self.keeps_all && slot.item.is_some() && !slot.closed {
            slot = wait(&self.changed, slot);
        }
        if slot.item.as_ref().and_then(ForSet::due).is_some_and(|there| there.stays(item.due())) {
            return Some(item);
        }
        let old = slot.item.replace(item);
        self.changed.notify_all();
        old
    }

    /// Waits for an item; `None` when the box was closed.
    pub(super) fn take(&self) -> Option<T> {
        let mut slot = self.slot();
        loop {
            if slot.closed {
                return None;
            }
            if let Some(item) = slot.item.take() {
                self.changed.notify_all();
                return Some(item);
            }
            slot = wait(&self.changed, slot);
        }
    }

    pub(super) fn is_closed(&self) -> bool {
        self.slot().closed
    }

    pub(super) fn close(&self) {
        self.slot().closed = true;
        self.changed.notify_all();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use depthrig_bus::HostTime;
    use depthrig_driver::moments::SetTimes;
    use proptest::prelude::*;

    const FRAME: i64 = 33_333_333;
    const SETS: i64 = 6 * FRAME;

    #[derive(Debug, Clone, PartialEq)]
    struct Pair {
        at: i64,
        due: Option<Due>,
    }

    impl ForSet for Pair {
        fn due(&self) -> Option<&Due> {
            self.due.as_ref()
        }
    }

    proptest! {
        /// Pairs come all the time, and are taken now and then: what is taken is the pair nearest to the newest set
        /// since the last time, and where there was none, the newest.
        #[test]
        fn what_is_taken_is_for_the_newest_set_or_the_newest(
            first in 0..SETS,
            tremble in prop::collection::vec(-FRAME / 20..FRAME / 20, 200),
            gaps in prop::collection::vec(1..20usize, 1..40),
        ) {
            let sets = SetTimes::default();
            sets.note(HostTime::from_ns(SETS), SETS);
            let stamps: Vec<_> = tremble.iter().enumerate().map(|(i, t)| 10 * SETS + first + i as i64 * FRAME + t).collect();
            let newest = Newest::new(false);
            let mut stamps = stamps.as_slice();
            for gap in gaps {
                let Some((since, rest)) = stamps.split_at_checked(gap) else { break };
                stamps = rest;
                let mut superseded = 0;
                for at in since {
                    let due = sets.due(HostTime::from_ns(*at), FRAME);
                    superseded += usize::from(newest.put(Pair { at: *at, due }).is_some());
                }
                // The slow and plain way: by set, the newest one first.
                let off = |at: i64| (at + SETS / 2).rem_euclid(SETS) - SETS / 2;
                let near = since.iter().copied().filter(|at| off(*at).abs() <= FRAME / 2 + FRAME / 4);
                let set = |at: i64| (at + SETS / 2).div_euclid(SETS);
                let best = near.clone().map(set).max();
                let best = best.and_then(|s| near.filter(|at| set(*at) == s).min_by_key(|at| off(*at).abs()));
                let expected = best.unwrap_or(since[since.len() - 1]);
                prop_assert_eq!(newest.take().unwrap().at, expected);
                prop_assert_eq!(superseded, since.len() - 1);
            }
        }
    }
}
