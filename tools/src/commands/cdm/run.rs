//! `depthrig cdm run`: refines the depth of one colour and depth image.

use super::store::{Channels, Models, usage};
use crate::exit::{Exit, UsageError};
use crate::outfile::{OutFile, Overwrite};
use crate::{image_file, out};
use anyhow::Result;
use depthrig_cdm::{
    Color, ColorFormat, EngineKind, FillRefiner, Job, Output, Precision, RawDepth, RefinerOptions, StepTimes,
    refiner, tiny,
};
use image::{DynamicImage, ExtendedColorType, ImageEncoder, codecs::png};
use serde::Serialize;
use std::path::{Path, PathBuf};

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
Colour and depth must show the same view at the same size: depth registered to colour.

OUT.npy holds 32-bit floats: metres (0 = no depth), or with --inverse the network's output in 1/m. OUT.png holds
16 bits in units of --out-unit.

Exit codes: 0 success, 1 failure, 2 wrong usage or mismatched images, 3 written, but without any depth.

Examples:
  depthrig cdm run --rgb color.png --depth depth.png --depth-unit 0.001 --model cdm-d435 --out refined.npy
  depthrig cdm run --rgb color.png --depth depth.png --depth-unit 0.0001 --model cdm_d405.ckpt --input-size 252 \\
      --inverse --out inverse.npy
  depthrig cdm run --rgb color.png --depth depth.png --depth-unit 0.001 --engine tiny --out refined.png
  depthrig cdm run --rgb color.png --depth depth.png --depth-unit 0.001 --engine fill --out filled.png";

/// Arguments.
#[derive(Debug, clap::Args)]
pub struct RunArgs {
    /// Colour image, PNG or JPEG
    #[arg(long, value_name = "FILE")]
    rgb: PathBuf,
    /// Raw depth registered to colour, a 16-bit PNG; 0 is a hole
    #[arg(long, value_name = "FILE")]
    depth: PathBuf,
    /// Metres per unit of the raw depth
    #[arg(long, value_name = "METRES", value_parser = crate::args::depth_unit_m)]
    depth_unit: f64,
    /// Installed model, checkpoint file, or NAME.onnx for the engine tiny
    #[arg(long, value_name = "NAME|FILE", required_unless_present = "engine")]
    model: Option<String>,
    /// Shorter side of the network's input, pixels [default: the model's]
    #[arg(long, value_name = "PIXELS", value_parser = clap::value_parser!(u32).range(14..=8192))]
    input_size: Option<u32>,
    /// Engine: onnxruntime, or tiny or fill, which need no model [default: onnxruntime]
    #[arg(long, value_name = "ENGINE", value_parser = engine)]
    engine: Option<EngineKind>,
    /// Write the network's output: inverse depth, 1/m
    #[arg(long)]
    inverse: bool,
    /// Output file, .npy or .png
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    #[command(flatten)]
    overwrite: Overwrite,
    /// Metres per unit of an output PNG
    #[arg(long, value_name = "METRES", value_parser = crate::args::depth_unit_m, default_value_t = 0.001)]
    out_unit: f64,
    /// Order of the colour channels [default: the model's]
    #[arg(long, value_enum, value_name = "ORDER")]
    channel_order: Option<Channels>,
    /// Farthest raw depth, metres; the rest is a hole [default: the model's]
    #[arg(long, value_name = "METRES", value_parser = crate::args::range_limit_m)]
    max_depth: Option<f64>,
    /// Precision of the network: fp32, fp16 or bf16
    #[arg(long, value_name = "PRECISION", default_value = "fp32", value_parser = precision)]
    precision: Precision,
    /// Device that runs the network: cpu, cuda:0, tensorrt:0 or openvino
    #[arg(long, value_name = "DEVICE", default_value = "cpu")]
    device: String,
    /// CPU threads [default: all cores]
    #[arg(long, value_name = "N", default_value_t = 0, hide_default_value = true, value_parser = clap::value_parser!(u16).range(0..=1024))]
    threads: u16,
    /// ONNX Runtime library [default: found automatically]
    #[arg(long, value_name = "FILE")]
    library: Option<PathBuf>,
    /// Reach of fill and tiny from measured depth, fraction of the width; 1: no limit
    #[arg(long, value_name = "PART", value_parser = crate::args::fill_reach, default_value_t = FillRefiner::REACH)]
    fill_reach: f64,
    #[command(flatten)]
    models: Models,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// Parses the name of an engine.
///
/// # Errors
/// When the name is unknown.
pub fn engine(text: &str) -> Result<EngineKind, String> {
    text.parse().map_err(|e: depthrig_cdm::Error| e.to_string())
}

/// Parses the name of a precision.
///
/// # Errors
/// When the name is unknown.
pub fn precision(text: &str) -> Result<Precision, String> {
    text.parse().map_err(|e: depthrig_cdm::Error| e.to_string())
}

/// Result of the command, as JSON.
#[derive(Debug, Serialize)]
struct Report<'a> {
    out: &'a Path,
    width: usize,
    height: usize,
    /// Unit of the file's numbers: `metres`, `inverse metres`, or `units` of a PNG.
    values: &'static str,
    /// Metres per unit of a PNG.
    unit_m: Option<f64>,
    engine: &'a str,
    /// Empty if the engine needs no model.
    model: &'a str,
    /// Whether the model is trained; `None` without a model.
    trained: Option<bool>,
    /// Pixels with raw depth, percent.
    raw_percent: f64,
    /// Pixels with refined depth, percent.
    refined_percent: f64,
    /// Problems of the output or the input.
    warnings: Vec<String>,
    prepare_ms: f64,
    infer_ms: f64,
    finish_ms: f64,
}

