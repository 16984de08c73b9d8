//! One image as a file: PNG, NPY, or the JPEG as it is stored.

use crate::dataset::{DatasetFrame, jpeg_pixels};
use crate::{Error, ErrorKind, Result, npy};
use depthrig_bus::{FrameHeader, Layout, PixelFormat, Sample};
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder};
use serde::Serialize;
use std::borrow::Cow;

/// The form of an image file.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum StillFormat {
    /// PNG, of 8 or 16 bits. Depth is in the camera's units, which a PNG cannot name.
    Png,
    /// NumPy's array file: the pixels as the camera's channel carried them, rows without padding.
    Npy,
    /// The JPEG, byte by byte as it is stored.
    Jpeg,
}

impl StillFormat {
    /// PNG where it holds every bit of such images, else NPY.
    pub const fn of(format: PixelFormat) -> Self {
        if png_color(format).is_some() { Self::Png } else { Self::Npy }
    }

    /// The ending of such a file's name.
    pub const fn extension(self) -> &'static str {
        match self {
            Self::Png => "png",
            Self::Npy => "npy",
            Self::Jpeg => "jpg",
        }
    }
}

/// The file of a frame that was read with [`crate::PixelMode::Stored`].
///
/// # Errors
/// [`ErrorKind::BadInput`] when the format cannot hold such pixels, [`ErrorKind::Codec`] when decoding
/// fails.
pub fn still(frame: &DatasetFrame, form: StillFormat) -> Result<Cow<'_, [u8]>> {
    let h = &frame.header;
    if form == StillFormat::Jpeg {
        return match frame.codec {
            "jpeg" | "mjpeg" => Ok(frame.pixels.as_slice().into()),
            other => Err(refused(h, format_args!("is stored as {other}, not as a JPEG; write PNG or NPY"))),
        };
    }
    let format = h.pixel_format().ok_or_else(|| refused(h, "has a pixel format unknown here"))?;
    let pixels = frame.decoded()?;
    if format.layout() == Layout::Jpeg {
        return encode(h, PixelFormat::Rgb8, &jpeg_pixels(&pixels, h)?, form).map(Cow::Owned);
    }
    encode(h, format, &tight(h, &pixels, format), form).map(Cow::Owned)
}

/// The file of an image whose rows follow each other without padding.
///
/// # Errors
/// [`ErrorKind::Codec`] when the format cannot be stored in this form.
pub fn encode(h: &FrameHeader, format: PixelFormat, pixels: &[u8], form: StillFormat) -> Result<Vec<u8>> {
    if format.layout() == Layout::Jpeg || pixels.len() != format.frame_bytes(h.width, h.height) {
        return Err(refused(h, format_args!("has {} bytes, not as many as its size says", pixels.len())));
    }
    match form {
        StillFormat::Png => png(h, format, pixels),
        StillFormat::Npy => Ok(array(h, format, pixels)),
        StillFormat::Jpeg => Err(refused(h, "is not written as a JPEG, that would lose bits")),
    }
}

fn refused(h: &FrameHeader, why: impl core::fmt::Display) -> Error {
    Error::new(ErrorKind::BadInput, format!("frame {} of {}/{} {why}", h.sequence, h.camera(), h.stream()))
}

/// The PNG colour type of a format; `None` where PNG would have to change the pixels.
const fn png_color(format: PixelFormat) -> Option<ExtendedColorType> {
    Some(match (format.layout(), format.sample()) {
        (Layout::Rgb | Layout::Bgr | Layout::Jpeg, _) => ExtendedColorType::Rgb8,
        (Layout::Grey, Sample::U8) => ExtendedColorType::L8,
        (Layout::Grey, Sample::U16) => ExtendedColorType::L16,
        _ => return None,
    })
}

fn png(h: &FrameHeader, format: PixelFormat, pixels: &[u8]) -> Result<Vec<u8>> {
    let Some(color) = png_color(format) else {
        let what = format_args!("is {}, which a PNG cannot hold; write NPY", format.name());
        return Err(refused(h, what));
    };
    let pixels: Cow<'_, [u8]> = match color {
        _ if format.layout() == Layout::Bgr => {
            pixels.as_chunks().0.iter().flat_map(|[b, g, r]| [*r, *g, *b]).collect()
        }
        // The encoder takes numbers in native byte order and writes them high byte first, as PNG requires.
        ExtendedColorType::L16 if cfg!(target_endian = "big") => {
            pixels.as_chunks().0.iter().flat_map(|[low, high]| [*high, *low]).collect()
        }
        _ => pixels.into(),
    };
    let mut out = Vec::new();
    let encoder = PngEncoder::new_with_quality(&mut out, CompressionType::Fast, FilterType::Adaptive);
    encoder
        .write_image(&pixels, h.width, h.height, color)
        .map_err(|e| refused(h, "cannot be encoded as PNG").with_source(e))?;
    Ok(out)
}

