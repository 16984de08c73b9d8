//! A session before it begins: what would go wrong with this rig on this computer, why it matters and what to do.
//!
//! Facts are gathered first ([`Host`], [`crate::attached`]), then judged without touching anything, so that every
//! finding can be tested on fake facts. Nothing is streamed. A camera that somebody has is left alone.

mod bandwidth;
mod calibration;
mod cameras;
mod clock;
mod disk;
mod finding;
mod host;
mod link;
mod memory;
mod plan;
mod refine;
mod served;
#[cfg(test)]
mod tests;
mod ways;

pub use bandwidth::{LinkLoad, wire_bits_per_s};
pub use clock::ClockSync;
pub use disk::{DiskFacts, DiskPlan};
pub use finding::{Finding, Severity};
pub use host::Host;
pub use plan::{CameraPlan, PlannedStream};

use crate::attached::{Ask, Attached, look};
use crate::config::RigConfig;
use depthrig_bus::{HostTime, RuntimeDir, UtcPair};
use depthrig_usb::SysRoot;
use serde::Serialize;

/// The findings about a session.
#[derive(Debug, Clone, Serialize)]
pub struct Report {
    /// The rig's name.
    pub rig: String,
    /// The worst of the findings.
    pub verdict: Severity,
    /// The cameras of the rig file, in its order.
    pub cameras: Vec<CameraPlan>,
    /// The USB links that cameras of the rig share or fill, by load.
    pub links: Vec<LinkLoad>,
    /// The disk of the recordings.
    pub disk: DiskPlan,
    /// Shared memory that the streams need with the slots they are to have, bytes.
    pub shm_needed_bytes: u64,
    /// Bytes free in `/dev/shm`.
    pub shm_free_bytes: u64,
    /// The findings, the worst first.
    pub findings: Vec<Finding>,
}

/// Where to look.
#[derive(Debug)]
pub struct Surroundings {
    /// The file system of the kernel's facts.
    pub root: SysRoot,
    /// Where the rigs of this user are.
    pub runtime: Option<RuntimeDir>,
    /// Whether the disk may be written to for a moment, to learn its rate.
    pub measure_disk: bool,
}

/// The findings, and everything that is attached.
#[derive(Debug, Clone, Serialize)]
pub struct Examined {
    /// The findings.
    #[serde(flatten)]
    pub report: Report,
    /// Everything attached, of the rig or not.
    pub attached: Attached,
}

/// Examines a session of `config`.
///
/// # Errors
/// When the bus cannot be read at all.
pub fn examine(config: &RigConfig, around: &Surroundings, ask: &dyn Ask) -> crate::Result<Report> {
    examine_all(config, around, ask).map(|examined| examined.report)
}

/// As [`examine`], with what is attached.
///
/// # Errors
/// As [`examine`].
pub fn examine_all(config: &RigConfig, around: &Surroundings, ask: &dyn Ask) -> crate::Result<Examined> {
    let attached = look(&around.root, ask)?;
    let plans = cameras::plan(config, &attached);
    let host = Host::gather(config, around, plans.iter().map(|p| &p.plan));
    Ok(Examined { report: judge(config, &attached, plans, &host), attached })
}

/// Judges the gathered facts.
fn judge(config: &RigConfig, attached: &Attached, plans: Vec<plan::Planned>, host: &Host) -> Report {
    let mut findings = Vec::new();
    let mut plans: Vec<_> = plans
        .into_iter()
        .map(|p| {
            findings.extend(p.findings);
            p.plan
        })
        .collect();
    cameras::check_named_twice(&plans, &mut findings);
    cameras::check_unnamed(attached, &plans, &mut findings);
    let links = bandwidth::loads(&plans, attached);
    bandwidth::check(&links, &mut findings);
    bandwidth::check_usbfs(&plans, host, &mut findings);
    let disk = disk::check(config, &plans, &host.disk, &mut findings);
    let shm_needed_bytes = memory::check(config, &plans, host, &mut findings);
    host.check(config, &mut findings);
    refine::check(config, &plans, &mut findings);
    calibration::check(config, UtcPair::sample().utc_ns(HostTime::now()), &mut findings);
    host.check_unmet(&mut findings);
    findings.sort_by_key(|f| (core::cmp::Reverse(f.severity), f.camera.is_some()));
    for p in &mut plans {
        p.worst = findings.iter().filter(|f| f.camera.as_deref() == Some(&*p.name)).map(|f| f.severity).max();
    }
    Report {
        rig: config.rig.to_string(),
        verdict: findings.iter().map(|f| f.severity).max().unwrap_or(Severity::Good),
        cameras: plans,
        links,
        disk,
        shm_needed_bytes,
        shm_free_bytes: host.shm_free_bytes.unwrap_or(0),
        findings,
    }
}
