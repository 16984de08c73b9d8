//! A configuration descriptor of a video camera: control units, streaming interfaces, formats, frame sizes, endpoints.
//!
//! Layouts are those of the USB Video Class 1.5 specification (sections 3.5 to 3.9) and of the USB 3.2 specification
//! (section 9.6). Interfaces other than video are kept as far as their endpoints; descriptors of unknown kinds are
//! skipped, as the specifications ask. A known descriptor that is too short for its fields is an error, because
//! everything behind it could be misread.

mod read;

use super::formats::{FourCc, Guid};
use depthrig_driver::Result;

/// A configuration of a device.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Configuration {
    /// The number by which it is chosen.
    pub value: u8,
    /// The control interfaces: one for each function that is a camera.
    pub controls: Vec<ControlInterface>,
    /// The streaming interfaces, in the order of the descriptor.
    pub streams: Vec<StreamingInterface>,
    /// All other interfaces: motion sensors, vendor channels.
    pub others: Vec<OtherInterface>,
}

/// A video control interface (subclass 1).
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct ControlInterface {
    /// `bInterfaceNumber`.
    pub number: u8,
    /// Version of USB video as a binary-coded decimal: 0x0150 is 1.5.
    pub uvc_version: u16,
    /// Frequency of the device's clock in Hz. A D400 names 48 MHz and stamps its frames in microseconds all the same.
    pub clock_hz: u32,
    /// Numbers of the streaming interfaces that belong to it.
    pub streams: Vec<u8>,
    /// Its units and terminals.
    pub units: Vec<Unit>,
}

/// A unit or a terminal of a control interface.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Unit {
    /// The number by which requests name it.
    pub id: u8,
    /// Its kind.
    pub kind: UnitKind,
    /// Which controls it has: bit 0 of byte 0 is the first.
    pub controls: Vec<u8>,
}

/// The kinds of units.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum UnitKind {
    /// The sensor and its optics: exposure, focus.
    Camera,
    /// Another input.
    Input {
        /// `wTerminalType`.
        terminal: u16,
    },
    /// Where images leave: a streaming interface links to it.
    Output {
        /// `wTerminalType`.
        terminal: u16,
    },
    /// Chooses between inputs.
    Selector,
    /// Brightness, gain, white balance.
    Processing,
    /// The vendor's own.
    Extension {
        /// Which extension.
        guid: Guid,
    },
}

/// A video streaming interface (subclass 2).
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct StreamingInterface {
    /// `bInterfaceNumber`.
    pub number: u8,
    /// Address of the endpoint that carries the images, as the input header names it.
    pub endpoint: u8,
    /// The output terminal that it shows.
    pub terminal: u8,
    /// Its formats.
    pub formats: Vec<Format>,
    /// The endpoints of each alternate setting. A camera that sends by bulk transfers has one setting.
    pub settings: Vec<Setting>,
}

/// One alternate setting of an interface.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Setting {
    /// `bAlternateSetting`.
    pub number: u8,
    /// Its endpoints.
    pub endpoints: Vec<Endpoint>,
}

/// An interface that is not of video.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct OtherInterface {
    /// `bInterfaceNumber`.
    pub number: u8,
    /// Its class; 0xFF is the vendor's own, 0x03 is HID.
    pub class: u8,
    /// Its subclass.
    pub subclass: u8,
    /// Its alternate settings.
    pub settings: Vec<Setting>,
}

/// How an endpoint transfers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum TransferKind {
    /// Requests.
    Control,
    /// At a reserved rate, and what is lost is lost.
    Isochronous,
    /// With what bandwidth is left, and complete.
    Bulk,
    /// Small and soon.
    Interrupt,
}

/// An endpoint.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Endpoint {
    /// Its address; bit 7 is set when it sends to the host.
    pub address: u8,
    /// How it transfers.
    pub kind: TransferKind,
    /// Bytes of a packet.
    pub packet_bytes: u16,
    /// Packets in a micro-frame, of high-speed isochronous endpoints: 1 to 3.
    pub packets: u8,
    /// `bInterval`.
    pub interval: u8,
    /// Further parameters of a USB 3 device.
    pub companion: Option<Companion>,
}

/// The companion of an endpoint of a USB 3 device.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Companion {
    /// Packets in a burst, less one.
    pub max_burst: u8,
    /// `bmAttributes`.
    pub attributes: u8,
    /// Bytes in a service interval, of periodic endpoints.
    pub bytes_per_interval: u16,
}

/// How the frames of a format are described.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum FormatKind {
    /// Uncompressed (subtypes 4 and 5).
    Uncompressed,
    /// Frame-based (subtypes 0x10 and 0x11): what a D400 uses for its depth, uncompressed all the same.
    FrameBased,
    /// JPEG images (subtypes 6 and 7).
    Mjpeg,
}

/// A format of a streaming interface.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Format {
    /// `bFormatIndex`, from 1.
    pub index: u8,
    /// How its frames are described.
    pub kind: FormatKind,
    /// Its identifier; of [`FormatKind::Mjpeg`] the one that Windows gives it.
    pub guid: Guid,
    /// Bits of a pixel; 0 when compressed.
    pub bits_per_pixel: u8,
    /// Its frame sizes.
    pub frames: Vec<FrameSize>,
}

/// Time between frames, in units of 100 ns.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Interval(pub u32);

impl Interval {
    /// Frames in a second; infinite for an interval of 0.
    pub fn rate_hz(self) -> f64 {
        1e7 / f64::from(self.0)
    }

