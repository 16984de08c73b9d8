//! The blocks of a frame's metadata, each read by its flags and built for an emulated camera.

use depthrig_driver::bytes::{array, put, u8_at, u16_at, u32_at, u64_at};

/// Bytes of a block before its contents: id and size.
const HEADER: usize = 8;

const TIMING: u32 = 0x8000_0001;
const STATS: u32 = 0x0000_0003;
const DEPTH: u32 = 0x8000_0000;
const COLOR: u32 = 0x8000_0005;
const CONFIGURATION: u32 = 0x8000_0002;
const L515_TIMING: u32 = 0x8000_0010;
const L515_DEPTH: u32 = 0x8000_0012;

/// One block.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Block {
    /// Counter and times.
    Timing(CaptureTiming),
    /// Statistics.
    Stats(CaptureStats),
    /// Settings of the stereo module.
    Depth(DepthControl),
    /// Settings of the colour sensor.
    Color(ColorControl),
    /// Mode and trigger.
    Configuration(Configuration),
    /// Settings of an L515's depth.
    L515Depth(L515DepthControl),
    /// A block that depthrig has no use for.
    Unknown {
        /// Its id.
        id: u32,
        /// Its bytes, id and size included.
        size: u32,
    },
}

/// Walks blocks from the start of `bytes` until they end or one does not fit.
pub(super) fn walk(mut bytes: &[u8]) -> impl Iterator<Item = Block> {
    core::iter::from_fn(move || {
        let id = u32_at(bytes, 0)?;
        let size = u32_at(bytes, 4)?;
        // A size below that of its own header would never end the walk.
        let whole = bytes.get(..size as usize).filter(|b| b.len() >= HEADER)?;
        bytes = bytes.get(whole.len()..)?;
        let known = match id {
            TIMING | L515_TIMING => CaptureTiming::parse(whole).map(Block::Timing),
            STATS => CaptureStats::parse(whole).map(Block::Stats),
            DEPTH => DepthControl::parse(whole).map(Block::Depth),
            COLOR => ColorControl::parse(whole).map(Block::Color),
            CONFIGURATION => Configuration::parse(whole).map(Block::Configuration),
            L515_DEPTH => L515DepthControl::parse(whole).map(Block::L515Depth),
            _ => None,
        };
        Some(known.unwrap_or(Block::Unknown { id, size }))
    })
}

/// An empty block of `size` bytes.
fn block(id: u32, size: usize) -> Vec<u8> {
    let mut bytes = vec![0; size];
    put(&mut bytes, 0, &id.to_le_bytes());
    put(&mut bytes, 4, &(size as u32).to_le_bytes());
    bytes
}

/// Fields of 32 bits that have a flag each: reads the `i`-th from `at` on, and writes them.
struct Fields {
    at: usize,
    flags_at: usize,
}

impl Fields {
    fn get(&self, bytes: &[u8], flags: u32, bit: u32, i: usize) -> Option<u32> {
        (flags & bit != 0).then(|| u32_at(bytes, self.at + 4 * i)).flatten()
    }

    /// Puts values in order and gives the flags of those that are there.
    fn put(&self, bytes: &mut [u8], values: &[(u32, Option<u32>)]) {
        let mut flags = 0;
        for (i, (bit, value)) in values.iter().enumerate() {
            if let Some(v) = value {
                flags |= bit;
                put(bytes, self.at + 4 * i, &v.to_le_bytes());
            }
        }
        put(bytes, self.flags_at, &flags.to_le_bytes());
    }
}

/// Flags at 12, fields from 16 on.
const AT_16: Fields = Fields { at: 16, flags_at: 12 };

/// Counter and times of the capture, microseconds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct CaptureTiming {
    /// Version of the block.
    pub version: u32,
    /// Rises by one with each frame that the sensor took.
    pub frame_counter: Option<u32>,
    /// From the middle of the exposure to the frame's presentation time.
    pub sensor_timestamp_us: Option<u32>,
    /// Time to read the sensor out.
    pub readout_us: Option<u32>,
    /// Exposure.
    pub exposure_us: Option<u32>,
    /// From frame to frame.
    pub interval_us: Option<u32>,
    /// From the start of the frame until it is ready to be sent.
    pub latency_us: Option<u32>,
}

