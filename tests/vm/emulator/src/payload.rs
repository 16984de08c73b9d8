//! The header of a frame's payload: the 12 bytes of the class, and the blocks that Intel puts behind them.
//!
//! Layouts: UVC 1.5, section 2.4.3.3; the blocks of librealsense `src/metadata.h` (Apache-2.0). They are written here
//! from their offsets alone, so that a driver's own reading of them is checked by a second hand.

use crate::model::{Metadata, Mode};

/// Contents of a payload header.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Header<'a> {
    pub mode: &'a Mode,
    pub metadata: Metadata,
    /// Colour has other controls in its metadata than depth.
    pub color: bool,
    /// The bit that changes with every frame.
    pub toggle: bool,
    pub damaged: bool,
    /// When the frame was complete in the device, in its microseconds.
    pub pts_us: u32,
    /// The device's clock when the header was sent.
    pub sent_us: u32,
    /// Frames since the stream was started.
    pub counter: u32,
    /// From mid-exposure to `pts_us`.
    pub sensor_us: u32,
    pub exposure_us: u32,
    pub gain: u32,
    /// `None` without a projector.
    pub laser_mw: Option<u32>,
    /// Likewise.
    pub emitter: Option<u8>,
    pub auto_exposure: u32,
}

struct Writer<'a> {
    bytes: &'a mut [u8; 255],
    at: usize,
}

impl Writer<'_> {
    fn put(&mut self, value: &[u8]) {
        if let Some(to) = self.bytes.get_mut(self.at..self.at + value.len()) {
            to.copy_from_slice(value);
            self.at += value.len();
        }
    }

    fn words(&mut self, values: &[u32]) {
        for value in values {
            self.put(&value.to_le_bytes());
        }
    }
}