/// Format of the result.
enum Refined {
    Units(Vec<u16>),
    Floats(Vec<f32>),
}

/// Refines.
pub fn run(args: &RunArgs) -> Result<Exit> {
    let as_png = form(args)?;
    let model = args.model.as_deref().map(Path::new);
    let inputs: Vec<&Path> = [args.rgb.as_path(), &args.depth].into_iter().chain(model).collect();
    let out = OutFile::new(&args.out, args.overwrite, &inputs)?;
    let (color, width, height) = read_color(&args.rgb)?;
    let depth = read_depth(&args.depth, &args.rgb, width, height)?;
    let options = options(args)?;
    let max_depth_m = options.model.as_ref().map_or(f64::INFINITY, |m| m.max_depth_m);
    let has_model = options.model.is_some();
    let trained = match &options.model {
        Some(model) => Some(model.is_trained()),
        None => (options.engine_kind() == EngineKind::Tiny)
            .then(|| options.tiny.is_some() || tiny::model().is_trained),
    };
    let mut refiner = refiner(&options).map_err(usage)?;
    let mut refined =
        if as_png { Refined::Units(vec![0; depth.len()]) } else { Refined::Floats(vec![0.0; depth.len()]) };
    let mut job = Job {
        color: Color { pixels: &color, format: ColorFormat::Rgb8, width, height, stride: 3 * width },
        depth: RawDepth { pixels: &depth, unit_m: args.depth_unit },
        out: match &mut refined {
            Refined::Units(pixels) => Output::Units { pixels, unit_m: args.out_unit },
            Refined::Floats(pixels) if args.inverse => Output::Inverse(pixels),
            Refined::Floats(pixels) => Output::Metres(pixels),
        },
        steps: StepTimes::default(),
    };
    refiner.refine(core::slice::from_mut(&mut job)).map_err(usage)?;
    let steps = job.steps;
    out.write(&encoded(&refined, width, height)?)?;
    let described = refiner.describe();
    let limit_m = has_model.then(|| args.max_depth.unwrap_or(max_depth_m));
    let input = InputDepth::of(&depth, args.depth_unit, limit_m);
    let share = |n: usize| 100.0 * n as f64 / depth.len() as f64;
    let seen = match &refined {
        Refined::Units(p) => p.iter().filter(|d| **d > 0).count(),
        Refined::Floats(p) => p.iter().filter(|d| d.is_finite() && **d > 0.0).count(),
    };
    // Of the others much may be unknown, beyond the reach of filling.
    let suspicions = if !has_model || input.usable == 0 {
        Vec::new()
    } else {
        Plausibility::of(&metres(&refined, args), &depth, &input).warnings()
    };
    let report = Report {
        out: &args.out,
        width,
        height,
        values: if as_png {
            "units"
        } else if args.inverse {
            "inverse metres"
        } else {
            "metres"
        },
        unit_m: as_png.then_some(args.out_unit),
        engine: &described.engine,
        model: &described.model,
        trained,
        raw_percent: share(depth.iter().filter(|d| **d > 0 && **d < u16::MAX).count()),
        refined_percent: share(seen),
        warnings: input.warning().into_iter().chain(suspicions).collect(),
        prepare_ms: steps.prepare_ns as f64 / 1e6,
        infer_ms: steps.infer_ns as f64 / 1e6,
        finish_ms: steps.finish_ns as f64 / 1e6,
    };
    for warning in &report.warnings {
        out::note(format_args!("warning: {}: {warning}", args.depth.display()));
    }
    print_report(&report, args.json)?;
    Ok(if seen == 0 { Exit::Lost } else { Exit::Good })
}

