//! Taking out what cannot be right: pixels without support, such as the "flying" ones between two surfaces, and small
//! islands.
//!
//! Depth is compared as inverse depth `q` (1/m) and relative to itself, so that the same rule holds near and far.

use crate::workers::wide;

/// How much two neighbours on one surface may differ, relative to their inverse depth: noise and slant of ordinary
/// cameras stay below, flying pixels beyond.
pub(super) const SAME: f32 = 0.035;
/// Number of a pixel's eight neighbours that must lie on its surface. Two keep a line one pixel wide.
const SUPPORT: f32 = 2.0;

wide! {
/// Writes row `y` of `q`, without the pixels that too few of their eight neighbours support, to `out`; 0 is a hole.
///
/// At the edge of the image the neighbours that are missing support nothing.
pub(super) fn keep_supported(q: &[f32], w: usize, y: usize, out: &mut [f32]) {
    let h = q.len() / w;
    let row = |y: usize| &q[y * w..(y + 1) * w];
    let here = row(y);
    // A row that is not there is read as the row itself and weighs nothing.
    let (up, up_weight) = if y > 0 { (row(y - 1), 1.0) } else { (here, 0.0) };
    let (down, down_weight) = if y + 1 < h { (row(y + 1), 1.0) } else { (here, 0.0) };
    for x in [0, w - 1] {
        let from = x.saturating_sub(1);
        let to = (x + 1).min(w - 1);
        let mut n = 0.0;
        for nx in from..=to {
            let side = if nx == x { 0.0 } else { same(here[nx], here[x]) };
            n += side + up_weight * same(up[nx], here[x]) + down_weight * same(down[nx], here[x]);
        }
        out[x] = if n >= SUPPORT { here[x] } else { 0.0 };
    }
    if w < 3 {
        return;
    }
    let n = w - 2;
    let u0 = &up[..n];
    let u1 = &up[1..=n];
    let u2 = &up[2..];
    let d0 = &down[..n];
    let d1 = &down[1..=n];
    let d2 = &down[2..];
    let m0 = &here[..n];
    let m1 = &here[1..=n];
    let m2 = &here[2..];
    let out = &mut out[1..=n];
    for i in 0..n {
        let c = m1[i];
        let sides = same(m0[i], c) + same(m2[i], c);
        let over = same(u0[i], c) + same(u1[i], c) + same(u2[i], c);
        let under = same(d0[i], c) + same(d1[i], c) + same(d2[i], c);
        let n = sides + up_weight * over + down_weight * under;
        out[i] = if n >= SUPPORT { c } else { 0.0 };
    }
}
}

/// 1 when both lie on one surface. A hole is on none, not even with another hole.
#[inline(always)]
fn same(a: f32, b: f32) -> f32 {
    let near = (a - b).abs() < SAME * b;
    if near { 1.0 } else { 0.0 }
}

/// Pixels of one row that follow each other on one surface.
#[derive(Debug, Clone, Copy)]
struct Run {
    from: u32,
    to: u32,
    y: u32,
    /// The run that stands for the whole island, or one nearer to it.
    parent: u32,
    /// Pixels of the island, right for the run that stands for it.
    pixels: u32,
    /// The island's first and last column and last row, likewise; its first row is that of the run.
    left: u32,
    right: u32,
    bottom: u32,
    is_removed: bool,
}

/// Finds islands: pixels that are connected by sides on one surface.
#[derive(Debug, Default)]
pub(super) struct Islands {
    runs: Vec<Run>,
}

impl Islands {
    /// Makes room for every image of `pixels` pixels, so that none needs more later.
    pub(super) fn reserve(&mut self, pixels: usize) {
        self.runs.clear();
        self.runs.reserve(pixels);
    }

