//! The cameras of the rig file against the attached ones: found or not, with which modes, in which state.

use super::finding::{Finding, Severity};
use super::plan::{CameraPlan, Planned, mode_missing, no_plan, set_streams};
use super::served;
use crate::attached::{Attached, AttachedCamera, UseState};
use crate::config::{CameraConfig, RigConfig};
use crate::family::{self, Offered, Selector, Source};
use depthrig_driver::{Result, StreamProfile, choose_profiles};
use depthrig_usb::health::{self, RULE_CURE};

/// The camera's streams when the rig runs: its own, and those computed from its left and right images.
fn with_stereo(camera: &CameraConfig, device: &str, own: Vec<StreamProfile>) -> Result<Vec<StreamProfile>> {
    match &camera.stereo {
        Some(stereo) => depthrig_stereo::offered(device, &own, &stereo.options()),
        None => Ok(own),
    }
}

/// Plans every camera of `config`.
pub(super) fn plan(config: &RigConfig, attached: &Attached) -> Vec<Planned> {
    let plan_one = |camera: &CameraConfig| match camera.backend.source() {
        Source::Attached(selector) => plan_device(camera, camera.backend.name(), &selector, attached),
        Source::Served(service) => served::plan(camera, config.rig.as_str(), &service, attached),
        Source::Here(offered) => plan_here(camera, offered),
    };
    config.cameras.iter().map(plan_one).collect()
}

/// A camera that is a device of the family that `backend` drives.
pub(super) fn plan_device(
    camera: &CameraConfig,
    backend: &'static str,
    wanted: &Selector<'_>,
    attached: &Attached,
) -> Planned {
    let mut findings = Vec::new();
    let mut plan = CameraPlan { libusb: wanted.libusb, ..no_plan(camera, backend) };
    if let Some(device) = find(backend, wanted, attached, &mut findings) {
        plan.device = Some(device.describe());
        plan.port = Some(device.port.clone());
        plan.transfer_bytes = wanted.transfer_bytes;
        check_device(device, wanted, &mut findings);
        if !device.profiles.is_empty() {
            let name = device.describe();
            let offered = with_stereo(camera, &name, device.profiles.clone());
            match offered.and_then(|all| choose_profiles(&name, &all, &camera.streams)) {
                Ok(chosen) => set_streams(&mut plan, camera, chosen, device.usb.is_some(), &mut findings),
                Err(e) => findings.push(mode_missing(device, &e.to_string())),
            }
        }
    }
    let findings = findings.into_iter().map(|f| f.of(camera.name.as_str())).collect();
    Planned { plan, findings }
}

/// The plan of a camera without a device.
fn plan_here(camera: &CameraConfig, offered: Result<Offered>) -> Planned {
    let mut plan = no_plan(camera, camera.backend.name());
    let chosen = offered.and_then(|Offered { device, profiles }| {
        let chosen = choose_profiles(&device, &with_stereo(camera, &device, profiles)?, &camera.streams)?;
        Ok((device, chosen))
    });
    let mut findings = Vec::new();
    match chosen {
        Ok((device, chosen)) => {
            plan.device = Some(device);
            set_streams(&mut plan, camera, chosen, false, &mut findings);
        }
        Err(e) => findings.push(
            Finding::new(
                Severity::Error,
                "camera_unusable",
                e.to_string(),
                "the rig does not start with a camera that cannot work",
                "correct what the message names",
            )
            .of(camera.name.as_str()),
        ),
    }
    Planned { plan, findings }
}

