//! The inner loop: the cost of every disparity of a pixel, four paths through it, and in the second pass the best sum.
#![allow(clippy::needless_range_loop)] // closures would not be compiled for the processor
#![allow(unsafe_code)] // as the vectors that it is made of
#![allow(clippy::inline_always)] // what is not inlined is compiled for the oldest processor

use super::lanes::Lanes;
use core::mem::MaybeUninit;

/// Planes of an image: three bytes of census and the grey value.
pub const PLANES: usize = 4;
/// Largest difference of grey that counts, in the cost's units.
const GREY_MOST: u8 = 7;
/// Cost of what is beyond the last disparity: a path that crosses it never wins, and no sum of it overflows a byte.
const BEYOND: u8 = 127;
/// Cost beside the first and the last disparity; with a penalty it stays below 256.
const EDGE: u8 = 190;

/// Inputs and outputs of one row of a pass. Steps count pixels in the direction of the pass: from the left in the
/// first, from the right in the second.
#[derive(Debug, Clone, Copy)]
pub struct Row {
    /// Pixels of the row.
    pub width: usize,
    /// [`PLANES`] of the left image, together for each pixel.
    pub left: *const u8,
    /// Penalties of larger steps for the four paths, together for each pixel.
    pub large: *const u8,
    /// [`PLANES`] of the right image, mirrored: pixel `width - 1 - k` is byte `k / n` of phase `k % n`, with `n`
    /// vectors a pixel. Phase `n + q` is phase `q` one byte on, so that the vectors of a pixel are `reach` apart. Beyond the
    /// image's left edge its first column is repeated.
    pub right: [*const u8; PLANES],
    /// Bytes of a phase.
    pub reach: usize,
    /// Penalty of a step of one disparity.
    pub small: u8,
    /// Sums of the first pass.
    pub sums: *mut u8,
    /// For each vector the disparities of its lanes, then [`u8::MAX`] in lanes that are beyond the last disparity.
    pub lanes: *const u8,
    /// Number of disparities is that of all lanes.
    pub full: bool,
    /// Of each pixel, in the second pass.
    pub winners: *mut Winner,
    /// The right view's disparity of each pixel, in the second pass.
    pub mirrored: *mut u8,
}

/// The best disparity of a pixel, and the costs around it.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
#[repr(C)]
pub struct Winner {
    /// The disparity of the least cost, the smallest of several.
    pub disparity: u8,
    /// Its cost.
    pub cost: u8,
    /// Cost of the disparity before it; 255 when it is the first.
    pub before: u8,
    /// Cost of the disparity after it; 255 when it is the last.
    pub after: u8,
    /// The least cost of those that are not beside it; 255 without one.
    pub second: u8,
}

/// State carried from one step of a row to the next.
#[derive(Clone, Copy)]
pub struct Carry<S: Lanes, const N: usize> {
    along: [S; N],
    window: [[S::Keys; 2]; N],
}

impl<S: Lanes, const N: usize> Carry<S, N> {
    /// Before the first step.
    #[inline(always)]
    pub unsafe fn new() -> Self {
        // SAFETY: registers alone; the caller has seen that the processor has what `S` needs.
        unsafe { Self { along: [S::splat(0); N], window: [S::no_keys(); N] } }
    }
}

/// The cost that a path adds: `before` are the path's costs one pixel earlier, the least of which is 0.
#[inline(always)]
unsafe fn step<S: Lanes, const N: usize>(before: &[S; N], small: S, large: S) -> [S; N] {
    // SAFETY: registers alone, as in `Carry::new`. No sum leaves its byte: costs of a path are at most BEYOND + 63,
    // which is EDGE, and a penalty is at most 63.
    unsafe {
        let edge = S::splat(EDGE);
        let first = before[N - 1].up(edge);
        let last = before[0].down(edge);
        let mut more = *before;
        for i in 0..N {
            let lower = if i == 0 { first } else { before[i - 1] };
            let upper = if i == N - 1 { last } else { before[i + 1] };
            more[i] = before[i].min(lower.min(upper).add(small)).min(large);
        }
        more
    }
}

