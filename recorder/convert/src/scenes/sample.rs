//! A sample's members, and samples beside each other as one image.

use depthrig_bus::{Distortion, Intrinsics};
use depthrig_cdm::{Color, ColorFormat, FillRefiner, Job, Output, RawDepth, Refiner, StepTimes};
use depthrig_recorder::{Error, ErrorKind, Result};
use depthrig_sim::synthetic::scenes::{Settings, TRUTH_UNIT_M, Triplet};
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder};
use serde::Serialize;

/// Names and contents of a sample's files.
pub(super) type Members = Vec<(String, Vec<u8>)>;

#[derive(Serialize)]
struct Record<'a> {
    format: u32,
    sensor: &'a str,
    sensor_model: &'a str,
    seed: u64,
    families: Vec<&'static str>,
    scene: &'static str,
    intrinsics: Lens,
    truth_unit_m: f64,
    raw_unit_m: f64,
    hidden: f32,
    width: u32,
    height: u32,
    licence: &'static str,
}

#[derive(Serialize)]
pub(super) struct Lens {
    fx: f64,
    fy: f64,
    cx: f64,
    cy: f64,
    model: Distortion,
    coeffs: [f64; 8],
}

impl Lens {
    pub(super) fn of(k: &Intrinsics) -> Self {
        Self { fx: k.fx, fy: k.fy, cx: k.cx, cy: k.cy, model: k.distortion(), coeffs: k.coeffs }
    }
}

/// Makes the refiner `fill` of the daemon, for the holes of measured depth, so that a network learns on what it gets
/// live. Every hole is filled.
pub(super) fn fill() -> Result<FillRefiner> {
    let made = FillRefiner::new(1).map(|fill| fill.with_reach(1.0));
    made.map_err(|e| Error::new(ErrorKind::Io, e.to_string()).with_source(e))
}

/// Measured depth without holes, in the same unit; without any depth it stays empty.
fn filled(s: &Triplet, settings: &Settings, fill: &mut FillRefiner) -> Result<Vec<u16>> {
    let width = settings.width as usize;
    let height = settings.height as usize;
    let mut pixels = vec![0; s.raw.len()];
    let unit_m = s.raw_unit_m;
    let mut job = Job {
        color: Color { pixels: &s.color, format: ColorFormat::Rgb8, width, height, stride: 3 * width },
        depth: RawDepth { pixels: &s.raw, unit_m },
        out: Output::Units { pixels: &mut pixels, unit_m },
        steps: StepTimes::default(),
    };
    fill.refine(core::slice::from_mut(&mut job))
        .map_err(|e| Error::new(ErrorKind::BadInput, format!("sample {}: {e}", s.number)).with_source(e))?;
    Ok(pixels)
}

/// The files of a sample, the record last.
pub(super) fn members(s: &Triplet, settings: &Settings, fill: &mut FillRefiner) -> Result<Members> {
    let size = (settings.width, settings.height);
    let key = format!("{:010}", s.number);
    let gray16 = |v: &[u16]| png(bytemuck::cast_slice(v), size, ExtendedColorType::L16);
    let record = Record {
        format: super::FORMAT,
        sensor: s.camera,
        sensor_model: s.sensor_model,
        seed: settings.seed,
        families: s.families.iter().map(|f| f.name()).collect(),
        scene: s.scene.name(),
        intrinsics: Lens::of(&s.intrinsics),
        truth_unit_m: TRUTH_UNIT_M,
        raw_unit_m: s.raw_unit_m,
        hidden: s.hidden,
        width: size.0,
        height: size.1,
        licence: "MIT OR Apache-2.0",
    };
    let json = serde_json::to_vec(&record)
        .map_err(|e| Error::new(ErrorKind::Codec, format!("the record of sample {key}: {e}")))?;
    Ok(vec![
        (format!("{key}.color.png"), png(&s.color, size, ExtendedColorType::Rgb8)?),
        (format!("{key}.truth.png"), gray16(&s.truth)?),
        (format!("{key}.raw.png"), gray16(&s.raw)?),
        (format!("{key}.filled.png"), gray16(&filled(s, settings, fill)?)?),
        (format!("{key}.material.png"), png(&s.material, size, ExtendedColorType::L8)?),
        (format!("{key}.json"), json),
    ])
}

