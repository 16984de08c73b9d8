//! Attached cameras: every camera on the USB and every other video node, without disturbing one that is in use.
//!
//! The bus is read from `/sys`, so it is known whatever the permissions are. Nodes are opened only to ask the kernel
//! what they are. A camera itself (serial number, firmware, calibration, modes) is asked only when nobody has it;
//! about cameras that a running rig has open, that rig is asked.

mod ask;
mod classify;
mod served;
#[cfg(test)]
pub(crate) mod tests;

pub use ask::{Ask, NodeFacts, Served, System};
pub(crate) use served::place as place_of_served;

use crate::family::{self, Family, ImuFiles};
use crate::status::{CameraStatus, RigStatus};
use classify::Candidate;
use depthrig_bus::PixelFormat;
use depthrig_driver::{DeviceInfo, ErrorKind, StreamProfile};
use depthrig_realsense::iio;
use depthrig_usb::holder::{Holder, Holders, holders_of};
use depthrig_usb::{SysRoot, UsbDevice, VideoNode, health, scan, video_nodes};
use serde::Serialize;
use std::path::{Path, PathBuf};

/// Everything that is attached.
#[derive(Debug, Clone, Serialize)]
pub struct Attached {
    /// Cameras in the order of their ports, those on no USB after them.
    pub cameras: Vec<AttachedCamera>,
    /// Attached devices that cannot be used as a camera, one line each with what to do.
    pub unusable: Vec<String>,
    /// Cameras and rigs that could not be asked, one line each.
    pub not_asked: Vec<String>,
}

/// One camera.
#[derive(Debug, Clone, Serialize)]
pub struct AttachedCamera {
    /// The driver that it is for: `realsense`, `zed`, `kinect`, `v4l2`, `external`.
    pub backend: &'static str,
    /// Model, else the device's own name.
    pub model: String,
    /// Serial number as a rig file names it; `None` when it could not be asked.
    pub serial: Option<String>,
    /// Firmware; `None` when it could not be asked.
    pub firmware: Option<String>,
    /// Where its calibration comes from; `None` when it could not be asked.
    pub calibration: Option<String>,
    /// Port path on the USB, or the kernel's name of the device; RIG/CAMERA of one that another process serves.
    pub port: String,
    /// Vendor and product, such as `8086:0b07`; `None` on no USB.
    pub usb_id: Option<String>,
    /// Speed of its USB link, Mbit/s.
    pub usb_mbps: Option<u32>,
    /// The USB controller it shares with others.
    pub controller: Option<String>,
    /// Whether it can be used, and if not why.
    pub state: UseState,
    /// Whether the kernel may put it to sleep; `None` on no USB.
    pub may_sleep: Option<bool>,
    /// Processes that have it open.
    pub held_by: Vec<HeldBy>,
    /// The rig and camera that it is in a running rig of this user.
    pub rig: Option<String>,
    /// The camera's metadata that the kernel can give: `full`, `header` or `none`; `None` when it could not be asked.
    pub kernel_metadata: Option<&'static str>,
    /// Its nodes.
    pub nodes: Vec<NodeReport>,
    /// Its modes as a rig file names them; empty when it could not be asked.
    pub modes: Vec<ModeReport>,
    /// Problems of how it is attached, one line each with what to do.
    pub problems: Vec<String>,
    /// The device on the bus.
    #[serde(skip)]
    pub usb: Option<UsbDevice>,
    /// Its modes as drivers know them.
    #[serde(skip)]
    pub profiles: Vec<StreamProfile>,
}

/// Whether a camera can be used.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum UseState {
    /// Nobody has it.
    Free,
    /// Somebody has it.
    InUse,
    /// This user may not open it.
    Denied,
    /// It did not answer as it must.
    Failed,
    /// This version has no driver for it.
    NoDriver,
}

impl UseState {
    /// The name used in tables.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Free => "free",
            Self::InUse => "in use",
            Self::Denied => "denied",
            Self::Failed => "failed",
            Self::NoDriver => "no driver",
        }
    }
}

/// A process that has a camera open.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct HeldBy {
    /// Its process id.
    pub pid: u32,
    /// Its name.
    pub name: String,
}

impl From<Holder> for HeldBy {
    fn from(h: Holder) -> Self {
        Self { pid: h.pid, name: h.name }
    }
}

/// One node of a camera.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct NodeReport {
    /// Its path.
    pub path: String,
    /// `images`, `metadata`, `other`, `hid`, `usb`, or `unknown` when it could not be asked.
    pub role: &'static str,
    /// Its formats as V4L2 names them.
    pub formats: Vec<String>,
}

/// A mode as a rig file names it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ModeReport {
    /// `depth`, `color`, …
    pub stream: String,
    /// Pixel format.
    pub format: &'static str,
    /// Pixels per row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Frames a second.
    pub rate_hz: f64,
}