    /// Makes holes of the islands of fewer than `least` pixels, and of those of fewer than `body` that hang in the air:
    /// around them so few pixels lie at about their depth that all of these together are no `body` either.
    pub(super) fn remove(&mut self, q: &mut [f32], w: usize, least: u32, body: u32) {
        self.runs.clear();
        let mut before = 0..0;
        for (y, row) in q.chunks_exact(w).enumerate() {
            let first = self.runs.len();
            find_runs(row, y as u32, &mut self.runs);
            let above = if y > 0 { &q[(y - 1) * w..y * w] } else { &q[..0] };
            self.join(before.clone(), first, above, row);
            before = first..self.runs.len();
        }
        for i in 0..self.runs.len() {
            let root = self.root(i as u32) as usize;
            let Run { from, to, y, .. } = self.runs[i];
            let island = &mut self.runs[root];
            (island.left, island.right) = (island.left.min(from), island.right.max(to));
            island.bottom = island.bottom.max(y);
        }
        // Who is looked at must not depend on who went before.
        for i in 0..self.runs.len() {
            let island = self.runs[i];
            if island.parent as usize == i {
                let is_small = island.pixels < body;
                self.runs[i].is_removed = island.pixels < least || is_small && hangs(&island, q, w, body);
            }
        }
        for i in 0..self.runs.len() {
            let root = self.root(i as u32) as usize;
            if self.runs[root].is_removed {
                let Run { from, to, y, .. } = self.runs[i];
                q[y as usize * w..][from as usize..to as usize].fill(0.0);
            }
        }
    }

    /// Joins the runs from `first` on with those of the row above, both in order of columns.
    fn join(&mut self, above: core::ops::Range<usize>, first: usize, above_row: &[f32], row: &[f32]) {
        let mut up = above.start;
        for i in first..self.runs.len() {
            let Run { from, to, .. } = self.runs[i];
            while up < above.end && self.runs[up].to <= from {
                up += 1;
            }
            let mut at = up;
            while at < above.end && self.runs[at].from < to {
                let shared = from.max(self.runs[at].from) as usize..to.min(self.runs[at].to) as usize;
                let pairs = above_row[shared.clone()].iter().zip(&row[shared]);
                if pairs.into_iter().any(|(a, b)| same(*a, *b) > 0.0) {
                    self.unite(at as u32, i as u32);
                }
                at += 1;
            }
        }
    }

    fn root(&mut self, mut i: u32) -> u32 {
        loop {
            let parent = self.runs[i as usize].parent;
            if parent == i {
                return i;
            }
            // Halves the way for whoever comes next.
            let grandparent = self.runs[parent as usize].parent;
            self.runs[i as usize].parent = grandparent;
            i = grandparent;
        }
    }

    fn unite(&mut self, a: u32, b: u32) {
        let a = self.root(a);
        let b = self.root(b);
        if a != b {
            let keep = a.min(b) as usize;
            let give = a.max(b) as usize;
            self.runs[give].parent = keep as u32;
            self.runs[keep].pixels += self.runs[give].pixels;
        }
    }
}

/// Relative difference in inverse depth within which pixels may belong to the same object as an island.
const ABOUT: f32 = 0.12;
/// Pixels between those that are looked at around an island.
const STEP: usize = 3;

/// Whether the pixels at about the depth of `island`, in a window that reaches as far as a body is wide on each side of
/// it, are fewer than `body`.
fn hangs(island: &Run, q: &[f32], w: usize, body: u32) -> bool {
    let reach = 2 * body.isqrt() as usize;
    let depth = q[island.y as usize * w + island.from as usize];
    let columns = (island.left as usize).saturating_sub(reach)..(island.right as usize + reach).min(w);
    let rows =
        (island.y as usize).saturating_sub(reach)..(island.bottom as usize + 1 + reach).min(q.len() / w);
    let mut near = 0;
    for y in rows.step_by(STEP) {
        let row = &q[y * w..][columns.clone()];
        near += row.iter().step_by(STEP).filter(|other| (**other - depth).abs() < ABOUT * depth).count();
        if near * STEP * STEP >= body as usize {
            return false;
        }
    }
    true
}

fn find_runs(row: &[f32], y: u32, runs: &mut Vec<Run>) {
    let mut x = 0;
    while x < row.len() {
        if row[x] <= 0.0 {
            x += 1;
            continue;
        }
        let from = x;
        x += 1;
        while x < row.len() && same(row[x - 1], row[x]) > 0.0 {
            x += 1;
        }
        let parent = runs.len() as u32;
        let from = from as u32;
        let to = x as u32;
        runs.push(Run {
            from,
            to,
            y,
            parent,
            pixels: to - from,
            left: from,
            right: to,
            bottom: y,
            is_removed: false,
        });
    }
}
