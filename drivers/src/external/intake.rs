//! The frames of one stream on their way in: checked against the mode that was announced, counted, copied once.

use super::pace::Pace;
use crate::{FrameSink, Gate, Outcome, RawFrame, StreamProfile};
use depthrig_bus::external::{
    ExternalFrame, ExternalFrameFlags, FRAME_MAGIC, FrameInlet, SentFrame, VERSION,
};
use depthrig_bus::{ClockDomain, DropReason, FrameFlags, HostTime, PixelFormat, Result};

/// A frame that says it came longer ago than this is not believed, nanoseconds.
const OLDEST_NS: i64 = 10_000_000_000;
/// Frames in a row that are not what was announced, after which the process is told.
pub(super) const STRANGE_IN_A_ROW: u32 = 8;
/// No exposure is longer, nanoseconds.
const LONGEST_EXPOSURE_NS: u64 = 3_600_000_000_000;
/// Temperatures that a sensor can have, °C.
const TEMPERATURES: core::ops::RangeInclusive<f32> = -100.0..=250.0;

/// One stream.
#[derive(Debug)]
pub(super) struct Intake {
    index: usize,
    inlet: FrameInlet,
    gate: Gate,
    pace: Pace,
    profile: StreamProfile,
    has_counter: bool,
    pending: Option<SentFrame>,
    last_sequence: u64,
    last_arrival: HostTime,
    /// The last time of the device that came, and when.
    last_ticks: Option<(u64, HostTime)>,
    strange: u32,
    warned: bool,
}

/// What became of one look.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Look {
    /// Nothing was there.
    Empty,
    /// A frame was taken, delivered or dropped.
    Frame,
    /// A frame was not copied because too many come.
    Flood,
}

impl Intake {
    /// Stream number `index` with mode `profile`, whose device counts frames if `has_counter`.
    pub(super) fn new(index: usize, inlet: FrameInlet, profile: &StreamProfile, has_counter: bool) -> Self {
        Self {
            index,
            inlet,
            gate: Gate::new(index, profile),
            pace: Pace::new(profile.rate_hz),
            profile: profile.clone(),
            has_counter,
            pending: None,
            last_sequence: 0,
            last_arrival: HostTime::from_ns(i64::MIN),
            last_ticks: None,
            strange: 0,
            warned: false,
        }
    }

    /// Whether a frame of `session` waits.
    pub(super) fn has_frame(&mut self, session: (u64, u64)) -> Result<bool> {
        if self.pending.is_none() {
            self.pending = self.next(session)?;
        }
        Ok(self.pending.is_some())
    }

    /// How long to leave a flood alone.
    pub(super) fn wait(&self) -> core::time::Duration {
        self.pace.wait()
    }

    /// Why the frames cannot be used, once there were too many that are not what was announced.
    pub(super) fn verdict(&self) -> Option<String> {
        (self.strange >= STRANGE_IN_A_ROW)
            .then(|| format!("{STRANGE_IN_A_ROW} frames in a row are not {}", self.profile.describe()))
    }

    /// Takes the next frame of `session` (instance and number), if there is one.
    pub(super) fn take(&mut self, session: (u64, u64), sink: &mut dyn FrameSink) -> Result<Look> {
        let frame = match self.pending.take() {
            Some(frame) => frame,
            None => match self.next(session)? {
                Some(frame) => frame,
                None => return Ok(Look::Empty),
            },
        };
        let header = *frame.header();
        let now = HostTime::now();
        let raw = self.raw(&header, frame.pixels().len(), now);
        let gap = header.sequence.saturating_sub(self.last_sequence).saturating_sub(1);
        self.gate.explain_gap(gap, DropReason::QueueFull);
        self.last_sequence = self.last_sequence.max(header.sequence);
        let takes = self.pace.takes(now);
        let outcome = self.gate.deliver(&raw, sink, |memory| {
            if !takes {
                return Err(DropReason::QueueFull);
            }
            // The payload was measured above; a process cannot make it shorter any more.
            let pixels = frame.pixels().get(..memory.len()).ok_or(DropReason::WrongSize)?;
            memory.copy_from_slice(pixels);
            Ok(())
        });
        self.judge(&header, frame.pixels().len(), outcome);
        Ok(if takes { Look::Frame } else { Look::Flood })
    }

    /// The next frame of `session`; those of others are passed over.
    fn next(&mut self, session: (u64, u64)) -> Result<Option<SentFrame>> {
        while let Some(frame) = self.inlet.try_next()? {
            let header = frame.header();
            let is_one = header.magic == FRAME_MAGIC
                && header.version == VERSION
                && usize::from(header.size) == size_of::<ExternalFrame>();
            if !is_one {
                self.strange = self.strange.saturating_add(1);
                self.warn(|| "the header of a frame is none of this version".to_owned());
                return Ok(None);
            }
            if (header.instance, header.session) == session && header.sequence > 0 {
                return Ok(Some(frame));
            }
        }
        Ok(None)
    }

