//! The plan of one camera: its device, and the streams that it would deliver.

use super::finding::{Finding, Severity};
use crate::attached::{AttachedCamera, ModeReport};
use crate::config::CameraConfig;
use depthrig_driver::StreamProfile;
use depthrig_usb::health;
use serde::Serialize;

/// A camera of the rig and the device that it would be.
#[derive(Debug, Clone, Serialize)]
pub struct CameraPlan {
    /// Its name in the rig.
    pub name: String,
    /// Its driver.
    pub backend: &'static str,
    /// The device that it would be, in words; `None` when none was found.
    pub device: Option<String>,
    /// Where that is attached.
    pub port: Option<String>,
    /// The streams it would deliver; empty when they are not known.
    pub streams: Vec<PlannedStream>,
    /// The worst of its findings.
    pub worst: Option<Severity>,
    /// Whether it would be read through libusb.
    pub libusb: bool,
    /// Memory that the kernel counts for the transfers of a vendor's library, bytes.
    #[serde(skip)]
    pub transfer_bytes: u64,
    /// The modes of `streams`, with whether each is recorded.
    #[serde(skip)]
    pub profiles: Vec<(StreamProfile, bool)>,
}

/// A stream of a plan.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PlannedStream {
    /// Its mode.
    #[serde(flatten)]
    pub mode: ModeReport,
    /// Its USB load, Mbit/s; 0 when it is on none.
    pub usb_mbit_s: f64,
    /// Whether it is recorded.
    pub recorded: bool,
}

/// A plan with its problems.
pub(super) struct Planned {
    pub(super) plan: CameraPlan,
    pub(super) findings: Vec<Finding>,
}

/// The plan of a camera whose device is not known yet.
pub(super) fn no_plan(camera: &CameraConfig, backend: &'static str) -> CameraPlan {
    CameraPlan {
        name: camera.name.to_string(),
        backend,
        device: None,
        port: None,
        streams: Vec::new(),
        worst: None,
        libusb: false,
        transfer_bytes: 0,
        profiles: Vec::new(),
    }
}

/// The finding that `device` does not have the configured mode; `what` says which.
pub(super) fn mode_missing(device: &AttachedCamera, what: &str) -> Finding {
    let cure = "write one of its modes into [[camera.stream]]";
    Finding::new(
        Severity::Error,
        "mode_missing",
        what,
        "the camera is not started in a mode that it does not have, so it would be missing from every set",
        match device.usb.as_ref().and_then(health::slow_link) {
            Some(slow) => format!("{slow}; or {cure}"),
            None => cure.to_owned(),
        },
    )
}

/// Sets the streams of `plan` to the `chosen` ones and those computed from them.
pub(super) fn set_streams(
    plan: &mut CameraPlan,
    camera: &CameraConfig,
    chosen: Vec<StreamProfile>,
    on_usb: bool,
    findings: &mut Vec<Finding>,
) {
    let derived = camera.derived_profiles(&chosen).unwrap_or_else(|e| {
        let why = "the camera does not start: its depth cannot be refined";
        let cure = "correct what the message names";
        let finding = Finding::new(Severity::Error, "refine_impossible", e.to_string(), why, cure);
        findings.push(finding.of(camera.name.as_str()));
        Vec::new()
    });
    let captured = chosen.into_iter().map(|p| {
        let recorded = camera.records(&p.stream);
        (p, recorded)
    });
    let captured: Vec<_> = captured.collect();
    let with_depth = captured.iter().any(|(p, _)| p.stream.as_str() == "depth");
    for (p, recorded) in captured.into_iter().chain(derived) {
        let on_usb = on_usb && !camera.is_computed_here(&p.stream);
        let own = camera.backend.wire_bits_per_s(&p, with_depth);
        let bits_per_s = own.unwrap_or_else(|| super::wire_bits_per_s(&p));
        let usb_mbit_s = if on_usb { bits_per_s / 1e6 } else { 0.0 };
        plan.streams.push(PlannedStream { mode: ModeReport::from(&p), usb_mbit_s, recorded });
        plan.profiles.push((p, recorded));
    }
}
