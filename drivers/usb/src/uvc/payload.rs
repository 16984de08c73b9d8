//! The header in front of every payload of USB video (UVC 1.5 class specification, section 2.4.3.3).

use core::fmt;
use depthrig_driver::bytes::{u16_at, u32_at};

/// Bytes of a header that has both time stamps and no vendor blocks.
pub const FULL_HEADER_BYTES: usize = 12;
/// The most bytes that a header may have: its length is one byte.
pub const MAX_HEADER_BYTES: usize = 255;

/// The flags of a payload header.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub struct Flags(pub u8);

impl Flags {
    /// Changes from each frame to the next.
    pub const FRAME_ID: u8 = 0x01;
    /// The frame's last payload.
    pub const END_OF_FRAME: u8 = 0x02;
    /// The header has a presentation time.
    pub const PTS: u8 = 0x04;
    /// The header has a source clock reference.
    pub const SCR: u8 = 0x08;
    /// A still image.
    pub const STILL: u8 = 0x20;
    /// The device had an error with this frame.
    pub const ERROR: u8 = 0x40;
    /// The header ends here; always set.
    pub const END_OF_HEADER: u8 = 0x80;

    /// Whether every bit of `mask` is set.
    pub const fn has(self, mask: u8) -> bool {
        self.0 & mask == mask
    }

    /// The bit that changes from each frame to the next.
    pub const fn frame_id(self) -> bool {
        self.has(Self::FRAME_ID)
    }
}

/// A sample of the device's clock together with the bus's.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct SourceClock {
    /// The device's clock, in ticks of `dwClockFrequency` (a D400 counts microseconds all the same).
    pub ticks: u32,
    /// The number of the USB frame at that moment, 11 bits: milliseconds, modulo 2048.
    pub usb_frame: u16,
}

/// A payload header, read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PayloadHeader<'a> {
    /// All of it.
    pub bytes: &'a [u8],
    /// Its flags.
    pub flags: Flags,
    /// The presentation time of the frame, in ticks of `dwClockFrequency` (a D400 counts microseconds all the same).
    pub pts: Option<u32>,
    /// The device's clock when the payload was sent.
    pub source_clock: Option<SourceClock>,
    /// The vendor's bytes behind the fields of the standard.
    pub vendor: &'a [u8],
}

/// Why a payload has no header.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum PayloadFault {
    /// No bytes at all.
    Empty,
    /// The header gives its length as less than the two bytes that every header has, or than what its flags promise.
    TooShort,
    /// The header gives its length as more than what came.
    CutOff,
}

impl fmt::Display for PayloadFault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Empty => "an empty payload",
            Self::TooShort => "a payload header that is shorter than its flags say",
            Self::CutOff => "a payload that ends within its header",
        })
    }
}

impl core::error::Error for PayloadFault {}

impl<'a> PayloadHeader<'a> {
    /// Reads the header at the start of `payload`; the frame's bytes begin behind [`Self::bytes`].
    ///
    /// # Errors
    /// [`PayloadFault`]
    pub fn parse(payload: &'a [u8]) -> Result<Self, PayloadFault> {
        let length = usize::from(*payload.first().ok_or(PayloadFault::Empty)?);
        if length < 2 {
            return Err(PayloadFault::TooShort);
        }
        let bytes = payload.get(..length).ok_or(PayloadFault::CutOff)?;
        let flags = Flags(*bytes.get(1).ok_or(PayloadFault::TooShort)?);
        let mut at = 2;
        let mut pts = None;
        if flags.has(Flags::PTS) {
            pts = Some(u32_at(bytes, at).ok_or(PayloadFault::TooShort)?);
            at += 4;
        }
        let mut source_clock = None;
        if flags.has(Flags::SCR) {
            let ticks = u32_at(bytes, at).ok_or(PayloadFault::TooShort)?;
            let usb_frame = u16_at(bytes, at + 4).ok_or(PayloadFault::TooShort)? & 0x07FF;
            source_clock = Some(SourceClock { ticks, usb_frame });
            at += 6;
        }
        let vendor = bytes.get(at..).unwrap_or_default();
        Ok(Self { bytes, flags, pts, source_clock, vendor })
    }