/// The attached camera that `wanted` selects; adds a finding when it is missing or ambiguous.
fn find<'a>(
    backend: &str,
    wanted: &Selector<'_>,
    attached: &'a Attached,
    findings: &mut Vec<Finding>,
) -> Option<&'a AttachedCamera> {
    let why = "the rig runs without the camera and looks for it again and again; its sets are incomplete";
    let family: Vec<_> = attached.cameras.iter().filter(|c| c.backend == backend).collect();
    let list = |cameras: &[&AttachedCamera]| match cameras {
        [] => format!("no camera for `backend = \"{backend}\"` is attached"),
        some => format!("attached are: {}", some.iter().map(|c| c.describe()).collect::<Vec<_>>().join(", ")),
    };
    let fits = |c: &&&AttachedCamera| {
        wanted.port.is_none_or(|port| c.port == port)
            && wanted.serial.is_none_or(|serial| c.serial.as_deref() == Some(serial))
    };
    let found: Vec<_> = family.iter().filter(fits).copied().collect();
    match (found.as_slice(), wanted.port, wanted.serial) {
        ([one], ..) => return Some(one),
        ([], port, serial) => {
            let what = match (port, serial) {
                (Some(port), Some(serial)) => format!("no camera {serial} at port {port}"),
                (Some(port), None) => format!("no camera at port {port}"),
                (None, Some(serial)) => format!("no camera with the serial number {serial}"),
                (None, None) => "no such camera".to_owned(),
            };
            let unknown: Vec<_> = family.iter().filter(|c| c.serial.is_none()).copied().collect();
            let near = serial.and_then(|s| nearest(s, &family));
            let cure = match (near, unknown.as_slice()) {
                (Some(near), _) => format!("plug it in; or did you mean serial = \"{near}\"?"),
                (None, []) => {
                    "plug it in, or correct `serial` or `port` (`depthrig cameras` lists what is there)"
                        .into()
                }
                (None, some) => format!(
                    "it may be {}, whose serial number could not be asked ({}); name it by `port`, or make it free",
                    some.iter().map(|c| c.describe()).collect::<Vec<_>>().join(" or "),
                    some.iter().map(|c| c.state.name()).collect::<Vec<_>>().join(", "),
                ),
            };
            findings.push(Finding::new(
                Severity::Error,
                "camera_missing",
                format!("{what}; {}", list(&family)),
                why,
                cure,
            ));
        }
        (several, ..) => findings.push(Finding::new(
            Severity::Error,
            "camera_ambiguous",
            format!("{} cameras fit; {}", several.len(), list(several)),
            "which one it would be depends on chance",
            "name it by `serial` or `port`",
        )),
    }
    None
}

/// The serial number that differs from `serial` in one or two characters.
fn nearest<'a>(serial: &str, family: &[&'a AttachedCamera]) -> Option<&'a str> {
    let distances = family.iter().filter_map(|c| {
        let theirs = c.serial.as_deref()?;
        Some((strsim::damerau_levenshtein(serial, theirs), theirs))
    });
    distances.filter(|(d, _)| *d <= 2).min().map(|(_, s)| s)
}

