//! Where the ticks of all computers of a session lie: chosen by the one that records, for the streams of all.
//!
//! It says its phase to the others twice a second, and they answer with the rhythms of their streams ([`crate::hosts`]). A computer that is
//! away keeps the phase that it heard last.

use super::Rhythm;
use core::sync::atomic::{AtomicI64, Ordering};
use depthrig_bus::HostTime;
use depthrig_bus::sync::lock;
use std::collections::BTreeMap;
use std::sync::Mutex;

/// A stream that is 20 ppm off its measured period is a quarter of a frame of 30 Hz away after so long.
const KNOWN_FOR_NS: i64 = 400_000_000_000;

/// The phase of the ticks, and the streams that it is chosen for.
#[derive(Debug, Default)]
pub struct Grid {
    /// Ticks lie so long after multiples of the period on the clock of the session, nanoseconds.
    phase_ns: AtomicI64,
    /// Streams of this computer, on the clock of the session.
    own: Mutex<Vec<Rhythm>>,
    /// Those of others, by the name of the computer.
    others: Mutex<BTreeMap<String, Vec<Rhythm>>>,
}

impl Grid {
    /// Phase of the ticks, nanoseconds after multiples of the period on the clock of the session.
    pub fn phase_ns(&self) -> i64 {
        self.phase_ns.load(Ordering::Relaxed)
    }

    /// Sets the phase.
    pub fn set_phase_ns(&self, phase_ns: i64) {
        self.phase_ns.store(phase_ns, Ordering::Relaxed);
    }

    /// Rhythms of this computer's streams on the clock of the session; empty while that is unknown.
    pub fn own(&self) -> Vec<Rhythm> {
        lock(&self.own).clone()
    }

    /// Sets the rhythms of this computer's streams.
    pub fn set_own(&self, rhythms: impl Iterator<Item = Rhythm>) {
        let mut own = lock(&self.own);
        own.clear();
        own.extend(rhythms);
    }

    /// Rhythms of all other computers, of those that are away too, which keep the phase: for some minutes they are known well enough.
    pub fn others(&self, now: HostTime) -> Vec<Rhythm> {
        let is_known = |r: &&Rhythm| now.ns().saturating_sub(r.newest_ns) < KNOWN_FOR_NS;
        lock(&self.others).values().flatten().filter(is_known).copied().collect()
    }

    /// Sets the rhythms of another computer.
    pub fn set_other(&self, host: &str, rhythms: Vec<Rhythm>) {
        lock(&self.others).insert(host.to_owned(), rhythms);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_computer_that_is_away_is_forgotten_after_some_minutes() {
        let grid = Grid::default();
        let rhythm = |newest_ns| Rhythm { newest_ns, period_ns: 1e9 / 30.0, tolerance_ns: 1 };
        grid.set_other("left", vec![rhythm(1_000), rhythm(2_000)]);
        grid.set_other("top", vec![rhythm(300_000_000_000)]);
        let known = |ns| grid.others(HostTime::from_ns(ns)).len();
        assert_eq!(known(KNOWN_FOR_NS), 3);
        assert_eq!(known(KNOWN_FOR_NS + 1_500), 2);
        assert_eq!(known(KNOWN_FOR_NS + 2_000), 1);
        // What it says now replaces what it said.
        grid.set_other("left", vec![rhythm(KNOWN_FOR_NS)]);
        assert_eq!(known(KNOWN_FOR_NS + 2_000), 2);
    }
}
