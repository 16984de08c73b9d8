//! Runs the scenarios of a boot, each in a process of its own, and reports how each ended.

use crate::checks::{Checks, REPORT_VARIABLE, Report};
use crate::{Scenario, scenario, system};
use anyhow::Context;
use depthrig_bus::HostTime;
use rustix::process::{Pid, Signal, kill_process_group};
use serde_json::json;
use std::fs::File;
use std::os::unix::process::{CommandExt, ExitStatusExt};
use std::path::Path;
use std::process::{Child, Command};
use std::time::Duration;

/// Runs what `share/plan` lists, into `share/report` and `share/logs`; `share/done` is made at the end.
///
/// # Errors
/// When the shared folder cannot be read or written.
pub fn run(share: &Path) -> anyhow::Result<()> {
    let plan = std::fs::read_to_string(share.join("plan")).context("the plan of this boot")?;
    system::kernel_messages()?;
    for name in plan.lines() {
        supervise(scenario(name)?, share)?;
    }
    std::fs::write(share.join("done"), "").context("the end of the report")
}

/// Runs one scenario to its end, and whatever it leaves behind to its end.
fn supervise(scenario: &Scenario, share: &Path) -> anyhow::Result<()> {
    let path = share.join("report");
    Report::at(&path, scenario.name)?.add("start", json!({}))?;
    let mut checks = Checks::new(Report::at(&path, scenario.name)?);
    let started = HostTime::now();

    let log = File::create(share.join(format!("logs/{}.log", scenario.name)))?;
    let mut child = Command::new(std::env::current_exe()?)
        .arg(scenario.name)
        .env(REPORT_VARIABLE, &path)
        .stdin(std::process::Stdio::null())
        .stdout(log.try_clone()?)
        .stderr(log)
        .process_group(0)
        .spawn()?;
    let in_time =
        system::wait_until(Duration::from_secs(scenario.limit_s), || !matches!(child.try_wait(), Ok(None)));
    // Remaining processes of its group, a daemon for example, must not disturb the next scenario.
    end_group(&child);
    let status = child.wait()?;
    if !in_time {
        checks.that("ends in time", false, format!("killed after {} s of guest time", scenario.limit_s));
    } else if let Some(signal) = status.signal() {
        checks.that("is not killed", false, format!("signal {signal}"));
    } else if !matches!(status.code(), Some(0 | 1)) {
        // 1 is a failed check, which has been reported.
        checks.that("ends by itself", false, status);
    }
    leave_nothing(&mut checks)?;
    complaints(&mut checks, scenario, share)?;

    let guest_s = started.elapsed().as_secs_f64();
    Report::at(&path, scenario.name)?.add("end", json!({ "guest_s": guest_s }))
}

/// Kills every process of the scenario's group.
fn end_group(child: &Child) {
    if let Some(group) = Pid::from_raw(child.id() as i32) {
        // It fails when nobody is left, which is the ordinary case.
        let _ = kill_process_group(group, Signal::KILL);
    }
}

/// No camera is left for the next scenario: those of the emulator go with its process, those of vivid with its module.
fn leave_nothing(checks: &mut Checks) -> anyhow::Result<()> {
    // It fails when it is not loaded.
    let _ = Command::new("rmmod").arg("vivid").stderr(std::process::Stdio::null()).status();
    let gone = || system::video_nodes().is_ok_and(|nodes| nodes.is_empty());
    // The kernel's hub needs up to 2.5 s for each camera that went together with others.
    if !system::wait_until(Duration::from_mins(1), gone) {
        checks.that("leaves no camera behind", false, format!("{:?}", system::video_nodes()?));
    }
    Ok(())
}

/// The kernel must not have complained: a warning there is a bug of a driver, of the emulator, or of depthrig's order.
fn complaints(checks: &mut Checks, scenario: &Scenario, share: &Path) -> anyhow::Result<()> {
    const WORDS: [&str; 5] = ["WARNING:", "BUG:", "Oops", "blocked for more than", "Call Trace"];
    let said = system::kernel_messages()?;
    // vhci says this for every frame of every stream.
    let kept: Vec<&str> =
        said.iter().map(String::as_str).filter(|line| !line.contains("Not yet implemented")).collect();
    std::fs::write(share.join(format!("logs/{}.kernel", scenario.name)), kept.join("\n"))?;
    let complaint = kept.iter().find(|line| WORDS.iter().any(|word| line.contains(word)));
    checks.that("the kernel has no complaint", complaint.is_none(), complaint.unwrap_or(&""));
    Ok(())
}
