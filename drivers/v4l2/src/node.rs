//! One video node: what it is, the modes it has, its controls, and the extension units behind it.

use super::controls::enumerate;
use super::error::node_error;
use super::ioctl::{self, Memory, QueueKind, text};
use super::metadata::MetadataFormat;
use core::fmt;
use depthrig_driver::{Error, ErrorKind, Result};
use depthrig_usb::controls::{self, Control, ControlKind, ControlValue};
use depthrig_usb::uvc::control::{ControlPort, Query};
use depthrig_usb::uvc::formats::FourCc;
use rustix::io::Errno;
use std::os::fd::RawFd;
use std::path::{Path, PathBuf};
use v4l::frameinterval::FrameIntervalEnum;
use v4l::framesize::FrameSizeEnum;
use v4l::v4l_sys as sys;
use v4l::video::Capture as _;

/// Capabilities of a node, as the driver reports them.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Capability {
    /// Its driver: `uvcvideo`, `vivid`, …
    pub driver: String,
    /// The camera's name.
    pub card: String,
    /// Where it is attached, as the kernel has it: `usb-0000:00:14.0-1`, `platform:vivid-000`.
    pub bus: String,
    /// Capabilities of this very node (`device_caps`, not those of all nodes of the device).
    pub flags: u32,
}

impl Capability {
    /// Whether images come from it.
    pub const fn is_capture(&self) -> bool {
        self.flags & sys::V4L2_CAP_VIDEO_CAPTURE != 0
    }

    /// Whether metadata comes from it.
    pub const fn is_metadata(&self) -> bool {
        self.flags & sys::V4L2_CAP_META_CAPTURE != 0
    }

    /// Whether it can be streamed from by handing buffers over.
    pub const fn can_stream(&self) -> bool {
        self.flags & sys::V4L2_CAP_STREAMING != 0
    }
}

/// The time between two frames, seconds as a fraction.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Interval {
    /// Above the line.
    pub numerator: u32,
    /// Below the line.
    pub denominator: u32,
}

impl Interval {
    /// Frames a second; 0 for an invalid fraction.
    pub fn rate_hz(self) -> f64 {
        if self.numerator == 0 { 0.0 } else { f64::from(self.denominator) / f64::from(self.numerator) }
    }
}

/// A format, a size and a frame interval.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Mode {
    /// The format of its images.
    pub format: FourCc,
    /// Pixels per row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Time between frames.
    pub interval: Interval,
}

impl fmt::Display for Mode {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { format, width, height, interval } = self;
        write!(f, "{format} {width}x{height} {} Hz", (interval.rate_hz() * 1000.0).round() / 1000.0)
    }
}

/// How an image lies in a buffer of the kernel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Layout {
    /// Bytes from one row to the next; 0 for compressed images.
    pub bytes_per_line: u32,
    /// Bytes that a buffer needs at most.
    pub size_image: u32,
}

/// Sizes that are offered of a node which takes any size.
const COMMON_SIZES: [(u32, u32); 12] = [
    (1280, 720),
    (1920, 1080),
    (640, 480),
    (320, 240),
    (424, 240),
    (640, 360),
    (800, 600),
    (848, 480),
    (960, 540),
    (1280, 800),
    (2560, 1440),
    (3840, 2160),
];
/// Rates that are offered of a node which takes any rate, Hz.
const COMMON_RATES: [u32; 8] = [30, 15, 5, 10, 25, 50, 60, 90];
/// A node that claims more modes than this is not listened to any further.
const MAX_MODES: usize = 10_000;

/// An open video node. Several may be open on one path: one streams while another has the controls.
pub struct Node {
    device: v4l::Device,
    path: PathBuf,
    capability: Capability,
}

impl fmt::Debug for Node {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Node")
            .field("path", &self.path)
            .field("capability", &self.capability)
            .finish_non_exhaustive()
    }
}

