//! Format identifiers of USB video, and which pixel format each of them is.

use core::fmt;
use depthrig_bus::PixelFormat;

/// The tail that all format identifiers made from a four-character code have in common
/// (UVC 1.5 uncompressed payload specification, table 2-1).
const TAIL: [u8; 12] = [0x00, 0x00, 0x10, 0x00, 0x80, 0x00, 0x00, 0xAA, 0x00, 0x38, 0x9B, 0x71];

/// A 16-byte identifier as it is on the wire: its first three groups are little-endian.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Default)]
pub struct Guid(pub [u8; 16]);

impl Guid {
    /// The identifier made from a four-character code.
    pub const fn from_code(code: FourCc) -> Self {
        let mut bytes = [0; 16];
        let mut i = 0;
        while i < 16 {
            bytes[i] = if i < 4 { code.0[i] } else { TAIL[i - 4] };
            i += 1;
        }
        Self(bytes)
    }

    /// Its first four bytes.
    pub const fn code(self) -> FourCc {
        let [a, b, c, d, ..] = self.0;
        FourCc([a, b, c, d])
    }

    /// The format by the kernel's name of it (`V4L2_PIX_FMT_…`). The same format goes by several identifiers:
    /// 8-bit grey by `Y800`, `Y8`, `L8` (50 as a number) and `RAW8`, depth by `Z16`, `INVZ` and `D16` (80 as a
    /// number), after librealsense (`src/uvc/uvc-device.cpp`, Apache-2.0) and the kernel's table.
    pub const fn format(self) -> FourCc {
        match &self.code().0 {
            b"YUY2" => FourCc::YUYV,
            b"Y800" | b"Y8  " | b"RAW8" | b"INRI" | [0x32, 0, 0, 0] => FourCc::GREY,
            b"INVZ" | [0x50, 0, 0, 0] => FourCc::Z16,
            b"RW16" => FourCc::BYR2,
            _ => self.code(),
        }
    }

    /// The identifier under which cameras announce `format`; `None` where USB video has none of this kind.
    pub const fn of(format: PixelFormat) -> Option<Self> {
        let code = match format {
            PixelFormat::Mono8 => *b"Y8  ",
            PixelFormat::Mono16 => *b"Y16 ",
            PixelFormat::Z16 => *b"Z16 ",
            PixelFormat::Yuyv => *b"YUY2",
            PixelFormat::Uyvy => *b"UYVY",
            PixelFormat::Nv12 => *b"NV12",
            // A format descriptor of its own announces it; this is the identifier that Windows gives it.
            PixelFormat::Mjpeg => *b"MJPG",
            _ => return None,
        };
        Some(Self::from_code(FourCc(code)))
    }
}

impl fmt::Display for Guid {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let b = &self.0;
        let groups: [&[usize]; 5] = [&[3, 2, 1, 0], &[5, 4], &[7, 6], &[8, 9], &[10, 11, 12, 13, 14, 15]];
        for (i, group) in groups.iter().enumerate() {
            if i > 0 {
                f.write_str("-")?;
            }
            for &at in *group {
                write!(f, "{:02X}", b[at])?;
            }
        }
        Ok(())
    }
}

impl fmt::Debug for Guid {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

/// A four-character code of a pixel format, as the kernel names it.
#[derive(Clone, Copy, PartialEq, Eq, Hash)]
pub struct FourCc(pub [u8; 4]);

impl FourCc {
    /// Packed 4:2:2, Y0 U Y1 V.
    pub const YUYV: Self = Self(*b"YUYV");
    /// Packed 4:2:2, U Y0 V Y1.
    pub const UYVY: Self = Self(*b"UYVY");
    /// 4:2:0, a plane of Y and one of U and V.
    pub const NV12: Self = Self(*b"NV12");
    /// 8-bit grey.
    pub const GREY: Self = Self(*b"GREY");
    /// 16-bit grey.
    pub const Y16: Self = Self(*b"Y16 ");
    /// 16-bit depth.
    pub const Z16: Self = Self(*b"Z16 ");
    /// Left and right 8-bit grey, a byte of each in turn.
    pub const Y8I: Self = Self(*b"Y8I ");
    /// Left and right 12-bit grey, three bytes for a pixel of each.
    pub const Y12I: Self = Self(*b"Y12I");
    /// 16-bit Bayer pattern.
    pub const BYR2: Self = Self(*b"BYR2");
    /// JPEG images.
    pub const MJPG: Self = Self(*b"MJPG");
    /// JPEG images by the name that some kernel drivers give them.
    pub const JPEG: Self = Self(*b"JPEG");
    /// Payload headers of USB video: a format of metadata nodes.
    pub const UVCH: Self = Self(*b"UVCH");
    /// Payload headers with the blocks of RealSense D400: a format of metadata nodes.
    pub const D4XX: Self = Self(*b"D4XX");

