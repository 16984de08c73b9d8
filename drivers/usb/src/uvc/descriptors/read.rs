//! Reads the bytes of a configuration descriptor.

use super::{
    Companion, Configuration, ControlInterface, Endpoint, Format, FormatKind, FrameSize, Interval, Intervals,
    OtherInterface, Setting, StreamingInterface, TransferKind, Unit, UnitKind,
};
use crate::uvc::formats::{FourCc, Guid};
use depthrig_driver::bytes::{u16_at, u32_at};
use depthrig_driver::{Error, ErrorKind, Result};

/// Descriptor types (USB 3.2, table 9-6; UVC 1.5, table A-4).
mod kind {
    pub const CONFIGURATION: u8 = 0x02;
    pub const INTERFACE: u8 = 0x04;
    pub const ENDPOINT: u8 = 0x05;
    pub const CLASS_INTERFACE: u8 = 0x24;
    pub const COMPANION: u8 = 0x30;
}

const CLASS_VIDEO: u8 = 0x0E;
const VIDEO_CONTROL: u8 = 1;
const VIDEO_STREAMING: u8 = 2;
/// `wTerminalType` of a camera (UVC 1.5, table B-2).
const CAMERA: u16 = 0x0201;

/// Where the next descriptors belong.
#[derive(Clone, Copy)]
enum Place {
    /// Before the first interface.
    Nowhere,
    Control,
    Stream,
    Other,
}

pub(super) fn configuration(bytes: &[u8]) -> Result<Configuration> {
    let head = Descriptor::at(bytes, 0)?;
    if head.kind() != kind::CONFIGURATION {
        return Err(head.error("no configuration descriptor"));
    }
    let total = usize::from(head.u16(2)?);
    let Some(all) = bytes.get(..total) else {
        return Err(
            head.error(&format!("its length of {total} bytes is more than the {} there are", bytes.len()))
        );
    };
    let mut reader = Reader {
        configuration: Configuration { value: head.u8(5)?, ..Configuration::default() },
        place: Place::Nowhere,
    };
    let mut at = head.bytes.len();
    while at < all.len() {
        let descriptor = Descriptor::at(all, at)?;
        reader.take(&descriptor)?;
        at += descriptor.bytes.len();
    }
    Ok(reader.configuration)
}

/// One descriptor and where it is, for messages.
struct Descriptor<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl<'a> Descriptor<'a> {
    fn at(all: &'a [u8], at: usize) -> Result<Self> {
        let rest = all.get(at..).unwrap_or_default();
        let length = rest.first().copied().unwrap_or(0).into();
        let bytes = if length < 2 { None } else { rest.get(..length) };
        match bytes {
            Some(bytes) => Ok(Self { bytes, at }),
            None => Err(Error::new(
                ErrorKind::Protocol,
                format!("the descriptor at byte {at} has length {length}, and {} bytes are left", rest.len()),
            )),
        }
    }

    fn kind(&self) -> u8 {
        self.bytes.get(1).copied().unwrap_or(0)
    }

    fn u8(&self, at: usize) -> Result<u8> {
        self.bytes.get(at).copied().ok_or_else(|| self.too_short())
    }

    fn u16(&self, at: usize) -> Result<u16> {
        u16_at(self.bytes, at).ok_or_else(|| self.too_short())
    }

    fn u32(&self, at: usize) -> Result<u32> {
        u32_at(self.bytes, at).ok_or_else(|| self.too_short())
    }

    fn guid(&self, at: usize) -> Result<Guid> {
        let bytes = self.slice(at, 16)?;
        Ok(Guid(bytes.try_into().map_err(|_| self.too_short())?))
    }

