//! A streaming camera: each picture of both eyes becomes a frame of each stream that was asked for, and the motion unit's
//! samples, where they are, batches.

use super::imu::Imu;
use super::mode::Eye;
use super::motion::{Motion, Sample};
use crate::unpack::{Half, copy_half};
use crate::video::{Picture, PictureSource};
use crate::{Error, ErrorKind, FrameSink, Gate, Poll, RawFrame, Result, Stream, StreamProfile};
use core::time::Duration;
use depthrig_bus::HostTime;
use std::sync::mpsc::{Receiver, TryRecvError};

/// How long pictures are waited for before the motion unit's batch is looked at again.
const SLICE: Duration = Duration::from_millis(20);

/// One eye that was asked for.
struct Port {
    eye: Eye,
    gate: Gate,
    row_bytes: usize,
    frame_bytes: usize,
}

/// A camera that streams.
pub struct ZedStream {
    profiles: Vec<StreamProfile>,
    ports: Vec<Port>,
    /// None when the motion unit alone is delivered.
    pictures: Option<Box<dyn PictureSource>>,
    /// Bytes from one row of both eyes to the next.
    stride: usize,
    /// Bytes of a whole picture of both eyes.
    wire_bytes: usize,
    motion: Option<Motion>,
    imu: Option<Imu>,
    /// How setting the camera on another thread came out, when it has.
    settled: Option<Receiver<Result<()>>>,
    device: String,
}

impl ZedStream {
    /// Frames of `profiles`, all of one mode, out of `pictures`, whose rows begin every `stride` bytes. `settled`
    /// tells how setting the camera came out; an error ends the stream.
    pub fn new(
        device: String,
        profiles: Vec<(Eye, StreamProfile)>,
        pictures: Box<dyn PictureSource>,
        stride: usize,
        motion: Option<Motion>,
        settled: Option<Receiver<Result<()>>>,
    ) -> Self {
        let ports: Vec<_> = profiles
            .iter()
            .enumerate()
            .map(|(i, (eye, p))| Port {
                eye: *eye,
                gate: Gate::new(i, p),
                row_bytes: p.format.row_bytes(p.width) as usize,
                frame_bytes: p.frame_bytes(),
            })
            .collect();
        let wire_bytes = profiles.first().map_or(0, |(_, p)| stride * p.height as usize);
        let profiles = profiles.into_iter().map(|(_, p)| p).collect();
        let pictures = Some(pictures);
        Self { profiles, ports, pictures, stride, wire_bytes, motion, imu: None, settled, device }
    }

    /// A camera of which the motion unit alone is delivered, with [`Self::with_imu`].
    pub const fn without_pictures(device: String, motion: Motion) -> Self {
        Self {
            profiles: Vec::new(),
            ports: Vec::new(),
            pictures: None,
            stride: 0,
            wire_bytes: 0,
            motion: Some(motion),
            imu: None,
            settled: None,
            device,
        }
    }

    /// The same with the motion unit's samples, as the last of its streams.
    #[must_use]
    pub fn with_imu(mut self, profile: StreamProfile, samples: Receiver<Sample>) -> Self {
        self.imu = Some(Imu::new(self.profiles.len(), &profile, samples));
        self.profiles.push(profile);
        self
    }

    /// The motion unit, while it is read.
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
            let came = match &self.pictures {
                Some(_) => {
                    self.poll_pictures(if self.imu.is_some() { left.min(SLICE) } else { left }, sink)?
                }
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
    /// Waits for a picture. Whether one came.
    fn poll_pictures(&mut self, patience: Duration, sink: &mut dyn FrameSink) -> Result<bool> {
        let Self { ports, pictures, stride, wire_bytes, motion, device, .. } = self;
        let Some(pictures) = pictures else { return Ok(false) };
        let eyes_c = motion.as_ref().map_or([None; 2], Motion::eyes_c);
        let came = pictures.poll(patience, &mut |picture| {
            for port in ports.iter_mut() {
                port.deliver(picture, *stride, *wire_bytes, eyes_c, sink);
            }
        });
        came.map_err(|e| Error::new(e.kind(), format!("{device}: {e}")).with_source(e))
    }

    /// Waits for the motion unit, which is all there is: without it the camera is gone. Whether a batch went.
    fn poll_unit(&mut self, patience: Duration, sink: &mut dyn FrameSink) -> Result<bool> {
        if let Some(why) = self.motion.as_ref().and_then(Motion::problem) {
            let what = format!("{}: its motion unit is no longer read: {why}", self.device);
            return Err(Error::new(ErrorKind::Disconnected, what));
        }
        Ok(self.imu.as_mut().is_some_and(|imu| imu.wait(patience, sink)))
    }
}

impl Port {
    fn deliver(
        &mut self,
        picture: &Picture<'_>,
        stride: usize,
        wire_bytes: usize,
        eyes_c: [Option<f64>; 2],
        sink: &mut dyn FrameSink,
    ) {
        let time = picture.kernel_time.unwrap_or(picture.arrival);
        let bytes = own_bytes(picture.bytes.len(), wire_bytes, self.frame_bytes);
        let mut raw = RawFrame::new(picture.sequence, time.ns() as u64, picture.arrival, bytes);
        raw.damaged = picture.damaged;
        let (half, temperature) = match self.eye {
            Eye::Left => (Half::Left, eyes_c[0]),
            Eye::Right => (Half::Right, eyes_c[1]),
        };
        raw.temperature_c = temperature.map_or(f32::NAN, |t| t as f32);
        let row_bytes = self.row_bytes;
        self.gate.deliver(&raw, sink, |memory| copy_half(picture.bytes, stride, row_bytes, half, memory));
    }
}

/// The bytes of one eye when `came` of both arrived: all when the picture is whole, more when it is too long.
const fn own_bytes(came: usize, wire_bytes: usize, frame_bytes: usize) -> usize {
    if came == wire_bytes {
        frame_bytes
    } else if came > wire_bytes {
        frame_bytes + (came - wire_bytes)
    } else if came == 0 {
        0
    } else {
        // Half of what came, and never as many as a whole picture has.
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
