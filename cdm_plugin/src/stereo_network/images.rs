//! Images into a network's numbers and back: a border where it takes every size, another size where it takes one.

use super::form::Plane;
use depthrig_calib::stereo::Gray;

/// From the size of the images to that of the network.
#[derive(Debug, Clone, Copy)]
pub struct Fit {
    /// Width and height of the images.
    pub size: (usize, usize),
    /// Width and height of the network's input.
    pub inner: (usize, usize),
    /// The image is resized; else its last column and row are repeated.
    pub resized: bool,
}

/// The left or the right image.
pub struct Image<'a> {
    pub grey: Gray<'a>,
    pub rgb: Option<&'a [u8]>,
}

impl Image<'_> {
    fn at(&self, x: usize, y: usize, channel: usize, width: usize) -> f32 {
        let byte = match self.rgb {
            Some(rgb) => rgb.get((y * width + x) * 3 + channel),
            None => self.grey.pixels.get(y * self.grey.stride + x),
        };
        byte.copied().map_or(0.0, f32::from)
    }
}

/// Where a channel lies among a network's numbers.
#[derive(Debug, Clone, Copy)]
pub struct Place {
    pub start: usize,
    /// From one pixel to the next.
    pub step: usize,
}

/// Factor and offset for the bytes of a channel.
#[derive(Clone, Copy)]
pub struct Scale {
    pub factor: f32,
    pub offset: f32,
}

/// Writes one channel of an image, each byte scaled. Another size is interpolated between four pixels, with the corners
/// of the images aligned.
pub fn fill(fit: Fit, image: &Image<'_>, channel: usize, scale: Scale, place: Place, out: &mut [f32]) {
    let (width, height) = fit.size;
    let (inner_width, inner_height) = fit.inner;
    let mut cells = out.iter_mut().skip(place.start).step_by(place.step);
    let ratio = |a: usize, b: usize| a as f32 / b.max(1) as f32;
    let rx = ratio(width, inner_width);
    let ry = ratio(height, inner_height);
    // The pixel before a place, the one behind it, and how far it is on the way from one to the other.
    let between = |i: usize, r: f32, n: usize| {
        let at = ((i as f32 + 0.5) * r - 0.5).clamp(0.0, (n - 1) as f32);
        (at as usize, (at as usize + 1).min(n - 1), at.fract())
    };
    for y in 0..inner_height {
        let (y0, y1, fy) = between(y, ry, height);
        for x in 0..inner_width {
            let Some(cell) = cells.next() else { return };
            let value = if fit.resized {
                let (x0, x1, fx) = between(x, rx, width);
                let row = |y| {
                    let a = image.at(x0, y, channel, width);
                    let b = image.at(x1, y, channel, width);
                    a + (b - a) * fx
                };
                let a = row(y0);
                let b = row(y1);
                a + (b - a) * fy
            } else {
                image.at(x.min(width - 1), y.min(height - 1), channel, width)
            };
            *cell = value * scale.factor + scale.offset;
        }
    }
}

impl Fit {
    /// Which of the network's pixels a pixel of the image gets its disparity from: the nearest, because the mean of a
    /// near and a far one is a place where nothing is.
    fn source(self, x: usize, y: usize) -> usize {
        let along = |i: usize, size: usize, inner: usize| {
            if self.resized { ((2 * i + 1) * inner / (2 * size)).min(inner - 1) } else { i }
        };
        along(y, self.size.1, self.inner.1) * self.inner.0 + along(x, self.size.0, self.inner.0)
    }
}

/// Converts the network's output to disparities of the image, NaN where a match would lie outside the right image.
/// Returns the share of numbers with the wrong sign.
pub fn disparity(fit: Fit, plane: Plane, numbers: &[f32], negative: bool, out: &mut [f32]) -> f64 {
    let (width, _) = fit.size;
    let scale = if fit.resized { width as f32 / fit.inner.0 as f32 } else { 1.0 };
    let scale = if negative { -scale } else { scale };
    let mut some = 0_u64;
    let mut below = 0_u64;
    for (y, row) in out.chunks_exact_mut(width).enumerate() {
        for (x, d) in row.iter_mut().enumerate() {
            let value = numbers.get(fit.source(x, y) * plane.step).copied().unwrap_or(f32::NAN) * scale;
            some += u64::from(value.is_finite() && value != 0.0);
            below += u64::from(value.is_finite() && value < 0.0);
            *d = if value >= 0.0 && value <= x as f32 { value } else { f32::NAN };
        }
    }
    below as f64 / some.max(1) as f64
}

/// Confidence of each pixel: 0 without a disparity; else the network's 0 to 1 as 1 to 255, and 255 where it gives none.
pub fn confidence(fit: Fit, plane: Option<(Plane, &[f32])>, disparity: &[f32], out: &mut [u8]) {
    let (width, _) = fit.size;
    for (y, (row, depths)) in out.chunks_exact_mut(width).zip(disparity.chunks_exact(width)).enumerate() {
        for (x, (c, d)) in row.iter_mut().zip(depths).enumerate() {
            let sure = plane.map_or(1.0, |(plane, numbers)| {
                numbers.get(fit.source(x, y) * plane.step).copied().unwrap_or(0.0)
            });
            let sure = if sure.is_nan() { 0.0 } else { sure.clamp(0.0, 1.0) };
            *c = if d.is_nan() { 0 } else { 1 + (sure * 254.0).round() as u8 };
        }
    }
}
