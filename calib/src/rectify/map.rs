//! The source of each pixel of a rectified view, computed once, and the loops that apply it to an image.
//! A loop works in pieces: pixels from anywhere in the image are gathered into rows of words, and the arithmetic on
//! those is compiled for the processor's vectors.

use crate::Camera;
use crate::simd::for_every_processor;
use crate::stereo::RowOffset;
use depthrig_bus::Intrinsics;
use glam::{DMat3, DVec3};

/// Parts of a pixel.
const PARTS: f64 = 256.0;
/// Pixels of a piece.
const PIECE: usize = 256;

/// The table of one view. A pixel comes from four in a square.
#[derive(Debug, Clone)]
pub(super) struct Map {
    width: usize,
    /// Number of the upper left one.
    at: Vec<u32>,
    /// Weight of the right ones, 0 to 256.
    right: Vec<u16>,
    /// Weight of the lower ones, 0 to 256.
    below: Vec<u16>,
    /// Pixels that the camera does not see, rising. Their places are 0.
    outside: Vec<u32>,
}

/// A channel of a piece: of each pixel the left byte of a row, and 16 bits above it the right one.
#[derive(Clone, Copy)]
struct Channel {
    top: [u32; PIECE],
    bottom: [u32; PIECE],
}

impl Channel {
    const EMPTY: Self = Self { top: [0; PIECE], bottom: [0; PIECE] };
}

impl Map {
    /// For `camera`, which `rotation` turns into a view with the intrinsics `view`; both have `size`, whose sides
    /// are at least 2. What lies lower in that view by `rows` is moved up.
    pub(super) fn new(
        camera: &Camera,
        rotation: DMat3,
        view: &Intrinsics,
        size: (u32, u32),
        rows: Option<&RowOffset>,
    ) -> Self {
        let back = rotation.transpose();
        let w = f64::from(size.0);
        let h = f64::from(size.1);
        let entry = |x: u32, y: u32| {
            let lower = rows.map_or(0.0, |rows| rows.at(f64::from(x) / w, f64::from(y) / h));
            let row = f64::from(y) + lower;
            let ray = DVec3::new((f64::from(x) - view.cx) / view.fx, (row - view.cy) / view.fy, 1.0);
            let at = camera.project(back * ray)?;
            // The visible area ends half a part outside of the last pixel's centre, which then rounds to it.
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
            let (x, right) = split(at.x, size.0);
            let (y, below) = split(at.y, size.1);
            Some((y * size.0 + x, right, below))
        };
        let none = Vec::new();
        let mut map = Self {
            width: size.0 as usize,
            at: Vec::new(),
            right: Vec::new(),
            below: Vec::new(),
            outside: none,
        };
        for (i, (x, y)) in (0..).zip((0..size.1).flat_map(|y| (0..size.0).map(move |x| (x, y)))) {
            let seen = entry(x, y);
            if seen.is_none() {
                map.outside.push(i);
            }
            let (at, right, below) = seen.unwrap_or_default();
            map.at.push(at);
            map.right.push(right);
            map.below.push(below);
        }
        map
    }

    /// Column and row that pixel number `i` comes from.
    pub(super) fn source(&self, i: usize) -> Option<(f64, f64)> {
        let seen = self.outside.binary_search(&(i as u32)).is_err();
        let at = *self.at.get(i).filter(|_| seen)? as usize;
        let part = |of: &[u16]| f64::from(of[i]) / PARTS;
        Some(((at % self.width) as f64 + part(&self.right), (at / self.width) as f64 + part(&self.below)))
    }

    /// A grey image out of one.
    pub(super) fn grey(&self, image: &[u8], grey: &mut [u8]) {
        let mut words = Channel::EMPTY;
        for (from, out) in self.pieces().zip(grey.chunks_mut(PIECE)) {
            from.fetch([&mut words], |at| {
                [[at, at + self.width].map(|at| {
                    let two = bytes::<2>(image, at);
                    u32::from(two[0]) | u32::from(two[1]) << 16
                })]
            });
            from.mix(&words, out);
        }
        self.blank::<1>(grey);
    }

