//! Randomness that depends on nothing but its inputs, so that a seed gives the same images on every
//! machine and with any number of threads.

/// Mixes 64 bits well (the finaliser of `SplitMix64`, Steele, Lea and Flood 2014).
pub(crate) const fn mix(mut x: u64) -> u64 {
    x = (x ^ (x >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    x = (x ^ (x >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    x ^ (x >> 31)
}

/// A seed out of a seed and a text (FNV-1a).
pub(crate) fn text_seed(seed: u64, text: &str) -> u64 {
    text.bytes()
        .fold(mix(seed) ^ 0xCBF2_9CE4_8422_2325, |h, b| (h ^ u64::from(b)).wrapping_mul(0x0100_0000_01B3))
}

/// The random numbers that belong to one thing: a frame, a pixel.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Rolls(u64);

impl Rolls {
    /// Those of the thing with these coordinates.
    pub(crate) const fn new(seed: u64, a: u32, b: u32, c: u32) -> Self {
        let at = (a as u64) | ((b as u64) << 32);
        Self(mix(mix(seed.wrapping_add(0x9E37_79B9_7F4A_7C15) ^ at).wrapping_add(c as u64)))
    }

    /// Number `i`, 64 bits.
    pub(crate) const fn bits(self, i: u64) -> u64 {
        mix(self.0.wrapping_add(i.wrapping_mul(0x9E37_79B9_7F4A_7C15)))
    }

    /// Number `i`, evenly in 0..1.
    pub(crate) fn unit(self, i: u64) -> f32 {
        to_unit(self.bits(i) >> 32)
    }

    /// Number `i`, evenly in 0..1, in double precision.
    pub(crate) fn unit_f64(self, i: u64) -> f64 {
        (self.bits(i) >> 11) as f64 / (1u64 << 53) as f64
    }

    /// Number `i`, of normal distribution with variance 1 (sum of four; cut off at ±3.5).
    pub(crate) fn normal(self, i: u64) -> f32 {
        normal_of(self.bits(i))
    }
}

/// The normal deviate made of four 16-bit pieces.
pub(crate) fn normal_of(bits: u64) -> f32 {
    let sum = (bits & 0xFFFF) + ((bits >> 16) & 0xFFFF) + ((bits >> 32) & 0xFFFF) + (bits >> 48);
    // Four even numbers in 0..1 have the variance 4/12.
    (sum as f32 * (1.0 / 65_536.0) - 2.0) * 1.732_050_8
}

fn to_unit(bits32: u64) -> f32 {
    (bits32 >> 8) as f32 * (1.0 / 16_777_216.0)
}

/// A cheap hash of lattice coordinates, 0..1.
pub(crate) fn lattice(x: i32, y: i32, z: i32) -> f32 {
    let mut h = (x as u32).wrapping_mul(0x8DA6_B343)
        ^ (y as u32).wrapping_mul(0xD816_3841)
        ^ (z as u32).wrapping_mul(0xCB1A_B31F);
    h = (h ^ (h >> 15)).wrapping_mul(0x2C1B_3C6D);
    h = (h ^ (h >> 12)).wrapping_mul(0x297A_2D39);
    (h >> 8) as f32 * (1.0 / 16_777_216.0)
}

/// Smooth noise in the plane, 0..1, features about 1 wide; `layer` picks another field.
pub(crate) fn smooth2(x: f32, y: f32, layer: i32) -> f32 {
    let fx = x.floor();
    let fy = y.floor();
    let i = fx as i32;
    let j = fy as i32;
    let ease = |t: f32| t * t * (3.0 - 2.0 * t);
    let u = ease(x - fx);
    let v = ease(y - fy);
    let top = lattice(i, j, layer) * (1.0 - u) + lattice(i + 1, j, layer) * u;
    let bottom = lattice(i, j + 1, layer) * (1.0 - u) + lattice(i + 1, j + 1, layer) * u;
    top * (1.0 - v) + bottom * v
}

/// Smooth noise in space, 0..1, features about 1 wide; `layer` picks another field.
pub(crate) fn smooth3(p: glam::Vec3, layer: i32) -> f32 {
    let floor = p.floor();
    let [i, j, k] = [floor.x as i32, floor.y as i32, floor.z as i32];
    let t = p - floor;
    let ease = t * t * (glam::Vec3::splat(3.0) - 2.0 * t);
    let at = |di: i32, dj: i32, dk: i32| {
        let layer = layer.wrapping_add((k + dk).wrapping_mul(7919));
        lattice(i + di, j + dj, layer)
    };
    let row = |dj: i32, dk: i32| at(0, dj, dk) * (1.0 - ease.x) + at(1, dj, dk) * ease.x;
    let plane = |dk: i32| row(0, dk) * (1.0 - ease.y) + row(1, dk) * ease.y;
    plane(0) * (1.0 - ease.z) + plane(1) * ease.z
}

/// Noise of three sizes, 0..1.
pub(crate) fn fractal2(x: f32, y: f32, layer: i32) -> f32 {
    (smooth2(x, y, layer) * 4.0
        + smooth2(x * 2.1, y * 2.1, layer + 1) * 2.0
        + smooth2(x * 4.3, y * 4.3, layer + 2))
        / 7.0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn normal_deviates_have_mean_0_and_variance_1() {
        let rolls = Rolls::new(1, 2, 3, 4);
        let values: Vec<f64> = (0..100_000).map(|i| f64::from(rolls.normal(i))).collect();
        let mean = values.iter().sum::<f64>() / values.len() as f64;
        let variance = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / values.len() as f64;
        assert!(mean.abs() < 0.02 && (variance - 1.0).abs() < 0.03, "{mean} {variance}");
    }

    #[test]
    fn neighbours_are_unrelated_and_smooth_noise_is_smooth() {
        let bits = |x| Rolls::new(7, x, 0, 0).unit(0);
        let together: f32 =
            (0..10_000).map(|x| (bits(x) - 0.5) * (bits(x + 1) - 0.5)).sum::<f32>() / 10_000.0;
        assert!(together.abs() < 0.005, "{together}");
        let steep = (0..10_000).map(|i| {
            let x = i as f32 * 0.01;
            (smooth2(x + 0.01, 0.3, 0) - smooth2(x, 0.3, 0)).abs()
        });
        assert!(steep.fold(0.0, f32::max) < 0.02);
    }
}
