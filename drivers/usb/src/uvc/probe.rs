//! The block by which host and camera agree on a stream: probed, then committed (UVC 1.5 class specification, 4.3.1.1).

use depthrig_driver::bytes::{u16_at, u32_at};
use depthrig_driver::{Error, ErrorKind, Result};

/// Bytes of the block in UVC 1.0.
pub const BYTES_1_0: usize = 26;
/// Bytes of the block in UVC 1.1.
pub const BYTES_1_1: usize = 34;
/// Bytes of the block in UVC 1.5.
pub const BYTES_1_5: usize = 48;

/// Selector of the probe control of a streaming interface.
pub const PROBE: u8 = 0x01;
/// Selector of the commit control of a streaming interface.
pub const COMMIT: u8 = 0x02;

/// Hint: the interval is to be kept, the rest may be changed.
pub const KEEP_INTERVAL: u16 = 0x0001;

/// Bytes of the block for a device of this version of USB video (0x0100, 0x0110, 0x0150).
pub const fn bytes_of_version(uvc_version: u16) -> usize {
    if uvc_version >= 0x0150 {
        BYTES_1_5
    } else if uvc_version >= 0x0110 {
        BYTES_1_1
    } else {
        BYTES_1_0
    }
}

/// The block; what a version does not have is zero.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Probe {
    /// Which fields the device shall keep: [`KEEP_INTERVAL`].
    pub hint: u16,
    /// Index of the format.
    pub format_index: u8,
    /// Index of the frame size within the format.
    pub frame_index: u8,
    /// Time between frames, 100 ns.
    pub frame_interval: u32,
    /// Key-frame rate, P-frame rate, quality, window size: of compressed formats.
    pub compression: [u16; 4],
    /// Time from capture to transmission, milliseconds.
    pub delay_ms: u16,
    /// The most bytes that a frame may have.
    pub max_frame_bytes: u32,
    /// The most bytes that the device sends in one payload, its header included.
    pub max_payload_bytes: u32,
    /// Further fields of 1.1 and 1.5: clock frequency and more, as it came.
    pub rest: Vec<u8>,
}

impl Probe {
    /// Reads a block of 26, 34 or 48 bytes.
    ///
    /// # Errors
    /// [`ErrorKind::Protocol`] when it has another length.
    pub fn parse(bytes: &[u8]) -> Result<Self> {
        if ![BYTES_1_0, BYTES_1_1, BYTES_1_5].contains(&bytes.len()) {
            return Err(wrong_length(bytes.len()));
        }
        let read = || {
            Some(Self {
                hint: u16_at(bytes, 0)?,
                format_index: *bytes.get(2)?,
                frame_index: *bytes.get(3)?,
                frame_interval: u32_at(bytes, 4)?,
                compression: [u16_at(bytes, 8)?, u16_at(bytes, 10)?, u16_at(bytes, 12)?, u16_at(bytes, 14)?],
                delay_ms: u16_at(bytes, 16)?,
                max_frame_bytes: u32_at(bytes, 18)?,
                max_payload_bytes: u32_at(bytes, 22)?,
                rest: bytes.get(BYTES_1_0..)?.to_vec(),
            })
        };
        read().ok_or_else(|| wrong_length(bytes.len()))
    }

    /// The block as bytes, as long as it was when read; 26 bytes of a new one.
    pub fn build(&self) -> Vec<u8> {
        let mut out = Vec::with_capacity(BYTES_1_5);
        out.extend_from_slice(&self.hint.to_le_bytes());
        out.extend_from_slice(&[self.format_index, self.frame_index]);
        out.extend_from_slice(&self.frame_interval.to_le_bytes());
        for field in self.compression {
            out.extend_from_slice(&field.to_le_bytes());
        }
        out.extend_from_slice(&self.delay_ms.to_le_bytes());
        out.extend_from_slice(&self.max_frame_bytes.to_le_bytes());
        out.extend_from_slice(&self.max_payload_bytes.to_le_bytes());
        out.extend_from_slice(&self.rest);
        out
    }

    /// The device's clock frequency in Hz, where the version has it.
    pub fn clock_hz(&self) -> Option<u32> {
        u32_at(&self.rest, 0)
    }

    /// Turns this block into the wish for a mode: what the device is to decide is zero.
    pub fn wish(mut self, format_index: u8, frame_index: u8, frame_interval: u32) -> Self {
        self.hint = KEEP_INTERVAL;
        self.format_index = format_index;
        self.frame_index = frame_index;
        self.frame_interval = frame_interval;
        self.max_frame_bytes = 0;
        self.max_payload_bytes = 0;
        self
    }
}

fn wrong_length(n: usize) -> Error {
    Error::new(
        ErrorKind::Protocol,
        format!("a probe block of {n} bytes; USB video has {BYTES_1_0}, {BYTES_1_1} or {BYTES_1_5}"),
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// 640x480 Z16 at 30 Hz of a D435-like camera, written out by hand.
    fn block() -> [u8; 48] {
        let mut b = [0; 48];
        b[0] = 1;
        b[2] = 1;
        b[3] = 3;
        b[4..8].copy_from_slice(&[0x15, 0x16, 0x05, 0x00]); // 333 333
        b[16] = 7;
        b[18..22].copy_from_slice(&[0x00, 0x60, 0x09, 0x00]); // 614 400
        b[22..26].copy_from_slice(&[0x00, 0x61, 0x09, 0x00]); // 614 656
        b[26..30].copy_from_slice(&[0x00, 0x6C, 0xDC, 0x02]); // 48 MHz
        b[30] = 3;
        b[47] = 0xEE;
        b
    }

    #[test]
    fn the_fields_are_where_the_specification_has_them() {
        let probe = Probe::parse(&block()).unwrap();
        assert_eq!((probe.hint, probe.format_index, probe.frame_index), (1, 1, 3));
        assert_eq!(probe.frame_interval, 333_333);
        assert_eq!(probe.delay_ms, 7);
        assert_eq!((probe.max_frame_bytes, probe.max_payload_bytes), (614_400, 614_656));
        assert_eq!(probe.clock_hz(), Some(48_000_000));
        assert_eq!(probe.build(), block());
    }

    #[test]
    fn only_three_lengths_are_blocks() {
        for n in 0..100 {
            assert_eq!(Probe::parse(&[0; 100][..n]).is_ok(), [26, 34, 48].contains(&n), "{n} bytes");
        }
        assert_eq!(Probe::parse(&block()[..26]).unwrap().clock_hz(), None);
        let lengths = [0x0100, 0x010A, 0x0110, 0x0150].map(bytes_of_version);
        assert_eq!(lengths, [26, 26, 34, 48]);
    }

    #[test]
    fn a_wish_leaves_the_sizes_to_the_device() {
        let wish = Probe::parse(&block()).unwrap().wish(2, 5, 166_666).build();
        assert_eq!(wish[..8], [1, 0, 2, 5, 0x0A, 0x8B, 2, 0]);
        assert_eq!(wish[18..26], [0; 8]);
        assert_eq!(wish[26..], block()[26..]);
    }

    proptest! {
        #[test]
        fn writing_what_was_read_changes_nothing(
            n in prop_oneof![Just(26_usize), Just(34), Just(48)],
            bytes in proptest::collection::vec(any::<u8>(), 48),
        ) {
            prop_assert_eq!(Probe::parse(&bytes[..n]).unwrap().build(), &bytes[..n]);
        }
    }
}