    /// The kernel's number for it: the first character in the lowest byte.
    pub const fn number(self) -> u32 {
        u32::from_le_bytes(self.0)
    }

    /// From the kernel's number.
    pub const fn from_number(number: u32) -> Self {
        Self(number.to_le_bytes())
    }

    /// The pixel format of depthrig that has the same bytes; `None` when a driver must unpack it first, or when
    /// depthrig does not know it.
    pub fn pixel_format(self) -> Option<PixelFormat> {
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

    /// Bits that a pixel takes on the wire; `None` where it varies or is not known.
    pub const fn bits_per_pixel(self) -> Option<u32> {
        Some(match &self.0 {
            b"GREY" => 8,
            b"NV12" => 12,
            b"YUYV" | b"UYVY" | b"Y16 " | b"Z16 " | b"Y8I " | b"BYR2" => 16,
            b"Y12I" => 24,
            _ => return None,
        })
    }
}

impl fmt::Display for FourCc {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.0.iter().all(|c| (b' '..=b'~').contains(c)) {
            for c in self.0 {
                write!(f, "{}", c as char)?;
            }
            Ok(())
        } else {
            write!(f, "{:#010x}", u32::from_le_bytes(self.0))
        }
    }
}

impl fmt::Debug for FourCc {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "\"{self}\"")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_guid_reads_as_it_is_written_in_documents() {
        let unit = Guid([
            0xCB, 0x6C, 0x60, 0xC9, 0x4C, 0x59, 0x25, 0x4D, 0xAF, 0x47, 0xCC, 0xC4, 0x96, 0x43, 0x59, 0x95,
        ]);
        assert_eq!(unit.to_string(), "C9606CCB-594C-4D25-AF47-CCC496435995");
        assert_eq!(Guid::from_code(FourCc::Z16).to_string(), "2036315A-0000-0010-8000-00AA00389B71");
    }

    #[test]
    fn the_names_of_one_format_become_one() {
        for (code, want) in [
            (*b"YUY2", "YUYV"),
            (*b"UYVY", "UYVY"),
            (*b"Y8  ", "GREY"),
            (*b"Y800", "GREY"),
            (*b"RAW8", "GREY"),
            ([0x32, 0, 0, 0], "GREY"),
            ([0x50, 0, 0, 0], "Z16 "),
            (*b"Z16 ", "Z16 "),
            (*b"INVZ", "Z16 "),
            (*b"RW16", "BYR2"),
            (*b"Y8I ", "Y8I "),
            (*b"Y12I", "Y12I"),
        ] {
            assert_eq!(Guid::from_code(FourCc(code)).format().to_string(), want);
        }
        assert_eq!(FourCc([0x33, 0, 0, 0]).to_string(), "0x00000033");
    }

    #[test]
    fn a_pixel_format_comes_back_from_its_identifier() {
        let mut known = 0;
        for format in PixelFormat::ALL {
            let Some(guid) = Guid::of(format) else { continue };
            known += 1;
            assert_eq!(guid.format().pixel_format(), Some(format), "{format:?}");
            if let Some(bits) = guid.format().bits_per_pixel() {
                assert_eq!(format.frame_bytes(64, 8), 64 * 8 * bits as usize / 8, "{format:?}");
            }
        }
        assert_eq!(known, 7);
        assert_eq!(FourCc::Y8I.pixel_format(), None);
    }
}
