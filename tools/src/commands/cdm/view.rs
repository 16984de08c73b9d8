//! `depthrig cdm view`: refined depth beside raw depth, as a picture of four panels and as a page with turning points.

use crate::context::Context;
use crate::exit::{Exit, UsageError};
use crate::out;
use crate::outfile::{OutFile, Overwrite};
use anyhow::{Context as _, Result, bail};
use depthrig_bus::{FrameHeader, Intrinsics, PixelFormat, files};
use depthrig_calib::{PoseExt, Registration, same_view};
use depthrig_recorder::{Dataset, DatasetFrame, DatasetSet, PixelMode};
use image::RgbImage;
use serde::Serialize;
use std::path::{Path, PathBuf};

mod page;
mod panels;

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
PREFIX.png shows colour, raw depth in the view of colour, refined depth, and the difference of both depths from 0 to
0.2 m. PREFIX.html shows both as points that turn, beside each other; it is one file, needs no network, and any browser
opens it.

The pictures come out of a dataset with depth_refined (of a rig, or of `depthrig cdm relabel`), or are three files of
one view and size.

Exit codes: 0 good, 1 failed, 2 wrong usage.

Examples:
  depthrig cdm view --dataset data/kitchen_cdm --camera d435 --set 120 --out kitchen
  depthrig cdm view --rgb color.png --depth depth.png --depth-unit 0.001 --refined refined.npy --out look
  depthrig cdm view --rgb color.png --depth depth.png --depth-unit 0.001 --refined refined.png \\
      --intrinsics 911.8,911.2,645.1,364.9 --out look";

