//! Raw depth with every hole filled: the paper's "Filled" input.
//!
//! A hole gets the depth of the nearest measured pixel (Euclidean distance between pixels, exact). Columns first, then the
//! lower envelope of parabolas along each row: P. Felzenszwalb and D. Huttenlocher, "Distance Transforms of Sampled
//! Functions", 2012.

/// Fills the holes (0 and 65535) of an image of `width` pixels per row; one without any depth stays as it is.
pub fn nearest(pixels: &[u16], width: usize) -> Vec<u16> {
    let is_hole = |v: u16| v == 0 || v == u16::MAX;
    if width == 0 || pixels.iter().all(|v| is_hole(*v)) {
        return pixels.to_vec();
    }
    let height = pixels.len() / width;
    // The row of the nearest measured pixel of the same column.
    let mut source = vec![usize::MAX; pixels.len()];
    for x in 0..width {
        let mut last = usize::MAX;
        for y in 0..height {
            if !is_hole(pixels[y * width + x]) {
                last = y;
            }
            source[y * width + x] = last;
        }
        last = usize::MAX;
        for y in (0..height).rev() {
            if !is_hole(pixels[y * width + x]) {
                last = y;
            }
            let above = source[y * width + x];
            if last != usize::MAX && (above == usize::MAX || last - y < y - above) {
                source[y * width + x] = last;
            }
        }
    }
    let mut out = pixels.to_vec();
    let mut envelope = Envelope::default();
    for y in 0..height {
        let row = &source[y * width..(y + 1) * width];
        envelope.of(row, y);
        let mut k = 0;
        for x in 0..width {
            while k + 1 < envelope.columns.len() && envelope.from[k + 1] < x as f64 {
                k += 1;
            }
            let column = envelope.columns[k];
            out[y * width + x] = pixels[row[column] * width + column];
        }
    }
    out
}

/// The columns whose parabolas are lowest somewhere, and from where on.
#[derive(Default)]
struct Envelope {
    columns: Vec<usize>,
    from: Vec<f64>,
}

impl Envelope {
    fn of(&mut self, row: &[usize], y: usize) {
        self.columns.clear();
        self.from.clear();
        let height = |x: usize| {
            let d = row[x].abs_diff(y) as f64;
            d * d + (x * x) as f64
        };
        for x in (0..row.len()).filter(|x| row[*x] != usize::MAX) {
            let mut from = f64::NEG_INFINITY;
            while let (Some(last), Some(begin)) = (self.columns.last().copied(), self.from.last().copied()) {
                from = (height(x) - height(last)) / (2 * (x - last)) as f64;
                if from > begin {
                    break;
                }
                self.columns.pop();
                self.from.pop();
                from = f64::NEG_INFINITY;
            }
            self.columns.push(x);
            self.from.push(from);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Every hole has the depth of one of the pixels that no other is nearer than.
    #[test]
    fn a_hole_gets_a_nearest_depth() {
        let mut state = 7u64;
        let mut next = |n: u64| {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            (state >> 33) % n
        };
        for (width, height) in [(1, 1), (1, 9), (13, 1), (17, 11), (24, 24)] {
            for one_of in [1, 2, 9, 60] {
                let pixels: Vec<u16> = (0..width * height)
                    .map(|i| if next(one_of) == 0 { 1 + i as u16 } else { [0, u16::MAX][i % 2] })
                    .collect();
                let got = nearest(&pixels, width);
                let measured: Vec<usize> =
                    (0..pixels.len()).filter(|i| pixels[*i] != 0 && pixels[*i] != u16::MAX).collect();
                let far = |a: usize, b: usize| {
                    (a % width).abs_diff(b % width).pow(2) + (a / width).abs_diff(b / width).pow(2)
                };
                for (i, value) in got.iter().enumerate() {
                    let Some(best) = measured.iter().map(|m| far(i, *m)).min() else {
                        assert_eq!(*value, pixels[i]);
                        continue;
                    };
                    // A depth is its place.
                    assert_eq!(far(i, usize::from(*value) - 1), best, "{width}x{height} 1/{one_of} at {i}");
                }
            }
        }
    }
}