impl Node {
    /// Opens the node at `path`, without blocking and without taking the camera from anybody.
    ///
    /// # Errors
    /// [`ErrorKind::NotFound`], [`ErrorKind::PermissionDenied`] (with the cure), [`ErrorKind::Disconnected`],
    /// [`ErrorKind::Unsupported`] when it is not a video node, [`ErrorKind::Io`].
    pub fn open(path: &Path) -> Result<Self> {
        let device = v4l::Device::with_path(path).map_err(|e| node_error(path, "cannot be opened", e))?;
        let c = ioctl::capability(device.handle().fd())
            .map_err(|e| node_error(path, "does not say what it is (VIDIOC_QUERYCAP)", e))?;
        let flags =
            if c.capabilities & sys::V4L2_CAP_DEVICE_CAPS != 0 { c.device_caps } else { c.capabilities };
        let capability =
            Capability { driver: text(&c.driver), card: text(&c.card), bus: text(&c.bus_info), flags };
        Ok(Self { device, path: path.to_owned(), capability })
    }

    /// Its path, `/dev/videoN`: for messages, not for finding it again.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Its capabilities.
    pub const fn capability(&self) -> &Capability {
        &self.capability
    }

    pub(super) fn fd(&self) -> RawFd {
        self.device.handle().fd()
    }

    pub(super) fn error(&self, what: &str, e: std::io::Error) -> Error {
        node_error(&self.path, what, e)
    }

    /// Whether another open file has this node's buffers, so that it streams or is about to. Nothing is taken from it.
    pub fn is_used_elsewhere(&self) -> bool {
        let kind = if self.capability.is_metadata() { QueueKind::Metadata } else { QueueKind::Video };
        // Giving back buffers that one has not is refused with EBUSY exactly when somebody else has them.
        ioctl::request_buffers(self.fd(), kind, Memory::Mapped, 0)
            .is_err_and(|e| e.raw_os_error() == Some(Errno::BUSY.raw_os_error()))
    }

    /// The formats of a capture or metadata node, in the driver's order.
    ///
    /// # Errors
    /// [`ErrorKind::Disconnected`], [`ErrorKind::Io`].
    pub fn formats(&self) -> Result<Vec<FourCc>> {
        let kind = if self.capability.is_metadata() { QueueKind::Metadata } else { QueueKind::Video };
        let mut formats = Vec::new();
        while formats.len() < 512 {
            let next = ioctl::enum_format(self.fd(), kind, formats.len() as u32)
                .map_err(|e| self.error("does not list its formats (VIDIOC_ENUM_FMT)", e))?;
            match next {
                Some(code) => formats.push(FourCc::from_number(code)),
                None => break,
            }
        }
        Ok(formats)
    }

    /// Every mode of the formats that `wanted` picks, in the driver's order. Of a node that takes any size or rate,
    /// the common ones.
    ///
    /// # Errors
    /// Those of [`Self::formats`].
    pub fn modes(&self, wanted: impl Fn(FourCc) -> bool) -> Result<Vec<Mode>> {
        let mut modes = Vec::new();
        for format in self.formats()?.into_iter().filter(|f| wanted(*f)) {
            for (width, height) in self.sizes(format)? {
                for interval in self.intervals(format, width, height)? {
                    modes.push(Mode { format, width, height, interval });
                    if modes.len() >= MAX_MODES {
                        return Ok(modes);
                    }
                }
            }
        }
        Ok(modes)
    }

    fn sizes(&self, format: FourCc) -> Result<Vec<(u32, u32)>> {
        let listed = match self.device.enum_framesizes(v4l::FourCC::new(&format.0)) {
            Ok(listed) => listed,
            Err(e) => return self.none_listed("does not list its image sizes (VIDIOC_ENUM_FRAMESIZES)", e),
        };
        let mut sizes = Vec::new();
        for s in listed {
            match s.size {
                FrameSizeEnum::Discrete(d) => sizes.push((d.width, d.height)),
                FrameSizeEnum::Stepwise(s) => {
                    sizes.extend(COMMON_SIZES.into_iter().filter(|(w, h)| {
                        on_step(*w, s.min_width, s.max_width, s.step_width)
                            && on_step(*h, s.min_height, s.max_height, s.step_height)
                    }));
                }
            }
        }
        Ok(sizes)
    }