impl ModeReport {
    /// Samples a second of an IMU; `None` of images.
    pub fn samples_hz(&self) -> Option<f64> {
        (self.format == PixelFormat::Motion.name()).then(|| self.rate_hz * f64::from(self.width))
    }
}

impl From<&StreamProfile> for ModeReport {
    fn from(p: &StreamProfile) -> Self {
        let width = p.width;
        let height = p.height;
        Self { stream: p.stream.to_string(), format: p.format.name(), width, height, rate_hz: p.rate_hz }
    }
}

impl AttachedCamera {
    /// `D435 017322071234 at USB port 4-1.2`, for messages.
    pub fn describe(&self) -> String {
        let serial = self.serial.as_deref().map(|s| format!(" {s}")).unwrap_or_default();
        let place = if self.usb.is_some() { format!("USB port {}", self.port) } else { self.port.clone() };
        format!("{}{serial} at {place}", self.model)
    }

    /// `obs (process 4711)`, `camera "d435" of rig "mount"`, or as much as is known.
    pub fn held_words(&self) -> String {
        let processes: Vec<_> =
            self.held_by.iter().map(|h| format!("{} (process {})", h.name, h.pid)).collect();
        match (&self.rig, processes.as_slice()) {
            (Some(rig), _) => format!("rig {rig}"),
            (None, []) => "a process of another user (as root its name can be seen)".to_owned(),
            (None, some) => some.join(", "),
        }
    }
}

/// Looks at everything below `root`, asking with `ask`.
///
/// # Errors
/// Those of [`scan`] and [`video_nodes`].
pub fn look(root: &SysRoot, ask: &dyn Ask) -> crate::Result<Attached> {
    let devices = scan(root)?;
    let (rigs, mut not_asked) = ask.rigs();
    // One driver may have many cameras below one device; only the node says which it is of.
    let platform = video_nodes(root)?.into_iter().map(|node| match ask.node(&node.path) {
        Ok(facts) => (facts.bus, node),
        Err(_) => (node.parent.clone(), node),
    });
    let (candidates, unusable) = classify::cameras(&devices, platform);
    let mut cameras: Vec<_> = candidates.into_iter().map(|c| camera(root, ask, &rigs, c)).collect();
    cameras.extend(ask.served().into_iter().map(|s| served::camera(s, &rigs)));
    for c in cameras.iter().filter(|c| c.state == UseState::Denied) {
        not_asked.push(format!("{}: this user may not open it; {}", c.describe(), health::RULE_CURE));
    }
    Ok(Attached { cameras, unusable, not_asked })
}

fn camera(root: &SysRoot, ask: &dyn Ask, rigs: &[RigStatus], c: Candidate) -> AttachedCamera {
    let mut denied = false;
    let mut used_elsewhere = false;
    let mut metadata = None;
    let mut nodes: Vec<NodeReport> = c
        .found
        .nodes
        .iter()
        .map(|node| match ask.node(&node.path) {
            Ok(facts) => {
                used_elsewhere |= facts.used_elsewhere;
                if facts.role == "metadata" {
                    let full = facts.formats.iter().any(|f| f == "D4XX");
                    metadata = Some(if full { "full" } else { "header" });
                }
                NodeReport { path: shown(&node.path), role: facts.role, formats: facts.formats }
            }
            Err(e) => {
                denied |= e.kind() == ErrorKind::PermissionDenied;
                NodeReport { path: shown(&node.path), role: "unknown", formats: Vec::new() }
            }
        })
        .collect();
    let hid = c.found.hidraw.iter().map(|p| NodeReport { path: shown(p), role: "hid", formats: Vec::new() });
    nodes.extend(hid);
    let imu = match c.family.imu {
        ImuFiles::Hidraw => unreadable_hidraw(&c.found.hidraw, ask),
        ImuFiles::Iio => unreadable_iio(root, &c.port, ask),
        ImuFiles::None => None,
    };
    let holders = holders(root, &c);
    if let Some(usb) = &c.usb {
        nodes.push(NodeReport { path: shown(&usb.node), role: "usb", formats: Vec::new() });
    }
    let in_rig = rigs.iter().find_map(|rig| Some((rig, in_rig(rig, &c)?)));
    // Without the right to see every process, a busy node is the only sign of who streams.
    let in_use = in_rig.is_some() || !holders.others.is_empty() || (holders.hidden > 0 && used_elsewhere);
    let mut found = AttachedCamera {
        backend: c.family.name,
        model: c.found.model,
        serial: c.found.serial,
        firmware: None,
        calibration: None,
        port: c.port,
        usb_id: c.usb.as_ref().map(UsbDevice::id),
        usb_mbps: c.usb.as_ref().map(|d| d.speed_mbps),
        controller: c.usb.as_ref().map(|d| d.controller.clone()),
        state: UseState::Free,
        may_sleep: c.usb.as_ref().map(|d| health::may_sleep(d).is_some()),
        held_by: holders.others.into_iter().map(HeldBy::from).collect(),
        rig: in_rig.map(|(rig, camera)| format!("\"{}\", camera \"{}\"", rig.rig, camera.name)),
        kernel_metadata: metadata,
        nodes,
        modes: Vec::new(),
        problems: c
            .usb
            .as_ref()
            .and_then(health::slow_link)
            .into_iter()
            .chain(imu)
            .chain(c.found.problem)
            .collect(),
        usb: c.usb,
        profiles: Vec::new(),
    };
    match in_rig {
        _ if denied && in_rig.is_none() => found.state = UseState::Denied,
        Some((_, camera)) => {
            found.state = UseState::InUse;
            let said = |text: &str| (!text.is_empty()).then(|| text.to_owned());
            found.serial = said(&camera.serial).or(found.serial);
            found.firmware = said(&camera.firmware);
            found.calibration = said(&camera.calibration);
            if !camera.model.is_empty() {
                found.model.clone_from(&camera.model);
            }
        }
        None if in_use => found.state = UseState::InUse,
        None if c.family.probe.is_none() => known_unasked(&mut found, c.found.idle_serial, ask),
        None => ask_device(&mut found, c.family, ask),
    }
    found
}

