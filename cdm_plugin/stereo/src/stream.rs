//! A running camera with stereo: its own frames are delivered and copied for the workers, whose results come after.

use super::ledger::{Ledger, Step};
use super::pair::{Raw, Views};
use super::workers::{Event, Product, Workers};
use super::{COLOR, PREFIXES, StereoOptions};
use core::time::Duration;
use depthrig_bus::{DropReason, FrameFlags, HostTime};
use depthrig_driver::clock::{CalibratedLatency, ClockQuality};
use depthrig_driver::controls::ControlPanel;
use depthrig_driver::moments::{Due, FrameSchedule, SetTimes};
use depthrig_driver::{Error, ErrorKind, FrameMeta, FrameSink, Poll, Result, Stream, StreamProfile};
use std::sync::{Arc, Weak};

/// How often the threads' results are looked for while the camera is waited for.
const SLICE: Duration = Duration::from_millis(2);
/// Pairs that may be on their way in a group of streams when no pair may be superseded.
const AHEAD: usize = 2;

/// A running camera with stereo.
pub(super) struct StereoStream {
    profiles: Vec<StreamProfile>,
    inner: Box<dyn Stream>,
    pairing: Pairing,
    every_pair: bool,
    ended: bool,
}

/// Up to three streams: where they are asked for, their number among those that are delivered and the bytes of a frame.
type Outlets = [Option<(usize, usize)>; 3];

/// Streams that are made together.
struct Group {
    /// `color` alone, or depth, confidence, disparity.
    streams: Outlets,
    ledger: Ledger<FrameMeta>,
    /// Times that its matcher failed.
    failures: u64,
}

/// Where the camera's frames are gathered into pairs.
struct Pairing {
    name: String,
    /// Indices of left and right among the camera's streams.
    sides: [usize; 2],
    /// Where each of the camera's streams is delivered, if it is.
    own: Vec<Option<usize>>,
    /// Memory that the camera writes into.
    lent: Vec<Vec<u8>>,
    /// The pair that is being gathered.
    raw: Raw,
    /// Metadata of its left and right image, where it has come.
    have: [Option<FrameMeta>; 2],
    /// From one pair to the next.
    frame_ns: i64,
    /// How far apart the images of a pair may be.
    near_ns: i64,
    /// Moments whose pairs are preferred.
    sets: Arc<SetTimes>,
    /// Which pairs are matched.
    schedule: FrameSchedule,
    ticket: u64,
    /// `color`, then the modes.
    groups: Vec<Group>,
    workers: Workers,
    /// The images show that left and right are swapped.
    swapped: bool,
}

impl StereoStream {
    /// Of `inner`, whose streams number `sides` are left and right; `profiles` are delivered.
    pub(super) fn new(
        name: String,
        inner: Box<dyn Stream>,
        sides: [usize; 2],
        profiles: Vec<StreamProfile>,
        mut workers: Workers,
        options: &StereoOptions,
    ) -> Self {
        let find = |name: &str| profiles.iter().position(|p| p.stream.as_str() == name);
        let own: Vec<_> = inner.profiles().iter().map(|p| find(p.stream.as_str())).collect();
        let group = |streams| Group { streams, ledger: Ledger::new(), failures: 0 };
        let outlet = |name: &str| find(name).map(|i| (i, profiles[i].frame_bytes()));
        let mut groups = vec![group([outlet(COLOR), None, None])];
        for mode in &options.modes {
            groups.push(group(PREFIXES.map(|prefix| outlet(&format!("{prefix}{}", mode.name)))));
        }
        let frame_ns = inner.profiles().get(sides[0]).map_or(0, |p| p.period_ns() as i64);
        let raw = workers.blank();
        let lent: Vec<_> = own.iter().map(|_| Vec::new()).collect();
        let pairing = Pairing {
            name,
            sides,
            own,
            lent,
            raw,
            have: [None; 2],
            frame_ns,
            near_ns: frame_ns / 4,
            sets: Arc::clone(&options.sets),
            schedule: FrameSchedule::new(options.rate_hz, frame_ns),
            ticket: 0,
            groups,
            workers,
            swapped: false,
        };
        Self { profiles, inner, pairing, every_pair: options.every_pair, ended: false }
    }
}

