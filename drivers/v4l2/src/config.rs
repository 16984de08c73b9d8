//! Configuration of a camera at the kernel's video nodes.

use depthrig_bus::{Intrinsics, MAX_LENT, StreamName};
use depthrig_usb::controls::ControlValue;

/// A camera and how it is to be set. What is `None` stays as the camera has it.
#[derive(Debug, Clone, PartialEq)]
pub struct V4l2Config {
    /// Serial number as USB reports it; `None`: the one at `port`, or the only one.
    pub serial: Option<String>,
    /// Port path on the bus, such as `4-1.2`, or the kernel's bus name of a camera that is not on USB, such as
    /// `platform:vivid-000`.
    pub port: Option<String>,
    /// Controls by name. Switches and menus are written before numbers, so that an automatic is off when its value
    /// comes.
    pub controls: Vec<(String, ControlValue)>,
    /// Whose memory images arrive in.
    pub memory: MemoryChoice,
    /// Handling of Motion JPEG.
    pub mjpeg: MjpegChoice,
    /// Which clock stamps the frames.
    pub clock: ClockChoice,
    /// Ticks a second of the device's clock; `None`: as its descriptor says.
    pub device_clock_hz: Option<u32>,
    /// Metres per unit of depth, for a camera that sends depth.
    pub depth_unit_m: f64,
    /// Intrinsics, each for a stream at one size.
    pub intrinsics: Vec<GivenIntrinsics>,
    /// Buffers of each stream, 2 to [`MAX_LENT`].
    pub buffers: u32,
}

impl Default for V4l2Config {
    fn default() -> Self {
        Self {
            serial: None,
            port: None,
            controls: Vec::new(),
            memory: MemoryChoice::default(),
            mjpeg: MjpegChoice::default(),
            clock: ClockChoice::default(),
            device_clock_hz: None,
            depth_unit_m: 0.001,
            intrinsics: Vec::new(),
            buffers: super::DEFAULT_BUFFERS,
        }
    }
}

/// The fewest and the most buffers that a stream may have.
pub const BUFFERS: core::ops::RangeInclusive<u32> = 2..=MAX_LENT as u32;

/// Whose memory images arrive in.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum MemoryChoice {
    /// The kernel's; an image is copied once, into shared memory.
    #[default]
    Mmap,
    /// Shared memory itself, where the kernel can; an image is not copied by us. Else as `Mmap`, with a line in the
    /// log.
    UserPointer,
}

/// Handling of Motion JPEG.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum MjpegChoice {
    /// Decoded to red, green, blue.
    #[default]
    Decode,
    /// Handed on as it came, into recordings as well.
    Keep,
}

/// Which clock stamps the frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum ClockChoice {
    /// The device's where the kernel hands it over and its rate is known, else the kernel's.
    #[default]
    Auto,
    /// The kernel's.
    Kernel,
}

/// Intrinsics of a stream at one size.
#[derive(Debug, Clone, PartialEq)]
pub struct GivenIntrinsics {
    /// Which stream.
    pub stream: StreamName,
    /// Pixels per row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// The intrinsics at that size.
    pub intrinsics: Intrinsics,
}
