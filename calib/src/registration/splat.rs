//! Drawing every depth pixel as a rectangle; see [`super::Method::Splat`].
//!
//! Neighbouring pixels of a row mostly cover the same rows of colour. Such a run is drawn once into a line, and the line
//! into each of these rows: most of the work is then minima of whole vectors.
#![allow(
    clippy::needless_bitwise_bool,
    reason = "a lazy operator is a branch, and branches keep loops from being vectors"
)]

use super::target::{EMPTY, Target, key};
use super::warp::{Place, Seen, Warp};

/// A rectangle wider or higher than this is not drawn: the point is all but in colour's pupil, and one such pixel after
/// another would take minutes.
const MAX_SPAN: i16 = 128;
/// Left of everything: a corner that is not seen.
const NOWHERE: i16 = i16::MIN;

/// The rows that one thread works with.
#[derive(Debug)]
pub(super) struct SplatRows {
    seen: Seen,
    left: Vec<i16>,
    top: Vec<i16>,
    right: Vec<i16>,
    bottom: Vec<i16>,
    line: Vec<u16>,
}

impl SplatRows {
    pub(super) fn new(depth_width: usize, color_width: usize) -> Self {
        let row = || vec![0; depth_width];
        Self {
            seen: Seen::new(depth_width),
            left: row(),
            top: row(),
            right: row(),
            bottom: row(),
            line: vec![EMPTY; color_width],
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
            self.rectangles(warp, depth, unit, row);
            self.draw_row(depth, target);
        }
    }

    /// Finds the rectangle of every pixel, cut to the picture. One that is not seen has `bottom` −1.
    fn rectangles(&mut self, warp: &Warp, depth: &[u16], unit: f32, row: usize) {
        let [w, h] = warp.size;
        warp.row(depth, unit, row, Place::First, &mut self.seen);
        whole(&self.seen, w, h, &mut self.left, &mut self.top);
        if warp.spreads {
            warp.row(depth, unit, row, Place::Last, &mut self.seen);
            whole(&self.seen, w, h, &mut self.right, &mut self.bottom);
        } else {
            self.right.copy_from_slice(&self.left);
            self.bottom.copy_from_slice(&self.top);
        }
        let (w, h) = (w as i16 - 1, h as i16 - 1);
        let n = depth.len();
        let (left, top) = (&mut self.left[..n], &mut self.top[..n]);
        let (right, bottom) = (&mut self.right[..n], &mut self.bottom[..n]);
        for i in 0..n {
            let (l, r) = (left[i].min(right[i]), left[i].max(right[i]));
            let (t, b) = (top[i].min(bottom[i]), top[i].max(bottom[i]));
            let seen = (l > NOWHERE) & (r >= 0) & (b >= 0) & (l <= w) & (t <= h);
            let small = (r.wrapping_sub(l) <= MAX_SPAN) & (b.wrapping_sub(t) <= MAX_SPAN);
            left[i] = l.max(0);
            right[i] = r.min(w);
            top[i] = if seen & small { t.max(0) } else { -1 };
            bottom[i] = if seen & small { b.min(h) } else { -1 };
        }
    }

    fn draw_row(&mut self, depth: &[u16], target: &mut Target<'_>) {
        let n = depth.len();
        let (left, right) = (&self.left[..n], &self.right[..n]);
        let (top, bottom) = (&self.top[..n], &self.bottom[..n]);
        let mut i = 0;
        while i < n {
            let (t, b) = (top[i], bottom[i]);
            if b < 0 {
                i += 1;
                continue;
            }
            let (mut from, mut to) = (left[i], right[i]);
            let begin = i;
            while i < n && top[i] == t && bottom[i] == b {
                let key = key(depth[i]);
                for x in &mut self.line[left[i] as usize..=right[i] as usize] {
                    *x = (*x).min(key);
                }
                from = from.min(left[i]);
                to = to.max(right[i]);
                i += 1;
            }
            debug_assert!(i > begin);
            let (from, to) = (from as usize, to as usize + 1);
            let line = &mut self.line[from..to];
            for y in t as usize..=b as usize {
                let row = &mut target.pixels[y * target.width + from..y * target.width + to];
                for (old, new) in row.iter_mut().zip(&*line) {
                    *old = (*old).min(*new);
                }
            }
            line.fill(EMPTY);
        }
    }

    /// Paints some rows of depth with colour: the pixel in which a corner lies, which one librealsense decides by the sizes.
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
        let place = if is_coarser { Place::Last } else { Place::First };
        for (row, out) in rows.zip(out.chunks_exact_mut(width * 3)) {
            warp.row(&depth[row * width..(row + 1) * width], unit, row, place, &mut self.seen);
            whole(&self.seen, warp.size[0], warp.size[1], &mut self.left, &mut self.top);
            for ((x, y), out) in self.left.iter().zip(&self.top).zip(out.chunks_exact_mut(3)) {
                let (x, y) = (*x as u16 as usize, *y as u16 as usize);
                if x < color_width && y < color_height {
                    let at = (y * color_width + x) * 3;
                    out.copy_from_slice(&color[at..at + 3]);
                } else {
                    out.fill(0);
                }
            }
        }
    }
}

/// Whole pixels, one beyond the picture at the most.
fn whole(seen: &Seen, w: f32, h: f32, xs: &mut [i16], ys: &mut [i16]) {
    let round = |at: f32, end: f32| {
        let at = at + 0.5;
        let at = if at > -1.0 { at } else { -1.0 };
        (if at < end { at } else { end }) as i32 as i16
    };
    for ((u, v), (x, y)) in seen.u.iter().zip(&seen.v).zip(xs.iter_mut().zip(ys.iter_mut())) {
        let nowhere = u.is_nan();
        *x = if nowhere { NOWHERE } else { round(*u, w) };
        *y = if nowhere { NOWHERE } else { round(*v, h) };
    }
}