/// The pixels of a frame as a NumPy array.
fn array(h: &FrameHeader, format: PixelFormat, pixels: &[u8]) -> Vec<u8> {
    let height = h.height as usize;
    let width = h.width as usize;
    let shape = match format.layout() {
        // The rows of both planes: all of Y, then half as many of U and V in turns.
        Layout::Nv12 => vec![pixels.len() / width.max(1), width],
        Layout::Grey => vec![height, width],
        layout => vec![height, width, layout.channels() as usize],
    };
    npy::file(format.numpy(), &shape, pixels)
}

/// The rows without padding.
pub fn tight<'a>(h: &FrameHeader, pixels: &'a [u8], format: PixelFormat) -> Cow<'a, [u8]> {
    let row = format.row_bytes(h.width) as usize;
    let stride = h.stride as usize;
    if stride <= row || row == 0 {
        return pixels.into();
    }
    let mut rows = Vec::with_capacity(pixels.len());
    pixels.chunks(stride).for_each(|r| rows.extend_from_slice(&r[..row.min(r.len())]));
    rows.into()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn header(format: PixelFormat, width: u32, height: u32) -> FrameHeader {
        let mut h = FrameHeader::default();
        h.set_image(format, width, height);
        h
    }

    /// `np.save` of NumPy 2 writes these bytes for `np.array([[1, 2, 3]], "<u2")`.
    #[test]
    fn an_npy_is_as_numpy_writes_it() {
        let h = header(PixelFormat::Z16, 3, 1);
        let file = encode(&h, PixelFormat::Z16, &[1, 0, 2, 0, 3, 0], StillFormat::Npy).unwrap();
        let mut expected = b"\x93NUMPY\x01\x00v\x00".to_vec();
        expected.extend(b"{'descr': '<u2', 'fortran_order': False, 'shape': (1, 3), }");
        expected.resize(127, b' ');
        expected.extend([b'\n', 1, 0, 2, 0, 3, 0]);
        assert_eq!(file, expected);
    }

    #[test]
    fn the_data_of_an_npy_is_aligned_whatever_the_shape() {
        for width in [1, 9, 10, 99, 1280, 100_000] {
            let h = header(PixelFormat::Rgb8, width, 2);
            let pixels = vec![7; PixelFormat::Rgb8.frame_bytes(width, 2)];
            let file = encode(&h, PixelFormat::Rgb8, &pixels, StillFormat::Npy).unwrap();
            let data = 10 + usize::from(u16::from_le_bytes([file[8], file[9]]));
            assert_eq!((data % 64, file.len() - data), (0, pixels.len()));
            assert_eq!(file[data - 1], b'\n');
        }
    }

    #[test]
    fn a_png_holds_every_bit_or_is_refused() {
        for format in PixelFormat::ALL {
            let h = header(format, 6, 4);
            let pixels: Vec<u8> = (0..format.frame_bytes(6, 4)).map(|i| (i * 37) as u8).collect();
            let file = encode(&h, format, &pixels, StillFormat::Png);
            if format == PixelFormat::Mjpeg {
                file.unwrap_err(); // images are decoded to rgb8 before they come here
                continue;
            }
            if StillFormat::of(format) == StillFormat::Npy {
                let e = file.unwrap_err();
                assert_eq!(e.kind(), ErrorKind::BadInput);
                assert!(e.to_string().contains("write NPY"), "{e}");
                continue;
            }
            let back = image::load_from_memory(&file.unwrap()).unwrap();
            let bytes = match format {
                PixelFormat::Z16 | PixelFormat::Mono16 => {
                    back.into_luma16().into_raw().iter().flat_map(|v| v.to_le_bytes()).collect()
                }
                PixelFormat::Bgr8 => {
                    let mut rgb = back.into_rgb8().into_raw();
                    rgb.chunks_exact_mut(3).for_each(|p| p.swap(0, 2));
                    rgb
                }
                PixelFormat::Rgb8 => back.into_rgb8().into_raw(),
                _ => back.into_luma8().into_raw(),
            };
            assert_eq!(bytes, pixels, "{}", format.name());
        }
    }

    #[test]
    fn a_header_that_lies_is_refused() {
        let h = header(PixelFormat::Mono8, 4, 4);
        for form in [StillFormat::Png, StillFormat::Npy] {
            assert!(encode(&h, PixelFormat::Mono8, &[0; 15], form).is_err());
        }
    }
}
