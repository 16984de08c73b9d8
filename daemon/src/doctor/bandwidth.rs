//! USB load of the cameras of a rig, link by link.
//!
//! A camera's images go over its own link, over the link of every hub above it, and through its controller; each has a
//! limit of its own.

use super::finding::{Finding, Severity};
use super::host::Host;
use super::plan::CameraPlan;
use crate::attached::Attached;
use crate::stream;
use depthrig_bus::Layout;
use depthrig_driver::StreamProfile;
use depthrig_libusb as libusb;
use depthrig_usb::health;
use serde::Serialize;
use std::collections::BTreeMap;

/// Most of a USB2 bus to plan with, Mbit/s of video: a rule of thumb of multi-camera set-ups, which leaves
/// room for hubs and retries.
const USB2_PLAN_MBIT_S: f64 = 300.0;
/// Most of a USB3 link or controller to plan with: 3 of its 5 Gbit/s, and the same share of faster ones.
const USB3_PLAN_SHARE: f64 = 0.6;
/// Bulk data that a USB2 bus can carry: 13 packets of 512 bytes in each of 8000 microframes a second (USB 2.0
/// specification, table 5-10).
const USB2_MOST_MBIT_S: f64 = 13.0 * 512.0 * 8.0 * 8000.0 / 1e6;
/// Share of 5 Gbit/s that the coding leaves: 8 bits of 10 (USB 3.2 specification, section 6.3.1.3).
const GEN1_CODING: f64 = 0.8;
/// Share of 10 Gbit/s and more that the coding leaves: 128 bits of 132 (same, section 6.3.2.1).
const GEN2_CODING: f64 = 128.0 / 132.0;

/// Bits of a pixel of MJPEG on the wire, at most, as cameras send it.
const MJPEG_BITS: f64 = 4.0;

/// The load of a link.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct LinkLoad {
    /// `port 4-1.2`, `hub 4-1`, `controller 0000:00:14.0`, in words.
    pub link: String,
    /// Cameras of the rig that go over it.
    pub cameras: Vec<String>,
    /// Its speed, Mbit/s.
    pub speed_mbps: u32,
    /// The load that they send, Mbit/s.
    pub load_mbit_s: f64,
    /// The load that may be planned with, Mbit/s.
    pub plan_mbit_s: f64,
    /// The load that it can carry, Mbit/s.
    pub most_mbit_s: f64,
}

/// USB load of a stream, bits a second. Colour is sent as YUYV or UYVY, 2 bytes a pixel, whatever it is turned
/// into afterwards; the rest is sent as it is delivered.
pub fn wire_bits_per_s(p: &StreamProfile) -> f64 {
    // Its reports are some kilobytes a second on an endpoint of their own.
    if p.format.is_motion() {
        return 0.0;
    }
    let bits = match p.format.layout() {
        Layout::Grey => f64::from(8 * p.format.sample().bytes()),
        Layout::Nv12 => 12.0,
        Layout::Jpeg => MJPEG_BITS,
        _ => 16.0,
    };
    f64::from(p.width) * f64::from(p.height) * bits * p.rate_hz
}

/// The load to plan with and the load that can be carried at a speed, Mbit/s.
fn limits(speed_mbps: u32) -> (f64, f64) {
    let speed = f64::from(speed_mbps);
    match speed_mbps {
        0..480 => (speed * USB3_PLAN_SHARE, speed),
        480..5000 => (USB2_PLAN_MBIT_S, USB2_MOST_MBIT_S),
        5000..10_000 => (speed * USB3_PLAN_SHARE, speed * GEN1_CODING),
        _ => (speed * USB3_PLAN_SHARE, speed * GEN2_CODING),
    }
}

