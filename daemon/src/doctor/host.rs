//! Facts about the computer itself.

use super::clock::{ClockSync, clock_sync};
use super::disk::DiskFacts;
use super::finding::{Finding, Severity};
use super::ways::Way;
use super::{CameraPlan, Surroundings, link, ways};
use crate::config::{CameraConfig, RigConfig};
use crate::family::Unmet;
use crate::priority;
use crate::recording::reserve_bytes;
use crate::status::LinkStatus;
use depthrig_bus::shm;
use depthrig_usb::SysRoot;
use std::path::Path;

/// Facts of the computer.
#[derive(Debug, Clone)]
pub struct Host {
    /// The file system of the kernel's facts.
    pub root: SysRoot,
    /// Bytes free in `/dev/shm`; `None` when it cannot be asked.
    pub shm_free_bytes: Option<u64>,
    /// Why camera threads get no real-time priority; `None` when they do.
    pub realtime_refusal: Option<String>,
    /// The clock; `None` when the kernel does not say.
    pub clock: Option<ClockSync>,
    /// Who runs a rig of this name now.
    pub rig_holder: Option<String>,
    /// The clock of a session of several computers, or why not; `None` for one computer.
    pub link: Option<Result<LinkStatus, String>>,
    /// The ways to the other computers that record with this one.
    pub ways: Vec<Way>,
    /// The disk of the recordings.
    pub disk: DiskFacts,
    /// Requirements of the cameras that it does not meet.
    pub unmet: Vec<Unmet>,
}

/// Clocks of cameras and computers are followed up to this, parts per million.
const MAX_SLEW_PPM: f64 = 500.0;

impl Host {
    /// Asks for everything. The disk is measured only when something would be recorded.
    pub(super) fn gather<'p>(
        config: &RigConfig,
        around: &Surroundings,
        plans: impl Iterator<Item = &'p CameraPlan>,
    ) -> Self {
        let shm_folder = around.root.at(Path::new(shm::SHM_DIR));
        let mut recorded = plans.flat_map(|p| &p.profiles).map(|(_, recorded)| *recorded);
        let measure = around.measure_disk && recorded.any(|r| r);
        let rig_holder = around.runtime.as_ref().and_then(|r| r.holder(&config.rig));
        // The rig that runs has the address.
        let link = config.link.as_ref().filter(|_| rig_holder.is_none());
        let ways = link.map(|link| ways::measure(config, link, around.runtime.as_ref())).unwrap_or_default();
        let link = link.map(link::ask);
        Self {
            root: around.root.clone(),
            link,
            shm_free_bytes: shm::free_bytes(&shm_folder).ok(),
            realtime_refusal: priority::refusal(),
            clock: clock_sync(),
            rig_holder,
            ways,
            disk: DiskFacts::gather(&config.recording.directory, reserve_bytes(&config.recording), measure),
            unmet: unmet(config),
        }
    }

    /// Notes the requirements of cameras that are not met, and takes back findings about a camera that follow from them.
    pub(super) fn check_unmet(&self, findings: &mut Vec<Finding>) {
        for Unmet { finding, explains_failure } in &self.unmet {
            if *explains_failure {
                findings.retain(|f| f.id != "camera_failed" || f.camera != finding.camera);
            }
            findings.push(finding.clone());
        }
    }

    /// Checks the computer, apart from disk and shared memory.
    pub(super) fn check(&self, config: &RigConfig, findings: &mut Vec<Finding>) {
        if let Some(holder) = &self.rig_holder {
            findings.push(Finding::new(
                Severity::Error,
                "rig_running",
                format!("rig \"{}\" runs already, held by {holder}", config.rig),
                "one rig of a name runs at a time, and its cameras are in use",
                "stop it first (Ctrl-C, or systemctl stop depthrig), or give this rig another name",
            ));
        }
        if let Some(why) = self.realtime_refusal.as_ref().filter(|_| config.supervisor.raise_priority) {
            findings.push(Finding::new(
                Severity::Warning,
                "realtime",
                format!("camera threads get no real-time priority: {why}"),
                "a busy computer can delay them, and a frame that waits too long is overwritten",
                "allow it: `@video - rtprio 20` in /etc/security/limits.d/depthrig.conf and log in again, or LimitRTPRIO=20 \
                 in a service (depthrig install has one); or set supervisor.raise_priority = false",
            ));
        }
        if let Some(link) = &self.link {
            link::check(link, findings);
        }
        ways::check(config, &self.ways, findings);
        if let Some(ppm) = self.clock.map(|c| c.slew_ppm).filter(|ppm| ppm.abs() > MAX_SLEW_PPM) {
            findings.push(Finding::new(
                Severity::Warning,
                "clock_slewed",
                format!("a program turns this computer's clock by {ppm:+.0} ppm now, to correct it"),
                "the clocks of cameras and of other computers are followed up to 500 ppm; beyond that times are off until it is done",
                "wait until the clock is right: `chronyc tracking` says how far it is off; or set it at once, `chronyc makestep`",
            ));
        }
        if self.clock.is_some_and(|c| !c.synchronised) {
            findings.push(Finding::new(
                Severity::Info,
                "clock_unsynchronised",
                "nobody keeps this computer's clock right",
                "capture times stay consistent among the cameras, but their UTC may be off, and differs from other computers'",
                "start chrony or systemd-timesyncd (timedatectl set-ntp true)",
            ));
        }
    }
}

fn unmet(config: &RigConfig) -> Vec<Unmet> {
    let of_camera = |camera: &CameraConfig| {
        let name = camera.name.to_string();
        let unmet = camera.backend.unmet(&camera.streams);
        unmet.into_iter().map(move |u| Unmet { finding: u.finding.of(&name), ..u })
    };
    config.cameras.iter().flat_map(of_camera).collect()
}
