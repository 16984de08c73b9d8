//! How a D400 is doing: its temperatures, and the codes of its error report.

use super::hwm::{HardwareMonitor, Request};
use super::protocol_error;
use depthrig_driver::Result;

/// Selector of the temperatures in the extension unit (librealsense `src/ds/ds-private.h`).
pub const TEMPERATURES_SELECTOR: u8 = 9;
/// Selector of the error report, one byte.
pub const ERROR_SELECTOR: u8 = 7;

/// Temperatures in °C; `None` where the camera says that it does not know.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Temperatures {
    /// Of the projector.
    pub projector_c: Option<i8>,
    /// Of the processor.
    pub asic_c: Option<i8>,
}

impl Temperatures {
    /// Reads the four bytes of [`TEMPERATURES_SELECTOR`]: two flags, two temperatures. The camera gives them only
    /// while it streams.
    pub const fn parse(bytes: [u8; 4]) -> Self {
        const fn known(valid: u8, c: u8) -> Option<i8> {
            if valid == 0 { None } else { Some(c as i8) }
        }
        let [projector_valid, asic_valid, projector, asic] = bytes;
        Self { projector_c: known(projector_valid, projector), asic_c: known(asic_valid, asic) }
    }

    /// The four bytes, for an emulated camera.
    pub fn build(&self) -> [u8; 4] {
        let byte = |c: Option<i8>| c.unwrap_or(0) as u8;
        [
            self.projector_c.is_some().into(),
            self.asic_c.is_some().into(),
            byte(self.projector_c),
            byte(self.asic_c),
        ]
    }
}

/// Temperature in °C by the hardware monitor (GTEMP), the first byte of its reply.
///
/// # Errors
/// Those of [`HardwareMonitor::command`]; [`depthrig_driver::ErrorKind::Protocol`] when the reply is empty.
pub fn temperature_c(monitor: &mut dyn HardwareMonitor) -> Result<i8> {
    let reply = monitor.command(&Request::temperature())?;
    reply.first().map(|c| *c as i8).ok_or_else(|| protocol_error("the reply about the temperature is empty"))
}

/// The meaning of a code of the error report; `None` for 0, no error (librealsense
/// `src/ds/d400/d400-private.h`, `d400_fw_error_report`).
pub fn error_report(code: u8) -> Option<String> {
    let text = match code {
        0 => return None,
        1 => "the laser is hot and its power was reduced; see to ventilation",
        2 => "the laser is too hot and was switched off; see to ventilation, then restart the camera",
        3 => "the laser was switched off by its safety circuit; restart the camera",
        4 => "the stereo module is not connected",
        5 => "the memory with the calibration is damaged (EEPROM)",
        6 => "the calibration is damaged; restore it with the vendor's calibration tool",
        7 => "an update of the motion module failed",
        8 => "an update of the image processor failed",
        9 => "the motion module was paused",
        10 => "the motion module failed",
        11 => "USB overflow (SCP): too much for this port or hub",
        12 => "USB overflow (REC): too much for this port or hub",
        13 => "USB overflow (CAM): too much for this port or hub",
        14 => "the link to the left imager fails (MIPI)",
        15 => "the link to the right imager fails (MIPI)",
        16 => "the link to the RT module fails (MIPI)",
        17 => "the link to the fisheye module fails (MIPI)",
        18 => "the left imager cannot be configured (I2C)",
        19 => "the right imager cannot be configured (I2C)",
        20 => "the RT module cannot be configured (I2C)",
        21 => "the fisheye module cannot be configured (I2C)",
        22 => "depth did not start",
        23 => "infrared did not start",
        24 => "colour did not start",
        25 => "the rectification unit failed (REC)",
        26 => "the limit of USB 2 was reached; use a USB 3 port and cable",
        27 => "the laser is too cold and was switched off",
        28 => "the temperature cannot be read, so the laser was switched off",
        29 => "the image processor could not load its data",
        other => return Some(format!("error {other}, which is not known")),
    };
    Some(text.to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn temperatures_by_hand() {
        let both = Temperatures { projector_c: Some(41), asic_c: Some(-5) };
        assert_eq!(Temperatures::parse([1, 1, 41, 0xFB]), both);
        assert_eq!(both.build(), [1, 1, 41, 0xFB]);
        assert_eq!(Temperatures::parse([0, 1, 41, 50]), Temperatures { projector_c: None, asic_c: Some(50) });
    }

    #[test]
    fn every_code_has_a_text_and_zero_is_no_error() {
        assert_eq!(error_report(0), None);
        let mut texts: Vec<_> = (1..=255).map(|c| error_report(c).unwrap()).collect();
        assert!(texts[1].contains("switched off"), "{}", texts[1]);
        assert!(texts[29].contains("30"), "{}", texts[29]);
        texts.sort();
        texts.dedup();
        assert_eq!(texts.len(), 255);
    }
}
