//! A streaming camera: each picture of both eyes becomes a frame of each stream that was asked for.

use super::mode::Eye;
use super::motion::Motion;
use crate::unpack::{Half, copy_half};
use crate::video::{Picture, PictureSource};
use crate::{Error, FrameSink, Gate, Poll, RawFrame, Result, Stream, StreamProfile};
use core::time::Duration;
use std::sync::mpsc::{Receiver, TryRecvError};

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
    pictures: Box<dyn PictureSource>,
    /// Bytes from one row of both eyes to the next.
    stride: usize,
    /// Bytes of a whole picture of both eyes.
    wire_bytes: usize,
    motion: Option<Motion>,
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
        Self { profiles, ports, pictures, stride, wire_bytes, motion, settled, device }
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
        let Self { ports, pictures, stride, wire_bytes, motion, device, .. } = self;
        let eyes_c = motion.as_ref().map_or([None; 2], Motion::eyes_c);
        let came = pictures.poll(timeout, &mut |picture| {
            for port in ports.iter_mut() {
                port.deliver(picture, *stride, *wire_bytes, eyes_c, sink);
            }
        });
        match came {
            Ok(true) => Ok(Poll::Frame),
            Ok(false) => Ok(Poll::Idle),
            Err(e) => Err(Error::new(e.kind(), format!("{device}: {e}")).with_source(e)),
        }
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