impl Stream for StereoStream {
    fn profiles(&self) -> &[StreamProfile] {
        &self.profiles
    }

    fn controls(&self) -> Option<Weak<dyn ControlPanel>> {
        self.inner.controls()
    }

    fn poll(&mut self, timeout: Duration, sink: &mut dyn FrameSink) -> Result<Poll> {
        let deadline = HostTime::now().plus(timeout);
        let mut came = false;
        loop {
            let left = deadline.from_now();
            let open = self.pairing.open();
            if self.ended && open == 0 {
                return Ok(if came { Poll::Frame } else { Poll::End });
            }
            let wait = if self.ended || (self.every_pair && open >= AHEAD) {
                left
            } else {
                // While threads are at work the camera is waited for in short pieces, so that results do not wait for
                // it.
                let slice = if open > 0 { left.min(SLICE) } else { left };
                match self.inner.poll(slice, &mut Tee { pairing: &mut self.pairing, sink })? {
                    Poll::Frame => came = true,
                    Poll::Idle => {}
                    Poll::End => {
                        self.ended = true;
                        self.pairing.end(sink);
                    }
                }
                Duration::ZERO
            };
            let mut event = self.pairing.workers.next(wait);
            while let Some(e) = event {
                came = true;
                self.pairing.take(e, sink);
                event = self.pairing.workers.next(Duration::ZERO);
            }
            if self.pairing.swapped {
                let what = format!(
                    "{}: its images show that left and right are swapped: what is near lies further right in the right one. \
                     Exchange the halves of the images, or the names of the streams",
                    self.pairing.name
                );
                return Err(Error::new(ErrorKind::BadInput, what));
            }
            if came || deadline.from_now().is_zero() {
                let over = self.ended && self.pairing.open() == 0 && !came;
                return Ok(if came {
                    Poll::Frame
                } else if over {
                    Poll::End
                } else {
                    Poll::Idle
                });
            }
        }
    }
}

impl Pairing {
    /// The most pairs that any group of streams still waits for.
    fn open(&self) -> usize {
        self.groups.iter().map(|g| g.ledger.open()).max().unwrap_or(0)
    }

    /// Takes the image of `side` (0 left, 1 right) from the memory that was lent for it.
    fn gathered(&mut self, side: usize, meta: &FrameMeta, sink: &mut dyn FrameSink) {
        if side == 0 && self.have[0].is_some() {
            // The left image before never met its partner.
            self.lose(DropReason::Incomplete, 1, sink);
        }
        let place = if side == 0 { &mut self.raw.left } else { &mut self.raw.right };
        core::mem::swap(place, &mut self.lent[self.sides[side]]);
        self.have[side] = Some(*meta);
        let [Some(left), Some(right)] = self.have else { return };
        let apart = left.capture_time.since_ns(right.capture_time);
        if apart < -self.near_ns {
            self.have[0] = None;
            self.lose(DropReason::Incomplete, 1, sink);
        } else if apart > self.near_ns {
            self.have[1] = None;
        } else {
            self.have = [None; 2];
            self.submit(&left, sink);
        }
    }

    fn submit(&mut self, meta: &FrameMeta, sink: &mut dyn FrameSink) {
        self.ticket += 1;
        let blank = self.workers.blank();
        let mut raw = core::mem::replace(&mut self.raw, blank);
        raw.ticket = self.ticket;
        let at = meta.capture_time;
        raw.matched = self.schedule.is_due(at.ns(), &self.sets);
        raw.due = self.sets.due(at, self.frame_ns);
        if let Some(period_ns) = self.schedule.period_ns() {
            raw.due = raw.due.filter(|_| raw.matched).or(raw.matched.then(|| Due::alone(at, period_ns)));
        }
        // Pairs that are not to be matched are images of colour alone.
        let groups = if raw.matched { self.groups.len() } else { 1 };
        for group in self.groups.iter_mut().take(groups) {
            group.ledger.begin(self.ticket, *meta);
        }
        if let Some(old) = self.workers.offer(raw) {
            for group in &mut self.groups {
                group.fail(old, DropReason::QueueFull, sink);
            }
        }
    }

