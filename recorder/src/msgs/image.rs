//! `sensor_msgs` images and camera information.

use crate::cdr::{Reader, Writer};
use crate::codec::DepthShape;
use crate::{Error, ErrorKind, Result};
use depthrig_bus::{Distortion, FrameHeader, Layout, PixelFormat};

/// Bytes that are enough for an `Image`, or for a `CompressedImage` of these bytes.
pub(crate) const fn room(frame_id: &str, pixels: &[u8]) -> usize {
    // A stamp, six numbers of 32 bits, two strings' ends and the encoding's name are far below.
    128 + frame_id.len() + pixels.len()
}

pub(crate) fn write_image(
    buf: &mut Vec<u8>,
    stamp_utc_ns: i64,
    frame_id: &str,
    h: &FrameHeader,
    encoding: &str,
    pixels: &[u8],
) {
    buf.reserve(room(frame_id, pixels));
    write_image_head(buf, stamp_utc_ns, frame_id, h, encoding, pixels.len() as u32);
    buf.extend_from_slice(pixels);
}

/// An `Image` up to its pixels, which are so many bytes.
pub(crate) fn write_image_head(
    buf: &mut Vec<u8>,
    stamp_utc_ns: i64,
    frame_id: &str,
    h: &FrameHeader,
    encoding: &str,
    bytes: u32,
) {
    let mut w = Writer::new(buf);
    w.header(stamp_utc_ns, frame_id).u32(h.height).u32(h.width).str(encoding).u8(0).u32(h.stride).u32(bytes);
}

/// The pixels of an `Image`.
pub(crate) fn read_image(message: &[u8]) -> Result<&[u8]> {
    let mut r = Reader::new(message)?;
    r.time()?;
    r.str()?;
    r.u32()?;
    r.u32()?;
    r.str()?;
    r.u8()?;
    r.u32()?;
    r.bytes()
}

/// The image file in a `CompressedImage`.
pub(crate) fn read_compressed(message: &[u8]) -> Result<&[u8]> {
    let mut r = Reader::new(message)?;
    r.time()?;
    r.str()?;
    r.str()?;
    r.bytes()
}

/// Shape, codec and data of a `CompressedDepth`.
pub(crate) fn read_compressed_depth(message: &[u8]) -> Result<(DepthShape, &str, &[u8])> {
    let mut r = Reader::new(message)?;
    r.time()?;
    r.str()?;
    // Fields in the order of the bytes.
    let height = r.u32()?;
    let width = r.u32()?;
    let step = r.u32()?;
    Ok((DepthShape { width, height, step }, r.str()?, r.bytes()?))
}

/// Appends a `CompressedDepth` whose data `fill` writes.
pub(crate) fn write_compressed_depth(
    buf: &mut Vec<u8>,
    stamp_utc_ns: i64,
    frame_id: &str,
    shape: DepthShape,
    codec: &str,
    fill: impl FnOnce(&mut Vec<u8>) -> Result<()>,
) -> Result<()> {
    let mut w = Writer::new(buf);
    w.header(stamp_utc_ns, frame_id).u32(shape.height).u32(shape.width).u32(shape.step).str(codec);
    w.bytes_with(fill).map(drop)
}

/// Appends a `CompressedImage` whose image file, of this format, `fill` writes.
pub(crate) fn write_compressed(
    buf: &mut Vec<u8>,
    stamp_utc_ns: i64,
    frame_id: &str,
    format: &str,
    fill: impl FnOnce(&mut Vec<u8>) -> Result<()>,
) -> Result<()> {
    Writer::new(buf).header(stamp_utc_ns, frame_id).str(format).bytes_with(fill).map(drop)
}

pub(crate) fn write_camera_info(buf: &mut Vec<u8>, stamp_utc_ns: i64, frame_id: &str, h: &FrameHeader) {
    let i = &h.intrinsics;
    let (model, n) = match i.distortion() {
        Distortion::Unknown => ("", 0),
        Distortion::KannalaBrandt4 => ("equidistant", 4),
        Distortion::Rational => ("rational_polynomial", 8),
        // No viewer knows the inverse model; where it distorts nothing it is the plain one.
        Distortion::InverseBrownConrady if i.coeffs.iter().any(|c| *c != 0.0) => ("inverse_brown_conrady", 5),
        _ => ("plumb_bob", 5),
    };
    let mut w = Writer::new(buf);
    w.header(stamp_utc_ns, frame_id).u32(h.height).u32(h.width).str(model).u32(n as u32);
    w.f64s(&i.coeffs[..n]);
    let one = f64::from(u8::from(i.is_known()));
    w.f64s(&[i.fx, 0.0, i.cx, 0.0, i.fy, i.cy, 0.0, 0.0, one]);
    w.f64s(&[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]);
    w.f64s(&[i.fx, 0.0, i.cx, 0.0, 0.0, i.fy, i.cy, 0.0, 0.0, 0.0, one, 0.0]);
    w.u32(0).u32(0);
    w.u32(0).u32(0).u32(0).u32(0).u8(0);
}

/// The pixel format of an image of `len` bytes under this header; an error if both do not agree.
pub(crate) fn check_image(h: &FrameHeader, len: usize) -> Result<PixelFormat> {
    let bad = |why: String| {
        Err(Error::new(
            ErrorKind::BadInput,
            format!("frame {} of {}/{} cannot be recorded: {why}", h.sequence, h.camera(), h.stream()),
        ))
    };
    let Some(format) = h.pixel_format() else {
        return bad(format!("pixel format code {} is unknown", h.format));
    };
    if len < h.payload_len as usize {
        return bad(format!("its header promises {} bytes, {len} are there", h.payload_len));
    }
    if format.layout() == Layout::Jpeg {
        return if h.payload_len == 0 { bad("it is empty".into()) } else { Ok(format) };
    }
    let row = u64::from(format.row_bytes(1)) * u64::from(h.width);
    let rows =
        u64::from(h.height) + if format.layout() == Layout::Nv12 { u64::from(h.height) / 2 } else { 0 };
    let whole = u64::from(h.stride) * rows;
    if h.width == 0 || h.height == 0 || u64::from(h.stride) < row || u64::from(h.payload_len) != whole {
        return bad(format!(
            "{}x{} {} with {} bytes per row takes {whole} bytes, its header says {}",
            h.width,
            h.height,
            format.name(),
            h.stride,
            h.payload_len
        ));
    }
    Ok(format)
}