    /// Grey and, if requested, red, green, blue, out of red, green, blue.
    pub(super) fn rgb(&self, image: &[u8], grey: &mut [u8], mut rgb: Option<&mut [u8]>) {
        let row = 3 * self.width;
        let mut words = [Channel::EMPTY; 3];
        let mut planes = [[0; PIECE]; 3];
        for (i, (from, out)) in self.pieces().zip(grey.chunks_mut(PIECE)).enumerate() {
            let n = out.len();
            from.fetch(words.each_mut(), |at| {
                let [top, bottom] = [3 * at, 3 * at + row].map(|at| bytes::<6>(image, at));
                [0, 1, 2].map(|c| [top, bottom].map(|p| u32::from(p[c]) | u32::from(p[c + 3]) << 16))
            });
            for (words, plane) in words.iter().zip(&mut planes) {
                from.mix(words, &mut plane[..n]);
            }
            let [r, g, b] = planes.each_ref().map(|p| &p[..n]);
            luma(r, g, b, out);
            if let Some(rgb) = &mut rgb {
                interleave(&planes, &mut rgb[3 * i * PIECE..][..3 * n]);
            }
        }
        self.blank::<1>(grey);
        if let Some(rgb) = rgb {
            self.blank::<3>(rgb);
        }
    }

    /// Grey and, if requested, red, green, blue, out of YUYV, whose width is even. Both pixels of a pair have its
    /// colour, as in `OpenCV`; mixing before or after the change to red, green, blue is the same but for what is cut off at
    /// 0 and 255.
    pub(super) fn yuyv(&self, image: &[u8], grey: &mut [u8], mut rgb: Option<&mut [u8]>) {
        let row = 2 * self.width;
        let mut words = [Channel::EMPTY; 3];
        let mut planes = [[0; PIECE]; 3];
        let mut chroma = [[0; PIECE]; 2];
        let four = |at: usize| u32::from_le_bytes(bytes(image, at));
        for (i, (from, out)) in self.pieces().zip(grey.chunks_mut(PIECE)).enumerate() {
            let n = out.len();
            let luminance = |at: usize| four(at) & 0x00ff_00ff;
            let Some(rgb) = &mut rgb else {
                let [words, ..] = &mut words;
                from.fetch([words], |at| [[2 * at, 2 * at + row].map(luminance)]);
                from.mix(words, out);
                continue;
            };
            from.fetch(words.each_mut(), |at| {
                // The second and the fourth byte of a pair are its colour. An odd pixel's right neighbour is in the next.
                let odd = at % 2;
                let pair = 2 * (at - odd);
                let colors = [pair, pair + row].map(|at| [four(at), four(at + 4 * odd)]);
                let of = |shift: u32| colors.map(|[l, r]| (l >> shift & 255) | (r >> shift & 255) << 16);
                [[2 * at, 2 * at + row].map(luminance), of(8), of(24)]
            });
            from.mix(&words[0], out);
            for (words, plane) in words[1..].iter().zip(&mut chroma) {
                from.mix(words, &mut plane[..n]);
            }
            let [r, g, b] = &mut planes;
            rgb_of_yuv(out, &chroma[0][..n], &chroma[1][..n], &mut r[..n], &mut g[..n], &mut b[..n]);
            interleave(&planes, &mut rgb[3 * i * PIECE..][..3 * n]);
        }
        self.blank::<1>(grey);
        if let Some(rgb) = rgb {
            self.blank::<3>(rgb);
        }
    }

    /// Blackens the pixels that the camera does not see.
    fn blank<const N: usize>(&self, out: &mut [u8]) {
        let (pixels, _) = out.as_chunks_mut::<N>();
        for i in &self.outside {
            pixels[*i as usize] = [0; N];
        }
    }

    fn pieces(&self) -> impl Iterator<Item = Piece<'_>> {
        let weights = self.right.chunks(PIECE).zip(self.below.chunks(PIECE));
        self.at.chunks(PIECE).zip(weights).map(|(at, (right, below))| Piece { at, right, below })
    }
}

