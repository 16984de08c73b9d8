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

/// Arrangement of the samples of an image.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Layout {
    /// One sample a pixel.
    Grey,
    /// Red, green, blue.
    Rgb,
    /// Blue, green, red.
    Bgr,
    /// Packed 4:2:2, Y0 U Y1 V.
    Yuyv,
    /// Packed 4:2:2, U Y0 V Y1.
    Uyvy,
    /// Planar 4:2:0: Y plane, then interleaved UV.
    Nv12,
    /// One JPEG image.
    Jpeg,
    /// Samples of an IMU.
    Motion,
}

impl Layout {
    /// Samples of a pixel in a row (of the Y plane for NV12); 0 where no array holds such an image.
    pub const fn channels(self) -> u32 {
        match self {
            Self::Grey | Self::Nv12 => 1,
            Self::Yuyv | Self::Uyvy => 2,
            Self::Rgb | Self::Bgr => 3,
            Self::Jpeg | Self::Motion => 0,
        }
    }
}

/// Type of a sample, little-endian.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Sample {
    /// An unsigned byte.
    U8,
    /// An unsigned number of 16 bits.
    U16,
    /// A float of 32 bits.
    F32,
}

impl Sample {
    /// Bytes of a sample.
    pub const fn bytes(self) -> u32 {
        match self {
            Self::U8 => 1,
            Self::U16 => 2,
            Self::F32 => 4,
        }
    }
}

/// A format's row in the table below.
struct Facts {
    format: PixelFormat,
    name: &'static str,
    layout: Layout,
    sample: Sample,
    is_depth: bool,
    ros: Option<&'static str>,
}

const fn facts(
    format: PixelFormat,
    name: &'static str,
    layout: Layout,
    sample: Sample,
    ros: Option<&'static str>,
) -> Facts {
    Facts { format, name, layout, sample, is_depth: false, ros }
}

const fn depth(format: PixelFormat, name: &'static str, sample: Sample, ros: &'static str) -> Facts {
    Facts { is_depth: true, ..facts(format, name, Layout::Grey, sample, Some(ros)) }
}

/// Everything about the formats, in wire order: a new format is a row here.
const TABLE: [Facts; 13] = [
    facts(PixelFormat::Rgb8, "rgb8", Layout::Rgb, Sample::U8, Some("rgb8")),
    facts(PixelFormat::Bgr8, "bgr8", Layout::Bgr, Sample::U8, Some("bgr8")),
    facts(PixelFormat::Mono8, "mono8", Layout::Grey, Sample::U8, Some("mono8")),
    facts(PixelFormat::Mono16, "mono16", Layout::Grey, Sample::U16, Some("mono16")),
    depth(PixelFormat::Z16, "z16", Sample::U16, "16UC1"),
    depth(PixelFormat::DepthF32, "depth_f32", Sample::F32, "32FC1"),
    facts(PixelFormat::Yuyv, "yuyv", Layout::Yuyv, Sample::U8, Some("yuv422_yuy2")),
    facts(PixelFormat::Uyvy, "uyvy", Layout::Uyvy, Sample::U8, Some("yuv422")),
    facts(PixelFormat::Nv12, "nv12", Layout::Nv12, Sample::U8, Some("nv12")),
    facts(PixelFormat::Mjpeg, "mjpeg", Layout::Jpeg, Sample::U8, None),
    facts(PixelFormat::Confidence8, "confidence8", Layout::Grey, Sample::U8, Some("mono8")),
    facts(PixelFormat::DisparityF32, "disparity_f32", Layout::Grey, Sample::F32, Some("32FC1")),
    facts(PixelFormat::Motion, "motion", Layout::Motion, Sample::U8, None),
];

impl PixelFormat {
    /// Every format, in wire order.
    pub const ALL: [Self; TABLE.len()] = {
        let mut all = [Self::Rgb8; TABLE.len()];
        let mut i = 0;
        while i < TABLE.len() {
            assert!(TABLE[i].format as usize == i + 1, "the table is in wire order");
            all[i] = TABLE[i].format;
            i += 1;
        }
        all
    };

    /// The format of a wire code, if this version knows it.
    pub fn from_code(code: u32) -> Option<Self> {
        Self::ALL.into_iter().find(|f| *f as u32 == code)
    }

    const fn facts(self) -> &'static Facts {
        &TABLE[self as usize - 1]
    }

    /// The name used in configuration, reports and JSON.
    pub const fn name(self) -> &'static str {
        self.facts().name
    }

    /// Arrangement of the samples.
    pub const fn layout(self) -> Layout {
        self.facts().layout
    }

    /// Type of the samples.
    pub const fn sample(self) -> Sample {
        self.facts().sample
    }

    /// NumPy's name of the type of the samples.
    pub const fn numpy(self) -> &'static str {
        match self.sample() {
            Sample::U8 => "|u1",
            Sample::U16 => "<u2",
            Sample::F32 => "<f4",
        }
    }

    /// The `encoding` of `sensor_msgs/msg/Image` of ROS; `None` where such a message cannot hold it.
    pub const fn ros_encoding(self) -> Option<&'static str> {
        self.facts().ros
    }

    /// Bytes of one row of `width` pixels without padding (the Y plane for NV12, 0 for MJPEG).
    pub const fn row_bytes(self, width: u32) -> u32 {
        match self.layout() {
            Layout::Motion => width * crate::MOTION_SAMPLE_BYTES as u32,
            layout => width * layout.channels() * self.sample().bytes(),
        }
    }

    /// Bytes of an image without row padding; for MJPEG the most that is reserved for one.
    pub const fn frame_bytes(self, width: u32, height: u32) -> usize {
        match self.layout() {
            Layout::Nv12 => width as usize * height as usize * 3 / 2,
            Layout::Jpeg => width as usize * height as usize * 2,
            _ => self.row_bytes(width) as usize * height as usize,
        }
    }

    /// Whether colour has fewer samples than brightness.
    pub const fn is_subsampled(self) -> bool {
        matches!(self.layout(), Layout::Yuyv | Layout::Uyvy | Layout::Nv12)
    }

    /// Whether the pixels are depth, in metres or units of metres. Disparity is not.
    pub const fn is_depth(self) -> bool {
        self.facts().is_depth
    }

    /// Whether the frames are batches of IMU samples instead of images. Frame sets exclude such a stream.
    pub const fn is_motion(self) -> bool {
        matches!(self.layout(), Layout::Motion)
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
