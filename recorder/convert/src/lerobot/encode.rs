//! Images as LeRobot reads them: a JPEG as it was stored, other colour and grey as PNG, depth as TIFF.

use super::stats::Samples;
use crate::rows::images::{Form, format_of, wrong};
use depthrig_bus::{FrameHeader, PixelFormat};
use depthrig_recorder::jpeg_pixels;
use depthrig_recorder::still::{self, StillFormat};
use depthrig_recorder::{DatasetFrame, Result};
use std::io::Cursor;
use tiff::encoder::{TiffEncoder, colortype};

/// An encoded image.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Image {
    pub(super) bytes: Vec<u8>,
    /// Kind of file: `jpg`, `png` or `tiff`.
    pub(super) extension: &'static str,
}

/// Encodes a frame that was read as it is stored; `sample` asks for its pixels' values as well.
pub(super) fn encode(form: Form, frame: &DatasetFrame, sample: bool) -> Result<(Image, Option<Samples>)> {
    let h = &frame.header;
    if form == Form::Color && matches!(frame.codec, "jpeg" | "mjpeg") {
        let image = Image { bytes: frame.pixels.clone(), extension: "jpg" };
        let pixels = if sample { Some(jpeg_pixels(&frame.pixels, h)?) } else { None };
        return Ok((image, pixels.map(|p| thinned(form, h, PixelFormat::Rgb8, &p))));
    }
    let format = format_of(form, h)?;
    let decoded = frame.decoded()?;
    let pixels = still::tight(h, &decoded, format);
    let image = lossless(form, h, format, &pixels)?;
    Ok((image, sample.then(|| thinned(form, h, format, &pixels))))
}

/// An image of zeros: black, no depth. It stands where a camera delivered nothing.
pub(super) fn blank(form: Form, width: u32, height: u32) -> Result<Image> {
    let format = match form {
        Form::Color => PixelFormat::Rgb8,
        Form::Grey8 => PixelFormat::Mono8,
        Form::Grey16 => PixelFormat::Mono16,
        Form::Depth16 => PixelFormat::Z16,
        Form::DepthF32 => PixelFormat::DepthF32,
    };
    let mut h = FrameHeader::default();
    h.set_image(format, width, height);
    lossless(form, &h, format, &vec![0; format.frame_bytes(width, height)])
}

/// The file of an image whose rows follow each other without padding.
fn lossless(form: Form, h: &FrameHeader, format: PixelFormat, pixels: &[u8]) -> Result<Image> {
    if !form.is_depth() {
        return Ok(Image { bytes: still::encode(h, format, pixels, StillFormat::Png)?, extension: "png" });
    }
    if pixels.len() != format.frame_bytes(h.width, h.height) {
        return Err(wrong(h, format_args!("has {} bytes, not as many as its size says", pixels.len())));
    }
    let mut bytes = Vec::with_capacity(pixels.len() + 1024);
    let sink = Cursor::new(&mut bytes);
    let written = TiffEncoder::new(sink).and_then(|mut tiff| match form {
        Form::DepthF32 => tiff.write_image::<colortype::Gray32Float>(h.width, h.height, &f32s(pixels)),
        _ => tiff.write_image::<colortype::Gray16>(h.width, h.height, &u16s(pixels)),
    });
    written.map_err(|e| wrong(h, "cannot be made a TIFF").with_source(e))?;
    Ok(Image { bytes, extension: "tiff" })
}

fn u16s(bytes: &[u8]) -> Vec<u16> {
    bytes.as_chunks().0.iter().map(|b| u16::from_le_bytes(*b)).collect()
}

fn f32s(bytes: &[u8]) -> Vec<f32> {
    bytes.as_chunks().0.iter().map(|b| f32::from_le_bytes(*b)).collect()
}

/// The values of every n-th pixel in both directions, for the statistics.
fn thinned(form: Form, h: &FrameHeader, format: PixelFormat, pixels: &[u8]) -> Samples {
    let step = downsampling(h.width, h.height);
    let row = format.row_bytes(h.width).max(1) as usize;
    let pixel = row / h.width.max(1) as usize;
    let rows = pixels.chunks_exact(row).step_by(step);
    let values = rows.flat_map(|r| r.chunks_exact(pixel.max(1)).step_by(step).flatten().copied());
    let mut bytes: Vec<u8> = values.collect();
    if format == PixelFormat::Bgr8 {
        bytes.as_chunks_mut::<3>().0.iter_mut().for_each(|p| p.swap(0, 2));
    }
    match form {
        Form::Color | Form::Grey8 => Samples::U8(bytes),
        Form::Grey16 | Form::Depth16 => Samples::U16(u16s(&bytes)),
        Form::DepthF32 => Samples::F32(f32s(&bytes)),
    }
}

/// LeRobot's rule (`auto_downsample_height_width` in its `compute_stats.py`): images of 300 pixels and more are
/// thinned to about 150.
fn downsampling(width: u32, height: u32) -> usize {
    if width.max(height) < 300 {
        return 1;
    }
    (if width > height { width } else { height } / 150) as usize
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn thinning_follows_lerobot() {
        assert_eq!(downsampling(299, 200), 1);
        assert_eq!(downsampling(300, 200), 2);
        assert_eq!(downsampling(1280, 720), 8);
        assert_eq!(downsampling(480, 640), 4);
    }
}
