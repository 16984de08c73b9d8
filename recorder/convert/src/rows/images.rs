//! Pixels of a row's images, as every layout for training has them.

use depthrig_bus::{FrameHeader, Layout, PixelFormat, Sample};
use depthrig_recorder::{DatasetFrame, Error, ErrorKind, Result, jpeg_pixels, still};

/// Form of a stream's images in an export.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Form {
    /// Red, green, blue, 8 bits each.
    Color,
    /// 8 bits.
    Grey8,
    /// 16 bits.
    Grey16,
    /// 16 bits, in the camera's unit.
    Depth16,
    /// 32-bit floats, metres.
    DepthF32,
}

impl Form {
    /// The form for a pixel format; `None` for one that no layout has.
    pub(crate) const fn of(format: PixelFormat) -> Option<Self> {
        Some(match (format.layout(), format.sample(), format.is_depth()) {
            (Layout::Rgb | Layout::Bgr | Layout::Jpeg, ..) => Self::Color,
            (Layout::Grey, Sample::U8, false) => Self::Grey8,
            (Layout::Grey, Sample::U16, false) => Self::Grey16,
            (Layout::Grey, Sample::U16, true) => Self::Depth16,
            (Layout::Grey, Sample::F32, true) => Self::DepthF32,
            _ => return None,
        })
    }

    /// Colour channels of an image.
    pub(crate) const fn channels(self) -> usize {
        match self {
            Self::Color => 3,
            _ => 1,
        }
    }

    /// Whether it is depth.
    pub(crate) const fn is_depth(self) -> bool {
        matches!(self, Self::Depth16 | Self::DepthF32)
    }
}

/// The error of a frame that cannot be exported.
pub(crate) fn wrong(h: &FrameHeader, what: impl core::fmt::Display) -> Error {
    Error::new(ErrorKind::Codec, format!("frame {} of {}/{} {what}", h.sequence, h.camera(), h.stream()))
}

/// The pixels of a frame that was read as it is stored, without padding; colour as red, green, blue.
pub(crate) fn pixels(form: Form, frame: &DatasetFrame) -> Result<Vec<u8>> {
    let h = &frame.header;
    if form == Form::Color && matches!(frame.codec, "jpeg" | "mjpeg") {
        return jpeg_pixels(&frame.pixels, h);
    }
    let format = format_of(form, h)?;
    let decoded = frame.decoded()?;
    let mut pixels = still::tight(h, &decoded, format).into_owned();
    if pixels.len() != format.frame_bytes(h.width, h.height) {
        return Err(wrong(h, format_args!("has {} bytes, not as many as its size says", pixels.len())));
    }
    if format == PixelFormat::Bgr8 {
        pixels.as_chunks_mut::<3>().0.iter_mut().for_each(|p| p.swap(0, 2));
    }
    Ok(pixels)
}

/// The pixel format of a frame, which its form must be for.
pub(crate) fn format_of(form: Form, h: &FrameHeader) -> Result<PixelFormat> {
    let format = h.pixel_format().filter(|f| Form::of(*f) == Some(form));
    format.ok_or_else(|| wrong(h, "has another pixel format than its session says"))
}
