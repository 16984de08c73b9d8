//! `depthrig cdm bench`: measures speed and memory of each engine, side by side.
//!
//! Each combination of engine and size runs in its own process: a process can load one ONNX Runtime only, peak memory
//! is measured per process, and a failure does not end the other measurements.

use self::flicker::Flicker;
use self::scene::image;
use super::run::{engine as parse_engine, precision as parse_precision};
use super::store::{Models, usage};
use crate::bench::stats::median;
use crate::exit::{Exit, UsageError};
use crate::out;
use anyhow::{Context as _, Result};
use depthrig_bus::clock::{HostTime, process_cpu_ns};
use depthrig_cdm::tiny::{TinyFile, is_tiny_file};
use depthrig_cdm::{
    Color, ColorFormat, EngineKind, Job, Output, Precision, RawDepth, RefinerOptions, StepTimes,
    find_library, refiner,
};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

mod flicker;
mod scene;

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
The image is synthetic, with edges and holes; times do not depend on its content. Times are medians of wall-clock and
CPU time (all threads). A busy computer affects wall-clock time more than CPU time.

--flicker N refines N images of a still scene with the noise of a stereo camera (a tenth of a pixel) and prints how much depth
changes from image to image: the standard deviation of raw and refined depth where all of them have raw depth, and of
refined depth in the holes.

An engine is fill, tiny, or onnxruntime with a device and a precision: onnxruntime/cpu/fp32,
onnxruntime/openvino/bf16, onnxruntime/cuda:0/fp16.

Exit codes: 0 success, 1 an engine failed, 2 wrong usage.

Examples:
  depthrig cdm bench
  depthrig cdm bench --image 640x480 --threads 1 --flicker 30
  depthrig cdm bench --model cdm-d435 --input-size 252,518
  depthrig cdm bench --model cdm-d435 --engine onnxruntime/cpu/fp32,onnxruntime/openvino/bf16 --threads 2 --json";

/// Arguments.
#[derive(Debug, clap::Args)]
pub struct BenchArgs {
    /// Installed model, or checkpoint file; without one, only fill and tiny can run. Or a tiny.onnx of one's own
    #[arg(long, value_name = "NAME|FILE")]
    model: Option<String>,
    /// Engines, as ENGINE[/DEVICE[/PRECISION]] [default: fill, tiny, onnxruntime]
    #[arg(long = "engine", value_name = "ENGINE", value_delimiter = ',', value_parser = Spec::parse)]
    engines: Vec<Spec>,
    /// Size of the image, pixels
    #[arg(long, value_name = "WxH", default_value = "1280x720", value_parser = size)]
    image: (usize, usize),
    /// Shorter side of the network's input, pixels [default: the model's]
    #[arg(long = "input-size", value_name = "PIXELS", value_delimiter = ',', value_parser = clap::value_parser!(u32).range(14..=8192))]
    input_sizes: Vec<u32>,
    /// Images per batch
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..=64))]
    batch: u16,
    /// CPU threads [default: all cores]
    #[arg(long, value_name = "N", default_value_t = 0, hide_default_value = true, value_parser = clap::value_parser!(u16).range(0..=1024))]
    threads: u16,
    /// Measurement time of each, seconds; at least three runs
    #[arg(long, value_name = "SECONDS", default_value_t = 5.0, value_parser = crate::args::seconds)]
    seconds: f64,
    /// Measure the noise of refined depth over N images, too
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(2..=1000))]
    flicker: Option<u32>,
    /// ONNX Runtime library [default: found automatically]
    #[arg(long, value_name = "FILE")]
    library: Option<PathBuf>,
    #[command(flatten)]
    models: Models,
    /// Print JSON
    #[arg(long)]
    json: bool,
    /// Measure one engine in this process
    #[arg(long, hide = true)]
    here: bool,
}

impl BenchArgs {
    /// The model that an engine takes, if it is named: an ONNX file is for `tiny`, any other for the rest.
    fn model_of(&self, spec: &Spec) -> Option<&str> {
        let is_tiny = |name: &&str| is_tiny_file(Path::new(name));
        let named = self.model.as_deref();
        match spec.engine {
            EngineKind::Tiny => named.filter(is_tiny),
            engine if engine.needs_model() => named.filter(|name| !is_tiny(name)),
            _ => None,
        }
    }
}

/// An engine with its device and precision.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Spec {
    engine: EngineKind,
    device: String,
    precision: Precision,
}

