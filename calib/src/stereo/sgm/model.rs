//! Reference model of the two passes, plain and slow.

use super::kernel::Winner;
use super::pass::Costs;

/// An image, by pixel; beyond its edges it goes on with the edge.
pub struct Image<'a> {
    pub pixels: &'a [u8],
    pub width: usize,
    pub height: usize,
    pub stride: usize,
}

impl Image<'_> {
    pub fn at(&self, x: isize, y: isize) -> i32 {
        let x = x.clamp(0, self.width as isize - 1) as usize;
        let y = y.clamp(0, self.height as isize - 1) as usize;
        i32::from(self.pixels[y * self.stride + x])
    }

    /// Which of the 24 pixels around one are darker than it.
    fn census(&self, x: isize, y: isize) -> Vec<bool> {
        let around = (-2..=2).flat_map(|dy| (-2..=2).map(move |dx| (dx, dy))).filter(|o| *o != (0, 0));
        around.map(|(dx, dy)| self.at(x + dx, y + dy) < self.at(x, y)).collect()
    }
}

/// The cost of a disparity at a pixel: bits of the census that differ, and up to 7 for a quarter of the difference of
/// grey.
pub fn cost(left: &Image<'_>, right: &Image<'_>, (x, y): (usize, usize), d: usize) -> i32 {
    let x = x as isize;
    let y = y as isize;
    // There is no pixel of the right image beyond its left edge: the one at the edge stands for it.
    let there = (x - d as isize).max(0);
    let bits = left.census(x, y).iter().zip(right.census(there, y)).filter(|(a, b)| **a != *b).count();
    bits as i32 + ((left.at(x, y) - right.at(there, y)).abs() / 4).min(7)
}

/// The winners of the left view and the disparities of the right one.
pub fn winners(left: &Image<'_>, right: &Image<'_>, costs: &Costs) -> (Vec<Winner>, Vec<u8>) {
    let w = left.width;
    let h = left.height;
    let n = costs.disparities;
    let all: Vec<(usize, usize)> = (0..h).flat_map(|y| (0..w).map(move |x| (x, y))).collect();
    let cost: Vec<Vec<i32>> =
        all.iter().map(|at| (0..n).map(|d| cost(left, right, *at, d)).collect()).collect();
    let mut more = vec![vec![0; n]; w * h];
    for (dx, dy) in [(-1, 0), (-1, -1), (0, -1), (1, -1), (1, 0), (1, 1), (0, 1), (-1, 1)] {
        let backward = dy > 0 || (dy == 0 && dx > 0);
        let mut path: Vec<Vec<i32>> = vec![Vec::new(); w * h];
        for k in 0..w * h {
            let i = if backward { w * h - 1 - k } else { k };
            let (x, y) = all[i];
            let bx = x as isize + dx;
            let by = y as isize + dy;
            path[i] = cost[i].clone();
            if !(0..w as isize).contains(&bx) || !(0..h as isize).contains(&by) {
                continue;
            }
            let before = path[by as usize * w + bx as usize].clone();
            let least = *before.iter().min().unwrap();
            let change = (left.at(x as isize, y as isize) - left.at(bx, by)).abs();
            let large = i32::from(costs.large.most) - (change - i32::from(costs.large.slack)).max(0);
            let large = large.max(i32::from(costs.large.least));
            for d in 0..n {
                let mut added = (before[d] - least).min(large);
                for beside in [d.wrapping_sub(1), d + 1] {
                    if let Some(v) = before.get(beside) {
                        added = added.min(v - least + i32::from(costs.small));
                    }
                }
                path[i][d] += added;
                more[i][d] += added;
            }
        }
    }
    // Half of the sum of all eight paths, in a byte.
    let total: Vec<Vec<u8>> = cost
        .iter()
        .zip(&more)
        .map(|(c, m)| c.iter().zip(m).map(|(c, m)| ((8 * c + (*m).min(255) + 1) / 2) as u8).collect())
        .collect();
    let least = |of: &mut dyn Iterator<Item = (u8, usize)>| of.min().unwrap_or((u8::MAX, 0));
    let winners = total.iter().map(|t| {
        let (cost, d) = least(&mut t.iter().copied().zip(0_usize..));
        let second = least(&mut t.iter().copied().zip(0_usize..).filter(|(_, e)| e.abs_diff(d) > 1)).0;
        let beside = |d: usize| t.get(d).copied().unwrap_or(u8::MAX);
        Winner { disparity: d as u8, cost, before: beside(d.wrapping_sub(1)), after: beside(d + 1), second }
    });
    let mirrored = all
        .iter()
        .enumerate()
        .map(|(i, (x, _))| least(&mut (0..n.min(w - x)).map(|d| (total[i + d][d], d))).1 as u8);
    (winners.collect(), mirrored.collect())
}
