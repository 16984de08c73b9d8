//! Which devices are cameras, and of which family.

use super::{UsbDevice, VideoNode};
use crate::family::{self, Family, Found, Identified};

/// A camera as the bus shows it.
pub(super) struct Candidate {
    pub(super) family: &'static Family,
    pub(super) port: String,
    pub(super) usb: Option<UsbDevice>,
    pub(super) found: Found,
}

/// The cameras among `devices` and `platform` nodes, each with its port, and attached devices that are unusable.
pub(super) fn cameras(
    devices: &[UsbDevice],
    platform: impl Iterator<Item = (String, VideoNode)>,
) -> (Vec<Candidate>, Vec<String>) {
    let mut cameras = Vec::new();
    let mut unusable = Vec::new();
    for d in devices {
        match family::identify(d, devices) {
            Some((family, Identified::Camera(found) | Identified::Generic(found))) => {
                cameras.push(Candidate { family, port: d.port.clone(), usb: Some(d.clone()), found });
            }
            Some((_, Identified::Unusable(why))) => unusable.push(format!("{}: {why}", d.describe())),
            Some((_, Identified::Part)) | None => {}
        }
    }
    for (place, node) in platform {
        match cameras.iter_mut().find(|c| c.usb.is_none() && c.port == place) {
            Some(camera) => camera.found.nodes.push(node),
            None => cameras.push(Candidate {
                family: family::PLATFORM,
                port: place,
                usb: None,
                found: Found { model: node.name.clone(), nodes: vec![node], ..Found::default() },
            }),
        }
    }
    (cameras, unusable)
}
