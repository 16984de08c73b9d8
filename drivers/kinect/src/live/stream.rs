//! A streaming Kinect: each image of a capture through its stream's gate, written once, and the IMU's samples in
//! batches.

use super::counter::FrameCounter;
use super::ffi::image_format;
use super::handle::{Handle, Image};
use crate::modes::WiredSync;
use crate::motion::{Measured, Unit};
use core::time::Duration;
use depthrig_bus::{DropReason, FrameFlags, HostTime, PixelFormat};
use depthrig_driver::{
    Error, ErrorKind, FrameSink, Gate, Poll, RawFrame, Result, Stream, StreamProfile, unpack,
};

/// Limit of captures per poll: as many as libk4a may have kept for a late reader.
const AT_ONCE: usize = 8;
/// How long images are waited for before the IMU is looked at again.
const SLICE: Duration = Duration::from_millis(20);
/// A host timestamp older than this is invalid.
const OLDEST: Duration = Duration::from_secs(5);

/// A camera that streams.
pub(super) struct LiveStream {
    name: String,
    profiles: Vec<StreamProfile>,
    streams: Vec<StreamState>,
    camera: Handle,
    imu: Option<Imu>,
    /// It no longer sends anything.
    is_gone: bool,
}

/// The IMU, and room for what one look at it finds.
struct Imu {
    unit: Unit,
    found: Vec<Measured>,
    /// It reported its end, which the cameras may not have.
    is_over: bool,
}

/// Limit of samples per poll, more than libk4a keeps (half a second of them).
const MOST_SAMPLES: usize = 1024;

/// One stream.
struct StreamState {
    kind: Kind,
    gate: Gate,
    counter: FrameCounter,
    unpack: Unpack,
    width: u32,
    height: u32,
    /// When its last frame arrived.
    last: HostTime,
    flags: FrameFlags,
}

/// Which image of a capture.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    Color,
    Depth,
    Ir,
}

/// How an image gets into lent memory.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Unpack {
    /// Rows that may be padded, in this format of libk4a's.
    Rows { wire: u32, row: usize, rows: usize },
    /// Blue, green, red and an unused byte, of which three are delivered.
    WithoutAlpha { row: usize, rows: usize },
    /// A JPEG image as it came.
    Keep,
    /// A JPEG image, decoded.
    Decode { whole: usize },
}

impl LiveStream {
    /// Frames of `profiles` out of `camera`, which was started in their modes.
    pub(super) fn new(name: String, camera: Handle, profiles: Vec<StreamProfile>, sync: WiredSync) -> Self {
        let of = |motion: bool| {
            let all = profiles.iter().enumerate();
            all.filter(move |(_, p)| p.format.is_motion() == motion)
        };
        let streams = of(false).map(|(i, p)| StreamState::new(i, p, sync)).collect();
        let imu = of(true).next().map(|(i, p)| Imu {
            unit: Unit::new(i, p, 1.0),
            found: Vec::with_capacity(MOST_SAMPLES),
            is_over: false,
        });
        Self { name, profiles, streams, camera, imu, is_gone: false }
    }

    /// Hands on the IMU samples that have come. Whether a batch went.
    fn poll_imu(&mut self, sink: &mut dyn FrameSink) -> bool {
        let Some(imu) = &mut self.imu else { return false };
        imu.found.clear();
        while !imu.is_over && imu.found.len() < MOST_SAMPLES {
            match self.camera.imu_sample() {
                Ok(Some(sample)) => imu.found.push(sample),
                Ok(None) => break,
                Err(e) => {
                    imu.is_over = true;
                    tracing::warn!(camera = %self.name, error = %e, "no more IMU samples; images go on");
                }
            }
        }
        imu.unit.take(&imu.found, HostTime::now(), |us| us, sink)
    }

    fn gone(&self, why: &Error) -> Error {
        Error::new(ErrorKind::Disconnected, format!("{}: {why}", self.name))
    }
}

impl Drop for LiveStream {
    fn drop(&mut self) {
        if self.imu.is_some() {
            self.camera.stop_imu();
        }
        // Every image was given back, for which libk4a would wait. Closing comes after it, with the handle.
        self.camera.stop();
    }
}

