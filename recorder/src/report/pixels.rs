//! Images for the report: how much of a depth image has depth, and small copies to embed.

use crate::dataset::{DatasetFrame, jpeg_pixels};
use crate::msgs::image::check_image;
use crate::{Error, ErrorKind, Result};
use depthrig_bus::{FrameHeader, Layout, PixelFormat, Sample};
use jpeg_encoder::{ColorType, Encoder, SamplingFactor};
use std::borrow::Cow;

/// Width of a small copy, pixels: twice the shown width, for high-resolution screens and for paper.
const WIDTH: u32 = 240;
/// Height of a small copy at most, pixels.
const HEIGHT_MAX: u32 = 320;
/// Points along each side that a pixel of a small copy is the mean of.
const POINTS: u32 = 3;
/// JPEG quality of small copies.
const QUALITY: u8 = 80;

/// Viridis at ten equal steps (matplotlib, S. van der Walt and N. Smith, CC0): its lightness is even, so that it reads
/// the same on paper and with colour blindness.
const VIRIDIS: [[u8; 3]; 10] = [
    [68, 1, 84],
    [72, 40, 120],
    [62, 74, 137],
    [49, 104, 142],
    [38, 130, 142],
    [31, 158, 137],
    [53, 183, 121],
    [110, 206, 88],
    [181, 222, 43],
    [253, 231, 37],
];

/// The colours of depth from near to far, as an HTML element.
pub(super) fn ramp() -> String {
    let rgb = (0..=10).map(|i| viridis(1.0 - i as f32 / 10.0).map(|v| v.to_string()).join(","));
    let stops: Vec<_> = rgb.map(|rgb| format!("rgb({rgb})")).collect();
    format!("<span class=\"ramp\" style=\"background:linear-gradient(90deg,{})\"></span>", stops.join(","))
}

/// The colour of `x` from 0 to 1.
fn viridis(x: f32) -> [u8; 3] {
    let at = x.clamp(0.0, 1.0) * (VIRIDIS.len() - 1) as f32;
    let i = at as usize;
    let part = at.fract();
    let a = VIRIDIS[i];
    let b = VIRIDIS[(i + 1).min(VIRIDIS.len() - 1)];
    core::array::from_fn(|k| (f32::from(a[k]) + part * (f32::from(b[k]) - f32::from(a[k]))).round() as u8)
}

/// The rows of a frame's image, decoded and checked against its header.
pub(super) struct Image<'a> {
    format: PixelFormat,
    width: u32,
    height: u32,
    stride: usize,
    unit_m: f32,
    pixels: Cow<'a, [u8]>,
}

/// A small copy.
pub(super) struct Small {
    width: u32,
    height: u32,
    content: Content,
}

enum Content {
    Color(Vec<u8>),
    /// Metres; 0 without depth.
    Depth(Vec<f32>),
}

impl<'a> Image<'a> {
    /// The image of a frame that was read as it is stored.
    pub(super) fn of(frame: &'a DatasetFrame) -> Result<Self> {
        Self::new(&frame.header, frame.decoded()?)
    }

    /// The image that `header` describes.
    pub(super) fn new(header: &FrameHeader, pixels: impl Into<Cow<'a, [u8]>>) -> Result<Self> {
        let pixels = pixels.into();
        let width = header.width;
        let height = header.height;
        let unit_m = header.depth_unit_m as f32;
        let image = |format, stride, pixels| Self { format, width, height, stride, unit_m, pixels };
        if header.pixel_format().is_some_and(|f| f.layout() == Layout::Jpeg) {
            let rgb = jpeg_pixels(&pixels, header)?;
            return Ok(image(PixelFormat::Rgb8, 3 * width as usize, rgb.into()));
        }
        let format = check_image(header, pixels.len())?;
        let stride = header.stride as usize;
        Ok(image(format, stride, pixels))
    }

    fn row(&self, y: u32) -> &[u8] {
        let at = y as usize * self.stride;
        &self.pixels[at..at + self.format.row_bytes(self.width) as usize]
    }

