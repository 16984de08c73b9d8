//! The images of a camera's streaming interfaces, over several submitted bulk transfers for each.

use super::budget::{self, Reservation};
use super::camera::{Camera, Inner};
use super::errors::failed;
use super::frames::{Assembled, Layout};
use super::negotiate::{self, Agreement};
use super::stream::{Stream, Todo};
use super::transfers::{CompletionQueue, Event, TransferPool};
use core::time::Duration;
use depthrig_bus::HostTime;
use depthrig_driver::{Error, ErrorKind, Result};
use depthrig_usb::uvc::descriptors::{Endpoint, Format, FrameSize, Interval, TransferKind};
use depthrig_usb::uvc::formats::FourCc;
use depthrig_usb::video::{Image, ImageSource};
use std::sync::Arc;
use std::thread::JoinHandle;

/// Room for the payload header and what else a device may put around a frame (librealsense `src/uvc/uvc-streamer.cpp`).
const HEADER_ROOM: usize = 1024;
/// The most bytes of a frame that a transfer is made for. A descriptor that asks for more is wrong.
const MAX_FRAME_BYTES: usize = 64 << 20;
/// Least payload size, bytes; a device that announces less announced nothing.
const LEAST_PAYLOAD: usize = 64;
/// How often the streams are looked after while nothing comes.
const TICK: Duration = Duration::from_millis(50);
/// How long the transfers are waited for when the source is stopped. The kernel gives them back at once, unless it
/// hangs.
const STOP_WAIT: Duration = Duration::from_secs(5);

/// One stream of a camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StreamMode {
    /// Number of the streaming interface.
    pub interface: u8,
    /// Format on the wire.
    pub format: FourCc,
    /// Pixels in a row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Frames per second.
    pub rate_hz: f64,
}

/// How a source works.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Settings {
    transfers: usize,
}

impl Settings {
    /// The fewest transfers of a stream: one that fills while the other is emptied.
    pub const FEWEST_TRANSFERS: usize = 2;
    /// The most transfers of a stream; more only cost memory.
    pub const MOST_TRANSFERS: usize = 32;

    /// `transfers` submitted for each stream, one for each frame that may wait. Cut to the bounds above.
    pub fn with_transfers(transfers: usize) -> Self {
        Self { transfers: transfers.clamp(Self::FEWEST_TRANSFERS, Self::MOST_TRANSFERS) }
    }

    /// Transfers of each stream.
    pub const fn transfers(self) -> usize {
        self.transfers
    }
}

impl Default for Settings {
    /// Four: the capture thread may be late by three frame periods.
    fn default() -> Self {
        Self { transfers: 4 }
    }
}

/// Counters of a source since it was started.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Statistics {
    /// Transfers that came back.
    pub transfers: u64,
    /// Bytes that were copied to put split frames together; 0 when every frame came in one payload.
    pub assembled_bytes: u64,
    /// Transfers in which the device sent more than there was room for.
    pub overflows: u64,
    /// Transfers with another error.
    pub failures: u64,
    /// Transfers that ended because the endpoint was halted.
    pub stalls: u64,
    /// How often an endpoint was cleared.
    pub clearings: u64,
    /// Memory that the kernel counts for the submitted transfers.
    pub kernel_bytes: u64,
}

/// A camera that is streaming. Dropping it takes all transfers back and stops the camera.
pub struct Source {
    streams: Vec<Running>,
    queue: Arc<CompletionQueue>,
    camera: Arc<Inner>,
    reservation: Reservation,
    kernel_bytes: u64,
}

struct Running {
    stream: Stream<TransferPool>,
    agreement: Agreement,
    endpoint: u8,
    clearing: Option<JoinHandle<()>>,
}

/// A mode as the descriptors and the camera have it.
struct Plan {
    agreement: Agreement,
    endpoint: Endpoint,
    layout: Layout,
    transfer_bytes: usize,
    period: Duration,
}