impl Header<'_> {
    /// Writes the header and returns its length.
    pub(crate) fn write(&self, bytes: &mut [u8; 255]) -> usize {
        let mut w = Writer { bytes, at: 2 };
        w.words(&[self.pts_us, self.sent_us]);
        w.put(&((self.sent_us / 1000) as u16 & 0x7FF).to_le_bytes());
        match self.metadata {
            Metadata::None => {}
            Metadata::D400 => self.d400(&mut w),
            Metadata::L515 => self.l515(&mut w),
        }
        let length = w.at;
        bytes[0] = length as u8;
        // End of header, clock reference, time stamp, end of frame.
        bytes[1] = 0x8E | u8::from(self.toggle) | if self.damaged { 0x40 } else { 0 };
        length
    }

    fn timing(&self, w: &mut Writer<'_>, id: u32) {
        let interval = self.mode.interval / 10;
        let readout = self.sensor_us.saturating_sub(self.exposure_us / 2);
        w.words(&[id, 40, 1, 0x3F, self.counter, self.sensor_us, readout, self.exposure_us, interval, 2000]);
    }

    fn d400(&self, w: &mut Writer<'_>) {
        self.timing(w, 0x8000_0001);
        // Capture statistics: the hardware's time stamp and the exposure are valid (flags 0x3).
        w.words(&[3, 80, 0x3, self.pts_us, self.exposure_us, 0]);
        w.words(&[0; 14]);
        if self.color {
            w.words(&[0x8000_0005, 72, 1, 0x3FFF, 0, 50, 64, 50, 0, 4600, self.gain, 0, 300, 0]);
            w.words(&[self.exposure_us / 100, 4600, 3, 0]);
        } else {
            // Laser power, emitter and LED are valid where there is a projector.
            let flags = if self.laser_mw.is_some() { 0x1FF } else { 0x7B };
            w.words(&[
                0x8000_0000,
                60,
                1,
                flags,
                self.gain,
                self.exposure_us,
                self.laser_mw.unwrap_or(0),
                self.auto_exposure,
                0,
            ]);
            w.words(&[0, u32::from(self.mode.width) - 1, 0, u32::from(self.mode.height) - 1, 0]);
            w.put(&[self.emitter.unwrap_or(0), 0, 0, 0]);
        }
        let rate = 10_000_000 / self.mode.interval.max(1);
        w.words(&[0x8000_0002, 40, 1, 0x7FF]);
        w.put(&[0x0F, 4, 0, 0, 0, 0]);
        for value in [self.format_code(), self.mode.width, self.mode.height, rate as u16, 0, 0] {
            w.put(&value.to_le_bytes());
        }
        w.put(&[0, 0, 0, 0, 0, 0]);
    }

    fn l515(&self, w: &mut Writer<'_>) {
        self.timing(w, 0x8000_0010);
        w.words(&[
            0x8000_0012,
            28,
            1,
            0x7,
            self.laser_mw.unwrap_or(100),
            0,
            self.emitter.unwrap_or(1).into(),
        ]);
    }

    /// Which pixel format: 0 depth, 1 the left infrared image, 2 both, 3 YUYV.
    fn format_code(&self) -> u16 {
        match &self.mode.fourcc {
            b"Z16 " => 0,
            b"GREY" => 1,
            b"Y8I " => 2,
            _ => 3,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::Layout;

    fn header(mode: &Mode, color: bool, metadata: Metadata) -> ([u8; 255], usize) {
        let header = Header {
            mode,
            metadata,
            color,
            toggle: true,
            damaged: false,
            pts_us: 0x0102_0304,
            sent_us: 0x0102_0400,
            counter: 77,
            sensor_us: 9000,
            exposure_us: 8000,
            gain: 16,
            laser_mw: Some(150),
            emitter: Some(1),
            auto_exposure: 1,
        };
        let mut bytes = [0; 255];
        let length = header.write(&mut bytes);
        (bytes, length)
    }

    fn word(bytes: &[u8], at: usize) -> u32 {
        u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap())
    }

    /// The offsets of the protocol notes, by hand.
    #[test]
    fn the_blocks_of_a_depth_frame_lie_where_a_reader_looks() {
        let fourcc = *b"Z16 ";
        let mode =
            Mode { fourcc, layout: Layout::Plain, bits: 16, width: 848, height: 480, interval: 333_333 };
        let (bytes, length) = header(&mode, false, Metadata::D400);
        assert_eq!((length, bytes[0], bytes[1]), (232, 232, 0x8F));
        assert_eq!(word(&bytes, 2), 0x0102_0304);
        for (at, id, size) in
            [(12, 0x8000_0001, 40), (52, 3, 80), (132, 0x8000_0000, 60), (192, 0x8000_0002, 40)]
        {
            assert_eq!((word(&bytes, at), word(&bytes, at + 4)), (id, size), "block at {at}");
        }
        assert_eq!((word(&bytes, 12 + 16), word(&bytes, 12 + 20), word(&bytes, 12 + 28)), (77, 9000, 8000));
        assert_eq!((word(&bytes, 132 + 16), word(&bytes, 132 + 20), word(&bytes, 132 + 24)), (16, 8000, 150));
        assert_eq!(bytes[132 + 56], 1, "the emitter");
        assert_eq!(bytes[192 + 24..192 + 30], [0x50, 3, 0xE0, 1, 30, 0], "width, height, rate");
    }

    #[test]
    fn a_color_frame_has_the_controls_of_color() {
        let fourcc = *b"YUYV";
        let mode =
            Mode { fourcc, layout: Layout::Plain, bits: 16, width: 640, height: 480, interval: 333_333 };
        let (bytes, length) = header(&mode, true, Metadata::D400);
        assert_eq!(length, 244);
        assert_eq!((word(&bytes, 132), word(&bytes, 136)), (0x8000_0005, 72));
        assert_eq!((word(&bytes, 204), word(&bytes, 208)), (0x8000_0002, 40));
        assert_eq!(word(&bytes, 132 + 56), 80, "manual exposure, in units of 100 µs");
        assert_eq!(header(&mode, true, Metadata::None).1, 12);
    }
}
