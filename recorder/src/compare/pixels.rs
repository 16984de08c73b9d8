//! How far apart two images are, sample by sample, summed over a stream.

use crate::dataset::jpeg_pixels;
use crate::still::tight;
use depthrig_bus::{FrameHeader, Layout, PixelFormat, Sample};
use serde::Serialize;

/// How far the pixels of a stream are apart, over the frames whose pixels differ.
///
/// A sample is one number of an image: a byte of an 8-bit image, a 16-bit value, a float; of a camera's JPEG a
/// byte of its decoded colours.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[non_exhaustive]
pub struct PixelDifference {
    /// `camera/stream`.
    pub stream: String,
    /// Frames whose pixels were decoded because they are not stored alike.
    pub frames_decoded: u64,
    /// Frames whose pixels differ.
    pub frames_differing: u64,
    /// Of these, frames that have another size or format in the other dataset: they have no common samples.
    pub frames_incomparable: u64,
    /// Samples of the differing frames.
    pub samples: u64,
    /// Samples that differ.
    pub samples_differing: u64,
    /// The greatest difference of two samples, in the unit of the samples; of floats where both are finite.
    pub max_abs: f64,
    /// The mean of the differences over all samples of the differing frames.
    pub mean_abs: f64,
    /// Peak signal-to-noise ratio over the differing frames, dB; 8-bit samples only.
    pub psnr_db: Option<f64>,
    #[serde(skip)]
    sums: Sums,
}

#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct Sums {
    samples: u64,
    differing: u64,
    max: f64,
    abs: f64,
    squares: f64,
    eight_bit: bool,
}

impl PixelDifference {
    pub(super) fn new(stream: &str) -> Self {
        Self {
            stream: stream.to_owned(),
            frames_decoded: 0,
            frames_differing: 0,
            frames_incomparable: 0,
            samples: 0,
            samples_differing: 0,
            max_abs: 0.0,
            mean_abs: 0.0,
            psnr_db: None,
            sums: Sums::default(),
        }
    }

    /// Compares two decoded images of the same moment; if they differ, returns a description of each.
    pub(super) fn frame(
        &mut self,
        ha: &FrameHeader,
        a: &[u8],
        hb: &FrameHeader,
        b: &[u8],
    ) -> Option<(String, String)> {
        self.frames_decoded += 1;
        let size = |h: &FrameHeader| (h.format, h.width, h.height);
        let incomparable = |this: &mut Self, x: String, y: String| {
            this.frames_differing += 1;
            this.frames_incomparable += 1;
            Some((x, y))
        };
        let Some(format) = ha.pixel_format().filter(|_| size(ha) == size(hb)) else {
            let shape = |h: &FrameHeader| {
                let format = h.pixel_format().map_or("unknown", PixelFormat::name);
                format!("{}x{} {format}", h.width, h.height)
            };
            return incomparable(self, shape(ha), shape(hb));
        };
        if format.layout() == Layout::Jpeg {
            if a == b {
                return None;
            }
            // The channel carries the JPEG itself: other bytes are another payload even where they look alike.
            return match (jpeg_pixels(a, ha), jpeg_pixels(b, hb)) {
                (Ok(x), Ok(y)) => Some(self.add(format, &x, &y)),
                (x, y) => {
                    let [x, y] = [x, y].map(|r| r.map_or_else(|e| e.to_string(), |_| "decodes".into()));
                    incomparable(self, x, y)
                }
            };
        }
        let a = tight(ha, a, format);
        let b = tight(hb, b, format);
        if a == b {
            return None;
        }
        if a.len() != b.len() {
            return incomparable(self, format!("{} bytes", a.len()), format!("{} bytes", b.len()));
        }
        Some(self.add(format, &a, &b))
    }

    fn add(&mut self, format: PixelFormat, a: &[u8], b: &[u8]) -> (String, String) {
        let sums = match format.sample() {
            Sample::U16 => Sums::of(a, b, |v: [u8; 2]| u16::from_le_bytes(v).into()),
            Sample::F32 => Sums::of(a, b, |v: [u8; 4]| f32::from_le_bytes(v).into()),
            Sample::U8 => Sums { eight_bit: true, ..Sums::of(a, b, |v: [u8; 1]| v[0].into()) },
        };
        let t = &mut self.sums;
        t.samples += sums.samples;
        t.differing += sums.differing;
        t.max = t.max.max(sums.max);
        t.abs += sums.abs;
        t.squares += sums.squares;
        self.frames_differing += 1;
        (self.samples, self.samples_differing, self.max_abs) = (t.samples, t.differing, t.max);
        self.mean_abs = t.mean();
        self.psnr_db = sums.eight_bit.then(|| t.psnr_db());
        let difference = format!(
            "{} of {} samples differ, by {} at most, {:.3} in the mean",
            sums.differing,
            sums.samples,
            sums.max,
            sums.mean()
        );
        ("as recorded".to_owned(), difference)
    }
}