/// Costs along a path, less the least of them.
#[inline(always)]
unsafe fn grown<S: Lanes, const N: usize>(cost: &[S; N], more: &[S; N]) -> [S; N] {
    // SAFETY: registers alone, as in `Carry::new`. A cost is at most BEYOND, and what is added to it at most 63.
    unsafe {
        let mut path = *cost;
        let mut least = cost[0].add(more[0]);
        for i in 0..N {
            path[i] = cost[i].add(more[i]);
            least = least.min(path[i]);
        }
        let least = least.least_everywhere();
        for i in 0..N {
            path[i] = path[i].sub(least);
        }
        path
    }
}

/// One of the three paths from the row before, through the cell `here`: `N` vectors that nobody else uses meanwhile.
#[inline(always)]
unsafe fn across<S: Lanes, const N: usize>(
    here: *mut u8,
    cost: &[S; N],
    (small, large): (S, S),
    sum: &mut [S; N],
) {
    // SAFETY: vector `i < N` of the cell is read and written, and the cell has `N`, by the caller.
    unsafe {
        let mut before = [small; N];
        for i in 0..N {
            before[i] = S::load(here.add(i * S::LANES));
        }
        let more = step(&before, small, large);
        let path = grown(cost, &more);
        for i in 0..N {
            path[i].store(here.add(i * S::LANES));
            sum[i] = sum[i].add(more[i]);
        }
    }
}

/// Some steps of a row: `BACK` is the second pass. Cell `s` of `cells[p]` is where path `p` from the row before goes on at
/// step `s`: the path from behind, the one from beside, the one from ahead.
///
/// # Safety
/// The processor has what `S` needs; every pointer of `row` reaches as its comment says, and so do the cells of these
/// steps; nobody else writes there.
#[inline(always)]
pub unsafe fn run<S: Lanes, const N: usize, const BACK: bool>(
    row: &Row,
    carry: &mut Carry<S, N>,
    cells: [*mut u8; 3],
    steps: core::ops::Range<usize>,
) {
    let cell = N * S::LANES;
    let w = row.width;
    let right = row.right;
    // SAFETY: with `x < w`, since `steps` ends at `w` at most:
    // - `left` and `large` have PLANES bytes for each pixel of the row, of which bytes 0 to 3 of pixel `x` are read;
    // - `right` has 2 N - 1 phases of `reach` bytes. Phase `k % N + i` is at most 2 N - 2, and the LANES bytes from `k / N` end
    //   before `reach`, which is more than `w / N + LANES`;
    // - `lanes` has two cells, and a load ends with the second at the latest;
    // - `sums`, `winners` and `mirrored` have `w` entries for the row; a sum begins at a multiple of a cell, so of LANES, of
    //   memory that is aligned to 64, as `stream` asks;
    // - the cells of these steps are the caller's to promise: see `Order::cells`.
    unsafe {
        let small = S::splat(row.small);
        let grey_most = S::splat(GREY_MOST);
        let Carry { mut along, mut window } = *carry;
        for s in steps {
            let x = if BACK { w - 1 - s } else { s };
            let left = row.left.add(x * PLANES);
            let large = row.large.add(x * PLANES);
            let bits = [S::splat(*left), S::splat(*left.add(1)), S::splat(*left.add(2))];
            let grey = S::splat(*left.add(3));
            let k = w - 1 - x;
            let first = (k % N) * row.reach + k / N;
            let mut cost = [small; N];
            for i in 0..N {
                let at = first + i * row.reach;
                let there = [S::load(right[0].add(at)), S::load(right[1].add(at)), S::load(right[2].add(at))];
                let difference = grey.quarter_of_difference(S::load(right[3].add(at)));
                cost[i] = S::hamming(bits, there).add(difference.min(grey_most));
            }
            if !row.full {
                let beyond = S::splat(BEYOND);
                for i in 0..N {
                    let lanes = S::load(row.lanes.add(cell + i * S::LANES));
                    cost[i] = cost[i].or(lanes.min(beyond));
                }
            }

            let mut sum = step(&along, small, S::splat(*large));
            along = grown(&cost, &sum);
            for (p, cells) in [(1, cells[0]), (2, cells[1]), (3, cells[2])] {
                let here = cells.wrapping_add(s * cell);
                across(here, &cost, (small, S::splat(*large.add(p))), &mut sum);
            }

            let sums = row.sums.add(x * cell);
            if !BACK {
                for i in 0..N {
                    sum[i].stream(sums.add(i * S::LANES));
                }
                continue;
            }
            let mut total = sum;
            for i in 0..N {
                let both = sum[i].add_saturating(S::load(sums.add(i * S::LANES)));
                total[i] = both.average(cost[i].times_8());
                if !row.full {
                    total[i] = total[i].or(S::load(row.lanes.add(cell + i * S::LANES)));
                }
            }
            choose(row, x, &total, &mut window);
        }
        *carry = Carry { along, window };
    }
}

