//! `depthrig stereo`: computes the disparity of a rectified image pair.

use crate::exit::{Exit, UsageError};
use crate::outfile::{OutFile, Overwrite};
use crate::{image_file, out};
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
The images must be rectified: a point at (x, y) in the left image is at (x - disparity, y) in the right image. Colour is
converted to grey; of 16-bit images the 8 bits below the highest bit used by either are taken.

OUT.npy holds 32-bit floats: disparity in pixels of the left image, NaN where unknown. OUT.png holds 16 bits: disparity
times 256, 0 where unknown (as in KITTI). Confidence is an 8-bit PNG: 0 where disparity is unknown, up to 255.

Exit codes: 0 success, 1 failure, 2 wrong usage, or mismatched or swapped images.

Examples:
  depthrig stereo left.png right.png --out disparity.npy
  depthrig stereo left.jpg right.jpg --preset ultra --max-disparity 224 --out disparity.png --confidence sure.png";

/// Arguments.
#[derive(Debug, clap::Args)]
pub struct StereoArgs {
    /// Left image: PNG, JPEG, PGM or PPM
    left: PathBuf,
    /// Right image, of the same size
    right: PathBuf,
    /// Trade-off of speed and quality: performance, quality or ultra
    #[arg(long, value_name = "PRESET", default_value = "quality", value_parser = preset)]
    preset: Preset,
    /// Disparity search range, pixels; nearer objects get no disparity
    #[arg(long, value_name = "N", default_value_t = 128, value_parser = clap::value_parser!(u16).range(1..=256))]
    max_disparity: u16,
    /// Output file, .npy or .png
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// Confidence image to write, a PNG
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
    /// Do not correct a measured row offset between the images
    #[arg(long)]
    keep_rows: bool,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// Parses the name of a preset.
///
/// # Errors
/// When the name is unknown.
pub fn preset(text: &str) -> Result<Preset, String> {
    text.parse().map_err(|e: depthrig_calib::Error| e.to_string())
}

/// Rec. 709 luma. The crate `image` converts colour to grey differently from version to version; depth must not change.
pub const fn luma([r, g, b]: [u32; 3]) -> u32 {
    (2126 * r + 7152 * g + 722 * b) / 10_000
}

/// An owned grey image.
pub struct Image {
    pixels: Vec<u8>,
    width: usize,
    height: usize,
}

impl Image {
    /// Reads a pair of PNG, JPEG, PGM or PPM. Of 16 bits, takes the 8 that begin with the highest bit used by either
    /// image: a camera's 10 or 12 bits are mostly stored in the lower ones.
    ///
    /// # Errors
    /// When an image cannot be read.
    pub fn pair(left: &Path, right: &Path) -> Result<[Self; 2]> {
        let images = [image_file::open(left)?, image_file::open(right)?];
        if images.iter().all(|p| !wide(p)) {
            return Ok(images.map(|p| {
                let width = p.width() as usize;
                let height = p.height() as usize;
                let pixels = match p {
                    DynamicImage::ImageLuma8(p) => p.into_raw(),
                    p => p.into_rgb8().pixels().map(|p| luma(p.0.map(u32::from)) as u8).collect(),
                };
                Self { pixels, width, height }
            }));
        }
        let most = images.iter().map(most).max().unwrap_or(0);
        let shift = (u32::BITS - most.leading_zeros()).saturating_sub(u8::BITS);
        Ok(images.map(|p| {
            let width = p.width() as usize;
            let height = p.height() as usize;
            // An 8-bit image has been spread to 16.
            let shift = if wide(&p) { shift } else { u8::BITS };
            let pixels = p.into_rgb16().pixels().map(|p| (luma(p.0.map(u32::from)) >> shift) as u8).collect();
            Self { pixels, width, height }
        }))
    }

    /// Makes an image of these pixels, rows without padding.
    pub const fn new(pixels: Vec<u8>, width: usize, height: usize) -> Self {
        Self { pixels, width, height }
    }

