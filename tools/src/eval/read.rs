//! Reads depth from image files: 16-bit PNG and TIFF in a given unit, NPY and TIFF in metres.

use anyhow::{Context, Result, bail};
use depthrig_bus::files;
use depthrig_recorder::npy::{self, Array};
use std::path::Path;

/// The largest side of an image that is read.
const MAX_SIDE: usize = 32_768;

/// A depth image in metres, row by row; values that are not finite or not above 0 are holes.
#[derive(Debug, Clone, PartialEq)]
pub struct Metres {
    /// Pixels per row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// The pixels.
    pub pixels: Vec<f32>,
}

/// Extensions of supported files.
pub const ENDINGS: [&str; 4] = ["png", "npy", "tiff", "tif"];

/// Reads `path`. Whole numbers are taken times `unit_m`, floating-point ones are metres; `65535` of 16 bits says that a
/// range ended, and is a hole.
pub fn depth(path: &Path, unit_m: f64) -> Result<Metres> {
    let read = || -> Result<Metres> {
        let bytes = files::read(path, files::IMAGE_MAX_BYTES)?;
        match path.extension().and_then(|e| e.to_str()).map(str::to_lowercase).as_deref() {
            Some("npy") => npy(&bytes, unit_m),
            Some("tif" | "tiff") => tiff(&bytes, unit_m),
            _ => png(&bytes, unit_m),
        }
    };
    read().with_context(|| format!("{}: cannot be read as depth", path.display()))
}

fn units(values: impl Iterator<Item = u16>, unit_m: f64) -> Vec<f32> {
    values.map(|v| if v == u16::MAX { 0.0 } else { (f64::from(v) * unit_m) as f32 }).collect()
}

fn png(bytes: &[u8], unit_m: f64) -> Result<Metres> {
    let image = image::load_from_memory_with_format(bytes, image::ImageFormat::Png)?;
    let width = image.width() as usize;
    let height = image.height() as usize;
    let image::DynamicImage::ImageLuma16(image) = image else {
        bail!("it is {:?}, not 16-bit grey", image.color());
    };
    Ok(Metres { width, height, pixels: units(image.into_raw().into_iter(), unit_m) })
}

fn tiff(bytes: &[u8], unit_m: f64) -> Result<Metres> {
    use tiff::decoder::{Decoder, DecodingResult};
    let mut decoder = Decoder::new(std::io::Cursor::new(bytes))?;
    let (width, height) = decoder.dimensions()?;
    let width = width as usize;
    let height = height as usize;
    let pixels = match decoder.read_image()? {
        DecodingResult::U16(v) => units(v.into_iter(), unit_m),
        DecodingResult::F32(v) => v,
        DecodingResult::F64(v) => v.into_iter().map(|d| d as f32).collect(),
        _ => bail!("its numbers are neither 16-bit units nor metres as floating point"),
    };
    if pixels.len() != width * height {
        bail!("it is not one number a pixel");
    }
    Ok(Metres { width, height, pixels })
}

fn npy(bytes: &[u8], unit_m: f64) -> Result<Metres> {
    let Array { kind, shape, data } = npy::read(bytes).map_err(anyhow::Error::msg)?;
    let ([height, width]
    | [1, height, width]
    | [height, width, 1]
    | [1, height, width, 1]
    | [1, 1, height, width]) = shape[..]
    else {
        bail!("shape {shape:?} is not that of one image");
    };
    if width == 0 || height == 0 || width > MAX_SIDE || height > MAX_SIDE {
        bail!("unsupported shape {shape:?}; an image has two dimensions");
    }
    let pixels = match kind {
        "<u2" => units(data.as_chunks::<2>().0.iter().map(|b| u16::from_le_bytes(*b)), unit_m),
        "<f2" => data.as_chunks::<2>().0.iter().map(|b| half(u16::from_le_bytes(*b))).collect(),
        "<f4" => data.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect(),
        "<f8" => data.as_chunks::<8>().0.iter().map(|b| f64::from_le_bytes(*b) as f32).collect(),
        other => bail!("its numbers are {other}; <u2, <f2, <f4 and <f8 can be read"),
    };
    Ok(Metres { width, height, pixels })
}

/// A 16-bit float of IEEE 754.
fn half(bits: u16) -> f32 {
    let sign = bits >> 15;
    let exponent = (bits >> 10) & 31;
    let part = bits & 1023;
    let value = match exponent {
        0 => f32::from(part) * 2f32.powi(-24),
        31 => f32::NAN,
        e => (1.0 + f32::from(part) / 1024.0) * 2f32.powi(i32::from(e) - 15),
    };
    if sign == 1 { -value } else { value }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn arrays_of_every_kind() {
        let metres = [0.5f32, 1.0, 0.0, 2.0];
        let of =
            |kind: &str, shape: &[usize], data: Vec<u8>| npy(&npy::file(kind, shape, &data), 0.001).unwrap();
        let f4 = metres.iter().flat_map(|v| v.to_le_bytes()).collect();
        assert_eq!(of("<f4", &[2, 2], f4), Metres { width: 2, height: 2, pixels: metres.to_vec() });
        let f8 = metres.iter().flat_map(|v| f64::from(*v).to_le_bytes()).collect();
        assert_eq!(of("<f8", &[1, 1, 4], f8).pixels, metres);
        let f2 = [0x3800u16, 0x3c00, 0, 0x4000].iter().flat_map(|v| v.to_le_bytes()).collect();
        assert_eq!(of("<f2", &[4, 1, 1], f2).pixels, metres);
        let u2 = [500u16, 1000, 65535, 2000].iter().flat_map(|v| v.to_le_bytes()).collect();
        assert_eq!(of("<u2", &[1, 4], u2).pixels, metres);
    }

    #[test]
    fn what_is_no_image_is_refused() {
        for (kind, shape, n) in [
            ("<f4", &[2, 2][..], 15),
            ("<f4", &[2, 2, 3], 48),
            ("|u1", &[2, 2], 4),
            ("<f4", &[0, 2], 0),
            ("<f4", &[9_999_999, 9_999_999], 4),
        ] {
            assert!(npy(&npy::file(kind, shape, &vec![0; n]), 0.001).is_err(), "{kind} {shape:?} {n}");
        }
        for bytes in [&b""[..], b"\x93NUMPY", b"\x93NUMPY\x01\x00\xff\xff{"] {
            assert!(npy(bytes, 0.001).is_err() && png(bytes, 0.001).is_err() && tiff(bytes, 0.001).is_err());
        }
    }
}
