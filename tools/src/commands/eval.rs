//! `depthrig eval`: evaluates depth against a reference.

use crate::context::Context;
use crate::eval::dataset::FromDataset;
use crate::eval::files::{Files, HAMMER_RANGE_M, HAMMER_UNIT_M, Named};
use crate::eval::{Evaluation, Options, Row, Source, page};
use crate::exit::{Exit, UsageError};
use crate::out;
use crate::outfile::{OutFile, Overwrite};
use crate::progress::Progress;
use crate::signals::Stop;
use anyhow::{Result, bail};
use depthrig_bus::StreamName;
use depthrig_cdm::metrics::DepthRange;
use std::path::{Path, PathBuf};

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
INPUT is a depthrig dataset with ground truth, or a folder in the layout of the HAMMER dataset. Without it, --truth
names a folder of references and each --pred a folder of predictions with the same file paths except for the extension
(.png and .tiff: 16 bits; .tiff and .npy: metres).

Plain metrics use the pixels where both have depth. Strict metrics use all pixels with a valid reference and count
missing depth as 0 m. The table has means over images; the HTML report and --json also pool all pixels.

Exit codes: 0 compared, 1 nothing could be compared, 2 wrong usage, 3 some images could not be compared.

Examples:
  depthrig eval data/20261121_1015_kitchen
  depthrig eval data/20261121_1015_kitchen --pred depth --pred depth_refined --truth depth_true_color
  depthrig eval HAMMER/test --pred cdm=out/hammer --out hammer.html
  depthrig eval --truth truth --pred raw=raw --pred model=out --unit 0.001 --max-m 3 --json";

/// Arguments.
#[derive(Debug, clap::Args)]
pub struct EvalArgs {
    /// Dataset with ground truth, or folder in the layout of HAMMER
    input: Option<PathBuf>,
    /// Stream of the dataset, or folder (NAME=DIR or DIR), to evaluate; repeatable
    #[arg(long, value_name = "STREAM|[NAME=]DIR")]
    pred: Vec<String>,
    /// Reference stream or folder [default: depth_true_color, else depth_true]
    #[arg(long, value_name = "STREAM|DIR")]
    truth: Option<String>,
    /// Folder of colour images for the worst cases in the report
    #[arg(long, value_name = "DIR")]
    rgb: Option<PathBuf>,
    /// Metres per unit of integer depth files
    #[arg(long, value_name = "M", default_value_t = HAMMER_UNIT_M, value_parser = crate::args::depth_unit_m)]
    unit: f64,
    /// Metres per unit of integer reference files [default: as --unit]
    #[arg(long, value_name = "M", value_parser = crate::args::depth_unit_m)]
    truth_unit: Option<f64>,
    /// Nearest valid reference, metres [default: 0; HAMMER: 0.1]
    #[arg(long, value_name = "M", value_parser = crate::args::distance_m)]
    min_m: Option<f64>,
    /// Farthest valid reference, metres [default: no limit; HAMMER: 6]
    #[arg(long, value_name = "M", value_parser = crate::args::distance_m)]
    max_m: Option<f64>,
    /// Width of a distance bin, metres; the 48th holds everything beyond
    #[arg(long, value_name = "M", default_value = "0.25", value_parser = positive_metres)]
    bin_m: f64,
    /// HTML report to write [default: eval.html in the current folder]
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
    #[command(flatten)]
    overwrite: Overwrite,
    /// Print JSON instead of table and HTML report (with --out: both)
    #[arg(long)]
    json: bool,
    /// Threads [default: all cores]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..))]
    threads: Option<u16>,
}

/// Number of distance bins.
const BINS: usize = 48;
/// Default path of the HTML report.
const PAGE: &str = "eval.html";

/// Parses a length above 0.
fn positive_metres(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(m) if m > 0.0 && m < 1e6 => Ok(m),
        _ => Err("write a number of metres above 0, such as 0.001".to_owned()),
    }
}

