//! `depthrig import`: imports recordings of other programs as datasets.

use crate::context::Context;
use crate::exit::{Exit, UsageError};
use crate::out;
use crate::progress::Progress;
use crate::signals::Stop;
use anyhow::Result;
use clap::ValueEnum;
use core::ops::ControlFlow;
use depthrig_bus::CameraName;
use depthrig_convert::kinect::{KinectImport, KinectOptions};
use depthrig_convert::scenes::SceneSets;
use depthrig_convert::{ByteCameraImport, ByteCameraOptions, ImportReport, Importer, RosbagImport, import};
use depthrig_kinect::playback::CalibrationSource;
use depthrig_recorder::fs::{Fs, RealFs};
use depthrig_recorder::{ColorCodec, RecorderOptions, check_outside};
use depthrig_sim::synthetic::scenes::Generator;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
OUT is a new dataset, verified at the end. Assumptions are printed and stored in the table [import]
of its session.toml; docs/exchange.md describes each layout.

Exit codes: 0 success, 1 failed or interrupted, 2 wrong usage, 3 imported, but part of the input
could not be.

Examples:
  depthrig import bytecameradepth recorded_data/20250314_1512 data/20250314_1512_kitchen
  depthrig import rosbag 20260314_151200.bag data/20260314_1512_kitchen
  depthrig import kinect kitchen.mkv data/kitchen";

const BYTECAMERA_EXAMPLES: &str = "\
FOLDER holds camera_<model> folders with depth_N.png, color_N.png, ir_N.png and raw_depth_N.npy. With
the frames.csv and calibration.json of an export the original dataset is restored; without them,
times are derived from N and depth units from the camera models.

Exit codes: 0 success, 1 failed or interrupted, 2 wrong usage, 3 imported, but part of the input
could not be.

Examples:
  depthrig import bytecameradepth recorded_data/20250314_1512 data/20250314_1512_kitchen
  depthrig import bytecameradepth monday data/monday --depth-unit d405=0.0001 --rate 5";

const ROSBAG_EXAMPLES: &str = "\
Images with their counters, device times, exposure and gain, intrinsics, poses and options are
imported; IMU messages are not. From a truncated or damaged bag, every readable part is imported.

Exit codes: 0 success, 1 failed or interrupted, 2 wrong usage, 3 imported, but part of the bag
could not be.

Examples:
  depthrig import rosbag 20260314_151200.bag data/20260314_1512_kitchen
  depthrig import rosbag 20260314_151200.bag data/small --color-codec jpeg --json";

const KINECT_EXAMPLES: &str = "\
JPEG, depth, infrared and IMU samples are imported unchanged, with device times, calibration and
serial number. From a truncated or damaged file, every complete cluster is imported.

Exit codes: 0 success, 1 failed or interrupted, 2 wrong usage, 3 imported, but part of the file
could not be.

Examples:
  depthrig import kinect kitchen.mkv data/kitchen
  depthrig import kinect old.mkv data/old --camera kinect_left --calibration 000123456789.json";

/// Layouts to import from.
#[derive(Debug, clap::Subcommand)]
pub enum ImportCommand {
    /// Import a session of ByteCameraDepth, or one that depthrig exported
    #[command(after_help = BYTECAMERA_EXAMPLES)]
    Bytecameradepth(ByteCameraArgs),
    /// Import a rosbag (version 2, .bag) of librealsense or the RealSense Viewer
    #[command(after_help = ROSBAG_EXAMPLES)]
    Rosbag(RosbagArgs),
    /// Import an Azure Kinect .mkv of k4arecorder or another program of its SDK
    #[command(after_help = KINECT_EXAMPLES)]
    Kinect(KinectArgs),
}

impl ImportCommand {
    fn input(&self) -> &Path {
        match self {
            Self::Bytecameradepth(args) => &args.input,
            Self::Rosbag(args) => &args.input,
            Self::Kinect(args) => &args.input,
        }
    }

    const fn common(&self) -> &Common {
        match self {
            Self::Bytecameradepth(args) => &args.common,
            Self::Rosbag(args) => &args.common,
            Self::Kinect(args) => &args.common,
        }
    }
}

