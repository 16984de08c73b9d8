//! `depthrig cdm relabel`: copies a dataset and adds refined depth to the copy.

use super::pieces::{Request, step_name};
use super::store::Models;
use crate::context::Context;
use crate::exit::{Exit, UsageError};
use crate::out;
use crate::scratch::Scratch;
use crate::watched::{DerivedDataset, watched};
use anyhow::Result;
use clap::ValueEnum;
use depthrig_cdm::stage::{CdmConfig, EngineChoice, RefineConfig, RefineModel};
use depthrig_cdm::store::names_a_file;
use depthrig_cdm::tiny::is_tiny_file;
use depthrig_cdm::{FillRefiner, Precision};
use depthrig_convert::RunPart;
use depthrig_convert::relabel::{RelabelOptions, RelabelReport, relabel};
use depthrig_convert::store::Place;
use depthrig_recorder::Dataset;
use std::path::{Path, PathBuf};

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
OUT is DATASET plus a stream depth_refined for every camera that has color and depth, in the view and size of colour.
All other images are copied as stored; DATASET is only read. Until OUT is complete, the work is in OUT.relabel: run
the command again with the same options to resume an interrupted run.

With --shard each segment of DATASET, or of each dataset in the folder DATASET, becomes a dataset of its own in OUT, with
account.json in it; `depthrig merge` joins those of a recording. --shard 0/4 makes the first of four parts, on this
computer or another one; what is complete is left alone. DATASET and OUT may be s3://BUCKET/PREFIX, with credentials
and endpoint of the variables AWS_... (docs/depth-lab.md).

Exit codes: 0 success, 1 failed or interrupted (OUT does not exist), 2 wrong usage or a dataset that cannot be refined,
3 done, but parts of DATASET could not be read; with --shard also when segments were skipped or are missing.

Examples:
  depthrig cdm relabel data/20261121_1015_kitchen data/kitchen_fill --engine fill
  depthrig cdm relabel data/20261121_1015_kitchen --out data/kitchen_cdm --model cdm-d435 -j 2 --threads 4
  depthrig cdm relabel data --out refined --engine fill --shard 2/8
  depthrig cdm relabel s3://rigs/data --out s3://rigs/refined --engine fill --shard 2/8";

/// Engine that refines depth.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Engine {
    /// Each camera's model if one is installed, else fill
    Auto,
    /// Colour-guided hole filling; needs no model
    Fill,
    /// The small network of this program after fill, or a NAME.onnx like it
    Tiny,
    /// ONNX Runtime with a camera depth model
    Onnxruntime,
}

/// Arguments.
#[derive(Debug, clap::Args)]
pub struct RelabelArgs {
    /// Dataset folder; with --shard also a folder of datasets, or s3://BUCKET/PREFIX
    dataset: PathBuf,
    /// Folder of the new dataset, must not exist; with --shard of all the new datasets
    #[arg(value_name = "OUT", required_unless_present = "out_option")]
    out: Option<PathBuf>,
    /// OUT as an option
    #[arg(long = "out", value_name = "OUT", id = "out_option", conflicts_with = "out")]
    out_option: Option<PathBuf>,
    /// Engine that refines depth
    #[arg(long, value_enum, default_value = "auto")]
    engine: Engine,
    /// Installed model, checkpoint or NAME.onnx for all cameras [default: per camera]
    #[arg(long, value_name = "MODEL")]
    model: Option<String>,
    /// Shorter side of the network's input, pixels [default: the model's]
    #[arg(long, value_name = "N")]
    input_size: Option<u32>,
    /// Device that runs the network: cpu, cuda:0, tensorrt:0 or openvino
    #[arg(long, default_value = "cpu")]
    device: String,
    /// Precision of the network: fp32, fp16 or bf16
    #[arg(long, value_name = "PRECISION", default_value = "fp32", value_parser = super::run::precision)]
    precision: Precision,
    /// ONNX Runtime library [default: found automatically]
    #[arg(long, value_name = "FILE")]
    library: Option<PathBuf>,
    /// Treat depth as registered to colour, regardless of the calibration
    #[arg(long)]
    is_aligned: bool,
    /// Reach of fill and tiny from measured depth, fraction of the width; 1: no limit
    #[arg(long, value_name = "PART", value_parser = crate::args::fill_reach, default_value_t = FillRefiner::REACH)]
    fill_reach: f64,
    /// Images to process in parallel [default: one per core; 1 with a depth model]
    #[arg(short = 'j', long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=256))]
    jobs: Option<u16>,
    /// Threads per image [default: 1; all cores with a depth model]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=256))]
    threads: Option<u16>,
    /// Part of the segments to refine: K of N, from 0; s3:// without it: 0/1
    #[arg(long, value_name = "K/N")]
    shard: Option<RunPart>,
    #[command(flatten)]
    scratch: Scratch,
    #[command(flatten)]
    models: Models,
    /// Print the report as JSON
    #[arg(long)]
    json: bool,
}