impl Spec {
    fn of(engine: EngineKind) -> Self {
        Self { engine, device: "cpu".into(), precision: Precision::Fp32 }
    }

    fn parse(text: &str) -> Result<Self, String> {
        let mut parts = text.split('/');
        let mut spec = Self::of(parse_engine(parts.next().unwrap_or_default())?);
        if let Some(device) = parts.next() {
            device.clone_into(&mut spec.device);
        }
        if let Some(precision) = parts.next() {
            spec.precision = parse_precision(precision)?;
        }
        match parts.next() {
            None => Ok(spec),
            Some(more) => Err(format!("unexpected {more:?} after engine, device and precision")),
        }
    }

    fn text(&self) -> String {
        match self.engine {
            EngineKind::Fill => EngineKind::Fill.to_string(),
            EngineKind::Tiny if *self == Self::of(EngineKind::Tiny) => EngineKind::Tiny.to_string(),
            _ => format!("{}/{}/{}", self.engine, self.device, self.precision),
        }
    }
}

fn size(text: &str) -> Result<(usize, usize), String> {
    let numbers = text.split_once('x').map(|(w, h)| (w.parse(), h.parse()));
    match numbers {
        Some((Ok(w @ 1..=8192), Ok(h @ 1..=8192))) => Ok((w, h)),
        _ => Err("write columns and rows, such as 1280x720".to_owned()),
    }
}

/// Measurements of one engine; times are milliseconds per image.
#[derive(Debug, Default, Serialize, Deserialize)]
struct Measured {
    /// Engine, device and precision as requested.
    asked: String,
    /// Engine that ran, with version, device and precision.
    engine: String,
    /// Empty if the engine needs none.
    model: String,
    /// Shorter side of the network's input; 0 without a network.
    input_size: u32,
    threads: usize,
    batch: usize,
    runs: usize,
    /// Time to load the engine, and time of the first batch, which allocates.
    load_ms: f64,
    first_ms: f64,
    prepare_ms: f64,
    infer_ms: f64,
    finish_ms: f64,
    total_ms: f64,
    best_ms: f64,
    cpu_ms: f64,
    images_per_s: f64,
    peak_mb: f64,
    /// Only with `--flicker`.
    flicker: Option<Flicker>,
    /// Failure, instead of numbers.
    error: Option<String>,
}

/// Measures every engine at every size.
pub fn run(args: &BenchArgs) -> Result<Exit> {
    if args.here {
        let spec = args.engines.first().context("no engine was given")?;
        out::json_line(&measure(args, spec)?)?;
        return Ok(Exit::Good);
    }
    let mut specs = args.engines.clone();
    if specs.is_empty() {
        specs.push(Spec::of(EngineKind::Fill));
        match find_library(args.library.as_deref(), "cpu", Precision::Fp32) {
            Ok(_) => specs.push(Spec::of(EngineKind::Tiny)),
            Err(e) => out::note(format_args!("tiny is left out: {e}")),
        }
        let network = Spec::of(EngineKind::OnnxRuntime);
        specs.extend(args.model_of(&network).is_some().then_some(network));
    }
    if let Some(spec) = specs.iter().find(|s| s.engine.needs_model() && args.model_of(s).is_none()) {
        let text = format!("the engine {} needs a model: name one with --model", spec.engine);
        return Err(UsageError(text).into());
    }
    let mut rows = Vec::new();
    for spec in &specs {
        if !spec.engine.needs_model() || args.input_sizes.is_empty() {
            rows.push(measure_in_child(args, spec, None)?);
        } else {
            for size in &args.input_sizes {
                rows.push(measure_in_child(args, spec, Some(*size))?);
            }
        }
    }
    if args.json {
        out::json(&rows)?;
    } else {
        print_rows(&rows)?;
    }
    Ok(if rows.iter().any(|r| r.error.is_some()) { Exit::Failed } else { Exit::Good })
}

