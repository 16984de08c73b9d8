//! Reads depth from image files: 16-bit PNG and TIFF in a given unit, NPY and TIFF in metres.

use anyhow::{Context, Result, bail};
use depthrig_bus::files;
use depthrig_cdm::stage::pixels::UNIT_OF_METRES;
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

/// Raw depth as a refiner gets it.
#[derive(Debug, Clone, PartialEq)]
pub struct Raw {
    /// Pixels per row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// The pixels; 0 is a hole, and so is 65535.
    pub pixels: Vec<u16>,
    /// Metres per unit.
    pub unit_m: f64,
}

impl Raw {
    /// In metres.
    pub fn metres(&self) -> Metres {
        let pixels = units(self.pixels.iter().copied(), self.unit_m);
        Metres { width: self.width, height: self.height, pixels }
    }

    /// Makes depth beyond `max_m` a hole.
    pub fn cut(&mut self, max_m: f64) {
        for v in &mut self.pixels {
            if f64::from(*v) * self.unit_m > max_m {
                *v = 0;
            }
        }
    }
}

impl Metres {
    /// At another size: the nearest pixel of each, so that no depth between two surfaces arises.
    pub fn resized(&self, (width, height): (usize, usize)) -> Self {
        let along = |i: usize, n: usize, of: usize| ((2 * i + 1) * of / (2 * n)).min(of - 1);
        let row = |y: usize| along(y, height, self.height) * self.width;
        let rows = (0..height).flat_map(|y| (0..width).map(move |x| (x, y)));
        let pixels = rows.map(|(x, y)| self.pixels[row(y) + along(x, width, self.width)]).collect();
        Self { width, height, pixels }
    }
}

/// Extensions of supported files.
pub const ENDINGS: [&str; 4] = ["png", "npy", "tiff", "tif"];

/// Depth as a file holds it.
enum Stored {
    Units(Vec<u16>),
    Metres(Vec<f32>),
}

struct Image {
    width: usize,
    height: usize,
    stored: Stored,
}

impl Image {
    fn metres(self, unit_m: f64) -> Metres {
        let pixels = match self.stored {
            Stored::Units(v) => units(v.into_iter(), unit_m),
            Stored::Metres(v) => v,
        };
        Metres { width: self.width, height: self.height, pixels }
    }
}

/// Reads `path`. Whole numbers are taken times `unit_m`, floating-point ones are metres; `65535` of 16 bits says that a
/// range ended, and is a hole.
pub fn depth(path: &Path, unit_m: f64) -> Result<Metres> {
    Ok(image(path)?.metres(unit_m))
}

/// Reads raw depth. Metres are put into units of 0.1 mm, as the daemon does.
pub fn raw(path: &Path, unit_m: f64) -> Result<Raw> {
    let Image { width, height, stored } = image(path)?;
    let (pixels, unit_m) = match stored {
        Stored::Units(v) => (v, unit_m),
        Stored::Metres(v) => (to_units(&v), UNIT_OF_METRES),
    };
    Ok(Raw { width, height, pixels, unit_m })
}

/// Metres as units of 0.1 mm; what is not above 0 or beyond them is 0.
pub fn to_units(metres: &[f32]) -> Vec<u16> {
    let unit = |m: &f32| {
        let v = f64::from(*m) / UNIT_OF_METRES;
        if v > 0.0 && v < 65534.5 { (v + 0.5) as u16 } else { 0 }
    };
    metres.iter().map(unit).collect()
}

fn image(path: &Path) -> Result<Image> {
    let read = || -> Result<Image> {
        let bytes = files::read(path, files::IMAGE_MAX_BYTES)?;
        match path.extension().and_then(|e| e.to_str()).map(str::to_lowercase).as_deref() {
            Some("npy") => npy(&bytes),
            Some("tif" | "tiff") => tiff(&bytes),
            _ => {
                let (size, v) = png16(&bytes)?;
                Ok(Image { width: size.0, height: size.1, stored: Stored::Units(v) })
            }
        }
    };
    read().with_context(|| format!("{}: cannot be read as depth", path.display()))
}

/// Width, height and pixels of a PNG of 8-bit grey: numbers of materials.
pub fn png8(bytes: &[u8]) -> Result<((usize, usize), Vec<u8>)> {
    let image = image::load_from_memory_with_format(bytes, image::ImageFormat::Png)?;
    let size = (image.width() as usize, image.height() as usize);
    let image::DynamicImage::ImageLuma8(image) = image else {
        bail!("it is {:?}, not 8-bit grey", image.color());
    };
    Ok((size, image.into_raw()))
}

