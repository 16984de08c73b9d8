//! `depthrig doctor`: checks everything a session needs before it starts.

use crate::context::Context;
use crate::exit::Exit;
use crate::view::Style;
use crate::{out, screen};
use anyhow::Result;
use depthrig_daemon::attached::System;
use depthrig_daemon::config::RigConfig;
use depthrig_daemon::doctor::{Finding, Report, Severity, Surroundings, examine};
use depthrig_usb::SysRoot;
use std::path::PathBuf;

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
Nothing is streamed, and cameras in use are not opened. To measure the disk, doctor writes to an unnamed file for one
second; --no-disk skips this.

Exit codes: 0 ready, 1 an error (the session does not run as configured), 2 invalid configuration, 3 a warning (it runs,
but something may be lost).

Examples:
  depthrig doctor rig.toml
  depthrig doctor rig.toml --json | jq '.findings[] | {severity, id, camera, cure}'";

/// Arguments.
#[derive(Debug, clap::Args)]
pub struct DoctorArgs {
    /// Rig configuration
    config: PathBuf,
    /// Skip the write test of the recording disk
    #[arg(long)]
    no_disk: bool,
    /// Print JSON
    #[arg(long)]
    json: bool,
    /// Folder that contains /sys, /proc and /dev
    #[arg(long, value_name = "DIR", default_value = "/", hide = true)]
    sys_root: PathBuf,
}

/// Runs the checks and prints the findings.
pub fn run(args: &DoctorArgs, context: &Context) -> Result<Exit> {
    let mut config = RigConfig::load(&args.config).map_err(depthrig_daemon::Error::from)?;
    if let Some(rig) = &context.global.rig {
        config.rig = rig.clone();
    }
    let runtime = context.runtime().ok();
    let root = SysRoot::new(&args.sys_root);
    let around = Surroundings { root, runtime: runtime.clone(), measure_disk: !args.no_disk };
    let report = examine(&config, &around, &System::of_rig(&config, runtime))?;
    if args.json {
        out::json(&report)?;
    } else {
        let style = Style { width: screen::size().map_or(120, |(width, _)| width), color: context.color() };
        out::styled(text(&report, style))?;
    }
    Ok(match report.verdict {
        Severity::Error => Exit::Failed,
        Severity::Warning => Exit::Lost,
        Severity::Info | Severity::Good => Exit::Good,
    })
}

fn text(r: &Report, style: Style) -> String {
    let mut lines = vec![format!("rig {}: {}", r.rig, out::count(r.cameras.len(), "camera")), String::new()];
    lines.push(out::table(
        &["camera", "device", "streams", "Mbit/s", ""],
        usize::MAX,
        r.cameras.iter().map(|c| {
            let streams: Vec<_> = c
                .streams
                .iter()
                .map(|s| match s.mode.samples_hz() {
                    Some(hz) => format!("{} motion@{hz}", s.mode.stream),
                    None => {
                        format!("{} {}x{}@{}", s.mode.stream, s.mode.width, s.mode.height, s.mode.rate_hz)
                    }
                })
                .collect();
            let load: f64 = c.streams.iter().map(|s| s.usb_mbit_s).sum();
            vec![
                c.name.clone(),
                c.device.clone().unwrap_or_else(|| "not found".to_owned()),
                if streams.is_empty() { "?".to_owned() } else { fold(&streams, style.width) },
                if load > 0.0 { format!("{load:.0}") } else { "-".to_owned() },
                c.worst.map_or("good", Severity::name).to_owned(),
            ]
        }),
    ));
    lines.push(String::new());
    // The load of a camera that could not be queried is unknown.
    for l in r.links.iter().filter(|l| l.load_mbit_s > 0.0) {
        let share = 100.0 * l.load_mbit_s / l.plan_mbit_s;
        lines.push(format!(
            "{}: {:.0} of {:.0} Mbit/s planned ({share:.0} %): {}",
            l.link,
            l.load_mbit_s,
            l.plan_mbit_s,
            l.cameras.join(", ")
        ));
    }
    let d = &r.disk;
    let took = d.measured_bytes_per_s.map(|rate| format!(", it took {}/s", out::bytes(rate as u64)));
    let left = d.minutes_left.map(|m| format!(", room for {}", out::seconds(m * 60.0)));
    lines.push(format!(
        "disk {}: a recording needs {}/s{}{}",
        d.directory,
        out::bytes(d.needed_bytes_per_s as u64),
        took.unwrap_or_default(),
        left.unwrap_or_default()
    ));
    lines.push(format!(
        "shared memory: {} needed, {} free",
        out::bytes(r.shm_needed_bytes),
        out::bytes(r.shm_free_bytes)
    ));
    for f in &r.findings {
        lines.push(String::new());
        lines.extend(finding(f, style));
    }
    let count = |s| r.findings.iter().filter(|f| f.severity == s).count();
    lines.push(String::new());
    lines.push(match (count(Severity::Error), count(Severity::Warning)) {
        (0, 0) => "ready: nothing stands in the way".to_owned(),
        (0, w) => format!("runs, but something may be lost: {}", out::count(w, "warning")),
        (e, 0) => format!("not ready: {}", out::count(e, "error")),
        (e, w) => format!("not ready: {}, {}", out::count(e, "error"), out::count(w, "warning")),
    });
    lines.join("\n")
}

fn finding(f: &Finding, style: Style) -> Vec<String> {
    let name = match (f.severity, style.color) {
        (s @ Severity::Error, true) => format!("\u{1b}[31m{}\u{1b}[0m", s.name()),
        (s @ Severity::Warning, true) => format!("\u{1b}[33m{}\u{1b}[0m", s.name()),
        (s, _) => s.name().to_owned(),
    };
    let camera = f.camera.as_ref().map(|c| format!(" {c}:")).unwrap_or_default();
    let mut lines = vec![format!("{name}{camera} [{}]", f.id)];
    lines.extend(out::item(" ", &f.what, style.width));
    lines.extend(out::item(" ", &format!("why:  {}", f.why), style.width));
    lines.extend(out::item(" ", &format!("cure: {}", f.cure), style.width));
    lines
}

/// Lists streams on one line if they fit, else one per line.
fn fold(streams: &[String], width: usize) -> String {
    streams.join(if width >= 110 { ", " } else { "\n" })
}
