//! The lower convex hull of the points of a sliding window: the envelope of the fastest deliveries.
//!
//! A frame can be late but not early, so among points (device time `x`, arrival − device time `d`) only the low
//! ones know the clock. The textbook one-pass hull forgets each point that another one shadows, and cannot bring
//! it back when that other one leaves the window: after a clock moved up, one old low point would rule for ever.
//! So the lowest point of each slice of the window is kept beside the hull, and the hull is built again from
//! those when the oldest leave, eight slices together: some 256 steps, 32 times in a window.

use std::collections::VecDeque;

/// Slices of the window whose lowest point is kept.
const SLICES: i64 = 256;
/// Slices that leave together.
const BATCH: i64 = 8;
/// Slices at most: the window, the batch and what a pause keeps.
const MAX_SLICES: usize = 2 * SLICES as usize;
/// Vertices at most. A window of real frames has under a hundred; this bounds memory for input that is not.
const MAX_VERTICES: usize = 4096;

/// A moment on two clocks: of a device and the host, or of two hosts.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Point {
    /// Device time, nanoseconds since the epoch's first frame.
    pub x: i64,
    /// Arrival minus device time, nanoseconds.
    pub d: i64,
}

/// A line `d(x) = d0 + slope (x - x0)`; `slope` is the host's rate over the device's, minus one.
#[derive(Debug, Clone, Copy)]
pub struct Line {
    /// A time on the line.
    pub x0: i64,
    /// Its height there, nanoseconds.
    pub d0: i64,
    /// Rise per nanosecond.
    pub slope: f64,
}

impl Line {
    /// The line's height over `x`, nanoseconds.
    pub fn at(&self, x: i64) -> f64 {
        self.d0 as f64 + self.slope * (x.saturating_sub(self.x0)) as f64
    }
}

/// The lowest point of one slice of time.
#[derive(Debug, Clone, Copy)]
struct Slice {
    index: i64,
    lowest: Point,
    count: u64,
}

/// Lower convex hull of the last `window_ns`.
#[derive(Debug)]
pub struct Hull {
    window_ns: i64,
    /// Old points stay until the newer ones span this much: a pause must not leave a slope without a lever.
    keep_ns: i64,
    slice_ns: i64,
    vertices: VecDeque<Point>,
    slices: VecDeque<Slice>,
    count: u64,
}

impl Hull {
    /// An empty hull of the last `window_ns` nanoseconds; a pause never leaves less than `keep_ns` of history.
    pub fn new(window_ns: i64, keep_ns: i64) -> Self {
        let slice_ns = (window_ns / SLICES).max(1);
        Self {
            window_ns,
            keep_ns: keep_ns.min(window_ns),
            slice_ns,
            vertices: VecDeque::with_capacity(128),
            slices: VecDeque::with_capacity(SLICES as usize + 2),
            count: 0,
        }
    }

    /// Forgets every point.
    pub fn clear(&mut self) {
        self.vertices.clear();
        self.slices.clear();
        self.count = 0;
    }

    /// Vertices of the hull.
    pub(super) fn len(&self) -> usize {
        self.vertices.len()
    }

    /// Points in the window, whether they touch the hull or not.
    pub(super) fn count(&self) -> u64 {
        self.count
    }

    /// Device time from the first vertex to the last, nanoseconds.
    pub(super) fn span_ns(&self) -> i64 {
        match (self.vertices.front(), self.vertices.back()) {
            (Some(first), Some(last)) => last.x - first.x,
            _ => 0,
        }
    }

    /// Takes a point; one that is not later than the last is only used when it is lower at the same time.
    /// `slope` says what "lowest of its slice" means: lowest above a line of this slope.
    pub fn push(&mut self, p: Point, slope: f64) {
        if self.vertices.back().is_some_and(|v| p.x < v.x || (p.x == v.x && p.d >= v.d)) {
            return;
        }
        let index = p.x.div_euclid(self.slice_ns);
        self.count += 1;
        match self.slices.back_mut() {
            Some(slice) if slice.index == index => {
                slice.count += 1;
                let rise = slope * (p.x - slice.lowest.x) as f64;
                if (p.d - slice.lowest.d) as f64 <= rise {
                    slice.lowest = p;
                }
            }
            _ => self.slices.push_back(Slice { index, lowest: p, count: 1 }),
        }
        append(&mut self.vertices, p);
        self.expire(p.x);
    }

    fn expire(&mut self, now: i64) {
        let oldest = now - self.window_ns;
        let limit = oldest - BATCH * self.slice_ns;
        if self.slices.front().is_none_or(|s| s.lowest.x >= limit) && self.slices.len() <= MAX_SLICES {
            self.bound();
            return;
        }
        let before = self.slices.len();
        // The slice after the front one is what would remain; it must still reach back far enough.
        while self.slices.len() > 1
            && (self.slices[0].lowest.x < oldest && now - self.slices[1].lowest.x >= self.keep_ns
                || self.slices.len() > MAX_SLICES)
        {
            self.count -= self.slices.pop_front().map_or(0, |s| s.count);
        }
        if self.slices.len() < before {
            self.rebuild();
        }
        self.bound();
    }

