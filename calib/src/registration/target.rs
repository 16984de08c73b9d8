//! An image in which the nearest depth wins.
//!
//! While it is drawn, a pixel holds `depth − 1`, so that nothing (0) is larger than everything: one unsigned minimum
//! decides, and the order of drawing does not matter.

/// Value of an empty pixel while an image is drawn.
pub(super) const EMPTY: u16 = u16::MAX;

/// The key that is compared for a depth value; [`EMPTY`] for a hole.
pub(super) const fn key(depth: u16) -> u16 {
    depth.wrapping_sub(1)
}

/// An image that is being drawn.
pub(super) struct Target<'a> {
    pub(super) pixels: &'a mut [u16],
    pub(super) width: usize,
}

impl<'a> Target<'a> {
    /// An empty image in this memory.
    pub(super) fn new(pixels: &'a mut [u16], width: usize) -> Self {
        pixels.fill(EMPTY);
        Self { pixels, width }
    }
}

/// From keys to depth.
pub(super) fn finish(pixels: &mut [u16]) {
    for pixel in pixels {
        *pixel = pixel.wrapping_add(1);
    }
}

/// The nearest of several images.
pub(super) fn merge<'a>(mut images: impl Iterator<Item = &'a [u16]>, out: &mut [u16]) {
    let Some(first) = images.next() else { return };
    out.copy_from_slice(first);
    for image in images {
        for (out, new) in out.iter_mut().zip(image) {
            *out = (*out).min(*new);
        }
    }
}