impl Source {
    /// Starts the streams of `modes` together.
    ///
    /// # Errors
    /// [`ErrorKind::Unsupported`] when the camera does not have the mode or sends it isochronously, [`ErrorKind::Io`]
    /// when the kernel allows too little memory for transfers (with the cure), [`ErrorKind::Disconnected`].
    pub fn start(camera: &Camera, modes: &[StreamMode], settings: Settings) -> Result<Self> {
        let inner = Arc::clone(&camera.inner);
        let plans: Vec<_> = modes.iter().map(|m| plan(&inner, m)).collect::<Result<_>>()?;
        let bytes = |p: &Plan| budget::needed(settings.transfers, p.transfer_bytes);
        let kernel_bytes = plans.iter().map(bytes).sum();
        let reservation = Reservation::take(inner.root(), inner.label(), kernel_bytes)?;
        let queue = CompletionQueue::new(plans.len() * (settings.transfers + 1));
        let mut source = Self { streams: Vec::new(), queue, camera: inner, reservation, kernel_bytes };
        for plan in plans {
            source.add(plan, settings)?;
        }
        Ok(source)
    }

    fn add(&mut self, plan: Plan, settings: Settings) -> Result<()> {
        let Plan { agreement, endpoint, layout, transfer_bytes, period } = plan;
        let address = endpoint.address;
        let camera = Arc::clone(&self.camera);
        let what = format!("starting streaming interface {}", agreement.interface);
        // Clearing comes first: cameras take it as the end of a stream, as the kernel's driver uses it.
        camera.handle().clear_halt(address).map_err(|e| failed(camera.label(), &what, e))?;
        negotiate::commit(&camera, &agreement).map_err(|e| failed(camera.label(), &what, e))?;
        let index = self.streams.len();
        let pool = TransferPool::new(
            Arc::clone(&camera),
            address,
            &self.queue,
            index,
            settings.transfers,
            transfer_bytes,
        );
        let Some(pool) = pool else {
            return Err(failed(camera.label(), &what, rusb::Error::NoMem));
        };
        let stream = Stream::new(pool, layout, period, HostTime::now());
        self.streams.push(Running { stream, agreement, endpoint: address, clearing: None });
        match self.streams.last_mut().map(|r| r.stream.submit_all()) {
            None | Some(Ok(())) => Ok(()),
            Some(Err(e)) => Err(self.error(e, &what)),
        }
    }

    /// Counters so far.
    pub fn statistics(&self) -> Statistics {
        let mut sum = Statistics { kernel_bytes: self.kernel_bytes, ..Statistics::default() };
        for running in &self.streams {
            let counts = running.stream.counts();
            sum.transfers += counts.transfers;
            sum.overflows += counts.overflows;
            sum.failures += counts.failures;
            sum.stalls += counts.stalls;
            sum.clearings += counts.clearings;
            sum.assembled_bytes += running.stream.copied();
        }
        sum
    }

    fn error(&self, e: rusb::Error, what: &str) -> Error {
        match e {
            rusb::Error::NoMem => Reservation::refused(self.camera.root(), self.camera.label()),
            e => failed(self.camera.label(), what, e),
        }
    }

    /// Attends to one event; `each` gets the frames that it brings.
    fn attend(&mut self, event: &Event, each: &mut dyn FnMut(&Image<'_>)) -> Result<()> {
        let (index, at) = match *event {
            Event::Completed { stream, at, .. } => (stream, at),
            Event::Cleared { stream, .. } => (stream, HostTime::now()),
        };
        let Some(running) = self.streams.get_mut(index) else { return Ok(()) };
        let mut hand_on = |frame: &Assembled<'_>| {
            each(&Image {
                source: index,
                bytes: frame.bytes,
                damaged: frame.damaged,
                sequence: frame.sequence,
                kernel_time: None,
                arrival: at,
                header: frame.header,
            });
        };
        let result = match *event {
            Event::Completed { slot, .. } => running.stream.completed(slot, at, &mut hand_on),
            Event::Cleared { result, .. } => {
                join(&mut running.clearing);
                if let Err(e) = result {
                    tracing::warn!(camera = self.camera.label(), endpoint = running.endpoint, %e, "clearing an endpoint failed");
                }
                running.stream.cleared(result, at, &mut hand_on)
            }
        };
        result.map_err(|e| self.error(e, "streaming"))
    }

