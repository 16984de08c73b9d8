//! Numbers of a full image that help to set a camera up: sharpness, exposure, holes.

use super::refused;
use crate::Result;
use crate::dataset::jpeg_pixels;
use crate::still::tight;
use depthrig_bus::{FrameHeader, Layout, PixelFormat, Sample};
use serde::Serialize;

/// Bins of a histogram of luma.
pub const LUMA_BINS: usize = 64;
/// A pixel with at most this luma is clipped at the dark end.
const DARK: u8 = 1;
/// A pixel with a channel of at least this is clipped at the bright end.
const BRIGHT: u8 = 254;

/// Numbers of an image. Depth has holes and nothing else, every other image has all but holes.
#[derive(Debug, Clone, PartialEq, Default, Serialize)]
pub struct Measure {
    /// Mean squared Laplacian of luma (4 neighbours, of 255 grey levels), the border left out. It grows with focus, contrast and noise, so compare
    /// it only within one scene.
    pub sharpness: Option<f64>,
    /// Share of the pixels in each of 64 bins of luma.
    pub luma: Option<Vec<f64>>,
    /// Share of the pixels that are black; `None` for grey of more than 8 bits, whose scale has no end.
    pub dark: Option<f64>,
    /// Share of the pixels with a channel at its maximum.
    pub bright: Option<f64>,
    /// Share of the pixels without depth.
    pub holes: Option<f64>,
}

/// Measures the full image of a frame.
///
/// # Errors
/// [`crate::ErrorKind::BadInput`] for a frame that is not an image or is shorter than its header says, [`crate::ErrorKind::Codec`] for a damaged JPEG.
pub fn measure(h: &FrameHeader, pixels: &[u8]) -> Result<Measure> {
    let format = h.pixel_format().ok_or_else(|| refused(h, "its pixel format is unknown"))?;
    let pixels = pixels
        .get(..h.payload_len as usize)
        .ok_or_else(|| refused(h, "it is shorter than its header says"))?;
    if format.is_motion() {
        return Err(refused(h, "it is not an image"));
    }
    if format.layout() == Layout::Jpeg {
        return Ok(of_luma(&Luma::of_rgb(&jpeg_pixels(pixels, h)?), h.width as usize));
    }
    let pixels = tight(h, pixels, format);
    if h.width == 0 || h.height == 0 || pixels.len() != format.frame_bytes(h.width, h.height) {
        return Err(refused(h, "its size is not what its header says"));
    }
    if format.is_depth() {
        return Ok(Measure { holes: Some(holes(format, &pixels)), ..Measure::default() });
    }
    let luma = match (format.layout(), format.sample()) {
        (Layout::Rgb, _) => Luma::of_rgb(&pixels),
        (Layout::Bgr, _) => Luma::of_bgr(&pixels),
        (Layout::Yuyv, _) => Luma::of_bytes(pixels.iter().step_by(2).copied().map(full_range)),
        (Layout::Uyvy, _) => Luma::of_bytes(pixels.iter().skip(1).step_by(2).copied().map(full_range)),
        (Layout::Nv12, _) => {
            let area = h.width as usize * h.height as usize;
            Luma::of_bytes(pixels[..area].iter().copied().map(full_range))
        }
        (_, Sample::U8) => Luma::of_bytes(pixels.iter().copied()),
        (_, sample) => Luma::of_wide(&pixels, sample),
    };
    Ok(of_luma(&luma, h.width as usize))
}

/// Luma of 16 to 235, as cameras send it, on the scale of 0 to 255.
fn full_range(y: u8) -> u8 {
    (((i32::from(y) - 16) * 255 + 109) / 219).clamp(0, 255) as u8
}

/// An image in grey.
struct Luma {
    values: Vec<u8>,
    /// Pixels that are black and that have a channel at its maximum; `None` if the scale has no end.
    clipped: Option<Clipped>,
}

#[derive(Default)]
struct Clipped {
    dark: usize,
    bright: usize,
}

impl Luma {
    fn of_rgb(pixels: &[u8]) -> Self {
        Self::of_channels(pixels.as_chunks().0.iter().copied())
    }

    fn of_bgr(pixels: &[u8]) -> Self {
        Self::of_channels(pixels.as_chunks().0.iter().map(|[b, g, r]| [*r, *g, *b]))
    }

