//! Post-processing of disparities: median, speckle removal, filling of short gaps, doubling of the size.
#![allow(clippy::inline_always)] // what is not inlined is compiled for the oldest processor

use super::choose::{NONE, ONE};
use crate::simd::for_every_processor;

for_every_processor! {
    /// A row but for its first and last pixel; each slice is that row's, as long as `out` and two more.
    fn median_row(above: &[u16], row: &[u16], below: &[u16], out: &mut [u16]) {
        let n = out.len();
        let a = &above[..n];
        let b = &above[1..=n];
        let c = &above[2..n + 2];
        let d = &row[..n];
        let e = &row[1..=n];
        let f = &row[2..n + 2];
        let g = &below[..n];
        let h = &below[1..=n];
        let i = &below[2..n + 2];
        for x in 0..n {
            // A hole counts as infinitely far, and is filled when most around it is known.
            let m = if e[x] == NONE { 0 } else { e[x] };
            let [a, b, c] = sorted(or(a[x], m), or(b[x], m), or(c[x], m));
            let [d, e, f] = sorted(or(d[x], m), m, or(f[x], m));
            let [g, h, i] = sorted(or(g[x], m), or(h[x], m), or(i[x], m));
            // Of sorted triples: the middle of the largest least, the middle middle and the smallest most (Smith 1996).
            let low = a.max(d).max(g);
            let middle = sorted(b, e, h)[1];
            let high = c.min(f).min(i);
            let median = sorted(low, middle, high)[1];
            out[x] = if row[x + 1] == NONE && median == 0 { NONE } else { median };
        }
    }
}

/// `v`, or `middle` if `v` is [`NONE`].
#[inline(always)]
fn or(v: u16, middle: u16) -> u16 {
    if v == NONE { middle } else { v }
}

/// The three in order.
#[inline(always)]
fn sorted(a: u16, b: u16, c: u16) -> [u16; 3] {
    let low = a.min(b);
    let high = a.max(b);
    [low.min(c), high.min(low.max(c)), high.max(c)]
}

/// The median of 3x3 around each disparity; where a neighbour has none, the middle stands in for it. A hole with five
/// neighbours or more that have one gets the fifth of them, counted from the nearest: the surface behind rather than the
/// one before it. The outermost pixels stay.
pub fn median(width: usize, from: &[u16], to: &mut [u16]) {
    let height = from.len() / width;
    if width < 3 || height < 3 {
        to.copy_from_slice(from);
        return;
    }
    let row = |y: usize| &from[y * width..][..width];
    for (y, to) in to.chunks_exact_mut(width).enumerate() {
        if y == 0 || y == height - 1 {
            to.copy_from_slice(row(y));
            continue;
        }
        (to[0], to[width - 1]) = (row(y)[0], row(y)[width - 1]);
        median_row(row(y - 1), row(y), row(y + 1), &mut to[1..width - 1]);
    }
}

/// A stretch of a row without a step in it.
#[derive(Debug, Clone, Copy, Default)]
struct Run {
    start: u32,
    end: u32,
    /// The run that stands for its region, or one on the way there.
    parent: u32,
    /// Pixels of the region, where the run stands for it.
    pixels: u32,
}

/// Finds regions and removes small ones.
#[derive(Debug, Default)]
pub struct Speckle {
    runs: Vec<Run>,
}

impl Speckle {
    /// For images of so many pixels.
    pub fn new(pixels: usize) -> Self {
        Self { runs: Vec::with_capacity(pixels) }
    }

    pub fn bytes(&self) -> usize {
        self.runs.capacity() * size_of::<Run>()
    }

    /// Removes regions of at most `most` pixels. A region is what hangs together by its four neighbours, with no more than
    /// `step` from one to the next.
    pub fn remove(&mut self, width: usize, map: &mut [u16], confidence: &mut [u8], most: u32, step: u16) {
        let runs = &mut self.runs;
        runs.clear();
        let mut above = 0..0;
        for (y, row) in map.chunks_exact(width).enumerate() {
            let first = runs.len();
            let offset = (y * width) as u32;
            let mut x = 0;
            while x < width {
                if row[x] == NONE {
                    x += 1;
                    continue;
                }
                let start = x;
                x += 1;
                while x < width && row[x] != NONE && row[x].abs_diff(row[x - 1]) <= step {
                    x += 1;
                }
                let start = offset + start as u32;
                let end = offset + x as u32;
                runs.push(Run { start, end, parent: runs.len() as u32, pixels: end - start });
            }
            if y > 0 {
                join(runs, above, width as u32, map, step);
            }
            above = first..runs.len();
        }
        for i in 0..runs.len() {
            let region = root(runs, i);
            if runs[region].pixels <= most {
                let of = runs[i].start as usize..runs[i].end as usize;
                map[of.clone()].fill(NONE);
                confidence[of].fill(0);
            }
        }
    }
}

/// Joins the runs of the last row, which begin where `above` ends, with those above them.
fn join(runs: &mut [Run], above: core::ops::Range<usize>, width: u32, map: &[u16], step: u16) {
    let mut i = above.start;
    let mut j = above.end;
    while i < above.end && j < runs.len() {
        let a = runs[i];
        let b = runs[j];
        let start = (a.start + width).max(b.start);
        let end = (a.end + width).min(b.end);
        let touch = (start..end).any(|at| map[at as usize].abs_diff(map[(at - width) as usize]) <= step);
        if touch {
            let p = root(runs, i);
            let q = root(runs, j);
            if p != q {
                runs[q].parent = p as u32;
                runs[p].pixels += runs[q].pixels;
            }
        }
        if a.end + width <= b.end {
            i += 1;
        } else {
            j += 1;
        }
    }
}

