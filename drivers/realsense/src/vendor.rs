//! The hardware monitor through libusb: requests out, replies in, without the extension unit's padding.

use crate::protocol::hwm::{HardwareMonitor, Request, UNIT_BYTES, reply_data};
use core::time::Duration;
use depthrig_driver::{Error, Result};
use depthrig_libusb::{BulkChannel, Camera, UsbError};

/// How long a command may take (librealsense `src/hw-monitor.h`).
const COMMAND_TIMEOUT: Duration = Duration::from_secs(5);
/// How long stale replies are waited for before a request: they are there or they are not.
const STALE_WAIT: Duration = Duration::from_millis(1);
/// The most replies that are thrown away.
const MAX_STALE: u32 = 4;

/// The hardware monitor behind the vendor's bulk endpoints.
#[derive(Debug)]
pub struct VendorBulk {
    channel: BulkChannel,
    /// A request was not answered: its reply may still come, and must not be taken for the next one's.
    stale: bool,
}

impl VendorBulk {
    /// Takes the vendor's interface.
    ///
    /// # Errors
    /// Those of [`BulkChannel::new`].
    pub fn new(camera: &Camera) -> Result<Self> {
        Ok(Self { channel: BulkChannel::new(camera)?, stale: false })
    }

    fn failed(&mut self, request: &Request, e: UsbError) -> Error {
        self.stale = true;
        self.channel.failed(&format!("hardware monitor: {request}"), e)
    }

    fn drop_stale_replies(&mut self) {
        let mut reply = [0; UNIT_BYTES];
        let mut left = MAX_STALE;
        while self.stale && left > 0 {
            left -= 1;
            self.stale = self.channel.read(&mut reply, STALE_WAIT).is_ok();
        }
        self.stale = false;
    }
}

impl HardwareMonitor for VendorBulk {
    fn command(&mut self, request: &Request) -> Result<Vec<u8>> {
        self.drop_stale_replies();
        let bytes = request.to_bytes();
        match self.channel.write(&bytes, COMMAND_TIMEOUT) {
            // A restart may take the device away before the transfer is confirmed.
            Err(UsbError::NoDevice) if !request.is_answered() => return Ok(Vec::new()),
            Ok(n) if n == bytes.len() => {}
            Ok(_) => return Err(self.failed(request, UsbError::Io)),
            Err(e) => return Err(self.failed(request, e)),
        }
        if !request.is_answered() {
            return Ok(Vec::new());
        }
        let mut reply = [0; UNIT_BYTES];
        let n = match self.channel.read(&mut reply, COMMAND_TIMEOUT) {
            Ok(n) => n,
            Err(e) => return Err(self.failed(request, e)),
        };
        let answer = reply_data(request, reply.get(..n).unwrap_or_default());
        answer
            .map(<[u8]>::to_vec)
            .map_err(|e| Error::new(e.kind(), format!("{}: {e}", self.channel.label())).with_source(e))
    }
}