/// At most [`PIECE`] pixels of the table.
#[derive(Clone, Copy)]
struct Piece<'a> {
    at: &'a [u32],
    right: &'a [u16],
    below: &'a [u16],
}

impl Piece<'_> {
    /// The words of all pixels in some channels: `words` gives those of both rows for the place of a pixel.
    #[inline]
    fn fetch<const N: usize>(self, mut out: [&mut Channel; N], words: impl Fn(usize) -> [[u32; 2]; N]) {
        for (i, at) in self.at.iter().enumerate().take(PIECE) {
            for (channel, [top, bottom]) in out.iter_mut().zip(words(*at as usize)) {
                (channel.top[i], channel.bottom[i]) = (top, bottom);
            }
        }
    }

    /// The mean of each pixel's four, by their weights.
    fn mix(self, words: &Channel, out: &mut [u8]) {
        let n = out.len();
        mix(&words.top[..n], &words.bottom[..n], &self.right[..n], &self.below[..n], out);
    }
}

/// The `N` bytes of an image from `at` on. The table has no place behind the last square of an image of its size.
#[inline]
fn bytes<const N: usize>(image: &[u8], at: usize) -> [u8; N] {
    let mut out = [0; N];
    out.copy_from_slice(&image[at..at + N]);
    out
}

for_every_processor! {
    fn mix(top: &[u32], bottom: &[u32], right: &[u16], below: &[u16], out: &mut [u8]) {
        let weights = right.iter().zip(below);
        for (((out, t), b), (r, below)) in out.iter_mut().zip(top).zip(bottom).zip(weights) {
            let r = u32::from(*r);
            let below = u32::from(*below);
            let t = (t & 0xffff) * (256 - r) + (t >> 16) * r;
            let b = (b & 0xffff) * (256 - r) + (b >> 16) * r;
            *out = ((t * (256 - below) + b * below + (1 << 15)) >> 16) as u8;
        }
    }
}

for_every_processor! {
    /// Luminance by BT.601, in 14 bits as `OpenCV`'s `cvtColor` has it.
    fn luma(red: &[u8], green: &[u8], blue: &[u8], out: &mut [u8]) {
        for (((out, r), g), b) in out.iter_mut().zip(red).zip(green).zip(blue) {
            let sum = 4899 * u32::from(*r) + 9617 * u32::from(*g) + 1868 * u32::from(*b);
            *out = ((sum + (1 << 13)) >> 14) as u8;
        }
    }
}

for_every_processor! {
    /// Red, green, blue by BT.601 with luminance within 16 and 235, in 20 bits as `OpenCV`'s `cvtColor` has it.
    fn rgb_of_yuv(y: &[u8], u: &[u8], v: &[u8], red: &mut [u8], green: &mut [u8], blue: &mut [u8]) {
        const HALF: i32 = 1 << 19;
        let outs = red.iter_mut().zip(green).zip(blue);
        for (((red, green), blue), ((y, u), v)) in outs.zip(y.iter().zip(u).zip(v)) {
            let y = (i32::from(*y) - 16).max(0) * 1_220_542 + HALF;
            let u = i32::from(*u) - 128;
            let v = i32::from(*v) - 128;
            *red = ((y + 1_673_527 * v) >> 20).clamp(0, 255) as u8;
            *green = ((y - 852_492 * v - 409_993 * u) >> 20).clamp(0, 255) as u8;
            *blue = ((y + 2_116_026 * u) >> 20).clamp(0, 255) as u8;
        }
    }
}

