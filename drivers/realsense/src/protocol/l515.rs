//! An L515's reports about itself: intrinsics by size, the pose of its colour sensor, controls, temperatures, errors.
//!
//! Sources: librealsense v2.54 `src/l500/l500-private.h`, `l500-color.cpp` and `l500-depth.cpp` (Apache-2.0).

use super::hwm::{HardwareMonitor, Request};
use super::intrinsics::{rigid, rotation};
use super::protocol_error;
use depthrig_bus::{Distortion, Intrinsics, Pose};
use depthrig_driver::bytes::{f32_at, f32s_at, f64_at, i32_at, put, put_f32s, u8_at, u32_at};
use depthrig_driver::{Error, ErrorKind, Result};
use glam::DVec3;

/// Selector of the error report in the extension unit, one byte.
pub const ERROR_SELECTOR: u8 = 3;

/// A camera has no more sizes than this in a table.
const MOST_SIZES: usize = 5;

/// A lens at one size: 44 bytes.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Lens {
    /// Pixels per row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Focal length along x, pixels.
    pub fx: f32,
    /// Focal length along y, pixels.
    pub fy: f32,
    /// Principal point x, pixels.
    pub ppx: f32,
    /// Principal point y, pixels.
    pub ppy: f32,
    /// Distortion `k1 k2 p1 p2 k3`.
    pub distortion: [f32; 5],
}

const LENS: usize = 44;

impl Lens {
    fn parse(bytes: &[u8], at: usize) -> Option<Self> {
        let [fx, fy, ppx, ppy] = f32s_at(bytes, at + 8)?;
        let width = u32_at(bytes, at)?;
        let height = u32_at(bytes, at + 4)?;
        Some(Self { width, height, fx, fy, ppx, ppy, distortion: f32s_at(bytes, at + 24)? })
    }

    fn build(&self, bytes: &mut [u8], at: usize) {
        put(bytes, at, &self.width.to_le_bytes());
        put(bytes, at + 4, &self.height.to_le_bytes());
        put_f32s(bytes, at + 8, &[self.fx, self.fy, self.ppx, self.ppy]);
        put_f32s(bytes, at + 24, &self.distortion);
    }

    fn pinhole(&self) -> Result<Intrinsics> {
        let Self { width, height, fx, fy, ppx, ppy, distortion } = *self;
        let finite = [fx, fy, ppx, ppy].iter().chain(&distortion).all(|v| v.is_finite());
        if !finite || fx <= 0.0 || fy <= 0.0 {
            let text = format!(
                "the camera is not calibrated: its table holds no intrinsics for {width}x{height}; only the vendor can \
                 calibrate an L515"
            );
            return Err(Error::new(ErrorKind::Unsupported, text));
        }
        Ok(Intrinsics::pinhole(fx.into(), fy.into(), ppx.into(), ppy.into()))
    }
}

/// Depth at one size: as the sensor sees it, and in space. 112 bytes.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct DepthLens {
    /// Before the correction of the mirror.
    pub raw: DepthPart,
    /// After it: what the images are.
    pub world: DepthPart,
}

/// One half of [`DepthLens`]: 56 bytes.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct DepthPart {
    /// The lens.
    pub lens: Lens,
    /// Where the laser leaves, pixels.
    pub zero_order: [f32; 2],
    /// Units of depth per millimetre.
    pub z_norm: f32,
}

const DEPTH_PART: usize = LENS + 12;

impl DepthPart {
    fn parse(bytes: &[u8], at: usize) -> Option<Self> {
        Some(Self {
            lens: Lens::parse(bytes, at)?,
            zero_order: f32s_at(bytes, at + LENS)?,
            z_norm: f32_at(bytes, at + LENS + 8)?,
        })
    }

    fn build(&self, bytes: &mut [u8], at: usize) {
        self.lens.build(bytes, at);
        put_f32s(bytes, at + LENS, &self.zero_order);
        put_f32s(bytes, at + LENS + 8, &[self.z_norm]);
    }
}

/// The table of depth intrinsics (`intrinsic_depth`).
#[derive(Debug, Clone, PartialEq, Default)]
pub struct DepthIntrinsics {
    /// Which way the mirror moves, horizontally and vertically.
    pub scan: [u8; 2],
    /// Offset that the camera adds to each depth, millimetres.
    pub offset: f32,
    /// One entry for each size.
    pub sizes: Vec<DepthLens>,
}

/// Bytes before the entries: 12 of the orientation, 4 with the number of entries.
const DEPTH_HEADER: usize = 16;

impl DepthIntrinsics {
    /// Asks an L515.
    ///
    /// # Errors
    /// Those of [`HardwareMonitor::command`] and [`Self::parse`].
    pub fn read(monitor: &mut dyn HardwareMonitor) -> Result<Self> {
        Self::parse(&monitor.command(&Request::l515_depth_intrinsics())?)
    }

