//! The steps, written plainly: what the fast forms must equal.

use crate::stereo::{DisparityMap, Parameters, StereoPair};

/// Cost of a disparity that leads out of the right picture.
const OUTSIDE: u8 = 40;
/// The eight directions that paths come from, as steps to the pixel before.
const PATHS: [(isize, isize); 8] = [(-1, 0), (-1, -1), (0, -1), (1, -1), (1, 0), (1, 1), (0, 1), (-1, 1)];

/// The matcher without tricks.
#[derive(Debug)]
pub struct Plain {
    size: (usize, usize),
    parameters: Parameters,
    census: [Vec<u64>; 2],
    cost: Vec<u8>,
    path: Vec<u8>,
    sum: Vec<u16>,
}

impl Plain {
    pub fn new(width: usize, height: usize, parameters: &Parameters) -> Self {
        let cells = width * height * parameters.max_disparity;
        Self {
            size: (width, height),
            parameters: parameters.clone(),
            census: [vec![0; width * height], vec![0; width * height]],
            cost: vec![0; cells],
            path: vec![0; cells],
            sum: vec![0; cells],
        }
    }

    pub fn memory_bytes(&self) -> u64 {
        (self.cost.len() + self.path.len() + 2 * self.sum.len() + 16 * self.census[0].len()) as u64
    }

    /// 9x7 around each pixel, 62 bits: which neighbours are darker.
    fn census(pixels: impl Fn(usize, usize) -> u8, (w, h): (usize, usize), out: &mut [u64]) {
        for (i, bits) in out.iter_mut().enumerate() {
            let (x, y) = (i % w, i / w);
            let centre = pixels(x, y);
            *bits = 0;
            for dy in -3..=3_isize {
                for dx in (-4..=4_isize).filter(|dx| (*dx, dy) != (0, 0)) {
                    let at = |p: usize, d: isize, n: usize| p.saturating_add_signed(d).min(n - 1);
                    *bits = *bits << 1 | u64::from(pixels(at(x, dx, w), at(y, dy, h)) < centre);
                }
            }
        }
    }

    pub fn run(&mut self, pair: &StereoPair<'_>, out: &mut DisparityMap) {
        let ((w, h), n) = (self.size, self.parameters.max_disparity);
        Self::census(|x, y| pair.left.row(y)[x], self.size, &mut self.census[0]);
        Self::census(|x, y| pair.right.row(y)[x], self.size, &mut self.census[1]);
        for (i, costs) in self.cost.chunks_exact_mut(n).enumerate() {
            for (d, cost) in costs.iter_mut().enumerate() {
                *cost = if d > i % w {
                    OUTSIDE
                } else {
                    (self.census[0][i] ^ self.census[1][i - d]).count_ones() as u8
                };
            }
        }
        self.sum.fill(0);
        for (dx, dy) in PATHS {
            let backward = dy > 0 || (dy == 0 && dx > 0);
            for k in 0..w * h {
                let i = if backward { w * h - 1 - k } else { k };
                let (x, y) = ((i % w) as isize + dx, (i / w) as isize + dy);
                let before = ((0..w as isize).contains(&x) && (0..h as isize).contains(&y))
                    .then(|| (y as usize * w + x as usize) * n);
                for d in 0..n {
                    let more = before.map_or(0, |at| step(&self.path[at..at + n], d, &self.parameters));
                    let cost = self.cost[i * n + d] + more;
                    self.path[i * n + d] = cost;
                    self.sum[i * n + d] += u16::from(cost);
                }
            }
        }
        for (i, sums) in self.sum.chunks_exact(n).enumerate() {
            let x = i % w;
            let d = best(sums);
            let right = (0..n.min(w - x + d)).min_by_key(|e| self.sum[(i - d.min(x) + e) * n..][*e]);
            let kept = d <= x && right.is_some_and(|e| e.abs_diff(d) <= self.parameters.left_right_px.into());
            (out.disparity[i], out.confidence[i]) =
                if kept { (sub_pixel(sums, d), 255) } else { (f32::NAN, 0) };
        }
    }
}

/// What a path adds to the cost of `d`.
fn step(before: &[u8], d: usize, parameters: &Parameters) -> u8 {
    let least = before.iter().copied().min().unwrap_or(0);
    let at = |d: usize| before.get(d).map_or(u8::MAX, |v| v - least);
    let beside = at(d.wrapping_sub(1)).min(at(d + 1)).saturating_add(parameters.p1);
    at(d).min(beside).min(parameters.p2)
}

fn best(sums: &[u16]) -> usize {
    sums.iter().enumerate().min_by_key(|(_, s)| **s).map_or(0, |(d, _)| d)
}

/// The minimum between whole disparities: two lines of equal and opposite slope through three sums.
fn sub_pixel(sums: &[u16], d: usize) -> f32 {
    let (Some(&a), Some(&c)) = (sums.get(d.wrapping_sub(1)), sums.get(d + 1)) else { return d as f32 };
    let (a, b, c) = (f32::from(a), f32::from(sums[d]), f32::from(c));
    let slope = (a - b).max(c - b);
    if slope > 0.0 { d as f32 + (a - c) / (2.0 * slope) } else { d as f32 }
}
