//! `depthrig zed replay`: recomputes depth from recorded raw stereo, in several modes at once.

use crate::context::Context;
use crate::exit::{Exit, UsageError};
use crate::out;
use crate::watched::{DerivedDataset, watched};
use anyhow::Result;
use clap::ValueEnum;
use depthrig_convert::zed_replay::{
    NetworkChoice, NetworkPixels, OpenOptions, Step, ZedReplayOptions, ZedReplayReport, zed_replay,
};
use depthrig_recorder::ColorCodec;
use depthrig_stereo::Mode;
use depthrig_zed::CalibrationFile;
use std::path::PathBuf;

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
INPUT is a dataset with the raw streams left and right of a camera, a folder of side-by-side images, or an SVO2 file.
The new dataset has rectified colour, and for each mode depth_MODE and confidence_MODE in the view of the left camera.
performance, quality and ultra are depthrig's own stereo, recorded as mimic_performance and so on; neural is your own
stereo network in ONNX format. Until the dataset is complete, the work is in DATASET.zedreplay: run the command again
with the same options to resume an interrupted run.

Exit codes: 0 success, 1 failed (also: INPUT is not a recording) or interrupted (DATASET does not exist), 2 wrong usage,
or a recording without stereo pairs or calibration, 3 done, but some pairs could not be read or a mode is unavailable.

Examples:
  depthrig zed replay data/20261121_1015_kitchen --modes performance,ultra,quality --out data/kitchen_depth
  depthrig zed replay kitchen.svo2 --modes quality,neural --network hitnet.onnx --out data/kitchen_depth --disparity
  depthrig zed replay side_by_side/ --calibration SN12345.conf --out data/kitchen_depth -j 4";

/// Storage of colour.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Color {
    /// JPEG of quality 95
    Jpeg,
    /// Lossless PNG
    Png,
    /// Lossless, not encoded as an image
    Raw,
}

/// Arguments.
#[derive(Debug, clap::Args)]
pub struct ReplayArgs {
    /// Dataset, folder of side-by-side images, or SVO2 file
    #[arg(value_name = "INPUT")]
    input: PathBuf,
    /// Folder of the new dataset; must not exist
    #[arg(long, value_name = "DATASET")]
    out: PathBuf,
    /// Depth modes: performance, ultra, quality, neural
    #[arg(long, value_name = "MODES", value_delimiter = ',', default_value = "performance,ultra,quality")]
    modes: Vec<String>,
    /// Stereo network of the mode neural, an ONNX file
    #[arg(long, value_name = "FILE")]
    network: Option<PathBuf>,
    /// Pixel range: 0-255, 0-1, -1-1 or imagenet [default: its metadata's, else 0-255]
    #[arg(long, value_name = "PIXELS", requires = "network", allow_hyphen_values = true)]
    network_pixels: Option<String>,
    /// The network outputs negative disparity
    #[arg(long, requires = "network")]
    network_negative: bool,
    /// Device that runs the network: cpu, cuda:0, tensorrt:0 or openvino
    #[arg(long, default_value = "cpu")]
    device: String,
    /// ONNX Runtime library [default: found automatically]
    #[arg(long, value_name = "FILE")]
    library: Option<PathBuf>,
    /// Camera to process if the dataset has several, else its new name [default: zed2i]
    #[arg(long, value_name = "NAME")]
    camera: Option<String>,
    /// The camera's SN<serial>.conf [default: beside the input or in the SDK's folder]
    #[arg(long, value_name = "FILE")]
    calibration: Option<PathBuf>,
    /// Serial number of the camera, if the recording lacks it
    #[arg(long, value_name = "NUMBER")]
    serial: Option<String>,
    /// Rate of pairs without timestamps, Hz [default: 30]
    #[arg(long, value_name = "HZ", value_parser = crate::args::rate_hz)]
    rate: Option<f64>,
    /// Also record disparity_MODE
    #[arg(long)]
    disparity: bool,
    /// Nearest depth, metres; half of it takes twice the time
    #[arg(long, value_name = "METRES", default_value_t = 0.3, value_parser = crate::args::range_limit_m)]
    min_depth: f64,
    /// Farthest depth, metres; anything beyond is a hole
    #[arg(long, value_name = "METRES", default_value_t = 20.0, value_parser = crate::args::range_limit_m)]
    max_depth: f64,
    /// Metres per depth unit
    #[arg(long, value_name = "METRES", default_value_t = 0.001, value_parser = crate::args::depth_unit_m)]
    depth_unit: f64,
    /// Storage of rectified colour
    #[arg(long, value_enum, default_value = "jpeg")]
    color_codec: Color,
    /// Pairs and modes to process in parallel [default: one per core]
    #[arg(short = 'j', long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=256))]
    jobs: Option<u16>,
    /// Threads per job
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..=256))]
    threads: u16,
    /// Memory limit, GB; may reduce the parallel jobs [default: half the free memory]
    #[arg(long, value_name = "GB", value_parser = crate::args::memory_gb)]
    memory: Option<f64>,
    /// Print the report as JSON
    #[arg(long)]
    json: bool,
}

