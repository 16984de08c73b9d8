//! `depthrig eval`: evaluates depth and refiners against a reference.

use super::cdm::run::precision;
use super::cdm::store::Models;
use crate::context::Context;
use crate::eval::page::{Pictures, page};
use crate::eval::records::{Header, Reader, Writer, same_run};
use crate::eval::refine::{Choice, Refiners, RunOptions};
use crate::eval::run::Run;
use crate::eval::summary::{Evaluation, Summary};
use crate::eval::units::WrongUnit;
use crate::eval::{csv, hammer, merge, text};
use crate::exit::{Exit, UsageError};
use crate::out;
use crate::outfile::{OutFile, Overwrite};
use crate::progress::Progress;
use crate::scratch::Scratch;
use crate::signals::Stop;
use anyhow::{Result, bail};
use depthrig_bus::Intrinsics;
use depthrig_cdm::Precision;
use depthrig_cdm::metrics::{DepthRange, Rules};
use depthrig_convert::RunPart;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

mod source;

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
INPUT is a depthrig dataset with ground truth, a folder in the layout of the HAMMER dataset, or shards of `depthrig
scenes`. Without it, --truth names a folder of references, and --raw and each --pred folders with the same file paths
except for the extension (.png and .tiff: 16 bits; .tiff and .npy: metres).

--refine runs an engine (fill), an installed model, a checkpoint or a tiny.onnx on raw depth; `filled` is raw depth
with its holes filled, and NAME:filled a refiner that gets such depth. Plain metrics use the pixels where both have
depth. Strict metrics use all pixels with a valid reference and count missing depth as 0 m. docs/evaluation.md has the
definitions.

Exit codes: 0 compared, 1 nothing could be compared, 2 wrong usage, 3 some images could not be compared.

Examples:
  depthrig eval data/20261121_1015_kitchen --refine fill --refine cdm-d435
  depthrig eval shards/held-out --refine filled --refine fill --csv eval.csv
  depthrig eval HAMMER --like-cdm --refine filled --refine fill --refine cdm-d435 --refine cdm-l515 --out table1.html
  depthrig eval --truth truth --pred raw=raw --pred model=out --unit 0.001 --max-m 3 --json
  depthrig eval shards/held-out --refine fill --shard 0/4 --sums part0.jsonl
  depthrig eval --merge part0.jsonl part1.jsonl part2.jsonl part3.jsonl";

