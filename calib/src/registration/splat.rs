//! Drawing every depth pixel as a rectangle; see [`super::Method::Splat`].
//!
//! Neighbouring pixels of a row mostly cover the same rows of colour. Such a run is drawn once into a line, and the line
//! into each of these rows: most of the work is then minima of whole vectors.
#![allow(unsafe_code)] // a cast whose range is known
#![allow(clippy::inline_always, reason = "what is not inlined is compiled for the oldest processor")]
#![allow(
    clippy::needless_bitwise_bool,
    reason = "a lazy operator is a branch, and branches keep loops from being vectors"
)]

use super::lens::Lens32;
use super::target::{EMPTY, Target, key};
use super::warp::{Lane, Numbers, Warp, WithRow};
use crate::simd::for_every_processor;

/// A rectangle wider or higher than this is not drawn: the point is all but in colour's pupil, and one such pixel after
/// another would take minutes.
const MAX_SPAN: i32 = 128;
/// The columns and rows of a pixel that is not seen.
const NOWHERE: u32 = u32::MAX;

/// Three lines of colour, for the left, the middle and the right of each pixel: written to one line, each pixel would
/// wait for the one before. There is a column for every 16-bit number, so that none need be checked.
type Lines = [u16; LINES];
const LINES: usize = 1 << 18;
/// Where the second and the third line begin: were the same column of each at the same place of a page, the processor
/// would take writing one for writing the other.
const MIDDLE: usize = (1 << 16) + 683;
const LAST: usize = (2 << 16) + 1366;

/// The rows that one thread works with.
#[derive(Debug)]
pub(super) struct SplatRows {
    /// First and last column of colour that a pixel covers, in the upper and lower half.
    columns: Vec<u32>,
    /// First and last row, likewise.
    rows: Vec<u32>,
    /// [`Lines`].
    lines: Vec<u16>,
}

impl SplatRows {
    pub(super) fn new(depth_width: usize) -> Self {
        Self {
            columns: vec![NOWHERE; depth_width],
            rows: vec![NOWHERE; depth_width],
            lines: vec![EMPTY; LINES],
        }
    }

    /// Draws some rows of depth.
    pub(super) fn draw(
        &mut self,
        warp: &Warp,
        depth: &[u16],
        unit: f32,
        width: usize,
        rows: core::ops::Range<usize>,
        target: &mut Target<'_>,
    ) {
        for row in rows {
            let depth = &depth[row * width..(row + 1) * width];
            let corners = if warp.spreads { Corners::Both } else { Corners::First };
            self.rectangles(warp, depth, unit, row, corners);
            if let Some(lines) = self.lines.first_chunk_mut() {
                draw_row(depth, &self.columns, &self.rows, lines, target.pixels, target.width);
            }
        }
    }

    fn rectangles(&mut self, warp: &Warp, depth: &[u16], unit: f32, row: usize, corners: Corners) {
        let (columns, rows) = (&mut *self.columns, &mut *self.rows);
        let numbers = &warp.numbers;
        warp.with_row(row, depth.len(), Rectangles { depth, unit, corners, numbers, columns, rows });
    }

    /// Paints some rows of depth with colour: the pixel in which a corner lies, which one librealsense decides by the
    /// sizes.
    #[expect(clippy::too_many_arguments, reason = "two pictures with their sizes")]
    pub(super) fn paint(
        &mut self,
        warp: &Warp,
        depth: &[u16],
        unit: f32,
        (width, height): (usize, usize),
        rows: core::ops::Range<usize>,
        color: &[u8],
        (color_width, color_height): (usize, usize),
        out: &mut [u8],
    ) {
        let is_coarser = color_width < width && color_height < height;
        let corners = if is_coarser { Corners::Last } else { Corners::First };
        for (row, out) in rows.zip(out.chunks_exact_mut(width * 3)) {
            self.rectangles(warp, &depth[row * width..(row + 1) * width], unit, row, corners);
            for ((x, y), out) in self.columns.iter().zip(&self.rows).zip(out.chunks_exact_mut(3)) {
                if *x == NOWHERE {
                    out.fill(0);
                } else {
                    let at = ((y & 0xffff) as usize * color_width + (x & 0xffff) as usize) * 3;
                    out.copy_from_slice(&color[at..at + 3]);
                }
            }
        }
    }
}

/// Which corners of a depth pixel are looked at.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Corners {
    First,
    Last,
    Both,
}

struct Rectangles<'a> {
    depth: &'a [u16],
    unit: f32,
    corners: Corners,
    numbers: &'a Numbers,
    columns: &'a mut [u32],
    rows: &'a mut [u32],
}

impl WithRow for Rectangles<'_> {
    fn run<Y: Lane, L: Lens32>(self, first: (&[f32], Y), last: (&[f32], Y), lens: L) {
        let Self { depth, unit, corners, numbers, columns, rows } = self;
        match corners {
            Corners::Both => {
                both(depth, unit, first.0, first.1, last.0, last.1, lens, numbers, columns, rows);
            }
            Corners::First => one(depth, unit, first.0, first.1, lens, numbers, columns, rows),
            Corners::Last => one(depth, unit, last.0, last.1, lens, numbers, columns, rows),
        }
    }
}

