//! A stored picture becomes the pixels that the camera's channel carried.

use crate::encode::Codec;
use crate::msgs::image;
use crate::{Error, ErrorKind, Result};
use ::image::ImageDecoder;
use ::image::codecs::jpeg::JpegDecoder;
use depthrig_bus::{FrameHeader, PixelFormat};
use std::io::Cursor;

/// The bytes in an image message, as stored.
pub(super) fn stored(message: &[u8], codec: Codec) -> Result<&[u8]> {
    image::read_data(message, codec != Codec::Raw)
}

/// Whether the picture of a whole image message can be decoded to what its header says. A camera's own JPEG,
/// which a replay hands on as it came, is decoded here as well.
pub(crate) fn check_stored(message: &[u8], codec: Codec, h: &FrameHeader) -> Result<()> {
    let stored = stored(message, codec)?;
    decode(stored, codec, h)?;
    if codec == Codec::Mjpeg {
        jpeg_pixels(stored, h)?;
    }
    Ok(())
}

fn wrong(h: &FrameHeader, what: impl core::fmt::Display) -> Error {
    let name = format!("frame {} of {}/{}", h.sequence, h.camera(), h.stream());
    Error::new(ErrorKind::Codec, format!("{name} cannot be decoded: {what}"))
}

/// The pixels of a colour JPEG, three bytes each without row padding.
pub(crate) fn jpeg_pixels(stored: &[u8], h: &FrameHeader) -> Result<Vec<u8>> {
    let damaged = |e: ::image::ImageError| wrong(h, "its JPEG is damaged").with_source(e);
    let decoder = JpegDecoder::new(Cursor::new(stored)).map_err(damaged)?;
    let (width, height) = decoder.dimensions();
    if (width, height) != (h.width, h.height) || decoder.color_type().bytes_per_pixel() != 3 {
        let said = format!("its header says {}x{} in colour", h.width, h.height);
        return Err(wrong(h, format_args!("its JPEG is {width}x{height}, {said}")));
    }
    let mut pixels = vec![0; 3 * h.width as usize * h.height as usize];
    decoder.read_image(&mut pixels).map_err(damaged)?;
    Ok(pixels)
}

/// The payload as the header describes it: same format, same stride, same length.
pub(super) fn decode(stored: &[u8], codec: Codec, h: &FrameHeader) -> Result<Vec<u8>> {
    if codec != Codec::Jpeg {
        return if stored.len() == h.payload_len as usize {
            Ok(stored.to_vec())
        } else {
            let said = h.payload_len;
            Err(wrong(h, format_args!("{} bytes are stored, its header says {said}", stored.len())))
        };
    }
    let mut pixels = jpeg_pixels(stored, h)?;
    if h.pixel_format() == Some(PixelFormat::Bgr8) {
        pixels.chunks_exact_mut(3).for_each(|p| p.swap(0, 2));
    }
    let (row, stride) = (3 * h.width as usize, h.stride as usize);
    if stride == row {
        return Ok(pixels);
    }
    if stride < row || stride.checked_mul(h.height as usize) != Some(h.payload_len as usize) {
        return Err(wrong(h, "its header contradicts itself"));
    }
    let mut padded = vec![0; h.payload_len as usize];
    for (to, from) in padded.chunks_exact_mut(stride).zip(pixels.chunks_exact(row)) {
        to[..row].copy_from_slice(from);
    }
    Ok(padded)
}
