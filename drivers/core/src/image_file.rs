//! One image file: its header, whether it is complete, and its pixels.

use crate::{Error, ErrorKind, Result};
use core::fmt;
use depthrig_bus::files;
use image::ImageDecoder;
use image::codecs::png::PngDecoder;
use std::io::{self, BufReader, Cursor, Read, Seek};
use std::path::Path;

/// The most bytes of pixels that one image is believed to have: 9400x9400 in colour.
const MAX_PIXEL_BYTES: u64 = 1 << 28;

/// How the pixels of an image are stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// Three bytes a pixel.
    Rgb8,
    /// A byte a pixel.
    Grey8,
    /// Two bytes a pixel.
    Grey16,
}

impl Kind {
    const fn bytes_per_pixel(self) -> u64 {
        match self {
            Self::Rgb8 => 3,
            Self::Grey8 => 1,
            Self::Grey16 => 2,
        }
    }
}

impl fmt::Display for Kind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Rgb8 => "8-bit colour",
            Self::Grey8 => "8-bit grey",
            Self::Grey16 => "16-bit grey",
        })
    }
}

/// Format and size of an image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Info {
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// How its pixels are stored.
    pub kind: Kind,
}

impl Info {
    /// The bytes of its pixels.
    pub const fn bytes(&self) -> u64 {
        (self.width as u64 * self.height as u64).saturating_mul(self.kind.bytes_per_pixel())
    }
}

impl fmt::Display for Info {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}x{} {}", self.width, self.height, self.kind)
    }
}

/// Reads what `path` is from its header and checks that the file does not end early. Pixels stay undecoded.
///
/// # Errors
/// [`ErrorKind::BadInput`] with what is wrong with the file, [`ErrorKind::NotFound`], [`ErrorKind::Io`].
pub fn probe(path: &Path) -> Result<Info> {
    let file = files::open(path).map_err(|e| io_error(path, e))?;
    inspect(BufReader::new(file)).map_err(|bad| bad.into_error(path))
}

/// Decodes `path` into `pixels`, which has the size that `expected` says; 16-bit pixels as little-endian.
///
/// # Errors
/// Those of [`probe`], and [`ErrorKind::BadInput`] when the file is no longer as `expected`.
pub fn decode(path: &Path, expected: &Info, pixels: &mut [u8]) -> Result<()> {
    let bytes = files::read(path, files::IMAGE_MAX_BYTES).map_err(|e| io_error(path, e))?;
    let info = inspect(BufReader::new(Cursor::new(&bytes))).map_err(|bad| bad.into_error(path))?;
    if info != *expected {
        let message =
            format!("{}: it was {expected} when the camera was opened and is {info} now", path.display());
        return Err(Error::new(ErrorKind::BadInput, message + "; leave the folder alone while it plays"));
    }
    if !bytes.starts_with(&PNG_SIGNATURE) {
        return decode_jpeg(path, &bytes, &info, pixels);
    }
    let undecodable = |e: image::ImageError| undecodable(path, &e.to_string()).with_source(e);
    let decoder = PngDecoder::new(Cursor::new(&bytes)).map_err(undecodable)?;
    if decoder.total_bytes() != pixels.len() as u64 {
        let message =
            format!("{}: the decoder sees other pixels than the header says ({info})", path.display());
        return Err(Error::new(ErrorKind::BadInput, message + "; save it as plain PNG"));
    }
    decoder.read_image(pixels).map_err(undecodable)?;
    if info.kind == Kind::Grey16 && cfg!(target_endian = "big") {
        pixels.chunks_exact_mut(2).for_each(<[u8]>::reverse);
    }
    Ok(())
}

