//! `depthrig cameras`: lists the attached cameras.

use crate::context::Context;
use crate::exit::Exit;
use crate::{out, screen};
use anyhow::Result;
use depthrig_daemon::attached::{Attached, AttachedCamera, ModeReport, System, UseState, look};
use depthrig_realsense::{RealsenseBackend, RealsenseConfig};
use depthrig_usb::SysRoot;
use std::path::PathBuf;

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
A camera that is in use is listed with the process that holds it, and not opened; its data comes from the running rig.
Exit code 3 if a camera cannot be used or could not be queried.

Examples:
  depthrig cameras
  depthrig cameras --modes D435        possible entries of [[camera.stream]]
  depthrig cameras --reset 012345678901
  depthrig cameras --json | jq '.cameras[] | {model, serial, port, state}'";

/// Arguments.
#[derive(Debug, clap::Args)]
pub struct CamerasArgs {
    /// Show only cameras whose model, serial number or port contains PART
    #[arg(value_name = "PART")]
    only: Option<String>,
    /// Show the modes of each camera
    #[arg(long)]
    modes: bool,
    /// Show device nodes, formats and USB controller of each camera
    #[arg(long)]
    nodes: bool,
    /// Restart the RealSense D400 with this serial number, even while in use
    #[arg(long, value_name = "SERIAL", conflicts_with_all = ["only", "modes", "nodes", "json"])]
    reset: Option<String>,
    /// Print JSON
    #[arg(long)]
    json: bool,
    /// Folder that contains /sys, /proc and /dev
    #[arg(long, value_name = "DIR", default_value = "/", hide = true)]
    sys_root: PathBuf,
}

/// Lists the cameras, or resets one.
pub fn run(args: &CamerasArgs, context: &Context) -> Result<Exit> {
    if let Some(serial) = &args.reset {
        let camera = RealsenseBackend::new(RealsenseConfig::default()).reset(Some(serial))?;
        let model = camera.model;
        let serial = camera.serial;
        let port = camera.port;
        out::line(format_args!("{model} {serial} at USB port {port} restarts and is back in some seconds"))?;
        return Ok(Exit::Good);
    }
    let root = SysRoot::new(&args.sys_root);
    let ask = System { runtime: context.runtime().ok(), rig: Vec::new(), root: root.clone() };
    let mut attached = look(&root, &ask)?;
    if let Some(part) = &args.only {
        let part = part.to_lowercase();
        let has = |text: &str| text.to_lowercase().contains(&part);
        attached.cameras.retain(|c| has(&c.model) || has(&c.port) || c.serial.as_deref().is_some_and(has));
    }
    if args.json {
        out::json(&attached)?;
    } else {
        let width = screen::size().map_or(120, |(width, _)| width);
        out::line(text(&attached, args, width))?;
    }
    Ok(exit(&attached))
}

fn exit(attached: &Attached) -> Exit {
    let usable = |c: &AttachedCamera| matches!(c.state, UseState::Free | UseState::InUse);
    if attached.cameras.iter().all(usable) && attached.not_asked.is_empty() { Exit::Good } else { Exit::Lost }
}

