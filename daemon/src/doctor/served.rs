//! Cameras that another process serves: whether it does, its streams, and whether the daemon could start it.

use super::finding::{Finding, Severity};
use super::plan::{Planned, mode_missing, no_plan, set_streams};
use crate::attached::{Attached, UseState, place_of_served};
use crate::config::CameraConfig;
use crate::family::Service;
use depthrig_driver::choose_profiles;
use std::path::{Path, PathBuf};

const INCOMPLETE: &str =
    "the rig runs without the camera and looks for it again and again; its sets are incomplete";

/// Plans the camera of rig `rig` that `service` serves.
pub(super) fn plan(camera: &CameraConfig, rig: &str, service: &Service<'_>, attached: &Attached) -> Planned {
    let mut plan = no_plan(camera, camera.backend.name());
    let mut findings = Vec::new();
    let place = place_of_served(rig, camera.name.as_str());
    let found = attached.cameras.iter().find(|c| c.backend == plan.backend && c.port == place);
    match found {
        None => findings.push(not_served(service)),
        Some(device) => {
            plan.device = Some(device.describe());
            plan.port = Some(place);
            match choose_profiles(&device.describe(), &device.profiles, &camera.streams) {
                _ if device.profiles.is_empty() => {}
                Ok(chosen) => set_streams(&mut plan, camera, chosen, false, &mut findings),
                Err(e) => findings.push(mode_missing(device, &e.to_string())),
            }
            let problem = device.problems.last().cloned().unwrap_or_default();
            let (code, why, cure) = match device.state {
                UseState::Failed | UseState::Denied => (
                    "camera_failed",
                    "the camera would not open for the session either",
                    "do what the message says, or end that process and start it again",
                ),
                UseState::InUse if device.rig.is_none() => (
                    "camera_in_use",
                    "a camera streams to one program at a time",
                    "end that program before the session",
                ),
                _ => return finish(plan, findings),
            };
            findings.push(Finding::new(Severity::Error, code, problem, why, cure));
        }
    }
    finish(plan, findings)
}

fn finish(plan: super::CameraPlan, findings: Vec<Finding>) -> Planned {
    let findings = findings.into_iter().map(|f| f.of(&plan.name)).collect();
    Planned { plan, findings }
}

/// The finding that no process serves the camera now.
fn not_served(service: &Service<'_>) -> Finding {
    let Some(program) = service.command.first() else {
        return Finding::new(
            Severity::Error,
            "camera_missing",
            "no process serves it",
            INCOMPLETE,
            "start the process that does (docs/external.md), or name it in the rig file as `command`",
        );
    };
    if can_run(program, service.directory) {
        return Finding::new(
            Severity::Info,
            "external_not_running",
            format!("its process, {program}, starts with the rig"),
            "its modes are known only when it runs, so disk and shared memory are planned without them",
            "nothing, or start it by itself for a check",
        );
    }
    Finding::new(
        Severity::Error,
        "command_missing",
        format!("`command` names {program}, which this user cannot run from {}", service.directory.display()),
        "the rig does not start with a camera that cannot work",
        "correct `command` or `directory`, or install the program",
    )
}

/// Whether `program` would be found: by its path from `directory`, or in `PATH`.
fn can_run(program: &str, directory: &Path) -> bool {
    use rustix::fs::{Access, access};
    let runs = |path: PathBuf| path.is_file() && access(&path, Access::EXEC_OK).is_ok();
    if program.contains('/') {
        return runs(directory.join(program));
    }
    let path = std::env::var_os("PATH").unwrap_or_default();
    std::env::split_paths(&path).any(|folder| runs(directory.join(folder).join(program)))
}