    fn intervals(&self, format: FourCc, width: u32, height: u32) -> Result<Vec<Interval>> {
        let listed = match self.device.enum_frameintervals(v4l::FourCC::new(&format.0), width, height) {
            Ok(listed) => listed,
            Err(e) => {
                return self.none_listed("does not list its frame intervals (VIDIOC_ENUM_FRAMEINTERVALS)", e);
            }
        };
        let mut intervals = Vec::new();
        for i in listed {
            match i.interval {
                FrameIntervalEnum::Discrete(f) => {
                    intervals.push(Interval { numerator: f.numerator, denominator: f.denominator });
                }
                FrameIntervalEnum::Stepwise(s) => {
                    let rate = |f: v4l::Fraction| {
                        Interval { numerator: f.numerator, denominator: f.denominator }.rate_hz()
                    };
                    // The longest interval is the slowest rate.
                    let slowest = rate(s.max);
                    let fastest = rate(s.min);
                    let within = |hz: &u32| (slowest..=fastest).contains(&f64::from(*hz));
                    intervals.extend(
                        COMMON_RATES
                            .into_iter()
                            .filter(within)
                            .map(|hz| Interval { numerator: 1, denominator: hz }),
                    );
                }
            }
        }
        intervals.retain(|i| i.rate_hz() > 0.0);
        Ok(intervals)
    }

    /// A list that is missing is an empty list; any other error is one.
    fn none_listed<T>(&self, what: &str, e: std::io::Error) -> Result<Vec<T>> {
        match e.raw_os_error().map(Errno::from_raw_os_error) {
            Some(Errno::INVAL | Errno::NOTTY) => Ok(Vec::new()),
            _ => Err(self.error(what, e)),
        }
    }

    /// Sets the mode and says how its images will lie in the buffers.
    ///
    /// # Errors
    /// [`ErrorKind::Unsupported`] when the driver gives another mode, naming it; [`ErrorKind::Busy`],
    /// [`ErrorKind::Disconnected`], [`ErrorKind::Io`].
    pub fn set_mode(&self, mode: &Mode) -> Result<Layout> {
        let got = ioctl::set_pix_format(self.fd(), mode.width, mode.height, mode.format.number())
            .map_err(|e| self.error(&format!("does not take the mode {mode} (VIDIOC_S_FMT)"), e))?;
        if (got.width, got.height, got.fourcc) != (mode.width, mode.height, mode.format.number()) {
            let given = FourCc::from_number(got.fourcc);
            return Err(self.other_mode(mode, &format!("{given} {}x{}", got.width, got.height)));
        }
        let fraction = v4l::Fraction::new(mode.interval.numerator, mode.interval.denominator);
        match self.device.set_params(&v4l::video::capture::Parameters::new(fraction)) {
            Ok(set) => {
                let interval =
                    Interval { numerator: set.interval.numerator, denominator: set.interval.denominator };
                // USB cameras count in 100 ns, so that a thirtieth comes back as 333333 of ten millions.
                if (interval.rate_hz() / mode.interval.rate_hz() - 1.0).abs() > 0.001 {
                    return Err(self.other_mode(mode, &format!("{:.3} Hz", interval.rate_hz())));
                }
            }
            // A driver without the call has one interval, which is the one that it listed.
            Err(e) if e.raw_os_error() == Some(Errno::NOTTY.raw_os_error()) => {}
            Err(e) => return Err(self.error("does not take the frame interval (VIDIOC_S_PARM)", e)),
        }
        Ok(Layout { bytes_per_line: got.bytes_per_line, size_image: got.size_image })
    }

    fn other_mode(&self, asked: &Mode, given: &str) -> Error {
        let path = self.path.display();
        let why = "its driver gives the nearest mode that it has";
        Error::new(
            ErrorKind::Unsupported,
            format!("{path}: asked for {asked}, the driver set {given}; {why}"),
        )
    }

    /// Sets the format of a metadata node and says which it became and how long its buffers are, bytes. A kernel that
    /// does not know the format for this camera sets its own.
    ///
    /// # Errors
    /// [`ErrorKind::Busy`], [`ErrorKind::Disconnected`], [`ErrorKind::Io`].
    pub fn set_metadata_format(&self, wanted: MetadataFormat) -> Result<(MetadataFormat, u32)> {
        let code = wanted.fourcc().unwrap_or(FourCc::UVCH).number();
        let (got, size) = ioctl::set_metadata_format(self.fd(), code)
            .map_err(|e| self.error("does not take a metadata format (VIDIOC_S_FMT)", e))?;
        Ok((MetadataFormat::from_fourcc(FourCc::from_number(got)), size))
    }

