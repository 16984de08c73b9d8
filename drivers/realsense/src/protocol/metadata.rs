//! Metadata that a RealSense camera sends with each frame: blocks behind the standard part of the USB video payload
//! header.
//!
//! Blocks have an id and a size and are walked by these; an unknown block is skipped. Source of the
//! layouts: librealsense `src/metadata.h` (Apache-2.0) and the public description of `V4L2_META_FMT_D4XX`.

use depthrig_driver::bytes::{put, u8_at, u16_at, u32_at};

mod blocks;
mod record;

pub use blocks::{
    Block, CaptureStats, CaptureTiming, ColorControl, Configuration, DepthControl, L515DepthControl, Trigger,
};
pub use record::{Record, RecordFormat, build_record, records};

/// The standard part of a payload header (USB video class 1.5, table 2-6).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct PayloadHeader {
    /// Bytes of the whole header as it says itself, with the blocks.
    pub length: u8,
    /// Flags.
    pub flags: u8,
    /// Presentation time. On RealSense: microseconds of the camera's clock, whatever its descriptors say.
    pub pts: Option<u32>,
    /// The camera's clock and the bus frame when the header was made.
    pub scr: Option<(u32, u16)>,
}

/// Flag: the image toggles it.
pub const FID: u8 = 0x01;
/// Flag: last payload of the image.
pub const EOF: u8 = 0x02;
/// Flag: there is a presentation time.
pub const PTS: u8 = 0x04;
/// Flag: there is a clock sample.
pub const SCR: u8 = 0x08;
/// Flag: the image is damaged.
pub const ERR: u8 = 0x40;
/// Flag: the header ends here.
pub const EOH: u8 = 0x80;

impl PayloadHeader {
    /// Reads a header; gives it with what follows its standard part, cut to its length. `None` when it is cut off
    /// within its standard part or says that it is shorter than that.
    ///
    /// A header that says that it is longer than what is there is cut: the kernel's `UVCH` format keeps the length
    /// and leaves the blocks out.
    pub fn parse(bytes: &[u8]) -> Option<(Self, &[u8])> {
        let length = u8_at(bytes, 0)?;
        let flags = u8_at(bytes, 1)?;
        let mut at = 2;
        let mut header = Self { length, flags, pts: None, scr: None };
        if flags & PTS != 0 {
            header.pts = Some(u32_at(bytes, at)?);
            at += 4;
        }
        if flags & SCR != 0 {
            header.scr = Some((u32_at(bytes, at)?, u16_at(bytes, at + 4)?));
            at += 6;
        }
        let end = usize::from(length).min(bytes.len());
        bytes.get(at..end).map(|vendor| (header, vendor))
    }

    /// The bytes of a header with `vendor` behind its standard part, for an emulated camera. The flags for what is
    /// there, and the length, are put right; `None` when it is longer than 255 bytes.
    pub fn build(&self, vendor: &[u8]) -> Option<Vec<u8>> {
        let mut flags = self.flags & !(PTS | SCR);
        let mut bytes = vec![0, 0];
        if let Some(pts) = self.pts {
            flags |= PTS;
            bytes.extend(pts.to_le_bytes());
        }
        if let Some((clock, frame)) = self.scr {
            flags |= SCR;
            bytes.extend(clock.to_le_bytes());
            bytes.extend(frame.to_le_bytes());
        }
        bytes.extend(vendor);
        let length = u8::try_from(bytes.len()).ok()?;
        put(&mut bytes, 0, &[length, flags]);
        Some(bytes)
    }
}

/// Everything that a camera says of one frame; what it leaves out, or marks as not valid, is `None`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Metadata {
    /// The standard part.
    pub header: PayloadHeader,
    /// Counter and times.
    pub timing: Option<CaptureTiming>,
    /// Statistics.
    pub stats: Option<CaptureStats>,
    /// Settings of the stereo module.
    pub depth: Option<DepthControl>,
    /// Settings of the colour sensor.
    pub color: Option<ColorControl>,
    /// Mode and trigger.
    pub configuration: Option<Configuration>,
    /// Settings of an L515's depth.
    pub l515_depth: Option<L515DepthControl>,
}

impl Metadata {
    /// Reads a payload header with its blocks, as [`depthrig_usb::video::Image::header`] has it. Blocks that are damaged
    /// end the walk; what was read before stays. `None` when even the standard part is cut off.
    pub fn parse(bytes: &[u8]) -> Option<Self> {
        let (header, vendor) = PayloadHeader::parse(bytes)?;
        let mut all = Self { header, ..Self::default() };
        for block in blocks::walk(vendor) {
            match block {
                Block::Timing(b) => all.timing = Some(b),
                Block::Stats(b) => all.stats = Some(b),
                Block::Depth(b) => all.depth = Some(b),
                Block::Color(b) => all.color = Some(b),
                Block::Configuration(b) => all.configuration = Some(b),
                Block::L515Depth(b) => all.l515_depth = Some(b),
                Block::Unknown { .. } => {}
            }
        }
        Some(all)
    }

    /// The device's frame counter.
    pub fn frame_counter(&self) -> Option<u32> {
        self.timing?.frame_counter
    }

    /// The middle of the exposure on the camera's clock, in microseconds that wrap at 2^32: the presentation time
    /// minus the sensor's time stamp (librealsense `src/metadata-parser.h`).
    pub fn mid_exposure_us(&self) -> Option<u32> {
        Some(self.header.pts?.wrapping_sub(self.timing?.sensor_timestamp_us?))
    }

    /// Exposure time in microseconds, from the block of the sensor, else from that of the timing.
    pub fn exposure_us(&self) -> Option<u32> {
        // The colour sensor's own field is in units of 100 µs and holds the manual setting.
        self.depth.and_then(|d| d.exposure_us).or_else(|| self.timing?.exposure_us)
    }

    /// Gain in the camera's units.
    pub fn gain(&self) -> Option<u32> {
        self.depth.and_then(|d| d.gain).or_else(|| self.color?.gain)
    }
}

#[cfg(test)]
mod tests;
