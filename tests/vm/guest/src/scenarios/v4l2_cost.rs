//! Cost of capturing an image, in instructions: `depthrig bench capture` on a virtual camera. One nanosecond of guest
//! time is one instruction, so the ratio is the same whatever the host does.
//!
//! The guest's processor has neither AVX nor quick string moves (README.md beside `run`), so that glibc takes its copy for
//! processors of 2006. That one takes half as many instructions again into memory that does not begin at a multiple of 16:
//! so this fails when the pixels of a slot do not (bus/tests/pixel_alignment.rs says where they begin).

use crate::checks::Checks;
use crate::{Scenario, system, vivid};
use anyhow::Context;
use std::process::Command;

/// See the module.
pub const SCENARIO: Scenario = Scenario {
    name: "v4l2-cost",
    about: "depthrig bench capture on vivid at 1280x720x30: at most 1.2 x a bare loop, one copy or none",
    cost: 2,
    limit_s: 60,
    needs: "",
    run,
};

fn run(checks: &mut Checks) -> anyhow::Result<()> {
    vivid::load(1)?;
    let depthrig = std::env::current_exe()?.with_file_name("depthrig");
    let mut bench = Command::new(depthrig);
    bench.args(["bench", "capture", "--quick", "--json", "--port", &vivid::port(0)]);
    let said = system::run(&mut bench)?;
    let report: serde_json::Value = serde_json::from_str(&said).context("the bench's report")?;
    let costs = report["costs"].as_array().context("costs")?;
    checks.equal("two formats in three ways are measured", costs.len(), 6);
    for cost in costs {
        let format = cost["format"].as_str().unwrap_or("");
        let way = cost["way"].as_str().unwrap_or("");
        let us = &cost["median_us"];
        let ratio = &cost["ratio"];
        let copies = &cost["copies"];
        checks.note(format!("{format} {way}: {us} us of CPU an image, {ratio} x, {copies} copies"));
        let wanted = if way == "userptr" { 0.0 } else { 1.0 };
        checks.equal(&format!("{format} {way}: copies"), copies.as_f64(), Some(wanted));
        let cheap = ratio.as_f64().is_some_and(|r| r > 0.0 && r <= 1.2);
        checks.that(&format!("{format} {way}: CPU over a bare loop is at most 1.2"), cheap, ratio);
    }
    Ok(())
}