impl CaptureTiming {
    /// Bytes of the block.
    pub const BYTES: usize = 40;

    fn parse(b: &[u8]) -> Option<Self> {
        let flags = u32_at(b, 12)?;
        let field = |bit, i| AT_16.get(b, flags, bit, i);
        Some(Self {
            version: u32_at(b, 8)?,
            frame_counter: field(0x01, 0),
            sensor_timestamp_us: field(0x02, 1),
            readout_us: field(0x04, 2),
            exposure_us: field(0x08, 3),
            interval_us: field(0x10, 4),
            latency_us: field(0x20, 5),
        })
    }

    /// The block's bytes.
    pub fn build(&self) -> Vec<u8> {
        let mut b = block(TIMING, Self::BYTES);
        put(&mut b, 8, &self.version.to_le_bytes());
        let fields = [
            (0x01, self.frame_counter),
            (0x02, self.sensor_timestamp_us),
            (0x04, self.readout_us),
            (0x08, self.exposure_us),
            (0x10, self.interval_us),
            (0x20, self.latency_us),
        ];
        AT_16.put(&mut b, &fields);
        b
    }
}

/// Statistics of the capture. Only what depthrig has a use for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct CaptureStats {
    /// Which fields the camera filled in.
    pub flags: u32,
    /// The camera's clock.
    pub hw_timestamp: u32,
    /// Exposure, in the camera's units.
    pub exposure: u64,
    /// White balance, kelvin.
    pub white_balance_k: u32,
}

impl CaptureStats {
    /// Bytes of the block.
    pub const BYTES: usize = 80;

    fn parse(b: &[u8]) -> Option<Self> {
        Some(Self {
            flags: u32_at(b, 8)?,
            hw_timestamp: u32_at(b, 12)?,
            exposure: u64_at(b, 16)?,
            white_balance_k: u32_at(b, 48)?,
        })
    }

    /// The block's bytes.
    pub fn build(&self) -> Vec<u8> {
        let mut b = block(STATS, Self::BYTES);
        put(&mut b, 8, &self.flags.to_le_bytes());
        put(&mut b, 12, &self.hw_timestamp.to_le_bytes());
        put(&mut b, 16, &self.exposure.to_le_bytes());
        put(&mut b, 48, &self.white_balance_k.to_le_bytes());
        b
    }
}

/// Settings of the stereo module when the frame was taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct DepthControl {
    /// Version of the block.
    pub version: u32,
    /// Gain in the camera's units.
    pub gain: Option<u32>,
    /// Exposure, microseconds.
    pub exposure_us: Option<u32>,
    /// Power of the laser, milliwatts.
    pub laser_power_mw: Option<u32>,
    /// Whether auto-exposure was on.
    pub auto_exposure: Option<bool>,
    /// Whether the exposure may lower the rate.
    pub exposure_priority: Option<u32>,
    /// Region of auto-exposure: left, right, top, bottom.
    pub roi: Option<[u32; 4]>,
    /// Preset.
    pub preset: Option<u32>,
    /// Emitter: 0 off, 1 laser, 2 auto, 3 LED.
    pub emitter: Option<u8>,
    /// Power of the LED.
    pub led_power: Option<u16>,
}

impl DepthControl {
    /// Bytes of the block.
    pub const BYTES: usize = 60;

    fn parse(b: &[u8]) -> Option<Self> {
        let flags = u32_at(b, 12)?;
        let field = |bit, i| AT_16.get(b, flags, bit, i);
        Some(Self {
            version: u32_at(b, 8)?,
            gain: field(0x1, 0),
            exposure_us: field(0x2, 1),
            laser_power_mw: field(0x4, 2),
            auto_exposure: field(0x8, 3).map(|v| v != 0),
            exposure_priority: field(0x10, 4),
            roi: (|| Some([field(0x20, 5)?, field(0x20, 6)?, field(0x20, 7)?, field(0x20, 8)?]))(),
            preset: field(0x40, 9),
            emitter: u8_at(b, 56).filter(|_| flags & 0x80 != 0),
            led_power: u16_at(b, 58).filter(|_| flags & 0x100 != 0),
        })
    }

