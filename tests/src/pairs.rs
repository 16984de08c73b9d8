//! Rectified pairs of images: synthetic ones whose truth is known, and a real one.

use depthrig_calib::stereo::{Gray, StereoPair};
use std::path::PathBuf;

/// Pixels per row, and rows.
pub type Size = (usize, usize);

/// Both images of a pair, grey.
pub struct Pair {
    /// Name of the pair in messages.
    pub name: String,
    /// Size of each image.
    pub size: Size,
    /// Left and right, rows without padding.
    pub images: [Vec<u8>; 2],
}

impl Pair {
    /// The pair as matchers take it.
    pub fn pair(&self) -> StereoPair<'_> {
        let (w, h) = self.size;
        let [left, right] = self.images.each_ref().map(|e| Gray::packed(e, w, h));
        StereoPair::new(left, right)
    }

    /// OpenCV's image of aloe plants, a part of its size.
    ///
    /// # Panics
    /// When it is not there: `DEPTHRIG_TEST_DATA` names the folder that holds it.
    pub fn aloe(parts: u32) -> Self {
        let data = std::env::var_os("DEPTHRIG_TEST_DATA").map_or_else(
            || PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../shared/data"),
            PathBuf::from,
        );
        let images = ["aloeL.jpg", "aloeR.jpg"].map(|name| {
            let path = data.join("opencv_aloe_stereo").join(name);
            let bytes = std::fs::read(&path)
                .unwrap_or_else(|e| panic!("{}: {e}; set DEPTHRIG_TEST_DATA", path.display()));
            let depthrig_jpeg::Image { info, pixels } = depthrig_jpeg::decode(&bytes).expect("a JPEG");
            image::RgbImage::from_raw(info.width, info.height, pixels).expect("in colour")
        });
        // Rec. 709 luma in whole numbers: libraries turn colour into grey in ways that differ from version to version.
        let grey = |e: &image::RgbImage| {
            let luma = |p: &image::Rgb<u8>| {
                let [r, g, b] = p.0.map(u32::from);
                image::Luma([((2126 * r + 7152 * g + 722 * b) / 10_000) as u8])
            };
            image::GrayImage::from_fn(e.width(), e.height(), |x, y| luma(e.get_pixel(x, y)))
        };
        let images = images.each_ref().map(grey);
        let w = images[0].width() / parts;
        let h = images[0].height() / parts;
        let small =
            images.each_ref().map(|e| image::imageops::resize(e, w, h, image::imageops::Triangle).into_raw());
        Self { name: format!("aloe of {w}x{h}"), size: (w as usize, h as usize), images: small }
    }
}

/// A number from 0 to 1 of two others.
pub fn hash(a: i64, b: i64, seed: u64) -> f64 {
    let mut x = (a as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15)
        ^ (b as u64).wrapping_mul(0xC2B2_AE3D_27D4_EB4F)
        ^ seed.wrapping_mul(0x1656_67B1_9E37_79F9);
    x ^= x >> 31;
    x = x.wrapping_mul(0xBF58_476D_1CE4_E5B9);
    x ^= x >> 29;
    (x.wrapping_mul(0x94D0_49BB_1331_11EB) >> 56) as f64 / 255.0
}

/// Noise that is smooth between whole numbers, 0 to 1.
pub fn smooth(u: f64, v: f64, seed: u64) -> f64 {
    let i = u.floor();
    let j = v.floor();
    let fu = u - i;
    let fv = v - j;
    let at = |i: f64, j: f64| hash(i as i64, j as i64, seed);
    let row = |j| at(i, j) * (1.0 - fu) + at(i + 1.0, j) * fu;
    row(j) * (1.0 - fv) + row(j + 1.0) * fv
}

/// A stripe with soft edges, of period 1.
pub fn stripe(u: f64) -> f64 {
    ((u * core::f64::consts::TAU).sin() * 3.0).clamp(-1.0, 1.0) * 0.5 + 0.5
}

/// A value at a place of the left view.
pub type Field<'a> = &'a dyn Fn(f64, f64) -> f64;

/// Renders a surface from its disparity and brightness (0 to 1) at a pixel of the left view. The right image is a fifth
/// darker than the left one; both have noise of three grey levels.
pub fn seen(name: String, size: Size, disparity: Field<'_>, brightness: Field<'_>) -> Pair {
    seen_apart(name, size, disparity, &|_, _| 0.0, brightness)
}

/// Like [`seen`], with the right image's content `rows` lower than the left one's.
pub fn seen_apart(
    name: String,
    size: Size,
    disparity: Field<'_>,
    rows: Field<'_>,
    brightness: Field<'_>,
) -> Pair {
    let image = |right: bool| -> Vec<u8> {
        let pixel = |i: usize| {
            let x = (i % size.0) as f64;
            let y = (i / size.0) as f64;
            let mut left = (x, y);
            for _ in 0..if right { 8 } else { 0 } {
                left = (x + disparity(left.0, left.1), y - rows(left.0, left.1));
            }
            let noise: f64 = (0..4).map(|k| hash(i as i64, k, 77 + u64::from(right)) - 0.5).sum();
            let gain = if right { 0.8 } else { 1.0 };
            (gain * (20.0 + 200.0 * brightness(left.0, left.1)) + 5.0 * noise).round().clamp(0.0, 255.0) as u8
        };
        (0..size.0 * size.1).map(pixel).collect()
    };
    Pair { name, size, images: [image(false), image(true)] }
}
