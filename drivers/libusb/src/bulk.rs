//! A vendor's own channel beside the images: a pair of bulk endpoints.

use super::camera::{Camera, Inner};
use super::errors::failed;
use core::time::Duration;
use depthrig_driver::{Error, ErrorKind, Result};
use std::sync::Arc;

/// The bulk endpoints of a camera's vendor interface (0x01 out and 0x81 in on a RealSense D400).
#[derive(Debug)]
pub struct BulkChannel {
    camera: Arc<Inner>,
    out: u8,
    back: u8,
}

impl BulkChannel {
    /// Takes the vendor's interface.
    ///
    /// # Errors
    /// [`ErrorKind::Unsupported`] when the camera has none, [`ErrorKind::Busy`] naming who holds it.
    pub fn new(camera: &Camera) -> Result<Self> {
        let inner = Arc::clone(&camera.inner);
        let Some((number, out, back)) = inner.configuration().vendor_channel() else {
            let text = format!("{}: it has no vendor interface with bulk endpoints", inner.label());
            return Err(Error::new(ErrorKind::Unsupported, text));
        };
        inner.claim(number)?;
        Ok(Self { camera: inner, out: out.address, back: back.address })
    }

    /// Model and port, for messages.
    pub fn label(&self) -> &str {
        self.camera.label()
    }

    /// Writes `bytes`; returns how many were taken.
    ///
    /// # Errors
    /// Those of libusb.
    pub fn write(&self, bytes: &[u8], timeout: Duration) -> rusb::Result<usize> {
        self.camera.handle().write_bulk(self.out, bytes, timeout)
    }

    /// Reads into `bytes`; returns how many came.
    ///
    /// # Errors
    /// Those of libusb.
    pub fn read(&self, bytes: &mut [u8], timeout: Duration) -> rusb::Result<usize> {
        self.camera.handle().read_bulk(self.back, bytes, timeout)
    }

    /// The error for `e` while doing `what`. Endpoints that it halted are cleared.
    pub fn failed(&self, what: &str, e: rusb::Error) -> Error {
        if e == rusb::Error::Pipe {
            for endpoint in [self.out, self.back] {
                // If this fails too, the next request says so.
                let _ = self.camera.handle().clear_halt(endpoint);
            }
        }
        failed(self.camera.label(), what, e)
    }
}
