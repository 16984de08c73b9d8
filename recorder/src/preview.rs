//! Small images of frames, for viewers: colour and grey as JPEG, depth as every n-th pixel.
//!
//! Made for looking at, quickly: a JPEG has 4:2:0 colour and is a mean of the pixels that it stands for. Depth is never averaged, because a mean of two
//! surfaces is a place where nothing is.

mod measure;

pub use measure::{LUMA_BINS, Measure, measure};

use crate::still::tight;
use crate::{Error, ErrorKind, Result};
use depthrig_bus::{FrameHeader, Layout, PixelFormat, Sample};
use jpeg_encoder::{ColorType, Encoder, SamplingFactor};
use std::borrow::Cow;

/// JPEG quality of previews.
const QUALITY: u8 = 70;
/// Unit of depth that comes as metres in floating point.
const FLOAT_DEPTH_UNIT_M: f32 = 1e-3;

/// Form of a preview's bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PreviewKind {
    /// A JPEG.
    Jpeg,
    /// Unsigned 16-bit depth, little endian, row by row; 0 is a hole.
    Depth,
}

/// A small image of a frame.
#[derive(Debug, Clone, PartialEq)]
pub struct Preview {
    /// Its form.
    pub kind: PreviewKind,
    /// Pixels of the frame, in each direction, that one pixel stands for.
    pub step: u16,
    /// Columns.
    pub width: u16,
    /// Rows.
    pub height: u16,
    /// Metres of one unit of depth; 0 for a JPEG.
    pub depth_unit_m: f32,
    /// The image.
    pub bytes: Vec<u8>,
}

/// The preview of a frame with at most `max_width` columns, 0: of full size. A camera's own JPEG is passed on as it is.
///
/// # Errors
/// [`ErrorKind::BadInput`] for a frame that is not an image or does not have the size that its header says, [`ErrorKind::Codec`] when it cannot be encoded.
pub fn preview(h: &FrameHeader, pixels: &[u8], max_width: u32) -> Result<Preview> {
    let format = h.pixel_format().ok_or_else(|| refused(h, "its pixel format is unknown"))?;
    let pixels = pixels
        .get(..h.payload_len as usize)
        .ok_or_else(|| refused(h, "it is shorter than its header says"))?;
    let size = |n: u32| u16::try_from(n).map_err(|_| refused(h, "it has more than 65535 pixels per side"));
    if format.layout() == Layout::Jpeg {
        return Ok(Preview {
            kind: PreviewKind::Jpeg,
            step: 1,
            width: size(h.width)?,
            height: size(h.height)?,
            depth_unit_m: 0.0,
            bytes: pixels.to_vec(),
        });
    }
    let pixels = tight(h, pixels, format);
    if h.width == 0 || h.height == 0 || pixels.len() != format.frame_bytes(h.width, h.height) {
        return Err(refused(h, "its size is not what its header says"));
    }
    let step = if max_width == 0 { 1 } else { h.width.div_ceil(max_width).min(h.width).min(h.height) };
    let grid = Grid {
        width: h.width as usize,
        step: step as usize,
        columns: (h.width / step) as usize,
        rows: (h.height / step) as usize,
    };
    let of = |kind, depth_unit_m, bytes| {
        Ok(Preview {
            kind,
            step: size(step)?,
            width: size(h.width / step)?,
            height: size(h.height / step)?,
            depth_unit_m,
            bytes,
        })
    };
    match (format, format.layout(), format.sample()) {
        (PixelFormat::Z16, ..) => of(PreviewKind::Depth, h.depth_unit_m as f32, grid.every(&pixels)),
        (PixelFormat::DepthF32, ..) => of(PreviewKind::Depth, FLOAT_DEPTH_UNIT_M, grid.millimetres(&pixels)),
        (_, Layout::Rgb | Layout::Bgr, _) => {
            let color = if format.layout() == Layout::Rgb { ColorType::Rgb } else { ColorType::Bgr };
            of(PreviewKind::Jpeg, 0.0, grid.jpeg(&grid.mean::<3>(&pixels), color)?)
        }
        (_, Layout::Grey, Sample::U8) => {
            of(PreviewKind::Jpeg, 0.0, grid.jpeg(&grid.mean::<1>(&pixels), ColorType::Luma)?)
        }
        (_, Layout::Grey, _) => of(
            PreviewKind::Jpeg,
            0.0,
            grid.jpeg(&grid.brightened(&pixels, format.sample()), ColorType::Luma)?,
        ),
        (_, Layout::Yuyv | Layout::Uyvy | Layout::Nv12, _) => of(
            PreviewKind::Jpeg,
            0.0,
            grid.jpeg(&grid.of_yuv(&pixels, h.height as usize, format.layout()), ColorType::Rgb)?,
        ),
        (_, Layout::Motion | Layout::Jpeg, _) => Err(refused(h, "it is not an image")),
    }
}