/// Counts of raw depth pixels by their use in the refiner.
struct InputDepth {
    pixels: usize,
    usable: usize,
    /// Measured, but beyond the model's range.
    beyond: usize,
    limit_m: f64,
    unit_m: f64,
}

impl InputDepth {
    fn of(depth: &[u16], unit_m: f64, limit_m: Option<f64>) -> Self {
        let limit_m = limit_m.unwrap_or(f64::INFINITY);
        let measured = depth.iter().filter(|d| **d > 0 && **d < u16::MAX);
        let all = measured.clone().count();
        let beyond = measured.filter(|d| f64::from(**d) * unit_m > limit_m).count();
        Self { pixels: depth.len(), usable: all - beyond, beyond, limit_m, unit_m }
    }

    /// A raw depth that the refiner uses, metres.
    fn metres(&self, raw: u16) -> Option<f32> {
        let metres = f64::from(raw) * self.unit_m;
        (raw > 0 && raw < u16::MAX && metres <= self.limit_m).then_some(metres as f32)
    }

    fn warning(&self) -> Option<String> {
        let Self { pixels, usable, beyond, limit_m, unit_m } = self;
        let cure = format!(
            "check --depth-unit, which is {unit_m} m (0.001 for millimetres, 0.0001 for most D405), or raise --max-depth"
        );
        match (usable, beyond) {
            (0, 0) => Some(format!(
                "none of its {pixels} pixels has depth (0 and 65535 are holes), so nothing is refined; check the file"
            )),
            (0, _) => Some(format!(
                "all its depth ({beyond} pixels) lies beyond {limit_m} m and counts as holes, so nothing is \
                 refined; {cure}"
            )),
            (usable, beyond) if beyond > usable => Some(format!(
                "{:.0} % of its depth lies beyond {limit_m} m and counts as holes; {cure}",
                100.0 * *beyond as f64 / (beyond + usable) as f64
            )),
            _ => None,
        }
    }
}

/// Farthest plausible depth of a model for short-range cameras, metres: that of the official class.
const FARTHEST_M: f32 = 20.0;
/// Share of implausible depth in a result that causes a warning.
const IMPLAUSIBLE: f64 = 0.05;
/// A correct model does not change much of the raw depth by more than this factor.
const FACTOR: f32 = 2.0;
/// Share of raw depth changed by more than that factor that causes a warning.
const MOVED: f64 = 0.1;

/// Plausibility of a network's result: a network with damaged weights outputs numbers as well.
#[derive(Debug, Default)]
struct Plausibility {
    pixels: usize,
    /// Missing, or beyond [`FARTHEST_M`].
    implausible: usize,
    /// With raw depth and a plausible result.
    compared: usize,
    /// Of these, off by more than [`FACTOR`].
    moved: usize,
}

impl Plausibility {
    fn of(refined_m: &[f32], raw: &[u16], input: &InputDepth) -> Self {
        let mut seen = Self { pixels: refined_m.len(), ..Self::default() };
        for (refined, raw) in refined_m.iter().zip(raw) {
            // NaN is in no range.
            if !(*refined > 0.0 && *refined <= FARTHEST_M) {
                seen.implausible += 1;
            } else if let Some(raw) = input.metres(*raw) {
                seen.compared += 1;
                let is_near = (raw / FACTOR..=raw * FACTOR).contains(refined);
                seen.moved += usize::from(!is_near);
            }
        }
        seen
    }

