//! Lists the attached cameras and selects those that match a rig.

use super::models::{self, Model};
use depthrig_driver::{Error, ErrorKind, Result};
use depthrig_usb::UsbDevice;

/// Name of the family of [`cameras`], for the messages of [`candidates`].
pub const D400: &str = "RealSense D400";

/// An attached camera.
#[derive(Debug, Clone)]
pub struct FoundCamera {
    /// Its model.
    pub model: &'static Model,
    /// Its place on the USB.
    pub usb: UsbDevice,
}

impl FoundCamera {
    /// `D435 at USB port 4-1.2`, for messages.
    pub fn describe(&self) -> String {
        format!("{} at USB port {}", self.model.name, self.usb.port)
    }
}

/// The D400 among `devices`, in the order of their ports.
pub fn cameras(devices: Vec<UsbDevice>) -> Vec<FoundCamera> {
    let camera = |usb: UsbDevice| {
        let model = (usb.vendor_id == models::VENDOR).then(|| models::of_product(usb.product_id))??;
        Some(FoundCamera { model, usb })
    };
    devices.into_iter().filter_map(camera).collect()
}

/// The attached RealSense devices that cannot be used, one line each with the cure.
pub fn unusable(devices: &[UsbDevice]) -> Vec<String> {
    let intel = devices.iter().filter(|d| d.vendor_id == models::VENDOR);
    intel
        .filter_map(|d| models::undriven(d.product_id).map(|why| format!("{}: {why}", d.describe())))
        .collect()
}

/// The cameras of `found` that `port` and `serial` may mean; `what` is their
/// family in messages. The serial number on a camera is known
/// only after it was opened, so with one there may be several candidates.
///
/// # Errors
/// [`ErrorKind::NotFound`] when nothing is at the port, or nothing is attached, or more than one camera is and none was
/// named; the message lists what there is, and what of `unusable` explains it.
pub fn candidates(
    what: &str,
    found: Vec<FoundCamera>,
    port: Option<&str>,
    serial: Option<&str>,
    unusable: &[String],
) -> Result<Vec<FoundCamera>> {
    let list = |found: &[FoundCamera]| found.iter().map(FoundCamera::describe).collect::<Vec<_>>().join(", ");
    let not_found = |said: String, there_are: &[FoundCamera]| {
        let mut text = match there_are {
            [] => format!("{said}; no {what} is attached"),
            some => format!("{said}; there are: {}", list(some)),
        };
        for line in unusable {
            text = format!("{text}; {line}");
        }
        Error::new(ErrorKind::NotFound, text)
    };
    if let Some(port) = port {
        let (at_port, others): (Vec<_>, Vec<_>) = found.into_iter().partition(|f| f.usb.port == port);
        return if at_port.is_empty() {
            Err(not_found(format!("no {what} is at USB port {port}"), &others))
        } else {
            Ok(at_port)
        };
    }
    match (serial, found.as_slice()) {
        (Some(serial), []) => Err(not_found(format!("the {what} {serial} is not there"), &[])),
        (None, []) => Err(not_found(format!("the rig wants a {what}"), &[])),
        (Some(_), _) | (None, [_]) => Ok(found),
        (None, _) => {
            Err(not_found(format!("several {what} are attached, so name one by `serial` or `port`"), &found))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::RealsenseConfig;
    use depthrig_usb::PowerControl;

    fn usb(product_id: u16, port: &str) -> UsbDevice {
        UsbDevice {
            port: port.to_owned(),
            bus_number: 4,
            device_number: 7,
            vendor_id: 0x8086,
            product_id,
            device_version: 0,
            class: 0xEF,
            manufacturer: String::new(),
            product: "Intel(R) RealSense(TM)".to_owned(),
            serial: String::new(),
            speed_mbps: 5000,
            usb_version: 0x0320,
            controller: String::new(),
            power_control: PowerControl::On,
            node: "/dev/bus/usb/004/007".into(),
            interfaces: Vec::new(),
        }
    }

    fn at(port: &str) -> RealsenseConfig {
        RealsenseConfig { port: Some(port.to_owned()), ..RealsenseConfig::default() }
    }

    #[test]
    fn a_port_names_one_camera_and_a_serial_number_leaves_all() {
        let found = || cameras(vec![usb(0x0B07, "4-1"), usb(0x0B5B, "4-2"), usb(0x0B64, "4-3")]);
        assert_eq!(found().len(), 2, "an L515 is not among them");
        let ports = |c: &RealsenseConfig, s| -> Vec<String> {
            candidates(D400, found(), c.port.as_deref(), s, &[])
                .unwrap()
                .into_iter()
                .map(|f| f.usb.port)
                .collect()
        };
        assert_eq!(ports(&at("4-2"), None), ["4-2"]);
        assert_eq!(ports(&RealsenseConfig::default(), Some("x")), ["4-1", "4-2"]);
        let e = candidates(D400, found(), None, None, &[]).unwrap_err();
        assert_eq!(e.kind(), ErrorKind::NotFound);
        assert!(e.to_string().ends_with("there are: D435 at USB port 4-1, D405 at USB port 4-2"), "{e}");
        let e = candidates(D400, found(), Some("4-9"), None, &[]).unwrap_err();
        assert!(e.to_string().starts_with("no RealSense D400 is at USB port 4-9; there are: D435"), "{e}");
    }

    #[test]
    fn a_camera_in_recovery_explains_why_none_is_found() {
        let devices = vec![usb(0x0ADB, "4-1")];
        let why = unusable(&devices);
        let e = candidates(D400, cameras(devices), None, None, &why).unwrap_err();
        assert!(e.to_string().contains("rs-fw-update -r") && e.to_string().contains("4-1"), "{e}");
    }
}