    /// Reads the data of a reply. The camera may send more than its entries.
    ///
    /// # Errors
    /// [`ErrorKind::Protocol`] when it says that it has more entries than came, or than any camera has, or none.
    pub fn parse(data: &[u8]) -> Result<Self> {
        let n = entries("depth", u8_at(data, 15), data.len())?;
        let all = || {
            let mut sizes = Vec::with_capacity(n);
            for i in 0..n {
                let at = DEPTH_HEADER + 2 * DEPTH_PART * i;
                let raw = DepthPart::parse(data, at)?;
                sizes.push(DepthLens { raw, world: DepthPart::parse(data, at + DEPTH_PART)? });
            }
            Some(Self { scan: [u8_at(data, 0)?, u8_at(data, 1)?], offset: f32_at(data, 8)?, sizes })
        };
        all().ok_or_else(|| too_short("depth", data.len(), DEPTH_HEADER + 2 * DEPTH_PART * n))
    }

    /// The data of a reply, for an emulated camera.
    pub fn build(&self) -> Vec<u8> {
        let mut data = vec![0; DEPTH_HEADER + 2 * DEPTH_PART * self.sizes.len()];
        put(&mut data, 0, &self.scan);
        put_f32s(&mut data, 8, &[self.offset]);
        put(&mut data, 15, &[self.sizes.len() as u8]);
        for (i, size) in self.sizes.iter().enumerate() {
            let at = DEPTH_HEADER + 2 * DEPTH_PART * i;
            size.raw.build(&mut data, at);
            size.world.build(&mut data, at + DEPTH_PART);
        }
        data
    }

    /// Intrinsics of depth and infrared at `width` x `height`, the size after they were turned. Without distortion,
    /// as the vendor's software has it.
    ///
    /// # Errors
    /// [`ErrorKind::Unsupported`] without an entry of that size, or if it was never calibrated.
    pub fn at(&self, width: u32, height: u32) -> Result<Intrinsics> {
        let lenses = self.sizes.iter().map(|s| &s.world.lens);
        lens_at("depth", lenses, width, height)?.pinhole()
    }

    /// Metres per unit of depth: a thousandth of what `znorm` of the first entry divides 1 by. 0.00025 m on every
    /// unit known.
    ///
    /// # Errors
    /// [`ErrorKind::Protocol`] if the result is not a usable unit.
    pub fn unit_m(&self) -> Result<f64> {
        let z_norm = self.sizes.first().map_or(0.0, |s| f64::from(s.world.z_norm));
        let unit = 0.001 / z_norm;
        // Infinitely many units would make each of them nothing.
        if z_norm.is_finite() && z_norm > 0.0 && unit < 1.0 {
            return Ok(unit);
        }
        Err(protocol_error(format!("the L515 reports {z_norm} depth units per millimetre")))
    }
}

/// The table of colour intrinsics (`intrinsic_rgb`).
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ColorIntrinsics {
    /// Shear of the sensor's axes.
    pub shear: f32,
    /// One entry for each size.
    pub sizes: Vec<Lens>,
}

/// Bytes before the entries: 8 of the common part, 4 with the number of entries.
const COLOR_HEADER: usize = 12;

impl ColorIntrinsics {
    /// Asks an L515.
    ///
    /// # Errors
    /// Those of [`HardwareMonitor::command`] and [`Self::parse`].
    pub fn read(monitor: &mut dyn HardwareMonitor) -> Result<Self> {
        Self::parse(&monitor.command(&Request::l515_color_intrinsics())?)
    }

    /// Reads the data of a reply. The camera may send more than its entries.
    ///
    /// # Errors
    /// As [`DepthIntrinsics::parse`].
    pub fn parse(data: &[u8]) -> Result<Self> {
        let n = entries("colour", u8_at(data, 11), data.len())?;
        let lenses = (0..n).map(|i| Lens::parse(data, COLOR_HEADER + LENS * i));
        let all = || Some(Self { shear: f32_at(data, 0)?, sizes: lenses.collect::<Option<_>>()? });
        all().ok_or_else(|| too_short("colour", data.len(), COLOR_HEADER + LENS * n))
    }

    /// The data of a reply, for an emulated camera.
    pub fn build(&self) -> Vec<u8> {
        let mut data = vec![0; COLOR_HEADER + LENS * self.sizes.len()];
        put_f32s(&mut data, 0, &[self.shear]);
        put(&mut data, 11, &[self.sizes.len() as u8]);
        for (i, size) in self.sizes.iter().enumerate() {
            size.build(&mut data, COLOR_HEADER + LENS * i);
        }
        data
    }

