//! The images of a generated recording.

use super::Fixture;
use depthrig_bus::{Name, PixelFormat, Pose};
use depthrig_calib::PoseExt;
use depthrig_driver::{Backend, MemorySink, StreamProfile, StreamRequest};
use depthrig_kinect::calibration::{Calibration, CameraCalibration, LensModel, RawIntrinsics};
use depthrig_kinect::modes::Cut;
use depthrig_kinect::{ColorFormat, ColorMode, DepthMode};
use depthrig_sim::synthetic::{SyntheticBackend, SyntheticConfig};
use jpeg_encoder::{ColorType, Encoder, SamplingFactor};
use std::collections::HashMap;
use std::time::Duration;

/// The cameras' images at each capture, asked for in order.
pub trait Images {
    /// Colour as the camera sends it in the recording's mode.
    fn color(&mut self, n: u32) -> Vec<u8>;
    /// Depth in millimetres, row by row.
    fn depth(&mut self, n: u32) -> Vec<u16>;
    /// Infrared, row by row.
    fn infrared(&mut self, n: u32) -> Vec<u16>;
}

/// Images that follow from their number. There are [`Pattern::DIFFERENT`] of them, and then they begin again.
pub struct Pattern {
    color: Option<ColorMode>,
    depth_size: (u32, u32),
    /// JPEG is slow to make.
    jpegs: HashMap<u32, Vec<u8>>,
}

impl Pattern {
    /// Different images.
    pub const DIFFERENT: u32 = 5;

    /// The images of `fixture`.
    pub fn new(fixture: &Fixture) -> Self {
        let depth_size = fixture.depth.map_or((0, 0), DepthMode::size);
        Self { color: fixture.color, depth_size, jpegs: HashMap::new() }
    }

    /// Red, green and blue of an image: slopes, edges and grain, so that it packs as a room does (1.3 bits a pixel at
    /// 720p).
    pub fn rgb(width: u32, height: u32, n: u32) -> Vec<u8> {
        let n = n % Self::DIFFERENT;
        let mut noise = 0x9E37_79B9_u32.wrapping_add(n);
        let mut out = Vec::with_capacity((width * height * 3) as usize);
        for y in 0..height {
            for x in 0..width {
                noise ^= noise << 13;
                noise ^= noise >> 17;
                noise ^= noise << 5;
                let grain = (noise & 15) as i32 - 8;
                let edge = if ((x + 20 * n) / 40 + y / 48).is_multiple_of(2) { 60 } else { 0 };
                let at = |base: u32| (base as i32 + edge + grain).clamp(0, 255) as u8;
                out.extend([at(x * 150 / width), at(y * 150 / height), at(90 + 20 * n)]);
            }
        }
        out
    }
}

impl Images for Pattern {
    fn color(&mut self, n: u32) -> Vec<u8> {
        let Some(mode) = self.color else { return Vec::new() };
        let (width, height) = mode.resolution.size();
        let n = n % Self::DIFFERENT;
        let pixels = width * height;
        match mode.format {
            ColorFormat::Mjpg => {
                let made = || jpeg(&Self::rgb(width, height, n), width, height, 90);
                self.jpegs.entry(n).or_insert_with(made).clone()
            }
            ColorFormat::Nv12 => (0..pixels * 3 / 2).map(|i| (i * 7 + i / width + n * 31) as u8).collect(),
            ColorFormat::Yuy2 => (0..pixels * 2).map(|i| (i * 5 + i / width + n * 29) as u8).collect(),
            ColorFormat::Bgra => {
                let rgb = Self::rgb(width, height, n);
                rgb.chunks_exact(3).flat_map(|p| [p[2], p[1], p[0], 255]).collect()
            }
        }
    }

    fn depth(&mut self, n: u32) -> Vec<u16> {
        let (width, height) = self.depth_size;
        let n = n % Self::DIFFERENT;
        let at = |x: u32, y: u32| {
            if (x / 16 + y / 16).is_multiple_of(13) { 0 } else { (500 + 37 * n + 3 * x + 2 * y) as u16 }
        };
        (0..height).flat_map(|y| (0..width).map(move |x| at(x, y))).collect()
    }

    fn infrared(&mut self, n: u32) -> Vec<u16> {
        let (width, height) = self.depth_size;
        let n = n % Self::DIFFERENT;
        (0..height).flat_map(|y| (0..width).map(move |x| (x * 31 + y * 17 + n * 101) as u16)).collect()
    }
}