    /// Borrows the image as the engine's type.
    pub fn gray(&self) -> Gray<'_> {
        Gray::packed(&self.pixels, self.width, self.height)
    }

    /// Checks that both images have the same size.
    ///
    /// # Errors
    /// A usage error that names both sizes.
    pub fn fits(&self, other: &Self) -> Result<()> {
        if (self.width, self.height) == (other.width, other.height) {
            return Ok(());
        }
        let text = format!(
            "the left image is {}x{} and the right one {}x{}: a rectified pair is of one size",
            self.width, self.height, other.width, other.height
        );
        Err(UsageError(text).into())
    }
}

/// Returns whether the image has more than 8 bits.
fn wide(image: &DynamicImage) -> bool {
    matches!(image.color(), ColorType::L16 | ColorType::La16 | ColorType::Rgb16 | ColorType::Rgba16)
}

/// Largest grey value of a 16-bit image, else 0. It uses the same luma as the pixels: a larger one would not fit in 8
/// bits.
fn most(image: &DynamicImage) -> u32 {
    if !wide(image) {
        return 0;
    }
    image.to_rgb16().pixels().map(|p| luma(p.0.map(u32::from))).max().unwrap_or(0)
}

/// Result of the command, as JSON.
#[derive(Debug, Serialize)]
struct Report<'a> {
    out: &'a Path,
    width: usize,
    height: usize,
    producer: String,
    parameters: String,
    vectors: &'static str,
    memory_bytes: u64,
    /// Pixels with a disparity, percent.
    filled_percent: f64,
    /// Row offset between the images, if it could be measured.
    rows: Option<Rows>,
    /// Whether the right image was shifted by that offset.
    rows_corrected: bool,
    warnings: Vec<String>,
    /// CPU time of the calling thread for a matcher's first pair; `bench stereo` measures properly.
    cpu_ms: f64,
}

/// Downward offset of the right image, pixels. Each value has the uncertainty `unsure_px`.
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
    let [left, right] = Image::pair(&args.left, &args.right)?;
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
        RowCorrector::new(size.0, size.1, offset).map_err(usage)?.correct(&right.gray(), &mut moved)?;
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

/// Returns whether the output is a PNG.
fn form(path: &Path) -> Result<bool> {
    match path.extension().and_then(|e| e.to_str()).unwrap_or_default().to_ascii_lowercase().as_str() {
        "npy" => Ok(false),
        "png" => Ok(true),
        _ => Err(UsageError(format!("{}: unsupported extension; use .npy or .png", path.display())).into()),
    }
}

fn npy(map: &DisparityMap) -> Vec<u8> {
    let data: Vec<_> = map.disparity.iter().flat_map(|d| d.to_le_bytes()).collect();
    depthrig_recorder::npy::file("<f4", &[map.height, map.width], &data)
}

/// Encodes disparity times 256 as 16 bits; a disparity that rounds to 0 becomes 1, because 0 means unknown.
fn png(map: &DisparityMap) -> Result<Vec<u8>> {
    let units =
        map.disparity.iter().map(|d| if d.is_nan() { 0 } else { ((d * 256.0).round() as u16).max(1) });
    // PNG is big-endian; the encoder takes native order.
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

    /// The pixels that two files of this image are read as.
    fn read(image: &DynamicImage) -> Vec<u8> {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("p.png");
        image.save(&path).unwrap();
        let [left, right] = Image::pair(&path, &path).unwrap();
        assert_eq!(left.pixels, right.pixels);
        left.pixels
    }

    #[test]
    fn colour_becomes_the_grey_of_rec_709() {
        let colours = [[255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 255], [200, 100, 50], [77, 77, 77]];
        let image = image::RgbImage::from_fn(6, 1, |x, _| image::Rgb(colours[x as usize]));
        assert_eq!(read(&image.into()), [54, 182, 18, 255, 117, 77]);
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
