//! A sink that checks every promise about a single frame as it comes, and records the observations.

use core::time::Duration;
use depthrig_bus::sync::lock;
use depthrig_bus::{
    DropCounts, DropReason, FrameFlags, HostTime, MOTION_SAMPLE_BYTES, MetadataLevel, PixelFormat,
};
use depthrig_driver::clock::ClockQuality;
use depthrig_driver::{FrameMeta, FrameSink, StreamProfile};
use std::sync::{Arc, Mutex};

/// Contents of memory on loan before the driver writes: two different fills in turn, so that a byte that a
/// driver leaves alone cannot look right every time.
const FILLS: [u8; 2] = [0xA5, 0x5A];

/// A frame that was published.
#[derive(Debug, Clone)]
pub(super) struct Published {
    pub(super) stream: usize,
    pub(super) meta: FrameMeta,
    pub(super) pixels: Vec<u8>,
    /// The byte that the memory held before.
    pub(super) fill: u8,
}

/// Everything that a driver delivered.
#[derive(Debug, Default)]
pub(super) struct Observed {
    pub(super) published: Vec<Published>,
    pub(super) delivered: Vec<u64>,
    pub(super) drops: Vec<DropCounts>,
    pub(super) captured: Vec<u64>,
    pub(super) broken: Vec<String>,
    pub(super) refuse: u32,
    last: Vec<Option<FrameMeta>>,
    profiles: Vec<StreamProfile>,
    on_loan: Vec<Option<(Vec<u8>, u8)>>,
    loans: usize,
}

/// The probe; clones share the observations.
#[derive(Debug, Clone, Default)]
pub(super) struct Probe {
    observed: Arc<Mutex<Observed>>,
    lent: Vec<u8>,
    lent_of: usize,
}

impl Probe {
    pub(super) fn new(profiles: &[StreamProfile]) -> Self {
        let n = profiles.len();
        let observed = Observed {
            delivered: vec![0; n],
            drops: vec![DropCounts::default(); n],
            captured: vec![0; n],
            last: vec![None; n],
            on_loan: (0..n).map(|_| None).collect(),
            profiles: profiles.to_vec(),
            ..Observed::default()
        };
        Self { observed: Arc::new(Mutex::new(observed)), ..Self::default() }
    }

    /// Reads the observations.
    pub(super) fn with<T>(&self, look: impl FnOnce(&mut Observed) -> T) -> T {
        look(&mut lock(&self.observed))
    }
}

impl Observed {
    /// Frames published on the stream that has the fewest.
    pub(super) fn least_delivered(&self) -> u64 {
        self.delivered.iter().copied().min().unwrap_or_default()
    }

    /// Frames published or dropped, all streams.
    pub(super) fn seen(&self) -> u64 {
        self.delivered.iter().sum::<u64>() + self.drops.iter().map(DropCounts::total).sum::<u64>()
    }

    fn check(&mut self, stream: usize, meta: &FrameMeta, bytes: usize) {
        let now = HostTime::now();
        let mut broken = Vec::new();
        let Some(p) = self.profiles.get(stream) else {
            self.broken.push(format!("a frame of stream {stream}, which was not started"));
            return;
        };
        let sized = match p.format {
            PixelFormat::Mjpeg => true,
            PixelFormat::Motion => {
                bytes.is_multiple_of(MOTION_SAMPLE_BYTES) && (1..=p.frame_bytes()).contains(&bytes)
            }
            _ => bytes == p.frame_bytes(),
        };
        if !sized {
            broken.push(format!("it has {bytes} bytes, not {}", p.frame_bytes()));
        }
        if meta.capture_time > meta.arrival {
            broken.push(format!("captured {} ns after it arrived", meta.capture_time.since_ns(meta.arrival)));
        }
        if meta.arrival > now {
            broken.push(format!("arrives {} ns in the future", meta.arrival.since_ns(now)));
        }
        if meta.captured != self.delivered[stream] + 1 + self.drops[stream].total() {
            broken.push(format!(
                "captured = {}, but {} are delivered with it and {} dropped",
                meta.captured,
                self.delivered[stream] + 1,
                self.drops[stream].total()
            ));
        }
        let level = MetadataLevel::of(meta.clock_domain, meta.flags);
        let is_lost = meta.flags.has(FrameFlags::METADATA_LOST);
        if level != p.metadata && !is_lost {
            broken.push(format!("its metadata is {}, the stream's {}", level.name(), p.metadata.name()));
        }
        if let Some(last) = &self.last[stream] {
            if meta.clock_epoch < last.clock_epoch {
                broken.push(format!("clock epoch {} after {}", meta.clock_epoch, last.clock_epoch));
            }
            if meta.clock_epoch == last.clock_epoch && meta.capture_time < last.capture_time {
                broken.push(format!(
                    "its time went back by {} ns",
                    last.capture_time.since_ns(meta.capture_time)
                ));
            }
            if meta.arrival < last.arrival {
                broken.push(format!("its arrival went back by {} ns", last.arrival.since_ns(meta.arrival)));
            }
        }
        self.last[stream] = Some(*meta);
        let n = self.delivered[stream];
        self.broken.extend(broken.into_iter().map(|what| format!("frame {n} of {}: {what}", p.describe())));
    }
}