    /// In nanoseconds.
    pub fn ns(self) -> u64 {
        u64::from(self.0) * 100
    }
}

/// The intervals that a frame size can have.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Intervals {
    /// These.
    Discrete(Vec<Interval>),
    /// All from `min` to `max` in steps of `step`.
    Continuous {
        /// The shortest.
        min: Interval,
        /// The longest.
        max: Interval,
        /// Between two of them.
        step: Interval,
    },
}

/// A frame size of a format.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FrameSize {
    /// `bFrameIndex`, from 1.
    pub index: u8,
    /// Pixels in a row.
    pub width: u16,
    /// Rows.
    pub height: u16,
    /// Bits per second at the longest interval.
    pub min_bit_rate: u32,
    /// Bits per second at the shortest interval.
    pub max_bit_rate: u32,
    /// The most bytes of a frame, where the descriptor names them; a frame-based one does not.
    pub max_bytes: Option<u32>,
    /// Bytes of a row, where a frame-based descriptor names them; 0 when they vary.
    pub bytes_per_line: u32,
    /// The interval it has of itself.
    pub default_interval: Interval,
    /// The intervals it can have.
    pub intervals: Intervals,
}

impl FrameSize {
    /// Bytes of one uncompressed frame of this size in `format`; `None` when it is compressed.
    pub fn bytes(&self, format: &Format) -> Option<u64> {
        let bits = match format.bits_per_pixel {
            0 => format.format().bits_per_pixel()?,
            bits => bits.into(),
        };
        (format.kind != FormatKind::Mjpeg)
            .then(|| u64::from(self.width) * u64::from(self.height) * u64::from(bits) / 8)
    }

    /// The interval nearest to `rate_hz` that it can have; `None` when it has none within 1 % of it.
    pub fn interval_for(&self, rate_hz: f64) -> Option<Interval> {
        let near = |i: &Interval| (i.rate_hz() / rate_hz - 1.0).abs() < 0.01;
        let distance = |i: &Interval| (i.rate_hz() - rate_hz).abs();
        match &self.intervals {
            Intervals::Discrete(list) => {
                list.iter().filter(|i| near(i)).min_by(|a, b| distance(a).total_cmp(&distance(b))).copied()
            }
            Intervals::Continuous { min, max, step } => {
                let wanted = 1e7 / rate_hz;
                let steps = ((wanted - f64::from(min.0)) / f64::from(step.0.max(1))).round().max(0.0);
                let interval = f64::from(min.0) + steps * f64::from(step.0);
                // A float beyond 32 bits becomes the greatest number, which `max` then cuts.
                Some(Interval((interval as u32).clamp(min.0, max.0.max(min.0)))).filter(near)
            }
        }
    }
}

impl Format {
    /// The format by the kernel's name.
    pub const fn format(&self) -> FourCc {
        match self.kind {
            FormatKind::Mjpeg => FourCc::MJPG,
            FormatKind::Uncompressed | FormatKind::FrameBased => self.guid.format(),
        }
    }
}

impl StreamingInterface {
    /// The endpoint that carries the images, with the number of the setting it is in: the first in which it is.
    pub fn image_endpoint(&self) -> Option<(u8, Endpoint)> {
        self.settings
            .iter()
            .find_map(|s| Some((s.number, *s.endpoints.iter().find(|e| e.address == self.endpoint)?)))
    }

    /// The format and the frame size of `code`, `width` and `height`.
    pub fn find(&self, code: FourCc, width: u32, height: u32) -> Option<(&Format, &FrameSize)> {
        self.formats.iter().filter(|f| f.format() == code).find_map(|format| {
            let is_it = |s: &&FrameSize| u32::from(s.width) == width && u32::from(s.height) == height;
            Some((format, format.frames.iter().find(is_it)?))
        })
    }
}

impl Configuration {
    /// Reads a configuration descriptor with all that follows it.
    ///
    /// # Errors
    /// [`depthrig_driver::ErrorKind::Protocol`] with the place, when it is cut off or a descriptor in it is too short.
    pub fn parse(bytes: &[u8]) -> Result<Self> {
        read::configuration(bytes)
    }

    /// The streaming interface of this number.
    pub fn stream(&self, number: u8) -> Option<&StreamingInterface> {
        self.streams.iter().find(|s| s.number == number)
    }

    /// The control interface that the streaming interface of this number belongs to.
    pub fn control_of(&self, stream: u8) -> Option<&ControlInterface> {
        self.controls.iter().find(|c| c.streams.contains(&stream))
    }

    /// The control interface that has the extension `guid`, and the number of the unit.
    pub fn extension(&self, guid: Guid) -> Option<(&ControlInterface, u8)> {
        self.controls.iter().find_map(|c| {
            let unit = c.units.iter().find(|u| u.kind == UnitKind::Extension { guid })?;
            Some((c, unit.id))
        })
    }

    /// The vendor's own interface with one bulk endpoint each way: its number, the one out and the one in.
    pub fn vendor_channel(&self) -> Option<(u8, Endpoint, Endpoint)> {
        self.others.iter().rev().filter(|i| i.class == 0xFF).find_map(|i| {
            let points = &i.settings.first()?.endpoints;
            let bulk = |inward: bool| {
                points
                    .iter()
                    .find(|e| e.kind == TransferKind::Bulk && (e.address & 0x80 != 0) == inward)
                    .copied()
            };
            Some((i.number, bulk(false)?, bulk(true)?))
        })
    }
}

#[cfg(test)]
mod tests;