    /// What the gate is told of a frame. Whatever cannot be is made harmless here.
    fn raw(&mut self, header: &ExternalFrame, sent: usize, now: HostTime) -> RawFrame {
        let said = HostTime::from_ns(header.arrival_time_ns);
        let believed = said <= now && now.since_ns(said) < OLDEST_NS && said >= self.last_arrival;
        let arrival = if believed { said } else { now.max(self.last_arrival) };
        self.last_arrival = arrival;
        let bytes = if self.is_announced(header) && header.payload_len as usize <= sent {
            header.payload_len as usize
        } else {
            // More than any frame has, which the gate calls a wrong size.
            usize::MAX
        };
        let sequence = if self.has_counter { header.device_sequence } else { header.sequence };
        let sequence = sequence & (u64::MAX >> (64 - self.profile.sequence_bits.clamp(1, 64)));
        let mut raw = RawFrame::new(sequence, 0, arrival, bytes);
        let flags = ExternalFrameFlags(header.flags);
        raw.damaged = flags.has(ExternalFrameFlags::DAMAGED);
        if flags.has(ExternalFrameFlags::HARDWARE_TRIGGERED) {
            raw.flags = raw.flags.with(FrameFlags::HARDWARE_TRIGGERED);
        }
        raw.exposure_ns = if header.exposure_ns <= LONGEST_EXPOSURE_NS { header.exposure_ns } else { 0 };
        raw.gain = if header.gain.is_finite() && header.gain >= 0.0 { header.gain } else { 0.0 };
        let temperature = header.temperature_c;
        raw.temperature_c = if TEMPERATURES.contains(&temperature) { temperature } else { f32::NAN };
        self.stamp(&mut raw, header.device_time, flags.has(ExternalFrameFlags::METADATA_LOST));
        raw
    }

    /// Gives the frame its time of the device, or says that it has none.
    fn stamp(&mut self, raw: &mut RawFrame, ticks: u64, lost: bool) {
        let clock = self.profile.clock;
        let without = |raw: &mut RawFrame| {
            raw.flags = raw.flags.with(FrameFlags::METADATA_LOST).with(FrameFlags::TIME_UNCERTAIN);
        };
        match clock.domain {
            ClockDomain::Device => {
                let mask = u64::MAX >> (64 - clock.counter_bits.clamp(1, 64));
                raw.device_ticks = ticks & mask;
                if lost {
                    without(raw);
                    raw.device_ticks = self.last_ticks.map_or(0, |(ticks, then)| {
                        let since = raw.arrival.since_ns(then).max(0) as f64 / clock.tick_ns();
                        ticks.wrapping_add(since as u64) & mask
                    });
                }
                self.last_ticks = Some((raw.device_ticks, raw.arrival));
            }
            ClockDomain::Kernel => {
                let stamp = HostTime::from_ns(ticks.min(i64::MAX as u64) as i64);
                let age = raw.arrival.since_ns(stamp);
                raw.device_ticks = ticks;
                if lost || !(0..OLDEST_NS).contains(&age) {
                    without(raw);
                    raw.device_ticks = raw.arrival.ns().max(0) as u64;
                }
            }
            _ => raw.device_ticks = raw.arrival.ns().max(0) as u64,
        }
    }

    fn is_announced(&self, header: &ExternalFrame) -> bool {
        let p = &self.profile;
        (header.format, header.width, header.height) == (p.format as u32, p.width, p.height)
    }

    /// Counts frames that are not what was announced, and says so once.
    fn judge(&mut self, header: &ExternalFrame, sent: usize, outcome: Outcome) {
        let strange = match outcome {
            Outcome::Dropped(DropReason::WrongSize) => true,
            Outcome::Dropped(DropReason::Incomplete) => !self.is_announced(header),
            Outcome::Dropped(_) | Outcome::AlreadyCounted => return,
            Outcome::Delivered => false,
        };
        if !strange {
            self.strange = 0;
            return;
        }
        self.strange = self.strange.saturating_add(1);
        let format = PixelFormat::from_code(header.format).map_or("unknown", PixelFormat::name);
        let (width, height, says) = (header.width, header.height, header.payload_len);
        self.warn(|| {
            format!("the process sends {width}x{height} {format}, says {says} bytes and gives {sent}")
        });
    }

    fn warn(&mut self, what: impl FnOnce() -> String) {
        if !core::mem::replace(&mut self.warned, true) {
            let (announced, bytes) = (self.profile.describe(), self.profile.frame_bytes());
            tracing::warn!(
                stream = self.index,
                announced,
                bytes,
                "a frame is not what was announced: {}",
                what()
            );
        }
    }
}
