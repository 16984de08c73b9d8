//! `depthrig stereo`: the disparity of one rectified pair of pictures.

use crate::exit::{Exit, UsageError};
use crate::outfile::{OutFile, Overwrite};
use crate::{out, picture};
use anyhow::Result;
use depthrig_bus::clock::thread_cpu_ns;
use depthrig_calib::RowCorrector;
use depthrig_calib::stereo::{
    DisparityMap, Gray, Matcher, OrderCheck, Parameters, Preset, RowCheck, RowOffset, SgmMatcher, StereoPair,
};
use image::{ColorType, DynamicImage, ExtendedColorType, ImageEncoder, codecs::png};
use serde::Serialize;
use std::path::{Path, PathBuf};

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
The pictures are rectified: what is seen at (x, y) in the left one is seen at (x - disparity, y) in the right one. Colour
is made grey; pictures of 16 bits count from the highest bit that one of the two uses.

OUT.npy holds 32-bit floats, pixels of the left picture, NaN where there is none. OUT.png holds 16 bits, 256 a pixel, 0
where there is none (as KITTI has it). Confidence is a PNG of 8 bits: 0 where there is none, 255 for the surest.

Exit codes: 0 good, 1 failed, 2 wrong usage or pictures that do not fit, or that are swapped.

Examples:
  depthrig stereo left.png right.png --out disparity.npy
  depthrig stereo left.jpg right.jpg --preset ultra --max-disparity 224 --out disparity.png --confidence sure.png";

/// Arguments.
#[derive(Debug, clap::Args)]
pub struct StereoArgs {
    /// The left picture: PNG, JPEG, PGM or PPM
    left: PathBuf,
    /// The right picture, of the same size
    right: PathBuf,
    /// A point between fast and good: performance, quality or ultra
    #[arg(long, value_name = "PRESET", default_value = "quality", value_parser = preset)]
    preset: Preset,
    /// Disparities to search, pixels; what is nearer gets none
    #[arg(long, value_name = "N", default_value_t = 128, value_parser = clap::value_parser!(u16).range(1..=256))]
    max_disparity: u16,
    /// The file to write, .npy or .png
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// A PNG of how sure each disparity is
    #[arg(long, value_name = "FILE")]
    confidence: Option<PathBuf>,
    #[command(flatten)]
    overwrite: Overwrite,
    /// Threads
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..=64))]
    threads: u16,
    /// Match even if left and right look swapped
    #[arg(long)]
    even_if_swapped: bool,
    /// Match rows as they are, even where they are measured to be apart
    #[arg(long)]
    keep_rows: bool,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// Reads the name of a preset.
///
/// # Errors
/// When there is none of that name.
pub fn preset(text: &str) -> Result<Preset, String> {
    text.parse().map_err(|e: depthrig_calib::Error| e.to_string())
}

/// Rec. 709 luma. `image` makes grey of colour in ways that differ from version to version; depth shall not.
const fn luma([r, g, b]: [u32; 3]) -> u32 {
    (2126 * r + 7152 * g + 722 * b) / 10_000
}

/// A grey picture of its own.
pub struct Picture {
    pixels: Vec<u8>,
    width: usize,
    height: usize,
}

impl Picture {
    /// Reads a pair of PNG, JPEG, PGM or PPM. Of 16 bits those 8 count that begin with the highest which either picture uses:
    /// a camera's 10 or 12 bits are mostly kept in the lower ones.
    ///
    /// # Errors
    /// When one cannot be read.
    pub fn pair(left: &Path, right: &Path) -> Result<[Self; 2]> {
        let pictures = [picture::open(left)?, picture::open(right)?];
        if pictures.iter().all(|p| !wide(p)) {
            return Ok(pictures.map(|p| {
                let (width, height) = (p.width() as usize, p.height() as usize);
                let pixels = match p {
                    DynamicImage::ImageLuma8(p) => p.into_raw(),
                    p => p.into_rgb8().pixels().map(|p| luma(p.0.map(u32::from)) as u8).collect(),
                };
                Self { pixels, width, height }
            }));
        }
        let most = pictures.iter().map(most).max().unwrap_or(0);
        let shift = (u32::BITS - most.leading_zeros()).saturating_sub(u8::BITS);
        Ok(pictures.map(|p| {
            let (width, height) = (p.width() as usize, p.height() as usize);
            // One of 8 bits has been spread to 16.
            let shift = if wide(&p) { shift } else { u8::BITS };
            let pixels = p.into_rgb16().pixels().map(|p| (luma(p.0.map(u32::from)) >> shift) as u8).collect();
            Self { pixels, width, height }
        }))
    }

