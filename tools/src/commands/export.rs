//! `depthrig export`: exports datasets to other layouts.

use crate::calibrate::corrected::Corrected;
use crate::context::Context;
use crate::exit::{Exit, UsageError};
use crate::out;
use crate::progress::Progress;
use crate::signals::Stop;
use anyhow::Result;
use core::ops::ControlFlow;
use depthrig_convert::lerobot::Lerobot;
use depthrig_convert::{ExportOptions, ExportReport, Exporter, Hdf5, Zarr, export};
use depthrig_recorder::fs::RealFs;
use depthrig_recorder::{Dataset, ErrorKind, Mark};
use std::path::PathBuf;

mod bytecameradepth;
mod lerobot;

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
OUT is a new folder. Run the command again with the same datasets and options to resume an
interrupted export; the result is the same as without the interruption. Nothing is ever
overwritten. OUT/export.json, written last, lists what was exported and what was lost;
docs/exchange.md describes each layout. Datasets marked bad (`depthrig edit DATASET --mark bad`) are left out.

Exit codes: 0 success, 1 failed or interrupted, 2 wrong usage, 3 exported, but some sets, frames or
pixels could not be.

Examples:
  depthrig export bytecameradepth data/20261121_1015_kitchen paper
  depthrig export lerobot data/20261121_1015_kitchen lerobot/kitchen
  depthrig export lerobot data/* lerobot/all --task \"put the cup on the shelf\"";

/// Examples for `--help` of `export zarr`.
const ZARR_EXAMPLES: &str = "\
Rows, episodes and values are those of depthrig export lerobot, with the same options. Images are exact; a missing one is zeros, and
true in missing_CAMERA_STREAM.

Examples:
  depthrig export zarr data/20261121_1015_kitchen kitchen.zarr
  depthrig export zarr data/2026* all.zarr --state arm/joint_position --action policy/action";

/// Examples for `--help` of `export hdf5`.
const HDF5_EXAMPLES: &str = "\
Rows, episodes and values are those of depthrig export lerobot, with the same options. OUT/demo.hdf5 is in the layout of robomimic, whose
loader reads it as it is. Images are exact; a missing one is zeros, and true in missing/CAMERA_STREAM.

Examples:
  depthrig export hdf5 data/20261121_1015_kitchen kitchen
  depthrig export hdf5 data/2026* all --state arm/joint_position --action policy/action";

/// Layouts to export to.
#[derive(Debug, clap::Subcommand)]
pub enum ExportCommand {
    /// Export to the layout of ByteCameraDepth, with times and calibration
    #[command(after_help = bytecameradepth::EXAMPLES)]
    Bytecameradepth(bytecameradepth::Args),
    /// Export to LeRobot v3.0: an episode per episode, or per dataset without any; JPEG/PNG colour, TIFF depth
    #[command(after_help = lerobot::EXAMPLES)]
    Lerobot(lerobot::Args),
    /// Export to HDF5 in the layout of robomimic: one file, a group per episode with observations and actions
    #[command(after_help = HDF5_EXAMPLES)]
    Hdf5(lerobot::Args),
    /// Export to Zarr in the layout of diffusion_policy's replay buffer: an array per stream, state and action
    #[command(after_help = ZARR_EXAMPLES)]
    Zarr(lerobot::Args),
}

/// Options of every export.
#[derive(Debug, clap::Args)]
pub struct Common {
    /// Dataset folders
    #[arg(required = true, value_name = "DATASET")]
    datasets: Vec<PathBuf>,
    /// New folder for the export
    #[arg(required = true)]
    out: PathBuf,
    /// Parts of 100 sets to process in parallel [default: one per core]
    #[arg(short = 'j', long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=256))]
    jobs: Option<u16>,
    #[command(flatten)]
    corrected: Corrected,
    /// Print the report as JSON
    #[arg(long)]
    json: bool,
}

/// Runs the export.
pub fn run(command: &ExportCommand, context: &Context) -> Result<Exit> {
    match command {
        ExportCommand::Bytecameradepth(args) => {
            let (mut exporter, common) = args.exporter()?;
            drive(&mut exporter, common, context)
        }
        ExportCommand::Lerobot(args) => {
            let (options, common) = args.options();
            drive(&mut Lerobot::new(options), common, context)
        }
        ExportCommand::Hdf5(args) => {
            let (options, common) = args.options();
            drive(&mut Hdf5::new(options), common, context)
        }
        ExportCommand::Zarr(args) => {
            let (options, common) = args.options();
            drive(&mut Zarr::new(options), common, context)
        }
    }
}

/// Runs an exporter with a progress bar and prints its report.
fn drive(exporter: &mut dyn Exporter, common: &Common, context: &Context) -> Result<Exit> {
    let dir = &common.out;
    let open = |path: &PathBuf| common.corrected.of(Dataset::open(path)?);
    let mut datasets = common.datasets.iter().map(open).collect::<Result<Vec<_>>>()?;
    datasets.retain(|dataset| {
        let is_bad = dataset.session().mark == Some(Mark::Bad);
        if is_bad {
            let path = dataset.path().display();
            out::note(format_args!(
                "left out: {path} is marked bad (take it back with: depthrig edit {path} --mark none)"
            ));
        }
        !is_bad
    });
    if datasets.is_empty() {
        return Err(UsageError("every dataset is marked bad; there is nothing to export".to_owned()).into());
    }
    let mut options = ExportOptions::default();
    if let Some(jobs) = common.jobs {
        options.workers = usize::from(jobs);
    }
    let stop = Stop::on_signals()?;
    let mut bar = Progress::new(context.global.quiet > 0);
    let report = export(&RealFs, exporter, datasets, dir, options, &mut |p| {
        bar.set("export", p.sets, p.total);
        if stop.is_asked() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    })
    .map_err(usage)?;
    bar.clear();
    if common.json {
        out::json(&report)?;
    } else if context.global.quiet == 0 {
        print_report(&report, dir)?;
    }
    for problem in &report.problems {
        out::note(format_args!("lost: {problem}"));
    }
    Ok(match report {
        _ if report.ended => Exit::Failed,
        _ if report.lost > 0 => Exit::Lost,
        _ => Exit::Good,
    })
}

fn print_report(report: &ExportReport, dir: &std::path::Path) -> Result<()> {
    let dir = dir.display();
    if report.ended {
        return out::line(format_args!("{dir}: interrupted; run it again to resume"));
    }
    let resumed = match report.parts_resumed {
        0 => String::new(),
        n if n == report.parts => " (was there already)".to_owned(),
        n => format!(" ({n} of {} parts were there already)", report.parts),
    };
    out::line(format_args!(
        "{dir}: {} of {} in {}, {}{resumed}",
        out::count(report.frames, "frame"),
        out::count(report.sets, "set"),
        out::count(report.files, "file"),
        out::bytes(report.bytes)
    ))?;
    for loss in &report.losses {
        out::line(format_args!("note: {loss}"))?;
    }
    for (counter, n) in &report.counters {
        out::line(format_args!("note: {counter}: {n}"))?;
    }
    Ok(())
}

/// Turns an error about the input into a usage error (exit code 2).
pub fn usage(e: depthrig_recorder::Error) -> anyhow::Error {
    match e.kind() {
        ErrorKind::BadInput => UsageError(e.to_string()).into(),
        _ => e.into(),
    }
}
