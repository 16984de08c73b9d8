//! Four-character codes of V4L2 formats.

use core::fmt;
use depthrig_bus::PixelFormat;

/// A format as V4L2 names it (`linux/videodev2.h`).
#[derive(Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct FourCc(pub [u8; 4]);

impl FourCc {
    /// Packed 4:2:2, Y0 U Y1 V.
    pub const YUYV: Self = Self(*b"YUYV");
    /// Packed 4:2:2, U Y0 V Y1.
    pub const UYVY: Self = Self(*b"UYVY");
    /// Y plane, then interleaved UV at half the size.
    pub const NV12: Self = Self(*b"NV12");
    /// 8-bit grey.
    pub const GREY: Self = Self(*b"GREY");
    /// 16-bit little-endian grey.
    pub const Y16: Self = Self(*b"Y16 ");
    /// 16-bit little-endian depth.
    pub const Z16: Self = Self(*b"Z16 ");
    /// Motion JPEG.
    pub const MJPG: Self = Self(*b"MJPG");
    /// Baseline JPEG pictures, which some drivers call it.
    pub const JPEG: Self = Self(*b"JPEG");
    /// Left and right bytes in turn (RealSense).
    pub const Y8I: Self = Self(*b"Y8I ");
    /// Left and right 12-bit pixels in turn (RealSense).
    pub const Y12I: Self = Self(*b"Y12I");
    /// USB video payload headers (metadata nodes).
    pub const UVCH: Self = Self(*b"UVCH");
    /// USB video payload headers with the blocks of RealSense D400 (metadata nodes).
    pub const D4XX: Self = Self(*b"D4XX");

    /// The code as the kernel has it: the first character in the lowest byte.
    pub const fn code(self) -> u32 {
        u32::from_le_bytes(self.0)
    }

    /// From the kernel's number.
    pub const fn from_code(code: u32) -> Self {
        Self(code.to_le_bytes())
    }

    /// What a picture of this format is delivered as without being changed; `None` where there is no such format.
    pub const fn pixel_format(self) -> Option<PixelFormat> {
        Some(match self {
            Self::YUYV => PixelFormat::Yuyv,
            Self::UYVY => PixelFormat::Uyvy,
            Self::NV12 => PixelFormat::Nv12,
            Self::GREY => PixelFormat::Mono8,
            Self::Y16 => PixelFormat::Mono16,
            Self::Z16 => PixelFormat::Z16,
            Self::MJPG | Self::JPEG => PixelFormat::Mjpeg,
            _ => return None,
        })
    }
}

impl fmt::Display for FourCc {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let shown = |b: &u8| if b.is_ascii_graphic() || *b == b' ' { char::from(*b) } else { '?' };
        let text: String = self.0.iter().map(shown).collect();
        f.write_str(text.trim_end())
    }
}

impl fmt::Debug for FourCc {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}