/// Options of every import.
#[derive(Debug, clap::Args)]
struct Common {
    /// Folder of the new dataset
    out: PathBuf,
    /// Storage of colour
    #[arg(long, value_enum, default_value = "raw", value_name = "CODEC")]
    color_codec: Color,
    /// Print the report as JSON
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum Color {
    /// Lossless
    Raw,
    /// JPEG of quality 95: a tenth of the size, lossy
    Jpeg,
}

/// Arguments of `import bytecameradepth`.
#[derive(Debug, clap::Args)]
pub struct ByteCameraArgs {
    /// Folder of one session
    #[arg(value_name = "FOLDER")]
    input: PathBuf,
    #[command(flatten)]
    common: Common,
    /// Metres per depth unit, of all cameras or of CAM; repeatable
    #[arg(long = "depth-unit", value_name = "[CAM=]METRES", value_parser = depth_unit)]
    depth_units: Vec<(Option<String>, f64)>,
    /// Sets per second, without a frames.csv [default: 5]
    #[arg(long, value_name = "HZ", value_parser = crate::args::rate_hz)]
    rate: Option<f64>,
}

/// Arguments of `import rosbag`.
#[derive(Debug, clap::Args)]
pub struct RosbagArgs {
    /// Bag file
    #[arg(value_name = "FILE.bag")]
    input: PathBuf,
    #[command(flatten)]
    common: Common,
}

/// Arguments of `import kinect`.
#[derive(Debug, clap::Args)]
pub struct KinectArgs {
    /// Azure Kinect recording
    #[arg(value_name = "FILE.mkv")]
    input: PathBuf,
    #[command(flatten)]
    common: Common,
    /// Name of the camera in the dataset
    #[arg(long, default_value = "kinect", value_name = "NAME")]
    camera: CameraName,
    /// Device calibration (JSON), or "none" [default: the recording's]
    #[arg(long, value_name = "FILE")]
    calibration: Option<PathBuf>,
}

fn depth_unit(text: &str) -> Result<(Option<String>, f64), String> {
    let (camera, unit) = text.rsplit_once('=').map_or((None, text), |(c, u)| (Some(c.to_owned()), u));
    let unit = crate::args::depth_unit_m(unit).map_err(|why| format!("{why}, or d405=0.0001"))?;
    Ok((camera, unit))
}

/// Runs the import.
pub fn run(command: &ImportCommand, context: &Context) -> Result<Exit> {
    let fs: Arc<dyn Fs> = Arc::new(RealFs);
    check_outside(&command.common().out, command.input()).map_err(super::export::usage)?;
    match command {
        ImportCommand::Bytecameradepth(args) => {
            let mut options = ByteCameraOptions { rate_hz: args.rate, ..ByteCameraOptions::default() };
            options.name = name_of(&args.common.out);
            for (camera, unit) in &args.depth_units {
                match camera {
                    Some(camera) => drop(options.camera_depth_unit_m.insert(camera.clone(), *unit)),
                    None => options.depth_unit_m = Some(*unit),
                }
            }
            let importer = ByteCameraImport::open(Arc::clone(&fs), &args.input, options);
            drive("import", &mut importer.map_err(super::export::usage)?, fs, &args.common, context)
        }
        ImportCommand::Rosbag(args) => {
            let importer = RosbagImport::open(&*fs, &args.input, name_of(&args.common.out));
            drive("import", &mut importer.map_err(super::export::usage)?, fs, &args.common, context)
        }
        ImportCommand::Kinect(args) => {
            let importer = KinectImport::open(&args.input, kinect(args));
            drive("import", &mut importer.map_err(super::export::usage)?, fs, &args.common, context)
        }
    }
}

fn kinect(args: &KinectArgs) -> KinectOptions {
    let calibration = match &args.calibration {
        None => CalibrationSource::Recorded,
        Some(none) if none.as_os_str() == "none" => CalibrationSource::None,
        Some(path) => CalibrationSource::At(path.clone()),
    };
    KinectOptions { name: name_of(&args.common.out), camera: args.camera.clone(), calibration }
}

fn name_of(out: &Path) -> String {
    out.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

/// Records a run of random scenes as a dataset with lossless colour.
pub fn scenes(generator: Generator, count: u64, out: &Path, json: bool, context: &Context) -> Result<Exit> {
    let sets = SceneSets::new(generator, count, name_of(out)).map_err(super::export::usage)?;
    let common = Common { out: out.to_owned(), color_codec: Color::Raw, json };
    drive("making scenes", &mut { sets }, Arc::new(RealFs), &common, context)
}

/// Runs an importer with a progress bar, named by what it is `doing`, and prints its report.
fn drive(
    doing: &str,
    importer: &mut dyn Importer,
    fs: Arc<dyn Fs>,
    common: &Common,
    context: &Context,
) -> Result<Exit> {
    if name_of(&common.out).is_empty() {
        return Err(UsageError(format!("invalid dataset name: {}", common.out.display())).into());
    }
    let color = match common.color_codec {
        Color::Raw => ColorCodec::Raw,
        Color::Jpeg => ColorCodec::Jpeg,
    };
    let options = RecorderOptions { color, ..RecorderOptions::default() };
    let stop = Stop::on_signals()?;
    let mut bar = Progress::new(context.global.quiet > 0);
    let report = import(importer, fs, &common.out, options, &mut |p| {
        bar.set(doing, p.done, p.total);
        if stop.is_asked() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    })
    .map_err(super::export::usage)?;
    bar.clear();
    if common.json {
        out::json(&report)?;
    } else if context.global.quiet == 0 {
        for stated in &report.facts.stated {
            out::line(format_args!("note: {stated}"))?;
        }
        out::line(super::verify::summary(&report.verified))?;
    }
    if report.ended {
        let out = common.out.display();
        out::note(format_args!(
            "interrupted: {out} holds what was read until then; remove it and start again"
        ));
    }
    for lost in report.facts.problems.iter().chain(&report.summary.lost) {
        out::note(format_args!("lost: {lost}"));
    }
    Ok(exit(&report))
}

fn exit(report: &ImportReport) -> Exit {
    match super::verify::exit(&report.verified) {
        _ if report.ended => Exit::Failed,
        Exit::Good if report.facts.lost > 0 || !report.summary.complete => Exit::Lost,
        verified => verified,
    }
}
