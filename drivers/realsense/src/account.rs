//! From what an image brings along to the frame number and the device time that the gate needs.
//!
//! With the whole header both are the device's own: its frame counter, and the time of mid-exposure, which is the
//! presentation time minus the "sensor timestamp" (wrapping 32-bit microseconds). With the standard header the number
//! is the transport's and the time is the presentation time. Without a header the time is the kernel's stamp, or the
//! arrival.
//!
//! A single image whose metadata did not come is reckoned from the last one that had it, and flagged. Images that
//! come before any metadata has no place in time yet: they are kept in mind, and booked as incomplete as soon as the
//! first number is known. So no frame is lost without an account of it.

use super::protocol::metadata::{Metadata, Trigger};
use depthrig_bus::{FrameFlags, HostTime, MetadataLevel};
use depthrig_usb::video::Image;

/// The metadata of one image.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Facts {
    /// Presentation time stamp, microseconds.
    pub(super) presentation_us: Option<u32>,
    /// The device's frame counter.
    pub(super) counter: Option<u32>,
    /// From mid-exposure to the presentation time, microseconds.
    pub(super) from_exposure_us: Option<u32>,
    /// Exposure time, microseconds.
    pub(super) exposure_us: Option<u32>,
    /// Sensor gain, in the camera's units.
    pub(super) gain: Option<u32>,
    /// The exposure was triggered from outside.
    pub(super) is_triggered: bool,
}

impl Facts {
    /// Reads a payload header, with the vendor's blocks if it has them.
    pub(super) fn of(header: &[u8]) -> Self {
        let Some(all) = Metadata::parse(header) else { return Self::default() };
        Self {
            presentation_us: all.header.pts,
            counter: all.frame_counter(),
            from_exposure_us: all.timing.and_then(|t| t.sensor_timestamp_us),
            exposure_us: all.exposure_us(),
            gain: all.gain(),
            is_triggered: all.configuration.and_then(|c| c.trigger()) == Some(Trigger::External),
        }
    }
}

/// Number and time of an image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Stamp {
    pub(super) sequence: u64,
    pub(super) ticks: u64,
    pub(super) flags: FrameFlags,
}

/// Images without any metadata before any had some, after which the camera is taken for one that sends none.
const MAX_ORPHANS: usize = 30;

/// The account of one source.
#[derive(Debug)]
pub(super) struct Account {
    level: MetadataLevel,
    last: Option<Last>,
    orphans: Vec<u64>,
}

/// The last image that had its metadata.
#[derive(Debug, Clone, Copy)]
struct Last {
    transport: u64,
    counter: u32,
    ticks: u32,
    at: HostTime,
}

/// Result of [`Account::stamp`] for an image.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Stamped {
    /// Its number and time.
    Yes(Stamp),
    /// Its time is not known yet; it is remembered.
    NotYet,
    /// It has no time, and will not get one.
    Never,
}

impl Account {
    /// The account of a source whose images bring along `level`.
    pub(super) const fn new(level: MetadataLevel) -> Self {
        Self { level, last: None, orphans: Vec::new() }
    }

    /// Width of the numbers that [`Self::stamp`] gives, bits.
    pub(super) const fn sequence_bits(level: MetadataLevel) -> u32 {
        if matches!(level, MetadataLevel::Full) { 32 } else { 64 }
    }

    /// Number and time of `image`.
    pub(super) fn stamp(&mut self, image: &Image<'_>, facts: &Facts) -> Stamped {
        let at = image.kernel_time.unwrap_or(image.arrival);
        let by_transport = |ticks: u64| Stamp { sequence: image.sequence, ticks, flags: FrameFlags(0) };
        match self.level {
            MetadataLevel::Full | MetadataLevel::Header => {}
            // The counter is host time in nanoseconds and used as it is.
            _ => return Stamped::Yes(by_transport(at.ns().max(0) as u64)),
        }
        let is_full = self.level == MetadataLevel::Full;
        let counter = if is_full { facts.counter } else { Some(0) };
        if let (Some(presentation), Some(counter)) = (facts.presentation_us, counter) {
            let (ticks, flags) = match facts.from_exposure_us.filter(|_| is_full) {
                Some(ago) => (presentation.wrapping_sub(ago), FrameFlags(0)),
                None => (presentation, FrameFlags::HEADER_TIME),
            };
            self.last = Some(Last { transport: image.sequence, counter, ticks, at });
            let sequence = if is_full { counter.into() } else { image.sequence };
            return Stamped::Yes(Stamp { sequence, ticks: ticks.into(), flags });
        }
        let Some(last) = self.last else {
            self.orphans.push(image.sequence);
            return if self.orphans.len() < MAX_ORPHANS { Stamped::NotYet } else { Stamped::Never };
        };
        let microseconds = at.since_ns(last.at) / 1000;
        let ticks = last.ticks.wrapping_add(microseconds as u32);
        let step = image.sequence.wrapping_sub(last.transport) as u32;
        let sequence = if is_full { last.counter.wrapping_add(step).into() } else { image.sequence };
        let flags = FrameFlags::METADATA_LOST.with(FrameFlags::TIME_UNCERTAIN);
        Stamped::Yes(Stamp { sequence, ticks: ticks.into(), flags })
    }

