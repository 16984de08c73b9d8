//! The gate that every frame of every driver passes: accounts, checks, clock, one write of the pixels.
//!
//! Invariants, per stream:
//! - `captured = delivered + Σ dropped(reason)` after every call, where `captured` counts each frame that
//!   the device announced since the gate was made: those seen and those that its frame counter skipped;
//! - delivered frames have strictly rising unwrapped device sequence numbers within one clock epoch;
//! - capture times never go back within one clock epoch, and never lie after the arrival.

use crate::clock::{CalibratedLatency, ClockConfig, ClockMap};
use crate::{FrameMeta, FrameSink, Loan, StreamProfile};
use depthrig_bus::{ClockDomain, DropCounts, DropReason, FrameFlags, HostTime, PixelFormat};

/// A frame as the device announces it, before its pixels are written anywhere.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RawFrame {
    /// The device's frame counter as it came.
    pub device_sequence: u64,
    /// The device's clock at mid-exposure as it came.
    pub device_ticks: u64,
    /// When the last byte had arrived.
    pub arrival: HostTime,
    /// Bytes that arrived, of the pixels as the device sends them, scaled to the delivered format: a driver
    /// that converts on the way reports `frame_bytes()` when the source was whole.
    pub bytes: usize,
    /// The device or the transport flagged the frame as damaged.
    pub damaged: bool,
    /// Exposure time; 0 when unknown.
    pub exposure_ns: u64,
    /// Sensor gain; 0 when unknown.
    pub gain: f32,
    /// Sensor temperature in °C; NaN when unknown.
    pub temperature_c: f32,
    /// Facts that the driver knows (hardware trigger, synthetic).
    pub flags: FrameFlags,
}

impl RawFrame {
    /// A whole, undamaged frame of `bytes` bytes about which nothing else is known.
    pub const fn new(device_sequence: u64, device_ticks: u64, arrival: HostTime, bytes: usize) -> Self {
        Self {
            device_sequence,
            device_ticks,
            arrival,
            bytes,
            damaged: false,
            exposure_ns: 0,
            gain: 0.0,
            temperature_c: f32::NAN,
            flags: FrameFlags(0),
        }
    }
}

/// Outcome of a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Outcome {
    /// Published.
    Delivered,
    /// Dropped and counted.
    Dropped(DropReason),
    /// It came after its successor and had been counted as [`DropReason::DeviceGap`] already.
    AlreadyCounted,
}

/// How far back a frame counter may step and still be a late or repeated frame rather than a restart.
const REORDER_WINDOW: u64 = 64;
/// So many frames behind the newest, each the successor of the last, are not stragglers: the counter restarted.
const RESTARTING_FRAMES: u32 = 4;

/// No camera loses so many frames in a row; a counter that jumps farther was set anew.
const FARTHEST_GAP: u64 = 1 << 32;

/// The gate of one stream.
#[derive(Debug)]
pub struct Gate {
    stream: usize,
    format: PixelFormat,
    frame_bytes: usize,
    sequence_bits: u32,
    domain: ClockDomain,
    /// Flags of every frame.
    flags: FrameFlags,
    clock: ClockMap,
    /// Newest unwrapped sequence number, and which of the 64 before it were seen (bit 0 = the newest).
    newest: Option<(u64, u64)>,
    /// The last frame behind the newest, and how many in a row came before it, itself included.
    behind: Option<(u64, u32)>,
    /// Frames before the next one whose loss is known already, and what for.
    known_lost: (u64, DropReason),
    captured: u64,
    delivered: u64,
    drops: DropCounts,
    last_capture: HostTime,
    /// Frames between two reports of the clock's quality: about a second's worth.
    report_every: u64,
    /// The receiver was asked for the stream's latency.
    is_asked: bool,
    /// The receiver's answer.
    latency: Option<CalibratedLatency>,
}

impl Gate {
    /// The gate of stream number `stream`, delivering as `profile` says.
    pub fn new(stream: usize, profile: &StreamProfile) -> Self {
        let clock =
            ClockConfig::new(profile.clock.counter_bits, profile.clock.tick_ns(), profile.period_ns());
        Self {
            stream,
            format: profile.format,
            frame_bytes: profile.frame_bytes(),
            sequence_bits: profile.sequence_bits,
            domain: profile.clock.domain,
            flags: profile.metadata.flags(),
            clock: ClockMap::new(clock),
            newest: None,
            behind: None,
            known_lost: (0, DropReason::DeviceGap),
            captured: 0,
            delivered: 0,
            drops: DropCounts::default(),
            last_capture: HostTime::from_ns(i64::MIN),
            report_every: (profile.rate_hz.ceil() as u64).max(1),
            is_asked: false,
            latency: None,
        }
    }

