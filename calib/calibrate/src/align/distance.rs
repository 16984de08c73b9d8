//! Signed distance to the outline of a mask.

use glam::DVec2;

/// Further than every distance in an image, squared.
const FAR: f32 = 1e12;

/// Distance of each pixel to the outline, pixels: negative inside. The outline runs half-way between neighbouring pixels inside
/// and outside; the border of the image does not count.
#[derive(Debug, Clone)]
pub(super) struct SignedDistance {
    width: usize,
    height: usize,
    values: Vec<f32>,
}

impl SignedDistance {
    pub(super) fn new(mask: &[bool], width: usize, height: usize) -> Self {
        let outside = squared(mask, width, height, true);
        let inside = squared(mask, width, height, false);
        let values = outside
            .iter()
            .zip(&inside)
            .map(|(o, i)| if *o > 0.0 { o.sqrt() - 0.5 } else { 0.5 - i.sqrt() })
            .collect();
        Self { width, height, values }
    }

    fn value(&self, x: usize, y: usize) -> f64 {
        f64::from(self.values[y * self.width + x])
    }

    /// Distance at a place, bilinear; at the border of the image for places outside it.
    pub(super) fn at(&self, p: DVec2) -> f64 {
        let x = p.x.clamp(0.0, self.width as f64 - 1.0);
        let y = p.y.clamp(0.0, self.height as f64 - 1.0);
        let x0 = x as usize;
        let y0 = y as usize;
        let x1 = (x0 + 1).min(self.width - 1);
        let y1 = (y0 + 1).min(self.height - 1);
        let fx = x - x0 as f64;
        let fy = y - y0 as f64;
        let top = self.value(x0, y0) * (1.0 - fx) + self.value(x1, y0) * fx;
        let bottom = self.value(x0, y1) * (1.0 - fx) + self.value(x1, y1) * fx;
        top * (1.0 - fy) + bottom * fy
    }

    /// The direction in which the distance grows, from differences over `reach` pixels to each side, of unit length; `None` on
    /// ridges.
    pub(super) fn normal(&self, p: DVec2, reach: f64) -> Option<DVec2> {
        let dx = self.at(p + DVec2::new(reach, 0.0)) - self.at(p - DVec2::new(reach, 0.0));
        let dy = self.at(p + DVec2::new(0.0, reach)) - self.at(p - DVec2::new(0.0, reach));
        let gradient = DVec2::new(dx, dy);
        // Near ridges and valleys the differences cancel.
        (gradient.length() > reach).then(|| gradient.normalize())
    }
}

/// Pairs of neighbouring pixels inside and outside.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Edge {
    /// Column of the pixel inside.
    pub x: usize,
    /// Row of the pixel inside.
    pub y: usize,
    /// Half-way to the pixel outside.
    pub at: DVec2,
}

/// The outline of a mask as edges between pixels.
pub(super) fn outline(mask: &[bool], width: usize, height: usize) -> Vec<Edge> {
    let mut edges = Vec::new();
    for y in 0..height {
        for x in 0..width {
            let here = mask[y * width + x];
            if x + 1 < width && mask[y * width + x + 1] != here {
                edges.push(Edge { x: x + usize::from(!here), y, at: DVec2::new(x as f64 + 0.5, y as f64) });
            }
            if y + 1 < height && mask[(y + 1) * width + x] != here {
                edges.push(Edge { x, y: y + usize::from(!here), at: DVec2::new(x as f64, y as f64 + 0.5) });
            }
        }
    }
    edges
}