    fn bound(&mut self) {
        while self.vertices.len() > MAX_VERTICES {
            self.vertices.pop_front();
        }
    }

    /// The hull of the slices' lowest points and of the newest point, which is always a vertex.
    fn rebuild(&mut self) {
        let newest = self.vertices.back().copied();
        self.vertices.clear();
        for slice in &self.slices {
            append(&mut self.vertices, slice.lowest);
        }
        if let Some(p) = newest
            && self.vertices.back().is_none_or(|v| v.x < p.x)
        {
            append(&mut self.vertices, p);
        }
    }

    /// The edge over `x`, as a line; none while the hull is a single point.
    pub(super) fn edge(&self, x: i64) -> Option<Line> {
        let after = self.vertices.partition_point(|v| v.x <= x).clamp(1, self.vertices.len().max(2) - 1);
        let a = self.vertices.get(after - 1)?;
        let b = self.vertices.get(after)?;
        Some(Line { x0: a.x, d0: a.d, slope: (b.d - a.d) as f64 / (b.x - a.x) as f64 })
    }

    /// The highest line of the given slope that no point lies below; none while the hull is empty.
    pub fn support(&self, slope: f64) -> Option<Line> {
        let x0 = self.vertices.front()?.x;
        let height = |v: &Point| v.d as f64 - slope * (v.x - x0) as f64;
        let lowest = self.vertices.iter().min_by(|a, b| height(a).total_cmp(&height(b)))?;
        Some(Line { x0: lowest.x, d0: lowest.d, slope })
    }
}

/// Adds the rightmost point to a lower hull: whatever it leaves above the new edge goes.
fn append(hull: &mut VecDeque<Point>, p: Point) {
    while let Some(&b) = hull.back() {
        let above = if b.x == p.x {
            b.d >= p.d
        } else if let Some(&a) = hull.len().checked_sub(2).and_then(|i| hull.get(i)) {
            let cross =
                i128::from(b.x - a.x) * i128::from(p.d - a.d) - i128::from(p.x - a.x) * i128::from(b.d - a.d);
            cross <= 0
        } else {
            false
        };
        if !above {
            break;
        }
        hull.pop_back();
    }
    hull.push_back(p);
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Points that nothing shadows, the slow way: a point stays when no pair around it passes below it.
    fn slow(points: &[Point]) -> Vec<Point> {
        let below = |p: Point| {
            points.iter().any(|a| {
                points.iter().any(|b| {
                    a.x < p.x
                        && p.x < b.x
                        && i128::from(p.d - a.d) * i128::from(b.x - a.x)
                            >= i128::from(b.d - a.d) * i128::from(p.x - a.x)
                })
            })
        };
        points.iter().copied().filter(|&p| !below(p)).collect()
    }

    proptest! {
        #[test]
        fn is_the_lower_hull_of_all_points_while_none_expires(
            steps in prop::collection::vec((1i64..50, -40i64..40), 1..60)
        ) {
            let mut hull = Hull::new(1_000_000, 0);
            let mut x = 0;
            let mut points = Vec::new();
            for (dx, d) in steps {
                x += dx;
                points.push(Point { x, d });
                hull.push(Point { x, d }, 0.0);
            }
            prop_assert_eq!(hull.vertices.iter().copied().collect::<Vec<_>>(), slow(&points));
        }

        #[test]
        fn is_the_lower_hull_of_the_window_with_one_point_a_slice(
            steps in prop::collection::vec((0i64..4, -40i64..40), 1..80)
        ) {
            // Slices of 10 and at most one point in each: the window's hull must be exact.
            let mut hull = Hull::new(2560, 0);
            let mut x = 0;
            let mut points = Vec::new();
            for (skip, d) in steps {
                x += 10 + 170 * skip;
                points.push(Point { x, d });
                hull.push(Point { x, d }, 0.0);
                if points[0].x < x - 2560 - 10 * BATCH {
                    points.retain(|p| p.x >= x - 2560);
                }
                prop_assert_eq!(hull.vertices.iter().copied().collect::<Vec<_>>(), slow(&points));
                prop_assert_eq!(hull.count(), points.len() as u64);
            }
        }
    }

    #[test]
    fn one_old_low_point_does_not_outlive_the_window() {
        let mut hull = Hull::new(60_000, 5_000);
        for i in 0..3000 {
            let d = if i < 1000 { 0 } else { 100 };
            hull.push(Point { x: i * 33, d }, 0.0);
        }
        assert_eq!(hull.support(0.0).unwrap().d0, 100);
        assert!(hull.span_ns() <= 62_000);
    }

    #[test]
    fn a_pause_keeps_the_lever_until_the_new_points_have_one() {
        let mut hull = Hull::new(60_000, 5_000);
        for i in 0..300 {
            hull.push(Point { x: i * 33, d: 0 }, 0.0);
        }
        hull.push(Point { x: 500_000, d: 40 }, 0.0);
        assert!(hull.span_ns() > 480_000);
        for i in 1..300 {
            hull.push(Point { x: 500_000 + i * 33, d: 0 }, 0.0);
        }
        assert!(hull.span_ns() < 60_000, "{}", hull.span_ns());
    }
}
