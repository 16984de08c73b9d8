//! The hardware monitor behind the extension unit: 1024 bytes set, 1024 bytes got.

use super::{HardwareMonitor, Request, UNIT_BYTES, reply_data, unit_reply};
use core::time::Duration;
use depthrig_bus::HostTime;
use depthrig_driver::{Error, ErrorKind, Result};
use depthrig_usb::uvc::control::{ControlPort, Query};

/// Number of the extension unit on D400 and L515.
pub const UNIT_ID: u8 = 3;
/// Selector of the hardware monitor in that unit.
pub const UNIT_SELECTOR: u8 = 1;
/// GUID of the unit, `C9606CCB-594C-4D25-AF47-CCC496435995`, as it stands in a USB descriptor.
pub const UNIT_GUID: [u8; 16] =
    [0xCB, 0x6C, 0x60, 0xC9, 0x4C, 0x59, 0x25, 0x4D, 0xAF, 0x47, 0xCC, 0xC4, 0x96, 0x43, 0x59, 0x95];

/// How a camera that is not ready is asked again.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Retry {
    /// Pause before asking again.
    pub pause: Duration,
    /// No new try begins later than this after the first.
    pub limit: Duration,
}

impl Default for Retry {
    /// Every 20 ms for two seconds. The firmware needs some tens of milliseconds for its slowest tables; a request
    /// that took the kernel's whole control time-out (5 s) is not sent again.
    fn default() -> Self {
        Self { pause: Duration::from_millis(20), limit: Duration::from_secs(2) }
    }
}

/// Limit of answers in a row to other requests; more are not an accident.
const MAX_MIX_UPS: u32 = 2;

/// The hardware monitor of one camera by its extension unit. The exclusive borrow of the port keeps a request and
/// its reply together; threads share a monitor as `Arc<Mutex<_>>`.
///
/// Another process that asks the same camera can still come between. Its reply shows by the echo of another opcode,
/// and the request is sent again.
#[derive(Debug)]
pub struct UnitMonitor<P> {
    port: P,
    unit: u8,
    retry: Retry,
}

impl<P: ControlPort> UnitMonitor<P> {
    /// The monitor behind unit number `unit` of `port` (it is [`UNIT_ID`] on every camera known).
    pub const fn new(port: P, unit: u8, retry: Retry) -> Self {
        Self { port, unit, retry }
    }

    /// The port, for the other controls of the camera.
    pub const fn port(&mut self) -> &mut P {
        &mut self.port
    }

    /// The port alone.
    pub fn into_port(self) -> P {
        self.port
    }

    fn query(&mut self, query: Query, frame: &mut [u8]) -> Result<()> {
        self.port.query(self.unit, UNIT_SELECTOR, query, frame)
    }

    /// Asks again for as long as the answer is that the camera is not ready.
    fn patiently<T>(&mut self, last: HostTime, mut ask: impl FnMut(&mut Self) -> Result<T>) -> Result<T> {
        loop {
            match ask(self) {
                Err(e)
                    if matches!(e.kind(), ErrorKind::Busy | ErrorKind::Io)
                        && HostTime::now().plus(self.retry.pause) <= last =>
                {
                    std::thread::sleep(self.retry.pause);
                }
                done => return done,
            }
        }
    }

    /// One request and its reply.
    fn exchange(&mut self, request: &Request, last: HostTime) -> Result<Vec<u8>> {
        self.patiently(last, |m| m.query(Query::SetCur, &mut request.to_unit_frame()))?;
        let mut frame = [0; UNIT_BYTES];
        self.patiently(last, |m| m.query(Query::GetCur, &mut frame))?;
        reply_data(request, unit_reply(&frame)?).map(<[u8]>::to_vec)
    }

    /// A request after which the camera is gone.
    fn farewell(&mut self, request: &Request) -> Result<Vec<u8>> {
        match self.query(Query::SetCur, &mut request.to_unit_frame()) {
            // It may leave before it acknowledges.
            Err(e) if !matches!(e.kind(), ErrorKind::Disconnected | ErrorKind::Io) => Err(e),
            _ => Ok(Vec::new()),
        }
    }
}

impl<P: ControlPort> HardwareMonitor for UnitMonitor<P> {
    fn command(&mut self, request: &Request) -> Result<Vec<u8>> {
        let last = HostTime::now().plus(self.retry.limit);
        let mut mix_ups = 0;
        let asked = loop {
            if !request.is_answered() {
                break self.farewell(request);
            }
            match self.patiently(last, |m| m.exchange(request, last)) {
                Err(e) if e.kind() == ErrorKind::Protocol && mix_ups < MAX_MIX_UPS => mix_ups += 1,
                done => break done,
            }
        };
        asked.map_err(|e| Error::new(e.kind(), format!("hardware monitor: {e}")).with_source(e))
    }
}
