//! Removes disparities without texture.
//!
//! Where the images show nothing but noise, each pixel has a best disparity too, and paths make surfaces of them. One margin
//! between the best cost and the second says little, since noise has large ones now and then; their mean over a window does:
//! on noise it stays below a bound, on texture it is several times that.

use super::choose::NONE;
use super::kernel::Winner;
use crate::simd::for_every_processor;

/// Pixels from the middle of a window to its sides.
const RADIUS: usize = 6;
/// Pixels of a window's side. So many margins of a byte in both directions fit 16 bits.
const SIDE: usize = 2 * RADIUS + 1;

for_every_processor! {
    /// Adds one row's margins to the sums of columns, and takes another's away.
    fn slide(enters: &[Winner], leaves: &[Winner], sums: &mut [u16]) {
        for ((sum, enters), leaves) in sums.iter_mut().zip(enters).zip(leaves) {
            let margin = |w: &Winner| u16::from(w.second.saturating_sub(w.cost));
            // The row that leaves was added before.
            *sum = sum.wrapping_add(margin(enters)).wrapping_sub(margin(leaves));
        }
    }
}

for_every_processor! {
    /// Removes disparities in a window whose sum is below `least`; `sums` has [`SIDE`] - 1 columns more than the row.
    fn remove(sums: &[u16], least: u16, map: &mut [u16], confidence: &mut [u8]) {
        let n = map.len();
        for x in 0..n {
            let mut sum = 0_u16;
            for k in 0..SIDE {
                sum = sum.wrapping_add(sums[x + k]);
            }
            let is_flat = sum < least;
            map[x] = if is_flat { NONE } else { map[x] };
            confidence[x] = if is_flat { 0 } else { confidence[x] };
        }
    }
}

/// Sums of margins in windows of 13x13 pixels; beyond the edges of the image its outermost pixels are repeated.
#[derive(Debug)]
pub struct Texture {
    /// Of each column of the window's rows, with those beyond both sides.
    sums: Vec<u16>,
}

impl Texture {
    /// For images of this width.
    pub fn new(width: usize) -> Self {
        Self { sums: vec![0; width + SIDE - 1] }
    }

    pub fn bytes(&self) -> usize {
        2 * self.sums.len()
    }

    /// Removes the disparities of `map` where the mean margin of `winners` is below `least`.
    pub fn remove(
        &mut self,
        winners: &[Winner],
        width: usize,
        least: u8,
        map: &mut [u16],
        confidence: &mut [u8],
    ) {
        let height = winners.len() / width;
        let row = |y: usize| &winners[y.min(height - 1) * width..][..width];
        let sums = &mut self.sums[..];
        sums.fill(0);
        // The window of the row before the first one, whose outermost row is not in it yet.
        for y in 0..=2 * RADIUS {
            for (sum, w) in sums[RADIUS..].iter_mut().zip(row(y.saturating_sub(RADIUS + 1))) {
                *sum += u16::from(w.second.saturating_sub(w.cost));
            }
        }
        let least = u16::from(least) * (SIDE * SIDE) as u16;
        let rows = map.chunks_exact_mut(width).zip(confidence.chunks_exact_mut(width));
        for (y, (map, confidence)) in rows.enumerate() {
            slide(row(y + RADIUS), row(y.saturating_sub(RADIUS + 1)), &mut sums[RADIUS..][..width]);
            let first = sums[RADIUS];
            let last = sums[RADIUS + width - 1];
            sums[..RADIUS].fill(first);
            sums[RADIUS + width..].fill(last);
            remove(sums, least, map, confidence);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simd::in_every_width;
    use crate::stereo::{DisparityMap, Gray, Matcher, Parameters, Preset, SgmMatcher, StereoPair};
    use proptest::prelude::*;

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]

        /// All vectors remove what the mean of every window, computed anew, says.
        #[test]
        fn windows_are_summed_as_the_slow_way_sums_them(
            (w, h) in (1_usize..60, 1_usize..30),
            least in 0_u8..=60,
            seed in 1..u64::MAX,
        ) {
            let mut state = seed;
            let mut next = || {
                state ^= state << 13;
                state ^= state >> 7;
                state ^= state << 17;
                (state >> 32) as u8
            };
            let mut winner = || Winner { cost: next() / 2, second: next() / 2, ..Winner::default() };
            let winners: Vec<Winner> = (0..w * h).map(|_| winner()).collect();
            let mean = |x: usize, y: usize| {
                let near = |at: usize, n: usize| (0..SIDE).map(move |k| (at + k).saturating_sub(RADIUS).min(n - 1));
                let margin = |w: &Winner| u32::from(w.second.saturating_sub(w.cost));
                near(y, h).flat_map(|v| near(x, w).map(move |u| (u, v))).map(|(u, v)| margin(&winners[v * w + u])).sum::<u32>()
            };
            in_every_width(|width| {
                let mut texture = Texture::new(w);
                // The second time, the sums are those of another image.
                for _ in 0..2 {
                    let mut map = vec![7; w * h];
                    let mut confidence = vec![9; w * h];
                    texture.remove(&winners, w, least, &mut map, &mut confidence);
                    for i in 0..w * h {
                        let is_flat = mean(i % w, i / w) < u32::from(least) * (SIDE * SIDE) as u32;
                        let want = if is_flat { (NONE, 0) } else { (7, 9) };
                        assert_eq!((map[i], confidence[i]), want, "{} {} {width:?}", i % w, i / w);
                    }
                }
            });
        }
    }