/// The best of the costs of pixel `x`, and what the right view makes of them. `window[i]` has the best keys of the right pixels
/// that pixel `x` is compared with, each in the lane of its disparity.
///
/// # Safety
/// As [`run`], of which it is the end; `x` is below the row's width.
#[inline(always)]
unsafe fn choose<S: Lanes, const N: usize>(
    row: &Row,
    x: usize,
    total: &[S; N],
    window: &mut [[S::Keys; 2]; N],
) {
    // SAFETY: `lanes`, `winners` and `mirrored` as in `run`. `costs` has 256 bytes, and `Passes::new` takes no more vectors than
    // hold 256 disparities; all N LANES bytes are written before any is read. `disparity` is a number from `lanes`, so below
    // N LANES; the places of `d - 1` and `d + 1` are looked at where there are such disparities, and lie below N LANES too.
    unsafe {
        let mut number = *total;
        let mut best = S::no_keys();
        for i in 0..N {
            number[i] = S::load(row.lanes.add(i * S::LANES));
            let keys = total[i].keys(number[i]);
            best = S::min_keys(best, keys);
            window[i] = S::min_keys(window[i], keys);
        }
        // The right pixel at the same place has now been seen from all its disparities.
        *row.mirrored.add(x) = S::first_key(window[0]) as u8;
        let last = S::keys_down(window[0]);
        for i in 1..N {
            window[i - 1] = window[i];
        }
        window[N - 1] = last;

        let key = S::least_key(best);
        let disparity = key as u8;
        let low = disparity.saturating_sub(1);
        let span = if disparity == 0 { 1 } else { 2 };
        let low = S::splat(low);
        let span = S::splat(span);
        let mut other = S::splat(u8::MAX);
        // At most 256 bytes, as MAX_DISPARITIES is; every byte that is read was written.
        let mut costs = MaybeUninit::<[u8; 256]>::uninit();
        let costs = costs.as_mut_ptr().cast::<u8>();
        for i in 0..N {
            other = other.min_outside(total[i], number[i].sub(low), span);
            total[i].store(costs.add(i * S::LANES));
        }
        let d = usize::from(disparity);
        *row.winners.add(x) = Winner {
            disparity,
            cost: (key >> 8) as u8,
            before: if d == 0 { u8::MAX } else { *costs.add(((d - 1) % N) * S::LANES + (d - 1) / N) },
            after: if d + 1 == N * S::LANES {
                u8::MAX
            } else {
                *costs.add(((d + 1) % N) * S::LANES + (d + 1) / N)
            },
            second: other.least(),
        };
    }
}