    /// ITU-R BT.601.
    fn of_channels(pixels: impl Iterator<Item = [u8; 3]>) -> Self {
        let mut clipped = Clipped::default();
        let values = pixels
            .map(|[r, g, b]| {
                let luma = ((77 * u32::from(r) + 150 * u32::from(g) + 29 * u32::from(b) + 128) >> 8) as u8;
                clipped.bright += usize::from(r.max(g).max(b) >= BRIGHT);
                clipped.dark += usize::from(luma <= DARK);
                luma
            })
            .collect();
        Self { values, clipped: Some(clipped) }
    }

    fn of_bytes(pixels: impl Iterator<Item = u8>) -> Self {
        let mut clipped = Clipped::default();
        let values = pixels
            .inspect(|luma| {
                clipped.bright += usize::from(*luma >= BRIGHT);
                clipped.dark += usize::from(*luma <= DARK);
            })
            .collect();
        Self { values, clipped: Some(clipped) }
    }

    /// Grey of more than 8 bits, scaled so that the brightest pixel is white.
    fn of_wide(pixels: &[u8], sample: Sample) -> Self {
        let values: Vec<f32> = if sample == Sample::F32 {
            pixels.as_chunks().0.iter().map(|v| f32::from_le_bytes(*v)).collect()
        } else {
            pixels.as_chunks().0.iter().map(|v| f32::from(u16::from_le_bytes(*v))).collect()
        };
        let brightest = values.iter().copied().filter(|v| v.is_finite()).fold(0.0, f32::max);
        let scale = if brightest > 0.0 { 255.0 / brightest } else { 0.0 };
        // Not a number becomes black.
        Self { values: values.iter().map(|v| (v * scale) as u8).collect(), clipped: None }
    }
}

fn of_luma(luma: &Luma, width: usize) -> Measure {
    let count = luma.values.len().max(1) as f64;
    let mut bins = [0_u32; LUMA_BINS];
    for value in &luma.values {
        bins[usize::from(*value) * LUMA_BINS / 256] += 1;
    }
    let share = |pixels: usize| pixels as f64 / count;
    Measure {
        sharpness: Some(sharpness(&luma.values, width)),
        luma: Some(bins.iter().map(|n| f64::from(*n) / count).collect()),
        dark: luma.clipped.as_ref().map(|c| share(c.dark)),
        bright: luma.clipped.as_ref().map(|c| share(c.bright)),
        holes: None,
    }
}

/// Mean squared Laplacian; 0 for an image without an inside.
fn sharpness(luma: &[u8], width: usize) -> f64 {
    let rows: Vec<&[u8]> = luma.chunks_exact(width.max(1)).collect();
    if width < 3 || rows.len() < 3 {
        return 0.0;
    }
    let mut sum = 0_u64;
    for three in rows.windows(3) {
        let row = |above: &[u8], here: &[u8], below: &[u8]| -> u64 {
            let inside = here.windows(3).zip(&above[1..]).zip(&below[1..]);
            inside
                .map(|((here, above), below)| {
                    let around =
                        i32::from(here[0]) + i32::from(here[2]) + i32::from(*above) + i32::from(*below);
                    u64::from((4 * i32::from(here[1]) - around).unsigned_abs().pow(2))
                })
                .sum()
        };
        sum += row(three[0], three[1], three[2]);
    }
    sum as f64 / ((width - 2) * (rows.len() - 2)) as f64
}

