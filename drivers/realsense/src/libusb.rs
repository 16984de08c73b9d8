//! A D400 through libusb, for computers whose kernel has no driver for it or gives no metadata.
//!
//! The complete payload header is seen, so the metadata are always complete, whatever the kernel's version.

use super::find::FoundCamera;
use super::protocol::hwm::{HardwareMonitor, Retry, UNIT_GUID, UnitMonitor};
use super::transport::{Function, HeaderPart, ImageControls, Mode, Sensor, Started, Transport};
use crate::vendor::VendorBulk;
use depthrig_driver::{Error, ErrorKind, Result};
use depthrig_libusb::{Camera, Port, Settings, Source, StreamMode};
use depthrig_usb::SysRoot;
use depthrig_usb::controls::Control;
use depthrig_usb::uvc::control::ControlPort;
use depthrig_usb::uvc::descriptors::{Configuration, ControlInterface, Intervals, StreamingInterface};
use depthrig_usb::uvc::formats::{FourCc, Guid};
use depthrig_usb::uvc::image_controls::ImageUnits;

/// Opens the camera, taking it from the kernel's driver for as long as it is open.
///
/// # Errors
/// [`ErrorKind::Busy`], [`ErrorKind::PermissionDenied`], [`ErrorKind::Disconnected`], [`ErrorKind::Io`].
pub(super) fn open(root: &SysRoot, found: &FoundCamera) -> Result<Box<dyn Transport>> {
    let camera = Camera::open(root, &found.usb)?;
    let streams = streams(camera.configuration());
    if !streams.iter().any(|s| s.sensor == Sensor::Depth) {
        let text = format!("{}: its descriptors show no depth", found.describe());
        return Err(Error::new(ErrorKind::Protocol, text));
    }
    let modes = streams.iter().flat_map(|s| s.modes.iter().map(|(mode, _)| *mode)).collect();
    Ok(Box::new(Libusb { camera, label: found.describe(), streams, modes }))
}

/// A camera through libusb.
struct Libusb {
    camera: Camera,
    label: String,
    streams: Vec<Offer>,
    modes: Vec<Mode>,
}

/// A streaming interface and what it offers.
#[derive(Debug, PartialEq)]
struct Offer {
    interface: u8,
    sensor: Sensor,
    /// Each mode with the rate as the descriptor has it.
    modes: Vec<(Mode, f64)>,
}

/// The streaming interfaces and what each is of.
fn streams(configuration: &Configuration) -> Vec<Offer> {
    let stereo = stereo(configuration).map(|c| c.number);
    let offer = |stream: &StreamingInterface| {
        let has = |code| stream.formats.iter().any(|f| f.format() == code);
        let owner = configuration.control_of(stream.number).map(|c| c.number);
        // As through the kernel: depth has depth, infrared has grey, and what is left over is colour, unless it is of
        // the stereo module and has nothing but UYVY.
        let sensor = if has(FourCc::Z16) {
            Sensor::Depth
        } else if has(FourCc::GREY) || has(FourCc::Y8I) {
            Sensor::Infrared
        } else if has(FourCc::YUYV) || (has(FourCc::UYVY) && owner != stereo) {
            Sensor::Color
        } else {
            return None;
        };
        let mut modes: Vec<(Mode, f64)> = Vec::new();
        for (format, size) in stream.formats.iter().flat_map(|f| f.frames.iter().map(move |s| (f, s))) {
            let list = match &size.intervals {
                Intervals::Discrete(list) => list.as_slice(),
                Intervals::Continuous { .. } => core::slice::from_ref(&size.default_interval),
            };
            for interval in list.iter().filter(|i| i.0 > 0) {
                let exact = interval.rate_hz();
                // The descriptor's thirtieth is 333333 of ten millions; it means 30.
                let rate_hz = (exact * 100.0).round() / 100.0;
                let width = size.width.into();
                let height = size.height.into();
                let mode = Mode { sensor, fourcc: format.format().0, width, height, rate_hz };
                // One format may be announced under two names; the first one is taken.
                if modes.iter().all(|(known, _)| *known != mode) {
                    modes.push((mode, exact));
                }
            }
        }
        Some(Offer { interface: stream.number, sensor, modes })
    };
    configuration.streams.iter().filter_map(offer).collect()
}

/// The function with the extension unit of the stereo module.
fn stereo(configuration: &Configuration) -> Option<&ControlInterface> {
    configuration.extension(Guid(UNIT_GUID)).map(|(control, _)| control)
}

impl Libusb {
    fn function(&self, function: Function) -> Result<&ControlInterface> {
        let configuration = self.camera.configuration();
        let stereo = stereo(configuration);
        let found = match function {
            Function::Stereo => stereo,
            Function::Color => {
                let number = stereo.map(|c| c.number);
                configuration.controls.iter().find(|c| Some(c.number) != number)
            }
        };
        found.ok_or_else(|| {
            let what = match function {
                Function::Stereo => "no extension unit of a stereo module",
                Function::Color => "no colour module of its own",
            };
            Error::new(ErrorKind::Unsupported, format!("{}: it has {what}", self.label))
        })
    }
}