    /// Counts pairs without a left image. Where not all are matched, the next one is instead of one of these.
    fn lose(&mut self, reason: DropReason, n: u64, sink: &mut dyn FrameSink) {
        let groups = if self.schedule.period_ns().is_none() { self.groups.len() } else { 1 };
        for group in self.groups.iter_mut().take(groups) {
            let streams = group.streams;
            group.ledger.lose(reason, n, &mut |step| announce(streams, step, sink));
        }
    }

    /// The left image that waits, if one does, will have no partner.
    fn give_up_left(&mut self, sink: &mut dyn FrameSink) {
        if self.have[0].take().is_some() {
            self.lose(DropReason::Incomplete, 1, sink);
        }
    }

    /// The camera sends no more.
    fn end(&mut self, sink: &mut dyn FrameSink) {
        self.give_up_left(sink);
        self.have = [None; 2];
    }

    fn take(&mut self, event: Event, sink: &mut dyn FrameSink) {
        match event {
            Event::Rectified(views) => {
                if let Some(color) = self.groups.first_mut() {
                    color.deliver_color(&views, sink);
                }
            }
            Event::Matched(mode, product) => {
                if let Some(group) = self.groups.get_mut(mode + 1) {
                    group.deliver_depth(&product, sink);
                }
                self.workers.give_back(mode, product);
            }
            Event::Skipped(mode, ticket) => {
                if let Some(group) = self.groups.get_mut(mode + 1) {
                    group.fail(ticket, DropReason::QueueFull, sink);
                }
            }
            Event::Swapped => self.swapped = true,
            Event::Failed(mode, ticket, why) => {
                if let Some(group) = self.groups.get_mut(mode + 1) {
                    group.failures += 1;
                    if group.failures.is_power_of_two() {
                        let n = group.failures;
                        tracing::error!(
                            camera = self.name,
                            times = n,
                            error = why,
                            "stereo failed at a pair"
                        );
                    }
                    group.fail(ticket, DropReason::DeviceError, sink);
                }
            }
        }
    }
}

impl Group {
    fn fail(&mut self, ticket: u64, reason: DropReason, sink: &mut dyn FrameSink) {
        let streams = self.streams;
        self.ledger.fail(ticket, reason, &mut |step| announce(streams, step, sink));
    }

    fn deliver_color(&mut self, views: &Views, sink: &mut dyn FrameSink) {
        self.deliver(views.ticket, sink, |_, memory| {
            if memory.len() != views.left_rgb.len() {
                return Err(DropReason::WrongSize);
            }
            memory.copy_from_slice(&views.left_rgb);
            Ok(())
        });
    }

    fn deliver_depth(&mut self, product: &Product, sink: &mut dyn FrameSink) {
        let Product { ticket, map, depth } = product;
        self.deliver(*ticket, sink, |kind, memory| match kind {
            0 => write(memory, depth, u16::to_le_bytes),
            1 => write(memory, &map.confidence, |c| [c]),
            _ => write(memory, &map.disparity, f32::to_le_bytes),
        });
    }

    /// Delivers the pair `ticket` on each stream of the group; `fill` writes the image of the stream of a kind.
    fn deliver(
        &mut self,
        ticket: u64,
        sink: &mut dyn FrameSink,
        fill: impl Fn(usize, &mut [u8]) -> Result<(), DropReason>,
    ) {
        let streams = self.streams;
        self.ledger.settle(ticket, &mut |step| {
            let Step::Done(facts, captured) = step else {
                announce(streams, step, sink);
                return;
            };
            let meta = FrameMeta { captured, flags: facts.flags.with(FrameFlags::DERIVED), ..facts };
            for (kind, stream) in streams.into_iter().enumerate() {
                let Some((stream, bytes)) = stream else { continue };
                sink.captured(stream, 1);
                let Some(memory) = sink.loan(stream, bytes) else {
                    sink.dropped(stream, DropReason::NoSlot, 1);
                    continue;
                };
                if let Err(reason) = fill(kind, memory) {
                    sink.discard(stream);
                    sink.dropped(stream, reason, 1);
                } else {
                    sink.commit(stream, &meta);
                }
            }
        });
    }
}