fn units(values: impl Iterator<Item = u16>, unit_m: f64) -> Vec<f32> {
    values.map(|v| if v == u16::MAX { 0.0 } else { (f64::from(v) * unit_m) as f32 }).collect()
}

/// Width, height and pixels of a PNG of 16-bit grey.
pub fn png16(bytes: &[u8]) -> Result<((usize, usize), Vec<u16>)> {
    let image = image::load_from_memory_with_format(bytes, image::ImageFormat::Png)?;
    let size = (image.width() as usize, image.height() as usize);
    let image::DynamicImage::ImageLuma16(image) = image else {
        bail!("it is {:?}, not 16-bit grey", image.color());
    };
    Ok((size, image.into_raw()))
}

fn tiff(bytes: &[u8]) -> Result<Image> {
    use tiff::decoder::{Decoder, DecodingResult};
    let mut decoder = Decoder::new(std::io::Cursor::new(bytes))?;
    let (width, height) = decoder.dimensions()?;
    let width = width as usize;
    let height = height as usize;
    let stored = match decoder.read_image()? {
        DecodingResult::U16(v) => Stored::Units(v),
        DecodingResult::F32(v) => Stored::Metres(v),
        DecodingResult::F64(v) => Stored::Metres(v.into_iter().map(|d| d as f32).collect()),
        _ => bail!("its numbers are neither 16-bit units nor metres as floating point"),
    };
    let count = match &stored {
        Stored::Units(v) => v.len(),
        Stored::Metres(v) => v.len(),
    };
    if count != width * height {
        bail!("it is not one number a pixel");
    }
    Ok(Image { width, height, stored })
}

fn npy(bytes: &[u8]) -> Result<Image> {
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
    let stored = match kind {
        "<u2" => Stored::Units(data.as_chunks::<2>().0.iter().map(|b| u16::from_le_bytes(*b)).collect()),
        "<f2" => {
            Stored::Metres(data.as_chunks::<2>().0.iter().map(|b| half(u16::from_le_bytes(*b))).collect())
        }
        "<f4" => Stored::Metres(data.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect()),
        "<f8" => {
            Stored::Metres(data.as_chunks::<8>().0.iter().map(|b| f64::from_le_bytes(*b) as f32).collect())
        }
        other => bail!("its numbers are {other}; <u2, <f2, <f4 and <f8 can be read"),
    };
    Ok(Image { width, height, stored })
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
        let of = |kind: &str, shape: &[usize], data: Vec<u8>| {
            npy(&npy::file(kind, shape, &data)).unwrap().metres(0.001)
        };
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
    fn raw_depth_keeps_its_units_and_metres_become_tenths_of_millimetres() {
        assert_eq!(to_units(&[1.0, 0.00004, 6.5534, 6.6, f32::NAN, -1.0]), [10_000, 0, 65_534, 0, 0, 0]);
        let mut raw = Raw { width: 4, height: 1, pixels: vec![0, 6000, 6001, u16::MAX], unit_m: 0.001 };
        assert_eq!(raw.metres().pixels, [0.0, 6.0, 6.001, 0.0]);
        raw.cut(6.0);
        assert_eq!(raw.pixels, [0, 6000, 0, 0]);
    }

    #[test]
    fn another_size_takes_the_nearest_pixels() {
        let m = Metres { width: 2, height: 2, pixels: vec![1.0, 2.0, 3.0, 4.0] };
        let big = m.resized((4, 2));
        assert_eq!(big.pixels, [1.0, 1.0, 2.0, 2.0, 3.0, 3.0, 4.0, 4.0]);
        assert_eq!(big.resized((2, 2)), m);
        assert_eq!(m.resized((1, 1)).pixels, [4.0]);
        assert_eq!(m.resized((3, 1)).pixels, [3.0, 4.0, 4.0]);
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
            assert!(npy(&npy::file(kind, shape, &vec![0; n])).is_err(), "{kind} {shape:?} {n}");
        }
        for bytes in [&b""[..], b"\x93NUMPY", b"\x93NUMPY\x01\x00\xff\xff{"] {
            assert!(npy(bytes).is_err() && png16(bytes).is_err() && tiff(bytes).is_err());
        }
    }
}