impl FrameSink for Probe {
    fn loan(&mut self, stream: usize, len: usize) -> Option<&mut [u8]> {
        let fill = self.with(|b| {
            if b.refuse > 0 {
                b.refuse -= 1;
                return None;
            }
            b.loans += 1;
            if b.on_loan.get(stream).is_some_and(Option::is_some) {
                b.broken.push(format!("stream {stream}: memory is asked for while some is on loan"));
            }
            let fill = FILLS[b.loans % 2];
            if let Some(slot) = b.on_loan.get_mut(stream) {
                *slot = Some((Vec::new(), fill));
            }
            Some(fill)
        })?;
        self.lent = vec![fill; len];
        self.lent_of = stream;
        Some(&mut self.lent)
    }

    fn commit(&mut self, stream: usize, meta: &FrameMeta) {
        let pixels = core::mem::take(&mut self.lent);
        let is_right = self.lent_of == stream;
        self.with(|b| {
            let Some((_, fill)) = b.on_loan.get_mut(stream).and_then(Option::take).filter(|_| is_right)
            else {
                b.broken.push(format!("stream {stream}: a commit without memory on loan"));
                return;
            };
            b.check(stream, meta, pixels.len());
            b.delivered[stream] += 1;
            // The last frames are enough to look at; all of them would be gigabytes.
            if b.published.len() >= 64 {
                b.published.remove(0);
            }
            b.published.push(Published { stream, meta: *meta, pixels, fill });
        });
    }

    fn discard(&mut self, stream: usize) {
        self.with(|b| {
            if b.on_loan.get_mut(stream).and_then(Option::take).is_none() {
                b.broken.push(format!("stream {stream}: a discard without memory on loan"));
            }
        });
    }

    fn dropped(&mut self, stream: usize, reason: DropReason, n: u64) {
        self.with(|b| match b.drops.get_mut(stream) {
            Some(drops) => drops.add(reason, n),
            None => b.broken.push(format!("a drop on stream {stream}, which was not started")),
        });
    }

    fn captured(&mut self, stream: usize, n: u64) {
        self.with(|b| match b.captured.get_mut(stream) {
            Some(captured) => *captured += n,
            None => b.broken.push(format!("a capture on stream {stream}, which was not started")),
        });
    }

    fn clock_quality(&mut self, stream: usize, quality: &ClockQuality) {
        let is_number = quality.rate_ppm.is_finite();
        self.with(|b| {
            if stream >= b.delivered.len() || !is_number {
                b.broken.push(format!("stream {stream}: an invalid clock quality: {quality:?}"));
            }
        });
    }
}

/// Waits until `is_done`, at most `timeout`.
pub(super) fn wait_for(timeout: Duration, mut is_done: impl FnMut() -> bool) -> bool {
    let deadline = HostTime::now().plus(timeout);
    while !is_done() {
        if deadline.from_now().is_zero() {
            return false;
        }
        std::thread::sleep(Duration::from_millis(2));
    }
    true
}