    /// Boxes of plain paint, lit from one side, in front of a wall with texture; with the noise of a sensor. Disparity of the
    /// left image, and which pixels are a box.
    fn painted_boxes(w: usize, h: usize, noise: f64) -> ([Vec<u8>; 2], Vec<f32>) {
        let hash = |a: usize, b: usize, seed: u64| {
            let mut x = (a as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15)
                ^ (b as u64).wrapping_mul(0xC2B2_AE3D_27D4_EB4F)
                ^ seed.wrapping_mul(0x1656_67B1_9E37_79F9);
            x = (x ^ (x >> 31)).wrapping_mul(0x94D0_49BB_1331_11EB);
            (x >> 40) as f64 / f64::from(1 << 24)
        };
        let boxed = |x: usize, y: usize| {
            (h / 5..4 * h / 5).contains(&y) && x.wrapping_sub(w / 8) % (w / 3) < w / 5 && x >= w / 8
        };
        let truth: Vec<f32> = (0..w * h).map(|i| if boxed(i % w, i / w) { 30.0 } else { 10.0 }).collect();
        let color = |x: usize, y: usize, d: f32| {
            if d > 20.0 { 90.0 + 60.0 * x as f64 / w as f64 } else { 40.0 + 160.0 * hash(x, y, 5) }
        };
        let sensor =
            |i: usize, side: u64| noise * ((0..4).map(|k| hash(i, k, 70 + side)).sum::<f64>() - 2.0) * 1.7;
        let mut left = vec![0.0; w * h];
        let mut right = vec![0.0; w * h];
        for near in [10, 30] {
            for i in (0..w * h).filter(|i| truth[*i] == near as f32) {
                left[i] = color(i % w, i / w, truth[i]);
                if i % w >= near {
                    right[i - near] = left[i];
                }
            }
        }
        let sides = [(left, 0), (right, 1)];
        let seen = sides.map(|(image, n)| {
            image
                .iter()
                .enumerate()
                .map(|(i, v)| (v + sensor(i, n)).round().clamp(0.0, 255.0) as u8)
                .collect()
        });
        (seen, truth)
    }

    #[test]
    fn what_has_no_texture_gets_no_disparity_and_texture_keeps_its_own() {
        let w = 420;
        let h = 200;
        for noise in [2.0, 5.0] {
            let ([left, right], truth) = painted_boxes(w, h, noise);
            let pair = StereoPair::new(Gray::packed(&left, w, h), Gray::packed(&right, w, h));
            for preset in Preset::ALL {
                let shares = |parameters: &Parameters| {
                    let mut out = DisparityMap::default();
                    SgmMatcher::new(w, h, parameters, 1).unwrap().run(&pair, &mut out).unwrap();
                    // Not the first columns, nor what a box hides from the right camera.
                    let of = |near: bool, f: &dyn Fn(f32, f32) -> bool| {
                        let counts = |i: &usize| {
                            let x = i % w;
                            let hidden = (0..22).any(|k| x + k < w && truth[i + k] > 20.0);
                            x >= 48 && (truth[*i] > 20.0) == near && (near || !hidden)
                        };
                        let all: Vec<usize> = (0..w * h).filter(counts).collect();
                        all.iter().filter(|i| f(out.disparity[**i], truth[**i])).count() as f64
                            / all.len() as f64
                    };
                    let wrong = |d: f32, t: f32| (d - t).abs() > 2.0;
                    [of(true, &wrong), of(false, &wrong), of(false, &|d, _| d.is_nan())]
                };
                let rejecting = Parameters::preset(preset, 64);
                let all = Parameters { texture_margin: 0, half_texture_margin: 0, ..rejecting.clone() };
                let [[before, wall_before, missing_before], [after, wall, missing]] =
                    [&all, &rejecting].map(shares);
                let case = format!(
                    "{preset}, noise {noise}: boxes wrong {before:.3} {after:.3}, wall {wall_before:.3} {wall:.3}, missing {missing_before:.4} {missing:.4}"
                );
                assert!(before > 0.1 && after < before / 2.5, "{case}");
                assert!(wall < wall_before + 0.01 && missing < missing_before + 0.02, "{case}");
            }
        }
    }
}
