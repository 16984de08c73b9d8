//! Recordings of an Azure Kinect, generated without one: as the SDK's recorder writes them, with images that follow
//! from their number or that a simulated Kinect takes. Also early forms of such files, and forms that other writers
//! give them.

#![allow(clippy::unwrap_used, clippy::expect_used)] // test support: a failure here is a failed test

use depthrig_kinect::{ColorFormat, ColorMode, ColorResolution, DepthMode, WiredSync};
use std::io::{self, BufWriter, Seek, Write};
use std::path::Path;

pub mod element;
mod images;
mod writer;

pub use images::{Images, Pattern, Simulated};

/// The calibration of a fictitious device.
pub const CALIBRATION: &str = include_str!("../../data/kinect_calibration.json");
/// Time from one IMU sample to the next, nanoseconds: 1.6 kHz.
pub const MOTION_NS: u64 = 625_000;
/// How much later than the gyroscope the accelerometer is read, nanoseconds.
pub const ACCEL_LATE_NS: u64 = 12_000;

/// How several IMU samples share a block.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Lacing {
    /// Not at all.
    None,
    /// Sizes in bytes of 255.
    Xiph,
    /// All of one size, as the SDK writes them.
    Fixed,
    /// Sizes as differences.
    Ebml,
}

/// A recording to be generated.
#[derive(Debug, Clone)]
#[allow(clippy::struct_excessive_bools)] // each is a form of its own
pub struct Fixture {
    /// Mode of the colour camera.
    pub color: Option<ColorMode>,
    /// Mode of the depth camera.
    pub depth: Option<DepthMode>,
    /// Images per second.
    pub rate_hz: u32,
    /// Captures, those in [`Self::lost`] included.
    pub captures: u32,
    /// Captures that the recorder lost.
    pub lost: Vec<u32>,
    /// Whether there is a track of motion.
    pub motion: bool,
    /// Serial number; empty for none.
    pub serial: String,
    /// The attached calibration.
    pub calibration: Option<String>,
    /// The device's clock at the file's time 0, nanoseconds.
    pub start_offset_ns: u64,
    /// How much later depth is than colour, nanoseconds.
    pub depth_delay_ns: i64,
    /// Part of the device among others.
    pub wired_sync: WiredSync,
    /// How IMU samples share blocks.
    pub lacing: Lacing,
    /// Whether clusters have checksums, as the SDK gives them.
    pub checksums: bool,
    /// Whether there is an index.
    pub index: bool,
    /// Whether tags stand behind the clusters.
    pub tags_behind: bool,
    /// Whether sizes of the segment and the clusters are left open, as programs do that cannot go back.
    pub open_sizes: bool,
    /// Depth and infrared with the low byte first in tracks that say YUY2, infrared as `DEPTH_IR`, a mode with a small
    /// `x`, and no tags that name the tracks: what very early recorders wrote.
    pub early: bool,
}

impl Default for Fixture {
    /// One second at 30 Hz of 720p JPEG, the narrow field of view, and motion.
    fn default() -> Self {
        Self {
            color: Some(ColorMode { format: ColorFormat::Mjpg, resolution: ColorResolution::P720 }),
            depth: Some(DepthMode::NfovUnbinned),
            rate_hz: 30,
            captures: 30,
            lost: Vec::new(),
            motion: true,
            serial: "000123456789".into(),
            calibration: Some(CALIBRATION.into()),
            start_offset_ns: 336_277_000,
            depth_delay_ns: 0,
            wired_sync: WiredSync::Standalone,
            lacing: Lacing::Fixed,
            checksums: true,
            index: true,
            tags_behind: false,
            open_sizes: false,
            early: false,
        }
    }
}

/// Summary of a generated recording.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Written {
    /// Where each cluster begins, bytes.
    pub clusters: Vec<u64>,
    /// Where the last one ends.
    pub clusters_end: u64,
    /// IMU samples.
    pub motion: u64,
}

impl Fixture {
    /// The device's clock at the middle of the exposure of capture `n`, colour and depth, microseconds.
    pub fn times_us(&self, n: u32) -> (u64, u64) {
        let (color, depth) = self.file_times_ns(n);
        ((color + self.start_offset_ns) / 1000, (depth + self.start_offset_ns) / 1000)
    }

    /// The same on the file's clock, nanoseconds.
    fn file_times_ns(&self, n: u32) -> (u64, u64) {
        // Whole microseconds, as the device counts.
        let at = u64::from(n) * 1_000_000 / u64::from(self.rate_hz) * 1000;
        let early = self.depth_delay_ns.min(0).unsigned_abs();
        (at + early, (at + early).saturating_add_signed(self.depth_delay_ns))
    }

    /// Length of the recording, seconds.
    pub fn length_s(&self) -> f64 {
        f64::from(self.captures) / f64::from(self.rate_hz)
    }

    /// Writes it to `path`, image by image.
    ///
    /// # Errors
    /// Those of writing.
    pub fn write(&self, path: &Path, images: &mut dyn Images) -> io::Result<Written> {
        let mut out = BufWriter::new(std::fs::File::create(path)?);
        let written = self.write_to(&mut out, images)?;
        out.flush()?;
        Ok(written)
    }

    /// Writes it to `out`.
    ///
    /// # Errors
    /// Those of writing.
    pub fn write_to(&self, out: &mut (impl Write + Seek), images: &mut dyn Images) -> io::Result<Written> {
        writer::Writer::new(self, out).run(images)
    }

    /// Its bytes, with images that follow from their number.
    pub fn bytes(&self) -> Vec<u8> {
        self.bytes_and_places().0
    }

    /// Its bytes, and where its clusters are.
    pub fn bytes_and_places(&self) -> (Vec<u8>, Written) {
        let mut out = io::Cursor::new(Vec::new());
        let written = self.write_to(&mut out, &mut Pattern::new(self)).unwrap();
        (out.into_inner(), written)
    }

    /// A small one: no camera gives images so small, and tests that look at every byte are glad of it.
    pub fn small() -> Self {
        Self {
            color: Some(ColorMode { format: ColorFormat::Nv12, resolution: ColorResolution::P720 }),
            depth: Some(DepthMode::Nfov2x2Binned),
            captures: 6,
            ..Self::default()
        }
    }
}

/// Sample `i` of motion: the gyroscope's time on the device's clock in nanoseconds, acceleration and rotation. The
/// accelerometer is [`ACCEL_LATE_NS`] later.
pub fn motion(fixture: &Fixture, i: u64) -> (u64, [f32; 3], [f32; 3]) {
    let at = fixture.start_offset_ns + i * MOTION_NS;
    let swing = (i as f32 * 0.01).sin();
    (at, [0.2 * swing, -9.81, 0.1], [0.01, 0.02 * swing, i as f32])
}

/// Puts the gyroscope's time of sample `i` of a written recording without checksums into another century.
pub fn damage_time(path: &Path, fixture: &Fixture, i: u64) {
    let (at_ns, acceleration, _) = motion(fixture, i);
    let mut sample = acceleration.map(f32::to_le_bytes).concat();
    sample.extend(at_ns.to_le_bytes());
    let mut bytes = std::fs::read(path).unwrap();
    let places: Vec<_> =
        (0..bytes.len() - sample.len()).filter(|at| bytes[*at..].starts_with(&sample)).collect();
    assert_eq!(places.len(), 1, "where the sample is");
    bytes[places[0] + sample.len() - 2] ^= 0x40;
    std::fs::write(path, bytes).unwrap();
}