    fn slice(&self, at: usize, n: usize) -> Result<&'a [u8]> {
        at.checked_add(n).and_then(|end| self.bytes.get(at..end)).ok_or_else(|| self.too_short())
    }

    /// The bytes that the length byte at `at` announces.
    fn counted(&self, at: usize) -> Result<&'a [u8]> {
        self.slice(at + 1, self.u8(at)?.into())
    }

    fn too_short(&self) -> Error {
        self.error(&format!("its {} bytes are too few for its fields", self.bytes.len()))
    }

    fn error(&self, what: &str) -> Error {
        let Self { bytes, at } = self;
        let subtype = match (self.kind(), bytes.get(2)) {
            (kind::CLASS_INTERFACE, Some(subtype)) => format!(", subtype {subtype:#04x}"),
            _ => String::new(),
        };
        Error::new(
            ErrorKind::Protocol,
            format!("descriptor of type {:#04x}{subtype} at byte {at}: {what}", self.kind()),
        )
    }
}

struct Reader {
    configuration: Configuration,
    place: Place,
}

impl Reader {
    fn take(&mut self, d: &Descriptor<'_>) -> Result<()> {
        match (d.kind(), self.place) {
            (kind::INTERFACE, _) => self.interface(d),
            (kind::ENDPOINT, _) => self.endpoint(d),
            (kind::COMPANION, _) => self.companion(d),
            (kind::CLASS_INTERFACE, Place::Control) => match self.configuration.controls.last_mut() {
                Some(control) => of_control(control, d),
                None => Ok(()),
            },
            (kind::CLASS_INTERFACE, Place::Stream) => match self.configuration.streams.last_mut() {
                Some(stream) => of_stream(stream, d),
                None => Ok(()),
            },
            _ => Ok(()),
        }
    }

    fn interface(&mut self, d: &Descriptor<'_>) -> Result<()> {
        let number = d.u8(2)?;
        let setting = Setting { number: d.u8(3)?, endpoints: Vec::new() };
        let class = d.u8(5)?;
        let subclass = d.u8(6)?;
        let c = &mut self.configuration;
        self.place = match (class, subclass) {
            (CLASS_VIDEO, VIDEO_CONTROL) => {
                c.controls.push(ControlInterface { number, ..ControlInterface::default() });
                Place::Control
            }
            (CLASS_VIDEO, VIDEO_STREAMING) => {
                // Every setting repeats the interface; the formats are behind the first. The last one read must be
                // the one that is at the end of the list, so that what follows finds it there.
                match c.streams.last_mut().filter(|s| s.number == number) {
                    Some(stream) => stream.settings.push(setting),
                    None => c.streams.push(StreamingInterface {
                        number,
                        settings: vec![setting],
                        ..StreamingInterface::default()
                    }),
                }
                Place::Stream
            }
            _ => {
                match c.others.last_mut().filter(|i| i.number == number) {
                    Some(other) => other.settings.push(setting),
                    None => {
                        c.others.push(OtherInterface { number, class, subclass, settings: vec![setting] });
                    }
                }
                Place::Other
            }
        };
        Ok(())
    }

    /// The setting that endpoints belong to; those of a control interface are not needed here.
    fn setting(&mut self) -> Option<&mut Setting> {
        match self.place {
            Place::Stream => self.configuration.streams.last_mut()?.settings.last_mut(),
            Place::Other => self.configuration.others.last_mut()?.settings.last_mut(),
            Place::Nowhere | Place::Control => None,
        }
    }

    fn endpoint(&mut self, d: &Descriptor<'_>) -> Result<()> {
        let size = d.u16(4)?;
        let endpoint = Endpoint {
            address: d.u8(2)?,
            kind: match d.u8(3)? & 3 {
                0 => TransferKind::Control,
                1 => TransferKind::Isochronous,
                2 => TransferKind::Bulk,
                _ => TransferKind::Interrupt,
            },
            packet_bytes: size & 0x07FF,
            packets: ((size >> 11) & 3) as u8 + 1,
            interval: d.u8(6)?,
            companion: None,
        };
        if let Some(setting) = self.setting() {
            setting.endpoints.push(endpoint);
        }
        Ok(())
    }

    fn companion(&mut self, d: &Descriptor<'_>) -> Result<()> {
        let companion =
            Companion { max_burst: d.u8(2)?, attributes: d.u8(3)?, bytes_per_interval: d.u16(4)? };
        if let Some(endpoint) = self.setting().and_then(|s| s.endpoints.last_mut()) {
            endpoint.companion = Some(companion);
        }
        Ok(())
    }
}