impl Stream for LiveStream {
    fn profiles(&self) -> &[StreamProfile] {
        &self.profiles
    }

    fn poll(&mut self, timeout: Duration, sink: &mut dyn FrameSink) -> Result<Poll> {
        if self.is_gone {
            return Err(self.gone(&Error::new(ErrorKind::Disconnected, "it is gone")));
        }
        // Samples that wait for an image are mapped by the newest alone; they are read at least this often.
        let slice = if self.imu.is_some() { timeout.min(SLICE) } else { timeout };
        let deadline = HostTime::now().plus(timeout);
        loop {
            let any = self.poll_captures(slice.min(deadline.from_now()), sink)?;
            if self.poll_imu(sink) || any {
                return Ok(Poll::Frame);
            }
            if deadline.from_now().is_zero() {
                return Ok(Poll::Idle);
            }
        }
    }
}

impl LiveStream {
    /// Waits for a capture, and hands on what else has come. Whether there was an image.
    fn poll_captures(&mut self, timeout: Duration, sink: &mut dyn FrameSink) -> Result<bool> {
        let mut timeout = timeout;
        let mut any = false;
        for _ in 0..AT_ONCE {
            match self.camera.capture(timeout) {
                Ok(Some(capture)) => {
                    let temperature_c = capture.temperature_c();
                    for stream in &mut self.streams {
                        let image = match stream.kind {
                            Kind::Color => capture.color(),
                            Kind::Depth => capture.depth(),
                            Kind::Ir => capture.ir(),
                        };
                        if let Some(image) = image {
                            any = true;
                            stream.deliver(&image, temperature_c, sink);
                        }
                    }
                }
                Ok(None) => break,
                Err(e) => {
                    self.is_gone = true;
                    return Err(self.gone(&e));
                }
            }
            timeout = Duration::ZERO;
        }
        Ok(any)
    }
}

impl StreamState {
    fn new(index: usize, profile: &StreamProfile, sync: WiredSync) -> Self {
        let kind = match profile.stream.as_str() {
            "depth" => Kind::Depth,
            "ir" => Kind::Ir,
            _ => Kind::Color,
        };
        // The master's pulse is what a subordinate takes its images by.
        let is_triggered = sync == WiredSync::Subordinate;
        Self {
            kind,
            gate: Gate::new(index, profile),
            counter: FrameCounter::new(profile.period_ns() / 1000),
            unpack: Unpack::of(profile),
            width: profile.width,
            height: profile.height,
            last: HostTime::from_ns(i64::MIN),
            flags: if is_triggered { FrameFlags::HARDWARE_TRIGGERED } else { FrameFlags(0) },
        }
    }

    fn deliver(&mut self, image: &Image<'_>, temperature_c: f32, sink: &mut dyn FrameSink) {
        let device_us = image.device_us();
        let bytes = image.bytes();
        let arrival = arrival(image.system_ns(), HostTime::now()).max(self.last);
        self.last = arrival;
        let (pixels, arrived) = if image.size() == (self.width, self.height) {
            self.unpack.measure(bytes.unwrap_or_default(), image.stride())
        } else {
            // An image of another mode.
            (&[][..], self.unpack.frame_bytes(self.width, self.height) + 1)
        };
        let number = self.counter.number_exposed(device_us, image.exposure_us());
        let mut raw = RawFrame::new(number, device_us, arrival, arrived);
        raw.damaged = bytes.is_none() || image.format() != self.unpack.wire();
        raw.exposure_ns = image.exposure_us().saturating_mul(1000);
        raw.temperature_c = temperature_c;
        raw.flags = self.flags;
        let unpack = self.unpack;
        let stride = image.stride();
        let width = self.width;
        let height = self.height;
        self.gate.deliver(&raw, sink, |to| unpack.fill(pixels, stride, width, height, to));
    }
}

/// When an image had arrived: as libk4a stamped it (`CLOCK_MONOTONIC`, before the depth engine works on it), else now.
fn arrival(system_ns: u64, now: HostTime) -> HostTime {
    let stamp = HostTime::from_ns(i64::try_from(system_ns).unwrap_or(0));
    let age_ns = now.since_ns(stamp);
    let is_usable = system_ns != 0 && (0..OLDEST.as_nanos() as i64).contains(&age_ns);
    if is_usable { stamp } else { now }
}

