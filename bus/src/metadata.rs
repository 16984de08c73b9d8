//! How much metadata a camera gives with a frame, which limits how good its times can be.

use crate::{ClockDomain, FrameFlags, FrameHeader};

/// Source of a frame's times, best first.
/// It follows from a frame's clock domain and flags ([`FrameHeader::metadata_level`]), so it is stored nowhere else.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum MetadataLevel {
    /// The device's own frame counter, exposure and mid-exposure time.
    Full,
    /// The device's time in the header of the transport (such as the presentation time of USB video): later than
    /// mid-exposure by what the device takes to expose and read out.
    Header,
    /// A stamp of the host: the kernel's when the first packet came, or the schedule of files that are played.
    Kernel,
    /// Only the arrival of the last byte. Also a frame of a better stream whose metadata was lost on the way.
    Arrival,
    /// The truth of a simulated camera.
    Simulated,
}

impl MetadataLevel {
    /// Every level, best first.
    pub const ALL: [Self; 5] = [Self::Full, Self::Header, Self::Kernel, Self::Arrival, Self::Simulated];

    /// The name used in reports, metrics and JSON.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Full => "full",
            Self::Header => "header",
            Self::Kernel => "kernel",
            Self::Arrival => "arrival",
            Self::Simulated => "simulated",
        }
    }

    /// The flags that every frame of a stream of this level carries.
    pub const fn flags(self) -> FrameFlags {
        match self {
            Self::Header => FrameFlags::HEADER_TIME,
            Self::Simulated => FrameFlags::SYNTHETIC,
            Self::Full | Self::Kernel | Self::Arrival => FrameFlags(0),
        }
    }

    /// The level of a frame with these flags whose capture time comes from `domain`.
    pub const fn of(domain: ClockDomain, flags: FrameFlags) -> Self {
        match domain {
            _ if flags.has(FrameFlags::SYNTHETIC) => Self::Simulated,
            _ if flags.has(FrameFlags::METADATA_LOST) => Self::Arrival,
            ClockDomain::Device if flags.has(FrameFlags::HEADER_TIME) => Self::Header,
            ClockDomain::Device => Self::Full,
            ClockDomain::Kernel => Self::Kernel,
            ClockDomain::Arrival => Self::Arrival,
        }
    }
}

impl FrameHeader {
    /// Source of the frame's times.
    pub const fn metadata_level(&self) -> MetadataLevel {
        let domain = match self.clock_domain {
            1 => ClockDomain::Device,
            2 => ClockDomain::Kernel,
            _ => ClockDomain::Arrival,
        };
        MetadataLevel::of(domain, FrameFlags(self.flags))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_frame_says_its_level() {
        let level = |domain: ClockDomain, flags: FrameFlags| {
            FrameHeader { clock_domain: domain as u32, flags: flags.0, ..FrameHeader::default() }
                .metadata_level()
        };
        let none = FrameFlags::default();
        assert_eq!(level(ClockDomain::Device, none), MetadataLevel::Full);
        assert_eq!(level(ClockDomain::Device, FrameFlags::HEADER_TIME), MetadataLevel::Header);
        assert_eq!(level(ClockDomain::Kernel, none), MetadataLevel::Kernel);
        assert_eq!(level(ClockDomain::Arrival, FrameFlags::LATE), MetadataLevel::Arrival);
        assert_eq!(level(ClockDomain::Device, FrameFlags::METADATA_LOST), MetadataLevel::Arrival);
        let lost = FrameFlags::METADATA_LOST.with(FrameFlags::HEADER_TIME);
        assert_eq!(level(ClockDomain::Device, lost), MetadataLevel::Arrival);
        assert_eq!(level(ClockDomain::Device, FrameFlags::SYNTHETIC), MetadataLevel::Simulated);
        let header = FrameHeader { clock_domain: 999, ..FrameHeader::default() };
        assert_eq!(header.metadata_level(), MetadataLevel::Arrival, "a domain of a later version");
    }

    #[test]
    fn the_flags_of_a_level_are_read_back_as_it() {
        let domain = |level| match level {
            MetadataLevel::Kernel => ClockDomain::Kernel,
            MetadataLevel::Arrival => ClockDomain::Arrival,
            _ => ClockDomain::Device,
        };
        for level in MetadataLevel::ALL {
            assert_eq!(MetadataLevel::of(domain(level), level.flags()), level);
        }
    }
}
