//! What a camera that another process serves is and can: written by the process, checked by both sides.

use super::{
    ExternalClock, ExternalMode, ExternalModeFlags, ExternalOffer, MAX_FRAME_BYTES, MAX_MODES, MAX_STREAMS,
    text,
};
use crate::{Distortion, Error, ErrorKind, Intrinsics, Name, PixelFormat, Pose, Result, StreamName};

/// The longest side of a picture, pixels.
const MAX_SIDE: u32 = 16_384;
/// The farthest that a stream may be from the origin of its camera, metres.
const MAX_OFFSET_M: f64 = 100.0;

/// What a process says of its camera. Texts longer than 31 bytes are cut.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct About {
    /// Model, such as `OAK-D Pro`.
    pub model: String,
    /// Serial number.
    pub serial: String,
    /// Firmware version; empty when there is none.
    pub firmware: String,
    /// Where it is attached; empty when nobody knows.
    pub port: String,
    /// Where its calibration comes from: `factory`, `none`, …
    pub calibration: String,
    /// The program that serves it.
    pub program: String,
}

impl About {
    pub(super) fn encode(&self, offer: &mut ExternalOffer) {
        text::set(&mut offer.model, &self.model);
        text::set(&mut offer.serial, &self.serial);
        text::set(&mut offer.firmware, &self.firmware);
        text::set(&mut offer.port, &self.port);
        text::set(&mut offer.calibration, &self.calibration);
        text::set(&mut offer.program, &self.program);
    }

    pub(super) fn decode(offer: &ExternalOffer) -> Result<Self> {
        let about = Self {
            model: text::get(&offer.model, "model")?.to_owned(),
            serial: text::get(&offer.serial, "serial")?.to_owned(),
            firmware: text::get(&offer.firmware, "firmware")?.to_owned(),
            port: text::get(&offer.port, "port")?.to_owned(),
            calibration: text::get(&offer.calibration, "calibration")?.to_owned(),
            program: text::get(&offer.program, "program")?.to_owned(),
        };
        if about.model.is_empty() {
            return Err(invalid("its field `model` is empty"));
        }
        Ok(about)
    }
}

/// One mode that a stream can run in. [`Self::new`] has what most cameras have; set the rest.
#[derive(Debug, Clone, PartialEq)]
pub struct Mode {
    /// `color`, `depth`, …
    pub stream: StreamName,
    /// Pixel format.
    pub format: PixelFormat,
    /// Pixels per row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Frames per second.
    pub rate_hz: f64,
    /// Metres per unit of `z16` depth; 1 for `depth_f32`, 0 when the pixels are no depth.
    pub depth_unit_m: f64,
    /// Intrinsics at this size; the default when no calibration is known.
    pub intrinsics: Intrinsics,
    /// Pose of the stream's optical frame in the camera's frame.
    pub pose: Pose,
    /// Which clock stamps its frames.
    pub clock: ExternalClock,
    /// Picoseconds per tick of the device's clock.
    pub tick_ps: u64,
    /// Bits of the device's clock before it starts again at 0.
    pub counter_bits: u32,
    /// Bits of the device's frame counter; 0 when it has none.
    pub sequence_bits: u32,
    /// The frames are made by a program and not by a sensor.
    pub simulated: bool,
}

impl Mode {
    /// A mode without calibration, stamped by arrival, of a device without a frame counter; depth in millimetres.
    pub fn new(stream: StreamName, format: PixelFormat, size: (u32, u32), rate_hz: f64) -> Self {
        let depth_unit_m = match format {
            PixelFormat::Z16 => 0.001,
            PixelFormat::DepthF32 => 1.0,
            _ => 0.0,
        };
        Self {
            stream,
            format,
            width: size.0,
            height: size.1,
            rate_hz,
            depth_unit_m,
            intrinsics: Intrinsics::default(),
            pose: Pose::IDENTITY,
            clock: ExternalClock::Arrival,
            tick_ps: 1000,
            counter_bits: 64,
            sequence_bits: 0,
            simulated: false,
        }
    }

    /// The same with frames that the device's own clock stamps at mid-exposure: `counter_bits` bits that count up every
    /// `tick_ps` picoseconds, and a frame counter of `sequence_bits` bits.
    pub fn with_device_clock(mut self, counter_bits: u32, tick_ps: u64, sequence_bits: u32) -> Self {
        self.clock = ExternalClock::Device;
        (self.counter_bits, self.tick_ps, self.sequence_bits) = (counter_bits, tick_ps, sequence_bits);
        self
    }

