//! Shared memory against the slots that the rig asks for.

use super::finding::{Finding, Severity};
use super::host::Host;
use super::plan::CameraPlan;
use crate::config::RigConfig;
use depthrig_bus::shm;

/// Bytes that every stream's slots take together; notes streams that do not fit.
pub(super) fn check(
    config: &RigConfig,
    plans: &[CameraPlan],
    host: &Host,
    findings: &mut Vec<Finding>,
) -> u64 {
    let set_bytes = |p: &CameraPlan| p.profiles.iter().map(|(p, _)| p.frame_bytes() as u64).sum::<u64>();
    let needed = plans.iter().map(set_bytes).sum::<u64>() * config.bus.slots as u64;
    let Some(free) = host.shm_free_bytes else {
        findings.push(Finding::new(
            Severity::Error,
            "shm_missing",
            format!("{} cannot be asked for its free space", shm::SHM_DIR),
            "frames reach everybody through it",
            format!("mount a tmpfs at {}", shm::SHM_DIR),
        ));
        return needed;
    };
    // As the daemon deals it out: every camera an equal share.
    let share = free / config.cameras.len().max(1) as u64;
    for p in plans.iter().filter(|p| set_bytes(p) > 0) {
        match shm::slots_that_fit(config.bus.slots, set_bytes(p), share) {
            Err(e) => findings.push(
                Finding::new(
                    Severity::Error,
                    "shm_too_small",
                    e.to_string(),
                    "the camera does not start without shared memory for its frames",
                    format!("mount -o remount,size=4G {}", shm::SHM_DIR),
                )
                .of(&p.name),
            ),
            Ok(slots) if slots < config.bus.slots => findings.push(
                Finding::new(
                    Severity::Warning,
                    "shm_tight",
                    format!(
                        "{slots} slots of each stream fit into {}, {} are asked for",
                        shm::SHM_DIR,
                        config.bus.slots
                    ),
                    "with fewer slots a slow subscriber loses frames sooner",
                    format!(
                        "mount -o remount,size={}M {}, or lower bus.slots",
                        (needed / 8 * 10).div_ceil(1 << 20),
                        shm::SHM_DIR
                    ),
                )
                .of(&p.name),
            ),
            Ok(_) => {}
        }
    }
    needed
}