fn text(attached: &Attached, args: &CamerasArgs, width: usize) -> String {
    if attached.cameras.is_empty() {
        let nothing =
            if args.only.is_some() { "no such camera is attached" } else { "no camera is attached" };
        let more = attached.unusable.iter().flat_map(|line| out::item("!", line, width));
        return [nothing.to_owned()].into_iter().chain(more).collect::<Vec<_>>().join("\n");
    }
    let mut lines = vec![table(&attached.cameras, width)];
    for c in &attached.cameras {
        let mut more = Vec::new();
        if c.state == UseState::InUse {
            more.extend(out::item("-", &format!("in use by {}", c.held_words()), width));
        }
        more.extend(c.problems.iter().flat_map(|p| out::item("!", p, width)));
        if args.nodes {
            let on = c.controller.as_ref().map(|n| format!("controller {n}"));
            let metadata = c.kernel_metadata.map(|level| format!("kernel metadata: {level}"));
            let sleep = c.may_sleep.map(|may| format!("autosuspend: {}", if may { "yes" } else { "no" }));
            let facts: Vec<_> = c.usb_id.clone().into_iter().chain(on).chain(metadata).chain(sleep).collect();
            more.extend(out::item("-", &facts.join(", "), width));
            for n in &c.nodes {
                let formats = n.formats.join(" ");
                more.extend(out::item("-", &format!("{} {} {formats}", n.path, n.role), width));
            }
        }
        if args.modes {
            more.extend(modes(&c.modes).iter().flat_map(|m| out::item("-", m, width)));
            if c.modes.is_empty() {
                more.extend(out::item("-", &format!("its modes are not known: {}", c.state.name()), width));
            }
        }
        if !more.is_empty() {
            lines.push(String::new());
            lines.push(c.describe());
            lines.extend(more);
        }
    }
    let notes = attached.unusable.iter().chain(&attached.not_asked);
    let notes: Vec<_> = notes.flat_map(|line| out::item("!", line, width)).collect();
    if !notes.is_empty() {
        lines.push(String::new());
        lines.extend(notes);
    }
    lines.join("\n")
}

/// A table with one camera per line and as many columns as fit.
fn table(cameras: &[AttachedCamera], width: usize) -> String {
    let or_dash = |text: &Option<String>| text.clone().unwrap_or_else(|| "-".to_owned());
    let header = ["model", "serial", "port", "USB", "state", "backend", "calibration", "firmware"];
    let row = |c: &AttachedCamera| {
        [
            c.model.clone(),
            or_dash(&c.serial),
            c.port.clone(),
            speed(c),
            c.state.name().to_owned(),
            c.backend.to_owned(),
            or_dash(&c.calibration),
            or_dash(&c.firmware),
        ]
    };
    let with = |columns: usize| {
        let rows = cameras.iter().map(|c| row(c).into_iter().take(columns).collect());
        out::table(header.get(..columns).unwrap_or(&header), usize::MAX, rows)
    };
    let fits = |text: &String| text.lines().all(|line| line.chars().count() <= width);
    (6..=header.len()).rev().map(with).find(fits).unwrap_or_else(|| with(6))
}

/// `USB3 5 Gbit/s`.
fn speed(c: &AttachedCamera) -> String {
    match c.usb_mbps {
        None => "-".to_owned(),
        Some(0) => "?".to_owned(),
        Some(mbps @ 5000..) => format!("USB3 {} Gbit/s", mbps / 1000),
        Some(mbps @ 480..) => format!("USB2 {mbps} Mbit/s"),
        Some(mbps) => format!("USB1 {mbps} Mbit/s"),
    }
}

/// One line for each stream, format and size: `depth z16 848x480: 90, 60, 30, 15 Hz`.
fn modes(all: &[ModeReport]) -> Vec<String> {
    let mut lines: Vec<(String, Vec<f64>)> = Vec::new();
    for m in all {
        let (what, rate_hz) = match m.samples_hz() {
            Some(hz) => (format!("{} {}", m.stream, m.format), hz),
            None => (format!("{} {} {}x{}", m.stream, m.format, m.width, m.height), m.rate_hz),
        };
        match lines.iter_mut().find(|(w, _)| *w == what) {
            Some((_, rates)) => rates.push(rate_hz),
            None => lines.push((what, vec![rate_hz])),
        }
    }
    let line = |(what, mut rates): (String, Vec<f64>)| {
        rates.sort_by(|a, b| b.total_cmp(a));
        rates.dedup();
        let rates: Vec<_> = rates.iter().map(f64::to_string).collect();
        format!("{what}: {} Hz", rates.join(", "))
    };
    lines.into_iter().map(line).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rates_of_one_size_share_a_line() {
        let mode = |stream: &str, height, rate_hz| ModeReport {
            stream: stream.into(),
            format: "z16",
            width: 640,
            height,
            rate_hz,
        };
        let all = [
            mode("depth", 480, 30.0),
            mode("depth", 480, 15.0),
            mode("depth", 480, 30.0),
            mode("depth", 360, 90.0),
        ];
        assert_eq!(modes(&all), ["depth z16 640x480: 30, 15 Hz", "depth z16 640x360: 90 Hz"]);
    }
}
