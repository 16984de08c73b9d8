//! One stream of bulk transfers: what is done with each transfer that comes back, and when the end point is cleared.
//!
//! It knows neither libusb nor threads, so that its tests need no device.

use super::frames::{Assembled, Assembler, Layout};
use core::time::Duration;
use depthrig_bus::HostTime;

/// How a transfer came back.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Status {
    /// With data.
    Completed,
    /// Because it was cancelled.
    Cancelled,
    /// The end point is halted.
    Stalled,
    /// The device is gone.
    Gone,
    /// The device sent more than there was room for.
    Overflow,
    /// Another error on the bus.
    Failed,
}

/// A transfer that came back.
#[derive(Debug, Clone, Copy)]
pub(super) struct Landing<'a> {
    pub status: Status,
    pub bytes: &'a [u8],
    /// There was room for more.
    pub short: bool,
}

/// The transfers of one end point, by number.
pub(super) trait Lane: Send {
    /// How many there are.
    fn slots(&self) -> usize;
    /// Gives a transfer that is at rest to the device.
    fn submit(&mut self, slot: usize) -> rusb::Result<()>;
    /// Asks for a transfer back. It lands as any other.
    fn cancel(&mut self, slot: usize);
    /// Takes a transfer whose end was posted; `None` when it was not under way.
    fn land(&mut self, slot: usize) -> Option<Landing<'_>>;
}

/// Frame periods of silence after which the end point is cleared (librealsense `src/uvc/uvc-streamer.cpp`).
const SILENT_PERIODS: u32 = 10;
/// But not sooner than this: short intervals are late by more than ten of them on a busy computer.
const SILENT_AT_LEAST: Duration = Duration::from_millis(500);
/// And not before the first frame within this: the sensors and their exposure control start up.
const SILENT_AT_START: Duration = Duration::from_secs(2);
/// Clearings without a frame in between, after which silence is left alone: a camera that waits for its
/// synchronisation pulse has nothing to send, and one that hangs is the supervisor's business.
const MAX_CLEARINGS: u32 = 3;
/// Failed transfers in a row that are taken for a halted end point.
const MAX_FAILURES: u32 = 8;

/// What the owner of a stream is to do next.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Todo {
    Nothing,
    /// No transfer is under way: clear the end point, commit the stream again, and call [`Stream::cleared`].
    Clear,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum State {
    Running,
    /// Transfers are being called back.
    Draining,
    /// Somebody clears the end point.
    Clearing,
    Stopping,
}

/// What became of a stream's transfers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct Counts {
    pub transfers: u64,
    pub overflows: u64,
    pub failures: u64,
    pub stalls: u64,
    pub clearings: u64,
}

pub(super) struct Stream<L> {
    lane: L,
    frames: Assembler,
    state: State,
    flying: usize,
    failures_in_a_row: u32,
    clearings_in_a_row: u32,
    silent_after: Duration,
    last_data: HostTime,
    started: bool,
    counts: Counts,
}

impl<L: Lane> Stream<L> {
    /// A stream with frames every `period`.
    pub(super) fn new(lane: L, layout: Layout, period: Duration, now: HostTime) -> Self {
        Self {
            lane,
            frames: Assembler::new(layout),
            state: State::Running,
            flying: 0,
            failures_in_a_row: 0,
            clearings_in_a_row: 0,
            silent_after: (period * SILENT_PERIODS).max(SILENT_AT_LEAST),
            last_data: now,
            started: false,
            counts: Counts::default(),
        }
    }

    pub(super) const fn flying(&self) -> usize {
        self.flying
    }

    pub(super) const fn counts(&self) -> Counts {
        self.counts
    }

    pub(super) const fn copied(&self) -> u64 {
        self.frames.copied()
    }

    /// Gives every transfer to the device.
    ///
    /// # Errors
    /// libusb's. Transfers that were accepted are under way all the same.
    pub(super) fn submit_all(&mut self) -> rusb::Result<()> {
        for slot in 0..self.lane.slots() {
            self.submit(slot)?;
        }
        Ok(())
    }

    /// A transfer came back at `at`.
    ///
    /// # Errors
    /// [`rusb::Error::NoDevice`], and what a submit fails with.
    pub(super) fn landed(
        &mut self,
        slot: usize,
        at: HostTime,
        each: &mut dyn FnMut(&Assembled<'_>),
    ) -> rusb::Result<()> {
        let Some(landing) = self.lane.land(slot) else { return Ok(()) };
        self.flying = self.flying.saturating_sub(1);
        self.counts.transfers += 1;
        if landing.status == Status::Gone {
            return Err(rusb::Error::NoDevice);
        }
        if self.state != State::Running {
            return Ok(());
        }
        match landing.status {
            Status::Completed => {
                self.frames.take(landing.bytes, landing.short, each);
                self.failures_in_a_row = 0;
                if !landing.bytes.is_empty() {
                    self.last_data = at;
                    self.started = true;
                    self.clearings_in_a_row = 0;
                }
            }
            Status::Overflow | Status::Failed => {
                self.frames.broken(each);
                if landing.status == Status::Overflow {
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

    /// To be called now and then: whether the end point must be cleared.
    pub(super) fn tick(&mut self, now: HostTime) -> Todo {
        let patience = if self.started { self.silent_after } else { self.silent_after.max(SILENT_AT_START) };
        if self.state == State::Running
            && self.clearings_in_a_row < MAX_CLEARINGS
            && now.since_ns(self.last_data) > patience.as_nanos() as i64
        {
            self.drain();
        }
        if self.state == State::Draining && self.flying == 0 {
            self.state = State::Clearing;
            self.clearings_in_a_row += 1;
            self.counts.clearings += 1;
            return Todo::Clear;
        }
        Todo::Nothing
    }

    /// The end point was cleared and the stream committed again, or not: in both cases it is tried again.
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

    /// Calls every transfer back for good.
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
        for slot in (0..self.lane.slots()).rev() {
            self.lane.cancel(slot);
        }
    }

    fn submit(&mut self, slot: usize) -> rusb::Result<()> {
        self.lane.submit(slot)?;
        self.flying += 1;
        Ok(())
    }
}

#[cfg(test)]
mod tests;
