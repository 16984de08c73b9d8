//! Sanitises a frame's header: an invalid value becomes the known one, or nothing.

use depthrig_bus::external::{ExternalFrame, ExternalFrameFlags, FRAME_MAGIC, VERSION};
use depthrig_bus::{ClockDomain, FrameFlags, HostTime};
use depthrig_driver::{RawFrame, StreamProfile};

/// A frame that says it came longer ago than this is not believed, nanoseconds.
const OLDEST_NS: i64 = 10_000_000_000;
/// No exposure is longer, nanoseconds.
const LONGEST_EXPOSURE_NS: u64 = 3_600_000_000_000;
/// Temperatures that a sensor can have, °C.
const TEMPERATURES: core::ops::RangeInclusive<f32> = -100.0..=250.0;

/// State of the frames of one stream so far.
#[derive(Debug)]
pub(crate) struct Facts {
    profile: StreamProfile,
    has_counter: bool,
    last_sequence: u64,
    last_arrival: HostTime,
    /// The last time of the device that came, and when.
    last_ticks: Option<(u64, HostTime)>,
}

/// Whether a header is one of this version at all.
pub(super) fn is_header(header: &ExternalFrame) -> bool {
    header.magic == FRAME_MAGIC
        && header.version == VERSION
        && usize::from(header.size) == size_of::<ExternalFrame>()
}

impl Facts {
    /// Of the frames of a mode, whose device counts them if `has_counter`.
    pub(crate) fn new(profile: &StreamProfile, has_counter: bool) -> Self {
        Self {
            profile: profile.clone(),
            has_counter,
            last_sequence: 0,
            last_arrival: HostTime::from_ns(i64::MIN),
            last_ticks: None,
        }
    }

    /// Frames that the process says it had since the last one, and that did not come.
    pub(crate) const fn lost_before(&mut self, header: &ExternalFrame) -> u64 {
        let gap = header.sequence.saturating_sub(self.last_sequence).saturating_sub(1);
        if header.sequence > self.last_sequence {
            self.last_sequence = header.sequence;
        }
        gap
    }

    /// The gate's input for a frame of which `sent` bytes came and which is read at `now`.
    pub(crate) fn raw(&mut self, header: &ExternalFrame, sent: usize, now: HostTime) -> RawFrame {
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

    /// Whether a frame is of the format and size of the mode.
    fn is_announced(&self, header: &ExternalFrame) -> bool {
        let p = &self.profile;
        (header.format, header.width, header.height) == (p.format as u32, p.width, p.height)
    }
}

#[cfg(test)]
mod tests;