    /// The block's bytes.
    pub fn build(&self) -> Vec<u8> {
        let mut b = block(DEPTH, Self::BYTES);
        put(&mut b, 8, &self.version.to_le_bytes());
        let roi = |i: usize| self.roi.and_then(|r| r.get(i).copied());
        let fields = [
            (0x1, self.gain),
            (0x2, self.exposure_us),
            (0x4, self.laser_power_mw),
            (0x8, self.auto_exposure.map(u32::from)),
            (0x10, self.exposure_priority),
            (0x20, roi(0)),
            (0x20, roi(1)),
            (0x20, roi(2)),
            (0x20, roi(3)),
            (0x40, self.preset),
        ];
        AT_16.put(&mut b, &fields);
        let mut flags = u32_at(&b, 12).unwrap_or(0);
        if let Some(v) = self.emitter {
            flags |= 0x80;
            put(&mut b, 56, &[v]);
        }
        if let Some(v) = self.led_power {
            flags |= 0x100;
            put(&mut b, 58, &v.to_le_bytes());
        }
        put(&mut b, 12, &flags.to_le_bytes());
        b
    }
}

/// Settings of the colour sensor when the frame was taken. Only what depthrig has a use for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct ColorControl {
    /// Version of the block.
    pub version: u32,
    /// Whether auto-exposure was on; on the wire 1 means that it was not.
    pub auto_exposure: Option<bool>,
    /// White balance that the camera chose, kelvin.
    pub auto_white_balance_k: Option<u32>,
    /// Gain in the camera's units.
    pub gain: Option<u32>,
    /// Exposure that was set by hand, in units of 100 µs.
    pub manual_exposure_100us: Option<u32>,
    /// White balance that was set by hand, kelvin.
    pub manual_white_balance_k: Option<u32>,
    /// Frequency of the mains: 0 off, 1 50 Hz, 2 60 Hz, 3 auto.
    pub power_line: Option<u32>,
}

impl ColorControl {
    /// Bytes of the block.
    pub const BYTES: usize = 72;

    fn parse(b: &[u8]) -> Option<Self> {
        let flags = u32_at(b, 12)?;
        let field = |bit, i| AT_16.get(b, flags, bit, i);
        Some(Self {
            version: u32_at(b, 8)?,
            auto_exposure: field(0x10, 4).map(|v| v != 1),
            auto_white_balance_k: field(0x20, 5),
            gain: field(0x40, 6),
            manual_exposure_100us: field(0x400, 10),
            manual_white_balance_k: field(0x800, 11),
            power_line: field(0x1000, 12),
        })
    }

    /// The block's bytes.
    pub fn build(&self) -> Vec<u8> {
        let mut b = block(COLOR, Self::BYTES);
        put(&mut b, 8, &self.version.to_le_bytes());
        let fields = [
            (0x1, None), // brightness
            (0x2, None), // contrast
            (0x4, None), // saturation
            (0x8, None), // sharpness
            (0x10, self.auto_exposure.map(|on| if on { 8 } else { 1 })),
            (0x20, self.auto_white_balance_k),
            (0x40, self.gain),
            (0x80, None),  // backlight
            (0x100, None), // gamma
            (0x200, None), // hue
            (0x400, self.manual_exposure_100us),
            (0x800, self.manual_white_balance_k),
            (0x1000, self.power_line),
        ];
        AT_16.put(&mut b, &fields);
        b
    }
}

/// The trigger of the frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Trigger {
    /// Its own clock.
    Free,
    /// Its own clock, synchronised.
    Synchronised,
    /// A pulse from outside.
    External,
    /// A number that is not known.
    Unknown(u8),
}

