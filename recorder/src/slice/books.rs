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
    /// Gaps for which no account has given a reason yet, and whether they are gaps of the new dataset.
    open: VecDeque<(u64, bool)>,
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

    /// `sets` were offered between two sets and are not there; `counted` when both are in the new dataset.
    pub(super) fn gap(&mut self, sets: u64, counted: bool, losses: &mut [u64; REASONS]) {
        if sets > 0 {
            self.open.push_back((sets, counted));
            self.settle(losses);
        }
    }

    /// An account was read.
    pub(super) fn account(&mut self, account: &SetCounts, losses: &mut [u64; REASONS]) {
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
        self.open.iter().filter(|(_, counted)| *counted).map(|(n, _)| n).sum()
    }

    fn settle(&mut self, losses: &mut [u64; REASONS]) {
        for (credit, lost) in self.credit.iter_mut().zip(losses) {
            while let Some((sets, counted)) = self.open.front_mut() {
                let n = (*credit).min(*sets);
                if n == 0 {
                    break;
                }
                *credit -= n;
                *sets -= n;
                if *counted {
                    *lost += n;
                }
                if *sets == 0 {
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

    #[test]
    fn a_loss_is_counted_once_whichever_reports_it_first() {
        let mut losses = [0; REASONS];
        let mut books = Books::after(Some(&account([5, 0, 0, 0, 0, 0])));
        books.gap(2, true, &mut losses);
        assert_eq!((losses, books.unexplained()), ([0; REASONS], 2));
        books.account(&account([6, 3, 0, 0, 0, 0]), &mut losses);
        assert_eq!((losses, books.unexplained()), ([1, 1, 0, 0, 0, 0], 0));
        // Two more of the account are on their way; a gap before the new dataset takes one of them.
        books.gap(1, false, &mut losses);
        books.gap(1, true, &mut losses);
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
                    books.gap(n, true, &mut losses);
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