fn refused(h: &FrameHeader, why: &str) -> Error {
    let what = format!("frame {} of {}/{} cannot be shown: {why}", h.sequence, h.camera(), h.stream());
    Error::new(ErrorKind::BadInput, what)
}

/// Which pixels of an image those of its preview stand for.
struct Grid {
    /// Columns of the image.
    width: usize,
    step: usize,
    columns: usize,
    rows: usize,
}

impl Grid {
    /// Top-left pixels in the image, row by row.
    fn pixels(&self) -> impl Iterator<Item = usize> {
        (0..self.rows).flat_map(move |y| (0..self.columns).map(move |x| (y * self.width + x) * self.step))
    }

    /// Each `step`-th 16-bit value.
    fn every(&self, image: &[u8]) -> Vec<u8> {
        if self.step == 1 {
            return image.to_vec();
        }
        let mut out = Vec::with_capacity(self.columns * self.rows * 2);
        for row in image.as_chunks::<2>().0.chunks_exact(self.width).step_by(self.step).take(self.rows) {
            out.extend(row.iter().step_by(self.step).take(self.columns).flatten());
        }
        out
    }

    fn millimetres(&self, image: &[u8]) -> Vec<u8> {
        let values = image.as_chunks::<4>().0;
        let of = |i: usize| {
            let metres = f32::from_le_bytes(values[i]);
            // Not a number and what is beyond 65 m are holes.
            let units = metres / FLOAT_DEPTH_UNIT_M;
            if units > 0.0 && units < 65535.5 { units.round() as u16 } else { 0 }
        };
        self.pixels().flat_map(|i| of(i).to_le_bytes()).collect()
    }

    /// Means of squares of pixels with `N` channels of a byte.
    fn mean<'a, const N: usize>(&self, image: &'a [u8]) -> Cow<'a, [u8]> {
        // A step that the compiler knows makes its sums and its division vectors: three times as fast.
        match self.step {
            1 => image.into(),
            2 => self.means::<N>(image, 2).into(),
            3 => self.means::<N>(image, 3).into(),
            step => self.means::<N>(image, step).into(),
        }
    }

    #[expect(clippy::inline_always, reason = "each call is for another step; see `mean`")]
    #[inline(always)]
    fn means<const N: usize>(&self, image: &[u8], step: usize) -> Vec<u8> {
        let area = (step * step) as u32;
        let mut out = Vec::with_capacity(self.columns * self.rows * N);
        let mut sums = vec![0_u32; self.width * N];
        for rows in image.chunks_exact(self.width * N * step).take(self.rows) {
            sums.fill(0);
            for row in rows.chunks_exact(self.width * N) {
                for (sum, value) in sums.iter_mut().zip(row) {
                    *sum += u32::from(*value);
                }
            }
            for square in sums.as_chunks::<N>().0.chunks_exact(step).take(self.columns) {
                let total = |c: usize| square.iter().map(|pixel| pixel[c]).sum::<u32>();
                out.extend(core::array::from_fn::<_, N, _>(|c| ((total(c) + area / 2) / area) as u8));
            }
        }
        out
    }

    /// Grey of more than 8 bits, scaled so that the brightest pixel is white.
    fn brightened(&self, image: &[u8], sample: Sample) -> Vec<u8> {
        let value = |i: usize| match sample {
            Sample::F32 => f32::from_le_bytes(image.as_chunks::<4>().0[i]),
            Sample::U16 => f32::from(u16::from_le_bytes(image.as_chunks::<2>().0[i])),
            Sample::U8 => f32::from(image[i]),
        };
        let values: Vec<f32> = self.pixels().map(value).collect();
        let brightest = values.iter().copied().filter(|v| v.is_finite()).fold(0.0, f32::max);
        let scale = if brightest > 0.0 { 255.0 / brightest } else { 0.0 };
        // Not a number becomes black.
        values.iter().map(|v| (v * scale) as u8).collect()
    }

    /// Red, green and blue of each `step`-th pixel of 4:2:2 or 4:2:0 (BT.601, limited range, as cameras send it).
    fn of_yuv(&self, image: &[u8], height: usize, layout: Layout) -> Vec<u8> {
        let at = |i: usize| {
            let pair = i / 2 * 4;
            match layout {
                Layout::Uyvy => [image[2 * i + 1], image[pair], image[pair + 2]],
                Layout::Nv12 => {
                    let chroma =
                        self.width * height + i / self.width / 2 * self.width + i % self.width / 2 * 2;
                    [image[i], image[chroma], image[chroma + 1]]
                }
                _ => [image[2 * i], image[pair + 1], image[pair + 3]],
            }
        };
        self.pixels().flat_map(|i| rgb(at(i))).collect()
    }

    fn jpeg(&self, pixels: &[u8], color: ColorType) -> Result<Vec<u8>> {
        let mut out = Vec::new();
        let mut encoder = Encoder::new(&mut out, QUALITY);
        encoder.set_sampling_factor(SamplingFactor::R_4_2_0);
        encoder.encode(pixels, self.columns as u16, self.rows as u16, color).map_err(|e| {
            Error::new(ErrorKind::Codec, "a preview cannot be encoded as JPEG").with_source(e)
        })?;
        Ok(out)
    }
}

