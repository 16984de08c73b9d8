//! A stored image becomes the pixels that the camera's channel carried.

use crate::codec::{DEPTH_CODEC, DepthDecoder, DepthShape};
use crate::encode::Codec;
use crate::msgs::image;
use crate::{Error, ErrorKind, Result};
use ::image::codecs::png::PngDecoder;
use ::image::{ColorType, ImageDecoder, Limits};
use depthrig_bus::{FrameHeader, PixelFormat};
use depthrig_jpeg::{Form, Info};
use std::cell::RefCell;
use std::io::Cursor;

thread_local! {
    /// One per thread that reads depth, so that its tables and buffers are made once.
    static DEPTH: RefCell<Option<DepthDecoder>> = const { RefCell::new(None) };
}

/// The bytes in an image's message, as stored.
pub(crate) fn stored(message: &[u8], codec: Codec) -> Result<&[u8]> {
    match codec {
        Codec::Raw => image::read_image(message),
        Codec::Jpeg | Codec::Mjpeg | Codec::Png => image::read_compressed(message),
        Codec::Rank => {
            let (_, name, data) = image::read_compressed_depth(message)?;
            if name != DEPTH_CODEC {
                let what = format!("depth is packed with \"{name}\"; this depthrig reads \"{DEPTH_CODEC}\"");
                return Err(Error::new(ErrorKind::Version, what));
            }
            Ok(data)
        }
    }
}

/// Whether the image of a whole image message can be decoded to what its header says. A camera's own JPEG,
/// which a replay hands on as it came, is decoded here as well.
pub(crate) fn check_stored(message: &[u8], codec: Codec, h: &FrameHeader) -> Result<()> {
    let stored = stored(message, codec)?;
    if codec == Codec::Rank {
        let (shape, ..) = image::read_compressed_depth(message)?;
        if shape != shape_of(h) {
            return Err(wrong(h, format_args!("its message says {shape:?}, its header {:?}", shape_of(h))));
        }
    }
    decode(stored, codec, h)?;
    if codec == Codec::Mjpeg {
        jpeg_pixels(stored, h)?;
    }
    Ok(())
}

const fn shape_of(h: &FrameHeader) -> DepthShape {
    DepthShape { width: h.width, height: h.height, step: h.stride }
}

fn wrong(h: &FrameHeader, what: impl core::fmt::Display) -> Error {
    let name = format!("frame {} of {}/{}", h.sequence, h.camera(), h.stream());
    Error::new(ErrorKind::Codec, format!("{name} cannot be decoded: {what}"))
}

/// The pixels of a colour JPEG, three bytes each without row padding.
///
/// # Errors
/// [`ErrorKind::Codec`] when the JPEG is damaged or not of the size in the header.
pub fn jpeg_pixels(stored: &[u8], h: &FrameHeader) -> Result<Vec<u8>> {
    let damaged = |e: depthrig_jpeg::Error| wrong(h, "its JPEG is damaged").with_source(e);
    let info = depthrig_jpeg::info(stored).map_err(damaged)?;
    let expected = Info { width: h.width, height: h.height, form: Form::Rgb };
    check_color("JPEG", info.width, info.height, info == expected, h)?;
    let mut pixels = vec![0; expected.bytes()];
    depthrig_jpeg::decode_into(stored, expected, &mut pixels).map_err(damaged)?;
    Ok(pixels)
}

fn png_pixels(stored: &[u8], h: &FrameHeader) -> Result<Vec<u8>> {
    let damaged = |e: ::image::ImageError| wrong(h, "its PNG is damaged").with_source(e);
    let mut limits = Limits::default();
    (limits.max_image_width, limits.max_image_height) = (Some(h.width), Some(h.height));
    let decoder = PngDecoder::with_limits(Cursor::new(stored), limits).map_err(damaged)?;
    if decoder.color_type() != ColorType::Rgb8 {
        return Err(wrong(h, "its PNG is not RGB of 8 bit"));
    }
    color_pixels(decoder, h)
}

/// Whether this is a PNG or a JPEG of the header's size: for the fuzz targets.
#[cfg(any(test, feature = "testing"))]
pub(crate) fn color_decodes(stored: &[u8], h: &FrameHeader) -> bool {
    png_pixels(stored, h).is_ok() | jpeg_pixels(stored, h).is_ok()
}

fn color_pixels(decoder: impl ImageDecoder, h: &FrameHeader) -> Result<Vec<u8>> {
    let (width, height) = decoder.dimensions();
    let fits = (width, height) == (h.width, h.height) && decoder.color_type().bytes_per_pixel() == 3;
    check_color("PNG", width, height, fits, h)?;
    let mut pixels = vec![0; 3 * width as usize * height as usize];
    let damaged = |e: ::image::ImageError| wrong(h, "its PNG is damaged").with_source(e);
    decoder.read_image(&mut pixels).map_err(damaged)?;
    Ok(pixels)
}

fn check_color(kind: &str, width: u32, height: u32, fits: bool, h: &FrameHeader) -> Result<()> {
    if !fits {
        let said = format!("its header says {}x{} in colour", h.width, h.height);
        return Err(wrong(h, format_args!("its {kind} is {width}x{height}, {said}")));
    }
    if 3 * u64::from(width) * u64::from(height) > crate::IMAGE_MAX_BYTES {
        return Err(wrong(h, format_args!("a {kind} of {width}x{height} is too large")));
    }
    Ok(())
}

/// The payload as the header describes it: same format, same stride, same length.
pub(crate) fn decode(stored: &[u8], codec: Codec, h: &FrameHeader) -> Result<Vec<u8>> {
    let pixels = match codec {
        Codec::Raw | Codec::Mjpeg => stored.to_vec(),
        Codec::Rank => {
            let mut pixels = Vec::new();
            DEPTH
                .with_borrow_mut(|d| d.get_or_insert_default().decode(stored, shape_of(h), &mut pixels))
                .map_err(|e| wrong(h, e))?;
            pixels
        }
        Codec::Jpeg => padded(jpeg_pixels(stored, h)?, h)?,
        Codec::Png => padded(png_pixels(stored, h)?, h)?,
    };
    if pixels.len() == h.payload_len as usize {
        return Ok(pixels);
    }
    let len = pixels.len();
    let said = h.payload_len;
    Err(wrong(h, format_args!("{len} bytes are stored, its header says {said}")))
}

/// RGB pixels in the channel order and with the row padding of the live image; the padding is zero.
fn padded(mut pixels: Vec<u8>, h: &FrameHeader) -> Result<Vec<u8>> {
    if h.pixel_format() == Some(PixelFormat::Bgr8) {
        pixels.chunks_exact_mut(3).for_each(|p| p.swap(0, 2));
    }
    let row = 3 * h.width as usize;
    let stride = h.stride as usize;
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
