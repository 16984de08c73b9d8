//! Depth as colour: the turbo map, near is red, far is blue, missing depth is black.
//!
//! Polynomial approximation by A. Mikhailov, "Turbo, An Improved Rainbow Colormap for Visualization" (Google AI
//! blog, 2019; Apache-2.0): fifth degree in `x` per channel, within 20 levels of the published table, within 33
//! at its dark ends.

const RED: [f32; 6] = [0.135_721_38, 4.615_392_6, -42.660_323, 132.131_08, -152.942_4, 59.286_38];
const GREEN: [f32; 6] = [0.091_402_61, 2.194_188_4, 4.842_966_6, -14.185_033, 4.277_298_6, 2.829_566];
const BLUE: [f32; 6] = [0.106_673_3, 12.641_946, -60.582_047, 110.362_77, -89.903_11, 27.348_25];

/// The colour of `x`: 0 is dark blue, 1 is dark red; values outside are clamped.
pub fn turbo(x: f32) -> [u8; 3] {
    let x = x.clamp(0.0, 1.0);
    [RED, GREEN, BLUE].map(|c| {
        let y = c.iter().rev().fold(0.0, |sum, k| sum * x + k);
        (y.clamp(0.0, 1.0) * 255.0).round() as u8
    })
}

/// The colour of a depth of `metres` between `near` and `far`; black where depth is missing.
pub fn depth_color(metres: f32, near: f32, far: f32) -> [u8; 3] {
    if !metres.is_finite() || metres <= 0.0 {
        return [0; 3];
    }
    // Equal steps of 1/z, as a stereo camera has them: near things, which a hand works on, get most colours.
    turbo((1.0 / metres - 1.0 / far) / (1.0 / near - 1.0 / far))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Entries 0, 64, 128, 192 and 255 of the published table of 256 colours.
    const TABLE: [(f32, [u8; 3]); 5] = [
        (0.0, [48, 18, 59]),
        (64.0 / 255.0, [40, 187, 235]),
        (128.0 / 255.0, [164, 252, 59]),
        (192.0 / 255.0, [251, 126, 33]),
        (1.0, [122, 4, 2]),
    ];

    #[test]
    fn follows_the_published_table() {
        for (x, want) in TABLE {
            let got = turbo(x);
            let most = if x == 0.0 || x == 1.0 { 33 } else { 20 };
            for (g, w) in got.iter().zip(want) {
                assert!(g.abs_diff(w) <= most, "turbo({x}) = {got:?}, the table has {want:?}");
            }
        }
    }

    #[test]
    fn no_depth_is_black_and_near_is_red() {
        assert_eq!(depth_color(0.0, 0.2, 5.0), [0; 3]);
        assert_eq!(depth_color(f32::NAN, 0.2, 5.0), [0; 3]);
        assert_eq!(depth_color(0.2, 0.2, 5.0), turbo(1.0));
        assert_eq!(depth_color(9.0, 0.2, 5.0), turbo(0.0));
        let [r, _, b] = depth_color(0.25, 0.2, 5.0);
        assert!(r > b);
    }
}