impl Transport for Libusb {
    fn name(&self) -> &'static str {
        "libusb"
    }

    fn modes(&self) -> &[Mode] {
        &self.modes
    }

    fn control(&mut self, function: Function) -> Result<Box<dyn ControlPort>> {
        Ok(Box::new(Port::new(&self.camera, self.function(function)?.number)?))
    }

    fn image_controls(&mut self, function: Function) -> Result<Box<dyn ImageControls>> {
        let function = self.function(function)?;
        let port = Port::new(&self.camera, function.number)?;
        Ok(Box::new(ImageUnits::new(port, function)))
    }

    fn monitor(&mut self) -> Result<Box<dyn HardwareMonitor>> {
        match VendorBulk::new(&self.camera) {
            Ok(monitor) => Ok(Box::new(monitor)),
            // A model without the vendor's interface has its extension unit all the same.
            Err(e) if e.kind() == ErrorKind::Unsupported => {
                let (control, unit) = self.camera.configuration().extension(Guid(UNIT_GUID)).ok_or(e)?;
                let port = Port::new(&self.camera, control.number)?;
                Ok(Box::new(UnitMonitor::new(port, unit, Retry::default())))
            }
            Err(e) => Err(e),
        }
    }

    fn start(&mut self, modes: &[Mode]) -> Result<Started> {
        let wish = |mode: &Mode| {
            let found = self.streams.iter().find_map(|s| {
                let (_, rate_hz) = s.modes.iter().find(|(known, _)| known == mode)?;
                Some((s.interface, *rate_hz))
            });
            let (interface, rate_hz) = found.ok_or_else(|| {
                Error::new(ErrorKind::Unsupported, format!("{}: it has no mode {mode:?}", self.label))
            })?;
            let Mode { fourcc, width, height, .. } = *mode;
            Ok(StreamMode { interface, format: FourCc(fourcc), width, height, rate_hz })
        };
        let wishes = modes.iter().map(wish).collect::<Result<Vec<_>>>()?;
        let source = Source::start(&self.camera, &wishes, Settings::default())?;
        Ok(Started { images: Box::new(source), headers: vec![HeaderPart::Whole; modes.len()] })
    }
}

impl ImageControls for ImageUnits<Port> {
    fn list(&mut self) -> Result<Vec<Control>> {
        Self::list(self)
    }

    fn get(&mut self, control: &Control) -> Result<i64> {
        Self::get(self, control)
    }

    fn set(&mut self, control: &Control, value: i64) -> Result<()> {
        Self::set(self, control, value)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use depthrig_usb::uvc::descriptors::{Format, FormatKind, FrameSize, Interval, Unit, UnitKind};

    fn stream(number: u8, codes: &[[u8; 4]], intervals: &[u32]) -> StreamingInterface {
        let size = FrameSize {
            index: 1,
            width: 640,
            height: 480,
            min_bit_rate: 0,
            max_bit_rate: 0,
            max_bytes: None,
            bytes_per_line: 0,
            default_interval: Interval(333_333),
            intervals: Intervals::Discrete(intervals.iter().copied().map(Interval).collect()),
        };
        let format = |code: &[u8; 4]| Format {
            index: 1,
            kind: FormatKind::FrameBased,
            guid: Guid::from_code(FourCc(*code)),
            bits_per_pixel: 16,
            frames: vec![size.clone()],
        };
        StreamingInterface { number, formats: codes.iter().map(format).collect(), ..Default::default() }
    }

    fn configuration(streams: Vec<StreamingInterface>, stereo: &[u8], color: &[u8]) -> Configuration {
        let kind = UnitKind::Extension { guid: Guid(UNIT_GUID) };
        let unit = Unit { id: 3, kind, controls: Vec::new() };
        let control = |number, of: &[u8], units| ControlInterface {
            number,
            streams: of.to_vec(),
            units,
            ..ControlInterface::default()
        };
        let mut controls = vec![control(0, stereo, vec![unit])];
        if !color.is_empty() {
            controls.push(control(3, color, Vec::new()));
        }
        Configuration { controls, streams, ..Configuration::default() }
    }

    fn sensors(configuration: &Configuration) -> Vec<(u8, Sensor, usize)> {
        streams(configuration).iter().map(|s| (s.interface, s.sensor, s.modes.len())).collect()
    }

    #[test]
    fn sensors_are_identified_by_what_they_offer() {
        let thirty_and_fifteen = [333_333, 666_666];
        // D16 (80) is depth under a second name: the same modes, once.
        let depth = stream(1, &[*b"Z16 ", [80, 0, 0, 0]], &thirty_and_fifteen);
        let infrared = stream(2, &[*b"UYVY", *b"Y8  ", *b"Y8I "], &[333_333]);
        let color = stream(4, &[*b"YUY2"], &[333_333, 0]);
        let d435 = configuration(vec![depth.clone(), infrared.clone(), color], &[1, 2], &[4]);
        assert_eq!(sensors(&d435), [(1, Sensor::Depth, 2), (2, Sensor::Infrared, 3), (4, Sensor::Color, 1)]);
        let modes = &streams(&d435)[0].modes;
        assert_eq!(modes.iter().map(|(m, _)| m.rate_hz).collect::<Vec<_>>(), [30.0, 15.0]);
        assert_eq!(modes[0].0.fourcc, *b"Z16 ");
        // A D405 has its colour in the stereo module.
        let own = stream(3, &[*b"YUY2"], &[333_333]);
        let bare = stream(4, &[*b"UYVY"], &[333_333]);
        let d405 = configuration(vec![depth, infrared, own, bare], &[1, 2, 3, 4], &[]);
        assert_eq!(sensors(&d405), [(1, Sensor::Depth, 2), (2, Sensor::Infrared, 3), (3, Sensor::Color, 1)]);
    }
}
