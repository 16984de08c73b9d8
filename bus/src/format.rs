//! Pixel formats and how many bytes an image of each takes.

use serde::{Deserialize, Serialize};

/// How the pixels of a frame are stored. The discriminant is part of the wire format.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[repr(u32)]
#[non_exhaustive]
pub enum PixelFormat {
    /// Red, green, blue, one byte each.
    Rgb8 = 1,
    /// Blue, green, red, one byte each.
    Bgr8 = 2,
    /// One byte of grey.
    Mono8 = 3,
    /// 16-bit little-endian grey (infrared).
    Mono16 = 4,
    /// 16-bit little-endian depth in units of `FrameHeader::depth_unit_m`; 0 is "no depth".
    Z16 = 5,
    /// 32-bit float depth in metres; NaN or a value not above 0 is "no depth".
    DepthF32 = 6,
    /// Packed 4:2:2, Y0 U Y1 V.
    Yuyv = 7,
    /// Packed 4:2:2, U Y0 V Y1.
    Uyvy = 8,
    /// Planar 4:2:0: Y plane, then interleaved UV.
    Nv12 = 9,
    /// One JPEG image; the payload length varies.
    Mjpeg = 10,
    /// One byte of confidence, higher is surer.
    Confidence8 = 11,
    /// 32-bit float disparity of the left image of a rectified pair, pixels; NaN is "no match".
    DisparityF32 = 12,
    /// No image: samples of an IMU ([`crate::MotionSample`]), `width` of them in one row.
    Motion = 13,
}

impl PixelFormat {
    /// Every format, in wire order.
    pub const ALL: [Self; 13] = [
        Self::Rgb8,
        Self::Bgr8,
        Self::Mono8,
        Self::Mono16,
        Self::Z16,
        Self::DepthF32,
        Self::Yuyv,
        Self::Uyvy,
        Self::Nv12,
        Self::Mjpeg,
        Self::Confidence8,
        Self::DisparityF32,
        Self::Motion,
    ];

    /// The format of a wire code, if this version knows it.
    pub fn from_code(code: u32) -> Option<Self> {
        Self::ALL.into_iter().find(|f| *f as u32 == code)
    }

    /// The name used in configuration, reports and JSON.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Rgb8 => "rgb8",
            Self::Bgr8 => "bgr8",
            Self::Mono8 => "mono8",
            Self::Mono16 => "mono16",
            Self::Z16 => "z16",
            Self::DepthF32 => "depth_f32",
            Self::Yuyv => "yuyv",
            Self::Uyvy => "uyvy",
            Self::Nv12 => "nv12",
            Self::Mjpeg => "mjpeg",
            Self::Confidence8 => "confidence8",
            Self::DisparityF32 => "disparity_f32",
            Self::Motion => "motion",
        }
    }

    /// Bytes of one row of `width` pixels without padding (the Y plane for NV12, 0 for MJPEG).
    pub const fn row_bytes(self, width: u32) -> u32 {
        match self {
            Self::Rgb8 | Self::Bgr8 => width * 3,
            Self::Mono8 | Self::Nv12 | Self::Confidence8 => width,
            Self::Mono16 | Self::Z16 | Self::Yuyv | Self::Uyvy => width * 2,
            Self::DepthF32 | Self::DisparityF32 => width * 4,
            Self::Mjpeg => 0,
            Self::Motion => width * crate::MOTION_SAMPLE_BYTES as u32,
        }
    }

    /// Bytes of an image without row padding; for MJPEG the most that is reserved for one.
    pub const fn frame_bytes(self, width: u32, height: u32) -> usize {
        match self {
            Self::Nv12 => width as usize * height as usize * 3 / 2,
            Self::Mjpeg => width as usize * height as usize * 2,
            _ => self.row_bytes(width) as usize * height as usize,
        }
    }

    /// Whether the pixels are depth, in metres or units of metres. Disparity is not.
    pub const fn is_depth(self) -> bool {
        matches!(self, Self::Z16 | Self::DepthF32)
    }

    /// Whether the frames are batches of IMU samples instead of images. Frame sets exclude such a stream.
    pub const fn is_motion(self) -> bool {
        matches!(self, Self::Motion)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes() {
        assert_eq!(PixelFormat::Rgb8.frame_bytes(1280, 720), 2_764_800);
        assert_eq!(PixelFormat::Z16.frame_bytes(1280, 720), 1_843_200);
        assert_eq!(PixelFormat::Nv12.frame_bytes(640, 480), 460_800);
    }

    #[test]
    fn codes_round_trip() {
        for f in PixelFormat::ALL {
            assert_eq!(PixelFormat::from_code(f as u32), Some(f));
        }
        assert_eq!(PixelFormat::from_code(0), None);
    }
}