    /// Share of the pixels that have a depth, 0 to 1; `None` for an image without depth.
    ///
    /// A pixel without depth is 0 in `z16`, and not above 0 or not finite in `depth_f32`.
    pub(super) fn fill(&self) -> Option<f64> {
        if !self.format.is_depth() {
            return None;
        }
        let filled: fn(&[u8]) -> usize = match self.format.sample() {
            Sample::U16 => |row| row.as_chunks::<2>().0.iter().filter(|p| **p != [0, 0]).count(),
            Sample::F32 => |row| {
                let depths = row.as_chunks::<4>().0.iter().map(|p| f32::from_le_bytes(*p));
                depths.filter(|d| d.is_finite() && *d > 0.0).count()
            },
            Sample::U8 => |row| row.iter().filter(|v| **v != 0).count(),
        };
        let n: usize = (0..self.height).map(|y| filled(self.row(y))).sum();
        Some(n as f64 / (f64::from(self.width) * f64::from(self.height)))
    }

    fn depth_at(&self, x: u32, y: u32) -> f32 {
        let row = self.row(y);
        let x = x as usize;
        let metres = match self.format.sample() {
            Sample::U8 => f32::from(row[x]) * self.unit_m,
            Sample::U16 => f32::from(u16::from_le_bytes([row[2 * x], row[2 * x + 1]])) * self.unit_m,
            Sample::F32 => f32::from_le_bytes([row[4 * x], row[4 * x + 1], row[4 * x + 2], row[4 * x + 3]]),
        };
        if metres.is_finite() && metres > 0.0 { metres } else { 0.0 }
    }

    fn color_at(&self, x: u32, y: u32, brightest: f32) -> [f32; 3] {
        let row = self.row(y);
        let i = x as usize;
        let byte = |at: usize| f32::from(row.get(at).copied().unwrap_or(0));
        match (self.format.layout(), self.format.sample()) {
            (Layout::Rgb, _) => [byte(3 * i), byte(3 * i + 1), byte(3 * i + 2)],
            (Layout::Bgr, _) => [byte(3 * i + 2), byte(3 * i + 1), byte(3 * i)],
            (Layout::Grey, Sample::U16) => [(byte(2 * i) + 256.0 * byte(2 * i + 1)) * 255.0 / brightest; 3],
            (Layout::Grey, Sample::F32) => [(disparity(row, i) * 255.0 / brightest).clamp(0.0, 255.0); 3],
            (Layout::Yuyv, _) => rgb_of(byte(2 * i), byte(4 * (i / 2) + 1), byte(4 * (i / 2) + 3)),
            (Layout::Uyvy, _) => rgb_of(byte(2 * i + 1), byte(4 * (i / 2)), byte(4 * (i / 2) + 2)),
            (Layout::Nv12, _) => {
                let at = (self.height + y / 2) as usize * self.stride + 2 * (i / 2);
                let chroma = |k: usize| f32::from(self.pixels.get(at + k).copied().unwrap_or(128));
                rgb_of(byte(i), chroma(0), chroma(1))
            }
            _ => [byte(i); 3],
        }
    }

    /// A copy of at most [`WIDTH`] pixels per row.
    pub(super) fn small(&self) -> Small {
        self.small_of(WIDTH)
    }

    /// A copy of at most `width` pixels per row.
    pub(super) fn small_of(&self, width: u32) -> Small {
        let width = self.width.clamp(1, width.max(1));
        let height = (self.height * width / self.width.max(1)).clamp(1, HEIGHT_MAX);
        let along = |i: u32, n: u32, k: u32, size: u32| {
            let at = (u64::from(i) * u64::from(POINTS) + u64::from(k)) * 2 + 1;
            ((at * u64::from(size)) / (2 * u64::from(POINTS) * u64::from(n))).min(u64::from(size) - 1) as u32
        };
        if self.format.is_depth() {
            // One of the pixels: the mean of a near and a far one would be a point in empty space.
            let at = |i: u32| {
                self.depth_at(
                    along(i % width, width, 1, self.width),
                    along(i / width, height, 1, self.height),
                )
            };
            return Small { width, height, content: Content::Depth((0..width * height).map(at).collect()) };
        }
        let brightest = if self.format.sample() == Sample::U8 { 255.0 } else { self.brightest() };
        let mut data = Vec::with_capacity(3 * (width * height) as usize);
        for i in 0..width * height {
            let mut sum = [0.0; 3];
            for k in 0..POINTS * POINTS {
                let x = along(i % width, width, k % POINTS, self.width);
                let y = along(i / width, height, k / POINTS, self.height);
                for (s, v) in sum.iter_mut().zip(self.color_at(x, y, brightest)) {
                    *s += v;
                }
            }
            data.extend(sum.map(|s| (s / (POINTS * POINTS) as f32).round() as u8));
        }
        Small { width, height, content: Content::Color(data) }
    }

