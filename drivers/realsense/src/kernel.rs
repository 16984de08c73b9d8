//! A D400 through the kernel's video driver: its nodes found by interface and by what they offer.
//!
//! `uvcvideo` hangs the nodes of a function on its control interface, number 0 for the stereo module and another one
//! for the colour module, and puts a metadata node right behind each capture node. Which node is which follows from
//! that and from the formats, never from the numbers of the nodes.

use super::config::MetadataWish;
use super::find::FoundCamera;
use super::protocol::hwm::{HardwareMonitor, Retry, UNIT_ID, UnitMonitor};
use super::transport::{Function, HeaderPart, ImageControls, Mode, Sensor, Started, Transport};
use depthrig_driver::{Error, ErrorKind, Result};
use depthrig_usb::controls::{Control, ControlValue};
use depthrig_usb::uvc::control::ControlPort;
use depthrig_usb::{SysRoot, holder};
use depthrig_v4l2 as v4l2;
use depthrig_v4l2::{DEFAULT_BUFFERS, MetadataFormat, Node, Wanted};
use std::path::PathBuf;

/// The encodings that are of use.
const FORMATS: [&[u8; 4]; 7] = [b"Z16 ", b"GREY", b"Y8I ", b"YUYV", b"UYVY", b"NV12", b"CNF4"];

/// A streaming interface as the kernel shows it.
#[derive(Debug)]
struct Port {
    sensor: Sensor,
    function: Function,
    video: PathBuf,
    metadata: Option<PathBuf>,
    modes: Vec<v4l2::Mode>,
}

/// A camera through its video nodes.
#[derive(Debug)]
pub(super) struct Kernel {
    root: SysRoot,
    label: String,
    ports: Vec<Port>,
    modes: Vec<Mode>,
    wish: MetadataWish,
}

impl Kernel {
    /// Opens the nodes of `found`, without taking them from anybody.
    ///
    /// # Errors
    /// [`ErrorKind::NotFound`] when the kernel's driver has not bound the camera, with the cure;
    /// [`ErrorKind::PermissionDenied`], [`ErrorKind::Disconnected`], [`ErrorKind::Io`].
    pub(super) fn open(root: &SysRoot, found: &FoundCamera, wish: MetadataWish) -> Result<Self> {
        let label = found.describe();
        let mut ports: Vec<Port> = Vec::new();
        for interface in &found.usb.interfaces {
            let function = if interface.number == 0 { Function::Stereo } else { Function::Color };
            // The capture node that a metadata node would belong to.
            let mut last: Option<usize> = None;
            for shown in &interface.video_nodes {
                let node = Node::open(&shown.path)?;
                if node.capability().is_metadata() {
                    if let Some(port) = last.take().and_then(|at| ports.get_mut(at)) {
                        port.metadata = Some(shown.path.clone());
                    }
                } else if node.capability().is_capture() {
                    let modes = node.modes(|f| FORMATS.contains(&&f.0))?;
                    last = sensor_of(function, &modes).map(|sensor| {
                        let video = shown.path.clone();
                        ports.push(Port { sensor, function, video, metadata: None, modes });
                        ports.len() - 1
                    });
                }
            }
        }
        if !ports.iter().any(|p| p.sensor == Sensor::Depth) {
            let text = format!(
                "{label}: the kernel shows no depth node of it; is the module uvcvideo loaded, and does no other program hold \
                 the camera through libusb? `transport = \"libusb\"` works without the kernel's driver"
            );
            return Err(Error::new(ErrorKind::NotFound, text));
        }
        let modes = ports.iter().flat_map(|p| p.modes.iter().map(|m| mode_of(p.sensor, m))).collect();
        Ok(Self { root: root.clone(), label, ports, modes, wish })
    }

    /// Whether the nodes of `found` are there at all.
    pub(super) fn has_bound(found: &FoundCamera) -> bool {
        found.usb.video_nodes().next().is_some()
    }

    fn node(&self, path: &std::path::Path) -> Result<Node> {
        Node::open(path).map_err(|e| self.in_camera(&e))
    }

    fn in_camera(&self, e: &Error) -> Error {
        Error::new(e.kind(), format!("{}: {e}", self.label))
    }

    /// Adds the process that holds a busy node.
    fn name_holder(&self, path: &std::path::Path, e: Error) -> Error {
        if e.kind() != ErrorKind::Busy {
            return self.in_camera(&e);
        }
        let holders = holder::holders_of(&self.root, path).describe();
        let text =
            format!("{}: in use; {} is held by {holders}. End that program", self.label, path.display());
        Error::new(ErrorKind::Busy, text).with_source(e)
    }

    fn path_of(&self, function: Function) -> Result<&PathBuf> {
        let port = self.ports.iter().find(|p| p.function == function);
        port.map(|p| &p.video).ok_or_else(|| {
            let text = format!("{}: it has no colour module of its own", self.label);
            Error::new(ErrorKind::Unsupported, text)
        })
    }
}