impl Unpack {
    fn of(profile: &StreamProfile) -> Self {
        let row = profile.format.row_bytes(profile.width) as usize;
        let rows = profile.height as usize;
        match profile.format {
            PixelFormat::Mjpeg => Self::Keep,
            PixelFormat::Rgb8 => Self::Decode { whole: profile.frame_bytes() },
            PixelFormat::Bgr8 => Self::WithoutAlpha { row, rows },
            // Chroma follows luminance in rows of the same length, half as many.
            PixelFormat::Nv12 => Self::Rows { wire: image_format::NV12, row, rows: rows + rows / 2 },
            PixelFormat::Z16 => Self::Rows { wire: image_format::DEPTH16, row, rows },
            PixelFormat::Mono16 => Self::Rows { wire: image_format::IR16, row, rows },
            _ => Self::Rows { wire: image_format::YUY2, row, rows },
        }
    }

    /// The format that libk4a must say the image has.
    const fn wire(self) -> u32 {
        match self {
            Self::Rows { wire, .. } => wire,
            Self::WithoutAlpha { .. } => image_format::BGRA32,
            Self::Keep | Self::Decode { .. } => image_format::MJPG,
        }
    }

    /// Bytes of a complete frame as it is delivered; of kept JPEG the most that fits.
    const fn frame_bytes(self, width: u32, height: u32) -> usize {
        match self {
            Self::Rows { row, rows, .. } | Self::WithoutAlpha { row, rows } => row * rows,
            Self::Keep => PixelFormat::Mjpeg.frame_bytes(width, height),
            Self::Decode { whole } => whole,
        }
    }

    /// The bytes that are the image, and how many bytes of a delivered frame they stand for: less than a frame
    /// has when some are missing, more when there are too many.
    fn measure(self, bytes: &[u8], stride: usize) -> (&[u8], usize) {
        match self {
            Self::Rows { row, rows, .. } => (bytes, scaled(bytes.len(), stride.max(row), row, rows, row)),
            Self::WithoutAlpha { row, rows } => {
                let wire_row = row / 3 * 4;
                (bytes, scaled(bytes.len(), stride.max(wire_row), wire_row, rows, row))
            }
            Self::Keep | Self::Decode { .. } => match (unpack::jpeg_span(bytes), self) {
                (Ok(image), Self::Decode { whole }) => (image, whole),
                (Ok(image), _) => (image, image.len()),
                (Err(DropReason::Incomplete), _) => (&[], 0),
                // Not a JPEG at all.
                (Err(_), _) => (&[], usize::MAX),
            },
        }
    }

    fn fill(
        self,
        image: &[u8],
        stride: usize,
        width: u32,
        height: u32,
        to: &mut [u8],
    ) -> Result<(), DropReason> {
        match self {
            Self::Rows { row, .. } => unpack::copy_rows(image, stride.max(row), row, to),
            Self::WithoutAlpha { row, .. } => unpack::drop_alpha(image, stride.max(row / 3 * 4), row / 3, to),
            Self::Keep => unpack::keep_jpeg(image, to),
            Self::Decode { .. } => unpack::decode_jpeg(image, width, height, to),
        }
    }
}

/// The bytes of a delivered frame of `rows` rows of `row` bytes that `came` bytes stand for, when rows of `wire_row`
/// bytes begin every `stride`. The last row may lack its padding.
const fn scaled(came: usize, stride: usize, wire_row: usize, rows: usize, row: usize) -> usize {
    let whole = row * rows;
    let needed = stride * rows.saturating_sub(1) + wire_row;
    if came > stride * rows {
        whole + (came - stride * rows)
    } else if came >= needed {
        whole
    } else if came == 0 {
        0
    } else {
        // Never as many as a complete frame has, and at least one.
        let part = (came as u64 * whole as u64 / needed as u64) as usize;
        if part == 0 {
            1
        } else if part >= whole {
            whole - 1
        } else {
            part
        }
    }
}

#[cfg(test)]
mod tests;
