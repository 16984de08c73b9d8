//! Where each pixel of a rectified view comes from, computed once, and the passes over a picture.

use crate::Camera;
use depthrig_bus::Intrinsics;
use glam::{DMat3, DVec3};

/// A pixel's source: four pixels in a square and the weights of the right and of the lower ones, 0 to 256.
#[derive(Debug, Clone, Copy)]
struct Entry {
    /// Number of the upper left one, [`OUTSIDE`] where the eye sees nothing.
    at: u32,
    right: u16,
    below: u16,
}

const OUTSIDE: u32 = u32::MAX;
/// Parts of a pixel.
const PARTS: f64 = 256.0;

/// The table of one view.
#[derive(Debug, Clone)]
pub(super) struct Map {
    width: usize,
    entries: Vec<Entry>,
}

impl Map {
    /// For the eye `camera`, which `rotation` turns into a view with the intrinsics `view`; both have `size`, whose sides
    /// are at least 2.
    pub(super) fn new(camera: &Camera, rotation: DMat3, view: &Intrinsics, size: (u32, u32)) -> Self {
        let back = rotation.transpose();
        let (w, h) = (f64::from(size.0), f64::from(size.1));
        let entry = |x: u32, y: u32| {
            let ray = DVec3::new((f64::from(x) - view.cx) / view.fx, (f64::from(y) - view.cy) / view.fy, 1.0);
            let at = camera.project(back * ray)?;
            // What is seen ends half a part outside of the last pixel's centre, which then rounds to it.
            let near = 0.5 / PARTS;
            let inside = at.x >= -near && at.y >= -near && at.x <= w - 1.0 + near && at.y <= h - 1.0 + near;
            if !inside {
                return None;
            }
            let split = |v: f64, size: u32| {
                let parts = (v * PARTS).round().max(0.0) as u32;
                // The last pixel is the right one of its pair, with all the weight.
                let first = (parts / 256).min(size - 2);
                (first, (parts - first * 256).min(256) as u16)
            };
            let ((x, right), (y, below)) = (split(at.x, size.0), split(at.y, size.1));
            Some(Entry { at: y * size.0 + x, right, below })
        };
        let pixels = (0..size.1).flat_map(|y| (0..size.0).map(move |x| (x, y)));
        let none = Entry { at: OUTSIDE, right: 0, below: 0 };
        Self { width: size.0 as usize, entries: pixels.map(|(x, y)| entry(x, y).unwrap_or(none)).collect() }
    }

    /// Column and row that pixel number `i` comes from.
    pub(super) fn source(&self, i: usize) -> Option<(f64, f64)> {
        let e = self.entries.get(i).filter(|e| e.at != OUTSIDE)?;
        let at = e.at as usize;
        let part = |v: u16| f64::from(v) / PARTS;
        Some(((at % self.width) as f64 + part(e.right), (at / self.width) as f64 + part(e.below)))
    }

    /// A picture of `N` bytes a pixel.
    pub(super) fn bytes<const N: usize>(&self, picture: &[u8], out: &mut [u8]) {
        let row = self.width * N;
        for (out, e) in out.chunks_exact_mut(N).zip(&self.entries) {
            let at = e.at as usize * N;
            let [Some(top), Some(bottom)] = [at, at + row].map(|i| picture.get(i..i + 2 * N)) else {
                out.fill(0);
                continue;
            };
            for (c, out) in out.iter_mut().enumerate() {
                *out = e.mix([top[c], top[c + N], bottom[c], bottom[c + N]]);
            }
        }
    }

    /// Grey out of red, green, blue.
    pub(super) fn grey_from_rgb(&self, picture: &[u8], out: &mut [u8]) {
        let row = self.width * 3;
        for (out, e) in out.iter_mut().zip(&self.entries) {
            let at = e.at as usize * 3;
            *out = match [at, at + row].map(|i| picture.get(i..i + 6)) {
                [Some(t), Some(b)] => luma([0, 1, 2].map(|c| e.mix([t[c], t[c + 3], b[c], b[c + 3]]))),
                _ => 0,
            };
        }
    }

    /// Grey out of YUYV.
    pub(super) fn grey_from_yuyv(&self, picture: &[u8], out: &mut [u8]) {
        let row = self.width * 2;
        for (out, e) in out.iter_mut().zip(&self.entries) {
            let at = e.at as usize * 2;
            *out = match [at, at + row].map(|i| picture.get(i..i + 3)) {
                [Some(t), Some(b)] => e.mix([t[0], t[2], b[0], b[2]]),
                _ => 0,
            };
        }
    }

    /// Red, green, blue out of YUYV, whose width is even. Both pixels of a pair have its colour, as in `OpenCV`; mixing before or after the
    /// change to red, green, blue is the same but for what is cut off at 0 and 255.
    pub(super) fn rgb_from_yuyv(&self, picture: &[u8], out: &mut [u8]) {
        let row = self.width * 2;
        for (out, e) in out.chunks_exact_mut(3).zip(&self.entries) {
            // From the pair of the left pixel to the end of that of the right one: four bytes, or eight.
            let first = e.at as usize;
            let odd = first % 2;
            let at = (first - odd) * 2;
            let pairs = [at, at + row].map(|i| picture.get(i..i + 4 + 4 * odd));
            let [Some(t), Some(b)] = pairs else {
                out.fill(0);
                continue;
            };
            let (left, right) = (2 * odd, 2 * odd + 2);
            let other = 4 * odd;
            let y = e.mix([t[left], t[right], b[left], b[right]]);
            let u = e.mix([t[1], t[1 + other], b[1], b[1 + other]]);
            let v = e.mix([t[3], t[3 + other], b[3], b[3 + other]]);
            out.copy_from_slice(&rgb_of_yuv(y, u, v));
        }
    }
}

impl Entry {
    /// The mean of upper left, upper right, lower left and lower right, by their weights.
    #[inline]
    fn mix(self, [a, b, c, d]: [u8; 4]) -> u8 {
        let (r, l) = (u32::from(self.right), 256 - u32::from(self.right));
        let top = u32::from(a) * l + u32::from(b) * r;
        let bottom = u32::from(c) * l + u32::from(d) * r;
        ((top * (256 - u32::from(self.below)) + bottom * u32::from(self.below) + (1 << 15)) >> 16) as u8
    }
}

/// Luminance by BT.601, in 14 bits as `OpenCV`'s `cvtColor` has it.
#[inline]
fn luma([r, g, b]: [u8; 3]) -> u8 {
    ((4899 * u32::from(r) + 9617 * u32::from(g) + 1868 * u32::from(b) + (1 << 13)) >> 14) as u8
}

/// Red, green, blue by BT.601 with luminance within 16 and 235, in 20 bits as `OpenCV`'s `cvtColor` has it.
#[inline]
fn rgb_of_yuv(y: u8, u: u8, v: u8) -> [u8; 3] {
    const HALF: i32 = 1 << 19;
    let y = (i32::from(y) - 16).max(0) * 1_220_542;
    let (u, v) = (i32::from(u) - 128, i32::from(v) - 128);
    let red = y + 1_673_527 * v;
    let green = y - 852_492 * v - 409_993 * u;
    let blue = y + 2_116_026 * u;
    [red, green, blue].map(|c| ((c + HALF) >> 20).clamp(0, 255) as u8)
}