/// Checks the device itself.
fn check_device(device: &AttachedCamera, wanted: &Selector<'_>, findings: &mut Vec<Finding>) {
    match device.state {
        UseState::Free => {}
        UseState::InUse => findings.push(Finding::new(
            Severity::Error,
            "camera_in_use",
            format!("{} is in use by {}", device.describe(), device.held_words()),
            "a camera streams to one program at a time; what it can do was not asked, so as not to disturb it",
            "end that program before the session",
        )),
        UseState::Denied => findings.push(Finding::new(
            Severity::Error,
            "permission_denied",
            format!("{}: this user may not open its nodes", device.describe()),
            "the camera stays dark",
            format!("{RULE_CURE}, then plug the camera in again"),
        )),
        UseState::Failed => findings.push(Finding::new(
            Severity::Error,
            "camera_failed",
            device.problems.last().cloned().unwrap_or_else(|| format!("{} does not answer", device.describe())),
            "the camera would not open for the session either",
            "do what the message says; if it says nothing, plug the camera in again",
        )),
        UseState::NoDriver => findings.push(Finding::new(
            Severity::Error,
            "no_driver",
            format!("{}: this version has no driver for it", device.describe()),
            "the rig cannot run with it",
            "use a newer version of depthrig",
        )),
    }
    if device.state == UseState::Free && device.calibration.as_deref().is_none_or(|c| c == "none") {
        findings.push(Finding::new(
            if wanted.needs_calibration { Severity::Error } else { Severity::Warning },
            "calibration_missing",
            format!("{} has no calibration", device.describe()),
            "its frames carry no intrinsics, so depth cannot be turned into points nor laid over colour",
            "give the rig file a calibration for it, or have the camera calibrated; `allow_uncalibrated = true` uses a RealSense without",
        ));
    }
    if device.kernel_metadata == Some("header") && wanted.kernel_metadata {
        findings.push(Finding::new(
            Severity::Info,
            "metadata_header",
            format!("the kernel knows no metadata format for {} ({})", device.model, device.usb_id.as_deref().unwrap_or("?")),
            "frames carry the device's time of the USB header; frame counter, exposure and mid-exposure time are missing",
            "use Linux 6.5 or later (6.11 for a D421), or transport = \"libusb\"; or leave it: times stay good to a few milliseconds",
        ));
    }
    let Some(usb) = &device.usb else { return };
    if let Some(what) = health::slow_link(usb) {
        findings.push(Finding::new(
            Severity::Warning,
            "usb2",
            what,
            "modes are missing or slower, and cameras on the bus push each other out",
            format!("move it from port {} to a USB3 socket, with a USB3 cable", usb.port),
        ));
    }
    if health::may_sleep(usb).is_some() {
        findings.push(Finding::new(
            Severity::Info,
            "autosuspend",
            "the kernel may put it to sleep when it is idle (autosuspend)",
            "a camera that was put to sleep between two sessions may not answer at the next",
            format!("{RULE_CURE}, or write `on` to /sys/bus/usb/devices/{}/power/control", usb.port),
        ));
    }
}

/// Two cameras of the rig that are one device.
pub(super) fn check_named_twice(plans: &[CameraPlan], findings: &mut Vec<Finding>) {
    for (i, a) in plans.iter().enumerate() {
        for b in plans.iter().skip(i + 1).filter(|b| b.port.is_some() && b.port == a.port) {
            let port = a.port.as_deref().unwrap_or_default();
            findings.push(
                Finding::new(
                    Severity::Error,
                    "camera_named_twice",
                    format!("\"{}\" and \"{}\" are both the camera at port {port}", a.name, b.name),
                    "the second to open it finds it busy",
                    "give each its own `serial` or `port`",
                )
                .of(&b.name),
            );
        }
    }
}

/// Checks attached devices that are unusable, or in no camera of the rig.
pub(super) fn check_unnamed(attached: &Attached, plans: &[CameraPlan], findings: &mut Vec<Finding>) {
    for line in &attached.unusable {
        findings.push(Finding::new(
            Severity::Info,
            "device_unusable",
            line.as_str(),
            "it is attached, but no rig can use it",
            "do what the message says, or unplug it",
        ));
    }
    // A rig of synthetic or recorded cameras alone says nothing of the real ones.
    if plans.iter().all(|p| p.port.is_none()) {
        return;
    }
    // Which of them a process will open, only that process knows.
    let may_be_served =
        |c: &AttachedCamera| c.backend == family::SERVED.name && plans.iter().any(|p| p.backend == c.backend);
    let named =
        |c: &AttachedCamera| plans.iter().any(|p| p.port.as_deref() == Some(&*c.port)) || may_be_served(c);
    for c in attached.cameras.iter().filter(|c| !named(c) && c.usb.is_some()) {
        findings.push(Finding::new(
            Severity::Info,
            "camera_unnamed",
            format!("{} is attached and not in the rig file", c.describe()),
            "it is not used",
            "add a [[camera]] for it, if it belongs to the rig",
        ));
    }
}
