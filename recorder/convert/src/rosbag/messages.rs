//! The few ROS 1 messages in a recording of librealsense: little-endian fields one after the other, text and lists with
//! their length before them (<http://wiki.ros.org/msg>).

use depthrig_bus::{Distortion, Intrinsics, PixelFormat};

/// The longest side of an image, pixels: a longer one would overflow the size of an image.
const MAX_SIDE: u32 = 1 << 16;

/// Reads fields; `None` where the data end too early.
struct Fields<'a>(&'a [u8]);

impl<'a> Fields<'a> {
    fn take(&mut self, n: usize) -> Option<&'a [u8]> {
        let (taken, rest) = self.0.split_at_checked(n)?;
        self.0 = rest;
        Some(taken)
    }

    fn u8(&mut self) -> Option<u8> {
        self.take(1).map(|b| b[0])
    }

    fn u32(&mut self) -> Option<u32> {
        Some(u32::from_le_bytes(self.take(4)?.try_into().ok()?))
    }

    fn f64(&mut self) -> Option<f64> {
        Some(f64::from_le_bytes(self.take(8)?.try_into().ok()?))
    }

    fn bytes(&mut self) -> Option<&'a [u8]> {
        let n = self.u32()? as usize;
        self.take(n)
    }

    fn text(&mut self) -> Option<&'a str> {
        core::str::from_utf8(self.bytes()?).ok()
    }

    /// `std_msgs/Header`; its stamp in nanoseconds.
    fn header(&mut self) -> Option<i64> {
        let _seq = self.u32()?;
        let s = self.u32()?;
        let ns = self.u32()?;
        self.bytes()?;
        Some(i64::from(s) * 1_000_000_000 + i64::from(ns))
    }
}

/// `sensor_msgs/Image`.
pub(super) struct Image<'a> {
    pub stamp_ns: i64,
    pub width: u32,
    pub height: u32,
    pub encoding: &'a str,
    pub big_endian: bool,
    pub step: u32,
    pub data: &'a [u8],
}

pub(super) fn image(data: &[u8]) -> Option<Image<'_>> {
    let mut f = Fields(data);
    let stamp_ns = f.header()?;
    let height = f.u32()?;
    let width = f.u32()?;
    let encoding = f.text()?;
    let big_endian = f.u8()? != 0;
    let step = f.u32()?;
    Some(Image { stamp_ns, width, height, encoding, big_endian, step, data: f.bytes()? })
}

impl Image<'_> {
    /// The pixel format, if datasets know it and the size is one of an image; a depth stream says only how wide its numbers are.
    pub(super) fn format(&self, depth: bool) -> Option<PixelFormat> {
        if ![self.width, self.height].iter().all(|side| (1..=MAX_SIDE).contains(side)) {
            return None;
        }
        Some(match self.encoding {
            "mono16" | "16UC1" if depth => PixelFormat::Z16,
            "mono16" | "16UC1" => PixelFormat::Mono16,
            "mono8" | "8UC1" => PixelFormat::Mono8,
            "rgb8" => PixelFormat::Rgb8,
            "bgr8" => PixelFormat::Bgr8,
            "32FC1" if depth => PixelFormat::DepthF32,
            _ => return None,
        })
    }
}

/// Width, height and intrinsics of a `sensor_msgs/CameraInfo`; librealsense writes its own names of distortion models.
pub(super) fn camera_info(data: &[u8]) -> Option<(u32, u32, Intrinsics)> {
    let mut f = Fields(data);
    f.header()?;
    let height = f.u32()?;
    let width = f.u32()?;
    let model = f.text()?.to_lowercase();
    let n = f.u32()?;
    let mut coeffs = [0.0; 8];
    for i in 0..n as usize {
        let c = f.f64()?;
        *coeffs.get_mut(i)? = c;
    }
    let mut k = [0.0; 9];
    for v in &mut k {
        *v = f.f64()?;
    }
    let straight = coeffs.iter().all(|c| *c == 0.0);
    let model = match model.as_str() {
        "brown conrady" | "plumb_bob" => Distortion::BrownConrady,
        "inverse brown conrady" => Distortion::InverseBrownConrady,
        "kannala brandt4" | "equidistant" => Distortion::KannalaBrandt4,
        "rational_polynomial" => Distortion::Rational,
        // Among others RealSense's "Modified Brown Conrady", which no field here stands for.
        _ if straight => Distortion::None,
        _ => Distortion::Unknown,
    };
    let [fx, _, cx, _, fy, cy, ..] = k;
    Some((width, height, Intrinsics { fx, fy, cx, cy, coeffs, model: model as u32, reserved: 0 }))
}

/// `geometry_msgs/Transform`: translation and quaternion x, y, z, w.
#[derive(Debug, Clone, Copy)]
pub(super) struct Transform {
    pub(super) translation: [f64; 3],
    pub(super) rotation: [f64; 4],
}

pub(super) fn transform(data: &[u8]) -> Option<Transform> {
    let mut f = Fields(data);
    let translation = [f.f64()?, f.f64()?, f.f64()?];
    Some(Transform { translation, rotation: [f.f64()?, f.f64()?, f.f64()?, f.f64()?] })
}

/// `diagnostic_msgs/KeyValue`.
pub(super) fn key_value(data: &[u8]) -> Option<(&str, &str)> {
    let mut f = Fields(data);
    Some((f.text()?, f.text()?))
}

/// `std_msgs/Float32`.
pub(super) fn float(data: &[u8]) -> Option<f32> {
    Some(f32::from_le_bytes(data.try_into().ok()?))
}

/// The rate in a `realsense_msgs/StreamInfo`, Hz.
pub(super) fn stream_rate(data: &[u8]) -> Option<u32> {
    Fields(data).u32()
}