    /// The greatest of some of the pixels of 16-bit grey or disparity, at least 1.
    fn brightest(&self) -> f32 {
        let rows = (0..self.height).step_by(4).map(|y| self.row(y));
        if self.format.sample() == Sample::F32 {
            let xs = || (0..self.width as usize).step_by(4);
            return rows.flat_map(|r| xs().map(|x| disparity(r, x))).fold(1.0, f32::max);
        }
        let values =
            rows.flat_map(|r| r.as_chunks::<2>().0.iter().step_by(4).map(|p| u16::from_le_bytes(*p)));
        f32::from(values.max().unwrap_or(1).max(1))
    }
}

/// The disparity of a pixel of a row, 0 without one.
fn disparity(row: &[u8], x: usize) -> f32 {
    let value = row.as_chunks().0.get(x).map_or(f32::NAN, |b| f32::from_le_bytes(*b));
    if value.is_finite() { value } else { 0.0 }
}

/// ITU-R BT.601, full range, as webcams send it.
fn rgb_of(y: f32, u: f32, v: f32) -> [f32; 3] {
    let u = u - 128.0;
    let v = v - 128.0;
    [y + 1.402 * v, y - 0.344_136 * u - 0.714_136 * v, y + 1.772 * u].map(|c| c.clamp(0.0, 255.0))
}

/// The range of metres that shows most of some small depth images: without the 2 % at each end.
pub(super) fn depth_range<'a>(images: impl Iterator<Item = &'a Small>) -> Option<(f32, f32)> {
    let mut depths = Vec::new();
    for small in images {
        if let Content::Depth(d) = &small.content {
            depths.extend(d.iter().copied().filter(|d| *d > 0.0));
        }
    }
    depths.sort_unstable_by(f32::total_cmp);
    let near = *depths.get(depths.len() / 50)?;
    let far = depths[depths.len() - 1 - depths.len() / 50];
    Some((near, far.max(near * 1.01)))
}

impl Small {
    /// As a JPEG in a `data:` URL; depth in colours from `range` in metres, near is light, missing is black.
    pub(super) fn data_uri(&self, range: Option<(f32, f32)>) -> Result<String> {
        let (near, far) = range.unwrap_or((0.0, 1.0));
        let shown: Cow<'_, [u8]> = match &self.content {
            Content::Color(rgb) => rgb.into(),
            Content::Depth(d) => d.iter().flat_map(|d| depth_color(*d, near, far)).collect(),
        };
        let mut jpeg = Vec::new();
        let mut encoder = Encoder::new(&mut jpeg, QUALITY);
        let color = matches!(self.content, Content::Color(_));
        encoder.set_sampling_factor(if color { SamplingFactor::R_4_2_0 } else { SamplingFactor::R_4_4_4 });
        encoder.encode(&shown, self.width as u16, self.height as u16, ColorType::Rgb).map_err(|e| {
            Error::new(ErrorKind::Codec, "a small image cannot be encoded as JPEG").with_source(e)
        })?;
        Ok(format!("data:image/jpeg;base64,{}", base64(&jpeg)))
    }

    pub(super) const fn size(&self) -> (u32, u32) {
        (self.width, self.height)
    }
}

fn depth_color(metres: f32, near: f32, far: f32) -> [u8; 3] {
    if metres > 0.0 { viridis((far - metres) / (far - near)) } else { [0; 3] }
}