    fn warnings(&self) -> Vec<String> {
        let share = |n: usize, of: usize| n as f64 / of.max(1) as f64;
        let missing = share(self.implausible, self.pixels);
        let moved = share(self.moved, self.compared);
        let mut warnings = Vec::new();
        if missing > IMPLAUSIBLE {
            warnings.push(format!(
                "{:.0} % of the result is missing or beyond {FARTHEST_M} m: the weights may be damaged or of another training \
                 (`depthrig cdm info NAME --check`), --channel-order may be another, or --out-unit too small",
                missing * 100.0
            ));
        }
        if moved > MOVED {
            warnings.push(format!(
                "{:.0} % of the raw depth differs from the result by more than a factor of {FACTOR}: the weights may be damaged \
                 or of another training (`depthrig cdm info NAME --check`), or --depth-unit may be another",
                moved * 100.0
            ));
        }
        warnings
    }
}

/// The result in metres.
fn metres(refined: &Refined, args: &RunArgs) -> Vec<f32> {
    match refined {
        Refined::Units(units) => units.iter().map(|u| f32::from(*u) * args.out_unit as f32).collect(),
        Refined::Floats(inverse) if args.inverse => inverse.iter().map(|v| v.recip()).collect(),
        Refined::Floats(metres) => metres.clone(),
    }
}

fn print_report(r: &Report<'_>, json: bool) -> Result<()> {
    if json {
        return out::json(r);
    }
    let model = if r.model.is_empty() { String::new() } else { format!(", model {}", r.model) };
    out::line(format_args!(
        "{}: {}x{}, {}; {}{model}; depth in {:.1} % of the pixels, {:.1} % before; {:.0} + {:.0} + {:.0} ms",
        r.out.display(),
        r.width,
        r.height,
        r.values,
        r.engine,
        r.refined_percent,
        r.raw_percent,
        r.prepare_ms,
        r.infer_ms,
        r.finish_ms
    ))?;
    if r.trained == Some(false) {
        out::line("the model was NEVER TRAINED: its weights are random, and its output is not depth")?;
    }
    Ok(())
}

/// Returns whether the output is a PNG.
fn form(args: &RunArgs) -> Result<bool> {
    let ending = args.out.extension().and_then(|e| e.to_str()).unwrap_or_default().to_ascii_lowercase();
    match ending.as_str() {
        "npy" => Ok(false),
        "png" if args.inverse => {
            Err(UsageError("--inverse writes 1/m, which an integer PNG cannot hold; use .npy".to_owned())
                .into())
        }
        "png" => Ok(true),
        _ => {
            Err(UsageError(format!("{}: unsupported extension; use .npy or .png", args.out.display())).into())
        }
    }
}

fn options(args: &RunArgs) -> Result<RefinerOptions> {
    let file = args.model.as_deref().map(Path::new).filter(|path| tiny::is_tiny_file(path));
    let engine = args.engine.or_else(|| file.map(|_| EngineKind::Tiny));
    let is_tiny = engine == Some(EngineKind::Tiny);
    let tiny = file.filter(|_| is_tiny).map(tiny::TinyFile::read).transpose().map_err(usage)?;
    let model = match &args.model {
        Some(_) if engine.is_some_and(|e| !e.needs_model()) => None,
        Some(name) => {
            let mut model = args.models.store()?.model(name).map_err(usage)?;
            if let Some(order) = args.channel_order {
                model.channel_order = order.into();
            }
            if let Some(max) = args.max_depth {
                model.max_depth_m = max;
            }
            Some(model)
        }
        None => None,
    };
    Ok(RefinerOptions {
        engine,
        model,
        tiny,
        input_size: args.input_size,
        precision: args.precision,
        device: args.device.clone(),
        threads: args.threads.into(),
        library: args.library.clone(),
        fill_reach: args.fill_reach,
    })
}

/// Reads colour as 8-bit RGB; grey is expanded, and transparency is dropped.
fn read_color(path: &Path) -> Result<(Vec<u8>, usize, usize)> {
    let image = image_file::open(path)?;
    if image.color().bytes_per_pixel() / image.color().channel_count() != 1 {
        let text = format!("{}: colour has more than 8 bits per channel; convert it to 8", path.display());
        return Err(UsageError(text).into());
    }
    let width = image.width() as usize;
    let height = image.height() as usize;
    // Dropped, not blended: as OpenCV reads it.
    Ok((image.into_rgb8().into_raw(), width, height))
}