/// Measures in a child process.
fn measure_in_child(args: &BenchArgs, spec: &Spec, input_size: Option<u32>) -> Result<Measured> {
    let program = std::env::current_exe().context("this program was not found")?;
    let mut command = Command::new(program);
    command.args(["cdm", "bench", "--here", "--engine", &spec.text()]);
    command.args(["--image", &format!("{}x{}", args.image.0, args.image.1)]);
    command.args(["--batch", &args.batch.to_string(), "--threads", &args.threads.to_string()]);
    command.args(["--seconds", &args.seconds.to_string()]);
    let mut option = |name: &str, value: Option<&std::ffi::OsStr>| {
        if let Some(value) = value {
            command.arg(name).arg(value);
        }
    };
    option("--model", args.model_of(spec).map(AsRef::as_ref));
    option("--library", args.library.as_ref().map(AsRef::as_ref));
    option("--models", args.models.dir.as_ref().map(AsRef::as_ref));
    option("--flicker", args.flicker.map(|n| n.to_string()).as_ref().map(AsRef::as_ref));
    option("--input-size", input_size.map(|s| s.to_string()).as_ref().map(AsRef::as_ref));
    let done =
        command.stdin(Stdio::null()).output().context("a process for the measurement cannot be started")?;
    let failed = |why: String| Measured {
        asked: spec.text(),
        input_size: input_size.unwrap_or(0),
        error: Some(why),
        ..Measured::default()
    };
    if let Ok(measured) = serde_json::from_slice::<Measured>(&done.stdout) {
        return Ok(measured);
    }
    let text = String::from_utf8_lossy(&done.stderr);
    let why =
        if text.trim().is_empty() { format!("ended with {}", done.status) } else { text.trim().to_owned() };
    Ok(failed(why))
}

fn measure(args: &BenchArgs, spec: &Spec) -> Result<Measured> {
    let (mut model, mut tiny) = (None, None);
    match args.model_of(spec) {
        Some(file) if spec.engine == EngineKind::Tiny => {
            tiny = Some(TinyFile::read(Path::new(file)).map_err(usage)?);
        }
        Some(name) => model = Some(args.models.store()?.model(name).map_err(usage)?),
        None => {}
    }
    let input_size = args.input_sizes.first().copied().or(model.as_ref().map(|m| m.input_size)).unwrap_or(0);
    let options = RefinerOptions {
        engine: Some(spec.engine),
        model,
        tiny,
        input_size: args.input_sizes.first().copied(),
        precision: spec.precision,
        device: spec.device.clone(),
        threads: args.threads.into(),
        library: args.library.clone(),
        ..RefinerOptions::default()
    };
    let start = HostTime::now();
    let mut refiner = refiner(&options).map_err(usage)?;
    let load_ms = ms(start);

    let (width, height) = args.image;
    let (color, depth) = image(width, height);
    let batch = usize::from(args.batch);
    let mut outputs = vec![vec![0u16; width * height]; batch];
    let mut jobs: Vec<Job<'_>> = outputs
        .iter_mut()
        .map(|pixels| Job {
            color: Color { pixels: &color, format: ColorFormat::Rgb8, width, height, stride: 3 * width },
            depth: RawDepth { pixels: &depth, unit_m: 0.001 },
            out: Output::Units { pixels, unit_m: 0.001 },
            steps: StepTimes::default(),
        })
        .collect();
    let start = HostTime::now();
    refiner.refine(&mut jobs).map_err(usage)?;
    let first_ms = ms(start);

    // Columns: prepare, infer, finish, total, CPU.
    let mut times: [Vec<f64>; 5] = Default::default();
    let begin = HostTime::now();
    while times[0].len() < 3 || begin.elapsed().as_secs_f64() < args.seconds {
        let start = HostTime::now();
        let cpu = process_cpu_ns();
        refiner.refine(&mut jobs).map_err(usage)?;
        let all = ms(start);
        let cpu = (process_cpu_ns() - cpu) as f64 / 1e6;
        let mean = |of: fn(&StepTimes) -> u64| {
            jobs.iter().map(|j| of(&j.steps) as f64 / 1e6).sum::<f64>() / batch as f64
        };
        let row = [
            mean(|s| s.prepare_ns),
            mean(|s| s.infer_ns),
            mean(|s| s.finish_ns),
            all / batch as f64,
            cpu / batch as f64,
        ];
        for (column, value) in times.iter_mut().zip(row) {
            column.push(value);
        }
    }
    let [prepare_ms, infer_ms, finish_ms, total_ms, cpu_ms] = times.each_ref().map(|t| median(t));
    let peak_mb = peak_mb().unwrap_or(0.0);
    let flicker = args.flicker.map(|images| flicker::measure(&mut *refiner, args.image, images));
    let flicker = flicker.transpose().map_err(usage)?;
    let described = refiner.describe();
    Ok(Measured {
        asked: spec.text(),
        engine: described.engine.clone(),
        model: described.model.clone(),
        input_size,
        threads: options.thread_count(),
        batch,
        runs: times[0].len(),
        load_ms,
        first_ms,
        prepare_ms,
        infer_ms,
        finish_ms,
        total_ms,
        best_ms: times[3].iter().copied().fold(f64::INFINITY, f64::min),
        cpu_ms,
        images_per_s: 1000.0 / total_ms,
        peak_mb,
        flicker,
        error: None,
    })
}