    /// Bytes of one frame; for MJPEG the most that one may have.
    pub const fn frame_bytes(&self) -> usize {
        self.format.frame_bytes(self.width, self.height)
    }

    /// `depth 640x480 z16`, for messages.
    pub fn describe(&self) -> String {
        format!("{} {}x{} {}", self.stream, self.width, self.height, self.format.name())
    }

    pub(super) fn encode(&self) -> ExternalMode {
        let mut record = ExternalMode {
            rate_hz: self.rate_hz,
            depth_unit_m: self.depth_unit_m,
            intrinsics: self.intrinsics,
            pose: self.pose,
            tick_ps: self.tick_ps,
            format: self.format as u32,
            width: self.width,
            height: self.height,
            clock: self.clock as u32,
            counter_bits: self.counter_bits,
            sequence_bits: self.sequence_bits,
            flags: if self.simulated { ExternalModeFlags::SIMULATED.0 } else { 0 },
            ..ExternalMode::default()
        };
        text::set(&mut record.stream, self.stream.as_str());
        record
    }

    /// The mode of a record that may hold anything.
    ///
    /// # Errors
    /// [`ErrorKind::Other`] naming the stream and the field that cannot be.
    pub fn decode(record: &ExternalMode) -> Result<Self> {
        let stream = Name::new(text::get(&record.stream, "stream")?)?;
        let wrong =
            |field: &str, what: String| invalid(&format!("stream {stream}: its field `{field}` {what}"));
        let format = PixelFormat::from_code(record.format)
            .ok_or_else(|| wrong("format", format!("is {}, which is no pixel format", record.format)))?;
        let clock = ExternalClock::from_code(record.clock)
            .ok_or_else(|| wrong("clock", format!("is {}, which is no clock", record.clock)))?;
        let mode = Self {
            stream: stream.clone(),
            format,
            width: record.width,
            height: record.height,
            rate_hz: record.rate_hz,
            depth_unit_m: record.depth_unit_m,
            intrinsics: record.intrinsics,
            pose: record.pose,
            clock,
            tick_ps: record.tick_ps,
            counter_bits: record.counter_bits,
            sequence_bits: record.sequence_bits,
            simulated: ExternalModeFlags(record.flags).has(ExternalModeFlags::SIMULATED),
        };
        mode.check().map_err(|(field, what)| wrong(field, what))?;
        Ok(mode)
    }

    /// Whether every number can be; else which field cannot, and why.
    fn check(&self) -> Result<(), (&'static str, String)> {
        if self.format.is_motion() {
            let why = "is motion; a camera of another process gives pictures only".to_owned();
            return Err(("format", why));
        }
        for (field, side) in [("width", self.width), ("height", self.height)] {
            if !(1..=MAX_SIDE).contains(&side) {
                return Err((field, format!("is {side}; it must be within 1 and {MAX_SIDE}")));
            }
        }
        let halved = matches!(self.format, PixelFormat::Yuyv | PixelFormat::Uyvy | PixelFormat::Nv12);
        let odd_height = self.format == PixelFormat::Nv12 && !self.height.is_multiple_of(2);
        if odd_height || halved && !self.width.is_multiple_of(2) {
            return Err(("width", format!("or `height` is odd, which {} cannot be", self.format.name())));
        }
        if self.frame_bytes() > MAX_FRAME_BYTES {
            return Err((
                "width",
                format!("and `height` make frames of more than {} MiB", MAX_FRAME_BYTES >> 20),
            ));
        }
        if !(self.rate_hz > 0.0 && self.rate_hz <= 1000.0) {
            return Err(("rate_hz", format!("is {}; it must be above 0, at most 1000", self.rate_hz)));
        }
        self.check_depth()?;
        self.check_lens()?;
        self.check_pose()?;
        self.check_clock()
    }

    fn check_depth(&self) -> Result<(), (&'static str, String)> {
        let unit = self.depth_unit_m;
        let (right, must) = match self.format {
            PixelFormat::Z16 => (unit > 0.0 && unit <= 1.0, "above 0, at most 1, for z16"),
            PixelFormat::DepthF32 => (unit == 1.0, "1 for depth_f32, which is in metres"),
            _ => (unit == 0.0, "0 for pixels that are no depth"),
        };
        if right { Ok(()) } else { Err(("depth_unit_m", format!("is {unit}; it must be {must}"))) }
    }