    /// Frames captured since the gate was made, delivered or not.
    pub const fn captured(&self) -> u64 {
        self.captured
    }

    /// Frames delivered since the gate was made.
    pub const fn delivered(&self) -> u64 {
        self.delivered
    }

    /// Frames lost since the gate was made.
    pub const fn drops(&self) -> DropCounts {
        self.drops
    }

    /// The stream's clock map, for its quality and for two-way probes.
    pub const fn clock(&mut self) -> &mut ClockMap {
        &mut self.clock
    }

    /// Says that up to `n` of the frames that the counter of the next one skips were lost for `reason` and not by the
    /// device. Only the last word before a frame counts.
    pub const fn explain_gap(&mut self, n: u64, reason: DropReason) {
        self.known_lost = (n, reason);
    }

    /// Passes one frame: checks and counts it, maps its time, and has `fill` write the pixels into memory on
    /// loan from `sink`. `fill` writes every byte of it or returns the reason why the frame is
    /// dropped.
    pub fn deliver(
        &mut self,
        raw: &RawFrame,
        sink: &mut dyn FrameSink,
        fill: impl FnOnce(&mut [u8]) -> Result<(), DropReason>,
    ) -> Outcome {
        self.deliver_timed(raw, sink, |memory, _| fill(memory))
    }

    /// As [`Self::deliver`] for payloads with times in them: `fill` gets the frame's metadata, and may change the
    /// fields that the gate does not know.
    pub fn deliver_timed(
        &mut self,
        raw: &RawFrame,
        sink: &mut dyn FrameSink,
        fill: impl FnOnce(&mut [u8], &mut FrameMeta) -> Result<(), DropReason>,
    ) -> Outcome {
        let stream = self.stream;
        self.pass(raw, sink, |meta, sink| {
            let memory = sink.loan(stream, raw.bytes).ok_or(DropReason::NoSlot)?;
            let mut meta = *meta;
            if let Err(reason) = fill(memory, &mut meta) {
                sink.discard(stream);
                return Err(reason);
            }
            sink.commit(stream, &meta);
            Ok(())
        })
    }

    /// Passes one frame whose pixels the device has written into `loan`, which came from `sink`'s
    /// [`FrameSink::lend`] and is of the size of the frame. The loan comes back when the frame is not delivered.
    pub fn deliver_lent(
        &mut self,
        raw: &RawFrame,
        sink: &mut dyn FrameSink,
        loan: Loan,
    ) -> (Outcome, Option<Loan>) {
        let stream = self.stream;
        let mut loan = Some(loan);
        let outcome = self.pass(raw, sink, |meta, sink| {
            if let Some(loan) = loan.take() {
                sink.commit_lent(stream, loan, meta);
            }
            Ok(())
        });
        (outcome, loan)
    }

    /// Counts, checks and stamps one frame; `hand_over` publishes it or says why it cannot.
    fn pass(
        &mut self,
        raw: &RawFrame,
        sink: &mut dyn FrameSink,
        hand_over: impl FnOnce(&FrameMeta, &mut dyn FrameSink) -> Result<(), DropReason>,
    ) -> Outcome {
        let Some(device_sequence) = self.account(raw, sink) else {
            return Outcome::AlreadyCounted;
        };
        self.ask_latency(sink);
        let passed = device_sequence.and_then(|sequence| {
            self.check(raw)?;
            let meta = FrameMeta { captured: self.captured, ..self.stamp(raw, sequence) };
            hand_over(&meta, sink)
        });
        if let Err(reason) = passed {
            self.lose(reason, 1, sink);
            return Outcome::Dropped(reason);
        }
        if self.domain == ClockDomain::Device && self.delivered.is_multiple_of(self.report_every) {
            sink.clock_quality(self.stream, &self.clock.quality());
        }
        self.delivered += 1;
        Outcome::Delivered
    }

    /// Asks once for the latency that a calibration found.
    fn ask_latency(&mut self, sink: &dyn FrameSink) {
        if core::mem::replace(&mut self.is_asked, true) {
            return;
        }
        self.latency = sink.calibrated_latency(self.stream);
        if let Some(latency) = self.latency {
            self.clock.calibrate(latency);
        }
    }

    /// Checks that the frame is complete and undamaged.
    fn check(&self, raw: &RawFrame) -> Result<(), DropReason> {
        if raw.damaged {
            return Err(DropReason::DeviceError);
        }
        let varies = self.format == PixelFormat::Mjpeg;
        if raw.bytes > self.frame_bytes || raw.bytes == 0 {
            return Err(if raw.bytes == 0 { DropReason::Incomplete } else { DropReason::WrongSize });
        }
        if raw.bytes < self.frame_bytes && !varies {
            return Err(DropReason::Incomplete);
        }
        Ok(())
    }