    /// The numbers of the images that came before the one just stamped and had no place in time, oldest first.
    pub(super) fn take_orphans(&mut self) -> Vec<u64> {
        let Some(last) = self.last else { return Vec::new() };
        let is_full = self.level == MetadataLevel::Full;
        let number = |transport: u64| {
            if is_full {
                u64::from(last.counter.wrapping_sub(last.transport.wrapping_sub(transport) as u32))
            } else {
                transport
            }
        };
        core::mem::take(&mut self.orphans).into_iter().map(number).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn image(sequence: u64, arrival_ms: i64) -> Image<'static> {
        let arrival = HostTime::from_ns(1_000_000_000 + arrival_ms * 1_000_000);
        Image {
            source: 0,
            bytes: &[],
            damaged: false,
            sequence,
            kernel_time: Some(arrival.plus_ns(-1_000_000)),
            arrival,
            header: None,
        }
    }

    fn facts(presentation: u32, counter: u32) -> Facts {
        Facts {
            presentation_us: Some(presentation),
            counter: Some(counter),
            from_exposure_us: Some(9_000),
            ..Facts::default()
        }
    }

    fn yes(stamped: Stamped) -> (u64, u64, FrameFlags) {
        match stamped {
            Stamped::Yes(s) => (s.sequence, s.ticks, s.flags),
            other => panic!("{other:?}"),
        }
    }

    const PLAIN: FrameFlags = FrameFlags(0);

    #[test]
    fn mid_exposure_is_the_presentation_time_minus_the_sensor_timestamp_also_across_the_wrap() {
        let mut account = Account::new(MetadataLevel::Full);
        assert_eq!(yes(account.stamp(&image(5, 0), &facts(1_000_000, 77))), (77, 991_000, PLAIN));
        assert_eq!(
            yes(account.stamp(&image(6, 33), &facts(4_000, 78))),
            (78, u64::from(u32::MAX) - 4_999, PLAIN)
        );
    }

    #[test]
    fn with_the_standard_header_the_number_is_the_transports() {
        let mut account = Account::new(MetadataLevel::Header);
        let header = Facts { presentation_us: Some(500), ..Facts::default() };
        assert_eq!(yes(account.stamp(&image(9, 0), &header)), (9, 500, FrameFlags::HEADER_TIME));
    }

    #[test]
    fn without_a_header_the_kernels_stamp_is_the_time_else_the_arrival() {
        let mut account = Account::new(MetadataLevel::Kernel);
        assert_eq!(yes(account.stamp(&image(3, 10), &Facts::default())), (3, 1_009_000_000, PLAIN));
        let mut account = Account::new(MetadataLevel::Arrival);
        let bare = Image { kernel_time: None, ..image(3, 10) };
        assert_eq!(yes(account.stamp(&bare, &Facts::default())), (3, 1_010_000_000, PLAIN));
    }

    #[test]
    fn an_image_whose_metadata_is_lost_is_reckoned_and_flagged() {
        let mut account = Account::new(MetadataLevel::Full);
        account.stamp(&image(5, 0), &facts(u32::MAX, u32::MAX));
        // Two images later, one of which never came.
        let (sequence, ticks, flags) = yes(account.stamp(&image(7, 66), &Facts::default()));
        assert_eq!((sequence, ticks), (1, 66_000 - 9_000 - 1));
        assert!(flags.has(FrameFlags::METADATA_LOST) && flags.has(FrameFlags::TIME_UNCERTAIN));
        assert_eq!(
            MetadataLevel::of(depthrig_bus::ClockDomain::Device, flags),
            MetadataLevel::Arrival,
            "the frame says so itself"
        );
    }

    #[test]
    fn images_before_the_first_metadata_are_numbered_backwards_from_it() {
        let mut account = Account::new(MetadataLevel::Full);
        assert_eq!(account.stamp(&image(0, 0), &Facts::default()), Stamped::NotYet);
        assert_eq!(account.stamp(&image(1, 33), &Facts::default()), Stamped::NotYet);
        assert!(account.take_orphans().is_empty(), "nothing is known yet");
        assert_eq!(yes(account.stamp(&image(3, 99), &facts(50, 1))).0, 1);
        assert_eq!(account.take_orphans(), [u64::from(u32::MAX) - 1, u64::from(u32::MAX)]);
        assert!(account.take_orphans().is_empty(), "each is booked once");
    }

    #[test]
    fn a_camera_that_never_sends_metadata_is_found_out() {
        let mut account = Account::new(MetadataLevel::Header);
        for i in 1..MAX_ORPHANS as u64 {
            assert_eq!(account.stamp(&image(i, 0), &Facts::default()), Stamped::NotYet);
        }
        assert_eq!(account.stamp(&image(99, 0), &Facts::default()), Stamped::Never);
    }
}
