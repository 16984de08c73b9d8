//! A picture in which the nearest depth wins.
//!
//! While it is drawn, a pixel holds `depth − 1`, so that nothing (0) is larger than everything: one unsigned minimum
//! decides, and the order of drawing does not matter.

/// What an empty pixel holds while a picture is drawn.
pub(super) const EMPTY: u16 = u16::MAX;

/// What is compared for a depth value; [`EMPTY`] for a hole.
pub(super) const fn key(depth: u16) -> u16 {
    depth.wrapping_sub(1)
}

/// A picture that is being drawn.
pub(super) struct Target<'a> {
    pub(super) pixels: &'a mut [u16],
    pub(super) width: usize,
}

impl<'a> Target<'a> {
    /// An empty picture in this memory.
    pub(super) fn new(pixels: &'a mut [u16], width: usize) -> Self {
        pixels.fill(EMPTY);
        Self { pixels, width }
    }

    /// From what is compared back to depth.
    pub(super) fn finish(self) {
        for pixel in self.pixels {
            *pixel = pixel.wrapping_add(1);
        }
    }
}

/// The nearest of several pictures that are not finished, as depth.
pub(super) fn merge<'a>(mut pictures: impl Iterator<Item = &'a [u16]>, out: &mut [u16]) {
    let Some(first) = pictures.next() else { return };
    out.copy_from_slice(first);
    for picture in pictures {
        for (out, new) in out.iter_mut().zip(picture) {
            *out = (*out).min(*new);
        }
    }
    for pixel in out {
        *pixel = pixel.wrapping_add(1);
    }
}