    /// Maps the frame's time.
    fn stamp(&mut self, raw: &RawFrame, device_sequence: u64) -> FrameMeta {
        let mut meta = FrameMeta {
            device_sequence,
            device_time: raw.device_ticks,
            capture_time: raw.arrival,
            capture_uncertainty_ns: 0,
            clock_epoch: 0,
            clock_domain: self.domain,
            arrival: raw.arrival,
            flags: raw.flags.with(self.flags),
            captured: self.captured,
            exposure_ns: raw.exposure_ns,
            gain: raw.gain,
            temperature_c: raw.temperature_c,
            latency_ns: 0,
        };
        if self.domain == ClockDomain::Device {
            let mapped = self.clock.observe(raw.device_ticks, device_sequence, raw.arrival);
            meta.device_time = mapped.device_time;
            meta.capture_time = mapped.capture_time;
            meta.capture_uncertainty_ns = mapped.uncertainty_ns;
            meta.clock_epoch = mapped.epoch;
            meta.flags = meta.flags.with(mapped.flags);
            meta.latency_ns = mapped.latency_ns;
        } else {
            let latency_ns = self.latency.map_or(0, |l| l.ns.max(0));
            if let Some(latency) = self.latency {
                meta.flags = meta.flags.with(FrameFlags::LATENCY_CALIBRATED);
                meta.latency_ns = latency_ns as u64;
                meta.capture_uncertainty_ns = latency.bound_ns.max(0) as u64;
            }
            // With the kernel's domain the counter is its monotonic stamp in nanoseconds, taken as it is.
            let stamp = match self.domain {
                ClockDomain::Kernel => HostTime::from_ns(raw.device_ticks as i64).min(raw.arrival),
                _ => raw.arrival,
            };
            if latency_ns > 0 || self.domain == ClockDomain::Kernel {
                meta.capture_time = stamp.plus_ns(-latency_ns).max(self.last_capture);
            }
        }
        self.last_capture = meta.capture_time;
        meta
    }

    /// Unwraps the frame counter and counts the frames that it skipped. `None`: counted before; `Err`: not
    /// to be delivered.
    fn account(&mut self, raw: &RawFrame, sink: &mut dyn FrameSink) -> Option<Result<u64, DropReason>> {
        let (known, why) = core::mem::replace(&mut self.known_lost, (0, DropReason::DeviceGap));
        let Some((newest, seen)) = self.newest else {
            self.newest = Some((raw.device_sequence, 1));
            // Nobody but the transport can know of frames before the first.
            let known = if known > FARTHEST_GAP { 0 } else { known };
            self.capture(1 + known, sink);
            self.lose(why, known, sink);
            return Some(Ok(raw.device_sequence));
        };
        let bits = self.sequence_bits.clamp(1, 64);
        let shift = 64 - bits;
        // Signed distance on the counter's own circle.
        let step = ((raw.device_sequence << shift).wrapping_sub(newest << shift) as i64) >> shift;
        if step > 0 && step as u64 > FARTHEST_GAP {
            self.capture(1, sink);
            self.behind = None;
            self.newest = Some((raw.device_sequence, 1));
            return Some(Ok(raw.device_sequence));
        }
        if step > 0 {
            self.behind = None;
            let step = step as u64;
            self.capture(step, sink);
            let known = known.min(step - 1);
            self.lose(why, known, sink);
            self.lose(DropReason::DeviceGap, step - 1 - known, sink);
            let seen = if step >= 64 { 1 } else { (seen << step) | 1 };
            self.newest = Some((newest.wrapping_add(step), seen));
            return Some(Ok(newest.wrapping_add(step)));
        }
        let back = step.unsigned_abs();
        let in_a_row = match self.behind {
            Some((last, n)) if last.wrapping_add(1) == raw.device_sequence => n + 1,
            _ => 1,
        };
        self.behind = Some((raw.device_sequence, in_a_row));
        if back < REORDER_WINDOW && back <= newest && in_a_row < RESTARTING_FRAMES {
            if seen & (1 << back) == 0 {
                self.newest = Some((newest, seen | (1 << back)));
                return None;
            }
            self.capture(1, sink);
            return Some(Err(DropReason::OutOfOrder));
        }
        // The counter restarted: the device was reset. How many frames it lost meanwhile nobody knows.
        self.capture(1, sink);
        self.behind = None;
        self.newest = Some((raw.device_sequence, 1));
        Some(Ok(raw.device_sequence))
    }

    fn capture(&mut self, n: u64, sink: &mut dyn FrameSink) {
        self.captured += n;
        sink.captured(self.stream, n);
    }

    fn lose(&mut self, reason: DropReason, n: u64, sink: &mut dyn FrameSink) {
        if n > 0 {
            self.drops.add(reason, n);
            sink.dropped(self.stream, reason, n);
        }
    }
}

#[cfg(test)]
mod tests;
