//! `depthrig status`: prints the status of the running rig.

use crate::context::Context;
use crate::exit::Exit;
use crate::signals::Stop;
use crate::view::{self, Style};
use crate::{out, screen};
use anyhow::Result;
use core::time::Duration;
use depthrig_daemon::status::{
    CameraState, CameraStatus, HostsStatus, LinkState, RefineState, RigStatus, SignalState,
};

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
Exit code 3 if a camera is not streaming, a required signal does not come, the clock of the session or another computer does not answer, depth that should be refined is not, or the recording lost anything.

Examples:
  depthrig status
  depthrig status --json | jq '.cameras[].streams[] | {id, rate_hz, dropped}'
  depthrig status --watch --json >> rig.jsonl";

/// Arguments.
#[derive(Debug, clap::Args)]
pub struct StatusArgs {
    /// Print again every second until Ctrl-C
    #[arg(long)]
    watch: bool,
    /// Print JSON; with --watch one object per line
    #[arg(long)]
    json: bool,
}

/// Prints the status once, or every second with `--watch`.
pub fn run(args: &StatusArgs, context: &Context) -> Result<Exit> {
    let client = super::record::connect(context)?;
    let style = Style { width: screen::size().map_or(120, |(width, _)| width), color: context.color() };
    let print = |rig: &RigStatus| match (args.json, args.watch) {
        (true, false) => out::json(rig),
        (true, true) => out::json_line(rig),
        (false, false) => out::styled(view::status(rig, style)),
        (false, true) => out::styled(format_args!("{}\n", view::status(rig, style))),
    };
    let stop = args.watch.then(Stop::on_signals).transpose()?;
    loop {
        let rig = client.status()?;
        print(&rig)?;
        if stop.as_ref().is_none_or(|stop| stop.wait(Duration::from_secs(1))) {
            return Ok(exit(&rig));
        }
    }
}

fn exit(rig: &RigStatus) -> Exit {
    let fine = |state| matches!(state, CameraState::Streaming | CameraState::Finished | CameraState::Opening);
    let lost =
        rig.recording.as_ref().is_some_and(|r| r.error.is_some() || r.dropped.values().any(|n| *n > 0));
    let refined = |c: &CameraStatus| c.refine.as_ref().is_none_or(|r| r.state != RefineState::Failed);
    let silent = rig.signals.iter().any(|s| s.required && s.state != SignalState::Live);
    let adrift = rig.link.as_ref().is_some_and(|l| !matches!(l.state, LinkState::Own | LinkState::Live));
    if lost
        || silent
        || adrift
        || rig.ros2.as_ref().is_some_and(|ros2| ros2.pid.is_none())
        || rig.hosts.as_ref().is_some_and(HostsStatus::is_ill)
        || !rig.cameras.iter().all(refined)
        || !rig.cameras.iter().all(|c| fine(c.state))
    {
        Exit::Lost
    } else {
        Exit::Good
    }
}
