//! Moments of frame sets, and the selection of frames to compute on when not all are computed.

mod schedule;

use core::sync::atomic::{AtomicI64, Ordering};
use depthrig_bus::HostTime;
pub use schedule::FrameSchedule;

/// The moments of the frame sets: equally spaced, after the newest that is known. Whoever makes sets notes them.
#[derive(Debug, Default)]
pub struct SetTimes {
    /// 0 before the first.
    newest_ns: AtomicI64,
    period_ns: AtomicI64,
}

/// A moment of a set, and how far from it something is, all in nanoseconds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Due {
    moment: i64,
    off: i64,
    period: i64,
}

impl SetTimes {
    /// Notes the newest set and the time from one to the next.
    pub fn note(&self, newest: HostTime, period_ns: i64) {
        self.period_ns.store(period_ns, Ordering::Relaxed);
        self.newest_ns.store(newest.ns(), Ordering::Relaxed);
    }

    /// The newest set, if there is one.
    pub fn newest(&self) -> Option<HostTime> {
        Some(self.newest_ns.load(Ordering::Relaxed)).filter(|t| *t != 0).map(HostTime::from_ns)
    }

    /// From one set to the next, nanoseconds; 1 before the first.
    pub fn period_ns(&self) -> i64 {
        self.period_ns.load(Ordering::Relaxed).max(1)
    }

    /// The set that an image captured at `at` is for when images come `frame_ns` apart: the one that it is nearer to
    /// than its neighbours are. None for an image between two sets.
    pub fn due(&self, at: HostTime, frame_ns: i64) -> Option<Due> {
        let newest = self.newest()?;
        let period_ns = self.period_ns();
        let since = at.since_ns(newest);
        let moment = since.saturating_add(period_ns / 2).div_euclid(period_ns).saturating_mul(period_ns);
        // A quarter more, because stamps tremble and moments move: two images may be for one set, and the nearer is.
        let off = (since - moment).abs();
        (off <= frame_ns / 2 + frame_ns / 4).then(|| Due {
            moment: newest.ns().saturating_add(moment),
            off,
            period: period_ns,
        })
    }
}

impl Due {
    /// Of an image that is due for itself.
    pub const fn alone(at: HostTime, period_ns: i64) -> Self {
        Self { moment: at.ns(), off: 0, period: period_ns }
    }

    /// Whether an image that is for this set stays when one comes that is for `newer`.
    pub fn stays(&self, newer: Option<&Self>) -> bool {
        newer.is_none_or(|n| {
            let same = n.moment.abs_diff(self.moment) < self.period as u64 / 2;
            same && self.off <= n.off
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;

    fn at(ms: i64) -> HostTime {
        HostTime::from_ns(ms * MS)
    }

    #[test]
    fn before_the_first_set_no_image_is_for_one() {
        assert_eq!(SetTimes::default().due(at(1000), 33 * MS), None);
        assert_eq!(SetTimes::default().newest(), None);
    }

    #[test]
    fn images_are_for_the_set_that_they_are_nearest_to_however_long_ago_one_was_noted() {
        let sets = SetTimes::default();
        sets.note(at(1000), 200 * MS);
        // Of images 33 ms apart, from before the newest set to long after it.
        let images: Vec<_> = (0..300).map(|i| 711 + 33 * i).collect();
        for moment in (800..10_000).step_by(200) {
            let nearest = images.iter().copied().min_by_key(|p: &i64| (p - moment).abs()).unwrap();
            let due = sets.due(at(nearest), 33 * MS).unwrap();
            assert_eq!((due.moment, due.off), (moment * MS, (nearest - moment).abs() * MS));
        }
        let many = images.iter().filter(|p| sets.due(at(**p), 33 * MS).is_some()).count();
        let sets_seen = (images[299] - images[0]) / 200;
        assert!((sets_seen..=2 * sets_seen).contains(&(many as i64)), "{many} for {sets_seen} sets");
    }

    #[test]
    fn the_nearer_of_two_for_one_set_stays_and_a_newer_set_wins() {
        let due = |moment: i64, off: i64| Due { moment: moment * MS, off: off * MS, period: 200 * MS };
        assert!(due(1000, 20).stays(None), "before one that is for no set");
        assert!(due(1000, 3).stays(Some(&due(1000, 20))));
        assert!(due(1000, 3).stays(Some(&due(1002, 4))), "the moments have moved a little");
        assert!(!due(1000, 20).stays(Some(&due(1000, 3))));
        assert!(!due(1000, 0).stays(Some(&due(1200, 20))));
    }
}