impl ReplayArgs {
    fn options(&self) -> Result<ZedReplayOptions> {
        let usage = |text: String| anyhow::Error::from(UsageError(text));
        let modes = self.modes.iter().map(|m| m.trim().parse::<Mode>().map_err(|e| usage(e.to_string())));
        let pixels = self.network_pixels.as_ref().map(|p| p.parse::<NetworkPixels>());
        let pixels = pixels.transpose().map_err(|e| usage(e.to_string()))?;
        let network = self.network.clone().map(|file| NetworkChoice {
            file,
            library: self.library.clone(),
            device: self.device.clone(),
            pixels,
            negative: self.network_negative,
        });
        let mut options = ZedReplayOptions {
            modes: modes.collect::<Result<_>>()?,
            network,
            camera: self.camera.clone(),
            disparity: self.disparity,
            range_m: (self.min_depth, self.max_depth),
            depth_unit_m: self.depth_unit,
            color: match self.color_codec {
                Color::Jpeg => ColorCodec::Jpeg,
                Color::Png => ColorCodec::Png,
                Color::Raw => ColorCodec::Raw,
            },
            threads: self.threads.into(),
            open: OpenOptions {
                calibration: self.calibration.clone().map_or_else(Default::default, CalibrationFile::At),
                serial: self.serial.clone(),
                rate_hz: self.rate,
            },
            ..ZedReplayOptions::default()
        };
        if options.network.is_some() && !options.modes.contains(&Mode::Neural) {
            return Err(usage("--network is for the mode neural, which --modes does not name".to_owned()));
        }
        if let Some(jobs) = self.jobs {
            options.jobs = jobs.into();
        }
        if let Some(gb) = self.memory {
            options.memory_bytes = (gb * 1e9) as u64;
        }
        Ok(options)
    }
}

/// Recomputes depth and reports the result.
pub fn run(args: &ReplayArgs, context: &Context) -> Result<Exit> {
    let options = args.options()?;
    let report = watched(context, |progress| {
        zed_replay(&args.input, &args.out, &options, &mut |step, done, total| {
            progress(if step == Step::Replay { "depth" } else { "verify" }, done, total)
        })
    })?;
    let derived = DerivedDataset {
        path: &report.path,
        sets: report.sets,
        bytes: report.bytes,
        ended: report.ended,
        lost: report.lost,
        problems: &report.problems,
        lacks: !report.unavailable.is_empty(),
    };
    derived.print(context, args.json.then_some(&report), || print_modes(&report))
}

fn print_modes(report: &ZedReplayReport) -> Result<()> {
    if report.resumed > 0 {
        out::line(format_args!("  {} of them by an earlier run", report.resumed))?;
    }
    for m in &report.modes {
        let frames = out::count(m.frames, "frame");
        out::line(format_args!("  {}: {frames}, {} by {}", m.mode, m.recorded_as, m.producer))?;
        out::line(format_args!("    {}", m.parameters))?;
        if !m.shared_with.is_empty() {
            out::line(format_args!("    matched at once with {}", m.shared_with.join(" and ")))?;
        }
    }
    for line in &report.unavailable {
        out::line(format_args!("  {line}"))?;
    }
    for note in &report.notes {
        out::line(format_args!("  note: {note}"))?;
    }
    let jobs = out::count(report.jobs as u64, "pair");
    let memory = out::bytes(report.memory_bytes);
    out::line(format_args!("  {jobs} at once, {memory} of memory at most for pairs and matchers"))?;
    let cpu = &report.cpu;
    if cpu.pairs > 0 {
        let each = |s: f64| s * 1e3 / cpu.pairs as f64;
        out::line(format_args!(
            "  processor time per pair: {:.0} ms, of which stereo {:.0}, reading {:.0}, rectifying {:.0}, depth {:.0}",
            each(cpu.total_s),
            each(cpu.stereo_s),
            each(cpu.read_s),
            each(cpu.rectify_s),
            each(cpu.depth_s)
        ))?;
    }
    Ok(())
}
