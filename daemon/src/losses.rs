//! When a recording lost something: its losses by reason over its time, in a bounded history.
//!
//! The accounts of a recording only grow. They are looked at once a second, and by how much they grew goes into the bucket of that
//! moment. No frame is touched for it, and without losses nothing is kept.

use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Buckets of a history at most; when a loss lies beyond them, buckets become twice as wide.
pub const BUCKETS_MAX: u64 = 600;
/// Width of a bucket at first, nanoseconds.
const FIRST_WIDTH_NS: u64 = 1_000_000_000;

/// Losses of a recording, of all its time or of a part.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Losses {
    /// Sets that were not recorded, by reason.
    pub sets: BTreeMap<String, u64>,
    /// Frames that recorded sets lack, by stream.
    pub missing: BTreeMap<String, u64>,
    /// Frames that never reached their channel, by reason; sets need few of them.
    pub frames: BTreeMap<String, u64>,
}

/// A part of a recording in which something was lost.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LossBucket {
    /// Its beginning, seconds after that of the recording.
    pub from_s: f64,
    /// Its losses.
    #[serde(flatten)]
    pub losses: Losses,
}

/// When a recording lost something.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RecordingLosses {
    /// The dataset's folder.
    pub path: String,
    /// Length of the recording so far, seconds.
    pub duration_s: f64,
    /// Width of a bucket, seconds.
    pub bucket_s: f64,
    /// The buckets with losses, in the order of time, 600 at most.
    pub buckets: Vec<LossBucket>,
}

impl Losses {
    fn parts(&self) -> [&BTreeMap<String, u64>; 3] {
        [&self.sets, &self.missing, &self.frames]
    }

    const fn parts_mut(&mut self) -> [&mut BTreeMap<String, u64>; 3] {
        [&mut self.sets, &mut self.missing, &mut self.frames]
    }

    fn is_empty(&self) -> bool {
        self.parts().iter().all(|part| part.is_empty())
    }

    /// The losses that came after `before`.
    fn since(&self, before: &Self) -> Self {
        let mut more = Self::default();
        for ((to, now), before) in more.parts_mut().into_iter().zip(self.parts()).zip(before.parts()) {
            for (reason, n) in now {
                let new = n.saturating_sub(before.get(reason).copied().unwrap_or(0));
                if new > 0 {
                    to.insert(reason.clone(), new);
                }
            }
        }
        more
    }

    fn add(&mut self, more: Self) {
        for (to, from) in self.parts_mut().into_iter().zip([more.sets, more.missing, more.frames]) {
            for (reason, n) in from {
                *to.entry(reason).or_default() += n;
            }
        }
    }
}

/// The history of the losses of one recording.
#[derive(Debug, Default)]
pub struct LossHistory {
    /// Doublings of the width.
    doublings: u32,
    /// By number of the bucket.
    buckets: BTreeMap<u64, Losses>,
    /// The losses that are in the buckets.
    seen: Losses,
}

impl LossHistory {
    /// Width of a bucket, nanoseconds.
    const fn width_ns(&self) -> u64 {
        FIRST_WIDTH_NS << self.doublings
    }

    /// Takes in all losses of the recording so far, `at_ns` after it began.
    pub fn note(&mut self, at_ns: u64, so_far: &Losses) {
        let more = so_far.since(&self.seen);
        if more.is_empty() {
            return;
        }
        while at_ns / self.width_ns() >= BUCKETS_MAX {
            self.widen();
        }
        self.buckets.entry(at_ns / self.width_ns()).or_default().add(more.clone());
        self.seen.add(more);
    }

    fn widen(&mut self) {
        self.doublings += 1;
        for (index, losses) in core::mem::take(&mut self.buckets) {
            self.buckets.entry(index / 2).or_default().add(losses);
        }
    }

    /// Width of a bucket, seconds, and the buckets with losses.
    pub fn buckets(&self) -> (f64, Vec<LossBucket>) {
        let width_s = self.width_ns() as f64 / 1e9;
        let bucket = |(index, losses): (&u64, &Losses)| LossBucket {
            from_s: *index as f64 * width_s,
            losses: losses.clone(),
        };
        (width_s, self.buckets.iter().map(bucket).collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const SECOND: u64 = FIRST_WIDTH_NS;

    fn losses(sets: u64, missing: u64, frames: u64) -> Losses {
        let part = |name: &str, n: u64| if n > 0 { [(name.to_owned(), n)].into() } else { BTreeMap::new() };
        Losses {
            sets: part("disk_slow", sets),
            missing: part("front/depth", missing),
            frames: part("device_gap", frames),
        }
    }

    #[test]
    fn without_losses_nothing_is_kept_however_long_it_lasts() {
        let mut history = LossHistory::default();
        (0..100_000).for_each(|s| history.note(s * SECOND, &Losses::default()));
        assert_eq!(history.buckets(), (1.0, Vec::new()));
    }

    #[test]
    fn what_is_seen_twice_counts_once() {
        let mut history = LossHistory::default();
        history.note(SECOND / 2, &losses(0, 0, 2));
        history.note(3 * SECOND, &losses(0, 0, 2));
        history.note(4 * SECOND, &losses(1, 0, 2));
        let (_, buckets) = history.buckets();
        let found: Vec<_> = buckets.iter().map(|b| (b.from_s, b.losses.clone())).collect();
        assert_eq!(found, [(0.0, losses(0, 0, 2)), (4.0, losses(1, 0, 0))]);
    }

    proptest! {
        /// The slow model keeps every loss with its moment and puts all of them into buckets anew.
        #[test]
        fn a_history_is_that_of_all_losses_binned_at_the_end(
            steps in proptest::collection::vec((0..200 * SECOND, 0u64..3, 0u64..3, 0u64..3), 0..80),
        ) {
            let mut history = LossHistory::default();
            let mut kept: Vec<(u64, Losses)> = Vec::new();
            let mut so_far = Losses::default();
            let mut at = 0;
            for (pause, sets, missing, frames) in steps {
                at += pause;
                let more = losses(sets, missing, frames);
                so_far.add(more.clone());
                history.note(at, &so_far);
                if !more.is_empty() {
                    kept.push((at, more));
                }

                let last = kept.last().map_or(0, |(at, _)| *at);
                let mut width = SECOND;
                while last / width >= BUCKETS_MAX {
                    width *= 2;
                }
                let mut model: BTreeMap<u64, Losses> = BTreeMap::new();
                for (at, more) in &kept {
                    model.entry(at / width).or_default().add(more.clone());
                }
                let (width_s, buckets) = history.buckets();
                prop_assert_eq!(width_s, width as f64 / 1e9);
                let expected: Vec<_> = model.into_iter().map(|(i, l)| (i as f64 * width_s, l)).collect();
                let found: Vec<_> = buckets.into_iter().map(|b| (b.from_s, b.losses)).collect();
                prop_assert!(found.len() as u64 <= BUCKETS_MAX);
                prop_assert_eq!(found, expected);
            }
        }
    }
}
