//! Which recorder's losses fall between two sets.
//!
//! Two sources report a loss. The commit marks say exactly how many sets were offered between two sets that are
//! there; the accounts, about once a second, say for which reasons sets were lost. A loss may be in an account
//! before the set after it is in the file, or long after. So both are kept until they meet.

use crate::{SetCounts, SetDrop};
use std::collections::VecDeque;

const REASONS: usize = SetDrop::ALL.len();

/// The books of one input, from set to set.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct Books {
    /// Losses by reason as of the last account; `None` before the first one of a segment from the middle.
    seen: Option<[u64; REASONS]>,
    /// Losses that accounts reported and no gap has shown yet.
    credit: [u64; REASONS],
    /// Gaps for which no account has given a reason yet.
    open: VecDeque<Gap>,
    /// Sets offered as of the first account, if that came after sets: it holds earlier losses without naming them.
    base: Option<u64>,
}

/// Sets that were offered between two sets and are not there.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Gap {
    /// How many.
    pub(super) sets: u64,
    /// Whether both neighbours are in the new dataset.
    pub(super) counted: bool,
    /// Sets offered up to the one after the gap, with it.
    pub(super) offered: u64,
}

impl Gap {
    /// Whether an account of `offered` sets holds it.
    const fn is_in(&self, offered: u64) -> bool {
        self.offered <= offered.saturating_add(1)
    }
}

impl Books {
    /// Books that begin where the accounts do.
    pub(super) fn from_zero() -> Self {
        Self { seen: Some([0; REASONS]), ..Self::default() }
    }

    /// Books that begin after this account, or in the middle of accounts that begin elsewhere.
    pub(super) fn after(account: Option<&SetCounts>) -> Self {
        Self { seen: account.map(|a| a.dropped), ..Self::default() }
    }

    /// A gap was found, or none if it has no sets.
    pub(super) fn gap(&mut self, gap: Gap, losses: &mut [u64; REASONS]) {
        // No later account gives a reason for it, so it must not take that of another loss.
        let is_in_base = !gap.counted && self.base.is_some_and(|base| gap.is_in(base));
        if gap.sets > 0 && !is_in_base {
            self.open.push_back(gap);
            self.settle(losses);
        }
    }

    /// An account was read.
    pub(super) fn account(&mut self, account: &SetCounts, losses: &mut [u64; REASONS]) {
        if self.seen.is_none() {
            self.base = Some(account.offered);
            self.open.retain(|gap| gap.counted || !gap.is_in(account.offered));
        }
        let before = self.seen.replace(account.dropped).unwrap_or(account.dropped);
        for ((credit, now), before) in self.credit.iter_mut().zip(account.dropped).zip(before) {
            // The numbers of a damaged file may not fit.
            *credit = credit.saturating_add(now.saturating_sub(before));
        }
        self.settle(losses);
    }

    /// The input has ended: losses that no gap shows came after its last set.
    pub(super) fn end(&mut self, losses: &mut [u64; REASONS]) {
        for (total, credit) in losses.iter_mut().zip(&mut self.credit) {
            *total = total.saturating_add(std::mem::take(credit));
        }
    }

    /// Losses that accounts reported and no gap has shown: at the end of the input, those after its last set.
    pub(super) fn beyond_gaps(&self) -> u64 {
        self.credit.iter().fold(0, |sum, n| sum.saturating_add(*n))
    }

    /// Sets that are missing in the new dataset for an unknown reason.
    pub(super) fn unexplained(&self) -> u64 {
        self.open.iter().filter(|gap| gap.counted).map(|gap| gap.sets).sum()
    }

    fn settle(&mut self, losses: &mut [u64; REASONS]) {
        for (credit, lost) in self.credit.iter_mut().zip(losses) {
            while let Some(gap) = self.open.front_mut() {
                let n = (*credit).min(gap.sets);
                if n == 0 {
                    break;
                }
                *credit -= n;
                gap.sets -= n;
                if gap.counted {
                    *lost += n;
                }
                if gap.sets == 0 {
                    self.open.pop_front();
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn account(dropped: [u64; REASONS]) -> SetCounts {
        SetCounts { offered: 0, recorded: 0, dropped }
    }

    fn gap(sets: u64, counted: bool) -> Gap {
        Gap { sets, counted, offered: 0 }
    }

    /// Of a track that begins with the second segment: its first account holds a gap of before, which is not in the
    /// new dataset, and comes after the set behind the gap or before it.
    #[test]
    fn a_gap_that_no_account_will_name_takes_no_later_loss() {
        let at = |offered, dropped| SetCounts {
            offered,
            recorded: offered - dropped,
            dropped: [dropped, 0, 0, 0, 0, 0],
        };
        let seen = Gap { sets: 1, counted: false, offered: 7 };
        for account_first in [false, true] {
            let mut losses = [0; REASONS];
            let mut books = Books::after(None);
            if account_first {
                books.account(&at(6, 3), &mut losses);
                books.gap(seen, &mut losses);
            } else {
                books.gap(seen, &mut losses);
                books.account(&at(7, 3), &mut losses);
            }
            books.account(&at(12, 4), &mut losses);
            books.end(&mut losses);
            assert_eq!((losses, books.unexplained()), ([1, 0, 0, 0, 0, 0], 0), "{account_first}");
        }
        // One after the account is still explained by the next one, and not counted twice.
        let mut losses = [0; REASONS];
        let mut books = Books::after(None);
        books.account(&at(5, 2), &mut losses);
        books.gap(seen, &mut losses);
        books.account(&at(7, 3), &mut losses);
        books.end(&mut losses);
        assert_eq!(losses, [0; REASONS]);
    }

    #[test]
    fn a_loss_is_counted_once_whichever_reports_it_first() {
        let mut losses = [0; REASONS];
        let mut books = Books::after(Some(&account([5, 0, 0, 0, 0, 0])));
        books.gap(gap(2, true), &mut losses);
        assert_eq!((losses, books.unexplained()), ([0; REASONS], 2));
        books.account(&account([6, 3, 0, 0, 0, 0]), &mut losses);
        assert_eq!((losses, books.unexplained()), ([1, 1, 0, 0, 0, 0], 0));
        // Two more of the account are on their way; a gap before the new dataset takes one of them.
        books.gap(gap(1, false), &mut losses);
        books.gap(gap(1, true), &mut losses);
        assert_eq!(losses, [1, 2, 0, 0, 0, 0]);
        books.account(&account([6, 3, 4, 0, 0, 0]), &mut losses);
        books.end(&mut losses);
        assert_eq!((losses, books.unexplained()), ([1, 2, 4, 0, 0, 0], 0));
    }

    proptest! {
        /// In whatever order marks and accounts report losses, the totals are those of the model.
        #[test]
        fn totals_are_exact(events in proptest::collection::vec((0..3u64, 0..REASONS, any::<bool>()), 0..40)) {
            let mut books = Books::from_zero();
            let mut losses = [0; REASONS];
            let mut reported = [0u64; REASONS];
            let mut gaps = 0;
            for (n, reason, is_account) in events {
                if is_account {
                    reported[reason] += n;
                    books.account(&account(reported), &mut losses);
                } else {
                    gaps += n;
                    books.gap(gap(n, true), &mut losses);
                }
                let total: u64 = losses.iter().sum();
                prop_assert_eq!(total, gaps.min(reported.iter().sum()));
                prop_assert_eq!(books.unexplained(), gaps - total);
                prop_assert!(losses.iter().zip(&reported).all(|(l, t)| l <= t));
            }
            books.end(&mut losses);
            prop_assert_eq!(losses, reported);
        }
    }
}
