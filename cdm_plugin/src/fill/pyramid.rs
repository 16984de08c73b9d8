//! The same image ever smaller: inverse depth where there is some, the colour it was seen with, and how much of each
//! cell it covers.

use crate::workers::{Workers, wide};

/// An image at one size. `q` is inverse depth in 1/m, 0 in a hole; `share` is how much of the cell had depth, 0 to 1.
#[derive(Debug, Default)]
pub(super) struct Level {
    pub(super) w: usize,
    pub(super) h: usize,
    pub(super) q: Vec<f32>,
    pub(super) share: Vec<f32>,
    /// Red, green, blue and 0 from the lowest byte on: of the pixels that gave the depth, or of all pixels without
    /// depth.
    pub(super) color: Vec<u32>,
}

impl Level {
    pub(super) fn resize(&mut self, w: usize, h: usize) {
        (self.w, self.h) = (w, h);
        self.q.resize(w * h, 0.0);
        self.share.resize(w * h, 0.0);
        self.color.resize(w * h, 0);
    }
}

/// Makes `coarse` of `fine`, which has twice its size, rounded up.
pub(super) fn shrink(workers: &Workers, fine: &Level, coarse: &mut Level) {
    workers.rows3(&mut coarse.q, &mut coarse.share, &mut coarse.color, coarse.w, |y, q, share, color| {
        let rows = [2 * y, (2 * y + 1).min(fine.h - 1)].map(|y| y * fine.w..(y + 1) * fine.w);
        let [a, b] = rows;
        shrink_row(
            workers.wide,
            [&fine.q[a.clone()], &fine.q[b.clone()]],
            [&fine.share[a.clone()], &fine.share[b.clone()]],
            [&fine.color[a], &fine.color[b]],
            q,
            share,
            color,
        );
    });
}

wide! {
fn shrink_row(
    q: [&[f32]; 2],
    share: [&[f32]; 2],
    color: [&[u32]; 2],
    out_q: &mut [f32],
    out_share: &mut [f32],
    out_color: &mut [u32],
) {
    let w = q[0].len();
    let whole = w / 2;
    // Pairs, and slices of one length: nothing is left to be checked in the loop.
    let [qa, qb] = q.map(|r| &r.as_chunks::<2>().0[..whole]);
    let [sa, sb] = share.map(|r| &r.as_chunks::<2>().0[..whole]);
    let [ca, cb] = color.map(|r| &r.as_chunks::<2>().0[..whole]);
    let to_q = &mut out_q[..whole];
    let to_share = &mut out_share[..whole];
    let to_color = &mut out_color[..whole];
    for x in 0..whole {
        let q = [qa[x][0], qa[x][1], qb[x][0], qb[x][1]];
        let share = [sa[x][0], sa[x][1], sb[x][0], sb[x][1]];
        let color = [ca[x][0], ca[x][1], cb[x][0], cb[x][1]];
        (to_q[x], to_share[x], to_color[x]) = cell(q, share, color);
    }
    if w % 2 == 1 {
        let i = w - 1;
        let cell = cell(
            [q[0][i], q[0][i], q[1][i], q[1][i]],
            [share[0][i], share[0][i], share[1][i], share[1][i]],
            [color[0][i], color[0][i], color[1][i], color[1][i]],
        );
        (out_q[whole], out_share[whole], out_color[whole]) = cell;
    }
}
}

/// Four cells in one. Where they lie on two surfaces the farther one wins: holes are mostly shadows that a near thing
/// throws on a far one, and a thing must not grow.
#[inline(always)]
pub(super) fn cell(q: [f32; 4], share: [f32; 4], color: [u32; 4]) -> (f32, f32, u32) {
    let far = |q: f32| if q > 0.0 { q } else { f32::MAX };
    let farthest = far(q[0]).min(far(q[1])).min(far(q[2]).min(far(q[3])));
    let weight = |i: usize| {
        let ratio = if q[i] > 0.0 { farthest / q[i] } else { 0.0 };
        let square = ratio * ratio;
        square * square * share[i]
    };
    let weights = [weight(0), weight(1), weight(2), weight(3)];
    let sum = (weights[0] + weights[1]) + (weights[2] + weights[3]);
    let has_depth = sum > 0.0;
    let scale = if has_depth { 1.0 / sum } else { 0.0 };
    let mean = (weights[0] * q[0] + weights[1] * q[1]) + (weights[2] * q[2] + weights[3] * q[3]);
    let total = (share[0] + share[1]) + (share[2] + share[3]);
    let of = |i: usize| if has_depth { weights[i] * scale } else { 0.25 };
    let channel = |shift: u32| {
        let value = |i: usize| ((color[i] >> shift) & 255) as i32 as f32 * of(i);
        let mean = (value(0) + value(1)) + (value(2) + value(3));
        ((mean + 0.5) as i32 as u32) << shift
    };
    (mean * scale, total * 0.25, channel(0) | channel(8) | channel(16))
}