    /// The controls that it has, without the compound ones.
    ///
    /// # Errors
    /// [`ErrorKind::Disconnected`], [`ErrorKind::Io`].
    pub fn controls(&self) -> Result<Vec<Control>> {
        enumerate(self.fd()).map_err(|e| self.error("does not list its controls (VIDIOC_QUERY_EXT_CTRL)", e))
    }

    /// The present value of a control.
    ///
    /// # Errors
    /// [`ErrorKind::Disconnected`], [`ErrorKind::Io`], [`ErrorKind::Protocol`] when the camera refuses.
    pub fn read_control(&self, control: &Control) -> Result<i64> {
        let wide = control.kind == ControlKind::Integer64;
        ioctl::control(self.fd(), control.id, wide)
            .map_err(|e| self.error(&format!("control {} cannot be read", control.name), e))
    }

    /// Writes the control `name`, checked against what it takes. `controls` is what [`Self::controls`] said.
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] for an unknown name (naming those there are) or a value that it does not take (with
    /// range, step or items); [`ErrorKind::Busy`], [`ErrorKind::Disconnected`], [`ErrorKind::Io`].
    pub fn set_control(&self, controls: &[Control], name: &str, value: &ControlValue) -> Result<()> {
        let in_node = |e: Error| {
            Error::new(e.kind(), format!("{} ({}): {e}", self.path.display(), self.capability.card))
        };
        let control = controls::find(controls, name).map_err(in_node)?;
        let number = control.check(value).map_err(in_node)?;
        let wide = control.kind == ControlKind::Integer64;
        ioctl::set_control(self.fd(), control.id, wide, number).map_err(|e| {
            let what = format!("control {} cannot be set to {value}", control.name);
            if e.kind() != std::io::ErrorKind::PermissionDenied {
                return self.error(&what, e);
            }
            // The kernel's word for a control that is read-only now.
            let path = self.path.display();
            let why = "an automatic has it; switch that off first";
            Error::new(ErrorKind::BadInput, format!("{path}: {what}: {why}")).with_source(e)
        })
    }
}

const fn on_step(value: u32, least: u32, most: u32, step: u32) -> bool {
    let step = if step == 0 { 1 } else { step };
    value >= least && value <= most && (value - least).is_multiple_of(step)
}

impl ControlPort for Node {
    /// `UVCIOC_CTRL_QUERY`. The kernel knows extension units alone by it, not the camera terminal nor the processing
    /// unit; those are [`Node::set_control`]'s.
    fn query(&mut self, unit: u8, selector: u8, query: Query, data: &mut [u8]) -> Result<()> {
        ioctl::unit_query(self.fd(), unit, selector, query as u8, data).map_err(|e| {
            let what = format!("{query:?} of selector {selector} of unit {unit}, {} bytes", data.len());
            let (kind, why) = match e.raw_os_error().map(Errno::from_raw_os_error) {
                Some(Errno::NOENT) => (ErrorKind::Unsupported, "the camera has no such unit or selector"),
                Some(Errno::BADRQC) => (ErrorKind::Unsupported, "the selector cannot do that"),
                Some(Errno::NOTTY) => (ErrorKind::Unsupported, "this is not a node of a USB camera"),
                Some(Errno::NOBUFS) => (ErrorKind::Protocol, "the value has another length"),
                Some(Errno::INVAL | Errno::PIPE | Errno::RANGE | Errno::ILSEQ) => {
                    (ErrorKind::Protocol, "the camera refused")
                }
                Some(Errno::BUSY | Errno::AGAIN) => (ErrorKind::Busy, "the camera is not ready; ask again"),
                Some(Errno::TIMEDOUT) => {
                    (ErrorKind::Stalled, "the camera did not answer; if that stays so, plug it in anew")
                }
                _ => return self.error(&what, e),
            };
            Error::new(kind, format!("{}: {what}: {why} ({e})", self.path.display())).with_source(e)
        })
    }
}
