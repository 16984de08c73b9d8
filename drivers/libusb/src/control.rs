//! Requests to the control units of a camera, over its default pipe.

use super::camera::{CONTROL_TIMEOUT, Camera, Inner};
use super::errors::failed;
use depthrig_driver::{Error, ErrorKind, Result};
use depthrig_usb::uvc::control::{ControlPort, Query};
use std::sync::Arc;

/// To the device, class, interface (USB 3.2, table 9-2).
const CLASS_OUT: u8 = 0x21;
/// To the host, class, interface.
const CLASS_IN: u8 = 0xA1;

/// Unit 0, which is the interface itself: why the last request was refused (UVC 1.5, table 4-6 and section 4.2.1.2).
const REQUEST_ERROR_CODE: u8 = 0x02;

/// The control units of one function, addressed by its control interface.
#[derive(Debug, Clone)]
pub struct Port {
    camera: Arc<Inner>,
    interface: u8,
}

impl Port {
    /// The units of control interface `interface`.
    ///
    /// # Errors
    /// [`ErrorKind::Unsupported`] when the camera does not have the control interface.
    pub fn new(camera: &Camera, interface: u8) -> Result<Self> {
        let camera = Arc::clone(&camera.inner);
        if camera.configuration().controls.iter().all(|c| c.number != interface) {
            let text = format!("{}: it has no control interface {interface}", camera.label());
            return Err(Error::new(ErrorKind::Unsupported, text));
        }
        Ok(Self { camera, interface })
    }

    /// Why a request was refused, as the error says it.
    fn refusal(&self, unit: u8, selector: u8) -> Error {
        let mut code = [0];
        let label = self.camera.label();
        let known = unit != 0
            && request(&self.camera, self.interface, 0, REQUEST_ERROR_CODE, Query::GetCur, &mut code).is_ok();
        let (kind, why) = match (known, code) {
            (true, [1]) => (ErrorKind::Busy, "it is not ready".to_owned()),
            (true, [2]) => (ErrorKind::Protocol, "not in this state".to_owned()),
            (true, [3]) => (ErrorKind::Protocol, "not enough power".to_owned()),
            (true, [4]) => (ErrorKind::BadInput, "out of range".to_owned()),
            (true, [5]) => (ErrorKind::Unsupported, "there is no such unit".to_owned()),
            (true, [6]) => (ErrorKind::Unsupported, "there is no such control".to_owned()),
            (true, [7]) => (ErrorKind::Protocol, "no such request".to_owned()),
            (true, [8]) => (ErrorKind::BadInput, "an invalid value".to_owned()),
            _ => (ErrorKind::Protocol, "it does not say why".to_owned()),
        };
        Error::new(kind, format!("{label}: control {selector} of unit {unit} was refused: {why}"))
    }
}

impl ControlPort for Port {
    fn query(&mut self, unit: u8, selector: u8, query: Query, data: &mut [u8]) -> Result<()> {
        let asked = data.len();
        match request(&self.camera, self.interface, unit, selector, query, data) {
            Ok(n) if n == asked => Ok(()),
            Ok(n) => Err(Error::new(
                ErrorKind::Protocol,
                format!(
                    "{}: control {selector} of unit {unit} has {n} bytes, {asked} were asked for",
                    self.camera.label()
                ),
            )),
            Err(rusb::Error::Pipe) => Err(self.refusal(unit, selector)),
            Err(e) => Err(failed(self.camera.label(), &format!("control {selector} of unit {unit}"), e)),
        }
    }
}

/// One class request to an interface, or to a unit of it.
pub(super) fn request(
    camera: &Inner,
    interface: u8,
    unit: u8,
    selector: u8,
    query: Query,
    data: &mut [u8],
) -> rusb::Result<usize> {
    let value = u16::from(selector) << 8;
    let index = u16::from(unit) << 8 | u16::from(interface);
    let handle = camera.handle();
    match query {
        Query::SetCur => handle.write_control(CLASS_OUT, query as u8, value, index, data, CONTROL_TIMEOUT),
        _ => handle.read_control(CLASS_IN, query as u8, value, index, data, CONTROL_TIMEOUT),
    }
}