fn decode_jpeg(path: &Path, bytes: &[u8], info: &Info, pixels: &mut [u8]) -> Result<()> {
    let form = match info.kind {
        Kind::Rgb8 => depthrig_jpeg::Form::Rgb,
        Kind::Grey8 | Kind::Grey16 => depthrig_jpeg::Form::Grey,
    };
    let expected = depthrig_jpeg::Info { width: info.width, height: info.height, form };
    depthrig_jpeg::decode_into(bytes, expected, pixels)
        .map_err(|e| undecodable(path, &e.to_string()).with_source(e))
}

fn undecodable(path: &Path, why: &str) -> Error {
    let message = format!("{}: the image is damaged ({why}); write it again", path.display());
    Error::new(ErrorKind::BadInput, message)
}

/// An input or output error at `path`, with the kind that the supervisor acts on.
pub fn io_error(path: &Path, e: io::Error) -> Error {
    let kind = match e.kind() {
        io::ErrorKind::NotFound => ErrorKind::NotFound,
        io::ErrorKind::PermissionDenied => ErrorKind::PermissionDenied,
        _ => ErrorKind::Io,
    };
    Error::new(kind, format!("{}: {e}", path.display())).with_source(e)
}

/// Why bytes cannot be played as an image: what they are, and the cure.
enum Bad {
    Io(io::Error),
    Truncated,
    NoImage,
    Unsupported(String, &'static str),
}

impl From<io::Error> for Bad {
    fn from(e: io::Error) -> Self {
        if e.kind() == io::ErrorKind::UnexpectedEof { Self::Truncated } else { Self::Io(e) }
    }
}

impl Bad {
    fn into_error(self, path: &Path) -> Error {
        let (what, cure) = match self {
            Self::Io(e) => return io_error(path, e),
            Self::Truncated => (
                "the file is cut off: it ends before the image does".to_owned(),
                "copy it again or remove it",
            ),
            Self::NoImage => (
                "this is neither PNG nor JPEG".to_owned(),
                "convert it, or make the pattern in `files` narrower",
            ),
            Self::Unsupported(what, cure) => (what, cure),
        };
        Error::new(ErrorKind::BadInput, format!("{}: {what}; {cure}", path.display()))
    }
}

const PNG_SIGNATURE: [u8; 8] = *b"\x89PNG\r\n\x1a\n";

fn inspect(mut r: BufReader<impl Read + Seek>) -> Result<Info, Bad> {
    let mut start = [0; 2];
    r.read_exact(&mut start)?;
    let info = if start == PNG_SIGNATURE[..2] {
        inspect_png(&mut r)?
    } else if start == [0xFF, 0xD8] {
        let mut rest = Vec::new();
        r.take(1 << 30).read_to_end(&mut rest)?;
        inspect_jpeg(&rest)?
    } else {
        return Err(Bad::NoImage);
    };
    if info.width == 0 || info.height == 0 || info.bytes() > MAX_PIXEL_BYTES {
        let what = format!("{info} is an unsupported size for a camera's image");
        return Err(Bad::Unsupported(what, "make it smaller"));
    }
    Ok(info)
}

/// Walks the chunks of a PNG (after the first two bytes) to the end mark. PNG specification, section 5.
fn inspect_png(r: &mut BufReader<impl Read + Seek>) -> Result<Info, Bad> {
    let mut signature = [0; 6];
    r.read_exact(&mut signature)?;
    if signature != PNG_SIGNATURE[2..] {
        return Err(Bad::NoImage);
    }
    let mut info = None;
    loop {
        let mut head = [0; 8];
        r.read_exact(&mut head)?;
        let [a, b, c, d, name @ ..] = head;
        let len = u32::from_be_bytes([a, b, c, d]);
        match &name {
            b"IHDR" if len == 13 => {
                let mut ihdr = [0; 17]; // 13 and the checksum
                r.read_exact(&mut ihdr)?;
                info = Some(png_info(&ihdr)?);
                continue;
            }
            b"tRNS" => return Err(alpha()),
            _ if info.is_none() => return Err(Bad::NoImage),
            _ => {}
        }
        // Reading the last byte of the chunk's checksum proves that the file reaches as far.
        r.seek_relative(i64::from(len) + 3)?;
        r.read_exact(&mut [0])?;
        if &name == b"IEND" {
            return info.ok_or(Bad::NoImage);
        }
    }
}

fn alpha() -> Bad {
    let cure = "remove it, for example with ImageMagick: mogrify -alpha off FILE";
    Bad::Unsupported("the image has an alpha channel".to_owned(), cure)
}

fn png_info(ihdr: &[u8; 17]) -> Result<Info, Bad> {
    let [w0, w1, w2, w3, h0, h1, h2, h3, bits, color, ..] = *ihdr;
    let kind = match (color, bits) {
        (0, 8) => Kind::Grey8,
        (0, 16) => Kind::Grey16,
        (2, 8) => Kind::Rgb8,
        (4 | 6, _) => return Err(alpha()),
        (3, _) => {
            let what = format!("the image has a palette of {bits}-bit colours");
            return Err(Bad::Unsupported(what, "save it as 8-bit RGB or as 8- or 16-bit grey"));
        }
        _ => {
            let what = format!("{bits}-bit {} is not supported", if color == 0 { "grey" } else { "colour" });
            return Err(Bad::Unsupported(what, "save it as 8-bit RGB or as 8- or 16-bit grey"));
        }
    };
    let width = u32::from_be_bytes([w0, w1, w2, w3]);
    let height = u32::from_be_bytes([h0, h1, h2, h3]);
    Ok(Info { width, height, kind })
}

/// Walks the segments of a JPEG (after the start mark) to its end mark. ITU-T T.81, annex B.
///
/// The decoder fills what is missing with grey and says nothing, so that a cut is found here or never.
fn inspect_jpeg(bytes: &[u8]) -> Result<Info, Bad> {
    let at = |i: usize| bytes.get(i).copied().ok_or(Bad::Truncated);
    let mut info = None;
    let mut i = 0;
    loop {
        if at(i)? != 0xFF {
            return Err(Bad::NoImage);
        }
        while at(i)? == 0xFF {
            i += 1; // any number of fill bytes
        }
        let marker = at(i)?;
        i += 1;
        match marker {
            0xD9 => return info.ok_or(Bad::NoImage),
            0x01 | 0xD0..=0xD7 => continue, // stands alone
            _ => {}
        }
        let len = usize::from(u16::from_be_bytes([at(i)?, at(i + 1)?]));
        match marker {
            0xC0..=0xC2 => info = Some(jpeg_info(bytes.get(i + 2..i + 8).ok_or(Bad::Truncated)?)?),
            0xC3 | 0xC5..=0xC7 | 0xC9..=0xCB | 0xCD..=0xCF => {
                let what = "lossless, hierarchical and arithmetic JPEG are not supported".to_owned();
                return Err(Bad::Unsupported(what, "save it as plain JPEG or as PNG"));
            }
            _ => {}
        }
        i += len;
        if marker == 0xDA {
            // Compressed data: an FF in it is followed by 00 or by a restart mark.
            while at(i)? != 0xFF || matches!(at(i + 1)?, 0x00 | 0xD0..=0xD7) {
                i += 1;
            }
        }
    }
}

fn jpeg_info(sof: &[u8]) -> Result<Info, Bad> {
    let &[bits, h0, h1, w0, w1, components] = sof else { return Err(Bad::Truncated) };
    let kind = match (bits, components) {
        (8, 1) => Kind::Grey8,
        (8, 3) => Kind::Rgb8,
        _ => {
            let what = format!("JPEG of {components} components with {bits} bits is not supported");
            return Err(Bad::Unsupported(what, "save it as 8-bit RGB or 8-bit grey"));
        }
    };
    let width = u16::from_be_bytes([w0, w1]).into();
    let height = u16::from_be_bytes([h0, h1]).into();
    Ok(Info { width, height, kind })
}

#[cfg(test)]
mod tests;
