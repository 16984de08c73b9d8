//! Requests that differ between a D400 and an L515 while they stream.

use super::protocol::health::{self, Temperatures};
use super::protocol::hwm::{HardwareMonitor, Request, UNIT_ID};
use super::protocol::l515;
use depthrig_driver::Result;
use depthrig_usb::uvc::control::{ControlPort, Query};

/// A family of cameras.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Family {
    /// D400.
    D4xx,
    /// L515.
    L515,
}

impl Family {
    /// The request for its clock: 32 bits of microseconds.
    pub(super) fn clock(self) -> Request {
        match self {
            Self::D4xx => Request::clock(),
            Self::L515 => Request::l515_clock(),
        }
    }

    /// Selector of the error report in the extension unit.
    pub(super) const fn error_selector(self) -> u8 {
        match self {
            Self::D4xx => health::ERROR_SELECTOR,
            Self::L515 => l515::ERROR_SELECTOR,
        }
    }

    /// The meaning of one of its error codes; `None` for 0.
    pub(super) fn error_report(self, code: u8) -> Option<String> {
        match self {
            Self::D4xx => health::error_report(code),
            Self::L515 => l515::error_report(code),
        }
    }

    /// Temperature in °C nearest to the sensor; NaN where the camera does not know.
    ///
    /// # Errors
    /// Those of the ways to the camera.
    pub(super) fn temperature_c(
        self,
        monitor: &mut dyn HardwareMonitor,
        port: &mut dyn ControlPort,
    ) -> Result<f32> {
        match self {
            Self::D4xx => {
                let mut bytes = [0; 4];
                port.query(UNIT_ID, health::TEMPERATURES_SELECTOR, Query::GetCur, &mut bytes)?;
                // The projector sits between the imagers; the processor is further away.
                let Temperatures { projector_c, asic_c } = Temperatures::parse(bytes);
                Ok(projector_c.or(asic_c).map_or(f32::NAN, f32::from))
            }
            Self::L515 => Ok(l515::Temperatures::read(monitor)?.receiver_c as f32),
        }
    }
}