    /// One of these pixels, rows without padding.
    pub const fn made(pixels: Vec<u8>, width: usize, height: usize) -> Self {
        Self { pixels, width, height }
    }

    /// As the engine takes it.
    pub fn gray(&self) -> Gray<'_> {
        Gray::packed(&self.pixels, self.width, self.height)
    }

    /// Refuses another picture that is of another size.
    ///
    /// # Errors
    /// A usage error that says both sizes.
    pub fn fits(&self, other: &Self) -> Result<()> {
        if (self.width, self.height) == (other.width, other.height) {
            return Ok(());
        }
        let text = format!(
            "the left picture is {}x{} and the right one {}x{}: a rectified pair is of one size",
            self.width, self.height, other.width, other.height
        );
        Err(UsageError(text).into())
    }
}

/// Whether it has more than 8 bits.
fn wide(picture: &DynamicImage) -> bool {
    matches!(picture.color(), ColorType::L16 | ColorType::La16 | ColorType::Rgb16 | ColorType::Rgba16)
}

/// The largest grey value of one of 16 bits, else 0. It is of the same luma as the pixels: a larger one would not fit in 8 bits.
fn most(picture: &DynamicImage) -> u32 {
    if !wide(picture) {
        return 0;
    }
    picture.to_rgb16().pixels().map(|p| luma(p.0.map(u32::from))).max().unwrap_or(0)
}

/// What was done.
#[derive(Debug, Serialize)]
struct Report<'a> {
    out: &'a Path,
    width: usize,
    height: usize,
    producer: String,
    parameters: String,
    vectors: &'static str,
    memory_bytes: u64,
    /// Pixels that have a disparity, percent.
    filled_percent: f64,
    /// How far the rows of the two are apart, where the pictures say it.
    rows: Option<Rows>,
    /// The right picture's rows were moved by that.
    rows_corrected: bool,
    warnings: Vec<String>,
    /// CPU time of the calling thread, for the first pair of a matcher; `bench stereo` measures properly.
    cpu_ms: f64,
}

/// How much lower things lie in the right picture, pixels. Each may be off by `unsure_px`.
#[derive(Debug, Serialize)]
struct Rows {
    middle_px: f64,
    /// From the left side to the right one.
    across_px: f64,
    /// From top to bottom.
    down_px: f64,
    unsure_px: [f64; 3],
    places: usize,
}

impl Rows {
    const fn of(offset: &RowOffset) -> Self {
        let RowOffset { middle_px, across_px, down_px, unsure_px, places, .. } = *offset;
        Self { middle_px, across_px, down_px, unsure_px, places }
    }
}