/// The loads of every link that cameras of the rig go over, the fullest first. A link that carries one camera is that
/// camera's own; of hubs and controllers those are left out that carry the same cameras as a link below them.
pub(super) fn loads(plans: &[CameraPlan], attached: &Attached) -> Vec<LinkLoad> {
    let usb = |port: &str| attached.cameras.iter().find(|c| c.port == port).and_then(|c| c.usb.as_ref());
    let mut links: BTreeMap<(u8, String), LinkLoad> = BTreeMap::new();
    for plan in plans {
        let Some(device) = plan.port.as_deref().and_then(usb) else { continue };
        let load: f64 = plan.streams.iter().map(|s| s.usb_mbit_s).sum();
        let mut over = vec![(0, format!("USB port {}", device.port))];
        let mut above = device.port.as_str();
        while let Some((hub, _)) = above.rsplit_once('.') {
            over.push((1, format!("hub at USB port {hub}")));
            above = hub;
        }
        // The USB2 half of a controller is a bus of its own.
        let half = if device.speed_mbps < 5000 { "USB2" } else { "USB3" };
        over.push((2, format!("{half} of controller {}", device.controller)));
        for (level, link) in over {
            let entry = links.entry((level, link.clone())).or_insert_with(|| LinkLoad {
                link,
                cameras: Vec::new(),
                speed_mbps: 0,
                load_mbit_s: 0.0,
                plan_mbit_s: 0.0,
                most_mbit_s: 0.0,
            });
            entry.cameras.push(plan.name.clone());
            entry.load_mbit_s += load;
            // A hub is as fast as the fastest camera on it shows it to be.
            entry.speed_mbps = entry.speed_mbps.max(device.speed_mbps);
        }
    }
    let mut kept: Vec<LinkLoad> = Vec::new();
    for mut link in links.into_values() {
        if kept.iter().any(|k| k.cameras == link.cameras) {
            continue;
        }
        (link.plan_mbit_s, link.most_mbit_s) = limits(link.speed_mbps);
        kept.push(link);
    }
    kept.sort_by(|a, b| (b.load_mbit_s / b.plan_mbit_s).total_cmp(&(a.load_mbit_s / a.plan_mbit_s)));
    kept
}

/// Links that carry more than is planned with, or than they can.
pub(super) fn check(links: &[LinkLoad], findings: &mut Vec<Finding>) {
    for l in links.iter().filter(|l| l.load_mbit_s > l.plan_mbit_s) {
        let (severity, id) = if l.load_mbit_s > l.most_mbit_s {
            (Severity::Error, "bandwidth_exceeded")
        } else {
            (Severity::Warning, "bandwidth_tight")
        };
        let one = l.cameras.len() == 1;
        let finding = Finding::new(
            severity,
            id,
            format!(
                "{} ({} Mbit/s): {} would send {:.0} Mbit/s; plan with {:.0} at most, it carries {:.0}",
                l.link,
                l.speed_mbps,
                l.cameras.join(", "),
                l.load_mbit_s,
                l.plan_mbit_s,
                l.most_mbit_s
            ),
            "frames that find no room on the bus are lost, first when the computer is busy",
            if one {
                "ask for smaller or slower modes (15 Hz is enough for 5 sets a second), or a faster port"
            } else {
                "move cameras to another controller (depthrig cameras shows which port is on which), or ask for smaller or \
                 slower modes (15 Hz is enough for 5 sets a second)"
            },
        );
        findings.push(match l.cameras.as_slice() {
            [one] => finding.of(one),
            _ => finding,
        });
    }
}

/// The libusb path: the memory of its transfers against the kernel's limit.
pub(super) fn check_usbfs(plans: &[CameraPlan], host: &Host, findings: &mut Vec<Finding>) {
    let over: Vec<_> = plans.iter().filter(|p| p.libusb).collect();
    let captured = over.iter().flat_map(|p| &p.profiles).filter(|(p, _)| !stream::is_derived(&p.stream));
    let own: u64 = captured.map(|(p, _)| transfer_bytes(p)).sum();
    let needed = own + plans.iter().map(|p| p.transfer_bytes).sum::<u64>();
    if needed == 0 {
        return;
    }
    if let Some(what) = health::usbfs_too_small(&host.root, needed) {
        findings.push(Finding::new(
            Severity::Error,
            "usbfs_memory",
            what,
            "the camera over libusb whose transfers find no room does not start",
            "`sudo depthrig install --apply` writes a higher limit for every start; or write it now as the message says",
        ));
    }
}

/// Bytes that the kernel counts for the transfers of one stream over libusb: each holds an image with its header.
fn transfer_bytes(p: &StreamProfile) -> u64 {
    let image = (wire_bits_per_s(p) / p.rate_hz / 8.0) as usize;
    libusb::transfer_memory(libusb::Settings::default().transfers(), image + 1024)
}
