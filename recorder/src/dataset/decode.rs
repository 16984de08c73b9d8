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

/// Decodes the picture of a whole image message.
pub(crate) fn decode_stored(message: &[u8], codec: Codec, h: &FrameHeader) -> Result<Vec<u8>> {
    decode(stored(message, codec)?, codec, h)
}

/// The payload as the header describes it: same format, same stride, same length.
pub(super) fn decode(stored: &[u8], codec: Codec, h: &FrameHeader) -> Result<Vec<u8>> {
    let wrong = |what: String| {
        let name = format!("frame {} of {}/{}", h.sequence, h.camera(), h.stream());
        Error::new(ErrorKind::Codec, format!("{name} cannot be decoded: {what}"))
    };
    if codec != Codec::Jpeg {
        return if stored.len() == h.payload_len as usize {
            Ok(stored.to_vec())
        } else {
            Err(wrong(format!("{} bytes are stored, its header says {}", stored.len(), h.payload_len)))
        };
    }
    let jpeg = |e: ::image::ImageError| wrong("its JPEG is damaged".to_owned()).with_source(e);
    let decoder = JpegDecoder::new(Cursor::new(stored)).map_err(jpeg)?;
    if decoder.dimensions() != (h.width, h.height) || decoder.color_type().bytes_per_pixel() != 3 {
        let (w, hh) = decoder.dimensions();
        return Err(wrong(format!(
            "its JPEG is {w}x{hh}, its header says {}x{} in colour",
            h.width, h.height
        )));
    }
    let row = 3 * h.width as usize;
    let mut pixels = vec![0; row * h.height as usize];
    decoder.read_image(&mut pixels).map_err(jpeg)?;
    if h.pixel_format() == Some(PixelFormat::Bgr8) {
        pixels.chunks_exact_mut(3).for_each(|p| p.swap(0, 2));
    }
    let stride = h.stride as usize;
    if stride == row {
        return Ok(pixels);
    }
    if stride < row || stride.checked_mul(h.height as usize) != Some(h.payload_len as usize) {
        return Err(wrong("its header contradicts itself".to_owned()));
    }
    let mut padded = vec![0; h.payload_len as usize];
    for (to, from) in padded.chunks_exact_mut(stride).zip(pixels.chunks_exact(row)) {
        to[..row].copy_from_slice(from);
    }
    Ok(padded)
}