/// Arguments.
#[derive(Debug, clap::Args)]
pub struct EvalArgs {
    /// Dataset with ground truth, shards (both also s3://BUCKET/PREFIX), or folder in the layout of HAMMER
    input: Option<PathBuf>,
    /// Stream of the dataset, or folder (NAME=DIR or DIR), to evaluate; repeatable
    #[arg(long, value_name = "STREAM|[NAME=]DIR")]
    pred: Vec<String>,
    /// Engine or model to run on raw depth, or `filled`; repeatable
    #[arg(long, value_name = "[NAME=]REFINER[:filled]", value_parser = Choice::parse)]
    refine: Vec<Choice>,
    /// Raw depth to refine [default: stream depth, else depth_aligned]
    #[arg(long, value_name = "STREAM|DIR")]
    raw: Option<String>,
    /// Reference stream or folder [default: depth_true_color, else depth_true]
    #[arg(long, value_name = "STREAM|DIR")]
    truth: Option<String>,
    /// Folder of colour images, for refiners and the report
    #[arg(long, value_name = "DIR")]
    rgb: Option<PathBuf>,
    /// Folder of 8-bit images with the number of each pixel's material
    #[arg(long, value_name = "DIR")]
    material: Option<PathBuf>,
    /// Lens of the images in folders, pixels, for point clouds in the report
    #[arg(long, value_name = "FX,FY,CX,CY", value_parser = intrinsics)]
    intrinsics: Option<Intrinsics>,
    /// Scenes or sequences to use, with * and ? [default: all]
    #[arg(long, value_name = "NAME,...", value_delimiter = ',')]
    scenes: Vec<String>,
    /// Count as the authors of CDM: 0.1 to 6 m, NaN left out, HAMMER's test scenes
    #[arg(long)]
    like_cdm: bool,
    /// Resize predictions to their reference, taking the nearest pixels
    #[arg(long)]
    resize: bool,
    /// Metres per unit of integer depth files
    #[arg(long, value_name = "M", default_value_t = hammer::UNIT_M, value_parser = crate::args::depth_unit_m)]
    unit: f64,
    /// Metres per unit of integer reference files [default: as --unit]
    #[arg(long, value_name = "M", value_parser = crate::args::depth_unit_m)]
    truth_unit: Option<f64>,
    /// Nearest valid reference, metres [default: 0; HAMMER and shards: 0.1]
    #[arg(long, value_name = "M", value_parser = crate::args::distance_m)]
    min_m: Option<f64>,
    /// Farthest valid reference, metres [default: no limit; HAMMER and shards: 6]
    #[arg(long, value_name = "M", value_parser = crate::args::distance_m)]
    max_m: Option<f64>,
    /// Width of a distance bin, metres; the 48th holds everything beyond
    #[arg(long, value_name = "M", default_value = "0.25", value_parser = positive_metres)]
    bin_m: f64,
    /// HTML report to write [default: eval.html in the current folder]
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
    /// CSV to write: all rows, by distance, material and scene
    #[arg(long, value_name = "FILE")]
    csv: Option<PathBuf>,
    #[command(flatten)]
    overwrite: Overwrite,
    /// Print JSON instead of table and HTML report (with --out: both)
    #[arg(long)]
    json: bool,
    /// File of each image's sums, from which the same command goes on
    #[arg(long, value_name = "FILE")]
    sums: Option<PathBuf>,
    /// Part to evaluate: K of N, from 0; needs --sums
    #[arg(long, value_name = "K/N", requires = "sums", conflicts_with_all = ["out", "csv", "json"])]
    shard: Option<RunPart>,
    /// Files of sums of all parts, to report as one run
    #[arg(long, value_name = "FILE", num_args = 1.., conflicts_with_all = ["input", "pred", "refine", "truth", "sums", "shard"])]
    merge: Vec<PathBuf>,
    /// Device that runs networks: cpu, cuda:0, tensorrt:0 or openvino
    #[arg(long, value_name = "DEVICE", default_value = "cpu")]
    device: String,
    /// Precision of networks: fp32, fp16 or bf16
    #[arg(long, value_name = "PRECISION", default_value = "fp32", value_parser = precision)]
    precision: Precision,
    /// Shorter side of a network's input, pixels [default: the model's]
    #[arg(long, value_name = "PIXELS", value_parser = clap::value_parser!(u32).range(14..=8192))]
    input_size: Option<u32>,
    /// ONNX Runtime library [default: found automatically]
    #[arg(long, value_name = "FILE")]
    library: Option<PathBuf>,
    #[command(flatten)]
    scratch: Scratch,
    #[command(flatten)]
    models: Models,
    /// Threads [default: all cores]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..))]
    threads: Option<u16>,
}

/// Number of distance bins.
const BINS: usize = 48;
/// Default path of the HTML report.
const PAGE: &str = "eval.html";
/// Raw depth beyond this is a hole for the authors of CDM, metres.
const CDM_RAW_MAX_M: f64 = 6.0;

/// Parses a length above 0.
fn positive_metres(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(m) if m > 0.0 && m < 1e6 => Ok(m),
        _ => Err("write a number of metres above 0, such as 0.001".to_owned()),
    }
}

/// Parses the lens of a pinhole.
fn intrinsics(text: &str) -> Result<Intrinsics, String> {
    let numbers: Vec<f64> = text.split(',').map_while(|t| t.trim().parse().ok()).collect();
    match numbers[..] {
        [fx, fy, cx, cy] if numbers.iter().all(|n| n.is_finite()) && fx > 0.0 && fy > 0.0 => {
            Ok(Intrinsics::pinhole(fx, fy, cx, cy))
        }
        _ => Err(format!("write four numbers of pixels such as 600,600,320,240, not \"{text}\"")),
    }
}

/// Where results go.
struct Outputs {
    page: Option<OutFile>,
    csv: Option<OutFile>,
}