/// The run that stands for the region of run `i`; halves the way there.
fn root(runs: &mut [Run], mut i: usize) -> usize {
    while runs[i].parent as usize != i {
        runs[i].parent = runs[runs[i].parent as usize].parent;
        i = runs[i].parent as usize;
    }
    i
}

/// Fills gaps of at most `most` pixels in a row, and then in a column, whose ends differ by at most `step`: on a line from
/// one end to the other, and with the least confidence.
pub fn fill_gaps(
    width: usize,
    map: &mut [u16],
    confidence: &mut [u8],
    most: usize,
    step: u16,
    last: &mut [u32],
) {
    for (row, confidence) in map.chunks_exact_mut(width).zip(confidence.chunks_exact_mut(width)) {
        let mut x = 0;
        while x < width {
            if row[x] != NONE {
                x += 1;
                continue;
            }
            let start = x;
            while x < width && row[x] == NONE {
                x += 1;
            }
            if start == 0 || x == width || x - start > most || row[start - 1].abs_diff(row[x]) > step {
                continue;
            }
            let a = row[start - 1];
            let b = row[x];
            for i in start..x {
                row[i] = between(a, b, i - start + 1, x - start + 1);
                confidence[i] = 1;
            }
        }
    }
    // The row after the last disparity of each column; 0 before there is one.
    let last = &mut last[..width];
    last.fill(0);
    for y in 0..map.len() / width {
        for x in 0..width {
            let here = map[y * width + x];
            if here == NONE {
                continue;
            }
            let start = last[x] as usize;
            last[x] = y as u32 + 1;
            if start == 0 || start == y || y - start > most {
                continue;
            }
            let above = map[(start - 1) * width + x];
            if above.abs_diff(here) <= step {
                for i in start..y {
                    map[i * width + x] = between(above, here, i - start + 1, y - start + 1);
                    confidence[i * width + x] = 1;
                }
            }
        }
    }
}

/// `part` of `whole` on the way from `a` to `b`.
fn between(a: u16, b: u16, part: usize, whole: usize) -> u16 {
    let a = i64::from(a);
    let b = i64::from(b);
    (a + (b - a) * part as i64 / whole as i64) as u16
}

/// Twice the size and twice the disparity. Between four disparities that differ by less than a pixel it goes on a plane, else
/// the nearest is taken.
pub fn double(
    (width, height): (usize, usize),
    (map, sure): (&[u16], &[u8]),
    (full_width, full_height): (usize, usize),
    out: &mut [u16],
    confidence: &mut [u8],
) {
    for y in 0..full_height {
        let near_y = (y / 2).min(height - 1);
        let far_y = if y % 2 == 0 { near_y.saturating_sub(1) } else { (near_y + 1).min(height - 1) };
        let near = &map[near_y * width..][..width];
        let far = &map[far_y * width..][..width];
        let sure = &sure[near_y * width..][..width];
        let out = &mut out[y * full_width..][..full_width];
        let confidence = &mut confidence[y * full_width..][..full_width];
        for x in 0..full_width {
            let i = (x / 2).min(width - 1);
            let j = if x % 2 == 0 { i.saturating_sub(1) } else { (i + 1).min(width - 1) };
            let four = [near[i], near[j], far[i], far[j]];
            confidence[x] = sure[i];
            let (low, high) = four.iter().fold((NONE, 0), |(l, h), v| (l.min(*v), h.max(*v)));
            out[x] = if high - low <= ONE && high != NONE {
                // Twice (9 a + 3 b + 3 c + d) / 16.
                let [a, b, c, d] = four.map(u32::from);
                ((9 * a + 3 * b + 3 * c + d) / 8) as u16
            } else if four[0] == NONE {
                NONE
            } else {
                four[0] * 2
            };
        }
    }
}

/// Where `map` has none, takes what `other` has, half as sure.
pub fn fill_from((map, sure): (&mut [u16], &mut [u8]), (other, other_sure): (&[u16], &[u8])) {
    for (((d, sure), other), other_sure) in map.iter_mut().zip(sure).zip(other).zip(other_sure) {
        if *d == NONE && *other != NONE {
            (*d, *sure) = (*other, (*other_sure / 2).max(1));
        }
    }
}

/// An image of half the size: the mean of each 2x2; an odd last row or column counts twice.
pub fn halve(image: &crate::stereo::Gray<'_>, out: &mut [u8]) {
    let width = image.width.div_ceil(2);
    for (y, out) in out.chunks_exact_mut(width).enumerate() {
        let a = image.row(2 * y);
        let b = image.row((2 * y + 1).min(image.height - 1));
        let pairs_a = a.chunks_exact(2);
        let pairs_b = b.chunks_exact(2);
        let odd = (pairs_a.remainder().first(), pairs_b.remainder().first());
        for ((out, a), b) in out.iter_mut().zip(pairs_a).zip(pairs_b) {
            *out = ((u16::from(a[0]) + u16::from(a[1]) + u16::from(b[0]) + u16::from(b[1]) + 2) / 4) as u8;
        }
        if let (Some(a), Some(b)) = odd {
            out[width - 1] = u16::midpoint(u16::from(*a), u16::from(*b) + 1) as u8;
        }
    }
}