/// A class-specific descriptor of a control interface (UVC 1.5, section 3.7.2).
fn of_control(control: &mut ControlInterface, d: &Descriptor<'_>) -> Result<()> {
    let unit = match d.u8(2)? {
        1 => {
            control.uvc_version = d.u16(3)?;
            control.clock_hz = d.u32(7)?;
            control.streams = d.counted(11)?.to_vec();
            return Ok(());
        }
        2 => match d.u16(4)? {
            CAMERA => Unit { id: d.u8(3)?, kind: UnitKind::Camera, controls: d.counted(14)?.to_vec() },
            terminal => Unit { id: d.u8(3)?, kind: UnitKind::Input { terminal }, controls: Vec::new() },
        },
        3 => {
            let terminal = d.u16(4)?;
            Unit { id: d.u8(3)?, kind: UnitKind::Output { terminal }, controls: Vec::new() }
        }
        4 => Unit { id: d.u8(3)?, kind: UnitKind::Selector, controls: Vec::new() },
        5 => Unit { id: d.u8(3)?, kind: UnitKind::Processing, controls: d.counted(7)?.to_vec() },
        6 => {
            let inputs = d.counted(21)?.len();
            let kind = UnitKind::Extension { guid: d.guid(4)? };
            Unit { id: d.u8(3)?, kind, controls: d.counted(22 + inputs)?.to_vec() }
        }
        _ => return Ok(()),
    };
    control.units.push(unit);
    Ok(())
}

/// A class-specific descriptor of a streaming interface (UVC 1.5, section 3.9.2).
fn of_stream(stream: &mut StreamingInterface, d: &Descriptor<'_>) -> Result<()> {
    let subtype = d.u8(2)?;
    match subtype {
        1 => {
            stream.endpoint = d.u8(6)?;
            stream.terminal = d.u8(8)?;
        }
        4 | 6 | 0x10 => stream.formats.push(format(subtype, d)?),
        5 | 7 | 0x11 => {
            let wanted = match subtype {
                5 => FormatKind::Uncompressed,
                7 => FormatKind::Mjpeg,
                _ => FormatKind::FrameBased,
            };
            let Some(format) = stream.formats.last_mut().filter(|f| f.kind == wanted) else {
                return Err(d.error("a frame size that follows no format of its kind"));
            };
            format.frames.push(frame(subtype, d)?);
        }
        _ => {}
    }
    Ok(())
}

fn format(subtype: u8, d: &Descriptor<'_>) -> Result<Format> {
    let mjpeg = subtype == 6;
    Ok(Format {
        index: d.u8(3)?,
        kind: match subtype {
            4 => FormatKind::Uncompressed,
            6 => FormatKind::Mjpeg,
            _ => FormatKind::FrameBased,
        },
        guid: if mjpeg { Guid::from_code(FourCc::MJPG) } else { d.guid(5)? },
        bits_per_pixel: if mjpeg { 0 } else { d.u8(21)? },
        frames: Vec::new(),
    })
}

fn frame(subtype: u8, d: &Descriptor<'_>) -> Result<FrameSize> {
    let frame_based = subtype == 0x11;
    let (default_at, count_at) = if frame_based { (17, 21) } else { (21, 25) };
    let interval = |i: usize| Ok::<_, Error>(Interval(d.u32(26 + 4 * i)?));
    let intervals = match d.u8(count_at)? {
        0 => Intervals::Continuous { min: interval(0)?, max: interval(1)?, step: interval(2)? },
        n => Intervals::Discrete((0..n.into()).map(interval).collect::<Result<_>>()?),
    };
    Ok(FrameSize {
        index: d.u8(3)?,
        width: d.u16(5)?,
        height: d.u16(7)?,
        min_bit_rate: d.u32(9)?,
        max_bit_rate: d.u32(13)?,
        max_bytes: if frame_based { None } else { Some(d.u32(17)?) },
        bytes_per_line: if frame_based { d.u32(22)? } else { 0 },
        default_interval: Interval(d.u32(default_at)?),
        intervals,
    })
}