/// Writes `values` as bytes.
fn write<T: Copy, const N: usize>(
    memory: &mut [u8],
    values: &[T],
    bytes: impl Fn(T) -> [u8; N],
) -> Result<(), DropReason> {
    if memory.len() != values.len() * N {
        return Err(DropReason::WrongSize);
    }
    for (to, v) in memory.chunks_exact_mut(N).zip(values) {
        to.copy_from_slice(&bytes(*v));
    }
    Ok(())
}

/// Says what is missing from each of `streams`.
fn announce(streams: Outlets, step: Step<FrameMeta>, sink: &mut dyn FrameSink) {
    let Step::Lost(reason, n) = step else { return };
    for (stream, _) in streams.into_iter().flatten() {
        sink.captured(stream, n);
        match reason {
            DropReason::QueueFull => sink.superseded(stream, n),
            reason => sink.dropped(stream, reason, n),
        }
    }
}

/// Sink of the camera's frames: delivers them and gathers them into pairs.
struct Tee<'a> {
    pairing: &'a mut Pairing,
    sink: &'a mut dyn FrameSink,
}

impl Tee<'_> {
    /// Where the camera's stream is delivered.
    fn own(&self, stream: usize) -> Option<usize> {
        self.pairing.own.get(stream).copied().flatten()
    }
}

impl FrameSink for Tee<'_> {
    fn loan(&mut self, stream: usize, len: usize) -> Option<&mut [u8]> {
        let memory = self.pairing.lent.get_mut(stream)?;
        memory.resize(len, 0);
        Some(memory)
    }

    fn commit(&mut self, stream: usize, meta: &FrameMeta) {
        let own = self.own(stream);
        let Self { pairing, sink } = self;
        let Some(image) = pairing.lent.get(stream) else { return };
        if let Some(own) = own {
            // A slot is asked for now and not before the image came, since the image is needed either way.
            if let Some(memory) = sink.loan(own, image.len()) {
                memory.copy_from_slice(image);
                sink.commit(own, meta);
            } else {
                sink.dropped(own, DropReason::NoSlot, 1);
            }
        }
        if let Some(side) = pairing.sides.iter().position(|s| *s == stream) {
            pairing.gathered(side, meta, *sink);
        }
    }

    fn discard(&mut self, _: usize) {}

    fn dropped(&mut self, stream: usize, reason: DropReason, n: u64) {
        if let Some(own) = self.own(stream) {
            self.sink.dropped(own, reason, n);
        }
        if stream == self.pairing.sides[0] {
            // A left image that still waits came before these. A right one may belong to the next left one, of which
            // a gap before it is reported first.
            self.pairing.give_up_left(self.sink);
            self.pairing.lose(reason, n, self.sink);
        }
    }

    fn captured(&mut self, stream: usize, n: u64) {
        if let Some(own) = self.own(stream) {
            self.sink.captured(own, n);
        }
    }

    fn clock_quality(&mut self, stream: usize, quality: &ClockQuality) {
        if let Some(own) = self.own(stream) {
            self.sink.clock_quality(own, quality);
        }
        if stream == self.pairing.sides[0] {
            for (made, _) in self.pairing.groups.iter().flat_map(|g| g.streams).flatten() {
                self.sink.clock_quality(made, quality);
            }
        }
    }

    fn calibrated_latency(&self, stream: usize) -> Option<CalibratedLatency> {
        let made = || self.pairing.groups.iter().flat_map(|g| g.streams).flatten().next();
        let receiver = self.own(stream).or_else(|| made().map(|(made, _)| made))?;
        self.sink.calibrated_latency(receiver)
    }
}
