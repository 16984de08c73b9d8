//! Where the ticks of all computers of a session lie: chosen by the one that records, for the streams of all.
//!
//! It says its phase to the others twice a second, and they answer with the rhythms of their streams ([`crate::hosts`]). A computer that is
//! away keeps the phase that it heard last.

use super::Rhythm;
use core::sync::atomic::{AtomicI64, Ordering};
use depthrig_bus::sync::lock;
use std::collections::BTreeMap;
use std::sync::Mutex;

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

    /// Rhythms of all other computers.
    pub fn others(&self) -> Vec<Rhythm> {
        lock(&self.others).values().flatten().copied().collect()
    }

    /// Sets the rhythms of another computer; none when it is away.
    pub fn set_other(&self, host: &str, rhythms: Vec<Rhythm>) {
        lock(&self.others).insert(host.to_owned(), rhythms);
    }
}