    /// Looks after silent and halted endpoints.
    fn tick(&mut self) -> Result<()> {
        let now = HostTime::now();
        for (index, running) in self.streams.iter_mut().enumerate() {
            if running.stream.tick(now) == Todo::Clear {
                tracing::warn!(
                    camera = self.camera.label(),
                    endpoint = running.endpoint,
                    "an endpoint is silent or halted; it is cleared and the stream started again"
                );
                running.clearing = Some(spawn_clearing(&self.camera, running, &self.queue, index)?);
            }
        }
        Ok(())
    }
}

/// Clears the endpoint of a stream and commits it again on a thread of its own: both are requests to the camera, which
/// may take seconds that the other streams do not have.
fn spawn_clearing(
    camera: &Arc<Inner>,
    running: &Running,
    queue: &Arc<CompletionQueue>,
    stream: usize,
) -> Result<JoinHandle<()>> {
    let theirs = Arc::clone(camera);
    let queue = Arc::clone(queue);
    let agreement = running.agreement.clone();
    let endpoint = running.endpoint;
    let name = format!("usb-clear-{endpoint:02x}");
    let clear = move || {
        let result =
            theirs.handle().clear_halt(endpoint).and_then(|()| negotiate::commit(&theirs, &agreement));
        drop(theirs); // before the event is read, so that this thread is never the last to hold the camera
        queue.post(Event::Cleared { stream, result });
    };
    std::thread::Builder::new().name(name).spawn(clear).map_err(|e| {
        let text = format!("{}: no thread to clear an endpoint could be started", camera.label());
        Error::new(ErrorKind::Io, text).with_source(e)
    })
}

fn join(thread: &mut Option<JoinHandle<()>>) {
    if let Some(thread) = thread.take() {
        // Nothing in it can panic.
        let _ = thread.join();
    }
}

