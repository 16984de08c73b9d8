//! Datasets of several computers on the clock of their session.
//!
//! Each of them has the signal `HOST/link_clock` ([`crate::link`]). What it says beside a set puts the set's times on the session's clock: local
//! time plus offset. Ticks of all computers lie on one grid there, so that sets of one moment are found whatever UTC their computers had.

use crate::link::{self, ClockSample};
use depthrig_bus::HostTime;
use depthrig_link::Reading;
use depthrig_recorder::{PixelMode, Session, SetReader};

/// From the clock of a set to that of a replay.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Shift {
    /// Added to its times, nanoseconds.
    pub ns: i64,
    /// The same at the first set of its epoch, nanoseconds: publishers of signals are known by a time.
    pub epoch_ns: i64,
    /// The shift may be wrong by this much, nanoseconds.
    pub uncertainty_ns: u64,
    /// A clock stepped beside the set, or was not known for a while, so that it may be wrong by more.
    pub is_doubtful: bool,
}

/// A set's place on the session's clock.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Place {
    /// Log time of the set on the session's clock, nanoseconds.
    pub session_ns: i64,
    /// From its computer's clock to the session's.
    pub shift: Shift,
}

/// Which clock a dataset's session has, and the place of each set on it.
#[derive(Debug)]
pub struct SessionClock {
    /// The clock's number.
    pub clock: i64,
    /// Of each set.
    pub places: Vec<Place>,
    /// The session's clock minus UTC, as this computer saw both at its first set, nanoseconds.
    pub utc_offset_ns: i64,
}

impl SessionClock {
    /// That of a dataset, whose sets are read without their images; `None` for a dataset of one computer, or if several clocks took turns.
    ///
    /// A dataset with the signals of several computers is one that was joined: its times are on the session's clock already.
    pub fn of(session: &Session, reader: &mut SetReader) -> Option<Self> {
        let signals = session.signals.iter().enumerate();
        let signals: Vec<_> =
            signals.filter(|(_, s)| link::is_clock(&s.description)).map(|(i, _)| i).collect();
        if signals.is_empty() {
            return None;
        }
        let mut samples: Vec<ClockSample> = Vec::new();
        // Of each set its tick and the offset to UTC; of one that cannot be read those of the set before.
        let mut ticks: Vec<(HostTime, i64)> = Vec::new();
        for (n, utc_ns) in reader.times().to_vec().into_iter().enumerate() {
            let Ok(set) = reader.read(n, PixelMode::None) else {
                let (_, offset_ns) = ticks.last().copied().unwrap_or_default();
                ticks.push((HostTime::from_ns(utc_ns.saturating_sub(offset_ns)), offset_ns));
                continue;
            };
            ticks.push((set.tick, set.utc_offset_ns));
            let of_clock = set.signals.iter().filter(|s| signals.contains(&s.signal));
            samples.extend(of_clock.flat_map(|s| &s.samples).filter_map(link::read));
        }
        let clock = samples.first()?.clock;
        if samples.iter().any(|s| s.clock != clock) {
            return None;
        }
        if signals.len() > 1 {
            let own = Reading { offset_ns: 0, uncertainty_ns: 0, rate: 0.0, epoch: 1 };
            for sample in &mut samples {
                sample.reading = own;
            }
        }
        samples.sort_by_key(|s| s.time);
        let mut begun = None;
        let mut places = Vec::new();
        for (tick, _) in &ticks {
            let (epoch, place) = place(*tick, &samples)?;
            let epoch_ns = match begun {
                Some((before, ns)) if before == epoch => ns,
                _ => place.shift.ns,
            };
            begun = Some((epoch, epoch_ns));
            places.push(Place { shift: Shift { epoch_ns, ..place.shift }, ..place });
        }
        let utc_offset_ns = ticks.first()?.1.saturating_sub(places.first()?.shift.ns);
        Some(Self { clock, places, utc_offset_ns })
    }

    /// Log times on the session's clock moved to UTC by `utc_offset_ns`, strictly increasing.
    pub fn times(&self, utc_offset_ns: i64) -> Vec<i64> {
        let mut before = i64::MIN;
        let rising = |place: &Place| {
            before = place.session_ns.saturating_add(utc_offset_ns).max(before.saturating_add(1));
            before
        };
        self.places.iter().map(rising).collect()
    }
}

/// Farther from its nearest sample the place of a set is doubtful: the clock was not known yet, or not for a while.
const NEAR_NS: u64 = 1_000_000_000;

/// The place of a set by the sample nearest in time, which is at most 0.1 s away while the recording has all of them;
/// with its epoch.
fn place(tick: HostTime, samples: &[ClockSample]) -> Option<(u32, Place)> {
    let after = samples.partition_point(|s| s.time <= tick);
    let around = [after.checked_sub(1).and_then(|i| samples.get(i)), samples.get(after)];
    let nearest = around.iter().flatten().min_by_key(|s| tick.since_ns(s.time).saturating_abs())?;
    let off_ns = tick.since_ns(nearest.time);
    let r = nearest.reading.moved(off_ns);
    let is_between_epochs = matches!(around, [Some(a), Some(b)] if a.reading.epoch != b.reading.epoch);
    let shift = Shift {
        ns: r.offset_ns,
        epoch_ns: r.offset_ns,
        uncertainty_ns: r.uncertainty_ns,
        is_doubtful: is_between_epochs || off_ns.unsigned_abs() > NEAR_NS,
    };
    let place = Place { session_ns: tick.plus_ns(shift.ns).ns(), shift };
    Some((r.epoch, place))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sample(time_ms: i64, offset_ns: i64, epoch: u32) -> ClockSample {
        let reading = Reading { offset_ns, uncertainty_ns: 1000, rate: 1e-4, epoch };
        ClockSample { clock: 1, reading, time: HostTime::from_ns(time_ms * 1_000_000) }
    }

    #[test]
    fn a_set_goes_by_the_nearest_sample() {
        let samples = [sample(100, 5_000, 1), sample(200, 15_000, 1), sample(300, -7_000, 2)];
        let at = |ms: i64| place(HostTime::from_ns(ms * 1_000_000), &samples).unwrap().1;
        assert_eq!((at(120).shift.ns, at(120).shift.is_doubtful), (5_000 + 2_000, false));
        assert_eq!(at(120).session_ns, 120_000_000 + 7_000);
        assert_eq!(at(180).shift.ns, 15_000 - 2_000);
        assert_eq!(at(120).shift.uncertainty_ns, 1_000 + 40);
        // Between two epochs.
        assert!(at(240).shift.is_doubtful && at(260).shift.is_doubtful);
        // Before the first and after the last.
        assert_eq!((at(0).shift.ns, at(0).shift.is_doubtful), (5_000 - 10_000, false));
        assert_eq!((at(400).shift.ns, at(400).shift.is_doubtful), (-7_000 + 10_000, false));
        assert!(!at(1300).shift.is_doubtful && at(1301).shift.is_doubtful && at(-901).shift.is_doubtful);
        assert_eq!(place(HostTime::from_ns(0), &[]), None);
    }
}