    /// Intrinsics of colour at `width` x `height`, with the distortion of Brown and Conrady.
    ///
    /// # Errors
    /// [`ErrorKind::Unsupported`] without an entry of that size, or if it was never calibrated.
    pub fn at(&self, width: u32, height: u32) -> Result<Intrinsics> {
        let lens = lens_at("colour", self.sizes.iter(), width, height)?;
        let mut intrinsics = lens.pinhole()?;
        intrinsics.model = Distortion::BrownConrady as u32;
        for (to, from) in intrinsics.coeffs.iter_mut().zip(lens.distortion) {
            *to = from.into();
        }
        Ok(intrinsics)
    }
}

fn entries(of: &str, n: Option<u8>, length: usize) -> Result<usize> {
    match n.map(usize::from) {
        Some(n @ 1..=MOST_SIZES) => Ok(n),
        Some(n) => Err(protocol_error(format!(
            "the L515's table of {of} intrinsics states {n} entries; a camera has 1 to {MOST_SIZES}"
        ))),
        None => Err(too_short(of, length, COLOR_HEADER)),
    }
}

fn too_short(of: &str, is: usize, must: usize) -> Error {
    protocol_error(format!("the L515's table of {of} intrinsics has {is} bytes; at least {must} are needed"))
}

fn lens_at<'a>(
    of: &str,
    mut lenses: impl Iterator<Item = &'a Lens> + Clone,
    width: u32,
    height: u32,
) -> Result<&'a Lens> {
    let there_are: Vec<_> = lenses.clone().map(|l| format!("{}x{}", l.width, l.height)).collect();
    lenses.find(|l| (l.width, l.height) == (width, height)).ok_or_else(|| {
        let list = there_are.join(", ");
        let text = format!("the L515 has no {of} intrinsics for {width}x{height}; it has them for {list}");
        Error::new(ErrorKind::Unsupported, text)
    })
}

/// From depth to colour: `p_color = R p_depth + 0.001 t`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ColorExtrinsics {
    /// R, row after row.
    pub rotation: [f32; 9],
    /// t in millimetres.
    pub translation_mm: [f32; 3],
}

impl ColorExtrinsics {
    /// Asks an L515.
    ///
    /// # Errors
    /// Those of [`HardwareMonitor::command`] and [`Self::parse`].
    pub fn read(monitor: &mut dyn HardwareMonitor) -> Result<Self> {
        Self::parse(&monitor.command(&Request::l515_color_extrinsics())?)
    }

    /// Reads the data of a reply.
    ///
    /// # Errors
    /// [`ErrorKind::Protocol`] when it has less than 48 bytes.
    pub fn parse(data: &[u8]) -> Result<Self> {
        let all = || Some(Self { rotation: f32s_at(data, 0)?, translation_mm: f32s_at(data, 36)? });
        all().ok_or_else(|| {
            protocol_error(format!("the pose of the L515's colour sensor has {} bytes, not 48", data.len()))
        })
    }

    /// The data of a reply, for an emulated camera.
    pub fn build(&self) -> Vec<u8> {
        let mut data = vec![0; 48];
        put_f32s(&mut data, 0, &self.rotation);
        put_f32s(&mut data, 36, &self.translation_mm);
        data
    }

    /// The pose of the colour sensor in the depth frame, the inverse of what the camera says.
    ///
    /// # Errors
    /// [`ErrorKind::Protocol`] unless R is a rotation and t a distance within a camera.
    pub fn color_in_depth(&self) -> Result<Pose> {
        let back = rotation(self.rotation)?.transpose();
        let t = DVec3::from_array(self.translation_mm.map(f64::from)) * 0.001;
        rigid(back, -(back * t))
    }
}

/// Temperatures in °C.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Temperatures {
    /// Of the laser's driver.
    pub laser_c: f64,
    /// Of the processor.
    pub processor_c: f64,
    /// Of the mirror's electronics.
    pub mirror_c: f64,
    /// Of the receiver.
    pub receiver_c: f64,
    /// By the sensor of humidity.
    pub humidity_c: f64,
}

impl Temperatures {
    /// Asks an L515.
    ///
    /// # Errors
    /// Those of [`HardwareMonitor::command`]; [`ErrorKind::Protocol`] when the reply is too short.
    pub fn read(monitor: &mut dyn HardwareMonitor) -> Result<Self> {
        let data = monitor.command(&Request::l515_temperatures())?;
        Self::parse(&data).ok_or_else(|| {
            protocol_error(format!(
                "the L515's temperatures have {} bytes; at least 40 are needed",
                data.len()
            ))
        })
    }

    /// Reads the data of a reply.
    pub fn parse(data: &[u8]) -> Option<Self> {
        Some(Self {
            laser_c: f64_at(data, 0)?,
            processor_c: f64_at(data, 8)?,
            mirror_c: f64_at(data, 16)?,
            receiver_c: f64_at(data, 24)?,
            humidity_c: f64_at(data, 32)?,
        })
    }
}