impl ImageSource for Source {
    fn poll(&mut self, timeout: Duration, each: &mut dyn FnMut(&Image<'_>)) -> Result<bool> {
        let end = HostTime::now().plus(timeout);
        let mut any = false;
        loop {
            let mut wait = end.min(HostTime::now().plus(TICK));
            while let Some(event) = Arc::clone(&self.queue).next(wait) {
                self.attend(&event, &mut |image| {
                    any = true;
                    each(image);
                })?;
                wait = HostTime::from_ns(0); // what else is there, without waiting
            }
            self.tick()?;
            if any || end.from_now().is_zero() {
                return Ok(any);
            }
        }
    }
}

impl Drop for Source {
    fn drop(&mut self) {
        for running in &mut self.streams {
            join(&mut running.clearing);
            running.stream.stop();
        }
        let deadline = HostTime::now().plus(STOP_WAIT);
        while self.streams.iter().any(|r| r.stream.pending() > 0) {
            let Some(event) = self.queue.next(deadline) else { break };
            // Errors change nothing here: a device that is gone gives its transfers back as well.
            let _ = self.attend(&event, &mut |_| {});
        }
        for running in &self.streams {
            match self.camera.handle().clear_halt(running.endpoint) {
                Ok(()) | Err(rusb::Error::NoDevice) => {}
                Err(e) => {
                    tracing::warn!(camera = self.camera.label(), endpoint = running.endpoint, %e, "a stream was not ended");
                }
            }
        }
        tracing::debug!(camera = self.camera.label(), reservation = ?self.reservation, statistics = ?self.statistics(), "stopped");
    }
}

/// Finds the mode in the descriptors and agrees with the camera on it.
fn plan(camera: &Inner, mode: &StreamMode) -> Result<Plan> {
    let StreamMode { interface, format: code, width, height, rate_hz } = *mode;
    let label = camera.label();
    let unsupported = |why: String| Error::new(ErrorKind::Unsupported, format!("{label}: {why}"));
    let Some(stream) = camera.configuration().stream(interface) else {
        return Err(unsupported(format!("it has no streaming interface {interface}")));
    };
    let found: Option<(&Format, &FrameSize, Interval)> =
        stream.find(code, width, height).and_then(|(f, s)| Some((f, s, s.interval_for(rate_hz)?)));
    let Some((format, size, interval)) = found else {
        return Err(unsupported(format!("no mode {code} {width}x{height} {rate_hz} Hz")));
    };
    let Some((_, endpoint)) = stream.image_endpoint().filter(|(_, e)| e.kind == TransferKind::Bulk) else {
        return Err(unsupported(format!(
            "interface {interface} does not send by bulk transfers; use the kernel's driver (transport = \"kernel\")"
        )));
    };
    let agreement = negotiate::probe(camera, interface, format.index, size.index, interval.0)?;
    let announced = agreement.probe.max_frame_bytes as usize;
    let (frame_bytes, fixed) = match size.bytes(format) {
        Some(bytes) => (usize::try_from(bytes).unwrap_or(usize::MAX), true),
        None if announced > 0 => (announced, false),
        None => (size.max_bytes.map_or(0, |n| n as usize), false),
    };
    if frame_bytes == 0 || frame_bytes > MAX_FRAME_BYTES || endpoint.packet_bytes == 0 {
        return Err(unsupported(format!("its {code} {width}x{height} has frames of {frame_bytes} bytes")));
    }
    let (transfer_bytes, payload_bytes) =
        transfer_bytes(frame_bytes, agreement.probe.max_payload_bytes as usize, endpoint.packet_bytes.into());
    let layout = Layout { frame_bytes, fixed, payload_bytes };
    Ok(Plan { agreement, endpoint, layout, transfer_bytes, period: Duration::from_nanos(interval.ns()) })
}

/// Bytes of a transfer, and of a payload at most.
///
/// A payload ends with a short packet or when it has as many bytes as the device announced. A transfer has room for the
/// announced payload, so that each holds one; it is a multiple of the packet, or the device could send more than there
/// is room for; and it is not larger than a frame with its header can be, whatever was announced.
fn transfer_bytes(frame: usize, announced: usize, packet: usize) -> (usize, usize) {
    let whole = (frame + HEADER_ROOM).next_multiple_of(packet);
    if (LEAST_PAYLOAD..whole).contains(&announced) {
        (announced.next_multiple_of(packet), announced)
    } else {
        (whole, announced.max(whole))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_transfer_holds_one_payload_and_is_a_multiple_of_the_packet() {
        // 640x480 Z16 of a D400: one payload for a frame.
        assert_eq!(transfer_bytes(614_400, 614_656, 1024), (615_424, 614_656));
        // A payload of whole packets ends without a short one: the transfer must not wait for more.
        assert_eq!(transfer_bytes(614_400, 16_384, 1024), (16_384, 16_384));
        assert_eq!(transfer_bytes(614_400, 3000, 512), (3072, 3000));
        // Nothing announced, too little, or more than a frame can need.
        assert_eq!(transfer_bytes(614_400, 0, 1024), (615_424, 615_424));
        assert_eq!(transfer_bytes(614_400, 12, 512), (615_424, 615_424));
        assert_eq!(transfer_bytes(614_400, usize::MAX, 1024), (615_424, usize::MAX));
    }

    #[test]
    fn the_number_of_transfers_is_bounded() {
        assert_eq!(Settings::default().transfers(), 4);
        assert_eq!(Settings::with_transfers(0).transfers(), 2);
        assert_eq!(Settings::with_transfers(1000).transfers(), 32);
    }
}