/// Matches a pair.
pub fn run(args: &StereoArgs) -> Result<Exit> {
    let as_png = form(&args.out)?;
    let inputs = [args.left.as_path(), args.right.as_path()];
    let out = OutFile::new(&args.out, args.overwrite, &inputs)?;
    let confidence = args.confidence.as_deref().map(|path| OutFile::new(path, args.overwrite, &inputs));
    let confidence = confidence.transpose()?;
    confidence.as_ref().map_or(Ok(()), |confidence| confidence.differs_from(&out))?;
    let [left, right] = Picture::pair(&args.left, &args.right)?;
    left.fits(&right)?;
    let pair = StereoPair::new(left.gray(), right.gray());
    let usage = |e: depthrig_calib::Error| UsageError(e.to_string());
    if !args.even_if_swapped {
        let mut order = OrderCheck::new(left.width, left.height).map_err(usage)?;
        order.refuse_swapped(&pair).map_err(usage)?;
    }
    let mut rows = RowCheck::new(left.width, left.height);
    rows.look(&pair).map_err(usage)?;
    let offset = rows.offset();
    let mut moved = Vec::new();
    let corrected = offset.as_ref().filter(|o| o.is_significant() && !args.keep_rows);
    if let Some(offset) = corrected {
        let size = (left.width as u32, left.height as u32);
        RowCorrector::new(size, offset).map_err(usage)?.correct(&right.gray(), &mut moved)?;
    }
    let is_corrected = corrected.is_some();
    let pair = if is_corrected {
        StereoPair::new(left.gray(), Gray::packed(&moved, left.width, left.height))
    } else {
        pair
    };
    let parameters = Parameters::preset(args.preset, args.max_disparity.into());
    let mut matcher =
        SgmMatcher::new(left.width, left.height, &parameters, args.threads.into()).map_err(usage)?;
    let mut map = DisparityMap::default();
    let start = thread_cpu_ns();
    matcher.run(&pair, &mut map)?;
    let cpu_ms = (thread_cpu_ns() - start) as f64 / 1e6;
    out.write(&if as_png { png(&map)? } else { npy(&map) })?;
    if let Some(confidence) = confidence {
        confidence.write(&encoded(&map.confidence, &map, ExtendedColorType::L8)?)?;
    }
    let described = matcher.describe();
    let report = Report {
        out: &args.out,
        width: map.width,
        height: map.height,
        producer: described.producer,
        parameters: match &corrected {
            Some(offset) => format!("{} {}", described.parameters, offset.describe_correction()),
            None => described.parameters,
        },
        vectors: matcher.form(),
        memory_bytes: described.memory_bytes,
        filled_percent: 100.0 * map.fill(),
        rows: offset.as_ref().map(Rows::of),
        rows_corrected: is_corrected,
        warnings: offset.and_then(|o| o.warning(is_corrected)).into_iter().collect(),
        cpu_ms,
    };
    for warning in &report.warnings {
        out::note(format_args!("warning: {}, {}: {warning}", args.left.display(), args.right.display()));
    }
    if args.json {
        out::json(&report)?;
    } else {
        out::line(format_args!(
            "{}: {}x{}, {} of {} disparities, in {:.1} % of the pixels; {:.0} ms, {} of memory",
            report.out.display(),
            report.width,
            report.height,
            args.preset,
            args.max_disparity,
            report.filled_percent,
            report.cpu_ms,
            out::bytes(report.memory_bytes)
        ))?;
    }
    Ok(Exit::Good)
}

/// Whether a PNG is asked for.
fn form(path: &Path) -> Result<bool> {
    match path.extension().and_then(|e| e.to_str()).unwrap_or_default().to_ascii_lowercase().as_str() {
        "npy" => Ok(false),
        "png" => Ok(true),
        _ => Err(UsageError(format!("{}: the result is a .npy or a .png", path.display())).into()),
    }
}

fn npy(map: &DisparityMap) -> Vec<u8> {
    let data: Vec<_> = map.disparity.iter().flat_map(|d| d.to_le_bytes()).collect();
    depthrig_recorder::npy_file("<f4", &[map.height, map.width], &data)
}

/// 16 bits, 256 a pixel; a disparity of less than half of that becomes the smallest one, for 0 is none.
fn png(map: &DisparityMap) -> Result<Vec<u8>> {
    let units =
        map.disparity.iter().map(|d| if d.is_nan() { 0 } else { ((d * 256.0).round() as u16).max(1) });
    // PNG is big-endian; the encoder takes the order of this computer.
    let data: Vec<_> = units.flat_map(u16::to_ne_bytes).collect();
    encoded(&data, map, ExtendedColorType::L16)
}

fn encoded(data: &[u8], map: &DisparityMap, color: ExtendedColorType) -> Result<Vec<u8>> {
    let mut file = Vec::new();
    png::PngEncoder::new(&mut file).write_image(data, map.width as u32, map.height as u32, color)?;
    Ok(file)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The pixels that two files of this picture are read as.
    fn read(picture: &DynamicImage) -> Vec<u8> {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("p.png");
        picture.save(&path).unwrap();
        let [left, right] = Picture::pair(&path, &path).unwrap();
        assert_eq!(left.pixels, right.pixels);
        left.pixels
    }

    #[test]
    fn colour_becomes_the_grey_of_rec_709() {
        let colours = [[255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 255], [200, 100, 50], [77, 77, 77]];
        let picture = image::RgbImage::from_fn(6, 1, |x, _| image::Rgb(colours[x as usize]));
        assert_eq!(read(&picture.into()), [54, 182, 18, 255, 117, 77]);
    }

    /// A brightest of 255 takes 8 bits, whatever another formula rounds it to.
    #[test]
    fn the_brightest_of_16_bits_is_that_of_the_same_grey() {
        let of = |pixel: [u16; 3]| {
            read(&DynamicImage::ImageRgb16(image::ImageBuffer::from_pixel(2, 1, image::Rgb(pixel))))
        };
        assert_eq!(of([256, 256, 254]), [255; 2]); // 255.86
        assert_eq!(of([256; 3]), [128; 2]);
        assert_eq!(of([u16::MAX; 3]), [255; 2]);
    }
}
