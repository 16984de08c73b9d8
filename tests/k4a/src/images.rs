//! The cameras' images, each of which encodes its own number, so that a test can identify it.

use crate::abi::{BGRA32, DEPTH16, IR16, MJPG, NV12};
use jpeg_encoder::{ColorType, Encoder};

/// So many different JPEG images come in turn.
pub const JPEGS: u64 = 4;

/// Bytes of an image of `format`, which is not a compressed one.
fn bytes(format: u32, width: u32, height: u32) -> usize {
    let pixels = width as usize * height as usize;
    match format {
        NV12 => pixels * 3 / 2,
        BGRA32 => pixels * 4,
        _ => pixels * 2,
    }
}

/// Image number `n`.
pub fn image(format: u32, width: u32, height: u32, n: u64) -> Vec<u8> {
    match format {
        MJPG => jpeg(width, height, n),
        DEPTH16 => grid(width, height, |x, y| (500 + (x + 3 * y + 7 * n) % 4000) as u16),
        IR16 => grid(width, height, |x, y| (1 + (5 * x + 11 * y + 13 * n) % 4001) as u16),
        _ => (0..bytes(format, width, height)).map(|i| (i as u64 * 31 + n * 17) as u8).collect(),
    }
}

fn grid(width: u32, height: u32, value: impl Fn(u64, u64) -> u16) -> Vec<u8> {
    let mut out = Vec::with_capacity(bytes(DEPTH16, width, height));
    for y in 0..u64::from(height) {
        for x in 0..u64::from(width) {
            out.extend(value(x, y).to_le_bytes());
        }
    }
    out
}

/// Whether `pixels` are an image that [`image`] makes, whichever; of JPEG and of images without alpha see there.
pub fn is_genuine(format: u32, width: u32, height: u32, pixels: &[u8]) -> bool {
    // Each kind repeats after so many numbers.
    let turns = match format {
        MJPG => JPEGS,
        DEPTH16 => 4000,
        IR16 => 4001,
        _ => 256,
    };
    let same_start = |n: &u64| match (format, pixels) {
        (MJPG, _) => true,
        (DEPTH16 | IR16, [a, b, ..]) => image(format, 1, 1, *n) == [*a, *b],
        (_, [a, ..]) => (*n * 17) as u8 == *a,
        _ => false,
    };
    (0..turns).filter(same_start).any(|n| image(format, width, height, n) == pixels)
}

/// Coloured bars that move with the number.
fn jpeg(width: u32, height: u32, n: u64) -> Vec<u8> {
    let n = n % JPEGS;
    let mut rgb = Vec::with_capacity(width as usize * height as usize * 3);
    for y in 0..u64::from(height) {
        for x in 0..u64::from(width) {
            let bar = (x / 16 + y / 16 + n * 5) * 40;
            rgb.extend([bar as u8, (bar * 3 + 60 * n) as u8, (255 - bar % 256) as u8]);
        }
    }
    let mut out = Vec::new();
    let w = u16::try_from(width).unwrap_or(16);
    let h = u16::try_from(height).unwrap_or(16);
    // An image that cannot be encoded is an empty one, which no test takes for good.
    if Encoder::new(&mut out, 80).encode(&rgb, w, h, ColorType::Rgb).is_err() {
        out.clear();
    }
    out
}
