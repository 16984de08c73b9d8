//! Which sets are replayed when: the sets of one or several datasets on one axis of time.
//!
//! Datasets without a common stream are replayed side by side, by UTC. A set leads a moment when no earlier set took
//! it along; it takes along the next set of every other dataset that is at most half the time between sets away (the
//! median of the dataset in which sets follow each other faster). A set that no other takes along is a moment of its own,
//! and the streams of the other datasets are missing from it. So each set is in one moment, and moments never cross.
//!
//! Datasets with a common stream must follow each other. Time that no dataset covers is not waited for: the first set
//! after it comes as long after the last one before it as sets usually do.

use crate::{Error, ErrorKind, Result};
use depthrig_bus::StreamId;

/// Time between sets of a dataset that has one set only: 5 Hz.
const LONE_PERIOD_NS: i64 = 200_000_000;

/// Facts about a dataset for the timeline.
pub struct Part<'a> {
    /// Its name for messages.
    pub name: String,
    /// Its streams.
    pub streams: Vec<&'a StreamId>,
    /// Log time of each set, UTC nanoseconds since 1970, increasing; not empty.
    pub times: &'a [i64],
}

/// A set of a dataset.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Member {
    /// Which dataset.
    pub dataset: u32,
    /// The number of the set in it, from 0.
    pub set: u32,
}

/// The moments of a replay in order; 20 bytes for a set.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Timeline {
    /// Nanoseconds after the first moment; increasing.
    at_ns: Vec<i64>,
    /// Where a moment's members begin.
    first: Vec<u32>,
    members: Vec<Member>,
}

impl Timeline {
    /// The moments of `parts`.
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] when two of them hold the same stream at the same time.
    pub fn new(parts: &[Part<'_>]) -> Result<Self> {
        check(parts)?;
        let periods: Vec<i64> = parts.iter().map(|p| median_gap_ns(p.times)).collect();
        let mut timeline = Self { at_ns: Vec::new(), first: Vec::new(), members: Vec::new() };
        let mut next = vec![0; parts.len()];
        // Subtracted from UTC this is the time on the axis.
        let mut origin = None;
        let mut leader_before = 0;
        let mut taken: Vec<usize> = Vec::new();
        loop {
            let time = |d: usize| parts[d].times.get(next[d]).copied();
            let heads = (0..parts.len()).filter_map(|d| Some((time(d)?, d)));
            let Some((utc_ns, leader)) = heads.min() else { return Ok(timeline) };
            let before = timeline.at_ns.last().copied();
            let idle = (0..parts.len()).all(|d| next[d] == 0 || time(d).is_none());
            if let (Some(before), true) = (before, idle) {
                let usual = before.saturating_add(periods[leader_before]);
                origin = Some(utc_ns.saturating_sub(usual));
            }
            let at = utc_ns.saturating_sub(*origin.get_or_insert(utc_ns));
            timeline.at_ns.push(before.map_or(0, |b| at.max(b.saturating_add(1))));
            timeline.first.push(timeline.members.len() as u32);
            taken.clear();
            taken.push(leader);
            for d in (0..parts.len()).filter(|d| *d != leader) {
                let window_ns = periods[d].min(periods[leader]) / 2;
                let near = time(d).is_some_and(|t| t.saturating_sub(utc_ns) <= window_ns);
                if near && taken.iter().all(|other| shared(&parts[*other], &parts[d]).is_none()) {
                    taken.push(d);
                }
            }
            taken.sort_unstable();
            for d in &taken {
                timeline.members.push(Member { dataset: *d as u32, set: next[*d] as u32 });
                next[*d] += 1;
            }
            leader_before = leader;
        }
    }

    /// The moments from `from_ns` to `to_ns` on the axis, both included; the first of them is its new beginning.
    pub fn between(&self, from_ns: i64, to_ns: i64) -> Self {
        let begin = self.at_or_after(from_ns).unwrap_or(self.len());
        let end = self.at_ns.partition_point(|t| *t <= to_ns).max(begin);
        let member = |moment: usize| self.first.get(moment).map_or(self.members.len(), |m| *m as usize);
        let origin = self.at_ns.get(begin).copied().unwrap_or(0);
        Self {
            at_ns: self.at_ns[begin..end].iter().map(|t| t - origin).collect(),
            first: self.first[begin..end].iter().map(|m| m - member(begin) as u32).collect(),
            members: self.members[member(begin)..member(end)].to_vec(),
        }
    }

    /// Moments.
    pub const fn len(&self) -> usize {
        self.at_ns.len()
    }

    /// When each moment is, nanoseconds after the first.
    pub fn times(&self) -> &[i64] {
        &self.at_ns
    }

    /// From the first moment to the last, nanoseconds.
    pub fn length_ns(&self) -> i64 {
        self.at_ns.last().copied().unwrap_or(0)
    }

    /// The first moment at or after `at_ns`.
    pub fn at_or_after(&self, at_ns: i64) -> Option<usize> {
        Some(self.at_ns.partition_point(|t| *t < at_ns)).filter(|n| *n < self.len())
    }

    /// The sets of a moment, in the order of the datasets.
    pub fn members(&self, moment: usize) -> &[Member] {
        let begin = self.first.get(moment).map_or(self.members.len(), |m| *m as usize);
        let end = self.first.get(moment + 1).map_or(self.members.len(), |m| *m as usize);
        &self.members[begin..end]
    }

    /// The moment that holds set `set` of the only dataset.
    pub fn moment_of(&self, set: usize) -> Option<usize> {
        self.members.binary_search_by_key(&set, |m| m.set as usize).ok()
    }
}

/// Refuses datasets that contradict each other.
fn check(parts: &[Part<'_>]) -> Result<()> {
    for (i, a) in parts.iter().enumerate() {
        for b in &parts[i + 1..] {
            let (Some(stream), Some((a0, a1)), Some((b0, b1))) = (shared(a, b), span(a.times), span(b.times))
            else {
                continue;
            };
            if a0 <= b1 && b0 <= a1 {
                let s = (a0.max(b0).saturating_sub(a0)) as f64 / 1e9;
                return Err(Error::new(
                    ErrorKind::BadInput,
                    format!(
                        "{} and {} both hold {stream} at the same time (from {s:.3} s after the beginning of {0}), so \
                         they cannot be one rig: replay one of them, or cut them so that they follow each other",
                        a.name, b.name
                    ),
                ));
            }
        }
    }
    Ok(())
}

/// A stream that both have.
fn shared<'a>(a: &Part<'a>, b: &Part<'_>) -> Option<&'a StreamId> {
    a.streams.iter().copied().find(|s| b.streams.contains(s))
}

fn span(times: &[i64]) -> Option<(i64, i64)> {
    Some((*times.first()?, *times.last()?))
}

/// The usual time from a set to the next.
fn median_gap_ns(times: &[i64]) -> i64 {
    let mut gaps: Vec<i64> = times.windows(2).map(|w| w[1].saturating_sub(w[0])).collect();
    if gaps.is_empty() {
        return LONE_PERIOD_NS;
    }
    let middle = (gaps.len() - 1) / 2;
    *gaps.select_nth_unstable(middle).1
}

#[cfg(test)]
mod tests;
