//! Images to record: real ones from a folder, or made ones that compress about as real ones do.

use crate::{Error, ErrorKind, Result};
use std::path::Path;
use std::sync::Arc;

/// Different images of each kind; more would only cost memory.
const VARIETY: usize = 4;

/// Colour images (RGB8) and depth images (Z16), all of one size.
pub(super) struct Pool {
    pub(super) color: Vec<Arc<[u8]>>,
    pub(super) depth: Vec<Arc<[u8]>>,
}

/// The images to record, and where they come from in words.
pub(super) fn pool(images: Option<&Path>, w: u32, h: u32) -> Result<(Pool, String)> {
    let mut pool = Pool { color: Vec::new(), depth: Vec::new() };
    if let Some(dir) = images {
        load(dir, w, h, &mut pool)?;
        if pool.color.is_empty() || pool.depth.is_empty() {
            let message = format!(
                "{} has {} colour and {} depth images; at least one of each is needed (8-bit PNG or JPEG, \
                 16-bit PNG)",
                dir.display(),
                pool.color.len(),
                pool.depth.len()
            );
            return Err(Error::new(ErrorKind::BadInput, message));
        }
        let c = pool.color.len();
        let d = pool.depth.len();
        let from = format!("{c} colour and {d} depth images from {}, tiled to {w}x{h}", dir.display());
        return Ok((pool, from));
    }
    for seed in 0..VARIETY as u32 {
        let (color, depth) = synthetic(w, h, seed);
        pool.color.push(color.into());
        pool.depth.push(depth.into());
    }
    Ok((pool, format!("{VARIETY} synthetic colour and depth images of {w}x{h}")))
}

fn load(dir: &Path, w: u32, h: u32, pool: &mut Pool) -> Result<()> {
    let mut paths: Vec<_> = std::fs::read_dir(dir)
        .map_err(|e| Error::reading("read the folder", dir, e))?
        .filter_map(|e| Some(e.ok()?.path()))
        .collect();
    paths.sort();
    for path in paths {
        if path.is_dir() {
            load(&path, w, h, pool)?;
            continue;
        }
        let Some("png" | "jpg" | "jpeg") = path.extension().and_then(|e| e.to_str()) else { continue };
        let image = open(&path)?;
        let iw = image.width().max(1);
        let ih = image.height().max(1);
        // Tiled, not scaled: scaling would make real images smoother than they are.
        let places = (0..h).flat_map(|y| (0..w).map(move |x| (x % iw, y % ih)));
        match image {
            image::DynamicImage::ImageLuma16(depth) => {
                pool.depth.push(places.flat_map(|(x, y)| depth.get_pixel(x, y).0[0].to_le_bytes()).collect());
            }
            other => {
                let color = other.into_rgb8();
                pool.color.push(places.flat_map(|(x, y)| color.get_pixel(x, y).0).collect());
            }
        }
    }
    Ok(())
}

fn open(path: &Path) -> Result<image::DynamicImage> {
    let unreadable = || Error::new(ErrorKind::BadInput, format!("{} cannot be read", path.display()));
    if path.extension().is_some_and(|e| e == "png") {
        return image::open(path).map_err(|e| unreadable().with_source(e));
    }
    let bytes = std::fs::read(path).map_err(|e| Error::reading("read", path, e))?;
    let decoded = depthrig_jpeg::decode(&bytes).map_err(|e| unreadable().with_source(e))?;
    let depthrig_jpeg::Info { width, height, form } = decoded.info;
    let image = match form {
        depthrig_jpeg::Form::Grey => {
            image::GrayImage::from_raw(width, height, decoded.pixels).map(Into::into)
        }
        depthrig_jpeg::Form::Rgb => image::RgbImage::from_raw(width, height, decoded.pixels).map(Into::into),
    };
    image.ok_or_else(unreadable)
}

