//! Images between two computers: as they are, or smaller in the codecs of recordings.

use crate::dataset::decode;
use crate::encode::{Codec, ImageWriter};
use crate::msgs::image::check_image;
use crate::options::{ColorCodec, DepthCodec};
use crate::{Error, ErrorKind, RecorderOptions, Result};
use ::image::codecs::png::CompressionType;
use depthrig_bus::{FrameHeader, PixelFormat};

/// Coding of an image on its way. The discriminant is what travels; it is given to one coding for good.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[repr(u8)]
pub enum Coding {
    /// The payload as it lies in shared memory.
    Raw = 0,
    /// Colour as JPEG, 4:4:4.
    Jpeg = 1,
    /// Depth in the codec of [`crate::codec`], every bit of it.
    Rank = 2,
}

impl Coding {
    /// Every coding.
    pub const ALL: [Self; 3] = [Self::Raw, Self::Jpeg, Self::Rank];

    /// The coding with this number.
    pub fn from_code(code: u8) -> Option<Self> {
        Self::ALL.into_iter().find(|c| *c as u8 == code)
    }

    /// The name used in reports and JSON.
    pub const fn name(self) -> &'static str {
        self.codec().name()
    }

    /// The smaller coding of images in `format`; [`Self::Raw`] for those that have none.
    pub fn smaller(format: PixelFormat) -> Self {
        let codecs = RecorderOptions {
            color: ColorCodec::Jpeg,
            depth: DepthCodec::Rank,
            ..RecorderOptions::default()
        };
        let codec = Codec::of(format, &codecs);
        Self::ALL.into_iter().find(|coding| coding.codec() == codec).unwrap_or(Self::Raw)
    }

    const fn codec(self) -> Codec {
        match self {
            Self::Raw => Codec::Raw,
            Self::Jpeg => Codec::Jpeg,
            Self::Rank => Codec::Rank,
        }
    }
}

/// Encodes images; it keeps its buffers from one to the next.
pub struct TransitEncoder {
    writer: ImageWriter,
}

impl Default for TransitEncoder {
    fn default() -> Self {
        Self { writer: ImageWriter::new(RecorderOptions::default().jpeg_quality) }
    }
}

impl TransitEncoder {
    /// Puts the image of `h` in its smaller coding into `out`, whose contents are replaced; returns that coding, and nothing in `out` if it is
    /// [`Coding::Raw`].
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] for pixels that contradict the header, [`ErrorKind::Codec`] when they cannot be encoded.
    pub fn encode(&mut self, h: &FrameHeader, pixels: &[u8], out: &mut Vec<u8>) -> Result<Coding> {
        let coding = Coding::smaller(check_image(h, pixels.len())?);
        out.clear();
        if coding == Coding::Raw {
            return Ok(coding);
        }
        let pixels = &pixels[..h.payload_len as usize];
        self.writer.encode(out, coding.codec(), h, pixels, CompressionType::Fast)?;
        Ok(coding)
    }
}

/// Refuses an image of `h` that may not come in this coding as `len` bytes.
///
/// # Errors
/// [`ErrorKind::BadInput`] for a header that contradicts itself or them.
pub fn check(coding: Coding, h: &FrameHeader, len: u32) -> Result<()> {
    let format = check_image(h, h.payload_len as usize)?;
    let fits = if coding == Coding::Raw { len == h.payload_len } else { coding == Coding::smaller(format) };
    if fits {
        return Ok(());
    }
    let what = format!(
        "{len} bytes ({}) came for an image of {} bytes ({})",
        coding.name(),
        h.payload_len,
        format.name()
    );
    Err(Error::new(ErrorKind::BadInput, what))
}

/// Puts the image of `h` that came as `bytes` into `pixels`, as long as the header says.
///
/// # Errors
/// As [`check`], and [`ErrorKind::Codec`] for bytes that are not such an image.
pub fn arrived(coding: Coding, h: &FrameHeader, bytes: &[u8], pixels: &mut [u8]) -> Result<()> {
    check(coding, h, u32::try_from(bytes.len()).unwrap_or(u32::MAX))?;
    let decoded = decode::decode(bytes, coding.codec(), h)?;
    if pixels.len() != decoded.len() {
        let what = format!("an image of {} bytes has {} bytes of room", decoded.len(), pixels.len());
        return Err(Error::new(ErrorKind::BadInput, what));
    }
    pixels.copy_from_slice(&decoded);
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn image(format: PixelFormat, width: u32, height: u32, padding: u32) -> (FrameHeader, Vec<u8>) {
        let mut h = FrameHeader::default();
        h.set_image(format, width, height);
        h.stride += padding;
        h.payload_len = h.stride * height;
        let pixels = (0..h.payload_len).map(|i| ((i / 7) * 3 % 251) as u8).collect();
        (h, pixels)
    }

    #[test]
    fn depth_comes_as_it_was_and_colour_nearly() {
        let mut encoder = TransitEncoder::default();
        for (format, coding, padding, most) in [
            (PixelFormat::Z16, Coding::Rank, 0, 0),
            (PixelFormat::Z16, Coding::Rank, 6, 0),
            (PixelFormat::Mono8, Coding::Raw, 0, 0),
            (PixelFormat::Rgb8, Coding::Jpeg, 0, 40),
            (PixelFormat::Bgr8, Coding::Jpeg, 0, 40),
        ] {
            let (h, pixels) = image(format, 64, 48, padding);
            let mut bytes = vec![1, 2, 3];
            assert_eq!(encoder.encode(&h, &pixels, &mut bytes).unwrap(), coding, "{format:?}");
            let mut back = vec![0; pixels.len()];
            if coding == Coding::Raw {
                assert!(bytes.is_empty());
                bytes.clone_from(&pixels);
            }
            arrived(coding, &h, &bytes, &mut back).unwrap();
            let off = pixels.iter().zip(&back).map(|(a, b)| a.abs_diff(*b)).max().unwrap();
            assert!(off <= most, "{format:?} is off by {off}");
            arrived(Coding::Raw, &h, &pixels, &mut back).unwrap();
            assert_eq!(back, pixels);
        }
    }

    #[test]
    fn what_is_no_such_image_is_refused() {
        let (h, pixels) = image(PixelFormat::Z16, 64, 48, 0);
        let mut bytes = Vec::new();
        TransitEncoder::default().encode(&h, &pixels, &mut bytes).unwrap();
        let mut back = vec![0; pixels.len()];
        for (coding, bytes, len) in [
            (Coding::Jpeg, &bytes[..], back.len()),
            (Coding::Rank, &bytes[..bytes.len() - 1], back.len()),
            (Coding::Raw, &pixels[1..], back.len()),
            (Coding::Raw, &pixels[..], back.len() - 2),
        ] {
            assert!(arrived(coding, &h, bytes, &mut back[..len]).is_err(), "{coding:?} {len}");
        }
        let odd = FrameHeader { stride: 4, ..h };
        assert!(arrived(Coding::Raw, &odd, &pixels, &mut back).is_err());
    }
}
