//! Cameras that other processes serve, listed beside those that are attached.

use super::{AttachedCamera, HeldBy, ModeReport, Served, UseState};
use crate::family;
use crate::status::{CameraState, RigStatus};
use depthrig_driver::ErrorKind;

/// Where such a camera is, as `port`: RIG/CAMERA.
pub(crate) fn place(rig: &str, camera: &str) -> String {
    format!("{rig}/{camera}")
}

/// The camera of `served`; `rigs` are those that run.
pub(super) fn camera(served: Served, rigs: &[RigStatus]) -> AttachedCamera {
    let Served { place: at, holder, offered } = served;
    let is_used = |rig: &&RigStatus| {
        let mut cameras = rig.cameras.iter();
        rig.rig == at.rig.as_str()
            && cameras.any(|c| c.name == at.camera.as_str() && matches!(c.state, CameraState::Streaming))
    };
    let rig = rigs.iter().find(is_used);
    let mut camera = AttachedCamera {
        backend: family::SERVED.name,
        model: "(not known)".to_owned(),
        serial: None,
        firmware: None,
        calibration: None,
        port: place(at.rig.as_str(), at.camera.as_str()),
        usb_id: None,
        usb_mbps: None,
        controller: None,
        state: if rig.is_some() { UseState::InUse } else { UseState::Free },
        may_sleep: None,
        held_by: process(&holder).into_iter().collect(),
        rig: rig.map(|r| format!("\"{}\", camera \"{}\"", r.rig, at.camera)),
        kernel_metadata: None,
        nodes: Vec::new(),
        modes: Vec::new(),
        problems: Vec::new(),
        usb: None,
        profiles: Vec::new(),
    };
    match offered {
        Ok((info, profiles)) => {
            let said = |text: String| (!text.is_empty()).then_some(text);
            camera.model = info.model;
            (camera.serial, camera.firmware) = (said(info.serial), said(info.firmware));
            camera.calibration = said(info.calibration);
            camera.modes = profiles.iter().map(ModeReport::from).collect();
            camera.profiles = profiles;
        }
        Err(e) => {
            camera.state = match e.kind() {
                ErrorKind::Busy => UseState::InUse,
                ErrorKind::PermissionDenied => UseState::Denied,
                _ => UseState::Failed,
            };
            let why = e.to_string();
            camera.problems.push(if why.contains(&holder) { why } else { format!("{holder}: {why}") });
        }
    }
    camera
}

/// The process of a lock's text, `process 4711 (my_camera)`.
fn process(holder: &str) -> Option<HeldBy> {
    let (pid, rest) = holder.strip_prefix("process ")?.split_once(' ')?;
    let name = rest.trim_matches(['(', ')']).to_owned();
    Some(HeldBy { pid: pid.parse().ok()?, name })
}
