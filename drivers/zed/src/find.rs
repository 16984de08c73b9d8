//! Finds the attached cameras: the video half, and the IMU in the same housing.
//!
//! The two are devices of their own. On USB 2 both are behind the camera's hub. On USB 3 the video half is on the fast
//! lines and the IMU behind the hub on the slow ones, so that they have different buses; the kernel knows
//! which two ports are one socket and links them (`port/peer`, Documentation/ABI/testing/sysfs-bus-usb).

use depthrig_driver::{Error, ErrorKind, Result};
use depthrig_usb::{SysRoot, UsbDevice};

/// Stereolabs.
pub const VENDOR_ID: u16 = 0x2b03;

/// A camera model.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Model {
    /// Its name.
    pub name: &'static str,
    /// Product of the video half.
    pub video: u16,
    /// Product of the IMU; the first ZED has none.
    pub motion: Option<u16>,
}

/// The models that are known. Only the ZED 2i is tested; the others speak the same way.
pub const MODELS: [Model; 4] = [
    Model { name: "ZED 2i", video: 0xf880, motion: Some(0xf881) },
    Model { name: "ZED 2", video: 0xf780, motion: Some(0xf781) },
    Model { name: "ZED-M", video: 0xf682, motion: Some(0xf681) },
    Model { name: "ZED", video: 0xf582, motion: None },
];

/// An attached camera.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FoundCamera {
    /// Its model.
    pub model: Model,
    /// The video half.
    pub video: UsbDevice,
    /// The IMU, if it was found.
    pub motion: Option<UsbDevice>,
}

impl FoundCamera {
    /// The serial number as far as it is known without opening the camera: that of the IMU.
    pub fn serial(&self) -> Option<&str> {
        self.motion.as_ref().map(|m| m.serial.as_str()).filter(|s| !s.is_empty())
    }

    /// `ZED 2i 31234 at USB port 4-1`, for messages.
    pub fn describe(&self) -> String {
        describe(self.model.name, self.serial().unwrap_or_default(), &self.video.port)
    }

    /// Versions of both halves' firmware.
    pub fn firmware(&self) -> String {
        let version = |d: &UsbDevice| format!("{}.{}", d.device_version >> 8, d.device_version & 0xFF);
        match &self.motion {
            Some(motion) => format!("{} (IMU {})", version(&self.video), version(motion)),
            None => version(&self.video),
        }
    }
}

/// Name of a camera, for messages.
pub fn describe(model: &str, serial: &str, port: &str) -> String {
    let space = if serial.is_empty() { "" } else { " " };
    format!("{model}{space}{serial} at USB port {port}")
}

/// The cameras among `devices`, which is what [`depthrig_usb::scan`] gave for `root`, by port.
pub fn cameras(root: &SysRoot, devices: &[UsbDevice]) -> Vec<FoundCamera> {
    let mut found = Vec::new();
    for video in devices.iter().filter(|d| d.vendor_id == VENDOR_ID) {
        let Some(model) = MODELS.into_iter().find(|m| m.video == video.product_id) else { continue };
        found.push(FoundCamera { model, video: video.clone(), motion: None });
    }
    let places: Vec<Vec<String>> = found.iter().map(|f| hubs(root, &f.video.port)).collect();
    let mut motions: Vec<&UsbDevice> =
        devices.iter().filter(|d| d.vendor_id == VENDOR_ID && !d.serial.is_empty()).collect();
    for (camera, hubs) in found.iter_mut().zip(&places) {
        let product = camera.model.motion;
        let mine = |d: &UsbDevice| Some(d.product_id) == product && hubs.iter().any(|h| behind(&d.port, h));
        if let Some(at) = motions.iter().position(|d| mine(d)) {
            camera.motion = Some(motions.remove(at).clone());
        }
    }
    // A computer whose kernel does not know which ports are one socket: one of each can only belong together.
    for model in MODELS {
        let mut alone = found.iter_mut().filter(|f| f.model == model && f.motion.is_none());
        let mut units = motions.iter().filter(|d| Some(d.product_id) == model.motion);
        if let (Some(camera), None, Some(unit), None) =
            (alone.next(), alone.next(), units.next(), units.next())
        {
            camera.motion = Some((*unit).clone());
        }
    }
    found
}

/// The IMU of `model` with this serial number: that of the camera, wherever it is.
pub fn imu<'d>(devices: &'d [UsbDevice], model: Model, serial: &str) -> Option<&'d UsbDevice> {
    devices.iter().find(|d| {
        d.vendor_id == VENDOR_ID
            && Some(d.product_id) == model.motion
            && d.serial == serial
            && !serial.is_empty()
    })
}

/// Ports at which the hub of the camera may be whose video half is at `port`: the one it is behind, and the slow
/// halves of its own socket and of that one.
fn hubs(root: &SysRoot, port: &str) -> Vec<String> {
    let parent = port.rsplit_once('.').map(|(parent, _)| parent.to_owned());
    let peers = [Some(port.to_owned()), parent.clone()].into_iter().flatten().filter_map(|p| peer(root, &p));
    let peers: Vec<_> = peers.collect();
    parent.into_iter().chain(peers).collect()
}

/// Whether `port` is directly behind the hub at `hub`.
fn behind(port: &str, hub: &str) -> bool {
    port.strip_prefix(hub).and_then(|rest| rest.strip_prefix('.')).is_some_and(|n| !n.contains('.'))
}

/// The port that is the other half of the same socket: `usb1-port3` is `1-3`, `1-2-port3` is `1-2.3`.
fn peer(root: &SysRoot, port: &str) -> Option<String> {
    let link = root.join(format!("sys/bus/usb/devices/{port}/port/peer")).canonicalize().ok()?;
    let (hub, number) = link.file_name()?.to_str()?.rsplit_once("-port")?;
    Some(match hub.strip_prefix("usb") {
        Some(bus) => format!("{bus}-{number}"),
        None => format!("{hub}.{number}"),
    })
}

/// The cameras that match a port and a serial number, either of which may be left open. A camera whose serial number
/// is not known yet matches any.
///
/// # Errors
/// [`ErrorKind::NotFound`] listing what is attached if no camera matches, or if several do and none is named.
pub fn candidates(
    found: Vec<FoundCamera>,
    port: Option<&str>,
    serial: Option<&str>,
) -> Result<Vec<FoundCamera>> {
    let list = found.iter().map(FoundCamera::describe).collect::<Vec<_>>().join(", ");
    let attached =
        if list.is_empty() { "no ZED is attached".to_owned() } else { format!("attached: {list}") };
    let not_found = |what: String| Err(Error::new(ErrorKind::NotFound, format!("{what}; {attached}")));
    let wanted: Vec<FoundCamera> = found
        .into_iter()
        .filter(|f| port.is_none_or(|p| p == f.video.port))
        .filter(|f| serial.is_none_or(|s| f.serial().is_none_or(|known| known == s)))
        .collect();
    match (wanted.len(), port, serial) {
        (0, Some(p), _) => not_found(format!("there is no such ZED at USB port {p}")),
        (0, None, Some(s)) => not_found(format!("there is no ZED with serial number {s}")),
        (0, None, None) => not_found("there is no ZED; is it plugged in?".to_owned()),
        (n, None, None) if n > 1 => {
            not_found("several ZEDs are attached; select one with serial = \"…\" or port = \"…\"".to_owned())
        }
        _ => Ok(wanted),
    }
}

#[cfg(test)]
mod tests;
