//! The vendor's own channel of a RealSense camera: requests out, replies in, without the extension unit's padding.

use super::camera::{Camera, Inner};
use super::errors::failed;
use crate::realsense::protocol::hwm::{HardwareMonitor, Request, UNIT_BYTES, reply_data};
use crate::{Error, ErrorKind, Result};
use core::time::Duration;
use std::sync::Arc;

/// How long a command may take (librealsense `src/hw-monitor.h`).
const COMMAND_TIMEOUT: Duration = Duration::from_secs(5);
/// How long stale replies are waited for before a request: they are there or they are not.
const STALE_WAIT: Duration = Duration::from_millis(1);
/// The most replies that are thrown away.
const MAX_STALE: u32 = 4;

/// The hardware monitor behind the vendor's bulk endpoints (0x01 out and 0x81 in on a D400).
#[derive(Debug)]
pub struct VendorBulk {
    camera: Arc<Inner>,
    out: u8,
    back: u8,
    /// A request was not answered: its reply may still come, and must not be taken for the next one's.
    stale: bool,
}

impl VendorBulk {
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
        Ok(Self { camera: inner, out: out.address, back: back.address, stale: false })
    }

    fn failed(&mut self, request: &Request, e: rusb::Error) -> Error {
        self.stale = true;
        if e == rusb::Error::Pipe {
            for endpoint in [self.out, self.back] {
                // If this fails too, the next request says so.
                let _ = self.camera.handle().clear_halt(endpoint);
            }
        }
        failed(self.camera.label(), &format!("hardware monitor: {request}"), e)
    }

    fn drop_stale_replies(&mut self) {
        let mut reply = [0; UNIT_BYTES];
        let mut left = MAX_STALE;
        while self.stale && left > 0 {
            left -= 1;
            self.stale = self.camera.handle().read_bulk(self.back, &mut reply, STALE_WAIT).is_ok();
        }
        self.stale = false;
    }
}

impl HardwareMonitor for VendorBulk {
    fn command(&mut self, request: &Request) -> Result<Vec<u8>> {
        self.drop_stale_replies();
        let bytes = request.to_bytes();
        let handle = self.camera.handle();
        let sent = handle.write_bulk(self.out, &bytes, COMMAND_TIMEOUT);
        match sent {
            // A restart may take the device away before the transfer is confirmed.
            Err(rusb::Error::NoDevice) if !request.is_answered() => return Ok(Vec::new()),
            Ok(n) if n == bytes.len() => {}
            Ok(_) => return Err(self.failed(request, rusb::Error::Io)),
            Err(e) => return Err(self.failed(request, e)),
        }
        if !request.is_answered() {
            return Ok(Vec::new());
        }
        let mut reply = [0; UNIT_BYTES];
        let n = match handle.read_bulk(self.back, &mut reply, COMMAND_TIMEOUT) {
            Ok(n) => n,
            Err(e) => return Err(self.failed(request, e)),
        };
        let answer = reply_data(request, reply.get(..n).unwrap_or_default());
        answer
            .map(<[u8]>::to_vec)
            .map_err(|e| Error::new(e.kind(), format!("{}: {e}", self.camera.label())).with_source(e))
    }
}
