//! A frame as image files: colour as it is, depth as 16-bit PNG and as a preview in colours.

use crate::outfile::{OutFile, Overwrite};
use crate::turbo::depth_color;
use anyhow::{Context, Result, bail};
use depthrig_bus::{FrameHeader, Layout, Sample, files};
use depthrig_jpeg::{Form, Image};
use image::{
    DynamicImage, ExtendedColorType, GrayImage, ImageEncoder, ImageFormat, ImageReader, RgbImage, codecs::png,
};
use std::io::Cursor;
use std::path::{Path, PathBuf};

/// Share of the depths of an image that get the colours of the ends of the map.
const TAIL: f64 = 0.02;

/// The image in a file: PNG, JPEG, PGM or PPM, by its first bytes.
///
/// # Errors
/// When it cannot be read, or is damaged or of another kind; the message names it.
pub fn open(path: &Path) -> Result<DynamicImage> {
    let unreadable = || format!("{}: cannot be read as an image; PNG, JPEG, PGM and PPM can", path.display());
    let bytes = files::read(path, files::IMAGE_MAX_BYTES)
        .with_context(|| format!("{}: cannot be read", path.display()))?;
    if bytes.starts_with(&depthrig_jpeg::START) {
        return jpeg(&bytes).with_context(unreadable);
    }
    let reader = ImageReader::new(Cursor::new(bytes)).with_guessed_format().with_context(unreadable)?;
    reader.decode().with_context(unreadable)
}

/// An image as a PNG file.
///
/// # Errors
/// When it cannot be encoded.
pub fn png(image: &RgbImage) -> Result<Vec<u8>> {
    let mut file = Cursor::new(Vec::new());
    image.write_to(&mut file, ImageFormat::Png)?;
    Ok(file.into_inner())
}

/// A JPEG's pixels, those that libjpeg gives.
fn jpeg(bytes: &[u8]) -> Result<DynamicImage> {
    let Image { info, pixels } = depthrig_jpeg::decode(bytes)?;
    let image = match info.form {
        Form::Grey => GrayImage::from_raw(info.width, info.height, pixels).map(DynamicImage::from),
        Form::Rgb => RgbImage::from_raw(info.width, info.height, pixels).map(DynamicImage::from),
    };
    image.context("the image is smaller than it says")
}

/// The rows of a frame without padding between them.
fn rows<'a>(header: &FrameHeader, pixels: &'a [u8]) -> Result<impl Iterator<Item = &'a [u8]>> {
    let format = header.pixel_format().context("the frame's pixel format is unknown to this version")?;
    let row = format.row_bytes(header.width) as usize;
    let stride = header.stride as usize;
    let height = header.height as usize;
    if row == 0 || stride < row || pixels.len() < stride * height.saturating_sub(1) + row {
        bail!(
            "a {}x{} {} frame with a stride of {stride} cannot have {} bytes",
            header.width,
            header.height,
            format.name(),
            pixels.len()
        );
    }
    Ok((0..height).map(move |y| &pixels[y * stride..y * stride + row]))
}

/// Converts a frame to depth in metres, row by row; 0 where depth is missing. `None` when the frame is not a depth
/// frame.
pub fn depth_m(header: &FrameHeader, pixels: &[u8]) -> Result<Option<Vec<f32>>> {
    let unit = header.depth_unit_m as f32;
    let Some(format) = header.pixel_format().filter(|f| f.is_depth()) else { return Ok(None) };
    let read: fn(&[u8], f32) -> Vec<f32> = match format.sample() {
        Sample::U8 => |row, unit| row.iter().map(|v| f32::from(*v) * unit).collect(),
        Sample::U16 => |row, unit| {
            row.chunks_exact(2).map(|b| f32::from(u16::from_le_bytes([b[0], b[1]])) * unit).collect()
        },
        Sample::F32 => {
            |row, _| row.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect()
        }
    };
    Ok(Some(rows(header, pixels)?.flat_map(|row| read(row, unit)).collect()))
}

