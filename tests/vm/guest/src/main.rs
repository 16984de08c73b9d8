//! The program inside the virtual machine: `guest boot` as the child of init, and one process for each scenario.
//!
//! A scenario is a file below `scenarios/` with a line in [`SCENARIOS`]; `tests/vm/README.md` says how to write one.
// A test: a panic is a failed scenario.
#![allow(
    clippy::expect_used,
    clippy::default_trait_access,
    clippy::too_many_lines,
    clippy::format_push_string
)]

mod boot;
mod checks;
mod daemon;
mod feed;
mod mount;
mod outside;
mod stereo_reference;
mod subject;
mod system;
mod tally;
mod vivid;

mod scenarios {
    pub mod cameras;
    pub mod daemon_life;
    pub mod daemon_smoke;
    pub mod doctor;
    pub mod emulator;
    pub mod emulator_load;
    pub mod faults;
    pub mod fourteen;
    pub mod l515;
    pub mod librealsense;
    pub mod libusb;
    pub mod realsense_calibration;
    pub mod realsense_clock;
    pub mod realsense_conformance;
    pub mod realsense_control;
    pub mod realsense_imu;
    pub mod realsense_infrared;
    pub mod replug;
    pub mod service;
    pub mod udev;
    pub mod uvc;
    pub mod v4l2_cost;
    pub mod v4l2_daemon;
    pub mod v4l2_faults;
    pub mod v4l2_formats;
    pub mod vivid_smoke;
    pub mod whole_mount;
    pub mod zed;
    pub mod zed_records;
}

use anyhow::{Context, bail};
use checks::{Checks, Report};
use std::path::Path;
use std::process::ExitCode;

/// One thing to show, in a process of its own.
pub struct Scenario {
    /// Its name on the command line and in the report.
    pub name: &'static str,
    /// One line for `tests/vm/run --list`.
    pub about: &'static str,
    /// Processor seconds of the host that it takes, roughly: scenarios are shared out by it.
    pub cost: u32,
    /// It is killed, and has failed, after so many seconds of guest time.
    pub limit_s: u64,
    /// An archive of the host's that it needs (`tests/vm/rig/librealsense.py`); empty: none.
    pub needs: &'static str,
    /// Its function. An error is a failed check.
    pub run: fn(&mut Checks) -> anyhow::Result<()>,
}

/// Every scenario, in the order in which they run.
const SCENARIOS: &[Scenario] = &[
    scenarios::vivid_smoke::SCENARIO,
    scenarios::daemon_smoke::SCENARIO,
    scenarios::cameras::SCENARIO,
    scenarios::doctor::SCENARIO,
    scenarios::udev::SCENARIO,
    scenarios::service::SCENARIO,
    scenarios::emulator::SCENARIO,
    scenarios::realsense_calibration::SCENARIO,
    scenarios::realsense_clock::SCENARIO,
    scenarios::realsense_conformance::SCENARIO,
    scenarios::emulator_load::SCENARIO,
    scenarios::l515::SCENARIO,
    scenarios::librealsense::SCENARIO,
    scenarios::v4l2_formats::SCENARIO,
    scenarios::v4l2_faults::SCENARIO,
    scenarios::v4l2_cost::SCENARIO,
    scenarios::v4l2_daemon::SCENARIO,
    scenarios::realsense_conformance::V4L2,
    scenarios::uvc::SCENARIO,
    scenarios::libusb::SCENARIO,
    scenarios::libusb::END,
    scenarios::libusb::SEVEN,
    scenarios::libusb::DAEMON,
    scenarios::realsense_conformance::LIBUSB,
    scenarios::realsense_control::SCENARIO,
    scenarios::realsense_infrared::SCENARIO,
    scenarios::realsense_imu::SCENARIO,
    scenarios::zed::SCENARIO,
    scenarios::zed_records::SCENARIO,
    scenarios::fourteen::SCENARIO,
    scenarios::whole_mount::SCENARIO,
    scenarios::replug::SCENARIO,
    scenarios::daemon_life::SCENARIO,
    scenarios::faults::SCENARIO,
];

fn main() -> anyhow::Result<ExitCode> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let words: Vec<&str> = arguments.iter().map(String::as_str).collect();
    match words[..] {
        ["list"] => {
            for scenario in SCENARIOS {
                println!("{:24} {}", scenario.name, scenario.about);
            }
        }
        ["list", "--json"] => {
            let list: Vec<_> = SCENARIOS
                .iter()
                .map(|s| serde_json::json!({ "name": s.name, "about": s.about, "cost": s.cost, "needs": s.needs }))
                .collect();
            println!("{}", serde_json::Value::from(list));
        }
        ["boot", share] => boot::run(Path::new(share))?,
        [name] => return one(name),
        _ => bail!("usage: guest SCENARIO | guest list [--json] | guest boot FOLDER"),
    }
    Ok(ExitCode::SUCCESS)
}

/// The scenario called `name`.
fn scenario(name: &str) -> anyhow::Result<&'static Scenario> {
    SCENARIOS.iter().find(|s| s.name == name).with_context(|| format!("no scenario {name}; see `guest list`"))
}

/// Runs one scenario in this process.
fn one(name: &str) -> anyhow::Result<ExitCode> {
    let scenario = scenario(name)?;
    let mut checks = Checks::new(Report::of_environment(scenario.name)?);
    let outcome = (scenario.run)(&mut checks);
    if let Err(error) = outcome {
        checks.that("runs to its end", false, format!("{error:#}"));
    }
    Ok(if checks.all_hold() { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}
