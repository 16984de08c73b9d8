//! The features that are compared: the census of 5x5 pixels around each pixel, and its grey value.
//!
//! Bit `n` of the census says whether the neighbour `n`, counted row by row without the middle, is darker than the middle
//! (Zabih and Woodfill 1994). Images go on beyond their edges with the value of the edge.

use super::kernel::PLANES;
use crate::simd::for_every_processor;
use crate::stereo::Gray;

/// Pixels around the middle on each side.
const RADIUS: usize = 2;

/// Rows of an image, made longer by [`RADIUS`] on both sides.
#[derive(Debug)]
pub struct Padded {
    rows: Vec<u8>,
    width: usize,
    height: usize,
}

impl Padded {
    pub fn new(width: usize, height: usize) -> Self {
        Self { rows: vec![0; (width + 2 * RADIUS) * height], width, height }
    }

    pub fn bytes(&self) -> usize {
        self.rows.len()
    }

    pub fn fill(&mut self, image: &Gray<'_>) {
        for (y, out) in self.rows.chunks_exact_mut(self.width + 2 * RADIUS).enumerate() {
            let row = image.row(y);
            out[..RADIUS].fill(row[0]);
            out[RADIUS..RADIUS + self.width].copy_from_slice(row);
            out[RADIUS + self.width..].fill(row[self.width - 1]);
        }
    }

    fn row(&self, y: isize) -> &[u8] {
        let y = y.clamp(0, self.height as isize - 1) as usize;
        &self.rows[y * (self.width + 2 * RADIUS)..][..self.width + 2 * RADIUS]
    }

    /// Row `y` as it was.
    pub fn grey(&self, y: usize) -> &[u8] {
        &self.row(y as isize)[RADIUS..RADIUS + self.width]
    }

    /// The [`PLANES`] of row `y`, one after the other.
    pub fn planes(&self, y: usize, out: &mut [u8]) {
        let w = self.width;
        let y = y as isize;
        let rows = [-2, -1, 0, 1, 2].map(|dy| self.row(y + dy));
        let (a, rest) = out.split_at_mut(w);
        let (b, rest) = rest.split_at_mut(w);
        let (c, grey) = rest.split_at_mut(w);
        census(rows[0], rows[1], rows[2], rows[3], rows[4], a, b, c);
        grey.copy_from_slice(self.grey(y as usize));
    }
}

/// Sets bit `n` of `out` where what lies `$at` further in `$row` is darker than the middle.
macro_rules! eight_bits {
    ($out:ident, $middle:ident, [$(($row:ident, $at:literal)),* $(,)?]) => {{
        let len = $out.len();
        let middle = &$middle[..len];
        let rows = [$(&$row[$at..$at + len]),*];
        for x in 0..len {
            let m = middle[x];
            let mut bits = 0;
            let mut n = 0;
            while n < 8 {
                bits |= u8::from(rows[n][x] < m) << n;
                n += 1;
            }
            $out[x] = bits;
        }
    }};
}

for_every_processor! {
    /// The three bytes of the census of a row; the five rows are longer than `a`, `b` and `c` by [`RADIUS`] on each side.
    fn census(r0: &[u8], r1: &[u8], r2: &[u8], r3: &[u8], r4: &[u8], a: &mut [u8], b: &mut [u8], c: &mut [u8]) {
        let middle = &r2[RADIUS..];
        eight_bits!(a, middle, [(r0, 0), (r0, 1), (r0, 2), (r0, 3), (r0, 4), (r1, 0), (r1, 1), (r1, 2)]);
        eight_bits!(b, middle, [(r1, 3), (r1, 4), (r2, 0), (r2, 1), (r2, 3), (r2, 4), (r3, 0), (r3, 1)]);
        eight_bits!(c, middle, [(r3, 2), (r3, 3), (r3, 4), (r4, 0), (r4, 1), (r4, 2), (r4, 3), (r4, 4)]);
    }
}

/// Puts the [`PLANES`] of a right row where [`super::kernel::Row::right`] has them.
pub fn mirror(planes: &[u8], width: usize, vectors: usize, reach: usize, out: &mut [u8]) {
    for (plane, out) in planes.chunks_exact(width).zip(out.chunks_exact_mut((2 * vectors - 1) * reach)) {
        for (q, phase) in out.chunks_exact_mut(reach).enumerate() {
            let inside = width.saturating_sub(q).div_ceil(vectors).min(reach);
            let (inside, beyond) = phase.split_at_mut(inside);
            for (to, from) in
                inside.iter_mut().zip(plane[..width - q.min(width)].iter().rev().step_by(vectors))
            {
                *to = *from;
            }
            beyond.fill(plane[0]);
        }
    }
}

/// Puts the bytes of [`PLANES`] of a row together for each pixel.
pub fn together(planes: &[u8], width: usize, out: &mut [u8]) {
    let (a, rest) = planes.split_at(width);
    let (b, rest) = rest.split_at(width);
    let (c, d) = rest.split_at(width);
    zip(a, b, c, d, out.as_chunks_mut().0);
}

for_every_processor! {
    fn zip(a: &[u8], b: &[u8], c: &[u8], d: &[u8], out: &mut [[u8; PLANES]]) {
        let n = out.len();
        let a = &a[..n];
        let b = &b[..n];
        let c = &c[..n];
        let d = &d[..n];
        for x in 0..n {
            out[x] = [a[x], b[x], c[x], d[x]];
        }
    }
}

/// Penalties of a larger step for the four paths of a pass: less where grey changes, since that is where depth does.
#[derive(Debug, Clone, Copy)]
pub struct Penalties {
    /// Where grey does not change.
    pub most: u8,
    /// Where it changes most.
    pub least: u8,
    /// Change of grey that is not counted.
    pub slack: u8,
}

for_every_processor! {
    /// `most - (|here - before| - slack)`, at least `least`.
    fn penalty(here: &[u8], before: &[u8], out: &mut [u8], most: u8, least: u8, slack: u8) {
        let n = out.len();
        let here = &here[..n];
        let before = &before[..n];
        for x in 0..n {
            out[x] = most.saturating_sub(here[x].abs_diff(before[x]).saturating_sub(slack)).max(least);
        }
    }
}

impl Penalties {
    /// Of row `y` of a pass, in the order of [`super::kernel::Row`]'s paths: along the row, and from the row before it the
    /// pixel behind, the one beside and the one ahead. `back` is the pass from the right and from below.
    pub fn row(self, image: &Padded, y: usize, back: bool, out: &mut [u8]) {
        let w = image.width;
        let y = y as isize;
        let side = if back { 1 } else { -1 };
        let here = image.grey(y as usize);
        for (p, out) in out.chunks_exact_mut(w).take(PLANES).enumerate() {
            let (row, dx) = [(y, side), (y + side, side), (y + side, 0), (y + side, -side)][p];
            let before = &image.row(row)[(RADIUS as isize + dx) as usize..][..w];
            penalty(here, before, out, self.most, self.least, self.slack);
        }
    }
}
