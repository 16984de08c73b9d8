//! A streaming Kinect: each picture of a capture through its stream's gate, written once, and the motion unit's samples in
//! batches.

use super::counter::FrameCounter;
use super::ffi::image_format;
use super::handle::{Handle, Image};
use crate::kinect::modes::WiredSync;
use crate::kinect::motion::{Measured, Unit};
use crate::{Error, ErrorKind, FrameSink, Gate, Poll, RawFrame, Result, Stream, StreamProfile, unpack};
use core::time::Duration;
use depthrig_bus::{DropReason, FrameFlags, HostTime, PixelFormat};

/// So many captures are handed on by one poll: what libk4a may have kept for a reader that was late.
const AT_ONCE: usize = 8;
/// How long pictures are waited for before the motion unit is looked at again.
const SLICE: Duration = Duration::from_millis(20);
/// A stamp of the host that is older than this is none.
const OLDEST: Duration = Duration::from_secs(5);

/// A camera that streams.
pub(super) struct LiveStream {
    name: String,
    profiles: Vec<StreamProfile>,
    lanes: Vec<Lane>,
    camera: Handle,
    imu: Option<Imu>,
    /// It sends nothing any more.
    is_gone: bool,
}

/// The motion unit, and room for what one look at it finds.
struct Imu {
    unit: Unit,
    found: Vec<Measured>,
    /// It says that nothing more will come, which the cameras may not know.
    is_over: bool,
}

/// Samples that one look takes at the most, more than libk4a keeps (half a second of them).
const MOST_SAMPLES: usize = 1024;

/// One stream.
struct Lane {
    kind: Kind,
    gate: Gate,
    counter: FrameCounter,
    unpack: Unpack,
    size: (u32, u32),
    /// When its last frame arrived.
    last: HostTime,
    flags: FrameFlags,
}

/// Which picture of a capture.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    Color,
    Depth,
    Ir,
}

/// How a picture gets into lent memory.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Unpack {
    /// Rows that may be padded, in this format of libk4a's.
    Rows { wire: u32, row: usize, rows: usize },
    /// Blue, green, red and an unused byte, of which three are delivered.
    WithoutAlpha { row: usize, rows: usize },
    /// A JPEG picture as it came.
    Keep,
    /// A JPEG picture, decoded.
    Decode { whole: usize },
}

impl LiveStream {
    /// Frames of `profiles` out of `camera`, which was started in their modes.
    pub(super) fn new(name: String, camera: Handle, profiles: Vec<StreamProfile>, sync: WiredSync) -> Self {
        let of = |motion: bool| {
            let all = profiles.iter().enumerate();
            all.filter(move |(_, p)| p.format.is_motion() == motion)
        };
        let lanes = of(false).map(|(i, p)| Lane::new(i, p, sync)).collect();
        let imu = of(true).next().map(|(i, p)| Imu {
            unit: Unit::new(i, p, 1.0),
            found: Vec::with_capacity(MOST_SAMPLES),
            is_over: false,
        });
        Self { name, profiles, lanes, camera, imu, is_gone: false }
    }