for_every_processor! {
    /// The rectangles between both corners.
    fn both<Y: Lane, L: Lens32>(
        depth: &[u16], unit: f32, x0: &[f32], y0: Y, x1: &[f32], y1: Y, lens: L, numbers: &Numbers,
        columns: &mut [u32], rows: &mut [u32],
    ) {
        let n = depth.len();
        let (x0, y0, x1, y1) = (&x0[..n], y0.cut(n), &x1[..n], y1.cut(n));
        let (columns, rows, numbers) = (&mut columns[..n], &mut rows[..n], *numbers);
        for i in 0..n {
            let z = f32::from(depth[i]) * unit;
            let a = numbers.project(z, x0[i], y0.at(i), lens);
            let b = numbers.project(z, x1[i], y1.at(i), lens);
            let seen = (depth[i] != 0) & a.seen & b.seen;
            (columns[i], rows[i]) = rectangle((a.u, a.v), (b.u, b.v), seen, numbers.size);
        }
    }
}

for_every_processor! {
    /// The pixels under one corner.
    fn one<Y: Lane, L: Lens32>(
        depth: &[u16], unit: f32, x: &[f32], y: Y, lens: L, numbers: &Numbers, columns: &mut [u32], rows: &mut [u32],
    ) {
        let n = depth.len();
        let (x, y) = (&x[..n], y.cut(n));
        let (columns, rows, numbers) = (&mut columns[..n], &mut rows[..n], *numbers);
        for i in 0..n {
            let a = numbers.project(f32::from(depth[i]) * unit, x[i], y.at(i), lens);
            let seen = (depth[i] != 0) & a.seen;
            (columns[i], rows[i]) = rectangle((a.u, a.v), (a.u, a.v), seen, numbers.size);
        }
    }
}

/// The pixels between two corners, cut to the picture: columns and rows.
#[inline(always)]
fn rectangle(a: (f32, f32), b: (f32, f32), seen: bool, [w, h]: [f32; 2]) -> (u32, u32) {
    let span = |a: f32, b: f32, end: f32| {
        let (a, b) = (truncated(a, end), truncated(b, end));
        let (a, b) = (a.min(b), a.max(b));
        let end = whole(end);
        let inside = (b >= 0) & (a < end) & (b - a <= MAX_SPAN);
        ((a.max(0) << 16 | b.min(end - 1)) as u32, inside)
    };
    let (columns, in_columns) = span(a.0, b.0, w);
    let (rows, in_rows) = span(a.1, b.1, h);
    let seen = seen & in_columns & in_rows;
    (if seen { columns } else { NOWHERE }, if seen { rows } else { NOWHERE })
}

/// The pixel that librealsense takes: cut towards zero, so that the one left of the picture is in it by half. One beyond
/// the picture at the most.
#[inline(always)]
fn truncated(at: f32, end: f32) -> i32 {
    let at = at + 0.5;
    // NaN becomes −1.
    let at = if at > -1.0 { at } else { -1.0 };
    whole(if at < end { at } else { end })
}

/// The whole part of a number between −1 and the side of a picture.
#[inline(always)]
fn whole(at: f32) -> i32 {
    // SAFETY: the number is no NaN and is far within 32 bits.
    unsafe { at.to_int_unchecked() }
}

for_every_processor! {
    /// Draws the rectangles of a row.
    fn draw_row(
        depth: &[u16], columns: &[u32], rows: &[u32], lines: &mut Lines, pixels: &mut [u16], width: usize,
    ) {
        let mut left = depth.len();
        let (mut depth, mut columns, mut rows) = (depth, &columns[..left], &rows[..left]);
        while let Some(run) = rows.first().copied() {
            let n = rows.iter().position(|r| *r != run).unwrap_or(left);
            let of_run = (&columns[..n], &depth[..n]);
            (depth, columns, rows) = (&depth[n..], &columns[n..], &rows[n..]);
            left -= n;
            if run == NOWHERE {
                continue;
            }
            let (mut from, mut to) = (u32::MAX, 0);
            for c in of_run.0 {
                (from, to) = (from.min(*c), to.max(c & 0xffff));
            }
            for (c, z) in of_run.0.iter().zip(of_run.1) {
                let (l, r, key) = (c >> 16, c & 0xffff, key(*z));
                least(&mut lines[l as u16 as usize], key);
                // Of up to three columns this is the one between, or one of them.
                least(&mut lines[usize::from(((l + r) >> 1) as u16) + MIDDLE], key);
                least(&mut lines[usize::from(r as u16) + LAST], key);
                if r - l > 2 {
                    for x in l..=r {
                        least(&mut lines[usize::from(x as u16)], key);
                    }
                }
            }
            let (from, to) = ((from >> 16) as usize, to as usize + 1);
            let (first, others) = lines.split_at_mut(MIDDLE);
            let (middle, last) = others.split_at_mut(LAST - MIDDLE);
            flatten(&mut first[from..to], &mut middle[from..to], &mut last[from..to]);
            for y in (run >> 16) as usize..=(run & 0xffff) as usize {
                draw_line(&first[from..to], &mut pixels[y * width + from..y * width + to]);
            }
            first[from..to].fill(EMPTY);
        }
    }
}

/// The three lines as one, in the first; the others are emptied.
#[inline(always)]
fn flatten(first: &mut [u16], middle: &mut [u16], last: &mut [u16]) {
    for ((first, middle), last) in first.iter_mut().zip(middle).zip(last) {
        *first = (*first).min(*middle).min(*last);
        (*middle, *last) = (EMPTY, EMPTY);
    }
}

#[inline(always)]
fn draw_line(line: &[u16], row: &mut [u16]) {
    for (old, new) in row.iter_mut().zip(line) {
        *old = (*old).min(*new);
    }
}

#[inline(always)]
fn least(old: &mut u16, new: u16) {
    *old = (*old).min(new);
}
