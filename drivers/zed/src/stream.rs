//! A streaming camera: each side-by-side image becomes a frame of each requested stream, and the IMU's samples become
//! batches.

use super::imu::Imu;
use super::mode::Side;
use super::motion::{Motion, Sample};
use core::time::Duration;
use depthrig_bus::HostTime;
use depthrig_driver::unpack::{Half, copy_half};
use depthrig_driver::{Error, ErrorKind, FrameSink, Gate, Poll, RawFrame, Result, Stream, StreamProfile};
use depthrig_usb::video::{Image, ImageSource};
use std::sync::mpsc::{Receiver, TryRecvError};

/// How long images are waited for before the IMU's batch is looked at again.
const SLICE: Duration = Duration::from_millis(20);

/// A requested image, left or right.
struct Port {
    side: Side,
    gate: Gate,
    row_bytes: usize,
    frame_bytes: usize,
}

/// A camera that streams.
pub struct ZedStream {
    profiles: Vec<StreamProfile>,
    ports: Vec<Port>,
    /// None when the IMU alone is delivered.
    images: Option<Box<dyn ImageSource>>,
    /// Bytes from one row of the side-by-side image to the next.
    stride: usize,
    /// Bytes of a complete side-by-side image.
    wire_bytes: usize,
    motion: Option<Motion>,
    imu: Option<Imu>,
    /// The outcome of setting the camera on another thread, until it has been received.
    settled: Option<Receiver<Result<()>>>,
    device: String,
}

impl ZedStream {
    /// Frames of `profiles`, all of one mode, out of `images`, whose rows begin every `stride` bytes. `settled`
    /// delivers the outcome of setting the camera; an error ends the stream.
    pub fn new(
        device: String,
        profiles: Vec<(Side, StreamProfile)>,
        images: Box<dyn ImageSource>,
        stride: usize,
        motion: Option<Motion>,
        settled: Option<Receiver<Result<()>>>,
    ) -> Self {
        let ports: Vec<_> = profiles
            .iter()
            .enumerate()
            .map(|(i, (side, p))| Port {
                side: *side,
                gate: Gate::new(i, p),
                row_bytes: p.format.row_bytes(p.width) as usize,
                frame_bytes: p.frame_bytes(),
            })
            .collect();
        let wire_bytes = profiles.first().map_or(0, |(_, p)| stride * p.height as usize);
        let profiles = profiles.into_iter().map(|(_, p)| p).collect();
        let images = Some(images);
        Self { profiles, ports, images, stride, wire_bytes, motion, imu: None, settled, device }
    }

    /// A camera of which the IMU alone is delivered, with [`Self::with_imu`].
    pub const fn without_images(device: String, motion: Motion) -> Self {
        Self {
            profiles: Vec::new(),
            ports: Vec::new(),
            images: None,
            stride: 0,
            wire_bytes: 0,
            motion: Some(motion),
            imu: None,
            settled: None,
            device,
        }
    }

    /// The same with the IMU's samples, as the last of its streams.
    #[must_use]
    pub fn with_imu(mut self, profile: StreamProfile, samples: Receiver<Sample>) -> Self {
        self.imu = Some(Imu::new(self.profiles.len(), &profile, samples));
        self.profiles.push(profile);
        self
    }

    /// The IMU, while it is read.
    pub const fn motion(&self) -> Option<&Motion> {
        self.motion.as_ref()
    }
}

impl Stream for ZedStream {
    fn profiles(&self) -> &[StreamProfile] {
        &self.profiles
    }

    fn poll(&mut self, timeout: Duration, sink: &mut dyn FrameSink) -> Result<Poll> {
        match self.settled.as_ref().map(Receiver::try_recv) {
            Some(Ok(outcome)) => {
                self.settled = None;
                outcome?;
            }
            Some(Err(TryRecvError::Disconnected)) => self.settled = None,
            Some(Err(TryRecvError::Empty)) | None => {}
        }
        let deadline = HostTime::now().plus(timeout);
        loop {
            let left = deadline.from_now();
            let came = match &self.images {
                Some(_) => self.poll_images(if self.imu.is_some() { left.min(SLICE) } else { left }, sink)?,
                None => self.poll_unit(left.min(SLICE), sink)?,
            };
            let unit = self.motion.as_ref();
            let went = self.imu.as_mut().is_some_and(|imu| imu.drain(unit, sink));
            if came || went {
                return Ok(Poll::Frame);
            }
            if left.is_zero() {
                return Ok(Poll::Idle);
            }
        }
    }
}

impl ZedStream {
    /// Waits for an image. Whether one came.
    fn poll_images(&mut self, timeout: Duration, sink: &mut dyn FrameSink) -> Result<bool> {
        let Self { ports, images, stride, wire_bytes, motion, device, .. } = self;
        let Some(images) = images else { return Ok(false) };
        let image_sensors_c = motion.as_ref().map_or([None; 2], Motion::image_sensors_c);
        let came = images.poll(timeout, &mut |image| {
            for port in ports.iter_mut() {
                port.deliver(image, *stride, *wire_bytes, image_sensors_c, sink);
            }
        });
        came.map_err(|e| Error::new(e.kind(), format!("{device}: {e}")).with_source(e))
    }

    /// Waits for the IMU, which is all there is: without it the camera is gone. Whether a batch went.
    fn poll_unit(&mut self, timeout: Duration, sink: &mut dyn FrameSink) -> Result<bool> {
        if let Some(why) = self.motion.as_ref().and_then(Motion::problem) {
            let what = format!("{}: its IMU is no longer read: {why}", self.device);
            return Err(Error::new(ErrorKind::Disconnected, what));
        }
        Ok(self.imu.as_mut().is_some_and(|imu| imu.wait(timeout, sink)))
    }
}

impl Port {
    fn deliver(
        &mut self,
        image: &Image<'_>,
        stride: usize,
        wire_bytes: usize,
        image_sensors_c: [Option<f64>; 2],
        sink: &mut dyn FrameSink,
    ) {
        let time = image.kernel_time.unwrap_or(image.arrival);
        let bytes = own_bytes(image.bytes.len(), wire_bytes, self.frame_bytes);
        let mut raw = RawFrame::new(image.sequence, time.ns() as u64, image.arrival, bytes);
        raw.damaged = image.damaged;
        let (half, temperature) = match self.side {
            Side::Left => (Half::Left, image_sensors_c[0]),
            Side::Right => (Half::Right, image_sensors_c[1]),
        };
        raw.temperature_c = temperature.map_or(f32::NAN, |t| t as f32);
        let row_bytes = self.row_bytes;
        self.gate.deliver(&raw, sink, |memory| copy_half(image.bytes, stride, row_bytes, half, memory));
    }
}

/// The bytes of one half when `came` of the side-by-side image arrived: all if it is complete, more if it is too long.
const fn own_bytes(came: usize, wire_bytes: usize, frame_bytes: usize) -> usize {
    if came == wire_bytes {
        frame_bytes
    } else if came > wire_bytes {
        frame_bytes + (came - wire_bytes)
    } else if came == 0 {
        0
    } else {
        // Half of what came, and never as many as a complete image has.
        let half = came / 2;
        if half == 0 {
            1
        } else if half >= frame_bytes {
            frame_bytes - 1
        } else {
            half
        }
    }
}

#[cfg(test)]
mod tests;