    /// Writes a header with these parts, `flags` completed by what the parts imply; `None` when the vendor's bytes
    /// do not fit into a header.
    pub fn build(
        flags: u8,
        pts: Option<u32>,
        source_clock: Option<SourceClock>,
        vendor: &[u8],
    ) -> Option<Vec<u8>> {
        let mut flags = flags | Flags::END_OF_HEADER;
        let mut out = vec![0, 0];
        flags &= !(Flags::PTS | Flags::SCR);
        if let Some(pts) = pts {
            flags |= Flags::PTS;
            out.extend_from_slice(&pts.to_le_bytes());
        }
        if let Some(clock) = source_clock {
            flags |= Flags::SCR;
            out.extend_from_slice(&clock.ticks.to_le_bytes());
            out.extend_from_slice(&clock.usb_frame.to_le_bytes());
        }
        out.extend_from_slice(vendor);
        *out.first_mut()? = u8::try_from(out.len()).ok()?;
        *out.get_mut(1)? = flags;
        Some(out)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// A header as a D400 sends it with its capture-timing block, cut to 16 bytes, written out by hand.
    const D400: [u8; 16] =
        [16, 0x8F, 0x78, 0x56, 0x34, 0x12, 0x01, 0x02, 0x03, 0x04, 0xFF, 0xFF, 0x01, 0x00, 0x00, 0x80];

    #[test]
    fn a_full_header_is_read() {
        let mut payload = D400.to_vec();
        payload.extend_from_slice(&[9; 20]);
        let header = PayloadHeader::parse(&payload).unwrap();
        assert_eq!(header.bytes, D400);
        assert_eq!(header.flags, Flags(0x8F));
        assert!(header.flags.frame_id() && header.flags.has(Flags::END_OF_FRAME));
        assert!(!header.flags.has(Flags::ERROR));
        assert_eq!(header.pts, Some(0x1234_5678));
        assert_eq!(header.source_clock, Some(SourceClock { ticks: 0x0403_0201, usb_frame: 0x07FF }));
        assert_eq!(header.vendor, [1, 0, 0, 0x80]);
    }

    #[test]
    fn each_time_stamp_may_be_missing() {
        let none = PayloadHeader::parse(&[2, 0x80, 7]).unwrap();
        assert_eq!((none.pts, none.source_clock, none.vendor), (None, None, &[][..]));
        let scr_alone = PayloadHeader::parse(&[8, 0x88, 1, 0, 0, 0, 2, 0, 7]).unwrap();
        assert_eq!(scr_alone.source_clock, Some(SourceClock { ticks: 1, usb_frame: 2 }));
        assert_eq!(scr_alone.pts, None);
    }

    #[test]
    fn what_is_too_short_is_refused_at_every_length() {
        assert_eq!(PayloadHeader::parse(&[]), Err(PayloadFault::Empty));
        for n in 1..D400.len() {
            assert_eq!(PayloadHeader::parse(&D400[..n]), Err(PayloadFault::CutOff), "{n} bytes");
        }
        for length in 0..12 {
            let mut payload = D400;
            payload[0] = length;
            assert_eq!(PayloadHeader::parse(&payload), Err(PayloadFault::TooShort), "length {length}");
        }
    }

    proptest! {
        #[test]
        fn any_bytes_are_read_or_refused(bytes in proptest::collection::vec(any::<u8>(), 0..300)) {
            if let Ok(header) = PayloadHeader::parse(&bytes) {
                prop_assert_eq!(header.bytes.len(), usize::from(bytes[0]));
                let fields = 2 + 4 * usize::from(header.pts.is_some()) + 6 * usize::from(header.source_clock.is_some());
                prop_assert_eq!(header.bytes.len(), fields + header.vendor.len());
            }
        }

        #[test]
        fn what_is_built_is_read(
            flags in any::<u8>(),
            pts in any::<Option<u32>>(),
            clock in any::<Option<(u32, u16)>>(),
            vendor in proptest::collection::vec(any::<u8>(), 0..243),
        ) {
            let clock = clock.map(|(ticks, frame)| SourceClock { ticks, usb_frame: frame & 0x7FF });
            let bytes = PayloadHeader::build(flags, pts, clock, &vendor).unwrap();
            let header = PayloadHeader::parse(&bytes).unwrap();
            prop_assert_eq!(header.pts, pts);
            prop_assert_eq!(header.source_clock, clock);
            prop_assert_eq!(header.vendor, &vendor[..]);
            let times = Flags::PTS | Flags::SCR;
            prop_assert_eq!(header.flags.0 & !times, (flags | Flags::END_OF_HEADER) & !times);
        }
    }

    #[test]
    fn vendor_blocks_that_do_not_fit_are_refused() {
        assert_eq!(PayloadHeader::build(0, None, None, &[0; 254]), None);
        assert_eq!(PayloadHeader::build(0, None, None, &[0; 253]).unwrap().len(), MAX_HEADER_BYTES);
    }
}
