//! A streaming D400: pictures from the transport, through the account of their metadata, into the gates.

use super::account::{Account, Facts, Stamped};
use super::control::Control;
use super::imu::Imu;
use super::memory::Memory;
use crate::video::{Picture, PictureSource};
use crate::{Error, ErrorKind, FrameSink, Gate, Poll, RawFrame, Result, Stream, StreamProfile, unpack};
use core::time::Duration;
use depthrig_bus::{DropReason, FrameFlags, HostTime};
use std::sync::Arc;

/// How the bytes of a source become the pixels of a stream.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Unpack {
    /// As they are.
    Copy,
    /// The left bytes of interleaved pairs.
    Left,
    /// The right bytes.
    Right,
    /// Pixels of one byte, turned, in rows of so many as they come.
    Turn8(usize),
    /// Pixels of two bytes, likewise.
    Turn16(usize),
    /// Confidence, turned, in rows of so many bytes as it comes.
    Confidence(usize),
    /// Blocks of Y411 for rows of so many pixels.
    Y411(usize),
}

/// One stream: its gate, and how it is made from its source.
#[derive(Debug)]
pub(super) struct Lane {
    pub(super) gate: Gate,
    pub(super) source: usize,
    pub(super) unpack: Unpack,
    pub(super) frame_bytes: usize,
}

/// What was started of one sensor.
#[derive(Debug)]
pub(super) struct Source {
    pub(super) account: Account,
    pub(super) wire_bytes: usize,
}

/// Everything that a stream is made of.
pub(super) struct Parts {
    pub(super) label: String,
    pub(super) pictures: Box<dyn PictureSource>,
    pub(super) profiles: Vec<StreamProfile>,
    pub(super) lanes: Vec<Lane>,
    pub(super) sources: Vec<Source>,
    pub(super) control: Control,
    pub(super) memory: Arc<Memory>,
    pub(super) imu: Option<Imu>,
}

/// A streaming D400.
pub(super) struct RealsenseStream {
    /// First, so that the device stops before the control thread is waited for.
    pictures: Option<Box<dyn PictureSource>>,
    label: String,
    profiles: Vec<StreamProfile>,
    lanes: Vec<Lane>,
    sources: Vec<Source>,
    control: Control,
    memory: Arc<Memory>,
    imu: Option<Imu>,
    began: HostTime,
    last_picture: Option<HostTime>,
}

impl RealsenseStream {
    pub(super) fn new(parts: Parts) -> Self {
        let Parts { label, pictures, profiles, mut lanes, sources, control, memory, imu } = parts;
        for lane in &mut lanes {
            lane.gate.clock().expect_probes();
        }
        Self {
            pictures: Some(pictures),
            label,
            profiles,
            lanes,
            sources,
            control,
            memory,
            imu,
            began: HostTime::now(),
            last_picture: None,
        }
    }
}

impl Stream for RealsenseStream {
    fn profiles(&self) -> &[StreamProfile] {
        &self.profiles
    }

