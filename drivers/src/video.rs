//! Raw pictures as they come from a camera, whichever way: kernel nodes or libusb.
//!
//! A transport is a [`PictureSource`]; what the bytes mean is the business of the
//! camera family that polls it.

use crate::Result;
use core::time::Duration;
use depthrig_bus::HostTime;

/// One picture as it came over the wire.
#[derive(Debug, Clone, Copy)]
pub struct Picture<'a> {
    /// Which of the sources that were started: the index into what was asked for.
    pub source: usize,
    /// What arrived, cut to the bytes that did.
    pub bytes: &'a [u8],
    /// The device or the transport flagged it as damaged.
    pub damaged: bool,
    /// The transport's counter, unwrapped: it rises by one with every picture that the device sent, as far as the
    /// transport can know.
    pub sequence: u64,
    /// When its first packet arrived, as the kernel stamped it; `None` where there is no kernel driver, or where the
    /// stamp is not of `CLOCK_MONOTONIC`.
    pub kernel_time: Option<HostTime>,
    /// When it was handed over complete.
    pub arrival: HostTime,
    /// The payload header of USB video, with whatever blocks the vendor put behind its 2 to 12 bytes; `None` where
    /// the transport does not get to see it.
    pub header: Option<&'a [u8]>,
}

/// A camera that is streaming raw pictures. Dropping it stops the camera.
pub trait PictureSource: Send {
    /// Waits at most `timeout`, then hands each picture that is there to `each`; says whether there was one.
    ///
    /// The bytes are valid during the call of `each` alone.
    ///
    /// # Errors
    /// [`crate::ErrorKind::Disconnected`], [`crate::ErrorKind::Io`]: the source is of no more use.
    fn poll(&mut self, timeout: Duration, each: &mut dyn FnMut(&Picture<'_>)) -> Result<bool>;
}