impl RelabelArgs {
    fn options(&self) -> RelabelOptions {
        let is_tiny = self.model.as_deref().is_some_and(|name| is_tiny_file(Path::new(name)));
        let engine = match self.engine {
            Engine::Auto if is_tiny => EngineChoice::Tiny,
            Engine::Auto => EngineChoice::Auto,
            Engine::Fill => EngineChoice::Fill,
            Engine::Tiny => EngineChoice::Tiny,
            Engine::Onnxruntime => EngineChoice::OnnxRuntime,
        };
        let model = self.model.as_ref().map(|name| {
            let path = PathBuf::from(name);
            let is_file = names_a_file(name) || path.is_file();
            if is_file { RefineModel::File(path) } else { RefineModel::Installed(name.clone()) }
        });
        let refine = RefineConfig {
            engine,
            model,
            input_size: self.input_size,
            device: self.device.clone(),
            precision: self.precision,
            is_aligned: self.is_aligned,
            fill_reach: self.fill_reach,
            ..RefineConfig::default()
        };
        let cdm = CdmConfig {
            library: self.library.clone(),
            models: self.models.dir.clone(),
            ..CdmConfig::default()
        };
        let cores = std::thread::available_parallelism().map_or(1, std::num::NonZero::get);
        let is_light = matches!(engine, EngineChoice::Fill | EngineChoice::Tiny);
        let (workers, threads) = if is_light { (cores, 1) } else { (1, cores) };
        RelabelOptions {
            refine,
            cdm,
            workers: self.jobs.map_or(workers, usize::from),
            threads: self.threads.map_or(threads, usize::from),
        }
    }
}

/// Adds refined depth and reports the result.
pub fn run(args: &RelabelArgs, context: &Context) -> Result<Exit> {
    let Some(out) = args.out.as_ref().or(args.out_option.as_ref()) else {
        return Err(UsageError("name the new dataset with --out OUT".to_owned()).into());
    };
    let options = args.options();
    if args.shard.is_some() || Place::is_remote(&args.dataset) || Place::is_remote(out) {
        let request = Request {
            input: &args.dataset,
            out,
            part: args.shard.unwrap_or(RunPart::ALL),
            scratch: &args.scratch,
            json: args.json,
        };
        return super::pieces::run(&request, &options, context);
    }
    let dataset = Dataset::open(&args.dataset)?;
    let report = watched(context, |progress| {
        relabel(&dataset, out, &options, &mut |step, done, total| progress(step_name(step), done, total))
    })?;
    let derived = DerivedDataset {
        path: &report.path,
        sets: report.sets,
        bytes: report.bytes,
        ended: report.ended,
        lost: report.lost,
        problems: &report.problems,
        lacks: false,
    };
    derived.print(context, args.json.then_some(&report), || print_streams(&report))
}

fn print_streams(report: &RelabelReport) -> Result<()> {
    for s in &report.streams {
        let with = if s.model.is_empty() { String::new() } else { format!(" with {}", s.model) };
        out::line(format_args!("  {}: {} by {}{with}", s.stream, out::count(s.frames, "frame"), s.engine))?;
        if let Some(note) = &s.note {
            out::line(format_args!("  note: {note}"))?;
        }
    }
    Ok(())
}
