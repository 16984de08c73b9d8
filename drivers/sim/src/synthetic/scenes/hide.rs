//! Regions of measured depth hidden at random, so that a network learns to fill holes from context of every kind.
//!
//! Holes of a sensor have a cause: glass, dark things, what lies behind edges. A network that sees only such holes
//! learns the cause instead of the context. A hidden region is a rectangle, a border, a blob or a thing, of any size.

use super::super::noise::{Rolls, fractal2};
use super::super::random::Draw;

/// Smallest side of a rectangle, pixels.
const LEAST_SIDE: f32 = 6.0;
/// Measured depth that is kept at least, as a share.
const KEEP: f32 = 0.1;

/// A region.
enum Region {
    /// Turned around its middle: pixels, half of the sides, sine and cosine.
    Rectangle { middle: [f32; 2], half: [f32; 2], turn: [f32; 2] },
    /// So far from a side: left, right, top, bottom.
    Border { side: usize, wide: f32 },
    /// Where smooth noise of this size is above a level.
    Blob { size: f32, level: f32, layer: i32 },
    /// A share of the things, walls and the floor too.
    Things { share: f32, seed: u64 },
}

/// Hides regions of `raw`, an image of `size`; `keys` has the thing at each pixel. Returns the share of measured pixels
/// that it hid.
pub(super) fn hide(draw: &mut Draw, raw: &mut [u16], size: (u32, u32), keys: impl Fn(usize) -> u16) -> f32 {
    let w = size.0 as usize;
    let regions = regions(draw, [size.0 as f32, size.1 as f32]);
    let is_hidden = |i: usize| {
        let x = (i % w) as f32;
        let y = (i / w) as f32;
        regions.iter().any(|r| r.contains([x, y], [size.0 as f32, size.1 as f32], || keys(i)))
    };
    let measured = raw.iter().filter(|z| **z > 0).count();
    let hidden: Vec<usize> = (0..raw.len()).filter(|i| raw[*i] > 0 && is_hidden(*i)).collect();
    let share = hidden.len() as f32 / measured.max(1) as f32;
    if share > 1.0 - KEEP {
        return 0.0;
    }
    for i in hidden {
        raw[i] = 0;
    }
    share
}

fn regions(draw: &mut Draw, [w, h]: [f32; 2]) -> Vec<Region> {
    let mut regions = Vec::new();
    for _ in 0..=draw.weighted(&[0.6, 0.3, 0.1]) {
        match draw.weighted(&[0.45, 0.12, 0.23, 0.2]) {
            0 => {
                let most = if draw.chance(0.5) { 0.6 } else { 0.25 };
                for _ in 0..=draw.below(6) {
                    let side = draw.scale(LEAST_SIDE, most * h);
                    let stretch = draw.scale(0.4, 2.5);
                    let turn = if draw.chance(0.5) { 0.0 } else { draw.between(0.0, 3.15) };
                    regions.push(Region::Rectangle {
                        middle: [draw.between(0.0, w), draw.between(0.0, h)],
                        half: [side * stretch.sqrt() / 2.0, side / stretch.sqrt() / 2.0],
                        turn: [turn.sin(), turn.cos()],
                    });
                }
            }
            1 => {
                let side = draw.below(4);
                regions.push(Region::Border {
                    side,
                    wide: draw.scale(0.03, 0.4) * if side < 2 { w } else { h },
                });
            }
            2 => regions.push(Region::Blob {
                size: draw.scale(0.03, 0.5) * h,
                level: draw.between(0.5, 0.75),
                layer: draw.below(1 << 20) as i32,
            }),
            _ => regions
                .push(Region::Things { share: draw.between(0.05, 0.45), seed: draw.below(1 << 20) as u64 }),
        }
    }
    regions
}

impl Region {
    fn contains(&self, [x, y]: [f32; 2], [w, h]: [f32; 2], key: impl Fn() -> u16) -> bool {
        match self {
            Self::Rectangle { middle, half, turn: [sin, cos] } => {
                let (x, y) = (x - middle[0], y - middle[1]);
                (x * cos + y * sin).abs() <= half[0] && (y * cos - x * sin).abs() <= half[1]
            }
            Self::Border { side, wide } => [x, w - 1.0 - x, y, h - 1.0 - y][*side] < *wide,
            Self::Blob { size, level, layer } => fractal2(x / size, y / size, *layer) > *level,
            Self::Things { share, seed } => Rolls::new(*seed, u32::from(key()), 0, 0).unit(0) < *share,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn regions_are_of_every_size_and_touch_nothing_else() {
        let mut shares = Vec::new();
        for number in 0..300 {
            let mut raw: Vec<u16> =
                (0..160 * 120).map(|i| if i % 7 == 0 { 0 } else { 500 + i as u16 }).collect();
            let before = raw.clone();
            let key = |i: usize| (i % 160 / 20 + i / 160 / 20 * 8) as u16;
            let share = hide(&mut Draw::new(1, number, 4), &mut raw, (160, 120), key);
            let mut again = before.clone();
            assert_eq!(hide(&mut Draw::new(1, number, 4), &mut again, (160, 120), key), share);
            assert_eq!(again, raw);
            assert!(raw.iter().zip(&before).all(|(r, b)| r == b || *r == 0));
            let count = |of: &[u16]| of.iter().filter(|z| **z > 0).count() as f32;
            assert!((share - (1.0 - count(&raw) / count(&before))).abs() < 1e-6, "{number}: {share}");
            shares.push(share);
        }
        shares.sort_by(f32::total_cmp);
        // A few hundredths, some tenths, and half of the image.
        assert!(shares[75] < 0.12 && shares[150] > 0.05 && shares[285] > 0.4, "{shares:?}");
        assert!(shares[299] <= 1.0 - KEEP);
    }

    #[test]
    fn each_kind_hides_its_own_pixels() {
        let size = [100.0, 80.0];
        let at = |r: &Region, x: f32, y: f32| r.contains([x, y], size, || (x / 10.0) as u16);
        let turned = Region::Rectangle { middle: [50.0, 40.0], half: [20.0, 2.0], turn: [1.0, 0.0] };
        assert!(at(&turned, 50.0, 58.0) && !at(&turned, 68.0, 40.0));
        let sides: Vec<Region> = (0..4).map(|side| Region::Border { side, wide: 10.0 }).collect();
        let middles = [(5.0, 40.0), (95.0, 40.0), (50.0, 5.0), (50.0, 75.0)];
        for (i, (x, y)) in middles.into_iter().enumerate() {
            let inside: Vec<bool> = sides.iter().map(|s| at(s, x, y)).collect();
            assert!((0..4).all(|k| inside[k] == (k == i)), "{inside:?} at {x}, {y}");
        }
        let things = Region::Things { share: 0.5, seed: 3 };
        let row: Vec<bool> = (0..100).map(|x| at(&things, x as f32, 0.0)).collect();
        assert!(row.chunks(10).all(|c| c.iter().all(|v| *v == c[0])), "a thing is hidden whole");
        assert!(row.iter().any(|v| *v) && row.iter().any(|v| !*v));
        let blob = Region::Blob { size: 20.0, level: 0.5, layer: 3 };
        let hidden = (0..8000).filter(|i| at(&blob, (i % 100) as f32, (i / 100) as f32)).count();
        assert!((800..7200).contains(&hidden), "{hidden}");
    }
}