impl Outputs {
    fn new(args: &EvalArgs) -> Result<Self> {
        let page = match (&args.out, args.json || args.shard.is_some()) {
            (Some(path), _) => Some(path.as_path()),
            (None, true) => None,
            (None, false) => Some(Path::new(PAGE)),
        };
        let file = |path: &Path| OutFile::new(path, args.overwrite, &[]);
        let out = Self { page: page.map(file).transpose()?, csv: args.csv.as_deref().map(file).transpose()? };
        if let (Some(page), Some(csv)) = (&out.page, &out.csv) {
            page.differs_from(csv)?;
        }
        Ok(out)
    }
}

/// Evaluates and reports.
pub fn run(args: &EvalArgs, context: &Context) -> Result<Exit> {
    let outputs = Outputs::new(args)?;
    if !args.merge.is_empty() {
        let (evaluation, header) = merge::merge(&args.merge)?;
        return report(args, &outputs, &evaluation, &header, &Pictures::default());
    }
    let source::Opened { mut source, limits, title, copy: _copy } = source::open(args, context)?;
    let rules = rules(args, limits)?;
    let cores = || std::thread::available_parallelism().map_or(1, usize::from);
    let threads = args.threads.map_or_else(cores, usize::from);
    let refiners = Refiners::open(
        &args.refine,
        &RunOptions {
            models: args.models.dir.clone(),
            device: args.device.clone(),
            precision: args.precision,
            input_size: args.input_size,
            library: args.library.clone(),
            threads,
        },
    )?;
    let rows = refiners.rows(source.as_ref())?;
    let part = args.shard.unwrap_or(RunPart::ALL);
    let header = Header {
        resized: args.resize,
        options: options(args),
        ..Header::new(&title, part, rows, &rules, source.as_ref())
    };
    let mut summary = Summary::new(rules);
    let mut pictures = Pictures::default();
    let run = Run {
        refiners,
        header: &header,
        rules,
        raw_max_m: args.like_cdm.then_some(CDM_RAW_MAX_M),
        threads,
        pictures: outputs.page.is_some().then_some(&mut pictures),
        done: 0,
        source: source.as_mut(),
    };
    if !measure(run, &mut summary, args, context)? {
        return Ok(Exit::Lost);
    }
    let evaluation = summary.finish(&header);
    if let (Some(_), Some(sums)) = (args.shard, &args.sums) {
        out::line(format_args!("sums      {}", sums.display()))?;
        return Ok(ended(&evaluation));
    }
    report(args, &outputs, &evaluation, &header, &pictures)
}

/// The options that decide what the numbers are, apart from those that the header has on its own.
fn options(args: &EvalArgs) -> BTreeMap<String, String> {
    // Without INPUT they are folders, which other computers may have elsewhere.
    let stream = |name: &Option<String>| name.clone().filter(|_| args.input.is_some());
    [
        ("--unit", Some(args.unit.to_string())),
        ("--truth-unit", args.truth_unit.map(|unit| unit.to_string())),
        ("--scenes", Some(args.scenes.join(",")).filter(|scenes| !scenes.is_empty())),
        ("--raw", stream(&args.raw)),
        ("--truth", stream(&args.truth)),
        ("--input-size", args.input_size.map(|pixels| pixels.to_string())),
    ]
    .into_iter()
    .filter_map(|(name, value)| Some((name.to_owned(), value?)))
    .collect()
}

/// Rules of the measurement.
fn rules(args: &EvalArgs, limits: DepthRange) -> Result<Rules> {
    let limits = if args.like_cdm { source::usual_range() } else { limits };
    let range =
        DepthRange { min_m: args.min_m.unwrap_or(limits.min_m), max_m: args.max_m.unwrap_or(limits.max_m) };
    if range.min_m.is_nan() || range.max_m.is_nan() || range.min_m > range.max_m {
        let text = format!(
            "invalid depth range {}..={} m; --min-m must not exceed --max-m",
            range.min_m, range.max_m
        );
        return Err(UsageError(text).into());
    }
    Ok(Rules { range, bin_m: args.bin_m, bins: BINS, skip_not_finite: args.like_cdm })
}

