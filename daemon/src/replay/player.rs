//! The replay thread: reads moments, waits until they are due, publishes and records them.

use super::signals::Outputs;
use super::source::Moment;
use super::transport::Order;
use super::{Inner, lock};
use crate::Result;
use crate::stream::Stream;
use core::time::Duration;
use depthrig_bus::{
    Bus, DropReason, ErrorKind, FrameFlags, FrameHeader, HostTime, MemberRecord, Publisher, RuntimeDir,
    SUBSCRIBER_BUFFER, SetHeader, SetPublisher, UtcPair, shm,
};
use depthrig_recorder::{PixelMode, ReadPixels, RecordFrame, RecordMotion, RecordSet};
use std::sync::Arc;

/// How often a replay that has nothing to publish looks for new subscribers, who are to see the last set.
const IDLE: Duration = Duration::from_millis(100);
/// How often a replay that waits for a subscriber looks for one that was killed.
const CLEAN: Duration = Duration::from_secs(1);
/// How often a replay that waits for a subscriber or the recorder asks again.
const ASK: Duration = Duration::from_millis(1);
/// A subscriber that keeps a replay waiting this long is worth a line in the log.
const TIMEOUT: Duration = Duration::from_secs(5);

/// The replay thread's state.
pub struct Player {
    inner: Arc<Inner>,
    bus: Arc<Bus>,
    outputs: Vec<Output>,
    /// The channels of the IMUs.
    units: Vec<Output>,
    /// Batches that were published, and go into the next set that is recorded.
    carried: Vec<RecordMotion>,
    signals: Outputs,
    sets: SetPublisher,
}

struct Output {
    stream: Arc<Stream>,
    publisher: Publisher,
    sequence: u64,
}

impl Player {
    /// Opens the channels.
    ///
    /// # Errors
    /// `NoSpace` when shared memory is too small, and those of opening a channel.
    pub fn new(inner: Arc<Inner>, bus: Arc<Bus>, runtime: &RuntimeDir) -> Result<Self> {
        let bytes = |s: &Stream| s.profile.frame_bytes();
        let set_bytes = inner.streams.iter().chain(&inner.unit_streams).map(|s| bytes(s) as u64).sum();
        let free = shm::free_bytes(shm::SHM_DIR.as_ref())?;
        let fit = shm::slots_that_fit(inner.slots(), set_bytes, free)?;
        let open = |stream: &Arc<Stream>| -> Result<Output> {
            let publisher = bus.publisher(&stream.id, bytes(stream), fit)?;
            Ok(Output { stream: Arc::clone(stream), publisher, sequence: 0 })
        };
        let outputs = inner.streams.iter().map(open).collect::<Result<_>>()?;
        let units = inner.unit_streams.iter().map(open).collect::<Result<_>>()?;
        let sets =
            if inner.lossless() { bus.set_publisher_with(SUBSCRIBER_BUFFER)? } else { bus.set_publisher()? };
        let signals = Outputs::open(&inner, runtime, lock(&inner.sources).signals())?;
        Ok(Self { inner, bus, outputs, units, carried: Vec::new(), signals, sets })
    }

    /// Runs until the replay is stopped. The channels stay until then, so that subscribers can read the last frames.
    pub fn run(mut self) {
        let inner = Arc::clone(&self.inner);
        let mut ahead: Option<(usize, Moment)> = None;
        while !inner.stopping() {
            let order = lock(&inner.transport).order(HostTime::now());
            inner.set_done(order == Order::End);
            let Order::Publish { moment, due, turn } = order else {
                self.idle(IDLE);
                continue;
            };
            // Read before it is due, then look again: a command may have come meanwhile.
            let Some((_, read)) = ahead.take_if(|(n, _)| *n == moment && due <= HostTime::now()) else {
                if ahead.as_ref().is_some_and(|(n, _)| *n == moment) {
                    self.idle(due.from_now().min(IDLE));
                } else {
                    let read =
                        lock(&inner.sources).read(&inner.timeline, moment, PixelMode::DecodedAndStored);
                    ahead = Some((moment, read));
                }
                continue;
            };
            let now = HostTime::now();
            self.publish(moment, read);
            lock(&inner.transport).published(moment, turn, now);
            inner.acted.notify_all();
        }
    }

    /// Sleeps until a command comes or `length` has passed.
    fn idle(&self, length: Duration) {
        self.inner.wake.wait(length);
        self.outputs.iter().chain(&self.units).for_each(|o| o.publisher.welcome());
        self.signals.welcome();
        self.sets.welcome();
    }

    fn publish(&mut self, number: usize, mut moment: Moment) {
        for problem in std::mem::take(&mut moment.problems) {
            self.inner.lose(problem);
        }
        let is_recording = lock(&self.inner.recording).is_active();
        self.signals.publish(&self.inner, std::mem::take(&mut moment.signals), is_recording);
        if !self.publish_motion(&mut moment) || moment.frames.is_empty() {
            return;
        }
        let mut members: Vec<_> = self
            .outputs
            .iter()
            .map(|o| MemberRecord {
                id: o.stream.id.clone(),
                sequence: None,
                capture_time_ns: moment.tick.ns(),
            })
            .collect();
        let mut recorded = Vec::with_capacity(moment.frames.len());
        for frame in std::mem::take(&mut moment.frames) {
            let (Some(output), Some(member)) =
                (self.outputs.get_mut(frame.stream), members.get_mut(frame.stream))
            else {
                continue;
            };
            match send(&self.inner, &self.bus, output, &frame.header, &frame.pixels) {
                Ok(Some(header)) => {
                    member.sequence = Some(header.sequence);
                    member.capture_time_ns = header.capture_time_ns;
                    let codec = frame.codec;
                    let pixels = Box::new(ReadPixels { pixels: frame.pixels, codec, stored: frame.stored });
                    recorded.push(RecordFrame { stream: frame.stream, header, pixels });
                }
                Ok(None) => return, // stopped while it waited
                Err(e) => self.inner.lose(format!("set {}: {e}", moment.id)),
            }
        }
        let id = self.inner.count(number, &moment, members.iter().any(|m| m.sequence.is_none()));
        let header = SetHeader {
            set_id: id.set,
            tick_ns: moment.tick.ns(),
            spread_ns: moment.spread_ns,
            incomplete: id.incomplete,
            ..SetHeader::default()
        };
        let sent = when_free(
            &self.inner,
            &self.bus,
            "the frame sets",
            || self.sets.send(header, &members),
            || self.sets.welcome(),
        );
        if let Err(e) = sent {
            self.inner.lose(format!("set {}: {e}", moment.id));
        }
        self.record(id.set, &moment, recorded);
    }