    fn check_lens(&self) -> Result<(), (&'static str, String)> {
        let lens = &self.intrinsics;
        if *lens == Intrinsics::default() {
            return Ok(());
        }
        let model = Distortion::ALL.into_iter().find(|d| *d as u32 == lens.model);
        if model.is_none_or(|m| m == Distortion::Unknown) {
            let why = format!(
                "is {}, which is no lens model; all of it is zero when no calibration is known",
                lens.model
            );
            return Err(("intrinsics.model", why));
        }
        let far = f64::from(self.width.max(self.height)) * 100.0;
        for (field, value) in [("intrinsics.fx", lens.fx), ("intrinsics.fy", lens.fy)] {
            if !(value > 0.0 && value <= far) {
                return Err((field, format!("is {value}, which is no focal length in pixels")));
            }
        }
        for (field, value) in [("intrinsics.cx", lens.cx), ("intrinsics.cy", lens.cy)] {
            if !(-far..=far).contains(&value) {
                return Err((field, format!("is {value}, which is no principal point in pixels")));
            }
        }
        match lens.coeffs.iter().find(|c| !(-1e6..1e6).contains(*c)) {
            Some(c) => Err(("intrinsics.coeffs", format!("has {c}, which is no distortion coefficient"))),
            None => Ok(()),
        }
    }

    fn check_pose(&self) -> Result<(), (&'static str, String)> {
        if let Some(t) = self.pose.translation_m.iter().find(|t| !(-MAX_OFFSET_M..=MAX_OFFSET_M).contains(*t))
        {
            return Err(("pose.translation_m", format!("has {t}; it must be within ±{MAX_OFFSET_M} m")));
        }
        let norm = self.pose.rotation_xyzw.iter().map(|c| c * c).sum::<f64>().sqrt();
        if (norm - 1.0).abs() <= 1e-3 {
            return Ok(());
        }
        Err(("pose.rotation_xyzw", format!("has the length {norm}; it must be a quaternion of length 1")))
    }

    fn check_clock(&self) -> Result<(), (&'static str, String)> {
        if !(8..=64).contains(&self.counter_bits) {
            return Err(("counter_bits", format!("is {}; it must be within 8 and 64", self.counter_bits)));
        }
        if !(1..=1_000_000_000_000).contains(&self.tick_ps) {
            return Err(("tick_ps", format!("is {}; it must be within 1 ps and 1 s", self.tick_ps)));
        }
        if self.sequence_bits != 0 && !(8..=64).contains(&self.sequence_bits) {
            return Err((
                "sequence_bits",
                format!("is {}; it must be 0, or within 8 and 64", self.sequence_bits),
            ));
        }
        let host = matches!(self.clock, ExternalClock::Host | ExternalClock::Arrival);
        if host && (self.tick_ps, self.counter_bits) != (1000, 64) {
            let why =
                format!("is {}; on the host's clock it is 1000, and `counter_bits` is 64", self.tick_ps);
            return Err(("tick_ps", why));
        }
        Ok(())
    }
}

/// Whether a camera may have these modes.
///
/// # Errors
/// [`ErrorKind::Other`] when there are none, too many, or too many streams among them.
pub(super) fn check_all(modes: &[Mode]) -> Result<()> {
    check_count(modes.len())?;
    let mut streams: Vec<_> = modes.iter().map(|m| &m.stream).collect();
    streams.sort();
    streams.dedup();
    if streams.len() > MAX_STREAMS {
        return Err(invalid(&format!("it has {} streams; {MAX_STREAMS} is the most", streams.len())));
    }
    Ok(())
}

/// Whether a camera may have so many modes.
///
/// # Errors
/// [`ErrorKind::Other`] when it may not.
pub(super) fn check_count(modes: usize) -> Result<()> {
    if (1..=MAX_MODES).contains(&modes) {
        return Ok(());
    }
    Err(invalid(&format!("it has {modes} modes; it must have 1 to {MAX_MODES}")))
}

pub(super) fn invalid(what: &str) -> Error {
    Error::new(ErrorKind::Other, what)
}
