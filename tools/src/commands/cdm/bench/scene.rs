//! The scene of the bench: boxes on a slanted floor, still and with the noise of a sensor.

/// Inverse depth is off by so much, 1/m: a tenth of a pixel of disparity of a D435 (baseline 50 mm, 385 pixels of focal length),
/// 21 mm at 2 m.
const NOISE_PER_M: f64 = 0.1 / (0.05 * 385.0);
/// Noise is one over cells of so many pixels: a stereo camera compares windows.
const CELL: usize = 4;
/// Share of the cells that are holes in an image and not in the next.
const HOLES: f64 = 0.01;
/// Colour is off by so many levels at most.
const COLOR_NOISE: u64 = 2;

/// A synthetic image: depth in millimetres of boxes on a slanted floor with holes along their edges, and matching
/// colour.
pub fn image(width: usize, height: usize) -> (Vec<u8>, Vec<u16>) {
    let mut color = Vec::with_capacity(3 * width * height);
    let mut depth = Vec::with_capacity(width * height);
    for v in 0..height {
        for u in 0..width {
            let x = u as f64 / width as f64;
            let y = v as f64 / height as f64;
            let bx = (x * 5.0).fract();
            let by = (y * 4.0).fract();
            let inside = bx > 0.25 && bx < 0.75 && by > 0.25 && by < 0.75;
            let near_edge = (bx - 0.25).abs() < 0.04 || (bx - 0.75).abs() < 0.03;
            let floor = 2200.0 - 1200.0 * y + 90.0 * (9.0 * x).sin();
            let d = if inside { floor * 0.8 } else { floor };
            depth.push(if near_edge && by > 0.2 && by < 0.8 { 0 } else { d as u16 });
            let shade = if inside { 190.0 } else { 90.0 } + 30.0 * (40.0 * x).sin() * (31.0 * y).cos();
            color.extend([shade as u8, (shade * 0.8) as u8, (255.0 - shade) as u8]);
        }
    }
    (color, depth)
}

/// [`image`] as a sensor sees it for the `number`th time: the same for the same number.
pub fn noisy(width: usize, height: usize, number: u64) -> (Vec<u8>, Vec<u16>) {
    let (mut color, mut depth) = image(width, height);
    let mut random = Random(number.wrapping_mul(0x9E37_79B9_7F4A_7C15) ^ 0x5CE7E);
    for c in &mut color {
        let off = random.next() % (2 * COLOR_NOISE + 1);
        *c = (u64::from(*c) + off).saturating_sub(COLOR_NOISE).min(255) as u8;
    }
    let across = width.div_ceil(CELL);
    let cells: Vec<Option<f64>> = (0..across * height.div_ceil(CELL))
        .map(|_| (random.unit() >= HOLES).then(|| NOISE_PER_M * random.normal()))
        .collect();
    for (i, d) in depth.iter_mut().enumerate().filter(|(_, d)| **d > 0) {
        let cell = cells[i / width / CELL * across + i % width / CELL];
        *d = cell
            .map_or(0, |off| (1000.0 / (1000.0 / f64::from(*d) + off)).round().clamp(0.0, 65534.0) as u16);
    }
    (color, depth)
}

/// SplitMix64 (Steele, Lea, Flood 2014), so that images are the same everywhere.
struct Random(u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    /// 0 to 1.
    fn unit(&mut self) -> f64 {
        (self.next() >> 11) as f64 / (1u64 << 53) as f64
    }

    /// Of mean 0 and deviation 1 (Box and Muller).
    fn normal(&mut self) -> f64 {
        let radius = (-2.0 * (1.0 - self.unit()).ln()).sqrt();
        radius * (core::f64::consts::TAU * self.unit()).cos()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_image_has_holes_and_depth() {
        let (color, depth) = image(160, 90);
        assert_eq!((color.len(), depth.len()), (3 * 160 * 90, 160 * 90));
        let holes = depth.iter().filter(|d| **d == 0).count();
        assert!(holes > 100 && holes < depth.len() / 3, "{holes}");
    }

    #[test]
    fn noise_is_of_its_size_and_of_its_number() {
        let (_, still) = image(320, 180);
        let (color, depth) = noisy(320, 180, 1);
        assert!(noisy(320, 180, 1) == (color, depth.clone()) && noisy(320, 180, 2).1 != depth);
        let off: Vec<f64> = still
            .iter()
            .zip(&depth)
            .filter(|(a, b)| **a > 0 && **b > 0)
            .map(|(a, b)| 1000.0 / f64::from(*b) - 1000.0 / f64::from(*a))
            .collect();
        let deviation = (off.iter().map(|d| d * d).sum::<f64>() / off.len() as f64).sqrt();
        assert!((0.9..1.1).contains(&(deviation / NOISE_PER_M)), "{deviation}");
        let gone = still.iter().zip(&depth).filter(|(a, b)| **a > 0 && **b == 0).count();
        let share = gone as f64 / still.iter().filter(|d| **d > 0).count() as f64;
        assert!((0.003..0.03).contains(&share), "{share}");
    }
}