impl Sums {
    fn of<const N: usize>(a: &[u8], b: &[u8], value: impl Fn([u8; N]) -> f64) -> Self {
        let mut s = Self::default();
        for (x, y) in a.as_chunks().0.iter().zip(b.as_chunks().0) {
            s.samples += 1;
            if x == y {
                continue;
            }
            s.differing += 1;
            let d = (value(*x) - value(*y)).abs();
            // A hole (NaN) against a number has no size; that it differs is counted.
            if d.is_finite() {
                s.max = s.max.max(d);
                s.abs += d;
                s.squares += d * d;
            }
        }
        s
    }

    fn mean(&self) -> f64 {
        self.abs / self.samples.max(1) as f64
    }

    /// 10 log10(255² / MSE), ITU-T J.340.
    fn psnr_db(&self) -> f64 {
        10.0 * (255.0 * 255.0 * self.samples as f64 / self.squares.max(f64::MIN_POSITIVE)).log10()
    }
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
    fn eight_bit_differences_are_measured() {
        let h = header(PixelFormat::Mono8, 4, 1);
        let mut d = PixelDifference::new("c/s");
        assert_eq!(d.frame(&h, &[1, 2, 3, 4], &h, &[1, 2, 3, 4]), None);
        assert!(d.frame(&h, &[0, 10, 20, 30], &h, &[0, 13, 20, 29]).is_some());
        assert!(d.frame(&h, &[0, 0, 0, 0], &h, &[0, 0, 0, 4]).is_some());
        assert_eq!((d.frames_decoded, d.frames_differing, d.frames_incomparable), (3, 2, 0));
        assert_eq!((d.samples, d.samples_differing, d.max_abs, d.mean_abs), (8, 3, 4.0, 1.0));
        let mse: f64 = (9.0 + 1.0 + 16.0) / 8.0;
        let psnr = d.psnr_db.unwrap();
        assert!((psnr - 10.0 * (255.0f64.powi(2) / mse).log10()).abs() < 1e-9, "{psnr}");
    }

    #[test]
    fn wider_samples_are_numbers_and_not_bytes() {
        let h = header(PixelFormat::Z16, 2, 1);
        let mut d = PixelDifference::new("c/s");
        let bytes = |v: [u16; 2]| v.map(u16::to_le_bytes).concat();
        d.frame(&h, &bytes([256, 7]), &h, &bytes([255, 7])).unwrap();
        assert_eq!((d.samples, d.samples_differing, d.max_abs, d.psnr_db), (2, 1, 1.0, None));
        let h = header(PixelFormat::DepthF32, 2, 1);
        let mut d = PixelDifference::new("c/s");
        let bytes = |v: [f32; 2]| v.map(f32::to_le_bytes).concat();
        d.frame(&h, &bytes([1.5, f32::NAN]), &h, &bytes([1.0, 2.0])).unwrap();
        assert_eq!((d.samples, d.samples_differing, d.max_abs, d.mean_abs), (2, 2, 0.5, 0.25));
    }

    #[test]
    fn bytes_between_rows_are_no_pixels() {
        let tight = header(PixelFormat::Mono8, 3, 2);
        let mut padded = tight;
        (padded.stride, padded.payload_len) = (4, 8);
        let mut d = PixelDifference::new("c/s");
        assert_eq!(d.frame(&padded, &[1, 2, 3, 9, 4, 5, 6, 9], &tight, &[1, 2, 3, 4, 5, 6]), None);
        assert!(d.frame(&padded, &[1, 2, 3, 9, 4, 5, 7, 9], &tight, &[1, 2, 3, 4, 5, 6]).is_some());
    }

    #[test]
    fn other_sizes_have_no_common_samples() {
        let a = header(PixelFormat::Mono8, 2, 1);
        let b = header(PixelFormat::Mono8, 1, 2);
        let mut d = PixelDifference::new("c/s");
        let shapes = d.frame(&a, &[1, 2], &b, &[1, 2]).unwrap();
        assert_eq!(shapes, ("2x1 mono8".to_owned(), "1x2 mono8".to_owned()));
        assert_eq!((d.frames_differing, d.frames_incomparable, d.samples), (1, 1, 0));
    }
}