    /// Hands on the samples of motion that have come. Whether a batch went.
    fn poll_imu(&mut self, sink: &mut dyn FrameSink) -> bool {
        let Some(imu) = &mut self.imu else { return false };
        imu.found.clear();
        while !imu.is_over && imu.found.len() < MOST_SAMPLES {
            match self.camera.imu_sample() {
                Ok(Some(sample)) => imu.found.push(sample),
                Ok(None) => break,
                Err(e) => {
                    imu.is_over = true;
                    tracing::warn!(camera = %self.name, error = %e, "no more samples of motion; pictures go on");
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
        // Every picture was given back, for which libk4a would wait. Closing comes after it, with the handle.
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
        // Samples that wait for a picture are mapped by the newest alone; they are read at least this often.
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
    /// Waits for a capture, and hands on what else has come. Whether there was a picture.
    fn poll_captures(&mut self, timeout: Duration, sink: &mut dyn FrameSink) -> Result<bool> {
        let (mut patience, mut any) = (timeout, false);
        for _ in 0..AT_ONCE {
            match self.camera.capture(patience) {
                Ok(Some(capture)) => {
                    let temperature_c = capture.temperature_c();
                    for lane in &mut self.lanes {
                        let image = match lane.kind {
                            Kind::Color => capture.color(),
                            Kind::Depth => capture.depth(),
                            Kind::Ir => capture.ir(),
                        };
                        if let Some(image) = image {
                            any = true;
                            lane.deliver(&image, temperature_c, sink);
                        }
                    }
                }
                Ok(None) => break,
                Err(e) => {
                    self.is_gone = true;
                    return Err(self.gone(&e));
                }
            }
            patience = Duration::ZERO;
        }
        Ok(any)
    }
}

impl Lane {
    fn new(index: usize, profile: &StreamProfile, sync: WiredSync) -> Self {
        let kind = match profile.stream.as_str() {
            "depth" => Kind::Depth,
            "ir" => Kind::Ir,
            _ => Kind::Color,
        };
        // The master's pulse is what a subordinate takes its pictures by.
        let is_triggered = sync == WiredSync::Subordinate;
        Self {
            kind,
            gate: Gate::new(index, profile),
            counter: FrameCounter::new(profile.period_ns() / 1000),
            unpack: Unpack::of(profile),
            size: (profile.width, profile.height),
            last: HostTime::from_ns(i64::MIN),
            flags: if is_triggered { FrameFlags::HARDWARE_TRIGGERED } else { FrameFlags(0) },
        }
    }

    fn deliver(&mut self, image: &Image<'_>, temperature_c: f32, sink: &mut dyn FrameSink) {
        let device_us = image.device_us();
        let bytes = image.bytes();
        let arrival = arrival(image.system_ns(), HostTime::now()).max(self.last);
        self.last = arrival;
        let (picture, arrived) = if image.size() == self.size {
            self.unpack.measure(bytes.unwrap_or_default(), image.stride())
        } else {
            // A picture of another mode.
            (&[][..], self.unpack.whole(self.size) + 1)
        };
        let number = self.counter.number_exposed(device_us, image.exposure_us());
        let mut raw = RawFrame::new(number, device_us, arrival, arrived);
        raw.damaged = bytes.is_none() || image.format() != self.unpack.wire();
        raw.exposure_ns = image.exposure_us().saturating_mul(1000);
        raw.temperature_c = temperature_c;
        raw.flags = self.flags;
        let (unpack, stride, size) = (self.unpack, image.stride(), self.size);
        self.gate.deliver(&raw, sink, |to| unpack.fill(picture, stride, size, to));
    }
}

/// When a picture had arrived: as libk4a stamped it (`CLOCK_MONOTONIC`, before the depth engine works on it), else now.
fn arrival(system_ns: u64, now: HostTime) -> HostTime {
    let stamp = HostTime::from_ns(i64::try_from(system_ns).unwrap_or(0));
    let age_ns = now.since_ns(stamp);
    let is_usable = system_ns != 0 && (0..OLDEST.as_nanos() as i64).contains(&age_ns);
    if is_usable { stamp } else { now }
}

impl Unpack {
    fn of(profile: &StreamProfile) -> Self {
        let (row, rows) = (profile.format.row_bytes(profile.width) as usize, profile.height as usize);
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

    /// The format that libk4a must say the picture has.
    const fn wire(self) -> u32 {
        match self {
            Self::Rows { wire, .. } => wire,
            Self::WithoutAlpha { .. } => image_format::BGRA32,
            Self::Keep | Self::Decode { .. } => image_format::MJPG,
        }
    }

    /// Bytes of a whole frame as it is delivered; of kept JPEG the most there is room for.
    const fn whole(self, size: (u32, u32)) -> usize {
        match self {
            Self::Rows { row, rows, .. } | Self::WithoutAlpha { row, rows } => row * rows,
            Self::Keep => PixelFormat::Mjpeg.frame_bytes(size.0, size.1),
            Self::Decode { whole } => whole,
        }
    }

    /// What of the bytes is the picture, and how many bytes of a delivered frame that stands for: less than a frame
    /// has when some are missing, more when there are too many.
    fn measure(self, bytes: &[u8], stride: usize) -> (&[u8], usize) {
        match self {
            Self::Rows { row, rows, .. } => (bytes, scaled(bytes.len(), stride.max(row), row, rows, row)),
            Self::WithoutAlpha { row, rows } => {
                let wire_row = row / 3 * 4;
                (bytes, scaled(bytes.len(), stride.max(wire_row), wire_row, rows, row))
            }
            Self::Keep | Self::Decode { .. } => match (unpack::jpeg_span(bytes), self) {
                (Ok(picture), Self::Decode { whole }) => (picture, whole),
                (Ok(picture), _) => (picture, picture.len()),
                (Err(DropReason::Incomplete), _) => (&[], 0),
                // It is no JPEG at all.
                (Err(_), _) => (&[], usize::MAX),
            },
        }
    }

    fn fill(self, picture: &[u8], stride: usize, size: (u32, u32), to: &mut [u8]) -> Result<(), DropReason> {
        match self {
            Self::Rows { row, .. } => unpack::copy_rows(picture, stride.max(row), row, to),
            Self::WithoutAlpha { row, .. } => {
                unpack::drop_alpha(picture, stride.max(row / 3 * 4), row / 3, to)
            }
            Self::Keep => unpack::keep_jpeg(picture, to),
            Self::Decode { .. } => unpack::decode_jpeg(picture, size.0, size.1, to),
        }
    }
}

/// The bytes of a delivered frame of `rows` rows of `row` bytes that `came` bytes stand for, when rows of `wire_row` bytes
/// begin every `stride`. The last row may lack its padding.
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
        // Never as many as a whole frame has, nor none.
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
