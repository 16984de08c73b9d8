//! One stream of bulk transfers: handles each completed transfer and decides when the endpoint is cleared.
//!
//! It knows neither libusb nor threads, so that its tests need no device.

use super::frames::{Assembled, Assembler, Layout};
use core::time::Duration;
use depthrig_bus::HostTime;

/// How a transfer completed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Status {
    /// With data.
    Completed,
    /// Because it was cancelled.
    Cancelled,
    /// The endpoint is halted.
    Stalled,
    /// The device is gone.
    Gone,
    /// The device sent more than there was room for.
    Overflow,
    /// Another error on the bus.
    Failed,
}

/// A completed transfer.
#[derive(Debug, Clone, Copy)]
pub(super) struct Completion<'a> {
    pub status: Status,
    pub bytes: &'a [u8],
    /// The transfer had room for more.
    pub short: bool,
}

/// The transfers of one endpoint, by number.
pub(super) trait Transfers: Send {
    /// Number of transfers.
    fn slots(&self) -> usize;
    /// Submits a transfer that is not pending.
    fn submit(&mut self, slot: usize) -> rusb::Result<()>;
    /// Cancels a transfer. It completes like any other.
    fn cancel(&mut self, slot: usize);
    /// Takes a transfer whose completion was posted; `None` when it was not pending.
    fn take_completed(&mut self, slot: usize) -> Option<Completion<'_>>;
}

/// Frame periods of silence after which the endpoint is cleared (librealsense `src/uvc/uvc-streamer.cpp`).
const SILENT_PERIODS: u32 = 10;
/// But not sooner than this: short intervals are late by more than ten of them on a busy computer.
const SILENT_AT_LEAST: Duration = Duration::from_millis(500);
/// And not before the first frame within this: the sensors and their exposure control start up.
const SILENT_AT_START: Duration = Duration::from_secs(2);
/// Clearings without a frame in between, after which silence is left alone: a camera that waits for its
/// synchronisation pulse has nothing to send, and one that hangs is the supervisor's business.
const MAX_CLEARINGS: u32 = 3;
/// Failed transfers in a row that are taken for a halted endpoint.
const MAX_FAILURES: u32 = 8;

/// Next step for the owner of a stream.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Todo {
    Nothing,
    /// No transfer is pending: clear the endpoint, commit the stream again, and call [`Stream::cleared`].
    Clear,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum State {
    Running,
    /// Transfers are being cancelled.
    Draining,
    /// The owner clears the endpoint.
    Clearing,
    Stopping,
}

/// Counts of a stream's transfers by outcome.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct Counts {
    pub transfers: u64,
    pub overflows: u64,
    pub failures: u64,
    pub stalls: u64,
    pub clearings: u64,
}

pub(super) struct Stream<L> {
    transfers: L,
    frames: Assembler,
    state: State,
    pending: usize,
    failures_in_a_row: u32,
    clearings_in_a_row: u32,
    silent_after: Duration,
    last_data: HostTime,
    started: bool,
    counts: Counts,
}

impl<L: Transfers> Stream<L> {
    /// A stream with frames every `period`.
    pub(super) fn new(transfers: L, layout: Layout, period: Duration, now: HostTime) -> Self {
        Self {
            transfers,
            frames: Assembler::new(layout),
            state: State::Running,
            pending: 0,
            failures_in_a_row: 0,
            clearings_in_a_row: 0,
            silent_after: (period * SILENT_PERIODS).max(SILENT_AT_LEAST),
            last_data: now,
            started: false,
            counts: Counts::default(),
        }
    }

    pub(super) const fn pending(&self) -> usize {
        self.pending
    }

    pub(super) const fn counts(&self) -> Counts {
        self.counts
    }

    pub(super) const fn copied(&self) -> u64 {
        self.frames.copied()
    }

    /// Submits every transfer.
    ///
    /// # Errors
    /// libusb's. Transfers that were accepted stay pending.
    pub(super) fn submit_all(&mut self) -> rusb::Result<()> {
        for slot in 0..self.transfers.slots() {
            self.submit(slot)?;
        }
        Ok(())
    }

    /// Handles the transfer that completed at `at`.
    ///
    /// # Errors
    /// [`rusb::Error::NoDevice`], and what a submit fails with.
    pub(super) fn completed(
        &mut self,
        slot: usize,
        at: HostTime,
        each: &mut dyn FnMut(&Assembled<'_>),
    ) -> rusb::Result<()> {
        let Some(completion) = self.transfers.take_completed(slot) else { return Ok(()) };
        self.pending = self.pending.saturating_sub(1);
        self.counts.transfers += 1;
        if completion.status == Status::Gone {
            return Err(rusb::Error::NoDevice);
        }
        if self.state != State::Running {
            return Ok(());
        }
        match completion.status {
            Status::Completed => {
                self.frames.take(completion.bytes, completion.short, each);
                self.failures_in_a_row = 0;
                if !completion.bytes.is_empty() {
                    self.last_data = at;
                    self.started = true;
                    self.clearings_in_a_row = 0;
                }
            }
            Status::Overflow | Status::Failed => {
                self.frames.broken(each);
                if completion.status == Status::Overflow {
                    self.counts.overflows += 1;
                } else {
                    self.counts.failures += 1;
                }
                self.failures_in_a_row += 1;
                if self.failures_in_a_row >= MAX_FAILURES {
                    self.drain();
                    return Ok(());
                }
            }
            Status::Stalled => {
                self.counts.stalls += 1;
                self.drain();
                return Ok(());
            }
            Status::Cancelled | Status::Gone => {}
        }
        self.submit(slot)
    }

    /// Reports whether the endpoint must be cleared; to be called regularly.
    pub(super) fn tick(&mut self, now: HostTime) -> Todo {
        let timeout = if self.started { self.silent_after } else { self.silent_after.max(SILENT_AT_START) };
        if self.state == State::Running
            && self.clearings_in_a_row < MAX_CLEARINGS
            && now.since_ns(self.last_data) > timeout.as_nanos() as i64
        {
            self.drain();
        }
        if self.state == State::Draining && self.pending == 0 {
            self.state = State::Clearing;
            self.clearings_in_a_row += 1;
            self.counts.clearings += 1;
            return Todo::Clear;
        }
        Todo::Nothing
    }

    /// Starts again after the endpoint was cleared and the stream committed, whether or not that succeeded.
    ///
    /// # Errors
    /// [`rusb::Error::NoDevice`], and what a submit fails with.
    pub(super) fn cleared(
        &mut self,
        result: rusb::Result<()>,
        now: HostTime,
        each: &mut dyn FnMut(&Assembled<'_>),
    ) -> rusb::Result<()> {
        if self.state != State::Clearing {
            return Ok(());
        }
        if result == Err(rusb::Error::NoDevice) {
            return result;
        }
        self.frames.restart(each);
        self.state = State::Running;
        self.failures_in_a_row = 0;
        self.last_data = now;
        self.submit_all()
    }

    /// Cancels every transfer for good.
    pub(super) fn stop(&mut self) {
        self.state = State::Stopping;
        self.cancel_all();
    }

    fn drain(&mut self) {
        self.state = State::Draining;
        self.cancel_all();
    }

    fn cancel_all(&mut self) {
        // From the last to the first, so that none fills up because the one before was taken away.
        for slot in (0..self.transfers.slots()).rev() {
            self.transfers.cancel(slot);
        }
    }

    fn submit(&mut self, slot: usize) -> rusb::Result<()> {
        self.transfers.submit(slot)?;
        self.pending += 1;
        Ok(())
    }
}

#[cfg(test)]
mod tests;