/// Mode and trigger.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Configuration {
    /// Version of the block.
    pub version: u32,
    /// Kind of camera.
    pub hw_type: Option<u8>,
    /// Variant of camera.
    pub sku: Option<u8>,
    /// Number of the format.
    pub format: Option<u16>,
    /// Pixels per row.
    pub width: Option<u16>,
    /// Rows.
    pub height: Option<u16>,
    /// Frames per second.
    pub rate_hz: Option<u16>,
    /// The trigger; its low byte is the kind.
    pub trigger: Option<u16>,
    /// Which of a sequence of settings, as bits.
    pub sub_preset: Option<u32>,
}

impl Configuration {
    /// Bytes of the block.
    pub const BYTES: usize = 40;

    fn parse(b: &[u8]) -> Option<Self> {
        let flags = u32_at(b, 12)?;
        let short = |bit, at| u16_at(b, at).filter(|_| flags & bit != 0);
        Some(Self {
            version: u32_at(b, 8)?,
            hw_type: u8_at(b, 16).filter(|_| flags & 0x1 != 0),
            sku: u8_at(b, 17).filter(|_| flags & 0x2 != 0),
            format: short(0x8, 22),
            width: short(0x10, 24),
            height: short(0x20, 26),
            rate_hz: short(0x40, 28),
            trigger: short(0x80, 30),
            sub_preset: array(b, 35).map(u32::from_le_bytes).filter(|_| flags & 0x400 != 0),
        })
    }

    /// The trigger of the frame.
    pub fn trigger(&self) -> Option<Trigger> {
        Some(match self.trigger?.to_le_bytes()[0] {
            0 => Trigger::Free,
            1 => Trigger::Synchronised,
            2 => Trigger::External,
            other => Trigger::Unknown(other),
        })
    }

    /// The block's bytes.
    pub fn build(&self) -> Vec<u8> {
        let mut b = block(CONFIGURATION, Self::BYTES);
        put(&mut b, 8, &self.version.to_le_bytes());
        let mut flags = 0u32;
        let mut field = |bit: u32, at: usize, value: Option<&[u8]>| {
            if let Some(bytes) = value {
                flags |= bit;
                put(&mut b, at, bytes);
            }
        };
        field(0x1, 16, self.hw_type.map(u8::to_le_bytes).as_ref().map(<[u8; 1]>::as_slice));
        field(0x2, 17, self.sku.map(u8::to_le_bytes).as_ref().map(<[u8; 1]>::as_slice));
        for (bit, at, value) in [
            (0x8, 22, self.format),
            (0x10, 24, self.width),
            (0x20, 26, self.height),
            (0x40, 28, self.rate_hz),
            (0x80, 30, self.trigger),
        ] {
            field(bit, at, value.map(u16::to_le_bytes).as_ref().map(<[u8; 2]>::as_slice));
        }
        field(0x400, 35, self.sub_preset.map(u32::to_le_bytes).as_ref().map(<[u8; 4]>::as_slice));
        put(&mut b, 12, &flags.to_le_bytes());
        b
    }
}

/// Settings of an L515's depth when the frame was taken (librealsense v2.54 `src/metadata.h`,
/// `md_l500_depth_control`).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct L515DepthControl {
    /// Version of the block.
    pub version: u32,
    /// Power of the laser, 1 to 12.
    pub laser_power: Option<u32>,
    /// Preset.
    pub preset: Option<u32>,
    /// Whether the camera sets the power itself.
    pub laser_mode: Option<u32>,
}

impl L515DepthControl {
    /// Bytes of the block.
    pub const BYTES: usize = 28;

    fn parse(b: &[u8]) -> Option<Self> {
        let flags = u32_at(b, 12)?;
        let field = |bit, i| AT_16.get(b, flags, bit, i);
        Some(Self {
            version: u32_at(b, 8)?,
            laser_power: field(0x1, 0),
            preset: field(0x2, 1),
            laser_mode: field(0x4, 2),
        })
    }

    /// The block's bytes.
    pub fn build(&self) -> Vec<u8> {
        let mut b = block(L515_DEPTH, Self::BYTES);
        put(&mut b, 8, &self.version.to_le_bytes());
        AT_16.put(&mut b, &[(0x1, self.laser_power), (0x2, self.preset), (0x4, self.laser_mode)]);
        b
    }
}