/// The range of colours that shows most of an image: from one end of its depths to the other, without the tails.
pub fn depth_range(depth: &[f32]) -> (f32, f32) {
    let mut some: Vec<f32> = depth.iter().copied().filter(|z| z.is_finite() && *z > 0.0).step_by(7).collect();
    some.sort_unstable_by(f32::total_cmp);
    let at = |share| crate::bench::stats::quantile(&some, share).unwrap_or(1.0);
    let near = at(TAIL);
    (near, at(1.0 - TAIL).max(near * 1.01))
}

/// The frame as a person sees it: colour as it is, depth in colours, 16-bit grey stretched.
pub fn to_rgb(header: &FrameHeader, pixels: &[u8]) -> Result<RgbImage> {
    if let Some(depth) = depth_m(header, pixels)? {
        let (near, far) = depth_range(&depth);
        let data = depth.iter().flat_map(|z| depth_color(*z, near, far)).collect();
        return image_of(header, data);
    }
    let format = header.pixel_format().context("the frame's pixel format is unknown to this version")?;
    let data = match (format.layout(), format.sample()) {
        (Layout::Jpeg, _) => {
            return Ok(jpeg(pixels).context("the frame's JPEG cannot be decoded")?.into_rgb8());
        }
        (Layout::Rgb, _) => rows(header, pixels)?.flatten().copied().collect(),
        (Layout::Bgr, _) => {
            rows(header, pixels)?.flat_map(|r| r.chunks_exact(3).flat_map(|p| [p[2], p[1], p[0]])).collect()
        }
        (Layout::Grey, Sample::U8) => rows(header, pixels)?.flatten().flat_map(|v| [*v; 3]).collect(),
        (Layout::Grey, Sample::U16) => stretched(rows(header, pixels)?),
        (Layout::Grey, Sample::F32) => disparity_colors(rows(header, pixels)?),
        (Layout::Motion, _) => bail!(
            "{}/{} gives motion samples and no images; depthrig tap prints them",
            header.camera(),
            header.stream()
        ),
        (Layout::Yuyv | Layout::Uyvy | Layout::Nv12, _) => {
            bail!("{} frames cannot be shown yet", format.name())
        }
    };
    image_of(header, data)
}

/// 16-bit grey with its brightest pixel at white.
fn stretched<'a>(rows: impl Iterator<Item = &'a [u8]>) -> Vec<u8> {
    let values: Vec<u32> =
        rows.flat_map(|r| r.chunks_exact(2).map(|b| u32::from(u16::from_le_bytes([b[0], b[1]])))).collect();
    let most = values.iter().copied().max().unwrap_or(0).max(1);
    values.iter().flat_map(|v| [(v * 255 / most) as u8; 3]).collect()
}

/// Disparity in the colours of depth: the greatest is the nearest, no match is black.
fn disparity_colors<'a>(rows: impl Iterator<Item = &'a [u8]>) -> Vec<u8> {
    let inverse = |b: &[u8; 4]| f32::from_le_bytes(*b).recip();
    let depths: Vec<f32> = rows.flat_map(|r| r.as_chunks().0.iter().map(inverse)).collect();
    let (near, far) = depth_range(&depths);
    depths.iter().flat_map(|z| depth_color(*z, near, far)).collect()
}

fn image_of(header: &FrameHeader, data: Vec<u8>) -> Result<RgbImage> {
    RgbImage::from_raw(header.width, header.height, data).context("the frame is smaller than it says")
}