/// Three planes as pixels.
fn interleave([r, g, b]: &[[u8; PIECE]; 3], out: &mut [u8]) {
    for (((out, r), g), b) in out.as_chunks_mut().0.iter_mut().zip(r).zip(g).zip(b) {
        *out = [*r, *g, *b];
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simd::in_every_width;
    use proptest::prelude::*;

    /// The pixel out of its four, one channel at a time. `byte(x, y)` is that of the image.
    fn one(map: &Map, i: usize, byte: impl Fn(usize, usize) -> u8) -> Option<u8> {
        let at = Some(map.at[i]).filter(|_| !map.outside.contains(&(i as u32)))? as usize;
        let x = at % map.width;
        let y = at / map.width;
        let r = u64::from(map.right[i]);
        let b = u64::from(map.below[i]);
        let of = |x, y, weight: u64| u64::from(byte(x, y)) * weight;
        let sum = of(x, y, (256 - r) * (256 - b))
            + of(x + 1, y, r * (256 - b))
            + of(x, y + 1, (256 - r) * b)
            + of(x + 1, y + 1, r * b);
        Some(((sum + (1 << 15)) >> 16) as u8)
    }

    fn rgb_of([y, u, v]: [u8; 3]) -> [u8; 3] {
        let y = (i64::from(y) - 16).max(0) * 1_220_542;
        let u = i64::from(u) - 128;
        let v = i64::from(v) - 128;
        [y + 1_673_527 * v, y - 852_492 * v - 409_993 * u, y + 2_116_026 * u]
            .map(|c| ((c + (1 << 19)) >> 20).clamp(0, 255) as u8)
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]

        /// All passes in all vectors are the slow way bit for bit, wherever pixels come from.
        #[test]
        fn passes_are_the_slow_way(
            (w, h) in (1..200_usize, 2..12_usize),
            seed in 1..u64::MAX,
        ) {
            let w = 2 * w;
            let mut state = seed;
            let mut below = |n: u32| {
                state ^= state << 13;
                state ^= state >> 7;
                state ^= state << 17;
                (state >> 32) as u32 % n
            };
            let at: Vec<u32> = (0..w * h)
                .map(|_| below(h as u32 - 1) * w as u32 + below(w as u32 - 1))
                .collect();
            let outside = (0..(w * h) as u32).filter(|_| below(9) == 0).collect();
            let weights: [Vec<u16>; 2] = [0, 1].map(|_| at.iter().map(|_| below(257) as u16).collect());
            let [right, lower] = weights;
            let map = Map { width: w, at, right, below: lower, outside };
            let image: Vec<u8> = (0..3 * w * h).map(|_| below(256) as u8).collect();
            let grey = &image[..w * h];
            let yuyv = &image[..2 * w * h];
            let rgb = &image;
            in_every_width(|width| {
                let mut got = vec![7; w * h];
                let mut got_rgb = vec![7; 3 * w * h];
                map.grey(grey, &mut got);
                for (i, got) in got.iter().enumerate() {
                    assert_eq!(*got, one(&map, i, |x, y| grey[y * w + x]).unwrap_or(0), "grey {i} {width:?}");
                }
                map.rgb(rgb, &mut got, Some(&mut got_rgb));
                for (i, (grey, got)) in got.iter().zip(got_rgb.chunks(3)).enumerate() {
                    let want = [0, 1, 2].map(|c| one(&map, i, |x, y| rgb[(y * w + x) * 3 + c]).unwrap_or(0));
                    assert_eq!(got, want, "rgb {i} {width:?}");
                    let [r, g, b] = want.map(u64::from);
                    let luma = (4899 * r + 9617 * g + 1868 * b + (1 << 13)) >> 14;
                    assert_eq!(u64::from(*grey), luma, "luma {i} {width:?}");
                }
                map.yuyv(yuyv, &mut got, Some(&mut got_rgb));
                for (i, (grey, got)) in got.iter().zip(got_rgb.chunks(3)).enumerate() {
                    let of = |c: usize| one(&map, i, |x, y| {
                        let at = if c == 0 { 2 * x } else { x / 2 * 4 + 2 * c - 1 };
                        yuyv[y * w * 2 + at]
                    });
                    let want = of(0).zip(of(1)).zip(of(2)).map(|((y, u), v)| (y, rgb_of([y, u, v])));
                    let (y, color) = want.unwrap_or_default();
                    assert_eq!((*grey, got), (y, &color[..]), "yuyv {i} {width:?}");
                }
                let mut alone = vec![7; w * h];
                map.yuyv(yuyv, &mut alone, None);
                assert_eq!(alone, got, "grey alone {width:?}");
            });
        }
    }
}