/// ITU-R BT.601 with 8 bits: Y from 16 to 235, U and V about 128.
fn rgb([y, u, v]: [u8; 3]) -> [u8; 3] {
    let y = 1.164 * (f32::from(y) - 16.0);
    let u = f32::from(u) - 128.0;
    let v = f32::from(v) - 128.0;
    [y + 1.596 * v, y - 0.392 * u - 0.813 * v, y + 2.017 * u].map(|c| c.round() as u8)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn header(format: PixelFormat, width: u32, height: u32) -> FrameHeader {
        let mut h = FrameHeader::default();
        h.set_image(format, width, height);
        h.depth_unit_m = 1e-3;
        h
    }

    /// Pixels of a JPEG, by a decoder that is not the encoder's.
    fn decoded(p: &Preview) -> image::RgbImage {
        assert_eq!(p.kind, PreviewKind::Jpeg);
        let image = depthrig_jpeg::decode(&p.bytes).unwrap();
        assert_eq!((image.info.width, image.info.height), (u32::from(p.width), u32::from(p.height)));
        let grey = image.pixels.len() == usize::from(p.width) * usize::from(p.height);
        let rgb = if grey { image.pixels.iter().flat_map(|v| [*v; 3]).collect() } else { image.pixels };
        image::RgbImage::from_raw(p.width.into(), p.height.into(), rgb).unwrap()
    }

    #[test]
    fn depth_is_every_nth_pixel_and_never_a_mean() {
        let h = header(PixelFormat::Z16, 7, 5);
        let pixels: Vec<u8> = (0..35_u16).flat_map(u16::to_le_bytes).collect();
        let p = preview(&h, &pixels, 4).unwrap();
        assert_eq!((p.kind, p.step, p.width, p.height), (PreviewKind::Depth, 2, 3, 2));
        let values: Vec<u16> = p.bytes.as_chunks().0.iter().map(|b| u16::from_le_bytes(*b)).collect();
        assert_eq!(values, [0, 2, 4, 14, 16, 18]);
        assert_eq!(preview(&h, &pixels, 0).unwrap().bytes, pixels);
        let h = header(PixelFormat::DepthF32, 4, 1);
        let pixels: Vec<u8> = [0.5_f32, f32::NAN, -1.0, 70.0].iter().flat_map(|v| v.to_le_bytes()).collect();
        assert_eq!(preview(&h, &pixels, 0).unwrap().bytes, [0xf4, 1, 0, 0, 0, 0, 0, 0]);
    }

    #[test]
    fn every_format_shows_its_colour() {
        // Left half red, right half dark grey, in each format.
        let width = 64;
        let height = 32;
        for format in PixelFormat::ALL {
            if format.is_depth() || matches!(format, PixelFormat::Motion | PixelFormat::Mjpeg) {
                continue;
            }
            let is_left = |i: usize| i % 64 < 32;
            let pixels: Vec<u8> = match format.layout() {
                Layout::Rgb => {
                    (0..2048).flat_map(|i| if is_left(i) { [255, 0, 0] } else { [50; 3] }).collect()
                }
                Layout::Bgr => {
                    (0..2048).flat_map(|i| if is_left(i) { [0, 0, 255] } else { [50; 3] }).collect()
                }
                // Red is Y 81, U 90, V 240; grey 50 is Y 59.
                Layout::Yuyv => (0..1024)
                    .flat_map(|i| if is_left(2 * i) { [81, 90, 81, 240] } else { [59, 128, 59, 128] })
                    .collect(),
                Layout::Uyvy => (0..1024)
                    .flat_map(|i| if is_left(2 * i) { [90, 81, 240, 81] } else { [128, 59, 128, 59] })
                    .collect(),
                Layout::Nv12 => (0..2048)
                    .map(|i| if is_left(i) { 81 } else { 59 })
                    .chain((0..512).flat_map(|i| if i % 32 < 16 { [90, 240] } else { [128, 128] }))
                    .collect(),
                _ => match format.sample() {
                    Sample::U8 => (0..2048).map(|i| if is_left(i) { 255 } else { 50 }).collect(),
                    Sample::U16 => (0..2048)
                        .flat_map(|i| (if is_left(i) { 1000_u16 } else { 196 }).to_le_bytes())
                        .collect(),
                    Sample::F32 => (0..2048)
                        .flat_map(|i| (if is_left(i) { 10_f32 } else { 1.96 }).to_le_bytes())
                        .collect(),
                },
            };
            for max_width in [0, 32] {
                let p = preview(&header(format, width, height), &pixels, max_width).unwrap();
                let image = decoded(&p);
                let left = image.get_pixel(image.width() / 4, image.height() / 2).0;
                let right = image.get_pixel(image.width() * 3 / 4, image.height() / 2).0;
                let is_grey = format.layout() == Layout::Grey;
                let expected = if is_grey { [255; 3] } else { [255, 0, 0] };
                let near = |a: [u8; 3], b: [u8; 3]| a.iter().zip(b).all(|(a, b)| a.abs_diff(b) <= 6);
                assert!(near(left, expected) && near(right, [50; 3]), "{format:?} {left:?} {right:?}");
            }
        }
    }

    #[test]
    fn a_mean_is_the_rounded_mean_of_its_square() {
        for (width, height, step) in [(7, 5, 2), (11, 9, 3), (13, 8, 4), (600, 600, 300)] {
            let image: Vec<u8> = (0..width * height * 3).map(|i| (i * i / 7 % 256) as u8).collect();
            let grid = Grid { width, step, columns: width / step, rows: height / step };
            let mean = |x: usize, y: usize, c: usize| {
                let square = (0..step * step).map(|i| (y * step + i / step, x * step + i % step));
                let sum: usize = square.map(|(y, x)| usize::from(image[(y * width + x) * 3 + c])).sum();
                (sum as f64 / (step * step) as f64 + 0.5) as u8
            };
            let pixels = (0..grid.rows).flat_map(|y| (0..grid.columns).map(move |x| (x, y)));
            let expected: Vec<u8> = pixels.flat_map(|(x, y)| [0, 1, 2].map(|c| mean(x, y, c))).collect();
            assert_eq!(*grid.mean::<3>(&image), expected, "step {step}");
        }
    }

    #[test]
    fn rows_with_padding_and_frames_that_are_too_short() {
        let mut h = header(PixelFormat::Mono8, 4, 2);
        h.stride = 8;
        h.payload_len = 16;
        let p = preview(&h, &[200; 16], 2).unwrap();
        assert_eq!((p.width, p.height), (2, 1));
        assert!(preview(&h, &[0; 15], 0).is_err());
        h.payload_len = 7;
        assert!(preview(&h, &[0; 16], 0).is_err());
        assert!(preview(&header(PixelFormat::Motion, 4, 1), &[0; 4096], 0).is_err());
        // A camera's own JPEG is not touched.
        let mut h = header(PixelFormat::Mjpeg, 640, 480);
        h.payload_len = 3;
        assert_eq!(preview(&h, &[1, 2, 3, 4], 100).unwrap().bytes, [1, 2, 3]);
    }
}