    /// Publishes the IMU batches before a set; `false` when the replay was stopped while it waited.
    fn publish_motion(&mut self, moment: &mut Moment) -> bool {
        let mut bytes = Vec::new();
        for mut batch in std::mem::take(&mut moment.motion) {
            let Some(output) = self.units.get_mut(batch.unit) else { continue };
            bytes.clear();
            batch.samples.iter().for_each(|s| bytes.extend_from_slice(&s.to_bytes()));
            match send(&self.inner, &self.bus, output, &batch.header, &bytes) {
                Ok(Some(header)) => {
                    batch.header = header;
                    if lock(&self.inner.recording).is_active() {
                        self.carried.push(batch);
                    } else {
                        self.carried.clear();
                    }
                }
                Ok(None) => return false,
                Err(e) => self.inner.lose(format!("set {}: {e}", moment.id)),
            }
        }
        true
    }

    /// Hands the set to the recorder, if one is running, and waits until it has room: a recording of a replay loses
    /// nothing.
    fn record(&mut self, id: u64, moment: &Moment, frames: Vec<RecordFrame>) {
        let inner = Arc::clone(&self.inner);
        let motion = std::mem::take(&mut self.carried);
        let signals = self.signals.take();
        while !lock(&inner.recording).has_room() && !inner.stopping() {
            std::thread::sleep(ASK);
        }
        let present = |s: &usize| frames.iter().any(|f| f.stream == *s);
        let missing = (0..self.outputs.len()).filter(|s| !present(s)).collect();
        let utc_ns = lock(&inner.sources).utc_ns(moment.tick);
        let utc = UtcPair { mono: moment.tick, utc_ns, width_ns: 0 };
        *lock(&inner.clock) = utc;
        let tick = moment.tick;
        let spread_ns = moment.spread_ns;
        lock(&inner.recording).push(RecordSet { id, tick, utc, frames, missing, motion, signals, spread_ns });
    }
}

/// Publishes a frame with the header that it was recorded with; `None` when the replay was stopped meanwhile.
fn send(
    inner: &Inner,
    bus: &Bus,
    output: &mut Output,
    original: &FrameHeader,
    payload: &[u8],
) -> depthrig_bus::Result<Option<FrameHeader>> {
    let stream = Arc::clone(&output.stream);
    let mut books = stream.books();
    books.captured += 1;
    drop(books);
    let name = stream.id.to_string();
    let loan =
        when_free(inner, bus, &name, || output.publisher.loan(payload.len()), || output.publisher.welcome());
    let sent = loan.and_then(|slot| {
        let Some(mut slot) = slot else { return Ok(None) };
        slot.pixels_mut().copy_from_slice(payload);
        let sequence = output.sequence + 1;
        let header = FrameHeader {
            sequence,
            captured: sequence + original.drops().total(),
            flags: original.flags | FrameFlags::REPLAYED.0,
            payload_len: payload.len() as u32,
            ..*original
        };
        *slot.header_mut() = header;
        output.publisher.send_unstamped(slot)?;
        output.sequence = sequence;
        Ok(Some(header))
    });
    inner.intake.wake.raise();
    let mut books = stream.books();
    match &sent {
        Ok(Some(h)) => {
            books.published(h, h.publish_time_ns.saturating_sub(h.capture_time_ns));
        }
        _ => books.dropped.add(DropReason::NoSlot, 1),
    }
    sent
}

/// Runs `action` on a channel. A replay that its subscribers pace waits until they have let go of a slot; `None` when
/// it was stopped meanwhile. `refresh` has the channel look at who is still there: only then does it take back slots
/// that a killed subscriber held.
fn when_free<T>(
    inner: &Inner,
    bus: &Bus,
    channel: &str,
    mut action: impl FnMut() -> depthrig_bus::Result<T>,
    refresh: impl Fn(),
) -> depthrig_bus::Result<Option<T>> {
    let began = HostTime::now();
    let mut warned = false;
    let mut looked = began;
    loop {
        match action() {
            Err(e) if e.kind() == ErrorKind::NoSpace && inner.lossless() => {}
            done => {
                if looked != began || warned {
                    inner.set_waiting_for(None);
                }
                return done.map(Some);
            }
        }
        if inner.stopping() {
            return Ok(None);
        }
        if looked.elapsed() > CLEAN {
            // One of them may have been killed, and will never let go.
            looked = HostTime::now();
            inner.set_waiting_for(Some(channel));
            bus.clean_dead();
            refresh();
        }
        if began.elapsed() > TIMEOUT && !warned {
            warned = true;
            tracing::warn!(
                channel,
                "the replay waits: a subscriber reads no further, or holds more than {} frames (an IMU sends more \
                 batches than that before a set: whoever waits for the set must read it meanwhile)",
                SUBSCRIBER_BUFFER - 1
            );
        }
        std::thread::sleep(ASK);
    }
}
