//! What is compared of a picture: the census of 5x5 pixels around each, and its grey value.
//!
//! Bit `n` of the census says whether the neighbour `n`, counted row by row without the middle, is darker than the middle
//! (Zabih and Woodfill 1994). Pictures go on beyond their edges with the value of the edge.

use super::kernel::PLANES;
use crate::simd::for_every_processor;
use crate::stereo::Gray;

/// Pixels around the middle on each side.
const RADIUS: usize = 2;

/// Rows of a picture, made longer by [`RADIUS`] on both sides.
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

    pub fn fill(&mut self, picture: &Gray<'_>) {
        for (y, out) in self.rows.chunks_exact_mut(self.width + 2 * RADIUS).enumerate() {
            let row = picture.row(y);
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

for_every_processor! {
    fn census(r0: &[u8], r1: &[u8], r2: &[u8], r3: &[u8], r4: &[u8], a: &mut [u8], b: &mut [u8], c: &mut [u8]) {
        let n = a.len();
        let (b, c) = (&mut b[..n], &mut c[..n]);
        let [r0, r1, r2, r3, r4] = [&r0[..n + 4], &r1[..n + 4], &r2[..n + 4], &r3[..n + 4], &r4[..n + 4]];
        let middle = &r2[2..n + 2];
        for x in 0..n {
            let m = middle[x];
            let bit = |v: u8, n: u8| u8::from(v < m) << n;
            a[x] = bit(r0[x], 0) | bit(r0[x + 1], 1) | bit(r0[x + 2], 2) | bit(r0[x + 3], 3)
                | bit(r0[x + 4], 4) | bit(r1[x], 5) | bit(r1[x + 1], 6) | bit(r1[x + 2], 7);
            b[x] = bit(r1[x + 3], 0) | bit(r1[x + 4], 1) | bit(r2[x], 2) | bit(r2[x + 1], 3)
                | bit(r2[x + 3], 4) | bit(r2[x + 4], 5) | bit(r3[x], 6) | bit(r3[x + 1], 7);
            c[x] = bit(r3[x + 2], 0) | bit(r3[x + 3], 1) | bit(r3[x + 4], 2) | bit(r4[x], 3)
                | bit(r4[x + 1], 4) | bit(r4[x + 2], 5) | bit(r4[x + 3], 6) | bit(r4[x + 4], 7);
        }
    }
}

/// Puts the [`PLANES`] of a right row where [`super::kernel::Row::right`] has them.
pub fn mirror(planes: &[u8], width: usize, vectors: usize, reach: usize, out: &mut [u8]) {
    for (plane, out) in planes.chunks_exact(width).zip(out.chunks_exact_mut(vectors * reach)) {
        for (q, phase) in out.chunks_exact_mut(reach).enumerate() {
            let inside = (width.saturating_sub(q)).div_ceil(vectors).min(reach);
            let (inside, beyond) = phase.split_at_mut(inside);
            for (to, from) in inside.iter_mut().zip(plane[..width - q.min(width)].iter().rev().step_by(vectors)) {
                *to = *from;
            }
            beyond.fill(plane[0]);
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
        let (here, before) = (&here[..n], &before[..n]);
        for x in 0..n {
            out[x] = most.saturating_sub(here[x].abs_diff(before[x]).saturating_sub(slack)).max(least);
        }
    }
}

impl Penalties {
    /// Of row `y` of a pass, in the order of [`super::kernel::Row`]'s paths: along the row, and from the row before it the
    /// pixel behind, the one beside and the one ahead. `back` is the pass from the right and from below.
    pub fn row(&self, picture: &Padded, y: usize, back: bool, out: &mut [u8]) {
        let w = picture.width;
        let (y, side) = (y as isize, if back { 1 } else { -1 });
        let here = picture.grey(y as usize);
        for (p, out) in out.chunks_exact_mut(w).take(PLANES).enumerate() {
            let (row, dx) = [(y, side), (y + side, side), (y + side, 0), (y + side, -side)][p];
            let before = &picture.row(row)[(RADIUS as isize + dx) as usize..][..w];
            penalty(here, before, out, self.most, self.least, self.slack);
        }
    }
}
