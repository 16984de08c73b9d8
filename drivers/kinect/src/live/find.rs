//! Finds the Kinects on the USB: a depth camera and a colour camera behind a hub of their own, in one housing.
//!
//! This is read from `/sys`, without libk4a and without opening anything. The serial number is that of the colour
//! camera's descriptor, which libk4a itself pairs the halves by (`uvc_camerareader.cpp`).

use depthrig_driver::{Error, ErrorKind, Result};
use depthrig_usb::UsbDevice;

/// Microsoft.
pub const VENDOR: u16 = 0x045e;
/// The depth camera.
pub const DEPTH: u16 = 0x097c;
/// The colour camera, with the motion sensors.
pub const COLOR: u16 = 0x097d;

/// A Kinect on the bus.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FoundCamera {
    /// The depth half: the one whose port the camera goes by.
    pub depth: UsbDevice,
    /// The colour half, if it is there.
    pub color: Option<UsbDevice>,
}

impl FoundCamera {
    /// The serial number, if the descriptors have one.
    pub fn serial(&self) -> Option<&str> {
        let halves = self.color.iter().chain([&self.depth]);
        halves.map(|d| d.serial.as_str()).find(|s| !s.is_empty())
    }

    /// `Azure Kinect 000123456789 at USB port 2-1.1`, for messages.
    pub fn describe(&self) -> String {
        describe(self.serial().unwrap_or_default(), &self.depth.port)
    }
}

/// Name of a camera, for messages.
pub fn describe(serial: &str, port: &str) -> String {
    let serial = if serial.is_empty() { String::new() } else { format!(" {serial}") };
    let port = if port.is_empty() { String::new() } else { format!(" at USB port {port}") };
    format!("{MODEL}{serial}{port}")
}

/// The model's name.
pub const MODEL: &str = "Azure Kinect";

/// The Kinects among `devices`, which is what [`depthrig_usb::scan`] gave.
pub fn cameras(devices: &[UsbDevice]) -> Vec<FoundCamera> {
    let mut colors: Vec<&UsbDevice> = devices.iter().filter(|d| is(d, COLOR)).collect();
    let mut found: Vec<FoundCamera> = devices
        .iter()
        .filter(|d| is(d, DEPTH))
        .map(|d| FoundCamera { depth: d.clone(), color: None })
        .collect();
    // Behind the hub in the housing; where the bus does not show it, a half with the same serial number.
    for same in [
        (|a: &UsbDevice, b: &UsbDevice| hub(&a.port).is_some() && hub(&a.port) == hub(&b.port))
            as fn(&_, &_) -> _,
        |a, b| !a.serial.is_empty() && a.serial == b.serial,
    ] {
        for camera in found.iter_mut().filter(|f| f.color.is_none()) {
            if let Some(at) = colors.iter().position(|c| same(c, &camera.depth)) {
                camera.color = Some(colors.remove(at).clone());
            }
        }
    }
    // One of each can only belong together.
    let mut alone = found.iter_mut().filter(|f| f.color.is_none());
    if let (Some(camera), None, [color]) = (alone.next(), alone.next(), colors.as_slice()) {
        camera.color = Some((*color).clone());
    }
    found
}

fn is(device: &UsbDevice, product: u16) -> bool {
    (device.vendor_id, device.product_id) == (VENDOR, product)
}

/// The port of the hub that the device at `port` hangs on.
fn hub(port: &str) -> Option<&str> {
    port.rsplit_once('.').map(|(hub, _)| hub)
}

/// The one among `found` that a rig means by its port.
///
/// # Errors
/// [`ErrorKind::NotFound`] listing what is attached.
pub fn at_port<'f>(found: &'f [FoundCamera], port: &str) -> Result<&'f FoundCamera> {
    let camera = found.iter().find(|f| f.depth.port == port);
    camera.ok_or_else(|| {
        let list = found.iter().map(FoundCamera::describe).collect::<Vec<_>>().join(", ");
        let attached =
            if list.is_empty() { "none is attached".to_owned() } else { format!("attached: {list}") };
        Error::new(ErrorKind::NotFound, format!("there is no {MODEL} at USB port {port}; {attached}"))
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use depthrig_usb::fake::{FakeDevice, FakeTree};
    use depthrig_usb::scan;

    fn half(port: &str, product: u16, serial: &'static str) -> FakeDevice {
        let strings = ["Microsoft Corp.", "", serial];
        FakeDevice { id: (VENDOR, product), strings, interfaces: vec![], ..FakeDevice::new(port, 0) }
    }

    #[test]
    fn halves_behind_one_hub_are_one_camera() {
        let home = tempfile::tempdir().unwrap();
        let tree = FakeTree::new(home.path());
        tree.plug(&half("2-1.1", DEPTH, "000111111111"));
        tree.plug(&half("2-1.2", COLOR, "000111111111"));
        tree.plug(&half("2-3.1", DEPTH, "000222222222"));
        tree.plug(&half("2-3.2", COLOR, "000222222222"));
        tree.plug(&FakeDevice::new("4-1", 0));
        let found = cameras(&scan(tree.root()).unwrap());
        let cameras: Vec<_> = found.iter().map(|f| (f.depth.port.as_str(), f.serial().unwrap())).collect();
        assert_eq!(cameras, [("2-1.1", "000111111111"), ("2-3.1", "000222222222")]);
        assert_eq!(found[1].color.as_ref().unwrap().port, "2-3.2");
        assert_eq!(at_port(&found, "2-3.1").unwrap(), &found[1]);
        let e = at_port(&found, "9-9").unwrap_err();
        assert!(e.to_string().contains("000111111111 at USB port 2-1.1"), "{e}");
    }

    #[test]
    fn a_half_alone_is_reported_as_such() {
        let home = tempfile::tempdir().unwrap();
        let tree = FakeTree::new(home.path());
        tree.plug(&half("2-1.1", DEPTH, ""));
        let found = cameras(&scan(tree.root()).unwrap());
        assert_eq!((found.len(), found[0].color.is_none(), found[0].serial()), (1, true, None));
        assert_eq!(found[0].describe(), "Azure Kinect at USB port 2-1.1");
        // Not behind hubs that the bus shows, and the only ones there are.
        let tree = FakeTree::new(&home.path().join("other"));
        tree.plug(&half("2-1", DEPTH, ""));
        tree.plug(&half("2-2", COLOR, "000333333333"));
        assert_eq!(cameras(&scan(tree.root()).unwrap())[0].serial(), Some("000333333333"));
    }
}