/// Why the IMU of a camera cannot be read through its raw HID nodes, if so.
fn unreadable_hidraw(nodes: &[PathBuf], ask: &dyn Ask) -> Option<String> {
    let denied = nodes.iter().find(|node| !ask.may_open(node))?;
    Some(format!(
        "its IMU {} may not be opened, so that it has no stream imu: {} and plug the camera in again",
        denied.display(),
        health::RULE_CURE
    ))
}

/// Why this user cannot read or switch on the kernel's sensors of an IMU, if so.
fn unreadable_iio(root: &SysRoot, port: &str, ask: &dyn Ask) -> Option<String> {
    let sensors = iio::on_port(root, port);
    let files = sensors.iter().flat_map(|s| s.switches().into_iter().chain([s.node.clone()]));
    let denied = files.into_iter().find(|file| !ask.may_open(file))?;
    Some(format!(
        "its IMU cannot be read, because {} may not be opened, so that it has no stream imu: {} and plug the camera in again",
        denied.display(),
        health::RULE_CURE
    ))
}

/// Fills in the facts about a camera that are known without asking it, which only the process that drives it may.
fn known_unasked(found: &mut AttachedCamera, serial: Option<String>, ask: &dyn Ask) {
    found.serial = serial;
    if found.usb.as_ref().is_some_and(|usb| !ask.may_open(&usb.node)) {
        found.state = UseState::Denied;
    }
}

/// Opens a camera that nobody has and notes its answers.
fn ask_device(found: &mut AttachedCamera, family: &Family, ask: &dyn Ask) {
    match ask.device(family, &found.port) {
        Some(Ok((info, profiles))) => {
            let DeviceInfo { model, serial, firmware, calibration, .. } = info;
            if !model.is_empty() {
                found.model = model;
            }
            let said = |text: String| (!text.is_empty()).then_some(text);
            (found.serial, found.firmware) = (said(serial).or(found.serial.take()), said(firmware));
            found.calibration = said(calibration);
            found.modes = profiles.iter().map(ModeReport::from).collect();
            found.profiles = profiles;
        }
        Some(Err(e)) => {
            found.state = match e.kind() {
                ErrorKind::Busy => UseState::InUse,
                ErrorKind::PermissionDenied => UseState::Denied,
                _ => UseState::Failed,
            };
            found.problems.push(e.to_string());
        }
        None => found.state = UseState::NoDriver,
    }
}

/// Who has any of the camera's nodes open.
fn holders(root: &SysRoot, c: &Candidate) -> Holders {
    let mut all = Holders::default();
    let video = c.found.nodes.iter().map(|n| n.path.as_path());
    for node in video.chain(c.usb.as_ref().map(|d| d.node.as_path())) {
        let found = holders_of(root, node);
        all.others.extend(found.others);
        all.own |= found.own;
        all.hidden = all.hidden.max(found.hidden);
    }
    all.others.sort();
    all.others.dedup();
    all
}

/// The camera of a running rig that `c` is.
fn in_rig<'r>(rig: &'r RigStatus, c: &Candidate) -> Option<&'r CameraStatus> {
    let has_ports = |name: &str| family::find(name).is_none_or(|f| f.has_ports);
    let driven = |camera: &&CameraStatus| camera.backend != "replay" && has_ports(&camera.backend);
    rig.cameras.iter().filter(driven).find(|camera| camera.port == c.port && !c.port.is_empty())
}

fn shown(path: &Path) -> String {
    path.display().to_string()
}