/// Share of pixels without depth.
fn holes(format: PixelFormat, pixels: &[u8]) -> f64 {
    if format.sample() == Sample::F32 {
        let values = pixels.as_chunks().0;
        // Not a number is a hole, too.
        let has_depth = |v: &&[u8; 4]| f32::from_le_bytes(**v) > 0.0;
        return 1.0 - values.iter().filter(has_depth).count() as f64 / values.len() as f64;
    }
    let values = pixels.as_chunks::<2>().0;
    values.iter().filter(|v| **v == [0, 0]).count() as f64 / values.len() as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    fn header(format: PixelFormat, width: u32, height: u32) -> FrameHeader {
        let mut h = FrameHeader::default();
        h.set_image(format, width, height);
        h
    }

    #[test]
    fn sharpness_is_the_mean_squared_laplacian() {
        // Against a slow form that follows the definition pixel by pixel.
        let (width, height) = (7_usize, 5_usize);
        let pixels: Vec<u8> = (0..width * height).map(|i| (i * i * 37 % 251) as u8).collect();
        let at = |x: usize, y: usize| f64::from(pixels[y * width + x]);
        let mut sum = 0.0;
        for y in 1..height - 1 {
            for x in 1..width - 1 {
                let laplacian = 4.0 * at(x, y) - at(x - 1, y) - at(x + 1, y) - at(x, y - 1) - at(x, y + 1);
                sum += laplacian * laplacian;
            }
        }
        let m = measure(&header(PixelFormat::Mono8, 7, 5), &pixels).unwrap();
        assert_eq!(m.sharpness, Some(sum / 15.0));
        let m = measure(&header(PixelFormat::Mono8, 2, 2), &[0, 255, 255, 0]).unwrap();
        assert_eq!(m.sharpness, Some(0.0));
    }

    #[test]
    fn exposure_and_holes_are_shares_of_the_pixels() {
        // Black, white, pure red that is clipped although its luma is not, and grey.
        let pixels = [0, 0, 0, 255, 255, 255, 255, 0, 0, 100, 100, 100];
        let m = measure(&header(PixelFormat::Rgb8, 2, 2), &pixels).unwrap();
        assert_eq!((m.dark, m.bright, m.holes), (Some(0.25), Some(0.5), None));
        let luma = m.luma.unwrap();
        let full: Vec<_> = (0..LUMA_BINS).filter(|i| luma[*i] > 0.0).collect();
        assert_eq!((luma.len(), full), (LUMA_BINS, vec![0, 77 * 255 / 256 / 4, 25, 63]));
        assert!((luma.iter().sum::<f64>() - 1.0).abs() < 1e-12);
        let z16: Vec<u8> = [0_u16, 5, 6, 0].iter().flat_map(|v| v.to_le_bytes()).collect();
        let m = measure(&header(PixelFormat::Z16, 2, 2), &z16).unwrap();
        assert_eq!(m, Measure { holes: Some(0.5), ..Measure::default() });
        let f32s: Vec<u8> = [f32::NAN, -1.0, 0.5, 0.0].iter().flat_map(|v| v.to_le_bytes()).collect();
        assert_eq!(measure(&header(PixelFormat::DepthF32, 2, 2), &f32s).unwrap().holes, Some(0.75));
        // The scale of wide grey has no end, so nothing of it is clipped.
        let wide: Vec<u8> = [0_u16, 500, 1000, 1000].iter().flat_map(|v| v.to_le_bytes()).collect();
        let m = measure(&header(PixelFormat::Mono16, 2, 2), &wide).unwrap();
        assert_eq!((m.dark, m.bright, m.luma.unwrap()[63]), (None, None, 0.5));
    }

    #[test]
    fn every_format_of_a_camera_measures_the_same_grey() {
        // Grey 150 on all of the image: luma 145 in limited range.
        for format in PixelFormat::ALL {
            if format.is_depth() || matches!(format, PixelFormat::Motion | PixelFormat::Mjpeg) {
                continue;
            }
            let h = header(format, 4, 2);
            let pixels: Vec<u8> = match (format.layout(), format.sample()) {
                (Layout::Rgb | Layout::Bgr, _) => vec![150; 24],
                (Layout::Yuyv, _) => [145, 128].repeat(8),
                (Layout::Uyvy, _) => [128, 145].repeat(8),
                (Layout::Nv12, _) => [vec![145; 8], vec![128; 4]].concat(),
                (_, Sample::U8) => vec![150; 8],
                (_, Sample::U16) => (0..8).flat_map(|_| 150_u16.to_le_bytes()).collect(),
                (_, Sample::F32) => (0..8).flat_map(|_| 1.5_f32.to_le_bytes()).collect(),
            };
            let m = measure(&h, &pixels).unwrap();
            let bin = if format.layout() == Layout::Grey && format.sample() != Sample::U8 { 63 } else { 37 };
            assert_eq!((m.sharpness, m.luma.unwrap()[bin]), (Some(0.0), 1.0), "{format:?}");
        }
        assert!(measure(&header(PixelFormat::Motion, 4, 1), &[0; 4096]).is_err());
        let mut short = header(PixelFormat::Mono8, 4, 2);
        short.payload_len = 7;
        assert!(measure(&short, &[0; 8]).is_err());
    }
}
