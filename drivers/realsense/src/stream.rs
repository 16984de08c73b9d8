//! A streaming D400: images from the transport, through the account of their metadata, into the gates.

use super::account::{Account, Facts, Stamped};
use super::control::Control;
use super::imu::Imu;
use super::memory::Memory;
use super::panel::Panel;
use core::time::Duration;
use depthrig_bus::{DropReason, FrameFlags, HostTime};
use depthrig_driver::controls::ControlPanel;
use depthrig_driver::{
    Error, ErrorKind, FrameSink, Gate, Poll, RawFrame, Result, Stream, StreamProfile, unpack,
};
use depthrig_usb::video::{Image, ImageSource};
use std::sync::{Arc, Weak};

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

/// One stream: its gate, and how its frames are unpacked from its source.
#[derive(Debug)]
pub(super) struct StreamState {
    pub(super) gate: Gate,
    pub(super) source: usize,
    pub(super) unpack: Unpack,
    pub(super) frame_bytes: usize,
}

/// A started sensor.
#[derive(Debug)]
pub(super) struct Source {
    pub(super) account: Account,
    pub(super) wire_bytes: usize,
}

/// Everything that a stream is made of.
pub(super) struct Parts {
    pub(super) label: String,
    pub(super) images: Box<dyn ImageSource>,
    pub(super) profiles: Vec<StreamProfile>,
    pub(super) streams: Vec<StreamState>,
    pub(super) sources: Vec<Source>,
    pub(super) control: Control,
    pub(super) memory: Arc<Memory>,
    pub(super) imu: Option<Imu>,
    pub(super) panel: Option<Arc<Panel>>,
}

/// A streaming D400.
pub(super) struct RealsenseStream {
    /// First, so that the device stops before the control thread is waited for.
    images: Option<Box<dyn ImageSource>>,
    label: String,
    profiles: Vec<StreamProfile>,
    streams: Vec<StreamState>,
    sources: Vec<Source>,
    control: Control,
    memory: Arc<Memory>,
    imu: Option<Imu>,
    panel: Option<Arc<Panel>>,
    began: HostTime,
    last_image: Option<HostTime>,
}

impl RealsenseStream {
    pub(super) fn new(parts: Parts) -> Self {
        let Parts { label, images, profiles, mut streams, sources, control, memory, imu, panel } = parts;
        for stream in &mut streams {
            stream.gate.clock().expect_probes();
        }
        Self {
            images: Some(images),
            label,
            profiles,
            streams,
            sources,
            control,
            memory,
            imu,
            panel,
            began: HostTime::now(),
            last_image: None,
        }
    }
}

impl Stream for RealsenseStream {
    fn profiles(&self) -> &[StreamProfile] {
        &self.profiles
    }

    fn poll(&mut self, timeout: Duration, sink: &mut dyn FrameSink) -> Result<Poll> {
        let Self { images, label, streams, sources, control, last_image, imu, .. } = self;
        let Some(running) = images.as_mut() else {
            return Err(Error::new(ErrorKind::Disconnected, format!("{label} failed before; open it anew")));
        };
        for probe in control.probes() {
            for stream in streams.iter_mut() {
                stream.gate.clock().probe(probe.before, probe.ticks.into(), probe.after);
            }
            if let Some(imu) = imu {
                imu.probe(probe);
            }
        }
        let temperature_c = control.temperature_c();
        let mut any = false;
        let mut is_mute = false;
        let polled = running.poll(timeout, &mut |image| {
            *last_image = Some(image.arrival);
            any = true;
            if let Some(source) = sources.get_mut(image.source) {
                let stamped = hand_over(streams, source, image, temperature_c, sink);
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
            self.images = None;
            self.imu = None;
            self.panel = None;
            return Err(Error::new(e.kind(), format!("{}: {e}", self.label)).with_source(e));
        }
        if any {
            self.memory.note_image();
        }
        // A batch does not show that images come.
        let batch = self.imu.as_mut().is_some_and(|imu| imu.drain(sink));
        // Of a camera that delivers nothing else, the end of its IMU is the end.
        if let Some(e) = self.imu.as_mut().filter(|_| self.streams.is_empty()).and_then(Imu::take_end) {
            self.images = None;
            self.imu = None;
            self.panel = None;
            return Err(Error::new(e.kind(), format!("{}: its IMU is no longer read: {e}", self.label))
                .with_source(e));
        }
        Ok(if any || batch { Poll::Frame } else { Poll::Idle })
    }

    fn controls(&self) -> Option<Weak<dyn ControlPanel>> {
        let panel = Arc::downgrade(self.panel.as_ref()?);
        Some(panel)
    }
}

impl Drop for RealsenseStream {
    fn drop(&mut self) {
        // A failure is not silence, and an IMU says nothing about images.
        if self.images.take().is_some() && !self.streams.is_empty() {
            self.memory.note_end(self.last_image.unwrap_or(self.began).elapsed());
        }
    }
}

/// Passes one image to every stream that is made from it.
fn hand_over(
    streams: &mut [StreamState],
    source: &mut Source,
    image: &Image<'_>,
    temperature_c: f32,
    sink: &mut dyn FrameSink,
) -> Stamped {
    let facts = image.header.map_or_else(Facts::default, Facts::of);
    let stamped = source.account.stamp(image, &facts);
    let Stamped::Yes(stamp) = &stamped else { return stamped };
    let missed = source.account.take_orphans();
    for stream in streams.iter_mut().filter(|s| s.source == image.source) {
        for sequence in &missed {
            // Its pixels are long gone and its time was never known.
            stream.gate.deliver(&RawFrame::new(*sequence, stamp.ticks, image.arrival, 0), sink, |_| {
                Err(DropReason::Incomplete)
            });
        }
        // As many bytes of the stream's as came of the source's; one too many is too many.
        let bytes = match image.bytes.len() {
            n if n == source.wire_bytes => stream.frame_bytes,
            n if n > source.wire_bytes => stream.frame_bytes + 1,
            n => n * stream.frame_bytes / source.wire_bytes.max(1),
        };
        let mut raw = RawFrame::new(stamp.sequence, stamp.ticks, image.arrival, bytes);
        raw.damaged = image.damaged;
        raw.exposure_ns = facts.exposure_us.map_or(0, |us| u64::from(us) * 1000);
        raw.gain = facts.gain.map_or(0.0, |g| g as f32);
        raw.temperature_c = temperature_c;
        raw.flags = stamp.flags;
        if facts.is_triggered {
            raw.flags = raw.flags.with(FrameFlags::HARDWARE_TRIGGERED);
        }
        stream.gate.deliver(&raw, sink, |memory| match stream.unpack {
            Unpack::Copy => unpack::copy_rows(image.bytes, memory.len(), memory.len(), memory),
            Unpack::Left => unpack::y8i::left(image.bytes, memory),
            Unpack::Right => unpack::y8i::right(image.bytes, memory),
            Unpack::Turn8(columns) => unpack::turn::turn::<1>(image.bytes, columns, memory),
            Unpack::Turn16(columns) => unpack::turn::turn::<2>(image.bytes, columns, memory),
            Unpack::Confidence(columns) => unpack::turn::confidence(image.bytes, columns, memory),
            Unpack::Y411(width) => unpack::y411::to_nv12(image.bytes, width, memory),
        });
    }
    stamped
}

#[cfg(test)]
mod tests;