/// RFC 4648, section 4.
fn base64(bytes: &[u8]) -> String {
    const ALPHABET: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let mut out = String::with_capacity(bytes.len().div_ceil(3) * 4);
    for three in bytes.chunks(3) {
        let bits = (0..3).fold(0u32, |v, i| v << 8 | u32::from(three.get(i).copied().unwrap_or(0)));
        for i in 0..4 {
            let six = (bits >> (18 - 6 * i) & 63) as usize;
            out.push(if i <= three.len() { char::from(ALPHABET[six]) } else { '=' });
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The test vectors of RFC 4648, section 10.
    #[test]
    fn base64_is_that_of_the_rfc() {
        for (bytes, text) in [
            ("", ""),
            ("f", "Zg=="),
            ("fo", "Zm8="),
            ("foo", "Zm9v"),
            ("foob", "Zm9vYg=="),
            ("fooba", "Zm9vYmE="),
            ("foobar", "Zm9vYmFy"),
        ] {
            assert_eq!(base64(bytes.as_bytes()), text);
        }
        assert_eq!(base64(&[0xfb, 0xff, 0xbf]), "+/+/");
    }

    fn header(format: PixelFormat, width: u32, height: u32) -> FrameHeader {
        let mut h = FrameHeader::default();
        h.set_image(format, width, height);
        h.depth_unit_m = 0.001;
        h
    }

    #[test]
    fn fill_counts_pixels_and_not_padding() {
        let mut h = header(PixelFormat::Z16, 2, 2);
        h.stride = 6;
        h.payload_len = 12;
        let pixels = [1, 0, 0, 0, 9, 9, 0, 1, 0, 0, 9, 9];
        assert_eq!(Image::new(&h, &pixels[..]).unwrap().fill(), Some(0.5));
        let floats: Vec<u8> =
            [1.0f32, f32::NAN, -1.0, 0.0, f32::INFINITY, 2.0].iter().flat_map(|f| f.to_le_bytes()).collect();
        let h = header(PixelFormat::DepthF32, 6, 1);
        assert_eq!(Image::new(&h, floats).unwrap().fill(), Some(2.0 / 6.0));
        assert_eq!(Image::new(&header(PixelFormat::Mono8, 1, 1), vec![3]).unwrap().fill(), None);
    }

    /// The greatest disparity is white and no match is black.
    #[test]
    fn disparity_is_shown_as_grey() {
        let row: Vec<f32> = (0..8).map(|i| if i < 4 { 32.0 } else { f32::NAN }).collect();
        let pixels: Vec<u8> = row.repeat(8).iter().flat_map(|f| f.to_le_bytes()).collect();
        let small = Image::new(&header(PixelFormat::DisparityF32, 8, 8), pixels).unwrap().small();
        let Content::Color(rgb) = &small.content else { panic!("disparity is no depth") };
        assert_eq!((rgb[0], rgb[3 * 7]), (255, 0));
    }

    /// Every format gives a small image of the right colour, and damaged headers an error.
    #[test]
    fn every_format_is_shown() {
        for format in PixelFormat::ALL.into_iter().filter(|f| *f != PixelFormat::Mjpeg) {
            let h = header(format, 640, 360);
            let pixels = vec![128; format.frame_bytes(640, 360)];
            let small = Image::new(&h, &pixels[..]).unwrap().small();
            assert_eq!(small.size(), (240, 135), "{}", format.name());
            if let Content::Color(rgb) = &small.content {
                let grey = match format {
                    PixelFormat::Mono16 => 255,
                    // The bytes are those of a small negative number.
                    PixelFormat::DisparityF32 => 0,
                    _ => 128,
                };
                assert!(rgb.iter().all(|v| v.abs_diff(grey) <= 1), "{}: {:?}", format.name(), &rgb[..3]);
            }
            assert!(small.data_uri(Some((0.1, 50.0))).unwrap().starts_with("data:image/jpeg;base64,/9j/"));
            assert!(Image::new(&h, &pixels[..100]).is_err(), "{}", format.name());
        }
        for (w, h) in [(1, 1), (1, 5000), (5000, 1)] {
            let pixels = vec![7; PixelFormat::Rgb8.frame_bytes(w, h)];
            Image::new(&header(PixelFormat::Rgb8, w, h), pixels).unwrap().small().data_uri(None).unwrap();
        }
    }

    #[test]
    fn near_is_light_and_no_depth_is_black() {
        assert_eq!(depth_color(0.0, 0.5, 2.0), [0; 3]);
        assert_eq!(depth_color(0.5, 0.5, 2.0), VIRIDIS[9]);
        assert_eq!(depth_color(9.0, 0.5, 2.0), VIRIDIS[0]);
        let h = header(PixelFormat::Z16, 100, 1);
        let pixels: Vec<u8> = (0..100u16).flat_map(|d| (d * 10).to_le_bytes()).collect();
        let small = Image::new(&h, pixels).unwrap().small();
        let (near, far) = depth_range([small].iter()).unwrap();
        assert!((near - 0.02).abs() < 0.011 && (far - 0.98).abs() < 0.011, "{near} {far}");
    }
}
