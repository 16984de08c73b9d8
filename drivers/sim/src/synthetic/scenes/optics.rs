//! Faults of a colour camera: blur, noise, and what JPEG leaves of an image.

use super::super::noise::{Rolls, mix, normal_of};
use super::super::random::Draw;
use core::f32::consts::{PI, SQRT_2};

/// Base tables of quantisation for luma and chroma (ITU-T T.81, annex K.1).
const LUMA: [u8; 64] = [
    16, 11, 10, 16, 24, 40, 51, 61, 12, 12, 14, 19, 26, 58, 60, 55, 14, 13, 16, 24, 40, 57, 69, 56, 14, 17,
    22, 29, 51, 87, 80, 62, 18, 22, 37, 56, 68, 109, 103, 77, 24, 35, 55, 64, 81, 104, 113, 92, 49, 64, 78,
    87, 103, 121, 120, 101, 72, 92, 95, 98, 112, 100, 103, 99,
];
const CHROMA: [u8; 64] = [
    17, 18, 24, 47, 99, 99, 99, 99, 18, 21, 26, 66, 99, 99, 99, 99, 24, 26, 56, 99, 99, 99, 99, 99, 47, 66,
    99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99,
    99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99,
];
/// Side of a block.
const N: usize = 8;

/// Gives an image faults that are drawn: half of the images have each.
pub(super) fn blemish(draw: &mut Draw, color: &mut [u8], w: usize) {
    let sigma = draw.scale(0.4, 1.6);
    if draw.chance(0.5) {
        blur(color, w, sigma);
    }
    let level = draw.scale(1.0, 7.0);
    let seed = draw.below(1 << 24) as u64;
    if draw.chance(0.5) {
        for (i, v) in color.iter_mut().enumerate() {
            let noise = normal_of(mix(Rolls::new(seed, i as u32, 0, 0).bits(0)));
            *v = (f32::from(*v) + noise * level).round().clamp(0.0, 255.0) as u8;
        }
    }
    let quality = draw.between(35.0, 96.0);
    if draw.chance(0.5) {
        compress(color, w, quality);
    }
}

/// Gaussian blur; the border repeats.
fn blur(color: &mut [u8], w: usize, sigma: f32) {
    let reach = (sigma * 2.5).ceil() as usize;
    let mut kernel: Vec<f32> =
        (0..=2 * reach).map(|i| (-0.5 * ((i as f32 - reach as f32) / sigma).powi(2)).exp()).collect();
    let sum: f32 = kernel.iter().sum();
    for k in &mut kernel {
        *k /= sum;
    }
    let h = color.len() / 3 / w;
    let mut rows = vec![0.0f32; color.len()];
    for y in 0..h {
        let row = &color[y * w * 3..][..w * 3];
        let out = &mut rows[y * w * 3..][..w * 3];
        for (i, k) in kernel.iter().enumerate() {
            for x in 0..w {
                let from = (x + i).saturating_sub(reach).min(w - 1) * 3;
                for c in 0..3 {
                    out[x * 3 + c] += k * f32::from(row[from + c]);
                }
            }
        }
    }
    let mut sums = vec![0.0f32; w * 3];
    for y in 0..h {
        sums.fill(0.0);
        for (i, k) in kernel.iter().enumerate() {
            let from = (y + i).saturating_sub(reach).min(h - 1);
            for (sum, v) in sums.iter_mut().zip(&rows[from * w * 3..][..w * 3]) {
                *sum += k * v;
            }
        }
        for (out, sum) in color[y * w * 3..][..w * 3].iter_mut().zip(&sums) {
            *out = (sum + 0.5) as u8;
        }
    }
}

