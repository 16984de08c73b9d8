//! Raw images as they come from a camera, whichever way: kernel nodes or libusb.
//!
//! A transport is a [`ImageSource`]; what the bytes mean is the business of the
//! camera family that polls it.

use core::time::Duration;
use depthrig_bus::HostTime;
use depthrig_driver::Result;

/// One image as it came over the wire.
#[derive(Debug, Clone, Copy)]
pub struct Image<'a> {
    /// Which of the sources that were started: the index into what was asked for.
    pub source: usize,
    /// The bytes that arrived.
    pub bytes: &'a [u8],
    /// The device or the transport flagged it as damaged.
    pub damaged: bool,
    /// The transport's counter, unwrapped: it rises by one with every image that the device sent, as far as the
    /// transport can know.
    pub sequence: u64,
    /// When its first packet arrived, as the kernel stamped it; `None` without a kernel driver, or where the
    /// stamp is not of `CLOCK_MONOTONIC`.
    pub kernel_time: Option<HostTime>,
    /// When it was handed over complete.
    pub arrival: HostTime,
    /// The payload header of USB video, with whatever blocks the vendor put behind its 2 to 12 bytes; `None` where
    /// the transport does not get to see it.
    pub header: Option<&'a [u8]>,
}

/// A camera that is streaming raw images. Dropping it stops the camera.
pub trait ImageSource: Send {
    /// Waits at most `timeout`, then hands each image that is there to `each`; says whether there was one.
    ///
    /// The bytes are valid during the call of `each` alone.
    ///
    /// # Errors
    /// [`depthrig_driver::ErrorKind::Disconnected`], [`depthrig_driver::ErrorKind::Io`]: the source is of no more use.
    fn poll(&mut self, timeout: Duration, each: &mut dyn FnMut(&Image<'_>)) -> Result<bool>;
}