/// Arguments.
#[derive(Debug, clap::Args)]
pub struct ViewArgs {
    /// A dataset with refined depth
    #[arg(long, value_name = "DATASET", conflicts_with = "rgb", required_unless_present = "rgb")]
    dataset: Option<PathBuf>,
    /// The camera [default: the first with refined depth]
    #[arg(long, value_name = "NAME", requires = "dataset")]
    camera: Option<String>,
    /// Id of the set [default: the first with everything]
    #[arg(long, value_name = "ID", requires = "dataset")]
    set: Option<u64>,
    /// Colour, PNG or JPEG
    #[arg(long, value_name = "FILE", requires_all = ["depth", "depth_unit", "refined"])]
    rgb: Option<PathBuf>,
    /// Raw depth in the view of colour, a PNG of 16 bits
    #[arg(long, value_name = "FILE", requires = "rgb")]
    depth: Option<PathBuf>,
    /// Metres per unit of raw depth, and of refined depth when that is a PNG
    #[arg(long, value_name = "METRES", requires = "rgb", value_parser = crate::args::depth_unit_m)]
    depth_unit: Option<f64>,
    /// Refined depth: .npy of 32-bit floats in metres, or a PNG of 16 bits
    #[arg(long, value_name = "FILE", requires = "rgb")]
    refined: Option<PathBuf>,
    /// Intrinsics of the pictures, pixels [default: a lens of 69 degrees, which the page then says]
    #[arg(long, value_name = "FX,FY,CX,CY", requires = "rgb", value_parser = intrinsics)]
    intrinsics: Option<[f64; 4]>,
    /// What the files are named, without their endings
    #[arg(long, value_name = "PREFIX")]
    out: PathBuf,
    #[command(flatten)]
    overwrite: Overwrite,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

fn intrinsics(text: &str) -> Result<[f64; 4], String> {
    let numbers: Vec<f64> = text.split(',').filter_map(|n| n.trim().parse().ok()).collect();
    match <[f64; 4]>::try_from(numbers) {
        Ok(k) if k.iter().all(|v| v.is_finite()) && k[0] > 0.0 && k[1] > 0.0 => Ok(k),
        _ => Err("write four numbers, such as 911.8,911.2,645.1,364.9".to_owned()),
    }
}

/// What is looked at: one view, depth in metres, 0 where there is none.
pub(crate) struct Look {
    color: RgbImage,
    raw: Vec<f32>,
    refined: Vec<f32>,
    intrinsics: Intrinsics,
    /// What it is, and what refined it.
    title: String,
    engine: String,
    /// What the reader must know.
    note: String,
}

#[derive(Serialize)]
struct Report {
    picture: PathBuf,
    page: PathBuf,
    /// Share of pixels with depth.
    raw_filled: f64,
    refined_filled: f64,
    /// Median of the difference where both are, metres.
    median_difference_m: Option<f64>,
}

/// Looks.
pub fn run(args: &ViewArgs, _: &Context) -> Result<Exit> {
    let with = |ending: &str| {
        let mut name = args.out.clone().into_os_string();
        name.push(ending);
        PathBuf::from(name)
    };
    let inputs: Vec<&Path> =
        [&args.rgb, &args.depth, &args.refined].into_iter().flatten().map(AsRef::as_ref).collect();
    let picture = OutFile::new(&with(".png"), args.overwrite, &inputs)?;
    let page = OutFile::new(&with(".html"), args.overwrite, &inputs)?;
    let look = match &args.dataset {
        Some(dataset) => from_dataset(args, dataset)?,
        None => from_files(args)?,
    };
    picture.write(&crate::picture::png(&panels::draw(&look))?)?;
    page.write(page::write(&look)?.as_bytes())?;
    let filled =
        |depth: &[f32]| depth.iter().filter(|z| **z > 0.0).count() as f64 / depth.len().max(1) as f64;
    let report = Report {
        raw_filled: filled(&look.raw),
        refined_filled: filled(&look.refined),
        median_difference_m: median_difference(&look),
        picture: picture.path().to_owned(),
        page: page.path().to_owned(),
    };
    if args.json {
        out::json(&report)?;
    } else {
        let off = report.median_difference_m.map_or_else(|| "-".to_owned(), |m| format!("{:.1} mm", m * 1e3));
        out::line(format_args!("{}\n{}", report.picture.display(), report.page.display()))?;
        out::line(format_args!(
            "{} by {}: depth on {:.1} % of the pixels, raw on {:.1} %; median difference {off}",
            look.title,
            look.engine,
            report.refined_filled * 100.0,
            report.raw_filled * 100.0
        ))?;
    }
    Ok(Exit::Good)
}

fn median_difference(look: &Look) -> Option<f64> {
    let pairs = look.raw.iter().zip(&look.refined).filter(|(a, b)| **a > 0.0 && **b > 0.0);
    let mut off: Vec<f32> = pairs.map(|(a, b)| (a - b).abs()).collect();
    if off.is_empty() {
        return None;
    }
    let middle = off.len() / 2;
    Some(f64::from(*off.select_nth_unstable_by(middle, f32::total_cmp).1))
}

fn usage(text: String) -> anyhow::Error {
    UsageError(text).into()
}

fn from_dataset(args: &ViewArgs, path: &Path) -> Result<Look> {
    let dataset = Dataset::open(path)?;
    let streams = &dataset.session().streams;
    let is = |at: usize, camera: &str, stream: &str| {
        streams[at].id.camera.as_str() == camera && streams[at].id.stream.as_str() == stream
    };
    let find = |camera: &str, stream: &str| (0..streams.len()).find(|at| is(*at, camera, stream));
    let has =
        |camera: &str| Some([find(camera, "color")?, find(camera, "depth")?, find(camera, "depth_refined")?]);
    let camera = args
        .camera
        .clone()
        .or_else(|| streams.iter().map(|s| s.id.camera.to_string()).find(|camera| has(camera).is_some()));
    let Some((camera, [color, depth, refined])) = camera.and_then(|c| Some((c.clone(), has(&c)?))) else {
        let names: Vec<_> = streams.iter().map(|s| s.id.to_string()).collect();
        return Err(usage(format!(
            "{} has no camera with color, depth and depth_refined (it has {}); `depthrig cdm relabel` makes one that has",
            path.display(),
            names.join(", ")
        )));
    };
    let mut reader = dataset.set_reader()?;
    let whole =
        |set: &DatasetSet| [color, depth, refined].iter().all(|s| set.frames.iter().any(|f| f.stream == *s));
    let wanted = |set: &DatasetSet| args.set.is_none_or(|id| set.id == id) && whole(set);
    let number = (0..reader.times().len())
        .find(|n| reader.read(*n, PixelMode::None).is_ok_and(|set| wanted(&set)))
        .ok_or_else(|| usage(format!("no such set has color, depth and depth_refined of {camera}")))?;
    let set = reader.read(number, PixelMode::Decoded)?;
    let frame = |stream: usize| {
        let frame = set.frames.iter().find(|f| f.stream == stream);
        frame.with_context(|| format!("set {} lost a frame of {camera}", set.id))
    };
    let (color, depth, refined) = (frame(color)?, frame(depth)?, frame(refined)?);
    let (h, with) = (&refined.header, refined.header.refiner_model());
    Ok(Look {
        color: crate::picture::to_rgb(&color.header, &color.pixels)?,
        raw: in_view(color, depth)?,
        refined: metres(&refined.header, &refined.pixels)?,
        intrinsics: color.header.intrinsics,
        title: format!("{} {camera} set {}", dataset.session().name, set.id),
        engine: if with.is_empty() { h.refiner().to_owned() } else { format!("{} with {with}", h.refiner()) },
        note: String::new(),
    })
}

fn metres(h: &FrameHeader, pixels: &[u8]) -> Result<Vec<f32>> {
    crate::picture::depth_m(h, pixels)?.with_context(|| format!("{}/{} is no depth", h.camera(), h.stream()))
}

/// Raw depth in the view of colour, metres.
fn in_view(color: &DatasetFrame, depth: &DatasetFrame) -> Result<Vec<f32>> {
    let (c, d) = (&color.header, &depth.header);
    let raw = metres(d, &depth.pixels)?;
    let (c_size, d_size) = ((c.width, c.height), (d.width, d.height));
    let same = same_view((&d.intrinsics, d_size, &d.pose), (&c.intrinsics, c_size, &c.pose));
    if same || (c_size == d_size && !d.intrinsics.is_known()) {
        return Ok(raw);
    }
    let unit = if d.format == PixelFormat::Z16 as u32 { d.depth_unit_m } else { 0.0001 };
    let units: Vec<u16> =
        raw.iter().map(|z| (f64::from(*z) / unit + 0.5).clamp(0.0, 65_535.0) as u16).collect();
    let between = c.pose.inverse().compose(&d.pose);
    let mut out = vec![0; c.width as usize * c.height as usize];
    Registration::new(&d.intrinsics, d_size, &c.intrinsics, c_size, &between)?
        .depth_to_color(&units, unit, &mut out)?;
    Ok(out.iter().map(|z| (f64::from(*z) * unit) as f32).collect())
}

fn from_files(args: &ViewArgs) -> Result<Look> {
    let (Some(rgb), Some(depth), Some(unit), Some(refined)) =
        (&args.rgb, &args.depth, args.depth_unit, &args.refined)
    else {
        return Err(usage("give --dataset, or --rgb, --depth, --depth-unit and --refined".to_owned()));
    };
    let color = crate::picture::open(rgb)?.into_rgb8();
    let size = color.dimensions();
    let raw = read_depth(depth, unit, size)?;
    let refined_depth = read_depth(refined, unit, size)?;
    let (w, h) = (f64::from(size.0), f64::from(size.1));
    let guess = w / 2.0 / 34.5f64.to_radians().tan();
    let note = if args.intrinsics.is_some() { "" } else { "intrinsics are a guess (a lens of 69 degrees)" };
    let [fx, fy, cx, cy] = args.intrinsics.unwrap_or([guess, guess, w / 2.0 - 0.5, h / 2.0 - 0.5]);
    let name = |p: &Path| p.file_name().unwrap_or_default().to_string_lossy().into_owned();
    Ok(Look {
        color,
        raw,
        refined: refined_depth,
        intrinsics: Intrinsics::pinhole(fx, fy, cx, cy),
        title: name(rgb),
        engine: name(refined),
        note: note.to_owned(),
    })
}

/// Depth of a file in metres: 32-bit floats of NumPy, or 16 bits in units.
fn read_depth(path: &Path, unit: f64, (w, h): (u32, u32)) -> Result<Vec<f32>> {
    let pixels = w as usize * h as usize;
    if path.extension().is_some_and(|e| e.eq_ignore_ascii_case("npy")) {
        let bytes = files::read(path, files::IMAGE_MAX_BYTES)
            .with_context(|| format!("{} cannot be read", path.display()))?;
        return npy(&bytes, (w, h)).with_context(|| {
            format!("{} is no NumPy array of {h} rows and {w} columns of 32-bit floats", path.display())
        });
    }
    let image::DynamicImage::ImageLuma16(picture) = crate::picture::open(path)? else {
        bail!("{} is not grey of 16 bits", path.display());
    };
    if picture.len() != pixels {
        let (pw, ph) = picture.dimensions();
        return Err(usage(format!(
            "{} has {pw}x{ph} pixels, colour {w}x{h}: they must be of one view",
            path.display()
        )));
    }
    Ok(picture.iter().map(|z| (f64::from(*z) * unit) as f32).collect())
}

/// The numbers of an array file of version 1 or 2.
fn npy(bytes: &[u8], (w, h): (u32, u32)) -> Option<Vec<f32>> {
    let rest = bytes.strip_prefix(b"\x93NUMPY")?;
    let (version, rest) = rest.split_first_chunk::<2>()?;
    let (len, rest) = if version[0] == 1 {
        let (len, rest) = rest.split_first_chunk::<2>()?;
        (usize::from(u16::from_le_bytes(*len)), rest)
    } else {
        let (len, rest) = rest.split_first_chunk::<4>()?;
        (u32::from_le_bytes(*len) as usize, rest)
    };
    let (head, data) = rest.split_at_checked(len)?;
    let head: String = std::str::from_utf8(head).ok()?.split_whitespace().collect();
    let right = head.contains("'descr':'<f4'")
        && head.contains("'fortran_order':False")
        && head.contains(&format!("'shape':({h},{w})"));
    let pixels = w as usize * h as usize;
    (right && data.len() == pixels * 4).then(|| {
        data.as_chunks::<4>()
            .0
            .iter()
            .map(|b| f32::from_le_bytes(*b))
            .map(|z| if z.is_finite() { z } else { 0.0 })
            .collect()
    })
}

#[cfg(test)]
mod tests;
