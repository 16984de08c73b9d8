//! The account of pairs: the outcome of each, in their order.
//!
//! A pair is lost at once or decided later. What comes after one that is still open waits for it, so that whoever reads
//! the counts of a frame reads those of the pairs up to it.

use depthrig_bus::{DropCounts, DropReason};
use std::collections::VecDeque;

/// One stretch of pairs.
#[derive(Debug, Clone, Copy)]
enum Entry<M> {
    /// Lost, for these reasons.
    Lost(DropCounts),
    /// Still to be decided, with what is known of it.
    Open(u64, M),
}

/// Accounting step for pairs, in their order.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Step<M> {
    /// So many are lost, for this reason.
    Lost(DropReason, u64),
    /// One is done, with what is known of it and how many pairs there were up to it.
    Done(M, u64),
}

/// The open and the not yet announced pairs of one group of streams.
#[derive(Debug)]
pub(super) struct Ledger<M> {
    entries: VecDeque<Entry<M>>,
    captured: u64,
}

/// Pairs that may be open at once: one that waits for each of the two threads, one that each works on, two that are
/// done.
pub(super) const MOST_OPEN: usize = 6;

impl<M: Copy> Ledger<M> {
    pub(super) fn new() -> Self {
        Self { entries: VecDeque::with_capacity(2 * MOST_OPEN + 2), captured: 0 }
    }

    /// Pairs that are not decided.
    pub(super) fn open(&self) -> usize {
        self.entries.iter().filter(|e| matches!(e, Entry::Open(..))).count()
    }

    /// The next pair is to be decided later.
    pub(super) fn begin(&mut self, ticket: u64, facts: M) {
        self.entries.push_back(Entry::Open(ticket, facts));
    }

    /// The next `n` pairs are lost. `say` hears of those that wait for nothing.
    pub(super) fn lose(&mut self, reason: DropReason, n: u64, say: &mut dyn FnMut(Step<M>)) {
        let mut counts = DropCounts::default();
        counts.add(reason, n);
        self.entries.push_back(Entry::Lost(counts));
        self.merge();
        self.release(say);
    }

    /// The open pair `ticket` is lost.
    pub(super) fn fail(&mut self, ticket: u64, reason: DropReason, say: &mut dyn FnMut(Step<M>)) {
        let mut counts = DropCounts::default();
        counts.add(reason, 1);
        for e in &mut self.entries {
            if matches!(e, Entry::Open(t, _) if *t == ticket) {
                *e = Entry::Lost(counts);
            }
        }
        self.merge();
        self.release(say);
    }

    /// The open pair `ticket` is done: those before it are announced, then it counts as captured and is announced as
    /// done. A pair that is not open is ignored.
    pub(super) fn settle(&mut self, ticket: u64, say: &mut dyn FnMut(Step<M>)) {
        if !self.entries.iter().any(|e| matches!(e, Entry::Open(t, _) if *t == ticket)) {
            return;
        }
        while let Some(first) = self.entries.pop_front() {
            match first {
                Entry::Lost(counts) => self.announce(&counts, say),
                Entry::Open(t, facts) if t == ticket => {
                    self.captured += 1;
                    say(Step::Done(facts, self.captured));
                    break;
                }
                // Pairs are decided in their order; one that was left open before this one has been given up.
                Entry::Open(..) => {
                    self.captured += 1;
                    say(Step::Lost(DropReason::Abandoned, 1));
                }
            }
        }
        self.release(say);
    }

    /// Announces what waits for nothing.
    fn release(&mut self, say: &mut dyn FnMut(Step<M>)) {
        while let Some(Entry::Lost(counts)) = self.entries.front().copied() {
            self.entries.pop_front();
            self.announce(&counts, say);
        }
    }

    fn announce(&mut self, counts: &DropCounts, say: &mut dyn FnMut(Step<M>)) {
        for (reason, n) in DropReason::ALL.into_iter().zip(counts.0).filter(|(_, n)| *n > 0) {
            self.captured += n;
            say(Step::Lost(reason, n));
        }
    }

    /// Stretches of losses that touch become one, so that there are never more entries than there are open pairs twice
    /// over.
    fn merge(&mut self) {
        let mut i = 1;
        while i < self.entries.len() {
            if let (Entry::Lost(a), Entry::Lost(b)) = (self.entries[i - 1], self.entries[i]) {
                let mut sum = a;
                sum.0.iter_mut().zip(b.0).for_each(|(s, n)| *s += n);
                self.entries[i - 1] = Entry::Lost(sum);
                self.entries.remove(i);
            } else {
                i += 1;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn what_follows_an_open_pair_waits_for_it() {
        let mut l = Ledger::new();
        let mut said = Vec::new();
        l.begin(1, 'a');
        l.lose(DropReason::Incomplete, 2, &mut |s| said.push(s));
        l.begin(2, 'b');
        l.fail(2, DropReason::QueueFull, &mut |s| said.push(s));
        assert!(said.is_empty() && l.captured == 0 && l.open() == 1, "nothing is known of the first");
        l.settle(1, &mut |s| said.push(s));
        let lost = [Step::Lost(DropReason::Incomplete, 2), Step::Lost(DropReason::QueueFull, 1)];
        assert_eq!(said, [Step::Done('a', 1), lost[0], lost[1]]);
        assert_eq!((l.captured, l.open()), (4, 0));
        l.settle(1, &mut |_| panic!("it was decided"));
    }

    proptest! {
        /// However pairs end, each counts once, in order, and memory does not grow.
        #[test]
        fn each_pair_counts_once(steps in proptest::collection::vec(0u8..5, 1..400)) {
            let mut l = Ledger::new();
            let mut ticket = 0u64;
            let mut pairs = 0u64;
            let mut delivered = Vec::new();
            let mut dropped = 0;
            let mut open = VecDeque::new();
            let room = l.entries.capacity();
            for step in steps {
                let mut say = |s| match s {
                    Step::Lost(_, n) => dropped += n,
                    Step::Done(t, captured) => {
                        delivered.push(t);
                        assert_eq!(captured, delivered.len() as u64 + dropped, "as of this pair");
                    }
                };
                match step {
                    0 if open.len() < MOST_OPEN => {
                        (ticket, pairs) = (ticket + 1, pairs + 1);
                        l.begin(ticket, ticket);
                        open.push_back(ticket);
                    }
                    1 => {
                        pairs += 2;
                        l.lose(DropReason::DeviceGap, 2, &mut say);
                    }
                    2 => if let Some(t) = open.pop_back() {
                        l.fail(t, DropReason::QueueFull, &mut say);
                    }
                    _ => if let Some(t) = open.pop_front() {
                        l.settle(t, &mut say);
                    }
                }
                prop_assert_eq!(l.open(), open.len());
                prop_assert_eq!(l.captured, delivered.len() as u64 + dropped);
                prop_assert!(l.captured <= pairs);
                if open.is_empty() {
                    prop_assert_eq!(l.captured, pairs, "nothing is left over");
                }
            }
            prop_assert!(delivered.windows(2).all(|w| w[0] < w[1]));
            prop_assert_eq!(l.entries.capacity(), room);
        }
    }
}