/// A control of depth, by number (`l500_control`).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[repr(u32)]
pub enum Control {
    /// Confidence below which depth is invalid.
    ConfidenceThreshold = 0,
    /// Sharpening after the computation of depth.
    PostSharpness = 1,
    /// Sharpening before it.
    PreSharpness = 2,
    /// Filter of noise.
    NoiseFilter = 3,
    /// Gain of the receiver.
    ReceiverGain = 4,
    /// Power of the laser, percent.
    LaserPower = 5,
    /// Least distance, millimetres.
    MinimumDistance = 6,
    /// Whether pixels of no confidence are kept.
    InvalidationBypass = 7,
    /// Which infrared image.
    AlternateIr = 8,
}

/// The range of a control.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Range {
    /// Least value.
    pub least: i32,
    /// Greatest value.
    pub greatest: i32,
    /// Step between values.
    pub step: i32,
}

impl Control {
    /// Every control.
    pub const ALL: [Self; 9] = [
        Self::ConfidenceThreshold,
        Self::PostSharpness,
        Self::PreSharpness,
        Self::NoiseFilter,
        Self::ReceiverGain,
        Self::LaserPower,
        Self::MinimumDistance,
        Self::InvalidationBypass,
        Self::AlternateIr,
    ];

    /// The name in rig files.
    pub const fn name(self) -> &'static str {
        match self {
            Self::ConfidenceThreshold => "confidence_threshold",
            Self::PostSharpness => "post_processing_sharpness",
            Self::PreSharpness => "pre_processing_sharpness",
            Self::NoiseFilter => "noise_filtering",
            Self::ReceiverGain => "receiver_gain",
            Self::LaserPower => "laser_power",
            Self::MinimumDistance => "min_distance_mm",
            Self::InvalidationBypass => "invalidation_bypass",
            Self::AlternateIr => "alternate_ir",
        }
    }

    /// The control of a name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|c| c.name() == name)
    }

    fn ask(self, monitor: &mut dyn HardwareMonitor, what: u32) -> Result<i32> {
        let data = monitor.command(&Request::l515_control(self as u32, what, 0))?;
        i32_at(&data, 0).ok_or_else(|| {
            protocol_error(format!("control {} came with {} bytes instead of 4", self.name(), data.len()))
        })
    }

    /// Its value.
    ///
    /// # Errors
    /// Those of [`HardwareMonitor::command`]; [`ErrorKind::Protocol`] when the reply is too short.
    pub fn get(self, monitor: &mut dyn HardwareMonitor) -> Result<i32> {
        self.ask(monitor, 0)
    }

    /// Its range.
    ///
    /// # Errors
    /// As [`Self::get`].
    pub fn range(self, monitor: &mut dyn HardwareMonitor) -> Result<Range> {
        Ok(Range {
            least: self.ask(monitor, 1)?,
            greatest: self.ask(monitor, 2)?,
            step: self.ask(monitor, 3)?,
        })
    }

    /// Sets it, and gives what the camera says that it is then.
    ///
    /// # Errors
    /// As [`Self::get`]; [`ErrorKind::BadInput`] for a value that it does not allow.
    pub fn set(self, monitor: &mut dyn HardwareMonitor, value: i32) -> Result<i32> {
        let Range { least, greatest, step } = self.range(monitor)?;
        if value < least || value > greatest {
            let text =
                format!("{} = {value}: the camera allows {least} to {greatest}, step {step}", self.name());
            return Err(Error::new(ErrorKind::BadInput, text));
        }
        monitor.command(&Request::set_l515_control(self as u32, value, 0))?;
        self.get(monitor)
    }
}

/// The meaning of a code of the error report; `None` for 0, no error (`l500_fw_error_report`).
pub fn error_report(code: u8) -> Option<String> {
    let text = match code {
        0 => return None,
        1 => "a failure keeps it from sending depth; restart the camera",
        2 => "overflow of infrared: too much for this port or hub",
        3 => "overflow of depth: too much for this port or hub",
        4 => "overflow of confidence: too much for this port or hub",
        5 => "its receiver is saturated by light and depth pauses for a second",
        6 => "depth stopped for some seconds",
        7 => "it is near its greatest temperature; see to ventilation",
        8 => "it is too hot",
        9 => "an update of the firmware failed",
        12 => "it noticed a fall and stopped its laser; start it again",
        14..=17 => "its laser or mirror failed; restart the camera, and if it stays the camera is broken",
        other => return Some(format!("error {other}, which is not known")),
    };
    Some(format!("{text} (code {code})"))
}

#[cfg(test)]
mod tests;