/// SplitMix64: a number that looks random and follows from `x`.
fn hash(x: u64) -> u64 {
    let mut z = x.wrapping_add(0x9e37_79b9_7f4a_7c15);
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

/// Bytes that no compressor makes smaller.
pub(super) fn incompressible(len: usize, seed: u64) -> Arc<[u8]> {
    (0..len as u64).map(|i| hash(seed << 40 | i) as u8).collect()
}

/// Value noise: random heights on a grid of `cell` pixels, blended between; -1 to 1.
fn noise(x: u32, y: u32, cell: u32, seed: u32) -> f32 {
    let at = |gx: u32, gy: u32| {
        let h = hash(u64::from(seed) << 48 | u64::from(cell) << 32 | u64::from(gx) << 16 | u64::from(gy));
        (h & 0xffff) as f32 / 32_767.5 - 1.0
    };
    let gx = x / cell;
    let gy = y / cell;
    let ease = |t: f32| t * t * (3.0 - 2.0 * t);
    let fx = ease((x % cell) as f32 / cell as f32);
    let fy = ease((y % cell) as f32 / cell as f32);
    let mix = |a: f32, b: f32, t: f32| a + (b - a) * t;
    let top = mix(at(gx, gy), at(gx + 1, gy), fx);
    mix(top, mix(at(gx, gy + 1), at(gx + 1, gy + 1), fx), fy)
}

/// An image as a stereo camera sees a table with things on it: smooth shading, texture of several sizes and
/// a little sensor noise in colour; slanted planes, steps, disparity levels and holes in depth.
fn synthetic(w: u32, h: u32, seed: u32) -> (Vec<u8>, Vec<u8>) {
    let mut color = Vec::new();
    let mut depth = Vec::new();
    for y in 0..h {
        for x in 0..w {
            let shade = 110.0 + 50.0 * noise(x, y, 320, seed) + 25.0 * noise(x, y, 90, seed);
            let texture = 10.0 * noise(x, y, 24, seed) + 8.0 * noise(x, y, 7, seed);
            let grain =
                ((hash(u64::from(seed) << 50 | u64::from(y) << 20 | u64::from(x)) & 7) as f32 - 3.5) * 0.8;
            let thing = noise(x, y, 160, seed + 99) > 0.25;
            let tint = if thing { [40.0, -10.0, -30.0] } else { [0.0, 5.0, 12.0] };
            color.extend(tint.map(|t| (shade + texture + grain + t).clamp(0.0, 255.0) as u8));
            let plane = 900.0 + 1.2 * (h - y) as f32 + 0.1 * x as f32;
            let z = if thing { plane - 140.0 + 30.0 * noise(x, y, 60, seed) } else { plane };
            // Stereo measures disparity in 1/32 pixel; 36 000 is focal length x baseline in pixel x mm.
            let disparity = (36_000.0 * 32.0 / z + 0.7 * noise(x, y, 5, seed)).round();
            let hole = noise(x, y, 40, seed + 7) > 0.62 || (thing && noise(x, y, 11, seed) > 0.8);
            let mm = if hole { 0 } else { (36_000.0 * 32.0 / disparity) as u16 };
            depth.extend(mm.to_le_bytes());
        }
    }
    (color, depth)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// If synthetic images were flat or noise, the measurement would flatter or slander the recorder.
    #[test]
    fn synthetic_images_compress_about_as_real_ones_do() {
        let (color, depth) = synthetic(320, 240, 1);
        let ratio = |b: &[u8]| b.len() as f64 / zstd::bulk::compress(b, 1).unwrap().len() as f64;
        let mut jpeg = Vec::new();
        jpeg_encoder::Encoder::new(&mut jpeg, 95)
            .encode(&color, 320, 240, jpeg_encoder::ColorType::Rgb)
            .unwrap();
        let jpeg_ratio = color.len() as f64 / jpeg.len() as f64;
        // Real frames: depth 4.2 with zstd-1, colour 11 with JPEG q95 4:4:4.
        assert!((2.5..7.0).contains(&ratio(&depth)), "depth {}", ratio(&depth));
        assert!((4.0..14.0).contains(&jpeg_ratio), "colour {jpeg_ratio}");
    }
}