/// Rounds each 8x8 block as JPEG of this quality does, with full chroma. Blocks that the border cuts stay.
fn compress(color: &mut [u8], w: usize, quality: f32) {
    let h = color.len() / 3 / w;
    let basis: [[f32; N]; N] = core::array::from_fn(|k| {
        let norm = if k == 0 { 0.5 / SQRT_2 } else { 0.5 };
        core::array::from_fn(|x| norm * ((2 * x + 1) as f32 * k as f32 * PI / 16.0).cos())
    });
    // The scale of libjpeg.
    let scale = if quality < 50.0 { 50.0 / quality } else { 2.0 - quality / 50.0 };
    let tables = [LUMA, CHROMA].map(|t| t.map(|v| (f32::from(v) * scale).round().clamp(1.0, 255.0)));
    for (y, x) in (0..h / N).flat_map(|y| (0..w / N).map(move |x| (y * N, x * N))) {
        let at = |i: usize| ((y + i / N) * w + x + i % N) * 3;
        let pixels: [[f32; 3]; N * N] =
            core::array::from_fn(|i| [0, 1, 2].map(|c| f32::from(color[at(i) + c])));
        let mut planes = [
            pixels.map(|[r, g, b]| 0.299 * r + 0.587 * g + 0.114 * b - 128.0),
            pixels.map(|[r, g, b]| -0.168_736 * r - 0.331_264 * g + 0.5 * b),
            pixels.map(|[r, g, b]| 0.5 * r - 0.418_688 * g - 0.081_312 * b),
        ];
        for (plane, table) in planes.iter_mut().zip([&tables[0], &tables[1], &tables[1]]) {
            *plane = transform(&basis, plane);
            for (v, q) in plane.iter_mut().zip(table) {
                *v = (*v / q).round() * q;
            }
            *plane = transform(&turned(&basis), plane);
        }
        let [luma, blue, red] = planes;
        for (i, ((l, cb), cr)) in luma.into_iter().zip(blue).zip(red).enumerate() {
            let l = l + 128.0;
            let rgb = [l + 1.402 * cr, l - 0.344_136 * cb - 0.714_136 * cr, l + 1.772 * cb];
            for (c, v) in rgb.into_iter().enumerate() {
                color[at(i) + c] = v.round().clamp(0.0, 255.0) as u8;
            }
        }
    }
}

fn turned(basis: &[[f32; N]; N]) -> [[f32; N]; N] {
    core::array::from_fn(|x| core::array::from_fn(|k| basis[k][x]))
}

/// `basis` times block times `basis` turned.
fn transform(basis: &[[f32; N]; N], block: &[f32; N * N]) -> [f32; N * N] {
    let mut half = [0.0f32; N * N];
    for y in 0..N {
        for k in 0..N {
            half[y * N + k] = (0..N).map(|x| basis[k][x] * block[y * N + x]).sum();
        }
    }
    let mut out = [0.0f32; N * N];
    for k in 0..N {
        for y in 0..N {
            for x in 0..N {
                out[k * N + x] += basis[k][y] * half[y * N + x];
            }
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    fn image(w: usize, h: usize) -> Vec<u8> {
        (0..w * h * 3).map(|i| (mix(i as u64 / 3 / 5) >> 58) as u8 * 3 + (i % 3) as u8 * 20).collect()
    }

    fn error(a: &[u8], b: &[u8]) -> f64 {
        a.iter().zip(b).map(|(a, b)| (f64::from(*a) - f64::from(*b)).abs()).sum::<f64>() / a.len() as f64
    }

    #[test]
    fn compression_loses_more_at_lower_quality_and_little_at_the_highest() {
        let before = image(43, 29);
        let off = [100.0, 90.0, 60.0, 30.0].map(|quality| {
            let mut after = before.clone();
            compress(&mut after, 43, quality);
            error(&after, &before)
        });
        assert!(off[0] < 0.7 && off.is_sorted() && off[3] > 4.0, "{off:?}");
    }

    #[test]
    fn blur_keeps_the_mean_and_spreads_a_dot_as_a_gaussian_does() {
        let w = 41;
        let h = 41;
        let mut color = vec![0; w * h * 3];
        color[(20 * w + 20) * 3] = 255;
        blur(&mut color, w, 1.0);
        let at = |x: usize, y: usize| f64::from(color[(y * w + x) * 3]);
        assert!((at(20, 20) - 255.0 / core::f64::consts::TAU).abs() < 1.5, "{}", at(20, 20));
        assert!((at(21, 20) / at(20, 20) - 0.6065).abs() < 0.03 && at(20, 21) == at(21, 20));
        let mut plain = vec![77; w * h * 3];
        blur(&mut plain, w, 1.6);
        assert!(plain.iter().all(|v| *v == 77));
    }

    #[test]
    fn faults_follow_from_the_draw_and_some_images_have_none() {
        let before = image(48, 32);
        let made: Vec<Vec<u8>> = (0..64)
            .map(|n| {
                let mut color = before.clone();
                blemish(&mut Draw::new(2, n / 2, 5), &mut color, 48);
                color
            })
            .collect();
        assert!(made.chunks(2).all(|pair| pair[0] == pair[1]));
        let clean = made.iter().filter(|m| **m == before).count();
        assert!((2..20).contains(&clean), "{clean}");
    }
}
