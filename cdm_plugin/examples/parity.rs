//! How far the network's input, its output and the result lie from those of the official code, for files that
//! `tests/peers/cdm_official.py` wrote:
//!
//! `cargo run --release -p depthrig-cdm --example parity -- ENCODER WEIGHTS ENGINE FILE...`
#![allow(clippy::print_stdout)]

use depthrig_cdm::prep::Prep;
use depthrig_cdm::{
    ChannelOrder, Color, ColorFormat, Encoder, EngineKind, Error, ErrorKind, Job, Model, Output, RawDepth,
    RefinerOptions, Result, StepTimes, Weights, refiner,
};
use std::sync::Arc;

fn main() -> Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [encoder, weights, engine, files @ ..] = arguments.as_slice() else {
        return Err(Error::new(ErrorKind::BadInput, "usage: parity ENCODER WEIGHTS ENGINE FILE..."));
    };
    let model = Model {
        id: "parity".into(),
        encoder: encoder.parse::<Encoder>()?,
        weights: Arc::new(Weights::open(weights)?),
        channel_order: ChannelOrder::Bgr,
        input_size: 518,
        max_depth_m: 6.0,
    };
    for file in files {
        one(&model, engine.parse()?, file)?;
    }
    Ok(())
}

/// The numbers of the tensor `name` with its shape.
fn numbers(file: &Weights, name: &str) -> Result<(Vec<usize>, Vec<f32>)> {
    let missing = || Error::new(ErrorKind::NotFound, format!("{}: no tensor {name}", file.path().display()));
    let shape = file.entries().get(name).ok_or_else(missing)?.shape.clone();
    Ok((shape, file.to_f32(name)?))
}

fn one(model: &Model, engine: EngineKind, path: &str) -> Result<()> {
    let file = Weights::open(path)?;
    let (shape, rgb) = numbers(&file, "rgb")?;
    let (_, raw) = numbers(&file, "raw")?;
    let [height, width, _] = shape[..] else {
        return Err(Error::new(ErrorKind::BadInput, "rgb has three axes"));
    };
    let input_size = numbers(&file, "input_size")?.1[0] as u32;
    let unit_m = 1.0 / f64::from(numbers(&file, "units_per_metre")?.1[0]);
    let rgb: Vec<u8> = rgb.into_iter().map(|v| v as u8).collect();
    let raw: Vec<u16> = raw.into_iter().map(|v| v as u16).collect();
    let color = Color { pixels: &rgb, format: ColorFormat::Rgb8, width, height, stride: 3 * width };
    let depth = RawDepth { pixels: &raw, unit_m };

    let (shape, official) = numbers(&file, "x")?;
    let mut prep = Prep::new(width, height, input_size, model.max_depth_m)?;
    assert_eq!(prep.net(), (shape[3], shape[2]), "the size of the input");
    let mut x = vec![f32::NAN; official.len()];
    prep.prepare(&color, &depth, model.channel_order, &mut x)?;
    let input = max_abs(&x, &official);

    let options = RefinerOptions {
        engine: Some(engine),
        model: Some(model.clone()),
        input_size: Some(input_size),
        ..RefinerOptions::default()
    };
    let mut inverse = vec![f32::NAN; width * height];
    let out = Output::Inverse(&mut inverse);
    let mut jobs = [Job { color, depth, out, steps: StepTimes::default() }];
    refiner(&options)?.refine(&mut jobs)?;
    let infer_ms = jobs[0].steps.infer_ns / 1_000_000;
    let result = max_abs(&inverse, &numbers(&file, "inv_full")?.1);

    println!(
        "{path}: {width}x{height} as {}x{}: input differs by {input:.1e}, result by {result:.1e} 1/m; {engine} {infer_ms} ms",
        shape[3], shape[2]
    );
    Ok(())
}

fn max_abs(a: &[f32], b: &[f32]) -> f32 {
    assert_eq!(a.len(), b.len());
    a.iter()
        .zip(b)
        .map(|(a, b)| (a - b).abs())
        .fold(0.0, |m, d| if d.is_nan() { f32::INFINITY } else { m.max(d) })
}