fn ms(since: HostTime) -> f64 {
    since.elapsed().as_secs_f64() * 1e3
}

/// Peak resident memory of this process, from `/proc/self/status`.
fn peak_mb() -> Option<f64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find(|l| l.starts_with("VmHWM:"))?;
    Some(line.split_whitespace().nth(1)?.parse::<f64>().ok()? / 1024.0)
}

fn print_rows(rows: &[Measured]) -> Result<()> {
    let header = [
        "ENGINE",
        "INPUT",
        "THREADS",
        "PREPARE ms",
        "INFER ms",
        "FINISH ms",
        "TOTAL ms",
        "CPU ms",
        "PER s",
        "PEAK MB",
        "LOAD ms",
    ];
    let good = rows.iter().filter(|r| r.error.is_none()).map(|r| {
        let n = |v: f64| if v < 10.0 { format!("{v:.2}") } else { format!("{v:.0}") };
        vec![
            r.engine.clone(),
            if r.input_size == 0 { "-".into() } else { r.input_size.to_string() },
            r.threads.to_string(),
            n(r.prepare_ms),
            n(r.infer_ms),
            n(r.finish_ms),
            n(r.total_ms),
            n(r.cpu_ms),
            n(r.images_per_s),
            n(r.peak_mb),
            n(r.load_ms),
        ]
    });
    if rows.iter().any(|r| r.error.is_none()) {
        out::line(out::table(&header, 1, good))?;
    }
    let flickers = rows.iter().filter_map(|r| Some((r, r.flicker.as_ref()?))).map(|(r, f)| {
        let mm = |mm: f64| format!("{mm:.2}");
        vec![r.engine.clone(), f.images.to_string(), mm(f.raw_mm), mm(f.refined_mm), mm(f.holes_mm)]
    });
    let flickers: Vec<_> = flickers.collect();
    if !flickers.is_empty() {
        out::line("")?;
        out::line(out::table(&["ENGINE", "IMAGES", "RAW mm", "REFINED mm", "HOLES mm"], 1, flickers))?;
    }
    for row in rows {
        if let Some(error) = &row.error {
            out::line(format_args!("{}: {error}", row.asked))?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn engines_by_their_words() {
        let spec = Spec::parse("onnxruntime/cuda:0/fp16").unwrap();
        assert_eq!(
            (spec.engine, &*spec.device, spec.precision),
            (EngineKind::OnnxRuntime, "cuda:0", Precision::Fp16)
        );
        for text in ["fill", "tiny", "tiny/cuda:0/fp32", "onnxruntime/cpu/fp32", "onnxruntime/openvino/bf16"]
        {
            assert_eq!(Spec::parse(text).unwrap().text(), text);
        }
        assert_eq!(Spec::parse("onnxruntime").unwrap().text(), "onnxruntime/cpu/fp32");
        for wrong in ["", "torch", "onnxruntime/cpu/int8", "onnxruntime/cpu/fp32/more"] {
            assert!(Spec::parse(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn sizes_by_their_words() {
        assert!(size("640x480") == Ok((640, 480)) && size("640").is_err() && size("0x5").is_err());
    }

    #[test]
    fn fill_is_measured() {
        use clap::Parser;
        #[derive(clap::Parser)]
        struct Cli {
            #[command(flatten)]
            bench: BenchArgs,
        }
        let words =
            ["bench", "--here", "--engine", "fill", "--image", "160x90", "--seconds", "0", "--threads", "1"];
        let Cli { bench } = Cli::try_parse_from(words).unwrap();
        let measured = measure(&bench, &bench.engines[0]).unwrap();
        assert!(measured.engine.starts_with("fill") && measured.runs == 3 && measured.error.is_none());
        assert!(measured.total_ms > 0.0 && measured.peak_mb > 1.0 && measured.images_per_s > 0.0);
        let parts = measured.prepare_ms + measured.infer_ms + measured.finish_ms;
        assert!(parts > 0.0 && measured.threads == 1);
    }
}