impl Transport for Kernel {
    fn name(&self) -> &'static str {
        "kernel"
    }

    fn modes(&self) -> &[Mode] {
        &self.modes
    }

    fn control(&mut self, function: Function) -> Result<Box<dyn ControlPort>> {
        Ok(Box::new(self.node(self.path_of(function)?)?))
    }

    fn image_controls(&mut self, function: Function) -> Result<Box<dyn ImageControls>> {
        Ok(Box::new(NodeControls(self.node(self.path_of(function)?)?)))
    }

    fn monitor(&mut self) -> Result<Box<dyn HardwareMonitor>> {
        let node = self.node(self.path_of(Function::Stereo)?)?;
        Ok(Box::new(UnitMonitor::new(node, UNIT_ID, Retry::default())))
    }

    /// Only one may set the mode of a node: who streams already keeps everybody else from it.
    fn check_free(&mut self) -> Result<()> {
        for port in &self.ports {
            let Some(mode) = port.modes.first() else { continue };
            self.node(&port.video)?.set_mode(mode).map_err(|e| self.name_holder(&port.video, e))?;
        }
        Ok(())
    }

    fn start(&mut self, modes: &[Mode]) -> Result<Started> {
        let mut nodes = Vec::new();
        for mode in modes {
            let found = self.ports.iter().filter(|p| p.sensor == mode.sensor).find_map(|p| {
                let same = |m: &&v4l2::Mode| mode_of(p.sensor, m) == *mode;
                p.modes.iter().find(same).map(|m| (p, *m))
            });
            let Some((port, exact)) = found else {
                let text = format!("{}: it has no mode {mode:?}", self.label);
                return Err(Error::new(ErrorKind::Unsupported, text));
            };
            let video = self.node(&port.video)?;
            video.set_mode(&exact).map_err(|e| self.name_holder(&port.video, e))?;
            let metadata = match (&port.metadata, self.wish) {
                (None, _) | (_, MetadataWish::None) => None,
                (Some(path), MetadataWish::Full) => Some((self.node(path)?, MetadataFormat::D4xx)),
                (Some(path), MetadataWish::Header) => Some((self.node(path)?, MetadataFormat::Uvch)),
            };
            nodes.push((Wanted { video, metadata }, port.video.clone()));
        }
        let (wanted, paths): (Vec<_>, Vec<_>) = nodes.into_iter().unzip();
        let source = v4l2::Source::start(wanted, DEFAULT_BUFFERS).map_err(|e| match paths.first() {
            Some(path) => self.name_holder(path, e),
            None => self.in_camera(&e),
        })?;
        let part = |at| match source.metadata(at) {
            MetadataFormat::D4xx => HeaderPart::Whole,
            MetadataFormat::Uvch => HeaderPart::Standard,
            MetadataFormat::None => HeaderPart::Nothing,
        };
        let headers = (0..modes.len()).map(part).collect();
        Ok(Started { images: Box::new(source), headers })
    }
}

/// Which sensor a node belongs to, by its function and by what it offers; `None` when it offers nothing of use.
fn sensor_of(function: Function, modes: &[v4l2::Mode]) -> Option<Sensor> {
    let has = |code: &[u8; 4]| modes.iter().any(|m| m.format.0 == *code);
    if has(b"Z16 ") {
        Some(Sensor::Depth)
    } else if has(b"GREY") || has(b"Y8I ") {
        Some(Sensor::Infrared)
    } else if has(b"CNF4") {
        Some(Sensor::Confidence)
    } else if has(b"YUYV") || (has(b"UYVY") && function == Function::Color) {
        Some(Sensor::Color)
    } else {
        None
    }
}

fn mode_of(sensor: Sensor, mode: &v4l2::Mode) -> Mode {
    let v4l2::Mode { format, width, height, interval } = *mode;
    // The kernel's thirtieth is 333333 of ten millions; the descriptors mean 30.
    let rate_hz = (interval.rate_hz() * 100.0).round() / 100.0;
    Mode { sensor, fourcc: format.0, width, height, rate_hz }
}

/// The image controls of a node.
struct NodeControls(Node);

impl ImageControls for NodeControls {
    fn list(&mut self) -> Result<Vec<Control>> {
        self.0.controls()
    }

    fn get(&mut self, control: &Control) -> Result<i64> {
        self.0.read_control(control)
    }

    fn set(&mut self, control: &Control, value: i64) -> Result<()> {
        self.0.set_control(core::slice::from_ref(control), &control.name, &ControlValue::Integer(value))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use depthrig_v4l2::{FourCc, Interval};

    fn modes(codes: &[&[u8; 4]]) -> Vec<v4l2::Mode> {
        let interval = Interval { numerator: 333_333, denominator: 10_000_000 };
        codes.iter().map(|c| v4l2::Mode { format: FourCc(**c), width: 640, height: 480, interval }).collect()
    }

    #[test]
    fn nodes_are_identified_by_what_they_offer() {
        let stereo = |codes: &[&[u8; 4]]| sensor_of(Function::Stereo, &modes(codes));
        assert_eq!(stereo(&[b"Z16 "]), Some(Sensor::Depth));
        assert_eq!(stereo(&[b"GREY", b"UYVY", b"Y8I "]), Some(Sensor::Infrared));
        assert_eq!(stereo(&[b"YUYV"]), Some(Sensor::Color), "a D405's colour");
        assert_eq!(stereo(&[]), None);
        assert_eq!(sensor_of(Function::Color, &modes(&[b"YUYV"])), Some(Sensor::Color));
    }

    #[test]
    fn a_thirtieth_of_a_second_is_30_hz() {
        let mode = modes(&[b"Z16 "]).remove(0);
        assert!((mode_of(Sensor::Depth, &mode).rate_hz - 30.0).abs() < 1e-9);
    }
}
