//! JPEG images to pixels, byte for byte as libjpeg-turbo decodes them.
//!
//! Layer 2. Pillow, OpenCV, ROS and PyTorch's loaders all decode with libjpeg-turbo: the accurate integer transform, and
//! chroma upsampled by its triangle filter. A decoder that rounds otherwise shifts colour by up to four levels and not
//! evenly to both sides, from which a depth network trained on the others' pixels computes different depth. Every crate
//! of depthrig decodes JPEG here, and `image` is built without its own decoder.
//!
//! A damaged image is an error: nothing is filled in for data that is missing.
#![cfg_attr(test, allow(clippy::unwrap_used, clippy::expect_used))]

use core::fmt;
use libjpeg_turbo_rs::{ColorSpace, DecodeLimits, Decoder, PixelFormat};
use std::panic::{AssertUnwindSafe, catch_unwind};

/// First bytes of a JPEG image (ITU-T T.81, table B.1).
pub const START: [u8; 2] = [0xFF, 0xD8];

/// Larger images are refused: 16384x16384.
pub const MAX_PIXELS: u64 = 1 << 28;

/// Progressive images of more scans are refused. Encoders write about ten; each costs time of its own, however few bytes
/// it has.
const MAX_SCANS: usize = 128;

/// Channels of an image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Form {
    /// One byte a pixel.
    Grey,
    /// Red, green, blue.
    Rgb,
}

impl Form {
    /// Bytes of one pixel.
    pub const fn bytes_per_pixel(self) -> usize {
        match self {
            Self::Grey => 1,
            Self::Rgb => 3,
        }
    }
}

impl fmt::Display for Form {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Grey => "grey",
            Self::Rgb => "colour",
        })
    }
}

/// Size and channels of an image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Info {
    /// Pixels per row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Channels.
    pub form: Form,
}

impl Info {
    /// Bytes of the decoded image; rows lie without padding.
    pub const fn bytes(&self) -> usize {
        self.width as usize * self.height as usize * self.form.bytes_per_pixel()
    }
}

impl fmt::Display for Info {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}x{} {}", self.width, self.height, self.form)
    }
}

/// A decoded image, rows without padding.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Image {
    /// Size and channels.
    pub info: Info,
    /// The pixels, [`Info::bytes`] of them.
    pub pixels: Vec<u8>,
}

/// Why an image cannot be decoded.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Error(String);

impl fmt::Display for Error {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl core::error::Error for Error {}

/// Result of decoding.
pub type Result<T> = core::result::Result<T, Error>;

/// Size and channels of an image, read from its header.
///
/// # Errors
/// When the header is damaged, or names more than 8 bits a channel or other channels than grey or colour.
pub fn info(jpeg: &[u8]) -> Result<Info> {
    guarded(|| Ok(open(jpeg)?.info))
}

/// Decodes `jpeg` into `out`, which has [`Info::bytes`] of `expected`.
///
/// Images without Huffman tables, as cameras send them, are decoded with those of ITU-T T.81, annex K.
///
/// # Errors
/// When the image is damaged or cut short, or differs from `expected`. The contents of `out` are then unspecified.
pub fn decode_into(jpeg: &[u8], expected: Info, out: &mut [u8]) -> Result<()> {
    guarded(|| {
        let Opened { info, decoder } = open(jpeg)?;
        if info != expected {
            return Err(Error(format!("the JPEG is {info}, and {expected} is expected")));
        }
        decode_opened(&decoder, info, out)
    })
}

/// Decodes `jpeg`.
///
/// # Errors
/// When the image is damaged or cut short, or larger than [`MAX_PIXELS`].
pub fn decode(jpeg: &[u8]) -> Result<Image> {
    guarded(|| {
        let Opened { info, decoder } = open(jpeg)?;
        let mut pixels = vec![0; info.bytes()];
        decode_opened(&decoder, info, &mut pixels)?;
        Ok(Image { info, pixels })
    })
}

/// A decoder that has read the header.
struct Opened<'a> {
    info: Info,
    decoder: Decoder<'a>,
}

fn open(jpeg: &[u8]) -> Result<Opened<'_>> {
    let limits = DecodeLimits { max_pixels: MAX_PIXELS, max_scans: MAX_SCANS, ..DecodeLimits::default() };
    let mut decoder = Decoder::new_with_limits(jpeg, limits).map_err(|e| damaged(&e))?;
    let form = match decoder.jpeg_color_space() {
        ColorSpace::Grayscale => Form::Grey,
        ColorSpace::YCbCr | ColorSpace::Rgb => Form::Rgb,
        other => {
            let what = format!("the JPEG has the channels {other:?}; grey and colour are supported");
            return Err(Error(what));
        }
    };
    decoder.set_output_format(match form {
        Form::Grey => PixelFormat::Grayscale,
        Form::Rgb => PixelFormat::Rgb,
    });
    // As libjpeg does by default; it changes only progressive images that end before their last scan.
    decoder.set_block_smoothing(true);
    let header = decoder.header();
    if header.precision != 8 {
        let what = format!("the JPEG has {} bits a channel; 8 are supported", header.precision);
        return Err(Error(what));
    }
    let info = Info { width: header.width.into(), height: header.height.into(), form };
    if info.width == 0 || info.height == 0 || u64::from(info.width) * u64::from(info.height) > MAX_PIXELS {
        return Err(Error(format!(
            "a JPEG of {info} is not supported: at most {MAX_PIXELS} pixels, at least one"
        )));
    }
    Ok(Opened { info, decoder })
}

fn decode_opened(decoder: &Decoder<'_>, info: Info, out: &mut [u8]) -> Result<()> {
    if out.len() != info.bytes() {
        return Err(Error(format!(
            "a buffer of {} bytes cannot hold {info}, which needs {}",
            out.len(),
            info.bytes()
        )));
    }
    let written = decoder.decode_image_into(out).map_err(|e| damaged(&e))?;
    if written.bytes_written == out.len() {
        return Ok(());
    }
    Err(Error(format!("the JPEG of {info} gave {} bytes", written.bytes_written)))
}

fn damaged(e: &libjpeg_turbo_rs::JpegError) -> Error {
    Error(format!("the JPEG is damaged or not supported ({e})"))
}

/// Turns a panic of the decoder into an error: it reads untrusted data.
fn guarded<T>(work: impl FnOnce() -> Result<T>) -> Result<T> {
    catch_unwind(AssertUnwindSafe(work))
        .unwrap_or_else(|_| Err(Error("the JPEG is damaged: the decoder gave up".into())))
}
