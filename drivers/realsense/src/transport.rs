//! The transport to a D400: the kernel's video driver or libusb, behind one trait.
//!
//! The backend does not depend on which one it has. A transport lists what the device offers, hands out the ways to its
//! controls, and starts the images; it does not interpret their bytes and headers.

use super::protocol::hwm::HardwareMonitor;
use depthrig_driver::Result;
use depthrig_usb::controls::Control;
use depthrig_usb::uvc::control::ControlPort;
use depthrig_usb::video::ImageSource;

/// One of the video streaming interfaces of a D400.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Sensor {
    /// Depth.
    Depth,
    /// The imagers behind it.
    Infrared,
    /// Colour: a module of its own, or the stereo module's on a D405.
    Color,
    /// How sure depth is, which an L515 alone has.
    Confidence,
}

/// One of the video control functions of a D400.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Function {
    /// The stereo module: depth and infrared, and colour on a D405.
    Stereo,
    /// The colour module; a D405 has none.
    Color,
}

/// A mode as the device's descriptors have it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Mode {
    /// Which interface offers it.
    pub sensor: Sensor,
    /// Encoding of the pixels, as V4L2 names it: `Z16 `, `GREY`, `Y8I `, `Y12I`, `YUYV`, `UYVY`; of an
    /// L515 also `NV12` and `CNF4`.
    pub fourcc: [u8; 4],
    /// Pixels per row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Frames per second.
    pub rate_hz: f64,
}

impl Mode {
    /// Bytes of one image on the wire; `None` for an encoding that is not known here.
    pub const fn wire_bytes(&self) -> Option<usize> {
        let pixels = self.width as usize * self.height as usize;
        match &self.fourcc {
            // Confidence counts bytes, of two pixels each, as its pixels.
            b"GREY" | b"CNF4" => Some(pixels),
            b"NV12" => Some(pixels * 3 / 2),
            b"Z16 " | b"Y8I " | b"YUYV" | b"UYVY" => Some(pixels * 2),
            b"Y12I" => Some(pixels * 3),
            _ => None,
        }
    }
}

/// How much of the payload header the images of a source bring along.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum HeaderPart {
    /// None of it: [`depthrig_usb::video::Image::header`] is `None`.
    Nothing,
    /// Its standard part of 12 bytes: the device's time stamp and clock sample.
    Standard,
    /// All of it, with the vendor's metadata blocks.
    Whole,
}

/// The started streams.
pub struct Started {
    /// The images; [`depthrig_usb::video::Image::source`] is the index into the modes that were asked for.
    pub images: Box<dyn ImageSource>,
    /// The part of the header that the kernel or the library really grants, for each of the modes.
    pub headers: Vec<HeaderPart>,
}

/// The image controls of one function (camera terminal and processing unit), by the names that V4L2 gives them
/// ([`Control`]). Every call may take as long as the kernel's control time-out (5 s), so none belongs on a capture
/// thread.
pub trait ImageControls: Send {
    /// All that there are.
    ///
    /// # Errors
    /// [`depthrig_driver::ErrorKind::Disconnected`], [`depthrig_driver::ErrorKind::Io`].
    fn list(&mut self) -> Result<Vec<Control>>;

    /// The present value.
    ///
    /// # Errors
    /// [`depthrig_driver::ErrorKind::Disconnected`], [`depthrig_driver::ErrorKind::Io`], [`depthrig_driver::ErrorKind::Protocol`] when the camera
    /// refuses.
    fn get(&mut self, control: &Control) -> Result<i64>;

    /// Sets it to a value that [`Control::check`] gave.
    ///
    /// # Errors
    /// Those of [`Self::get`].
    fn set(&mut self, control: &Control, value: i64) -> Result<()>;
}

/// An open D400. Dropping it and everything it handed out releases the device.
pub trait Transport: Send {
    /// `kernel` or `libusb`, for messages.
    fn name(&self) -> &'static str;

    /// Every mode that the device's descriptors list, also such as the backend cannot use.
    fn modes(&self) -> &[Mode];

    /// A way to the extension units of a function. It is independent of the images: what is handed out may be used
    /// on another thread while they stream.
    ///
    /// # Errors
    /// [`depthrig_driver::ErrorKind::Unsupported`] when there is no such function, [`depthrig_driver::ErrorKind::Disconnected`],
    /// [`depthrig_driver::ErrorKind::Io`].
    fn control(&mut self, function: Function) -> Result<Box<dyn ControlPort>>;

    /// A way to the image controls of a function, as independent.
    ///
    /// # Errors
    /// Those of [`Self::control`].
    fn image_controls(&mut self, function: Function) -> Result<Box<dyn ImageControls>>;

    /// A way to the hardware monitor, as independent. It goes by the extension unit through the kernel and by the
    /// vendor's bulk interface through libusb.
    ///
    /// # Errors
    /// Those of [`Self::control`].
    fn monitor(&mut self) -> Result<Box<dyn HardwareMonitor>>;

    /// Checks that no other process streams from the camera, as far as that shows before it is started. A transport
    /// that holds the camera exclusively once opened need not.
    ///
    /// # Errors
    /// [`depthrig_driver::ErrorKind::Busy`] naming the process, [`depthrig_driver::ErrorKind::Disconnected`], [`depthrig_driver::ErrorKind::Io`].
    fn check_free(&mut self) -> Result<()> {
        Ok(())
    }

    /// Starts the sources of `modes` together; at most one for each [`Sensor`].
    ///
    /// # Errors
    /// [`depthrig_driver::ErrorKind::Unsupported`] when the device refuses a mode, [`depthrig_driver::ErrorKind::Busy`],
    /// [`depthrig_driver::ErrorKind::Disconnected`], [`depthrig_driver::ErrorKind::Io`].
    fn start(&mut self, modes: &[Mode]) -> Result<Started>;
}