/// Evaluates and reports.
pub fn run(args: &EvalArgs, context: &Context) -> Result<Exit> {
    let (mut source, limits, title) = source(args)?;
    let range =
        DepthRange { min_m: args.min_m.unwrap_or(limits.min_m), max_m: args.max_m.unwrap_or(limits.max_m) };
    if range.min_m.is_nan() || range.max_m.is_nan() || range.min_m > range.max_m {
        let text = format!(
            "invalid depth range {}..={} m; --min-m must not exceed --max-m",
            range.min_m, range.max_m
        );
        return Err(UsageError(text).into());
    }
    let path = match (&args.out, args.json) {
        (Some(path), _) => Some(path.clone()),
        (None, true) => None,
        (None, false) => Some(PathBuf::from(PAGE)),
    };
    let path = path.map(|path| OutFile::new(&path, args.overwrite, &[])).transpose()?;
    let cores = || std::thread::available_parallelism().map_or(1, usize::from);
    let options =
        Options { range, bins: (args.bin_m, BINS), threads: args.threads.map_or_else(cores, usize::from) };
    let stop = Stop::on_signals()?;
    let mut bar = Progress::new(context.global.quiet > 0);
    let evaluation = crate::eval::run(source.as_mut(), &options, |done, total| {
        bar.set("comparing", done.min(total), total);
        !stop.is_asked()
    })?;
    bar.clear();
    let Some(evaluation) = evaluation else { bail!("interrupted; nothing was written") };
    if evaluation.rows.is_empty() {
        let why = evaluation.failed.iter().chain(&evaluation.left_out).take(3).cloned().collect::<Vec<_>>();
        bail!("nothing could be compared: {}", why.join("; "));
    }
    if let Some(path) = &path {
        path.write(page::page(&title, &evaluation, &options).as_bytes())?;
    }
    if args.json {
        out::json(&evaluation)?;
    } else {
        out::line(text(&evaluation))?;
        if let Some(path) = &path {
            out::line(format_args!("page      {}", path.path().display()))?;
        }
    }
    for line in evaluation.failed.iter().take(20) {
        out::note(format_args!("not compared: {line}"));
    }
    let all = evaluation.failed.is_empty() && evaluation.left_out.is_empty();
    Ok(if all { Exit::Good } else { Exit::Lost })
}

/// Selects the source of the images, the default range of references, and its title.
fn source(args: &EvalArgs) -> Result<(Box<dyn Source>, DepthRange, String)> {
    let truth_unit_m = args.truth_unit.unwrap_or(args.unit);
    let Some(input) = &args.input else {
        let usage = "without INPUT give --truth DIR and --pred DIR, or give a dataset with truth";
        let truth =
            args.truth.as_ref().filter(|_| !args.pred.is_empty()).ok_or_else(|| UsageError(usage.into()))?;
        let files = Files::pairs(&folders(args), (Path::new(truth), truth_unit_m), args.rgb.as_deref())?;
        return Ok((Box::new(files), DepthRange::ALL, truth.clone()));
    };
    let title = input.display().to_string();
    // A folder without read permission is refused like a dataset, with the cure.
    let is_closed = input.read_dir().is_err_and(|e| e.kind() == std::io::ErrorKind::PermissionDenied);
    if is_closed || input.join(depthrig_recorder::SESSION_FILE).is_file() || input.is_file() {
        let names = args.pred.iter().map(|p| stream(p)).collect::<Result<Vec<_>>>()?;
        let truth = args.truth.as_deref().map(stream).transpose()?;
        let source = FromDataset::open(input, &names, truth.as_ref())?;
        return Ok((Box::new(source), DepthRange::ALL, title));
    }
    let (min_m, max_m) = HAMMER_RANGE_M;
    Ok((Box::new(Files::hammer(input, &folders(args))?), DepthRange { min_m, max_m }, title))
}

fn stream(text: &str) -> Result<StreamName> {
    StreamName::new(text).map_err(|e| UsageError(format!("invalid stream name {text}: {e}")).into())
}

fn folders(args: &EvalArgs) -> Vec<Named> {
    let named = |text: &String| {
        let (name, folder) = text.split_once('=').unwrap_or_else(|| (last_part(text), text));
        Named { name: name.to_owned(), folder: folder.into(), unit_m: args.unit }
    };
    args.pred.iter().map(named).collect()
}

fn last_part(path: &str) -> &str {
    path.trim_end_matches('/').rsplit('/').next().unwrap_or(path)
}

fn text(evaluation: &Evaluation) -> String {
    let mut header = vec!["PREDICTION"];
    header.extend(["L1", "RMSE", "AbsRel", "δ0.5", "δ1", "strict L1", "RMSE", "AbsRel", "δ0.5", "δ1"]);
    header.extend(["missing %", "images"]);
    let row = |r: &Row| {
        let m = &r.metrics.mean_of_images;
        let mut cells = vec![page::label(r)];
        cells.extend([false, true].iter().flat_map(|s| page::measures(m, *s)).map(|(_, v)| page::value(v)));
        cells.push(format!("{:.2}", m.missing_percent));
        cells.push(r.metrics.images.to_string());
        cells
    };
    let mut text = out::table(&header, 1, evaluation.rows.iter().map(row));
    for line in &evaluation.left_out {
        text.push_str("\nleft out  ");
        text.push_str(line);
    }
    text
}
