//! Whether somebody keeps the clock of the computer right.
#![allow(unsafe_code)] // adjtimex(2) has no safe form in the crates that are used

use core::mem;

/// Synchronisation of the computer's clock, as the kernel has it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ClockSync {
    /// A program (chrony, systemd-timesyncd, ntpd, ptp4l) keeps it right.
    pub synchronised: bool,
    /// The error that the kernel reckons with at most, microseconds.
    pub max_error_us: i64,
    /// The rate at which it is turned now, against the oscillator, parts per million: chrony and `ptp4l` correct an offset so.
    pub slew_ppm: f64,
}

/// Asks the kernel; nothing is changed.
pub fn clock_sync() -> Option<ClockSync> {
    // SAFETY: `timex` is plain C data, for which all bytes zero is a value; `modes` 0 changes nothing.
    let mut timex: libc::timex = unsafe { mem::zeroed() };
    // SAFETY: the pointer is to a whole `timex` that lives over the call.
    let state = unsafe { libc::adjtimex(&raw mut timex) };
    (state >= 0).then_some(ClockSync {
        synchronised: state != libc::TIME_ERROR && timex.status & libc::STA_UNSYNC == 0,
        max_error_us: timex.maxerror,
        // adjtimex(2): `freq` in units of 2^-16 ppm, `tick` in microseconds of a hundredth of a second.
        slew_ppm: timex.freq as f64 / 65536.0 + (timex.tick - 10_000) as f64 * 100.0,
    })
}