pub(super) fn png(pixels: &[u8], (width, height): (u32, u32), kind: ExtendedColorType) -> Result<Vec<u8>> {
    let mut out = Vec::new();
    let filter = if kind == ExtendedColorType::L8 { FilterType::Up } else { FilterType::Paeth };
    PngEncoder::new_with_quality(&mut out, CompressionType::Fast, filter)
        .write_image(pixels, width, height, kind)
        .map_err(|e| {
            Error::new(ErrorKind::Codec, format!("a PNG of {width}x{height}: {e}")).with_source(e)
        })?;
    Ok(out)
}

/// Largest width of a cell of a contact sheet, pixels.
const CELL: usize = 320;
/// Samples in a row of it.
const IN_A_ROW: usize = 2;

/// A PNG of samples: colour, true and measured depth beside each other; near is bright, holes are black.
///
/// # Errors
/// [`ErrorKind::Codec`] when it cannot be encoded.
pub fn contact_sheet(samples: &[Triplet], settings: &Settings) -> Result<Vec<u8>> {
    let (w, h) = (settings.width as usize, settings.height as usize);
    let shrink = w.div_ceil(CELL).max(1);
    let (cell_w, cell_h) = (w / shrink, h / shrink);
    let rows = samples.len().div_ceil(IN_A_ROW).max(1);
    let (width, height) = (cell_w * 3 * IN_A_ROW, cell_h * rows);
    let mut sheet = vec![0u8; width * height * 3];
    for (i, s) in samples.iter().enumerate() {
        let mut seen: Vec<u16> = s.truth.iter().copied().filter(|z| *z > 0).collect();
        seen.sort_unstable();
        let at =
            |part: usize| seen.get(seen.len() * part / 100).map_or(1.0, |z| f64::from(*z) * TRUTH_UNIT_M);
        let range = (at(2) * 0.95, at(98) * 1.05);
        for y in 0..cell_h {
            for x in 0..cell_w {
                let from = y * shrink * w + x * shrink;
                let places = [
                    mean(&s.color, w, from, shrink),
                    shade(f64::from(s.truth[from]) * TRUTH_UNIT_M, range),
                    shade(f64::from(s.raw[from]) * s.raw_unit_m, range),
                ];
                for (column, color) in places.into_iter().enumerate() {
                    let left = (i % IN_A_ROW * 3 + column) * cell_w + x;
                    let to = ((i / IN_A_ROW * cell_h + y) * width + left) * 3;
                    sheet[to..to + 3].copy_from_slice(&color);
                }
            }
        }
    }
    png(&sheet, (width as u32, height as u32), ExtendedColorType::Rgb8)
}

/// The mean colour of a block.
fn mean(color: &[u8], w: usize, from: usize, shrink: usize) -> [u8; 3] {
    core::array::from_fn(|c| {
        let block =
            (0..shrink * shrink).map(|i| u32::from(color[(from + i / shrink * w + i % shrink) * 3 + c]));
        (block.sum::<u32>() / (shrink * shrink) as u32) as u8
    })
}

/// From warm and bright (near) to blue and dark (far).
fn shade(z: f64, (near, far): (f64, f64)) -> [u8; 3] {
    if z <= 0.0 {
        return [0; 3];
    }
    let t = ((1.0 / z - 1.0 / far) / (1.0 / near - 1.0 / far)).clamp(0.0, 1.0);
    let mix = |a: f64, b: f64, c: f64| {
        let v = if t < 0.5 { a + (b - a) * t * 2.0 } else { b + (c - b) * (t * 2.0 - 1.0) };
        v as u8
    };
    [mix(40.0, 190.0, 255.0), mix(40.0, 80.0, 235.0), mix(110.0, 110.0, 170.0)]
}