/// Squared distance to the nearest pixel whose mask is `target` (Felzenszwalb and Huttenlocher, Distance Transforms of Sampled
/// Functions, 2012).
fn squared(mask: &[bool], width: usize, height: usize, target: bool) -> Vec<f32> {
    let mut values = vec![FAR; width * height];
    // Along columns the distance to the nearest is counted up from above and from below, all columns at once.
    let mut steps = vec![f32::INFINITY; width];
    for y in 0..height {
        for (x, steps) in steps.iter_mut().enumerate() {
            *steps = if mask[y * width + x] == target { 0.0 } else { *steps + 1.0 };
            values[y * width + x] = (*steps * *steps).min(FAR);
        }
    }
    steps.fill(f32::INFINITY);
    for y in (0..height).rev() {
        for (x, steps) in steps.iter_mut().enumerate() {
            *steps = if mask[y * width + x] == target { 0.0 } else { *steps + 1.0 };
            let value = &mut values[y * width + x];
            *value = value.min(*steps * *steps);
        }
    }
    let mut row = vec![0.0_f32; width];
    let mut lowest: Vec<usize> = vec![0; width];
    let mut from: Vec<f32> = vec![0.0; width + 1];
    for y in 0..height {
        let line = &mut values[y * width..(y + 1) * width];
        // Far rows and rows inside the target need no envelope.
        if line.iter().all(|v| *v == 0.0) || line.iter().all(|v| *v >= FAR) {
            continue;
        }
        row.copy_from_slice(line);
        envelope(&row, &mut lowest, &mut from, line);
    }
    values
}

/// The lower envelope of parabolas of heights `row`.
fn envelope(row: &[f32], lowest: &mut [usize], from: &mut [f32], out: &mut [f32]) {
    let mut last = 0;
    lowest[0] = 0;
    from[0] = f32::NEG_INFINITY;
    from[1] = f32::INFINITY;
    for q in 1..row.len() {
        if row[q] >= FAR {
            continue;
        }
        let square = row[q] + (q * q) as f32;
        loop {
            let p = lowest[last];
            let meet = if row[p] >= FAR {
                f32::NEG_INFINITY
            } else {
                (square - row[p] - (p * p) as f32) / (2 * (q - p)) as f32
            };
            if meet > from[last] || (last == 0 && meet > f32::NEG_INFINITY) {
                last += 1;
                lowest[last] = q;
                from[last] = meet;
                from[last + 1] = f32::INFINITY;
                break;
            }
            if last == 0 {
                lowest[0] = q;
                from[1] = f32::INFINITY;
                break;
            }
            last -= 1;
        }
    }
    let mut k = 0;
    for (x, value) in out.iter_mut().enumerate() {
        while from[k + 1] < x as f32 {
            k += 1;
        }
        let d = x as f32 - lowest[k] as f32;
        *value = d * d + row[lowest[k]];
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn distances_are_those_of_a_search_over_all_pixels() {
        let width = 37;
        let height = 23;
        let mut state = 1_u64;
        for share in [2_u64, 20, 300] {
            let mask: Vec<bool> = (0..width * height)
                .map(|_| {
                    state =
                        state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
                    (state >> 33).is_multiple_of(share)
                })
                .collect();
            assert!(mask.contains(&true) && mask.contains(&false));
            for target in [true, false] {
                let found = squared(&mask, width, height, target);
                for y in 0..height {
                    for x in 0..width {
                        let nearest = (0..width * height)
                            .filter(|i| mask[*i] == target)
                            .map(|i| (i % width).abs_diff(x).pow(2) + (i / width).abs_diff(y).pow(2))
                            .min()
                            .unwrap();
                        assert_eq!(found[y * width + x] as usize, nearest, "{x} {y} {target} {share}");
                    }
                }
            }
        }
    }

    #[test]
    fn the_outline_is_half_way_between_pixels() {
        // Columns 3 and more are inside.
        let mask: Vec<bool> = (0..80).map(|i| i % 10 >= 3).collect();
        let distance = SignedDistance::new(&mask, 10, 8);
        assert!(distance.at(DVec2::new(2.5, 4.0)).abs() < 1e-6);
        assert!((distance.at(DVec2::new(0.0, 4.0)) - 2.5).abs() < 1e-6);
        assert!((distance.at(DVec2::new(6.0, 4.0)) + 3.5).abs() < 1e-6);
        assert_eq!(distance.normal(DVec2::new(2.5, 4.0), 1.0), Some(DVec2::new(-1.0, 0.0)));
        let edges = outline(&mask, 10, 8);
        assert_eq!(edges.len(), 8);
        assert!(edges.iter().all(|e| e.x == 3 && e.at.x == 2.5));
    }
}