    fn poll(&mut self, timeout: Duration, sink: &mut dyn FrameSink) -> Result<Poll> {
        let Self { pictures, label, lanes, sources, control, last_picture, imu, .. } = self;
        let Some(running) = pictures.as_mut() else {
            return Err(Error::new(ErrorKind::Disconnected, format!("{label} failed before; open it anew")));
        };
        for probe in control.probes() {
            for lane in lanes.iter_mut() {
                lane.gate.clock().probe(probe.before, probe.ticks.into(), probe.after);
            }
            if let Some(imu) = imu {
                imu.probe(probe);
            }
        }
        let temperature_c = control.temperature_c();
        let (mut any, mut is_mute) = (false, false);
        let polled = running.poll(timeout, &mut |picture| {
            *last_picture = Some(picture.arrival);
            any = true;
            if let Some(source) = sources.get_mut(picture.source) {
                let stamped = hand_over(lanes, source, picture, temperature_c, sink);
                is_mute |= stamped == Stamped::Never;
            }
        });
        let failed = match polled {
            Ok(_) if is_mute => {
                self.memory.note_mute();
                let text = "it sends no metadata although the kernel offers it; it is opened again without";
                Some(Error::new(ErrorKind::Protocol, text))
            }
            Ok(_) => None,
            Err(e) => Some(e),
        };
        if let Some(e) = failed {
            // Whatever failed, the device is let go at once.
            self.pictures = None;
            self.imu = None;
            return Err(Error::new(e.kind(), format!("{}: {e}", self.label)).with_source(e));
        }
        if any {
            self.memory.note_picture();
        }
        // A batch is no sign that images come.
        let batch = self.imu.as_mut().is_some_and(|imu| imu.drain(sink));
        // Of a camera that delivers nothing else, the end of its IMU is the end.
        if let Some(e) = self.imu.as_mut().filter(|_| self.lanes.is_empty()).and_then(Imu::take_end) {
            self.pictures = None;
            self.imu = None;
            return Err(Error::new(e.kind(), format!("{}: its IMU is no longer read: {e}", self.label))
                .with_source(e));
        }
        Ok(if any || batch { Poll::Frame } else { Poll::Idle })
    }
}

impl Drop for RealsenseStream {
    fn drop(&mut self) {
        // What failed was no silence, and an IMU says nothing of images.
        if self.pictures.take().is_some() && !self.lanes.is_empty() {
            self.memory.note_end(self.last_picture.unwrap_or(self.began).elapsed());
        }
    }
}

/// Passes one picture to every stream that is made from it.
fn hand_over(
    lanes: &mut [Lane],
    source: &mut Source,
    picture: &Picture<'_>,
    temperature_c: f32,
    sink: &mut dyn FrameSink,
) -> Stamped {
    let facts = picture.header.map_or_else(Facts::default, Facts::of);
    let stamped = source.account.stamp(picture, &facts);
    let Stamped::Yes(stamp) = &stamped else { return stamped };
    let missed = source.account.take_orphans();
    for lane in lanes.iter_mut().filter(|l| l.source == picture.source) {
        for sequence in &missed {
            // Its pixels are long gone and its time was never known.
            lane.gate.deliver(&RawFrame::new(*sequence, stamp.ticks, picture.arrival, 0), sink, |_| {
                Err(DropReason::Incomplete)
            });
        }
        // As many bytes of the stream's as came of the source's; one too many is too many.
        let bytes = match picture.bytes.len() {
            n if n == source.wire_bytes => lane.frame_bytes,
            n if n > source.wire_bytes => lane.frame_bytes + 1,
            n => n * lane.frame_bytes / source.wire_bytes.max(1),
        };
        let mut raw = RawFrame::new(stamp.sequence, stamp.ticks, picture.arrival, bytes);
        raw.damaged = picture.damaged;
        raw.exposure_ns = facts.exposure_us.map_or(0, |us| u64::from(us) * 1000);
        raw.gain = facts.gain.map_or(0.0, |g| g as f32);
        raw.temperature_c = temperature_c;
        raw.flags = stamp.flags;
        if facts.is_triggered {
            raw.flags = raw.flags.with(FrameFlags::HARDWARE_TRIGGERED);
        }
        lane.gate.deliver(&raw, sink, |memory| match lane.unpack {
            Unpack::Copy => unpack::copy_rows(picture.bytes, memory.len(), memory.len(), memory),
            Unpack::Left => unpack::y8i::left(picture.bytes, memory),
            Unpack::Right => unpack::y8i::right(picture.bytes, memory),
            Unpack::Turn8(columns) => unpack::turn::turn::<1>(picture.bytes, columns, memory),
            Unpack::Turn16(columns) => unpack::turn::turn::<2>(picture.bytes, columns, memory),
            Unpack::Confidence(columns) => unpack::turn::confidence(picture.bytes, columns, memory),
            Unpack::Y411(width) => unpack::y411::to_nv12(picture.bytes, width, memory),
        });
    }
    stamped
}

#[cfg(test)]
mod tests;