/// Measures the images that the file of sums lacks; false when it was interrupted.
fn measure(mut run: Run<'_>, summary: &mut Summary, args: &EvalArgs, context: &Context) -> Result<bool> {
    let mut sums = None;
    if let Some(path) = &args.sums {
        if path.exists() {
            let mut reader = Reader::open(path)?;
            same_run(&reader.header, run.header, path)?;
            while let Some(record) = reader.next()? {
                summary.add(&record, |_, _| Ok(Vec::new()))?;
            }
            if reader.end.is_none() {
                bail!("{}: it is not complete; remove it", path.display());
            }
            return Ok(true);
        }
        let mut done = 0;
        sums = Some(Writer::create(path, run.header, |record| {
            done += 1;
            summary.add(&record, |_, _| Ok(Vec::new()))
        })?);
        run.done = done;
    }
    let stop = Stop::on_signals()?;
    let mut bar = Progress::new(context.global.quiet > 0);
    let measured = run.measure(summary, &mut sums, |done, total| {
        bar.set("comparing", done.min(total), total);
        !stop.is_asked()
    });
    bar.clear();
    if let Ok(Some(finished)) = &measured {
        for doubt in &finished.doubts {
            out::note(format_args!("warning: {doubt}"));
        }
    }
    match (measured, sums) {
        (Err(e), Some(sums)) if e.is::<WrongUnit>() => {
            sums.discard();
            Err(e)
        }
        (Err(e), _) => Err(e),
        (Ok(Some(finished)), Some(sums)) => sums.finish(finished.images).map(|()| true),
        (Ok(Some(_)), None) => Ok(true),
        (Ok(None), Some(_)) => {
            out::note("interrupted; the same command goes on where it was");
            Ok(false)
        }
        (Ok(None), None) => bail!("interrupted; nothing was written"),
    }
}

/// Writes and prints what was asked for.
fn report(
    args: &EvalArgs,
    outputs: &Outputs,
    evaluation: &Evaluation,
    header: &Header,
    pictures: &Pictures,
) -> Result<Exit> {
    let rules = header.rules()?;
    if evaluation.rows.is_empty() {
        let why = evaluation.failed.iter().chain(&evaluation.left_out).take(3).cloned().collect::<Vec<_>>();
        bail!("nothing could be compared: {}", why.join("; "));
    }
    if evaluation.rows.iter().all(|r| r.metrics.pixel_pooled.counted == 0) {
        bail!(
            "nothing could be compared: no reference lies within {} to {} m; look at --truth-unit, --min-m and --max-m",
            rules.range.min_m,
            rules.range.max_m
        );
    }
    if let Some(path) = &outputs.page {
        path.write(page(evaluation, header, &rules, pictures).as_bytes())?;
    }
    if let Some(path) = &outputs.csv {
        path.write(csv::file(evaluation).as_bytes())?;
    }
    if args.json {
        out::json(evaluation)?;
    } else {
        out::line(text::tables(evaluation, header.like_cdm))?;
        if let Some(path) = &outputs.page {
            out::line(format_args!("page      {}", path.path().display()))?;
        }
    }
    for row in evaluation.rows.iter().filter(|r| r.not_finite > 0) {
        let counted = if header.like_cdm { "left out" } else { "missing" };
        let n = row.not_finite;
        out::note(format_args!(
            "{}: {n} predicted pixels are NaN or infinite and count as {counted}",
            crate::eval::page::label(row)
        ));
    }
    Ok(ended(evaluation))
}

/// Prints what could not be compared, and chooses the exit code.
fn ended(evaluation: &Evaluation) -> Exit {
    for line in evaluation.failed.iter().take(20) {
        out::note(format_args!("not compared: {line}"));
    }
    let all = evaluation.failed.is_empty() && evaluation.left_out.is_empty();
    if all { Exit::Good } else { Exit::Lost }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_lens_is_four_numbers() {
        assert_eq!(intrinsics("600, 601,320.5,240").unwrap().fy, 601.0);
        for bad in ["", "1,2,3", "0,1,2,3", "a,b,c,d", "1,2,3,4,5", "inf,1,1,1"] {
            assert!(intrinsics(bad).unwrap_err().contains("600,600,320,240"), "{bad}");
        }
    }
}
