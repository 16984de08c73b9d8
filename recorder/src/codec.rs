//! The depth codec of depthrig: small and lossless, for 16-bit images. `docs/dataset-format.md`, "Depth codec",
//! has it byte by byte.
//!
//! A depth camera measures few different distances: a stereo camera some hundred disparities, whatever the depth
//! unit is. So each value becomes its rank among the values of the image, the rank is predicted from its
//! neighbours (the median edge detector of LOCO-I / JPEG-LS: Weinberger, Seroussi, Sapiro, IEEE TIP 9(8), 2000),
//! and what is left is split into low and high bytes and packed with Zstandard at level 1.

use crate::{Error, ErrorKind, Result};

mod decoder;
mod encoder;

pub use decoder::DepthDecoder;
pub use encoder::DepthEncoder;

/// The codec's name with its version, as a message says it.
pub const DEPTH_CODEC: &str = "rank/1";

/// Unpacked images above this many bytes are refused: 16384x8192 of 16 bit.
const IMAGE_MAX: u64 = 1 << 28;
/// Bytes before the Zstandard frame: the number of values in the palette.
const HEAD: usize = 4;
/// A Zstandard block holds at most 128 KiB and takes at least four bytes (RFC 8878, 3.1.1.2), so that a short
/// input cannot ask for much memory.
const EXPANSION_MAX: u64 = (128 << 10) / 4;

/// The shape of a 16-bit image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DepthShape {
    /// Pixels per row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Bytes from row to row, at least two per pixel; what is beyond the pixels is padding.
    pub step: u32,
}

impl DepthShape {
    /// Bytes of the image, padding included.
    pub fn bytes(&self) -> u64 {
        u64::from(self.step) * u64::from(self.height)
    }

    const fn pixels(&self) -> usize {
        self.width as usize * self.height as usize
    }

    /// Bytes of a row that are pixels.
    const fn row(&self) -> usize {
        2 * self.width as usize
    }

    /// Bytes of padding in the image.
    const fn padding(&self) -> usize {
        (self.step as usize - self.row()) * self.height as usize
    }

    fn check(&self) -> Result<()> {
        let Self { width, height, step } = *self;
        if width == 0 || height == 0 || u64::from(step) < 2 * u64::from(width) {
            return Err(bad(format!(
                "{width}x{height} of 16 bit with {step} bytes per row is not a valid image"
            )));
        }
        if self.bytes() > IMAGE_MAX {
            return Err(bad(format!(
                "{width}x{height} with {step} bytes per row is too large for this codec"
            )));
        }
        Ok(())
    }
}

fn bad(what: impl core::fmt::Display) -> Error {
    Error::new(ErrorKind::Codec, format!("a depth image: {what}"))
}

/// A table with a place for each 16-bit value, so that a value is an index that needs no check.
type Table<T> = Box<[T; 1 << 16]>;

// On the heap: 128 KiB is too much for the stack of a worker thread.
#[allow(clippy::unnecessary_box_returns)]
fn table<T: Copy + Default>() -> Table<T> {
    match vec![T::default(); 1 << 16].into_boxed_slice().try_into() {
        Ok(table) => table,
        Err(_) => unreachable!("the vector has 1 << 16 elements"),
    }
}

#[cfg(test)]
mod tests;