/// Writes the frame into `folder` as PNG files named after `stem`; returns their paths. Depth and 16-bit grey
/// keep every bit; depth gets a preview beside it.
///
/// # Errors
/// When the frame is not what its header says, its format cannot be shown, or a file cannot be written.
pub fn write_png(
    header: &FrameHeader,
    pixels: &[u8],
    folder: &Path,
    stem: &str,
    overwrite: Overwrite,
) -> Result<Vec<PathBuf>> {
    let mut written = Vec::new();
    let mut write = |name: String, data: &[u8], color: ExtendedColorType| -> Result<()> {
        let path = folder.join(name);
        let mut file = Vec::new();
        // Images of a live stream: the fastest compression that still compresses.
        let encoder =
            png::PngEncoder::new_with_quality(&mut file, png::CompressionType::Fast, png::FilterType::Sub);
        encoder
            .write_image(data, header.width, header.height, color)
            .with_context(|| format!("{}: cannot be written", path.display()))?;
        OutFile::new(&path, overwrite, &[])?.write(&file)?;
        written.push(path);
        Ok(())
    };
    let format = header.pixel_format().context("the frame's pixel format is unknown to this version")?;
    let is_depth = format.is_depth();
    let has_16_bits = format.sample() == Sample::U16;
    if has_16_bits {
        let native: Vec<u8> = rows(header, pixels)?
            .flat_map(|r| r.chunks_exact(2).flat_map(|b| u16::from_le_bytes([b[0], b[1]]).to_ne_bytes()))
            .collect();
        write(format!("{stem}.png"), &native, ExtendedColorType::L16)?;
    }
    if is_depth || !has_16_bits {
        let name = if is_depth { format!("{stem}_preview.png") } else { format!("{stem}.png") };
        write(name, to_rgb(header, pixels)?.as_raw(), ExtendedColorType::Rgb8)?;
    }
    Ok(written)
}

#[cfg(test)]
mod tests {
    use super::*;
    use depthrig_bus::PixelFormat;

    fn header(format: PixelFormat, width: u32, height: u32) -> FrameHeader {
        let mut h = FrameHeader::default();
        h.set_image(format, width, height);
        h.depth_unit_m = 0.0001;
        h
    }

    #[test]
    fn depth_survives_the_png_bit_by_bit() {
        let folder = tempfile::tempdir().unwrap();
        let values: Vec<u16> = (0..12).map(|i| i * 5461).collect();
        let pixels: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
        let written = write_png(
            &header(PixelFormat::Z16, 4, 3),
            &pixels,
            folder.path(),
            "d",
            Overwrite { overwrite: false },
        )
        .unwrap();
        assert_eq!(written, [folder.path().join("d.png"), folder.path().join("d_preview.png")]);
        let read = image::open(&written[0]).unwrap();
        assert_eq!(read.as_luma16().unwrap().as_raw(), &values);
        let preview = image::open(&written[1]).unwrap().into_rgb8();
        assert_eq!(preview.get_pixel(0, 0).0, [0; 3]); // no depth
        assert_eq!(preview.get_pixel(1, 0).0, crate::turbo::turbo(1.0)); // nearest
    }

    #[test]
    fn row_padding_is_left_out_and_a_short_frame_is_refused() {
        let mut h = header(PixelFormat::Bgr8, 1, 2);
        h.stride = 5;
        let image = to_rgb(&h, &[1, 2, 3, 99, 99, 4, 5, 6]).unwrap();
        assert_eq!(image.as_raw(), &[3, 2, 1, 6, 5, 4]);
        let e = to_rgb(&h, &[0; 7]).unwrap_err().to_string();
        assert!(e.contains("1x2 bgr8 frame"), "{e}");
    }

    #[test]
    fn the_greatest_disparity_is_the_nearest() {
        let values = [f32::NAN, 20.0, 10.0, 5.0];
        let pixels: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
        let image = to_rgb(&header(PixelFormat::DisparityF32, 4, 1), &pixels).unwrap();
        assert_eq!(image.get_pixel(0, 0).0, [0; 3]);
        assert_eq!(image.get_pixel(1, 0).0, crate::turbo::turbo(1.0));
        assert_eq!(image.get_pixel(3, 0).0, crate::turbo::turbo(0.0));
    }

    #[test]
    fn depth_is_in_metres_whatever_its_unit() {
        let z16 = depth_m(&header(PixelFormat::Z16, 1, 1), &5000u16.to_le_bytes()).unwrap().unwrap();
        assert!((z16[0] - 0.5).abs() < 1e-6);
        assert_eq!(depth_m(&header(PixelFormat::Rgb8, 1, 1), &[0; 3]).unwrap(), None);
    }
}
