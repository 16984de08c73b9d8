//! From a driver to the bus: pixels are written once, into the slot that subscribers read.

use crate::stream::{Books, Reached, Stream};
use crate::wake::Wake;
use depthrig_bus::{
    DropReason, FrameHeader, FrameMut, HostTime, MOTION_SAMPLE_BYTES, PixelFormat, Publisher,
};
use depthrig_driver::clock::{CalibratedLatency, ClockQuality};
use depthrig_driver::{FrameMeta, FrameSink, Loan};
use std::sync::{Arc, MutexGuard};

/// The sink of one opening of one camera.
pub struct BusSink {
    streams: Vec<Port>,
    wake: Arc<Wake>,
}

/// One stream of the sink.
struct Port {
    stream: Arc<Stream>,
    publisher: Arc<Publisher>,
    /// The header of every frame; fields that change per frame are filled in at commit.
    template: FrameHeader,
    session: u64,
    loan: Option<FrameMut>,
    latency: Option<CalibratedLatency>,
}

impl BusSink {
    /// A sink over `streams`, each with its channel and the header that all its frames share. `wake` is
    /// raised after each frame.
    pub fn new(streams: Vec<(Arc<Stream>, Arc<Publisher>, FrameHeader)>, wake: Arc<Wake>) -> Self {
        let port = |(stream, publisher, template): (Arc<Stream>, Arc<Publisher>, FrameHeader)| {
            let session = stream.books().begin_session();
            Port { stream, publisher, template, session, loan: None, latency: None }
        };
        Self { streams: streams.into_iter().map(port).collect(), wake }
    }

    /// The same with the latencies that a calibration found, one for each stream.
    pub fn with_latencies(mut self, latencies: &[Option<CalibratedLatency>]) -> Self {
        for (port, latency) in self.streams.iter_mut().zip(latencies) {
            port.latency = *latency;
        }
        self
    }
}

impl Port {
    /// The stream's books, unless this session was closed.
    fn books(&self) -> Option<MutexGuard<'_, Books>> {
        let books = self.stream.books();
        (books.session == self.session).then_some(books)
    }

    fn publish(&mut self, mut frame: FrameMut, meta: &FrameMeta) {
        let stream = Arc::clone(&self.stream);
        let mut books = stream.books();
        if books.session != self.session {
            return;
        }
        let payload_len = frame.header().payload_len;
        let mut template = self.template;
        if self.stream.profile.format.is_motion() {
            // A batch is as wide as it has samples.
            template.set_image(PixelFormat::Motion, payload_len / MOTION_SAMPLE_BYTES as u32, 1);
        }
        let header = FrameHeader {
            sequence: books.delivered + 1,
            device_sequence: meta.device_sequence,
            device_time: meta.device_time,
            capture_time_ns: meta.capture_time.ns(),
            capture_uncertainty_ns: meta.capture_uncertainty_ns,
            arrival_time_ns: meta.arrival.ns(),
            exposure_ns: meta.exposure_ns,
            captured: books.captured,
            dropped: books.dropped.0,
            clock_domain: meta.clock_domain as u32,
            clock_epoch: books.epoch_base + meta.clock_epoch,
            flags: meta.flags.0,
            gain: meta.gain,
            temperature_c: meta.temperature_c,
            latency_ns: meta.latency_ns,
            payload_len,
            ..template
        };
        *frame.header_mut() = header;
        if let Err(e) = self.publisher.send(frame) {
            books.dropped.add(DropReason::NoSlot, 1);
            tracing::error!(stream = %self.stream.id, error = %e, "a frame was lost on its way to the subscribers");
            return;
        }
        books.published(&header, HostTime::now().since_ns(meta.capture_time));
    }
}

impl FrameSink for BusSink {
    fn loan(&mut self, stream: usize, len: usize) -> Option<&mut [u8]> {
        let port = self.streams.get_mut(stream)?;
        port.loan = None;
        match port.publisher.loan(len) {
            Ok(frame) => Some(port.loan.insert(frame).pixels_mut()),
            Err(e) => {
                tracing::debug!(stream = %port.stream.id, error = %e, "no slot");
                None
            }
        }
    }

    fn commit(&mut self, stream: usize, meta: &FrameMeta) {
        if let Some(port) = self.streams.get_mut(stream) {
            if let Some(frame) = port.loan.take() {
                port.publish(frame, meta);
            }
            self.wake.raise();
        }
    }

    fn lend(&mut self, stream: usize, len: usize) -> Option<Loan> {
        let port = self.streams.get(stream)?;
        // Its absence is the kernel's to notice: frames that it skips for want of memory are a gap in its counter.
        let lent = port.publisher.loan(len);
        lent.inspect_err(|e| tracing::debug!(stream = %port.stream.id, error = %e, "no slot"))
            .ok()
            .map(Loan::Slot)
    }

    fn commit_lent(&mut self, stream: usize, loan: Loan, meta: &FrameMeta) {
        let Some(port) = self.streams.get_mut(stream) else { return };
        match loan {
            Loan::Slot(frame) => port.publish(frame, meta),
            // Not of this sink; a frame outside a slot cannot be published without a copy.
            Loan::Memory(_) => self.dropped(stream, DropReason::NoSlot, 1),
        }
        self.wake.raise();
    }

    fn discard(&mut self, stream: usize) {
        if let Some(port) = self.streams.get_mut(stream) {
            port.loan = None;
        }
    }

    fn dropped(&mut self, stream: usize, reason: DropReason, n: u64) {
        let Some(port) = self.streams.get(stream) else { return };
        let Some(mut books) = port.books() else { return };
        books.dropped.add(reason, n);
        // A camera that loses every frame must not fill the log: one line a second, the counts say the rest.
        if books.may_log_loss(HostTime::now()) {
            let id = &port.stream.id;
            let total = books.dropped.total();
            tracing::error!(stream = %id, reason = reason.name(), frames = n, total, "frames lost");
        }
    }

    fn superseded(&mut self, stream: usize, n: u64) {
        let Some(port) = self.streams.get(stream) else { return };
        let Some(mut books) = port.books() else { return };
        books.dropped.add(DropReason::QueueFull, n);
        if let Some(Reached { reached_hz, of_hz }) = books.superseded(HostTime::now()) {
            let id = &port.stream.id;
            let reason = DropReason::QueueFull.name();
            tracing::info!(
                stream = %id,
                "computed at {reached_hz:.1} of {of_hz:.1} Hz, the newest first; skipped frames are counted as {reason}"
            );
        }
    }

    fn captured(&mut self, stream: usize, n: u64) {
        if let Some(mut books) = self.streams.get(stream).and_then(Port::books) {
            books.captured += n;
        }
    }

    fn clock_quality(&mut self, stream: usize, quality: &ClockQuality) {
        if let Some(mut books) = self.streams.get(stream).and_then(Port::books) {
            books.clock = Some(*quality);
        }
    }

    fn calibrated_latency(&self, stream: usize) -> Option<CalibratedLatency> {
        self.streams.get(stream)?.latency
    }
}