fn jpeg(rgb: &[u8], width: u32, height: u32, quality: u8) -> Vec<u8> {
    let mut out = Vec::new();
    let mut encoder = Encoder::new(&mut out, quality);
    encoder.set_sampling_factor(SamplingFactor::F_1_1);
    encoder.encode(rgb, width as u16, height as u16, ColorType::Rgb).unwrap();
    out
}

/// Images of a simulated Kinect in a room with objects. Infrared is derived from its depth.
pub struct Simulated {
    shots: Vec<(Vec<u8>, Vec<u16>)>,
}

impl Simulated {
    /// Takes `shots` captures for `fixture`, which has JPEG and depth, and gives it the simulated device's calibration.
    /// A recording of more captures shows them again and again.
    ///
    /// # Panics
    /// When the simulated Kinect has no such modes.
    pub fn shoot(fixture: &mut Fixture, shots: usize) -> Self {
        let color = fixture.color.filter(|c| c.format == ColorFormat::Mjpg).expect("JPEG");
        let depth = fixture.depth.expect("depth");
        let config = SyntheticConfig { model: "kinect".into(), ..SyntheticConfig::default() };
        let wanted =
            |name, size| StreamRequest { size: Some(size), ..StreamRequest::any(Name::new(name).unwrap()) };
        let requests = [wanted("color", color.resolution.size()), wanted("depth", depth.size())];
        let mut stream =
            SyntheticBackend::new(vec![config]).unwrap().open(None).unwrap().start(&requests).unwrap();
        let mut sink = MemorySink::default();
        while (0..2).any(|i| sink.delivered(i) < shots as u64) {
            stream.poll(Duration::from_millis(50), &mut sink).unwrap();
        }
        let [c, d] = stream.profiles() else { panic!("two streams were asked for") };
        assert_eq!((c.format, d.format, d.depth_unit_m), (PixelFormat::Rgb8, PixelFormat::Z16, 0.001));
        fixture.calibration = Some(calibration(c, color.resolution.cut(), d, depth.cut()).build());
        let of = |stream: usize| sink.frames.iter().filter(move |f| f.0 == stream).map(|f| &f.2).take(shots);
        let pairs = of(0).zip(of(1)).map(|(rgb, z16)| {
            let depth = z16.as_chunks::<2>().0.iter().map(|b| u16::from_le_bytes(*b)).collect();
            (jpeg(rgb, c.width, c.height, 90), depth)
        });
        Self { shots: pairs.collect() }
    }

    fn shot(&self, n: u32) -> &(Vec<u8>, Vec<u16>) {
        &self.shots[n as usize % self.shots.len()]
    }
}

impl Images for Simulated {
    fn color(&mut self, n: u32) -> Vec<u8> {
        self.shot(n).0.clone()
    }

    fn depth(&mut self, n: u32) -> Vec<u16> {
        self.shot(n).1.clone()
    }

    /// Brighter where it is nearer.
    fn infrared(&mut self, n: u32) -> Vec<u16> {
        let bright = |mm: &u16| (4_000_000_000 / u64::from((*mm).max(500)).pow(2)).min(16_000) as u16;
        self.shot(n).1.iter().map(bright).collect()
    }
}

/// The calibration of a device whose cameras have these intrinsics and poses.
fn calibration(color: &StreamProfile, color_cut: Cut, depth: &StreamProfile, depth_cut: Cut) -> Calibration {
    let raw = |p: &StreamProfile, cut: Cut| {
        let k = p.intrinsics;
        let width = f64::from(cut.sensor.0);
        let height = f64::from(cut.sensor.1);
        let [k1, k2, p1, p2, k3, k4, k5, k6] = k.coeffs;
        RawIntrinsics {
            model: LensModel::BrownConrady,
            cx: (k.cx + 0.5 + f64::from(cut.offset.0)) / width,
            cy: (k.cy + 0.5 + f64::from(cut.offset.1)) / height,
            fx: k.fx / width,
            fy: k.fy / height,
            k: [k1, k2, k3, k4, k5, k6],
            p1,
            p2,
            center: [0.0; 2],
        }
    };
    let camera = |p: &StreamProfile, cut, camera_from_device, sensor| CameraCalibration {
        intrinsics: raw(p, cut),
        metric_radius: 1.7,
        camera_from_device,
        sensor,
    };
    let color_from_depth = color.pose_in_device.inverse().compose(&depth.pose_in_device);
    Calibration {
        depth: camera(depth, depth_cut, Pose::IDENTITY, (1024, 1024)),
        color: camera(color, color_cut, color_from_depth, (4096, 3072)),
        gyroscope: None,
        accelerometer: None,
    }
}