/// Reads depth and checks that it has the size of its colour image.
fn read_depth(path: &Path, rgb: &Path, width: usize, height: usize) -> Result<Vec<u16>> {
    let image = image_file::open(path)?;
    let has = (image.width() as usize, image.height() as usize);
    if has != (width, height) {
        return Err(UsageError(format!(
            "{} is {}x{} and {} is {width}x{height}: they do not show the same view. Depth must be registered to colour first, for which the \
             calibration of the camera is needed; depthrig does it for the cameras of a rig (refine) and for its datasets \
             (depthrig cdm relabel)",
            path.display(),
            has.0,
            has.1,
            rgb.display()
        ))
        .into());
    }
    match image {
        DynamicImage::ImageLuma16(depth) => Ok(depth.into_raw()),
        DynamicImage::ImageLuma8(_) => Err(UsageError(format!(
            "{}: has 8 bits per pixel, which is mostly a preview; use a 16-bit PNG with one channel",
            path.display()
        ))
        .into()),
        other => Err(UsageError(format!(
            "{}: unsupported depth format {:?}; use a 16-bit PNG with one channel",
            path.display(),
            other.color()
        ))
        .into()),
    }
}

/// Encodes the output file.
fn encoded(refined: &Refined, width: usize, height: usize) -> Result<Vec<u8>> {
    Ok(match refined {
        Refined::Floats(pixels) => {
            let data: Vec<_> = pixels.iter().flat_map(|d| d.to_le_bytes()).collect();
            depthrig_recorder::npy::file("<f4", &[height, width], &data)
        }
        Refined::Units(pixels) => {
            // PNG is big-endian; the encoder takes native order.
            let data: Vec<_> = pixels.iter().flat_map(|d| d.to_ne_bytes()).collect();
            let mut file = Vec::new();
            png::PngEncoder::new(&mut file).write_image(
                &data,
                width as u32,
                height as u32,
                ExtendedColorType::L16,
            )?;
            file
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The warnings for a result over raw depth of 1 m in units of 1 mm, and two pixels that no model uses.
    fn warned(result: impl Fn(usize) -> f32) -> Vec<String> {
        let mut raw = vec![1000u16; 100];
        raw[98] = 0;
        raw[99] = 30_000;
        let refined: Vec<f32> = (0..raw.len()).map(result).collect();
        let input = InputDepth::of(&raw, 0.001, Some(6.0));
        Plausibility::of(&refined, &raw, &input).warnings()
    }

    #[test]
    fn numbers_that_are_not_depth_are_a_warning_with_its_cure() {
        assert_eq!(warned(|_| 1.0), [""; 0]);
        for bad in [0.0, -1.0, 20.5, f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
            assert_eq!(warned(|i| if i < 5 { bad } else { 1.0 }), [""; 0], "{bad}");
            let warnings = warned(|i| if i < 17 { bad } else { 1.0 });
            let [why] = &warnings[..] else { panic!("{bad}: {warnings:?}") };
            assert!(why.starts_with("17 % of the result is missing or beyond 20 m"), "{why}");
            assert!(why.contains("cdm info NAME --check"), "{why}");
        }
    }

    /// Output in range but far from the measured depth is not depth either.
    #[test]
    fn depth_far_from_the_raw_depth_is_a_warning_with_its_cure() {
        // A model that improves depth.
        assert_eq!(warned(|i| if i < 9 { 3.0 } else { 0.6 }), [""; 0]);
        for bad in [0.3, 3.0] {
            let warnings = warned(|i| if i < 49 { bad } else { 1.2 });
            let [why] = &warnings[..] else { panic!("{bad}: {warnings:?}") };
            let begins = "50 % of the raw depth differs from the result by more than a factor of 2";
            assert!(why.starts_with(begins) && why.contains("cdm info NAME --check"), "{why}");
        }
        assert_eq!(warned(|i| if i < 98 { 1.0 } else { 15.0 }), [""; 0], "where raw depth is missing");
    }
}
